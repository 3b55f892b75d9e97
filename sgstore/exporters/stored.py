"""From a store to files: which recordings clips are cut from, and clips around frames that are named."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.errors import ExportError
from sgstore.exporters import exporter_named
from sgstore.exporters.clips import (
    WrittenClip,
    WrittenFile,
    export_folder,
    provenance_of,
    write_file_manifest,
    write_manifest,
)
from sgstore.exporters.export import Export
from sgstore.exporters.labels import Labels
from sgstore.matches import merged
from sgstore.world import Clip

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from sgstore.exporters import Exporter
    from sgstore.query import Store

OPTIONS: Final = {
    "abstraction": "abstraction",
    "with_graph": "with-graph",
    "channels": "channel",
    "clouds": "clouds",
}
"""Options of an export that only some formats mind, and what the command line calls them."""


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


def labelled(export: Export, texts: Mapping[str, str], **parameters: object) -> Export:
    """An export with labels for the frames of its clips.

    Parameters
    ----------
    export : Export
    texts : mapping
        Name → expression or query; see :mod:`sgstore.exporters.labels`.
    **parameters
        Values of ``$name`` in them.

    Raises
    ------
    QueryError, ExportError
        A text is neither an expression nor a query, or has several values in a frame.
    """
    if not texts:
        return export
    frame_id = np.concatenate([frames.frame_id for frames in export.frames()])
    return replace(export, labels=Labels.asked(export.store, texts, frame_id, **parameters))


def write_export(export: Export, to: Path, form: str = "mcap") -> list[WrittenClip | WrittenFile]:
    """Write clips of a store, all of it or nothing.

    Parameters
    ----------
    export : Export
    to : Path
        Folder; made if it does not exist, and nothing in it is overwritten.
    form : str
        Name of an exporter.

    Returns
    -------
    list of WrittenClip or WrittenFile
        What is there now, without the manifest.

    Raises
    ------
    ExportError, TraceError
        As the exporter says, there is no such format, or it does not mind an option; then nothing is written.
    """
    exporter = exporter_named(form)
    _check(export, exporter)
    told = replace(export, provenance=provenance_of(dict(export.provenance)))
    with told.store.file.snapshot(), export_folder(to) as folder:
        written = list(exporter.write(told, folder))
        clips = [one for one in written if isinstance(one, WrittenClip)]
        files = [one for one in written if isinstance(one, WrittenFile)]
        if clips and not files:
            write_manifest(folder, clips)
        else:
            write_file_manifest(folder, {"form": form, **told.about()}, files)
    return [replace(one, file=to / one.file.name) for one in written]


def _check(export: Export, exporter: Exporter) -> None:
    for option in fields(Export):
        name = option.name
        if name not in OPTIONS or name in exporter.options:
            continue
        if getattr(export, name) != option.default:
            told = f"--{OPTIONS[name]}"
            raise ExportError(f"{told} is not for the format '{exporter.name}'")
    for clip in export.clips:
        if clip.start_ns > clip.end_ns:
            raise ExportError(
                f"a clip of {clip.trace!r} ends at {clip.end_ns} ns, before its start"
            )


def write_stored(
    store: Store, clips: Sequence[Clip], to: Path, *, form: str = "mcap", query: str = ""
) -> list[WrittenClip]:
    """Cut clips out of the recordings of a store; :func:`write_export` without options.

    Parameters
    ----------
    store : Store
    clips : sequence of Clip
    to : Path
        Folder; made if it does not exist, and nothing in it is overwritten.
    form : str
        Name of an exporter of clips.
    query : str
        What found them; kept with every clip.

    Raises
    ------
    ExportError, TraceError
        As the exporter says; then nothing is written.
    """
    provenance = {"query": query} if query else {}
    written = write_export(Export(store, tuple(clips), provenance=provenance), to, form)
    return [one for one in written if isinstance(one, WrittenClip)]
