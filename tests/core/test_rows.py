"""Rows as tables and files: those that the database makes equal those made of Python values."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import polars
import pyarrow as pa
import pytest

import sgstore.matches
from sgstore.apps.cli import run
from sgstore.errors import MissingExtraError, SqlError
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.store import Rows

PLAIN = """
SELECT i AS whole, i::INTEGER AS short, i / 7 AS number, (i / 7)::FLOAT AS rough, i % 2 = 0 AS truth,
       'ä' || i AS text, CASE WHEN i % 3 = 0 THEN 'car'::kind END AS kind,
       CASE WHEN i % 5 = 0 THEN i END AS some, CASE WHEN i % 5 = 0 THEN i % 2 = 0 END AS perhaps,
       CASE WHEN i % 5 = 0 THEN i / 3 END AS part,
       NULL::BIGINT AS none, NULL::VARCHAR AS no_text, 'nan'::DOUBLE AS nan, i AS "a.b"
FROM range({}) t(i)
"""
OTHER = """
SELECT i, [i, NULL] AS list, {{'a': i}} AS struct, (i / 8)::DECIMAL(12, 3) AS exact, sum(i) OVER () AS huge,
       TIMESTAMP '2020-01-01' + INTERVAL (i) SECOND AS moment, ['car'::kind] AS kinds, i::SMALLINT AS small
FROM range({}) t(i)
"""
MANY = 10_500
"""More rows than a batch."""
RUNAWAY = "SELECT a.range + b.range AS x FROM range(1000000) a, range(1000000) b"


@pytest.fixture(scope="module")
def store(town_store: Path) -> Iterator[Store]:
    store = Store(town_store)
    with store.file.snapshot():
        yield store


def nothing(*_: object) -> None:
    """Stand in for what makes tables of Arrow, where it makes none."""


def known(rows: Rows) -> Rows:
    """The same rows, all of which are there as Python values."""
    assert len(rows.values) == len(rows)
    return rows


def frame_of_pandas(rows: Rows) -> Any:
    pytest.importorskip("pandas")
    return rows.df().to_dict("list"), [str(kind) for kind in rows.df().dtypes]


def parquet(rows: Rows, path: Path) -> tuple[list[Any], list[Any]]:
    number = rows.parquet(path)
    with duckdb.connect() as connection:
        found = connection.execute("FROM read_parquet(?) ORDER BY 1", [str(path)])
        kinds = [str(one[1]) for one in found.description or []]
        values = found.fetchall()
    assert number == len(values)
    return kinds, [[*map(repr, row)] for row in values]


@pytest.mark.parametrize("sql", [PLAIN, OTHER], ids=["plain", "other"])
def test_tables_by_the_database_are_those_of_python_values(
    store: Store, sql: str, tmp_path: Path
) -> None:
    sql = sql.format(MANY)
    by_values = known(store.sql(sql))

    assert "over" in repr(store.sql(sql))
    assert f"<{MANY:,} rows" in repr(by_values)
    assert len(store.sql(sql)) == MANY
    assert repr(store.sql(sql).arrow().to_pydict()) == repr(by_values.arrow().to_pydict())
    assert store.sql(sql).arrow().schema == by_values.arrow().schema
    ours, theirs = store.sql(sql).polars(), by_values.polars()
    assert ours.schema == theirs.schema
    assert ours.equals(theirs)
    assert parquet(store.sql(sql), tmp_path / "a.parquet") == parquet(
        by_values, tmp_path / "b.parquet"
    )


def test_data_frames_by_the_database_are_those_of_python_values(store: Store) -> None:
    sql = PLAIN.format(MANY)

    assert repr(frame_of_pandas(store.sql(sql))) == repr(frame_of_pandas(known(store.sql(sql))))


def test_few_rows_are_there_at_once(store: Store) -> None:
    sql = PLAIN.format(3)

    assert store.sql(sql).arrow().schema.field("short").type == pa.int32()
    assert store.sql(sql).polars().schema["none"] == polars.Null
    assert store.sql(sql + " LIMIT 0").arrow().num_rows == 0
    assert store.sql("SELECT 1 AS a, 2 AS a").arrow().column_names == ["a", "a"]
    assert store.sql(PLAIN.format(MANY), max_rows=7).arrow().num_rows == 7


QUERIES = [
    "MATCH (a:Vehicle)-[:near|very_near]->(b) RETURN frame.id AS f, a.name, b.speed, a.is_ego, b.lane_type",
    "MATCH (a:Vehicle)-[:near]->(b) RETURN a.kind, b.kind, COUNT(*) AS n ORDER BY n DESC LIMIT 3",
    "MATCH (e:Ego)-[:near]->(v) RETURN e.speed AS s, v.name LIMIT 40",
    "MATCH (e:Ego) WHERE e.speed > 900 RETURN e.speed",
    "MATCH (e:Ego)-[:near]->(v:Vehicle) THEN MATCH (e)-[:very_near]->(v)",
    "MATCH (e:Ego)-[:near]->(v:Vehicle) RETURN DISTINCT v.name AS name, trace.name",
    "MATCH (e:Ego)-[:near]->(v:Vehicle)",
    "MATCH (e:Ego)-[:near]->(v:Vehicle) RETURN v.name, ttc(e, v) AS ttc, e.gear, v.speed > 3 AS fast",
]


@pytest.mark.parametrize("query", QUERIES)
def test_tables_of_matches_are_those_of_their_rows(
    store: Store, query: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FIRST_WINDOW", "LAST_WINDOW"):
        monkeypatch.setattr(sgstore.matches, name, 2)
    matches = store.find(query)
    few = matches.limit(7)
    ours = (matches.arrow(), matches.polars(), few.arrow())
    monkeypatch.setattr(sgstore.matches.Matches, "_table", nothing)
    theirs = (matches.arrow(), matches.polars(), few.arrow())

    assert ours[0].equals(theirs[0])
    assert ours[1].schema == theirs[1].schema
    assert ours[1].equals(theirs[1])
    assert ours[2].equals(theirs[2])


@pytest.mark.parametrize("form", ["parquet", "arrow"])
@pytest.mark.parametrize("query", [*QUERIES, f"{QUERIES[0]} LIMIT 30", f"{QUERIES[0]} LIMIT 0"])
def test_files_of_matches_are_those_of_their_rows(
    query: str, form: str, town_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FIRST_WINDOW", "LAST_WINDOW"):
        monkeypatch.setattr(sgstore.matches, name, 2)
    for module in ("_arrow", "_table_files"):  # rows whose values tell the types
        monkeypatch.setattr(f"sgstore.store.{module}.ROWS_AT_ONCE", 100)

    def written(name: str) -> bytes:
        assert run(["find", str(town_store), query, "-o", str(tmp_path / name)]) == 0
        return (tmp_path / name).read_bytes()

    ours = written(f"a.{form}")
    monkeypatch.setattr("sgstore.store._file.record_batches", nothing)

    assert ours == written(f"b.{form}")


@pytest.mark.parametrize("form", ["arrow", "polars"])
def test_the_deadline_holds_for_tables(store: Store, form: str) -> None:
    with pytest.raises(SqlError, match=r"stopped after 0\.5 s"):
        getattr(store.sql(RUNAWAY, timeout_s=0.5), form)()


def test_the_deadline_and_errors_hold_for_files(store: Store, tmp_path: Path) -> None:
    with pytest.raises(SqlError, match=r"stopped after 0\.5 s"):
        store.sql(RUNAWAY, timeout_s=0.5).parquet(tmp_path / "x.parquet")
    broken = f"SELECT CASE WHEN i = 400000 THEN error('boom') ELSE i END FROM range({400_001}) t(i)"
    with pytest.raises(SqlError, match="boom"):
        store.sql(broken).parquet(tmp_path / "x.parquet")
    with pytest.raises(SqlError, match="boom"):
        store.sql(broken).arrow()

    assert not list(tmp_path.iterdir())


def test_without_arrow_there_are_data_frames_and_files_too(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sql = PLAIN.format(MANY)
    expected, kinds = store.sql(sql).polars(), parquet(store.sql(sql), tmp_path / "a.parquet")
    monkeypatch.setitem(sys.modules, "pyarrow", None)

    assert store.sql(sql).polars().equals(expected)
    assert parquet(store.sql(sql), tmp_path / "b.parquet") == kinds
    with pytest.raises(MissingExtraError, match="arrow"):
        store.sql(sql).arrow()


@pytest.mark.parametrize("form", ["parquet", "arrow"])
@pytest.mark.parametrize("sql", [PLAIN, OTHER], ids=["plain", "other"])
def test_files_of_the_verb_hold_the_same_rows(
    store: Store,
    town_store: Path,
    sql: str,
    form: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def written(name: str) -> bytes:
        assert run(["sql", str(town_store), sql.format(300), "-o", str(tmp_path / name)]) == 0
        return (tmp_path / name).read_bytes()

    ours = written(f"a.{form}")
    monkeypatch.setattr("sgstore.store._file.record_batches", nothing)

    assert ours == written(f"b.{form}")
    assert np.array_equal([row[0] for row in store.sql(sql.format(300))], np.arange(300))
