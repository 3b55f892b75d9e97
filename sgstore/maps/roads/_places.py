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

from sgstore.maps.roads._ribbons import centre_lines

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.maps.roads._ribbons import Ribbons
    from sgstore.model.world import Floats, Ints


STOP_LINE: Final = "stop_line"
"""Kind of a signal that is a line painted on the road."""


BROAD_LINES: Final = ("broad_line_left", "broad_line_right")
"""Names of broad markings to the left and to the right of a lane, in its direction of travel."""


@dataclass(frozen=True, slots=True)
class MapPlaces:
    """Intervals of lanes that map parts (junctions, crosswalks, signals, …) cover; shape (n,).

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
        """Yield for each interval: node id of the map part, kind, node id of the lane, start, end."""
        # Map node c has the id -1 - c, and the lanes follow the first node of a map.
        parts, lanes = (-1 - self.part).tolist(), (-2 - self.lane).tolist()
        return zip(parts, self.what, lanes, self.start.tolist(), self.end.tolist(), strict=True)

    @classmethod
    def none(cls) -> MapPlaces:
        """Return an empty table of lane intervals."""
        no_rows, no_lengths = np.zeros(0, np.int64), np.zeros(0)
        return cls(no_rows, (), no_rows, no_lengths, no_lengths)

    @classmethod
    def of(
        cls, part: Ints, what: Sequence[str], lane: Ints, start: Floats, end: Floats
    ) -> MapPlaces:
        """Return a table of lane intervals, sorted, from columns in any order."""
        order = np.lexsort((end, start, lane, part))
        kinds = tuple(what[int(row)] for row in order)
        return cls(part[order], kinds, lane[order], start[order], end[order])

    @classmethod
    def of_broad_lines(cls, rows: Sequence[tuple[int, bool, float, float]]) -> MapPlaces:
        """Return a table with the intervals of lanes that have broad markings.

        A row is the lane, True if the marking is on its left, and start and end; m.
        """
        lane = np.array([row[0] for row in rows], np.int64)
        start, end = (np.array([row[i] for row in rows], np.float64) for i in (2, 3))
        what = [BROAD_LINES[0 if is_left else 1] for _, is_left, _, _ in rows]
        return cls.of(lane + 1, what, lane, start, end)


def whole_lanes(
    ribbons: Ribbons, what: str, names: Sequence[str], column: dict[str, int]
) -> MapPlaces:
    """Return intervals that cover whole lanes, one for each lane that belongs to a road or junction.

    Parameters
    ----------
    ribbons : Ribbons
    what : str
        Kind of the parts: ``road``, ``junction`` or ``lane``.
    names : sequence of str
        Name of the part of each lane, or empty.
    column : dict of str to int
        Column of each part among the nodes.
    """
    pairs = [(column[name], lane) for lane, name in enumerate(names) if name in column]
    part, lane = np.array(pairs, np.int64).reshape(-1, 2).T
    return MapPlaces.of(part, [what] * len(part), lane, np.zeros(len(lane)), ribbons.lengths[lane])


def crosswalk_places(
    ribbons: Ribbons, columns: Ints, shapes: Any, z: Floats, storey: float
) -> MapPlaces:
    """Return the intervals of lanes that each crosswalk crosses.

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
    lane, crosswalk = shapely.STRtree(shapes).query(lines, predicate="intersects")
    inside: Any = shapely.intersection(lines[lane], shapes[crosswalk])
    points, pair = shapely.get_coordinates(inside, return_index=True)
    if not len(pair):
        return MapPlaces.none()
    along: Any = shapely.line_locate_point(lines[lane[pair]], shapely.points(points))
    first_points = np.flatnonzero(np.diff(pair, prepend=-1))
    extents = (reduce.reduceat(along, first_points) for reduce in (np.minimum, np.maximum))
    lane, crosswalk = lane[pair[first_points]], crosswalk[pair[first_points]]
    start, end = (_curve_lengths(ribbons, lane, extent) for extent in extents)
    height = np.abs(ribbons.at(lane, (start + end) / 2).z - z[crosswalk])
    same_storey = np.flatnonzero(~(height > storey))  # also if the height is unknown
    return MapPlaces.of(
        columns[crosswalk[same_storey]],
        ["crosswalk"] * len(same_storey),
        lane[same_storey],
        start[same_storey],
        end[same_storey],
    )


def _curve_lengths(ribbons: Ribbons, lane: Ints, along: Floats) -> Floats:
    """Convert lengths measured along straight pieces to lengths along curved centre lines; m."""
    x, y = (ribbons.left_x + ribbons.right_x) / 2, (ribbons.left_y + ribbons.right_y) / 2
    lengths = np.empty(len(lane))
    for row in np.unique(lane).tolist():
        own = slice(ribbons.offsets[row], ribbons.offsets[row + 1])
        steps = np.hypot(np.diff(x[own]), np.diff(y[own]))
        straight = np.concatenate((np.zeros(1), np.cumsum(steps)))
        on_lane = lane == row
        lengths[on_lane] = np.interp(along[on_lane], straight, ribbons.along[own])
    return lengths


def signal_places(
    ribbons: Ribbons,
    junction: Sequence[str],
    what: Sequence[str],
    applies: tuple[Ints, Ints],
    stops: tuple[Ints, Ints, Floats],
) -> MapPlaces:
    """Return the positions of traffic signals along the lanes to which they apply.

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
    in_junction = [bool(name) for name in junction]
    stopping = {*zip(*(column.tolist() for column in stops[:2]), strict=True)}
    pairs = {*zip(*(column.tolist() for column in applies), strict=True)}
    rows = [(*pair, 0.0) for pair in pairs if in_junction[pair[1]]]
    rows += [
        (signal, lane, float(ribbons.lengths[lane]))
        for signal, lane in pairs - stopping
        if not in_junction[lane]
    ]
    rows += {
        (signal, lane, along)
        for signal, lane, along in zip(*(column.tolist() for column in stops), strict=True)
        if not in_junction[lane] and (signal, lane) in pairs
    }
    part, lane = np.array([row[:2] for row in rows], np.int64).reshape(-1, 2).T
    along = np.array([row[2] for row in rows], np.float64)
    return MapPlaces.of(part, [what[int(column)] for column in part], lane, along, along)
