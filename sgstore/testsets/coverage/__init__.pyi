# The face of this package: what others may import from it.

from ._classes import UNKNOWN as UNKNOWN
from ._classes import Classed as Classed
from ._classes import CountedUnit as CountedUnit
from ._classes import Missing as Missing
from ._classes import classed as classed
from ._classes import shared as shared
from ._compare import classes as classes
from ._compare import covered as covered
from ._compare import expected_classes as expected_classes
from ._compare import growth as growth
from ._compare import novel as novel
from ._compare import novel_clips as novel_clips
from ._compare import novel_frames as novel_frames
from ._compare import rank_sizes as rank_sizes
from ._compare import venn as venn
from ._compare import S3C_THRESHOLD as S3C_THRESHOLD
from ._compare import failures as failures
from ._compare import read_outcomes as read_outcomes
from ._compare import told_outcomes as told_outcomes
from ._features import Combinations as Combinations
from ._features import Combos as Combos
from ._features import combined as combined
from ._features import combos as combos
from ._features import explain as explain
from ._features import features as features
from ._frames import ChosenFrames as ChosenFrames
from ._frames import ReportTable as ReportTable
from ._frames import frames_of as frames_of
from ._frames import names_of as names_of
from ._frames import recordings_of as recordings_of
from ._frames import traces_of as traces_of
from ._frames import of_unknown as of_unknown
from ._frames import periods_of as periods_of
from ._frames import run_begins as run_begins
from ._frames import selection_of as selection_of
from ._sequences import WITHIN_S as WITHIN_S
from ._sequences import ManoeuvreEvents as ManoeuvreEvents
from ._sequences import SequenceCoverage as SequenceCoverage
from ._sequences import check_sequences as check_sequences
from ._sequences import happenings as happenings
from ._sequences import manoeuvres_named as manoeuvres_named
from ._sequences import sequences as sequences
from ._sequences import sequences_in as sequences_in
from ._slots import Specification as Specification
from ._slots import read_specifications as read_specifications
from ._slots import slot_coverage as slot_coverage
from ._slots import slot_matrix as slot_matrix
from ._slots import specification as specification

__all__ = [
    "ChosenFrames",
    "Classed",
    "Combinations",
    "Combos",
    "CountedUnit",
    "ManoeuvreEvents",
    "Missing",
    "ReportTable",
    "S3C_THRESHOLD",
    "SequenceCoverage",
    "Specification",
    "UNKNOWN",
    "WITHIN_S",
    "check_sequences",
    "classed",
    "classes",
    "combined",
    "combos",
    "covered",
    "expected_classes",
    "explain",
    "failures",
    "features",
    "frames_of",
    "growth",
    "happenings",
    "manoeuvres_named",
    "names_of",
    "recordings_of",
    "traces_of",
    "novel",
    "novel_clips",
    "novel_frames",
    "of_unknown",
    "periods_of",
    "rank_sizes",
    "read_outcomes",
    "read_specifications",
    "run_begins",
    "selection_of",
    "sequences",
    "sequences_in",
    "shared",
    "slot_coverage",
    "slot_matrix",
    "specification",
    "told_outcomes",
    "venn",
]
