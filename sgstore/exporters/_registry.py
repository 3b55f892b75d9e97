"""The registry of exporters: formats of this package, and those of others.

A format is a function from an :class:`Export` and a folder to what it wrote there. This module loads none of
them, and is cheap to load: the command line names formats and their options in its help.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore import plugins
from sgstore.errors import ExportError
from sgstore.vocabulary import suggestion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.exporters._clips import WrittenClip, WrittenFile
    from sgstore.exporters._labels import Export


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
        Which options of an :class:`Export` it minds: ``abstraction``, ``with_graph``, ``mounts``,
        ``rebase_context``, ``graphml``, ``channels``, ``clouds``.
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
    _of("mcap", "with_graph", "mounts", "rebase_context"),
    _of("parquet"),
    _of("frames", "channels", "clouds"),
    _of("nx", "abstraction", "graphml"),
    _of("pyg", "abstraction"),
    _of("s3c", "abstraction"),
    _of("xosc"),
    _of("openlabel"),
    _of("rrd", "mounts"),
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
