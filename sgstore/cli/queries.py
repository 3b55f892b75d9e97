"""Verbs that find: patterns and SQL."""

from __future__ import annotations

from enum import StrEnum
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sgstore.cli.arguments import (
    NO_MATCH,
    AsJson,
    FrameName,
    Output,
    Parameters,
    PatternName,
    QueryFile,
    QueryText,
    RowFormat,
    StorePath,
    With,
    app,
    asked_of,
    form_of,
    open_store,
    parameters_of,
    query_of,
    say_left_out,
    seconds_of,
    tables_of,
    text_of,
)
from sgstore.cli.output import Format, say, write_document, write_rows, write_text

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.matches import Matches
    from sgstore.sandbox import Answer, Sandbox

Safe = Annotated[
    bool,
    typer.Option(
        "--safe", help="Ask in a process of its own that is bounded in time, memory and rows."
    ),
]
Timeout = Annotated[
    str,
    typer.Option("--timeout", metavar="TIME", help="With --safe: the longest time, such as 5s."),
]
MaxRows = Annotated[int, typer.Option("--max-rows", min=0, help="With --safe: the most rows.")]


@app.command()
def find(
    store: StorePath,
    query: QueryText = None,
    file: QueryFile = None,
    name: PatternName = None,
    parameters: Parameters = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
    output: Output = None,
    count: Annotated[
        bool, typer.Option("--count", help="Print the number of distinct frames and nothing else.")
    ] = False,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print how the query is understood, and its SQL.")
    ] = False,
    require: Annotated[
        bool, typer.Option("--require", help="End with exit code 4 if nothing matches.")
    ] = False,
    safe: Safe = False,
    timeout: Timeout = "5s",
    max_rows: MaxRows = 10_000,
    tables: With = None,
) -> int:
    """Find frames by a pattern of their scene graphs.

    One row a match: the frame, its time, and what each variable is bound to; or what RETURN asks for.
    """
    text, values = asked_of(query, file, name, parameters_of(parameters))
    if safe:
        if count or explain:
            raise typer.BadParameter("--safe gives rows: not with --count or --explain")
        form = form_of(form, output, as_json=as_json)
        with _sandbox(store, timeout, max_rows, tables) as box:
            answer = box.find(text, **values)
        _say_all(answer)
        number = write_rows(*_as_shown(answer, form), form, output)
        if not number and form is Format.table:
            say("nothing matches")
        return NO_MATCH if require and not number else 0
    opened = open_store(store, tables_of(tables))
    with opened.file.snapshot():  # it is opened once
        matches = opened.find(text, **values)
        if explain:
            typer.echo(matches.explain())
            return 0
        say_left_out(matches)
        if count:
            number = matches.count()
            typer.echo(number)
        else:
            form = form_of(form, output, as_json=as_json)
            columns, rows = _as_shown(matches, form)
            number = write_rows(columns, rows, form, output)
            if not number and form is Format.table:
                say("nothing matches")
    return NO_MATCH if require and not number else 0


def _as_shown(
    answer: Matches | Answer, form: Format
) -> tuple[tuple[str, ...], Iterable[tuple[Any, ...]]]:
    """Columns and rows as a form has them: names for people; graphs in JSON as networkx reads them."""
    from sgstore.lang.reading import for_people
    from sgstore.sandbox import Answer

    rows = answer.rows if isinstance(answer, Answer) else answer
    if form is Format.table:
        return for_people(answer.columns, rows, graphs=answer.graphs)
    return _node_link(answer, rows, form) if answer.graphs else (answer.columns, rows)


def _node_link(
    answer: Matches | Answer, rows: Iterable[tuple[Any, ...]], form: Format
) -> tuple[tuple[str, ...], Iterable[tuple[Any, ...]]]:
    """Rows that end in a graph: in JSON as networkx reads them."""
    if form not in {Format.json, Format.ndjson}:
        return answer.columns, rows
    columns = ("directed", "multigraph", *answer.columns)
    return columns, (
        (True, True, *row[:-1], [{**edge, "key": edge["relation"]} for edge in row[-1]])
        for row in rows
    )


@app.command("why-not")
def why_not(
    store: StorePath,
    frame: FrameName,
    query: QueryText = None,
    file: QueryFile = None,
    name: PatternName = None,
    parameters: Parameters = None,
    as_json: AsJson = False,
) -> int:
    """Say how far a pattern holds in a frame: what fails first, and how near it came."""
    text, values = asked_of(query, file, name, parameters_of(parameters))
    answer = open_store(store).why_not(frame, text, **values)
    if as_json:
        write_document(answer.as_dict(), Format.json)
    else:
        typer.echo(str(answer))
    return 0


@app.command()
def like(
    store: StorePath,
    frame: FrameName,
    ignore: Annotated[
        list[str] | None,
        typer.Option(
            "--ignore", metavar="NAME", help="A relation or a kind that does not count; repeatable."
        ),
    ] = None,
    abstraction: Annotated[
        str, typer.Option("--abstraction", metavar="NAME", help="Whose graphs are compared.")
    ] = "RSV",
    limit: Annotated[int, typer.Option("--limit", min=1, help="How many runs of frames.")] = 10,
    pattern: Annotated[
        bool, typer.Option("--pattern", help="Print a pattern that describes the frame instead.")
    ] = False,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
    output: Output = None,
) -> int:
    """Find frames like another: of the same class, or the most like by what they have in common.

    One row for consecutive frames that are as like as each other: the first one, how many, how like, whether
    the graphs are the same, and what the example has that they have not, and they that it has not.
    """
    opened = open_store(store)
    if pattern:
        write_text(f"{opened.pattern(frame, ignore=ignore or ())}\n", output)
        return 0
    form = form_of(form, output, as_json=as_json)
    found = opened.like(frame, abstraction=abstraction, ignore=ignore or (), limit=limit)
    if form is Format.table:
        columns = ("frame", "t", "frames", "similarity", "same", "missing", "extra")
        rows = (
            (
                f"{one.frame.trace}#{one.frame.seq}",
                round(one.frame.t, 3),
                one.frames,
                round(one.similarity, 3),
                one.same,
                _counted(one.missing),
                _counted(one.extra),
            )
            for one in found
        )
        write_rows(columns, rows, form, output)
        return 0
    columns = ("frame_id", "trace", "seq", "time_ns", "t", "frames", "similarity", "same")
    columns += ("shared", "missing", "extra")
    rows = (
        (
            *(getattr(one.frame, name) for name in columns[:5]),
            *(getattr(one, name) for name in columns[5:]),
        )
        for one in found
    )
    write_rows(columns, rows, form, output)
    return 0


def _counted(features: dict[str, int]) -> str:
    """Features with how often, as one text."""
    return ", ".join(f"{n} x {text}" if n > 1 else text for text, n in features.items())


class Language(StrEnum):
    """Languages that are translated."""

    sgl = "sgl"


@app.command()
def translate(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="What to translate; - is stdin.")],
    language: Annotated[
        Language, typer.Option("--from", help="sgl: properties of SGSM, as Python.")
    ] = Language.sgl,
    output: Output = None,
) -> int:
    """Translate properties of other tools into the query language; nothing of the file is run."""
    from sgstore.lang.sgl import translated

    write_text(translated(text_of(file)), output)
    return 0


@app.command()
def sql(
    store: StorePath,
    statement: Annotated[
        str | None, typer.Argument(metavar="SQL", help="'SELECT … FROM frames, nodes, edges …'")
    ] = None,
    file: QueryFile = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
    output: Output = None,
    safe: Safe = False,
    timeout: Timeout = "5s",
    max_rows: MaxRows = 10_000,
    tables: With = None,
) -> int:
    """Ask a store in SQL, read only.

    Views: frames, nodes, edges, lane_states, lane_gaps, pairs, lanes, entities, payloads; DESCRIBE them.
    """
    form = form_of(form, output, as_json=as_json)
    if safe:
        with _sandbox(store, timeout, max_rows, tables) as box:
            answer = box.sql(query_of(statement, file))
        _say_all(answer)
        write_rows(answer.columns, answer.rows, form, output)
        return 0
    opened = open_store(store, tables_of(tables)).file
    with opened.user_batches(query_of(statement, file)) as batches:
        rows = chain.from_iterable(batch.values for batch in batches)
        write_rows(batches.columns, rows, form, output, batches.types)
    return 0


def _sandbox(store: Path, timeout: str, max_rows: int, tables: list[str] | None) -> Sandbox:
    from sgstore.sandbox import Sandbox

    return Sandbox(
        store,
        timeout_s=seconds_of(timeout, "--timeout"),
        max_rows=max_rows,
        tables=tables_of(tables),
    )


def _say_all(answer: Answer) -> None:
    """Say what an answer lacks."""
    say_left_out(answer)
    if answer.truncated:
        say(f"only the first {len(answer.rows)} rows; --max-rows sets how many")
