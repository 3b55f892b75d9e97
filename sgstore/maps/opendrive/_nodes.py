"""Map nodes (lanes, roads, junctions) of an OpenDRIVE map, and the edges between them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.maps.opendrive._network import junction_ends
from sgstore.maps.opendrive._piecewise import last_before
from sgstore.maps.roads import MapNodes, conflicts, turn_words
from sgstore.model.vocabulary import DRIVING, TRAFFIC

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.maps.opendrive._document import Document
    from sgstore.maps.opendrive._lanes import LaneTable
    from sgstore.maps.roads import Edge, Ribbons
    from sgstore.model.world import Bools, Floats, Ints

NARROW: Final = 1e-2
"""Width that a lane must exceed somewhere, or else the lanes on both sides of it are neighbours; m."""

SPEED_UNITS: Final = {"": 1.0, "m/s": 1.0, "mph": 0.44704, "km/h": 1 / 3.6, "kmh": 1 / 3.6}
"""Unit of speed → factor to m/s, as in ASAM OpenDRIVE 1.8 (``e_unitSpeed``)."""

FIRST_LANE: Final = 1
"""Row of the first lane among the map nodes, because row 0 is ``off_road``."""


def lane_nodes(document: Document, lanes: LaneTable, ribbons: Ribbons) -> MapNodes:
    """Return one map node per OpenDRIVE lane, with type, length, speed limit and so on."""
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
        width=ribbons.mean_widths(),
        speed_limit=_speed_limits(document, lanes),
    )


def junction_of(document: Document, road: int) -> str:
    """Return the id of the junction to which a road belongs; empty if it belongs to none."""
    junction = document["road"].attributes[road].get("junction", "-1")
    return "" if junction == "-1" else junction


def _turns(document: Document, lanes: LaneTable, ribbons: Ribbons) -> tuple[str, ...]:
    """Return the turn direction of each lane in a junction. All sections of a road have the same one."""
    sign = np.where(lanes.forward, 1.0, -1.0)
    _, one = np.unique(lanes.section, return_index=True)
    of_road = np.zeros(len(document["road"]))
    np.add.at(of_road, lanes.road[one], (ribbons.turned() * sign)[one])
    turn = of_road[lanes.road] * sign
    return tuple(
        word if junction_of(document, road) else ""
        for word, road in zip(turn_words(turn), lanes.road.tolist(), strict=True)
    )


def _speed_limits(document: Document, lanes: LaneTable) -> Floats:
    """Return the speed limit in the middle of each lane: that of the lane, or else of the road; m/s."""
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
    """Return an OpenDRIVE speed in m/s. NaN for ``no limit``, ``undefined`` and invalid values."""
    try:
        metres = float(value) * SPEED_UNITS[unit.strip().lower()]
    except (ValueError, KeyError):
        return np.nan
    return metres if 0 < metres < 1000 else np.nan


def wide_pairs(lanes: LaneTable, ribbons: Ribbons) -> Ints:
    """Return pairs of lanes (2, n) that share a border, the left lane first."""
    return _pairs(lanes, np.flatnonzero(ribbons.mean_widths() > NARROW))


def neighbours(lanes: LaneTable, ribbons: Ribbons) -> list[Edge]:
    """Return the map edges ``toLeftOf``, ``toRightOf`` and ``opposes`` between lanes.

    Neighbours share a border. Lanes of traffic with only lanes without traffic between them (a
    median, a strip of grass) are also neighbours, because drivers look across it.
    """
    wide = np.flatnonzero(ribbons.mean_widths() > NARROW)
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


def _pairs(lanes: LaneTable, rows: Ints) -> Ints:
    """Return pairs of adjacent lanes (2, n) in the same lane section, among the given lanes."""
    same: Bools = np.diff(lanes.section[rows]) == 0
    return np.stack((rows[:-1][same], rows[1:][same]))


def flow_edges(
    lanes: LaneTable, nodes: MapNodes, ribbons: Ribbons, flow: tuple[Ints, Ints]
) -> list[Edge]:
    """Return the map edges ``travelsTo`` (successor) and ``conflictsWith`` (crossing) between lanes."""
    crossing = [
        lane
        for lane, (kind, junction) in enumerate(zip(lanes.type, nodes.junction, strict=True))
        if junction and kind in DRIVING
    ]
    one, other = conflicts(ribbons, np.array(crossing, np.int64), nodes.junction, flow)
    both = np.concatenate((one, other)), np.concatenate((other, one))
    return [
        ("travelsTo", flow[0] + FIRST_LANE, flow[1] + FIRST_LANE),
        ("conflictsWith", both[0] + FIRST_LANE, both[1] + FIRST_LANE),
    ]


def road_nodes(document: Document) -> list[MapNodes]:
    """Return one map node per road, junction and roundabout of an OpenDRIVE map."""
    every = range(len(document["road"]))
    road = MapNodes.of(
        "road",
        document.road_ids,
        length=document.numbers("road", "length"),
        road=tuple(document.road_ids),
        junction=tuple(junction_of(document, row) for row in every),
    )
    names = document["junction"].texts("id")
    junction = MapNodes.of("junction", names, junction=tuple(names))
    return [road, junction, MapNodes.of("roundabout", [*_roundabouts(document)])]


def _roundabouts(document: Document) -> dict[str, set[str]]:
    """Return the roundabouts of an OpenDRIVE map with their junctions: id → junction ids."""
    groups, members = document["junctionGroup"], document["junctionGroup/junctionReference"]
    names, found = groups.texts("id"), dict[str, set[str]]()
    kinds = groups.texts("type")
    for group, junction in zip(members.parent, members.texts("junction"), strict=True):
        if kinds[group].strip() == "roundabout":
            found.setdefault(names[group], set()).add(junction)
    return found


def _in_roundabouts(document: Document) -> Iterator[tuple[int, int]]:
    """Yield pairs of node rows: a road, and the roundabout to which it belongs."""
    ends: list[list[str]] = [[] for _ in range(len(document["road"]))]
    for road, _, junction in junction_ends(document):
        ends[road].append(junction)
    for row, junctions in enumerate(_roundabouts(document).values()):
        for road, at in enumerate(ends):
            between = len(at) == 2 and junctions.issuperset(at)
            if between or junction_of(document, road) in junctions:
                yield road, row


def road_types(document: Document) -> dict[str, tuple[tuple[float, str], ...]]:
    """Return the types (such as ``town``) of each road: road → list of (start position, type)."""
    table = document["road/type"]
    found: dict[str, list[tuple[float, str]]] = {}
    places = document.rough_numbers("road/type", "s").tolist()
    for road, s, name in zip(table.road.tolist(), places, table.texts("type"), strict=True):
        found.setdefault(document.road_ids[road], []).append((s, name))
    return {road: tuple(sorted(types)) for road, types in found.items()}


def junction_types(document: Document) -> dict[str, str]:
    """Return the type of each OpenDRIVE junction, such as ``virtual``: junction id → type."""
    table = document["junction"]
    pairs = zip(table.texts("id"), table.texts("type", "default"), strict=True)
    return {name: kind.strip() or "default" for name, kind in pairs}


def containment(document: Document, road: Ints) -> list[Edge]:
    """Return the map edges ``isIn``: lanes in roads, roads in junctions and roundabouts.

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
    round_roads, around = np.array([*_in_roundabouts(document)], np.int64).reshape(-1, 2).T
    every = np.arange(len(road))
    return [
        ("isIn", FIRST_LANE + every, first_road + road),
        ("isIn", first_road + roads, first_junction + within),
        ("isIn", first_road + round_roads, first_junction + len(document["junction"]) + around),
    ]
