"""Readers of driving recordings: one package per recording type (CARLA, OSI, …), and base classes."""

from sgstore.readers._base import FramesTrace, MessageTrace, TraceMessage, channels_of
from sgstore.readers._blocks import NAN, POSE, EntityTable, FrameRows, MessageDecoder
from sgstore.readers._cameras import Cameras, LiveCameras, RecordedCameras
from sgstore.readers._media import Media, picture_form, png, read_carried, record_reader
from sgstore.readers._registry import (
    ENDINGS,
    READERS,
    RecordingFile,
    RecordingReader,
    is_recording,
    on_map,
    open_recording,
    open_trace,
    read_message,
    read_messages,
)
from sgstore.readers._roles import channel_rank
from sgstore.readers._ros2 import decode, parse_definition
from sgstore.readers._topics import TopicBatch, TopicReading
from sgstore.readers.carla._live import (
    LiveWorld,
    Sensor,
    SensorCloud,
    SensorPicture,
    SensorReading,
    Sensors,
    connect,
    load_sensors,
)
from sgstore.readers.commonroad._file import CommonRoadFile
from sgstore.readers.foxglove._messages import DERIVED
from sgstore.readers.osi._file import OsiFile
from sgstore.readers.osi._schema import add_fields, descriptors, message_class

__all__ = [
    "DERIVED",
    "ENDINGS",
    "READERS",
    "Cameras",
    "CommonRoadFile",
    "LiveCameras",
    "LiveWorld",
    "Media",
    "OsiFile",
    "RecordedCameras",
    "RecordingFile",
    "Sensor",
    "SensorCloud",
    "SensorPicture",
    "SensorReading",
    "Sensors",
    "TopicBatch",
    "TopicReading",
    "add_fields",
    "channel_rank",
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
    "record_reader",
]

# For authors of readers; see docs/flavours.md.
__all__ += [
    "NAN",
    "POSE",
    "EntityTable",
    "FrameRows",
    "FramesTrace",
    "MessageDecoder",
    "MessageTrace",
    "RecordingReader",
    "TraceMessage",
    "channels_of",
]
