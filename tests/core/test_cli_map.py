"""``sgstore map``: what is in a road map, as rows and as a picture."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from conftest import REPOSITORY
from opendrive_maps import a_map, a_road, arc, element, lane, line, section
from recordings import Recorder, car

from sgstore.apps.cli import run
from sgstore.maps.roads import lane_text, summary

if TYPE_CHECKING:
    from pathlib import Path

TOWN = REPOSITORY / "samples/town/town.xodr"


def small() -> str:
    """Two roads, one of two types, in a virtual junction; a light, a pole, a crosswalk, a controller."""
    types = element("type", s=0, type="town") + element("type", s=30, type="rural")
    signal = element("signal", id="s", s=5, t=-4, type="1000001", orientation="+", dynamic="yes")
    things = element("object", id="p", s=5, t=5, type="pole", radius=0.1)
    things += element("object", id="z", s=9, t=0, type="crosswalk", length=3, width=7)
    lanes = section(lane(2, kind="sidewalk"), lane(1), lane(0), lane(-1))
    return a_map(
        a_road("1", line(100.0), type=types, signals=signal, objects=things, sections=lanes),
        a_road("2", arc(10.0, 0.1), junction="9"),
        a_road("bad", line(float("nan"))),
        element("junction", id="9", type="virtual"),
        element("controller", element("control", signalId="s"), id="c"),
    )


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]):
    """Runs a command line; gives exit code, stdout and stderr."""

    def call(*arguments: object) -> tuple[int, str, str]:
        code = run([str(a) for a in arguments])
        return code, *capsys.readouterr()

    return call


def test_the_parts_of_a_map_are_counted_and_measured(tmp_path: Path, call: Any) -> None:
    file = tmp_path / "small.xodr"
    file.write_text(small(), encoding="utf-8")

    code, out, err = call("map", file, "--json")

    rows = [tuple(row.values()) for row in json.loads(out)]
    assert (code, err) == (0, "")
    # The lane beside the arc is 3.5 m wide on its outside: 10 m × 11.75 / 10.
    assert rows[:2] == [("lane", "driving", 3, 211.7), ("lane", "sidewalk", 1, 100.0)]
    assert rows[2:5] == [
        ("road", "rural", 1, 70.0),
        ("road", "town", 1, 30.0),
        ("road", "", 1, 10.0),
    ]
    assert rows[5:10] == [
        ("junction", "virtual", 1, None),
        ("crosswalk", "", 1, None),
        ("signal", "traffic_light", 1, None),
        ("controller", "", 1, None),
        ("object", "pole", 1, None),
    ]
    assert [(part, count) for part, _, count, _ in rows[10:]] == [("warning", 1)]
    assert "road 'bad'" in rows[10][1]


def test_in_a_table_warnings_are_said_and_are_no_rows(tmp_path: Path, call: Any) -> None:
    file = tmp_path / "small.xodr"
    file.write_text(small(), encoding="utf-8")

    code, out, err = call("map", file)

    assert code == 0
    assert "road 'bad'" in err
    assert "warning" not in out


def test_a_table_for_people_has_the_same_rows(call: Any) -> None:
    code, out, _ = call("map", TOWN)
    _, machine, _ = call("map", TOWN, "--format", "ndjson")

    assert code == 0
    lines = out.splitlines()
    assert lines[0].split() == ["part", "kind", "count", "length_m"]
    assert len(lines) - 2 == len(machine.splitlines())
    assert any(row.split()[:2] == ["signal", "traffic_light"] for row in lines)


@pytest.mark.parametrize("ending", ["png", "svg"])
def test_a_map_is_drawn(tmp_path: Path, call: Any, ending: str) -> None:
    picture = tmp_path / f"map.{ending}"

    code, out, err = call("map", TOWN, "-o", picture)

    assert code == 0
    assert "driving" in out
    assert str(picture) in err
    start = {"png": b"\x89PNG", "svg": b"<?xml"}[ending]
    assert picture.read_bytes().startswith(start)


def test_a_map_of_a_recording_and_one_of_plain_lanes_are_maps_too(
    tmp_path: Path, call: Any
) -> None:
    from test_roads_text import TWO

    drive, plain = tmp_path / "drive.mcap", tmp_path / "plain.json"
    with Recorder(drive) as recorder:
        recorder.map(small())
        recorder.ground_truth(0.0, [car(1)], host=1)
    plain.write_text(lane_text(TWO), encoding="utf-8")

    _, out, _ = call("map", drive, "--json")
    assert ("signal", "traffic_light", 1) in {tuple(row.values())[:3] for row in json.loads(out)}
    _, out, _ = call("map", plain, "--json")
    assert json.loads(out)[0] == {"part": "lane", "kind": "driving", "count": 3, "length_m": 60.0}


def test_what_has_no_map_is_an_error_that_names_the_file(tmp_path: Path, call: Any) -> None:
    bare, text = tmp_path / "bare.mcap", tmp_path / "text.txt"
    with Recorder(bare) as recorder:
        recorder.ground_truth(0.0, [car(1)], host=1)
    text.write_text("hello", encoding="utf-8")
    broken = tmp_path / "broken.xodr"
    broken.write_text("<OpenDRIVE>", encoding="utf-8")

    for file, reason in (
        (bare, "neither a road map nor lanes"),
        (text, "not an MCAP file"),
        (broken, "not XML"),
        (tmp_path / "nowhere", "No such file"),
    ):
        code, out, err = call("map", file)
        assert (code, out) == (1, "")
        assert str(file) in err
        assert reason in err
    code, _, err = call("map", TOWN, "-o", tmp_path / "map.gif")
    assert code == 1
    assert ".png" in err


def test_types_that_begin_beyond_the_road_hold_from_its_start() -> None:
    from sgstore.maps.opendrive import read_map

    kinds = element("type", s=-5, type="town") + element("type", s=1e9, type="rural")
    road_map = read_map(a_map(a_road("1", line(50.0), type=kinds)), "odd")

    roads = [part for part in summary(road_map) if part.part == "road"]

    assert sum(part.length or 0 for part in roads) == pytest.approx(50.0)
    assert {part.kind for part in roads} == {"town", "rural"}
    (lanes,) = [part for part in summary(road_map) if (part.part, part.kind) == ("lane", "driving")]
    assert (lanes.count, lanes.length) == (1, pytest.approx(50.0))
