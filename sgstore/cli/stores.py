"""Verbs about a store as a whole: is it as it was published, and take traces out of it."""

from __future__ import annotations

from typing import Annotated

import typer

from sgstore.cli.arguments import ERROR, AsJson, RowFormat, StorePath, app, form_of
from sgstore.cli.output import Format, say, write_rows


@app.command()
def verify(
    store: StorePath,
    payloads: Annotated[
        bool, typer.Option("--payloads", help="Hash the recordings again, too.")
    ] = False,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> int:
    """Look whether everything is as it was published; print what is not."""
    from sgstore.store import StoreFile

    found = StoreFile(store).verify(recordings=payloads)
    rows = [(fault.trace, fault.check, fault.detail) for fault in found.faults]
    write_rows(("trace", "check", "detail"), rows, form_of(form, as_json=as_json))
    hashed = f", {found.recordings} recordings" if payloads else ""
    wrong = f"{len(rows)} faults" if rows else "no fault"
    say(f"{store}: {found.traces} traces, {found.rows} rows{hashed}: {wrong}")
    return ERROR if rows else 0


@app.command()
def remove(
    store: StorePath,
    traces: Annotated[
        list[str], typer.Argument(metavar="TRACE…", help="Names, ids, or beginnings of names.")
    ],
    compact: Annotated[
        bool, typer.Option("--compact", help="Write the store anew, to give the space back.")
    ] = False,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> int:
    """Take traces out of a store, all of them or none; the recordings stay where they are."""
    from sgstore.store import StoreFile

    file = StoreFile(store)
    gone = file.remove(*traces)
    if compact:
        file.compact()
    rows = [(trace.name, trace.frames, str(trace.path)) for trace in gone]
    write_rows(("trace", "frames", "file"), rows, form_of(form, as_json=as_json))
    return 0
