"""Commands with queries: find, why-not, like, translate, sql, patterns."""

from __future__ import annotations

import re
from enum import StrEnum
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer
from typer import Argument, Option

from sgstore.apps.cli import _completion as completion
from sgstore.apps.cli._collection_options import (
    COLLECTIONS,
    CollectionOptions,
    shown_bundle,
    url_of,
)
from sgstore.apps.cli._options import (
    NO_MATCH,
    Abstraction,
    AsJson,
    AskedPath,
    AskOptions,
    FrameName,
    Limit,
    QueryFile,
    QueryLimits,
    Question,
    RowOptions,
    Statements,
    StorePath,
    To,
    Verbs,
    With,
    on_terminal,
    parameters_of,
    query_of,
    say_left_out,
    say_notes,
    say_scope,
    seconds_of,
    tables_of,
    text_of,
)
from sgstore.apps.cli._output import (
    BINARY,
    Format,
    progress,
    say,
    write_binary,
    write_document,
    write_text,
)
from sgstore.base.display import excerpts, number_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from sgstore.apps.sandbox import Answer, Sandbox
    from sgstore.lang.library import NamedPattern
    from sgstore.matches import Interval, Matches

PANEL: Final = "Questions"

verbs = Verbs()


@verbs.command(rich_help_panel=PANEL)
def find(
    store: AskedPath,
    question: Question,
    count: bool = False,
    explain: bool = False,
    require: bool = False,
    safe: bool = False,
    limit: Limit = 0,
    tables: With = None,
    each_frame: Annotated[bool, Option("--rows")] = False,
    *,
    whole: CollectionOptions,
    ask: AskOptions,
) -> int:
    """Find frames whose scene graphs match a pattern.

    One row a match: the frame, its time, and what each variable is bound to; or what RETURN asks for.
    Without RETURN, a terminal shows stretches of frames in which a match lasts.

    Parameters
    ----------
    count
        Print only the number of distinct frames.
    explain
        Print the stages of the query and its SQL.
    require
        End with exit code 4 without matches.
    each_frame
        Print one row for each match and frame, always.
    """
    text, values = question.asked()
    if count and limit:
        raise typer.BadParameter("--limit cannot be combined with --count")
    if (url := url_of(store)) is not None:
        with whole.collection_at(url, ask, tables, safe=safe) as opened:
            found = opened.find(text, **values)
            found = found.limit(limit) if limit else found
            return _write_parted(found, ask, count=count, explain=explain, require=require)
    if safe:
        if count or explain:
            raise typer.BadParameter("--safe cannot be combined with --count or --explain")
        with _sandbox(store, ask, limit, tables) as box:
            answer = box.find(text, **values)
        _say_all(answer)
        number = ask.write(*_as_shown(answer, answer.rows, ask.chosen))
        return _ended(number, ask, require=require)
    opened = ask.opened(store, tables_of(tables))
    if ask.chosen is Format.table and not explain:
        text = _with_names(text)
    with opened.file.snapshot():  # open the store once
        matches = opened.find(text, **values)
        if explain:
            typer.echo(matches.explain())
            return 0
        say_left_out(matches, matches.mistakes)
        if count:
            number = matches.count()
            typer.echo(number)
            _say_absent(matches, number)
            return NO_MATCH if require and not number else 0
        say_scope(getattr(matches, "scope", {}), ask.chosen)
        some = matches.limit(limit) if limit else matches
        if ask.chosen in BINARY and not matches.graphs:
            number = write_binary(some.parquet, ask.chosen, ask.to)
        elif not each_frame and on_terminal(ask) and _returns_nothing(text):
            number = _write_stretches(islice(matches.intervals(), limit or None), ask)
        else:
            number = ask.write(*_as_shown(some, some, ask.chosen))
        _say_absent(matches, number)
    return _ended(number, ask, require=require)


def _with_names(text: str) -> str:
    """Return a query that returns names of nodes, not ids; the same query if that would change its rows."""
    from sgstore.lang.syntax import parse
    from sgstore.lang.syntax.tree import AttributeOf, MatchClause, Variable

    queries = [one for one in parse(text) if isinstance(one, MatchClause)]
    returns = queries[0].returns if len(queries) == 1 else None
    if returns is None or returns.distinct or returns.order or returns.having or queries[0].later:
        return text
    plain = all(
        one.form != "value" or isinstance(one.value, Variable | AttributeOf)
        for one in returns.items
    )
    if not plain or returns.top or returns.sample:
        return text
    steps = [getattr(step, "block", None) for step in queries[0].sequence.steps]
    paths = [path for block in steps if block is not None for path in block.paths]
    nodes = {node.name for path in paths for node in path.nodes}
    for item in reversed(returns.items):
        if isinstance(item.value, Variable) and item.value.name in nodes:
            end = item.value.span.end
            alias = "" if item.name else f" AS {item.value.name}"
            text = f"{text[:end]}.name{alias}{text[end:]}"
    return text


def _say_absent(matches: Matches, number: int) -> None:
    """If a query has no matches, print why, such as a part of the pattern that occurs in no frame."""
    if not number and not matches.mistakes:
        say_notes(matches.notes)


def _returns_nothing(text: str) -> bool:
    """True if a query has no ``RETURN`` clause, so that each match is one row per frame."""
    from sgstore.lang.sql import each_match
    from sgstore.lang.syntax import parse
    from sgstore.lang.syntax.tree import MatchClause

    asked = each_match(parse(text))
    return all(one.returns is None for one in asked if isinstance(one, MatchClause))


def _write_stretches(intervals: Iterator[Interval], ask: AskOptions) -> int:
    """Print intervals of matching frames, and their total length. Return the number of intervals."""
    traces: set[str] = set()
    frames, seconds = 0, 0.0

    def counted() -> Iterator[Interval]:
        nonlocal frames, seconds
        for one in intervals:
            traces.add(one.trace)
            frames, seconds = frames + one.frames, seconds + one.end - one.start
            yield one

    number = _write_intervals(counted(), ask)
    if number:
        parts = (
            number_of(number, "stretch", "es"),
            number_of(frames, "frame"),
            f"{seconds:,.1f} s",
        )
        say(f"{', '.join(parts)} in {number_of(len(traces), 'trace')}; --rows shows each frame")
    return number


def _write_parted(
    matches: Matches, ask: AskOptions, *, count: bool, explain: bool, require: bool
) -> int:
    """Print the results of a query on a collection of stores, and return the exit code."""
    if explain:
        typer.echo(matches.explain())
        return 0
    if count:
        number = matches.count()
        typer.echo(number)
    else:
        say_scope(matches.scope, ask.chosen)
        number = ask.write(*_as_shown(matches, matches, ask.chosen))
    say_left_out(matches)
    if count:
        return NO_MATCH if require and not number else 0
    return _ended(number, ask, require=require)


def _ended(number: int, ask: AskOptions, *, require: bool) -> int:
    """Return the exit code for a number of matches. On a terminal, report that nothing matches."""
    if not number and ask.for_people:
        say("nothing matches")
    return NO_MATCH if require and not number else 0


def _as_shown(
    answer: Matches | Answer, rows: Iterable[tuple[Any, ...]], form: Format
) -> tuple[tuple[str, ...], Iterable[tuple[Any, ...]]]:
    """Return the columns and rows of a query result in the form that an output format needs.

    Tables get readable names of entities. JSON gets graphs in the node-link form of networkx.
    """
    from sgstore.lang.sql import for_people

    if form is Format.table:
        return for_people(answer.columns, rows, graphs=answer.graphs)
    if not answer.graphs or form not in {Format.json, Format.ndjson}:
        return answer.columns, rows
    columns = ("directed", "multigraph", *answer.columns)
    return columns, (
        (True, True, *row[:-1], [{**edge, "key": edge["relation"]} for edge in row[-1]])
        for row in rows
    )


@verbs.command("why-not", rich_help_panel=PANEL)
def why_not(
    store: StorePath,
    frame: FrameName,
    question: Question,
    bounds: QueryLimits,
    as_json: AsJson = False,
) -> int:
    """Explain why a pattern does not match a frame: the first condition that fails, and by how much."""
    text, values = question.asked()
    answer = bounds.opened(store).why_not(frame, text, **values)
    if as_json:
        write_document(answer.as_dict(), Format.json)
    else:
        typer.echo(str(answer))
    return 0


@verbs.command(rich_help_panel=PANEL)
def like(
    store: AskedPath,
    frame: FrameName,
    ignore: list[str] | None = None,
    abstraction: Abstraction = "RSV",
    limit: Limit = 10,
    every: Annotated[bool, Option("--all")] = False,
    describe: bool = False,
    *,
    whole: CollectionOptions,
    out: RowOptions,
    bounds: QueryLimits,
) -> int:
    """Find frames that resemble a frame: frames of the same class, or the most similar frames.

    One row for each trace: its best run of consecutive frames that are as like as each other. It says how
    many, how like, whether the graphs are the same, and what only the example has, or only they.
    Frames less than 5 s from the example are left out; --all takes them, and every run, too.

    Parameters
    ----------
    ignore : NAME
        Ignore a relation or a kind; repeatable.
    every
        Show all runs of a trace, not only the best, and those near the frame.
    describe
        Print a pattern that describes the frame instead.
    """
    opened = whole.opened_at(store, bounds)
    if describe:
        write_text(f"{opened.pattern(frame, ignore=ignore or ())}\n", out.to)
        return 0
    found = opened.like(
        frame,
        abstraction=abstraction,
        ignore=ignore or (),
        limit=limit or 10**9,
        each_trace=not every,
    )
    if out.for_people:
        columns = ("frame", "t", "frames", "similarity", "same", "missing", "extra")
        rows = (
            (
                f"{one.frame.trace}#{one.frame.seq}",
                round(one.frame.t, 3),
                one.frames,
                round(one.similarity, 3),
                one.same,
                _differing(one.missing),
                _differing(one.extra),
            )
            for one in found
        )
        out.write(columns, rows)
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
    out.write(columns, rows)
    return 0


_FEATURES_SHOWN: Final = 3
"""Number of features in a cell of a text table. Further ones are counted. Other formats have all features."""


def _differing(features: dict[str, int]) -> str:
    """Return a text with the first few differing features and their counts, and how many more differ."""
    shown = [f"{n} x {text}" if n > 1 else text for text, n in features.items()]
    more = shown[_FEATURES_SHOWN:]
    return ", ".join([*shown[:_FEATURES_SHOWN], *([f"… {len(more)} more"] if more else [])])


@verbs.command(rich_help_panel=PANEL)
def translate(
    file: Path,
    language: Annotated[Literal["sgl"], Option("--from")] = "sgl",
    to: To = None,
) -> int:
    """Translate properties of other tools into the query language, without running any code of the file.

    Parameters
    ----------
    file : FILE
        File to translate; - reads stdin.
    language
        sgl: properties of SGSM, as Python.
    """
    from sgstore.lang.contrib.sgsm import translated

    write_text(translated(text_of(file)), to)
    return 0


@verbs.command(rich_help_panel=PANEL)
def sql(
    store: AskedPath,
    statement: Annotated[str | None, Argument()] = None,
    file: QueryFile = None,
    safe: bool = False,
    limit: Limit = 0,
    tables: With = None,
    each: Annotated[bool, Option("--each", rich_help_panel=COLLECTIONS)] = False,
    *,
    whole: CollectionOptions,
    ask: AskOptions,
) -> int:
    """Run a read-only SQL statement on a store, or on the topics of a recording.

    'SHOW TABLES' lists the views, such as frames, nodes, edges, pairs and world_pairs; 'DESCRIBE nodes'
    their columns; 'sgstore docs views' explains them.
    What a pattern returns is a table, too: FROM sgql('MATCH … RETURN …'); and messages: FROM topic('/imu').

    Parameters
    ----------
    statement : SQL
        'SELECT … FROM frames, nodes, edges …'
    each
        Run it in each bundle of a collection, with a column 'bundle'.
    """
    if (url := url_of(store)) is not None:
        with whole.collection_at(url, ask, tables, safe=safe) as opened:
            rows = opened.sql(query_of(statement, file), each=each)
            say_scope(rows.scope, ask.chosen)
            shown = ((shown_bundle(row[0], ask), *row[1:]) for row in rows)
            ask.write(rows.columns, islice(shown, limit or None))
            say_left_out(rows)
            return 0
    if safe:
        with _sandbox(store, ask, limit, tables) as box:
            answer = box.sql(query_of(statement, file))
        _say_all(answer)
        ask.write(answer.columns, answer.rows)
        return 0
    if store.suffix not in completion.STORE_ENDINGS and _is_recording(store):
        from sgstore.store import StoreFile

        seconds = seconds_of(ask.timeout, "--timeout") if ask.timeout else None
        text = query_of(statement, file)
        number = _write_sql(StoreFile.recording_sql(store, text, seconds), limit, ask)
        if not number and text.split()[0].upper() == "SHOW":
            topics = excerpts([f"topic('{name}')" for name in StoreFile.recorded_topics(store)])
            say(f"the tables of a recording are its topics: {topics or 'none'}")
        return 0
    from sgstore.query import UserStatement

    opened = ask.opened(store, tables_of(tables))
    with opened.file.snapshot():
        asked = UserStatement(opened.find, opened.catalog().tables, query_of(statement, file))
        say_left_out(asked)
        say_scope(asked.scope(opened.file), ask.chosen)
        _write_sql(asked.on(opened.file), limit, ask)
    return 0


def _is_recording(path: Path) -> bool:
    from sgstore.readers import is_recording

    return path.exists() and is_recording(path)


def _write_sql(sql: Any, limit: int, ask: AskOptions) -> int:
    """Write the rows of an SQL statement in the chosen format, and return their number."""
    if (form := ask.chosen) in BINARY and not limit:
        return write_binary(sql.parquet, form, ask.to)
    with sql.batches() as batches:
        rows = chain.from_iterable(batch.values for batch in batches)
        if ask.for_people and batches.columns[:2] == ("column_name", "column_type"):
            rows = ((name, _short_type(kind), *more) for name, kind, *more in rows)
        return ask.write(batches.columns, islice(rows, limit or None), batches.types)


def _short_type(kind: str) -> str:
    """Return a column type without the values of an enumeration, except the first ones."""
    values = re.findall(r"'(?:[^']|'')*'", kind) if kind.startswith("ENUM(") else []
    if len(values) <= _VALUES_SHOWN:
        return kind
    return f"ENUM({', '.join(values[:_VALUES_SHOWN])}, … {len(values)} values)"


_VALUES_SHOWN: Final = 3
"""Largest number of values of an enumeration in a text table. Other formats have all values."""


def _sandbox(store: Path, bounds: QueryLimits, limit: int, tables: list[str] | None) -> Sandbox:
    from sgstore.apps.sandbox import Sandbox

    if bounds.max_spill is not None:
        raise typer.BadParameter("--max-spill cannot be combined with --safe, which uses no disk")
    return Sandbox(
        store,
        timeout_s=seconds_of(bounds.timeout or "5s", "--timeout"),
        max_rows=limit or 10_000,
        tables=tables_of(tables),
    )


def _say_all(answer: Answer) -> None:
    say_left_out(answer)
    if answer.truncated:
        say(f"only the first {number_of(len(answer.rows), 'row')}; --limit sets how many")


library = Verbs(
    name="patterns",
    help="List, search, show and run the named patterns of the library.",
    no_args_is_help=True,
)

LibraryName = Annotated[str, Argument(autocompletion=completion.patterns)]


class Kind(StrEnum):
    """Kind of a library pattern: predicate, concept, scenario or property."""

    predicate = "predicate"
    concept = "concept"
    scenario = "scenario"
    property = "property"


PatternKinds = Annotated[list[Kind] | None, Option("--kind")]


@library.command("list")
def list_patterns(
    kinds: PatternKinds = None,
    *,
    out: RowOptions,
) -> int:
    """List the patterns of the library with their meanings.

    Predicates are conditions that every query may use; concepts and scenarios are found by their
    names; properties are rules that a trace keeps or violates.
    """
    from sgstore.lang.library import patterns

    _write_patterns([p for p in patterns().values() if not kinds or p.kind in kinds], out)
    return 0


def _write_patterns(found: list[NamedPattern], out: RowOptions) -> None:
    if out.for_people:
        columns = ("name", "kind", "from", "sentence")
        rows = [(p.name, p.kind, p.library, p.sentence) for p in found]
    else:
        columns = ("name", "kind", "library", "sentence", "parameters", "source", "query")
        rows = [(*_told(p).values(),) for p in found]
    out.write(columns, rows)


@library.command("search")
def search_patterns(
    words: list[str],
    kinds: PatternKinds = None,
    *,
    out: RowOptions,
) -> int:
    """Search the patterns of the library by words, with the best match first.

    Parameters
    ----------
    words : WORD…
        Words, in any order: pedestrian crossing.
    """
    from sgstore.lang.library import search

    _write_patterns(search(" ".join(words), [*(kinds or ())]), out)
    return 0


@library.command("show")
def show_pattern(name: LibraryName, as_json: AsJson = False, to: To = None) -> int:
    """Print a pattern: its text, parameters, source, and a scene in which it is true.

    What is printed is a query, its remarks being comments: it can be changed and asked with find -f.
    """
    from sgstore.lang.library import pattern_named

    found = pattern_named(name)
    if as_json:
        write_document({**_told(found), "example": found.example}, Format.json)
    else:
        write_text(_for_people(found), to)
    return 0


@library.command("run")
def run_pattern(
    store: StorePath,
    name: Annotated[str, Argument(autocompletion=completion.patterns)] = "",
    chosen: Annotated[list[str] | None, Argument()] = None,
    every: Annotated[bool, Option("--all")] = False,
    clips: bool = False,
    before: str = "0s",
    after: str = "0s",
    require: bool = False,
    *,
    ask: AskOptions,
) -> int:
    """Find a pattern of the library in a store: times of the matches, and their entities.

    Of a property: whether each trace keeps it, and where it does not.

    Parameters
    ----------
    name : NAME
        Name of a pattern, such as cut_in or ParkingExit.
    chosen : NAME=VALUE
        Parameters of the pattern, such as within=2s.
    every
        Count the matches of all concepts and scenarios, in one run.
    clips
        Print clips (trace, start_ns, end_ns) in log time.
    before : TIME
        Time before each match, with --clips.
    after : TIME
        Time after each match, with --clips.
    require
        End with exit code 4 without matches, or if the property is violated.
    """
    from sgstore.lang.library import pattern_named

    if every == bool(name) or (every and clips):
        raise typer.BadParameter("add the name of a pattern, or --all without a name and --clips")
    offsets = seconds_of(before, "--before"), seconds_of(after, "--after")
    if every:
        return _run_all(store, ask, require=require)
    found = pattern_named(name)
    if found.kind == "predicate":
        hint = f"a condition: ask 'sgstore find STORE \"MATCH … WHERE {found.name}(…)\"'"
        raise typer.BadParameter(f"{found.name} is {hint}")
    if found.is_check:
        if clips:
            raise typer.BadParameter(f"{found.name} is a property, which has verdicts and no clips")
        statements = Statements([found.name], parameters=chosen)
        from sgstore.apps.cli._checks import check  # only here: the verb is none of this module's

        whole = CollectionOptions()
        return check(store, whole=whole, statements=statements, require=require, ask=ask)
    text = found.written(**parameters_of(chosen))
    matches = ask.opened(store).find(text)
    say_left_out(matches)
    if clips:
        rows = ((c.trace, c.start_ns, c.end_ns) for c in matches.clips(*offsets))
        number = ask.write(("trace", "start_ns", "end_ns"), rows)
    else:
        number = _write_intervals(matches.intervals(), ask)
    return _ended(number, ask, require=require)


def _run_all(store: Path, ask: AskOptions, *, require: bool) -> int:
    """Print the number of matches of each concept and scenario of the library, and return the exit code."""
    from sgstore.lang.library import patterns

    opened, total = ask.opened(store), 0
    asked = [one for one in patterns().values() if one.kind in {"concept", "scenario"}]

    def rows() -> Iterator[tuple[Any, ...]]:
        nonlocal total
        with opened.file.shared():
            for one in progress(asked, "patterns"):
                matches = opened.find(one.text)
                traces = [found.trace for found in matches.intervals()]
                total += len(traces)
                yield one.name, one.kind, len(traces), len({*traces}), len(matches.left_out)

    ask.write(("name", "kind", "matches", "traces", "left_out"), rows())
    return _ended(total, ask, require=require)


def _write_intervals(intervals: Iterator[Interval], ask: AskOptions) -> int:
    """Print intervals of matching frames as rows, and return their number.

    Tables contain the names of the entities instead of node ids.
    """
    from sgstore.matches import intervals_for_people

    if ask.for_people:
        return ask.write(*intervals_for_people(intervals))
    first = next(intervals, None)
    if first is None:
        return ask.write((), [])
    columns = ("trace", "start_seq", "end_seq", "start", "end", "frames", *first.values)
    rows = (
        (i.trace, i.start_seq, i.end_seq, i.start, i.end, i.frames, *i.values.values())
        for i in chain([first], intervals)
    )
    return ask.write(columns, rows)


def _told(found: NamedPattern) -> dict[str, Any]:
    """Return a library pattern as a dictionary for JSON output."""
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
    """Return a library pattern as query text. Comments explain the pattern and its default parameters."""
    head = [f"{found.name}: {found.sentence}", f"source: {found.source}"]
    head += [f"param {p.name} = {p.default}: {p.meaning}" for p in found.parameters.values()]
    head += ["", *found.example.splitlines()] if found.example else []
    comments = [f"-- {line}".rstrip() for line in head]
    return "\n".join([*comments, found.text, ""])
