"""Verbs about recordings and stores."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest
from recordings import Recorder, car, drive

from sgstore.apps.cli import run
from sgstore.ingest import ingest
from sgstore.model.vocabulary import OWN_KINDS
from sgstore.store import StoreFile


def sgstore(*arguments: object, stdin: str = "") -> subprocess.CompletedProcess[bytes]:
    """A command line, run in this process: its exit code, and the bytes that it prints."""
    printed, told, typed = (
        io.TextIOWrapper(io.BytesIO(text.encode()), encoding="utf-8", write_through=True)
        for text in ("", "", stdin)
    )
    with redirect_stdout(printed), redirect_stderr(told), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdin", typed)
        code = run([str(argument) for argument in arguments])
    return subprocess.CompletedProcess(
        arguments, code, printed.buffer.getvalue(), told.buffer.getvalue()
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


def test_the_camera_of_the_sample_gives_a_jpeg_and_its_message_around_it(town_store) -> None:
    topic = "/ego/camera/front/image"

    picture = sgstore("payload", town_store, "town#264", topic).stdout
    message = sgstore("payload", town_store, "town#264", topic, "--message").stdout

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


# ingest


def statuses(run: subprocess.CompletedProcess[bytes]) -> dict[str, str]:
    return {Path(row["file"]).name: row["status"] for row in json.loads(run.stdout)}


def test_recordings_come_from_folders_patterns_and_a_list(tmp_path) -> None:
    for name in ("a", "b", "c", "d"):
        folder = tmp_path / f"in{name}"
        folder.mkdir()
        drive(folder / f"{name}.mcap", frames=3 + ord(name) % 7)
    store = tmp_path / "s.db"
    listed = f"{tmp_path / 'ind' / 'd.mcap'}\n\n{tmp_path / 'inc'}\n"

    trial = sgstore("ingest", store, tmp_path / "in[ab]" / "*.mcap", "--dry-run", "--json")
    first = sgstore("ingest", store, tmp_path / "in[ab]" / "*.mcap", "-j", 2, "--json")
    second = sgstore("ingest", store, tmp_path / "ina", "-", "--json", stdin=listed)

    assert statuses(trial) == {"a.mcap": "new", "b.mcap": "new"}
    assert statuses(first) == {"a.mcap": "added", "b.mcap": "added"}
    assert statuses(second) == {"a.mcap": "present", "d.mcap": "added", "c.mcap": "added"}
    assert [run.returncode for run in (trial, first, second)] == [0, 0, 0]


def test_a_part_and_egos_are_asked_for_by_options(tmp_path) -> None:
    path = drive(tmp_path / "d.mcap", frames=60)
    options = ("--since", "1s", "--until", "5000ms", "--rate", 2, "--ego", "7", "--ego", "3")

    run = sgstore("ingest", tmp_path / "s.db", path, *options, "--json")

    assert run.returncode == 0, run.stderr
    rows = [(row["trace"], row["ego"], row["frames"]) for row in json.loads(run.stdout)]
    assert rows == [("d", "Ego", 9), ("d~2", "3", 9)]
    told = sgstore("info", tmp_path / "s.db", "--trace", "d~2").stdout.decode()
    assert "from 1 s, to 5 s, 2 frames a second" in told


def test_what_was_read_otherwise_is_refused_and_replaced_by_force(tmp_path) -> None:
    path = drive(tmp_path / "d.mcap", frames=20)
    sgstore("ingest", tmp_path / "s.db", path)

    refused = sgstore("ingest", tmp_path / "s.db", path, "--rate", 1)
    forced = sgstore("ingest", tmp_path / "s.db", path, "--rate", 1, "--force", "--json")

    assert refused.returncode == 1
    assert "read with other settings; remove it, or add --force to ingest it again" in (
        refused.stderr.decode()
    )
    assert (forced.returncode, statuses(forced)) == (0, {"d.mcap": "replaced"})


@pytest.mark.parametrize(
    ("arguments", "code", "reason"),
    [
        (("nothing/*.mcap",), 1, "no file matches this pattern"),
        (("d.mcap", "--since", "soon"), 2, "expected a time"),
        (("d.mcap", "--jobs", "-1"), 2, "Invalid value"),
        (("none.mcap",), 1, "file not found"),
    ],
)
def test_wrong_use_of_ingest_is_told(tmp_path, arguments, code, reason) -> None:
    run = sgstore("ingest", tmp_path / "s.db", *arguments)

    assert run.returncode == code
    assert reason in run.stderr.decode()
    assert list(tmp_path.iterdir()) == []


# info, doctor


def damaged(folder: Path) -> Path:
    """A recording with a chunk that is hurt, a jump of the clock and a gap."""
    with Recorder(folder / "hurt.mcap", chunk_size=400, compression="") as recorder:
        for i in range(40):
            stamp = i / 10 - (2.0 if 20 <= i < 30 else 0.0) + (5.0 if i >= 35 else 0.0)
            recorder.ground_truth(i / 10, [car(7, float(i))], host=7, stamp=stamp)
    content = bytearray((folder / "hurt.mcap").read_bytes())
    content[len(content) // 3] ^= 0xFF
    (folder / "hurt.mcap").write_bytes(content)
    return folder / "hurt.mcap"


@pytest.mark.data
def test_warnings_of_the_map_are_in_the_json_of_an_ingest(data: Path, tmp_path) -> None:
    case = data / "cases" / "bugs-18-negative-lane-width"

    paths = tmp_path / "s.db", case / "negw.mcap", "--map", case / "negw.xodr"
    run = sgstore("ingest", *paths, "--json")

    (row,) = json.loads(run.stdout)
    assert any("width is negative" in warning for warning in row["warnings"]), row
    assert "width is negative" in run.stderr.decode()


def test_the_report_of_a_trace_is_kept_and_told(tmp_path) -> None:
    path = damaged(tmp_path)

    run = sgstore("ingest", tmp_path / "s.db", path, "--json")
    told = sgstore("info", tmp_path / "s.db", "--trace", "hurt").stdout.decode()
    kept = in_json("info", tmp_path / "s.db", "--trace", "hurt")

    assert run.returncode == 3
    report = kept["report"]
    assert report["losses"][0]["reason"] == "the chunk does not match its checksum"
    assert (report["entities"], report["clock_jumps"]) == ({"car": 1}, 1)
    assert report["clock_jumps_at"][0]["seconds"] == pytest.approx(-1.9)
    assert report["gaps"] >= 1
    for line in ("entities     1 car", "clock jumps  1: -1.9 s before #", "losses:", "channels:"):
        assert line in told, told
    assert "the chunk does not match its checksum; " in told
    assert [channel["topic"] for channel in kept["channels"]] == ["truth"]


def test_the_json_of_an_ingest_has_errors_and_losses_with_their_places(tmp_path) -> None:
    hurt, bad = damaged(tmp_path), tmp_path / "a_bad.mcap"
    bad.write_bytes(hurt.read_bytes()[:4])
    whole = drive(tmp_path / "whole.mcap", frames=3)

    rows = json.loads(sgstore("ingest", tmp_path / "s.db", hurt, bad, whole, "--json").stdout)

    found = {Path(row["file"]).name: row for row in rows}
    report = StoreFile(tmp_path / "s.db").trace("hurt").report
    assert "a_bad.mcap" in found["a_bad.mcap"]["error"]
    assert [found[name]["error"] for name in ("hurt.mcap", "whole.mcap")] == [None, None]
    assert found["hurt.mcap"]["losses"] == len(found["hurt.mcap"]["losses_at"]) == 1
    (loss,) = found["hurt.mcap"]["losses_at"]
    assert loss["reason"] == "the chunk does not match its checksum"
    assert loss["offset"] == report["losses"][0]["offset"] > 0
    assert found["whole.mcap"]["losses_at"] == []


def test_doctor_says_what_would_be_read_and_what_is_wrong(tmp_path) -> None:
    path = damaged(tmp_path)
    ingest(tmp_path / "s.db", [path])
    kept = StoreFile(tmp_path / "s.db").trace("hurt")

    run = sgstore("doctor", path, "--json")
    told = sgstore("doctor", path)

    (found,) = json.loads(run.stdout)
    assert (run.returncode, told.returncode) == (3, 3)
    assert (found["frames"], found["digest"], found["ego"]) == (kept.frames, kept.digest, kept.ego)
    assert json.loads(json.dumps(found["losses"])) == [
        {name: str(v) if name.endswith("_ns") else v for name, v in loss.items()}
        for loss in kept.report["losses"]
    ]
    assert found["channels"][0]["messages"] == kept.frames
    assert "the chunk does not match its checksum" in told.stdout.decode()


def test_doctor_is_well_with_what_is_well_and_fails_with_what_is_no_recording(tmp_path) -> None:
    good = drive(tmp_path / "good.mcap", frames=5)
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(good.read_bytes()[:4])
    with Recorder(tmp_path / "pictures.mcap") as recorder:
        recorder.camera(0.0)

    assert sgstore("doctor", good).returncode == 0
    both = sgstore("doctor", bad, good, "--json")
    assert both.returncode == 1
    assert [bool(found["error"]) for found in json.loads(both.stdout)] == [True, False]
    other = sgstore("doctor", tmp_path / "pictures.mcap")
    assert other.returncode == 1
    assert "cannot be read" in other.stdout.decode()
    assert "pictures.Image" in other.stdout.decode()


def test_an_ingest_reports_a_trace_that_cannot_have_the_name_of_its_file(tmp_path) -> None:
    (tmp_path / "later").mkdir()
    store, first = tmp_path / "s.db", drive(tmp_path / "same.mcap", frames=3)
    later = drive(tmp_path / "later" / "same.mcap", frames=4)

    said = [sgstore("ingest", store, one).stderr.decode() for one in (first, later, later)]

    line = f"{later}: stored as 'same~2', because the store has another trace 'same'"
    assert [line in one for one in said] == [False, True, False]


def test_an_ingest_for_another_ego_explains_the_second_trace(tmp_path) -> None:
    store, path = tmp_path / "s.db", drive(tmp_path / "drive.mcap", frames=3)
    said = [
        sgstore("ingest", store, path, *more).stderr.decode()
        for more in ((), ("--ego", "3"), ("--ego", "3"))
    ]

    reason = "stored as 'drive~2', beside 'drive', the same recording with the ego 'Ego'"
    remedy = f"sgstore remove {store} drive"
    assert [f"{reason}; to keep only one of them: {remedy}\n" in one for one in said] == [
        *(False, True, False)
    ]
    assert sgstore(*remedy.split()[1:]).returncode == 0
    names = json.loads(sgstore("info", store, "--json").stdout)
    assert [(one["trace"], one["ego"]) for one in names] == [("drive~2", "3")]


# sql


def test_sql_with_two_stores_leads_to_a_collection(store, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    other = shutil.copy(store, tmp_path / "other.db")
    run = sgstore("sql", store, other, "SELECT count(*) AS n FROM frames")
    said = " ".join(run.stderr.decode().replace("│", " ").split())

    assert run.returncode == 2
    assert "expected one store, found 2; make a collection of them" in said
    for one in (store, other):
        assert sgstore("collection", "pack", one, "fleet").returncode == 0
    rows = in_json("sql", "fleet", "--each", "SELECT count(*) AS n FROM frames")
    (bundle,) = {row["bundle"] for row in in_json("info", "fleet")}
    assert [row["bundle"] for row in rows] == [bundle]
    tables = [
        sgstore("sql", "fleet", "--each", "SELECT 1").stdout.decode(),
        sgstore("info", "fleet").stdout.decode(),
    ]
    assert all(f" {bundle[:12]} " in f" {table.replace(chr(10), ' ')} " for table in tables)


def test_sql_lists_the_topics_of_a_recording(tmp_path) -> None:
    path = drive(tmp_path / "drive.mcap", frames=3)
    run = sgstore("sql", path, "SHOW TABLES")

    assert (run.returncode, run.stdout) == (0, b"")
    assert "the tables of a recording are its topics: topic('camera')," in run.stderr.decode()


def test_sql_shortens_enumerations_in_tables_only(store) -> None:
    table = sgstore("sql", store, "DESCRIBE entities").stdout.decode()
    (kind,) = [r for r in in_json("sql", store, "DESCRIBE entities") if r["column_name"] == "kind"]

    assert max(map(len, table.splitlines())) < 100
    assert f"ENUM('car', 'truck', 'van', … {len(OWN_KINDS)} values)" in table
    assert "'roundabout'" in kind["column_type"]


def test_help_names_the_tables_of_exports_and_the_codes_of_ingest() -> None:
    texts = {verb: " ".join(sgstore(verb, "-h").stdout.decode().split()) for verb in VERBS}

    assert (
        "Export matches: clips of their recordings (mcap, the default), tables" in texts["export"]
    )
    assert "3 parts of a recording were lost" in texts["ingest"]
    assert "'SHOW TABLES' lists the views" in texts["sql"]


VERBS = ("export", "ingest", "sql")


def test_an_export_of_tables_names_the_views_without_one(store, tmp_path) -> None:
    run = sgstore("export", store, "--as", "parquet", "--to", tmp_path / "tables")

    assert "views such as pairs, lane_states, events and world_nodes are not exported" in (
        run.stderr.decode()
    )


# verify, remove


def test_a_store_is_verified_and_traces_are_removed(tmp_path) -> None:
    paths = [drive(tmp_path / f"{name}.mcap", frames=n) for name, n in (("a", 4), ("b", 5))]
    store = tmp_path / "s.db"
    ingest(store, paths)

    well = sgstore("verify", store, "--payloads")
    paths[1].unlink()
    gone = sgstore("verify", store, "--payloads", "--json")
    removed = in_json("remove", store, "b", "--compact")
    none = sgstore("remove", store, "b")

    assert (well.returncode, well.stdout) == (0, b"")
    assert "2 traces" in well.stderr.decode()
    assert "2 recordings: no fault" in well.stderr.decode()
    assert (gone.returncode, [f["check"] for f in json.loads(gone.stdout)]) == (1, ["payloads"])
    assert "ingest --force" in json.loads(gone.stdout)[0]["remedy"]
    assert "2 recordings: 1 fault; remedy: put " in gone.stderr.decode()
    assert [(row["trace"], row["frames"]) for row in removed] == [("b", 5)]
    assert (none.returncode, "no trace 'b'" in none.stderr.decode()) == (1, True)
    assert [trace.name for trace in StoreFile(store).traces()] == ["a"]
    assert sgstore("verify", store).returncode == 0


# Names of recordings


def started(*arguments: object) -> subprocess.CompletedProcess[bytes]:
    """A command line in a process of its own, whose output takes what is no Unicode."""
    command = [sys.executable, "-m", "sgstore", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, check=False)


@pytest.mark.parametrize(
    ("name", "jobs"),
    [(b"mon\xffday.mcap", 1), (b"fold\xe9/drive.mcap", 2), (b"a/\x80/b/drive.mcap", 1)],
)
def test_a_recording_whose_name_is_no_utf_8_is_refused_and_the_others_come_in(
    name: bytes, jobs: int, tmp_path: Path
) -> None:
    good, bad = tmp_path / "good.mcap", tmp_path / os.fsdecode(name)
    try:
        bad.parent.mkdir(parents=True, exist_ok=True)
        drive(bad, frames=5)
    except OSError:
        pytest.skip("a file system of Unicode alone")
    drive(good, frames=4)

    run = started("ingest", tmp_path / "s.db", tmp_path, "--jobs", jobs)

    told = run.stderr.decode()
    assert run.returncode == 1
    assert "rename it" in told
    (odd,) = [part for part in name.split(b"/") if not part.isascii()]
    assert repr(odd)[2:-1] in told
    (row,) = in_json("info", tmp_path / "s.db")
    assert (row["trace"], row["file"]) == ("good", str(good))


def test_graphs_in_a_file_whose_name_is_no_utf_8_are_refused(tmp_path: Path) -> None:
    file = tmp_path / os.fsdecode(b"g\xff.csv")
    try:
        file.write_text("graph,src,relation,dst\na,car_1,near,ego\n")
    except OSError:
        pytest.skip("a file system of Unicode alone")

    run = started("import", tmp_path / "s.db", file, "--as", "csv")

    assert run.returncode == 1
    assert r"'g\xff.csv' is not; rename it" in run.stderr.decode()
    assert not (tmp_path / "s.db").exists()
