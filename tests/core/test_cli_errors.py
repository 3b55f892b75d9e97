"""Errors of the command line as data."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from sgstore.apps.cli import run
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


@pytest.mark.parametrize(
    ("verb", "query"),
    [("find", "MATCH (e:Ego) RETURN e.speed"), ("check", "--expression=CHECK ego.speed < 9")],
)
def test_the_name_of_a_file_says_how_rows_are_written_or_is_refused(
    verb: str, query: str, store: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    codes = [run([verb, store, query, "-o", str(tmp_path / n)]) for n in ("rows.csv", "rows.xlsx")]

    assert codes == [0, 2]
    assert (tmp_path / "rows.csv").read_text().startswith(("e.speed\n", "check,trace,"))
    assert not (tmp_path / "rows.xlsx").exists()
    assert "expected one of .csv, .json" in capsys.readouterr().err.replace("\n", " ")


def test_a_file_that_is_no_store_is_told_so_whatever_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")

    assert run(["find", str(tmp_path / "x.csv"), "MATCH (e:Ego)"]) == 1
    assert "not a store; expected a file that 'sgstore ingest' made" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "answer"),
    [
        (["ls"], "write: sgstore info"),
        (["query", "a"], "write: sgstore find"),
        (["coverage", "a.sgstore"], "write: sgstore coverage classes a.sgstore"),
        (["lock", "a.sgstore"], "write: sgstore select a.sgstore -o tests.lock"),
        (["a.sgstore"], "write: sgstore info a.sgstore"),
        (["a.mcap"], "write: sgstore doctor a.mcap"),
        (["lock", "tests.lock"], "write: sgstore lock list tests.lock"),
        (["fnd", "a.sgstore", "cut_in"], "write: sgstore find a.sgstore cut_in"),
        (["find", "a.sgstore", "--lmit", "3"], "write: sgstore find a.sgstore --limit 3"),
        (["find", "a.sgstore", "--top=3"], "write: sgstore find a.sgstore --limit=3"),
        (["find", "MATCH (e:Ego)"], "write: sgstore find STORE 'MATCH (e:Ego)'"),
        (["patterns", "cut_in"], "write: sgstore patterns show cut_in"),
    ],
)
def test_unknown_command_gives_the_right_one(
    arguments: list[str], answer: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments) == 2
    assert answer in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("arguments", [["help"], ["help", "find"], ["-V"]])
def test_usual_words_for_help_and_version(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments) == 0
    assert "sgstore" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("verb", "text", "code", "answer"),
    [
        ("find", "cut_in", 0, ""),
        ("find", "cut_inn", 2, "did you mean 'cut_in'?"),
        ("find", "stopped", 2, "write it after WHERE"),
        ("find", "r_g1_safe_distance", 2, "run it with check"),
        ("find", "SELECT 1", 2, "run SQL with sgstore sql"),
        ("find", "lost.sgql", 2, "No such file"),
        ("sql", "MATCH (e:Ego)", 2, "use find"),
        ("sql", "cut_in", 2, "use find"),
        ("sql", "CHECK ALWAYS ego.speed < 5", 2, "use check"),
        ("check", "ALWAYS ego.speed < 50", 0, "true"),
        ("check", "CHECK a: NEVER ego.speed > 50", 0, "true"),
        ("check", "cut_in", 2, "run it with find"),
        ("check", "SELECT 1", 2, "run SQL with sgstore sql"),
        ("check", "rss_distance", 0, "0 false"),
    ],
)
def test_every_verb_reads_every_text_or_names_the_right_verb(
    store: str, verb: str, text: str, code: int, answer: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([verb, store, text]) == code
    printed = capsys.readouterr()
    assert answer in printed.out + printed.err


def test_every_verb_reads_files(store: str, tmp_path: Path) -> None:
    (tmp_path / "a.sgql").write_text("MATCH (e:Ego) LIMIT 1")
    (tmp_path / "b").write_text("CHECK a: ALWAYS ego.speed < 50")
    (tmp_path / "c.sql").write_text("SELECT count(*) FROM frames")

    for verb, name in (("find", "a.sgql"), ("check", "b"), ("sql", "c.sql")):
        assert run([verb, store, str(tmp_path / name)]) == 0


def test_recording_instead_of_store_leads_to_doctor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a drive.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")

    assert run(["info", str(path)]) != 0
    assert f"sgstore doctor '{path}'" in capsys.readouterr().err


def test_trace_after_store_leads_to_the_option(
    town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["info", str(town_store), "town", "a b", "--json"]) != 0
    written = " ".join(capsys.readouterr().err.split())
    assert f"write: sgstore info {town_store} --json --trace town --trace 'a b'" in written


@pytest.mark.parametrize("command", ["show", "find", "export", "ingest", "coverage classes"])
def test_option_that_is_similar_to_no_other_has_no_suggestion(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert run([*command.split(), "x", "--boxes"]) == 2
    written = capsys.readouterr().err
    assert written.strip().endswith("No such option: --boxes")


def test_misspelt_option_has_a_suggestion(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["show", "x", "--verbos"]) == 2
    assert "write: sgstore show x --verbose" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--limit", "--top", "-n"])
def test_command_without_limit_names_another_way(
    capsys: pytest.CaptureFixture[str], option: str
) -> None:
    assert run(["check", "x.sgstore", "ALWAYS ego.speed < 3", option, "5"]) == 2
    written = " ".join(capsys.readouterr().err.split())
    assert f"No such option: {option}; check prints all rows; '| head' shows" in written


def test_option_of_other_commands_names_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["find", "x", "MATCH (e:Ego)", "--abstraction", "roadscene2vec"]) == 2
    written = " ".join(capsys.readouterr().err.split())
    head, _, names = written.partition("No such option: --abstraction; it is an option of: ")
    assert head
    assert {"export", "like", "coverage classes"} <= {*names.split(", ")}
