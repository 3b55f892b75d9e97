"""Binder of query results: ``RETURN``, ``ORDER BY``, ``SAMPLE`` and ``TOP``."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.bind._precision import is_stored
from sgstore.lang.bind._temporal import settled
from sgstore.lang.catalog import TRACE_ATTRIBUTES, Type
from sgstore.lang.syntax import tree as s

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from sgstore.errors import TextSpan
    from sgstore.lang.bind._symbols import Session, SymbolTable

_FORMS: Final[dict[str, b.Form]] = {
    "intervals": "intervals",
    "clips": "clips",
    "subgraphs": "subgraphs",
}


def bind_result(returns: s.Returns | None, names: SymbolTable) -> b.Result:
    """Resolve ``RETURN`` and the clauses after it. Without ``RETURN``, return the default result."""
    if returns is None:
        return b.Result()
    inner = replace(names, aggregates=True, over=True)
    item = _special(returns, names.session)
    form = item.form if item is not None else "value"
    result = b.Result(
        form=_FORMS.get(form, "rows"),
        columns=bind_columns(returns.items, inner),
        whole=any(item.form == "all" for item in returns.items),
        framed=form == "frames",
        distinct=returns.distinct,
        skip=returns.skip,
        limit=returns.limit,
        before=item.before if item else 0,
        after=item.after if item else 0,
    )
    if form == "clips" and result.before > 0:
        names.session.doubt(
            f"the clips begin {result.before / 1e9:g} s after the first frame of each match; for time"
            f" before it write CLIPS(-{result.before / 1e9:g}s, …)"
        )
    result = replace(result, having=_having(returns.having, result, inner))
    _check_result(result, returns, names.session)
    if result.aggregated or result.form in {"intervals", "clips"}:
        # Each row is unique already, and DISTINCT must not remove rows that are counted.
        result = replace(result, distinct=False)
    order = tuple(b.SortKey(_key(k.value, result, inner), k.descending) for k in returns.order)
    sample, top = _sampling(returns.sample, result, inner), _top(returns.top, result, inner)
    return replace(result, order=order, sample=sample, top=top)


def _special(returns: s.Returns, session: Session) -> s.Item | None:
    """If a ``RETURN`` clause has ``FRAMES``, ``INTERVALS``, ``SUBGRAPHS`` or ``CLIPS``, return this item."""
    special = [item for item in returns.items if item.form not in {"value", "all"}]
    if len(special) > 1:
        session.refuse("write one of FRAMES, INTERVALS, SUBGRAPHS or CLIPS", special[1].span)
    return special[0] if special else None


def bind_columns(items: Iterable[s.Item], names: SymbolTable) -> tuple[b.ReturnColumn, ...]:
    """Return the columns of a ``RETURN`` clause, with resolved names.

    An aggregate may use the grouping values of the same clause.
    """
    items = [item for item in items if item.form == "value"]
    found = [bind_column(item, names) for item in items]
    keys = _group_keys(found)
    columns: list[b.ReturnColumn] = []
    for item, column in zip(items, found, strict=True):
        assert item.value is not None  # noqa: S101 - the form of the item guarantees it
        value = _of_groups(column.value, keys) if b.is_counted(column.value) else column.value
        _refuse_mixed(value, item.value.span, names.session)
        columns.append(replace(column, value=value))
    return tuple(columns)


def _group_keys(columns: Iterable[b.ReturnColumn]) -> dict[b.Bound, str]:
    plain = (one for one in columns if not b.is_counted(one.value))
    return {one.value: one.name for one in plain if not isinstance(one.value, b.Value)}


def _of_groups(value: b.Bound, keys: Mapping[b.Bound, str]) -> b.Bound:
    """Return an expression in which each grouping value refers to its result column."""
    if value in keys:
        return b.GroupKey(keys[value], value.type)
    if isinstance(value, b.Operation):
        return b.with_operands(value, lambda part: _of_groups(part, keys))
    return value


def bind_column(item: s.Item, names: SymbolTable) -> b.ReturnColumn:
    """Resolve one value of a ``RETURN`` clause. Raise an error for a list that is not an aggregate."""
    assert item.value is not None  # noqa: S101 - the form of the item guarantees it
    value = settled(names.bind(item.value), names.session)
    if value.type is Type.list and not (isinstance(value, b.Aggregate) or b.is_passed_on(value)):
        names.session.refuse("a list cannot be returned", item.span)
    text = names.session.text[item.value.span.start : item.value.span.end]
    return b.ReturnColumn(item.name or " ".join(text.split()), value, is_stored(value))


def _refuse_mixed(value: b.Bound, span: TextSpan, session: Session) -> None:
    """Raise an error if an expression uses an aggregate together with a value of a single match."""
    if b.is_counted(value) and _of_each(value):
        session.refuse(
            "a value of each match cannot be returned with a value of all matches",
            span,
            "return them separately: x.speed, AVG(x.speed)",
        )


def _of_each(value: b.Bound, *, matches: bool = False) -> bool:
    """True if an expression uses a value of single matches outside aggregates such as ``COUNT``.

    ``matches``: values over a match are allowed.
    """
    if isinstance(value, b.Operation):
        return any(_of_each(operand, matches=matches) for operand in value.operands)
    if isinstance(value, b.OverMatch | b.StepTime):
        return not matches
    return not isinstance(value, b.Aggregate | b.GroupKey | b.Value | b.Choices)


def _having(written: s.Expression | None, result: b.Result, names: SymbolTable) -> b.Bound | None:
    """Return the ``HAVING`` condition with resolved names; None without ``HAVING``."""
    if written is None:
        return None
    session = names.session
    listed = result.form in {"intervals", "clips"}
    own: dict[str, b.Bound] = {column.name: column.value for column in result.columns}
    ends = result.names if listed else ()
    for name in ends:
        own[name] = b.GroupKey(name, Type.text if name == "trace" else Type.number)
    found = settled(replace(names, aliases=own).condition(written), session)
    of_match = any(isinstance(part, b.OverMatch | b.StepTime) for part in b.walk(found))
    found = _of_groups(found, _group_keys(result.columns))
    if listed:
        if b.is_counted(found) or _of_each(found, matches=True):
            session.refuse(
                f"after HAVING, {result.form} have only their ends as values",
                written.span,
                f"name one of: {', '.join(ends)}; write conditions on matches after WHERE",
            )
        return found
    grouped = b.is_counted(found) or result.aggregated
    if not grouped and not of_match:
        session.refuse(
            "HAVING chooses among groups of matches, but this query has no aggregate",
            written.span,
            "write conditions on matches after WHERE, before RETURN",
        )
    if _of_each(found, matches=not grouped):
        session.refuse(
            "HAVING can use only aggregates and returned values",
            written.span,
            "write conditions on matches after WHERE, before RETURN",
        )
    return found


def _key(value: s.Expression, result: b.Result, names: SymbolTable) -> b.Bound | str:
    """Return the key for sorting or sampling: a result column's name, or a resolved expression."""
    own = {column.name: column.value for column in result.columns}
    known = (*result.names, *own)
    taken = isinstance(value, s.Variable) and names.meaning(value.name) is not None
    if isinstance(value, s.Variable) and (value.name in own or (value.name in known and not taken)):
        return value.name
    if isinstance(value, s.Variable) and value.name not in {*names.visible(), *known}:
        names.session.unknown("variable", value.name, value.span, {*names.visible(), *known})
    found = settled(replace(names, aliases=own).bind(value), names.session)
    if result.aggregated and b.is_counted(found):
        found = _of_groups(found, _group_keys(result.columns))
    _refuse_mixed(found, value.span, names.session)
    if found.type is Type.list:
        names.session.refuse("a list cannot define an order", value.span)
    if isinstance(found, b.Value):
        hint = f"name a value, or one of: {', '.join(known)}"
        names.session.refuse("a constant cannot define an order", value.span, hint)
    same = next((column.name for column in result.columns if column.value == found), None)
    if result.form in {"intervals", "clips"} and found == _TRACE_NAME:
        same = "trace"
    if same is not None:
        return same
    counted = b.is_counted(found)
    one_each = not (result.distinct or result.framed or result.aggregated)
    listed = result.form in {"rows", "subgraphs"}
    if not listed or not (result.aggregated if counted else one_each):
        names.session.refuse(
            "these results can be ordered or sampled only by a returned value",
            value.span,
            f"name one of: {', '.join(known)}",
        )
    return found


def _sampling(sample: s.Sample | None, result: b.Result, names: SymbolTable) -> b.Sampling | None:
    if sample is None:
        return None
    if result.groups:
        reason = "SAMPLE chooses among matches, but this query does not list them"
        names.session.refuse(reason, sample.span, "write LIMIT n for the first rows")
    return b.Sampling(sample.number, sample.per and _key(sample.per, result, names))


_TRACE_NAME: Final = b.TraceAttribute(TRACE_ATTRIBUTES["name"], Type.text)


def _top(top: s.Sample | None, result: b.Result, names: SymbolTable) -> b.Sampling | None:
    """Return the resolved ``LIMIT n PER value`` (keep the first n rows of each value); None without it."""
    if top is None or top.per is None:
        return None
    per = _key(top.per, result, names)
    rows = result.form == "rows" and not (result.whole or result.framed)
    if not isinstance(per, str) and rows and (result.aggregated or result.distinct):
        names.session.refuse(
            "with DISTINCT or an aggregate, LIMIT n PER needs a returned value",
            top.per.span,
            f"name one of: {', '.join(column.name for column in result.columns)}",
        )
    return b.Sampling(top.number, per)


def _check_result(result: b.Result, returns: s.Returns, session: Session) -> None:
    names = [*result.names, *(column.name for column in result.columns)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        session.refuse(f"two results have the name '{twice}'", returns.span, "name them with AS")
    listed = result.form != "rows" or result.whole or result.framed
    if result.aggregated and listed:
        hint = "write COUNT {(a)-[:near]->(b)} AS n for a number in each row"
        if result.form in {"intervals", "clips"}:
            hint = "frames is the number of frames of each; write MIN(…) OVER match for a value over each"
        session.refuse("matches are either counted or listed, not both", returns.span, hint)
