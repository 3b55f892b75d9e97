"""How long a step of a sequence lasts, bound."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from sgstore.records import dataclass

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


@dataclass(frozen=True, slots=True)
class Length:
    """A length of time: ``amount`` nanoseconds, or frames."""

    amount: int
    frames: bool


_COMPARE: Final[Mapping[str, Callable[[Any, int, int], Any]]] = {
    ">=": lambda length, amount, by: length >= amount - by,
    ">": lambda length, amount, by: length > amount + by,
    "<=": lambda length, amount, by: length <= amount + by,
    "<": lambda length, amount, by: length < amount - by,
    "=": lambda length, amount, by: abs(length - amount) <= by,
}
"""Comparisons, what differs by no more than a tolerance being the same."""


@dataclass(frozen=True, slots=True)
class BoundHold:
    """Duration that a step must have: from the first to the last frame of its run.

    Attributes
    ----------
    comparison : str
    length : Length
        In frames: how many there are.
    inclusive : bool
        Whether the time of one median period is added to that of the run.
    """

    comparison: str
    length: Length
    inclusive: bool

    def fits(self, length: Any, tolerance: int) -> Any:
        """Tell whether a run that is so long lasts as it must.

        Parameters
        ----------
        length : int or (R,) int
            Nanoseconds, or frames.
        tolerance : int
            Of times; ns.

        Returns
        -------
        bool or (R,) bool
        """
        by = 0 if self.length.frames else tolerance
        return _COMPARE[self.comparison](length, self.length.amount, by)
