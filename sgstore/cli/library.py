"""Verbs about the library of named patterns: list, show, run."""

from __future__ import annotations

from enum import StrEnum
from itertools import chain
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sgstore.cli.arguments import (
    NO_MATCH,
    AsJson,
    Output,
    RowFormat,
    StorePath,
    app,
    form_of,
    open_store,
    parameters_of,
    say_left_out,
    seconds_of,
)
from sgstore.cli.checks import check
from sgstore.cli.output import Format, say, write_document, write_rows, write_text

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.lang import NamedPattern
    from sgstore.matches import Interval

library = typer.Typer(no_args_is_help=True)
app.add_typer(library, name="patterns", help="The library of named patterns: list, show, run them.")

PatternName = Annotated[
    str, typer.Argument(metavar="NAME", help="Of a pattern, such as cut_in or ParkingExit.")
]
Chosen = Annotated[
    list[str] | None,
    typer.Argument(metavar="NAME=VALUE", help="Parameters of the pattern, such as within=2s."),
]


class Kind(StrEnum):
    """Kinds of patterns."""

    predicate = "predicate"
    concept = "concept"
    scenario = "scenario"
    property = "property"


@library.command("list")
def list_patterns(
    kind: Annotated[Kind | None, typer.Option("--kind", help="Only patterns of this kind.")] = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
    output: Output = None,
) -> int:
    """Name the patterns of the library, with what they find.

    Predicates are conditions that every query may use; concepts and scenarios are found by their
    names; properties are rules that a trace keeps or violates.
    """
    from sgstore.lang import patterns

    form = form_of(form, output, as_json=as_json)
    found = [p for p in patterns().values() if kind is None or p.kind == kind]
    if form is Format.table:
        columns = ("name", "kind", "from", "sentence")
        rows = [(p.name, p.kind, p.library, p.sentence) for p in found]
    else:
        columns = ("name", "kind", "library", "sentence", "parameters", "source", "query")
        rows = [(*_told(p).values(),) for p in found]
    write_rows(columns, rows, form, output)
    return 0


@library.command("show")
def show_pattern(name: PatternName, as_json: AsJson = False, output: Output = None) -> int:
    """Print a pattern: its text, its parameters, where it comes from, and a scene that it holds in.

    What is printed is a query, its remarks being comments: it can be changed and asked with find -f.
    """
    from sgstore.lang import pattern_named

    found = pattern_named(name)
    if as_json:
        write_document({**_told(found), "example": found.example}, Format.json)
    else:
        write_text(_for_people(found), output)
    return 0


@library.command("run")
def run_pattern(
    store: StorePath,
    name: PatternName,
    chosen: Chosen = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
    output: Output = None,
    clips: Annotated[
        bool, typer.Option("--clips", help="Print clips (trace, start_ns, end_ns) in log time.")
    ] = False,
    before: Annotated[
        str, typer.Option("--before", metavar="TIME", help="With --clips: time before each match.")
    ] = "0s",
    after: Annotated[
        str, typer.Option("--after", metavar="TIME", help="With --clips: time after each match.")
    ] = "0s",
    require: Annotated[
        bool,
        typer.Option(
            "--require",
            help="End with exit code 4 if nothing matches, or if the property is violated.",
        ),
    ] = False,
) -> int:
    """Find a pattern of the library in a store: when it holds, and who takes part.

    Of a property: whether each trace keeps it, and where it does not.
    """
    from sgstore.lang import pattern_named

    found = pattern_named(name)
    if found.kind == "predicate":
        hint = f"a condition: ask 'sgstore find STORE \"MATCH … WHERE {found.name}(…)\"'"
        raise typer.BadParameter(f"{found.name} is {hint}")
    if found.is_check:
        if clips:
            raise typer.BadParameter(f"{found.name} is a property, which has verdicts and no clips")
        return check(
            store,
            name=found.name,
            parameters=chosen,
            require=require,
            form=form,
            as_json=as_json,
            output=output,
        )
    text = found.written(**parameters_of(chosen))
    form = form_of(form, output, as_json=as_json)
    matches = open_store(store).find(text)
    say_left_out(matches)
    if clips:
        offsets = seconds_of(before, "--before"), seconds_of(after, "--after")
        rows = ((c.trace, c.start_ns, c.end_ns) for c in matches.clips(*offsets))
        number = write_rows(("trace", "start_ns", "end_ns"), rows, form, output)
    else:
        number = _write_intervals(matches.intervals(), form, output)
    if not number and form is Format.table:
        say("nothing matches")
    return NO_MATCH if require and not number else 0


def _write_intervals(intervals: Iterator[Interval], form: Format, output: Any) -> int:
    """Intervals as rows; for people, with a name for each that takes part instead of its node id."""
    first = next(intervals, None)
    if first is None:
        return write_rows((), [], form, output)
    every = chain([first], intervals)
    if form is not Format.table:
        columns = ("trace", "start_seq", "end_seq", "start", "end", "frames", *first.values)
        rows = (
            (i.trace, i.start_seq, i.end_seq, i.start, i.end, i.frames, *i.values.values())
            for i in every
        )
        return write_rows(columns, rows, form, output)
    named = {name.removesuffix(".name") for name in first.values if name.endswith(".name")}
    keep = [name for name in first.values if name.removesuffix(".id") not in named]
    columns = ("from", "start", "end", "frames", *(name.removesuffix(".name") for name in keep))
    shown = (
        (
            f"{i.trace}#{i.start_seq}",
            round(i.start, 3),
            round(i.end, 3),
            i.frames,
            *(i.values[name] for name in keep),
        )
        for i in every
    )
    return write_rows(columns, shown, form, output)


def _told(found: NamedPattern) -> dict[str, Any]:
    """A pattern as data."""
    parameters = [
        {"name": p.name, "type": p.type, "default": p.default, "meaning": p.meaning}
        for p in found.parameters.values()
    ]
    return {
        "name": found.name,
        "kind": found.kind,
        "library": found.library,
        "sentence": found.sentence,
        "parameters": parameters,
        "source": found.source,
        "query": found.query,
    }


def _for_people(found: NamedPattern) -> str:
    """A pattern as a query: with its parameters' defaults, everything about it as comments."""
    head = [f"{found.name}: {found.sentence}", f"source: {found.source}"]
    head += [f"param {p.name} = {p.default}: {p.meaning}" for p in found.parameters.values()]
    head += ["", *found.example.splitlines()] if found.example else []
    comments = [f"-- {line}".rstrip() for line in head]
    return "\n".join([*comments, found.text, ""])
