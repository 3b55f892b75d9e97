"""Rebuild of a store that an older version wrote: keep names and settings, and replace the file.

The reader works with old and altered stores, and returns enough data to rebuild them.

It reads only the tables of recordings and settings. These have not changed since schema version 2, except for
table ``recording``, new in version 4. They must be tables, because a view could read anything.
"""

from __future__ import annotations

import json
import math
import os
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import sgstore.store._schema as shape
from sgstore.base.display import excerpts
from sgstore.base.quoting import quoted
from sgstore.errors import StoreError
from sgstore.store._creation import attach_empty
from sgstore.store._engine_errors import BusyError, DiskFullError, move
from sgstore.store._locking import Access, spill_folder
from sgstore.store._publish import copy_sorted
from sgstore.store._staging import scratch
from sgstore.store._store_paths import Folder
from sgstore.store._traces import located

if TYPE_CHECKING:
    from pathlib import Path

    from duckdb import DuckDBPyConnection

    from sgstore.store._schema import Objects


@dataclass(frozen=True, slots=True)
class OldTrace:
    """Trace of a store that is to be rebuilt, with name, recording and settings.

    Attributes
    ----------
    imported : dict or None
        Import settings, for imported graphs of another tool.
    """

    trace_id: int
    name: str
    path: Path
    size: int
    mtime_ns: int
    digest: str
    ego: str
    since: float | None
    until: float | None
    map_id: int | None
    period_ns: int
    answers: tuple[str, ...]
    settings: dict[str, Any]
    imported: dict[str, Any] | None


@dataclass(frozen=True, slots=True)
class OldMap:
    """Road map of a store that is to be rebuilt. The text is empty if the store has no text of the map."""

    name: str
    digest: str
    text: str


@dataclass(frozen=True, slots=True)
class OldSet:
    """Derived set of relations (edges computed after ingest) in a store that is to be rebuilt."""

    name: str
    settings: dict[str, Any]
    traces: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Remains:
    """Content of an old store that its rebuild needs: traces, maps and derived sets.

    Attributes
    ----------
    traces : tuple of OldTrace
        Traces in ingest order.
    maps : dict
        Maps by id.
    sets : tuple of OldSet
    abstractions : tuple of str
        Abstractions whose classes were computed after ingest.
    others : tuple of str
        User tables and views.
    """

    traces: tuple[OldTrace, ...]
    maps: dict[int, OldMap]
    sets: tuple[OldSet, ...]
    abstractions: tuple[str, ...]
    others: tuple[str, ...]

    @staticmethod
    def of(path: Path) -> Remains:
        """Return the content of an old store that its rebuild needs: traces, maps and derived sets.

        Raises
        ------
        StoreError
            The file is not a store, or the needed tables are not readable.
        """
        access = Access(path, checked=False)
        with access.reading() as connection:
            return remains_in(connection, shape.database_of(connection), path)

    def give_names(
        self,
        path: Path,
    ) -> None:
        """Rename the traces and maps of a rebuilt store to their names in the old store."""
        access = Access(path)
        with scratch(spill_folder()) as connection, access.writing(connection):
            for trace in self.traces:
                connection.execute(
                    "UPDATE store.inside.trace SET name = ? WHERE trace_id = ?",
                    [trace.name, trace.trace_id],
                )
            named = {one.digest: one.name for one in self.maps.values()}
            if len(set(named.values())) == len(named):
                held = connection.execute(
                    "SELECT map_id, digest, name FROM store.inside.map"
                ).fetchall()
                others = {name for _, digest, name in held if digest not in named}
                for map_id, digest, _ in held:
                    if digest in named and named[digest] not in others:
                        connection.execute(
                            "UPDATE store.inside.map SET name = ? WHERE map_id = ?",
                            [named[digest], map_id],
                        )

    def replace(
        self,
        fresh: Path,
        path: Path,
    ) -> None:
        """Replace an old store file by the rebuilt store, with exclusive access to the old file.

        Raises
        ------
        StoreError
            The traces of the old store have changed in the meantime.
        """
        access = Access(path, checked=False)
        with scratch(spill_folder()) as connection, access.attached(connection):
            if remains_in(connection, "store", path) != self:
                raise StoreError(f"{path}: has changed while it was made anew; do it again")
            connection.execute("FORCE CHECKPOINT store")
            connection.execute("DETACH store")
            _replace(path, fresh)


def remains_in(connection: DuckDBPyConnection, database: str, path: Path) -> Remains:
    """Return the traces, maps and derived sets of an already open store, for its rebuild."""
    objects = shape.objects_of(connection, database)
    if shape.about_store(connection, database, objects) is None:
        raise StoreError(f"{path}: a DuckDB database, but not a store")
    reader = _TableReader(connection, database, path, objects)
    try:
        return Remains(
            traces=_traces(reader, path),
            maps={
                row["map_id"]: _map(row) for row in reader.rows("map", "map_id name digest text")
            },
            sets=_sets(reader),
            abstractions=tuple(
                sorted(
                    {
                        str(row["abstraction"])
                        for row in reader.distinct("later_class", "abstraction")
                    }
                )
            ),
            others=tuple(shape.others(objects)),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StoreError(
            f"{path}: its list of traces cannot be read ({error});"
            " ingest its recordings into a new store"
        ) from error


class _TableReader:
    """Reader of the tables of an old store. Views and macros of the store are ignored."""

    def __init__(
        self, connection: DuckDBPyConnection, database: str, path: Path, objects: Objects
    ) -> None:
        self._connection = connection
        self._database = database
        self._path = path
        self._schema = shape.schema_of(objects)
        self._tables = {one[2] for one in objects if one[:2] == ("table", self._schema)}

    def has(self, table: str) -> bool:
        """Return True if the store has the table."""
        return table in self._tables

    def rows(self, table: str, columns: str, *, needed: bool = False) -> list[dict[str, Any]]:
        """Return some columns of a table, as one dict per row. A missing optional table has no rows."""
        return self._asked(table, columns, "SELECT", needed=needed)

    def distinct(self, table: str, columns: str) -> list[dict[str, Any]]:
        """Return the distinct rows of some columns of a table, as one dict per row."""
        return self._asked(table, columns, "SELECT DISTINCT", needed=False)

    def _asked(self, table: str, columns: str, how: str, *, needed: bool) -> list[dict[str, Any]]:
        if not self.has(table):
            if needed:
                raise StoreError(
                    f"{self._path}: has no table {table!r}, so nothing is known of its recordings;"
                    " ingest them into a new store"
                )
            return []
        names = columns.split()
        listed = ", ".join(map(quoted, names))
        found = self._connection.execute(
            f"{how} {listed} FROM {quoted(self._database)}.{self._schema}.{quoted(table)}"
        )
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


_TRACE: Final = (
    "trace_id name ego since until map_id config_id period_ns answers report ingested_at"
)
_RECORDING: Final = "uri size mtime_ns digest"


def _traces(reader: _TableReader, path: Path) -> tuple[OldTrace, ...]:
    settings = {
        row["config_id"]: _object(row["settings"])
        for row in reader.rows("config", "config_id settings", needed=True)
    }
    recordings = {
        row["recording_id"]: row
        for row in reader.rows("recording", f"recording_id place {_RECORDING}")
    }
    if reader.has("recording"):
        rows = reader.rows("trace", f"{_TRACE} recording_id", needed=True)
        rows = [row | recordings[row["recording_id"]] for row in rows]
    else:  # an old store: each trace has its own
        rows = reader.rows("trace", f"{_TRACE} {_RECORDING}", needed=True)
    rows.sort(key=lambda row: (row["ingested_at"].isoformat(), str(row["name"])))
    found = tuple(_trace(row, settings, path) for row in rows)
    if len({one.name for one in found}) < len(found) or len({t.trace_id for t in found}) < len(
        found
    ):
        raise ValueError("two traces have the same name or id")
    return found


def _trace(row: dict[str, Any], settings: dict[int, dict[str, Any]], store: Path) -> OldTrace:
    report = _object(row["report"])
    form = report.get("imported")
    return OldTrace(
        trace_id=int(row["trace_id"]),
        name=_text(row["name"]),
        path=located(_text(row["uri"]), _text(row.get("place") or ""), int(row["size"]), store),
        size=int(row["size"]),
        mtime_ns=int(row["mtime_ns"]),
        digest=_text(row["digest"]),
        ego=_text(row["ego"] or ""),
        since=_seconds(row["since"]),
        until=_seconds(row["until"]),
        map_id=row["map_id"],
        period_ns=int(row["period_ns"]),
        answers=tuple(map(_text, row["answers"])),
        settings=settings[row["config_id"]],
        imported=None if form is None else {"form": _text(form), **report.get("import", {})},
    )


def _map(row: dict[str, Any]) -> OldMap:
    return OldMap(_text(row["name"]), _text(row["digest"]), _text(row["text"] or ""))


def _sets(reader: _TableReader) -> tuple[OldSet, ...]:
    found: dict[tuple[str, str], list[int]] = {}
    for row in reader.rows("derived", "name settings trace_id"):
        found.setdefault((_text(row["name"]), _text(row["settings"])), []).append(row["trace_id"])
    return tuple(
        OldSet(name, _object(text), tuple(traces)) for (name, text), traces in sorted(found.items())
    )


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"expected a text, found {value!r}")
    return value


def _seconds(value: object) -> float | None:
    if value is None:
        return None
    if not isinstance(value, float) or not math.isfinite(value):
        raise TypeError(f"expected seconds, found {value!r}")
    return value


def _object(text: object) -> dict[str, Any]:
    value: Any = json.loads(_text(text))
    if not isinstance(value, dict):
        raise TypeError(f"expected an object of JSON, found {text!r}")
    return {str(key): one for key, one in value.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]


def compact(path: Path, access: Access, memory: int) -> None:
    """Rewrite a store with sorted tables, and replace its file."""
    refuse_others(path, access)
    database = scratch(spill_folder(), memory=memory, threads=os.cpu_count() or 1)
    try:
        with (
            Folder(path) as beside,
            database as connection,
            access.attached(connection, beside.path),
        ):
            connection.execute("FORCE CHECKPOINT store")
            attach_empty(connection, beside.path / "store")
            copy_sorted(connection)
            connection.execute("DETACH fresh")
            _replace(path, beside.path / "store")
    except DiskFullError as error:
        reason = "the disk is full, and has no room for a second store"
        raise DiskFullError(f"{path}: not compacted, and not changed: {reason}") from error


_LISTED: Final = 100
"""Largest number of object names in the error about objects that a rewrite would delete."""


def settle(path: Path, access: Access, memory: int) -> None:
    """Merge the write-ahead log of a killed writer process into the store file."""
    left = [path.with_name(f"{path.name}{ending}") for ending in (".wal", ".gate")]
    if any(one.exists() for one in left):
        database = scratch(spill_folder(), memory=memory)
        with suppress(BusyError), database as connection, access.attached(connection):
            connection.execute("CHECKPOINT store")


def refuse_others(path: Path, access: Access) -> None:
    """Raise an error if a store has user tables, views, macros and so on, which a rewrite would delete.

    Raises
    ------
    StoreError
    """
    with access.reading() as connection:
        database = shape.database_of(connection)
        others = shape.others(shape.objects_of(connection, database))
        others += shape.unlisted(connection, database)
    if others:
        raise StoreError(
            f"{path}: cannot be written anew: what is none of sgstore's would be lost:"
            f" {excerpts(others, _LISTED)}; move them to another file first"
        )


def _replace(path: Path, fresh: Path) -> None:
    """Replace a store file by a new file. The write-ahead log must be merged already.

    Raises
    ------
    StoreError
        One of the files has a log. The log of the old file would apply to the new file, or the new log would be
        lost.
    """
    for one in (path, fresh):
        if one.with_name(f"{one.name}.wal").exists():
            raise StoreError(f"{path}: left as it is: the log {one.name}.wal of {one} stays")
    move(fresh, path, f"{path}: left as it is: cannot be replaced")
