"""Open obligations of a check: conditions that later frames must satisfy.

Bindings with equal obligations share one state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from weakref import WeakValueDictionary

from sgstore.temporal._formula import TRUE, And, Formula, Since, propositions
from sgstore.temporal._progression import (
    Past,
    Progression,
    ProgressionFrame,
    Term,
    Tick,
    least,
    may_end,
)
from sgstore.temporal._quantifiers import HOLDS, PENDING, VIOLATED
from sgstore.temporal._valuation import NEVER
from sgstore.temporal._verdicts import always_true, bounded

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from sgstore.temporal._sequence_monitor import FrameTime

    Keys = NDArray[np.int64]
    Span = tuple[FrameTime, FrameTime]


REMEMBERED: Final = 100_000
"""Largest number of cached transitions before a reset."""

Duties = tuple["frozenset[Term] | Term | None", ...]
"""Open obligations of each part of a formula: a set for an ``ALWAYS``, else one term."""


class ObligationState:
    """State of a temporal formula during monitoring: its obligations, and the memory of past operators.

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
        """True if the temporal formula is true when the trace ends now."""
        if self.word in {"broken", "begins"}:
            return self.word == "begins"
        return all(term.ended for term in self._open)

    @property
    def _open(self) -> list[Term]:
        return [d for duty in self.duties if duty for d in _open(duty)]

    def at_end(self, end: str, tick: Tick) -> int:
        """Return the formula's verdict code if the trace ends now: ``VIOLATED``, ``PENDING``, ``HOLDS``."""
        if self.ended or end == "weak":
            return HOLDS
        due = end == "pending" or (end == "bounded" and all(may_end(t, tick) for t in self._open))
        return PENDING if due else VIOLATED


@dataclass(frozen=True, slots=True)
class ObligationStep:
    """Result of one frame for a monitored formula: the next state, and violations that begin or end.

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
    """Monitored formula of a check as a state machine, with its reset condition and quantifier conditions.

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
        """Return the state of the formula after one frame, and the violations that begin or end.

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
        """Return the time (ns) and frame number until which no time bound of the formula begins or ends."""
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
    """Split a formula ``ALWAYS p``: return True and p, or False and the whole formula.

    The split requires a p with bounded future.
    """
    body = always_true(formula)
    if body is None or not bounded(body):
        return False, formula
    return True, body
