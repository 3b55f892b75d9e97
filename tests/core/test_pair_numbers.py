"""Numbers of pairs as arrays: against shapely, against plain definitions, and against SQL that was measured."""

from __future__ import annotations

import cmath
import math
from typing import TYPE_CHECKING

import duckdb
import numpy as np
import pytest
import shapely
from contacts import disagreements, random_movers
from test_geometry import random_boxes
from thorough import LONG

from sgstore.base.geometry import corners
from sgstore.model.pair_numbers import (
    COLUMNS,
    HUNG,
    OPTIONAL,
    PAIR_FUNCTIONS,
    UPRIGHT,
    PairNumbers,
    gap,
    low_and_high,
    pairs_view,
)
from sgstore.model.vocabulary import SIGNALS, VEHICLES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from sgstore.model.world import Floats

PI = math.pi


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


@pytest.mark.parametrize(
    ("x", "y", "heading", "expected"),
    [
        pytest.param(10, 0, 0, 6, id="apart: the gap"),
        pytest.param(4, 0, 0, 0, id="touching"),
        pytest.param(3.7, 0.5, 0, -0.3, id="bumper in bumper"),
        pytest.param(1, 1.9, 0, -0.1, id="side in side"),
        pytest.param(2.8, 0, PI / 2, -0.2, id="bumper in door"),
        pytest.param(0, 0, 0, -2, id="one in the other: out sideways"),
        pytest.param(0, 0, PI / 2, -3, id="crosswise: out along either axis"),
    ],
)
def test_the_clearance_is_the_gap_or_the_shortest_way_out(
    x: float, y: float, heading: float, expected: float
) -> None:
    numbers = PairNumbers(moving(0, 0), moving(x, y, heading))

    assert numbers["clearance"][0] == pytest.approx(expected, abs=1e-12)


def test_boxes_moved_out_by_their_clearance_touch_and_by_less_overlap() -> None:
    a, b = random_pairs(3000)
    a, b = (np.insert(one, 2, 0, axis=1) for one in (a, b))
    numbers = PairNumbers(a, b)
    depth = -numbers["clearance"]
    deep = depth > 1e-6
    a, b, depth = a[deep], b[deep], depth[deep]

    def freed(share: float) -> Floats:
        """Whether a move in one of 720 directions separates the boxes."""
        free = np.zeros(len(a), bool)
        for angle in np.arange(720) / 720 * 2 * PI:
            moved = b.copy()
            moved[:, 0] += np.cos(angle) * depth * share
            moved[:, 1] += np.sin(angle) * depth * share
            free |= PairNumbers(a, moved)["gap"] > 0
        return free

    assert len(depth) > 200
    assert freed(1.001).all()
    assert not freed(0.999).any()


@pytest.mark.parametrize("column", range(5))
def test_a_missing_number_makes_the_gap_missing(column: int) -> None:
    a = np.array([[0, 0, 0, 4, 2.0]] * 2)
    b = a + np.array([[20, 3, 1, 0, 0], [0.5, 0, 0, 0, 0]])
    b[:, column] = np.nan

    assert np.isnan(gap(a, b)).all()
    assert np.isnan(gap(b, a)).all()


def moving(x: float, y: float, heading: float = 0, *, z: float = 0, vx: float = 0, vy: float = 0):
    return np.array([[x, y, z, heading, 4, 2, vx, vy]], float)


def test_pair_numbers_of_a_car_closing_in_on_another() -> None:
    numbers = PairNumbers(moving(0, 0, vx=10), moving(24, 0, z=7, vx=5))

    assert numbers["dist"][0] == 25
    assert numbers["gap"][0] == pytest.approx(20)
    assert numbers["closing_speed"][0] == pytest.approx(5)
    assert numbers["closing_time"][0] == pytest.approx(4)
    assert numbers["ttc"][0] == pytest.approx(4)
    assert numbers["headway"][0] == pytest.approx(2)
    assert numbers["rel_speed"][0] == pytest.approx(5)
    assert numbers["bearing"][0] == 0


def test_pair_numbers_that_do_not_exist_are_missing() -> None:
    apart = PairNumbers(moving(0, 0, vx=5), moving(20, 0, vx=10))
    standing = PairNumbers(moving(0, 0, vx=0.1), moving(20, 0))
    behind = PairNumbers(moving(0, 0, vx=10), moving(-20, 0, vx=20))
    same_place = PairNumbers(moving(0, 0, vx=10), moving(0, 0, vx=20))

    assert np.isnan(apart["closing_time"][0])
    assert np.isnan(apart["ttc"][0])
    assert apart["closing_speed"][0] == pytest.approx(-5)
    assert np.isnan(standing["headway"][0])
    assert np.isnan(behind["headway"][0])
    assert behind["closing_time"][0] == pytest.approx(1.6)
    assert behind["ttc"][0] == pytest.approx(1.6)
    assert np.isnan(same_place["closing_speed"][0])
    assert np.isnan(same_place["closing_time"][0])
    assert same_place["ttc"][0] == 0
    assert same_place["gap"][0] == 0


@pytest.mark.parametrize("seed", range(100 if LONG else 1))
def test_the_time_to_collision_is_when_sampled_boxes_first_touch(seed: int) -> None:
    a, b = random_movers(10_000, seed)

    numbers = PairNumbers(a, b)

    assert disagreements(a, b, numbers["ttc"], horizon=20) == []
    assert np.array_equal(numbers["ttc"] == 0, numbers["gap"] == 0)
    assert min((numbers["ttc"] == 0).mean(), (numbers["ttc"] > 0).mean()) > 0.09
    assert np.array_equal(numbers["ttc"], PairNumbers(b, a)["ttc"], equal_nan=True) or (
        np.nanmax(np.abs(numbers["ttc"] - PairNumbers(b, a)["ttc"])) < 1e-9
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
        pytest.param(moving(9, 0, vx=10 - 9e-7), None, None, id="comes nearer in months"),
        pytest.param(moving(9, 0, vx=10 - 2e-6), 2.5e6, 2.5e6, id="comes nearer in weeks"),
        pytest.param(moving(-2, 2.1, vx=10, vy=-1), 0.138, 0.1, id="drives into the flank"),
        pytest.param(moving(-1, 3.1, PI / 2, vx=60, vy=-1), 0.00613, None, id="is past in time"),
        pytest.param(moving(3, 2.2, vx=11, vy=-1), None, 0.2, id="meets though the centres part"),
        pytest.param(moving(0, 0, math.nan), None, None, id="turned who knows how"),
        pytest.param(moving(24, 0, vx=math.nan), None, None, id="of a speed that is not known"),
    ],
)
def test_times_until_two_meet(other: Floats, closing_time: float | None, ttc: float | None) -> None:
    numbers = PairNumbers(moving(0, 0, vx=10), other)

    expected = [math.nan if time is None else time for time in (closing_time, ttc)]
    found = [numbers["closing_time"][0], numbers["ttc"][0]]
    assert found == pytest.approx(expected, nan_ok=True, rel=0.01)


@pytest.mark.parametrize("column", [0, 1, 3, 4, 5, 6, 7])
def test_a_missing_number_makes_the_time_to_collision_missing(column: int) -> None:
    a = np.concatenate([moving(0, 0, vx=10), moving(0, 0, vx=10)])
    b = np.concatenate([moving(9, 0, 0.2), moving(1, 0, 0.2)])
    assert not np.isnan(PairNumbers(a, b)["ttc"]).any()
    b[:, column] = np.nan

    assert np.isnan(PairNumbers(a, b)["ttc"]).all()
    assert np.isnan(PairNumbers(b, a)["ttc"]).all()


def test_gaps_along_and_across_are_those_of_the_shadows_on_the_axes() -> None:
    rng = np.random.default_rng(8)
    a, b = rng.uniform(-12, 12, (2, 500, 8))
    a[:, 4:6], b[:, 4:6] = rng.uniform(0.5, 6, (2, 500, 2))

    numbers = PairNumbers(a, b)

    for i in range(500):
        shadows = []
        for x, y, _, heading, length, width, _, _ in (a[i], b[i]):
            box = [
                complex(x, y) + np.exp(1j * heading) * complex(u * length / 2, v * width / 2)
                for u in (1, -1)
                for v in (1, -1)
            ]
            shadows.append([corner * np.exp(-1j * a[i, 3]) for corner in box])
        for axis, found in (("real", numbers["lon_gap"][i]), ("imag", numbers["lat_gap"][i])):
            one, other = ([getattr(corner, axis) for corner in box] for box in shadows)
            assert found == pytest.approx(max(min(other) - max(one), min(one) - max(other), 0))
        assert max(numbers["lon_gap"][i], numbers["lat_gap"][i]) <= numbers["gap"][i] + 1e-9


@pytest.mark.parametrize(
    ("heading", "expected"),
    [
        pytest.param(PI / 2, 0, id="its tail"),
        pytest.param(-PI / 2, 180, id="its front"),
        pytest.param(PI, 90, id="its right side"),
    ],
)
def test_apparent_heading_is_what_is_seen_of_a_car(heading: float, expected: float) -> None:
    numbers = PairNumbers(moving(0, 0, 0.3), moving(0, 20, heading))

    assert abs(numbers["apparent_heading"][0]) == pytest.approx(expected)
    assert np.isnan(PairNumbers(moving(0, 0), moving(0, 0))["apparent_heading"][0])


def test_closing_speed_is_how_fast_the_distance_shrinks() -> None:
    rng = np.random.default_rng(5)
    a, b = rng.uniform(-20, 20, (2, 2000, 8))
    a[:, 2] = b[:, 2] = 0
    step = 1e-6
    later_a, later_b = a.copy(), b.copy()
    later_a[:, :2] += a[:, 6:] * step
    later_b[:, :2] += b[:, 6:] * step

    now, later = PairNumbers(a, b), PairNumbers(later_a, later_b)

    apart = (
        now["dist"] > 1
    )  # the difference over a step means little between centres that almost meet
    slope = (now["dist"] - later["dist"]) / step
    assert now["closing_speed"][apart] == pytest.approx(slope[apart], abs=1e-3)


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

    numbers = PairNumbers(state[rows["src"]], state[rows["dst"]])

    assert len(rows["src"]) == 120 * 11
    rows["closing_time"] = rows.pop("ttc")  # as it was called then
    rows["dist"] = rows.pop("distance")
    measured = [name for name in PAIR_FUNCTIONS if name in rows and name != "headway"]
    assert len(measured) == 9  # that of headway was by half lengths and |v|
    for name in measured:
        missing = np.ma.getmaskarray(rows[name])
        ours = numbers[name]
        assert np.array_equal(np.isnan(ours), missing), name
        ours = np.radians(ours) if PAIR_FUNCTIONS[name].unit == "degrees" else ours
        expected = np.ma.getdata(rows[name])[~missing]
        assert ours[~missing] == pytest.approx(expected, rel=1e-12, abs=1e-12), name


class Box:
    """A box of one pair in complex numbers, for definitions that share nothing with the expressions."""

    def __init__(self, row: Floats) -> None:
        x, y, self.z, self.heading, self.length, self.width, vx, vy = map(float, row)
        self.place, self.velocity = complex(x, y), complex(vx, vy)

    def seen(self, other: Box) -> complex:
        return (other.place - self.place) * cmath.exp(-1j * self.heading)


def apart(a: Box, b: Box) -> float:
    """Between the footprints, by shapely."""
    boxes = [[o.place.real, o.place.imag, o.heading, o.length, o.width] for o in (a, b)]
    one, other = shapely.polygons(corners(np.array(boxes)))
    return shapely.distance(one, other)


def clear(a: Box, b: Box) -> float:
    """The gap, or the shortest way out of an overlap: from the centre to an edge of the Minkowski sum."""
    shapes = [corners(np.array([[0.0, 0.0, o.heading, o.length, o.width]]))[0] for o in (a, b)]
    sums = shapely.MultiPoint([one + other for one in shapes[0] for other in shapes[1]]).convex_hull
    there = shapely.Point((b.place - a.place).real, (b.place - a.place).imag)
    inside = sums.contains(there)
    return -sums.exterior.distance(there) if inside else sums.distance(there)


def closing(a: Box, b: Box) -> float:
    """The part of b's velocity, as a sees it, that leads to a."""
    there = (b.place - a.place) / abs(b.place - a.place)
    return -((b.velocity - a.velocity) * there.conjugate()).real


def bumpers(a: Box, b: Box) -> float:
    """From a's front to the nearest point of b along a's axis, by the corners of b."""
    boxes = [[o.place.real, o.place.imag, o.heading, o.length, o.width] for o in (a, b)]
    around = corners(np.array(boxes))
    ahead = around @ [math.cos(a.heading), math.sin(a.heading)]
    return max(ahead[1].min() - ahead[0].max(), 0)


def onward(a: Box) -> float:
    """Speed along a's axis; below 0: backwards."""
    return (a.velocity * cmath.exp(-1j * a.heading)).real


def angle(turn: float) -> float:
    return math.degrees(cmath.phase(cmath.exp(1j * turn)))


DEFINITIONS: dict[str, Callable[[Box, Box], float | None]] = {
    "dist": lambda a, b: math.hypot(abs(b.place - a.place), b.z - a.z),
    "gap": apart,
    "bearing": lambda a, b: angle(cmath.phase(b.place - a.place) - a.heading),
    "rel_heading": lambda a, b: angle(b.heading - a.heading),
    "lon": lambda a, b: a.seen(b).real,
    "lat": lambda a, b: a.seen(b).imag,
    "closing_speed": closing,
    "headway": lambda a, b: (
        bumpers(a, b) / onward(a) if a.seen(b).real > 0 and onward(a) > 0.1 else None
    ),
    "rel_speed": lambda a, b: abs(b.velocity - a.velocity),
    "apparent_heading": lambda a, b: angle(b.heading - cmath.phase(b.place - a.place)),
    "closing_time": lambda a, b: apart(a, b) / closing(a, b) if closing(a, b) >= 1e-6 else None,
    "clearance": clear,
}
"""Of all but those with a test of their own: ``ttc``, ``lon_gap`` and ``lat_gap``."""


@pytest.mark.parametrize("name", DEFINITIONS)
def test_a_number_is_what_its_definition_says(name: str) -> None:
    a, b = random_movers(400, seed=3)
    known = ~np.isnan(a + b).any(axis=1) & (np.hypot(*(b - a)[:, :2].T) > 1e-9)
    a, b = a[known], b[known]

    found = PairNumbers(a, b)[name]

    expected = [DEFINITIONS[name](Box(one), Box(other)) for one, other in zip(a, b, strict=True)]
    wanted = np.array([np.nan if value is None else value for value in expected])
    assert np.array_equal(np.isnan(found), np.isnan(wanted))
    off = found - wanted
    off = (off + 180) % 360 - 180 if PAIR_FUNCTIONS[name].unit == "degrees" else off
    assert np.nanmax(np.abs(off) / (1 + np.abs(wanted))) < 1e-9
    assert len(a) > 200


@pytest.fixture(scope="module")
def movers() -> Iterator[tuple[Floats, Floats, duckdb.DuckDBPyConnection]]:
    """Random pairs as arrays, and the same pairs as a table."""
    a, b = random_movers(2000, seed=4)
    rng = np.random.default_rng(4)
    a, b = (np.hstack([side, rng.uniform(-8, 4, (len(side), 2))]) for side in (a, b))
    for side in (a, b):  # NULL where NaN, each column now and then
        side[rng.random(side.shape) < 0.03] = np.nan
    state = {c: np.concatenate([a[:, i], b[:, i]]) for i, c in enumerate(COLUMNS)}
    state["z"] /= 4
    state |= {"frame_id": np.tile(np.arange(len(a)), 2), "node_id": np.repeat([0.0, 1.0], len(a))}
    count = 2 * len(a)
    state["height"] = rng.choice([0, 1.5, 2, 3, math.nan], count, p=[0.05, 0.3, 0.3, 0.3, 0.05])
    state["pitch"] = rng.choice([0, 0.1, -0.2, 0.4, math.nan], count)
    state["carrier"] = rng.choice([0, 1, 7, math.nan], count, p=[0.05, 0.05, 0.05, 0.85])
    kinds = rng.choice(["car", "prop", "traffic_light"], count, p=[0.6, 0.3, 0.1])
    hung, upright = (np.isin(kinds, some) for some in (HUNG, UPRIGHT))
    sides = low_and_high(state["z"], state["height"], hung, upright)
    told = {**state, **dict(zip(("low", "high"), sides, strict=True))}
    a, b = np.split(np.stack([told[c] for c in (*COLUMNS, *OPTIONAL)], axis=1), 2)
    state["kind"] = kinds
    given = (*COLUMNS, "height", "carrier", "pitch")
    read = ", ".join(f"CASE WHEN isnan({c}) THEN NULL ELSE {c} END AS {c}" for c in given)

    with duckdb.connect() as db:
        db.execute(
            "CREATE SCHEMA inside; CREATE TABLE inside.trace AS SELECT 0 AS trace_id, NULL AS uneven;"
            " CREATE TABLE inside.state AS"
            f" SELECT frame_id, node_id, kind, FALSE AS is_ego, {read} FROM state"
        )
        yield a, b, db


@pytest.mark.parametrize("name", [name for name, one in PAIR_FUNCTIONS.items() if one.sql])
def test_a_number_as_an_array_is_what_the_database_computes(
    name: str, movers: tuple[Floats, Floats, duckdb.DuckDBPyConnection]
) -> None:
    a, b, db = movers
    view, _ = pairs_view("criticality")
    column = PAIR_FUNCTIONS[name].column or name
    rows = db.execute(f"SELECT {column} FROM ({view}) WHERE src = 0 ORDER BY frame_id").fetchall()

    wanted = np.array([np.nan if value is None else value for (value,) in rows])
    found = PairNumbers(a, b)[name]
    assert np.array_equal(np.isnan(found), np.isnan(wanted))
    assert np.allclose(found, wanted, rtol=1e-12, atol=1e-12, equal_nan=True)
    assert 0 < np.isnan(found).mean() < 1


# Who is a pair of bodies -------------------------------------------------------------------------

PLACES = {"dist", "bearing", "rel_heading", "lon", "lat", "closing_speed", "rel_speed"}
PLACES |= {"apparent_heading"}
EXPRESSED = [name for name, one in PAIR_FUNCTIONS.items() if one.sql]


def body(
    x: float,
    z: float = 0.75,
    height: float = 1.5,
    node: int = 0,
    carrier: float = math.nan,
    pitch: float = math.nan,
):
    """A car, or a thing on the road if it has no height, that drives along the x axis."""
    row = np.array([[x, 0.3, z, 0.1, 4, 2, 9 - x / 4, 0.2, -1, 0]])
    low, high = (np.array([[side]]) for side in (z - height / 2, z + height / 2))
    return np.hstack([row, low, high, [[node, carrier, pitch]]])


def test_kinds_of_bodies_are_those_of_the_vocabulary() -> None:
    assert HUNG == SIGNALS
    assert UPRIGHT[: len(VEHICLES)] == VEHICLES


@pytest.mark.parametrize("name", EXPRESSED)
def test_a_car_on_a_bridge_above_is_no_pair(name: str) -> None:
    for x in (1, 14, 60):
        above = PairNumbers(body(0), body(x, z=7, node=1))
        assert np.isnan(above[name][0])
        level = PairNumbers(body(0), body(x, z=2.2, node=1))
        plain = PairNumbers(body(0)[:, :10], body(x, z=2.2)[:, :10])
        assert np.array_equal(level[name], plain[name], equal_nan=True)


@pytest.mark.parametrize("name", EXPRESSED)
@pytest.mark.parametrize(
    ("x", "z", "pitches", "joined"),
    [
        pytest.param(40, 0.75 + 2.4, (math.nan, math.nan), True, id="6 % and no pitch"),
        pytest.param(
            40, 0.75 + 2.6, (math.nan, math.nan), False, id="more than a storey, no pitch"
        ),
        pytest.param(14, 0.75 + 1.6, (math.nan, 0), False, id="more than 10 %, no pitch"),
        pytest.param(40, 0.75 + 3.9, (0, -0.1), True, id="as steep as b's pitch"),
        pytest.param(40, 0.75 + 3.9, (0.1, math.nan), True, id="as steep as a's pitch"),
        pytest.param(40, 0.75 + 4.1, (0.1, 0), False, id="steeper than the pitch"),
        pytest.param(20, 0.75 + 5.5, (0.6, 0), False, id="a pitch that no road has"),
    ],
)
def test_a_slope_joins_what_a_road_may_climb(
    name: str, x: float, z: float, pitches: tuple[float, float], joined: bool
) -> None:
    a, b = body(0, pitch=pitches[0]), body(x, z=z, node=1, pitch=pitches[1])
    plain = PairNumbers(a[:, :10], b[:, :10])[name]

    assert np.isnan(PairNumbers(a, b)[name][0]) == (not joined or np.isnan(plain[0]))


@pytest.mark.parametrize("name", EXPRESSED)
@pytest.mark.parametrize("carriers", [(math.nan, 0), (1, math.nan), (7, 7)])
def test_what_is_pulled_or_carried_is_no_pair_with_its_carrier(
    name: str, carriers: tuple[float, float]
) -> None:
    one, other = (body(8 * i, node=i, carrier=carrier) for i, carrier in enumerate(carriers))

    assert np.isnan(PairNumbers(one, other)[name][0])
    assert np.isnan(PairNumbers(other, one)[name][0])


@pytest.mark.parametrize("name", EXPRESSED)
def test_paint_on_the_road_has_a_place_and_no_body(name: str) -> None:
    paint = PairNumbers(body(0), body(14, z=0, height=0, node=1))
    hump = PairNumbers(body(0), body(14, z=0.05, height=0.1, node=1))

    assert np.isnan(paint[name][0]) == (name not in PLACES or np.isnan(hump[name][0]))


def test_a_height_that_was_not_recorded_is_not_the_height_of_paint() -> None:
    z, height = np.array([0.75, 0.75, 0.0]), np.array([0.0, math.nan, 0.0])
    upright = np.array([True, True, False])

    low, high = low_and_high(z, height, np.zeros(3, np.bool_), upright)

    assert low.tolist() == [0.75, 0.75, 0]
    assert np.isnan(high).tolist() == [True, True, False]


def test_distance_is_in_the_plane_where_a_height_is_not_known() -> None:
    numbers = PairNumbers(moving(0, 0), moving(3, 4, z=math.nan))

    assert numbers["dist"][0] == 5


# The dynamics that the formulas stand for ---------------------------------------------------------


@pytest.mark.parametrize("seed", range(20 if LONG else 2))
def test_a_long_req_is_the_least_braking_that_a_simulation_needs(seed: int) -> None:
    """A thousand steps a second, b braking to a stand whichever way it moves."""
    rng = np.random.default_rng(seed)
    count = 60
    d, v1 = rng.uniform(5, 60, count), rng.uniform(1, 20, count)
    v2 = rng.uniform(-15, 0.8 * v1, count)
    a2 = -np.sign(v2) * rng.uniform(0.5, 6, count)
    a, b = (np.tile([0, 0, 0, 0, 4, 2.0, 0, 0, 0, 0], (count, 1)) for _ in "ab")
    a[:, 6], b[:, 0], b[:, 6], b[:, 8] = v1, d + 4, v2, a2
    found = PairNumbers(a, b)["a_long_req"]

    times = np.arange(0, 60, 1e-3)[:, None]
    until = np.minimum(times, np.abs(v2) / np.abs(a2))
    ahead = d + v2 * until + a2 * until**2 / 2

    def least(push: Floats) -> Floats:
        return (ahead - v1 * times - push * times**2 / 2).min(axis=0)

    low, high = np.full(count, -80.0), np.zeros(count)
    for _ in range(40):
        middle = (low + high) / 2
        hits = least(middle) < 0
        low, high = np.where(hits, low, middle), np.where(hits, middle, high)

    hard = low < -0.1  # who brakes less stands only after the minute that is looked at
    assert found[hard] == pytest.approx(low[hard], abs=2e-3)
    assert (found[~hard] > -0.11).all()
    assert (v2 < 0).mean() > 0.3
    assert (found < -1).mean() > 0.3


@pytest.mark.parametrize("name", ["drac", "btn", "a_long_req", "a_req", "decel_to_safety_time"])
@pytest.mark.parametrize("apart", [-0.5, 0, 5e-5])
@pytest.mark.parametrize("speed", [0, 5, 12])
def test_who_touches_cannot_brake_in_time(name: str, apart: float, speed: float) -> None:
    numbers = PairNumbers(
        np.array([[0, 0, 0, 0, 4, 2, 8, 0, 0, 0.0]]),
        np.array([[4 + apart, 0, 0, 0, 4, 2, speed, 0, -1, 0.0]]),
    )

    assert np.isnan(numbers[name][0])


def test_headway_is_by_the_side_that_the_other_turns_to_it() -> None:
    crossing = PairNumbers(moving(0, 0, vx=10), moving(23, 0, PI / 2))
    reversing = PairNumbers(moving(0, 0, vx=-3), moving(20, 0))
    drifting = PairNumbers(moving(0, 0, vx=10, vy=10), moving(24, 0))

    assert crossing["headway"][0] == pytest.approx(2)
    assert np.isnan(reversing["headway"][0])
    assert drifting["headway"][0] == pytest.approx(2)
