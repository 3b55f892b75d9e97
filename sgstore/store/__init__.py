"""Store of scene graphs: one DuckDB file. Only this package of sgstore uses DuckDB.

Reading: ``_file`` has the main class, :class:`StoreFile`. ``_locking`` shares the file between readers and
writers, with ``_gate`` and ``_lease``. ``_schema`` checks it against ``schema.sql`` before the first read.
``_rows`` runs SQL statements; ``_arrow`` and ``_table_files`` convert their rows. ``_temporary_tables`` creates
the temporary tables of a statement, and ``_interrupts`` interrupts statements. ``_traces`` finds traces
and frames by name, and ``_graphs`` reads graphs. ``_catalog`` describes the store for the query compiler.
``_joins`` joins user tables, ``_encounters`` computes measures of later encounters, and ``_contents`` computes
digests of frames.

Writing: ``_packing`` converts the graphs of a block to columns and masks. ``_write`` builds a trace outside the
store, in ``_staging``, as arrays in a file of ``_table_stream``. ``_columns`` sorts them, and ``_checksums``
computes their checksums. ``_payloads`` joins messages to frames, and ``_publish`` adds the trace to the store.
``_classes`` adds frame classes, ``_derive`` adds derived sets of relations; ``_similarity`` compares frames.
``_verify`` verifies a store; ``_creation`` creates stores, and ``_rebuild`` rewrites them.

Collections: ``_bundles`` copies traces into new stores, describes their content, and splits segments
before that. ``_merge`` merges the results of several bundles.
"""

from sgstore.store._bundles import (
    CATALOGUE,
    BundleSource,
    Facts,
    facts_of,
    split_segment,
    whole_segment,
)
from sgstore.store._catalog import subset_catalogs
from sgstore.store._classes import Abstracted, CodedClasses, Triples
from sgstore.store._clients import duckdb
from sgstore.store._contents import Mark, MessagePlaces
from sgstore.store._encounters import measured
from sgstore.store._file import StoreFile
from sgstore.store._graph_digests import graph_digests
from sgstore.store._joins import UserTables
from sgstore.store._merge import PartFile
from sgstore.store._publish import PresentError
from sgstore.store._rebuild import OldMap, OldTrace, Remains
from sgstore.store._rows import Rows, Tabular, count_parquet
from sgstore.store._schema import SCHEMA_VERSION
from sgstore.store._similarity import Example, SimilarFrames
from sgstore.store._staging import Sealed
from sgstore.store._state_columns import StateColumns
from sgstore.store._store_paths import Folder
from sgstore.store._table_files import ParquetTable
from sgstore.store._temporary_tables import Given, GivenTable
from sgstore.store._traces import FrameRef, Identity, StoredTrace
from sgstore.store._verify import verify_file
from sgstore.store._write import OnMap, Segment

__all__ = [
    "CATALOGUE",
    "SCHEMA_VERSION",
    "Abstracted",
    "BundleSource",
    "CodedClasses",
    "Example",
    "Facts",
    "Folder",
    "FrameRef",
    "Given",
    "GivenTable",
    "Identity",
    "Mark",
    "MessagePlaces",
    "OldMap",
    "OldTrace",
    "OnMap",
    "ParquetTable",
    "PartFile",
    "PresentError",
    "Remains",
    "Rows",
    "Sealed",
    "Segment",
    "SimilarFrames",
    "StateColumns",
    "StoreFile",
    "StoredTrace",
    "Tabular",
    "Triples",
    "UserTables",
    "count_parquet",
    "duckdb",
    "facts_of",
    "graph_digests",
    "measured",
    "split_segment",
    "subset_catalogs",
    "verify_file",
    "whole_segment",
]
