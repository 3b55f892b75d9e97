"""Criticality measures of object pairs over a whole trace, as an SQL function and an SQL view.

A measure needs the tracks of two entities, so SQL cannot express it. DuckDB calls a Python function for each
remaining row. A pair is computed once, and cached until the file changes. The function belongs to a database
instance, which can have several files; a macro of each connection selects the file. Both exist only for
statements that name them.
"""

from __future__ import annotations

import re
from collections import OrderedDict
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import count
from typing import TYPE_CHECKING, Any, Final

import duckdb
from duckdb.func import FunctionNullHandling

from sgstore.base.quoting import quoted
from sgstore.errors import ConfigError
from sgstore.lang.catalog import LANE_CHAINS, TOPIC
from sgstore.model.criticality import FIXED_KINDS, KNOWN, RECORDED
from sgstore.model.graph import lane_chains
from sgstore.store._interrupts import interrupted
from sgstore.store._lease import stamp_of
from sgstore.store._meetings import RecordedValues
from sgstore.store._schema import INSIDE
from sgstore.store._topic_relations import show_topic_values

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable
    from pathlib import Path

    from duckdb import DuckDBPyConnection

    from sgstore.store._lease import Stamp
    from sgstore.store._locking import Access

_MOST_CALLS: Final = 1 << 16
"""Largest number of cached calls of the SQL function, because SQL repeats a pair in each frame."""
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


class _MeasuredQuestion:
    """Criticality measures of object pairs, for a database connection that uses them in an SQL statement.

    Parameters
    ----------
    connection : DuckDBPyConnection
        Connection of the statement. Another connection of the same instance reads the tracks.
    known : RecordedValues
    """

    def __init__(self, connection: DuckDBPyConnection, known: RecordedValues) -> None:
        self.asking = connection
        self._known = known
        self._reader = connection.cursor()
        at = connection.execute("SELECT current_database()").fetchall()[0][0]
        self._reader.execute(f'USE "{at}".{INSIDE}')

    def value(self, measure: str, trace: int, src: int, dst: int) -> float | None:
        """Return a criticality measure of an object pair in a trace; ``None`` if unknown or undefined."""
        name = measure.removeprefix(KNOWN)
        if name not in RECORDED:
            raise ConfigError(f"no recorded measure: {measure!r}; expected {', '.join(RECORDED)}")
        scope = "known_" if measure.startswith(KNOWN) else ""
        with self._known.lock:
            if id(self.asking) in interrupted and not self._known.known(scope, name, trace, src):
                return None
            return self._known.value(self._reader, scope, name, (trace, src, dst))

    def close(self) -> None:
        self._reader.close()


_tokens = count()
_questions: Final[dict[int, _MeasuredQuestion]] = {}
_places: Final[dict[int, Access]] = {}
_known: Final[OrderedDict[tuple[Path, Stamp], RecordedValues]] = OrderedDict()


@lru_cache(_MOST_CALLS)
def _recorded(token: int, measure: Any, trace: Any, src: Any, dst: Any) -> float | None:
    asked = _questions.get(token)
    if asked is None or measure is None or trace is None or src is None or dst is None:
        return None
    return asked.value(measure, trace, src, dst)


@contextmanager
def recorded_measures(connection: DuckDBPyConnection, access: Access, sql: str) -> Generator[None]:
    """Context manager that adds the SQL function ``recorded()`` to a connection if a statement uses it.

    Parameters
    ----------
    connection : DuckDBPyConnection
    access : Access
    sql : str
        First statement. Call :func:`show_recorded` for further statements.
    """
    _places[id(connection)] = access
    try:
        show_recorded(connection, sql)
        yield
    finally:
        del _places[id(connection)]
        interrupted.discard(id(connection))
        for token, asked in list(_questions.items()):
            if asked.asking is connection:
                del _questions[token]
                asked.close()


def show_recorded(connection: DuckDBPyConnection, sql: str) -> None:
    """Add to a connection what its SQL uses: ``recorded()``, the view ``encounters``, topic values."""
    access = _places.get(id(connection))
    if access is None:
        return
    if TOPIC in sql:
        show_topic_values(connection, access, sql)
    if LANE_CHAINS in sql:
        _show_lane_chains(connection, access)
    if _WANTED.search(sql) is None:
        return
    if any(asked.asking is connection for asked in list(_questions.values())):
        return
    place = access.path, stamp_of(access.path)
    known = _known.setdefault(place, RecordedValues())
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


_LINKS: Final = f"""
SELECT e.map_id, e.src, e.dst, a.junction IS NOT DISTINCT FROM b.junction
FROM {INSIDE}.map_edge e
  JOIN {INSIDE}.map_node a ON a.map_id = e.map_id AND a.node_id = e.src
  JOIN {INSIDE}.map_node b ON b.map_id = e.map_id AND b.node_id = e.dst
WHERE e.relation = 'travelsTo'
"""
_PAIRS: Final = f"""
CREATE OR REPLACE TEMP TABLE {quoted(LANE_CHAINS)} AS
WITH chains AS (
  SELECT n.map_id, n.node_id AS lane, coalesce(c.chain, n.node_id) AS chain
  FROM {INSIDE}.map_node n LEFT JOIN (
    SELECT unnest($1::BIGINT[]) AS map_id, unnest($2::INTEGER[]) AS lane, unnest($3::INTEGER[]) AS chain
  ) c ON c.map_id = n.map_id AND c.lane = n.node_id
  WHERE n.kind = 'lane'
)
SELECT a.map_id, a.lane AS src, b.lane AS dst
FROM chains a JOIN chains b ON b.map_id = a.map_id AND b.chain = a.chain
"""


def _show_lane_chains(connection: DuckDBPyConnection, access: Access) -> None:
    """Create the temporary table of all pairs of lanes that are parts of one lane."""
    place = access.path, stamp_of(access.path)
    if place not in _chains:
        links = connection.execute(_LINKS).fetchall()
        found = lane_chains(((at, a), (at, b), inside) for at, a, b, inside in links)
        rows = [(at, lane, chain) for (at, lane), (_, chain) in found.items()]
        _chains.clear()
        _chains[place] = [[row[column] for row in rows] for column in range(3)]
    connection.execute(_PAIRS, _chains[place])


_chains: Final[dict[tuple[Path, Stamp], list[list[int]]]] = {}
"""Map, lane and chain of the lanes that have several parts, for the file that was read last."""


def measured(
    ask: Callable[[str, list[Any]], Iterable[tuple[Any, ...]]],
    trace_id: int,
    scope: str,
    measure: str,
    src: int,
    dst: int,
) -> float | None:
    """Return a criticality measure of an object pair in a trace; ``None`` if it is unknown."""
    ((value,),) = ask("SELECT recorded(?, ?, ?, ?)", [f"{scope}{measure}", trace_id, src, dst])
    return value
