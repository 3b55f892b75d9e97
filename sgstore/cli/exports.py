"""Verbs that write test sets."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

import typer

from sgstore.cli.arguments import (
    LOSS,
    AsJson,
    Parameters,
    QueryFile,
    QueryText,
    StorePath,
    app,
    form_of,
    lines_of,
    open_store,
    parameters_of,
    query_of,
    say_left_out,
    seconds_of,
)
from sgstore.cli.output import Format, say, write_rows

BEFORE_AFTER: Final = "2s"


class ClipFormat(StrEnum):
    """Formats that clips are exported in."""

    mcap = "mcap"


@app.command()
def export(
    store: StorePath,
    query: QueryText = None,
    to: Annotated[
        Path,
        typer.Option("--to", metavar="DIR", help="Folder to write into; nothing is overwritten."),
    ] = Path("clips"),
    file: QueryFile = None,
    parameters: Parameters = None,
    frames: Annotated[
        Path | None,
        typer.Option(
            "--frames", help="Instead of a query: a file with a FRAME a line; - is stdin."
        ),
    ] = None,
    clip_format: Annotated[
        ClipFormat, typer.Option("--format", help="What the clips are written as.")
    ] = ClipFormat.mcap,
    before: Annotated[
        str, typer.Option("--before", metavar="TIME", help="Time before each match: 2s, 500ms.")
    ] = BEFORE_AFTER,
    after: Annotated[
        str, typer.Option("--after", metavar="TIME", help="Time after each match.")
    ] = BEFORE_AFTER,
    as_json: AsJson = False,
) -> int:
    """Cut matches out of their recordings, as clips with the original messages.

    RETURN CLIPS(-3s, +5s) in the query wins over --before and --after.
    """
    from sgstore.exporters.stored import around_frames, write_stored

    opened = open_store(store)
    margins = seconds_of(before, "--before"), seconds_of(after, "--after")
    if frames is not None:
        if query or file:
            raise typer.BadParameter("give a QUERY or --frames, not both")
        clips = around_frames(opened, lines_of(frames), *margins)
        text = ""
    else:
        text = query_of(query, file)
        matches = opened.find(text, **parameters_of(parameters))
        say_left_out(matches)
        clips = list(matches.clips(*margins))
    if not clips:
        say("nothing matches: nothing to export")
        return 0
    written = write_stored(opened, clips, to, form=clip_format.value, query=text)
    for clip in written:
        for loss in clip.losses:
            say(f"{clip.file.name}: lost: {loss.reason}")
    columns = ("clip", "trace", "start_ns", "seconds", "messages")
    rows = (
        (
            str(clip.file),
            clip.trace,
            clip.start_ns,
            round((clip.end_ns - clip.start_ns) / 1e9, 3),
            sum(channel.messages for channel in clip.messages),
        )
        for clip in written
    )
    write_rows(columns, rows, form_of(Format.table, as_json=as_json))
    return LOSS if any(clip.losses for clip in written) else 0
