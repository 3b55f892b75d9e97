"""The registry of exporters, and export from a store.

A format is a function from an :class:`Export` and a folder to what it wrote there. What it writes is there as a
whole or not at all, with a manifest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore import plugins
from sgstore.errors import ExportError
from sgstore.exporters._clips import (
    WrittenClip,
    WrittenFile,
    export_folder,
    provenance_of,
    write_manifest,
)
from sgstore.exporters._labels import Export, Labels
from sgstore.matches import merged
from sgstore.vocabulary import natural, suggestion
from sgstore.world import Clip, tolerance_ns

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from sgstore.query import Store


GROUP: Final = plugins.EXPORTERS.group
"""Group of entry points by which an installed package adds formats."""


Write = Callable[["Export", Path], "Sequence[WrittenClip | WrittenFile]"]
"""Writes an export into an empty folder, tests it with the format's own reader, and tells what is there.

Its names are those of the export; the manifest is none of its business. It may raise
:class:`~sgstore.errors.ExportError`: then nothing is left of it.
"""


@dataclass(frozen=True, slots=True)
class Exporter:
    """A format.

    Attributes
    ----------
    name : str
        What users call it.
    write : callable
        See :class:`Write`.
    options : frozenset of str
        Which of ``abstraction``, ``with_graph``, ``channels`` and ``clouds`` of an export it minds.
    """

    name: str
    write: Write
    options: frozenset[str] = frozenset()


def _of(module: str, *options: str) -> Exporter:
    """A format of ours; its module is not loaded before it is written."""

    def write(export: Export, folder: Path) -> Sequence[WrittenClip | WrittenFile]:
        found: Any = import_module(f"sgstore.exporters._{module}")
        return found.write(export, folder)

    return Exporter(module, write, frozenset(options))


EXPORTERS: Final = (
    _of("mcap", "with_graph"),
    _of("parquet"),
    _of("frames", "channels", "clouds"),
    _of("nx", "abstraction"),
    _of("pyg", "abstraction"),
    _of("s3c", "abstraction"),
)
"""The formats of this package."""


def exporters() -> dict[str, Exporter]:
    """All formats by name: those of this package, and those of others.

    Raises
    ------
    ExportError
        A package names a format that cannot be loaded.
    """
    known = {exporter.name: exporter for exporter in EXPORTERS}
    for name, entry in plugins.EXPORTERS.others().items():
        if name not in known:
            known[name] = plugins.EXPORTERS.load_other(entry, ExportError)
    return known


def exporter_named(name: str) -> Exporter:
    """The exporter that a user's name means.

    Raises
    ------
    ExportError
        There is none of that name.
    """
    known = next((one for one in EXPORTERS if one.name == name), None)
    if known is not None:  # looking for those of other packages takes a while
        return known
    found = exporters()
    if name not in found:
        like = suggestion(name, found)
        hint = f"did you mean '{like}'?" if like else f"known: {', '.join(found)}"
        raise ExportError(f"no export format '{name}'; {hint}")
    return found[name]


# From a store to files: which recordings clips are cut from, and clips around frames that are named ----

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
    found = [store.file.frame(frame) for frame in frames]
    clips = (
        Clip(f.trace, f.log_time_ns - round(before * 1e9), f.log_time_ns + round(after * 1e9))
        for f in found
    )
    periods = {one.name: tolerance_ns(one.period_ns) for one in store.info()}
    return list(
        merged(sorted(clips, key=lambda clip: (natural(clip.trace), clip.start_ns)), periods)
    )


def labelled(export: Export, texts: Mapping[str, str], **parameters: object) -> Export:
    """An export with labels for the frames of its clips.

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
    """Write clips of a store, all of it or nothing.

    Parameters
    ----------
    export : Export
    to : str or Path
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
    to, exporter = Path(to), exporter_named(form)
    _check(export, exporter)
    told = replace(export, provenance=provenance_of(dict(export.provenance)))
    with told.store.file.snapshot(), export_folder(to) as folder:
        written = list(exporter.write(told, folder))
        clips = [one for one in written if isinstance(one, WrittenClip)]
        files = [one for one in written if isinstance(one, WrittenFile)]
        if clips and not files:
            content = {"clips": [one.as_dict() for one in clips]}
            write_manifest(folder, "sgstore.clips", content)
        else:
            content = {"form": form, **told.about(), "files": [one.as_dict() for one in files]}
            write_manifest(folder, "sgstore.export", content)
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
