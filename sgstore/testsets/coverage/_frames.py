"""Queries for missing features or missing values of scene parameters (slots), and tables of results.

Missing features and slot values are returned as queries that users can run.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.display import IN_NOTEBOOK, html_table, text_table
from sgstore.lang.syntax import node_of_kind
from sgstore.model.vocabulary import KINDS

if TYPE_CHECKING:
    from collections.abc import Sequence


_EGOS: Final = ("ego", "ego_car")
_ROLE: Final = re.compile(r"Ego Lane|(Left|Right) \d+ of Ego Lane|Opposing Lane \d+")
_LANE: Final = "Lane"
"""Label of a lane for traffic in frames without a lane of the ego, where lanes have no role."""

_NO_EGO_LANE: Final = "NOT EXISTS {(:Ego)-[:isIn {is_primary: TRUE}]->(:Lane)}"
_PARTS: Final = {
    "Off Road": ":OffRoad",
    "Road": ":Road",
    "Root Road": ":Road",
    "Junction": ":Junction",
}


def query_of_features(features: Sequence[tuple[str, ...]]) -> str | None:
    """Return a query for frames that have all given features; ``None`` if a feature has no pattern.

    Parameters
    ----------
    features : sequence
        Labels of an edge's source, edge and destination; or of a node.
    """
    patterns = [_pattern(feature, f"lane{n}") for n, feature in enumerate(features, start=1)]
    known = [pattern for pattern in patterns if pattern is not None]
    if len(known) < len(patterns):
        return None
    (first, condition), *others = known
    blocks = (f"{one} WHERE {meets}" if meets else one for one, meets in others)
    where = " AND ".join(
        [*([condition] if condition else []), *(f"EXISTS {{{b}}}" for b in blocks)]
    )
    return f"MATCH {first}{' WHERE ' if where else ''}{where} RETURN FRAMES"


def is_of_ego(feature: Sequence[str]) -> bool:
    """True if a feature contains the ego, or a lane named relative to the ego."""
    return any(label in _EGOS or _ROLE.fullmatch(label) for label in feature[::2])


def _pattern(feature: Sequence[str], lane: str) -> tuple[str, str] | None:
    """Return the query pattern of a feature, and its condition on a lane; ``None`` without a pattern."""
    nodes = [f"({lane}:Lane)" if label == _LANE else _node(label) for label in feature[::2]]
    if any(node is None for node in nodes):
        return None
    condition = f"for_traffic({lane}) AND {lane}.role IS NULL AND {_NO_EGO_LANE}"
    pattern = f"{nodes[0]}-[:{feature[1]}]->{nodes[1]}" if len(feature) > 1 else nodes[0]
    return str(pattern), condition if _LANE in feature[::2] else ""


def _node(label: str) -> str | None:
    """Return the query pattern for a node label of an abstraction; ``None`` if it has no pattern."""
    if label in _EGOS:
        return "(:Ego)"
    if label in _PARTS:
        return f"({_PARTS[label]})"
    if _ROLE.fullmatch(label):
        return f"(:Lane {{role: '{label}'}})"
    if label in KINDS:
        return node_of_kind(label)
    return None


_PATTERN: Final = re.compile(r"\s*MATCH\b(?P<body>.*)", re.IGNORECASE | re.DOTALL)
_BEYOND: Final = re.compile(
    r"\b(RETURN|ORDER\s+BY|LIMIT|SAMPLE|THEN|UNTIL|FOR|CHECK|USING|DEFINE)\b|;|(?<!<)--(?!\(|>\s*\()|/\*",
    re.IGNORECASE,
)
_TEXT: Final = re.compile(r"'(?:[^'\\]|\\.|'')*'")


def block_of(pattern: str) -> str | None:
    """Convert a query ``MATCH … WHERE …`` to the text inside ``EXISTS {…}``; ``None`` for other clauses."""
    found = _PATTERN.fullmatch(pattern)
    if found is None or _BEYOND.search(_TEXT.sub("''", found["body"])):
        return None
    return found["body"].strip()


def query_of_blocks(there: Sequence[str], absent: Sequence[str]) -> str:
    """Return a query for frames that match some patterns and do not match others."""
    parts = [f"EXISTS {{{block}}}" for block in there]
    parts += [f"NOT EXISTS {{{block}}}" for block in absent]
    where = f" WHERE {' AND '.join(parts)}" if parts else ""
    return f"MATCH (){where} RETURN FRAMES"


# Results of the commands of coverage: a table, and notes about its denominators.

Row = tuple[Any, ...]


@dataclass(frozen=True)
class ReportTable:
    """Table of results: column names, rows and notes.

    Attributes
    ----------
    columns : tuple of str
    rows : list of tuple
    said : list of str
        Notes that are needed to read the table.
    """

    columns: tuple[str, ...]
    rows: list[Row]
    said: list[str] = field(default_factory=list[str])

    def __str__(self) -> str:
        """Return the first rows and the notes as text."""
        some = self.rows[:IN_NOTEBOOK]
        more = [f"the first {len(some)} rows"] if len(self.rows) > len(some) else []
        return text_table(self.columns, some, "\n".join([*more, *self.said]))

    def _repr_html_(self) -> str:
        """Return the first rows and the notes as an HTML table, for notebooks."""
        return html_table(self.columns, self.rows[:IN_NOTEBOOK], below="; ".join(self.said))

    def without(self, *names: str) -> ReportTable:
        """Return the table without the named columns."""
        kept = [place for place, name in enumerate(self.columns) if name not in names]
        rows = [tuple(row[place] for place in kept) for row in self.rows]
        return ReportTable(tuple(self.columns[place] for place in kept), rows, self.said)

    def column(self, name: str) -> list[Any]:
        """Return the values of a column of the table."""
        place = self.columns.index(name)
        return [row[place] for row in self.rows]

    def dicts(self) -> list[dict[str, Any]]:
        """Return the rows of the table as dictionaries by column name."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]


SHARES = ("measure", "part", "of", "share", "denominator")
"""Column names of a table of shares. Each row states the denominator of its share."""


def share(measure: str, part: float, of: float, denominator: str) -> Row:
    """Return a table row: name, two numbers, and their quotient (``None`` for a division by 0)."""
    return measure, part, of, part / of if of else None, denominator


def of_unknown(unknown: int, text: str) -> list[str]:
    """If some frames have no known class, return a list with a note about them; otherwise an empty list."""
    if not unknown:
        return []
    return [f"{unknown} frames of {text} are too symmetric for a class; they are not counted"]
