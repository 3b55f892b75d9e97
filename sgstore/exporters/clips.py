"""What every exporter of clips needs: where they come from, what they are called, how they reach their folder.

An export is whole or it is not there: its files are written into a folder of their own beside their
place, and moved there, one after another, when all of them are finished. Nothing that exists is ever
overwritten, and nothing is written outside the folder that the user names.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import tempfile
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import ExportError

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from sgstore.world import Loss, MessageRefs

MANIFEST: Final = "manifest.json"

_UNSAFE: Final = re.compile(r"[^A-Za-z0-9._-]+")
_RESERVED: Final = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")
_LONGEST_NAME: Final = 80


@dataclass(frozen=True, slots=True)
class Source:
    """A recording that clips are cut from.

    Attributes
    ----------
    path : Path
    digest : str
        SHA-256 that the file had when it was ingested; empty: not to be checked.
    context : MessageRefs
        Messages that later ones depend on. Only their places and which of them share a channel matter.
    """

    path: Path
    digest: str
    context: MessageRefs


@dataclass(frozen=True, slots=True)
class ChannelCount:
    """Messages of a channel in a clip. ``id``, ``topic``, ``schema`` as the source has them."""

    id: int
    topic: str
    schema: str
    messages: int


@dataclass(frozen=True, slots=True)
class WrittenClip:
    """A clip that was written.

    Attributes
    ----------
    file : Path
    sha256 : str
        Of the file.
    trace, source, source_sha256 : str
        Name of the trace; name and SHA-256 of its file.
    start_ns, end_ns : int
        Log times, both included.
    messages : tuple of ChannelCount
        Every channel of the source, those without a message too.
    context : int
        Messages among them that stand outside the interval: what later ones depend on.
    losses : tuple of Loss
        What of the source could not be read where the clip was cut.
    provenance : dict
        What the caller wants to be known of it: the query and its hash, the version of the tool.
    """

    file: Path
    sha256: str
    trace: str
    source: str
    source_sha256: str
    start_ns: int
    end_ns: int
    messages: tuple[ChannelCount, ...]
    context: int
    losses: tuple[Loss, ...]
    provenance: dict[str, str]

    def as_dict(self) -> dict[str, Any]:
        """The clip as plain values, as it stands in a manifest."""
        values = asdict(self)
        values["file"] = self.file.name
        return values


def provenance_of(told: dict[str, str]) -> dict[str, str]:
    """What the caller tells of an export, with the hash of its query and the version of the tool."""
    query = told.get("query", "")
    digest = {"query_sha256": hashlib.sha256(query.encode()).hexdigest()} if query else {}
    return {**told, **digest, "tool": tool()}


def tool() -> str:
    """Name and version of this package."""
    return f"sgstore {version('sgstore')}"


def clip_name(trace: str, number: int, ending: str) -> str:
    """A file name for a clip, safe on every system: ``swarm_Town04_003.mcap``.

    Whatever may not stand in a name becomes ``_``; the number, unique in an export, keeps names apart.
    """
    name = _UNSAFE.sub("_", trace)[:_LONGEST_NAME].strip("._-") or "clip"
    if _RESERVED.fullmatch(name):
        name = f"_{name}"
    return f"{name}_{number:03d}{ending}"


@contextmanager
def export_folder(to: Path, names: Sequence[str]) -> Generator[Path]:
    """A folder to write the files of an export into; they are moved to ``to`` if all goes well.

    Parameters
    ----------
    to : Path
        Made if it does not exist.
    names : sequence of str
        The files that will be there, without the manifest.

    Raises
    ------
    ExportError
        One of the files exists, or nothing can be written there.
    """
    try:
        to.mkdir(parents=True, exist_ok=True)
        taken = [name for name in (*names, MANIFEST) if os.path.lexists(to / name)]
        if taken:
            raise ExportError(
                f"{to}: {taken[0]} exists already and is not overwritten; choose another folder"
            )
        work = Path(tempfile.mkdtemp(prefix=".export-", dir=to))
        try:
            yield work
            _move([work / name for name in (*names, MANIFEST)], to)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        raise ExportError(f"{to}: cannot be written: {error.strerror or error}") from error


def write_manifest(folder: Path, clips: Sequence[WrittenClip]) -> None:
    """Write the manifest of an export: the same bytes for the same clips."""
    content = {"format": "sgstore.clips", "tool": tool(), "clips": [c.as_dict() for c in clips]}
    text = json.dumps(content, indent=2, sort_keys=True, ensure_ascii=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")


def _move(files: Sequence[Path], to: Path) -> None:
    """Move files to a folder, all or none; a file that came into being meanwhile is not overwritten."""
    moved: list[Path] = []
    try:
        for file in files:
            target = to / file.name
            try:
                target.hardlink_to(file)  # unlike a renaming, it fails where something is
            except FileExistsError:
                raise
            except OSError:  # a file system without links
                with target.open("xb"):
                    pass
                file.replace(target)
            moved.append(target)
    except BaseException:
        for target in moved:
            target.unlink(missing_ok=True)
        raise
