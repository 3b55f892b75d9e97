"""Scenarios in OpenSCENARIO: valid by its schema, and driven again they are what was recorded."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from recordings import Recorder, bulb, car, house, person
from test_sample import SAMPLE, decoded, lamps, tracks_of
from thorough import LONG

import sgstore
from sgstore.exporters import Export, write_export
from sgstore.ingest import ingest
from sgstore.lang.library import patterns
from sgstore.model.world import Clip

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.seconds(6)

S = 1_000_000_000
SCHEMA = (
    Path(os.environ.get("SGSTORE_DATA", Path(__file__).parents[3] / "shared" / "data"))
    / "schemas"
    / "OpenSCENARIO_1_2.xsd"
)
LETTERS = {"x": 0, "y": 1, "z": 2, "h": 3, "p": 4, "r": 5}


def faults(files: list[Path]) -> list[str]:
    """What the schema of the standard finds wrong."""
    if not SCHEMA.is_file():
        pytest.skip(f"no {SCHEMA}")
    etree = pytest.importorskip("lxml.etree")
    schema = etree.XMLSchema(etree.parse(str(SCHEMA)))
    found = []
    for file in files:
        schema.validate(etree.parse(str(file)))
        found += [f"{file.name}: {fault}" for fault in schema.error_log]
    return found


# A reader of scenarios, as the standard says them -----------------------------------------------------


@dataclass
class Played:
    """An entity of a scenario over time."""

    centre: np.ndarray[Any, Any]
    properties: dict[str, str]
    there: list[tuple[float, float]] = field(default_factory=list)
    """From when to when it is there."""
    tracks: list[tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]] = field(default_factory=list)

    def middle(self, time: float) -> np.ndarray[Any, Any] | None:
        """The middle of its box."""
        if not any(start <= time < end for start, end in self.there):
            return None
        begun = [one for one in self.tracks if one[0][0] <= time]
        times, poses = max(begun, key=lambda one: (one[0][0], len(one[0])))  # at its end it stands
        pose = np.array([np.interp(time, times, poses[:, axis]) for axis in range(6)])
        turn = about(2, pose[3]) @ about(1, pose[4]) @ about(0, pose[5])
        return pose[:3] + turn @ self.centre


def about(axis: int, angle: float) -> np.ndarray[Any, Any]:
    c, s, out = np.cos(angle), np.sin(angle), np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[i, i], out[j, j], out[i, j], out[j, i] = c, c, -s, s
    return out


def pose_of(element: ET.Element) -> np.ndarray[Any, Any]:
    (world,) = element.iter("WorldPosition")
    return np.array([float(world.get(name, 0)) for name in LETTERS])


def played(file: Path) -> tuple[dict[str, Played], dict[str, list[tuple[float, str]]], float]:
    """Entities by name, what signals show from when on, and how long it lasts."""
    root = ET.parse(file).getroot()
    found: dict[str, Played] = {}
    for one in root.iter("ScenarioObject"):
        at = one.find(".//Center").attrib
        centre = np.array([float(at[axis]) for axis in "xyz"])
        told = {p.get("name"): p.get("value") for p in one.iter("Property")}
        found[one.get("name")] = Played(centre, told)
    board = root.find("Storyboard")
    end, came, shown = begins(board.find("StopTrigger")), {}, {}
    for one in board.find("Init").iter("Private"):
        came[one.get("entityRef")] = 0.0
        found[one.get("entityRef")].tracks.append((np.zeros(1), pose_of(one)[None]))
    for one in board.find("Init").iter("TrafficSignalStateAction"):
        shown.setdefault(one.get("name"), []).append((0.0, one.get("state")))
    for group in root.iter("ManeuverGroup"):
        actor = next((ref.get("entityRef") for ref in group.iter("EntityRef")), "")
        for event in group.iter("Event"):
            time = begins(event.find("StartTrigger"))
            for one in event.iter("TrafficSignalStateAction"):
                shown.setdefault(one.get("name"), []).append((time, one.get("state")))
            if actor:
                happen(found[actor], actor, event, time, came)
    for actor, start in came.items():
        found[actor].there.append((start, end + 1e-9))
    return found, shown, end


def begins(trigger: ET.Element) -> float:
    return float(trigger.find(".//SimulationTimeCondition").get("value"))


def happen(one: Played, name: str, event: ET.Element, time: float, came: dict[str, float]) -> None:
    """Let an entity come, move, stand or leave."""
    if event.find(".//AddEntityAction") is not None:
        assert name not in came
        came[name] = time
    if event.find(".//DeleteEntityAction") is not None:
        one.there.append((came.pop(name), time))
    if event.find(".//TeleportAction") is not None:
        one.tracks.append((np.array([time]), pose_of(event)[None]))
    vertices = [*event.iter("Vertex")]
    if vertices:
        times = np.array([float(vertex.get("time")) for vertex in vertices])
        one.tracks.append((times, np.array([pose_of(vertex) for vertex in vertices])))
        assert times[0] == time


# The sample -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def store(town_store: Path) -> Iterator[sgstore.Store]:
    with sgstore.open(town_store) as store:
        yield store


@pytest.fixture(scope="module")
def frames() -> list[Any]:
    return decoded(SAMPLE)[1]["ground_truth"]


def test_a_scenario_has_everybody_where_the_recording_has_them(
    store: sgstore.Store, frames: list[Any], tmp_path: Path
) -> None:
    """Seconds in which vehicles and people come and leave; at each frame, and between two."""
    low, high = 440, (560 if LONG else 480)
    (file, road_map) = write_export(
        Export(store, (Clip("town", low * S // 10, high * S // 10),)), tmp_path / "out", "xosc"
    )
    compared, absent, end = stands_as_recorded(file.file, store, frames, low)

    assert file.losses == ()
    assert end == (high - low) / 10
    assert compared > 900
    assert absent > 100
    assert (
        road_map.file.read_text()
        == decoded(SAMPLE)[1]["ground_truth_map"][0].open_drive_xml_content
    )
    assert faults([file.file]) == []


def stands_as_recorded(
    file: Path, store: sgstore.Store, frames: list[Any], low: int
) -> tuple[int, int, float]:
    """How many places were compared, how many entities were not there, and how long it lasts; s.

    Everybody is within 1 cm of the recording, from its frame ``low`` on, at each frame and between two.
    """
    found, _, end = played(file)
    tracks = tracks_of(frames)
    z = {o.id.value: o.base.position.z for frame in frames for o in frame.moving_object}
    compared, absent = 0, 0
    for one in found.values():
        track = tracks.get(one.properties["sgstore.ident"])
        if track is None:  # it stands for ever
            continue
        for step in range(2 * round(end * 10) + 1):
            middle, row = one.middle(step / 20), low + step // 2
            rows = [row, row + step % 2]
            if middle is None:
                absent += 1
                continue
            if not track.here[rows].all() or not {*rows} <= stored(store, one):
                continue
            expected = [track.x[rows].mean(), track.y[rows].mean(), z[track.ident]]
            assert np.abs(middle - expected).max() < 0.01, (file.name, one.properties, step)
            compared += 1
    return compared, absent, end


def stored(store: sgstore.Store, one: Played) -> set[int]:
    """Frames of the store in which an entity is."""
    ident = one.properties["sgstore.ident"]
    if ident not in _STORED:
        sql = (
            "SELECT f.seq FROM nodes n JOIN frames f USING (frame_id) JOIN entities e ON e.node_id = n.node_id"
            f" WHERE e.ident = '{ident}'"
        )
        _STORED[ident] = {seq for (seq,) in store.sql(sql)}
    return _STORED[ident]


_STORED: dict[str, set[int]] = {}


def test_lights_show_what_they_showed(
    store: sgstore.Store, frames: list[Any], tmp_path: Path
) -> None:
    low, high = 300, 400
    (file, _) = write_export(
        Export(store, (Clip("town", low * S // 10, high * S // 10),)), tmp_path / "out", "xosc"
    )
    _, shown, _ = played(file.file)
    red, green = lamps(frames, 2), lamps(frames, 4)
    compared = 0
    for signal, changes in shown.items():
        times = [time for time, _ in changes]
        assert times == sorted(set(times))
        for row in range(low, high + 1):
            before = [state for time, state in changes if time <= (row - low) / 10 + 1e-9]
            if before and before[-1] in {"red", "green"}:
                assert red[signal][row] == (before[-1] == "red"), (signal, row)
                assert green[signal][row] == (before[-1] == "green"), (signal, row)
                compared += 1
    assert len({state for changes in shown.values() for _, state in changes}) >= 3
    assert compared > 300


def test_matches_of_the_library_are_valid_scenarios_and_driven_again_what_was_recorded(
    store: sgstore.Store, frames: list[Any], tmp_path: Path
) -> None:
    wanted, clips = (20 if LONG else 1), []
    for pattern in patterns().values():
        if pattern.kind == "scenario" and len(clips) < wanted:
            clips += list(store.find(pattern.written()).clips(1, 1))[:1]
    written = write_export(Export(store, tuple(clips)), tmp_path / "out", "xosc")
    files = [one.file for one in written if one.file.suffix == ".xosc"]

    assert len(clips) == len(files) == wanted
    assert faults(files) == []
    assert [one.file.name for one in written if one.holds == "maps"] == ["town.xodr"]
    for clip, file in zip(clips, files, strict=True):
        low = max(0, -(-clip.start_ns * 10 // S))  # a clip may begin before the recording
        compared, _, end = stands_as_recorded(file, store, frames, low)
        assert compared > 10 * end, file.name


# Recordings that lack something -----------------------------------------------------------------------


def test_who_comes_and_goes_and_what_is_not_known(tmp_path: Path) -> None:
    """A car is gone for three frames, another is there in one; no map, and a person without a size."""
    with Recorder(tmp_path / "drive.mcap") as recorder:
        for i in range(12):
            ego = car(7, 2.0 * i, v=(20, 0), yaw=3.1 if i < 6 else -3.1, name="Ego")
            ego.base.orientation.pitch, ego.base.orientation.roll = 0.1, -0.05
            moving = [ego, person(9, 10 + 0.1 * i, 4)]
            moving += [car(3, 5.0 + i, 3.5)] if not 4 <= i <= 6 else []
            moving += [car(5, 8.0, -3.5)] if i == 2 else []
            lights = [bulb(80 + c, c, 3 if c == 2 else 2, (25, -4, 3)) for c in (2, 3, 4)]
            houses = [house(50, 30.0)] if i == 0 else []
            recorder.ground_truth(0.1 * i, moving, host=7, lights=lights, houses=houses)
    ingest(tmp_path / "s.sgstore", [tmp_path / "drive.mcap"])
    with sgstore.open(tmp_path / "s.sgstore") as store:
        (one,) = write_export(Export(store, (Clip("drive", 0, 2 * S),)), tmp_path / "out", "xosc")
    found, _, end = played(one.file)
    by_name = {
        played.properties.get("sgstore.ident", name): played for name, played in found.items()
    }
    reasons = " | ".join(loss.reason for loss in one.losses)

    assert end == 1.1
    assert [np.round(by_name["3"].there, 6).tolist()] == [[[0.0, 0.4], [0.7, 1.1]]]
    assert np.round(by_name["5"].there, 6).tolist() == [[0.2, 0.3]]
    assert np.allclose(by_name["5"].middle(0.25), [8, -3.5, 0.75], atol=1e-3)
    assert np.allclose(by_name["Ego"].middle(0.5), [10, 0, 0.75], atol=1e-3)
    # Its heading goes over the half turn by the short way.
    assert np.allclose(by_name["Ego"].middle(0.55), [11, 0, 0.75], atol=0.01)
    assert np.allclose(by_name["50"].middle(0.3)[:2], [30, 0], atol=1e-3)
    assert "no OpenDRIVE map" in reasons
    assert "not a signal of the map" in reasons
    assert "the size of" in reasons
    assert faults([one.file]) == []
