"""Abstractions from the literature. Each makes simpler labelled graphs from scene graphs.

They are ``E``, ``EL``, ``ER``, ``RSV``, ``junction`` and ``SG``.

The names come from S3C (Woodlief et al., 2024) and CARLASGG. Except in ``SG``, entities are
traffic, people, animals, signals and props, without scenery (buildings, poles, barriers,
vegetation). An entity is labelled with its kind, the ego with ``ego``. Relations are proximity,
direction, and left and right. The literature has no ``leads``, ``follows``, ``overlaps``, ``sees``
and ``conflictsWith``.

These rules apply where our graphs have more than those of the literature:

* ``EL``, ``RSV``: lanes are driving strands (:mod:`sgstore.graphs.abstractions._lane_roles`). ``Ego Lane`` is
  the strand of the ego's primary lane. Strands next to it with the same direction are ``Left n``
  and ``Right n of Ego Lane``, if they are in range. Any other strand with an entity is an
  ``Opposing Lane k`` (CARLASGG's word, for both directions), ordered by the distance of its nearest
  entity from the ego, then by node id. If the ego's place or lane is unknown, the label is
  ``Lane``. All lanes are in ``Root Road``. Off-road entities are in ``Off Road``.
* ``RSV_related``, ``RSV_curvature``: ``RSV`` with CARLASGG's ``filter_if_no_relation``, and with the
  curvature in the name of the ego's lane.
* ``junction``: lanes, roads and junctions of the map. The sections of a road are merged, as in
  CARLASGG: its lanes have names such as ``Lane 5_-1``. Names do not count for the class: a driving
  lane is labelled ``Lane``, another lane with its type. Therefore the same scene in another place
  has the same class.
* ``SG``: the complete scene graph; with waypoints if ingest was configured for them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.graphs.abstractions._columns import EGO, Labelled, repeated
from sgstore.graphs.abstractions._lane_roles import (
    NAMELESS,
    OFF_ROAD,
    UNNAMED,
    ego_lanes,
    role_name,
    strands_of,
)
from sgstore.graphs.abstractions._subsets import BETWEEN_ENTITIES, OF_JUNCTION
from sgstore.model.vocabulary import (
    KIND_CODE,
    KINDS,
    MOST_KINDS,
    MOST_RELATIONS,
    RELATION_CODE,
    RELATIONS,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.graphs.abstractions._columns import GraphColumns, MapColumns, Part
    from sgstore.model.world import Bools, Floats, Ints


ROOT_ROAD: Final = -(1 << 40)
"""Node id of the node ``Root Road``."""

_MAPS: Final = 4
"""Number of road maps whose results are cached."""

_IS_IN: Final = RELATION_CODE["isIn"]
_ON_ROADS: Final = np.zeros(MOST_RELATIONS, np.bool_)
_ON_ROADS[[RELATION_CODE[r] for r in OF_JUNCTION if r not in BETWEEN_ENTITIES]] = True


def _kind_labels() -> tuple[str, ...]:
    """Return the node labels that abstractions use: one per kind, in the order of codes, then ``ego``."""
    return (*KINDS, EGO)


def entities(seen: GraphColumns) -> Labelled:
    """Abstraction ``E``: only the traffic objects, without edges."""
    return Labelled.assembled(seen.frames, [_entities(seen)], [], _kind_labels())


def related(seen: GraphColumns) -> Labelled:
    """Abstraction ``ER``: the traffic objects and the relations between them."""
    labels = (*_kind_labels(), *RELATIONS)
    edges, bundles = _relations(seen)
    return Labelled.assembled(seen.frames, [_entities(seen)], [edges], labels, bundles=bundles)


def in_lanes(seen: GraphColumns) -> Labelled:
    """Abstraction ``EL``: the traffic objects, and the lanes of each, named relative to the ego."""
    return _with_lanes(seen, related=False)


def road_scene(seen: GraphColumns) -> Labelled:
    """Abstraction ``RSV``: the traffic objects, their relations, and their lanes named relative to the ego."""
    return _with_lanes(seen, related=True)


def related_scene(seen: GraphColumns) -> Labelled:
    """Abstraction ``RSV_related``: ``RSV`` with only the objects related to the ego, and their lanes."""
    found = road_scene(replace(seen, **_rows(seen, _OF_NODES, _related_to_ego(seen))))
    inside = (found.src >= 0) & (found.dst < 0)
    used = np.unique(np.stack([found.frame[inside], found.dst[inside]]), axis=1)
    rooted = np.unique(used[0][used[1] != OFF_ROAD])
    wanted = {*zip(*used.tolist(), strict=True), *((one, ROOT_ROAD) for one in rooted.tolist())}
    return replace(
        found,
        **_rows(found, _OF_LABELLED, _among(found.node_frame, found.node, wanted)),
        **_rows(found, _OF_EDGES, _among(found.frame, found.src, wanted)),
    )


def _related_to_ego(seen: GraphColumns) -> Bools:
    """Return a mask of the nodes to keep: map parts, scenery, the ego, and objects with a relation to it."""
    ego = np.full(seen.frames, -1)
    ego[seen.node_frame[seen.is_ego]] = seen.node[seen.is_ego]
    frame, src, dst, _ = seen.pairs
    of_ego = (src == ego[frame]) | (dst == ego[frame])
    other = np.where(src == ego[frame], dst, src)[of_ego]
    kept = ~seen.is_traffic | seen.is_ego
    kept[seen.row_of(frame[of_ego], other)] = True
    return kept


def _among(frame: Ints, node: Ints, wanted: set[tuple[int, int]]) -> Bools:
    """Return a mask of all objects, and of the map parts that occur as (frame, node) in ``wanted``."""
    pairs = zip(frame.tolist(), node.tolist(), strict=True)
    return np.array([one[1] >= 0 or one in wanted for one in pairs], np.bool_)


def _rows(table: Any, names: Sequence[str], kept: Bools) -> dict[str, Any]:
    return {name: getattr(table, name)[kept] for name in names}


_OF_LABELLED: Final = ("node_frame", "node", "node_label")
_OF_EDGES: Final = ("frame", "src", "label", "dst")
_OF_NODES: Final = ("node_frame", "node", "kind", "is_ego", "x", "y", "z", "heading")


def curved_scene(seen: GraphColumns) -> Labelled:
    """Abstraction ``RSV_curvature``: ``RSV`` with the curve class of the ego's lane, such as ``Ego Lane@-2``.

    The number counts the thresholds :data:`BENDS` that the turn of the lane over 2 m exceeds; it is positive to
    the left. Without a known curvature, the name stays ``Ego Lane``.
    """
    found, grounds = road_scene(seen), seen.grounds
    if grounds is None or seen.ego_along is None or not len(grounds.courses[0]):
        return found
    lane, start, curvature = grounds.courses
    known = np.flatnonzero((seen.ego_lane < 0) & np.isfinite(seen.ego_along))
    far = 1.0 + max(float(start.max()), float(np.max(seen.ego_along[known], initial=0.0)))
    wanted = -seen.ego_lane[known] * far + np.maximum(seen.ego_along[known], 0.0)
    at = np.searchsorted(-lane * far + start, wanted, side="right") - 1
    known, at = known[(at >= 0)], at[at >= 0]
    same = lane[at] == seen.ego_lane[known]
    number = np.full(seen.frames, len(BENDS) + 1)
    number[known[same]] = _bend(curvature[at[same]])
    names = [f"Ego Lane@{bin_}" for bin_ in range(-len(BENDS), len(BENDS) + 1)]
    ego = found.labels.index("Ego Lane") if "Ego Lane" in found.labels else -1
    rows = np.flatnonzero((found.node_label == ego) & (number[found.node_frame] <= len(BENDS)))
    label = found.node_label.copy()
    label[rows] = len(found.labels) + len(BENDS) + number[found.node_frame[rows]]
    return replace(found, labels=(*found.labels, *names), node_label=label)


def _bend(curvature: Floats) -> Ints:
    """Return how many thresholds each curvature exceeds: positive in left curves, negative in right curves."""
    turn = np.degrees(curvature * 2.0)
    return np.sign(turn).astype(np.int64) * np.searchsorted(BENDS, np.abs(turn), side="left")


BENDS: Final = (1.0, 2.5, 5.0, 7.5, 10.0)
"""Thresholds for the change of direction of a lane over 2 m, as in CARLASGG; degrees."""


def whole(seen: GraphColumns) -> Labelled:
    """Abstraction ``SG``: the complete scene graph."""
    label = np.where(seen.is_ego, len(KINDS), seen.kind)
    first = len(_kind_labels())
    frame, relation, src, dst = seen.lasting(range(len(RELATIONS)))
    edges = [
        (seen.frame, seen.src, first + seen.relation.astype(np.int64), seen.dst),
        (frame, src, first + relation.astype(np.int64), dst),
    ]
    labels = [*_kind_labels(), *RELATIONS]
    if seen.grounds is not None:
        label, more = _with_roles(seen, seen.grounds, label, len(labels))
        labels += more
    nodes = [(seen.node_frame, seen.node, label)]
    return Labelled.assembled(seen.frames, nodes, edges, labels, _names(seen.grounds))


def _with_roles(
    seen: GraphColumns, grounds: MapColumns, label: Ints, first: int
) -> tuple[Ints, list[str]]:
    """Return the label of each node. A lane whose name is a role relative to the ego gets the role as label."""
    named = strands_of(grounds).named
    roles = np.unique(named[named != UNNAMED])
    if not len(roles):
        return label, []
    part = np.clip(-1 - seen.node, 0, len(named) - 1)
    role = np.where(seen.node < 0, named[part], UNNAMED)
    at = np.minimum(np.searchsorted(roles, role), len(roles) - 1)
    named_label = np.where(role == UNNAMED, label, first + at)
    return named_label, [role_name(one) for one in roles.tolist()]


def junction(seen: GraphColumns) -> Labelled:
    """Abstraction ``junction``: traffic objects and their relations, lanes, roads and junctions."""
    grounds = seen.grounds
    first = len(_kind_labels())
    wanted = [RELATION_CODE[name] for name in OF_JUNCTION]
    nodes, kept = [_entities(seen)], seen.is_traffic
    labels = [*_kind_labels(), *RELATIONS]
    edges: list[Part] = []
    if grounds is not None:
        whose = _merged(grounds)
        own = [KIND_CODE[name] for name in ("lane", "road", "junction", "off_road")]
        rows = np.flatnonzero(np.isin(seen.kind, own))
        label, more = _ground_labels(grounds, len(labels))
        labels += more
        nodes.append(
            (
                seen.node_frame[rows],
                whose[-1 - seen.node[rows]],
                label[-1 - seen.node[rows]],
            )
        )
        kept = kept.copy()
        kept[rows] = True
        edges.append(_drawn(seen, kept, seen.lasting(wanted), whose))
    moving = np.flatnonzero(_ON_ROADS[seen.relation])
    columns = (seen.frame[moving], seen.relation[moving], seen.src[moving], seen.dst[moving])
    edges.append(_drawn(seen, kept, columns, None if grounds is None else _merged(grounds)))
    parts: list[Part] = [(frame, src, first + relation, dst) for frame, relation, src, dst in edges]
    between, bundles = _relations(seen)
    parts.append(between)
    return Labelled.assembled(seen.frames, nodes, parts, labels, _names(grounds), bundles)


def _drawn(seen: GraphColumns, kept: Bools, columns: Part, whose: Ints | None) -> Part:
    """Return the edges after nodes were merged (such as sections of a lane), without duplicates and loops."""
    frame, relation, src, dst = columns
    a, b = seen.row_of(frame, src), seen.row_of(frame, dst)
    both = (a >= 0) & (b >= 0) & kept[a] & kept[b]
    frame, relation, src, dst = frame[both], relation[both].astype(np.int64), src[both], dst[both]
    if whose is None or not len(frame):
        return frame, relation, src, dst
    of_map = (src < 0) | (dst < 0)
    src, dst = _standing_for(whose, src), _standing_for(whose, dst)
    rows = np.flatnonzero(of_map)
    again = repeated((frame[rows], relation[rows], src[rows], dst[rows]))
    keep = np.ones(len(frame), np.bool_)
    keep[rows[again]] = False
    keep &= src != dst
    return frame[keep], relation[keep], src[keep], dst[keep]


def _standing_for(whose: Ints, node: Ints) -> Ints:
    return np.where(node < 0, whose[np.clip(-1 - node, 0, len(whose) - 1)], node)


@lru_cache(maxsize=_MAPS)
def _merged(grounds: MapColumns) -> Ints:
    """Return for each map node the node that represents it. All sections of a lane have the same one."""
    found = -1 - np.arange(len(grounds.kind))
    lanes = np.flatnonzero(grounds.kind == KIND_CODE["lane"])
    first: dict[tuple[str, int, str], int] = {}
    keys = zip(grounds.road[lanes], grounds.lane[lanes].tolist(), strict=True)
    for row, (road, lane) in zip(lanes.tolist(), keys, strict=True):
        if not road:  # only a name: a graph from another source
            continue
        key = (road, lane, "Lane" if grounds.driving[row] else grounds.lane_type[row])
        found[row] = first.setdefault(key, -1 - row)
    return found


@lru_cache(maxsize=_MAPS)
def _ground_labels(grounds: MapColumns, first: int) -> tuple[Ints, list[str]]:
    """Return the label of each map node (such as ``Lane`` or a lane type), and the texts of all labels."""
    words = {"road": "Road", "junction": "Junction", "off_road": "Off Road"}
    text: list[str] = [
        ("Lane" if driven else f"Lane ({kind_of_lane or 'none'})")
        if KINDS[kind] == "lane"
        else words.get(str(KINDS[kind]), str(KINDS[kind]))
        for kind, kind_of_lane, driven in zip(
            grounds.kind.tolist(), grounds.lane_type, grounds.driving.tolist(), strict=True
        )
    ]
    named = strands_of(grounds).named
    for row in np.flatnonzero(named != UNNAMED).tolist():
        text[row] = role_name(int(named[row]))
    table = {label: first + i for i, label in enumerate(dict.fromkeys(text))}
    return np.array([table[label] for label in text], np.int64), list(table)


@lru_cache(maxsize=_MAPS)
def _names(grounds: MapColumns | None) -> dict[int, str]:
    """Return the names of map nodes as in the literature: node id → name."""
    if grounds is None:
        return {}
    names: dict[int, str] = {}
    columns = zip(
        grounds.kind.tolist(), grounds.name, grounds.road, grounds.lane.tolist(), strict=True
    )
    for row, (kind, name, road, lane) in enumerate(columns):
        match KINDS[kind]:
            case "lane":
                names[-1 - row] = f"Lane {road}_{lane:+d}" if road else str(name)
            case "road":
                names[-1 - row] = f"Road {name}"
            case "junction":
                names[-1 - row] = f"Junction {name}"
            case "off_road":
                names[-1 - row] = "Off Road"
            case _:
                pass
    return names


def _entities(seen: GraphColumns) -> Part:
    rows = np.flatnonzero(seen.is_traffic)
    label = np.where(seen.is_ego[rows], len(KINDS), seen.kind[rows])
    return seen.node_frame[rows], seen.node[rows], label


def _relations(seen: GraphColumns) -> tuple[Part, list[list[int]]]:
    """Return the edges between traffic objects. The label of each edge is a set of relations."""
    frame, src, dst, bits = seen.pairs
    distinct, number = np.unique(bits, return_inverse=True)
    first = len(_kind_labels())
    bundles = [
        [first + code for code in range(len(RELATIONS)) if one >> code & 1]
        for one in distinct.tolist()
    ]
    return (frame, src, -1 - number, dst), bundles


def _with_lanes(seen: GraphColumns, *, related: bool) -> Labelled:
    labels = [*_kind_labels(), *RELATIONS]
    between, bundles = _relations(seen) if related else (None, [])
    nodes, edges = [_entities(seen)], [between] if between else []
    if seen.grounds is not None:
        lanes, inside, names = _lanes(seen, len(labels))
        labels += names
        nodes += lanes
        edges += inside
    return Labelled.assembled(seen.frames, nodes, edges, labels, bundles=bundles)


def _lanes(seen: GraphColumns, first: int) -> tuple[list[Part], list[Part], list[str]]:
    """Return the lanes relative to the ego as nodes, ``isIn`` edges and label texts."""
    is_in = len(_kind_labels()) + _IS_IN
    lanes = ego_lanes(seen)
    roots = np.unique(lanes.frame)
    frame, src = lanes.off_road
    off_frames = np.unique(frame)
    names = ["Root Road", "Off Road", "Lane"]
    present = np.unique(lanes.role)
    label = first + len(names) + np.searchsorted(present, lanes.role)
    label[lanes.role == NAMELESS] = first + 2
    names += [role_name(one) if one != NAMELESS else "Lane" for one in present.tolist()]
    nodes = [
        (lanes.frame, lanes.strand, label),
        (roots, np.full(len(roots), ROOT_ROAD), np.full(len(roots), first)),
        (off_frames, np.full(len(off_frames), OFF_ROAD), np.full(len(off_frames), first + 1)),
    ]
    in_frame, inner, strand = lanes.inside
    edges = [
        (in_frame, inner, np.full(len(inner), is_in), strand),
        (
            lanes.frame,
            lanes.strand,
            np.full(len(lanes.frame), is_in),
            np.full(len(lanes.frame), ROOT_ROAD),
        ),
        (frame, src, np.full(len(src), is_in), np.full(len(src), OFF_ROAD)),
    ]
    return nodes, edges, names


# ``roadscene2vec``: graphs of the tool of that name (Malawade et al., 2022), with its own
# thresholds. Its actors (``car`` for all large vehicles, ``moto``, ``bicycle``, ``ped``, ``light``,
# ``sign``) are related to the ego, ``ego_car``, only. ``Root Road`` has three lanes. The middle
# lane contains the ego and all actors with the centre within 6 m to its left and right; the others
# are in the left or right lane. A distance gets the first of five names whose threshold it does not
# exceed. Bins of direction include both ends, so that exactly 45° gives two relations. Static
# entities have no relations. Errors of the tool are not imitated: its angle for CARLA is the
# difference of yaws.

ACTORS: Final[Mapping[str, str]] = {
    **dict.fromkeys(("car", "truck", "van", "bus", "trailer", "vehicle"), "car"),
    "motorcycle": "moto",
    "bicycle": "bicycle",
    "person": "ped",
    "traffic_light": "light",
    **dict.fromkeys(("stop_sign", "yield_sign", "speed_limit", "sign"), "sign"),
}
"""Kind of entity → actor type of roadscene2vec, which knows no other types."""

PROXIMITY: Final = (
    ("near_coll", 4.0),
    ("super_near", 7.0),
    ("very_near", 10.0),
    ("near", 16.0),
    ("visible", 25.0),
)
"""Distance relations of roadscene2vec with their limits between centres in 3D; m."""

DIRECTIONS: Final = (
    ("inDFrontOf", 0.0, 45.0),
    ("inSFrontOf", 45.0, 90.0),
    ("atSRearOf", 90.0, 135.0),
    ("atDRearOf", 135.0, 180.0),
)
"""Direction relations of roadscene2vec with their ranges of angles, both ends included; degrees."""

LANE_THRESHOLD: Final = 6.0
"""Half the width of the middle lane in roadscene2vec; m."""

LANES: Final = ("Left Lane", "Middle Lane", "Right Lane")

_NODES: Final = (*dict.fromkeys(ACTORS.values()), "ego_car", "Root Road", *LANES)
_EDGES: Final = (
    "isIn",
    *(name for name, _ in PROXIMITY),
    *(name for name, *_ in DIRECTIONS),
    *("toLeftOf", "toRightOf"),
)
_LABELS: Final = (*_NODES, *_EDGES)
_LABEL: Final = {text: i for i, text in enumerate(_LABELS)}
_ACTOR: Final = np.full(MOST_KINDS, -1)
_ACTOR[[KIND_CODE[kind] for kind in ACTORS]] = [_LABEL[actor] for actor in ACTORS.values()]
_LANE_NODES: Final = ROOT_ROAD - 1 - np.arange(len(LANES))


def roadscene2vec(seen: GraphColumns) -> Labelled:
    """Abstraction ``roadscene2vec``: objects with relations to the ego, each in one of three lanes."""
    label = np.where(seen.is_ego, _LABEL["ego_car"], _ACTOR[seen.kind])
    rows = np.flatnonzero(label >= 0)
    frames = np.arange(seen.frames)
    fixed = [(frames, np.full(seen.frames, ROOT_ROAD), np.full(seen.frames, _LABEL["Root Road"]))]
    edges: list[Part] = []
    for name, node in zip(LANES, _LANE_NODES.tolist(), strict=True):
        lane = np.full(seen.frames, node)
        fixed.append((frames, lane, np.full(seen.frames, _LABEL[name])))
        edges.append((frames, lane, _all(frames, "isIn"), np.full(seen.frames, ROOT_ROAD)))
    nodes = [(seen.node_frame[rows], seen.node[rows], label[rows]), *fixed]
    return Labelled.assembled(
        seen.frames,
        nodes,
        [*edges, *_of_ego(seen, rows)],
        _LABELS,
    )


def _all(rows: NDArray[np.signedinteger], label: str) -> NDArray[np.signedinteger]:
    return np.full(len(rows), _LABEL[label])


def _of_ego(seen: GraphColumns, rows: NDArray[np.signedinteger]) -> list[Part]:
    """Return the edges of each object to its lane (left, middle or right), and to and from the ego."""
    ego = np.full(seen.frames, -1)
    own = np.flatnonzero(seen.is_ego)
    ego[seen.node_frame[own]] = own
    middle = int(_LANE_NODES[1])
    edges = [(seen.node_frame[own], seen.node[own], _all(own, "isIn"), np.full(len(own), middle))]
    rows = rows[(ego[seen.node_frame[rows]] >= 0) & ~seen.is_ego[rows]]
    at = ego[seen.node_frame[rows]]
    dx, dy, dz = (getattr(seen, axis)[rows] - getattr(seen, axis)[at] for axis in "xyz")
    heading = seen.heading[at]
    ahead = dx * np.cos(heading) + dy * np.sin(heading)
    left = dy * np.cos(heading) - dx * np.sin(heading)
    known = np.flatnonzero(np.isfinite(ahead) & np.isfinite(left))
    rows, at, ahead, left = rows[known], at[known], ahead[known], left[known]
    distance = np.sqrt(ahead**2 + left**2 + np.nan_to_num(dz[known]) ** 2)
    bearing = np.abs(np.degrees(np.arctan2(left, ahead)))
    frame, node, ego_node = seen.node_frame[rows], seen.node[rows], seen.node[at]
    lane = 1 - (left > LANE_THRESHOLD).astype(np.int64) + (left < -LANE_THRESHOLD)
    edges.append((frame, node, _all(node, "isIn"), _LANE_NODES[lane]))

    def add(label: str, where: NDArray[np.signedinteger], *, both: bool = False) -> None:
        ends = [(node, ego_node), (ego_node, node)][: 2 if both else 1]
        for src, dst in ends:
            part = (frame[where], src[where], _all(where, label), dst[where])
            edges.append(part)

    low = -1.0
    for name, high in PROXIMITY:
        add(name, np.flatnonzero((distance > low) & (distance <= high)), both=True)
        low = high
    near = distance <= PROXIMITY[-1][1]
    for name, first, last in DIRECTIONS:
        add(name, np.flatnonzero(near & (bearing >= first) & (bearing <= last)))
    add("toLeftOf", np.flatnonzero(near & (lane == 0)))
    add("toRightOf", np.flatnonzero(near & (lane == 2)))
    return edges
