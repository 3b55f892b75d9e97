"""Evaluation of temporal formulas and values over time on whole traces, as arrays.

A column has a truth value for each frame; operators map columns to columns. An *until* compares two frames: the
next frame in its bound at which its right side holds, and the next frame at which its left side fails.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.temporal._formula import (
    TRUE,
    And,
    Bound,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    TruthConstant,
    Until,
    propositions,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Ints

    Places = NDArray[np.int32 | np.int64]
    Array = NDArray[Any]


def evaluate(formula: Formula, columns: Mapping[str, Bools], times: Ints) -> Bools:
    """Return the truth value of a temporal formula at each frame of a trace, (F,).

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (F,) bool
        Truth values of the propositions.
    times : (F,) int64
        Timestamps of the frames, ascending; ns.

    Returns
    -------
    (F,) bool
        Value of the formula at each frame.

    Raises
    ------
    ValueError
        A proposition is missing, columns have different lengths, or times do not ascend.
    """
    missing = sorted(propositions(formula) - set(columns))
    if missing:
        raise ValueError(f"no column for the proposition {missing[0]!r}")
    for name in propositions(formula):
        if columns[name].shape != times.shape:
            raise ValueError(f"{name} has shape {columns[name].shape}, expected {times.shape}")
    if np.any(np.diff(times) <= 0):
        raise ValueError("the times of the frames must ascend")
    if not len(times):
        return np.zeros(0, np.bool_)
    return PropositionTable(columns, times).whole(formula)


def evaluate_rows(formula: Formula, columns: Mapping[str, Bools], times: Ints, rows: int) -> Bools:
    """Return the truth value of a temporal formula for each node combination and frame, (B, F).

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (B, F) bool, or (1, F)
        Propositions of each binding; (1, F) if equal for all bindings.
    times : (F,) int64
        Times as in :func:`evaluate`; F is at least 1.
    rows : int
        B, the number of bindings.

    Returns
    -------
    (B, F) bool
    """
    found = PropositionTable(columns, times).value(formula)
    return np.broadcast_to(found, (rows, len(times)))


@dataclass(frozen=True, slots=True)
class PropositionTable:
    """Truth values of temporal formulas in one trace, computed from single-frame conditions.

    Parameters
    ----------
    columns : mapping of str to (F,) bool, or (B, F), or (1, F)
    times : (F,) int64
        Ascending; ns.
    """

    columns: Mapping[str, Bools]
    times: Ints

    def whole(self, formula: Formula) -> Bools:
        """Return the truth value (F,) of a formula at each frame. The trace must have a frame."""
        return self.value(formula)[0]

    def value(self, formula: Formula) -> Bools:  # noqa: PLR0911 - a case each
        """Return the truth value of a formula for each node combination and frame, (B, F).

        The shape is (1, F) if all node combinations have the same value.
        """
        match formula:
            case TruthConstant(value=value):
                return np.full((1, len(self.times)), value)
            case Proposition(name=name):
                return np.atleast_2d(self.columns[name])
            case Not(operand=operand):
                return ~self.value(operand)
            case And(operands=operands):
                return reduce(np.logical_and, map(self.value, operands))
            case Or(operands=operands):
                return reduce(np.logical_or, map(self.value, operands))
            case Next(operand=operand, weak=weak):
                shifted = np.roll(self.value(operand), -1, axis=1)
                shifted[:, -1] = weak
                return shifted
            case Previous(operand=operand):
                shifted = np.roll(self.value(operand), 1, axis=1)
                shifted[:, 0] = False
                return shifted
            case Until(left=left, right=right, bound=bound):
                start, end = self.window(bound, forward=True)
                hit = _at(_next(self.value(right)), start)
                true = hit <= np.minimum(
                    len(self.times) - 1 if end is None else end, len(self.times) - 1
                )
                return true if left == TRUE else true & (hit <= _next(~self.value(left)))
            case Since(left=left, right=right, bound=bound):
                start, end = self.window(bound, forward=False)
                hit = _at(_last(self.value(right)), start)
                true = hit >= np.maximum(0 if end is None else end, 0)
                return true if left == TRUE else true & (hit >= _last(~self.value(left)))

    def window(self, bound: Bound, *, forward: bool) -> tuple[Places | None, Places | None]:
        """For each frame, return the nearest and the farthest frame in the time bound of an operator.

        ``None`` as nearest frame means the frame itself; as farthest frame, the trace end.
        """
        sign = 1 if forward else -1
        near = far = None
        here = self.frames
        low, high = bound.low, bound.high
        period = None if bound.frames else self._period
        if bound.frames or period:
            # With an even clock, counting frames is enough.
            unit = period or 1
            near = here + sign * min(-(-low // unit), len(here)) if low else None
            far = None if high is None else here + sign * min(high // unit, len(here))
        elif forward:
            near = np.searchsorted(self.times, _sum(self.times, low), "left") if low else None
            if high is not None:
                far = np.searchsorted(self.times, _sum(self.times, high), "right") - 1
        else:
            if low:
                near = np.searchsorted(self.times, self.times - low, "right") - 1
            if high is not None:
                far = np.searchsorted(self.times, self.times - high, "left")
        return near, far

    @property
    def frames(self) -> Places:
        """Number of each frame of the trace, shape (F,)."""
        return _frames(len(self.times))

    @property
    def _period(self) -> int | None:
        """Time between frames, if it is constant; otherwise None; ns."""
        if len(self.times) < 2:
            return None
        period = int(self.times[1] - self.times[0])
        return period if bool(np.all(np.diff(self.times) == period)) else None


def _sum(times: Ints, by: int) -> Ints:
    return np.minimum(times, np.iinfo(np.int64).max - by) + by


def _frames(frames: int) -> Places:
    return np.arange(frames, dtype=np.int32 if frames < 1 << 29 else np.int64)


def _next(flags: Bools) -> Places:
    frames = flags.shape[1]
    here = _frames(frames)
    places = np.where(flags, here, here.dtype.type(frames))[:, ::-1]
    return np.minimum.accumulate(places, axis=1)[:, ::-1]


def _last(flags: Bools) -> Places:
    here = _frames(flags.shape[1])
    return np.maximum.accumulate(np.where(flags, here, here.dtype.type(-1)), axis=1)


def _at(places: Places, frame: Places | None) -> Places:
    """Return the values of an array of frame numbers at the given frames.

    The value is -1 before the trace, and F after it.
    """
    if frame is None:
        return places
    frames = places.shape[1]
    inside = (frame >= 0) & (frame < frames)
    told = places[:, np.clip(frame, 0, frames - 1)]
    return np.where(inside, told, np.where(frame < 0, -1, frames))
