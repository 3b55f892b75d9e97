"""SGL in the query language means what set algebra over the graph says."""

from __future__ import annotations

import operator
import random
from typing import TYPE_CHECKING, Any

import pytest

from sgstore.apps.cli import run
from sgstore.errors import QueryError
from sgstore.lang.contrib.sgsm import translated
from sgstore.lang.syntax import parse

if TYPE_CHECKING:
    from pathlib import Path

    import networkx as nx

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(6)

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
          "below": P.lt(P.size(near), 0), "at_most": P.le(P.size(near), 0), "equal": P.eq(P.size(near), 0),
          "not_equal": P.ne(P.size(near), 0), "at_least": P.ge(P.size(near), 0), "above": P.gt(P.size(near), 0),
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
            "below": False,
            "at_most": not near,
            "equal": not near,
            "not_equal": bool(near),
            "at_least": True,
            "above": bool(near),
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
    assert len(parse(text)) == 19


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
        ("x = P.gt(P.size(P.filterByAttr('G', 'name', 'spaceship')), 0)", "no name matches"),
        (
            "x = P.gt(P.size(P.filterByAttr('G', 'speed', lambda x: exit())), 0)",
            "expected a text, or lambda",
        ),
        ("x = x\ny = P.gt(P.size(x), 0)", "defined by itself"),
        ("for i in range(3): pass", "expected an assignment"),
        ("Property('p', 'G(q', [('q', P.gt(1, 0))])", r"expected '\\)'"),
        ("Property('p', 'G(r)', [('q', P.gt(1, 0))])", "unknown proposition 'r'"),
        ("Property('p')", "expected Property"),
        ("def", "invalid Python"),
        ("x = " + "(" * 5000, "invalid Python"),
    ],
)
def test_what_is_not_sgl_is_refused_with_its_place(text: str, reason: str) -> None:
    with pytest.raises(QueryError, match=reason.replace("\\\\", "\\")):
        translated(text)


def test_what_stands_in_one_another_without_end_is_refused() -> None:
    chain = "\n".join(f'a{i + 1} = P.relSet(a{i}, "near")' for i in range(2000))
    doubled = "\n".join(f"a{i + 1} = P.union(a{i}, a{i})" for i in range(40))
    asked = "x = P.gt(P.size(a{}), 0)"

    with pytest.raises(QueryError, match="the expressions are nested too deeply"):
        translated(f'a0 = "Ego"\n{chain}\n{asked.format(2000)}')
    with pytest.raises(QueryError, match="more than 100000 calls"):
        translated(f'a0 = "Ego"\n{doubled}\n{asked.format(40)}')
    with pytest.raises(QueryError, match="the expressions are nested too deeply"):
        translated(f"Property('p', '{'(' * 20000}q', [('q', P.gt(1, 0))])")


@pytest.mark.parametrize("text", ["", "import os\nos.system('ls')", "# nothing"])
def test_a_text_without_properties_is_refused(text: str) -> None:
    with pytest.raises(QueryError, match="neither a property nor"):
        translated(text)


def test_what_is_no_python_is_shown_where_it_is_not() -> None:
    with pytest.raises(QueryError) as error:
        translated("x = 1\ny = (2 3)\n")

    assert error.value.as_dict()["line"] == 2
    assert "  y = (2 3)" in str(error.value)


# What is hurt: a translation that the language can read, or a refusal that says where; nothing else

FUNCTIONS = [
    *("gt", "lt", "ge", "le", "eq", "ne", "logic_or", "logic_and", "logic_implies", "logic_xor"),
    *("logic_not", "size", "relSet", "relSetR", "filterByAttr", "intersection", "union"),
    *("difference", "symmetric_difference", "unheard_of", ""),
]
LEAVES = [
    *('"Ego"', '"G"', "Ego", "lanes", '"isIn"', '"near"', '"no_relation"', '"incoming"', '"name"'),
    *('"carla_speed"', '"light_state"', '"Red"', '"traffic_light*"', '"["', '""', "0", "1", "-1"),
    *("2.5", "True", "None", "1e999", "10**400", "0x" + "f" * 5000, "1j", "...", 'b"x"', "*lanes"),
    *(
        "lambda x: x > 4",
        "lambda: 1",
        "lambda x, y: y < 2",
        "lambda x: 1 < x < 2",
        "lambda x: x in x",
    ),
    *("[]", "()", "{}", "{**lanes}", 'f"{lanes}"', "lanes.x", "lanes[0]", "itself", "not lanes"),
]


def random_value(rng: random.Random, depth: int) -> str:
    """A value that SGL may have, or may not."""
    if depth == 0 or rng.random() < 0.2:
        return rng.choice(LEAVES)
    inner = [random_value(rng, depth - 1) for _ in range(rng.choice((0, 1, 2, 2, 2, 3, 3, 4)))]
    name = rng.choice(FUNCTIONS)
    if rng.random() < 0.2:
        return f"partial({', '.join([f'P.{name}' if name else 'P', *inner])})"
    if rng.random() < 0.1 and inner:
        inner[-1] = rng.choice(("edge=", "x=", "**")) + inner[-1]
    return f"P.{name}({', '.join(inner)})" if name else f"P({', '.join(inner)})"


def random_properties(rng: random.Random) -> str:
    """Properties with whatever in them; half of them are right but for what is hurt."""
    formulas = [
        "G(~a)",
        "a",
        "$[3][a]",
        "$[0][a]",
        f"$[{'9' * 5000}][a]",
        "G(",
        "",
        "a U b R a <-> a",
    ]
    formulas += [
        "X",
        "~" * 2000 + "a",
        "(" * 500 + "a" + ")" * 500,
        "ä & a",
        "$[²][a]",
        "a b",
        "tru",
    ]
    names = ['"Phi"', '""', '"1"', '"ALWAYS"', '"a b"', "1", "None", '"ü"']
    right = f"P.gt(P.size(P.relSet({rng.choice(LEAVES[:4])}, {rng.choice(LEAVES[4:7])})), 0)"
    value = rng.choice((right, random_value(rng, 3), random_value(rng, 4)))
    key = rng.choice(('"a"', '"a"', '"a"', '"MATCH"', '"é"', '"1a"', '""', "1"))
    pairs = rng.choice((f"[({key}, {value})]", f"{{{key}: {value}}}", f"[{value}]", value, "[]"))
    one = f"Property({rng.choice(names)}, '{rng.choice(formulas)}', {pairs})"
    lanes = rng.choice(('P.relSet("Ego", "isIn")', random_value(rng, 2)))
    text = (
        f"lanes = {lanes}\nitself = itself\nagain = {right}\n{rng.choice((one, one, '', value))}\n"
    )
    if rng.random() < 0.3:
        at = rng.randrange(len(text))
        hurt = rng.choice(("", "(", ")", '"', "\x0c", "\u2028", "\r", "\0", "é", "\ud800", "#"))
        text = text[:at] + hurt + text[at + rng.choice((0, 1, 3)) :]
    return text


@pytest.mark.parametrize("seed", range(4))
def test_whatever_is_translated_can_be_read_or_is_refused(seed: int) -> None:
    rng = random.Random(seed)
    read = 0
    for _ in range(400):
        text = random_properties(rng)
        try:
            found = translated(text)
        except QueryError:
            continue
        assert parse(found), text
        read += 1
    assert read > 20


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ("P.gt(1)", "gt takes 2 arguments, found 1"),
        ("P.gt(P.size(P.relSet('Ego')), 0)", "relSet takes 2 or 3 arguments, found 1"),
        ("P.gt(P.size(), 0)", "size takes 1 argument, found 0"),
        ("P.logic_not()", "logic_not takes 1 argument, found 0"),
        ("P.gt(P.size('Ego'), True)", "expected a number"),
        ("P.gt(P.size('Ego'), 1e999)", "the number is too large"),
        ("partial(P.union, 'Ego')", "union takes 2 arguments, found 1"),
    ],
)
def test_a_wrong_number_of_arguments_is_told(value: str, says: str, tmp_path: Path) -> None:
    file = tmp_path / "properties.py"
    file.write_text(
        f"# ein Kommentar: ä\nProperty('p', 'G(a)', [('a', {value})])\n", encoding="utf-8"
    )

    with pytest.raises(QueryError) as raised:
        translated(file.read_text(encoding="utf-8"))

    assert says in str(raised.value)
    assert run(["translate", str(file)]) == 2


def test_a_set_in_a_set_is_refused_and_not_warned_of() -> None:
    red = 'P.filterByAttr("Ego", "light_state", "[[a]")'
    text = f'import SG_Primitives as P\nProperty("a", "G(p)", [("p", P.gt(P.size({red}), 0))])\n'

    with pytest.raises(QueryError, match="a set contains a set"):
        translated(text)
