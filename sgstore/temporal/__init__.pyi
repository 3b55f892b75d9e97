# The face of this package: what others may import from it.

from ._checks import CheckRun as CheckRun
from ._checks import Verdict as Verdict
from ._checks import absence_text as absence_text
from ._checks import cell_of as cell_of
from ._checks import columns_returned as columns_returned
from ._checks import margin_cells as margin_cells
from ._checks import returned_by as returned_by
from ._checks import Witness as Witness
from ._checks import unknown_notes as unknown_notes
from ._checks import verdict_columns as verdict_columns
from ._checks import verdict_rows as verdict_rows
from ._formula import Formula as Formula
from ._matches import TemporalMatches as TemporalMatches
from ._monitor import FrameSource as FrameSource
from ._monitor import Monitor as Monitor
from ._followed import RecentGraphs as RecentGraphs
from ._monitor import opened as opened
from ._monitor import paced as paced
from ._plan import kept_throughout as kept_throughout
from ._robustness import Robustness as Robustness
from ._sequence_monitor import FrameTime as FrameTime
from ._sequence_monitor import MonitorEvent as MonitorEvent
from ._shrink import ShortestClip as ShortestClip
from ._shrink import shortest_clips as shortest_clips
from ._signals import evaluate as evaluate

__all__ = [
    "CheckRun",
    "Formula",
    "FrameSource",
    "FrameTime",
    "Monitor",
    "MonitorEvent",
    "Robustness",
    "ShortestClip",
    "TemporalMatches",
    "Verdict",
    "Witness",
    "evaluate",
    "kept_throughout",
    "absence_text",
    "cell_of",
    "columns_returned",
    "margin_cells",
    "returned_by",
    "opened",
    "shortest_clips",
    "unknown_notes",
    "verdict_columns",
    "verdict_rows",
]
