"""Recordings land in a collection by shares, and a commit makes bundles of them: as if one had read all."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from opendrive_maps import a_map, a_road, lane, line, section
from recordings import Recorder, car
from thorough import LONG

from sgstore.apps.cli import run as run_verb
from sgstore.collection import Collection, commit, gc, land, pack, rebuild, verify
from sgstore.collection import _catalogue as catalogue
from sgstore.collection import _landing as landing
from sgstore.collection import _storage as places
from sgstore.errors import StoreError
from sgstore.ingest import ingest
from sgstore.query import Store

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.seconds(20), pytest.mark.usefixtures("own_cache")]

NEAR = "MATCH (a:Car)-[:near]->(b:Car)"
COUNTED = "MATCH (a:Car)-[:near]->(b:Car) RETURN trace.name, a, COUNT(*) AS n, AVG(b.x)"


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Four recordings, two of which have the same name, in two folders; all but the first on one map."""
    road_map = a_map(a_road("1", line(200.0), sections=section(lane(1), lane(0), lane(-1))))
    folder = tmp_path_factory.mktemp("drives")
    paths = [folder / name for name in ("a.mcap", "b.mcap", "c.mcap", "more/a.mcap")]
    paths[3].parent.mkdir()
    for number, path in enumerate(paths):
        with Recorder(path) as recorder:
            if number:
                recorder.map(road_map)
            for i in range(65 + number):
                moving = [car(7, i, v=(10, 0)), car(8, i + 12 + number / 2, v=(9, 0))]
                recorder.ground_truth(i * 0.1, moving, host=7)
    return paths


@pytest.fixture(scope="module")
def unsharded(drives: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("whole") / "c"
    assert {outcome.status for outcome in land(place, drives)} == {"landed"}
    assert len(list((place / "maps").rglob("tables"))) == 1
    assert commit(place).added == ["a", "a~2", "b", "c"]
    return place


def segments_of(place: Path) -> list[str]:
    return sorted(path.relative_to(place).as_posix() for path in (place / "segments").rglob("*"))


def facts_of(place: Path) -> dict[str, list[Any]]:
    """What the catalogue says, but for what bundles are called and how large they are."""
    facts = Collection(place).snapshot.facts
    told = {table: sorted(row[1:] for row in rows) for table, rows in facts.items()}
    return told | {"bundle": [], "config": facts["config"]}


def test_shares_that_were_stopped_and_begun_again_are_the_whole(
    drives: list[Path], unsharded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, put = tmp_path / "c", landing._Landing._put

    def stopped(self: Any, sealed: Path) -> str:
        put(self, sealed)
        raise KeyboardInterrupt  # it has landed, and nobody has noted it

    for share in (2, 1, 3):
        with monkeypatch.context() as patched:
            patched.setattr(landing._Landing, "_put", stopped)
            with suppress(KeyboardInterrupt):
                land(place, drives, shard=(share, 3))
        land(place, drives, shard=(share, 3))
    done = commit(place)

    assert done.added == ["a", "a~2", "b", "c"]
    assert segments_of(place) == segments_of(unsharded)
    assert facts_of(place) == facts_of(unsharded)
    one, other = Collection(place), Collection(unsharded)
    assert one.find(COUNTED).rows() == other.find(COUNTED).rows() != []


def killed_at_work(words: list[str], place: Path, rng: random.Random) -> bool:
    """Begin a share, and kill it when it has made some files, or a little later; whether it still ran."""

    def files() -> int:
        return sum(len(names) for _, _, names in os.walk(place))

    enough = files() + rng.randrange(4)
    with subprocess.Popen(words, stdout=subprocess.DEVNULL) as running:
        while running.poll() is None and files() < enough:
            time.sleep(0.001)
        time.sleep(rng.uniform(0, 0.1))
        running.kill()
    return running.returncode == -signal.SIGKILL


@pytest.mark.skipif(not LONG, reason="four shares are begun three times each: make cluster")
@pytest.mark.parametrize("seed", range(3))
def test_shares_that_are_killed_twice_and_begun_again_are_the_whole(
    drives: list[Path], unsharded: Path, tmp_path: Path, seed: int
) -> None:
    rng, place, killed = random.Random(seed), tmp_path / "c", list[bool]()
    for share in range(1, 5):
        words = [sys.executable, "-m", "sgstore", "ingest", str(place), *map(str, drives)]
        words += ["--shard", f"{share}/4"]
        killed += [killed_at_work(words, place, rng) for _ in range(2)]
        assert subprocess.run(words, stdout=subprocess.DEVNULL, check=False).returncode == 0
    done = commit(place)

    assert sum(killed) >= 4
    assert done.refused == []
    assert segments_of(place) == segments_of(unsharded)
    assert facts_of(place) == facts_of(unsharded)
    one, other = Collection(place), Collection(unsharded)
    assert one.find(COUNTED).rows() == other.find(COUNTED).rows() != []
    assert verify(place).faults == []


def test_each_recording_is_in_one_share(drives: list[Path], tmp_path: Path) -> None:
    found = [
        [outcome.path for outcome in land(tmp_path / "c", drives, shard=(share, 2))]
        for share in (1, 2)
    ]

    assert sorted(found[0] + found[1]) == sorted(drives)


def test_a_map_is_once_in_a_bundle(drives: list[Path], unsharded: Path, tmp_path: Path) -> None:
    ingest(tmp_path / "s.sgstore", drives)
    pack(tmp_path / "s.sgstore", tmp_path / "packed", bundle_traces=2)

    of_traces: list[list[str]] = []
    for place in (unsharded, tmp_path / "packed"):
        for bundle in sorted((place / "bundles").iterdir()):
            with duckdb.connect(str(bundle), read_only=True) as connection:
                told = connection.sql("SELECT name FROM inside.map").fetchall()
                asked = "SELECT DISTINCT map FROM frames WHERE map IS NOT NULL"
                assert told == connection.sql(asked).fetchall()
                of_traces.append([name for (name,) in told])
    assert [len(names) for names in of_traces] == [1, 1, 1]  # of three traces, of one, of two


def test_what_was_landed_is_what_ingest_reads(
    drives: list[Path], unsharded: Path, tmp_path: Path
) -> None:
    ingest(tmp_path / "s.sgstore", drives[:3])
    with Store(tmp_path / "s.sgstore") as store:
        wanted = [tuple(row)[2:] for row in store.find(f"USING DATASET b {NEAR}")]
    found = [tuple(row)[2:] for row in Collection(unsharded).find(f"USING DATASET b {NEAR}")]

    assert found == wanted != []
    assert verify(unsharded).faults == []


def test_what_has_landed_is_not_read_again(drives: list[Path], tmp_path: Path) -> None:
    place = tmp_path / "c"
    land(place, drives[:1])
    commit(place)

    (outcome,) = land(place, drives[:1])
    assert (outcome.status, outcome.frames) == ("present", 65)
    assert commit(place).bundles == []
    land(place, drives[1:2])
    assert commit(place).added == ["b"]
    assert [row["name"] for row in Collection(place).traces()] == ["a", "b"]
    assert gc(place, older_s=0).names
    assert Collection(place).find(NEAR).count() == 65 + 66


def test_two_traces_of_one_id_are_refused_and_nothing_else_is_lost(
    drives: list[Path], unsharded: Path, tmp_path: Path
) -> None:
    place = tmp_path / "c"
    land(place, drives[:2])
    told = next((place / "segments").rglob("sealed.json"))
    copied = place / "segments" / "00" / ("0" * 64)
    shutil.copytree(told.parent, copied)
    values = json.loads(told.read_text())
    values["identity"]["digest"], values["path"] = "f" * 64, "/elsewhere/stranger.mcap"
    (copied / "sealed.json").write_text(json.dumps(values))

    done = commit(place)

    (reason,) = done.refused
    assert "stranger.mcap" in reason
    assert any(path.name in reason for path in drives[:2])
    assert len(done.added) == 1
    assert Collection(place).find(NEAR).count() > 0
    assert run_verb(["collection", "commit", str(place)]) == 1


def test_one_trace_read_in_two_ways_is_in_a_collection_once(
    drives: list[Path], tmp_path: Path
) -> None:
    place = tmp_path / "c"
    land(place, drives[:1])
    commit(place)
    land(place, drives[:1], until=2)

    (reason,) = commit(place).refused
    assert "different settings" in reason


def test_what_came_from_a_store_and_lands_too_is_there_already(
    drives: list[Path], tmp_path: Path
) -> None:
    place = tmp_path / "c"
    ingest(tmp_path / "s.sgstore", drives[:2])  # one without a map, one with it
    assert pack(tmp_path / "s.sgstore", place).added == ["a", "b"]
    land(place, drives[:3])

    done = commit(place)
    assert (done.refused, sorted(done.present), done.added) == ([], ["a", "b"], ["c"])
    land(place, drives[1:2], since=1)
    (reason,) = commit(place).refused
    assert "different settings" in reason


def test_a_share_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="shard 3/2"):
        land(tmp_path / "c", [], shard=(3, 2))
    assert run_verb(["ingest", str(tmp_path / "c"), "x.mcap", "--shard", "half"]) == 2


def test_bundles_of_another_version_are_made_anew(
    drives: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "c"
    land(place, drives[:2])
    commit(place)
    wanted = Collection(place).find(COUNTED).rows()
    before = catalogue.latest(places.place_at(place))
    old = [(*row[:4], "0", *row[5:]) for row in before.facts["bundle"]]
    catalogue.write(places.place_at(place), 2, before.facts | {"bundle": old})

    assert run_verb(["find", str(place), NEAR]) == 1
    assert "collection rebuild" in capsys.readouterr().err
    assert [*rebuild(place)] == [row[0] for row in old]
    assert Collection(place).find(COUNTED).rows() == wanted != []
    assert verify(place).faults == []
    assert rebuild(place) == {}
    drives[0].rename(tmp_path / drives[0].name)
    with pytest.raises(StoreError, match="gone"):
        rebuild(place, everything=True)
    assert len(rebuild(place, everything=True, look_in=[tmp_path])) == 1
    (tmp_path / drives[0].name).rename(drives[0])
    assert Collection(place).find(COUNTED).rows() == wanted


def test_the_verbs_do_it(
    drives: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = str(tmp_path / "c")
    for share in range(1, 8):
        assert run_verb(["ingest", place, *map(str, drives), "--shard", f"{share}/7"]) == 0
        told = capsys.readouterr()
        assert ("of 4 recordings: none" in told.err) != ("landed" in told.out)
    assert run_verb(["find", place, NEAR, "--count"]) == 0
    assert "the collection has no committed bundle" in capsys.readouterr().err
    for news in ("4 traces in 1 bundle, snapshot 1", "no new traces; the last snapshot is 1"):
        assert run_verb(["collection", "commit", place, "--json"]) == 0
        assert news in capsys.readouterr().err
    assert run_verb(["find", place, NEAR, "--count"]) == 0
    assert int(capsys.readouterr().out) == sum(65 + number for number in range(4))


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:20])


@pytest.mark.parametrize("name", ["COLLECTION.json", "catalogue/00000001.json"])
def test_what_is_cut_off_is_named(
    unsharded: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "a fleet, größer"
    shutil.copytree(unsharded, place)
    assert run_verb(["find", str(place), NEAR, "--count"]) == 0
    cut_off(place / name)
    capsys.readouterr()

    for verb in (["find", str(place), NEAR], ["collection", "commit", str(place)]):
        assert run_verb(verb) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{place / name}: damaged or cut off" in line


def test_a_file_is_no_collection(drives: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    for verb in (
        ["collection", "commit", str(drives[0])],
        ["ingest", str(drives[0]), str(drives[1]), "--shard", "1/1"],
    ):
        assert run_verb(verb) == 1
        assert f"{drives[0]}: a file, and a collection is a folder" in capsys.readouterr().err
