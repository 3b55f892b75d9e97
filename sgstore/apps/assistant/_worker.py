"""Queries of an AI assistant, run in the sandbox process.

A query is ``{"ask": NAME, "with": {…}}``, where the name is a key of :data:`ANSWERS`. A reply with
a list has ``columns`` and ``rows``, ``truncated`` if there are more rows, ``total`` with the number
of all rows (not for rows of a query or of SQL, which are read only up to the limit), ``left_out``
with the traces that cannot answer and their reasons, and ``notes``.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from sgstore.apps.sandbox import plain, serve
from sgstore.apps.verbs import by_lane
from sgstore.errors import QueryError
from sgstore.lang.help import words
from sgstore.lang.library import pattern_named
from sgstore.lang.sql import for_people
from sgstore.matches import intervals_for_people

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from sgstore.matches import Matches
    from sgstore.query import Store
    from sgstore.testsets.coverage import ChosenFrames, ReportTable

    Reply = dict[str, Any]


def answer(store: Store, question: Mapping[str, Any], most: int) -> Reply:
    """Return the reply of the sandbox process to a query of an assistant."""
    about = dict(question["with"])
    about["limit"] = min(about.get("limit", most), most)
    if question["ask"] in _OF_TRACES:
        store = store.only(*about.pop("traces"))
    return plain(ANSWERS[question["ask"]](store, **about))


_OF_TRACES: Final = {"find", "check"}
"""Kinds of questions for which the sandbox process searches only the listed traces."""


def _listed(
    columns: Sequence[str], rows: Iterable[Sequence[Any]], limit: int, **about: Any
) -> Reply:
    """Return a reply with at most ``limit`` rows, and the number of all rows."""
    some = iter(rows)
    found = list(islice(some, limit))
    total = len(found) + sum(1 for _ in some)
    return _cut(columns, found, truncated=total > limit) | {"total": total, **about}


def _listed_first(
    columns: Sequence[str], rows: Iterable[Sequence[Any]], limit: int, **about: Any
) -> Reply:
    """Return a reply with at most ``limit`` rows. It reads one row more, to know if there are more."""
    found = list(islice(rows, limit + 1))
    return _cut(columns, found[:limit], truncated=len(found) > limit) | about


def _cut(columns: Sequence[str], rows: Sequence[Sequence[Any]], *, truncated: bool) -> Reply:
    return {"columns": columns, "rows": rows, "truncated": truncated}


def _named(text: str, parameters: Mapping[str, Any], *, check: bool) -> tuple[str, dict[str, Any]]:
    """Return the text of a query and the values of its parameters. The text may name a library pattern.

    Raises
    ------
    QueryError
        The name is unknown, or has another kind than required.
    """
    name = text.strip()
    if not name.isidentifier():
        return text, dict(parameters)
    found = pattern_named(name)
    if found.kind == "predicate":
        raise QueryError(
            f"{found.name} is a condition, and no pattern: {found.sentence}",
            hint=f"use it in a query: MATCH (e:Ego), (v:Vehicle) WHERE {found.name}(…)",
        )
    if found.is_check is not check:
        what = ("a rule", "check") if found.is_check else ("a pattern", "find")
        raise QueryError(f"{found.name} is {what[0]}", hint=f"ask it with the tool {what[1]}")
    return found.written(**parameters), {}


def _found(
    store: Store, text: str, parameters: Mapping[str, Any]
) -> tuple[Matches, dict[str, Any]]:
    """Return the matches of a query. Also return traces that cannot answer it, and likely mistakes."""
    asked, values = _named(text, parameters, check=False)
    matches = store.find(asked, **values)
    return matches, {"left_out": matches.reasons, "notes": matches.notes}


def _traces(store: Store, limit: int) -> Reply:
    columns = ("trace", "frames", "seconds", "hz", "ego", "map", "flavour", "losses")
    rows = (
        (
            one.name,
            one.frames,
            round(one.seconds, 3),
            round(1e9 / one.period_ns, 2) if one.period_ns else None,
            one.ego,
            one.map,
            one.flavour,
            len(one.report["losses"]),
        )
        for one in store.traces()
    )
    return _listed(columns, rows, limit)


def _find(store: Store, limit: int, query: str, parameters: Mapping[str, Any], form: str) -> Reply:
    matches, about = _found(store, query, parameters)
    if form == "count":
        return _listed(("frames",), [(matches.count(),)], 1, **about)
    if form == "frames":
        frames = ((f"{one.trace}#{one.seq}", round(one.t, 3)) for one in matches.frames())
        return _listed(("frame", "t"), frames, limit, **about)
    if form == "intervals":
        return _listed(*intervals_for_people(matches.intervals()), limit, **about)
    rows = for_people(matches.columns, matches, graphs=matches.graphs)
    return _listed_first(*rows, limit, **about)


def _sql(store: Store, limit: int, statement: str) -> Reply:
    rows = store.sql(statement, max_rows=limit)
    listed = _listed_first(rows.columns, rows.values, limit, left_out=dict(rows.reasons))
    return listed | {"truncated": rows.truncated}


def _why_not(
    store: Store, limit: int, frame: str, query: str, parameters: Mapping[str, Any]
) -> Reply:
    del limit
    asked, values = _named(query, parameters, check=False)
    told = store.why_not(frame, asked, **values)
    return {"text": str(told), **told.as_dict()}


def _check(store: Store, limit: int, text: str, parameters: Mapping[str, Any]) -> Reply:
    from sgstore.temporal import columns_returned, verdict_columns, verdict_rows

    asked, values = _named(text, parameters, check=True)
    run = store.check(asked, **values)
    told: dict[str, Any] = {"margin": run.quantitative, "returned": columns_returned(run.returned)}
    tally: Counter[str] = Counter()
    rows, unknown, total = list[tuple[Any, ...]](), dict[str, str](), 0
    for verdict in run:
        tally[verdict.verdict] += 1
        if verdict.reason:
            unknown[verdict.trace] = verdict.reason
        own = list(verdict_rows(verdict, **told))
        rows += own[: limit - len(rows)]
        total += len(own)
    listed = _cut(verdict_columns(**told), rows, truncated=total > limit) | {"total": total}
    return {**listed, "verdicts": dict(tally), "left_out": unknown, "notes": run.notes}


def _bindings(
    store: Store, limit: int, frame: str, query: str, parameters: Mapping[str, Any]
) -> Reply:
    del limit
    matches, about = _found(store, query, parameters)
    with store.file.snapshot():
        ref = store.file.frame(frame)
        found = [] if ref.trace in matches.reasons else matches.bindings(ref)
    return {"bindings": found, **about}


def _clips(
    store: Store,
    limit: int,
    query: str,
    parameters: Mapping[str, Any],
    before: float,
    after: float,
) -> Reply:
    matches, about = _found(store, query, parameters)
    rows = ((one.trace, one.start_ns, one.end_ns) for one in matches.clips(before, after))
    return _listed(("trace", "start_ns", "end_ns"), rows, limit, **about)


def _timeline(store: Store, limit: int, queries: Sequence[str], traces: Sequence[str]) -> Reply:
    from sgstore.draw import timelines

    only = [store.file.trace(name).name for name in traces]
    found = [asdict(one) for one in timelines(store, by_lane(queries, {}), only)]
    return {"timelines": found[:limit], "truncated": len(found) > limit, "total": len(found)}


def _missing(  # noqa: PLR0913, PLR0917  what coverage is measured of, and by
    store: Store,
    limit: int,
    frames: str,
    reference: str,
    cells: str,
    abstraction: str,
    k: int,
    of_ego: bool,  # noqa: FBT001
) -> Reply:
    from sgstore.testsets.coverage import classed, combos, specification

    measured = _chosen(store, frames)
    other = _chosen(store, reference) if reference or frames else None
    if cells:
        asked, _ = _named(cells, {}, check=False)
        shares, _, missing = specification(measured, asked, 0, other or "")
    else:
        pair = [classed(one, abstraction) for one in (measured, other) if one is not None]
        found = combos(pair[0], abstraction, k, *pair[1:], of_ego=of_ego)
        shares, missing = found.shares, found.missing
        if other is None:
            missing = missing.without("frames_in_reference")
    return _listed(missing.columns, missing.rows, limit, **_shares(shares, measured, other))


def _shares(
    shares: ReportTable, measured: ChosenFrames, other: ChosenFrames | None
) -> dict[str, Any]:
    (row,) = shares.dicts()
    left_out = {**measured.reasons, **(other.reasons if other else {})}
    return {
        "share": row,
        "missing": row["of"] - row["part"],
        "left_out": left_out,
        "said": shares.said,
    }


def _chosen(store: Store, query: str) -> ChosenFrames:
    """Return the frames that match a query; all frames of the store if the query is empty."""
    from sgstore.testsets.coverage import ChosenFrames, frames_of

    if not query:
        return ChosenFrames("the store", store)
    asked, _ = _named(query, {}, check=False)
    return ChosenFrames(query, store, frames_of(store, asked), store.find(asked).reasons)


def _views(store: Store, limit: int) -> Reply:
    del limit
    meanings = dict(
        store.sql(
            "SELECT view_name, comment FROM duckdb_views()"
            " WHERE schema_name = 'main' AND NOT internal ORDER BY view_oid"
        ).values
    )
    columns: dict[str, list[str]] = {}
    for view, column, kind in store.sql(
        "SELECT table_name, column_name, data_type FROM information_schema.columns"
        " WHERE table_schema = 'main' ORDER BY ordinal_position"
    ):
        # Enumerations would list all values; they are in the vocabulary.
        short = "word" if kind.startswith("ENUM") else kind.lower()
        columns.setdefault(view, []).append(f"{column} {short}")
    views = {name: {"meaning": meanings[name], "columns": columns[name]} for name in meanings}
    return {"views": views}


def _vocabulary(store: Store, limit: int) -> Reply:
    """Return the kinds and relations that occur in a store, with their counts."""
    del limit
    catalog = store.catalog()
    relations: Counter[str] = Counter()
    ends: dict[str, tuple[set[str], set[str]]] = {}
    for edges in (catalog.edges, catalog.map_edges):
        for (relation, source, target), rows in edges.items():
            relations[relation] += rows
            sources, targets = ends.setdefault(relation, (set(), set()))
            sources.add(source)
            targets.add(target)
    kinds = store.sql("SELECT kind, count(*) FROM entities GROUP BY kind ORDER BY 2 DESC, 1")
    return {
        "kinds": dict(kinds.values),
        "map_kinds": sorted(catalog.mapped),
        "relations": {
            name: [sorted(one) for one in ends[name]] for name, _ in relations.most_common()
        },
        "unknown": {
            trace.name: sorted(set(relations) - trace.answers)
            for trace in catalog.traces
            if set(relations) - trace.answers
        },
        "own": {name: str(kind) for name, kind in catalog.own.items()},
        "tables": {name: list(table.columns) for name, table in catalog.tables.items()},
        "topics": {
            name: [f"{one['name']} ({one['meaning']})" for one in fields]
            for name, fields in words(catalog)["topics"].items()
        },
    }


ANSWERS: Final = {
    "traces": _traces,
    "vocabulary": _vocabulary,
    "views": _views,
    "find": _find,
    "sql": _sql,
    "why_not": _why_not,
    "check": _check,
    "bindings": _bindings,
    "clips": _clips,
    "timeline": _timeline,
    "missing": _missing,
}
"""Kind of a question → function that answers it. Its argument ``limit`` is the largest number of rows."""


def main() -> None:
    """Answer queries in the sandbox process."""
    serve(answer)
