"""The verb for assistants: mcp."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from typer import Option

from sgstore.cli._options import StorePath, With, app, seconds_of, tables_of
from sgstore.errors import MissingExtraError

PANEL: Final = "Questions"


@app.command(rich_help_panel=PANEL)
def mcp(
    store: StorePath,
    write_to: Annotated[
        Path | None,
        Option("--write-to", metavar="DIR", help="Let clips be exported into this folder."),
    ] = None,
    question_timeout: Annotated[
        str, Option("--timeout", metavar="TIME", help="Longest time for a question.")
    ] = "10s",
    max_rows: Annotated[int, Option("--max-rows", min=1, help="Rows of an answer at most.")] = 1000,
    tables: With = None,
) -> None:
    """Serve a store to an assistant: a server of the Model Context Protocol on stdin and stdout.

    For the settings of an assistant: {"command": "sgstore", "args": ["mcp", "/path/to/drives.sgstore"]}.
    Queries run in a separate process that sees nothing but the store; files are written with --write-to only.
    """
    try:
        from sgstore.assistant import StoreTools, serve
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in {"mcp", "pydantic"}:
            raise
        raise MissingExtraError("serving an assistant", "mcp") from error
    seconds, joined = seconds_of(question_timeout, "--timeout"), tables_of(tables)
    with StoreTools(
        store, write_to=write_to, timeout_s=seconds, most_rows=max_rows, tables=joined
    ) as tools:
        serve(tools)
