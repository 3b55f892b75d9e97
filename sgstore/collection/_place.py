"""Places of collections: a folder, or a prefix in an object store.

Nothing that is there is ever changed, but for being removed: a file appears complete or not at all, and of two
who write the same name at once one is told that it was late.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import time
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from sgstore.errors import MissingExtraError, StoreError

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

PIECE: Final = 1 << 20
"""Bytes that are read at a time."""

TRIES: Final = 4
"""How often is asked for what an object store did not give whole."""

_SCHEMES: Final = ("s3://", "s3a://", "gs://", "az://", "abfs://", "http://", "https://")


class MissingObjectError(StoreError):
    """There is no file of that name at a place."""


class Place(Protocol):
    """A folder of files with names such as ``bundles/….sgstore``.

    Attributes
    ----------
    url : str
        As people name it.
    """

    url: str

    def read(self, name: str) -> bytes:
        """Return the content of a file."""
        ...

    def write_new(self, name: str, data: bytes) -> bool:
        """Write a file unless there is one of that name; tell whether it was written."""
        ...

    def upload(self, path: Path, name: str) -> None:
        """Write a file with the content of a local one."""
        ...

    def fetch(self, name: str, to: Path) -> None:
        """Copy a file to a local place."""
        ...

    def names(self, folder: str) -> Iterator[tuple[str, int, float]]:
        """Names of the files in a folder and below it; bytes, and when each was written (s since 1970)."""
        ...

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        ...

    def local(self, name: str) -> Path | None:
        """The file on this machine; ``None`` if it must be fetched."""
        ...


def place_at(url: str | Path) -> Place:
    """The place of a collection.

    Parameters
    ----------
    url : str or Path
        A folder, or ``s3://bucket/prefix``, ``gs://…``, ``az://…``.

    Raises
    ------
    MissingExtraError
        It is in an object store, and the extra ``cluster`` is not installed.
    """
    text = str(url)
    return _Remote(text) if is_remote(text) else _Folder(Path(text.removeprefix("file://")))


def is_remote(url: str | Path) -> bool:
    """Tell whether a place is in an object store."""
    return str(url).startswith(_SCHEMES)


def digest_of_file(path: Path) -> str:
    """SHA-256 of a file.

    Raises
    ------
    StoreError
        It cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while piece := file.read(PIECE):
                digest.update(piece)
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror}") from error
    return digest.hexdigest()


class _Folder:
    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        self.url = str(self.root)

    @contextmanager
    def _told(self, name: str) -> Generator[None]:
        try:
            yield
        except FileNotFoundError as error:
            raise MissingObjectError(f"{self.root / name}: there is no such file") from error
        except OSError as error:
            raise StoreError(f"{self.root / name}: {error.strerror or error}") from error

    def read(self, name: str) -> bytes:
        with self._told(name):
            return (self.root / name).read_bytes()

    def write_new(self, name: str, data: bytes) -> bool:
        with self._told(name), self._beside(name) as (fresh, path):
            with fresh.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            try:
                os.link(fresh, path)
            except FileExistsError:
                return False
            return True

    def upload(self, path: Path, name: str) -> None:
        with self._told(name), self._beside(name) as (fresh, to):
            shutil.copyfile(path, fresh)
            fresh.replace(to)

    @contextmanager
    def _beside(self, name: str) -> Generator[tuple[Path, Path]]:
        """A place for a file on its way, which is gone in the end, and its own place."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = path.with_name(f".{path.name}.{secrets.token_hex(6)}")
        try:
            yield fresh, path
        finally:
            fresh.unlink(missing_ok=True)

    def fetch(self, name: str, to: Path) -> None:
        with self._told(name):
            shutil.copyfile(self.root / name, to)

    def names(self, folder: str) -> Iterator[tuple[str, int, float]]:
        with self._told(folder):
            for path in sorted((self.root / folder).rglob("*")):
                if path.is_file() and not path.name.startswith("."):
                    about = path.stat()
                    yield path.relative_to(self.root).as_posix(), about.st_size, about.st_mtime

    def remove(self, name: str) -> None:
        path = self.root / name
        with self._told(name):
            path.unlink(missing_ok=True)
        with suppress(OSError):  # others are in it
            if path.parent != self.root:
                path.parent.rmdir()

    def local(self, name: str) -> Path:
        return self.root / name


class _Remote:
    """A place in an object store, by obstore: it asks again where that is worth it, a while later."""

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self._objects = _package()
        with self._told(""):
            self._store = self._objects.store.from_url(self.url, **_options(self.url))

    @contextmanager
    def _told(self, name: str) -> Generator[None]:
        where = f"{self.url}/{name}".rstrip("/")
        wrong = self._objects.exceptions
        try:
            yield
        except (FileNotFoundError, wrong.NotFoundError) as error:
            raise MissingObjectError(f"{where}: no such object, or no such bucket") from error
        except (PermissionError, wrong.PermissionDeniedError, wrong.UnauthenticatedError) as error:
            raise StoreError(f"{where}: access is refused: look at the credentials") from error
        except (wrong.BaseError, OSError) as error:
            text = " ".join(str(error).split())
            raise StoreError(f"{where}: {text[:300]}") from error

    def read(self, name: str) -> bytes:
        with self._told(name):
            return bytes(self._objects.get(self._store, name).bytes())

    def write_new(self, name: str, data: bytes) -> bool:
        with self._told(name):
            try:
                self._objects.put(self._store, name, data, mode="create")
            except self._objects.exceptions.AlreadyExistsError:
                return False
            return True

    def upload(self, path: Path, name: str) -> None:
        with self._told(name):
            self._objects.put(self._store, name, path)

    def fetch(self, name: str, to: Path) -> None:
        with self._told(name):
            size = -1
            for left in reversed(range(TRIES)):
                found = self._objects.get(self._store, name)
                size = found.meta["size"]
                try:
                    with to.open("wb") as file:
                        for piece in found.stream(min_chunk_size=PIECE):
                            file.write(piece)
                    if to.stat().st_size == size:
                        return
                except self._objects.exceptions.BaseError:
                    if not left:
                        raise
                time.sleep(0.1 * (TRIES - left))
            raise StoreError(f"{self.url}/{name}: ends before its {size} bytes do")

    def names(self, folder: str) -> Iterator[tuple[str, int, float]]:
        with self._told(folder):
            for some in self._objects.list(self._store, prefix=folder):
                for one in some:
                    yield one["path"], one["size"], one["last_modified"].timestamp()

    def remove(self, name: str) -> None:
        with suppress(MissingObjectError), self._told(name):
            self._objects.delete(self._store, name)

    def local(self, name: str) -> Path | None:
        del name  # it must be fetched
        return None


def _options(url: str) -> dict[str, Any]:
    """Settings of the client: an S3 of one's own may be reached by plain HTTP (AWS_ENDPOINT_URL)."""
    retry = {
        "max_retries": TRIES,
        "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=5)},
        "retry_timeout": timedelta(seconds=60),
    }
    endpoint = os.environ.get("AWS_ENDPOINT_URL", os.environ.get("AWS_ENDPOINT", ""))
    plain = url.startswith("http:") or (url.startswith("s3") and endpoint.startswith("http://"))
    return {"retry_config": retry} | ({"client_options": {"allow_http": True}} if plain else {})


@cache
def _package() -> Any:
    try:
        found = import_module("obstore")
        import_module("obstore.store")
        import_module("obstore.exceptions")
    except ImportError as error:
        raise MissingExtraError("obstore", "cluster") from error
    return found
