"""Long tasks of the explorer page: coverage, comparison of two stores, export or lock of selected clips.

Each function implements the task of its name, with the fields as parameters.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.apps.explorer._plain_words import feature_words, plain_sentence
from sgstore.base.json_text import finite
from sgstore.base.processes import send_reply
from sgstore.errors import StoreError
from sgstore.exporters import Export, write_export
from sgstore.model.frame_ids import frame_ids
from sgstore.model.vocabulary import RELATIONS
from sgstore.model.world import Clip
from sgstore.query import Store
from sgstore.store import MessagePlaces, StateColumns
from sgstore.testsets.coverage import (
    ChosenFrames,
    classed,
    classes,
    combos,
    covered,
    features,
    growth,
)
from sgstore.testsets.diff import by_frame, scenes
from sgstore.testsets.locks import ENDING, Lock, lock_of
from sgstore.testsets.scenes import phrases

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.testsets.coverage import ReportTable

    Clips = Sequence[tuple[str, int, int]]

MOST_ROWS: Final = 2000
"""Largest number of table rows that are sent. The total number of rows is sent too."""

MOST_PAIRED: Final = 48
"""Number of features in the matrix of missing pairs."""

MOST_IN_WORDS: Final = 200
"""Number of classes that are described in words."""


def coverage(store: Store, what: str, abstraction: str) -> dict[str, Any]:
    """Return a coverage table of a store: classes by rank, growth, or missing pairs of features.

    Parameters
    ----------
    store : Store
    what : str
        ``classes``, ``growth``, ``combos`` or ``matrix``.
    abstraction : str
    """
    of = classed(ChosenFrames(store.file.path.name, store), abstraction)
    if what == "growth":
        return _table(growth(of, "frame", 80))
    if what == "matrix":
        found = features(of, abstraction, of_ego=True).matrix(MOST_PAIRED)
        return {**found, "words": [*map(_in_words, found["names"])]}
    if what == "classes":
        table = classes(of)
        shown = table.column("frame")[:MOST_IN_WORDS]
        return {**_table(table), "words": phrases(store, shown)}
    found = combos(of, abstraction, 2)
    tables = {"shares": found.shares, "missing": found.missing, "covered": found.covered}
    return {name: _table(table) for name, table in tables.items()}


def select(store: Store, clips: Clips, abstraction: str) -> dict[str, Any]:
    """Return the length of the selected clips, and the share of the store's scene classes that they cover.

    Returns
    -------
    dict
        ``clips``, ``frames``, ``seconds``, ``bytes``; ``kept``: a table of shares.
    """
    with store.file.snapshot():
        parts = list(_frames(store, clips))
        frame_id = np.sort(np.concatenate([np.zeros(0, np.int64), *(ids for _, ids, _ in parts)]))
        sizes = (lengths for _, lengths in MessagePlaces.lengths(store.file, frame_id))
        size = sum(int(lengths.sum()) for lengths in sizes) if len(frame_id) else 0
        whole = classed(ChosenFrames("the store", store), abstraction)
        some = classed(ChosenFrames("the selection", store, frame_id), abstraction)
        kept = _table(covered(whole, some))
    seconds = sum((lasts for *_, lasts in parts), 0.0)
    about = {"clips": len(clips), "frames": len(frame_id), "seconds": seconds}
    return {**about, "bytes": size, "kept": kept}


def lock(store: Store, clips: Clips, to: str, **_: str) -> dict[str, Any]:
    """Write the selected clips as a lock file (list of test cases with checksums)."""
    path, made = Path(to if to.endswith(ENDING) else f"{to}{ENDING}"), _locked(store, clips)
    made.write(path)
    return {"result": {"file": str(path), "cases": len(made.cases)}}


def download(store: Store, clips: Clips) -> dict[str, Any]:
    """Return the text of a lock with the selected clips. Nothing is written."""
    made = _locked(store, clips)
    return {"result": {"text": made.text(), "cases": len(made.cases)}}


def _locked(store: Store, clips: Clips) -> Lock:
    with store.file.snapshot():
        found = _frames(store, clips)
        parts = [(ids, StateColumns(store.file).log_times(*clip), "") for clip, ids, _ in found]
        return lock_of(store, parts, {"chosen": "in the explorer"}, progress=_done)


def export(store: Store, clips: Clips, to: str, format: str) -> dict[str, Any]:
    """Export the selected clips into a folder, in a file format."""
    with store.file.snapshot():
        times = [(clip[0], StateColumns(store.file).log_times(*clip)) for clip in clips]
    cut = tuple(Clip(trace, int(log.min()), int(log.max())) for trace, log in times)
    written = write_export(Export(store, cut, progress=_done), Path(to), format)
    losses = [f"{one.file.name}: {loss.reason}" for one in written for loss in one.losses]
    files = [one.file.name for one in written]
    return {"result": {"folder": to, "files": files, "losses": losses}}


def diff(store: Store, other: str, abstraction: str) -> dict[str, Any]:
    """Return the scenes and frames in which two stores differ."""
    with Store(other) as second:
        a, b = (classed(ChosenFrames(s.file.path.name, s), abstraction) for s in (store, second))
        return {"result": {"scenes": _table(scenes(a, b)), "frames": _table(by_frame(a, b))}}


def _done(done: int, whole: int) -> None:
    send_reply({"progress": [done, whole], "more": True})


def _frames(store: Store, clips: Clips) -> Iterator[tuple[tuple[str, int, int], Any, float]]:
    """Merge overlapping clips. Yield each clip with the ids of its frames and its length; s."""
    traces = {one.name: one for one in store.traces()}
    for trace, first, last in _apart(clips):
        of = traces.get(trace) or store.file.trace(
            trace
        )  # raises an error that lists the known traces
        if last >= of.frames:
            raise StoreError(f"no frame #{last} in {trace!r}; it has #0 … #{of.frames - 1}")
        ids = frame_ids(of.trace_id, np.arange(first, last + 1))
        yield (trace, first, last), ids, len(ids) * of.period_ns / 1e9


def _apart(clips: Clips) -> list[tuple[str, int, int]]:
    """Return clips sorted by trace and time. Overlapping or adjacent clips are merged."""
    found: list[tuple[str, int, int]] = []
    for trace, first, last in sorted(clips):
        if found and found[-1][0] == trace and first <= found[-1][2] + 1:
            found[-1] = trace, found[-1][1], max(found[-1][2], last)
        else:
            found.append((trace, first, last))
    return found


def _table(of: ReportTable) -> dict[str, Any]:
    """Convert a result table to JSON values for the page, in plain words. Long tables are cut."""
    of_words = [_WORDS.get(name) for name in of.columns]
    rows = [
        [
            value if words is None else words(value)
            for words, value in zip(of_words, row, strict=True)
        ]
        for row in finite(of.rows[:MOST_ROWS])
    ]
    said = [*map(plain_sentence, of.said)]
    return {"columns": of.columns, "rows": rows, "of": len(of.rows), "said": said}


def _in_words(feature: str) -> str:
    return feature_words(feature, frozenset(RELATIONS))


_WORDS: Final = {
    "combination": _in_words,
    "measure": plain_sentence,
    "denominator": plain_sentence,
}
"""Column of a table → function that returns its texts in plain words."""
