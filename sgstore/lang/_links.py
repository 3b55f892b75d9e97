"""Links between the steps of a sequence, and the sequences that an expression of steps stands for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from sgstore.records import dataclass

if TYPE_CHECKING:
    from sgstore.lang._durations import Length


@dataclass(frozen=True, slots=True)
class StepLink:
    """Relation in time between a step and the one before it.

    Attributes
    ----------
    kind : str
        ``then``: from ``after`` on, up to ``within``, and in a later frame; ``immediately``: in the next frame;
        ``until``: in the frame after a run of the step before; ``while``: in the same frame.
    after, within : Length or None
    """

    kind: Literal["then", "immediately", "until", "while"]
    after: Length | None
    within: Length | None


@dataclass(frozen=True, slots=True)
class StepWay:
    """A sequence that an expression of steps stands for.

    Attributes
    ----------
    steps : tuple of int
        Numbers of its steps; one that is repeated is there several times.
    happen : tuple of int
        Those of them that happen, and are not absent.
    links : tuple of StepLink
    """

    steps: tuple[int, ...]
    happen: tuple[int, ...]
    links: tuple[StepLink, ...]
