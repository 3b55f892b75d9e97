"""Verbs about road maps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sgstore.cli.arguments import AsJson, RowFormat, app, form_of
from sgstore.cli.output import Format, say, write_rows

if TYPE_CHECKING:
    from sgstore.roads import RoadMap


@app.command(name="map")
def map_(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="OpenDRIVE (.xodr), or a recording that carries roads."
        ),
    ],
    picture: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Draw it there, north up: .png or .svg."),
    ] = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> int:
    """Say what is in a road map: lanes by type, junctions, signals, what is wrong with it."""
    from sgstore.roads.summary import summary

    road_map = _road_map(file)
    if picture is not None:
        from sgstore.draw import draw_map

        draw_map(road_map, picture)
        say(f"drawn: {picture}")
    form = form_of(form, as_json=as_json)
    rows = [
        (one.part, one.kind, one.count, None if one.length is None else round(one.length, 1))
        for one in summary(road_map)
    ]
    if form is Format.table:  # sentences have no room in a table
        for _, text, _, _ in (row for row in rows if row[0] == "warning"):
            say(text)
        rows = [row for row in rows if row[0] != "warning"]
    columns = ("part", "kind", "count", "length_m")
    types = ("VARCHAR", "VARCHAR", "BIGINT", "DOUBLE")
    write_rows(columns, rows, form, types=types)
    return 0


def _road_map(file: Path) -> RoadMap:
    """The map in a file, or the one that a recording carries."""
    from sgstore.errors import MapError
    from sgstore.ingest import read_map_file
    from sgstore.opendrive import read_map
    from sgstore.traces import open_trace

    try:
        with file.open("rb") as stream:
            start = stream.read(64)
    except OSError as error:
        raise MapError(f"{file}: {error.strerror or error}") from error
    # Texts begin with a bracket, or the mark of their encoding; no recording does.
    if start.lstrip()[:1] in {b"<", b"{"} or start[:2] in {b"\xff\xfe", b"\xfe\xff", b"\xef\xbb"}:
        return read_map_file(file)
    with open_trace(file) as trace:
        if not trace.info.map_text:
            raise MapError(f"{file}: the recording carries neither a road map nor lanes")
        return read_map(trace.info.map_text, trace.info.map_name)
