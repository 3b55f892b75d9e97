"""The application, the arguments that verbs share, and how their texts become values."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from sgstore.cli.output import Format, say
from sgstore.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.coverage import Chosen
    from sgstore.matches import Matches
    from sgstore.query import Store
    from sgstore.sandbox import Answer

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ERROR, USAGE, LOSS, NO_MATCH, INTERRUPTED = 1, 2, 3, 4, 130
"""Exit codes; 0 is done."""

StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="The store: one DuckDB file.")]
FrameName = Annotated[
    str, typer.Argument(metavar="FRAME", help="A frame_id, TRACE#SEQ, or TRACE@12.3s.")
]
QueryText = Annotated[
    str | None, typer.Argument(metavar="QUERY", help="A pattern: 'MATCH (e:Ego) …'.")
]
QueryFile = Annotated[
    Path | None, typer.Option("--file", "-f", help="Read the query from a file; - is stdin.")
]
PatternName = Annotated[
    str | None,
    typer.Option(
        "--pattern", "-p", metavar="NAME", help="A pattern of the library, in place of a query."
    ),
]
Parameters = Annotated[
    list[str] | None,
    typer.Option(
        "--param",
        metavar="NAME=VALUE",
        help="Value of $NAME in the query, a list as [1, 2]; repeatable.",
    ),
]
With = Annotated[
    list[str] | None,
    typer.Option(
        "--with",
        metavar="[NAME=]FILE",
        help="Join a table of your own (Parquet, CSV, JSON): by frame_id, or by trace and seq, time_ns"
        " or t; repeatable.",
    ),
]
RowFormat = Annotated[Format, typer.Option("--format", help="How rows are printed.")]
SgsmCompat = Annotated[
    bool,
    typer.Option(
        "--sgsm-compat", help="Violated if any beginning of a trace is, as SGSM reports it."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Short for --format json.")]
Output = Annotated[
    Path | None, typer.Option("--output", "-o", help="Write to this file instead of stdout.")
]


@app.callback(invoke_without_command=True)
def sgstore(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Find the driving scenes that matter.

    Recordings go in (ingest), frames are found by what happens in them (find,
    sql), looked at (show), and exported as clips (export). First steps: demo.
    """
    if version:
        from importlib.metadata import version as version_of

        typer.echo(f"sgstore {version_of('sgstore')}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


def open_store(store: Path, tables: Mapping[str, Path] | None = None) -> Store:
    """The store at a path, with tables of the user's own; rows of these that belong to no frame are told."""
    from sgstore.query import Store

    opened = Store(store, tables=tables)
    for name, joined in opened.file.joined().items():
        if joined.matched < joined.rows:
            lost = joined.rows - joined.matched
            say(f"{name}: {lost} of {joined.rows} rows belong to no frame of the store")
    return opened


_ENDINGS: Final = {
    ".csv": Format.csv,
    ".json": Format.json,
    ".ndjson": Format.ndjson,
    ".jsonl": Format.ndjson,
    ".parquet": Format.parquet,
    ".arrow": Format.arrow,
    ".feather": Format.arrow,
    ".txt": Format.table,
    "": Format.table,
}


def form_of(form: Format, output: Path | None = None, *, as_json: bool) -> Format:
    """What ``--format`` and ``--json`` mean together; without them the name of the file says it."""
    if as_json or form is not Format.table or output is None:
        return Format.json if as_json else form
    found = _ENDINGS.get(output.suffix.lower())
    if found is None:
        known = ", ".join(filter(None, _ENDINGS))
        raise typer.BadParameter(
            f"--output {output}: nothing is written as '{output.suffix}'; expected one of {known}"
        )
    return found


def tables_of(given: list[str] | None) -> dict[str, Path]:
    """``--with`` as files by the names of their tables: ``NAME=FILE``, or the name of the file."""
    tables: dict[str, Path] = {}
    for text in given or []:
        name, equals, path = text.partition("=")
        file = Path(path if equals else text)
        name = name if equals else re.sub(r"\W", "_", file.stem)
        if not name.isidentifier():
            raise typer.BadParameter(f"--with {text!r}: expected NAME=FILE, such as labels={file}")
        if name in tables:
            raise typer.BadParameter(f"--with: two tables are called {name!r}; write NAME=FILE")
        tables[name] = file
    return tables


def query_of(text: str | None, file: Path | None) -> str:
    """The query of an argument, or of a file."""
    if (text is None) == (file is None):
        raise typer.BadParameter("give a query as an argument, or a file with -f FILE")
    return text if text is not None else text_of(file or Path("-"))


def asked_of(
    text: str | None, file: Path | None, name: str | None, values: Mapping[str, Any]
) -> tuple[str, Mapping[str, Any]]:
    """The query as a text, from a file, or of the library by its name; and values that it does not hold yet."""
    if sum(source is not None for source in (text, file, name)) != 1:
        raise typer.BadParameter("give one of: a query as a text, a file with it, -p NAME")
    if name is None:
        return query_of(text, file), values
    from sgstore.lang import pattern_named

    return pattern_named(name).written(**values), {}


def text_of(file: Path) -> str:
    """The text in a file; ``-`` is stdin."""
    if str(file) == "-":
        return sys.stdin.read()
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        written = re.match(r"\s*(MATCH|CHECK|DEFINE|USING)\b", str(file))
        hint = "; this is a query, and no file of that name" if written else ""
        raise ConfigError(f"{file}: {getattr(error, 'strerror', None) or error}{hint}") from error


def lines_of(file: Path) -> list[str]:
    """The lines of a file that hold something."""
    return [line.strip() for line in text_of(file).splitlines() if line.strip()]


def parameters_of(pairs: list[str] | None) -> dict[str, Any]:
    """``NAME=VALUE`` as values: numbers, ``true`` and ``false``, lists as in JSON, all else as texts."""
    values: dict[str, Any] = {}
    for pair in pairs or []:
        name, equals, value = pair.partition("=")
        if not equals or not name.isidentifier():
            raise typer.BadParameter(f"--param {pair!r}: expected NAME=VALUE")
        values[name] = _listed(pair, value) if value.startswith("[") else _parameter(value)
    return values


def _listed(pair: str, value: str) -> Any:
    import json  # few need it

    try:
        return json.loads(value)
    except (ValueError, RecursionError):
        hint = """expected a list as in JSON: '["car", "bus"]'"""
        raise typer.BadParameter(f"--param {pair!r}: {hint}") from None


def _parameter(value: str) -> Any:
    if value.lower() in {"true", "false"}:
        return value.lower() == "true"
    for number in (int, float):
        try:
            return number(value)
        except ValueError:
            continue
    return value


_TIME: Final = re.compile(r"(\d+(?:\.\d+)?)\s*(ms|s|min)?")
_UNIT: Final = {"ms": 1e-3, "s": 1.0, "min": 60.0, None: 1.0}


def seconds_of(text: str, option: str) -> float:
    """A time such as ``2s`` in seconds."""
    match = _TIME.fullmatch(text.strip())
    if match is None:
        raise typer.BadParameter(f"{option} {text!r}: expected a time such as 2s, 500ms or 1min")
    return float(match[1]) * _UNIT[match[2]]


def say_left_out(matches: Matches | Answer | Chosen) -> None:
    """Say which traces cannot answer a query."""
    if matches.left_out:
        names = ", ".join(matches.left_out)
        say(f"left out, because they cannot answer this query (no road map, perhaps): {names}")
