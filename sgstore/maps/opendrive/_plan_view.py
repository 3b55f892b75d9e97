"""Reference lines of OpenDRIVE roads (line, arc, spiral, polynomial), evaluated at many positions at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.maps.opendrive._piecewise import cubic, cubic_bend, cubic_slope

if TYPE_CHECKING:
    from sgstore.maps.opendrive._document import Document
    from sgstore.model.world import Codes, Floats, Ints

LINE, ARC, SPIRAL, CUBIC = range(4)

MAX_TURN: Final = 12 * np.pi
"""Largest change of heading within one spiral; rad. Up to it, the integration error is far below 1 mm."""

_NODES, _WEIGHTS = (np.asarray(a, np.float64) for a in np.polynomial.legendre.leggauss(32))

_FEW_NODES, _FEW_WEIGHTS = (np.asarray(a, np.float64) for a in np.polynomial.legendre.leggauss(5))

_CELLS: Final = 64
"""Number of steps in a table of arc lengths."""

_TINY: Final = 1e-9

_BELOW_ONE: Final = 1 - 1e-12


@dataclass(frozen=True, slots=True)
class _Measure:
    """Arc lengths of cubic curves. Also the share of the length at 65 equal steps of the curve parameter."""

    span: Floats
    length: Floats
    shares: Floats


@dataclass(frozen=True, slots=True)
class PlanView:
    """Geometry records (line, arc, spiral, …) of the reference lines of all roads, by road and s.

    Attributes
    ----------
    road : (n,) int64
        Row of the road.
    s, x, y, heading, length : (n,) float64
        Start and extent.
    kind : (n,) int8
        ``LINE``, ``ARC``, ``SPIRAL`` or ``CUBIC``.
    curvature, rate : (n,) float64
        Curvature at the start, and its change per metre; for lines, arcs and spirals.
    u, v : (c, 4) float64
        Polynomials of the cubics only, in their order, over their parameter, constant first.
    measure : _Measure
        Arc length of the cubics.
    """

    road: Ints
    s: Floats
    x: Floats
    y: Floats
    heading: Floats
    length: Floats
    kind: Codes
    curvature: Floats
    rate: Floats
    u: Floats
    v: Floats
    measure: _Measure


@dataclass(frozen=True, slots=True)
class Poses:
    """Positions on reference lines of roads: coordinates, heading and curvature; shape (N,)."""

    x: Floats
    y: Floats
    heading: Floats
    curvature: Floats


def read_plan_view(document: Document) -> PlanView:
    """Read the reference lines of all OpenDRIVE roads, and record defective roads."""
    table = document["road/geometry"]
    n = len(table)
    names = {"s": "s", "x": "x", "y": "y", "heading": "hdg", "length": "length"}
    columns: dict[str, Any] = {
        column: document.numbers("road/geometry", name) for column, name in names.items()
    }
    length = columns["length"]
    document.accuse("road/geometry", length < 0, "attribute 'length' is negative")
    kind = np.full(n, -1, np.int8)
    kind[document["road/geometry/line"].of] = LINE
    curvature, rate = np.zeros(n), np.zeros(n)
    arcs = document["road/geometry/arc"].of
    curvature[arcs] = document.numbers("road/geometry/arc", "curvature")
    kind[arcs] = ARC
    wild = _read_spirals(document, kind, curvature, rate, length)
    u, v, span = _read_cubics(document, kind, length)
    document.accuse("road/geometry", kind < 0, "has no line, arc, spiral, poly3 or paramPoly3")
    order = np.lexsort((columns["s"], table.road))
    for row in wild.tolist():
        name = document.road_ids[table.road[row]]
        document.warnings.append(
            f"road {name!r}: the spiral at s = {columns['s'][row]:g} m has no usable curvature;"
            " a curve to the next geometry counts"
        )
        at = int(np.flatnonzero(order == row)[0]) + 1
        after = int(order[at]) if at < n and table.road[order[at]] == table.road[row] else None
        u[row], v[row] = _curve_between(columns, row, after)
        kind[row], span[row] = CUBIC, 1.0
    cubics = order[kind[order] == CUBIC]
    u, v, span = u[cubics], v[cubics], span[cubics]
    measure = _measured(u, v, span, length[cubics])
    columns |= {"road": table.road, "kind": kind, "curvature": curvature, "rate": rate}
    columns = {name: column[order] for name, column in columns.items()}
    return PlanView(**columns, u=u, v=v, measure=measure)


def _read_spirals(
    document: Document, kind: Codes, curvature: Floats, rate: Floats, length: Floats
) -> Ints:
    """Read all spirals. Return the rows of the spirals without a usable curvature."""
    spirals = document["road/geometry/spiral"].of
    first, last = (
        document.rough_numbers("road/geometry/spiral", name, np.nan)
        for name in ("curvStart", "curvEnd")
    )
    turn = np.maximum(np.abs(first), np.abs(last)) * length[spirals]
    usable = turn <= MAX_TURN
    kind[spirals] = SPIRAL
    wild, spirals, first, last = spirals[~usable], spirals[usable], first[usable], last[usable]
    curvature[spirals] = first
    rate[spirals] = (last - first) / np.where(length[spirals] > 0, length[spirals], 1.0)
    return wild


def _curve_between(columns: dict[str, Any], row: int, after: int | None) -> tuple[Floats, Floats]:
    """Return the cubic curve from one geometry record to the next; a straight line if they do not fit."""
    length, heading = columns["length"][row], columns["heading"][row]
    start, end = np.array([1.0, 0.0]) * length, np.array([length, 0.0])
    slope = start
    if after is not None:
        dx, dy = (columns[axis][after] - columns[axis][row] for axis in "xy")
        cos, sin = np.cos(heading), np.sin(heading)
        place = np.array([cos * dx + sin * dy, cos * dy - sin * dx])
        if length / 4 <= np.hypot(dx, dy) <= length * 1.01:
            turn = columns["heading"][after] - heading
            end, slope = place, np.array([np.cos(turn), np.sin(turn)]) * length
    cubic = np.stack((0 * start, start, 3 * end - 2 * start - slope, start + slope - 2 * end))
    return cubic[:, 0], cubic[:, 1]


def _read_cubics(document: Document, kind: Codes, length: Floats) -> tuple[Floats, Floats, Floats]:
    n = len(kind)
    u, v, span = np.zeros((n, 4)), np.zeros((n, 4)), np.zeros(n)
    poly3, param = document["road/geometry/poly3"].of, document["road/geometry/paramPoly3"].of
    u[poly3, 1] = 1.0
    span[poly3] = np.nan  # computed from the arc length later
    for i, letter in enumerate("abcd"):
        v[poly3, i] = document.numbers("road/geometry/poly3", letter)
        u[param, i] = document.numbers("road/geometry/paramPoly3", f"{letter}U")
        v[param, i] = document.numbers("road/geometry/paramPoly3", f"{letter}V")
    ranges = document["road/geometry/paramPoly3"].texts("pRange", "normalized")
    by_arc = np.array([text == "arcLength" for text in ranges], bool)
    span[param] = np.where(by_arc, length[param], 1.0)
    kind[poly3] = kind[param] = CUBIC
    return u, v, span


def _measured(u: Floats, v: Floats, span: Floats, length: Floats) -> _Measure:
    """Compute the arc length of cubic curves, and its share at equal steps of the curve parameter."""
    unknown = np.isnan(span)
    reach = np.where(unknown, length, span)  # the arc length is never shorter than u
    arc = _arc_table(u, v, reach)
    rows = np.flatnonzero(unknown & (arc[:, -1] > 0))
    if len(rows):
        whole = _Measure(reach, arc[:, -1], arc / np.maximum(arc[:, -1:], _TINY))
        reach[rows] = _parameter(u, v, whole, rows, length[rows] / arc[rows, -1])
        arc[rows] = _arc_table(u[rows], v[rows], reach[rows])
    return _Measure(reach, arc[:, -1], arc / np.maximum(arc[:, -1:], _TINY))


def _arc_table(u: Floats, v: Floats, span: Floats) -> Floats:
    step = span / _CELLS
    at = (np.arange(_CELLS)[:, None] + (_FEW_NODES + 1) / 2).ravel()
    p = step[:, None] * at
    speed = np.hypot(cubic_slope(u[:, None], p), cubic_slope(v[:, None], p))
    cells = speed.reshape(len(span), _CELLS, len(_FEW_NODES)) @ _FEW_WEIGHTS * (step[:, None] / 2)
    return np.concatenate((np.zeros((len(span), 1)), np.cumsum(cells, axis=1)), axis=1)


def _parameter(u: Floats, v: Floats, measure: _Measure, rows: Ints, share: Floats) -> Floats:
    """Return the curve parameter at which a cubic curve has reached a share of its length.

    Cubic Hermite interpolation in the cell of the table.
    """
    knots = _CELLS + 1
    share = np.clip(share, 0.0, 1.0)
    keys = (measure.shares * _BELOW_ONE + np.arange(len(measure.shares))[:, None]).ravel()
    place = np.searchsorted(keys, rows + share * _BELOW_ONE, side="right") - 1
    cell = np.clip(place - rows * knots, 0, _CELLS - 1)
    low, high = measure.shares[rows, cell], measure.shares[rows, cell + 1]
    h = np.clip((share - low) / np.maximum(high - low, _TINY), 0.0, 1.0)
    step = measure.span[rows] / _CELLS
    run = (high - low) * measure.length[rows]
    # dp/dh at both ends of the cell; ignored where the curve almost stops.
    before, after = (
        np.minimum(
            run / np.maximum(np.hypot(cubic_slope(u[rows], p), cubic_slope(v[rows], p)), _TINY),
            3 * step,
        )
        for p in (cell * step, (cell + 1) * step)
    )
    smooth = h * h * (3 - 2 * h) * step
    return cell * step + smooth + h * (1 - h) ** 2 * before - h * h * (1 - h) * after


def poses(plan: PlanView, record: Ints, s: Floats) -> Poses:
    """Return position, heading and curvature of points on road reference lines.

    Parameters
    ----------
    plan : PlanView
    record : (N,) int64
        Row of the record of each place.
    s : (N,) float64
        Along the road; m. Places before the record's start are moved to it.
    """
    ds = np.maximum(s - plan.s[record], 0.0)
    heading0, k0 = plan.heading[record], plan.curvature[record]
    curvature = k0 + plan.rate[record] * ds
    turned = ds * (k0 + curvature) / 2
    kind = plan.kind[record]
    # Chord of an arc: along the mean heading, shorter by sin(x) / x. A line is an arc without
    # curvature.
    chord = ds * np.sinc(turned / (2 * np.pi))
    along, across = chord * np.cos(turned / 2), chord * np.sin(turned / 2)
    rows = np.flatnonzero(kind == SPIRAL)
    along[rows], across[rows] = _spiral(ds[rows], k0[rows], plan.rate[record[rows]])
    rows = np.flatnonzero(kind == CUBIC)
    if len(rows):
        along[rows], across[rows], turned[rows], curvature[rows] = _cubic(
            plan, record[rows], ds[rows]
        )
    cos, sin = np.cos(heading0), np.sin(heading0)
    return Poses(
        plan.x[record] + cos * along - sin * across,
        plan.y[record] + sin * along + cos * across,
        heading0 + turned,
        curvature,
    )


def _spiral(ds: Floats, curvature: Floats, rate: Floats) -> tuple[Floats, Floats]:
    """Return how far a spiral (clothoid) goes along and across its start direction after a length ``ds``."""
    at = ds[:, None] * ((_NODES + 1) / 2)
    angle = at * (curvature[:, None] + rate[:, None] * at / 2)
    half = ds / 2
    return (np.cos(angle) @ _WEIGHTS) * half, (np.sin(angle) @ _WEIGHTS) * half


def _cubic(plan: PlanView, record: Ints, ds: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return displacement, turn and curvature of parametric cubic curves after a length ``ds``."""
    number = np.cumsum(plan.kind == CUBIC) - 1
    length = plan.length[record]
    share = np.where(length > 0, ds / np.maximum(length, _TINY), 0.0)
    rows = number[record]
    u, v = plan.u[rows], plan.v[rows]
    p = _parameter(plan.u, plan.v, plan.measure, rows, share)
    du, dv = cubic_slope(u, p), cubic_slope(v, p)
    speed = np.maximum(np.hypot(du, dv), _TINY)
    curvature = (du * cubic_bend(v, p) - dv * cubic_bend(u, p)) / speed**3
    return cubic(u, p), cubic(v, p), np.arctan2(dv, du), curvature
