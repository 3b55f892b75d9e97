"""Many recordings at once: in processes, again, anew, in part, and as several egos have them."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from carla_recordings import Bridge, vehicle
from foxglove_scenes import SceneRecorder, cube
from killing import content, made
from opendrive_maps import a_map, a_road, line
from recordings import Recorder, car, drive, person

from sgstore import readers
from sgstore.errors import MapError, StoreError, TraceError
from sgstore.ingest import ingest, recordings
from sgstore.model.config import Config, RangeSettings
from sgstore.pipeline import recording_ingest
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.pipeline.recording_ingest import Progress, TraceOutcome

pytestmark = pytest.mark.seconds(19)


def rows(store: Path, sql: str) -> list[tuple[Any, ...]]:
    return StoreFile(store).rows(sql).values


# In processes


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Recordings of one name, a copy of another, one that is not there, and one that is none."""
    folder = tmp_path_factory.mktemp("mixed")
    paths = made(folder, frames=70)
    bad = folder / "bad.mcap"
    bad.write_bytes(b"no recording")
    return [*paths[:2], bad, *paths[2:], folder / "none.mcap"]


@pytest.fixture(scope="module")
def one_by_one(mixed: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Any]]:
    store = tmp_path_factory.mktemp("one") / "s.db"
    return store, ingest(store, mixed)


def test_the_store_is_the_same_whatever_the_number_of_processes(
    mixed: Any, one_by_one: Any, tmp_path: Path
) -> None:
    outcomes = ingest(tmp_path / "s.db", mixed, jobs=3)

    def told(outcome: Any) -> tuple[Any, ...]:
        return outcome.path, outcome.status, outcome.name, outcome.frames, outcome.entities

    assert list(map(told, outcomes)) == list(map(told, one_by_one[1]))
    assert [str(o.error) for o in outcomes] == [str(o.error) for o in one_by_one[1]]
    assert [type(o.error) for o in outcomes] == [type(o.error) for o in one_by_one[1]]
    assert content(tmp_path / "s.db") == content(one_by_one[0])
    assert [p.name for p in tmp_path.iterdir()] == ["s.db"]


def test_names_are_given_in_the_order_of_the_recordings(one_by_one: Any) -> None:
    names = [(o.path.parent.name == "other", o.name, o.status) for o in one_by_one[1]]

    assert names == [
        (False, "a", "added"),
        (False, "b", "added"),
        (False, "", "failed"),
        (True, "a~2", "added"),
        (False, "b", "present"),
        (False, "", "failed"),
    ]


def test_progress_of_all_is_told_from_all_processes(mixed: Any, tmp_path: Path) -> None:
    seen: list[Progress] = []

    ingest(tmp_path / "s.db", mixed, jobs=2, on_progress=seen.append)

    total = sum(path.stat().st_size for path in mixed if path.exists())
    assert {p.all_size for p in seen} == {total}
    assert {p.files for p in seen} == {len(mixed)}
    # The copy is read too, if it is taken up before the first one is published.
    assert max(p.all_frames for p in seen) - (70 + 35 + 70) in {0, 35}
    assert [p.files_done for p in seen] == sorted(p.files_done for p in seen)
    assert all(p.all_bytes <= total for p in seen)


def test_a_process_that_dies_costs_the_recording_that_it_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [drive(tmp_path / f"d{i}.mcap", frames=200 + i) for i in range(5)]
    hired: list[Any] = []
    real = subprocess.Popen

    def hire(*arguments: Any, **options: Any) -> Any:
        hired.append(real(*arguments, **options))
        return hired[-1]

    monkeypatch.setattr(subprocess, "Popen", hire)
    victims: list[Path] = []

    def kill(progress: Progress) -> None:
        if not victims:
            victims.append(progress.path)
            os.kill(hired[paths.index(progress.path) % 2].pid, signal.SIGKILL)

    outcomes = ingest(tmp_path / "s.db", paths, jobs=2, on_progress=kill)

    failed = [o.path for o in outcomes if o.error]
    assert failed == victims
    assert "the process that read it was killed by signal 9" in str(
        next(o.error for o in outcomes if o.error)
    )
    assert [o.path for o in outcomes] == paths
    assert [o.status for o in ingest(tmp_path / "s.db", paths)].count("present") == 4


def test_a_map_that_is_none_stops_before_a_process_is_begun(
    mixed: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subprocess, "Popen", None)

    with pytest.raises(MapError):
        ingest(tmp_path / "s.db", mixed, jobs=2, road_map=tmp_path / "none.xodr")


# Again, anew, and only in thought


def test_what_looks_the_same_is_not_hashed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = drive(tmp_path / "d.mcap", frames=5)
    ingest(tmp_path / "s.db", [path])

    def hashed(*_: object, **__: object) -> Iterator[None]:
        raise AssertionError("hashed")

    monkeypatch.setattr(hashlib, "file_digest", hashed)
    (outcome,) = ingest(tmp_path / "s.db", [path])

    assert outcome.status == "present"


def test_what_was_touched_is_known_by_its_content(tmp_path: Path) -> None:
    path = drive(tmp_path / "d.mcap", frames=5)
    ingest(tmp_path / "s.db", [path])
    os.utime(path, ns=(1, 1))

    assert [o.status for o in ingest(tmp_path / "s.db", [path])] == ["present"]


def test_what_is_there_is_read_anew_and_replaced_by_force(tmp_path: Path) -> None:
    paths = made(tmp_path, frames=30)
    ingest(tmp_path / "s.db", paths)
    before = content(tmp_path / "s.db")
    small = Config(range=RangeSettings(15.0))

    outcomes = ingest(tmp_path / "s.db", [paths[1]], config=small, force=True)

    assert [(o.status, o.name) for o in outcomes] == [("replaced", "b")]
    store = StoreFile(tmp_path / "s.db")
    assert store.trace("b").settings["range"]["radius"] == 15
    assert store.verify().faults == []
    ingest(tmp_path / "s.db", [paths[1]], force=True)
    after = content(tmp_path / "s.db")
    assert after == before, "settings that have come and gone have the same number"


def test_force_reads_what_is_not_there(tmp_path: Path) -> None:
    (outcome,) = ingest(tmp_path / "s.db", [drive(tmp_path / "d.mcap", frames=5)], force=True)

    assert outcome.status == "added"


def test_a_trial_says_what_would_be_done_and_does_nothing(tmp_path: Path) -> None:
    paths = made(tmp_path, frames=10)
    ingest(tmp_path / "s.db", paths[:1])
    before = (tmp_path / "s.db").read_bytes()

    found = ingest(tmp_path / "s.db", [*paths, tmp_path / "none.mcap"], dry_run=True)
    nothing = ingest(tmp_path / "t.db", paths[:1], dry_run=True)

    assert [o.status for o in found] == ["present", "new", "new", "new", "failed"]
    assert [o.status for o in nothing] == ["new"]
    assert (tmp_path / "s.db").read_bytes() == before
    assert not (tmp_path / "t.db").exists()


# In part


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """260 frames, ten a second; beside it a store of all of them."""
    path = drive(tmp_path_factory.mktemp("long") / "d.mcap", frames=260)
    ingest(path.with_name("all.db"), [path])
    return path


def edges(store: Path) -> set[tuple[Any, ...]]:
    sql = "SELECT time_ns, src, relation, dst FROM edges JOIN frames USING (frame_id)"
    return set(rows(store, sql))


@pytest.mark.parametrize(
    ("part", "times"),
    [
        ({"since": 12.05}, range(121, 260)),
        ({"until": 3.0}, range(31)),
        ({"rate": 3}, [i for i in range(260) if i == 0 or i * 3 // 10 != (i - 1) * 3 // 10]),
        ({"since": 12.0, "until": 25.0, "rate": 1}, range(120, 251, 10)),
    ],
)
def test_a_part_is_the_same_frames_with_the_same_edges(
    long: Any, tmp_path: Path, part: Any, times: Any
) -> None:
    everything = long.with_name("all.db")
    (outcome,) = ingest(tmp_path / "part.db", [long], **part)

    expected = [i * 100_000_000 for i in times]
    assert outcome.frames == len(expected)
    found = rows(tmp_path / "part.db", "SELECT seq, time_ns FROM frames ORDER BY seq")
    assert found == list(enumerate(expected))
    wanted = set(expected)
    assert edges(tmp_path / "part.db") == {e for e in edges(everything) if e[0] in wanted}
    sql = "SELECT time_ns, channel, message_offset, chunk_offset FROM payloads JOIN frames USING (frame_id)"
    payloads = {row for row in rows(everything, sql) if row[0] in wanted}
    assert {r for r in rows(tmp_path / "part.db", sql) if r[1] == "truth"} == {
        r for r in payloads if r[1] == "truth"
    }
    assert StoreFile(tmp_path / "part.db").verify().faults == []


def test_a_part_is_another_reading_of_the_trace(long: Any, tmp_path: Path) -> None:
    ingest(tmp_path / "s.db", [long], until=3.0)

    (same,) = ingest(tmp_path / "s.db", [long], until=3.0)
    (other,) = ingest(tmp_path / "s.db", [long], until=4.0)
    (anew,) = ingest(tmp_path / "s.db", [long], until=4.0, force=True)

    assert same.status == "present"
    assert "already in the store as 'd', read in another part" in str(other.error)
    assert (anew.status, anew.frames) == ("replaced", 41)
    assert StoreFile(tmp_path / "s.db").trace("d").until == 4.0


def test_a_part_without_frames_is_told(long: Any, tmp_path: Path) -> None:
    (outcome,) = ingest(tmp_path / "s.db", [long], since=99)

    assert isinstance(outcome.error, TraceError)
    assert "it goes from 0 s to 25.9 s" in str(outcome.error)


# Several egos


@pytest.fixture(scope="module")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six cars and a person; car 5 comes late and car 6 goes early."""
    path = tmp_path_factory.mktemp("crowd") / "crowd.mcap"
    with Recorder(path) as recorder:
        recorder.map(a_map(a_road("1", line(200.0, x=-20.0, y=2.0))))
        for i in range(80):
            here = [k for k in range(1, 7) if not (k == 5 and i < 65) and not (k == 6 and i > 30)]
            cars = [car(k, 15.0 * k + i / 10, 3.5 * (k % 2), v=(1, 0)) for k in here]
            recorder.ground_truth(i / 10, [*cars, person(9, 20.0, 5.0)], host=1)
    return path


def of_trace(store: Path, name: str) -> dict[str, list[tuple[Any, ...]]]:
    """What a store holds of a trace, by the ids that all stores share."""
    trace = StoreFile(store).trace(name)
    low, high = trace.trace_id << 24, (trace.trace_id + 1) << 24
    return {
        "nodes": rows(
            store,
            f"SELECT * EXCLUDE (trace) FROM nodes WHERE frame_id BETWEEN {low} AND {high} ORDER BY ALL",
        ),
        "edges": rows(
            store,
            f"SELECT * EXCLUDE (trace) FROM edges WHERE frame_id BETWEEN {low} AND {high} ORDER BY ALL",
        ),
        "frames": rows(
            store,
            f"SELECT frame_id, seq, time_ns, ego FROM frames WHERE frame_id BETWEEN {low} AND {high}",
        ),
    }


SMALL = Config(range=RangeSettings(25.0))


@pytest.fixture(scope="module")
def alone(crowd: Path) -> dict[str, dict[str, list[tuple[Any, ...]]]]:
    """The trace of each of three egos in a store of its own."""
    found: dict[str, dict[str, list[tuple[Any, ...]]]] = {}
    for ego in ("5", "1", "6"):
        store = crowd.with_name(f"{ego}.db")
        ingest(store, [crowd], config=replace(SMALL, ego=ego))
        found[ego] = of_trace(store, "crowd")
    return found


@pytest.mark.parametrize("at_once", [2, 8])
def test_each_of_several_egos_has_the_trace_that_it_would_have_alone(
    crowd: Any, alone: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    """In one reading, or in several that share the rows of the map and the classes of their frames."""
    monkeypatch.setattr(recording_ingest, "EGOS_AT_ONCE", at_once)

    outcomes = ingest(tmp_path / "s.db", [crowd], config=SMALL, egos=["5", "1", "6"])

    assert [(o.ego, o.status, o.name) for o in outcomes] == [
        ("5", "added", "crowd"),
        ("1", "added", "crowd~2"),
        ("6", "added", "crowd~3"),
    ]
    for outcome in outcomes:
        assert of_trace(tmp_path / "s.db", outcome.name) == alone[outcome.ego]
    again = ingest(tmp_path / "s.db", [crowd], config=SMALL, egos=["1", "2"])
    assert [(o.ego, o.status) for o in again] == [("1", "present"), ("2", "added")]


def test_names_of_egos_are_looked_up_in_a_recording_that_is_open(
    crowd: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Path] = []

    def open_trace(path: Path, **options: Any) -> Any:
        opened.append(path)
        return readers.open_trace(path, **options)

    monkeypatch.setattr(recording_ingest, "open_trace", open_trace)
    config = Config(egos=("5", "1", "nobody"), exclude_ids=("2", "somebody"))

    outcomes = ingest(tmp_path / "s.db", [crowd], config=config)

    assert [o.status for o in outcomes] == ["added", "added", "failed"]
    assert opened == [crowd]
    message = str(outcomes[2].error)
    (alone,) = ingest(tmp_path / "alone.db", [crowd], config=Config(ego="nobody"))
    assert message == str(alone.error)


def test_every_vehicle_can_be_an_ego(crowd: Any, tmp_path: Path) -> None:
    outcomes = ingest(tmp_path / "s.db", [crowd], egos=["all"], jobs=2)

    assert sorted(o.ego for o in outcomes) == ["1", "2", "3", "4", "5", "6"]
    assert {o.status for o in outcomes} == {"added"}
    egos = rows(tmp_path / "s.db", "SELECT DISTINCT name FROM inside.trace ORDER BY ALL")
    assert len(egos) == 6
    assert StoreFile(tmp_path / "s.db").verify().faults == []


def test_an_ego_that_is_not_in_the_recording_costs_no_other(crowd: Any, tmp_path: Path) -> None:
    outcomes = ingest(tmp_path / "s.db", [crowd], egos=["1", "nobody", "2"])

    assert [o.status for o in outcomes] == ["added", "failed", "added"]
    assert "nobody" in str(outcomes[1].error)


def test_an_ego_that_comes_only_after_the_part_is_told(crowd: Any, tmp_path: Path) -> None:
    outcomes = ingest(tmp_path / "s.db", [crowd], egos=["1", "5"], until=2.0)

    assert [(o.status, o.frames) for o in outcomes] == [("added", 21), ("failed", 0)]
    assert "the ego '5' is missing from all frames" in str(outcomes[1].error)


# Which files


def test_files_folders_and_patterns_are_meant_each_once(tmp_path: Path) -> None:
    (tmp_path / "day1" / "deep").mkdir(parents=True)
    (tmp_path / "day[2]").mkdir()
    names = [
        "b.mcap",
        "a.mcap",
        "day1/deep/c.MCAP",
        "day1/d.osi",
        "day[2]/e.mcap",
        "day1/notes.txt",
    ]
    for name in names:
        (tmp_path / name).write_bytes(b"")

    def meant(*given: str) -> list[str]:
        found = recordings([tmp_path / name for name in given])
        return [path.relative_to(tmp_path).as_posix() for path in found]

    assert meant("day1") == ["day1/d.osi", "day1/deep/c.MCAP"]
    assert meant("*.mcap", "b.mcap") == ["a.mcap", "b.mcap"]
    assert meant("b.mcap", "a.mcap", "b.mcap") == ["b.mcap", "a.mcap"]
    assert meant("**/*.mcap") == ["a.mcap", "b.mcap", "day[2]/e.mcap"]
    assert meant("day[2]") == ["day[2]/e.mcap"]
    assert meant("none.mcap") == ["none.mcap"]
    assert meant("day?") == ["day1/d.osi", "day1/deep/c.MCAP"]


@pytest.mark.parametrize("name", ["empty", "*.mcap"])
def test_a_folder_or_pattern_that_means_nothing_is_told(tmp_path: Path, name: Any) -> None:
    (tmp_path / "empty").mkdir()

    with pytest.raises(StoreError, match=r"no recording \(\.mcap|no file matches this pattern"):
        recordings([tmp_path / name])


def test_who_names_the_egos_is_not_told_that_there_are_several(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Bridge(path) as bridge:
        bridge.actors({1: ("vehicle.audi.tt", "hero"), 2: ("vehicle.audi.tt", "ego_vehicle")})
        bridge.objects(0.0, [vehicle(1), vehicle(2, 20.0)])

    (alone,) = ingest(tmp_path / "one.db", [path])
    named = ingest(tmp_path / "two.db", [path], egos=["hero", "ego_vehicle"])

    assert any(warning.startswith("several egos: ") for warning in alone.warnings)
    assert [outcome.status for outcome in named] == ["added", "added"]
    assert not any("ego" in warning for outcome in named for warning in outcome.warnings)
    store = StoreFile(tmp_path / "two.db")
    assert not any("ego" in warning for one in store.traces() for warning in one.report["warnings"])


def test_another_mapping_is_another_configuration(tmp_path: Path) -> None:
    path, mapping = tmp_path / "a.mcap", tmp_path / "m.toml"
    with SceneRecorder.of(path, "json") as recorder:
        recorder.scene(1.0, [cube("a", type="car", kind="bus")])
    config = Config(mapping=str(mapping))

    def again(text: str) -> TraceOutcome:
        mapping.write_text(text)
        return ingest(tmp_path / "s.db", [path], config=config)[0]

    assert again('[entity]\ntype = "metadata.type"\n').status == "added"
    assert again('# the same\n[entity]\ntype = "metadata.type"\n').status == "present"
    changed = again('[entity]\ntype = "metadata.kind"\n')
    assert (changed.status, "with other settings" in str(changed.error)) == ("failed", True)
