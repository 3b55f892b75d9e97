"""The verb that checks: verdicts of traces."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sgstore.cli.arguments import (
    NO_MATCH,
    AsJson,
    Output,
    Parameters,
    RowFormat,
    SgsmCompat,
    StorePath,
    app,
    asked_of,
    form_of,
    open_store,
    parameters_of,
)
from sgstore.cli.output import Format, say, write_rows

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.history.checks import Verdict
    from sgstore.matches import Interval

COLUMNS = ("check", "trace", "verdict", "who", "from", "start", "end", "frames")


@app.command()
def check(
    store: StorePath,
    file: Annotated[
        Path | None,
        typer.Argument(metavar="[FILE]", help="A file of CHECK statements; - is stdin."),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--pattern", "-p", metavar="NAME", help="A check of the library.")
    ] = None,
    text: Annotated[
        str | None, typer.Option("--expression", "-e", metavar="TEXT", help="'CHECK ALWAYS …'")
    ] = None,
    parameters: Parameters = None,
    sgsm_compat: SgsmCompat = False,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print how the checks are understood, and their SQL.")
    ] = False,
    require: Annotated[
        bool, typer.Option("--require", help="End with exit code 4 if a trace violates a check.")
    ] = False,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
    output: Output = None,
) -> int:
    """Check what must be true of every trace.

    One row a check and trace: true, false, or unknown where it cannot be told; and one a violation: by whom,
    and from when to when.
    """
    given = parameters_of(parameters)
    asked, values = asked_of(text, file, name, given)
    run = open_store(store).check(asked, sgsm_compat=sgsm_compat, **values)
    if explain:
        typer.echo(run.explain())
        return 0
    tally = {"true": 0, "false": 0}

    def counted() -> Iterator[Verdict]:
        for verdict in run:
            tally[verdict.verdict] = tally.get(verdict.verdict, 0) + 1
            yield verdict

    form = form_of(form, output, as_json=as_json)
    if form is Format.table:
        write_rows(COLUMNS, (row for one in counted() for row in _rows(one)), form, output)
        say(", ".join(f"{count} {word}" for word, count in tally.items()))
    else:
        write_rows(
            tuple(_document(None)),
            (tuple(_document(one).values()) for one in counted()),
            form,
            output,
        )
    return NO_MATCH if require and tally["false"] else 0


def _rows(verdict: Verdict) -> Iterator[tuple[Any, ...]]:
    """A verdict as a person reads it: a row, or one for each violation."""
    head = verdict.check, verdict.trace, verdict.verdict
    told = False
    for witness in verdict.witnesses:
        who = ", ".join(witness.names.values())
        for row in _times(witness.violations) or [("", "", "", "")]:
            told = True
            yield (*head, who, *row)
    if not told:
        for row in _times(verdict.violations) or [("", "", "", "")]:
            yield (*head, "", *row)


def _times(violations: tuple[Interval, ...]) -> list[tuple[Any, ...]]:
    return [
        (f"{i.trace}#{i.start_seq}", round(i.start, 3), round(i.end, 3), i.frames)
        for i in violations
    ]


def _document(verdict: Verdict | None) -> dict[str, Any]:
    """A verdict as a program reads it."""
    return {
        "check": verdict and verdict.check,
        "trace": verdict and verdict.trace,
        "verdict": verdict and verdict.verdict,
        "first_violation": verdict and verdict.first_violation and _span(verdict.first_violation),
        "violations": [_span(one) for one in verdict.violations] if verdict else [],
        "witnesses": [
            {
                "nodes": dict(one.nodes),
                "names": dict(one.names),
                "holds": one.holds,
                "violations": [_span(span) for span in one.violations],
            }
            for one in (verdict.witnesses if verdict else ())
        ],
    }


def _span(interval: Interval) -> dict[str, Any]:
    return {
        "start_seq": interval.start_seq,
        "end_seq": interval.end_seq,
        "start_ns": interval.start_ns,
        "end_ns": interval.end_ns,
        "start": interval.start,
        "end": interval.end,
        "frames": interval.frames,
    }
