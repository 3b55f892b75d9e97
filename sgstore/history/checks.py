"""``CHECK`` over a store: verdicts of its traces, where they are violated, and by whom."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.history.bindings import Level, folded_values, innermost, levels_of
from sgstore.history.reading import Ask, Trace, Values, asks_of, traces
from sgstore.lang.bound import Query, Result
from sgstore.lang.compiler import compile_checks
from sgstore.lang.found import entities
from sgstore.lang.phases import traces_of
from sgstore.matches import Interval
from sgstore.temporal.plans import Plan
from sgstore.temporal.verdicts import (
    FALSE,
    PRESUMABLY_TRUE,
    STATUS,
    Settled,
    Violation,
    within_bounds,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.checks import BoundCheck
    from sgstore.lang.over_time import Quantifier
    from sgstore.store import StoreFile
    from sgstore.world import Bools, Ints

    Keys = NDArray[np.int64]
    Statuses = NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class Witness:
    """Entities that a verdict is due to: of ``FORALL`` those that violate it, of ``FORSOME`` those that do not.

    Attributes
    ----------
    nodes : dict of str to int
        Node ids by variable.
    names : dict of str to str
        Their names.
    holds : bool
    violations : tuple of Interval
        Where the check is violated for them.
    """

    nodes: Mapping[str, int]
    names: Mapping[str, str]
    holds: bool
    violations: tuple[Interval, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What a check says of a trace.

    Attributes
    ----------
    check, trace : str
        Their names.
    verdict : str
        ``true`` or ``false``; with ``USING END pending`` also ``presumably_true``, ``presumably_false``; and
        ``unknown`` of a trace that cannot answer it, or, with ``USING GAPS unknown``, if it depends on what
        happened in a gap.
    first_violation : Interval or None
        The first of the violations.
    violations : tuple of Interval
        In order; of a check with quantifiers those of all its witnesses.
    witnesses : tuple of Witness
    status : (F,) int8 or None
        If asked for: what was known at each frame, as places in :data:`sgstore.temporal.verdicts.STATUS`.
    """

    check: str
    trace: str
    verdict: str
    violations: tuple[Interval, ...] = ()
    witnesses: tuple[Witness, ...] = ()
    status: Statuses | None = None

    @property
    def first_violation(self) -> Interval | None:
        """Where the check is violated first; ``None``: nowhere."""
        return self.violations[0] if self.violations else None

    @property
    def violated(self) -> bool:
        """Whether the trace is known to violate the check."""
        return self.verdict == "false"

    @property
    def statuses(self) -> tuple[str, ...]:
        """The status at each frame in words, if it was asked for."""
        return tuple(STATUS[code] for code in self.status) if self.status is not None else ()


class CheckRun:
    """The checks of a text, ready to be asked of a store. Iterating asks: verdicts trace by trace.

    Parameters
    ----------
    file : StoreFile
    catalog : function
        Gives what the store holds.
    text : str
        ``CHECK`` statements, with the predicates that they need.
    parameters : mapping of str to value
    sgsm_compat : bool
        Whether a trace violates a check if any of its beginnings would, as SGSM reports, and not only if it
        does itself. Violations are then the frames that such beginnings end with.
    status : bool
        Whether the status at each frame is told.

    Raises
    ------
    QueryError
        The text has no checks, or they have no meaning; it says where.
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
        self._text, self._parameters = text, parameters
        self._compat, self._status = sgsm_compat, status
        with file.snapshot():
            self._checks = compile_checks(text, catalog(), parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the checks, in order."""
        return tuple(one.check.name for one in self._checks)

    def __iter__(self) -> Iterator[Verdict]:
        with self._file.snapshot():
            for one in compile_checks(self._text, self._catalog(), self._parameters):
                check = _Check(self._file, one, compat=self._compat, status=self._status)
                yield from check.verdicts()

    def explain(self) -> str:
        """What becomes of the checks: formulas over atoms, and what each atom is."""
        parts = [_Check(self._file, one, compat=False, status=False).text() for one in self._checks]
        return "\n\n".join(parts)


@dataclass(frozen=True, slots=True)
class _Told:
    """What is known of one binding, or of a check without quantifiers."""

    violations: tuple[Violation, ...] = ()
    status: Statuses | None = None


_NOTHING: Final = _Told()


class _Check:
    """One check, while a store is asked."""

    def __init__(self, file: StoreFile, one: BoundCheck, *, compat: bool, status: bool) -> None:
        check = one.check
        self._file, self._check, self._catalog = file, check, one.catalog
        self._compat, self._want_status = compat, status
        self._whole = Query(
            check.scope,
            Result(),
            check.relations,
            check.injective,
            check.ego,
            check.unknown_is_false,
        )
        self._variables = tuple(node for q in check.quantifiers for node in q.nodes)
        absent = frozenset(node for q in check.quantifiers if q.absent for node in q.nodes)
        self._plan = Plan(self._whole, frozenset(self._variables), absent)
        self._formula = self._plan.formula(check.formula)
        self._reset = self._plan.formula(check.reset) if check.reset is not None else None
        self._guards = {
            number: self._plan.formula(quantifier.where)
            for number, quantifier in enumerate(check.quantifiers)
            if quantifier.where is not None
        }
        self._people: dict[int, dict[str, dict[int, str]]] = {}

    def text(self) -> str:
        """The check as it is asked."""
        from sgstore.temporal.printing import plan_text  # for who asks

        head = [f"---- {self._check.name}"]
        head += [f"{q.word} {', '.join(q.nodes)}" for q in self._check.quantifiers]
        return (
            "\n".join(head)
            + "\n"
            + plan_text(self._plan, self._formula, self._reset, self._catalog)
        )

    def verdicts(self) -> Iterator[Verdict]:
        """The verdict of each trace, those last that cannot answer."""
        gaps = "bridge" if self._check.gaps == "bridge" else "break"
        asks: dict[str, Ask] = asks_of(self._plan)
        self._read_people()
        for trace in traces(self._file, self._catalog, self._whole, asks, gaps=gaps):
            if len(trace):
                yield self._verdict(trace)
        _, left = traces_of(self._whole, self._catalog)
        chosen = [t for t in self._catalog.traces if self._check.ego in {None, t.ego}]
        for facts in chosen:
            if facts.trace_id in left:
                yield Verdict(self._check.name, facts.name, "unknown")

    def _read_people(self) -> None:
        """The entities that variables may be, with their names, by trace."""
        for node in self._check.scope.nodes:
            statement = entities(self._whole, node, self._catalog, None)
            for trace, number, name in self._file.rows(statement.sql, statement.values).values:
                self._people.setdefault(trace, {}).setdefault(node, {})[number] = name

    def _verdict(self, trace: Trace) -> Verdict:
        levels = self._levels(trace)
        bindings = innermost(levels)
        kinds, members = self._alike(trace, bindings)
        values = np.zeros(len(kinds), np.bool_)
        told = [_NOTHING] * len(kinds)
        for low in range(0, len(kinds), trace.together):
            part = slice(low, low + trace.together)
            values[part], told[part] = self._evaluated(trace, kinds[part])
        truths = folded_values(levels, values[members])
        if self._check.gaps == "unknown" and trace.clock.gap_before.any():
            least, most = self._bounds(trace, kinds)
            ends = [folded_values(levels, end[members])[0][0] for end in (least, most)]
            if ends[0] != ends[1]:
                return Verdict(self._check.name, trace.name, "unknown")
        return self._reported(trace, levels, truths, [told[i] for i in members.tolist()])

    def _bounds(self, trace: Trace, bindings: Keys) -> tuple[Bools, Bools]:
        """The verdict of some bindings, at least and at most, whatever happened in the gaps."""
        parts: list[tuple[Bools, Bools]] = []
        for low in range(0, len(bindings), trace.together):
            some = bindings[low : low + trace.together]
            columns = Values(self._plan, trace, self._variables, some).columns(self._formula)
            times, gaps = trace.clock.times, trace.clock.gap_before
            parts.append(within_bounds(self._formula, columns, times, gaps, len(some)))
        nothing = np.zeros(0, np.bool_)
        least = np.concatenate([nothing, *(part[0] for part in parts)])
        return least, np.concatenate([nothing, *(part[1] for part in parts)])

    def _levels(self, trace: Trace) -> list[Level]:
        people = self._people.get(trace.trace_id, {})
        domains = {
            node: np.array(sorted(people.get(node, ())), np.int64)
            for node in self._check.scope.nodes
        }
        others = [domains[n] for n in self._check.scope.nodes if n not in self._variables]
        apart = np.concatenate([np.zeros(0, np.int64), *others])

        def counts(quantifier: Quantifier, variables: tuple[str, ...], bindings: Keys) -> Bools:
            guard = self._guards.get(self._check.quantifiers.index(quantifier))
            if guard is None or not len(bindings):
                return np.ones(len(bindings), np.bool_)
            size = trace.together
            parts = [
                Values(self._plan, trace, variables, bindings[low : low + size]).formula(guard)
                for low in range(0, len(bindings), size)
            ]
            return np.concatenate([part.any(axis=1) for part in parts])

        injective = self._check.injective
        return levels_of(
            self._check.quantifiers, domains, apart=apart if injective else None, counts=counts
        )

    def _alike(self, trace: Trace, bindings: Keys) -> tuple[Keys, Ints]:
        """Bindings of which the same is true in every frame need but one evaluation.

        Returns one binding of each sort, and the sort of each binding.
        """
        if not len(bindings):
            return bindings, np.zeros(0, np.int64)
        asks = asks_of(self._plan)
        found: list[Ints] = []
        for name, ask in asks.items():
            columns = [self._variables.index(v) for v in ask.variables]
            found.append(trace.relations[name].find(bindings[:, columns]))
        if not found:
            return bindings[:1], np.zeros(len(bindings), np.int64)
        sorts = np.stack(found, axis=1)
        _, first, members = np.unique(sorts, axis=0, return_index=True, return_inverse=True)
        return bindings[first], members.reshape(-1)

    def _evaluated(self, trace: Trace, bindings: Keys) -> tuple[Bools, list[_Told]]:
        """The verdict of some bindings, and more of those that it is due to."""
        values = Values(self._plan, trace, self._variables, bindings)
        columns = values.columns(self._formula)
        truths = values.formula(self._formula)[:, 0].copy()
        resets = values.formula(self._reset) if self._reset is not None else None
        told: list[_Told] = []
        for row in range(len(bindings)):
            needed = not truths[row] or self._compat or self._want_status
            if not (needed or self._check.end == "pending"):
                told.append(_NOTHING)
                continue
            own = {name: column[min(row, len(column) - 1)] for name, column in columns.items()}
            settled = Settled(self._formula, own, trace.clock.times)
            reset = resets[row] if resets is not None else None
            truths[row], one = self._one(settled, reset)
            told.append(one)
        return truths, told

    def _one(self, settled: Settled, reset: Bools | None) -> tuple[bool, _Told]:
        weak = self._check.end == "weak"
        wanted = self._compat or self._want_status or self._check.end == "pending"
        status = settled.statuses() if wanted else None
        if self._compat and status is not None:
            broken = status < PRESUMABLY_TRUE
            return not broken.any(), _Told(tuple(_runs(broken)), status)
        violations = tuple(settled.violations(reset, weak=weak))
        holds = bool(settled.value[0])
        if weak and not holds:
            holds = not violations
        return holds, _Told(violations, status)

    def _reported(
        self, trace: Trace, levels: list[Level], truths: list[Bools], told: list[_Told]
    ) -> Verdict:
        holds = bool(truths[0][0])
        status = self._joined(levels, told, len(trace))
        verdict = "true" if holds else "false"
        if self._check.end == "pending" and status is not None:
            verdict = STATUS[int(status[-1])]
        if not levels:
            own = tuple(_interval(trace, one, {}) for one in told[0].violations)
            return Verdict(self._check.name, trace.name, verdict, own, (), self._kept(status))
        witnesses = self._witnesses(trace, levels, truths, told)
        if holds:
            violations: tuple[Interval, ...] = ()
        else:
            every = {(i.start_seq, i.end_seq): i for w in witnesses for i in w.violations}
            violations = tuple(every[key] for key in sorted(every))
            if not violations:
                violations = (_interval(trace, Violation(len(trace) - 1, len(trace) - 1), {}),)
        return Verdict(
            self._check.name, trace.name, verdict, violations, witnesses, self._kept(status)
        )

    def _kept(self, status: Statuses | None) -> Statuses | None:
        return status if self._want_status else None

    def _witnesses(
        self, trace: Trace, levels: list[Level], truths: list[Bools], told: list[_Told]
    ) -> tuple[Witness, ...]:
        """Those of the outermost quantifiers that are of one word."""
        word = levels[0].word
        depth = next((n for n, level in enumerate(levels) if level.word != word), len(levels))
        level, values = levels[depth - 1], truths[depth]
        names = [n for q in self._check.quantifiers[:depth] for n in q.nodes]
        people = self._people.get(trace.trace_id, {})
        found: list[Witness] = []
        for row in np.flatnonzero(values == (word == "FORSOME")).tolist():
            nodes = dict(zip(names, level.bindings[row].tolist(), strict=True))
            called = {name: people[name][node] for name, node in nodes.items()}
            inner = told[row].violations if depth == len(levels) else ()
            violations = tuple(_interval(trace, one, called) for one in inner)
            found.append(Witness(nodes, called, bool(values[row]), violations))
        return tuple(found)

    def _joined(self, levels: list[Level], told: list[_Told], frames: int) -> Statuses | None:
        """The status of the whole check at each frame, of those of its bindings."""
        if not (self._want_status or self._check.end == "pending"):
            return None
        rows = [one.status for one in told if one.status is not None]
        for number in range(len(levels) - 1, -1, -1):
            level = levels[number]
            every = level.word == "FORALL"
            outer = len(levels[number - 1].bindings) if number else 1
            empty = len(STATUS) - 1 if every else FALSE
            joined = [np.full(frames, empty, np.int8) for _ in range(outer)]
            for parent, row in zip(level.parents.tolist(), rows, strict=True):
                both = np.minimum if every else np.maximum
                joined[parent] = both(joined[parent], row)
            rows = joined
        return rows[0]


def _runs(flags: Bools) -> Iterator[Violation]:
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False))
    for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        yield Violation(start, end - 1)


def _interval(trace: Trace, of: Violation, names: Mapping[str, str]) -> Interval:
    return Interval(
        trace.name,
        int(trace.numbers[of.start]),
        int(trace.numbers[of.end]),
        int(trace.times[of.start]),
        int(trace.times[of.end]),
        trace.seconds(of.start),
        trace.seconds(of.end),
        of.end - of.start + 1,
        dict(names),
    )
