"""Command ``sgstore monitor``: evaluates checks and patterns frame by frame, on a recording or a simulator."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from sgstore.apps.cli._checks import PANEL, margin_document
from sgstore.apps.cli._options import (
    LOSS,
    NO_MATCH,
    AsJson,
    ReadingOptions,
    Statements,
    Verbs,
    say_notes,
    seconds_of,
)
from sgstore.apps.cli._output import json_text, say
from sgstore.apps.cli._process import was_ended
from sgstore.base.output_files import without_controls

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from sgstore.readers import Sensor
    from sgstore.temporal import FrameSource, Monitor, MonitorEvent, Verdict

verbs = Verbs()


@verbs.command(rich_help_panel=PANEL)
def monitor(
    trace: str,
    checks: Annotated[list[str] | None, Argument()] = None,
    ego: str = "",
    duration: str | None = None,
    require: bool = False,
    as_json: AsJson = False,
    serve: bool = False,
    port: Annotated[int, Option(min=0, max=65535)] = 0,
    sensors: Path | None = None,
    *,
    statements: Statements,
    reading: ReadingOptions,
) -> int:
    """Evaluate checks and patterns frame by frame, on a recording or a running CARLA.

    One line for each violation and each match, as soon as it is known; then the verdicts. The answers are
    those of check and find over a store. With --serve a page shows
    the scene, a recording in its own time; it stays until Ctrl-C.

    Parameters
    ----------
    trace : TRACE
        A recording; or carla://HOST:PORT, until Ctrl-C.
    checks : [CHECK…]
        Checks and patterns, their names in the library, or files; - reads stdin.
    ego
        Ego: id, role or name; by default that of the recording.
    duration : TIME
        Simulation time: 60s.
    require
        End with exit code 4 if a check is violated.
    serve
        Show the running monitor on a page.
    port
        Its port; 0: any free.
    sensors
        With --serve: cameras for the ego of CARLA, as for record.
    """
    from sgstore.lang.syntax import joined
    from sgstore.model.config import Config
    from sgstore.pipeline.plausibility import Plausibility
    from sgstore.temporal import Monitor, opened

    asked, values = statements.asked(checks)
    settings = reading.settings() or Config()
    write = _write_json if as_json else _write_text
    longest = seconds_of(duration, "--duration") if duration else None
    cameras = _sensors(sensors, shown=serve and trace.startswith("carla://"))
    with opened(trace, settings, road_map=reading.road_map, ego=ego, sensors=cameras) as source:
        checked = Plausibility(source.road_map)
        source.frames = checked.watched(source.frames)
        watch = partial(
            Monitor,
            joined([*chain.from_iterable(asked.values())]),
            source.road_map,
            settings,
            parameters=values,
            trace=source.name,
            topics=source.topics,
            called=_pattern_names(asked),
            sgsm_compat=statements.sgsm_compat,
        )
        if serve:
            watched, verdicts = _run_with_page(watch, source, write, longest, port)
        else:
            watched = watch(on_event=write)
            say_notes(watched.notes)
            verdicts = watched.run(source.frames, duration_s=longest)
    losses = [*source.losses, *(loss.reason for loss in watched.generator.losses)]
    found = checked.findings()
    known = [one.value for one in found]
    warnings = [one for one in source.warnings if one not in known]
    for warning in [*warnings, *map(str, found), *losses]:
        say(warning)
    for verdict in verdicts:
        _write_verdict(verdict, as_json=as_json)
    if require and any(verdict.violated for verdict in verdicts):
        return NO_MATCH
    return LOSS if losses else 0


def _sensors(file: Path | None, *, shown: bool) -> list[Sensor]:
    """Return the CARLA sensors listed in a file. Raise an error if no live page shows them."""
    from sgstore.readers import load_sensors

    if file is not None and not shown:
        told = "--sensors needs the page of a running CARLA: carla://HOST:PORT --serve"
        raise typer.BadParameter(told)
    return [] if file is None else load_sensors(file)


def _run_with_page(
    watch: Callable[..., Monitor],
    source: FrameSource,
    write: Callable[[MonitorEvent], None],
    longest: float | None,
    port: int,
) -> tuple[Monitor, tuple[Verdict, ...]]:
    """Run a monitor and serve its live page. Return the monitor and the verdicts when both have ended."""
    from sgstore.apps.explorer import LiveRun, serve_live
    from sgstore.temporal import paced

    page = LiveRun(source.name, source.road_map, source.cameras)

    def on_event(event: MonitorEvent) -> None:
        write(event)
        page.event(event)

    watched = watch(on_event=on_event, on_step=page.step)
    say_notes(watched.notes)
    page.follow(watched)
    with serve_live(page, port=port, on_start=say):
        frames = source.frames if source.live else paced(source.frames)
        verdicts = watched.run(frames, duration_s=longest)
        page.end(verdicts)
        if not was_ended():
            say("the page is served until Ctrl-C")
            with suppress(KeyboardInterrupt):
                threading.Event().wait()
    return watched, verdicts


def _pattern_names(asked: Mapping[str, list[str]]) -> list[str]:
    """Return the names of the patterns as they occur in monitor events, in the order of the queries."""
    from sgstore.lang.sql import each_match
    from sgstore.lang.syntax import parse
    from sgstore.lang.syntax.tree import MatchClause

    every: list[str] = []
    for name, texts in asked.items():
        statements = (one for text in texts for one in each_match(parse(text)))
        count = sum(isinstance(one, MatchClause) for one in statements)
        every += [name] if count == 1 else [f"{name} {number + 1}" for number in range(count)]
    return every


def _write_text(event: MonitorEvent) -> None:
    binding = ", ".join(f"{variable} = {name}" for variable, name in event.names.items())
    about = f"from {event.start.t:.3f} s" if event.start != event.told else ""
    if event.kind == "kept again":
        about = f"after {event.end.t - event.start.t:.3f} s"
    if event.at_end:
        about = "at the end"
    from sgstore.temporal import cell_of

    values = ", ".join(f"{name} = {cell_of(value)}" for name, value in event.values.items())
    parts = (f"{event.told.t:9.3f} s", event.kind.ljust(10), event.name, binding, about, values)
    _line("  ".join(part for part in parts if part))


def _write_json(event: MonitorEvent) -> None:
    about = asdict(event)
    if not event.values:
        del about["values"]
    _line(json_text({"event": about.pop("kind"), **about}))


def _write_verdict(verdict: Verdict, *, as_json: bool) -> None:
    if as_json:
        about: dict[str, Any] = {
            "event": "verdict",
            "name": verdict.check,
            "trace": verdict.trace,
            "verdict": verdict.verdict,
            "violations": len(verdict.violations),
            "reason": verdict.reason or None,
            "absent_frames": verdict.absent_frames,
        }
        if verdict.robustness is not None:
            about["robustness"] = margin_document(verdict)
        _line(json_text(about))
    else:
        from sgstore.temporal import absence_text, margin_cells

        count = len(verdict.violations)
        more = f"  {count} violation{'s' * (count > 1)}" if count else ""
        why = f"  ({verdict.reason})" if verdict.reason else ""
        margin, decided, _ = margin_cells(verdict)
        more += f"  robustness {margin}" if margin else ""
        more += f"  {decided}" if decided else ""
        more += f"  {absence_text(verdict.absent_frames)}" if verdict.absent_frames else ""
        _line(f"{verdict.check}: {verdict.verdict}{more}{why}")


def _line(text: str) -> None:
    """Print a line to stdout at once, without buffering."""
    typer.echo(without_controls(text))
