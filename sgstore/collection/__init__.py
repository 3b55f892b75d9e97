"""Collections: many store files (bundles) in a folder or object store. Queries work as in a single store.

A collection is a folder, or a prefix in an object store. It has *bundles*, which are immutable
stores of some hundreds of traces, and a *catalogue* of their contents. ``_storage`` reads and writes
such places, ``_catalogue`` the snapshots of the catalogue. ``_pack`` makes bundles of stores and of
landed segments, and maintains them.

A query is compiled once against the whole collection. An engine (``_engines``: local processes,
Ray, Spark) then runs ``_worker`` on each bundle that may have results. ``_questions`` merges the
results.
"""

from sgstore.collection._landing import land
from sgstore.collection._maintenance import CollectionFaults, Garbage, gc, rebuild, verify
from sgstore.collection._pack import Commit, commit, pack, unpack
from sgstore.collection._questions import (
    Collection,
    CollectionChecks,
    CollectionFrames,
    CollectionMatches,
    CollectionRows,
    CollectionUnion,
    PartialAnswerError,
    open,
)
from sgstore.collection._storage import ABOUT

__all__ = [
    "ABOUT",
    "Collection",
    "CollectionChecks",
    "CollectionFaults",
    "CollectionFrames",
    "CollectionMatches",
    "CollectionRows",
    "CollectionUnion",
    "Commit",
    "Garbage",
    "PartialAnswerError",
    "commit",
    "gc",
    "land",
    "open",
    "pack",
    "rebuild",
    "unpack",
    "verify",
]
