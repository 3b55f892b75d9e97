"""SUMO's floating-car data and networks; ``oracle_sumo.py`` compares them with SUMO itself."""

from __future__ import annotations

import gzip
import math
from typing import TYPE_CHECKING, Any

import pytest
from carla_recordings import idents, kinds, read, reasons, states
from sumo_recordings import NET, drive, export, step, vehicle
from test_lanelet2 import edges, row_of

import sgstore
from sgstore.errors import MapError, TraceError
from sgstore.ingest import recordings
from sgstore.maps.map_files import read_map_file
from sgstore.maps.sumo_net import sumo_net_text
from sgstore.model.vocabulary import VEHICLE_LIGHTS
from sgstore.readers import open_trace, read_message
from sgstore.readers.sumo import _file

if TYPE_CHECKING:
    from pathlib import Path


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def told(frame: dict[str, Any], ident: str, *names: str) -> list[float]:
    return [round(float(frame[ident][name]), 6) for name in names]


def test_steps_are_frames_with_the_middles_of_boxes_behind_the_bumpers(tmp_path: Path) -> None:
    info, blocks, report = read(written(tmp_path / "drive.fcd.xml", drive(30)))

    frames = states(blocks)
    assert (info.flavour, info.ego, len(frames), report.losses) == ("sumo", "", 30, [])
    assert kinds(blocks) == {"car": "car", "bus": "bus", "ped": "person"}
    assert told(frames[3], "car", "x", "y", "heading", "vx", "vy", "length") == [
        *(20.5, -4.8, 0.0, 10.0, 0.0, 5.0)
    ]
    assert told(frames[3], "bus", "x", "heading", "vx") == [53.0, round(-math.pi, 6), -10.0]
    assert told(frames[3], "ped", "y", "vy") == [round(-7.37 - 0.215 / 2, 6), 0.1]
    assert blocks[0].time_ns[:2].tolist() == [0, 100_000_000]


def test_what_a_step_tells_beyond_places_is_taken(tmp_path: Path) -> None:
    things = (
        vehicle("a", 1, 1, acceleration=-2.0, signals=0x2 | 0x8, z=4.0, length=4.0, height=2.0),
        vehicle("a", 5, 5, tag="person", type="ped"),
        vehicle("p", 9, 9, type="police@dist"),
        vehicle("b", 9, 1, tag="container"),
        vehicle("lorry1", 20, 1, type="my_lorry"),
    )
    path = written(tmp_path / "one.xml", export(step(7, *things), step(8)))

    _, blocks, _ = read(path)

    frame, empty = states(blocks)
    assert kinds(blocks) == {
        "a": "car",
        "person a": "person",
        "p": "car",
        "b": "prop",
        "lorry1": "truck",
    }
    assert told(frame, "a", "x", "z", "ax") == [-1.0, 5.0, -2.0]
    lit = {n for i, n in enumerate(VEHICLE_LIGHTS) if frame["a"]["lights"] >> i & 1}
    assert lit == {"light_left", "light_brake"}
    assert empty == {}


def test_a_long_file_is_read_in_pieces_and_a_step_is_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path / "drive.xml", drive(40))
    whole = read(path)
    monkeypatch.setattr(_file, "_PIECE", 77)
    monkeypatch.setattr("sgstore.readers._file.RUN_BYTES", 900)

    pieces = read(path)

    assert idents(pieces[1]) == idents(whole[1])
    assert [told(f, "car", "x") for f in states(pieces[1])] == [[17.5 + i] for i in range(40)]
    refs = whole[1][0].messages
    place = {"chunk_offset": -1, "offset": int(refs.offset[5]), "length": int(refs.length[5])}
    assert read_message(path, **place).startswith(b'<timestep time="0.50">')
    with pytest.raises(TraceError, match="the file was replaced"):
        read_message(path, **{**place, "offset": 3})


def test_a_file_that_is_cut_keeps_its_whole_steps_and_says_so(tmp_path: Path) -> None:
    text = drive(9)
    cut = written(tmp_path / "cut.xml", text[: text.index('time="0.60"') + 90])
    odd = written(
        tmp_path / "odd.xml", export(step(0, vehicle("a", 1, 1)), "<timestep><x/></timestep>")
    )

    assert read(cut)[2].frames == 6
    assert "ends inside a time step" in reasons(read(cut)[2])
    assert "without a time" in reasons(read(odd)[2])


PHASES = '<phase duration="9" state="GG"/>'
TLS = """<tlsStates>
    <tlsState time="0.00" id="J" programID="0" phase="0" state="Gr"/>
    <tlsState time="0.20" id="J" programID="0" phase="0" state="Gr"/>
    <tlsState time="0.30" id="J" programID="0" phase="1" state="yo"/>
</tlsStates>
"""


def test_lights_show_what_the_file_beside_says(tmp_path: Path) -> None:
    net = written(
        tmp_path / "town.net.xml", NET.replace(PHASES, f'{PHASES}<phase duration="3" state="yr"/>')
    )
    steps = (step(i / 10, vehicle("car", 80 + i, -4.8)) for i in range(6))
    fcd = written(tmp_path / "drive.fcd.xml", export(*steps))
    written(tmp_path / "drive.tls.xml", TLS)
    store = sgstore.open(tmp_path / "drives.sgstore", create=True)
    store.ingest(fcd, road_map=net, egos=["car"])
    lit = store.sql("SELECT DISTINCT ident, light_state FROM nodes WHERE light_state IS NOT NULL")
    rows = store.find(
        "MATCH (t:TrafficLight)-[:controlsTrafficOf]->(l:Lane)"
        " RETURN frame.seq, t.light_state, l.name"
    ).rows()

    assert sorted(lit.values) == [
        *(("light J/0", "green"), ("light J/0", "yellow")),
        *(("light J/1", "flashing"), ("light J/1", "red")),
    ]
    assert set(map(tuple, rows)) == {
        (seq, shown[seq > 2], lane)
        for seq in range(6)
        for lane, shown in ((":J_0_0", ("green", "yellow")), (":J_1_0", ("red", "flashing")))
    }
    written(tmp_path / "drive.tls.xml", TLS.replace("tlsStates", "routes"))
    with pytest.raises(TraceError, match="expected <tlsStates>"):
        open_trace(fcd)


def test_sizes_of_vehicles_come_from_their_types_or_a_warning_follows(tmp_path: Path) -> None:
    kinds_of = {"a": "sedan", "b": "liner", "c": "odd", "d": "DEFAULT_VEHTYPE", "e": "liner"}
    things = [vehicle(one, 9 * i, 0, type=kind) for i, (one, kind) in enumerate(kinds_of.items())]
    things[4] = vehicle("e", 50, 0, type="liner@x", length=7.0)
    path = written(tmp_path / "drive.fcd.xml", export(step(0, *things)))
    _, blocks, report = read(path)

    assert told(states(blocks)[0], "d", "length", "width") == [5.0, 1.8]
    assert [warning.split("'")[1] for warning in report.warnings if "no size" in warning] == [
        *("liner", "odd", "sedan")
    ]
    types = (
        '<vType id="sedan" length="4.1" width="1.7"/><vType id="liner" vClass="bus" length="18"/>'
    )
    written(tmp_path / "drive.rou.xml", f"<routes>{types}</routes>")
    _, blocks, report = read(path)

    frame = states(blocks)[0]
    assert [told(frame, one, "length", "width") for one in "abe"] == [
        *([4.1, 1.7], [18.0, 2.5], [7.0, 2.5])
    ]
    assert kinds(blocks)["b"] == "bus"
    assert [warning for warning in report.warnings if "'liner'" in warning] == []
    written(tmp_path / "drive.rou.xml", "<routes>")
    with pytest.raises(TraceError, match="vehicle types cannot be read"):
        open_trace(path)


def test_files_in_gzip_are_read_as_they_are(tmp_path: Path) -> None:
    plain = written(tmp_path / "drive.fcd.xml", drive(20))
    packed, net = tmp_path / "packed.fcd.xml.gz", tmp_path / "town.net.xml.gz"
    packed.write_bytes(gzip.compress(drive(20).encode()))
    net.write_bytes(gzip.compress(NET.encode()))

    whole, again = read(plain), read(packed)
    assert repr(states(whole[1])) == repr(states(again[1]))
    refs = again[1][0].messages
    place = {"chunk_offset": -1, "offset": int(refs.offset[5]), "length": int(refs.length[5])}
    assert read_message(packed, **place).startswith(b'<timestep time="0.50">')
    assert edges(read_map_file(net), "travelsTo") >= {("A_1", ":J_0_0")}
    assert packed in recordings([tmp_path])
    packed.write_bytes(gzip.compress(drive(600).encode())[:-30])
    assert "the compressed file is damaged" in reasons(read(packed)[2])


def test_a_folder_has_recordings_of_sumo_but_not_its_other_files(tmp_path: Path) -> None:
    fcd = written(tmp_path / "drive.xml", drive(3))
    written(tmp_path / "town.net.xml", NET)
    written(tmp_path / "routes.xml", "<routes/>")

    assert recordings([tmp_path]) == [fcd]


def test_a_network_is_a_road_map(tmp_path: Path) -> None:
    road_map = read_map_file(written(tmp_path / "town.net.xml", NET))

    nodes = road_map.nodes
    assert edges(road_map, "travelsTo") == {
        *(("A_1", ":J_0_0"), (":J_0_0", "C_0"), ("A_2", ":J_1_0"), (":J_1_0", "D_0"))
    }
    assert {("A_2", "A_1"), ("A_1", "A_0")} <= edges(road_map, "toLeftOf")
    assert ("A_2", "B_0") in edges(road_map, "opposes")
    assert edges(road_map, "laneChange") == {("A_1", "A_2"), ("A_2", "A_1")}
    types = {name: kind for name, kind in zip(nodes.name, nodes.lane_type, strict=True) if kind}
    assert (types["A_0"], types["A_1"], types["B_0"]) == ("sidewalk", "driving", "bus")
    assert nodes.speed_limit[row_of(road_map, "A_1", "lane")] == 13.89
    assert nodes.junction[row_of(road_map, ":J_1_0", "lane")] == "J"
    crossing = row_of(road_map, ":J_c0_0", "crosswalk")
    assert road_map.outlines()[crossing].bounds == (94.0, -8.0, 98.0, 1.0)
    assert edges(road_map, "controlsTrafficOf") == {("J", ":J_0_0"), ("J", ":J_1_0")}
    assert road_map.warnings == ()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<net ", "not XML"),
        ("<net/>", "without lanes"),
        ("<routes/>", "expected <net>"),
        (NET.replace("<net ", "<!DOCTYPE net []><net "), "document type declaration"),
    ],
)
def test_what_is_no_network_is_refused(text: str, reason: str) -> None:
    with pytest.raises(MapError, match=reason):
        sumo_net_text(text)


def test_a_drive_and_its_network_make_scene_graphs(tmp_path: Path) -> None:
    net = written(tmp_path / "town.net.xml", NET)
    store = sgstore.open(tmp_path / "drives.sgstore", create=True)
    store.ingest(written(tmp_path / "drive.xml", drive(12)), road_map=net, egos=["car"])

    rows = store.find("MATCH (p:Person)-[:isIn]->(l:Lane) RETURN p.ident AS who, l.name AS lane")

    assert [(row.who, row.lane) for row in rows] == [("ped", "A_0")] * 12
    with open_trace(tmp_path / "drive.xml", ego="bus") as trace:
        assert next(trace.blocks()).ego[0] >= 0
