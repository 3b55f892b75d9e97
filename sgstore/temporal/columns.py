"""Formulas over whole traces: every operator at all frames at once, in linear time.

A column is true or false at each frame; operators make columns of columns. An *until* looks for the next frame
at which its right side holds, from where its bound begins, and compares it with the next one at which its left
side fails.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.temporal.formulas import (
    And,
    Bound,
    Constant,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    Until,
    propositions,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sgstore.world import Bools, Ints

CELLS: Final = 4_000_000
"""Frames times prefixes that are worked on at once."""


def evaluate(formula: Formula, columns: Mapping[str, Bools], times: Ints) -> Bools:
    """Where a formula is true in a trace.

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (F,) bool
        The propositions.
    times : (F,) int64
        Time stamps of the frames, ascending; ns.

    Returns
    -------
    (F,) bool
        The formula's value at each frame.

    Raises
    ------
    ValueError
        A proposition is missing, columns have different lengths, or times do not ascend.
    """
    table = _Table.of(formula, columns, times)
    if not len(times):
        return np.zeros(0, np.bool_)
    return table.value(formula, np.array([[len(times) - 1]]))[0]


def evaluate_rows(formula: Formula, columns: Mapping[str, Bools], times: Ints, rows: int) -> Bools:
    """Where a formula is true for each of several bindings in one trace.

    Parameters
    ----------
    formula : Formula
    columns : mapping of str to (B, F) bool, or (1, F)
        The propositions for each binding; (1, F): the same for all.
    times : (F,) int64
        As in :func:`evaluate`; F is at least 1.
    rows : int
        B, the number of bindings.

    Returns
    -------
    (B, F) bool
    """
    last = np.full((rows, 1), len(times) - 1)
    return _Table(columns, times).value(formula, last)


def prefix_verdicts(formula: Formula, columns: Mapping[str, Bools], times: Ints) -> Bools:
    """The value of a formula at the first frame, if the trace ended at each of its frames in turn.

    Parameters
    ----------
    formula, columns, times
        As in :func:`evaluate`.

    Returns
    -------
    (F,) bool
        The verdict over the frames 0 … f. Time grows with the square of F; memory does not.
    """
    table = _Table.of(formula, columns, times)
    frames = len(times)
    rows = max(CELLS // max(frames, 1), 1)
    parts = [
        table.value(formula, np.arange(start, min(start + rows, frames))[:, None])[:, 0]
        for start in range(0, frames, rows)
    ]
    return np.concatenate([np.zeros(0, np.bool_), *parts])


@dataclass(frozen=True, slots=True)
class _Table:
    """The propositions of a trace. Values have a row for each end of it, ``last`` (R, 1); a column a frame."""

    columns: Mapping[str, Bools]
    times: Ints

    @classmethod
    def of(cls, formula: Formula, columns: Mapping[str, Bools], times: Ints) -> _Table:
        missing = sorted(propositions(formula) - set(columns))
        if missing:
            raise ValueError(f"no column for the proposition {missing[0]!r}")
        for name in propositions(formula):
            if columns[name].shape != times.shape:
                raise ValueError(f"{name} has shape {columns[name].shape}, expected {times.shape}")
        if np.any(np.diff(times) <= 0):
            raise ValueError("the times of the frames must ascend")
        return cls(columns, times)

    def value(self, formula: Formula, last: Ints) -> Bools:  # noqa: PLR0911 - a case each
        """(R, F): the value at each frame, for each end of the trace; meaningless behind the end."""
        frames = len(self.times)
        match formula:
            case Constant(value=value):
                return np.full((len(last), frames), value)
            case Proposition(name=name):
                return np.broadcast_to(self.columns[name], (len(last), frames))
            case Not(operand=operand):
                return ~self.value(operand, last)
            case And(operands=operands):
                return np.logical_and.reduce([self.value(operand, last) for operand in operands])
            case Or(operands=operands):
                return np.logical_or.reduce([self.value(operand, last) for operand in operands])
            case Next(operand=operand, weak=weak):
                shifted = np.full((len(last), frames), weak)
                shifted[:, :-1] = self.value(operand, last)[:, 1:]
                return np.where(np.arange(frames) < last, shifted, weak)
            case Previous(operand=operand):
                shifted = np.zeros((len(last), frames), np.bool_)
                shifted[:, 1:] = self.value(operand, last)[:, :-1]
                return shifted
            case Until(left=left, right=right, bound=bound):
                return self._until(self.value(left, last), self.value(right, last), bound, last)
            case Since(left=left, right=right, bound=bound):
                return self._since(self.value(left, last), self.value(right, last), bound)

    def _until(self, left: Bools, right: Bools, bound: Bound, last: Ints) -> Bools:
        here = np.arange(len(self.times))
        start, end = self._window(bound, forward=True)
        behind = here > last
        hit = _at(_next(right & ~behind), start)
        fails = _next(~left & ~behind)
        return (hit <= np.minimum(end, last)) & (hit <= fails)

    def _since(self, left: Bools, right: Bools, bound: Bound) -> Bools:
        start, end = self._window(bound, forward=False)
        hit = _at(_last(right), start)
        fails = _last(~left)
        return (hit >= np.maximum(end, 0)) & (hit >= fails)

    def _window(self, bound: Bound, *, forward: bool) -> tuple[Ints, Ints]:
        """The first and the last frame that an operator looks at, from each frame, in its direction."""
        times, frames = self.times, len(self.times)
        here = np.arange(frames)
        sign = 1 if forward else -1
        if bound.frames:
            near = here + sign * bound.low
            far = None if bound.high is None else here + sign * bound.high
        elif forward:
            near = np.searchsorted(times, times + bound.low, "left")
            far = None
            if bound.high is not None:
                far = np.searchsorted(times, _sum(times, bound.high), "right") - 1
        else:
            near = np.searchsorted(times, times - bound.low, "right") - 1
            far = None
            if bound.high is not None:
                far = np.searchsorted(times, times - bound.high, "left")
        if far is None:
            far = np.full(frames, frames - 1 if forward else 0)
        return near, far


def _sum(times: Ints, by: int) -> Ints:
    """Later times, where they can be told in 64 bits."""
    return np.minimum(times, np.iinfo(np.int64).max - by) + by


def _next(flags: Bools) -> NDArray[np.int64]:
    """(R, F): the first frame from each on where a flag is set; F where there is none."""
    frames = flags.shape[1]
    places = np.where(flags, np.arange(frames), frames)
    return np.minimum.accumulate(places[:, ::-1], axis=1)[:, ::-1]


def _last(flags: Bools) -> NDArray[np.int64]:
    """(R, F): the last frame up to each where a flag is set; -1 where there is none."""
    places = np.where(flags, np.arange(flags.shape[1]), -1)
    return np.maximum.accumulate(places, axis=1)


def _at(places: NDArray[np.int64], frame: Ints) -> NDArray[np.int64]:
    """The places told at other frames; F and -1 where these are out of the trace, behind and before it."""
    frames = places.shape[1]
    inside = (frame >= 0) & (frame < frames)
    told = places[:, np.clip(frame, 0, frames - 1)]
    return np.where(inside, told, np.where(frame < 0, -1, frames))
