"""Messages that are kept between two readings: the same messages, and no chunk decompressed twice."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import carla_recordings
import numpy as np
import pytest
from recordings import drive

import sgstore.mcap._chunks as chunks
import sgstore.mcap._read_ahead as ahead
import sgstore.mcap._read_ahead as spool
from sgstore.mcap import McapFile
from sgstore.model.world import FrameBlock, TraceReport
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

Told = list[tuple[int, int, int, int, int, int, bytes]]


def told(recording: McapFile, keep: Callable[[int], bool] | None = None) -> Told:
    """All messages, with their places and data."""
    return [
        (
            int(run.channel[row]),
            int(run.sequence[row]),
            int(run.log_time_ns[row]),
            int(run.publish_time_ns[row]),
            run.chunk_offset,
            int(run.offset[row]),
            bytes(run.data(row)),
        )
        for run in recording.walk(TraceReport(), keep=keep)
        for row in range(len(run))
    ]


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Offsets of the chunks that are read from the file, as they are."""
    offsets: list[int] = []
    read = chunks.read_records

    def read_records(file: Any, head: chunks.ChunkHead, **how: Any) -> Any:
        offsets.append(head.offset)
        return read(file, head, **how)

    monkeypatch.setattr(ahead, "read_records", read_records)
    return offsets


@pytest.fixture(params=["zstd", "lz4"])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "a.mcap"
    carla_recordings.drive(path, 40, everything=True, compression=request.param, chunk_size=3000)
    return path


@pytest.mark.parametrize(
    "keep", [lambda _: True, lambda channel: channel % 2 == 0], ids=["all", "some"]
)
def test_a_second_walk_gives_what_the_first_gave(path: Path, keep: Callable[[int], bool]) -> None:
    with McapFile(path) as recording:
        first = told(recording, keep)

        assert len({message[4] for message in first}) > 5
        assert told(recording) == first
        assert told(recording) == first


def test_what_is_kept_is_decompressed_once(path: Path, counted: list[int]) -> None:
    with McapFile(path) as recording:
        told(recording, lambda _: True)
        before = counted.copy()
        told(recording)

    # Those that define channels are read again, for what may be odd about the definitions.
    again = counted[len(before) :]
    assert len(before) > 2 * len(again)
    assert len(set(before)) == len(before)


@pytest.mark.parametrize("most", [0, 2000])
def test_where_there_is_no_room_chunks_are_decompressed_again(
    path: Path, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool, "MOST_SPOOLED", most)
    with McapFile(path) as recording:
        first = told(recording, lambda _: True)

        assert told(recording) == first


def test_a_full_disk_is_no_error(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def __init__(self, **_how: Any) -> None: ...

        def seek(self, _place: int) -> None:
            raise OSError(28, "No space left on device")

        def close(self) -> None: ...

    monkeypatch.setattr(spool, "SpooledTemporaryFile", Full)
    with McapFile(path) as recording:
        first = told(recording, lambda _: True)

        assert told(recording) == first


def test_more_than_memory_holds_goes_to_a_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spool, "IN_MEMORY", 1000)
    with McapFile(path) as recording:
        first = told(recording, lambda _: True)

        assert told(recording) == first


@pytest.mark.parametrize("write", [drive, carla_recordings.drive])
def test_frames_do_not_depend_on_what_is_kept(
    write: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "a.mcap", 30)
    kept = blocks(tmp_path / "a.mcap")
    monkeypatch.setattr(spool, "MOST_SPOOLED", 0)

    for one, other in zip(kept, blocks(tmp_path / "a.mcap"), strict=True):
        for name in ("seq", "time_ns", "log_time_ns", "ego"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("node", "x", "y", "heading", "vx", "light_state"):
            assert np.array_equal(
                getattr(one.states, name), getattr(other.states, name), equal_nan=True
            )
        for name in ("channel", "log_time_ns", "chunk_offset", "offset", "length"):
            assert np.array_equal(getattr(one.messages, name), getattr(other.messages, name))


def blocks(path: Path) -> list[FrameBlock]:
    with open_trace(path) as trace:
        return list(trace.blocks(7))
