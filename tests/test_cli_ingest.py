"""Verbs about recordings and stores, as a shell runs them."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from recordings import drive

from sgstore.ingest import ingest
from sgstore.store import StoreFile

SAMPLE = Path(str(files("sgstore"))) / "sample" / "town.mcap"


def sgstore(*arguments: object, stdin: str = "") -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-m", "sgstore", *map(str, arguments)],
        input=stdin.encode(),
        capture_output=True,
        check=False,
    )


def in_json(*arguments: object) -> Any:
    run = sgstore(*arguments, "--json")
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cli")
    ingest(folder / "s.db", [drive(folder / "drive.mcap", frames=20)])
    return folder / "s.db"


# payload


def test_a_payload_is_written_to_a_file_or_to_stdout(store, tmp_path) -> None:
    expected = StoreFile(store).payload("drive#3", "camera")

    run = sgstore("payload", store, "drive#3", "camera", "-o", tmp_path / "p.bin")

    assert run.returncode == 0
    assert (tmp_path / "p.bin").read_bytes() == expected
    assert f"{len(expected)} bytes (message)" in run.stderr.decode()
    assert sgstore("payload", store, "drive#3", "camera").stdout == expected


def test_without_a_channel_those_of_the_frame_are_listed(store) -> None:
    rows = in_json("payload", store, "drive#3")

    assert [(row["channel"], row["length"]) for row in rows if row["channel"] == "camera"] == [
        ("camera", 200)
    ]
    assert {row["channel"] for row in rows} == {"camera", "truth"}


def test_the_camera_of_the_sample_gives_a_jpeg_and_its_message_around_it(tmp_path) -> None:
    ingest(tmp_path / "s.db", [SAMPLE])
    topic = "/ego/camera/front/image"

    picture = sgstore("payload", tmp_path / "s.db", "town#264", topic).stdout
    message = sgstore("payload", tmp_path / "s.db", "town#264", topic, "--message").stdout

    assert (picture[:3], picture[-2:]) == (b"\xff\xd8\xff", b"\xff\xd9")
    assert len(message) > len(picture)
    assert picture in message


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("drive#3", "kamera"), "did you mean 'camera'?"),
        (("drive#99", "camera"), "it has frames #0 … #19"),
        (("drive#3", "camera", "-o", "/nowhere/p.bin"), "No such file or directory"),
    ],
)
def test_a_payload_that_cannot_be_had_is_told(store, arguments, reason) -> None:
    run = sgstore("payload", store, *arguments)

    assert run.returncode == 1
    assert reason in run.stderr.decode()
