"""Coverage: what a data set holds, what it lacks, and how much one says of another.

``frames`` says which frames are meant · ``classed`` gives each its class, or that of a window · ``compare``
counts: classes, coverage, novelty, what sets share, growth · ``estimates`` says how much was not seen ·
``features`` and ``slots`` combine what scenes are made of, and list what is missing as queries that ``asking``
writes · ``cells`` takes a query as a specification · ``explain`` tells two selections apart · ``failures``
looks at where a system failed.

Every answer is a table that says what its shares are of.
"""

from sgstore.coverage.cells import specification
from sgstore.coverage.classed import Classed, Missing, Unit, classed
from sgstore.coverage.compare import (
    classes,
    covered,
    growth,
    novel,
    novel_clips,
    novel_frames,
    venn,
)
from sgstore.coverage.explain import explain
from sgstore.coverage.failures import S3C_THRESHOLD, Outcomes, failures
from sgstore.coverage.features import Combos, combos
from sgstore.coverage.frames import Chosen, selection_of
from sgstore.coverage.slots import read_specifications, slot_coverage
from sgstore.coverage.tables import Table

__all__ = [
    "S3C_THRESHOLD",
    "Chosen",
    "Classed",
    "Combos",
    "Missing",
    "Outcomes",
    "Table",
    "Unit",
    "classed",
    "classes",
    "combos",
    "covered",
    "explain",
    "failures",
    "growth",
    "novel",
    "novel_clips",
    "novel_frames",
    "read_specifications",
    "selection_of",
    "slot_coverage",
    "specification",
    "venn",
]
