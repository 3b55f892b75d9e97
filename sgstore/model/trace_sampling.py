"""Selection of frames of a trace: a time span, and a lower frame rate.

The selected frames get new numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.tables import chained, taken
from sgstore.errors import TraceError
from sgstore.model.world import TOLERANCE_NS, FrameBlock

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.model.world import Bools, Ints


_NONE: Final = np.zeros(0, np.intp)

MAX_MESSAGES: Final = 200_000
"""Largest number of message references that wait in an incomplete block."""

_SLACK_NS: Final = TOLERANCE_NS
"""Time by which a frame may be too early for its step, because simulators round their clocks; ns."""
_SLACK: Final = _SLACK_NS / 1e9
"""The tolerance for early frames in seconds. It also applies at both ends of the selected part."""


@dataclass(frozen=True, slots=True)
class TracePart:
    """Selected part of a trace: a time span and a frame rate to reduce it to.

    Attributes
    ----------
    since, until : float or None
        The part begins with the first frame at or after ``since``. It ends before the first frame after
        ``until``. Seconds since the first frame of the recording.
    rate : float
        Frames per second: the first frame at or after each step of 1/rate. 0: all frames.
    """

    since: float | None = None
    until: float | None = None
    rate: float = 0.0

    def blocks(self, blocks: Iterator[FrameBlock], size: int) -> Iterator[FrameBlock]:
        """Yield the selected frames of a trace in blocks of ``size`` frames.

        The last block and blocks with many messages are smaller. Entities keep their node ids. Entities that
        appear only in dropped frames stay in the list of entities.

        Raises
        ------
        TraceError
            The part contains no frame.
        """
        if self == TracePart():
            yield from blocks
            return
        clock = _Clock(self)
        waiting, given = _KeptFrames(), 0
        for block in blocks:
            kept = clock.kept(block.time_ns)
            happened = tuple(event for event in block.events if clock.within(event.time_ns))
            waiting.add(replace(block, events=happened), kept)
            full = len(waiting) if waiting.messages > MAX_MESSAGES else len(waiting) // size * size
            if full:
                yield waiting.take(full, given)
                given += full
            if clock.over:
                break
        if len(waiting):
            yield waiting.take(len(waiting), given)
        elif not given:
            raise TraceError(f"no frame of it is in the part: it goes from 0 s to {clock.last:g} s")


class _Clock:
    """Selector of frames by time span and frame rate, one block of frames after another."""

    def __init__(self, part: TracePart) -> None:
        self._part = part
        self._zero: int | None = None
        self._step = -1
        self._begun = part.since is None
        self.last = 0.0
        self.over = False

    def within(self, time_ns: int) -> bool:
        """Return True if a time belongs to the selected part of a trace.

        Earlier frames must have been processed before.
        """
        since = (time_ns - (self._zero or 0)) / 1e9
        part = self._part
        return (
            (part.since or -math.inf) - _SLACK
            <= since
            <= (math.inf if part.until is None else part.until) + _SLACK
        )

    def kept(self, time_ns: Ints) -> Bools:
        """Return a mask of the frames in the time span that fit the lower frame rate."""
        part = self._part
        self._zero = int(time_ns[0]) if self._zero is None else self._zero
        since = (time_ns - self._zero) / 1e9
        self.last = float(since[-1])
        kept = np.ones(len(since), np.bool_)
        if part.rate:
            slack = (time_ns - self._zero + _SLACK_NS) / 1e9
            step = np.floor(slack * part.rate).astype(np.int64)
            # Also if the clock runs backwards: a different step is a different frame.
            kept = step != np.concatenate([[self._step], step[:-1]])
            self._step = int(step[-1])
        start = 0
        if not self._begun:
            found = np.flatnonzero(since >= (part.since or 0) - _SLACK)
            self._begun = bool(len(found))
            start = int(found[0]) if len(found) else len(kept)
            kept[:start] = False
        if part.until is not None:
            # A clock that runs backwards before the start of the part does not end the part.
            beyond = start + np.flatnonzero(since[start:] > part.until + _SLACK)
            self.over = bool(len(beyond))
            kept[int(beyond[0]) if len(beyond) else len(kept) :] = False
        return kept


class _KeptFrames:
    """Buffer of selected frames, with their messages, objects and events."""

    def __init__(self) -> None:
        self._blocks: list[FrameBlock] = []
        self._frames = 0
        self.messages = 0

    def __len__(self) -> int:
        return self._frames

    def add(self, block: FrameBlock, kept: Bools) -> None:
        if not self._frames:  # No frame refers to messages from so long before.
            self._blocks = [_without_messages(one) for one in self._blocks]
            self.messages = 0
        self._blocks.append(_selected(block, kept))
        self._frames += int(kept.sum())
        self.messages += len(block.messages)

    def take(self, count: int, first: int) -> FrameBlock:
        """Remove the first frames from the buffer, and return them as one block."""
        whole = _joined(self._blocks)
        now = _sliced(whole, 0, count)
        rest = _sliced(whole, count, len(whole))
        self._blocks = [_only_frames(_without_messages(rest))]
        self._frames -= count
        self.messages = 0
        return replace(now, seq=first + np.arange(count))


def _selected(block: FrameBlock, kept: Bools) -> FrameBlock:
    if kept.all():
        return block
    rows = np.flatnonzero(np.repeat(kept, np.diff(block.offsets)))
    counts = np.diff(block.offsets)[kept]
    return replace(
        block,
        seq=block.seq[kept],
        time_ns=block.time_ns[kept],
        log_time_ns=block.log_time_ns[kept],
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        states=block.states.take(rows),
        ego=block.ego[kept],
    )


def _sliced(block: FrameBlock, start: int, stop: int) -> FrameBlock:
    kept = np.zeros(len(block), np.bool_)
    kept[start:stop] = True
    return _selected(block, kept)


def _joined(blocks: list[FrameBlock]) -> FrameBlock:
    first = blocks[0]
    if len(blocks) == 1:
        return first
    shifts = np.cumsum([0, *(len(block.states) for block in blocks)])
    entities = [block.entities for block in blocks if len(block.entities)] or [first.entities]
    offsets = [block.offsets[:-1] + shift for block, shift in zip(blocks, shifts, strict=False)]
    return FrameBlock(
        seq=np.concatenate([block.seq for block in blocks]),
        time_ns=np.concatenate([block.time_ns for block in blocks]),
        log_time_ns=np.concatenate([block.log_time_ns for block in blocks]),
        offsets=np.concatenate([*offsets, shifts[-1:]]).astype(np.int64),
        states=chained([block.states for block in blocks]),
        ego=np.concatenate([block.ego for block in blocks]),
        entities=chained(entities),
        scenery=chained([block.scenery for block in blocks]),
        messages=chained([block.messages for block in blocks]),
        events=tuple(event for block in blocks for event in block.events),
        noise=first.noise,
    )


def _without_messages(block: FrameBlock) -> FrameBlock:
    return replace(block, messages=taken(block.messages, _NONE))


def _only_frames(block: FrameBlock) -> FrameBlock:
    entities = block.entities
    first = entities.first + len(entities)
    none = replace(taken(entities, _NONE), first=first)
    return replace(block, entities=none, scenery=taken(block.scenery, _NONE), events=())
