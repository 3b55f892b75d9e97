"""Export format DuckDB: the frames of the clips in one file with the public views, for other programs.

The file has no clips. With ``--storage v1.0.0`` every DuckDB from 1.0 on reads it, and programs
that contain one: dbt, ibis, SQLAlchemy, BI tools. It is no store: sgstore does not read it again.
Labels are the table ``labels``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.exporters._clips import WrittenFile

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.exporters._clip_frames import Export

FILE: Final = "scenes.duckdb"


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write the frames of all clips into one file, and verify it by counting them."""
    parts: list[np.ndarray[tuple[int], np.dtype[np.int64]]] = []
    for frames in export.frames():
        parts.append(frames.frame_id)
        export.tell(frames.number, len(export.clips))
    frame_id = np.unique(np.concatenate(parts))
    columns, kinds = export.label_columns(frame_id), export.label_types()
    labels = {name: (kinds[name], values) for name, values in columns.items()}
    export.store.file.write_portable(folder / FILE, frame_id, export.storage, labels)
    return [WrittenFile.of(folder / FILE, "frames", len(frame_id))]
