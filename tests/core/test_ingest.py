"""Recordings into a store: what comes in, what is said of the rest, and that nothing is half done."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from children import FOLDERS
from opendrive_maps import a_map, a_road, line
from recordings import Recorder, car, drive

from sgstore import ingest as running
from sgstore.errors import MapError, StoreError, TraceError
from sgstore.ingest import ingest
from sgstore.maps import map_files as maps
from sgstore.maps.map_files import read_map_file
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config, RangeSettings
from sgstore.model.vocabulary import RELATIONS
from sgstore.pipeline import recording_ingest
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from sgstore.pipeline.recording_ingest import Progress

pytestmark = pytest.mark.seconds(11)

STREET = a_map(a_road("1", line(200.0, x=-20.0, y=2.0)))
"""A lane 200 m long under the drive."""


def rows(store: Path, sql: str) -> list[tuple[Any, ...]]:
    return StoreFile(store).rows(sql).values


def recorded(path: Path, text: str = STREET, frames: int = 12) -> Path:
    """A drive of two cars on a map that the recording carries."""
    with Recorder(path) as recorder:
        if text:
            recorder.map(text)
        for i in range(frames):
            recorder.ground_truth(i / 10, [car(7, float(i)), car(3, 12.0 + i)], host=7)
    return path


def test_a_recording_comes_in_with_its_graphs(tmp_path: Path) -> None:
    (outcome,) = ingest(tmp_path / "s.db", [recorded(tmp_path / "drive.mcap")])

    assert (outcome.status, outcome.name, outcome.frames) == ("added", "drive", 12)
    assert outcome.entities == {"car": 2}
    assert (outcome.warnings, outcome.losses, outcome.error) == ([], [], None)
    assert rows(tmp_path / "s.db", "SELECT count(*) FROM frames") == [(12,)]
    sql = "SELECT count(*) FROM edges WHERE relation = 'near' AND src_is_ego"
    assert rows(tmp_path / "s.db", sql) == [(12,)]


def test_the_store_holds_what_reader_and_generator_say(tmp_path: Path) -> None:
    path = recorded(tmp_path / "drive.mcap")
    ingest(tmp_path / "s.db", [path])
    expected: Counter[tuple[Any, ...]] = Counter()
    with open_trace(path) as trace:
        generator = SceneGraphGenerator(read_map(STREET, "town.xodr"), Config())
        for block in trace.blocks(5):
            edges = generator.block(block).edges
            seq = block.seq[edges.frame]
            columns = (seq, edges.src, edges.relation, edges.dst)
            expected.update(zip(*(column.tolist() for column in columns), strict=True))
    sql = "SELECT seq, src, relation, dst FROM edges JOIN frames USING (frame_id) WHERE src >= 0"

    found = Counter(rows(tmp_path / "s.db", sql))

    assert found == Counter({(q, s, RELATIONS[r], d): n for (q, s, r, d), n in expected.items()})


def test_many_blocks_are_as_good_as_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = drive(tmp_path / "drive.mcap", frames=130)
    found = []
    for name, size in (("one.db", 240), ("many.db", 60), ("odd.db", 17)):
        monkeypatch.setattr(running, "BLOCK_FRAMES", size)
        ingest(tmp_path / name, [path])
        found.append(rows(tmp_path / name, "SELECT * FROM inside.edge ORDER BY ALL"))

    assert found[0] == found[1] == found[2]


def test_the_same_recording_again_is_present(tmp_path: Path) -> None:
    path = recorded(tmp_path / "drive.mcap")
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(path.read_bytes())
    ingest(tmp_path / "s.db", [path])
    before = (tmp_path / "s.db").read_bytes()

    again = ingest(tmp_path / "s.db", [path, copy])

    assert [(o.status, o.name, o.frames) for o in again] == [("present", "drive", 12)] * 2
    assert (tmp_path / "s.db").read_bytes() == before


def not_opened(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Let the opening of recordings fail. The list receives their paths."""
    paths: list[Path] = []

    def opened(path: Path, **_: object) -> None:
        paths.append(path)
        raise TraceError("opened", path=path)

    monkeypatch.setattr(recording_ingest, "open_trace", opened)
    return paths


@pytest.mark.parametrize("config", [Config(), Config(ego="3")])
def test_a_recording_that_is_present_is_not_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, config: Config
) -> None:
    path = recorded(tmp_path / "drive.mcap")
    ingest(tmp_path / "s.db", [path], config=config)
    expected = ingest(tmp_path / "s.db", [copy_of(path)], config=config)[0].as_dict()
    opened = not_opened(monkeypatch)

    (outcome,) = ingest(tmp_path / "s.db", [path], config=config)

    assert outcome.as_dict() | {"path": "", "seconds": 0} == expected | {"path": "", "seconds": 0}
    assert (outcome.status, outcome.ego, opened) == ("present", config.ego or "7", [])


def copy_of(path: Path) -> Path:
    """Return another file with the same content, which the store does not know."""
    found = path.with_stem(f"{path.stem}-copy")
    found.write_bytes(path.read_bytes())
    return found


def test_a_recording_is_opened_if_anything_of_its_request_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, store = recorded(tmp_path / "drive.mcap", text=""), tmp_path / "s.db"
    street = tmp_path / "street.xodr"
    street.write_text(STREET)
    ingest(store, [path], road_map=street)
    opened = not_opened(monkeypatch)
    ingest(store, [path], road_map=street)
    assert not opened
    others: list[dict[str, Any]] = [
        {"road_map": None},
        {"config": Config(ego="3")},
        {"config": Config(egos=("7",))},
        {"config": Config(range=RangeSettings(20.0))},
        {"since": 0.5},
        {"rate": 5.0},
        {"force": True},
    ]

    for number, other in enumerate(others, 1):
        ingest(store, [path], **{"road_map": street, **other})
        assert len(opened) == number, other

    street.write_text(STREET.replace('x="-20.0"', 'x="-21.0"'))
    ingest(store, [path], road_map=street)
    assert len(opened) == len(others) + 1
    path.touch()
    street.write_text(STREET)
    ingest(store, [path], road_map=street)
    assert len(opened) == len(others) + 2


def test_a_trace_with_other_settings_than_its_request_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, store = recorded(tmp_path / "drive.mcap"), tmp_path / "s.db"
    ingest(store, [path])
    with duckdb.connect(store) as connection:
        connection.execute("UPDATE inside.config SET digest = 'other'")
    opened = not_opened(monkeypatch)

    ingest(store, [path])

    assert opened == [path]


def test_the_same_recording_with_other_settings_is_refused(tmp_path: Path) -> None:
    path = recorded(tmp_path / "drive.mcap")
    ingest(tmp_path / "s.db", [path])
    before = (tmp_path / "s.db").read_bytes()

    (outcome,) = ingest(tmp_path / "s.db", [path], config=Config(range=RangeSettings(20.0)))

    assert outcome.status == "failed"
    assert "already in the store as 'drive', read with other settings" in str(outcome.error)
    assert (tmp_path / "s.db").read_bytes() == before


def test_one_that_fails_does_not_stop_the_others(tmp_path: Path) -> None:
    good = [recorded(tmp_path / f"{name}.mcap", frames=n) for name, n in (("a", 3), ("b", 4))]
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"no recording")

    outcomes = ingest(tmp_path / "s.db", [good[0], bad, tmp_path / "none.mcap", good[1]])

    assert [o.status for o in outcomes] == ["added", "failed", "failed", "added"]
    assert all(isinstance(o.error, TraceError) for o in outcomes[1:3])
    assert [name for (name,) in rows(tmp_path / "s.db", "SELECT name FROM inside.trace")] == [
        "a",
        "b",
    ]


# Maps


def test_the_map_that_is_given_serves_recordings_without_their_own(tmp_path: Path) -> None:
    (tmp_path / "street.xodr").write_text(STREET)
    paths = [recorded(tmp_path / "bare.mcap", text=""), recorded(tmp_path / "own.mcap")]

    outcomes = ingest(tmp_path / "s.db", paths, road_map=tmp_path / "street.xodr")

    assert [o.warnings for o in outcomes] == [[], []]
    sql = "SELECT DISTINCT trace, map FROM frames ORDER BY trace"
    # The text is the same, and so is the map: it is in the store once, under its first name.
    assert rows(tmp_path / "s.db", sql) == [("bare", "street.xodr"), ("own", "street.xodr")]
    assert rows(tmp_path / "s.db", "SELECT count(*) FROM inside.map") == [(1,)]


def test_a_recording_without_a_map_comes_in_without_roads_and_it_is_said(tmp_path: Path) -> None:
    (outcome,) = ingest(tmp_path / "s.db", [recorded(tmp_path / "bare.mcap", text="")])

    assert outcome.status == "added"
    assert outcome.warnings == [
        "no road map: without road nodes and without relations that need them"
    ]
    assert rows(tmp_path / "s.db", "SELECT count(*) FROM nodes WHERE node_id < 0") == [(0,)]
    (trace,) = StoreFile(tmp_path / "s.db").traces()
    assert "isIn" not in trace.answers
    assert trace.report["warnings"] == outcome.warnings


def test_a_map_in_a_recording_that_cannot_be_read_is_a_warning(tmp_path: Path) -> None:
    path = recorded(tmp_path / "drive.mcap", text="<OpenDRIVE/>")

    (outcome,) = ingest(tmp_path / "s.db", [path])

    assert outcome.status == "added"
    assert outcome.warnings[0].startswith("its road map cannot be read: ")


def test_a_map_is_read_once_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = []
    monkeypatch.setattr(maps, "read_map", lambda *map_: (read.append(map_), read_map(*map_))[1])
    paths = [recorded(tmp_path / f"{n}.mcap", frames=n) for n in (2, 3, 4)]

    ingest(tmp_path / "s.db", paths)

    assert len(read) == 1


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "No such file"),
        (b"no xml", r"street\.xodr: "),
        (b"<OpenDRIVE/>", r"street\.xodr: "),
        (b"\xff\xfe\xff", "cannot be read as an OpenDRIVE map"),
        (b"<?xml version='1.0' encoding='klingon'?><OpenDRIVE/>", "klingon"),
    ],
)
def test_a_map_that_is_given_and_is_none_stops_before_anything_is_done(
    tmp_path: Path, content: Any, reason: Any
) -> None:
    path = recorded(tmp_path / "drive.mcap")
    if content is not None:
        (tmp_path / "street.xodr").write_bytes(content)

    with pytest.raises(MapError, match=reason):
        ingest(tmp_path / "s.db", [path], road_map=tmp_path / "street.xodr")

    assert not (tmp_path / "s.db").exists()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1"])
def test_a_map_is_read_in_the_encoding_that_it_names(tmp_path: Path, encoding: Any) -> None:
    named = f"<?xml version='1.0' encoding='{encoding.removesuffix('-sig')}'?>"
    text = named + STREET.replace('name="test"', 'name="Größe"')
    (tmp_path / "street.xodr").write_bytes(text.encode(encoding))

    assert "Größe" in read_map_file(tmp_path / "street.xodr").text


# Bad input leaves everything as it was


def bad_inputs(folder: Path) -> dict[str, Path]:
    empty = folder / "empty.mcap"
    empty.write_bytes(b"")
    text = folder / "text.mcap"
    text.write_text("this is not a recording")
    other = folder / "pictures.mcap"
    with Recorder(other) as recorder:
        recorder.camera(0.0)
    return {
        "none": folder / "none.mcap",
        "empty": empty,
        "text": text,
        "other": other,
        "folder": folder,
    }


@pytest.mark.parametrize("name", ["none", "empty", "text", "other", "folder"])
def test_bad_input_makes_no_store(tmp_path: Path, name: Any) -> None:
    (tmp_path / "in").mkdir()
    path = bad_inputs(tmp_path / "in")[name]

    (outcome,) = ingest(tmp_path / "s.db", [path])

    assert (outcome.status, outcome.name) == ("failed", "")
    assert str(path) in str(outcome.error)
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize("name", ["none", "empty", "text", "other", "folder"])
def test_bad_input_leaves_a_store_byte_for_byte(tmp_path: Path, name: Any) -> None:
    (tmp_path / "in").mkdir()
    ingest(tmp_path / "s.db", [recorded(tmp_path / "in" / "drive.mcap", frames=3)])
    before = (tmp_path / "s.db").read_bytes()

    ingest(tmp_path / "s.db", [bad_inputs(tmp_path / "in")[name]])

    assert (tmp_path / "s.db").read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "s.db"]


def test_what_is_no_store_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / "s.db").write_text("my diary")

    with pytest.raises(StoreError, match="not a store"):
        ingest(tmp_path / "s.db", [recorded(tmp_path / "drive.mcap")])

    assert (tmp_path / "s.db").read_text() == "my diary"


# Long runs


def test_progress_is_told_block_by_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "BLOCK_FRAMES", 60)
    path = drive(tmp_path / "drive.mcap", frames=130, chunk_size=2000)
    seen: list[Progress] = []

    ingest(tmp_path / "s.db", [path], on_progress=seen.append)

    assert [p.frames for p in seen] == [60, 120, 130]
    reached = [p.bytes_done for p in seen]
    assert reached == sorted(reached)
    assert 0 < reached[0] < reached[-1] <= seen[0].size == path.stat().st_size


def test_an_interrupted_run_leaves_a_whole_store_and_nothing_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running, "BLOCK_FRAMES", 60)
    paths = [recorded(tmp_path / "a.mcap"), drive(tmp_path / "b.mcap", frames=130)]

    def interrupt(progress: Progress) -> None:
        if progress.path == paths[1]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ingest(tmp_path / "s.db", paths, on_progress=interrupt)

    assert [t.name for t in StoreFile(tmp_path / "s.db").traces()] == ["a"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "b.mcap", "s.db"]
    assert [o.status for o in ingest(tmp_path / "s.db", paths)] == ["present", "added"]


def test_ctrl_c_in_the_middle_is_an_interruption_too(tmp_path: Path) -> None:
    path = drive(tmp_path / "long.mcap", frames=1500)
    code = (
        "import sys; from sgstore import ingest as m; m.BLOCK_FRAMES = 60\n"
        f"m.ingest({str(tmp_path / 's.db')!r}, [{str(path)!r}],"
        " on_progress=lambda p: print(p.frames, flush=True))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        assert run.stdout is not None
        run.stdout.readline()
        time.sleep(0.05)
        run.send_signal(signal.SIGINT)
        _, errors = run.communicate(timeout=300)

    assert "KeyboardInterrupt" in errors
    assert [p.name for p in tmp_path.iterdir()] == ["long.mcap"]


PEAK = """
import re, sys
from pathlib import Path
sys.path[:0] = {path!r}
from graph_blocks import publish_long
from sgstore.store import StoreFile
publish_long(StoreFile.create({store!r}), {frames})
print(re.search("VmHWM: *([0-9]+)", Path("/proc/self/status").read_text().replace("\\t", " "))[1])
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peaks are told by Linux")
def test_memory_does_not_grow_with_the_length_of_a_trace(tmp_path: Path) -> None:
    peaks = []
    for frames in (600, 20_000):
        code = PEAK.format(path=FOLDERS, store=str(tmp_path / f"{frames}.db"), frames=frames)
        run = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        peaks.append(int(run.stdout))

    # Up to the rows that a transaction holds back it may grow, and not with all that the graphs take.
    assert peaks[1] < peaks[0] + 100_000, peaks
