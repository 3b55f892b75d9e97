"""Export of clips from a store. Its files and manifest are written completely, or not at all."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError, SgstoreError
from sgstore.exporters._clip_frames import Export
from sgstore.exporters._clips import (
    WrittenClip,
    WrittenFile,
    export_folder,
    provenance_of,
    write_manifest,
)
from sgstore.exporters._labels import Labels
from sgstore.exporters._registry import EXPORTERS, exporter_named
from sgstore.matches import merged
from sgstore.model.vocabulary import natural
from sgstore.model.world import Clip, tolerance_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.exporters._registry import Exporter
    from sgstore.query import Store

_SEVERAL: Final = {"mounts": "mount", "channels": "channel"}
"""Options that can be repeated on the command line → their name there."""


def around_frames(
    store: Store, frames: Iterable[int | str], before: float, after: float
) -> list[Clip]:
    """Return clips around given frames. Overlapping clips are merged.

    Parameters
    ----------
    store : Store
    frames : iterable
        ``frame_id``, ``TRACE#SEQ`` or ``TRACE@12.3s`` each.
    before, after : float
        Time added at both ends; s.

    Raises
    ------
    StoreError
        A frame is missing.
    """
    found = [store.file.frame(frame) for frame in frames]
    clips = (
        Clip(f.trace, f.log_time_ns - round(before * 1e9), f.log_time_ns + round(after * 1e9))
        for f in found
    )
    periods = {one.name: tolerance_ns(one.period_ns) for one in store.info()}
    return list(
        merged(sorted(clips, key=lambda clip: (natural(clip.trace), clip.start_ns)), periods)
    )


def whole_clips(store: Store) -> list[Clip]:
    """Return a clip for each whole trace of a store."""
    found = store.file.rows(
        "SELECT trace, min(log_time_ns), max(log_time_ns) FROM frames GROUP BY trace"
    )
    return sorted((Clip(*row) for row in found), key=lambda clip: natural(clip.trace))


def labelled(export: Export, texts: Mapping[str, str], **parameters: object) -> Export:
    """Return an export with labels for the frames of its clips.

    Parameters
    ----------
    export : Export
    texts : mapping
        Name → expression or query; see :mod:`sgstore.exporters._labels`.
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


def write_export(
    export: Export, to: str | Path, form: str = "mcap"
) -> list[WrittenClip | WrittenFile]:
    """Write the clips of an export into a folder, completely or not at all.

    Parameters
    ----------
    export : Export
    to : str or Path
        Folder, created if missing; its files are not overwritten.
    form : str
        Name of an exporter.

    Returns
    -------
    list of WrittenClip or WrittenFile
        The written files, without the manifest.

    Raises
    ------
    ExportError, TraceError
        The exporter fails, the format is unknown, or it does not support an option. Then no file is
        written.
    """
    to, exporter = Path(to), exporter_named(form)
    _check(export, exporter)
    told = replace(export, provenance=provenance_of(dict(export.provenance)))
    with told.store.file.snapshot(), export_folder(to) as folder:
        written = _written(exporter, told, folder)
        clips = [one for one in written if isinstance(one, WrittenClip)]
        files = [one for one in written if isinstance(one, WrittenFile)]
        if clips and not files:
            content: dict[str, Any] = {"clips": [one.as_dict() for one in clips]}
            beside = sorted({*folder.iterdir()} - {one.file for one in clips})
            if beside:
                content["files"] = [WrittenFile.of(one, "layout", 1).as_dict() for one in beside]
            write_manifest(folder, "sgstore.clips", content)
        else:
            content = {"form": form, **told.about(), "files": [one.as_dict() for one in files]}
            write_manifest(folder, "sgstore.export", content)
    return [replace(one, file=to / one.file.name) for one in written]


def _written(exporter: Exporter, export: Export, folder: Path) -> list[WrittenClip | WrittenFile]:
    """Run an exporter. Its errors get the name of the format."""
    try:
        written: list[Any] = list(exporter.write(export, folder))
        odd = [one for one in written if not isinstance(one, WrittenClip | WrittenFile)]
        if odd:
            raise TypeError(f"expected WrittenClip or WrittenFile, got {odd[0]!r}")
    except SgstoreError:
        raise
    except Exception as fault:
        raise ExportError(f"the format {exporter.name!r} cannot be written: {fault!r}") from fault
    return written


def _check(export: Export, exporter: Exporter) -> None:
    some = frozenset[str]().union(*(one.options for one in EXPORTERS))
    for option in fields(Export):
        name = option.name
        if name in some - exporter.options and getattr(export, name) != option.default:
            told = f"--{_SEVERAL.get(name, name).replace('_', '-')}"
            able = " or ".join(f"--as {one.name}" for one in EXPORTERS if name in one.options)
            reason = f"{told} cannot be used with the format '{exporter.name}'; add {able}"
            raise ExportError(reason)
    for clip in export.clips:
        if clip.start_ns > clip.end_ns:
            raise ExportError(
                f"a clip of {clip.trace!r} ends at {clip.end_ns} ns, before its start"
            )
