"""A store made anew from its recordings holds what it held, and nothing is lost on the way."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from killing import content
from recordings import Recorder, car, drive
from test_ingest import STREET
from thorough import LONG

from sgstore.apps.cli import run
from sgstore.errors import StoreError
from sgstore.ingest import ingest
from sgstore.model.config import Config, RangeSettings, preset
from sgstore.pipeline.derive import derive, keep_abstraction
from sgstore.pipeline.importing import Words, import_graphs
from sgstore.pipeline.rebuild import rebuild
from sgstore.store import Abstracted, Remains, StoreFile
from sgstore.store._schema import schema_sql

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(30)

CSV = "graph,src,relation,dst,t\ng1,ego,near,elf_1,0\ng2,ego,visible,elf_1,0.5\n"


FEW = {"b~2", "elves", "other", "part"}
"""What a rebuild is asked about that has nothing to do with what kinds of traces there are."""


@dataclass
class Made:
    folder: Path
    store: bytes
    content: dict[str, Any]


def held(path: Path) -> dict[str, Any]:
    """All rows of a store, but for times, and for where recordings lie from its folder."""
    store = StoreFile(path)
    with store.snapshot():
        found: dict[str, Any] = dict(content(path))
        found["derived"] = store.rows(
            "SELECT * EXCLUDE (derived_at) FROM inside.derived ORDER BY name, trace_id"
        ).values
        found["order"] = [one.name for one in store.traces()]
    found["manifest"] = [row for row in found["manifest"] if row[2] != "derived"]  # holds a time
    return found


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A store with traces of every kind: settings, parts, egos, a map that was given, graphs, sets."""
    folder = tmp_path_factory.mktemp("made")
    store = folder / "s.sgstore"
    first = drive(folder / "b.mcap", frames=20)
    (folder / "street.xodr").write_text(STREET)
    with Recorder(folder / "crowd.mcap") as recorder:
        for i in range(15):
            recorder.ground_truth(i / 10, [car(n, i / 10 + 9 * n) for n in (1, 2, 3)], host=1)
    (folder / "again").mkdir()
    same_name = drive(folder / "again" / "b.mcap", frames=22)
    (folder / "elves.csv").write_text(CSV)
    outcomes = [
        *ingest(store, [first, same_name]),
        *ingest(store, [drive(folder / "bare.mcap", frames=12)], road_map=folder / "street.xodr"),
    ]
    elves = import_graphs(store, [folder / "elves.csv"], "csv", words=Words({"elf": "person"}))
    small = Config(range=RangeSettings(25.0))
    outcomes += [
        *ingest(store, [folder / "crowd.mcap"], config=small, egos=["2", "3"]),
        *ingest(store, [drive(folder / "part.mcap", frames=30)], since=0.5, until=1.6),
        *ingest(store, [drive(folder / "other.mcap", frames=9)], config=preset("carlasgg"), rate=5),
        *ingest(store, [drive(folder / "ego.mcap", frames=8)], config=Config(ego="3")),
    ]
    assert [str(one.error) for one in (*outcomes, *elves)] == ["None"] * 9
    derive(store, Config(range=RangeSettings(20.0)), "near_by", ["b", "b~2"])
    keep_abstraction(store, "roadscene2vec", ["b"])
    file = StoreFile(store)
    file.abstracted.complete("SG")
    file.remove("b")  # so that the name of the other is not the one that it would get now
    return Made(folder, store.read_bytes(), held(store))


@pytest.fixture
def store(made: Made, tmp_path: Path) -> Path:
    (tmp_path / "s.sgstore").write_bytes(made.store)
    return tmp_path / "s.sgstore"


@pytest.fixture(scope="module")
def few(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Of these traces a part, a set of graphs, other settings, and one that has derived graphs."""
    store = tmp_path_factory.mktemp("few") / "s.sgstore"
    store.write_bytes(made.store)
    for name in set(made.content["order"]) - FEW:
        StoreFile(store).remove(name)
    rebuild(store)  # so that maps have the numbers that they get when the others never were there
    return Made(made.folder, store.read_bytes(), held(store))


@pytest.fixture
def small(few: Made, tmp_path: Path) -> Path:
    (tmp_path / "s.sgstore").write_bytes(few.store)
    return tmp_path / "s.sgstore"


def change(store: Path, *statements: str) -> None:
    with duckdb.connect(str(store)) as connection:
        for statement in statements:
            connection.execute(statement)


TABLES = re.findall(r"^CREATE TABLE (\w+)", schema_sql(), re.MULTILINE)
OWN_RECORDINGS = (
    "CREATE OR REPLACE TABLE inside.trace AS SELECT t.* EXCLUDE (recording_id), r.uri, r.size,"
    " r.mtime_ns, r.digest FROM inside.trace t JOIN inside.recording r ON r.recording_id = t.recording_id",
    "DROP VIEW payloads",
    "DROP TABLE inside.recording",
    "UPDATE inside.trace SET config_id = (SELECT n FROM (SELECT config_id, row_number() OVER () AS n"
    " FROM inside.config) c WHERE c.config_id = trace.config_id)",
    "CREATE OR REPLACE TABLE inside.config AS"
    " SELECT row_number() OVER ()::INTEGER AS config_id, digest, settings FROM inside.config",
    "UPDATE inside.store_info SET value = 'before' WHERE key = 'schema_digest'",
)
"""So stores were made when each trace had the place of its recording, and settings were 1, 2, 3."""

AMONG_THE_VIEWS = (
    *(f"CREATE TABLE main.{table} AS FROM inside.{table}" for table in TABLES),
    "DROP SCHEMA inside CASCADE",
    "UPDATE main.store_info SET value = 'before' WHERE key = 'schema_digest'",
)
"""So stores were made before their tables had a schema of their own."""

MADE_BEFORE = {
    "of tables among the views": AMONG_THE_VIEWS,
    "of recordings in traces": OWN_RECORDINGS,
}
HOW = {
    "as it is": (),
    "of an older version": (
        *AMONG_THE_VIEWS,
        "DELETE FROM store_info WHERE key = 'schema_digest'",
        "UPDATE store_info SET value = '2' WHERE key = 'schema_version'",
        *(f"DROP VIEW {view}" for view in ("events", "pairs", "lane_dists", "roles")),
        "ALTER TABLE bucket DROP COLUMN joined",
        "DROP TABLE event",
        "DROP TABLE map_reach",
    ),
    "altered": (
        "CREATE MACRO abs(x) AS 1",
        "DROP TABLE inside.frame",
        "CREATE VIEW inside.frame AS SELECT * FROM read_csv('/etc/passwd')",
        "DELETE FROM inside.entity",
        "UPDATE inside.state SET x = 7",
        "CREATE OR REPLACE VIEW lanes AS SELECT 1 AS x",
    ),
}


@pytest.mark.parametrize("how", HOW if LONG else ["of an older version", "altered"])
def test_a_store_made_anew_holds_all_that_it_held(
    how: str, request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    # How tables were kept before, or what somebody altered, is the same matter for every kind of trace.
    names = ("made", "store") if how == "as it is" else ("few", "small")
    made, store = map(request.getfixturevalue, names)
    change(store, *HOW[how])
    if how == "altered":  # and beside it lies what is no store
        store.with_name(f"{store.name}.rebuild").write_bytes(b"no store")
    code = run(["rebuild", str(store), "--format", "ndjson"])
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]

    assert code == 0
    assert held(store) == made.content  # checksums included
    assert StoreFile(store).verify().faults == []
    assert sorted(row["trace"] for row in told) == sorted(made.content["order"])
    assert {row["status"] for row in told} == {"added"}
    assert list(store.parent.iterdir()) == [store]


@pytest.mark.parametrize("frames", [1, 20])
def test_classes_of_traces_are_the_same_however_many_come_in_at_once(
    frames: int, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = StoreFile(small).abstracted.classes("SG")
    change(small, "DELETE FROM inside.later_class WHERE abstraction = 'SG'")
    monkeypatch.setattr("sgstore.store._classes._TOGETHER", frames)
    written: list[int] = []
    complete = Abstracted._complete

    def counted(self: Abstracted, name: str, traces: list[int]) -> None:
        written.append(len(traces))
        complete(self, name, traces)

    monkeypatch.setattr(Abstracted, "_complete", counted)
    after = StoreFile(small).abstracted.classes("SG")

    assert sum(written) == len(FEW)
    assert (max(written) == 1) == (frames == 1)
    assert {name: values.tolist() for name, values in after.items()} == {
        name: values.tolist() for name, values in before.items()
    }
    assert StoreFile(small).verify().faults == []


@pytest.mark.parametrize("how", MADE_BEFORE)
def test_a_store_that_was_made_before_says_what_it_was_made_of(
    how: str, few: Made, small: Path
) -> None:
    """A rebuild asks no more of the old store: from equal remains it makes equal stores."""
    before = Remains.of(small)
    change(small, *MADE_BEFORE[how])

    with pytest.raises(StoreError, match="'sgstore rebuild' makes it again"):
        StoreFile(small).traces()
    assert Remains.of(small) == before
    assert {one.name for one in before.traces} == set(few.content["order"])
    assert before.maps
    assert before.sets
    assert before.abstractions


def test_what_an_older_version_did_not_keep_is_left_out_when_that_is_said(
    few: Made, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Versions 2 and 3 did not say how graphs were imported, and no other verb opens their stores."""
    report = "UPDATE trace SET report = json_merge_patch(report, '{\"import\": null}')"
    change(small, *HOW["of an older version"], report)
    before = small.read_bytes()

    assert run(["remove", str(small), "elves"]) == 1
    assert "'sgstore rebuild' makes it again" in capsys.readouterr().err
    assert run(["rebuild", str(small)]) == 1
    told = capsys.readouterr().err
    assert "'elf' is an unknown kind" in told
    assert "an older version did not keep how it was imported" in told
    assert "--leave-out 'elves'" in told
    assert small.read_bytes() == before
    assert run(["rebuild", str(small), "--leave-out", "elfs"]) == 1
    assert "no trace 'elfs'; there are: " in capsys.readouterr().err
    assert small.read_bytes() == before

    assert run(["rebuild", str(small), "--leave-out", "elves"]) == 0
    assert sorted(held(small)["order"]) == sorted(set(few.content["order"]) - {"elves"})
    assert not small.with_name(f"{small.name}.rebuild").exists()
    import_graphs(small, [few.folder / "elves.csv"], "csv", words=Words({"elf": "person"}))
    again = held(small)
    assert sorted(again.pop("order")) == sorted(few.content["order"])
    assert again["state"] == few.content["state"]
    assert StoreFile(small).verify().faults == []
    for verb in (["info"], ["verify"], ["find", "MATCH (v:Car)-[:near]->(ego)"]):
        assert run([verb[0], str(small), *verb[1:]]) == 0


def test_traces_whose_recordings_are_gone_can_be_left_out_of_an_old_store(
    few: Made, small: Path
) -> None:
    gone = (
        "UPDATE recording SET uri = uri || '.gone', place = NULL WHERE recording_id IN"
        " (SELECT recording_id FROM trace WHERE name IN ('part', 'other'))"
    )
    change(small, *HOW["of an older version"], gone)

    with pytest.raises(StoreError, match=r"(?s)2 of 4 recordings cannot be .*--leave-out TRACE"):
        rebuild(small)
    rebuild(small, leave_out=["other", "part"])
    assert set(held(small)["order"]) == set(few.content["order"]) - {"part", "other"}


def test_recordings_that_are_gone_or_changed_are_named_and_nothing_is_touched(
    few: Made, small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in few.folder.iterdir():
        if file.suffix in {".mcap", ".csv"}:
            shutil.copy2(file, tmp_path / file.name)
    moved, changed = few.folder / "part.mcap", few.folder / "other.mcap"
    before = small.read_bytes()
    try:
        moved.rename(few.folder / "part.gone")
        changed.write_bytes(changed.read_bytes()[:-1] + b"x")
        code = run(["rebuild", str(small)])
        said = capsys.readouterr().err

        assert code == 1
        assert "2 of 4 recordings cannot be read" in said
        assert f"{moved}: gone" in said
        assert f"{changed}: changed since it was ingested" in said
        assert small.read_bytes() == before
        assert run(["rebuild", str(small), "--look-in", str(tmp_path), "--jobs", "2"]) == 0
        assert StoreFile(small).trace("part").path == tmp_path / "part.mcap"
        assert StoreFile(small).verify(recordings=True).faults == []
    finally:
        (few.folder / "part.gone").rename(moved)
        shutil.copy2(tmp_path / "other.mcap", changed)
    again = held(small)
    assert [row[:2] for row in again["trace"]] == [row[:2] for row in few.content["trace"]]
    assert again["state"] == few.content["state"]


def test_a_run_that_was_stopped_goes_on_and_the_old_store_stays_till_then(
    few: Made, small: Path
) -> None:
    before = small.read_bytes()
    files: set[Path] = set()

    def stop(progress: Any) -> None:
        files.add(progress.path)
        if len(files) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rebuild(small, on_progress=stop)
    assert small.read_bytes() == before
    assert len(StoreFile(small).traces()) == 4

    statuses = [one.status for one in rebuild(small)]
    assert statuses.count("present") >= 2
    assert statuses.count("added") >= 2
    assert held(small) == few.content
    assert list(small.parent.iterdir()) == [small]


def test_what_a_stopped_run_left_of_another_store_is_not_kept(few: Made, small: Path) -> None:
    fresh = small.with_name(f"{small.name}.rebuild")
    ingest(fresh, [few.folder / "part.mcap"])  # the whole, and under other names
    rebuild(small)

    assert held(small) == few.content


def test_tables_of_others_are_not_lost(store: Path) -> None:
    change(store, "CREATE TABLE labels AS SELECT 1 AS label")
    before = store.read_bytes()

    with pytest.raises(StoreError, match="tables of other programs would be lost: labels"):
        rebuild(store)
    assert store.read_bytes() == before


@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("DROP TABLE inside.trace", "has no table 'trace'"),
        ("UPDATE inside.config SET settings = '[1]'", "cannot be read"),
        ('UPDATE inside.config SET settings = \'{"range": {"odd": 1}}\'', "odd"),
        ("DELETE FROM inside.config", "cannot be read"),
        ("UPDATE inside.trace SET name = 'same'", "two traces have the same name or id"),
        ("UPDATE inside.trace SET report = '7'", "cannot be read"),
        ("UPDATE inside.recording SET uri = '/dev/zero', size = 0, mtime_ns = 0", "/dev/zero"),
        ("DELETE FROM inside.recording", "cannot be read"),
        ("UPDATE inside.trace SET since = 'nan'", "cannot be read"),
    ],
)
def test_a_store_whose_traces_are_not_known_is_left_as_it_is(
    store: Path, statement: str, reason: str
) -> None:
    change(store, statement)
    before = store.read_bytes()

    with pytest.raises(StoreError, match=reason):
        rebuild(store)
    assert store.read_bytes() == before


def test_a_store_that_changes_meanwhile_is_not_replaced(small: Path) -> None:
    def change_once(_: Any) -> None:
        if "other" in {one.name for one in StoreFile(small).traces()}:
            StoreFile(small).remove("other")

    with pytest.raises(StoreError, match="has changed while it was made anew"):
        rebuild(small, on_progress=change_once)
    assert "other" not in {one.name for one in StoreFile(small).traces()}
    rebuild(small)
    assert len(StoreFile(small).traces()) == 3
