"""Rows for people and for machines: a table that fits the terminal, JSON, NDJSON, CSV, Parquet, Arrow.

In JSON, 64-bit ids and times (``frame_id``, ``trace_id``, ``bucket`` and whatever ends in ``_ns``) are texts,
because many JSON readers round whole numbers beyond 2⁵³; so is any other whole number beyond that.
"""

from __future__ import annotations

import csv
import json
import math
import shutil
import sys
from enum import StrEnum
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import ExportError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path
    from typing import TextIO


class Format(StrEnum):
    """How rows are printed."""

    table = "table"
    json = "json"
    ndjson = "ndjson"
    csv = "csv"
    parquet = "parquet"
    arrow = "arrow"


_KEYS: Final = frozenset({"frame", "from", "trace"})
"""Columns by which a row is found again."""
_LEAST: Final = 8
"""Letters that a column keeps."""
_BINARY: Final = frozenset({Format.parquet, Format.arrow})
_WITHOUT_NESTING: Final = frozenset({Format.csv, *_BINARY})

LONG: Final = frozenset({"frame_id", "trace_id", "bucket"})
SAFE_INTEGER: Final = 2**53
ROWS_THAT_SET_WIDTHS: Final = 200
GAP: Final = "  "


def write_rows(
    columns: Sequence[str],
    rows: Iterable[Sequence[Any]],
    form: Format,
    output: Path | None = None,
    types: Sequence[str] | None = None,
) -> int:
    """Print rows as they come, on stdout or into a file; memory does not grow with their number.

    Parameters
    ----------
    columns : sequence of str
    rows : iterable of sequences
        Plain Python values; ``None`` is a missing one.
    form : Format
    output : Path, optional
        A file to write instead of stdout; Parquet and Arrow need one, unless stdout is a pipe or a file.
    types : sequence of str, optional
        The database's types of the columns, for Parquet and Arrow.

    Returns
    -------
    int
        How many rows were written.

    Raises
    ------
    ExportError
        The file cannot be written, or Parquet or Arrow would go to a terminal.
    """
    if form in _WITHOUT_NESTING and not types:
        rows = ([_flat(value) for value in row] for row in rows)
    if form in _BINARY:
        return _write_binary(columns, rows, form, output, types)
    if output is None:
        return _write_text(columns, rows, form, sys.stdout)
    try:
        with output.open("w", encoding="utf-8", newline="") as stream:
            return _write_text(columns, rows, form, stream)
    except OSError as error:
        raise ExportError(f"{output}: {error.strerror or error}") from error


def write_document(values: dict[str, Any], form: Format) -> None:
    """Print one thing on stdout: its values one a line for people, else as one JSON document."""
    if form is Format.table:
        lines = [(name, _cell(_json_value(value, name))) for name, value in values.items()]
        width = max(len(name) for name, _ in lines)
        sys.stdout.writelines(f"{name.ljust(width)}{GAP}{value}\n" for name, value in lines)
        return
    json.dump(_json_object(values), sys.stdout, ensure_ascii=False, indent=2)
    sys.stdout.write("\n")


def say(message: str) -> None:
    """Tell something that is not a result, on stderr."""
    sys.stderr.write(f"sgstore: {message}\n")


def write_error(about: dict[str, Any]) -> None:
    """Tell an error as data: one line of JSON on stderr."""
    sys.stderr.write(f"{json.dumps(_json_object(about), ensure_ascii=False)}\n")


def write_text(text: str, output: Path | None = None) -> None:
    """Print a text as it is, on stdout or into a file.

    Raises
    ------
    ExportError
        The file cannot be written.
    """
    if output is None:
        sys.stdout.write(text)
        return
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ExportError(f"{output}: {error.strerror or error}") from error


def _write_text(
    columns: Sequence[str], rows: Iterable[Sequence[Any]], form: Format, stream: TextIO
) -> int:
    match form:
        case Format.json:
            return _write_json(columns, rows, stream)
        case Format.ndjson:
            return _count(stream.write(f"{_dumps(columns, row)}\n") for row in rows)
        case Format.csv:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(columns)
            return _count(writer.writerow(["" if v is None else v for v in row]) for row in rows)
        case _:
            return _write_table(columns, rows, stream)


def _count(written: Iterator[Any]) -> int:
    return sum(1 for _ in written)


def _write_json(columns: Sequence[str], rows: Iterable[Sequence[Any]], stream: TextIO) -> int:
    number = 0
    for row in rows:
        stream.write("[\n  " if number == 0 else ",\n  ")
        stream.write(_dumps(columns, row))
        number += 1
    stream.write("\n]\n" if number else "[]\n")
    return number


def _dumps(columns: Sequence[str], row: Sequence[Any]) -> str:
    return json.dumps(_json_object(dict(zip(columns, row, strict=True))), ensure_ascii=False)


def _flat(value: Any) -> Any:
    """Lists and objects as JSON, for forms that have none."""
    return json.dumps(_json_value(value), ensure_ascii=False) if _is_nested(value) else value


def _is_nested(value: Any) -> bool:
    return isinstance(value, list | tuple | dict)


def _json_object(values: dict[str, Any]) -> dict[str, Any]:
    return {name: _json_value(value, name) for name, value in values.items()}


def _json_value(value: Any, name: str = "") -> Any:
    match value:
        case None | bool() | str():
            return value
        case int():
            long = name in LONG or name.endswith("_ns") or abs(value) > SAFE_INTEGER
            return str(value) if long else value
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return _json_object(value)
        case list() | tuple():
            return [_json_value(item, name) for item in value]
        case _:
            return value.isoformat() if hasattr(value, "isoformat") else str(value)


def _write_binary(
    columns: Sequence[str],
    rows: Iterable[Sequence[Any]],
    form: Format,
    output: Path | None,
    types: Sequence[str] | None,
) -> int:
    """Write Parquet, or by way of it, so that memory stays bounded and types are those of the whole, Arrow."""
    from sgstore.store import write_parquet

    if form is Format.parquet and output is not None:
        return write_parquet(columns, rows, output, types)
    if output is None and sys.stdout.isatty():
        raise ExportError(
            f"{form.capitalize()} is not for a terminal: name a file with -o FILE, or redirect stdout"
        )
    import tempfile
    from pathlib import Path

    from sgstore.store.dataframes import arrow_file

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.parquet"
        number = write_parquet(columns, rows, file, types)
        if form is Format.arrow:
            ready = output or Path(folder) / "rows.arrow"
            arrow_file(file, ready)
            file = ready
        if output is None:
            with file.open("rb") as source:
                shutil.copyfileobj(source, sys.stdout.buffer)
    return number


# Tables for people ---------------------------------------------------------------------------------


def _write_table(columns: Sequence[str], rows: Iterable[Sequence[Any]], stream: TextIO) -> int:
    """A table whose widths the first rows set, so that it can start before the last row is known."""
    rows = iter(rows)
    first = [[_cell(value) for value in row] for row in islice(rows, ROWS_THAT_SET_WIDTHS)]
    if not first:
        return 0
    numeric = [all(_is_number(row[i]) for row in first) for i in range(len(columns))]
    widths = [max(len(name), *(len(row[i]) for row in first)) for i, name in enumerate(columns)]
    widths = _fitted(columns, widths, _room(stream))
    stream.write(_line(columns, widths, numeric))
    stream.write(_line(["─" * width for width in widths], widths, numeric))
    rest = ([_cell(value) for value in row] for row in rows)
    return _count(stream.write(_line(row, widths, numeric)) for row in chain(first, rest))


def _room(stream: TextIO) -> int | None:
    """Columns of the terminal, or ``None`` where the table does not go to one."""
    return shutil.get_terminal_size().columns if stream.isatty() else None


def _fitted(columns: Sequence[str], widths: list[int], room: int | None) -> list[int]:
    """Widths that fit: the widest columns give way first, what a row is found by last; none below 8 letters."""
    if room is None:
        return widths
    widths = list(widths)
    others = [i for i, name in enumerate(columns) if name not in _KEYS]
    for giving in (others, list(range(len(columns)))):
        while giving and sum(widths) + len(GAP) * (len(widths) - 1) > room:
            widest = max(giving, key=widths.__getitem__)
            if widths[widest] <= _LEAST:
                break
            widths[widest] -= 1
    return widths


def _line(cells: Sequence[str], widths: Sequence[int], numeric: Sequence[bool]) -> str:
    parts = []
    for cell, width, right in zip(cells, widths, numeric, strict=True):
        text = cell if len(cell) <= width else f"{cell[: width - 1]}…"
        parts.append(text.rjust(width) if right else text.ljust(width))
    return f"{GAP.join(parts).rstrip()}\n"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) and abs(value) < 1e4 else f"{value:.1f}"
    text = str(value)
    return "".join(c if c.isprintable() else "�" for c in text)


def _is_number(cell: str) -> bool:
    return not cell or (cell.lstrip("-")[:1].isdigit() and cell[-1:].isdigit() and " " not in cell)
