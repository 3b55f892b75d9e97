"""Relation ``sees``: objects that the ego can see, because no other object hides them.

The eye is above the centre of the ego, at the height of its roof. A body is seen if a straight line
to its centre, or to a corner of its footprint at that height, is free. A body blocks a line that
crosses its footprint between its lower and its upper side: a car hides the car behind it, but not
the traffic light above, and a bridge hides nothing on the road below.

* A body without height hides nothing; neither does a signal, nor a body whose footprint contains
  the eye. The ego hides nothing, and a body does not hide itself.
* Without the height of the eye or of the body, only the plane counts. A body without a footprint is
  tested by its centre; a body without position is not seen.
* A body on another storey (as in ``overlaps``) is not seen; signals have no storey.
* A line along a side, or through a corner, is free. The only limit is the range of the graph. The
  view direction of the ego and the weather do not count: they concern sensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.geometry import corners, wrapped
from sgstore.base.numba_loops import worth
from sgstore.graphs.relations._scene import (
    IS_SIGNAL,
    Relation,
    by_frame,
    edges_between,
    meeting,
    on_one_level,
    turns,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sgstore.graphs.relations._scene import BlockScene, Bodies
    from sgstore.model.graph import Edges
    from sgstore.model.world import Bools, Floats, Ints

    Rows = NDArray[np.intp]


GRAZE: Final = 1e-6
"""Length inside a footprint up to which a sight line does not count as blocked; m."""

AT_ONCE: Final = 4096
"""Number of pairs of an object and a possibly hiding object that are processed together."""

POINTS: Final = 5
"""Number of tested points of an object: its centre and its four corners."""


def seen(bodies: Bodies, ego: Rows) -> Rows:
    """Return the rows of the objects that the ego can see in their frame.

    Parameters
    ----------
    bodies : Bodies
    ego : (F,) intp
        Row of the ego of each frame; with -1 the frame has no seen bodies.
    """
    if worth():
        return _seen_in_loops(bodies, ego)
    mine = ego[bodies.frame]
    there = (mine >= 0) & (mine != np.arange(len(bodies)))
    rows = np.flatnonzero(there & np.isfinite(bodies.x) & np.isfinite(bodies.y))
    views = _views(bodies, rows, mine[rows])
    hidden = np.zeros((len(rows), POINTS), np.bool_)
    for target, cover in _in_one_direction(views, bodies.frame[rows]):
        # Near covers first: they hide the most, and hidden bodies are not tested again.
        order = np.argsort(views.near[cover], kind="stable")
        for first in range(0, len(order), AT_ONCE):
            part = order[first : first + AT_ONCE]
            for point in range(POINTS):
                pairs = part[~hidden[target[part], point]]
                blocked = pairs[_blocked(views, target[pairs], cover[pairs], point)]
                hidden[target[blocked], point] = True
    return rows[~hidden.all(axis=1)]


def _seen_in_loops(bodies: Bodies, ego: Rows) -> Rows:
    from sgstore.graphs.relations import _loops

    order, starts = by_frame(bodies.frame, len(ego))
    place, size = (bodies.x, bodies.y, bodies.z), (bodies.length, bodies.width, bodies.height)
    views = place, turns(bodies), size, IS_SIGNAL[bodies.kind]
    return np.flatnonzero(_loops.sight(order, starts, ego, views, GRAZE))


@dataclass(frozen=True, slots=True)
class _Views:
    """Objects relative to the position of the ego's eye, in map axes; shape (N,).

    Attributes
    ----------
    x, y : (N, 5) float64
        Tested points: the centre, and the corners (equal to the centre without a footprint); m.
    z : float64
        Height of these points above the eye; m.
    low, high : float64
        Range of directions of the footprint, ``low`` in [-π, π), ``high`` not below it; rad.
    near, far : float64
        Bounds of the distances of its points; m.
    hides : bool
        True if it can hide other bodies.
    cos, sin, length, width : float64
        Direction and half the size of the footprint; m.
    bottom, top : float64
        Heights of the lower and the upper side above the eye; m.
    """

    x: Floats
    y: Floats
    z: Floats
    low: Floats
    high: Floats
    near: Floats
    far: Floats
    hides: Bools
    cos: Floats
    sin: Floats
    length: Floats
    width: Floats
    bottom: Floats
    top: Floats


def _views(bodies: Bodies, rows: Rows, eye: Rows) -> _Views:
    x, y = bodies.x[rows] - bodies.x[eye], bodies.y[rows] - bodies.y[eye]
    z = bodies.z[rows] - bodies.z[eye] - np.nan_to_num(bodies.height[eye]) / 2
    heading, length, width = bodies.heading[rows], bodies.length[rows], bodies.width[rows]
    around = corners(np.stack([x, y, heading, length, width], axis=1))
    known = ~np.isnan(around).any(axis=(1, 2))
    around[~known] = np.stack([x, y], axis=1)[~known][:, None]
    points_x = np.column_stack([x, around[:, :, 0]])
    points_y = np.column_stack([y, around[:, :, 1]])
    cos, sin = np.cos(heading), np.sin(heading)
    lon, lat = np.abs(x * cos + y * sin), np.abs(y * cos - x * sin)
    within = (lon <= length / 2) & (lat <= width / 2)
    middle = np.arctan2(y, x)
    aside = wrapped(np.arctan2(points_y, points_x) - middle[:, None])
    low = np.where(within, -np.pi, wrapped(middle + aside.min(axis=1)))
    low = np.where(low >= np.pi, -np.pi, low)
    wide = np.where(within, 2 * np.pi, np.ptp(aside, axis=1))
    ahead, beside = np.maximum(lon - length / 2, 0), np.maximum(lat - width / 2, 0)
    height = bodies.height[rows]
    return _Views(
        x=points_x,
        y=points_y,
        z=z,
        low=low,
        high=low + wide,
        near=np.sqrt(ahead * ahead + beside * beside),
        far=np.sqrt((points_x**2 + points_y**2).max(axis=1, initial=0)),
        hides=known & (height > 0) & ~within & ~IS_SIGNAL[bodies.kind[rows]],
        cos=cos,
        sin=sin,
        length=length / 2 - GRAZE,
        width=width / 2 - GRAZE,
        bottom=z - height / 2,
        top=z + height / 2,
    )


def _in_one_direction(views: _Views, frame: Ints) -> Iterator[tuple[Rows, Rows]]:
    """Yield pairs of an object and an object that may hide it: nearer, and in the same direction."""
    # Ranges beyond π occur a second time, from the other side.
    again = np.flatnonzero(views.high > np.pi)
    rows = np.concatenate([np.arange(len(views.low)), again])
    low = np.concatenate([views.low, views.low[again] - 2 * np.pi])
    high = np.concatenate([views.high, views.high[again] - 2 * np.pi])
    for one, other in meeting(frame[rows], low, high):
        first, second = rows[one], rows[other]
        target, cover = np.concatenate([first, second]), np.concatenate([second, first])
        kept = views.hides[cover] & (views.near[cover] < views.far[target]) & (target != cover)
        yield target[kept], cover[kept]


def _blocked(views: _Views, target: Rows, cover: Rows, point: int) -> Bools:
    """Return a mask of lines of sight, each to a point of an object: True if a nearer object blocks it."""
    cos, sin = views.cos[cover], views.sin[cover]
    x, y = views.x[cover, 0], views.y[cover, 0]
    to_x, to_y = views.x[target, point], views.y[target, point]
    # In the axes of the cover; shares of the way from the eye, 0, to the point, 1.
    enters, leaves = _within(
        -x * cos - y * sin, to_x * cos + to_y * sin, views.length[cover], 0.0, 1.0
    )
    enters, leaves = _within(
        x * sin - y * cos, to_y * cos - to_x * sin, views.width[cover], enters, leaves
    )
    height = views.z[target]
    low, high = (
        np.minimum(enters * height, leaves * height),
        np.maximum(enters * height, leaves * height),
    )
    passes = (low >= views.top[cover]) | (
        high <= views.bottom[cover]
    )  # False if a height is missing
    return (enters < leaves) & ~passes


def _within(
    start: Floats, run: Floats, half: Floats, enters: Floats | float, leaves: Floats | float
) -> tuple[Floats, Floats]:
    """Return the fractions of a line at which a coordinate enters and leaves the range ±``half``."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half - start) / run, (half - start) / run
    return (
        np.maximum(np.minimum(one, other), enters),
        np.minimum(np.maximum(one, other), leaves),
    )


def _edges(scene: BlockScene) -> Edges:
    bodies, ego = scene.bodies, scene.ego
    rows = seen(bodies, ego) if scene.config.sees else np.zeros(0, np.intp)
    rows = rows[on_one_level(bodies, ego[bodies.frame[rows]], rows)]
    return edges_between(scene, "sees", ego[bodies.frame[rows]], rows)


SEES = Relation(
    name="sees",
    doc="ego → entity: no other body hides it: its centre or a corner is in sight",
    edges=_edges,
    settings=lambda config: config.sees,
)
