"""Objects at OpenDRIVE roads: crosswalks, parking spaces, trees, buildings and so on.

An object has outlines, in its own axes (``cornerLocal``) or along the road (``cornerRoad``); or a
length and a width; or a radius; or it is a point. A ``repeat`` makes many objects of one: copies at
distances, or one strip along the road for distance 0. (ASAM OpenDRIVE 1.8, 13.) All corners of all
objects are placed at once. A parking space is a lane of type ``parking`` with two cross sections.
Paint on the road (stop lines, arrows, hatchings) has no node.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import shapely

from sgstore.maps.opendrive._positions import node_columns, places, standing
from sgstore.maps.opendrive._signals import is_signal_object
from sgstore.maps.roads import MapNodes, PlainLane
from sgstore.model.vocabulary import KIND_CODE

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.maps.opendrive._document import Document
    from sgstore.maps.opendrive._plan_view import PlanView
    from sgstore.model.world import Floats, Ints


PARKING: Final = "parking"
"""Kind that marks a parking space. It becomes a lane of this type, not an entity."""
PAINT: Final = "paint"
"""Kind that marks paint on the road, which does not become an entity."""

KIND_OF_TYPE: Final = {
    **dict.fromkeys(
        ("barrier", "railing", "soundbarrier", "wall", "fence", "guardrail"), "barrier"
    ),
    **dict.fromkeys(("building", "house", "tunnel", "bridge"), "building"),
    **dict.fromkeys(("pole", "streetlamp", "lamp", "post"), "pole"),
    **dict.fromkeys(("tree", "vegetation", "bush", "forest"), "vegetation"),
    **dict.fromkeys(("obstacle", "trafficisland", "gantry", "wind"), "prop"),
    **dict.fromkeys(("roadmark", "roadsurface", "patch"), PAINT),
    **{kind: kind for kind in ("car", "van", "bus", "trailer", "train", "crosswalk")},
    "bike": "bicycle",
    "motorbike": "motorcycle",
    "tram": "train",
    "pedestrian": "person",
    "parkingspace": PARKING,
}
"""Object type in lower case → kind, for ASAM OpenDRIVE 1.8 (``e_objectType``) and words of older maps."""

_PHRASES: Final = (
    (("crosswalk", "zebra"), "crosswalk"),
    (("stencil", "chevron region", "stop line", "road mark", "road marking"), PAINT),
    (("solid single", "solid double", "broken single", "broken double"), PAINT),
    (("pole", "post", "signpost", "lamppost", "streetlamp", "streetlight", "mast"), "pole"),
    (("barrier", "guardrail", "rail", "railing", "fence", "wall"), "barrier"),
    (("building", "house"), "building"),
    (("tree", "bush", "hedge", "shrub", "vegetation"), "vegetation"),
    (("parking space", "parking lot"), PARKING),
)
"""Regular expression for a name or unknown type → kind, for maps without types. The first match counts."""
_WORD: Final = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")

MOST_POINTS: Final = 1_000_000
"""Largest number of corners of all objects in a map, with copies. Further objects cause a warning."""
_STRIP_STEP: Final = 1.0
"""Distance between the corners of a strip along a road; m."""
_MOST_STEPS: Final = 5_000
_CIRCLE: Final = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)


def kind_of_object(type_name: str, name: str) -> str:
    """Return the kind of an OpenDRIVE object, from its type; if the type is unknown, from words in its name.

    :data:`PARKING` and :data:`PAINT` for objects that are not entities; ``prop`` for all others.
    """
    declared = KIND_OF_TYPE.get(type_name.strip().lower())
    if declared is not None:
        return declared
    for text in (type_name, name):
        words = " ".join(_singular(word) for word in _WORD.findall(text))
        for phrases, kind in _PHRASES:
            if any(f" {phrase} " in f" {words} " for phrase in phrases):
                return kind
    return "prop"


def _singular(word: str) -> str:
    word = word.lower()
    return word.removesuffix("es") if word.endswith(("shes", "xes")) else word.removesuffix("s")


@dataclass(frozen=True, slots=True)
class Objects:
    """Objects of an OpenDRIVE map, such as trees and buildings. Each has a map node and a geometry."""

    nodes: MapNodes
    shapes: list[Any]

    def take(self, rows: Ints) -> Objects:
        """Return the map objects of the given rows, in this order."""
        return Objects(self.nodes.take(rows), [self.shapes[row] for row in rows.tolist()])


class _Ring(NamedTuple):
    """Outline of a map object: corners (k, 2) of an area or line."""

    item: int
    corners: Floats
    is_area: bool = True


@dataclass(slots=True)
class _Items:
    """Objects at the roads and their outlines, with one row for each copy of a repeated object.

    Corners in ``local`` are in the item's own axes; corners in ``along`` are s and t of its road.
    """

    row: list[int] = field(default_factory=list[int])
    name: list[str] = field(default_factory=list[str])
    place: list[tuple[float, float, float]] = field(
        default_factory=list[tuple[float, float, float]]
    )
    size: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])
    local: list[_Ring] = field(default_factory=list[_Ring])
    along: list[_Ring] = field(default_factory=list[_Ring])
    points: int = 0

    def add(
        self, row: int, name: str, place: tuple[float, float, float], size: tuple[float, float]
    ) -> int:
        """Add a copy of an object at a road position. Return the row of the copy."""
        self.row.append(row)
        self.name.append(name)
        self.place.append(place)
        self.size.append(size)
        return len(self.row) - 1


def read_objects(
    document: Document, plan: PlanView, warnings: list[str]
) -> tuple[Objects, Objects, list[PlainLane], Ints]:
    """Read the objects of an OpenDRIVE map. Objects with an invalid position are skipped with a warning.

    Returns crosswalks, all other entities, parking spaces, and the rows of their roads.
    """
    kind = "road/object"
    table = document[kind]
    names, types = table.texts("name"), table.texts("type")
    kinds = list(map(kind_of_object, types, names))
    wanted = np.array(
        [not is_signal_object(n) and k != PAINT for n, k in zip(names, kinds, strict=True)], bool
    )
    rows = standing(document, kind, np.flatnonzero(wanted), warnings).tolist()
    items = _items(_Outlines(document), _repeats(document), rows, warnings)
    row = np.array(items.row, np.int64)
    s, t, up = np.array(items.place, np.float64).reshape(-1, 3).T
    columns = node_columns(document, plan, kind, row, at=(s, t, up))
    length, width = np.array(items.size, np.float64).reshape(-1, 2).T
    parks = np.array([kinds[r] == PARKING for r in items.row], bool)
    nodes = MapNodes.of(
        ["prop" if kinds[r] == PARKING else kinds[r] for r in items.row],
        items.name,
        length=np.where(length > 0, length, np.nan),
        width=np.where(width > 0, width, np.nan),
        **columns,
    )
    shapes = _shapes(items, _placed(document, plan, items, columns))
    objects = Objects(nodes, shapes)
    crosswalk = nodes.kind == KIND_CODE["crosswalk"]
    spaces = {
        row: space for row in np.flatnonzero(parks).tolist() if (space := _space(objects, row))
    }
    flat = [nodes.name[row] for row in np.flatnonzero(parks).tolist() if row not in spaces]
    warnings.extend(f"parking space {name!r} left out: it has no extent" for name in flat)
    return (
        objects.take(np.flatnonzero(crosswalk)),
        objects.take(np.flatnonzero(~crosswalk & ~parks)),
        list(spaces.values()),
        table.road[row[list(spaces)]],
    )


def _space(objects: Objects, row: int) -> PlainLane | None:
    """Convert a parking space to a lane in the direction of its heading; ``None`` if it has no area."""
    nodes, shape = objects.nodes, objects.shapes[row]
    if shape.area <= 0:
        return None
    corners = _quadrangle(shape)
    sides = np.hypot(*np.diff(corners, axis=0, append=corners[:1]).T)
    if sides[0] + sides[2] < sides[1] + sides[3]:
        corners = np.roll(corners, -1, axis=0)
    facing = np.array((np.cos(nodes.heading[row]), np.sin(nodes.heading[row])))
    if (corners[1] - corners[0] + corners[2] - corners[3]) @ facing < 0:
        corners = np.roll(corners, 2, axis=0)
    return PlainLane(
        name=nodes.name[row],
        type=PARKING,
        road=nodes.road[row],
        junction=nodes.junction[row],
        section=0,
        number=0,
        left=corners[[3, 2]],
        right=corners[[0, 1]],
        z=np.full(2, nodes.z[row]),
    )


def _quadrangle(shape: Any) -> Floats:
    """Return four corners (4, 2) counter-clockwise: those of the shape, or of the rectangle around it."""
    if shape.geom_type != "Polygon" or len(shape.exterior.coords) != 5 or not shape.is_valid:
        shape = shapely.minimum_rotated_rectangle(shape)
    corners = np.asarray(shape.exterior.coords, np.float64)[:-1]
    return corners if shape.exterior.is_ccw else corners[::-1]


@dataclass(frozen=True, slots=True)
class _Repeat:
    """OpenDRIVE element ``repeat``: several copies of an object along the road, or one continuous strip."""

    s: float
    length: float
    distance: float
    t: tuple[float, float]
    up: tuple[float, float]
    width: tuple[float, float]

    def copies(self) -> int:
        """Return the number of copies of the object. For a strip: the number of points along the road."""
        step = self.distance if self.distance > 0 else max(_STRIP_STEP, self.length / _MOST_STEPS)
        return int(min(np.floor(self.length / step + 1e-9), MOST_POINTS)) + 1

    def shares(self, n: int) -> Floats:
        """Return the positions of the n copies of a repeated object, from 0 (start) to 1 (end), (n,)."""
        if self.distance > 0 and self.length > 0:
            return np.arange(n, dtype=np.float64) * (self.distance / self.length)
        return np.linspace(0.0, 1.0, n)


def _repeats(document: Document) -> dict[int, list[_Repeat]]:
    """Return the valid ``repeat`` elements of each OpenDRIVE object: row of the object → list."""
    kind = "road/object/repeat"
    names = ("s", "length", "distance", "tStart", "tEnd", "zOffsetStart", "zOffsetEnd")
    columns = [document.rough_numbers(kind, name) for name in names]
    own = document.rough_numbers("road/object", "width")[document[kind].of]
    ends = [document.rough_numbers(kind, name, -1.0) for name in ("widthStart", "widthEnd")]
    columns += [np.where(width < 0, own, width) for width in ends]
    found: dict[int, list[_Repeat]] = {}
    for row, values in zip(document[kind].parent, np.column_stack(columns).tolist(), strict=True):
        s, length, distance, t0, t1, up0, up1, width0, width1 = values
        if np.isfinite(values).all() and length >= 0:
            repeat = _Repeat(s, length, distance, (t0, t1), (up0, up1), (width0, width1))
            found.setdefault(row, []).append(repeat)
    return found


class _Outlines:
    """Outlines of OpenDRIVE objects as corners (k, 2), relative to the object or in road coordinates."""

    def __init__(self, document: Document) -> None:
        kind = "road/object"
        self.local = _corners(document, "cornerLocal", ("u", "v"))
        self.along = _corners(document, "cornerRoad", ("s", "t"))
        names = ("s", "t", "zOffset", "length", "width", "radius")
        self.own = {name: document.rough_numbers(kind, name).tolist() for name in names}
        self.ids = document[kind].texts("id")

    def of(self, row: int) -> tuple[list[Floats], list[Floats]]:
        """Return two lists of outlines of an object: relative to the object, and in road coordinates."""
        place = np.array((self.own["s"][row], self.own["t"][row]))
        along = [ring - place for ring in self.along.get(row, [])]
        local = self.local.get(row, [])
        return (local if local or along else [self._plain(row)]), along

    def _plain(self, row: int) -> Floats:
        """Return the outline of an object from its length and width, or its radius; otherwise a point."""
        length, width, radius = (self.own[name][row] for name in ("length", "width", "radius"))
        if length > 0 and width > 0:
            return np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (length / 2, width / 2)
        if radius > 0:
            return radius * np.stack((np.cos(_CIRCLE), np.sin(_CIRCLE)), axis=1)
        return np.zeros((1, 2))


def _corners(document: Document, tag: str, names: tuple[str, str]) -> dict[int, list[Floats]]:
    """Return the valid outlines of OpenDRIVE objects, for one kind of corners: row of the object → outlines."""
    kind = f"road/object/outline/{tag}"
    points = np.column_stack([document.rough_numbers(kind, name) for name in names])
    outline = document[kind].of
    of = document["road/object/outline"].of
    found: dict[int, list[Floats]] = {}
    starts = np.flatnonzero(np.diff(outline, prepend=-1))
    for number, ring in zip(outline[starts].tolist(), np.split(points, starts[1:]), strict=False):
        if np.isfinite(ring).all():
            found.setdefault(int(of[number]), []).append(ring)
    return found


def _items(
    outlines: _Outlines, repeats: dict[int, list[_Repeat]], rows: list[int], warnings: list[str]
) -> _Items:
    """Return all copies of some OpenDRIVE objects, with outlines. Warn about objects that are too large."""
    items = _Items()
    own = outlines.own
    for row in rows:
        rings = outlines.of(row)
        corners = sum(len(ring) for part in rings for ring in part)
        spread = repeats.get(row, [])
        wanted = sum(r.copies() * (corners if r.distance > 0 else 2) for r in spread)
        if items.points + (wanted if spread else corners) > MOST_POINTS:
            name = outlines.ids[row]
            warnings.append(f"object {name!r} has too many corners or copies and is left out")
            continue
        items.points += wanted if spread else corners
        if not spread:
            place = own["s"][row], own["t"][row], own["zOffset"][row]
            size = own["length"][row], own["width"][row]
            _stand(items, items.add(row, outlines.ids[row], place, size), rings)
        number = 0
        for repeat in spread:
            if repeat.distance > 0:
                size = own["length"][row], own["width"][row]
                number = _copy(items, row, (outlines.ids[row], number), repeat, (rings, size))
            else:
                name = f"{outlines.ids[row]}#{number}" if number else outlines.ids[row]
                _stretch(items, row, name, repeat)
                number += 1
    return items


_Rings = tuple[list["Floats"], list["Floats"]]


def _stand(items: _Items, item: int, rings: _Rings) -> None:
    """Add the outlines of a repeated object at the position of one of its copies."""
    s, t, _ = items.place[item]
    items.local.extend(_Ring(item, ring) for ring in rings[0])
    items.along.extend(_Ring(item, ring + np.array((s, t))) for ring in rings[1])


def _copy(
    items: _Items,
    row: int,
    name: tuple[str, int],
    repeat: _Repeat,
    one: tuple[_Rings, tuple[float, float]],
) -> int:
    """Add the copies that a ``repeat`` element requests for an object. Return the number for the next copy."""
    shares = repeat.shares(repeat.copies()).tolist()
    for number, share in enumerate(shares, name[1]):
        place = (
            repeat.s + share * repeat.length,
            repeat.t[0] + share * (repeat.t[1] - repeat.t[0]),
            repeat.up[0] + share * (repeat.up[1] - repeat.up[0]),
        )
        _stand(items, items.add(row, f"{name[0]}#{number}", place, one[1]), one[0])
    return name[1] + len(shares)


def _stretch(items: _Items, row: int, name: str, repeat: _Repeat) -> None:
    """Add the continuous strip that a ``repeat`` element without distance requests."""
    n = repeat.copies() + 1
    share = repeat.shares(n)
    s, t = repeat.s + share * repeat.length, np.interp(share, (0, 1), repeat.t)
    half = np.interp(share, (0, 1), repeat.width) / 2
    size = repeat.length, float(2 * half.mean())
    place = float(s[n // 2]), float(t[n // 2]), sum(repeat.up) / 2
    item = items.add(row, name, place, size)
    right, left = np.column_stack((s, t - half)), np.column_stack((s, t + half))
    wide = bool(half.max() > 0)
    corners = np.concatenate((right, left[::-1])) if wide else left
    items.along.append(_Ring(item, corners, wide))


def _placed(
    document: Document, plan: PlanView, items: _Items, columns: dict[str, Any]
) -> list[_Ring]:
    """Return all object outlines in map coordinates."""
    local, item = _laid_out(items.local)
    cos, sin = np.cos(columns["heading"][item]), np.sin(columns["heading"][item])
    x = columns["x"][item] + cos * local[:, 0] - sin * local[:, 1]
    y = columns["y"][item] + sin * local[:, 0] + cos * local[:, 1]
    along, item = _laid_out(items.along)
    road = document["road/object"].road[np.array(items.row, np.int64)[item]]
    where_x, where_y, *_ = places(document, plan, road, along[:, 0], along[:, 1])
    return [
        *_moved(items.local, np.column_stack((x, y))),
        *_moved(items.along, np.column_stack((where_x, where_y))),
    ]


def _laid_out(rings: list[_Ring]) -> tuple[Floats, Ints]:
    """Return the corners of all outlines as one array, and the row of the object for each corner."""
    points = np.concatenate([np.zeros((0, 2)), *(ring.corners for ring in rings)])
    items = np.array([ring.item for ring in rings], np.int64)
    return points, np.repeat(items, np.array([len(ring.corners) for ring in rings], np.int64))


def _moved(rings: list[_Ring], points: Floats) -> Iterator[_Ring]:
    """Replace the corners of outlines by the given points, in order. Yield the new outlines."""
    end = 0
    for ring in rings:
        begin, end = end, end + len(ring.corners)
        yield ring._replace(corners=points[begin:end])


def _shapes(items: _Items, rings: list[_Ring]) -> list[Any]:
    """Return the shapely geometry of each object: an area, a line, or a point."""
    parts: list[list[Any]] = [[] for _ in items.row]
    for item, corners, is_area in rings:
        if len(corners) == 1:
            parts[item].append(shapely.Point(corners[0]))
        elif len(corners) == 2 or not is_area:
            parts[item].append(shapely.LineString(corners))
        else:
            parts[item].append(shapely.Polygon(corners))
    return [
        part[0] if len(part) == 1 else shapely.union_all(shapely.make_valid(part)) for part in parts
    ]
