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

from sgstore.abstractions.columns import BETWEEN_ENTITIES, EGO, SCENERY, Labelled
from sgstore.abstractions.roles import OPPOSING, UNNAMED, role_name
from sgstore.vocabulary import (
    ENTITY_KINDS,
    KIND_CODE,
    KINDS,
    RELATION_CODE,
    RELATIONS,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sgstore.abstractions.columns import Grounds, Part, Seen
    from sgstore.abstractions.roles import Strands
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
_OFF_ROAD: Final = -1
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
    again = _repeated((frame[rows], relation[rows], src[rows], dst[rows]))
    keep = np.ones(len(frame), np.bool_)
    keep[rows[again]] = False
    keep &= src != dst
    return frame[keep], relation[keep], src[keep], dst[keep]


def _standing_for(whose: Ints, node: Ints) -> Ints:
    return np.where(node < 0, whose[np.clip(-1 - node, 0, len(whose) - 1)], node)


def _repeated(columns: Part) -> Bools:
    """Which rows have come before."""
    again = np.zeros(len(columns[0]), np.bool_)
    if len(again):
        order = np.lexsort(columns)
        same = np.ones(len(order) - 1, np.bool_)
        for column in columns:
            same &= column[order][1:] == column[order][:-1]
        again[order[1:]] = same
    return again


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
    assert seen.grounds is not None  # noqa: S101 - the caller has looked
    is_in = len(_KIND_LABELS) + _IS_IN
    strands = seen.grounds.strands
    frame, src, dst = _inside(seen)
    off = dst == _OFF_ROAD
    strand = strands.of[-1 - dst]
    on = np.flatnonzero(strand != 0)
    on = on[~_repeated((frame[on], src[on], strand[on]))]
    inside = (frame[on], src[on], strand[on])
    lane_frame, lane, role = _roles(seen, strands, inside)
    off_frames = np.unique(frame[off])
    roots = np.unique(lane_frame)
    names = ["Root Road", "Off Road", "Lane"]
    present = np.unique(role)
    label = first + len(names) + np.searchsorted(present, role)
    label[role == _NAMELESS] = first + 2
    names += [role_name(one) if one != _NAMELESS else "Lane" for one in present.tolist()]
    nodes = [
        (lane_frame, lane, label),
        (roots, np.full(len(roots), ROOT_ROAD), np.full(len(roots), first)),
        (off_frames, np.full(len(off_frames), _OFF_ROAD), np.full(len(off_frames), first + 1)),
    ]
    edges = [
        (inside[0], inside[1], np.full(len(on), is_in), inside[2]),
        (lane_frame, lane, np.full(len(lane), is_in), np.full(len(lane), ROOT_ROAD)),
        (frame[off], src[off], np.full(int(off.sum()), is_in), dst[off]),
    ]
    return nodes, edges, names


def lane_roles(seen: Seen) -> tuple[Ints, Ints, list[str]]:
    """What the lanes of each frame are to the ego in ``RSV``, as far as that can be said.

    Returns
    -------
    frame, node : (N,) int64
        Frame, counted from 0, and lane: one that is in range or that somebody is in. Ascending.
    role : list of str
        ``Ego Lane``, ``Left 1 of Ego Lane``, ``Opposing Lane 0`` and so on.
    """
    if seen.grounds is None:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), []
    strands = seen.grounds.strands
    frame, src, dst = _inside(seen)
    on = np.flatnonzero(strands.of[-1 - dst] != 0)
    frame, src, dst = frame[on], src[on], dst[on]
    role_frame, strand, role = _roles(seen, strands, (frame, src, strands.of[-1 - dst]))
    said = role != _NAMELESS
    span = len(strands.of) + 1  # node ids of lanes are below zero, and above -span
    known = role_frame[said] * span - strand[said]
    order = np.argsort(known)
    known, role = known[order], role[said][order]
    present = np.flatnonzero(seen.kind == KIND_CODE["lane"])
    in_range = seen.node_frame[present] * span - seen.node[present]
    lane_frame, lane = np.divmod(np.union1d(in_range, frame * span - dst), span)
    wanted = lane_frame * span - strands.of[lane - 1]
    at = np.searchsorted(known, wanted)
    hit = np.flatnonzero(np.append(known, -1)[at] == wanted)
    names = [role_name(one) for one in role[at[hit]].tolist()]
    return lane_frame[hit], -lane[hit], names


def _inside(seen: Seen) -> tuple[Ints, Ints, Ints]:
    """Frames, traffic, and the lanes that it is in."""
    rows = np.flatnonzero((seen.relation == _IS_IN) & (seen.src >= 0) & (seen.dst < 0))
    entity = seen.row_of(seen.frame[rows], seen.src[rows])
    rows = rows[(entity >= 0) & seen.is_traffic[entity]]
    return seen.frame[rows], seen.src[rows], seen.dst[rows]


_NAMELESS: Final = -(1 << 20)
"""Role of a lane of which nobody can say how it lies to the ego."""


def _roles(seen: Seen, strands: Strands, inside: Part) -> tuple[Ints, Ints, Ints]:
    """The lanes of each frame and their roles: ``(frame, strand, role)``."""
    frame, src, strand = inside
    ego = np.where(seen.ego_lane < 0, strands.of[-1 - seen.ego_lane], 0)
    present = np.flatnonzero(seen.kind == KIND_CODE["lane"])
    here_frame = np.concatenate([seen.node_frame[present], frame])
    here = np.concatenate([strands.of[-1 - seen.node[present]], strand])
    reached = np.append(np.zeros(len(present), np.bool_), np.ones(len(frame), np.bool_))
    role = np.full(len(here), OPPOSING)
    own = ego[here_frame]
    for one in np.unique(own[own != 0]).tolist():
        roles = strands.roles(one)
        known = np.array(sorted(roles))
        values = np.array([roles[s] for s in known.tolist()])
        of = np.flatnonzero(own == one)
        at = np.minimum(np.searchsorted(known, here[of]), len(known) - 1)
        role[of] = np.where(known[at] == here[of], values[at], OPPOSING)
    named = strands.named[-1 - here]
    keep = (here != 0) & (reached | (role != OPPOSING) | (named != UNNAMED))
    fresh = np.flatnonzero(keep)
    fresh = fresh[~_repeated((here_frame[fresh], here[fresh]))]
    here_frame, here, role, named = here_frame[fresh], here[fresh], role[fresh], named[fresh]
    role = _numbered(seen, (frame, src, strand), (here_frame, here, role))
    return here_frame, here, np.where(named != UNNAMED, named, role)


def _numbered(seen: Seen, inside: Part, lanes: Part) -> Ints:
    """The roles of lanes, with the opposing ones numbered by the distance of what is in them."""
    here_frame, here, role = lanes
    distance, has_ego = _from_ego(seen)
    rows = np.flatnonzero(role == OPPOSING)
    if not len(rows) or not len(inside[0]):  # then all of them are there by their names
        return role
    order = rows[np.lexsort((here[rows], here_frame[rows]))]
    frame, src, strand = inside
    low = int(strand.min())
    span = 1 - low
    keys = here_frame[order] * span + (here[order] - low)
    wanted = frame * span + (strand - low)
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    hit = keys[at] == wanted
    nearest = np.full(len(order), np.inf)
    np.minimum.at(nearest, at[hit], distance[seen.row_of(frame[hit], src[hit])])
    ranked = np.lexsort((-here[order], nearest, here_frame[order]))
    sorted_frame = here_frame[order][ranked]
    starts = np.searchsorted(sorted_frame, sorted_frame)
    numbers = OPPOSING + np.arange(len(order)) - starts
    numbers[~(has_ego & (seen.ego_lane < 0))[sorted_frame]] = _NAMELESS
    role = role.copy()
    role[order[ranked]] = numbers
    return role


def _from_ego(seen: Seen) -> tuple[NDArray[np.float64], Bools]:
    """Distance of each node from the ego in the plane, infinite if unknown; and which frames have an ego."""
    x, y = (np.full(seen.frames, np.nan) for _ in range(2))
    ego = np.flatnonzero(seen.is_ego)
    x[seen.node_frame[ego]], y[seen.node_frame[ego]] = seen.x[ego], seen.y[ego]
    away = np.hypot(seen.x - x[seen.node_frame], seen.y - y[seen.node_frame])
    return np.where(np.isfinite(away), away, np.inf), np.isfinite(x + y)
