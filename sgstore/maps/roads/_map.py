"""Road map as arrays (lanes, roads, junctions, crosswalks, signals), with distances along lanes."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sgstore.base.tables import chained, spread, taken
from sgstore.maps.roads._courses import LaneCourses
from sgstore.maps.roads._footprints import LaneIndex
from sgstore.maps.roads._places import (
    STOP_LINE,
    MapPlaces,
    crosswalk_places,
    signal_places,
    whole_lanes,
)
from sgstore.maps.roads._ribbons import (
    PREPARED,
    LanePoints,
    LaneSurface,
    Ribbons,
    lane_polygons,
    waypoints,
)
from sgstore.maps.roads._zones import zones
from sgstore.model.vocabulary import DRIVING, KIND_CODE, KINDS, RELATION_CODE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from sgstore.model.world import Bools, Codes, Floats, Ints


FARTHEST: Final = 200.0
"""Largest search distance along lanes from one entity to another; m. The view ``pairs`` has the same limit."""
_CELL: Final = 8.0
"""Cell size of the grid that excludes bodies far from all crosswalks; m."""
_MOST_CELLS: Final = 1 << 16

_MOST_AT_ONCE: Final = 1 << 22
"""Number of pairs of lanes whose distances are in memory at once."""


def _downstream(
    lengths: Floats, src: Ints, dst: Ints, limit: float
) -> Iterator[tuple[Ints, Ints, Floats]]:
    """Yield pairs of lanes and their distance: the second lane starts within ``limit`` after the first ends.

    Traffic flows from ``src`` to ``dst``. The fronts of all lanes advance together, lane by lane.
    """
    order = np.lexsort((dst, src))
    onward, first = dst[order], np.searchsorted(src[order], np.arange(len(lengths) + 1))
    step = max(_MOST_AT_ONCE // max(len(lengths), 1), 1)
    for lanes in np.split(np.arange(len(lengths)), range(step, len(lengths), step)):
        best = np.full((len(lanes), len(lengths)), np.inf)
        source, at, distance = np.arange(len(lanes)), lanes, np.zeros(len(lanes))
        while len(source):
            of, place = spread(first[at], first[at + 1] - first[at])
            source, at, distance = source[of], onward[place], distance[of]
            better = np.flatnonzero((distance <= limit) & (distance < best[source, at]))
            source, at, distance = source[better], at[better], distance[better]
            np.minimum.at(best, (source, at), distance)
            least = np.flatnonzero(distance == best[source, at])
            key, one = np.unique(source[least] * len(lengths) + at[least], return_index=True)
            source, at = np.divmod(key, len(lengths))
            distance = distance[least[one]] + lengths[at]
        row, other = np.nonzero(np.isfinite(best))
        yield lanes[row], other, best[row, other]


STRAIGHT: Final = np.radians(30.0)
"""Turn angle below which a lane through a junction goes straight on; rad."""


def turn_words(turn: Floats) -> list[str]:
    """Return ``left``, ``right`` or ``straight`` for turn angles; rad. Positive angles turn left."""
    words = np.where(turn > STRAIGHT, "left", np.where(turn < -STRAIGHT, "right", "straight"))
    return list(map(str, words))


OFF_ROAD: Final = -1
"""Node id of the single node that stands for all places outside driving lanes."""

STOREY: Final = 2.5
"""Largest difference in height between a footprint and its lane; m."""

Geometries = NDArray[np.object_]
"""Array of shapely geometries."""

_FIRST_LANE: Final = OFF_ROAD - 1
_QUADRANT: Final = np.pi / 4
_ROUNDING: Final = 1e-3
"""Difference of overlaps and headings that counts as rounding, so that results survive a rotation."""
_MOST_PRESENT: Final = 1 << 24
"""Largest number of (node, point) pairs that are processed at once."""
_CORNERS: Final = 8
"""Number of corners of a shape that the quick test of distance uses."""
_TOUCH: Final = 1e-6
"""Difference of distances below which no exact test is needed; m."""
_MERGED: Final = " without sections"
"""Suffix that marks a map with a single node for all sections of a lane."""


@dataclass(frozen=True, slots=True)
class MapNodes:
    """All parts of a road map (lanes, roads, signals, …) as columns. Row ``i`` has the node id ``-1 - i``.

    Attributes
    ----------
    kind : (K,) int8
        Codes of :data:`sgstore.model.vocabulary.KINDS`.
    name : tuple of str
        ``road/section/lane`` of a lane, else the id in the map; ``off_road``.
    x, y, z, heading : (K,) float64
        A point on it and its direction there (a lane: the middle of its centre line, in the
        direction of travel). NaN for ``off_road`` and for unknown places.
    lane_type : tuple of str
        ``driving``, ``sidewalk``, … as in OpenDRIVE; empty for other nodes.
    road, junction, turn : tuple of str
        Ids of its road and junction; ``left``, ``right``, ``straight`` for a lane in a junction.
        Empty if there is none.
    section, lane : (K,) int64
        Section and lane number in the road; 0 for other nodes.
    length, width, speed_limit : (K,) float64
        m, mean m, m/s; NaN if unknown.
    curvature : (K,) float64
        Curvature of the centre line at a waypoint, positive to the left; 1/m. NaN for other nodes.
    """

    kind: Codes
    name: tuple[str, ...]
    x: Floats
    y: Floats
    z: Floats
    heading: Floats
    lane_type: tuple[str, ...]
    road: tuple[str, ...]
    junction: tuple[str, ...]
    turn: tuple[str, ...]
    section: Ints
    lane: Ints
    length: Floats
    width: Floats
    speed_limit: Floats
    curvature: Floats

    def __len__(self) -> int:
        return len(self.kind)

    @classmethod
    def of(cls, kind: str | Sequence[str], name: Sequence[str], **columns: Any) -> MapNodes:
        """Create a table of map parts from columns. Missing columns become empty texts, 0 or NaN.

        ``kind``: one, or one per node.
        """
        n = len(name)
        kinds = [kind] * n if isinstance(kind, str) else kind
        missing: dict[str, Any] = {"section": np.zeros(n, np.int64), "lane": np.zeros(n, np.int64)}
        texts = {"lane_type", "road", "junction", "turn"}
        values = {
            column.name: missing.get(
                column.name, ("",) * n if column.name in texts else np.full(n, np.nan)
            )
            for column in fields(cls)
        }
        values |= {"kind": np.array([KIND_CODE[k] for k in kinds], np.int8), "name": tuple(name)}
        return cls(**(values | columns))

    def take(self, rows: Ints) -> MapNodes:
        """Return the map parts of the given rows, in this order."""
        return taken(self, rows)

    def first_sections(self) -> Ints:
        """For each map part, return the row that represents it: for a lane, the row of its first section."""
        same = np.arange(len(self))
        first: dict[tuple[str, int], int] = {}
        for column in np.flatnonzero(self.kind == KIND_CODE["lane"]).tolist():
            key = self.road[column], int(self.lane[column])
            if key[1]:  # lanes without a number in a section, such as parking spaces, stay
                same[column] = first.setdefault(key, column)
        return same


@dataclass(frozen=True, slots=True)
class MapEdges:
    """Edges between the parts of a road map, such as successor or neighbour; shape (E,).

    Attributes
    ----------
    relation : int8
        Codes of :data:`sgstore.model.vocabulary.RELATIONS`.
    src, dst : int64
        Node ids.
    """

    relation: Codes
    src: Ints
    dst: Ints

    def __len__(self) -> int:
        return len(self.relation)


@dataclass(frozen=True, slots=True)
class LaneHits:
    """Pairs of a footprint and a lane that it touches, sorted by footprint; shape (H,).

    Attributes
    ----------
    row : int64
        Row of the footprint in the query.
    lane : int64
        Node id of the lane.
    overlap : float64
        Share of the footprint's area in the lane, 0 … 1.
    offset : float64
        Lateral offset of the footprint's centre from the lane's centre line, positive to the left
        of the direction of travel; m.
    heading_error : float64
        Heading of the footprint less the direction of travel there, in (-π, π]; rad.
    primary : bool
        True for the best lane of each footprint: centre inside first, then the smaller heading
        error (by quadrants of 45°), then the larger overlap, then the lower lane.
    """

    row: Ints
    lane: Ints
    overlap: Floats
    offset: Floats
    heading_error: Floats
    primary: Bools


@dataclass(frozen=True, slots=True)
class LaneChanges:
    """Parts of lanes from which vehicles may change to a neighbouring lane; shape (n,).

    Attributes
    ----------
    lane, to : int64
        Lanes, counted from 0.
    start, end : float64
        Along the centre line of ``lane``; m.
    """

    lane: Ints
    to: Ints
    start: Floats
    end: Floats

    def __len__(self) -> int:
        return len(self.lane)

    @classmethod
    def none(cls) -> LaneChanges:
        """Return an empty table of permitted lane changes."""
        no_lanes, nowhere = np.zeros(0, np.int64), np.zeros(0)
        return cls(no_lanes, no_lanes, nowhere, nowhere)


@dataclass(eq=False, kw_only=True, repr=False)
class RoadMap:
    """Road map: lanes, roads, junctions and signals with edges and lane surfaces, and geometric look-ups.

    Attributes
    ----------
    name : str
        Its name for people: the file name, or the name in the map's header.
    text : str
        The source text.
    digest : str
        SHA-256 of text and variant, in hexadecimal digits: the identity of the map.
    nodes : MapNodes
    edges : MapEdges
        Static relations: ``isIn`` (lane → road, road → junction or roundabout), ``travelsTo``, ``opposes``,
        ``toLeftOf``, ``toRightOf``, ``laneChange``, ``conflictsWith`` among lanes, ``controlsTrafficOf``
        (signal → lane).
    ribbons : Ribbons
        The surface of the lanes, in the order of their nodes. Lane i (wherever lanes are counted from 0) has
        node id -2 - i.
    shapes : (K,) object
        Geometries of the nodes, or ``None`` for lanes and for nodes that consist of lanes.
    lane_changes : LaneChanges
        Stretches of the ``laneChange`` edges along their lanes.
    road_types : mapping of str to tuple of (float, str)
        Id of a road → its types (``town``, ``motorway``, …) and the start of each along its
        reference line; m.
    junction_types : mapping of str to str
        Id of a junction → ``default``, ``direct``, ``virtual``, …
    controllers : mapping of str to tuple of str
        Id of a controller → ids of the signals that it switches.
    warnings : sequence of str
        Tolerated defects of the map, each with its road.
    stops : (m,) int64, int64 and float64
        Signals (columns of the nodes), lanes that they apply to (from 0), and the place along
        these; m.
    stop_lines : (n,) int64
        Columns of the signals that are painted stop lines.
    courses : LaneCourses
        Curvature and slope of the lanes, metre by metre. Empty for a map without sections.
    broad_lines : MapPlaces
        Broad markings at the sides of lanes.
    own : mapping of int to mapping
        Row of a lane or signal → its attributes without a column: markings, and text and size of a sign.
    marking_parts : mapping of int to sequence of sequence of tuple
        Row of a lane → for each marked side, the markings in order: start along the road (m), and attributes.
    variant : str
        Difference from the map that the text describes.
    """

    name: str
    text: str
    nodes: MapNodes
    edges: MapEdges
    ribbons: Ribbons
    shapes: Geometries
    lane_changes: LaneChanges = field(default_factory=LaneChanges.none)
    road_types: Mapping[str, tuple[tuple[float, str], ...]] = field(
        default_factory=dict[str, tuple[tuple[float, str], ...]]
    )
    junction_types: Mapping[str, str] = field(default_factory=dict[str, str])
    controllers: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    warnings: Sequence[str] = ()
    stops: tuple[Ints, Ints, Floats] = field(
        default_factory=lambda: (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    )
    stop_lines: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    courses: LaneCourses = field(default_factory=LaneCourses.none)
    broad_lines: MapPlaces = field(default_factory=MapPlaces.none)
    own: Mapping[int, Mapping[str, Any]] = field(default_factory=dict[int, "Mapping[str, Any]"])
    marking_parts: Mapping[int, Sequence[Sequence[tuple[float, Mapping[str, Any]]]]] = field(
        default_factory=dict[int, "Sequence[Sequence[tuple[float, Mapping[str, Any]]]]"]
    )
    variant: str = ""

    def __post_init__(self) -> None:
        told = (self.text + self.variant).encode("utf-8", "surrogatepass")
        self.digest = hashlib.sha256(told).hexdigest()
        self.warnings = tuple(self.warnings)
        self._lanes = len(self.ribbons)
        # Limit and last result of :meth:`downstream`.
        self._ways: tuple[float, tuple[Ints, Ints, Floats]] | None = None

    def outlines(self) -> Geometries:
        """Return the shapely polygon, line or point of each map part, (K,); ``None`` for parts without a shape.

        Roads, junctions and ``off_road`` have no shape: a road consists of its lanes.
        """
        return self._outlines.copy()

    def surface_of(self, lanes: Ints, distance: float) -> LaneSurface:
        """Return the area within a distance of some lanes (counted from 0); m."""
        with PREPARED:
            return LaneSurface(self._outlines[1 + lanes], distance)

    def lanes_of(self, boxes: Floats, z: Floats) -> LaneHits:
        """Return the lanes that footprints (ground rectangles of objects) touch. Heights are compared, too.

        Parameters
        ----------
        boxes : (N, 5) float64
            ``x, y, heading, length, width`` of each footprint; m, m, rad, m, m. A footprint with
            length or width 0 or NaN is a point or a line. A footprint with NaN in ``x, y`` touches
            nothing.
        z : (N,) float64
            Height of the footprint's centre *on the ground* (the bottom of the box); m. NaN: any storey.

        Notes
        -----
        A footprint within 1 mm of a lane touches it. Its height is compared with the lane at the
        footprint's centre. The heading error in a bend is taken there, too.
        """
        touches = self._index.touches(np.asarray(boxes, np.float64), np.asarray(z, np.float64))
        quadrant = np.floor(np.abs(touches.heading_error) / _QUADRANT + _ROUNDING)
        overlap = np.round(touches.overlap / _ROUNDING)
        order = np.lexsort((touches.lane, -overlap, quadrant, ~touches.inside, touches.row))
        first = np.diff(touches.row[order], prepend=-1) != 0
        primary = np.zeros(len(order), np.bool_)
        primary[order[first]] = True
        return LaneHits(
            touches.row,
            _FIRST_LANE - touches.lane,
            touches.overlap,
            touches.offset,
            touches.heading_error,
            primary,
        )

    def crosswalks_of(self, boxes: Floats, z: Floats) -> tuple[Ints, Ints]:
        """Return the crosswalks below footprints, as pairs: index of the footprint, node id.

        Boxes and heights as in :meth:`lanes_of`.
        """
        columns, tree, cells = self._crosswalks
        boxes = np.asarray(boxes, np.float64)
        rows = np.flatnonzero(np.isfinite(boxes[:, :2]).all(axis=1))
        if cells is not None:
            long = (np.abs(boxes[rows, 3:5]) > _CELL).any(axis=1)
            rows = rows[long | np.isin(_cells(boxes[rows, :2]), cells)]
        if not len(columns) or not len(rows):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        row, place = tree.query(_rectangles(boxes[rows]), predicate="intersects")
        row, column = rows[row], columns[place]
        same = ~(np.abs(self.nodes.z[column] - np.asarray(z, np.float64)[row]) > STOREY)
        row, column = row[same], column[same]
        order = np.lexsort((column, row))
        return row[order], -1 - column[order]

    def near(self, x: Floats, y: Floats, radius: float) -> tuple[Ints, Ints]:
        """Return the map parts within ``radius`` of points, as pairs: index of the point, node id.

        A road or junction is near if one of its lanes is near. Ordered by row and by descending
        node id.
        """
        rows, columns = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        places = np.column_stack((x, y))
        step = max(_MOST_PRESENT // len(self.nodes), 1)
        for first in range(0, len(places), step):
            present = self._present(places[first : first + step], radius)
            row, column = np.nonzero(present)
            rows.append(first + row)
            columns.append(column)
        return np.concatenate(rows), -1 - np.concatenate(columns)

    def _present(self, places: Floats, radius: float) -> Bools:
        """Return a mask (N, K) of the K map parts within ``radius`` of N positions."""
        columns, tree = self._extents
        finite = np.flatnonzero(np.isfinite(places).all(axis=1))
        low, high = places[finite] - radius, places[finite] + radius
        row, place = tree.query(shapely.box(*low.T, *high.T))
        # Boxes and some corners decide most pairs; only the other pairs need exact shapes.
        box, corners = self._corners
        at = places[finite][row]
        aside = np.maximum(np.maximum(box[place, :2] - at, at - box[place, 2:]), 0)
        near = ((corners[place] - at[:, None]) ** 2).sum(axis=2).min(axis=1) <= (
            radius - _TOUCH
        ) ** 2
        near &= radius > _TOUCH
        ask = np.flatnonzero(~near & ((aside**2).sum(axis=1) <= (radius + _TOUCH) ** 2))
        points: Any = shapely.points(at[ask])
        with PREPARED:
            near[ask] = shapely.dwithin(tree.geometries[place[ask]], points, radius)
        row, place = row[near], place[near]
        present = np.zeros((len(places), len(self.nodes)), np.bool_)
        present[finite[row], columns[place]] = True
        for child, parent in self._containment:
            at, which = np.nonzero(present[:, child])
            present[at, parent[which]] = True
        return present

    def near_shapes(self, corners: Floats, distance: float) -> tuple[Ints, Ints]:
        """Return the map parts within a distance of shapes, as pairs: index of the shape, node id.

        Parameters
        ----------
        corners : (N, V, 2) float64
            Ends of lines (V = 2), or corners of simple polygons; m.
        distance : float
            m.

        Notes
        -----
        Roads, junctions and ``off_road`` have no shape and are never near.
        """
        make = shapely.linestrings if corners.shape[1] == 2 else shapely.polygons
        shapes: Any = make(corners)
        columns, tree = self._extents
        row, place = tree.query(shapes, predicate="dwithin", distance=distance)
        order = np.lexsort((columns[place], row))
        return row[order], -1 - columns[place][order]

    def lanes_of_signal(self, signal: str) -> Ints:
        """Return the node ids of the driving lanes to which a traffic signal applies; empty for an unknown id.

        For a signal that is missing in the map, :meth:`lanes_ref` can replace its id.
        """
        if signal.startswith(_LANES_REF):
            names = _names_in(signal)
            nodes = self.nodes
            found = [
                -1 - column
                for column in range(len(nodes))
                if nodes.lane_type[column] in DRIVING and nodes.name[column] in names
            ]
            return np.array(found, np.int64)
        return self._controlled.get(signal, np.zeros(0, np.int64))

    def waypoints(self, spacing: float) -> LanePoints:
        """Return points along the centre lines of all lanes, every ``spacing`` metres.

        Raises
        ------
        ValueError
            ``spacing`` is not above 0.
        """
        return waypoints(self.ribbons, spacing)

    @cached_property
    def without_sections(self) -> RoadMap:
        """Return the map with the sections of each lane merged into a single node.

        The node is the one of the first section, with the name ``road_number``. The other nodes
        stay, without edges; node ids keep their meaning. Surface queries still distinguish
        sections. The result is another map with another digest.
        """
        nodes, same = self.nodes, self.nodes.first_sections()
        first = same == np.arange(len(nodes))
        lane = (nodes.kind == KIND_CODE["lane"]) & (nodes.lane != 0)
        name = tuple(
            f"{road}_{number}" if merged else name
            for name, road, number, merged in zip(
                nodes.name, nodes.road, nodes.lane.tolist(), lane & first, strict=True
            )
        )
        length = np.bincount(same, np.nan_to_num(nodes.length), len(nodes))
        return replace(
            self,
            nodes=replace(nodes, name=name, length=np.where(lane & first, length, nodes.length)),
            edges=merged_edges(self.edges, same),
            courses=LaneCourses.none(),
            broad_lines=MapPlaces.none(),
            variant=f"{self.variant}{_MERGED}",
        )

    def downstream(self, limit: float) -> tuple[Ints, Ints, Floats]:
        """Return pairs of lanes: the second starts at most ``limit`` metres after the end of the first.

        The last result is cached: a second call with the same limit is free.

        Returns
        -------
        lane, other : (n,) int64
            Lanes, counted from 0; ``lane`` ascends. A lane may reach itself.
        distance : (n,) float64
            From the end of ``lane`` to the start of ``other``; m.
        """
        if self._ways is None or self._ways[0] != limit:
            flow = self.edges.relation == RELATION_CODE["travelsTo"]
            src, dst = _FIRST_LANE - self.edges.src[flow], _FIRST_LANE - self.edges.dst[flow]
            lanes = (src >= 0) & (src < self._lanes)
            ways = _downstream(self.ribbons.lengths, src[lanes], dst[lanes], limit)
            lane, other, distance = map(np.concatenate, zip(*ways, strict=True))
            self._ways = limit, (lane, other, distance)
        return self._ways[1]

    def links(self) -> list[tuple[int, int, bool]]:
        """Return the lanes that traffic connects: node ids, and true if both are in one junction or in none."""
        flow = self.edges.relation == RELATION_CODE["travelsTo"]
        ends = self.edges.src[flow].tolist(), self.edges.dst[flow].tolist()
        at = self.nodes.junction
        return [(a, b, at[-1 - a] == at[-1 - b]) for a, b in zip(*ends, strict=True)]

    @cached_property
    def reach(self) -> tuple[Ints, Ints, Floats]:
        """Return pairs of lanes that traffic connects, and the distance from one start to the other.

        Returns
        -------
        lane, other : (n,) int64
            Node ids. Each lane also occurs with itself; two lanes occur twice if both directions
            are drivable.
        start : (n,) float64
            Start of ``other``, along the lanes from the start of ``lane``; negative if the way
            leads from ``other`` to ``lane``; m. At most :data:`FARTHEST` between the end of one and
            the start of the next.

        Notes
        -----
        Empty for a map without sections: places along its lanes refer to sections.
        """
        if _MERGED in self.variant:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
        begun, reached, distance = self.downstream(FARTHEST)
        every, start = np.arange(self._lanes), self.ribbons.lengths[begun] + distance
        lane = np.concatenate([every, begun, reached])
        other = np.concatenate([every, reached, begun])
        starts = np.concatenate([np.zeros(len(every)), start, -start])
        order = np.lexsort((starts, other, lane))
        return _FIRST_LANE - lane[order], _FIRST_LANE - other[order], starts[order]

    @cached_property
    def places(self) -> MapPlaces:
        """Intervals of lanes that map parts cover: junctions, crosswalks, signals, zones and so on.

        Empty for a map without sections, as :attr:`reach`.
        """
        nodes, lanes = self.nodes, slice(1, 1 + self._lanes)
        is_merged = _MERGED in self.variant
        if not self._lanes or (is_merged and not self.own):
            return MapPlaces.none()
        what = [KINDS[int(code)] for code in nodes.kind]
        columns = {
            of: {nodes.name[column]: column for column, kind in enumerate(what) if kind == of}
            for of in ("road", "junction")
        }
        columns["lane"] = {str(column): column for column in range(1, lanes.stop)}
        names = {"lane": list(columns["lane"]), "road": nodes.road[lanes]}
        names["junction"] = nodes.junction[lanes]
        wholes = [whole_lanes(self.ribbons, of, names[of], columns[of]) for of in columns]
        wholes += [self._on_roundabouts(), self._on_zones(), self.broad_lines]
        for column in self.stop_lines.tolist():
            what[column] = STOP_LINE
        crosswalks, *_ = self._crosswalks
        shapes, z = self.shapes[crosswalks], nodes.z[crosswalks]
        control = self.edges.relation == RELATION_CODE["controlsTrafficOf"]
        applies = -1 - self.edges.src[control], _FIRST_LANE - self.edges.dst[control]
        signals = signal_places(self.ribbons, names["junction"], what, applies, self.stops)
        crossed = crosswalk_places(self.ribbons, crosswalks, shapes, z, STOREY)
        table = chained([*wholes, crossed, signals])
        # Attributes are JSON texts, each at the first place of its part; of a waypoint, at that of its lane.
        first = dict(zip(table.part[::-1].tolist(), range(len(table))[::-1], strict=True))
        inside = self.edges.relation == RELATION_CODE["isIn"]
        ends = zip(self.edges.src[inside].tolist(), self.edges.dst[inside].tolist(), strict=True)
        first |= {
            -1 - point: first[-1 - lane]
            for point, lane in ends
            if what[-1 - point] == "waypoint" and -1 - point in self.own
        }
        parts = [part for part, told in self.own.items() if told and part in first]
        about = taken(table, np.array([first[part] for part in parts], np.int64))
        texts = (json.dumps(self.own[part], ensure_ascii=False, sort_keys=True) for part in parts)
        about = replace(about, part=np.array(parts, np.int64), what=tuple(texts))
        table = about if is_merged else chained([table, about])
        return MapPlaces.of(table.part, table.what, table.lane, table.start, table.end)

    def _on_roundabouts(self) -> MapPlaces:
        """Return the lanes of each roundabout, as intervals of these lanes."""
        (lane, road), (part, whole) = self._containment
        around = np.flatnonzero(self.nodes.kind[whole] == KIND_CODE["roundabout"])
        of_road: dict[int, list[int]] = {}
        for at, one in zip(part[around].tolist(), whole[around].tolist(), strict=True):
            of_road.setdefault(at, []).append(one)
        pairs = [
            (one, row - 1)
            for row, at in zip(lane.tolist(), road.tolist(), strict=True)
            for one in of_road.get(at, ())
        ]
        of, lanes = np.array(pairs, np.int64).reshape(-1, 2).T
        return MapPlaces.of(
            of, ["roundabout"] * len(of), lanes, np.zeros(len(of)), self.ribbons.lengths[lanes]
        )

    def _on_zones(self) -> MapPlaces:
        """Return merge and departure zones (areas near on-ramps and off-ramps) as intervals of lanes."""
        lanes = slice(1, 1 + self._lanes)
        pairs = {
            name: (-2 - self.edges.src[on], -2 - self.edges.dst[on])
            for name in ("travelsTo", "toLeftOf", "toRightOf", "opposes")
            for on in [
                (self.edges.relation == RELATION_CODE[name]) & (self.edges.src > -2 - self._lanes)
            ]
        }
        one, other = np.concatenate([pairs["toLeftOf"], pairs["toRightOf"]], axis=1)
        against = {*zip(*(column.tolist() for column in pairs["opposes"]), strict=True)}
        same = [pair not in against for pair in zip(one.tolist(), other.tolist(), strict=True)]
        nodes, beside = self.nodes, (one[same], other[same])
        lengths = self.ribbons.lengths
        return zones(
            nodes.lane_type[lanes], nodes.junction[lanes], lengths, pairs["travelsTo"], beside
        )

    @cached_property
    def _index(self) -> LaneIndex:
        return LaneIndex(self.ribbons, STOREY)

    @cached_property
    def _outlines(self) -> Geometries:
        shapes = self.shapes.copy()
        shapes[1 : 1 + self._lanes] = lane_polygons(self.ribbons)
        folded = ~shapely.is_missing(shapes) & ~shapely.is_valid(shapes)
        shapes[folded] = shapely.make_valid(
            shapes[folded], method="structure", keep_collapsed=False
        )
        return shapes

    @cached_property
    def _crosswalks(self) -> tuple[Ints, shapely.STRtree, Ints | None]:
        """Crosswalks of the map: their rows, a spatial index, and grid cells near them.

        The cells are ``None`` if there are too many.
        """
        columns = np.flatnonzero(self.nodes.kind == KIND_CODE["crosswalk"])
        shapes = self.shapes[columns]
        tree = shapely.STRtree(shapes)
        low, high = np.split(shapely.bounds(shapes).reshape(-1, 4) / _CELL, 2, axis=1)
        if not np.prod(high - low + 4, axis=1).sum() < _MOST_CELLS:
            return columns, tree, None
        around = [np.zeros((0, 2), np.int64)] + [
            np.stack(np.meshgrid(*map(np.arange, a, b)), axis=-1).reshape(-1, 2)
            for a, b in zip(_floor(low) - 1, _floor(high) + 2, strict=True)
        ]
        return columns, tree, np.unique(_numbered(np.concatenate(around)))

    @cached_property
    def _corners(self) -> tuple[Floats, Floats]:
        """Bounding boxes (M, 4) of map parts, and a few corners (M, C, 2) of each shape; m."""
        _, tree = self._extents
        every, shape = shapely.get_coordinates(tree.geometries, return_index=True)
        count = np.bincount(shape, minlength=len(tree.geometries))
        chosen = (count[:, None] * (np.arange(_CORNERS) / _CORNERS)).astype(np.int64)
        chosen += (np.cumsum(count) - count)[:, None]
        corners = np.append(every, [[np.inf, np.inf]], axis=0)[np.where(count[:, None], chosen, -1)]
        return shapely.bounds(tree.geometries), corners

    @cached_property
    def _extents(self) -> tuple[Ints, shapely.STRtree]:
        outlines = self._outlines
        columns = np.flatnonzero(~shapely.is_missing(outlines))
        tree = shapely.STRtree(outlines[columns])
        shapely.prepare(tree.geometries)  # Prepared shapes make distances fast.
        return columns, tree

    @cached_property
    def _containment(self) -> tuple[tuple[Ints, Ints], ...]:
        """Pairs of a map part and the part that contains it: lane and road, road and junction."""
        inside = self.edges.relation == RELATION_CODE["isIn"]
        child, parent = -1 - self.edges.src[inside], -1 - self.edges.dst[inside]
        lane = self.nodes.kind[child] == KIND_CODE["lane"]
        return (child[lane], parent[lane]), (child[~lane], parent[~lane])

    @cached_property
    def _controlled(self) -> dict[str, Ints]:
        controls = self.edges.relation == RELATION_CODE["controlsTrafficOf"]
        src, dst = self.edges.src[controls], self.edges.dst[controls]
        return {self.nodes.name[-1 - node]: dst[src == node] for node in np.unique(src).tolist()}

    @staticmethod
    def lanes_ref(names: Iterable[str]) -> str:
        """For a traffic signal that is not in the map, return an id that lists the names of its lanes."""
        return _LANES_REF + json.dumps(list(names), ensure_ascii=False)

    @staticmethod
    def within(outline: Any, places: Floats) -> NDArray[np.bool_]:
        """Return a mask (N,) of the positions (N, 2) inside a shapely polygon."""
        return np.asarray(shapely.contains_xy(outline, *places.T), np.bool_)

    @staticmethod
    def point_shapes(x: Floats, y: Floats) -> NDArray[np.object_]:
        """Convert coordinates to shapely points, (N,) each."""
        points: Any = shapely.points(np.column_stack([x, y]))
        return points


_LANES_REF: Final = "lanes:"


def _names_in(ref: str) -> set[str]:
    try:
        told = json.loads(ref.removeprefix(_LANES_REF))
    except (ValueError, RecursionError):
        return set()
    return {name for name in told if isinstance(name, str)} if isinstance(told, list) else set()


def merged_edges(edges: MapEdges, same: Ints) -> MapEdges:
    """Return the map edges after the sections of each lane were merged, without duplicates."""
    src, dst = -1 - same[-1 - edges.src], -1 - same[-1 - edges.dst]
    table = np.column_stack([edges.relation.astype(np.int64), src, dst])[src != dst]
    relation, src, dst = np.unique(table, axis=0).reshape(-1, 3).T
    return MapEdges(relation.astype(np.int8), src, dst)


def _cells(places: Floats) -> Ints:
    return _numbered(_floor(places / _CELL))


def _floor(places: Floats) -> Ints:
    return np.floor(places).astype(np.int64)


def _numbered(cells: Ints) -> Ints:
    """Return a number for each grid square, (N,). Rarely, two squares have the same number."""
    return cells[:, 0] << 32 ^ cells[:, 1]


def _rectangles(boxes: Floats) -> Geometries:
    """Convert footprints to shapely polygons. A side that is missing or zero becomes 0.1 mm long."""
    half = np.maximum(np.nan_to_num(np.abs(boxes[:, 3:5])) / 2, 5e-5)
    heading = np.nan_to_num(boxes[:, 2])
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    along = half[:, :1] * np.array([1.0, -1.0, -1.0, 1.0])
    across = half[:, 1:] * np.array([1.0, 1.0, -1.0, -1.0])
    x = boxes[:, :1] + cos * along - sin * across
    y = boxes[:, 1:2] + sin * along + cos * across
    polygons: Any = shapely.polygons(np.stack((x, y), axis=-1))
    return polygons
