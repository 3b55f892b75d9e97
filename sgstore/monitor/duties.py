"""What a check still asks of one binding: states that are shared by all bindings that are in the same.

A state is made once and compared by identity. What follows a state and a letter is remembered, where time does
not matter in it, so most bindings of most checks take one look into a table a frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from weakref import WeakValueDictionary

from sgstore.temporal.formulas import TRUE, And, Formula, Since, propositions
from sgstore.temporal.progression import Frame, Past, Progression, Term, Tick, least
from sgstore.temporal.verdicts import always_true, bounded

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

NEVER: Final = 1 << 62
"""Later than any frame."""

REMEMBERED: Final = 100_000
"""Steps that are remembered before they are begun anew."""

Duties = tuple["frozenset[Term] | Term | None", ...]
"""For each part of a formula: what is open of an ``ALWAYS`` at former frames, or what is open of another."""


class State:
    """What is still to be shown, and what operators of the past keep.

    Attributes
    ----------
    word : str
        ``begins``: the formula is asked from the next frame on; ``open``; ``broken``; ``kept``: it is true,
        whatever comes.
    past : Past
    duties : Duties
    timeless : bool
        Whether no time is kept in it.
    following : dict of int to Step
        What is remembered of steps, by letter.
    staying : dict of int to (int, int, int)
        Of letters that change nothing: the guards that are true, and the last time (ns) and number of a frame
        of which that is known.
    """

    __slots__ = ("__weakref__", "duties", "following", "past", "staying", "timeless", "word")

    def __init__(self, word: str, past: Past, duties: Duties) -> None:
        self.word, self.past, self.duties = word, past, duties
        timed = any(term.timed for term in self.terms) or any(entries for _, entries in past)
        self.timeless = not timed
        self.following: dict[int, Step] = {}
        self.staying: dict[int, tuple[int, int, int]] = {}

    @property
    def terms(self) -> list[Term]:
        """All that is open."""
        found = [term for term, _ in self.past]
        found += [term for _, entries in self.past for *_, term in entries]
        for duty in self.duties:
            found += [duty] if isinstance(duty, Term) else duty or ()
        return found

    @property
    def ended(self) -> bool:
        """Whether the formula is true if no frame follows."""
        if self.word in {"broken", "begins"}:
            return self.word == "begins"
        open_terms = [d for duty in self.duties if duty for d in _open(duty)]
        return all(term.ended for term in open_terms)


@dataclass(frozen=True, slots=True)
class Step:
    """What a frame makes of a state.

    Attributes
    ----------
    state : State
    started, ended : bool
        Whether a violation begins, or ends, with this frame.
    guards : int
        Which guards are true in this frame, a bit each.
    """

    state: State
    started: bool
    ended: bool
    guards: int


class Automaton:
    """A formula, what resets it, and conditions of single frames that are looked at beside it.

    Parameters
    ----------
    formula : Formula
    reset : Formula, optional
        Looks at nothing later than the frame.
    guards : sequence of Formula
        Of single frames.
    bits : mapping of str to int
        The bit of each proposition in letters.

    Attributes
    ----------
    begun : State
        Before the first frame.
    mask : int
        The bits that matter.
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
        self._states: WeakValueDictionary[tuple[str, Past, Duties], State] = WeakValueDictionary()
        self._remembered: dict[State, None] = {}
        self._steps = 0
        self.begun = self._state("begins", self._progression.begun, ())

    def step(
        self, state: State, letter: int, tick: Tick, seen: dict[tuple[State, int], Step]
    ) -> Step:
        """What a frame makes of a state.

        Parameters
        ----------
        state : State
        letter : int
            The propositions that are true, a bit each; no others than those of :attr:`mask`.
        tick : Tick
        seen : dict
            What this frame has made of other states already; it is kept by whoever tells frames.
        """
        found = state.following.get(letter) or seen.get((state, letter))
        if found is None and letter in state.staying:
            guards, time, number = state.staying[letter]
            if tick.time <= time and tick.number <= number:
                return Step(state, started=False, ended=False, guards=guards)
        if found is None:
            found = self._step(state, letter, tick)
            if found.state is state and not (state.timeless or found.started or found.ended):
                state.staying[letter] = (found.guards, *self._until(state, tick))
            if state.timeless and found.state.timeless:
                self._remember(state, letter, found)
            else:
                seen[state, letter] = found
        return found

    def _until(self, state: State, tick: Tick) -> tuple[int, int]:
        """Up to which time and number no bound that is open in a state begins or ends."""
        bounds = [begun for term in state.terms for begun in term.bounds()]
        for part, (_, entries) in zip(self._progression.past, state.past, strict=True):
            if isinstance(part, Since):
                kept = ((n if part.bound.frames else t) for t, n, _ in entries)
                bounds += [(part.bound, since) for since in kept]
        last = [NEVER, NEVER]
        for bound, since in bounds:
            now = tick.number if bound.frames else tick.time
            ends = [since + bound.low - 1]
            ends += [] if bound.high is None else [since + bound.high]
            last[bound.frames] = min([last[bound.frames], *(end for end in ends if end >= now)])
        return last[False], last[True]

    def _remember(self, state: State, letter: int, step: Step) -> None:
        if self._steps == REMEMBERED:
            for known in self._remembered:
                known.following.clear()
            self._remembered.clear()
            self._steps = 0
        self._steps += 1
        self._remembered[state] = None
        state.following[letter] = step

    def _state(self, word: str, past: Past, duties: Duties) -> State:
        key = word, past, duties
        found = self._states.get(key)
        if found is None:
            found = self._states[key] = State(*key)
        return found

    def _step(self, state: State, letter: int, tick: Tick) -> Step:
        named = {name: bool(letter & bit) for name, bit in self._bits.items()}
        frame = Frame(self._progression, state.past, named, tick)
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
        # Of what will not change any more the past does not matter either, but to guards.
        past = self._progression.begun if self._lasts(word) and not self._guards else frame.past()
        return Step(self._state(word, past, duties), started, ended, guards)

    def _lasts(self, word: str) -> bool:
        return word == "kept" or (word == "broken" and self._reset is None)

    def final(self, state: State, counted: int) -> bool:
        """Whether no frame changes a state any more, if so many guards were true in some frame."""
        return self._lasts(state.word) and counted == (1 << len(self._guards)) - 1

    def _moved(self, state: State, frame: Frame) -> tuple[str, Duties]:
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
    """A formula as it is watched: what must be true at each frame, each by itself; or whole."""
    body = always_true(formula)
    if body is None or not bounded(body):
        return False, formula
    return True, body
