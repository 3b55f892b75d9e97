"""Each attribute of nodes, frames and traces is the same in SQL and in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from sgstore.lang.bound import FrameAttribute, NodeAttribute, TraceAttribute
from sgstore.lang.catalog import (
    ENV_ATTRIBUTES,
    FRAME_ATTRIBUTES,
    NODE_ATTRIBUTES,
    TRACE_ATTRIBUTES,
    Attribute,
    Unit,
)
from sgstore.lang.evaluation import Binding, evaluator
from sgstore.lang.functions import PAIR_FUNCTIONS
from sgstore.vocabulary import MAP_KINDS

if TYPE_CHECKING:
    from sgstore.lang.evaluation import FrameView
    from sgstore.query import Store

SEQ = 300


@pytest.fixture(scope="module")
def store(open_town: Store) -> Store:
    return open_town


@pytest.fixture(scope="module")
def view(store: Store) -> FrameView:
    asked = [FrameAttribute(one, one.type) for one in ENV_ATTRIBUTES.values()]
    return store._view(store.file.frame(f"town#{SEQ}"), asked)


def in_memory(expression: Any, view: FrameView, node: int = 0) -> Any:
    return evaluator(expression, lambda block: pytest.fail(str(block)))(Binding(view, {"n": node}))


def same(found: Any, expected: Any) -> bool:
    if isinstance(found, float) and isinstance(expected, float | int):
        return found == pytest.approx(expected)
    return found == expected


@pytest.mark.parametrize("attribute", NODE_ATTRIBUTES.values(), ids=lambda one: one.name)
def test_an_attribute_of_nodes(attribute: Attribute, store: Store, view: FrameView) -> None:
    query = f"MATCH (n) WHERE frame.seq = {SEQ} RETURN n.id AS id, n.{attribute.name} AS value"
    leaf = NodeAttribute("n", attribute, attribute.type)

    rows = store.find(query).rows()

    assert {row[0] for row in rows} == set(view.nodes)
    for node, value in rows:
        assert same(value, in_memory(leaf, view, node)), view.nodes[node]


@pytest.mark.parametrize("function", PAIR_FUNCTIONS)
def test_a_number_of_pairs(function: str, store: Store, view: FrameView) -> None:
    query = f"MATCH (e:Ego), (n) WHERE frame.seq = {SEQ} RETURN n.id, {function}(e, n), {function}(n, e)"
    (ego,) = [node for node, about in view.nodes.items() if about["is_ego"]]

    rows = store.find(query).rows()

    assert len(rows) > 50
    for node, there, back in rows:
        assert same(there, view.pair(function, ego, node)), view.nodes[node]
        assert same(back, view.pair(function, node, ego)), view.nodes[node]
    known = {view.nodes[node]["kind"] for node, there, _ in rows if there is not None}
    assert not known & set(MAP_KINDS)


def test_without_labels_numbers_of_pairs_are_of_entities(store: Store) -> None:
    plain = store.find("MATCH (a), (b) WHERE dist(a, b) < 10 RETURN FRAMES")
    labelled = store.find("MATCH (a:Entity), (b:Entity) WHERE dist(a, b) < 10 RETURN FRAMES")

    assert plain.count() == labelled.count() > 100
    assert store.find("MATCH (a) WHERE NOT dist(ego, a) >= 10 OR a.id = ego.id").count() > 100


@pytest.mark.parametrize(
    "attribute", [*FRAME_ATTRIBUTES.values(), *ENV_ATTRIBUTES.values()], ids=lambda one: one.name
)
def test_an_attribute_of_frames(attribute: Attribute, store: Store, view: FrameView) -> None:
    name = (
        attribute.name
        if attribute.unit in {Unit.weather, Unit.clock}
        else f"frame.{attribute.name}"
    )
    ((value,),) = store.find(f"MATCH (e:Ego) WHERE frame.seq = {SEQ} RETURN {name} AS value").rows()

    assert same(value, in_memory(FrameAttribute(attribute, attribute.type), view))


@pytest.mark.parametrize("attribute", TRACE_ATTRIBUTES.values(), ids=lambda one: one.name)
def test_an_attribute_of_traces(attribute: Attribute, store: Store, view: FrameView) -> None:
    query = f"MATCH (e:Ego) WHERE frame.seq = {SEQ} RETURN trace.{attribute.name} AS value"
    ((value,),) = store.find(query).rows()

    assert same(value, in_memory(TraceAttribute(attribute, attribute.type), view))
