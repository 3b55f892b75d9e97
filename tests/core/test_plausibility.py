"""Faults that are well-formed and impossible are found in every flavour; good recordings raise no alarm."""

from __future__ import annotations

import copy
import math
import os
from functools import cache
from typing import TYPE_CHECKING

import pytest
from builders import PaperMap, Patch
from implausible import FAULTS, KINDS, WRITERS, Body, Drive, Moment, drive, frames, noisy
from test_cli_ingest import sgstore

from sgstore.graphs.online import Frame
from sgstore.ingest import ingest
from sgstore.maps.map_files import Maps
from sgstore.model.config import Config
from sgstore.pipeline.doctor import examine
from sgstore.pipeline.plausibility import REMEDY, Finding, Plausibility
from sgstore.readers import on_map, open_trace
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap

pytestmark = pytest.mark.seconds(9)

LONG = bool(os.environ.get("SGSTORE_LONG"))
TRUE_ALARMS = {
    # Its ego jumps back by 1.9 m: a fault of its conversion.
    "real/nuscenes/scene-0655.mcap": ["teleport"],
    # A car has two tracks, 1 mm apart.
    "real/av2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede": ["doubled body"],
}


def found_in(flavour: str, of: Drive, folder: Path, size: int = 25) -> list[Finding]:
    checked = Plausibility()
    if flavour == "online":
        assert len(list(checked.watched(frames(of)))) == len(of)
        return checked.findings()
    with open_trace(WRITERS[flavour](of, folder / "x.mcap")) as trace:
        for block in trace.blocks(size):
            checked.see(block)
        return checked.findings(trace.report)


@cache
def good() -> Drive:
    return drive()


def with_fault(name: str) -> Drive:
    of = copy.deepcopy(good())
    FAULTS[name][0](of)
    return of


def flavours(number: int, name: str) -> list[str]:
    """All flavours of a fault in the long form, else one of them, in turn."""
    of = sorted(FAULTS[name][1])
    return of if LONG else [of[number % len(of)]]


@pytest.mark.parametrize("flavour", [*WRITERS, "online"])
def test_a_good_drive_raises_no_alarm(flavour: str, tmp_path: Path) -> None:
    assert found_in(flavour, good(), tmp_path) == []


@pytest.mark.parametrize(("number", "name"), [*enumerate(FAULTS)], ids=FAULTS)
def test_each_kind_of_fault_is_found_in_each_flavour(
    number: int, name: str, tmp_path: Path
) -> None:
    kinds = FAULTS[name][2]
    for flavour in flavours(number, name):
        found = [one for one in found_in(flavour, with_fault(name), tmp_path) if one.kind in kinds]

        assert found, flavour
        assert all(one.remedy == REMEDY[one.kind] and one.remedy in str(one) for one in found)
        assert all(
            0 <= one.frame < len(good()) and f"frame {one.frame}" in str(one) for one in found
        )


def test_the_noise_of_measured_data_raises_no_alarm(tmp_path: Path) -> None:
    for seed in range(40 if LONG else 8):
        for size in (0.05, 0.15, 0.3):
            assert found_in("online", noisy(good(), size, seed), tmp_path) == []


def test_faults_are_found_in_measured_data(tmp_path: Path) -> None:
    for name in ("velocity in km/h", "heading off by 180", "teleport", "swapped ids"):
        found = found_in("online", noisy(with_fault(name), 0.05, 1), tmp_path)

        assert {one.kind for one in found} & FAULTS[name][2], name


def test_a_finding_names_the_body_and_the_frame_in_which_it_begins(tmp_path: Path) -> None:
    middle = len(good()) // 2
    (jump,) = found_in("osi", with_fault("teleport"), tmp_path)
    swaps = found_in("osi", with_fault("swapped ids"), tmp_path)
    (fast,) = found_in("osi", with_fault("velocity of one body x10"), tmp_path)

    assert (jump.kind, jump.entity, jump.frame) == ("teleport", "2", middle)
    assert [(one.kind, one.frame, one.entities) for one in swaps] == [("swapped ids", middle, 2)]
    assert (fast.entity, fast.entities) == ("2", 1)
    assert "factor 10" in fast.value


def test_findings_do_not_depend_on_the_size_of_blocks(tmp_path: Path) -> None:
    for name in ("teleport", "reused id", "frozen", "unsorted stamps", "light flickers"):
        whole = found_in("osi", with_fault(name), tmp_path, 120)

        assert found_in("osi", with_fault(name), tmp_path, 7) == whole, name


# Faults that only a map shows.

STREET = PaperMap(
    Patch("1/0/-1", 0, -4, 400, 0, road="1", controlled_by="s1"),
    Patch("1/0/-2", 0, -8, 400, -4, road="1"),
    objects=(("s1", "traffic_light"),),
)


def street(*, mirrored: bool = False, turned: float = 0.0) -> Drive:
    """Two cars along the street, or in mirrored or turned axes."""
    side = -1 if mirrored else 1
    return [
        Moment(
            i * 0.1,
            i * 0.1,
            {
                ident: Body(10 + i, side * (-2.0 - 40 * mirrored), turned, 10.0, 0.0)
                for ident in (1, 2)
            },
        )
        for i in range(60)
    ]


def on_street(of: Drive, ref: str = "s1", road_map: RoadMap = STREET) -> list[str]:
    checked = Plausibility(road_map)
    for number, moment in enumerate(of):
        frame = Frame(number * 100_000_000, ego=1)
        for ident, body in moment.bodies.items():
            x, way = body.x + 20 * ident, math.cos(body.heading)
            frame.add(
                *(ident, KINDS[ident], x, body.y),
                heading=math.degrees(body.heading),
                vx=body.vx * way,
                vy=body.vy,
                length=4.5,
                width=1.9,
            )
        frame.add("t", "traffic_light", 400, 2, light_state="red", map_ref=ref)
        list(checked.watched([frame]))
    return [one.kind for one in checked.findings()]


def test_lights_without_lanes_and_places_off_the_map_are_found() -> None:
    assert on_street(street()) == []
    assert on_street(street(), ref="s2") == ["light without lanes"]
    assert on_street(street(), ref="") == ["light without lanes"]
    assert on_street(street(mirrored=True)) == ["off the map"]


def test_vehicles_beside_the_lanes_are_found() -> None:
    beside = street()
    for moment in beside:
        for body in moment.bodies.values():
            body.y = 12.0

    assert on_street(beside) == ["off the map"]


def test_vehicles_against_their_lanes_are_found() -> None:
    back = street()
    for moment in back:
        for body in moment.bodies.values():
            body.x, body.heading = 300 - body.x, math.pi

    assert on_street(back) == ["wrong way"]


def test_mirrored_axes_are_named_where_the_mirrored_place_is_on_the_map() -> None:
    checked = Plausibility(STREET)
    for number in range(20):
        frame = Frame(number * 100_000_000, ego="a")
        frame.add("a", "car", -40 - number, -2, heading=180, length=4.5, width=1.9)
        frame.add("b", "car", -90 - number, -2, heading=180, length=4.5, width=1.9)
        list(checked.watched([frame]))
    (found,) = checked.findings()

    assert found.kind == "off the map"
    assert "on the map if x were mirrored" in found.value


def test_lights_that_never_change_are_found_after_a_long_time() -> None:
    kinds = []
    for step in (1, 4):
        checked = Plausibility()
        for number in range(40):
            frame = Frame(number * step * 1_000_000_000)
            frame.add("t", "traffic_light", 0, 0, light_state="green")
            list(checked.watched([frame]))
        kinds.append([one.kind for one in checked.findings()])

    assert kinds == [[], ["lights never change"]]


# Where findings are shown.


def test_doctor_ingest_and_the_store_report_a_finding(tmp_path: Path) -> None:
    path = WRITERS["osi"](with_fault("teleport"), tmp_path / "t.mcap")

    examined = examine(path)
    (outcome,) = ingest(tmp_path / "t.sgstore", [path])
    report = StoreFile(tmp_path / "t.sgstore").trace("t").report
    printed = sgstore("doctor", path).stdout.decode()

    (found,) = examined.implausible
    assert (found["kind"], found["entity"], found["entities"]) == ("teleport", "2", 1)
    line = str(Finding(**found))
    assert line in outcome.warnings
    assert line in report["warnings"]
    table = printed.partition("implausible data:")[2]
    assert "teleport" in table
    assert f"teleport: {found['remedy']}" in table
    assert max(map(len, table.splitlines())) <= 100


def test_a_named_ego_makes_the_missing_ego_of_the_recording_moot(tmp_path: Path) -> None:
    path = WRITERS["osi"](with_fault("ego missing"), tmp_path / "t.mcap")
    own, other = (
        ingest(tmp_path / f"{name}.sgstore", [path], egos=egos)[0].warnings
        for name, egos in (("a", ()), ("b", ("3",)))
    )

    assert any(line.startswith("ego missing") for line in own)
    assert not any(line.startswith("ego missing") for line in other)


def test_good_recordings_raise_no_alarm(data: Path) -> None:
    folders = ("traces", "real", "commonroad", "ncap_alks/mcap")
    paths = [p for name in folders for p in sorted((data / name).rglob("*"))]
    paths = [p for p in paths if p.suffix in {".mcap", ".osi", ".xml", ".log"}]
    paths = [p for p in paths if p.parent.name != "damaged"]
    paths += [p for p in sorted((data / "real/av2").iterdir()) if p.is_dir()] if LONG else []
    alarms: dict[str, list[str]] = {}
    for path in paths if LONG else paths[::12]:
        with open_trace(path) as trace:
            road_map, _ = Maps(None, Config().signs).of(trace.info)
            on_map(trace, road_map)
            checked = Plausibility(road_map)
            for block in trace.blocks(120):
                checked.see(block)
            found = checked.findings(trace.report)
        if found:
            alarms[str(path.relative_to(data))] = [one.kind for one in found]

    assert {name: kinds for name, kinds in alarms.items() if TRUE_ALARMS.get(name) != kinds} == {}
