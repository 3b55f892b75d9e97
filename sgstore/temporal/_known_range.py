"""Comparison of two ranges around the ego: the stored range, and the range that a check needs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.lang.bind import Horizon, horizon, spoken_kinds
from sgstore.lang.catalog import excluded_kinds

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import BoundCheck
    from sgstore.lang.memory import FrameView
    from sgstore.store import StoreFile


_SPEEDS: Final = """
SELECT frame_id >> 24 AS trace_id, max(speed) AS speed FROM known_state GROUP BY ALL
"""


@dataclass(frozen=True, slots=True)
class ShortRange:
    """Two reasons: why the distance stored around the ego is too small for the verdict true, and for false.

    An empty text means that the verdict is possible.

    Attributes
    ----------
    true, false : str
    """

    true: str = ""
    false: str = ""

    def of(self, *, holds: bool) -> str:
        """Return the reason why the distance stored around the ego is too small for the given verdict.

        An empty text means that the verdict is possible.
        """
        return self.true if holds else self.false

    def or_else(self, other: ShortRange) -> ShortRange:
        """For each verdict, keep the reason why it is impossible. If it is empty, take that of ``other``."""
        return ShortRange(self.true or other.true, self.false or other.false)


def short_ranges(file: StoreFile, catalog: Catalog, check: BoundCheck) -> Mapping[int, ShortRange]:
    """Return the reasons why the range stored around the ego is too short for a check: trace id → reasons.

    Parameters
    ----------
    file : StoreFile
    catalog : Catalog
        Catalog of the bound check.
    check : BoundCheck
    """
    if not check.world or check.unknown_is_false:
        return {}
    found: dict[int, ShortRange] = {}
    limited = [trace for trace in catalog.traces if trace.known < math.inf]
    if _any_short(horizon(check), [t.known for t in limited]):
        fastest = dict(file.rows(_SPEEDS).values)
        for trace in limited:
            needed = horizon(check, fastest.get(trace.trace_id) or 0.0)
            if _any_short(needed, [trace.known]):
                found[trace.trace_id] = short_range(needed, trace.known)
    for trace in catalog.traces:
        if trace.excluded:
            less = found.get(trace.trace_id, ShortRange())
            found[trace.trace_id] = less.or_else(without_kinds(check, trace.excluded))
    return found


def _any_short(needed: Horizon, known: list[float]) -> bool:
    return bool(known) and max(needed.true, needed.false) > min(known)


def short_range(needed: Horizon, known: float) -> ShortRange:
    """Return the reasons why the range stored around the ego, in m, is too short for a check.

    They are empty if it is long enough.

    Parameters
    ----------
    needed : Horizon
    known : float
        m.
    """

    def reason(metres: float) -> str:
        if metres <= known:
            return ""
        far = "everything" if metres == math.inf else f"{math.ceil(metres)} m"
        return f"it depends on {far} around the ego, but the trace covers {known:g} m"

    return ShortRange(reason(needed.true), reason(needed.false))


def without_kinds(check: BoundCheck, excluded: frozenset[str]) -> ShortRange:
    """Return the reasons why a trace cannot decide a check: its settings exclude kinds of node.

    Parameters
    ----------
    check : BoundCheck
    excluded : frozenset of str
    """

    def reason(spoken: frozenset[str]) -> str:
        missed = sorted(spoken & excluded)
        if not missed:
            return ""
        some = ", ".join(missed[:3]) + (f" and {len(missed) - 3} more kinds" if missed[3:] else "")
        return f"it depends on {some}, which the settings of the trace exclude"

    true, false = spoken_kinds(check)
    return ShortRange(reason(true), reason(false))


@dataclass(slots=True)
class SeenRange:
    """Smallest range around the ego that the frames of an online monitor covered.

    Attributes
    ----------
    known : float
        Known distance; m.
    cut : bool
        True if entities beyond the distance were cut off.
    fastest : float
        Highest speed so far; m/s.
    labels : tuple of str
        Labels that the settings keep; empty: all.
    excluded : frozenset of str
        Kinds that the settings excluded.
    """

    known: float
    labels: tuple[str, ...] = ()
    excluded: frozenset[str] = frozenset()
    cut: bool = False
    fastest: float = 0.0

    def see(self, view: FrameView) -> None:
        """Update the covered range around the ego with the data of a new frame."""
        self.cut = self.cut or view.graph.out_of_world > 0
        self.excluded |= view.graph.excluded
        speeds = (about.get("speed", 0.0) for about in view.nodes.values())
        self.fastest = max(self.fastest, *speeds, 0.0)

    def short(self, check: BoundCheck) -> ShortRange:
        """Return the reasons why the frames seen so far cannot prove the check true, and false."""
        if not check.world or check.unknown_is_false:
            return ShortRange()
        found = ShortRange()
        if self.cut:
            found = short_range(horizon(check, self.fastest), self.known)
        excluded = excluded_kinds(self.labels, self.excluded)
        return found.or_else(without_kinds(check, excluded)) if excluded else found
