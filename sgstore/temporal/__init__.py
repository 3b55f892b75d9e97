"""Temporal logic: LTLf with past operators and time bounds, on recorded traces or frame by frame.

Both engines return the same results: :func:`evaluate` for all frames of a trace at once, :class:`OnlineFormula`
frame by frame, as early as possible.
"""

from sgstore.temporal._check_verdict import (
    Verdict,
    ViolationInterval,
    Witness,
    absence_text,
    cell_of,
    columns_returned,
    false_text,
    margin_cells,
    returned_by,
    unknown_notes,
    verdict_columns,
    verdict_rows,
)
from sgstore.temporal._checks import CheckRun
from sgstore.temporal._followed import RecentGraphs
from sgstore.temporal._formula import Formula
from sgstore.temporal._matches import TemporalMatches
from sgstore.temporal._monitor import FrameSource, Monitor, opened, paced
from sgstore.temporal._plan import kept_throughout
from sgstore.temporal._robustness import Robustness
from sgstore.temporal._sequence_monitor import FrameTime, MonitorEvent
from sgstore.temporal._shrink import ShortestClip, shortest_clips
from sgstore.temporal._signals import evaluate

__all__ = [
    "CheckRun",
    "Formula",
    "FrameSource",
    "FrameTime",
    "Monitor",
    "MonitorEvent",
    "RecentGraphs",
    "Robustness",
    "ShortestClip",
    "TemporalMatches",
    "Verdict",
    "ViolationInterval",
    "Witness",
    "absence_text",
    "cell_of",
    "columns_returned",
    "evaluate",
    "false_text",
    "kept_throughout",
    "margin_cells",
    "opened",
    "paced",
    "returned_by",
    "shortest_clips",
    "unknown_notes",
    "verdict_columns",
    "verdict_rows",
]
