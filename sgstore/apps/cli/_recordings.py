"""Commands for recordings: ingest, info, doctor, record, import."""

from __future__ import annotations

import json
import shlex
import sys
from collections import Counter
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer
from typer import Argument, Option

from sgstore.apps.cli import _completion as completion
from sgstore.apps.cli._collection_options import note_collection, shown_bundle, url_of
from sgstore.apps.cli._options import (
    ERROR,
    LOSS,
    AskedPath,
    Jobs,
    PrintedRows,
    ReadingOptions,
    StorePath,
    Verbs,
    jobs_of,
    lines_of,
    say_scope,
    seconds_of,
)
from sgstore.apps.cli._output import Format, complain, quiet, say, write_document, write_report
from sgstore.base.display import excerpts, number_of
from sgstore.errors import StoreError, place_named

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Mapping

    from sgstore.pipeline.recording_ingest import TraceOutcome
    from sgstore.store import StoreFile

PANEL: Final = "Recordings"

verbs = Verbs()


Recordings = Annotated[
    list[str],
    Argument(
        metavar="TRACE…",
        help="Recordings, folders of them, patterns ('drives/**/day?.mcap'); - reads a list from stdin.",
    ),
]


@verbs.command(rich_help_panel=PANEL)
def ingest(
    store: StorePath,
    traces: Recordings,
    reading: ReadingOptions,
    ego: list[str] | None = None,
    jobs: Jobs = 1,
    since: str | None = None,
    until: str | None = None,
    rate: Annotated[float | None, Option(min=0)] = None,
    topics: Annotated[list[str] | None, Option(metavar="TOPIC,…")] = None,
    force: bool = False,
    dry_run: bool = False,
    shard: str | None = None,
    *,
    out: PrintedRows,
) -> int:
    """Read recordings into a store; recordings that it already contains are skipped.

    Exit codes: 0 all were read; 1 a recording failed, the others are in the store; 2 wrong usage;
    3 parts of a recording were lost.

    Parameters
    ----------
    ego
        Id, role or name of the ego; repeatable, each makes a trace; all: every vehicle.
    since
        Start at this time of a recording: 10s.
    until
        Stop at this time: 1min.
    rate
        Frames per second to keep; 0: all.
    topics
        Channels to store as columns, for topic('/imu') in queries: /planner,/imu.
    dry_run
        Report the planned work without doing it.
    shard : I/N
        Into a collection: land share I of N of the recordings; then 'collection commit'.
    """
    from sgstore.apps.cli._output import ingest_bar
    from sgstore.ingest import ingest as ingest_traces
    from sgstore.ingest import recordings

    options: dict[str, Any] = {
        "road_map": reading.road_map,
        "config": reading.settings(),
        "egos": ego or (),
        "jobs": jobs_of(jobs),
        "since": None if since is None else seconds_of(since, "--since"),
        "until": None if until is None else seconds_of(until, "--until"),
        "rate": rate,
        "topics": [name for one in topics or () for name in one.split(",") if name],
    }
    if shard is not None or url_of(store) is not None:
        outcomes = _land(store, recordings(_names(traces)), shard, options, alone=force or dry_run)
    else:
        with ingest_bar() as on_progress:
            outcomes = ingest_traces(
                store,
                recordings(_names(traces)),
                force=force,
                dry_run=dry_run,
                on_progress=on_progress,
                **options,
            )
    return _report_outcomes(outcomes, out, store)


def _report_outcomes(outcomes: list[TraceOutcome], out: PrintedRows, store: Path) -> int:
    """Print the result of an ingest for each recording, and return the exit code."""
    first = {outcome.path: outcome for outcome in reversed(outcomes)}
    for outcome in outcomes:
        _say_warnings(outcome)
        if outcome is first[outcome.path] and (taken := outcome.taken_name):
            reason = f"because the store has another trace {taken!r}"
            if outcome.other:
                reason = f"beside {taken!r}, the same recording with the ego {outcome.other!r}"
                remedy = shlex.join(["sgstore", "remove", place_named(store), taken])
                reason += f"; to keep only one of them: {remedy}"
            say(f"{place_named(outcome.path)}: stored as {outcome.name!r}, {reason}")
    code = ERROR if any(outcome.error for outcome in outcomes) else 0
    if out.for_people:  # an error is no row
        outcomes = [outcome for outcome in outcomes if not outcome.error]
    reports: list[dict[str, Any]] = [
        {"scope": outcome.scope} if outcome.scope else {} for outcome in outcomes
    ]
    _say_scope(reports, out)
    columns = ("trace", "status", "ego", "frames", "entities", "seconds", "losses", "file")
    rows = map(_outcome_row, outcomes)
    totals = {"frames": "frames", "losses": "losses"}
    for report, outcome in zip(reports, outcomes, strict=True):
        report["warnings"] = [*outcome.warnings]
        report["error"] = str(outcome.error) if outcome.error else None
        report["losses_at"] = [asdict(loss) for loss in outcome.losses]
    more = ("scope", "warnings", "error", "losses_at")
    out.write(*_with_more(columns, rows, reports, more, out), totals=totals)
    return code or (LOSS if any(outcome.losses for outcome in outcomes) else 0)


def _say_scope(reports: Iterable[Mapping[str, Any]], out: PrintedRows) -> None:
    """Print the data that the settings of traces excluded. JSON rows already contain them as ``scope``."""
    from sgstore.model.scope import scope_of

    if out.chosen not in {Format.json, Format.ndjson}:
        say_scope(scope_of(reports, world=None), out.chosen)


def _with_more(
    columns: tuple[str, ...],
    rows: Iterable[tuple[Any, ...]],
    reports: Iterable[Mapping[str, Any]],
    names: tuple[str, ...],
    out: PrintedRows,
) -> tuple[tuple[str, ...], Iterable[tuple[Any, ...]]]:
    """Return result rows. For JSON, add columns with some values of each recording's report."""
    if out.chosen not in {Format.json, Format.ndjson}:
        return columns, rows
    parts = (tuple(map(one.get, names)) for one in reports)
    return (*columns, *names), ((*row, *its) for row, its in zip(rows, parts, strict=True))


def _land(
    store: Path, paths: list[Path], shard: str | None, options: dict[str, Any], *, alone: bool
) -> list[TraceOutcome]:
    """Ingest recordings, or one share of them, into a collection. Return the result of each recording.

    ``alone`` is true if an option for single stores was given, which is an error.
    """
    if alone:
        raise typer.BadParameter("--force and --dry-run are not supported for a collection")
    from sgstore.collection import land

    number, stroke, of = (shard or "1/1").partition("/")
    if not (stroke and number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
        raise typer.BadParameter(f"--shard {shard}: expected I/N, such as 3/16; I is 1 to N")
    outcomes = land(url_of(store) or store, paths, shard=(int(number), int(of)), **options)
    if shard is not None:
        names = excerpts([one.name or one.path.name for one in outcomes]) or "none"
        say(f"share {shard} of {number_of(len(paths), 'recording')}: {names}")
    return outcomes


def _names(traces: list[str]) -> list[str]:
    return [name for one in traces for name in (lines_of(Path("-")) if one == "-" else [one])]


def _say_warnings(outcome: TraceOutcome) -> None:
    if outcome.error:
        complain(str(outcome.error))
    for name, number in outcome.unknown_types.items():
        many = f"{number} {'entity' if number == 1 else 'entities'} of type {name!r}"
        say(f"{place_named(outcome.path)}: {many}, {_no_kind(name)}")
    for warning in outcome.warnings:
        say(f"{place_named(outcome.path)}: {warning}")
    for loss in outcome.losses:
        say(f"{place_named(outcome.path)}: lost: {loss.reason}")


def _no_kind(type_name: str) -> str:
    """Return advice for an unknown type name in a recording: how to map it to a kind of entity."""
    name = json.dumps(type_name, ensure_ascii=False)
    return (
        "of which nothing says what kind it is; to say it, write into a file for --config:"
        f' [types] {name} = {{ kind = "…" }}'
    )


def _outcome_row(outcome: TraceOutcome) -> tuple[Any, ...]:
    return (
        outcome.name,
        outcome.status,
        outcome.ego,
        outcome.frames,
        sum(outcome.entities.values()),
        round(outcome.seconds, 2),
        len(outcome.losses),
        place_named(outcome.path),
    )


@verbs.command(rich_help_panel=PANEL)
def info(
    store: AskedPath,
    traces: Annotated[list[str] | None, Option("--trace", autocompletion=completion.traces)] = None,
    *,
    out: PrintedRows,
) -> int:
    """List the traces of a store or a collection, or describe a trace in full.

    Parameters
    ----------
    traces
        Show details of a trace, by name, id, or start of one; repeatable.
    """
    if (url := url_of(store)) is not None:
        _list_collection(url, traces or [], out)
        return 0
    from sgstore.store import StoreFile

    file = StoreFile(store)
    if traces:
        _describe_traces(file, traces, out)
        return 0
    columns = ("trace", "frames", "seconds", "ego", "map", "flavour", "losses", "trace_id", "file")
    stored = file.traces()
    reports = [one.report for one in stored]
    _say_scope(reports, out)
    for one in stored:
        counts = {"clock jump": "clock_jumps", "gap": "gaps"}
        steps = [
            number_of(count, what)
            for what, key in counts.items()
            if (count := one.report.get(key, 0))
        ]
        if steps:
            say(f"{one.name}: {', '.join(steps)}; info --trace lists them")
    topics = Counter(topic for its in file.stored_topics().values() for topic in its)
    if topics:
        each = ", ".join(f"{name} in {number}" for name, number in sorted(topics.items()))
        say(f"stored topics: {each} of {number_of(len(stored), 'trace')}")
    rows = (
        (
            *(one.name, one.frames, round(one.seconds, 3)),
            *(one.ego, one.map, one.flavour, len(one.report["losses"])),
            *(one.trace_id, str(one.path)),
        )
        for one in stored
    )
    totals = {"frames": "frames", "seconds": "s", "losses": "losses"}
    out.write(*_with_more(columns, rows, reports, ("scope",), out), totals=totals)
    return 0


_TIMES: Final = ("start_ns", "end_ns", "frames", "period_ns")


def _list_collection(url: str, names: list[str], out: PrintedRows) -> None:
    """Print the catalogue entries of the named traces of a collection, or of all traces."""
    from sgstore.collection import Collection
    from sgstore.model.world import covered_s

    whole = Collection(url)
    note_collection(whole)
    found = whole.traces()
    known = {row["name"] for row in found}
    for name in names:
        if name not in known:
            raise StoreError(f"{url}: no trace {name!r}")
    columns = ("trace", "frames", "seconds", "ego", "map", "trace_id", "bundle", "file")
    rows = (
        (
            *(row["name"], row["frames"], round(covered_s(*(row[name] for name in _TIMES)), 3)),
            *(
                row["ego"],
                row["map"],
                row["trace_id"],
                shown_bundle(row["bundle"], out),
                row["uri"],
            ),
        )
        for row in found
        if not names or row["name"] in names
    )
    out.write(columns, rows, totals={"frames": "frames", "seconds": "s"})


def _describe_traces(file: StoreFile, names: list[str], out: PrintedRows) -> None:
    """Print all data about traces: one document for a single trace, a row per trace for several."""
    with file.snapshot():
        found = [file.trace(name) for name in names]
        channels = [[asdict(one) for one in file.channels(trace.trace_id)] for trace in found]
        topics = file.stored_topics()
    documents = [
        one.as_dict() | {"channels": its, "topics": topics.get(one.trace_id, {})}
        for one, its in zip(found, channels, strict=True)
    ]
    if out.for_people:
        for number, (one, about) in enumerate(zip(found, documents, strict=True)):
            sys.stdout.write("\n" if number else "")
            write_report(about | one.report | {"frames": one.frames})
    elif len(documents) == 1:
        write_document(documents[0], out.chosen)
    else:
        out.write(tuple(documents[0]), [tuple(one.values()) for one in documents])


@verbs.command(rich_help_panel=PANEL)
def doctor(traces: Recordings, reading: ReadingOptions, out: PrintedRows) -> int:
    """Check recordings: report readable content and damage. Needs no store."""
    from sgstore.ingest import recordings
    from sgstore.pipeline.doctor import Examination, examine

    settings = reading.settings()
    examinations = (
        examine(path, config=settings, road_map=reading.road_map)
        for path in recordings(_names(traces))
    )
    codes: set[int] = set()

    def examined() -> Iterator[dict[str, Any]]:
        for examination in examinations:
            codes.add(ERROR if examination.error else LOSS if examination.losses else 0)
            yield examination.as_dict()

    if out.for_people:
        for number, values in enumerate(examined()):
            sys.stdout.write("\n" if number else "")
            write_report(values)
    else:
        columns = [column.name for column in fields(Examination)]
        out.write(columns, (tuple(values.values()) for values in examined()))
    return ERROR if ERROR in codes else max(codes, default=0)


PORT: Final = 2000
"""Default port of a CARLA server."""


@verbs.command(rich_help_panel=PANEL)
def record(
    output: Path,
    host: str = "localhost",
    port: int = PORT,
    ego: str = "",
    sensors: Path | None = None,
    duration: str | None = None,
    step: str | None = None,
    scenery: Annotated[bool, Option("--scenery/--no-scenery")] = True,
) -> int:
    """Record a running CARLA into an MCAP file: frames, road map and sensors of the ego.

    Parameters
    ----------
    output : FILE
        Recording to write: a new FILE.mcap.
    host
        Host of the CARLA server.
    port
        Its port.
    ego
        Id or role name of the ego; by default hero, ego_vehicle.
    sensors
        A TOML file with a table [[sensor]] for each sensor.
    duration : TIME
        Simulation time: 60s; by default until Ctrl-C.
    step : TIME
        Drive the world in steps: 50ms; by default follow it.
    scenery
        Include buildings, poles and other objects of the level.
    """
    from sgstore.apps.record import record as record_world
    from sgstore.readers import connect, load_sensors

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
    say(
        f"{number_of(written.frames, 'frame')}, {seconds:.2f} s; sgstore ingest STORE {written.path}"
    )
    typer.echo(written.path)
    return LOSS if done.dropped else 0


@contextmanager
def _counter() -> Generator[Callable[[int, float], None] | None]:
    """Yield a function that shows a frame count on stderr; ``None`` if stderr is not a terminal."""
    if quiet() or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console

    with Console(stderr=True).status("waiting for the first frame") as line:
        yield lambda frames, seconds: line.update(
            f"{number_of(frames, 'frame')}, {seconds:.1f} s of simulation; Ctrl-C ends the recording"
        )


@dataclass(frozen=True)
class ImportOptions:
    """Command line options that map labels of imported graphs to kinds and relations.

    Parameters
    ----------
    kind : LABEL=KIND
        Kind of a label; repeatable.
    relation : NAME=RELATION
        Relation for a name; repeatable.
    unknown_as : KIND
        Import unknown labels as this kind ('other': unknown kind) and skip unknown relations;
        'own': use labels as kinds and names as relations.
    new_kind : KIND
        Additional kind for --kind; repeatable.
    answers : RELATION
        Relation that the graphs can contain, even if it never occurs; repeatable.
    period : TIME
        Time between frames, if the file has no times.
    """

    kind: list[str] | None = None
    relation: list[str] | None = None
    unknown_as: str = ""
    new_kind: list[str] | None = None
    answers: list[str] | None = None
    period: str = "1s"


@verbs.command("import", rich_help_panel=PANEL)
def import_(
    store: StorePath,
    files: list[Path],
    form_of_graphs: Annotated[Literal["s3c", "nodelink", "csv", "openlabel"], Option("--as")],
    force: bool = False,
    *,
    meaning: ImportOptions,
    out: PrintedRows,
) -> int:
    """Import graphs of other tools into a store: each graph becomes a frame.

    Parameters
    ----------
    files : FILE…
        Files of graphs, each a trace; .xz, .gz and .bz2 too.
    form_of_graphs
        s3c: its CSV; csv: graph, src, relation, dst; nodelink: JSON of networkx; openlabel:
        ASAM OpenLABEL 1.0.
    """
    from sgstore.model.vocabulary import relation_named
    from sgstore.pipeline.importing import Words, import_graphs

    pairs = _pairs(meaning.kind, "--kind"), _pairs(meaning.relation, "--relation")
    words = Words(*pairs, meaning.unknown_as, meaning.new_kind or ())
    answers = {name: relation_named(name) for name in meaning.answers or ()}
    for name, known in answers.items():
        if known is None:
            raise typer.BadParameter(f"--answers {name}: unknown relation")
    seconds = seconds_of(meaning.period, "--period")
    if seconds <= 0:
        raise typer.BadParameter("--period: expected more than 0s")
    done = import_graphs(
        store,
        files,
        form_of_graphs,
        words=words,
        relations=[name for name in answers.values() if name is not None],
        period_s=seconds,
        force=force,
    )
    for one in done:
        if one.error is not None:
            complain(str(one.error))
        for what, often in sorted(one.lost.items()):
            say(f"{one.path.name}: {what}: {number_of(often, 'time')}, cannot be kept")
    columns = ("file", "status", "trace", "frames", "entities", "edges")
    rows = ((str(o.path), o.status, o.name, o.frames, o.entities, o.edges) for o in done)
    out.write(columns, rows)
    if any(one.error is not None for one in done):
        return ERROR
    return LOSS if any(one.lost for one in done) else 0


def _pairs(texts: list[str] | None, option: str) -> dict[str, str]:
    pairs: dict[str, str] = {}
    for text in texts or []:
        name, equals, value = text.rpartition("=")
        if not (name and equals and value):
            raise typer.BadParameter(f"{option} {text!r}: expected NAME=VALUE")
        if name in pairs:
            raise typer.BadParameter(f"{option} {text!r}: {name} means {pairs[name]} already")
        pairs[name] = value
    return pairs
