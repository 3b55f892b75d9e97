"""The store: one DuckDB file, and the only room that knows DuckDB.

``file`` is its face · ``access`` lets readers and writers share the file · ``rows`` runs statements, users'
too · ``traces`` names traces and frames · ``scenes`` puts one graph together · ``packing`` turns the graphs
of a block into columns and masks · ``segment`` builds a trace aside, in tables that wait in ``staging`` and a
``folder`` beside the store; ``payloads`` joins its messages to its frames, ``sealed`` is what is ready, with
``checksums``, and ``publishing`` brings it in · ``verifying`` looks whether all is as it was published ·
``schema`` makes an empty store from ``schema.sql`` · ``parquet`` writes rows to a file · ``joining`` brings
users' own tables beside the store.
"""

from sgstore.store.file import StoreFile
from sgstore.store.folder import Folder
from sgstore.store.given import GivenTable
from sgstore.store.joining import UserTables
from sgstore.store.parquet import write_parquet
from sgstore.store.rows import Batches, Rows
from sgstore.store.sealed import Sealed
from sgstore.store.segment import Segment, new_segment
from sgstore.store.traces import FrameRef, StoredTrace

__all__ = [
    "Batches",
    "Folder",
    "FrameRef",
    "GivenTable",
    "Rows",
    "Sealed",
    "Segment",
    "StoreFile",
    "StoredTrace",
    "UserTables",
    "new_segment",
    "write_parquet",
]
