"""A live CARLA: a world in our axes, by the wheel's own types and a world that stands in for one."""

from __future__ import annotations

import math
import sys
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest

carla = pytest.importorskip("carla")

from standin_carla import StandInActor, at_red, box, transform  # noqa: E402

from sgstore.errors import MissingExtraError, TraceError  # noqa: E402
from sgstore.model.config import Config  # noqa: E402
from sgstore.model.vocabulary import VEHICLE_LIGHTS  # noqa: E402
from sgstore.readers import LiveWorld, Sensor, connect  # noqa: E402
from sgstore.sgg import SceneGraphGenerator  # noqa: E402
from sgstore.temporal import opened  # noqa: E402


def graph_of(live: LiveWorld):
    return SceneGraphGenerator(live.road_map, Config()).step(live.frame())


def by_ident(graph) -> dict[str, dict]:
    return {a["ident"]: a for a in graph.nodes.values() if "ident" in a}


def edges(graph) -> set[tuple[str, str, str]]:
    names = {node: a.get("ident", a.get("name", "")) for node, a in graph.nodes.items()}
    return {(names[a], relation, names[b]) for a, relation, b, _ in graph.edges}


def test_the_hero_waits_at_red_and_a_person_crosses() -> None:
    graph = graph_of(LiveWorld(at_red()))

    assert graph.nodes[graph.ego]["ident"] == "24"
    assert graph.time_ns == 5_000_000_000
    assert {
        ("24", "isIn", "3/0/1"),
        ("31", "isIn", "3/0/1"),
        ("40", "controlsTrafficOf", "3/0/1"),
        ("25", "atDRearOf", "24"),
    } <= edges(graph)
    assert by_ident(graph)["40"]["light_state"] == "red"


def test_positions_velocities_and_inputs_are_in_our_axes() -> None:
    world = at_red()
    world.actors[1].velocity = carla.Vector3D(1.0, 2.0, 0.5)
    world.actors[1].angular_velocity = carla.Vector3D(0.0, 0.0, 12.0)

    hero = by_ident(graph_of(LiveWorld(world)))["24"]

    assert (hero["x"], hero["y"], hero["z"]) == pytest.approx((-1.75, 28.0, 0.75))
    assert hero["heading"] == pytest.approx(-90.0)
    assert (hero["vx"], hero["vy"], hero["vz"]) == (1.0, -2.0, 0.5)
    assert hero["yaw_rate"] == pytest.approx(-12.0)
    assert (hero["steer"], hero["throttle"], hero["brake"]) == (-0.25, 0.0, 1.0)
    assert (hero["gear"], hero["hand_brake"]) == (2, True)
    assert (hero["length"], hero["width"], hero["height"]) == pytest.approx((4.7, 2.1, 1.5))
    assert "steer" not in by_ident(graph_of(LiveWorld(world)))["25"]


@pytest.mark.parametrize("seed", range(20))
def test_a_point_of_an_actor_is_where_carla_itself_has_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, z, a, b, c = rng.uniform(-50, 50, 6).tolist()
    yaw, pitch, roll = rng.uniform(-180, 180, 3).tolist()
    pose = transform(x, y, z, yaw, pitch, roll)

    there = pose.transform(carla.Location(a, b, c))
    world = at_red()
    world.actors[1].pose = pose
    world.actors[1].bounding_box.location = carla.Location(a, b, c)

    hero = by_ident(graph_of(LiveWorld(world)))["24"]

    middle = hero["x"], hero["y"], hero["z"]
    assert middle == pytest.approx((there.x, -there.y, there.z), abs=2e-4)


@pytest.mark.parametrize("seed", range(20))
def test_heading_pitch_and_roll_are_those_of_right_handed_axes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = at_red()
    pose = transform(
        *(-1.75, -28.0, 0.0, rng.uniform(-180, 180), rng.uniform(-80, 80), rng.uniform(-170, 170))
    )
    world.actors[1].pose = pose

    hero = by_ident(graph_of(LiveWorld(world)))["24"]

    heading, pitch, roll = (math.radians(hero[name]) for name in ("heading", "pitch", "roll"))
    cos_h, sin_h, cos_p, sin_p = (
        math.cos(heading),
        math.sin(heading),
        math.cos(pitch),
        math.sin(pitch),
    )
    ahead, up = pose.get_forward_vector(), pose.get_up_vector()
    # The columns of Rz(heading) Ry(pitch) Rx(roll).
    assert (cos_h * cos_p, sin_h * cos_p, -sin_p) == pytest.approx(
        (ahead.x, -ahead.y, ahead.z), abs=1e-5
    )
    assert (
        cos_h * sin_p * math.cos(roll) + sin_h * math.sin(roll),
        sin_h * sin_p * math.cos(roll) - cos_h * math.sin(roll),
        cos_p * math.cos(roll),
    ) == pytest.approx((up.x, -up.y, up.z), abs=1e-5)


def test_every_light_of_a_vehicle_has_the_bit_that_the_wheel_gives_it() -> None:
    words = {"LeftBlinker": "light_left", "RightBlinker": "light_right"}
    states = carla.VehicleLightState.names
    told = {
        int(value): words.get(name)
        or "light_" + "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")
        for name, value in states.items()
        if name not in {"NONE", "All"}
    }

    assert sorted(told.values()) == sorted(VEHICLE_LIGHTS)
    for value, name in told.items():
        world = at_red()
        world.actors[1].light_state = carla.VehicleLightState(value)
        vehicle = by_ident(graph_of(LiveWorld(world)))["24"]
        assert [one for one in VEHICLE_LIGHTS if vehicle[one]] == [name]
    hero = by_ident(graph_of(LiveWorld(at_red())))["24"]
    assert [name for name in VEHICLE_LIGHTS if hero[name]] == ["light_left", "light_brake"]


@pytest.mark.parametrize("name", carla.TrafficLightState.names)
def test_every_state_of_a_traffic_light_is_told(name: str) -> None:
    world = at_red()
    next(a for a in world.actors if a.id == 40).state = carla.TrafficLightState.names[name]

    assert by_ident(graph_of(LiveWorld(world)))["40"]["light_state"] == name.lower()


def test_a_light_that_does_not_know_its_signal_is_found_by_its_stop_waypoints() -> None:
    world = at_red()
    light = next(a for a in world.actors if a.id == 40)
    light.opendrive_id = ""
    light.pose = transform(-9.0, -14.0)
    light.stops = (world.waypoint(-1.75, -23.0),)

    assert ("40", "controlsTrafficOf", "3/0/1") in edges(graph_of(LiveWorld(world)))
    light.stops = ()
    assert ("40", "controlsTrafficOf", "3/0/1") not in edges(graph_of(LiveWorld(world)))


def test_blueprints_and_labels_of_the_level_become_kinds() -> None:
    of = by_ident(graph_of(LiveWorld(at_red())))

    assert {i: a["kind"] for i, a in of.items()} == {
        "24": "car",
        "25": "car",
        "31": "person",
        "40": "traffic_light",
        "50": "prop",
        "level:9000000000000": "building",
        "level:8": "car",
    }
    assert of["25"]["special"] == "emergency"
    house = of["level:9000000000000"]
    assert (house["x"], house["y"], house["length"], house["is_static"]) == (30.0, 40.0, 16.0, True)
    parked = of["level:8"]
    assert parked["heading"] == pytest.approx(-math.degrees(0.5), abs=1e-4)
    assert (parked["speed"], parked["is_static"]) == (0.0, False)


def test_scenery_is_optional() -> None:
    of = by_ident(graph_of(LiveWorld(at_red(), scenery=False)))

    assert not [ident for ident in of if ident.startswith("level:")]


@pytest.mark.parametrize(
    ("wanted", "ego"),
    [("", "24"), ("hero", "24"), ("25", "25"), ("autopilot", "25"), ("nobody", None)],
)
def test_the_ego_is_a_role_or_an_id(wanted: str, ego: str | None) -> None:
    frame = LiveWorld(at_red(), ego=wanted).frame()

    assert (frame.ego or None) == ego


def test_actors_that_come_and_go_are_asked_about_once_and_forgotten() -> None:
    world = at_red()
    live = LiveWorld(world)
    for step in range(30):
        world.tick()
        if step % 10 == 5:
            new = StandInActor(
                100 + step, "vehicle.audi.tt", transform(-5.25, -40.0), box(4, 2, 1.5)
            )
            world.actors = [a for a in world.actors if a.id < 100] + [new]
        frame = live.frame()

    assert world.lists == 4
    assert {e.ident for e in frame.entities if len(e.ident) == 3} == {"125"}
    assert len(live._actors) == len(world.actors)


def test_steps_follow_the_world_as_it_goes() -> None:
    world = at_red()
    live = LiveWorld(world)
    generator = SceneGraphGenerator(live.road_map, Config())
    inside = []
    for _ in range(60):
        graph = generator.step(live.frame(world.wait_for_tick()))
        inside.append(("31", "isIn", "3/0/1") in edges(graph))

    assert inside[0]
    assert not inside[-1]
    assert graph.time_ns == 8_000_000_000
    assert graph.seq == 59


def test_a_world_without_a_map_is_refused() -> None:
    world = at_red()

    class NoMap:
        name = "x"

        def to_opendrive(self) -> str:
            return ""

    world.map = NoMap()
    with pytest.raises(TraceError, match="no road map"):
        LiveWorld(world)


def test_a_server_that_goes_away_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    world = at_red()
    live = LiveWorld(world)
    live.frame()

    def gone() -> None:
        raise RuntimeError("time-out of 10000ms while waiting for the simulator")

    monkeypatch.setattr(world, "get_vehicles_light_states", gone)
    with pytest.raises(TraceError, match="the CARLA server does not answer: time-out"):
        live.frame()


def test_without_the_package_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", None)

    with pytest.raises(MissingExtraError, match=r"pip install 'sgstore\[carla\]'"):
        connect()


def test_where_no_server_answers_it_is_said_where() -> None:
    with pytest.raises(TraceError, match=r"no CARLA server answers at localhost:1\b"):
        connect("localhost", 1, timeout_s=0.2)


def test_cameras_of_a_running_world_have_a_picture_of_each_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = at_red()
    monkeypatch.setattr(
        "sgstore.readers.connect", lambda *_: SimpleNamespace(get_world=lambda: world)
    )
    camera, lidar = (
        Sensor("front", "sensor.camera.rgb", attributes={"image_size_x": "8"}),
        Sensor("top", "sensor.lidar.ray_cast"),
    )

    with opened("carla://localhost:2000", Config(), sensors=[camera, lidar]) as source:
        assert source.cameras is not None
        list(islice(source.frames, 3))
        pictures = [source.cameras.at(seq, "front") for seq in range(4)]

        assert source.cameras.topics == ("front",)
        assert [picture and picture.form for picture in pictures] == ["png", "png", "png", None]
    attached = {actor.type_id: actor.gone for actor in world.actors if actor.parent is not None}
    assert attached == {camera.type: True, lidar.type: True}
