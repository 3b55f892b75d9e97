"""Output of commands: progress bars, tables, machine formats, reports on recordings.

Progress bars appear only on a terminal.
"""

from __future__ import annotations

import csv
import json
import math
import shutil
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, Final, TypeVar

from sgstore.base.display import number_of
from sgstore.base.output_files import BIDIRECTIONAL, without_controls, written_text
from sgstore.base.temporary_folders import working_folder
from sgstore.errors import ExportError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path
    from typing import TextIO

    from sgstore.pipeline.recording_ingest import Progress

T = TypeVar("T")


def progress(items: Sequence[T], noun: str) -> Iterator[T]:
    """Yield the items. On a terminal, show a progress bar on stderr."""
    from rich.console import Console
    from rich.progress import track

    console, hidden = Console(stderr=True), quiet() or not sys.stderr.isatty()
    yield from track(items, noun, console=console, transient=True, disable=hidden)


@contextmanager
def ingest_bar() -> Generator[Callable[[Progress], None] | None]:
    """Yield a function that shows the progress of an ingest; ``None`` if stderr is quiet or not a terminal."""
    if quiet() or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[files]}{task.fields[frames]} frames"),
        TextColumn("{task.fields[speed]}"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    task = bar.add_task("", total=None, files="", frames=0, speed="")

    def show(progress: Progress) -> None:
        elapsed = bar.tasks[task].elapsed or 0
        speed = f"{progress.all_bytes / elapsed / 1e6:.1f} MB/s" if elapsed > 0.5 else ""
        several = f"{progress.files_done}/{progress.files} files, " if progress.files > 1 else ""
        bar.update(
            task,
            description=progress.path.name,
            total=progress.all_size,
            completed=progress.all_bytes,
            files=several,
            frames=progress.all_frames,
            speed=speed,
        )

    with bar:
        yield show


@contextmanager
def count_bar(what: str, things: str) -> Generator[Callable[[int, int], None] | None]:
    """Yield a function that shows a count on a progress bar; ``None`` if stderr is quiet or not a terminal."""
    if quiet() or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TextColumn(things))
    with Progress(
        *columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True
    ) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


# Rows as a table that fits the terminal, JSON, NDJSON, CSV, Parquet or Arrow. In JSON, 64-bit ids
# and times (``frame_id``, ``trace_id``, ``bucket`` and names ending in ``_ns``) are texts, because
# many JSON readers round integers beyond 2⁵³; so are other integers beyond that.


class Format(StrEnum):
    """Output format of result rows."""

    table = "table"
    json = "json"
    ndjson = "ndjson"
    csv = "csv"
    parquet = "parquet"
    arrow = "arrow"


_KEYS: Final = frozenset({"frame", "from", "trace"})
"""Names of columns that identify a row."""
_PATHS: Final = frozenset({"file", "path", "uri"})
"""Names of columns with file paths, which differ mostly at their ends."""
_LEAST: Final = 8
"""Smallest width of a table column; letters."""
LONG_TABLE: Final = 20
"""Number of rows from which a table on a terminal also states the total."""
BINARY: Final = frozenset({Format.parquet, Format.arrow})
_WITHOUT_NESTING: Final = frozenset({Format.csv, *BINARY})

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
    """Write result rows to stdout or a file as they arrive, in constant memory.

    Parameters
    ----------
    columns : sequence of str
    rows : iterable of sequences
        Plain Python values; ``None`` means a missing value.
    form : Format
    output : Path, optional
        Output file instead of stdout; required for Parquet and Arrow, unless stdout is a pipe or a
        file.
    types : sequence of str, optional
        The database's types of the columns, for Parquet and Arrow.

    Returns
    -------
    int
        Number of written rows.

    Raises
    ------
    ExportError
        The file cannot be written, or Parquet or Arrow would go to a terminal.
    """
    if form in _WITHOUT_NESTING and not types:
        rows = ([_flat(value) for value in row] for row in rows)
    if form in BINARY:
        from sgstore.store import ParquetTable

        return write_binary(
            lambda to: ParquetTable.write_rows(columns, rows, to, types), form, output
        )
    if output is None:
        return _write_text(columns, rows, form, sys.stdout)
    with written_text(output) as stream:
        return _write_text(columns, rows, form, stream)


JSON_VERSION: Final = 1
"""Version of the keys and types in the JSON of all commands, as listed in ``docs/json_shapes.json``."""


def write_document(values: dict[str, Any], form: Format) -> None:
    """Print one object on stdout: one value per line as text, or one JSON document."""
    if form is Format.table:
        lines = [(name, _cell(_json_value(value, name))) for name, value in values.items()]
        width = max(len(name) for name, _ in lines)
        sys.stdout.writelines(f"{name.ljust(width)}{GAP}{value}\n" for name, value in lines)
        return
    sys.stdout.write(f"{json_text({'json_version': JSON_VERSION} | _json_object(values), 2)}\n")


@dataclass(slots=True)
class _Verbosity:
    """Current state of the options ``--quiet`` and ``--verbose``."""

    quiet: bool = False
    handler: Any = None


_verbosity = _Verbosity()


def set_verbosity(*, quiet: bool, verbose: bool) -> None:
    """Switch the messages on stderr off (``--quiet``) or to more detail (``--verbose``).

    Options before and after a command are combined.

    Parameters
    ----------
    quiet : bool
        True to suppress :func:`say` and progress bars; results and errors stay.
    verbose : bool
        True to print the library's log on stderr, with the time since the process start.
    """
    _verbosity.quiet |= quiet
    if verbose and _verbosity.handler is None:
        import logging

        _verbosity.handler = logging.StreamHandler()
        form = "sgstore: %(relativeCreated)6d ms  %(name)s: %(message)s"
        _verbosity.handler.setFormatter(logging.Formatter(form))
        logging.getLogger("sgstore").addHandler(_verbosity.handler)
        logging.getLogger("sgstore").setLevel(logging.DEBUG)


def reset_verbosity() -> None:
    """Reset the messages on stderr to normal: neither quiet nor verbose."""
    handler, _verbosity.handler, _verbosity.quiet = _verbosity.handler, None, False
    if handler is not None:
        import logging

        logging.getLogger("sgstore").removeHandler(handler)
        logging.getLogger("sgstore").setLevel(logging.NOTSET)


def say(message: str) -> None:
    """Print a message on stderr that is neither a result nor an error."""
    if not _verbosity.quiet:
        complain(message)


def say_json(found: Mapping[str, Any]) -> None:
    """Print a message for programs on stderr, as one line of JSON."""
    if not _verbosity.quiet:
        sys.stderr.write(f"{json.dumps(found, ensure_ascii=False)}\n")


def complain(message: str) -> None:
    """Print an error message on stderr."""
    sys.stderr.write(f"sgstore: {without_controls(message)}\n")


def quiet() -> bool:
    """True if only results and errors are printed, because of ``--quiet``."""
    return _verbosity.quiet


def write_error(about: dict[str, Any]) -> None:
    """Print an error as one line of JSON on stderr."""
    sys.stderr.write(f"{json_text(_json_object(about))}\n")


def write_text(text: str, output: Path | None = None) -> None:
    """Write a text unchanged, to stdout or a file.

    Raises
    ------
    ExportError
        The file cannot be written.
    """
    if output is None:
        sys.stdout.write(text)
        return
    with written_text(output) as stream:
        stream.write(text)


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
            return _count(writer.writerow(map(_csv_cell, row)) for row in rows)
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
    return json_text(_json_object(dict(zip(columns, row, strict=True))))


_CONTROLS: Final = {code: f"\\u{code:04x}" for code in (*range(0x7F, 0xA0), *BIDIRECTIONAL)}
"""Control characters that JSON does not escape → escaped form. They could control a terminal."""


def json_text(value: Any, indent: int | None = None) -> str:
    """Return a value as JSON text without characters that could control a terminal."""
    text = json.dumps(value, ensure_ascii=False, indent=indent)
    return text if text.isprintable() else text.translate(_CONTROLS)


def _csv_cell(value: Any) -> Any:
    return "" if value is None else without_controls(value) if isinstance(value, str) else value


def _flat(value: Any) -> Any:
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


def write_binary(write: Callable[[Path], int], form: Format, output: Path | None) -> int:
    """Write result rows as Parquet or Arrow, in bounded memory. Return the number of rows.

    Parameters
    ----------
    write : callable
        Function that writes a Parquet file, and returns its number of rows.
    form, output
        As in :func:`write_rows`, with the same errors.
    """
    if form is Format.parquet and output is not None:
        return write(output)
    if output is None and sys.stdout.isatty():
        raise ExportError(
            f"{form.capitalize()} cannot be printed on a terminal; add -o FILE, or redirect stdout"
        )
    from sgstore.store import ParquetTable

    with working_folder("rows") as folder:
        file = folder / "rows.parquet"
        number = write(file)
        if form is Format.arrow:
            ready = output or folder / "rows.arrow"
            ParquetTable.to_arrow(file, ready)
            file = ready
        if output is None:
            with file.open("rb") as source:
                shutil.copyfileobj(source, sys.stdout.buffer)
    return number


def _write_table(columns: Sequence[str], rows: Iterable[Sequence[Any]], stream: TextIO) -> int:
    """Write rows as a text table, and return their number. The first rows determine the column widths."""
    rows = iter(rows)
    first = [[_cell(value) for value in row] for row in islice(rows, ROWS_THAT_SET_WIDTHS)]
    if not first:
        return 0
    numeric = [all(_is_number(row[i]) for row in first) for i in range(len(columns))]
    widths = [max(len(name), *(len(row[i]) for row in first)) for i, name in enumerate(columns)]
    rest = ([_cell(value) for value in row] for row in rows)
    room = shutil.get_terminal_size().columns if stream.isatty() else None
    kept, fitted = [*range(len(columns))], widths
    if room is not None:
        kept, fitted = _fitted(columns, widths, numeric, room)
    keys = [name in _KEYS and fitted[i] == widths[i] for i, name in enumerate(columns)]
    layout = [
        _TableColumn(i, columns[i], fitted[i], numeric[i], room is None or keys[i]) for i in kept
    ]
    if room is not None:
        before_last = sum(one.width + len(GAP) for one in layout[:-1])
        layout[-1].most = max(layout[-1].width, room - before_last)
    stream.write(_line(columns, layout))
    stream.write(_line(["─" * width for width in fitted], layout))
    number = _count(stream.write(_line(row, layout)) for row in chain(first, rest))
    if left_out := [name for i, name in enumerate(columns) if i not in kept]:
        say(f"no room for the columns {', '.join(left_out)}; --json has them")
    return number


@dataclass(slots=True)
class _TableColumn:
    """Column of a text table: its index and width, and the way its texts are shortened on a terminal."""

    place: int
    name: str
    width: int
    right: bool
    whole: bool
    most: int = 0

    def text(self, cell: str) -> str:
        """Return the text of a cell, cut to the column width. Paths keep both ends; numbers are not cut."""
        room = self.most or self.width
        if len(cell) > room and not (self.right or self.whole):
            end = (room - 1) * 2 // 3 if self.name in _PATHS else 0
            cell = f"{cell[: room - 1 - end]}…{cell[len(cell) - end :]}"
        return cell.rjust(self.width) if self.right else cell.ljust(self.width)


def _line(cells: Sequence[str], layout: Sequence[_TableColumn]) -> str:
    return f"{GAP.join(one.text(cells[one.place]) for one in layout).rstrip()}\n"


def _fitted(
    columns: Sequence[str], widths: Sequence[int], numeric: Sequence[bool], room: int
) -> tuple[list[int], list[int]]:
    """Return the columns of a text table that fit on the terminal, and the widths of all columns.

    First the widest texts are shortened, down to 8 letters; then the last columns are omitted; then
    the identifying columns are shortened. Numbers are never cut, because a cut number is a wrong
    number.
    """
    widths, kept = list(widths), list(range(len(columns)))
    keys = {i for i, name in enumerate(columns) if name in _KEYS} or {0}

    def too_wide() -> bool:
        return sum(widths[i] for i in kept) + len(GAP) * (len(kept) - 1) > room

    def narrow(giving: list[int]) -> None:
        while giving and too_wide():
            widest = max(giving, key=widths.__getitem__)
            if widths[widest] <= _LEAST:
                break
            widths[widest] -= 1

    narrow([i for i in kept if i not in keys and not numeric[i]])
    for i in reversed(range(len(columns))):
        if too_wide() and i not in keys:
            kept.remove(i)
    narrow([i for i in kept if i in keys])
    return kept, widths


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) and abs(value) < 1e4 else f"{value:.1f}"
    return _shown(str(value))


def _is_number(cell: str) -> bool:
    return not cell or (cell.lstrip("-")[:1].isdigit() and cell[-1:].isdigit() and " " not in cell)


# Report on a recording as text: one fact per line, then lists.

_MANY: Final = 20
"""Largest number of losses and warnings that are listed. Further ones are counted."""


def write_report(values: dict[str, Any]) -> None:
    """Print a report on a recording on stdout.

    Parameters
    ----------
    values : dict
        Result of :meth:`sgstore.store.StoredTrace.as_dict` with its report, or of
        :meth:`sgstore.ingest.Examination.as_dict`; missing and empty values are skipped.
    """
    facts = [(name, text) for name, text in _facts(values) if text]
    width = max((len(name) for name, _ in facts), default=0)
    lines = [f"{name.ljust(width)}{GAP}{_shown(text)}" for name, text in facts]
    for title, items in _lists(values):
        lines += ["", f"{title}:", *(f"{GAP}{_shown(item)}" for item in items)]
    sys.stdout.writelines(f"{line}\n" for line in lines)
    _write_implausible(values.get("implausible", []))


def _write_implausible(findings: list[dict[str, Any]]) -> None:
    """Print a table of implausible data and its remedies."""
    if not findings:
        return
    sys.stdout.write("\nimplausible data:\n")
    columns = ("kind", "entity", "entities", "frame", "times", "value")
    _write_table(columns, [[one[name] for name in columns] for one in findings], sys.stdout)
    sys.stdout.write("\nremedies:\n")
    for one in findings:
        sys.stdout.write(f"{GAP}{one['kind']}: {one['remedy']}\n")


def _facts(values: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "trace", values.get("name", "")
    yield "trace_id", str(values.get("trace_id", ""))
    yield "file", f"{values['path']} ({_amount(values['size'])})"
    yield "sha256", values.get("digest", "")
    yield "flavour", values.get("flavour", "")
    yield "ego", values.get("ego", "")
    yield "road map", values.get("map", "") or values.get("road_map", "")
    yield "frames", ", ".join(filter(None, (_frames(values), _rates(values))))
    yield "part", _part(values)
    yield "entities", _counts(values.get("entities", {}))
    yield "unknown types", _counts(values.get("unknown_types", {}))
    for name in ("clock_jumps", "gaps"):
        if values.get(name):
            yield name.replace("_", " "), _steps(values, name)
    yield "lost", _lost(values.get("losses", []))
    ingested = values.get("ingested_at")
    yield (
        "ingested",
        f"{ingested:%Y-%m-%d %H:%M:%S} UTC, sgstore {values['version']}" if ingested else "",
    )
    yield "cannot be read", values.get("error", "")


def _lists(values: dict[str, Any]) -> Iterator[tuple[str, list[str]]]:
    channels = values.get("channels", [])
    if channels:
        yield "channels", list(_channels(channels))
    if topics := values.get("topics"):
        yield (
            "stored topics",
            [
                f"{name}: {number_of(one['messages'], 'message')}, {number_of(len(one['fields']), 'field')}"
                for name, one in topics.items()
            ],
        )
    for title, items in (
        ("losses", [_loss(loss) for loss in values.get("losses", [])]),
        ("warnings", list(values.get("warnings", []))),
    ):
        more = [f"… and {len(items) - _MANY} more"] if len(items) > _MANY else []
        if items:
            yield title, items[:_MANY] + more


def _frames(values: dict[str, Any]) -> str:
    count = values.get("frames", 0)
    if not count:
        return ""
    from sgstore.model.world import covered_s

    step = values.get("period_ns", 0)
    told = covered_s(values.get("start_ns", 0), values.get("end_ns", 0), count, step)
    seconds, period = values.get("seconds", told), abs(step) / 1e9
    return f"{count}, {seconds:g} s" + (f", mostly every {period:g} s" if period else "")


def _part(values: dict[str, Any]) -> str:
    since, until = values.get("since"), values.get("until")
    parts = [f"from {since:g} s"] if since is not None else []
    parts += [f"to {until:g} s"] if until is not None else []
    rate = values.get("settings", {}).get("rate", 0)
    parts += [f"{rate:g} frames a second"] if rate else []
    return ", ".join(parts)


def _counts(counts: dict[str, int]) -> str:
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{count} {name}" for name, count in ordered)


def _steps(values: dict[str, Any], name: str) -> str:
    count, first = values.get(name, 0), values.get(f"{name}_at", [])
    places = ", ".join(f"{s['seconds']:+g} s before #{s['seq']} ({s['t']:g} s)" for s in first[:5])
    more = f", … ({count} in all)" if count > 5 else ""
    return f"{count}: {places}{more}" if count and first else str(count)


def _lost(losses: list[dict[str, Any]]) -> str:
    if not losses:
        return ""
    messages = sum(max(loss["messages"], 0) for loss in losses)
    size = sum(max(loss["bytes"], 0) for loss in losses)
    unknown = any(loss["messages"] < 0 for loss in losses)
    return f"{'at least ' if unknown else ''}{number_of(messages, 'message')}, {_amount(size)}"


def _loss(loss: dict[str, Any]) -> str:
    told = [loss["reason"]]
    if loss["messages"] >= 0:
        told.append(number_of(loss["messages"], "message"))
    if loss["bytes"] >= 0:
        told.append(_amount(loss["bytes"]))
    if loss["start_ns"] >= 0:
        told.append(f"log times {loss['start_ns'] / 1e9:.3f} … {loss['end_ns'] / 1e9:.3f} s")
    if loss["offset"] >= 0:
        told.append(f"byte {loss['offset']} of the file")
    return "; ".join(told)


def _channels(channels: Iterable[dict[str, Any]]) -> Iterator[str]:
    rows = [
        (
            channel["topic"],
            channel["schema"] or channel["message_encoding"] or "no schema",
            channel.get("role") or "",
            number_of(channel["messages"], "message") if channel.get("messages", -1) >= 0 else "",
            _rates(channel),
        )
        for channel in channels
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        yield GAP.join(cells).rstrip()


def _rates(values: dict[str, Any]) -> str:
    """Return rate, median period and largest gap of a channel or of frames as text."""
    if values.get("rate") is None:
        return ""
    gap = f"largest gap {values['largest_gap']:.4g} s"
    return f"{values['rate']:.4g} Hz, median period {values['period']:.4g} s, {gap}"


def _amount(size: int) -> str:
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= scale:
            return f"{size / scale:.1f} {unit}"
    return number_of(size, "byte")


def _shown(text: str) -> str:
    """Replace unprintable characters of a text, because they could control the terminal."""
    if text.isprintable():  # nearly every cell of a long table
        return text
    return "".join(c if c.isprintable() else "�" for c in text)
