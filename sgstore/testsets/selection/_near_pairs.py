"""Worst measures between the ego and other entities in each frame, without computing all pairs.

Distances and velocities give a lower bound for a measure of a pair. The pair with the least bound of a frame is
measured first. Then only pairs with a bound up to its value can have a lower value. The values are those of the
view ``world_criticality``: the same expressions, with cosines and sines of the database.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.model.frame_ids import SEQ_BITS
from sgstore.model.pair_numbers import MARKS, UNEVEN, PairNumbers, low_and_high_sql
from sgstore.testsets.selection._situations import MET

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.store import StoreFile

    Columns = dict[str, Floats]

BOUNDED: Final = frozenset({"closing_time", "ttc_mild"})
"""Measures with a lower bound. Low values are worse."""

FRAMES: Final = 1 << 14
"""Frames whose entities are in memory together."""

_GROWTH: Final = np.sqrt(8.0)
"""Two boxes that accelerate by 2 m/s² along and across come nearer by this times the square of the time; m."""

_SLACK: Final = 1 - 1e-9
"""Factor of a bound that covers rounding."""

_NODE_BITS: Final = 32

_TOGETHER: Final = 1 << 14
"""Pairs that are bounded together: few enough for the caches of a processor."""

_UNEVEN: Final = f"""
  SELECT trace_id FROM inside.trace
  WHERE coalesce(uneven & {UNEVEN["near_flat"] | UNEVEN["near_storeys"] | UNEVEN["carried"]} <> 0, true)
"""  # noqa: S608  numbers of ours

_HEIGHTS: Final = low_and_high_sql(lambda name: name if name == "kind" else f"{name}::DOUBLE")
_COLUMNS: Final = {
    **{name: name for name in ("x", "y", "vx", "vy", "length", "width")},
    "cos": "cos(heading::DOUBLE)",
    "sin": "sin(heading::DOUBLE)",
}
_OF_MARKS: Final = {**_HEIGHTS, "pitch": "pitch", "carrier": "carrier"}
"""Columns for the marks of pairs: other storeys, carriers, flat bodies."""


def _states(columns: Mapping[str, str], more: str = "") -> str:
    listed = ", ".join(f"{sql} AS {name}" for name, sql in columns.items())
    return f"""
      SELECT frame_id, is_ego, node_id, {listed} FROM inside.known_state
      WHERE (is_ego OR kind {MET}) {more}
    """  # noqa: S608  names of ours


_STATES: Final = _states(_COLUMNS)
_MARKED: Final = _states(
    {"x": "x", "y": "y", **_OF_MARKS}, f"AND frame_id >> {SEQ_BITS} IN ({_UNEVEN})"
)


def worst_in_frames(
    file: StoreFile, frames: Ints, measures: Sequence[str]
) -> tuple[Floats, Ints, Ints]:
    """For each frame, return the lowest values of measures, their entities, and the number of unknown gaps.

    Parameters
    ----------
    file : StoreFile
    frames : (F,) int64
        Ascending frame ids.
    measures : sequence of str
        Of :data:`BOUNDED`.

    Returns
    -------
    values : (M, F) float64
        inf without a known value.
    others : (M, F) int64
        Node ids; -1 without a known value. Of equal values, the smallest node id counts.
    blind : (F,) int64
    """
    pairs, count = _EgoPairs.read(file, frames), len(frames)
    lowest = np.full((len(measures), len(pairs)), np.inf)
    unknown = np.zeros(len(pairs), np.bool_)
    for start in range(0, len(pairs), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        lowest[:, part], unknown[part] = _bounds(pairs.numbers(part), measures)
    blind = np.bincount(pairs.frame[unknown], minlength=count)
    first = np.unique(np.concatenate([_first(pairs.frame, bound, count) for bound in lowest]))
    left = np.zeros(len(pairs), np.bool_)
    for bound, value in zip(lowest, _values(pairs, first, measures), strict=True):
        most = _least(pairs.frame[first], value, count)
        left |= (bound <= most[pairs.frame]) & (bound < np.inf)
    rows = np.flatnonzero(left)
    frame, node = pairs.frame[rows], pairs.node[rows]
    values = _values(pairs, rows, measures)
    least = np.stack([_least(frame, value, count) for value in values])
    who = np.full(least.shape, -1)
    for i, value in enumerate(values):
        equal = np.flatnonzero((value == least[i, frame]) & (value < np.inf))
        equal = equal[np.argsort(-node[equal], kind="stable")]
        who[i, frame[equal]] = node[equal]
    return least, who, blind


@dataclass(frozen=True, slots=True)
class _EgoPairs:
    """Pairs of the ego and an entity that it could meet, in some frames; arrays of shape (K,).

    Attributes
    ----------
    frame, node : int64
        Index of the frame, and node id of the other entity.
    sides : two of int64
        Rows of the ego and of the other entity in ``columns``.
    columns : dict of str to (S,) float64
        Columns of all entities. NaN for a missing value.
    marks : dict of str to float64
        NaN for pairs without numbers, such as those on different storeys; else 0.
    """

    frame: Ints
    node: Ints
    sides: tuple[Ints, Ints]
    columns: Columns
    marks: Columns

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def read(cls, file: StoreFile, frames: Ints) -> _EgoPairs:
        """Read the pairs of frames with ascending ids. Marks are computed only in traces with special pairs."""
        pairs = cls._read(file, frames, _STATES)
        uneven = cls._read(file, frames, _MARKED)
        if len(uneven):
            keys, marked = ((one.frame << _NODE_BITS) + one.node for one in (pairs, uneven))
            order = np.argsort(keys)
            rows = order[np.searchsorted(keys, marked, sorter=order)]
            numbers = PairNumbers.of(*uneven.sided(slice(None)))
            for name, values in pairs.marks.items():
                values[rows] = numbers[name]
        return pairs

    @classmethod
    def _read(cls, file: StoreFile, frames: Ints, sql: str) -> _EgoPairs:
        found = file.arrays(
            f"{sql} AND frame_id BETWEEN ? AND ?", [int(frames[0]), int(frames[-1])], plain=True
        )
        keys = (np.ma.getdata(found.pop(name)) for name in ("frame_id", "node_id", "is_ego"))
        ids, node, is_ego = (one.astype(of) for one, of in zip(keys, "qq?", strict=True))
        place = np.minimum(np.searchsorted(frames, ids), len(frames) - 1)
        here = frames[place] == ids
        ego = np.full(len(frames), -1)
        ego[place[is_ego & here]] = np.flatnonzero(is_ego & here)
        other = np.flatnonzero(here & ~is_ego & (ego[place] >= 0))
        columns = {
            name: np.ma.filled(np.ma.asarray(values, np.float64), np.nan)
            for name, values in found.items()
        }
        columns["node_id"] = node.astype(np.float64)
        marks = {name: np.zeros(len(other)) for name in MARKS}
        return cls(place[other], node[other], (ego[place[other]], other), columns, marks)

    def sided(self, rows: Ints | slice) -> list[Columns]:
        """Return two tables for some pairs: the columns of the ego, and those of the other entity."""
        return [
            {name: values[side[rows]] for name, values in self.columns.items()}
            for side in self.sides
        ]

    def numbers(self, rows: Ints | slice) -> PairNumbers:
        """Compute quantities of some pairs, such as closing speed, for the measures."""
        found = PairNumbers.of(*self.sided(rows))
        found |= {name: values[rows] for name, values in self.marks.items()}
        for one in "ab":
            found |= {f"c{one}": found[f"{one}_cos"], f"s{one}": found[f"{one}_sin"]}
        return found


def _bounds(pairs: PairNumbers, measures: Sequence[str]) -> tuple[list[Floats], Bools]:
    """Return lower bounds for the measures of pairs, and a mask of the pairs whose gap is unknown."""
    apart = np.maximum(pairs["at_least"], 0) * _SLACK
    unknown = np.isnan(apart + pairs["ca"] + pairs["cb"])
    closing = np.nan_to_num(pairs["closing_speed"])
    approach = pairs["approach"]
    with np.errstate(all="ignore"):
        root = np.sqrt(closing * closing + 4 * _GROWTH * apart)
        mild = np.where(closing > 0, 2 * apart / (closing + root), (root - closing) / (2 * _GROWTH))
        known = {
            "closing_time": np.where(approach >= 1e-6, apart / approach, np.inf),
            "ttc_mild": np.where(apart > 0, mild, 0),
        }
    return [np.where(unknown, np.inf, known[name] * _SLACK) for name in measures], unknown


def _least(frame: Ints, values: Floats, count: int) -> Floats:
    """Return the lowest value in each frame; infinite for a frame without values."""
    least = np.full(count, np.inf)
    np.minimum.at(least, frame, values)
    return least


def _first(frame: Ints, bound: Floats, count: int) -> Ints:
    """For each frame, return the row with the lowest bound. Frames without a finite bound are left out."""
    rows = np.flatnonzero((bound == _least(frame, bound, count)[frame]) & (bound < np.inf))
    first = np.full(count, -1)
    first[frame[rows]] = rows
    return first[first >= 0]


def _values(pairs: _EgoPairs, rows: Ints, measures: Sequence[str]) -> Floats:
    """Return M measures of R pairs, (M, R); infinite for an unknown value."""
    found = np.full((len(measures), len(rows)), np.inf)
    for start in range(0, len(rows), _TOGETHER):
        numbers = pairs.numbers(rows[start : start + _TOGETHER])
        for values, name in zip(found, measures, strict=True):
            known = numbers[name]
            values[start : start + _TOGETHER] = np.where(np.isnan(known), np.inf, known)
    return found
