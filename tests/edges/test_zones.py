"""Merge and departure zones, the disturbances of ISO 34502 in them, and broad markings beside lanes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import commonroad_scenarios as commonroad
import numpy as np
import pytest
from lanelet2_maps import LaneletMap
from library_scenes import ENTRY, EXIT, SCENES, WAYS, on
from opendrive_maps import a_map, a_road, lane, line, link, mark, section
from scenes import APART, Scene, along, ego, store_of
from thorough import LONG, some

from sgstore.errors import QueryError
from sgstore.lang.library import pattern_named, patterns
from sgstore.maps.lanelet2 import lanelet2_text
from sgstore.maps.map_files import read_map_file
from sgstore.maps.opendrive import read_map
from sgstore.maps.sumo_net import sumo_net_text
from sgstore.model.frame_ids import SEQ_BITS
from sgstore.pipeline.importing import import_graphs
from sgstore.readers import open_trace
from sgstore.temporal import Monitor
from sgstore.testsets.coverage import ChosenFrames, iso34502, selection_of

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.maps.roads import RoadMap
    from sgstore.query import Store

ZONES: Final = {"main": WAYS, "merge": ENTRY, "departure": EXIT}
"""Roads of two lanes, to whose right there is nothing, a lane that leads on, and one that leads off."""
ISO: Final = [name for name in patterns() if name.startswith("iso_")]
TRIED: Final = some(ISO, 7)


# The 24 disturbances ----------------------------------------------------------------------------------------


def scenes_of(name: str, zone: str) -> list[Scene]:
    """The drawn scenes of a pattern, found and not, on a road of a zone; there further to the right, too."""
    drawn = [on(scene, ZONES[zone]) for scene in SCENES[name] if scene is not None]
    further = [] if zone == "main" else [on(to_the_right(one), one.road) for one in drawn]
    return [*drawn, *further]


def to_the_right(scene: Scene) -> Scene:
    actors = (replace(a, route=tuple((x, y - 3.5) for x, y in a.route)) for a in scene.actors)
    return Scene(scene.road, *actors, seconds=scene.seconds, rate=scene.rate)


TRACES: Final = {f"{zone} {name}": scenes_of(name, zone) for zone in ZONES for name in TRIED}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    store = store_of(tmp_path_factory.mktemp("zones") / "s.db", TRACES)
    with store.file.snapshot():
        yield store


def test_there_are_eight_in_each_of_three_zones() -> None:
    choices = {pattern_named(name).parameters["zone"].choices for name in ISO}

    assert len(ISO) == 8
    assert choices == {("'any'", "'main'", "'merge'", "'departure'")}


@pytest.mark.parametrize("name", TRIED)
@pytest.mark.parametrize("zone", ["any", *ZONES])
def test_a_disturbance_is_found_in_its_zone_alone(store: Store, name: str, zone: str) -> None:
    intervals = store.find(pattern_named(name).written(zone=zone)).intervals()
    found = {(i.trace, int(i.start // APART)) for i in intervals if i.trace.endswith(f" {name}")}

    wanted = [one for one in ZONES if zone in {"any", one}]
    assert found == {
        (f"{one} {name}", number)
        for one in wanted
        for number in range(0, len(TRACES[f"{one} {name}"]), 2)
    }


@pytest.mark.parametrize(("name", "zone"), some([(n, z) for n in TRIED for z in ZONES], 7))
def test_a_monitor_finds_it_where_the_store_does(store: Store, name: str, zone: str) -> None:
    for number, scene in enumerate(TRACES[f"{zone} {name}"]):
        told: list[str] = []
        monitor = Monitor(
            pattern_named(name).written(zone=zone),
            scene.road,
            on_event=lambda event, told=told: told.append(event.kind),
        )
        sql = "SELECT frame_id FROM frames WHERE trace = ? AND t >= ? AND t < ? ORDER BY frame_id"
        span = [f"{zone} {name}", number * APART, (number + 1) * APART]
        for graph in store.file.graphs(store.file.arrays(sql, span)["frame_id"]):
            monitor.look([graph])
        monitor.finish()

        assert ("found" in told) == (number % 2 == 0)


def test_coverage_counts_each_disturbance_on_each_road(store: Store) -> None:
    cells, covered, missing = iso34502(ChosenFrames("all", store))

    assert len({(row["road"], row["ego"], row["other"]) for row in cells.dicts()}) == 24
    of_trace: dict[str, dict[str, set[str]]] = {}
    for row in cells.dicts():
        name, _, zone = row["pattern"].partition(" zone=")
        found = [*store.find(pattern_named(name).written(zone=zone)).intervals()]
        of_trace.setdefault(zone, {})[name] = {one.trace for one in found}
        assert (row["matches"], row["traces"]) == (len(found), len({one.trace for one in found}))
        assert row["state"] == ("covered" if found else "missing")
        assert row["unknown_traces"] == 0
    for trace in TRACES:
        zone, _, name = trace.partition(" ")
        assert trace in of_trace[zone][name]
    states = [row["state"] for row in cells.dicts()]
    assert (len(covered.rows), len(missing.rows)) == (
        states.count("covered"),
        24 - len(covered.rows),
    )


def test_a_selected_frame_counts_the_matches_that_end_there(store: Store) -> None:
    query = pattern_named(TRIED[0]).written(zone="merge")
    end, trace = max((i.end_seq, i.trace) for i in store.find(query).intervals())
    last = store.file.frame(f"{trace}#{end}").frame_id
    before = store.file.frame(f"{trace}#{end - 1}").frame_id
    assert last - (last >> SEQ_BITS << SEQ_BITS) > end  # ids have gaps

    for frame, matches in ((last, 1), (before, 0)):
        cells = iso34502(ChosenFrames("one", store, np.array([frame])))[0].dicts()
        (row,) = (row for row in cells if row["pattern"] == f"{TRIED[0]} zone=merge")
        assert (row["matches"], row["ego_frames"]) == (matches, 1)


def test_a_cell_without_the_data_of_its_pattern_is_unknown_and_not_0(tmp_path: Path) -> None:
    scene = SCENES["iso_cut_in"][0]
    assert scene is not None
    (tmp_path / "graph.csv").write_text("graph,src,relation,dst\na,ego,near,car_1\n")
    import_graphs(tmp_path / "graph.db", [tmp_path / "graph.csv"], "csv")
    beside = Scene(scene.road, ego(along(400), 5), seconds=2)
    cells = iso34502(selection_of(str(tmp_path / "graph.db")))[0]
    off = iso34502(ChosenFrames("off", store_of(tmp_path / "off.db", {"off": [beside]})))[0]
    store_of(tmp_path / "graph.db", {"cut-in": [scene]})
    partly = iso34502(selection_of(str(tmp_path / "graph.db")))[0]

    assert {(row["state"], row["matches"]) for row in cells.dicts()} == {("unknown", None)}
    assert [note.partition(":")[0] for note in cells.said[1:]] == ["graph is unknown"]
    assert {(row["state"], row["matches"]) for row in off.dicts()} == {("unknown", None)}
    assert off.said[1:] == ["off is unknown: the ego is on no lane of a map"]
    assert {row["unknown_traces"] for row in partly.dicts()} == {1}
    assert {row["state"] for row in partly.dicts()} == {"covered", "missing"}


def test_another_zone_is_refused(store: Store) -> None:
    with pytest.raises(QueryError, match="parameter 'zone' cannot be 'ramp'") as caught:
        pattern_named("iso_cut_in").written(zone="ramp")
    assert caught.value.hint == "expected one of 'any', 'main', 'merge', 'departure'"

    with pytest.raises(QueryError, match="parameter 'zone' cannot be 'ramp'"):
        store.find("MATCH iso_cut_in(zone = 'ramp')")


# Where maps have zones --------------------------------------------------------------------------------------


def ends_and_begins() -> RoadMap:
    """Two lanes to x = 400, one to 800, and two again: links say which goes on, types say nothing."""
    roads = [
        a_road(
            "1",
            line(400.0),
            sections=section(lane(0), lane(-1, after=-1), lane(-2)),
            links=link("successor", "road", "2", "start"),
        ),
        a_road(
            "2",
            line(400.0, x=400.0),
            sections=section(lane(0), lane(-1, before=-1, after=-1)),
            links=link("predecessor", "road", "1", "end") + link("successor", "road", "3", "start"),
        ),
        a_road(
            "3",
            line(400.0, x=800.0),
            sections=section(lane(0), lane(-1, before=-1), lane(-2)),
            links=link("predecessor", "road", "2", "end"),
        ),
    ]
    return read_map(a_map(*roads), "ends")


def on_lanelets() -> RoadMap:
    """The same as lanelets that become one at x = 400, and two at 800; they touch nowhere else."""
    m = LaneletMap()
    for begin, far, end in ((0, -30.0, 400), (1200, -30.0, 800)):
        for aside in (0.0, far):
            lines = [
                [(min(begin, end), y), (max(begin, end), y)]
                if not aside
                else sorted([(begin, y + aside), (end, y)])
                for y in (0.0, -3.5)
            ]
            m.lanelet(*(m.way(one, type="line_thin", subtype="solid") for one in lines))
    m.lanelet(*(m.way([(400, y), (800, y)], type="line_thin") for y in (0.0, -3.5)))
    return read_map(lanelet2_text(m.text()), "lanelets.osm")


def of_commonroad(path: Path) -> RoadMap:
    """Two lanelets, of which the right one is an access ramp, and two whose right one is an exit ramp."""
    text = ""
    for first, x, kind in ((1, 0, "accessRamp"), (3, 800, "exitRamp")):
        lines = [[(x, y), (x + 400, y)] for y in (0.0, -3.5, -7.0)]
        beside = '<adjacent{} ref="{}" drivingDir="same"/><laneletType>{}</laneletType>'
        text += commonroad.lanelet(first, *lines[:2], beside.format("Right", first + 1, "highway"))
        text += commonroad.lanelet(first + 1, *lines[1:], beside.format("Left", first, kind))
    whole = commonroad.scenario().replace(commonroad.lanes(), text).replace(commonroad.CROSSING, "")
    assert text in whole
    path.write_text(whole, encoding="utf-8")
    with open_trace(path) as trace:
        return read_map(trace.info.map_text, "commonroad")


def of_sumo() -> RoadMap:
    """An edge whose right lane is one to accelerate on."""
    lanes = "".join(
        f'<lane id="a_{i}" index="{i}" speed="30" shape="0,{y} 400,{y}"{more}/>'
        for i, y, more in ((0, -5.25, ' acceleration="1"'), (1, -1.75, ""))
    )
    text = f'<net><location netOffset="0,0"/><edge id="a" from="1" to="2">{lanes}</edge></net>'
    return read_map(sumo_net_text(text), "sumo.net.xml")


WHERE: Final = {
    # Where merge and departure zones are: 250 m before lanes end or become one, 250 m after they began.
    "links": ((150, 400), (800, 1050)),
    "lanelets": ((150, 400), (800, 1050)),
    "commonroad": ((0, 400), (800, 1200)),
    "sumo": ((0, 400), (0, 0)),
}
RAMP: Final = ((3, -31.5), (400, -1.75), (800, -1.75), (1197, -31.5))


def test_zones_are_where_maps_were_drawn_with_them(tmp_path: Path) -> None:
    maps = {
        "links": ends_and_begins(),
        "lanelets": on_lanelets(),
        "commonroad": of_commonroad(tmp_path / "c.xml"),
        "sumo": of_sumo(),
    }
    traces = {
        f"{name} {number}": [Scene(road, ego(way, 40), seconds=29.6, rate=5 if LONG else 2)]
        for name, road in maps.items()
        for number, way in enumerate(
            (along(-1.75, 3, 1197), RAMP if name == "lanelets" else along(-5.25, 3, 1197))
        )
    }
    store = store_of(tmp_path / "s.db", traces)
    text = (
        "MATCH (e:Ego) WHERE EXISTS {(e)-[:isIn]->(:Lane)} RETURN trace.name AS trace, e.x AS x,"
        " to_merge_zone(e) AS far, in_merge_zone(e) AS merge, in_departure_zone(e) AS departure"
    )
    rows = [row for row in store.find(text).rows() if 3 < row.x % 400 < 397]

    assert {row.trace for row in rows} == {*traces}
    for row in rows:
        merge, departure = WHERE[row.trace.split()[0]]
        assert row.merge == (merge[0] <= row.x < merge[1]), row
        assert row.departure == (departure[0] < row.x <= departure[1]), row
        far = max(merge[0] - row.x, 0)
        wanted = pytest.approx(far, abs=1.5) if far <= 200 and row.x < merge[1] else None
        assert row.far == wanted, row


def test_zones_of_soderleden_are_before_its_ramp_joins_the_road(data: Path) -> None:
    """Where lane 5/0/-1 and the road 2 become road 0, and where lane 1/0/-1 has ended."""
    road_map = read_map_file(data / "maps" / "soderleden.xodr")
    names = road_map.nodes.name

    zones = {(names[-1 - lane], what) for _, what, lane, *_ in road_map.places.rows()}

    assert {one for one in zones if one[1].endswith("_zone")} == {
        (name, "merge_zone")
        for name in ("1/0/-1", "2/0/-1", "2/0/-2", "2/1/-1", "2/1/-2", "5/0/-1")
    }


def test_a_crossing_is_no_zone(tmp_path: Path) -> None:
    crossing, _ = SCENES["NoSignalJunctionCrossing"]
    store = store_of(tmp_path / "s.db", {"crossing": [crossing]})

    assert len(store.find("MATCH (v:Car) WHERE in_zone(v, 'main')").rows()) > 50
    assert store.find("MATCH (v:Car) WHERE NOT in_zone(v, 'main')").rows() == []


def test_zones_are_unknown_on_no_lane_and_on_lanes_without_sections(tmp_path: Path) -> None:
    scenes = {
        "aside": [Scene(ENTRY, ego(along(-30.0), 10), seconds=1)],
        "merged": [Scene(ENTRY.without_sections, ego(along(-1.75), 10), seconds=1)],
    }
    store = store_of(tmp_path / "s.db", scenes)

    assert store.find("MATCH (e:Ego) WHERE EXISTS {(e)-[:isIn]->(:Lane)}").count() == 6
    for zone in ("main", "merge", "departure"):
        assert store.find(f"MATCH (e:Ego) WHERE NOT known(in_zone(e, '{zone}'))").count() == 12


# Broad markings ---------------------------------------------------------------------------------------------


def bold(drives: str = "RHT", *, centre: bool = False) -> RoadMap:
    """Two lanes to each side; the markings between those of a side are broad from x = 100 to 200."""
    marks = (mark("solid"), mark("solid", s=100, weight="bold"), mark("solid", s=200))
    lanes = [lane(0, *(marks if centre else (mark("broken"),)))]
    lanes += [lane(n, *(marks if abs(n) == 1 and not centre else ())) for n in (-1, -2, 1, 2)]
    return read_map(a_map(a_road("1", line(400.0), sections=section(*lanes), rule=drives)), "bold")


def broad(road_map: RoadMap) -> set[tuple[str, str, float, float]]:
    names = road_map.nodes.name
    return {
        (names[-1 - at], what.removeprefix("broad_line_"), round(start), round(end))
        for _, what, at, start, end in road_map.places.rows()
        if what.startswith("broad_line")
    }


def test_broad_markings_are_beside_the_lanes_that_were_drawn_with_them() -> None:
    ends = {
        -1: (100, 200),
        1: (200, 300),
    }  # along the lanes: those to the left are driven against s
    assert broad(bold()) == {
        (f"1/0/{sign * number}", side, *ends[sign])
        for sign in (1, -1)
        for number, side in ((1, "right"), (2, "left"))
    }
    assert broad(bold(centre=True)) == {(f"1/0/{sign}", "left", *ends[sign]) for sign in (1, -1)}
    assert broad(bold("LHT")) == {
        (f"1/0/{sign * number}", side, *ends[-sign])
        for sign in (1, -1)
        for number, side in ((1, "left"), (2, "right"))
    }


def test_broad_lines_of_lanelets_and_of_commonroad_are_read(tmp_path: Path) -> None:
    m = LaneletMap()
    ways = [
        m.way([(0, y), (100, y)], type=kind)
        for y, kind in ((7.0, "line_thin"), (3.5, "line_thick"), (0.0, "curbstone"))
    ]
    left, right = m.lanelet(ways[0], ways[1]), m.lanelet(ways[1], ways[2])
    assert broad(read_map(lanelet2_text(m.text()), "b.osm")) == {
        (left, "right", 0, 100),
        (right, "left", 0, 100),
    }

    text = commonroad.scenario().replace("dashed", "broad_dashed", 1)
    (tmp_path / "c.xml").write_text(text, encoding="utf-8")
    with open_trace(tmp_path / "c.xml") as trace:
        found = broad(read_map(trace.info.map_text, "commonroad"))
    assert found == {("1", "left", 0, 80)}


def test_who_passes_on_the_right_of_a_broad_marking_keeps_the_rule(tmp_path: Path) -> None:
    roads = {"bold": bold(), "thin": WAYS}
    scene, _ = SCENES["r_i2_passing_on_the_right"]
    traces = {name: [on(scene, road)] for name, road in roads.items()}
    traces["bold"] = [
        Scene(
            roads["bold"],
            *(replace(a, start=a.start + 105) for a in scene.actors),
            seconds=scene.seconds,
            rate=scene.rate,
        )
    ]
    store = store_of(tmp_path / "s.db", traces)
    text = pattern_named("r_i2_passing_on_the_right").text
    verdicts = {one.trace: one.verdict for one in store.check(text)}
    told: list[str] = []
    monitor = Monitor(text, roads["bold"], on_event=lambda event: told.append(event.kind))
    ids = store.file.arrays("SELECT frame_id FROM frames WHERE trace = 'bold' ORDER BY 1", [])
    for graph in store.file.graphs(ids["frame_id"]):
        monitor.look([graph])
    monitor.finish()

    assert verdicts == {"bold": "true", "thin": "false"}
    assert "violated" not in told
    crossed = "MATCH (e:Ego), (v:Vehicle) WHERE right_of_broad_line(e) AND left_of_broad_line(v)"
    assert {row.trace for row in store.find(f"{crossed} RETURN trace.name AS trace").rows()} == {
        "bold"
    }
