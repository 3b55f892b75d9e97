"""Merge and departure zones of a map: lanes near on-ramps, off-ramps and lane ends.

ISO 34502 has three kinds of road geometry: the road, the merge zone and the departure zone. It does
not define their lengths. Here a merge zone is

* a lane whose type leads onto a road (``entry``, ``onRamp``, ``mwyEntry``), and its neighbours;
* the last :data:`LONG` before a lane ends while a neighbour continues;
* the last :data:`LONG` before two or more roads become one, if these roads lead nowhere else.
  Therefore a crossing is never a merge zone.

A departure zone is the same against the direction of travel: ``exit``, ``offRamp``, ``mwyExit``;
the first :data:`LONG` after a lane began, or after one road became several. Only neighbours in the
same direction count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.maps.roads._places import MapPlaces
from sgstore.model.vocabulary import DRIVING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from sgstore.model.world import Floats, Ints

LONG: Final = 250.0
"""Length of a zone that does not follow from lane types; m. It is that of German acceleration lanes (RAA
2008)."""
_MOST: Final = 1_000
"""Largest number of junction lanes that are searched for each entering lane, because maps can have any size."""
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
    """Return the merge and departure zones (near on-ramps and off-ramps), as intervals of lanes.

    Parameters
    ----------
    types, within : sequence of str
        Type of each lane; junction of each lane, or empty.
    lengths : (L,) float64
        m.
    flow : (n,) int64 twice
        Lanes, and the next lanes of their traffic.
    beside : (m,) int64 twice
        Neighbouring lanes of the same direction.
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
    """Driving lanes with their lengths, successors, predecessors, and groups of neighbouring lanes."""

    types: Sequence[str]
    inside: Sequence[bool]
    lengths: Sequence[float]
    after: Sequence[Sequence[int]]
    before: Sequence[Sequence[int]]
    group: Sequence[int]

    def turned(self) -> _Lanes:
        """Return the lanes in reverse driving direction: successors become predecessors."""
        return replace(self, after=self.before, before=self.after)

    def reaches(self, leading: frozenset[str]) -> dict[int, float]:
        """Return the lanes in a merge zone, each with the length of the zone before its end: lane → m."""
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
        """Yield the lanes that end where several roads become one road."""
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
        """Yield the lane groups after the next junction, each with the last lane before it."""
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
        """Add a lane, its neighbours and the lanes before them to a merge zone, up to its largest length."""
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
    """Return lanes related to each lane (such as successors), as lists. Only driving lanes count."""
    found: list[list[int]] = [[] for _ in range(count)]
    for one, other in zip(*(column.tolist() for column in pairs), strict=True):
        if traffic[one] and traffic[other]:
            found[one].append(other)
    return found


def _groups(beside: Sequence[Sequence[int]]) -> list[int]:
    """Return the group number of each lane. Neighbouring lanes have the same number."""
    group = [-1] * len(beside)
    for first in range(len(beside)):
        queue = [first] if group[first] < 0 else []
        while queue:
            at = queue.pop()
            if group[at] < 0:
                group[at] = first
                queue += beside[at]
    return group
