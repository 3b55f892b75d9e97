"""Shared parts of the exporters: sources and names of clips, and folders that appear complete or not at all.

An export is whole or it is not there: its files are written into a folder of their own beside their
place, and moved there, one after another, when all of them are finished, the manifest last: where there is
none, there is no export. Nothing that exists is ever overwritten, and nothing is written outside the folder
that the user names.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import ExportError
from sgstore.files import HeldFolder
from sgstore.mcap import digest_of

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping, Sequence
    from pathlib import Path

    from sgstore.mcap import Loss


MANIFEST: Final = "manifest.json"
_PREFIX: Final = ".export-"
_FILES: Final = "files"
_MOVING: Final = "moving.json"
"""In the folder of an export on its way: its files, and what they are once they begin to be moved."""

_UNSAFE: Final = re.compile(r"[^A-Za-z0-9._-]+")
_RESERVED: Final = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")
_LONGEST_NAME: Final = 80


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

    def as_row(self) -> dict[str, Any]:
        """Row of a table for people."""
        return {
            "clip": str(self.file),
            "trace": self.trace,
            "start_ns": self.start_ns,
            "seconds": round((self.end_ns - self.start_ns) / 1e9, 3),
            "messages": sum(channel.messages for channel in self.messages),
        }


@dataclass(frozen=True, slots=True)
class WrittenFile:
    """A file, or a folder of files, that was written.

    Attributes
    ----------
    file : Path
        In the folder of the export.
    sha256 : str
        Of a file; empty for a folder: a table beside it has those of its files.
    holds : str
        What it holds: ``nodes``, ``pictures``, ….
    count : int
        How many of these.
    losses : tuple of Loss
        What of the graphs or of the recordings is not in it.
    """

    file: Path
    sha256: str
    holds: str
    count: int
    losses: tuple[Loss, ...] = ()

    @classmethod
    def of(cls, file: Path, holds: str, count: int, losses: Sequence[Loss] = ()) -> WrittenFile:
        """A file or a folder that is there, with its hash."""
        digest = digest_of(file) if file.is_file() else ""
        return cls(file, digest, holds, count, tuple(losses))

    def as_dict(self) -> dict[str, Any]:
        """The file as plain values, as it stands in a manifest."""
        return asdict(self) | {"file": self.file.name}

    def as_row(self) -> dict[str, Any]:
        """Row of a table for people."""
        return {"file": str(self.file), "holds": self.holds, "count": self.count}


def provenance_of(told: dict[str, str]) -> dict[str, str]:
    """Provenance of an export: the caller's values, the hash of its query, and the version of the tool."""
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
    return f"{safe_name(trace, 'clip')}_{number:03d}{ending}"


def safe_name(text: str, otherwise: str) -> str:
    """A name for a file or a folder, safe on every system: no separators, no dots in front, nothing reserved.

    Parameters
    ----------
    text : str
        Whatever may not stand in a name becomes ``_``.
    otherwise : str
        The name, if nothing is left.
    """
    name = _UNSAFE.sub("_", text)[:_LONGEST_NAME].strip("._-") or otherwise
    return f"_{name}" if _RESERVED.fullmatch(name) else name


def check_folder(to: Path) -> None:
    """Refuse a folder that no export can be written into, before anything is searched.

    Parameters
    ----------
    to : Path
        It need not exist.

    Raises
    ------
    ExportError
        It is a file, or there is an export in it.
    """
    if os.path.lexists(to) and not to.is_dir():
        raise ExportError(f"{to}: a file; an export needs a folder")
    _refuse_taken(to, [MANIFEST])


@contextmanager
def export_folder(to: Path) -> Generator[Path]:
    """A folder to write the files of an export into; they are moved to ``to`` if all goes well.

    Parameters
    ----------
    to : Path
        Made if it does not exist, and gone again if the export is not complete.

    Raises
    ------
    ExportError
        One of the files exists, or nothing can be written there.
    """
    made = [folder for folder in (to, *to.parents) if not folder.exists()]
    try:
        to.mkdir(parents=True, exist_ok=True)
        with HeldFolder(to, _PREFIX, _undo) as held:
            _refuse_taken(to, [MANIFEST])
            work = held.path / _FILES
            work.mkdir()
            yield work
            found = sorted(entry.name for entry in work.iterdir() if entry.name != MANIFEST)
            _refuse_taken(to, found)
            things = [work / name for name in (*found, MANIFEST)]
            marks = {thing.name: _mark(thing) for thing in things}
            (held.path / _MOVING).write_text(json.dumps(marks), encoding="utf-8")
            _move(things, to)
    except OSError as error:
        raise ExportError(f"{to}: cannot be written: {error.strerror or error}") from error
    finally:
        for folder in made:
            with suppress(OSError):  # what holds something stays
                folder.rmdir()


def _mark(thing: Path) -> list[int]:
    """Identity of a file or a folder, which stays when it is moved."""
    about = thing.lstat()
    return [about.st_dev, about.st_ino]


def _undo(left: Path) -> None:
    """Take back what a killed export had moved to its place when it was not complete."""
    try:
        marks = json.loads((left / _MOVING).read_text(encoding="utf-8"))
    except (OSError, ValueError):  # it had not begun to move
        return
    to = left.parent
    if _is_the(to / MANIFEST, marks[MANIFEST]):
        return
    for name, mark in marks.items():
        target = to / name
        if _is_the(target, mark) or _is_kept_free(target, left / _FILES / name):
            _remove(target)


def _is_the(thing: Path, mark: list[int]) -> bool:
    try:
        return _mark(thing) == mark
    except OSError:
        return False


def _is_kept_free(target: Path, thing: Path) -> bool:
    """Return True for a placeholder whose file has not come yet."""
    if target.is_symlink() or not (target.exists() and thing.exists()):
        return False
    return not any(target.iterdir()) if target.is_dir() else not target.stat().st_size


def _remove(target: Path) -> None:
    if target.is_dir():
        shutil.rmtree(target, ignore_errors=True)
    else:
        target.unlink(missing_ok=True)


def _refuse_taken(to: Path, names: Sequence[str]) -> None:
    taken = [name for name in names if os.path.lexists(to / name)]
    if taken:
        raise ExportError(
            f"{to}: {taken[0]} exists already and is not overwritten; choose another folder"
        )


def write_manifest(folder: Path, form: str, content: Mapping[str, Any]) -> None:
    """Write the manifest of an export: the same bytes for the same content."""
    told = {"format": form, "tool": tool(), **content}
    text = json.dumps(told, indent=2, sort_keys=True, ensure_ascii=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def _move(things: Sequence[Path], to: Path) -> None:
    """Move files and folders to a folder, all or none; what came into being meanwhile is not overwritten."""
    moved: list[Path] = []
    try:
        for thing in things:
            target = to / thing.name
            if thing.is_dir():
                target.mkdir()  # unlike a renaming, it fails where something is
                moved.append(target)
                thing.replace(target)
            else:
                _move_file(thing, target)
                moved.append(target)
    except BaseException:
        for target in moved:
            _remove(target)
        raise


def _move_file(file: Path, target: Path) -> None:
    try:
        target.hardlink_to(file)  # unlike a renaming, it fails where something is
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        with target.open("xb"):
            pass
        file.replace(target)
