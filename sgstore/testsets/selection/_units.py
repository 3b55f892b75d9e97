"""Units of a selection (frames, clips or whole traces), with the scene classes that each contains."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from sgstore.errors import ConfigError
from sgstore.model.frame_ids import trace_of
from sgstore.store import MessagePlaces
from sgstore.testsets.coverage import (
    UNKNOWN,
    Combinations,
    check_sequences,
    classed,
    features,
    happenings,
    manoeuvres_named,
    periods_of,
    run_begins,
    sequences_in,
)
from sgstore.testsets.selection._sets import SetFamily, distinct, spread

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.testsets.coverage import ChosenFrames, Classed
    from sgstore.testsets.locks import CasePart


MOST: Final = 150_000_000
"""Largest number of memberships in memory. More raise an error, so that a result is always complete."""

_CELLS: Final = 50_000_000
"""Number of truth values that are processed at once."""


class SelectionUnit(StrEnum):
    """Unit of a selection of test cases: a frame, a clip of some seconds, or a whole trace."""

    frame = "frame"
    clip = "clip"
    trace = "trace"


Measure = Literal["units", "frames", "seconds", "bytes"]
"""Unit in which the cost of a selection is measured."""


@dataclass(frozen=True)
class Budget:
    """Budget of a selection: an amount of time, bytes, frames or units.

    Attributes
    ----------
    most : float
    measure : Measure
    """

    most: float
    measure: Measure

    @classmethod
    def parse(cls, text: str) -> Budget:
        """Return the budget in a text, such as ``600s``, ``2h``, ``5GB``, ``1000frames`` or ``40units``.

        Raises
        ------
        ConfigError
            The text is invalid or zero.
        """
        found = _BUDGET.fullmatch(text)
        if found is None or float(found[1]) <= 0 or found[2].lower() not in _MEASURES:
            raise ConfigError(
                f"not a budget: {text!r}; expected 600s, 10min, 2h, 5GB, 300MiB, 1000frames or 40units"
            )
        factor, measure = _MEASURES[found[2].lower()]
        return cls(float(found[1]) * factor, measure)

    def __str__(self) -> str:
        return f"{self.most:g} {self.measure}"


_BUDGET: Final = re.compile(r"\s*(\d{1,15}(?:\.\d+)?)\s*([A-Za-z]+)\s*")
_MEASURES: Final[dict[str, tuple[float, Measure]]] = {
    "s": (1, "seconds"),
    "min": (60, "seconds"),
    "h": (3600, "seconds"),
    "b": (1, "bytes"),
    **{
        f"{prefix}{ending}": (base ** (power + 1), "bytes")
        for ending, base in (("b", 1000), ("ib", 1024))
        for power, prefix in enumerate("kmgt")
    },
    **dict.fromkeys(("frame", "frames"), (1, "frames")),
    **dict.fromkeys(("unit", "units"), (1, "units")),
}


@dataclass(frozen=True)
class Units:
    """Frames divided into selection units: single frames, clips (which can overlap) or whole traces.

    Attributes
    ----------
    chosen : ChosenFrames
        The frames to select from.
    unit : SelectionUnit
    frame_id : (N,) int64
        The frames of all units, ascending.
    asked : (N,) bool
        True for frames to select from: only these count. Whole traces can have others.
    log_time_ns : (N,) int64
    begin, end : (U,) int64
        Row range of each unit, end excluded; both ascend, and each row is in a unit.
    others : int
        Number of omitted units: those with the same elements as a unit here, and no lower cost.
    """

    chosen: ChosenFrames
    unit: SelectionUnit
    frame_id: Ints
    asked: Bools
    log_time_ns: Ints
    begin: Ints
    end: Ints
    others: int = 0

    def __len__(self) -> int:
        return len(self.begin)

    @property
    def total(self) -> int:
        """Return the number of all units. The bundles of a collection may return only their cheapest units."""
        return len(self) + self.others

    @property
    def overlap(self) -> bool:
        """True if a frame is in several clips."""
        return bool((self.begin[1:] < self.end[:-1]).any())

    @property
    def sizes(self) -> Ints:
        """Return the number of frames in each selection unit (frame, clip or trace), (U,)."""
        return self.end - self.begin

    @property
    def first(self) -> Ints:
        """Return the id of the first frame of each selection unit, (U,)."""
        return self.frame_id[self.begin]

    @property
    def last(self) -> Ints:
        """Return the id of the last frame of each selection unit, (U,)."""
        return self.frame_id[self.end - 1]

    def codes(self, of: Classed) -> Ints:
        """Return the scene class of each frame, (N,). Frames outside the query have no class."""
        place = np.searchsorted(of.frame_id, self.frame_id)
        there = np.append(of.frame_id, -1)[place] == self.frame_id
        return np.where(there, np.append(of.code, UNKNOWN)[place], UNKNOWN)

    def rows_of(self, picked: Ints) -> Ints:
        """Return the indices of all frames in the given clips or traces, ascending and without duplicates."""
        step = np.zeros(len(self.frame_id) + 1, np.int64)
        np.add.at(step, self.begin[picked], 1)
        np.add.at(step, self.end[picked], -1)
        return np.flatnonzero(np.cumsum(step)[:-1])

    def cases(self, picked: Ints, splits: Mapping[int, str] | None = None) -> list[CasePart]:
        """Return selected clips or traces as test cases of a lock, each with its split."""
        found: list[CasePart] = []
        for unit in sorted(picked.tolist()):
            rows = slice(self.begin[unit], self.end[unit])
            found.append(
                (self.frame_id[rows], self.log_time_ns[rows], (splits or {}).get(unit, ""))
            )
        return found

    def members(self) -> Iterator[tuple[Ints, Ints]]:
        """Yield pairs in groups: the index of a clip or trace, and the index of one of its frames."""
        ends = np.cumsum(self.sizes)
        low = 0
        while low < len(self):
            base = int(ends[low] - self.sizes[low])
            high = max(int(np.searchsorted(ends, base + _CELLS // 10, side="right")), low + 1)
            unit, row = spread(self.begin[low:high], self.end[low:high])
            yield low + unit, row
            low = high

    def weights(self, measure: Measure) -> Floats:
        """Return the cost of each frame, (N,): 1, or its duration in seconds, or the bytes of its messages."""
        match measure:
            case "units" | "frames":
                return np.ones(len(self.frame_id))
            case "seconds":
                return periods_of(self.chosen.store, self.frame_id) / 1e9
            case "bytes":
                found = np.zeros(len(self.frame_id))
                for frame_id, length in MessagePlaces.lengths(
                    self.chosen.store.file, self.frame_id
                ):
                    np.add.at(found, np.searchsorted(self.frame_id, frame_id), length)
                return found

    def costs(self, measure: Measure) -> Floats:
        """Return the cost of each clip or trace, (U,). A frame in several clips counts in each."""
        if measure == "units":
            return np.ones(len(self))
        return self.summed(self.weights(measure), measure)

    def summed(self, weights: Floats, measure: Measure) -> Floats:
        """For each clip or trace, return the total weight of its frames, (U,). It is always positive."""
        if not len(self):
            return np.zeros(0)
        ranges = np.stack([self.begin, self.end], axis=1).ravel()
        found = np.add.reduceat(np.append(weights, 0.0), ranges)[::2]
        # A trace of one frame has no period, and a frame may have no messages.
        return np.maximum(found, 1e-3 if measure == "seconds" else 1.0)

    def together(self, picked: Ints, measure: Measure) -> float:
        """Return the total cost of some clips or traces. A frame in several clips counts once."""
        if measure == "units":
            return float(len(picked))
        if not self.overlap:
            return float(self.costs(measure)[picked].sum())
        return float(self.weights(measure)[self.rows_of(picked)].sum())

    def ranks(self, seed: int) -> Ints:
        """Return a random rank for each clip or trace, (U,). Stores with the same traces have equal ranks."""
        mixed = _mixed(self.first.astype(np.uint64) + np.uint64(seed * int(_STEP) % (1 << 64)))
        order = np.lexsort((self.first, mixed))
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        return rank


_STEP: Final = np.uint64(0x9E3779B97F4A7C15)


def _mixed(
    words: np.ndarray[tuple[int], np.dtype[np.uint64]],
) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    """Return pseudo-random numbers computed from 64-bit words by SplitMix64 (Steele, Lea, Flood, 2014)."""
    words = words + _STEP
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return words ^ (words >> np.uint64(31))


def units_of(
    chosen: ChosenFrames, unit: SelectionUnit, clip_s: float = 2.0, stride_s: float | None = None
) -> Units:
    """Return frames divided into selection units: single frames, clips or traces.

    A clip is a part of a run of consecutive frames, of a given length. The first clip begins with
    the run, the others follow at the stride, until one reaches the end of the run; the last one may
    be shorter. A step in time of more than 2.5 median periods ends a run. A trace is taken
    completely if one of its frames is selected from.

    Parameters
    ----------
    chosen : ChosenFrames
    unit : SelectionUnit
    clip_s : float
        Length of clips; s.
    stride_s : float, optional
        Time from the start of one clip to the start of the next; s. Clips overlap if it is below
        their length. By default the length.

    Raises
    ------
    ConfigError
        The length of clips is not positive, or frames would be between clips.
    """
    stride_s = clip_s if stride_s is None else stride_s
    if not clip_s > 0:
        raise ConfigError(f"clips of {clip_s:g} s; expected a time above zero, such as 2s")
    if not 0 < stride_s <= clip_s:
        raise ConfigError(
            f"clips of {clip_s:g} s that begin every {stride_s:g} s: expected a time above zero, and no longer"
            " than a clip, so that every frame is in one"
        )
    found = chosen.store.file.arrays(
        "SELECT frame_id, time_ns, log_time_ns FROM frames ORDER BY frame_id"
    )
    frame_id, time_ns, log_time_ns = (column.astype(np.int64) for column in found.values())
    rows = chosen.rows_of(frame_id)
    asked = np.zeros(len(frame_id), np.bool_)
    asked[rows] = True
    if unit is SelectionUnit.trace:
        rows = np.flatnonzero(np.isin(trace_of(frame_id), trace_of(frame_id[rows])))
    each = np.arange(len(rows))
    own = Units(chosen, unit, frame_id[rows], asked[rows], log_time_ns[rows], each, each + 1)
    if unit is SelectionUnit.frame or not len(rows):
        return own
    if unit is SelectionUnit.clip:
        begin, end = _clips(own, time_ns[rows], clip_s, stride_s)
    else:
        begin, end = _ranges(np.append(True, np.diff(trace_of(own.frame_id)) != 0))
    return replace(own, begin=begin, end=end)


def _ranges(fresh: Bools) -> tuple[Ints, Ints]:
    begin = np.flatnonzero(fresh)
    return begin, np.append(begin[1:], len(fresh))


def _clips(frames: Units, time_ns: Ints, clip_s: float, stride_s: float) -> tuple[Ints, Ints]:
    """Return two indices for each clip: its first frame, and the frame after its last one."""
    period = periods_of(frames.chosen.store, frames.frame_id)
    fresh = run_begins(frames.chosen.store, frames.frame_id, time_ns)
    starts, ends = _ranges(fresh)
    run = np.cumsum(fresh) - 1
    # Frames are at approximate multiples of the period: a slightly early frame belongs to the next
    # clip.
    since = time_ns - time_ns[starts][run] + (period * 0.25).astype(np.int64)
    length, stride = max(round(clip_s * 1e9), 1), max(round(stride_s * 1e9), 1)
    part = since // stride
    fresh[1:] |= part[1:] != part[:-1]
    begin = np.flatnonzero(fresh)
    # Runs are laid in sequence on one time axis, so far apart that no clip reaches the next run.
    far = np.cumsum(since[ends - 1] + 2 * length) - since[ends - 1]
    end = np.searchsorted(since + far[run], far[run[begin]] + part[begin] * stride + length)
    reaches = end == ends[run[begin]]
    kept = ~reaches | np.append(True, ~reaches[:-1] | (run[begin][1:] != run[begin][:-1]))
    return begin[kept], end[kept].astype(np.int64)


@dataclass(frozen=True)
class Holdings:
    """Elements of each selection unit: its scene classes, feature combinations or manoeuvre sequences.

    Attributes
    ----------
    classed : Classed or None
        The frames with their classes; ``None`` with sequences, and for elements from bundles.
    pairs : (2, M) int64
        Units with their elements; each pair once, in order.
    weight : (E,) int64
        Number of combinations that an element represents: combinations with equal frames are
        merged.
    frames : (E,) int64
        Number of frames with each element, of those to select from.
    kind : str
        Description of the elements.
    has : (C, E) bool or None
        Elements of the occurring classes; ``None`` if the classes are the elements.
    """

    classed: Classed | None
    pairs: Ints
    weight: Ints
    frames: Ints
    kind: str
    has: Bools | None = None

    @property
    def total(self) -> int:
        """Return the number of scene classes, feature combinations or manoeuvre sequences."""
        return int(self.weight.sum())

    def family(self, units: Units, cost: Floats, need: int, rank: Ints) -> SetFamily:
        """Return a set family for set covers: each clip or trace is the set of its scene classes."""
        found = SetFamily.of(self.pairs, len(units), len(self.frames), cost, need, rank)
        return replace(found, weight=self.weight)

    def joined(self, other: Holdings) -> Holdings:
        """Return the elements of this object and another one, so that a selection covers both."""
        pairs = np.concatenate(
            [self.pairs, other.pairs + np.array([[0], [len(self.weight)]])], axis=1
        )
        return Holdings(
            None,
            pairs[:, np.lexsort(pairs[::-1])],
            np.concatenate([self.weight, other.weight]),
            np.concatenate([self.frames, other.frames]),
            f"{self.kind} and {other.kind}",
        )

    def over(self, units: Units) -> Holdings:
        """Return the same kind of elements for other clips, which have the same frames.

        Raises
        ------
        ConfigError
            The elements are sequences, which a clip can have without any of its parts.
        """
        if self.classed is None:
            raise ConfigError(
                "clips that overlap are chosen for sequences by their number alone: leave out --stride, or"
                " --objective and a budget of time, frames or bytes"
            )
        pairs = classes_of(units, self.classed)
        return replace(self, pairs=pairs if self.has is None else _of_units(pairs, self.has))


def holdings(units: Units, abstraction: str, combos: int = 0, *, of_ego: bool = False) -> Holdings:
    """For each clip or trace, return its scene classes, or its combinations of k features.

    Parameters
    ----------
    units : Units
    abstraction : str
    combos : int
        0: classes; k: combinations of k features.
    of_ego : bool
        True if only features of the ego, and of lanes relative to it, count.

    Raises
    ------
    AbstractionError
        The abstraction is unknown.
    ConfigError
        There are too many combinations.
    """
    of = classed(units.chosen, abstraction)
    pairs = classes_of(units, of)
    if not combos:
        sizes = of.sizes()[of.present()]
        return Holdings(of, pairs, np.ones_like(sizes), sizes, kind_of(abstraction))
    found = Combinations.of(features(of, abstraction, of_ego=of_ego), combos)
    inside, weight, frames = _distinct_combinations(found)
    kind = f"combinations of {combos} features{' of the ego' if of_ego else ''} in {abstraction}"
    return Holdings(of, _of_units(pairs, inside), weight, frames, kind, inside)


def kind_of(abstraction: str) -> str:
    """Return a name for the scene classes of an abstraction, for messages."""
    return f"classes in {abstraction}"


def sequence_holdings(units: Units, k: int, names: Sequence[str], within_s: float) -> Holdings:
    """For each clip or trace, return the sequences of k manoeuvres in it.

    Parameters
    ----------
    units : Units
    k : int
    names : sequence of str
        Manoeuvres, as in :func:`sgstore.testsets.coverage.manoeuvres_named`.
    within_s : float
        Greatest time from the first to the last; s.

    Raises
    ------
    ConfigError
        There are too many sequences.
    QueryError
        A manoeuvre is not a valid pattern.
    """
    happened = happenings(units.chosen, manoeuvres_named(names))
    check_sequences(len(happened.names), k)
    row = np.searchsorted(units.frame_id, happened.frame_id)
    number: dict[int, int] = {}
    parts = [np.zeros((2, 0), np.int64)]
    ends = zip(units.begin.tolist(), units.end.tolist(), strict=True)
    for unit, (begin, end) in enumerate(ends):
        low, high = np.searchsorted(row, [begin, end]).tolist()
        of, time = happened.code[low:high], happened.time_ns[low:high]
        found = sequences_in(of, time, len(happened.names), k, round(within_s * 1e9))
        held = sorted(number.setdefault(one, len(number)) for one in found)
        parts.append(np.stack([np.full(len(held), unit), np.array(held, np.int64)]))
    pairs = np.concatenate(parts, axis=1)
    often = np.bincount(pairs[1], minlength=len(number)).astype(np.int64)
    kind = f"sequences of {k} manoeuvres within {within_s:g} s" if k > 1 else "manoeuvres"
    return Holdings(None, pairs, np.ones_like(often), often, kind)


def classes_of(units: Units, of: Classed) -> Ints:
    """Return pairs (2, M): a clip or trace, and a scene class in it."""
    present = of.present()
    number = np.full(len(of.names) + 1, UNKNOWN)
    number[present] = np.arange(len(present))
    code = number[units.codes(of)]
    held = 0
    parts: list[Ints] = []
    for unit, row in units.members():
        known = code[row] != UNKNOWN
        key = distinct(unit[known] * max(len(present), 1) + code[row[known]])
        parts.append(np.stack(np.divmod(key, max(len(present), 1))))
        held += len(key)
        if held > MOST:
            raise ConfigError(f"more than {MOST:,} classes in units: ask for a longer stride")
    return np.concatenate(parts, axis=1) if parts else np.zeros((2, 0), np.int64)


def _distinct_combinations(found: Combinations) -> tuple[Bools, Ints, Ints]:
    """Return which scene classes have each feature combination. Combinations in the same frames are merged.

    Also return the multiplicity and the number of frames of each.
    """
    has = found.features.there
    there = np.flatnonzero(found.frames)
    number: dict[bytes, int] = {}
    weight: list[int] = []
    frames: list[int] = []
    step = max(_CELLS // max(len(has), 1), 1)
    for low in range(0, len(there), step):
        part = there[low : low + step]
        inside = np.ones((len(has), len(part)), np.bool_)
        for column in found.members[part].T:
            inside &= has[:, column]
        for row, many in zip(
            np.packbits(inside, axis=0).T, found.frames[part].tolist(), strict=True
        ):
            place = number.setdefault(row.tobytes(), len(number))
            if place == len(weight):
                weight.append(0)
                frames.append(many)
            weight[place] += 1
    if len(number) * len(has) > 40 * _CELLS:
        raise ConfigError(
            f"{len(number):,} combinations in {len(has):,} classes: too many to go through; ask for"
            " a smaller k, or for an abstraction with fewer labels"
        )
    rows = np.frombuffer(b"".join(number), np.uint8).reshape(len(number), -1)
    inside = np.unpackbits(rows, axis=1, count=len(has)).T.astype(np.bool_)
    return inside, np.array(weight, np.int64), np.array(frames, np.int64)


def _of_units(pairs: Ints, has: Bools) -> Ints:
    """Convert pairs (clip, scene class) to pairs (clip, feature combination)."""
    held = 0
    parts: list[Ints] = []
    unit, row = pairs
    step = max(_CELLS // max(has.shape[1], 1), 1)
    for low, high in _whole_units(unit, step):
        first = np.flatnonzero(np.append(True, np.diff(unit[low:high]) != 0))
        which, element = np.nonzero(np.logical_or.reduceat(has[row[low:high]], first, axis=0))
        held += len(which)
        if held > MOST:
            raise ConfigError(
                f"more than {MOST:,} combinations in units: ask for a smaller k, for longer clips, or for an"
                " abstraction with fewer labels"
            )
        parts.append(np.stack([unit[low:high][first][which], element]))
    return np.concatenate(parts, axis=1) if parts else np.zeros((2, 0), np.int64)


def _whole_units(unit: Ints, step: int) -> Iterator[tuple[int, int]]:
    """Yield ranges of about ``step`` rows. A range never ends inside a clip or trace."""
    low = 0
    while low < len(unit):
        high = int(np.searchsorted(unit, unit[min(low + step, len(unit)) - 1], side="right"))
        yield low, high
        low = high


def kept(pairs: Ints, weight: Ints, picked: Ints, units: int) -> Ints:
    """For each n, return the number of scene classes (or combinations) in the first n selected clips."""
    place = np.full(units, -1)
    place[picked] = np.arange(len(picked))
    rows = place[pairs[0]] >= 0
    elements, where = pairs[1][rows], place[pairs[0][rows]]
    order = np.lexsort((where, elements))
    first = order[np.unique(elements[order], return_index=True)[1]]
    gained = np.bincount(where[first], weight[elements[first]], minlength=len(picked))
    return np.cumsum(gained).astype(np.int64)
