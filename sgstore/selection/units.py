"""What is selected: frames, clips or whole traces; and what each of them holds."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.coverage import classed
from sgstore.coverage.asking import is_of_ego
from sgstore.coverage.classed import GAP, UNKNOWN
from sgstore.coverage.features import combined, features
from sgstore.errors import ConfigError
from sgstore.selection.cover import Family
from sgstore.store.contents import lengths_of_messages
from sgstore.store.covering import seq_of, trace_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.coverage import Chosen, Classed
    from sgstore.coverage.features import Combinations
    from sgstore.world import Bools, Floats, Ints

MOST: Final = 150_000_000
"""Most memberships of elements in units that are held at once: more are an error, not a part of the answer."""

_CELLS: Final = 50_000_000
"""Truth values that are looked at together."""


class Piece(StrEnum):
    """What is chosen or not: a frame, consecutive frames of some seconds, a whole trace."""

    frame = "frame"
    clip = "clip"
    trace = "trace"


class Measure(StrEnum):
    """What a selection costs."""

    units = "units"
    frames = "frames"
    seconds = "seconds"
    bytes = "bytes"


@dataclass(frozen=True)
class Budget:
    """How much may be selected.

    Attributes
    ----------
    most : float
    measure : Measure
    """

    most: float
    measure: Measure

    @classmethod
    def parse(cls, text: str) -> Budget:
        """``600s``, ``10min``, ``2h``, ``5GB``, ``300MiB``, ``1000frames``, ``40units`` as a budget.

        Raises
        ------
        ConfigError
            It is none of these, or nothing at all.
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
_BYTES: Final = {
    f"{prefix}{ending}": (base ** (power + 1), Measure.bytes)
    for ending, base in (("b", 1000), ("ib", 1024))
    for power, prefix in enumerate("kmgt")
}
_MEASURES: Final[dict[str, tuple[float, Measure]]] = {
    "s": (1, Measure.seconds),
    "min": (60, Measure.seconds),
    "h": (3600, Measure.seconds),
    "b": (1, Measure.bytes),
    **_BYTES,
    **{
        name: (1, measure)
        for measure in (Measure.frames, Measure.units)
        for name in (measure.value, measure.value[:-1])
    },
}


@dataclass(frozen=True)
class Units:
    """Frames in units.

    Attributes
    ----------
    chosen : Chosen
        The frames that were asked for.
    piece : Piece
    frame_id : (N,) int64
        The frames of all units, ascending.
    asked : (N,) bool
        Whether a frame is one that was asked for: only these count. Others are in whole traces.
    number : (N,) int64
        The unit of each frame, 0 … U - 1, ascending.
    log_time_ns : (N,) int64
    """

    chosen: Chosen
    piece: Piece
    frame_id: Ints
    asked: Bools
    number: Ints
    log_time_ns: Ints

    def __len__(self) -> int:
        return int(self.number[-1]) + 1 if len(self.number) else 0

    @property
    def starts(self) -> Ints:
        """(U + 1,): where the frames of each unit begin."""
        return np.searchsorted(self.number, np.arange(len(self) + 1))

    @property
    def first(self) -> Ints:
        """(U,): ids of the first frames of the units."""
        return self.frame_id[self.starts[:-1]]

    @property
    def last(self) -> Ints:
        """(U,): ids of their last frames."""
        return self.frame_id[self.starts[1:] - 1]

    def costs(self, measure: Measure) -> Floats:
        """(U,): what each unit costs; a frame lasts the median period of its trace."""
        match measure:
            case Measure.units:
                return np.ones(len(self))
            case Measure.frames:
                return np.diff(self.starts).astype(np.float64)
            case Measure.seconds:
                periods = {one.trace_id: one.period_ns for one in self.chosen.store.info()}
                traces, number = np.unique(trace_of(self.frame_id), return_inverse=True)
                period = np.array([periods[one] for one in traces.tolist()], np.float64) / 1e9
                # A trace of one frame has no period; it must not be free.
                return np.maximum(np.bincount(self.number, period[number], len(self)), 1e-3)
            case Measure.bytes:
                found = np.zeros(len(self))
                for frame_id, length in lengths_of_messages(self.chosen.store.file, self.frame_id):
                    rows = np.searchsorted(self.frame_id, frame_id)
                    np.add.at(found, self.number[rows], length)
                return np.maximum(found, 1.0)

    def ranks(self, seed: int) -> Ints:
        """(U,): an order of the units at random, the same in every store that has the same traces."""
        mixed = _mixed(self.first.astype(np.uint64) + np.uint64(seed * int(_STEP) % (1 << 64)))
        order = np.lexsort((self.first, mixed))
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        return rank


_STEP: Final = np.uint64(0x9E3779B97F4A7C15)


def _mixed(
    words: np.ndarray[tuple[int], np.dtype[np.uint64]],
) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    """SplitMix64 (Steele, Lea, Flood, 2014)."""
    words = words + _STEP
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return words ^ (words >> np.uint64(31))


def units_of(chosen: Chosen, piece: Piece, clip_s: float = 2.0) -> Units:
    """The units of some frames.

    A clip is a part of a run of consecutive frames that were asked for, of a given time: a run is cut from its
    beginning, and its last clip may be shorter. A step in time of more than 2.5 median periods ends a run. A
    trace is taken whole if one of its frames was asked for.

    Parameters
    ----------
    chosen : Chosen
    piece : Piece
    clip_s : float
        Length of clips; s.

    Raises
    ------
    ConfigError
        Clips would have no length.
    """
    if not clip_s > 0:
        raise ConfigError(f"clips of {clip_s:g} s; expected a time above zero, such as 2s")
    found = chosen.store.file.arrays(
        "SELECT frame_id, time_ns, log_time_ns FROM frames ORDER BY frame_id"
    )
    frame_id, time_ns, log_time_ns = (column.astype(np.int64) for column in found.values())
    rows = chosen.rows_of(frame_id)
    asked = np.zeros(len(frame_id), np.bool_)
    asked[rows] = True
    if piece is Piece.trace:
        rows = np.flatnonzero(np.isin(trace_of(frame_id), trace_of(frame_id[rows])))
    own = Units(chosen, piece, frame_id[rows], asked[rows], np.arange(len(rows)), log_time_ns[rows])
    if piece is Piece.frame or not len(rows):
        return own
    trace = trace_of(own.frame_id)
    fresh = np.ones(len(rows), np.bool_)
    fresh[1:] = trace[1:] != trace[:-1]
    if piece is Piece.clip:
        fresh = _clips(own, time_ns[rows], fresh, clip_s)
    return replace(own, number=np.cumsum(fresh) - 1)


def _clips(units: Units, time_ns: Ints, fresh: Bools, clip_s: float) -> Bools:
    """Which frames begin a clip."""
    periods = {one.trace_id: one.period_ns for one in units.chosen.store.info()}
    traces, number = np.unique(trace_of(units.frame_id), return_inverse=True)
    period = np.array([periods[one] for one in traces.tolist()], np.float64)[number]
    seq = seq_of(units.frame_id)
    step = np.diff(time_ns, prepend=time_ns[:1])
    fresh = fresh.copy()
    fresh[1:] |= (seq[1:] != seq[:-1] + 1) | (step[1:] > GAP * period[1:]) | (step[1:] < 0)
    starts = np.flatnonzero(fresh)
    since = time_ns - np.repeat(time_ns[starts], np.diff(np.append(starts, len(time_ns))))
    # Frames stand at whole periods, more or less: what is a hair early belongs to the next clip.
    length = round(clip_s * 1e9)
    part = (since + (period * 0.25).astype(np.int64)) // length
    fresh[1:] |= part[1:] != part[:-1]
    return fresh


@dataclass(frozen=True)
class Holdings:
    """What units hold: classes, or combinations of features.

    Attributes
    ----------
    classed : Classed
        The frames with their classes.
    pairs : (2, M) int64
        Units, and the elements that each holds; each pair once, in order.
    weight : (E,) int64
        How many combinations an element stands for: those that are in the same frames are one.
    frames : (E,) int64
        Frames that were asked for with each.
    kind : str
        What the elements are.
    """

    classed: Classed
    pairs: Ints
    weight: Ints
    frames: Ints
    kind: str

    @property
    def total(self) -> int:
        """How many classes or combinations there are."""
        return int(self.weight.sum())

    def family(self, units: Units, cost: Floats, need: int, rank: Ints) -> Family:
        """The units as sets of their elements."""
        found = Family.of(self.pairs, len(units), len(self.frames), cost, need, rank)
        return replace(found, weight=self.weight)


def holdings(units: Units, abstraction: str, combos: int = 0, *, of_ego: bool = False) -> Holdings:
    """What units hold: their classes, or the combinations of so many features that occur in their frames.

    Parameters
    ----------
    units : Units
    abstraction : str
    combos : int
        0: classes.
    of_ego : bool
        Whether only features count that speak of the ego, or of a lane by how it lies to the ego.

    Raises
    ------
    AbstractionError
        There is no such abstraction.
    ConfigError
        There are more combinations, or combinations in units, than can be gone through.
    """
    of = classed(units.chosen, abstraction)
    rows = np.searchsorted(units.frame_id, of.frame_id)
    known = of.code != UNKNOWN
    present = of.present()
    number = np.full(len(of.names) + 1, UNKNOWN)
    number[present] = np.arange(len(present))
    pairs = _distinct(units.number[rows[known]], number[of.code[known]], len(present))
    if not combos:
        weight = np.ones(len(present), np.int64)
        return Holdings(of, pairs, weight, of.sizes()[present], f"classes in {abstraction}")
    own = features(of, abstraction)
    if of_ego:
        keep = [i for i, name in enumerate(own.names) if is_of_ego(name)]
        names = tuple(own.names[i] for i in keep)
        own = replace(own, names=names, counts=own.counts[:, keep])
    found = combined(own, combos)
    inside, weight, frames = _distinct_combinations(found)
    kind = f"combinations of {combos} features{' of the ego' if of_ego else ''} in {abstraction}"
    return Holdings(of, _of_units(pairs, inside), weight, frames, kind)


def _distinct(unit: Ints, element: Ints, elements: int) -> Ints:
    key = np.unique(unit * max(elements, 1) + element)
    return np.stack(np.divmod(key, max(elements, 1)))


def _distinct_combinations(found: Combinations) -> tuple[Bools, Ints, Ints]:
    """Combinations by the classes that have them: (classes, E), how many are alike, and frames of each."""
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
    """Units and their elements, of units and their classes, and of classes and their elements."""
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
    """Ranges of rows that end where a unit ends, about ``step`` long."""
    low = 0
    while low < len(unit):
        high = int(np.searchsorted(unit, unit[min(low + step, len(unit)) - 1], side="right"))
        yield low, high
        low = high


def kept(pairs: Ints, weight: Ints, picked: Ints, units: int) -> Ints:
    """How many elements are kept after each of some units."""
    place = np.full(units, -1)
    place[picked] = np.arange(len(picked))
    rows = place[pairs[0]] >= 0
    elements, where = pairs[1][rows], place[pairs[0][rows]]
    order = np.lexsort((where, elements))
    first = order[np.unique(elements[order], return_index=True)[1]]
    gained = np.bincount(where[first], weight[elements[first]], minlength=len(picked))
    return np.cumsum(gained).astype(np.int64)
