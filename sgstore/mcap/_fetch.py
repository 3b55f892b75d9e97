"""Access to single messages of recordings, and to bags (folders with the files of one recording).

A rosbag2 bag is a folder. Its ``metadata.yaml`` lists the MCAP files of one recording. A position in a bag
counts from the start of its first file, as if the files were one. Only the list of files is read from
``metadata.yaml``. A small subset of YAML is therefore enough: a key, and its list of plain or quoted texts, as
rosbag2 writes it. The listed files must lie in the folder.

Source: rosbag2, ``rosbag2_storage/yaml.hpp``.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from io import FileIO
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, TypeVar

from mcap.opcode import Opcode

from sgstore.errors import TraceError, url_named
from sgstore.mcap._chunks import (
    HEAD,
    MAX_CHUNK,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    READ_ERRORS,
    read_chunk_head,
    read_records,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator
    from io import BufferedReader

_Found = TypeVar("_Found")

METADATA: Final = "metadata.yaml"
MAX_METADATA: Final = 16 << 20
"""Maximum size of ``metadata.yaml``; bytes. The file repeats the settings of every channel."""
MAX_PARTS: Final = 10_000
"""Maximum number of files in a bag."""

_MARK: Final = b"rosbag2_bagfile_information"
_BEGINNING: Final = 4096
_FILES: Final = (".mcap", ".osi", ".zst", ".xml")
_ENTRY: Final = re.compile(r"(?P<indent> *)(?P<dash>- +)?(?P<rest>\S.*?)\s*")
_KEY: Final = re.compile(r"(relative_file_paths|storage_identifier|compression_mode)\s*:\s*(.*)")


@dataclass(frozen=True, slots=True)
class BagPart:
    """File of a bag (folder with the files of one recording), with its position in the bag.

    Attributes
    ----------
    path : Path
    base : int
        Position of its first byte in the bag: the size of all earlier files; bytes.
    size : int
        -1 means that the file is missing.
    """

    path: Path
    base: int
    size: int


def bag_folder(path: Path) -> Path | None:
    """Return the folder of a bag from its path or its ``metadata.yaml``; ``None`` if it is not a bag.

    A folder is a bag if its ``metadata.yaml`` begins like those of rosbag2, because other tools write such
    files, too.
    """
    if path.name == METADATA:
        return path.parent
    if (url := url_named(path)) is not None:
        return path if _is_remote_bag(url) else None
    try:
        if not path.is_dir():
            return None
        with (path / METADATA).open("rb") as file:
            return path if _MARK in file.read(_BEGINNING) else None
    except (OSError, ValueError):
        return None


FOLDERS: Final = {
    # Argoverse 2, sensor data set.
    "city_SE3_egovehicle.feather": ("annotations*.feather", "map/log_map_archive_*.json"),
    # 123D.
    "sync.arrow": (
        "[be]*[xo]_[ds]*_se3*.arrow",  # box_detections_se3, ego_state_se3
        "traffic_light_detections*.arrow",
        "map.arrow",
    ),
}
"""File that identifies a folder of recordings → patterns of the other files. The first one is required."""


def log_files(path: Path) -> list[Path] | None:
    """Return the files of a recording that is a folder, but not MCAP; ``None`` for any other path."""
    if url_named(path) is not None:
        return None
    if (stored := _sqlite_bag(path)) is not None:
        return stored
    for mark, patterns in FOLDERS.items():
        try:
            if (path / mark).is_file():
                found = [sorted(path.glob(pattern)) for pattern in patterns]
                if found[0]:
                    return [path / mark, *(file for files in found for file in files)]
        except (OSError, ValueError):
            return None
    return None


def _sqlite_bag(path: Path) -> list[Path] | None:
    """Return the files of a rosbag2 bag in SQLite, with its ``metadata.yaml``; ``None`` for other paths."""
    folder = bag_folder(path)
    if folder is None:
        return None
    try:
        found = read_metadata((folder / METADATA).read_text(encoding="utf-8", errors="replace"))
        if found["storage_identifier"][:1] != ["sqlite3"]:
            return None
        files = [_inside(folder, name) for name in found["relative_file_paths"][:MAX_PARTS]]
    except (OSError, TraceError):
        return None
    return [folder / METADATA, *(file for file in files if file.is_file())]


@lru_cache(maxsize=1024)
def _is_remote_bag(url: str) -> bool:
    """Return True if a URL is a bag folder in an object store. A URL with a file suffix is not a bag."""
    if url.lower().endswith(_FILES):
        return False
    from sgstore.mcap._remote import open_url

    try:
        with open_url(f"{url}/{METADATA}") as file:
            return _MARK in file.read(_BEGINNING)
    except (OSError, TraceError):
        return False


def parts_of(folder: Path) -> tuple[BagPart, ...]:
    """Return the files of a bag, in the order of its metadata file.

    Raises
    ------
    TraceError
        The metadata are unreadable, list no file, or belong to a bag in another format; or all files are
        missing.
    """
    parts: list[BagPart] = []
    base = 0
    for name in _listed(folder / METADATA):
        path = _inside(folder, name)
        size = _size(path)
        parts.append(BagPart(path, base, size))
        base += max(size, 0)
    if all(part.size < 0 for part in parts):
        reason = f"none of the {len(parts)} files that its {METADATA} lists exists"
        raise TraceError(reason, path=folder)
    return tuple(parts)


def part_at(parts: tuple[BagPart, ...], place: int) -> BagPart | None:
    """Return the file of a bag that contains a byte position of the bag; ``None`` if no file does."""
    there = (part for part in parts if part.base <= place < part.base + part.size)
    return next(there, None)


def _listed(path: Path) -> list[str]:
    try:
        with open_regular(path) as file:
            content = file.read(MAX_METADATA + 1)
        text = content.decode()
    except (OSError, ValueError) as error:
        raise TraceError(f"cannot be read: {error}", path=path) from error
    if len(content) > MAX_METADATA:
        raise TraceError(f"more than {MAX_METADATA} bytes, which no bag needs", path=path)
    found = read_metadata(text)
    (stored,) = found["storage_identifier"][:1] or ("mcap",)
    if stored != "mcap":
        raise TraceError(f"a bag of {stored!r}; expected 'mcap' (ros2 bag convert)", path=path)
    if "".join(found["compression_mode"]).upper() == "FILE":
        raise TraceError("its files are compressed as a whole; expected MCAP files", path=path)
    files = found["relative_file_paths"]
    if not files or len(files) > MAX_PARTS:
        reason = f"it lists {len(files)} files; expected 1 to {MAX_PARTS} in relative_file_paths"
        raise TraceError(reason, path=path)
    return files


def read_metadata(text: str) -> dict[str, list[str]]:
    """Parse the YAML metadata of a bag: key → file names or storage format. An absent key has no values.

    Other keys and their nested values are skipped.
    """
    found: dict[str, list[str]] = {
        "relative_file_paths": [],
        "storage_identifier": [],
        "compression_mode": [],
    }
    open_key, open_indent = "", -1
    for line in text.splitlines():
        entry = _ENTRY.fullmatch(line)
        if entry is None or entry["rest"].startswith("#"):
            continue
        indent = len(entry["indent"])
        if open_key and entry["dash"] and indent >= open_indent:
            found[open_key].append(_plain(entry["rest"]))
            continue
        open_key = ""
        key = None if entry["dash"] else _KEY.fullmatch(entry["rest"])
        if key is None or found[key[1]]:
            continue
        if key[2] and not key[2].startswith("#"):
            found[key[1]] = [_plain(value) for value in _values(key[2])]
        elif key[1] == "relative_file_paths":
            open_key, open_indent = key[1], indent
    return found


def _values(text: str) -> list[str]:
    """Return the texts of a YAML list ``[a, b]``, or the single text."""
    if text.startswith("[") and text.endswith("]"):
        return [part.strip() for part in text[1:-1].split(",") if part.strip()]
    return [text]


def _plain(text: str) -> str:
    """Return a YAML scalar without quotes or trailing comment."""
    quoted = re.match(r"""'((?:[^']|'')*)'|"((?:[^"\\]|\\.)*)\"""", text)
    if quoted is None:
        return re.sub(r"\s+#.*", "", text)
    if quoted[1] is not None:
        return quoted[1].replace("''", "'")
    return re.sub(r"\\(.)", r"\1", quoted[2])


def _inside(folder: Path, name: str) -> Path:
    """Return the path of a file listed in a bag's metadata. Early versions prefix the folder name."""
    parts = PurePosixPath(name).parts
    if not parts or PurePosixPath(name).is_absolute() or ".." in parts or "\0" in name:
        raise TraceError(f"it lists {name!r}, which is not in its folder", path=folder / METADATA)
    path = folder.joinpath(*parts)
    return folder / parts[-1] if len(parts) > 1 and _size(path) < 0 else path


def _size(path: Path) -> int:
    """Return the size of a regular file; -1 if it is missing."""
    try:
        if url_named(path) is not None:
            return mark_of(path)[0]
        status = path.stat()
    except (OSError, ValueError, TraceError):
        return -1
    return status.st_size if stat.S_ISREG(status.st_mode) else -1


# Files of recordings: safe opening, hashing, and access to single messages.


def message_at(path: Path, *, chunk_offset: int, offset: int, length: int) -> bytes:
    """Return the bytes of one message of a recording, from its position."""
    (data,) = messages_at(path, [(chunk_offset, offset, length)])
    return bytes(data)


def messages_at(path: Path, places: Iterable[tuple[int, int, int]]) -> Iterator[memoryview]:
    """Yield the bytes of several messages of a recording, in the order of the given positions.

    Parameters
    ----------
    path : Path
        A file, or the folder of a bag. Positions in a bag count from the start of its first file.
    places : iterable of (chunk_offset, offset, length)
        Byte offset of the chunk record in the file, -1 outside chunks; byte offset of the message record in the
        uncompressed chunk, or in the file; bytes of its data. Group the messages of a chunk, because only the
        last chunk is cached.

    Raises
    ------
    TraceError
        The file is unreadable, the chunk is damaged, or the message does not match, because the file was
        replaced.
    """
    folder = bag_folder(path)
    parts = None if folder is None else parts_of(folder)
    known, records = -1, memoryview(b"")
    for chunk_offset, offset, length in places:
        place = offset if chunk_offset < 0 else chunk_offset
        file, base = (path, 0) if parts is None else _part_of(path, parts, place)
        if chunk_offset < 0:
            offset -= base  # noqa: PLW2901
            record = _bytes_at(file, offset, length)
        else:
            if chunk_offset != known:
                records, known = _records_at(file, chunk_offset - base), chunk_offset
            record = records[offset : offset + MESSAGE_HEAD.itemsize + length]
        if not _is_message(record, length) or offset < 0:
            reason = f"no message of {length} bytes at {offset} there: the file was replaced"
            raise TraceError(reason, path=file, offset=max(chunk_offset - base, 0))
        yield record[MESSAGE_HEAD.itemsize :]


def _bytes_at(path: Path, offset: int, length: int) -> memoryview:
    """Return the bytes of a message outside chunks; empty if the offset is outside the file."""
    with open_regular(path) as file:
        try:
            file.seek(offset)
            return memoryview(file.read(min(MESSAGE_HEAD.itemsize + length, MAX_CHUNK)))
        except READ_ERRORS:
            return memoryview(b"")


def _records_at(path: Path, chunk_offset: int) -> memoryview:
    """Return the decompressed records of a chunk; empty if the offset is outside the file."""
    with open_regular(path) as file:
        try:
            return memoryview(read_records(file, read_chunk_head(file, chunk_offset)))
        except TraceError as error:
            raise TraceError(error.reason, path=path, offset=chunk_offset) from error
        except READ_ERRORS:
            return memoryview(b"")


def _is_message(record: memoryview, length: int) -> bool:
    whole = length >= 0 and len(record) == MESSAGE_HEAD.itemsize + length
    return whole and HEAD.unpack_from(record) == (Opcode.MESSAGE, MESSAGE_FIELDS + length)


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a recording (a file, or all files of a bag) as hexadecimal digits.

    Raises
    ------
    TraceError
        A file cannot be read.
    """
    files = log_files(path)
    if files is None:
        folder = bag_folder(path)
        files = [path] if folder is None else [p.path for p in parts_of(folder) if p.size >= 0]
    digest = hashlib.sha256()
    for one in files:
        with open_regular(one) as file:
            try:
                hashlib.file_digest(file, lambda: digest)
            except OSError as error:
                raise TraceError(f"cannot be read: {error.strerror}", path=one) from error
    return digest.hexdigest()


def read_and_digest(path: Path, digest: str, read: Callable[[], _Found]) -> tuple[_Found, str]:
    """Read a recording and compute the hash of its file at the same time. The disk is read only once.

    Parameters
    ----------
    path : Path
    digest : str
        Known SHA-256 of the file, or an empty string to compute it.
    read : function
        First reading of the recording.

    Returns
    -------
    tuple
        Result of the reading, and the digest.

    Raises
    ------
    TraceError
        A file cannot be read, or ``read`` raises it.
    """
    with ThreadPoolExecutor(1) as beside:
        hashing = None if digest else beside.submit(digest_of, path)
        found = read()
        return found, hashing.result() if hashing else digest


def check_name(path: Path) -> None:
    """Raise an error if the path of a recording is not valid UTF-8, which a store needs.

    Raises
    ------
    TraceError
        The name of the file or of a parent folder is not UTF-8.
    """
    for name in reversed(path.absolute().parts):
        try:
            name.encode()
        except UnicodeEncodeError:
            shown = repr(os.fsencode(name))[2:-1]
            reason = f"a store needs names in UTF-8; '{shown}' is not; rename it"
            raise TraceError(reason, path=path) from None


def mark_of(path: Path) -> tuple[int, int]:
    """Return the size (bytes) and modification time (ns) of a recording, to detect a changed file.

    For a bag: the total size of its files, and their latest modification time.

    Raises
    ------
    OSError
        The file does not exist.
    TraceError
        The metadata of the bag are unreadable, or all its files are missing.
    """
    if (inside := log_files(path)) is not None:
        marks = [_mark(file) for file in inside]
        return sum(size for size, _ in marks), max(time for _, time in marks)
    folder = bag_folder(path)
    if folder is None:
        return _mark(path)
    files = [part for part in parts_of(folder) if part.size >= 0]
    return sum(part.size for part in files), max(_mark(part.path)[1] for part in files)


def _mark(path: Path) -> tuple[int, int]:
    if (url := url_named(path)) is not None:
        from sgstore.mcap._remote import mark_of_url

        return mark_of_url(url)
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def mark_of_open(file: BufferedReader) -> tuple[int, int]:
    """Return the size (bytes) and modification time (ns) of an open file."""
    remote: Any = file.raw
    if not isinstance(remote, FileIO):
        return remote.mark
    status = os.fstat(file.fileno())
    return status.st_size, status.st_mtime_ns


@contextmanager
def near(path: Path, folder: Path) -> Generator[None]:
    """Context manager: copy a remote recording to a local folder, and read the copy inside the block.

    Other code still uses the URL of the recording.

    Parameters
    ----------
    path : Path
        A recording. A local one is not copied.
    folder : Path
        Folder for the copy, created if needed.

    Raises
    ------
    TraceError
        The recording does not exist or cannot be fetched.
    """
    if url_named(path) is None:
        yield
        return
    from sgstore.mcap._remote import copied

    bag = bag_folder(path)
    paths = [path] if bag is None else [p.path for p in parts_of(bag) if p.size >= 0]
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            stack.enter_context(copied([url_named(one) or "" for one in paths], folder))
        except OSError as error:
            raise TraceError(f"cannot be fetched: {error.strerror}", path=path) from error
        yield


def remote_names(url: str) -> list[str]:
    """Return the URLs of all objects below a URL in an object store, sorted.

    Raises
    ------
    TraceError
        The object store does not list its objects.
    """
    from sgstore.mcap._remote import names_below

    try:
        return sorted(names_below(url))
    except OSError as error:
        raise TraceError(error.strerror or "cannot be read", path=url) from error


def _part_of(path: Path, parts: tuple[BagPart, ...], place: int) -> tuple[Path, int]:
    """Return the file of a bag that contains a byte position, and the file's first position."""
    part = part_at(parts, place)
    if part is None:
        raise TraceError("the bag was replaced; its files are missing", path=path, offset=place)
    return part.path, part.base


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading. Pipes and devices are rejected, because they would block.

    Raises
    ------
    TraceError
        The file does not exist, is a folder or device, or is not readable.
    """
    try:
        if (url := url_named(path)) is not None:
            from sgstore.mcap._remote import open_url

            return open_url(url)
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise TraceError("a folder; expected an MCAP recording", path=path)
        if not stat.S_ISREG(mode):
            raise TraceError("not a regular file; expected an MCAP recording", path=path)
        return path.open("rb")
    except FileNotFoundError as error:
        there = "file not found" if url_named(path) is None else f"{error.strerror}"
        raise TraceError(there, path=path) from error
    except (OSError, ValueError) as error:
        raise TraceError(f"cannot be opened: {error}", path=path) from error
