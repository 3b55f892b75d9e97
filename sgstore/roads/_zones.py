"""Merge and departure zones along the lanes of a map: where lanes come in, and where they go off.

ISO 34502 has three kinds of road geometry: the road alone, the merge zone and the departure zone, of which it
tells no length. Here a merge zone is

* a lane that leads onto a road by its type (``entry``, ``onRamp``, ``mwyEntry``), and the lanes beside it;
* the last :data:`LONG` before a lane ends while one beside it goes on;
* the last :data:`LONG` before two roads or more become one, where none of them leads anywhere else: so no
  crossing is a merge zone, whatever the map calls it.

A departure zone is the same against the direction of travel: ``exit``, ``offRamp``, ``mwyExit``; the first
:data:`LONG` after a lane began, or one road became several. Lanes beside one another are of one direction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.roads._places import MapPlaces
from sgstore.vocabulary import DRIVING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from sgstore.world import Floats, Ints

LONG: Final = 250.0
"""Length of a zone that no type of lanes tells: of acceleration lanes of German motorways (RAA 2008); m."""
_MOST: Final = 1_000
"""Lanes of a junction that are looked at from one that leads into it: a map of strangers may be of any size."""
MERGE_ZONE: Final = "merge_zone"
DEPARTURE_ZONE: Final = "departure_zone"
_LEADING: Final[Mapping[str, frozenset[str]]] = {
    MERGE_ZONE: frozenset({"entry", "onRamp", "mwyEntry"}),
    DEPARTURE_ZONE: frozenset({"exit", "offRamp", "mwyExit"}),
}


def zones(
    types: Sequence[str],
    within: Sequence[str],
    lengths: Floats,
    flow: tuple[Ints, Ints],
    beside: tuple[Ints, Ints],
) -> MapPlaces:
    """Zones on the lanes of a map.

    Parameters
    ----------
    types, within : sequence of str
        Of each lane its type, and its junction; empty: none.
    lengths : (L,) float64
        m.
    flow : (n,) int64 twice
        Lanes, and lanes that their traffic goes on to.
    beside : (m,) int64 twice
        Lanes side by side of one direction.
    """
    traffic = [of in DRIVING for of in types]
    lanes = _Lanes(
        types,
        [bool(junction) for junction in within],
        lengths.tolist(),
        _related(len(types), flow, traffic),
        _related(len(types), (flow[1], flow[0]), traffic),
        _groups(_related(len(types), beside, traffic)),
    )
    onward = lanes.reaches(_LEADING[MERGE_ZONE])
    back = lanes.turned().reaches(_LEADING[DEPARTURE_ZONE])
    lane = np.array([*onward, *back], np.int64)
    far = np.minimum([*onward.values(), *back.values()], lengths[lane])
    merges = np.arange(len(lane)) < len(onward)
    start, end = np.where(merges, lengths[lane] - far, 0.0), np.where(merges, lengths[lane], far)
    what = [MERGE_ZONE if one else DEPARTURE_ZONE for one in merges.tolist()]
    return MapPlaces.of(lane + 1, what, lane, start, end)


@dataclass(frozen=True, slots=True)
class _Lanes:
    """Lanes for motor traffic with their lengths, those that follow and come before, and who is beside whom."""

    types: Sequence[str]
    inside: Sequence[bool]
    lengths: Sequence[float]
    after: Sequence[Sequence[int]]
    before: Sequence[Sequence[int]]
    group: Sequence[int]

    def turned(self) -> _Lanes:
        """The same against the direction of travel."""
        return replace(self, after=self.before, before=self.after)

    def reaches(self, leading: frozenset[str]) -> dict[int, float]:
        """Lanes that are in a zone, and how far that reaches back from their ends; m."""
        groups: dict[int, list[int]] = {}
        for lane, of in enumerate(self.group):
            if self.types[lane] in DRIVING:
                groups.setdefault(of, []).append(lane)
        found: dict[int, float] = {}
        seeds: list[int] = []
        for lanes in groups.values():
            if any(self.inside[lane] for lane in lanes):
                continue
            if 0 < sum(self.types[lane] in leading for lane in lanes) < len(lanes):
                found |= {lane: self.lengths[lane] for lane in lanes}
            goes_on = [any(not self.inside[one] for one in self.after[lane]) for lane in lanes]
            if any(goes_on) and not all(self.after[lane] for lane in lanes):
                seeds += lanes
        for lane in [*seeds, *self._joining()]:
            self._walk_back(lane, groups, found)
        return found

    def _joining(self) -> Iterable[int]:
        """Lanes right before the place where the roads that they are of become one."""
        reached: dict[int, set[int]] = {}
        coming: dict[int, set[int]] = {}
        last: dict[int, set[int]] = {}
        for lane, inside in enumerate(self.inside):
            if self.types[lane] not in DRIVING or (inside and self.before[lane]):
                continue
            for through, target in self._onto(lane):
                reached.setdefault(self.group[lane], set()).add(target)
                coming.setdefault(target, set()).add(self.group[lane])
                last.setdefault(target, set()).add(through)
        for target, sources in coming.items():
            if len(sources) > 1 and all(reached[one] == {target} for one in sources):
                yield from last[target]

    def _onto(self, lane: int) -> Iterable[tuple[int, int]]:
        """Groups of lanes outside of junctions that a lane leads to, with the lane right before each."""
        queue, seen = [lane], {lane}
        while queue and len(seen) < _MOST:
            at = queue.pop()
            for one in self.after[at]:
                if not self.inside[one]:
                    yield at, self.group[one]
                elif one not in seen:
                    seen.add(one)
                    queue.append(one)

    def _walk_back(
        self, lane: int, groups: Mapping[int, Sequence[int]], found: dict[int, float]
    ) -> None:
        """Put into a zone a lane and what is beside it, up to :data:`LONG` behind its end or to a junction."""
        queue = [(lane, LONG)]
        while queue:
            at, left = queue.pop()
            for one in (at,) if self.inside[at] else groups[self.group[at]]:
                if left <= found.get(one, 0.0):
                    continue
                found[one] = left
                if left > self.lengths[one]:
                    further = left - self.lengths[one]
                    ways = [w for w in self.before[one] if self.inside[one] or not self.inside[w]]
                    queue += [(way, further) for way in ways]


def _related(count: int, pairs: tuple[Ints, Ints], traffic: Sequence[bool]) -> list[list[int]]:
    """For each lane those that it is related to; of those for motor traffic alone."""
    found: list[list[int]] = [[] for _ in range(count)]
    for one, other in zip(*(column.tolist() for column in pairs), strict=True):
        if traffic[one] and traffic[other]:
            found[one].append(other)
    return found


def _groups(beside: Sequence[Sequence[int]]) -> list[int]:
    """For each lane the number of the first one that is beside it, whether next to it or further off."""
    group = [-1] * len(beside)
    for first in range(len(beside)):
        queue = [first] if group[first] < 0 else []
        while queue:
            at = queue.pop()
            if group[at] < 0:
                group[at] = first
                queue += beside[at]
    return group
