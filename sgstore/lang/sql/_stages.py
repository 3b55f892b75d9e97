"""SQL of queries with several clauses: ``OPTIONAL MATCH``, ``WITH``, and later ``MATCH`` clauses.

Each stage converts the relation of the previous stage: one row for each frame and match, with the bound nodes
and edges, and the values passed by ``WITH``. The results are computed from the last relation as from known
matches (:attr:`SqlBuilder.found`). A node that is NULL has no rows in any table, so all its values are NULL.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from sgstore.base.quoting import quoted
from sgstore.lang.bind import PLACE
from sgstore.lang.ir import (
    Bound,
    GroupKey,
    MatchStage,
    PathWay,
    Query,
    Result,
    ReturnColumn,
    Scope,
    WithStage,
    is_counted,
    is_passed_on,
    walk,
)
from sgstore.lang.sql._expressions import Leaf, column_of, columns_of, expression_text, leaves
from sgstore.lang.sql._frames import frames
from sgstore.lang.sql._masks import SqlBuilder, folded
from sgstore.lang.sql._plan import SharedRelation
from sgstore.lang.sql._results import directed, in_order
from sgstore.lang.sql._rewrite import FALSE
from sgstore.lang.sql._select import Select, nested

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.sql._windows import Window


def staged_matches(query: Query, catalog: Catalog, window: Window | None) -> SqlBuilder:
    """Return an SQL builder for a query with several clauses. One shared subquery has all matches.

    Parameters
    ----------
    query : Query
        Rewritten query.
    catalog : Catalog
    window : Window or None
    """
    sql = SqlBuilder(query, catalog, window)
    rows: SharedRelation | None = None
    for stage in query.stages:
        if isinstance(stage, WithStage):
            assert rows is not None  # noqa: S101 - a query begins with a pattern
            rows = _passed(sql, query, rows, stage)
        else:
            rows = _first(sql, query, stage) if rows is None else _joined(sql, query, rows, stage)
    sql.query, sql.found = query, rows
    return sql


def _first(sql: SqlBuilder, query: Query, stage: MatchStage) -> SharedRelation:
    nodes, edges = _bound(stage.scope)
    late, wanted = _late(stage)
    text = _pattern(sql, query, stage, None, wanted)
    paths = {path.place: column_of(path.place) for path in stage.paths}
    if late:
        keep = ['"frame_id"', *columns_of(nodes, edges), *map(quoted, paths.values())]
        leaf = _leaf_of({})
        tests = [expression_text(one, leaf, sql.values) for one in late]
        text = Select(keep, [nested(text, ":rows")], tests).text()
    return SharedRelation(sql.share(text, "match"), nodes, edges, paths)


def _late(stage: MatchStage) -> tuple[list[Bound], list[Leaf]]:
    """Return the conditions of a ``MATCH`` on values or paths from ``WITH``, and other values in them."""
    late = [one for one in stage.scope.where if _speaks_of_passed(one)]
    wanted = [leaf for one in late for leaf in leaves(one) if not is_passed_on(leaf)]
    return late, list(dict.fromkeys(wanted))


def _pattern(
    sql: SqlBuilder,
    query: Query,
    stage: MatchStage,
    rows: SharedRelation | None,
    wanted: list[Leaf],
) -> str:
    """Return SQL for the matches of one ``MATCH`` clause, with the wanted values, and paths as lists."""
    nodes, edges = _bound(stage.scope)
    outer = frozenset(stage.scope.outer)
    texts: list[str] = []
    given: SharedRelation | None = None
    for way in [one for one in stage.ways if one.scope.where != (FALSE,)] or stage.ways[:1]:
        where = tuple(one for one in way.scope.where if not _speaks_of_passed(one))
        scope = replace(way.scope, where=where)
        # Conditions of blocks in a later pattern are searched in the query. The pattern is not the outermost
        # scope.
        asked = scope if rows is None else replace(scope)
        told = Result(columns=tuple(ReturnColumn(column_of(leaf), leaf) for leaf in wanted))
        sql.query, sql.found = replace(query, scope=asked, result=told, stages=()), None
        if rows is not None and outer and given is None:
            given = _given(sql, rows, outer)
        stops = frozenset(key for keys in way.nodes for key in keys)
        text = frames(sql, scope, given, nodes | outer | stops, edges, wanted)
        if stage.paths:
            text = _with_paths(text, stage, way, columns_of(nodes | outer, edges), wanted)
        texts.append(text)
    return "\nUNION ALL\n".join(texts)


def _with_paths(
    text: str, stage: MatchStage, way: PathWay, columns: list[str], wanted: list[Leaf]
) -> str:
    names = dict.fromkeys(['"frame_id"', *columns, *(quoted(column_of(leaf)) for leaf in wanted)])
    select = Select(list(names), [nested(text, ":way")])
    for path, keys in zip(stage.paths, way.nodes, strict=True):
        ids = ", ".join(quoted(f"{key}.id") for key in keys)
        select.columns.append(f"[{ids}] AS {quoted(column_of(path.place))}")
    return select.text()


def _joined(
    sql: SqlBuilder, query: Query, rows: SharedRelation, stage: MatchStage
) -> SharedRelation:
    """Join the matches of a later ``MATCH`` clause to the matches of the earlier clauses."""
    outer = frozenset(stage.scope.outer)
    nodes, edges = _bound(stage.scope)
    late, wanted = _late(stage)
    text = _pattern(sql, query, stage, rows, wanted)
    paths = {path.place: column_of(path.place) for path in stage.paths}
    more = quoted(":more")
    select = Select(['":rows".*'])
    own = [*columns_of(nodes, edges), *map(quoted, paths.values())]
    select.columns += [f"{more}.{column}" for column in own]
    select.join(f'{quoted(rows.name)} AS ":rows"', [])
    on = [f'{more}.{column} = ":rows".{column}' for column in ('"frame_id"', *columns_of(outer))]
    on += [
        f'{more}.{quoted(f"{key}.id")} IS DISTINCT FROM ":rows".{quoted(f"{other}.id")}'
        for key, other in stage.apart
        if key in nodes and other in rows.nodes
    ]

    def leaf(found: Leaf) -> str:
        table = '":rows"' if is_passed_on(found) and found not in paths else more
        return f"{table}.{quoted(column_of(found))}"

    on += [expression_text(one, leaf, sql.values) for one in late]
    select.join(nested(text, ":more"), on, "LEFT JOIN" if stage.optional else "JOIN")
    name = sql.share(select.text(), "optional" if stage.optional else "match")
    return SharedRelation(name, rows.nodes | nodes, rows.edges | edges, {**rows.told, **paths})


def _bound(scope: Scope) -> tuple[frozenset[str], frozenset[str]]:
    """Return the keys of nodes and edges that identify a match: two matches differ if one of these differs."""
    nodes = frozenset(key for key, node in scope.nodes.items() if node.role != "hidden")
    return nodes, frozenset(edge.key for edge in scope.edges if edge.named)


def _given(sql: SqlBuilder, rows: SharedRelation, outer: frozenset[str]) -> SharedRelation:
    """Return a subquery with the nodes that ``{…}`` uses from outside, and their frames as bit masks.

    Rows with NULL are excluded.
    """
    keys = columns_of(outer)
    known = [f"{key} IS NOT NULL" for key in keys]
    each = Select(['"frame_id"', *keys], [quoted(rows.name)], known, distinct=True)
    return SharedRelation(sql.share(folded(each.text(), keys), "outside"), outer, frozenset())


def _speaks_of_passed(condition: Bound) -> bool:
    return any(is_passed_on(part) for part in walk(condition))


def _passed(
    sql: SqlBuilder, query: Query, rows: SharedRelation, stage: WithStage
) -> SharedRelation:
    """Return a subquery with the rows that a ``WITH`` clause passes to the next clause."""
    values = [column.value for column in stage.values]
    collected = any(in_order(part) for value in values for part in walk(value))
    text = _of_rows(sql, query, rows, stage.before, values)
    if collected:
        order = ", ".join(['"frame_id"', *columns_of(rows.nodes, rows.edges), *_told(rows)])
        place = PLACE.rpartition(".")[2]
        placed = Select(["*", f"row_number() OVER (ORDER BY {order}) AS {place}"])
        placed.join(nested(text, ":matches"), [])
        text = placed.text()
    select = Select(['":rows"."frame_id"'], [nested(text, ":rows")])
    nodes, edges = dict(stage.nodes), {edge.key: key for edge, key in stage.edges}
    kept = stage.grouped
    if not kept:
        nodes = {key: key for key in sorted(rows.nodes)} | nodes
        edges = {key: key for key in sorted(rows.edges)} | edges
    ids = {f"{new}.id": f"{key}.id" for new, key in nodes.items()}
    ids |= {f"{new}.type": f"{key}.type" for new, key in edges.items()}
    select.columns += [f'":rows".{quoted(key)} AS {quoted(new)}' for new, key in ids.items()]
    texts: dict[str, str] = {}
    groups = list(range(1, len(select.columns) + 1))
    columns = zip(stage.values, stage.places, strict=True)
    # A grouping value comes before the aggregates, and has the same SQL text there.
    for column, place in sorted(columns, key=lambda one: is_counted(one[0].value)):
        texts[column.name] = expression_text(column.value, _leaf_of(texts), sql.values)
        select.columns.append(f"{texts[column.name]} AS {quoted(column_of(place))}")
        if not is_counted(column.value):
            groups.append(len(select.columns))
    if any(map(is_counted, values)):
        select.group = [str(group) for group in groups]
    else:
        select.distinct = kept
    told = {place: column_of(place) for place in stage.places}
    if not kept:
        select.columns += [f'":rows".{column}' for column in _told(rows)]
        told = {**rows.told, **told}
    found = SharedRelation(
        sql.share(select.text(), "with"), frozenset(nodes), frozenset(edges), told
    )
    return _chosen(sql, query, found, stage)


def _told(rows: SharedRelation) -> list[str]:
    return [quoted(column) for column in rows.told.values()]


def _of_rows(
    sql: SqlBuilder, query: Query, rows: SharedRelation, scope: Scope, values: Iterable[Bound]
) -> str:
    """Return SQL for the rows of the earlier clauses, with columns for more values."""
    asked = replace(query, scope=scope, result=Result(), stages=())
    sql.query, sql.found = asked, rows
    wanted: list[Leaf] = [leaf for value in values for leaf in leaves(value)]
    return frames(sql, scope, None, rows.nodes, rows.edges, [*wanted, *rows.told])


def _leaf_of(texts: dict[str, str]) -> Callable[[Leaf], str]:
    def leaf(found: Leaf) -> str:
        if isinstance(found, GroupKey):
            return texts[found.name]
        return f'":rows".{quoted(column_of(found))}'

    return leaf


def _chosen(
    sql: SqlBuilder, query: Query, rows: SharedRelation, stage: WithStage
) -> SharedRelation:
    """Return a subquery with the rows that ``LIMIT`` and ``WHERE`` of a ``WITH`` clause keep."""
    columns = ['"frame_id"', *columns_of(rows.nodes, rows.edges), *_told(rows)]
    if stage.skip or stage.limit is not None:
        keys = [
            (key.value, key.descending) for key in stage.order if not isinstance(key.value, str)
        ]
        text = _of_rows(sql, query, rows, stage.after, [key for key, _ in keys])
        leaf = _leaf_of({})
        order = [directed(expression_text(k, leaf, sql.values), down) for k, down in keys]
        order += [f'":rows".{column}' for column in columns[1:]]
        by = f"ORDER BY {', '.join(order)}" if order else ""
        rank = f'row_number() OVER (PARTITION BY ":rows"."frame_id" {by}) AS ":rank"'
        ranked = Select([*(f'":rows".{column}' for column in columns), rank])
        ranked.join(nested(text, ":rows"), [])
        first = Select(
            list(columns), [nested(ranked.text(), ":ranked")], [f'":rank" > {stage.skip}']
        )
        if stage.limit is not None:
            first.where.append(f'":rank" <= {stage.skip + stage.limit}')
        rows = replace(rows, name=sql.share(first.text(), "chosen"))
    if stage.where:
        text = _of_rows(sql, query, rows, stage.after, stage.where)
        select = Select([f'":rows".{column}' for column in columns], [nested(text, ":rows")])
        leaf = _leaf_of({})
        select.where = [expression_text(one, leaf, sql.values) for one in stage.where]
        rows = replace(rows, name=sql.share(select.text(), "chosen"))
    return rows
