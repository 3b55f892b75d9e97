"""Every option of every verb: given more than once it is collected or refused, and no number is too odd."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, get_args

import pytest
import typer

from sgstore.apps.cli import app, run
from sgstore.apps.demo import RECORDING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.seconds(10)

VALUES = {"kinds": ("concept", "property")}
"""Two values of each option that collects and does not take any text."""


def verbs(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every verb of the command line with its command."""
    for name, below in getattr(command, "commands", {}).items():
        yield from verbs(below, (*path, name))
    if not hasattr(command, "commands"):
        yield path, command


def options() -> Iterator[Any]:
    for path, command in verbs(typer.main.get_command(app)):
        for parameter in command.params:
            if parameter.param_type_name == "option" and not parameter.is_flag:
                yield pytest.param(
                    path, command, parameter, id=" ".join((*path, parameter.opts[0]))
                )


def others_needed(command: Any, but: Any) -> list[str]:
    """What a verb must be given beside an option."""
    given: list[str] = []
    for parameter in command.params:
        if parameter.required and parameter is not but:
            is_option = parameter.param_type_name == "option"
            given += [*parameter.opts[:1] * is_option, "csv"]
    return given


@pytest.mark.parametrize(("path", "command", "option"), [*options()])
def test_an_option_that_is_repeated_keeps_all_its_values_or_is_refused(
    path: tuple[str, ...], command: Any, option: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = VALUES.get(option.name, ("a=1", "b=2"))
    short_and_long = option.opts[0], option.opts[-1]
    given = [short_and_long[0], first, short_and_long[1], second]

    if option.multiple:
        context = command.make_context("it", [*others_needed(command, option), *given])
        held = [str(getattr(value, "value", value)) for value in context.params[option.name]]
        assert held == [first, second]
    else:
        assert run([*path, *others_needed(command, option), *given]) == 2
        told = " ".join(capsys.readouterr().err.replace("│", " ").split())
        assert "has 2 values; expected one" in told
        assert option.opts[0] in told


AT_WORK = {"ingest", "rebuild", "record", "demo"}
"""Verbs that would do all their work for a number that they may take."""


def numbers_of(parameter: Any) -> set[type]:
    annotation = parameter.type_descriptor.annotation
    return {float, int} & {annotation, *get_args(annotation)}


@pytest.fixture(scope="module")
def short_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first three seconds of the sample."""
    store = tmp_path_factory.mktemp("short") / "short.sgstore"
    assert run(["ingest", str(store), str(RECORDING), "--until", "3"]) == 0
    return store


@pytest.mark.parametrize(
    ("path", "command"),
    [
        pytest.param(path, command, id=" ".join(path))
        for path, command in verbs(typer.main.get_command(app))
        if path[-1] not in AT_WORK and any(map(numbers_of, command.params))
    ],
)
def test_a_number_that_is_none_or_has_400_digits_ends_no_verb_in_a_traceback(
    path: tuple[str, ...],
    command: Any,
    short_store: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    store = str(short_store)
    query = "MATCH (e:Ego)-[:near]->(c:Car)"
    known = {"query": query, "pattern": query, "frame": f"{RECORDING.stem}#3"}
    odd = {float: ["1e999", "nan"], int: ["9" * 400, "-1"]}
    for parameter in filter(numbers_of, command.params):
        needed = [one for one in command.params if one.required and one is not parameter]
        given = [
            word
            for one in needed
            for word in (
                *one.opts[:1] * (one.param_type_name == "option"),
                known.get(one.name, store),
            )
        ]
        for value in (value for kind in numbers_of(parameter) for value in odd[kind]):
            option = f"{parameter.opts[0]}={value}"
            assert run([*path, *given, option]) in {0, 1, 2, 3}


def test_a_switch_both_ways_is_refused_and_a_flag_said_twice_is_a_flag(
    town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["record", "x.mcap", "--scenery", "--no-scenery"]) == 2
    assert "has 2 values; expected one" in capsys.readouterr().err
    assert run(["info", str(town_store), "--json", "--json"]) == 0


def test_names_that_are_given_two_values_are_refused(town_store: Path, tmp_path: Path) -> None:
    store = str(town_store)
    twice = ["--param", "x=1", "--param", "x=2"]
    (tmp_path / "g.csv").write_text("graph,src,relation,dst\n0,ego,near,car 1\n")
    graphs = ["import", str(tmp_path / "new.sgstore"), str(tmp_path / "g.csv"), "--as", "csv"]

    assert run(["find", store, "MATCH (e:Ego) WHERE e.speed > $x", *twice]) == 2
    assert run(["patterns", "run", store, "cut_in", "within=1s", "within=2s"]) == 2
    assert run([*graphs, "--kind", "a=car", "--kind", "a=bus"]) == 2
    assert run([*graphs, "--relation", "a=near", "--relation", "a=visible"]) == 2


def test_two_ways_to_say_how_rows_are_printed_are_refused(town_store: Path) -> None:
    assert run(["info", str(town_store), "--json", "--format", "csv"]) == 2
    assert run(["info", str(town_store), "--json", "--format", "json"]) == 0


BROKEN, KEPT = "CHECK slow: ALWAYS ego.speed < 3", "CHECK sane: ALWAYS ego.speed < 300"


def test_check_answers_everything_that_it_is_asked(
    town_store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.sgql").write_text("CHECK a: ALWAYS ego.speed < 300; -- a remark")
    (tmp_path / "b.sgql").write_text("CHECK b: ALWAYS ego.speed < $top -- no semicolon")
    files = [str(tmp_path / name) for name in ("a.sgql", "b.sgql")]
    asked = ["-e", BROKEN, "-e", KEPT, "-p", "phi1", "-p", "phi7", "--param", "top=300"]

    code = run(["check", str(town_store), *files, *asked, "--format", "ndjson", "--require"])

    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    verdicts = {row["check"]: row["verdict"] for row in rows}
    assert code == 4
    assert set(verdicts) == {"a", "b", "slow", "sane", "phi1", "phi7"}
    assert (verdicts["slow"], verdicts["sane"]) == ("false", "true")


@pytest.mark.parametrize("first", [True, False])
def test_one_violated_check_of_two_is_enough_in_any_order(first: bool, town_store: Path) -> None:
    two = [BROKEN, KEPT] if first else [KEPT, BROKEN]

    assert run(["check", str(town_store), "-e", two[0], "-e", two[1], "--require"]) == 4
    assert run(["check", str(town_store), "-e", KEPT, "--require"]) == 0


def test_several_unnamed_checks_are_numbered_across_options(
    town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    texts = ["-e", "CHECK ALWAYS ego.speed < 3;", "-e", "CHECK ALWAYS ego.speed < 300"]

    assert run(["check", str(town_store), *texts, "--format", "ndjson"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(r["check"], r["verdict"]) for r in rows] == [("check 1", "false"), ("check 2", "true")]


def test_a_parameter_that_nobody_has_is_refused(
    town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = str(town_store)

    assert run(["check", store, "-p", "phi1", "-p", "phi7", "--param", "none=1"]) == 2
    assert run(["check", store, "-p", "phi1", "-e", KEPT, "--param", "none=1"]) == 2
    assert "none" in capsys.readouterr().err


def test_monitor_watches_everything_and_calls_patterns_by_their_names(
    capsys: pytest.CaptureFixture[str],
) -> None:
    from sgstore.apps.demo import RECORDING

    asked = ["-p", "cut_in", "-p", "lead_hard_braking", "-p", "phi1", "-e", BROKEN, "-e", KEPT]

    assert run(["monitor", str(RECORDING), *asked, "--duration", "12s", "--json", "--require"]) == 4
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {one["name"] for one in lines if one["event"] == "found"} == {
        "cut_in",
        "lead_hard_braking",
    }
    verdicts = {one["name"]: one["verdict"] for one in lines if one["event"] == "verdict"}
    assert set(verdicts) == {"phi1", "slow", "sane"}
    assert (verdicts["slow"], verdicts["sane"]) == ("false", "true")


def test_info_tells_of_each_trace_that_is_named(
    town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twice = ["info", str(town_store), "--trace", "town", "--trace", "tow"]

    assert run([*twice, "--json"]) == 0
    assert [one["name"] for one in json.loads(capsys.readouterr().out)] == ["town", "town"]
    assert run(twice) == 0
    assert capsys.readouterr().out.count("sha256") == 2


def test_the_library_lists_each_kind_that_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["patterns", "list", "--kind", "concept", "--kind", "property", "--json"]) == 0
    kinds = {one["kind"] for one in json.loads(capsys.readouterr().out)}
    assert kinds == {"concept", "property"}


def test_lanes_of_files_with_one_name_are_kept_apart(
    town_store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, speed in (("a", 0), ("b", 1)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "fast.sgql").write_text(f"MATCH (e:Ego) WHERE e.speed > {speed}")
    files = [part for name in "ab" for part in ("-f", str(tmp_path / name / "fast.sgql"))]

    assert run(["timeline", str(town_store), *files]) == 0
    lanes = [line for line in capsys.readouterr().out.splitlines() if "found" in line]
    assert len(lanes) == 2
