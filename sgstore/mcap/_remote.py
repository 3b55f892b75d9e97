"""Recordings in object stores and on web servers, read with obstore.

A recording is named by its URL: ``s3://bucket/day1/a.mcap``, ``https://host/a.mcap``. For single messages, only
their byte ranges are transferred. For a complete reading, the file is copied first (:func:`copied`). Readers
then use the copy, and all other code uses the URL.
"""

from __future__ import annotations

import io
import os
import secrets
import time
from contextlib import closing, contextmanager, suppress
from datetime import timedelta
from errno import EINVAL, EIO, ENOENT
from functools import cache, lru_cache
from importlib import import_module
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any, Final
from zlib import crc32

from sgstore.errors import MissingExtraError, TraceError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator
    from pathlib import Path

TRIES: Final = 4
"""Number of attempts if a response of an object store is incomplete."""

PIECE: Final = 1 << 20
"""Size of a request when single messages are read; bytes."""

COPIED: Final = 16 << 20
"""Size of a request when a whole object is copied; bytes."""

_copies: Final[dict[str, Path]] = {}
"""URL → path of its current local copy."""


@cache
def object_stores() -> Any:
    """Import the package obstore, and return it.

    Raises
    ------
    MissingExtraError
        The extra ``cluster`` is not installed.
    """
    try:
        found = import_module("obstore")
        import_module("obstore.store")
        import_module("obstore.exceptions")
    except ImportError as error:
        raise MissingExtraError("recordings and collections elsewhere", "cluster") from error
    return found


def object_store_at(url: str) -> Any:
    """Open the object store at a URL. Requests are repeated after temporary errors."""
    return object_stores().store.from_url(url, **_options(url))


def _options(url: str) -> dict[str, Any]:
    """Return client settings for an object store. A private S3 server may use plain HTTP."""
    retry = {
        "max_retries": TRIES,
        "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=5)},
        "retry_timeout": timedelta(seconds=60),
    }
    endpoint = os.environ.get("AWS_ENDPOINT_URL", os.environ.get("AWS_ENDPOINT", ""))
    plain = url.startswith("http:") or (url.startswith("s3") and endpoint.startswith("http://"))
    return {"retry_config": retry} | ({"client_options": {"allow_http": True}} if plain else {})


def reason_of_object_store(error: BaseException) -> tuple[str, bool]:
    """Return the reason for an object store error as one line, and True if the object does not exist."""
    wrong = object_stores().exceptions
    if isinstance(error, FileNotFoundError | wrong.NotFoundError):
        return "object or bucket not found", True
    refused = PermissionError, wrong.PermissionDeniedError, wrong.UnauthenticatedError
    if isinstance(error, refused):
        return "access is refused: look at the credentials", False
    told = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(told.split())[:300], False


def fetch_object(store: Any, name: str, file: IO[bytes]) -> None:
    """Download an object into an open file. Try again if the data end too early.

    Raises
    ------
    OSError
        Every try ends early, or the file cannot be written.
    obstore.exceptions.BaseError
        The object store refuses the object.
    """
    objects, size = object_stores(), -1
    for left in reversed(range(TRIES)):
        file.seek(0)
        file.truncate()
        found = objects.get(store, name)
        size = found.meta["size"]
        try:
            for piece in found.stream(min_chunk_size=PIECE):
                file.write(piece)
        except objects.exceptions.BaseError:
            if not left:
                raise
        else:
            if file.tell() == size:
                return
        time.sleep(0.1 * (TRIES - left))
    raise OSError(EIO, f"ends before its {size} bytes do")


@lru_cache(maxsize=64)
def _opened(root: str, endpoint: str) -> Any:
    del endpoint  # part of the cache key
    return object_store_at(root)


def _at(url: str) -> tuple[Any, str]:
    """Return the object store for a URL, and the name of the object in it."""
    scheme, _, rest = url.partition("://")
    host, _, name = rest.partition("/")
    root = f"{scheme}://{host}"
    key = [os.environ.get(one, "") for one in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT", *_KEYS)]
    return _opened(root, "\n".join(key)), name


_KEYS: Final = ("AWS_ACCESS_KEY_ID", "AWS_SESSION_TOKEN", "AWS_PROFILE")


@contextmanager
def _told(url: str) -> Generator[None]:
    try:
        yield
    except (object_stores().exceptions.BaseError, OSError) as error:
        reason, missing = reason_of_object_store(error)
        if missing:
            raise FileNotFoundError(ENOENT, reason, url) from error
        raise TraceError(reason, path=url) from error


def _mark(about: Any) -> tuple[int, int]:
    """Return size (bytes) and modification time (ns) of an object in an object store.

    Object stores report whole seconds. The digits below one second are a hash of the object's tag, so that they
    differ between two versions within a second.
    """
    changed, tag = about["last_modified"], about["e_tag"]
    within = crc32(tag.encode()) % 1_000_000_000 if tag else changed.microsecond * 1000
    return about["size"], int(changed.timestamp()) * 1_000_000_000 + within


def mark_of_url(url: str) -> tuple[int, int]:
    """Return size (bytes) and modification time (ns) of the object at a URL.

    Raises
    ------
    FileNotFoundError
        The object does not exist.
    TraceError
        The object store refuses the request.
    """
    copy = _copies.get(url)
    if copy is not None:
        status = copy.stat()
        return status.st_size, status.st_mtime_ns
    with _told(url):
        store, name = _at(url)
        return _mark(object_stores().head(store, name))


def names_below(url: str) -> Iterator[str]:
    """Yield the URLs of all objects below a URL of an object store, in any order.

    Raises
    ------
    TraceError
        The object store refuses the request.
    """
    scheme, _, rest = url.partition("://")
    host = rest.partition("/")[0]
    with _told(url):
        store, name = _at(url)
        for some in object_stores().list(store, prefix=name.rstrip("/") or None):
            for one in some:
                yield f"{scheme}://{host}/{one['path']}"


def open_url(url: str) -> io.BufferedReader:
    """Open the object at a URL, or its local copy, for reading.

    Raises
    ------
    FileNotFoundError
        The object does not exist.
    TraceError
        The object store refuses the object.
    """
    copy = _copies.get(url)
    return copy.open("rb") if copy is not None else io.BufferedReader(RemoteFile(url), PIECE)


class NoRangesError(TraceError):
    """Error: a server does not support byte ranges."""


class RemoteFile(io.RawIOBase):
    """File object for a remote recording, which downloads only the needed byte ranges.

    Attributes
    ----------
    mark : (int, int)
        Size and modification time of the object; bytes, ns.
    """

    def __init__(self, url: str) -> None:
        super().__init__()
        self.name = url
        with _told(url):
            self._store, self._key = _at(url)
            about = object_stores().head(self._store, self._key)
        self._tag = about["e_tag"]
        self._whole: IO[bytes] | None = None
        self._position = 0
        self.mark = _mark(about)

    def readable(self) -> bool:
        """Return True: the file is readable."""
        return True

    def seekable(self) -> bool:
        """Return True: the read position can be changed."""
        return True

    def tell(self) -> int:
        """Return the read position in the file; bytes."""
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Change the read position in the file, and return it."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self.mark[0]}[whence]
        if base + offset < 0:
            raise OSError(EINVAL, "negative position")
        self._position = base + offset
        return self._position

    def readinto(self, buffer: Any, /) -> int:
        """Read bytes into a buffer until it is full or the object ends."""
        view = memoryview(buffer).cast("B")
        stop = min(self._position + len(view), self.mark[0])
        if stop <= self._position:
            return 0
        data = self.piece(self._position, stop)
        view[: len(data)] = data
        self._position = stop
        return len(data)

    def close(self) -> None:
        """Close the remote file."""
        if self._whole is not None:
            self._whole.close()
        super().close()

    def piece(self, start: int, stop: int) -> memoryview:
        """Return a byte range of the remote file. Without server support, the whole file is downloaded.

        Raises
        ------
        FileNotFoundError
            The object no longer exists.
        TraceError
            The object was replaced or is not available.
        """
        if self._whole is None:
            try:
                return self._range(start, stop)
            except NoRangesError:
                self._whole = self._fetched()
        self._whole.seek(start)
        return memoryview(self._whole.read(stop - start))

    def _range(self, start: int, stop: int) -> memoryview:
        asked: dict[str, Any] = {"range": (start, stop)}
        if self._tag:
            asked["if_match"] = self._tag
        wrong = object_stores().exceptions

        def ask() -> memoryview:
            try:
                found = object_stores().get(self._store, self._key, options=asked)
                return memoryview(found.bytes())
            except wrong.PreconditionError as error:
                raise TraceError("it was replaced while it was read", path=self.name) from error
            except wrong.NotSupportedError as error:
                raise NoRangesError("its server lacks range support", path=self.name) from error

        return whole(self.name, stop - start, ask)

    def _fetched(self) -> IO[bytes]:
        """Download the whole remote file into a temporary file without a name."""
        file = TemporaryFile()  # noqa: SIM115  closed in close()
        with _told(self.name):
            fetch_object(self._store, self._key, file)
        return file


def whole(url: str, size: int, ask: Callable[[], memoryview]) -> memoryview:
    """Repeat a download request up to a few times, until all bytes have arrived.

    Raises
    ------
    FileNotFoundError
        The object does not exist.
    TraceError
        The bytes do not arrive; the message contains the reason.
    """
    wrong, reason = object_stores().exceptions, ""
    final = wrong.NotFoundError, wrong.PermissionDeniedError, wrong.UnauthenticatedError
    for done in range(TRIES):
        if done:
            time.sleep(0.1 * done)
        with _told(url):
            try:
                data = ask()
            except final:
                raise
            except wrong.BaseError as error:
                reason, _ = reason_of_object_store(error)
                continue
        if len(data) == size:
            return data
        reason = f"{len(data)} bytes came of {size}"
    raise TraceError(f"not read in {TRIES} tries: {reason}", path=url)


@contextmanager
def copied(urls: list[str], folder: Path) -> Generator[None]:
    """Context manager: copy remote files to a local folder, and read the copies inside the block.

    Raises
    ------
    FileNotFoundError
        The object does not exist.
    TraceError
        The object is incomplete, or the disk is full.
    """
    made: dict[str, Path] = {}
    try:
        for url in urls:
            path = folder / f"copy-{secrets.token_hex(6)}"
            try:
                _copy(url, path)
            finally:
                made[url] = path
            _copies[url] = path
        yield
    finally:
        for url, path in made.items():
            _copies.pop(url, None)
            with suppress(OSError):
                path.unlink(missing_ok=True)


def _copy(url: str, path: Path) -> None:
    file = RemoteFile(url)
    size, changed = file.mark
    with closing(file):
        pieces = (file.piece(at, min(at + COPIED, size)) for at in range(0, size, COPIED))
        with path.open("wb") as to:
            for piece in pieces:
                try:
                    to.write(piece)
                except OSError as error:
                    reason = f"no copy of it can be written: {error.strerror}"
                    raise TraceError(reason, path=url) from error
    os.utime(path, ns=(changed, changed))
