"""Reader of logs of Argoverse 2 (sensor data set), and of their clips.

The frames have the times of the annotations, and the axes of the city. Velocities are derived.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sgstore.readers._boxes import BoxesTrace
from sgstore.readers.av2._file import FRAME, MAP

if TYPE_CHECKING:
    from sgstore.model.world import Channel


class Av2Trace(BoxesTrace):
    """Log of Argoverse 2, or a clip of such a log, which yields frames."""

    name = "av2"
    tables = ("av2",)

    @staticmethod
    def role(channel: Channel) -> str:
        """Return the role of a channel: ``ground_truth`` for annotated frames, ``map``, or else ``payload``."""
        return {FRAME: "ground_truth", MAP: "map"}.get(channel.schema, "payload")
