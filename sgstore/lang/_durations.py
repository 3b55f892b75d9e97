"""Bound durations of sequence steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


@dataclass(frozen=True, slots=True)
class Length:
    """Duration of ``amount`` nanoseconds or frames."""

    amount: int
    frames: bool


_COMPARE: Final[Mapping[str, Callable[[Any, int, int], Any]]] = {
    ">=": lambda length, amount, by: length >= amount - by,
    ">": lambda length, amount, by: length > amount + by,
    "<=": lambda length, amount, by: length <= amount + by,
    "<": lambda length, amount, by: length < amount - by,
    "=": lambda length, amount, by: abs(length - amount) <= by,
}
"""Comparisons that treat lengths within a tolerance as equal."""


@dataclass(frozen=True, slots=True)
class BoundHold:
    """Duration that a step must have, from the first to the last frame of its run.

    Attributes
    ----------
    comparison : str
    length : Length
        Duration to compare with; if in frames, the number of frames.
    inclusive : bool
        True if one median frame period is added to the duration of the run.
    """

    comparison: str
    length: Length
    inclusive: bool

    def fits(self, length: Any, tolerance: int) -> Any:
        """Return true for runs whose length meets the comparison.

        Parameters
        ----------
        length : int or (R,) int
            Length of the run; ns or frames.
        tolerance : int
            Tolerance for times; ns.

        Returns
        -------
        bool or (R,) bool
        """
        by = 0 if self.length.frames else tolerance
        return _COMPARE[self.comparison](length, self.length.amount, by)
