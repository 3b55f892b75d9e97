"""Positions of junctions, crosswalks, signals and stop lines along the lanes of a map.

A road or junction covers its lanes completely; a lane covers itself. A crosswalk covers the part of
a lane of its storey where it crosses the centre line. A signal has one place on each of its lanes.
In a junction it is the start of the lane, because traffic stops there, wherever the pole is.
Elsewhere it is the place in the map, or else the end of the lane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import shapely

from sgstore.base.tables import chained
from sgstore.maps.roads._ribbons import centre_lines

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.maps.roads._ribbons import Ribbons
    from sgstore.model.world import Floats, Ints


STOP_LINE: Final = "stop_line"
"""Kind of a signal that is a line painted on the road."""


BROAD_LINES: Final = ("broad_line_left", "broad_line_right")
"""Kinds of broad markings to the left and to the right of a lane, seen in its direction of travel."""


@dataclass(frozen=True, slots=True)
class MapPlaces:
    """Intervals of lanes covered by map parts (junctions, crosswalks, signals, …); shape (n,).

    Attributes
    ----------
    part : int64
        Columns of the parts among the nodes.
    what : tuple of str
        ``stop_line``, else the kind of the part.
    lane : int64
        Lanes, counted from 0.
    start, end : float64
        Along the centre line of the lane; m.
    """

    part: Ints
    what: tuple[str, ...]
    lane: Ints
    start: Floats
    end: Floats

    def __len__(self) -> int:
        return len(self.part)

    def rows(self) -> Iterator[tuple[int, str, int, float, float]]:
        """Yield each lane interval as (map node id, kind, lane node id, start, end)."""
        ids = ((-1 - self.part).tolist(), self.what, (-2 - self.lane).tolist())
        return zip(*ids, self.start.tolist(), self.end.tolist(), strict=True)

    @classmethod
    def none(cls) -> MapPlaces:
        """Return an empty table of lane intervals."""
        no_parts, nowhere = np.zeros(0, np.int64), np.zeros(0)
        return cls(no_parts, (), no_parts, nowhere, nowhere)

    @classmethod
    def of(
        cls, part: Ints, what: Sequence[str], lane: Ints, start: Floats, end: Floats
    ) -> MapPlaces:
        """Make a sorted table of lane intervals from columns in any order."""
        order = np.lexsort((end, start, lane, part))
        told = tuple(what[int(row)] for row in order)
        return cls(part[order], told, lane[order], start[order], end[order])

    @staticmethod
    def of_lines(rows: Sequence[tuple[int, bool, float, float]]) -> MapPlaces:
        """Make a table of lane intervals with broad markings, from rows of lane, side, start and end; m."""
        lane = np.array([row[0] for row in rows], np.int64)
        start, end = (np.array([row[i] for row in rows], np.float64) for i in (2, 3))
        return MapPlaces.of(lane + 1, [BROAD_LINES[not row[1]] for row in rows], lane, start, end)


def made_of_lanes(
    ribbons: Ribbons, what: str, names: Sequence[str], column: dict[str, int]
) -> MapPlaces:
    """Return whole lanes as lane intervals of their road or junction.

    Parameters
    ----------
    ribbons : Ribbons
    what : str
    names : sequence of str
        Name of the part of each lane, or empty.
    column : dict of str to int
        Column of each part among the nodes.
    """
    found = [(column[name], lane) for lane, name in enumerate(names) if name in column]
    part, lane = np.array(found, np.int64).reshape(-1, 2).T
    return MapPlaces.of(part, [what] * len(part), lane, np.zeros(len(lane)), ribbons.lengths[lane])


def on_crosswalks(
    ribbons: Ribbons, columns: Ints, shapes: Any, z: Floats, storey: float
) -> MapPlaces:
    """Return, for each crosswalk, the intervals of the lanes that it crosses.

    Parameters
    ----------
    ribbons : Ribbons
    columns : (n,) int64
        Columns of the crosswalks among the nodes.
    shapes : (n,) object
        Their geometries.
    z : (n,) float64
        Their heights; m. NaN: on any storey.
    storey : float
        Least difference of height between two storeys; m.
    """
    lines = centre_lines(ribbons)
    lane, place = shapely.STRtree(shapes).query(lines, predicate="intersects")
    inside: Any = shapely.intersection(lines[lane], shapes[place])
    points, of = shapely.get_coordinates(inside, return_index=True)
    if not len(of):
        return MapPlaces.none()
    at: Any = shapely.line_locate_point(lines[lane[of]], shapely.points(points))
    starts = np.flatnonzero(np.diff(of, prepend=-1))
    ends = [np.minimum.reduceat(at, starts), np.maximum.reduceat(at, starts)]
    row = of[starts]
    lane, place = lane[row], place[row]
    start, end = (_by_length(ribbons, lane, along) for along in ends)
    level = np.abs(ribbons.at(lane, (start + end) / 2).z - z[place])
    on = np.flatnonzero(~(level > storey))
    what = ["crosswalk"] * len(on)
    return MapPlaces.of(columns[place[on]], what, lane[on], start[on], end[on])


def _by_length(ribbons: Ribbons, lane: Ints, at: Floats) -> Floats:
    """Convert lengths along straight pieces of a line to lengths along curved centre lines; m."""
    x, y = (ribbons.left_x + ribbons.right_x) / 2, (ribbons.left_y + ribbons.right_y) / 2
    found = np.empty(len(lane))
    for one in np.unique(lane).tolist():
        own = slice(ribbons.offsets[one], ribbons.offsets[one + 1])
        steps = np.hypot(np.diff(x[own]), np.diff(y[own]))
        rows = lane == one
        run = np.concatenate((np.zeros(1), np.cumsum(steps)))
        found[rows] = np.interp(at[rows], run, ribbons.along[own])
    return found


def of_signals(
    ribbons: Ribbons,
    junction: Sequence[str],
    what: Sequence[str],
    applies: tuple[Ints, Ints],
    stops: tuple[Ints, Ints, Floats],
) -> MapPlaces:
    """Return the positions of traffic signals along the lanes that they apply to.

    Parameters
    ----------
    ribbons : Ribbons
    junction : sequence of str
        The junction of each lane, or empty.
    what : sequence of str
        Kind of each node.
    applies : (n,) int64 twice
        Signals, as columns among the nodes, and lanes that they apply to.
    stops : (m,) int64, int64 and float64
        Signals, lanes, and the places along these from the map; m.
    """
    within = np.array([bool(name) for name in junction], np.bool_)
    told = {*zip(*(column.tolist() for column in stops[:2]), strict=True)}
    pairs = {*zip(*(column.tolist() for column in applies), strict=True)}
    rows = [(*one, 0.0) for one in pairs if within[one[1]]]
    rows += [(*one, float(ribbons.lengths[one[1]])) for one in pairs - told if not within[one[1]]]
    columns = zip(*(column.tolist() for column in stops), strict=True)
    rows += {one for one in columns if not within[one[1]] and one[:2] in pairs}
    part, lane = np.array([one[:2] for one in rows], np.int64).reshape(-1, 2).T
    at = np.array([one[2] for one in rows], np.float64)
    return MapPlaces.of(part, [what[int(one)] for one in part], lane, at, at)


def together(parts: Sequence[MapPlaces]) -> MapPlaces:
    """Concatenate several tables of lane intervals."""
    one = chained(parts)
    return MapPlaces.of(one.part, one.what, one.lane, one.start, one.end)
