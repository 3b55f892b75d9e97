"""Order of reading messages with equal times. Each channel has a rank.

A frame needs the map, static entities, transforms and signals of its instant first. Messages that refer to a
frame, such as the controls of the ego, come after it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.readers._ros2 import short_name

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from sgstore.mcap import Recording

LOOSE, MAP, STATIC, TRANSFORMS, LIGHTS, STATES, EGO, CONTROLS = range(-1, 7)
"""Ranks of channels in reading order. ``LOOSE`` means any order: payloads, which frames find by time, and road
maps, which are read before all frames."""

_SCHEMAS: Final = {
    "osi3.MapAsamOpenDrive": LOOSE,
    "osi3.GroundTruth": STATES,
    "osi3.SensorView": STATES,
    "osi3.HostVehicleData": CONTROLS,
    "carla_msgs/CarlaWorldInfo": LOOSE,
    "std_msgs/String": MAP,
    "carla_msgs/CarlaActorList": STATIC,
    "carla_msgs/CarlaTrafficLightInfoList": STATIC,
    "carla_msgs/CarlaEgoVehicleInfo": STATIC,
    "carla_msgs/CarlaTrafficLightStatusList": LIGHTS,
    "derived_object_msgs/ObjectArray": STATES,
    "carla_msgs/CarlaEgoVehicleStatus": CONTROLS,
    "carla_msgs/CarlaEgoVehicleControl": CONTROLS,
    "carla_msgs/CarlaCollisionEvent": CONTROLS,
    "carla_msgs/CarlaLaneInvasionEvent": CONTROLS,
    "nav_msgs/Odometry": EGO,
    "tf2_msgs/TFMessage": TRANSFORMS,
    "foxglove.FrameTransform": TRANSFORMS,
    "foxglove.FrameTransforms": TRANSFORMS,
    "foxglove.SceneUpdate": STATES,
    "commonroad.Map": MAP,
    "commonroad.Step": STATES,
    "sumo.Timestep": STATES,
    "carla.RecorderFrame": STATES,
    "sgstore.Frame": STATES,
    "py123d.Map": MAP,
    "py123d.Frame": STATES,
    "av2.Map": MAP,
    "av2.Frame": STATES,
    **{
        f"{package}_{name}": rank
        for package in ("autoware", "autoware_auto")
        for name, rank in {
            "perception_msgs/TrafficLightGroupArray": LIGHTS,
            "perception_msgs/TrafficSignalArray": LIGHTS,
            "perception_msgs/TrackedObjects": STATES,
            "perception_msgs/PredictedObjects": STATES,
            "perception_msgs/DetectedObjects": STATES,
            "localization_msgs/KinematicState": EGO,
            "vehicle_msgs/GearReport": CONTROLS,
            "vehicle_msgs/TurnIndicatorsReport": CONTROLS,
            "vehicle_msgs/HazardLightsReport": CONTROLS,
        }.items()
    },
}
"""Name of a message schema → rank of its channels."""
_ROLES: Final = {"map": MAP, "ground_truth": STATES}
"""Role of a channel in a reader of another package → rank of the channel."""


def channel_rank(
    recording: Recording, roles: Mapping[int, str] | None = None
) -> Callable[[int], int]:
    """Return a function from channel id to rank. Among messages with equal times, the lowest rank is first.

    ``roles``: role by channel id, for channels whose schema has no rank.
    """
    known = roles or {}

    def rank(channel: int) -> int:
        schema = recording.schemas.get(recording.channels[channel].schema_id)
        named = _SCHEMAS.get(short_name(schema.name)) if schema is not None else None
        return _ROLES.get(known.get(channel, ""), LOOSE) if named is None else named

    return rank
