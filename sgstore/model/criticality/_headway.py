"""Recorded headway: time until object a reaches the present position of object b.

headway_recorded(t) (s) = min { t′ − t : t′ ≥ t, the footprint of a at t′ touches the one of b at t
}. Source: Jansson, Collision Avoidance Theory, 2005. Here the path is the recorded one, so that it
can bend.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.model.criticality._footprints import AreaSearch

if TYPE_CHECKING:
    from sgstore.model.criticality._encounter import Encounter
    from sgstore.model.criticality._footprints import Footprints
    from sgstore.model.world import Bools, Floats, Ints


def headway_recorded(of: Encounter) -> Floats:
    """Return the time until object a reaches b's present position, for each frame, (T,); s. NaN for never."""
    comes = np.full(len(of.b), np.inf)
    for rows_a, rows_b in of.crossings():
        later = of.a.times[rows_a] - of.b.times[rows_b]
        ahead = later >= 0
        np.minimum.at(comes, rows_b[ahead], later[ahead])
    found = comes[of.together[1]]
    return np.where(np.isfinite(found), found, np.nan)


class HeadwaySearch(AreaSearch):
    """Search for many pairs of objects: the smallest recorded headway of each pair.

    Parameters
    ----------
    of : Footprints
    pairs : int
        Number of pairs.
    when : (K,) int64
        Place of the frame of each state of ``of`` in ``times``.
    both : (K,) bool
        Mask of the states whose frame has both objects of the pair.
    times : (F,) float64
        Ascending; s.

    Attributes
    ----------
    least : (P,) float64
        Least headway that is found; s. Infinite for none.
    """

    def __init__(self, of: Footprints, pairs: int, when: Ints, both: Bools, times: Floats) -> None:
        super().__init__(of, pairs)
        self.least: Floats = np.full(pairs, np.inf)
        self._times = times
        ends = np.append(of.states, len(when))[1:] - 1
        self._begin, self._end = when[of.states], when[ends]
        # States by object and time, and the last state up to each that has both objects.
        self._object = np.repeat(np.arange(len(of.objects)), np.diff(of.begins))
        self._keys = np.repeat(self._object, ends + 1 - of.states) * len(times) + when
        self._when, self._ends = when, ends
        self._last_both = np.maximum.accumulate(np.where(both, np.arange(len(when)), -1))

    def _near(self, level: int, pair: Ints, a: Ints, b: Ints) -> tuple[Ints, Ints, Ints]:
        """Return pairs of overlapping bounding boxes that may have a smaller headway, most promising first."""
        on = self._boxes_overlap(level, a, b)
        pair, a, b = pair[on], a[on], b[on]
        rows = self._of.levels[level].rows
        after = self._begin[rows[a]], self._end[rows[a + 1] - 1]
        before = self._begin[rows[b]], self._end[rows[b + 1] - 1]
        bound = np.maximum(self._times[after[0]] - self._times[before[1]], 0)
        on = np.flatnonzero((bound < self.least[pair]) & (after[1] >= before[0]))
        on = on[np.argsort(bound[on], kind="stable")]
        return pair[on], a[on], b[on]

    def _rows(self, pair: Ints, a: Ints, b: Ints) -> None:
        """Compare the footprints of pairs of rows. Update the smallest headway of each object pair."""
        near = np.flatnonzero(self._circles_overlap(a, b))
        headway = self._headways(a[near], b[near])
        less = headway < self.least[pair[near]]
        near, headway = near[less], headway[less]
        on = self._overlap(a[near], b[near])
        np.minimum.at(self.least, pair[near[on]], headway[on])

    def _headways(self, a: Ints, b: Ints) -> Floats:
        """Return the time from b's last frame at a position until a reaches it; s. Infinite if a never does."""
        key = self._object[b] * len(self._times) + self._end[a]
        last = np.minimum(self._keys.searchsorted(key, "right") - 1, self._ends[b])
        last = np.where(last >= 0, self._last_both[last], -1)
        later = self._times[self._begin[a]] - self._times[self._when[last]]
        return np.where(last >= self._of.states[b], np.maximum(later, 0), np.inf)
