"""Channels of a recording and places of its messages, as a trace refers to them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.traces.chunks import IDS
from sgstore.world import Channel, MessageRefs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sgstore.traces.chunks import Messages
    from sgstore.traces.recording import Recording

Ref = tuple[int, int, int, int, int]
"""Channel id, log time, chunk offset, offset, length."""


def ref_of(run: Messages, row: int) -> Ref:
    """Where one message of a run stands."""
    return (
        int(run.channel[row]),
        int(run.log_time_ns[row]),
        run.chunk_offset,
        int(run.offset[row]),
        int(run.length[row]),
    )


def refs_of(refs: Iterable[Ref], channels: tuple[Channel, ...]) -> MessageRefs:
    """References as columns, in file order; each once."""
    index = {channel.id: i for i, channel in enumerate(channels)}
    ordered = sorted(set(refs), key=lambda ref: (ref[2] if ref[2] >= 0 else ref[3], ref[3]))
    columns = np.array(ordered, np.int64).reshape(-1, 5).T
    channel = np.array([index[int(number)] for number in columns[0]], np.int64)
    return MessageRefs(channel, columns[1], columns[2], columns[3], columns[4])


def channels_of(recording: Recording, role: Callable[[int], str]) -> tuple[Channel, ...]:
    """The channels of a recording in order of their ids; ``role``: that of a channel, by its id."""
    counts = recording.counts or {}
    channels: list[Channel] = []
    for number, record in sorted(recording.channels.items()):
        schema = recording.schemas.get(record.schema_id)
        channels.append(
            Channel(
                id=number,
                topic=record.topic,
                schema=schema.name if schema else "",
                schema_encoding=schema.encoding if schema else "",
                message_encoding=record.message_encoding,
                messages=counts.get(number, 0 if counts else -1),
                role=role(number),
            )
        )
    return tuple(channels)


class FrameRefs:
    """References of the messages that belong to frames.

    Parameters
    ----------
    channels : tuple of Channel
    window : tuple of int
        Log times, both included; what a clip carries in from outside them belongs to no frame.

    Notes
    -----
    Messages of channels whose role is neither ``ground_truth`` nor ``payload`` last, and belong to none.
    """

    def __init__(self, channels: tuple[Channel, ...], window: tuple[int, int]) -> None:
        self._window = window
        self._index = np.full(IDS, -1, np.int64)
        for i, channel in enumerate(channels):
            if channel.role in {"ground_truth", "payload"}:
                self._index[channel.id] = i

    def __call__(self, run: Messages) -> MessageRefs:
        """Those of a run of messages."""
        start, end = self._window
        channel = self._index[run.channel]
        kept = (channel >= 0) & (run.log_time_ns >= start) & (run.log_time_ns <= end)
        chunk = np.full(int(kept.sum()), run.chunk_offset, np.int64)
        return MessageRefs(
            channel[kept], run.log_time_ns[kept], chunk, run.offset[kept], run.length[kept]
        )
