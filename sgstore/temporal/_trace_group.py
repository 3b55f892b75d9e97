"""Query results of traces in memory: frame times and tables of matches, for one or several traces.

A group has the frames of all its traces in one array, and each table begins with the index of the trace. So the
work of a sequence does not grow with the number of traces.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.lang.operators import Column
from sgstore.model.frame_ids import BUCKET_BITS, FRAME_BITS, seq_of, trace_of
from sgstore.model.world import JUMP_NS, longest_step_ns, seconds_of, tolerance_ns
from sgstore.temporal._signal_values import Clock

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Ints

    Keys = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TimedRelation:
    """Table of query matches: the nodes of each match, and the frames in which it occurs.

    Attributes
    ----------
    keys : (K, n) int64
        Distinct bindings in ascending order.
    starts : (K + 1,) int64
        Start of each binding's frames.
    frames : (R,) int64
        Numbers of frames, ascending for each binding.
    values : tuple of (R,) arrays
        Queried values of each match; unknown values are masked.
    """

    keys: Keys
    starts: Ints
    frames: Ints
    values: tuple[Any, ...] = ()

    @property
    def owners(self) -> Ints:
        """Index of the match (node combination) to which each row belongs, (R,)."""
        return np.repeat(np.arange(len(self.keys)), np.diff(self.starts))

    @classmethod
    def of(cls, frames: Ints, keys: Keys, values: Sequence[Any] = ()) -> TimedRelation:
        """Return the table of matches from unsorted rows of frame and node ids. Duplicate rows are dropped.

        Parameters
        ----------
        frames : (R,) int64
        keys : (R, n) int64
        values : sequence of (R,) arrays
        """
        order = ordering([*keys.T, frames])
        return cls.ordered(frames[order], keys[order], [value[order] for value in values])

    @classmethod
    def ordered(cls, frames: Ints, keys: Keys, values: Sequence[Any] = ()) -> TimedRelation:
        """Return the table of matches from rows that are sorted by node ids, then by frame."""
        new = _changes(keys)
        fresh = new.copy()
        fresh[1:] |= frames[1:] != frames[:-1]
        if not fresh.all():
            frames, keys, new = frames[fresh], keys[fresh], new[fresh]
            values = [value[fresh] for value in values]
        first = np.flatnonzero(new)
        return cls(keys[first], np.append(first, len(frames)), frames, tuple(values))

    def between(self, first: int, last: int) -> TimedRelation:
        """Return the table limited to a range of frames (ends included). Frames count from 0 again."""
        rows = np.flatnonzero((self.frames >= first) & (self.frames <= last))
        owners = np.searchsorted(self.starts, rows, "right") - 1
        new = np.flatnonzero(np.diff(owners, prepend=-1))
        keys, starts = self.keys[owners[new]], np.append(new, len(rows))
        values = tuple(value[rows] for value in self.values)
        return TimedRelation(keys, starts, self.frames[rows] - first, values)

    def find(self, wanted: Keys) -> Ints:
        """Return the index of each given node combination in the table, shape (B,); -1 for a missing one."""
        if not len(self.keys) or not len(wanted):
            return np.full(len(wanted), -1)
        if not wanted.shape[1]:
            return np.zeros(len(wanted), np.int64)
        codes = codes_of(np.concatenate((self.keys, wanted)))
        place = np.full(int(codes.max()) + 1, -1)
        place[codes[: len(self.keys)]] = np.arange(len(self.keys))
        return place[codes[len(self.keys) :]]

    def rows_of(self, places: Ints) -> tuple[Ints, Ints]:
        """Return all frame rows of some matches, given their indices in the table.

        The result is the position in ``places`` and the row index of each.
        """
        known = np.flatnonzero(places >= 0)
        first, end = self.starts[places[known]], self.starts[places[known] + 1]
        counts = end - first
        owner = np.repeat(known, counts)
        offset = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
        return owner, np.repeat(first, counts) + offset

    def flags(self, places: Ints, length: int) -> Bools:
        """Return a mask (B, length): true if the match occurs in the frame. All false for index -1."""
        found = np.zeros((len(places), length), np.bool_)
        owner, rows = self.rows_of(places)
        found[owner, self.frames[rows]] = True
        return found

    def column(self, places: Ints, length: int, number: int = 0) -> Column:
        """Return the value of each match in each frame, (B, length), with a mask of the known values."""
        told = self.values[number]
        plain = np.ma.getdata(told)
        kind = np.float64 if plain.dtype.kind in "iuf" else plain.dtype
        values = np.zeros((len(places), length), kind)
        if plain.dtype.kind == "O":
            values[:] = ""
        known = np.zeros((len(places), length), np.bool_)
        owner, rows = self.rows_of(places)
        at = owner, self.frames[rows]
        values[at] = plain[rows]
        known[at] = ~np.ma.getmaskarray(told)[rows]
        if kind is np.float64:
            known &= ~np.isnan(values)
        return Column(values, known)


CELLS: Final = 4_000_000
"""Largest product of node combinations and frames that are processed at once."""


@dataclass(slots=True)
class TraceReader:
    """Data of one trace in memory: frames, times and query results.

    Attributes
    ----------
    trace_id : int
    name : str
    frame_ids, numbers, times, log_times : (F,) int64
        Frame ids, frame numbers (``seq``), simulation times and log times (ns).
    start : int
        Simulation time from which seconds are counted; ns.
    clock : Clock
    relations : dict of str to TimedRelation
    """

    trace_id: int
    name: str
    frame_ids: Ints
    numbers: Ints
    times: Ints
    log_times: Ints
    start: int
    clock: Clock
    relations: dict[str, TimedRelation] = field(default_factory=dict[str, TimedRelation])

    def __len__(self) -> int:
        return len(self.frame_ids)

    def between(self, first: int, last: int) -> TraceReader:
        """Return a range of frames (ends included) as a trace of its own."""
        rows = slice(first, last + 1)
        return replace(
            self,
            frame_ids=self.frame_ids[rows],
            numbers=self.numbers[rows],
            times=self.times[rows],
            log_times=self.log_times[rows],
            clock=replace(self.clock, times=self.clock.times[rows], runs=self.clock.runs[rows]),
            relations={name: one.between(first, last) for name, one in self.relations.items()},
        )

    @property
    def together(self) -> int:
        """Number of node combinations to process at once. Their arrays must fit into memory."""
        return max(CELLS // max(len(self), 1), 1)

    def seconds(self, frame: int) -> float:
        """Return the time of a frame since the start of the trace; s."""
        return seconds_of(int(self.times[frame] - self.start))


@dataclass(frozen=True, slots=True)
class JointClock:
    """Frame times of several traces on one time axis. A day separates one trace from the next.

    Attributes
    ----------
    times : (F,) int64
        Ascending; ns.
    gap_before : (F,) bool
        Mask of the frames after a gap, and of the first frames of the traces.
    period, tolerance : (F,) int64
        See :class:`Clock`, for the trace of each frame.
    """

    times: Ints
    gap_before: Bools
    period: Ints
    tolerance: Ints


@dataclass(slots=True)
class TraceGroup:
    """Data of several traces in memory: frames, times and query results, in the order of the trace ids.

    Attributes
    ----------
    ids, begins, periods : (T,) int64
        Ids, start times and frame periods of the traces; ns.
    names : list of str
    starts : (T + 1,) int64
        First frame of each trace.
    frame_ids, numbers, times, log_times : (F,) int64
        See :class:`TraceReader`.
    ticks : (F,) int64
        Times that ascend in each trace; ns.
    runs : (F,) int64
        Number of each frame's run without gaps.
    relations : dict of str to TimedRelation
        Their keys begin with the index of the trace.
    """

    ids: Ints
    begins: Ints
    periods: Ints
    names: list[str]
    starts: Ints
    frame_ids: Ints
    numbers: Ints
    times: Ints
    log_times: Ints
    ticks: Ints
    runs: Ints
    relations: dict[str, TimedRelation] = field(default_factory=dict[str, TimedRelation])

    @classmethod
    def of(
        cls, about: Mapping[int, Sequence[Any]], clock: Mapping[str, Ints], gaps: str
    ) -> TraceGroup:
        """Return the frames of several traces. ``about``: trace id → name, start (ns), frame period (ns)."""
        columns = [clock[name] for name in ("frame_id", "seq", "time_ns", "log_time_ns")]
        known = np.isin(trace_of(columns[0]), [*about])
        if not known.all():
            columns = [column[known] for column in columns]
        owners = trace_of(columns[0])
        first = np.flatnonzero(np.diff(owners, prepend=-1))
        ids, starts = owners[first], np.append(first, len(owners))
        told = [about[trace] for trace in ids.tolist()]
        begins, periods = (np.array([one[n] for one in told], np.int64) for n in (1, 2))
        ticks = columns[2].copy()
        steps = np.diff(ticks, prepend=ticks[:1])
        steps[first] = 1
        late = np.flatnonzero(steps <= 0)
        for trace in np.unique(np.searchsorted(starts, late, "right") - 1).tolist():
            own = slice(starts[trace], starts[trace + 1])
            ticks[own] = ascending(ticks[own])
        steps = np.diff(ticks, prepend=ticks[:1])
        if gaps == "bridge":
            breaks = steps == JUMP_NS
        else:
            longest = np.array([longest_step_ns(period) for period in periods.tolist()])
            breaks = steps > np.repeat(longest, np.diff(starts))
            breaks |= np.diff(columns[1], prepend=columns[1][:1] - 1) != 1
        breaks[first] = True
        frame_ids, numbers, times, log_times = columns
        return cls(
            ids,
            begins,
            periods,
            [one[0] for one in told],
            starts,
            frame_ids,
            numbers,
            times,
            log_times,
            ticks,
            np.cumsum(breaks),
        )

    @classmethod
    def alone(cls, trace: TraceReader) -> TraceGroup:
        """Return a single trace as a group."""
        clock = trace.clock
        ids, begins, periods = (
            np.array([one]) for one in (trace.trace_id, trace.start, clock.period)
        )
        starts = np.array([0, len(trace)])
        frames = trace.frame_ids, trace.numbers, trace.times, trace.log_times
        found = cls(ids, begins, periods, [trace.name], starts, *frames, clock.times, clock.runs)
        for name, one in trace.relations.items():
            keys = np.insert(one.keys, 0, 0, axis=1)
            found.relations[name] = replace(one, keys=keys)
        return found

    @property
    def clock(self) -> JointClock:
        """Clock with the frame times of all traces."""
        counts = np.diff(self.starts)
        first = self.starts[:-1]
        steps = np.diff(self.ticks, prepend=self.ticks[:1])
        steps[first] = JUMP_NS
        gaps = np.diff(self.runs, prepend=self.runs[:1]) != 0
        gaps[first] = True
        tolerances = [tolerance_ns(period) for period in self.periods.tolist()]
        both = (np.repeat(np.array(one, np.int64), counts) for one in (self.periods, tolerances))
        return JointClock(np.cumsum(steps), gaps, *both)

    @property
    def _whole(self) -> bool:
        """True if each trace has all frames, so that a frame number is also its index."""
        first = np.repeat(self.starts[:-1], np.diff(self.starts))
        return bool(np.array_equal(self.numbers + first, np.arange(len(first))))

    def owners(self, frames: Ints) -> Ints:
        """Return the index of the trace of each frame."""
        return np.repeat(np.arange(len(self.ids)), np.diff(self.starts))[frames]

    def places(self, frame_ids: Ints) -> Ints:
        """Return the index of each frame id in the group; -1 if it is not there."""
        return places_of(frame_ids, self.frame_ids, self.ids, self.starts)

    def table(self, buckets: Ints, keys: Keys, masks: Ints) -> TimedRelation:
        """Return a table of matches from rows in any order: bucket (60 frames), node ids, frame mask."""
        traces = buckets >> BUCKET_BITS
        owners = np.searchsorted(self.ids, traces)
        if len(self.ids):
            known = self.ids[np.minimum(owners, len(self.ids) - 1)] == traces
        else:
            known = np.zeros(len(owners), np.bool_)
        if not known.all():
            owners, buckets, keys, masks = (one[known] for one in (owners, buckets, keys, masks))
        order = ordering([owners, *keys.T, buckets])
        keys, buckets = np.column_stack((owners, keys))[order], buckets[order]
        new = _changes(keys)
        fresh = new.copy()
        fresh[1:] |= buckets[1:] != buckets[:-1]
        masks = masks[order]
        if not fresh.all():
            masks = np.bitwise_or.reduceat(masks, np.flatnonzero(fresh))
            keys, buckets, new = keys[fresh], buckets[fresh], new[fresh]
        bits = np.flatnonzero(_bits(masks))
        row, bit = bits >> FRAME_BITS, bits & ((1 << FRAME_BITS) - 1)
        if self._whole:
            frames = (self.starts[keys[:, 0]] + seq_of(buckets << FRAME_BITS))[row] + bit
        else:
            frames = self.places((buckets << FRAME_BITS)[row] + bit)
        before = np.cumsum(np.bitwise_count(masks), dtype=np.int64)
        first = np.flatnonzero(new)
        starts = np.append(0, before)[np.append(first, len(masks))]
        return TimedRelation(keys[first], starts, frames)

    def reader(self, place: int) -> TraceReader:
        """Return the data of one trace of the group."""
        rows = slice(int(self.starts[place]), int(self.starts[place + 1]))
        period = int(self.periods[place])
        clock = Clock(self.ticks[rows], self.runs[rows], period, tolerance_ns(period))
        return TraceReader(
            trace_id=int(self.ids[place]),
            name=self.names[place],
            frame_ids=self.frame_ids[rows],
            numbers=self.numbers[rows],
            times=self.times[rows],
            log_times=self.log_times[rows],
            start=int(self.begins[place]),
            clock=clock,
            relations={name: self.part(one, place) for name, one in self.relations.items()},
        )

    def part(self, relation: TimedRelation, place: int) -> TimedRelation:
        """Return the rows of a table that belong to one trace."""
        low, high = np.searchsorted(relation.keys[:, 0], [place, place + 1]).tolist()
        starts = relation.starts[low : high + 1]
        rows = slice(int(starts[0]), int(starts[-1]))
        return TimedRelation(
            relation.keys[low:high, 1:],
            starts - starts[0],
            relation.frames[rows] - self.starts[place],
            tuple(value[rows] for value in relation.values),
        )


def places_of(wanted: Ints, frame_ids: Ints, traces: Ints, starts: Ints) -> Ints:
    """Return the index of each wanted frame id in a sorted array of frame ids; -1 if it is not there.

    Parameters
    ----------
    wanted : (R,) int64
    frame_ids : (F,) int64
    traces, starts : (T,) int64
        Trace ids, and the first frame of each trace.
    """
    if not len(frame_ids):
        return np.full(len(wanted), -1)
    owners = trace_of(wanted)
    first = np.flatnonzero(np.diff(owners, prepend=-1))
    start = starts[np.minimum(np.searchsorted(traces, owners[first]), len(traces) - 1)]
    found = np.repeat(start, np.diff(first, append=len(wanted))) + seq_of(wanted)
    np.minimum(found, len(frame_ids) - 1, out=found)
    elsewhere = np.flatnonzero(frame_ids[found] != wanted)
    if len(elsewhere):  # of another trace, or of a missing frame
        some = wanted[elsewhere]
        there = np.minimum(np.searchsorted(frame_ids, some), len(frame_ids) - 1)
        found[elsewhere] = np.where(frame_ids[there] == some, there, -1)
    return found


def _bits(masks: Ints) -> NDArray[np.uint8]:
    """Return the bits of 64-bit masks as an array, lowest bit of each mask first."""
    return np.unpackbits(masks.astype("<i8").view(np.uint8), bitorder="little")


def _changes(keys: Keys) -> Bools:
    """Return a mask of the rows that differ from the row before them."""
    found = np.ones(len(keys), np.bool_)
    if len(keys):
        found[1:] = False
    for column in keys.T:
        found[1:] |= column[1:] != column[:-1]
    return found


def codes_of(keys: Keys) -> Ints:
    """Number the rows of a table so that equal rows get the same number. Return one number per row."""
    order = ordering([*keys.T])
    found = np.empty(len(keys), np.int64)
    found[order] = np.cumsum(_changes(keys[order])) - 1
    return found


def ordering(columns: Sequence[Ints]) -> Ints:
    """Return the sort order of table rows by several columns. The first column is the primary key."""
    rows = len(columns[0])
    if not rows:
        return np.zeros(0, np.int64)
    code, size = np.zeros(rows, np.int64), 1
    for column in columns:
        low = int(column.min())
        many = int(column.max()) - low + 1
        size *= many
        if size >= 1 << 62:
            return np.lexsort(columns[::-1])
        if many > 1:
            code *= many
            code += column
            code -= low
    bits = rows.bit_length()
    if size.bit_length() + bits > 62:
        return np.argsort(code, kind="stable")
    code <<= bits  # sorting numbers that include their row index is much faster
    code |= np.arange(rows)
    code.sort()
    code &= (1 << bits) - 1
    return code


def ascending(times: Ints) -> Ints:
    """Return frame times that ascend strictly. Repeated times and backward jumps are moved forward.

    A repeated time becomes a nanosecond later. After a backward jump, all times are shifted by
    :data:`sgstore.model.world.JUMP_NS` after the last one. So the jump is a gap that no time bound spans.
    """
    steps = np.diff(times, prepend=times[:1])
    if np.any(steps < 0):
        times = times + np.cumsum(np.where(steps < 0, JUMP_NS - steps, 0))
    ticks = np.arange(len(times))
    return np.maximum.accumulate(times - ticks) + ticks if len(times) else times
