"""Frames in which one step of a sequence is true, found online from pattern, conditions and duration."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sgstore.temporal._progression import Term
from sgstore.temporal._valuation import NEVER, Partial

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.lang.ir import BoundHold
    from sgstore.temporal._signal_state import StreamClock
    from sgstore.temporal._valuation import Key

Needs = bool | tuple[tuple[Partial, Term], ...]
"""Truth value of conditions, or the open terms of which one must become true."""


@dataclass(slots=True)
class Run:
    """Consecutive frames without a gap in which a sequence step matches.

    Attributes
    ----------
    number : int
        Number of the first frame.
    last : int
        Number of the last frame so far.
    over : bool
        True if the run has ended.
    """

    number: int
    last: int
    over: bool = False


@dataclass(frozen=True, slots=True)
class StepFrame:
    """Frame in which a sequence step matches.

    Attributes
    ----------
    number, time : int
        Number and time (ns) of the frame.
    gap : bool
        True if a gap lies before the frame.
    run : Run
    """

    number: int
    time: int
    gap: bool
    run: Run

    @property
    def ends(self) -> tuple[int, ...]:
        """Numbers of the frame, and of the first and last frame of its run.

        The last frame is absent while the run continues.
        """
        return (self.number, self.run.number, *([self.run.last] if self.run.over else []))


class StepState:
    """State of one sequence step for one combination of nodes: its matching and undecided frames.

    Parameters
    ----------
    pulse : StreamClock
        Clock, updated with each frame before this object.
    hold : BoundHold, optional
        Required duration of the step.

    Attributes
    ----------
    places : list of StepFrame
        Stored frames, ascending.
    open : deque of Needs
        Open conditions of the undecided frames, earliest first.
    """

    def __init__(self, pulse: StreamClock, hold: BoundHold | None = None) -> None:
        self._pulse, self._hold = pulse, hold
        self.places: list[StepFrame] = []
        self.open: deque[Needs] = deque()
        self._queue: deque[tuple[int, int, bool]] = (
            deque()
        )  # number, time, and gap before each frame
        self._run: Run | None = None
        self._waiting: list[StepFrame] = []
        self._start = (0, 0)
        self._fits = True

    @property
    def idle(self) -> bool:
        """True if the step has no stored frame and no current run, so that its state can be deleted."""
        return not (self.places or self._queue or self._run)

    @property
    def oldest(self) -> int:
        """First frame of the stored or undecided runs of the step. :data:`NEVER` means no frame."""
        runs = [place.run.number for place in self.places[:1]]
        runs += [self._run.number] if self._run is not None else []
        return min([*runs, self.undecided])

    @property
    def undecided(self) -> int:
        """Number of the first frame in which the step is undecided. :data:`NEVER` means no frame."""
        if self._waiting:
            return self._waiting[0].number
        return self._queue[0][0] if self._queue else NEVER

    def frames(self) -> Iterator[int]:
        """Yield the numbers of the stored frames of the step, decided or not, and of the ends of their runs."""
        for place in (*self.places, *self._waiting):
            yield from place.ends
        if self._run is not None:
            yield self._run.number
        yield from (number for number, _, _ in self._queue)

    def ask(self, holds: Needs, *, gap: bool) -> None:
        """Add the next frame in which the step may match, with conditions that are still open."""
        self._queue.append((self._pulse.tick.number, self._pulse.tick.time, gap))
        self.open.append(holds)

    def decide(self, needs: list[Needs]) -> None:
        """Decide the open frames of the step whose conditions have become known."""
        self.open = deque(needs)
        while self.open and isinstance(self.open[0], bool):
            number, time, gap = self._queue.popleft()
            holds = self.open.popleft()
            if gap or not holds:
                self._end()
            if holds:
                self._extend(number, time, gap=gap)

    def _extend(self, number: int, time: int, *, gap: bool) -> None:
        if self._run is None:
            self._run = Run(number, number)
            self._start = number, time
            self._fits = self._hold is None
        self._run.last = number
        self._waiting.append(StepFrame(number, time, gap, self._run))
        growing = self._hold is not None and self._hold.comparison in {">=", ">"}
        self._fits = self._fits or (growing and self._long())
        if self._fits:
            self._flush()

    def _flush(self) -> None:
        self.places += self._waiting
        self._waiting = []

    def _long(self) -> bool:
        """True if the current run of matching frames has the required duration."""
        if self._hold is None:
            return True
        last = self._waiting[-1]
        length = last.time - self._start[1] + (self._pulse.period if self._hold.inclusive else 0)
        if self._hold.length.frames:
            length = last.number - self._start[0] + 1
        return self._hold.fits(length, self._pulse.tick.tolerance)

    def _end(self) -> None:
        if self._waiting and self._long():
            self._flush()
        self._waiting = []
        if self._run is not None:
            self._run.over = True
        self._run = None

    def finish(self) -> None:
        """End the trace: decide all open frames of the step."""
        self.decide([n if isinstance(n, bool) else any(t.ended for _, t in n) for n in self.open])
        self._end()


Binding = dict[str, int]
"""Variable → node."""


def joined(one: Binding, names: tuple[str, ...], key: Key, apart: frozenset[str]) -> Binding | None:
    """Merge the nodes of two matches. ``None`` means a conflict, or two equal nodes that must differ."""
    both = dict(one)
    for name, node in zip(names, key, strict=True):
        known = both.get(name)
        if known is None:
            if name in apart and any(n == node for v, n in one.items() if v in apart):
                return None
            both[name] = node
        elif known != node:
            return None
    return both
