"""The numbers of a pair of entities as SQL, each in terms of others: the formulas of the view ``pairs``.

A *raw* column belongs to one of the two, ``a`` or ``b``: position about the trace's origin, heading in
radians, velocity, box. Numbers are computed in layers, one statement within the other, because DuckDB shares
named columns and not repeated expressions.
"""

from __future__ import annotations

import string
from functools import cache
from typing import TYPE_CHECKING, Final

from sgstore.quoting import quoted

if TYPE_CHECKING:
    from collections.abc import Iterable

_HALF: Final = {
    "la": "{alength} / 2",
    "wa": "{awidth} / 2",
    "lb": "{blength} / 2",
    "wb": "{bwidth} / 2",
}
_PAIR: Final = {
    "dx": "{bx} - {ax}",
    "dy": "{by} - {ay}",
    "dz": "{bz} - {az}",
    "dvx": "{bvx} - {avx}",
    "dvy": "{bvy} - {avy}",
    "turn": "{bheading} - {aheading}",
    **_HALF,
    "planar": "sqrt({dx} * {dx} + {dy} * {dy})",
    "dist": "sqrt({dx} * {dx} + {dy} * {dy} + {dz} * {dz})",
    "lon": "{dx} * cos({aheading}) + {dy} * sin({aheading})",
    "lat": "{dy} * cos({aheading}) - {dx} * sin({aheading})",
    "back": "{dx} * cos({bheading}) + {dy} * sin({bheading})",
    "side": "{dy} * cos({bheading}) - {dx} * sin({bheading})",
    "course": "CASE WHEN {dx} = 0 AND {dy} = 0 THEN 0 * {aheading}"
    " ELSE degrees(atan2({dy}, {dx}) - {aheading}) END",
    "turned": "degrees({turn})",
    "bearing": "{course} - 360 * ceil(({course} - 180) / 360)",
    "rel_heading": "{turned} - 360 * ceil(({turned} - 180) / 360)",
    # What is not known stays so: greatest() would pass over it.
    "lon_gap": "CASE WHEN {out1} < 0 THEN 0 ELSE {out1} END",
    "lat_gap": "CASE WHEN {out2} < 0 THEN 0 ELSE {out2} END",
    "sighted": "degrees({bheading} - atan2({dy}, {dx}))",
    "apparent_heading": "CASE WHEN {planar} > 0"
    " THEN {sighted} - 360 * ceil(({sighted} - 180) / 360) END",
    "rel_speed": "sqrt({dvx} * {dvx} + {dvy} * {dvy})",
    "closing_speed": "-({dx} * {dvx} + {dy} * {dvy}) / nullif({planar}, 0)",
    "pace": "sqrt({avx} * {avx} + {avy} * {avy})",
    "headway": "CASE WHEN {lon} > 0 AND {pace} > 0.1 AND {la} + {lb} IS NOT NULL"
    " THEN greatest({lon} - {la} - {lb}, 0) / {pace} END",
    # No two boxes are nearer than their circumscribed circles; a micrometre makes up for rounding.
    "at_least": "{planar} - sqrt({la} * {la} + {wa} * {wa}) - sqrt({lb} * {lb} + {wb} * {wb}) - 1e-6",
    "co": "abs(cos({turn}))",
    "si": "abs(sin({turn}))",
    "hand": "CASE WHEN cos({turn}) * sin({turn}) < 0 THEN -1 ELSE 1 END",
    # Distance from the octagon that the two boxes make: out and past each of its four near edges.
    "out1": "abs({lon}) - {la} - {lb} * {co} - {wb} * {si}",
    "out2": "abs({lat}) - {wa} - {lb} * {si} - {wb} * {co}",
    "out3": "abs({back}) - {lb} - {la} * {co} - {wa} * {si}",
    "out4": "abs({side}) - {wb} - {la} * {si} - {wa} * {co}",
    "past1": "abs(CASE WHEN {lon} < 0 THEN -{lat} ELSE {lat} END"
    " - {hand} * ({lb} * {si} - {wb} * {co})) - {wa}",
    "past2": "abs(CASE WHEN {lat} < 0 THEN -{lon} ELSE {lon} END"
    " - {hand} * ({lb} * {co} - {wb} * {si})) - {la}",
    "past3": "abs(CASE WHEN {back} < 0 THEN -{side} ELSE {side} END"
    " + {hand} * ({la} * {si} - {wa} * {co})) - {wb}",
    "past4": "abs(CASE WHEN {side} < 0 THEN -{back} ELSE {back} END"
    " + {hand} * ({la} * {co} - {wa} * {si})) - {lb}",
    "gap": "CASE WHEN {la} + {wa} + {lb} + {wb} IS NULL THEN NULL"
    " WHEN greatest({out1}, {out2}, {out3}, {out4}) <= 0 THEN 0 ELSE sqrt(least("
    + ", ".join(
        f"CASE WHEN {{out{i}}} > 0 THEN {{out{i}}} * {{out{i}}}"
        f" + greatest({{past{i}}}, 0) * greatest({{past{i}}}, 0) END"
        for i in (1, 2, 3, 4)
    )
    + ")) END",
    "ttc": "CASE WHEN {closing_speed} > 0 THEN {gap} / {closing_speed} END",
}
"""Numbers of a pair (a, b) in terms of the columns of both and of one another, as in the view ``pairs``."""


WAY: Final = "lane_dist"
"""The number that no layer computes: it is looked up, by lanes and what lies between them."""


def way_text(frame: str, a: str, b: str, conditions: Iterable[str]) -> str:
    """How far it is along the lanes from a to b.

    Parameters
    ----------
    frame, a, b : str
        Columns of the frame and of both ids.
    conditions : iterable of str
        What is known of the rows ``"a"`` and ``"b"`` of ``lane_state`` besides, so that fewer are looked at.
    """
    # Each row is tied to the frame asked for, not to the others: that is what tells DuckDB where to begin.
    more = "".join(f"\n        AND {condition}" for condition in conditions)
    ahead = """min(CASE WHEN "way" >= 0 THEN "way" END)"""
    behind = """max(CASE WHEN "way" < 0 THEN "way" END)"""
    return f"""(
    SELECT CASE WHEN {behind} IS NULL OR {ahead} <= -{behind} THEN {ahead} ELSE {behind} END
    FROM (
      SELECT "r"."start" + (CAST("b"."along" AS DOUBLE) - CAST("a"."along" AS DOUBLE)) AS "way"
      FROM "lane_state" AS "a", "lane_state" AS "b", "frame" AS "f", "map_reach" AS "r"
      WHERE "a"."frame_id" = {frame} AND "a"."node_id" = {a} AND "a"."is_own"
        AND "b"."frame_id" = {frame} AND "b"."node_id" = {b} AND "b"."is_own"
        AND "f"."frame_id" = {frame} AND "r"."map_id" = "f"."map_id"
        AND "r"."src" = "a"."lane" AND "r"."dst" = "b"."lane"{more}
    ) AS "ways" WHERE "way" BETWEEN -200 AND 200
  )"""  # noqa: S608  columns that the compiler named


@cache
def parts_of(name: str) -> tuple[str, ...]:
    """The numbers and raw columns that a number of a pair is made of."""
    return tuple(sorted({f for _, f, _, _ in string.Formatter().parse(_PAIR[name]) if f}))


@cache
def stage_of(name: str) -> int:
    """How many layers of a statement come before a number of a pair; 0 for a raw column."""
    return 1 + max(stage_of(part) for part in parts_of(name)) if name in _PAIR else 0


@cache
def needed_for(name: str) -> frozenset[str]:
    """A number of a pair with all that it is made of."""
    if name not in _PAIR:
        return frozenset({name})
    return frozenset({name}).union(*(needed_for(part) for part in parts_of(name)))


def pair_column(name: str, a: str, b: str) -> str:
    """The column of a number of a pair, or of a raw column (``ax``: x of a)."""
    if name in _PAIR:
        return quoted(f"{name}({a}, {b})")
    return quoted(f"{a if name[0] == 'a' else b}:{name[1:]}")


def pair_text(name: str, a: str, b: str) -> str:
    """A number of a pair in terms of the columns of the layers before."""
    columns = {part: pair_column(part, a, b) for part in parts_of(name)}
    return _PAIR[name].format_map(columns)
