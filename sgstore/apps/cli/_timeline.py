"""Command ``sgstore timeline``: plots matches and violations over time, with one lane per entity."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from sgstore.apps.cli._checks import PANEL
from sgstore.apps.cli._options import (
    Parameters,
    PatternNames,
    QueryLimits,
    StorePath,
    Traces,
    Verbs,
    parameters_of,
    say_unknown,
    text_of,
    text_or_file,
)
from sgstore.apps.cli._output import say
from sgstore.base.output_files import without_controls

if TYPE_CHECKING:
    from collections.abc import Mapping

verbs = Verbs()


@verbs.command(rich_help_panel=PANEL)
def timeline(
    store: StorePath,
    queries: Annotated[list[str] | None, Argument()] = None,
    files: Annotated[list[Path] | None, Option("--file", "-f")] = None,
    names: PatternNames = None,
    parameters: Parameters = None,
    traces: Traces = None,
    to: Annotated[Path | None, Option("--to", "-o")] = None,
    every: Annotated[bool, Option("--all")] = False,
    parts: str | None = None,
    *,
    bounds: QueryLimits,
) -> int:
    """Plot matches and rule violations over time, one lane per entity, for each trace that has any.

    In the terminal, or with -o as a picture; all traces have one scale. With --parts FRAME one lane
    for each part of a pattern.

    Parameters
    ----------
    queries : [QUERY…]
        'MATCH …', or 'CHECK …'.
    to
        Picture to write: FILE.png or FILE.svg.
    every
        Include traces without matches and violations.
    parts : FRAME
        Show where each part of one pattern holds for the match in this frame.
    """
    from sgstore.draw import LETTERS, NAME, lines_of, parts_timeline, timelines

    asked = _asked(queries or [], files or [], names or [], parameters_of(parameters))
    if parts is None:
        found = timelines(bounds.opened(store), asked, traces or ())
    else:
        if len(asked) > 1 or traces:
            raise typer.BadParameter("--parts FRAME needs one pattern, and the trace of the frame")
        ((text, values),) = asked.values()
        found = [parts_timeline(bounds.opened(store), text, parts, values)]
    for name in {*(traces or ())} - {one.trace for one in found}:
        raise typer.BadParameter(f"--trace: the store has no trace {name!r}")
    say_unknown((lane.name, one.trace, lane.reason) for one in found for lane in one.lanes)
    hits = [one for one in found if one.hit]
    if not every and hits:
        if len(hits) < len(found):
            say(
                f"{len(found) - len(hits)} more traces without matches or violations; --all shows them"
            )
        found = hits
    if to is None:
        letters = max(LETTERS, min(shutil.get_terminal_size().columns - NAME - 26, 3 * LETTERS))
        longest = max((one.seconds for one in found), default=0.0)
        for one in found:
            typer.echo(without_controls("\n".join(lines_of(one, letters, longest))))
        return 0
    from sgstore.draw import draw_timelines

    draw_timelines(found, to)
    typer.echo(to)
    return 0


def _asked(
    queries: list[str], files: list[Path], names: list[str], values: Mapping[str, Any]
) -> dict[str, tuple[str, Mapping[str, object]]]:
    """Return the queries to plot, and the values of their parameters, by lane name."""
    from sgstore.apps.verbs import by_lane, free_name
    from sgstore.lang.library import pattern_named

    lanes: dict[str, str] = {}
    for file in files:
        lanes[free_name(file.stem, str(file), lanes)] = text_of(file)
    named = [pattern_named(name).name for name in names]
    found = by_lane([*map(text_or_file, queries), *named], values, lanes)
    if not found:
        raise typer.BadParameter("add a QUERY, -f FILE or -p NAME")
    return found
