"""Counts by masks and other plans of a query: the same rows as frame by frame and without each rule."""

from __future__ import annotations

import random
from collections import Counter
from contextlib import suppress
from operator import eq, ge, gt, le, lt, ne
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from oracle import disagreement
from oracle_patterns import Writer
from oracle_worlds import World, random_world
from thorough import LONG

import sgstore.lang.sql._masks as sql
import sgstore.lang.sql._rewrite as rewrite
from sgstore.errors import QueryError
from sgstore.lang.sql import compile_query
from sgstore.lang.sql._mask_counts import MOST, CountRange, frames_with

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.sql import SqlStatement

SIGNS: dict[str, Callable[[float, float], bool]] = {
    "=": eq,
    "<": lt,
    "<=": le,
    ">": gt,
    ">=": ge,
    "<>": ne,
}
Rows = list[tuple[int, int, int]]


def rows_of(world: World, statement: SqlStatement) -> list[tuple[Any, ...]]:
    return world.connection.execute(statement.sql, list(statement.values)).fetchall()


def unchanged(of: Any, _: Catalog, **__: bool) -> Any:
    return of


def found(rows: Rows, wanted: CountRange) -> set[tuple[int, int, int]]:
    """Bucket, key and bit of the frames that the SQL finds among rows of (bucket, key, mask)."""
    with duckdb.connect() as connection:
        connection.execute('CREATE TABLE "given" ("bucket" BIGINT, "key" INTEGER, "mask" BIGINT)')
        connection.execute(
            'CREATE TABLE "bits" AS SELECT range AS bit, 1 << range AS m FROM range(60)'
        )
        connection.execute(
            'INSERT INTO "given" SELECT unnest($1), unnest($2), unnest($3)',
            [list(column) for column in zip(*rows, strict=True)],
        )
        sql = frames_with("given", ['"key"'], wanted)
        masks = connection.execute(f'SELECT "bucket", "key", "mask" FROM ({sql})').fetchall()
    return {(b, key, bit) for b, key, mask in masks for bit in range(60) if mask >> bit & 1}


def counted(rows: Rows, holds: Callable[[int], bool]) -> set[tuple[int, int, int]]:
    counts = Counter(
        (bucket, key, bit) for bucket, key, mask in rows for bit in range(60) if mask >> bit & 1
    )
    return {frame for frame, count in counts.items() if holds(count)}


@pytest.mark.parametrize("sign", SIGNS)
@pytest.mark.parametrize("number", [-1, 0, 0.5, 1, 2, 2.5, 3, 7, 90])
def test_mask_sums_equal_counted_frames(sign: str, number: float) -> None:
    if SIGNS[sign](0, number):
        return  # such a comparison is asked the other way round
    rng = random.Random(3)
    rows = [(rng.choice((5, 9)), rng.choice((1, 2, 3)), rng.getrandbits(60)) for _ in range(60)]
    rows += [(5, 4, (1 << 60) - 1), (5, 4, 1 << 59), (5, 4, 1)]

    frames = found(rows, CountRange.of(sign, number))

    assert frames == counted(rows, lambda count: SIGNS[sign](count, number))


@pytest.mark.parametrize("bound", [1, MOST - 1, MOST, MOST + 1, MOST + 2])
@pytest.mark.parametrize("most", [MOST, MOST + 1, *[40_000] * LONG])
def test_count_is_right_for_many_rows(bound: int, most: int) -> None:
    """Some buckets have as many rows as can be added up, or more, and some frames are in all of them."""
    rng = random.Random(1)
    rows = [(1, 1, rng.getrandbits(60) | 1 << 59 | 1 << 11) for _ in range(most)]
    rows += [(1, 2, rng.getrandbits(60)) for _ in range(5)]

    assert found(rows, CountRange.of(">=", bound)) == counted(rows, lambda count: count >= bound)
    assert found(rows, CountRange.of("=", bound)) == counted(rows, lambda count: count == bound)


@pytest.fixture(scope="module")
def world() -> World:
    return random_world(4, traces=3, frames=14)


@pytest.mark.parametrize("sign", SIGNS)
def test_block_count_equals_block_matches(sign: str, world: World) -> None:
    text = f"MATCH (a:Entity) WHERE COUNT {{(a)-[:near|visible]->(b)-[r]-(c)}} {sign} 3 RETURN frame.id, a"
    each = "MATCH (a:Entity) RETURN frame.id, a, COUNT {(a)-[:near|visible]->(b)-[r]-(c)} AS n"

    statement, counts = (compile_query(q, world.catalog).rows() for q in (text, each))

    def rows(of: SqlStatement) -> list[tuple[int, ...]]:
        return world.connection.execute(of.sql, list(of.values)).fetchall()

    wanted = {row[:2] for row in rows(counts) if SIGNS[sign](row[2], 3)}
    assert set(rows(statement)) == wanted
    assert wanted
    assert "sum(" in statement.sql
    assert "sum(" not in counts.sql


COUNTS = [
    "MATCH (a)-[:near]->(b) RETURN COUNT(*)",
    "MATCH (a)-[r]->(b) RETURN a.kind, type(r) AS relation, b.kind, COUNT(*) AS n ORDER BY n DESC",
    "MATCH (a:Vehicle)-[:isIn]->(l:Lane) RETURN l.road, l.width > 3, COUNT(*), COUNT(DISTINCT a.id)",
    "MATCH (a)-[r]->(b) RETURN trace.name, trace.map, MIN(a.name), MAX(type(r)), 2 * COUNT(*)",
    "MATCH (a) WHERE NOT EXISTS {(a)-[:near]->()} RETURN a, a.is_static, COUNT(*)",
    "MATCH (a:Car)-[:near]->(:Train) RETURN COUNT(*)",
    "USING NODES any MATCH (a)-[:near|visible]->()<-[d]-(b) RETURN type(d), a.kind, COUNT(*)",
    "MATCH (a)-[:near]->(b) WHERE a.speed > b.speed RETURN a.special, b.ident, COUNT(*)",
]


@pytest.mark.parametrize("text", COUNTS)
def test_bucket_counts_equal_frame_counts(
    text: str, world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = compile_query(text, world.catalog)

    monkeypatch.setattr(rewrite, "count_by_buckets", unchanged)
    by_frames = compile_query(text, world.catalog).rows()

    assert rows_of(world, compiled.rows()) == rows_of(world, by_frames)
    assert "held" in compiled.rows().sql
    assert "held" not in by_frames.sql


@pytest.mark.parametrize(
    "returned", ["COUNT(*), AVG(a.x)", "COUNT(*), a.speed", "COUNT(a.speed)", "COUNT(*), frame.seq"]
)
def test_changing_values_are_not_counted_by_bucket(returned: str, world: World) -> None:
    statement = compile_query(f"MATCH (a)-[:near]->(b) RETURN {returned}", world.catalog).rows()

    assert "held" not in statement.sql


# Other plans of a query


# Without labels_to_conditions, labels of nodes outside a block have no SQL.
OPTIONAL = (
    "push_negations",
    "counts_to_existence",
    "unfold_paths",
    "labels_from_conditions",
    "open_exists",
    "entities_of_pairs",
    "narrowed",
    "ordered",
    "count_by_buckets",
)


@pytest.fixture(scope="module")
def answered() -> tuple[World, dict[str, list[tuple[Any, ...]]]]:
    """Random queries with their rows by all rules."""
    world, answers = random_world(11), {}
    for number in range(400, 416):
        text = Writer(number).query()
        with suppress(QueryError):
            answers[text] = rows_of(world, compile_query(text, world.catalog).rows())
    assert len(answers) > 10
    return world, answers


@pytest.mark.parametrize("rule", OPTIONAL)
def test_rewriting_rule_keeps_results(
    rule: str,
    answered: tuple[World, dict[str, list[tuple[Any, ...]]]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world, answers = answered
    monkeypatch.setattr(rewrite, rule, unchanged)
    for text, rows in answers.items():
        assert rows_of(world, compile_query(text, world.catalog).rows()) == rows, text


PATHS = [
    "MATCH (a:Car)-[:isIn]->(l:Lane)-[:travelsTo*1..2]->(m:Lane)<-[:isIn]-(b)",
    "MATCH (a:Car)-[:near|visible*1..3]->(b)-[r:isIn]->(l:Lane)",
    "USING NODES any MATCH (a:Car)-[:isIn]->(l:Lane)-[:travelsTo|opposes*2..4]->(l)",
    "MATCH (a)-[:near*1..2]->(b)-[:visible*1..2]->(c), (a)-[:isIn]->(:Lane)",
    "MATCH (a:Car) WHERE COUNT {(a)-[:isIn]->(l:Lane)-[:travelsTo*1..3]->(m)} >= 2",
    "MATCH (a:Person)-[:isIn]->(l:Lane)-[:near*1..2]->(m:Lane)",
]


@pytest.mark.parametrize("text", PATHS)
def test_paths_start_at_bound_nodes_without_changing_results(
    text: str, world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rows() -> tuple[str, list[tuple[Any, ...]]]:
        statement = compile_query(text, world.catalog).rows()
        return statement.sql, rows_of(world, statement)

    unfolded, found = rows()
    monkeypatch.setattr(sql, "_BRANCHES", 0)
    at_once, same = rows()

    assert found == same
    assert ":lengths" not in at_once
    assert ":lengths" in unfolded or '"ways ' in unfolded or not found
    assert disagreement(text, world)[0] == ""
