"""Errors of the command line as data."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from sgstore.cli import run
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def store(tmp_path: Path) -> str:
    StoreFile.create(tmp_path / "empty.sgstore")
    return str(tmp_path / "empty.sgstore")


@pytest.mark.parametrize("how", [["--json"], ["--format", "ndjson"], ["--format=json"]])
def test_a_mistake_in_a_query_is_told_as_data(how: list[str], store: str, capsys) -> None:
    query = "MATCH (e:Ego)\nWHERE e.sped > 3"

    code = run(["find", store, query, *how])

    out, err = capsys.readouterr()
    assert (code, out) == (2, "")
    assert json.loads(err) == {
        "error": "QueryNameError",
        "reason": "unknown attribute 'sped'",
        "hint": "did you mean 'speed'?",
        "start": query.index("sped"),
        "end": query.index("sped") + 4,
        "line": 2,
        "column": 9,
    }


def test_in_a_sandbox_it_is_the_same(store: str, capsys) -> None:
    run(["find", store, "MATCH (e:Eggo)", "--json", "--safe", "--timeout", "20s"])

    error = json.loads(capsys.readouterr().err)

    assert (error["error"], error["reason"], error["start"]) == (
        "QueryNameError",
        "unknown label 'Eggo'",
        9,
    )


@pytest.mark.parametrize(
    ("arguments", "error", "code"),
    [
        (["sql", "{0}", "SELEKT 1", "--json"], "SqlError", 2),
        (["find", "{0}.none", "MATCH (e)", "--json"], "StoreError", 1),
        (["like", "{0}", "town#3", "--json"], "StoreError", 1),
    ],
)
def test_other_errors_are_data_too(arguments, error, code, store: str, capsys) -> None:
    assert run([argument.format(store) for argument in arguments]) == code

    told = json.loads(capsys.readouterr().err)
    assert told["error"] == error
    assert told["reason"]


def test_a_parameter_may_be_a_list_as_in_json(store: str, capsys) -> None:
    query = "MATCH (v:Vehicle) WHERE v.kind IN $kinds"

    assert run(["find", store, query, "--param", 'kinds=["car", "bus"]', "--count"]) == 0
    assert run(["find", store, query, "--param", 'kinds=["car", "buss"]']) == 2
    assert "unknown kind 'buss'" in capsys.readouterr().err
    assert run(["find", store, query, "--param", "kinds=[car"]) == 2
    assert "expected a list as in JSON" in capsys.readouterr().err


def test_for_people_it_is_shown_with_carets(store: str, capsys) -> None:
    assert run(["find", store, "MATCH (e:Eggo)"]) == 2

    assert "^^^^" in capsys.readouterr().err
