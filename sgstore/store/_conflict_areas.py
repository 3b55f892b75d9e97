"""Measures of conflict areas (areas that two objects cross) for all pairs of an object, trace by trace.

Notes
-----
The footprints of an object and of all others are compared in one pass over columns. If the object is the
ego, the following traces are read ahead: each time twice as many, up to a number of states. So a question
about one trace reads one trace, and a question about the store reads it once, in any order of the pairs.
The cache keeps the measures, not the states. Its memory is bounded in bytes.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

import numpy as np

from sgstore.model.criticality import FIXED_KINDS, OF_AREAS, crossings_of
from sgstore.model.frame_ids import SEQ_BITS, trace_of

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterator, Mapping

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.model.world import Floats, Ints

MOST_BYTES: Final = 64 << 20
"""Largest size of the cached measures of conflict areas."""
MOST_STATES: Final = 1 << 20
"""Number of states that are compared together. The objects of a longer trace are divided into parts."""
_MOST_TRACES: Final = 64
"""Largest number of traces that are compared together."""

_MOVING: Final = f"""
SELECT frame_id, node_id, x, y, heading, length, width FROM {{scope}}state
WHERE frame_id BETWEEN $1 AND $2 AND kind NOT IN {FIXED_KINDS}
  AND (abs(node_id) % $3 = $4 OR node_id = $5)
"""
_PLACE: Final = """radians(degrees({0}.heading)) AS heading,
  {0}.length::DOUBLE AS length, {0}.width::DOUBLE AS width"""
# One state is enough for an object that never moves.
_STANDING: Final = f"""
WITH present AS (
  SELECT DISTINCT k.bucket >> 18 AS trace_id, b.map_id, k.node_id
  FROM {{scope}}node k JOIN bucket b ON b.bucket = k.bucket
  WHERE k.bucket BETWEEN $1::BIGINT >> 6 AND $2::BIGINT >> 6 AND k.kind NOT IN {FIXED_KINDS}
    AND (abs(k.node_id) % $3 = $4 OR k.node_id = $5)
)
SELECT k.trace_id << 24 AS frame_id, k.node_id, t.origin_x + e.x AS x, t.origin_y + e.y AS y,
  {_PLACE.format("e")}
FROM present k JOIN trace t ON t.trace_id = k.trace_id
  JOIN entity e ON e.trace_id = k.trace_id AND e.node_id = k.node_id
UNION ALL
SELECT k.trace_id << 24, k.node_id, m.x, m.y, {_PLACE.format("m")}
FROM present k JOIN map_node m ON m.map_id = k.map_id AND m.node_id = k.node_id
"""
_TRACES: Final = """
SELECT t.trace_id, t.origin_x, t.origin_y, coalesce(sum(m.rows), 0)::BIGINT AS states
FROM trace t
  LEFT JOIN manifest m ON m.owner = 'trace' AND m.id = t.trace_id AND m."table" IN ('state', 'world_state')
GROUP BY ALL ORDER BY t.trace_id
"""
_TIMES: Final = "SELECT frame_id, t FROM frames WHERE frame_id BETWEEN ? AND ? ORDER BY frame_id"
_EGOS: Final = "SELECT trace_id, min(ego) FROM frame WHERE ego IS NOT NULL GROUP BY trace_id"


@dataclass(frozen=True)
class _Measured:
    """Measures of an object and some others: ids of the others, ascending, and values by measure."""

    nodes: Ints
    values: Mapping[str, Floats]

    @property
    def size(self) -> int:
        """Approximate size in bytes."""
        return 1024 + self.nodes.nbytes * (1 + len(self.values))


_T = TypeVar("_T")
_States: TypeAlias = "tuple[Ints, Ints, list[Floats]]"


class BoundedCache(OrderedDict[Any, _T]):
    """Cache of values with sizes in bytes. The oldest values are dropped beyond a total size."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self._most, self._total = most, 0
        self._sizes: dict[Hashable, int] = {}

    def keep(self, key: Hashable, value: _T, size: int) -> None:
        """Add a value, and drop the oldest ones if the cache is too large."""
        self._total += size - self._sizes.get(key, 0)
        self[key], self._sizes[key] = value, size
        self.move_to_end(key)
        while self._total > self._most and len(self) > 1:
            self._total -= self._sizes.pop(self.popitem(last=False)[0])


class ConflictAreas:
    """Measures of conflict areas in a store file that does not change, by object pair."""

    def __init__(self) -> None:
        self._known: BoundedCache[_Measured] = BoundedCache(MOST_BYTES)
        self._columns: BoundedCache[_States] = BoundedCache(MOST_BYTES)
        self._traces: dict[str, NDArray[Any]] = {}
        self._egos: dict[int, int] = {}
        self._ahead = 1

    def known(self, scope: str, trace: int, src: int) -> bool:
        """Return True if the measures of an object are in the cache."""
        return (scope, trace, src) in self._known

    def value(
        self, reader: DuckDBPyConnection, scope: str, measure: str, pair: tuple[int, int, int]
    ) -> float | None:
        """Return a measure of a trace and two of its objects. ``None`` means unknown or undefined.

        Parameters
        ----------
        reader : DuckDBPyConnection
            Connection that reads the states.
        scope : str
            ``known_`` for all known states; empty for those in the graphs.
        measure : str
            Name in ``OF_AREAS``.
        pair : tuple of int
            Trace, first and second object.
        """
        trace, src, dst = pair
        if not self.known(scope, trace, src):
            self._compute(reader, scope, trace, src)
        found = self._known.get((scope, trace, src), _NONE)
        place = int(found.nodes.searchsorted(dst))
        if place == len(found.nodes) or found.nodes[place] != dst:
            return None
        value = float(found.values[measure][place])
        return None if math.isnan(value) else value

    def _compute(self, reader: DuckDBPyConnection, scope: str, trace: int, src: int) -> None:
        """Compute the measures of an object; for an ego, also those of the egos of the following traces."""
        if not self._traces:
            self._traces = reader.execute(_TRACES).fetchnumpy()
            self._egos = dict(reader.execute(_EGOS).fetchall())
        ids, sizes = self._traces["trace_id"], self._traces["states"]
        first = int(ids.searchsorted(trace))
        if first == len(ids) or ids[first] != trace:
            return
        sources, total = {trace: src}, int(sizes[first])
        ahead = range(first + 1, min(first + self._ahead, len(ids)))
        for i in ahead if self._egos.get(trace) == src else ():
            other, size = int(ids[i]), int(sizes[i])
            ego = self._egos.get(other)
            if ego is None or total + size > MOST_STATES or self.known(scope, other, ego):
                break
            sources[other], total = ego, total + size
        if self._egos.get(trace) == src:
            self._ahead = min(2 * self._ahead, _MOST_TRACES)
        parts = -(-total // MOST_STATES)
        found = self._measured(reader, scope, sources, max(parts, 1))
        # The newest value of the cache is never dropped.
        for one, measured in sorted(found, key=lambda pair: pair[0] == trace):
            self._known.keep((scope, one, sources[one]), measured, measured.size)

    def _measured(
        self, reader: DuckDBPyConnection, scope: str, sources: dict[int, int], parts: int
    ) -> Iterator[tuple[int, _Measured]]:
        """Yield the measures of an object in each of some traces."""
        found = []
        for part in range(parts):
            states = self._states(reader, scope, sources, (parts, part))
            found.append(crossings_of(*states, sources))
        traces, nodes, crossed = (np.concatenate(one) for one in zip(*found, strict=True))
        when = _times(reader, crossed)
        values = {name: of(when) for name, of in OF_AREAS.items()}
        for trace in sources:
            rows = np.flatnonzero(traces == trace)
            rows = rows[np.argsort(nodes[rows])]
            yield trace, _Measured(nodes[rows], {name: one[rows] for name, one in values.items()})

    def _states(
        self, reader: DuckDBPyConnection, scope: str, sources: dict[int, int], part: tuple[int, int]
    ) -> _States:
        """Return the states of all objects in some traces, or of a part of the objects."""
        key = scope, *sources, *part
        if len(sources) == 1 and key in self._columns:
            return self._columns[key]
        ends = [min(sources) << SEQ_BITS, ((max(sources) + 1) << SEQ_BITS) - 1]
        source = next(iter(sources.values()))
        found = [
            reader.execute(sql.format(scope=scope), [*ends, *part, source]).fetchnumpy()
            for sql in (_MOVING, _STANDING)
        ]
        frame, node, *boxes = (
            np.concatenate([_filled(one[name]) for one in found]) for name in found[0]
        )
        moving = slice(0, len(found[0]["frame_id"]))
        trace = self._traces["trace_id"].searchsorted(trace_of(frame[moving]))
        for i, name in enumerate(("origin_x", "origin_y")):
            boxes[i][moving] += self._traces[name][trace]
        boxes[2][moving] = np.radians(np.degrees(boxes[2][moving]))  # as in the view of all states
        states = frame, node, boxes
        if len(sources) == 1 and part[0] == 1:
            self._columns.keep(key, states, 7 * frame.nbytes)
        return states


_NONE: Final = _Measured(np.zeros(0, np.int64), {})


def _filled(column: NDArray[Any]) -> NDArray[Any]:
    """Return a column without a mask: integers, or float64 with NaN for NULL."""
    if column.dtype.kind != "f":
        return np.ma.getdata(column).astype(np.int64, copy=False)
    found = np.ma.getdata(column).astype(np.float64)
    found[np.ma.getmask(column)] = np.nan
    return found


def _times(reader: DuckDBPyConnection, frames: Ints) -> Floats:
    """Return the times of frames, in the same shape; NaN for -1."""
    known = frames[frames >= 0]
    if not len(known):
        return np.full(frames.shape, np.nan)
    ends = [int(known.min()), int(known.max())]
    found = reader.execute(_TIMES, ends).fetchnumpy()
    ids, times = (np.asarray(found[name]) for name in ("frame_id", "t"))
    rows = np.minimum(ids.searchsorted(frames), len(ids) - 1)
    return np.where(frames >= 0, times[rows], np.nan)
