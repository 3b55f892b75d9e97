# The face of this package: what others may import from it.

from ._blocks import MessageDecoder as MessageDecoder
from ._base import MessageTrace as MessageTrace
from ._base import channels_of as channels_of
from ._blocks import NAN as NAN
from ._blocks import POSE as POSE
from ._blocks import EntityTable as EntityTable
from ._blocks import FrameRows as FrameRows
from ._base import FramesTrace as FramesTrace
from ._base import TraceMessage as TraceMessage
from ._cameras import Cameras as Cameras
from ._cameras import LiveCameras as LiveCameras
from ._cameras import RecordedCameras as RecordedCameras
from ._media import Media as Media
from ._media import picture_form as picture_form
from ._media import png as png
from ._media import read_carried as read_carried
from ._media import record_reader as record_reader
from ._registry import ENDINGS as ENDINGS
from ._registry import READERS as READERS
from ._registry import RecordingFile as RecordingFile
from ._registry import RecordingReader as RecordingReader
from ._registry import is_recording as is_recording
from ._registry import on_map as on_map
from ._registry import open_recording as open_recording
from ._registry import open_trace as open_trace
from ._registry import read_message as read_message
from ._registry import read_messages as read_messages
from ._registry import readers as readers
from ._roles import channel_rank as channel_rank
from ._ros2 import decode as decode
from ._ros2 import parse_definition as parse_definition
from .carla._live import LiveWorld as LiveWorld
from .carla._live import connect as connect
from .carla._live import Sensor as Sensor
from .carla._live import SensorCloud as SensorCloud
from .carla._live import SensorPicture as SensorPicture
from .carla._live import SensorReading as SensorReading
from .carla._live import Sensors as Sensors
from .carla._live import load_sensors as load_sensors
from .commonroad._file import CommonRoadFile as CommonRoadFile
from .foxglove._messages import DERIVED as DERIVED
from .osi._file import OsiFile as OsiFile
from .osi._schema import add_fields as add_fields
from .osi._schema import descriptors as descriptors
from .osi._schema import message_class as message_class

__all__ = [
    "Cameras",
    "CommonRoadFile",
    "DERIVED",
    "ENDINGS",
    "EntityTable",
    "FrameRows",
    "FramesTrace",
    "LiveCameras",
    "LiveWorld",
    "Media",
    "MessageDecoder",
    "MessageTrace",
    "NAN",
    "OsiFile",
    "POSE",
    "READERS",
    "RecordedCameras",
    "RecordingFile",
    "RecordingReader",
    "Sensor",
    "SensorCloud",
    "SensorPicture",
    "SensorReading",
    "Sensors",
    "TraceMessage",
    "add_fields",
    "channel_rank",
    "channels_of",
    "connect",
    "decode",
    "descriptors",
    "is_recording",
    "load_sensors",
    "message_class",
    "on_map",
    "open_recording",
    "open_trace",
    "parse_definition",
    "picture_form",
    "png",
    "read_carried",
    "read_message",
    "read_messages",
    "readers",
    "record_reader",
]
