"""A data set that has moved: its recordings are found beneath a root."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest
from recordings import drive

import sgstore
from sgstore.cli import run
from sgstore.errors import TraceError
from sgstore.ingest import ingest
from sgstore.rebuild import rebuild

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


def test_another_file_of_the_same_name_is_passed_over(moved: Path) -> None:
    town = moved.parent / "new" / "disk" / "town"
    drive(town / "a.mcap", frames=3)
    store = sgstore.open(moved, root=town)

    assert store.payload("a#3", "camera")
    (town / "mon" / "a.mcap").unlink()
    with pytest.raises(TraceError, match="cannot be read"):
        store.payload("a#3", "camera")
