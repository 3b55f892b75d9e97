"""Tables of the clips as Parquet: ``clips``, ``frames`` with their labels, ``nodes``, ``edges``, ``payloads``.

Their columns are those of the public views, behind the number of the clip, so a frame that is in two clips
comes twice; ``edges`` have the attributes of lanes and gaps beside them. Rows are in order of clip and frame.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError
from sgstore.exporters._clips import WrittenFile
from sgstore.store import ParquetTable, count_parquet

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from sgstore.exporters._labels import ClipFrames, Export
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
TABLES: Final = {"frames": _FRAMES, "nodes": _NODES, "edges": _EDGES, "payloads": _PAYLOADS}

_CLIPS: Final = {
    "clip": "INTEGER",
    "trace": "VARCHAR",
    "start_ns": "BIGINT",
    "end_ns": "BIGINT",
    "source": "VARCHAR",
    "source_sha256": "VARCHAR",
}


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write the tables, and read them again."""
    about = export.about()["clips"]
    with ParquetTable(folder / "clips.parquet", _CLIPS.items()) as clips:
        columns = {name: [clip.get(name) for clip in about] for name in _CLIPS}
        clips.add(columns | {"clip": list(range(1, len(about) + 1))})
    counts = {"clips": clips.rows}
    for name in TABLES:
        counts[name] = _write_table(export, folder, name)
    return [_tested(folder / f"{name}.parquet", name, count) for name, count in counts.items()]


def _write_table(export: Export, folder: Path, name: str) -> int:
    file = export.store.file
    kinds = _label_types(export) if name == "frames" else {}
    columns = {"clip": "INTEGER", **_types(file, TABLES[name]), **kinds}
    with ParquetTable(folder / f"{name}.parquet", columns.items()) as table:
        for frames in export.windows():
            found = file.arrays(TABLES[name], frames.bounds)
            table.add(_of_clip(export, frames, found, kinds))
    return table.rows


def _of_clip(
    export: Export,
    frames: ClipFrames,
    found: Mapping[str, np.ndarray[Any, Any]],
    labels: Mapping[str, str],
) -> dict[str, Any]:
    """Rows of a table that are in the clip, with its number and the labels."""
    frame_id = np.asarray(found["frame_id"]).astype(np.int64)
    rows = np.isin(frame_id, frames.frame_id)
    columns: dict[str, Any] = {name: values[rows] for name, values in found.items()}
    columns["clip"] = np.full(int(rows.sum()), frames.number, np.int32)
    if labels:
        columns |= export.label_columns(frame_id[rows])
    return columns


def _types(file: StoreFile, sql: str) -> dict[str, str]:
    found = file.rows(sql, {"first": 0, "last": 0})
    return dict(zip(found.columns, found.types, strict=True))


def _label_types(export: Export) -> dict[str, str]:
    """Types of the columns of labels: the narrowest that holds all of their values."""
    if export.labels is None:
        return {}
    return {name: _type_of(values.tolist()) for name, values in export.labels.values.items()}


def _type_of(values: Sequence[Any]) -> str:
    known = {type(value) for value in values} - {type(None)}
    if known <= {bool}:
        return "BOOLEAN"
    if known <= {int}:
        return "BIGINT"
    return "DOUBLE" if known <= {int, float} else "VARCHAR"


def _tested(file: Path, name: str, count: int) -> WrittenFile:
    """A table that was read again, by pyarrow if that is installed."""
    try:
        arrow: Any = import_module("pyarrow.parquet")
    except ImportError:
        found, _ = count_parquet(file)
    else:
        try:
            with arrow.ParquetFile(file) as table:
                found = sum(batch.num_rows for batch in table.iter_batches())
        except (OSError, ValueError) as error:  # among them all errors of pyarrow
            raise ExportError(f"{file.name}: cannot be read back: {error}") from error
    if found != count:
        raise ExportError(f"{file.name}: {count} rows were written, {found} are read back")
    return WrittenFile.of(file, name, count)
