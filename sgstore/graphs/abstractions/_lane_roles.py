"""Roles of lanes relative to the ego: ``Ego Lane``, ``Left 1 of Ego Lane``, ``Opposing Lane 0`` and so on.

A *strand* is a chain of lanes: a lane and its only successor, if that has no other predecessor. Strands end at
the borders of junctions. They depend on the map only, and are computed once per map.
"""

from __future__ import annotations

import re
from collections import OrderedDict, defaultdict
from typing import TYPE_CHECKING, Final
from weakref import WeakKeyDictionary

import numpy as np

from sgstore.base.tables import components
from sgstore.graphs.abstractions._columns import (
    LANES_OF,
    EgoLanes,
    GraphColumns,
    MapColumns,
    Part,
    repeated,
)
from sgstore.model.vocabulary import KIND_CODE, RELATION_CODE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Ints


OPPOSING: Final = 1 << 16
"""First code of the roles of opposing lanes: ``Opposing Lane 0``, ``Opposing Lane 1``, …"""

_MOST: Final = 1000
"""Largest number of lanes with a role on each side of the ego's lane."""

UNNAMED: Final = -(1 << 21)
"""Code for a name that is not a lane role."""


class Strands:
    """Strands of a map (chains of consecutive lanes), and the left and right neighbours of each.

    Attributes
    ----------
    of : (K,) int64
        For each part of the map the node id that represents its strand: the greatest one among its
        lanes. 0 for other parts than driving lanes.
    named : (K,) int64
        For each part of the map the role in its name, as in graphs from other sources;
        :data:`UNNAMED` without a role.
    """

    def __init__(self, grounds: MapColumns) -> None:
        self.of = _strands(grounds)
        self.named = np.array([_role_named(name) for name in grounds.name], np.int64)
        self._left = self._beside(grounds, "toLeftOf")
        self._right = self._beside(grounds, "toRightOf")
        self._roles: OrderedDict[int, dict[int, int]] = OrderedDict()

    def roles(self, ego: int) -> dict[int, int]:
        """Return the role of each strand (chain of lanes) relative to the strand of the ego.

        The role is 0 for the ego's strand, n for the n-th on its left, and -n for the n-th on its
        right.
        """
        if ego not in self._roles:
            roles = {ego: 0}
            for beside, sign in ((self._left, 1), (self._right, -1)):
                edge = {ego}
                for step in range(1, _MOST):
                    edge = {s for one in edge for s in beside[one]} - roles.keys()
                    if not edge:
                        break
                    roles |= dict.fromkeys(edge, sign * step)
            self._roles[ego] = roles
        return self._roles[ego]

    def _beside(self, grounds: MapColumns, relation: str) -> defaultdict[int, set[int]]:
        """Return the neighbours of each strand (chain of lanes) on one side that have the same direction."""
        against = grounds.relation == RELATION_CODE["opposes"]
        pairs = set(zip(grounds.src[against].tolist(), grounds.dst[against].tolist(), strict=True))
        rows = np.flatnonzero(grounds.relation == RELATION_CODE[relation])
        found: defaultdict[int, set[int]] = defaultdict(set)
        for src, dst in zip(grounds.src[rows].tolist(), grounds.dst[rows].tolist(), strict=True):
            one, other = int(self.of[-1 - dst]), int(self.of[-1 - src])
            if one and other and (src, dst) not in pairs:
                found[one].add(other)
        return found


_STRANDS: Final[WeakKeyDictionary[MapColumns, Strands]] = WeakKeyDictionary()
"""Cached strands by map. An entry is removed together with its map."""


def strands_of(grounds: MapColumns) -> Strands:
    """Return the strands (chains of consecutive lanes) of a map."""
    if grounds not in _STRANDS:
        _STRANDS[grounds] = Strands(grounds)
    return _STRANDS[grounds]


def _strands(grounds: MapColumns) -> Ints:
    """Return the number of the strand (chain of consecutive lanes) of each map node; 0 for other nodes."""
    on = grounds.relation == RELATION_CODE["travelsTo"]
    src, dst = -1 - grounds.src[on], -1 - grounds.dst[on]
    driven = grounds.driving
    both = driven[src] & driven[dst]
    src, dst = src[both], dst[both]
    only = (np.bincount(src, minlength=len(driven))[src] == 1) & (
        np.bincount(dst, minlength=len(driven))[dst] == 1
    )
    only &= (grounds.junction[src] == grounds.junction[dst]).astype(np.bool_)
    return np.where(driven, -1 - components(len(driven), src[only], dst[only]), 0)


def role_name(role: int) -> str:
    """Return the name of a lane role, such as ``Left 1 of Ego Lane``."""
    if role == 0:
        return "Ego Lane"
    if role >= OPPOSING:
        return f"Opposing Lane {role - OPPOSING}"
    return f"{'Left' if role > 0 else 'Right'} {abs(role)} of Ego Lane"


_BESIDE: Final = re.compile(r"(left|right) (\d{1,4}) of ego lane")

_OPPOSING: Final = re.compile(r"opposing lane (\d{1,4})")

_ROLES: Final = {
    "ego lane": 0,
    "middle lane": 0,
    "left lane": 1,
    "right lane": -1,
    "lane_middle": 0,
    "lane_left": 1,
    "lane_right": -1,
}
"""Names of lanes in S3C, CARLASGG and RoadScene2Vec. In the latter, the ego is always in the middle lane."""


def _role_named(name: str) -> int:
    """Parse the name of a lane role, such as ``Left 1 of Ego Lane``."""
    text = name.lower()
    if beside := _BESIDE.fullmatch(text):
        return int(beside[2]) * (1 if beside[1] == "left" else -1)
    if opposing := _OPPOSING.fullmatch(text):
        return OPPOSING + int(opposing[1])
    return _ROLES.get(text, UNNAMED)


OFF_ROAD: Final = -1
"""Node id of the node that stands for everything off the road."""

NAMELESS: Final = -(1 << 20)
"""Code for a lane whose place relative to the ego is unknown."""

_IS_IN: Final = RELATION_CODE["isIn"]

_NONE: Final = np.zeros(0, np.int64)


def ego_lanes(seen: GraphColumns) -> EgoLanes:
    """Return the lanes of each frame, with their roles relative to the ego; empty without a map."""
    if seen not in LANES_OF:
        LANES_OF[seen] = _found(seen)
    return LANES_OF[seen]


def _found(seen: GraphColumns) -> EgoLanes:
    if seen.grounds is None:
        return EgoLanes(_NONE, _NONE, _NONE, (_NONE,) * 3, (_NONE,) * 2, (_NONE,) * 2)
    strands = strands_of(seen.grounds)
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
    """Return frame, lane and role name of each lane that has a role relative to the ego.

    Returns
    -------
    frame, node : (N,) int64
        Frame, counted from 0, and a lane in range or with traffic. Ascending.
    role : list of str
        ``Ego Lane``, ``Left 1 of Ego Lane``, ``Opposing Lane 0`` and so on.
    """
    if seen.grounds is None:
        return _NONE, _NONE, []
    of = strands_of(seen.grounds).of
    lanes = ego_lanes(seen)
    said = lanes.role != NAMELESS
    span = len(of) + 1  # node ids of lanes are negative, and above -span
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
    """Return frame, object and lane of each traffic object on a lane."""
    rows = np.flatnonzero((seen.relation == _IS_IN) & (seen.src >= 0) & (seen.dst < 0))
    entity = seen.row_of(seen.frame[rows], seen.src[rows])
    rows = rows[(entity >= 0) & seen.is_traffic[entity]]
    return seen.frame[rows], seen.src[rows], seen.dst[rows]


def _roles(seen: GraphColumns, strands: Strands, inside: Part) -> tuple[Ints, Ints, Ints]:
    """Return frame, strand (chain of lanes), and role relative to the ego, for all strands of all frames."""
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
    """Return lane roles with numbers for opposing lanes: 0 for the one with the object nearest to the ego."""
    here_frame, here, role = lanes
    distance, has_ego = _from_ego(seen)
    rows = np.flatnonzero(role == OPPOSING)
    if not len(rows) or not len(inside[0]):  # then all lanes come from names
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
    """Return each node's distance from the ego (infinite if unknown), and a mask of frames with an ego."""
    x, y = (np.full(seen.frames, np.nan) for _ in range(2))
    ego = np.flatnonzero(seen.is_ego)
    x[seen.node_frame[ego]], y[seen.node_frame[ego]] = seen.x[ego], seen.y[ego]
    away = np.hypot(seen.x - x[seen.node_frame], seen.y - y[seen.node_frame])
    return np.where(np.isfinite(away), away, np.inf), np.isfinite(x + y)
