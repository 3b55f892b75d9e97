"""Which recordings are meant by the names that people give."""

from __future__ import annotations

from glob import glob, has_magic
from pathlib import Path
from typing import TYPE_CHECKING

from sgstore.errors import StoreError, TraceError
from sgstore.traces import ENDINGS
from sgstore.traces.parts import METADATA, bag_folder, parts_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from sgstore.traces.parts import Part


def recordings(names: Iterable[str | Path]) -> list[Path]:
    """The files that are meant: each once, in the order in which they are named.

    Parameters
    ----------
    names : iterable of str or Path
        Files; folders, which stand for the recordings in them and below; bags, by their folder or their
        ``metadata.yaml``; and patterns (``drives/*/day?.mcap``, ``**`` for any depth) that no shell has
        expanded. What is in a folder or fits a pattern is sorted.

    Raises
    ------
    StoreError
        A folder holds no recording, or nothing fits a pattern.
    """
    return list(dict.fromkeys(path for name in names for path in _meant(Path(name))))


def _meant(path: Path) -> Iterator[Path]:
    if path.name == METADATA:
        yield path.parent
    elif path.is_dir():
        inside = sorted(_inside(path))
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


def _inside(folder: Path) -> Iterator[Path]:
    """The recordings in a folder and below it; the files that a bag consists of are none themselves."""
    bags = {path.parent for path in folder.rglob(METADATA) if bag_folder(path.parent) is not None}
    own = {part.path for bag in bags for part in _parts(bag)}
    yield from bags
    yield from (path for path in folder.rglob("*") if is_recording(path) and path not in own)


def _parts(bag: Path) -> tuple[Part, ...]:
    """The files of a bag; of one that cannot be read none, and reading it says why."""
    try:
        return parts_of(bag)
    except TraceError:
        return ()


def is_recording(path: Path) -> bool:
    """Whether a file is named as a recording is."""
    return path.name.lower().endswith(ENDINGS) and path.is_file()
