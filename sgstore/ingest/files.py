"""Which recordings are meant by the names that people give."""

from __future__ import annotations

from glob import glob, has_magic
from pathlib import Path
from typing import TYPE_CHECKING

from sgstore.errors import StoreError
from sgstore.traces import ENDINGS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


def recordings(names: Iterable[str | Path]) -> list[Path]:
    """The files that are meant: each once, in the order in which they are named.

    Parameters
    ----------
    names : iterable of str or Path
        Files; folders, which stand for the recordings in them and below; and patterns (``drives/*/day?.mcap``,
        ``**`` for any depth) that no shell has expanded. What is in a folder or fits a pattern is sorted.

    Raises
    ------
    StoreError
        A folder holds no recording, or nothing fits a pattern.
    """
    return list(dict.fromkeys(path for name in names for path in _meant(Path(name))))


def _meant(path: Path) -> Iterator[Path]:
    if path.is_dir():
        inside = sorted(p for p in path.rglob("*") if is_recording(p))
        if not inside:
            raise StoreError(
                f"{path}: no recording ({', '.join(ENDINGS)}) in this folder or below it"
            )
        yield from inside
    elif has_magic(str(path)) and not path.exists():
        fitting = sorted(glob(str(path), recursive=True))  # noqa: PTH207  absolute patterns, too
        if not fitting:
            raise StoreError(f"{path}: no file fits this pattern")
        for name in fitting:
            yield from _meant(Path(name))
    else:
        yield path


def is_recording(path: Path) -> bool:
    """Whether a file is named as a recording is."""
    return path.name.lower().endswith(ENDINGS) and path.is_file()
