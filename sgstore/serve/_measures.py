"""Longer pieces of work of the page: coverage, ticked clips as a test set, two stores compared."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.coverage import ChosenFrames, classed, classes, combos, covered, growth
from sgstore.diff import by_frame, scenes
from sgstore.errors import StoreError
from sgstore.exporters import Export, write_export
from sgstore.locks import lock_of
from sgstore.store import frame_ids, lengths_of_messages
from sgstore.world import Clip

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from sgstore.coverage import ReportTable
    from sgstore.query import Store

    Progress = Callable[[int, int], None]
    Clips = Sequence[tuple[str, int, int]]

MOST_ROWS: Final = 2000
"""Rows of a table that the page is sent; it says how many there are."""


def measured(store: Store, what: str, abstraction: str) -> dict[str, Any]:
    """A table of coverage of a store: classes by rank, growth, or combinations of two features that lack.

    Parameters
    ----------
    store : Store
    what : str
        ``classes``, ``growth`` or ``combos``.
    abstraction : str
    """
    of = classed(ChosenFrames(store.file.path.name, store), abstraction)
    if what == "growth":
        return _table(growth(of, "frame", 80))
    if what == "classes":
        return _table(classes(of))
    found = combos(of, abstraction, 2)
    return {"shares": _table(found.shares), "missing": _table(found.missing)} | {
        "covered": _table(found.covered())
    }


def measured_clips(store: Store, clips: Clips, abstraction: str) -> dict[str, Any]:
    """Size of clips, and share of the store's classes that they keep.

    Returns
    -------
    dict
        ``clips``, ``frames``, ``seconds``, ``bytes``; ``kept``: a table of shares.
    """
    with store.file.snapshot():
        frame_id, seconds = _frames(store, clips)
        sizes = (lengths for _, lengths in lengths_of_messages(store.file, frame_id))
        size = sum(int(lengths.sum()) for lengths in sizes) if len(frame_id) else 0
        whole = classed(ChosenFrames("the store", store), abstraction)
        some = classed(ChosenFrames("the selection", store, frame_id), abstraction)
        kept = _table(covered(whole, some))
    about = {"clips": len(clips), "frames": len(frame_id), "seconds": seconds}
    return {**about, "bytes": size, "kept": kept}


def locked_clips(store: Store, clips: Clips, to: Path, progress: Progress) -> dict[str, Any]:
    """Write a lock of clips."""
    parts: list[Any] = []
    with store.file.snapshot():
        for clip in _apart(clips):
            frame_id, _ = _frames(store, [clip])
            times = _log_times(store, clip)
            parts.append((frame_id, times, ""))
        lock = lock_of(store, parts, {"chosen": "in the explorer"}, progress=progress)
    path = to.with_name(to.name if to.suffix == ".lock" else f"{to.name}.lock")
    lock.write(path)
    return {"file": str(path), "cases": len(lock.cases)}


def exported(store: Store, clips: Clips, to: Path, form: str, progress: Progress) -> dict[str, Any]:
    """Write clips in a format of export."""
    with store.file.snapshot():
        times = [(clip[0], _log_times(store, clip)) for clip in clips]
    cut = tuple(Clip(trace, int(log.min()), int(log.max())) for trace, log in times)
    written = write_export(Export(store, cut, progress=progress), to, form)
    losses = [f"{one.file.name}: {loss.reason}" for one in written for loss in one.losses]
    return {"folder": str(to), "files": [one.file.name for one in written], "losses": losses}


def differing(a: Store, b: Store, abstraction: str) -> dict[str, Any]:
    """Scenes and frames in which two stores differ."""
    both = [classed(ChosenFrames(one.file.path.name, one), abstraction) for one in (a, b)]
    return {"scenes": _table(scenes(*both)), "frames": _table(by_frame(*both))}


def _frames(store: Store, clips: Clips) -> tuple[Any, float]:
    """Ids of the frames of clips, each once, ascending; how many seconds they last."""
    ids, seconds = [np.zeros(0, np.int64)], 0.0
    for trace, first, last in _apart(clips):
        of = store.file.trace(trace)
        if last >= of.frames:
            raise StoreError(f"no frame #{last} in {trace!r}; it has #0 … #{of.frames - 1}")
        ids.append(frame_ids(of.trace_id, np.arange(first, last + 1)))
        seconds += (last - first + 1) * of.period_ns / 1e9
    return np.sort(np.concatenate(ids)), seconds


def _apart(clips: Clips) -> list[tuple[str, int, int]]:
    """Clips by trace and time; those that overlap or touch are one."""
    found: list[tuple[str, int, int]] = []
    for trace, first, last in sorted(clips):
        if found and found[-1][0] == trace and first <= found[-1][2] + 1:
            found[-1] = trace, found[-1][1], max(found[-1][2], last)
        else:
            found.append((trace, first, last))
    return found


def _log_times(store: Store, clip: tuple[str, int, int]) -> Any:
    trace, first, last = clip
    return store.file.log_times(trace, first, last)


def _table(of: ReportTable) -> dict[str, Any]:
    """A table as the page shows it; it says how many rows there are."""
    rows = [[_plain(value) for value in row] for row in of.rows[:MOST_ROWS]]
    return {"columns": of.columns, "rows": rows, "of": len(of.rows), "said": of.said}


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
