"""What is done with matches once they are found: CASE, groups, HAVING, LIMIT n PER, SKIP, collect."""

from __future__ import annotations

import csv
import json
from typing import TYPE_CHECKING

import pytest
from oracle_after import disagreement_after, try_many_after
from oracle_worlds import World, random_world
from recordings import Recorder, car
from thorough import LONG

from sgstore.apps.cli import run as run_verb
from sgstore.ingest import ingest
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.seconds(4)


@pytest.mark.parametrize("first", range(0, 400, 50) if LONG else [50])
def test_random_results_equal_their_definition(first: int) -> None:
    seen = try_many_after(first, 50)

    assert seen["tried"] > 30
    assert seen["with rows"] > 10


@pytest.fixture(scope="module")
def world() -> World:
    return random_world(3, traces=3, frames=8)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("RETURN v.kind AS k, COUNT(*) AS n HAVING n > 2 ORDER BY n DESC", id="having"),
        pytest.param("RETURN v.kind HAVING COUNT(*) > 2 AND MAX(v.x) > 101", id="not returned"),
        pytest.param("RETURN DISTINCT v.kind HAVING COUNT(*) > 3", id="distinct and having"),
        pytest.param("RETURN COUNT(*) AS n HAVING n > 1000", id="no group is left"),
        pytest.param(
            "RETURN trace.name, v.kind, COUNT(*) AS n ORDER BY n DESC LIMIT 2 PER trace.name",
            id="first two of each trace",
        ),
        pytest.param("RETURN v, v.kind, COUNT(*) AS n LIMIT 1 PER v", id="of each entity"),
        pytest.param("RETURN DISTINCT v, v.kind LIMIT 1 PER v", id="of each, told once"),
        pytest.param(
            "RETURN trace.name, v, frame.seq ORDER BY v.x DESC LIMIT 2 PER v", id="of matches"
        ),
        pytest.param("RETURN v.x AS x ORDER BY x SKIP 5 LIMIT 4", id="a page"),
        pytest.param("RETURN v.kind, COUNT(*) SKIP 1", id="a page of groups"),
        pytest.param("RETURN v.kind SKIP 100000", id="beyond the last"),
        pytest.param(
            "RETURN median(v.x), percentile(v.x, 90), stddev(v.speed), AVG(DISTINCT v.width)",
            id="statistics",
        ),
        pytest.param(
            "RETURN v.kind, MAX(v.x) - MIN(v.x), SUM(v.speed) / COUNT(v.speed)", id="arithmetic"
        ),
        pytest.param(
            "RETURN v.width AS w, SUM(v.x) * v.width, v.width / COUNT(*)",
            id="beside a group's value",
        ),
        pytest.param(
            "RETURN trace.name, collect(v.name), collect(DISTINCT v.kind), collect(v.speed)",
            id="lists",
        ),
        pytest.param("RETURN collect(DISTINCT v), COUNT(DISTINCT v)", id="list of entities"),
        pytest.param(
            "RETURN AVG(CASE WHEN v.speed > 1 THEN 1 WHEN v.speed IS NULL THEN 0.5 ELSE 0 END)",
            id="share",
        ),
        pytest.param(
            "RETURN CASE v.kind WHEN 'car' THEN 'four wheels' WHEN 'bicycle' THEN 'two' END AS w,"
            " COUNT(*) AS n ORDER BY CASE WHEN n > 9 THEN 1 ELSE 2 END, w",
            id="case of groups",
        ),
    ],
)
def test_results_equal_their_definition(text: str, world: World) -> None:
    problem, rows = disagreement_after(f"MATCH (v:Entity) {text}", world)

    assert problem == ""
    assert rows or "1000" in text


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """Two traces of 40 frames: in the first the ego goes at 0 to 39 m/s, in the second at 5."""
    folder = tmp_path_factory.mktemp("after")
    for name, speeds in (("run2", [float(i) for i in range(40)]), ("run10", [5.0] * 40)):
        with Recorder(folder / f"{name}.mcap") as recorder:
            for number, speed in enumerate(speeds):
                cars = [car(7, 0, v=(speed, 0)), car(2, 200, v=(3, 0))]
                recorder.ground_truth(number / 10, cars, host=7)
    ingest(folder / "x.sgstore", [folder / "run2.mcap", folder / "run10.mcap"])
    with Store(folder / "x.sgstore") as opened:
        yield opened


def test_pages_together_are_all_rows(store: Store) -> None:
    text = "MATCH (e:Ego) RETURN trace.name, frame.seq, e.speed"
    every = store.find(text).rows()

    assert len(every) == 80
    for skip, limit in ((0, 7), (35, 10), (79, 5), (200, 1)):
        page = store.find(f"{text} SKIP {skip} LIMIT {limit}")
        assert page.rows() == list(page) == every[skip : skip + limit]
        assert len(page.numpy()["e.speed"]) == len(every[skip : skip + limit])
    assert store.find(f"{text} SKIP 70").limit(3).rows() == every[70:73]


def test_frames_and_clips_belong_to_the_sampled_rows(store: Store) -> None:
    text = "MATCH (e:Ego) RETURN e.speed AS v ORDER BY v DESC LIMIT 2 PER trace.name"
    matches = store.find(text)

    assert [row.v for row in matches] == [39.0, 38.0, 5.0, 5.0]
    assert [(f.trace, f.seq) for f in matches.frames()] == [
        *(("run2", 39), ("run2", 38)),
        *(("run10", 0), ("run10", 1)),
    ]
    assert matches.count() == 4
    assert [clip.trace for clip in matches.clips(0.2, 0.2)] == ["run2", "run10"]
    assert store.find("MATCH (e:Ego) RETURN e.id SKIP 77").count() == 3


def test_intervals_are_sampled_by_their_ends(store: Store) -> None:
    text = "MATCH (e:Ego) WHERE e.speed % 10 < 8 RETURN INTERVALS"
    every = store.find(text).rows()

    assert [row.frames for row in every] == [8, 8, 8, 8, 40]
    long = store.find(f"{text} HAVING frames > 10 OR start > 2.9").rows()
    assert long == every[3:]
    first = store.find(f"{text} ORDER BY start DESC LIMIT 1 PER trace.name").rows()
    assert [(row.trace, row.start) for row in first] == [("run2", 3.0), ("run10", 0.0)]
    assert store.find(f"{text} SKIP 3").rows() == every[3:]


def test_lists_are_written_in_every_format(store: Store, tmp_path: Path) -> None:
    text = "MATCH (e:Ego) WHERE frame.seq < 3 RETURN trace.name AS run, collect(e.speed) AS v"
    matches = store.find(text)

    assert matches.rows() == [("run2", [0.0, 1.0, 2.0]), ("run10", [5.0, 5.0, 5.0])]
    assert matches.arrow().to_pydict()["v"] == [[0.0, 1.0, 2.0], [5.0, 5.0, 5.0]]
    assert matches.csv(tmp_path / "x.csv") == matches.parquet(tmp_path / "x.parquet") == 2
    rows = list(csv.reader((tmp_path / "x.csv").read_text("utf-8").splitlines()))
    assert json.loads(rows[1][1]) == [0.0, 1.0, 2.0]


def test_shell_prints_lists_and_groups(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    text = "MATCH (e:Ego) RETURN trace.name AS run, MAX(e.speed) AS v, collect(DISTINCT e.kind) HAVING v > 5"

    assert run_verb(["find", str(store.file.path), text, "--json"]) == 0

    assert json.loads(capsys.readouterr().out) == [
        {"run": "run2", "v": 39.0, "collect(DISTINCT e.kind)": ["car"]}
    ]


def test_case_can_use_other_frames(store: Store) -> None:
    faster = "CASE WHEN prev(e.speed) < e.speed THEN 'faster' ELSE 'no faster' END"

    found = store.find(
        f"MATCH (e:Ego) RETURN trace.name AS run, {faster} AS how, COUNT(*) AS n"
    ).rows()
    asked = store.find(f"MATCH (e:Ego) WHERE {faster} = 'faster'").count()

    assert found == [("run2", "faster", 39), ("run2", "no faster", 1), ("run10", "no faster", 40)]
    assert asked == 39
