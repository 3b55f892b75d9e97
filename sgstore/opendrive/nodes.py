"""Lanes, roads and junctions as nodes, and the relations that hold among them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.opendrive.grouped import last_before
from sgstore.roads import STOREY, MapNodes
from sgstore.roads.conflicts import conflicts
from sgstore.roads.ribbons import mean_widths, turned
from sgstore.roads.turns import turn_words
from sgstore.vocabulary import DRIVING, TRAFFIC

if TYPE_CHECKING:
    from sgstore.opendrive.document import Document
    from sgstore.opendrive.lanes import Lanes
    from sgstore.opendrive.links import Flow
    from sgstore.roads import Ribbons
    from sgstore.roads.lanes import Edge
    from sgstore.world import Bools, Floats, Ints

NARROW: Final = 1e-2
"""A lane that is nowhere wider has no neighbours: those on both sides of it are neighbours; m."""

SPEED_UNITS: Final = {"": 1.0, "m/s": 1.0, "mph": 0.44704, "km/h": 1 / 3.6, "kmh": 1 / 3.6}
"""Units of speed → m/s. (ASAM OpenDRIVE 1.8, ``e_unitSpeed``.)"""

FIRST_LANE: Final = 1
"""Row of the first lane: ``off_road`` comes before it."""


def lane_nodes(document: Document, lanes: Lanes, ribbons: Ribbons) -> MapNodes:
    """The lanes, in their order."""
    road_names = document.road_ids
    sections = lanes.sections
    number = sections.number[lanes.section]
    roads = [road_names[r] for r in lanes.road.tolist()]
    names = [
        f"{road}/{section}/{ident}"
        for road, section, ident in zip(roads, number.tolist(), lanes.ident.tolist(), strict=True)
    ]
    length = ribbons.lengths
    middle = ribbons.at(np.arange(len(lanes)), length / 2)
    return MapNodes.of(
        "lane",
        names,
        x=middle.x,
        y=middle.y,
        z=middle.z,
        heading=middle.heading,
        lane_type=tuple(lanes.type),
        road=tuple(roads),
        junction=tuple(junction_of(document, road) for road in lanes.road.tolist()),
        turn=_turns(document, lanes, ribbons),
        section=number,
        lane=lanes.ident,
        length=length,
        width=mean_widths(ribbons),
        speed_limit=_speed_limits(document, lanes),
    )


def junction_of(document: Document, road: int) -> str:
    """Id of the junction that a road lies in, empty if it lies in none."""
    junction = document["road"].attributes[road].get("junction", "-1")
    return "" if junction == "-1" else junction


def _turns(document: Document, lanes: Lanes, ribbons: Ribbons) -> tuple[str, ...]:
    """How lanes turn on their way through a junction; a road that turns in several sections turns once."""
    sign = np.where(lanes.forward, 1.0, -1.0)
    _, one = np.unique(lanes.section, return_index=True)
    of_road = np.zeros(len(document["road"]))
    np.add.at(of_road, lanes.road[one], (turned(ribbons) * sign)[one])
    turn = of_road[lanes.road] * sign
    return tuple(
        word if junction_of(document, road) else ""
        for word, road in zip(turn_words(turn), lanes.road.tolist(), strict=True)
    )


def _speed_limits(document: Document, lanes: Lanes) -> Floats:
    """Limits at the middle of each lane: the lane's own record, else that of its road; m/s."""
    sections = lanes.sections
    start, end = sections.start[lanes.section], sections.end[lanes.section]
    middle = (start + end) / 2
    kind = "road/laneSection/lane/speed"
    record = last_before(
        lanes.row[document[kind].of],
        document.numbers(kind, "sOffset", 0.0),
        np.arange(len(lanes)),
        middle - start,
    )
    own = np.append(_speeds(document, kind), np.nan)[record]
    of_type = document["road/type"]
    kind = "road/type/speed"
    limit = np.full(len(of_type) + 1, np.nan)
    limit[document[kind].of] = _speeds(document, kind)
    at = document.numbers("road/type", "s", 0.0)
    of_road = limit[last_before(of_type.road, at, lanes.road, middle)]
    return np.where(np.isnan(own), of_road, own)


def _speeds(document: Document, kind: str) -> Floats:
    table = document[kind]
    texts = zip(table.texts("max"), table.texts("unit"), strict=True)
    return np.array([speed(value, unit) for value, unit in texts], np.float64)


def speed(value: str, unit: str) -> float:
    """A speed in m/s; NaN for ``no limit``, ``undefined`` and what is no speed."""
    try:
        metres = float(value) * SPEED_UNITS[unit.strip().lower()]
    except (ValueError, KeyError):
        return np.nan
    return metres if 0 < metres < 1000 else np.nan


def wide_pairs(lanes: Lanes, ribbons: Ribbons) -> Ints:
    """(2, n): lanes that share a border, the left one first."""
    return _pairs(lanes, np.flatnonzero(mean_widths(ribbons) > NARROW))


def neighbours(lanes: Lanes, ribbons: Ribbons) -> list[Edge]:
    """``toLeftOf``, ``toRightOf`` and ``opposes`` among lanes.

    Neighbours share a border. Lanes of traffic that only lanes without traffic part (a median, a strip of
    grass) are neighbours as well: they are what a driver looks at across it.
    """
    wide = np.flatnonzero(mean_widths(ribbons) > NARROW)
    traffic = _pairs(lanes, wide[[lanes.type[lane] in TRAFFIC for lane in wide.tolist()]])
    forward, both = lanes.forward, lanes.both
    left, right = np.concatenate((wide_pairs(lanes, ribbons), traffic), axis=1)
    from_left, from_right = forward[left], forward[right]
    against = (forward[traffic[0]] != forward[traffic[1]]) | both[traffic].any(axis=0)
    opposing = traffic[:, against] + FIRST_LANE
    left, right = left + FIRST_LANE, right + FIRST_LANE
    return [
        ("toRightOf", right[from_left], left[from_left]),
        ("toLeftOf", right[~from_left], left[~from_left]),
        ("toLeftOf", left[from_right], right[from_right]),
        ("toRightOf", left[~from_right], right[~from_right]),
        ("opposes", np.concatenate(opposing), np.concatenate(opposing[::-1])),
    ]


def _pairs(lanes: Lanes, rows: Ints) -> Ints:
    """(2, n): lanes of a section that follow one another among ``rows``, from left to right."""
    same: Bools = np.diff(lanes.section[rows]) == 0
    return np.stack((rows[:-1][same], rows[1:][same]))


def flow_edges(lanes: Lanes, nodes: MapNodes, ribbons: Ribbons, flow: Flow) -> list[Edge]:
    """``travelsTo`` and ``conflictsWith`` among lanes; ``nodes`` are theirs."""
    crossing = [
        lane
        for lane, (kind, junction) in enumerate(zip(lanes.type, nodes.junction, strict=True))
        if junction and kind in DRIVING
    ]
    pair = (flow.src, flow.dst)
    one, other = conflicts(ribbons, np.array(crossing, np.int64), nodes.junction, pair, STOREY)
    both = np.concatenate((one, other)), np.concatenate((other, one))
    return [
        ("travelsTo", flow.src + FIRST_LANE, flow.dst + FIRST_LANE),
        ("conflictsWith", both[0] + FIRST_LANE, both[1] + FIRST_LANE),
    ]


def road_nodes(document: Document) -> list[MapNodes]:
    """The roads, and the junctions, in their order."""
    every = range(len(document["road"]))
    road = MapNodes.of(
        "road",
        document.road_ids,
        length=document.numbers("road", "length"),
        road=tuple(document.road_ids),
        junction=tuple(junction_of(document, row) for row in every),
    )
    names = document["junction"].texts("id")
    return [road, MapNodes.of("junction", names, junction=tuple(names))]


def road_types(document: Document) -> dict[str, tuple[tuple[float, str], ...]]:
    """Id of each road that has a type → where along it which type begins."""
    table = document["road/type"]
    found: dict[str, list[tuple[float, str]]] = {}
    places = document.rough_numbers("road/type", "s").tolist()
    for road, s, name in zip(table.road.tolist(), places, table.texts("type"), strict=True):
        found.setdefault(document.road_ids[road], []).append((s, name))
    return {road: tuple(sorted(types)) for road, types in found.items()}


def junction_types(document: Document) -> dict[str, str]:
    """Id of each junction → its type (ASAM OpenDRIVE 1.8, 12: one that does not say is ``default``)."""
    table = document["junction"]
    pairs = zip(table.texts("id"), table.texts("type", "default"), strict=True)
    return {name: kind.strip() or "default" for name, kind in pairs}


def containment(document: Document, road: Ints) -> list[Edge]:
    """``isIn``: lanes in their roads, roads in their junctions. They stand in the order of their nodes.

    ``road``: rows of the roads of all lanes.
    """
    first_road = FIRST_LANE + len(road)
    first_junction = first_road + len(document["road"])
    junctions: dict[str, int] = {}
    for row, name in enumerate(document["junction"].texts("id")):
        junctions.setdefault(name, row)
    pairs = [
        (row, junctions[name])
        for row in range(len(document["road"]))
        if (name := junction_of(document, row)) in junctions
    ]
    roads, within = np.array(pairs, np.int64).reshape(-1, 2).T
    every = np.arange(len(road))
    return [
        ("isIn", FIRST_LANE + every, first_road + road),
        ("isIn", first_road + roads, first_junction + within),
    ]
