"""Verbs that need a running simulator."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from sgstore.cli.arguments import LOSS, app, seconds_of
from sgstore.cli.output import say

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

PORT: Final = 2000
"""Where a CARLA server listens by default."""


@app.command()
def record(
    output: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="The recording: FILE.mcap; nothing is overwritten."),
    ],
    host: Annotated[str, typer.Option("--host", help="Where the CARLA server runs.")] = "localhost",
    port: Annotated[int, typer.Option("--port", help="Its port.")] = PORT,
    ego: Annotated[
        str, typer.Option("--ego", help="Id or role name of the ego; by default hero, ego_vehicle.")
    ] = "",
    sensors: Annotated[
        Path | None,
        typer.Option("--sensors", help="A TOML file with a table [[sensor]] for each sensor."),
    ] = None,
    duration: Annotated[
        str | None,
        typer.Option("--duration", metavar="TIME", help="Simulation time: 60s; else until Ctrl-C."),
    ] = None,
    step: Annotated[
        str | None,
        typer.Option(
            "--step", metavar="TIME", help="Drive the world in steps: 50ms; else follow it."
        ),
    ] = None,
    scenery: Annotated[
        bool, typer.Option("--scenery/--no-scenery", help="Buildings, poles, … of the level, too.")
    ] = True,
) -> int:
    """Record a running CARLA into an MCAP file: frames, road map and sensors of the ego."""
    from sgstore.recording import record as record_world
    from sgstore.traces.carla_live import connect
    from sgstore.traces.carla_sensors import load_sensors

    attached = load_sensors(sensors) if sensors else []
    duration_s = seconds_of(duration, "--duration") if duration else None
    step_s = seconds_of(step, "--step") if step else None
    world = connect(host, port).get_world()
    with _counter() as count:
        done = record_world(
            world,
            output,
            ego=ego,
            sensors=attached,
            duration_s=duration_s,
            step_s=step_s,
            scenery=scenery,
            on_frame=count,
        )
    for warning in done.warnings:
        say(warning)
    written = done.written
    seconds = (written.end_ns - written.start_ns) / 1e9
    say(f"{written.frames} frames, {seconds:.2f} s; sgstore ingest STORE {written.path}")
    typer.echo(written.path)
    return LOSS if done.dropped else 0


@contextmanager
def _counter() -> Generator[Callable[[int, float], None] | None]:
    """A line that counts frames on stderr; ``None`` where that is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console

    with Console(stderr=True).status("waiting for the first frame") as line:
        yield lambda frames, seconds: line.update(
            f"{frames} frames, {seconds:.1f} s of simulation; Ctrl-C ends the recording"
        )
