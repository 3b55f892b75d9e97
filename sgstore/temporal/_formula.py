"""Temporal logic formulas over named propositions, for recorded traces and online monitors.

The semantics is pointwise over frames. A formula is true or false at each frame of a finite trace: ``NEXT`` is
false at the last frame and ``WEAKNEXT`` true, ``PREVIOUS`` is false at the first (LTLf). Time bounds compare
timestamps, both ends included; frame bounds compare frame numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@dataclass(frozen=True, slots=True)
class Bound:
    """Time bound of a temporal operator, such as [0 s, 2 s] from the current frame on; or frame numbers.

    Attributes
    ----------
    low, high : int
        Nanoseconds or frames. ``high`` is ``None`` for an unlimited range.
    frames : bool
    """

    low: int = 0
    high: int | None = None
    frames: bool = False

    def widened(self, by: int) -> Bound:
        """Return the time bound, extended at both ends by a tolerance (ns). Bounds in frames stay unchanged."""
        if self.frames or not by:
            return self
        return Bound(max(self.low - by, 0), None if self.high is None else self.high + by)


WHOLE: Final = Bound()
"""Time bound without limits: up to the end, or back to the start, of the trace."""


@dataclass(frozen=True, slots=True)
class TruthConstant:
    """Formula that is always true, or always false."""

    value: bool


@dataclass(frozen=True, slots=True)
class Proposition:
    """Named condition in a formula, true or false in each single frame."""

    name: str


@dataclass(frozen=True, slots=True)
class Not:
    """Negation (``NOT``) of a formula."""

    operand: Formula


@dataclass(frozen=True, slots=True)
class And:
    """Conjunction (``AND``) of formulas."""

    operands: tuple[Formula, ...]


@dataclass(frozen=True, slots=True)
class Or:
    """Disjunction (``OR``) of formulas."""

    operands: tuple[Formula, ...]


@dataclass(frozen=True, slots=True)
class Next:
    """Temporal operator *next*: the operand is true at the next frame.

    At the last frame, the value is ``weak``.
    """

    operand: Formula
    weak: bool = False


@dataclass(frozen=True, slots=True)
class Previous:
    """Temporal operator *previous*: the operand is true at the previous frame.

    At the first frame, it is false.
    """

    operand: Formula


@dataclass(frozen=True, slots=True)
class Until:
    """Temporal operator *until*, on this frame and later ones.

    ``right`` is true at a frame within the future bound. ``left`` is true at all frames before that
    frame.
    """

    left: Formula
    right: Formula
    bound: Bound = WHOLE


@dataclass(frozen=True, slots=True)
class Since:
    """Temporal operator *since*, on this frame and earlier ones.

    ``right`` is true at a frame within the past bound. ``left`` is true at all frames after that
    frame.
    """

    left: Formula
    right: Formula
    bound: Bound = WHOLE


Formula = TruthConstant | Proposition | Not | And | Or | Next | Previous | Until | Since

TRUE: Final = TruthConstant(value=True)


def eventually(operand: Formula, bound: Bound = WHOLE) -> Formula:
    """Return the formula *eventually*: the operand is true at this frame or a later one."""
    return Until(TRUE, operand, bound)


def always(operand: Formula, bound: Bound = WHOLE) -> Formula:
    """Return the formula *always*: the operand is true at this frame and all later ones."""
    return Not(eventually(Not(operand), bound))


def once(operand: Formula, bound: Bound = WHOLE) -> Formula:
    """Return the formula *once*: the operand is true at this frame or an earlier one."""
    return Since(TRUE, operand, bound)


def historically(operand: Formula, bound: Bound = WHOLE) -> Formula:
    """Return the formula *historically*: the operand is true at this frame and all earlier ones."""
    return Not(once(Not(operand), bound))


def release(left: Formula, right: Formula, bound: Bound = WHOLE) -> Formula:
    """Return the formula *release*: ``right`` is true up to and including the first frame of ``left``.

    ``right`` is still true in the frame of ``left``.
    """
    return Not(Until(Not(left), Not(right), bound))


@lru_cache(maxsize=256)
def tolerant(formula: Formula, by: int) -> Formula:
    """Return a temporal formula with all time bounds extended by a tolerance; ns."""
    found = with_operands(formula, lambda operand: tolerant(operand, by))
    if isinstance(found, Until | Since):
        return replace(found, bound=found.bound.widened(by))
    return found


def propositions(formula: Formula) -> frozenset[str]:
    """Return the names of the propositions (single-frame conditions) in a temporal formula."""
    return frozenset(part.name for part in walk(formula) if isinstance(part, Proposition))


def walk(formula: Formula) -> Iterator[Formula]:
    """Yield a temporal formula and all its subformulas, smallest first. Equal ones may repeat."""
    for operand in operands_of(formula):
        yield from walk(operand)
    yield formula


def operands_of(formula: Formula) -> tuple[Formula, ...]:
    """Return the direct operands of a temporal formula."""
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
    """Return a copy of a temporal formula with a function applied to each direct operand."""
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
    """True if a temporal formula depends on later frames."""
    return any(isinstance(part, Next | Until) for part in walk(formula))


def _xor(*operands: Formula) -> Formula:
    first, *rest = operands
    for second in rest:
        first = Or((And((first, Not(second))), And((Not(first), second))))
    return first


def _implies(condition: Formula, consequence: Formula) -> Formula:
    return Or((Not(condition), consequence))


LOGIC: Final[dict[str, Callable[..., Formula]]] = {
    "NOT": Not,
    "AND": lambda *operands: And(operands),
    "OR": lambda *operands: Or(operands),
    "XOR": _xor,
    "IMPLIES": _implies,
}
"""Constructors of logical formulas, by word."""


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
"""Constructors of temporal formulas from operands and bound, by word."""


def formula_text(formula: Formula) -> str:  # noqa: C901, PLR0911 - a case each
    """Return a temporal formula as text, with the names of its propositions."""
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
    """Return the time bound of a temporal operator as text, such as ``[0s, 2s]``.

    An unlimited bound gives an empty text.
    """
    if bound == Bound():
        return ""
    ends = [_length(bound.low, bound), "INF" if bound.high is None else _length(bound.high, bound)]
    return f"[{', '.join(ends)}]"


def _length(amount: int, bound: Bound) -> str:
    return f"{amount}frames" if bound.frames else f"{amount / 1e9:g}s"
