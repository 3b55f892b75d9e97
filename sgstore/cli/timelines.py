"""The verb that shows when: swim lanes of matches and violations."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sgstore.cli.arguments import (
    Parameters,
    StorePath,
    app,
    open_store,
    parameters_of,
    text_of,
)

if TYPE_CHECKING:
    from collections.abc import Mapping


@app.command()
def timeline(
    store: StorePath,
    queries: Annotated[
        list[str] | None, typer.Argument(metavar="[QUERY…]", help="'MATCH …', or 'CHECK …'.")
    ] = None,
    files: Annotated[
        list[Path] | None,
        typer.Option("--file", "-f", help="Read a query, or checks, from a file; repeatable."),
    ] = None,
    names: Annotated[
        list[str] | None,
        typer.Option("--pattern", "-p", metavar="NAME", help="One of the library; repeatable."),
    ] = None,
    parameters: Parameters = None,
    trace: Annotated[str, typer.Option("--trace", help="Only this trace.")] = "",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="A picture: FILE.png or FILE.svg.")
    ] = None,
) -> int:
    """Show when what matches or is violated: swim lanes, a lane for each who, over every trace.

    In the terminal, or with -o as a picture.
    """
    from sgstore.draw.swimlanes import LETTERS, NAME, lines_of, timelines

    asked = _asked(queries or [], files or [], names or [], parameters_of(parameters))
    found = timelines(open_store(store), asked, trace)
    if trace and not found:
        raise typer.BadParameter(f"--trace: the store has no trace {trace!r}")
    if output is None:
        letters = max(LETTERS, min(shutil.get_terminal_size().columns - NAME - 26, 3 * LETTERS))
        for one in found:
            typer.echo("\n".join(lines_of(one, letters)))
        return 0
    from sgstore.draw.timeline import draw_timelines

    draw_timelines(found, output)
    typer.echo(output)
    return 0


def _asked(
    queries: list[str], files: list[Path], names: list[str], values: Mapping[str, Any]
) -> dict[str, tuple[str, Mapping[str, Any]]]:
    """What is asked, by the names of its lanes."""
    from sgstore.lang.standard import pattern_named

    found: dict[str, tuple[str, Mapping[str, Any]]] = {}
    for number, text in enumerate(queries, start=1):
        found["match" if len(queries) == 1 else f"match {number}"] = text, values
    for file in files:
        found[file.stem] = text_of(file), values
    for name in names:
        one = pattern_named(name)
        own = {key: value for key, value in values.items() if key in one.parameters}
        found[name] = one.written(**own), {}
    if not found:
        raise typer.BadParameter("give a QUERY, -f FILE or -p NAME")
    return found
