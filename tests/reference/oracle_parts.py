"""Queries in several parts by their definition: ``OPTIONAL MATCH``, ``WITH``, ``MATCH`` behind them, paths.

Frame by frame, a query has a list of rows; each part makes another list of it. Patterns are searched
exhaustively, as in :mod:`oracle`. ``python -m oracle_parts 5000`` (in this folder) tries that many random
queries on random worlds.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from dataclasses import replace
from functools import lru_cache, partial
from itertools import groupby, product
from typing import TYPE_CHECKING, Any

from oracle import (
    Edge,
    Entity,
    Search,
    asked,
    assignments,
    difference,
    free_names,
    named_nodes,
    only_ego,
    relations_of,
    remembered,
    shown,
    try_each,
)
from oracle_after import is_counted, rounded, said
from oracle_over_time import graph_of
from oracle_patterns import SIMPLE, Writer

from sgstore.lang.bind import bind_query
from sgstore.lang.memory import FrameView, StageSearch
from sgstore.lang.syntax import parse
from sgstore.lang.syntax import tree as s
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator

    from oracle import Binding, Compared
    from oracle_worlds import Frame, World


class Row(Search):
    """A match of all parts so far: variables, and values that ``WITH`` passed on; ``None`` is NULL."""

    def __init__(self, search: Search, binding: Binding, passed: Binding) -> None:
        super().__init__(search.frame, search.graph, search.injective)
        self.binding, self.passed = binding, passed

    def of(self, e: s.Expression) -> Any:
        """A value, or which entity it is."""
        value = self.value(e, self.binding)
        node = isinstance(e, s.Variable) and e.name not in self.passed
        return Entity(self.frame.trace.owner(value), value) if node and value is not None else value

    def value(self, e: s.Expression, binding: Binding) -> Any:
        if isinstance(e, s.Variable) and e.name in self.passed:
            return self.passed[e.name]
        return super().value(e, binding)

    def owned(self, owner: str, name: str, binding: Binding) -> Any:
        if owner in binding and binding[owner] is None:
            return None
        return super().owned(owner, name, binding)

    def call(self, e: s.Call, binding: Binding) -> Any:
        if e.name == "type" and binding[e.arguments[0].name] is None:  # type: ignore[union-attr]
            return None
        if e.name in {"length", "nodes"}:
            nodes = self.value(e.arguments[0], binding)
            return nodes if e.name == "nodes" or nodes is None else len(nodes) - 1
        if e.name == "dist" and None in [self.value(one, binding) for one in e.arguments]:
            return None
        return super().call(e, binding)

    def matches(
        self, block: s.Block, outside: Binding, apart: tuple[str, ...] = ()
    ) -> Iterator[Binding]:
        if all(outside.get(name, "") is not None for name in free_names(block)):
            yield from super().matches(block, outside, apart)

    def found(self, block: s.Block) -> list[tuple[Binding, Binding]]:
        """Matches of a block beside what is bound, each with its paths."""
        if not paths_in(block):
            found = self.matches(block, self.binding)
            return [(binding, {}) for binding in found if self.differs(block, binding)]
        if any(self.binding.get(name, "") is None for name in free_names(block)):
            return []
        bare = replace(block, where=None)
        apart = tuple(name for name in free_names(block) if name in self.binding)
        found = self.matches(bare, self.binding, apart)
        return [(b, p) for b in found if self.differs(block, b) for p in self.along(block, b)]

    def differs(self, block: s.Block, binding: Binding) -> bool:
        """Whether the nodes of a block are none of the variables before; but ``(:Ego)`` is the ego."""
        egos = {n for n, node in named_nodes(block) if node.label and only_ego(node.label)}
        own = {n for n, _ in named_nodes(block)} - self.binding.keys() - egos
        before = {node for name, node in self.binding.items() if name[:1] != "#"}
        return not self.injective or not any(binding[name] in before for name in own)

    def along(self, block: s.Block, binding: Binding) -> Iterator[Binding]:
        """The paths of a match of which the condition is true: each a list of nodes."""
        names = {id(node): name for name, node in named_nodes(block)}
        choices: list[list[tuple[Any, ...]]] = []
        for path in paths_in(block):
            found: list[tuple[Any, ...]] = [(binding[names[id(path.nodes[0])]],)]
            for edge, node in zip(path.edges, path.nodes[1:], strict=True):
                end = binding[names[id(node)]]
                found = [
                    (*way, *more, end) for way in found for more in self.ways(edge, way[-1], end)
                ]
            choices.append(found)
        for chosen in product(*choices):
            told = dict(zip([path.name or "" for path in paths_in(block)], chosen, strict=True))
            row = Row(self, binding, {**self.passed, **told})
            if block.where is None or row.value(block.where, binding) is True:
                yield told

    def ways(self, edge: s.EdgePattern, left: Any, right: Any) -> set[tuple[Any, ...]]:
        """The nodes between the ends of an edge, for each way that it may stand for."""
        if edge.low is None or edge.high is None:
            return {()}
        ends = (right, left) if edge.direction == "left" else (left, right)
        links = self.joined(step_of(edge))
        found: set[tuple[Any, ...]] = set()

        def walk(seen: tuple[Any, ...], length: int) -> None:
            if length == 0:
                if seen[-1] == ends[1]:
                    found.add(seen[1:-1])
                return
            for step in (b for a, b in links if a == seen[-1]):  # type: ignore[union-attr]
                if self.injective and length > 1 and (step in seen or step == ends[1]):
                    continue
                walk((*seen, step), length - 1)

        for length in range(edge.low, edge.high + 1):
            walk((ends[0],), length)
        return {way[::-1] for way in found} if edge.direction == "left" else found


@remembered
def step_of(edge: s.EdgePattern) -> s.EdgePattern:
    """One edge of a way, along it; always the same object, because pairs of nodes are kept by it."""
    along = "any" if edge.direction == "any" else "right"
    return replace(edge, low=None, high=None, direction=along)


def rows_of(match: s.MatchClause, world: World, text: str) -> list[Row]:
    """The rows of a query before ``RETURN``."""
    rows = [row for search, binding in begun(match, world) for row in first(match, search, binding)]
    for part in match.later:
        if isinstance(part, s.WithClause):
            frames = groupby(rows, key=lambda row: row.frame.frame_id)
            rows = [row for _, some in frames for row in passed_on(part, list(some), text)]
        else:
            rows = [row for one in rows for row in joined(part, one)]
    return rows


def paths_in(block: s.Block) -> list[s.Path]:
    return [path for path in block.paths if path.name]


def begun(match: s.MatchClause, world: World) -> Iterator[tuple[Search, Binding]]:
    """Matches of the first pattern; of one with named paths, without its condition."""
    if not paths_in(match.block):
        return assignments(match, world)
    (step,) = match.sequence.steps
    bare = replace(step, block=replace(match.block, where=None))
    part = replace(match, sequence=replace(match.sequence, steps=(bare,)))
    return assignments(part, world, match)


def first(match: s.MatchClause, search: Search, binding: Binding) -> Iterator[Row]:
    if not paths_in(match.block):
        yield Row(search, binding, {})
        return
    for told in Row(search, binding, {}).along(match.block, binding):
        yield Row(search, binding, told)


def joined(part: s.LaterMatch, row: Row) -> list[Row]:
    found = row.found(part.block)
    if not found and part.optional:
        edges = [edge.name for path in part.block.paths for edge in path.edges if edge.name]
        names = [*(name for name, _ in named_nodes(part.block)), *edges]
        paths = dict.fromkeys(path.name or "" for path in paths_in(part.block))
        found = [({**dict.fromkeys(names), **row.binding}, paths)]
    return [Row(row, binding, {**row.passed, **told}) for binding, told in found]


def passed_on(clause: s.WithClause, rows: list[Row], text: str) -> list[Row]:
    """The rows of a frame behind ``WITH``."""
    every = [
        s.Item("value", s.Variable(n, clause.span), n, 0, 0, clause.span) for n in names_of(rows)
    ]
    items = [one for item in clause.items for one in (every if item.form == "all" else [item])]
    named = {item.name or said(item.value, text): item.value for item in items}
    counted = any(map(is_counted, named.values()))
    if counted or clause.distinct:
        found = [renamed(members, named, {}) for members in grouped(rows, named).values()]
    else:
        found = [renamed([row], named, {**row.binding}) for row in rows]
    for sort in reversed(clause.order):
        known = [row for row in found if row.of(sort.value) is not None]
        unknown = [row for row in found if row.of(sort.value) is None]
        known.sort(key=lambda row: shown((row.of(sort.value),))[0], reverse=sort.descending)
        found = known + unknown
    end = None if clause.limit is None else clause.skip + clause.limit
    found = found[clause.skip : end]
    if clause.where is not None:
        found = [row for row in found if row.value(clause.where, row.binding) is True]
    if not (counted or clause.distinct):
        found = [
            renamed([row], {n: s.Variable(n, clause.span) for n in named}, {}) for row in found
        ]
    return found


def names_of(rows: list[Row]) -> list[str]:
    names = {**rows[0].binding, **rows[0].passed} if rows else {}
    return [name for name in names if name[:1] != "#" and name != "ego"]


def grouped(rows: list[Row], named: dict[str, Any]) -> dict[tuple[Any, ...], list[Row]]:
    plain = [value for value in named.values() if not is_counted(value)]
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = tuple(hashed(row.of(value)) for value in plain)
        found.setdefault(key, []).append(row)
    return found


def hashed(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(value)
    return (value.relation, id(value.attributes)) if isinstance(value, Edge) else value


def renamed(members: list[Row], named: dict[str, Any], binding: Binding) -> Row:
    """A row of what is passed on of some rows; ``ego`` is always bound."""
    first = members[0]
    # What is not passed on may still be asked behind WITH, where each row is one as before.
    passed = {k: v for k, v in first.passed.items() if k not in named} if binding else {}
    binding = dict(binding)
    if "ego" in first.binding:
        binding["ego"] = first.binding["ego"]
    for name, value in named.items():
        if isinstance(value, s.Variable) and value.name in first.binding:
            binding[name] = first.binding[value.name]
            continue
        counted = is_counted(value)
        binding.pop(name, None)
        passed[name] = aggregated(value, members) if counted else first.of(value)
    return Row(first, binding, passed)


def aggregated(e: Any, members: list[Row]) -> Any:
    """An aggregate, or arithmetic of aggregates."""
    match e:
        case s.Arithmetic(first=first, rest=((sign, term),)):
            one, other = aggregated(first, members), aggregated(term, members)
            both = one is not None and other is not None
            return (one + other if sign == "+" else one - other) if both else None
        case s.Constant(value=value):
            return value
        case s.CountAll():
            return len(members)
    known = [value for value in (row.of(e.arguments[0]) for row in members) if value is not None]
    known = list(dict.fromkeys(known)) if e.distinct else known
    if e.name.lower() == "count":
        return len(known)
    if not known:
        return 0 if e.name.lower() == "sum" else None
    return {"min": min, "max": max, "sum": math.fsum}[e.name.lower()](known)


@lru_cache(1)
def returned(text: str, world: World) -> Counter[tuple[Any, ...]]:
    """The rows after ``RETURN``, as often as they are returned."""
    match = parse(text)[-1]
    assert isinstance(match, s.MatchClause)
    assert match.returns is not None
    rows = rows_of(match, world, text)
    named = {str(i): item.value for i, item in enumerate(match.returns.items)}
    counted = [is_counted(value) for value in named.values()]
    if not any(counted):
        found = [tuple(hashed(row.of(value)) for value in named.values()) for row in rows]
        kept = dict.fromkeys(found) if match.returns.distinct else found
        return Counter(rounded(shown(row)) for row in kept)
    groups = grouped(rows, named)
    if all(counted):
        groups.setdefault((), [])
    result = Counter[tuple[Any, ...]]()
    for key, members in groups.items():
        told = iter(shown(key))
        row = [aggregated(v, members) if is_counted(v) else next(told) for v in named.values()]
        result[rounded(tuple(row))] += 1
    return result


def listed(text: str, world: World) -> set[tuple[Any, ...]]:
    """The rows of whole matches: frame, and what the names mean."""
    match = parse(text)[-1]
    assert isinstance(match, s.MatchClause)
    found: set[tuple[Any, ...]] = set()
    for row in rows_of(match, world, text):
        both = {**row.binding, **row.passed}
        told = {n: v for n, v in both.items() if n[:1] != "#" and n != "ego"}
        values = [v.relation if isinstance(v, Edge) else v for _, v in sorted(told.items())]
        found.add((row.frame.frame_id, *rounded(tuple(values))))
    return found


# Random queries -----------------------------------------------------------------------------------


PATHS = (
    ("{} = (a)-[:near*1..2]->(b)", ["a", "b"]),
    ("{} = (a:Lane)-[:travelsTo*1..3]->(b)", ["a", "b"]),
    ("{} = (a:Car)-[:isIn]->(b)-[:isIn*1..2]->(c)", ["a", "b", "c"]),
    ("{} = (a)<-[:near|visible*2..3]-(b:Car)", ["a", "b"]),
    ("{} = (a:Vehicle)-[:near*1..2]-(b)-[:isIn]->(c)", ["a", "b", "c"]),
    ("{} = (a:Entity)", ["a"]),
    ("{} = (a)<-[:near*1..3]-(b), (b)-[:isIn*1..2]->(:Road)", ["a", "b"]),
)
"""Patterns with a path that has a name, and their variables."""


class PartsWriter(Writer):
    """Writes queries in several parts, without what depends on an order that nothing says."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.values: list[str] = []

    def whole(self) -> str:
        text = self.query() if self.rng.random() < 0.3 else self.simple()
        kinds = self.rng.choice(
            ("o", "oo", "w", "ow", "wo", "wm", "wmo", "owm", "ww", "om", "wom", "mw")
        )
        for place, kind in enumerate(kinds):
            text += (
                self.passing() if kind == "w" else self.further("def" if place else "abcd", kind)
            )
        return text

    def simple(self) -> str:
        """A pattern that most frames have."""
        any_ = "USING NODES any " * (self.rng.random() < 0.2)
        if self.rng.random() < 0.35:
            text, nodes = self.rng.choice(PATHS)
            self.nodes += nodes
            return f"{any_}MATCH {text.format('p')}{self.of_path('p')}"
        text, nodes = self.rng.choice(SIMPLE)
        self.nodes += nodes
        return f"{any_}MATCH {text}"

    def of_path(self, name: str) -> str:
        """A condition on a path that was just written; it has a value from here on."""
        self.paths.append(name)
        tests = [f"length({name}) {self.rng.choice(('>', '<=', '='))} {self.rng.choice('12')}"]
        tests += [f"length({name}) < a.id" for _ in "a" if "a" in self.nodes]
        return f" WHERE {self.rng.choice(tests)}" if self.rng.random() < 0.4 else ""

    @property
    def paths(self) -> list[str]:
        return self.__dict__.setdefault("_paths", [])

    def further(self, letters: str, kind: str) -> str:
        if self.rng.random() < 0.2:
            text, nodes = self.rng.choice(PATHS)
            names = {f"({n}": f"({n}{len(self.seen)}" for n in nodes if n not in self.nodes}
            self.seen.append("q")
            for old, new in names.items():
                text = text.replace(old, new)
            self.nodes += [new[1:] for new in names.values()]
            name = f"q{len(self.seen)}"
            return f" {'OPTIONAL ' if kind == 'o' else ''}MATCH {text.format(name)}{self.of_path(name)}"
        edges, self.edges = self.edges, []  # an edge is known only where it is bound
        before = set(self.nodes)
        text = self.block(letters, depth=2)
        own = [name for name in self.nodes if name not in before]
        if self.values and self.rng.random() < 0.4 and own:
            sign = self.rng.choice(("<", ">=", "<>"))
            word = "AND" if " WHERE " in text else "WHERE"
            text += f" {word} {self.rng.choice(own)}.id {sign} {self.rng.choice(self.values)}"
        self.edges = edges + self.edges
        return f" {'OPTIONAL ' if kind == 'o' else ''}MATCH {text}"

    def passing(self) -> str:
        nodes = [n for n in self.nodes if n != "ego"]
        kept = self.rng.sample(nodes, self.rng.randint(0, min(2, len(nodes))))
        called = {n: f"r{len(self.seen)}{n}" if self.rng.random() < 0.2 else n for n in kept}
        items, values = [n if n == c else f"{n} AS {c}" for n, c in called.items()], []
        pool = nodes or ["ego"]
        a, b = self.rng.choice(pool), self.rng.choice(pool)
        counted = self.rng.random() < 0.5
        some = [f"{a}.id", f"{a}.kind", f"{b}.x", f"COUNT {{({a})-[:near]->()}}", "frame.seq % 3"]
        of_all = [
            "COUNT(*)",
            f"COUNT({b})",
            f"COUNT(DISTINCT {a})",
            f"MAX({a}.x)",
            f"SUM({b}.width)",
        ]
        of_all += [f"MAX({a}.id) - MIN({b}.id)", *(f"MAX({v})" for v in self.values)]
        some += [*self.values, *(f"length({path})" for path in self.paths)]
        chosen = self.rng.sample(of_all, self.rng.choice((1, 2))) if counted else []
        chosen += self.rng.sample(some, self.rng.choice((0, 1)) if chosen or kept else 1)
        for value in chosen:
            name = f"n{len(self.seen)}"
            self.seen.append(name)
            items.append(f"{value} AS {name}")
            if ".kind" not in value:
                values.append(name)
        self.paths[:] = [path for path in self.paths if self.rng.random() < 0.5]
        items += self.paths
        distinct = not counted and self.rng.random() < 0.3
        text = f" WITH {'DISTINCT ' * distinct}{', '.join(items)}"
        kept = list(called.values())
        unnamed = [*kept, *self.nodes] if not (counted or distinct) else kept
        self.values, self.edges = values, []
        if (counted or distinct) and self.rng.random() < 0.3 and not self.paths:
            keys = [*values, *(f"{name}.id" for name in kept)]
            told = (item.rpartition(" ")[2] for item in items)
            kinds = [name for name in told if name not in (*values, *kept, *self.paths)]
            text += f" ORDER BY {', '.join(k + self.rng.choice(('', ' DESC')) for k in [*keys, *kinds])}"
            text += self.rng.choice((" LIMIT 1", " LIMIT 2", " SKIP 1", " SKIP 1 LIMIT 1"))
        if self.rng.random() < 0.5 and (values or kept):
            tests = [f"{value} {self.rng.choice('<>')} 1" for value in values]
            tests += [f"{name}.x > 101" for name in unnamed if name != "ego"]
            tests += [f"{name}.is_ego" for name in kept]
            text += f" WHERE {self.rng.choice(tests)}" if tests else ""
        self.nodes = list(kept)
        return text

    @property
    def seen(self) -> list[str]:
        return self.__dict__.setdefault("_seen", [])

    def told(self) -> str:
        names = [name for name in self.nodes if name != "ego"]
        some = [*names, *(f"{n}.x" for n in names), *(f"{n}.kind" for n in names)]
        some += [*(f"{n}.is_ego" for n in names), *self.values, "frame.seq", "trace.name"]
        some += [f"{n}.name" for n in names] + [f"type({edge})" for edge in self.edges]
        some += [f"COUNT {{({n})-[:near]-()}}" for n in names]
        some += [f"EXISTS {{({n})-[:isIn]->(:Lane)}}" for n in names]
        some += [*self.paths, *(f"length({path})" for path in self.paths)]
        some += [f"nodes({path})" for path in self.paths]
        if len(names) > 1:
            some += [f"dist({names[0]}, {names[-1]})", f"{names[0]} = {names[-1]}"]
        chosen = self.rng.sample(some, min(len(some), self.rng.choice((1, 2, 3))))
        if self.rng.random() < 0.4:
            counted = [
                "COUNT(*)",
                *(f"COUNT({n})" for n in names),
                *(f"SUM({v})" for v in self.values),
            ]
            counted += [f"COUNT(DISTINCT {n})" for n in names] + [f"MAX({n}.y)" for n in names]
            chosen = [*chosen[:1], *self.rng.sample(counted, min(2, len(counted)))]
            return f" RETURN {', '.join(chosen)}"
        return f" RETURN {self.rng.choice(('', 'DISTINCT '))}{', '.join(chosen)}"


def disagreement_of_parts(text: str, world: World) -> tuple[str, int]:
    """What the compiled query and the definition do not agree on; how many rows there are."""
    from sgstore.lang.sql import compile_query

    statement = compile_query(text, world.catalog).rows()
    wanted = returned(text, world)
    found = Counter(rounded(row) for row in asked(statement, world))
    return ("" if found == wanted else difference("rows", found, wanted)), len(wanted)


def disagreement_of_matches(text: str, world: World) -> tuple[str, int]:
    """The same of whole matches, and of the number of frames."""
    from sgstore.lang.sql import compile_query

    compiled = compile_query(text, world.catalog)
    statement = compiled.rows()
    wanted = listed(text, world)
    names = [n for n in statement.columns[5:] if not n.endswith(".name") and n != "ego"]
    keep = [statement.columns.index(name) for name in sorted(names)]
    rows = asked(statement, world)
    found = Counter((row[0], *rounded(tuple(row[i] for i in keep))) for row in rows)
    if found != Counter(wanted):
        return difference("matches", found, Counter(wanted)), 0
    ((many,),) = asked(compiled.count(), world)
    frames = len({row[0] for row in wanted})
    return ("" if many == frames else f"{many} frames, wanted {frames}"), frames


def in_memory(text: str, world: World) -> tuple[str, int]:
    """The same of what is returned of each match, by the search of one graph after another."""
    query = bind_query(text, parse(text), world.catalog, {})
    if query.result.aggregated or not query.stages:
        return "", 0
    search, found = StageSearch(query), Counter[tuple[Any, ...]]()
    values = [search.value(column.value) for column in query.result.columns]
    match = parse(text)[-1]
    for frame in answering(match, world):
        about = {"seq": frame.seq, "id": frame.frame_id}
        view = FrameView(graph_of(frame), about, {"name": frame.trace.name})
        told = (tuple(map(hashed, (value(row) for value in values))) for row in search.rows(view))
        found.update(map(rounded, told))
    wanted = returned(text, world)
    if query.result.distinct:
        found, wanted = (Counter(dict.fromkeys(rows, 1)) for rows in (found, wanted))
    return ("" if found == wanted else difference("in memory", found, wanted)), len(wanted)


def online(text: str, world: World) -> tuple[str, int]:
    """The same of the frames in which matches begin, frame by frame."""
    return online_of([text], world)


def lenient(text: str) -> str:
    """A query of which no trace is left out."""
    start, using, rest = text.partition("USING ")
    return f"USING UNKNOWN false, {rest}" if using else f"USING UNKNOWN false {start}"


def online_of(texts: list[str], world: World) -> tuple[str, int]:
    """The same of the parts of a ``UNION``: each of its queries is watched."""
    texts, many = [lenient(text) for text in texts if "EGO '" not in text], 0
    for trace in world.traces if texts else []:
        frames = [replace(frame, seq=n) for n, frame in enumerate(trace.frames)]
        alone = replace(world, traces=[replace(trace, frames=frames)])
        rows = [rows_by_frame(text, alone) for text in texts]
        wanted = Counter((k, *one) for k, own in enumerate(rows) for one in begun_in(frames, own))
        monitor = Monitor(" UNION ".join(texts), trace=trace.name, period_s=0.1)
        found = Counter[tuple[Any, ...]]()
        for n, frame in enumerate(frames):
            for event in monitor.look([graph_of(frame)]):
                nodes = sorted((k, v) for k, v in event.nodes.items() if k != "ego")
                part = int(event.name.split()[-1]) - 1 if len(texts) > 1 else 0
                found[part, event.start.seq, tuple(nodes)] += 1
                known = [values for some in rows[part][n].values() for values in some]
                passed = rounded(tuple(event.values.values()))
                if sorted(map(str, passed)) not in [sorted(map(str, one)) for one in known]:
                    return f"frame {n}: {event.values}, wanted one of {known}", 0
        if found != wanted:
            return difference(f"online {trace.name}", found, wanted), 0
        many += sum(wanted.values())
    return "", many


def rows_by_frame(text: str, world: World) -> dict[int, dict[Any, list[Any]]]:
    """What is bound in each frame of a trace, and the values that are passed on with it."""
    match = parse(text)[-1]
    assert isinstance(match, s.MatchClause)
    rows: dict[int, dict[Any, list[Any]]] = {n: {} for n in range(-1, len(world.frames))}
    for row in rows_of(match, world, text):
        told = tuple(sorted((n, shown_node(v)) for n, v in row.binding.items() if n[:1] != "#"))
        rows[row.frame.seq].setdefault(told, []).append(rounded(tuple(row.passed.values())))
    return rows


def begun_in(frames: list[Frame], rows: dict[int, dict[Any, Any]]) -> Iterator[tuple[Any, ...]]:
    """The first frame of each run in which something is bound, and its nodes."""
    for n, frame in enumerate(frames):
        gap = n == 0 or frame.time_ns - frames[n - 1].time_ns > 250_000_000
        for told in rows[n]:
            if gap or told not in rows[n - 1]:
                yield n, tuple((k, v) for k, v in told if isinstance(v, int) and k != "ego")


def all_agree(compared: list[Compared], world: World) -> tuple[str, int]:
    """The first difference that some comparisons tell; how much the first of them found."""
    found = [one(world) for one in compared]
    return next((problem for problem, _ in found if problem), ""), found[0][1]


def shown_node(value: Any) -> Any:
    """What a name is bound to: a node, the relation of an edge in brackets, or nothing."""
    return f"[{value.relation}]" if isinstance(value, Edge) else "" if value is None else value


def answering(match: Any, world: World) -> Iterator[Frame]:
    """The frames of the traces that a query is asked of, and that can answer it."""
    egos = [setting.value for setting in match.settings if setting.name.lower() == "ego"]
    needed = {name.lower() for name in relations_of(match)}
    for frame in world.frames:
        if needed <= {name.lower() for name in frame.trace.answers} and (
            not egos or egos == [frame.trace.hero]
        ):
            yield frame


ROWS = {
    "OPTIONAL MATCH": r"OPTIONAL MATCH",
    "WITH": r" WITH ",
    "MATCH after WITH": r" WITH .*(?<!OPTIONAL) MATCH ",
    "named paths": r"\b[pq]\d* = \(",
    "WITH of many": r" WITH [^W]*(COUNT\(|MAX\(|SUM\(|median|percentile|stddev|collect)",
}
"""Constructs, and how they are told in a query."""


def try_many_parts(first: int, count: int) -> Counter[str]:
    """Random queries on random worlds, by SQL, in memory, and frame by frame."""

    def made(number: int) -> tuple[str, Compared]:
        writer = PartsWriter(number)
        text = writer.whole()
        bare = [partial(online, text)]
        if number % 3 == 0:
            return text, partial(all_agree, [partial(disagreement_of_matches, text), *bare])
        text += writer.told()
        told = [partial(one, text) for one in (disagreement_of_parts, in_memory)]
        return text, partial(all_agree, told + bare)

    return try_each(first, count, made, rows=ROWS, traces=2, frames=5)


if __name__ == "__main__":
    print(dict(try_many_parts(int((sys.argv[2:] or ["0"])[0]), int(sys.argv[1]))))
