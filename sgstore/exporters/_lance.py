"""Export format Lance: the tables of the format Parquet, as one Lance data set each.

Lance names its files at random, so equal exports have different bytes.
"""

from __future__ import annotations

import shutil
from importlib import import_module
from typing import TYPE_CHECKING, Any

from sgstore.errors import ExportError, MissingExtraError
from sgstore.exporters import _parquet
from sgstore.exporters._clips import WrittenFile

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.exporters._clip_frames import Export


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write the tables of all clips as Lance data sets, and verify them by counting their rows."""
    try:
        lance: Any = import_module("lance")
        parquet: Any = import_module("pyarrow.parquet")
    except ImportError as error:
        raise MissingExtraError("Lance", "lance") from error
    tables = folder / ".parquet"
    tables.mkdir()
    written: list[WrittenFile] = []
    for table in _parquet.write(export, tables):
        if table.file.suffix != ".parquet":
            continue
        to = folder / f"{table.file.stem}.lance"
        with parquet.ParquetFile(table.file) as file:
            batches = file.iter_batches()
            found = lance.write_dataset(batches, str(to), schema=file.schema_arrow).count_rows()
        if found != table.count:
            raise ExportError(f"{to.name}: {table.count} rows were written, {found} are read back")
        written.append(WrittenFile.of(to, table.holds, found))
    shutil.move(tables / "fields.json", folder / "fields.json")
    shutil.rmtree(tables)
    return [*written, WrittenFile.of(folder / "fields.json", "tables", len(written))]
