"""Criticality measures of many object pairs at once. The values are the same as in :class:`Encounter`.

Notes
-----
Circles around and inside the footprints bound a number of a pair. They choose the few frames in which the
exact number is needed.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from sgstore.model.criticality._encroachment import OF_AREAS
from sgstore.model.criticality._exposure import TAU
from sgstore.model.criticality._footprints import FOOTPRINT, Footprints
from sgstore.model.criticality._headway import HeadwaySearch
from sgstore.model.criticality._potential import crash_chances
from sgstore.model.frame_ids import SEQ_BITS, trace_of
from sgstore.model.pair_numbers import PairNumbers

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from sgstore.model.world import Bools, Floats, Ints

_MARGIN: Final = 1e-6
"""Enlargement of bounds, more than their rounding errors; m."""
_TOGETHER: Final = 1 << 14
"""Number of pairs whose exact values are computed at once."""
_SEQ: Final = (1 << SEQ_BITS) - 1
_DENSE: Final = 1 << 16
"""Largest range of node ids for which a table with one entry per id is used."""


def _numbered(ids: Ints) -> tuple[Ints, Ints]:
    """Return ascending ids that include the given ones, and the index of each given id in this list."""
    low = int(ids.min())
    if int(ids.max()) - low < _DENSE:
        return np.arange(low, int(ids.max()) + 1), ids - low
    return np.unique(ids, return_inverse=True)


class Meetings:
    """All frames that contain both objects of a pair. One object per trace is paired with all others.

    Parameters
    ----------
    frames, nodes, place : (K,) int64
        Frame id and node id of each state of an object in a frame, in any order, and its row in ``states``.
    states : (M, 10) float64
        As in :class:`Track`. A standing object needs one row.
    sources : mapping of int to int
        Node id of the object by trace id. All traces of the frames occur.
    times : tuple of (F,) int64 and (F,) float64
        Frames of the traces, ascending, and their times; s.

    Attributes
    ----------
    traces, sources, nodes : (P,) int64
        Trace and node ids of both objects of each pair.
    pair, frame_id, when : (R,) int64
        Pair of each row, its frame, and the place of the frame in the order of time.
    a, b : (R,) int64
        State of the object of the trace, and of the other one.
    of_motion : frozenset of str
        Measures that need velocities and accelerations.
    """

    of_motion: ClassVar = frozenset({"tet", "tit", "cpi"})

    def __init__(
        self,
        frames: Ints,
        nodes: Ints,
        place: Ints,
        states: Floats,
        sources: Mapping[int, int],
        times: tuple[Ints, Floats],
    ) -> None:
        self._states = states
        traces = np.array(sorted(sources))
        rank = traces.searchsorted(trace_of(frames))
        ends = times[0].searchsorted((traces + 1) << SEQ_BITS) - 1
        lengths = np.where(ends >= 0, (times[0][ends] & _SEQ) + 1, 0)
        first = np.cumsum(lengths) - lengths
        self.times: Floats = np.full(int(lengths.sum()), np.nan)
        self.times[first[traces.searchsorted(trace_of(times[0]))] + (times[0] & _SEQ)] = times[1]
        when = first[rank] + (frames & _SEQ)
        egos = np.array([sources[one] for one in traces.tolist()])
        own = nodes == egos[rank]
        of_frame = np.full(len(self.times), -1)
        of_frame[when[own]] = place[own]
        ids, number = _numbered(np.append(nodes, egos))
        width = len(ids)
        code = rank * width + number[: len(nodes)]
        there = np.zeros(len(traces) * width, np.bool_)
        there[code[~own]] = True
        there &= np.repeat(np.bincount(rank[own], minlength=len(traces)) > 0, width)
        others = np.flatnonzero(there)
        ranks, place_of = np.divmod(others, width)
        self.nodes: Ints = ids[place_of]
        self.traces: Ints = traces[ranks]
        self.sources: Ints = egos[ranks]
        self._objects = others, ranks * width + number[len(nodes) :][ranks]
        self._tracks = code, when, place, of_frame[when] >= 0
        of_code = np.cumsum(there) - 1
        a = of_frame[when]
        rows = np.flatnonzero((a >= 0) & ~own)
        self.pair: Ints = of_code[code[rows]]
        self.when: Ints = when[rows]
        self.frame_id: Ints = frames[rows]
        self.a: Ints = a[rows]
        self.b: Ints = place[rows]

    def __len__(self) -> int:
        return len(self.nodes)

    def least(self, rows: Ints, values: Floats) -> Floats:
        """Return the smallest of the given values for each pair, (P,). Infinite for a pair without values."""
        found = np.full(len(self), np.inf)
        np.minimum.at(found, self.pair[rows], values)
        return found

    @cached_property
    def first(self) -> Floats:
        """Time of the first row of each pair, (P,); s."""
        return self.least(np.arange(len(self.pair)), self.times[self.when])

    @cached_property
    def known(self) -> Bools:
        """Mask of the rows in which positions and sizes of both objects are known, (R,)."""
        known: Bools = np.logical_and.reduce(~np.isnan(self._states[:, FOOTPRINT]), axis=1)
        return known[self.a] & known[self.b]

    @cached_property
    def away(self) -> Floats:
        """Distance between the centres of both objects in each row, (R,); m."""
        x, y = self._states[:, 0], self._states[:, 1]
        return np.hypot(x[self.b] - x[self.a], y[self.b] - y[self.a])

    @cached_property
    def beyond(self) -> Floats:
        """Distance between the circles around both footprints in each row, (R,); m. Negative for overlap."""
        reach = np.hypot(self._states[:, 4], self._states[:, 5]) / 2
        return self.away - reach[self.a] - reach[self.b]

    def numbers(self, rows: Ints, of: Callable[[PairNumbers], Floats]) -> Floats:
        """Return a measure of the two objects in each given row, (K,)."""
        found = np.empty(len(rows))
        for start in range(0, len(rows), _TOGETHER):
            part = rows[start : start + _TOGETHER]
            pairs = PairNumbers(self._states[self.a[part]], self._states[self.b[part]])
            found[start : start + _TOGETHER] = of(pairs)
        return found

    def ordered(self, pairs: Bools) -> tuple[Ints, Ints]:
        """Return the rows of some pairs, by pair and time, and the index of each pair's first row."""
        rows = np.flatnonzero(pairs[self.pair])
        rows = rows[np.lexsort((self.when[rows], self.pair[rows]))]
        return rows, np.flatnonzero(np.diff(self.pair[rows], prepend=-1))

    @cached_property
    def ahead(self) -> Ints:
        """Return all rows in which object b may be ahead in the path of object a, with some rows too many."""
        x, y, _, heading, length, width, *_ = self._states.T
        cosine, sine = np.cos(heading), np.sin(heading)
        dx, dy = x[self.b] - x[self.a], y[self.b] - y[self.a]
        lon = dx * cosine[self.a] + dy * sine[self.a]
        lat = np.abs(dy * cosine[self.a] - dx * sine[self.a])
        reach = (width[self.a] + np.hypot(length, width)[self.b]) / 2
        return np.flatnonzero(self.known & (lon > -_MARGIN) & (lat < reach + _MARGIN))

    @cached_property
    def closest(self) -> tuple[Floats, Floats]:
        """Smallest gap of each pair (m), and the first time with this gap (s), (P,)."""
        inner = np.minimum(self._states[:, 4], self._states[:, 5]) / 2
        known = np.flatnonzero(self.known)
        most = (self.away - inner[self.a] - inner[self.b])[known]
        most = np.maximum(self.least(known, most), 0) + _MARGIN
        rows = known[self.beyond[known] <= most[self.pair[known]]]
        gap = self.numbers(rows, lambda pairs: pairs["gap"])
        least = self.least(rows, gap)
        on = rows[gap == least[self.pair[rows]]]
        return least, self.least(on, self.times[self.when[on]])

    @cached_property
    def exposed(self) -> tuple[Ints, Ints, Floats, Floats]:
        """Return the rows with a short TTC of each pair: pair, first row, TTC (s) and time step (s)."""
        vx, vy = self._states[:, 6], self._states[:, 7]
        speed = np.hypot(vx[self.b] - vx[self.a], vy[self.b] - vy[self.a])
        near = np.flatnonzero(self.known & (self.beyond - TAU * speed <= _MARGIN))
        ttc = np.full(len(self.pair), np.nan)
        ttc[near] = self.numbers(near, lambda pairs: pairs["ttc"])
        pairs = np.zeros(len(self), np.bool_)
        pairs[self.pair[near[ttc[near] <= TAU]]] = True
        rows, _ = self.ordered(pairs)
        step = np.diff(self.times[self.when[rows]], append=np.nan)
        on = (ttc[rows] <= TAU) & (np.diff(self.pair[rows], append=-1) == 0)
        rows, step = rows[on], step[on]
        begins = np.flatnonzero(np.diff(self.pair[rows], prepend=-1))
        return self.pair[rows], begins, ttc[rows], step

    @cached_property
    def _near(self) -> tuple[Ints, Ints]:
        """Pairs of objects that move in overlapping areas, and the state rows of these objects."""
        others, sources = self._objects
        code, when, place, _ = self._tracks
        reach = np.hypot(self._states[:, 4], self._states[:, 5]) / 2 + _MARGIN
        size = int(max(code.max(initial=0), sources.max(initial=0))) + 1
        on = np.ones(len(others), np.bool_)
        for axis in (0, 1):
            low, high = np.full(size, np.inf), np.full(size, -np.inf)
            np.fmin.at(low, code, (self._states[:, axis] - reach)[place])
            np.fmax.at(high, code, (self._states[:, axis] + reach)[place])
            on &= (low[others] <= high[sources]) & (low[sources] <= high[others])
        objects = np.zeros(size, np.bool_)
        objects[others[on]] = objects[sources[on]] = True
        rows = np.flatnonzero(objects[code])
        return np.flatnonzero(on), rows[np.lexsort((when[rows], code[rows]))]

    @cached_property
    def _footprints(self) -> tuple[Footprints, Ints, Ints]:
        """Footprints of the objects that move in overlapping areas, and the two objects of each pair."""
        pairs, rows = self._near
        code, _, place, _ = self._tracks
        boxes = [self._states[:, column][place[rows]] for column in FOOTPRINT]
        found = Footprints(code[rows], np.stack(boxes))
        others, sources = (found.objects.searchsorted(one[pairs]) for one in self._objects)
        return found, sources, others

    def headways(self) -> Floats:
        """Return the smallest recorded headway of each pair, (P,); s. Infinite if a never reaches b's place."""
        footprints, a, b = self._footprints
        pairs, rows = self._near
        _, when, _, both = self._tracks
        search = HeadwaySearch(footprints, len(a), when[rows], both[rows], self.times)
        known = np.flatnonzero(footprints.known[a] & footprints.known[b])
        search.run(known, a[known], b[known])
        found = np.full(len(self), np.inf)
        found[pairs] = search.least
        return found

    @cached_property
    def encroachments(self) -> Floats:
        """Times at which both objects of each pair enter and leave their conflict area, (P, 4); s."""
        footprints, a, b = self._footprints
        pairs, rows = self._near
        times = np.append(self.times[self._tracks[1][rows]], np.nan)  # -1 is the last one
        found = np.full((len(self), 4), np.nan)
        found[pairs] = times[footprints.crossed(a, b)]
        return found

    def values(self, name: str) -> Floats:
        """Return the named criticality measure of each pair, (P,). NaN if unknown or undefined."""
        with np.errstate(invalid="ignore"):
            if name in OF_AREAS:
                return OF_AREAS[name](self.encroachments)
            found = _OF_ROWS[name](self)
        return np.where(np.isfinite(found), found, np.nan)


def _ttc_recorded(of: Meetings) -> Floats:
    near = np.flatnonzero(of.known & (of.beyond <= _MARGIN))
    met = near[of.numbers(near, lambda pairs: pairs["gap"]) <= 0]
    return of.least(met, of.times[of.when[met]]) - of.first


def _summed(of: Meetings, power: int) -> Floats:
    pair, begins, ttc, step = of.exposed
    found = np.zeros(len(of))
    parts = (TAU - ttc) ** power * step
    for one, part in zip(pair[begins].tolist(), np.split(parts, begins)[1:], strict=True):
        found[one] = part.sum()  # rounds as the sum of one pair; reduceat does not
    return found


def _cpi(of: Meetings) -> Floats:
    ahead = of.ahead
    chance = np.where(of.known, 0.0, np.nan)
    chance[ahead] = of.numbers(ahead, crash_chances)
    counted = ~np.isnan(chance)
    found = np.where(np.bincount(of.pair[counted], minlength=len(of)) > 0, 0.0, np.nan)
    pairs = np.zeros(len(of), np.bool_)
    pairs[of.pair[np.flatnonzero(chance > 0)]] = True
    rows, begins = of.ordered(pairs)
    for one, part in zip(
        of.pair[rows][begins].tolist(), np.split(chance[rows], begins)[1:], strict=True
    ):
        found[one] = np.nanmean(part)
    return found


_OF_ROWS: Final[dict[str, Callable[[Meetings], Floats]]] = {
    "ttc_recorded": _ttc_recorded,
    "headway_recorded": Meetings.headways,
    "dce_recorded": lambda of: of.closest[0],
    "ttce_recorded": lambda of: of.closest[1] - of.first,
    "tet": lambda of: _summed(of, 0),
    "tit": lambda of: _summed(of, 1),
    "cpi": _cpi,
}
"""Name of a measure → function from the frames with both objects to its values, (P,). Not finite: unknown."""
