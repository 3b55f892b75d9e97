"""Shared parts of the exporters: file names, descriptions of written files, atomic output folders.

An export is complete or absent. Its files are written to a temporary folder next to their place.
When all are finished, they are moved there one after another, the manifest last: a folder without a
manifest has no export. Existing files are never overwritten, and only the folder of the user is
written to.
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

from sgstore.base.temporary_folders import HeldFolder, sweep, sweep_temporary
from sgstore.errors import ExportError, reason_of
from sgstore.mcap import digest_of

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping, Sequence
    from pathlib import Path

    from sgstore.mcap import Loss


MANIFEST: Final = "manifest.json"
_PREFIX: Final = ".export-"
_FILES: Final = "files"
_MOVING: Final = "moving.json"
"""Name of the journal in the temporary folder: its files, and their identities while they are moved."""

_UNSAFE: Final = re.compile(r"[^A-Za-z0-9._-]+")
_RESERVED: Final = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")
_LONGEST_NAME: Final = 80


@dataclass(frozen=True, slots=True)
class ChannelCount:
    """Number of messages of a channel in an exported clip, with its id, topic and schema in the recording."""

    id: int
    topic: str
    schema: str
    messages: int


@dataclass(frozen=True, slots=True)
class WrittenClip:
    """Description of a written clip: file, trace, times, channels and lost messages.

    Attributes
    ----------
    file : Path
    sha256 : str
        Hash of the file.
    trace, source, source_sha256 : str
        Name of the trace; name and SHA-256 of its file.
    start_ns, end_ns : int
        Log times, both included.
    messages : tuple of ChannelCount
        Every channel of the source, including empty ones.
    context : int
        Number of context messages among them: outside the interval, but needed by later ones.
    first_ns : int
        Log time of the first message in the file. It is before ``start_ns`` if there is context.
    losses : tuple of Loss
        Unreadable parts of the source in the clip.
    provenance : dict
        Values of the caller about the origin: the query and its hash, the version of the tool.
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
    first_ns: int
    losses: tuple[Loss, ...]
    provenance: dict[str, str]

    def as_dict(self) -> dict[str, Any]:
        """Return the description of a written clip as plain values for the manifest file."""
        values = asdict(self)
        values["file"] = self.file.name
        return values

    def as_row(self) -> dict[str, Any]:
        """Return the description of a written clip as a table row for the command line."""
        return {
            "clip": str(self.file),
            "trace": self.trace,
            "start_ns": self.start_ns,
            "seconds": round((self.end_ns - self.start_ns) / 1e9, 3),
            "messages": sum(channel.messages for channel in self.messages),
            "context": self.context,
        }


@dataclass(frozen=True, slots=True)
class WrittenFile:
    """Description of a written file or folder: content, count, hash and lost data.

    Attributes
    ----------
    file : Path
        Path in the folder of the export.
    sha256 : str
        Hash of a file; empty for a folder, whose files have hashes in a table.
    holds : str
        Kind of its content: ``nodes``, ``pictures``, ….
    count : int
        Number of these.
    losses : tuple of Loss
        Parts of the graphs or recordings that are missing in it.
    notes : tuple of str
        Properties of the format that users must know. They are no loss.
    """

    file: Path
    sha256: str
    holds: str
    count: int
    losses: tuple[Loss, ...] = ()
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        file: Path,
        holds: str,
        count: int,
        losses: Sequence[Loss] = (),
        notes: Sequence[str] = (),
    ) -> WrittenFile:
        """Return the description of an existing file or folder, with its hash."""
        digest = digest_of(file) if file.is_file() else ""
        return cls(file, digest, holds, count, tuple(losses), tuple(notes))

    def as_dict(self) -> dict[str, Any]:
        """Return the description of a written file as plain values for the manifest file."""
        values = asdict(self) | {"file": self.file.name}
        if not self.notes:
            del values["notes"]
        return values

    def as_row(self) -> dict[str, Any]:
        """Return the description of a written file as a table row for the command line."""
        return {"file": str(self.file), "holds": self.holds, "count": self.count}


def provenance_of(told: dict[str, str]) -> dict[str, str]:
    """Return the origin of an export: the caller's values, the hash of the query, and the package version."""
    query = told.get("query", "")
    digest = {"query_sha256": hashlib.sha256(query.encode()).hexdigest()} if query else {}
    return {**told, **digest, "tool": tool()}


def tool() -> str:
    """Return the name and version of this package as a text."""
    return f"sgstore {version('sgstore')}"


def clip_name(trace: str, number: int, ending: str) -> str:
    """Return a file name for a clip, valid on all systems, such as ``swarm_Town04_003.mcap``.

    Invalid characters become ``_``; the number, unique in a trace, prevents collisions.
    """
    return f"{safe_name(trace, 'clip')}_{number:03d}{ending}"


def safe_name(text: str, otherwise: str) -> str:
    """Return a file or folder name without separators, leading dots and reserved names.

    Parameters
    ----------
    text : str
        Invalid characters become ``_``.
    otherwise : str
        Default for an empty name.
    """
    name = _UNSAFE.sub("_", text)[:_LONGEST_NAME].strip("._-") or otherwise
    return f"_{name}" if _RESERVED.fullmatch(name) else name


def check_folder(to: Path) -> None:
    """Raise an error if an export cannot be written into a folder. Call it before the slow search.

    Parameters
    ----------
    to : Path
        The folder may be missing.

    Raises
    ------
    ExportError
        It is a file, or contains an export.

    Notes
    -----
    Folders that a killed run left are removed first: a refused run makes no folder, so it would keep them.
    """
    sweep(to, _PREFIX, _undo)
    sweep_temporary()
    if os.path.lexists(to) and not to.is_dir():
        raise ExportError(f"{to}: a file; an export needs a folder")
    _refuse_taken(to, [MANIFEST])


@contextmanager
def export_folder(to: Path) -> Generator[Path]:
    """Yield a temporary folder for the files of an export. After success, the files are moved to ``to``.

    Parameters
    ----------
    to : Path
        Created if missing, and removed again if the export fails.

    Raises
    ------
    ExportError
        One of the files exists, or the folder is not writable.
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
        raise ExportError(f"{to}: cannot be written: {reason_of(error)}") from error
    finally:
        for folder in made:
            with suppress(OSError):  # folders with content stay
                folder.rmdir()


def _mark(thing: Path) -> list[int]:
    """Return two numbers (device and inode) that identify a file or folder, even after it is moved."""
    about = thing.lstat()
    return [about.st_dev, about.st_ino]


def _undo(left: Path) -> None:
    """If an export was killed while it moved its files, remove the moved files from the target folder."""
    try:
        marks = json.loads((left / _MOVING).read_text(encoding="utf-8"))
    except (OSError, ValueError):  # the move had not begun
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
    """True if a target file is an empty placeholder, because the exported file was not moved to it yet."""
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
    """Write the manifest file of an export. Equal content gives equal bytes."""
    told = {"format": form, "tool": tool(), **content}
    text = json.dumps(told, indent=2, sort_keys=True, ensure_ascii=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def _move(things: Sequence[Path], to: Path) -> None:
    """Move all files and folders into a folder; after an error, move none. Existing files are kept."""
    moved: list[Path] = []
    try:
        for thing in things:
            target = to / thing.name
            if thing.is_dir():
                target.mkdir()  # unlike a rename, it fails for an existing target
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
        target.hardlink_to(file)  # unlike a rename, it fails for an existing target
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        with target.open("xb"):
            pass
        try:
            file.replace(target)
        except OSError:
            target.unlink()
            raise
