"""Events of a trace → rows, each with the frame that is nearest in time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.store.packing import frame_ids, texts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.store.packing import Columns
    from sgstore.world import Event, FrameBlock, Ints

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
