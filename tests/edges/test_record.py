"""Recordings of a live CARLA: what is recorded and ingested gives the graphs of the online mode."""

from __future__ import annotations

import io
import json
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

carla = pytest.importorskip("carla")

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage  # noqa: E402
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud  # noqa: E402
from google.protobuf import descriptor_pb2  # noqa: E402
from mcap.reader import make_reader  # noqa: E402
from standin_carla import StandInActor, StandInWorld, at_red, box, transform  # noqa: E402

from sgstore.apps.cli import run  # noqa: E402
from sgstore.apps.demo import RECORDING  # noqa: E402
from sgstore.apps.record import record  # noqa: E402
from sgstore.errors import ConfigError, ExportError, TraceError  # noqa: E402
from sgstore.exporters import Recorder  # noqa: E402
from sgstore.graphs.online import Frame  # noqa: E402
from sgstore.ingest import ingest  # noqa: E402
from sgstore.model.config import Config  # noqa: E402
from sgstore.query import Store  # noqa: E402
from sgstore.readers import LiveWorld, Sensor, load_sensors, png  # noqa: E402
from sgstore.sgg import SceneGraphGenerator  # noqa: E402

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.model.graph import SceneGraph

CAMERA = Sensor("front", "sensor.camera.rgb", x=1.5, z=2.0, attributes={"image_size_x": "8"})
ROOF = Sensor("roof", "sensor.lidar.ray_cast", z=2.4, yaw=90.0)
UNIT = Sensor("imu", "sensor.other.imu")


def busy() -> StandInWorld:
    """A world in which a car comes, another goes, and the light changes."""
    world = at_red()

    def script(world: StandInWorld) -> None:
        tick = world.clock.frame - 100
        if tick == 8:
            world.actors.append(
                StandInActor(
                    *(70, "vehicle.mitsubishi.fusorosa", transform(1.75, -60.0, 0.1, -90.0)),
                    box(10.0, 3.9, 4.2, z=2.1),
                    velocity=carla.Vector3D(0.0, -6.0, 0.0),
                )
            )
        if tick == 15:
            world.actors = [a for a in world.actors if a.id != 25]
        if tick == 20:
            next(a for a in world.actors if a.id == 40).state = carla.TrafficLightState.Green
            next(a for a in world.actors if a.id == 24).velocity = carla.Vector3D(0.0, 2.0, 0.0)

    world.script = script
    return world


def messages(path: Path, topic: str) -> list[tuple[Any, Any]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [(schema, message) for schema, _, message in reader.iter_messages(topics=[topic])]


# The same graphs ----------------------------------------------------------------------------------


def test_a_recorded_run_has_the_graphs_of_the_online_mode(tmp_path: Path) -> None:
    path, end = tmp_path / "run.mcap", 1.5
    done = record(busy(), path, duration_s=end)
    world = busy()
    live = LiveWorld(world)
    generator = SceneGraphGenerator(live.road_map, Config())

    (outcome,) = ingest(tmp_path / "s.sgstore", [path])
    store = Store(tmp_path / "s.sgstore")
    # The reader has names for what moves, and numbers for what stands; the house is the only one without.
    house = "level:9000000000000"
    named = f"CASE WHEN kind = 'building' THEN '{house}' ELSE ident END"
    names = dict(store.sql(f"SELECT node_id, {named} FROM entities").values)

    assert (outcome.status, outcome.frames, outcome.losses) == ("added", done.written.frames, [])
    assert done.ego == "24"
    for seq in range(done.written.frames):
        online = generator.step(live.frame(world.wait_for_tick()))
        agree(online, store.file.graph(f"run#{seq}"), names)
    assert done.written.frames == 31
    kinds = dict(store.sql("SELECT ident, kind FROM entities").values)
    assert {kinds[ident] for ident in ("41", "50", "70")} == {"stop_sign", "prop", "bus"}


LOST = {"steer", "hand_brake", "subkind", "name", "ident", "type_name"}
"""What OSI has no word for (nor has it for taxis, electric cars and models), and what counts the entities."""


def agree(online: SceneGraph, stored: SceneGraph, names: dict[int, str]) -> None:
    assert online.time_ns == stored.time_ns
    of = {node: a["ident"] if node >= 0 else node for node, a in online.nodes.items()}
    to = {node: names[node] if node >= 0 else node for node in stored.nodes}
    assert of[online.ego] == to[stored.ego] == "24"
    assert set(of.values()) == set(to.values())
    assert {(of[a], r, of[b]) for a, r, b, _ in online.edges} == {
        (to[a], r, to[b]) for a, r, b, _ in stored.edges
    }
    theirs = {to[node]: attributes for node, attributes in stored.nodes.items()}
    for node, ours in online.nodes.items():
        for name, value in ours.items():
            if (name in LOST and node >= 0) or value in {"taxi", "electric"}:
                continue
            told = theirs[of[node]].get(name)
            if isinstance(value, float):
                assert told == pytest.approx(value, abs=2e-4), (of[node], name)
            elif not (name.startswith("light_") and told is False):
                assert told == value, (of[node], name)


def test_commanded_controls_are_recorded_beside_the_applied_ones(tmp_path: Path) -> None:
    world, path = busy(), tmp_path / "run.mcap"
    ego = next(a for a in world.actors if a.id == 24)
    ego.control = carla.VehicleControl(throttle=0.5, manual_gear_shift=True)
    ego.angular_velocity = carla.Vector3D(2.0, 3.0, 0.0)
    record(world, path, duration_s=0.3, commands=lambda: {"throttle": 0.75, "planner": "mpc"})

    (outcome,) = ingest(tmp_path / "s.sgstore", [path])
    store = Store(tmp_path / "s.sgstore")

    assert outcome.losses == []
    (row, *_) = store.find(
        "MATCH (e:Ego) WHERE e.control_throttle > e.throttle RETURN e.throttle, e.control_throttle,"
        " e.control_planner, e.manual_gear, e.ang_vel_x, e.ang_vel_y"
    )
    assert tuple(row) == (0.5, 0.75, "mpc", True, -2.0, 3.0)
    graph = store.file.graph("run#0")
    assert graph.nodes[graph.ego]["control_planner"] == "mpc"


# What is in the file ------------------------------------------------------------------------------


def test_sensors_are_joined_to_frames_by_their_time(tmp_path: Path) -> None:
    world, path = busy(), tmp_path / "run.mcap"

    done = record(world, path, sensors=[CAMERA, ROOF, UNIT], duration_s=0.5)

    frames = done.written.frames
    assert done.written.messages == {
        "ground_truth_map": 1,
        "ground_truth": frames,
        "sgstore/frames": frames,
        "/ego/front/image": frames,
        "/ego/front/calibration": 1,
        "/ego/roof/points": frames,
        "/ego/imu": frames,
    }
    ingest(tmp_path / "s.sgstore", [path])
    store = Store(tmp_path / "s.sgstore")
    image = store.payload("run#4", "/ego/front/image")
    assert b"\x89PNG" in image
    joined = store.sql(
        "SELECT channel, count(*), max(abs(offset_s)) FROM payloads WHERE channel LIKE '/ego/%'"
        " AND channel NOT LIKE '%/calibration' GROUP BY channel ORDER BY channel"
    ).values
    channels = ("/ego/front/image", "/ego/imu", "/ego/roof/points")
    assert joined == [(channel, frames, 0.0) for channel in channels]


def test_sensors_are_attached_in_our_axes_and_taken_away_again(tmp_path: Path) -> None:
    world = busy()
    before = list(world.actors)

    record(world, tmp_path / "run.mcap", sensors=[CAMERA, ROOF], duration_s=0.2)

    camera, roof = (a for a in world.actors if a.id >= 1000)
    assert camera.parent is roof.parent is before[1]
    assert (camera.pose.location.x, camera.pose.location.z) == pytest.approx((1.5, 2.0))
    assert roof.pose.rotation.yaw == pytest.approx(-90.0)
    assert camera.gone
    assert roof.gone
    assert camera.listener is None


def test_pictures_and_points_are_what_the_sensor_measured(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    path = tmp_path / "run.mcap"
    record(busy(), path, sensors=[CAMERA, ROOF, UNIT], duration_s=0.2)

    schema, message = messages(path, "/ego/front/image")[0]
    assert schema.name == "foxglove.CompressedImage"
    picture = CompressedImage.FromString(message.data)
    pixels = np.asarray(image.open(io.BytesIO(picture.data)))
    assert pixels.shape == (6, 8, 3)
    assert pixels[3, 5].tolist() == [30, 101, 10]
    cloud = PointCloud.FromString(messages(path, "/ego/roof/points")[0][1].data)
    points = np.frombuffer(cloud.data, [(name, "<f4") for name in ("x", "y", "z", "intensity")])
    assert points["y"].tolist() == [-2.0, 5.0]
    assert [f.name for f in cloud.fields] == ["x", "y", "z", "intensity"]
    unit = json.loads(messages(path, "/ego/imu")[0][1].data)
    assert unit["accelerometer"] == {"x": 1.0, "y": -2.0, "z": 3.0}
    assert unit["gyroscope"] == pytest.approx({"x": -0.1, "y": 0.2, "z": -0.3})


def test_our_osi_has_the_numbers_of_the_standard(tmp_path: Path) -> None:
    """The sample was written with ASAM's own package, so it brings the descriptors of the standard."""
    path = tmp_path / "run.mcap"
    record(busy(), path, duration_s=0.1)
    ours = fields_of(messages(path, "ground_truth")[0][0].data)
    standard = fields_of(messages(RECORDING, "ground_truth")[0][0].data)

    shared = ours.keys() & standard.keys()
    assert {"osi3.GroundTruth.moving_object", "osi3.BaseMoving.velocity"} <= shared
    assert len(shared) > 150
    assert {name: ours[name] for name in shared} == {name: standard[name] for name in shared}


def fields_of(schema: bytes) -> dict[str, tuple[int, int]]:
    found: dict[str, tuple[int, int]] = {}

    def walk(message: descriptor_pb2.DescriptorProto, prefix: str) -> None:
        for item in message.field:
            found[f"{prefix}{message.name}.{item.name}"] = (item.number, item.type)
        for inner in message.nested_type:
            walk(inner, f"{prefix}{message.name}.")

    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        for message in file.message_type:
            walk(message, f"{file.package}.")
    return found


def test_ids_that_are_no_numbers_get_one_and_keep_their_name(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    frames = []
    for step in range(3):
        frame = Frame(step * 10**8, ego="hero")
        frame.add("hero", "car", 0.0, 0.0, 0.7, heading=0.0, length=4.0, width=2.0, height=1.4)
        frame.add("7", "person", 6.0, 0.0, heading=0.0)
        frame.add("wall", "barrier", 9.0, 4.0, 1.0, subkind="wall", static=True)
        for state in ("red_yellow", "flashing", "off", "unknown"):
            frame.add(
                f"light {state}", "traffic_light", 12.0, 4.0 * len(state), 3.0, light_state=state
            )
        frames.append(frame)

    with Recorder(path) as recorder:
        for frame in frames:
            recorder.frame(frame)

    ingest(tmp_path / "s.sgstore", [path])
    store = Store(tmp_path / "s.sgstore")
    rows = store.sql("SELECT ident, kind, subkind, is_static FROM entities").values
    assert ("hero", "car", None, False) in rows
    assert ("7", "person", None, False) in rows
    assert [row[1:] for row in rows if row[1] == "barrier"] == [("barrier", "wall", True)]
    told = store.sql("SELECT DISTINCT light_state FROM nodes WHERE kind = 'traffic_light'").values
    assert {state for (state,) in told} == {"red_yellow", "flashing", "off", "unknown"}
    graph = store.file.graph("run#2")
    assert graph.nodes[graph.ego]["length"] == pytest.approx(4.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_picture_survives_being_a_png(seed: int) -> None:
    image = pytest.importorskip("PIL.Image")
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (rng.integers(1, 9), rng.integers(1, 9), 3)).astype(np.uint8)

    read = np.asarray(image.open(io.BytesIO(png(pixels))).convert("RGB"))

    assert (read == pixels).all()


# Beginnings and ends ------------------------------------------------------------------------------


def test_a_run_that_is_interrupted_is_a_recording(tmp_path: Path) -> None:
    world, path = busy(), tmp_path / "run.mcap"
    script = world.script

    def until(world: StandInWorld) -> None:
        script(world)
        if world.clock.frame == 112:
            raise KeyboardInterrupt

    world.script = until
    done = record(world, path)

    assert done.written.frames == 11
    assert len(messages(path, "ground_truth")) == 11
    assert not list(tmp_path.glob("*.part"))


def test_what_was_recorded_before_an_error_is_kept(tmp_path: Path) -> None:
    world, path = busy(), tmp_path / "run.mcap"

    def fail(world: StandInWorld) -> None:
        world.stands_still = world.clock.frame > 105

    world.script = fail
    with pytest.raises(TraceError, match="the world did not advance for 10 s"):
        record(world, path)

    assert len(messages(path, "ground_truth")) == 6


def test_nothing_is_overwritten_and_nothing_is_left_of_a_run_without_frames(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(ExportError, match="the file exists"):
        record(busy(), path)
    assert path.read_bytes() == b"precious"

    still = busy()
    still.stands_still = True
    with pytest.raises(TraceError, match="did not advance"):
        record(still, tmp_path / "other.mcap")
    assert [file.name for file in tmp_path.iterdir()] == ["run.mcap"]

    with pytest.raises(ExportError, match=r"end the name in \.mcap"):
        record(busy(), tmp_path / "run.bag")


def test_a_world_that_is_driven_gets_its_settings_back(tmp_path: Path) -> None:
    world = busy()

    done = record(world, tmp_path / "run.mcap", step_s=0.1, duration_s=1.0)

    assert done.written.frames == 11
    assert world.applied == [(True, 0.1), (False, 0.0)]


def test_sensors_need_an_ego_and_a_blueprint_that_there_is(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="no vehicle is the ego"):
        record(busy(), tmp_path / "a.mcap", ego="nobody", sensors=[CAMERA])
    wrong = Sensor("x", "sensor.camera.xray")
    with pytest.raises(TraceError, match=r"sensor 'x' \(sensor.camera.xray\): blueprint"):
        record(busy(), tmp_path / "b.mcap", sensors=[wrong])
    wrong = Sensor("x", "sensor.other.imu", attributes={"fov": "90"})
    with pytest.raises(TraceError, match="has no attribute 'fov'"):
        record(busy(), tmp_path / "c.mcap", sensors=[wrong])
    assert list(tmp_path.iterdir()) == []


def test_frames_without_an_ego_are_told(tmp_path: Path) -> None:
    done = record(busy(), tmp_path / "run.mcap", ego="nobody", duration_s=0.2)

    assert done.warnings == ["5 of 5 frames have no ego"]


def test_ticks_that_were_missed_are_told(tmp_path: Path) -> None:
    world = busy()
    script = world.script

    def hurry(world: StandInWorld) -> None:
        script(world)
        if world.clock.frame == 103:
            clock = world.clock
            world.clock = carla.Timestamp(clock.frame + 2, clock.elapsed_seconds + 0.1, 0.05, 0.0)

    world.script = hurry
    done = record(world, tmp_path / "run.mcap", duration_s=0.5)

    assert len(done.warnings) == 1
    assert done.warnings[0].startswith("2 ticks between the frames are missing")


# Settings and the command line --------------------------------------------------------------------


def test_sensors_are_listed_in_a_file(tmp_path: Path) -> None:
    file = tmp_path / "sensors.toml"
    file.write_text(
        '[[sensor]]\nname = "front"\ntype = "sensor.camera.rgb"\nx = 1.5\nz = 2\n'
        "attributes = { image_size_x = 8 }\n"
    )

    assert load_sensors(file) == [CAMERA]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sensor = 3", r"expected tables \[\[sensor\]\]"),
        ("[[sensors]]", r"expected tables \[\[sensor\]\]"),
        ("[[sensor]]\nname = 'a b'\ntype = 'sensor.x'", "sensor 1: 'name' is 'a b'"),
        ("[[sensor]]\nname = 'a'\ntype = 'camera'", "'type' is 'camera'; expected a blueprint"),
        ("[[sensor]]\nname = 'a'\ntype = 'sensor.x'\nx = 'far'", "'x' is 'far'; expected a number"),
        ("[[sensor]]\nname = 'a'\ntype = 'sensor.x'\nfov = 3", "expected a table of attributes"),
        ("[[sensor]]\nname='a'\ntype='sensor.x'\n" * 2, "two sensors have the same name"),
        ("[[sensor", "not TOML"),
    ],
)
def test_a_file_of_sensors_that_is_none_says_why(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "sensors.toml"
    file.write_text(text)

    with pytest.raises(ConfigError, match=message):
        load_sensors(file)


def test_the_verb_records_what_a_server_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    world = busy()

    class Client:
        def get_world(self) -> StandInWorld:
            return world

    asked: list[tuple[str, int]] = []

    def connect(host: str, port: int) -> Client:
        asked.append((host, port))
        return Client()

    monkeypatch.setattr("sgstore.readers.connect", connect)
    path = tmp_path / "run.mcap"

    code = run(["record", str(path), "--host", "far", "--duration", "500ms"])

    out, err = capsys.readouterr()
    assert code == 0
    assert asked == [("far", 2000)]
    assert out == f"{path}\n"
    assert "11 frames, 0.50 s" in err


def test_the_verb_says_what_to_install_and_where_no_server_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "carla", None)

    assert run(["record", str(tmp_path / "run.mcap")]) == 1
    assert "pip install 'sgstore[carla]'" in capsys.readouterr().err
