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
Parameters = Annotated[
    list[str] | None,
    typer.Option("--param", metavar="NAME=VALUE", help="Value of $NAME in the query; repeatable."),
]
RowFormat = Annotated[Format, typer.Option("--format", help="How rows are printed.")]
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


def open_store(store: Path) -> Store:
    """The store at a path."""
    from sgstore.query import Store

    return Store(store)


def form_of(form: Format, *, as_json: bool) -> Format:
    """What ``--format`` and ``--json`` mean together."""
    return Format.json if as_json else form


def query_of(text: str | None, file: Path | None) -> str:
    """The query of an argument, or of a file."""
    if (text is None) == (file is None):
        raise typer.BadParameter("give a query as an argument, or a file with -f FILE")
    return text if text is not None else text_of(file or Path("-"))


def text_of(file: Path) -> str:
    """The text in a file; ``-`` is stdin."""
    if str(file) == "-":
        return sys.stdin.read()
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: {getattr(error, 'strerror', None) or error}") from error


def lines_of(file: Path) -> list[str]:
    """The lines of a file that hold something."""
    return [line.strip() for line in text_of(file).splitlines() if line.strip()]


def parameters_of(pairs: list[str] | None) -> dict[str, Any]:
    """``NAME=VALUE`` as values: a number where it is one, ``true`` and ``false``, else a text."""
    values: dict[str, Any] = {}
    for pair in pairs or []:
        name, equals, value = pair.partition("=")
        if not equals or not name.isidentifier():
            raise typer.BadParameter(f"--param {pair!r}: expected NAME=VALUE")
        values[name] = _parameter(value)
    return values


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


def say_left_out(matches: Matches | Answer) -> None:
    """Say which traces cannot answer a query."""
    if matches.left_out:
        names = ", ".join(matches.left_out)
        say(f"left out, because they cannot answer this query (no road map, perhaps): {names}")
