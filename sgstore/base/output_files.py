"""Atomic output files: a file appears complete or not at all.

A file is written under a temporary name, then renamed. A full disk, a crash or an interrupt does not damage the
previous file, and readers never see half a file. Places that a rename cannot replace (a pipe, a device,
``/dev/stdout``) are written directly.
"""

from __future__ import annotations

import errno
import io
import os
import re
import select
import shutil
import stat
import sys
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.temporary_folders import HeldFolder, working_folder
from sgstore.errors import ExportError, reason_of

if TYPE_CHECKING:
    from collections.abc import Generator
    from typing import BinaryIO, TextIO


FILE_PREFIX: Final = ".sgstore-held-"
"""Prefix of the temporary folders next to output files."""

_DESCRIPTOR: Final = re.compile(r"/dev/fd/(\d+)|/proc/self/fd/(\d+)")

_NOT_REPLACEABLE: Final = {errno.EACCES, errno.EPERM, errno.EROFS, errno.EBUSY, errno.EXDEV}
"""Error codes for places in which a file can be written, but not replaced."""

BIDIRECTIONAL: Final = (0x61C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))
"""Characters that change the direction of the text around them, so that it looks like another text."""

_CONTROLS: Final = {
    code: f"\\x{code:02x}" for code in (*range(0x20), *range(0x7F, 0xA0)) if chr(code) not in "\n\t"
} | {code: f"\\u{code:04x}" for code in BIDIRECTIONAL}


def without_controls(text: str) -> str:
    r"""Replace terminal and bidirectional control characters by escapes such as ``\x1b``.

    Line feeds and tabs stay.
    """
    return text if text.isprintable() else text.translate(_CONTROLS)


class ReaderGoneError(ExportError):
    """Error: the program that reads the output pipe has ended, as ``head`` does. The work can stop."""


class Stream(io.RawIOBase):
    """Writable stream on a file descriptor. Errors become :class:`ExportError` with the file name.

    Parameters
    ----------
    descriptor : int
    name : str
        File name for messages.
    quiet : bool
        True to drop unwritable data silently.
    owned : bool
        True if the stream closes the descriptor.

    Notes
    -----
    After the first error, all data are dropped, so a later flush of buffers raises no error.
    """

    def __init__(
        self, descriptor: int, name: str, *, quiet: bool = False, owned: bool = True
    ) -> None:
        super().__init__()
        self._owned = owned
        self._descriptor = descriptor
        self._name = name
        self._quiet = quiet
        self.lost = False

    def writable(self) -> bool:
        """Return True: the output stream is writable."""
        return True

    def seekable(self) -> bool:
        """Return True if the stream supports seeking."""
        try:
            os.lseek(self._descriptor, 0, os.SEEK_CUR)
        except OSError:
            return False
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Move to a byte offset in the stream, and return the new position."""
        return os.lseek(self._descriptor, offset, whence)

    def fileno(self) -> int:
        """Return the file descriptor of the output stream."""
        return self._descriptor

    def isatty(self) -> bool:
        """Return True if the output stream is a terminal."""
        return os.isatty(self._descriptor)

    def write(self, data: Any, /) -> int:
        """Write all bytes to the stream, and return their number."""
        left = memoryview(data).cast("B")
        size = len(left)
        while left and not self.lost:
            try:
                left = left[os.write(self._descriptor, left) :]
            except BlockingIOError:  # another process made it non-blocking: wait
                select.select([], [self._descriptor], [])
            except OSError as error:
                self._fail(error)
        return size

    def close(self) -> None:
        """Close the stream. On a network file system, an error about a full disk may occur only now."""
        if self.closed:
            return
        super().close()
        if not self._owned:
            return
        try:
            os.close(self._descriptor)
        except OSError as error:
            if not self.lost:
                self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.lost = True
        if isinstance(error, BrokenPipeError):
            raise ReaderGoneError(f"{self._name}: the reader closed the pipe") from error
        if not self._quiet:
            raise ExportError(f"{self._name}: {reason_of(error)}") from error


class OutputFile:
    """Output file that gets its final name only when it is complete.

    Parameters
    ----------
    to : str or Path
        Final path. An existing file is replaced, with the same permissions; a link stays a link.

    Raises
    ------
    ExportError
        The place is not writable.
    """

    def __init__(self, to: str | Path) -> None:
        self._to = Path(to)
        self._stack = ExitStack()
        self._stream: io.BufferedWriter | None = None
        with _export_errors(self._to):
            self._target = _target(self._to)
            self._in_place = self._target is None
            self._path = None if self._target is None else self._folder(self._target) / "output"
            if self._path is not None and self._to.suffix:
                self._path = self._path.with_suffix(self._to.suffix)

    def _folder(self, target: Path) -> Path:
        try:
            return self._stack.enter_context(HeldFolder(target.parent, FILE_PREFIX)).path
        except OSError as error:
            if error.errno not in _NOT_REPLACEABLE or not target.exists():
                raise
            self._in_place = True
            return self._stack.enter_context(working_folder("output"))

    def path(self) -> Path:
        """Return a temporary path for the content. :meth:`keep` moves the file to its final path."""
        if self._path is None:
            with _export_errors(self._to):
                self._path = self._stack.enter_context(working_folder("output")) / "output"
        return self._path

    def stream(self) -> BinaryIO:
        """Return a byte stream for the content of the output file.

        It closes with the output; use it instead of :meth:`path`.
        """
        with _export_errors(self._to):
            if self._path is None:
                descriptor = _descriptor(self._to)
            else:
                descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        self._stream = io.BufferedWriter(Stream(descriptor, str(self._to)), 1 << 16)
        return self._stream

    def keep(self) -> None:
        """Complete the output file, and move it to its final path.

        Raises
        ------
        ExportError
            The file is not writable; the previous file does not change.
        """
        try:
            if self._stream is not None:
                self._stream.close()
            if self._path is not None:
                with _export_errors(self._to):
                    self._move(self._path)
        finally:
            self.discard()

    def _move(self, content: Path) -> None:
        target = self._target
        if target is None or self._in_place:
            _copy(content, target or self._to, str(self._to))
            return
        if target.exists():
            _keep_owner_and_mode(content, target)
        try:
            content.replace(target)
        except OSError as error:
            if error.errno not in _NOT_REPLACEABLE or not target.exists():
                raise
            _copy(content, target, str(self._to))

    def discard(self) -> None:
        """Discard the new output file. An older file at the final path stays unchanged."""
        if self._stream is not None and not self._stream.closed:
            raw = self._stream.raw
            if isinstance(raw, Stream):
                raw.lost = True
            self._stream.close()
        self._stack.close()


@contextmanager
def _complete(to: str | Path) -> Generator[OutputFile]:
    """Context manager with an output file. It is kept at the end, or discarded after an exception."""
    output = OutputFile(to)
    try:
        yield output
        output.keep()
    finally:
        output.discard()


@contextmanager
def written(to: str | Path) -> Generator[BinaryIO]:
    """Context manager with a byte stream. At the end, the file appears completely, or not at all.

    Raises
    ------
    ExportError
        The file is not writable; the previous file does not change.
    """
    with _complete(to) as output:
        yield output.stream()


@contextmanager
def written_text(to: str | Path) -> Generator[TextIO]:
    """Context manager to write a UTF-8 text file. The file appears only when it is complete.

    The file appears complete at the end. Line ends stay, and invalid characters become escapes.
    """
    with written(to) as stream:
        text = io.TextIOWrapper(stream, "utf-8", errors="backslashreplace", newline="")
        yield text
        text.detach()


@contextmanager
def written_at(to: str | Path) -> Generator[Path]:
    """Context manager with a temporary path. At the end, the file moves to its final path.

    Raises
    ------
    ExportError
        The file is not writable; the previous file does not change.
    """
    with _complete(to) as output, _export_errors(Path(to)):
        yield output.path()


def write_bytes(to: str | Path, data: bytes) -> None:
    """Write a file atomically: it appears completely, or not at all.

    Raises
    ------
    ExportError
        The file is not writable; the previous file does not change.
    """
    with written(to) as stream:
        stream.write(data)


@contextmanager
def _export_errors(to: Path) -> Generator[None]:
    """Context manager that converts operating system errors to :class:`ExportError`."""
    try:
        yield
    except OSError as error:
        raise ExportError(f"{to}: {reason_of(error)}") from error
    except ValueError as error:  # a name with a null character
        raise ExportError(f"{str(to)!r}: {error}") from error


def _target(to: Path) -> Path | None:
    """Return the file that the output replaces, with links resolved; ``None`` for a pipe or open stream."""
    try:
        about = to.stat()
    except FileNotFoundError:
        return Path(os.path.realpath(to))
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(about.st_mode) or _open_here(to, about) is not None:
        return None
    if not os.access(to, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    return Path(os.path.realpath(to))


def _open_here(to: Path, about: os.stat_result) -> int | None:
    """Return the open file descriptor that a name such as ``/dev/stdout`` refers to, or ``None``."""
    named = _DESCRIPTOR.fullmatch(str(to))
    if named:
        return int(named[1] or named[2])
    for descriptor in (1, 2):
        with suppress(OSError):
            if os.path.samestat(about, os.fstat(descriptor)):
                return descriptor
    return None


def _descriptor(to: Path) -> int:
    """Open an existing pipe, device or stream for writing, and return the file descriptor."""
    descriptor = _open_here(to, to.stat())
    if descriptor is None:
        return os.open(to, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):  # keeps the order of outputs
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
    return os.dup(descriptor)


def _copy(content: Path, to: Path, name: str) -> None:
    """Copy a file into an existing file or stream that cannot be replaced.

    The space is reserved first, so that a full disk does not damage an existing file.
    """
    about = to.stat()
    plain = stat.S_ISREG(about.st_mode) and _open_here(to, about) is None
    descriptor = os.open(to, os.O_WRONLY) if plain else _descriptor(to)
    with content.open("rb") as source, io.BufferedWriter(Stream(descriptor, name)) as sink:
        if plain:
            _reserve(descriptor, about.st_size, content.stat().st_size)
        shutil.copyfileobj(source, sink)
        if plain:
            sink.flush()
            os.ftruncate(descriptor, content.stat().st_size)


def _reserve(descriptor: int, before: int, size: int) -> None:
    """Reserve disk space for longer content. If the disk is full, restore the file size and raise an error."""
    if size <= before or not hasattr(os, "posix_fallocate"):
        return
    try:
        os.posix_fallocate(descriptor, before, size - before)
    except OSError as error:
        os.ftruncate(descriptor, before)
        if error.errno not in {errno.EOPNOTSUPP, errno.EINVAL}:  # not supported: write at once
            raise


def _keep_owner_and_mode(content: Path, target: Path) -> None:
    """Give a new file the owner and mode of the old file, and flush it to disk."""
    about = target.stat()
    with suppress(OSError):
        os.chown(content, about.st_uid, about.st_gid)
    content.chmod(stat.S_IMODE(about.st_mode))
    descriptor = os.open(content, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
