"""The verbs about the library: what they print, and how they end."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from sgstore.apps.cli import run
from sgstore.lang.library import pattern_named, patterns, search
from sgstore.query import Store

if TYPE_CHECKING:
    from pathlib import Path

OK, USAGE, NO_MATCH = 0, 2, 4


@pytest.fixture(scope="module")
def store(town_store: Path) -> str:
    return str(town_store)


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What a command line that ends well prints."""
    assert run(["patterns", *arguments]) == OK
    return capsys.readouterr().out


def test_list_names_them_all_or_those_of_a_kind(capsys: pytest.CaptureFixture[str]) -> None:
    rows = json.loads(said(capsys, "list", "--json"))

    assert [row["name"] for row in rows] == [*patterns()]
    assert rows[0]["sentence"] == pattern_named("stopped").sentence
    text = said(capsys, "list", "--kind", "concept")
    assert "cut_in" in text
    assert "ParkingExit" not in text


def test_search_names_first_what_has_most_of_the_words(capsys: pytest.CaptureFixture[str]) -> None:
    def found(*words: str) -> list[str]:
        assert run(["patterns", "search", *words, "--json"]) == 0
        return [one["name"] for one in json.loads(capsys.readouterr().out)]

    assert found("cut", "in")[0] == found("Cut-In")[0] == "cut_in"
    assert "jaywalking" in found("pedestrian")  # its sentence says: a person
    assert {"hard_brake"} <= {*found("brakes")} & {*found("braking")}
    assert {pattern_named(name).kind for name in found("lane", "--kind", "property")} == {
        "property"
    }
    assert found("xylophone") == []


@pytest.mark.parametrize("name", patterns())
def test_what_is_searched_by_its_own_words_is_among_the_best(name: str) -> None:
    (place,) = (i for i, one in enumerate(search(name)) if one.name == name)

    assert place < 12


def test_show_prints_a_query_that_can_be_asked(
    capsys: pytest.CaptureFixture[str], store: str, tmp_path: Path
) -> None:
    text = said(capsys, "show", "low_ttc")
    file = tmp_path / "low.sgql"
    file.write_text(text, encoding="utf-8")

    assert "-- param ttc = 1.5: the largest time to collision; s" in text
    assert "--   ····e→" in text
    assert run(["find", store, "-f", str(file), "--count"]) == OK
    frames = Store(store).find(pattern_named("low_ttc").text).count()
    assert capsys.readouterr().out == f"{frames}\n"


def test_show_gives_the_same_as_data(capsys: pytest.CaptureFixture[str]) -> None:
    told = json.loads(said(capsys, "show", "CutIn", "--json"))

    assert told["library"] == "leaderboard"
    assert told["parameters"][0] == {
        "name": "within",
        "type": "duration",
        "default": "4s",
        "meaning": "the longest time from the first step to the second",
    }
    assert "THEN WITHIN $within" in told["query"]
    assert told["example"] == pattern_named("CutIn").example


def test_run_finds_when_and_who(capsys: pytest.CaptureFixture[str], store: str) -> None:
    lines = said(capsys, "run", store, "merge_conflict").splitlines()
    rows = json.loads(said(capsys, "run", store, "merge_conflict", "--json"))

    assert lines[0].split()[:9] == ["from", "start", "end", "frames", "e", "a", "c", "b", "v"]
    assert lines[2].startswith("town#")
    assert len(rows) == len(lines) - 2
    assert {row["trace"] for row in rows} == {"town"}
    assert all(row["start"] <= row["end"] for row in rows)


def test_run_takes_parameters(capsys: pytest.CaptureFixture[str], store: str) -> None:
    few, many = (
        sum(
            row["frames"]
            for row in json.loads(said(capsys, "run", store, "low_ttc", f"ttc={t}", "--json"))
        )
        for t in (1.2, 3)
    )

    assert 0 < few < many


def test_run_gives_clips_of_a_pattern(capsys: pytest.CaptureFixture[str], store: str) -> None:
    arguments = ("run", store, "merge_conflict", "--clips", "--json")
    bare = json.loads(said(capsys, *arguments))
    wide = json.loads(said(capsys, *arguments, "--before", "500ms", "--after", "1s"))

    assert int(wide[0]["start_ns"]) == int(bare[0]["start_ns"]) - 500_000_000
    assert [set(clip) for clip in bare] == [{"trace", "start_ns", "end_ns"}] * len(bare)


def test_run_ends_with_a_code_of_its_own_where_nothing_matches(
    capsys: pytest.CaptureFixture[str], store: str
) -> None:
    assert run(["patterns", "run", store, "emergency_vehicle_near", "--require"]) == NO_MATCH
    assert "nothing matches" in capsys.readouterr().err
    assert said(capsys, "run", store, "emergency_vehicle_near", "--json") == "[]\n"


def test_run_tells_whether_a_property_is_kept(
    capsys: pytest.CaptureFixture[str], store: str
) -> None:
    (row,) = json.loads(said(capsys, "run", store, "phi2", "--json"))

    assert (row["check"], row["trace"], row["verdict"]) == ("phi2", "town", "true")
    assert run(["patterns", "run", store, "phi4", "S=0", "--require"]) == NO_MATCH
    assert "phi4" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["show", "cut_inn"], "did you mean 'cut_in'?"),
        (["run", "{}", "cut_in", "speed=3"], "it has: headway, within, hold"),
        (["run", "{}", "cut_in", "within=soon"], "expected a duration such as 4s"),
        (["run", "{}", "cut_in", "soon"], "expected NAME=VALUE"),
        (["run", "{}", "stopped"], "stopped is a condition"),
        (["run", "{}", "phi1", "--clips"], "phi1 is a property"),
        (["list", "--kind", "recipe"], "recipe"),
    ],
)
def test_wrong_usage_is_told(
    capsys: pytest.CaptureFixture[str], store: str, arguments: list[str], reason: str
) -> None:
    assert run(["patterns", *(a.format(store) for a in arguments)]) == USAGE
    assert reason in " ".join(capsys.readouterr().err.replace("│", " ").split())


def some(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Let the library have only some patterns."""
    found = {name: pattern_named(name) for name in names}
    monkeypatch.setattr("sgstore.lang.library.patterns", lambda: found)


def test_run_all_counts_the_matches_of_each_pattern(
    capsys: pytest.CaptureFixture[str], store: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("jaywalking", "brakes_hard", "turns_left", "turns_right", "ControlLoss")
    some(monkeypatch, "stopped", *names, "rss_distance")

    rows = json.loads(said(capsys, "run", store, "--all", "--json"))

    for row, name in zip(rows, names, strict=True):
        matches = Store(store).find(pattern_named(name).text)
        traces = [one.trace for one in matches.intervals()]
        counts = len(traces), len({*traces}), len(matches.left_out)
        assert [*row.values()] == [name, pattern_named(name).kind, *counts]


def test_run_all_ends_as_run_without_matches(store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    some(monkeypatch, "ControlLoss")

    assert run(["patterns", "run", store, "--all", "--require"]) == NO_MATCH
    assert run(["patterns", "run", store, "--all"]) == OK
    assert run(["patterns", "run", store, "--all", "--clips"]) == USAGE
    assert run(["patterns", "run", store, "cut_in", "--all"]) == USAGE
    assert run(["patterns", "run", store]) == USAGE


def test_check_library_checks_each_property(
    capsys: pytest.CaptureFixture[str], store: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    some(monkeypatch, "cut_in", "phi2", "phi4")

    assert run(["check", store, "--library", "--json"]) == OK
    together = json.loads(capsys.readouterr().out)
    assert run(["check", store, "-p", "phi2", "-p", "phi4", "--json"]) == OK
    assert together == json.loads(capsys.readouterr().out)
    assert {one["check"] for one in together} == {"phi2", "phi4"}
