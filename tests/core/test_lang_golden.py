"""Queries with the SQL, or the message, that they give: text files in ``golden/``, compared and run.

A file holds cases between lines of ``====``: a query, then ``---- sql`` or ``---- error``. To write the
second parts anew, set ``SGSTORE_UPDATE_GOLDEN=1``, and read the difference as code.
"""

from __future__ import annotations

import os
from pathlib import Path

import duckdb
import pytest
from oracle_worlds import SCHEMA

from sgstore.errors import QueryError
from sgstore.lang.bind import bind_checks
from sgstore.lang.catalog import Catalog, TraceFacts
from sgstore.lang.sql import compile_query
from sgstore.lang.syntax import parse

FOLDER = Path(__file__).parents[1] / "golden"
FILES = sorted(FOLDER.glob("*.txt"))
UPDATE = bool(os.environ.get("SGSTORE_UPDATE_GOLDEN"))

CATALOG = Catalog(
    edges={
        ("isIn", "car", "lane"): 9000,
        ("isIn", "truck", "lane"): 900,
        ("isIn", "person", "lane"): 50,
        ("isIn", "person", "crosswalk"): 20,
        ("isIn", "car", "off_road"): 3,
        ("near", "car", "car"): 5000,
        ("near", "car", "person"): 300,
        ("near", "person", "car"): 300,
        ("near_coll", "car", "person"): 30,
        ("visible", "car", "person"): 900,
        ("visible", "car", "car"): 8000,
        ("controlsTrafficOf", "traffic_light", "lane"): 40,
    },
    map_edges={
        ("isIn", "lane", "road"): 200,
        ("isIn", "road", "junction"): 20,
        ("opposes", "lane", "lane"): 80,
        ("travelsTo", "lane", "lane"): 150,
        ("controlsTrafficOf", "stop_sign", "lane"): 4,
    },
    moving=frozenset({"car", "truck", "person", "traffic_light"}),
    fixed=frozenset({"prop"}),
    mapped=frozenset({"lane", "road", "junction", "crosswalk", "off_road", "stop_sign"}),
    traces=(
        TraceFacts(1, "one", "7", frozenset({"isIn", "near", "near_coll", "visible", "travelsTo"})),
        TraceFacts(2, "two", "8", frozenset({"isIn", "near", "near_coll", "visible"})),
    ),
)


@pytest.fixture(scope="module")
def empty() -> duckdb.DuckDBPyConnection:
    connection = duckdb.connect()
    connection.execute(SCHEMA)
    return connection


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_queries_give_golden_results(path: Path, empty: duckdb.DuckDBPyConnection) -> None:
    cases = [case.strip("\n").split("\n---- ") for case in path.read_text("utf-8").split("====\n")]
    given = [f"{query}\n---- {outcome(query, empty)}" for query, *_ in cases]
    expected = ["\n---- ".join(case) for case in cases]

    if UPDATE:
        path.write_text("\n====\n".join(given) + "\n", encoding="utf-8")
    assert given == expected


def outcome(query: str, empty: duckdb.DuckDBPyConnection) -> str:
    if query.startswith("CHECK bound:"):
        with pytest.raises(QueryError) as refused:
            bind_checks(query, parse(query), lambda _: CATALOG, {})
        return f"error\n{refused.value}"
    try:
        statement = compile_query(query, CATALOG).rows()
    except QueryError as error:
        return f"error\n{error}"
    result = empty.execute(statement.sql, list(statement.values))
    assert tuple(column[0] for column in result.description) == statement.columns
    values = "".join(f"\n${i} = {value!r}" for i, value in enumerate(statement.values, start=1))
    return f"sql\n{statement.sql}{values}"


TO_IMPROVE = sorted((FOLDER / "to_improve").glob("*.txt"))
"""Errors that should be better: queries with the message that they give, and the one that is wanted."""


@pytest.mark.parametrize("path", TO_IMPROVE, ids=lambda path: path.stem)
def test_error_texts_marked_as_weak_are_unchanged(path: Path, empty) -> None:
    for case in path.read_text("utf-8").split("====\n"):
        query, now, wanted = case.strip("\n").split("\n---- ")

        assert outcome(query, empty) == now, "move the case to a golden file if it is good now"
        assert wanted.removeprefix("wanted\n").strip() not in now


def test_golden_files_exist() -> None:
    assert {path.stem for path in FILES} >= {"patterns", "blocks", "results", "syntax_errors"}
