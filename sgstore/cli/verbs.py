"""The verbs: what each takes, the function of the library that it calls, and what it prints."""

from __future__ import annotations

import re
import sys
from enum import StrEnum
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from sgstore.cli.output import Format, say, write_document, write_rows
from sgstore.errors import ConfigError, StoreError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.ingest import TraceOutcome
    from sgstore.query import Matches, Store

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ERROR, LOSS, NO_MATCH = 1, 3, 4

StorePath = Annotated[Path, typer.Argument(metavar="STORE", help="The store: one DuckDB file.")]
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

BEFORE_AFTER: Final = "2s"


class DrawnRelations(StrEnum):
    """Which edges a picture shows."""

    ego = "ego"
    all = "all"
    none = "none"


class ClipFormat(StrEnum):
    """Formats that clips are exported in."""

    mcap = "mcap"


@app.callback(invoke_without_command=True)
def sgstore(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Find the driving scenes that matter.

    Recordings go in (`ingest`), frames are found by what happens in them (`find`, `sql`), looked at
    (`show`), and exported as clips (`export`). `sgstore demo` does all of it on a bundled recording.
    """
    if version:
        from importlib.metadata import version as version_of

        typer.echo(f"sgstore {version_of('sgstore')}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def ingest(
    store: StorePath,
    traces: Annotated[
        list[Path], typer.Argument(metavar="TRACE…", help="Recordings (MCAP), or folders of them.")
    ],
    road_map: Annotated[
        Path | None,
        typer.Option("--map", help="OpenDRIVE file for recordings that carry no map of their own."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="TOML file with settings of the scene graphs.")
    ] = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> int:
    """Read recordings into a store; what is in it already is left as it is."""
    from sgstore.cli.progress import ingest_bar
    from sgstore.config import load
    from sgstore.ingest import ingest as ingest_traces

    settings = load(config) if config else None
    with ingest_bar() as on_progress:
        outcomes = ingest_traces(
            store, _recordings(traces), road_map=road_map, config=settings, on_progress=on_progress
        )
    for outcome in outcomes:
        _say_what_was_odd(outcome)
    columns = ("trace", "status", "frames", "entities", "seconds", "losses", "file")
    write_rows(columns, map(_outcome_row, outcomes), _form(form, as_json=as_json))
    if any(outcome.error for outcome in outcomes):
        return ERROR
    return LOSS if any(outcome.losses for outcome in outcomes) else 0


def _recordings(paths: Iterable[Path]) -> list[Path]:
    """The files meant: a folder stands for the recordings in it and below it."""
    found: list[Path] = []
    for path in paths:
        inside = sorted(path.rglob("*.mcap")) if path.is_dir() else [path]
        if not inside:
            raise StoreError(f"{path}: no .mcap file in this folder or below it")
        found += inside
    return list(dict.fromkeys(found))


def _say_what_was_odd(outcome: TraceOutcome) -> None:
    if outcome.error:
        say(str(outcome.error))
    for name, number in outcome.unknown_types.items():
        say(f"{outcome.path}: {number} entities of unknown type {name!r}, kept as 'unknown'")
    for warning in outcome.warnings:
        say(f"{outcome.path}: {warning}")
    for loss in outcome.losses:
        say(f"{outcome.path}: lost: {loss.reason}")


def _outcome_row(outcome: TraceOutcome) -> tuple[Any, ...]:
    return (
        outcome.name,
        outcome.status,
        outcome.frames,
        sum(outcome.entities.values()),
        round(outcome.seconds, 2),
        len(outcome.losses),
        str(outcome.path),
    )


@app.command()
def info(
    store: StorePath,
    trace: Annotated[
        str | None, typer.Option("--trace", help="One trace in full: a name, id, or beginning.")
    ] = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> int:
    """List the traces of a store, or say all that is known of one."""
    from sgstore.store import StoreFile

    file = StoreFile(store)
    form = _form(form, as_json=as_json)
    if trace is not None:
        write_document(file.trace(trace).as_dict(), form)
        return 0
    columns = ("trace", "frames", "seconds", "ego", "map", "flavour", "losses", "trace_id", "file")
    write_rows(
        columns,
        (
            (
                one.name,
                one.frames,
                round((one.end_ns - one.start_ns) / 1e9, 3),
                one.ego,
                one.map,
                one.flavour,
                len(one.report["losses"]),
                one.trace_id,
                str(one.path),
            )
            for one in file.traces()
        ),
        form,
    )
    return 0


@app.command()
def find(
    store: StorePath,
    query: QueryText = None,
    file: QueryFile = None,
    parameters: Parameters = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
    output: Output = None,
    count: Annotated[
        bool, typer.Option("--count", help="Print the number of distinct frames and nothing else.")
    ] = False,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print how the query is understood, and its SQL.")
    ] = False,
    require: Annotated[
        bool, typer.Option("--require", help="End with exit code 4 if nothing matches.")
    ] = False,
) -> int:
    """Find frames by a pattern of their scene graphs.

    One row a match: the frame, its time, and what each variable is bound to; or what RETURN asks for.
    """
    opened = _opened(store)
    matches = opened.find(_query(query, file), **_parameters(parameters))
    if explain:
        typer.echo(matches.explain())
        return 0
    _say_left_out(matches)
    if count:
        number = matches.count()
        typer.echo(number)
    else:
        form = _form(form, as_json=as_json)
        columns, rows = matches.for_people() if form is Format.table else (matches.columns, matches)
        number = write_rows(columns, rows, form, output)
        if not number and form is Format.table:
            say("nothing matches")
    return NO_MATCH if require and not number else 0


@app.command()
def sql(
    store: StorePath,
    statement: Annotated[
        str | None, typer.Argument(metavar="SQL", help="'SELECT … FROM frames, nodes, edges …'")
    ] = None,
    file: QueryFile = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
    output: Output = None,
) -> int:
    """Ask a store in SQL, read only.

    Views: frames, nodes, edges, lane_states, pairs, lanes, entities, payloads; DESCRIBE names their columns.
    """
    from sgstore.store import StoreFile

    with StoreFile(store).user_batches(_query(statement, file)) as batches:
        rows = chain.from_iterable(batch.values for batch in batches)
        write_rows(batches.columns, rows, _form(form, as_json=as_json), output, batches.types)
    return 0


@app.command()
def show(
    store: StorePath,
    frame: Annotated[
        str, typer.Argument(metavar="FRAME", help="A frame_id, TRACE#SEQ, or TRACE@12.3s.")
    ],
    query: QueryText = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The picture: .png or .svg.")
    ] = Path("frame.png"),
    file: QueryFile = None,
    parameters: Parameters = None,
    relations: Annotated[
        DrawnRelations, typer.Option("--relations", help="Which edges are drawn.")
    ] = DrawnRelations.ego,
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera", help="Channel of a picture to put beside it; 'none' for no picture."
        ),
    ] = None,
    radius: Annotated[
        float | None, typer.Option("--radius", help="Half the side of the window, in metres.")
    ] = None,
    north_up: Annotated[
        bool, typer.Option("--north-up", help="North is up, not the ego's heading.")
    ] = False,
) -> int:
    """Draw a frame from above; with a QUERY, what it matches there is marked."""
    from sgstore.draw.stored import draw_stored

    opened = _opened(store)
    text = _query(query, file) if query or file else None
    marked = draw_stored(
        opened,
        frame,
        output,
        matches=opened.find(text, **_parameters(parameters)) if text else None,
        camera=camera,
        relations=relations.value,
        radius=radius,
        north_up=north_up,
    )
    if text and not marked:
        say(f"the query does not match in {frame}: nothing is marked")
    typer.echo(output)
    return 0


@app.command()
def export(
    store: StorePath,
    query: QueryText = None,
    to: Annotated[
        Path,
        typer.Option("--to", metavar="DIR", help="Folder to write into; nothing is overwritten."),
    ] = Path("clips"),
    file: QueryFile = None,
    parameters: Parameters = None,
    frames: Annotated[
        Path | None,
        typer.Option(
            "--frames", help="Instead of a query: a file with a FRAME a line; - is stdin."
        ),
    ] = None,
    clip_format: Annotated[
        ClipFormat, typer.Option("--format", help="What the clips are written as.")
    ] = ClipFormat.mcap,
    before: Annotated[
        str, typer.Option("--before", metavar="TIME", help="Time before each match: 2s, 500ms.")
    ] = BEFORE_AFTER,
    after: Annotated[
        str, typer.Option("--after", metavar="TIME", help="Time after each match.")
    ] = BEFORE_AFTER,
    as_json: AsJson = False,
) -> int:
    """Cut matches out of their recordings, as clips with the original messages.

    RETURN CLIPS(-3s, +5s) in the query wins over --before and --after.
    """
    from sgstore.exporters.stored import around_frames, write_stored

    opened = _opened(store)
    margins = _seconds(before, "--before"), _seconds(after, "--after")
    if frames is not None:
        if query or file:
            raise typer.BadParameter("give a QUERY or --frames, not both")
        clips = around_frames(opened, _lines(frames), *margins)
        text = ""
    else:
        text = _query(query, file)
        matches = opened.find(text, **_parameters(parameters))
        _say_left_out(matches)
        clips = list(matches.clips(*margins))
    if not clips:
        say("nothing matches: nothing to export")
        return 0
    written = write_stored(opened, clips, to, form=clip_format.value, query=text)
    for clip in written:
        for loss in clip.losses:
            say(f"{clip.file.name}: lost: {loss.reason}")
    columns = ("clip", "trace", "start_ns", "seconds", "messages")
    rows = (
        (
            str(clip.file),
            clip.trace,
            clip.start_ns,
            round((clip.end_ns - clip.start_ns) / 1e9, 3),
            sum(channel.messages for channel in clip.messages),
        )
        for clip in written
    )
    write_rows(columns, rows, _form(Format.table, as_json=as_json))
    return LOSS if any(clip.losses for clip in written) else 0


@app.command()
def demo(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Where its store, pictures and clips are put.")
    ] = Path("sgstore-demo"),
) -> int:
    """Do the main job on a bundled recording: ingest, ask, look, export."""
    from sgstore.demo import run_demo

    run_demo(folder, typer.echo)
    return 0


# What verbs share -----------------------------------------------------------------------------------


def _opened(store: Path) -> Store:
    from sgstore.query import Store

    return Store(store)


def _form(form: Format, *, as_json: bool) -> Format:
    return Format.json if as_json else form


def _query(text: str | None, file: Path | None) -> str:
    if (text is None) == (file is None):
        raise typer.BadParameter("give a query as an argument, or a file with -f FILE")
    return text if text is not None else _text_of(file or Path("-"))


def _text_of(file: Path) -> str:
    if str(file) == "-":
        return sys.stdin.read()
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: {getattr(error, 'strerror', None) or error}") from error


def _lines(file: Path) -> list[str]:
    return [line.strip() for line in _text_of(file).splitlines() if line.strip()]


def _parameters(pairs: list[str] | None) -> dict[str, Any]:
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


def _seconds(text: str, option: str) -> float:
    match = _TIME.fullmatch(text.strip())
    if match is None:
        raise typer.BadParameter(f"{option} {text!r}: expected a time such as 2s, 500ms or 1min")
    return float(match[1]) * _UNIT[match[2]]


def _say_left_out(matches: Matches) -> None:
    if matches.left_out:
        names = ", ".join(matches.left_out)
        say(f"left out, because they cannot answer this query (no road map, perhaps): {names}")
