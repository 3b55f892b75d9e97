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


@pytest.mark.parametrize(
    ("sentence", "name"),
    [
        ("ego collides with another road user", "collision"),
        ("the ego crashes into a car", "collision"),
        ("ego hits a pedestrian", "collision"),
        ("smallest distance to another vehicle, collision", "collision"),
        ("time to collision below 2 seconds", "low_ttc"),
        ("low time to collision with a pedestrian", "low_ttc"),
        ("three persons near ego", "PedestrianCrossing"),
        ("several pedestrians near", "PedestrianCrossing"),
        ("many people crossing the street", "PedestrianCrossing"),
        ("turns left", "starting_left_turn"),
        ("ego turns left", "starting_left_turn"),
        ("a vehicle turns left", "turns_left"),
        ("ego turns right", "starting_right_turn"),
        ("ego turns right at the intersection", "SignalizedJunctionRightTurn"),
        ("pedestrian crosses in front of the ego", "crossing_pedestrian"),
        ("a person walks across the road in front of my car", "crossing_pedestrian"),
        ("vehicle cuts in closely", "cut_in"),
        ("another car cuts in ahead of me", "cut_in"),
        ("ego stands at red light", "waiting_at_red"),
        ("waiting at a red traffic light", "waiting_at_red"),
        ("car brakes hard in front of me", "lead_hard_braking"),
        ("the leading vehicle brakes suddenly", "lead_hard_braking"),
        ("ego brakes hard", "hard_braking"),
        ("ego drives over red light", "red_light_running"),
        ("ego drives over red light", "r_in2_red_light"),
        ("vehicle runs a red light", "red_light_running"),
        ("a bike is passed too closely", "close_pass_of_bicycle"),
        ("ego overtakes a cyclist", "close_pass_of_bicycle"),
        ("overtaking in the opposite lane", "overtaking_in_oncoming_lane"),
        ("left turn with oncoming traffic", "unprotected_left_turn"),
        ("ambulance behind the ego", "YieldToEmergencyVehicle"),
        ("ego changes lane", "changing_lane"),
        ("lane change without turn indicator", "lane_change_without_indicator"),
        ("vehicle ignores the stop sign", "stop_sign_ignored"),
        ("ego is stopped in the intersection", "stopped_in_junction"),
        ("pedestrian hidden behind a parked car", "ParkingCrossingPedestrian"),
        ("person suddenly becomes visible", "occlusion"),
        ("truck follows too closely", "tailgated_by_truck"),
        ("ego follows too close", "following_too_close"),
        ("pedestrian on the road without crosswalk", "jaywalking"),
        ("car drives against traffic", "against_traffic"),
        ("ego exceeds the speed limit", "r_g3_speed_limit"),
        ("almost a collision, near miss", "near_miss"),
        ("a car comes towards me in my lane", "oncoming_in_lane"),
        ("stops", "stops"),
        ("vehicle starts", "starts"),
        ("emergency vehicle with siren nearby", "emergency_vehicle_near"),
        ("parked cars along the road", "parked_row"),
        ("the ego is in a roundabout", "in_roundabout"),
        ("two vehicles merge into one lane", "merge_conflict"),
        ("ego drives on the oncoming lane to overtake", "overtaking_in_oncoming_lane"),
        ("ego waits for pedestrians at a crosswalk", "waiting_for_pedestrian_to_cross"),
        ("construction site in my lane", "ConstructionObstacle"),
        ("door of a parked car opens", "VehicleOpensDoorTwoWays"),
        ("traffic jam", "in_congestion"),
        ("reversing car", "reversing"),
        ("child runs onto the street", "walks_onto_road"),
        ("ego follows the car ahead with less than one second", "following_too_close"),
        ("cyclist crosses the intersection", "CrossingBicycleFlow"),
        ("ego is surrounded by many vehicles", "near_multiple_vehicles"),
    ],
)
def test_a_sentence_finds_its_pattern_among_the_first_three(sentence: str, name: str) -> None:
    assert name in [one.name for one in search(sentence)[:3]]


def test_rare_words_count_more_than_common_words() -> None:
    common = search("the ego and a vehicle")
    first, *_ = search("the ego and a vehicle in a lane of another, jaywalking")

    assert first.name == "jaywalking"
    assert first not in common[:3]
    assert search("the of") == []


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


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("check STORE overlaps", "did you mean 'no_collision' or "),
        ("find STORE overlaps", "did you mean 'collision' or 'no_collision' or 'low_ttc'?"),
        ("find STORE -p crashes", "did you mean 'collision' or "),
        ("check STORE no_colision", "did you mean 'no_collision'?"),
        ("find STORE -p overlaps", "more: sgstore patterns search overlaps"),
        ("find STORE -p xylophone", "list all names with 'sgstore patterns list'"),
        ("patterns R157", "write: sgstore patterns search R157"),
        ("patterns cut_in", "write: sgstore patterns show cut_in"),
    ],
)
def test_unknown_pattern_name_suggests_patterns_with_its_words(
    store: str, capsys: pytest.CaptureFixture[str], line: str, hint: str
) -> None:
    arguments = [store if word == "STORE" else word for word in line.split()]

    assert run(arguments) != OK
    assert hint in " ".join(capsys.readouterr().err.split())
