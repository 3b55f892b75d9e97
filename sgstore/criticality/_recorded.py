"""The recorded measures of a store: the ego with each of those that it could meet, trace by trace."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.coverage import ReportTable
from sgstore.criticality._closest import dce_recorded, ttce_recorded
from sgstore.criticality._collision import ttc_recorded
from sgstore.criticality._encounter import Encounter, Track
from sgstore.criticality._encroachment import et_recorded, pet
from sgstore.criticality._exposure import tet, tit
from sgstore.criticality._headway import headway_recorded
from sgstore.criticality._potential import cpi
from sgstore.errors import ConfigError
from sgstore.quoting import literal
from sgstore.vocabulary import MAP_KINDS, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from sgstore.query import Store
    from sgstore.world import Floats

_FIXED: Final = (*MAP_KINDS, *SIGNALS, "building", "pole", "barrier", "vegetation")
_STATES: Final = (
    *("x", "y", "z", "radians(heading)", "length", "width"),
    *("vx", "vy", "ax", "ay"),
)


@dataclass(frozen=True)
class RecordedMeasure:
    """A measure of an encounter.

    Attributes
    ----------
    doc, unit : str
    of : callable
        Its value, or its values in the frames that have both.
    least : bool
        Whether the least of the values in the frames is that of the encounter, and not the first one.
    worse : str
        Which values are the more critical ones: ``low`` or ``high``; empty: neither.
    """

    doc: str
    unit: str
    of: Callable[[Encounter], float | Floats]
    least: bool = False
    worse: str = "low"

    def value(self, encounter: Encounter) -> float:
        """The value of an encounter; NaN: not known, or there is none."""
        found = np.atleast_1d(self.of(encounter))
        if self.least:
            found = found[~np.isnan(found)]
            return float(found.min()) if len(found) else math.nan
        return float(found[0]) if len(found) else math.nan


RECORDED: Final = {
    "pet": RecordedMeasure(
        "post-encroachment time: from when one has left the area that both drive over to when the other one"
        " comes into it",
        "s",
        pet,
    ),
    "et_recorded": RecordedMeasure(
        "encroachment time: how long a is in that area", "s", et_recorded, worse="high"
    ),
    "ttc_recorded": RecordedMeasure(
        "time until the footprints first touch, from the first frame that has both on",
        "s",
        ttc_recorded,
    ),
    "headway_recorded": RecordedMeasure(
        "least time until a has come to where b is now", "s", headway_recorded, least=True
    ),
    "dce_recorded": RecordedMeasure("least gap", "m", dce_recorded),
    "ttce_recorded": RecordedMeasure(
        "time until the least gap, from the first frame that has both on",
        "s",
        ttce_recorded,
        worse="",
    ),
    "tet": RecordedMeasure("time exposed to a ttc of at most 2 s", "s", tet, worse="high"),
    "tit": RecordedMeasure("the same, weighted by how far below 2 s", "s²", tit, worse="high"),
    "cpi": RecordedMeasure(
        "crash potential index: mean probability that braking would not suffice",
        "share",
        cpi,
        worse="high",
    ),
}
"""Measures by name."""


def encounters(store: Store, trace: str) -> Iterator[tuple[int, int, str, Encounter]]:
    """The ego of a trace with each of those that it could meet: node ids of both, the kind, the tracks.

    Parameters
    ----------
    store : Store
    trace : str
        Its name.
    """
    kinds = ", ".join(map(literal, _FIXED))
    states = ", ".join(f"{column}::DOUBLE AS s{i}" for i, column in enumerate(_STATES))
    sql = f"""
      SELECT n.node_id, n.kind::VARCHAR AS kind, n.is_ego, f.t, {states}
      FROM nodes n JOIN frames f USING (frame_id)
      WHERE f.trace = ? AND n.kind NOT IN ({kinds}) ORDER BY n.node_id, f.t
    """  # noqa: S608  names of ours
    found = store.file.arrays(sql, [trace])
    node = np.asarray(found["node_id"]).astype(np.int64)
    rows = np.stack(
        [
            np.ma.filled(np.ma.asarray(found[f"s{i}"]).astype(np.float64), np.nan)
            for i in range(len(_STATES))
        ],
        axis=1,
    )
    times = np.asarray(found["t"]).astype(np.float64)
    ego = np.ma.filled(np.ma.asarray(found["is_ego"]).astype(np.bool_), fill_value=False)
    begins = np.flatnonzero(np.diff(node, prepend=node[:1] - 1)) if len(node) else np.zeros(0, int)
    spans = list(zip(begins.tolist(), [*begins[1:].tolist(), len(node)], strict=True))
    tracks = [(int(node[i]), str(found["kind"][i]), Track(times[i:j], rows[i:j])) for i, j in spans]
    for (own, _, track), (i, j) in zip(tracks, spans, strict=True):
        if ego[i:j].any():
            for other, kind, met in tracks:
                if other != own:
                    yield own, other, kind, Encounter(track, met)


def recorded(store: Store, measures: Sequence[str] = tuple(RECORDED)) -> ReportTable:
    """Recorded measures of each ego with each of those that it could meet; a row for each pair and trace.

    Parameters
    ----------
    store : Store
    measures : sequence of str
        Names in :data:`RECORDED`.

    Returns
    -------
    ReportTable
        ``trace``, ``src``, ``dst``, ``kind``, and each measure. ``None``: not known, or there is none.

    Raises
    ------
    ConfigError
        There is no such measure.
    """
    wrong = next((name for name in measures if name not in RECORDED), None)
    if wrong is not None:
        raise ConfigError(f"no recorded measure: {wrong!r}; expected some of {', '.join(RECORDED)}")
    rows: list[tuple[Any, ...]] = []
    for trace in store.traces():
        for own, other, kind, encounter in encounters(store, trace.name):
            values = [RECORDED[name].value(encounter) for name in measures]
            told = [None if math.isnan(value) else value for value in values]
            rows.append((trace.name, own, other, kind, *told))
    return ReportTable(("trace", "src", "dst", "kind", *measures), rows)
