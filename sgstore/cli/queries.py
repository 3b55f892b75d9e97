"""Verbs that find: patterns and SQL."""

from __future__ import annotations

from itertools import chain
from typing import Annotated

import typer

from sgstore.cli.arguments import (
    NO_MATCH,
    AsJson,
    Output,
    Parameters,
    QueryFile,
    QueryText,
    RowFormat,
    StorePath,
    app,
    form_of,
    open_store,
    parameters_of,
    query_of,
    say_left_out,
)
from sgstore.cli.output import Format, say, write_rows


@app.command()
def find(
    store: StorePath,
    query: QueryText = None,
    file: QueryFile = None,
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
) -> int:
    """Find frames by a pattern of their scene graphs.

    One row a match: the frame, its time, and what each variable is bound to; or what RETURN asks for.
    """
    opened = open_store(store)
    matches = opened.find(query_of(query, file), **parameters_of(parameters))
    if explain:
        typer.echo(matches.explain())
        return 0
    say_left_out(matches)
    if count:
        number = matches.count()
        typer.echo(number)
    else:
        form = form_of(form, as_json=as_json)
        columns, rows = matches.for_people() if form is Format.table else (matches.columns, matches)
        number = write_rows(columns, rows, form, output)
        if not number and form is Format.table:
            say("nothing matches")
    return NO_MATCH if require and not number else 0


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
) -> int:
    """Ask a store in SQL, read only.

    Views: frames, nodes, edges, lane_states, pairs, lanes, entities, payloads; DESCRIBE names their columns.
    """
    from sgstore.store import StoreFile

    with StoreFile(store).user_batches(query_of(statement, file)) as batches:
        rows = chain.from_iterable(batch.values for batch in batches)
        write_rows(batches.columns, rows, form_of(form, as_json=as_json), output, batches.types)
    return 0
