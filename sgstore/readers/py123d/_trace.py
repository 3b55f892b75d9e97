"""Reader of logs of 123D, and of their clips. The frames have the times of the annotations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sgstore.readers._boxes import BoxesTrace
from sgstore.readers.py123d._file import FRAME, MAP

if TYPE_CHECKING:
    from sgstore.graphs.online import Frame
    from sgstore.model.world import Channel


class Py123dTrace(BoxesTrace):
    """Log of 123D, or a clip of such a log, which yields frames."""

    name = "py123d"
    tables = ("py123d", "av2")

    @staticmethod
    def role(channel: Channel) -> str:
        """Return the role of a channel: ``ground_truth`` for frames, ``map``, or otherwise ``payload``."""
        return {FRAME: "ground_truth", MAP: "map"}.get(channel.schema, "payload")

    def add_lights(self, frame: Frame, told: dict[str, Any]) -> None:
        """Add the traffic lights of lanes to a frame. Each is placed at the start of its lane."""
        still = dict.fromkeys(("vx", "vy", "vz", "ax", "ay", "az", "yaw_rate"), 0.0)
        for one in told.get("lights", ()):
            place = one["x"], one["y"], one["z"]
            about = {"light_state": one["state"], "map_ref": one["id"]}
            frame.add(f"light {one['id']}", "traffic_light", *place, **about, **still)
