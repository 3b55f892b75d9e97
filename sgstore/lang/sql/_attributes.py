"""SQL for the attributes of nodes, frames and traces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.base.quoting import literal, quoted
from sgstore.lang.catalog import DERIVED, MAP_OWN, Attribute, DisplayUnit, Home, Type
from sgstore.lang.ir import FrameAttribute, TraceAttribute
from sgstore.lang.sql._select import Select, nested
from sgstore.model.pair_numbers import low_and_high_sql
from sgstore.model.vocabulary import MAP_KINDS, NOISE_MARKS, VEHICLE_LIGHTS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.lang.bind import Profile


@dataclass(frozen=True, slots=True)
class Aliases:
    """SQL aliases of the joined tables that contain the attributes of a node.

    ``None`` means that the table is not joined.
    """

    state: str | None = None
    entity: str | None = None
    map: str | None = None
    trace: str | None = None


_ORIGINS: Final = {
    DisplayUnit.east: "origin_x",
    DisplayUnit.north: "origin_y",
    DisplayUnit.up: "origin_z",
}

PLACES: Final = ", ".join(literal(kind) for kind in MAP_KINDS)
"""Kinds of map parts. Signs and lights are entities, and therefore not included."""

_ABSENT: Final = {
    Type.number: "CAST(NULL AS DOUBLE)",
    Type.text: "CAST(NULL AS VARCHAR)",
    Type.boolean: "CAST(NULL AS BOOLEAN)",
}


def attribute_text(attribute: Attribute, at: Aliases) -> str:
    """Return the SQL of a node attribute. Its value may be in one of several tables."""
    if attribute.unit is DisplayUnit.label:
        return _label(at)
    if attribute.name == "kind" and at.state and not (at.entity or at.map):
        return f"{at.state}.{quoted('kind')}"
    parts = [
        _part(attribute, home, f"{alias}.{quoted(attribute.columns[home])}", alias, at.trace)
        for home, alias in (
            (Home.state, at.state),
            (Home.entity, at.entity),
            (Home.scenery, at.entity),
            (Home.map, at.map),
        )
        if alias is not None and home in attribute.columns
    ]
    if attribute.name == "is_ego":
        parts.append("FALSE")
    if not parts:
        return _ABSENT[attribute.type]
    if attribute.values and len(parts) > 1:
        parts = [f"CAST({part} AS VARCHAR)" for part in parts]
    return parts[0] if len(parts) == 1 else f"coalesce({', '.join(parts)})"


def raw_text(name: str, at: Aliases, *, upright: bool = False) -> str:
    """Return the SQL of a stored number of a node, such as ``x``.

    Positions are relative to the origin of the trace.

    Static entities have no states. Their velocity and acceleration are 0.
    """
    if name in {"low", "high"}:
        return _side_text(name, at, upright=upright)
    still = name in {"vx", "vy", "ax", "ay"}
    parts: list[str] = []
    if name == "carrier":
        return f"{at.state}.{quoted(name)}" if at.state else "CAST(NULL AS INTEGER)"
    if name == "pitch":
        return f"CAST({at.state}.{quoted(name)} AS DOUBLE)" if at.state else "CAST(NULL AS DOUBLE)"
    if name == "node_id":
        ids = [f"{alias}.{quoted(name)}" for alias in (at.state, at.entity, at.map) if alias]
        return ids[0] if len(ids) == 1 else f"coalesce({', '.join(ids)})"
    if at.state:
        parts.append(f"CAST({at.state}.{quoted(name)} AS DOUBLE)")
    if at.entity:
        value = f"CAST({at.entity}.{quoted(name)} AS DOUBLE)"
        parts.append(f'CASE WHEN {at.entity}."is_static" THEN 0e0 END' if still else value)
    if at.map:
        value = "0e0" if still else f"{at.map}.{quoted(name)}"
        value = f'{value} - {at.trace}."origin_{name}"' if name in {"x", "y", "z"} else value
        # Signs and lights of a map are entities. Lanes and roads have no pair numbers.
        parts.append(f'CASE WHEN {at.map}."kind" NOT IN ({PLACES}) THEN {value} END')
    if not parts:
        return "CAST(NULL AS DOUBLE)"
    return parts[0] if len(parts) == 1 else f"coalesce({', '.join(parts)})"


def _side_text(name: str, at: Aliases, *, upright: bool) -> str:
    """Return the SQL of the height of a body's lower or upper side.

    It is NULL for signals and map parts.
    """
    parts = [
        low_and_high_sql(
            lambda column, alias=alias: (
                f"{alias}.{quoted(column)}"
                if column == "kind"
                else f"CAST({alias}.{quoted(column)} AS DOUBLE)"
            ),
            upright=upright,
        )[name]
        for alias in (at.state, at.entity)
        if alias
    ]
    if not parts:
        return "CAST(NULL AS DOUBLE)"
    return parts[0] if len(parts) == 1 else f"coalesce({', '.join(parts)})"


def owner_text(node: str, profile: Profile, trace: str, road_map: str) -> str:
    """Return the SQL of the owner of a node id: the trace for an entity, the map for a part of the map."""
    if not profile.mapped:
        return trace
    of_map = f"coalesce({road_map}, -1 - ({trace}))"
    return (
        of_map if profile.places == 1 else f"CASE WHEN {node} >= 0 THEN {trace} ELSE {of_map} END"
    )


def role_text(frame: str, node: str) -> str:
    """Return the SQL of the role of a lane in a frame, relative to the ego."""
    on = [f'":r"."frame_id" = {frame}', f'":r"."node_id" = {node}']
    role = Select(['any_value(":r"."role")'], ['"roles" AS ":r"'], on)
    return f"({role.text()})"


def own_text(attribute: Attribute, frame: str, node: str, edge: Sequence[str] = ()) -> str:
    """Return the SQL of a user-defined attribute of a node or edge in a frame.

    The attribute belongs to a node, or to the edge from this node with the given relation and other end.
    """
    told = 'json_extract_string(":o"."value", \'$\')'
    value = told
    if attribute.type is Type.number:  # another trace may have texts
        native = "HUGEINT" if attribute.whole else _NATIVE[attribute.type]
        numbers = "'BIGINT', 'UBIGINT', 'HUGEINT', 'DOUBLE'"
        value = f'CASE WHEN json_type(":o"."value") IN ({numbers}) THEN TRY_CAST({told} AS {native}) END'
    elif attribute.type is not Type.text:
        value = f"CAST({told} AS {_NATIVE[attribute.type]})"
    on = [f'":o"."frame_id" = {frame}', f'":o"."node_id" = {node}']
    ends = [
        f'":o"."{name}" = {text}' for name, text in zip(("relation", "dst"), edge, strict=False)
    ]
    on += ends or ['":o"."relation" IS NULL']
    on.append(f'":o"."attribute" = {literal(attribute.name)}')
    rows = Select([f"any_value({value})"], ['"attribute" AS ":o"'], on)
    if attribute.name in MAP_OWN and not edge:
        return f"coalesce(({rows.text()}), {_map_own_text(attribute, frame, node)})"
    return f"({rows.text()})"


def _map_own_text(attribute: Attribute, frame: str, node: str) -> str:
    """Return the SQL of an attribute of a lane or sign that the table ``map_place`` contains."""
    told = f'json_extract_string(":p"."what", {literal(f"$.{attribute.name}")})'
    kind = "VARCHAR" if attribute.type is Type.text else _NATIVE[attribute.type]
    on = [
        f'":f"."frame_id" = {frame}',
        '":p"."map_id" = ":f"."map_id"',
        f'":p"."node_id" = {node}',
        '":p"."what" LIKE \'{%\'',
    ]
    tables = ['"frame" AS ":f", "map_place" AS ":p"']
    rows = Select([f"any_value(CAST({told} AS {kind}))"], tables, on)
    return f"({rows.text()})"


def _part(attribute: Attribute, home: Home, column: str, alias: str, trace: str | None) -> str:
    number = f"CAST({column} AS DOUBLE)"
    unit = attribute.unit
    if unit in _ORIGINS and home is not Home.map:
        return f"({number} + {trace}.{quoted(_ORIGINS[unit])})"
    if unit in _BITS:
        bit = 2 ** _BITS[unit].index(attribute.name)
        return f"({column} & {bit}) <> 0"
    if (unit, home) in _STILL:
        return _STILL[unit, home].format(column)
    if unit is DisplayUnit.along:
        ay, heading = (f"CAST({alias}.{quoted(c)} AS DOUBLE)" for c in ("ay", "heading"))
        return f"({number} * cos({heading}) + {ay} * sin({heading}))"
    if unit is DisplayUnit.given:
        return f"CASE WHEN {alias}.{quoted('node_id')} IS NOT NULL THEN {column} IS NOT NULL END"
    plain = number if attribute.type is Type.number else column
    return _CONVERTED.get(unit, "{1}").format(column, plain)


_BITS: Final = {
    DisplayUnit.light: VEHICLE_LIGHTS,
    DisplayUnit.derived: (*(f"derived_{what}" for what in DERIVED), *NOISE_MARKS),
}

_STILL: Final = {
    (DisplayUnit.standing, Home.map): "CASE WHEN {0} IS NOT NULL THEN TRUE END",
    (DisplayUnit.velocity, Home.scenery): "CASE WHEN {0} THEN 0e0 END",
    (DisplayUnit.velocity, Home.map): f"CASE WHEN {{0}} NOT IN ({PLACES}) THEN 0e0 END",
}
"""SQL values of the motion attributes for entities and map parts that never move."""

_INTEGER: Final = "CAST({0} AS BIGINT)"
_CONVERTED: Final = {
    DisplayUnit.degrees: "degrees({1})",
    DisplayUnit.whole: _INTEGER,
    DisplayUnit.chain: _INTEGER,
}


def _label(at: Aliases) -> str:
    parts: list[str] = []
    if at.map:
        parts.append(f"{at.map}.{quoted('name')}")
    told = at.entity or (None if at.map else at.state)
    if told:
        kind = f"CAST({told}.{quoted('kind')} AS VARCHAR)"
        parts.append(f"{kind} || ' ' || CAST({told}.{quoted('node_id')} AS VARCHAR)")
    if not parts:
        return _ABSENT[Type.text]
    return parts[0] if len(parts) == 1 else f"coalesce({', '.join(parts)})"


def as_type(column: str, kind: Type) -> str:
    """Return SQL that converts a column of a user table to a type of the query language."""
    return f"CAST({column} AS {_NATIVE[kind]})"


_NATIVE: Final = {Type.number: "DOUBLE", Type.text: "VARCHAR", Type.boolean: "BOOLEAN"}


def frame_text(leaf: FrameAttribute | TraceAttribute, frame: str, trace: str, map_: str) -> str:
    """Return the SQL of an attribute of the frame or trace."""
    attribute = leaf.attribute
    home, column = next(iter(attribute.columns.items()))
    if attribute.unit in {
        DisplayUnit.seen,
        DisplayUnit.counted,
        DisplayUnit.weather,
        DisplayUnit.clock,
    }:
        return _looked_up(attribute, frame)
    if attribute.table:
        value = f'"u".{quoted(column)}'
        value = value if attribute.type is Type.open else as_type(value, attribute.type)
        on = [f'"u"."frame_id" = {frame}."frame_id"']
        rows = Select([f"any_value({value})"], [f'{quoted(attribute.table)} AS "u"'], on)
        return f"({rows.text()})"
    alias = map_ if home is Home.map else frame if isinstance(leaf, FrameAttribute) else trace
    value = f"{alias}.{quoted(column)}"
    if attribute.unit is DisplayUnit.recording:
        on = [f'"r"."recording_id" = {trace}."recording_id"']
        of = Select([f'"r".{quoted(column)}'], ['"recording" AS "r"'], on)
        value = f"({of.text()})"
    match attribute.unit:
        case DisplayUnit.seconds:
            return "(" + seconds_text(f'{value} - {trace}."start_ns"') + ")"
        case DisplayUnit.span:
            return f"({seconds_text(value)})"
        case DisplayUnit.classed:
            return _class_text(column, frame)
        case _:
            return value


def seconds_text(ns: str) -> str:
    """Return SQL that converts nanoseconds to seconds, like :func:`sgstore.model.world.seconds_of`."""
    return f"round(CAST({ns} AS DOUBLE) / 1e3) / 1e6"


def _class_text(abstraction: str, frame: str) -> str:
    on = [f'"c"."frame_id" = {frame}."frame_id"', f'"c"."abstraction" = {literal(abstraction)}']
    classes = Select(['any_value("c"."class")'], ['"classes" AS "c"'], on)
    return f"({classes.text()})"


def _looked_up(attribute: Attribute, frame: str) -> str:
    """Return the SQL of a frame attribute that depends on other frames or on events."""
    column = next(iter(attribute.columns.values()))
    if attribute.unit in {DisplayUnit.weather, DisplayUnit.clock}:
        return _weather_text(column, frame)
    held = f'"k"."abstraction" = {literal(column)}'
    if attribute.given:
        return _given_text(attribute, column, frame)
    if attribute.unit is DisplayUnit.seen:
        classes = Select(['"k"."class"'], ['"classes" AS "k"'], [held, '"k"."class" IS NOT NULL'])
        if attribute.table:
            frames = Select(['"u"."frame_id"'], [f'{quoted(attribute.table)} AS "u"'])
            classes.where.append(f'"k"."frame_id" IN ({frames.text()})')
        else:
            classes.where.append(among('"k"."frame_id" >> 24', list(attribute.traces)))
        return f"({_class_text(column, frame)} IN ({classes.text()}))"
    counts = Select(['"k"."class"', 'count(*) AS "frames"'], ['"classes" AS "k"'], [held])
    counts.group = ['"k"."class"']
    number = Select(['any_value("n"."frames")'], [nested(counts.text(), "n")])
    number.where = [f'"n"."class" = {_class_text(column, frame)}']
    return f"({number.text()})"


def _given_text(attribute: Attribute, abstraction: str, frame: str) -> str:
    """Return the SQL of a frame attribute that depends on all stores of a collection."""
    seen = attribute.unit is DisplayUnit.seen
    dataset = attribute.name.removeprefix(f"class_{abstraction} in ") if seen else ""
    on = [f'"k"."abstraction" = {literal(abstraction)}', f'"k"."dataset" = {literal(dataset)}']
    classed = _class_text(abstraction, frame)
    if seen:
        classes = Select(['"k"."class"'], [f'{quoted(attribute.given)} AS "k"'], on)
        return f"({classed} IN ({classes.text()}))"
    on.append(f'"k"."class" = {classed}')
    number = Select(['any_value("k"."frames")'], [f'{quoted(attribute.given)} AS "k"'], on)
    return f"({number.text()})"


def _weather_text(word_: str, frame: str) -> str:
    """Return the SQL of a weather attribute: its value in the last weather event up to the frame."""
    told = f'regexp_extract("v"."detail", \'(^|, ){word_}=([^,]*)\', 2)'
    if word_ == "time_of_day":
        parts = [
            f"CAST(split_part({told}, ':', {n}) AS DOUBLE) / {60 ** (n - 1)}" for n in (1, 2, 3)
        ]
        since = f'({frame}."time_ns" - "v"."time_ns") / 3.6e12'
        value = f"({' + '.join(parts)} + {since}) % 24"
        said = f"{told} <> ''"
    elif word_ == "temperature":
        value, said = f"CAST(split_part({told}, ' ', 1) AS DOUBLE)", f"{told} <> ''"
    else:
        value, said = f"nullif({told}, '')", "TRUE"
    on = [
        f'"v"."trace_id" = {frame}."trace_id"',
        '"v"."kind" = \'environment\'',
        f'"v"."frame_id" <= {frame}."frame_id"',
        said,
    ]
    last = Select([f'arg_max({value}, "v"."time_ns")'], ['"events" AS "v"'], on)
    return f"({last.text()})"


def among(column: str, numbers: list[int]) -> str:
    """Return the SQL condition that a column is one of some integers."""
    return f"({column}) IN ({', '.join(map(str, numbers))})" if numbers else "FALSE"
