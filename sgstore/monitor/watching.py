"""One ``CHECK``, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sgstore.errors import QueryError
from sgstore.history.bindings import Level, folded_values, innermost, levels_of
from sgstore.history.checks import Verdict, Witness
from sgstore.lang.bound import Query, Result
from sgstore.matches import Interval
from sgstore.monitor.bindings import Known, Partial
from sgstore.monitor.duties import Automaton, State, Step
from sgstore.monitor.events import Event, Moment
from sgstore.monitor.letters import Letters
from sgstore.temporal.formulas import looks_ahead
from sgstore.temporal.plans import Plan
from sgstore.temporal.verdicts import (
    CERTAINLY_TRUE,
    FALSE,
    PRESUMABLY_FALSE,
    PRESUMABLY_TRUE,
    STATUS,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from sgstore.lang.over_time import Check, Quantifier
    from sgstore.monitor.asking import Key, Questions
    from sgstore.temporal.courses import Memory, Pulse
    from sgstore.world import Bools

    Keys = NDArray[np.int64]
    Span = tuple[Moment, Moment]


@dataclass(frozen=True, slots=True)
class _Entry:
    """What is known of a binding.

    Attributes
    ----------
    state : State
    counted : int
        Guards that were true in some frame, a bit each.
    since : Moment or None
        From when on the check is violated.
    over : tuple of (Moment, Moment)
        Violations that have ended.
    memory : Memory
        What values over time need of former frames.
    final : bool
        Whether no frame changes it any more.
    """

    state: State
    counted: int
    since: Moment | None
    over: tuple[Span, ...]
    memory: Memory
    final: bool = False


def _same(one: _Entry, other: _Entry) -> bool:
    return (
        one.state is other.state
        and one.counted == other.counted
        and one.since is other.since
        and one.over == other.over
        and one.memory == other.memory
    )


class Watch:
    """A check, while a trace comes.

    Parameters
    ----------
    check : Check
    questions : Questions
        What is asked of each frame; those of the check become part of them.
    pulse : Pulse
        Told of each frame before this is.
    compat : bool
        Whether the check is violated in each frame with which the trace, if it ended there, would violate it;
        as SGSM reports it.

    Raises
    ------
    QueryError
        What is to be known at once depends on later frames.
    """

    def __init__(
        self, check: Check, questions: Questions, pulse: Pulse, *, compat: bool = False
    ) -> None:
        self._check, self._pulse, self._compat = check, pulse, compat
        self._last: Moment | None = None
        self._variables = tuple(node for q in check.quantifiers for node in q.nodes)
        whole = Query(check.scope, Result(), check.relations, check.injective, check.ego)
        whole = replace(whole, unknown_is_false=check.unknown_is_false)
        absent = frozenset(node for q in check.quantifiers if q.absent for node in q.nodes)
        plan = Plan(whole, frozenset(self._variables), absent)
        formula = plan.formula(check.formula)
        reset = None
        if check.reset is not None and not compat:
            reset = plan.formula(check.reset)
        if check.gaps == "unknown":
            raise QueryError(
                f"USING GAPS unknown of {check.name} is a question about what was recorded",
                hint="a monitor sees every frame that there is; leave it out, or ask a store",
            )
        if reset is not None and looks_ahead(reset):
            raise QueryError(
                f"RESET WHEN of {check.name} looks ahead",
                hint="a monitor begins anew in the next frame, so what resets it must be known by then",
            )
        guards = {q: plan.formula(q.where) for q in check.quantifiers if q.where is not None}
        self._guards: dict[Quantifier, int] = {q: 1 << n for n, q in enumerate(guards)}
        self._letters = Letters(
            plan, self._variables, questions, pulse, bridge=check.gaps == "bridge"
        )
        bits = self._letters.bits
        self._automaton = Automaton(formula, reset, tuple(guards.values()), bits)
        strangers = _Entry(self._automaton.begun, 0, None, (), self._letters.begun)
        self._known = Known(self._letters.lattice, strangers)
        self._questions = questions
        nodes = check.scope.nodes.items()
        self._domains = {key: questions.met(node.kinds) for key, node in nodes}
        self._kinds = {node.kinds for _, node in nodes}
        self._told: dict[Key, tuple[int, int]] = {}
        self._immediate = all(q.word == "FORALL" for q in check.quantifiers)

    @property
    def name(self) -> str:
        """Of the check."""
        return self._check.name

    # Frame by frame

    def step(self, here: Moment) -> list[Event]:
        """A frame has come, and the questions were asked of it: what is known from it on."""
        known = self._known
        found = {row: entry for row, entry in known.held.items() if entry.final}
        left = (row for row in known.held if row not in found) if found else known.held
        letters, memories = self._letters.read(left, self._remembered)
        changed: list[Partial] = []
        seen: dict[tuple[State, int], Step] = {}
        tick, automaton, mask = self._pulse.tick, self._automaton, self._automaton.mask
        stepped = self._as_sgsm if self._compat else _stepped
        for row, letter in letters.items():
            before = known.of(row)
            if before.final:
                found[row] = before
                continue
            step = automaton.step(before.state, letter & mask, tick, seen)
            entry = stepped(before, step, here, memories.get(row, ()))
            if entry is not before:
                changed.append(row)
                if automaton.final(entry.state, entry.counted):
                    entry = replace(entry, memory=(), final=True)
            found[row] = entry
        known.keep(found, _same)
        self._last = here
        if not self._immediate:
            return []
        return list(self._events(here, changed))

    def _as_sgsm(self, entry: _Entry, step: Step, here: Moment, memory: Memory) -> _Entry:
        """What is known of a binding that is violated as long as the trace may not end."""
        since, over = entry.since, entry.over
        if not step.state.ended:
            since = since or here
        elif since is not None:
            since, over = None, (*over, (since, self._last or here))
        counted = entry.counted | step.guards
        found = _Entry(step.state, counted, since, over, memory)
        return entry if _same(entry, found) else found

    def _remembered(self, row: Partial) -> Memory | None:
        entry = self._known.of(row)
        return None if entry.final else entry.memory

    # What is known

    def _events(self, here: Moment, changed: list[Partial]) -> Iterator[Event]:
        """What is told of bindings of which something else is known than before; of all, if somebody is new."""
        rows = list(self._known.held) if self._kinds & self._questions.fresh else changed
        for row in rows:
            entry = self._known.of(row)
            if entry.since is None and not entry.over:
                continue
            for key in self._covered(row, entry):
                begun, ended = self._told.get(key, (0, 0))
                spans = entry.over if entry.since is None else (*entry.over, (entry.since, None))
                if (begun, ended) == (len(spans), len(entry.over)) or not self._counts(key, entry):
                    continue
                self._told[key] = len(spans), len(entry.over)
                for number in range(ended, len(spans)):
                    start, end = spans[number]
                    if number >= begun:
                        yield self._event("violated", here, key, start, start)
                    if end is not None:
                        yield self._event("kept again", here, key, start, end)

    def _covered(self, row: Partial, entry: _Entry) -> Iterator[Key]:
        """The bindings of entities that were met of which no more is known than this."""
        if None not in row:
            yield row  # type: ignore[misc]
            return
        keys: list[Partial] = [()]
        for node, name in zip(row, self._variables, strict=True):
            some = self._domains[name] if node is None else (node,)
            keys = [(*key, one) for key in keys for one in some]
        for key in keys:
            if self._known.of(key) is entry:
                yield key  # type: ignore[misc]

    def _counts(self, key: Key, entry: _Entry) -> bool:
        """Whether a binding is one that the check is about."""
        if entry.counted != (1 << len(self._guards)) - 1:
            return False
        if any(n not in self._domains[v] for n, v in zip(key, self._variables, strict=True)):
            return False
        return not self._check.injective or (
            len(set(key)) == len(key) and not any(node in self._others for node in key)
        )

    @property
    def _others(self) -> set[int]:
        """What the nodes that no quantifier binds were: the egos."""
        rest = [n for n in self._domains if n not in self._variables]
        return {node for name in rest for node in self._domains[name]}

    def _event(
        self, kind: str, here: Moment, key: Key, start: Moment, end: Moment, *, at_end: bool = False
    ) -> Event:
        nodes = dict(zip(self._variables, key, strict=True))
        names = {name: self._domains[name][node] for name, node in nodes.items()}
        return Event(kind, self.name, here, start, end, nodes, names, at_end=at_end)

    # The end

    def status(self) -> str:
        """What is known of the check, for the entities that were met: one of ``STATUS``."""
        levels = self._levels()
        bindings = innermost(levels)
        return STATUS[self._folded_codes(levels, [self._of(key) for key in bindings.tolist()])]

    def _of(self, key: list[int]) -> _Entry:
        return self._known.of(tuple(key))

    def _levels(self) -> list[Level]:
        domains = {n: np.array(sorted(met), np.int64) for n, met in self._domains.items()}
        size = len(self._variables)

        def counts(quantifier: Quantifier, variables: tuple[str, ...], bindings: Keys) -> Bools:
            bit = self._guards.get(quantifier, 0)
            rest = (None,) * (size - len(variables))
            told = [self._known.of((*key, *rest)).counted & bit == bit for key in bindings.tolist()]
            return np.array(told, np.bool_)

        apart = np.array(sorted(self._others), np.int64) if self._check.injective else None
        return levels_of(self._check.quantifiers, domains, apart=apart, counts=counts)

    def _folded_codes(self, levels: list[Level], entries: list[_Entry]) -> int:
        rows = [_code(entry, compat=self._compat) for entry in entries]
        for number in range(len(levels) - 1, -1, -1):
            level = levels[number]
            every = level.word == "FORALL"
            outer = len(levels[number - 1].bindings) if number else 1
            joined = [CERTAINLY_TRUE if every else FALSE] * outer
            for parent, row in zip(level.parents.tolist(), rows, strict=True):
                joined[parent] = (min if every else max)(joined[parent], row)
            rows = joined
        return rows[0]

    def finish(self, trace: str, last: Moment) -> tuple[Verdict, list[Event]]:
        """The trace has ended: the verdict, and what only the end makes known."""
        levels = self._levels()
        bindings = innermost(levels)
        entries = [self._of(key) for key in bindings.tolist()]
        # Of what SGSM reports every violation is told already: the last frame's, too.
        weak = self._check.end == "weak" or self._compat
        spans = [_spans(entry, last, weak=weak) for entry in entries]
        truths = folded_values(levels, np.array([not one for one in spans], np.bool_))
        holds = bool(truths[0][0])
        verdict = "true" if holds else "false"
        if self._check.end == "pending":
            verdict = STATUS[self._folded_codes(levels, entries)]
        if not levels:
            own = tuple(_interval(trace, span, {}) for span in spans[0])
            found = Verdict(self.name, trace, verdict, own)
        else:
            witnesses = self._witnesses(trace, levels, truths, spans)
            violations: tuple[Interval, ...] = ()
            if not holds:
                every = {(i.start_seq, i.end_seq): i for w in witnesses for i in w.violations}
                violations = tuple(every[key] for key in sorted(every))
                violations = violations or (_interval(trace, (last, last), {}),)
            found = Verdict(self.name, trace, verdict, violations, witnesses)
        return found, list(self._at_end(last, holds=holds, bindings=bindings, spans=spans))

    def _at_end(
        self, last: Moment, *, holds: bool, bindings: Keys, spans: list[list[Span]]
    ) -> Iterator[Event]:
        """Violations that were not told yet."""
        if holds:
            return
        if not self._immediate:
            yield Event("violated", self.name, last, last, last, {}, {}, at_end=True)
            return
        for key, found in zip(bindings.tolist(), spans, strict=True):
            begun, _ = self._told.get(tuple(key), (0, 0))
            for start, _ in found[begun:]:
                yield self._event("violated", last, tuple(key), start, start, at_end=True)

    def _witnesses(
        self,
        trace: str,
        levels: list[Level],
        truths: list[Bools],
        spans: list[list[Span]],
    ) -> tuple[Witness, ...]:
        """Those of the outermost quantifiers that are of one word."""
        word = levels[0].word
        depth = next((n for n, level in enumerate(levels) if level.word != word), len(levels))
        level, values = levels[depth - 1], truths[depth]
        names = [n for q in self._check.quantifiers[:depth] for n in q.nodes]
        found: list[Witness] = []
        for row in np.flatnonzero(values == (word == "FORSOME")).tolist():
            nodes = dict(zip(names, level.bindings[row].tolist(), strict=True))
            called = {name: self._domains[name][node] for name, node in nodes.items()}
            inner = spans[row] if depth == len(levels) else []
            violations = tuple(_interval(trace, span, called) for span in inner)
            found.append(Witness(nodes, called, bool(values[row]), violations))
        return tuple(found)


def _stepped(entry: _Entry, step: Step, here: Moment, memory: Memory) -> _Entry:
    counted = entry.counted | step.guards
    plain = not (step.started or step.ended or memory)
    if plain and step.state is entry.state and counted == entry.counted:
        return entry
    since, over = entry.since, entry.over
    if step.started:
        since = here
    if step.ended and since is not None:
        since, over = None, (*over, (since, here))
    return _Entry(step.state, counted, since, over, memory)


def _code(entry: _Entry, *, compat: bool) -> int:
    broken = entry.state.word == "broken"
    if broken or (not compat and (entry.since is not None or entry.over)):
        return FALSE
    if entry.state.word == "kept":
        return CERTAINLY_TRUE
    return PRESUMABLY_TRUE if entry.state.ended else PRESUMABLY_FALSE


def _spans(entry: _Entry, last: Moment, *, weak: bool) -> list[Span]:
    """The violations of a binding in a trace that has ended."""
    found = list(entry.over)
    if entry.since is not None:
        found.append((entry.since, last))
    elif not (weak or entry.state.ended):
        found.append((last, last))
    return found


def _interval(trace: str, span: Span, names: Mapping[str, str]) -> Interval:
    start, end = span
    times = start.time_ns, end.time_ns, start.t, end.t
    return Interval(trace, start.seq, end.seq, *times, end.seq - start.seq + 1, dict(names))
