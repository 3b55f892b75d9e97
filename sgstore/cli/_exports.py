"""Verbs that draw and write: show, export."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from sgstore.cli._options import (
    LOSS,
    AsJson,
    Parameters,
    PatternName,
    QueryFile,
    QueryLimits,
    QueryText,
    StorePath,
    app,
    asked_of,
    form_of,
    lines_of,
    parameters_of,
    say_left_out,
    seconds_of,
)
from sgstore.cli._output import Format, count_bar, say, write_rows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sgstore.exporters import WrittenClip, WrittenFile
    from sgstore.query import Store
    from sgstore.world import Clip

PANEL: Final = "Pictures and exports"


BEFORE_AFTER: Final = "2s"


class Clouds(StrEnum):
    """Format of point clouds."""

    pcd = "pcd"
    npy = "npy"
    bin = "bin"


Folder = Annotated[
    Path, typer.Option("--to", metavar="DIR", help="Folder to write into; nothing is overwritten.")
]
Frames = Annotated[
    Path | None,
    typer.Option("--frames", help="Instead of a query: a file with a FRAME a line; - is stdin."),
]
LockFile = Annotated[
    Path | None,
    typer.Option(
        "--lock", metavar="FILE", help="Instead of a query: each case of a lock, a clip each."
    ),
]
Form = Annotated[
    str, typer.Option("--format", help="mcap, parquet, frames, nx, pyg, s3c, or of a package.")
]
Before = Annotated[
    str, typer.Option("--before", metavar="TIME", help="Time before each match: 2s, 500ms.")
]
After = Annotated[str, typer.Option("--after", metavar="TIME", help="Time after each match.")]
LabelTexts = Annotated[
    list[str] | None,
    typer.Option(
        "--label",
        metavar="NAME=TEXT",
        help="A value for each frame: an expression, or a query that is true where it matches.",
    ),
]
WithGraph = Annotated[
    bool, typer.Option("--with-graph", help="mcap: with the scene graphs, as JSON and to draw.")
]
Abstraction = Annotated[
    str, typer.Option("--abstraction", help="nx, pyg, s3c: abstraction of the graphs.")
]
Channels = Annotated[
    list[str] | None,
    typer.Option("--channel", metavar="TOPIC", help="frames: only of this sensor; repeatable."),
]
CloudForm = Annotated[Clouds, typer.Option("--clouds", help="frames: format of point clouds.")]


@app.command(rich_help_panel=PANEL)
def export(
    store: StorePath,
    query: QueryText = None,
    to: Folder = Path("clips"),
    file: QueryFile = None,
    name: PatternName = None,
    parameters: Parameters = None,
    frames: Frames = None,
    lock: LockFile = None,
    form: Form = "mcap",
    before: Before = BEFORE_AFTER,
    after: After = BEFORE_AFTER,
    labels: LabelTexts = None,
    with_graph: WithGraph = False,
    abstraction: Abstraction = "",
    channels: Channels = None,
    clouds: CloudForm = Clouds.pcd,
    as_json: AsJson = False,
    *,
    bounds: QueryLimits,
) -> int:
    """Cut matches out of their recordings, as clips with the original messages.

    Other formats: tables (parquet), pictures and clouds (frames), graphs for
    networkx (nx), PyTorch Geometric (pyg) and S3C (s3c). RETURN CLIPS(-3s, +5s)
    in the query wins over --before and --after.
    """
    from sgstore.exporters import Export, exporter_named, labelled, parse_labels, write_export

    exporter_named(form)  # before anything is searched
    texts = parse_labels(labels or [])
    opened = bounds.opened(store)
    values = parameters_of(parameters)
    margins = seconds_of(before, "--before"), seconds_of(after, "--after")
    if sum((frames is not None, lock is not None, bool(query or file or name))) > 1:
        raise typer.BadParameter("give one of: a QUERY, --frames, --lock")
    text, held = "", {}
    if frames is None and lock is None:
        text, held = asked_of(query, file, name, values)
    clips = _clips(opened, (frames, lock), text, held, margins)
    if not clips:
        say("nothing matches: nothing to export")
        return 0
    with count_bar(to.name or "export", "clips") as progress:
        order = Export(
            opened,
            tuple(clips),
            abstraction=abstraction,
            with_graph=with_graph,
            channels=tuple(channels or ()),
            clouds=clouds.value,
            provenance=({"query": text} if text else {"lock": lock.name} if lock else {}),
            progress=progress,
        )
        written = write_export(labelled(order, texts, **values), to, form)
    _write(written, form_of(Format.table, as_json=as_json))
    return LOSS if any(one.losses for one in written) else 0


def _write(written: Sequence[WrittenClip | WrittenFile], form: Format) -> None:
    """Say what was lost, and print what was written, a row each."""
    for one in written:
        for loss in one.losses:
            say(f"{one.file.name}: lost: {loss.reason}")
    rows = [one.as_row() for one in written]
    write_rows(tuple(rows[0]), [tuple(row.values()) for row in rows], form)


def _clips(
    store: Store,
    named: tuple[Path | None, Path | None],
    text: str,
    parameters: Mapping[str, Any],
    margins: tuple[float, float],
) -> list[Clip]:
    """The clips around what a query finds or frames that are named; or the cases of a lock, as they are."""
    frames, lock = named
    if lock is not None:
        from sgstore.locks import cases_of
        from sgstore.world import Clip

        return [Clip(*case[:3]) for case in cases_of(lock, store)]
    if frames is not None:
        from sgstore.exporters import around_frames

        return around_frames(store, lines_of(frames), *margins)
    matches = store.find(text, **parameters)
    say_left_out(matches)
    return list(matches.clips(*margins))


# Verbs that draw --------------------------------------------------------------------------------


class DrawnRelations(StrEnum):
    """Edges that a picture shows."""

    ego = "ego"
    all = "all"
    none = "none"


Frame = Annotated[
    str,
    typer.Argument(
        metavar="FRAME", help="A frame_id, TRACE#SEQ, or TRACE@12.3s; a clip: TRACE@12s..18s."
    ),
]
Picture = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        help="The picture: .png or .svg; of a clip: .gif.",
        show_default="frame.png, clip.gif",
    ),
]
DrawnEdges = Annotated[DrawnRelations, typer.Option("--relations", help="Which edges are drawn.")]
Camera = Annotated[
    str | None,
    typer.Option("--camera", help="Channel of a picture to put beside it; 'none' for no picture."),
]
Radius = Annotated[
    float | None, typer.Option("--radius", help="Half the side of the window, in metres.")
]
NorthUp = Annotated[bool, typer.Option("--north-up", help="North is up, not the ego's heading.")]
Diagram = Annotated[bool, typer.Option("--graph", help="Beside it the graph as nodes and edges.")]
PicturesASecond = Annotated[
    float, typer.Option("--fps", min=0.1, max=50.0, help="Pictures a second of an animation.")
]


@app.command(rich_help_panel=PANEL)
def show(
    store: StorePath,
    frame: Frame,
    query: QueryText = None,
    output: Picture = None,
    file: QueryFile = None,
    name: PatternName = None,
    parameters: Parameters = None,
    relations: DrawnEdges = DrawnRelations.ego,
    camera: Camera = None,
    radius: Radius = None,
    north_up: NorthUp = False,
    graph: Diagram = False,
    fps: PicturesASecond = 10.0,
    *,
    bounds: QueryLimits,
) -> int:
    """Draw a frame from above, or a clip as an animation; with a QUERY, what it matches is marked."""
    from sgstore.draw import draw_clip, draw_stored, range_of

    opened = bounds.opened(store)
    asked = query or file or name
    text, values = asked_of(query, file, name, parameters_of(parameters)) if asked else ("", {})
    clip = range_of(frame)
    output = output or Path("clip.gif" if clip else "frame.png")
    options: dict[str, Any] = {
        "matches": opened.find(text, **values) if text else None,
        "camera": camera,
        "relations": relations.value,
        "radius": radius,
        "north_up": north_up,
        "diagram": graph,
    }
    if clip is None:
        marked = int(draw_stored(opened, frame, output, **options))
    else:
        with count_bar(output.name, "pictures") as bar:
            marked = draw_clip(opened, clip, output, fps=fps, on_frame=bar, **options)
    if text and not marked:
        say(f"the query does not match in {frame}: nothing is marked")
    typer.echo(output)
    return 0
