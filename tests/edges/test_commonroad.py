"""CommonRoad scenarios: what they tell, beside the standard library's tree; damage, clips, folders."""

from __future__ import annotations

import math
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import shapely
from commonroad_scenarios import CAR, HEAD, LIGHT, as_mcap, dynamic, lanelet, lanes, scenario, state
from test_export_mcap import cut
from thorough import some

import sgstore
from sgstore.apps.cli import run
from sgstore.errors import StoreError, TraceError
from sgstore.ingest import recordings
from sgstore.maps.opendrive import read_map
from sgstore.model.vocabulary import KIND_CODE, KINDS
from sgstore.model.world import FrameBlock, TraceReport
from sgstore.readers import open_recording, open_trace, read_message

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap
    from sgstore.readers import CommonRoadFile

DATA = Path(os.environ.get("SGSTORE_DATA") or Path(__file__).parents[3] / "shared/data")
SCENARIOS = sorted((DATA / "commonroad").glob("*.xml"))
needs_data = pytest.mark.skipif(not SCENARIOS, reason=f"no scenarios in {DATA / 'commonroad'}")


@pytest.fixture
def made(tmp_path: Path) -> Path:
    path = tmp_path / "drive.xml"
    path.write_text(scenario())
    return path


def read(path: Path, ego: str = "") -> tuple[Any, list[FrameBlock], TraceReport]:
    with open_trace(path, ego=ego) as trace:
        return trace.info, list(trace.blocks()), trace.report


def states(blocks: list[FrameBlock]) -> dict[tuple[str, int], dict[str, float]]:
    """Columns by id and time in ns."""
    idents = [ident for block in blocks for ident in block.entities.ident]
    found: dict[tuple[str, int], dict[str, float]] = {}
    for block in blocks:
        for frame, time in enumerate(block.time_ns.tolist()):
            for row in range(*block.offsets[frame : frame + 2].tolist()):
                told = {
                    name: getattr(block.states, name)[row].item()
                    for name in block.states.__dataclass_fields__
                    if name != "own"
                }
                found[idents[int(told["node"])], time] = told
    return found


# What a scenario tells ----------------------------------------------------------------------------


def test_obstacles_drive_as_they_are_told(made: Path) -> None:
    info, blocks, report = read(made)
    found = states(blocks)

    assert info.flavour == "commonroad"
    assert report.frames == 25
    assert report.losses == []
    assert report.warnings == ["no frame has an ego"]
    assert {ident for ident, _ in found} == {"100", "101", "102", "30"}
    car, late = found["100", 700_000_000], found["101", 800_000_000]
    assert [car[name] for name in ("x", "y", "heading", "vx", "vy")] == [9, 0, 0, 10, 0]
    assert [car[name] for name in ("ax", "ay", "yaw_rate")] == pytest.approx([0.5, 1.0, 0.1])
    assert (car["length"], car["width"]) == (4.5, 1.9)
    assert (car["lights"], found["100", 0]["lights"]) == (1, -1)
    assert ("101", 700_000_000) not in found
    assert (late["vx"], late["vy"]) == pytest.approx((5 * math.cos(3.1), 5 * math.sin(3.1)))
    person = found["102", 0]
    assert (person["length"], person["width"]) == pytest.approx((0.6, 0.6))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> sgstore.Store:
    path = tmp_path_factory.mktemp("commonroad") / "drive.xml"
    path.write_text(scenario())
    store = sgstore.open(path.with_suffix(".sgstore"), create=True)
    store.ingest(path)
    return store


def test_kinds_and_what_stands(drive: sgstore.Store) -> None:
    kinds = drive.sql("SELECT ident, kind, subkind, is_static FROM entities ORDER BY ident::INT")
    assert kinds.values == [
        ("20", "speed_limit", "50", True),
        ("30", "traffic_light", None, False),
        ("50", "vehicle", "parked", True),
        ("100", "car", None, False),
        ("101", "truck", None, False),
        ("102", "person", None, False),
    ]


def test_lights_go_round(drive: sgstore.Store) -> None:
    sql = "SELECT light_state FROM nodes WHERE kind = 'traffic_light' ORDER BY frame_id"
    shown = [row[0] for row in drive.sql(sql).values if row[0] is not None]
    cycle = ["red"] * 5 + ["red_yellow"] * 2 + ["green"] * 6 + ["yellow"] * 3

    assert shown == [cycle[(step - 4) % 16] for step in range(25)]


def road_map(path: Path) -> RoadMap:
    with open_trace(path) as trace:
        return read_map(trace.info.map_text, trace.info.map_name)


def test_lanelets_are_a_road_map(made: Path) -> None:
    found = road_map(made)
    nodes = found.nodes
    row = {name: i for i, name in reversed([*enumerate(nodes.name)])}  # roads come behind lanes
    edges = {
        (relation, nodes.name[-1 - src], nodes.name[-1 - dst])
        for relation, src, dst in _edges(found)
    }

    assert found.name == "ZAM_Test-1_1_T-1 (lanes)"
    assert nodes.lane_type[row["1"]] == "driving"
    assert nodes.speed_limit[row["1"]] == pytest.approx(50 / 3.6)
    assert math.isnan(nodes.speed_limit[row["2"]])
    assert nodes.kind[row["8"]] == KIND_CODE["crosswalk"]
    places = found.places
    at = {
        (nodes.name[part], what): start
        for part, what, start in zip(
            places.part.tolist(), places.what, places.start.tolist(), strict=True
        )
    }
    assert at["stop line of 1", "stop_line"] == pytest.approx(76)
    assert at["30", "traffic_light"] == pytest.approx(76)
    assert nodes.junction[row["3"]] == "40"
    assert nodes.length[row["1"]] == pytest.approx(80)
    assert nodes.width[row["1"]] == pytest.approx(3.5)
    assert ("travelsTo", "1", "3") in edges
    assert {("laneChange", "1", "2"), ("laneChange", "2", "1"), ("toLeftOf", "2", "1")} <= edges
    assert ("controlsTrafficOf", "30", "1") in edges
    assert ("controlsTrafficOf", "20", "1") in edges


def _edges(found: RoadMap) -> list[tuple[str, int, int]]:
    from sgstore.model.vocabulary import RELATIONS

    edges = found.edges
    columns = (edges.relation.tolist(), edges.src.tolist(), edges.dst.tolist())
    return [(str(RELATIONS[r]), s, d) for r, s, d in zip(*columns, strict=True)]


@pytest.mark.parametrize(
    ("code", "value", "kind", "subkind"),
    [
        ("274", 50 / 3.6, "speed_limit", "50"),
        ("274.1", 30 / 3.6, "speed_limit", "zone 30"),
        ("R2-1", 11.176, "speed_limit", "25 mph"),
        ("C43", 90 / 3.6, "speed_limit", "90"),
        ("206", math.nan, "stop_sign", ""),
        ("205", math.nan, "yield_sign", ""),
        ("306", math.nan, "sign", "306"),
        ("274", math.nan, "sign", "274"),
    ],
)
def test_signs_mean_what_their_codes_say(
    tmp_path: Path, code: str, value: float, kind: str, subkind: str
) -> None:
    plate = f"<additionalValue>{value}</additionalValue>" if value == value else ""  # noqa: PLR0124
    text = re.sub(
        "<trafficSignID>274<(.*?)</additionalValue>",
        f"<trafficSignID>{code}</trafficSignID>{plate}",
        scenario(frames=9),
    )
    path = tmp_path / "signs.xml"
    path.write_text(text)
    _, blocks, _ = read(path)
    row = blocks[0].entities.ident.index("20")

    assert KINDS[blocks[0].entities.kind[row]] == kind
    assert blocks[0].entities.subkind[row] == subkind


def test_an_obstacle_can_be_the_ego(made: Path) -> None:
    _, blocks, report = read(made, ego="100")

    assert all((block.ego >= 0).all() for block in blocks)
    assert report.warnings == []
    with pytest.raises(TraceError, match="no entity that moves has the id '999'"):
        read(made, ego="999")


def test_shapes_beside_their_reference_point(tmp_path: Path) -> None:
    off = (
        "<rectangle><length>4</length><width>2</width><orientation>0.5</orientation>"
        "<center><x>1</x><y>0.5</y></center></rectangle>"
    )
    corners = ((-1, -2), (3, -2), (3, 1))
    polygon = "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in corners)
    turned = math.pi / 2
    path = tmp_path / "shapes.xml"
    path.write_text(
        HEAD.format(name="A", version="2020a")
        + dynamic(1, "car", off, [state(0, 10, 20, turned, 2), state(1, 10, 20.2, turned, 2)])
        + dynamic(2, "car", f"<polygon>{polygon}</polygon>", [state(0, 0, 0, 0, 0)])
        + "</commonRoad>"
    )
    found = states(read(path)[1])

    box = [found["1", 0][name] for name in ("x", "y", "heading", "length", "width")]
    assert box == pytest.approx([9.5, 21, turned + 0.5, 4, 2])
    assert (found["1", 0]["vx"], found["1", 0]["vy"]) == pytest.approx((0, 2))
    box = [found["2", 0][name] for name in ("x", "y", "length", "width")]
    assert box == pytest.approx([1, -0.5, 4, 3])


def test_a_slip_angle_turns_the_velocity_and_not_the_box(tmp_path: Path) -> None:
    slip = "<slipAngle><exact>0.2</exact></slipAngle>"
    path = tmp_path / "slips.xml"
    path.write_text(
        HEAD.format(name="A", version="2018b")
        + dynamic(1, "car", CAR, [state(0, 0, 0, 0.3, 10, slip)]).replace("dynamicO", "o")
        + "</commonRoad>"
    )
    (found,) = states(read(path)[1]).values()

    assert (found["vx"], found["vy"]) == pytest.approx((10 * math.cos(0.5), 10 * math.sin(0.5)))
    assert found["heading"] == pytest.approx(0.3)


# The container ------------------------------------------------------------------------------------


def test_every_message_is_read_back_by_its_place(made: Path) -> None:
    recording: CommonRoadFile
    with open_recording(made) as recording:  # type: ignore[assignment]
        count = 0
        for run in recording.walk(TraceReport()):
            for row in range(len(run)):
                place = {"offset": int(run.offset[row]), "length": int(run.length[row])}
                assert read_message(made, chunk_offset=-1, **place) == bytes(run.data(row))
                count += 1
        assert count == sum(recording.counts.values()) == 26
    with pytest.raises(TraceError, match="no message of 7 bytes at 3 there: the file was replaced"):
        read_message(made, chunk_offset=-1, offset=3, length=7)
    with pytest.raises(TraceError, match="the file was replaced"):
        read_message(made, chunk_offset=-1, offset=99, length=7)


def test_a_recording_of_the_messages_is_the_same_drive(made: Path, tmp_path: Path) -> None:
    clip = as_mcap(tmp_path / "drive.mcap", made)

    assert str(states(read(clip)[1])) == str(states(read(made)[1]))
    assert read(clip)[0].map_text == read(made)[0].map_text
    assert read(clip)[0].map_name == read(made)[0].map_name


def test_a_clip_brings_the_map_and_what_stands(made: Path, tmp_path: Path) -> None:
    (clip,) = cut(made, tmp_path / "clips", (1.0, 1.5))
    info, blocks, report = read(clip)
    whole = states(read(made)[1])

    assert report.frames == 6
    assert report.losses == []
    assert info.map_text == read(made)[0].map_text
    assert sum(len(block.scenery) for block in blocks) == 2
    for (ident, time), row in states(blocks).items():
        wanted = whole[ident, time]
        assert [row[k] for k in ("x", "y", "vx")] == [wanted[k] for k in ("x", "y", "vx")]


def test_a_folder_gives_its_scenarios_and_no_other_xml(made: Path) -> None:
    (made.parent / "other.xml").write_text("<OpenSCENARIO/>")

    assert recordings([made.parent]) == [made]
    made.unlink()
    with pytest.raises(StoreError, match=r"no recording \(\.mcap, \.osi, .*\.xml, \.xml\.gz\)"):
        recordings([made.parent])


# Damage -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        pytest.param(("2020a", "2099z"), "version '2099z'; versions 2018b and 2020a", id="version"),
        pytest.param(('timeStepSize="0.1"', ""), "timeStepSize ''", id="no step"),
        pytest.param(("</commonRoad>", ""), "not XML: no element found", id="cut"),
        pytest.param(
            ("<commonRoad ", "<!DOCTYPE x [<!ENTITY a 'b'>]><commonRoad "),
            "a document type",
            id="entity",
        ),
        pytest.param(("<type>car", "<type>" + "<a>" * 70), "nested more than 64", id="deep"),
        pytest.param(("<type>car", "<type>" + "c" * 2000), "more than 1000 characters", id="long"),
    ],
)
def test_what_is_no_scenario_is_refused(made: Path, wrong: tuple[str, str], said: str) -> None:
    made.write_text(made.read_text().replace(*wrong, 1))

    with pytest.raises(TraceError, match=re.escape(said)):
        open_trace(made)


def test_what_is_unsound_is_left_out_and_named(tmp_path: Path) -> None:
    good = state(0, 0, 0, 0, 1)
    course = [
        good,
        state(1, 1, 0, 0, 1),
        state(1, 2, 0, 0, 1),
        good.replace("<time><exact>0", "<time><exact>nan"),
    ]
    may_be = "<occupancySet><occupancy/></occupancySet>"
    path = tmp_path / "odd.xml"
    path.write_text(
        HEAD.format(name="A", version="2020a")
        + dynamic(1, "car", CAR, course)
        + dynamic(1, "car", CAR, [good])
        + dynamic(2, "car", CAR.replace("4.5", "-1"), [good])
        + dynamic(3, "car", "<cone/>", [good])
        + dynamic(4, "car", CAR, [good], may_be)
        + lanelet(9, [(0, 0)], [(0, 1), (5, 1)])
        + "</commonRoad>"
    )
    _, blocks, report = read(path)

    assert [loss.reason for loss in report.losses] == [
        "dynamicObstacle 1: there are two states at step 1; the first one counts",
        "dynamicObstacle 1: time 'nan' is not a number",
        "dynamicObstacle 1: there are two of this id; the first one counts",
        "dynamicObstacle 2: length -1.0 m of a shape",
        "dynamicObstacle 3: an unknown shape, cone",
        "dynamicObstacle 4: it has a set of places where it may be, and no trajectory: its first state counts",
        "lanelet 9: its borders need at least two points each",
    ]
    assert sorted(states(blocks)) == [("1", 0), ("1", 100_000_000), ("4", 0)]


def test_cuts_and_flips_end_in_an_error_or_in_losses(made: Path) -> None:
    text = made.read_bytes()
    rng = np.random.default_rng(5)
    cuts = some([text[:size] for size in range(0, len(text), 97)], 11)
    flips = []
    for _ in range(40):
        data = bytearray(text)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(32, 127)
        flips.append(bytes(data))
    for data in (*cuts, *flips):
        made.write_bytes(data)
        try:
            read(made)
        except TraceError as error:
            told = str(error)
            assert told.startswith(str(made))


# Real scenarios, beside a tree --------------------------------------------------------------------


def told(node: ET.Element, path: str) -> float:
    return float(node.findtext(f"{path}/exact") or "nan")


@needs_data
@pytest.mark.parametrize(
    "path", some(SCENARIOS, 7) if SCENARIOS else [], ids=lambda path: path.stem
)
def test_a_real_scenario_is_read_as_it_stands(path: Path) -> None:
    root = ET.parse(path).getroot()
    step = float(root.attrib["timeStepSize"])
    moving = [*root.findall("dynamicObstacle"), *root.findall("obstacle")]
    info, blocks, report = read(path)
    found = states(blocks)
    seen = set()
    for one in moving:
        for at in (one.find("initialState"), *one.findall("trajectory/state")):
            assert at is not None
            row = found[one.attrib["id"], round(told(at, "time") * step * 1e9)]
            x, y = (float(at.findtext(f"position/point/{axis}") or "nan") for axis in "xy")
            heading, speed = told(at, "orientation"), told(at, "velocity")
            assert (row["x"], row["y"]) == pytest.approx((x, y), abs=1e-9)
            assert math.hypot(row["vx"], row["vy"]) == pytest.approx(abs(speed))
            assert math.cos(row["heading"] - heading) == pytest.approx(1)
            seen.add((one.attrib["id"], told(at, "time")))
    lights = len(root.findall("trafficLight"))
    assert len(seen) == report.states - report.frames * lights
    assert len(report.losses) == len(root.findall(".//occupancySet"))

    lanelets = {one.attrib["id"]: one for one in root.findall("lanelet")}
    road = read_map(info.map_text, info.map_name)
    outlines = dict(reversed([*zip(road.nodes.name, road.outlines(), strict=True)]))
    flows = {(s, d) for r, s, d in _edges(road) if r == "travelsTo"}
    names = road.nodes.name
    for ident, one in lanelets.items():
        sides = [
            [
                (float(p.findtext("x") or 0), float(p.findtext("y") or 0))
                for p in one.findall(f"{side}/point")
            ]
            for side in ("leftBound", "rightBound")
        ]
        if "crosswalk" in [kind.text for kind in one.findall("laneletType")]:
            assert road.nodes.kind[names.index(ident)] == KIND_CODE["crosswalk"]
        area = shapely.Polygon([*sides[0], *reversed(sides[1])]).buffer(0)
        drawn = outlines[ident]
        assert drawn.symmetric_difference(area).area < 0.02 * area.area + 1.0
        onto = {names[-1 - d] for s, d in flows if names[-1 - s] == ident}
        assert onto <= {ref.attrib["ref"] for ref in one.findall("successor")}
    assert len(flows) >= 0.9 * len(root.findall("lanelet/successor"))


@needs_data
def test_real_scenarios_are_ingested_and_asked(tmp_path: Path) -> None:
    path = next(one for one in SCENARIOS if one.stem.startswith("USA_Lanker"))
    store = sgstore.open(tmp_path / "lanker.sgstore", create=True)
    store.ingest(path)

    assert len([*store.find("MATCH (a:Car)-[:isIn]->(l:Lane)")]) > 500
    assert len([*store.find("MATCH (l:TrafficLight)-[:controlsTrafficOf]->(x:Lane)")]) > 0
    ((states,),) = store.sql(
        "SELECT count(DISTINCT light_state) FROM nodes WHERE kind = 'traffic_light'"
    ).values
    assert states >= 2


def test_a_scenario_without_obstacles_is_a_map_and_one_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = HEAD.format(name="ZAM_Empty-1_1_T-1", version="2020a") + lanes() + LIGHT
    path = tmp_path / "empty.xml"
    path.write_text(f"<!-- by hand -->\n{text}</commonRoad>", encoding="utf-8")

    info, blocks, report = read(path)
    assert (sum(len(block.time_ns) for block in blocks), report.losses) == (1, [])
    assert info.map_text
    assert run(["map", str(path), "--json"]) == 0
    assert '"lane"' in capsys.readouterr().out
