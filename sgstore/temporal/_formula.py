"""Temporal formulas over named propositions: the one form that both engines evaluate.

Time is pointwise over frames. A formula is true or false at a frame of a finite trace: ``NEXT`` is false at
the last frame and ``WEAKNEXT`` true, ``PREVIOUS`` is false at the first (LTLf). Bounds of time compare time
stamps, both ends included; bounds in frames compare numbers of frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from sgstore.errors import QueryError
from sgstore.lang import parse
from sgstore.lang import syntax as s

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@dataclass(frozen=True, slots=True)
class Bound:
    """From when to when an operator looks, counted from where it stands, away from it in its direction.

    Attributes
    ----------
    low, high : int
        Nanoseconds, or frames; ``high`` is ``None`` if it looks as far as the trace goes.
    frames : bool
    """

    low: int = 0
    high: int | None = None
    frames: bool = False

    def widened(self, by: int) -> Bound:
        """The same with a tolerance at both ends, if it is one of time; ns."""
        if self.frames or not by:
            return self
        return Bound(max(self.low - by, 0), None if self.high is None else self.high + by)


WHOLE: Final = Bound()
"""From here to the end of the trace, or to its beginning."""


@dataclass(frozen=True, slots=True)
class TruthConstant:
    """True, or false."""

    value: bool


@dataclass(frozen=True, slots=True)
class Proposition:
    """Proposition: true or false at each frame by itself."""

    name: str


@dataclass(frozen=True, slots=True)
class Not:
    """Negation."""

    operand: Formula


@dataclass(frozen=True, slots=True)
class And:
    """Conjunction."""

    operands: tuple[Formula, ...]


@dataclass(frozen=True, slots=True)
class Or:
    """Disjunction."""

    operands: tuple[Formula, ...]


@dataclass(frozen=True, slots=True)
class Next:
    """The operand at the next frame; at the last frame, what ``weak`` says."""

    operand: Formula
    weak: bool = False


@dataclass(frozen=True, slots=True)
class Previous:
    """The operand at the frame before; false at the first."""

    operand: Formula


@dataclass(frozen=True, slots=True)
class Until:
    """``right`` at some frame within the bound, and ``left`` at all frames from here to before it."""

    left: Formula
    right: Formula
    bound: Bound = WHOLE


@dataclass(frozen=True, slots=True)
class Since:
    """``right`` at some frame back within the bound, and ``left`` at all frames after it up to here."""

    left: Formula
    right: Formula
    bound: Bound = WHOLE


Formula = TruthConstant | Proposition | Not | And | Or | Next | Previous | Until | Since

TRUE: Final = TruthConstant(value=True)


def eventually(operand: Formula, bound: Bound = WHOLE) -> Formula:
    """At some frame from here on."""
    return Until(TRUE, operand, bound)


def always(operand: Formula, bound: Bound = WHOLE) -> Formula:
    """At all frames from here on."""
    return Not(eventually(Not(operand), bound))


def once(operand: Formula, bound: Bound = WHOLE) -> Formula:
    """At some frame up to here."""
    return Since(TRUE, operand, bound)


def historically(operand: Formula, bound: Bound = WHOLE) -> Formula:
    """At all frames up to here."""
    return Not(once(Not(operand), bound))


def release(left: Formula, right: Formula, bound: Bound = WHOLE) -> Formula:
    """``right`` until and with ``left``, or for ever."""
    return Not(Until(Not(left), Not(right), bound))


@lru_cache(maxsize=256)
def tolerant(formula: Formula, by: int) -> Formula:
    """A formula whose bounds of time let in what misses them by no more than a tolerance; ns."""
    match formula:
        case TruthConstant() | Proposition():
            return formula
        case Not(operand=operand):
            return Not(tolerant(operand, by))
        case And(operands=operands):
            return And(tuple(tolerant(operand, by) for operand in operands))
        case Or(operands=operands):
            return Or(tuple(tolerant(operand, by) for operand in operands))
        case Next() | Previous():
            return replace(formula, operand=tolerant(formula.operand, by))
        case Until() | Since():
            left, right = tolerant(formula.left, by), tolerant(formula.right, by)
            return replace(formula, left=left, right=right, bound=formula.bound.widened(by))


def propositions(formula: Formula) -> frozenset[str]:
    """Names of the propositions in a formula."""
    return frozenset(part.name for part in walk(formula) if isinstance(part, Proposition))


def walk(formula: Formula) -> Iterator[Formula]:
    """A formula and all its parts, parts first; equal ones as often as they stand there."""
    for operand in operands_of(formula):
        yield from walk(operand)
    yield formula


def operands_of(formula: Formula) -> tuple[Formula, ...]:
    """The parts that an operator joins."""
    match formula:
        case And(operands=operands) | Or(operands=operands):
            return operands
        case Not(operand=operand) | Next(operand=operand) | Previous(operand=operand):
            return (operand,)
        case Until(left=left, right=right) | Since(left=left, right=right):
            return (left, right)
        case TruthConstant() | Proposition():
            return ()


def looks_ahead(formula: Formula) -> bool:
    """Tell whether a formula depends on later frames."""
    return any(isinstance(part, Next | Until) for part in walk(formula))


# From text --------------------------------------------------------------------------------------------------


def formula_of(text: str) -> Formula:
    """The formula that a text of the query language says; its variables are propositions.

    Parameters
    ----------
    text : str
        ``ALWAYS (braking IMPLIES EVENTUALLY[0s, 2s] stopped)``.

    Raises
    ------
    QueryError
        It is no formula, or has something else than propositions, logic and time.
    """
    prefix = "CHECK "
    try:
        (statement,) = parse(prefix + text)
    except QueryError as error:
        raise _shifted(error, text, len(prefix)) from None
    if not isinstance(statement, s.CheckClause):
        raise QueryError("expected a formula", text=text)
    try:
        return _formula(statement.formula)
    except _Refused as refused:
        span = refused.span
        at = type(span)(span.start - len(prefix), span.end - len(prefix))
        raise QueryError(refused.reason, text=text, span=at) from None


class _Refused(Exception):  # noqa: N818 - not an error of its own: it carries a place
    def __init__(self, reason: str, span: s.TextSpan) -> None:
        super().__init__(reason)
        self.reason = reason
        self.span = span


def _shifted(error: QueryError, text: str, by: int) -> QueryError:
    span = error.span
    moved = type(span)(max(span.start - by, 0), max(span.end - by, 0)) if span else None
    return type(error)(error.reason, text=text, span=moved, hint=error.hint)


def _formula(e: s.Expression) -> Formula:
    match e:
        case s.Variable(name=name):
            return Proposition(name)
        case s.Constant(value=bool() as value):
            return TruthConstant(value)
        case s.Logic(word=word, operands=operands):
            return LOGIC[word](*map(_formula, operands))
        case s.Temporal(word=word, operands=operands):
            return _temporal(word, tuple(map(_formula, operands)), e)
        case _:
            raise _Refused("expected propositions, logic and time only", e.span)


def _xor(*operands: Formula) -> Formula:
    first, *rest = operands
    for second in rest:
        first = Or((And((first, Not(second))), And((Not(first), second))))
    return first


def _and(*operands: Formula) -> Formula:
    return And(operands)


def _or(*operands: Formula) -> Formula:
    return Or(operands)


def _implies(condition: Formula, consequence: Formula) -> Formula:
    return Or((Not(condition), consequence))


LOGIC: Final[dict[str, Callable[..., Formula]]] = {
    "NOT": Not,
    "AND": _and,
    "OR": _or,
    "XOR": _xor,
    "IMPLIES": _implies,
}
_BOUNDED: Final[dict[str, Callable[..., Formula]]] = {
    "ALWAYS": always,
    "EVENTUALLY": eventually,
    "HISTORICALLY": historically,
    "ONCE": once,
    "UNTIL": Until,
    "SINCE": Since,
    "RELEASE": release,
}


def _temporal(word: str, operands: tuple[Formula, ...], e: s.Temporal) -> Formula:
    if word in _BOUNDED:
        return _BOUNDED[word](*operands, _bound(e))
    if e.bound is not None:
        raise _Refused(f"{word} has no bound", e.span)
    if word == "PREVIOUS":
        return Previous(*operands)
    return Next(*operands, weak=word == "WEAKNEXT")


def _bound(e: s.Temporal) -> Bound:
    if e.bound is None:
        return WHOLE
    low, high = e.bound
    if isinstance(low, s.Parameter) or isinstance(high, s.Parameter):
        raise _Refused("a formula over given propositions has no parameters", e.span)
    units = {end.unit == "frames" for end in (low, high) if end is not None and end.amount}
    if len(units) > 1:
        raise _Refused("a bound is either in time or in frames", e.span)
    frames = units == {True}
    ends = [None if end is None else int(end.amount) if frames else end.ns for end in (low, high)]
    if ends[1] is not None and ends[1] < (ends[0] or 0):
        raise _Refused("the bound ends before it begins", e.span)
    return Bound(ends[0] or 0, ends[1], frames)
