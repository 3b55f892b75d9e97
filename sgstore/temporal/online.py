"""Formulas frame by frame, in memory that the look-ahead bounds: progression of what is still to be shown.

At each frame a formula becomes a combination by *and*, *or* and *not* of **duties**: formulas that the next
frame must show (or need not, where there is none). What is already known vanishes in it. Equal combinations
are one object, so duties that come back are recognised, and a formula without bounds meets few of them:
they are the states of an automaton that is built as it is walked.

Operators of the past keep the combination that stood for them one frame before, for the present may depend
on the future of the past (``ONCE NEXT p``).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakValueDictionary

from sgstore.temporal.formulas import (
    And,
    Constant,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    Until,
    propositions,
    walk,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

REMEMBERED: Final = 100_000
"""Steps of a formula without bounds and past that are remembered: (combination, letter) → what follows."""


class _Term:
    """A combination of duties; equal ones are the same object."""

    __slots__ = ("__weakref__", "operands", "word")

    def __init__(self, word: str, operands: tuple[Any, ...]) -> None:
        self.word = word
        self.operands = operands


class _Terms:
    """All combinations that are in use."""

    def __init__(self) -> None:
        self._known: WeakValueDictionary[tuple[Any, ...], _Term] = WeakValueDictionary()
        self.true = self._made("true", ())
        self.false = self._made("false", ())

    def _made(self, word: str, operands: tuple[Any, ...], key: tuple[Any, ...] = ()) -> _Term:
        term = self._known.get((word, key))
        if term is None:
            term = _Term(word, operands)
            self._known[word, key] = term
        return term

    def constant(self, value: bool) -> _Term:  # noqa: FBT001 - it is the value
        return self.true if value else self.false

    def duty(self, formula: Formula, since: int | None, *, weak: bool) -> _Term:
        """What the next frame must show; ``since``: from where its bound counts, if that has begun already."""
        return self._made("duty", (formula, since, weak), (formula, since, weak))

    def negated(self, term: _Term) -> _Term:
        if term is self.true or term is self.false:
            return self.constant(term is self.false)
        if term.word == "not":
            return term.operands[0]
        return self._made("not", (term,), (id(term),))

    def joined(self, word: str, terms: list[_Term]) -> _Term:
        """``and`` or ``or`` of some terms, without what does not matter."""
        neutral, absorbing = (self.true, self.false) if word == "and" else (self.false, self.true)
        parts: dict[int, _Term] = {}
        for term in terms:
            for part in term.operands if term.word == word else (term,):
                if part is absorbing:
                    return absorbing
                if part is not neutral:
                    parts[id(part)] = part
        if any(part.word == "not" and id(part.operands[0]) in parts for part in parts.values()):
            return absorbing
        if len(parts) < 2:
            return next(iter(parts.values()), neutral)
        return self._made(word, tuple(parts.values()), tuple(sorted(parts)))


@dataclass(slots=True)
class _Entry:
    """A frame back at which the right side of a bounded *since* stood, and what its truth here still needs."""

    time: int
    number: int
    term: _Term


@dataclass(slots=True)
class _Past:
    """What an operator of the past keeps from one frame to the next."""

    before: _Term
    entries: deque[_Entry] = field(default_factory=deque["_Entry"])


class Online:
    """A formula that is told one frame after the other.

    Parameters
    ----------
    formula : Formula
    every : bool
        Whether the value at every frame is to be told, or the verdict only, which is cheaper.

    Attributes
    ----------
    verdict : bool or None
        The value at the first frame if the trace ended now; ``None`` before the first frame.
    certain : bool
        Whether that is the value whatever comes.
    """

    def __init__(self, formula: Formula, *, every: bool = True) -> None:
        self._formula = formula
        self._every = every
        self.terms = _Terms()
        self._names = sorted(propositions(formula))
        self.past = {
            part: _Past(self.terms.false)
            for part in walk(formula)
            if isinstance(part, Previous | Since)
        }
        self._plain = not self.past and not any(
            isinstance(part, Until) and (part.bound.low or part.bound.high is not None)
            for part in walk(formula)
        )
        self._steps: dict[tuple[Any, ...], _Term] = {}
        self._open: dict[_Term, list[int]] = {}
        self._first: _Term | None = None
        self.number = -1
        self.time = 0
        self.verdict: bool | None = None

    @property
    def certain(self) -> bool:
        """Whether no further frame can change the verdict, as far as logic without search can tell."""
        return self._first is self.terms.true or self._first is self.terms.false

    def step(self, letter: Mapping[str, bool], time_ns: int) -> list[tuple[int, bool]]:
        """Tell the next frame.

        Parameters
        ----------
        letter : mapping of str to bool
            The propositions.
        time_ns : int
            Later than the frame before.

        Returns
        -------
        list of (int, bool)
            Frames whose value is known from now on, in order, and these values.

        Raises
        ------
        ValueError
            A proposition is missing, or time does not ascend.
        """
        if self.number >= 0 and time_ns <= self.time:
            raise ValueError("the times of the frames must ascend")
        missing = [name for name in self._names if name not in letter]
        if missing:
            raise ValueError(f"no value for the proposition {missing[0]!r}")
        self.number += 1
        self.time = time_ns
        frame = _Frame(self, letter)
        if not self._every and self._first is not None:
            self._first = self._moved(self._first, letter, frame)
            frame.keep()
            self.verdict = self._ended(self._first)
            return []
        here = (
            frame.now(self._formula) if not self._plain else self._remembered(None, letter, frame)
        )
        moved: dict[_Term, list[int]] = {}
        for term, numbers in self._open.items():
            moved.setdefault(self._moved(term, letter, frame), []).extend(numbers)
        moved.setdefault(here, []).append(self.number)
        self._first = here if self._first is None else self._moved(self._first, letter, frame)
        frame.keep()
        self.verdict = self._ended(self._first)
        known: list[tuple[int, bool]] = []
        for value, term in ((True, self.terms.true), (False, self.terms.false)):
            known += [(number, value) for number in moved.pop(term, ())]
        self._open = moved
        return sorted(known)

    @property
    def state(self) -> object:
        """What the verdict still depends on.

        If a step of a formula that is :attr:`plain` leaves it the same, it stays so while the propositions do.
        """
        return self._first

    @property
    def plain(self) -> bool:
        """Whether a step depends on the propositions alone: no bounds, and nothing of the past."""
        return self._plain

    def finish(self) -> list[tuple[int, bool]]:
        """End the trace: the frames whose value was not known yet, in order, and these values."""
        known = [(n, self._ended(term)) for term, numbers in self._open.items() for n in numbers]
        self._open = {}
        return sorted(known)

    def _moved(self, term: _Term, letter: Mapping[str, bool], frame: _Frame) -> _Term:
        return self._remembered(term, letter, frame) if self._plain else frame.resolved(term)

    def _remembered(self, term: _Term | None, letter: Mapping[str, bool], frame: _Frame) -> _Term:
        key = (term, *(letter[name] for name in self._names))
        found = self._steps.get(key)
        if found is None:
            found = frame.now(self._formula) if term is None else frame.resolved(term)
            if len(self._steps) < REMEMBERED:
                self._steps[key] = found
        return found

    def _ended(self, term: _Term) -> bool:
        """The value of a combination if no frame follows."""
        match term.word:
            case "true" | "false":
                return term.word == "true"
            case "duty":
                return term.operands[2]
            case "not":
                return not self._ended(term.operands[0])
            case "and":
                return all(self._ended(operand) for operand in term.operands)
            case _:
                return any(self._ended(operand) for operand in term.operands)


class _Frame:
    """One frame while it is told."""

    def __init__(self, engine: Online, letter: Mapping[str, bool]) -> None:
        self._engine = engine
        self._letter = letter
        self._known: dict[tuple[Formula, int], _Term] = {}
        self._resolved: dict[_Term, _Term] = {}
        self._present: dict[Formula, _Term] = {}
        for part, past in engine.past.items():
            self._present[part] = self._of_past(part, past)

    def now(self, formula: Formula, since: int | None = None) -> _Term:
        """A formula at this frame; ``since``: from where the bound of an *until* counts, if not from here."""
        engine, terms = self._engine, self._engine.terms
        counted = isinstance(formula, Until) and formula.bound.frames
        start = since if since is not None else engine.number if counted else engine.time
        key = (formula, start)
        if key not in self._known:
            self._known[key] = self._now(formula, start, terms)
        return self._known[key]

    def _now(self, formula: Formula, start: int, terms: _Terms) -> _Term:  # noqa: PLR0911 - a case each
        match formula:
            case Constant(value=value):
                return terms.constant(value)
            case Proposition(name=name):
                return terms.constant(bool(self._letter[name]))
            case Not(operand=operand):
                return terms.negated(self.now(operand))
            case And(operands=operands):
                return terms.joined("and", [self.now(operand) for operand in operands])
            case Or(operands=operands):
                return terms.joined("or", [self.now(operand) for operand in operands])
            case Next(operand=operand, weak=weak):
                return terms.duty(operand, None, weak=weak)
            case Previous() | Since():
                return self._present[formula]
            case Until():
                return self._until(formula, start, terms)

    def _until(self, formula: Until, start: int, terms: _Terms) -> _Term:
        bound = formula.bound
        age = (self._engine.number if bound.frames else self._engine.time) - start
        if bound.high is not None and age > bound.high:
            return terms.false
        timed = bool(bound.low) or bound.high is not None
        later = terms.duty(formula, start if timed else None, weak=False)
        later = terms.joined("and", [self.now(formula.left), later])
        if age < bound.low:
            return later
        return terms.joined("or", [self.now(formula.right), later])

    def resolved(self, term: _Term) -> _Term:
        """A combination of the frame before, with what this frame shows of its duties."""
        if term not in self._resolved:
            self._resolved[term] = self._resolve(term)
        return self._resolved[term]

    def _resolve(self, term: _Term) -> _Term:
        terms = self._engine.terms
        match term.word:
            case "true" | "false":
                return term
            case "duty":
                formula, since, _ = term.operands
                return self.now(formula, since)
            case "not":
                return terms.negated(self.resolved(term.operands[0]))
            case word:
                return terms.joined(word, [self.resolved(operand) for operand in term.operands])

    def _of_past(self, part: Formula, past: _Past) -> _Term:
        terms = self._engine.terms
        before = self.resolved(past.before)
        if isinstance(part, Previous):
            return before
        if not isinstance(part, Since):
            raise TypeError(part)
        left, right = self.now(part.left), self.now(part.right)
        bound = part.bound
        if not bound.low and bound.high is None:
            return terms.joined("or", [right, terms.joined("and", [left, before])])
        return self._bounded(part, past, left, right)

    def _bounded(self, part: Since, past: _Past, left: _Term, right: _Term) -> _Term:
        engine, terms, bound = self._engine, self._engine.terms, part.bound
        for entry in past.entries:
            entry.term = terms.joined("and", [self.resolved(entry.term), left])
        past.entries.append(_Entry(engine.time, engine.number, right))
        kept = deque[_Entry]()
        found: list[_Term] = []
        for entry in past.entries:
            age = engine.number - entry.number if bound.frames else engine.time - entry.time
            if entry.term is not terms.false and (bound.high is None or age <= bound.high):
                kept.append(entry)
                found += [entry.term] if age >= bound.low else []
        past.entries = kept
        return terms.joined("or", found)

    def keep(self) -> None:
        """Leave to the next frame what operators of the past need."""
        for part, past in self._engine.past.items():
            past.before = (
                self.now(part.operand) if isinstance(part, Previous) else self._present[part]
            )
