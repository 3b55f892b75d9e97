"""``sgql('MATCH …')`` in SQL: a table of what a pattern returns."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest
from oracle_over_time import worlds

import sgstore
from sgstore.apps.cli import run as run_verb
from sgstore.apps.sandbox import Sandbox
from sgstore.errors import QueryError, SqlError
from sgstore.lang.syntax import pattern_tables

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.query import Store


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    _, store = worlds(7, tmp_path_factory.mktemp("worlds"))
    with store.file.snapshot():
        yield store


def in_quotes(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("MATCH (e:Ego)-[d:near|visible]-(v:Entity)", id="matches"),
        pytest.param("MATCH (v:Car) WHERE v.kind = 'car' RETURN v.name AS n, FRAMES", id="frames"),
        pytest.param("MATCH (e:Ego)-[:near]-(v) RETURN v.kind, COUNT(*) AS n", id="groups"),
        pytest.param("MATCH (e:Ego)-[:near]-(v) RETURN INTERVALS", id="intervals"),
        pytest.param("MATCH (e:Ego)-[:near]-(v) RETURN CLIPS(-1s, +1s)", id="clips"),
        pytest.param("MATCH (v) RETURN v.x AS x ORDER BY x LIMIT 5", id="in an order"),
        pytest.param("MATCH (v:Car) RETURN collect(v.name) AS names", id="lists"),
        pytest.param(
            "MATCH (e:Ego)-[:near|visible]-(v:Entity) WHERE v.speed < 3 AS a"
            " THEN MATCH (e), (v) WHERE dist(e, v) > 1 RETURN v.name AS n, t(a) AS t, INTERVALS",
            id="a sequence",
        ),
        pytest.param("MATCH (e:Ego) WHERE prev(e.speed) > 0.5", id="over time"),
    ],
)
def test_a_pattern_is_a_table_of_its_rows(text: str, store: Store) -> None:
    matches = store.find(text)

    rows = store.sql(f"SELECT * FROM sgql({in_quotes(text)})")

    assert rows.columns == matches.columns
    assert Counter(map(repr, rows)) == Counter(repr(tuple(row)) for row in matches)
    assert len(rows)


def test_a_statement_joins_patterns_and_views(store: Store) -> None:
    sql = """
        -- not this one: sgql('MATCH (e:Ego)')
        SELECT 'sgql(''no'')' AS said, f.trace, s.v, count(*) AS n /* sgql('nor this') */
        FROM SGQL ( $$MATCH (e:Ego)-[:near|visible]-(v:Entity)
                      WHERE v.speed > $least AND v.kind IN $kinds RETURN v.name AS v, FRAMES$$,
                    least := 0.5, kinds := ['car', 'bicycle'] ) AS s
        JOIN frames AS f ON f.frame_id = s.frame_id
        WHERE f.frame_id IN (SELECT frame_id FROM sgql('MATCH (c:Car) WHERE c.speed > 1'))
        GROUP BY ALL ORDER BY n DESC, v LIMIT 100"""
    near = store.find(
        "MATCH (e:Ego)-[:near|visible]-(v:Entity) WHERE v.speed > 0.5"
        " AND v.kind IN ['car', 'bicycle'] RETURN v.name AS v, FRAMES"
    )
    frames = {frame.frame_id for frame in store.find("MATCH (c:Car) WHERE c.speed > 1").frames()}
    wanted = Counter((row.trace, row.v) for row in near if row.frame_id in frames)

    rows = list(store.sql(sql))

    assert {(trace, v): n for _, trace, v, n in rows} == wanted
    assert {said for said, *_ in rows} == {"sgql('no')"}


def test_a_table_of_a_pattern_lasts_as_long_as_its_statement(store: Store) -> None:
    assert len(store.sql("FROM sgql('MATCH (e:Ego)')", max_rows=3)) == 3
    assert store.sql("FROM sgql('MATCH (e:Ego)')", max_rows=3).truncated
    with pytest.raises(SqlError, match="sgql does not exist"):
        store.sql("SELECT * FROM sgql")
    with pytest.raises(SqlError, match="edge does not exist"):
        store.sql("SELECT count(*) FROM edge, sgql('MATCH (e:Ego)')")


@pytest.mark.parametrize("name", ["block", "given", "gathered", "found"])
def test_a_table_of_ones_own_may_have_any_name_beside_a_pattern(
    name: str, store: Store, tmp_path: Path
) -> None:
    file = tmp_path / "mine.csv"
    file.write_text("trace,n\n" + "".join(f"{one.name},5\n" for one in store.traces()))
    pattern = "sgql('MATCH (e:Ego) WHERE prev(e.speed) > 0.5 RETURN INTERVALS')"
    own = sgstore.open(store.file.path, tables={name: file})
    expected = store.sql(f"SELECT 5, count(*) FROM {pattern}").values

    for _ in range(2):
        found = own.sql(f"SELECT (SELECT max(n) FROM {name}), count(*) FROM {pattern}").values
        assert found == expected
    assert expected[0][1] > 0


def test_the_same_pattern_is_asked_once() -> None:
    sql, tables = pattern_tables(
        "FROM sgql('MATCH (a)') a, sgql('MATCH (b)') b, sgql('MATCH (a)') c"
    )

    assert sql == 'FROM "sgql" a, "sgql 2" b, "sgql" c'
    assert [one.text for one in tables] == ["MATCH (a)", "MATCH (b)"]
    assert pattern_tables("FROM sgql('x')", {"sgql"})[0] == 'FROM "sgql_"'


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT 'sgql(''MATCH (e)'')'",
        'SELECT "sgql(" FROM t',
        "SELECT $$sgql('x')$$, $a$ sgql('$$') $a$",
        "SELECT e'\\' sgql(' FROM t",
        "SELECT x.sgql(1), my_sgql('a')",
        "SELECT 1 -- sgql('x",
        "SELECT sgql FROM t",
    ],
)
def test_what_is_no_call_stays_as_it_is(sql: str) -> None:
    assert pattern_tables(sql) == (sql, ())


@pytest.mark.parametrize(
    ("call", "reason", "at"),
    [
        ("sgql(MATCH)", r"sgql\(\) takes a query in quotes", "sgql(M"),
        ("sgql()", r"sgql\(\) takes a query in quotes", "sgql()"),
        ("sgql('a' 'b')", r"expected ',' or '\)' after the query", "sgql('a' '"),
        ("sgql('a', 5)", "expected the name of a parameter before the value", "sgql('a', 5"),
        ("sgql('a', x := now())", "expected a number, a text, true or false", "sgql('a', x := n"),
        ("sgql('a', x := [1, y])", "a list holds numbers, texts", "sgql('a', x := [1, y"),
        ("sgql('a'", r"expected ',' or '\)' after the query", "sgql('a'"),
        ("sgql('a', x := [1", "a list holds numbers, texts", "sgql('a', x := [1"),
    ],
)
def test_a_call_that_is_none_is_refused_where_it_stands(call: str, reason: str, at: str) -> None:
    text = f"SELECT * FROM {call}"

    with pytest.raises(QueryError, match=reason) as caught:
        pattern_tables(text)

    assert caught.value.span is not None
    assert text[caught.value.span.start : caught.value.span.end] == at


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("MATCH (e:Egg)", "unknown label 'Egg'"),
        ("MATCH (e:Ego", "the text ends"),
        ("MATCH (e:Ego) RETURN SUBGRAPHS", "a table has values, and SUBGRAPHS are graphs"),
        ("MATCH (e:Ego) WHERE e.speed > $x", r"the parameter \$x has no value"),
        ("CHECK ALWAYS ego.speed < 9", "a CHECK has a verdict, not matches"),
    ],
)
def test_a_mistake_in_the_pattern_is_told_in_its_text(text: str, reason: str, store: Store) -> None:
    with pytest.raises(QueryError, match=reason) as caught:
        store.sql(f"SELECT * FROM sgql('{text}')")

    assert caught.value.text == text


def test_a_shell_and_a_sandbox_ask_it_too(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, sql = (
        str(store.file.path),
        "SELECT count(*) AS n FROM sgql('MATCH (e:Ego) RETURN FRAMES')",
    )
    frames = store.find("MATCH (e:Ego)").count()

    assert run_verb(["sql", path, sql, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [{"n": frames}]
    assert run_verb(["sql", path, sql, "-o", str(tmp_path / "x.parquet")]) == 0
    assert run_verb(["sql", path, "FROM sgql('MATCH (e:Egg)')"]) != 0
    assert "unknown label 'Egg'" in capsys.readouterr().err
    with Sandbox(store.file.path, timeout_s=60) as box:
        assert box.sql(sql).rows == [(frames,)]
        with pytest.raises(QueryError, match="unknown label 'Egg'"):
            box.sql("FROM sgql('MATCH (e:Egg)')")


def test_traces_that_a_pattern_leaves_out_are_told(
    store: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "MATCH (e:Ego)-[:sees]->(v) RETURN COUNT(*) AS n"
    reasons: dict[str, Any] = store.find(text).reasons
    assert reasons

    assert store.sql(f"FROM sgql('{text}')").reasons == reasons
    assert run_verb(["sql", str(store.file.path), f"FROM sgql('{text}')"]) == 0
    assert "skipped, because they lack data for this query" in capsys.readouterr().err
