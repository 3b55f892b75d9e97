"""The verb that fetches sensor messages."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

import typer

from sgstore.cli.arguments import AsJson, Output, RowFormat, StorePath, app, form_of
from sgstore.cli.output import Format, say, write_rows
from sgstore.errors import ExportError

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.store import StoreFile


@app.command()
def payload(
    store: StorePath,
    frame: Annotated[
        str, typer.Argument(metavar="FRAME", help="frame_id, TRACE#SEQ or TRACE@12.3s.")
    ],
    channel: Annotated[
        str | None,
        typer.Argument(metavar="CHANNEL", help="Topic; without it, list those there are."),
    ] = None,
    output: Output = None,
    message: Annotated[
        bool, typer.Option("--message", help="The message as it was recorded, whatever is in it.")
    ] = False,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> int:
    """Fetch what a sensor said at a frame: a picture, a video up to it, or the message."""
    from sgstore.store import StoreFile

    file = StoreFile(store)
    if channel is None:
        _list_channels(file, frame, form_of(form, as_json=as_json))
        return 0
    if output is None and sys.stdout.isatty():
        raise ExportError(
            "a payload is not for a terminal: name a file with -o, or redirect stdout"
        )
    if message:
        data, what = file.payload(frame, channel), "message"
    else:
        carried = file.carried(frame, channel)
        data, what = carried.data, carried.form
        if carried.messages > 1:
            what += f", {carried.messages} messages from the key frame on"
    _write(data, output)
    say(f"{output or 'stdout'}: {len(data)} bytes ({what})")
    return 0


def _list_channels(file: StoreFile, frame: str, form: Format) -> None:
    with file.snapshot():
        wanted = file.frame(frame)
        found = file.rows(
            "SELECT channel, schema, offset_s, log_time_ns, length FROM payloads"
            " WHERE frame_id = ? ORDER BY channel",
            [wanted.frame_id],
        )
    write_rows(found.columns, found, form)


def _write(data: bytes, output: Path | None) -> None:
    if output is None:
        sys.stdout.buffer.write(data)
        return
    try:
        output.write_bytes(data)
    except OSError as error:
        raise ExportError(f"{output}: {error.strerror or error}") from error
