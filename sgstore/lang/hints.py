"""What would be right instead: hints for mistakes of people who know other languages, or other names."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sgstore.lang.catalog import NODE_ATTRIBUTES, Type
from sgstore.vocabulary import KINDS, LANE_TYPES, LIGHT_STATES, SPECIALS, folded, suggestion

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

MANY: Final = 16
"""So many names are listed in a hint."""

SYNTAX: Final = tuple(
    (re.compile(looks, re.IGNORECASE), hint)
    for looks, hint in (
        (r"==$", "equality is written '='"),
        (r"&&?$", "write AND"),
        (r"\|\|?$", "write OR"),
        (r"!$", "write NOT before a condition"),
        (r"""\bIS\s+['"]$""", "equality is written '='"),
        (r"""['"]$""", "the text in quotes has no end"),
        (r"\bIN\s*\([^()]*,$", "a list stands in square brackets: IN [1, 2]"),
        (r"[<>]=?\s*[\w.]+\s*[<>]=?$", "write 3 < x.speed AND x.speed < 5"),
        (r"EXISTS\s*\($", "write EXISTS {(a)-[:near]->(b)}, in braces"),
        (
            r"[)\w]\s*<?-\[\s*\w*:$",
            "in a condition, a pattern stands in braces: EXISTS {(a)-[:near]->(b)}",
        ),
        (r"\)\s*-\($", "an edge is written -[:near]-> or -->"),
        (r"\)\s*->?$", "an edge of any relation is written -->"),
        (r"\]\s*>$", "an edge ends in ]->"),
        (r"CLIPS\s*\(\s*[+-]?\d+$", "write CLIPS(-3s, +5s)"),
        (r"\)\s*OPTIONAL$", "what may be absent is asked in a condition: EXISTS {…}, or COUNT {…}"),
        (r"\)\s*WITH$", "there is no WITH: name conditions by DEFINE PREDICATE, results by AS"),
        (r"\)\s*MATCH$", "separate patterns by commas"),
        (r"\bSELECT$|^\s*FROM$", "SQL is asked by sgstore sql, or store.sql()"),
        (r"\bMATCH\s+\w+\s*=$", "a path has no name: name its nodes and edges"),
        (r"\bMATCH\s+\w+\s*:$", "a node stands in brackets: MATCH (e:Ego)"),
        (r"\bBETWEEN$", "write x >= 3 AND x <= 5"),
        (r"\bI?LIKE$", "write STARTS WITH, ENDS WITH, CONTAINS, or =~ with a regular expression"),
        (r"\bGROUP$", "values beside COUNT, MIN, … are the groups: RETURN e.kind, AVG(e.speed)"),
        (r"\bHAVING$", "count in the pattern: WHERE COUNT {…} > 2"),
        (r"\bSKIP$|\bOFFSET$", "there is no such thing: LIMIT n gives the first ones"),
        (r"\bLIMIT\s+\S+\s+(ORDER|SAMPLE)$", "the order is ORDER BY … SAMPLE … LIMIT …"),
        (r"\d\s*km(/h)?$", "speeds are in m/s: write 30 / 3.6"),
        (r"\d\s*h$|\d\s*min\w+$", "times are written 500ms, 2s or 1min"),
        (r"\w\s*:\s*[<>]=?$|\{\s*\w+\s*[<>]=?$", "a property is a value; write WHERE x.speed > 5"),
        (r"\[\s*\w*\s*:[^\]]*\|\s*:$", "one colon is enough: -[:near|visible]->"),
        (r"\(\s*\w*\s*:[^)]*:$", "labels are joined by & or |: (v:Car&Ego)"),
        (r"\bCOUNT\s*\(\s*\(.*:$", "a pattern is counted in braces: COUNT {(v:Car)}"),
    )
)
"""What the text up to and with the unexpected part looks like, and what would be right."""

SYNONYMS: Final[Mapping[str, str]] = {
    "velocity": "speed",
    "v": "speed",
    "acceleration": "accel",
    "yaw": "heading",
    "orientation": "heading",
    "rotation": "heading",
    "class": "kind",
    "category": "kind",
    "model": "type_name",
    "actorid": "ident",
    "trackid": "ident",
    "indicator": "light_left, light_right",
    "blinker": "light_left, light_right",
    "state": "light_state",
    "limit": "speed_limit",
}
"""Other words, folded, for attributes of nodes."""

TOLD: Final[Mapping[str, str]] = {
    **dict.fromkeys(
        ("color", "colour", "make", "brand"), "what the simulator says of its type is in type_name"
    ),
    **dict.fromkeys(
        ("position", "location", "pose", "transform", "pos"),
        "the place of a node e is e.x, e.y, e.z",
    ),
    **dict.fromkeys(
        ("size", "extent", "dimensions", "bbox"), "its size is length, width and height"
    ),
}
"""What people ask for, folded, that is no attribute of nodes, and where it is to be found."""

LIKEN: Final[Mapping[str, str]] = {
    **dict.fromkeys(("police", "ambulance", "fire", "firetruck"), "emergency"),
    **dict.fromkeys(("cab", "uber"), "taxi"),
    "bus": "public_transport",
    "ev": "electric",
    **dict.fromkeys(("amber", "orange"), "yellow"),
}
"""Other words, folded, for words of the closed vocabularies."""

_WORDS: Final = frozenset(folded(w) for w in (*KINDS, *LIGHT_STATES, *SPECIALS, *LANE_TYPES))


def hint_at(name: str, known: Iterable[str]) -> str | None:
    """What a name may have meant: that which is most like it or short for it, or else all that is known."""
    names = sorted(known, key=str.lower)
    others = (words.get(folded(name)) for words in (SYNONYMS, LIKEN))
    other = next((word for word in others if word in names), None)
    like = other or suggestion(name, names) or _short_for(name, names)
    if like:
        return f"did you mean '{like}'?"
    more = f", … ({len(names)} in all)" if len(names) > MANY else ""
    return f"known: {', '.join(names[:MANY])}{more}" if names else None


def _short_for(name: str, names: list[str]) -> str | None:
    """A name that is the beginning of another one, and not by chance."""
    whole = folded(name)
    found = [n for n in names if len(n) >= 3 and whole.startswith(folded(n))]
    return max(found, key=len, default=None)


def bracket_hint(text: str, position: int, found: str) -> str | None:
    """Where a bracket that is not closed was opened, if the text ends too soon; or that there is none to close.

    Parameters
    ----------
    text : str
    position : int
        Where what was not expected begins.
    found : str
        What that is; empty at the end.
    """
    opened: list[int] = []
    for part in _BRACKETS.finditer(text, 0, position):
        if part[0] in _CLOSES:
            if opened and text[opened[-1]] == _CLOSES[part[0]]:
                opened.pop()
        elif len(part[0]) == 1:
            opened.append(part.start())
    if found in _CLOSES and _CLOSES[found] not in {text[place] for place in opened}:
        return f"there is no '{_CLOSES[found]}' that it closes"
    if found or not opened:
        return None
    after = text[opened[-1] + 1 :].strip()
    after = after if len(after) <= _EXCERPT else f"{after[:_EXCERPT].rstrip()}…"
    return f"the '{text[opened[-1]]}' before {after or 'the end'} is not closed"


_BRACKETS: Final = re.compile(
    r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|/\*(?:.|\n)*?\*/|[()\[\]{}]"""
)
"""Brackets, and what brackets may stand in that do not count."""

_CLOSES: Final = {")": "(", "]": "[", "}": "{"}
_EXCERPT: Final = 24


def variable_hint(name: str, visible: Iterable[str], elsewhere: bool) -> str | None:  # noqa: FBT001
    """What a variable that is not known may have meant: an attribute, a text, the time; ``None``: no idea.

    Parameters
    ----------
    name : str
    visible : iterable of str
        Variables that may be used.
    elsewhere : bool
        Whether another part of the query binds one of that name.
    """
    if elsewhere:
        return "a variable of a block is known in this block only: bind it in MATCH"
    if folded(name) in {"t", "time", "seconds"}:
        return "the time since the trace began is frame.t"
    if folded(name) in NODE_ATTRIBUTES:
        owner = next(iter(sorted(set(visible) - {"ego"})), "ego")
        return (
            f"an attribute stands behind a variable: {owner}.{NODE_ATTRIBUTES[folded(name)].name}"
        )
    if folded(name) in _WORDS:
        return f"a text stands in quotes: '{name}'"
    return None


def comparison_hint(left: Type, right: Type, texts: Iterable[object]) -> str | None:
    """What would be right where values of two types are compared.

    Parameters
    ----------
    left, right : Type
    texts : iterable
        Texts that stand in the comparison as they are.
    """
    types = {left, right}
    if types == {Type.number, Type.text}:
        plain = [t for t in texts if re.fullmatch(r"\s*[-+]?\d+(\.\d+)?\s*", str(t))]
        return f"a number has no quotes: {plain[0]}" if plain else None
    if Type.boolean in types:
        return "it is true or false: write it by itself, or after NOT"
    if types == {Type.node, Type.number}:
        return "the id of a node e is e.id"
    if types == {Type.node, Type.text}:
        return "the name of a node e is e.name, what it is e.kind"
    return None
