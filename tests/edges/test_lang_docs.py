"""Every query in the documentation is run, and everything that the language knows is documented."""

from __future__ import annotations

import os
import re
from pathlib import Path

import duckdb
import pytest
from oracle_worlds import SCHEMA, add_chains
from test_lang_golden import CATALOG

from sgstore.errors import QueryError
from sgstore.lang import catalog
from sgstore.lang.bind import FUNCTIONS
from sgstore.lang.library import patterns, predicates
from sgstore.lang.sql import compile_checks, compile_query
from sgstore.model.pair_numbers import PAIR_FUNCTIONS
from sgstore.model.vocabulary import KINDS, RELATIONS

PATH = Path(__file__).parents[2] / "docs" / "language.md"
PAGE = PATH.read_text(encoding="utf-8")
QUERIES = re.findall(r"```sgql\n(.*?)```", PAGE, re.DOTALL)


def words() -> set[str]:
    """Words of the page as it is now: a test below may have written its table."""
    return set(re.findall(r"[A-Za-z_][\w]*", PATH.read_text(encoding="utf-8")))


def database() -> duckdb.DuckDBPyConnection:
    """A database with the views of a store without traces, and the table of chains that a store adds."""
    connection = duckdb.connect()
    connection.execute(SCHEMA)
    add_chains(connection)
    return connection


@pytest.mark.parametrize("text", QUERIES)
def test_a_query_of_the_page_compiles_and_runs(text: str) -> None:
    connection = database()

    statement = compile_query(text, CATALOG).rows()

    assert connection.execute(statement.sql, list(statement.values)).fetchall() == []


@pytest.mark.parametrize("text", re.findall(r"```sgql-check\n(.*?)```", PAGE, re.DOTALL))
def test_a_check_of_the_page_is_bound(text: str) -> None:
    assert len(compile_checks(text, CATALOG)) == text.count("CHECK")


def test_there_are_queries_on_the_page() -> None:
    assert len(QUERIES) > 10


def test_the_table_of_numbers_of_pairs_is_that_of_the_declarations() -> None:
    page = PATH.read_text(encoding="utf-8")
    begin, end = "<!-- numbers of pairs, made from sgstore/model/pair_numbers -->\n", "<!-- end -->"
    of_pairs = [name for name, one in PAIR_FUNCTIONS.items() if one.view == "pairs"]
    rows = [f"| `{name}(a, b)` | {PAIR_FUNCTIONS[name].meaning} |\n" for name in of_pairs]
    others = ", ".join(f"`{name}`" for name in PAIR_FUNCTIONS if name not in of_pairs)
    measures = f"\n[Measures of criticality](criticality.md) of (a, b): {others}.\n"
    table = "".join(["| function | is |\n|---|---|\n", *rows, measures])
    head, rest = page.split(begin)
    expected = f"{head}{begin}{table}{end}{rest.partition(end)[2]}"
    if os.environ.get("SGSTORE_UPDATE_GOLDEN"):
        PATH.write_text(expected, encoding="utf-8")
        page = expected

    assert page == expected


@pytest.mark.parametrize(
    "known",
    [
        pytest.param([a.name for a in catalog.NODE_ATTRIBUTES.values()], id="attributes of nodes"),
        pytest.param([a.name for a in catalog.EDGE_ATTRIBUTES.values()], id="attributes of edges"),
        pytest.param([a.name for a in catalog.FRAME_ATTRIBUTES.values()], id="of frames"),
        pytest.param([a.name for a in catalog.TRACE_ATTRIBUTES.values()], id="of traces"),
        pytest.param([*PAIR_FUNCTIONS], id="functions of pairs"),
        pytest.param(
            [p.name for p in patterns().values() if p.library == "std"], id="standard predicates"
        ),
        pytest.param([*KINDS], id="kinds"),
        pytest.param([*RELATIONS], id="relations"),
    ],
)
def test_what_the_language_knows_is_on_the_page(known: list[str]) -> None:
    assert set(known) - words() == set()


def test_every_function_is_on_the_page() -> None:
    assert {f.lower() for f in FUNCTIONS} - {word.lower() for word in words()} == set()


@pytest.mark.parametrize("name", predicates())
def test_a_predicate_of_the_library_can_be_asked(name: str) -> None:
    definition = predicates()[name]
    arguments = [parameter.name for parameter in definition.parameters]
    labels = {"j": "Junction", "l": "Lane"}
    values = {"s": "1", "zone": "'merge'"}
    nodes = (
        ", ".join(f"({a}:{labels.get(a, 'Vehicle')})" for a in arguments if a not in values)
        or "(:Ego)"
    )
    arguments = [values.get(argument, argument) for argument in arguments]
    connection = database()

    compiled = compile_query(
        f"MATCH {nodes} WHERE {definition.name}({', '.join(arguments)})", CATALOG
    )

    assert connection.execute(compiled.count().sql, list(compiled.count().values)).fetchall() == [
        (0,)
    ]


def test_an_own_predicate_hides_one_of_the_library() -> None:
    text = "DEFINE PREDICATE stopped(x) AS x.speed = 77; MATCH (v:Car) WHERE stopped(v)"

    assert 77 in compile_query(text, CATALOG).rows().values


def test_a_mistake_in_a_predicate_is_told_at_its_call() -> None:
    with pytest.raises(
        QueryError, match=r"in stopped\(\): a lane has no attribute 'speed'"
    ) as caught:
        compile_query("MATCH (l:Lane) WHERE stopped(l)", CATALOG)

    assert caught.value.span is not None
    assert caught.value.text[caught.value.span.start : caught.value.span.end] == "stopped(l)"
