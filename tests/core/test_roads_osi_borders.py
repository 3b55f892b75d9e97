"""Lanes of OSI that are told by their boundaries alone, beside the same lanes with their centre lines."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.reader import make_reader
from test_cli_ingest import in_json, sgstore
from test_roads_osi import (
    DRIVING,
    INTERSECTION,
    NONDRIVING,
    Truth,
    made,
    pairs,
    record,
    two_way,
)

import sgstore as library
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap

RELATIONS = ("travelsTo", "opposes", "toLeftOf", "toRightOf", "laneChange")


def without_lines(ground: Any, seed: int) -> None:
    """Take centre lines and neighbours out, and shuffle, turn and double what bounds lanes."""
    rng = random.Random(seed)
    for lane in ground.lane:
        about = lane.classification
        if about.type == INTERSECTION and not about.left_lane_boundary_id:
            continue
        del about.centerline[:], about.left_adjacent_lane_id[:], about.right_adjacent_lane_id[:]
    for boundary in list(ground.lane_boundary):
        points = list(boundary.boundary_line)
        if rng.random() < 0.5:
            points.reverse()
        del boundary.boundary_line[:]
        at = rng.randrange(1, len(points)) if seed % 2 else len(points)
        boundary.boundary_line.extend(points[: at + 1])
        rest = ground.lane_boundary.add()
        rest.CopyFrom(boundary)
        rest.id.value += 1_000_000
        if at + 1 < len(points):
            del rest.boundary_line[:]
            rest.boundary_line.extend(points[at:])
    for lane in ground.lane:
        for side in ("left", "right"):
            idents = getattr(lane.classification, f"{side}_lane_boundary_id")
            numbers = [one.value for one in idents]
            numbers += [number + 1_000_000 for number in numbers]
            rng.shuffle(numbers)
            del idents[:]
            for number in numbers:
                idents.add().value = number


def bent(radius: float, turn: float, side: int = 1) -> Truth:
    """One lane one way and two the other, on a bend to the left (side 1) or right, in steps of 3°."""
    truth = Truth()
    angles = np.radians(np.arange(0, turn + 1, 3))

    def arc(away: float) -> list[tuple[float, float]]:
        r = radius + away
        return [(r * float(np.cos(a)), side * r * float(np.sin(a))) for a in angles]

    for number in range(4):
        truth.boundary(10 + number, arc(-1.75 + 3.5 * number))
    for number, (inner, outer) in enumerate((((), (2,)), ((1,), (3,)), ((2,), ())), start=1):
        borders = ((9 + number,), (10 + number,))
        truth.lane(
            number,
            arc(3.5 * (number - 1)),
            along=number > 1,
            beside=(inner, outer)[::side],
            borders=borders[::side],
        )
    return truth


def straight() -> Truth:
    """The street of :func:`two_way`, with borders for all of its lanes."""
    truth = two_way()
    for number, (y, ident) in enumerate(((-3.5, 5), (3.5, 6))):
        for side, (name, away) in enumerate((("left", 1.75), ("right", -1.75))):
            border = 20 + 2 * number + side
            truth.boundary(border, [(100, y + away), (150, y + away)])
            about = truth.ground.lane[ident - 1].classification
            getattr(about, f"{name}_lane_boundary_id").add().value = border
    return truth


def corners(road_map: RoadMap) -> dict[str, np.ndarray]:
    """The ends of each lane's first and last cross section."""
    r = road_map.ribbons
    rows = np.column_stack((r.offsets[:-1], r.offsets[1:] - 1))
    columns = (r.left_x, r.left_y, r.right_x, r.right_y)
    return {
        road_map.nodes.name[1 + lane]: np.column_stack([c[rows[lane]] for c in columns])
        for lane in range(len(r))
    }


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "make",
    [straight, lambda: bent(12.0, 90), lambda: bent(30.0, 60, -1), lambda: bent(6.0, 180)],
    ids=["street", "bend left", "bend right", "u-turn"],
)
def test_lanes_between_boundaries_are_those_around_the_centre_lines(make: Any, seed: int) -> None:
    told, bare = make(), make()
    without_lines(bare.ground, seed)
    expected, found = made(told), made(bare)

    assert found.warnings == ()
    assert found.nodes.name == expected.nodes.name
    for relation in RELATIONS:
        assert pairs(found, relation) == pairs(expected, relation), relation
    ours, theirs = corners(found), corners(expected)
    for lane, places in theirs.items():
        assert ours[lane] == pytest.approx(places, abs=0.2), lane
    assert found.nodes.length == pytest.approx(expected.nodes.length, rel=0.01, nan_ok=True)
    assert found.nodes.width == pytest.approx(expected.nodes.width, abs=0.05, nan_ok=True)


@pytest.mark.data
@pytest.mark.parametrize("name", ["cut-in", "pedestrian", "traffic_lights", "highway_merge"])
def test_the_lanes_of_esmini_need_no_centre_lines(data: Path, name: str) -> None:
    with (data / f"traces/esmini/{name}.mcap").open("rb") as file:
        data_of = next(
            message.data
            for schema, _, message in make_reader(file).iter_messages()
            if schema is not None and schema.name.startswith("osi3.Ground")
        )
    maps: list[RoadMap] = []
    for bare in (False, True):
        truth = Truth()
        truth.ground.ParseFromString(data_of)
        if bare:
            without_lines(truth.ground, 1)
        maps.append(made(truth))
    expected, found = maps
    assert not [w for one in maps for w in one.warnings if "left out" in w]

    assert found.nodes.name == expected.nodes.name
    for relation in RELATIONS:
        more = pairs(found, relation) - pairs(expected, relation)
        missing = pairs(expected, relation) - pairs(found, relation)
        assert not more, relation
        # Two boundaries end 6 m before the lanes do.
        assert not missing or (name, relation, len(missing)) == ("highway_merge", "travelsTo", 2)


def test_an_intersection_between_boundaries_is_the_one_way_through_it() -> None:
    truth = Truth().lane(1, [(-50, 0), (0, 0)], pairs=((None, 9),))
    truth.lane(2, [(20, 5), (70, 5)], pairs=((9, None),))
    truth.boundary(10, [(0, 1.75), (6, 2.0), (12, 6.0), (20, 6.75)])
    truth.boundary(11, [(20, 3.25), (13, 2.5), (7, -1.5), (0, -1.75)])
    truth.lane(9, [], INTERSECTION, 0, along=None, pairs=((1, 2),), borders=((10,), (11,)))

    road_map = made(truth)

    assert pairs(road_map, "travelsTo") == {("1", "9"), ("9", "2")}
    assert corners(road_map)["9"][0] == pytest.approx([0, 1.75, 0, -1.75], abs=0.1)
    assert road_map.nodes.junction[road_map.nodes.name.index("9")]


def test_lanes_along_one_long_boundary_are_not_beside_those_that_lie_further_on() -> None:
    truth = Truth().boundary(10, [(0, 0), (100, 0)])
    for number, (side, x) in enumerate([(1, 0), (1, 50), (-1, 0), (-1, 50)]):
        truth.boundary(20 + number, [(x, 3.5 * side), (x + 50, 3.5 * side)])
        borders = ((20 + number,), (10,)) if side > 0 else ((10,), (20 + number,))
        truth.lane(1 + number, [(x, 1.75 * side), (x + 50, 1.75 * side)], borders=borders)

    assert pairs(made(truth), "toLeftOf") == {("1", "3"), ("2", "4")}


LOST = {
    "nothing": ((), ()),
    "no right": ((10,), ()),
    "a boundary that is not told": ((10,), (99,)),
    "one on both sides": ((10,), (10,)),
    "crossing": ((10,), (12,)),
    "a point": ((10,), (13,)),
}


def with_lost(borders: tuple[tuple[int, ...], tuple[int, ...]]) -> Truth:
    truth = Truth().boundary(10, [(0, 5), (50, 5)]).boundary(11, [(0, 0), (50, 0)])
    truth.boundary(12, [(0, 0), (50, 10)]).boundary(13, [(7, 7), (7, 7)])
    truth.lane(1, [], borders=((10,), (11,)))
    return truth.lane(2, [], NONDRIVING if borders == ((), ()) else DRIVING, borders=borders)


@pytest.mark.parametrize("why", LOST)
def test_a_lane_that_nothing_tells_is_a_loss_by_name_and_the_others_stay(
    why: str, tmp_path: Path
) -> None:
    path = record(tmp_path / "d.mcap", with_lost(LOST[why]))

    run = sgstore("ingest", tmp_path / "s.sgstore", path)

    lines = run.stderr.decode().splitlines()
    (line,) = [line for line in lines if "lost:" in line]
    assert run.returncode == 3
    assert "lane 2" in line
    assert sum("lane 2:" in line for line in lines) == 1, "said twice"
    (stored,) = library.open(tmp_path / "s.sgstore").info()
    assert [loss["reason"] for loss in stored.report["losses"]] == [line.partition("lost: ")[2]]
    assert in_json(
        "sql", tmp_path / "s.sgstore", "SELECT name FROM lanes WHERE lane_type IS NOT NULL"
    )
    assert sgstore("doctor", path).returncode == 3


def test_lanes_that_are_all_lost_are_named_and_not_denied(tmp_path: Path) -> None:
    path = record(tmp_path / "d.mcap", Truth().lane(7, []).lane(8, []))
    with open_trace(path) as trace:
        assert trace.info.map_text == ""

    run = sgstore("ingest", tmp_path / "s.sgstore", path)

    assert run.returncode == 3
    assert "lost: lanes 7, 8: left out: neither a centre line nor a boundary" in run.stderr.decode()


def test_lanes_of_no_use_are_no_loss_beside_another_map(tmp_path: Path) -> None:
    from opendrive_maps import a_map, a_road, line

    path = record(tmp_path / "d.mcap", with_lost(LOST["nothing"]))
    (tmp_path / "m.xodr").write_text(a_map(a_road("1", line(9.0))))

    run = sgstore("ingest", tmp_path / "s.sgstore", path, "--map", tmp_path / "m.xodr")

    assert run.returncode == 0
    assert "lost" not in run.stderr.decode()


def test_a_border_of_very_many_pieces_is_named_and_takes_no_time() -> None:
    truth = Truth()
    for number in range(1200):
        truth.boundary(10_000 + number, [(number, 3), (number + 1, 3)])
        truth.boundary(20_000 + number, [(number, 0), (number + 1, 0)])
    names = [tuple(range(start, start + 1200)) for start in (10_000, 20_000)]
    truth.lane(1, [], borders=(names[0], names[1]))
    truth.lane(2, [], borders=(names[0][:900], names[1][:900]))

    road_map = made(truth)

    assert road_map.warnings == ("lane 1: left out: more than 1000 boundaries to its left",)
    assert road_map.nodes.length[1] == pytest.approx(900)
