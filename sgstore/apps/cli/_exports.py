"""Commands that write pictures and clips: show, export, shrink."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer
from typer import Argument, Option

from sgstore.apps.cli import _completion as completion
from sgstore.apps.cli._options import (
    LOSS,
    AsJson,
    PrintedRows,
    QueryLimits,
    Question,
    StorePath,
    Verbs,
    form_of,
    lines_of,
    parameters_of,
    say_left_out,
    say_unknown,
    seconds_of,
)
from sgstore.apps.cli._output import Format, count_bar, say, write_rows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sgstore.exporters import Export, WrittenClip, WrittenFile
    from sgstore.matches import Matches
    from sgstore.model.world import Clip
    from sgstore.query import Store

PANEL: Final = "Pictures and exports"

verbs = Verbs()


@dataclass(frozen=True)
class ClipOptions:
    """Command line options for the content of exported clips.

    Parameters
    ----------
    before : TIME
        Time before each match: 2s, 500ms.
    after : TIME
        Time after each match.
    labels : NAME=TEXT
        A value for each frame: an expression, or a query that is true where it matches.
    with_graph
        mcap: include the scene graphs, as JSON and as drawings.
    mounts : AXES=X,Y,Z[,YAW]
        mcap, rrd, with graphs: where a sensor sits on the ego, by the frame_id of its messages;
        m, degrees; repeatable.
    rebase_context
        mcap: move static messages, such as the map, to the start of each clip.
    abstraction
        nx, pyg, s3c: abstraction of the graphs.
    graphml
        nx: also write each frame as GraphML, for Gephi.
    channels : TOPIC
        frames: use only this sensor; repeatable.
    clouds
        frames: format of point clouds.
    storage : VERSION
        duckdb: oldest version of DuckDB that can read the file, such as v1.0.0.
    crs : CRS
        geojson: coordinate system of the road maps, such as EPSG:32632; by default their own.
    """

    before: str = "2s"
    after: str = "2s"
    labels: Annotated[list[str] | None, Option("--label")] = None
    with_graph: bool = False
    mounts: Annotated[list[str] | None, Option("--mount")] = None
    rebase_context: bool = False
    abstraction: str = ""
    graphml: bool = False
    channels: Annotated[list[str] | None, Option("--channel")] = None
    clouds: Literal["pcd", "npy", "bin"] = "pcd"
    storage: str = "v1.0.0"
    crs: str = ""

    def order(self, store: Store, clips: Sequence[Clip], **about: Any) -> Export:
        """Return an export of clips from a store, with the settings of the command line."""
        from sgstore.exporters import Export, parse_mounts

        own = {k: v for k, v in vars(self).items() if k not in {"before", "after", "labels"}}
        own |= {"mounts": parse_mounts(self.mounts or ()), "channels": tuple(self.channels or ())}
        return Export(store, tuple(clips), **own, **about)


@verbs.command(rich_help_panel=PANEL)
def export(
    store: StorePath,
    question: Question,
    to: Path = Path("clips"),
    frames: Path | None = None,
    lock: Path | None = None,
    form: Annotated[str, Option("--format", autocompletion=completion.formats)] = "mcap",
    as_json: AsJson = False,
    *,
    clip: ClipOptions,
    bounds: QueryLimits,
) -> int:
    """Cut matches out of their recordings, as clips with the original messages.

    Other formats: tables (parquet, lance), a database of them (duckdb), pictures and clouds
    (frames), scenarios to drive again (xosc), labels (openlabel), recordings for Rerun (rrd), maps
    (geojson), graphs for networkx (nx), PyTorch Geometric (pyg) and S3C (s3c). Without a query all
    frames are exported, but no recordings (mcap, frames). RETURN CLIPS(-3s, +5s) in the query
    wins over --before and --after.

    Parameters
    ----------
    to : DIR
        Folder to write; no file is overwritten.
    frames
        Instead of a query: a file with a FRAME a line; - is stdin.
    lock : FILE
        Instead of a query: each case of a lock, a clip each.
    form
        mcap, parquet, frames, nx, pyg, s3c, xosc, openlabel, rrd, duckdb, lance, geojson, or
        that of a package.
    """
    from sgstore.exporters import (
        check_folder,
        exporter_named,
        labelled,
        parse_labels,
        whole_clips,
        write_export,
    )

    exporter_named(form)  # before the search starts
    check_folder(to)
    texts = parse_labels(clip.labels or [])
    opened = bounds.opened(store)
    values = parameters_of(question.parameters)
    margins = seconds_of(clip.before, "--before"), seconds_of(clip.after, "--after")
    if sum((frames is not None, lock is not None, bool(question))) > 1:
        raise typer.BadParameter("expected one of: a QUERY, --frames, --lock")
    text, held = "", {}
    if question:
        text, held = question.asked()
    if question or frames or lock:
        clips = _clips(opened, (frames, lock), text, held, margins)
    else:
        clips = whole_clips(opened, form)
    if not clips:
        say("no matches to export")
        return 0
    with count_bar(to.name or "export", "clips") as progress:
        told = {"query": text} if text else {"lock": lock.name} if lock else {}
        order = clip.order(opened, clips, provenance=told, progress=progress)
        written = write_export(labelled(order, texts, **values), to, form)
    _write(written, form_of(Format.table, as_json=as_json))
    return LOSS if any(one.losses for one in written) else 0


def _write(written: Sequence[WrittenClip | WrittenFile], form: Format) -> None:
    """Print one row for each written clip or file, and report lost messages."""
    _say_lost(written)
    rows = [one.as_row() for one in written]
    write_rows(tuple(rows[0]), [tuple(row.values()) for row in rows], form)


def _say_lost(written: Sequence[WrittenClip | WrittenFile]) -> None:
    for one in written:
        for loss in one.losses:
            say(f"{one.file.name}: lost: {loss.reason}")
    notes = {note: one for one in written for note in getattr(one, "notes", ())}
    for note, one in notes.items():
        say(f"{one.file.name}: {note}")


def _clips(
    store: Store,
    named: tuple[Path | None, Path | None],
    text: str,
    parameters: Mapping[str, Any],
    margins: tuple[float, float],
) -> list[Clip]:
    """Return the clips to export: around matches, around listed frames, or the cases of a lock file."""
    frames, lock = named
    if lock is not None:
        from sgstore.model.world import Clip
        from sgstore.testsets.locks import cases_of

        return [Clip(*case[:3]) for case in cases_of(lock, store)]
    if frames is not None:
        from sgstore.exporters import around_frames

        return around_frames(store, lines_of(frames), *margins)
    matches = store.find(text, **parameters)
    say_left_out(matches)
    return list(matches.clips(*margins))


@verbs.command(rich_help_panel=PANEL)
def shrink(
    store: StorePath,
    question: Question,
    clip: str | None = None,
    to: Path | None = None,
    *,
    out: PrintedRows,
    bounds: QueryLimits,
) -> int:
    """Cut each trace, or a clip, to the fewest frames that still match a query or violate a check.

    One row for each trace, and for each check. What is cut out is asked as if it were the
    whole recording.

    Parameters
    ----------
    clip : CLIP
        A clip to cut: TRACE@12s..18s or TRACE#120..180; by default every whole trace.
    to : DIR
        Folder for the clips, with the original messages; existing files are not overwritten.
    """
    from sgstore.exporters import check_folder
    from sgstore.testsets.diff import has_checks

    if to is not None:
        check_folder(to)  # before the search starts
    opened = bounds.opened(store)
    text, values = question.asked()
    found = list(opened.shrink(text, clip, **values))
    checks = has_checks(text)
    if checks:
        unknown = opened.check(text, **values).unknown()
        say_unknown((one.check, one.trace, one.reason) for one in unknown)
    else:
        say_left_out(opened.find(text, **values))
    if not found:
        say(f"no {'violations' if checks else 'matches'} to cut")
    written: dict[Clip, WrittenClip | WrittenFile] = {}
    if to is not None and found:
        written = _cut_out(opened, list(dict.fromkeys(one.clip for one in found)), text, to)
    head = [*(["file"] if written else []), *(["check"] if checks else [])]
    rows = [
        (
            *([str(written[one.clip].file)] if written else []),
            *([one.check] if checks else []),
            *(one.trace, f"{one.trace}#{one.start_seq}", f"{one.trace}#{one.end_seq}"),
            *(round(one.start, 3), round(one.end, 3), one.frames, one.of),
        )
        for one in found
    ]
    out.write((*head, "trace", "from", "to", "start", "end", "frames", "of"), rows)
    lost = any(one.losses for one in written.values())
    return LOSS if lost else 0


def _cut_out(
    store: Store, clips: list[Clip], text: str, to: Path
) -> dict[Clip, WrittenClip | WrittenFile]:
    """Write clips from their recordings, report lost messages, and return the written files by clip."""
    from sgstore.exporters import Export, write_export

    with count_bar(to.name or "shrink", "clips") as progress:
        order = Export(store, tuple(clips), provenance={"query": text}, progress=progress)
        written = write_export(order, to)
    _say_lost(written)
    return dict(zip(clips, written, strict=True))


@dataclass(frozen=True)
class DrawOptions:
    """Command line options for drawing a frame or an animation.

    Parameters
    ----------
    relations
        Edges to draw.
    camera
        Channel of a picture to put beside it; 'none' for no picture.
    radius
        Half the side of the window, in metres.
    north_up
        Draw north up, not the ego's heading.
    diagram
        Also draw the graph as nodes and edges.
    names
        Labels of entities: number, id or type of the simulator.
    fps
        Pictures per second of an animation.
    """

    relations: Literal["ego", "all", "none"] = "ego"
    camera: str | None = None
    radius: float | None = None
    north_up: bool = False
    diagram: Annotated[bool, Option("--graph")] = False
    names: Literal["number", "ident", "type"] = "number"
    fps: Annotated[float, Option(min=0.1, max=50.0)] = 10.0

    def options(self, matches: Matches | None) -> dict[str, Any]:
        """Return the drawing options as keyword arguments, without those of animations."""
        options = asdict(self)
        del options["fps"]
        return {"matches": matches, **options}


@verbs.command(rich_help_panel=PANEL)
def show(
    store: StorePath,
    frame: Annotated[str, Argument(autocompletion=completion.frames)],
    question: Question,
    output: Annotated[
        Path | None, Option("--output", "-o", show_default="frame.png, clip.gif")
    ] = None,
    *,
    drawn: DrawOptions,
    bounds: QueryLimits,
) -> int:
    """Draw a frame from above, or a clip as an animation; a QUERY marks its matches.

    Parameters
    ----------
    frame : FRAME
        A frame_id, TRACE#SEQ, or TRACE@12.3s; a clip: TRACE@12s..18s.
    output
        The picture: .png or .svg; of a clip: .gif, .mp4 or .webm.
    """
    from sgstore.draw import draw_clip, draw_stored
    from sgstore.model.frame_ids import range_of

    opened = bounds.opened(store)
    text, values = question.asked() if question else ("", {})
    clip = range_of(frame)
    output = output or Path("clip.gif" if clip else "frame.png")
    options = drawn.options(opened.find(text, **values) if text else None)
    if clip is None:
        marked = int(draw_stored(opened, frame, output, **options))
    else:
        with count_bar(output.name, "pictures") as bar:
            marked = draw_clip(opened, clip, output, fps=drawn.fps, on_frame=bar, **options)
    if text and not marked:
        say(f"the query does not match in {frame}; the picture has no marks")
    typer.echo(output)
    return 0
