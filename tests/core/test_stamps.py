"""Times of frames: stamp 0 is a time, a missing stamp is derived, and two clocks never mix."""

from __future__ import annotations

from typing import TYPE_CHECKING

import autoware_recordings
import carla_recordings
import numpy as np
import pytest
import recordings
from foxglove_scenes import SceneRecorder, cube
from recordings import car, ground_truth

from sgstore.readers import open_trace

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

Stamp = float | None
EPOCH = 1_700_000_000.0


def osi(path: Path, stamps: Sequence[Stamp], logs: Sequence[float]) -> None:
    with recordings.Recorder(path) as recorder:
        for i, (stamp, log) in enumerate(zip(stamps, logs, strict=True)):
            recorder.ground_truth(log, [car(1, x=i)], stamp=stamp, host=1)


def carla(path: Path, stamps: Sequence[Stamp], logs: Sequence[float]) -> None:
    with carla_recordings.Bridge(path) as bridge:
        for i, (stamp, log) in enumerate(zip(stamps, logs, strict=True)):
            bridge.objects(stamp or 0.0, [carla_recordings.vehicle(1, i)], log_time=log)


def autoware(path: Path, stamps: Sequence[Stamp], logs: Sequence[float]) -> None:
    with autoware_recordings.Stack(path) as stack:
        for i, (stamp, log) in enumerate(zip(stamps, logs, strict=True)):
            at = stamp or 0.0
            stack.objects(at, [autoware_recordings.thing("car", i, 0)], delay=log - at)


def foxglove(encoding: str) -> Callable[[Path, Sequence[Stamp], Sequence[float]], None]:
    def write(path: Path, stamps: Sequence[Stamp], logs: Sequence[float]) -> None:
        with SceneRecorder.of(path, encoding) as recorder:
            for i, (stamp, log) in enumerate(zip(stamps, logs, strict=True)):
                recorder.scene(log, [cube("a", (i, 0, 0), type="car", stamp=stamp)], stamped=False)

    return write


WRITERS = {
    "osi": osi,
    "carla": carla,
    "autoware": autoware,
    "foxglove protobuf": foxglove("protobuf"),
    "foxglove json": foxglove("json"),
}


@pytest.fixture(params=WRITERS)
def times(
    request: pytest.FixtureRequest, tmp_path: Path
) -> Callable[[Sequence[Stamp], Sequence[float]], list[float]]:
    """The times of frames with these stamps (``None``: missing; ROS writes 0) and log times; s."""

    def read(stamps: Sequence[Stamp], logs: Sequence[float]) -> list[float]:
        path = tmp_path / "a.mcap"
        WRITERS[request.param](path, stamps, logs)
        with open_trace(path) as trace:
            blocks = list(trace.blocks())
        return (np.concatenate([block.time_ns for block in blocks]) / 1e9).tolist()

    return read


LOGS = [EPOCH + i / 10 for i in range(5)]


@pytest.mark.parametrize("logs", [LOGS, [i / 10 for i in range(5)]], ids=["wall", "simulation"])
def test_a_simulation_that_starts_at_0_has_its_own_times(
    times: Callable, logs: list[float]
) -> None:
    assert times([0.0, 0.1, 0.2, 0.3, 0.4], logs) == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize("missing", range(5))
@pytest.mark.parametrize("start", [3.0, 40.0, EPOCH - 1e6])
def test_a_missing_stamp_gets_the_offset_of_its_neighbours(
    times: Callable, start: float, missing: int
) -> None:
    expected = [start + i / 10 for i in range(5)]
    stamps: list[Stamp] = [*expected]
    stamps[missing] = None

    assert times(stamps, LOGS) == pytest.approx(expected, abs=1e-6)


def test_a_missing_stamp_lies_between_its_neighbours_however_fast_the_clocks_run(
    times: Callable,
) -> None:
    found = times([5.0, None, None, 5.3, 5.4], [EPOCH + 2 * i for i in range(5)])

    assert found == pytest.approx([5.0, 5.1, 5.2, 5.3, 5.4], abs=1e-6)


def test_without_any_stamp_the_log_time_is_the_clock(times: Callable) -> None:
    assert times([None] * 5, LOGS) == pytest.approx(LOGS)


def test_a_simulation_that_starts_again_at_0_does_so(times: Callable) -> None:
    stamps = [5.0, 5.1, 0.0, 0.1, 0.2]

    assert times(stamps, LOGS) == pytest.approx(stamps)


def test_a_stamp_of_0_among_others_is_missing(times: Callable) -> None:
    found = times([EPOCH, EPOCH + 0.1, 0.0, EPOCH + 0.3, EPOCH + 0.4], [log + 5 for log in LOGS])

    assert found == pytest.approx(LOGS)


@pytest.mark.parametrize(
    ("stamps", "expected", "lost"),
    [
        ([0.0, 0.1, None, 0.3], [0.0, 0.1, 0.2, 0.3], 0),
        ([EPOCH, None, None, EPOCH + 0.3], [EPOCH, EPOCH + 0.1, EPOCH + 0.2, EPOCH + 0.3], 0),
        ([None, EPOCH, EPOCH + 0.1], [EPOCH, EPOCH + 0.1], 1),
        ([EPOCH, EPOCH + 0.1, None], [EPOCH, EPOCH + 0.1, EPOCH + 0.1], 0),
    ],
)
def test_a_file_without_log_times_places_a_message_between_its_neighbours(
    tmp_path: Path, stamps: list[Stamp], expected: list[float], lost: int
) -> None:
    path = tmp_path / "a.osi"
    messages = [
        ground_truth(stamp, [car(1, x=i)], host=1).SerializeToString()
        for i, stamp in enumerate(stamps)
    ]
    path.write_bytes(b"".join(len(one).to_bytes(4, "little") + one for one in messages))

    with open_trace(path) as trace:
        (block,) = trace.blocks()

    assert (block.time_ns / 1e9).tolist() == pytest.approx(expected, abs=1e-6)
    assert sum(loss.messages for loss in trace.report.losses) == lost


def test_controls_without_a_stamp_are_of_their_log_time(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with carla_recordings.Bridge(path) as bridge:
        bridge.actors({1: ("vehicle.audi.tt", "hero")})
        for i in range(4):
            bridge.objects(50 + i / 10, [carla_recordings.vehicle(1, i)], log_time=EPOCH + i / 10)
            told = carla_recordings.control(0.0, i / 10, 0.0) | {
                "header": carla_recordings.header(0.0)
            }
            name = "carla_msgs/CarlaEgoVehicleControl"
            bridge.write("/carla/hero/vehicle_control_cmd", name, told, EPOCH + i / 10)

    with open_trace(path) as trace:
        (block,) = trace.blocks()

    assert block.states.throttle.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3])


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
@pytest.mark.parametrize(("told", "there"), [(0.05, True), (0.15, False), (None, False)])
def test_a_deletion_deletes_what_is_older(
    tmp_path: Path, encoding: str, told: Stamp, there: bool
) -> None:
    path = tmp_path / "a.mcap"
    with SceneRecorder.of(path, encoding) as recorder:
        recorder.scene(0.1, [cube("a", type="car"), cube("b", type="car")])
        for kind, ident in ((0, "a"), (1, "")):
            gone = {"type": kind, "id": ident}
            if told is not None:
                gone["timestamp"] = {"sec": 0, "nsec": round(told * 1e9)}
            time = 0.2 + kind / 10
            keeper = cube("c", type="car", stamp=time)
            keeper["timestamp"] = {"sec": 0, "nsec": round(time * 1e9)}
            recorder.told("scene", "SceneUpdate", time, {"deletions": [gone], "entities": [keeper]})

    with open_trace(path) as trace:
        (block,) = trace.blocks()
    idents = [
        {block.entities.ident[node] for node in block.states.node[start:stop].tolist()}
        for start, stop in zip(block.offsets[:-1], block.offsets[1:], strict=True)
    ]

    kept = {"a", "b"} if there else set()
    assert idents == [{"a", "b"}, {"b", "c"} | kept, {"c"} | kept]
