"""Local cache of the bundles (store files) of a collection: each is fetched and verified once.

The name of a bundle is the SHA-256 of its file. A bundle in a local folder is used in place. A
verified bundle is remembered by the file's inode, size and time, so that it is not hashed for each
query.
"""

from __future__ import annotations

import json
import os
import secrets
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sgstore.collection._storage import digest_of_file
from sgstore.errors import StoreError

if TYPE_CHECKING:
    from sgstore.collection._storage import Place

CACHE: Final = "SGSTORE_CACHE"
"""Environment variable: the folder for fetched bundles."""


def cache_folder() -> Path:
    """Return the folder for fetched bundles (store files of a collection), and create it if missing.

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
            f"{folder}: cannot be written: {error.strerror}; {CACHE} names another folder for bundles"
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
        raise StoreError(f"{path}: cannot be written: {error.strerror or error}") from error
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
