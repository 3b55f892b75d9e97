"""Coverage: the kinds of scenes that a data set contains or lacks, also in comparison with another data set.

``_frames`` defines selections of frames and result tables. ``_classes`` assigns a class to each
frame or window. ``_compare`` counts classes, coverage, novelty, common classes and growth,
estimates the number of unseen classes, and evaluates failures of a system. ``_features``,
``_slots`` and ``_sequences`` count combinations and list missing ones as queries.

Every result is a table that names the denominators of its shares.
"""

from sgstore.testsets.coverage._chosen_frames import (
    ChosenFrames,
    frames_of,
    names_of,
    periods_of,
    recordings_of,
    run_begins,
    selection_of,
    traces_of,
)
from sgstore.testsets.coverage._classes import UNKNOWN, Classed, classed, shared
from sgstore.testsets.coverage._compare import (
    classes,
    covered,
    expected_classes,
    growth,
    novel,
    novel_clips,
    novel_frames,
    rank_sizes,
    venn,
)
from sgstore.testsets.coverage._differences import explain
from sgstore.testsets.coverage._failures import failures, read_outcomes, told_outcomes
from sgstore.testsets.coverage._features import Combinations, combos, features
from sgstore.testsets.coverage._frames import ReportTable, of_unknown
from sgstore.testsets.coverage._iso34502 import iso34502
from sgstore.testsets.coverage._sequences import (
    WITHIN_S,
    check_sequences,
    happenings,
    manoeuvres_named,
    sequences,
    sequences_in,
)
from sgstore.testsets.coverage._slots import Specification, slot_coverage, specification

__all__ = [
    "UNKNOWN",
    "WITHIN_S",
    "ChosenFrames",
    "Classed",
    "Combinations",
    "ReportTable",
    "Specification",
    "check_sequences",
    "classed",
    "classes",
    "combos",
    "covered",
    "expected_classes",
    "explain",
    "failures",
    "features",
    "frames_of",
    "growth",
    "happenings",
    "iso34502",
    "manoeuvres_named",
    "names_of",
    "novel",
    "novel_clips",
    "novel_frames",
    "of_unknown",
    "periods_of",
    "rank_sizes",
    "read_outcomes",
    "recordings_of",
    "run_begins",
    "selection_of",
    "sequences",
    "sequences_in",
    "shared",
    "slot_coverage",
    "specification",
    "told_outcomes",
    "traces_of",
    "venn",
]
