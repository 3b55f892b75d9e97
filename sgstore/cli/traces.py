"""Verbs about recordings: read them into a store, say what is in it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sgstore.cli.arguments import ERROR, LOSS, AsJson, RowFormat, StorePath, app, form_of
from sgstore.cli.output import Format, say, write_document, write_rows
from sgstore.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.ingest import TraceOutcome


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
    preset: Annotated[
        str | None,
        typer.Option("--preset", metavar="NAME", help="Settings with a name: see config --list."),
    ] = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> int:
    """Read recordings into a store; what is in it already is left as it is."""
    from sgstore.cli.progress import ingest_bar
    from sgstore.config import load
    from sgstore.config import preset as preset_named
    from sgstore.ingest import ingest as ingest_traces

    if config and preset:
        raise typer.BadParameter("give --config or --preset; a file may name a preset itself")
    settings = preset_named(preset) if preset else load(config) if config else None
    with ingest_bar() as on_progress:
        outcomes = ingest_traces(
            store, _recordings(traces), road_map=road_map, config=settings, on_progress=on_progress
        )
    for outcome in outcomes:
        _say_what_was_odd(outcome)
    columns = ("trace", "status", "frames", "entities", "seconds", "losses", "file")
    write_rows(columns, map(_outcome_row, outcomes), form_of(form, as_json=as_json))
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
    form = form_of(form, as_json=as_json)
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
