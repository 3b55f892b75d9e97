"""Patterns with names as steps, with variables of one's own: the same as the text with other names in it."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import pytest
from oracle_over_time import worlds
from test_lang_golden import CATALOG

from sgstore.errors import QueryError
from sgstore.lang.library import patterns
from sgstore.lang.sql import compile_query, value_text

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.query import Store

SEQUENCES = [p for p in patterns().values() if p.kind in {"concept", "scenario"}]


def told(text: str) -> list[Any]:
    """What the steps of a query bind and ask for."""
    bound = compile_query(text, CATALOG).bound
    scopes = [(step.scope, step.when) for step in bound.steps] or [(bound.scope, ())]
    return [
        (
            [(re.sub(r"#\d+", "#", key), node.kinds) for key, node in scope.nodes.items()],
            sorted(re.sub(r"#\d+", "#", value_text(part)) for part in (*scope.where, *when)),
        )
        for scope, when in scopes
    ]


@pytest.mark.parametrize("pattern", SEQUENCES, ids=lambda one: one.name)
def test_renamed_library_pattern_equals_renamed_text(
    pattern: Any,
) -> None:
    outside = pattern.query
    while "{" in outside:
        outside = re.sub(r"\{[^{}]*\}", "", outside)
    found = re.findall(r"\((\w+)(?=[:)])", outside)
    names = {name: f"my_{name}" for name in dict.fromkeys(found) if name != "ego"}
    assert names
    text = pattern.text
    for name, new in names.items():
        text = re.sub(rf"(?<![.$\w]){name}\b(?!\s*\()", new, text)
    given = ", ".join(f"{name} = {new}" for name, new in names.items())

    assert told(f"MATCH {pattern.name}({given})") == told(text)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    _, store = worlds(7, tmp_path_factory.mktemp("worlds"))
    with store.file.snapshot():
        yield store


PASSING = """DEFINE SCENARIO passing(limit = 3, most = 9) AS
MATCH (e:Ego)-[:near|visible]-(v:Entity) WHERE v.speed < $limit
  AND NOT EXISTS {(x:Person)-[:near]->(v) WHERE x.speed > $most} AS begun
THEN MATCH (e), (v) WHERE dist(e, v) > 1 AS over;
"""
SPELLED = """MATCH (e:Ego)-[:near|visible]-({0}:Entity) WHERE {0}.speed < {1}
  AND NOT EXISTS {{(p:Person)-[:near]->({0}) WHERE p.speed > 9}} AS {2}
THEN MATCH (e), ({0}) WHERE dist(e, {0}) > 1 AS {3}"""


@pytest.mark.parametrize(
    ("steps", "spelled", "values"),
    [
        pytest.param("passing(v = a)", [("a", 3, "begun", "over")], "a, t(over)", id="once"),
        pytest.param(
            "passing(v = a) THEN MATCH passing(v = x, begun = then, over = past, limit = 5)",
            [("a", 3, "begun", "over"), ("x", 5, "then", "past")],
            "a, x, t(begun), t(past)",
            id="twice, and one has the name that braces in it bind",
        ),
        pytest.param(
            "passing(v = a) THEN MATCH passing(v = a, begun = then, over = past)",
            [("a", 3, "begun", "over"), ("a", 3, "then", "past")],
            "a, t(then)",
            id="twice of the same",
        ),
    ],
)
def test_scenario_equals_its_text(
    steps: str, spelled: list[tuple[str, int, str, str]], values: str, store: Store
) -> None:
    text = " THEN ".join(SPELLED.format(*one) for one in spelled)

    found = store.find(f"{PASSING} MATCH {steps} RETURN trace.name, {values}").rows()

    assert found == store.find(f"{text} RETURN trace.name, {values}").rows()
    assert found


def test_names_in_braces_are_local(store: Store) -> None:
    """A scenario asks that there be no person, whatever the text around it calls ``x``."""
    asked = f"{PASSING} MATCH (x:Car) THEN WITHIN 0.3s MATCH passing(v = a) RETURN trace.name, x, a"
    text = f"MATCH (x:Car) THEN WITHIN 0.3s {SPELLED.format('a', 3, 'begun', 'over')}"

    found = store.find(asked).rows()

    assert found == store.find(f"{text} RETURN trace.name, x, a").rows()
    assert found


def test_parameter_name_hides_variable() -> None:
    text = "DEFINE SCENARIO fast(v = 3) AS MATCH (v:Car) WHERE v.speed > $v; MATCH fast(v = {})"

    assert "v.speed > 5" in str(told(text.format(5)))
    with pytest.raises(QueryError, match="'v' is a parameter of fast and takes a value"):
        compile_query(text.format("w"), CATALOG)
