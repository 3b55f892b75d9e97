"""Criticality measures of object pairs over a whole trace, as an SQL function and an SQL view.

A measure needs the tracks of two entities, so SQL cannot express it. DuckDB calls a Python function for each
remaining row. A pair is computed once, and cached until the file changes. The function belongs to a database
instance, which can have several files; a macro of each connection selects the file. Both exist only for
statements that name them.
"""

from __future__ import annotations

import math
import re
import threading
from collections import OrderedDict
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import count
from typing import TYPE_CHECKING, Any, Final

import duckdb
from duckdb.func import FunctionNullHandling

from sgstore.errors import ConfigError
from sgstore.model.criticality import (
    FIXED_KINDS,
    KNOWN,
    OF_AREAS,
    RECORDED,
    TRACKS,
    tracks_of,
)
from sgstore.store._conflict_areas import BoundedCache, ConflictAreas
from sgstore.store._interrupts import interrupted
from sgstore.store._lease import stamp_of
from sgstore.store._schema import INSIDE

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable
    from pathlib import Path

    from duckdb import DuckDBPyConnection

    from sgstore.model.criticality import Track
    from sgstore.store._lease import Stamp

MOST_BYTES: Final = 64 << 20
"""Largest size of the cached object tracks. For a longer trace, only the states of the pair are read."""
_STATE_BYTES: Final = 11 * 8
"""Size of a state in a track: its time, and the columns of ``TRACKS``."""
_MOST_PAIRS: Final = 1 << 18
"""Number of pairs with cached measures, about 64 MiB."""
_MOST_CALLS: Final = 1 << 16
"""Number of calls whose values are returned without a look-up: a pair is measured again in each frame."""
_FILES: Final = 4
"""Number of files with cached measures."""

_WANTED: Final = re.compile(r"\b(recorded|encounters)\b", re.IGNORECASE)
_FUNCTION: Final = "sgstore_recorded"
# The rows are in the order of traces, so that the states of a trace are read once.
_VIEW: Final = f"""
CREATE TEMP VIEW IF NOT EXISTS encounters AS
SELECT trace_id, trace, src, dst, kind,
  {", ".join(f"recorded('{KNOWN}{name}', trace_id, src, dst) AS {name}" for name in RECORDED)}
FROM (
  SELECT e.trace_id, t.name AS trace, e.node_id AS src, o.node_id AS dst, o.kind
  FROM (SELECT DISTINCT frame_id >> 24 AS trace_id, node_id FROM {INSIDE}.state WHERE is_ego) e
  JOIN (
    SELECT trace_id, node_id, kind FROM {INSIDE}.entity
    WHERE is_static
      OR (trace_id, node_id) IN (SELECT DISTINCT frame_id >> 24, node_id FROM {INSIDE}.known_state)
  ) o ON o.trace_id = e.trace_id AND o.node_id <> e.node_id AND o.kind NOT IN {FIXED_KINDS}
  JOIN {INSIDE}.trace t ON t.trace_id = e.trace_id
  ORDER BY e.trace_id, e.node_id, o.node_id
)
"""


class _Known:
    """Cache of a store file: object tracks that were read, and criticality measures of object pairs."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.tracks: BoundedCache[dict[int, Track]] = BoundedCache(MOST_BYTES)
        self.values: OrderedDict[tuple[str, int, int, int], float | None] = OrderedDict()
        self.areas = ConflictAreas()


class _MeasuredQuestion:
    """Database connection whose SQL statement uses criticality measures of object pairs.

    Parameters
    ----------
    connection : DuckDBPyConnection
        Connection of the statement. Another connection of the same instance reads the tracks.
    known : _Known
    """

    def __init__(self, connection: DuckDBPyConnection, known: _Known) -> None:
        self.asking = connection
        self._known = known
        self._reader = connection.cursor()
        at = connection.execute("SELECT current_database()").fetchall()[0][0]
        self._reader.execute(f'USE "{at}".{INSIDE}')

    def value(self, measure: str, trace: int, src: int, dst: int) -> float | None:
        """Return a criticality measure of an object pair in a trace. ``None`` means unknown or undefined."""
        if measure.removeprefix(KNOWN) not in RECORDED:
            raise ConfigError(f"no recorded measure: {measure!r}; expected {', '.join(RECORDED)}")
        with self._known.lock:
            if measure.removeprefix(KNOWN) in OF_AREAS:
                return self._of_area(measure, trace, src, dst)
            key, values = (measure, trace, src, dst), self._known.values
            if key not in values:
                if id(self.asking) in interrupted:
                    return None
                if len(values) >= _MOST_PAIRS:
                    values.popitem(last=False)
                values[key] = self._worked_out(measure, trace, src, dst)
            return values[key]

    def _of_area(self, measure: str, trace: int, src: int, dst: int) -> float | None:
        """Return a measure of a conflict area. Those of all pairs of the first object are computed together."""
        scope, areas = "known_" if measure.startswith(KNOWN) else "", self._known.areas
        if id(self.asking) in interrupted and not areas.known(scope, trace, src):
            return None
        return areas.value(self._reader, scope, measure.removeprefix(KNOWN), (trace, src, dst))

    def _worked_out(self, measure: str, trace: int, src: int, dst: int) -> float | None:
        if src == dst:
            return None
        nodes = "world_nodes" if measure.startswith(KNOWN) else "nodes"
        a, b = (self._track(nodes, trace, node) for node in (src, dst))
        if a is None or b is None:
            return None
        from sgstore.model.criticality import Encounter  # imports numpy

        value = RECORDED[measure.removeprefix(KNOWN)].value(Encounter(a, b))
        return None if math.isnan(value) else value

    def _track(self, nodes: str, trace: int, node: int) -> Track | None:
        known = self._known.tracks
        for key in ((nodes, trace), (nodes, trace, node)):
            if key in known:
                known.move_to_end(key)
                return known[key].get(node)
        first, last = trace << 24, ((trace + 1) << 24) - 1
        sql = "SELECT count(*) FROM known_state WHERE frame_id BETWEEN ? AND ?"
        ((many,),) = self._reader.execute(sql, [first, last]).fetchall()
        tracks = TRACKS.format(nodes=nodes)
        if many * _STATE_BYTES <= MOST_BYTES:
            key, found = (nodes, trace), self._reader.execute(tracks, [trace])
        else:
            key = nodes, trace, node
            found = self._reader.execute(f"{tracks} AND n.node_id = $2", [trace, node])
        read = {other: track for other, _, _, track in tracks_of(found.fetchnumpy())}
        known.keep(key, read, sum(map(len, read.values())) * _STATE_BYTES)
        return read.get(node)

    def close(self) -> None:
        self._reader.close()


_tokens = count()
_questions: Final[dict[int, _MeasuredQuestion]] = {}
_paths: Final[dict[int, Path]] = {}
_known: Final[OrderedDict[tuple[Path, Stamp], _Known]] = OrderedDict()


@lru_cache(_MOST_CALLS)
def _recorded(token: int, measure: Any, trace: Any, src: Any, dst: Any) -> float | None:
    asked = _questions.get(token)
    if asked is None or measure is None or trace is None or src is None or dst is None:
        return None
    return asked.value(measure, trace, src, dst)


@contextmanager
def recorded_measures(connection: DuckDBPyConnection, path: Path, sql: str) -> Generator[None]:
    """Context manager that adds the SQL function ``recorded()`` to a connection, if a statement uses it.

    Parameters
    ----------
    connection : DuckDBPyConnection
    path : Path
    sql : str
        First statement. Call :func:`show_recorded` for further statements.
    """
    _paths[id(connection)] = path
    try:
        show_recorded(connection, sql)
        yield
    finally:
        del _paths[id(connection)]
        interrupted.discard(id(connection))
        for token, asked in list(_questions.items()):
            if asked.asking is connection:
                del _questions[token]
                asked.close()


def show_recorded(connection: DuckDBPyConnection, sql: str) -> None:
    """Add the SQL function ``recorded()`` and the view ``encounters`` to a connection, if SQL uses them."""
    path = _paths.get(id(connection))
    if path is None or _WANTED.search(sql) is None:
        return
    if any(asked.asking is connection for asked in list(_questions.values())):
        return
    place = path, stamp_of(path)
    known = _known.setdefault(place, _Known())
    _known.move_to_end(place)
    while len(_known) > _FILES:
        _known.popitem(last=False)
    token = next(_tokens)
    _questions[token] = _MeasuredQuestion(connection, known)
    with suppress(
        duckdb.CatalogException, duckdb.NotImplementedException
    ):  # the function already exists
        # DuckDB does not move a function with side effects before other conditions.
        connection.create_function(
            _FUNCTION,
            _recorded,
            ["BIGINT", "VARCHAR", "BIGINT", "BIGINT", "BIGINT"],
            "DOUBLE",
            null_handling=FunctionNullHandling.SPECIAL,
            side_effects=True,
        )
    arguments = "measure, trace_id, src, dst"
    connection.execute(
        f"CREATE TEMP MACRO recorded({arguments}) AS {_FUNCTION}({token}, {arguments})"
    )
    connection.execute(_VIEW)


def measured(
    ask: Callable[[str, list[Any]], Iterable[tuple[Any, ...]]],
    trace_id: int,
    scope: str,
    measure: str,
    src: int,
    dst: int,
) -> float | None:
    """Return a criticality measure of an object pair in a trace. ``None`` means unknown."""
    ((value,),) = ask("SELECT recorded(?, ?, ?, ?)", [f"{scope}{measure}", trace_id, src, dst])
    return value
