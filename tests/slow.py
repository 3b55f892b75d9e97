"""Seconds of processor that files of tests take: which come first in a run, and which the edit loop can afford.

Rough: the dearest were measured one at a time on a loaded machine, others before later changes, or estimated.
Not listed: about three.
"""

from __future__ import annotations

from typing import Final

SECONDS: Final = {
    "explorer": 60,
    "importing": 45,
    "cli_ending": 33,
    "exports": 30,
    "ingest_hardship": 28,
    "pytest_plugin": 28,
    "fuzz": 27,
    "rebuilding": 25,
    "assistant": 25,
    "notebook": 25,
    "derive": 24,
    "cli_streams": 22,
    "library": 20,
    "doors": 19,
    "cli": 19,
    "ingest_many": 19,
    "export_graphs": 19,
    "coverage": 18,
    "over_time": 17,
    "docs_queries": 17,
    "store_verify": 16,
    "mutants": 16,
    "serve": 12,
    "parts": 8,
    "monitor": 15,
    "lang_attributes": 15,
    "crowds": 15,
    "online": 15,
    "like": 15,
    "selection": 15,
    "derive_using": 14,
    "lang_sql": 14,
    "store_segment": 13,
    "outputs": 13,
    "damaged": 13,
    "osi": 13,
    "store_transactions": 12,
    "flavours": 12,
    "carla_lights": 12,
    "mcap_file": 12,
    "ingest": 11,
    "ingest_data": 11,
    "tolerance": 11,
    "store": 11,
    "selection_docs": 11,
    "lang_subgraphs": 10,
    "foxglove": 10,
    "cli_repeated": 10,
    "draw_clip": 10,
    "store_sharing": 9,
    "frozen": 9,
    "lang_after": 8,
    "lang_own_names": 8,
    "sql_patterns": 8,
    "union": 8,
    "lang_oracle": 8,
    "lang_match": 8,
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
    "temporal": 6,
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
