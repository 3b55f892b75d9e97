"""Expressions of steps on random streams against exhaustive search: ``python oracle_steps.py 10000``.

No store is asked: where each step holds, and for whom, is drawn. Over columns, frame by frame, and by
definition the matches must be the same, to the frame of each step.
"""

from __future__ import annotations

import random
import sys
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from oracle_over_time import Told, many_ways, names_of, spelled_out, visible_names

from sgstore.errors import QueryError
from sgstore.lang.bind import bind_query
from sgstore.lang.bind._renaming import names_written
from sgstore.lang.catalog import Catalog
from sgstore.lang.syntax import parse
from sgstore.lang.syntax import tree as s
from sgstore.model.world import longest_step_ns, tolerance_ns
from sgstore.temporal._sequence_monitor import FrameTime, sequence_monitor
from sgstore.temporal._sequences import Finder
from sgstore.temporal._signal_state import StreamClock
from sgstore.temporal._signal_values import Clock
from sgstore.temporal._trace_group import TimedRelation, TraceGroup, TraceReader
from sgstore.temporal._valuation import QueryCache

if TYPE_CHECKING:
    from collections.abc import Mapping

PERIOD = 100_000_000
LINKS = (
    *("THEN", "THEN", "THEN WITHIN 0.3s", "THEN AFTER 0.2s", "THEN AFTER 0.1s WITHIN 0.6s"),
    *("THEN IMMEDIATELY", "UNTIL", "WHILE", "THEN WITHIN 2frames"),
)
HOLDS = ("", "", "", "", " FOR >= 0.1s", " FOR >= 2frames", " FOR < 0.3s")
OFTEN = ("", "", "", "{2}", "{1,2}", "{1,3}", "{2,3}")
NODES = {"v": (1, 1, 1, 2), "w": (3, 3, 4)}
MOST_WAYS = 20

Held = dict[str, set[tuple[int, tuple[tuple[str, int], ...]]]]


class Writer:
    """Writes random expressions of steps; each step is told from the others by a number in it."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._number = 0
        self._bound = ["v"]

    def step(self, names: list[str] | None = None) -> str:
        names = names or self._rng.choice((["v"], ["v"], ["v"], ["v", "w"]))
        self._number += 1
        nodes = ", ".join(f"({name}:Car)" for name in names)
        return f"MATCH {nodes} WHERE v.speed > {self._number}{self._rng.choice(HOLDS)}"

    def sequence(self, depth: int) -> str:
        rng = self._rng
        parts = [self.part(depth)]
        for _ in range(rng.choice((0, 1, 1, 2) if depth else (1, 2))):
            link = rng.choice(LINKS)
            if link == "THEN" and rng.random() < 0.2:
                parts.append(f"THEN NOT {self.step(['v']).split(' FOR ')[0]}")
            parts += [link, self.part(depth)]
        return " ".join(parts)

    def part(self, depth: int) -> str:
        rng = self._rng
        if depth > 1 or rng.random() < 0.5:
            return self.step()
        inner = [self.sequence(depth + 1) for _ in range(rng.choice((1, 2, 2, 3)))]
        return f"({' | '.join(inner)}){rng.choice(OFTEN)}"

    def text(self) -> str:
        found = self.sequence(0)
        if self._rng.random() < 0.1:
            found += f" THEN WITHIN 0.5s NOT {self.step(['v']).split(' FOR ')[0]}"
        return found


class Stream(Told):
    """Frames, and where steps hold."""

    def __init__(self, times: list[int], held: Held) -> None:
        self.times, self.period, self.slack = times, PERIOD, tolerance_ns(PERIOD)
        self._held = held

    def holds(self, step: s.StepClause, known: set[str]) -> set[tuple[int, tuple[Any, ...]]]:
        found = self._held[number_of(step)]
        if step.hold is not None:
            found = {(i, b) for i, b in found if self.lasts(step.hold, i, b, found)}
        return found


def number_of(step: s.StepClause) -> str:
    where = step.block.where
    assert isinstance(where, s.Comparison)
    assert isinstance(where.right, s.Constant)
    return str(where.right.value)


class People:
    """Nobody: names of nodes do not matter here."""

    def __contains__(self, _node: int) -> bool:
        return False


def compare(seed: int) -> int:
    """Ask one expression of one stream in three ways; how many matches there are."""
    rng = random.Random(f"steps {seed}")
    text = Writer(rng).text()
    policy = rng.choice(("all", "first", "longest"))
    (statement,) = parse(f"USING MATCHES {policy} {text}")
    assert isinstance(statement, s.MatchClause)
    if many_ways(statement.sequence) > MOST_WAYS:
        return 0
    if has_own_rounds(statement.sequence, frozenset()):
        return 0  # test_lang_rounds.py compares these with written repetitions
    ways = spelled_out(statement.sequence)
    if max(len(steps) for steps, _ in ways) > 6:
        return 0
    try:
        query = bind_query(text, [statement], Catalog(), {})
    except QueryError as error:
        if "in some of the sequences only" not in error.reason:
            raise
        return 0
    size = rng.randint(4, 14)
    times = np.cumsum([PERIOD * rng.choice((1, 1, 1, 1, 1, 9)) for _ in range(size)]).tolist()
    likely = rng.choice((0.3, 0.5, 0.7, 0.9))
    steps = {number_of(step): step for one, _ in ways for step in one}
    held: Held = {}
    for number, step in steps.items():
        names = sorted(names_of(step))
        told = [tuple((n, rng.choice(NODES[n])) for n in names) for _ in range(2)]
        held[number] = {(i, b) for b in told for i in range(size) if rng.random() < likely}
    expected: Counter[Any] = Counter()
    for binding, frames, end in Stream(times, held).sequences(statement.sequence, policy):
        expected[tuple(sorted(binding.items())), tuple(frames), end] += 1
    assert query.scope.nodes.keys() == visible_names(statement.sequence), text
    columns = over_columns(query, held, times)
    spans = Counter((binding, frames[0], end) for binding, frames, end in expected.elements())
    assert columns == spans, (seed, policy, text, columns - spans, spans - columns)
    told_frames = Counter((binding, frames) for binding, frames, _ in expected.elements())
    seen = frame_by_frame(query, held, times)
    assert seen == told_frames, (seed, policy, text, seen - told_frames, told_frames - seen)
    return sum(expected.values())


def has_own_rounds(sequence: s.SequenceClause, outside: frozenset[str]) -> bool:
    """Whether a variable is in a repeated group and nowhere else, so that each repetition has its own."""
    every = {id(step): names_written(replace(sequence, steps=(step,))) for step in sequence.steps}
    for step in sequence.steps:
        others = outside.union(*(names for key, names in every.items() if key != id(step)))
        if isinstance(step, s.GroupStep) and (
            (step.high > 1 and every[id(step)] - others)
            or any(has_own_rounds(one, others) for one in step.alternatives)
        ):
            return True
    return False


def asked(query: Any, number: int) -> str:
    """The number that tells a step of a bound query from the others."""
    (condition,) = query.steps[number].scope.where
    return str(condition.operands[1].value)


def over_columns(query: Any, held: Held, times: list[int]) -> Counter[Any]:
    none: Any = None
    finder = Finder(none, query, Catalog())
    clock_of = np.array(times)
    ids = np.arange(len(times))
    ticks = Clock.of(clock_of, ids, PERIOD, longest_step_ns(PERIOD), tolerance_ns(PERIOD))
    trace = TraceReader(1, "trace", ids, ids, clock_of, clock_of, times[0], ticks)
    for number, ask in enumerate(finder._steps):
        rows = sorted(held[asked(query, number)])
        keys = np.array([[dict(b)[name] for name in ask.variables] for _, b in rows], np.int64)
        frames = np.array([i for i, _ in rows], np.int64)
        trace.relations[ask.name] = TimedRelation.of(
            frames, keys.reshape(len(rows), len(ask.variables))
        )
    found: Counter[Any] = Counter()
    names = sorted(query.scope.nodes)
    for _, _, keys, values in finder.found_in(TraceGroup.alone(trace), ()):
        for key, first, last in zip(keys.tolist(), values[-2], values[-1], strict=True):
            found[tuple(zip(names, key, strict=True)), first, last] += 1
    return found


def frame_by_frame(query: Any, held: Held, times: list[int]) -> Counter[Any]:
    questions, clock = QueryCache(), StreamClock(PERIOD)
    monitor = sequence_monitor("it", query, questions, clock)
    people: Any = People()
    events: list[Any] = []
    here = FrameTime(0, 0, 0.0)
    for frame, time in enumerate(times):
        clock.step(time)
        here = FrameTime(frame, time, 0.0)
        answers: list[Mapping[Any, Any]] = [{} for _ in range(len(query.steps))]
        for number, (question, variables) in enumerate(monitor._asks):
            now = [dict(b) for i, b in held[asked(query, number)] if i == frame]
            answers[question] = {tuple(b[name] for name in variables): None for b in now}
        questions.answers = answers
        events += monitor.step(here, people)
    events += monitor.finish(here)
    return Counter(
        (tuple(sorted(event.nodes.items())), tuple(step.seq for step in event.steps))
        for event in events
    )


def try_streams(first: int, count: int) -> int:
    """Compare so many streams; how many matches they have."""
    return sum(compare(seed) for seed in range(first, first + count))


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    start = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    sys.stdout.write(f"{number} streams, no difference; {try_streams(start, number)} matches\n")
