"""Registry of export formats: built-in formats, and formats of other packages.

A format is a function from an :class:`Export` and a folder to the written files. This module loads
no formats, and is fast to load: the help of the command line lists formats and their options.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.base import plugins
from sgstore.errors import ExportError
from sgstore.model.vocabulary import suggestion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.exporters._clip_frames import Export
    from sgstore.exporters._clips import WrittenClip, WrittenFile


GROUP: Final = plugins.EXPORTERS.group
"""Name of the Python entry point group for export formats of other packages."""

Write = Callable[["Export", Path], "Sequence[WrittenClip | WrittenFile]"]
"""Function that writes an export into an empty folder, reads it for verification, and returns the files.

The exporter chooses file names but does not write the manifest. It may raise
:class:`~sgstore.errors.ExportError`; then all its files are removed.
"""


@dataclass(frozen=True, slots=True)
class Exporter:
    """Export format: its name, the function that writes the files, and the supported options.

    Attributes
    ----------
    name : str
        Name for users.
    write : callable
        See :class:`Write`.
    options : frozenset of str
        Supported options of an :class:`Export`: ``abstraction``, ``with_graph``, ``mounts``,
        ``rebase_context``, ``graphml``, ``channels``, ``clouds``, ``storage``, ``crs``.
    recorded : bool
        True if the format copies messages of recordings. Then an export needs a query.
    """

    name: str
    write: Write
    options: frozenset[str] = frozenset()
    recorded: bool = False


def _of(module: str, *options: str, recorded: bool = False) -> Exporter:
    """Return a built-in export format. Its module is imported on first use."""

    def write(export: Export, folder: Path) -> Sequence[WrittenClip | WrittenFile]:
        found: Any = import_module(f"sgstore.exporters._{module}")
        return found.write(export, folder)

    return Exporter(module, write, frozenset(options), recorded)


EXPORTERS: Final = (
    _of("mcap", "with_graph", "mounts", "rebase_context", recorded=True),
    _of("parquet"),
    _of("frames", "channels", "clouds", recorded=True),
    _of("nx", "abstraction", "graphml"),
    _of("pyg", "abstraction"),
    _of("s3c", "abstraction"),
    _of("xosc"),
    _of("openlabel"),
    _of("rrd", "mounts"),
    _of("duckdb", "storage"),
    _of("lance"),
    _of("geojson", "crs"),
)
"""Built-in export formats."""


def exporters() -> dict[str, Exporter]:
    """Return all export formats by name: built-in ones, and those of other packages.

    Raises
    ------
    ExportError
        A format of another package cannot be loaded.
    """
    known = {exporter.name: exporter for exporter in EXPORTERS}
    for name, entry in plugins.EXPORTERS.others().items():
        if name not in known:
            known[name] = plugins.EXPORTERS.load_other(entry, ExportError)
    return known


def exporter_named(name: str) -> Exporter:
    """Return the export format with a name, or raise an error for an unknown name.

    Raises
    ------
    ExportError
        The name is unknown.
    """
    known = next((one for one in EXPORTERS if one.name == name), None)
    if known is not None:  # the search for other packages is slow
        return known
    found = exporters()
    if name not in found:
        like = suggestion(name, found)
        hint = f"did you mean '{like}'?" if like else f"known: {', '.join(found)}"
        raise ExportError(f"no export format '{name}'; {hint}")
    return found[name]
