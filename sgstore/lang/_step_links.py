"""Time links between the steps of a sequence, and the sequences of an expression of steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from sgstore.lang._durations import Length


@dataclass(frozen=True, slots=True)
class StepLink:
    """Relation in time between a step and the previous step.

    Attributes
    ----------
    kind : str
        ``then``: in a later frame, at least ``after`` and at most ``within`` later; ``immediately``: in the
        next frame; ``until``: in the frame after a run of the previous step; ``while``: in the same frame.
    after, within : Length or None
    """

    kind: Literal["then", "immediately", "until", "while"]
    after: Length | None
    within: Length | None


@dataclass(frozen=True, slots=True)
class StepWay:
    """Sequence of steps that an expression of steps allows.

    Attributes
    ----------
    steps : tuple of int
        Numbers of the steps. A repeated step occurs several times.
    happen : tuple of int
        Numbers of the steps that must occur, without absent steps.
    links : tuple of StepLink
    """

    steps: tuple[int, ...]
    happen: tuple[int, ...]
    links: tuple[StepLink, ...]
