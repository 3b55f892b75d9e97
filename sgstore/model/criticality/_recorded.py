"""Recorded criticality measures by name. Their values for the ego and each other object in a store."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from sgstore.base.quoting import literal
from sgstore.errors import ConfigError
from sgstore.model.vocabulary import MAP_KINDS, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from sgstore.model.criticality._encounter import Encounter, Track

_FIXED: Final = (*MAP_KINDS, *SIGNALS, "building", "pole", "barrier", "vegetation")
_STATES: Final = (
    *("x", "y", "z", "radians(heading)", "length", "width"),
    *("vx", "vy", "ax", "ay"),
)


@dataclass(frozen=True, slots=True)
class RecordedMeasure:
    """Criticality measure of two objects over a whole recording. It has a description and a unit.

    Attributes
    ----------
    name : str
    doc, unit : str
    least : bool
        True if the value of the encounter is the least value of the frames, and not the first one.
    worse : str
        The more critical values: ``low`` or ``high``; empty for neither.
    """

    name: str
    doc: str
    unit: str
    least: bool = False
    worse: str = "low"

    @property
    def meaning(self) -> str:
        """Description and unit of the criticality measure in one line."""
        return f"{self.doc}; {self.unit}; of what was recorded: the same in each frame of a trace"

    def value(self, encounter: Encounter) -> float:
        """Return the criticality measure for the tracks of two objects; NaN if unknown or undefined."""
        of = getattr(import_module("sgstore.model.criticality"), self.name)
        found = np.atleast_1d(of(encounter))
        if self.least:
            found = found[~np.isnan(found)]
            return float(found.min()) if len(found) else math.nan
        return float(found[0]) if len(found) else math.nan


RECORDED: Final = {
    one.name: one
    for one in (
        RecordedMeasure(
            "pet",
            "post-encroachment time: from when one has left the area that both drive over to when the other one"
            " comes into it",
            "s",
        ),
        RecordedMeasure(
            "et_recorded", "encroachment time: how long a is in that area", "s", worse="high"
        ),
        RecordedMeasure(
            "ttc_recorded",
            "time until the footprints first touch, from the first frame that has both on",
            "s",
        ),
        RecordedMeasure(
            "headway_recorded", "least time until a has come to where b is now", "s", least=True
        ),
        RecordedMeasure("dce_recorded", "least gap", "m"),
        RecordedMeasure(
            "ttce_recorded",
            "time until the least gap, from the first frame that has both on",
            "s",
            worse="",
        ),
        RecordedMeasure("tet", "time exposed to a ttc of at most 2 s", "s", worse="high"),
        RecordedMeasure("tit", "the same, weighted by how far below 2 s", "s²", worse="high"),
        RecordedMeasure(
            "cpi",
            "crash potential index: mean probability that braking would not suffice",
            "share",
            worse="high",
        ),
    )
}
"""Criticality measures of whole recordings by name."""


_FRAMES: Final = 2**24
"""Number of frame ids that a trace occupies. It makes database look-ups fast."""
FIXED_KINDS: Final = f"({', '.join(map(literal, _FIXED))})"
"""SQL list of the kinds of entities that never move and cannot be met."""

_columns = ", ".join(f"{column}::DOUBLE AS s{i}" for i, column in enumerate(_STATES))
TRACKS: Final = f"""
  SELECT n.node_id, n.kind::VARCHAR AS kind, n.is_ego, f.t, {_columns}
  FROM {{nodes}} n JOIN frames f USING (frame_id)
  WHERE n.frame_id BETWEEN $1::BIGINT * {_FRAMES} AND $1::BIGINT * {_FRAMES} + {_FRAMES - 1}
    AND n.kind NOT IN {FIXED_KINDS}"""  # noqa: S608  names of ours
"""SQL that selects the states of a trace from a view ``nodes``, as input of :func:`tracks_of`."""

KNOWN: Final = "known "
"""Prefix in the name of a measure that also uses states outside the graphs."""


def tracks_of(found: Mapping[str, Any]) -> list[tuple[int, str, bool, Track]]:
    """Convert table columns to the tracks of objects, each with node id, kind, and True for an ego.

    Parameters
    ----------
    found : mapping of str to array
        The columns of :data:`TRACKS`, in any order of rows.
    """
    from sgstore.model.criticality._encounter import Track

    order = np.lexsort((np.asarray(found["t"]), np.asarray(found["node_id"])))
    node = np.asarray(found["node_id"]).astype(np.int64)[order]
    rows = np.empty((len(node), len(_STATES)))
    for i in range(len(_STATES)):
        rows[:, i] = np.ma.filled(np.ma.asarray(found[f"s{i}"]).astype(np.float64), np.nan)[order]
    times = np.asarray(found["t"]).astype(np.float64)[order]
    ego = np.ma.filled(np.ma.asarray(found["is_ego"]).astype(np.bool_), fill_value=False)[order]
    kinds = np.asarray(found["kind"])
    begins = np.flatnonzero(np.diff(node, prepend=node[:1] - 1)).tolist()
    spans = zip(begins, [*begins[1:], len(node)], strict=True) if begins else ()
    return [
        (int(node[i]), str(kinds[order[i]]), bool(ego[i:j].any()), Track(times[i:j], rows[i:j]))
        for i, j in spans
    ]


class _Asked(Protocol):
    """Interface of a store file, reduced to the methods that the recorded measures use."""

    def arrays(self, sql: str, parameters: Sequence[object] | None = None) -> Mapping[str, Any]: ...
    def recorded_encounters(self, measures: Sequence[str]) -> Any: ...
    def trace(self, ref: int | str) -> Any: ...


class _Store(Protocol):
    @property
    def file(self) -> _Asked: ...


def encounters(store: _Store, trace: str) -> Iterator[tuple[int, int, str, Encounter]]:
    """Yield each pair of the ego and another object of a trace: node ids, kind and tracks.

    The states include known ones outside the graphs, up to ``[range] world``.

    Parameters
    ----------
    store : Store
    trace : str
        Its name.
    """
    from sgstore.model.criticality._encounter import Encounter

    sql = TRACKS.format(nodes="world_nodes")
    tracks = tracks_of(store.file.arrays(sql, [store.file.trace(trace).trace_id]))
    for own, _, is_ego, track in tracks:
        for other, kind, _, met in tracks if is_ego else ():
            if other != own:
                yield own, other, kind, Encounter(track, met)


def recorded(store: _Store, measures: Sequence[str] = tuple(RECORDED)) -> Any:
    """Return a table of recorded criticality measures: one row per trace, ego and other object.

    The pairs are those of the view ``encounters``.

    Parameters
    ----------
    store : Store
    measures : sequence of str
        Names in :data:`RECORDED`.

    Returns
    -------
    Rows
        ``trace``, ``src``, ``dst``, ``kind``, and each measure. ``None`` means unknown or
        undefined.

    Raises
    ------
    ConfigError
        The measure is unknown.
    """
    wrong = next((name for name in measures if name not in RECORDED), None)
    if wrong is not None:
        raise ConfigError(f"no recorded measure: {wrong!r}; expected some of {', '.join(RECORDED)}")
    return store.file.recorded_encounters(measures)
