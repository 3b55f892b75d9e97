# The face of this package: what others may import from it.

from ._bundles import CATALOGUE as CATALOGUE
from ._bundles import Facts as Facts
from ._bundles import answers_of as answers_of
from ._bundles import facts_of as facts_of
from ._bundles import join_bundles as join_bundles
from ._bundles import maps_of_traces as maps_of_traces
from ._bundles import names_of_traces as names_of_traces
from ._bundles import parquet_rows as parquet_rows
from ._bundles import write_bundle as write_bundle
from ._catalog import relations_of_set as relations_of_set
from ._catalog import subset_catalogs as subset_catalogs
from ._encounters import measured as measured
from ._traces import scope_of as scope_of
from ._traces import scope_text as scope_text
from ._landed import split_segment as split_segment
from ._landed import whole_segment as whole_segment
from ._merge import PartFile as PartFile
from ._merge import merged_arrays as merged_arrays
from ._merge import merged_classes as merged_classes
from ._merge import merged_file as merged_file
from ._merge import merged_parts as merged_parts
from ._merge import write_classes as write_classes
from ._merge import write_coded as write_coded
from ._merge import write_rows as write_rows
from ._merge import write_part as write_part
from ._classes import Abstracted as Abstracted
from ._classes import CodedClasses as CodedClasses
from ._classes import Triples as Triples
from ._contents import DIGEST_BYTES as DIGEST_BYTES
from ._contents import WINDOW as WINDOW
from ._contents import Mark as Mark
from ._contents import MessagePlaces as MessagePlaces
from ._contents import graph_digests as graph_digests
from ._contents import lengths_of_messages as lengths_of_messages
from ._contents import marks as marks
from ._contents import messages_of as messages_of
from ._schema import SCHEMA_VERSION as SCHEMA_VERSION
from ._file import StoreFile as StoreFile
from ._given import Given as Given
from ._given import GivenTable as GivenTable
from ._joins import UserTables as UserTables
from ._locking import Folder as Folder
from ._clients import duckdb as duckdb
from ._locking import refuse_name as refuse_name
from ._packing import BUCKET_BITS as BUCKET_BITS
from ._packing import trace_of as trace_of
from ._packing import seq_of as seq_of
from ._packing import begins as begins
from ._packing import SEQ_BITS as SEQ_BITS
from ._packing import frame_ids as frame_ids
from ._publish import PresentError as PresentError
from ._rebuild import OldMap as OldMap
from ._rebuild import OldTrace as OldTrace
from ._rebuild import Remains as Remains
from ._rebuild import named_as as named_as
from ._rebuild import remains_of as remains_of
from ._rebuild import take_place as take_place
from ._rows import Batches as Batches
from ._rows import IN_NOTEBOOK as IN_NOTEBOOK
from ._rows import ParquetTable as ParquetTable
from ._rows import Rows as Rows
from ._rows import Tabular as Tabular
from ._rows import as_told as as_told
from ._rows import as_told_batches as as_told_batches
from ._rows import arrow_file as arrow_file
from ._rows import count_parquet as count_parquet
from ._rows import write_csv as write_csv
from ._rows import write_batches as write_batches
from ._rows import write_parquet as write_parquet
from ._similarity import Example as Example
from ._similarity import SimilarFrames as SimilarFrames
from ._similarity import example_of as example_of
from ._similarity import frames_like as frames_like
from ._similarity import most_like as most_like
from ._staging import Sealed as Sealed
from ._traces import FrameRef as FrameRef
from ._traces import range_of as range_of
from ._traces import Identity as Identity
from ._traces import StoredTrace as StoredTrace
from ._traces import free_name as free_name
from ._traces import trace_among as trace_among
from ._traces import trace_id_of as trace_id_of
from ._verify import verify_file as verify_file
from ._write import OnMap as OnMap
from ._write import Segment as Segment

__all__ = [
    "Abstracted",
    "CodedClasses",
    "Triples",
    "BUCKET_BITS",
    "Batches",
    "CATALOGUE",
    "DIGEST_BYTES",
    "Example",
    "Facts",
    "Folder",
    "FrameRef",
    "Given",
    "GivenTable",
    "IN_NOTEBOOK",
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
    "SCHEMA_VERSION",
    "SEQ_BITS",
    "Sealed",
    "Segment",
    "SimilarFrames",
    "StoreFile",
    "StoredTrace",
    "UserTables",
    "WINDOW",
    "answers_of",
    "arrow_file",
    "as_told_batches",
    "begins",
    "count_parquet",
    "example_of",
    "facts_of",
    "frame_ids",
    "frames_like",
    "free_name",
    "graph_digests",
    "join_bundles",
    "lengths_of_messages",
    "marks",
    "maps_of_traces",
    "measured",
    "scope_of",
    "scope_text",
    "merged_arrays",
    "merged_classes",
    "merged_file",
    "merged_parts",
    "messages_of",
    "most_like",
    "names_of_traces",
    "named_as",
    "parquet_rows",
    "duckdb",
    "refuse_name",
    "relations_of_set",
    "remains_of",
    "range_of",
    "seq_of",
    "split_segment",
    "subset_catalogs",
    "take_place",
    "trace_among",
    "trace_id_of",
    "trace_of",
    "verify_file",
    "whole_segment",
    "write_bundle",
    "write_classes",
    "write_coded",
    "write_rows",
    "write_csv",
    "write_batches",
    "write_parquet",
    "write_part",
]
