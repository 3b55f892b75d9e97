"""The verbs check, monitor and timeline.

Verdicts can be written as JUnit XML for build servers: one test per check and trace.
"""

from __future__ import annotations

import math
import re
import shutil
import threading
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer import Argument, Option

from sgstore.apps.cli._options import (
    LOSS,
    NO_MATCH,
    AsJson,
    AskedPath,
    AskOptions,
    Parameters,
    PatternNames,
    QueryLimits,
    ReadingOptions,
    Statements,
    StorePath,
    Traces,
    Verbs,
    parameters_of,
    say_notes,
    say_scope,
    say_unknown,
    seconds_of,
    text_of,
)
from sgstore.apps.cli._output import json_text, say
from sgstore.apps.cli._places import CollectionOptions, url_of
from sgstore.apps.cli._process import was_ended
from sgstore.base.output_files import without_controls, write_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.collection import PartedChecks
    from sgstore.matches import Interval
    from sgstore.readers import Sensor
    from sgstore.temporal import CheckRun, FrameSource, Monitor, MonitorEvent, Verdict

PANEL: Final = "Rules over time"

verbs = Verbs()


_NO_XML: Final = re.compile(r"[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML cannot hold, not even as references."""


def write_junit(path: Path, verdicts: Iterable[Verdict]) -> None:
    """Write a test suite for each check, with a case for each trace.

    A violated check is a failure whose text names each violation. A trace that cannot answer, or a
    pending verdict, is skipped. A passed case contains the number of frames without an entity.

    Parameters
    ----------
    path : Path
    verdicts : iterable of Verdict

    Raises
    ------
    ExportError
        The file cannot be written; an existing file stays unchanged.
    """
    from xml.etree import ElementTree as Xml  # few need it

    from sgstore.temporal import absence_text

    root = Xml.Element("testsuites", name="sgstore check")
    suites: dict[str, Xml.Element] = {}
    for one in verdicts:
        name = _plain(one.check)
        if name not in suites:
            suites[name] = Xml.SubElement(root, "testsuite", name=name)
        case = Xml.SubElement(suites[name], "testcase", classname=name, name=_plain(one.trace))
        if one.violated:
            lines = _violations(one)
            count = f"{len(lines)} violation{'s' * (len(lines) != 1)}"
            Xml.SubElement(case, "failure", message=count).text = "\n".join(lines)
        elif one.verdict != "true":
            Xml.SubElement(case, "skipped", message=_plain(one.reason or _word(one)))
        elif one.absent_frames:
            Xml.SubElement(case, "system-out").text = absence_text(one.absent_frames)
    for element, cases in [(root, root.findall("*/*")), *((s, list(s)) for s in suites.values())]:
        element.set("tests", str(len(cases)))
        element.set("failures", str(sum(case.find("failure") is not None for case in cases)))
        element.set("errors", "0")
        element.set("skipped", str(sum(case.find("skipped") is not None for case in cases)))
    Xml.indent(root)
    write_bytes(path, Xml.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _word(verdict: Verdict) -> str:
    """Return the text of a verdict without a reason."""
    return (
        "still due at the end of the recording" if verdict.verdict == "pending" else verdict.verdict
    )


def _violations(verdict: Verdict) -> list[str]:
    """Return a line for each violation: frames, times and values."""
    return [
        _plain(
            f"{one.trace}#{one.start_seq}-{one.end_seq}, {one.start:.3f} to {one.end:.3f} s,"
            f" {one.frames} frames"
            + "".join(f", {name} {value}" for name, value in one.values.items())
        )
        for one in verdict.violations
    ]


def _plain(text: str) -> str:
    """Replace characters that XML cannot hold by escapes."""
    return _NO_XML.sub(lambda found: f"\\x{ord(found[0]):02x}", text)


# The verb that checks: verdicts of traces -------------------------------------------------------


@verbs.command(rich_help_panel=PANEL)
def check(
    store: AskedPath,
    files: Annotated[
        list[Path] | None,
        Argument(metavar="[FILE…]", help="Files of CHECK statements; - is stdin."),
    ] = None,
    explain: Annotated[
        bool, Option("--explain", help="Print how the checks are understood, and their SQL.")
    ] = False,
    require: Annotated[
        bool, Option("--require", help="End with exit code 4 if a trace violates a check.")
    ] = False,
    junit: Annotated[
        Path | None,
        Option(metavar="FILE", help="Write the verdicts as JUnit's XML, too, for build servers."),
    ] = None,
    *,
    whole: CollectionOptions,
    statements: Statements,
    ask: AskOptions,
) -> int:
    """Check what must be true of every trace.

    One row a check and trace: true, false, unknown where it cannot be told, or pending where something is
    still due at the end; and one a violation: by whom, and from when to when.
    """
    from sgstore.lang.syntax import joined

    asked, values = statements.asked(files)
    text = joined([*chain.from_iterable(asked.values())])
    if (url := url_of(store)) is not None:
        with whole.collection_at(url, ask) as opened:
            asked_of = opened.check(text, sgsm_compat=statements.sgsm_compat, **values)
            return _reported(asked_of, ask, explain=explain, require=require, junit=junit)
    run = ask.opened(store).check(text, sgsm_compat=statements.sgsm_compat, **values)
    return _reported(run, ask, explain=explain, require=require, junit=junit)


def _reported(
    run: CheckRun | PartedChecks,
    ask: AskOptions,
    *,
    explain: bool,
    require: bool,
    junit: Path | None,
) -> int:
    """Print verdicts, or the explanation of the checks; return the exit code."""
    from sgstore.temporal import columns_returned, verdict_columns, verdict_rows

    if explain:
        typer.echo(run.explain())
        return 0
    say_notes(run.notes)
    say_scope(getattr(run, "scope", {}), ask.chosen)
    tally = {"true": 0, "false": 0}
    kept: list[Verdict] = []
    absent: dict[str, int] = {}

    def counted() -> Iterator[Verdict]:
        for verdict in run:
            if junit is not None or verdict.reason:
                kept.append(verdict)
            if verdict.absent_frames:
                absent[verdict.check] = absent.get(verdict.check, 0) + verdict.absent_frames
            tally[verdict.verdict] = tally.get(verdict.verdict, 0) + 1
            yield verdict

    quantitative, returned = run.quantitative, run.returned
    if ask.for_people:
        shown: dict[str, Any] = {"margin": quantitative, "returned": columns_returned(returned)}
        ask.write(
            verdict_columns(**shown),
            (row for one in counted() for row in verdict_rows(one, **shown)),
        )
        say(", ".join(f"{count} {word}" for word, count in tally.items()))
    else:
        more = ("robustness",) if quantitative else ()
        told = (
            (*_document(one, returned[one.check]), _margin_document(one))[
                : len(_DOCUMENT) + len(more)
            ]
            for one in counted()
        )
        ask.write((*_DOCUMENT, *more), told)
    say_unknown((one.check, one.trace, one.reason) for one in kept)
    for one, frames in absent.items():
        say(f"{one} is true, and an entity is absent in {frames} frame{'s' * (frames != 1)}")
    if junit is not None:
        write_junit(junit, kept)
    return NO_MATCH if require and tally["false"] else 0


_DOCUMENT: Final = (
    "check",
    "trace",
    "verdict",
    "reason",
    "first_violation",
    "violations",
    "witnesses",
    "absent_frames",
)
"""Columns of verdicts for programs."""


def _document(verdict: Verdict, returned: Sequence[str]) -> tuple[Any, ...]:
    """Return a verdict as a row for programs."""
    spans = [_span(one, returned) for one in verdict.violations]
    witnesses = [
        {
            "nodes": dict(one.nodes),
            "names": dict(one.names),
            "holds": one.holds,
            "violations": [_span(span, returned) for span in one.violations],
        }
        for one in verdict.witnesses
    ]
    head = verdict.check, verdict.trace, verdict.verdict, verdict.reason or None
    return (*head, spans[0] if spans else None, spans, witnesses, verdict.absent_frames)


def _margin_document(verdict: Verdict) -> dict[str, Any] | None:
    """Return the robustness of a verdict for programs, with None for infinite numbers."""
    found = verdict.robustness
    if found is None:
        return None
    upper = found.value if found.upper is None else found.upper
    ends = {"value": found.value, "upper": upper}
    return asdict(found) | {k: v if math.isfinite(v) else None for k, v in ends.items()}


def _span(interval: Interval, returned: Sequence[str]) -> dict[str, Any]:
    names = ("start_seq", "end_seq", "start_ns", "end_ns", "start", "end", "frames")
    about = {name: getattr(interval, name) for name in names}
    if returned:
        about["values"] = {name: interval.values.get(name) for name in returned}
    return about


# The verb monitor: checks and patterns over a recording as if it were live, or over a running
# simulator.


SensorFile = Annotated[
    Path | None,
    Option("--sensors", help="With --serve, of a CARLA: cameras for its ego, as record has them."),
]


@verbs.command(rich_help_panel=PANEL)
def monitor(
    trace: Annotated[
        str, Argument(metavar="TRACE", help="A recording; or carla://HOST:PORT, until Ctrl-C.")
    ],
    files: Annotated[
        list[Path] | None,
        Argument(metavar="[FILE…]", help="Files of CHECK and MATCH statements; - is stdin."),
    ] = None,
    ego: Annotated[
        str, Option("--ego", help="Id, role or name of the ego; else as the recording says.")
    ] = "",
    duration: Annotated[
        str | None, Option("--duration", metavar="TIME", help="Simulation time: 60s.")
    ] = None,
    require: Annotated[
        bool, Option("--require", help="End with exit code 4 if a check is violated.")
    ] = False,
    as_json: AsJson = False,
    serve: Annotated[bool, Option("--serve", help="Show a page of it while it goes on.")] = False,
    port: Annotated[int, Option("--port", min=0, max=65535, help="Of the page; 0: any.")] = 0,
    sensors: SensorFile = None,
    *,
    statements: Statements,
    reading: ReadingOptions,
) -> int:
    """Watch a recording as if it were live, or a running CARLA.

    One line for each violation and each match, as soon as it is known; then the verdicts. The answers are
    those of check and find over a store. With --serve a page shows
    the scene, a recording in its own time; it stays until Ctrl-C.
    """
    from sgstore.lang.syntax import joined
    from sgstore.model.config import Config
    from sgstore.temporal import Monitor, opened

    asked, values = statements.asked(files)
    settings = reading.settings() or Config()
    tell = _as_json if as_json else _for_people
    longest = seconds_of(duration, "--duration") if duration else None
    cameras = _sensors(sensors, shown=serve and trace.startswith("carla://"))
    with opened(trace, settings, road_map=reading.road_map, ego=ego, sensors=cameras) as source:
        watch = partial(
            Monitor,
            joined([*chain.from_iterable(asked.values())]),
            source.road_map,
            settings,
            parameters=values,
            trace=source.name,
            called=_called(asked),
            sgsm_compat=statements.sgsm_compat,
        )
        if serve:
            watched, verdicts = _watched_on_a_page(watch, source, tell, longest, port)
        else:
            watched = watch(on_event=tell)
            verdicts = watched.run(source.frames, duration_s=longest)
    losses = [*source.losses, *(loss.reason for loss in watched.generator.losses)]
    for warning in [*source.warnings, *losses]:
        say(warning)
    for verdict in verdicts:
        _tell_verdict(verdict, as_json=as_json)
    if require and any(verdict.violated for verdict in verdicts):
        return NO_MATCH
    return LOSS if losses else 0


def _sensors(file: Path | None, *, shown: bool) -> list[Sensor]:
    """Load the sensors listed in a file; ``shown``: a page displays their data."""
    from sgstore.readers import load_sensors

    if file is not None and not shown:
        told = "--sensors is for the page of a running CARLA: carla://HOST:PORT --serve"
        raise typer.BadParameter(told)
    return [] if file is None else load_sensors(file)


def _watched_on_a_page(
    watch: Callable[..., Monitor],
    source: FrameSource,
    tell: Callable[[MonitorEvent], None],
    longest: float | None,
    port: int,
) -> tuple[Monitor, tuple[Verdict, ...]]:
    """Run a monitor with its page; return it and the verdicts after both have ended."""
    from sgstore.apps.explorer import LiveRun, serve_live
    from sgstore.temporal import paced

    page = LiveRun(source.name, source.road_map, source.cameras)

    def told(event: MonitorEvent) -> None:
        tell(event)
        page.event(event)

    watched = watch(on_event=told, on_step=page.step)
    page.follow(watched)
    with serve_live(page, port=port, on_start=say):
        frames = source.frames if source.live else paced(source.frames)
        verdicts = watched.run(frames, duration_s=longest)
        page.end(verdicts)
        if not was_ended():
            say("the page stays until Ctrl-C")
            with suppress(KeyboardInterrupt):
                threading.Event().wait()
    return watched, verdicts


def _called(asked: Mapping[str, list[str]]) -> list[str]:
    """Return the names of the patterns in events, in query order."""
    from sgstore.lang.sql import each_match
    from sgstore.lang.syntax import parse
    from sgstore.lang.syntax.tree import MatchClause

    every: list[str] = []
    for name, texts in asked.items():
        statements = (one for text in texts for one in each_match(parse(text)))
        count = sum(isinstance(one, MatchClause) for one in statements)
        every += [name] if count == 1 else [f"{name} {number + 1}" for number in range(count)]
    return every


def _for_people(event: MonitorEvent) -> None:
    who = ", ".join(f"{variable} = {name}" for variable, name in event.names.items())
    about = f"from {event.start.t:.3f} s" if event.start != event.told else ""
    if event.kind == "kept again":
        about = f"after {event.end.t - event.start.t:.3f} s"
    if event.at_end:
        about = "at the end"
    from sgstore.temporal import cell_of

    values = ", ".join(f"{name} = {cell_of(value)}" for name, value in event.values.items())
    parts = (f"{event.told.t:9.3f} s", event.kind.ljust(10), event.name, who, about, values)
    _line("  ".join(part for part in parts if part))


def _as_json(event: MonitorEvent) -> None:
    about = asdict(event)
    if not event.values:
        del about["values"]
    _line(json_text({"event": about.pop("kind"), **about}))


def _tell_verdict(verdict: Verdict, *, as_json: bool) -> None:
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
            about["robustness"] = _margin_document(verdict)
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
    """Print a line without buffering."""
    typer.echo(without_controls(text))


# The verb that shows when: swim lanes of matches and violations ---------------------------------


@verbs.command(rich_help_panel=PANEL)
def timeline(
    store: StorePath,
    queries: Annotated[
        list[str] | None, Argument(metavar="[QUERY…]", help="'MATCH …', or 'CHECK …'.")
    ] = None,
    files: Annotated[
        list[Path] | None,
        Option("--file", "-f", help="Read a query, or checks, from a file; repeatable."),
    ] = None,
    names: PatternNames = None,
    parameters: Parameters = None,
    traces: Traces = None,
    output: Annotated[
        Path | None, Option("--output", "-o", help="A picture: FILE.png or FILE.svg.")
    ] = None,
    every: Annotated[
        bool, Option("--all", help="Also traces in which nothing is found or violated.")
    ] = False,
    parts: Annotated[
        str | None,
        Option(
            "--parts",
            metavar="FRAME",
            help="Where each part of one pattern holds for the match in this frame.",
        ),
    ] = None,
    *,
    bounds: QueryLimits,
) -> int:
    """Plot matches and rule violations over time, one lane per entity, for each trace that has some.

    In the terminal, or with -o as a picture; all traces have one scale. With --parts FRAME one lane
    for each part of a pattern.
    """
    from sgstore.draw import LETTERS, NAME, lines_of, parts_timeline, timelines

    asked = _asked(queries or [], files or [], names or [], parameters_of(parameters))
    if parts is None:
        found = timelines(bounds.opened(store), asked, traces or ())
    else:
        if len(asked) > 1 or traces:
            raise typer.BadParameter("--parts FRAME takes one pattern, and the trace of the frame")
        ((text, values),) = asked.values()
        found = [parts_timeline(bounds.opened(store), text, parts, values)]
    for name in {*(traces or ())} - {one.trace for one in found}:
        raise typer.BadParameter(f"--trace: the store has no trace {name!r}")
    say_unknown((lane.name, one.trace, lane.reason) for one in found for lane in one.lanes)
    hits = [one for one in found if one.hit]
    if not every and hits:
        if len(hits) < len(found):
            say(
                f"nothing is found or violated in {len(found) - len(hits)} more traces; --all shows them"
            )
        found = hits
    if output is None:
        letters = max(LETTERS, min(shutil.get_terminal_size().columns - NAME - 26, 3 * LETTERS))
        longest = max((one.seconds for one in found), default=0.0)
        for one in found:
            typer.echo(without_controls("\n".join(lines_of(one, letters, longest))))
        return 0
    from sgstore.draw import draw_timelines

    draw_timelines(found, output)
    typer.echo(output)
    return 0


def _asked(
    queries: list[str], files: list[Path], names: list[str], values: Mapping[str, Any]
) -> dict[str, tuple[str, Mapping[str, Any]]]:
    """Return the texts to plot with their values, by lane name."""
    from sgstore.lang.library import pattern_named

    found: dict[str, tuple[str, Mapping[str, Any]]] = {}
    for number, text in enumerate(queries, start=1):
        found["match" if len(queries) == 1 else f"match {number}"] = text, values
    for file in files:
        found[_free(file.stem, str(file), found)] = text_of(file), values
    for name in names:
        one = pattern_named(name)
        own = {key: value for key, value in values.items() if key in one.parameters}
        found[_free(name, f"pattern {name}", found)] = one.written(**own), {}
    if not found:
        raise typer.BadParameter("give a QUERY, -f FILE or -p NAME")
    return found


def _free(name: str, longer: str, taken: Mapping[str, object]) -> str:
    """Return an unused name for a lane."""
    if name not in taken:
        return name
    numbers = (f"{longer} ({number})" for number in count(2))
    return next(one for one in chain([longer], numbers) if one not in taken)
