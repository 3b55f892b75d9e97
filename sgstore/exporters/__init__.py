"""Clips of recordings → files: one file for each format, listed in :data:`EXPORTERS`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from sgstore.errors import ExportError
from sgstore.exporters.clips import Source, WrittenClip
from sgstore.exporters.mcap import write_clips
from sgstore.vocabulary import suggestion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from sgstore.world import Clip

__all__ = ["EXPORTERS", "Exporter", "Source", "WriteClips", "WrittenClip", "exporter_named"]


class WriteClips(Protocol):
    """Writes clips into a folder, with a manifest; see :func:`sgstore.exporters.mcap.write_clips`."""

    def __call__(
        self,
        clips: Sequence[Clip],
        sources: Mapping[str, Source],
        to: Path,
        *,
        provenance: Mapping[str, str] | None = None,
    ) -> list[WrittenClip]:
        """Write the clips; all of them or none."""
        ...


@dataclass(frozen=True, slots=True)
class Exporter:
    """A format that clips can be written in.

    Attributes
    ----------
    name : str
        What users call it.
    write_clips : callable
    """

    name: str
    write_clips: WriteClips


EXPORTERS: Final = (Exporter("mcap", write_clips),)


def exporter_named(name: str) -> Exporter:
    """The exporter that a user's name means.

    Raises
    ------
    ExportError
        There is none of that name.
    """
    known = {exporter.name: exporter for exporter in EXPORTERS}
    if name not in known:
        like = suggestion(name, known)
        hint = f"did you mean '{like}'?" if like else f"known: {', '.join(known)}"
        raise ExportError(f"no export format '{name}'; {hint}")
    return known[name]
