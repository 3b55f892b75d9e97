"""Storage of a collection: a local folder, or a prefix in an object store such as S3.

Files are written and removed, but never changed. A file appears complete or not at all. If two
processes write the same name at once, one of them learns that it was late.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sgstore.errors import StoreError, reason_of, url_named
from sgstore.mcap import (
    fetch_object,
    object_store_at,
    object_stores,
    reason_of_object_store,
)

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

ABOUT: Final = "COLLECTION.json"
"""Name of the file that marks a folder as a collection."""

PIECE: Final = 1 << 20
"""Number of bytes that one read returns at most."""


class MissingObjectError(StoreError):
    """Error for a missing file of a collection."""


def place_at(url: str | Path) -> Place:
    """Return the storage of a collection at a path or URL.

    Parameters
    ----------
    url : str or Path
        A folder, or ``s3://bucket/prefix``, ``gs://…``, ``az://…``.

    Raises
    ------
    MissingExtraError
        The place is an object store, and the extra ``cluster`` is not installed.
    """
    remote = url_named(url)
    return _Folder(Path(str(url).removeprefix("file://"))) if remote is None else _Remote(remote)


def digest_of_file(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises
    ------
    StoreError
        The file cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while piece := file.read(PIECE):
                digest.update(piece)
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {reason_of(error)}") from error
    return digest.hexdigest()


class _Folder:
    """Local folder with the files of a collection, with names such as ``bundles/….sgstore``.

    Attributes
    ----------
    url : str
        Its name for users.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        self.url = str(self.root)

    @contextmanager
    def _told(self, name: str) -> Generator[None]:
        try:
            yield
        except FileNotFoundError as error:
            raise MissingObjectError(f"{self.root / name}: file not found") from error
        except OSError as error:
            if self.root.is_file():
                raise StoreError(f"{self.root}: a file, and a collection is a folder") from error
            raise StoreError(f"{self.root / name}: {reason_of(error)}") from error

    def read(self, name: str) -> bytes:
        """Return the content of a file."""
        with self._told(name):
            return (self.root / name).read_bytes()

    def write_new(self, name: str, data: bytes) -> bool:
        """Write a new file; return False if a file with this name exists."""
        with self._told(name), self._beside(name) as (fresh, path):
            with fresh.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            try:
                os.link(fresh, path)
            except OSError as error:
                # A network drive may report an error after it has made the link.
                if path.exists() and path.samefile(fresh):
                    return True
                if isinstance(error, FileExistsError):
                    return False
                raise
            return True

    def upload(self, path: Path, name: str) -> None:
        """Copy a local file to a name in the storage."""
        with self._told(name), self._beside(name) as (fresh, to):
            shutil.copyfile(path, fresh)
            with fresh.open("rb") as file:
                os.fsync(file.fileno())  # a snapshot names the file: both survive a power failure
            fresh.replace(to)

    @contextmanager
    def _beside(self, name: str) -> Generator[tuple[Path, Path]]:
        """Yield a temporary path for a new file, and its final path. At the end, delete the temporary file."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = path.with_name(f".{path.name}.{secrets.token_hex(6)}")
        try:
            yield fresh, path
        finally:
            fresh.unlink(missing_ok=True)

    def fetch(self, name: str, to: Path) -> None:
        """Copy a file from the storage to a local path."""
        with self._told(name):
            shutil.copyfile(self.root / name, to)

    def names(self, folder: str) -> Iterator[tuple[str, int, float]]:
        """Yield the name, size in bytes and time (s since 1970) of all files below a folder."""
        with self._told(folder):
            for path in sorted((self.root / folder).rglob("*")):
                if path.is_file() and not path.name.startswith("."):
                    about = path.stat()
                    yield path.relative_to(self.root).as_posix(), about.st_size, about.st_mtime

    def remove(self, name: str) -> None:
        """Remove a file from the storage; a missing file is ignored."""
        path = self.root / name
        with self._told(name):
            path.unlink(missing_ok=True)
        with suppress(OSError):  # the folder may contain other files
            if path.parent != self.root:
                path.parent.rmdir()

    def local(self, name: str) -> Path:
        """Return the local path of a stored file; ``None`` if it must be copied to this machine first."""
        return self.root / name


class _Remote:
    """Storage of a collection in an object store, by the package obstore, which retries requests."""

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self._objects = object_stores()
        with self._told(""):
            self._store = object_store_at(self.url)

    @contextmanager
    def _told(self, name: str) -> Generator[None]:
        where = f"{self.url}/{name}".rstrip("/")
        try:
            yield
        except (self._objects.exceptions.BaseError, OSError) as error:
            reason, missing = reason_of_object_store(error)
            raise (MissingObjectError if missing else StoreError)(f"{where}: {reason}") from error

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
        with self._told(name), to.open("wb") as file:
            fetch_object(self._store, name, file)

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


CACHE: Final = "SGSTORE_CACHE"
"""Environment variable for the folder in which copies of remote bundles are stored."""


def cache_folder() -> Path:
    """Return the folder for copies of remote bundles (store files). If the folder is missing, create it.

    Raises
    ------
    StoreError
        The folder cannot be created.
    """
    told = os.environ.get(CACHE)
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    folder = Path(told) if told else Path(base).expanduser() / "sgstore"
    try:
        (folder / "bundles").mkdir(parents=True, exist_ok=True)
        (folder / "seen").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(
            f"{folder}: cannot be written: {reason_of(error)}; {CACHE} names another folder for bundles"
        ) from error
    return folder


def bundle_path(place: Place, sha: str, *, again: bool = False) -> Path:
    """Return the path of a bundle (store file of a collection) on this machine, after verification.

    Parameters
    ----------
    place : Place
    sha : str
    again : bool
        True to verify the file again.

    Raises
    ------
    StoreError
        The file is missing, cannot be fetched, or differs from the committed one.
    """
    folder, name = cache_folder(), f"bundles/{sha}.sgstore"
    path = place.local(name)
    if path is None:
        path = folder / name
        if not path.exists():
            _fetch(place, name, sha, path)
            return path
    if again or not _seen(folder, sha, path):
        if (held := digest_of_file(path)) != sha:
            raise StoreError(
                f"{place.url}/{name}: not as it was committed: its SHA-256 is {held[:12]}…;"
                " put the file back from a copy, or remove its traces from the collection"
            )
        _remember(folder, sha, path)
    return path


def _fetch(place: Place, name: str, sha: str, path: Path) -> None:
    fresh = path.with_name(f".{sha}.{os.getpid()}-{secrets.token_hex(4)}")
    try:
        place.fetch(name, fresh)
        if (held := digest_of_file(fresh)) != sha:
            raise StoreError(
                f"{place.url}/{name}: not as it was committed: its SHA-256 is {held[:12]}…"
            )
        fresh.replace(path)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {reason_of(error)}") from error
    finally:
        with suppress(OSError):
            fresh.unlink(missing_ok=True)


def _stamp(path: Path) -> list[int]:
    about = path.stat()
    return [about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns]


def _seen(folder: Path, sha: str, path: Path) -> bool:
    """True if a bundle file has been verified and has not changed since."""
    try:
        return json.loads((folder / "seen" / sha).read_text()) == _stamp(path)
    except FileNotFoundError:
        if not path.exists():
            raise StoreError(f"{path}: a bundle that the catalogue speaks of is gone") from None
        return False
    except (OSError, ValueError):
        return False


def _remember(folder: Path, sha: str, path: Path) -> None:
    fresh = folder / "seen" / f".{sha}.{os.getpid()}"
    with suppress(OSError):  # then it is verified again
        fresh.write_text(json.dumps(_stamp(path)))
        fresh.replace(folder / "seen" / sha)


Place = _Folder | _Remote
"""Storage of a collection."""
