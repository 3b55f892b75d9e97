"""Plane geometry against shapely and against plain definitions."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sgstore.base.geometry import bearings, corners, gap_to_points, offsets, wrapped

if TYPE_CHECKING:
    from sgstore.model.world import Floats

PI = math.pi


def random_boxes(rng: np.random.Generator, count: int, spread: float) -> Floats:
    boxes = rng.uniform((-spread, -spread, -9, 0.1, 0.1), (spread, spread, 9, 15, 3), (count, 5))
    boxes[::50, 4] = 0  # lines
    boxes[::70, 3:] = 0  # points
    return boxes


def test_the_gap_to_a_point_is_shapelys_distance() -> None:
    rng = np.random.default_rng(3)
    boxes = random_boxes(rng, 20_000, 10)
    x, y = rng.uniform(-10, 10, (2, len(boxes)))

    expected = shapely.distance(shapely.polygons(corners(boxes)), shapely.points(x, y))

    assert np.abs(gap_to_points(boxes, x, y) - expected).max() <= 1e-9


def test_corners_run_counter_clockwise_from_the_front_left() -> None:
    box = np.array([[10, 20, PI / 2, 4, 2]])

    assert corners(box)[0] == pytest.approx(np.array([[9, 22], [9, 18], [11, 18], [11, 22]]))
    (polygon,) = np.atleast_1d(shapely.polygons(corners(box)))
    assert polygon.exterior.is_ccw


@given(st.floats(-1e6, 1e6) | st.integers(-9, 9).map(lambda quarters: quarters * PI / 2))
def test_a_wrapped_angle_is_in_its_interval_and_points_the_same_way(angle: float) -> None:
    turned = float(wrapped(np.array([angle]))[0])

    assert -PI < turned <= PI
    assert math.cos(turned - angle) == pytest.approx(1, abs=1e-9)


def test_wrapped_angles_stay_in_the_interval_around_half_turns() -> None:
    odd = 2 * np.random.default_rng(2).integers(-(10**6), 10**6, 100_000) + 1
    turns = odd * PI
    above, below = (np.nextafter(turns, end).astype(np.float64) for end in (np.inf, -np.inf))

    turned = wrapped(np.concatenate([turns, above, below]))

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
