"""Reader of logs of CARLA's recorder (``client.start_recorder("drive.log")``), and of their clips.

A frame is a frame of the simulator. The log names its map, but does not contain it. CARLA's y and yaw change
their signs. The position of an actor is its origin, mostly on the ground; in sgstore, it is the centre of its
box. The mapping ``carla_origins`` keeps the origins, for comparison with metrics of ScenarioRunner.

ScenarioRunner hides an actor by a place 500 m below the road. Such actors are left out.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import TraceError
from sgstore.graphs.online import Frame
from sgstore.model.world import TraceReport
from sgstore.readers._base import FramesTrace, TraceMessage
from sgstore.readers.carla._live import LIGHTS, in_world
from sgstore.readers.carla._recorder_file import FRAME, TOWN
from sgstore.readers.carla._signals import Light, light_state, shared_signals, sign_at, signals_of
from sgstore.readers.carla._survey import EGO_ROLES, meaning_of

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap
    from sgstore.mcap import Recording
    from sgstore.model.world import Channel

ORIGINS: Final = "carla_origins"
"""Mapping file that uses the origins of actors as their positions."""
HIDDEN_BELOW: Final = 100.0
"""Depth below the ego (without an ego: below 0) at which an actor counts as hidden; m."""

_STILL: Final = dict.fromkeys(("vx", "vy", "vz", "ax", "ay", "az", "yaw_rate"), 0.0)


class CarlaRecorderTrace(FramesTrace):
    """Log of CARLA's recorder, or a clip of such a log, which yields frames.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id or role name of the ego; empty: the vehicle with the role ``hero`` or ``ego_vehicle``.
    digest : str
        SHA-256 of the file if known; empty: the file is hashed.
    mapping : str
        ``carla_origins``: positions are the origins of actors instead of the centres of their boxes.
    """

    name = "carla_recorder"

    def __init__(
        self, recording: Recording, *, ego: str = "", digest: str = "", mapping: str = ""
    ) -> None:
        self._origins = str(mapping) == ORIGINS
        self._places: dict[int, Light] = {}
        self._signals: dict[int, str] = {}
        self._road_map: RoadMap | None = None
        self._report = TraceReport()
        self.recording = recording
        super().__init__(recording, ego=ego and self.ego_named(ego), digest=digest)
        towns = (channel.metadata.get(TOWN, "") for channel in recording.channels.values())
        self.info = replace(self.info, map_name=next(filter(None, towns), ""))

    def ego_named(self, name: str) -> str:
        """Return the id of the actor that has a given id or role name.

        Raises
        ------
        TraceError
            No actor has it.
        """
        channels = {number for number, c in self.recording.channels.items() if self._is_frames(c)}
        roles: dict[str, None] = {}
        for run in self.recording.walk(TraceReport()):
            for row, channel in enumerate(run.channel.tolist()):
                if channel not in channels:
                    continue
                for actor in _actors(run.data(row)):
                    if name in (str(actor.get("id")), actor.get("role")):
                        return str(actor.get("id"))
                    roles[str(actor.get("role", actor.get("id")))] = None
        listed = ", ".join([*roles][:20])
        raise TraceError(f"no vehicle or walker has the id or role {name!r}; there are: {listed}")

    def _is_frames(self, channel: Any) -> bool:
        return self.recording.schemas[channel.schema_id].name == FRAME

    @staticmethod
    def role(channel: Channel) -> str:
        """Return the role of a channel: ``ground_truth`` for frames, otherwise ``payload``."""
        return "ground_truth" if channel.schema == FRAME else "payload"

    def on_map(self, road_map: RoadMap | None) -> None:
        """Find the map signals that belong to the traffic lights and signs of the log."""
        self._road_map = road_map
        if road_map is not None and self._places:
            self._signals = signals_of(self._places, road_map)

    def decoder(self, report: TraceReport) -> Any:
        """Return a new decoder of frames. Add the warnings about traffic lights to a report."""
        self._report = report
        if self._road_map is not None:
            report.warnings += shared_signals(self._signals, self._road_map)
        return super().decoder(report)

    def frame(self, message: TraceMessage) -> Frame:
        """Convert a message of the log (JSON with actors) to a frame."""
        told = json.loads(message.data)
        egos = {one.get("role"): one for one in reversed(told["actors"])}
        ego = next((egos[role] for role in EGO_ROLES if role in egos), None)
        frame = Frame(round(told["elapsed"] * 1e9), None if ego is None else ego["id"])
        ground = 0.0 if ego is None else ego["location"][2]
        for one in told["actors"]:
            if one["location"][2] > ground - HIDDEN_BELOW:
                self._add(frame, one, **_motion(one), **_inputs(one))
            else:
                self._hide(one)
        for one in told["traffic_lights"]:
            self._add_light(frame, one)
        for one in told["standing"]:
            x, y, _ = one["location"]
            signs = self._road_map is not None and one["type"].startswith("traffic.")
            sign = sign_at(self._road_map, x, -y) if signs and self._road_map is not None else ""
            self._add(frame, one, static=True, map_ref=sign)
        here = {entity.ident for entity in frame.entities}
        for pair in told.get("collisions", ()):
            frame.happened("collision", *(str(one) if str(one) in here else "" for one in pair))
        return frame

    def _hide(self, one: dict[str, Any]) -> None:
        words = (
            f"actor {one['id']} is hidden below the road in some frames, and is left out of them"
        )
        if words not in self._report.warnings:
            self._report.warnings.append(words)

    def _add(self, frame: Frame, one: dict[str, Any], **more: Any) -> None:
        x, y, z, *half = one.get("box", (0.0, 0.0, 0.0, math.nan, math.nan, math.nan))
        if self._origins:
            x, y, z = 0.0, 0.0, 0.0
        roll, pitch, yaw = one["rotation"]
        meaning = meaning_of(one["type"])
        frame.add(
            *(one["id"], meaning.kind, *in_world((x, y, z), _transform(one))),
            heading=0.0 - yaw,
            pitch=0.0 - pitch,
            roll=roll,
            **dict(zip(("length", "width", "height"), (2 * abs(e) for e in half), strict=True)),
            special=meaning.special,
            subkind=meaning.subkind,
            type_name=one["type"],
            **more,
        )
        if not more.get("static") and "box" in one:
            x, y, z = one["location"]
            own = {"origin_x": x, "origin_y": 0.0 - y, "origin_z": z}
            entity = frame.entities.pop()
            frame.entities.append(entity._replace(own={**(entity.own or {}), **own}))

    def _add_light(self, frame: Frame, one: dict[str, Any]) -> None:
        """Add a traffic light to a frame, without its box. Such a box is an area on the road."""
        ident, (x, y, z), yaw = one["id"], one["location"], one["rotation"][2]
        self._places.setdefault(ident, Light(x, -y, z, math.radians(-yaw)))
        bare = {key: value for key, value in one.items() if key != "box"}
        state = light_state(one.get("state", -1))
        self._add(frame, bare, light_state=state, map_ref=self._signals.get(ident, ""), **_STILL)


def _actors(data: Any) -> list[dict[str, Any]]:
    try:
        return [one for one in json.loads(bytes(data))["actors"] if isinstance(one, dict)]
    except (ValueError, TypeError, LookupError, RecursionError):
        return []


def _transform(one: dict[str, Any]) -> Any:
    """Return the pose of an actor with the attributes of a ``carla.Transform``."""
    place = dict(zip("xyz", one["location"], strict=True))
    turn = dict(zip(("roll", "pitch", "yaw"), one["rotation"], strict=True))
    return SimpleNamespace(location=SimpleNamespace(**place), rotation=SimpleNamespace(**turn))


def _motion(one: dict[str, Any]) -> dict[str, float]:
    """Return the recorded velocity and yaw rate of an actor. Missing values are derived later."""
    if "velocity" not in one:
        return {}
    x, y, z = one["velocity"]
    return {"vx": x, "vy": 0.0 - y, "vz": z, "yaw_rate": 0.0 - one["angular_velocity"][2]}


def _inputs(one: dict[str, Any]) -> dict[str, Any]:
    """Return controls and lights of a vehicle. The steering gets the opposite sign, as in sgstore."""
    told: dict[str, Any] = {}
    if "control" in one:
        told = dict(one["control"])
        told["steer"] = 0.0 - told["steer"]
    if "lights" in one:
        told["lights"] = [name for bit, name in LIGHTS if one["lights"] & bit]
    return told
