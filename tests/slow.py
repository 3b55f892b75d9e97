"""Seconds of processor that files of tests take: which come first in a run, and which the edit loop can afford.

Rough: the dearest were measured one at a time on a loaded machine, others before later changes, or estimated.
Not listed: about three.
"""

from __future__ import annotations

from typing import Final

SECONDS: Final = {
    "importing": 45,
    "rebuilding": 25,
    "cli_ending": 33,
    "ingest_hardship": 28,
    "cli_streams": 22,
    "exports": 30,
    "monitor": 28,
    "pytest_plugin": 28,
    "doors": 19,
    "library": 28,
    "fuzz": 27,
    "lang_attributes": 27,
    "cli": 27,
    "store_verify": 26,
    "derive": 24,
    "crowds": 22,
    "ingest_data": 11,
    "ingest_many": 19,
    "export_graphs": 19,
    "online": 15,
    "lang_subgraphs": 19,
    "lang_match": 19,
    "coverage": 18,
    "store_segment": 17,
    "over_time": 17,
    "outputs": 17,
    "frozen": 9,
    "docs_queries": 17,
    "temporal": 17,
    "ingest": 16,
    "mutants": 16,
    "store_carried": 16,
    "like": 15,
    "selection": 15,
    "store_sharing": 14,
    "derive_using": 14,
    "lang_sql": 14,
    "damaged": 13,
    "osi": 13,
    "store_transactions": 12,
    "flavours": 12,
    "carla_lights": 12,
    "mcap_file": 12,
    "tolerance": 11,
    "store": 11,
    "selection_docs": 11,
    "lang_oracle": 10,
    "foxglove": 10,
    "cli_repeated": 10,
    "draw_clip": 10,
    "query": 8,
    "user_tables": 8,
    "locks": 8,
    "osi_camera": 8,
    "carlasgg": 8,
    "carla": 8,
    "store_payloads": 8,
    "sgg_traces": 8,
    "osi_file": 7,
    "lang_identity": 7,
    "datasets": 6,
    "carla_bags": 6,
    "views": 6,
    "query_recordings": 6,
    "relations": 6,
    "classes": 6,
    "lang_sgl": 6,
    "events": 5,
}
"""Name, without ``test_``, and seconds."""


def seconds(name: str) -> float:
    """Seconds of processor that a file takes, about."""
    return SECONDS.get(name, 3)
