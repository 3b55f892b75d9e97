"""Reader of recordings made by sgstore's ``Recorder``. They contain OSI messages, and exact frames as JSON.

OSI has no fields for some values, such as the kind of a prop, the steering input, and the controls of other
vehicles.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sgstore.graphs.online import Frame
from sgstore.readers._base import FramesTrace, TraceMessage
from sgstore.readers.osi._schema import ROAD_MAP, message_class

if TYPE_CHECKING:
    from sgstore.mcap import Recording
    from sgstore.model.world import Channel

FRAME: Final = "sgstore.Frame"
"""Name of the message schema of exact frames."""


class RecordedTrace(FramesTrace):
    """Recording made by sgstore's ``Recorder``. The frames are yielded as they were recorded.

    Parameters and attributes are those of :class:`~sgstore.readers.FramesTrace`.
    """

    name = "sgstore"

    def __init__(self, recording: Recording, *, ego: str = "", digest: str = "") -> None:
        self._map_name = ""
        super().__init__(recording, ego=ego, digest=digest)
        if self.info.map_text:
            self.info = replace(self.info, map_name=self._map_name)

    @staticmethod
    def role(channel: Channel) -> str:
        """Return the role of a channel: frames, the road map, or other data."""
        return {FRAME: "ground_truth", ROAD_MAP: "map"}.get(channel.schema, "payload")

    def map_text(self, message: TraceMessage) -> str:
        """Return the OpenDRIVE text in a message with the road map, and store the name of the map."""
        record = self.recording.channels[message.channel.id]
        told = message_class(self.recording.schemas[record.schema_id]).FromString(message.data)
        self._map_name = str(told.map_reference).replace("\\", "/").rpartition("/")[2]
        return str(told.open_drive_xml_content)

    def frame(self, message: TraceMessage) -> Frame:
        """Return the frame in a message."""
        return Frame.from_dict(json.loads(message.data))
