"""Where a step of a sequence holds, frame by frame: its pattern, its other conditions, its duration."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from sgstore.monitor.bindings import Partial
from sgstore.temporal.progression import Term

if TYPE_CHECKING:
    from sgstore.lang.over_time import Hold
    from sgstore.monitor.asking import Key

Needs = bool | tuple[tuple[Partial, Term], ...]
"""Whether conditions hold, or what of them must still be shown: for some binding one of these."""

NEVER: Final = 1 << 62
"""Later than any frame."""


@dataclass(slots=True)
class Run:
    """Frames one after the other, without a gap, in which a step holds.

    Attributes
    ----------
    number : int
        The number of its first frame.
    last : int
        The number of its last frame so far.
    over : bool
        Whether the next frame is not part of it.
    """

    number: int
    last: int
    over: bool = False


@dataclass(frozen=True, slots=True)
class Place:
    """A frame in which a step holds.

    Attributes
    ----------
    number, time : int
        Of the frame; ns.
    gap : bool
        Whether a gap lies before it.
    run : Run
    """

    number: int
    time: int
    gap: bool
    run: Run


@dataclass(slots=True)
class _Asked:
    """A frame of which it is not known yet whether the step's conditions hold."""

    number: int
    time: int
    gap: bool
    holds: Needs


@dataclass(slots=True)
class Held:
    """A step and one binding.

    Attributes
    ----------
    places : list of Place
        Those that are kept, ascending.
    """

    places: list[Place] = field(default_factory=list[Place])
    _queue: deque[_Asked] = field(default_factory=deque["_Asked"])
    _run: Run | None = None
    _waiting: list[Place] = field(default_factory=list[Place])
    _start: tuple[int, int] = (0, 0)
    _fits: bool = True

    @property
    def idle(self) -> bool:
        """Whether nothing is remembered."""
        return not (self.places or self._queue or self._run)

    @property
    def oldest(self) -> int:
        """The first frame of the runs of which something is kept or may come; :data:`NEVER`: there are none."""
        runs = [place.run.number for place in self.places[:1]]
        runs += [self._run.number] if self._run is not None else []
        return min([*runs, self.undecided])

    @property
    def undecided(self) -> int:
        """The number of the first frame that may still turn out to be a place; :data:`NEVER`: none so far."""
        if self._waiting:
            return self._waiting[0].number
        return self._queue[0].number if self._queue else NEVER

    def ask(self, number: int, time: int, *, gap: bool, holds: Needs) -> None:
        """The next frame, and what its conditions still need."""
        self._queue.append(_Asked(number, time, gap, holds))

    @property
    def open(self) -> list[Needs]:
        """What frames still need, the earliest first."""
        return [asked.holds for asked in self._queue]

    def decide(self, needs: list[Needs], hold: Hold | None, period: int) -> None:
        """What those frames need now: who needs nothing any more is a place, or is none."""
        for asked, need in zip(self._queue, needs, strict=True):
            asked.holds = need
        while self._queue and isinstance(self._queue[0].holds, bool):
            asked = self._queue.popleft()
            if self._run is not None and (asked.gap or not asked.holds):
                self._end(hold, period)
            if asked.holds:
                self._extend(asked, hold, period)

    def _extend(self, asked: _Asked, hold: Hold | None, period: int) -> None:
        if self._run is None:
            self._run = Run(asked.number, asked.number)
            self._start = asked.number, asked.time
            self._fits = hold is None
        self._run.last = asked.number
        place = Place(asked.number, asked.time, asked.gap, self._run)
        if self._fits:
            self.places.append(place)
            return
        self._waiting.append(place)
        if hold is not None and hold.comparison in {">=", ">"} and self._long(hold, period):
            self._fits = True
            self._flush()

    def _flush(self) -> None:
        self.places += self._waiting
        self._waiting = []

    def _long(self, hold: Hold, period: int) -> bool:
        """Whether the run is as long as is asked."""
        assert self._run is not None  # noqa: S101 - there is one
        last = self._waiting[-1]
        length = last.time - self._start[1] + (period if hold.inclusive else 0)
        if hold.length.frames:
            length = last.number - self._start[0] + 1
        return hold.fits(length)

    def _end(self, hold: Hold | None, period: int) -> None:
        if self._waiting and hold is not None and self._long(hold, period):
            self._flush()
        self._waiting = []
        if self._run is not None:
            self._run.over = True
        self._run = None

    def finish(self, hold: Hold | None, period: int) -> None:
        """The trace has ended."""
        told = [n if isinstance(n, bool) else any(t.ended for _, t in n) for n in self.open]
        self.decide([*told], hold, period)
        self._end(hold, period)


Binding = dict[str, int]
"""What variables are bound to."""


def joined(one: Binding, names: tuple[str, ...], key: Key, apart: frozenset[str]) -> Binding | None:
    """A binding and another one together; ``None`` if they differ, or what must differ does not."""
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
