"""Conditions asked of many nodes at once have the answers that they have of one after the other."""

from __future__ import annotations

import random

import numpy as np
import pytest
from oracle_worlds import random_world
from test_lang_match import view_of

from sgstore.lang.memory import Binding, expression
from sgstore.lang.memory._evaluate import crowd_test
from sgstore.lang.memory._frame_view import crowd
from sgstore.lang.sql import compile_query

NUMBERS = (
    "b.speed",
    "b.x",
    "b.length",
    "b.heading",
    "a.speed",
    "dist(a, b)",
    "gap(b, a)",
    "ttc(a, b)",
    "headway(b, a)",
    "bearing(b, a)",
    "rel_speed(a, b)",
    "3",
    "0",
    "-2.5",
)


def number(rng: random.Random, depth: int) -> str:
    if depth == 0 or rng.random() < 0.4:
        return rng.choice(NUMBERS)
    one, other = number(rng, depth - 1), number(rng, depth - 1)
    unary = ("abs({})", "sqrt({})", "floor({})", "ceil({})", "round({})", "-({})")
    unary += ("sin({})", "cos({})", "tan({})", "log({})", "sign({})", "degrees({})", "radians({})")
    unary += ("exp({} / 9)",)
    both = ("({} + {})", "({} - {})", "({} * {})", "({} / {})", "({} % {})")
    both += ("min({}, {})", "max({}, {})", "pow({}, {})", "atan2({}, {})")
    if rng.random() < 0.1:
        return f"CASE WHEN {condition(rng, depth - 1)} THEN {one} ELSE {other} END"
    if rng.random() < 0.4:
        return rng.choice(unary).format(one)
    return rng.choice(both).format(one, other)


def condition(rng: random.Random, depth: int) -> str:
    if depth == 0 or rng.random() < 0.3:
        if rng.random() < 0.2:
            return f"{number(rng, 1)} IS {rng.choice(('', 'NOT '))}NULL"
        if rng.random() < 0.1:
            return "b.is_static"
        word = rng.choice(("<", "<=", ">", ">=", "=", "<>"))
        return f"{number(rng, 2)} {word} {number(rng, 2)}"
    one, other = condition(rng, depth - 1), condition(rng, depth - 1)
    words = ("(NOT {})", "({} AND {})", "({} OR {})", "({} XOR {})", "({} IMPLIES {})")
    words += ("coalesce({}, {})", "coalesce({}, FALSE)")
    return rng.choice(words).format(one, other)


def test_random_conditions_agree_in_columns_and_singly() -> None:
    rng = random.Random(4)
    views = [view_of(f) for n in range(3) for f in random_world(n, frames=4, static=n == 1).frames]
    catalog = random_world(0, frames=4).catalog
    asked = true = 0
    for _ in range(200):
        text = condition(rng, 2)
        scope = compile_query(f"MATCH (a:Car), (b:%) WHERE {text}", catalog).bound.scope
        for part in scope.where:
            at_once, alone = crowd_test(part, "b"), expression(part, injective=True)
            if at_once is None:
                continue
            for view in views:
                among = crowd(view, scope.nodes["b"].kinds)
                for a in crowd(view, scope.nodes["a"].kinds).nodes[:2]:
                    told = [alone(Binding(view, {"a": a, "b": b})) is True for b in among.nodes]
                    found = at_once(Binding(view, {"a": a}), among)
                    assert found.tolist() == told, (text, part)
                    asked += len(told)
                    true += sum(told)

    assert asked > 10_000
    assert 0.1 < true / asked < 0.9


@pytest.mark.parametrize(
    "text",
    [
        "b.kind = 'car'",
        "same_lane(a, b)",
        "EXISTS {(b)-[:near]->(a)}",
        "lane_dist(a, b) < 5",
        "b.id = 3",
    ],
)
def test_non_numeric_condition_is_evaluated_node_by_node(text: str) -> None:
    catalog = random_world(0, frames=4).catalog
    scope = compile_query(f"MATCH (a:Car), (b:Car) WHERE {text}", catalog).bound.scope

    assert [part for part in scope.where if crowd_test(part, "b") is not None] == []


def test_columns_without_entities_are_empty() -> None:
    (view, *_) = [view_of(f) for f in random_world(0, frames=4).frames]
    catalog = random_world(0, frames=4).catalog
    scope = compile_query("MATCH (a:Ego), (b:Train) WHERE dist(a, b) < 5", catalog).bound.scope
    test = crowd_test(scope.where[0], "b")

    assert test is not None
    found = test(Binding(view, {"a": 0}), crowd(view, scope.nodes["b"].kinds))
    assert np.array_equal(found, np.zeros(0, np.bool_))
