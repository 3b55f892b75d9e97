"""Stored topics stay with their traces: removed, replaced, rewritten, rebuilt, packed and landed."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import duckdb
import pytest
from thorough import LONG
from topic_recordings import topic_recording

import sgstore
from sgstore.collection import Collection, commit, land, pack, unpack
from sgstore.errors import StoreError
from sgstore.ingest import ingest
from sgstore.pipeline.rebuild import rebuild
from sgstore.store import BundleSource, Sealed, verify_file

pytestmark = [pytest.mark.seconds(13), pytest.mark.usefixtures("own_cache")]

TOPICS = ("/imu", "/planner")


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("drives")
    return [topic_recording(folder / f"{name}.mcap", n) for name, n in (("a", 3), ("b", 4))]


@pytest.fixture(scope="module")
def whole(drives: list[Path]) -> Path:
    return ingested(drives[0].with_name("whole.sgstore"), drives)


@pytest.fixture(scope="module")
def messages(whole: Path) -> dict[str, list[Any]]:
    found = rows(whole)
    assert {topic: len(its) for topic, its in found.items()} == {"/imu": 35, "/planner": 7}
    return found


def ingested(path: Path, drives: list[Path], topics: tuple[str, ...] = TOPICS) -> Path:
    assert [one.error for one in ingest(path, drives, topics=topics)] == [None] * len(drives)
    return path


def rows(path: Path, *topics: str) -> dict[str, list[Any]]:
    """All messages of the stored topics, and proof that no recording was read."""
    store = sgstore.open(path)
    found = {
        t: store.sql(f"SELECT * FROM topic('{t}') ORDER BY ALL").values for t in topics or TOPICS
    }
    known = store.catalog().topics
    assert all(known[topic].stored for topic in found)
    return found


def assert_valid(path: Path) -> None:
    assert verify_file(path).faults == []
    assert verify_file(path).others == ()


def test_a_rewritten_or_rebuilt_store_has_the_same_messages(
    whole: Path, messages: dict[str, list[Any]], tmp_path: Path
) -> None:
    path = Path(shutil.copy(whole, tmp_path / "s.sgstore"))
    sgstore.open(path).file.compact()
    assert rows(path) == messages
    rebuild(path)
    assert rows(path) == messages
    assert_valid(path)


def test_a_removed_trace_takes_its_messages_along(
    whole: Path, drives: list[Path], messages: dict[str, list[Any]], tmp_path: Path
) -> None:
    path = Path(shutil.copy(whole, tmp_path / "s.sgstore"))
    store = sgstore.open(path)
    store.file.remove("a")
    assert rows(path) == {t: [r for r in found if r[0] == "b"] for t, found in messages.items()}
    ingest(path, drives[1:], topics=["/imu"], force=True)
    assert len(rows(path, "/imu")["/imu"]) == 20
    assert not store.catalog().topics["/planner"].stored
    store.file.remove("b")
    names = store.file.rows("SELECT table_name FROM duckdb_tables() WHERE table_name LIKE 'topic%'")
    assert names.values == []


def test_collections_have_the_same_messages(
    whole: Path, drives: list[Path], messages: dict[str, list[Any]], tmp_path: Path
) -> None:
    place = tmp_path / "c"
    pack(whole, place, bundle_traces=1)
    unpack(place, tmp_path / "out.sgstore")
    assert rows(tmp_path / "out.sgstore") == messages
    assert_valid(tmp_path / "out.sgstore")
    land(tmp_path / "l", drives, topics=TOPICS)
    commit(tmp_path / "l")
    unpack(tmp_path / "l", tmp_path / "landed.sgstore")
    assert rows(tmp_path / "landed.sgstore") == messages
    if LONG:
        with Collection(place) as asked:
            found = [row[1:] for row in asked.sql("SELECT * FROM topic('/planner')", each=True)]
        assert sorted(found, key=repr) == sorted(map(tuple, messages["/planner"]), key=repr)


def test_a_part_of_a_store_has_its_messages(
    whole: Path, drives: list[Path], tmp_path: Path
) -> None:
    ids = {trace.trace_id: f"new {trace.name}" for trace in sgstore.open(whole).file.traces()[:1]}
    BundleSource(whole).write(tmp_path / "part.sgstore", ids)
    found = rows(tmp_path / "part.sgstore")
    assert {row[0] for row in found["/imu"]} == {"new a"}
    assert len(found["/imu"]) == 15
    mixed = ingested(tmp_path / "plain.sgstore", drives[1:], topics=())
    parts = [tmp_path / "part.sgstore", mixed]
    BundleSource.join(parts, tmp_path / "both.sgstore", {**ids, trace_of(mixed): "b"}, {})
    store = sgstore.open(tmp_path / "both.sgstore")
    sql = "SELECT trace, count(*) FROM topic('/imu') GROUP BY 1 ORDER BY 1"
    assert store.sql(sql).values == [("b", 20), ("new a", 15)]


def trace_of(path: Path) -> int:
    return sgstore.open(path).file.traces()[0].trace_id


def test_an_altered_table_is_not_read(whole: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(whole, tmp_path / "s.sgstore"))
    with duckdb.connect(str(path)) as connection:
        ((table,),) = connection.execute(
            "SELECT \"table\" FROM inside.topic WHERE topic = '/imu' LIMIT 1"
        ).fetchall()
        connection.execute(f"ALTER TABLE inside.{table} ADD COLUMN more INTEGER DEFAULT 3")
    assert f"inside.{table}" in verify_file(path).others
    assert not sgstore.open(path).catalog().topics["/imu"].stored


def test_a_segment_names_no_other_files(tmp_path: Path) -> None:
    told = '{"path": "a", "identity": {}, "topics": [{"topic": "/a", "parts": ["../x.parquet"]}]}'
    (tmp_path / "sealed.json").write_text(told)
    with pytest.raises(StoreError, match="outside its folder"):
        Sealed.read(tmp_path)
