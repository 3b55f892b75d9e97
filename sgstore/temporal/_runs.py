"""Runs (consecutive matching frames) of a single-frame pattern, for many traces at once.

All rows (one binding in one frame) form one array, ordered by trace, binding and frame. So the work does not
grow with the number of traces. A value over a run is read only for the rows of the pattern.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.lang import ir as b
from sgstore.lang.operators import Column
from sgstore.lang.sql import extents
from sgstore.matches import Windows
from sgstore.model.frame_ids import BUCKET_BITS, FRAME_BITS, seq_of, trace_of
from sgstore.model.world import BUCKET_FRAMES, longest_step_ns, tolerance_ns
from sgstore.temporal._match_values import over_rows, picked
from sgstore.temporal._offline import (
    EDGE_BYTES,
    ROW_BYTES,
    arrays_of,
    buckets_of,
    chosen_traces,
    times_of,
)
from sgstore.temporal._signal_values import Clock, SignalValues
from sgstore.temporal._trace_group import ascending, ordering, places_of
from sgstore.temporal._windows import over_columns

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.sql import Window
    from sgstore.model.world import Bools, Ints
    from sgstore.store import StoreFile
    from sgstore.temporal._plan import Ask, Plan, Test

    Keys = NDArray[np.int64]

FIRST_WINDOW: Final = 2_048
"""Number of buckets in the first window. Each window reads most tables again; dense patterns need memory."""

ROWS_EACH: Final = 2
"""Weight of a sorted row in the count of rows of :class:`Windows`."""

TOGETHER: Final = 1_500_000
"""Largest number of rows that are read at once for several traces."""

VALUE_BYTES: Final = 20
"""Additional memory for each value in a row; bytes."""

LARGE: Final = 1e12
"""Limit above which window sums are computed separately, so that each is rounded only once."""

RunsTold = tuple["Ints", "Ints", "Keys", list[list[Any]]]
"""Runs of frames as columns: ids of first frames, ids of last frames, nodes and edges, returned values."""


@dataclass(frozen=True)
class FrameLine:
    """Frames of many traces, concatenated into one array, with their times.

    Frames come from the buckets of a store, 60 at a time. Times are read on demand.

    Attributes
    ----------
    ids : (F,) int64
        Frame ids in ascending order.
    owners : (F,) int64
        Index of each frame's trace.
    traces, starts : (T,) int64
        Trace ids, and the first frame of each trace.
    periods, tolerances : (T,) int64
        Median period and time tolerance of each trace; ns.
    apart : bool
        True if gaps between frames are possible.
    told : function
        Function that returns ids and times (ns) of all frames read.
    """

    ids: Ints
    owners: Ints
    traces: Ints
    starts: Ints
    periods: Ints
    tolerances: Ints
    apart: bool
    told: Callable[[], tuple[Ints, Ints]]

    @classmethod
    def read(
        cls, file: StoreFile, about: Mapping[int, tuple[Any, ...]], window: Window | None
    ) -> FrameLine:
        """Return the frames of a window of several traces. ``about`` comes from :func:`chosen_traces`."""
        buckets = buckets_of(file, window)
        owners = buckets["bucket"] >> BUCKET_BITS
        rows = np.isin(owners, [*about])
        if window is not None and window.traces is not None:
            rows &= np.isin(owners, window.traces)
        bucket, valid, joined = (buckets[n][rows] for n in ("bucket", "valid", "joined"))
        held, bits = np.nonzero((valid[:, None] >> np.arange(BUCKET_FRAMES)) & 1)
        ids = (bucket[held] << FRAME_BITS) + bits
        starts = np.flatnonzero(np.diff(trace_of(ids), prepend=-1))
        traces, counts = trace_of(ids[starts]), np.diff(starts, append=len(ids))
        owners = np.repeat(np.arange(len(traces)), counts)
        periods = np.array([about[trace][2] for trace in traces.tolist()], np.int64)
        tolerances = np.array([tolerance_ns(period) for period in periods.tolist()], np.int64)
        apart = int(np.bitwise_count(joined).sum()) != len(ids) - len(traces)
        told = partial(times_of, file, window)
        return cls(ids, owners, traces, starts, periods, tolerances, apart, told)

    @cached_property
    def times(self) -> Ints:
        """Times of the frames, shape (F,), strictly ascending in each trace; ns."""
        ids, times = self.told()
        if len(ids) != len(self.ids):
            times = times[np.isin(trace_of(ids), self.traces)]
        still = np.diff(times) <= 0
        still[self.starts[1:] - 1] = False
        ends = np.append(self.starts[1:], len(times))
        for owner in np.unique(self.owners[1:][still]).tolist():
            own = slice(self.starts[owner], ends[owner])
            times[own] = ascending(times[own])
        return times

    @cached_property
    def begins(self) -> Bools:
        """Mask (F,) of the frames at the start of a trace or after a gap."""
        found = np.zeros(len(self.ids), np.bool_)
        if self.apart:
            longest = np.array([longest_step_ns(period) for period in self.periods.tolist()])
            found[1:] = np.diff(self.times) > longest[self.owners[1:]]
            found |= np.diff(seq_of(self.ids), prepend=-2) != 1
        found[self.starts] = True
        return found

    def places(self, ids: Ints) -> Ints:
        """Return the array index of each frame id, shape (R,). -1 if the frame is not present."""
        return places_of(ids, self.ids, self.traces, self.starts)


@dataclass(frozen=True)
class BindingRows:
    """Table of query matches in many traces: one row for each frame and combination of nodes.

    Rows are sorted by trace, nodes and frame, without duplicates.

    Attributes
    ----------
    line : FrameLine
    frames : (R,) int64
        Index of each row's frame in the line.
    keys : (R, n) int64
    fresh : (R,) bool
        True for the first row of a binding.
    values : dict of Bound to Column
        (1, R).
    """

    line: FrameLine
    frames: Ints
    keys: Keys
    fresh: Bools
    values: Mapping[b.Bound, Column]

    @classmethod
    def of(
        cls, line: FrameLine, ids: Ints, keys: Keys, values: Mapping[b.Bound, Column]
    ) -> BindingRows:
        """Return the table of matches from unsorted rows. Rows of other traces are dropped."""
        frames = line.places(ids)
        known = frames >= 0
        if not known.all():
            frames, keys = frames[known], keys[known]
            values = {name: _rows(value, known) for name, value in values.items()}
        owners = line.owners[frames]
        order = ordering([owners, *keys.T, frames - line.starts[owners]])
        frames, keys = frames[order], keys[order]
        fresh = np.ones(len(order), np.bool_)
        fresh[1:] = np.diff(owners[order]) != 0
        for key in keys.T:
            fresh[1:] |= key[1:] != key[:-1]
        found = cls(line, frames, keys, fresh, {n: _rows(v, order) for n, v in values.items()})
        again = ~fresh
        again[1:] &= np.diff(frames) == 0
        return found.only(~again) if again.any() else found

    def only(self, rows: Bools) -> BindingRows:
        """Return a copy of the table with only the selected rows."""
        owners = np.cumsum(self.fresh)[rows]
        fresh = np.diff(owners, prepend=0) != 0
        values = {name: _rows(value, rows) for name, value in self.values.items()}
        return BindingRows(self.line, self.frames[rows], self.keys[rows], fresh, values)

    def __len__(self) -> int:
        return len(self.frames)

    @cached_property
    def starts(self) -> Ints:
        """Index of the first row of each run (series of rows with consecutive frames and the same nodes)."""
        follows = np.diff(self.frames, prepend=-2) == 1
        return np.flatnonzero(self.fresh | ~follows | self.line.begins[self.frames])

    def held(self, hold: b.BoundHold) -> BindingRows:
        """Return a copy with only those runs (same nodes in consecutive frames) that last long enough."""
        if not len(self):
            return self
        counts = np.diff(self.starts, append=len(self))
        first, last = self.frames[self.starts], self.frames[self.starts + counts - 1]
        owners = self.line.owners[first]
        length = counts
        if not hold.length.frames:
            length = self.line.times[last] - self.line.times[first]
            length = length + (self.line.periods[owners] if hold.inclusive else 0)
        tolerances: Any = self.line.tolerances[owners]
        return self.only(np.repeat(hold.fits(length, tolerances), counts))


class RowValues(SignalValues):
    """Values of expressions over several frames, one for each row of a table of matches, (1, R).

    Parameters
    ----------
    rows : BindingRows
    """

    def __init__(self, rows: BindingRows) -> None:
        nothing = np.zeros(0, np.int64)
        super().__init__(Clock(nothing, nothing, 0))
        self._rows = rows

    def signal(self, signal: Ask) -> Column:
        """Return the value of a single-frame query in each row of the table, (1, R)."""
        assert signal.value is not None  # noqa: S101 - it is no atom
        return self._rows.values[signal.value]

    def course(self, course: b.SignalCall, test: Test) -> Column:
        """Return the value of a function over a time window, such as ``avg_over(x, 2s)``, in each row."""
        column = self.signal(test.signals[course.operand])
        first = self.window_starts(course)
        if course.word in {"sum_over", "avg_over"}:
            known = column.known & np.isfinite(column.values)
            if np.abs(column.values[known]).max(initial=0) > LARGE:
                return _one_by_one(course.word, column.values[0], known[0], first)
        return over_columns(course.word, column, first)

    def window_starts(self, course: b.SignalCall) -> Ints:
        """For each row, return the first row of the time window that ends at it, shape (R,)."""
        rows, line = self._rows, self._rows.line
        here = np.arange(len(rows))
        stretch = np.cumsum(line.begins)[rows.frames]
        begun = rows.fresh | (np.diff(stretch, prepend=0) != 0)
        begun = np.maximum.accumulate(np.where(begun, here, 0))
        if course.frames:
            at, guess = rows.frames, here - (course.by - 1)
            limit = at - (course.by - 1)
        else:
            owners = line.owners[rows.frames]
            at, room = line.times[rows.frames], course.by + line.tolerances
            limit = at - room[owners]
            guess = here - (room // np.maximum(line.periods, 1))[owners]
        # Without missing frames and with an even clock, a window has one row per frame.
        found = np.maximum(guess, begun)
        early = (found == begun) | (at[found - 1] < limit)
        wrong = np.flatnonzero((at[found] < limit) | ~early)
        found[wrong] = _earliest(at, limit[wrong], begun[wrong], wrong)
        return found


class RunFinder:
    """Search in a store for the runs (consecutive matching frames) of a single-frame pattern.

    Parameters
    ----------
    file : StoreFile
        Store; it must not change during use.
    catalog : Catalog
    query : Query
        Query with one step.
    plan : Plan
        Plan of the additional conditions, and of values over runs.
    ask : Ask
        The pattern.
    named : tuple of str
        Nodes and edges that a match returns.
    """

    def __init__(
        self,
        file: StoreFile,
        catalog: Catalog,
        query: b.Query,
        plan: Plan,
        ask: Ask,
        named: tuple[str, ...],
    ) -> None:
        self._file, self._catalog, self._query = file, catalog, query
        self._plan, self._ask, self._named = plan, ask, named
        scope = ask.query.scope
        bare = not (scope.edges or scope.where) and {*scope.nodes} == {*ask.variables}
        self._window_nodes = frozenset(ask.variables) if bare else None

    def fits(self, places: Sequence[b.Bound]) -> bool:
        """True if a single query can return both the matches and the values in ``RETURN``."""
        step = self._query.steps[0]
        if self._query.spans or step.absent or self._query.gaps != "break" or self._ask.everywhere:
            return False
        asked = [*step.when, *(value for place in places for value in _values(place))]
        return all(map(self._is_of_rows, asked))

    def _is_of_rows(self, value: b.Bound) -> bool:
        match value:
            case b.SignalCall(word=word, operand=operand) if word in b.WINDOWS and not value.ahead:
                plain = not b.is_temporal(operand) and self._is_of_rows(operand)
                return plain and b.nodes_of(operand) == self._window_nodes
            case _ if b.is_formula(value):
                return False  # a formula counts unknown as false
            case b.Operation(operands=operands) if b.is_temporal(value):
                return all(map(self._is_of_rows, operands))
            case b.StepTime():
                return False
            case _:
                plain = not (b.is_temporal(value) or b.edges_of(value) or [*b.blocks_of(value)])
                return plain and b.nodes_of(value) <= {*self._ask.variables}

    @cached_property
    def _about(self) -> dict[int, tuple[Any, ...]]:
        return chosen_traces(self._file, self._query, self._catalog)

    def found(self, places: Sequence[b.Bound], within: Window | None) -> Iterator[RunsTold]:
        """Yield the runs (consecutive matching frames) of whole traces, split into portions for the memory.

        Parameters
        ----------
        places : sequence of Bound
            Values to compute for each run.
        within : Window or None
        """
        # Ids are digests, so their order mixes traces, and each window reads a part of each table.
        every = sorted(extents(self._catalog))
        asked = [one for one in every if within is None or one[0] in within]
        steps = Windows(asked, first=FIRST_WINDOW, whole_traces=True)

        def ask(window: Window | None) -> tuple[RunsTold, int]:
            return self._found(places, None if window is None else window.whole(every))

        for window in steps:
            for told, rows in steps.parts(window or within, ask):
                steps.rows += rows * ROWS_EACH
                yield told

    def _found(self, places: Sequence[b.Bound], window: Window | None) -> tuple[RunsTold, int]:
        """Return the runs (consecutive matching frames) in a window of frames, and the number of rows read."""
        step = self._query.steps[0]
        tests = {one: self._plan.test(one) for one in step.when}
        tests |= {one: self._plan.test(one) for place in places for one in _values(place)}
        rows = self._read(tests.values(), window)
        many = len(rows)
        values = RowValues(rows)
        found = {one: _whole(values.test(test), len(rows)) for one, test in tests.items()}
        rows = replace(rows, values=found)
        for one in step.when:
            rows = rows.only(rows.values[one].true[0])
        rows = self._projected(rows)
        rows = rows if step.hold is None else rows.held(step.hold)
        columns = rows.values
        counts = np.diff(rows.starts, append=len(rows))
        told: list[Any] = []
        for place in places:
            if isinstance(place, b.OverMatch):
                at = None if place.at is None else columns[place.at]
                over = over_rows(place.word, columns[place.operand], rows.starts, at)
                told.append(np.repeat(over, counts))
            else:
                here = np.arange(len(rows))
                told.append(picked(columns[place], np.zeros_like(here), here))
        return self._parts(rows, told), many

    def _parts(self, rows: BindingRows, told: list[Any]) -> RunsTold:
        """Return the first frame, last frame, nodes and values of each run of matching frames.

        A run ends where a returned value changes or a frame id is skipped.
        """
        ids = rows.line.ids[rows.frames]
        new = np.diff(ids, prepend=-2) != 1
        new[rows.starts] = True
        for column in told:
            new[1:] |= column[1:] != column[:-1]
        first = np.flatnonzero(new)
        last = np.append(first[1:], len(ids))[: len(first)] - 1
        values = [column[first].tolist() for column in told]
        return ids[first], ids[last], rows.keys[first], values

    def _projected(self, rows: BindingRows) -> BindingRows:
        """Return a copy of the table of matches with only the node columns that the query returns."""
        if self._named == self._ask.columns:
            return rows
        columns = [self._ask.columns.index(name) for name in self._named]
        ids = rows.line.ids[rows.frames]
        return BindingRows.of(rows.line, ids, rows.keys[:, columns], rows.values)

    def _read(self, tests: Collection[Test], window: Window | None) -> BindingRows:
        """Return the matches of the pattern in a window, with the values that some expressions need."""
        signals = (signal.value for test in tests for signal in test.signals.values())
        asked = list(dict.fromkeys(value for value in signals if value is not None))
        line = FrameLine.read(self._file, self._about, window)
        size = ROW_BYTES + EDGE_BYTES * len(self._ask.edges) + VALUE_BYTES * len(asked)
        most = self._file.memory // size
        if len(line.traces) > 1:
            most = min(most, TOGETHER)
        ids, keys, found = arrays_of(self._file, self._catalog, self._ask, window, asked, most)
        values = {value: _column(one) for value, one in zip(asked, found, strict=True)}
        return BindingRows.of(line, ids, keys, values)


def _values(place: b.Bound) -> tuple[b.Bound, ...]:
    if not isinstance(place, b.OverMatch):
        return (place,)
    return (place.operand,) if place.at is None else (place.operand, place.at)


def _column(told: Any) -> Column:
    """Return a column read from the database as values and a mask of the known ones, shape (1, R)."""
    values, known = np.ma.getdata(told), ~np.ma.getmaskarray(told)
    if values.dtype.kind in "iuf":
        values = values.astype(np.float64)
        known &= ~np.isnan(values)
    return Column(values[None], known[None])


def _rows(column: Column, rows: Any) -> Column:
    return Column(column.values[:, rows], column.known[:, rows])


def _whole(column: Column, rows: int) -> Column:
    shape = 1, rows
    return Column(np.broadcast_to(column.values, shape), np.broadcast_to(column.known, shape))


def _earliest(at: Ints, limit: Ints, low: Ints, high: Ints) -> Ints:
    """For each row, return the first index in its range at which the sorted ``at`` reaches the limit."""
    low, high = low.copy(), high.copy()
    while np.any(low < high):
        middle = (low + high) // 2
        reached = at[middle] >= limit
        low, high = np.where(reached, low, middle + 1), np.where(reached, middle, high)
    return low


def _one_by_one(word: str, values: Any, known: Bools, first: Ints) -> Column:
    """For each row, return the exact sum or mean of the known values in its time window."""
    count = np.concatenate(([0], np.cumsum(known)))
    some = values[known].tolist()
    ends = zip(count[first].tolist(), count[1:].tolist(), strict=True)
    total = np.array([math.fsum(some[low:high]) for low, high in ends])
    many = count[1:] - count[first]
    total = total / np.maximum(many, 1) if word == "avg_over" else total
    return Column(total[None], (many > 0)[None])
