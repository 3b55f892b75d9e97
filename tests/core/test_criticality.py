"""Measures of criticality: against simulations of boxes and of drivers, and definitions in complex numbers."""

from __future__ import annotations

import cmath
import math
import os
import re
import subprocess
import sys
from functools import cache
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import shapely
from contacts import distances, random_movers
from test_pair_numbers import Box, moving
from thorough import LONG

from sgstore.base.geometry import corners
from sgstore.lang.memory import FrameView
from sgstore.model.pair_numbers import COLUMNS, PAIR_FUNCTIONS, PairNumbers, columns_needed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.model.world import Floats
    from sgstore.query import Store

pytestmark = pytest.mark.seconds(12)

MEASURES = {name: one for name, one in PAIR_FUNCTIONS.items() if one.view == "criticality"}
PAGE = Path(__file__).parents[2] / "docs" / "criticality.md"
MS = 1e-3


def random_meetings(count: int, seed: int) -> tuple[Floats, Floats]:
    """Pairs of boxes that move and accelerate; of half of them b is in a's way, or nearly."""
    rng = np.random.default_rng(seed)
    a, b = random_movers(count, seed)
    a, b = (np.hstack([boxes, rng.uniform(-8, 4, (count, 2))]) for boxes in (a, b))
    ahead = np.arange(count) % 2 == 0
    turn = np.exp(1j * a[ahead, 3])
    place = a[ahead, 0] + 1j * a[ahead, 1]
    place += (rng.uniform(0, 60, ahead.sum()) + 1j * rng.uniform(-3, 3, ahead.sum())) * turn
    b[ahead, 0], b[ahead, 1] = place.real, place.imag
    for boxes in (a, b):
        speed = turn * (rng.uniform(-3, 25, ahead.sum()) + 1j * rng.normal(0, 0.3, ahead.sum()))
        boxes[ahead, 6], boxes[ahead, 7] = speed.real, speed.imag
    b[ahead, 3] = a[ahead, 3] + rng.normal(0, 0.2, ahead.sum())
    return a, b


# Closest encounter --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20 if LONG else 1))
def test_the_closest_encounter_is_that_of_sampled_boxes(seed: int) -> None:
    horizon, coarse = 12.0, 0.05
    a, b = random_movers(400, seed + 100)
    numbers = PairNumbers(a, b)
    dce, ttce = numbers["dce"], numbers["ttce"]
    assert not np.isnan(dce + ttce).any()

    times = np.arange(0, horizon, coarse)
    sampled = np.stack([distances(a, b, np.full(len(a), time)) for time in times])
    around = np.clip(times[sampled.argmin(axis=0)], coarse, None)
    for offset in np.arange(-coarse, coarse, MS):  # a thousand times a second where it is nearest
        fine = distances(a, b, around + offset)
        sampled = np.vstack([sampled, fine])
    least = sampled.min(axis=0)
    speed = np.hypot(*(b - a)[:, 6:].T)
    soon = ttce < horizon - coarse

    assert (dce <= least + 1e-9).all()
    assert (least <= dce + speed * MS + 1e-9)[soon].all()
    assert np.abs(distances(a, b, np.minimum(ttce, 1e4)) - dce)[ttce < 1e4].max() < 1e-6
    early = sampled[: len(times)][times <= 3 + 1e-9].min(axis=0)
    fine = [distances(a, b, np.minimum(around + k * MS, 3)) for k in range(-50, 50, 5)]
    early = np.minimum(early, np.min(fine, axis=0))
    assert (numbers["dce_3s"] <= early + 1e-9).all()
    assert (early <= numbers["dce_3s"] + speed * coarse + 1e-9).all()
    assert (numbers["dce_3s"] >= dce - 1e-9).all()
    assert np.abs(numbers["dce_3s"] - distances(a, b, np.minimum(ttce, 3))).max() < 1e-6
    before = (times[:, None] < ttce - coarse) & (sampled[: len(times)] <= dce)
    assert not before.any()
    assert np.array_equal(dce == 0, ~np.isnan(numbers["ttc"]) | (numbers["gap"] == 0))
    assert (dce <= numbers["gap"] + 1e-9).all()
    assert min((dce == 0).mean(), (ttce == 0).mean(), ((dce > 0) & (ttce > 0)).mean()) > 0.05


@pytest.mark.parametrize(
    ("other", "dce", "ttce"),
    [
        pytest.param(moving(24, 5), 3, 2, id="stands beside the path: abreast first after 20 m"),
        pytest.param(moving(-24, 5), math.hypot(20, 3), 0, id="stands behind"),
        pytest.param(moving(24, 0), 0, 2, id="stands ahead"),
        pytest.param(moving(24, 5, vx=10), math.hypot(20, 3), 0, id="keeps its place"),
        pytest.param(moving(1, 1, vx=12), 0, 0, id="overlaps and leaves"),
        pytest.param(moving(2, 5, vx=3), 3, 0, id="is abreast, and will be for a while"),
    ],
)
def test_closest_encounters(other: Floats, dce: float, ttce: float) -> None:
    numbers = PairNumbers(moving(0, 0, vx=10), other)

    assert (numbers["dce"][0], numbers["ttce"][0]) == pytest.approx((dce, ttce))


# Worst case ---------------------------------------------------------------------------------------


def test_the_worst_case_is_when_growing_discs_first_touch() -> None:
    a, b = random_movers(1500, 21)
    found = PairNumbers(a, b)["wttc"]
    times = np.linspace(0, 6, 6001)[:, None]
    radii = sum(np.hypot(box[:, 4], box[:, 5]) / 2 for box in (a, b))
    rel = b - a
    apart = np.hypot(rel[:, 0] + rel[:, 6] * times, rel[:, 1] + rel[:, 7] * times)

    slack = apart - radii - 2 * 11.5 * times**2 / 2
    first = np.where(slack <= 0, times, np.inf).min(axis=0)

    assert np.isfinite(first).all()
    assert (found <= first + 1e-9).all()
    assert (first - found < MS + 1e-9)[slack.min(axis=0) < -0.01].all()
    assert np.array_equal(found == 0, slack[0] <= 0)


def test_no_drive_of_bounded_acceleration_meets_before_the_worst_case() -> None:
    rng = np.random.default_rng(22)
    a, b = random_movers(800, 23)
    worst, step = PairNumbers(a, b)["wttc"], 0.02
    moved = [box.copy() for box in (a, b)]
    met = np.full(len(a), np.inf)
    for tick in range(150):
        apart = distances(moved[0], moved[1], np.zeros(len(a)))
        met = np.where((apart <= 0) & np.isinf(met), tick * step, met)
        towards = (moved[1] - moved[0])[:, 0] + 1j * (moved[1] - moved[0])[:, 1]
        for box, way in zip(moved, (towards, -towards), strict=True):
            push = 11.5 * np.exp(1j * (np.angle(way) + rng.normal(0, 0.3, len(way))))
            box[:, 0] += box[:, 6] * step + push.real * step**2 / 2
            box[:, 1] += box[:, 7] * step + push.imag * step**2 / 2
            box[:, 6] += push.real * step
            box[:, 7] += push.imag * step
            box[:, 3] += rng.uniform(-0.2, 0.2, len(way))

    assert np.isfinite(met).mean() > 0.5
    assert (worst <= met + 1e-9).all()


# Mild case ----------------------------------------------------------------------------------------


def grown(boxes: Floats, times: Floats) -> Floats:
    """Boxes whose sides have moved outward by as much as 2 m/s² moves somebody."""
    found = boxes.copy()
    found[:, 4:6] += 2 * times[:, None] ** 2
    return found


@pytest.mark.parametrize("seed", range(20 if LONG else 1))
def test_the_mild_case_is_when_growing_boxes_first_touch(seed: int) -> None:
    for pairs in (random_movers(400, seed + 41), random_meetings(400, seed + 42)):
        a, b = (boxes[:, :8] for boxes in pairs)
        numbers = PairNumbers(a, b)
        found = numbers["ttc_mild"]
        assert np.isfinite(found).all()

        assert distances(grown(a, found), grown(b, found), found).max() < 1e-6
        for share in np.linspace(0, 1, 200, endpoint=False):
            when = share * found
            apart = distances(grown(a, when), grown(b, when), when)
            assert (apart[found > 0] > 0).all()
        assert np.array_equal(found == 0, numbers["gap"] == 0)
        soon = ~np.isnan(numbers["ttc"])
        assert (found[soon] <= numbers["ttc"][soon] + 1e-9).all()
        assert (found > 0).mean() > 0.5


def test_no_mild_drive_meets_before_the_mild_case_and_some_do_then() -> None:
    a, b = random_movers(200, 44)
    mild = PairNumbers(a, b)["ttc_mild"]
    met = np.full(len(a), np.inf)
    ways = [complex(lon, lat) for lon in (-2, 0, 2) for lat in (-2, 0, 2)]
    for pushes in product(ways, repeat=2):
        for share in (0.999, 1.001):
            moved = [box.copy() for box in (a, b)]
            for box, push in zip(moved, pushes, strict=True):
                off = push * np.exp(1j * box[:, 3]) * (share * mild) ** 2 / 2
                box[:, :2] += np.stack([off.real, off.imag], axis=1)
            hit = distances(*moved, share * mild) <= 0
            met = np.where(hit, np.minimum(met, share), met)

    assert (met[mild > 0] > 1).all()
    assert (met[mild > 0] < np.inf).mean() > 0.4


# One behind the other -----------------------------------------------------------------------------


class Mover(Box):
    """A box that accelerates."""

    def __init__(self, row: Floats) -> None:
        super().__init__(row[:8])
        self.push = complex(*row[8:])

    def along(self, value: complex) -> float:
        return (value * cmath.exp(-1j * self.heading)).real

    def across(self, value: complex) -> float:
        return (value * cmath.exp(-1j * self.heading)).imag


def shadow(box: Box, axis: float) -> tuple[float, float]:
    """From where to where the footprint reaches in a direction."""
    around = [
        box.place + cmath.exp(1j * box.heading) * complex(u * box.length / 2, v * box.width / 2)
        for u in (1, -1)
        for v in (1, -1)
    ]
    reached = [(corner * cmath.exp(-1j * axis)).real for corner in around]
    return min(reached), max(reached)


def way(a: Box, b: Box) -> float | None:
    """From a's front to b's rear, where b is in the strip ahead of a."""
    (low, high), (first, last) = (shadow(box, a.heading + math.pi / 2) for box in (a, b))
    if a.seen(b).real <= 0 or last <= low or high <= first:
        return None
    return max(shadow(b, a.heading)[0] - shadow(a, a.heading)[1], 0)


def first_root(*coefficients: float) -> float | None:
    """The least root of a polynomial that is not negative."""
    found = np.roots(coefficients)
    real = [root.real for root in found if abs(root.imag) < 1e-9 and root.real >= 0]
    return min(real, default=None)


def ttc_accel(a: Mover, b: Mover) -> float | None:
    d = way(a, b)
    if d is None or d == 0:
        return d
    return first_root(
        (a.along(b.push) - a.along(a.push)) / 2, a.along(b.velocity) - a.along(a.velocity), d
    )


def pttc(a: Mover, b: Mover) -> float | None:
    d, v1, v2, a2 = way(a, b), a.along(a.velocity), a.along(b.velocity), a.along(b.push)
    if d is None or v2 * a2 >= 0:
        return None
    if d == 0:
        return 0
    met, stands = first_root(a2 / 2, v2 - v1, d), -v2 / a2
    if met is not None and met <= stands:
        return met
    return (d + v2 * stands / 2) / v1 if v1 > 0 else None


def approach(a: Mover, b: Mover) -> tuple[float | None, float]:
    return way(a, b), a.along(a.velocity) - a.along(b.velocity)


def drac(a: Mover, b: Mover, after: float = 0) -> float | None:
    d, speed = approach(a, b)
    if d is None or d <= 1e-4 or speed <= 0:
        return None if d is None or d <= 1e-4 else 0
    room = d - after * a.along(b.velocity)
    return speed**2 / (2 * room) if room > 0 else None


def a_long_req(a: Mover, b: Mover) -> float | None:
    d, speed = approach(a, b)
    if d is None or d <= 1e-4:
        return None
    if speed <= 0:
        return 0
    v1, v2, a2 = a.along(a.velocity), a.along(b.velocity), a.along(b.push)
    needed = a2 - speed**2 / (2 * d)
    stops = a2 * v2 < 0 or (v2 == 0 and a2 < 0)
    if v1 > 0 and stops and 2 * d / speed > v2 / -a2:
        needed = -(v1**2) / (2 * (d - v2**2 / (2 * a2)))
    return min(needed, 0)


def sideways(a: Mover, b: Mover, after: float, push: complex = 0) -> float:
    """How far they overlap across a's axis some time later; below 0: how far they are apart."""
    b = Mover(b_row(b, b.place + (b.velocity - a.velocity) * after + push * after**2 / 2))
    (low, high), (first, last) = (shadow(box, a.heading + math.pi / 2) for box in (a, b))
    return min(high - first, last - low)


def b_row(b: Mover, place: complex) -> Floats:
    size = (b.heading, b.length, b.width)
    velocity, push = ((v.real, v.imag) for v in (b.velocity, b.push))
    return np.array([place.real, place.imag, 0, *size, *velocity, *push])


def a_lat_req(a: Mover, b: Mover) -> float | None:
    time, d = ttc_accel(a, b), way(a, b)
    if d is None or time is None:
        return d if d is None else 0
    if time == 0:
        return None if sideways(a, b, 0) > 0 else 0
    return 2 * max(sideways(a, b, time, b.push), 0) / time**2


def ttb(a: Mover, b: Mover) -> float | None:
    d, speed = approach(a, b)
    return None if d is None or speed <= 0 else d / speed - speed / (2 * 8)


def tts(a: Mover, b: Mover) -> float | None:
    d, speed = approach(a, b)
    if d is None or speed <= 0:
        return None
    short = sideways(a, b, d / speed)
    return d / speed - math.sqrt(2 * short / 8) if short > 0 else None


def ratio(measure: Callable[[Mover, Mover], float | None], by: float):
    def asked(a: Mover, b: Mover) -> float | None:
        value = measure(a, b)
        return None if value is None else abs(value) / by

    return asked


def crossing(a: Mover, b: Mover) -> tuple[float, float] | None:
    """When both centres are where their paths cross."""
    va, vb, between = a.velocity, b.velocity, b.place - a.place
    if abs(va) * abs(vb) == 0:
        return None
    angle = abs(cmath.phase(vb / va))
    if min(angle, math.pi - angle) < math.radians(1):
        return None
    matrix = np.array([[va.real, -vb.real], [va.imag, -vb.imag]])
    first, second = np.linalg.solve(matrix, [between.real, between.imag])
    return first, second


def stay(one: Mover, other: Mover) -> tuple[float, float] | None:
    """From when to when a footprint is on the strip that the other one sweeps."""
    if crossing(one, other) is None:
        return None
    axis = cmath.phase(other.velocity) + math.pi / 2
    (low, high), (first, last) = shadow(one, axis), shadow(other, axis)
    speed = (one.velocity * cmath.exp(-1j * axis)).real
    return tuple(sorted(((first - high) / speed, (last - low) / speed)))  # type: ignore[return-value]


def pret(a: Mover, b: Mover) -> float | None:
    stays = stay(a, b), stay(b, a)
    if stays[0] is None or stays[1] is None:
        return None
    (_, left), (entered, until) = sorted((stays[0], stays[1]), key=sum)
    if entered > left:
        return entered - left if entered >= 0 else None
    return 0 if min(left, until) >= 0 else None


def spret(a: Mover, b: Mover) -> float | None:
    times = crossing(a, b)
    return None if times is None or min(times) < 0 else abs(times[0] ** 2 - times[1] ** 2)


def et(a: Mover, b: Mover) -> float | None:
    on = stay(a, b)
    return None if on is None or on[1] < 0 else on[1] - on[0]


def ttk(a: Mover, b: Mover) -> float | None:
    (low, high), (first, last) = (shadow(box, a.heading + math.pi / 2) for box in (a, b))
    if a.seen(b).real < 0 and last > low and high > first:
        gap = max(shadow(a, a.heading)[0] - shadow(b, a.heading)[1], 0)
        speed = a.along(b.velocity) - a.along(a.velocity)
        return gap / speed - speed / (2 * 8) if speed > 0 else None
    own, other = stay(a, b), stay(b, a)
    if own is None or other is None or own[0] > other[1] or other[0] > own[1]:
        return None
    if own[1] < 0 or other[0] <= 0:
        return None
    short = (own[1] - other[0]) * abs(a.velocity)
    return other[0] - math.sqrt(2 * short / 8)


def psd(a: Mover, b: Mover) -> float | None:
    on, speed = stay(a, b), abs(a.velocity)
    if on is None or on[1] < 0 or speed <= 0.1:
        return None
    return max(on[0], 0) * speed / (speed**2 / (2 * 11.5))


def ci(a: Mover, b: Mover) -> float | None:
    after, mass = pret(a, b), 1500
    if after is None:
        return None
    joint = (a.velocity + b.velocity) / 2
    lost = sum(mass * abs(v) ** 2 / 2 for v in (a.velocity, b.velocity)) - mass * abs(joint) ** 2
    return lost * math.exp(-after) if after <= 5 else 0


def stopping(speed: float, brake: float) -> float:
    return speed**2 / (2 * brake)


def rss_lon(a: Mover, b: Mover) -> float:
    ahead = 1 if a.seen(b).real > 0 else -1
    to_b, to_a = ahead * a.along(a.velocity), -ahead * a.along(b.velocity)
    if to_a > 0 and (to_b > 0 or (ahead > 0 and to_b == 0)):
        stops = stopping(to_b + 3.5, 3) + stopping(to_a + 3.5, 4)
        return to_b + to_a + 2 * 3.5 / 2 + stops
    if to_b < 0 and to_a < 0:
        rear, front = 0.0, min(-to_b, -to_a)
    else:
        rear, front = max(to_b, to_a), -min(to_b, to_a)
    return max(rear + 3.5 / 2 + stopping(rear + 3.5, 4) - stopping(front, 8), 0)


def rss_lat(a: Mover, b: Mover) -> float:
    left = 1 if a.seen(b).imag >= 0 else -1
    found = 0.0
    for speed in (left * a.across(a.velocity), -left * a.across(b.velocity)):
        after = speed + 0.2
        found += (speed + after) / 2 + math.copysign(stopping(after, 0.8), after)
    return 0.1 + max(found, 0)


def rss_margin(a: Mover, b: Mover) -> float:
    gaps: list[float] = []
    for axis in (a.heading, a.heading + math.pi / 2):
        (low, high), (first, last) = shadow(a, axis), shadow(b, axis)
        gaps.append(max(first - high, low - last, 0))
    return max(gaps[0] - rss_lon(a, b), gaps[1] - rss_lat(a, b))


DEFINITIONS: dict[str, Callable[[Mover, Mover], float | None]] = {
    "ttc_accel": ttc_accel,
    "pttc": pttc,
    "ttb": ttb,
    "tts": tts,
    "ttr": lambda a, b: None if tts(a, b) is None else max(ttb(a, b) or 0, tts(a, b) or 0),
    "drac": drac,
    "decel_to_safety_time": lambda a, b: drac(a, b, after=2),
    "a_long_req": a_long_req,
    "a_lat_req": a_lat_req,
    "a_req": lambda a, b: (
        None
        if a_long_req(a, b) is None or a_lat_req(a, b) is None
        else abs(complex(a_long_req(a, b) or 0, a_lat_req(a, b) or 0))
    ),
    "btn": ratio(a_long_req, 11.5),
    "stn": ratio(a_lat_req, 8),
    "pret": pret,
    "spret": spret,
    "et": et,
    "psd": psd,
    "ttk": ttk,
    "msd": lambda a, b: stopping(abs(a.velocity), 11.5),
    "delta_v": lambda a, b: abs((a.velocity + b.velocity) / 2 - a.velocity),
    "ci": ci,
    "rss_lon": rss_lon,
    "rss_lat": rss_lat,
    "rss_margin": rss_margin,
}
"""Of all but those that are simulated above."""


@cache
def meetings() -> tuple[Floats, Floats]:
    return random_meetings(3000 if LONG else 600, seed=31)


def test_every_measure_has_a_definition() -> None:
    assert {*DEFINITIONS, "dce", "dce_3s", "ttce", "ttc_mild", "wttc"} == {*MEASURES}


@pytest.mark.parametrize("name", DEFINITIONS)
def test_a_measure_is_what_its_definition_says(name: str) -> None:
    a, b = meetings()

    found = PairNumbers(a, b)[name]

    told = [DEFINITIONS[name](Mover(one), Mover(other)) for one, other in zip(a, b, strict=True)]
    wanted = np.array([np.nan if value is None else value for value in told])
    odd = np.flatnonzero(np.isnan(found) != np.isnan(wanted))
    assert odd.tolist() == []
    assert np.nanmax(np.abs(found - wanted) / (1 + np.abs(wanted))) < 1e-7
    assert (~np.isnan(found)).mean() > 0.1
    assert len(set(found[~np.isnan(found)].tolist())) > 20


@pytest.mark.parametrize("name", MEASURES)
def test_a_measure_is_unknown_where_what_it_needs_is(name: str) -> None:
    a = np.tile([0, 0, 0, 0, 4, 2, 10, 0, 0, 0.0], (2, 1))
    b = np.array([[14, 1, 0, 0.3, 4, 2, 2, 0.5, -1, 0], [9, -6, 0, 1.5, 4, 2, 0.5, 6, 0, 0]], float)
    known = PairNumbers(a, b)[name]
    assert not np.isnan(known).all()

    for side, needed in zip((0, 1), columns_needed(name), strict=True):
        for column in needed:
            boxes = [a.copy(), b.copy()]
            boxes[side][:, COLUMNS.index(column)] = np.nan
            assert np.isnan(PairNumbers(*boxes)[name]).all(), (side, column)


# Drivers ------------------------------------------------------------------------------------------


def driven(speed: Floats, push: Floats, times: Floats) -> Floats:
    """How far one comes that keeps an acceleration until it stands; (T, K)."""
    stands = np.where(push < 0, np.maximum(speed, 0) / np.maximum(-push, 1e-12), np.inf)
    until = np.minimum(times[:, None], stands)
    return speed * until + push * until**2 / 2


def test_who_brakes_as_required_just_does_not_touch() -> None:
    a, b = random_meetings(4000, seed=41)
    numbers = PairNumbers(a, b)
    needed, d = numbers["a_long_req"], numbers["lead"]
    apt = (needed < 0) & (numbers["v2"] >= 0) & (numbers["a2"] <= 0)
    times = np.arange(0, 60, 0.01)

    def least(share: float) -> Floats:
        behind = driven(numbers["v1"][apt], needed[apt] * share, times)
        return (d[apt] + driven(numbers["v2"][apt], numbers["a2"][apt], times) - behind).min(axis=0)

    assert apt.sum() > 100
    assert (least(1.0) > -1e-6).all()
    assert (least(0.98) < -1e-6).mean() > 0.9


def test_who_keeps_the_safe_distance_of_rss_stops_in_time() -> None:
    rng = np.random.default_rng(43)
    rear, front = rng.uniform(0, 40, (2, 300))
    a, b = (np.zeros((300, 8)) for _ in "ab")
    a[:, 6], b[:, 6], b[:, 0] = rear, front, 200

    asked = PairNumbers(a, b)["rss_lon"]

    times = np.arange(0, 30, 0.005)
    response = driven(rear, np.full(300, 3.5), np.minimum(times, 1))
    behind = response + driven(rear + 3.5, np.full(300, -4.0), np.maximum(times - 1, 0))
    ahead = driven(front, np.full(300, -8.0), times)
    ends = behind[-1] - ahead[-1]
    assert asked == pytest.approx(np.maximum(ends, 0), abs=1e-6)


@pytest.mark.parametrize(
    ("name", "a", "b", "expected"),
    [
        # Closing by 10 m/s over 20 m, b gaining 1 m/s²; and figures worked out on paper.
        pytest.param("ttc_accel", (15, 0), (24, 5, 1), 2.254, id="ttc at constant acceleration"),
        pytest.param("pttc", (23, 0), (24, 20, -2), 3.217, id="b brakes by 2 m/s²"),
        pytest.param("a_long_req", (20, 0), (34, 10, -5), -5.0, id="both come to a stand"),
        pytest.param("a_long_req", (20, 0), (24, 10, 0), -2.5, id="b keeps its speed"),
        pytest.param("drac", (20, 0), (24, 10, 0), 2.5, id="100 over 40"),
        pytest.param("decel_to_safety_time", (20, 0), (34, 10, 0), 5.0, id="10 m are left of 30"),
        pytest.param("ttb", (20, 0), (24, 10, 0), 2 - 10 / 16, id="less the time to brake"),
        pytest.param("tts", (20, 0), (24, 10, 0), 2 - math.sqrt(0.5), id="2 m aside"),
        pytest.param("rss_lon", (10, 0), (60, 10, 0), 10 + 1.75 + 13.5**2 / 8 - 6.25, id="RSS"),
        pytest.param("rss_lon", (10, 0), (60, 0, 0), 10 + 1.75 + 13.5**2 / 8, id="b stands ahead"),
        pytest.param("rss_lon", (0, 0), (-60, 10, 0), 10 + 1.75 + 13.5**2 / 8, id="a stands ahead"),
        pytest.param(
            "rss_lon", (10, 0), (60, -1e-6, 0), 10 + 1.75 + 13.5**2 / 8, id="b drives across"
        ),
        pytest.param(
            "rss_lon",
            (0, 0),
            (60, -10, 0),
            1.75 + 3.5**2 / 6 + 10 + 1.75 + 13.5**2 / 8,
            id="a stands and b comes",
        ),
        pytest.param("pttc", (10, 0), (29, -4, 4), 2.3, id="b comes and stands after 2 m"),
        pytest.param("pttc", (10, 0), (29, -10, 2), 10 - math.sqrt(75), id="b comes and brakes"),
        pytest.param("pttc", (10, 0), (29, -4, -4), math.nan, id="b comes and speeds up"),
        pytest.param("a_long_req", (10, 0), (24, 0, -5), -2.5, id="b has just come to a stand"),
    ],
)
def test_figures_worked_out_by_hand(
    name: str, a: tuple[float, float], b: tuple[float, float, float], expected: float
) -> None:
    one = np.array([[0, 0, 0, 0, 4, 2, a[0], 0, a[1], 0]], float)
    other = np.array([[b[0], 0, 0, 0, 4, 2, b[1], 0, b[2], 0]], float)

    assert PairNumbers(one, other)[name][0] == pytest.approx(expected, abs=5e-4, nan_ok=True)


# Paths that cross ---------------------------------------------------------------------------------


def test_the_predicted_encroachment_is_that_of_sampled_boxes_and_strips() -> None:
    a, b = random_movers(1000, 51)
    speeds = [np.hypot(box[:, 6], box[:, 7]) for box in (a, b)]
    turn = np.angle((a[:, 6] + 1j * a[:, 7]) / (b[:, 6] + 1j * b[:, 7] + 1e-12))
    apt = (np.minimum(*speeds) > 3) & (np.abs(np.sin(turn)) > 0.3)
    a, b = a[apt][:60], b[apt][:60]
    numbers = PairNumbers(a, b)
    step = 0.01
    times = np.arange(-15, 15, step)

    for i in range(len(a)):
        inside = [
            shapely.intersects(moved(one[i], times), strip)
            for one, strip in ((a, strip_of(b[i])), (b, strip_of(a[i])))
        ]
        ends = [(times[on].min(), times[on].max()) for on in inside if on.any()]
        if len(ends) < 2 or max(map(abs, (*ends[0], *ends[1]))) > 14.9:
            continue
        (_, left), (entered, _) = sorted(ends, key=sum)
        if min(abs(entered), abs(ends[0][1]), abs(ends[1][1]), abs(entered - left)) < 3 * step:
            continue
        wanted = math.nan
        if entered > left:
            wanted = entered - left if entered >= 0 else math.nan
        elif min(ends[0][1], ends[1][1]) >= 0:
            wanted = 0
        assert numbers["pret"][i] == pytest.approx(wanted, abs=3 * step, nan_ok=True)
        if ends[0][1] >= 0:
            assert numbers["et"][i] == pytest.approx(ends[0][1] - ends[0][0], abs=3 * step)


def test_who_kicks_down_in_time_has_left_when_the_other_one_comes() -> None:
    a, b = random_movers(3000, 61)
    numbers = PairNumbers(a, b)
    wait, comes = numbers["ttk"], numbers["enters_b"]
    apt = (wait > 0) & np.isnan(numbers["trail"])
    distance = (
        numbers["pace"] * comes + 8 * (comes - wait) ** 2 / 2
    )  # and not before it waited so long
    leaves = numbers["pace"] * (numbers["cross_a"] + numbers["stay_a"])

    assert apt.sum() > 30
    assert distance[apt] == pytest.approx(leaves[apt])
    for row in np.flatnonzero(apt)[:40]:
        when, way = comes[row], a[row, 6:8] / np.hypot(*a[row, 6:8])
        for late, touches in ((-0.02, False), (0.02, True)):
            went = numbers["pace"][row] * when + 8 * (when - wait[row] - late) ** 2 / 2
            there = a[row].copy()
            there[:2] += way * went
            on = shapely.intersects(moved(there, np.zeros(1))[0], strip_of(b[row]))
            assert on == touches


def moved(box: Floats, times: Floats) -> Any:
    rows = np.repeat(box[None, [0, 1, 3, 4, 5]], len(times), axis=0)
    rows[:, :2] += times[:, None] * box[6:8]
    return shapely.polygons(corners(rows))


def strip_of(box: Floats) -> Any:
    return shapely.MultiPolygon(list(moved(box, np.array([-60.0, 60.0])))).convex_hull


# Engines ------------------------------------------------------------------------------------------


def test_a_pattern_the_view_and_a_graph_in_memory_say_the_same(open_town: Store) -> None:
    calls = ", ".join(f"{name}(a, b)" for name in MEASURES)
    asked = open_town.find(
        f"MATCH (a:Ego), (b:Entity) WHERE frame.seq % 20 = 0 RETURN frame.id, a.id, b.id, {calls}"
    )
    told = {row[:3]: row[3:] for row in asked}
    frames = sorted({frame for frame, *_ in told})
    sql = f"""
      SELECT frame_id, src, dst, {", ".join(MEASURES)} FROM criticality
      WHERE src_is_ego AND frame_id IN ({", ".join(map(str, frames))})
    """
    seen = {row[:3]: row[3:] for row in open_town.sql(sql).values}

    views = {frame: FrameView(open_town.file.graph(frame)) for frame in frames}

    assert len(seen) > 10
    assert len(told) > len(seen)  # those that stand for ever, too
    for (frame, a, b), row in told.items():
        wanted = np.array(row, float)  # NaN where None
        found = [views[frame].pair(name, a, b) for name in MEASURES]
        np.testing.assert_allclose(np.array(found, float), wanted, rtol=1e-6, atol=1e-6)
        same = np.array(seen.get((frame, a, b), row), float)
        np.testing.assert_allclose(same, wanted, rtol=1e-9, atol=1e-9)
    known = dict(zip(MEASURES, zip(*told.values(), strict=True), strict=True))
    assert [name for name, column in known.items() if {*column} == {None}] == []


BOUNDED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))
resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
import sgstore
path, *names = sys.argv[1:]
with sgstore.open(path) as store:
    for name in names:
        sql = f"SELECT max({name}), count({name}) FROM criticality WHERE src_is_ego"
        ((most, known),) = store.sql(sql).values
        below = f"criticality WHERE src_is_ego AND {name} <= {most}" if known else "criticality WHERE FALSE"
        found = store.sql(f"SELECT frame_id FROM {below} ORDER BY {name}, frame_id").values
        assert len(found) == known, name
    tests = " AND ".join(f"({name}(e, v) < 1e300 OR {name}(e, v) IS NULL)" for name in names)
    print(store.find(f"MATCH (e:Ego), (v:Car) WHERE {tests}").count())
    print(store.find("MATCH (e:Ego), (v:Car)").count())
"""


def test_a_condition_on_a_measure_takes_no_memory_without_bound(town_store: Path) -> None:
    command = [sys.executable, "-c", BOUNDED, str(town_store), *MEASURES]

    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)

    assert done.stderr == ""
    assert len({*done.stdout.split()}) == 1


def test_measures_over_a_drive_are_what_the_frames_add_up_to(open_town: Store) -> None:
    tet, recorded, *_ = re.findall(r"```sql\n(SELECT trace, .*?)```", PAGE.read_text(), re.DOTALL)
    seen: dict[tuple[str, int], list[tuple[float, float | None, float]]] = {}
    sql = "SELECT trace, dst, t, ttc, gap FROM criticality JOIN frames USING (frame_id) WHERE src_is_ego"
    for trace, other, *row in open_town.sql(f"{sql} ORDER BY t").values:
        seen.setdefault((trace, other), []).append(tuple(row))
    exposed: dict[tuple[str, int], tuple[float, float]] = {}
    nearest: list[tuple[str, float, int, float, float]] = []
    for key, course in seen.items():
        low = [
            (t, until - t, ttc) for (t, ttc, _), (until, *_) in pairwise(course) if ttc is not None
        ]
        low = [one for one in low if one[2] <= 2]
        if low:
            exposed[key] = sum(dt for _, dt, _ in low), sum((2 - ttc) * dt for _, dt, ttc in low)
        for place, (t, *_) in enumerate(course):
            gap, when = min((gap, at) for at, _, gap in course[place:])
            nearest.append((key[0], t, key[1], gap, when - t))

    told = {row[:2]: row[2:] for row in open_town.sql(tet).values if row[2] is not None}

    assert told == {key: pytest.approx(values) for key, values in exposed.items()}
    assert len(told) > 0
    for found, wanted in zip(
        open_town.sql(recorded).values,
        sorted(nearest, key=lambda one: (one[0], one[2], one[1])),
        strict=True,
    ):
        assert found[0] == wanted[0]
        assert found[1:] == pytest.approx(wanted[1:])


# The page -----------------------------------------------------------------------------------------


def rows() -> Iterator[str]:
    yield "| measure | is | unit | source |\n|---|---|---|---|\n"
    for name, one in MEASURES.items():
        alias = f", `{one.alias}`" if one.alias else ""
        told = one.doc + (f"; {one.note}" if one.note else "")
        yield f"| `{name}`{alias} | {told} | {one.unit} | {one.source} |\n"


def test_the_page_lists_the_measures() -> None:
    page = PAGE.read_text(encoding="utf-8")
    begin, end = "<!-- measures, made from sgstore/model/pair_numbers -->\n", "<!-- end -->"
    head, rest = page.split(begin)
    expected = f"{head}{begin}{''.join(rows())}{end}{rest.partition(end)[2]}"
    if os.environ.get("SGSTORE_UPDATE_GOLDEN"):
        PAGE.write_text(expected, encoding="utf-8")
        page = expected

    assert page == expected


def test_every_measure_has_a_source() -> None:
    assert [name for name, one in MEASURES.items() if not re.search(r"\d{4}", one.source)] == []
