"""Operators and functions of query expressions, each defined as SQL, for one value, and for arrays.

An operand may be unknown. Most operators are *strict*: if an operand is unknown, the value is unknown. So
they are written for known values only. Logic, tests of ``NULL``, ``coalesce`` and ``IN`` have their own
rules.
"""

from __future__ import annotations

import math
import operator
import re
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.json_text import float32

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from sgstore.model.world import Bools

    SqlOf = Callable[[Sequence[str]], str]

MIRRORED: Final = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "=": "=", "<>": "<>"}
"""Comparison signs with the sign for exchanged operands, such as ``<`` → ``>``."""


@dataclass(frozen=True, slots=True)
class Column:
    """Array with the values of an expression, and a mask of the known values.

    Attributes
    ----------
    values : array or scalar
        Array of shape (N,) or (B, F). An axis of length 1, or a scalar, means a constant value. Entries that
        are not known are not valid.
    known : bool or array of bool
        Mask of known values; ``True`` means that all values are known.
    """

    values: Any
    known: Any = True

    @property
    def flags(self) -> Bools:
        """Values of this column as booleans. Where ``known`` is false, the boolean has no meaning."""
        return np.asarray(self.values, np.bool_)

    @property
    def true(self) -> Any:
        """Mask: true where a value is known and true."""
        return self.flags if self.known is True else self.known & self.flags

    @property
    def false(self) -> Any:
        """Mask: true where a value is known and false."""
        flags = np.logical_not(self.flags)
        return flags if self.known is True else self.known & flags


def all_known(columns: Iterable[Column]) -> Any:
    """Return a mask: true where all columns have a known value. ``True`` alone means everywhere."""
    found: Any = True
    for column in columns:
        if column.known is not True:
            found = column.known if found is True else found & column.known
    return found


@dataclass(frozen=True, slots=True)
class Operator:
    """Operator or function of query expressions, defined as SQL, for one value, and for arrays.

    Attributes
    ----------
    sql : function
        Function from the SQL of the operands to the SQL of the operator.
    one : function
        Function that combines operand functions into a function of one binding.
    columns : function
        Function from the columns of the operands to the column of values.
    infix : bool
        True if the operator is written between its operands.
    strict : bool
        True if the value is unknown whenever an operand is unknown.
    """

    sql: SqlOf
    one: Callable[[Sequence[Callable[[Any], Any]]], Callable[[Any], Any]]
    columns: Callable[[Sequence[Column]], Column]
    infix: bool = False
    strict: bool = False


_WHOLE: Final = re.compile(r"""\$\d+|\w+|"[^"]*"(\."[^"]*")*|'[^']*'""")
"""Regular expression of SQL text that needs no brackets: placeholder, word, number, column or string."""

_BRACKETS: Final = re.compile(r"""(?:"[^"]*"|'[^']*'|[^"'()])*([()])""")


def operand_text(text: str) -> str:
    """Return an SQL text that can be an operand: in brackets, unless it is one word or one call."""
    return text if _WHOLE.fullmatch(text) or _is_call(text) else f"({text})"


def _is_call(text: str) -> bool:
    """True if an SQL text is a single call, or is completely in brackets."""
    if not re.match(r"\w*\(", text):
        return False
    depth = 0
    for bracket in _BRACKETS.finditer(text):
        depth += 1 if bracket[1] == "(" else -1
        if depth == 0:
            return bracket.end() == len(text)
    return False


def _sql(form: str | SqlOf) -> SqlOf:
    """Return a function that puts the SQL of operands into a template of an operator's SQL.

    ``abs(...)`` is a call, ``(... AND ...)`` joins all operands, ``{0} = {1}`` has a place for each operand.
    """
    if not isinstance(form, str):
        return form
    if form.endswith("(...)"):
        name = form.removesuffix("(...)")
        return lambda parts: f"{name}({', '.join(parts)})"
    if form.startswith("(... "):
        word = form.removeprefix("(...").removesuffix("...)")
        return lambda parts: f"({word.join(map(operand_text, parts))})"
    return lambda parts: form.format(*map(operand_text, parts))


def _odd(parts: Sequence[str]) -> str:
    """Return the SQL of ``XOR``, which is true if an odd number of operands is true.

    Like ``<>``, it is NULL if an operand is NULL.
    """
    return reduce(lambda left, right: f"({left} <> {right})", map(operand_text, parts))


def _where(part: str, condition: str) -> str:
    """Return the SQL of a value. It becomes NULL if a condition on the value (written ``v``) is false.

    The value is written only once. Otherwise, the text of nested operators would grow exponentially.
    """
    return f"list_filter([{part}], lambda v: {condition})[1]"


def _not_zero(part: str) -> str:
    """Return SQL for a divisor that becomes NULL if it is zero.

    ``nullif`` is faster, but it is a macro that plans its argument twice. So only the innermost of several
    nested divisors uses it.
    """
    return _where(part, "v <> 0") if "nullif(" in part else f"nullif({part}, 0)"


def _division(sign: str) -> SqlOf:
    def text(parts: Sequence[str]) -> str:
        value, by = map(operand_text, parts)
        return f"({value} {sign} {_not_zero(by)})"

    return text


def _if_all_known(name: str) -> SqlOf:
    def text(parts: Sequence[str]) -> str:
        known = " AND ".join(f"{operand_text(part)} IS NOT NULL" for part in parts)
        return f"CASE WHEN {known} THEN {name}({', '.join(parts)}) END"

    return text


def _member(parts: Sequence[str]) -> str:
    value, *items = parts
    return f"{operand_text(value)} IN ({', '.join(items)})" if items else "FALSE"


def _is_listed(value: Any, items: Sequence[Any]) -> bool:
    return value in items


def _edges_between(nodes: Sequence[int]) -> int:
    return len(nodes) - 1


def _no_columns(*_: Any) -> Any:
    raise TypeError("a path is not a column")


def _strict(
    sql: str | SqlOf,
    one: Callable[..., Any],
    columns: Callable[..., Any],
    *,
    infix: bool = False,
    partial: bool = False,
) -> Operator:
    """Return an operator. Its result is unknown if an operand is unknown.

    Without ``partial``, the operator has a value for all known operands. With ``partial``, ``one`` returns
    ``None`` for a missing value, and ``columns`` returns the values and a mask of valid values.
    """

    def of_one(parts: Sequence[Callable[[Any], Any]]) -> Callable[[Any], Any]:
        if len(parts) == 2:
            left, right = parts

            def of_two(at: Any) -> Any:
                a = left(at)
                if a is None:
                    return None
                b = right(at)
                return None if b is None else one(a, b)

            return of_two

        def of_many(at: Any) -> Any:
            values = [part(at) for part in parts]
            return None if None in values else one(*values)

        return of_many

    def of_columns(parts: Sequence[Column]) -> Column:
        return Column(columns(*(part.values for part in parts)), all_known(parts))

    def of_some(parts: Sequence[Column]) -> Column:
        values, fits = columns(*(part.values for part in parts))
        known = all_known(parts)
        return Column(values, fits if known is True else known & fits)

    return Operator(_sql(sql), of_one, of_some if partial else of_columns, infix, strict=True)


def _divided(a: float, by: float) -> float | None:
    return a / by if by else None


def _over_columns(function: Callable[..., Any]) -> Callable[..., tuple[Any, Any]]:
    """Return the division of arrays. A result is unknown where the divisor is 0."""

    def of_columns(a: Any, by: Any) -> tuple[Any, Any]:
        fits = np.not_equal(by, 0)
        return function(a, np.where(fits, by, 1)), fits

    return of_columns


def _remainder(a: float, by: float) -> float | None:
    return math.fmod(a, by) if by else None


def _root(a: float) -> float | None:
    return math.sqrt(a) if a >= 0 else None


def _root_columns(a: Any) -> tuple[Any, Any]:
    fits = np.greater_equal(a, 0)
    return np.sqrt(np.where(fits, a, 0)), fits


def _sign(a: float) -> int:
    return (a > 0) - (a < 0)


def _finite(function: Callable[..., float]) -> Callable[..., float | None]:
    """Return a :mod:`math` function that returns None instead of an error, infinity or NaN."""

    def one(*values: float) -> float | None:
        try:
            found = function(*values)
        except (ValueError, OverflowError):
            return None
        return found if math.isfinite(found) else None

    return one


def _each(one: Callable[..., float | None]) -> Callable[..., Any]:
    """Return a function for arrays that calls a function for numbers once for each value.

    Functions of numpy differ in the last bit from the C library, which Python and the database use.
    """

    def of_columns(*values: Any) -> tuple[Any, Any]:
        told = np.broadcast_arrays(*(np.asarray(value, np.float64) for value in values))
        found = map(one, *(array.ravel().tolist() for array in told))
        numbers = np.array([math.nan if v is None else v for v in found], np.float64)
        numbers = numbers.reshape(told[0].shape)
        return numbers, ~np.isnan(numbers)

    return of_columns


def _computed(sql: str, function: Callable[..., float]) -> Operator:
    """Return an operator for a function of :mod:`math`. Its result is unknown if it is not finite."""
    one = _finite(function)
    return _strict(sql, one, _each(one), partial=True)


def _rounded(a: float) -> float:
    """Return a number rounded to an integer; halves away from zero, as in SQL."""
    return math.copysign(math.floor(abs(a) + 0.5), a)


def _rounded_columns(a: Any) -> Any:
    return np.copysign(np.floor(np.abs(a) + 0.5), a)


def _float32_columns(numbers: Any) -> tuple[Any, Any]:
    rounded = np.asarray(numbers, np.float64).astype(np.float32).astype(np.float64)
    return rounded, np.isfinite(rounded)


def microseconds(seconds: float) -> float:
    """Return a time in seconds, rounded to microseconds; halves away from zero."""
    return _rounded(seconds * 1e6) / 1e6


def _microseconds_columns(seconds: Any) -> Any:
    return _rounded_columns(np.multiply(seconds, 1e6)) / 1e6


def _of_texts(name: str) -> Callable[..., Any]:
    return lambda *values: getattr(np.char, name)(*map(_texts, values))


def _texts(values: Any) -> Any:
    return np.asarray(values).astype(str)


def _contains(text: Any, part: Any) -> Any:
    return np.char.find(_texts(text), _texts(part)) >= 0


def _matches(text: str, pattern: str) -> bool:
    return re.fullmatch(pattern, text) is not None


def _matches_columns(texts: Any, pattern: Any) -> Any:
    wanted, texts = re.compile(str(pattern)), np.asarray(texts).astype(str)
    words, places = np.unique(texts, return_inverse=True)
    flags = np.array([wanted.fullmatch(word) is not None for word in words], np.bool_)
    return flags[places].reshape(texts.shape)


def _ruled(
    sql: str | SqlOf,
    one: Callable[[Iterable[Any]], Any],
    columns: Callable[[Sequence[Column]], Column],
    *,
    infix: bool = False,
) -> Operator:
    """Return an operator, such as ``AND``, with its own rule for unknown operands.

    ``one`` reads the operands lazily.
    """

    def of_one(parts: Sequence[Callable[[Any], Any]]) -> Callable[[Any], Any]:
        return lambda at: one(part(at) for part in parts)

    return Operator(_sql(sql), of_one, columns, infix)


def _and(values: Iterable[Any]) -> bool | None:
    result: bool | None = True
    for value in values:
        if value is False:
            return False
        if value is None:
            result = None
    return result


def _or(values: Iterable[Any]) -> bool | None:
    result: bool | None = False
    for value in values:
        if value is True:
            return True
        if value is None:
            result = None
    return result


def _not(values: Iterable[Any]) -> bool | None:
    (value,) = values
    return None if value is None else not value


def _xor(values: Iterable[Any]) -> bool | None:
    known = list(values)
    return None if None in known else sum(known) % 2 == 1


def _implies(values: Iterable[Any]) -> bool | None:
    condition, consequence = values
    return _or((_not((condition,)), consequence))


def _and_columns(parts: Sequence[Column]) -> Column:
    true = reduce(operator.and_, (part.true for part in parts))
    if all(part.known is True for part in parts):
        return Column(true)
    return Column(true, true | reduce(operator.or_, (part.false for part in parts)))


def _or_columns(parts: Sequence[Column]) -> Column:
    true = reduce(operator.or_, (part.true for part in parts))
    if all(part.known is True for part in parts):
        return Column(true)
    return Column(true, true | reduce(operator.and_, (part.false for part in parts)))


def _not_columns(parts: Sequence[Column]) -> Column:
    return Column(np.logical_not(parts[0].flags), parts[0].known)


def _xor_columns(parts: Sequence[Column]) -> Column:
    return Column(reduce(operator.xor, (part.flags for part in parts)), all_known(parts))


def _implies_columns(parts: Sequence[Column]) -> Column:
    return _or_columns([_not_columns(parts[:1]), parts[1]])


def _first_known(values: Iterable[Any]) -> Any:
    return next((value for value in values if value is not None), None)


def _first_known_columns(parts: Sequence[Column]) -> Column:
    found = parts[-1]
    for part in reversed(parts[:-1]):
        if part.known is True:
            found = part
        else:
            known = True if found.known is True else part.known | found.known
            found = Column(np.where(part.known, part.values, found.values), known)
    return found


def _is_member(parts: Sequence[Callable[[Any], Any]]) -> Callable[[Any], Any]:
    value, choices = parts

    def member(at: Any) -> bool | None:
        items = choices(at)
        if not items:
            return False
        found = value(at)
        return None if found is None else found in items

    return member


def _is_member_columns(parts: Sequence[Column]) -> Column:
    value, items = parts
    if not items.values:
        return Column(np.False_)
    return Column(
        reduce(operator.or_, (value.values == item for item in items.values)), value.known
    )


# ``CASE``: the operands are condition and value of each branch, then the value of ``ELSE``.


def _case(parts: Sequence[str]) -> str:
    *branches, otherwise = parts
    pairs = zip(branches[::2], branches[1::2], strict=True)
    told = " ".join(f"WHEN {condition} THEN {value}" for condition, value in pairs)
    return f"CASE {told} ELSE {otherwise} END"


def _chosen(parts: Sequence[Callable[[Any], Any]]) -> Callable[[Any], Any]:
    *branches, otherwise = parts
    pairs = list(zip(branches[::2], branches[1::2], strict=True))

    def chosen(at: Any) -> Any:
        found = next((value for condition, value in pairs if condition(at) is True), otherwise)
        return found(at)

    return chosen


def _chosen_columns(parts: Sequence[Column]) -> Column:
    *branches, found = parts
    for condition, value in zip(branches[-2::-2], branches[::-2], strict=True):
        true = condition.true
        known = True
        if value.known is not True or found.known is not True:
            known = np.where(true, value.known, found.known)
        # NULL has no type.
        one = found.values if value.known is False else value.values
        other = value.values if found.known is False else found.values
        found = Column(np.where(true, one, other), known)
    return found


def _null_test(word: str, *, null: bool) -> Operator:
    def of_one(parts: Sequence[Callable[[Any], Any]]) -> Callable[[Any], Any]:
        (part,) = parts
        return lambda at: (part(at) is None) == null

    def of_columns(parts: Sequence[Column]) -> Column:
        known = parts[0].known
        return Column(np.logical_not(known) if null else np.asarray(known))

    return Operator(_sql(f"{{0}} {word}"), of_one, of_columns)


_FINITE: Final = "isfinite(CAST(v AS DOUBLE))"

COMPARISONS: Final[Mapping[str, Operator]] = {
    "=": _strict("{0} = {1}", operator.eq, np.equal, infix=True),
    "<>": _strict("{0} <> {1}", operator.ne, np.not_equal, infix=True),
    "<": _strict("{0} < {1}", operator.lt, np.less, infix=True),
    "<=": _strict("{0} <= {1}", operator.le, np.less_equal, infix=True),
    ">": _strict("{0} > {1}", operator.gt, np.greater, infix=True),
    ">=": _strict("{0} >= {1}", operator.ge, np.greater_equal, infix=True),
}
TEXT_TESTS: Final[Mapping[str, Operator]] = {
    "STARTS WITH": _strict("starts_with(...)", str.startswith, _of_texts("startswith"), infix=True),
    "ENDS WITH": _strict("ends_with(...)", str.endswith, _of_texts("endswith"), infix=True),
    "CONTAINS": _strict("contains(...)", operator.contains, _contains, infix=True),
    "=~": _strict("regexp_full_match(...)", _matches, _matches_columns, infix=True),
}
CONNECTIVES: Final[Mapping[str, Operator]] = {
    "AND": _ruled("(... AND ...)", _and, _and_columns, infix=True),
    "OR": _ruled("(... OR ...)", _or, _or_columns, infix=True),
    "NOT": _ruled("NOT {0}", _not, _not_columns),
    "XOR": _ruled(_odd, _xor, _xor_columns, infix=True),
    "IMPLIES": _ruled("(NOT {0} OR {1})", _implies, _implies_columns, infix=True),
}
NUMERIC: Final[Mapping[str, Operator]] = {
    "abs": _strict("abs(...)", abs, np.abs),
    "sqrt": _strict(f"sqrt({_where('{0}', 'v >= 0')})", _root, _root_columns, partial=True),
    "floor": _strict("floor(...)", math.floor, np.floor),
    "ceil": _strict("ceil(...)", math.ceil, np.ceil),
    "round": _strict("round(...)", _rounded, _rounded_columns),
    "sign": _strict("CAST(sign({0}) AS INTEGER)", _sign, np.sign),
    "degrees": _strict("degrees(...)", math.degrees, np.degrees),
    "radians": _strict("radians(...)", math.radians, np.radians),
    "sin": _computed(f"sin({_where('{0}', _FINITE)})", math.sin),
    "cos": _computed(f"cos({_where('{0}', _FINITE)})", math.cos),
    "tan": _computed(f"tan({_where('{0}', _FINITE)})", math.tan),
    "exp": _computed(_where("exp({0})", _FINITE), math.exp),
    "log": _computed(f"ln({_where('{0}', 'v > 0 AND isfinite(v)')})", math.log),
}
"""Functions of one number, by name in the query language."""

EXTREMES: Final[Mapping[str, Operator]] = {
    "min": _strict(_if_all_known("least"), min, lambda *values: reduce(np.minimum, values)),
    "max": _strict(_if_all_known("greatest"), max, lambda *values: reduce(np.maximum, values)),
}
"""Functions of two or more numbers, by name in the query language."""

OF_TWO: Final[Mapping[str, Operator]] = {
    "atan2": _computed("atan2(...)", math.atan2),
    "pow": _computed(_where("pow({0}, {1})", _FINITE), math.pow),
}
"""Functions of exactly two numbers, by name in the query language."""

OF_TEXT: Final[Mapping[str, Operator]] = {
    "lower": _strict("lower(...)", str.lower, _of_texts("lower")),
    "upper": _strict("upper(...)", str.upper, _of_texts("upper")),
}
"""Functions of one text, by name in the query language."""

OPERATORS: Final[Mapping[str, Operator]] = {
    **COMPARISONS,
    **TEXT_TESTS,
    **CONNECTIVES,
    **NUMERIC,
    **EXTREMES,
    **OF_TWO,
    **OF_TEXT,
    "+": _strict("(... + ...)", operator.add, np.add, infix=True),
    "-": _strict("(... - ...)", operator.sub, np.subtract, infix=True),
    "*": _strict("(... * ...)", operator.mul, np.multiply, infix=True),
    "/": _strict(_division("/"), _divided, _over_columns(np.divide), infix=True, partial=True),
    "%": _strict(_division("%"), _remainder, _over_columns(np.fmod), infix=True, partial=True),
    "negative": _strict("(- {0})", operator.neg, np.negative),
    "length": _strict("(len({0}) - 1)", _edges_between, _no_columns),
    "size": _strict("len({0})", len, _no_columns),
    "is in": _strict("list_contains({1}, {0})", _is_listed, _no_columns),
    "float32": _strict(
        "CAST(TRY_CAST({0} AS FLOAT) AS DOUBLE)", float32, _float32_columns, partial=True
    ),
    "microseconds": _strict("(round({0} * 1e6) / 1e6)", microseconds, _microseconds_columns),
    "coalesce": _ruled("coalesce(...)", _first_known, _first_known_columns),
    "case": Operator(_case, _chosen, _chosen_columns),
    "IS NULL": _null_test("IS NULL", null=True),
    "IS NOT NULL": _null_test("IS NOT NULL", null=False),
    "IN": Operator(_member, _is_member, _is_member_columns, infix=True),
}
"""All operators, by the word of an :class:`~sgstore.lang.ir.Operation`. In memory, ``IN`` has two operands: a
value, and one operand with all choices."""

ROUNDINGS: Final[Mapping[str, Callable[[float], float | None]]] = {
    "float32": float32,
    "microseconds": microseconds,
}
"""Operators that round one side of a comparison (see ``_precision``). Queries cannot use them."""

INFIX: Final = frozenset(word for word, one in OPERATORS.items() if one.infix)

COMPILER_SQL: Final = {
    "name": _sql("{0} || ' ' || CAST({1} AS VARCHAR)"),
    "whose": _sql("CASE WHEN {0} IS NOT NULL THEN ({1}, {0}) END"),
}
"""SQL templates of operations that only the compiler creates."""
