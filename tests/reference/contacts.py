"""When two boxes that keep their velocity first touch, by looking a thousand times a second, with shapely.

Moments at which two boxes are certainly apart are passed over: in a millisecond their distance shrinks by
no more than their velocities differ by. What is found is what looking at every one of them would find.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.model.world import Floats

COLUMNS = ("x", "y", "z", "heading", "length", "width", "vx", "vy")
STEP = 1e-3


def distances(a: Floats, b: Floats, after: Floats) -> Floats:
    """How far apart the boxes of each pair are some time later; m. a, b: (K, 8), see :data:`COLUMNS`."""
    return shapely.distance(*(_polygons(box, after) for box in (a, b)))


def _polygons(boxes: Floats, after: Floats) -> NDArray[np.object_]:
    centre = boxes[:, 0] + 1j * boxes[:, 1] + (boxes[:, 6] + 1j * boxes[:, 7]) * after
    around = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) / 2
    corners = around[:, 0] * boxes[:, 4:5] + 1j * around[:, 1] * boxes[:, 5:6]
    corners = centre[:, None] + corners * np.exp(1j * boxes[:, 3:4])
    return shapely.polygons(np.stack([corners.real, corners.imag], axis=-1))


def sampled_contact(a: Floats, b: Floats, horizon: float) -> Floats:
    """Time of the first sample in which the boxes of each pair touch; s. NaN: in none up to the horizon."""
    found = np.full(len(a), np.nan)
    sample = np.zeros(len(a), np.int64)
    shrinks = np.hypot(*(b - a)[:, 6:].T) * STEP
    left = np.arange(len(a))
    while len(left):
        apart = distances(a[left], b[left], sample[left] * STEP)
        touch = apart <= 0
        found[left[touch]] = sample[left[touch]] * STEP
        left, apart = left[~touch], apart[~touch]
        passed = apart / np.maximum(shrinks[left], 1e-12)
        sample[left] += np.maximum(np.floor(np.minimum(passed, 1e9)), 1).astype(np.int64)
        left = left[sample[left] * STEP <= horizon]
    return found


def disagreements(a: Floats, b: Floats, told: Floats, horizon: float) -> list[str]:
    """What is wrong with the times that were told for pairs of boxes: nothing, it is hoped."""
    known = ~np.isnan(np.delete(a + b, 2, axis=1)).any(axis=1)  # all but z
    if not np.isnan(told[~known]).all():
        return ["a time is told of boxes that are not known"]
    a, b, told = a[known], b[known], told[known]
    seen = sampled_contact(a, b, horizon)
    within = ~np.isnan(told) & (told <= horizon)
    touch = np.zeros(len(a))
    touch[within] = distances(a[within], b[within], told[within])
    wrong = {
        "a contact that is none": within & (touch > 1e-6),
        "an earlier contact": within & (seen < told - 1e-9),
        # One that is over within the millisecond falls between two samples.
        "a later contact": within & (seen > told + STEP + 1e-9) & _lasting(a, b, told),
        "no contact where there is one": ~within & ~np.isnan(seen),
    }
    return [
        f"{what}: pair {i}, told {told[i]}, seen {seen[i]}"
        for what, where in wrong.items()
        for i in np.nonzero(where)[0][:3]
    ]


def _lasting(a: Floats, b: Floats, told: Floats) -> NDArray[np.bool_]:
    """Whether the boxes of each pair still touch at the first sample after the time that was told."""
    after = np.ceil(np.nan_to_num(told) / STEP) * STEP
    return distances(a, b, after) <= 0


def random_movers(count: int, seed: int) -> tuple[Floats, Floats]:
    """Pairs of boxes that move: apart or not, parallel or not, on a course to meet, without extent."""
    rng = np.random.default_rng(seed)
    low, high = (-40, -40, -5, -4, 0.2, 0.2, -20, -20), (40, 40, 5, 4, 15, 3, 20, 20)
    a, b = rng.uniform(low, high, (2, count, 8))
    kind = np.arange(count) % 10
    b[kind < 3, 3] = a[kind < 3, 3] + rng.integers(-2, 3, (kind < 3).sum()) * np.pi / 2
    b[kind == 1, 6:] = 0  # what stands
    b[kind == 2, 6:] = a[kind == 2, 6:]  # keeps its place
    b[kind == 3, :2] = a[kind == 3, :2] + rng.uniform(-2, 2, ((kind == 3).sum(), 2))
    b[kind == 4, 4:6] = 0  # a point
    a[kind == 5, 5] = 0  # a line
    meet = (kind >= 6) & (kind < 9)
    away, time = rng.uniform(-4, 4, (meet.sum(), 2)), rng.uniform(0.1, 6, (meet.sum(), 1))
    b[meet, 6:] = a[meet, 6:] + (a[meet, :2] + away - b[meet, :2]) / time
    turned = kind == 9  # driving as they are turned, as traffic does
    for boxes in (a, b):
        speed = rng.uniform(0, 20, turned.sum())
        boxes[turned, 6] = speed * np.cos(boxes[turned, 3])
        boxes[turned, 7] = speed * np.sin(boxes[turned, 3])
    return a, b
