"""A second ``MATCH`` about the same frame: what stands in both, joined by commas and ``AND``."""

from __future__ import annotations

import re

import pytest
from oracle import disagreement
from oracle_worlds import World, random_world
from test_lang_golden import CATALOG

from sgstore.lang.sql import compile_query


@pytest.fixture(scope="module")
def world() -> World:
    return random_world(1, frames=20)


def plain(text: str) -> str:
    """The statement of a query, without the numbers that tell unnamed nodes apart."""
    statement = compile_query(text, CATALOG).rows()
    return re.sub(r"#\d+", "#", statement.sql) + repr(statement.values)


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("MATCH (e:Ego) MATCH (v:Car)", "MATCH (e:Ego), (v:Car)"),
        (
            "MATCH (e:Ego) WHERE e.speed > 1 MATCH (e)-[:near]->(v) WHERE v.speed < 2",
            "MATCH (e:Ego), (e)-[:near]->(v) WHERE e.speed > 1 AND v.speed < 2",
        ),
        (
            "MATCH (e:Ego) MATCH (e)-[:near]->(v) WHERE e.speed > v.speed MATCH (v)-[:isIn]->(:Lane)",
            "MATCH (e:Ego), (e)-[:near]->(v), (v)-[:isIn]->(:Lane) WHERE e.speed > v.speed",
        ),
        (
            "MATCH (a:Car) MATCH (b:Car) FOR >= 1s AS s THEN MATCH (a) MATCH (b) WHERE a.x < b.x",
            "MATCH (a:Car), (b:Car) FOR >= 1s AS s THEN MATCH (a), (b) WHERE a.x < b.x",
        ),
    ],
)
def test_it_is_the_same_as_commas(text: str, same: str, world: World) -> None:
    assert plain(text) == plain(same)
    if "THEN" not in text:
        assert disagreement(text, world)[0] == ""


def test_nodes_of_both_differ(world: World) -> None:
    problem, frames = disagreement("MATCH (a:Car)-[:near]->(b) MATCH (c:Car)-[:near]->(d)", world)

    assert problem == ""
    assert frames
