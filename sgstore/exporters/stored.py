"""From a store to files: which recordings clips are cut from, and clips around frames that are named."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sgstore.exporters import Source, exporter_named
from sgstore.matches import merged
from sgstore.world import Clip

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from sgstore.exporters import WrittenClip
    from sgstore.query import Store


def around_frames(
    store: Store, frames: Iterable[int | str], before: float, after: float
) -> list[Clip]:
    """Clips around frames; those that overlap are one.

    Parameters
    ----------
    store : Store
    frames : iterable
        ``frame_id``, ``TRACE#SEQ`` or ``TRACE@12.3s`` each.
    before, after : float
        What is added at both ends; s.

    Raises
    ------
    StoreError
        There is no such frame.
    """
    found = (store.file.frame(frame) for frame in frames)
    clips = (
        Clip(f.trace, f.log_time_ns - round(before * 1e9), f.log_time_ns + round(after * 1e9))
        for f in found
    )
    return list(merged(sorted(clips, key=lambda clip: (clip.trace, clip.start_ns))))


def write_stored(
    store: Store, clips: Sequence[Clip], to: Path, *, form: str = "mcap", query: str = ""
) -> list[WrittenClip]:
    """Cut clips out of the recordings of a store.

    Parameters
    ----------
    store : Store
    clips : sequence of Clip
    to : Path
        Folder; made if it does not exist, and nothing in it is overwritten.
    form : str
        Name of an exporter.
    query : str
        What found them; kept with every clip.

    Raises
    ------
    ExportError, TraceError
        As the exporter says; then nothing is written.
    """
    sources = {
        name: Source(trace.path, trace.digest, store.file.context(name))
        for name in dict.fromkeys(clip.trace for clip in clips)
        for trace in [store.file.trace(name)]
    }
    provenance = {"query": query} if query else {}
    return exporter_named(form).write_clips(clips, sources, to, provenance=provenance)
