"""Plane geometry against shapely, against plain definitions, and against its twin in SQL."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

import duckdb
import numpy as np
import pytest
import shapely
from contacts import disagreements, random_movers
from hypothesis import given
from hypothesis import strategies as st

from sgstore.geometry import (
    bearings,
    corners,
    gap,
    gap_to_points,
    offsets,
    pair_numbers,
    wrapped,
)

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.world import Floats

PI = math.pi


def random_boxes(rng: np.random.Generator, count: int, spread: float) -> Floats:
    boxes = rng.uniform((-spread, -spread, -9, 0.1, 0.1), (spread, spread, 9, 15, 3), (count, 5))
    boxes[::50, 4] = 0  # lines
    boxes[::70, 3:] = 0  # points
    return boxes


def random_pairs(count: int) -> tuple[Floats, Floats]:
    """Pairs of boxes, from apart to overlapping; a third parallel or perpendicular, exactly or almost."""
    rng = np.random.default_rng(7)
    a, b = random_boxes(rng, count, 15), random_boxes(rng, count, 15)
    third = count // 3
    b[:third, 2] = a[:third, 2] + rng.integers(-4, 5, third) * (PI / 2)
    b[: third // 2, 2] += rng.choice([0, 1e-15, -1e-12, 1e-9], third // 2)
    b[third : third + third // 4, :2] = a[third : third + third // 4, :2]
    return a, b


def test_the_gap_is_shapelys_distance() -> None:
    a, b = random_pairs(150_000)

    expected = shapely.distance(shapely.polygons(corners(a)), shapely.polygons(corners(b)))

    assert np.abs(gap(a, b) - expected).max() <= 1e-9
    assert 0.1 < (expected == 0).mean() < 0.5
    assert np.array_equal(gap(a, b) > 1e-9, expected > 1e-9)


def test_the_gap_is_the_same_from_both_sides() -> None:
    a, b = random_pairs(20_000)

    assert np.abs(gap(a, b) - gap(b, a)).max() <= 1e-12


@pytest.mark.parametrize(
    ("x", "y", "heading", "expected"),
    [
        pytest.param(10, 0, 0, 6, id="in line: bumper to bumper"),
        pytest.param(-10, 0, PI, 6, id="behind, facing away: bumper to bumper"),
        pytest.param(10, 0, PI / 2, 7, id="crossing: bumper to door"),
        pytest.param(0, 5, 0, 3, id="side by side: door to door"),
        pytest.param(7, 6, 0, 5, id="corner to corner, 3 ahead and 4 aside"),
        pytest.param(4, 0, 0, 0, id="touching"),
        pytest.param(1, 1, 0.3, 0, id="overlapping"),
        pytest.param(0, 0, 0, 0, id="one in the other"),
    ],
)
def test_the_gap_is_between_footprints(x: float, y: float, heading: float, expected: float) -> None:
    car, other = np.array([[0, 0, 0, 4, 2.0]]), np.array([[x, y, heading, 4, 2.0]])

    assert gap(car, other)[0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("column", range(5))
def test_a_missing_number_makes_the_gap_missing(column: int) -> None:
    a = np.array([[0, 0, 0, 4, 2.0]] * 2)
    b = a + np.array([[20, 3, 1, 0, 0], [0.5, 0, 0, 0, 0]])
    b[:, column] = np.nan

    assert np.isnan(gap(a, b)).all()
    assert np.isnan(gap(b, a)).all()


def test_the_gap_to_a_point_is_shapelys_distance() -> None:
    rng = np.random.default_rng(3)
    boxes = random_boxes(rng, 20_000, 10)
    x, y = rng.uniform(-10, 10, (2, len(boxes)))

    expected = shapely.distance(shapely.polygons(corners(boxes)), shapely.points(x, y))

    assert np.abs(gap_to_points(boxes, x, y) - expected).max() <= 1e-9


def test_corners_run_counter_clockwise_from_the_front_left() -> None:
    box = np.array([[10, 20, PI / 2, 4, 2]])

    assert corners(box)[0] == pytest.approx(np.array([[9, 22], [9, 18], [11, 18], [11, 22]]))
    assert shapely.polygons(corners(box))[0].exterior.is_ccw


@given(st.floats(-1e6, 1e6) | st.integers(-9, 9).map(lambda quarters: quarters * PI / 2))
def test_a_wrapped_angle_is_in_its_interval_and_points_the_same_way(angle: float) -> None:
    turned = float(wrapped(np.array([angle]))[0])

    assert -PI < turned <= PI
    assert math.cos(turned - angle) == pytest.approx(1, abs=1e-9)


def test_wrapped_angles_stay_in_the_interval_around_half_turns() -> None:
    odd = 2 * np.random.default_rng(2).integers(-(10**6), 10**6, 100_000) + 1
    above, below = np.nextafter(odd * PI, np.inf), np.nextafter(odd * PI, -np.inf)

    turned = wrapped(np.concatenate([odd * PI, above, below]))

    assert (turned > -PI).all()
    assert (turned <= PI).all()


def test_half_a_turn_is_positive_whichever_way_it_was_made() -> None:
    angles = np.array([PI, -PI, 3 * PI, -5 * PI])

    assert wrapped(angles) == pytest.approx(PI)
    assert np.isnan(wrapped(np.array([np.nan, np.inf]))).all()


@pytest.mark.parametrize("heading", [0, PI / 2, PI, -PI / 2, 1.0])
def test_bearings_are_positive_to_the_left(heading: float) -> None:
    ahead = np.array([1.0, 0.0, -1.0, 0.0, 1.0])
    left = np.array([0.0, 1.0, 0.0, -1.0, 1.0])
    cos, sin = math.cos(heading), math.sin(heading)

    found = bearings(ahead * cos - left * sin, ahead * sin + left * cos, np.full(5, heading))

    assert np.cos(found) == pytest.approx(np.cos([0, PI / 2, PI, -PI / 2, PI / 4]), abs=1e-12)
    assert np.sin(found) == pytest.approx(np.sin([0, PI / 2, PI, -PI / 2, PI / 4]), abs=1e-12)


def test_the_bearing_of_the_same_place_is_zero_and_without_heading_there_is_none() -> None:
    found = bearings(np.zeros(2), np.zeros(2), np.array([2.0, np.nan]))

    assert found[0] == 0
    assert np.isnan(found[1])


def test_offsets_are_the_vector_in_turned_axes() -> None:
    lon, lat = offsets(np.array([0.0, 3.0]), np.array([5.0, 4.0]), np.array([PI / 2, 0.0]))

    assert lon == pytest.approx([5, 3])
    assert lat == pytest.approx([0, 4])


def moving(x: float, y: float, heading: float = 0, *, z: float = 0, vx: float = 0, vy: float = 0):
    return np.array([[x, y, z, heading, 4, 2, vx, vy]], float)


def test_pair_numbers_of_a_car_closing_in_on_another() -> None:
    numbers = pair_numbers(moving(0, 0, vx=10), moving(24, 0, z=7, vx=5))

    assert numbers.distance[0] == 25
    assert numbers.gap[0] == pytest.approx(20)
    assert numbers.closing_speed[0] == pytest.approx(5)
    assert numbers.closing_time[0] == pytest.approx(4)
    assert numbers.ttc[0] == pytest.approx(4)
    assert numbers.headway[0] == pytest.approx(2)
    assert numbers.rel_speed[0] == pytest.approx(5)
    assert numbers.bearing[0] == 0


def test_pair_numbers_that_do_not_exist_are_missing() -> None:
    apart = pair_numbers(moving(0, 0, vx=5), moving(20, 0, vx=10))
    standing = pair_numbers(moving(0, 0, vx=0.1), moving(20, 0))
    behind = pair_numbers(moving(0, 0, vx=10), moving(-20, 0, vx=20))
    same_place = pair_numbers(moving(0, 0, vx=10), moving(0, 0, vx=20))

    assert np.isnan(apart.closing_time[0])
    assert np.isnan(apart.ttc[0])
    assert apart.closing_speed[0] == pytest.approx(-5)
    assert np.isnan(standing.headway[0])
    assert np.isnan(behind.headway[0])
    assert behind.closing_time[0] == pytest.approx(1.6)
    assert behind.ttc[0] == pytest.approx(1.6)
    assert np.isnan(same_place.closing_speed[0])
    assert np.isnan(same_place.closing_time[0])
    assert same_place.ttc[0] == 0
    assert same_place.gap[0] == 0


@pytest.mark.parametrize("seed", range(100 if os.environ.get("SGSTORE_LONG") else 1))
def test_the_time_to_collision_is_when_sampled_boxes_first_touch(seed: int) -> None:
    a, b = random_movers(10_000, seed)

    numbers = pair_numbers(a, b)

    assert disagreements(a, b, numbers.ttc, horizon=20) == []
    assert np.array_equal(numbers.ttc == 0, numbers.gap == 0)
    assert min((numbers.ttc == 0).mean(), (numbers.ttc > 0).mean()) > 0.09
    assert np.array_equal(numbers.ttc, pair_numbers(b, a).ttc, equal_nan=True) or (
        np.nanmax(np.abs(numbers.ttc - pair_numbers(b, a).ttc)) < 1e-9
    )


@pytest.mark.parametrize(
    ("other", "closing_time", "ttc"),
    [
        pytest.param(moving(24, 0), 2, 2, id="stands ahead"),
        pytest.param(moving(24, 3), 2.02, None, id="stands beside the path"),
        pytest.param(moving(20, 16, -PI / 2, vy=-10), 1.522, 1.7, id="comes from the side"),
        pytest.param(moving(20, 30, -PI / 2, vy=-10), 2.30, None, id="comes from the side, late"),
        pytest.param(moving(3, 1.5, vx=-5), 0, 0, id="overlaps"),
        pytest.param(moving(1, 1, vx=12), None, 0, id="overlaps and leaves"),
        pytest.param(moving(4, 0, vx=10), None, 0, id="touches, and keeps its place"),
        pytest.param(moving(9, 0, vx=10), None, None, id="keeps its place"),
        pytest.param(moving(9, 0, vx=10 - 9e-7), 5.56e6, None, id="comes nearer in months"),
        pytest.param(moving(-2, 2.1, vx=10, vy=-1), 0.138, 0.1, id="drives into the flank"),
        pytest.param(moving(-1, 3.1, PI / 2, vx=60, vy=-1), 0.00613, None, id="is past in time"),
        pytest.param(moving(3, 2.2, vx=11, vy=-1), None, 0.2, id="meets though the centres part"),
        pytest.param(moving(0, 0, math.nan), None, None, id="turned who knows how"),
        pytest.param(moving(24, 0, vx=math.nan), None, None, id="of a speed that is not known"),
    ],
)
def test_times_until_two_meet(other: Floats, closing_time: float | None, ttc: float | None) -> None:
    numbers = pair_numbers(moving(0, 0, vx=10), other)

    expected = [math.nan if time is None else time for time in (closing_time, ttc)]
    found = [numbers.closing_time[0], numbers.ttc[0]]
    assert found == pytest.approx(expected, nan_ok=True, rel=0.01)


@pytest.mark.parametrize("column", [0, 1, 3, 4, 5, 6, 7])
def test_a_missing_number_makes_the_time_to_collision_missing(column: int) -> None:
    a = np.concatenate([moving(0, 0, vx=10), moving(0, 0, vx=10)])
    b = np.concatenate([moving(9, 0, 0.2), moving(1, 0, 0.2)])
    assert not np.isnan(pair_numbers(a, b).ttc).any()
    b[:, column] = np.nan

    assert np.isnan(pair_numbers(a, b).ttc).all()
    assert np.isnan(pair_numbers(b, a).ttc).all()


def test_gaps_along_and_across_are_those_of_the_shadows_on_the_axes() -> None:
    rng = np.random.default_rng(8)
    a, b = rng.uniform(-12, 12, (2, 500, 8))
    a[:, 4:6], b[:, 4:6] = rng.uniform(0.5, 6, (2, 500, 2))

    numbers = pair_numbers(a, b)

    for i in range(500):
        shadows = []
        for x, y, _, heading, length, width, _, _ in (a[i], b[i]):
            box = [
                complex(x, y) + np.exp(1j * heading) * complex(u * length / 2, v * width / 2)
                for u in (1, -1)
                for v in (1, -1)
            ]
            shadows.append([corner * np.exp(-1j * a[i, 3]) for corner in box])
        for axis, found in (("real", numbers.lon_gap[i]), ("imag", numbers.lat_gap[i])):
            one, other = ([getattr(corner, axis) for corner in box] for box in shadows)
            assert found == pytest.approx(max(min(other) - max(one), min(one) - max(other), 0))
        assert max(numbers.lon_gap[i], numbers.lat_gap[i]) <= numbers.gap[i] + 1e-9


@pytest.mark.parametrize(
    ("heading", "expected"),
    [
        pytest.param(PI / 2, 0, id="its tail"),
        pytest.param(-PI / 2, PI, id="its front"),
        pytest.param(PI, PI / 2, id="its right side"),
    ],
)
def test_apparent_heading_is_what_is_seen_of_a_car(heading: float, expected: float) -> None:
    numbers = pair_numbers(moving(0, 0, 0.3), moving(0, 20, heading))

    assert abs(numbers.apparent_heading[0]) == pytest.approx(expected)
    assert np.isnan(pair_numbers(moving(0, 0), moving(0, 0)).apparent_heading[0])


def test_closing_speed_is_how_fast_the_distance_shrinks() -> None:
    rng = np.random.default_rng(5)
    a, b = rng.uniform(-20, 20, (2, 2000, 8))
    a[:, 2] = b[:, 2] = 0
    step = 1e-6
    later_a, later_b = a.copy(), b.copy()
    later_a[:, :2] += a[:, 6:] * step
    later_b[:, :2] += b[:, 6:] * step

    now, later = pair_numbers(a, b), pair_numbers(later_a, later_b)

    apart = (
        now.distance > 1
    )  # the difference over a step means little between centres that almost meet
    slope = (now.distance - later.distance) / step
    assert now.closing_speed[apart] == pytest.approx(slope[apart], abs=1e-3)


@pytest.mark.data
def test_pair_numbers_equal_the_measured_view_in_sql(data: Path) -> None:
    rng = np.random.default_rng(11)
    state = rng.uniform((-30, -30, 0, -3, 1, 1, -9, -9), (30, 30, 0, 3, 9, 3, 9, 9), (120, 8))
    names = ("x", "y", "z", "heading", "length", "width", "vx", "vy")
    columns = {name: state[:, i] for i, name in enumerate(names)}
    columns |= {"frame_id": np.arange(120) // 12, "node_id": np.arange(120)}
    columns |= {"speed": np.hypot(state[:, 6], state[:, 7])}
    view = (data / "views_measured.sql").read_text(encoding="utf-8")
    view = view[view.index("CREATE TEMP VIEW pairs") :]
    with duckdb.connect() as db:
        db.execute("CREATE TABLE state_f AS SELECT *, 'car' AS kind FROM columns")
        db.execute(view)
        rows = db.execute("SELECT * EXCLUDE (frame_id, src_kind, dst_kind) FROM pairs").fetchnumpy()

    numbers = pair_numbers(state[rows["src"]], state[rows["dst"]])

    assert len(rows["src"]) == 120 * 11
    rows["closing_time"] = rows.pop("ttc")  # as it was called then
    measured = [name for name in numbers.__slots__ if name in rows]
    assert len(measured) == 10
    for name in measured:
        missing = np.ma.getmaskarray(rows[name])
        assert np.array_equal(np.isnan(getattr(numbers, name)), missing), name
        found, expected = getattr(numbers, name)[~missing], np.ma.getdata(rows[name])[~missing]
        assert found == pytest.approx(expected, rel=1e-12, abs=1e-12), name
