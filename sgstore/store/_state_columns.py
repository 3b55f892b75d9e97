"""Object states (such as position and speed) of frames as plain columns, for a viewer.

Positions are relative to the origin of the trace, so they fit into 32 bits. NaN means unknown. Kinds and light
states are codes; `codes` returns their names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.quoting import quoted
from sgstore.errors import StoreError
from sgstore.model.frame_ids import frame_ids, seq_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.store._file import StoreFile
    from sgstore.store._packing import Columns

MOST_FRAMES: Final = 20_000
"""Largest number of frames per call."""

_STATE: Final = {
    "node": "node_id",
    "kind": "enum_code(kind)",
    "ego": "is_ego",
    **dict.fromkeys(("x", "y", "heading", "speed", "length", "width")),
    "lights": "lights",
    "light": "enum_code(light_state)",
}
_TYPES: Final[Mapping[str, Any]] = {
    "node": "int32",
    "kind": "uint8",
    "ego": "uint8",
    **dict.fromkeys(("x", "y", "heading", "speed", "length", "width"), "float32"),
    "lights": "uint16",
    "light": "uint8",
}
_OF_STATE: Final = ", ".join(f'{sql or name} AS "{name}"' for name, sql in _STATE.items())


class StateColumns:
    """Object states and other data of the traces of a store, as plain columns.

    Parameters
    ----------
    file : StoreFile

    Raises
    ------
    StoreError
        By each method: the trace does not exist.
    """

    def __init__(self, file: StoreFile) -> None:
        self._file = file

    def frames(self, trace: int | str, first: int, last: int) -> Columns:
        """Return the frames ``first`` to ``last`` as columns: number, time from trace start (s), ego or -1."""
        found = self._file.arrays(
            "SELECT f.seq AS seq, round((f.time_ns - t.start_ns) / 1e3) / 1e6 AS t, coalesce(f.ego, -1) AS ego"
            " FROM frame f JOIN trace t ON t.trace_id = f.trace_id"
            " WHERE f.frame_id BETWEEN ? AND ? ORDER BY f.frame_id",
            _ids(self._file.trace_id(trace), first, last),
        )
        return _typed(found, {"seq": "uint32", "t": "float64", "ego": "int32"})

    def states(self, trace: int | str, first: int, last: int) -> Columns:
        """Return the states of all non-static objects in a range of frames, with the frame numbers.

        Raises
        ------
        StoreError
            The range has more than :data:`MOST_FRAMES` frames.
        """
        if last - first >= MOST_FRAMES:
            raise StoreError(f"{last - first + 1} frames requested; at most {MOST_FRAMES} at once")
        found = self._file.arrays(
            f"SELECT frame_id, {_OF_STATE} FROM state WHERE frame_id BETWEEN ? AND ?"
            " ORDER BY frame_id, node_id",
            _ids(self._file.trace_id(trace), first, last),
        )
        seq = seq_of(found.pop("frame_id").astype(np.int64)).astype(np.uint32)
        return {"seq": seq, **_typed(found, _TYPES)}

    def states_at(self, frames: Sequence[tuple[int, int]]) -> Columns:
        """Return object states in given frames. Column ``at`` is the index of the frame in the input."""
        if len(frames) > MOST_FRAMES:
            raise StoreError(f"{len(frames)} frames requested; at most {MOST_FRAMES} at once")
        ids = [int(frame_ids(trace, np.array([seq]))[0]) for trace, seq in frames]
        found = self._file.arrays(
            f"SELECT a.at AS at, {_OF_STATE} FROM"
            " (SELECT unnest(?::BIGINT[]) AS id, unnest(range(?)) AS at) a"
            " JOIN state s ON s.frame_id = a.id ORDER BY a.at, s.node_id",
            [ids, len(ids)],
        )
        return {"at": found.pop("at").astype(np.uint32), **_typed(found, _TYPES)}

    def scenery(self, trace: int | str) -> Columns:
        """Return the static objects of a trace as columns. Elements of the road map are excluded."""
        found = self._file.arrays(
            'SELECT node_id AS node, enum_code(kind) AS kind, x, y, heading, "length", width FROM entity'
            " WHERE trace_id = ? AND is_static ORDER BY node_id",
            [self._file.trace_id(trace)],
        )
        return _typed(found, _TYPES)

    def names(self, trace: int | str) -> dict[int, tuple[str, ...]]:
        """Return kind, simulator id and type name of each object of a trace, by node id; empty if unknown."""
        rows = self._file.rows(
            "SELECT node_id, kind::VARCHAR, coalesce(ident, ''), coalesce(type_name, '') FROM entity"
            " WHERE trace_id = ? ORDER BY node_id",
            [self._file.trace_id(trace)],
        )
        return {node: tuple(about) for node, *about in rows.values}

    def places(self) -> dict[str, tuple[float, float, str, list[str]]]:
        """For each trace, return its coordinate origin (m), map digest and camera topics: trace name → values.

        One statement reads all traces, because there may be thousands. Cameras are the sorted topics of
        pictures.
        """
        rows = self._file.rows(
            "SELECT t.name, t.origin_x, t.origin_y, coalesce(m.digest, ''), coalesce(c.topics, [])"
            " FROM trace t LEFT JOIN map m ON m.map_id = t.map_id"
            " LEFT JOIN (SELECT trace_id, list(DISTINCT topic ORDER BY topic) AS topics FROM channel"
            " WHERE contains(schema, 'Image') GROUP BY trace_id) c ON c.trace_id = t.trace_id"
        )
        return {trace: tuple(about) for trace, *about in rows.values}  # type: ignore[misc]

    def log_times(self, trace: int | str, first: int, last: int) -> NDArray[np.int64]:
        """For a range of frames, return the log times of their messages; ns."""
        sql = (
            "SELECT log_time_ns FROM frame WHERE trace_id = ? AND seq BETWEEN ? AND ? ORDER BY seq"
        )
        found = self._file.arrays(sql, [self._file.trace_id(trace), first, last])
        return found["log_time_ns"].astype(np.int64)

    def codes(self) -> dict[str, list[str]]:
        """Return the names of object kinds and of light states, as lists in the order of their codes."""
        ((kinds, lights),) = self._file.rows(
            "SELECT enum_range(NULL::kind)::VARCHAR[], enum_range(NULL::light_state)::VARCHAR[]"
        ).values
        return {"kind": kinds, "light": lights}

    def series(
        self, trace: int | str, attribute: str, node: int, other: int | None = None
    ) -> Columns:
        """Return an attribute of a node, or of a node pair, over a trace: ``seq``, ``t`` and ``value``.

        Parameters
        ----------
        trace : int or str
        attribute : str
            Numeric column of the view ``nodes``; with ``other``, of ``pairs``.
        node, other
            Node ids.

        Raises
        ------
        StoreError
            The column does not exist.
        """
        view = "nodes" if other is None else "pairs"
        low, high = _ids(self._file.trace_id(trace), 0, (1 << 24) - 1)
        whose = "n.node_id = ?" if other is None else "n.src = ? AND n.dst = ?"
        with self._file.access.reading(public=True) as connection:
            columns = connection.execute(f"DESCRIBE {view}").fetchall()
            numbers = [c[0] for c in columns if c[1] in {"FLOAT", "DOUBLE", "TINYINT"}]
            if attribute not in numbers:
                raise StoreError(
                    f"no number {attribute!r} in {view}; there are {', '.join(numbers)}"
                )
            found = connection.execute(
                f"SELECT f.seq AS seq, f.t AS t, n.{quoted(attribute)}::DOUBLE AS value"
                f" FROM {view} n JOIN frames f ON f.frame_id = n.frame_id"
                f" WHERE n.frame_id BETWEEN ? AND ? AND f.frame_id BETWEEN ? AND ? AND {whose} ORDER BY f.seq",
                [low, high, low, high, node, *([] if other is None else [other])],
            ).fetchnumpy()
        return _typed(found, {"seq": "uint32", "t": "float64", "value": "float32"})


def _ids(trace_id: int, first: int, last: int) -> tuple[int, int]:
    low, high = frame_ids(trace_id, np.array([first, min(last, (1 << 18) * 60 - 1)])).tolist()
    return low, high


def _typed(found: Mapping[str, NDArray[Any]], types: Mapping[str, Any]) -> Columns:
    """Convert columns to the given types. NULL becomes NaN or 0."""
    told: Columns = {}
    for name, values in found.items():
        type_ = np.dtype(types[name])
        missing = np.nan if type_.kind == "f" else 0
        filled = np.ma.filled(values.astype(type_), missing) if np.ma.isMA(values) else values
        told[name] = np.ascontiguousarray(filled, type_)
    return told
