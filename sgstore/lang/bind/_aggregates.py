"""Aggregates of the query language over all matches of a query, such as ``COUNT``, ``AVG`` or ``collect``.

They are allowed after ``RETURN``. Unknown values are ignored. Without values, ``COUNT`` and ``SUM`` are 0,
as in blocks, ``collect`` is an empty list, and the others are NULL.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.bind._symbols import of_type
from sgstore.lang.catalog import Type
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.lang.bind._symbols import SymbolTable
    from sgstore.lang.syntax import tree as s


PLACE: Final = '":rows".":place"'
"""SQL column that holds the order of the matches. ``collect`` returns its values in this order."""


@dataclass(frozen=True, slots=True)
class AggregateFunction:
    """Definition of an aggregate function such as ``COUNT``: its SQL, and the types of operand and result.

    Attributes
    ----------
    sql : function
        Function from the SQL of the operand (after ``DISTINCT``, if present) and the share to the SQL of the
        aggregate.
    of : frozenset of Type
        Allowed types of the operand.
    gives : Type or None
        Type of the result; ``None`` means the type of the operand.
    share : bool
        True if there is a second argument: a percentage.
    """

    sql: Callable[[str, float], str]
    of: frozenset[Type] = frozenset({Type.number})
    gives: Type | None = Type.number
    share: bool = False


_VALUES: Final = frozenset({Type.number, Type.text, Type.boolean, Type.node})
_ORDERED: Final = frozenset({Type.number, Type.text})


def _called(form: str) -> Callable[[str, float], str]:
    return lambda inner, _: form.format(inner)


def _quantile(inner: str, share: float) -> str:
    return f"quantile_cont({inner}, {share!r})"


def _collected(inner: str, _: float) -> str:
    """Return the SQL of the aggregate ``collect``: the list of all values, or an empty list.

    With ``DISTINCT`` the list is sorted by value.
    """
    value = inner.removeprefix("DISTINCT ")
    order = PLACE if value == inner else value
    return f"coalesce(list({inner} ORDER BY {order}) FILTER (WHERE {value} IS NOT NULL), [])"


AGGREGATES: Final[dict[str, AggregateFunction]] = {
    "count": AggregateFunction(_called("count({0})"), _VALUES),
    "min": AggregateFunction(_called("min({0})"), _ORDERED, None),
    "max": AggregateFunction(_called("max({0})"), _ORDERED, None),
    "avg": AggregateFunction(_called("avg({0})")),
    "sum": AggregateFunction(_called("coalesce(sum({0}), 0)")),
    "stddev": AggregateFunction(_called("stddev_samp({0})")),
    "median": AggregateFunction(lambda inner, _: _quantile(inner, 0.5)),
    "percentile": AggregateFunction(_quantile, share=True),
    "collect": AggregateFunction(_collected, _VALUES, Type.list),
}
"""Aggregate functions of the query language, by name in lower case without underscores."""

EXTREMES: Final = frozenset({"min", "max"})
"""Aggregates whose names are also functions of two or more numbers."""


def is_aggregate(e: s.Call) -> bool:
    """True if a call is an aggregate over all matches, as ``max(x)`` is; ``max(x, y)`` is a plain function."""
    name = normalize_name(e.name)
    return name in AGGREGATES and (name not in EXTREMES or len(e.arguments) == 1)


def aggregate(e: s.Call, names: SymbolTable) -> b.Aggregate:
    """Resolve the names and types in a call of an aggregate such as ``COUNT(x)``; return the expression.

    Raises
    ------
    QueryError
        Invalid arguments.
    """
    name, session = normalize_name(e.name), names.session
    function = AGGREGATES[name]
    wanted = 2 if function.share else 1
    if len(e.arguments) != wanted:
        hint = f"write {e.name}(x.speed, 95) for the 95th percentile" if function.share else None
        reason = f"{e.name}() takes {wanted} argument{'s' * (wanted > 1)}, found {len(e.arguments)}"
        session.refuse(reason, e.span, hint)
    inner = replace(names, aggregates=False, aggregated=True, aliases={})
    if function.of == frozenset({Type.number}):
        operand = inner.number(e.arguments[0])
    else:
        operand = inner.bind(e.arguments[0])
        operand = of_type(operand, Type.number) if name in EXTREMES else operand
        if name in EXTREMES and operand.type not in function.of:
            session.refuse(f"{e.name}() takes numbers or texts", e.arguments[0].span)
        if name == "collect" and operand.type not in function.of:
            session.refuse(f"{e.name}() takes values", e.arguments[0].span)
    share = _share(e.arguments[1], e, names) if function.share else 0.0
    _note_habits(e, operand, share, names)
    return b.Aggregate(name, operand, e.distinct, function.gives or operand.type, share)


def _note_habits(e: s.Call, operand: b.Bound, share: float, names: SymbolTable) -> None:
    """Add a note if a call has a fraction where a percentage is expected, or if it sums angles."""
    written = names.session.text[e.span.start : e.span.end]
    if 0 < share <= 0.01:
        names.session.doubt(
            f"{written} is a percentile of {share * 100:g} %; write {share * 1e4:g}"
        )
    if normalize_name(e.name) in {"avg", "sum", "stddev"} and b.is_angle(operand):
        names.session.doubt(
            f"{written} adds angles, which repeat after 360 degrees; a mean direction is"
            " degrees(atan2(AVG(sin(radians(x))), AVG(cos(radians(x)))))"
        )


def _share(written: s.Expression, e: s.Call, names: SymbolTable) -> float:
    """Return the second argument of an aggregate call as a fraction: 0.95 for 95 percent."""
    found = names.bind(written)
    if not isinstance(found, b.Value) or isinstance(found.value, bool | str | None):
        names.session.refuse(
            f"the second argument of {e.name}() must be a number, equal for all matches",
            written.span,
            f"write {e.name}(x.speed, 95) for the 95th percentile",
        )
    if not (math.isfinite(found.value) and 0 <= found.value <= 100):
        names.session.refuse(f"{e.name}() takes a number from 0 to 100", written.span)
    return found.value / 100


def sql_of(one: b.Aggregate, inner: str) -> str:
    """Return the SQL of an aggregate such as ``AVG(x)``, from the SQL of its operand (``inner``)."""
    if one.operand is not None and one.operand.type is Type.number and one.word in _REAL:
        inner = f"CAST({inner} AS DOUBLE)"
    if one.distinct:
        inner = f"DISTINCT {inner}"
    found = AGGREGATES[one.word].sql(inner, one.share)
    owned = isinstance(one.operand, b.Operation) and one.operand.word == "whose"
    if not owned or one.word != "collect":
        return found
    # Nodes of several traces are distinguished by their owner, but shown as ids.
    return f'list_sort([struct_extract("one", 2) FOR "one" IN {found}])'


_REAL: Final = frozenset({"median", "percentile", "stddev"})
"""Aggregates that interpolate or take roots. They need floating-point operands."""
