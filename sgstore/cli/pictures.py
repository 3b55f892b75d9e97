"""Verbs that draw."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sgstore.cli.arguments import (
    Parameters,
    QueryFile,
    QueryText,
    StorePath,
    app,
    open_store,
    parameters_of,
    query_of,
)
from sgstore.cli.output import say


class DrawnRelations(StrEnum):
    """Which edges a picture shows."""

    ego = "ego"
    all = "all"
    none = "none"


@app.command()
def show(
    store: StorePath,
    frame: Annotated[
        str, typer.Argument(metavar="FRAME", help="A frame_id, TRACE#SEQ, or TRACE@12.3s.")
    ],
    query: QueryText = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The picture: .png or .svg.")
    ] = Path("frame.png"),
    file: QueryFile = None,
    parameters: Parameters = None,
    relations: Annotated[
        DrawnRelations, typer.Option("--relations", help="Which edges are drawn.")
    ] = DrawnRelations.ego,
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera", help="Channel of a picture to put beside it; 'none' for no picture."
        ),
    ] = None,
    radius: Annotated[
        float | None, typer.Option("--radius", help="Half the side of the window, in metres.")
    ] = None,
    north_up: Annotated[
        bool, typer.Option("--north-up", help="North is up, not the ego's heading.")
    ] = False,
    graph: Annotated[
        bool, typer.Option("--graph", help="Beside it the graph as nodes and edges.")
    ] = False,
) -> int:
    """Draw a frame from above; with a QUERY, what it matches there is marked."""
    from sgstore.draw.stored import draw_stored

    opened = open_store(store)
    text = query_of(query, file) if query or file else None
    marked = draw_stored(
        opened,
        frame,
        output,
        matches=opened.find(text, **parameters_of(parameters)) if text else None,
        camera=camera,
        relations=relations.value,
        radius=radius,
        north_up=north_up,
        diagram=graph,
    )
    if text and not marked:
        say(f"the query does not match in {frame}: nothing is marked")
    typer.echo(output)
    return 0
