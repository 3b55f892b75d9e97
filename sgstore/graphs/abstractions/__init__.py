"""Abstractions: simpler labelled graphs from the literature, made from scene graphs, and their graph classes.

An abstraction is a function from columns (:class:`GraphColumns`) to columns (:class:`Labelled`).
:data:`ABSTRACTIONS` lists the built-in ones. Users add their own with :func:`register`, or as an
entry point of the group ``sgstore.abstractions``. ``_classes`` defines classes.
"""

from sgstore.graphs.abstractions._classes import Classes, classes_of, contents_of
from sgstore.graphs.abstractions._columns import GraphColumns, Labelled, MapColumns, found
from sgstore.graphs.abstractions._features import GraphFeatures, of_frames, without
from sgstore.graphs.abstractions._lane_roles import lane_roles
from sgstore.graphs.abstractions._registry import (
    ABSTRACTIONS,
    AT_INGEST,
    Abstraction,
    abstraction_named,
    abstractions,
    check_name,
    register,
)
from sgstore.graphs.abstractions._subsets import SUBSETS, Subset

__all__ = [
    "ABSTRACTIONS",
    "AT_INGEST",
    "SUBSETS",
    "Abstraction",
    "Classes",
    "GraphColumns",
    "GraphFeatures",
    "Labelled",
    "MapColumns",
    "Subset",
    "abstraction_named",
    "abstractions",
    "check_name",
    "classes_of",
    "contents_of",
    "found",
    "lane_roles",
    "of_frames",
    "register",
    "without",
]
