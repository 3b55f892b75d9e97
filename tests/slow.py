"""Seconds of processor that files of tests take: which come first in a run, and which the edit loop can afford.

Rough: the dearest were measured one at a time on a loaded machine, others before later changes, or estimated.
Not listed: about three.
"""

from __future__ import annotations

from typing import Final

SECONDS: Final = {
    "rebuilding": 60,
    "cli_streams": 50,
    "cli_ending": 45,
    "importing": 45,
    "crowds": 35,
    "store_segment": 35,
    "ingest_hardship": 32,
    "ingest_many": 30,
    "exports": 30,
    "tolerance": 30,
    "monitor": 28,
    "pytest_plugin": 28,
    "fuzz": 27,
    "doors": 26,
    "store_sharing": 26,
    "ingest": 25,
    "library": 25,
    "over_time": 25,
    "derive": 24,
    "lang_attributes": 24,
    "outputs": 22,
    "cli": 22,
    "ingest_data": 21,
    "damaged": 21,
    "store_verify": 21,
    "export_graphs": 19,
    "coverage": 18,
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
