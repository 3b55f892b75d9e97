"""Recordings of CARLA's bridge that are cut anywhere keep what is whole, in chunks of either kind."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carla_recordings import HERO, Bridge, vehicle, walker
from thorough import some

from sgstore.errors import TraceError
from sgstore.mcap import McapFile
from sgstore.model.world import TraceReport
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from pathlib import Path

SMALL = {
    "derived_object_msgs/ObjectArray": "std_msgs/Header header\nObject[] objects",
    "derived_object_msgs/Object": "uint32 id\ngeometry_msgs/Pose pose",
}
"""Definitions of a few words, so that a file is small enough to be cut at every byte."""
CHUNK_HEAD = 9 + 8 + 8 + 8 + 4 + 4 + 0 + 8
MESSAGE_HEAD = 31


def ends_of_frames(path: Path) -> list[int]:
    """Where the messages that are frames end in a file that stores its chunks as they are."""
    with McapFile(path) as recording:
        runs = list(recording.walk(TraceReport()))
        topics = {number: channel.topic for number, channel in recording.channels.items()}
        return [
            run.chunk_offset + CHUNK_HEAD + int(run.offset[row] + MESSAGE_HEAD + run.length[row])
            for run in runs
            for row in range(len(run))
            if topics[int(run.channel[row])] == "/carla/objects"
        ]


def test_a_recording_cut_at_any_byte_keeps_every_whole_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Bridge(path, compression="", other=SMALL, chunk_size=150, summary=False) as bridge:
        bridge.actors(HERO)
        for i in range(4):
            bridge.objects(i * 0.1, [vehicle(1, i), walker(2)][: 1 + i % 2])
    whole, ends = path.read_bytes(), ends_of_frames(path)
    cut = tmp_path / "cut.mcap"
    lossless = 0

    for length in some(range(len(whole) + 1), 7):
        cut.write_bytes(whole[:length])
        expected = sum(end <= length for end in ends)
        try:
            with open_trace(cut, digest="x") as trace:
                assert sum(len(block) for block in trace.blocks(2)) == expected > 0
                lossless += not trace.report.losses
        except TraceError:
            assert expected == 0

    assert len(ends) == 4
    assert 0 < lossless < len(whole) - ends[0]


def test_a_compressed_recording_cut_at_any_byte_keeps_every_whole_chunk(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Bridge(path, other=SMALL, chunk_size=200, summary=False) as bridge:
        for i in range(6):
            bridge.objects(i * 0.1, [vehicle(1, i), walker(2)])
    whole = path.read_bytes()
    with McapFile(path) as recording:
        runs = list(recording.walk(TraceReport()))
        counts = [len(run) for run in runs]
        stops = [run.chunk_offset for run in runs[1:]]
    cut = tmp_path / "cut.mcap"
    found = []

    for length in some(range(len(whole) + 1), 7):
        cut.write_bytes(whole[:length])
        try:
            with open_trace(cut, digest="x") as trace:
                found.append(sum(len(block) for block in trace.blocks()))
        except TraceError:
            found.append(0)
        assert found[-1] >= sum(counts[: sum(stop <= length for stop in stops)])

    assert (len(counts) > 3, found[-1]) == (True, 6)
    assert found == sorted(found)
