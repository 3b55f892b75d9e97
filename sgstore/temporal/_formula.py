"""Temporal formulas over named propositions: the one form that both engines evaluate.

Time is pointwise over frames. A formula is true or false at a frame of a finite trace: ``NEXT`` is false at
the last frame and ``WEAKNEXT`` true, ``PREVIOUS`` is false at the first (LTLf). Bounds of time compare time
stamps, both ends included; bounds in frames compare numbers of frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

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
    found = with_operands(formula, lambda operand: tolerant(operand, by))
    if isinstance(found, Until | Since):
        return replace(found, bound=found.bound.widened(by))
    return found


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


def with_operands(formula: Formula, change: Callable[[Formula], Formula]) -> Formula:
    """A formula with a change made to each of its :func:`operands_of`."""
    match formula:
        case And() | Or():
            return replace(formula, operands=tuple(map(change, formula.operands)))
        case Not() | Next() | Previous():
            return replace(formula, operand=change(formula.operand))
        case Until() | Since():
            return replace(formula, left=change(formula.left), right=change(formula.right))
        case TruthConstant() | Proposition():
            return formula


def looks_ahead(formula: Formula) -> bool:
    """Tell whether a formula depends on later frames."""
    return any(isinstance(part, Next | Until) for part in walk(formula))


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
"""What makes a formula of operands, by word."""


def _next(operand: Formula, _: Bound) -> Formula:
    return Next(operand)


def _weak_next(operand: Formula, _: Bound) -> Formula:
    return Next(operand, weak=True)


def _previous(operand: Formula, _: Bound) -> Formula:
    return Previous(operand)


TEMPORAL: Final[dict[str, Callable[..., Formula]]] = {
    "ALWAYS": always,
    "EVENTUALLY": eventually,
    "HISTORICALLY": historically,
    "ONCE": once,
    "NEXT": _next,
    "WEAKNEXT": _weak_next,
    "PREVIOUS": _previous,
    "UNTIL": Until,
    "SINCE": Since,
    "RELEASE": release,
}
"""What makes a formula of operands and a bound, by word."""


# As text, for ``explain`` -------------------------------------------------------------------------


def formula_text(formula: Formula) -> str:  # noqa: C901, PLR0911 - a case each
    """A formula as one would write it, with the names of its propositions."""
    match formula:
        case TruthConstant(value=value):
            return str(value).upper()
        case Proposition(name=name):
            return name
        case Not(operand=Not(operand=operand)):
            return formula_text(operand)
        case Not(operand=operand):
            return f"NOT {formula_text(operand)}"
        case And(operands=operands):
            return "(" + " AND ".join(map(formula_text, operands)) + ")"
        case Or(operands=operands):
            return "(" + " OR ".join(map(formula_text, operands)) + ")"
        case Next(operand=operand, weak=weak):
            return f"{'WEAK' * weak}NEXT {formula_text(operand)}"
        case Previous(operand=operand):
            return f"PREVIOUS {formula_text(operand)}"
        case Until(left=left, right=right, bound=bound):
            return f"({formula_text(left)} UNTIL{bound_text(bound)} {formula_text(right)})"
        case Since(left=left, right=right, bound=bound):
            return f"({formula_text(left)} SINCE{bound_text(bound)} {formula_text(right)})"


def bound_text(bound: Bound) -> str:
    """A bound; nothing for one that is none."""
    if bound == Bound():
        return ""
    ends = [_length(bound.low, bound), "INF" if bound.high is None else _length(bound.high, bound)]
    return f"[{', '.join(ends)}]"


def _length(amount: int, bound: Bound) -> str:
    return f"{amount}frames" if bound.frames else f"{amount / 1e9:g}s"
