"""Search for patterns of the query library by name, or by words."""

from __future__ import annotations

import re
from collections import Counter
from difflib import get_close_matches
from functools import cache
from math import log
from typing import TYPE_CHECKING, Final

from sgstore.errors import QueryNameError
from sgstore.lang.library._entries import NamedPattern, patterns
from sgstore.model.vocabulary import LABEL_ALIASES, normalize_name, suggestion

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

_SUGGESTED: Final = 3
"""Largest number of patterns that the error about an unknown name suggests."""

_MISSPELT: Final = 0.8
"""Least similarity of a name to its misspelling, from 0 to 1."""

_WORD: Final = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+")

_ENDING: Final = re.compile(r"(?<=...)(?:e?ly|ing|(?<!e)ed|es|(?<!s)s|ion|e)$")
_DOUBLED: Final = re.compile(r"([bdgmnpt])\1$")
"""Doubled letter before an ending: ``stopped``."""


def _stem(word: str) -> str:
    """Return the stem of a word: ``brak`` for ``brakes`` and ``braking``."""
    stem = _ENDING.sub("", word)
    return _DOUBLED.sub(r"\1", stem)


_SYNONYMS: Final = {
    _stem(word): [_stem(one) for one in meaning.split()]
    for meaning, words in (
        *((name, alias) for alias, name in LABEL_ALIASES.items()),
        ("person", "persons people man woman child children"),
        ("vehicle", "car automobile"),
        ("bicycle", "bike cyclist bicyclist"),
        ("truck", "lorry"),
        ("ego", "i me my self"),
        ("emergency", "ambulance siren"),
        ("collision", "collide crash contact overlap hit touch"),
        ("time collision", "ttc"),
        ("several", "many multiple three four five crowd group"),
        ("stop", "stand stood wait halt stationary static"),
        ("start", "begin"),
        ("near", "nearby nearest close closest among surrounded"),
        ("low", "below under less small short"),
        ("hard", "strong sudden abrupt heavy"),
        ("brake", "decelerate deceleration"),
        ("ahead", "front before"),
        ("junction", "intersection crossroad"),
        ("oncoming", "opposite opposing"),
        ("slow", "creep"),
        ("congestion", "jam"),
        ("road", "street"),
        ("hidden", "occlusion occluded"),
        ("pass", "overtake"),
        ("crosswalk", "zebra"),
        ("no", "without"),
        ("", "a an and are by into is its of that the to with"),
    )
    for word in words.split()
}
"""Stem of a synonym → stems that replace it. Function words have none."""

_NAME, _SENTENCE, _REST = 4.0, 2.0, 1.0
"""Weights of a word in the name, in the sentence, and in parameters, source and text."""

_PREDICATE: Final = 0.8
"""Factor for predicates, which are conditions of queries and not queries."""

_RARE: Final = 0.1
"""Largest share of the entries that have a rare word."""


def pattern_named(name: str, *, check: bool = False) -> NamedPattern:
    """Return a pattern of the query library by name.

    Case and underscores count only if two names differ in nothing else.

    Parameters
    ----------
    name : str
    check : bool
        True to suggest only checks for an unknown name.

    Raises
    ------
    QueryNameError
        The name is unknown or ambiguous.
    """
    found = patterns()
    if name in found:
        return found[name]
    like = [known for known in found if normalize_name(known) == normalize_name(name)]
    if len(like) == 1:
        return found[like[0]]
    if like:
        raise QueryNameError(f"'{name}' may be {' or '.join(like)}", hint="write one of them")
    raise QueryNameError(f"unknown pattern '{name}'", hint=_hint_for(name, check=check))


def _hint_for(name: str, *, check: bool) -> str:
    """Return a hint with the correct name for a misspelt one, otherwise with patterns that have its words."""
    names = [one.name for one in patterns().values() if one.is_check or not check]
    words = [one.name for one in search(name) if one.name in names][:_SUGGESTED]
    near = get_close_matches(name, names, 1, _MISSPELT)
    near = near or words or get_close_matches(name, names, 1)
    near = near or [one for one in (suggestion(name, names),) if one]
    if not near:
        return "list all names with 'sgstore patterns list'"
    more = (
        f"; more: sgstore patterns search {name}" if len(words) == len(near) == _SUGGESTED else ""
    )
    listed = " or ".join(f"'{one}'" for one in near)
    return f"did you mean {listed}?{more}"


def search(text: str, kinds: Collection[str] = ()) -> list[NamedPattern]:
    """Return the patterns of the query library that match some words, best match first.

    A word that few entries have counts more than a common word, such as ``ego``. A word counts most in a
    name, then in a sentence, then in parameters, source and text. Words of one stem match (``brakes``,
    ``braking``), and so do synonyms (``pedestrian``, ``person``).

    Parameters
    ----------
    text : str
        Words in any order: ``"pedestrian crosses"``.
    kinds : collection of str
        Kinds to search, from :data:`KINDS_OF_PATTERNS`; empty means all.

    Returns
    -------
    list of NamedPattern
        Entries with at least one word: first those whose name has exactly the words, then those with all
        rare words in name and sentence, then those of the largest weight.
    """
    places, rarity = _index()
    wanted = {word for word in _words(text) if word in rarity}
    rare = {word for word in wanted if rarity[word] >= -log(_RARE)}
    ranks: list[tuple[bool, bool, float, NamedPattern]] = []
    for entry in patterns().values():
        place = places[entry.name]
        common = wanted & place.keys()
        if not common or (kinds and entry.kind not in kinds):
            continue
        weight = sum(rarity[word] * place[word] for word in common)
        said = {word: rarity[word] * one for word, one in place.items() if one > _REST}
        covered = sum(said[w] for w in said.keys() & wanted) / sum(said.values())
        weight *= (1 + covered) * (_PREDICATE if entry.kind == "predicate" else 1)
        named = wanted == {word for word, one in place.items() if one == _NAME}
        rares = all(place.get(word, 0) > _REST for word in rare)
        ranks.append((named, rares, weight, entry))
    ranks.sort(key=lambda rank: rank[:3], reverse=True)
    return [entry for *_, entry in ranks]


@cache
def _index() -> tuple[Mapping[str, Mapping[str, float]], Mapping[str, float]]:
    """Return the weight of each word in each library pattern, and the rarity of each word."""
    places: dict[str, dict[str, float]] = {}
    for entry in patterns().values():
        parameters = " ".join(f"{p.name} {p.meaning}" for p in entry.parameters.values())
        rest = f"{parameters} {entry.source} {entry.kind} {entry.query}"
        places[entry.name] = {
            **dict.fromkeys(_words(rest), _REST),
            **dict.fromkeys(_words(entry.sentence), _SENTENCE),
            **dict.fromkeys(_words(entry.name), _NAME),
        }
    entries = Counter(word for place in places.values() for word in place)
    return places, {word: log((len(places) + 1) / count) for word, count in entries.items()}


def _words(text: str) -> list[str]:
    """Split a text into words without endings. Synonyms are replaced by one word."""
    stems = [_stem(word.lower()) for word in _WORD.findall(text)]
    return [one for stem in stems for one in _SYNONYMS.get(stem, [stem])]
