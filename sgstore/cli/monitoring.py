"""The verb that watches: checks and patterns over a recording as if it were live, or a running simulator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sgstore.cli.arguments import (
    LOSS,
    NO_MATCH,
    AsJson,
    Parameters,
    SgsmCompat,
    app,
    asked_of,
    parameters_of,
    seconds_of,
)
from sgstore.cli.output import say
from sgstore.cli.traces import Config, Preset, RoadMap, settings_of

if TYPE_CHECKING:
    from sgstore.history.checks import Verdict
    from sgstore.monitor import Event, Moment


@app.command()
def monitor(
    trace: Annotated[
        str,
        typer.Argument(metavar="TRACE", help="A recording; or carla://HOST:PORT, until Ctrl-C."),
    ],
    file: Annotated[
        Path | None,
        typer.Argument(metavar="[FILE]", help="A file of CHECK and MATCH statements; - is stdin."),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--pattern", "-p", metavar="NAME", help="One of the library.")
    ] = None,
    text: Annotated[
        str | None, typer.Option("--expression", "-e", metavar="TEXT", help="'CHECK ALWAYS …'")
    ] = None,
    parameters: Parameters = None,
    road_map: RoadMap = None,
    config: Config = None,
    preset: Preset = None,
    ego: Annotated[
        str, typer.Option("--ego", help="Id, role or name of the ego; else as the recording says.")
    ] = "",
    duration: Annotated[
        str | None, typer.Option("--duration", metavar="TIME", help="Simulation time: 60s.")
    ] = None,
    sgsm_compat: SgsmCompat = False,
    require: Annotated[
        bool, typer.Option("--require", help="End with exit code 4 if a check is violated.")
    ] = False,
    as_json: AsJson = False,
) -> int:
    """Watch a recording as if it were live, or a running CARLA.

    One line for each violation and each match, as soon as it is known; then the verdicts. The answers are
    those of check and find over a store.
    """
    from sgstore.config import Config as Settings
    from sgstore.monitor import Monitor
    from sgstore.monitor.sources import opened

    asked, values = asked_of(text, file, name, parameters_of(parameters))
    settings = settings_of(config, preset) or Settings()
    tell = _as_json if as_json else _for_people
    with opened(trace, settings, road_map=road_map, ego=ego) as source:
        watched = Monitor(
            asked,
            source.road_map,
            settings,
            on_event=tell,
            parameters=values,
            trace=source.name,
            called=name or "pattern",
            sgsm_compat=sgsm_compat,
        )
        longest = seconds_of(duration, "--duration") if duration else None
        verdicts = watched.run(source.frames, duration_s=longest)
    for warning in [*source.warnings, *source.losses]:
        say(warning)
    for verdict in verdicts:
        _tell_verdict(verdict, as_json=as_json)
    if require and any(verdict.violated for verdict in verdicts):
        return NO_MATCH
    return LOSS if source.losses else 0


def _for_people(event: Event) -> None:
    who = ", ".join(f"{variable} = {name}" for variable, name in event.names.items())
    about = f"from {event.start.t:.3f} s" if event.start != event.told else ""
    if event.kind == "kept again":
        about = f"after {event.end.t - event.start.t:.3f} s"
    if event.at_end:
        about = "at the end"
    parts = (f"{event.told.t:9.3f} s", event.kind.ljust(10), event.name, who, about)
    _line("  ".join(part for part in parts if part))


def _as_json(event: Event) -> None:
    about: dict[str, Any] = {
        "event": event.kind,
        "name": event.name,
        "told": _moment(event.told),
        "start": _moment(event.start),
        "end": _moment(event.end),
        "nodes": dict(event.nodes),
        "names": dict(event.names),
        "steps": [_moment(step) for step in event.steps],
        "at_end": event.at_end,
    }
    _line(json.dumps(about, ensure_ascii=False))


def _moment(moment: Moment) -> dict[str, Any]:
    return {"seq": moment.seq, "time_ns": moment.time_ns, "t": moment.t}


def _tell_verdict(verdict: Verdict, *, as_json: bool) -> None:
    if as_json:
        about = {
            "event": "verdict",
            "name": verdict.check,
            "trace": verdict.trace,
            "verdict": verdict.verdict,
            "violations": len(verdict.violations),
        }
        _line(json.dumps(about, ensure_ascii=False))
    else:
        count = len(verdict.violations)
        more = f"  {count} violation{'s' * (count > 1)}" if count else ""
        _line(f"{verdict.check}: {verdict.verdict}{more}")


def _line(text: str) -> None:
    """A line that is there at once, whoever reads it."""
    typer.echo(text)
