"""Sequences, operators of time and checks as they are defined: ``python oracle_over_time.py 2000``.

Random questions are asked of random worlds, by the definitions of docs/language.md written down once more:
every tuple of frames is tried, every operator looks at every frame.
"""

from __future__ import annotations

import random
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from oracle import Search, compare
from oracle_worlds import random_world

import sgstore
from sgstore.lang import syntax as s
from sgstore.lang.parser import parse
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator

    from oracle_worlds import Trace, World

    from sgstore.query import Store

Binding = dict[str, int]
GAP = 2.5
AHEAD = {"ALWAYS", "EVENTUALLY", "NEXT", "WEAKNEXT", "UNTIL", "RELEASE"}


def parts_of(expression: Any) -> Iterator[Any]:
    yield expression
    if is_dataclass(expression):
        for field in fields(expression):
            yield from parts_of(getattr(expression, field.name))
    elif isinstance(expression, tuple):
        for part in expression:
            yield from parts_of(part)


def is_temporal(expression: Any) -> bool:
    courses = {"prev", "delta", "run_length", "since_true", "age", "exists_now"}
    return any(
        isinstance(part, s.Temporal) or (isinstance(part, s.Call) and part.name in courses)
        for part in parts_of(expression)
    )


@dataclass
class Told:
    """A trace and the definitions of what is true in it."""

    trace: Trace
    period: int

    def __post_init__(self) -> None:
        self.frames = self.trace.frames
        self.times = [frame.time_ns for frame in self.frames]
        self.searches = [Search(frame, frame.graph, injective=True) for frame in self.frames]

    def gap_before(self, i: int) -> bool:
        return self.times[i] - self.times[i - 1] > GAP * self.period

    # Conditions

    def true(self, e: Any, i: int, binding: Binding) -> bool:
        """A condition at a frame, unknown being false where time begins."""
        match e:
            case s.Logic(word=word, operands=operands):
                values = [self.true(operand, i, binding) for operand in operands]
                return {
                    "NOT": lambda: not values[0],
                    "AND": lambda: all(values),
                    "OR": lambda: any(values),
                    "XOR": lambda: sum(values) % 2 == 1,
                    "IMPLIES": lambda: not values[0] or values[1],
                }[word]()
            case s.Temporal():
                return self.tense(e, i, binding)
            case s.Call(name="exists_now", arguments=(s.Variable(name=name),)):
                return binding[name] in self.frames[i].graph
            case _ if is_temporal(e):
                return self.value(e, i, binding) is True
            case _:
                spoken = {p.name for p in parts_of(e) if isinstance(p, s.Variable | s.NodePattern)}
                graph = self.frames[i].graph
                here = all(binding[name] in graph for name in spoken & set(binding))
                return here and self.searches[i].value(e, binding) is True

    def tense(self, e: s.Temporal, i: int, binding: Binding) -> bool:
        last = len(self.frames) - 1
        near = [j for j in range(last + 1) if self.within(e, i, j)]
        one = e.operands[-1]
        match e.word:
            case "NEXT" | "WEAKNEXT":
                return self.true(one, i + 1, binding) if i < last else e.word == "WEAKNEXT"
            case "PREVIOUS":
                return i > 0 and self.true(one, i - 1, binding)
            case "ALWAYS" | "HISTORICALLY":
                return all(self.true(one, j, binding) for j in near)
            case "EVENTUALLY" | "ONCE":
                return any(self.true(one, j, binding) for j in near)
            case "RELEASE":
                left = e.operands[0]
                return all(
                    self.true(one, j, binding)
                    or any(self.true(left, k, binding) for k in range(i, j))
                    for j in near
                )
            case _:
                left = e.operands[0]
                between = (
                    (lambda j: range(i, j)) if e.word == "UNTIL" else lambda j: range(j + 1, i + 1)
                )
                return any(
                    self.true(one, j, binding)
                    and all(self.true(left, k, binding) for k in between(j))
                    for j in near
                )

    def within(self, e: s.Temporal, i: int, j: int) -> bool:
        sign = 1 if e.word in AHEAD else -1
        if sign * (j - i) < 0:
            return False
        if e.bound is None:
            return True
        low, high = e.bound
        age = sign * (j - i) if low.unit == "frames" else sign * (self.times[j] - self.times[i])
        size = (lambda d: d.amount) if low.unit == "frames" else lambda d: d.ns
        return size(low) <= age and (high is None or age <= size(high))

    def value(self, e: Any, i: int, binding: Binding) -> Any:  # noqa: C901, PLR0911 - a case each
        """A value at a frame; ``None`` is NULL."""
        match e:
            case s.Comparison(word=word, left=left, right=right):
                frames = isinstance(right, s.Duration) and right.unit == "frames"
                one = self.value(left, i, binding) if not frames else self.counted(left, i, binding)
                return compare(word, one, self.value(right, i, binding))
            case s.Duration(unit="frames", amount=amount):
                return amount
            case s.Duration():
                return e.ns / 1e9
            case s.Constant(value=value):
                return value
            case s.Call(name="prev", arguments=(inner,)):
                return None if i == 0 or self.gap_before(i) else self.value(inner, i - 1, binding)
            case s.Call(name="delta", arguments=(inner, by)):
                return self.delta(inner, by, i, binding)
            case s.Call(name="run_length", arguments=(inner,)):
                run = self.run_up_to(inner, i, binding)
                return (self.times[i] - self.times[run[0]]) / 1e9 if run else 0
            case s.Call(name="since_true", arguments=(inner,)):
                past = [j for j in range(i + 1) if self.true(inner, j, binding)]
                return (self.times[i] - self.times[past[-1]]) / 1e9 if past else None
            case s.Call(name="age", arguments=(s.Variable(name=name),)):
                seen = [j for j in range(i + 1) if binding[name] in self.frames[j].graph]
                return (self.times[i] - self.times[seen[0]]) / 1e9 if i in seen else None
            case _ if any(binding[name] not in self.frames[i].graph for name in spoken_of(e)):
                return None
            case _:
                return self.searches[i].value(e, binding)

    def counted(self, e: Any, i: int, binding: Binding) -> int:
        return len(self.run_up_to(e.arguments[0], i, binding))

    def run_up_to(self, e: Any, i: int, binding: Binding) -> list[int]:
        run: list[int] = []
        while i >= 0 and self.true(e, i, binding):
            run.insert(0, i)
            if self.gap_before(i) or i == 0:
                break
            i -= 1
        return run

    def delta(self, inner: Any, by: s.Duration, i: int, binding: Binding) -> Any:
        if by.unit == "frames":
            then = i - int(by.amount)
        else:
            past = [j for j in range(i + 1) if self.times[j] <= self.times[i] - by.ns]
            then = past[-1] if past else -1
        if then < 0 or any(self.gap_before(j) for j in range(then + 1, i + 1)):
            return None
        now, before = self.value(inner, i, binding), self.value(inner, then, binding)
        return None if now is None or before is None else now - before

    # Sequences

    def holds(self, step: s.Step, known: set[str]) -> set[tuple[int, tuple[Any, ...]]]:
        """Frames and bindings in which a step's pattern and conditions hold; some names are those of others."""
        named = (s.Variable, s.NodePattern)
        told = {p.name for p in parts_of(step.block.where) if isinstance(p, named)} & known
        names = sorted(told | names_of(step))
        parts = conjuncts(step.block.where)
        now = [part for part in parts if not is_temporal(part)]
        later = [part for part in parts if is_temporal(part)]
        where = s.Logic("AND", tuple(now), step.span) if now else None
        paths = step.block.paths
        bare = {p.name for p in parts_of(paths) if isinstance(p, s.NodePattern)}
        span = step.span
        paths += tuple(
            s.Path((s.NodePattern(n, None, (), None, span, span),), ())
            for n in names
            if n not in bare
        )
        block = s.Block(paths, where, span)
        found: set[tuple[int, tuple[Any, ...]]] = set()
        for i, search in enumerate(self.searches):
            for match in search.matches(block, {}):
                binding = {name: match[name] for name in names}
                if all(self.true(part, i, binding) for part in later):
                    found.add((i, tuple(sorted(binding.items()))))
        if step.hold is not None:
            found = {(i, b) for i, b in found if self.lasts(step.hold, i, b, found)}
        return found

    def lasts(self, hold: s.Hold, i: int, binding: Any, found: set[Any]) -> bool:
        run = self.run(i, {j for j, b in found if b == binding})
        if hold.duration.unit == "frames":
            return compare(hold.comparison, len(run), hold.duration.amount)
        length = self.times[run[-1]] - self.times[run[0]] + (self.period if hold.inclusive else 0)
        return compare(hold.comparison, length, hold.duration.ns)

    def run(self, i: int, frames: set[int]) -> list[int]:
        first, last = i, i
        while first - 1 in frames and not self.gap_before(first):
            first -= 1
        while last + 1 in frames and not self.gap_before(last + 1):
            last += 1
        return list(range(first, last + 1))

    def sequences(
        self, sequence: s.Sequence, policy: str
    ) -> Iterator[tuple[Binding, list[int], int]]:
        """Every match: the binding, the frames of the steps, and the frame at which it ends."""
        steps = list(sequence.steps)
        known = set().union(*(names_of(step) for step in steps if not step.absent))
        held = [self.holds(step, known) for step in steps]
        for binding in self.bindings(
            [h for h, step in zip(held, steps, strict=True) if not step.absent]
        ):
            own = [{i for i, b in h if agrees(dict(b), binding)} for h in held]
            for run in self.runs(own[0]):
                tuples = [t for i in run for t in self.tuples(steps, sequence.links, own, [i])]
                if not tuples:
                    continue
                best = min(tuples)
                if policy == "longest":
                    best = max(t for t in tuples if t[0] == best[0])
                end = best[-1]
                last = max(n for n, step in enumerate(steps) if not step.absent)
                if steps[last].hold is not None:
                    end = self.run(end, own[last])[-1]
                yield binding, best, end
                if policy == "first":
                    break

    def bindings(self, held: list[set[Any]]) -> list[Binding]:
        """All assignments of the variables of some steps that agree."""
        found: list[Binding] = [{}]
        for step in held:
            options = [dict(b) for b in {b for _, b in step}]
            found = [
                one | more
                for one in found
                for more in options
                if agrees(one, more) and len(set((one | more).values())) == len(one | more)
            ]
        return [dict(items) for items in {tuple(sorted(one.items())) for one in found}]

    def runs(self, frames: set[int]) -> list[list[int]]:
        runs = {tuple(self.run(i, frames)) for i in frames}
        return [list(run) for run in sorted(runs)]

    def tuples(
        self, steps: list[s.Step], links: tuple[s.Link, ...], own: list[set[int]], so_far: list[int]
    ) -> Iterator[list[int]]:
        number = len(so_far) + sum(step.absent for step in steps[: len(so_far)])
        happened = sum(not step.absent for step in steps[:number])
        while happened < len(so_far):
            happened += not steps[number].absent
            number += 1
        if number == len(steps):
            yield so_far
            return
        i, absent = so_far[-1], set[int]()
        if steps[number].absent:
            absent, number = own[number], number + 1
            if number == len(steps):
                limit = links[number - 2].within
                if not any(j > i and self.not_later(i, j, limit) for j in absent):
                    yield so_far
                return
        for j in sorted(own[number]):
            link = links[number - 1]
            if self.linked(link, i, j, own[number - 1]) and not any(i < k < j for k in absent):
                yield from self.tuples(steps, links, own, [*so_far, j])

    def linked(self, link: s.Link, i: int, j: int, before: set[int]) -> bool:  # noqa: PLR0911
        if link.kind == "while":
            return i == j
        if link.kind == "immediately":
            return j == i + 1 and not self.gap_before(j)
        if link.kind == "until":
            whole = all(k in before for k in range(i, j))
            return j > i and whole and not any(self.gap_before(k) for k in range(i + 1, j + 1))
        if j <= i or not self.not_later(i, j, link.within):
            return False
        if link.after is None:
            return True
        if link.after.unit == "frames":
            return j - i >= link.after.amount
        return self.times[j] - self.times[i] >= link.after.ns

    def not_later(self, i: int, j: int, limit: Any) -> bool:
        if limit is None:
            return True
        if limit.unit == "frames":
            return j - i <= limit.amount
        return self.times[j] - self.times[i] <= limit.ns


def names_of(step: s.Step) -> set[str]:
    """The names that a step's pattern binds."""
    nodes = (p for p in parts_of(step.block.paths) if isinstance(p, s.NodePattern))
    return {node.name for node in nodes if node.name}


def spoken_of(where: Any) -> set[str]:
    return {part.name for part in parts_of(where) if isinstance(part, s.Variable)} - {"frame"}


def conjuncts(where: Any) -> list[Any]:
    if where is None:
        return []
    if isinstance(where, s.Logic) and where.word == "AND":
        return [part for operand in where.operands for part in conjuncts(operand)]
    return [where]


def agrees(one: Binding, other: Binding) -> bool:
    return all(one[name] == other[name] for name in one.keys() & other.keys())


# Random questions -------------------------------------------------------------------------------------------

FIRST = (
    "MATCH (e:Ego)",
    "MATCH (e:Ego), (v:Car)",
    "MATCH (e:Ego)-[:near]->(v)",
    "MATCH (e:Ego)-[:near|visible]-(v:Entity)",
    "MATCH (e:Ego), (v:Entity)",
)
LATER = ("MATCH (e)", "MATCH (e), (v)", "MATCH (e)-[:near]->(v)", "MATCH (v)-[:isIn]->(:Lane)")
NEW = ("MATCH (e)-[:visible]->(w:Entity)", "MATCH (w:Person)", "MATCH (v)-[:near]->(w)")
ATOMS = (
    "e.speed > 0.5",
    "e.speed > 2",
    "EXISTS {(e)-[:isIn]->(:Lane)}",
    "NOT EXISTS {(e)-[:near]->(:Car)}",
    "COUNT {(e)-[:visible]->()} > 1",
)
PAIRS = ("v.speed > 0.5", "dist(e, v) < 6", "EXISTS {(e)-[:near]->(v)}", "v.speed < e.speed")
COURSES = (
    "prev(e.speed) < e.speed",
    "delta(e.x, 0.2s) > 0",
    "delta(e.speed, 2frames) >= 0",
    "run_length(e.speed > 0.5) >= 2frames",
    "run_length(e.speed > 0.5) >= 0.1s",
    "since_true(e.speed > 2) <= 0.2s",
    "age(e) > 0.2s",
)
PAIR_COURSES = ("prev(dist(e, v)) > dist(e, v)", "exists_now(v)", "age(v) >= 0.1s")
BOUNDS = ("", "", "[0s, 0.3s]", "[0.1s, 1s]", "[1frames, 3frames]", "[0.2s, INF]")
HOLDS = ("", "", "", " FOR >= 0.1s", " FOR >= 2frames", " FOR < 0.3s", " FOR >= 0.2s INCLUSIVE")
THEN = (
    *("THEN", "THEN WITHIN 0.3s", "THEN AFTER 0.2s", "THEN AFTER 0.1s WITHIN 1s"),
    *("THEN IMMEDIATELY", "UNTIL", "WHILE", "THEN WITHIN 2frames"),
)


def condition(rng: random.Random, pair: bool, depth: int, *, temporal: bool) -> str:
    if depth == 0:
        atoms = ATOMS + (PAIRS * 2 if pair else ())
        atoms += (COURSES + (PAIR_COURSES if pair else ())) if temporal else ()
        return rng.choice(atoms)
    inner = [condition(rng, pair, depth - 1, temporal=temporal) for _ in range(2)]
    shapes = ["NOT ({0})", "({0}) AND ({1})", "({0}) OR ({1})", "({0}) IMPLIES ({1})"]
    if temporal:
        bound = rng.choice(BOUNDS)
        words = ("ALWAYS", "EVENTUALLY", "HISTORICALLY", "ONCE")
        shapes += [f"{word}{bound} ({{0}})" for word in words]
        shapes += [f"{word} ({{0}})" for word in ("NEXT", "WEAKNEXT", "PREVIOUS")]
        shapes += [f"({{0}}) {word}{bound} ({{1}})" for word in ("UNTIL", "SINCE", "RELEASE")]
    return rng.choice(shapes).format(*inner)


def random_sequence(rng: random.Random) -> str:
    first = rng.choice(FIRST)
    pair = "(v" in first
    text = first
    if rng.random() < 0.7:
        text += f" WHERE {condition(rng, pair, rng.randint(0, 1), temporal=rng.random() < 0.3)}"
    text += rng.choice(HOLDS) + " AS s0"
    steps = rng.randint(1, 3)
    new = False
    for number in range(1, steps + 1):
        link = rng.choice(THEN)
        if link.startswith("THEN") and rng.random() < 0.25 and link != "THEN IMMEDIATELY":
            text += f" THEN NOT MATCH (e) WHERE {condition(rng, pair, 0, temporal=False)}"
        choices = [one for one in LATER if pair or "(v" not in one]
        if pair and not new and rng.random() < 0.2:
            choices, new = list(NEW), True
        text += f" {link} {rng.choice(choices)}"
        if rng.random() < 0.6:
            text += f" WHERE {condition(rng, pair, rng.randint(0, 1), temporal=rng.random() < 0.3)}"
        text += rng.choice(HOLDS) + f" AS s{number}"
    if rng.random() < 0.1:
        text += f" THEN WITHIN 0.5s NOT MATCH (e) WHERE {condition(rng, pair, 0, temporal=False)}"
    return text


def periods(store: Store) -> dict[str, int]:
    return {trace.name: trace.period_ns for trace in store.info()}


def compare_sequence(world: World, store: Store, text: str, policy: str) -> int:
    """Ask a sequence both ways; how many matches there are."""
    (statement,) = parse(text)
    assert isinstance(statement, s.Match)
    steps = [step for step in statement.sequence.steps if isinstance(step, s.Step)]
    names = sorted(set().union(*(names_of(step) for step in steps if not step.absent)))
    times = [f"t({step.name})" for step in steps if step.name]
    asked = f"USING UNKNOWN false, MATCHES {policy} {text} RETURN trace.name, {', '.join(names + times)}"
    found = Counter(tuple(row) for row in store.find(asked))
    spans = Counter(
        (i.trace, i.start_seq, i.end_seq, *(i.values[name] for name in names))
        for i in store.find(f"USING UNKNOWN false, MATCHES {policy} {text}").intervals()
    )
    expected: Counter[Any] = Counter()
    expected_spans: set[Any] = set()
    period = periods(store)
    for trace in world.traces:
        told = Told(trace, period[trace.name])
        for binding, frames, end in told.sequences(statement.sequence, policy):
            nodes = tuple(binding[name] for name in names)
            start = told.times[0]
            expected[trace.name, *nodes, *((told.times[i] - start) / 1e9 for i in frames)] += 1
            seqs = (trace.frames[frames[0]].seq, trace.frames[end].seq)
            expected_spans.add((trace.name, *seqs, *nodes))
    assert found == expected, (text, found - expected, expected - found)
    assert set(spans) == expected_spans, (text, set(spans) ^ expected_spans)
    return sum(expected.values())


def compare_condition(world: World, store: Store, rng: random.Random) -> int:
    """Ask a pattern with a condition over time both ways; how many rows there are."""
    where = condition(rng, pair=True, depth=rng.randint(1, 3), temporal=True)
    value = f"ONCE[0s, 0.2s] ({condition(rng, pair=True, depth=1, temporal=True)})"
    text = (
        f"MATCH (e:Ego), (v:Entity) WHERE {where} RETURN trace.name, frame.seq, e, v, {value} AS y"
    )
    found = Counter(tuple(row) for row in store.find(f"USING UNKNOWN false {text}"))
    (statement,) = parse(text)
    assert isinstance(statement, s.Match)
    assert statement.returns is not None
    asked = statement.returns.items[-1].value
    expected: Counter[Any] = Counter()
    period = periods(store)
    for trace in world.traces:
        told = Told(trace, period[trace.name])
        step = s.Step(statement.block, absent=False, hold=None, name=None, span=statement.span)
        for i, binding in told.holds(step, {"e", "v"}):
            nodes = dict(binding)
            y = (
                told.true(asked, i, nodes)
                if is_temporal(asked)
                else told.searches[i].value(asked, nodes)
            )
            expected[trace.name, trace.frames[i].seq, nodes["e"], nodes["v"], y] += 1
    assert found == expected, (text, found - expected, expected - found)
    return sum(expected.values())


def compare_check(world: World, store: Store, rng: random.Random) -> int:
    """Ask a check both ways; how many traces violate it."""
    pair = rng.random() < 0.6
    words = rng.choice((("FORALL",), ("FORSOME",)))
    formula = condition(rng, pair, rng.randint(1, 3), temporal=True).replace("e.", "ego.")
    formula = formula.replace("(e)", "(ego)").replace("(e,", "(ego,")
    head = f"{words[0]} (v:Entity) " if pair else ""
    text = f"USING UNKNOWN false CHECK c: {head}{formula}"
    (statement,) = parse(text)
    assert isinstance(statement, s.Check)
    found = {verdict.trace: verdict.verdict == "true" for verdict in store.check(text)}
    period = periods(store)
    for trace in world.traces:
        told = Told(trace, period[trace.name])
        spoken = "ego" in {
            p.name for p in parts_of(statement.formula) if isinstance(p, s.Variable | s.NodePattern)
        }
        seen_ego = any(trace.ego in frame.graph for frame in trace.frames)
        domain = [n for n in trace.entities if any(n in frame.graph for frame in trace.frames)]
        ego = trace.ego if seen_ego else -99
        if spoken:
            domain = [node for node in domain if node != ego]
        bindings = [{"v": v, "ego": ego} for v in domain] if pair else [{"ego": ego}]
        values = [told.true(statement.formula, 0, binding) for binding in bindings]
        expected = any(values) if pair and words == ("FORSOME",) else all(values)
        assert found[trace.name] == expected, (text, trace.name, found[trace.name], expected)
    return sum(not holds for holds in found.values())


def worlds(seed: int, folder: Path) -> tuple[World, Store]:
    path = folder / f"{seed}.sgstore"
    StoreFile.create(path)
    world = random_world(seed, traces=3, frames=8 + seed % 5, path=path)
    world.connection.close()
    return world, sgstore.open(path)


def run(seeds: int, questions: int, folder: Path) -> tuple[int, int, int]:
    """Ask so many questions of each kind of each of so many worlds; how much was found."""
    found = [0, 0, 0]
    for seed in range(seeds):
        world, store = worlds(seed, folder)
        rng = random.Random(seed)
        for number in range(questions):
            policy = ("all", "first", "longest")[number % 3]
            found[0] += compare_sequence(world, store, random_sequence(rng), policy)
            found[1] += compare_condition(world, store, rng)
            found[2] += compare_check(world, store, rng)
    return found[0], found[1], found[2]


if __name__ == "__main__":
    asked = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    with tempfile.TemporaryDirectory() as made:
        worth = run(max(asked // 30, 1), 30, Path(made))
    sys.stdout.write(
        f"no difference; {worth[0]} sequences, {worth[1]} rows, {worth[2]} violations\n"
    )
