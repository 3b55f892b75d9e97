"""Criticality measures over whole traces, between an object and all other objects.

Notes
-----
The states of an object and of all others are compared in one pass over columns. If the object is the ego,
the following traces are read ahead: each time twice as many, up to a number of states. So a question about
one trace reads one trace, and a question about the store reads it once, in any order of the pairs. The cache
keeps the measures, and the states of single traces. Its memory is bounded in bytes.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

import numpy as np

from sgstore.model.criticality import FIXED_KINDS, OF_AREAS, Meetings
from sgstore.model.frame_ids import SEQ_BITS, trace_of
from sgstore.model.pair_numbers import COLUMNS

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    from sgstore.model.world import Floats, Ints

MOST_BYTES: Final = 64 << 20
"""Largest size of the cached measures, and the same limit for the cached states; bytes."""
MOST_STATES: Final = 1 << 19
"""Number of states that are compared at once. The objects of a longer trace are compared in parts."""
_MOST_TRACES: Final = 64
"""Largest number of following traces that are computed in advance."""

_PART: Final = f"k.kind NOT IN {FIXED_KINDS} AND (abs(k.node_id) % $3 = $4 OR k.node_id = $5)"
_PLACE: Final = """radians(degrees({0}.heading)) AS heading,
  {0}.length::DOUBLE AS length, {0}.width::DOUBLE AS width"""
_MOVING: Final = f"""
SELECT frame_id, node_id, x, y, heading, length, width{{motion}} FROM {{scope}}state k
WHERE frame_id BETWEEN $1 AND $2 AND {_PART}
"""
_STANDING: Final = f"""
WITH present AS (
  SELECT k.bucket, b.map_id, k.node_id, k.mask FROM {{scope}}node k JOIN bucket b ON b.bucket = k.bucket
  WHERE k.bucket BETWEEN $1::BIGINT >> 6 AND $2::BIGINT >> 6 AND {_PART}
)
SELECT k.bucket, k.node_id, k.mask, t.origin_x + e.x AS x, t.origin_y + e.y AS y,
  {_PLACE.format("e")}
FROM present k JOIN trace t ON t.trace_id = k.bucket >> 18
  JOIN entity e ON e.trace_id = t.trace_id AND e.node_id = k.node_id
UNION ALL
SELECT k.bucket, k.node_id, k.mask, m.x, m.y, {_PLACE.format("m")}
FROM present k JOIN map_node m ON m.map_id = k.map_id AND m.node_id = k.node_id
"""
_TRACES: Final = """
SELECT t.trace_id, t.origin_x, t.origin_y, coalesce(sum(m.rows), 0)::BIGINT AS states
FROM trace t
  LEFT JOIN manifest m ON m.owner = 'trace' AND m.id = t.trace_id AND m."table" IN ('state', 'world_state')
GROUP BY ALL ORDER BY t.trace_id
"""
_TIMES: Final = "SELECT frame_id, t FROM frames WHERE frame_id BETWEEN $1 AND $2 ORDER BY frame_id"
_EGOS: Final = (
    "SELECT DISTINCT frame_id >> 24 AS trace_id, node_id FROM state WHERE is_ego ORDER BY ALL"
)
_BITS: Final = np.arange(60)

_T = TypeVar("_T")
_States: TypeAlias = "tuple[Ints, Ints, Ints, Floats]"
_Traces: TypeAlias = "Mapping[str, NDArray[Any]]"


class BoundedCache(OrderedDict[Any, _T]):
    """Cache of values with their sizes in bytes. It drops the oldest values above a total size."""

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


class RecordedValues:
    """Cache of criticality measures of object pairs over whole traces. The store file must not change."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self._known: BoundedCache[tuple[Ints, Floats]] = BoundedCache(MOST_BYTES)
        self._columns: BoundedCache[_States] = BoundedCache(MOST_BYTES)
        self._traces: dict[str, NDArray[Any]] = {}
        self._egos: dict[int, int] = {}
        self._ahead = 1

    def known(self, scope: str, measure: str, trace: int, src: int) -> bool:
        """Return True if the cache has the values of a measure for an object."""
        return (scope, measure, trace, src) in self._known

    def value(
        self, reader: DuckDBPyConnection, scope: str, measure: str, pair: tuple[int, int, int]
    ) -> float | None:
        """Return a measure for two objects of a trace; ``None`` if it is unknown or undefined.

        Parameters
        ----------
        reader : DuckDBPyConnection
            Connection that reads the states.
        scope : str
            ``known_`` for all known states; empty for those in the graphs.
        measure : str
        pair : tuple of int
            Trace, first and second object.
        """
        trace, src, dst = pair
        if not self.known(scope, measure, trace, src):
            self._compute(reader, scope, measure, trace, src)
        nodes, values = self._known.get((scope, measure, trace, src), _NONE)
        place = int(nodes.searchsorted(dst))
        if place == len(nodes) or nodes[place] != dst or math.isnan(values[place]):
            return None
        return float(values[place])

    def _compute(
        self, reader: DuckDBPyConnection, scope: str, measure: str, trace: int, src: int
    ) -> None:
        """Compute a measure of an object with all others. For an ego, include the egos of the next traces."""
        if not self._traces:
            self._traces = reader.execute(_TRACES).fetchnumpy()
            self._egos = {one: min(nodes) for one, nodes in _egos(reader).items()}
        ids, sizes = self._traces["trace_id"], self._traces["states"]
        first = int(ids.searchsorted(trace))
        if first == len(ids) or ids[first] != trace:
            return
        sources, total = {trace: src}, int(sizes[first])
        ahead = range(first + 1, min(first + self._ahead, len(ids)))
        for i in ahead if self._egos.get(trace) == src else ():
            other, size = int(ids[i]), int(sizes[i])
            ego = self._egos.get(other)
            full = total + size > MOST_STATES
            if ego is None or full or self.known(scope, measure, other, ego):
                break
            sources[other], total = ego, total + size
        if self._egos.get(trace) == src:
            self._ahead = min(2 * self._ahead, _MOST_TRACES)
        part = {name: column[first : first + len(sources)] for name, column in self._traces.items()}
        names = [*OF_AREAS] if measure in OF_AREAS else [measure]
        found: dict[tuple[str, int], list[tuple[Ints, Floats]]] = {
            (name, one): [_NONE] for name in names for one in sources
        }
        for met in _meetings(reader, scope, part, sources, self._columns):
            begins = np.flatnonzero(np.diff(met.traces, prepend=-1))
            nodes = np.split(met.nodes, begins)[1:]
            for name in names:
                values = np.split(met.values(name), begins)[1:]
                for i, one in enumerate(met.traces[begins].tolist()):
                    found[name, one].append((nodes[i], values[i]))
        # The newest value of the cache is never dropped.
        for name, one in sorted(found, key=(measure, trace).__eq__):
            nodes, values = (
                np.concatenate(column) for column in zip(*found[name, one], strict=True)
            )
            order = np.argsort(nodes)
            known = nodes[order], values[order]
            self._known.keep((scope, name, one, sources[one]), known, 1024 + 2 * nodes.nbytes)


_NONE: Final = np.zeros(0, np.int64), np.zeros(0)


def _egos(reader: DuckDBPyConnection) -> dict[int, list[int]]:
    egos: dict[int, list[int]] = {}
    for trace, node in reader.execute(_EGOS).fetchall():
        egos.setdefault(trace, []).append(node)
    return egos


def meetings(reader: DuckDBPyConnection, measures: Sequence[str]) -> Iterator[Meetings]:
    """For each ego, yield its encounters with all other known objects, a group of traces at a time."""
    egos, traces = _egos(reader), reader.execute(_TRACES).fetchnumpy()
    window = np.cumsum(traces["states"]) // MOST_STATES
    for rows in np.split(np.arange(len(window)), np.flatnonzero(np.diff(window)) + 1):
        part = {name: column[rows] for name, column in traces.items()}
        some = [one for one in part["trace_id"].tolist() if one in egos]
        for turn in range(max((len(egos[one]) for one in some), default=0)):
            sources = {one: egos[one][turn] for one in some if turn < len(egos[one])}
            yield from _meetings(reader, "known_", part, sources, measures=measures)


def _meetings(
    reader: DuckDBPyConnection,
    scope: str,
    traces: _Traces,
    sources: Mapping[int, int],
    cache: BoundedCache[_States] | None = None,
    measures: Sequence[str] = (*Meetings.of_motion,),
) -> Iterator[Meetings]:
    """For one object of each trace, yield its encounters with the other objects, in parts."""
    ids = traces["trace_id"]
    parts = max(-(-int(traces["states"].sum()) // MOST_STATES), 1) if len(sources) == 1 else 1
    ends = [int(ids[0]) << SEQ_BITS, ((int(ids[-1]) + 1) << SEQ_BITS) - 1]
    found = reader.execute(_TIMES, ends).fetchnumpy()
    times = found["frame_id"].astype(np.int64), found["t"].astype(np.float64)
    motion = "" if Meetings.of_motion.isdisjoint(measures) else ", vx, vy, ax, ay"
    sql = [one.format(scope=scope, motion=motion) for one in (_MOVING, _STANDING)]
    wanted = np.array(list(sources))
    here = len(sources) == len(ids)
    for part in range(parts):
        key = scope, *sources
        read = None if cache is None else cache.get(key)
        if read is None:
            limits = [*ends, parts, part, next(iter(sources.values()))]
            read = _read(reader, sql, traces, limits)
            if cache is not None and parts == len(sources) == 1:
                cache.keep(key, read, read[3].nbytes + 3 * read[0].nbytes)
        *rows, states = read
        if not here:
            of_wanted = np.isin(trace_of(times[0]), wanted)
            times = times[0][of_wanted], times[1][of_wanted]
            rows = [one[np.isin(trace_of(rows[0]), wanted)] for one in rows]
        yield Meetings(*rows, states, sources, times)


def _read(
    reader: DuckDBPyConnection, sql: Sequence[str], traces: _Traces, limits: Sequence[int]
) -> _States:
    """Return the object states of some traces: frames, node ids, row numbers of the states, and the states."""
    moving, standing = (reader.execute(one, limits).fetchnumpy() for one in sql)
    frames, nodes = (
        np.ma.getdata(moving[name]).astype(np.int64) for name in ("frame_id", "node_id")
    )
    many = len(frames)
    states = np.zeros((10, many + len(standing["mask"]))).T  # columns are read more often than rows
    for i, name in enumerate(COLUMNS):
        for part, read in ((states[:many, i], moving), (states[many:, i], standing)):
            if name in read:
                part[:] = np.ma.getdata(read[name])
                part[np.ma.getmask(read[name])] = np.nan
    states[many:, 8:] = np.nan  # without a known acceleration
    of = traces["trace_id"].searchsorted(trace_of(frames))
    states[:many, 0] += traces["origin_x"][of]
    states[:many, 1] += traces["origin_y"][of]
    states[:many, 3] = np.radians(np.degrees(states[:many, 3]))  # as in the view of all states
    there, bit = np.nonzero(standing["mask"][:, None] >> _BITS & 1)
    return (
        np.append(frames, standing["bucket"][there] << 6 | bit),
        np.append(nodes, standing["node_id"].astype(np.int64)[there]),
        np.append(np.arange(many), many + there),
        states,
    )


def recorded_encounters(
    pairs: Mapping[str, NDArray[Any]], met: Iterable[Meetings], measures: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...], list[tuple[Any, ...]]]:
    """Return column names, types and rows of a table of object pairs with criticality measures.

    Parameters
    ----------
    pairs : mapping of str to array
        ``trace_id``, ``trace``, ``src``, ``dst`` and ``kind``; in the order of the ids.
    met : iterable of Meetings
    measures : sequence of str
        Names of recorded measures.
    """
    trace, src, dst = (pairs[name].astype(np.int64) for name in ("trace_id", "src", "dst"))
    traces, rank = np.unique(trace, return_inverse=True)
    egos, ego = np.unique(rank << 32 | src, return_inverse=True)
    keys = (ego << 32) + dst
    values = np.full((len(measures), len(keys)), np.nan)
    for one in met:
        ego = egos.searchsorted(traces.searchsorted(one.traces) << 32 | one.sources)
        wanted = (ego << 32) + one.nodes
        rows = np.minimum(keys.searchsorted(wanted), len(keys) - 1)
        listed = keys[rows] == wanted  # not the parts of a map
        for i, name in enumerate(measures):
            values[i, rows[listed]] = one.values(name)[listed]
    columns = [pairs["trace"].tolist(), src.tolist(), dst.tolist(), pairs["kind"].tolist()]
    for column in values:
        found = column.astype(object)
        found[np.isnan(column)] = None
        columns.append(found.tolist())
    types = ("VARCHAR", "INTEGER", "INTEGER", "VARCHAR", *["DOUBLE"] * len(measures))
    return ("trace", "src", "dst", "kind", *measures), types, [*zip(*columns, strict=True)]
