"""Sequences over columns, and joins of their bindings.

A match is a frame for each step, each frame within the bounds that the link before it sets. There is one match
for each binding and maximal run of frames of the first step: of all that begin in the run, the one whose frames
are the earliest, compared from the first step on.

All frames of all bindings stand in one line, with room between bindings, so that every step is one search in a
sorted array.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.ir import BoundHold, Length
    from sgstore.temporal._offline import TimedRelation
    from sgstore.temporal._signals import Clock
    from sgstore.world import Bools, Ints

    Keys = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Leg:
    """The way from one step to the next.

    Attributes
    ----------
    kind : str
        ``then``, ``immediately``, ``until``, ``while``.
    after, within : Length or None
        Bounds of ``then``.
    absent : (R,) int64 or None
        Places at which something must not happen strictly between the two.
    places : (R,) int64 or None
        Where the next step holds, ascending; ``None``: nothing follows, and what must not happen does not up
        to ``within``.
    """

    kind: str
    after: Length | None
    within: Length | None
    absent: Ints | None
    places: Ints | None


class BindingLine:
    """The frames of many bindings in one line: binding b's frame i is at ``b * stride + i``.

    Parameters
    ----------
    clock : Clock
    """

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.frames = len(clock.times)
        self.stride = self.frames + 1
        breaks = np.ones(self.stride, np.bool_)
        breaks[1 : self.frames] = clock.gap_before[1:]
        self._breaks = breaks

    def frame(self, places: Ints) -> Ints:
        """The frame of each place."""
        return places % self.stride

    def run_ends(self, places: Ints) -> Ints:
        """(R,) the last place of the run that each of some ascending places is in."""
        if not len(places):
            return places
        last = np.append(self._starts(places)[1:], True)
        ends = np.where(last, np.arange(len(places)), len(places))
        return places[np.minimum.accumulate(ends[::-1])[::-1]]

    def runs(self, places: Ints) -> Ints:
        """(R,) the number of the run that each of some ascending places is in."""
        return np.cumsum(self._starts(places)) - 1

    def _starts(self, places: Ints) -> Bools:
        """Return where runs begin: after a missing frame, a gap, or another binding's last frame."""
        starts = np.ones(len(places), np.bool_)
        follows = np.diff(places) == 1
        starts[1:] = ~follows | self._breaks[self.frame(places[1:])]
        return starts

    def held(self, places: Ints, hold: BoundHold) -> Ints:
        """Those places whose run is as long as is asked."""
        if not len(places):
            return places
        runs = self.runs(places)
        first = np.flatnonzero(np.diff(runs, prepend=-1))
        last = np.append(first[1:], len(places)) - 1
        if hold.length.frames:
            length = last - first + 1
        else:
            times = self.clock.times
            length = times[self.frame(places[last])] - times[self.frame(places[first])]
            length = length + (self.clock.period if hold.inclusive else 0)
        return places[hold.fits(length, self.clock.tolerance)[runs]]

    def window(self, leg: Leg, places: Ints) -> tuple[Ints, Ints]:
        """(R,) and (R,) the first and the last place at which the next step may be, from each place."""
        frame = self.frame(places)
        base = places - frame
        if leg.kind == "while":
            return places, places
        if leg.kind == "then":
            low = np.maximum(self._moved(frame, leg.after, "left"), frame + 1)
            high = self._moved(frame, leg.within, "right")
        else:
            low, high = frame + 1, frame + 1
            if leg.kind == "until":
                high = self.run_ends(places) - base + 1
            high = np.where(self._breaks[high], high - 1, high)  # there is a gap, or no frame
        low, high = base + low, base + np.minimum(high, self.frames - 1)
        if leg.absent is not None and len(leg.absent):
            following = np.searchsorted(leg.absent, places, "right")
            inside = np.minimum(following, len(leg.absent) - 1)
            beyond = np.iinfo(np.int64).max
            high = np.minimum(
                high, np.where(following < len(leg.absent), leg.absent[inside], beyond)
            )
        return low, high

    def _moved(self, frame: Ints, by: Length | None, side: str) -> Ints:
        """The first frame that is so much later (``left``), or the last that is not more (``right``)."""
        times = self.clock.times
        if by is None:
            return frame if side == "left" else np.full_like(frame, self.frames - 1)
        if by.frames:
            return frame + by.amount
        tolerance = self.clock.tolerance if side == "right" else -self.clock.tolerance
        amount = max(by.amount + tolerance, 0)
        then = np.minimum(times[frame], np.iinfo(np.int64).max - amount) + amount
        return (
            np.searchsorted(times, then, "left")
            if side == "left"
            else np.searchsorted(times, then, "right") - 1
        )


def matches_of(line: BindingLine, first: Ints, legs: Sequence[Leg], policy: str) -> Ints:
    """The matches of a sequence.

    Parameters
    ----------
    line : BindingLine
    first : (R,) int64
        Places at which the first step holds, ascending.
    legs : sequence of Leg
    policy : str
        ``all``; ``longest``: of those that begin where the earliest does, the one whose further frames are the
        latest, compared from the second step on; ``first``: of each binding only the first match.

    Returns
    -------
    (M, n) int64
        Places of the steps that happen, in order of the first.
    """
    steps = [first, *(leg.places for leg in legs if leg.places is not None)]
    onward: list[tuple[Ints, Ints]] = []
    possible = steps[-1]
    rest = list(legs)
    if rest and rest[-1].places is None:
        possible = _unfollowed(line, rest.pop(), possible)
    for leg, here in zip(reversed(rest), reversed(steps[:-1]), strict=True):
        low, high = line.window(leg, here)
        found, fits = _next(possible, low, high, latest=policy == "longest")
        onward.insert(0, (here[fits], found[fits]))
        possible = here[fits]
    chosen = _one_a_run(line, first, possible)
    if policy == "first" and len(chosen):
        chosen = chosen[np.diff(chosen // line.stride, prepend=-1) != 0]
    columns = [chosen]
    for here, found in onward:
        columns.append(found[np.searchsorted(here, columns[-1])])
    return np.stack(columns, axis=1)


def _next(possible: Ints, low: Ints, high: Ints, *, latest: bool) -> tuple[Ints, Bools]:
    """The earliest (or latest) of some places within each window, and whether there is one."""
    if not len(possible):
        return low, np.zeros(len(low), np.bool_)
    if latest:
        at = np.searchsorted(possible, high, "right") - 1
        found = possible[np.clip(at, 0, None)]
        return found, (at >= 0) & (found >= low) & (found <= high)
    at = np.searchsorted(possible, low, "left")
    found = possible[np.clip(at, None, len(possible) - 1)]
    return found, (at < len(possible)) & (found >= low) & (found <= high)


def _unfollowed(line: BindingLine, leg: Leg, places: Ints) -> Ints:
    """Those places after which something does not happen within a time."""
    absent = leg.absent if leg.absent is not None else places[:0]
    low, high = line.window(Leg("then", None, leg.within, None, None), places)
    _, followed = _next(absent, low, high, latest=False)
    return places[~followed]


def _one_a_run(line: BindingLine, first: Ints, possible: Ints) -> Ints:
    """The first of the possible places in each run of the first step."""
    runs = line.runs(first)[np.searchsorted(first, possible)] if len(possible) else possible
    return possible[np.diff(runs, prepend=-1) != 0] if len(possible) else possible


# Bindings of several steps together: those that agree on the variables that they share ----------

ROWS = 2_000_000
"""Rows of all steps together that are looked at at once."""


@dataclass(frozen=True, slots=True)
class JoinedBindings:
    """Bindings of several relations together.

    Attributes
    ----------
    variables : tuple of str
    bindings : (J, n) int64
    places : (J, r) int64
        For each relation the place of its key.
    """

    variables: tuple[str, ...]
    bindings: Keys
    places: Ints

    def parts(self, relations: Sequence[TimedRelation]) -> Iterator[JoinedBindings]:
        """The same in parts of which each has not too many rows."""
        if not len(self.bindings):
            return
        rows = np.zeros(len(self.bindings), np.int64)
        for number, relation in enumerate(relations):
            rows += np.diff(relation.starts)[self.places[:, number]]
        part = np.cumsum(rows) // ROWS
        starts = np.flatnonzero(np.diff(part, prepend=-1))
        for low, high in zip(starts, np.append(starts[1:], len(part)), strict=True):
            yield JoinedBindings(self.variables, self.bindings[low:high], self.places[low:high])


def joined(
    relations: Sequence[tuple[tuple[str, ...], TimedRelation]], apart: Collection[str]
) -> JoinedBindings:
    """All bindings of some relations, each with its variables, that agree on what these share.

    Parameters
    ----------
    relations : sequence of (variables, TimedRelation)
    apart : collection of str
        Variables of which no two may be the same.
    """
    variables, first = relations[0]
    found = JoinedBindings(variables, first.keys, np.arange(len(first.keys))[:, None])
    for more, relation in relations[1:]:
        found = _with(found, more, relation, apart)
    return found


def _with(
    found: JoinedBindings,
    variables: tuple[str, ...],
    relation: TimedRelation,
    apart: Collection[str],
) -> JoinedBindings:
    shared = [name for name in variables if name in found.variables]
    new = [name for name in variables if name not in found.variables]
    left = found.bindings[:, [found.variables.index(name) for name in shared]]
    right = relation.keys[:, [variables.index(name) for name in shared]]
    rows, others = _pairs(left, right)
    added = relation.keys[others][:, [variables.index(name) for name in new]]
    bindings = np.concatenate((found.bindings[rows], added), axis=1)
    names = (*found.variables, *new)
    kept = np.ones(len(rows), np.bool_)
    for at, name in enumerate(found.variables):
        for column, other in enumerate(new):
            if name in apart and other in apart:
                kept &= bindings[:, at] != added[:, column]
    places = np.column_stack((found.places[rows], others))
    return JoinedBindings(names, bindings[kept], places[kept])


def _pairs(left: Keys, right: Keys) -> tuple[Ints, Ints]:
    """Numbers of the rows of two tables that are equal, ordered by the first."""
    if not len(left) or not len(right):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    both = np.concatenate((left, right))
    if both.shape[1]:
        _, codes = np.unique(both, axis=0, return_inverse=True)
        codes = codes.reshape(-1)
    else:
        codes = np.zeros(len(both), np.int64)
    one, other = codes[: len(left)], codes[len(left) :]
    order = np.argsort(other, kind="stable")
    low = np.searchsorted(other[order], one, "left")
    counts = np.searchsorted(other[order], one, "right") - low
    rows = np.repeat(np.arange(len(left)), counts)
    offset = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    return rows, order[np.repeat(low, counts) + offset]
