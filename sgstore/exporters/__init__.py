"""Exporters: clips and their scene graphs as files of other tools, one module per format.

Each export is first written to a temporary folder, then moved completely or not at all, with a
manifest. A format is a function from an :class:`Export` and a folder to the written files. Other
packages add formats with an entry point of the group ``sgstore.exporters``: the name of the format,
and an :class:`Exporter`.
"""

from sgstore.exporters._clip_frames import FEW, ClipFrames, Export
from sgstore.exporters._clips import WrittenClip, WrittenFile, check_folder
from sgstore.exporters._labels import Labels, parse_labels
from sgstore.exporters._nx import graphs_of
from sgstore.exporters._recorder import Recorder, Written
from sgstore.exporters._registry import EXPORTERS, GROUP, Exporter, Write, exporter_named, exporters
from sgstore.exporters._sensor_data import cloud_of
from sgstore.exporters._transforms import Mount, parse_mounts
from sgstore.exporters._write import (
    around_frames,
    labelled,
    whole_clips,
    write_export,
)

__all__ = [
    "EXPORTERS",
    "FEW",
    "GROUP",
    "ClipFrames",
    "Export",
    "Exporter",
    "Labels",
    "Mount",
    "Recorder",
    "Write",
    "Written",
    "WrittenClip",
    "WrittenFile",
    "around_frames",
    "check_folder",
    "cloud_of",
    "exporter_named",
    "exporters",
    "graphs_of",
    "labelled",
    "parse_labels",
    "parse_mounts",
    "whole_clips",
    "write_export",
]
