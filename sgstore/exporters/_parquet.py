"""Export format Parquet: tables of the clips and their frames, nodes, entities, edges and messages.

The first column is the number of the clip, then the columns of the public views; a frame in two
clips occurs twice. ``frames`` have their labels, ``edges`` the attributes of lanes and gaps. Rows
are ordered by clip and frame. ``entities`` has the entities of each clip once, with the names of
the simulator; it joins ``nodes`` by ``clip`` and ``node_id``. ``fields.json`` describes each
column, and ``README.md`` is the card of the Hugging Face hub and ``datasets``.
"""

from __future__ import annotations

import json
from collections import defaultdict
from importlib import import_module, resources
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError
from sgstore.exporters._clips import WrittenFile
from sgstore.store import ParquetTable, count_parquet

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from sgstore.exporters._clip_frames import ClipFrames, Export
    from sgstore.store import StoreFile


_FRAMES: Final = """
SELECT * FROM frames WHERE frame_id >= $first AND frame_id <= $last ORDER BY frame_id
"""
_NODES: Final = """
SELECT * FROM nodes WHERE frame_id >= $first AND frame_id <= $last ORDER BY frame_id, node_id
"""
_EDGES: Final = """
SELECT e.*, l.* EXCLUDE (frame_id, src, dst, src_kind, relation), g.gap
FROM (SELECT DISTINCT * FROM edges WHERE frame_id >= $first AND frame_id <= $last) e
  LEFT JOIN (SELECT *, 'isIn' AS relation FROM lane_states WHERE frame_id >= $first AND frame_id <= $last) l
    ON l.frame_id = e.frame_id AND l.src = e.src AND l.dst = e.dst AND e.relation = l.relation
  LEFT JOIN (
    SELECT frame_id, src, dst, gap, 'follows' AS relation FROM lane_gaps
    WHERE frame_id >= $first AND frame_id <= $last UNION ALL
    SELECT frame_id, dst, src, gap, 'leads' FROM lane_gaps
    WHERE frame_id >= $first AND frame_id <= $last) g
    ON g.frame_id = e.frame_id AND g.src = e.src AND g.dst = e.dst AND e.relation = g.relation
ORDER BY e.frame_id, e.src, e.relation, e.dst
"""
_PAYLOADS: Final = """
SELECT * FROM payloads WHERE frame_id >= $first AND frame_id <= $last
ORDER BY frame_id, channel, log_time_ns, chunk_offset, message_offset
"""
_ENTITIES: Final = """
SELECT * EXCLUDE (trace_id) FROM entities WHERE trace_id = $trace ORDER BY node_id
"""
TABLES: Final = {"frames": _FRAMES, "nodes": _NODES, "edges": _EDGES, "payloads": _PAYLOADS}

_NOWHERE: Final = {"first": 0, "last": 0}

UNITS: Final = {
    **dict.fromkeys(("x", "y", "z", "length", "width", "height", "gap", "along"), "m"),
    "lane_offset": "m",
    **dict.fromkeys(("heading", "pitch", "roll", "heading_error"), "degrees"),
    **dict.fromkeys(("speed", "vx", "vy", "vz", "speed_limit"), "m/s"),
    **dict.fromkeys(("accel", "ax", "ay", "az"), "m/s²"),
    "yaw_rate": "degrees/s",
    "curvature": "1/m",
    **dict.fromkeys(("t", "offset_s"), "s"),
    **dict.fromkeys(("time_ns", "log_time_ns", "start_ns", "end_ns"), "ns"),
}
"""Column → unit. Other columns are names, counts, shares or truth values."""

_CLIPS: Final = {
    "clip": "INTEGER",
    "trace": "VARCHAR",
    "start_ns": "BIGINT",
    "end_ns": "BIGINT",
    "source": "VARCHAR",
    "source_sha256": "VARCHAR",
}


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write the tables of all clips as Parquet files, and verify them by reading them again."""
    about = export.about()["clips"]
    with ParquetTable(folder / "clips.parquet", _CLIPS.items()) as clips:
        columns = {name: [clip.get(name) for clip in about] for name in _CLIPS}
        clips.add(columns | {"clip": list(range(1, len(about) + 1))})
    counts, present = {"clips": clips.rows}, _Present()
    fields = {"clips": dict(_CLIPS)}
    for name in TABLES:
        counts[name], fields[name] = _write_table(export, folder, name, present)
    counts["entities"], fields["entities"] = _write_entities(export, folder, present)
    written = [_tested(folder / f"{name}.parquet", name, count) for name, count in counts.items()]
    (folder / "fields.json").write_bytes(_described(export.store.file, fields))
    (folder / "README.md").write_bytes(_card(export, counts).encode())
    columns = sum(map(len, fields.values()))
    written.append(WrittenFile.of(folder / "fields.json", "columns", columns))
    return [*written, WrittenFile.of(folder / "README.md", "card", 1, notes=[_NOT_EXPORTED])]


_NOT_EXPORTED: Final = (
    "views such as pairs, lane_states, events and world_nodes are not exported;"
    " sgstore sql STORE 'FROM pairs' -o pairs.parquet writes one, --as duckdb all"
)


class _Present:
    """For each clip number, the entities in the clip and its trace."""

    def __init__(self) -> None:
        self.nodes: defaultdict[int, set[int]] = defaultdict(set)
        self.trace: dict[int, int] = {}

    def see(self, name: str, clip: int, columns: Mapping[str, Any]) -> None:
        """Record the entities, or the trace, that the rows of a table contain for a clip."""
        if name == "frames" and len(columns["trace_id"]):
            self.trace.setdefault(clip, int(columns["trace_id"][0]))
        elif name == "nodes":
            node = np.unique(np.asarray(columns["node_id"]))
            self.nodes[clip].update(node[node >= 0].tolist())


def _write_entities(export: Export, folder: Path, present: _Present) -> tuple[int, dict[str, str]]:
    file = export.store.file
    columns = {"clip": "INTEGER", **_types(file, _ENTITIES, {"trace": 0})}
    with ParquetTable(folder / "entities.parquet", columns.items()) as table:
        for clip, trace in present.trace.items():
            found = file.arrays(_ENTITIES, {"trace": trace})
            rows = np.isin(np.asarray(found["node_id"]).astype(np.int64), [*present.nodes[clip]])
            told: dict[str, Any] = {name: values[rows] for name, values in found.items()}
            table.add(told | {"clip": np.full(int(rows.sum()), clip, np.int32)})
    return table.rows, columns


def _write_table(
    export: Export, folder: Path, name: str, present: _Present
) -> tuple[int, dict[str, str]]:
    file = export.store.file
    kinds = export.label_types() if name == "frames" else {}
    columns = {"clip": "INTEGER", **_types(file, TABLES[name]), **kinds}
    with ParquetTable(folder / f"{name}.parquet", columns.items()) as table:
        for frames in export.windows():
            found = file.arrays(TABLES[name], frames.bounds)
            rows = _of_clip(export, frames, found, kinds)
            present.see(name, frames.number, rows)
            table.add(rows)
    return table.rows, columns


def _of_clip(
    export: Export,
    frames: ClipFrames,
    found: Mapping[str, np.ndarray[Any, Any]],
    labels: Mapping[str, str],
) -> dict[str, Any]:
    """Return those rows of a table that belong to a clip. Add the clip number and the labels as columns."""
    frame_id = np.asarray(found["frame_id"]).astype(np.int64)
    rows = np.isin(frame_id, frames.frame_id)
    columns: dict[str, Any] = {name: values[rows] for name, values in found.items()}
    columns["clip"] = np.full(int(rows.sum()), frames.number, np.int32)
    if labels:
        columns |= export.label_columns(frame_id[rows])
    return columns


def _types(file: StoreFile, sql: str, bounds: Mapping[str, int] = _NOWHERE) -> dict[str, str]:
    found = file.rows(sql, dict(bounds))
    return dict(zip(found.columns, found.types, strict=True))


def _tested(file: Path, name: str, count: int) -> WrittenFile:
    """Return the description of a written Parquet table, after reading it again."""
    try:
        arrow: Any = import_module("pyarrow.parquet")
    except ImportError:
        found, _ = count_parquet(file)
    else:
        try:
            with arrow.ParquetFile(file) as table:
                found = sum(batch.num_rows for batch in table.iter_batches())
        except (OSError, ValueError) as error:  # includes all errors of pyarrow
            raise ExportError(f"{file.name}: cannot be read back: {error}") from error
    if found != count:
        raise ExportError(f"{file.name}: {count} rows were written, {found} are read back")
    return WrittenFile.of(file, name, count)


_ABOUT_CLIPS: Final = (
    "One row a clip: its trace, its first and last log time, and the recording that it is of."
)
_VIEWS: Final = "SELECT view_name, comment FROM duckdb_views() WHERE schema_name = 'main'"


def _described(file: StoreFile, fields: Mapping[str, Mapping[str, str]]) -> bytes:
    """Return names, types and units of all columns of all tables, as JSON."""
    about = {str(name): str(comment or "") for name, comment in file.rows(_VIEWS, {})}
    told = {
        table: {
            "about": about.get(table, _ABOUT_CLIPS),
            "columns": [
                {"name": name, "type": _plain(kind)} | _unit(table, name)
                for name, kind in columns.items()
            ],
        }
        for table, columns in fields.items()
    }
    return (json.dumps(told, indent=1, ensure_ascii=False) + "\n").encode()


def _plain(kind: str) -> str:
    return "VARCHAR" if kind.startswith("ENUM") else kind


def _unit(table: str, column: str) -> dict[str, str]:
    if (table, column) == ("payloads", "length"):
        return {"unit": "bytes"}
    return {"unit": UNITS[column]} if column in UNITS else {}


def _card(export: Export, counts: Mapping[str, int]) -> str:
    """Return the text of the data set card (README) of an export, with the header for the Hugging Face hub."""
    about = export.about()
    head = ["---", "tags:", "- autonomous-driving", "- scene-graph", "configs:"]
    for name in counts:
        head += [f"- config_name: {name}", f"  data_files: {name}.parquet"]
    sources = dict.fromkeys((one["source"], one["source_sha256"]) for one in about["clips"])
    rows = "\n".join(f"| `{name}` | {count:,} |" for name, count in counts.items())
    files = "\n".join(f"* {_code(name)} (SHA-256 `{digest}`)" for name, digest in sources)
    query = about["provenance"].get("query", "")
    asked = f"\nFound by:\n\n{_quoted(query)}\n" if query else ""
    card = resources.files("sgstore.exporters").joinpath("card.md").read_text(encoding="utf-8")
    return "\n".join(head) + card.format(clips=counts["clips"], asked=asked, rows=rows, files=files)


def _code(text: str) -> str:
    return f"`{text.replace('`', chr(39))}`"


def _quoted(text: str) -> str:
    """Return a text as an indented literal block for Markdown."""
    return "\n".join(f"    {line}" for line in text.splitlines())
