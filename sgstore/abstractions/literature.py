"""The abstractions of the literature: ``E``, ``EL``, ``ER``, ``RSV``, ``junction`` and ``SG``.

The names are those of S3C (Woodlief et al., 2024) and of CARLASGG. In all but ``SG``, entities are traffic,
people, animals, signals and props, without the scenery (buildings, poles, barriers, vegetation); an entity is
labelled with its kind, the ego with ``ego``; and relations are those of proximity and direction, and left and
right. ``leads``, ``follows``, ``overlaps``, ``sees`` and ``conflictsWith`` are unknown to the literature.

Where our graphs have what theirs lack, this is how it is:

* ``EL``, ``RSV``: lanes are strands (:mod:`sgstore.abstractions.roles`) that are driven on. The ego's is that
  of its primary lane; those beside it that run the same way are ``Left n`` and ``Right n of Ego Lane``, and are
  there if they are in range. Any other strand that an entity is in is an ``Opposing Lane k`` (CARLASGG's word,
  whichever way it runs), by the distance of the nearest entity in it from the ego, then by node id; where the
  ego's place or lane is not known, plainly a ``Lane``. All lanes are in ``Root Road``. What is off the road is
  in ``Off Road``.
* ``junction``: lanes, roads and junctions of the map. The sections of a road are one, as with CARLASGG: its
  lanes are called ``Lane 5_-1``. What a thing is called does not count for the class: a lane that is driven on
  is labelled ``Lane``, another with its type; so the same scene in another place is of the same class.
* ``SG``: the scene graph itself, all of it; with waypoints if these were asked for at ingest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.abstractions.columns import BETWEEN_ENTITIES, EGO, SCENERY, Labelled, repeated
from sgstore.abstractions.lanes import NAMELESS, OFF_ROAD, ego_lanes
from sgstore.abstractions.roles import UNNAMED, role_name
from sgstore.vocabulary import (
    ENTITY_KINDS,
    KIND_CODE,
    KINDS,
    RELATION_CODE,
    RELATIONS,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.abstractions.columns import Grounds, Part, Seen
    from sgstore.world import Bools, Ints

ROOT_ROAD: Final = -(1 << 40)
"""Node number of ``Root Road``."""

OF_JUNCTION: Final = (
    *BETWEEN_ENTITIES,
    *("isIn", "travelsTo", "laneChange", "opposes", "controlsTrafficOf", "mayAffect"),
)


@dataclass(frozen=True, slots=True)
class Subset:
    """What queries see under an abstraction, whose nodes and edges are some of those of the scene graph.

    Attributes
    ----------
    kinds : frozenset of str or None
        Kinds of its nodes; ``None``: all, and all relations.
    moving : frozenset of str
        Relations of entities, to one another and to parts of the map.
    lasting : frozenset of str
        Relations among parts of the map.
    """

    kinds: frozenset[str] | None
    moving: frozenset[str] = frozenset()
    lasting: frozenset[str] = frozenset()


_TRAFFIC: Final = frozenset(ENTITY_KINDS) - frozenset(SCENERY)
_LANES: Final = frozenset({"lane", "off_road"})
_RELATED: Final = frozenset(BETWEEN_ENTITIES)
_PARTS: Final = frozenset({*_LANES, "road", "junction"})

SUBSETS: Final[Mapping[str, Subset]] = {
    "E": Subset(_TRAFFIC),
    "EL": Subset(_TRAFFIC | _LANES, frozenset({"isIn"})),
    "ER": Subset(_TRAFFIC, _RELATED),
    "RSV": Subset(_TRAFFIC | _LANES, _RELATED | {"isIn"}),
    "junction": Subset(_TRAFFIC | _PARTS, frozenset(OF_JUNCTION), frozenset(OF_JUNCTION)),
    "SG": Subset(None),
}
"""In queries lanes keep the names and the sections that they have in the map."""

_MAPS: Final = 4
"""Maps of which what follows from them is remembered."""

_EGO_LABEL: Final = len(KINDS)
_KIND_LABELS: Final = (*KINDS, EGO)
_IS_IN: Final = RELATION_CODE["isIn"]
_ON_ROADS: Final = np.array([r in OF_JUNCTION and r not in BETWEEN_ENTITIES for r in RELATIONS])


def entities(seen: Seen) -> Labelled:
    """``E``: the entities."""
    return Labelled.assembled(seen.frames, [_entities(seen)], [], _KIND_LABELS)


def related(seen: Seen) -> Labelled:
    """``ER``: the entities and their relations."""
    labels = (*_KIND_LABELS, *RELATIONS)
    edges, bundles = _relations(seen)
    return Labelled.assembled(seen.frames, [_entities(seen)], [edges], labels, bundles=bundles)


def in_lanes(seen: Seen) -> Labelled:
    """``EL``: the entities, and their lanes as the ego has them."""
    return _with_lanes(seen, related=False)


def road_scene(seen: Seen) -> Labelled:
    """``RSV``: the entities with their relations, and their lanes as the ego has them."""
    return _with_lanes(seen, related=True)


def whole(seen: Seen) -> Labelled:
    """``SG``: the scene graph as it is."""
    label = np.where(seen.is_ego, _EGO_LABEL, seen.kind)
    first = len(_KIND_LABELS)
    frame, relation, src, dst = seen.lasting(range(len(RELATIONS)))
    edges = [
        (seen.frame, seen.src, first + seen.relation.astype(np.int64), seen.dst),
        (frame, src, first + relation.astype(np.int64), dst),
    ]
    labels = [*_KIND_LABELS, *RELATIONS]
    if seen.grounds is not None:
        label, more = _with_roles(seen, seen.grounds, label, len(labels))
        labels += more
    nodes = [(seen.node_frame, seen.node, label)]
    return Labelled.assembled(seen.frames, nodes, edges, labels, _names(seen.grounds))


def _with_roles(seen: Seen, grounds: Grounds, label: Ints, first: int) -> tuple[Ints, list[str]]:
    """Labels of nodes, in which lanes whose names say their role are labelled with it; and these labels."""
    named = grounds.strands.named
    roles = np.unique(named[named != UNNAMED])
    if not len(roles):
        return label, []
    part = np.clip(-1 - seen.node, 0, len(named) - 1)
    role = np.where(seen.node < 0, named[part], UNNAMED)
    at = np.minimum(np.searchsorted(roles, role), len(roles) - 1)
    named_label = np.where(role == UNNAMED, label, first + at)
    return named_label, [role_name(one) for one in roles.tolist()]


def junction(seen: Seen) -> Labelled:
    """``junction``: the entities with their relations; lanes, roads and junctions of the map."""
    grounds = seen.grounds
    first = len(_KIND_LABELS)
    wanted = [RELATION_CODE[name] for name in OF_JUNCTION]
    nodes, kept = [_entities(seen)], seen.is_traffic
    labels = [*_KIND_LABELS, *RELATIONS]
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


def _drawn(seen: Seen, kept: Bools, columns: Part, whose: Ints | None) -> Part:
    """Edges both of whose ends are kept, between what stands for these, each once and none to itself."""
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
def _merged(grounds: Grounds) -> Ints:
    """For each part of the map the node id that stands for it: of a lane in several sections, the greatest."""
    found = -1 - np.arange(len(grounds.kind))
    lanes = np.flatnonzero(grounds.kind == KIND_CODE["lane"])
    first: dict[tuple[str, int, str], int] = {}
    keys = zip(grounds.road[lanes], grounds.lane[lanes].tolist(), strict=True)
    for row, (road, lane) in zip(lanes.tolist(), keys, strict=True):
        if not road:  # it has a name and nothing else: a graph that came from elsewhere
            continue
        key = (road, lane, "Lane" if grounds.driving[row] else grounds.lane_type[row])
        found[row] = first.setdefault(key, -1 - row)
    return found


@lru_cache(maxsize=_MAPS)
def _ground_labels(grounds: Grounds, first: int) -> tuple[Ints, list[str]]:
    """Label of each part of the map, from ``first`` on, and the labels."""
    words = {"road": "Road", "junction": "Junction", "off_road": "Off Road"}
    text: list[str] = [
        ("Lane" if driven else f"Lane ({kind_of_lane or 'none'})")
        if KINDS[kind] == "lane"
        else words.get(str(KINDS[kind]), str(KINDS[kind]))
        for kind, kind_of_lane, driven in zip(
            grounds.kind.tolist(), grounds.lane_type, grounds.driving.tolist(), strict=True
        )
    ]
    named = grounds.strands.named
    for row in np.flatnonzero(named != UNNAMED).tolist():
        text[row] = role_name(int(named[row]))
    table = {label: first + i for i, label in enumerate(dict.fromkeys(text))}
    return np.array([table[label] for label in text], np.int64), list(table)


@lru_cache(maxsize=_MAPS)
def _names(grounds: Grounds | None) -> dict[int, str]:
    """What the literature calls parts of the map."""
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


def _entities(seen: Seen) -> Part:
    rows = np.flatnonzero(seen.is_traffic)
    label = np.where(seen.is_ego[rows], _EGO_LABEL, seen.kind[rows])
    return seen.node_frame[rows], seen.node[rows], label


def _relations(seen: Seen) -> tuple[Part, list[list[int]]]:
    """Edges between entities, and the bundles of labels, which follow those of the kinds, that they bear."""
    frame, src, dst, bits = seen.pairs
    distinct, number = np.unique(bits, return_inverse=True)
    first = len(_KIND_LABELS)
    bundles = [
        [first + code for code in range(len(RELATIONS)) if one >> code & 1]
        for one in distinct.tolist()
    ]
    return (frame, src, -1 - number, dst), bundles


def _with_lanes(seen: Seen, *, related: bool) -> Labelled:
    labels = [*_KIND_LABELS, *RELATIONS]
    between, bundles = _relations(seen) if related else (None, [])
    nodes, edges = [_entities(seen)], [between] if between else []
    if seen.grounds is not None:
        lanes, inside, names = _lanes(seen, len(labels))
        labels += names
        nodes += lanes
        edges += inside
    return Labelled.assembled(seen.frames, nodes, edges, labels, bundles=bundles)


def _lanes(seen: Seen, first: int) -> tuple[list[Part], list[Part], list[str]]:
    """Nodes, ``isIn`` edges and labels of the lanes as the ego has them; labels count from ``first``."""
    is_in = len(_KIND_LABELS) + _IS_IN
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
