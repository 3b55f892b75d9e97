"""Messages of faults: a full disk, texts of a store, objects of the user, times out of range."""

from __future__ import annotations

import errno
import os
import re
import resource
import shutil
from typing import TYPE_CHECKING

import duckdb
import numpy as np
import pytest
from recordings import Recorder, car

import sgstore
from sgstore.apps.cli import run
from sgstore.base.display import excerpt, excerpts
from sgstore.errors import StoreError
from sgstore.ingest import ingest
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def recording(path: Path, times: Sequence[float], stamps: Sequence[float] = ()) -> Path:
    with Recorder(path) as recorder:
        for row, (time, stamp) in enumerate(zip(times, stamps or times, strict=True)):
            recorder.ground_truth(time, [car(1, row, 0)], host=1, stamp=stamp)
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    paths = [recording(folder / f"{name}.mcap", [0, last]) for name, last in (("a", 1), ("b", 2))]
    for outcome in ingest(folder / "s.sgstore", paths):
        assert outcome.error is None
    return folder / "s.sgstore"


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Path:
    return shutil.copy(made, tmp_path / "s.sgstore")


# A full disk --------------------------------------------------------------------------------------


def test_a_write_without_room_has_our_words(store: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))  # the nearest to a full disk
    try:
        with pytest.raises(StoreError, match="stopped at the limit of the file size"):
            StoreFile(store).remove("a")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert {trace.name for trace in StoreFile(store).traces()} == {"a", "b"}


def test_a_failed_compaction_states_the_resulting_state(
    store: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(_connection: object, _path: object) -> None:
        raise duckdb.IOException(f"IO Error: {os.strerror(errno.ENOSPC)}")

    monkeypatch.setattr("sgstore.store._rebuild.attach_empty", full)

    assert run(["remove", str(store), "--compact"]) == 1
    assert "not compacted, and not changed: the disk is full" in capsys.readouterr().err
    assert run(["remove", str(store), "a", "--compact"]) == 1
    err = capsys.readouterr().err
    assert "s.sgstore: not compacted" in err
    assert "removed: a; the file is not smaller" in err
    assert "segment" not in err
    assert [trace.name for trace in StoreFile(store).traces()] == ["b"]


# Texts of a store ---------------------------------------------------------------------------------


def test_texts_of_a_store_are_cut_in_messages() -> None:
    assert excerpt("a" * 80) == "a" * 80
    assert excerpt("a" * 10_000_000) == "a" * 79 + "…"
    assert excerpts([f"t{i}" for i in range(3000)]) == (
        "t0, t1, t2, t3, t4, t5, t6, t7 and 2992 more"
    )


def test_long_texts_of_store_info_do_not_fill_a_message(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with duckdb.connect(str(store)) as connection:
        connection.execute(
            "UPDATE inside.store_info SET value = repeat('y', 2000000) WHERE key = 'created_by'"
        )
        connection.execute("UPDATE inside.store_info SET value = '4' WHERE key = 'schema_version'")

    for line in (["verify", str(store)], ["info", str(store)]):
        assert run(line) == 1
        told = capsys.readouterr()
        assert "yyy…" in told.err + told.out
        assert len(told.err + told.out) < 2000


def test_many_tables_of_the_user_do_not_fill_a_line(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with duckdb.connect(str(store)) as connection:
        for number in range(40):
            connection.execute(f"CREATE TABLE t{number:03}_{'x' * 150} (a INT)")

    assert run(["verify", str(store)]) == 0
    err = capsys.readouterr().err
    assert "and 32 more" in err
    assert max(map(len, err.splitlines())) < 1000


# Objects of the user ------------------------------------------------------------------------------


def test_a_rewrite_names_every_object_that_it_would_drop(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["remove", str(store), "--compact"]) == 0
    with duckdb.connect(str(store)) as connection:
        connection.execute("CREATE MACRO twice(x) AS 2 * x; CREATE SEQUENCE counter")
        connection.execute(
            "CREATE SCHEMA notes; CREATE SCHEMA mine; CREATE TYPE mood AS ENUM ('a')"
        )
        connection.execute(
            "CREATE MACRO mine.rows() AS TABLE SELECT 1; CREATE TABLE mine.t (a INT)"
        )

    assert run(["remove", str(store), "a", "--compact"]) == 1
    err = capsys.readouterr().err
    for name in (
        *("mine.t", "macro twice", "macro mine.rows", "sequence counter"),
        *("type mood", "empty schema notes"),
    ):
        assert name in err
    assert "empty schema mine" not in err
    assert {trace.name for trace in StoreFile(store).traces()} == {"a", "b"}


# Times --------------------------------------------------------------------------------------------


def test_times_after_2262_are_a_named_loss(tmp_path: Path) -> None:
    times = [i / 10 for i in range(8)]
    far = [*times[:3], 1.2e10, 5e9, *times[5:]]
    path = recording(tmp_path / "far.mcap", times, far)

    (outcome,) = ingest(tmp_path / "s.sgstore", [path])

    reason = "2 time stamps are after the year 2262 (1.2e+10 s): they count as missing"
    assert [loss.reason for loss in outcome.losses] == [reason]
    rows = sgstore.open(tmp_path / "s.sgstore").sql("SELECT t FROM frames ORDER BY seq")
    np.testing.assert_allclose([row[0] for row in rows.values], times)


def test_no_duration_is_negative(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    back = [8.0 - i / 10 for i in range(21)]
    path = recording(tmp_path / "back.mcap", [i / 10 for i in range(21)], back)
    store = tmp_path / "s.sgstore"
    ingest(store, [path])

    assert StoreFile(store).trace("back").seconds == pytest.approx(2.0)
    for line in (["info", store], ["info", store, "--trace", "back"], ["doctor", path]):
        run([str(word) for word in line])
        out = capsys.readouterr().out
        assert re.findall(r" -[\d.]+ +s(?! before)", out) == []
        assert re.search(r"\b2( s, 10 Hz| s, mostly every 0.1 s| +1|, *$| s\n)", out), out
