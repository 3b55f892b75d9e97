"""Measures of object pairs on arrays. numpy evaluates their SQL expressions."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from functools import cache, reduce
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from sgstore.model.pair_numbers._levels import OPTIONAL
from sgstore.model.pair_numbers._table import EXPRESSIONS

if TYPE_CHECKING:
    from numpy.typing import NDArray

Floats: TypeAlias = "NDArray[np.float64]"

Formula = Callable[[Mapping[str, Any]], Any]

COLUMNS: Final = ("x", "y", "z", "heading", "length", "width", "vx", "vy", "ax", "ay")
"""Columns of an entity from which numbers of pairs are computed."""


class PairNumbers(dict[str, "Floats"]):
    """Measures of K object pairs (a, b) by name, (K,) float64. Each is computed on first use.

    Parameters
    ----------
    a, b : (K, 15) float64
        ``x, y, z, heading, length, width, vx, vy, ax, ay`` of the two entities of pair k; m, m, m,
        rad, m, m, m/s, m/s, m/s², m/s²; then heights of the lower and the upper side
        (:func:`low_and_high`), node id, node id of the carrier, and pitch (rad). NaN for a missing
        value. The last columns are optional: without heights (K, 10) all pairs are on one level,
        without accelerations (K, 8) accelerations are unknown.
    """

    def __init__(self, a: Floats, b: Floats) -> None:
        super().__init__()
        for one, states in (("a", a), ("b", b)):
            told = dict(zip((*COLUMNS, *OPTIONAL), states.T, strict=False))
            unknown = np.broadcast_to(np.nan, len(states))
            self.update(
                {f"{one}_{name}": told.get(name, unknown) for name in (*COLUMNS, *OPTIONAL)}
            )

    @classmethod
    def of(cls, a: Mapping[str, Floats], b: Mapping[str, Floats]) -> PairNumbers:
        """Return the measures of object pairs. The columns of both objects are given by name."""
        found = cls.__new__(cls)
        for one, columns in (("a", a), ("b", b)):
            found.update({f"{one}_{name}": values for name, values in columns.items()})
        return found

    def __missing__(self, name: str) -> Floats:
        with np.errstate(all="ignore"):
            found = self[name] = _compiled(name)(self)
        return found


def gap(a: Floats, b: Floats) -> Floats:
    """Return the shortest distance between two boxes for each pair; m. 0 if they touch or overlap.

    Parameters
    ----------
    a, b : (K, 5) float64
        ``x, y, heading, length, width`` of the two boxes of pair k; m, m, rad, m, m. A box without extent
        is a point or a line.

    Returns
    -------
    (K,) float64
        Metres; NaN if a number is missing.
    """
    found = np.empty(len(a))
    for start in range(0, len(a), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        boxes = [np.full((len(box[part]), len(COLUMNS)), np.nan) for box in (a, b)]
        for whole, box in zip(boxes, (a, b), strict=True):
            whole[:, _FOOTPRINT] = box[part]
        found[part] = PairNumbers(*boxes)["gap"]
    return found


_TOGETHER: Final = 1 << 14
"""Number of pairs that are processed at once, so that they fit into the processor cache."""

_FOOTPRINT: Final = [COLUMNS.index(name) for name in ("x", "y", "heading", "length", "width")]

# An expression is parsed as Python, after replacing these words.
_AS_PYTHON: Final = tuple(
    (re.compile(pattern), text)
    for pattern, text in (
        (r"\bCASE WHEN\b", "case("),
        (r"\b(WHEN|THEN|ELSE)\b", ","),
        (r"\bEND\b", ")"),
        (r"\bIS NOT NULL\b", "is not None"),
        (r"\bIS NULL\b", "is None"),
        (r"\bNULL\b", "None"),
        (r"\bAND\b", "and"),
        (r"\bOR\b", "or"),
        (r"(?<![<>])=", "=="),
    )
)


def _case(*parts: Any) -> Any:
    """Evaluate an SQL ``CASE`` on arrays: first value with a true condition, or the last value, or NaN."""
    pairs, found = len(parts) // 2, parts[-1] if len(parts) % 2 else np.nan
    for i in reversed(range(pairs)):
        found = np.where(parts[2 * i], parts[2 * i + 1], found)
    return found


def _coalesced(value: Any, other: Any) -> Any:
    return np.where(np.isnan(value), other, value)


def _null_if(value: Any, other: Any) -> Any:
    return np.where(value == other, np.nan, value)


def _is_null(value: Any, _: Any) -> Any:
    return np.isnan(value)


def _is_known(value: Any, _: Any) -> Any:
    return ~np.isnan(value)


@cache
def _functions() -> Mapping[str, Callable[..., Any]]:
    """Return the numpy functions that replace SQL functions in expressions, by name."""
    return {
        "case": _case,
        **{
            name: getattr(np, name)
            for name in ("abs", "sqrt", "cbrt", "exp", "sign", "sin", "cos", "degrees", "ceil")
        },
        "acos": np.arccos,
        "atan2": np.arctan2,
        # They ignore missing values.
        "greatest": lambda *values: reduce(np.fmax, values),
        "least": lambda *values: reduce(np.fmin, values),
        "coalesce": _coalesced,
        "nullif": _null_if,
    }


@cache
def _operators() -> Mapping[type[ast.AST], Callable[..., Any]]:
    return {
        ast.Add: np.add,
        ast.Sub: np.subtract,
        ast.Mult: np.multiply,
        ast.Div: np.divide,
        ast.USub: np.negative,
        ast.Lt: np.less,
        ast.LtE: np.less_equal,
        ast.Gt: np.greater,
        ast.GtE: np.greater_equal,
        ast.Eq: np.equal,
        ast.Is: _is_null,
        ast.IsNot: _is_known,
        ast.And: np.logical_and,
        ast.Or: np.logical_or,
    }


@cache
def _compiled(name: str) -> Formula:
    """Compile the SQL expression of a measure of object pairs to a numpy function.

    An unknown condition counts as false; this is equivalent, because conditions are never negated.
    """
    text = EXPRESSIONS[name]
    for pattern, python in _AS_PYTHON:
        text = pattern.sub(python, text)
    return _formula(ast.parse(text, mode="eval").body)


def _formula(node: ast.expr) -> Formula:  # noqa: PLR0911 - a case each
    match node:
        case ast.Constant(value=value):
            constant: Any = np.nan if value is None else value
            return lambda _: constant
        case ast.Name(id=name):
            return lambda at: at[name]
        case ast.Call(func=ast.Name(id=word), args=parts):
            return _applied(_functions()[word], parts)
        case ast.UnaryOp(op=op, operand=operand):
            return _applied(_operators()[type(op)], [operand])
        case ast.BinOp(op=op, left=left, right=right):
            return _applied(_operators()[type(op)], [left, right])
        case ast.Compare(ops=[op], left=left, comparators=[right]):
            return _applied(_operators()[type(op)], [left, right])
        case ast.BoolOp(op=op, values=parts):
            combine = _operators()[type(op)]
            return _applied(lambda *values: reduce(combine, values), parts)
        case _:
            raise TypeError(ast.unparse(node))


def _applied(function: Callable[..., Any], operands: list[ast.expr]) -> Formula:
    first, *others = parts = [_formula(operand) for operand in operands]
    if not others:
        return lambda at: function(first(at))
    if len(others) == 1:
        (second,) = others
        return lambda at: function(first(at), second(at))
    return lambda at: function(*(part(at) for part in parts))
