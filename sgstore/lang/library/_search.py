"""Search of the query library for patterns by words."""

from __future__ import annotations

import re
from functools import cache, partial
from itertools import takewhile
from typing import TYPE_CHECKING, Final

from sgstore.lang.library._entries import NamedPattern, patterns
from sgstore.model.vocabulary import LABEL_ALIASES

if TYPE_CHECKING:
    from collections.abc import Collection

_WORD: Final = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+")

_SYNONYMS: Final = {
    **LABEL_ALIASES,
    **dict.fromkeys(("crash", "crashes", "crashed", "contact", "overlaps", "overlap"), "collision"),
}

_STEM: Final = 4
"""Smallest number of first letters that words of the same stem share: ``brakes``, ``braking``."""


def search(text: str, kinds: Collection[str] = ()) -> list[NamedPattern]:
    """Return the patterns of the query library that match some words, best match first.

    A word counts most in a name, then in a sentence, then in parameters, source and text. Words of one stem
    match, and so do synonyms of a kind (``pedestrian``, ``person``).

    Parameters
    ----------
    text : str
        Words in any order: ``"pedestrian crosses"``.
    kinds : collection of str
        Kinds to search, from :data:`KINDS_OF_PATTERNS`; empty means all.

    Returns
    -------
    list of NamedPattern
        Entries with at least one word, sorted by number of words, then by weight.
    """
    wanted = list(dict.fromkeys(_words(text)))
    ranks: list[tuple[int, int, NamedPattern]] = []
    for entry in patterns().values():
        if kinds and entry.kind not in kinds:
            continue
        weights = [max(map(partial(_weight, word), _places(entry.name))) for word in wanted]
        ranks.append((sum(map(bool, weights)), sum(weights), entry))
    ranks.sort(key=lambda rank: (-rank[0], -rank[1]))
    return [entry for words, _, entry in ranks if words]


@cache
def _places(name: str) -> tuple[tuple[int, frozenset[str]], ...]:
    """Return the words of a library pattern, with weights: words of the name count most."""
    entry = patterns()[name]
    parameters = " ".join(f"{p.name} {p.meaning}" for p in entry.parameters.values())
    rest = f"{parameters} {entry.source} {entry.kind} {entry.query}"
    texts = (4, entry.name), (2, entry.sentence), (1, rest)
    return tuple((weight, frozenset(_words(text))) for weight, text in texts)


def _words(text: str) -> list[str]:
    """Split a text into lower-case words, such as ``cut`` and ``in``. Synonyms are replaced."""
    return [_SYNONYMS.get(word, word) for word in map(str.lower, _WORD.findall(text))]


def _weight(word: str, place: tuple[int, frozenset[str]]) -> int:
    weight, words = place
    return weight if word in words or any(_of_one_stem(word, one) for one in words) else 0


def _of_one_stem(a: str, b: str) -> bool:
    common = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(a, b, strict=False)))
    return common >= _STEM and max(len(a), len(b)) - common <= _ENDING


_ENDING: Final = 3
"""Largest number of letters of a word ending: ``ing``."""
