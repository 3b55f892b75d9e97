"""A world that stands in for one of CARLA's: no server, but every value is of the wheel's own types.

The wheel's actors, snapshots and objects of the level cannot be made without a server, so these stand in for
them, with the same names. The map is a ``carla.Map`` of the town of the sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import carla
import numpy as np
from mcap.reader import make_reader

from sgstore.apps.demo import RECORDING
from sgstore.readers import message_class

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


def town_xodr() -> str:
    """The road map of the sample."""
    with RECORDING.open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages(topics=["ground_truth_map"]):
            return str(message_class(schema).FromString(message.data).open_drive_xml_content)
    raise AssertionError("the sample has no map")


def transform(
    x: float, y: float, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0
) -> carla.Transform:
    return carla.Transform(carla.Location(x, y, z), carla.Rotation(pitch, yaw, roll))


def box(length: float, width: float, height: float, z: float = 0.0) -> carla.BoundingBox:
    half = carla.Vector3D(length / 2, width / 2, height / 2)
    return carla.BoundingBox(carla.Location(0.0, 0.0, z), half)


@dataclass
class StandInActor:
    id: int
    type_id: str
    pose: carla.Transform
    bounding_box: carla.BoundingBox = field(default_factory=lambda: box(0, 0, 0))
    attributes: dict[str, str] = field(default_factory=dict)
    velocity: carla.Vector3D = field(default_factory=carla.Vector3D)
    acceleration: carla.Vector3D = field(default_factory=carla.Vector3D)
    angular_velocity: carla.Vector3D = field(default_factory=carla.Vector3D)
    control: carla.VehicleControl = field(default_factory=carla.VehicleControl)
    light_state: carla.VehicleLightState = carla.VehicleLightState.NONE
    state: carla.TrafficLightState = carla.TrafficLightState.Unknown
    opendrive_id: str = ""
    stops: tuple[Any, ...] = ()
    listener: Callable[[Any], None] | None = None
    gone: bool = False
    parent: StandInActor | None = None

    def get_transform(self) -> carla.Transform:
        return self.pose

    def get_velocity(self) -> carla.Vector3D:
        return self.velocity

    def get_acceleration(self) -> carla.Vector3D:
        return self.acceleration

    def get_angular_velocity(self) -> carla.Vector3D:
        return self.angular_velocity

    def get_control(self) -> carla.VehicleControl:
        return self.control

    def get_opendrive_id(self) -> str:
        return self.opendrive_id

    def get_stop_waypoints(self) -> list[Any]:
        return list(self.stops)

    def listen(self, callback: Callable[[Any], None]) -> None:
        self.listener = callback

    def stop(self) -> None:
        self.listener = None

    def destroy(self) -> bool:
        self.gone = True
        return True


BLUEPRINTS = {
    "sensor.camera.rgb": {"image_size_x", "image_size_y", "fov", "sensor_tick"},
    "sensor.lidar.ray_cast": {"range"},
    "sensor.other.imu": set[str](),
}


@dataclass
class StandInBlueprint:
    id: str
    set: dict[str, str] = field(default_factory=dict)

    def has_attribute(self, name: str) -> bool:
        return name in BLUEPRINTS[self.id]

    def set_attribute(self, name: str, value: str) -> None:
        self.set[name] = value


class Image(SimpleNamespace):
    """As ``carla.Image``."""


class LidarMeasurement(SimpleNamespace):
    """As ``carla.LidarMeasurement``."""


class IMUMeasurement(SimpleNamespace):
    """As ``carla.IMUMeasurement``."""


def measured(actor: StandInActor, clock: carla.Timestamp) -> Any:
    """What a sensor measures at a tick."""
    about = {"timestamp": clock.elapsed_seconds, "frame": clock.frame, "transform": actor.pose}
    match actor.type_id:
        case "sensor.camera.rgb":
            width, height = int(actor.attributes["image_size_x"]), 6
            pixels = np.zeros((height, width, 4), np.uint8)
            pixels[..., 0], pixels[..., 1], pixels[..., 2] = 10, clock.frame % 256, 30
            raw = pixels.tobytes()
            return Image(width=width, height=height, fov=90.0, raw_data=raw, **about)
        case "sensor.lidar.ray_cast":
            points = np.array([(1, 2, 3, 0.5), (4, -5, 6, 1.0)], "<f4")
            return LidarMeasurement(raw_data=points.tobytes(), channels=2, **about)
        case _:
            push, turn = carla.Vector3D(1.0, 2.0, 3.0), carla.Vector3D(0.1, 0.2, 0.3)
            return IMUMeasurement(accelerometer=push, gyroscope=turn, compass=0.5, **about)


@dataclass
class StandInObject:
    id: int
    name: str
    type: carla.CityObjectLabel
    bounding_box: carla.BoundingBox


@dataclass
class StandInSnapshot:
    timestamp: carla.Timestamp
    states: list[StandInActor]

    @property
    def frame(self) -> int:
        return int(self.timestamp.frame)

    def __iter__(self) -> Iterator[StandInActor]:
        return iter(self.states)


class StandInWorld:
    """A town with things in it; ``tick`` moves what has a velocity."""

    def __init__(
        self, *actors: StandInActor, objects: tuple[StandInObject, ...] = (), map_text: str = ""
    ) -> None:
        self.actors = list(actors)
        self.objects = list(objects)
        self.map = carla.Map("Carla/Maps/town", map_text or town_xodr())
        self.clock = carla.Timestamp(100, 5.0, 0.05, 0.0)
        self.lists = 0
        self.script: Callable[[StandInWorld], None] = lambda _: None
        self.step = 0.05
        self.settings = SimpleNamespace(synchronous_mode=False, fixed_delta_seconds=0.0)
        self.applied: list[tuple[bool, float]] = []
        self.stands_still = False

    def get_map(self) -> carla.Map:
        return self.map

    def get_snapshot(self) -> StandInSnapshot:
        return StandInSnapshot(self.clock, list(self.actors))

    def get_actors(self) -> list[StandInActor]:
        self.lists += 1
        return list(self.actors)

    def get_environment_objects(self, _label: Any = None) -> list[StandInObject]:
        return self.objects

    def get_vehicles_light_states(self) -> dict[int, carla.VehicleLightState]:
        return {a.id: a.light_state for a in self.actors if a.type_id.startswith("vehicle.")}

    def tick(self, _seconds: float = 0.0) -> int:
        if self.stands_still:
            raise RuntimeError("time-out of 10000ms while waiting for the simulator")
        clock, step = self.clock, self.step
        self.clock = carla.Timestamp(clock.frame + 1, clock.elapsed_seconds + step, step, 0.0)
        for actor in self.actors:
            place, speed = actor.pose.location, actor.velocity
            moved = carla.Location(
                place.x + step * speed.x, place.y + step * speed.y, place.z + step * speed.z
            )
            actor.pose = carla.Transform(moved, actor.pose.rotation)
        self.script(self)
        for actor in self.actors:
            if actor.listener is not None:
                actor.listener(measured(actor, self.clock))
        return int(self.clock.frame)

    def get_settings(self) -> SimpleNamespace:
        return self.settings

    def apply_settings(self, settings: SimpleNamespace) -> None:
        self.applied.append((settings.synchronous_mode, settings.fixed_delta_seconds))
        self.step = settings.fixed_delta_seconds or 0.05

    def get_blueprint_library(self) -> StandInWorld:
        return self

    def find(self, name: str) -> StandInBlueprint:
        if name not in BLUEPRINTS:
            raise IndexError(f"blueprint '{name}' not found")
        return StandInBlueprint(name)

    def spawn_actor(
        self, blueprint: StandInBlueprint, pose: carla.Transform, attach_to: StandInActor
    ) -> StandInActor:
        actor = StandInActor(1000 + len(self.actors), blueprint.id, pose, attributes=blueprint.set)
        actor.parent = attach_to
        self.actors.append(actor)
        return actor

    def wait_for_tick(self, _seconds: float = 0.0) -> StandInSnapshot:
        self.tick()
        return self.get_snapshot()

    def waypoint(self, x: float, y: float) -> carla.Waypoint:
        return self.map.get_waypoint(carla.Location(x, y, 0.0))


def at_red() -> StandInWorld:
    """The hero waits at a red light; a person crosses before it, a police car waits behind.

    Road 3 comes from the north (CARLA's y is south), its lane 1 goes south and is controlled by light 15.
    """
    hero = StandInActor(
        *(24, "vehicle.tesla.model3", transform(-1.75, -28.0, 0.0, yaw=90.0)),
        box(4.7, 2.1, 1.5, z=0.75),
        {"role_name": "hero"},
        control=carla.VehicleControl(throttle=0.0, steer=0.25, brake=1.0, gear=2, hand_brake=True),
        light_state=carla.VehicleLightState(
            carla.VehicleLightState.Brake | carla.VehicleLightState.LeftBlinker
        ),
    )
    police = StandInActor(
        *(25, "vehicle.dodge.charger_police", transform(-1.75, -36.0, 0.0, yaw=90.0)),
        box(5.0, 2.0, 1.6, z=0.8),
        {"role_name": "autopilot"},
        velocity=carla.Vector3D(0.0, 0.5, 0.0),
    )
    person = StandInActor(
        *(31, "walker.pedestrian.0012", transform(-3.0, -23.0, 0.93, yaw=0.0)),
        box(0.4, 0.4, 1.86),
        velocity=carla.Vector3D(1.2, 0.0, 0.0),
    )
    light = StandInActor(
        *(40, "traffic.traffic_light", transform(-4.5, -21.0, 0.0, yaw=-90.0)),
        box(2, 2, 2, z=1.0),
        state=carla.TrafficLightState.Red,
        opendrive_id="15",
    )
    stop = StandInActor(41, "traffic.stop", transform(134.0, -127.5, 0.0))
    cone = StandInActor(
        *(50, "static.prop.trafficcone01", transform(6.0, -30.0)), box(0.4, 0.4, 0.7, z=0.35)
    )
    sensor = StandInActor(60, "sensor.camera.rgb", transform(0, 0, 2.0))
    spectator = StandInActor(1, "spectator", transform(0, 0, 50.0))
    house = StandInObject(
        *(9_000_000_000_000, "House_12", carla.CityObjectLabel.Buildings),
        carla.BoundingBox(carla.Location(30.0, -40.0, 5.0), carla.Vector3D(8.0, 5.0, 5.0)),
    )
    road = StandInObject(7, "Road", carla.CityObjectLabel.Roads, box(100, 4, 0))
    parked = StandInObject(8, "Parked", carla.CityObjectLabel.Car, box(4.4, 1.8, 1.5))
    parked.bounding_box.location = carla.Location(12.0, -50.0, 0.7)
    parked.bounding_box.rotation = carla.Rotation(0.0, math.degrees(0.5), 0.0)
    return StandInWorld(
        *(spectator, hero, police, person, light, stop, cone, sensor),
        objects=(house, road, parked),
    )
