"""Hints for error messages: words of other query languages, and unknown names. See ``hints.toml``."""

from __future__ import annotations

import re
import tomllib
import unicodedata
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang.catalog import NODE_ATTRIBUTES, Type
from sgstore.model.vocabulary import (
    LANE_TYPES,
    OWN_KINDS,
    OWN_LIGHT_STATES,
    SPECIALS,
    normalize_name,
    relation_named,
    suggestion,
)

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping


LOOK_BACK: Final = 400
"""Number of characters that are checked before the unexpected part of a query."""

MANY: Final = 24
"""Largest number of names that a hint lists."""


@cache
def _tables() -> dict[str, Any]:
    text = resources.files("sgstore.lang.syntax").joinpath("hints.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


@cache
def _words(table: str, of: str) -> Mapping[str, str]:
    """Return one table of ``hints.toml``: normalised word (no capitals, no ``_``) → hint."""
    told = _tables()[table][of].items()
    return {normalize_name(w.replace(" ", "_")): meant for meant, words in told for w in words}


def said_of(of: str, word: str) -> str | None:
    """If a word belongs to another query language, return a hint; otherwise None.

    Parameters
    ----------
    of : str
        ``attributes``, ``functions``, ``methods`` or ``variables``.
    word : str
    """
    return _words("said", of).get(normalize_name(word))


def places(names: Container[str]) -> frozenset[str]:
    """Return names for what the query may have next, such as ``label`` or ``comma``, from the terminals.

    The kinds are ``edge`` (or the end of a pattern), ``value`` (or a condition), ``operator`` (after a
    value), ``time`` (a duration), ``number``, ``label``, ``name``, ``within`` (inside an edge), ``start`` (of
    a statement), ``comma``, ``node`` (its bracket) and ``part`` (of a node).
    """
    value = "STRING" in names and "NULL" in names
    said = {
        "edge": "BARE_ANY" in names,
        "value": value,
        "operator": "SIGN" in names and "STAR" in names and not value,
        "time": "DURATION" in names and not value,
        "number": "NUMBER" in names and not value,
        "label": "PERCENT" in names and "NAME" in names,
        "name": "NAME" in names and not value,
        "within": "_CLOSE" in names,
        "start": "DEFINE" in names,
        "comma": "COMMA" in names,
        "part": "WHERE" in names and "RPAR" in names,
        "node": "LPAR" in names and not value and "SIGN" not in names,
    }
    return frozenset(place for place, so in said.items() if so)


_PREFIXES: Final = (
    "NOT",
    "EXISTS",
    "COUNT",
    "ALWAYS",
    "EVENTUALLY",
    "NEXT",
    "HISTORICALLY",
    "ONCE",
)

_ODD: Final = {
    **dict.fromkeys("→⇒⟶", "->"),
    **dict.fromkeys("←⇐⟵", "<-"),
    **dict.fromkeys("–—−‐", "-"),  # noqa: RUF001 - intended
    **dict.fromkeys("‘’‚´", "'"),  # noqa: RUF001
    **dict.fromkeys("“”„«»", '"'),
    **dict(zip("≥≤≠∈∧∨¬", (">=", "<=", "<>", "IN", "AND", "OR", "NOT"), strict=True)),  # noqa: RUF001
    **dict(zip("×÷∞…", ("*", "/", "INF", ".."), strict=True)),  # noqa: RUF001
}
"""Unusual characters that look like a sign of the language → that sign."""


def slip_hint(
    text: str, start: int, end: int, at: frozenset[str], words: Iterable[str]
) -> str | None:
    """If a part of a query text is not allowed there, return a hint, or None without one.

    Parameters
    ----------
    text : str
    start, end : int
        Start and end of the unexpected part.
    at : frozenset of str
        Kinds of the place: :func:`places`.
    words : iterable of str
        Keywords allowed there.
    """
    found = text[start:end]
    if hint := _character(found, at):
        return hint
    if len(found) > LOOK_BACK:
        return None
    before = text[max(start - LOOK_BACK, 0) : end]
    if hint := _looked("syntax", before, text, end, at):
        return hint
    if like := _like(found, words):
        return f"did you mean {like}?"
    if "operator" in at and re.match(r"[\w$'\"]", found):
        return _joined(found, before[: len(before) - len(found)], at)
    return _looked("last", before, text, end, at)


def _looked(table: str, before: str, text: str, end: int, at: frozenset[str]) -> str | None:
    """Return the hint of the first row in a table of hints that fits the query text at a position."""
    flags = re.IGNORECASE | re.DOTALL
    for looks, hint, *where in _tables()[table]:
        place, then = (*where, "", "")[:2]
        if place and place not in at:
            continue
        found = re.search(f"(?:{looks})$", before, flags)
        if found and re.compile(then, flags).match(text, end, end + LOOK_BACK):
            return found.expand(hint)
    return None


def _character(found: str, at: frozenset[str]) -> str | None:
    """If a query cannot have a character at its place, return a hint, or None without one."""
    if found in {"'", '"'}:
        return "the text in quotes is not closed"
    if found[:1] in {"'", '"'}:
        what = "a label" if "label" in at else "a name" if "name" in at else ""
        word = found[1:-1]
        return f"write {what} without quotes: {word}" if what and word.isidentifier() else None
    if found == "`":
        return "write a name without quotes, a text in '…'"
    if found in _ODD:
        return f"write {_ODD[found]} instead of {found}"
    return _unknown_letter(found, at)


def _unknown_letter(found: str, at: frozenset[str]) -> str | None:
    if found[:1].isalpha() and not found[0].isascii() and "name" in at:
        return "begin a name with a letter from a to z, or with _"
    if found and unicodedata.category(found[0]).startswith("C"):
        return "the character is invisible; delete it"
    return None


def _like(word: str, keywords: Iterable[str]) -> str | None:
    """Return the keyword that is most similar to a word and has the same first letter, or None."""
    like = (
        suggestion(word.upper(), [w for w in keywords if w.isalpha()]) if word.isalpha() else None
    )
    return like if like and like != word.upper() and like[0] == word[0].upper() else None


def _joined(found: str, before: str, at: frozenset[str]) -> str | None:
    """If a word directly follows a value, return a hint: a wrong keyword, or a missing comma or ``AND``."""
    last = re.search(r"(\w+)\s*$", before)
    if last and (like := _like(last[1], _PREFIXES)):
        return f"did you mean {like}?"
    if relation_named(found):
        return f"write a relation in a pattern: EXISTS {{(a)-[:{found}]->(b)}}"
    if "comma" in at:
        return "separate values with commas"
    return "join conditions with AND, and write texts in quotes"


_WORDS: Final = frozenset(
    normalize_name(w) for w in (*OWN_KINDS, *OWN_LIGHT_STATES, *SPECIALS, *LANE_TYPES)
)


def hint_at(name: str, known: Iterable[str]) -> str | None:
    """Return a hint for an unknown name: the most similar known name, or all known names.

    A list keeps its order, so that common names can come first. A set is sorted.
    """
    names = list(known) if isinstance(known, list | tuple) else sorted(known, key=str.lower)
    others = (_words("names", of).get(normalize_name(name)) for of in _tables()["names"])
    other = next((word for word in others if word and word.split(", ")[0] in names), None)
    like = suggestion(name, names)
    if like and len(like) < 3 < len(name):  # two letters are similar to too many names
        like = None
    like = other or like or _short_for(name, names)
    if like:
        return f"did you mean '{like}'?"
    more = f", … ({len(names)} in all)" if len(names) > MANY else ""
    return f"known: {', '.join(names[:MANY])}{more}" if names else None


def _short_for(name: str, names: list[str]) -> str | None:
    """Return the longest known name with which the given name begins, or None."""
    whole = normalize_name(name)
    found = [n for n in names if len(n) >= 3 and whole.startswith(normalize_name(n))]
    return max(found, key=len, default=None)


def bracket_hint(text: str, position: int, found: str) -> str | None:
    """If a query has an unmatched bracket, return a hint with its place; otherwise None.

    Parameters
    ----------
    text : str
    position : int
        Start of the unexpected part.
    found : str
        The unexpected part; empty at the end of the text.
    """
    opened: list[int] = []
    for part in _BRACKETS.finditer(text, 0, position):
        if part[0] in _CLOSES:
            if opened and text[opened[-1]] == _CLOSES[part[0]]:
                opened.pop()
        elif len(part[0]) == 1:
            opened.append(part.start())
    if found in _CLOSES and _CLOSES[found] not in {text[place] for place in opened}:
        return f"the opening '{_CLOSES[found]}' is missing"
    if found or not opened:
        return None
    after = text[opened[-1] + 1 :].strip()
    after = after if len(after) <= _EXCERPT else f"{after[:_EXCERPT].rstrip()}…"
    return f"the '{text[opened[-1]]}' before {after or 'the end'} is not closed"


_BRACKETS: Final = re.compile(
    r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|/\*(?:.|\n)*?\*/|[()\[\]{}]"""
)
"""Regular expression: brackets, and also texts and comments, whose brackets are ignored."""

_CLOSES: Final = {")": "(", "]": "[", "}": "{"}
_EXCERPT: Final = 24


def variable_hint(name: str, visible: Iterable[str], elsewhere: bool) -> str | None:  # noqa: FBT001
    """If an unknown variable may be an attribute or a text without quotes, return a hint; otherwise None.

    Parameters
    ----------
    name : str
    visible : iterable of str
        Variables allowed here.
    elsewhere : bool
        True if another part of the query binds this name.
    """
    if elsewhere:
        return "a block or an alternative step binds it; bind it in MATCH to use it here"
    word = normalize_name(name)
    if (said := said_of("variables", name)) is not None:
        return said.format(name=name)
    if relation_named(name):
        return (
            f"write a relation in a pattern, EXISTS {{(a)-[:{name}]->(b)}}, or as a text: '{name}'"
        )
    if (said := said_of("attributes", name)) is not None:
        return said
    if word in NODE_ATTRIBUTES and len(word) > 1:
        owner = next(iter(sorted(set(visible) - {"ego"})), "ego")
        return f"write an attribute after a variable: {owner}.{NODE_ATTRIBUTES[word].name}"
    return f"write a text in quotes: '{name}'" if word in _WORDS else None


def condition_hint(found: Type, written: str) -> str | None:
    """If a query has a value where it needs a condition, return a hint, or None without one.

    Parameters
    ----------
    found : Type
        Type of the value.
    written : str
        Text of the value.
    """
    if len(written) > _EXCERPT or found is Type.list:
        written = "…"
    if found is Type.number:
        return f"compare it: {written} > 0"
    if found is Type.text:
        return f"compare it: {written} = 'a'"
    if found is Type.node:
        return f"write a condition on it: {written}.speed > 3, stopped({written}), EXISTS {{…}}"
    return None


def comparison_hint(left: Type, right: Type, texts: Iterable[object]) -> str | None:
    """If a comparison has values of different types, return a hint, or None without one.

    Parameters
    ----------
    left, right : Type
    texts : iterable
        Constants in the comparison.
    """
    types = {left, right}
    if types == {Type.number, Type.text}:
        return next(filter(None, map(_number_hint, texts)), None)
    if Type.boolean in types:
        return "it is true or false; write it alone, or after NOT"
    if types == {Type.node, Type.number}:
        return "the id of a node e is e.id"
    if types == {Type.node, Type.text}:
        return "the name of a node e is e.name, its kind is e.kind"
    return None


def _number_hint(value: object) -> str | None:
    """Return a hint for a number in quotes, a number with a unit, or a text without quotes; or None."""
    if isinstance(value, int | float):
        return f"write a text in quotes: '{value}'"
    found = re.fullmatch(r"\s*([-+]?\d+(?:\.\d+)?)\s*([a-z°/²%]*)\s*", str(value), re.IGNORECASE)
    if found is None:
        return None
    if not found[2]:
        return f"write a number without quotes: {found[1]}"
    units = {"m/s": "speeds are in m/s", "km/h": "speeds are in m/s", "mph": "speeds are in m/s"}
    said = units.get(found[2].lower(), "m, m/s, degrees, s")
    return f"write a number without a unit; {said}"
