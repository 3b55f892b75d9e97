"""What the verbs of coverage answer with: a table, and sentences that say what its numbers are of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

Row = tuple[Any, ...]


@dataclass(frozen=True)
class Table:
    """Rows with the names of their columns.

    Attributes
    ----------
    columns : tuple of str
    rows : list of tuple
    said : list of str
        What a person must know to read them.
    """

    columns: tuple[str, ...]
    rows: list[Row]
    said: list[str] = field(default_factory=list[str])

    def column(self, name: str) -> list[Any]:
        """The values of a column."""
        place = self.columns.index(name)
        return [row[place] for row in self.rows]

    def dicts(self) -> list[dict[str, Any]]:
        """The rows, each as a dict from column to value."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]


SHARES = ("measure", "part", "of", "share", "denominator")
"""Columns of a table of shares: the share, and what it is a share of."""


def share(measure: str, part: float, of: float, denominator: str) -> Row:
    """A row of such a table; no share of nothing."""
    return measure, part, of, part / of if of else None, denominator


def of_unknown(unknown: int, text: str) -> list[str]:
    """The sentence about frames that have no class, if there are any."""
    if not unknown:
        return []
    return [
        f"{unknown} frames of {text} are too symmetric for a class to be told; they count nowhere"
    ]
