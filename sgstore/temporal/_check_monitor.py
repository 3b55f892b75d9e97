"""Online monitor of one ``CHECK`` statement, which processes a running trace frame by frame.

Each binding of a check has a state. Bindings in the same state share one object, so states compare by identity.
If time does not matter, the successor of a state and a letter is cached. So most bindings need one table lookup
per frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakValueDictionary

import numpy as np

from sgstore.errors import QueryError
from sgstore.temporal._binding_truth import Valuation
from sgstore.temporal._check_plan import FAVOURABLE, SIGNS, UNFAVOURABLE, base_name, plan_of_check
from sgstore.temporal._check_verdict import (
    Verdict,
    ViolationInterval,
    doubt_text,
    verdict_of,
)
from sgstore.temporal._formula import TRUE, And, Formula, Since, looks_ahead, propositions
from sgstore.temporal._match_values import AT_FRAME, ReturnedValues
from sgstore.temporal._match_values_monitor import MatchValues
from sgstore.temporal._plan import plan_of_returned
from sgstore.temporal._progression import (
    Past,
    Progression,
    ProgressionFrame,
    Term,
    Tick,
    least,
    may_end,
)
from sgstore.temporal._quantifiers import (
    HOLDS,
    PENDING,
    UNKNOWN,
    VIOLATED,
    Level,
    folded_values,
    innermost,
    levels_of,
    may_wait,
    newcomers,
    waits_for_newcomers,
)
from sgstore.temporal._robustness_monitor import RobustnessMonitor
from sgstore.temporal._sequence_monitor import FrameTime, MonitorEvent
from sgstore.temporal._valuation import NEVER, BindingTable, Partial
from sgstore.temporal._verdicts import (
    CERTAINLY_TRUE,
    FALSE,
    PRESUMABLY_FALSE,
    PRESUMABLY_TRUE,
    STATUS,
    always_true,
    bounded,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.ir import BoundCheck, BoundQuantifier, OverMatch
    from sgstore.model.world import Bools
    from sgstore.temporal._robustness import Robustness
    from sgstore.temporal._signal_state import StreamClock
    from sgstore.temporal._valuation import Key, Memory, QueryCache

    Keys = NDArray[np.int64]
    Span = tuple[FrameTime, FrameTime]

REMEMBERED: Final = 100_000
"""Largest number of cached transitions. A larger cache is cleared."""

Duties = tuple["frozenset[Term] | Term | None", ...]
"""Open obligations of each part of a formula: a set of terms for an ``ALWAYS``, otherwise one term."""


class ObligationState:
    """State of a temporal formula during monitoring: its conditions on later frames, and its past values.

    An obligation is a condition on later frames.

    Attributes
    ----------
    word : str
        ``begins``: evaluation starts at the next frame; ``open``; ``broken``; ``kept``: true for any later
        frames.
    past : Past
    duties : Duties
    timeless : bool
        True if the state contains no times.
    following : dict of int to ObligationStep
        Cached transitions by letter.
    staying : dict of int to (int, int, int, int)
        Letters without effect: true guards, last time (ns) and number of a frame with this property, and time
        tolerance (ns).
    """

    __slots__ = ("__weakref__", "duties", "following", "past", "staying", "timeless", "word")

    def __init__(self, word: str, past: Past, duties: Duties) -> None:
        self.word, self.past, self.duties = word, past, duties
        timed = any(term.timed for term in self.terms) or any(entries for _, entries in past)
        self.timeless = not timed
        self.following: dict[int, ObligationStep] = {}
        self.staying: dict[int, tuple[int, int, int, int]] = {}

    @property
    def terms(self) -> list[Term]:
        """Return all open obligations (conditions on later frames) in the state."""
        found = [term for term, _ in self.past]
        found += [term for _, entries in self.past for *_, term in entries]
        for duty in self.duties:
            found += [duty] if isinstance(duty, Term) else duty or ()
        return found

    @property
    def ended(self) -> bool:
        """True if the temporal formula is fulfilled when the trace ends at this frame."""
        if self.word in {"broken", "begins"}:
            return self.word == "begins"
        return all(term.ended for term in self._open)

    @property
    def _open(self) -> list[Term]:
        return [d for duty in self.duties if duty for d in _open(duty)]

    def at_end(self, end: str, tick: Tick) -> int:
        """Return the verdict of the formula if the trace ends now: ``VIOLATED``, ``PENDING`` or ``HOLDS``."""
        if self.ended or end == "weak":
            return HOLDS
        due = end == "pending" or (end == "bounded" and all(may_end(t, tick) for t in self._open))
        return PENDING if due else VIOLATED


@dataclass(frozen=True, slots=True)
class ObligationStep:
    """Result of one frame for a monitored formula: next state, and whether a violation begins or ends.

    Attributes
    ----------
    state : ObligationState
    started, ended : bool
        True if a violation begins, or ends, with this frame.
    guards : int
        True guards of this frame, one bit each.
    """

    state: ObligationState
    started: bool
    ended: bool
    guards: int


class Automaton:
    """State machine for the formula of a check, its ``RESET`` condition and its quantifier conditions.

    Parameters
    ----------
    formula : Formula
    reset : Formula, optional
        Reset condition; it does not depend on later frames.
    guards : sequence of Formula
        Guards; conditions of single frames.
    bits : mapping of str to int
        Proposition → its bit in letters.

    Attributes
    ----------
    begun : ObligationState
        State before the first frame.
    mask : int
        Relevant bits of letters.
    """

    def __init__(
        self,
        formula: Formula,
        reset: Formula | None,
        guards: Sequence[Formula],
        bits: Mapping[str, int],
    ) -> None:
        whole = And((formula, reset or TRUE, *guards))
        self._progression = Progression(whole)
        assert isinstance(self._progression.formula, And)  # noqa: S101 - it was made so
        first, second, *rest = self._progression.formula.operands
        self._reset = second if reset is not None else None
        self._guards = tuple(rest)
        self._parts = tuple(map(_part, _conjuncts(first)))
        self._bits = {name: bits[name] for name in sorted(propositions(whole))}
        self.mask = sum(self._bits.values())
        self._states: WeakValueDictionary[tuple[str, Past, Duties], ObligationState] = (
            WeakValueDictionary()
        )
        self._remembered: dict[ObligationState, None] = {}
        self._steps = 0
        self.begun = self._state("begins", self._progression.begun, ())

    def step(
        self,
        state: ObligationState,
        letter: int,
        tick: Tick,
        seen: dict[tuple[ObligationState, int], ObligationStep],
    ) -> ObligationStep:
        """Return the state of the formula after one frame, and if a violation begins or ends there.

        Parameters
        ----------
        state : ObligationState
        letter : int
            True propositions, one bit each, within :attr:`mask`.
        tick : Tick
        seen : dict
            Cache of transitions in this frame, provided by the caller.
        """
        found = state.following.get(letter) or seen.get((state, letter))
        if found is None and letter in state.staying:
            guards, time, number, tolerance = state.staying[letter]
            known = tick.time <= time and tick.number <= number
            if known and tick.tolerance == tolerance:
                return ObligationStep(state, started=False, ended=False, guards=guards)
        if found is None:
            found = self._step(state, letter, tick)
            if found.state is state and not (state.timeless or found.started or found.ended):
                until = self._until(state, tick)
                state.staying[letter] = (found.guards, *until, tick.tolerance)
            if state.timeless and found.state.timeless:
                self._remember(state, letter, found)
            else:
                seen[state, letter] = found
        return found

    def _until(self, state: ObligationState, tick: Tick) -> tuple[int, int]:
        """Return the time (ns) and frame number up to which no time bound of the formula begins or ends."""
        bounds = [begun for term in state.terms for begun in term.bounds()]
        for part, (_, entries) in zip(self._progression.past, state.past, strict=True):
            if isinstance(part, Since):
                kept = ((n if part.bound.frames else t) for t, n, _ in entries)
                bounds += [(part.bound, since) for since in kept]
        last = [NEVER, NEVER]
        for written, since in bounds:
            bound = written.widened(tick.tolerance)
            now = tick.number if bound.frames else tick.time
            ends = [since + bound.low - 1]
            ends += [] if bound.high is None else [since + bound.high]
            last[bound.frames] = min([last[bound.frames], *(end for end in ends if end >= now)])
        return last[False], last[True]

    def _remember(self, state: ObligationState, letter: int, step: ObligationStep) -> None:
        if self._steps == REMEMBERED:
            for known in self._remembered:
                known.following.clear()
            self._remembered.clear()
            self._steps = 0
        self._steps += 1
        self._remembered[state] = None
        state.following[letter] = step

    def _state(self, word: str, past: Past, duties: Duties) -> ObligationState:
        key = word, past, duties
        found = self._states.get(key)
        if found is None:
            found = self._states[key] = ObligationState(*key)
        return found

    def _step(self, state: ObligationState, letter: int, tick: Tick) -> ObligationStep:
        named = {name: bool(letter & bit) for name, bit in self._bits.items()}
        frame = ProgressionFrame(self._progression, state.past, named, tick)
        true = self._progression.terms.true
        guards = sum(
            1 << number for number, guard in enumerate(self._guards) if frame.now(guard) is true
        )
        word, duties, started = state.word, state.duties, False
        if word in {"begins", "open"}:
            word, duties = self._moved(state, frame)
            started = word == "broken"
        ended = False
        if word == "broken" and self._reset is not None and frame.now(self._reset) is true:
            word, ended = "begins", True
        # A final state needs no past, except for guards.
        past = self._progression.begun if self._lasts(word) and not self._guards else frame.past()
        return ObligationStep(self._state(word, past, duties), started, ended, guards)

    def _lasts(self, word: str) -> bool:
        return word == "kept" or (word == "broken" and self._reset is None)

    def final(self, state: ObligationState, counted: int) -> bool:
        """True if no later frame can change the state of the formula.

        The bits of ``counted`` are quantifier conditions that were true.
        """
        return self._lasts(state.word) and counted == (1 << len(self._guards)) - 1

    def _moved(self, state: ObligationState, frame: ProgressionFrame) -> tuple[str, Duties]:
        terms = self._progression.terms
        first = state.word == "begins"
        duties: list[frozenset[Term] | Term | None] = []
        for number, (always, part) in enumerate(self._parts):
            before = None if first else state.duties[number]
            if always:
                assert before is None or isinstance(before, frozenset)  # noqa: S101 - it was made so
                found = {frame.resolved(term) for term in before or ()} | {frame.now(part)}
                if terms.false in found:
                    return "broken", ()
                found.discard(terms.true)
                duties.append(frozenset(least(found)))
            else:
                assert before is None or isinstance(before, Term)  # noqa: S101 - it was made so
                term = frame.now(part) if before is None else frame.resolved(before)
                if term is terms.false:
                    return "broken", ()
                duties.append(term)
        if all(duty is terms.true for duty in duties):
            return "kept", ()
        return "open", tuple(duties)


def _open(duty: frozenset[Term] | Term) -> Sequence[Term]:
    return (duty,) if isinstance(duty, Term) else tuple(duty)


def _conjuncts(formula: Formula) -> list[Formula]:
    if isinstance(formula, And):
        return [part for operand in formula.operands for part in _conjuncts(operand)]
    return [formula]


def _part(formula: Formula) -> tuple[bool, Formula]:
    """Return (True, p) for a formula ``ALWAYS p``, otherwise (False, formula).

    The split requires a p with bounded future.
    """
    body = always_true(formula)
    if body is None or not bounded(body):
        return False, formula
    return True, body


@dataclass(frozen=True, slots=True)
class _CheckEntry:
    """State of a monitored check for one combination of entities (one binding).

    Attributes
    ----------
    state : ObligationState
    counted : int
        Guards that were true in some frame, one bit each.
    since : FrameTime or None
        Start of the current violation.
    over : tuple of (Moment, FrameTime)
        Ended violations.
    memory : Memory
        Memory of the time functions.
    final : bool
        True if no later frame can change the entry.
    doubt : Doubt or None
        Second evaluation, in which unknown conditions count against the check. ``None`` means no difference.
    """

    state: ObligationState
    counted: int
    since: FrameTime | None
    over: tuple[Span, ...]
    memory: Memory
    final: bool = False
    doubt: Doubt | None = None


@dataclass(frozen=True, slots=True)
class Doubt:
    """Second state of a monitored combination of entities. Here, unknown conditions count as violations.

    Attributes
    ----------
    state : ObligationState
    counted : int
    violated : bool
        True if this evaluation had a violation.
    name : str
        Unknown proposition.
    at : FrameTime
        Frame with the unknown value.
    """

    state: ObligationState
    counted: int
    violated: bool
    name: str
    at: FrameTime


def _same(one: _CheckEntry, other: _CheckEntry) -> bool:
    return (
        one.state is other.state
        and one.doubt == other.doubt
        and one.counted == other.counted
        and one.since is other.since
        and one.over == other.over
        and one.memory == other.memory
    )


class CheckMonitor:
    """Online monitor of one check over one trace.

    Parameters
    ----------
    check : BoundCheck
    questions : QueryCache
        Query cache; the queries of the check are added.
    pulse : StreamClock
        Clock, updated with each frame before this object.
    compat : bool
        True for SGSM mode: the check is violated in a frame if the trace would violate it by ending there.

    Raises
    ------
    QueryError
        A value that is needed at once depends on later frames.
    """

    def __init__(
        self, check: BoundCheck, questions: QueryCache, pulse: StreamClock, *, compat: bool = False
    ) -> None:
        self._check, self._pulse, self._compat = check, pulse, compat
        self._last: FrameTime | None = None
        plan, formula, reset, guards = plan_of_check(check, reset=not compat)
        self._variables = plan.bound
        if check.gaps == "unknown":
            raise QueryError(
                f"USING GAPS unknown of {check.name} needs a complete recording",
                hint="a monitor sees every frame that there is; leave it out, or ask a store",
            )
        if reset is not None and looks_ahead(reset):
            raise QueryError(
                f"RESET WHEN of {check.name} looks ahead",
                hint="a monitor restarts in the next frame, so the reset condition must be known by then",
            )
        self._guards: dict[BoundQuantifier, int] = {
            check.quantifiers[number]: 1 << place for place, number in enumerate(guards)
        }
        self._letters = Valuation(
            plan, self._variables, questions, pulse, bridge=check.gaps == "bridge"
        )
        self._plan = plan
        bits = dict(self._letters.bits)
        self._signed: dict[str, list[tuple[int, int, str]]] = {sign: [] for sign in SIGNS}
        every = (n for one in (formula, *guards.values()) for n in propositions(one))
        for name in sorted(n for n in {*every} if n[-1] in SIGNS):
            bits[name] = 1 << len(bits)
            self._signed[name[-1]].append((bits[base_name(name)], bits[name], base_name(name)))
        self._automaton = Automaton(formula, reset, tuple(guards.values()), bits)
        strangers = _CheckEntry(self._automaton.begun, 0, None, (), self._letters.begun)
        self._known = BindingTable(self._letters.lattice, strangers)
        self._questions = questions
        nodes = check.scope.nodes.items()
        self._domains = {key: questions.met(node.kinds) for key, node in nodes}
        self._kinds = {node.kinds for _, node in nodes}
        self._margins = RobustnessMonitor(check, questions, pulse) if check.robustness else None
        self._returned = ReturnedValues(check.returns, "first", check.having)
        about, bridge = (questions, pulse), check.gaps == "bridge"
        plan = partial(plan_of_returned, check)
        self._values = MatchValues(self._returned.parts, plan, *about, bridge=bridge)
        self._ended: dict[tuple[Partial, Span], dict[str, Any] | None] = {}
        self._told: dict[Key, tuple[int, int]] = {}
        self._full = 0
        self._immediate = all(q.word == "FORALL" for q in check.quantifiers)

    @property
    def check(self) -> BoundCheck:
        """The monitored check, with resolved names."""
        return self._check

    @property
    def name(self) -> str:
        """Name of the monitored check."""
        return self._check.name

    # Online, frame by frame

    def step(self, here: FrameTime) -> list[MonitorEvent]:
        """Process the next frame of the trace, and return the new events.

        The query results of the frame must be ready.
        """
        if self._margins is not None:
            self._margins.step()
        self._count_full()
        known, check = self._known, self._check
        found = {row: entry for row, entry in known.held.items() if entry.final}
        left = (row for row in known.held if row not in found) if found else known.held
        letters, memories = self._letters.read(left, self._remembered)
        changed: list[Partial] = []
        seen: dict[tuple[ObligationState, int], ObligationStep] = {}
        tick, automaton, mask = self._pulse.tick, self._automaton, self._automaton.mask
        stepped = self._as_sgsm if self._compat else _stepped
        for row, letter in letters.items():
            before = known.of(row)
            if before.final:
                found[row] = before
                continue
            best, worst = (self._with_unknown(letter, sign) & mask for sign in SIGNS)
            step = automaton.step(before.state, best, tick, seen)
            entry = stepped(before, step, here, memories.get(row, ()))
            if before.doubt is not None or best != worst:
                other = (before.doubt or before).state
                doubted = automaton.step(other, worst, tick, seen)
                doubt = self._doubted(before, entry, doubted, letter, here)
                entry = replace(entry, doubt=doubt)
            if entry is not before:
                changed.append(row)
                if entry.doubt is None and automaton.final(entry.state, entry.counted):
                    entry = replace(entry, memory=(), final=True)
            found[row] = entry
        grown = [(row, len(known.of(row).over)) for row in changed] if check.returns else []
        known.keep(found, _same)
        if check.returns:
            self._return(grown)
        self._last = here
        if not self._immediate:
            return []
        return list(self._events(here, changed))

    def _with_unknown(self, letter: int, sign: str) -> int:
        for bit, signed, _ in self._signed[sign]:
            if letter & bit:
                letter |= signed
        return letter

    def _doubted(
        self,
        before: _CheckEntry,
        entry: _CheckEntry,
        step: ObligationStep,
        letter: int,
        here: FrameTime,
    ) -> Doubt | None:
        """Return the state of some entities in which unknown conditions count as violations; None without one.

        ``None`` means that they change nothing.
        """
        old = before.doubt
        broken = step.started or (self._compat and not step.state.ended)
        own = entry.since is not None or len(entry.over) > len(before.over)
        violated = (old is not None and old.violated) or (broken and not own)
        counted = (before if old is None else old).counted | step.guards
        if step.state is entry.state and not violated and counted == entry.counted:
            return None
        if old is not None:
            return replace(old, state=step.state, counted=counted, violated=violated)
        every = [*self._signed[UNFAVOURABLE], *self._signed[FAVOURABLE]]
        name = next(name for bit, _, name in every if letter & bit)
        return Doubt(step.state, counted, violated, name, here)

    def _count_full(self) -> None:
        questions = self._questions
        if self._kinds & questions.fresh:
            self._full = 0
        self._full += all(questions.here[k] == len(questions.met(k)) for k in self._kinds)

    def _return(self, grown: list[tuple[Partial, int]]) -> None:
        """Compute the ``RETURN`` values of the violations that ended with this frame."""
        self._values.step()
        for row, before in grown:
            entry = self._known.of(row)
            for span in entry.over[before:]:
                for key in (row, *self._covered(row, entry)):
                    self._ended[key, span] = self._values_of(key, span)
        held = self._known.held.values()
        since = (entry.since.seq for entry in held if entry.since is not None)
        self._values.forget((self._pulse.tick.number, *since))

    def _values_of(self, key: Partial, span: Span) -> dict[str, Any] | None:
        """Return the ``RETURN`` values of a violation, or None if its ``HAVING`` condition is false."""
        binding = dict(zip(self._variables, key, strict=True))
        start, end = (one.seq for one in span)

        def part(value: OverMatch) -> Any:
            last = start if value.start == AT_FRAME else end
            return self._values.value(value, binding, (start, last))

        return self._returned.told(part)

    def _violation(self, key: Partial, span: Span) -> dict[str, Any] | None:
        """Return the ``RETURN`` values of a violation: stored ones if it has ended, otherwise new ones."""
        if not self._check.returns or span not in self._known.of(key).over:
            return self._values_of(key, span)
        wider = ((row, span) for row in self._known.lattice.wider(key))
        return next(self._ended[row] for row in wider if row in self._ended)

    def _as_sgsm(
        self, entry: _CheckEntry, step: ObligationStep, here: FrameTime, memory: Memory
    ) -> _CheckEntry:
        """Return the state of the check after this frame, for one combination of entities, in SGSM mode.

        In this mode, a violation lasts as long as the frames so far violate the check.
        """
        since, over = entry.since, entry.over
        if not step.state.ended:
            since = since or here
        elif since is not None:
            since, over = None, (*over, (since, self._last or here))
        counted = entry.counted | step.guards
        found = _CheckEntry(step.state, counted, since, over, memory)
        return entry if _same(entry, found) else found

    def _remembered(self, row: Partial) -> Memory | None:
        entry = self._known.of(row)
        return None if entry.final else entry.memory

    # Results

    def _events(self, here: FrameTime, changed: list[Partial]) -> Iterator[MonitorEvent]:
        """Yield events for the combinations of entities whose status changed in this frame.

        A new entity produces events for all its combinations. ``HAVING`` chooses ended violations.
        """
        rows = list(self._known.held) if self._kinds & self._questions.fresh else changed
        for row in rows:
            entry = self._known.of(row)
            if entry.since is None and not entry.over:
                continue
            for key in self._covered(row, entry):
                begun, ended = self._told.get(key, (0, 0))
                begins = entry.since is not None and self._check.having is None
                told = len(entry.over) + begins, len(entry.over)
                if (begun, ended) == told or not self._counts(key, entry):
                    continue
                self._told[key] = told
                for number, (start, end) in enumerate(entry.over[ended:], ended):
                    values = self._violation(key, (start, end))
                    if values is None:
                        continue
                    if number >= begun:
                        yield self._event("violated", here, key, start, start)
                    event = self._event("kept again", here, key, start, end)
                    yield replace(event, values=values)
                if begins and entry.since is not None and begun < told[0]:
                    yield self._event("violated", here, key, entry.since, entry.since)

    def _covered(self, row: Partial, entry: _CheckEntry) -> Iterator[Key]:
        """Yield all combinations of known entities to which a monitoring state applies."""
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

    def _counts(self, key: Key, entry: _CheckEntry) -> bool:
        """True if the check applies to this combination of entities."""
        if entry.counted != (1 << len(self._guards)) - 1:
            return False
        if any(n not in self._domains[v] for n, v in zip(key, self._variables, strict=True)):
            return False
        return not self._check.injective or (
            len(set(key)) == len(key) and not any(node in self._others for node in key)
        )

    @property
    def _others(self) -> set[int]:
        rest = [n for n in self._domains if n not in self._variables]
        return {node for name in rest for node in self._domains[name]}

    def _event(
        self,
        kind: str,
        here: FrameTime,
        key: Key,
        start: FrameTime,
        end: FrameTime,
        *,
        at_end: bool = False,
    ) -> MonitorEvent:
        nodes = dict(zip(self._variables, key, strict=True))
        names = {name: self._domains[name][node] for name, node in nodes.items()}
        return MonitorEvent(kind, self.name, here, start, end, nodes, names, at_end=at_end)

    # End of the trace

    @property
    def robustness(self) -> Robustness | None:
        """Robustness (margin of the verdict) if the trace ended now; None if it was not requested."""
        return None if self._margins is None else self._margins.told(self._levels(), self._domains)

    def status(self) -> str:
        """Return the status of the check for the entities seen so far: one of ``STATUS``."""
        levels = self._levels()
        bindings = innermost(levels)
        known = STATUS[self._folded_codes(levels, [self._of(key) for key in bindings.tolist()])]
        if known != "false" and any(one.doubt for one in self._known.held.values()):
            return "unknown" if self._worst() in {UNKNOWN, VIOLATED} else known
        return known

    def _worst(self) -> int:
        """Return the verdict if the trace ends now and all unknown conditions count against the check."""
        levels = self._levels(doubted=True)
        codes = [self._code_at_end(self._of(key)) for key in innermost(levels).tolist()]
        return int(folded_values(levels, np.array(codes, np.int8), HOLDS)[0][0])

    def _of(self, key: list[int]) -> _CheckEntry:
        return self._known.of(tuple(key))

    def _levels(self, *, doubted: bool = False, waiting: bool = False) -> list[Level]:
        """Return the combinations of entities for each quantifier of the check, outermost quantifier first.

        ``doubted``: use the second evaluation. ``waiting``: add future bindings of ``FORSOME``.
        """
        domains = {n: np.array(sorted(met), np.int64) for n, met in self._domains.items()}
        domains = newcomers(self._check, domains) if waiting else domains
        size = len(self._variables)

        def counts(
            quantifier: BoundQuantifier, variables: tuple[str, ...], bindings: Keys
        ) -> Bools:
            bit = self._guards.get(quantifier, 0)
            if waiting and quantifier.word == "FORSOME":
                return np.ones(len(bindings), np.bool_)
            rest = (None,) * (size - len(variables))
            found = (self._known.of((*key, *rest)) for key in bindings.tolist())
            every = [(one.doubt if doubted and one.doubt else one).counted for one in found]
            return np.array([counted & bit == bit for counted in every], np.bool_)

        apart = np.array(sorted(self._others), np.int64) if self._check.injective else None
        return levels_of(self._check.quantifiers, domains, apart=apart, counts=counts)

    def _folded_codes(self, levels: list[Level], entries: list[_CheckEntry]) -> int:
        codes = np.array([_code(entry, compat=self._compat) for entry in entries], np.int8)
        return int(folded_values(levels, codes, CERTAINLY_TRUE)[0][0])

    def _spans(self, entry: _CheckEntry, last: FrameTime) -> list[Span]:
        """Return the violations of one entity combination at the trace end: first and last frame of each."""
        found = list(entry.over)
        if entry.since is not None:
            found.append((entry.since, last))
        elif not self._compat and self._ends(entry.state) == VIOLATED:
            # In SGSM mode, all violations are already reported, also at the last frame.
            found.append((last, last))
        return found

    def _ends(self, state: ObligationState) -> int:
        return HOLDS if self._compat else state.at_end(self._check.end, self._pulse.tick)

    def _code_at_end(self, entry: _CheckEntry) -> int:
        """Return the verdict of one combination of entities, as a code, when the trace has ended."""
        own = self._ends(entry.state)
        if entry.since is not None or entry.over or own == VIOLATED:
            return VIOLATED
        if entry.doubt is None:
            return own
        other = UNKNOWN if entry.doubt.violated else self._ends(entry.doubt.state)
        return UNKNOWN if other == VIOLATED else other

    def finish(self, trace: str, last: FrameTime) -> tuple[Verdict, list[MonitorEvent]]:
        """End the trace: return the verdict of the check, and the events that only the end decides."""
        levels = self._levels()
        bindings = innermost(levels)
        entries = [self._of(key) for key in bindings.tolist()]
        codes = np.array([self._code_at_end(one) for one in entries], np.int8)
        best, worst = int(folded_values(levels, codes, HOLDS)[0][0]), self._worst()
        word = "true" if worst == HOLDS else "pending" if worst == PENDING else "unknown"
        if best == VIOLATED:
            word = "pending" if self._waits(levels) else "false"
        spans = [self._spans(entry, last) for entry in entries]

        def violations(row: int, names: Mapping[str, str]) -> tuple[ViolationInterval, ...]:
            key = tuple(bindings[row].tolist())
            return tuple(
                _interval(trace, span, {**names, **values})
                for span in spans[row]
                if (values := self._violation(key, span)) is not None
            )

        found = verdict_of(
            self._check,
            Verdict(self.name, trace, word),
            levels,
            codes,
            self._domains,
            violations,
            _interval(trace, (last, last), {}),
        )
        if word == "unknown":
            found = replace(found, reason=self._reason(trace))
        if word == "true":
            found = replace(found, absent_frames=last.seq + 1 - self._full)
        if self._margins is not None:
            found = replace(found, robustness=self._margins.told(levels, self._domains))
        holds = word != "false"
        return found, list(self._at_end(last, holds=holds, bindings=bindings, spans=spans))

    def _waits(self, levels: list[Level]) -> bool:
        """True if entities that appear later can still make a false check true."""
        if self._compat or not may_wait(self._check):
            return False
        wider = self._levels(waiting=True)
        codes = [self._code_at_end(self._of(key)) for key in innermost(wider).tolist()]
        return waits_for_newcomers(self._check, levels, wider, np.array(codes, np.int8))

    def _reason(self, trace: str) -> str:
        """Return a text that explains an unknown verdict: the unknown condition, its entities and its frame."""
        for key in innermost(self._levels(doubted=True)).tolist():
            entry = self._of(key)
            if entry.doubt is not None and self._code_at_end(entry) == UNKNOWN:
                names = zip(self._variables, key, strict=True)
                who = [self._domains[name][node] for name, node in names]
                condition = self._plan.doubts[entry.doubt.name]
                return doubt_text(condition, who, f"{trace}#{entry.doubt.at.seq}")
        return "it is unknown whether a quantifier is about an entity"

    def _at_end(
        self, last: FrameTime, *, holds: bool, bindings: Keys, spans: list[list[Span]]
    ) -> Iterator[MonitorEvent]:
        """Yield an event for each violation that is certain only when the trace has ended."""
        if holds:
            return
        if not self._immediate:
            if self._check.having is None:
                yield MonitorEvent("violated", self.name, last, last, last, {}, {}, at_end=True)
            return
        for key, found in zip(bindings.tolist(), spans, strict=True):
            begun, _ = self._told.get(tuple(key), (0, 0))
            for start, end in found[begun:]:
                every = self._check.having is None
                if every or self._violation(tuple(key), (start, end)) is not None:
                    yield self._event("violated", last, tuple(key), start, start, at_end=True)


def _stepped(
    entry: _CheckEntry, step: ObligationStep, here: FrameTime, memory: Memory
) -> _CheckEntry:
    counted = entry.counted | step.guards
    plain = not (step.started or step.ended or memory)
    if plain and step.state is entry.state and counted == entry.counted:
        return entry
    since, over = entry.since, entry.over
    if step.started:
        since = here
    if step.ended and since is not None:
        since, over = None, (*over, (since, here))
    return _CheckEntry(step.state, counted, since, over, memory)


def _code(entry: _CheckEntry, *, compat: bool) -> int:
    broken = entry.state.word == "broken"
    if broken or (not compat and (entry.since is not None or entry.over)):
        return FALSE
    if entry.state.word == "kept":
        return CERTAINLY_TRUE
    return PRESUMABLY_TRUE if entry.state.ended else PRESUMABLY_FALSE


def _interval(trace: str, span: Span, values: Mapping[str, Any]) -> ViolationInterval:
    start, end = span
    times = start.time_ns, end.time_ns, start.t, end.t
    frames = end.seq - start.seq + 1
    return ViolationInterval(trace, start.seq, end.seq, *times, frames, dict(values))
