"""Each attribute of nodes, frames and traces is the same in SQL and in memory."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from thorough import LONG, some

from sgstore.lang.bind._precision import Precision, precision_of
from sgstore.lang.catalog import (
    EDGE_ATTRIBUTES,
    ENV_ATTRIBUTES,
    FRAME_ATTRIBUTES,
    NODE_ATTRIBUTES,
    TRACE_ATTRIBUTES,
    Attribute,
    DisplayUnit,
    Type,
)
from sgstore.lang.ir import FrameAttribute, NodeAttribute, TraceAttribute
from sgstore.lang.memory import Binding
from sgstore.lang.memory._evaluate import evaluator
from sgstore.lang.sql import compile_query
from sgstore.model.pair_numbers import PAIR_FUNCTIONS
from sgstore.model.vocabulary import MAP_KINDS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sgstore.lang.memory import FrameView
    from sgstore.query import Store

    Found = Callable[[str], Sequence[tuple[Any, ...]]]

pytestmark = pytest.mark.seconds(20)

SEQ = 300


@pytest.fixture(scope="module")
def store(open_town: Store) -> Store:
    return open_town


@pytest.fixture(scope="module")
def found(store: Store) -> Found:
    """Rows of a query; what several tests ask is asked once."""

    @cache
    def rows(query: str) -> Sequence[tuple[Any, ...]]:
        return store.find(query).rows()

    return rows


@pytest.fixture(scope="module")
def view(store: Store) -> FrameView:
    told = " AND ".join(f"env.{name} IS NULL" for name in ENV_ATTRIBUTES)
    query = compile_query(f"MATCH (e:Ego) WHERE {told}", store.catalog()).bound
    return store._view(store.file.frame(f"town#{SEQ}"), query)


def in_memory(expression: Any, view: FrameView) -> Callable[[int], Any]:
    """The value of an expression of a node in memory."""
    value = evaluator(expression, lambda block: pytest.fail(str(block)))
    return lambda node: value(Binding(view, {"n": node}))


def same(found: Any, expected: Any) -> bool:
    if isinstance(found, float) and isinstance(expected, float | int):
        return math.isclose(found, expected, rel_tol=1e-6, abs_tol=1e-12)
    return found == expected


@pytest.mark.parametrize("attribute", NODE_ATTRIBUTES.values(), ids=lambda one: one.name)
def test_attribute_of_nodes(attribute: Attribute, found: Found, view: FrameView) -> None:
    here = in_memory(NodeAttribute("n", attribute, attribute.type), view)

    rows = found(plainly(f"n.{attribute.name}", WHOLE))

    assert {row[1] for row in rows} == set(view.nodes)
    for _, node, value in rows:
        assert same(value, here(node)), view.nodes[node]


@pytest.mark.parametrize("function", PAIR_FUNCTIONS)
def test_pair_number(function: str, store: Store, view: FrameView) -> None:
    query = f"MATCH (e:Ego), (n) WHERE frame.seq = {SEQ} RETURN n.id, {function}(e, n), {function}(n, e)"
    (ego,) = [node for node, about in view.nodes.items() if about["is_ego"]]

    rows = store.find(query).rows()

    assert len(rows) > 50
    for node, there, back in rows:
        assert same(there, view.pair(function, ego, node)), view.nodes[node]
        assert same(back, view.pair(function, node, ego)), view.nodes[node]
    known = {view.nodes[node]["kind"] for node, there, _ in rows if there is not None}
    assert not known & set(MAP_KINDS)


def test_pair_numbers_without_labels_are_of_entities(store: Store) -> None:
    plain = store.find("MATCH (a), (b) WHERE dist(a, b) < 10 RETURN FRAMES")
    labelled = store.find("MATCH (a:Entity), (b:Entity) WHERE dist(a, b) < 10 RETURN FRAMES")

    assert plain.count() == labelled.count() > 100
    assert store.find("MATCH (a) WHERE NOT dist(ego, a) >= 10 OR a.id = ego.id").count() > 100


@pytest.mark.parametrize(
    "attribute", [*FRAME_ATTRIBUTES.values(), *ENV_ATTRIBUTES.values()], ids=lambda one: one.name
)
def test_attribute_of_frames(attribute: Attribute, store: Store, view: FrameView) -> None:
    name = (
        attribute.name
        if attribute.unit in {DisplayUnit.weather, DisplayUnit.clock}
        else f"frame.{attribute.name}"
    )
    ((value,),) = store.find(f"MATCH (e:Ego) WHERE frame.seq = {SEQ} RETURN {name} AS value").rows()

    assert same(value, in_memory(FrameAttribute(attribute, attribute.type), view)(0))


@pytest.mark.parametrize("attribute", TRACE_ATTRIBUTES.values(), ids=lambda one: one.name)
def test_attribute_of_traces(attribute: Attribute, store: Store, view: FrameView) -> None:
    query = f"MATCH (e:Ego) WHERE frame.seq = {SEQ} RETURN trace.{attribute.name} AS value"
    ((value,),) = store.find(query).rows()

    assert same(value, in_memory(TraceAttribute(attribute, attribute.type), view)(0))


# Every attribute in every form that an expression can have. What each form says is worked out in Python from
# the plain values, so that an operand which binds wrongly in the SQL is seen, not only one that is refused.

WHOLE = "MATCH (n) WHERE frame.seq = 300"
OF_EDGE = {
    "gap": "MATCH (m)-[r:follows]->(n) WHERE frame.seq % 50 = 0",
    None: "MATCH (n)-[r:isIn]->(m:Lane) WHERE frame.seq % 50 = 0",
}


def plainly(name: str, pattern: str) -> str:
    """A query for the values of an attribute, with ids of the frame and of nodes before them."""
    keys = "frame.id AS frame, n.id AS n" + (", m.id AS m" if "(m" in pattern else "")
    return f"{pattern} RETURN {keys}, {name} AS value"


def asked_of() -> list[Any]:
    """Each attribute as it is written, with a pattern that binds what it belongs to."""
    found = [(f"n.{one.name}", one, WHOLE) for one in NODE_ATTRIBUTES.values()]
    found += [
        (f"r.{one.name}", one, OF_EDGE.get(one.name, OF_EDGE[None]))
        for one in EDGE_ATTRIBUTES.values()
    ]
    found += [(f"frame.{one.name}", one, WHOLE) for one in FRAME_ATTRIBUTES.values()]
    found += [(one.name, one, WHOLE) for one in ENV_ATTRIBUTES.values()]
    found += [(f"trace.{one.name}", one, WHOLE) for one in TRACE_ATTRIBUTES.values()]
    return [pytest.param(*one, id=one[0]) for one in found]


def written(value: Any) -> str:
    """A value as a constant of the language."""
    if isinstance(value, bool):
        return str(value).upper()
    return f"'{value}'" if isinstance(value, str) else repr(value)


def forms(name: str, some: Any, kind: Type) -> dict[str, Any]:
    """Conditions on an attribute, with what each says of a value (``None``: unknown)."""
    one = written(some)

    def known(test: Any) -> Any:
        return lambda value: None if value is None else test(value)

    same_as, differs = known(lambda v: v == some), known(lambda v: v != some)
    found: dict[str, Any] = {
        f"{name} = {one}": same_as,
        f"{one} = {name}": same_as,
        f"{name} <> {one}": differs,
        f"NOT {name} = {one}": differs,
        f"NOT ({name} <> {one})": same_as,
        f"{name} IN [{one}]": same_as,
        f"{name} NOT IN [{one}]": differs,
        f"{name} = {name}": known(lambda _: True),
        f"{name} <> {name}": known(lambda _: False),
        f"{name} IS NULL": lambda v: v is None,
        f"{name} IS NOT NULL": lambda v: v is not None,
        f"NOT {name} IS NULL": lambda v: v is not None,
        f"known({name}) = TRUE": lambda v: v is not None,
        f"coalesce({name}, {one}) = {one}": lambda v: v is None or v == some,
        f"({name} = {one}) = ({name} IS NULL)": known(lambda v: v != some),
        f"({name} = {one}) <> TRUE": differs,
        f"{name} = {one} XOR {name} IS NULL": known(lambda v: v == some),
        f"{name} = {one} IMPLIES {name} IS NULL": lambda v: True if v is None else v != some,
        f"({name} = {one}) IN [TRUE]": same_as,
    }
    if kind is Type.boolean:
        found |= {
            name: known(lambda v: v),
            f"NOT {name}": known(lambda v: not v),
            f"{name} = FALSE": known(lambda v: not v),
            f"{name} <> FALSE": known(lambda v: v),
            f"{name} = ({name} = {one})": known(lambda v: v == (v == some)),
            f"{name} XOR NOT {name}": known(lambda _: True),
            f"{name} OR NOT {name}": known(lambda _: True),
        }
    if kind is Type.number:
        found |= {
            f"{name} - {one} = 0": same_as,
            f"-{name} = -({one})": same_as,
            f"{name} < {one} OR {name} > {one}": differs,
            f"abs({name}) = abs({one})": known(lambda v: abs(v) == abs(some)),
        }
    return found


def in_store(value: Any, attribute: Attribute) -> Any:
    """A number of 32 bits as the store keeps it: results print its shortest text."""
    of_graphs = attribute in {*NODE_ATTRIBUTES.values(), *EDGE_ATTRIBUTES.values()}
    is_kept = of_graphs and attribute.unit is not DisplayUnit.degrees
    is_kept &= precision_of(NodeAttribute("n", attribute, attribute.type)) is Precision.float32
    return float(np.float32(value)) if is_kept and value is not None else value


def some_of(values: list[Any], attribute: Attribute) -> Any:
    """A value that occurs; if nothing of the sample has one, one that could."""
    known = [value for value in values if value is not None]
    could = {Type.number: 1.5, Type.text: "none", Type.boolean: True}[attribute.type]
    if attribute.name == "env.temperature":
        could = 290.5  # K
    return known[-1] if known else attribute.values[0] if attribute.values else could


@pytest.mark.parametrize(("name", "attribute", "pattern"), asked_of())
def test_attribute_in_every_form(
    name: str, attribute: Attribute, pattern: str, store: Store, found: Found
) -> None:
    asking = plainly(name, pattern)
    keys = asking.split(" RETURN ")[1].removesuffix(f", {name} AS value")
    plain = found(asking)
    values = [in_store(row[-1], attribute) for row in plain]
    some = some_of(values, attribute)
    asked = forms(name, some, attribute.type)
    wanted = [tuple(test(value) for test in asked.values()) for value in values]
    columns = ", ".join(f"{one} AS c{number}" for number, one in enumerate(asked))

    rows = store.find(f"{pattern} RETURN {keys}, {columns}").rows()

    width = len(plain[0]) - 1
    assert [row[:width] for row in rows] == [row[:-1] for row in plain]
    assert [row[width:] for row in rows] == wanted
    # As conditions, a row being kept where it is true: of each attribute some, of each form some attributes.
    for number, condition in enumerate(asked):
        if (number + len(name)) % (6 if LONG else 13):
            continue
        kept = [row[:-1] for row, told in zip(plain, wanted, strict=True) if told[number] is True]
        rows = store.find(f"{pattern} AND ({condition}) RETURN {keys}").rows()
        assert rows == kept, condition


@pytest.mark.parametrize(("name", "attribute", "pattern"), some(asked_of(), 4))
def test_attribute_in_returned_values(
    name: str, attribute: Attribute, pattern: str, store: Store, found: Found
) -> None:
    values = [row[-1] for row in found(plainly(name, pattern))]
    known = sorted(value for value in values if value is not None)
    ordered = known + [None] * (len(values) - len(known))

    def column(text: str) -> list[Any]:
        return [row[0] for row in store.find(f"{pattern} RETURN {text}").rows()]

    assert column(f"{name} AS value, n.id AS n ORDER BY {name}") == ordered
    assert column(f"{name} AS value, n.id AS n ORDER BY value DESC")[: len(known)] == known[::-1]
    assert set(column(f"DISTINCT {name} AS value")) == set(values)
    assert len(column(f"n.id AS n, {name} AS value SAMPLE 1 PER {name}")) == len(set(values))
    counts = [f"COUNT({name})", f"COUNT(DISTINCT {name})"]
    wanted: list[Any] = [len(known), len(set(known))]
    if attribute.type is not Type.boolean:
        counts += [f"MIN({name})", f"MAX({name})"]
        wanted += [min(known, default=None), max(known, default=None)]
    if attribute.type is Type.number:
        counts.append(f"SUM({name})")
        wanted.append(sum(in_store(one, attribute) for one in known))
    (row,) = store.find(f"{pattern} RETURN {', '.join(counts)}").rows()
    assert all(map(same, row, wanted)), (row, wanted)
    grouped = store.find(f"{pattern} RETURN {name} AS value, COUNT(*) AS many").rows()
    assert dict(grouped) == {value: values.count(value) for value in set(values)}


@pytest.mark.parametrize(
    ("name", "attribute", "pattern"), [one for one in asked_of() if one.id[:2] in {"n.", "r."}]
)
def test_attribute_as_property(
    name: str, attribute: Attribute, pattern: str, store: Store, found: Found
) -> None:
    plain = [(n, frame, value) for frame, n, *_, value in found(plainly(name, pattern))]
    tried = sorted({row[-1] for row in plain if row[-1] is not None})[:2]
    for value in tried or [some_of([], attribute)]:
        braces = f" {{{attribute.name}: {written(value)}}}"
        head, tail = pattern.split("n)" if name[0] == "n" else "]", 1)
        braced = f"{head}n{braces}){tail}" if name[0] == "n" else f"{head}{braces}]{tail}"

        rows = store.find(f"{braced} RETURN n.id AS n, frame.id AS frame").rows()

        assert rows == [row[:-1] for row in plain if row[-1] == value]


OF_CARS = [one for one in NODE_ATTRIBUTES.values() if "car" in one.kinds]


@pytest.mark.parametrize("first", some(range(0, len(OF_CARS), 8), 3))
def test_attributes_in_checks(first: int, store: Store) -> None:
    attributes = OF_CARS[first : first + 8]
    told = ", ".join(f"e.{one.name} AS v{n}" for n, one in enumerate(attributes))
    rows = store.find(f"MATCH (e:Ego) RETURN frame.seq, {told}").rows()
    asked: list[tuple[str, Any, list[Any]]] = []
    for n, attribute in enumerate(attributes, start=1):
        values = [row[n] for row in rows]
        name, some = f"ego.{attribute.name}", some_of(values, attribute)
        made = list(forms(name, some, attribute.type).items())[:10:3]
        braces = f"{{{attribute.name}: {written(some)}}}"
        made.append((f"EXISTS {{(n:Ego {braces})}}", lambda v, some=some: v == some))
        asked += [(condition, test, values) for condition, test in made]
    text = ";\n".join(f"CHECK c{n}: ALWAYS ({one})" for n, (one, *_) in enumerate(asked))

    verdicts = list(store.check(text))

    for verdict, (condition, test, values) in zip(verdicts, asked, strict=True):
        # Under an operator of time what is unknown is false, part by part.
        if all(value is not None for value in values):
            holds = all(test(value) for value in values)
            assert verdict.verdict == ("true" if holds else "false"), condition
