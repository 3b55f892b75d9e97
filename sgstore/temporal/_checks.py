"""Evaluation of ``CHECK`` statements over a store: verdicts and violations for each trace.

If a trace lacks data for a check, the verdict is ``unknown``, with the reason.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property, partial
from heapq import merge
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.display import IN_NOTEBOOK
from sgstore.errors import QueryError
from sgstore.lang.bind import not_computed, of_check
from sgstore.lang.help import compared_in_check
from sgstore.lang.library import statement
from sgstore.lang.sql import compile_checks, entities, relation, traces_of
from sgstore.matches import Interval, notes_in
from sgstore.model.frame_ids import trace_of
from sgstore.model.scope import scope_of
from sgstore.model.vocabulary import natural
from sgstore.temporal._check_plan import (
    FAVOURABLE,
    SIGNS,
    UNFAVOURABLE,
    WHOLE,
    WITHOUT_ABSENCE,
    base_name,
    empty_plan,
    misses_absent,
    plan_of_check,
)
from sgstore.temporal._check_verdict import (
    Verdict,
    ViolationInterval,
    columns_returned,
    doubt_text,
    returned_by,
    unknown_notes,
    verdict_columns,
    verdict_of,
    verdict_rows,
    within_range,
)
from sgstore.temporal._formula import (
    Formula,
    Proposition,
    formula_text,
    looks_ahead,
    propositions,
    tolerant,
)
from sgstore.temporal._known_range import ShortRange, short_ranges
from sgstore.temporal._match_values import AT_FRAME, ReturnedValues, Stretches
from sgstore.temporal._matches import lacking
from sgstore.temporal._offline import PlanValues, Premises, frame_times, traces
from sgstore.temporal._plan import (
    kept_throughout,
    needs_text,
    never_applies,
    plan_of_returned,
    plan_text,
)
from sgstore.temporal._premises import bindings_of, premises_of
from sgstore.temporal._quantifiers import (
    HOLDS,
    PENDING,
    UNKNOWN,
    VIOLATED,
    Level,
    folded_margins,
    folded_values,
    innermost,
    levels_among,
    levels_of,
    may_wait,
    newcomers,
    number_of_bindings,
    waits_for_newcomers,
)
from sgstore.temporal._robustness import (
    MARGIN_CELLS,
    MarginTable,
    Robustness,
    apart_from_absence,
    condition_text,
    least_values,
    margin_columns,
)
from sgstore.temporal._verdicts import (
    CERTAINLY_TRUE,
    PRESUMABLY_TRUE,
    Settled,
    Violation,
    always_true,
    violations_of_always,
    within_bounds,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.bind import CheckInCatalog
    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import BoundQuantifier, OverMatch
    from sgstore.lang.sql import Window
    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.store import StoreFile
    from sgstore.temporal._plan import Ask
    from sgstore.temporal._trace_group import TraceReader

    Codes = NDArray[np.int8]
    Keys = NDArray[np.int64]
    Statuses = NDArray[np.int8]
    Array = NDArray[Any]


class CheckRun:
    """Evaluation of the checks in a text on a store. Iteration yields verdicts, trace by trace.

    Parameters
    ----------
    file : StoreFile
    catalog : function
        Function that returns the catalog of the store.
    text : str
        ``CHECK`` statements, with the predicates that they need.
    parameters : mapping of str to value
    sgsm_compat : bool
        True for SGSM mode: a trace violates a check if any prefix of it does. Violations are then the last
        frames of such prefixes.
    status : bool
        True to also return the status of each frame.

    Raises
    ------
    QueryError
        The text has no checks, or they are invalid. The message gives the place.

    Examples
    --------
    >>> text = "CHECK slow: ALWAYS ego.speed < 14; CHECK still: ALWAYS ego.speed < 1"
    >>> for verdict in store.check(text):
    ...     print(verdict.check, verdict.trace, verdict.verdict)
    slow town true
    still town false
    """

    def __init__(
        self,
        file: StoreFile,
        catalog: Callable[[], Catalog],
        text: str,
        parameters: Mapping[str, object],
        *,
        sgsm_compat: bool = False,
        status: bool = False,
    ) -> None:
        self._file, self._catalog = file, catalog
        text, parameters = statement(text, parameters, check=True)
        self._text, self._parameters = text, parameters
        self._compat, self._status = sgsm_compat, status
        with file.snapshot():
            self._checks = compile_checks(text, catalog(), parameters)

    def __repr__(self) -> str:
        return f"<CheckRun of {', '.join(self.names)}>"

    def _repr_html_(self) -> str:
        """Evaluate the checks, and return verdicts and first violations as an HTML table for notebooks."""
        from sgstore.base.display import html_table

        found = list(self)
        words = Counter(one.verdict for one in found)
        caption = ", ".join(f"{number} {word}" for word, number in words.items()) or "no trace"
        margin = self.quantitative
        told: dict[str, Any] = {"margin": margin, "returned": columns_returned(self.returned)}
        every = (row for one in found for row in verdict_rows(one, **told))
        rows = list(islice(every, IN_NOTEBOOK + 1))
        notes = unknown_notes((one.check, one.trace, one.reason) for one in found)
        notes += [f"the first {IN_NOTEBOOK} rows"] if len(rows) > IN_NOTEBOOK else []
        return html_table(verdict_columns(**told), rows[:IN_NOTEBOOK], caption, "; ".join(notes))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the checks in the text, in order.

        Examples
        --------
        >>> store.check("CHECK slow: ALWAYS ego.speed < 14; CHECK ALWAYS ego.speed < 20").names
        ('slow', 'check 2')
        """
        return tuple(one.check.name for one in self._checks)

    @property
    def quantitative(self) -> bool:
        """True if at least one check of the text requests its robustness.

        Examples
        --------
        >>> store.check("CHECK slow: ALWAYS ego.speed < 14").quantitative
        False
        >>> store.check("CHECK slow: ALWAYS ego.speed < 14 ROBUSTNESS").quantitative
        True
        """
        return any(one.check.robustness for one in self._checks)

    @property
    def lasting(self) -> bool:
        """True if every check only requires a condition for all entities in every frame.

        Frames then have margins.

        Examples
        --------
        >>> store.check("CHECK slow: ALWAYS ego.speed < 14").lasting
        True
        >>> store.check("CHECK stops: EVENTUALLY ego.speed < 1").lasting
        False
        """
        return all(kept_throughout(one.check) is not None for one in self._checks)

    @property
    def returned(self) -> dict[str, tuple[str, ...]]:
        """``RETURN`` column names of each check: check name → column names.

        Examples
        --------
        >>> store.check("CHECK apart: FORALL (v:Vehicle) ALWAYS gap(ego, v) > 1 RETURN v.kind").returned
        {'apart': ('v.kind',)}
        """
        return returned_by(one.check for one in self._checks)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on likely mistakes in the checks, such as a text that equals no name in the store.

        Examples
        --------
        >>> store.check("CHECK none: FORALL (v:Vehicle) ALWAYS NOT v.name = 'car 7'").notes
        ("the store has no name 'car 7'; the nearest is 'car 0'",)
        """
        with self._file.snapshot():
            compared = [pair for one in self._checks for pair in compared_in_check(one.check)]
            found = dict.fromkeys(compared)
            doubts = dict.fromkeys(note for one in self._checks for note in one.check.doubts)
            return (*doubts, *notes_in(self._file, found, self._text, self._parameters))

    @property
    def scope(self) -> dict[str, Any]:
        """Data that settings exclude from the checked traces; see :func:`sgstore.model.scope.scope_of`.

        Examples
        --------
        >>> scope = store.check("CHECK slow: ALWAYS ego.speed < 14").scope
        >>> scope["world"], scope["states"], scope["beyond_world"]
        (200.0, 36189, 3153)
        """
        world = any(one.check.world for one in self._checks)
        with self._file.snapshot():
            return scope_of((one.report for one in self._file.traces()), world=world)

    def __iter__(self) -> Iterator[Verdict]:
        with self._file.snapshot():
            for one in compile_checks(self._text, self._catalog(), self._parameters):
                check = StoreCheck(self._file, one, compat=self._compat, status=self._status)
                yield from check.verdicts()

    def unknown(self) -> Iterator[Verdict]:
        """Yield the unknown verdicts of the traces that lack data for a check.

        Other traces are not evaluated.

        Examples
        --------
        >>> list(store.check("CHECK slow: ALWAYS ego.speed < 14").unknown())
        []
        >>> for verdict in store.check("CHECK safe: ALWAYS NOT HAPPENS collision(ego)").unknown():
        ...     print(verdict)
        <Verdict 'safe' of 'town': unknown, it does not record events of the kind collision>
        """
        with self._file.snapshot():
            for one in compile_checks(self._text, self._catalog(), self._parameters):
                yield from StoreCheck(self._file, one, compat=False, status=False).unknown()

    def margins(self) -> Iterator[tuple[Ints, Floats]]:
        """Yield, for each trace, frame ids and robustness margins. The text must have only one check.

        See :meth:`StoreCheck.margins`.

        Yields
        ------
        frame_ids : (F,) int64
            Frame ids of an answerable trace.
        margins : (F,) or (1,) float64

        Examples
        --------
        >>> run = store.check("CHECK slow: ALWAYS ego.speed < 14 ROBUSTNESS")
        >>> for frames, margins in run.margins():
        ...     print(len(frames), "frames, margin", round(float(margins.min()), 2))
        750 frames, margin 1.8
        """
        with self._file.snapshot():
            (one,) = compile_checks(self._text, self._catalog(), self._parameters)
            check = StoreCheck(self._file, one, margins=True)
            for trace in check.readers():
                if len(trace):
                    yield trace.frame_ids, check.margins(trace)

    def explain(self) -> str:
        """Return a text with the evaluation plan of each check: temporal formula and single-frame queries.

        Examples
        --------
        >>> plan = store.check("CHECK slow: ALWAYS ego.speed < 14").explain()
        >>> plan.splitlines()[1]
        'formula NOT (TRUE UNTIL (a1 OR a2-))'
        """
        parts = [
            StoreCheck(self._file, one, compat=False, status=False).text() for one in self._checks
        ]
        return "\n\n".join(parts)


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Verdict of a check for each combination of entities, with its violations.

    Attributes
    ----------
    codes : (B,) int8
        From :data:`VIOLATED` to :data:`HOLDS`.
    told : list of (violations, status, false frames)
    in_gap : (B,) bool
        True if the verdict depends on events in a gap.
    """

    codes: Codes
    told: list[_BindingVerdict]
    in_gap: Bools


_BindingVerdict = tuple[tuple[Violation, ...], "Statuses | None", "Bools | None"]
"""Violations of one binding (combination of entities), and its status after each frame if requested.

Third: the frames in which the condition of an ``ALWAYS`` check is false."""

_NOTHING: Final[_BindingVerdict] = (), None, None


class StoreCheck:
    """Evaluation of one check on the traces of a store.

    Parameters
    ----------
    file : StoreFile
        Store; it must not change during use.
    one : CheckInCatalog
    compat, status : bool
        See ``sgsm_compat`` and ``status`` of :class:`CheckRun`.
    margins : bool
        True if :meth:`margins` will be called.
    """

    def __init__(
        self,
        file: StoreFile,
        one: CheckInCatalog,
        *,
        compat: bool = False,
        status: bool = False,
        margins: bool = False,
    ) -> None:
        check, self._bound = one.check, one
        self._file, self._check, self._catalog = file, check, one.catalog
        self._compat, self._want_status = compat, status
        self._plan, self._formula, self._reset, self._guards = plan_of_check(check)
        self._whole, self._variables = self._plan.whole, self._plan.bound
        self._returned = ReturnedValues(check.returns, "first", check.having)
        self._values = plan_of_returned(check)
        for part in self._returned.parts:
            self._values.test(part.operand)
            if part.at is not None:
                self._values.test(part.at)
        self._quantity = self._plan.margin(check.formula, WHOLE) if check.robustness else None
        self._apart = None
        if check.robustness and misses_absent(check):
            self._apart = self._plan.margin(check.formula, WITHOUT_ABSENCE)
        self._lasting = kept_throughout(check)
        ranked = self._lasting or check.formula
        self._ranked = self._plan.margin(ranked, WHOLE) if margins else None
        self._least: list[Ask] = []
        always = None if self._quantity is None else always_true(self._quantity)
        if always is not None and not margins:
            for name, known in least_values(self._plan, always).items():
                self._least.append(replace(self._plan.signals[name], least=known))
                self._plan.signals[name] = self._least[-1]
        self._people: dict[int, dict[str, dict[int, str]]] = {}

    @cached_property
    def _lacks(self) -> dict[int, str]:
        """Return the traces that lack data for the check: trace id → reason."""
        found = lacking(self._file, self._catalog, of_check(self._check))
        for facts in self._catalog.traces:
            reasons = not_computed(self._check, facts), found.get(facts.trace_id, "")
            if any(reasons):
                found[facts.trace_id] = "; ".join(filter(None, reasons))
        return found

    @cached_property
    def _short(self) -> Mapping[int, ShortRange]:
        return short_ranges(self._file, self._catalog, self._check)

    @cached_property
    def _knowing(self) -> Catalog:
        return replace(self._catalog, unknowing=frozenset(self._lacks))

    def text(self) -> str:
        """Return the evaluation plan of the check as text."""
        head = [f"---- {self._check.name}"]
        head += [f"{q.word} {', '.join(q.nodes)}" for q in self._check.quantifiers]
        plan = plan_text(self._plan, self._formula, self._reset, self._catalog)
        quantity = [] if self._quantity is None else [f"robustness {formula_text(self._quantity)}"]
        returned = needs_text(self._values, self._catalog)
        return "\n".join([*head, plan, *quantity, *returned])

    def verdicts(self) -> Iterator[Verdict]:
        """Yield the verdict of the check on each trace, in the order of trace names."""
        known = (
            self._verdict(trace) for trace in self.readers(premises=self._narrowing) if len(trace)
        )
        yield from merge(known, self.unknown(), key=lambda verdict: natural(verdict.trace))

    @cached_property
    def _premises(self) -> Premises | None:
        """Sets of queries. A violation needs matches of all queries of one set. None: all traces are needed."""
        asks = self._plan.asks | self._values.asks
        found = premises_of(self._check, self._plan, self._formula, asks)
        return None if self._want_status else found

    @property
    def _narrowing(self) -> Premises | None:
        """Sets of queries that limit the traces to read; None if the robustness of the check is requested."""
        return None if self._check.robustness else self._premises

    def readers(
        self, within: Window | None = None, *, premises: Premises | None = None
    ) -> Iterator[TraceReader]:
        """Yield the traces that have data for the check, loaded into memory.

        ``within`` limits the traces to a window, ``premises`` the data to what the verdicts need.
        """
        gaps = "bridge" if self._check.gaps == "bridge" else "break"
        self._read_people()
        asks = self._plan.asks | self._values.asks
        about = self._file, self._knowing, self._whole, asks
        yield from traces(*about, gaps=gaps, within=within, premises=premises)

    def unknown(self) -> Iterator[Verdict]:
        """Yield an unknown verdict for each trace that lacks data for the check."""
        yield from self._unknown(self._knowing, self._lacks)

    def watched(self) -> dict[str, str]:
        """For each variable, return the name of the query that finds the frames with its entities.

        Later reads include this query.
        """
        found = (
            (node, self._plan.present(node)) for q in self._check.quantifiers for node in q.nodes
        )
        return {node: one.name for node, one in found if isinstance(one, Proposition)}

    def violated(self, trace: TraceReader, present: Mapping[str, str]) -> bool:
        """True if a range of frames violates the check, taken as a whole trace.

        Parameters
        ----------
        trace : TraceReader
            Selected frames.
        present : mapping of str to str
            Result of :meth:`watched` from before the trace was read. Entities that are absent from all frames
            are left out.
        """
        everybody = self._people.get(trace.trace_id, {})
        here = dict(everybody)
        for node, name in present.items():
            ids = trace.relations[name].keys[:, 0].tolist()
            here[node] = {i: everybody[node][i] for i in ids if i in everybody.get(node, {})}
        self._people[trace.trace_id] = here
        try:
            return self._verdict(trace).violated
        finally:
            self._people[trace.trace_id] = everybody

    def _unknown(self, catalog: Catalog, lacks: Mapping[int, str]) -> Iterator[Verdict]:
        """Yield an unknown verdict, with its reason, for each trace that lacks data."""
        _, left = traces_of(self._whole, catalog)
        for facts in catalog.traces:
            chosen = catalog.only is None or facts.trace_id in catalog.only
            if chosen and facts.trace_id in left and self._check.ego in {None, facts.ego}:
                reason = lacks.get(facts.trace_id, "")
                yield Verdict(self._check.name, facts.name, "unknown", reason=reason)

    @cached_property
    def _absences(self) -> dict[int, int]:
        """Return the number of frames in which an entity of the check is absent: trace id → frame count."""
        frames = frame_times(self._file, None)["frame_id"]
        full = np.ones(len(frames), np.bool_)
        traces, owners = np.unique(trace_of(frames), return_inverse=True)
        plan = empty_plan(self._check)
        for node in self._check.scope.nodes:
            ask = plan.atoms[plan.presence(node)]
            statement = relation(ask.query, self._knowing, None, (), {node})
            *before, (sql, values) = statement.steps()
            counted = f'SELECT "frame_id", count(*) AS "there" FROM ({sql}) GROUP BY ALL'  # noqa: S608
            found = self._file.arrays(counted, values, given=before, plain=True)
            there = np.zeros(len(frames), np.int64)
            ids, many = (np.ma.getdata(found[name]) for name in ("frame_id", "there"))
            there[np.searchsorted(frames, ids)] = many
            people = (self._people.get(trace, {}) for trace in traces.tolist())
            full &= there >= np.array([len(some.get(node, ())) for some in people])[owners]
        number = np.bincount(owners[~full], minlength=len(traces))
        return dict(zip(traces.tolist(), number.tolist(), strict=True))

    def _read_people(self) -> None:
        for node in self._check.scope.nodes:
            statement = entities(self._whole, node, self._catalog, None)
            for trace, number, name in self._file.rows(statement.sql, statement.values).values:
                self._people.setdefault(trace, {}).setdefault(node, {})[number] = name

    def _verdict(self, trace: TraceReader) -> Verdict:
        short = self._short.get(trace.trace_id, ShortRange())
        if self._premises is not None and not self._premises.left(trace.relations):
            absent = self._absences.get(trace.trace_id, 0)
            found = Verdict(self._check.name, trace.name, "true", absent_frames=absent)
            found = self._with_application(found, trace)
            return self._with_robustness(within_range(found, short), trace)
        levels = self._levels(trace, FAVOURABLE)
        judged = self._judged(trace, levels)
        strict, other = levels, judged
        if self._doubts_guards(trace):
            strict = self._levels(trace, UNFAVOURABLE)
            other = self._judged(trace, strict)
        best, worst = (
            int(folded_values(some, one.codes, HOLDS)[0][0])
            for some, one in ((levels, judged), (strict, other))
        )
        if best == VIOLATED or worst == HOLDS:
            word = "false" if best == VIOLATED else "true"
        else:
            word = "pending" if worst == PENDING else "unknown"
        if word == "false" and not self._compat and may_wait(self._check):
            wider = self._levels(trace, waiting=True)
            codes = self._judged(trace, wider).codes
            if waits_for_newcomers(self._check, levels, wider, codes):
                word = "pending"
        found = self._reported(
            trace, word, (levels, judged) if word == "false" else (strict, other)
        )
        if word == "unknown":
            found = replace(found, reason=self._reason(trace, strict, other))
        if word == "true":
            found = replace(found, absent_frames=self._absences.get(trace.trace_id, 0))
            found = self._with_application(found, trace)
        return self._with_robustness(within_range(found, short), trace, levels)

    def _with_application(self, found: Verdict, trace: TraceReader) -> Verdict:
        """Return a true verdict with the numbers that show if the check applied."""
        bindings = None
        if self._variables and all(one.word == "FORALL" for one in self._check.quantifiers):
            people = self._people.get(trace.trace_id, {})
            injective, nodes = self._check.injective, self._check.scope.nodes
            others = [people.get(n, ()) for n in nodes if injective and n not in self._variables]
            apart = set[int]().union(*others)
            domains = [set(people.get(name, ())) - apart for name in self._variables]
            bindings = number_of_bindings(domains, injective=injective)
        applied = self._applied.get(trace.trace_id)
        return replace(found, applied_frames=applied, bindings=bindings)

    @cached_property
    def _applied(self) -> dict[int, int]:
        """Return the number of frames in which the premise is true: trace id → frame count.

        The result is empty without a premise, and if a trace has too many combinations for its premise.
        """
        never = never_applies(self._check)
        if never is None:
            return {}
        inner = StoreCheck(self._file, replace(self._bound, check=never))
        try:
            readers = inner.readers(premises=inner._premises)
            return {trace.trace_id: inner._false_frames(trace) for trace in readers}
        except QueryError:  # the check itself needs fewer combinations
            return {}

    def _false_frames(self, trace: TraceReader) -> int:
        """Return the number of frames in which a check ``ALWAYS p`` has a false p, for some entities."""
        body = always_true(self._formula)
        if body is None or (self._premises and not self._premises.left(trace.relations)):
            return 0
        false = np.zeros(len(trace), np.bool_)
        kinds, _ = self._alike(trace, innermost(self._levels(trace)))
        for low in range(0, len(kinds), trace.together):
            some = kinds[low : low + trace.together]
            values = PlanValues(self._plan, trace, self._variables, some)
            false |= ~values.formula(body).all(axis=0)
        return int(false.sum())

    def _with_robustness(
        self, found: Verdict, trace: TraceReader, levels: list[Level] | None = None
    ) -> Verdict:
        if self._quantity is None:
            return found
        levels = self._levels(trace, FAVOURABLE) if levels is None else levels
        robustness = self._robustness(self._quantity, trace, levels)
        if self._apart is not None:
            without = partial(self._robustness, self._apart, trace, levels)
            robustness = apart_from_absence(robustness, without)
        return replace(found, robustness=robustness)

    def _judged(self, trace: TraceReader, levels: Sequence[Level]) -> Judged:
        """Return the verdict for each combination of entities of a check in a trace."""
        kinds, members = self._alike(trace, innermost(levels))
        codes = np.zeros(len(kinds), np.int8)
        told = [_NOTHING] * len(kinds)
        gaps = self._check.gaps == "unknown" and bool(trace.clock.gap_before.any())
        in_gap = np.zeros(len(kinds), np.bool_)
        for low in range(0, len(kinds), trace.together):
            part = slice(low, low + trace.together)
            codes[part], told[part] = self._evaluated(trace, kinds[part])
            if gaps:
                least, most = self._bounds(trace, kinds[part])
                in_gap[part] = least != most
                codes[part][in_gap[part]] = UNKNOWN
        told = [told[i] for i in members.tolist()]
        return Judged(codes[members], told, in_gap[members])

    def _doubts_guards(self, trace: TraceReader) -> bool:
        names = {n for guard in self._guards.values() for n in propositions(guard)}
        doubts = {base_name(name) for name in names if name[-1] in SIGNS}
        return any(len(trace.relations[name].frames) for name in doubts)

    def _reason(self, trace: TraceReader, levels: Sequence[Level], judged: Judged) -> str:
        """Return a text that explains an unknown verdict: the unknown condition, its entities and its frame."""
        rows = np.flatnonzero(judged.codes == UNKNOWN)
        if not len(rows):
            return "it is unknown whether a quantifier is about an entity"
        row = int(rows[0])
        if judged.in_gap[row]:
            return "it depends on a gap in the recording"
        binding = innermost(levels)[row : row + 1]
        found = self._decisive_doubt(trace, binding)
        if found is None:
            return "too little is known"
        name, frame = found
        names = self._people.get(trace.trace_id, {})
        who = [names[v][n] for v, n in zip(self._variables, binding[0].tolist(), strict=True)]
        return doubt_text(self._plan.doubts[name], who, f"{trace.name}#{trace.numbers[frame]}")

    def _decisive_doubt(self, trace: TraceReader, binding: Keys) -> tuple[str, int] | None:
        """Return the unknown condition that decides the verdict of some entities, and its frame; or None."""
        values = PlanValues(self._plan, trace, self._variables, binding)
        columns: dict[str, Floats] = {}
        for name in propositions(self._formula):
            if name[-1] in SIGNS:
                flags = values.evaluation(name[-1]).proposition(name)
                columns[name] = np.where(flags, 0.0, -np.inf)
            else:
                columns[name] = np.where(values.proposition(name), np.inf, -np.inf)
        table = MarginTable(columns, trace.clock.times, trace.clock.tolerance)
        starts = range(len(trace)) if self._reset is not None else (0,)
        value = table.value(self._formula)
        for start in starts:
            if value[0, start] == 0:
                found = table.decisive(self._formula, 0, start)
                return None if found is None else (base_name(found[0]), found[1])
        return None

    def _robustness(self, quantity: Formula, trace: TraceReader, levels: list[Level]) -> Robustness:
        """Return the robustness of the check on a trace: positive if true, negative if false."""
        sides = self._sides(quantity, trace, innermost(levels))
        ends = [folded_margins(levels, margins) for margins in sides]
        (value, row), most = ends[0], ends[-1][0]
        upper = None if most == value else most
        if row is None:
            return Robustness(value, upper=upper)
        binding = innermost(levels)[row : row + 1]
        names = self._people.get(trace.trace_id, {})
        nodes = dict(zip(self._variables, binding[0].tolist(), strict=True))
        called = {name: names[name][node] for name, node in nodes.items()}
        decisive = self._margins(quantity, trace, binding).decisive(quantity, 0, 0)
        if decisive is None:
            return Robustness(value, nodes=nodes, names=called, upper=upper)
        name, at = decisive
        when = int(trace.numbers[at]), int(trace.times[at]), trace.seconds(at)
        return Robustness(value, condition_text(self._plan, name), *when, nodes, called, upper)

    def _sides(self, quantity: Formula, trace: TraceReader, bindings: Keys) -> Iterator[Floats]:
        """Yield arrays with the robustness margin of each combination of entities, (B,).

        Unknown values count against the check. If there may be some, further margins count them in its favour.
        """
        least = self._least_margins(trace, bindings)
        if least is not None:
            yield least
            return
        kinds, members = self._alike(trace, bindings)
        size = max(trace.together // MARGIN_CELLS, 1)
        for sign in (UNFAVOURABLE, FAVOURABLE):
            parts = [np.zeros(0)]
            for low in range(0, len(kinds), size):
                some = kinds[low : low + size]
                value = self._margins(quantity, trace, some, sign).value(quantity)[:, 0]
                parts.append(np.broadcast_to(value, len(some)))
            yield np.concatenate(parts)[members]
            if not self._plan.doubts:
                return

    def _least_margins(self, trace: TraceReader, bindings: Keys) -> Floats | None:
        """Return the robustness of each combination of entities, from stored minimum values; or None."""
        doubts = {doubt for _, doubt in self._plan.states.values() if doubt is not None}
        if not self._least or any(len(trace.relations[name].frames) for name in doubts):
            return None
        found = np.full(len(bindings), np.inf)
        for ask in self._least:
            table = trace.relations[ask.name]
            numbers = np.ma.filled(np.ma.asarray(table.values[0], np.float64), np.nan)
            if np.isnan(numbers).any():
                return None
            if len(numbers):
                columns = [self._variables.index(name) for name in ask.variables]
                places = table.find(bindings[:, columns])
                least = np.append(np.minimum.reduceat(numbers, table.starts[:-1]), np.inf)
                found = np.minimum(found, least[places])
        return found

    def margins(self, trace: TraceReader) -> Floats:
        """Return the robustness margins of the check on a trace. NaN: the margin depends on an unknown number.

        For an ``ALWAYS`` check over all entities: shape (F,), the margin of each frame. Unknown entities and
        frames are ignored. For any other check: shape (1,), the margin of the whole trace.
        """
        each, quantity = self._lasting is not None, self._ranked
        assert quantity is not None  # noqa: S101 - who asks has asked for margins
        levels = self._levels(trace)
        kinds, members = self._alike(trace, innermost(levels))
        least = np.full(len(trace), np.nan if len(kinds) else np.inf)
        size, parts = max(trace.together // MARGIN_CELLS, 1), [np.zeros(0)]
        for low in range(0, len(kinds), size):
            some = kinds[low : low + size]
            value, other = (
                self._margins(quantity, trace, some, sign, unknown).value(quantity)
                for sign, unknown in ((UNFAVOURABLE, -np.inf), (FAVOURABLE, np.inf))
            )
            value = np.where(np.isinf(value) & (value != other), np.nan, value)
            if each:
                least = np.fmin(least, np.fmin.reduce(value, axis=0))
            else:
                parts.append(np.broadcast_to(value[:, 0], len(some)))
        if each:
            return least
        return np.array([folded_margins(levels, np.concatenate(parts)[members])[0]])

    def _margins(
        self,
        quantity: Formula,
        trace: TraceReader,
        bindings: Keys,
        counted: str = UNFAVOURABLE,
        unknown: float = -np.inf,
    ) -> MarginTable:
        values = PlanValues(self._plan, trace, self._variables, bindings, counted)
        about = values.test, values.proposition, trace.clock.tolerance, unknown
        columns = margin_columns(self._plan, quantity, *about)
        return MarginTable(columns, trace.clock.times, trace.clock.tolerance)

    def _bounds(self, trace: TraceReader, bindings: Keys) -> tuple[Bools, Bools]:
        """Return the lowest and the highest possible verdict of each combination of entities.

        Unseen events in recording gaps may change the verdict.
        """
        parts: list[tuple[Bools, Bools]] = []
        for low in range(0, len(bindings), trace.together):
            some = bindings[low : low + trace.together]
            values = PlanValues(self._plan, trace, self._variables, some)
            columns = values.columns(self._formula)
            times, gaps = trace.clock.times, trace.clock.gap_before
            lenient = tolerant(self._formula, trace.clock.tolerance)
            parts.append(within_bounds(lenient, columns, times, gaps, len(some)))
        nothing = np.zeros(0, np.bool_)
        least = np.concatenate([nothing, *(part[0] for part in parts)])
        return least, np.concatenate([nothing, *(part[1] for part in parts)])

    def _levels(
        self, trace: TraceReader, counted: str = FAVOURABLE, *, waiting: bool = False
    ) -> list[Level]:
        """Return the combinations of entities for each quantifier of the check, outermost quantifier first.

        ``waiting`` adds entities that may appear later.
        """
        people = self._people.get(trace.trace_id, {})
        domains = {
            node: np.array(sorted(people.get(node, ())), np.int64)
            for node in self._check.scope.nodes
        }
        others = [domains[n] for n in self._check.scope.nodes if n not in self._variables]
        apart = np.concatenate([np.zeros(0, np.int64), *others])
        domains = newcomers(self._check, domains) if waiting else domains

        def counts(
            quantifier: BoundQuantifier, variables: tuple[str, ...], bindings: Keys
        ) -> Bools:
            guard = self._guards.get(self._check.quantifiers.index(quantifier))
            every = waiting and quantifier.word == "FORSOME"
            if guard is None or every or not len(bindings):
                return np.ones(len(bindings), np.bool_)
            size = trace.together
            some = (bindings[low : low + size] for low in range(0, len(bindings), size))
            about = self._plan, trace, variables
            parts = [PlanValues(*about, part, counted).formula(guard) for part in some]
            return np.concatenate([part.any(axis=1) for part in parts])

        injective, quantifiers = self._check.injective, self._check.quantifiers
        if self._narrowing is not None:
            free = {
                name: ids[~np.isin(ids, apart)] if injective else ids
                for name, ids in domains.items()
            }
            few = bindings_of(self._narrowing, trace, self._variables, free, injective=injective)
            return levels_among(quantifiers, few, counts=counts)
        return levels_of(quantifiers, domains, apart=apart if injective else None, counts=counts)

    def _alike(self, trace: TraceReader, bindings: Keys) -> tuple[Keys, Ints]:
        """Group the combinations of entities with equal query results. Each group is evaluated once.

        Return one binding per group, and the group of each binding.
        """
        if not len(bindings):
            return bindings, np.zeros(0, np.int64)
        found: list[Ints] = []
        for name, ask in self._plan.asks.items():
            columns = [self._variables.index(v) for v in ask.variables]
            found.append(trace.relations[name].find(bindings[:, columns]))
        if not found:
            return bindings[:1], np.zeros(len(bindings), np.int64)
        sorts = np.stack(found, axis=1)
        _, first, members = np.unique(sorts, axis=0, return_index=True, return_inverse=True)
        return bindings[first], members.reshape(-1)

    def _evaluated(self, trace: TraceReader, bindings: Keys) -> tuple[Codes, list[_BindingVerdict]]:
        """Return the verdict of each combination of entities, and the violations where they are needed."""
        values = PlanValues(self._plan, trace, self._variables, bindings)
        codes, told = self._in_evaluation(trace, values, len(bindings))
        doubts = [name for name in propositions(self._formula) if name[-1] in SIGNS]
        doubtful = np.zeros(len(bindings), np.bool_)
        for name in doubts:
            doubtful |= values.evaluation(name[-1]).proposition(name).any(axis=1)
        if doubtful.any():
            other = values.evaluation(UNFAVOURABLE)
            worst, _ = self._in_evaluation(trace, other, len(bindings), among=doubtful)
            worst[worst == VIOLATED] = UNKNOWN
            kept = doubtful & (codes != VIOLATED)
            codes[kept] = worst[kept]
        return codes, told

    def _in_evaluation(
        self, trace: TraceReader, values: PlanValues, rows: int, among: Bools | None = None
    ) -> tuple[Codes, list[_BindingVerdict]]:
        """Return the verdict of each combination of entities, and its violations.

        Unknown conditions all count in the same way.
        """
        columns = values.columns(self._formula)
        truths = values.formula(self._formula)[:, 0]
        resets = values.formula(self._reset) if self._reset is not None else None
        codes = np.where(truths, HOLDS, VIOLATED).astype(np.int8)
        told = [_NOTHING] * rows
        lenient = tolerant(self._formula, trace.clock.tolerance)
        kept = always_true(self._formula)
        if kept is not None and not (looks_ahead(kept) or self._compat or self._want_status):
            held = values.formula(kept)
            for row in np.flatnonzero(~truths if among is None else ~truths & among).tolist():
                reset = None if resets is None else resets[row]
                told[row] = tuple(violations_of_always(held[row], reset)), None, ~held[row]
            return codes, told
        for row in range(rows):
            needed = not truths[row] or self._compat or self._want_status
            if not needed or (among is not None and not among[row]):
                continue
            own = {name: column[min(row, len(column) - 1)] for name, column in columns.items()}
            settled = Settled(lenient, own, trace.clock.times, trace.clock.tolerance)
            reset = resets[row] if resets is not None else None
            codes[row], told[row] = self._one(settled, reset)
        return codes, told

    def _one(self, settled: Settled, reset: Bools | None) -> tuple[int, _BindingVerdict]:
        status = settled.statuses() if self._compat or self._want_status else None
        if self._compat and status is not None:
            broken = status < PRESUMABLY_TRUE
            return VIOLATED if broken.any() else HOLDS, (tuple(_runs(broken)), status, None)
        violations, due = settled.judged(reset, self._check.end)
        code = VIOLATED if violations else PENDING if due else HOLDS
        false = settled.false_frames(self._check.end) if violations else None
        return code, (tuple(violations), status, false)

    def _reported(
        self, trace: TraceReader, word: str, about: tuple[Sequence[Level], Judged]
    ) -> Verdict:
        levels, judged = about
        status = self._joined(levels, judged.told, len(trace))
        bindings = innermost(levels)

        def violations(row: int, names: Mapping[str, str]) -> tuple[ViolationInterval, ...]:
            spans, _, false = judged.told[row] if judged.codes[row] == VIOLATED else _NOTHING
            values = self._values_of(trace, bindings[row : row + 1], spans)
            begins = [0, *(end + 1 for _, end, _ in spans)]
            return tuple(
                _violation(trace, one, {**names, **more}, _false_runs(trace, false, begin, one[1]))
                for begin, one, more in zip(begins, spans, values, strict=False)
                if more is not None
            )

        names = self._people.get(trace.trace_id, {})
        last = _violation(trace, (len(trace) - 1, len(trace) - 1, True), {})
        found = Verdict(self._check.name, trace.name, word, status=status)
        return verdict_of(self._check, found, levels, judged.codes, names, violations, last)

    def _values_of(
        self, trace: TraceReader, binding: Keys, spans: Sequence[Violation]
    ) -> list[dict[str, Any] | None]:
        """Return the ``RETURN`` values of each violation, for one combination of entities.

        ``None`` means a violation that ``HAVING`` rejects.
        """
        if not self._returned.parts:
            return [self._returned.told(lambda _: None) for _ in spans]
        values = PlanValues(self._values, trace, self._variables, binding)
        first, last, _ = np.array(spans, np.int64).reshape(-1, 3).T
        told: dict[OverMatch, Any] = {}
        for part in self._returned.parts:
            end = first if part.start == AT_FRAME else last
            stretches = Stretches(np.zeros_like(first), first, end)
            at = None if part.at is None else values.test(self._values.test(part.at))
            column = values.test(self._values.test(part.operand))
            told[part] = stretches.told(part.word, column, at).tolist()
        return [
            self._returned.told(lambda part, row=row: told[part][row]) for row in range(len(spans))
        ]

    def _joined(
        self, levels: Sequence[Level], told: list[_BindingVerdict], frames: int
    ) -> Statuses | None:
        """Return the check's status after each frame, combined from the status of each entity combination."""
        if not self._want_status:
            return None
        rows = [status for _, status, _ in told if status is not None]
        codes = np.array(rows, np.int8).reshape(len(rows), frames)
        return folded_values(levels, codes, CERTAINLY_TRUE)[0][0]


def _runs(flags: Bools) -> Iterator[Violation]:
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False))
    for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        yield start, end - 1, False


def _false_runs(
    trace: TraceReader, false: Bools | None, first: int, last: int
) -> tuple[Interval, ...]:
    """Return the runs of false frames between two frames, both included."""
    if false is None:
        return ()
    runs = _runs(false[first : last + 1])
    return tuple(Interval(*_extent(trace, first + a, first + b), {}) for a, b, _ in runs)


def _violation(
    trace: TraceReader, of: Violation, values: Mapping[str, Any], runs: tuple[Interval, ...] = ()
) -> ViolationInterval:
    start, end, _ = of
    return ViolationInterval(*_extent(trace, start, end), dict(values), runs)


def _extent(
    trace: TraceReader, start: int, end: int
) -> tuple[str, int, int, int, int, float, float, int]:
    """Return the fields of an interval before its values."""
    (first, last), (begin, stop) = trace.numbers[[start, end]], trace.times[[start, end]]
    seqs_ns = int(first), int(last), int(begin), int(stop)
    return trace.name, *seqs_ns, trace.seconds(start), trace.seconds(end), end - start + 1
