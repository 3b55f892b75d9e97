"""Reader of CommonRoad scenarios (``.xml``), and of clips of scenarios.

Source: CommonRoad: XML format documentation, versions 2018b and 2020a (Technical University of Munich).
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.graphs.online import Frame
from sgstore.maps.roads import OF_LANES
from sgstore.model.vocabulary import TypeMeaning, type_meanings
from sgstore.readers._base import FramesTrace, TraceMessage
from sgstore.readers.commonroad._file import MAP, NAME, STEP

if TYPE_CHECKING:
    from sgstore.mcap import Recording
    from sgstore.model.world import Channel

_STATES: Final = {
    "red": "red",
    "yellow": "yellow",
    "green": "green",
    "redYellow": "red_yellow",
    "inactive": "off",
}
_POSE: Final = ("x", "y", "z", "length", "width", "vx", "vy", "ax", "ay")
_STILL: Final = dict.fromkeys(("vx", "vy", "vz", "ax", "ay", "az", "yaw_rate"), 0.0)


class CommonRoadTrace(FramesTrace):
    """CommonRoad scenario, or a clip of a scenario, which yields frames.

    Parameters and attributes are those of :class:`~sgstore.readers.FramesTrace`.
    """

    name = "commonroad"

    def __init__(self, recording: Recording, *, ego: str = "", digest: str = "") -> None:
        super().__init__(recording, ego=ego, digest=digest)
        if self.info.map_text:
            names = (channel.metadata.get(NAME, "") for channel in recording.channels.values())
            name = next((name for name in names if name), "") or recording.path.stem
            self.info = replace(self.info, map_name=f"{name}{OF_LANES}")

    @staticmethod
    def role(channel: Channel) -> str:
        """Return the role of a channel: ``ground_truth`` for time steps, ``map``, or otherwise ``payload``."""
        return {STEP: "ground_truth", MAP: "map"}.get(channel.schema, "payload")

    def frame(self, message: TraceMessage) -> Frame:
        """Return the frame of a time step. It has no ego, because scenarios have none."""
        told = json.loads(message.data)
        frame = Frame(round(told["time"] * 1e9))
        for one in told["obstacles"]:
            moves: dict[str, Any] = dict.fromkeys(("vz", "az"), 0.0)
            _add(frame, one, **moves, lights=one.get("signals"))
        for one in told.get("standing", ()):
            _add(frame, one, static=True)
        for one in told.get("lights", ()):
            place = [one[axis] for axis in "xyz"]
            state = _STATES.get(one["state"], "unknown")
            ident = one["id"]
            frame.add(ident, "traffic_light", *place, light_state=state, map_ref=ident, **_STILL)
        for one in told.get("signs", ()):
            place = [one[axis] for axis in "xyz"]
            about = {"subkind": one.get("subkind", ""), "map_ref": one["id"]}
            frame.add(one["id"], one["kind"], *place, static=True, **about)
        return frame


def _add(frame: Frame, one: dict[str, Any], **more: Any) -> None:
    meaning = type_meanings().get(f"commonroad_{one['type']}".lower(), TypeMeaning("unknown"))
    numbers = {name: one[name] for name in _POSE if name in one}
    numbers |= {name: math.degrees(one[name]) for name in ("heading", "yaw_rate") if name in one}
    about = {"special": meaning.special, "subkind": meaning.subkind, "type_name": one["type"]}
    frame.add(one["id"], meaning.kind, **about, **numbers, **more)
