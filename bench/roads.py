"""How fast maps are read and asked, beside shapely, and LibCarla where the ``carla`` wheel is installed.

::

    python -m bench roads [--quick]

The maps are made up: a quarter of a town like CARLA's Town01, and a city of more than 20 MB; and the towns of
CARLA where the data folder (``SGSTORE_DATA``) is present. Times are the process's own processor time, so that
neighbours on the machine count less.
"""

from __future__ import annotations

import math
import os
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from bench.measure import Measure
from sgstore.maps.opendrive import parse_map, read_map
from sgstore.model.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.maps.roads import RoadMap

APART = 120.0
"""Distance of junctions; m."""
HALF = 15.0
"""How far a junction reaches from its centre; m."""
ARMS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
FOOTPRINTS = 100_000
POINTS = 20_000
TOWNS = ("Town01", "Town02", "Town07")
LIMITS = {"town": 0.15, "city": 2.0, "Town01": 0.15, "Town02": 0.15}
"""Seconds that reading a map may take."""


def city(streets: int, records: int) -> str:
    """OpenDRIVE text of a grid of streets both ways, each junction with its twelve ways through.

    ``records``: how many widths, marks and elevations a street has, as an editor writes them.
    """
    parts: list[str] = []
    junctions: list[str] = []
    names = {}
    for i in range(streets):
        for j in range(streets):
            for axis, (di, dj) in enumerate(((1, 0), (0, 1))):
                if i + di < streets and j + dj < streets:
                    names[(i, j), (i + di, j + dj)] = f"{2 * (i * streets + j) + axis}"
    for ((i, j), (k, m)), name in names.items():
        parts.append(street(name, (i, j), (k, m), streets, records))
    for i in range(streets):
        for j in range(streets):
            ways, connections = crossing(i, j, streets, names)
            parts += ways
            number = junction_name(i, j, streets)
            junctions.append(f'<junction id="{number}" name="">{"".join(connections)}</junction>')
    header = '<header revMajor="1" revMinor="6" name="city"/>'
    return f"<OpenDRIVE>{header}{''.join(parts)}{''.join(junctions)}</OpenDRIVE>"


def junction_name(i: int, j: int, streets: int) -> int:
    return 900_000 + i * streets + j


def record(tag: str, start: str, s: float, a: float, more: str = "") -> str:
    zeros = " ".join(f'{letter}="{0:.16e}"' for letter in "bcd")
    return f'<{tag} {start}="{s:.16e}" a="{a:.16e}" {zeros}{more}/>'


def lane(number: int, kind: str, width: float, at: list[float], links: bool) -> str:
    link = f'<link><predecessor id="{number}"/><successor id="{number}"/></link>' if links else ""
    widths = "".join(record("width", "sOffset", s, width) for s in at)
    marks = "".join(
        f'<roadMark sOffset="{s:.16e}" type="broken" material="standard" color="white" laneChange="none"/>'
        for s in at
    )
    return f'<lane id="{number}" type="{kind}" level="false">{link}{widths}{marks}</lane>'


def street(
    name: str, start: tuple[int, int], end: tuple[int, int], streets: int, records: int
) -> str:
    """A straight street from the edge of one junction to the edge of the next."""
    heading = math.atan2(end[1] - start[1], end[0] - start[0])
    length = APART - 2 * HALF
    x, y = start[0] * APART + HALF * math.cos(heading), start[1] * APART + HALF * math.sin(heading)
    at = [length * k / records for k in range(records)]
    kinds = ((1, "driving", 3.5), (2, "shoulder", 1.0), (3, "sidewalk", 2.0))
    left = "".join(lane(n, kind, width, at, links=True) for n, kind, width in reversed(kinds))
    right = "".join(lane(-n, kind, width, at, links=True) for n, kind, width in kinds)
    links = "".join(
        f'<{tag} elementType="junction" elementId="{junction_name(*place, streets)}"/>'
        for tag, place in (("predecessor", start), ("successor", end))
    )
    elevation = "".join(record("elevation", "s", s, 0.0) for s in at)
    offset = "".join(record("laneOffset", "s", s, 0.0) for s in at)
    return (
        f'<road name="Road {name}" length="{length:.16e}" id="{name}" junction="-1"><link>{links}</link>'
        f'<planView><geometry s="0" x="{x:.16e}" y="{y:.16e}" hdg="{heading:.16e}" length="{length:.16e}">'
        f"<line/></geometry></planView><elevationProfile>{elevation}</elevationProfile><lanes>{offset}"
        f'<laneSection s="0"><left>{left}</left><center><lane id="0" type="none"/></center>'
        f"<right>{right}</right></laneSection></lanes></road>"
    )


def crossing(i: int, j: int, streets: int, names: dict[Any, str]) -> tuple[list[str], list[str]]:
    """The connecting roads of a junction, and its connections."""
    ways: list[str] = []
    connections: list[str] = []
    arms = [
        (arm, names.get(((i, j), place)), names.get((place, (i, j))))
        for arm, place in ((arm, (i + int(arm[0]), j + int(arm[1]))) for arm in ARMS)
    ]
    arms = [arm for arm in arms if arm[1] or arm[2]]
    for into in arms:
        for out in arms:
            if into is out:
                continue
            name = f"{1_000_000 + 100 * (i * streets + j) + len(ways)}"
            ways.append(way(name, (i, j), into, out, junction_name(i, j, streets)))
            source = 1 if into[1] else -1  # streets run away from the junction they start at
            connections.append(
                f'<connection id="{len(ways)}" incomingRoad="{into[1] or into[2]}" connectingRoad="{name}"'
                f' contactPoint="start"><laneLink from="{source}" to="-1"/></connection>'
            )
    return ways, connections


def way(name: str, place: tuple[int, int], into: Any, out: Any, junction: int) -> str:
    """A connecting road from one arm of a junction to another: straight, or a quarter of a circle."""
    (ix, iy), (ox, oy) = into[0], out[0]
    heading = math.atan2(-iy, -ix)
    turn = ix * -oy - iy * -ox
    x, y = place[0] * APART + HALF * ix, place[1] * APART + HALF * iy
    length = HALF * math.pi / 2 if turn else 2 * HALF
    shape = f'<arc curvature="{turn / HALF:.16e}"/>' if turn else "<line/>"
    links = "".join(
        f'<{tag} elementType="road" elementId="{starts or ends}" contactPoint="{contact}"/>'
        for tag, (_, starts, ends) in (("predecessor", into), ("successor", out))
        for contact in ("start" if starts else "end",)
    )
    after = -1 if out[1] else 1
    lanes = (
        f'<lane id="-1" type="driving"><link><successor id="{after}"/></link>'
        f"{record('width', 'sOffset', 0.0, 3.5)}</lane>"
    )
    return (
        f'<road name="" length="{length:.16e}" id="{name}" junction="{junction}"><link>{links}</link>'
        f'<planView><geometry s="0" x="{x:.16e}" y="{y:.16e}" hdg="{heading:.16e}" length="{length:.16e}">'
        f"{shape}</geometry></planView>"
        '<lanes><laneSection s="0"><center><lane id="0" type="none"/></center>'
        f"<right>{lanes}</right></laneSection></lanes></road>"
    )


def timed(work: Callable[[], object], times: int) -> float:
    """Processor seconds that the work takes, the least of several times."""
    best = math.inf
    for _ in range(times):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def footprints(road_map: RoadMap, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Cars on driving lanes, spread evenly along them, a little askew."""
    rng = np.random.default_rng(0)
    points = road_map.waypoints(1.0)
    driving = np.array(
        [kind == "driving" for kind in road_map.nodes.lane_type[1 : 1 + len(road_map.ribbons)]]
    )
    rows = rng.choice(np.flatnonzero(driving[points.lane]), n)
    aside = rng.uniform(-0.4, 0.4, n) * points.width[rows]
    heading = points.heading[rows] + rng.normal(0, 0.1, n)
    boxes = np.column_stack(
        (
            points.x[rows] - np.sin(points.heading[rows]) * aside,
            points.y[rows] + np.cos(points.heading[rows]) * aside,
            heading,
            np.full(n, 4.5),
            np.full(n, 2.0),
        )
    )
    return boxes, points.z[rows]


def by_shapely(road_map: RoadMap, boxes: np.ndarray) -> int:
    """The same question put to shapely: intersecting lanes, and the shares of the area."""
    lanes = road_map.outlines()[1 : 1 + len(road_map.ribbons)]
    along, across = np.array([1, -1, -1, 1]) * 2.25, np.array([1, 1, -1, -1])
    cos, sin = np.cos(boxes[:, 2:3]), np.sin(boxes[:, 2:3])
    corners = (
        boxes[:, :1] + cos * along - sin * across,
        boxes[:, 1:2] + sin * along + cos * across,
    )
    shapes: Any = shapely.polygons(np.stack(corners, axis=-1))
    row, lane = shapely.STRtree(lanes).query(shapes, predicate="intersects")
    shapely.area(shapely.intersection(shapes[row], lanes[lane]))
    return len(row)


def look_ups(name: str, road_map: RoadMap, n: int, times: int) -> list[Measure]:
    """Footprints a second, ours and shapely's."""
    boxes, z = footprints(road_map, n)
    few = min(n, 2_000)
    road_map.lanes_of(boxes[:1], z[:1])
    ours = timed(partial(road_map.lanes_of, boxes, z), times)
    peer = timed(partial(by_shapely, road_map, boxes[:few]), 1) * n / few
    egos = boxes[:60, 0], boxes[:60, 1], 50.0
    road_map.near(*egos)
    return [
        Measure(
            f"{name}, lanes and shares of {n:,} footprints",
            ours,
            "s",
            f"{peer / ours:.0f} times shapely's speed; of 100,000 at most 1.5 s",
        ),
        Measure(
            f"{name}, within 50 m of 60 egos",
            timed(partial(road_map.near, *egos), times) * 1e3,
            "ms",
        ),
    ]


def beside_carla(name: str, text: str, road_map: RoadMap, times: int) -> list[Measure]:
    """LibCarla's times for reading the same map, and for one lane of a point."""
    try:
        import carla
    except ImportError:
        return []
    peer = carla.Map(name, text)
    boxes, z = footprints(road_map, POINTS)
    places = [
        carla.Location(x=x, y=-y, z=height) for (x, y), height in zip(boxes[:, :2], z, strict=True)
    ]
    boxes[:, 3:] = 0.0
    ours = timed(partial(road_map.lanes_of, boxes, z), times)
    theirs = timed(lambda: [peer.get_waypoint(place) for place in places], 1)
    return [
        Measure(f"{name}, read by LibCarla", timed(partial(carla.Map, name, text), times), "s"),
        Measure(
            f"{name}, lanes of {POINTS:,} points",
            ours,
            "s",
            f"{theirs / ours:.1f} times the speed of carla.Map.get_waypoint, one lane a point",
        ),
    ]


def maps() -> Iterator[tuple[str, str]]:
    """Names and texts of the maps, made up and real."""
    yield "town", city(4, 20)
    yield "city", city(17, 18)
    default = Path(__file__).parents[1] / "../shared/data"
    folder = Path(os.environ.get("SGSTORE_DATA") or default) / "maps"
    for name in TOWNS:
        if (folder / f"{name}.xodr").is_file():
            yield name, (folder / f"{name}.xodr").read_text(encoding="utf-8")


def run(quick: bool = False) -> list[Measure]:
    """Reading and asking towns and a city."""
    times = 1 if quick else 3
    table: list[Measure] = []
    for name, text in maps():
        road_map = parse_map(text, name)
        links = int((road_map.edges.relation == RELATION_CODE["travelsTo"]).sum())
        size = len(text) / 1e6
        note = f"{size:.1f} MB, {len(road_map.ribbons):,} lanes, {links:,} links"
        limit = f"; at most {LIMITS[name]} s" if name in LIMITS else ""
        read = timed(partial(parse_map, text, name), times)
        table.append(Measure(f"{name}, read", read, "s", note + limit))
        read_map(text, name)
        again = timed(partial(read_map, text, name), times)
        table.append(Measure(f"{name}, read again", again * 1e6, "µs"))
        table += look_ups(name, road_map, FOOTPRINTS // (10 if quick else 1), times)
        table += beside_carla(name, text, road_map, times)
    return table
