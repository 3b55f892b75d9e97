"""What a monitor tells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class Moment:
    """A frame of the trace that is watched.

    Attributes
    ----------
    seq : int
        Its number, from 0.
    time_ns : int
        Simulation time.
    t : float
        Seconds since the first frame.
    """

    seq: int
    time_ns: int
    t: float


@dataclass(frozen=True, slots=True)
class Event:
    """Something that is known from a frame on.

    Attributes
    ----------
    kind : str
        ``violated``: a check is, from ``start`` on; ``kept again``: that has ended with ``end``; ``found``: a
        pattern is.
    name : str
        Of the check, or of the pattern.
    told : Moment
        The frame that made it known.
    start, end : Moment
        The frames that it is about: of a violation that lasts both are its first; of a sequence those of its
        first and of its last step.
    nodes : mapping of str to int
        Node ids by variable.
    names : mapping of str to str
        Their names.
    steps : tuple of Moment
        Of a sequence: the frame of each step that happens.
    at_end : bool
        Whether only the end of the trace made it a violation.
    """

    kind: str
    name: str
    told: Moment
    start: Moment
    end: Moment
    nodes: Mapping[str, int]
    names: Mapping[str, str]
    steps: tuple[Moment, ...] = ()
    at_end: bool = False
