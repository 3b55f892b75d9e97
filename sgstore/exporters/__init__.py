"""Clips of recordings and their graphs → files: one file for each format, listed in :data:`EXPORTERS`.

``export`` says what is to be exported, ``stored`` writes it: aside first, then all of it or nothing, with a
manifest. A format is a function from an :class:`~sgstore.exporters.export.Export` and a folder to what it wrote
there; other packages add theirs as entry points of the group ``sgstore.exporters``: the name of the format, and
an :class:`Exporter`.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Final, Protocol

from sgstore.errors import ExportError
from sgstore.exporters.clips import Source, WrittenClip, WrittenFile
from sgstore.vocabulary import suggestion

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from sgstore.exporters.export import Export

__all__ = [
    "EXPORTERS",
    "GROUP",
    "Exporter",
    "Source",
    "Write",
    "WrittenClip",
    "WrittenFile",
    "exporter_named",
    "exporters",
]

GROUP: Final = "sgstore.exporters"
"""Group of entry points by which an installed package adds formats."""


class Write(Protocol):
    """Writes an export."""

    def __call__(self, export: Export, folder: Path) -> Sequence[WrittenClip | WrittenFile]:
        """Write it into an empty folder, test it with the format's own reader, and tell what is there.

        Its names are those of the export; the manifest is none of its business. It may raise
        :class:`~sgstore.errors.ExportError`: then nothing is left of it.
        """
        ...


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
        found: Any = import_module(f"sgstore.exporters.{module}")
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
    for entry in entry_points(group=GROUP):
        if entry.name in known:
            continue
        try:
            known[entry.name] = entry.load()
        except Exception as error:  # whatever its import does
            raise ExportError(
                f"the format {entry.name!r} ({entry.value}) cannot be loaded: {error!r}"
            ) from error
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
