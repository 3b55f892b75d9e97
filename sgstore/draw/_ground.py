"""Drawing of the ground of a frame: lanes, markings, crosswalks, scenery, distance rings, scale, compass."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakKeyDictionary

import numpy as np
from matplotlib.patches import Circle
from matplotlib.path import Path as Outline

import sgstore.draw._page as layers
import sgstore.draw._palette as palette
from sgstore.draw._view import SCENERY
from sgstore.maps.roads import DrawnOutlines, RoadMap
from sgstore.model.vocabulary import KINDS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.draw._page import Rect, Stage
    from sgstore.draw._view import MapWindow
    from sgstore.maps.roads import MapNodes
    from sgstore.model.world import Floats


STOREY_HEIGHT: Final = 4.0
"""Smallest difference in height for which one lane is drawn above another; m. Crossing roads have a larger
clearance."""
MOST_STOREYS: Final = 12

_SHAPES: Final[WeakKeyDictionary[RoadMap, dict[int, tuple[Any, Outline | None]]]] = (
    WeakKeyDictionary()
)
"""Cached outlines of each map in map axes, by row, with their source geometry."""


@dataclass(frozen=True, slots=True)
class GroundView:
    """Part of a road map that is visible in a picture.

    Attributes
    ----------
    road_map : RoadMap
    view : MapWindow
    outlines : list
        A shapely geometry, or ``None``, for every node of the map.
    rows : list of int
        Rows of the nodes in view.
    """

    road_map: RoadMap
    view: MapWindow
    outlines: list[Any]
    rows: list[int]

    @classmethod
    def of(cls, road_map: RoadMap, view: MapWindow) -> GroundView:
        """Return the part of a road map that is visible in a window."""
        reach = view.radius * math.sqrt(2)
        _, near = road_map.near(np.array([view.x]), np.array([view.y]), reach)
        rows = sorted(set((-1 - near).tolist()))
        return cls(road_map, view, list(road_map.outlines()), rows)

    @property
    def nodes(self) -> MapNodes:
        """Return all nodes of the road map."""
        return self.road_map.nodes

    def of_kind(self, *kinds: str) -> list[int]:
        """Return the indices of visible map nodes of the given kinds that have an outline."""
        return [
            r
            for r in self.rows
            if KINDS[self.nodes.kind[r]] in kinds and self.outlines[r] is not None
        ]

    def storeys(self) -> dict[int, int]:
        """Return the level of each visible lane, by node index. Level 0 is the lowest; bridges are higher."""
        rows = self.of_kind("lane")
        z = self.nodes.z[rows]
        low, high = np.nanmin(z, initial=np.inf), np.nanmax(z, initial=-np.inf)
        step = max(STOREY_HEIGHT, (high - low) / MOST_STOREYS)
        levels = np.nan_to_num((z - low) / step).astype(int)
        return dict(zip(rows, levels.tolist(), strict=True))

    def cover(self, places: Floats, z: Floats) -> Floats:
        """For each point (N, 2) with height ``z``, return how far the highest lane at the point is above it; m.

        The value is -inf where there is no lane.

        The height of a lane is that of its nearest cross section.
        """
        found = np.full(len(places), -np.inf)
        ribbons = self.road_map.ribbons
        for row in self.of_kind("lane"):
            if not 1 <= row < len(ribbons.offsets):
                continue
            inside = np.flatnonzero(RoadMap.within(self.outlines[row], places))
            if not len(inside):
                continue
            part = slice(*ribbons.offsets[row - 1 : row + 1].tolist())
            x, y = (
                (getattr(ribbons, f"left_{axis}") + getattr(ribbons, f"right_{axis}"))[part] / 2
                for axis in "xy"
            )
            away = np.hypot(places[inside, :1] - x, places[inside, 1:] - y)
            height = ribbons.z[part][away.argmin(axis=1)] - z[inside]
            found[inside] = np.fmax(found[inside], height)
        return found

    def outline(self, row: int) -> Outline | None:
        """If a map node has an area, return its outline in picture coordinates; otherwise ``None``."""
        known = _SHAPES.setdefault(self.road_map, {})
        shape = self.outlines[row]
        if row not in known or known[row][0] is not shape:
            rings = [ring for ring in rings_of(shape) if _is_closed(ring)]
            paths = [Outline(ring, closed=True) for ring in rings]
            known[row] = shape, Outline.make_compound_path(*paths) if paths else None
        path = known[row][1]
        return (
            None
            if path is None
            else Outline(self.view.place(np.asarray(path.vertices)), path.codes)
        )

    def open_lines(self, rows: Iterable[int]) -> list[Floats]:
        """Return the open lines of several map nodes, such as barriers, in picture coordinates."""
        rings = [ring for row in rows for ring in rings_of(self.outlines[row])]
        return [self.view.place(ring) for ring in rings if not _is_closed(ring)]

    def outlines_of(self, rows: Iterable[int]) -> list[Outline]:
        """Return the outlines of several map nodes in picture coordinates."""
        return [o for row in rows if (o := self.outline(row)) is not None]

    def parts(self, node: int) -> list[int]:
        """Return the map nodes to draw for a node: the lanes of a road or junction, or only the node itself."""
        row = -1 - node
        if not 0 <= row < len(self.outlines):
            return []
        kind, name = KINDS[self.nodes.kind[row]], self.nodes.name[row]
        if kind == "roundabout":
            edges = self.road_map.edges
            roads = [int(src) for src in edges.src[edges.dst == node]]
            return [part for road in roads for part in self.parts(road)]
        if kind in {"road", "junction"}:
            column = self.nodes.road if kind == "road" else self.nodes.junction
            return [r for r in self.of_kind("lane") if column[r] == name]
        return [row] if self.outlines[row] is not None else []

    def sides(self, row: int) -> tuple[Floats, Floats] | None:
        """Return the left and right border of a lane in its direction of travel; two arrays (N, 2).

        ``None`` for other nodes.
        """
        ribbons = self.road_map.ribbons
        if not 1 <= row < len(ribbons.offsets):
            return None
        part = slice(*ribbons.offsets[row - 1 : row + 1].tolist())
        left = np.column_stack((ribbons.left_x[part], ribbons.left_y[part]))
        right = np.column_stack((ribbons.right_x[part], ribbons.right_y[part]))
        return self.view.place(left), self.view.place(right)

    def middles(self, node: int) -> Floats:
        """Return visible points (N, 2) along the middle of a map part, in picture coordinates."""
        points: list[Floats] = []
        for row in self.parts(node):
            sides = self.sides(row)
            if sides is not None:
                points.append(_dense((sides[0] + sides[1]) / 2))
            else:
                rings = rings_of(self.outlines[row])
                points += [
                    self.view.place(ring[:-1].mean(axis=0)) for ring in rings if len(ring) > 1
                ]
        return np.concatenate(points) if points else np.empty((0, 2))

    def spot(self, node: int) -> tuple[float, float] | None:
        """Return a visible point of a map part at which to write its name; ``None`` if the part is not visible.

        On a lane it is on the middle line, if possible at least 8 m from the middle of the picture.
        """
        points = self.middles(node)
        points = points[np.abs(points).max(axis=1, initial=0.0) <= 0.88 * self.view.radius]
        away = np.hypot(*points.T)
        return _point(points, np.where(away >= 8.0, away, 1e6 - away))

    def nearest(self, node: int, to: tuple[float, float]) -> tuple[float, float] | None:
        """Return the point on the middle line of a map part that is nearest to a given point."""
        points = self.middles(node)
        return _point(points, np.hypot(*(points - to).T))


def paint_ground(stage: Stage, ground: GroundView, *, arrows: bool = True) -> None:
    """Draw the lanes by type, borders, direction arrows, crosswalks and scenery of a road map."""
    nodes = ground.nodes
    storeys = ground.storeys()
    for level in range(max(storeys.values(), default=-1) + 1):
        lanes = [row for row, storey in storeys.items() if storey == level]
        _paint_lanes(stage, ground, lanes, level, arrows=arrows)
    for row in ground.of_kind("crosswalk"):
        stage.fill_all(_stripes(ground, row), palette.CROSSWALK, z=layers.MARKS, edge=0.0)
    for row in ground.of_kind(*SCENERY, "unknown"):
        colour = palette.entity_tint(KINDS[int(nodes.kind[row])])
        # Props of a map are often areas, such as traffic islands: objects on them must stay
        # visible.
        thin = 0.18 if KINDS[nodes.kind[row]] == "prop" else 1.0
        stage.fill_all(ground.outlines_of([row]), colour, z=layers.SCENERY, edge=0.8, alpha=thin)
        stage.lines(ground.open_lines([row]), colour, z=layers.SCENERY, width=1.2)


def _paint_lanes(
    stage: Stage, ground: GroundView, lanes: list[int], level: int, *, arrows: bool
) -> None:
    types = ground.nodes.lane_type
    by_tint: dict[str, list[int]] = {}
    for row in sorted(lanes, key=lambda r: (types[r] in palette.TRAVELLED, types[r], r)):
        by_tint.setdefault(palette.lane_tint(types[row]), []).append(row)
    z = layers.LANES + level * layers.STOREY
    for colour, rows in by_tint.items():
        stage.fill_all(ground.outlines_of(rows), colour, z=z)
    marked = [r for r in lanes if types[r] in palette.TRAVELLED and not ground.nodes.junction[r]]
    sides = [side for row in marked if (side := ground.sides(row)) is not None]
    borders = [border for pair in sides for border in pair]
    z += 0.8 * layers.STOREY
    # Parking spaces are on lanes or next to them; they have no lane number.
    spaces = [r for r in lanes if types[r] == "parking" and not ground.nodes.lane[r]]
    outlines = ground.outlines_of(spaces)
    stage.fill_all(outlines, palette.lane_tint("parking"), z=z - 0.4 * layers.STOREY)
    borders += [np.asarray(outline.vertices) for outline in outlines]
    stage.lines(borders, palette.LANE_MARK, z=z, width=min(0.7, 0.16 * stage.points))
    if arrows:
        heads = [head for left, right in sides for head in _chevrons((left + right) / 2)]
        stage.lines(heads, palette.LANE_ARROW, z=z, width=1.1, capstyle="round")


def tint(stage: Stage, ground: GroundView, node: int, colour: str, alpha: float) -> None:
    """Colour a map part with a transparent colour. In an SVG file, the shape gets the id of the node."""
    parts = ground.parts(node)
    outlines, gid = ground.outlines_of(parts), f"node-{node}"
    if outlines:
        whole = Outline.make_compound_path(*outlines)
        storeys = ground.storeys()
        level = max((storeys.get(row, 0) for row in parts), default=0)
        z = layers.LANES + (level + 0.4) * layers.STOREY
        stage.fill(whole, colour, z=z, alpha=alpha, gid=gid)
    stage.lines(ground.open_lines(parts), colour, z=layers.TINTS, width=5.0, gid=gid)


def rings_of(geometry: Any) -> list[Floats]:
    """Return all rings and lines of a shapely geometry, each (N, 2) float64; empty for points."""
    if geometry is None or geometry.is_empty:
        return []
    match geometry.geom_type:
        case "Polygon":
            return [
                np.asarray(ring.coords)[:, :2] for ring in (geometry.exterior, *geometry.interiors)
            ]
        case "LineString" | "LinearRing":
            return [np.asarray(geometry.coords)[:, :2]]
        case "MultiPolygon" | "MultiLineString" | "GeometryCollection":
            return [ring for part in geometry.geoms for ring in rings_of(part)]
        case _:
            return []


def _is_closed(ring: Floats) -> bool:
    return len(ring) > 2 and bool((ring[0] == ring[-1]).all())


def _chevrons(line: Floats) -> list[Floats]:
    """Return arrow heads, as lines, at equal distances along a line. A short line has none."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    along = np.concatenate(((0.0,), np.cumsum(steps)))
    count = round(along[-1] / DrawnOutlines.ARROW_SPACING)
    # A lane in tiny pieces has no room for arrows; a lane of absurd length needs no more.
    if not 1 <= count <= 2000:
        return []
    at = (np.arange(count) + 0.5) * along[-1] / count
    place = np.column_stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)])
    ahead = np.column_stack([np.interp(at + 0.5, along, line[:, axis]) for axis in (0, 1)])
    return [_chevron(p, math.atan2(*(a - p)[::-1])) for p, a in zip(place, ahead, strict=True)]


def _chevron(place: Floats, angle: float) -> Floats:
    head = np.array(((-0.5, 0.55), (0.4, 0.0), (-0.5, -0.55)))
    cos, sin = math.cos(angle), math.sin(angle)
    return head @ np.array(((cos, sin), (-sin, cos))) + place


def _stripes(ground: GroundView, row: int) -> list[Outline]:
    """Return the outlines of the zebra stripes of a crosswalk."""
    rings = rings_of(ground.outlines[row].minimum_rotated_rectangle)
    if not rings or len(rings[0]) != 5:
        return ground.outlines_of([row])
    corners = ground.view.place(rings[0])
    a, b, d = corners[0], corners[1], corners[3]
    walk, across = (b - a, d - a) if np.hypot(*(b - a)) >= np.hypot(*(d - a)) else (d - a, b - a)
    count = max(2, min(200, round(float(np.hypot(*walk)) / 1.1)))
    edges = (np.arange(count)[:, None] + (0.25, 0.75)) / count
    return [
        Outline(
            np.array((a + p * walk, a + q * walk, a + q * walk + across, a + p * walk + across))
        )
        for p, q in edges
    ]


def _point(points: Floats, cost: Floats) -> tuple[float, float] | None:
    """Return the point with the lowest cost; ``None`` if the list of points is empty."""
    if not len(points):
        return None
    x, y = points[cost.argmin()].tolist()
    return x, y


def _dense(line: Floats) -> Floats:
    """Return a line with additional points every few metres, so that a long lane has visible points."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    along = np.concatenate(((0.0,), np.cumsum(steps)))
    at = np.linspace(0.0, along[-1], int(np.clip(along[-1] / 2.0, 2, 1000)))
    return np.column_stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)])


_LENGTHS: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000)
_SMALL: Final = {"fontsize": 6.5, "ha": "center"}


def paint_rings(stage: Stage) -> list[Rect]:
    """Draw circles at some distances from the middle of the picture. Return the rectangles of their labels."""
    taken: list[Rect] = []
    for metres in (10, 25, 50, 100, 200):
        if metres > stage.view.radius * 1.05:
            break
        ring = Circle(
            (0, 0),
            metres,
            fill=False,
            edgecolor=palette.RING,
            linewidth=0.5,
            linestyle=(0, (2, 4)),
            zorder=layers.RINGS,
        )
        stage.page.add(stage.axes, ring)
        at = metres * math.sqrt(0.5)
        look = _SMALL | {"fontsize": 5.5, "color": palette.FAINT_INK, "va": "center"}
        stage.text(at, -at, f"{metres} m", zorder=layers.RINGS, **look)
        taken.append(stage.rect(9 * stage.metre, 4 * stage.metre, (at, -at)))
    return taken


def paint_scale(stage: Stage) -> Rect:
    """Draw a scale bar of a round length in the lower left corner; return its rectangle."""
    half_x, half_y = stage.half
    metres = max(m for m in _LENGTHS if m <= max(1.0, min(half_x, half_y) / 2.2))
    margin, tick = 12 * stage.metre, 3 * stage.metre
    left, bottom, right = -half_x + margin, -half_y + margin, -half_x + margin + metres
    bar = ((left, bottom + tick), (left, bottom), (right, bottom), (right, bottom + tick))
    stage.lines([np.array(bar)], palette.INK, z=layers.FURNITURE, width=1.1)
    stage.text((left + right) / 2, bottom + tick, f"{metres} m", zorder=layers.FURNITURE, **_SMALL)
    return stage.rect(metres / 2, 8 * stage.metre, ((left + right) / 2, bottom))


def paint_compass(stage: Stage) -> Rect:
    """Draw a north arrow in the upper right corner; return its rectangle."""
    reach = min(11 * stage.metre, 0.05 * min(stage.half))
    middle = np.array(stage.half) - 1.8 * reach
    angle = stage.view.angle(math.pi / 2)
    north = np.array((math.cos(angle), math.sin(angle))) * reach
    aside = np.array((-north[1], north[0]))
    x, y = middle.tolist()
    dial = Circle(
        (x, y), 1.55 * reach, facecolor=palette.PAPER, alpha=0.75, zorder=layers.FURNITURE
    )
    stage.page.add(stage.axes, dial)
    for colour, wing in ((palette.INK, 0.45 * aside), (palette.FAINT_INK, -0.45 * aside)):
        half = np.array((0.75 * north, -north + wing, -0.65 * north))
        stage.fill(Outline(middle + half), colour, z=layers.FURNITURE + 0.1)
    x_n, y_n = (middle + 1.12 * north).tolist()
    look = {"fontsize": 0.6 * reach * stage.points, "ha": "center", "va": "center"}
    stage.text(x_n, y_n, "N", zorder=layers.FURNITURE + 0.2, weight="bold", **look)
    return stage.rect(1.6 * reach, 1.6 * reach, (x, y))
