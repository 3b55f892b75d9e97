"""A line of a table of results, and the table."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable


class Measure(NamedTuple):
    """One line of a table of results."""

    label: str
    value: float
    unit: str
    note: str = ""


def show(title: str, measures: Iterable[Measure]) -> None:
    """Print a table."""
    print(f"\n{title}\n{'─' * len(title)}")
    for label, value, unit, note in measures:
        number = f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
        print(f"{label:58} {number:>12} {unit:10} {note}".rstrip(), flush=True)
