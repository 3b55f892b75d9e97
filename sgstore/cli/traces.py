"""Verbs about recordings: read them into a store, say what is in it, and what is wrong with them."""

from __future__ import annotations

import os
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sgstore.cli.arguments import (
    ERROR,
    LOSS,
    AsJson,
    RowFormat,
    StorePath,
    app,
    form_of,
    lines_of,
    seconds_of,
)
from sgstore.cli.output import Format, say, write_document, write_rows
from sgstore.cli.reports import write_report

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.config import Config as Settings
    from sgstore.ingest import TraceOutcome


RoadMap = Annotated[
    Path | None,
    typer.Option(
        "--map",
        help="OpenDRIVE file, or folder of NAME.xodr, for recordings that carry no map of their own.",
    ),
]
Config = Annotated[
    Path | None, typer.Option("--config", help="TOML file with settings of the scene graphs.")
]
Preset = Annotated[
    str | None,
    typer.Option("--preset", metavar="NAME", help="Settings with a name: see config --list."),
]

Traces = Annotated[
    list[str],
    typer.Argument(
        metavar="TRACE…",
        help="Recordings, folders of them, patterns ('drives/**/day?.mcap'); - reads a list from stdin.",
    ),
]
Ego = Annotated[
    list[str] | None,
    typer.Option(
        "--ego",
        help="Id, role or name of the ego; repeatable, each makes a trace; all: every vehicle.",
    ),
]
Jobs = Annotated[
    int,
    typer.Option("--jobs", "-j", min=0, help="Recordings read at a time; 0: one for each core."),
]
Since = Annotated[
    str | None, typer.Option("--since", help="From this time of a recording on: 10s.")
]
Until = Annotated[str | None, typer.Option("--until", help="Up to this time: 1min.")]
Rate = Annotated[
    float | None, typer.Option("--rate", min=0, help="Frames to keep of a second; 0: all.")
]
Force = Annotated[
    bool, typer.Option("--force", help="Read anew, and replace, what is in the store already.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")]


@app.command()
def ingest(
    store: StorePath,
    traces: Traces,
    road_map: RoadMap = None,
    config: Config = None,
    preset: Preset = None,
    ego: Ego = None,
    jobs: Jobs = 1,
    since: Since = None,
    until: Until = None,
    rate: Rate = None,
    force: Force = False,
    dry_run: DryRun = False,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> int:
    """Read recordings into a store; what is in it already is left as it is."""
    from sgstore.cli.progress import ingest_bar
    from sgstore.ingest import ingest as ingest_traces
    from sgstore.ingest import recordings

    with ingest_bar() as on_progress:
        outcomes = ingest_traces(
            store,
            recordings(_names(traces)),
            road_map=road_map,
            config=settings_of(config, preset),
            egos=ego or (),
            jobs=jobs or os.cpu_count() or 1,
            since=None if since is None else seconds_of(since, "--since"),
            until=None if until is None else seconds_of(until, "--until"),
            rate=rate,
            force=force,
            dry_run=dry_run,
            on_progress=on_progress,
        )
    for outcome in outcomes:
        _say_what_was_odd(outcome)
    columns = ("trace", "status", "ego", "frames", "entities", "seconds", "losses", "file")
    write_rows(columns, map(_outcome_row, outcomes), form_of(form, as_json=as_json))
    if any(outcome.error for outcome in outcomes):
        return ERROR
    return LOSS if any(outcome.losses for outcome in outcomes) else 0


def _names(traces: list[str]) -> list[str]:
    """The names given, those on stdin in place of ``-``."""
    return [name for one in traces for name in (lines_of(Path("-")) if one == "-" else [one])]


def settings_of(config: Path | None, preset: str | None) -> Settings | None:
    """What ``--config`` and ``--preset`` say; ``None``: neither is given."""
    from sgstore.config import load
    from sgstore.config import preset as preset_named

    if config and preset:
        raise typer.BadParameter("give --config or --preset; a file may name a preset itself")
    return preset_named(preset) if preset else load(config) if config else None


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
        outcome.ego,
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
    form = form_of(form, as_json=as_json)
    if trace is not None:
        with file.snapshot():
            found = file.trace(trace)
            channels = [asdict(channel) for channel in file.channels(found.trace_id)]
        if form is Format.table:
            write_report(
                found.as_dict() | found.report | {"frames": found.frames, "channels": channels}
            )
        else:
            write_document(found.as_dict() | {"channels": channels}, form)
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
def doctor(
    traces: Traces,
    road_map: RoadMap = None,
    config: Config = None,
    preset: Preset = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> int:
    """Say what would be read of recordings, and what is wrong with them; no store is needed."""
    from sgstore.ingest import Examination, examine, recordings

    form = form_of(form, as_json=as_json)
    settings = settings_of(config, preset)
    found = (
        examine(path, config=settings, road_map=road_map) for path in recordings(_names(traces))
    )
    codes: set[int] = set()

    def seen() -> Iterator[dict[str, Any]]:
        for one in found:
            codes.add(ERROR if one.error else LOSS if one.losses else 0)
            yield one.as_dict()

    if form is Format.table:
        for number, values in enumerate(seen()):
            sys.stdout.write("\n" if number else "")
            write_report(values)
    else:
        columns = [column.name for column in fields(Examination)]
        write_rows(columns, (tuple(values.values()) for values in seen()), form)
    return ERROR if ERROR in codes else max(codes, default=0)
