"""Frame ids: trace id, bucket number (60 frames) and frame number in the bucket, in one integer.

Also the text form of a range of frames.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.model.world import BUCKET_FRAMES

if TYPE_CHECKING:
    from sgstore.model.world import Bools, Ints


BUCKET_BITS: Final = 18
"""Number of bits of a bucket number within a trace."""

FRAME_BITS: Final = 6
"""Number of bits of a frame number within a bucket."""

MAX_FRAMES: Final = BUCKET_FRAMES << BUCKET_BITS
"""Largest number of frames of a trace."""

SEQ_BITS: Final = BUCKET_BITS + FRAME_BITS
"""Number of bits of a frame id below its trace id."""


def trace_bucket(trace_id: int | Ints, seq: Ints) -> Ints:
    """Return the bucket number (group of 60 frames) of each frame number of a trace."""
    return (trace_id << BUCKET_BITS) + seq // BUCKET_FRAMES


def frame_ids(trace_id: int | Ints, seq: Ints) -> Ints:
    """Return the frame id of each frame number of a trace."""
    return (trace_bucket(trace_id, seq) << FRAME_BITS) + seq % BUCKET_FRAMES


def frames_of(bucket: Ints, mask: Ints) -> tuple[Ints, Ints]:
    """Convert bit masks of 60 frames each to frame ids. Also return the row of the mask for each id."""
    ids: list[Ints] = []
    rows: list[Ints] = []
    for bit in range(BUCKET_FRAMES):
        row = np.flatnonzero(mask >> bit & 1)
        ids.append((bucket[row] << FRAME_BITS) + bit)
        rows.append(row)
    return np.concatenate(ids), np.concatenate(rows)


def trace_of(frame_id: Ints) -> Ints:
    """Return the trace id that is part of each frame id."""
    return frame_id >> SEQ_BITS


def seq_of(frame_id: Ints) -> Ints:
    """Return the frame number (in its trace) that is part of each frame id."""
    bucket = (frame_id >> FRAME_BITS) & ((1 << BUCKET_BITS) - 1)
    return bucket * BUCKET_FRAMES + (frame_id & ((1 << FRAME_BITS) - 1))


def begins(frame_id: Ints) -> Bools:
    """Return a mask (N,): True if a frame does not directly follow the frame in the previous row."""
    trace, seq = trace_of(frame_id), seq_of(frame_id)
    found = np.ones(len(frame_id), np.bool_)
    found[1:] = (trace[1:] != trace[:-1]) | (seq[1:] != seq[:-1] + 1)
    return found


_RANGE: Final = re.compile(r"(.+)([@#])(\d+(?:\.\d+)?s?)\.\.(\d+(?:\.\d+)?s?)")


def range_of(text: str) -> tuple[str, str] | None:
    """Parse a text of a frame range, ``TRACE@12s..18s`` or ``TRACE#120..180``; ``None`` for a single frame.

    >>> range_of("town@12.5s..18s")
    ('town@12.5s', 'town@18s')
    >>> range_of("town#120..180"), range_of("town#120")
    (('town#120', 'town#180'), None)
    """
    found = _RANGE.fullmatch(text.strip())
    if found is None:
        return None
    trace, mark, first, last = found.groups()
    unit = "s" if mark == "@" else ""
    first, last = (f"{trace}{mark}{end.removesuffix('s')}{unit}" for end in (first, last))
    return first, last
