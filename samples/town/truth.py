"""The simulation as OSI ground truth: one message every 0.1 s, what stands still in the first only."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from camera import LIGHT_HEIGHT, stand_of
from cast import EGO
from draw_map import town
from osi3 import osi_groundtruth_pb2, osi_object_pb2, osi_trafficlight_pb2, osi_version_pb2
from scenery import fixtures
from tracks import STEP

if TYPE_CHECKING:
    from google.protobuf.message import Message
    from tracks import Track
    from traffic import Recording

GERMANY = 276
EGO_ID = 1
FIRST_MOVING, FIRST_LIGHT, FIRST_STATIC = 1, 1001, 2001
"""Ids: moving objects, bulbs, stationary objects; the ego is the first of the moving objects."""
BULBS = (("r", "COLOR_RED", 0.28), ("y", "COLOR_YELLOW", 0.0), ("g", "COLOR_GREEN", -0.28))
"""The lenses of a light: state, OSI's name, height over its middle; m."""


def interface_version() -> osi_version_pb2.InterfaceVersion:
    """The version of OSI that the installed package implements."""
    options = osi_version_pb2.DESCRIPTOR.GetOptions()
    return options.Extensions[osi_version_pb2.current_interface_version]


def vector(target: Message, x: float, y: float, z: float, digits: int) -> None:
    """Fill an OSI vector; rounded, as more digits would say nothing and cost space."""
    target.x, target.y, target.z = round(x, digits), round(y, digits), round(z, digits)


def coloured(target: Message, colour: tuple[int, int, int]) -> None:
    """Fill an OSI colour."""
    target.rgb.red, target.rgb.green, target.rgb.blue = (round(c / 255, 3) for c in colour)


class Truth:
    """Makes the messages. Ids are given in the order of the tracks and never reused."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        tracks = sorted(recording.tracks, key=lambda t: t.name != EGO)
        self.tracks = [(FIRST_MOVING + i, track) for i, track in enumerate(tracks)]

    def message(self, step: int) -> osi_groundtruth_pb2.GroundTruth:
        """Ground truth at a step."""
        out = osi_groundtruth_pb2.GroundTruth()
        out.version.CopyFrom(interface_version())
        stamp(out.timestamp, step * round(STEP * 1e9))
        out.host_vehicle_id.value = EGO_ID
        out.country_code = GERMANY
        for ident, track in self.tracks:
            if track.present(step):
                add_moving(out.moving_object.add(), ident, track, step)
        add_lights(out, self.recording.lights[step])
        if step == 0:
            out.map_reference = "town.xodr"
            add_standing(out)
        return out


def stamp(target: Message, time_ns: int) -> None:
    """Fill an OSI timestamp."""
    target.seconds, target.nanos = divmod(time_ns, 1_000_000_000)


def add_moving(out: osi_object_pb2.MovingObject, ident: int, track: Track, step: int) -> None:
    """A vehicle or a person."""
    i, model = step - track.first, track.model
    out.id.value = ident
    base = out.base
    size = base.dimension
    size.length, size.width, size.height = model.length, model.width, model.height
    x, y, heading = (float(v) for v in track.poses[i])
    vx, vy, ax, ay, turn = (float(v) for v in track.moves[i])
    vector(base.position, x, y, model.height / 2, 3)
    base.orientation.roll = base.orientation.pitch = 0.0
    base.orientation.yaw = round(math.remainder(heading, 2 * math.pi), 4)
    vector(base.velocity, vx, vy, 0.0, 3)
    vector(base.acceleration, ax, ay, 0.0, 2)
    base.orientation_rate.roll = base.orientation_rate.pitch = 0.0
    base.orientation_rate.yaw = round(turn, 3)
    coloured(out.color_description, model.colour)
    person = model.osi_type == "TYPE_PEDESTRIAN"
    kind_of_thing = "TYPE_PEDESTRIAN" if person else "TYPE_VEHICLE"
    out.type = osi_object_pb2.MovingObject.Type.Value(kind_of_thing)
    source = out.source_reference.add(type="net.eclipse.sumo")
    source.identifier.extend([f"entity_name:{track.name}", f"entity_type:{model.name}"])
    if person:
        return
    kind = osi_object_pb2.MovingObject.VehicleClassification
    out.vehicle_classification.type = kind.Type.Value(model.osi_type)
    out.vehicle_classification.role = kind.Role.Value(model.role)
    lights, lit = out.vehicle_classification.light_state, track.lights[i]
    turning = "RIGHT" if "r" in lit else "LEFT" if "l" in lit else "OFF"
    lights.indicator_state = kind.LightState.IndicatorState.Value(f"INDICATOR_STATE_{turning}")
    brake = "NORMAL" if "b" in lit else "OFF"
    lights.brake_light_state = kind.LightState.BrakeLightState.Value(f"BRAKE_LIGHT_STATE_{brake}")
    out.vehicle_attributes.number_wheels = 2 if model.width < 1 else 4
    out.vehicle_attributes.bbcenter_to_rear.x = round(-0.3 * model.length, 3)
    out.vehicle_attributes.bbcenter_to_front.x = round(0.3 * model.length, 3)


def add_lights(out: osi_groundtruth_pb2.GroundTruth, colours: dict[str, str]) -> None:
    """Three bulbs a light, each on or off, tied to the map by the signal's id as esmini ties them."""
    drawn = town()
    kind = osi_trafficlight_pb2.TrafficLight.Classification
    for i, thing in enumerate(drawn.lights):
        signal = thing.attributes["id"]
        x, y, facing = stand_of(drawn, thing)
        for k, (state, colour, up) in enumerate(BULBS):
            bulb = out.traffic_light.add()
            bulb.id.value = FIRST_LIGHT + 3 * i + k
            size = bulb.base.dimension
            size.length, size.width, size.height = 0.2, 0.4, 0.3
            vector(bulb.base.position, x, y, LIGHT_HEIGHT + up, 3)
            bulb.base.orientation.yaw = round(math.remainder(facing, 2 * math.pi), 4)
            bulb.classification.color = kind.Color.Value(colour)
            bulb.classification.icon = kind.Icon.Value("ICON_NONE")
            mode = "MODE_CONSTANT" if colours[signal] == state else "MODE_OFF"
            bulb.classification.mode = kind.Mode.Value(mode)
            bulb.classification.is_out_of_service = False
            source = bulb.source_reference.add(type="net.asam.opendrive")
            source.identifier.append(f"traffic_light_id:{signal}")


def add_standing(out: osi_groundtruth_pb2.GroundTruth) -> None:
    """Buildings, trees and masts."""
    kind = osi_object_pb2.StationaryObject.Classification
    for i, fixture in enumerate(fixtures()):
        thing = out.stationary_object.add()
        thing.id.value = FIRST_STATIC + i
        size = thing.base.dimension
        size.length, size.width, size.height = fixture.length, fixture.width, fixture.height
        vector(thing.base.position, fixture.x, fixture.y, fixture.height / 2, 3)
        thing.base.orientation.yaw = fixture.heading
        thing.classification.type = kind.Type.Value(fixture.osi_type)
        coloured(thing.color_description, fixture.colour)
