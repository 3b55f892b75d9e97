"""Frames with very many objects: blocks are split, and frames with too many object pairs are recorded."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.tables import taken
from sgstore.graphs.relations._pairs import AT_ONCE, MOST_PAIRS
from sgstore.graphs.relations._scene import IS_SIGNAL
from sgstore.mcap import Loss

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sgstore.model.config import Config
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import Codes, FrameBlock, Ints

    Rows = NDArray[np.intp]


NEAR: Final = "near"

TOUCHING: Final = "touching"

_WIDEST: Final = 1 << 20
"""Largest number of a grid cell. All positions beyond it share this cell."""


def pieces(frames: FrameBlock, kinds: Codes, config: Config, egos: int) -> Iterator[FrameBlock]:
    """Split a block of frames into parts with fewer object pairs, to limit memory. Usually, one part is enough.

    Parameters
    ----------
    frames : FrameBlock
    kinds : int8
        Kinds of all entities by node id, including those of the block.
    config : Config
    egos : int
        Number of graphs made of each frame.

    Yields
    ------
    FrameBlock
        The first one has the new entities, messages and events of the block.
    """
    most = max(AT_ONCE // max(egos, 1), 1)
    node = frames.states.node
    known = (node >= 0) & (node < len(kinds))  # the generator rejects unknown nodes later
    rows = np.flatnonzero(known)
    rows = rows[~IS_SIGNAL[kinds[node[rows]]]]
    count = np.bincount(frames.frame_of[rows], minlength=len(frames)).astype(np.int64)
    pairs = count * count // 2
    if int(pairs.sum()) > most:
        pairs = np.minimum(pairs, _neighbours(frames, rows, config))
    if int(pairs.sum()) <= most:
        yield frames
        return
    start = 0
    total = np.cumsum(pairs)
    while start < len(frames):
        before = int(total[start - 1]) if start else 0
        stop = max(int(np.searchsorted(total, before + most, side="right")), start + 1)
        yield _part(frames, start, stop)
        start = stop


def _neighbours(frames: FrameBlock, rows: Rows, config: Config) -> Ints:
    """For each frame, return an upper bound for the number of near object pairs, (F,)."""
    states = frames.states
    reach = max(config.pairs.within, 1.0)
    size = np.nan_to_num(np.hypot(states.length, states.width)[rows])
    reach += float(size.max(initial=0))  # touching bodies are also within reach
    cells = [
        np.clip(np.nan_to_num(np.floor(column[rows] / reach)), 2 - _WIDEST, _WIDEST - 2) + _WIDEST
        for column in (states.x, states.y)
    ]
    x, y = (cell.astype(np.int64) for cell in cells)
    frame = frames.frame_of[rows]
    wide = 2 * _WIDEST
    key = (frame * wide + x) * wide + y
    held, count = np.unique(key, return_counts=True)
    around = np.zeros(len(held), np.int64)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            other = held + dx * wide + dy
            at = np.minimum(np.searchsorted(held, other), len(held) - 1)
            around += np.where(held[at] == other, count[at], 0)
    of = held // (wide * wide)
    return np.bincount(of, weights=count * around / 2, minlength=len(frames)).astype(np.int64)


def _part(frames: FrameBlock, start: int, stop: int) -> FrameBlock:
    """Return a range of frames of a block. Only the first range keeps new objects, messages and events."""
    first, last = int(frames.offsets[start]), int(frames.offsets[stop])
    entities, scenery, messages = frames.entities, frames.scenery, frames.messages
    events = frames.events
    if start:
        none = np.zeros(0, np.intp)
        first_new = entities.first + len(entities)
        entities = replace(taken(entities, none), first=first_new)
        scenery, messages, events = scenery.take(none), taken(messages, none), ()
    return replace(
        frames,
        seq=frames.seq[start:stop],
        time_ns=frames.time_ns[start:stop],
        log_time_ns=frames.log_time_ns[start:stop],
        offsets=frames.offsets[start : stop + 1] - first,
        states=frames.states.take(np.arange(first, last)),
        ego=frames.ego[start:stop],
        entities=entities,
        scenery=scenery,
        messages=messages,
        events=events,
    )


class Crowds:
    """Record of the frames in a trace that have too many object pairs."""

    def __init__(self) -> None:
        self._found: dict[str, tuple[int, int, int, Loss]] = {}

    def see(self, graph: GraphBlock) -> None:
        """Record the frames of a block that have too many object pairs."""
        for what, frame, bodies in graph.crowded:
            time = int(graph.frames.log_time_ns[frame])
            count, seq, most, loss = self._found.get(what) or (
                *(0, int(graph.frames.seq[frame]), bodies),
                Loss("", start_ns=time, end_ns=time),
            )
            span = Loss("", start_ns=min(loss.start_ns, time), end_ns=max(loss.end_ns, time))
            self._found[what] = count + 1, seq, most, span

    def losses(self, config: Config) -> list[Loss]:
        """Return report entries for object pairs that were left out in crowded frames."""
        found: list[Loss] = []
        for what, (count, seq, bodies, span) in self._found.items():
            if what == NEAR:
                of = f"are within {config.pairs.within:g} m of one another ('pairs.within')"
                told = "proximity and direction are computed for the ego only"
            else:
                of, told = "touch one another", "contact is computed for the ego only"
            more = f", and {count - 1} more frames like it" if count > 1 else ""
            reason = (
                f"frame {seq} has {bodies:,} bodies, of which more than {MOST_PAIRS:,} pairs {of}:"
                f" {told}{more}"
            )
            found.append(Loss(reason, start_ns=span.start_ns, end_ns=span.end_ns))
        return found
