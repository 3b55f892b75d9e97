"""Recordings → store: read, make graphs, build aside, publish; block by block, several recordings at a time.

Memory does not grow with the length of a trace, and a trace is in the store with everything that belongs to
it or not at all. What cannot be read of one trace is said in its outcome and does not stop the others.

``files`` says which recordings are meant · ``maps`` reads road maps · ``parts`` cuts a trace in time ·
``tally`` counts what is in it · ``reading`` makes sealed segments of a recording · ``workers`` does that in
processes, each of which is a ``worker`` that is given a job (``jobs``) · ``running`` publishes what they
sealed, in the order given, and tells ``outcomes`` · ``examining`` says what would be read of a file, and what
is wrong with it.
"""

from sgstore.ingest.examining import Examination, examine
from sgstore.ingest.files import recordings
from sgstore.ingest.maps import read_map_file
from sgstore.ingest.outcomes import Progress, TraceOutcome
from sgstore.ingest.running import ingest

__all__ = [
    "Examination",
    "Progress",
    "TraceOutcome",
    "examine",
    "ingest",
    "read_map_file",
    "recordings",
]
