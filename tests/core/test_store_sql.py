"""Users' SQL: what reads is answered, what does anything else is refused, and the refusal says why."""

from __future__ import annotations

import math
import shutil
import time
from contextlib import nullcontext
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from graph_blocks import RandomTrace, publish

from sgstore.errors import SqlError, StoreError
from sgstore.model.vocabulary import SUPER_KINDS, kinds_labelled
from sgstore.store import GivenTable, StoreFile
from sgstore.store import duckdb as duckdb_of
from sgstore.store._sql_words import kind_notes

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

RUNAWAY = "SELECT count(*) FROM range(1000000) a, range(1000000) b WHERE a.range * b.range = 7.5"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StoreFile]:
    store = StoreFile.create(tmp_path_factory.mktemp("store") / "s.db")
    publish(store, RandomTrace(frames=130))
    with store.snapshot():
        yield store


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT count(*) FROM frames",
        "select count(*) from frames;",
        "-- how many\nSELECT count(*) FROM frames",
        "FROM frames SELECT count(*)",
        "WITH f AS (FROM frames) SELECT count(*) FROM f",
        "SELECT sum(n) FROM (VALUES (100), (30)) v(n)",
        "(SELECT count(*) FROM frames)",
    ],
)
def test_one_statement_that_reads_is_answered(store: Any, sql: Any) -> None:
    assert store.user_sql(sql).rows().values == [(130,)]


@pytest.mark.parametrize(
    "sql",
    ["DESCRIBE nodes", "SHOW TABLES", "SUMMARIZE frames", "EXPLAIN FROM edges", "TABLE frames"],
)
def test_what_describes_is_answered(store: Any, sql: Any) -> None:
    assert len(store.user_sql(sql).rows()) > 0


def test_types_of_the_result_are_told(store: Any) -> None:
    rows = store.user_sql("SELECT frame_id, kind FROM nodes LIMIT 1").rows()

    assert rows.columns == ("frame_id", "kind")
    assert (rows.types[0], rows.types[1][:4]) == ("BIGINT", "ENUM")
    assert isinstance(rows.values[0][1], str)


def test_rows_beyond_the_limit_are_left_out_and_it_is_said(store: Any) -> None:
    some = store.user_sql("SELECT seq FROM frames ORDER BY seq").rows(max_rows=7)
    every = store.user_sql("SELECT seq FROM frames").rows(max_rows=130)
    none = store.user_sql("SELECT seq FROM frames").rows(max_rows=0)

    assert ([seq for (seq,) in some], some.truncated) == (list(range(7)), True)
    assert (len(every), every.truncated) == (130, False)
    assert (len(none), none.truncated) == (0, True)


@pytest.mark.parametrize(
    ("sql", "reason"),
    [
        ("INSERT INTO inside.frame VALUES (1)", "INSERT is not allowed; expected SELECT"),
        ("UPDATE inside.trace SET name = 'x'", "UPDATE is not allowed"),
        ("DELETE FROM inside.trace", "DELETE is not allowed"),
        ("DROP TABLE inside.trace", "DROP is not allowed"),
        ("ALTER TABLE inside.trace ADD COLUMN x INT", "ALTER is not allowed"),
        ("CREATE TABLE x AS SELECT 1", "CREATE is not allowed"),
        ("CREATE TEMP TABLE x AS SELECT 1", "CREATE is not allowed"),
        ("COPY frames TO '{out}'", "COPY is not allowed"),
        ("COPY trace FROM '{secret}'", "COPY is not allowed"),
        ("EXPORT DATABASE '{out}'", "EXPORT is not allowed"),
        ("ATTACH '{out}'", "ATTACH is not allowed"),
        ("DETACH s", "DETACH is not allowed"),
        ("INSTALL httpfs", "is not allowed"),
        ("LOAD httpfs", "LOAD is not allowed"),
        ("SET memory_limit = '100GB'", "SET is not allowed"),
        ("RESET memory_limit", "SET is not allowed"),
        ("SET VARIABLE x = 1", "SET is not allowed"),
        ("PRAGMA enable_profiling", "is not allowed"),
        ("CALL pragma_version()", "CALL is not allowed"),
        ("CHECKPOINT", "is not allowed"),
        ("BEGIN", "TRANSACTION is not allowed"),
        ("VACUUM", "VACUUM is not allowed"),
        ("PREPARE p AS SELECT 1", "PREPARE is not allowed"),
        ("USE memory", "is not allowed"),
        ("SELECT 1; DROP TABLE inside.trace", "expected one statement, found 2"),
        ("SELECT 1; SELECT 2", "expected one statement, found 2"),
        ("", "expected one statement, found 0"),
        ("-- nothing", "expected one statement, found 0"),
        ("SELECT * FROM read_csv('{secret}')", "disabled by configuration"),
        ("SELECT * FROM read_text('{secret}')", "disabled by configuration"),
        ("SELECT * FROM read_blob('{secret}')", "disabled by configuration"),
        ("SELECT * FROM '{secret}'", "disabled by configuration|does not exist"),
        ("SELECT * FROM parquet_scan('{secret}')", "disabled by configuration"),
        ("SELECT * FROM glob('{secret}*')", "disabled by configuration"),
        ("SELECT * FROM sniff_csv('{secret}')", "disabled by configuration"),
        ("EXPLAIN ANALYZE COPY frames TO '{out}'", "disabled by configuration"),
        ("EXPLAIN ANALYZE INSERT INTO inside.bits VALUES (1, 1)", "read-only"),
        ("EXPLAIN ANALYZE CREATE TABLE x AS SELECT 1", "read-only"),
        ("SELECT * FROM store_in_python", "store_in_python does not exist"),
        ("SELECT getenv('HOME')", "getenv does not exist"),
        (
            "WITH x AS (INSERT INTO inside.bits VALUES (1, 1) RETURNING bit) FROM x",
            "read-only|SELECT",
        ),
    ],
)
def test_nothing_but_reading_the_store_is_done(
    store: Any, tmp_path: Path, sql: Any, reason: Any
) -> None:
    store_in_python = {"a": [1]}  # what DuckDB would read if it were let
    secret, out = tmp_path / "secret.csv", tmp_path / "out"
    secret.write_text("a,b\n1,2\n")
    before = store.path.read_bytes()

    with pytest.raises(SqlError, match=reason):
        store.user_sql(sql.format(secret=secret, out=out)).rows()

    assert store.path.read_bytes() == before
    assert not out.exists()
    assert store_in_python


def test_settings_are_the_same_for_the_next_statement(store: Any) -> None:
    sql = "SELECT value FROM duckdb_settings() WHERE name IN ('enable_external_access', 'lock_configuration')"

    for _ in range(2):
        assert sorted(store.user_sql(sql).rows().values) == [("false",), ("true",)]


@pytest.mark.parametrize(
    ("sql", "parts"),
    [
        ("SELECT * FROM edge_s", ["edge_s does not exist", 'Did you mean "edges"', "LINE 1"]),
        ("SELECT relatoin FROM edges", ['"relatoin" not found', "relation"]),
        ("SELECT 1 FROM", ["syntax error"]),
    ],
)
def test_a_mistake_is_told_as_the_database_tells_it(store: Any, sql: Any, parts: Any) -> None:
    with pytest.raises(SqlError) as caught:
        store.user_sql(sql).rows()

    assert all(part.lower() in str(caught.value).lower() for part in parts), caught.value


def test_a_time_with_a_zone_is_shown_or_told_how_to_be(store: Any) -> None:
    asked = "SELECT TIMESTAMPTZ '2026-11-25 10:00:00+02'"
    if find_spec("pytz") or duckdb.__version__ >= "2.0.1":  # which asks zoneinfo
        assert [row[0].timestamp() for row in store.user_sql(asked).rows()] == [1_795_593_600]
    else:
        with pytest.raises(SqlError, match=r"cast them: now\(\)::TIMESTAMP"):
            store.user_sql(asked).rows()

    assert len(store.user_sql("SELECT now()::TIMESTAMP").rows()) == 1


def test_a_runaway_statement_is_stopped_in_time(store: Any) -> None:
    start = time.perf_counter()

    with pytest.raises(SqlError, match=r"stopped after 0.2 s: SELECT count"):
        store.user_sql(RUNAWAY, timeout_s=0.2).rows()

    assert time.perf_counter() - start >= 0.2


def test_a_stream_is_stopped_in_time_too(store: Any) -> None:
    sql = "SELECT a.range + b.range FROM range(1000000) a, range(1000000) b"

    with (
        pytest.raises(SqlError, match="stopped after"),
        store.user_sql(sql, 0.3).batches(1000) as batches,
    ):
        for _ in batches:
            pass


def test_the_store_goes_on_after_a_statement_was_stopped(store: Any) -> None:
    with pytest.raises(SqlError):
        store.user_sql(RUNAWAY, timeout_s=0.05).rows()

    assert store.user_sql("SELECT 1", timeout_s=600).rows().values == [(1,)]


def test_too_much_memory_is_refused_not_taken(tmp_path: Path) -> None:
    StoreFile.create(tmp_path / "s.db")
    small = StoreFile(tmp_path / "s.db", memory=64 << 20)
    sql = "SELECT list(range) FROM range(20000000)"

    with pytest.raises(SqlError, match=r"(?i)memory"):
        small.user_sql(sql).rows()


@pytest.mark.parametrize("deep", ["(" * 100_000, "SELECT " + "-" * 100_000 + "1", "[" * 50_000])
def test_deep_nonsense_is_an_error_not_a_crash(store: Any, deep: Any) -> None:
    with pytest.raises(SqlError):
        store.user_sql(deep).rows()


def test_a_statement_that_is_too_long_is_refused(store: Any) -> None:
    with pytest.raises(SqlError, match="1048576 are allowed"):
        store.user_sql("SELECT 1" + " " * (1 << 20)).rows()


def test_an_error_of_sql_is_an_error_of_the_store() -> None:
    assert issubclass(SqlError, StoreError)


# Faults of the database itself


@pytest.fixture
def alone(tmp_path: Path) -> StoreFile:
    store = StoreFile.create(tmp_path / "alone.db")
    publish(store, RandomTrace(frames=5))
    return store


def fail(monkeypatch: pytest.MonkeyPatch, question: str, times: int) -> None:
    """Let the database fail the first times that it is asked a question."""
    execute, left = duckdb.DuckDBPyConnection.execute, [None] * times

    def faulty(connection: Any, sql: Any, parameters: Any = None) -> Any:
        if left and sql == question:
            left.pop()
            raise duckdb.InternalException(
                "INTERNAL Error: global dictionary\n\nStack Trace:\n0x4b"
            )
        return execute(connection, sql, parameters)

    monkeypatch.setattr(duckdb.DuckDBPyConnection, "execute", faulty)


@pytest.mark.skipif(duckdb.__version__.startswith("1."), reason="DuckDB 1 has no such setting")
def test_small_chunks_are_not_gathered_because_their_dictionaries_are_mixed_up(store: Any) -> None:
    setting = "SELECT current_setting('enable_caching_operators')"
    assert store.user_sql(setting).rows().values == [(False,)]


@pytest.mark.parametrize("nested", [False, True])
def test_a_question_that_meets_a_fault_of_the_database_is_asked_again(
    alone: Any, monkeypatch: pytest.MonkeyPatch, nested: Any
) -> None:
    question = "SELECT count(*) FROM frames"
    fail(monkeypatch, question, times=1)
    with alone.snapshot() if nested else nullcontext():
        assert alone.rows(question).values == [(5,)]
        assert alone.rows("SELECT 1").values == [(1,)]


def test_a_fault_that_stays_is_one_line_and_the_store_goes_on(
    alone: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail(monkeypatch, "SELECT 1", times=9)
    with pytest.raises(StoreError, match=r"fault of DuckDB \S+ itself.*global dictionary$"):
        alone.rows("SELECT 1")
    monkeypatch.undo()
    assert alone.rows("SELECT 1").values == [(1,)]


def test_what_a_question_was_given_is_given_again(
    alone: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    question = "SELECT sum(n) FROM mine"
    fail(monkeypatch, question, times=1)
    given = GivenTable("mine", {"n": "INTEGER"}, lambda: iter([[[1, 2]], [[3]]]))
    assert alone.rows(question, given=[given]).values == [(6,)]


@pytest.mark.parametrize("table", ["frame", "state", "edge"])
def test_who_asks_for_a_table_beneath_the_views_is_told_of_the_views(
    store: StoreFile, table: str
) -> None:
    with pytest.raises(
        SqlError, match=r"does not exist!\nThe views are frames, nodes, edges, "
    ) as told:
        store.user_sql(f"SELECT * FROM {table}").rows()
    assert "inside" not in str(told.value)


GIVEN = {
    "whole": ("BIGINT", [1 << 62, None, -7]),
    "real": ("DOUBLE", [0.1, None, math.inf]),
    "whole as real": ("DOUBLE", [1, 2, 3]),
    "not a number": ("DOUBLE", [1.5, math.nan, None]),
    "truth": ("BOOLEAN", [True, None, False]),
    "text": ("VARCHAR", [None, "é", "12"]),
    "nothing is known": ("DOUBLE", [None, None, None]),
    "texts": ("VARCHAR", [None, None, None]),
    "short": ("INTEGER", [1, None, 3]),
}


@pytest.mark.parametrize(
    "names", [*((name,) for name in GIVEN), ("whole", "real", "truth", "text")]
)
def test_a_table_that_is_given_holds_the_values_of_its_blocks(
    store: StoreFile, names: tuple[str, ...]
) -> None:
    block = [GIVEN[name][1] for name in names]
    given = GivenTable("mine", {n: GIVEN[n][0] for n in names}, lambda: iter([block, block]))
    as_real = [GIVEN[name][0] == "DOUBLE" for name in names]
    expected = [
        tuple(
            float(v) if real and v is not None else v for v, real in zip(row, as_real, strict=True)
        )
        for row in zip(*block, strict=True)
    ]

    found = store.rows("FROM mine", given=[given]).values

    assert repr(found) == repr(expected * 2)  # NaN is not equal to itself


@pytest.mark.parametrize("label", [*SUPER_KINDS, "TwoWheeler", "Pedestrian", "car"])
def test_is_a_finds_the_kinds_of_a_group(store: Any, label: str) -> None:
    kinds = kinds_labelled(label)
    counts = store.user_sql("SELECT kind, count(*) FROM world_nodes GROUP BY kind").rows().values
    sql = f"SELECT count(*) FROM world_nodes WHERE is_a(kind, '{label}')"

    expected = sum(count for kind, count in counts if kind in kinds)
    assert store.user_sql(sql).rows().values == [(expected,)]


def test_is_a_is_a_function_of_plain_connections(store: Any, tmp_path: Path) -> None:
    sql = "SELECT count(*) FROM nodes WHERE is_a(kind, 'vehicle')"
    with duckdb_of(shutil.copy(store.path, tmp_path / "copy.db")) as connection:
        assert connection.execute(sql).fetchall() == store.user_sql(sql).rows().values


def test_is_a_refuses_an_unknown_word(store: Any) -> None:
    with pytest.raises(SqlError, match="unknown kind or group of kinds: vehicel"):
        store.user_sql("SELECT count(*) FROM nodes WHERE is_a(kind, 'vehicel')").rows()


@pytest.mark.parametrize(
    ("sql", "notes"),
    [
        ("SELECT 1 FROM nodes WHERE kind = 'car'", []),
        ("SELECT 1 FROM nodes n WHERE n.kind IN ('car', 'vru')", ["is_a(kind, 'vru')"]),
        ("FROM pairs WHERE dst_kind = 'vehicle'", ["is_a(dst_kind, 'vehicle')"]),
        ("FROM entities WHERE kind != 'trukc'", ["did you mean 'truck'?"]),
        ("FROM events WHERE kind = 'collision'", []),
        ("FROM mine WHERE kind = 'trukc'", []),
        ("FROM nodes WHERE kind =", []),
    ],
)
def test_a_comparison_with_no_kind_gets_a_note(sql: str, notes: list[str]) -> None:
    found = kind_notes(sql)

    assert len(found) == len(notes)
    assert all(part in note for part, note in zip(notes, found, strict=True))
