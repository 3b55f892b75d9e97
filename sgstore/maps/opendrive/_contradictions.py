"""Warnings about OpenDRIVE records that contradict each other: lengths, positions, widths and references.

The records stay in the map as far as possible. A position beyond its road counts as the end of the
road.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.maps.opendrive._lanes import odd_sections
from sgstore.maps.opendrive._nodes import junction_of
from sgstore.maps.opendrive._piecewise import last_before
from sgstore.maps.opendrive._plan_view import PlanView, poses

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.maps.opendrive._document import Document
    from sgstore.maps.opendrive._lanes import LaneTable

APART: Final = 0.1
"""Difference of lengths and positions up to which they count as equal; m."""
_WIDTH: Final = "road/laneSection/lane/width"
_PLACED: Final = (
    *("road/signal", "road/signalReference", "road/object", "road/elevation"),
    *("road/laneOffset", "road/type"),
)
"""Kinds of elements that have a position s on their road."""


def contradictions(document: Document, lanes: LaneTable, plan: PlanView) -> list[str]:
    """Return a warning for each record of an OpenDRIVE map that contradicts other records."""
    return [
        *odd_sections(document),
        *document.warnings,
        *_lengths(document, plan),
        *_sections(document, lanes),
        *_widths(document, lanes),
        *_beyond(document),
        *_validities(document, lanes),
        *_references(document),
        *_doubled(document),
        *_junctions(document),
    ]


def _lengths(document: Document, plan: PlanView) -> Iterator[str]:
    """Yield warnings: a road's length differs from its reference line, or the reference line has gaps."""
    names, length = document.road_ids, document.numbers("road", "length")
    reach = np.zeros(len(length))
    np.maximum.at(reach, plan.road, plan.s + plan.length)
    for road in np.flatnonzero(np.abs(reach - length) > APART).tolist():
        yield (
            f"road {names[road]!r}: length is {length[road]:g} m, but its planView has"
            f" {reach[road]:g} m"
        )
    first = np.append(True, np.diff(plan.road) != 0)[: len(plan.s)]
    start = np.where(first, 0.0, np.append(0.0, (plan.s + plan.length)[:-1])[: len(plan.s)])
    for row in np.flatnonzero(np.abs(plan.s - start) > APART).tolist():
        yield (
            f"road {names[plan.road[row]]!r}: a geometry begins at s = {plan.s[row]:g} m,"
            f" but the one before it ends at {start[row]:g} m"
        )
    last = np.flatnonzero(~first[1:])
    end = poses(plan, last, plan.s[last] + plan.length[last])
    gap = np.hypot(end.x - plan.x[last + 1], end.y - plan.y[last + 1])
    for at in np.flatnonzero(gap > APART).tolist():
        row = int(last[at]) + 1
        yield (
            f"road {names[plan.road[row]]!r}: its reference line jumps by {gap[at]:.2f} m"
            f" at s = {plan.s[row]:g} m"
        )


def _sections(document: Document, lanes: LaneTable) -> Iterator[str]:
    """Yield warnings: a lane section begins outside its road, too late, or where another one begins."""
    sections, length = lanes.sections, document.numbers("road", "length")
    start, first = sections.start, sections.number == 0
    same = np.append(False, np.diff(start) <= 0)[: len(start)] & ~first
    for rows, what in (
        ((start > length[sections.road] + APART) | (start < -APART), "begins beyond its road"),
        (first & (start > APART), "is the first one: the road has no lanes before it"),
        (same, "begins where another one begins: only the last one counts"),
    ):
        for row in np.flatnonzero(rows).tolist():
            road = document.road_ids[sections.road[row]]
            yield f"road {road!r}: the laneSection at s = {start[row]:g} m {what}"


def _widths(document: Document, lanes: LaneTable) -> Iterator[str]:
    """Yield warnings: a lane has no width, or a width begins outside its section or too late."""
    has = np.zeros(len(lanes), bool)
    first = np.full(len(lanes), np.inf)
    for kind in (_WIDTH, "road/laneSection/lane/border"):
        lane = lanes.row[document[kind].of]
        offset = document.numbers(kind, "sOffset", 0.0)[lane >= 0]
        lane = lane[lane >= 0]
        has[lane] = True
        np.minimum.at(first, lane, offset)
        section = lanes.section[lane]
        beyond = offset > (lanes.sections.end - lanes.sections.start)[section] + APART
        for row in np.flatnonzero(beyond).tolist():
            what = f"a {kind.rpartition('/')[2]} at sOffset = {offset[row]:g} m begins beyond it"
            yield f"{lanes.name(document, int(lane[row]))}: {what}"
    for lane in np.flatnonzero(~has).tolist():
        yield f"{lanes.name(document, lane)}: no width, which counts as 0"
    for lane in np.flatnonzero(has & (first > APART)).tolist():
        yield f"{lanes.name(document, lane)}: no width before sOffset = {first[lane]:g} m"


def _beyond(document: Document) -> Iterator[str]:
    """Yield warnings: a signal, object or other record is outside its road."""
    length = document.numbers("road", "length")
    for kind in _PLACED:
        table, s = document[kind], document.rough_numbers(kind, "s")
        beyond = (s > length[table.road] + APART) | (s < -APART)
        for row in np.flatnonzero(beyond).tolist():
            road = int(table.road[row])
            ident = table.attributes[row].get("id")
            name = f"<{kind.rpartition('/')[2]}>" + ("" if ident is None else f" {ident!r}")
            yield (
                f"road {document.road_ids[road]!r}, {name}: its s = {s[row]:g} m is beyond"
                f" the road, which has {length[road]:g} m"
            )


def _validities(document: Document, lanes: LaneTable) -> Iterator[str]:
    """Yield warnings: a signal is valid only for lanes that do not exist at its position."""
    for kind in ("road/signal", "road/signalReference"):
        table, valid = document[kind], document[f"{kind}/validity"]
        if not len(valid):
            continue
        road, s = table.road[valid.of], document.rough_numbers(kind, "s")[valid.of]
        section = last_before(lanes.sections.road, lanes.sections.start, road, s)
        ends = [document.rough_numbers(f"{kind}/validity", name) for name in ("fromLane", "toLane")]
        low, high = np.minimum(*ends), np.maximum(*ends)
        start = np.searchsorted(lanes.section, section)
        stop = np.searchsorted(lanes.section, section, side="right")
        for row in np.flatnonzero(~((low <= 0) & (high >= 0))).tolist():
            here = lanes.ident[start[row] : stop[row]]
            if not ((here >= low[row]) & (here <= high[row])).any():
                name = table.attributes[valid.parent[row]].get("id", "")
                yield (
                    f"road {document.road_ids[road[row]]!r}, <{kind[5:]}> {name!r}: its validity"
                    f" names missing lanes {low[row]:g} to {high[row]:g}"
                )


def _references(document: Document) -> Iterator[str]:
    """Yield warnings: a reference to a signal or junction that does not exist."""
    signals = {*document["road/signal"].texts("id")}
    junctions, roads = {*document["junction"].texts("id")}, {*document.road_ids}
    controllers = document["controller"].texts("id")
    groups = document["junctionGroup"].texts("id")
    references = document["road/signalReference"]
    members, controls = document["junctionGroup/junctionReference"], document["controller/control"]
    for road, name in zip(references.road.tolist(), references.texts("id"), strict=True):
        if name not in signals:
            yield f"road {document.road_ids[road]!r}: a signalReference names a missing signal {name!r}"
    for row, name in zip(controls.parent, controls.texts("signalId"), strict=True):
        if name not in signals:
            yield f"controller {controllers[row]!r} names a missing signal {name!r}"
    for row, name in zip(members.parent, members.texts("junction"), strict=True):
        if name not in junctions:
            yield f"junctionGroup {groups[row]!r} names a missing junction {name!r}"
    for kind in ("road/predecessor", "road/successor"):
        for attributes, row in zip(document[kind].attributes, document[kind].parent, strict=True):
            name = attributes.get("elementId", "")
            at_junction = attributes.get("elementType") == "junction"
            if name not in (junctions if at_junction else roads):
                what = "junction" if at_junction else "road"
                yield f"road {document.road_ids[row]!r}: leads to a missing {what} {name!r}"


def _doubled(document: Document) -> Iterator[str]:
    """Yield warnings: two signals or junctions have the same id, or a road has two links at one end."""
    for kind in ("road/signal", "junction", "controller"):
        for name, count in Counter(document[kind].texts("id")).items():
            if count > 1:
                yield f"{kind.rpartition('/')[2]} {name!r}: there are {count} of this id"
    for kind in ("road/predecessor", "road/successor"):
        for road, count in Counter(document[kind].parent).items():
            if count > 1:
                tag = kind.rpartition("/")[2]
                yield f"road {document.road_ids[road]!r}: {count} {tag} links; the last one counts"


def _junctions(document: Document) -> Iterator[str]:
    """Yield warnings: a road's junction does not exist, or the junction has no connection with the road."""
    names = document["junction"].texts("id")
    kinds = dict(zip(names, document["junction"].texts("type"), strict=True))
    table = document["junction/connection"]
    named = {
        (names[row], attributes.get(key, ""))
        for row, attributes in zip(table.parent, table.attributes, strict=True)
        for key in ("connectingRoad", "linkedRoad")
    }
    for row, road in enumerate(document.road_ids):
        junction = junction_of(document, row)
        if junction and junction not in kinds:
            yield f"road {road!r} is part of a missing junction {junction!r}"
        elif junction and kinds[junction] != "virtual" and (junction, road) not in named:
            yield f"road {road!r}: no connection of its junction {junction!r} leads to it"
