"""Traces as a plan needs them: the clock, and the relations of atoms and signals, several traces a question."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.history.relations import Relation
from sgstore.lang.found import CLOCK, TRACES, relation
from sgstore.lang.phases import traces_of
from sgstore.lang.results import EXTENTS
from sgstore.matches import Windows
from sgstore.store.covering import trace_of
from sgstore.temporal.columns import evaluate_rows
from sgstore.temporal.formulas import Formula, propositions
from sgstore.temporal.measures import Clock, Column, Measured
from sgstore.vocabulary import RELATIONS
from sgstore.world import GAP

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.bound import Bound, Query
    from sgstore.lang.catalog import Catalog
    from sgstore.lang.phases import Window
    from sgstore.store import StoreFile
    from sgstore.temporal.plans import Plan, Signal, Test
    from sgstore.world import Bools, Ints

    Keys = NDArray[np.int64]

WORDS: Final = np.array(sorted(RELATIONS))
"""Relations in alphabetical order."""

CELLS: Final = 4_000_000
"""Bindings times frames that are worked on at once."""


@dataclass(frozen=True, slots=True)
class Ask:
    """A relation that is asked of a store.

    Attributes
    ----------
    query : Query
        The pattern.
    variables : tuple of str
        Keys of its nodes that are bound: the columns of the relation's keys.
    values : tuple of Bound
        Asked of each match.
    edges : tuple of str
        Keys of its edges that are bound: further columns of the keys, places in :data:`WORDS`.
    """

    query: Query
    variables: tuple[str, ...]
    values: tuple[Bound, ...] = ()
    edges: tuple[str, ...] = ()

    @property
    def everywhere(self) -> bool:
        """Whether it asks nothing, and so holds in every frame."""
        scope = self.query.scope
        return not (scope.nodes or scope.edges or scope.where)


@dataclass(slots=True)
class Trace:
    """One trace while it is looked at.

    Attributes
    ----------
    trace_id : int
    name : str
    frame_ids, numbers, times, log_times : (F,) int64
        Of its frames: ids, numbers (``seq``), simulation times and log times; ns.
    start : int
        Simulation time from which seconds are counted; ns.
    clock : Clock
    relations : dict of str to Relation
    """

    trace_id: int
    name: str
    frame_ids: Ints
    numbers: Ints
    times: Ints
    log_times: Ints
    start: int
    clock: Clock
    relations: dict[str, Relation] = field(default_factory=dict[str, Relation])

    def __len__(self) -> int:
        return len(self.frame_ids)

    @property
    def together(self) -> int:
        """How many bindings are worked on at once, in all frames."""
        return max(CELLS // max(len(self), 1), 1)

    def seconds(self, frame: int) -> float:
        """The time of a frame since the trace began."""
        return float(self.times[frame] - self.start) / 1e9


class Values:
    """The values of a plan's formulas and tests in one trace, for some bindings.

    Parameters
    ----------
    plan : Plan
    trace : Trace
    variables : tuple of str
        What the columns of the bindings are.
    bindings : (B, n) int64
    """

    def __init__(
        self, plan: Plan, trace: Trace, variables: tuple[str, ...], bindings: Keys
    ) -> None:
        self._plan, self._trace = plan, trace
        self._variables, self._bindings = variables, bindings
        self._atoms: dict[str, Bools] = {}

    def formula(self, formula: Formula) -> Bools:
        """(B, F) where a formula is true."""
        columns = self.columns(formula)
        return evaluate_rows(formula, columns, self._trace.clock.times, len(self._bindings))

    def columns(self, formula: Formula) -> dict[str, Bools]:
        """The propositions of a formula: (B, F), or (1, F) where a proposition is the same for all."""
        return {name: self._proposition(name) for name in propositions(formula)}

    def _proposition(self, name: str) -> Bools:
        if name in self._plan.tests:
            found = self.test(self._plan.tests[name]).true
            shape = len(found), len(self._trace)
            return np.broadcast_to(found, shape)
        if name not in self._atoms:
            found = self._trace.relations[name]
            places = found.find(self._projected(self._plan.atoms[name].variables))
            self._atoms[name] = found.flags(places, len(self._trace))
        return self._atoms[name]

    def test(self, test: Test) -> Column:
        """The value of a test."""

        def condition(expression: Bound) -> Bools:
            return self.formula(test.formulas[expression])

        clock = self._trace.clock
        return Measured(test, clock, self._signal, condition, self._proposition).column()

    def _signal(self, signal: Signal) -> Column:
        found = self._trace.relations[signal.name]
        places = found.find(self._projected(signal.variables))
        return found.column(places, len(self._trace))

    def _projected(self, variables: tuple[str, ...]) -> Keys:
        if not variables:
            return np.zeros((1, 0), np.int64)
        return self._bindings[:, [self._variables.index(name) for name in variables]]


def asks_of(plan: Plan) -> dict[str, Ask]:
    """What a plan needs of a store, by the names of its atoms and signals."""
    atoms = {name: Ask(atom.query, atom.variables) for name, atom in plan.atoms.items()}
    signals = {
        name: Ask(signal.query, signal.variables, (signal.value,))
        for name, signal in plan.signals.items()
    }
    return atoms | signals


def traces(
    file: StoreFile,
    catalog: Catalog,
    whole: Query,
    asks: Mapping[str, Ask],
    *,
    gaps: str = "break",
    within: Window | None = None,
) -> Iterator[Trace]:
    """The traces that can answer a query, one after the other, with the relations that are asked.

    They are read a few at a time, the more the fewer rows they have, so that memory does not grow with a store.

    Parameters
    ----------
    file : StoreFile
        It stays as it is while this runs.
    catalog : Catalog
    whole : Query
        Says which traces are asked.
    asks : mapping of str to Ask
        By name.
    gaps : str
        Whether a gap ends a run: ``break``, ``bridge``.
    within : Window, optional
        Buckets of whole traces; by default all.
    """
    extents = file.rows(EXTENTS).values
    if within is not None:
        extents = [one for one in extents if within.low <= one[0] < within.high]
    steps = Windows(extents, whole_traces=True)
    for window in steps:
        found, steps.rows = read(file, catalog, whole, asks, window or within, gaps=gaps)
        yield from found
        del found


def read(
    file: StoreFile,
    catalog: Catalog,
    whole: Query,
    asks: Mapping[str, Ask],
    window: Window | None,
    *,
    gaps: str,
) -> tuple[list[Trace], int]:
    """The traces of a window of whole traces, as :func:`traces` gives them; and how many rows were read."""
    about = {row[0]: row[1:] for row in file.rows(TRACES).values}
    chosen, left = traces_of(whole, catalog)
    asked = (set(about) if chosen is None else chosen) - left
    found = _clocks(file, about, asked, window, gaps)
    rows = sum(_relate(file, catalog, name, ask, window, found) for name, ask in asks.items())
    return list(found.values()), rows


def _clocks(
    file: StoreFile,
    about: Mapping[int, Sequence[Any]],
    asked: set[int],
    window: Window | None,
    gaps: str,
) -> dict[int, Trace]:
    low, high = (window.low << 6, window.high << 6) if window else (0, (1 << 63) - 1)
    clock = {name: np.ma.getdata(c) for name, c in file.arrays(CLOCK, (low, high)).items()}
    ids = clock["frame_id"].astype(np.int64)
    found: dict[int, Trace] = {}
    for trace_id, rows in _by_trace(ids):
        if trace_id not in asked:
            continue
        name, start, period = about[trace_id]
        numbers, times, logs = (
            clock[column][rows].astype(np.int64) for column in ("seq", "time_ns", "log_time_ns")
        )
        ticks = Clock.of(_ascending(times), numbers, period, GAP)
        if gaps == "bridge":
            ticks = replace(ticks, runs=np.zeros_like(ticks.runs))
        found[trace_id] = Trace(trace_id, name, ids[rows], numbers, times, logs, start, ticks)
    return found


def _relate(
    file: StoreFile,
    catalog: Catalog,
    name: str,
    ask: Ask,
    window: Window | None,
    found: Mapping[int, Trace],
) -> int:
    """Ask one relation, and give each trace its part."""
    if ask.everywhere:
        for trace in found.values():
            every = np.arange(len(trace))
            trace.relations[name] = Relation.of(every, np.zeros((len(trace), 0), np.int64))
        return 0
    bound = {*ask.variables, *ask.edges}
    statement = relation(ask.query, catalog, window, ask.values, bound)
    arrays = file.arrays(statement.sql, statement.values)
    ids = np.ma.getdata(arrays["frame_id"]).astype(np.int64)
    columns = [np.ma.getdata(arrays[key]).astype(np.int64) for key in ask.variables]
    columns += [np.searchsorted(WORDS, np.ma.getdata(arrays[k]).astype(str)) for k in ask.edges]
    keys = np.stack(columns, axis=1) if columns else np.zeros((len(ids), 0), np.int64)
    values = [arrays[f":{number}"] for number in range(len(ask.values))]
    order = np.argsort(ids, kind="stable")
    ids, keys, values = ids[order], keys[order], [value[order] for value in values]
    parts = dict(_by_trace(ids))
    nothing = slice(0, 0)
    for trace in found.values():
        rows = parts.get(trace.trace_id, nothing)
        frames = np.searchsorted(trace.frame_ids, ids[rows])
        trace.relations[name] = Relation.of(frames, keys[rows], [value[rows] for value in values])
    return len(ids)


def _by_trace(ids: Ints) -> Iterable[tuple[int, slice]]:
    """The traces of frames in order, and which of them are theirs."""
    if not len(ids):
        return []
    owners = trace_of(ids)
    starts = np.flatnonzero(np.diff(owners, prepend=-1))
    ends = np.append(starts[1:], len(ids))
    return [(int(owners[a]), slice(int(a), int(z))) for a, z in zip(starts, ends, strict=True)]


def _ascending(times: Ints) -> Ints:
    """Times that ascend, where a recording's stand still or go back: a nanosecond later than the one before."""
    ticks = np.arange(len(times))
    return np.maximum.accumulate(times - ticks) + ticks if len(times) else times
