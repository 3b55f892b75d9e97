"""Features and values of slots as queries: what is missing is asked for by text that a person can run."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sgstore.vocabulary import KINDS

if TYPE_CHECKING:
    from collections.abc import Sequence

_EGOS: Final = ("ego", "ego_car")
_ROLE: Final = re.compile(r"Ego Lane|(Left|Right) \d+ of Ego Lane|Opposing Lane \d+")
_PARTS: Final = {
    "Lane": ":Lane",
    "Off Road": ":OffRoad",
    "Road": ":Road",
    "Root Road": ":Road",
    "Junction": ":Junction",
}


def query_of_features(features: Sequence[tuple[str, ...]]) -> str | None:
    """A query that finds the frames with all of some features; ``None`` if one of them cannot be asked for.

    Parameters
    ----------
    features : sequence
        Labels of an edge's source, of itself and of its destination; or of a node.
    """
    patterns = [_pattern(feature) for feature in features]
    known = [pattern for pattern in patterns if pattern is not None]
    if len(known) < len(patterns):
        return None
    rest = " AND ".join(f"EXISTS {{{pattern}}}" for pattern in known[1:])
    return f"MATCH {known[0]}{' WHERE ' if rest else ''}{rest} RETURN FRAMES"


def is_of_ego(feature: Sequence[str]) -> bool:
    """Whether a feature speaks of the ego, or of a lane by how it lies to the ego."""
    return any(label in _EGOS or _ROLE.fullmatch(label) for label in feature[::2])


def _pattern(feature: Sequence[str]) -> str | None:
    nodes = [_node(label) for label in feature[::2]]
    if any(node is None for node in nodes):
        return None
    return f"{nodes[0]}-[:{feature[1]}]->{nodes[1]}" if len(feature) > 1 else nodes[0]


def _node(label: str) -> str | None:
    """A node of a label of an abstraction, as a pattern."""
    if label in _EGOS:
        return "(:Ego)"
    if label in _PARTS:
        return f"({_PARTS[label]})"
    if _ROLE.fullmatch(label):
        return f"(:Lane {{role: '{label}'}})"
    if label in KINDS:
        name = "".join(part.capitalize() for part in label.split("_"))
        return f"(:{name}&!Ego)"
    return None


_PATTERN: Final = re.compile(r"\s*MATCH\b(?P<body>.*)", re.IGNORECASE | re.DOTALL)
_BEYOND: Final = re.compile(
    r"\b(RETURN|ORDER\s+BY|LIMIT|SAMPLE|THEN|UNTIL|FOR|CHECK|USING|DEFINE)\b|;|(?<!<)--(?!\(|>\s*\()|/\*",
    re.IGNORECASE,
)
_TEXT: Final = re.compile(r"'(?:[^'\\]|\\.|'')*'")


def block_of(pattern: str) -> str | None:
    """A pattern, ``MATCH … WHERE …``, as the inside of ``EXISTS {…}``; ``None`` if it is more than that."""
    found = _PATTERN.fullmatch(pattern)
    if found is None or _BEYOND.search(_TEXT.sub("''", found["body"])):
        return None
    return found["body"].strip()


def query_of_blocks(there: Sequence[str], absent: Sequence[str]) -> str:
    """A query for the frames in which some blocks can be found and others cannot."""
    parts = [f"EXISTS {{{block}}}" for block in there]
    parts += [f"NOT EXISTS {{{block}}}" for block in absent]
    where = f" WHERE {' AND '.join(parts)}" if parts else ""
    return f"MATCH (){where} RETURN FRAMES"
