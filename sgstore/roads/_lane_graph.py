"""Distances and routes along the lanes: over ``travelsTo``, and over lane changes if wanted."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from sgstore.world import Floats, Ints


FARTHEST: Final = 200.0
"""How far along the lanes is looked from one entity to another; m. The view ``pairs`` has it too."""
_MOST_AT_ONCE: Final = 1 << 22
"""Pairs of lanes whose distances are held at a time."""
_NOTHING: Final = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))


@dataclass(frozen=True, slots=True)
class LaneReach:
    """Lanes that lie downstream of lanes, ordered by lane and distance; shape (n,).

    Attributes
    ----------
    lane, other : int64
        Lanes, counted from 0; ``other`` can be reached from the end of ``lane``. A lane may reach itself.
    distance : float64
        From the end of ``lane`` to the start of ``other``; m.
    """

    lane: Ints
    other: Ints
    distance: Floats

    @classmethod
    def none(cls) -> LaneReach:
        """Nothing lies downstream of anything."""
        return cls(*_NOTHING)


class LaneGraph:
    """Lanes as the nodes of a graph.

    Parameters
    ----------
    lengths : (L,) float64
        Lengths of lanes; m.
    src, dst : (n,) int64
        Lanes, counted from 0, from which traffic flows on to others.
    change_src, change_dst : (m,) int64
        Lanes from which traffic may change to others.
    """

    def __init__(
        self, lengths: Floats, src: Ints, dst: Ints, change_src: Ints, change_dst: Ints
    ) -> None:
        self._lengths = lengths
        order = np.lexsort((dst, src))
        self._next = dst[order]
        self._first = np.searchsorted(src[order], np.arange(len(lengths) + 1))
        self._changes: dict[int, list[int]] = {}
        for lane, other in zip(change_src.tolist(), change_dst.tolist(), strict=True):
            self._changes.setdefault(lane, []).append(other)
        self._reach: tuple[float, LaneReach] | None = None

    def downstream(self, limit: float) -> LaneReach:
        """All lanes whose start lies at most ``limit`` metres beyond the end of a lane.

        The last answer is kept: to ask again for the same limit costs nothing.
        """
        if self._reach is None or self._reach[0] != limit:
            self._reach = (limit, self._explore(limit))
        return self._reach[1]

    def _explore(self, limit: float) -> LaneReach:
        n = len(self._lengths)
        step = max(_MOST_AT_ONCE // max(n, 1), 1)
        parts = [
            self._from(np.arange(first, min(first + step, n)), limit) for first in range(0, n, step)
        ]
        lane, other, distance = (
            np.concatenate(columns) for columns in zip(_NOTHING, *parts, strict=True)
        )
        order = np.lexsort((other, distance, lane))
        return LaneReach(lane[order], other[order], distance[order])

    def _from(self, lanes: Ints, limit: float) -> tuple[Ints, Ints, Floats]:
        """Lanes downstream of some lanes: the fronts of all advance together, lane by lane."""
        best = np.full((len(lanes), len(self._lengths)), np.inf)
        source, at, distance = np.arange(len(lanes)), lanes, np.zeros(len(lanes))
        while len(source):
            counts = self._first[at + 1] - self._first[at]
            of = np.repeat(np.arange(len(at)), counts)
            number = np.arange(len(of)) - (np.cumsum(counts) - counts)[of]
            source, at, distance = (
                source[of],
                self._next[self._first[at[of]] + number],
                distance[of],
            )
            better = np.flatnonzero((distance <= limit) & (distance < best[source, at]))
            source, at, distance = source[better], at[better], distance[better]
            np.minimum.at(best, (source, at), distance)
            least = np.flatnonzero(distance == best[source, at])
            key, first = np.unique(
                source[least] * len(self._lengths) + at[least], return_index=True
            )
            source, at = np.divmod(key, len(self._lengths))
            distance = distance[least[first]] + self._lengths[at]
        row, other = np.nonzero(np.isfinite(best))
        return lanes[row], other, best[row, other]

    def distances(
        self, lane: Ints, along: Floats, other: Ints, other_along: Floats, limit: float
    ) -> Floats:
        """Distances along the lanes from one place to another, driving on.

        Parameters
        ----------
        lane, along : (N,)
            Where from: lanes, counted from 0, and the length of their centre lines up to there; m.
        other, other_along : (N,)
            Where to.
        limit : float
            Greatest distance between the end of the first lane and the start of the last; m.

        Returns
        -------
        (N,) float64
            m; infinite where there is no way, or none within the limit.
        """
        reach, n = self.downstream(limit), len(self._lengths)
        key = reach.lane * n + reach.other
        order = np.argsort(key)
        wanted = np.asarray(lane) * n + other
        place = np.searchsorted(key[order], wanted)
        row = np.append(order, -1)[place]
        found = np.append(key, -1)[row] == wanted
        between = np.where(found, np.append(reach.distance, np.inf)[row], np.inf)
        onward = self._lengths[lane] - along + between + other_along
        same = (np.asarray(lane) == other) & (other_along >= along)
        return np.where(same, other_along - along, onward)

    def route(self, src: int, dst: int, *, changes: bool = False) -> tuple[int, ...]:
        """The lanes of the shortest way from one lane to another, both included; empty: there is none.

        Parameters
        ----------
        src, dst : int
            Lanes, counted from 0. The way begins at the start of ``src``; to itself it is that lane alone.
        changes : bool
            Whether lane changes count as ways on. A change is as long as nothing.
        """
        settled: dict[int, int] = {}
        queue: list[tuple[float, int, int, int]] = [(0.0, 0, src, -1)]
        while queue:
            distance, steps, lane, before = heapq.heappop(queue)
            if lane in settled:
                continue
            settled[lane] = before
            if lane == dst:
                return _traced(settled, dst)
            length = float(self._lengths[lane])
            for other in self._next[self._first[lane] : self._first[lane + 1]].tolist():
                heapq.heappush(queue, (distance + length, steps + 1, other, lane))
            for other in self._changes.get(lane, []) if changes else []:
                heapq.heappush(queue, (distance, steps + 1, other, lane))
        return ()


def _traced(before: dict[int, int], lane: int) -> tuple[int, ...]:
    way = [lane]
    while (lane := before[lane]) >= 0:
        way.append(lane)
    return tuple(reversed(way))
