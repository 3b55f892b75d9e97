"""The times of frames: stamps of messages, and what stands for a stamp that is missing.

One law for all flavours, so that two clocks never mix in a trace:

* The clock of a trace is that of the stamps of its leading channel. If none of its messages has a stamp, it is
  the log time, of all channels.
* A missing stamp is the log time less the offset (log time − stamp) of the message before it, else of the one
  behind it. Where this is not between the stamps around it, it is interpolated.
* A stamp of 0 is a time if a stamp beside it is near 0. Formats that cannot say that a stamp is missing (ROS)
  write 0 for it: there, a 0 between stamps that go on is missing, too.
* A message of another channel without a stamp, or with that of another clock, is placed by the offset of the
  leading channel.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

NEAR: Final = 1_000_000_000
"""A stamp is near 0 up to here, or up to three periods of its channel; ns."""
AT_ZERO: Final = 100_000_000
"""How far from 0 a message of another channel may be by its log time if its stamp of 0 is a time; ns."""
OTHER_CLOCK: Final = 86_400_000_000_000
"""Stamps of two channels that are as far apart are of two clocks; ns."""
MOST_RUNS: Final = 100_000
"""Runs of messages without a stamp that are remembered; the messages of more are losses."""
NO_TIME: Final = "a message has no time, and none can be derived"
"""What a loss says of it."""
_STEPS: Final = 99
"""Steps of a clock whose median is its period."""

Known = tuple[int, int]
"""Log time and stamp of a message."""


@dataclass(slots=True)
class _Unstamped:
    """Messages without a stamp, or with a stamp of 0, and the messages with stamps around them."""

    first: int
    last: int
    before: Known | None
    behind: Known | None = None


@dataclass(slots=True)
class Stamps:
    """The stamps of a channel, as the first reading finds them.

    Attributes
    ----------
    explicit : bool
        Whether the format says that a stamp is missing.
    logged : bool
        Whether the file has log times of its own. Without them a missing stamp is told by the place of its
        message between two others.
    first : tuple of int or None
        Log time and stamp of the first message with a stamp that is not 0.
    steps : list of int
        The first times between two stamps; ns.
    """

    explicit: bool = True
    logged: bool = True
    first: Known | None = None
    steps: list[int] = field(default_factory=list[int])
    _number: int = -1
    _zero: Known | None = None
    _last: Known | None = None
    _runs: list[_Unstamped] = field(default_factory=list[_Unstamped])
    _open: _Unstamped | None = None
    _more: bool = False

    def next(self) -> None:
        """Count a message. It is called for each of the channel, whatever it holds."""
        self._number += 1

    def see(self, log_time_ns: int, stamp_ns: int | None) -> None:
        """Take note of the stamp of the message that was counted last."""
        if stamp_ns == 0:
            self._zero = self._zero or (log_time_ns, 0)
        if stamp_ns:
            known = log_time_ns, stamp_ns
            if self._last is not None and stamp_ns > self._last[1] and len(self.steps) < _STEPS:
                self.steps.append(stamp_ns - self._last[1])
            if self._open is not None:
                self._open.behind, self._open = known, None
            self.first = self.first or known
            self._last = known
        elif self._open is not None:
            self._open.last = self._number
        elif len(self._runs) < MOST_RUNS:
            self._open = _Unstamped(self._number, self._number, self._last)
            self._runs.append(self._open)

    def is_near(self, known: Known | None) -> bool:
        """Return whether a stamp is near 0."""
        steps = sorted(self.steps)
        period = steps[len(steps) // 2] if steps else 0
        return known is not None and abs(known[1]) <= max(NEAR, 3 * period)

    @property
    def clock(self) -> Known | None:
        """Log time and stamp of one message; ``None`` if the log time is the clock."""
        alone = self._number == 0
        return self.first or (self._zero if self.explicit or alone else None)

    def reading(self) -> StampReader:
        """Return what tells the times of the messages when they are read again."""
        return StampReader(self, self._runs)


class StampReader:
    """The times of the messages of a channel, one after another.

    Parameters
    ----------
    stamps : Stamps
    runs : list
        Its messages without a stamp, or with a stamp of 0.

    Attributes
    ----------
    untimed : int
        How many messages were given their log time, because no message of the channel has a stamp.
    """

    def __init__(self, stamps: Stamps, runs: list[_Unstamped]) -> None:
        self.untimed = 0
        self._stamps, self._runs, self._clock = stamps, runs, stamps.clock
        self._number, self._at = -1, 0
        self._offset = 0 if self._clock is None else self._clock[0] - self._clock[1]

    def next(self) -> None:
        """Count a message. It is called for each of the channel, whatever it holds."""
        self._number += 1

    def time(self, log_time_ns: int, stamp_ns: int | None) -> int | None:
        """The time of the message that was counted last; ``None`` if it cannot be known."""
        if self._clock is None:
            self.untimed += 1
            return log_time_ns
        time_ns = stamp_ns or self._unstamped(log_time_ns, stamp_ns)
        if time_ns is not None:
            self._offset = log_time_ns - time_ns
        return time_ns

    def beside(self, log_time_ns: int, stamp_ns: int | None) -> int:
        """The time of a message of another channel, which comes now."""
        expected = log_time_ns - self._offset
        if self._clock is None:
            return log_time_ns
        if stamp_ns == 0 and not self._stamps.explicit:
            return 0 if abs(expected) <= AT_ZERO else expected
        same_clock = stamp_ns is not None and abs(stamp_ns - expected) < OTHER_CLOCK
        return stamp_ns if stamp_ns is not None and same_clock else expected

    def _unstamped(self, log_time_ns: int, stamp_ns: int | None) -> int | None:
        """The time of a message without a stamp, or with a stamp of 0."""
        while self._at < len(self._runs) and self._runs[self._at].last < self._number:
            self._at += 1
        run = self._runs[self._at] if self._at < len(self._runs) else None
        if run is None or run.first > self._number:
            return None  # of too many
        before, behind = run.before, run.behind
        if stamp_ns == 0 and self._is_time(before, behind):
            return 0
        if not self._stamps.logged:
            return self._placed(run, log_time_ns)
        if before is None and behind is None:
            before = self._clock
        return _between(log_time_ns, before, behind)

    def _placed(self, run: _Unstamped, log_time_ns: int) -> int | None:
        """The time of a message in a file without log times: by its place between two stamps."""
        before, behind = run.before, run.behind
        if before is None:
            return None
        if behind is None or behind[1] < before[1]:
            return log_time_ns  # that of the message before it
        share = self._number - run.first + 1, run.last - run.first + 2
        return before[1] + (behind[1] - before[1]) * share[0] // share[1]

    def _is_time(self, before: Known | None, behind: Known | None) -> bool:
        """Return whether stamps of 0 between two others are a time."""
        stamps = self._stamps
        if before is None and behind is None:
            return True  # no other clock is known
        near = stamps.is_near(before) or stamps.is_near(behind)
        if stamps.explicit:
            return near
        begins = before is None or (behind is not None and behind[1] < before[1])
        return begins and stamps.is_near(behind)


def _between(log_time_ns: int, before: Known | None, behind: Known | None) -> int:
    """The time at a log time, by the offsets of the messages around it."""
    log, stamp = before or behind or (log_time_ns, log_time_ns)
    time_ns = log_time_ns - (log - stamp)
    if before is None or behind is None or before[1] <= time_ns <= behind[1]:
        return time_ns
    span = behind[0] - before[0]
    if behind[1] < before[1] or span <= 0:
        return time_ns
    return before[1] + (log_time_ns - before[0]) * (behind[1] - before[1]) // span
