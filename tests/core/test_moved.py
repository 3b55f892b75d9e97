"""A data set that has moved: its recordings are found beneath a root."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest
from recordings import drive

import sgstore
from sgstore.apps.cli import run
from sgstore.errors import TraceError
from sgstore.ingest import ingest
from sgstore.pipeline.rebuild import rebuild

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def moved(tmp_path: Path) -> Path:
    """A store whose recordings, two of one name, were moved from ``old/town`` to ``new/disk/town``."""
    for day, frames in (("mon", 12), ("tue", 14)):
        (tmp_path / "old" / "town" / day).mkdir(parents=True)
        drive(tmp_path / "old" / "town" / day / "a.mcap", frames=frames)
    ingest(tmp_path / "s.sgstore", sorted((tmp_path / "old").rglob("*.mcap")))
    (tmp_path / "new").mkdir()
    shutil.move(tmp_path / "old", tmp_path / "new" / "disk")
    return tmp_path / "s.sgstore"


@pytest.mark.parametrize("root", ["new", "new/disk", "new/disk/town"])
def test_payloads_of_a_moved_data_set_are_read_beneath_its_root(moved: Path, root: str) -> None:
    with pytest.raises(TraceError, match="cannot be read"):
        sgstore.open(moved).payload("a#3", "camera")

    place = moved.parent / root
    store = sgstore.open(moved, root=place)

    if root == "new":  # nothing lies there by the end of its old path
        with pytest.raises(TraceError, match="cannot be read"):
            store.payload("a#3", "camera")
        return
    assert store.payload("a#3", "camera") != store.payload("a~2#13", "camera")
    assert not store.file.verify(recordings=True).faults
    days = [trace.path.parent.name for trace in store.traces()]
    assert days == ["mon", "tue"]


def test_a_variable_of_the_environment_says_the_root_to_every_verb(
    moved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    verify = ["verify", str(moved), "--payloads"]
    clips = ["export", str(moved), "MATCH (e:Ego)", "--to", str(moved.parent / "clips")]
    assert run(verify) == 1
    monkeypatch.setenv("SGSTORE_ROOT", str(moved.parent / "new" / "disk"))

    assert run(verify) == 0
    assert run(clips) == 0
    before = sgstore.open(moved).sql("SELECT * FROM nodes ORDER BY ALL").values
    assert {one.status for one in rebuild(moved)} == {"added"}
    assert sgstore.open(moved).sql("SELECT * FROM nodes ORDER BY ALL").values == before


def test_a_store_that_is_moved_together_with_its_recordings_finds_them(tmp_path: Path) -> None:
    for day in ("mon", "tue"):
        (tmp_path / "old" / day).mkdir(parents=True)
        drive(tmp_path / "old" / day / "a.mcap", frames=12 if day == "mon" else 14)
    places = sorted((tmp_path / "old").rglob("*.mcap"))
    ingest(tmp_path / "old" / "s.sgstore", places)
    shutil.move(tmp_path / "old", tmp_path / "new")
    path = tmp_path / "new" / "s.sgstore"
    store = sgstore.open(path)

    assert store.payload("a#3", "camera")
    assert not store.file.verify(recordings=True).faults
    assert [trace.path.parent for trace in store.traces()] == [
        tmp_path / "new" / "mon",
        tmp_path / "new" / "tue",
    ]
    again = ingest(path, sorted((tmp_path / "new").rglob("*.mcap")))
    assert [one.status for one in again] == ["present", "present"]
    rebuild(path)
    files = sgstore.open(path).sql("SELECT DISTINCT file FROM payloads ORDER BY ALL").values
    assert files == [(str(trace.path),) for trace in store.traces()], "an absolute path"


def test_a_copy_of_a_store_alone_finds_the_recordings_where_they_were(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    ingest(tmp_path / "old" / "s.sgstore", [drive(tmp_path / "old" / "a.mcap", frames=12)])
    (tmp_path / "copy").mkdir()
    shutil.copy(tmp_path / "old" / "s.sgstore", tmp_path / "copy")

    assert sgstore.open(tmp_path / "copy" / "s.sgstore").payload("a#3", "camera")
    drive(tmp_path / "copy" / "a.mcap", frames=3)  # another recording, of the same name
    assert sgstore.open(tmp_path / "copy" / "s.sgstore").payload("a#3", "camera")


def test_a_recording_is_one_row_whoever_was_the_ego(tmp_path: Path) -> None:
    path = tmp_path / "s.sgstore"
    ingest(path, [drive(tmp_path / "a.mcap", frames=12)])
    (tmp_path / "b").mkdir()
    shutil.move(tmp_path / "a.mcap", tmp_path / "b" / "a.mcap")
    ingest(path, [tmp_path / "b" / "a.mcap"], egos=["3"])
    store = sgstore.open(path)

    assert [trace.ego for trace in store.traces()] == ["Ego", "3"]
    assert store.file.rows("SELECT place FROM recording").values == [("b/a.mcap",)]
    assert {trace.path for trace in store.traces()} == {tmp_path / "b" / "a.mcap"}
    assert not store.file.verify(recordings=True).faults
    store.file.remove(*(trace.name for trace in store.traces()[1:]))
    assert not store.file.verify(recordings=True).faults
    store.file.remove(store.traces()[0].name)
    assert [
        store.file.rows(f"SELECT count(*) FROM {table}").values
        for table in ("recording", "map", "config", "manifest")
    ] == [[(0,)]] * 4


def test_another_file_of_the_same_name_is_passed_over(moved: Path) -> None:
    town = moved.parent / "new" / "disk" / "town"
    drive(town / "a.mcap", frames=3)
    store = sgstore.open(moved, root=town)

    assert store.payload("a#3", "camera")
    (town / "mon" / "a.mcap").unlink()
    with pytest.raises(TraceError, match="cannot be read"):
        store.payload("a#3", "camera")
