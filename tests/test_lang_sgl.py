"""SGL in the query language means what set algebra over the graph says."""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any

import pytest

from sgstore.errors import QueryError
from sgstore.lang.parser import parse
from sgstore.lang.sgl import translated

if TYPE_CHECKING:
    import networkx as nx

    from sgstore.query import Store

PROPERTIES = """
from functools import partial
import SG_Primitives as P

lanes = partial(P.relSet, "Ego", "isIn")
roads = P.relSet(lanes, "isIn")
junctions = P.relSet(roads, "isIn")
opposing = partial(P.relSet, lanes, "opposes")
others = P.difference(P.relSetR(lanes, "isIn"), "Ego")
close = P.union(P.relSet(others, "near_coll"), P.relSet(others, "super_near"))
red = P.filterByAttr(P.filterByAttr(P.relSetR(lanes, "controlsTrafficOf"), "name", "traffic_light*"),
                     "light_state", "Red")
near = P.relSet("Ego", "near")
in_opposing = partial(P.gt, P.size(partial(P.intersection, lanes, opposing)), 0)
Property("Phi1", "G(~in_opposing)", [("in_opposing", in_opposing)])
Property("Phi7", "~ $[10][multiple & ~junction]",
         [("multiple", P.gt(P.size(lanes), 1)), ("junction", P.gt(P.size(junctions), 0))])
Property("mine", "G((only & ~is_red) -> X (rightmost U near)) | F fast",
         {"only": P.eq(P.size(P.difference(roads, P.relSetR(junctions, "isIn"))), 0),
          "is_red": P.gt(P.size(red), 0),
          "rightmost": P.eq(P.size(P.relSetR(lanes, "toRightOf")), 0),
          "near": P.ge(P.size(close), 2),
          "fast": P.eq(P.size(P.filterByAttr("Ego", "carla_speed", lambda x: x > 4)), 1),
          "some": P.gt(P.size(P.symmetric_difference(near, P.relSetR("Ego", "inDFrontOf"))), 1),
          "nobody": P.logic_not(P.gt(P.size(P.filterByAttr(near, "base_class", "person")), 0))})
"""


class Algebra:
    """SGL as sets of nodes of one graph."""

    def __init__(self, graph: nx.MultiDiGraph) -> None:
        self.graph = graph
        self.ego = {n for n, d in graph.nodes(data=True) if d["is_ego"]}

    def along(self, nodes: set[Any], relation: str) -> set[Any]:
        return {b for a, b, r in self.graph.edges(keys=True) if r == relation and a in nodes}

    def back(self, nodes: set[Any], relation: str) -> set[Any]:
        return {a for a, b, r in self.graph.edges(keys=True) if r == relation and b in nodes}

    def truth(self) -> dict[str, bool]:
        nodes = self.graph.nodes
        lanes = self.along(self.ego, "isIn")
        roads = self.along(lanes, "isIn")
        junctions = self.along(roads, "isIn")
        others = self.back(lanes, "isIn") - self.ego
        close = self.along(others, "near_coll") | self.along(others, "super_near")
        lights = self.back(lanes, "controlsTrafficOf")
        near = self.along(self.ego, "near")
        return {
            "in_opposing": len(lanes & self.along(lanes, "opposes")) > 0,
            "multiple": len(lanes) > 1,
            "junction": len(junctions) > 0,
            "only": len(roads - self.back(junctions, "isIn")) == 0,
            "is_red": any(nodes[n].get("light_state") == "red" for n in lights),
            "rightmost": len(self.back(lanes, "toRightOf")) == 0,
            "near": len(close) >= 2,
            "fast": sum(nodes[n]["speed"] > 4 for n in self.ego) == 1,
            "some": len(operator.xor(near, self.back(self.ego, "inDFrontOf"))) > 1,
            "nobody": not any(nodes[n]["kind"] == "person" for n in near),
        }


@pytest.fixture(scope="module")
def store(open_town: Store) -> Store:
    return open_town


def test_propositions_hold_where_set_algebra_says(store: Store) -> None:
    definitions = translated(PROPERTIES).partition("USING")[0]
    frames = [frame for frame in store.find("MATCH (e:Ego)").frames() if frame.seq % 30 == 0]
    wanted = {frame.seq: Algebra(store.graph(frame)).truth() for frame in frames}
    varied = 0

    for name in next(iter(wanted.values())):
        query = f"{definitions} USING NODES any MATCH (e:Ego) WHERE {name}() RETURN FRAMES"
        found = {frame.seq for frame in store.find(query).frames() if frame.seq % 30 == 0}
        assert found == {seq for seq, truth in wanted.items() if truth[name]}, name
        varied += 0 < len(found) < len(wanted)

    assert varied >= 6


def test_formulas_are_translated_word_by_word() -> None:
    text = translated(PROPERTIES)

    assert "CHECK Phi1: ALWAYS ((NOT (in_opposing())));" in text
    assert "EVENTUALLY (ALWAYS[0frames, 9frames] ((multiple() AND NOT (junction())))" in text
    assert "NEXT (((rightmost() UNTIL near()))" in text
    assert len(parse(text)) == 13


def test_carla_steers_to_the_other_side() -> None:
    text = translated(
        'x = P.eq(P.size(P.filterByAttr("Ego", "ego_control_carla_steer", lambda s: s < 0)), 1)'
    )

    assert "-n1.steer < 0" in text


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("x = P.gt(P.size(P.relSet('Ego', 'isInn')), 0)", "unknown relation 'isInn'"),
        (
            "x = P.gt(P.size(P.relation('Ego', 'isIn')), 0)",
            "expected a set of nodes, found relation",
        ),
        ("x = P.gt(P.size(P.filterByAttr('G', 'colour', 'red')), 0)", "unknown attribute 'colour'"),
        ("x = P.gt(P.size(P.filterByAttr('G', 'name', 'spaceship')), 0)", "nothing is called like"),
        (
            "x = P.gt(P.size(P.filterByAttr('G', 'speed', lambda x: exit())), 0)",
            "expected a text, or lambda",
        ),
        ("x = x\ny = P.gt(P.size(x), 0)", "defined by itself"),
        ("for i in range(3): pass", "expected an assignment"),
        ("Property('p', 'G(q', [('q', P.gt(1, 0))])", r"expected '\\)'"),
        ("Property('p', 'G(r)', [('q', P.gt(1, 0))])", "unknown proposition 'r'"),
        ("Property('p')", "expected Property"),
        ("def", "this is no Python"),
        ("x = " + "(" * 5000, "this is no Python"),
    ],
)
def test_what_is_not_sgl_is_refused_with_its_place(text: str, reason: str) -> None:
    with pytest.raises(QueryError, match=reason.replace("\\\\", "\\")):
        translated(text)


def test_what_stands_in_one_another_without_end_is_refused() -> None:
    chain = "\n".join(f'a{i + 1} = P.relSet(a{i}, "near")' for i in range(2000))
    doubled = "\n".join(f"a{i + 1} = P.union(a{i}, a{i})" for i in range(40))
    asked = "x = P.gt(P.size(a{}), 0)"

    with pytest.raises(QueryError, match="too much stands in one another"):
        translated(f'a0 = "Ego"\n{chain}\n{asked.format(2000)}')
    with pytest.raises(QueryError, match="more than 100000 calls"):
        translated(f'a0 = "Ego"\n{doubled}\n{asked.format(40)}')
    with pytest.raises(QueryError, match="too much stands in one another"):
        translated(f"Property('p', '{'(' * 20000}q', [('q', P.gt(1, 0))])")


@pytest.mark.parametrize("text", ["", "import os\nos.system('ls')", "# nothing"])
def test_a_text_without_properties_is_refused(text: str) -> None:
    with pytest.raises(QueryError, match="no property"):
        translated(text)


def test_what_is_no_python_is_shown_where_it_is_not() -> None:
    with pytest.raises(QueryError) as error:
        translated("x = 1\ny = (2 3)\n")

    assert error.value.as_dict()["line"] == 2
    assert "  y = (2 3)" in str(error.value)
