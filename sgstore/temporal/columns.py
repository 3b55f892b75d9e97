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
    TRUE,
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

    Places = NDArray[np.int32 | np.int64]

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
    table = Table.of(formula, columns, times)
    if not len(times):
        return np.zeros(0, np.bool_)
    return table.whole(formula)


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
    return Table(columns, times).value(formula, last)


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
    table = Table.of(formula, columns, times)
    frames = len(times)
    rows = max(CELLS // max(frames, 1), 1)
    parts = [
        table.value(formula, np.arange(start, min(start + rows, frames))[:, None])[:, 0]
        for start in range(0, frames, rows)
    ]
    return np.concatenate([np.zeros(0, np.bool_), *parts])


@dataclass(frozen=True, slots=True)
class Table:
    """The propositions of a trace. Values have a row for each end of it, ``last`` (R, 1); a column a frame.

    Parameters
    ----------
    columns : mapping of str to (F,) bool
    times : (F,) int64
        Ascending; ns.
    """

    columns: Mapping[str, Bools]
    times: Ints

    @classmethod
    def of(cls, formula: Formula, columns: Mapping[str, Bools], times: Ints) -> Table:
        """The same, if it has what a formula asks; see :func:`evaluate`."""
        missing = sorted(propositions(formula) - set(columns))
        if missing:
            raise ValueError(f"no column for the proposition {missing[0]!r}")
        for name in propositions(formula):
            if columns[name].shape != times.shape:
                raise ValueError(f"{name} has shape {columns[name].shape}, expected {times.shape}")
        if np.any(np.diff(times) <= 0):
            raise ValueError("the times of the frames must ascend")
        return cls(columns, times)

    def whole(self, formula: Formula) -> Bools:
        """(F,): the value at each frame of the whole trace, which has at least one."""
        return self.value(formula, np.array([[len(self.times) - 1]]))[0]

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
                kept = None if left == TRUE else self.value(left, last)
                return self._until(kept, self.value(right, last), bound, last)
            case Since(left=left, right=right, bound=bound):
                kept = None if left == TRUE else self.value(left, last)
                return self._since(kept, self.value(right, last), bound)

    def _until(self, left: Bools | None, right: Bools, bound: Bound, last: Ints) -> Bools:
        """``left`` is ``None`` where it is true always."""
        frames = len(self.times)
        behind = None if np.all(last == frames - 1) else np.arange(frames) > last
        hit = _next(right if behind is None else right & ~behind)
        start, end = self.window(bound, forward=True)
        hit = hit if start is None else _at(hit, start)
        true = hit <= (last if end is None else np.minimum(end, last))
        if left is not None:
            true &= hit <= _next(~left if behind is None else ~left & ~behind)
        return true

    def _since(self, left: Bools | None, right: Bools, bound: Bound) -> Bools:
        hit = _last(right)
        start, end = self.window(bound, forward=False)
        hit = hit if start is None else _at(hit, start)
        true = hit >= (0 if end is None else np.maximum(end, 0))
        if left is not None:
            true &= hit >= _last(~left)
        return true

    def window(self, bound: Bound, *, forward: bool) -> tuple[Places | None, Places | None]:
        """The first and the last frame that an operator looks at, from each frame, in its direction.

        ``None``: this frame; and the last one that there is.
        """
        sign = 1 if forward else -1
        near = far = None
        here = self.frames
        low, high = bound.low, bound.high
        period = None if bound.frames else self._period
        if bound.frames or period:
            # Of a clock that goes evenly, too, it is enough to count.
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
        """(F,) the numbers of the frames."""
        return _frames(len(self.times))

    @property
    def _period(self) -> int | None:
        """The time between two frames, if it is always the same; ns."""
        if len(self.times) < 2:
            return None
        period = int(self.times[1] - self.times[0])
        return period if bool(np.all(np.diff(self.times) == period)) else None


def _sum(times: Ints, by: int) -> Ints:
    """Later times, where they can be told in 64 bits."""
    return np.minimum(times, np.iinfo(np.int64).max - by) + by


def _frames(frames: int) -> Places:
    """Their numbers, in as few bytes as they need with some room."""
    return np.arange(frames, dtype=np.int32 if frames < 1 << 29 else np.int64)


def _next(flags: Bools) -> Places:
    """(R, F): the first frame from each on where a flag is set; F where there is none."""
    frames = flags.shape[1]
    here = _frames(frames)
    places = np.where(flags, here, here.dtype.type(frames))[:, ::-1]
    return np.minimum.accumulate(places, axis=1)[:, ::-1]


def _last(flags: Bools) -> Places:
    """(R, F): the last frame up to each where a flag is set; -1 where there is none."""
    here = _frames(flags.shape[1])
    return np.maximum.accumulate(np.where(flags, here, here.dtype.type(-1)), axis=1)


def _at(places: Places, frame: Places) -> Places:
    """The places told at other frames; F and -1 where these are out of the trace, behind and before it."""
    frames = places.shape[1]
    inside = (frame >= 0) & (frame < frames)
    told = places[:, np.clip(frame, 0, frames - 1)]
    return np.where(inside, told, np.where(frame < 0, -1, frames))
