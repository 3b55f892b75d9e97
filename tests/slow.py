"""Seconds of processor that files of tests take: which come first in a run, and which the edit loop can afford.

Rough: some were measured, under load and before later changes, others estimated. Not listed: about three.
"""

from __future__ import annotations

from typing import Final

SECONDS: Final = {
    "cli_streams": 45,
    "cli_ending": 55,
    "ingest_hardship": 40,
    "importing": 40,
    "crowds": 38,
    "rebuilding": 35,
    "ingest_many": 33,
    "exports": 30,
    "monitor": 30,
    "tolerance": 30,
    "store_segment": 30,
    "pytest_plugin": 28,
    "coverage": 28,
    "outputs": 28,
    "ingest_data": 27,
    "fuzz": 27,
    "doors": 26,
    "store_sharing": 26,
    "ingest": 25,
    "library": 25,
    "over_time": 25,
    "damaged": 25,
    "cli": 24,
    "derive": 24,
    "lang_attributes": 24,
    "store_verify": 21,
    "export_graphs": 19,
    "frozen": 18,
    "docs_queries": 17,
    "osi": 17,
    "mutants": 16,
    "online": 16,
    "store_carried": 16,
    "temporal": 15,
    "lang_subgraphs": 15,
    "like": 15,
    "selection": 15,
    "derive_using": 14,
    "lang_sql": 14,
    "store_transactions": 13,
    "flavours": 12,
    "carla_lights": 12,
    "lang_match": 12,
    "mcap_file": 12,
    "lang_oracle": 10,
    "foxglove": 10,
    "query": 10,
    "user_tables": 10,
    "cli_repeated": 10,
    "locks": 12,
    "store": 11,
    "selection_docs": 11,
    "draw_clip": 10,
    "datasets": 9,
    "osi_camera": 8,
    "carlasgg": 8,
    "carla": 8,
    "store_payloads": 8,
    "sgg_traces": 8,
    "osi_file": 7,
    "lang_identity": 7,
    "carla_bags": 6,
    "views": 6,
    "query_recordings": 6,
    "relations": 6,
    "classes": 6,
    "events": 6,
    "lang_sgl": 6,
}
"""Name, without ``test_``, and seconds."""


def seconds(name: str) -> float:
    """Seconds of processor that a file takes, about."""
    return SECONDS.get(name, 3)
