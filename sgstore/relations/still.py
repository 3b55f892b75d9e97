"""Pairs of what never moves: found once, when it appears, and looked up where both of them are in range."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.relations.pairs import NO_PAIRS, pairs_among
from sgstore.relations.scene import joined

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.config import Config
    from sgstore.relations.scene import Bodies
    from sgstore.world import Ints

    Rows = NDArray[np.intp]


class StillPairs:
    """The pairs of the scenery of a trace that are near one another; none, unless the settings want them.

    Parameters
    ----------
    config : Config
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._a, self._b = NO_PAIRS

    @property
    def wanted(self) -> bool:
        """Whether there is anything to learn."""
        return self._config.pairs.static and self._config.pairs.within > 0

    def learn(self, scenery: Bodies) -> None:
        """Find the pairs of all scenery so far, as if it stood in one frame."""
        a, b = pairs_among(scenery, np.arange(len(scenery)), self._config)
        order = np.argsort(a, kind="stable")
        self._a, self._b = a[order], b[order]

    def among(self, keys: Ints, states: int, count: int) -> tuple[Rows, Rows]:
        """The pairs of which both are in range.

        Parameters
        ----------
        keys : int64
            What is in range, ascending: from ``states`` on, frame times ``count`` plus the row of the scenery.
        states, count : int
            Rows of the block's states, and of the scenery.

        Returns
        -------
        a, b : intp
            Places in ``keys``.
        """
        if not len(self._a):
            return NO_PAIRS
        first = int(np.searchsorted(keys, states))
        still = keys[first:] - states
        owner, pair = joined(self._a, still % count)
        other = still[owner] - self._a[pair] + self._b[pair]
        place = np.minimum(np.searchsorted(still, other), max(len(still) - 1, 0))
        found = np.flatnonzero(still[place] == other)
        return first + owner[found], first + place[found]
