"""Everyday faults: names of stores, missing files, missing extras, file systems without locks."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest
from recordings import Recorder, car

import sgstore
from sgstore.errors import QueryError, StoreError
from sgstore.ingest import ingest

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("everyday") / "town.mcap"
    with Recorder(path) as recorder:
        for i in range(3):
            recorder.ground_truth(i / 10, [car(7, i, v=(10, 0), name="Ego")], host=7)
    return path


@pytest.fixture(scope="module")
def path(recording: Path) -> Path:
    path = recording.with_name("town.sgstore")
    ingest(path, [recording])
    return path


@pytest.mark.parametrize(
    "name", ["run12:30.sgstore", "~x.sgstore", "file:x.sgstore", "c:d/x.sgstore"]
)
def test_a_store_has_any_name_that_duckdb_can_open(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    ingest(name, [recording])
    with sgstore.open(name) as store:
        assert store.find("MATCH (e:Ego)").count() == 3
    assert (tmp_path / name).is_file()


@pytest.mark.skipif(os.name != "posix", reason="other systems have no such names")
@pytest.mark.parametrize("name", ["what?.sgstore", "a\\b.sgstore", "f?/x.sgstore"])
def test_a_name_that_duckdb_cannot_open_is_refused_before_work_begins(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    with pytest.raises(StoreError, match="rename the store"):
        ingest(tmp_path / name, [tmp_path / "nothing.mcap"])
    assert not [one for one in tmp_path.rglob("*") if one.is_file()]


def test_a_missing_recording_is_an_error(path: Path) -> None:
    with (
        sgstore.open(path) as store,
        pytest.raises(StoreError, match=r"missing\.mcap: file not found"),
    ):
        store.ingest("missing.mcap")


@pytest.mark.parametrize(
    "text",
    [
        "CHECK a: ALWAYS ego.speed < 5\nCHECK b: ALWAYS ego.speed < 6",
        "CHECK a: ALWAYS ego.speed < 5 ROBUSTNESS CHECK ALWAYS ego.speed < 6",
        "CHECK a: ALWAYS ego.speed < 5 RETURN ego.speed CHECK b: ALWAYS ego.speed < 6",
    ],
)
def test_two_checks_without_a_semicolon_get_a_hint(path: Path, text: str) -> None:
    with (
        sgstore.open(path) as store,
        pytest.raises(QueryError, match="separate statements with a semicolon"),
    ):
        store.check(text)


def test_a_clip_names_its_trace_whole(path: Path) -> None:
    with sgstore.open(path) as store:
        with pytest.raises(StoreError, match="no trace 'tow'; did you mean 'town'"):
            list(store.shrink("MATCH (e:Ego)", "tow@0s..0.2s"))
        assert len(list(store.shrink("MATCH (e:Ego)", "town@0s..0.2s"))) == 1


def test_without_locks_one_reads_and_does_not_write(
    path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fcntl = pytest.importorskip("fcntl")

    def flock(*_: Any) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    gate = path.with_name(f"{path.name}.gate")
    gate.touch()
    with sgstore.open(path) as store:
        assert store.find("MATCH (e:Ego)").count() == 3
        with pytest.raises(StoreError, match="cannot be locked for writing") as refused:
            store.ingest(recording, force=True)
    gate.unlink(missing_ok=True)
    assert "\n" not in str(refused.value)


def test_the_demo_runs_without_extras(tmp_path: Path) -> None:
    extras = ("PIL", "matplotlib", "pyarrow", "pandas", "polars", "isal", "numba", "av", "highspy")
    hidden = f"import sys; sys.modules.update(dict.fromkeys({extras!r}))"
    told = f"{hidden}; from sgstore.apps.cli import run; sys.exit(run(['demo', 'demo']))"
    done = subprocess.run(
        [sys.executable, "-c", told], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "no picture" in done.stdout
    assert (tmp_path / "demo" / "demo.sgstore").is_file()


def test_a_connection_of_duckdb_has_no_faulty_optimizer(path: Path) -> None:
    with sgstore.duckdb(path) as connection:
        assert connection.sql("SELECT count(*) FROM frames").fetchall() == [(3,)]
        (off,) = connection.sql("SELECT current_setting('disabled_optimizers')").fetchall()[0]
        assert "common_subplan" in off
    with pytest.raises(StoreError):
        sgstore.duckdb(path.with_name("none.sgstore"))
