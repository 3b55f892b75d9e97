"""A CARLA recording hurt in ten ways: what can be saved is saved, what cannot is named, and nothing costs much.

What was done to each file, and what can be had of it, stands in the README of the folder.
"""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
from carla_recordings import Bridge, light, read, states, vehicle
from mcap.reader import make_reader
from thorough import LONG

from sgstore.model.vocabulary import LIGHT_STATE_CODE

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Had = Callable[[str], tuple[Any, list[Any], Any]]

pytestmark = [pytest.mark.data, pytest.mark.seconds(6)]

UNKNOWN = LIGHT_STATE_CODE["unknown"]


class Hurt(NamedTuple):
    """What is to be had of a file: frames at least, what is said to be lost, what is said to be odd."""

    frames: int
    lost: str = ""
    odd: str = ""


FILES = {
    "clock_jump": Hurt(
        200, odd="the log clock steps back by 4.91 s before message 121 of /carla/status"
    ),
    "cut_mid_chunk": Hurt(99, lost="the file ends inside a chunk"),
    "flipped_chunk": Hurt(167, lost="the chunk cannot be decompressed"),
    "flipped_chunk_nocrc": Hurt(167, lost="the chunk cannot be decompressed"),
    "flipped_silent_nocrc": Hurt(200, odd="no chunk has a checksum"),
    "nan_poses": Hurt(200, lost="has no usable pose"),
    "no_footer": Hurt(200, odd="the file does not end with a footer"),
    "unknown_channel": Hurt(200, odd="channel '/vendor_x/blob'"),
    "zstd_bomb": Hurt(6, lost="the chunk declares 1000 bytes but holds more"),
    "zstd_bomb_fcs": Hurt(6, lost="the chunk declares 1000 bytes, the zstd frame in it 1073741824"),
}
each_file = pytest.mark.parametrize("name", FILES)
FEW = ("cut_mid_chunk", "nan_poses", "no_footer", "zstd_bomb", "zstd_bomb_fcs")
ENDED = tuple(FILES) if LONG else FEW
"""Files that the command line ingests; the library reads all of them."""

LOSS = 3
"""Exit code: finished, and something of a recording was lost."""
SECONDS, MEGABYTES = 10, 512
"""What reading any of them may cost; of a processor, of memory."""


@pytest.fixture(scope="module")
def folder(data: Path) -> Path:
    return data / "traces/carla/damaged"


@pytest.fixture(scope="module")
def had(folder: Path) -> Had:
    """All that is read of a file; each is read once."""
    return cache(lambda name: read(folder / f"{name}.mcap"))


@pytest.fixture(scope="module")
def whole(data: Path) -> dict[int, dict[str, Any]]:
    """Log time → states, of the file before it was hurt."""
    _, blocks, _ = read(data / "traces/carla/Town01.carla.mcap")
    times = np.concatenate([block.log_time_ns for block in blocks]).tolist()
    return dict(zip(times, states(blocks), strict=True))


@each_file
def test_what_can_be_saved_is_saved_and_what_is_lost_is_named(had: Had, name: str) -> None:
    hurt = FILES[name]

    _, blocks, report = had(name)

    assert report.frames >= hurt.frames
    assert report.frames == sum(map(len, blocks))
    assert bool(report.losses) is bool(hurt.lost)
    assert all(hurt.lost in loss.reason for loss in report.losses)
    assert any(hurt.odd in warning for warning in report.warnings) or not hurt.odd


@pytest.mark.parametrize(
    "name",
    ["cut_mid_chunk", "flipped_chunk", "flipped_chunk_nocrc", "no_footer", "unknown_channel"],
)
def test_every_frame_that_is_saved_is_what_it_was(
    had: Had, whole: dict[int, dict[str, Any]], name: str
) -> None:
    _, blocks, _ = had(name)
    times = np.concatenate([block.log_time_ns for block in blocks]).tolist()

    for time, ours in zip(times, states(blocks), strict=True):
        theirs = whole[time]
        assert ours.keys() == theirs.keys()
        for column in ("x", "y", "z", "heading", "vx", "ax", "length"):
            assert [s[column] for s in ours.values()] == pytest.approx(
                [s[column] for s in theirs.values()], abs=0, nan_ok=True
            )
        for ident, one in ours.items():
            assert one["light_state"] in {UNKNOWN, theirs[ident]["light_state"]}


def test_lights_are_unknown_after_a_hole(had: Had, whole: dict[int, dict[str, Any]]) -> None:
    """The messages that changed them at 10 and 12 s lie in the hole; no later frame has a message."""
    _, blocks, report = had("flipped_chunk")
    shown = [
        [s["light_state"] for s in frame.values() if s["light_state"] >= 0]
        for frame in states(blocks)
    ]
    truly = [
        [s["light_state"] for s in frame.values() if s["light_state"] >= 0]
        for frame in whole.values()
    ]

    assert shown[:99] == truly[:99]
    assert truly[132] != truly[98]
    assert [set(frame) for frame in shown[99:]] == [{UNKNOWN}] * 68
    assert {len(frame) for frame in shown} == {36}
    assert any("unknown in 68 frames" in warning for warning in report.warnings)


@pytest.mark.parametrize("lights", [True, False])
def test_only_a_recording_with_light_states_can_lose_them(tmp_path: Path, lights: bool) -> None:
    path = tmp_path / "drive.mcap"
    with Bridge(path, chunk_size=400) as bridge:
        if lights:
            bridge.light_places([light(7, 5.0, 3.0)])
            bridge.light_states({7: 0}, 0.0)
        for i in range(20):
            bridge.objects(0.1 * i, [vehicle(100, 0.5 * i)])
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    hurt, place = bytearray(path.read_bytes()), summary.chunk_indexes[-2]
    start = place.chunk_start_offset + place.chunk_length - place.compressed_size
    hurt[start : start + 8] = b"\xff" * 8
    path.write_bytes(hurt)

    _, blocks, report = read(path)

    assert report.losses
    assert 0 < sum(map(len, blocks)) < 20
    assert any("states of traffic lights" in one for one in report.warnings) is lights


def test_only_what_is_unusable_is_left_out(had: Had, whole: dict[int, dict[str, Any]]) -> None:
    _, blocks, report = had("nan_poses")
    gone = [
        (frame, ident)
        for frame, (ours, theirs) in enumerate(zip(states(blocks), whole.values(), strict=True))
        for ident in theirs.keys() - ours.keys()
    ]

    assert sorted(gone) == [(30, "105"), (60, "110"), *((frame, "503") for frame in range(90, 100))]
    assert sorted(loss.reason.split(": ")[1] for loss in report.losses) == [
        "1 state left out",
        "1 state left out",
        "10 states left out",
    ]


def test_a_recording_whose_log_times_run_back_is_read_in_their_order(
    had: Had, whole: dict[int, dict[str, Any]]
) -> None:
    _, blocks, _ = had("clock_jump")
    times = np.concatenate([block.log_time_ns for block in blocks])
    told = np.array([*whole])
    jumped = np.where(np.arange(200) < 120, told, told - 5_000_000_000)  # as the file was hurt
    jumped[51:55] = told[50]
    order = np.argsort(jumped, kind="stable")

    assert (np.diff(times) >= 0).all()
    assert times.tolist() == jumped[order].tolist()
    for ours, frame in zip(states(blocks), order.tolist(), strict=True):
        assert ours["100"]["x"] == whole[told[frame]]["100"]["x"]


INGEST = """
import json, os, re, resource, sys
from pathlib import Path
from sgstore.apps.cli import run
import sgstore.pipeline.doctor, sgstore.ingest
from sgstore.readers import READERS
seconds, to, *files = sys.argv[1:]
for file in files:
    child = os.fork()
    if not child:
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds)))
        for number, end in ((1, "out"), (2, "err")):
            os.dup2(os.open(f"{to}/{Path(file).stem}.{end}", os.O_WRONLY | os.O_CREAT), number)
        code = run(["ingest", f"{to}/{Path(file).stem}.db", file, "--json"])
        peak = re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]
        print(json.dumps([code, int(peak) / 1024]), flush=True)
        os._exit(0)
    os.waitpid(child, 0)
"""
"""Ingests files, each in a process of its own, forked from one that has loaded what all of them need."""


@pytest.fixture(scope="module")
def ended(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of what is said of each file."""
    to = tmp_path_factory.mktemp("ended")
    files = [str(folder / f"{name}.mcap") for name in ENDED]
    subprocess.run(
        [sys.executable, "-c", INGEST, str(SECONDS), to, *files], check=True, timeout=600
    )
    return to


@pytest.mark.parametrize("name", ENDED)
@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc for the peak of memory")
def test_on_the_command_line_a_loss_is_an_exit_code_and_costs_are_bounded(
    ended: Path, name: str
) -> None:
    hurt, said = FILES[name], (ended / f"{name}.err").read_text()

    *rows, last = (ended / f"{name}.out").read_text().splitlines()
    code, peak = json.loads(last)
    (row,) = json.loads("\n".join(rows))

    assert code == (LOSS if hurt.lost else 0), said
    assert row["frames"] >= hurt.frames
    assert (row["losses"] > 0) is bool(hurt.lost)
    assert hurt.lost + hurt.odd in said
    assert peak <= MEGABYTES
