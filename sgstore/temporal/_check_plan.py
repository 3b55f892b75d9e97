"""Evaluation plans of checks: temporal formulas that define how absences and unknown values count.

A check has two two-valued evaluations: unknown conditions count for the check in the first, and against it in
the second. In the formula, an unknown condition is a separate proposition. Its name ends in ``+`` for the first
evaluation, and in ``-`` for the second.

A condition on an absent entity, or on a value without a past, does not decide. It counts as true for a variable
of ``FORALL``, and as false for a variable of ``FORSOME``; under ``NOT``, the reverse applies. A query returns
the frames in which a condition is true. If absence counts as true, the negated condition is queried.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import sgstore.temporal._formula as f
from sgstore.lang import ir as b
from sgstore.lang.bind import (
    CONNECTIVES,
    certain,
    has_pairs,
    is_limited,
    negated,
    pushed,
    spelled_out,
    undecided,
    unknown,
    within,
)
from sgstore.lang.catalog import Type
from sgstore.lang.sql import unnumbered_text
from sgstore.temporal._plan import (
    FALSE,
    MARGINS,
    TRUE,
    Ask,
    Plan,
    Test,
    has_margin,
    query_of_check,
    variables_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.lang.ir import BoundCheck

STATE: Final = "state"
"""Internal operation for the state of a value: 0 known, 1 unknown, NULL for absent entities."""

POSSIBLY: Final = "possibly"
"""Internal operation for a condition in which unknown parts count as true."""

IN_FAVOUR: Final = "in favour"
"""Internal operation for a condition in which absent entities count as true."""

FAVOURABLE: Final = "+"
UNFAVOURABLE: Final = "-"
"""Name suffixes of the propositions for unknown values: for the first and for the second evaluation."""

SIGNS: Final = (FAVOURABLE, UNFAVOURABLE)

_CONTRARY: Final = {"+": "-", "-": "+", "": "*", "*": ""}


@dataclass(frozen=True, slots=True)
class Reading:
    """Rules for part of a formula: whether unknown values and absent entities count as true.

    Attributes
    ----------
    unknown : str
        When an unknown condition counts as true: ``+``, ``-``, always (``*``) or never (empty).
    positive : bool
        True under an even number of negations.
    absent : bool or None
        Truth value of a condition on an absent entity. ``None`` means that its quantifier decides.
    """

    unknown: str
    positive: bool = True
    absent: bool | None = None

    @property
    def contrary(self) -> Reading:
        """Return the rules for unknown values and absent entities inside a ``NOT``."""
        absent = None if self.absent is None else not self.absent
        return Reading(_CONTRARY[self.unknown], not self.positive, absent)


WHOLE: Final = Reading(FAVOURABLE)
"""Rules for the whole formula of a check."""

WITHOUT_ABSENCE: Final = Reading(FAVOURABLE, absent=True)
"""Rules in which conditions on absent entities count in favour of the check."""

CERTAIN: Final = Reading("", absent=False)
"""Rules for a condition that must be known to be true."""


def base_name(name: str) -> str:
    """Return a proposition's name without its suffix: ``+`` or ``-``, the rule for unknown values."""
    return name.rstrip("+-")


@dataclass(slots=True)
class CheckPlan(Plan):
    """Evaluation plan of a check: its temporal formulas, and the single-frame queries that they need.

    Attributes
    ----------
    words : tuple of (str, frozenset of str)
        Quantifiers, outermost first: ``FORALL``, ``FORSOME``, or ``false`` if conditions on absent entities
        are false, with their variables. The ego is a variable of the first.
    doubts : dict of str to Bound
        Name of an unknown proposition (without its sign) → unknown condition.
    states : dict of str to (Ask or None, str or None)
        Name of the signal of a :data:`STATE` → signal of the value (``None``: a constant), and the atom of its
        unknown frames.
    meanings : dict of str to Bound
        Proposition for a part of a condition → whole condition.
    limit : float or None
        Largest distance of a present entity from the ego; m.
    """

    words: tuple[tuple[str, frozenset[str]], ...] = ()
    doubts: dict[str, b.Bound] = field(default_factory=dict[str, b.Bound])
    states: dict[str, tuple[Ask | None, str | None]] = field(
        default_factory=dict[str, "tuple[Ask | None, str | None]"]
    )
    meanings: dict[str, b.Bound] = field(default_factory=dict[str, b.Bound])

    limit: float | None = None

    def _query(self, things: frozenset[str], where: tuple[b.Bound, ...]) -> b.Query:
        nodes = self.whole.scope.nodes
        some = sorted(key for key in things & nodes.keys() if is_limited(nodes[key]))
        if self.limit is None or not some:
            return Plan._query(self, things, where)  # noqa: SLF001 - of the base class
        ego = next(key for key, node in nodes.items() if not node.kinds.other)
        near = tuple(within(key, ego, self.limit) for key in some)
        return Plan._query(self, things | {ego}, (*where, *near))  # noqa: SLF001 - of the base class

    def formula(self, expression: b.Bound) -> f.Formula:
        """Return the formula of a condition in ``run_length``: true if the condition is known to be true."""
        match expression:
            case b.Operation(word=word, operands=(operand,)) if word == POSSIBLY:
                return self.read(operand, Reading("*", absent=False))
            case _:
                return self.read(expression, CERTAIN)

    def read(self, expression: b.Bound, reading: Reading) -> f.Formula:
        """Return the temporal formula of a condition. ``reading`` defines how unknown values count."""
        match expression:
            case b.Tense(word=word, operands=operands):
                bound = f.Bound(expression.low, expression.high, expression.frames)
                return f.TEMPORAL[word](*(self.read(one, reading) for one in operands), bound)
            case b.SignalCall(word="exists_now", operand=operand):
                return self.present(next(iter(b.nodes_of(operand))))
            case b.Operation(word=word) if word in CONNECTIVES and b.is_temporal(expression):
                return self._joined(expression, reading)
            case _ if b.is_temporal(expression):
                return self._over_frames(expression, reading)
            case _:
                return self._of_frame(expression, reading)

    # Logic

    def _joined(self, expression: b.Operation, reading: Reading) -> f.Formula:
        things = self._things(expression)
        if self._is_old(things, reading):
            return self._as_written(expression, reading)
        counted = self._counted(things, reading)
        match pushed(expression):
            case b.Operation("OR") as found if counted is True:
                return f.Not(self.read(negated(found), reading.contrary))
            case b.Operation("AND", operands) if counted is False:
                parts = self._merged(operands)
                return f.And(tuple(self.read(one, reading) for one in parts))
            case b.Operation("AND" | "OR" as word, operands):
                return f.LOGIC[word](*(self.read(one, reading) for one in operands))
            case b.Operation("NOT", (operand,)) if b.is_temporal(operand):
                return f.Not(self.read(operand, reading.contrary))
            case found:
                return self.read(found, reading)

    def _guarded(self, expression: b.Bound) -> frozenset[str]:
        """Return the nodes that must be present for a condition to be true."""
        match expression:
            case b.Operation("AND", operands):
                return frozenset().union(*map(self._guarded, operands))
            case b.Operation("OR", operands):
                return frozenset.intersection(*map(self._guarded, operands))
            case _:
                return self._things(expression)

    def _counted(self, things: frozenset[str], reading: Reading) -> bool | None:
        """Return the value of the condition for absent entities; None if their quantifiers disagree."""
        if reading.absent is not None:
            return reading.absent
        words = {word for word, nodes in self._levels if nodes & things} or {self._levels[0][0]}
        if len(words) > 1:
            return None
        (word,) = words
        return False if word == "false" else (word == "FORALL") == reading.positive

    @property
    def _levels(self) -> tuple[tuple[str, frozenset[str]], ...]:
        bound = frozenset().union(*(nodes for _, nodes in self.words))
        others = frozenset(self.whole.scope.nodes) - bound
        if not self.words:
            return (("FORALL", others),)
        (first, nodes), *rest = self.words
        word = "FORALL" if first == "false" else first
        # The ego of a check with old-style variables is not included.
        return ((word, others), (first, nodes), *rest) if others else self.words

    # Conditions on one frame

    def _of_frame(self, expression: b.Bound, reading: Reading) -> f.Formula:
        things = self._things(expression)
        counted = self._counted(things, reading)
        if counted is None or self._is_old(things, reading):
            return self._by_parts(expression, reading, things)
        wanted = negated(expression) if counted else pushed(expression)
        if self._guarded(wanted) == things:
            sign = _CONTRARY[reading.unknown] if counted else reading.unknown
            found = self._asked(wanted, things, sign)
            return f.Not(found) if counted else found
        return self._joined_here(wanted, counted=counted, reading=reading)

    def _joined_here(self, wanted: b.Bound, *, counted: bool, reading: Reading) -> f.Formula:
        """Return the formula of a single-frame condition, combined from formulas of its operands."""
        assert isinstance(wanted, b.Operation)  # noqa: S101 - a part of it is no logic
        inner = reading.contrary if counted else reading
        parts = self._merged(wanted.operands) if wanted.word == "AND" else wanted.operands
        found = f.LOGIC[wanted.word](*(self._of_frame(one, inner) for one in parts))
        return f.Not(found) if counted else found

    def _is_old(self, things: frozenset[str], reading: Reading) -> bool:
        old = frozenset().union(*(nodes for word, nodes in self.words if word == "false"))
        return reading.absent is None and bool(old & things)

    def _by_parts(self, expression: b.Bound, reading: Reading, things: frozenset[str]) -> f.Formula:
        if isinstance(expression, b.Operation) and expression.word in CONNECTIVES:
            return self._as_written(expression, reading)
        return self._by_levels(self._asked(expression, things, reading.unknown), things, reading)

    def _as_written(self, expression: b.Operation, reading: Reading) -> f.Formula:
        """Return the formula of a logical operation such as ``AND``, combined from formulas of its operands."""
        match expression:
            case b.Operation("NOT", (operand,)):
                return f.Not(self.read(operand, reading.contrary))
            case b.Operation("IMPLIES", (left, right)):
                return f.Or((f.Not(self.read(left, reading.contrary)), self.read(right, reading)))
            case b.Operation("XOR", operands):
                return self.read(spelled_out(operands), reading)
            case b.Operation(word, operands):
                return f.LOGIC[word](*(self.read(one, reading) for one in operands))

    def _by_levels(self, found: f.Formula, things: frozenset[str], reading: Reading) -> f.Formula:
        """Extend a formula: each quantifier decides if it is true while one of its entities is absent.

        The outermost quantifier has priority.
        """
        for word, nodes in reversed(self._levels):
            if nodes & things and word != "false" and (word == "FORALL") == reading.positive:
                away = [f.Not(self.present(node)) for node in sorted(nodes & things)]
                found = f.Or((found, *away))
            elif nodes & things and word != "false":
                found = f.And((found, *(self.present(node) for node in sorted(nodes & things))))
        return found

    def _asked(self, wanted: b.Bound, things: frozenset[str], sign: str) -> f.Formula:
        """Return a formula: true if a condition is true; with a ``sign``, also if the condition is unknown.

        If unknown values count as true, it is also true for them.
        """
        if isinstance(wanted, b.Value) and not things:
            return f.TruthConstant(wanted.value is True)
        found = f.Proposition(self._ask(certain(wanted, decided=self._decided), things))
        doubt = undecided(wanted) if sign and not self._decided else None
        if doubt is None:
            return found
        name = self._ask(doubt, things)
        self.doubts.setdefault(name, wanted)
        return f.Or((found, f.Proposition(name + sign.strip("*"))))

    def _ask(self, condition: b.Bound, things: frozenset[str]) -> str:
        """Return the name of the single-frame query for a condition. A new query is added to the plan."""
        key = unnumbered_text(condition) + f" of {sorted(things)}"
        name = self._names.get(key)
        if name is None:
            name = self._names[key] = f"{self.prefix}a{len(self.atoms) + 1}"
            where = tuple(b.conjuncts(condition))
            self.atoms[name] = Ask(name, self._query(things, where), self._variables(things))
        return name

    # Conditions on several frames

    def _over_frames(self, expression: b.Bound, reading: Reading) -> f.Formula:
        """Return the formula of a condition over several frames. Add the test for its unknown values."""
        things = self._things(expression)
        counted = self._counted(things, reading)
        state = self._state(expression)
        known = b.Operation("=", (state, _number(0)), Type.boolean)
        told = _absence_tried(expression, counted=counted is True)
        ways = [told]
        if self._open_courses(expression):
            ways.append(_with_possible(told))
        ways = [_contrary(one) for one in ways] if counted else ways
        found = self._tested(_boolean("AND", known, *ways), expression)
        sign = _CONTRARY[reading.unknown] if counted else reading.unknown
        doubt = self._doubtful(told, state) if sign else None
        whole: f.Formula = f.Proposition(found)
        if doubt is not None:
            name = self._tested(doubt, expression)
            self.doubts.setdefault(name, expression)
            whole = f.Or((whole, f.Proposition(name + sign.strip("*"))))
        if counted is None:
            return self._by_levels(whole, things, reading)
        return f.Not(whole) if counted else whole

    def _tested(self, condition: b.Bound, meaning: b.Bound) -> str:
        name = self.test(condition).name
        self.meanings.setdefault(name, meaning)
        return name

    def _doubtful(self, expression: b.Bound, state: b.Bound) -> b.Bound | None:
        """Return a condition that is true if the value of a comparison over frames is unknown, or else None."""
        ways: list[b.Bound] = []
        if any(self._may_be_unknown(part) for part in b.walk(state)):
            ways.append(b.Operation(">", (state, _number(0)), Type.boolean))
        if self._open_courses(expression):
            there = b.Operation(">=", (state, _number(0)), Type.boolean)
            other = _with_possible(expression)
            differ = _case(expression, _case(other, FALSE, TRUE), _case(other, TRUE, FALSE))
            ways.append(_boolean("AND", there, differ))
        if len(ways) > 1:
            return _case(ways[0], TRUE, ways[1])
        return ways[0] if ways else None

    def _open_courses(self, expression: b.Bound) -> bool:
        """True if a function over time, such as ``run_length``, contains a condition that may be unknown."""
        parts = (part for part in b.walk(expression) if isinstance(part, b.SignalCall))
        return any(self._open(p.operand) for p in parts if p.word in _OF_CONDITIONS)

    def _open(self, condition: b.Bound) -> bool:
        """True if a part of a condition may have an unknown value."""
        return any(
            self._unknown(part) is not None
            for part in b.walk(condition)
            if not isinstance(part, b.Operation | b.Tense | b.SignalCall)
        )

    @property
    def _decided(self) -> bool:
        return self.whole.unknown_is_false

    def _unknown(self, value: b.Bound) -> b.Bound | None:
        return None if self._decided else unknown(value)

    def _may_be_unknown(self, part: b.Bound) -> bool:
        return (
            isinstance(part, b.Operation)
            and part.word == STATE
            and self._unknown(part.operands[0]) is not None
        )

    def _state(self, expression: b.Bound) -> b.Bound:
        """Return an expression for the state of another one: 0 if known, above 0 if unknown, NULL if absent."""
        parts = list(dict.fromkeys(self._states(expression)))
        now = [part for part in parts if isinstance(part, b.Operation) and part.word == STATE]
        rest = self._things(expression) - frozenset().union(*map(self._things, now))
        parts += [_state_of(b.NodeValue(node)) for node in sorted(rest)]
        whole: b.Bound = _number(0)
        for part in parts:
            whole = b.Operation("+", (whole, part), Type.number)
        return whole

    def _states(self, expression: b.Bound) -> Iterable[b.Bound]:
        match expression:
            case b.Operation(word="coalesce" | "case" | "IS NULL" | "IS NOT NULL"):
                return
            case b.SignalCall(word="prev", operand=operand):
                yield b.SignalCall("prev", _state_of(operand))
            case b.SignalCall(word="delta", operand=operand, by=by, frames=frames):
                change = b.SignalCall("delta", _state_of(operand), by, frames)
                yield b.Operation("abs", (change,), Type.number)
                yield _state_of(operand)
            case b.SignalCall(word=word, operand=operand, by=by, frames=frames) if (
                word in b.WINDOWS
            ):
                yield b.SignalCall("max_over", _state_of(operand), by, frames)
                # A window without its full length has no frame that old.
                back = by - 1 if frames else by
                if back > 0:
                    yield b.SignalCall("delta", _state_of(_number(0)), back, frames)
            case b.SignalCall():
                return
            case b.Operation() if b.is_temporal(expression):
                for operand in expression.operands:
                    yield from self._states(operand)
            case b.Value() | b.Choices() | b.StepTime() | b.Tense():
                return
            case _:
                yield _state_of(expression)

    def _signal(self, value: b.Bound) -> Ask:
        if not (isinstance(value, b.Operation) and value.word == STATE):
            return Plan._signal(self, value)  # noqa: SLF001 - of the base class
        (operand,) = value.operands
        things = self._things(operand)
        if isinstance(operand, b.Value):
            ask = Ask("state", self._query(things, ()), ())
            self.states[ask.name] = None, None
            return ask
        if isinstance(operand, b.NodeValue):
            inner = self.atoms[self.presence(operand.node)]
            ask = replace(inner, name=f"state of {inner.name}")
            self.states[ask.name] = inner, None
            return ask
        inner = Plan._signal(self, operand)  # noqa: SLF001 - of the base class
        doubt = self._unknown(operand)
        atom = None if doubt is None else self._ask(doubt, things)
        ask = replace(inner, name=f"state of {inner.name}")
        self.states[ask.name] = inner, atom
        return ask

    def _measure(self, expression: b.Bound, test: Test) -> None:
        match expression:
            case b.Operation(word=word, operands=operands) if word != STATE and _has_state(
                expression
            ):
                for operand in operands:
                    self._measure(operand, test)
            case b.Operation("IS NOT NULL", (b.Operation() as difference,)) if test.signals:
                self._measure(difference, test)  # the margin is queried anyway
            case _:
                Plan._measure(self, expression, test)  # noqa: SLF001 - of the base class

    def presence(self, node: str) -> str:
        """Return the name of the single-frame query that finds the frames with a node."""
        found = self.present(node)
        assert isinstance(found, f.Proposition)  # noqa: S101 - it is about a node
        return found.name

    # Margins

    def quantity(self, expression: b.Bound) -> f.Formula:
        """Return the formula from which the margin in ``robustness(…)`` is computed."""
        reading = CERTAIN
        while isinstance(expression, b.Operation) and expression.word in {POSSIBLY, IN_FAVOUR}:
            change = {"unknown": "*"} if expression.word == POSSIBLY else {"absent": True}
            reading = replace(reading, **change)
            (expression,) = expression.operands
        return self.margin(expression, reading)

    def margin(  # noqa: PLR0911 - a case each
        self, expression: b.Bound, reading: Reading
    ) -> f.Formula:
        """Return the formula from which a condition's robustness margin is computed.

        ``reading`` has the rules for unknown values and absent entities.
        """
        match expression:
            case b.Tense(word=word, operands=operands):
                bound = f.Bound(expression.low, expression.high, expression.frames)
                return f.TEMPORAL[word](*(self.margin(one, reading) for one in operands), bound)
            case b.Operation("NOT", (operand,)):
                return f.Not(self.margin(operand, reading.contrary))
            case b.Operation("IMPLIES", (left, right)):
                return f.Or(
                    (f.Not(self.margin(left, reading.contrary)), self.margin(right, reading))
                )
            case b.Operation("AND" | "OR" as word, operands):
                return f.LOGIC[word](*(self.margin(one, reading) for one in operands))
            case b.Operation("XOR"):
                return self.margin(pushed(expression), reading)
            case b.Operation(word=word) if has_margin(expression):
                return self._margin(expression, reading)
            case _:
                return self.read(expression, reading)

    def _margin(self, expression: b.Operation, reading: Reading) -> f.Formula:
        """Return the formula from which a comparison's robustness margin is computed.

        It has defaults for absent and unknown values.
        """
        difference = MARGINS[expression.word](*expression.operands)
        things, state = self._things(expression), self._state(expression)
        counted = self._counted(things, reading)
        known = [b.Operation("=", (state, _number(0)), Type.boolean)]
        if has_pairs(expression):
            known.append(_boolean("IS NOT NULL", difference))
        whole = f.Proposition(
            self._tested(_boolean("AND", *known) if len(known) > 1 else known[0], expression)
        )
        found: f.Formula = f.And((self._differences(difference, expression, reading), whole))
        sign = _CONTRARY[reading.unknown] if counted else reading.unknown
        doubt = self._doubtful(expression, state) if sign else None
        also: tuple[f.Formula, ...] = ()
        if doubt is not None:
            name = self._tested(doubt, expression)
            self.doubts.setdefault(name, expression)
            also = (f.Proposition(name + sign.strip("*")),)
        if counted:
            return f.Or((found, f.Not(f.Or((whole, *also)))))
        found = f.Or((found, *also)) if also else found
        return self._by_levels(found, things, reading) if counted is None else found

    def _differences(
        self, difference: b.Bound, meaning: b.Operation, reading: Reading
    ) -> f.Formula:
        """Return the formula for the difference between the two sides of a comparison.

        It covers all rules for unknown values in functions over time.
        """
        counted = self._counted(self._things(meaning), reading)

        def told(ways: Iterable[b.Bound], *, either: bool) -> f.Formula:
            names = [self.test(one).name for one in ways]
            for name in names:
                self.margins.setdefault(name, meaning)
            if len(names) == 1:
                return f.Proposition(names[0])
            return (f.Or if either else f.And)(tuple(map(f.Proposition, names)))

        ways = [*dict.fromkeys((difference, _in_favour(difference)))]
        found = told(ways, either=counted is True)
        if not self._open_courses(difference):
            return found
        found = f.And((found, told(map(_with_possible, ways), either=counted is True)))
        if not reading.unknown:
            return found
        differ = _boolean("<>", difference, _with_possible(difference))
        name = self._tested(differ, meaning)
        self.doubts.setdefault(name, meaning)
        return f.Or((found, f.Proposition(name + reading.unknown.strip("*"))))


def _has_state(expression: b.Bound) -> bool:
    return any(isinstance(part, b.Operation) and part.word == STATE for part in b.walk(expression))


_OF_CONDITIONS: Final = frozenset({"run_length", "since_true", "robustness"})
"""Functions over time whose operand is a condition."""


def _with_possible(expression: b.Bound) -> b.Bound:
    """Return a copy of an expression in which functions such as ``run_length`` count unknown as true."""
    match expression:
        case b.SignalCall(word=word, operand=operand) if word in _OF_CONDITIONS:
            return replace(expression, operand=_boolean(POSSIBLY, operand))
        case _:
            return b.with_operands(expression, _with_possible)


def _in_favour(expression: b.Bound) -> b.Bound:
    """Return a copy of an expression in which ``robustness(…)`` counts absent entities as true."""
    match expression:
        case b.SignalCall(word="robustness", operand=operand):
            return replace(expression, operand=_boolean(IN_FAVOUR, operand))
        case _ if isinstance(expression, b.SignalCall) or b.is_formula(expression):
            return expression
        case _:
            return b.with_operands(expression, _in_favour)


def _absence_tried(expression: b.Bound, *, counted: bool) -> b.Bound:
    """Evaluate a condition twice: absent entities count as false, then as true. Join the results by OR or AND.

    If ``counted``, one result must be true, otherwise both.
    """
    other = _in_favour(expression)
    if other == expression:
        return expression
    return _case(expression, TRUE, other) if counted else _boolean("AND", expression, other)


def _number(value: float) -> b.Value:
    return b.Value(value, Type.number)


def _boolean(word: str, *operands: b.Bound) -> b.Operation:
    return b.Operation(word, operands, Type.boolean)


def _case(condition: b.Bound, then: b.Bound, otherwise: b.Bound) -> b.Operation:
    return _boolean("case", condition, then, otherwise)


def _contrary(condition: b.Bound) -> b.Bound:
    """Return the negation of a condition that depends on several frames.

    It is false too if a number of two entities is missing.
    """
    if not has_pairs(condition):
        return _case(condition, FALSE, TRUE)
    return _boolean("case", condition, FALSE, _boolean("IS NULL", condition), FALSE, TRUE)


def _state_of(value: b.Bound) -> b.Operation:
    return b.Operation(STATE, (value,), Type.number)


PlannedCheck = tuple[CheckPlan, f.Formula, "f.Formula | None", dict[int, f.Formula]]
"""Plan of a check, its formula, its reset formula, and its quantifier conditions by quantifier number."""


def empty_plan(check: BoundCheck) -> CheckPlan:
    """Return a new evaluation plan for a check. It has no queries yet."""
    words = tuple((q.word if q.absent else "false", frozenset(q.nodes)) for q in check.quantifiers)
    return CheckPlan(query_of_check(check), variables_of(check), words=words, limit=check.limit)


def plan_of_check(check: BoundCheck, *, reset: bool = True) -> PlannedCheck:
    """Return a check's evaluation plan, its formula, its ``RESET`` condition and its quantifier conditions.

    Without ``reset``, the reset condition is None.
    """
    plan = empty_plan(check)
    formula = plan.read(check.formula, WHOLE)
    resets = plan.formula(check.reset) if reset and check.reset is not None else None
    guards = {
        n: plan.read(q.where, Reading("-" if q.word == "FORALL" else "+", absent=False))
        for n, q in enumerate(check.quantifiers)
        if q.where is not None
    }
    return plan, formula, resets, guards


def plan_of_margins(check: BoundCheck, reading: Reading = WHOLE) -> tuple[CheckPlan, f.Formula]:
    """Return the evaluation plan for the robustness of a check, and the formula that gives its margin."""
    plan = empty_plan(check)
    return plan, plan.margin(check.formula, reading)


def misses_absent(check: BoundCheck) -> bool:
    """True if a check can become false only because an entity is absent."""
    return any(one.word == "FORSOME" and one.absent for one in check.quantifiers)
