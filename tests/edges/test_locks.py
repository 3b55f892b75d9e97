"""Locks: the same elsewhere to the byte, what changed is named, sets of cases; and stores compared."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import recordings

import sgstore
from sgstore.apps.cli import run
from sgstore.errors import ExportError, StoreError
from sgstore.ingest import ingest
from sgstore.model.config import from_dict
from sgstore.query import Store
from sgstore.store import graph_digests
from sgstore.testsets.coverage import classed, selection_of
from sgstore.testsets.diff import by_frame, matches, scenes, sources, verdicts
from sgstore.testsets.locks import (
    Lock,
    cases_of,
    frames_of_lock,
    intersect,
    minus,
    read_lock,
    union,
    verify,
)
from sgstore.testsets.selection import (
    SelectionSpec,
    SelectionUnit,
    Strategy,
    locked_selection,
    select,
)

pytest_plugins = ["pytester"]

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.seconds(12)

SAMPLE = Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap"
FRAMES = 61
NEARER = from_dict({"proximity": {"names": ["near_coll", "near"], "upper": [3.0, 12.0]}})


def made(folder: Path, name: str = "town", **how: object) -> Store:
    """A store of the first seconds of the sample, in a folder of its own, from a copy of the recording."""
    folder.mkdir(parents=True, exist_ok=True)
    copy = folder / f"{name}.mcap"
    if not copy.exists():
        shutil.copyfile(SAMPLE, copy)
    ingest(folder / "s.sgstore", [copy], until=6, **how)  # type: ignore[arg-type]
    return Store(folder / "s.sgstore")


def lock_of(store: Store, way: Strategy = Strategy.minimal, *, payloads: bool = True) -> Lock:
    found = select(
        selection_of(str(store.file.path)), SelectionSpec(way, SelectionUnit.clip, 1.0, "E")
    )
    return locked_selection(found, payloads=payloads)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory, kept_open: Callable[[Path], None]) -> Store:
    store = made(tmp_path_factory.mktemp("locks") / "here")
    kept_open(store.file.path)
    return store


@pytest.fixture(scope="module")
def lock(store: Store) -> Lock:
    return lock_of(store, Strategy.every)


def what_changed(lock: Lock, store: Store) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for one in verify(lock, store):
        found.setdefault(one.what, set()).add(one.where)
    return found


def test_made_again_in_another_folder_it_is_the_same_to_the_byte(
    lock: Lock, tmp_path: Path
) -> None:
    elsewhere = made(tmp_path / "far" / "away")

    again = lock_of(elsewhere, Strategy.every)

    assert again.text() == lock.text()
    assert str(tmp_path) not in again.text()
    assert list(verify(lock, elsewhere)) == []


def test_a_lock_is_read_as_it_was_written(lock: Lock, tmp_path: Path) -> None:
    lock.write(tmp_path / "a.lock")

    assert read_lock(tmp_path / "a.lock") == lock
    assert len(lock.text().splitlines()) > len(lock.cases) + len(lock.traces)
    with pytest.raises(ExportError, match=r"must end in \.lock"):
        lock.write(tmp_path / "a.txt")


def test_its_cases_are_the_frames_that_were_selected(store: Store, lock: Lock) -> None:
    assert sum(case.frames for case in lock.cases) == FRAMES
    assert len(frames_of_lock(lock, store)) == FRAMES
    assert cases_of(lock, store)[0] == ("town", 0, 900_000_000, "town#0-9")
    assert all(case.payload for case in lock.cases)


def test_a_changed_message_is_named_with_its_channel_and_its_case(
    lock: Lock, tmp_path: Path
) -> None:
    changed = recording_with_another_picture(tmp_path / "town.mcap")
    ingest(tmp_path / "s.sgstore", [changed], until=6)

    found = list(verify(lock, Store(tmp_path / "s.sgstore")))
    payloads = [one for one in found if one.what == "payload"]

    assert {one.what for one in found} == {"recording", "payload"}
    assert [one.where for one in payloads] == ["town#20-29"]
    assert payloads[0].detail == "/ego/camera/front/image: other messages"


def recording_with_another_picture(path: Path) -> Path:
    """The sample, but one picture of its third second ends in other bytes."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    with SAMPLE.open("rb") as source, path.open("wb") as target:
        writer = Writer(target, compression=CompressionType.NONE)
        writer.start("", "test")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        done = False
        for schema, channel, message in make_reader(source).iter_messages(log_time_order=False):
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic,
                    channel.message_encoding,
                    schemas.get(channel.schema_id, 0),
                    channel.metadata,
                )
            data = message.data
            image = channel.topic == "/ego/camera/front/image"
            if image and not done and message.log_time >= 2_400_000_000:
                data, done = data[:-4] + b"\1\2\3\4", True
            writer.add_message(
                channels[channel.id], message.log_time, data, message.publish_time, message.sequence
            )
        writer.finish()
    return path


def test_a_recording_that_was_replaced_without_being_ingested_is_named(
    lock: Lock, tmp_path: Path
) -> None:
    elsewhere = made(tmp_path)
    with (tmp_path / "town.mcap").open("ab") as file:
        file.write(b"\0")

    found = list(verify(lock, elsewhere))

    assert [(one.where, one.what) for one in found] == [("town", "payload")]
    assert "not the file that was ingested" in found[0].detail


def test_graphs_of_other_settings_are_named(lock: Lock, tmp_path: Path) -> None:
    elsewhere = made(tmp_path, config=NEARER)

    found = what_changed(lock, elsewhere)

    assert found["config"] == {"town"}
    assert found["graph"] <= {case.id for case in lock.cases}
    assert found.keys() == {"config", "graph"}
    with pytest.raises(StoreError, match="other settings"):
        cases_of(lock, elsewhere)


def test_a_graph_that_changed_is_named_and_others_are_not(lock: Lock, store: Store) -> None:
    other = replace(lock.cases[2], graph="0" * 32)
    cases = (*lock.cases[:2], other, *lock.cases[3:])

    assert what_changed(replace(lock, cases=cases), store) == {"graph": {other.id}}


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"first": -1}, "frames"),
        ({"last": 1}, "frames"),
        ({"frames": 1}, "frames"),
        ({"start_ns": -1}, "time"),
        ({"end_ns": 1}, "time"),
    ],
)
def test_a_case_of_other_frames_or_times_is_named(
    lock: Lock, store: Store, change: dict[str, int], what: str
) -> None:
    one = lock.cases[2]
    other = replace(one, **{name: getattr(one, name) + by for name, by in change.items()})
    cases = (*lock.cases[:2], other, *lock.cases[3:])

    assert other.id in what_changed(replace(lock, cases=cases), store)[what]


def test_versions_are_named_and_do_not_make_another_set(lock: Lock, store: Store) -> None:
    trace = replace(lock.traces[0], version="0.0.1")
    old = replace(lock, made_with={"sgstore": "0.0.1", "schema": "1"}, traces=(trace,))

    found = list(verify(old, store))

    assert [(one.where, one.what) for one in found] == [("lock", "version")] * 2 + [
        ("town", "version")
    ]
    assert not any(one.matters for one in found)


def test_a_trace_that_is_missing_is_named_and_its_clips_are_not_handed_out(
    lock: Lock, store: Store
) -> None:
    trace = replace(lock.traces[0], name="other", recording="0" * 64)
    cases = tuple(replace(case, trace="other") for case in lock.cases)
    other = replace(lock, traces=(trace,), cases=cases)

    assert what_changed(other, store) == {"trace": {"other"}}
    with pytest.raises(StoreError, match="no trace 'other' of the recording"):
        cases_of(other, store)


def test_a_digest_tells_every_number_and_every_edge_apart(store: Store) -> None:
    ids = frames_of_lock(lock_of(store, Strategy.every, payloads=False), store)

    alone = graph_digests(store.file, [ids[i : i + 1] for i in range(len(ids))])
    pairs = graph_digests(store.file, [ids[i : i + 2] for i in range(0, len(ids) - 1, 2)])

    assert len(set(alone)) == len(ids)  # things move: no two graphs are the same to the last bit
    assert not set(alone) & set(pairs)
    assert graph_digests(store.file, [ids[::2]]) != graph_digests(store.file, [ids])


def test_a_digest_is_the_same_however_the_store_is_read(
    store: Store, lock: Lock, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sgstore.store._graph_digests as reading

    ids = frames_of_lock(lock, store)
    groups = [ids[30:], ids[:61:7], ids[5:50], ids[12:13]]
    whole = graph_digests(store.file, groups)
    monkeypatch.setattr(reading, "FIRST", 1)
    monkeypatch.setattr(reading, "_ROWS_TOGETHER", 1)

    assert graph_digests(store.file, groups) == whole
    assert [graph_digests(store.file, [group])[0] for group in groups] == whole


def test_a_lock_of_format_1_is_read_and_verified(store: Store, lock: Lock, tmp_path: Path) -> None:
    ids = frames_of_lock(lock, store)
    groups = [ids[case.first : case.last + 1] for case in lock.cases]
    digests = graph_digests(store.file, groups, older=True)
    cases = [replace(case, graph=one) for case, one in zip(lock.cases, digests, strict=True)]
    cases[3] = replace(cases[3], graph="0" * 32)
    old = replace(lock, cases=tuple(cases), format=1)
    old.write(tmp_path / "old.lock")

    assert '"sgstore_lock": 1' in old.text()
    assert read_lock(tmp_path / "old.lock") == old
    assert what_changed(old, store) == {"graph": {cases[3].id}}
    assert union(old, old) == replace(old, selection={"union": [lock.selection, lock.selection]})
    with pytest.raises(StoreError, match="formats 1 and 2"):
        union(old, lock)


# Sets -------------------------------------------------------------------------------------------------------


def test_locks_are_sets_of_cases(lock: Lock) -> None:
    left, right = replace(lock, cases=lock.cases[:4]), replace(lock, cases=lock.cases[2:])

    assert union(left, right).cases == lock.cases
    assert intersect(left, right).cases == lock.cases[2:4]
    assert minus(left, right).cases == lock.cases[:2]
    assert minus(lock, lock).cases == ()
    assert minus(lock, lock).traces == ()
    assert union(left, right).selection["union"] == [lock.selection, lock.selection]


def test_what_shares_frames_is_taken_away_whatever_its_bounds(lock: Lock) -> None:
    part = replace(lock.cases[1], first=lock.cases[1].first + 5, last=lock.cases[2].first, id="x")

    left = minus(lock, replace(lock, cases=(part,)))

    assert left.cases == (lock.cases[0], *lock.cases[3:])


def test_two_recordings_of_one_name_get_two_names(lock: Lock) -> None:
    trace = replace(lock.traces[0], recording="1" * 64)

    both = union(lock, replace(lock, traces=(trace,)))

    assert [one.name for one in both.traces] == ["town", "town~2"]
    assert len({case.id for case in both.cases}) == 2 * len(lock.cases)


@pytest.mark.parametrize("change", [{"config": "x"}, {"map": "x"}, {"since": 1.0}])
def test_one_trace_read_in_two_ways_is_no_set(lock: Lock, change: dict[str, object]) -> None:
    other = replace(lock, traces=(replace(lock.traces[0], **change),))  # type: ignore[arg-type]

    for operation in (union, intersect, minus):
        with pytest.raises(StoreError, match="other settings"):
            operation(lock, other)


def test_one_case_of_two_contents_is_no_set(lock: Lock) -> None:
    other = replace(lock, cases=(replace(lock.cases[0], graph="0" * 32), *lock.cases[1:]))

    with pytest.raises(StoreError, match="the graph is not the same in both"):
        union(lock, other)


# What is no lock --------------------------------------------------------------------------------------------


CHANGES: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (lambda v: v.pop("cases"), "missing or unknown: 'cases'"),
    (lambda v: v.update(more=1), "missing or unknown: 'more'"),
    (lambda v: v.update(sgstore_lock=9), "expected 1 to 2: upgrade"),
    (lambda v: v.update(traces={}), "traces: expected a list"),
    (lambda v: v["cases"][0].pop("graph"), "cases[0]: expected id, trace"),
    (lambda v: v["cases"][1].update(first="0"), "cases[1].first: '0'; expected int"),
    (lambda v: v["cases"][1].update(first=True), "cases[1].first: 'True'"),
    (lambda v: v["cases"][1].update(first=9, last=8), "cases[1]: it ends before it begins"),
    (lambda v: v["cases"][1].update(last=10**12), "cases[1]: it ends before it begins"),
    (lambda v: v["cases"][1].update(start_ns=10**30), "beyond 64 bits"),
    (lambda v: v["cases"][1].update(trace="no"), "no trace 'no' among the traces"),
    (lambda v: v["cases"].append(v["cases"][0]), "two cases have one id"),
    (lambda v: v["traces"].append(v["traces"][0]), "two traces have one name"),
    (lambda v: v["cases"][0].update(payload={"a": 1}), "payload: expected texts"),
]


@pytest.mark.parametrize(("change", "says"), CHANGES)
def test_what_is_no_lock_is_refused_and_says_where(
    lock: Lock, tmp_path: Path, change: Callable[[dict[str, Any]], object], says: str
) -> None:
    values = json.loads(lock.text())
    change(values)
    path = tmp_path / "x.lock"
    path.write_text(json.dumps(values))

    with pytest.raises(StoreError) as raised:
        read_lock(path)

    assert says in str(raised.value)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize("text", [b"", b"\xff\xfe", b"[" * 100_000, b"{}", b"[]", b"NaN"])
def test_other_files_are_no_locks(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "x.lock").write_bytes(text)

    with pytest.raises(StoreError, match="not a lock"):
        read_lock(tmp_path / "x.lock")


# Locks where frames are asked for, and in pytest ------------------------------------------------------------


def test_coverage_takes_a_lock_beside_its_store_or_with_it(store: Store, lock: Lock) -> None:
    path = store.file.path.with_name("part.lock")
    replace(lock, cases=lock.cases[1:3]).write(path)

    alone, together = selection_of(str(path)), selection_of(f"{store.file.path}:{path}")

    for one in (alone, together):
        assert one.frame_id is not None
        assert len(classed(one, "E").frame_id) == 20
    copied = path.parent / "nowhere" / "part.lock"
    copied.parent.mkdir(exist_ok=True)
    shutil.copyfile(path, copied)
    with pytest.raises(StoreError, match="which store"):
        selection_of(str(copied))


def test_each_case_is_a_test(
    store: Store, lock: Lock, pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock.write(pytester.path / "tests.lock")
    pytester.makepyfile(
        f"""
        import pytest

        @pytest.mark.scenes(lock="tests.lock", store={str(store.file.path)!r})
        def test_scene(scene):
            assert len(scene.frames) in (1, 10)
            assert scene.graph(0).number_of_nodes() > 1
        """
    )
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")

    result = pytester.runpytest("-p", "sgstore.pytest_plugin", "-v")

    result.assert_outcomes(passed=len(lock.cases))
    result.stdout.fnmatch_lines(["*test_scene?town#0-9? PASSED*"])


# Two stores -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def later(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Another run of the drive: its first two seconds, with other thresholds."""
    folder = tmp_path_factory.mktemp("later")
    shutil.copyfile(SAMPLE, folder / "town.mcap")
    config = NEARER
    ingest(folder / "s.sgstore", [folder / "town.mcap"], until=2, config=config)
    return Store(folder / "s.sgstore")


def test_scenes_that_appeared_vanished_and_changed_are_told_apart(
    store: Store, later: Store
) -> None:
    a, b = (classed(selection_of(str(one.file.path)), "ER") for one in (store, later))

    rows = scenes(a, b).dicts()
    names = [{of.names[code] for code in of.code.tolist()} for of in (a, b)]

    told = {
        kind: {r["class"] for r in rows if r["change"] == kind} for kind in ("appeared", "vanished")
    }
    assert told == {"appeared": names[1] - names[0], "vanished": names[0] - names[1]}
    assert sum(r["frames_a"] for r in rows if r["change"] == "vanished") == sum(
        a.names[code] not in names[1] for code in a.code.tolist()
    )
    assert scenes(a, a).rows == []
    (row,) = by_frame(a, b).dicts()
    codes = [[of.names[code] for code in of.code.tolist()] for of in (a, b)]
    assert (row["frames_a"], row["frames_b"]) == (61, 21)
    assert row["different"] == sum(x != y for x, y in zip(*codes, strict=False))


def test_matches_and_verdicts_are_compared_by_trace(store: Store, later: Store) -> None:
    query = "MATCH (e:Ego)-[:near]->(v:Vehicle)"
    found = [{frame.seq for frame in one.find(query).frames()} for one in (store, later)]

    (row,) = matches(store, later, query, {}).dicts()
    check = "CHECK clear: ALWAYS NOT EXISTS {(e:Ego)-[:near]->(v:Vehicle)}"
    (verdict,) = verdicts(store, later, check, {}).dicts()
    (same,) = verdicts(store, store, check, {}).dicts()

    assert (row["frames_a"], row["frames_b"]) == (len(found[0]), len(found[1]))
    assert (row["only_a"], row["only_b"]) == (len(found[0] - found[1]), len(found[1] - found[0]))
    assert found[0]
    assert (verdict["a"], verdict["b"]) == ("false", "false" if found[1] else "true")
    assert verdict["change"] == "changed"
    assert same["change"] == "same"


def test_from_the_command_line(
    store: Store, later: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    here, lock = str(store.file.path), str(tmp_path / "t.lock")

    assert run(["select", here, "--minimal", "--abstraction", "E", "-o", lock]) == 0
    assert "lower bound" in capsys.readouterr().err
    assert run(["lock", "verify", lock, here]) == 0
    assert run(["lock", "verify", lock, str(later.file.path)]) == 1
    assert "config" in capsys.readouterr().out
    assert run(["diff", here, str(later.file.path), "--require", "--by-frame"]) == 4
    assert run(["diff", here, here, "--require"]) == 0
    assert run(["select", here, "--minimal", "--rarest"]) == 2
    assert run(["select", here, "-o", str(tmp_path / "t.txt")]) == 2
    assert run(["select", here, "--stratify", "trace.name"]) == 2
    assert not np.any([path.suffix == ".txt" for path in tmp_path.iterdir()])


@pytest.mark.parametrize("verb", ["select", "prioritize"])
def test_a_lock_is_there_though_nobody_reads_the_rows(
    store: Store, tmp_path: Path, verb: str
) -> None:
    lock = tmp_path / "first.lock"
    command = [sys.executable, "-m", "sgstore", verb, store.file.path, "--unit", "frame"]
    reader, writer = os.pipe()
    os.close(reader)
    subprocess.run([*command, "-o", lock], stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)

    assert len(read_lock(lock).cases) == FRAMES


def test_differences_of_settings_come_first(tmp_path: Path) -> None:
    path = recordings.drive(tmp_path / "a.mcap", frames=4)
    for name, config in (("a", {}), ("b", {"range": {"radius": 30.0}})):
        ingest(tmp_path / f"{name}.sgstore", [path], config=from_dict(config))
    before, after = (Store(tmp_path / f"{name}.sgstore") for name in "ab")

    assert sources(before, before) == []
    assert sources(before, after) == ["setting range.radius differs: 50.0 in A, 30.0 in B"]


def test_diff_lists_only_the_maps_that_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = {"a": {"Town01", "Town02", "Town03", "Town04"}}
    maps["b"] = maps["a"] | {"Town10"}
    monkeypatch.setattr("sgstore.testsets.diff._values_of", lambda of: {"map": maps[of]})

    assert sources("a", "b") == ["map differs: Town10 only in B"]  # type: ignore[arg-type]
