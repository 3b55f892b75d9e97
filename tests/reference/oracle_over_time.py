"""Sequences, operators of time and checks as they are defined: ``python oracle_over_time.py 2000``.

Random questions are asked of random worlds, by the definitions of docs/language.md written down once more:
every tuple of frames is tried, every operator looks at every frame.
"""

from __future__ import annotations

import math
import random
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from oracle import Edge, Search, arithmetic, compare, links_of, remembered
from oracle_worlds import random_world

import sgstore
from sgstore.errors import TextSpan
from sgstore.lang.syntax import parse
from sgstore.lang.syntax import tree as s
from sgstore.model.graph import SceneGraph
from sgstore.model.pair_numbers import PAIR_FUNCTIONS, columns_needed
from sgstore.model.vocabulary import normalize_name
from sgstore.store import StoreFile
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from oracle_worlds import Frame, Trace, World

    from sgstore.query import Store
    from sgstore.temporal import MonitorEvent, Verdict

T = TypeVar("T")
Binding = dict[str, int]
GAP = 2.5
WINDOWS = {
    "min_over": min,
    "max_over": max,
    "sum_over": math.fsum,
    "avg_over": lambda values: math.fsum(values) / len(values),
}
NUMBERS = {normalize_name(name) for name in PAIR_FUNCTIONS}
PROPER = {normalize_name(name): name for name in PAIR_FUNCTIONS}
SIZES = {"length", "width", "heading", "vx", "ax", "yaw_rate"}
MOVING = {"speed", "accel", "vx", "vy", "ax", "ay"}
RECORDED = {"speed", "accel", "vx", "vy", "ax", "ay", "length", "width", "height", "heading"}
"""What is measured, among the attributes that random conditions are about."""
TIMED = {"run_length", "since_true", "age"}
AHEAD = {"ALWAYS", "EVENTUALLY", "NEXT", "WEAKNEXT", "UNTIL", "RELEASE"}


@remembered
def parts_of(expression: Any) -> list[Any]:
    """An expression and all that stands in it."""
    inner: Any = expression if isinstance(expression, tuple) else ()
    if is_dataclass(expression):
        inner = [getattr(expression, one.name) for one in fields(expression)]
    return [expression, *(part for one in inner for part in parts_of(one))]


@remembered
def is_temporal(expression: Any) -> bool:
    courses = {
        "prev",
        "delta",
        "run_length",
        "since_true",
        "age",
        "exists_now",
        "robustness",
        *WINDOWS,
    }
    return any(
        isinstance(part, s.Temporal) or (isinstance(part, s.Call) and part.name in courses)
        for part in parts_of(expression)
    )


def parts_within(expression: Any) -> list[Any]:
    """What stands directly in an expression."""
    inner: Any = expression if isinstance(expression, tuple) else ()
    if is_dataclass(expression):
        inner = [getattr(expression, one.name) for one in fields(expression)]
    return [one for one in inner if is_dataclass(one) or isinstance(one, tuple)]


@remembered
def has_pairs(expression: Any) -> bool:
    """Whether numbers of pairs stand in an expression, outside of braces."""
    runs = {"run_length", "since_true", "robustness"}
    if isinstance(expression, s.Block):
        return False
    if isinstance(expression, s.Call) and expression.name in runs:
        return False
    if isinstance(expression, s.Call) and normalize_name(expression.name) in NUMBERS:
        return True
    return any(has_pairs(one) for one in parts_within(expression))


@remembered
def has_margins(expression: Any) -> bool:
    return any(isinstance(p, s.Call) and p.name == "robustness" for p in parts_of(expression))


def waits(e: Any) -> bool:
    """Whether a condition waits for something as long as a trace goes on."""
    endless = isinstance(e, s.Temporal) and (e.bound is None or e.bound[1] is None)
    return endless and e.word in {"UNTIL", "EVENTUALLY"}


def once(method: Callable[[Any, Any, int, Binding], T]) -> Callable[[Any, Any, int, Binding], T]:
    """What is told of an expression at a frame, worked out once for each binding."""

    def told(self: Told, e: Any, i: int, binding: Binding) -> T:
        reading = self.absent, self.unknown, self.due, self.tried
        key = method.__name__, reading, id(e), i, *binding.items()
        if key not in self.known:
            self.known[key] = e, method(self, e, i, binding)
        return self.known[key][1]

    return told


@dataclass
class Told:
    """A trace and the definitions of what is true in it."""

    trace: Trace
    period: int
    links: dict[str, tuple[s.EdgePattern, str, str]] = field(default_factory=dict)
    """Edge variables: the edge of the pattern, and the names of the nodes to its left and right."""
    known: dict[Any, Any] = field(default_factory=dict)
    bridge: bool = False
    """Whether a gap between frames ends nothing."""
    absent: bool | None = None
    """Of a check: what a condition counts as on an entity that is absent; it changes under NOT."""
    unknown: bool | None = None
    """Of a check: what a condition counts as that is unknown; it changes under NOT. Without: it is false."""
    due: bool | None = None
    """Whether an operator counts as true whose bound is not over at the end; it changes under NOT."""
    tried: tuple[bool, bool | None] | None = None
    """Of a check: what absent and unknown conditions within ``robustness`` count as, while it is tried."""
    taken: list[s.StepClause] = field(default_factory=list)
    """The steps of the match that :meth:`sequences` told last, in the order of its frames."""

    def __post_init__(self) -> None:
        self.slack = max(1000, self.period // 100)
        self.frames = self.trace.frames
        self.times = [frame.time_ns for frame in self.frames]
        self.searches = [Search(frame, frame.graph, injective=True) for frame in self.frames]

    def gap_before(self, i: int) -> bool:
        return (
            not self.bridge and self.times[i] - self.times[i - 1] > GAP * self.period + self.slack
        )

    # Conditions

    @once
    def true(self, e: Any, i: int, binding: Binding) -> bool:  # noqa: PLR0911 - a case each
        """A condition at a frame, unknown being false where time begins."""
        match e:
            case s.Logic(word="XOR", operands=(a, b)) if self.absent is not None:
                one, other = self.true(a, i, binding), self.true(b, i, binding)
                with self.under_not():
                    return (one and not self.true(b, i, binding)) or (
                        other and not self.true(a, i, binding)
                    )
            case s.Logic(word="NOT" | "IMPLIES" as word, operands=(first, *rest)) if (
                self.absent is not None
            ):
                with self.under_not():
                    failed = not self.true(first, i, binding)
                return failed or any(self.true(one, i, binding) for one in rest)
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
            case _ if self.absent is not None and self.is_away(e, i, binding):
                return self.absent
            case _ if self.unknown is not None and self.is_unknown(e, i, binding):
                return self.unknown
            case _ if self.absent is not None and self.tried is None and has_margins(e):
                ways = (self.value(e, i, binding) is True for _ in self.tries())
                return (any if self.absent else all)([*ways])
            case _ if is_temporal(e):
                return self.value(e, i, binding) is True
            case _:
                spoken = named_in(e)
                graph = self.frames[i].graph
                here = all(binding[name] in graph for name in spoken & set(binding))
                ways = self.with_edges(spoken, i, binding) if here else []
                return any(self.searches[i].value(e, way) is True for way in ways)

    def tries(self) -> Iterator[None]:
        """What an absent entity within ``robustness`` may count as, one after the other."""
        for absent in (True, False):
            self.tried = absent, self.unknown
            yield
            self.tried = None

    @contextmanager
    def under_not(self) -> Iterator[None]:
        """While the operand of a negation is looked at."""
        unknown = None if self.unknown is None else not self.unknown
        due = None if self.due is None else not self.due
        with self.counting(not self.absent, unknown, due=due):
            yield

    @contextmanager
    def counting(self, absent: bool, unknown: bool | None, *, due: bool | None) -> Iterator[None]:
        """While conditions count so."""
        before = self.absent, self.unknown, self.due, self.tried
        self.absent, self.unknown, self.due, self.tried = absent, unknown, due, None
        yield
        self.absent, self.unknown, self.due, self.tried = before

    def is_unknown(self, e: Any, i: int, binding: Binding) -> bool:  # noqa: PLR0911 - a case each
        """Whether a condition is about what is measured and was not recorded."""
        match e:
            case s.Call(name="coalesce" | "known") | s.Case() | s.NullTest() | s.Block():
                return False
            case s.Call(name="prev", arguments=(inner,)):
                return self.is_unknown(inner, i - 1, binding)
            case s.Call(name="delta", arguments=(inner, by)):
                return any(self.is_unknown(inner, j, binding) for j in (i, self.then(by, i)))
            case s.Call(name=name, arguments=(inner, by)) if name in WINDOWS:
                frames = (
                    j for j in self.last_frames(by, i) if not self.was_away(inner, j, binding)
                )
                return any(self.is_unknown(inner, j, binding) for j in frames)
            case s.Comparison() if any(
                isinstance(one, s.Call) and one.name in {"run_length", "since_true", "robustness"}
                for one in parts_of(e)
            ):
                told = set[Any]()
                for unknown in (True, False):
                    with self.counting(bool(self.absent), unknown, due=self.due):
                        ways = [self.value(e, i, binding) is True for _ in self.tries()]
                        told.add((any if self.absent else all)(ways))
                return len(told) > 1
            case s.Call(name=name) if normalize_name(name) in NUMBERS:
                return self.value(e, i, binding) is None and any(
                    self.value(s.AttributeOf(owner, column, e.span), i, binding) is None
                    for owner, columns in zip(
                        e.arguments, columns_needed(PROPER[normalize_name(name)]), strict=True
                    )
                    for column in columns & SIZES
                )
            case s.AttributeOf(owner=owner, name=name) if name in RECORDED:
                entity = self.trace.entities.get(binding[owner.name], {})
                still = name in MOVING and entity.get("static", False)
                return not still and self.value(e, i, binding) is None
            case _:
                return any(self.is_unknown(one, i, binding) for one in parts_within(e))

    def is_away(self, e: Any, i: int, binding: Binding) -> bool:
        """Whether a condition is about what is absent, a value without a past, or a pair without one."""
        graph = self.frames[i].graph
        if any(binding[name] not in graph for name in named_in(e) & set(binding)):
            return True
        if self.lacks_past(e, i, binding):
            return True
        if self.unknown is not None and self.is_unknown(e, i, binding):
            return False
        return has_pairs(e) and self.value(e, i, binding) is None

    def lacks_past(self, e: Any, i: int, binding: Binding) -> bool:  # noqa: PLR0911 - a case each
        match e:
            case s.Call(name="coalesce" | "known") | s.Case() | s.NullTest():
                return False
            case s.Call(name="prev", arguments=(inner,)):
                return i == 0 or self.gap_before(i) or self.was_away(inner, i - 1, binding)
            case s.Call(name="delta", arguments=(inner, by)):
                then = self.then(by, i)
                return then < 0 or self.was_away(inner, then, binding)
            case s.Call(name=name, arguments=(_, by)) if name in WINDOWS:
                if by.unit == "frames":
                    return len(self.last_frames(by, i)) < by.amount
                return by.ns > 0 and self.then(by, i) < 0
            case s.Call(name="run_length" | "since_true" | "age" | "robustness"):
                return False
            case _:
                inner = parts_within(e)
                return any(self.lacks_past(one, i, binding) for one in inner)

    def was_away(self, e: Any, i: int, binding: Binding) -> bool:
        return any(binding[n] not in self.frames[i].graph for n in named_in(e) & set(binding))

    def then(self, by: s.Duration, i: int) -> int:
        """The frame so long ago; -1: there is none without a gap."""
        if by.unit == "frames":
            then = i - int(by.amount)
        else:
            limit = self.times[i] - by.ns + self.slack
            then = max((j for j in range(i + 1) if self.times[j] <= limit), default=-1)
        broken = any(self.gap_before(j) for j in range(max(then, 0) + 1, i + 1))
        return -1 if then < 0 or broken else then

    def with_edges(self, spoken: set[str], i: int, binding: Binding) -> list[dict[str, Any]]:
        """A binding with the edges of a frame that its edge variables may be, in the order of the alphabet."""
        ways: list[dict[str, Any]] = [dict(binding)]
        for name in sorted(spoken & set(self.links)):
            edge, left, right = self.links[name]
            a, b = binding[left], binding[right]
            both = {"right": [(a, b)], "left": [(b, a)], "any": [(a, b), (b, a)]}[edge.direction]
            here = [way for way in both if {*way} <= set(self.frames[i].graph)]
            plain = replace(edge, properties=(), where=None)
            found = {r: t for way in here for r, t in self.searches[i].linked(plain, *way, {})}
            ways = [way | {name: Edge(r, found[r])} for way in ways for r in sorted(found)]
        return ways

    def tense(  # noqa: PLR0911 - a case each
        self, e: s.Temporal, i: int, binding: Binding
    ) -> bool:
        last = len(self.frames) - 1
        near = [j for j in range(last + 1) if self.within(e, i, j)]
        one = e.operands[-1]
        match e.word:
            case "NEXT" | "WEAKNEXT":
                if i < last:
                    return self.true(one, i + 1, binding)
                if self.due is None or waits(one):
                    return e.word == "WEAKNEXT"
                return self.due
            case "PREVIOUS":
                return i > 0 and self.true(one, i - 1, binding)
            case "ALWAYS" | "HISTORICALLY":
                held = all(self.true(one, j, binding) for j in near)
                return held and not self.is_due(e, i, counts_as=False)
            case "EVENTUALLY" | "ONCE":
                return any(self.true(one, j, binding) for j in near) or self.is_due(e, i)
            case "RELEASE":
                left = e.operands[0]
                ends = self.is_due(e, i, counts_as=False) and not any(
                    self.true(left, k, binding) for k in range(i, last + 1)
                )
                return not ends and all(
                    self.true(one, j, binding)
                    or any(self.true(left, k, binding) for k in range(i, j))
                    for j in near
                )
            case _:
                left = e.operands[0]
                between = (
                    (lambda j: range(i, j)) if e.word == "UNTIL" else lambda j: range(j + 1, i + 1)
                )
                still = self.is_due(e, i) and all(
                    self.true(left, k, binding) for k in range(i, last + 1)
                )
                return still or any(
                    self.true(one, j, binding)
                    and all(self.true(left, k, binding) for k in between(j))
                    for j in near
                )

    def is_due(self, e: s.Temporal, i: int, *, counts_as: bool = True) -> bool:
        """Whether an operator that looks ahead counts as true or false: its bound is not over at the end."""
        if self.due is not counts_as or e.word not in AHEAD or not e.bound or e.bound[1] is None:
            return False
        high = e.bound[1]
        if high.unit == "frames":
            return i + high.amount > len(self.frames) - 1
        return self.times[-1] - self.times[i] < high.ns - self.slack

    # Margins: by how much a condition is true

    @once
    def margin(self, e: Any, i: int, binding: Binding) -> float:  # noqa: C901, PLR0911 - a case each
        """By how much a condition holds at a frame: a comparison of numbers by their difference."""
        match e:
            case s.Logic(word="NOT" | "IMPLIES" | "XOR" as word, operands=operands) if (
                self.absent is not None
            ):
                ahead = [self.margin(operand, i, binding) for operand in operands]
                with self.under_not():
                    contrary = [-self.margin(operand, i, binding) for operand in operands]
                if word == "XOR":
                    return max(min(ahead[0], contrary[1]), min(contrary[0], ahead[1]))
                return max(contrary[0], *ahead[1:]) if ahead[1:] else contrary[0]
            case s.Logic(word=word, operands=operands):
                margins = [self.margin(operand, i, binding) for operand in operands]
                one, other = margins[0], margins[-1]
                return {
                    "NOT": -one,
                    "AND": min(margins),
                    "OR": max(margins),
                    "XOR": max(min(one, -other), min(-one, other)),
                    "IMPLIES": max(-one, other),
                }[word]
            case s.Temporal():
                return self.margin_over_time(e, i, binding)
            case s.Comparison() if self.absent is not None and self.is_away(e, i, binding):
                return math.inf if self.absent else -math.inf
            case s.Comparison() if self.unknown is not None and self.is_unknown(e, i, binding):
                return math.inf if self.unknown else -math.inf
            case s.Comparison() if (
                self.absent is not None and self.tried is None and has_margins(e)
            ):
                ways = [self.margin(e, i, binding) for _ in self.tries()]
                return max(ways) if self.absent else min(ways)
            case s.Comparison(word=word, left=left, right=right):
                spoken = named_in(e)
                graph = self.frames[i].graph
                here = all(binding[name] in graph for name in spoken & set(binding))
                if not (here or is_temporal(e)):
                    return -math.inf
                frames = isinstance(right, s.Duration) and right.unit == "frames"
                one = self.timed(left, right, i, binding)
                other = self.value(right, i, binding)
                if not all(isinstance(v, int | float) or v is None for v in (one, other)):
                    return math.inf if self.true(e, i, binding) else -math.inf
                if one is None or other is None:
                    return -math.inf
                timed = isinstance(left, s.Call) and left.name in TIMED and not frames
                apart = 0.0 if timed and abs(one - other) <= self.slack / 1e9 else one - other
                signs = {"<": -apart, "<=": -apart, ">": apart, ">=": apart}
                return {**signs, "=": -abs(apart), "<>": abs(apart)}[word]
            case _:
                return math.inf if self.true(e, i, binding) else -math.inf

    def margin_over_time(self, e: s.Temporal, i: int, binding: Binding) -> float:
        last = len(self.frames) - 1
        near = [j for j in range(last + 1) if self.within(e, i, j)]
        left, right = e.operands[0], e.operands[-1]

        def at(operand: Any, frames: Any) -> list[float]:
            return [self.margin(operand, j, binding) for j in frames]

        match e.word:
            case "NEXT" | "WEAKNEXT":
                end = -math.inf if e.word == "NEXT" else math.inf
                return at(right, [i + 1])[0] if i < last else end
            case "PREVIOUS":
                return at(right, [i - 1])[0] if i else -math.inf
            case "ALWAYS" | "HISTORICALLY":
                return min(at(right, near), default=math.inf)
            case "EVENTUALLY" | "ONCE":
                return max(at(right, near), default=-math.inf)
            case "RELEASE":
                return min(
                    (max(at(right, [j]) + at(left, range(i, j))) for j in near), default=math.inf
                )
            case "UNTIL":
                ways = (min(at(right, [j]) + at(left, range(i, j))) for j in near)
            case _:
                ways = (min(at(right, [j]) + at(left, range(j + 1, i + 1))) for j in near)
        return max(ways, default=-math.inf)

    def within(self, e: s.Temporal, i: int, j: int) -> bool:
        sign = 1 if e.word in AHEAD else -1
        if sign * (j - i) < 0:
            return False
        if e.bound is None:
            return True
        low, high = e.bound
        age = sign * (j - i) if low.unit == "frames" else sign * (self.times[j] - self.times[i])
        size = (lambda d: d.amount) if low.unit == "frames" else lambda d: d.ns
        slack = 0 if low.unit == "frames" else self.slack
        return size(low) - slack <= age and (high is None or age <= size(high) + slack)

    def either(self, e: Any, i: int, binding: Binding) -> Any:
        """A condition that looks at other frames, or a value, at a frame; what AND joins is each of its own."""
        if isinstance(e, s.Logic) and e.word == "AND" and is_temporal(e):
            known = [self.either(operand, i, binding) for operand in e.operands]
            return False if False in known else None if None in known else True
        logic = isinstance(e, s.Temporal | s.Logic) and is_temporal(e)
        return self.true(e, i, binding) if logic else self.value(e, i, binding)

    @once
    def value(self, e: Any, i: int, binding: Binding) -> Any:  # noqa: C901, PLR0911, PLR0912 - a case each
        """A value at a frame; ``None`` is NULL."""
        match e:
            case s.Comparison(word=word, left=left, right=right):
                frames = isinstance(right, s.Duration) and right.unit == "frames"
                one = self.timed(left, right, i, binding)
                other = self.value(right, i, binding)
                timed = isinstance(left, s.Call) and left.name in TIMED
                same = timed and not frames and one is not None
                if same and abs(one - other) <= self.slack / 1e9:
                    one = other
                return compare(word, one, other)
            case s.Duration(unit="frames", amount=amount):
                return amount
            case s.Duration():
                return e.ns / 1e9
            case s.Constant(value=value):
                return value
            case s.Arithmetic(first=first, rest=rest) if is_temporal(e):
                result = self.value(first, i, binding)
                for sign, term in rest:
                    result = arithmetic(sign, result, self.value(term, i, binding))
                return result
            case s.Case(branches=branches, otherwise=otherwise) if is_temporal(e):
                with self.certainly():
                    told = [b for b in branches if self.either(b.condition, i, binding) is True]
                chosen = told[0].value if told else otherwise
                return None if chosen is None else self.value(chosen, i, binding)
            case s.Call(name="prev", arguments=(inner,)):
                return None if i == 0 or self.gap_before(i) else self.value(inner, i - 1, binding)
            case s.Call(name="delta", arguments=(inner, by)):
                return self.delta(inner, by, i, binding)
            case s.Call(name=name, arguments=(inner, by)) if name in WINDOWS:
                frames = self.last_frames(by, i)
                told = [self.value(inner, j, binding) for j in frames]
                known = [value for value in told if value is not None]
                return WINDOWS[name](known) if known else None
            case s.Call(name="robustness", arguments=(inner,)):
                if self.absent is None:
                    return self.margin(inner, i, binding)
                absent, unknown = self.tried or (False, False)
                with self.counting(absent, self.unknown and unknown, due=None):
                    return self.margin(inner, i, binding)
            case s.Call(name="run_length", arguments=(inner,)):
                return len(self.run_up_to(inner, i, binding))
            case s.Call(name="since_true", arguments=(inner,)):
                with self.within_run():
                    past = [j for j in range(i + 1) if self.true(inner, j, binding)]
                return (self.times[i] - self.times[past[-1]]) / 1e9 if past else None
            case s.Call(name="age", arguments=(s.Variable(name=name),)):
                seen = [j for j in range(i + 1) if binding[name] in self.frames[j].graph]
                return (self.times[i] - self.times[seen[0]]) / 1e9 if i in seen else None
            case _ if any(binding[name] not in self.frames[i].graph for name in self.nodes_in(e)):
                return None
            case _:
                ways = self.with_edges(spoken_of(e), i, binding)
                return self.searches[i].value(e, ways[0]) if ways else None

    def nodes_in(self, e: Any) -> set[str]:
        return spoken_of(e) - set(self.links)

    def timed(self, e: Any, other: Any, i: int, binding: Binding) -> Any:
        """What is compared with something: a run with a time is as long as it lasts, and else its frames."""
        run_length = isinstance(e, s.Call) and e.name == "run_length"
        if not (run_length and isinstance(other, s.Duration) and other.unit != "frames"):
            return self.value(e, i, binding)
        run = self.run_up_to(e.arguments[0], i, binding)
        return (self.times[i] - self.times[run[0]]) / 1e9 if run else 0

    def run_up_to(self, e: Any, i: int, binding: Binding) -> list[int]:
        run: list[int] = []
        with self.within_run():
            while i >= 0 and self.true(e, i, binding):
                run.insert(0, i)
                if self.gap_before(i) or i == 0:
                    break
                i -= 1
        return run

    def within_run(self) -> Any:
        """While a condition of ``run_length`` is looked at: in a check who is absent ends the run."""
        if self.absent is None:
            return nullcontext()
        return self.counting(absent=False, unknown=self.unknown, due=None)

    def certainly(self) -> Any:
        """While a condition of ``CASE`` is looked at: in a check it must be known to be true."""
        if self.absent is None:
            return nullcontext()
        return self.counting(absent=False, unknown=self.unknown and False, due=None)

    def last_frames(self, by: s.Duration, i: int) -> list[int]:
        """The frames of a window, back to a gap."""
        back = next((j for j in range(i, 0, -1) if self.gap_before(j)), 0)
        if by.unit == "frames":
            return [j for j in range(back, i + 1) if i - j < by.amount]
        limit = by.ns + self.slack
        return [j for j in range(back, i + 1) if self.times[i] - self.times[j] <= limit]

    def delta(self, inner: Any, by: s.Duration, i: int, binding: Binding) -> Any:
        if by.unit == "frames":
            then = i - int(by.amount)
        else:
            then = self.times[i] - by.ns + self.slack
            past = [j for j in range(i + 1) if self.times[j] <= then]
            then = past[-1] if past else -1
        if then < 0 or any(self.gap_before(j) for j in range(then + 1, i + 1)):
            return None
        now, before = self.value(inner, i, binding), self.value(inner, then, binding)
        if now is None or before is None:
            return None
        if not (isinstance(inner, s.AttributeOf) and inner.name == "heading_error"):
            return now - before
        way = [self.value(inner, j, binding) for j in range(then, i + 1)]
        steps = pairwise(way)
        return wrapped(now - before) if None in way else sum(wrapped(b - a) for a, b in steps)

    def ever(self, label: str) -> list[int]:
        """What has a label, of the trace and of its map, in any frame."""
        asked = s.Label(label, TextSpan(0, 0))
        return sorted(
            {n for search in self.searches for n in search.graph if search.labelled(n, asked)}
        )

    def verdict(self, statement: s.CheckClause) -> str:
        """The verdict of a check of the ego, or of it and each or some v."""
        if not self.checked(statement, unknown=True, due=True)[0]:
            return "pending" if self.waits(statement) else "false"
        if self.checked(statement, unknown=False)[0]:
            return "true"
        pending = self.checked(statement, unknown=False, due=True)[0]
        return "pending" if pending else "unknown"

    def waits(self, statement: s.CheckClause) -> bool:
        """Whether v may be one who comes later: what is due of one who is in no frame so far."""
        if "FORSOME" not in {one.word for one in statement.quantifiers}:
            return False
        binding = {"v": -98, "ego": self.trace.ego if self.trace.ego is not None else -99}
        with self.counting(False, True, due=True):
            due = self.true(statement.formula, 0, binding)
        with self.counting(False, False, due=None):
            return due and not self.true(statement.formula, 0, binding)

    def checked(
        self, statement: s.CheckClause, *, unknown: bool | None = None, due: bool | None = None
    ) -> tuple[bool, float]:
        """Whether a check of the ego, or of it and each or some v, is met, and by how much."""
        # The signs of the map are entities, too.
        domain = self.ever("Entity")
        ego = self.trace.ego if self.trace.ego in domain else -99
        spoken = named_in(statement.formula)
        if "ego" in spoken:
            domain = [node for node in domain if node != ego]
        asked = {one.word for one in statement.quantifiers}
        bindings = [{"v": v, "ego": ego} for v in domain] if asked else [{"ego": ego}]
        with self.counting("FORSOME" not in asked, unknown, due=due):
            values = [self.true(statement.formula, 0, binding) for binding in bindings]
            margins = [self.margin(statement.formula, 0, binding) for binding in bindings]
        if "FORSOME" in asked:
            best = max(margins, default=-math.inf)
            if best == -math.inf:  # who is absent is no infinite fault
                with self.counting(absent=True, unknown=unknown, due=due):
                    others = [self.margin(statement.formula, 0, binding) for binding in bindings]
                best = min(max(others, default=best), 0.0)
            return any(values), best
        return all(values), min(margins, default=math.inf)

    # Sequences

    def holds(self, step: s.StepClause, known: set[str]) -> set[tuple[int, tuple[Any, ...]]]:
        """Frames and bindings in which a step's pattern and conditions hold; some names are those of others."""
        key = "holds", id(step), *sorted(known)
        if key not in self.known:
            self.known[key] = step, self.held(step, known)
        return self.known[key][1]

    def held(self, step: s.StepClause, known: set[str]) -> set[tuple[int, tuple[Any, ...]]]:
        told = named_in(step.block.where) & known
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

    def lasts(self, hold: s.HoldClause, i: int, binding: Any, found: set[Any]) -> bool:
        run = self.run(i, {j for j, b in found if b == binding})
        if hold.duration.unit == "frames":
            return compare(hold.comparison, len(run), hold.duration.amount)
        length = self.times[run[-1]] - self.times[run[0]] + (self.period if hold.inclusive else 0)
        if abs(length - hold.duration.ns) <= self.slack:
            length = hold.duration.ns
        return compare(hold.comparison, length, hold.duration.ns)

    def run(self, i: int, frames: set[int]) -> list[int]:
        first, last = i, i
        while first - 1 in frames and not self.gap_before(first):
            first -= 1
        while last + 1 in frames and not self.gap_before(last + 1):
            last += 1
        return list(range(first, last + 1))

    def sequences(
        self, sequence: s.SequenceClause, policy: str
    ) -> Iterator[tuple[Binding, list[int], int]]:
        """Every match: the binding, the frames of the steps, and the frame at which it ends."""
        if any(isinstance(step, s.GroupStep) for step in sequence.steps):
            yield from self.expressions(sequence, policy)
            return
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
                self.taken = [step for step in steps if not step.absent]
                yield binding, best, end
                if policy == "first":
                    break

    def expressions(
        self, sequence: s.SequenceClause, policy: str
    ) -> Iterator[tuple[Binding, list[int], int]]:
        """The same of an expression of steps: one match for each binding, first step, and run of it."""
        ways = [*spelled_out(sequence)]
        visible = visible_names(sequence)
        every: dict[Any, list[tuple[list[int], int, int, Binding]]] = {}
        for place, (steps, links) in enumerate(ways):
            known = set().union(*(names_of(step) for step in steps if not step.absent))
            held = [self.holds(step, known) for step in steps]
            for binding in self.bindings(
                [h for h, step in zip(held, steps, strict=True) if not step.absent]
            ):
                own = [{i for i, b in h if agrees(dict(b), binding)} for h in held]
                seen = tuple(sorted((k, v) for k, v in binding.items() if k in visible))
                for run in self.runs(own[0]):
                    for t in (t for i in run for t in self.tuples(steps, links, own, [i])):
                        last = max(n for n, step in enumerate(steps) if not step.absent)
                        end = self.run(t[-1], own[last])[-1] if steps[last].hold else t[-1]
                        group = seen if policy == "first" else (seen, steps[0].span, run[0])
                        every.setdefault(group, []).append((t, place, end, dict(seen)))
        for found in every.values():
            best = min(found, key=lambda one: one[:2])
            if policy == "longest":
                begin = [one for one in found if one[0][0] == best[0][0]]
                best = max(begin, key=lambda one: (one[0], -one[1]))
            self.taken = [step for step in ways[best[1]][0] if not step.absent]
            yield best[3], best[0], best[2]

    def over(self, e: s.OverExpression, span: tuple[int, int], binding: Binding) -> Any:
        """A value over some frames, both ends included."""
        assert isinstance(e.call, s.Call)
        word, (operand, *more) = e.call.name.upper(), e.call.arguments
        frames = list(range(span[0], span[1] + 1))
        if word in {"FIRST", "LAST"}:
            return self.value(operand, frames[0 if word == "FIRST" else -1], binding)
        told = [(self.value(operand, i, binding), i) for i in frames]
        known = [(value, i) for value, i in told if value is not None]
        if not known:
            return None
        values = [value for value, _ in known]
        if word in {"SUM", "AVG"}:
            return math.fsum(values) / (len(values) if word == "AVG" else 1)
        best = (min if word.endswith("MIN") else max)(values)
        if not word.startswith("ARG"):
            return best
        at = next(i for value, i in known if value == best)
        return self.value(more[0], at, binding) if more else self.seconds(at)

    def beside(self, e: Any, span: Any, i: int, binding: Binding) -> Any:
        """A value over some frames, or one of a frame less such a value."""
        if isinstance(e, s.OverExpression):
            frames = span(e)
            return None if frames is None else self.over(e, frames, binding)
        ((_, over),) = e.rest
        return arithmetic(
            "-", self.value(e.first, i, binding), self.over(over, span(over), binding)
        )

    def seconds(self, i: int) -> float:
        return (self.times[i] - self.times[0]) / 1e9

    def spans(
        self, binding: Binding, frames: list[int], end: int
    ) -> dict[tuple[str, str], tuple[int, int]]:
        """The frames of a match, by the names of the steps that a part of it begins and ends with."""
        steps = self.taken
        known = set().union(*map(names_of, steps))
        found = {("", ""): (frames[0], end)}
        for n, one in enumerate(steps):
            own = {i for i, b in self.holds(one, known) if agrees(dict(b), binding)}
            run = self.run(frames[n], own)
            found[one.name, ""] = run[0], run[-1]
            found |= {
                (one.name, later.name): (frames[n], frames[m])
                for m, later in enumerate(steps)
                if m > n
            }
        return found

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
        self,
        steps: list[s.StepClause],
        links: tuple[s.LinkClause, ...],
        own: list[set[int]],
        so_far: list[int],
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

    def linked(self, link: s.LinkClause, i: int, j: int, before: set[int]) -> bool:  # noqa: PLR0911
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
        return self.times[j] - self.times[i] >= link.after.ns - self.slack

    def not_later(self, i: int, j: int, limit: Any) -> bool:
        if limit is None:
            return True
        if limit.unit == "frames":
            return j - i <= limit.amount
        return self.times[j] - self.times[i] <= limit.ns + self.slack


Way = tuple[list[s.StepClause], tuple[s.LinkClause, ...]]


def spelled_out(sequence: s.SequenceClause) -> list[Way]:
    """All sequences that an expression of steps stands for, in the order in which they are written."""
    found: list[Way] = [([], ())]
    for number, step in enumerate(sequence.steps):
        more = ways_of(step) if isinstance(step, s.GroupStep) else [([step], ())]
        link = sequence.links[number - 1 : number] if number else ()
        found = [(a + b, (*x, *link, *y)) for a, x in found for b, y in more]
    return found


def ways_of(group: s.GroupStep) -> list[Way]:
    once = [way for one in group.alternatives for way in spelled_out(one)]
    again = s.LinkClause("then", None, None, group.span)
    found: list[Way] = []
    for times in range(group.low, group.high + 1):
        for chosen in product(once, repeat=times):
            links = [link for _, own in chosen for link in (again, *own)][1:]
            found.append(([step for steps, _ in chosen for step in steps], tuple(links)))
    return found


def many_ways(sequence: s.SequenceClause) -> int:
    """How many sequences an expression of steps stands for."""
    found = 1
    for step in sequence.steps:
        if isinstance(step, s.GroupStep):
            once = sum(map(many_ways, step.alternatives))
            found *= sum(once**times for times in range(step.low, step.high + 1))
    return found


def visible_names(sequence: s.SequenceClause) -> set[str]:
    """Names that every sequence binds."""
    ways = [steps for steps, _ in spelled_out(sequence)]
    return set.intersection(
        *(set().union(*(names_of(s) for s in steps if not s.absent)) for steps in ways)
    )


def wrapped(degrees: float) -> float:
    return (degrees + 180) % 360 - 180


def names_of(step: s.StepClause) -> set[str]:
    """The names that a step's pattern binds."""
    nodes = (p for p in parts_of(step.block.paths) if isinstance(p, s.NodePattern))
    return {node.name for node in nodes if node.name}


@remembered
def named_in(e: Any) -> set[str | None]:
    """The names of variables and nodes of patterns."""
    return {part.name for part in parts_of(e) if isinstance(part, s.Variable | s.NodePattern)}


@remembered
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
    "HAPPENS collision(e)",
)
PAIRS = (
    "HAPPENS collision(e, v)",
    "v.speed > 0.5",
    "dist(e, v) < 6",
    "EXISTS {(e)-[:near]->(v)}",
    "v.speed < e.speed",
)
COURSES = (
    "prev(e.speed) < e.speed",
    "delta(e.x, 0.2s) > 0",
    "delta(e.speed, 2frames) >= 0",
    "run_length(e.speed > 0.5) >= 2frames",
    "run_length(e.speed > 0.5) >= 0.1s",
    "since_true(e.speed > 2) <= 0.2s",
    "age(e) > 0.2s",
    "delta(e.speed, 0.2s) > 1 - 0.5 * 2",
    "prev(e.speed) < abs(-1) + e.speed / 2",
    "prev(e.speed) * 4 < frame.t + 1",
    "min_over(e.speed, 0.3s) > 0.5",
    "max_over(e.speed, 3frames) > e.speed",
    "avg_over(e.speed, 0.2s) >= e.speed",
    "sum_over(e.x, 0.5s) > 3 * sum_over(e.speed, 2frames)",
    "robustness(e.speed > 1 OR NOT e.x < 99) >= 0.5",
    "CASE WHEN prev(e.speed) < e.speed THEN delta(e.x, 0.2s) WHEN ONCE e.speed > 2 THEN e.x END > 1",
    "CASE WHEN run_length(e.speed > 0.5) >= 2frames THEN prev(e.speed) ELSE 2 END > 1",
)
PAIR_COURSES = (
    "min_over(dist(e, v), 0.4s) < 6",
    "avg_over(dist(e, v), 3frames) < max_over(dist(e, v), 0.1s)",
    "sum_over(e.speed - v.speed, 0.3s) > 0",
    "prev(dist(e, v)) > dist(e, v)",
    "exists_now(v)",
    "age(v) >= 0.1s",
    "robustness(dist(e, v) < 6 AND v.speed > 0.5) > -1",
)
MARGINS = (
    "robustness(EVENTUALLY[0s, 0.3s] (dist(e, v) > 6 AND e.speed > 1)) > -2",
    "robustness(e.speed > 1 SINCE v.speed < 2) < robustness(WEAKNEXT v.speed > 1)",
    "robustness(ALWAYS[0s, 0.2s] prev(e.speed) > 1) - robustness(HISTORICALLY e.speed < 3) > 0.5",
)
"""What a monitor does not know at once."""
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


def random_expression(rng: random.Random) -> str:
    """An expression of steps, with alternatives and repetitions."""
    first = rng.choice(FIRST)
    pair = "(v" in first

    def step(start: str) -> str:
        text = start
        if rng.random() < 0.5:
            temporal = rng.random() < 0.15
            text += f" WHERE {condition(rng, pair, rng.randint(0, 1), temporal=temporal)}"
        return text + rng.choice(HOLDS)

    def later() -> str:
        return step(rng.choice([one for one in LATER if pair or "(v" not in one]))

    def some(depth: int, start: str = "") -> str:
        parts = [start or (group(depth) if rng.random() < 0.5 else later())]
        for _ in range(rng.choice((0, 0, 1, 1, 2) if depth else (1, 1, 2))):
            link = rng.choice(THEN)
            if link == "THEN" and rng.random() < 0.15:
                parts.append(f"THEN NOT {step('MATCH (e)').split(' FOR ')[0]}")
            parts += [link, group(depth + 1) if rng.random() < 0.5 else later()]
        return " ".join(parts)

    def group(depth: int) -> str:
        many = rng.choice((1, 2, 2))
        inner = [later() if depth > 1 else some(depth + 1, later()) for _ in range(many)]
        often = rng.choice(("", "", "{2}", "{1,2}", "{1,3}", "{2,3}"))
        return f"({' | '.join(inner)}){often}"

    if rng.random() < 0.3:  # the first step is one of several, or repeated
        starts = " | ".join(step(first) for _ in range(rng.choice((1, 2))))
        return f"({starts}){rng.choice(('', '{1,2}'))} {rng.choice(THEN)} {some(1, later())}"
    text = some(0, step(first))
    return text if "(MATCH" in text else f"{text} THEN {group(0)}"


def short_expression(rng: random.Random) -> str:
    """An expression of steps that stands for few sequences, so that all of them can be tried."""
    while True:
        text = random_expression(rng)
        (statement,) = parse(text)
        assert isinstance(statement, s.MatchClause)
        if many_ways(statement.sequence) <= 12:
            return text


def compare_expression(world: World, store: Store, rng: random.Random, text: str = "") -> int:
    """Ask an expression of steps of a store, frame by frame, and by definition; how many matches there are."""
    text, policy = text or short_expression(rng), rng.choice(("all", "first", "longest"))
    (statement,) = parse(text)
    assert isinstance(statement, s.MatchClause)
    names = sorted(visible_names(statement.sequence))
    using = f"USING UNKNOWN false, MATCHES {policy}"
    found = Counter(
        (i.trace, i.start_seq, i.end_seq, *(i.values[name] for name in names))
        for i in store.find(f"{using} {text}").intervals()
    )
    expected: Counter[Any] = Counter()
    lasts: Counter[Any] = Counter()
    for trace in world.traces:
        told = Told(trace, periods(store)[trace.name])
        for binding, frames, end in told.sequences(statement.sequence, policy):
            nodes = tuple(binding[name] for name in names)
            expected[trace.name, trace.frames[frames[0]].seq, trace.frames[end].seq, *nodes] += 1
            lasts[trace.name, tuple(frames), nodes] += 1
    assert set(found) == set(expected), (policy, text, found - expected, expected - found)
    seen = steps_watched(world, f"{using} {text}", names, periods(store))
    assert seen == lasts, (policy, text, seen - lasts, lasts - seen)
    return sum(lasts.values())


def events_of(trace: Trace, text: str, period: dict[str, int]) -> list[MonitorEvent]:
    """What is told of a trace frame by frame."""
    events: list[MonitorEvent] = []
    about = {"on_event": events.append, "trace": trace.name}
    monitor = Monitor(text, period_s=period[trace.name] / 1e9, **about)
    for frame in trace.frames:
        monitor.look([graph_of(frame)])
    monitor.finish()
    return events


def steps_watched(
    world: World, text: str, names: list[str], period: dict[str, int]
) -> Counter[Any]:
    """The matches of a sequence, frame by frame: trace, frames of the steps, nodes of some names."""
    return Counter(
        (trace.name, tuple(step.seq for step in e.steps), tuple(e.nodes[name] for name in names))
        for trace in world.traces
        for e in events_of(trace, text, period)
    )


def expressions(seeds: range, questions: int, folder: Path) -> int:
    """Ask so many expressions of steps of each of some worlds; how many matches they had."""
    found = 0
    for seed in seeds:
        world, store = worlds(seed, folder)
        rng = random.Random(f"expressions {seed}")
        found += sum(compare_expression(world, store, rng) for _ in range(questions))
    return found


@lru_cache(4)
def periods(store: Store) -> dict[str, int]:
    return {trace.name: trace.period_ns for trace in store.info()}


def compare_sequence(world: World, store: Store, text: str, policy: str, written: str = "") -> int:
    """Ask a sequence both ways; how many matches there are. ``written``: what is asked of the store for it."""
    (statement,) = parse(text)
    assert isinstance(statement, s.MatchClause)
    steps = [step for step in statement.sequence.steps if isinstance(step, s.StepClause)]
    names = sorted(set().union(*(names_of(step) for step in steps if not step.absent)))
    times = [f"t({step.name})" for step in steps if step.name]
    using = f"USING UNKNOWN false, MATCHES {policy} "
    query = written.replace("{}", using) if written else using + text
    found = Counter(
        tuple(row) for row in store.find(f"{query} RETURN trace.name, {', '.join(names + times)}")
    )
    spans = Counter(
        (i.trace, i.start_seq, i.end_seq, *(i.values[name] for name in names))
        for i in store.find(query).intervals()
    )
    expected: Counter[Any] = Counter()
    expected_spans: set[Any] = set()
    lasts: Counter[Any] = Counter()
    period = periods(store)
    for trace in world.traces:
        told = Told(trace, period[trace.name])
        for binding, frames, end in told.sequences(statement.sequence, policy):
            nodes = tuple(binding[name] for name in names)
            start = told.times[0]
            expected[trace.name, *nodes, *((told.times[i] - start) / 1e9 for i in frames)] += 1
            seqs = (trace.frames[frames[0]].seq, trace.frames[end].seq)
            expected_spans.add((trace.name, *seqs, *nodes))
            lasts[trace.name, tuple(frames), nodes] += 1
    assert found == expected, (text, found - expected, expected - found)
    seen = steps_watched(world, query, names, period)
    assert seen == lasts, (query, seen - lasts, lasts - seen)
    assert set(spans) == expected_spans, (text, set(spans) ^ expected_spans)
    return sum(expected.values())


def compare_condition(world: World, store: Store, rng: random.Random, where: str = "") -> int:
    """Ask a pattern with a condition over time both ways; how many rows there are."""
    where = where or condition(rng, pair=True, depth=rng.randint(1, 3), temporal=True)
    value = f"ONCE[0s, 0.2s] ({condition(rng, pair=True, depth=1, temporal=True)})"
    return compare_values(world, store, where, [value])


def compare_values(world: World, store: Store, where: str, values: Sequence[str]) -> int:
    """Ask values of the frames in which a condition holds both ways; how many rows there are."""
    told_as = ", ".join(f"{value} AS y{n}" for n, value in enumerate(values))
    text = f"MATCH (e:Ego), (v:Entity) WHERE {where} RETURN trace.name, frame.seq, e, v, {told_as}"
    found = Counter(tuple(row) for row in store.find(f"USING UNKNOWN false {text}"))
    (statement,) = parse(text)
    assert isinstance(statement, s.MatchClause)
    assert statement.returns is not None
    asked = [item.value for item in statement.returns.items[4:]]
    expected: Counter[Any] = Counter()
    period = periods(store)
    for trace in world.traces:
        told = Told(trace, period[trace.name])
        step = s.StepClause(
            statement.block, absent=False, hold=None, name=None, span=statement.span
        )
        for i, binding in told.holds(step, {"e", "v"}):
            nodes = dict(binding)
            row = [told.either(value, i, nodes) for value in asked]
            expected[trace.name, trace.frames[i].seq, nodes["e"], nodes["v"], *row] += 1
    assert found == expected, differing(text, found, expected)
    return sum(expected.values())


OPERANDS = ("e.speed", "e.x", "frame.t", "delta(e.x, 0.2s)", "since_true(e.speed > 2)")
PAIR_OPERANDS = (
    "v.speed",
    "dist(e, v)",
    "e.speed - v.speed",
    "avg_over(v.x, 0.2s)",
    "age(v)",
    "prev(v.speed)",
)
OVER = ("MIN", "MAX", "AVG", "SUM", "FIRST", "LAST", "ARGMIN", "ARGMAX")


def over_values(
    rng: random.Random, names: Sequence[str], *, pair: bool, many: int = 4
) -> list[str]:
    """Values over a match whose steps have these names, which are told in their order."""
    found: list[str] = []
    for _ in range(many):
        operands = OPERANDS + (PAIR_OPERANDS * 2 if pair else ())
        word, operand = rng.choice(OVER), rng.choice(operands)
        more = f", {rng.choice(operands)}" if word[:3] == "ARG" and rng.random() < 0.5 else ""
        part = rng.choice(("match", *names))
        if len(names) > 1 and rng.random() < 0.3:
            part = "..".join(sorted(rng.sample(names, 2)))
        found.append(f"{word}({operand}{more}) OVER {part}")
    found.append(f"{rng.choice(('e.x', 'prev(e.x)'))} - {rng.choice(OVER[:4])}(e.x) OVER match")
    return found


def named_expression(rng: random.Random) -> tuple[str, list[str]]:
    """An expression of steps of which those that are not repeated have names, and the names of one way."""
    while True:
        text = short_expression(rng)
        (statement,) = parse(text)
        assert isinstance(statement, s.MatchClause)
        ends = once_only(statement.sequence)
        if len(ends) > 1:
            break
    for number, end in reversed([*enumerate(ends)]):
        text = f"{text[:end]} AS s{number}{text[end:]}"
    (statement,) = parse(text)
    assert isinstance(statement, s.MatchClause)
    steps, _ = rng.choice([*spelled_out(statement.sequence)])
    return text, [step.name for step in steps if step.name]


def once_only(sequence: s.SequenceClause) -> list[int]:
    """Where the steps of an expression end that are not repeated."""
    found: list[int] = []
    for step in sequence.steps:
        if isinstance(step, s.GroupStep):
            inner = step.alternatives if step.high == 1 else ()
            found += [end for one in inner for end in once_only(one)]
        elif not step.absent:
            found.append(step.span.end)
    return found


def compare_over_sequence(
    world: World, store: Store, rng: random.Random, *, many: int = 4, expression: bool = False
) -> int:
    """Ask values over the matches of a sequence, or of an expression of steps; how many there are."""
    text, names = named_expression(rng) if expression else (random_sequence(rng), [])
    names = names or re.findall(r" AS (s\d)", text)
    policy = rng.choice(("all", "first", "longest"))
    asked = over_values(rng, names, pair="(v" in text, many=many)
    returns = ", ".join(
        [f"t({name})" for name in names] + [f"{value} AS y{n}" for n, value in enumerate(asked)]
    )
    bridge = len(text) % 4 == 0
    using = f"USING UNKNOWN false, MATCHES {policy}" + ", GAPS bridge" * bridge
    query = f"{using} {text} RETURN trace.name, {returns}"
    found = Counter(rounded_row(row) for row in store.find(query))
    (statement,) = parse(query)
    assert isinstance(statement, s.MatchClause)
    assert statement.returns is not None
    values = [item.value for item in statement.returns.items[1 + len(names) :]]
    expected: Counter[Any] = Counter()
    for trace in world.traces:
        told = Told(trace, periods(store)[trace.name], bridge=bridge)
        for binding, frames, end in told.sequences(statement.sequence, policy):
            spans = told.spans(binding, frames, end)
            times = {step.name: told.seconds(i) for step, i in zip(told.taken, frames, strict=True)}
            parts = partial(lambda e, spans: spans.get(part_of(e)), spans=spans)
            row = [told.beside(one, parts, frames[-1], binding) for one in values]
            expected[rounded_row((trace.name, *map(times.get, names), *row))] += 1
    assert found == expected, differing(query, found, expected)
    seen = Counter(row for trace in world.traces for row in watched(trace, query, periods(store)))
    assert seen == expected, differing(f"online {query}", seen, expected)
    return sum(expected.values())


def watched(trace: Trace, text: str, period: dict[str, int]) -> Iterator[tuple[Any, ...]]:
    """The values of what is found in a trace frame by frame."""
    events = events_of(trace, text, period)
    return (rounded_row((trace.name, *event.values.values())) for event in events)


def graph_of(frame: Frame) -> SceneGraph:
    edges = [
        (src, relation, dst, {k: v for k, v in data.items() if k != "relation"})
        for src, dst, relation, data in frame.graph.edges(keys=True, data=True)
    ]
    about = frame.frame_id, frame.trace.name, frame.seq, frame.time_ns, frame.ego
    graph = SceneGraph(*about, dict(frame.graph.nodes(data=True)), edges)
    events: dict[str, list[Any]] = {kind: [] for kind in frame.trace.records}
    for kind, a, b in frame.events:
        events[kind].append((a, b))
    return replace(graph, events=events)


def part_of(e: Any) -> tuple[str, str]:
    return (e.start.name if e.start else "", e.end.name if e.end else "")


def differing(text: str, found: Counter[Any], wanted: Counter[Any]) -> str:
    """A query whose rows differ, and in which columns the first of them that is most alike does."""
    more, less = [*(found - wanted)], [*(wanted - found)]
    if not (more and less):
        return f"{text}: too many {more[:3]}, missing {less[:3]}"
    alike = max(less, key=lambda row: sum(a == b for a, b in zip(row, more[0], strict=True)))
    columns = [
        (n, *both) for n, both in enumerate(zip(more[0], alike, strict=True)) if both[0] != both[1]
    ]
    return f"{text}: {len(more)} rows differ, such as {more[0]}: column, found, wanted {columns}"


def rounded_row(row: Any) -> tuple[Any, ...]:
    """Numbers to five decimals, and of large ones nine digits."""
    return tuple(
        (round(v, 5) if abs(v) < 1e4 else float(f"{v:.9g}")) + 0.0
        if isinstance(v, int | float)
        else v
        for v in row
    )


def compare_over_pattern(
    world: World, store: Store, rng: random.Random, asked: Sequence[str] = (), pattern: str = ""
) -> int:
    """Ask values over the runs of a pattern's matches both ways; how many rows there are."""
    asked = asked or over_values(rng, [], pair=True)
    pattern = pattern or "(e:Ego), (v:Entity)"
    pair = "(v:Lane)" not in pattern
    where = condition(rng, pair=pair, depth=rng.randint(0, 1), temporal=rng.random() < 0.3)
    bridge = len(where) % 4 == 0
    using = "USING UNKNOWN false" + ", GAPS bridge" * bridge
    text = f"{using} MATCH {pattern} WHERE {where} RETURN trace.name, frame.seq, e, v, "
    text += ", ".join(f"{value} AS y{n}" for n, value in enumerate(asked))
    found = Counter(rounded_row(row) for row in store.find(text))
    (statement,) = parse(text)
    assert isinstance(statement, s.MatchClause)
    assert statement.returns is not None
    values = [item.value for item in statement.returns.items[4:]]
    expected: Counter[Any] = Counter()
    runs: Counter[Any] = Counter()
    for trace in world.traces:
        told = Told(trace, periods(store)[trace.name], edges_of(statement.block), bridge=bridge)
        step = replace(statement.sequence.steps[0], hold=None)
        held = told.holds(step, {"e", "v"})
        frames: dict[Any, set[int]] = {}
        for i, nodes in held:
            frames.setdefault(nodes, set()).add(i)
        rows: dict[Any, Any] = {}
        for i, nodes in held:
            binding = dict(nodes)
            run = told.run(i, frames[nodes])
            if any(isinstance(one, s.Arithmetic) for one in values) or (nodes, run[0]) not in rows:
                parts = partial(lambda _, ends: ends, ends=(run[0], run[-1]))
                rows[nodes, run[0]] = [told.beside(one, parts, i, binding) for one in values]
            row = rows[nodes, run[0]]
            seq = trace.frames[i].seq
            expected[rounded_row((trace.name, seq, binding["e"], binding["v"], *row))] += 1
            runs[rounded_row((trace.name, *row))] += i == run[0]
    assert found == expected, differing(text, found, expected)
    seen = Counter(row for trace in world.traces for row in watched(trace, text, periods(store)))
    assert seen == +runs, differing(f"online {text}", seen, +runs)
    return sum(expected.values())


def edges_of(block: s.Block) -> dict[str, tuple[s.EdgePattern, str, str]]:
    """The edge variables of a pattern: the edge, and the names of the nodes to its left and right."""
    names = {id(node): node.name or "" for path in block.paths for node in path.nodes}
    return {one.name: (one, names[a], names[b]) for one, a, b in links_of(block) if one.name}


def compare_over_check(world: World, store: Store, rng: random.Random, *, many: int = 4) -> int:
    """Ask values over the violations of a check both ways; how many there are."""
    check = random_check(rng)
    pair = "(v:Entity)" in check
    if rng.random() < 0.7:
        reset = condition(rng, pair, rng.randint(0, 1), temporal=False)
        check += " RESET WHEN " + re.sub(r"\be\b", "ego", reset)
    asked = [re.sub(r"\be\b", "ego", one) for one in over_values(rng, [], pair=pair, many=many)]
    asked += [rng.choice(("ego.speed", "prev(ego.x)", "frame.t"))]
    returns = ", ".join(f"{value} AS y{n}" for n, value in enumerate(asked))
    text = f"USING UNKNOWN false {check} RETURN {returns}"
    (statement,) = parse(text)
    assert isinstance(statement, s.CheckClause)
    values = [item.value for item in statement.returns]
    many = 0
    for verdict in store.check(text):
        (trace,) = (one for one in world.traces if one.name == verdict.trace)
        told = Told(trace, periods(store)[trace.name])
        place = {frame.seq: number for number, frame in enumerate(trace.frames)}
        known = [(one, one.violations) for one in verdict.witnesses]
        alone = [] if pair else [(None, verdict.violations)]
        for witness, violations in known or alone:
            binding = {"ego": trace.ego, **(dict(witness.nodes) if witness else {})}
            for one in violations:
                span = place[one.start_seq], place[one.end_seq]
                parts = partial(lambda _, ends: ends, ends=span)
                row = [told.beside(e, parts, span[0], binding) for e in values[:-1]]
                row.append(told.value(values[-1], span[0], binding))
                found = (one.values[f"y{n}"] for n in range(len(values)))
                wanted = rounded_row(row)
                assert rounded_row(found) == wanted, (text, trace.name, one, wanted)
                many += 1
        seen = violations_watched(trace, text, periods(store))
        stored = Counter((*i, v) for _, found in known for i, v in spans_of(found, trace))
        if known:
            assert seen == stored, (text, trace.name, seen - stored, stored - seen)
    return many


def violations_watched(trace: Trace, text: str, period: dict[str, int]) -> Counter[Any]:
    """The violations of a check, with what is returned of them, frame by frame."""
    monitor = Monitor(text, period_s=period[trace.name] / 1e9, trace=trace.name)
    for frame in trace.frames:
        monitor.look([graph_of(frame)])
    (verdict,) = monitor.finish()
    found = [span for one in verdict.witnesses for span in one.violations]
    return Counter(
        (i.start_seq, i.end_seq, rounded_row(v for k, v in i.values.items() if k[0] == "y"))
        for i in found
    )


def spans_of(found: Any, trace: Trace) -> Iterator[tuple[tuple[int, int], Any]]:
    place = {frame.seq: number for number, frame in enumerate(trace.frames)}
    for i in found:
        values = rounded_row(v for k, v in i.values.items() if k[0] == "y")
        yield (place[i.start_seq], place[i.end_seq]), values


EDGES = (
    ("(e:Ego)-[d:near|visible]->(v:Entity)", ("type(d)",)),
    ("(e:Ego)-[d:near|visible|isIn]-(v)", ("type(d)",)),
    ("(v:Entity)<-[d:inDFrontOf]-(e:Ego)", ("type(d)",)),
    *(
        (f"(v:Entity){way}(e:Ego)", ("type(r)", "r.gap"))
        for way in ("-[r:follows]->", "<-[r:leads]-")
    ),
    (
        "(e:Ego)-[r:isIn]->(v:Lane)",
        ("r.overlap", "r.offset", "r.heading_error", "r.along", "r.primary", "r.is_own", "type(r)"),
    ),
)
"""Patterns with an edge variable, and what there is to be asked of it."""


def edge_questions(rng: random.Random) -> Iterator[tuple[str, str, list[str]]]:
    """A pattern, a condition, and values: every attribute of an edge in every operator and function of time."""
    for pattern, values in EDGES:
        for value in values:
            made = [
                shape.format(
                    edge_test(rng, value),
                    edge_test(rng, rng.choice(values)),
                    bound=rng.choice(BOUNDS),
                )
                for shape in SHAPES
            ]
            asked = [f"ONCE[0frames, 0frames] ({one})" for one in made] + [f"prev({value})"]
            if value[0] == "r" and value not in {"r.primary", "r.is_own"}:
                asked += [f"delta({value}, {by})" for by in ("0.2s", "2frames")]
                words = sorted(WINDOWS.keys() - ({"avg_over"} if "heading" in value else set()))
                asked += [f"{word}({value}, {by})" for word in words for by in ("0.2s", "2frames")]
            yield pattern, rng.choice(made), asked


SHAPES = (
    *(f"{word}{{bound}} {{0}}" for word in ("ALWAYS", "EVENTUALLY", "HISTORICALLY", "ONCE")),
    *(f"{word} {{0}}" for word in ("NEXT", "WEAKNEXT", "PREVIOUS")),
    *(f"{{0}} {word}{{bound}} {{1}}" for word in ("UNTIL", "SINCE", "RELEASE")),
    "run_length({0}) >= 0.2s",
    "run_length({0}) >= 2frames OR {1}",
    "since_true({0}) > 0.1s",
    "NOT ONCE{bound} ({0} AND {1})",
    "ALWAYS{bound} ({0} OR NOT {1})",
    "PREVIOUS (e.speed > 0.5 AND {0})",
)


def edge_test(rng: random.Random, value: str) -> str:
    if value.startswith("type"):
        return f"{value} {rng.choice(('=', '<>'))} '{rng.choice(('near', 'visible', 'leads', 'isIn'))}'"
    if value in {"r.primary", "r.is_own"}:
        return value
    if rng.random() < 0.15:
        return f"{value} IS NULL"
    return f"{value} {rng.choice(('<', '>='))} {rng.choice((0, 0.25, 0.5, 1, 3, 8.5))}"


def compare_edges(world: World, store: Store, pattern: str, where: str, asked: list[str]) -> int:
    """Ask values and a condition over time of an edge variable both ways; how many rows there are."""
    returns = ", ".join(f"{value} AS y{n}" for n, value in enumerate(asked))
    text = f"MATCH {pattern} WHERE {where} RETURN DISTINCT trace.name, frame.seq, e, v, {returns}"
    found = {tuple(row) for row in store.find(f"USING UNKNOWN false {text}")}
    (statement,) = parse(text)
    assert isinstance(statement, s.MatchClause)
    assert statement.returns is not None
    values = [item.value for item in statement.returns.items[4:]]
    paths = s.Block(statement.block.paths, None, statement.span)
    links = edges_of(paths)
    expected: set[tuple[Any, ...]] = set()
    period = periods(store)
    for trace in world.traces:
        told = Told(trace, period[trace.name], links)
        for i, search in enumerate(told.searches):
            for match in search.matches(paths, {}):
                binding = {"e": match["e"], "v": match["v"]}
                if told.true(statement.block.where, i, binding):
                    told_values = [told.either(value, i, binding) for value in values]
                    expected.add((trace.name, trace.frames[i].seq, *binding.values(), *told_values))
    assert rounded(found) == rounded(expected), (text, found - expected, expected - found)
    return len(expected)


def rounded(rows: set[tuple[Any, ...]]) -> set[tuple[Any, ...]]:
    return {tuple(round(v, 3) if isinstance(v, float) else v for v in row) for row in rows}


def random_check(rng: random.Random) -> str:
    """A check of the ego, or of the ego and all, or some, others."""
    pair = rng.random() < 0.6
    word = rng.choice(("FORALL", "FORSOME"))
    formula = re.sub(r"\be\b", "ego", condition(rng, pair, rng.randint(1, 3), temporal=True))
    return f"CHECK c: {f'{word} (v:Entity) ' if pair else ''}{formula}"


def compare_check(world: World, store: Store, *checks: str, online: bool = True) -> int:
    """Ask checks, their verdicts and margins, both ways; how many traces violate one.

    ``online``: whether a monitor is asked, too, which does not know margins of later frames.
    """
    texts = [f"USING UNKNOWN false {check}" for check in checks]
    texts = [text.replace("CHECK c:", f"CHECK c{n}:", 1) for n, text in enumerate(texts)]
    asked = ";".join(f"{text} ROBUSTNESS" for text in texts)
    verdicts = {(one.trace, one.check): one for one in store.check(asked)}
    told_by = [verdicts, *([margins_watched(world, asked, periods(store))] if online else [])]
    violated = 0
    for n, text in enumerate(texts):
        (statement,) = parse(text)
        assert isinstance(statement, s.CheckClause)
        for trace in world.traces:
            expected, wanted = Told(trace, periods(store)[trace.name]).checked(statement)
            for verdict in (found[trace.name, f"c{n}"] for found in told_by):
                told = verdict.robustness
                assert told is not None
                assert (verdict.verdict == "true") == expected, (text, verdict, expected)
                # What is compared with a 32-bit column is rounded to 32 bits first.
                near = math.isclose(told.value, wanted, rel_tol=1e-6, abs_tol=1e-6)
                assert near, (text, trace.name, told, wanted)
                assert told.value == 0 or (told.value > 0) == expected, (text, told)
            violated += not expected
    return violated


UNKNOWN_ATOMS = (
    *("closing_speed(ego, v) > 1", "NOT closing_speed(ego, v) < 2", "v.length > 3", "v.width < 2"),
    *("prev(v.speed) > 1", "delta(v.speed, 0.2s) < 1", "max_over(v.speed, 0.2s) > 1"),
    *("run_length(v.speed > 1) >= 2frames", "since_true(closing_speed(ego, v) < 2) > 0.1s"),
    *("NOT v.speed > 1", "coalesce(v.speed, 0) < 1", "v.speed IS NULL", "v.speed > ego.speed"),
    *("exists_now(v)", "v.special = 'taxi'", "EXISTS {(ego)-[:near]->(v)}", "dist(ego, v) < 5"),
    *("robustness(v.speed > 1) > -1", "robustness(closing_speed(ego, v) > 1) < 2"),
    "robustness(dist(ego, v) < 6 AND NOT v.speed > 1 OR v.length > 3) >= -2",
    "CASE WHEN NOT ONCE v.speed > 1 THEN 0 ELSE dist(ego, v) END > 0",
)


def unknown_check(rng: random.Random) -> str:
    """A check of values that may be unknown."""

    def formula(depth: int) -> str:
        if depth == 0:
            return rng.choice(UNKNOWN_ATOMS)
        bound = rng.choice(("", "", "[0s, 0.3s]", "[0.2s, 0.5s]", "[0frames, 2frames]"))
        shapes = [
            *("NOT ({0})", "({0}) AND ({1})", "({0}) OR ({1})", "({0}) IMPLIES ({1})"),
            *(f"{word}{bound} ({{0}})" for word in ("ALWAYS", "EVENTUALLY", "ONCE")),
            *("NEXT ({0})", "PREVIOUS ({0})", "({0}) XOR ({1})", f"({{0}}) UNTIL{bound} ({{1}})"),
        ]
        inner = [formula(depth - 1) for _ in range(2)]
        return rng.choice(shapes).format(*inner)

    word = rng.choice(("FORALL", "FORALL", "FORSOME"))
    always = rng.choice(("ALWAYS", "ALWAYS", "EVENTUALLY", ""))
    return f"CHECK c: {word} (v:Entity) {always} ({formula(rng.randint(0, 2))})"


def compare_unknown(world: World, store: Store, *checks: str) -> Counter[str]:
    """Ask checks whose values may be unknown, both ways; how often each verdict is right."""
    texts = [text.replace("CHECK c:", f"CHECK c{n}:", 1) for n, text in enumerate(checks)]
    asked = ";".join(texts)
    verdicts = {(one.trace, one.check): one for one in store.check(asked)}
    online = margins_watched(world, asked, periods(store))
    found: Counter[str] = Counter()
    for n, text in enumerate(texts):
        (statement,) = parse(text)
        assert isinstance(statement, s.CheckClause)
        for trace in world.traces:
            stored, watched = (told[trace.name, f"c{n}"] for told in (verdicts, online))
            if stored.reason and " is unknown" not in stored.reason:
                continue  # the trace cannot answer at all
            wanted = Told(trace, periods(store)[trace.name]).verdict(statement)
            assert stored.verdict == wanted, (text, stored, wanted)
            assert watched.verdict == wanted, (text, watched, wanted)
            found[wanted] += 1
    return found


def margins_watched(world: World, text: str, period: dict[str, int]) -> dict[Any, Verdict]:
    """The verdicts of checks, frame by frame."""
    found: dict[Any, Verdict] = {}
    for trace in world.traces:
        monitor = Monitor(text, period_s=period[trace.name] / 1e9, trace=trace.name)
        for frame in trace.frames:
            monitor.look([graph_of(frame)])
        found |= {(trace.name, verdict.check): verdict for verdict in monitor.finish()}
    return found


def worlds(seed: int, folder: Path, *, traces: int = 3, frames: int = 0) -> tuple[World, Store]:
    """A random world, and the store that holds it."""
    path = folder / f"{seed}.sgstore"
    StoreFile.create(path)
    world = random_world(seed, traces=traces, frames=frames or 8 + seed % 5, path=path)
    world.connection.close()
    return world, sgstore.open(path)


def run(seeds: int, questions: int, folder: Path) -> tuple[int, int, int]:
    """Ask so many questions of each kind of each of so many worlds; how much was found."""
    found = [0, 0, 0]
    for seed in range(seeds):
        world, store = worlds(seed, folder)
        rng = random.Random(seed)
        found[1] += sum(compare_edges(world, store, *one) for one in edge_questions(rng))
        for number in range(questions):
            policy = ("all", "first", "longest")[number % 3]
            found[0] += compare_sequence(world, store, random_sequence(rng), policy)
            found[1] += compare_condition(world, store, rng)
            found[2] += compare_check(world, store, random_check(rng))
            found[0] += compare_over_sequence(world, store, rng)
            found[1] += compare_over_pattern(world, store, rng)
            found[2] += compare_over_check(world, store, rng)
    return found[0], found[1], found[2]


if __name__ == "__main__":
    asked = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    with tempfile.TemporaryDirectory() as made:
        worth = run(max(asked // 30, 1), 30, Path(made))
    sys.stdout.write(
        f"no difference; {worth[0]} sequences, {worth[1]} rows, {worth[2]} violations\n"
    )
