"""A result of millions of rows comes as a stream: memory is bounded whatever its length."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import duckdb
import pytest

from sgstore.store import StoreFile

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="peaks are told by Linux"
)

BUCKETS, EDGES = 700, 50
"""Edges that hold in every frame of a bucket: 60 rows of a result each, 2.1 million in all."""

ASK = """
import json, re, sys
from pathlib import Path
import sgstore

def peak():
    return int(re.search("VmHWM:\\\\s*(\\\\d+)", Path("/proc/self/status").read_text())[1]) / 1024

store = sgstore.open(sys.argv[1])
peaks, rows, first = [], 0, None
for rows, row in enumerate(store.find(sys.argv[2]), start=1):
    first = first or row
    if rows % 350_000 == 0:
        peaks.append(peak())
print(json.dumps([rows, peaks]))
"""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of 42,000 frames in seven traces, each with fifty edges and fifty-one cars."""
    path = tmp_path_factory.mktemp("many") / "many.sgstore"
    StoreFile.create(path)
    with duckdb.connect(str(path)) as connection:
        connection.execute("USE inside")
        for table, columns in TABLES.items():
            into = ", ".join(f'"{name}"' for name in columns)
            source = f"range({BUCKETS}) AS b(n)" + FROM.get(table, "")
            values = ", ".join(columns.values())
            connection.execute(
                f"INSERT INTO {table} ({into}) SELECT DISTINCT {values} FROM {source}"
            )
    return path


BUCKET = "(((n // 100 + 1) << 18) + n % 100)"
TRACE = "(n // 100 + 1)"
FROM = {
    "edge": f", range({EDGES}) AS e(k)",
    "state": f", range(60) AS f(bit), range({EDGES + 1}) AS e(k)",
    "entity": f", range({EDGES + 1}) AS e(k)",
    "frame": ", range(60) AS f(bit)",
}
TABLES = {
    "trace": {
        "trace_id": TRACE,
        "name": f"'drive ' || {TRACE}",
        "ego": "'0'",
        "frames": "6000",
        "start_ns": "0",
        "end_ns": "599900000000",
        "period_ns": "100000000",
        "answers": "['near']",
        "origin_x": "0",
        "origin_y": "0",
        "origin_z": "0",
        "recording_id": TRACE,
        "flavour": "'osi'",
        "config_id": "1",
        "report": "'{}'",
        "version": "'0'",
        "ingested_at": "TIMESTAMP '2026-01-01'",
    },
    "recording": {
        "recording_id": TRACE,
        "uri": f"'/drive{TRACE}.mcap'",
        "size": "0",
        "mtime_ns": "0",
        "digest": f"'{TRACE}'",
    },
    "entity": {
        "trace_id": TRACE,
        "node_id": "k",
        "kind": "'car'",
        "is_static": "FALSE",
        "lifetime": "1",
    },
    "bucket": {
        "bucket": BUCKET,
        "trace_id": TRACE,
        "valid": "(1::BIGINT << 60) - 1",
        "joined": "(1::BIGINT << 60) - 1",
    },
    "frame": {
        "frame_id": f"{BUCKET} * 64 + bit",
        "bucket": BUCKET,
        "bit": "bit",
        "trace_id": TRACE,
        "seq": "n % 100 * 60 + bit",
        "time_ns": "(n % 100 * 60 + bit) * 100000000",
        "log_time_ns": "(n % 100 * 60 + bit) * 100000000",
        "ego": "0",
    },
    "state": {
        "kind": "'car'",
        "frame_id": f"{BUCKET} * 64 + bit",
        "node_id": "k",
        "is_ego": "k = 0",
        "speed": "(k * bit) % 20",
        "repeated": "FALSE",
    },
    "edge": {
        "relation": "'near'",
        "src_is_ego": "FALSE",
        "dst_is_ego": "FALSE",
        "src_kind": "'car'",
        "dst_kind": "'car'",
        "bucket": BUCKET,
        "src": "k + 1",
        "dst": "(k + 1) % 50 + 1",
        "mask": "(1::BIGINT << 60) - 1",
    },
}


@pytest.mark.parametrize(
    "query",
    [
        pytest.param("MATCH (a:Car)-[:near]->(b) RETURN a.id, b.id", id="edges"),
        pytest.param(
            "MATCH (a:Car)-[:near]->(b) WHERE a.speed >= 0 AND b.speed - a.speed < 99 RETURN b.speed",
            id="values of frames",
        ),
    ],
)
def test_memory_does_not_grow_with_rows(query: str, path: Path) -> None:
    command = [sys.executable, "-c", ASK, str(path), query]

    done = subprocess.run(command, capture_output=True, text=True, check=True)

    rows, peaks = json.loads(done.stdout)
    assert rows == BUCKETS * EDGES * 60
    assert len(peaks) == 6
    assert (
        peaks[-1] < 600
    )  # MB, with Python, numpy and DuckDB; the rows alone would be more than that
    assert peaks[-1] < peaks[1] + 100
