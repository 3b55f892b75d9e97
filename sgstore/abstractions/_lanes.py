"""The lanes of each frame as its ego has them: what ``EL``, ``RSV`` and queries for a role are made of.

Lanes are strands (:mod:`sgstore.abstractions._columns`). Found once for a block of graphs, whoever asks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from weakref import WeakKeyDictionary

import numpy as np

from sgstore.abstractions._columns import OPPOSING, UNNAMED, GraphColumns, repeated, role_name
from sgstore.vocabulary import KIND_CODE, RELATION_CODE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.abstractions._columns import Part, Strands
    from sgstore.world import Bools, Ints


OFF_ROAD: Final = -1
"""Node id of what is off the road."""
NAMELESS: Final = -(1 << 20)
"""Role of a lane of which nobody can say how it lies to the ego."""

_IS_IN: Final = RELATION_CODE["isIn"]
_NONE: Final = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True)
class EgoLanes:
    """The lanes of many frames, as the ego of each has them.

    Attributes
    ----------
    frame, strand, role : (L,) int64
        Lanes that are there: those that traffic is in, those beside the ego's that are in range, and those
        whose names say their roles. ``role`` as :func:`sgstore.abstractions._columns.role_name` reads it, or
        :data:`NAMELESS`.
    inside : tuple of (I,) int64
        Frame, traffic, and the strand that it is in; each once.
    inside_lane : tuple of (J,) int64
        Frame, and a lane that traffic is in.
    off_road : tuple of (O,) int64
        Frame, and what is off the road in it.
    """

    frame: Ints
    strand: Ints
    role: Ints
    inside: Part
    inside_lane: Part
    off_road: Part


_FOUND: Final[WeakKeyDictionary[GraphColumns, EgoLanes]] = WeakKeyDictionary()


def ego_lanes(seen: GraphColumns) -> EgoLanes:
    """The lanes as the ego of each frame has them; none where there is no map."""
    if seen not in _FOUND:
        _FOUND[seen] = _found(seen)
    return _FOUND[seen]


def _found(seen: GraphColumns) -> EgoLanes:
    if seen.grounds is None:
        return EgoLanes(_NONE, _NONE, _NONE, (_NONE,) * 3, (_NONE,) * 2, (_NONE,) * 2)
    strands = seen.grounds.strands
    frame, src, dst = _inside(seen)
    off = dst == OFF_ROAD
    strand = strands.of[-1 - dst]
    on = np.flatnonzero(strand != 0)
    once = on[~repeated((frame[on], src[on], strand[on]))]
    inside = (frame[once], src[once], strand[once])
    return EgoLanes(
        *_roles(seen, strands, inside), inside, (frame[on], dst[on]), (frame[off], src[off])
    )


def lane_roles(seen: GraphColumns) -> tuple[Ints, Ints, list[str]]:
    """Roles of the lanes of each frame, relative to the ego, in ``RSV``; lanes without one are left out.

    Returns
    -------
    frame, node : (N,) int64
        Frame, counted from 0, and lane: one that is in range or that somebody is in. Ascending.
    role : list of str
        ``Ego Lane``, ``Left 1 of Ego Lane``, ``Opposing Lane 0`` and so on.
    """
    if seen.grounds is None:
        return _NONE, _NONE, []
    of = seen.grounds.strands.of
    lanes = ego_lanes(seen)
    said = lanes.role != NAMELESS
    span = len(of) + 1  # node ids of lanes are below zero, and above -span
    known = lanes.frame[said] * span - lanes.strand[said]
    order = np.argsort(known)
    known, role = known[order], lanes.role[said][order]
    present = np.flatnonzero(seen.kind == KIND_CODE["lane"])
    in_range = seen.node_frame[present] * span - seen.node[present]
    frame, lane = lanes.inside_lane
    lane_frame, lane = np.divmod(np.union1d(in_range, frame * span - lane), span)
    wanted = lane_frame * span - of[lane - 1]
    at = np.searchsorted(known, wanted)
    hit = np.flatnonzero(np.append(known, -1)[at] == wanted)
    names = [role_name(one) for one in role[at[hit]].tolist()]
    return lane_frame[hit], -lane[hit], names


def _inside(seen: GraphColumns) -> tuple[Ints, Ints, Ints]:
    """Frames, traffic, and the lanes that it is in."""
    rows = np.flatnonzero((seen.relation == _IS_IN) & (seen.src >= 0) & (seen.dst < 0))
    entity = seen.row_of(seen.frame[rows], seen.src[rows])
    rows = rows[(entity >= 0) & seen.is_traffic[entity]]
    return seen.frame[rows], seen.src[rows], seen.dst[rows]


def _roles(seen: GraphColumns, strands: Strands, inside: Part) -> tuple[Ints, Ints, Ints]:
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
    fresh = fresh[~repeated((here_frame[fresh], here[fresh]))]
    here_frame, here, role, named = here_frame[fresh], here[fresh], role[fresh], named[fresh]
    role = _numbered(seen, (frame, src, strand), (here_frame, here, role))
    return here_frame, here, np.where(named != UNNAMED, named, role)


def _numbered(seen: GraphColumns, inside: Part, lanes: Part) -> Ints:
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
    numbers[~(has_ego & (seen.ego_lane < 0))[sorted_frame]] = NAMELESS
    role = role.copy()
    role[order[ranked]] = numbers
    return role


def _from_ego(seen: GraphColumns) -> tuple[NDArray[np.float64], Bools]:
    """Distance of each node from the ego in the plane, infinite if unknown; and which frames have an ego."""
    x, y = (np.full(seen.frames, np.nan) for _ in range(2))
    ego = np.flatnonzero(seen.is_ego)
    x[seen.node_frame[ego]], y[seen.node_frame[ego]] = seen.x[ego], seen.y[ego]
    away = np.hypot(seen.x - x[seen.node_frame], seen.y - y[seen.node_frame])
    return np.where(np.isfinite(away), away, np.inf), np.isfinite(x + y)
