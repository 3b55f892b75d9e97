"""Edges are joined in the order of exact counts: with other counts it is another order, and the same answer."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import permutations
from typing import TYPE_CHECKING

import pytest
from oracle_worlds import World, random_world

from sgstore.lang.sql import compile_query
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from sgstore.lang.catalog import Catalog

TEXT = "MATCH (a:Car)-[:near]->(b), (b)-[:visible]->(c), (a)-[:inDFrontOf]->(c) RETURN frame.id, a, b, c"
RELATIONS = ("near", "visible", "inDFrontOf")


@pytest.fixture(scope="module")
def world() -> World:
    return random_world(23, traces=3, frames=20)


def counted(catalog: Catalog, counts: Mapping[str, int]) -> Catalog:
    """A catalog in which every triple of a relation has a count of our own."""
    edges = {triple: counts.get(triple[0], n) for triple, n in catalog.edges.items()}
    return replace(catalog, edges=edges)


def order(text: str) -> list[str]:
    """The relations of the joined edges, first to last."""
    return re.findall(r'"edge" AS "#\d+:(\w+)"', text)


def test_edge_order_follows_counts_without_changing_results(world: World) -> None:
    found: dict[tuple[str, ...], list[tuple[int, ...]]] = {}
    for rare, more, most in permutations(RELATIONS):
        counts = {rare: 1, more: 100, most: 10_000}
        statement = compile_query(TEXT, counted(world.catalog, counts)).rows()
        rows = world.connection.execute(statement.sql, list(statement.values)).fetchall()
        assert order(statement.sql) == [rare, more, most]
        found[tuple(order(statement.sql))] = rows

    assert len(found) == 6
    (first, *others) = found.values()
    assert first
    assert all(rows == first for rows in others)


def test_rare_edge_follows_a_connected_edge(world: World) -> None:
    """After the rarest comes the rarest that is connected, lest everything be joined with everything."""
    text = (
        "MATCH (a:Car)-[:near]->(b)-[:visible]->(c)-[:inDFrontOf]->(d) RETURN frame.id, a, b, c, d"
    )
    catalog = counted(world.catalog, {"near": 1, "visible": 500, "inDFrontOf": 2})

    statement = compile_query(text, catalog).rows()

    assert order(statement.sql) == ["near", "visible", "inDFrontOf"]


def test_catalog_counts_rows_exactly(town_store: Path) -> None:
    file = StoreFile(town_store)
    catalog = file.catalog()

    for table, counts in (("edge", catalog.edges), ("map_edge", catalog.map_edges)):
        sql = f"SELECT relation, src_kind, dst_kind, count(*) FROM inside.{table} GROUP BY ALL"
        rows = file.rows(sql).values
        assert dict(counts) == {(r, s, d): n for r, s, d, n in rows}
        assert len(rows) > 3


def test_paths_are_searched_in_answerable_traces(world: World) -> None:
    text = "MATCH (a:Car)-[:isIn]->(l:Lane)-[:travelsTo*1..2]->(m:Lane)<-[:isIn]-(b)"
    silent, *others = world.catalog.traces
    catalog = replace(world.catalog, traces=(replace(silent, answers=frozenset()), *others))

    def traces(of: Catalog) -> set[int]:
        statement = compile_query(f"{text} RETURN trace.id", of).rows()
        rows = world.connection.execute(statement.sql, statement.values).fetchall()
        return {trace for (trace,) in rows}

    assert silent.trace_id in traces(world.catalog)
    assert traces(catalog) == traces(world.catalog) - {silent.trace_id}
