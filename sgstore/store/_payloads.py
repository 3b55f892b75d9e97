"""Assignment of sensor messages and events to frames.

The tables hold the message of each channel at a frame, and its file position.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.display import excerpts
from sgstore.errors import StoreError
from sgstore.model.frame_ids import frame_ids
from sgstore.model.vocabulary import suggestion
from sgstore.model.world import nearest_frames
from sgstore.store._columns import chained
from sgstore.store._packing import texts

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from duckdb import DuckDBPyConnection

    from sgstore.model.config import Payloads
    from sgstore.model.world import Channel, Event, FrameBlock, Ints
    from sgstore.store._packing import Columns
    from sgstore.store._traces import FrameRef


_SAMPLE: Final = 8192
"""Number of first messages from which the period of a channel is estimated."""


@dataclass(slots=True)
class Periods:
    """Median time between messages of each channel, estimated from the first messages.

    Attributes
    ----------
    times : dict
        Channel id → log times of its first messages, in pieces; ns. -1: the frames themselves.
    counts : dict
        Channel id → number of these messages.
    """

    times: dict[int, list[Ints]] = field(default_factory=dict[int, "list[Ints]"])
    counts: dict[int, int] = field(default_factory=dict[int, int])

    def see(self, channel: int, log_time_ns: Ints) -> None:
        """Add message times of a channel to the estimate of its period."""
        count = self.counts.get(channel, 0)
        if count <= _SAMPLE and len(log_time_ns):
            piece = log_time_ns[: _SAMPLE + 1 - count]
            self.times.setdefault(channel, []).append(piece)
            self.counts[channel] = count + len(piece)

    def of(self, channel: int) -> float:
        """Return the median time between messages of a channel; ns. With fewer than two messages, it is 0."""
        times = np.sort(np.concatenate(self.times.get(channel, [np.zeros(0, np.int64)])))
        return float(np.median(np.diff(times))) if len(times) > 1 else 0.0


FRAMES: Final = -1
"""Number that stands for the frames in place of a channel number in :class:`Periods`."""

_AT_ONCE: Final = 250_000
"""Largest number of messages of a channel that are in memory at once."""

_PLACE: Final = ("log_time_ns", "chunk_offset", "offset", "length")


def joined(
    frames: FrameTimes,
    messages: Callable[[], Iterable[Columns]],
    channels: tuple[Channel, ...],
    periods: Periods,
    settings: Payloads,
) -> Iterator[Columns]:
    """Yield rows of the store table ``payload``: the message of each channel at each frame.

    Parameters
    ----------
    frames : FrameTimes
    messages : callable
        Function that returns all messages in groups.
    """
    own = _own(frames, messages, [c.id for c in channels if c.role == "ground_truth"])
    rows_of = {
        number: np.flatnonzero(own["channel"] == number)
        for number in np.unique(own["channel"]).tolist()
    }
    sensors = {c.id for c in channels if c.role == "payload"}
    for number in sorted({*rows_of, *sensors}):
        if number in sensors:
            allowed = tolerance_ns(periods, number, settings)
            nearest = settings.join == "nearest"
            found = _chosen(frames, _messages_of(messages, [number]), allowed, nearest=nearest)
        else:
            found = {name: values[rows_of[number]] for name, values in own.items()}
        count = len(found["frame"])
        yield {
            "seq": found["frame"],
            "channel_id": np.full(count, number),
            **{name: found[name] for name in _PLACE},
        }


class FrameTimes:
    """Log times of a trace's frames, and the indices that sort them.

    Parameters
    ----------
    log_time_ns : (F,) int64
    """

    def __init__(self, log_time_ns: Ints) -> None:
        self.order = np.argsort(log_time_ns, kind="stable")
        self.time = log_time_ns[self.order]


def _messages_of(
    messages: Callable[[], Iterable[Columns]], numbers: list[int]
) -> Iterator[Columns]:
    """Yield the recorded messages of some channels, in groups that fit into memory."""
    waiting: list[Columns] = []
    for some in messages():
        rows = np.flatnonzero(np.isin(some["channel"], numbers))
        if len(rows):
            waiting.append({name: values[rows] for name, values in some.items()})
        if sum(len(one["channel"]) for one in waiting) >= _AT_ONCE:
            yield chained("message", waiting)
            waiting = []
    if waiting:
        yield chained("message", waiting)


def _own(
    frames: FrameTimes, messages: Callable[[], Iterable[Columns]], leading: list[int]
) -> Columns:
    """Return the ground-truth message from which each frame was read.

    Frames of equal time keep the order of the messages.
    """
    parts = list(_messages_of(messages, leading))
    if not parts:
        return {name: np.zeros(0, np.int64) for name in ("frame", "channel", *_PLACE)}
    said = chained("message", parts)
    order = np.lexsort((said["offset"], said["chunk_offset"], said["channel"], said["log_time_ns"]))
    said = {name: values[order] for name, values in said.items()}
    turn = np.arange(len(frames.time)) - np.searchsorted(frames.time, frames.time)
    at = np.searchsorted(said["log_time_ns"], frames.time) + turn
    there = np.flatnonzero(at < len(order))
    there = there[said["log_time_ns"][at[there]] == frames.time[there]]
    frame = frames.order[there]
    ascending = np.argsort(frame)
    found = {name: values[at[there]][ascending] for name, values in said.items()}
    return found | {"frame": frame[ascending]}


def _chosen(
    frames: FrameTimes, messages: Iterable[Columns], allowed: int, *, nearest: bool
) -> Columns:
    """Choose a sensor message for each frame: the nearest one or the latest earlier one by log time.

    Among messages of equal time, the last one in the file counts.
    """
    before = after = _none(len(frames.time))
    for some in messages:
        order = np.lexsort(tuple(some[name] for name in reversed(_PLACE)))
        said = np.stack([some[name][order] for name in _PLACE])
        last = np.append(said[0, 1:] != said[0, :-1], True)
        said = np.hstack([said[:, last], _none(1)])  # and one placeholder for "no message"
        time = said[0, :-1]
        below = np.searchsorted(time, frames.time, side="right") - 1
        above = np.searchsorted(time, frames.time)
        before = _better(before, said[:, below], later=True)
        after = _better(after, said[:, above], later=False)
    known, coming = before[3] >= 0, after[3] >= 0
    late = coming & (~known | (after[0] - frames.time < frames.time - before[0])) & nearest
    chosen = np.where(late, after, before)
    rows = np.flatnonzero((chosen[3] >= 0) & (np.abs(chosen[0] - frames.time) <= allowed))
    frame = frames.order[rows]
    ascending = np.argsort(frame)
    places = chosen[:, rows[ascending]]
    return {"frame": frame[ascending]} | dict(zip(_PLACE, places, strict=True))


def _none(count: int) -> Ints:
    return np.full((len(_PLACE), count), -1, np.int64)


def _better(one: Ints, other: Ints, *, later: bool) -> Ints:
    """For each frame, choose the later or earlier of two messages by log time, then by file position.

    At equal times, the message with the later file position is chosen.
    """
    further = np.zeros(one.shape[1], np.bool_)
    same = np.ones(one.shape[1], np.bool_)
    for mine, theirs in zip(one[1:], other[1:], strict=True):
        further |= same & (theirs > mine)
        same &= theirs == mine
    sooner = other[0] > one[0] if later else other[0] < one[0]
    wins = sooner | ((other[0] == one[0]) & further)
    return np.where((other[3] >= 0) & ((one[3] < 0) | wins), other, one)


def tolerance_ns(periods: Periods, channel: int, settings: Payloads) -> int:
    """Return the largest accepted log time difference between a frame and its sensor message; ns."""
    if settings.tolerance:
        return round(settings.tolerance * 1e9)
    period = max(periods.of(channel), periods.of(FRAMES))
    return int(period / 2 if settings.join == "nearest" else period)


def payload_place(
    connection: DuckDBPyConnection, frame: FrameRef, channel: str
) -> tuple[int, int, int, int]:
    """Return channel id, chunk offset, offset and length of a channel's message at a frame.

    Raises
    ------
    StoreError
        The message is missing; the error names the reason.
    """
    found = connection.execute(
        """
        SELECT p.channel_id, p.chunk_offset, p."offset", p.length
        FROM frame f JOIN payload p ON p.bucket = f.bucket AND p.bit = f.bit
             JOIN channel c ON c.trace_id = f.trace_id AND c.channel_id = p.channel_id
        WHERE f.frame_id = ? AND c.topic = ? ORDER BY abs(p.log_time_ns - f.log_time_ns) LIMIT 1
        """,
        [frame.frame_id, channel],
    ).fetchone()
    if found is None:
        raise _no_payload(connection, frame, channel)
    return found


def _no_payload(connection: DuckDBPyConnection, frame: FrameRef, channel: str) -> StoreError:
    sql = "SELECT topic, role FROM channel WHERE trace_id = ? ORDER BY topic"
    roles = dict(connection.execute(sql, [frame.trace_id]).fetchall())
    if channel not in roles:
        like = suggestion(channel, [topic for topic in roles if topic])
        hint = f"did you mean {like!r}?" if like else f"there are: {excerpts([*map(repr, roles)])}"
        return StoreError(f"no channel {channel!r} in {frame.trace!r}; {hint}")
    reason = "no message near enough in time"
    if roles[channel] == "map":
        reason = "it holds the map, which belongs to all frames"
    return StoreError(f"no message of {channel!r} belongs to {frame.trace}#{frame.seq}: {reason}")


MOST_WAITING: Final = 100_000
"""Largest number of events that wait for their frame. Further events are assigned to the newest frame."""


class Happenings:
    """Events of one trace (such as collisions), assigned to the nearest frames block by block.

    Parameters
    ----------
    trace_id : int

    Notes
    -----
    An event after all frames so far can belong to the next frame, so it is held back.
    """

    def __init__(self, trace_id: int) -> None:
        self._trace_id = trace_id
        self._waiting: list[Event] = []
        self._last = np.zeros(
            (3, 0), np.int64
        )  # the last frame so far: simulation time, log time, id

    def of(self, frames: FrameBlock) -> Columns:
        """Assign events to the frames of a block, and return rows of the store table ``event``.

        Events that a later frame may be nearer to are held back.
        """
        ids = frame_ids(self._trace_id, frames.seq)
        known = np.hstack([self._last, np.stack([frames.time_ns, frames.log_time_ns, ids])])
        self._last = known[:, -1:]
        events = [*self._waiting, *frames.events]
        frame = nearest_frames(events, known[0], known[1])
        waits = frame == known.shape[1] - 1
        if waits.sum() > MOST_WAITING:
            waits[:] = False
        self._waiting = [event for event, wait in zip(events, waits, strict=True) if wait]
        told = [event for event, wait in zip(events, waits, strict=True) if not wait]
        return _columns(told, known[2][frame[~waits]])

    def rest(self) -> Columns:
        """Assign all waiting events to the last frame, and return them as rows of the table ``event``."""
        events, self._waiting = self._waiting, []
        return _columns(events, self._last[2][np.zeros(len(events), np.intp)])


def _columns(events: Sequence[Event], frame_id: Ints) -> Columns:
    value = [np.nan if event.value is None else event.value for event in events]
    return {
        "frame_id": frame_id,
        "time_ns": np.array([event.time_ns for event in events], np.int64),
        "log_time_ns": np.array([event.log_time_ns for event in events], np.int64),
        "kind": texts(event.kind for event in events),
        "ident": texts(event.ident for event in events),
        "other": texts(event.other for event in events),
        "value": np.array(value, np.float64),
        "detail": texts(event.detail for event in events),
        "lifetime": np.array([event.lifetime for event in events], np.int64),
        "other_lifetime": np.array([event.other_lifetime for event in events], np.int64),
    }
