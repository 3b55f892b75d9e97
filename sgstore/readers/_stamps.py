"""Simulation time of each frame: the time stamp of its message, or a replacement for a missing stamp.

All readers use the same rules, so that a trace never mixes two clocks:

* The clock of a trace is that of the stamps of its leading channel. If all its messages lack a stamp, the log
  time is the clock, for all channels.
* A missing stamp is computed as log time minus the offset (log time − stamp) of the previous message, else of
  the next one. If the result is not between the neighbouring stamps, it is interpolated.
* A stamp of 0 is a time if a neighbouring stamp is near 0. Formats without a value for "missing" (ROS) write 0
  instead. In these formats, a 0 between continuous stamps counts as missing, too.
* A message of another channel without a stamp, or with the stamp of another clock, gets its time from the
  offset of the leading channel.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from sgstore.model.world import AT_ZERO_NS

NEAR: Final = 1_000_000_000
"""Time up to which a stamp counts as near 0, or three periods of its channel if that is longer; ns."""
OTHER_CLOCK: Final = 86_400_000_000_000
"""Smallest difference between the stamps of two different clocks; ns."""
MOST_RUNS: Final = 100_000
"""Largest number of stored groups of messages without a stamp. Messages of further groups are lost."""
LATEST_NS: Final = 1 << 62
"""Limit of valid time stamps; ns. Differences of two such stamps fit into 64 bits."""
NO_TIME: Final = "a message has no time, and it cannot be derived"
"""Reason for the loss of a message without a time."""
_STEPS: Final = 99
"""Number of recent time steps whose median is the period of a clock."""

Known = tuple[int, int]
"""Log time of a message, and its time stamp."""


@dataclass(slots=True)
class _Unstamped:
    """Messages in a row without time stamp, and the nearest messages with a stamp before and after them."""

    first: int
    last: int
    before: Known | None
    behind: Known | None = None


@dataclass(slots=True)
class Stamps:
    """Time stamps in the messages of a channel, collected in the first reading of the recording.

    Attributes
    ----------
    explicit : bool
        True if the format distinguishes a missing stamp from 0.
    logged : bool
        True if the file has its own log times. Otherwise, a missing stamp follows from the position of its
        message between two others.
    first : tuple of int or None
        Log time and stamp of the first message with a stamp other than 0.
    steps : list of int
        First differences between stamps; ns.
    late : tuple of int or None
        Number of stamps beyond :data:`LATEST_NS`, which count as missing, and the first of them.
    """

    explicit: bool = True
    logged: bool = True
    first: Known | None = None
    steps: list[int] = field(default_factory=list[int])
    late: tuple[int, int] | None = None
    _number: int = -1
    _zero: Known | None = None
    _last: Known | None = None
    _runs: list[_Unstamped] = field(default_factory=list[_Unstamped])
    _open: _Unstamped | None = None
    _more: bool = False

    def next(self) -> None:
        """Count a message of the channel. Call it for each message, even without a time stamp."""
        self._number += 1

    def see(self, log_time_ns: int, stamp_ns: int | None) -> None:
        """Record the time stamp of the message that was counted last."""
        if stamp_ns is not None and abs(stamp_ns) >= LATEST_NS:
            count, first = self.late or (0, stamp_ns)
            self.late, stamp_ns = (count + 1, first), None
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
        """Return True if a time stamp is close to 0."""
        steps = sorted(self.steps)
        period = steps[len(steps) // 2] if steps else 0
        return known is not None and abs(known[1]) <= max(NEAR, 3 * period)

    @property
    def clock(self) -> Known | None:
        """Log time and time stamp of one message; ``None`` if frames use the log time instead."""
        alone = self._number == 0
        return self.first or (self._zero if self.explicit or alone else None)

    def reading(self) -> StampReader:
        """Return an object that returns the time of each message in the second reading of the recording."""
        return StampReader(self, self._runs)


class StampReader:
    """Simulation times of the messages of a channel, one after another.

    Parameters
    ----------
    stamps : Stamps
    runs : list
        Its runs of messages without a stamp or with a stamp of 0.

    Attributes
    ----------
    untimed : int
        Number of messages that use the log time, because all messages of the channel lack a stamp.
    """

    def __init__(self, stamps: Stamps, runs: list[_Unstamped]) -> None:
        self.untimed = 0
        self._stamps, self._runs, self._clock = stamps, runs, stamps.clock
        self._number, self._at = -1, 0
        self._offset = 0 if self._clock is None else self._clock[0] - self._clock[1]

    def next(self) -> None:
        """Count a message of the channel. Call it for each message, even without a time stamp."""
        self._number += 1

    def time(self, log_time_ns: int, stamp_ns: int | None) -> int | None:
        """Return the simulation time of the message that was counted last; ns. ``None`` if it is unknown."""
        if self._clock is None:
            self.untimed += 1
            return log_time_ns
        stamp_ns = _valid(stamp_ns)
        time_ns = stamp_ns or self._unstamped(log_time_ns, stamp_ns)
        if time_ns is not None:
            self._offset = log_time_ns - time_ns
        return time_ns

    def beside(self, log_time_ns: int, stamp_ns: int | None) -> int:
        """Return the simulation time of a message of another channel; ns."""
        expected, stamp_ns = log_time_ns - self._offset, _valid(stamp_ns)
        if self._clock is None:
            return log_time_ns
        if stamp_ns == 0 and not self._stamps.explicit:
            return 0 if abs(expected) <= AT_ZERO_NS else expected
        same_clock = stamp_ns is not None and abs(stamp_ns - expected) < OTHER_CLOCK
        return stamp_ns if stamp_ns is not None and same_clock else expected

    def _unstamped(self, log_time_ns: int, stamp_ns: int | None) -> int | None:
        """Return the simulation time of a message with a missing time stamp, or with a stamp of 0; ns."""
        while self._at < len(self._runs) and self._runs[self._at].last < self._number:
            self._at += 1
        run = self._runs[self._at] if self._at < len(self._runs) else None
        if run is None or run.first > self._number:
            return None  # This run was not stored.
        before, behind = run.before, run.behind
        if stamp_ns == 0 and self._is_time(before, behind):
            return 0
        if not self._stamps.logged:
            return self._placed(run, log_time_ns)
        if before is None and behind is None:
            before = self._clock
        return _between(log_time_ns, before, behind)

    def _placed(self, run: _Unstamped, log_time_ns: int) -> int | None:
        """In a file without log times, estimate a message's time from its position between two time stamps."""
        before, behind = run.before, run.behind
        if before is None:
            return None
        if behind is None or behind[1] < before[1]:
            return log_time_ns  # The time of the previous message.
        share = self._number - run.first + 1, run.last - run.first + 2
        return before[1] + (behind[1] - before[1]) * share[0] // share[1]

    def _is_time(self, before: Known | None, behind: Known | None) -> bool:
        """Return True if a time stamp of 0 is a real time; False if it means that the time is missing."""
        stamps = self._stamps
        if before is None and behind is None:
            return True  # Without another clock, 0 is a time.
        near = stamps.is_near(before) or stamps.is_near(behind)
        if stamps.explicit:
            return near
        begins = before is None or (behind is not None and behind[1] < before[1])
        return begins and stamps.is_near(behind)


def late_reason(count: int, first_ns: int) -> str:
    """Return as text why time stamps beyond :data:`LATEST_NS` count as missing."""
    year = 2262 if abs(first_ns) >= 1 << 63 else 2116
    when = f"after the year {year}" if first_ns > 0 else "before the year 1824"
    return f"{count} time stamps are {when} ({first_ns / 1e9:.6g} s): they count as missing"


def _valid(stamp_ns: int | None) -> int | None:
    return None if stamp_ns is None or abs(stamp_ns) >= LATEST_NS else stamp_ns


def _between(log_time_ns: int, before: Known | None, behind: Known | None) -> int:
    """Return the simulation time for a log time, from the time stamps before and after it; ns."""
    log, stamp = before or behind or (log_time_ns, log_time_ns)
    time_ns = log_time_ns - (log - stamp)
    if before is None or behind is None or before[1] <= time_ns <= behind[1]:
        return time_ns
    span = behind[0] - before[0]
    if behind[1] < before[1] or span <= 0:
        return time_ns
    return before[1] + (log_time_ns - before[0]) * (behind[1] - before[1]) // span
