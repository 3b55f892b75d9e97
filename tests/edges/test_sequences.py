"""Sequences of manoeuvres, as coverage and as what a selection keeps: against all that can be enumerated."""

from __future__ import annotations

import itertools
import json
import random
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scenes import Scene, actor, along, ego, path, store_of, street

from sgstore.apps.cli import run
from sgstore.errors import ConfigError, QueryNameError
from sgstore.testsets.coverage import (
    ChosenFrames,
    classed,
    features,
    happenings,
    manoeuvres_named,
    sequences,
    sequences_in,
)
from sgstore.testsets.selection import SelectionSpec, SelectionUnit, Strategy, select

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store


def enumerated(code: list[int], time: list[int], names: int, k: int, within: int) -> set[int]:
    """All sequences, by trying all k of the happenings."""
    found: set[int] = set()
    for rows in itertools.combinations(range(len(code)), k):
        times = [time[i] for i in rows]
        if all(a < b for a, b in itertools.pairwise(times)) and times[-1] - times[0] <= within:
            number = 0
            for i in rows:
                number = number * names + code[i]
            found.add(number)
    return found


@pytest.mark.parametrize("k", [1, 2, 3, 4])
def test_the_sequences_found_are_all_there_are(k: int) -> None:
    rng = random.Random(k)
    for _ in range(60):
        names, many, within = rng.randint(1, 4), rng.randint(0, 9), rng.choice([0, 2, 5, 1 << 62])
        code = [rng.randrange(names) for _ in range(many)]
        time = sorted(rng.randrange(12) for _ in range(many))

        found = sequences_in(np.array(code, int), np.array(time, int), names, k, within)

        assert {*found} == enumerated(code, time, names, k, within)
        for place in found.values():
            assert 0 <= place < many


ROAD = street("driving", "driving")
HALT = [(0, 5), (1, 5), (2, 0), (3, 0), (4, 5)]
LATER = [(0, 6), (2, 6), (3, 0), (4.4, 0), (5, 5)]
CHANGE = path((0, -5.25), (15, -5.25), (25, -1.75), (400, -1.75))
TRACES = {
    "one": [
        Scene(ROAD, ego(along(-1.75), HALT), actor("v", along(-5.25), LATER, start=9), seconds=6)
    ],
    "two": [Scene(ROAD, ego(CHANGE, [(0, 5), (5, 5), (6, 0)]), seconds=6.6)],
    "none": [Scene(ROAD, ego(along(-1.75), 5), seconds=3)],
}


THREE = manoeuvres_named(["stops", "starts", "changes_lane_left"])


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return store_of(tmp_path_factory.mktemp("drives") / "s.sgstore", TRACES)


def test_what_happens_is_told_by_who_does_it_and_when(drives: Store) -> None:
    found = happenings(ChosenFrames("all", drives), THREE)
    told = zip([found.names[i] for i in found.code.tolist()], found.time_ns.tolist(), strict=True)

    assert sorted((time / 1e9, name) for name, time in told) == [
        (2.0, "stops(ego)"),
        (3.0, "stops(car)"),
        (3.2, "starts(ego)"),
        (4.2, "changes_lane_left(ego)"),
        (4.6, "starts(car)"),
        (6.0, "stops(ego)"),
    ]
    assert found.names == (
        "changes_lane_left(ego)",
        "starts(car)",
        "starts(ego)",
        "stops(car)",
        "stops(ego)",
    )


def test_a_manoeuvre_late_in_a_recording_has_the_id_of_its_frame(tmp_path: Path) -> None:
    late = ego(along(-1.75), [(0, 5), (19, 5), (20, 0), (24, 0)])
    store = store_of(tmp_path / "s.sgstore", {"late": [Scene(ROAD, late, seconds=24)]})
    stops = {"stops": THREE["stops"]}
    (interval,) = store.find(stops["stops"]).intervals()

    found = happenings(ChosenFrames("all", store), stops)
    frame = store.file.frame(f"late#{interval.end_seq}").frame_id

    assert interval.start_seq > 64
    assert found.frame_id.tolist() == [frame]
    assert happenings(ChosenFrames("one", store, np.array([frame])), stops).code.tolist() == [0]


def test_coverage_counts_who_did_what_after_what(drives: Store) -> None:
    found = sequences(ChosenFrames("all", drives), manoeuvres=THREE)
    covered = {row["sequence"]: row["frame"] for row in found.covered.dicts()}

    assert covered == {
        "stops(ego) then stops(car)": "one#10",
        "stops(ego) then starts(ego)": "one#10",
        "stops(ego) then starts(car)": "one#10",
        "stops(car) then starts(ego)": "one#15",
        "stops(car) then starts(car)": "one#15",
        "starts(ego) then starts(car)": "one#16",
        "changes_lane_left(ego) then stops(ego)": covered["changes_lane_left(ego) then stops(ego)"],
    }
    assert found.shares.rows[0][1:3] == (7, 25)
    assert len(found.missing.rows) == 18
    assert not sequences(ChosenFrames("all", drives), 3, None, THREE, 1.0).covered.rows


def test_a_reference_says_which_sequences_there_should_be(drives: Store) -> None:
    frames = drives.file.arrays("SELECT frame_id FROM frames WHERE trace = 'two' ORDER BY 1")
    some = ChosenFrames("two", drives, frames["frame_id"].astype(np.int64))

    found = sequences(some, 2, ChosenFrames("all", drives), THREE)

    assert found.shares.rows[0][1:3] == (1, 7)
    assert [many for _, many in found.missing.rows] == [1] * 6


@pytest.mark.parametrize(
    ("names", "error", "told"),
    [
        (["stops", "stops"], ConfigError, "given twice"),
        (["a b=MATCH (e:Ego)"], ConfigError, "NAME=QUERY"),
        (["rss_distance"], ConfigError, "is a property"),
        (["stop"], QueryNameError, "stop"),
    ],
)
def test_manoeuvres_that_are_none_are_refused(
    names: list[str], error: type[Exception], told: str
) -> None:
    with pytest.raises(error, match=told):
        manoeuvres_named(names)


def test_more_sequences_than_can_be_gone_through_are_refused(drives: Store) -> None:
    with pytest.raises(ConfigError, match="ask for a smaller k"):
        sequences(ChosenFrames("all", drives), 12)


def test_no_fewer_clips_keep_all_sequences(drives: Store) -> None:
    chosen = ChosenFrames("all", drives)
    spec = SelectionSpec(
        Strategy.minimal, SelectionUnit.clip, 2.0, sequences=2, manoeuvres=(*THREE,), within_s=2.0
    )

    found = select(chosen, spec)

    units = found.units
    held: list[set[str]] = []
    for begin, end in zip(units.begin.tolist(), units.end.tolist(), strict=True):
        part = ChosenFrames("part", drives, units.frame_id[begin:end])
        found_here = sequences(part, manoeuvres=THREE, within_s=2.0)
        held.append({row[0] for row in found_here.covered.rows})
    every = set().union(*held)
    sizes = range(len(held) + 1)
    covers = (c for n in sizes for c in itertools.combinations(held, n) if set().union(*c) == every)
    assert every
    assert len(found.picked) == len(next(covers))
    assert set().union(*(held[i] for i in found.picked.tolist())) == every
    assert found.result["elements"] == len(every)


@pytest.mark.parametrize("abstraction", ["E", "RSV"])
@pytest.mark.parametrize("combos", [0, 1])
def test_no_fewer_clips_keep_all_classes_and_all_manoeuvres(
    drives: Store, abstraction: str, combos: int
) -> None:
    both: dict[str, Any] = {
        "classes": True,
        "combos": combos,
        "sequences": 1,
        "manoeuvres": (*THREE,),
    }
    spec = SelectionSpec(Strategy.minimal, SelectionUnit.clip, 2.0, abstraction, **both)
    chosen = ChosenFrames("all", drives)

    found = select(chosen, spec)
    alone = select(chosen, SelectionSpec(Strategy.minimal, SelectionUnit.clip, 2.0, abstraction))

    held: list[set[str]] = []
    units = found.units
    for begin, end in zip(units.begin.tolist(), units.end.tolist(), strict=True):
        part = ChosenFrames("part", drives, units.frame_id[begin:end])
        of = classed(part, abstraction)
        held.append({row[0] for row in sequences(part, 1, None, THREE).covered.rows})
        held[-1] |= {of.names[code] for code in of.code.tolist()}
        held[-1] |= {str(one) for one in features(of, abstraction).names} if combos else set()
    every = set().union(*held)
    sizes = range(len(held) + 1)
    covers = (c for n in sizes for c in itertools.combinations(held, n) if set().union(*c) == every)
    assert len(found.picked) == len(next(covers))
    assert set().union(*(held[i] for i in found.picked.tolist())) == every
    assert found.result["elements"] == len(every)
    assert found.result["kind"].endswith(" and manoeuvres")
    assert not any("a manoeuvre can be lost" in text for text in found.said)
    assert any("a manoeuvre can be lost; keep" in text for text in alone.said)
    assert spec.as_dict("")["classes"] is True
    assert spec.as_dict("")["abstraction"] == abstraction


@pytest.mark.parametrize(
    "more",
    [
        {"sequences": 2, "unit": SelectionUnit.frame},
        {"manoeuvres": ("stops",)},
        {"within_s": 3.0},
    ],
)
def test_what_does_not_go_with_sequences_is_refused(more: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        SelectionSpec(**{"strategy": Strategy.minimal, "unit": SelectionUnit.clip, **more})


def test_the_verbs_tell_the_same(
    drives: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(drives.file.path)

    def told(*line: str) -> Any:
        assert run([*line, "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    asked = [
        "coverage",
        "sequences",
        path,
        "-m",
        "stops",
        "-m",
        "go=MATCH (x:Vehicle) WHERE x.speed > 4",
    ]
    (shares,) = told(*asked, "--within", "3s")
    assert (shares["part"], shares["of"]) == (10, 16)
    assert {row["sequence"] for row in told(*asked, "--covered")} >= {"go(ego) then stops(ego)"}
    assert len(told(*asked, "--missing", "--by", f"{path}:MATCH (e:Ego)")) == 0
    lock = tmp_path / "some.lock"
    line = ["select", path, "--minimal", "--unit", "trace", "--sequences", "2", "-o", str(lock)]
    assert {row["unit"].partition("#")[0] for row in told(*line, "--no-payloads")} == {"one", "two"}
    assert '"sequences": 2' in lock.read_text()
