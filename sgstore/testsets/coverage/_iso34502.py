"""Coverage of the 24 traffic disturbances of ISO 34502: eight disturbances on three kinds of road.

The library has a pattern for each disturbance. Its parameter ``zone`` is the kind of road. All
patterns compare safe distances of RSS, and most of them need the lanes of a map. A trace without
these data has an unknown number of matches, which is not 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.lang.library import pattern_named
from sgstore.model.frame_ids import frame_ids, trace_of
from sgstore.testsets.coverage._chosen_frames import ChosenFrames, frames_of, traces_of
from sgstore.testsets.coverage._frames import ReportTable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.model.world import Ints
    from sgstore.testsets.coverage._frames import Row

ROADS: Final = ("main", "merge", "departure")
"""Kinds of road of the standard: values of the parameter ``zone``."""

DISTURBANCES: Final = {
    "iso_cut_in": ("keeps its lane", "cut-in"),
    "iso_cut_out": ("keeps its lane", "cut-out"),
    "iso_rear_accelerates": ("keeps its lane", "acceleration"),
    "iso_lead_brakes": ("keeps its lane", "deceleration"),
    "iso_change_cut_in": ("changes lanes", "cut-in"),
    "iso_change_cut_out": ("changes lanes", "cut-out"),
    "iso_change_rear_accelerates": ("changes lanes", "acceleration"),
    "iso_change_lead_brakes": ("changes lanes", "deceleration"),
}
"""Pattern of the library → behaviour of the ego, and of the other vehicle."""

COLUMNS: Final = (
    "road",
    "ego",
    "other",
    "state",
    "matches",
    "traces",
    "unknown_traces",
    "ego_frames",
    "pattern",
)


def iso34502(chosen: ChosenFrames) -> tuple[ReportTable, ReportTable, ReportTable]:
    """Count the matches of each of the 24 disturbances of ISO 34502 in selected frames.

    Parameters
    ----------
    chosen : ChosenFrames
        A match counts if its last frame is selected.

    Returns
    -------
    cells, covered, missing : ReportTable
        All 24 cells, and those that are covered or missing. ``state`` is ``covered`` with a match,
        ``unknown`` if no trace can answer (``matches`` is then ``None``), else ``missing``.
        ``unknown_traces`` counts the traces that cannot answer, ``ego_frames`` the frames with the ego
        on this kind of road.
    """
    said: dict[str, str] = {}
    with chosen.snapshot():
        rows = [row for road in ROADS for row in _cells_of(chosen, road, said)]
    states = [row[COLUMNS.index("state")] for row in rows]
    counts = ", ".join(f"{states.count(s)} {s}" for s in ("covered", "missing", "unknown"))
    notes = [f"{len(rows)} cells of ISO 34502 in {chosen.text}: {counts}", *said.values()]
    cells = ReportTable(COLUMNS, rows, notes)
    parts = [
        ReportTable(COLUMNS, [row for row, state in zip(rows, states, strict=True) if state == one])
        for one in ("covered", "missing")
    ]
    return cells, parts[0], parts[1]


def _cells_of(chosen: ChosenFrames, road: str, said: dict[str, str]) -> Iterator[Row]:
    """Yield the cells of one kind of road. Add a note for each unknown trace to ``said``."""
    there = f"MATCH (e:Ego) WHERE in_zone(e, '{road}')"
    on_road = _selected(chosen, frames_of(chosen.store, there))
    known = np.unique(trace_of(_selected(chosen, frames_of(chosen.store, f"{there} IS KNOWN"))))
    names = {one.name: one.trace_id for one in traces_of(chosen.store)}
    if chosen.frame_id is not None:
        wanted = set(trace_of(chosen.frame_id).tolist())
        names = {name: one for name, one in names.items() if one in wanted}
    for name, (ego, other) in DISTURBANCES.items():
        matches = chosen.store.find(pattern_named(name).written(zone=road))
        unknown = {of: why for of, why in matches.reasons.items() if of in names}
        for of, trace in names.items():
            if trace not in known:
                unknown.setdefault(of, "the ego is on no lane of a map")
        for of in sorted(unknown):
            said.setdefault(of, f"{of} is unknown: {unknown[of]}")
        # A match needs the ego on this road in its last frame.
        found = matches.intervals() if len(on_road) else iter(())
        last = [(names[i.trace], i.end_seq) for i in found if i.trace in names]
        ends = _selected(chosen, frame_ids(*np.array(last, np.int64).reshape(-1, 2).T))
        state = "covered" if len(ends) else "unknown" if len(unknown) == len(names) else "missing"
        yield (
            road,
            ego,
            other,
            state,
            None if state == "unknown" else len(ends),
            len(np.unique(trace_of(ends))),
            len(unknown),
            len(on_road),
            f"{name} zone={road}",
        )


def _selected(chosen: ChosenFrames, frame_id: Ints) -> Ints:
    """Return those of the given frames that belong to the selection."""
    if chosen.frame_id is None:
        return frame_id
    return frame_id[np.isin(frame_id, chosen.frame_id)]
