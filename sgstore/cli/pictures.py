"""Verbs that draw."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from sgstore.cli.arguments import (
    Parameters,
    PatternName,
    QueryFile,
    QueryText,
    StorePath,
    app,
    asked_of,
    open_store,
    parameters_of,
)
from sgstore.cli.output import say
from sgstore.cli.progress import count_bar


class DrawnRelations(StrEnum):
    """Which edges a picture shows."""

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


@app.command()
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
) -> int:
    """Draw a frame from above, or a clip as an animation; with a QUERY, what it matches is marked."""
    from sgstore.draw.stored import draw_clip, draw_stored, range_of

    opened = open_store(store)
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
