"""The example map of Lanelet2 as the package ``lanelet2`` reads it, beside what we make of it.

    python tests/reference/oracle_lanelet2.py [--write]

``--write`` keeps the answers of the package in ``tests/golden/lanelet2.json``, with which every run compares.
"""

from __future__ import annotations

import json
import os
import sys
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from sgstore.maps.lanelet2 import Projection, lanelet2_text
from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import DRIVING, KINDS, RELATIONS

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap

EXAMPLE = "maps/lanelet2/mapping_example.osm"
ORIGIN = (49.0, 8.4)
GOLDEN = Path(__file__).parents[1] / "golden" / "lanelet2.json"


def golden() -> dict[str, Any]:
    return json.loads(GOLDEN.read_text(encoding="utf-8"))


def as_told(road_map: RoadMap) -> dict[str, Any]:
    """What can be compared of our map of the file."""
    nodes, names = road_map.nodes, road_map.nodes.name
    kinds = [KINDS[code] for code in nodes.kind.tolist()]
    lanes = {row for row, kind in enumerate(kinds) if kind == "lane"}
    table = road_map.edges
    columns = (table.relation.tolist(), table.src.tolist(), table.dst.tolist())
    told: dict[str, list[list[str]]] = {}
    for code, src, dst in zip(*columns, strict=True):
        told.setdefault(RELATIONS[code], []).append([names[-1 - src], names[-1 - dst]])
    outlines = road_map.outlines()
    stop_lines = {int(part) for part in road_map.stop_lines}
    return {
        "lanes": {
            names[row]: [
                nodes.lane_type[row] in DRIVING,
                *np.round([outlines[row].centroid.x, outlines[row].centroid.y], 2).tolist(),
                round(outlines[row].area, 2),
            ]
            for row in sorted(lanes)
        },
        "crosswalks": sorted(names[row] for row, kind in enumerate(kinds) if kind == "crosswalk"),
        "successors": sorted(told["travelsTo"]),
        "left": sorted(told["toLeftOf"]),
        "right": sorted(told["toRightOf"]),
        "changes": sorted(told["laneChange"]),
        "stop_lines": {
            names[row]: np.round([nodes.x[row], nodes.y[row]], 2).tolist()
            for row in sorted(stop_lines)
        },
        "lights": {
            names[row]: [
                np.round([nodes.x[row], nodes.y[row]], 2).tolist(),
                sorted(lane for light, lane in told["controlsTrafficOf"] if light == names[row]),
            ]
            for row, kind in enumerate(kinds)
            if kind == "traffic_light"
        },
        "areas": {
            names[row]: [kind, *_ground(outlines[row])]
            for row, kind in enumerate(kinds)
            if kind in AREAS.values()
        },
    }


AREAS = {"building": "building", "vegetation": "vegetation", "traffic_island": "prop"}


def _ground(outline: Any) -> list[float]:
    """Its size, and where its middle is."""
    return np.round([outline.area, outline.centroid.x, outline.centroid.y], 2).tolist()


def by_library(path: Path) -> dict[str, Any]:
    """The same, as the package has it."""
    import lanelet2
    from lanelet2 import geometry
    from lanelet2.traffic_rules import Locations, Participants

    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(*ORIGIN))
    lanelets = lanelet2.io.load(str(path), projector)
    every = list(lanelets.laneletLayer)
    walks = {one.id for one in every if one.attributes["subtype"] == "crosswalk"}
    lanes = [one for one in every if one.id not in walks]
    rules = lanelet2.traffic_rules.create(Locations.Germany, Participants.Vehicle)
    driven = {one.id for one in lanes if rules.canPass(one)}
    graph = lanelet2.routing.RoutingGraph(lanelets, rules)

    def outline(lane: Any) -> shapely.Polygon:
        right, left = ([(p.x, p.y) for p in line] for line in (lane.rightBound, lane.leftBound))
        return shapely.Polygon([*right, *left[::-1]])

    def ways(lane: Any) -> list[Any]:
        """A lane as one may go along it."""
        return [lane] if rules.isOneWay(lane) else [lane, lane.invert()]

    def pairs(holds: Any, other_ways: Any) -> list[list[str]]:
        return sorted(
            [str(a.id), str(b.id)]
            for a, b in product(lanes, lanes)
            if a.id != b.id and any(holds(x, y) for x, y in other_ways(a, b))
        )

    def both(a, b):
        return [(a, b), (a.invert(), b)]

    def ends(a, b):
        return product(ways(a), ways(b))

    shapes = {str(one.id): outline(one) for one in lanes}
    # A lane that folds over itself has no outline of its own; ours is mended in the same way.
    mend = {"method": "structure", "keep_collapsed": False}
    shapes = {
        ident: s if s.is_valid else shapely.make_valid(s, **mend) for ident, s in shapes.items()
    }
    changes = {
        (str(one.id), str(to.id))
        for one in lanes
        if one.id in driven
        for to in (graph.left(one), graph.right(one))
        if to is not None
    }
    stops = {one for one in lanelets.lineStringLayer if _type(one) == "stop_line"}
    lights: dict[str, Any] = {}
    for lane in lanes:
        for light in lane.trafficLights():
            lamp = light.trafficLights[0]
            entry = lights.setdefault(str(light.id), [_middle(lamp), []])
            if lane.id in driven:
                entry[1].append(str(lane.id))
    return {
        "lanes": {
            str(lane.id): [
                lane.id in driven,
                *np.round(
                    [shapes[str(lane.id)].centroid.x, shapes[str(lane.id)].centroid.y], 2
                ).tolist(),
                round(shapes[str(lane.id)].area, 2),
            ]
            for lane in sorted(lanes, key=lambda lane: lane.id)
        },
        "crosswalks": sorted(map(str, walks)),
        "successors": pairs(geometry.follows, ends),
        "left": pairs(geometry.leftOf, both),
        "right": pairs(geometry.rightOf, both),
        "changes": sorted(map(list, changes)),
        "stop_lines": {str(one.id): _middle(one) for one in sorted(stops, key=lambda one: one.id)},
        "lights": {
            ident: [at, sorted(set(lanes))] for ident, (at, lanes) in sorted(lights.items())
        },
        "areas": {
            str(one.id): [
                AREAS[one.attributes["subtype"]],
                *_ground(shapely.Polygon([(p.x, p.y) for p in one.outerBoundPolygon()])),
            ]
            for one in sorted(lanelets.areaLayer, key=lambda one: one.id)
            if one.attributes["subtype"] in AREAS
        },
    }


def _type(line: Any) -> str:
    return line.attributes["type"] if "type" in line.attributes else ""  # noqa: SIM401 (no dict)


def _middle(line: Any) -> list[float]:
    return np.round(np.mean([(p.x, p.y) for p in line], axis=0), 2).tolist()


def main() -> int:
    path = Path(os.environ.get("SGSTORE_DATA", "../shared/data")) / EXAMPLE
    told = by_library(path)
    if "--write" in sys.argv:
        rows = (f'"{key}": {json.dumps(value)}' for key, value in told.items())
        GOLDEN.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    ours = as_told(read_map(lanelet2_text(text, Projection("LocalCartesianUTM", ORIGIN)), ""))
    differ = differences(ours, told)
    print(*differ, sep="\n")
    counts = {key: len(value) for key, value in told.items()}
    print(f"lanelet2 and we agree on {counts}" if not differ else f"{len(differ)} differences")
    return bool(differ)


def differences(ours: dict[str, Any], theirs: dict[str, Any]) -> list[str]:
    """Entries that one has and the other has not, or has otherwise; numbers to 2 cm and a thousandth."""
    found: list[str] = []
    for key, wanted in theirs.items():
        have = ours[key]
        if isinstance(wanted, list):
            missing = [one for one in wanted if one not in have]
            found += [f"{key}: we lack {one}" for one in missing]
            found += [f"{key}: they lack {one}" for one in have if one not in wanted]
            continue
        for ident in sorted({*wanted, *have}):
            if ident not in wanted or ident not in have:
                found.append(f"{key}: {ident} only with {'us' if ident in have else 'them'}")
            elif not _alike(have[ident], wanted[ident]):
                found.append(f"{key} {ident}: {have[ident]}, but they have {wanted[ident]}")
    return found


def _alike(one: Any, other: Any) -> bool:
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_alike, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) <= 0.02 + 0.001 * abs(other)
    return one == other


if __name__ == "__main__":
    sys.exit(main())
