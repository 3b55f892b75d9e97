# The face of this package: what others may import from it.

from ._clips import WrittenClip as WrittenClip
from ._clips import WrittenFile as WrittenFile
from ._clips import check_folder as check_folder
from ._frames import cloud_of as cloud_of
from ._labels import FEW as FEW
from ._labels import ClipFrames as ClipFrames
from ._labels import Export as Export
from ._labels import Labels as Labels
from ._labels import parse_labels as parse_labels
from ._nx import graphs_of as graphs_of
from ._recorder import Recorder as Recorder
from ._recorder import Written as Written
from ._registry import EXPORTERS as EXPORTERS
from ._registry import GROUP as GROUP
from ._registry import Exporter as Exporter
from ._registry import Write as Write
from ._transforms import Mount as Mount
from ._transforms import parse_mounts as parse_mounts
from ._write import around_frames as around_frames
from ._registry import exporter_named as exporter_named
from ._registry import exporters as exporters
from ._write import labelled as labelled
from ._write import write_export as write_export

__all__ = [
    "ClipFrames",
    "EXPORTERS",
    "Export",
    "Exporter",
    "FEW",
    "GROUP",
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
    "write_export",
]
