"""SQL and patterns of strangers: bounded in what they see, in time, in memory and in rows."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import pytest
from probes import PROBES

from sgstore.apps.sandbox import Sandbox, _limit
from sgstore.errors import QueryError, SgstoreError, SqlError, StoreError
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

RUNAWAY = (
    "SELECT count(*) FROM range(1000000000) a, range(1000000000) b WHERE a.range % 7 = b.range % 5"
)
NEAR = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"


@pytest.fixture(scope="module")
def path(town_store: Path) -> Path:
    return town_store


@pytest.fixture(scope="module")
def box(path: Path) -> Iterator[Sandbox]:
    """With a table of the host's, which opens a folder to the process."""
    table = path.with_name("labels.csv")
    Store(path).sql("SELECT frame_id, seq % 3 AS score FROM frames").csv(table)
    with Sandbox(path, timeout_s=600, tables={"labels": table}) as box:
        assert box.sql("SELECT count(*) FROM labels").rows == [(750,)]
        yield box


def test_sql_gives_what_it_gives_outside(box: Sandbox, path: Path) -> None:
    sql = "SELECT kind, count(*), max(speed) FROM nodes GROUP BY kind ORDER BY kind"

    assert box.sql(sql).rows == Store(path).sql(sql).values


def test_a_pattern_gives_what_it_gives_outside(box: Sandbox, path: Path) -> None:
    query = f"{NEAR} WHERE v.speed > $least"
    inside, outside = box.find(query, least=0.5), Store(path).find(query, least=0.5)

    assert inside.columns == outside.columns
    assert inside.rows == list(outside)
    assert len(inside.rows) > 10
    assert not inside.truncated


def test_a_worker_is_asked_in_its_own_words(box: Sandbox) -> None:
    assert box.ask({"sql": "SELECT 1 AS one"})["rows"] == [[1]]
    with pytest.raises(SqlError, match="the question has"):
        box.ask({"sql": "x" * 2_000_000}, SqlError)


def test_values_that_json_has_not_come_as_texts(box: Sandbox) -> None:
    sql = "SELECT DATE '2026-01-02', 1.5::DECIMAL(3,1), 'ab'::BLOB, [1, NULL], {'a': 2}, 9007199254740993"

    assert box.sql(sql).rows == [
        ("2026-01-02", "1.5", "6162", [1, None], {"a": 2}, 9007199254740993)
    ]


def test_an_answer_has_a_bounded_number_of_rows(path: Path) -> None:
    with Sandbox(path, max_rows=7) as box:
        some, few = box.find("MATCH (e:Ego)"), box.sql("SELECT seq FROM frames LIMIT 7")

    assert (len(some.rows), some.truncated) == (7, True)
    assert (len(few.rows), few.truncated) == (7, False)


def test_a_mistake_in_a_pattern_is_shown_with_carets(box: Sandbox, path: Path) -> None:
    query = "MATCH (e:Ego)-[:near_kol]->(v)"
    with pytest.raises(QueryError) as inside:
        box.find(query)
    with pytest.raises(QueryError) as outside:
        Store(path).find(query)

    assert str(inside.value) == str(outside.value)
    assert "near_coll" in str(inside.value)
    assert inside.value.span == outside.value.span


@pytest.mark.parametrize(("sql", "reason"), PROBES)
def test_nothing_but_the_store_is_reached(
    box: Sandbox, path: Path, tmp_path: Path, sql: Any, reason: Any
) -> None:
    secret, out = tmp_path / "secret.csv", tmp_path / "out"
    secret.write_text("a,b\n1,2\n")
    before = path.read_bytes()

    assert box.sql("SELECT 1").rows == [(1,)]  # one that died is started again
    assert box.folder is not None
    (folder,) = box.folder.glob("sgstore-held-*/tables")
    for name, value in (("secret", secret), ("out", out), ("folder", folder)):
        sql = sql.replace(f"{{{name}}}", str(value))

    with pytest.raises(SqlError, match=reason):
        box.sql(sql)

    assert not out.exists()
    assert [file.suffix for file in folder.rglob("*") if file.is_file()] == [".parquet"]
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("sql", "reason"),
    [
        ("SELECT len(list(range)) FROM range(100000000)", "needs more memory"),
        ("SELECT string_agg(repeat('x', 1000000), '') FROM range(100000)", "needs more memory"),
        (
            "SELECT * FROM range(50000000) ORDER BY hash(range) OFFSET 49999999",
            "more memory",  # which one, many threads decide
        ),
    ],
)
def test_memory_is_bounded_and_nothing_is_spilled(path: Path, sql: str, reason: str) -> None:
    with Sandbox(path, timeout_s=60, memory=128 << 20) as box:
        with pytest.raises(SqlError, match=reason):
            box.sql(sql)

        assert box.sql("SELECT 1").rows == [(1,)]


@pytest.mark.parametrize("memory", [64 << 20, 1 << 30])
def test_a_worker_process_has_limits_of_memory_and_files(memory: int) -> None:
    resource = pytest.importorskip("resource")
    reader, writer = os.pipe()
    child = os.fork()
    if not child:  # the limits hold until the process ends
        with suppress(BaseException):
            _limit(memory, files=1000)
            kinds = resource.RLIMIT_AS, resource.RLIMIT_FSIZE, resource.RLIMIT_CORE
            limits = json.dumps([resource.getrlimit(kind) for kind in kinds])
            with suppress(MemoryError):
                bytearray(5 * (1 << 30) + 2 * memory)
                limits = "more memory than the limit"
            os.write(writer, limits.encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        said = pipe.read()
    os.waitpid(child, 0)

    (soft, hard), files, core = json.loads(said)
    assert 2 * memory < soft == hard <= 2 * memory + (5 << 30)
    assert (files, core) == ([1000, 1000], [0, 0])


@pytest.mark.parametrize(
    "sql",
    [
        RUNAWAY,
        "SELECT " + "(" * 100_000,
        "SELECT sleep_ms(60000)",
        "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r) SELECT max(n) FROM r",
    ],
)
def test_a_runaway_statement_does_not_outlive_its_deadline(path: Path, sql: str) -> None:
    with Sandbox(path, timeout_s=0.5) as box:
        with pytest.raises(SgstoreError):
            box.sql(sql)

        assert at_last(lambda: box.sql("SELECT 1").rows) == [(1,)]


def at_last(ask: Callable[[], Any]) -> Any:
    """The answer of a new process, which may be late on a busy machine."""
    for _ in range(20):
        with suppress(SqlError):
            return ask()
    return ask()


def test_a_pattern_that_runs_away_slowly_is_stopped_at_its_deadline(path: Path) -> None:
    with Sandbox(path, timeout_s=0.5) as box:
        with pytest.raises(SqlError, match=r"stopped after 0\.5 s"):
            box.find("MATCH " + "-[:near]->".join(f"(v{i})" for i in range(8)))

        assert len(at_last(lambda: box.find(f"{NEAR} RETURN FRAMES").rows)) > 0


def test_a_pattern_that_runs_away_fast_is_stopped_by_its_memory_or_its_deadline(path: Path) -> None:
    with Sandbox(path, timeout_s=1.5) as box:
        with pytest.raises(SqlError, match=r"stopped after 1\.5 s|more memory than is allowed"):
            box.find("MATCH (a), (b), (c), (d), (e), (f) RETURN COUNT(*)")

        assert len(box.find(f"{NEAR} RETURN FRAMES").rows) > 0


def test_an_answer_that_is_too_long_is_stopped(path: Path) -> None:
    with Sandbox(path) as box:
        with pytest.raises(SqlError, match="longer than 67108864 bytes"):
            box.sql("SELECT repeat('x', 1000000) FROM range(100)")

        assert box.sql("SELECT 1").rows == [(1,)]


def test_what_is_no_store_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")

    with pytest.raises(StoreError, match="store not found"):
        Sandbox(tmp_path / "none.sgstore")
    with pytest.raises(StoreError, match="not a store"):
        Sandbox(tmp_path / "notes.txt")


def test_a_process_that_does_not_start_is_told_as_that(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sgstore.apps.sandbox.START_S", 0.001)
    with pytest.raises(SqlError, match=r"did not start: stopped after 0\.001 s"):
        Sandbox(path)
