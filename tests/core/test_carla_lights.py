"""Which signal of its town each traffic light of CARLA is, by LibCarla's own landmarks.

The wheel's ``carla.Map`` knows where the simulator puts each light, and under which id: lights are put there,
shuffled, shifted, left out and made up, and must come back as what they are.
"""

from __future__ import annotations

import math
import re
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest

carla = pytest.importorskip("carla", reason="the carla wheel is not installed")

from carla_recordings import HERO, Bridge, light, read, vehicle  # noqa: E402
from mcap.reader import make_reader  # noqa: E402
from opendrive_maps import a_map, a_road, element, lane, line, section  # noqa: E402
from recordings import OSI  # noqa: E402
from standin_carla import StandInActor, StandInWorld, box, transform  # noqa: E402

import sgstore  # noqa: E402
from sgstore.apps.record import record  # noqa: E402
from sgstore.ingest import ingest  # noqa: E402
from sgstore.maps.opendrive import read_map  # noqa: E402
from sgstore.model.config import Config  # noqa: E402
from sgstore.readers import LiveWorld  # noqa: E402
from sgstore.temporal import opened  # noqa: E402

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(12)

TOWNS = {
    "Town01": ("maps/Town01.xodr", 36),
    "Town02": ("maps/Town02.xodr", 24),
    "Town07": ("maps/Town07.xodr", 17),
    "Town04": ("traces/esmini/swarm_Town04.mcap", 43),
    "Town10HD": ("traces/sumo/Town10HD_sumo_osi.mcap", 17),
}
"""Where the map of a town stands, and how many lights it has: 137 in all."""
RED, GREEN = 0, 2
CROSSWISE = math.pi / 2
"""CARLA's actors are turned by it, to the right, against their signals; rad."""


class Lamp(NamedTuple):
    """A light where LibCarla has it, in our axes."""

    signal: str
    x: float
    y: float
    z: float
    heading: float

    def at(self, ahead: float, left: float) -> tuple[float, float]:
        """Moved in its own axes; m."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return self.x + ahead * cos - left * sin, self.y + ahead * sin + left * cos


class Town(NamedTuple):
    text: str
    lamps: list[Lamp]
    lanes: dict[str, set[str]]
    """Signal → road and number of the driving lanes that LibCarla says it is valid for."""


@cache
def town_of(path: Path) -> Town:
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            told = make_reader(file).iter_messages(topics=["ground_truth_map"])
            message = next(message for _, _, message in told)
        text = str(OSI.MapAsamOpenDrive.FromString(message.data).open_drive_xml_content)
    else:
        text = path.read_text(encoding="utf-8")
    # LibCarla mixes up a road and a junction of one id: junctions get ids of their own.
    ids = r'(<junction\b[^>]*? id="|elementType="junction" elementId="|\bjunction=")(\d+)'
    text = re.sub(ids, r"\g<1>77\2", text)
    lamps: dict[str, Lamp] = {}
    lanes: dict[str, set[str]] = {}
    for mark in carla.Map("town", text).get_all_landmarks_of_type("1000001"):
        of = mark.transform
        place = of.location.x, -of.location.y, of.location.z
        lamps[mark.id] = Lamp(mark.id, *place, -math.radians(of.rotation.yaw))
        lanes.setdefault(mark.id, set()).update(
            f"{mark.road_id}_{number}"
            for low, high in mark.get_lane_validities()
            for number in range(low, high + 1)
            if number
        )
    return Town(text, [lamps[name] for name in sorted(lamps)], lanes)


@pytest.fixture(params=[pytest.param(name, marks=pytest.mark.data) for name in TOWNS])
def town(request: pytest.FixtureRequest) -> Town:
    data = request.getfixturevalue("data")
    name, count = TOWNS[request.param]
    found = town_of(data / name)
    assert len(found.lamps) == count
    return found


def told(ident: int, lamp: Lamp, *, ahead: float = 0.0, left: float = 0.0, turned: float = 0.0):
    """A light as the bridge tells it."""
    return light(ident, *lamp.at(ahead, left), lamp.heading - turned, z=lamp.z)


def signals(path: Path, text: str, lights: list[dict]) -> dict[str, str]:
    """What a recording says that its lights are."""
    with Bridge(path) as bridge:
        bridge.world(text)
        bridge.light_places(lights)
        bridge.objects(0.0, [vehicle(1)])
    blocks = read(path)[1]
    of = blocks[0].entities
    return {i: ref for i, ref in zip(of.ident, of.map_ref, strict=True) if i != "1"}


def shuffled(lamps: list[Lamp], seed: int) -> dict[int, Lamp]:
    """Lights by ids that say nothing of their order in the map."""
    rng = np.random.default_rng(seed)
    idents = rng.choice(10_000, len(lamps), replace=False) + 100
    return dict(zip(idents.tolist(), lamps, strict=True))


@pytest.mark.parametrize("turned", [0.0, CROSSWISE], ids=["as landmarks", "as actors"])
def test_every_light_of_a_town_is_its_own_signal(town: Town, turned: float, tmp_path: Path) -> None:
    lamps = shuffled(town.lamps, 1)
    lights = [told(i, lamp, turned=turned) for i, lamp in lamps.items()]

    found = signals(tmp_path / "r.mcap", town.text, lights)

    assert found == {str(i): lamp.signal for i, lamp in lamps.items()}


@pytest.mark.parametrize(
    ("ahead", "left"), [(0.4, -0.5), (-0.25, 0.3), (0.05, 0.05), (-0.9, 0.1), (1.5, -2.5)]
)
def test_lights_that_all_stand_elsewhere_are_their_own_signals(
    town: Town, ahead: float, left: float, tmp_path: Path
) -> None:
    lamps = shuffled(town.lamps, 2)
    rng = np.random.default_rng(3)
    lights = [
        told(i, lamp, ahead=ahead + rng.normal(0, 0.003), left=left + rng.normal(0, 0.003))
        for i, lamp in lamps.items()
    ]

    found = signals(tmp_path / "r.mcap", town.text, lights)

    assert found == {str(i): lamp.signal for i, lamp in lamps.items()}


@pytest.mark.parametrize("seed", range(3))
def test_lights_that_are_left_out_or_made_up_leave_the_others_as_they_are(
    town: Town, seed: int, tmp_path: Path
) -> None:
    rng = np.random.default_rng(seed)
    lamps = {i: lamp for i, lamp in shuffled(town.lamps, seed).items() if rng.random() < 0.6}
    lights = [told(i, lamp) for i, lamp in lamps.items()]
    some = next(iter(lamps.values()))
    made_up = {
        20_001: told(1, some, ahead=0.5),  # in front of one that is there
        20_002: light(1, some.x + 400, some.y - 700, 1.0),
        20_003: light(1, math.nan, math.nan),
        20_004: light(1, some.x, some.y, math.nan),
    }
    lights += [one | {"id": i} for i, one in made_up.items()]
    rng.shuffle(lights)

    found = signals(tmp_path / "r.mcap", town.text, lights)

    theirs = {i: name for i, name in found.items() if int(i) > 20_000 and name}
    assert {i: found[str(i)] for i in lamps} == {i: lamp.signal for i, lamp in lamps.items()}
    assert len({name for name in found.values() if name}) == len(lamps) + len(theirs)


def test_lanes_show_what_their_own_lights_show(town: Town, tmp_path: Path) -> None:
    """Twins of different colours: the store's answer, lane by lane, beside LibCarla's lanes."""
    lamps = shuffled(town.lamps, 4)
    # Neighbours in the list of signals by place are of different colours, twins among them.
    order = sorted(lamps, key=lambda i: (round(lamps[i].x / 5), round(lamps[i].y / 5), lamps[i]))
    colour = {i: (RED, GREEN)[n % 2] for n, i in enumerate(order)}
    with Bridge(tmp_path / "r.mcap") as bridge:
        bridge.world(town.text)
        bridge.light_places([told(i, lamp) for i, lamp in lamps.items()])
        bridge.light_states(colour, 0.0)
        bridge.objects(0.1, [vehicle(1)])
    (outcome,) = ingest(tmp_path / "s.sgstore", [tmp_path / "r.mcap"])
    store = sgstore.open(tmp_path / "s.sgstore")
    rows = store.sql(
        "SELECT l.road || '_' || l.lane, n.light_state FROM edges e"
        " JOIN nodes n ON (n.frame_id, n.node_id) = (e.frame_id, e.src)"
        " JOIN lanes l ON l.node_id = e.dst WHERE e.relation = 'controlsTrafficOf' AND n.kind = 'traffic_light'"
    )
    driving = store.sql(
        "SELECT DISTINCT road || '_' || lane FROM lanes WHERE lane_type = 'driving'"
    )

    shown: dict[str, set[str]] = {}
    for lane_name, state in rows.values:
        shown.setdefault(lane_name, set()).add(state)
    expected: dict[str, set[str]] = {}
    for i, lamp in lamps.items():
        for name in town.lanes[lamp.signal] & {name for (name,) in driving.values}:
            expected.setdefault(name, set()).add("red" if colour[i] == RED else "green")
    assert outcome.status == "added"
    assert shown == expected


@pytest.mark.parametrize("turned", [0.0, CROSSWISE], ids=["as landmarks", "as actors"])
def test_lights_of_a_live_town_are_their_own_signals(town: Town, turned: float) -> None:
    lamps = shuffled(town.lamps, 5)
    yaw = {i: math.degrees(turned - lamp.heading) for i, lamp in lamps.items()}
    late = set(list(lamps)[::3])
    actors = {
        i: StandInActor(i, "traffic.traffic_light", transform(of.x, -of.y, of.z, yaw=yaw[i]))
        for i, of in lamps.items()
    }
    world = StandInWorld(*(a for i, a in actors.items() if i not in late), map_text=town.text)
    live = LiveWorld(world)
    live.frame()
    world.actors += [actors[i] for i in late]

    found = {entity.ident: entity.map_ref for entity in live.frame().entities}

    assert found == {str(i): lamp.signal for i, lamp in lamps.items()}
    assert live.warnings == []


def test_a_monitor_finds_the_signals_of_lights_in_a_map_that_is_given(tmp_path: Path) -> None:
    given = tmp_path / "one.xodr"
    given.write_text(one_lane())
    with Bridge(tmp_path / "r.mcap") as bridge:
        bridge.light_places([light(80, 50.25, -4.0)])
        bridge.objects(0.0, [vehicle(1)])

    with opened(str(tmp_path / "r.mcap"), Config(), road_map=given) as source:
        (frame,) = source.frames

    assert {e.ident: e.map_ref for e in frame.entities} == {"1": "", "80": "near"}


# What cannot be is said ------------------------------------------------------------------------------


def one_lane() -> str:
    """A road along x with one lane, which two signals apply to."""
    lamp = {
        "s": 50,
        "orientation": "+",
        "dynamic": "yes",
        "type": "1000001",
        "country": "OpenDRIVE",
    }
    both = element("signal", id="near", t=-4, **lamp) + element("signal", id="far", t=6, **lamp)
    return a_map(a_road("1", line(100), sections=section(lane(0), lane(-1)), signals=both))


def test_a_lane_that_is_red_and_green_at_once_is_named_with_its_lights(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    road_map = read_map(one_lane(), "one")
    at = {name: i for i, name in enumerate(road_map.nodes.name)}
    places = [
        light(ident, *(float(of[at[name]]) for of in (road_map.nodes.x, road_map.nodes.y)), 0.0)
        for ident, name in ((80, "near"), (81, "far"))
    ]
    with Bridge(path) as bridge:
        bridge.world(one_lane())
        bridge.actors(HERO)
        bridge.light_places([place | {"transform": turned_to(place, road_map)} for place in places])
        for i in range(9):
            bridge.light_states({80: RED, 81: RED if i < 4 else GREEN}, i * 0.1)
            bridge.objects(i * 0.1 + 0.05, [vehicle(1)])

    (outcome,) = ingest(tmp_path / "s.sgstore", [path])

    assert outcome.warnings == [
        "lane '1/0/-1': red by traffic light '80' and green by '81' at once, in 5 frames"
    ]


def turned_to(place: dict, road_map) -> dict:
    """The same place, facing as the signals of a map face."""
    heading = float(road_map.nodes.heading[list(road_map.nodes.name).index("near")])
    return light(0, 0, 0, heading)["transform"] | {"position": place["transform"]["position"]}


def live_lights(*signals_told: str) -> StandInWorld:
    hero = StandInActor(
        *(24, "vehicle.tesla.model3", transform(10, 1.75)),
        box(4.7, 2.1, 1.5),
        {"role_name": "hero"},
    )
    heads = [
        StandInActor(40 + i, "traffic.traffic_light", transform(50, 4 + i), opendrive_id=name)
        for i, name in enumerate(signals_told)
    ]
    return StandInWorld(hero, *heads, map_text=one_lane())


def test_two_live_lights_of_one_signal_are_named() -> None:
    live = LiveWorld(live_lights("near", "near", "far"))
    live.frame()

    assert live.warnings == ["traffic lights '40', '41' are one signal of the road map: 'near'"]


def test_a_recorded_world_that_contradicts_itself_is_told(tmp_path: Path) -> None:
    world = live_lights("near", "far")
    world.actors[1].state, world.actors[2].state = (
        carla.TrafficLightState.Red,
        carla.TrafficLightState.Green,
    )

    done = record(world, tmp_path / "r.mcap", duration_s=0.2, step_s=0.05)

    assert [w.rpartition(", in ")[0] for w in done.warnings] == [
        "lane '1/0/-1': red by traffic light '40' and green by '41' at once"
    ]
