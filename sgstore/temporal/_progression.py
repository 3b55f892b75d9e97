"""Formula progression: after each frame, compute the formula that the later frames must satisfy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

from sgstore.temporal._formula import (
    And,
    Bound,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    TruthConstant,
    Until,
    looks_ahead,
    propositions,
    walk,
    with_operands,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

# At each frame a formula becomes a combination by *and*, *or* and *not* of **duties**: formulas that the next
# frame must show (or need not, where there is none). What is already known vanishes in it. Equal combinations
# are one object, so duties that come back are recognised, and a formula without bounds meets few of them:
# they are the states of an automaton that is built as it is walked.
#
# Operators of the past keep the combination that stood for them one frame before, for the present may depend
# on the future of the past (``ONCE NEXT p``). Nothing here is changed in place: a state can be kept, compared,
# and gone on from more than once.


class Term:
    """Obligations of a temporal formula (conditions on later frames): a single one, or an ``and`` or ``or``.

    Equal terms are one object.

    Attributes
    ----------
    word : str
        ``true``, ``false``, ``duty``, ``not``, ``and``, ``or``.
    operands : tuple
        Operand terms. For a duty: the formula, the start of its bound (``None``: not begun), and its value if
        no frame follows.
    timed : bool
        True if a duty in the term has a begun bound.
    sense : int
        Implication between terms of the same :attr:`shape`: earlier bounds imply later ones (1), later imply
        earlier (-1), or no implication (0).
    shape : object
        Structure of the term without the starts of its bounds.
    begins : tuple of int
        Starts of the bounds.
    """

    __slots__ = ("__weakref__", "begins", "operands", "sense", "shape", "timed", "word")

    def __init__(self, word: str, operands: tuple[Any, ...]) -> None:
        self.word = word
        self.operands = operands
        self.sense, self.shape, self.begins = 0, None, tuple[int, ...]()
        if word == "duty":
            formula, since, _ = operands
            self.timed: bool = since is not None
            # The tighter bound implies the other; both apply if they begin here.
            if since is not None and not formula.bound.low:
                self.sense, self.shape, self.begins = 1, id(formula), (since,)
            return
        self.timed = any(operand.timed for operand in operands)
        if self.timed:
            self._liken(operands)

    def _liken(self, operands: tuple[Term, ...]) -> None:
        senses = {operand.sense for operand in operands if operand.timed}
        if len(senses) == 1 and 0 not in senses:
            (sense,) = senses
            self.sense = -sense if self.word == "not" else sense
            self.shape = self.word, *(o.shape if o.timed else id(o) for o in operands)
            self.begins = tuple(since for operand in operands for since in operand.begins)

    def bounds(self) -> Iterator[tuple[Bound, int]]:
        """Yield each time bound in these obligations that has begun, with its start as time or frame number."""
        if self.word == "duty":
            if self.timed:
                yield self.operands[0].bound, self.operands[1]
        elif self.timed:
            for operand in self.operands:
                yield from operand.bounds()

    def implies(self, other: Term) -> bool:
        """True if these obligations imply ``other``, which differs only in the start times of its bounds."""
        pairs = zip(self.begins, other.begins, strict=True)
        return all((a <= b) if self.sense > 0 else (a >= b) for a, b in pairs)

    @property
    def ended(self) -> bool:
        """Truth value of these obligations (conditions on later frames) if the trace ends now."""
        match self.word:
            case "true" | "false":
                return self.word == "true"
            case "duty":
                return self.operands[2]
            case "not":
                return not self.operands[0].ended
            case "and":
                return all(operand.ended for operand in self.operands)
            case _:
                return any(operand.ended for operand in self.operands)


def may_end(term: Term, tick: Tick, *, due: bool = True) -> bool:
    """True if no obligation (condition on later frames) fails because the trace ends.

    A forward operator is open if its bound is not over, and so is ``NEXT``. An operator without an upper bound
    has failed.

    Parameters
    ----------
    term : Term
    tick : Tick
        The last frame.
    due : bool
        Truth value of an open operator: false under an odd number of negations.
    """
    match term.word:
        case "duty":
            return due if _is_open(term, tick) else term.ended
        case "not":
            return not may_end(term.operands[0], tick, due=not due)
        case "and":
            return all(may_end(operand, tick, due=due) for operand in term.operands)
        case "or":
            return any(may_end(operand, tick, due=due) for operand in term.operands)
        case _:
            return term.ended


def _is_open(duty: Term, tick: Tick) -> bool:
    formula, since, _ = duty.operands
    if not isinstance(formula, Until):
        return True
    if formula.bound.high is None or since is None:
        return formula.bound.high is not None
    frames = formula.bound.frames
    age = (tick.number if frames else tick.time) - since
    return age < formula.bound.high - (0 if frames else tick.tolerance)


class Terms:
    """Table of all obligations (conditions on later frames). Each different one is stored once."""

    def __init__(self) -> None:
        self._known: WeakValueDictionary[tuple[Any, ...], Term] = WeakValueDictionary()
        self.true = self._made("true", ())
        self.false = self._made("false", ())

    def __len__(self) -> int:
        return len(self._known)

    def _made(self, word: str, operands: tuple[Any, ...], key: tuple[Any, ...] = ()) -> Term:
        term = self._known.get((word, key))
        if term is None:
            term = Term(word, operands)
            self._known[word, key] = term
        return term

    def constant(self, value: bool) -> Term:  # noqa: FBT001 - it is the value
        """Return the obligation (condition on later frames) that is always true, or the always false one."""
        return self.true if value else self.false

    def duty(self, formula: Formula, since: int | None, *, weak: bool) -> Term:
        """Return the obligation "the formula is true from the next frame on".

        ``since`` is the start of its time bound, if begun.

        Formulas compare by identity, so equal parts must be one object.
        """
        return self._made("duty", (formula, since, weak), (id(formula), since, weak))

    def negated(self, term: Term) -> Term:
        """Return the negation of obligations (conditions on later frames)."""
        if term is self.true or term is self.false:
            return self.constant(term is self.false)
        if term.word == "not":
            return term.operands[0]
        return self._made("not", (term,), (id(term),))

    def joined(self, word: str, terms: Iterable[Term]) -> Term:
        """Join obligations (conditions on later frames) by ``and`` or ``or``, and drop redundant ones.

        A term and its negation are not simplified; later frames decide them. The offline verdicts
        (:mod:`sgstore.temporal._verdicts`) do the same, and both must agree.
        """
        neutral, absorbing = (self.true, self.false) if word == "and" else (self.false, self.true)
        parts: dict[int, Term] = {}
        timed = 0
        for term in terms:
            for part in term.operands if term.word == word else (term,):
                if part is absorbing:
                    return absorbing
                if part is not neutral:
                    parts[id(part)] = part
                    timed += part.timed
        if timed > 1:
            parts = {id(part): part for part in least(parts.values(), word)}
        if len(parts) < 2:
            return next(iter(parts.values()), neutral)
        return self._made(word, tuple(parts.values()), tuple(sorted(parts)))


def least(terms: Iterable[Term], word: str = "and") -> list[Term]:
    """Return the obligations of an ``and`` or ``or`` without those that another one makes redundant.

    So a repeated obligation of an ``ALWAYS`` is stored once.
    """
    kept: list[Term] = []
    best: dict[Any, Term] = {}
    for term in terms:
        if not term.sense:
            kept.append(term)
            continue
        other = best.get(term.shape)
        if other is not None:
            strong, weak = (term, other) if term.implies(other) else (other, term)
            if not strong.implies(weak):
                kept.append(other)
            else:
                term = strong if word == "and" else weak  # noqa: PLW2901 - the better of the two
        best[term.shape] = term
    return kept + list(best.values())


Entry = tuple[int, int, Term]
"""Past frame (time, number) in which the right side of a bounded *since* can be true, with its open term."""

Past = tuple[tuple[Term, tuple[Entry, ...]], ...]
"""Memory of the past operators between two frames: a term and the entries of each operator."""


class Progression:
    """Temporal formula, prepared for evaluation frame by frame.

    Parameters
    ----------
    formula : Formula

    Attributes
    ----------
    formula : Formula
        Formula in which equal parts are one object.
    names : tuple of str
        Propositions in alphabetical order.
    terms : Terms
    past : tuple of Formula
        Past operators, parts first.
    begun : Past
        Memory of the past operators before the first frame.
    """

    def __init__(self, formula: Formula) -> None:
        self.formula = interned(formula)
        self.names = tuple(sorted(propositions(formula)))
        self.terms = Terms()
        parts = {id(part): part for part in walk(self.formula)}
        self.past = tuple(p for p in parts.values() if isinstance(p, Previous | Since))
        self.looking = frozenset(id(p) for p in parts.values() if looks_ahead(p))
        self.begun: Past = tuple((self.terms.false, ()) for _ in self.past)

    @property
    def untimed(self) -> bool:
        """True if the temporal formula has no time bounds, so that it does not depend on frame times."""
        return not any(
            isinstance(p, Until | Since) and (p.bound.low or p.bound.high is not None)
            for p in walk(self.formula)
        )


def interned(formula: Formula, known: dict[Formula, Formula] | None = None) -> Formula:
    """Return a copy of a temporal formula in which equal subformulas are one object."""
    known = {} if known is None else known
    if formula not in known:
        known[formula] = with_operands(formula, lambda part: interned(part, known))
    return known[formula]


@dataclass(frozen=True, slots=True)
class Tick:
    """Time and number of the current frame in an online evaluation.

    Attributes
    ----------
    time : int
        ns.
    number : int
        From 0.
    tolerance : int
        Time tolerance for equality; ns.
    """

    time: int
    number: int
    tolerance: int = 0

    def begun(self, bound: Bound, age: int) -> bool:
        """True if the time (ns or frames) since the start of a time bound has reached its lower end."""
        return age >= bound.low - (0 if bound.frames else self.tolerance)

    def over(self, bound: Bound, age: int) -> bool:
        """True if the time (ns or frames) since the start of a time bound has passed its upper end."""
        if bound.high is None:
            return False
        return age > bound.high + (0 if bound.frames else self.tolerance)


class ProgressionFrame:
    """Evaluation of temporal formulas at one frame of an online run.

    Parameters
    ----------
    progression : Progression
    past : Past
        Memory after the previous frame.
    letter : mapping of str to bool
        Truth values of the propositions.
    tick : Tick
    """

    def __init__(
        self, progression: Progression, past: Past, letter: Mapping[str, bool], tick: Tick
    ) -> None:
        self._terms, self._looking = progression.terms, progression.looking
        self._parts = progression.past
        self._letter, self._tick = letter, tick
        self._known: dict[tuple[int, int], Term] = {}
        self._resolved: dict[Term, Term] = {}
        self._present: dict[int, Term] = {}
        self._entries: list[tuple[Entry, ...]] = []
        for part, (before, entries) in zip(self._parts, past, strict=True):
            self._present[id(part)], kept = self._of_past(part, before, entries)
            self._entries.append(kept)

    def now(self, formula: Formula, since: int | None = None) -> Term:
        """Return the obligations (conditions on later frames) that make a formula true at this frame.

        ``since`` is the start of an *until* bound, by default here.
        """
        if since is None:
            counted = isinstance(formula, Until) and formula.bound.frames
            since = self._tick.number if counted else self._tick.time
        key = id(formula), since
        if key not in self._known:
            self._known[key] = self._now(formula, since, self._terms)
        return self._known[key]

    def _now(self, formula: Formula, start: int, terms: Terms) -> Term:  # noqa: PLR0911 - a case each
        match formula:
            case TruthConstant(value=value):
                return terms.constant(value)
            case Proposition(name=name):
                return terms.constant(bool(self._letter[name]))
            case Not(operand=operand):
                return terms.negated(self.now(operand))
            case And(operands=operands):
                return terms.joined("and", (self.now(operand) for operand in operands))
            case Or(operands=operands):
                return terms.joined("or", (self.now(operand) for operand in operands))
            case Next(operand=operand, weak=weak):
                return terms.duty(operand, None, weak=weak)
            case Previous() | Since():
                return self._present[id(formula)]
            case Until():
                return self._until(formula, start, terms)

    def _until(self, formula: Until, start: int, terms: Terms) -> Term:
        bound = formula.bound
        age = (self._tick.number if bound.frames else self._tick.time) - start
        if self._tick.over(bound, age):
            return terms.false
        right = self.now(formula.right) if self._tick.begun(bound, age) else terms.false
        if right is terms.true:
            return right
        left = self.now(formula.left)
        if left is terms.false:
            return right
        timed = bool(bound.low) or bound.high is not None
        later = terms.duty(formula, start if timed else None, weak=False)
        return terms.joined("or", (right, terms.joined("and", (left, later))))

    def resolved(self, term: Term) -> Term:
        """Return earlier obligations after this frame. Conditions that are decided now become true or false."""
        if term not in self._resolved:
            self._resolved[term] = self._resolve(term)
        return self._resolved[term]

    def _resolve(self, term: Term) -> Term:
        match term.word:
            case "true" | "false":
                return term
            case "duty":
                formula, since, _ = term.operands
                return self.now(formula, since)
            case "not":
                return self._terms.negated(self.resolved(term.operands[0]))
            case word:
                return self._terms.joined(word, (self.resolved(o) for o in term.operands))

    def _of_past(
        self, part: Formula, before: Term, entries: tuple[Entry, ...]
    ) -> tuple[Term, tuple[Entry, ...]]:
        """Return the value of a past operator (*previous* or *since*) at this frame.

        The second result is its memory for the next frame.
        """
        terms, before = self._terms, self.resolved(before)
        if isinstance(part, Previous):
            return before, ()
        assert isinstance(part, Since)  # noqa: S101 - there is no other
        left, right = self.now(part.left), self.now(part.right)
        bound = part.bound
        if not bound.low and bound.high is None:
            return terms.joined("or", [right, terms.joined("and", [left, before])]), ()
        if id(part) not in self._looking:
            return self._known_past(part, entries if left is terms.true else (), right)
        return self._open_past(part, entries, left, right)

    def _known_past(
        self, part: Since, entries: tuple[Entry, ...], right: Term
    ) -> tuple[Term, tuple[Entry, ...]]:
        """Return the value of a *since* with known operands at this frame, and its state for the next frame.

        The memory is the list of frames in which the right operand was true.
        """
        bound = part.bound
        if right is self._terms.true:
            # Without a lower bound, the latest entry suffices.
            here = (self._tick.time, self._tick.number, right)
            entries = (*entries, here) if bound.low else (here,)
        old = 0
        if bound.high is not None:
            while old < len(entries) and self._tick.over(bound, self._age(part, entries[old])):
                old += 1
        entries = entries[old:] if old else entries
        if bound.high is None and len(entries) > 1:
            entries = entries[:1]  # the earliest of these suffices
        holds = bool(entries) and self._tick.begun(bound, self._age(part, entries[0]))
        return self._terms.constant(holds), entries

    def _open_past(
        self,
        part: Since,
        entries: tuple[Entry, ...],
        left: Term,
        right: Term,
    ) -> tuple[Term, tuple[Entry, ...]]:
        terms, bound = self._terms, part.bound
        moved = [
            (time, number, terms.joined("and", [self.resolved(term), left]))
            for time, number, term in entries
        ]
        kept: list[Entry] = []
        found: list[Term] = []
        for entry in [*moved, (self._tick.time, self._tick.number, right)]:
            age = self._age(part, entry)
            if entry[2] is not terms.false and not self._tick.over(bound, age):
                kept.append(entry)
                found += [entry[2]] if self._tick.begun(bound, age) else []
        return terms.joined("or", found), tuple(kept)

    def _age(self, part: Since, entry: Entry) -> int:
        if part.bound.frames:
            return self._tick.number - entry[1]
        return self._tick.time - entry[0]

    def past(self) -> Past:
        """Return the values that the operators *previous* and *since* need at the next frame."""
        return tuple(
            (self.now(p.operand) if isinstance(p, Previous) else self._present[id(p)], entries)
            for p, entries in zip(self._parts, self._entries, strict=True)
        )
