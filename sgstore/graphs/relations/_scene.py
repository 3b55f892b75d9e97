"""Input for the computation of relations: objects, object pairs and map parts of a block of frames.

Overlapping intervals of a line give candidates without testing all pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.geometry import bearings
from sgstore.base.numba_loops import worth
from sgstore.base.tables import spread, taken
from sgstore.model.graph import Edges
from sgstore.model.pair_numbers import STOREY, TOUCH, UPRIGHT, all_level, climb, gap, low_and_high
from sgstore.model.vocabulary import KIND_CODE, MOST_KINDS, RELATION_CODE, SIGNALS, VEHICLES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.maps.roads import LaneHits
    from sgstore.model.config import Config
    from sgstore.model.world import Bools, Codes, Floats, Ints

    Nodes = NDArray[np.int32]
    Rows = NDArray[np.intp]
    Columns = tuple[Nodes, Codes, Nodes, Nodes]
    Looped = tuple[
        Rows, Rows, tuple[Nodes, Nodes], tuple[Floats, Floats, Floats], tuple[Floats, Floats]
    ]


CHUNK: Final = 1 << 16
"""Number of candidates that are processed together. It limits the memory and fits into a cache."""

FAR: Final = 1e9
"""Limit of interval ends; m. Ends beyond it are moved to it, which can only add candidate pairs."""

_ROUNDING: Final = 1e-15
"""Relative rounding error of interval ends, after the intervals of all groups are laid out on one line."""


def meeting(group: Ints, low: Floats, high: Floats) -> Iterator[tuple[Rows, Rows]]:
    """Yield the pairs of intervals in the same group that overlap, or almost overlap.

    Parameters
    ----------
    group : (N,) int64
        Not negative.
    low, high : (N,) float64
        Ends of the intervals. NaN overlaps nothing.

    Yields
    ------
    a, b : (n,) intp
        Rows, in chunks of about :data:`CHUNK`.
    """
    rows = np.flatnonzero(~np.isnan(low + high))
    if not len(rows):
        return
    group, low, high = group[rows], np.clip(low[rows], -FAR, FAR), np.clip(high[rows], -FAR, FAR)
    base = float(low.min())
    span = float(high.max()) - base + 1
    # All groups are laid in sequence: the intervals that overlap one are the next in order, up to
    # its end.
    start = group * span + (low - base)
    order = np.argsort(start, kind="stable")
    rows, start = rows[order], start[order]
    slack = _ROUNDING * span * (int(group.max()) + 2)
    end = group[order] * span + (high[order] - base) + slack
    first = np.arange(1, len(rows) + 1)
    count = np.searchsorted(start, end, side="right") - first
    for part in parts(count):
        owner, index = spread(first[part], count[part])
        yield rows[part][owner], rows[index]


def parts(count: Ints) -> Iterator[slice]:
    """Divide an array of counts into slices with sums of about :data:`CHUNK`. Yield the slices."""
    total = np.cumsum(count)
    bounds = np.searchsorted(total, np.arange(CHUNK, int(total[-1]), CHUNK)) if len(total) else []
    for begin, end in zip([0, *bounds], [*bounds, len(count)], strict=True):
        yield slice(begin, end)


# Input of a family of relations: the bodies of many frames, their related pairs, and the map under
# them. All of it is computed once per block and shared by the families. A *body* is an entity in
# one frame: an entity that stands still in sixty frames is sixty bodies, so that array arithmetic
# is enough.


@dataclass(frozen=True, slots=True)
class Bodies:
    """Objects in the graphs of a block of frames, one row per object and frame; shape (N,).

    Attributes
    ----------
    frame : int64
        Index of the frame in the block.
    node : int64
        Node id.
    kind : int8
        Codes of :data:`sgstore.model.vocabulary.KINDS`.
    moves : bool
        False for scenery.
    x, y, z, heading, length, width, height : float64
        The box; m, m, m, rad, m, m, m. A zero height of an upright kind is missing.
    carrier : int64
        Node id of its carrier or tractor; negative for none.
    band : float64
        Half width of the dead band of noisy positions; m. 0: exact.
    """

    frame: Ints
    node: Ints
    kind: Codes
    moves: Bools
    x: Floats
    y: Floats
    z: Floats
    heading: Floats
    length: Floats
    width: Floats
    height: Floats
    pitch: Floats
    carrier: Ints
    band: Floats

    def __len__(self) -> int:
        return len(self.node)

    def take(self, rows: NDArray[np.intp]) -> Bodies:
        """Return the objects of the given rows, in this order."""
        return taken(self, rows)

    @property
    def bottom(self) -> Floats:
        """Height of the lower side of each object, (N,); m. It is ``z`` if the object's height is unknown."""
        return self.z - np.nan_to_num(self.height) / 2

    @property
    def low_and_high(self) -> tuple[Floats, Floats]:
        """Heights of the lower and upper side of each object, (N,); m."""
        return low_and_high(self.z, self.height, IS_SIGNAL[self.kind], IS_UPRIGHT[self.kind])

    @property
    def boxes(self) -> Floats:
        """Footprints (ground rectangles) of the objects: ``x, y, heading, length, width``, (N, 5)."""
        return np.stack([self.x, self.y, self.heading, self.length, self.width], axis=1)


class BodyPairs:
    """Ordered pairs (a, b) of objects that can have relations. The second half repeats them as (b, a).

    Parameters
    ----------
    bodies : Bodies
    a, b : (K / 2,) intp
        Rows of bodies in the same frame, each pair once.
    between : str
        Reference points of the distance: :attr:`sgstore.model.config.Proximity.between`.
    """

    def __init__(self, bodies: Bodies, a: Rows, b: Rows, between: str) -> None:
        self._bodies, self._between = bodies, between
        self._halves, self._half = (a, b), len(a)

    def __len__(self) -> int:
        return 2 * self._half

    @cached_property
    def a(self) -> Rows:
        """Row of the first object of each pair in the table of objects, (K,)."""
        return np.concatenate(self._halves)

    @cached_property
    def b(self) -> Rows:
        """Row of the second object of each pair in the table of objects, (K,)."""
        return np.concatenate(self._halves[::-1])

    @cached_property
    def span(self) -> Floats:
        """Distance of each pair, once for (a, b) and (b, a), (K / 2,). Squared if not between footprints."""
        half = self._half
        found = np.empty(half)
        for part in even_parts(half):
            found[part] = spans(
                self._bodies, self._halves[0][part], self._halves[1][part], self._between
            )
        return found

    @cached_property
    def distance(self) -> Floats:
        """Distance of each object pair, measured as the settings define; m."""
        distance = self.span if self._between == "footprints" else np.sqrt(self.span)
        return np.concatenate([distance, distance])

    @cached_property
    def bearing(self) -> Floats:
        """Angle of b seen from a, in (-π, π]; rad. NaN without a's heading; 0 at the same position."""
        return self.bearings(np.arange(len(self)))

    def bearings(self, rows: Rows) -> Floats:
        """Return the angles of b seen from a for selected pairs; rad."""
        of, (a, b) = self._bodies, self.some(rows)
        return bearings(of.x[b] - of.x[a], of.y[b] - of.y[a], of.heading[a])

    def some(self, rows: Rows) -> tuple[Rows, Rows]:
        """Return the rows of both objects of selected pairs."""
        first, second = (half[rows % max(self._half, 1)] for half in self._halves)
        mirrored = rows >= self._half
        return np.where(mirrored, second, first), np.where(mirrored, first, second)

    @cached_property
    def offsets(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """How far b is ahead of a, and to the left of a; m. The error is below 1e-6 of the distance.

        NaN without a's heading, or with a heading beyond :data:`MOST_TURNED`.
        """
        of, half = self._bodies, self._half
        cos, sin = (column.astype(np.float32) for column in self._turns)
        ahead, left = np.empty((2, len(self)), np.float32)
        for part in even_parts(half):
            a, b = self._halves[0][part], self._halves[1][part]
            dx = (of.x[b] - of.x[a]).astype(np.float32)
            dy = (of.y[b] - of.y[a]).astype(np.float32)
            for rows, first in ((a, 0), (b, half)):
                to = slice(first + part.start, first + part.stop)
                ahead[to] = dx * cos[rows] + dy * sin[rows]
                left[to] = dy * cos[rows] - dx * sin[rows]
        np.negative(ahead[half:], out=ahead[half:])
        np.negative(left[half:], out=left[half:])
        return ahead, left

    @cached_property
    def for_loops(self) -> Looped:
        """The pairs as arrays for compiled loops: rows, frames, nodes, positions and headings."""
        of = self._bodies
        return (
            *self._halves,
            (of.frame.astype(np.int32), of.node.astype(np.int32)),
            (of.x, of.y, levels(of, self._between)),
            self._turns,
        )

    @cached_property
    def of_bodies(self) -> Bools:
        """Mask of solid pairs on one storey, once for (a, b) and (b, a), (K / 2,). Empty if all are such."""
        of = self._bodies
        plain = not (of.carrier >= 0).any() and not (of.height == 0).any()
        levels = of.low_and_high
        if plain and all_level(*levels):
            return np.zeros(0, np.bool_)
        return solid_pairs(of, *self._halves) & on_one_level(of, *self._halves)

    @property
    def in_loops(self) -> bool:
        """True if compiled loops can process the pairs. They do not support distances of footprints."""
        return self._between != "footprints" and worth()

    @cached_property
    def _turns(self) -> tuple[Floats, Floats]:
        heading = self._bodies.heading
        heading = np.where(np.abs(heading) <= MOST_TURNED, heading, np.nan)
        return np.cos(heading), np.sin(heading)

    @cached_property
    def ends(self) -> tuple[Nodes, Nodes, Nodes]:
        """Frame of each pair, and the node ids of a and b; int32."""
        frame, node = self._bodies.frame.astype(np.int32), self._bodies.node.astype(np.int32)
        frame, one, other = frame[self._halves[0]], node[self._halves[0]], node[self._halves[1]]
        return (
            np.concatenate([frame, frame]),
            np.concatenate([one, other]),
            np.concatenate([other, one]),
        )


MOST_TURNED: Final = 1e3
"""Largest heading whose rounding error stays below a tenth of a nanoradian; rad."""

EVEN_PART: Final = 1 << 13
"""Number of pairs that are computed together, so that their values fit into the fastest cache."""


def by_frame(frame: Ints, frames: int) -> tuple[Rows, Ints]:
    """Return row numbers sorted by frame, and the index at which each frame begins."""
    order = np.argsort(frame, kind="stable")
    return order, np.searchsorted(frame[order], np.arange(frames + 1))


def turns(bodies: Bodies) -> tuple[Floats, Floats]:
    """Return the cosine and sine of each object's heading."""
    return np.cos(bodies.heading), np.sin(bodies.heading)


def even_parts(count: int) -> Iterator[slice]:
    """Yield slices that together cover ``count`` rows, each with at most :data:`EVEN_PART` rows."""
    for start in range(0, count, EVEN_PART):
        yield slice(start, min(start + EVEN_PART, count))


def distances(bodies: Bodies, a: Rows, b: Rows, between: str) -> Floats:
    """Return the distances of object pairs, between centres or footprints as the settings define; m.

    The origin of a moving vehicle is on the ground, that of other bodies in the centre of the box,
    as in CARLA. A footprint without extent or heading is a point.
    """
    found = spans(bodies, a, b, between)
    return found if between == "footprints" else np.sqrt(found)


def spans(bodies: Bodies, a: Rows, b: Rows, between: str) -> Floats:
    """Return numbers that ascend with the distances of object pairs: squares, or gaps of footprints."""
    if between == "footprints":
        boxes = bodies.boxes
        boxes[np.isnan(boxes).any(axis=1), 2:] = 0
        return gap(boxes[a], boxes[b])
    places = (bodies.x, bodies.y, levels(bodies, between))
    dx, dy, dz = (of[b] - of[a] for of in places)
    dz = np.where(np.isnan(dz), 0.0, dz)  # in the plane if a height is unknown
    return dx * dx + dy * dy + dz * dz


def heights_meet(bodies: Bodies, a: Rows, b: Rows) -> Bools:
    """Return a mask of the object pairs with overlapping height ranges. True if a height is unknown."""
    low, high = bodies.low_and_high
    reach = np.fmax(low[b] - high[a], low[a] - high[b])
    solid = high > low
    return ~np.where(solid[a] & solid[b], reach > TOUCH, np.abs(low[b] - low[a]) > STOREY)


def on_one_level(bodies: Bodies, a: Rows, b: Rows) -> Bools:
    """Return a mask of the object pairs on the same storey. True if a height is unknown.

    Two bodies are on one storey if they overlap in height, or if a climbing road can join them.
    """
    level = heights_meet(bodies, a, b)
    rest = np.flatnonzero(~level)
    a, b = a[rest], b[rest]
    low, _ = bodies.low_and_high
    away = np.hypot(bodies.x[b] - bodies.x[a], bodies.y[b] - bodies.y[a])
    level[rest] = np.abs(low[b] - low[a]) <= climb(away, bodies.pitch[a], bodies.pitch[b])
    return level


def solid_pairs(bodies: Bodies, a: Rows, b: Rows) -> Bools:
    """Return a mask of the pairs of solid objects, except a carrier and its load."""
    flat = ~IS_UPRIGHT[bodies.kind] & (bodies.height == 0)
    return ~(flat[a] | flat[b] | carried_by(bodies, a, b))


def carried_by(bodies: Bodies, a: Rows, b: Rows) -> Bools:
    """Return a mask of the object pairs that are a carrier and its load, or loads of the same carrier."""
    carrier, node = bodies.carrier, bodies.node
    bound = (carrier[a] == node[b]) | (carrier[b] == node[a])
    return bound | (carrier[a] >= 0) & (carrier[a] == carrier[b])


def levels(bodies: Bodies, between: str) -> Floats:
    """Return the height of the point of each object from which distances are measured; m."""
    if between != "origins":
        return bodies.z
    on_ground: Bools = bodies.moves & IS_VEHICLE[bodies.kind]
    return np.where(on_ground, bodies.bottom, bodies.z)


def span_up_to(distance: float, between: str) -> float:
    """Convert a distance limit to the scale of :func:`spans`: for example, to the square of the limit."""
    if between == "footprints":
        return distance
    span = distance * distance
    while math.sqrt(math.nextafter(span, math.inf)) <= distance:
        span = math.nextafter(span, math.inf)
    while math.sqrt(span) > distance:
        span = math.nextafter(span, 0.0)
    return span


@dataclass(frozen=True, slots=True)
class Standing:
    """Map parts (lanes, crosswalks) below the objects of a block. They are the same for all egos.

    Attributes
    ----------
    hits : LaneHits
        Lanes that bodies touch; ``row`` is a row of :class:`Bodies`, ascending. Empty for signals.
    along : float64
        Place of the body's centre along the lane of each hit, also beyond its ends; m.
    own : bool
        True if the lane of the hit is one of the body's own
        (:func:`sgstore.graphs.relations._following.own_hits`).
    parts : tuple of int64 arrays
        Rows of :class:`Bodies`, ascending, and node ids of their crosswalks and waypoints.
    off_road : intp array
        Rows of the bodies that touch no driving lane, ascending.
    unsure : intp array
        Rows of the bodies whose driven lane is not sure in online mode. All lanes for traffic that they
        touch are their own.
    """

    hits: LaneHits
    along: Floats
    own: Bools
    parts: tuple[Ints, Ints]
    off_road: NDArray[np.intp]
    unsure: NDArray[np.intp]

    def take(self, place: NDArray[np.intp]) -> Standing:
        """Return the map parts below some of the objects. These objects get new row numbers."""
        hits, (rows, nodes) = self.hits, self.parts
        kept, there = place[hits.row] >= 0, place[rows] >= 0
        hits = taken(hits, kept)
        off_road, unsure = place[self.off_road], place[self.unsure]
        return Standing(
            replace(hits, row=place[hits.row]),
            self.along[kept],
            self.own[kept],
            (place[rows[there]], nodes[there]),
            off_road[off_road >= 0],
            unsure[unsure >= 0],
        )


@dataclass(frozen=True, slots=True)
class MapContext:
    """Map parts below the objects of a block of frames, and map parts in range of the egos.

    Attributes
    ----------
    standing : Standing
    present : (F, K) bool
        Mask of the map nodes in each graph; column i is node -1 - i.
    controls, affects : tuple of int64 arrays
        Node ids of signals of the trace, ascending, and of a lane that each one controls or may
        affect.
    map_affects : tuple of int64 arrays
        Node ids of signals of the map, and of a lane that each may affect.
    following : tuple of intp, intp, float64 arrays
        Rows of bodies: the follower, its leader, and the gap along the lanes; m.
    unsure : intp array
        Rows of the bodies whose other leaders are unknown, because a driven lane is not sure.
    """

    standing: Standing
    present: Bools
    controls: tuple[Ints, Ints]
    affects: tuple[Ints, Ints]
    map_affects: tuple[Ints, Ints]
    following: tuple[NDArray[np.intp], NDArray[np.intp], Floats]
    unsure: NDArray[np.intp]


def _columns_of(count: int) -> Columns:
    frame, src, dst = np.empty((3, count), np.int32)
    return frame, np.empty(count, np.int8), src, dst


class EdgeRoom:
    """Memory for the edges of a block of frames. All relations write into the same arrays.

    Therefore edges are written once. A family can also return its own columns, which are copied at
    the end.

    Parameters
    ----------
    count : int
        Capacity in edges.
    """

    def __init__(self, count: int = 0) -> None:
        self._columns = _columns_of(count)
        self._parts: list[Edges] = []
        self._used = 0

    def rest(self, count: int) -> Columns:
        """Return arrays with space for ``count`` or more edges."""
        if self._used + count > len(self._columns[0]):
            return _columns_of(count)
        frame, relation, src, dst = self._columns
        first = self._used
        return frame[first:], relation[first:], src[first:], dst[first:]

    def filled(self, columns: Columns, count: int, more: Edges | None = None) -> Edges:
        """Return the first ``count`` edges in the arrays as a table, with ``more`` edges appended."""
        if more is not None and len(more):
            if count + len(more) > len(columns[0]):
                return Edges.chained([self.filled(columns, count), more])
            _fill(columns, count, more)
            count += len(more)
        edges = _first(columns, count)
        if count and columns[0].base is self._columns[0].base:
            self._parts.append(edges)
            self._used += count
        return edges

    def chained(self, parts: Sequence[Edges]) -> Edges:
        """Concatenate tables of edges. Edges that are already in these arrays are not copied."""
        others = [part for part in parts if not any(part is own for own in self._parts)]
        count = self._used + sum(map(len, others))
        if len(parts) - len(others) < len(self._parts) or count > len(self._columns[0]):
            return Edges.chained(parts)
        for part in others:
            _fill(self._columns, self._used, part)
            self._used += len(part)
        return _first(self._columns, count)


def _first(columns: Columns, count: int) -> Edges:
    frame, relation, src, dst = columns
    return Edges(frame[:count], relation[:count], src[:count], dst[:count])


def _fill(columns: Columns, first: int, edges: Edges) -> None:
    to = slice(first, first + len(edges))
    for column, values in zip(
        columns, (edges.frame, edges.relation, edges.src, edges.dst), strict=True
    ):
        column[to] = values


@dataclass(frozen=True, slots=True)
class BlockScene:
    """Frames of a block with objects, object pairs, contacts and map parts: the input of all relations.

    Attributes
    ----------
    config : Config
    bodies : Bodies
    ego : (F,) intp
        Row of the ego of each frame, or -1.
    pairs : BodyPairs
    contacts : tuple of intp arrays
        Rows of bodies that touch, each pair once.
    ground : MapContext or None
        ``None`` without a map.
    room : EdgeRoom
        Shared columns for the edges.
    """

    config: Config
    bodies: Bodies
    ego: NDArray[np.intp]
    pairs: BodyPairs
    contacts: tuple[NDArray[np.intp], NDArray[np.intp]]
    ground: MapContext | None
    room: EdgeRoom = field(default_factory=EdgeRoom)

    def parameters(self, relation: Relation) -> Mapping[str, Any]:
        """Return the parameters of a relation from the settings, with defaults for missing values."""
        return {**relation.parameters, **self.config.relations.get(relation.name, {})}


def always(config: Config) -> bool:
    """Return True: this is the test for a relation that all settings request."""
    return True


@dataclass(frozen=True, slots=True, kw_only=True)
class Relation:
    """Declaration of a relation (edge type) of scene graphs, with the function that computes it.

    Attributes
    ----------
    name : str
        Letters, digits and ``_``, a letter first; compared without regard to case and underscores.
    doc : str
        Its meaning, for tables: source, target and condition.
    edges : function, optional
        Pure function that returns the edges of a scene. Relations that share a function are
        computed together; it may yield edges of any of them. ``None`` means that the relation comes
        with the map.
    symmetric : bool
        True if each edge has its mirror image.
    needs_map : bool
        True if it is unknown without a map. Otherwise :attr:`BlockScene.ground` can be ``None``.
    needs_lanes : bool
        True if one end is a lane; it is then unknown without lanes.
    of_map : bool
        True if it also holds among parts of a map; then every map provides it.
    of_pairs : bool
        True if it holds between related pairs (:attr:`BlockScene.pairs`); it is then unknown if the
        settings relate no pairs.
    settings : function
        Function that returns True if a config requests it.
    parameters : mapping
        Its settings, by name with defaults, for ``[relations.NAME]`` of a config; numbers, texts,
        true or false. See :meth:`BlockScene.parameters`.
    legend : str
        Short text for the legend of a picture, seen from the other end; empty means the name.
    """

    name: str
    doc: str
    edges: Callable[[BlockScene], Edges] | None = None
    symmetric: bool = False
    needs_map: bool = False
    needs_lanes: bool = False
    of_map: bool = False
    of_pairs: bool = False
    settings: Callable[[Config], bool] = always
    parameters: Mapping[str, Any] = field(default_factory=dict[str, Any], hash=False)
    legend: str = ""

    def asked(self, config: Config) -> bool:
        """Return True if the settings request this relation (edge type) in the graphs."""
        return self.settings(config) and (not self.of_pairs or relates_pairs(config))


def relates_pairs(config: Config) -> bool:
    """Return True if the settings request at least one relation between objects."""
    return config.pairs.ego or config.pairs.within > 0


def edges_between(
    scene: BlockScene, relation: str | Codes, src: NDArray[np.intp], dst: NDArray[np.intp]
) -> Edges:
    """Return edges between objects (given as row numbers). Their relation is one for all, or one for each."""
    bodies = scene.bodies
    return Edges(
        bodies.frame[src], _relation_codes(relation, len(src)), bodies.node[src], bodies.node[dst]
    )


def edges_of_pairs(
    scene: BlockScene, codes: Codes, holds: Bools, *, seen_by_a: bool = False
) -> tuple[Columns, int]:
    """Return the edges of the object pairs in a mask. Each pair has its own relation code.

    Parameters
    ----------
    scene : BlockScene
    codes : (K,) int8
        Codes of the relations.
    holds : (K,) bool
    seen_by_a : bool

    Returns
    -------
    columns, count
        Input of :meth:`EdgeRoom.filled`.
    """
    columns = scene.room.rest(len(codes))
    frame, src, dst = scene.pairs.ends
    if seen_by_a:
        src, dst = dst, src
    rows = None if holds.all() else np.flatnonzero(holds)
    count = len(codes) if rows is None else len(rows)
    for column, values in zip(columns, (frame, codes, src, dst), strict=True):
        if rows is None:
            column[:count] = values
        else:
            # This copies only the selected rows.
            np.take(values, rows, out=column[:count], mode="clip")
    return columns, count


def edges_to_map(
    scene: BlockScene, relation: str, src: NDArray[np.intp] | Ints, dst: Ints
) -> Edges:
    """Return edges with one relation, from objects (row numbers) to map nodes (node ids)."""
    bodies = scene.bodies
    return Edges(bodies.frame[src], _relation_codes(relation, len(src)), bodies.node[src], dst)


def _relation_codes(relation: str | Codes, count: int) -> Codes:
    if isinstance(relation, str):
        return np.full(count, RELATION_CODE[relation], np.int8)
    return relation


def kinds_mask(names: tuple[str, ...]) -> Bools:
    """Return an array of truth values, indexed by kind code: True for the given kinds."""
    table = np.zeros(MOST_KINDS, np.bool_)
    table[[KIND_CODE[name] for name in names]] = True
    return table


IS_SIGNAL: Final = kinds_mask(SIGNALS)
IS_VEHICLE: Final = kinds_mask(VEHICLES)
IS_UPRIGHT: Final = kinds_mask(UPRIGHT)
IS_USER: Final = kinds_mask((*VEHICLES, "person", "animal"))


def joined(keys: Ints, wanted: Ints) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return all pairs of rows with equal values in two arrays: row of ``wanted``, row of ``keys``."""
    start = np.searchsorted(keys, wanted)
    return spread(start, np.searchsorted(keys, wanted, side="right") - start)
