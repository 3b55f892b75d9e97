"""Commands for stores (verify, remove, rebuild, derive, payload), road maps, settings and the demo."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from typer import Argument, Option

from sgstore.apps.cli import _completion as completion
from sgstore.apps.cli._options import (
    ERROR,
    LOSS,
    FrameName,
    GraphOptions,
    Jobs,
    PrintedRows,
    StorePath,
    To,
    Traces,
    Verbs,
    jobs_of,
)
from sgstore.apps.cli._output import Format, count_bar, say, write_rows
from sgstore.base.display import excerpts, number_of
from sgstore.base.output_files import write_bytes
from sgstore.errors import ExportError, StoreError

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap
    from sgstore.pipeline.derive import Derivation
    from sgstore.store import StoreFile

PANEL: Final = "Stores and maps"

verbs = Verbs()


@verbs.command(rich_help_panel=PANEL)
def verify(
    store: StorePath,
    payloads: bool = False,
    *,
    out: PrintedRows,
) -> int:
    """Verify that a store has not changed since it was published; list every fault.

    Parameters
    ----------
    payloads
        Also hash the recordings again.
    """
    from sgstore.store import verify_file

    with count_bar("verifying", "rows") as progress:
        found = verify_file(store, recordings=payloads, progress=progress)
    columns = ("trace", "check", "detail", *([] if out.for_people else ["remedy"]))
    rows = [tuple(getattr(fault, name) for name in columns) for fault in found.faults]
    out.write(columns, rows)
    hashed = f", {number_of(found.recordings, 'recording')}" if payloads else ""
    wrong = number_of(len(rows), "fault") if rows else "no fault"
    if found.others:
        say(f"{store}: tables of other programs, not checked: {excerpts(found.others)}")
    held = f"{number_of(found.traces, 'trace')}, {number_of(found.rows, 'row')}"
    remedies = sorted({fault.remedy for fault in found.faults})
    say(f"{store}: {held}{hashed}: {wrong}{'; remedy: ' if rows else ''}{', '.join(remedies)}")
    return ERROR if rows else 0


@verbs.command(rich_help_panel=PANEL)
def remove(
    store: StorePath,
    traces: Annotated[list[str] | None, Argument(autocompletion=completion.traces)] = None,
    compact: bool = False,
    *,
    out: PrintedRows,
) -> int:
    """Remove traces from a store, all or none; the recordings stay.

    Parameters
    ----------
    traces : TRACE…
        Names, ids, or beginnings of names.
    compact
        Rewrite the file to free its space; also without a TRACE.
    """
    from sgstore.store import StoreFile

    if not traces and not compact:
        raise typer.BadParameter("add the names of traces, or --compact")
    file = StoreFile(store)
    if compact:
        file.refuse_others()
    gone = file.remove(*traces) if traces else ()
    if compact:
        try:
            file.compact()
        except StoreError as error:
            if not gone:
                raise
            named = excerpts([trace.name for trace in gone])
            raise StoreError(f"{error}; removed: {named}; the file is not smaller") from error
    rows = [(trace.name, trace.frames, str(trace.path)) for trace in gone]
    out.write(("trace", "frames", "file"), rows)
    return 0


@verbs.command(rich_help_panel=PANEL)
def rebuild(
    store: StorePath,
    look_in: list[Path] | None = None,
    leave_out: Annotated[list[str] | None, Option(autocompletion=completion.traces)] = None,
    jobs: Jobs = 1,
    *,
    out: PrintedRows,
) -> None:
    """Rebuild a store from its recordings; the old one stays until the new one is complete.

    Parameters
    ----------
    leave_out : TRACE
        Trace to leave out, if it cannot be rebuilt; repeatable.
    """
    from sgstore.apps.cli._output import ingest_bar
    from sgstore.pipeline.rebuild import rebuild as make_anew

    with ingest_bar() as on_progress:
        made = make_anew(
            store,
            look_in=look_in or (),
            leave_out=leave_out or (),
            jobs=jobs_of(jobs),
            on_progress=on_progress,
        )
    rows = [(one.trace, one.status, one.frames, str(one.path)) for one in made]
    out.write(("trace", "status", "frames", "file"), rows)


@verbs.command(rich_help_panel=PANEL)
def derive(
    store: StorePath,
    name: str | None = None,
    abstraction: str | None = None,
    trace: Traces = None,
    force: bool = False,
    remove: str | None = None,
    *,
    graphs: GraphOptions,
    out: PrintedRows,
) -> int:
    """Derive another set of relations from the stored states; without --name, list the sets.

    Parameters
    ----------
    name : NAME
        Name of the set: USING ABSTRACTION NAME.
    abstraction : NAME
        Abstraction whose graphs to store, such as roadscene2vec.
    force
        Replace a set of this name with other settings.
    remove : NAME
        Delete a set instead.
    """
    from sgstore.model.config import Config
    from sgstore.pipeline.derive import derive as derive_set
    from sgstore.pipeline.derive import keep_abstraction
    from sgstore.store import StoreFile

    given = graphs.config or graphs.preset
    if abstraction is not None:
        if name is not None or remove is not None or given or force:
            raise typer.BadParameter(
                "--abstraction NAME can be combined only with --trace: the set has the name of the"
                " abstraction; settings need --name NAME without --abstraction"
            )
        kept = keep_abstraction(store, abstraction, trace or ())
        return _write_derived(kept, out)
    if name is None or remove is not None:
        if name is not None or given or (remove is None and (trace or force)):
            raise typer.BadParameter("use --name NAME with settings, --remove NAME, or no option")
        deriving = StoreFile(store).deriving
        if remove is not None:
            say(f"removed {remove} of {', '.join(deriving.remove(remove))}")
            return 0
        rows = ((one.name, one.trace, len(one.answers)) for one in deriving.sets())
        out.write(("name", "trace", "relations"), rows)
        return 0
    settings = graphs.settings() or Config()
    done = derive_set(store, settings, name, trace or (), replace_old=force)
    return _write_derived(done, out)


def _write_derived(done: list[Derivation], out: PrintedRows) -> int:
    rows = ((one.trace, one.status, one.frames, one.edges) for one in done)
    out.write(("trace", "status", "frames", "edges"), rows)
    for one in done:
        for loss in one.losses:
            say(f"{one.trace}: {loss}")
    return LOSS if any(one.losses for one in done) else 0


@verbs.command("map", rich_help_panel=PANEL)
def map_(
    file: Path,
    to: Annotated[Path | None, Option("--to", "-o")] = None,
    *,
    out: PrintedRows,
) -> int:
    """Summarize a road map: lanes by type, junctions, signals, and problems.

    Parameters
    ----------
    file : FILE
        OpenDRIVE (.xodr), Lanelet2 (.osm), SUMO (.net.xml), or a recording that carries roads.
    to
        Picture to draw, north up: .png or .svg.
    """
    from sgstore.maps.roads import summary

    road_map = _road_map(file)
    if to is not None:
        from sgstore.draw import draw_map

        draw_map(road_map, to)
        say(f"drawn: {to}")
    rows = [
        (one.part, one.kind, one.count, None if one.length is None else round(one.length, 1))
        for one in summary(road_map)
    ]
    if out.for_people:  # a table has no room for sentences
        for _, text, _, _ in (row for row in rows if row[0] == "warning"):
            say(text)
        rows = [row for row in rows if row[0] != "warning"]
    columns = ("part", "kind", "count", "length_m")
    types = ("VARCHAR", "VARCHAR", "BIGINT", "DOUBLE")
    out.write(columns, rows, types)
    return 0


def _road_map(file: Path) -> RoadMap:
    """Return the road map of a map file or a recording."""
    from sgstore.errors import MapError
    from sgstore.maps.map_files import read_map_file
    from sgstore.maps.opendrive import read_map
    from sgstore.readers import open_trace

    try:
        with file.open("rb") as stream:
            start = stream.read(4096)
    except OSError as error:
        raise MapError(f"{file}: {error.strerror or error}") from error
    # Texts begin with a bracket, or a byte order mark; recordings except scenarios do not.
    if b"<commonRoad" not in start and (
        start.lstrip()[:1] in {b"<", b"{"} or start[:2] in {b"\xff\xfe", b"\xfe\xff", b"\xef\xbb"}
    ):
        return read_map_file(file)
    with open_trace(file) as trace:
        if not trace.info.map_text:
            raise MapError(f"{file}: the recording carries neither a road map nor lanes")
        return read_map(trace.info.map_text, trace.info.map_name)


@verbs.command(rich_help_panel=PANEL)
def payload(
    store: StorePath,
    frame: FrameName,
    channel: Annotated[str | None, Argument(autocompletion=completion.channels)] = None,
    to: To = None,
    message: bool = False,
    *,
    out: PrintedRows,
) -> int:
    """Fetch the sensor data of a frame: a picture, a video up to the frame, or the message.

    Parameters
    ----------
    channel : CHANNEL
        Topic; by default list the topics.
    message
        Write the message as recorded, not the picture in it.
    """
    from sgstore.store import StoreFile

    file = StoreFile(store)
    if channel is None:
        _list_channels(file, frame, out)
        return 0
    if to is None and sys.stdout.isatty():
        raise ExportError(
            "a payload cannot be printed on a terminal; add -o FILE, or redirect stdout"
        )
    if message:
        data, what = file.payload(frame, channel), "message"
    else:
        carried = file.carried(frame, channel)
        data, what = carried.data, carried.form
        if carried.messages > 1:
            what += f", {carried.messages} messages from the key frame on"
    if to is None:
        sys.stdout.buffer.write(data)
    else:
        write_bytes(to, data)
    say(f"{to or 'stdout'}: {number_of(len(data), 'byte')} ({what})")
    return 0


def _list_channels(file: StoreFile, frame: str, out: PrintedRows) -> None:
    with file.snapshot():
        wanted = file.frame(frame)
        found = file.rows(
            "SELECT channel, schema, offset_s, log_time_ns, length FROM payloads"
            " WHERE frame_id = ? ORDER BY channel",
            [wanted.frame_id],
        )
    out.write(found.columns, found)


@verbs.command(rich_help_panel=PANEL)
def config(
    file: Annotated[Path | None, Argument()] = None,
    preset: Annotated[str | None, Option(autocompletion=completion.presets)] = None,
    every: Annotated[bool, Option("--list")] = False,
    page: bool = False,
    *,
    out: PrintedRows,
) -> None:
    """Print all settings as commented TOML, as a template for ingest.

    Parameters
    ----------
    file : FILE
        TOML file to check and print in full.
    preset : NAME
        Print the settings of this preset.
    every
        List the presets.
    page
        Print the page docs/parameters.md instead.
    """
    from sgstore.model.config import PRESETS, Config, as_markdown, as_toml, load
    from sgstore.model.config import preset as preset_named

    if sum((file is not None, preset is not None, every, page)) > 1:
        raise typer.BadParameter("expected only one of FILE, --preset, --list and --page")
    if every:
        rows = ((name, one.summary) for name, one in PRESETS.items())
        out.write(("preset", "what it is"), rows)
        return
    if page:
        typer.echo(as_markdown(PRESETS), nl=False)
        return
    settings = preset_named(preset) if preset else load(file) if file else Config()
    typer.echo(as_toml(settings), nl=False)


@verbs.command(rich_help_panel=PANEL)
def docs(page: Annotated[str, Argument()] = "") -> int:
    """Print a page of the documentation; without a PAGE, list the pages.

    Parameters
    ----------
    page : PAGE
        Name of a page, such as language, exports or glossary.
    """
    from sgstore.model.vocabulary import suggestion

    pages = _pages()
    if not pages:
        raise StoreError("the pages of the documentation are not installed")
    name = Path(page).stem.lower().replace("_", "-")
    known = {one.lower().replace("_", "-"): one for one in pages}
    if not page:
        rows = [(one, _title(pages[one])) for one in sorted(pages)]
        write_rows(("page", "title"), rows, Format.table)
    elif name not in known:
        like = suggestion(name, known)
        hint = f"did you mean {known[like]}?" if like else "'sgstore docs' lists the pages"
        raise typer.BadParameter(f"no page {page!r}; {hint}")
    else:
        typer.echo(pages[known[name]].read_text(encoding="utf-8"), nl=False)
    return 0


def _pages() -> dict[str, Path]:
    """Return the pages of the documentation by name, from a source checkout or from the installed package."""
    from importlib.metadata import files

    folder = Path(__file__).parents[3] / "docs"
    found = [*folder.glob("*.md")] if (folder / "conf.py").is_file() else []
    if not found:
        held = (one for one in files("sgstore") or () if "share/doc/sgstore/" in one.as_posix())
        found = [Path(str(one.locate())) for one in held if one.suffix == ".md"]
    return {one.stem: one for one in found}


def _title(page: Path) -> str:
    """Return the first heading of a documentation page."""
    with page.open(encoding="utf-8") as lines:
        return next((line[2:].strip() for line in lines if line.startswith("# ")), "")


@verbs.command(rich_help_panel=PANEL)
def demo(
    folder: Annotated[Path, Argument()] = Path("sgstore-demo"),
    recording: Path | None = None,
) -> int:
    """Run the main commands on the bundled recording: ingest, find, show, export.

    Parameters
    ----------
    folder : DIR
        Folder for its store, pictures and clips.
    recording
        The sample recording; by default the package's.
    """
    from sgstore.apps.demo import run_demo

    run_demo(folder, typer.echo, recording)
    return 0
