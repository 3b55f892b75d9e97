"""Verbs about graphs that other tools made."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sgstore.cli.arguments import ERROR, LOSS, AsJson, StorePath, app, form_of, seconds_of
from sgstore.cli.output import Format, say, write_rows

if TYPE_CHECKING:
    from sgstore.importing import Imported


class GraphFormat(StrEnum):
    """What files of graphs are written in."""

    s3c = "s3c"
    nodelink = "nodelink"
    csv = "csv"


Files = Annotated[
    list[Path],
    typer.Argument(metavar="FILE…", help="Files of graphs, each a trace; .xz, .gz and .bz2 too."),
]
WrittenIn = Annotated[
    GraphFormat,
    typer.Option(
        "--format", help="s3c: its CSV; csv: graph, src, relation, dst; nodelink: JSON of networkx."
    ),
]
Kinds = Annotated[
    list[str] | None,
    typer.Option("--kind", metavar="LABEL=KIND", help="What a label means; repeatable."),
]
Relations = Annotated[
    list[str] | None,
    typer.Option("--relation", metavar="NAME=RELATION", help="What a relation means; repeatable."),
]
UnknownAs = Annotated[
    str,
    typer.Option(
        "--unknown-as",
        metavar="KIND",
        help="Take labels that nobody knows for this kind ('other': unknown), leave out relations.",
    ),
]
Answers = Annotated[
    list[str] | None,
    typer.Option(
        "--answers",
        metavar="RELATION",
        help="The graphs can hold it, though none of them may; repeatable.",
    ),
]
Period = Annotated[
    str,
    typer.Option("--period", metavar="TIME", help="From frame to frame, where no time is told."),
]
Force = Annotated[
    bool, typer.Option("--force", help="Read anew, and replace, what is in the store already.")
]
Rows = Annotated[Format, typer.Option("--rows", help="How rows are printed.")]


@app.command("import")
def import_(
    store: StorePath,
    files: Files,
    form_of_graphs: WrittenIn,
    kind: Kinds = None,
    relation: Relations = None,
    unknown_as: UnknownAs = "",
    answers: Answers = None,
    period: Period = "1s",
    force: Force = False,
    form: Rows = Format.table,
    as_json: AsJson = False,
) -> int:
    """Bring graphs that other tools made into a store: each becomes a frame."""
    from sgstore.importing import Words, import_graphs
    from sgstore.vocabulary import relation_named

    words = Words(_pairs(kind, "--kind"), _pairs(relation, "--relation"), unknown_as)
    known = [relation_named(name) for name in answers or ()]
    if None in known:
        raise typer.BadParameter(
            f"--answers {(answers or [''])[known.index(None)]}: no such relation"
        )
    seconds = seconds_of(period, "--period")
    if seconds <= 0:
        raise typer.BadParameter("--period: expected more than 0s")
    done = import_graphs(
        store,
        files,
        str(form_of_graphs),
        words=words,
        relations=[name for name in known if name is not None],
        period_s=seconds,
        force=force,
    )
    for one in done:
        if one.error is not None:
            say(str(one.error))
        for what, often in sorted(one.lost.items()):
            say(f"{one.path.name}: {what}: {often} times, cannot be kept")
    columns = ("file", "status", "trace", "frames", "entities", "edges")
    rows = ((str(o.path), o.status, o.name, o.frames, o.entities, o.edges) for o in done)
    write_rows(columns, rows, form_of(form, as_json=as_json))
    return _code(done)


def _pairs(texts: list[str] | None, option: str) -> dict[str, str]:
    pairs: dict[str, str] = {}
    for text in texts or []:
        name, equals, value = text.rpartition("=")
        if not (name and equals and value):
            raise typer.BadParameter(f"{option} {text!r}: expected NAME=VALUE")
        pairs[name] = value
    return pairs


def _code(done: list[Imported]) -> int:
    if any(one.error is not None for one in done):
        return ERROR
    return LOSS if any(one.lost for one in done) else 0
