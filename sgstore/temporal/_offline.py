"""Query results and values over time of whole traces, read from the store.

A relation holds, for each binding, the frames of one trace in which a condition is true. Lookups process many
bindings at once.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import QueryError
from sgstore.lang import ir as b
from sgstore.lang.bind import has_pairs
from sgstore.lang.operators import Column
from sgstore.lang.sql import (
    BUCKETS,
    CLOCK,
    CLOCK_OF_TRACES,
    TIMES,
    TRACES,
    Window,
    extents,
    relation,
    traces_of,
)
from sgstore.matches import TooMuchError, Windows
from sgstore.model.frame_ids import FRAME_BITS
from sgstore.model.vocabulary import RELATIONS
from sgstore.temporal._check_plan import FAVOURABLE, SIGNS, CheckPlan
from sgstore.temporal._formula import Formula, propositions, tolerant
from sgstore.temporal._plan import Ask, ask_text
from sgstore.temporal._robustness import MARGIN_CELLS, MarginTable, margin_columns
from sgstore.temporal._signal_values import SignalValues
from sgstore.temporal._signals import evaluate_rows
from sgstore.temporal._trace_group import (
    TimedRelation,
    TraceGroup,
    TraceReader,
    codes_of,
    ordering,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import Bound, Query, SignalCall
    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.store import StoreFile
    from sgstore.temporal._plan import Plan, Test

    Keys = NDArray[np.int64]


REMEDY: Final = (
    "restrict the nodes: add a label, an edge between them, or a condition, such as (v:Vehicle)"
)
"""Remedy for a query with too many combinations of nodes."""


def refuse_many(bindings: int, told: str) -> None:
    """Raise an error if a query has too many combinations of nodes in one trace.

    Raises
    ------
    QueryError
        The message names the nodes.
    """
    if bindings > MOST_BINDINGS:
        raise QueryError(
            f"{told}: {bindings:,} combinations of nodes in one trace, expected at most {MOST_BINDINGS:,}",
            hint=REMEDY,
        )


# Trace data for a plan: clock, and relations of atoms and signals, for several traces per query


def words() -> NDArray[np.str_]:
    """Return the names of all scene graph relations in alphabetical order."""
    return np.array(sorted(RELATIONS))


ROW_BYTES: Final = 100
"""Memory to sort one row with two or three nodes; bytes."""

ROWS_LESS: Final = 4
"""Number of rows in a table that take as much memory as one row in the count of :class:`Windows`."""

EDGE_BYTES: Final = 100
"""Additional memory for each edge in a row; bytes."""


_LAST: Final = (1 << 63) - 1

MOST_BINDINGS: Final = 5_000_000
"""Largest number of node combinations in one trace."""

NODES_NAMED: Final = 1_000
"""Largest number of node ids that a query can be limited to, because each id is a parameter."""


class PlanValues(SignalValues):
    """Values of temporal formulas and expressions in all frames of one trace, for some combinations of nodes.

    Parameters
    ----------
    plan : Plan
    trace : TraceReader
    variables : tuple of str
        Variables of the binding columns.
    bindings : (B, n) int64
    counted : str
        For a check: sign of the unknown propositions that count as true.
    """

    def __init__(
        self,
        plan: Plan,
        trace: TraceReader,
        variables: tuple[str, ...],
        bindings: Keys,
        counted: str = FAVOURABLE,
    ) -> None:
        super().__init__(trace.clock)
        self._plan, self._trace = plan, trace
        self._variables, self._bindings = variables, bindings
        self._counted = counted
        self._atoms: dict[str, Bools] = {}
        self._tests: dict[str, Column] = {}

    def evaluation(self, counted: str) -> PlanValues:
        """Return a copy in which unknown conditions all count for the check, or all count against the check.

        Other values are shared.
        """
        found = copy(self)
        found._counted = counted  # noqa: SLF001 - of one's own kind
        return found

    def test(self, test: Test) -> Column:
        """Return the values of an expression over several frames. They are computed once and cached."""
        if test.name not in self._tests:
            self._tests[test.name] = super().test(test)
        return self._tests[test.name]

    def formula(self, formula: Formula) -> Bools:
        """Return a mask (B, F): for each node combination and frame, true if a temporal formula is true."""
        lenient = tolerant(formula, self.clock.tolerance)
        times, rows = self.clock.times, len(self._bindings)
        return evaluate_rows(lenient, self.columns(formula), times, rows)

    def columns(self, formula: Formula) -> dict[str, Bools]:
        """Return the truth of each single-frame condition of a formula as a mask: name → (B, F) or (1, F).

        (1, F) is equal for all node combinations.
        """
        return {name: self.proposition(name) for name in propositions(formula)}

    def proposition(self, name: str) -> Bools:
        """Return a mask of the frames in which a single-frame condition of a formula is true."""
        if name[-1] in SIGNS:
            if name[-1] != self._counted:
                return np.zeros((1, len(self._trace)), np.bool_)
            name = name[:-1]
        if name in self._plan.tests:
            found = self.test(self._plan.tests[name]).true
            return np.broadcast_to(found, (len(found), len(self._trace)))
        if name not in self._atoms:
            found = self._trace.relations[name]
            places = found.find(self._projected(self._plan.atoms[name].variables))
            self._atoms[name] = found.flags(places, len(self._trace))
        return self._atoms[name]

    def condition(self, expression: Bound, test: Test) -> Bools:
        """Return a mask of the frames in which the condition inside ``run_length(…)`` or similar is true."""
        return self.formula(test.formulas[expression])

    def margins(self, course: SignalCall, test: Test) -> Floats:
        """Return the margin of the condition in ``robustness(…)``, for each combination and frame, (B, F)."""
        rows, size = len(self._bindings), max(self._trace.together // MARGIN_CELLS, 1)
        if rows > size:
            parts = (self._bindings[low : low + size] for low in range(0, rows, size))
            about = self._plan, self._trace, self._variables
            found = [PlanValues(*about, part).margins(course, test) for part in parts]
            return np.concatenate(found)
        formula, tolerance = test.quantities[course.operand], self.clock.tolerance
        columns = margin_columns(self._plan, formula, self.test, self.proposition, tolerance)
        value = MarginTable(columns, self.clock.times, tolerance).value(formula)
        return np.broadcast_to(value, (rows, len(self._trace)))

    def signal(self, signal: Ask) -> Column:
        """Return a number such as a speed for each node combination and frame, (B, F)."""
        if isinstance(self._plan, CheckPlan) and signal.name in self._plan.states:
            return self._state(*self._plan.states[signal.name])
        found = self._trace.relations[signal.name]
        places = found.find(self._projected(signal.variables))
        return found.column(places, len(self._trace))

    def _state(self, of: Ask | None, doubt: str | None) -> Column:
        """For each node combination and frame, return 1 if the value is unknown, otherwise 0, (B, F).

        Frames without the entity are masked.
        """
        frames = len(self._trace)
        if of is None:
            return Column(np.zeros((1, frames)), np.ones((1, frames), np.bool_))
        found = self._trace.relations[of.name]
        there = found.flags(found.find(self._projected(of.variables)), frames)
        values = np.zeros((1, frames)) if doubt is None else self.proposition(doubt)
        return Column(np.broadcast_to(values, there.shape).astype(np.float64), there)

    def _projected(self, variables: tuple[str, ...]) -> Keys:
        if not variables:
            return np.zeros((1, 0), np.int64)
        return self._bindings[:, [self._variables.index(name) for name in variables]]


Alternatives = frozenset[frozenset[str]]


@dataclass(frozen=True, slots=True)
class Premises:
    """Sets of queries. A trace that violates a check has matches of all queries of at least one set.

    Attributes
    ----------
    alternatives : frozenset of frozenset of str
    asks : mapping of str to Ask
        All queries of the check by name.
    """

    alternatives: Alternatives
    asks: Mapping[str, Ask]

    @property
    def order(self) -> list[str]:
        """Names of the queries in the order in which to run them: few matches and low cost first."""
        named = {name for one in self.alternatives for name in one}

        def rank(name: str) -> tuple[bool, bool, int]:
            ask = self.asks[name]
            return name not in named, _is_dense(ask), len(ask.variables)

        return sorted(self.asks, key=rank)

    def left(self, relations: Mapping[str, TimedRelation]) -> list[frozenset[str]]:
        """Return the sets of queries that are still possible: all of their queries run so far had a match."""
        empty = {name for name, one in relations.items() if not len(one.keys)}
        return [one for one in self.alternatives if not one & empty]

    def nodes(self, ask: Ask, traces: Iterable[TraceReader]) -> dict[str, Ints]:
        """For some traces, return the nodes that a query can be limited to: variable → node ids."""
        found: dict[str, list[Ints] | None] = {name: [] for name in ask.variables}
        for trace in traces:
            for one in self.left(trace.relations):
                for name, sofar in found.items():
                    held = [
                        trace.relations[other].keys[:, self.asks[other].variables.index(name)]
                        for other in one
                        if other in trace.relations and name in self.asks[other].variables
                    ]
                    if not held:
                        found[name] = None
                    elif sofar is not None:
                        few = held[0]
                        for more in held[1:]:
                            few = few[np.isin(few, more)]
                        sofar.append(few)
        return {
            name: np.unique(np.concatenate([np.zeros(0, np.int64), *ids]))
            for name, ids in found.items()
            if ids is not None
        }


def _is_dense(ask: Ask) -> bool:
    """True if all conditions of a query are negations, so that it probably has many matches."""
    return all(isinstance(c, b.Operation) and c.word == "NOT" for c in ask.query.scope.where)


def traces(
    file: StoreFile,
    catalog: Catalog,
    whole: Query,
    asks: Mapping[str, Ask],
    *,
    gaps: str = "break",
    within: Window | None = None,
    premises: Premises | None = None,
) -> Iterator[TraceReader]:
    """Yield the traces that have the data of a query, loaded into memory, in the order of the catalog.

    Traces are read in small groups, so memory does not grow with the store. If a group has too many rows, its
    halves are read again.

    Parameters
    ----------
    file : StoreFile
        Store; it must not change during the iteration.
    catalog : Catalog
    whole : Query
        Query that selects the traces.
    asks : mapping of str to Ask
        By name.
    gaps : str
        Effect of a gap on a run: ``break`` or ``bridge``.
    within : Window, optional
        Buckets of whole traces; by default all.
    premises : Premises, optional
        Premises of a check, to read only what its evaluation needs.

    Raises
    ------
    QueryError
        A query has too many matches in one trace.
    """
    ask = partial(read, file, catalog, whole, asks, gaps=gaps, premises=premises)
    ordered = [trace.trace_id for trace in catalog.traces]
    for group in _groups(extents(catalog), within, ask):
        places = {trace: place for place, trace in enumerate(group.ids.tolist())}
        for trace in ordered:
            if trace in places:
                yield group.reader(places[trace])


def groups(
    file: StoreFile,
    catalog: Catalog,
    whole: Query,
    asks: Mapping[str, Ask],
    *,
    gaps: str = "break",
    within: Window | None = None,
) -> Iterator[TraceGroup]:
    """Yield the same traces as :func:`traces`, by trace id. They are loaded in groups, which is faster."""
    every = sorted(extents(catalog))

    def ask(window: Window | None) -> tuple[TraceGroup, int]:
        part = None if window is None else window.whole(every)
        return read(file, catalog, whole, asks, part, gaps=gaps)

    yield from _groups(every, within, ask)


def _groups(
    every: list[tuple[int, int]],
    within: Window | None,
    ask: Callable[[Window | None], tuple[TraceGroup, int]],
) -> Iterator[TraceGroup]:
    asked = [one for one in every if within is None or one[0] in within]
    steps = Windows(asked, whole_traces=True)
    for window in steps:
        for found, rows in steps.parts(window or within, ask):
            steps.rows += rows // ROWS_LESS
            yield found


def read(
    file: StoreFile,
    catalog: Catalog,
    whole: Query,
    asks: Mapping[str, Ask],
    window: Window | None,
    *,
    gaps: str,
    premises: Premises | None = None,
) -> tuple[TraceGroup, int]:
    """Return the traces of a window of frames, loaded into memory, and the number of rows read.

    Raises
    ------
    TooMuchError
        The rows exceed the memory limit.
    """
    about = chosen_traces(file, whole, catalog)
    group = TraceGroup.of(about, frame_times(file, window), gaps)
    rows, memory = 0, file.memory
    for leader, names in _together(asks, premises).items():
        ask = asks[leader]
        left = _left(ask, group, premises)
        narrower = _narrowed(ask, group, left, premises)
        if narrower is None:
            group.relations |= {name: no_rows(asks[name]) for name in names}
            continue
        size = ROW_BYTES + EDGE_BYTES * len(ask.edges)
        where = window if left.all() else _window_of(group.ids[left].tolist(), catalog)
        named = {name: asks[name] for name in names}
        many = _relate(file, catalog, named, narrower, where, group, memory // size)
        rows, memory = rows + many, memory - many * size
    return group, rows


def _together(asks: Mapping[str, Ask], premises: Premises | None) -> dict[str, list[str]]:
    """Group the queries that are read together: name of the first query → names of its group.

    The other queries of a group return values of the same matches, or are conditions on them.
    """
    order = list(asks) if premises is None else premises.order
    groups: dict[str, list[str]] = {}
    for name in order:
        leaders = order if premises is None else list(groups)[-1:]
        led = (one for one in leaders if _is_among(asks[name], asks[one], premises))
        groups.setdefault(next(led, name), []).append(name)
    return groups


def _is_among(ask: Ask, leader: Ask, premises: Premises | None) -> bool:
    """True if the matches of a query can be read together with those of another query.

    The conditions are such that the matches of the leader are not slower to find: numbers of two entities.
    Premises limit the matches of conditions, so their queries come first.
    """
    if leader.value is None or ask.edges or leader.edges:
        return False
    one, two = ask.query.scope, leader.query.scope
    if (
        (ask.variables, ask.after) != (leader.variables, leader.after)
        or (one.nodes, one.edges, one.distinct) != (two.nodes, two.edges, two.distinct)
        or replace(ask.query, scope=two) != leader.query
    ):
        return False
    if ask.value is not None or premises is not None:
        return ask.value is not None and one.where == two.where
    more = _conditions_among(ask, leader)
    return (
        len(more) == len(one.where) - len(two.where)
        and any(map(has_pairs, more))
        and not any(map(b.blocks_of, more))
    )


def _conditions_among(ask: Ask, leader: Ask) -> list[Bound]:
    wider = leader.query.scope.where
    return [one for one in ask.query.scope.where if one not in wider]


def _narrowed(ask: Ask, group: TraceGroup, left: Bools, premises: Premises | None) -> Ask | None:
    """Return a single-frame query that searches only the nodes that earlier queries matched.

    ``None`` means that they matched no nodes.
    """
    if not left.any():
        return None
    ids = {} if premises is None else premises.nodes(ask, _readers(group, left))
    narrow = ask.loose or ask.value is not None
    for before in ask.after:
        keys = group.relations[before.name].keys
        keys = keys[left[keys[:, 0]], 1:]
        for node in set(before.variables) & set(ask.variables) if narrow else ():
            held = np.unique(keys[:, before.variables.index(node)])
            ids[node] = np.intersect1d(ids[node], held) if node in ids else held
    few = {node: held.tolist() for node, held in ids.items() if len(held) <= NODES_NAMED}
    return ask.among(few) if few else ask


def _left(ask: Ask, group: TraceGroup, premises: Premises | None) -> Bools:
    """Return a mask of the traces that a query must still search: earlier queries have matches there."""
    found = np.ones(len(group.ids), np.bool_)
    for before in ask.after:
        found &= np.bincount(group.relations[before.name].keys[:, 0], minlength=len(found)) > 0
    if premises is not None:
        for place in np.flatnonzero(found).tolist():
            found[place] = bool(premises.left(group.reader(place).relations))
    return found


def _readers(group: TraceGroup, chosen: Bools) -> list[TraceReader]:
    return [group.reader(place) for place in np.flatnonzero(chosen).tolist()]


def _window_of(traces: Collection[int], catalog: Catalog) -> Window:
    return Window.of([one.extent for one in catalog.traces if one.trace_id in traces])


def no_rows(ask: Ask) -> TimedRelation:
    """Return an empty table of matches for a query."""
    keys = np.zeros((0, 1 + len(ask.columns)), np.int64)
    values = () if ask.value is None else (np.ma.masked_all(0),)
    return TimedRelation.of(np.zeros(0, np.int64), keys, values)


def chosen_traces(file: StoreFile, query: Query, catalog: Catalog) -> dict[int, tuple[Any, ...]]:
    """Return the selected traces with data for the query: id → name, start (ns) and frame period (ns)."""
    chosen, left = traces_of(query, catalog)
    return {
        row[0]: tuple(row[1:])
        for row in file.rows(TRACES).values
        if row[0] not in left and (chosen is None or row[0] in chosen)
    }


def frame_times(file: StoreFile, window: Window | None) -> dict[str, Ints]:
    """Return ids, numbers, times and log times of all frames in a window, ordered by id."""
    low, high = (window.low << FRAME_BITS, window.high << FRAME_BITS) if window else (0, _LAST)
    sql, values = CLOCK, (low, high)
    if window and window.traces is not None:
        sql, values = CLOCK_OF_TRACES, (low, high, list(window.traces))
    found = file.arrays(sql, values, plain=True).items()
    return {name: np.ma.getdata(column).astype(np.int64) for name, column in found}


def buckets_of(file: StoreFile, window: Window | None) -> dict[str, Ints]:
    """Return the buckets (60 frames each) of a window. A bit mask marks the existing frames of each.

    One mask has all frames, one has the frames without a gap before them.
    """
    low, high = (window.low, window.high) if window else (0, _LAST)
    return _ordered(file, BUCKETS, low, high)


def times_of(file: StoreFile, window: Window | None) -> tuple[Ints, Ints]:
    """Return the ordered frame ids of a window, and their times; ns."""
    low, high = (window.low << FRAME_BITS, window.high << FRAME_BITS) if window else (0, _LAST)
    ids, times = _ordered(file, TIMES, low, high).values()
    return ids, times


def _ordered(file: StoreFile, sql: str, low: int, high: int) -> dict[str, Ints]:
    """Return the columns of an SQL query on a range of frames as integers, sorted by the first column."""
    asked = file.arrays(sql, (low, high), plain=True).items()
    found = {name: np.ma.getdata(column).astype(np.int64) for name, column in asked}
    first = next(iter(found.values()))
    if np.any(np.diff(first) < 0):
        order = np.argsort(first, kind="stable")  # merges traces that are sorted already
        return {name: column[order] for name, column in found.items()}
    return found


def arrays_of(
    file: StoreFile,
    catalog: Catalog,
    ask: Ask,
    window: Window | None,
    values: Sequence[Bound],
    most: int,
) -> tuple[Ints, Keys, list[Any]]:
    """Return all matches of a single-frame query as arrays: frame ids, node ids and values; not sorted.

    For a signal, the relations of its edges follow the nodes.

    Raises
    ------
    TooMuchError
        The number of rows exceeds ``most``.
    """
    bound = {*ask.variables, *ask.edges}
    statement = relation(ask.query, catalog, window, values, bound, most + 1)
    *before, last = statement.steps()
    arrays = file.arrays(*last, given=before, plain=True)
    ids = np.ma.getdata(arrays["frame_id"]).astype(np.int64, copy=False)
    if len(ids) > most:
        raise _too_many(catalog, ask, window, most)
    return ids, _keys(ask, arrays, len(ids)), [arrays[f":{n}"] for n in range(len(values))]


def masks_of(
    file: StoreFile, catalog: Catalog, ask: Ask, window: Window | None, most: int
) -> tuple[Ints, Keys, Ints]:
    """Return all matches of a single-frame query as unsorted arrays: buckets, node ids, frame masks.

    Raises
    ------
    TooMuchError
        The masks have more than ``most`` frames.
    """
    bound = {*ask.variables, *ask.edges}
    statement = relation(ask.query, catalog, window, (), bound, most + 1, masked=True)
    *before, last = statement.steps()
    arrays = file.arrays(*last, given=before, plain=True)
    buckets, masks = (
        np.ma.getdata(arrays[name]).astype(np.int64, copy=False) for name in ("bucket", "frames")
    )
    if int(np.bitwise_count(masks).sum()) > most:
        raise _too_many(catalog, ask, window, most)
    return buckets, _keys(ask, arrays, len(buckets)), masks


def _too_many(catalog: Catalog, ask: Ask, window: Window | None, most: int) -> TooMuchError:
    held = (one.name for one in catalog.traces if window is None or one.extent[0] in window)
    return TooMuchError(
        f"{ask_text(ask)} holds for more than {most:,} combinations of nodes and frames of"
        f" {', '.join(held)}, more than memory may take",
        hint=f"{REMEDY}; or allow more memory",
    )


def _keys(ask: Ask, arrays: Mapping[str, Any], rows: int) -> Keys:
    """Return the columns of nodes and edges of a result. Each relation is an index in :func:`words`."""
    columns = [np.ma.getdata(arrays[key]).astype(np.int64, copy=False) for key in ask.variables]
    columns += [np.searchsorted(words(), np.ma.getdata(arrays[k]).astype(str)) for k in ask.edges]
    return np.stack(columns, axis=1) if columns else np.zeros((rows, 0), np.int64)


def _relate(
    file: StoreFile,
    catalog: Catalog,
    asks: Mapping[str, Ask],
    leader: Ask,
    window: Window | None,
    group: TraceGroup,
    most: int,
) -> int:
    """Run the first query of a group, store the matches of the group in traces, and return their number.

    ``asks`` are the queries that are read with it, ``most`` is the largest number allowed.
    """
    if leader.everywhere:
        starts = group.starts.copy()
        keys = np.arange(len(group.ids))[:, None]
        table = TimedRelation(keys, starts, np.arange(len(group.frame_ids)))
        group.relations |= dict.fromkeys(asks, table)
        return 0
    if leader.value is None:
        table = group.table(*masks_of(file, catalog, leader, window, most))
        group.relations |= dict.fromkeys(asks, table)
        return len(table.frames)
    asked = [
        b.all_of(*_conditions_among(ask, leader)) if ask.value is None else ask.value
        for ask in asks.values()
    ]
    ids, keys, values = arrays_of(file, catalog, leader, window, asked, most)
    told = 1 + len(leader.columns)
    frames = group.places(ids)
    keys = np.column_stack((group.owners(frames), keys))
    known = (frames >= 0) & _deciding(asks, keys, values)
    if not known.all():
        frames, keys = frames[known], keys[known]
        values = [value[known] for value in values]
    order = ordering([*keys.T[:told], frames, *keys.T[told:]])
    keys, frames = keys[order, :told], frames[order]
    table = TimedRelation.ordered(frames, keys, [value[order] for value in values])
    for (name, ask), value in zip(asks.items(), table.values, strict=True):
        if ask.value is None:
            true = np.ma.filled(value, fill_value=False)
            rows = np.repeat(table.keys, np.diff(table.starts), axis=0)[true]
            group.relations[name] = TimedRelation.ordered(table.frames[true], rows)
        else:
            group.relations[name] = replace(table, values=(value,))
    return len(ids)


def _deciding(asks: Mapping[str, Ask], keys: Keys, values: Sequence[Any]) -> Bools:
    """Return a mask of the rows to keep: of rows with the same nodes, only that with the smallest value.

    Rows that meet a condition, and those with an unknown value, are always needed.
    """
    lowest = {name for name, ask in asks.items() if ask.least is not None}
    signals = {name for name, ask in asks.items() if ask.value is not None}
    if not lowest or signals != lowest.union(*(asks[name].least or () for name in lowest)):
        return np.ones(len(keys), np.bool_)
    found, codes = np.zeros(len(keys), np.bool_), codes_of(keys)
    for (name, ask), column in zip(asks.items(), values, strict=True):
        unknown = np.ma.getmaskarray(column)
        found |= np.ma.filled(column, fill_value=False) if ask.value is None else unknown
        if name in lowest:
            numbers = np.where(unknown, np.nan, np.ma.getdata(column))
            found |= np.isnan(numbers)
            least = np.full(int(codes.max(initial=-1)) + 1, np.inf)
            np.fmin.at(least, codes, numbers)
            found |= numbers == least[codes]
    return found
