"""Exhaustive search over networkx graphs, as plain as can be: what the compiler's SQL is held against.

``python -m oracle 10000`` (in this folder) tries that many random patterns on random worlds; ``python -m oracle
100000 0 2`` so many from the first on, in two processes.

A pattern is searched by assigning every node of the graph to every node of the pattern, in order; what is cut
off early is only what no edge of the pattern joins. Nothing else is clever here: what a label, an edge or a
condition means is written down once more, from the documentation.
"""

from __future__ import annotations

import cmath
import math
import re
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

from sgstore.lang.syntax import parse
from sgstore.lang.syntax import tree as s
from sgstore.model.vocabulary import SIGNALS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    import networkx as nx
    from oracle_worlds import Frame, World

    from sgstore.lang.sql import SqlStatement

    Compared = Callable[[World], tuple[str, int]]

T = TypeVar("T")
VEHICLES = {"car", "truck", "van", "bus", "motorcycle", "bicycle", "trailer", "train", "vehicle"}
MAP_KINDS = {"lane", "road", "junction", "crosswalk", "offroad", "waypoint"}
GROUPS = {
    "vehicle": VEHICLES,
    "vru": {"person", "bicycle", "motorcycle"},
    "signal": {"trafficlight", "stopsign", "yieldsign", "speedlimit", "sign"},
    "pedestrian": {"person"},
}
Binding = dict[str, Any]


@dataclass
class Search:
    """One frame, and how it is searched."""

    frame: Frame
    graph: nx.MultiDiGraph
    injective: bool
    pairs: dict[int, set[tuple[Any, Any]]] = field(default_factory=dict)

    # Matches

    def matches(
        self, block: s.Block, outside: Binding, apart: tuple[str, ...] = ()
    ) -> Iterator[Binding]:
        """Every assignment of nodes (and named edges) that makes the whole block true.

        ``apart``: names from outside that its nodes differ from, even if it does not speak of them.
        """
        nodes: dict[str, list[s.NodePattern]] = {}
        names: dict[int, str] = {}
        for name, node in named_nodes(block):
            names[id(node)] = name
            nodes.setdefault(name, []).append(node)
        own = [name for name in nodes if name not in outside]
        spoken_of = {n for n in free_names(block) if n in outside and outside[n] in self.graph}
        spoken_of = (spoken_of - {"ego"} if labels_ego(block) else spoken_of) | {*apart}
        choices = [[n for n in self.graph.nodes if self.fits(n, nodes[name])] for name in own]
        if not all(self.fits(outside[name], nodes[name]) for name in nodes if name in outside):
            return
        taken = {outside[name] for name in spoken_of} if self.injective else set()
        links = [(edge, names[a], names[b]) for edge, a, b in links_of(block)]
        for binding in self.assigned(own, choices, links, outside, taken):
            yield from self.edges(block, names, binding, 0)

    def assigned(
        self,
        own: list[str],
        choices: list[list[Any]],
        links: list[tuple[s.EdgePattern, str, str]],
        binding: Binding,
        taken: set[Any],
    ) -> Iterator[Binding]:
        """Every way to bind the nodes that are left, as far as edges may join them."""
        if not own:
            yield binding
            return
        name = own[0]
        done = {*binding, name}
        tied = [link for link in links if name in link[1:] and {*link[1:]} <= done]
        for node in choices[0]:
            if node in taken:
                continue
            bound = {**binding, name: node}
            if all((bound[a], bound[b]) in self.joined(edge) for edge, a, b in tied):
                more = {*taken, node} if self.injective else taken
                yield from self.assigned(own[1:], choices[1:], links, bound, more)

    def joined(self, edge: s.EdgePattern) -> set[tuple[Any, Any]] | Everything:
        """The pairs of nodes, left and right, that have an edge of such a relation, if it is a single one."""
        if edge.low is not None:
            return EVERYTHING
        if id(edge) not in self.pairs:
            found = {
                (src, dst)
                for relation, ends in self.frame.by_relation.items()
                if edge.label is None or related(relation, edge.label)
                for src, dst in ends
            }
            back = {(dst, src) for src, dst in found}
            ways = {"right": found, "left": back, "any": found | back}
            self.pairs[id(edge)] = ways[edge.direction]
        return self.pairs[id(edge)]

    def fits(self, node: Any, patterns: list[s.NodePattern]) -> bool:
        return all(
            pattern.label is None or self.labelled(node, pattern.label) for pattern in patterns
        )

    def edges(
        self, block: s.Block, names: dict[int, str], binding: Binding, number: int
    ) -> Iterator[Binding]:
        """Extensions of a binding of all nodes by the edge variables, where all edges exist."""
        links = links_of(block)
        if number == len(links):
            if self.conditions(block, names, binding):
                yield binding
            return
        edge, left, right = links[number]
        a, b = binding[names[left]], binding[names[right]]
        ways = {"right": [(a, b)], "left": [(b, a)], "any": [(a, b), (b, a)]}[edge.direction]
        found = [hit for way in ways for hit in self.linked(edge, *way, binding)]
        if edge.name is None:
            if found:
                yield from self.edges(block, names, binding, number + 1)
        else:
            for relation in sorted({relation for relation, _ in found}):
                attributes = next(a for r, a in found if r == relation)
                bound = binding | {edge.name: Edge(relation, attributes)}
                yield from self.edges(block, names, bound, number + 1)

    def linked(
        self, edge: s.EdgePattern, src: Any, dst: Any, binding: Binding
    ) -> list[tuple[str, dict[str, Any]]]:
        if edge.low is not None and edge.high is not None:
            lengths = range(edge.low, edge.high + 1)
            return [("", {})] if any(self.walks(edge, src, dst, n, [src]) for n in lengths) else []
        hits: list[tuple[str, dict[str, Any]]] = []
        for relation, attributes in self.graph.get_edge_data(src, dst, default={}).items():
            if edge.label is None or related(relation, edge.label):
                inner = binding | {
                    "": Edge(relation, attributes),
                    edge.name or "": Edge(relation, attributes),
                }
                tests = [
                    equal(attributes.get(attribute_name(p.name)), self.value(p.value, inner))
                    for p in edge.properties
                ]
                if edge.where is not None:
                    tests.append(self.value(edge.where, inner))
                if all(test is True for test in tests):
                    hits.append((relation, attributes))
        return hits

    def walks(self, edge: s.EdgePattern, at: Any, dst: Any, length: int, seen: list[Any]) -> bool:
        """Whether ``length`` edges lead from one node to the other; no node twice, if nodes differ."""
        if length == 0:
            return at == dst
        steps = {
            b
            for _, b, r in self.graph.out_edges(at, keys=True)
            if edge.label is None or related(r, edge.label)
        }
        if edge.direction == "any":
            steps |= {
                a
                for a, _, r in self.graph.in_edges(at, keys=True)
                if edge.label is None or related(r, edge.label)
            }
        for step in steps:
            between = length > 1
            if self.injective and between and (step in seen or step == dst):
                continue
            if self.walks(edge, step, dst, length - 1, [*seen, step]):
                return True
        return False

    def conditions(self, block: s.Block, names: dict[int, str], binding: Binding) -> bool:
        for path in block.paths:
            for node in path.nodes:
                at = binding[names[id(node)]]
                for prop in node.properties:
                    if (
                        equal(self.attribute(at, prop.name), self.value(prop.value, binding))
                        is not True
                    ):
                        return False
                if node.where is not None and self.value(node.where, binding) is not True:
                    return False
        return block.where is None or self.value(block.where, binding) is True

    def labelled(self, node: Any, label: s.LabelExpression) -> bool:
        if isinstance(label, s.LabelLogic):
            parts = [self.labelled(node, operand) for operand in label.operands]
            return {"!": not parts[0], "&": all(parts), "|": any(parts)}[label.word]
        name = label.name.replace("_", "").lower()
        kind = self.graph.nodes[node]["kind"].replace("_", "")
        if name == "ego":
            return self.graph.nodes[node]["is_ego"]
        if name == "entity":
            return kind not in MAP_KINDS
        return name == "%" or kind in GROUPS.get(name, {name})

    def value(self, e: s.Expression, binding: Binding) -> Any:  # noqa: C901, PLR0911, PLR0912 - one case each
        """The value of an expression; ``None`` is NULL."""
        match e:
            case s.Constant(value=value):
                return value
            case s.ListOf(items=items):
                return [self.value(item, binding) for item in items]
            case s.Variable(name=name):
                return binding[name]
            case s.AttributeOf(owner=owner, name=name):
                return self.owned(owner.name, name, binding)
            case s.Logic(word=word, operands=operands):
                return logic(word, [self.value(operand, binding) for operand in operands])
            case s.Comparison(word=word, left=left, right=right):
                return compare(word, self.value(left, binding), self.value(right, binding))
            case s.NullTest(operand=operand, negated=negated):
                return (self.value(operand, binding) is None) != negated
            case s.Membership(operand=operand, choices=choices, negated=negated):
                return member(self.value(operand, binding), self.value(choices, binding), negated)
            case s.Arithmetic(first=first, rest=rest):
                result = self.value(first, binding)
                for sign, term in rest:
                    result = arithmetic(sign, result, self.value(term, binding))
                return result
            case s.Negative(operand=operand):
                value = self.value(operand, binding)
                return None if value is None else -value
            case s.Call():
                return self.call(e, binding)
            case s.HappensExpression(kind=kind, arguments=arguments):
                nodes = [self.value(argument, binding) for argument in arguments]
                # Of a table of one's own, it is told who is the first of two.
                turns = (1, -1) if kind in EITHER_WAY else (1,)
                told = [
                    (a, b)
                    for what, *pair in self.frame.events
                    if what == kind
                    for a, b in (pair[::turn] for turn in turns)
                ]
                happened = any([*pair[: len(nodes)]] == nodes for pair in told)
                return happened or (False if kind in self.frame.trace.records else None)
            case s.Case(branches=branches, otherwise=otherwise):
                for branch in branches:
                    if self.value(branch.condition, binding) is True:
                        return self.value(branch.value, binding)
                return None if otherwise is None else self.value(otherwise, binding)
            case s.BlockExpression():
                return self.block(e, binding)
        raise NotImplementedError(e)

    def owned(self, owner: str, name: str, binding: Binding) -> Any:
        if owner == "frame" and owner not in binding:
            start = self.frame.trace.frames[0].time_ns
            frame = self.frame
            return {"seq": frame.seq, "id": frame.frame_id, "t": (frame.time_ns - start) / 1e9}[
                name
            ]
        if owner == "trace" and owner not in binding:
            trace = self.frame.trace
            return {"name": trace.name, "id": trace.trace_id, "map": trace.map_name}[name]
        bound = binding[owner]
        if isinstance(bound, Edge):
            return bound.attributes.get(attribute_name(name))
        return self.attribute(bound, name)

    def attribute(self, node: Any, name: str) -> Any:
        attributes = self.graph.nodes[node]
        return attributes.get("lane_type" if name == "type" else name)

    def call(self, e: s.Call, binding: Binding) -> Any:  # noqa: PLR0911 - a case each
        name = e.name
        if name == "type":
            return binding[e.arguments[0].name].relation  # type: ignore[union-attr]
        values = [self.value(argument, binding) for argument in e.arguments]
        if name == "abs":
            return None if values[0] is None else abs(values[0])
        if name == "coalesce":
            return next((value for value in values if value is not None), None)
        if name == "known":
            return values[0] is not None
        if name in {"min", "max"}:
            return None if None in values else {"min": min, "max": max}[name](values)
        if name in NUMBERS:
            return None if None in values else number_of(name, *values)
        return pair(name, self.graph.nodes[values[0]], self.graph.nodes[values[1]])

    def block(self, e: s.BlockExpression, binding: Binding) -> Any:
        matches = self.matches(e.block, binding)
        if e.word == "EXISTS":
            return next(matches, None) is not None
        found = list(matches)
        if e.word == "COUNT":
            return len(found)
        assert e.value is not None
        values = [v for v in (self.value(e.value, match) for match in found) if v is not None]
        if e.word == "SUM":
            return float(sum(values))
        if not values:
            return None
        return {"MIN": min, "MAX": max, "AVG": lambda v: sum(v) / len(v)}[e.word](values)


EITHER_WAY = {"collision", "lane_invasion", "environment"}
"""Events of which it is not told who is the first of two."""

NUMBERS = {
    "sqrt": cmath.sqrt,
    "sin": lambda a: (cmath.exp(1j * a) - cmath.exp(-1j * a)) / 2j,
    "cos": lambda a: (cmath.exp(1j * a) + cmath.exp(-1j * a)) / 2,
    "tan": cmath.tan,
    "exp": cmath.exp,
    "log": cmath.log,
    "sign": lambda a: a / abs(a) if a else 0,
    "degrees": lambda a: a / math.pi * 180,
    "radians": lambda a: a / 180 * math.pi,
    "atan2": lambda a, b: cmath.phase(complex(b, a)),
    "pow": lambda a, b: complex(a) ** b,
}


def number_of(name: str, *values: float) -> float | None:
    """A function of complex numbers: unknown where it has no value, or none that is real and finite."""
    try:
        found = complex(NUMBERS[name](*values))
    except (OverflowError, ValueError, ZeroDivisionError):
        return None
    real = abs(found.imag) <= 1e-9 * max(abs(found), 1e-300)
    return found.real if real and math.isfinite(found.real) else None


class Everything:
    def __contains__(self, _: object) -> bool:
        return True


EVERYTHING = Everything()


def only_ego(label: s.LabelExpression) -> bool:
    """Whether a label leaves nothing but the ego."""
    if isinstance(label, s.Label):
        return label.name.lower() == "ego"
    parts = [only_ego(operand) for operand in label.operands]
    return {"!": False, "&": any(parts), "|": all(parts)}[label.word]


def named_nodes(block: s.Block) -> list[tuple[str, s.NodePattern]]:
    """The nodes of a block as they are written; each that has no name gets one of its own."""
    nodes = [node for path in block.paths for node in path.nodes]
    return [(node.name or f"#{id(node)}", node) for node in nodes]


def labels_ego(block: s.Block) -> bool:
    """Whether a node of a block has a label that only the ego has: then that is what ``ego`` names."""
    labels = [node.label for name, node in named_nodes(block) if name != "ego"]
    return any(label is not None and only_ego(label) for label in labels)


@dataclass(frozen=True)
class Edge:
    relation: str
    attributes: dict[str, Any]


def attribute_name(name: str) -> str:
    return {"primary": "is_primary", "offset": "lane_offset"}.get(name, name)


def related(relation: str, label: s.LabelExpression) -> bool:
    if isinstance(label, s.LabelLogic):
        parts = [related(relation, operand) for operand in label.operands]
        return {"!": not parts[0], "&": all(parts), "|": any(parts)}[label.word]
    return (
        label.name == "%"
        or label.name.replace("_", "").lower() == relation.replace("_", "").lower()
    )


def remembered(function: Callable[[Any], T]) -> Callable[[Any], T]:
    """What a function tells of a part of a parsed text, worked out once; ``REMEMBERED.clear()`` forgets it."""

    def told(part: Any) -> T:
        key = function.__name__, id(part)
        if key not in REMEMBERED:
            REMEMBERED[key] = part, function(part)
        return REMEMBERED[key][1]

    return told


REMEMBERED: dict[tuple[str, int], tuple[Any, Any]] = {}
"""By function and part: the part, so that it lives on, and what is told of it."""


@remembered
def links_of(block: s.Block) -> list[tuple[s.EdgePattern, int, int]]:
    """The edges of a block, and which nodes they join."""
    return [
        (edge, id(left), id(right))
        for path in block.paths
        for edge, left, right in zip(path.edges, path.nodes, path.nodes[1:], strict=False)
    ]


@remembered
def free_names(block: s.Block | s.MatchClause) -> set[str]:
    """All names that occur in a block, or in blocks in it."""
    found: set[str] = set()

    def visit(part: Any) -> None:
        if isinstance(part, s.Variable):
            found.add(part.name)
        if isinstance(part, s.NodePattern) and part.name:
            found.add(part.name)
        if isinstance(part, (tuple, list)):
            for item in part:
                visit(item)
        elif hasattr(part, "__dataclass_fields__"):
            for name in part.__dataclass_fields__:
                visit(getattr(part, name))

    visit(block)
    return found


def logic(word: str, values: list[bool | None]) -> bool | None:
    if word == "NOT":
        return None if values[0] is None else not values[0]
    if word == "IMPLIES":
        return logic("OR", [logic("NOT", values[:1]), values[1]])
    if word == "AND":
        return False if False in values else None if None in values else True
    if word == "OR":
        return True if True in values else None if None in values else False
    return None if None in values else sum(bool(v) for v in values) % 2 == 1


def equal(a: Any, b: Any) -> bool | None:
    return compare("=", a, b)


def compare(word: str, a: Any, b: Any) -> bool | None:
    if a is None or b is None:
        return None
    if isinstance(a, str) and isinstance(b, str) and word in {"=", "<>"}:
        a, b = a.lower(), b.lower()
    return {
        "=": lambda: a == b,
        "<>": lambda: a != b,
        "<": lambda: a < b,
        "<=": lambda: a <= b,
        ">": lambda: a > b,
        ">=": lambda: a >= b,
        "STARTS WITH": lambda: a.startswith(b),
        "ENDS WITH": lambda: a.endswith(b),
        "CONTAINS": lambda: b in a,
    }[word]()


def member(value: Any, choices: list[Any], negated: bool) -> bool | None:
    if value is None:
        return None if choices else negated
    folded = [choice.lower() if isinstance(choice, str) else choice for choice in choices]
    return ((value.lower() if isinstance(value, str) else value) in folded) != negated


def arithmetic(sign: str, a: Any, b: Any) -> Any:
    if a is None or b is None or (sign in {"/", "%"} and b == 0):
        return None
    return {
        "+": lambda: a + b,
        "-": lambda: a - b,
        "*": lambda: a * b,
        "/": lambda: a / b,
        "%": lambda: math.fmod(a, b),
    }[sign]()


def pair(name: str, a: dict[str, Any], b: dict[str, Any]) -> float | None:
    """Numbers of a pair that need no more than school geometry; the others have tests of their own."""
    parts = {"lane", "road", "junction", "crosswalk", "off_road"} & {a["kind"], b["kind"]}
    if parts or any(axis not in n for n in (a, b) for axis in "xy") or storeys_apart(a, b):
        return None
    dx, dy = (b[axis] - a[axis] for axis in "xy")
    dz = b["z"] - a["z"] if "z" in a and "z" in b else 0
    if name == "dist":
        return math.sqrt(dx * dx + dy * dy + dz * dz)
    if name == "closing_speed":
        speeds = [0.0 if n.get("is_static") else n.get(v) for v in ("vx", "vy") for n in (a, b)]
        if None in speeds or not (dx or dy):
            return None
        return -(dx * (speeds[1] - speeds[0]) + dy * (speeds[3] - speeds[2])) / math.hypot(dx, dy)
    heading = math.radians(a["heading"])
    if name == "lon":
        return dx * math.cos(heading) + dy * math.sin(heading)
    if name == "lat":
        return dy * math.cos(heading) - dx * math.sin(heading)
    raise NotImplementedError(name)


def storeys_apart(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Whether two are apart in height, as far as it is known; signals are on no storey."""
    if {a["kind"], b["kind"]} & set(SIGNALS) or "z" not in a or "z" not in b:
        return False
    half_a, half_b = (n.get("height", 0) / 2 for n in (a, b))
    higher, away = (
        abs((b["z"] - half_b) - (a["z"] - half_a)),
        math.dist(*((n["x"], n["y"]) for n in (a, b))),
    )
    pitches = [0.0 if n.get("is_static") else n.get("pitch", 0.0) for n in (a, b)]
    tilt = max(abs(math.sin(math.radians(pitch))) for pitch in pitches)
    climb = max(min(0.1 * away, 2.5), min(tilt, 0.25) * away)
    if half_a and half_b:
        return abs(b["z"] - a["z"]) > half_a + half_b + 1e-4 and higher > climb
    return higher > max(2.5, climb)


def assignments(
    match: s.MatchClause, world: World, whole: s.MatchClause | None = None
) -> Iterator[tuple[Search, Binding]]:
    """Every match of a query in every frame of the traces that can answer it; ``ego`` bound if named.

    ``whole``: the query of which this one is a part, which says what a trace must know.
    """
    whole = whole or match
    injective = not any(setting.name.lower() == "nodes" for setting in match.settings)
    unknown_is_false = any(setting.name.lower() == "unknown" for setting in match.settings)
    needed = set[str]() if unknown_is_false else relations_of(whole)
    egos = [setting.value for setting in match.settings if setting.name.lower() == "ego"]
    for frame in world.frames:
        if egos and egos != [frame.trace.hero]:
            continue
        if not needed <= {answer.lower() for answer in frame.trace.answers}:
            continue
        search = Search(frame, frame.graph, injective)
        outside: Binding = {}
        apart: tuple[str, ...] = ()
        # Named anywhere, it is a node of the pattern: the one that has that label, or (ego:Ego).
        if "ego" in free_names(whole):
            if frame.ego is None:
                continue
            outside["ego"] = frame.ego
            apart = () if labels_ego(match.block) else ("ego",)
        for binding in search.matches(match.block, outside, apart):
            yield search, binding


def answer(text: str, world: World) -> tuple[Counter[tuple[Any, ...]], set[int]]:
    """Rows (frame, named nodes and relations of named edges) and frames of a query, whatever it returns."""
    match = parse(text)[-1]
    assert isinstance(match, s.MatchClause)
    rows: set[tuple[Any, ...]] = set()
    for search, binding in assignments(match, world):
        named = {k: v for k, v in binding.items() if not k.startswith("#") and k != "ego"}
        values = [v.relation if isinstance(v, Edge) else v for _, v in sorted(named.items())]
        rows.add((search.frame.frame_id, *values))
    return Counter(rows), {row[0] for row in rows}


def returned(text: str, world: World) -> Counter[tuple[Any, ...]]:
    """The values after ``RETURN``, as often as they are returned."""
    match = parse(text)[-1]
    assert isinstance(match, s.MatchClause)
    assert match.returns is not None
    items = [item.value for item in match.returns.items]
    found = list(assignments(match, world))
    counted = [is_counted(item) for item in items]
    plain = [item for item, c in zip(items, counted, strict=True) if not c]
    if not any(counted):
        rows = [tuple(identity(item, *at) for item in items) for at in found]
        return Counter(map(shown, dict.fromkeys(rows) if match.returns.distinct else rows))
    groups: dict[tuple[Any, ...], list[tuple[Search, Binding]]] = {}
    for at in found:
        groups.setdefault(tuple(identity(item, *at) for item in plain), []).append(at)
    if all(counted):
        groups.setdefault((), [])
    rows = []
    for key, members in groups.items():
        told = iter(shown(key))
        row = [over(i, members) if c else next(told) for i, c in zip(items, counted, strict=True)]
        rows.append(tuple(row))
    return Counter(rows)


@dataclass(frozen=True)
class Entity:
    """A node, told apart from those of other traces: by the trace, or, a part of the map, by the map."""

    owner: int
    node: int


def identity(item: Any, search: Search, binding: Binding) -> Any:
    """A value, or which entity it is."""
    value = search.value(item, binding)
    return Entity(search.frame.trace.owner(value), value) if isinstance(item, s.Variable) else value


def shown(row: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(value.node if isinstance(value, Entity) else value for value in row)


def is_counted(item: Any) -> bool:
    names = {"count", "min", "max", "avg", "sum"}
    one = isinstance(item, s.Call) and len(item.arguments) == 1
    return isinstance(item, s.CountAll) or (one and item.name.lower() in names)


def over(item: Any, members: list[tuple[Search, Binding]]) -> Any:
    """A count, or a value of all matches of a group."""
    if isinstance(item, s.CountAll):
        return len(members)
    values = [identity(item.arguments[0], *at) for at in members]
    known = [value for value in values if value is not None]
    if item.name.lower() == "count":
        return len(set(known)) if item.distinct else len(known)
    if not known:
        return None
    mean = sum(known) / len(known) if item.name.lower() == "avg" else 0
    return {"min": min, "max": max, "sum": sum, "avg": lambda _: mean}[item.name.lower()](known)


def relations_of(part: Any) -> set[str]:
    """Every relation that a query names."""
    if isinstance(part, s.EdgePattern) and part.label is not None:
        inner = relations_of(part.properties) | relations_of(part.where)
        return inner | {label.name.lower() for label in labels_in(part.label) if label.name != "%"}
    if isinstance(part, (tuple, list)):
        return {name for item in part for name in relations_of(item)}
    if hasattr(part, "__dataclass_fields__"):
        return {
            n for field in part.__dataclass_fields__ for n in relations_of(getattr(part, field))
        }
    return set()


def labels_in(label: s.LabelExpression) -> list[s.Label]:
    if isinstance(label, s.Label):
        return [label]
    return [found for operand in label.operands for found in labels_in(operand)]


def disagreement(text: str, world: World, *, counted: bool = True) -> tuple[str, int]:
    """What the compiled query and the search do not agree on (nothing, if all is well); number of frames."""
    from sgstore.lang.sql import compile_query

    compiled = compile_query(text, world.catalog)  # refused, before anything is searched
    wanted, frames = answer(text, world)
    statement = compiled.rows()
    found = asked(statement, world)
    names = [name for name in statement.columns[5:] if not name.endswith(".name") and name != "ego"]
    order = sorted(range(len(names)), key=lambda i: names[i])
    keep = [statement.columns.index(names[i]) for i in order]
    rows = Counter((row[0], *(row[i] for i in keep)) for row in found)
    if rows != wanted:
        return difference("rows", rows, wanted), 0
    if counted:
        ((many,),) = asked(compiled.count(), world)
        if many != len(frames):
            return f"frames: counted {many}, wanted {len(frames)}", 0
    return "", len(frames)


def asked(statement: SqlStatement, world: World) -> list[tuple[Any, ...]]:
    """Rows of a statement, step by step, as a store asks for them."""
    for text, values in statement.steps():
        world.connection.execute(text, values)
    return world.connection.fetchall()


def disagreement_of_results(text: str, world: World) -> tuple[str, int]:
    """As above, of a query that returns values."""
    from sgstore.lang.sql import compile_query

    statement = compile_query(text, world.catalog).rows()
    wanted = rounded(returned(text, world))
    found = world.connection.execute(statement.sql, list(statement.values)).fetchall()
    rows = rounded(Counter(found))
    return ("" if rows == wanted else difference("results", rows, wanted)), len(wanted)


def rounded(rows: Counter[tuple[Any, ...]]) -> Counter[tuple[Any, ...]]:
    result = Counter[tuple[Any, ...]]()
    for row, number in rows.items():
        result[tuple(round(v, 6) if isinstance(v, float) else v for v in row)] += number
    return result


def difference(what: str, found: Counter[Any], wanted: Counter[Any]) -> str:
    more, less = found - wanted, wanted - found
    return f"{what}: {len(found)}, wanted {len(wanted)}\n too many {more}\n missing {less}"


WORLD = 50
"""Patterns that are tried on one world."""


def with_worlds(
    first: int, count: int, *, traces: int = 3, frames: int = 6
) -> Iterator[tuple[int, World]]:
    """So many numbers, each with its random world; some numbers in a row share one."""
    from oracle_worlds import random_world

    for start in range(first, first + count, WORLD):
        seed = start // WORLD
        world = random_world(
            start, traces=traces, frames=frames, static=seed % 2 == 0, maps=1 + seed // 2 % 2
        )
        world.connection.execute("SET threads = 1")
        for number in range(start, min(start + WORLD, first + count)):
            yield number, world


def try_each(
    first: int,
    count: int,
    made: Callable[[int], tuple[str, Compared]],
    found: str = "with rows",
    rows: Mapping[str, str] = MappingProxyType({}),
    **size: int,
) -> Counter[str]:
    """Random queries on random worlds; how many, how many find something, how many are refused.

    Parameters
    ----------
    made : function
        Gives the text of a query by its number, and what tells the difference on a world and how much is found.
    found : str
        The word for those that find something.
    rows : mapping of str to str
        Regular expressions by name: how many queries have them is told, too, and
        how many of these find something.
    **size : int
        Traces of a world, and frames of a trace.
    """
    from sgstore.errors import QueryError

    seen = Counter[str]()
    for number, world in with_worlds(first, count, **size):
        text, compared = made(number)
        REMEMBERED.clear()
        about = f"query {number}, world {number - (number - first) % WORLD}: {text}"
        try:
            problem, many = compared(world)
        except QueryError as error:
            seen["refused"] += 1
            seen[error.reason.split("'")[0]] += 1
            continue
        except Exception as error:
            error.add_note(about)
            raise
        seen["tried"] += 1
        seen[found] += many > 0
        for name in (name for name, told in rows.items() if re.search(told, text)):
            seen[name] += 1
            seen[f"{name} {found}"] += many > 0
        assert not problem, f"{about}\n{problem}"
    return seen


def try_many(first: int, count: int) -> dict[str, int]:
    """Random patterns; of three one returns values. The frames are counted, too, of every fourth."""
    from oracle_patterns import Writer

    def made(number: int) -> tuple[str, Compared]:
        writer = Writer(number)
        text = writer.query()
        if number % 3:
            return text, partial(disagreement, text, counted=number % 4 == 0)
        text += writer.results()
        return text, partial(disagreement_of_results, text)

    return dict(try_each(first, count, made, "matched"))


def tried(first: int, count: int, jobs: int) -> Counter[str]:
    """The same, in several processes; each takes whole worlds. The first difference ends it."""
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from multiprocessing import get_context

    size = WORLD * max(1, min(4, count // (WORLD * jobs)))
    starts = range(first, first + count, size)
    seen, done, began, said = Counter[str](), 0, time.perf_counter(), 0.0
    # Not forked: the database has threads.
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        sizes = {start: min(size, first + count - start) for start in starts}
        futures = {pool.submit(try_many, start, sizes[start]): start for start in starts}
        for future in as_completed(futures):
            try:
                seen.update(future.result())
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
            done += sizes[futures[future]]
            spent = time.perf_counter() - began
            if spent - said > SAY_S or done == count:
                said = spent
                told = f"{seen['tried']} tried, {seen['matched']} with a match, {seen['refused']} refused"
                print(f"{done}/{count}, {spent:.0f} s: {told}; no difference", flush=True)
    return seen


SAY_S = 10.0
"""How often it is said how far it is; s."""


def main(arguments: list[int]) -> None:
    count, first, jobs = (*arguments, *(1000, 0, 1)[len(arguments) :])
    began = time.perf_counter()
    seen = tried(first, count, jobs)
    print(dict(seen))
    print(f"{count / (time.perf_counter() - began):.1f} patterns/s")


if __name__ == "__main__":
    main([int(argument) for argument in sys.argv[1:]])
