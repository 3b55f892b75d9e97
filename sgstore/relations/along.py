"""Where along a lane a place is: the foot of the perpendicular on its centre line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.relations.scene import spread
from sgstore.relations.sweep import parts

if TYPE_CHECKING:
    from sgstore.roads import Ribbons
    from sgstore.world import Floats, Ints


class Centrelines:
    """The centre lines of all lanes, to be asked for places along them.

    Parameters
    ----------
    ribbons : Ribbons
        Of which the straight lines between the middles of cross sections are taken.
    """

    def __init__(self, ribbons: Ribbons) -> None:
        self._first = ribbons.offsets[:-1]
        self._count = np.diff(ribbons.offsets) - 1
        x, y = (ribbons.left_x + ribbons.right_x) / 2, (ribbons.left_y + ribbons.right_y) / 2
        self._x, self._y, self._along = x, y, ribbons.along
        self._run_x, self._run_y = np.diff(x), np.diff(y)
        squared = self._run_x**2 + self._run_y**2
        self._squared = np.where(squared > 0, squared, 1.0)

    def along(self, lane: Ints, x: Floats, y: Floats) -> Floats:
        """Length of the centre line from the lane's start up to the foot of the perpendicular from a place.

        Parameters
        ----------
        lane : (N,) int64
            Lanes, counted from 0.
        x, y : (N,) float64
            Places; m.

        Returns
        -------
        (N,) float64
            m. The foot is the nearest point, of several the first; where that is an end of the lane, it is
            where the lane would be if it went straight on: below 0, or above its length.
        """
        count = self._count[lane]
        found = np.empty(len(lane))
        for part in parts(count):
            found[part] = self._of(self._first[lane[part]], count[part], x[part], y[part])
        return found

    def _of(self, first: Ints, count: Ints, x: Floats, y: Floats) -> Floats:
        owner, piece = spread(first, count)
        if not len(owner):
            return np.zeros(len(first))
        run_x, run_y = self._run_x[piece], self._run_y[piece]
        away_x, away_y = x[owner] - self._x[piece], y[owner] - self._y[piece]
        onward = (away_x * run_x + away_y * run_y) / self._squared[piece]
        share = np.minimum(np.maximum(onward, 0.0), 1.0)
        squared = (away_x - share * run_x) ** 2 + (away_y - share * run_y) ** 2
        starts = np.cumsum(count) - count
        least = np.repeat(np.minimum.reduceat(squared, starts), count)
        # Every lane has a piece at least, so each owner has a first that is the nearest.
        nearest = np.flatnonzero(squared == least)
        _, at = np.unique(owner[nearest], return_index=True)
        at = nearest[at]
        before, after = self._along[piece[at]], self._along[piece[at] + 1]
        out = ((at == starts) & (onward[at] < 0)) | ((at == starts + count - 1) & (onward[at] > 1))
        return before + np.where(out, onward[at], share[at]) * (after - before)
