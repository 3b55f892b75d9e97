"""Compiled loops (numba) for near object pairs, edges of pairs, and objects visible to the ego.

``_pairs``, ``_proximity``, ``_bearing`` and ``_sight`` have the same in numpy, with explanations.
Arrays come in tuples: positions ``x, y, z``, turns ``cos, sin`` of headings, sizes ``length, width,
height``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sgstore.base.numba_loops import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Codes, Floats, Ints

    Nodes = NDArray[np.int32]
    Columns = tuple[Nodes, Codes, Nodes, Nodes]
    Places = tuple[Floats, Floats, Floats]
    Turns = tuple[Floats, Floats]
    Looped = tuple[Ints, Ints, tuple[Nodes, Nodes], Places, Turns]
    Seen = tuple[Places, Turns, Places, Bools]


@compiled
def near_pairs(
    first: int,
    order: Ints,
    end: Ints,
    place: tuple[Floats, Floats, Floats],
    limit: float,
    found: tuple[Ints, Ints],
) -> tuple[int, int]:
    """Write pairs of near objects into an array. Return their number, and the position for the next call.

    ``order`` has the rows by frame and ``x``, ``end`` has the end of its frame for each place.
    Returns the number of pairs, and the place where the room may have run out.
    """
    x, y, z = place
    a, b = found
    count = 0
    while first < len(order) and count + end[first] - first <= len(a):
        one = order[first]
        for other in order[first + 1 : end[first]]:
            dx, dy, dz = x[other] - x[one], y[other] - y[one], z[other] - z[one]
            if dx * dx > limit:
                break
            if math.isnan(dz):
                dz = 0.0
            if dx * dx + dy * dy + dz * dz <= limit:
                a[count] = one
                b[count] = other
                count += 1
        first += 1
    return count, first


@compiled
def rungs(
    pairs: Looped,
    wanted: Bools,
    bounds: Floats,
    codes: Codes,
    columns: Columns,
) -> int:
    """Write the proximity edges of object pairs in both directions into arrays. Return their number.

    ``wanted``: mask of pairs; empty means all pairs.
    """
    a, b, (frame, node), (x, y, z), _ = pairs
    of, relation, src, dst = columns
    at = 0
    for i in range(len(a)):
        if len(wanted) and not wanted[i]:
            continue
        one, other = a[i], b[i]
        dx, dy, dz = x[other] - x[one], y[other] - y[one], z[other] - z[one]
        if math.isnan(dz):
            dz = 0.0
        span = dx * dx + dy * dy + dz * dz
        if span <= bounds[-1]:
            rung = 0
            while span > bounds[rung]:
                rung += 1
            relation[at] = relation[at + 1] = codes[rung]
            of[at] = of[at + 1] = frame[one]
            src[at] = dst[at + 1] = node[one]
            dst[at] = src[at + 1] = node[other]
            at += 2
    return at


@compiled
def sectors(
    pairs: Looped,
    bounds: tuple[Floats, Floats],
    codes: Codes,
    doubt: float,
    columns: Columns,
    doubtful: Ints,
) -> tuple[int, int]:
    """Write the direction edges of object pairs. Return two counts: edges, and pairs that need an exact angle.

    ``bounds`` are sines and cosines. Pairs from ``len(a)`` on are mirror images.
    """
    a, b, (frame, node), (x, y, _), (cos, sin) = pairs
    of, relation, src, dst = columns
    bound_sin, bound_cos = bounds
    at, unsure = 0, 0
    for i in range(len(a)):
        one, other = a[i], b[i]
        for mirrored in range(2):
            dx, dy = x[other] - x[one], y[other] - y[one]
            reach = (abs(dx) + abs(dy)) * doubt + 1e-30
            ahead = dx * cos[one] + dy * sin[one]
            aside = abs(dy * cos[one] - dx * sin[one])
            sector, sure = 0, abs(ahead) + aside > reach
            for k in range(len(bound_sin)):
                short_of = bound_sin[k] * ahead - bound_cos[k] * aside
                sure = sure and abs(short_of) > reach
                if short_of < 0:
                    sector += 1
            if sure:
                of[at], relation[at] = frame[one], codes[sector]
                src[at], dst[at] = node[other], node[one]
                at += 1
            else:
                doubtful[unsure] = i + len(a) * mirrored
                unsure += 1
            one, other = other, one
    return at, unsure


@compiled
def sides(
    pairs: Looped,
    least: float,
    codes: Codes,
    doubt: float,
    columns: Columns,
    doubtful: Ints,
) -> tuple[int, int]:
    """Write the left and right edges of object pairs into arrays. Return their number."""
    a, b, (frame, node), (x, y, _), (cos, sin) = pairs
    of, relation, src, dst = columns
    at, unsure = 0, 0
    for i in range(len(a)):
        one, other = a[i], b[i]
        for mirrored in range(2):
            dx, dy = x[other] - x[one], y[other] - y[one]
            reach = (abs(dx) + abs(dy)) * doubt + 1e-30
            left = dy * cos[one] - dx * sin[one]
            aside = abs(left)
            if not (aside if least < 0 else abs(aside - least)) > reach:
                doubtful[unsure] = i + len(a) * mirrored
                unsure += 1
            elif aside > least:
                of[at], relation[at] = frame[one], codes[0 if left >= 0 else 1]
                src[at], dst[at] = node[other], node[one]
                at += 1
            one, other = other, one
    return at, unsure


@compiled
def along(
    lane: Ints,
    x: Floats,
    y: Floats,
    first: Ints,
    pieces: Ints,
    line: tuple[Floats, Floats, Floats, Floats, Floats, Floats],
) -> Floats:
    """Return the length along a lane's centre line to the point nearest to each given position; m."""
    at_x, at_y, run_x, run_y, squared, length = line
    found = np.empty(len(lane))
    for i in range(len(lane)):
        least, best, best_onward = np.inf, first[lane[i]], 0.0
        last = best + pieces[lane[i]] - 1
        for piece in range(best, last + 1):
            away_x, away_y = x[i] - at_x[piece], y[i] - at_y[piece]
            onward = (away_x * run_x[piece] + away_y * run_y[piece]) / squared[piece]
            share = min(max(onward, 0.0), 1.0)
            away = (away_x - share * run_x[piece]) ** 2 + (away_y - share * run_y[piece]) ** 2
            if away < least:
                least, best, best_onward = away, piece, onward
        out = (best == first[lane[i]] and best_onward < 0) or (best == last and best_onward > 1)
        share = best_onward if out else min(max(best_onward, 0.0), 1.0)
        found[i] = length[best] + share * (length[best + 1] - length[best])
    return found


@compiled
def sight(
    order: Ints,
    starts: Ints,
    ego: Ints,
    bodies: Seen,
    graze: float,
) -> Bools:
    """Return a mask of the objects that the ego of their frame can see."""
    seen = np.zeros(len(bodies[0][0]), np.bool_)
    for f in range(len(starts) - 1):
        rows = order[starts[f] : starts[f + 1]]
        if ego[f] >= 0 and len(rows):
            _seen_from(ego[f], rows, bodies, graze, seen)
    return seen


@compiled
def _seen_from(
    eye: int,
    rows: Ints,
    bodies: Seen,
    graze: float,
    seen: Bools,
) -> None:
    row, x, y, box, hides = _views(eye, rows, bodies, graze)
    away = np.sqrt(x[:, 0] ** 2 + y[:, 0] ** 2)
    radius = box[:, 7]
    near = away - radius
    by_place = np.argsort(near)
    free = np.empty(5, np.bool_)
    for target in range(len(row)):
        free[:] = True
        left, far = 5, (away[target] + radius[target]) * (1 + 1e-9) + 1e-9
        for cover in by_place:
            if near[cover] > far:
                break
            # A body outside both radii of the line to the target hides none of its points.
            reach = (radius[cover] + radius[target]) * away[target] * (1 + 1e-9) + 1e-9
            across = abs(x[cover, 0] * y[target, 0] - y[cover, 0] * x[target, 0])
            if cover == target or not hides[cover] or across > reach:
                continue
            for point in range(5):
                if free[point] and _blocked(
                    x[cover, 0],
                    y[cover, 0],
                    box[cover],
                    x[target, point],
                    y[target, point],
                    box[target, 4],
                ):
                    free[point] = False
                    left -= 1
            if not left:
                break
        seen[row[target]] = left > 0


@compiled
def _views(
    eye: int,
    rows: Ints,
    bodies: Seen,
    graze: float,
) -> tuple[Ints, Floats, Floats, Floats, Bools]:
    """Return objects as seen from the ego's eye: rows, points, boxes, and a mask of opaque objects.

    A box is ``cos, sin``, half of length and width, height of points, lower and upper side, and a
    radius.
    """
    place, turn, (length, width, height), signal = bodies
    row = np.empty(len(rows), np.int64)
    x, y = np.empty((len(rows), 5)), np.empty((len(rows), 5))
    box, hides = np.empty((len(rows), 8)), np.empty(len(rows), np.bool_)
    eye_height = 0.0 if math.isnan(height[eye]) else height[eye] / 2
    count = 0
    for body in rows:
        dx, dy = place[0][body] - place[0][eye], place[1][body] - place[1][eye]
        if body == eye or not (math.isfinite(place[0][body]) and math.isfinite(place[1][body])):
            continue
        cos, sin = turn[0][body], turn[1][body]
        half_length, half_width = length[body] / 2, width[body] / 2
        x[count], y[count] = dx, dy
        known = True
        for corner in range(4):
            ahead = half_length if corner in {0, 3} else -half_length
            left = half_width if corner < 2 else -half_width
            x[count, 1 + corner] = dx + ahead * cos - left * sin
            y[count, 1 + corner] = dy + ahead * sin + left * cos
            known = known and not math.isnan(x[count, 1 + corner] + y[count, 1 + corner])
        if not known:
            x[count], y[count] = dx, dy
        inside = abs(dx * cos + dy * sin) <= half_length and abs(dy * cos - dx * sin) <= half_width
        hides[count] = known and height[body] > 0 and not inside and not signal[body]
        level = place[2][body] - place[2][eye] - eye_height
        box[count, 0], box[count, 1] = cos, sin
        box[count, 2], box[count, 3] = half_length - graze, half_width - graze
        box[count, 4] = level
        box[count, 5], box[count, 6] = level - height[body] / 2, level + height[body] / 2
        box[count, 7] = math.sqrt(half_length**2 + half_width**2) if known else 0.0
        row[count] = body
        count += 1
    return row[:count], x[:count], y[:count], box[:count], hides[:count]


@compiled
def _blocked(x: float, y: float, box: Floats, to_x: float, to_y: float, height: float) -> bool:
    """Return True if a box blocks the line of sight to a point."""
    cos, sin = box[0], box[1]
    enters, leaves = 0.0, 1.0
    start_x, run_x = -x * cos - y * sin, to_x * cos + to_y * sin
    start_y, run_y = x * sin - y * cos, to_y * cos - to_x * sin
    for start, run, half in ((start_x, run_x, box[2]), (start_y, run_y, box[3])):
        one, other = (-half - start) / run, (half - start) / run
        if math.isnan(one) or math.isnan(other):
            return False
        enters, leaves = max(min(one, other), enters), min(max(one, other), leaves)
    if not enters < leaves:
        return False
    low, high = enters * height, leaves * height
    if high < low:
        low, high = high, low
    return not (low >= box[6] or high <= box[5])  # False if a height is missing
