"""Temporal queries over a store, and their matches."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.lang import ExternalRelation, Window, of_query, relation, value_text, with_places
from sgstore.lang.ir import Bound, Query, Result, Scope, SignalCall, StepTime, Tense
from sgstore.matches import Matches
from sgstore.store import BUCKET_BITS
from sgstore.temporal._checks import lacking
from sgstore.temporal._offline import (
    Ask,
    PlanValues,
    TimedRelation,
    TraceReader,
    asks_of,
    traces,
    words,
)
from sgstore.temporal._plan import Plan, formula_text, hold_text, link_text, needs_text, sql_text
from sgstore.temporal._sequences import BindingLine, JoinedBindings, Leg, joined, matches_of

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

    from numpy.typing import NDArray

    from sgstore.lang import Catalog, Column, Compiled
    from sgstore.lang.ir import BoundStep, StepLink
    from sgstore.store import StoreFile
    from sgstore.temporal._formula import Formula
    from sgstore.world import Ints

    Keys = NDArray[np.int64]


@dataclass(slots=True)
class _MatchCollector:
    """Matches while they are collected."""

    first: list[Ints] = field(default_factory=list["Ints"])
    last: list[Ints] = field(default_factory=list["Ints"])
    bindings: list[Keys] = field(default_factory=list["Keys"])
    values: list[list[list[Any]]] = field(default_factory=list[list[list[Any]]])


class Finder:
    """Finder of the matches of a query over several frames in a store.

    Parameters
    ----------
    file : StoreFile
        It stays as it is while this is used.
    query : Query
        With steps.
    catalog : Catalog
    """

    def __init__(self, file: StoreFile, query: Query, catalog: Catalog) -> None:
        self._file, self._query, self._catalog = file, query, catalog
        nodes = {
            key: node for step in reversed(query.steps) for key, node in step.scope.nodes.items()
        }
        edges = tuple(edge for step in query.steps for edge in step.scope.edges)
        scope = Scope(nodes, {}, edges, (), frozenset())
        whole = replace(query, scope=scope, result=Result(), steps=(), links=())
        self._plan = Plan(whole, frozenset(nodes))
        self._when = [tuple(map(self._plan.formula, step.when)) for step in query.steps]
        self._steps = [self._ask(step) for step in query.steps]
        self._kept = tuple(sorted(query.scope.nodes))
        self._edges = tuple(edge.key for edge in query.scope.edges)

    def _ask(self, step: BoundStep) -> Ask:
        """The pattern of a step; what only matters in it is bound too where its conditions need that."""
        kept = set(self._query.scope.nodes)
        if step.when:
            kept |= set(step.scope.nodes)
        variables = tuple(sorted(kept & set(step.scope.nodes)))
        edges = tuple(sorted(edge.key for edge in step.scope.edges if edge.named))
        query = replace(self._query, scope=step.scope, result=Result(), steps=(), links=())
        return Ask(query, variables, (), () if step.absent else edges)

    def __call__(self, places: tuple[Bound, ...], window: Window | None) -> ExternalRelation:
        """The matches in a window, or in the whole traces that it is a part of.

        Parameters
        ----------
        places : tuple of Bound
            What is worked out for each match.
        window : Window or None
        """
        if window is not None:
            high = ((window.high - 1) >> BUCKET_BITS) + 1
            low = window.low >> BUCKET_BITS << BUCKET_BITS
            window = Window(low, high << BUCKET_BITS, window.traces)
        formulas = {p: self._plan.formula(p) for p in places if _is_condition(p)}
        for place in places:
            if place not in formulas and not isinstance(place, StepTime):
                self._plan.test(place)
        asks = asks_of(self._plan)
        asks |= {f"step {number}": ask for number, ask in enumerate(self._steps)}
        found = _MatchCollector(values=[[] for _ in range(len(places) + self._spans * 2)])
        about = self._file, self._catalog, self._query, asks
        for trace in traces(*about, gaps=self._query.gaps, within=window):
            if len(trace):
                self._find(trace, places, formulas, found)
        return self._collected(found)

    def text(self, places: tuple[Bound, ...]) -> str:
        """The questions about single frames, and the formulas over their answers."""
        lines: list[str] = []
        for number, (step, ask) in enumerate(zip(self._query.steps, self._steps, strict=True)):
            if number:
                lines.append(link_text(self._query.links[number - 1]))
            lines.append(
                f"{'not ' * step.absent}step {number + 1}({', '.join(self._named(number))})"
            )
            lines += [f"    when {formula_text(formula)}" for formula in self._when[number]]
            lines += [f"    {hold_text(step.hold)}"] if step.hold else []
            if not ask.everywhere:
                bound = {*ask.variables, *ask.edges}
                lines += sql_text(relation(ask.query, self._catalog, None, (), bound))
        for place in places:
            if not isinstance(place, StepTime):
                told = self._plan.formula(place) if _is_condition(place) else None
                name = formula_text(told) if told else self._plan.test(place).name
                lines.append(f"returned {value_text(place)} = {name}")
        return "\n".join([*lines, *needs_text(self._plan, self._catalog)])

    @property
    def _spans(self) -> bool:
        return len(self._query.steps) > 1

    def _find(
        self,
        trace: TraceReader,
        places: tuple[Bound, ...],
        formulas: dict[Bound, Formula],
        found: _MatchCollector,
    ) -> None:
        line = BindingLine(trace.clock)
        held = [self._held(trace, line, number) for number in range(len(self._steps))]
        if not self._spans:
            self._tell_frames(trace, held[0], places, formulas, found)
            return
        happen = [n for n, step in enumerate(self._query.steps) if not step.absent]
        together = joined([(self._named(n), held[n]) for n in happen], self._apart)
        for part in together.parts([held[n] for n in happen]):
            self._tell_matches(trace, line, held, part, places, formulas, found)

    @property
    def _apart(self) -> tuple[str, ...]:
        return self._kept if self._query.injective else ()

    def _named(self, number: int) -> tuple[str, ...]:
        """Return the columns of a step's relation that other steps or results use."""
        ask = self._steps[number]
        return (*(n for n in ask.variables if n in self._kept), *ask.edges)

    def _held(self, trace: TraceReader, line: BindingLine, number: int) -> TimedRelation:
        """Return the frames in which a step holds: its pattern, its other conditions, and its duration."""
        step, ask = self._query.steps[number], self._steps[number]
        relation = trace.relations[f"step {number}"]
        owners = np.repeat(np.arange(len(relation.keys)), np.diff(relation.starts))
        kept = np.ones(len(owners), np.bool_)
        for formula in self._when[number]:
            kept &= self._true(trace, relation, ask, formula, owners)
        keys, frames = relation.keys[owners[kept]], relation.frames[kept]
        columns = (*ask.variables, *ask.edges)
        keys = keys[:, [columns.index(name) for name in self._named(number)]]
        relation = TimedRelation.of(frames, keys)
        if step.hold is None:
            return relation
        owners = np.repeat(np.arange(len(relation.keys)), np.diff(relation.starts))
        places = line.held(owners * line.stride + relation.frames, step.hold)
        return TimedRelation.of(line.frame(places), relation.keys[places // line.stride])

    def _true(
        self, trace: TraceReader, relation: TimedRelation, ask: Ask, formula: Formula, owners: Ints
    ) -> Any:
        """Tell whether a formula is true in each row of a relation."""
        true = np.zeros(len(owners), np.bool_)
        for low, high, rows in _chunks(relation.starts, trace.together):
            bindings = relation.keys[low:high, : len(ask.variables)]
            values = PlanValues(self._plan, trace, ask.variables, bindings).formula(formula)
            true[rows] = values[owners[rows] - low, relation.frames[rows]]
        return true

    # Single frames

    def _tell_frames(
        self,
        trace: TraceReader,
        relation: TimedRelation,
        places: tuple[Bound, ...],
        formulas: dict[Bound, Formula],
        found: _MatchCollector,
    ) -> None:
        names = self._named(0)
        owners = np.repeat(np.arange(len(relation.keys)), np.diff(relation.starts))
        told = [np.zeros(len(owners), object) for _ in places]
        for low, high, rows in _chunks(relation.starts, trace.together):
            at = owners[rows] - low, relation.frames[rows]
            values = self._values(trace, names, relation.keys[low:high], places, formulas)
            for number, column in enumerate(values):
                told[number][rows] = _picked(column, at)
        ids = trace.frame_ids[relation.frames]
        new = np.ones(len(ids), np.bool_)
        new[1:] = (np.diff(ids) != 1) | (np.diff(owners) != 0)
        for column in told:
            new[1:] |= column[1:] != column[:-1]
        first = np.flatnonzero(new)
        last = np.append(first[1:], len(ids))[: len(first)] - 1
        found.first.append(ids[first])
        found.last.append(ids[last])
        found.bindings.append(self._ordered(names, relation.keys[owners[first]]))
        for number, column in enumerate(told):
            found.values[number].append(column[first].tolist())

    # Sequences

    def _tell_matches(
        self,
        trace: TraceReader,
        line: BindingLine,
        held: list[TimedRelation],
        part: JoinedBindings,
        places: tuple[Bound, ...],
        formulas: dict[Bound, Formula],
        found: _MatchCollector,
    ) -> None:
        steps = self._query.steps
        happen = [n for n, step in enumerate(steps) if not step.absent]
        at = [self._placed(line, held[n], part.places[:, i]) for i, n in enumerate(happen)]
        by_step = dict(zip(happen, at, strict=True))
        absent = {
            n: self._placed(line, held[n], held[n].find(self._projected(part, n)))
            for n, step in enumerate(steps)
            if step.absent
        }
        told = matches_of(line, by_step[0], self._legs(by_step, absent), self._query.policy)
        if not len(told):
            return
        owners = told[:, 0] // line.stride
        frames = line.frame(told)
        ends = frames[:, -1]
        if steps[happen[-1]].hold is not None:
            runs = line.run_ends(at[-1])
            ends = line.frame(runs[np.searchsorted(at[-1], told[:, -1])])
        found.first.append(trace.frame_ids[frames[:, -1]])
        found.last.append(trace.frame_ids[frames[:, -1]])
        found.bindings.append(self._ordered(part.variables, part.bindings[owners]))
        values = self._at_matches(trace, part, owners, frames, places, formulas)
        for number, column in enumerate(values):
            found.values[number].append(column)
        found.values[-2].append(trace.frame_ids[frames[:, 0]].tolist())
        found.values[-1].append(trace.frame_ids[ends].tolist())

    def _placed(self, line: BindingLine, relation: TimedRelation, places: Ints) -> Ints:
        owner, rows = relation.rows_of(places)
        return owner * line.stride + relation.frames[rows]

    def _projected(self, part: JoinedBindings, number: int) -> Keys:
        return part.bindings[:, [part.variables.index(n) for n in self._named(number)]]

    def _legs(self, at: dict[int, Ints], absent: dict[int, Ints]) -> list[Leg]:
        """The ways between the steps that happen; what must not happen lies on them."""
        legs: list[Leg] = []
        links, steps = self._query.links, self._query.steps
        number = 1
        while number < len(steps):
            link = links[number - 1]
            if number not in absent:
                legs.append(_leg(link, None, at[number]))
            elif number + 1 < len(steps):
                legs.append(_leg(links[number], absent[number], at[number + 1]))
                number += 1
            else:
                legs.append(_leg(link, absent[number], None))
            number += 1
        return legs

    def _at_matches(
        self,
        trace: TraceReader,
        part: JoinedBindings,
        owners: Ints,
        frames: Ints,
        places: tuple[Bound, ...],
        formulas: dict[Bound, Formula],
    ) -> list[list[Any]]:
        happen = [n for n, step in enumerate(self._query.steps) if not step.absent]
        told: list[list[Any]] = []
        worked_out = [place for place in places if not isinstance(place, StepTime)]
        columns: dict[Bound, Any] = {}
        if worked_out:
            size = trace.together
            picked: list[list[Any]] = [[] for _ in worked_out]
            for low in range(0, len(owners), size):
                some = owners[low : low + size]
                values = self._values(
                    trace, part.variables, part.bindings[some], tuple(worked_out), formulas
                )
                at = np.arange(len(some)), frames[low : low + size, -1]
                for number, column in enumerate(values):
                    picked[number] += _picked(column, at).tolist()
            columns = dict(zip(worked_out, picked, strict=True))
        for place in places:
            if isinstance(place, StepTime):
                times = trace.times[frames[:, happen.index(place.step)]] - trace.start
                told.append((times / 1e9).tolist())
            else:
                told.append(columns[place])
        return told

    # Values

    def _values(
        self,
        trace: TraceReader,
        names: tuple[str, ...],
        bindings: Keys,
        places: tuple[Bound, ...],
        formulas: dict[Bound, Formula],
    ) -> list[Any]:
        """Return values over time of some bindings: (B, F) flags, or columns."""
        values = PlanValues(self._plan, trace, names, bindings)
        return [
            values.formula(formulas[place])
            if place in formulas
            else values.test(self._plan.test(place))
            for place in places
        ]

    def _ordered(self, names: tuple[str, ...], keys: Keys) -> Keys:
        """Bindings with the columns in the order of the query's nodes and edges."""
        return keys[:, [names.index(name) for name in (*self._kept, *self._edges)]]

    def _collected(self, found: _MatchCollector) -> ExternalRelation:
        def flat(parts: list[Ints]) -> list[int]:
            return [item for part in parts for item in part.tolist()]

        width = len(self._kept) + len(self._edges)
        keys = np.concatenate([np.zeros((0, width), np.int64), *found.bindings])
        nodes = {key: keys[:, number].tolist() for number, key in enumerate(self._kept)}
        named = words()
        edges = {
            key: named[keys[:, len(self._kept) + number]].tolist()
            for number, key in enumerate(self._edges)
        }
        values = [[item for part in parts for item in part] for parts in found.values]
        return ExternalRelation(flat(found.first), flat(found.last), nodes, edges, values)


def _leg(link: StepLink, absent: Ints | None, places: Ints | None) -> Leg:
    return Leg(link.kind, link.after, link.within, absent, places)


def _is_condition(place: Bound) -> bool:
    return isinstance(place, Tense) or (
        isinstance(place, SignalCall) and place.word == "exists_now"
    )


def _chunks(starts: Ints, size: int) -> Iterator[tuple[int, int, slice]]:
    """Keys in parts of so many, with their rows."""
    for low in range(0, len(starts) - 1, size):
        high = min(low + size, len(starts) - 1)
        yield low, high, slice(int(starts[low]), int(starts[high]))


def _picked(column: Column | Any, at: tuple[Any, Any]) -> Any:
    """The values at some places as Python has them; ``None`` where they are unknown."""
    if isinstance(column, np.ndarray):
        return np.broadcast_to(column, (len(column), column.shape[1]))[_row(column, at)].astype(
            object
        )
    shape = np.broadcast_shapes(column.values.shape, np.shape(column.known))
    values, known = np.broadcast_to(column.values, shape), np.broadcast_to(column.known, shape)
    place = _row(values, at)
    told = values[place].astype(object)
    told[~known[place]] = None
    return told


def _row(values: Any, at: tuple[Any, Any]) -> tuple[Any, Any]:
    """Places in an array that may be the same for all bindings, or for all frames."""
    rows = at[0] if values.shape[0] > 1 else np.zeros_like(at[0])
    return rows, (at[1] if values.shape[1] > 1 else np.zeros_like(at[1]))


# What matches a query, of single frames or of several -------------------------------------------


class TemporalMatches(Matches):
    """Matches of a query over single frames or several; see :class:`sgstore.matches.Matches`.

    A match of a sequence is told once: its frame is that in which its last step is found, its interval goes
    from the frame of its first step to that one (to the end of its run, if the last step has a duration).
    """

    @contextmanager
    def _compiled(self) -> Generator[Compiled]:
        with super()._compiled() as compiled:
            if compiled.query.steps:
                # Where time begins what is unknown is false, and would find what nobody knows.
                unknowing = frozenset(self._lacking(compiled))
                knowing = replace(compiled.catalog, unknowing=unknowing)
                ready = replace(compiled, catalog=knowing)
                yield replace(ready, finder=self._finder(ready))
            else:
                yield compiled

    @property
    def reasons(self) -> dict[str, str]:
        """The reason for each of the traces in :attr:`left_out`, by name."""
        found = super().reasons
        with super()._compiled() as compiled:
            lacks = self._lacking(compiled)
            for trace in compiled.chosen:
                if trace.trace_id in lacks:
                    told = [found[trace.name]] if trace.name in found else []
                    found[trace.name] = "; ".join([*told, lacks[trace.trace_id]])
        return found

    def _lacking(self, compiled: Compiled) -> dict[int, str]:
        """The traces that do not know what the query needs, and why."""
        return lacking(self._file, compiled.catalog, of_query(compiled.bound))

    def explain(self) -> str:
        """Explain the query stage by stage; of one over several frames also the questions about each frame."""
        with self._compiled() as compiled:
            text = compiled.stages()
            if not compiled.query.steps:
                return text
            finder = self._finder(compiled)
            places = tuple(with_places(compiled.query)[1])
            return f"{text}\n\n---- plan\n{finder.text(places)}"

    def _finder(self, compiled: Compiled) -> Finder:
        # much: only for who asks what happens over time

        return Finder(self._file, compiled.query, compiled.catalog)
