"""Sensor messages and events of frames.

Which message of each channel belongs to a frame, and where it stands.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import StoreError
from sgstore.store._packing import frame_ids, texts
from sgstore.vocabulary import suggestion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from duckdb import DuckDBPyConnection

    from sgstore.config import Payloads
    from sgstore.store._packing import Columns
    from sgstore.store._traces import FrameRef
    from sgstore.world import Channel, Event, FrameBlock, Ints


_SAMPLE: Final = 8192
"""Messages from which the period of a channel is told: its first ones, so that memory stays bounded."""

JOIN: Final = """
WITH wanted AS (
  SELECT f.bucket, f.bit, f.log_time_ns, c.channel_id, c.tolerance_ns
  FROM frame f CROSS JOIN tolerance c),
said AS (  -- of messages of one time the last one in the file
  SELECT channel, log_time_ns,
         max(struct_pack(chunk_offset := chunk_offset, "offset" := "offset", length := length)) AS place
  FROM {messages} GROUP BY ALL),
found AS (
  SELECT w.*, b.log_time_ns AS before_ns, b.place AS before, a.log_time_ns AS after_ns, a.place AS after
  FROM wanted w
    ASOF LEFT JOIN said b ON b.channel = w.channel_id AND b.log_time_ns <= w.log_time_ns
    ASOF LEFT JOIN said a ON a.channel = w.channel_id AND a.log_time_ns >= w.log_time_ns),
chosen AS (
  SELECT *, $nearest
         AND coalesce(after_ns - log_time_ns < log_time_ns - before_ns, after_ns IS NOT NULL) AS later
  FROM found),
joined AS (
  SELECT bucket, bit, channel_id, log_time_ns AS frame_ns, tolerance_ns,
         CASE WHEN later THEN after_ns ELSE before_ns END AS log_time_ns,
         CASE WHEN later THEN after ELSE before END AS place
  FROM chosen)
SELECT bucket, bit, bucket >> 18 AS trace_id, channel_id, log_time_ns,
       place.chunk_offset AS chunk_offset, place."offset" AS "offset", place.length AS length
FROM joined WHERE abs(log_time_ns - frame_ns) <= tolerance_ns
"""
"""Messages of sensors: the nearest in log time, the earlier of two that are equally near; or the latest."""

OWN: Final = """
SELECT f.bucket, f.bit, f.bucket >> 18, m.channel, m.log_time_ns, m.chunk_offset, m."offset", m.length
FROM (SELECT *, row_number() OVER (PARTITION BY log_time_ns ORDER BY frame_id) AS turn FROM frame) f
JOIN (SELECT *, row_number() OVER (PARTITION BY log_time_ns ORDER BY chunk_offset, "offset") AS turn
      FROM {messages} WHERE channel IN (SELECT unnest($leading))) m
  ON m.log_time_ns = f.log_time_ns AND m.turn = f.turn
"""
"""The messages that frames are: of frames of one time the first is the first message, and so on."""


@dataclass(slots=True)
class Periods:
    """Periods of channels, estimated from their first messages.

    Attributes
    ----------
    times : dict
        Channel id → log times of its first messages, in pieces; ns. -1: the frames themselves.
    counts : dict
        Channel id → how many these are.
    """

    times: dict[int, list[Ints]] = field(default_factory=dict[int, "list[Ints]"])
    counts: dict[int, int] = field(default_factory=dict[int, int])

    def see(self, channel: int, log_time_ns: Ints) -> None:
        """Take note of messages."""
        count = self.counts.get(channel, 0)
        if count <= _SAMPLE and len(log_time_ns):
            piece = log_time_ns[: _SAMPLE + 1 - count]
            self.times.setdefault(channel, []).append(piece)
            self.counts[channel] = count + len(piece)

    def of(self, channel: int) -> float:
        """Median difference of log times; ns. 0 if there are fewer than two messages."""
        times = np.sort(np.concatenate(self.times.get(channel, [np.zeros(0, np.int64)])))
        return float(np.median(np.diff(times))) if len(times) > 1 else 0.0


FRAMES: Final = -1
"""The frames themselves, as a channel of :class:`Periods`."""


def join(
    connection: DuckDBPyConnection,
    messages: str,
    channels: tuple[Channel, ...],
    periods: Periods,
    settings: Payloads,
) -> None:
    """Fill the table ``payload`` of a trace; ``messages`` is a statement that gives all that were seen."""
    nearest, said = settings.join == "nearest", f"({messages})"
    connection.execute(
        "CREATE OR REPLACE TEMP TABLE tolerance (channel_id INTEGER, tolerance_ns BIGINT)"
    )
    leading = [c.id for c in channels if c.role == "ground_truth"]
    sensors = [c.id for c in channels if c.role == "payload"]
    if sensors:
        for channel in sensors:
            allowed = tolerance_ns(periods, channel, settings)
            connection.execute("INSERT INTO tolerance VALUES (?, ?)", [channel, allowed])
        connection.execute(
            f"INSERT INTO payload BY NAME {JOIN.format(messages=said)}", {"nearest": nearest}
        )
    connection.execute(f"INSERT INTO payload {OWN.format(messages=said)}", {"leading": leading})


def tolerance_ns(periods: Periods, channel: int, settings: Payloads) -> int:
    """Greatest difference of log times between a frame and its message; ns."""
    if settings.tolerance:
        return round(settings.tolerance * 1e9)
    period = max(periods.of(channel), periods.of(FRAMES))
    return int(period / 2 if settings.join == "nearest" else period)


def payload_place(
    connection: DuckDBPyConnection, frame: FrameRef, channel: str
) -> tuple[int, int, int, int]:
    """Channel's id, chunk offset, offset and length of the message of a channel that belongs to a frame.

    Raises
    ------
    StoreError
        There is none; it says why.
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
        hint = f"did you mean {like!r}?" if like else f"there are: {', '.join(map(repr, roles))}"
        return StoreError(f"no channel {channel!r} in {frame.trace!r}; {hint}")
    reason = "no message near enough in time"
    if roles[channel] == "map":
        reason = "it holds the map, which belongs to all frames"
    return StoreError(f"no message of {channel!r} belongs to {frame.trace}#{frame.seq}: {reason}")


# Events of a trace → rows, each with the frame that is nearest in time --------------------------

FAR_NS: Final = 1_000_000_000
"""An event whose simulation time is farther than this from all frames near it goes by log time instead."""
MOST_WAITING: Final = 10_000
"""Events that wait for the frames to come."""

_PIECE: Final = 4096


class Happenings:
    """The events of one trace, block after block.

    Parameters
    ----------
    trace_id : int

    Notes
    -----
    An event that happened after all frames so far may belong to the next one, and waits for it.
    """

    def __init__(self, trace_id: int) -> None:
        self._trace_id = trace_id
        self._waiting: list[Event] = []
        self._last = np.zeros(
            (3, 0), np.int64
        )  # the last frame so far: simulation time, log time, id

    def of(self, frames: FrameBlock) -> Columns:
        """Table ``event``, as far as it can be told when these frames are known."""
        ids = frame_ids(self._trace_id, frames.seq)
        known = np.hstack([self._last, np.stack([frames.time_ns, frames.log_time_ns, ids])])
        self._last = known[:, -1:]
        events = [*self._waiting, *frames.events]
        frame = _nearest(events, known[0], known[1])
        waits = frame == known.shape[1] - 1
        if len(events) > MOST_WAITING:
            waits[:] = False
        self._waiting = [event for event, wait in zip(events, waits, strict=True) if wait]
        told = [event for event, wait in zip(events, waits, strict=True) if not wait]
        return _columns(told, known[2][frame[~waits]])

    def rest(self) -> Columns:
        """The same of events for which no other frame came."""
        events, self._waiting = self._waiting, []
        return _columns(events, self._last[2][np.zeros(len(events), np.intp)])


def _nearest(events: Sequence[Event], time_ns: Any, log_time_ns: Any) -> Ints:
    """For each event the row of the nearest frame; of two that are as near the first."""
    found: list[Ints] = [np.zeros(0, np.int64)]
    for start in range(0, len(events), _PIECE):
        some = events[start : start + _PIECE]
        apart = np.abs(np.array([event.time_ns for event in some])[:, None] - time_ns)
        row = apart.argmin(axis=1)
        far = apart[np.arange(len(row)), row] > FAR_NS
        logged = np.abs(np.array([event.log_time_ns for event in some])[:, None] - log_time_ns)
        found.append(np.where(far, logged.argmin(axis=1), row))
    return np.concatenate(found)


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
    }
