"""Lanes as an ego has them: ``Ego Lane``, ``Left 1 of Ego Lane``, ``Opposing Lane 0`` and so on.

A *strand* is lanes one behind the other: a lane and the only one that follows it, if that follows no other.
Outside of junctions and inside of them strands are apart. It is a matter of the map alone, and is found once.
"""

from __future__ import annotations

import re
from collections import OrderedDict, defaultdict
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.vocabulary import RELATION_CODE

if TYPE_CHECKING:
    from sgstore.abstractions.columns import Grounds
    from sgstore.world import Ints

OPPOSING: Final = 1 << 16
"""Roles from here on: ``Opposing Lane 0``, ``1``, …"""

_MOST: Final = 1000
"""Lanes to one side of the ego's that have a name."""

UNNAMED: Final = -(1 << 21)
"""What stands for no role among those that names say."""


class Strands:
    """The strands of a map, and how they lie beside one another.

    Attributes
    ----------
    of : (K,) int64
        For each part of the map a node id: of the lane that stands for its strand, the one with the greatest
        node id; 0 for what is no lane that is driven on.
    named : (K,) int64
        For each part of the map the role that its name says, as in graphs that came from elsewhere;
        :data:`UNNAMED` where it says none.
    """

    def __init__(self, grounds: Grounds) -> None:
        self.of = _strands(grounds)
        self.named = np.array([_role_named(name) for name in grounds.name], np.int64)
        self._left = self._beside(grounds, "toLeftOf")
        self._right = self._beside(grounds, "toRightOf")
        self._roles: OrderedDict[int, dict[int, int]] = OrderedDict()

    def roles(self, ego: int) -> dict[int, int]:
        """Strand → its role beside the ego's: 0 the ego's own, n the n-th to its left, -n to its right."""
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

    def _beside(self, grounds: Grounds, relation: str) -> defaultdict[int, set[int]]:
        """Strand → strands next to it on one side, that run the same way."""
        against = grounds.relation == RELATION_CODE["opposes"]
        pairs = set(zip(grounds.src[against].tolist(), grounds.dst[against].tolist(), strict=True))
        rows = np.flatnonzero(grounds.relation == RELATION_CODE[relation])
        found: defaultdict[int, set[int]] = defaultdict(set)
        for src, dst in zip(grounds.src[rows].tolist(), grounds.dst[rows].tolist(), strict=True):
            one, other = int(self.of[-1 - dst]), int(self.of[-1 - src])
            if one and other and (src, dst) not in pairs:
                found[one].add(other)
        return found


def _strands(grounds: Grounds) -> Ints:
    """See :attr:`Strands.of`."""
    on = grounds.relation == RELATION_CODE["travelsTo"]
    src, dst = -1 - grounds.src[on], -1 - grounds.dst[on]
    driven = grounds.driving
    both = driven[src] & driven[dst]
    src, dst = src[both], dst[both]
    only = (np.bincount(src, minlength=len(driven))[src] == 1) & (
        np.bincount(dst, minlength=len(driven))[dst] == 1
    )
    only &= (grounds.junction[src] == grounds.junction[dst]).astype(np.bool_)
    src, dst = src[only], dst[only]
    least = np.arange(len(driven))
    while True:
        before = least.copy()
        low = np.minimum(least[src], least[dst])
        np.minimum.at(least, src, low)
        np.minimum.at(least, dst, low)
        least = least[least]
        if np.array_equal(before, least):
            break
    return np.where(driven, -1 - least, 0)


def role_name(role: int) -> str:
    """What the literature calls a role."""
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
"""Names of lanes with S3C and CARLASGG, and with RoadScene2Vec, whose ego is always in the middle one."""


def _role_named(name: str) -> int:
    """The role that a name says; the inverse of :func:`role_name`."""
    text = name.lower()
    if beside := _BESIDE.fullmatch(text):
        return int(beside[2]) * (1 if beside[1] == "left" else -1)
    if opposing := _OPPOSING.fullmatch(text):
        return OPPOSING + int(opposing[1])
    return _ROLES.get(text, UNNAMED)
