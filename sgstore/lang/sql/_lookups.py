"""SQL for lane distances, lane properties, and numbers from later frames, which the store contains.

A node lies on stretches of lanes: an entity at one point of each of its own lanes, a light or a sign at the
waiting places of the lanes that it controls, a part of the map at its ``map_place``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.base.quoting import literal, quoted
from sgstore.lang.bind import kind_conditions
from sgstore.lang.ir import PairNumber
from sgstore.lang.sql._masks import in_mask
from sgstore.lang.sql._windows import TRACE_OF_FRAME
from sgstore.model.criticality import KNOWN, RECORDED
from sgstore.model.pair_numbers import COURSES, LANE_DIST, NEXT_PARTS, PART_DIST, WAYS
from sgstore.model.vocabulary import SIGNALS, entity_kinds

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import Kinds
    from sgstore.lang.sql._expressions import Leaf

_SIGNALS: Final = frozenset(SIGNALS)


@dataclass(frozen=True, slots=True)
class WayEnd:
    """Start or end of a route along lanes: the SQL column of a node id, and the node's possible kinds."""

    node: str
    kinds: Kinds


def way_text(function: str, frame: str, ends: tuple[WayEnd, WayEnd], catalog: Catalog) -> str:
    """Return the SQL of a number that is measured along lanes, such as a lane distance.

    The numbers are :data:`sgstore.model.pair_numbers.WAYS`.

    Parameters
    ----------
    function : str
    frame : str
        Column of the frame id.
    ends : (WayEnd, WayEnd)
        Both nodes; the same node twice for a function of one node.
    catalog : Catalog
    """
    if function in NEXT_PARTS:
        return _next_text(frame, ends[0], NEXT_PARTS[function], catalog)
    if function in COURSES:
        return _course_text(frame, ends[0], function, catalog)
    if is_between_entities(function, ends, catalog):
        return _between_entities(frame, ends, catalog)
    return _between(frame, ends, catalog, parts=function == PART_DIST)


_AHEAD: Final = """min(CASE WHEN "way" >= 0 THEN "way" END)"""
_BEHIND: Final = """max(CASE WHEN "way" < 0 THEN "way" END)"""
_SHORTER: Final = (
    f"CASE WHEN {_BEHIND} IS NULL OR {_AHEAD} <= -{_BEHIND} THEN {_AHEAD} ELSE {_BEHIND} END"
)
"""SQL for the shorter of two routes: ahead (positive) or behind (negative)."""


def is_between_entities(function: str, ends: tuple[WayEnd, WayEnd], catalog: Catalog) -> bool:
    """True for a lane distance if neither node can be a light or a sign."""
    signals = _SIGNALS & (catalog.moving | catalog.fixed | catalog.mapped)
    return function == LANE_DIST and not any(end.kinds.every & signals for end in ends)


def lane_distances(ends: tuple[WayEnd, WayEnd], catalog: Catalog, within: list[str]) -> str:
    """Return SQL for all lane distances between entities: ``frame_id``, ``src``, ``dst`` and ``value``.

    ``within`` has conditions on the frame ids of ``":a"``.
    """
    a, b = ends
    more = _kinds_of(a, ":a", catalog) + _kinds_of(b, ":b", catalog)
    where = " AND ".join(['":a"."is_own"', '":b"."is_own"', *more, *within])
    return f"""
    SELECT "frame_id", "src", "dst",
      {_SHORTER} AS "value"
    FROM (
      SELECT ":a"."frame_id", ":a"."node_id" AS "src", ":b"."node_id" AS "dst",
        ":r"."start" + (CAST(":b"."along" AS DOUBLE) - CAST(":a"."along" AS DOUBLE)) AS "way"
      FROM "lane_state" AS ":a"
        JOIN "lane_state" AS ":b" ON ":b"."bucket" = ":a"."bucket" AND ":b"."frame_id" = ":a"."frame_id"
        JOIN "bucket" AS ":g" ON ":g"."bucket" = ":a"."bucket"
        JOIN "map_reach" AS ":r" ON ":r"."map_id" = ":g"."map_id" AND ":r"."src" = ":a"."lane"
          AND ":r"."dst" = ":b"."lane"
      WHERE {where}
    ) AS "ways" WHERE "way" BETWEEN -200 AND 200
    GROUP BY "frame_id", "src", "dst"
  """  # noqa: S608  columns that the compiler named


def _between_entities(frame: str, ends: tuple[WayEnd, WayEnd], catalog: Catalog) -> str:
    """Return the SQL of the lane distance of two entities. Each counts as a point on its lane."""
    a, b = (end.node for end in ends)
    conditions = _kinds_of(ends[0], ":a", catalog) + _kinds_of(ends[1], ":b", catalog)
    # Each row is joined to the given frame, not to other rows. So DuckDB starts with the frame.
    more = "".join(f"\n        AND {condition}" for condition in conditions)
    return f"""(
    SELECT {_SHORTER}
    FROM (
      SELECT ":r"."start" + (CAST(":b"."along" AS DOUBLE) - CAST(":a"."along" AS DOUBLE)) AS "way"
      FROM "lane_state" AS ":a", "lane_state" AS ":b", "frame" AS ":f", "map_reach" AS ":r"
      WHERE ":a"."frame_id" = {frame} AND ":a"."node_id" = {a} AND ":a"."is_own"
        AND ":b"."frame_id" = {frame} AND ":b"."node_id" = {b} AND ":b"."is_own"
        AND ":f"."frame_id" = {frame} AND ":r"."map_id" = ":f"."map_id"
        AND ":r"."src" = ":a"."lane" AND ":r"."dst" = ":b"."lane"{more}
    ) AS "ways" WHERE "way" BETWEEN -200 AND 200
  )"""  # noqa: S608  columns that the compiler named


def _between(frame: str, ends: tuple[WayEnd, WayEnd], catalog: Catalog, *, parts: bool) -> str:
    """Return the SQL of the lane distance of two nodes. Each covers parts of lanes.

    It is 0 if they overlap.
    """
    one, other = (_stretches(frame, end, catalog, parts=parts) for end in ends)
    near = '":r"."start" + (":b"."first" - ":a"."last")'
    far = '":r"."start" + (":b"."last" - ":a"."first")'
    return f"""(
    SELECT {_SHORTER}
    FROM (
      SELECT CASE WHEN {near} >= 0 THEN {near} WHEN {far} < 0 THEN {far} ELSE 0 END AS "way"
      FROM ({one}) AS ":a", ({other}) AS ":b", "frame" AS ":f", "map_reach" AS ":r"
      WHERE ":f"."frame_id" = {frame} AND ":r"."map_id" = ":f"."map_id"
        AND ":r"."src" = ":a"."lane" AND ":r"."dst" = ":b"."lane"
    ) AS "ways" WHERE "way" BETWEEN -200 AND 200
  )"""  # noqa: S608  columns that the compiler named


def _next_text(frame: str, end: WayEnd, what: str, catalog: Catalog) -> str:
    """Return the SQL of the distance along lanes to the next part of the map, such as a junction.

    It is 0 inside the part.
    """
    places = _stretches(frame, end, catalog, parts=False)
    return f"""(
    SELECT min(CASE WHEN "near" < 0 THEN 0 ELSE "near" END)
    FROM (
      SELECT ":r"."start" + (":p"."start" - ":a"."last") AS "near",
        ":r"."start" + (":p"."end" - ":a"."first") AS "far"
      FROM ({places}) AS ":a", "frame" AS ":f", "map_reach" AS ":r", "map_place" AS ":p"
      WHERE ":f"."frame_id" = {frame} AND ":r"."map_id" = ":f"."map_id"
        AND ":r"."src" = ":a"."lane" AND ":r"."start" >= 0
        AND ":p"."map_id" = ":f"."map_id" AND ":p"."lane" = ":r"."dst" AND ":p"."what" = {literal(what)}
    ) AS "ways" WHERE "far" >= 0 AND "near" <= 200
  )"""  # noqa: S608  columns that the compiler named


def _course_text(frame: str, end: WayEnd, column: str, catalog: Catalog) -> str:
    """Return the SQL of the curvature or slope of an entity's primary lane at its position."""
    more = "".join(f" AND {one}" for one in _kinds_of(end, ":s", catalog))
    return f"""(
    SELECT min(":c"."{column}")
    FROM "lane_state" AS ":s", "frame" AS ":f", "map_course" AS ":c"
    WHERE ":s"."frame_id" = {frame} AND ":s"."node_id" = {end.node} AND ":s"."is_primary"{more}
      AND ":f"."frame_id" = {frame} AND ":c"."map_id" = ":f"."map_id" AND ":c"."lane" = ":s"."lane"
      AND greatest(CAST(":s"."along" AS DOUBLE), 0) >= ":c"."start"
      AND (":c"."end" IS NULL OR CAST(":s"."along" AS DOUBLE) < ":c"."end")
  )"""  # noqa: S608  columns that the compiler named


def told_lanes(what: str) -> str:
    """Return SQL for the traces whose map has values for ``ways``, ``curvature`` or ``slope`` of lanes."""
    known = "" if what == "ways" else f' AND ":c"."{what}" IS NOT NULL'
    table = "map_reach" if what == "ways" else "map_course"
    return (
        'SELECT ":t"."trace_id" FROM "trace" AS ":t" WHERE EXISTS '  # noqa: S608  words of ours
        f'(SELECT NULL FROM "{table}" AS ":c" WHERE ":c"."map_id" = ":t"."map_id"{known})'
    )


def _stretches(frame: str, end: WayEnd, catalog: Catalog, *, parts: bool) -> str:
    """Return SQL for the parts of lanes that a node covers: lane, start and end; m."""
    kinds, held = end.kinds.every, catalog.moving | catalog.fixed
    found: list[str] = []
    if kinds & entity_kinds() - _SIGNALS:
        more = "".join(f" AND {one}" for one in _kinds_of(end, ":s", catalog))
        along = 'CAST(":s"."along" AS DOUBLE)'
        found.append(
            f'SELECT ":s"."lane" AS "lane", {along} AS "first", {along} AS "last" FROM "lane_state" AS ":s"'  # noqa: S608
            f' WHERE ":s"."frame_id" = {frame} AND ":s"."node_id" = {end.node} AND ":s"."is_own"{more}'
        )
    if kinds & _SIGNALS & held:
        edges = "known_edge" if catalog.world else "edge"
        found.append(_controlled(frame, end.node, kinds & _SIGNALS & held, edges))
    if parts or kinds & _SIGNALS & catalog.mapped:
        signs = ", ".join(map(literal, (*SIGNALS, "stop_line")))
        more = "" if parts else f' AND ":p"."what" IN ({signs})'
        found.append(
            'SELECT ":p"."lane" AS "lane", ":p"."start" AS "first", ":p"."end" AS "last"'  # noqa: S608
            ' FROM "frame" AS ":g", "map_place" AS ":p"'
            f' WHERE ":g"."frame_id" = {frame} AND ":p"."map_id" = ":g"."map_id"'
            f' AND ":p"."node_id" = {end.node}{more}'
        )
    nowhere = 'SELECT "lane", "start" AS "first", "end" AS "last" FROM "map_place" WHERE FALSE'
    return "\n        UNION ALL ".join(found or [nowhere])


def _controlled(frame: str, node: str, kinds: frozenset[str], edges: str) -> str:
    """Return SQL for the points on lanes where vehicles wait at a light or sign.

    They come from the map, otherwise from the junction.
    """
    at = """coalesce(":p"."start", CASE WHEN ":m"."junction" IS NOT NULL THEN 0 ELSE ":m"."length" END)"""
    signals = ", ".join(literal(kind) for kind in SIGNALS if kind in kinds)
    return f"""SELECT ":c"."dst" AS "lane", {at} AS "first", {at} AS "last"
        FROM "{edges}" AS ":c" JOIN "bucket" AS ":g" ON ":g"."bucket" = ":c"."bucket"
          JOIN "map_node" AS ":m" ON ":m"."map_id" = ":g"."map_id" AND ":m"."node_id" = ":c"."dst"
          LEFT JOIN "map_place" AS ":p" ON ":p"."map_id" = ":g"."map_id" AND ":p"."lane" = ":c"."dst"
            AND ":p"."what" = CAST(":c"."src_kind" AS VARCHAR)
        WHERE ":c"."relation" = 'controlsTrafficOf' AND ":c"."bucket" = {frame} >> 6 AND ":c"."src" = {node}
          AND ":c"."src_kind" IN ({signals}) AND {in_mask('":c"', frame)}"""  # noqa: S608  columns that the compiler named


def _kinds_of(end: WayEnd, alias: str, catalog: Catalog) -> list[str]:
    """Return SQL conditions on the kinds of entities. With them, fewer rows of ``lane_state`` are read."""
    kinds = end.kinds.only(entity_kinds() - _SIGNALS)
    held = catalog.moving | catalog.fixed
    return kind_conditions(kinds, f'"{alias}"."kind"', f'"{alias}"."is_ego"', held)


LOOKED_UP: Final = WAYS | RECORDED.keys()
"""Pair numbers that are read from the store, not computed from values of both nodes."""


def of_later(found: Iterable[Leaf]) -> list[PairNumber]:
    """Return the numbers of entity pairs that use later frames. SQL computes them last, as they are slow."""
    return [leaf for leaf in found if isinstance(leaf, PairNumber) and leaf.function in RECORDED]


def recorded_text(value: PairNumber, *, world: bool) -> str:
    """Return the SQL of a number of two entities that uses later frames.

    The store defines the SQL function.
    """
    name = f"{KNOWN if world else ''}{value.function}"
    ends = ", ".join(quoted(f"{key}.id") for key in (value.a, value.b))
    return f'recorded({literal(name)}, "frame_id" >> {TRACE_OF_FRAME}, {ends})'
