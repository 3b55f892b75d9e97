"""Fast counts of edges for SQL statements of users, computed from bit masks instead of single rows."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any, Final

import duckdb

from sgstore.base.quoting import quoted

if TYPE_CHECKING:
    from collections.abc import Iterator

_MAY_COUNT: Final = re.compile(r"(?is)(?=.*\bcount\s*\()(?=.*\bedges\b)")
_OF_MASKS: Final = {"src", "relation", "dst", "src_kind", "dst_kind", "src_is_ego", "dst_is_ego"}
_TABLE: Final = ":edges"
_COUNT: Final = f'SELECT CAST(coalesce(sum(":frames"), 0) AS BIGINT) FROM {quoted(_TABLE)}'
_PLAIN: Final = {
    "COLUMN_REF",
    "CONSTANT",
    "COMPARISON",
    "CONJUNCTION",
    "OPERATOR",
    "CAST",
    "BETWEEN",
}
"""DuckDB classes of expressions whose value is the same for equal edges."""


def counted_edges(sql: str) -> tuple[str, str] | None:
    """Return two SQL statements: one creates a table of edge counts from bit masks, the other queries it.

    ``None`` means that the SQL statement is not a count of the rows of the view ``edges``, by columns that all
    frames of a mask share.
    """
    if not _MAY_COUNT.match(sql):
        return None
    with duckdb.connect() as connection:
        tree = _tree(connection, sql)
        if tree.get("error") or len(tree["statements"]) != 1:
            return None
        node = tree["statements"][0]["node"]
        columns = _columns(node)
        if columns is None:
            return None
        counted = _tree(connection, _COUNT)["statements"][0]["node"]
        _replace(node, counted["select_list"][0], counted["from_table"])
        (query,) = connection.execute(
            "SELECT json_deserialize_sql(?::JSON)", [json.dumps(tree)]
        ).fetchone() or ("",)
    named = "".join(f"e.{quoted(name)}, " for name in sorted(columns))
    return f"{_CREATE} SELECT {named}{_EDGES}", query


_CREATE: Final = f"CREATE OR REPLACE TEMP TABLE {quoted(_TABLE)} AS"
_EDGES: Final = """sum(bit_count(e.mask & b.valid)) AS ":frames" FROM inside.bucket b JOIN (
  SELECT bucket, mask, src, relation, dst, src_kind, dst_kind, src_is_ego, dst_is_ego FROM inside.edge
  UNION ALL
  SELECT b.bucket, s.mask & d.mask, m.src, m.relation, m.dst, m.src_kind, m.dst_kind, false, false
  FROM inside.bucket b JOIN inside.node s ON s.bucket = b.bucket
    JOIN inside.map_edge m ON m.map_id = b.map_id AND m.src = s.node_id
    JOIN inside.node d ON d.bucket = b.bucket AND d.node_id = m.dst
) e ON e.bucket = b.bucket WHERE (e.mask & b.valid) <> 0 GROUP BY ALL"""
"""SQL for the number of frames of each edge, as the view ``edges`` shows it."""


def _tree(connection: duckdb.DuckDBPyConnection, sql: str) -> dict[str, Any]:
    row = connection.execute("SELECT json_serialize_sql(?::VARCHAR)", [sql]).fetchone()
    return json.loads(row[0]) if row else {"error": True}


def _columns(node: dict[str, Any]) -> set[str] | None:
    """Return the columns of ``edges`` that a statement uses; ``None`` if bit masks cannot answer it."""
    table = node.get("from_table") or {}
    plain = (
        table.get("type") == "BASE_TABLE"
        and _path(table) in (["edges"], ["main", "edges"])
        and not (table["sample"] or table["column_name_alias"] or table["at_clause"])
        and not (node["sample"] or node["qualify"] or node["cte_map"]["map"])
        and all(m["type"] in {"ORDER_MODIFIER", "LIMIT_MODIFIER"} for m in node["modifiers"])
    )
    if not plain:
        return None
    parts = [*_expressions(node)]
    counts = [one for one in parts if _is_count(one)]
    names = {one["column_names"][-1].lower() for one in parts if one["class"] == "COLUMN_REF"}
    aliases = {one["alias"].lower() for one in node["select_list"]}
    known = all(_is_count(one) or one["class"] in _PLAIN for one in parts)
    if not counts or not known or not names <= _OF_MASKS | aliases or aliases & _OF_MASKS:
        return None
    grouped = node["group_expressions"] or node["aggregate_handling"] != "STANDARD_HANDLING"
    wanted = names & _OF_MASKS
    return wanted if grouped or all(map(_is_count, node["select_list"])) else None


def _path(table: dict[str, Any]) -> list[str]:
    """Return the schema and the name of a table in a parsed statement, for any version of DuckDB."""
    if "qualified_name" in table:
        return table["qualified_name"]["path"]
    return [*filter(None, (table.get("schema_name"),)), table.get("table_name", "")]


def _expressions(part: Any) -> Iterator[dict[str, Any]]:
    if isinstance(part, list):
        for one in part:
            yield from _expressions(one)
    elif isinstance(part, dict):
        if "class" in part:
            yield part
        for one in part.values():
            yield from _expressions(one)


def _is_count(one: dict[str, Any]) -> bool:
    return one.get("function_name") == "count_star" and not (one["filter"] or one["distinct"])


def _replace(node: dict[str, Any], count: dict[str, Any], table: dict[str, Any]) -> None:
    """In a parsed statement, replace counts by sums, and the view ``edges`` by the table of edge counts."""
    for one in node["select_list"]:
        if _is_count(one):
            one["alias"] = one["alias"] or "count_star()"
    for one in [*_expressions(node)]:
        if _is_count(one):
            alias = one["alias"]
            one.clear()
            one.update(json.loads(json.dumps(count)), alias=alias)
    alias = node["from_table"]["alias"] or "edges"
    node["from_table"] = {**table, "alias": alias}
