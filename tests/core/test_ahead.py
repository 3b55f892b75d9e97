"""Chunks that threads decompress before their turn: the same messages and losses, and no thread is left.

Messages that are kept between two readings are the same messages, and no chunk is decompressed twice.
"""

from __future__ import annotations

import importlib
import random
import sys
import threading
import zlib
from typing import TYPE_CHECKING, Any

import carla_recordings
import numpy as np
import pytest
from carla_recordings import Bridge
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from recordings import drive
from thorough import share_of

import sgstore.mcap._chunks as chunks
import sgstore.mcap._read_ahead as ahead
import sgstore.mcap._reader as mcap_file
from sgstore.errors import TraceError
from sgstore.mcap import McapFile
from sgstore.mcap._read_ahead import MOST_BUFFERED, MOST_BUFFERS, Buffers
from sgstore.model.world import FrameBlock, TraceReport
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from sgstore.mcap import Recording
    from sgstore.mcap._chunks import ChunkHead

COMPRESSIONS = ["zstd", "lz4", ""]


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> dict[int, list[str]]:
    """Threads for small files too. Offset of each chunk that was decompressed → the threads that did."""
    names: dict[int, list[str]] = {}

    def records_of(stored: bytes, head: ChunkHead, **how: Any) -> Any:
        names.setdefault(head.offset, []).append(threading.current_thread().name)
        return chunks.records_of(stored, head, **how)

    monkeypatch.setattr(mcap_file, "SMALL", 0)
    monkeypatch.setattr(ahead, "BATCH", 4000)
    monkeypatch.setattr(ahead, "AHEAD", 12_000)
    monkeypatch.setattr(ahead, "LEAST", 1)
    monkeypatch.setattr(ahead, "_processors", lambda: 2)
    monkeypatch.setattr(ahead, "records_of", records_of)
    return names


@pytest.fixture
def in_turn() -> Any:
    """Reads a file as one processor does."""

    def read(path: Path) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ahead, "_processors", lambda: 1)
            return told(path)

    return read


def told(path: Path) -> tuple[list[tuple[Any, ...]], TraceReport]:
    """All messages with their places, as they were when they were handed out, and the report."""
    report, found = TraceReport(), []
    with McapFile(path) as recording:
        for run in recording.walk(report):
            columns = zip(run.channel.tolist(), run.log_time_ns.tolist(), strict=True)
            found += [(run.chunk_offset, *row, bytes(run.data(i))) for i, row in enumerate(columns)]
    return found, report


def offsets_of(path: Path) -> list[int]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return sorted(chunk.chunk_start_offset for chunk in summary.chunk_indexes)


def threads() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith("sgstore-chunks")]


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_threads_take_up_what_is_compressed_and_the_messages_are_the_same(
    compression: str, tmp_path: Path, begun: dict[int, list[str]], in_turn: Callable[[Path], Any]
) -> None:
    path = drive(tmp_path / "a.mcap", 60, compression=compression, chunk_size=2000)

    assert told(path) == in_turn(path)
    assert sorted(begun) == (offsets_of(path) if compression else [])
    assert len(begun) > 10 or not compression
    assert all(
        len(names) == 1 and names[0].startswith("sgstore-chunks") for names in begun.values()
    )


@pytest.mark.parametrize("cut", [0.5, 0.99, 1.0])
def test_a_file_without_summary_has_threads_too(
    cut: float,
    tmp_path: Path,
    begun: dict[int, list[str]],
    in_turn: Callable[[Path], Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = drive(tmp_path / "a.mcap", 60, chunk_size=2000)
    places, content = offsets_of(path), path.read_bytes()
    stop = int(cut * content.rindex(bytes([0x0F]) + (4).to_bytes(8, "little")))  # the end of data
    path.write_bytes(content[:stop])

    messages, report = told(path)

    assert (messages, report) == in_turn(path)
    assert any("not closed" in words for words in report.warnings)
    there = [place for place in places if place < stop]
    assert sorted(begun) == there[: len(begun)]
    assert len(begun) >= len(there) - 1 > 5  # the last one may be cut
    monkeypatch.setattr(ahead, "BETWEEN", 0)
    begun.clear()
    assert (messages, report) == told(path)
    assert not begun  # message indexes stand between


def test_what_hardly_becomes_larger_waits_for_its_turn(
    tmp_path: Path, begun: dict[int, list[str]], in_turn: Callable[[Path], Any]
) -> None:
    path, dice = tmp_path / "a.mcap", random.Random(1)
    with Bridge(path, compression="zstd", chunk_size=2000) as bridge:
        for i in range(20):
            content = dice.randbytes(3000) if i < 10 else bytes(3000)
            bridge.write("/camera", "sensor_msgs/CompressedImage", content, i / 10)

    assert told(path) == in_turn(path)
    assert sorted(begun) == offsets_of(path)[10:]


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.usefixtures("begun")
def test_damage_is_told_in_the_same_words_and_order(
    seed: int, tmp_path: Path, in_turn: Callable[[Path], Any]
) -> None:
    draw = random.Random(seed)
    how = {"compression": draw.choice(COMPRESSIONS[:2]), "enable_crcs": draw.random() < 0.7}
    path = drive(tmp_path / "a.mcap", 60, chunk_size=2000, **how)
    content = bytearray(path.read_bytes())
    for _ in range(draw.choice([1, 3, 10])):
        place = draw.choice([draw.randrange(100, len(content)), draw.choice(offsets_of(path)) + 20])
        content[place : place + draw.choice([1, 8])] = draw.randbytes(1)
    path.write_bytes(content[: draw.choice([len(content), draw.randrange(200, len(content))])])

    expected = in_turn(path)

    assert told(path) == expected
    assert expected[1].losses or expected[1].warnings
    assert not threads()


def test_only_what_a_walk_will_ask_for_is_begun(
    tmp_path: Path, begun: dict[int, list[str]]
) -> None:
    path = drive(tmp_path / "a.mcap", 60, chunk_size=2000)
    with McapFile(path) as recording:
        walk(recording, keep=lambda _: True)
        read = begun.copy()
        begun.clear()
        walk(recording)  # what was kept is not decompressed again
        assert 0 < len(begun) < len(read) / 3
        begun.clear()
        walk(recording, wanted=lambda offset: offset == max(read))  # one asks chunk by chunk
        assert not begun
        assert not threads()


def walk(recording: Recording, **how: Any) -> None:
    for _ in recording.walk(TraceReport(), **how):
        pass


def test_no_more_is_begun_than_may_be_ahead(tmp_path: Path, begun: dict[int, list[str]]) -> None:
    path = drive(tmp_path / "a.mcap", 60, chunk_size=2000)
    largest = max(c.uncompressed_size for c in _summary(path).chunk_indexes)
    with McapFile(path) as recording:
        for count, _ in enumerate(recording.walk(TraceReport())):
            # Those handed out, the rest of their batch, and those ahead of it.
            most = count + 1 + (ahead.AHEAD + 2 * (ahead.BATCH + largest)) / 2000
            assert len(begun) <= most


def _summary(path: Path) -> Any:
    with path.open("rb") as stream:
        return make_reader(stream).get_summary()


def test_neither_tiny_chunks_nor_places_where_none_are_pile_up(
    tmp_path: Path, begun: dict[int, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = drive(tmp_path / "a.mcap", 60, chunk_size=2000)
    true = offsets_of(path)
    monkeypatch.setattr(ahead, "BATCH", 1 << 20)
    monkeypatch.setattr(ahead, "AHEAD", 1 << 20)
    monkeypatch.setattr(ahead, "LEAST", 1 << 18)
    monkeypatch.setattr(ahead, "_TRIED", 7)
    with McapFile(path) as recording:
        recording._chunk_starts.extend(range(true[-1] + 1, true[-1] + 1000))
        for count, _ in enumerate(recording.walk(TraceReport())):
            assert len(begun) <= count + 1 + 8  # a batch in hand and one ahead, of four each
    assert sorted(begun) == true


@pytest.mark.usefixtures("begun")
def test_no_thread_outlives_what_it_was_for(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap", 60, chunk_size=2000)

    with McapFile(path) as recording:
        whole = recording.walk(TraceReport())
        next(whole)
        assert threads()
        assert sum(1 for _ in whole)
        assert not threads()

        left = recording.walk(TraceReport())
        next(left)
        left.close()
        assert not threads()

        held = recording.walk(TraceReport())
        next(held)
        other = recording.walk(TraceReport())
        next(other)
        assert threads()
    assert not threads()
    with pytest.raises(TraceError, match="closed file"):
        list(held)
    assert not threads()


@pytest.mark.usefixtures("begun")
def test_no_thread_is_left_where_a_recording_cannot_be_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = drive(tmp_path / "a.mcap", 60, chunk_size=2000)

    def failing(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sgstore.readers.osi._survey.ref_of", failing)
    monkeypatch.setattr("sgstore.mcap._read_ahead.Spool.put", failing)
    with pytest.raises(KeyboardInterrupt) as caught:
        open_trace(path)
    assert caught.traceback
    assert not threads()


@pytest.mark.usefixtures("begun")
def test_where_no_thread_can_be_started_all_is_read_in_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_turn: Callable[[Path], Any]
) -> None:
    path = drive(tmp_path / "a.mcap", 60, chunk_size=2000)
    expected = in_turn(path)

    def start(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", start)
    assert told(path) == expected


@pytest.mark.usefixtures("begun")
def test_a_chunk_that_changes_meanwhile_is_read_as_it_is_now(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap", 60, chunk_size=2000)
    second = offsets_of(path)[1]
    report = TraceReport()
    with McapFile(path) as recording:
        for at, _ in enumerate(recording.walk(report)):
            if at == 0:
                with path.open("r+b") as file:
                    file.seek(second + 9 + 16)
                    file.write(bytes(4))  # of its size
    assert [loss.offset for loss in report.losses] == [second]


@pytest.mark.usefixtures("begun")
def test_a_message_stays_what_it_is_as_long_as_somebody_holds_it(tmp_path: Path) -> None:
    path = drive(tmp_path / "a.mcap", 60, chunk_size=2000)
    expected = [message[-1] for message in told(path)[0]]

    with McapFile(path) as recording:
        runs = [(run, len(run)) for run in recording.walk(TraceReport())]
        held = [run.data(i) for run, count in runs for i in range(count)]
        assert [bytes(data) for data in held] == expected
        sums = [
            int(np.frombuffer(run.data(0), np.uint8).sum()) for run in recording.walk(TraceReport())
        ]
        assert sums == [sum(run.data(0)) for run, _ in runs]


# Memory -------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(st.integers(0, 3 << 20), st.integers(0, 5)), max_size=30))
@settings(max_examples=share_of(60), deadline=None)
def test_memory_is_never_handed_out_while_somebody_looks_at_it(
    wishes: list[tuple[int, int]],
) -> None:
    buffers = Buffers()
    held: dict[int, tuple[memoryview, int]] = {}
    for number, (size, place) in enumerate(wishes):
        held.pop(place, None)
        view = buffers.take(size)
        assert len(view) == size
        view[:] = bytes([number]) * size
        held[place] = (view[: size // 2], number)  # a part of it is enough
    for view, number in held.values():
        assert view == bytes([number]) * len(view)


def test_memory_is_used_again_and_not_hoarded() -> None:
    buffers = Buffers()

    def address(size: int) -> int:
        return np.frombuffer(buffers.take(size), np.uint8).ctypes.data

    first = address(1_000_000)
    assert address(900_000) == first
    view = buffers.take(1_000_000)
    assert address(1_000_000) != first
    del view
    assert first in {address(1_000_000), address(1_000_000)}
    held = [buffers.take(MOST_BUFFERED // 4) for _ in range(8)]
    assert buffers.kept <= MOST_BUFFERED
    del held
    buffers.take(MOST_BUFFERED // 2)
    assert buffers.kept <= MOST_BUFFERED
    buffers.clear()
    assert buffers.kept == 0

    many = [buffers.take(size) for size in (*[0] * 1000, *[1] * 1000)]
    assert all(many[i].nbytes == (i >= 1000) for i in range(2000))
    assert len(buffers._kept) <= MOST_BUFFERS


# Checksums ----------------------------------------------------------------------------------------


@given(st.binary(max_size=5000), st.integers(0, 8))
def test_checksums_are_those_of_zlib(content: bytes, start: int) -> None:
    isal = pytest.importorskip("isal.isal_zlib")  # the extra [fast]
    part = memoryview(content)[start:]

    assert isal.crc32(part) == zlib.crc32(part)
    assert isal.crc32(part, zlib.crc32(b"before")) == zlib.crc32(b"before" + bytes(part))


@pytest.mark.parametrize("fast", [True, False])
def test_checksums_are_looked_at_with_and_without_the_extra(
    fast: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if fast:
        pytest.importorskip("isal.isal_zlib")
    else:
        monkeypatch.setitem(sys.modules, "isal.isal_zlib", None)
    spec = importlib.util.find_spec("sgstore.mcap._chunks")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert (module.crc32 is not zlib.crc32) == fast

    path = drive(tmp_path / "a.mcap", chunk_size=2000, compression="")
    offset = offsets_of(path)[2]
    with path.open("r+b") as file:
        head = module.read_chunk_head(file, offset)
        assert module.read_records(file, head)
        file.seek(head.data_offset + 40)
        file.write(b"?")
        with pytest.raises(TraceError, match="checksum"):
            module.read_records(file, head)


# Messages that are kept between two readings ------------------------------------------------------


Told = list[tuple[int, int, int, int, int, int, bytes]]


def messages_of(recording: McapFile, keep: Callable[[int], bool] | None = None) -> Told:
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
        first = messages_of(recording, keep)

        assert len({message[4] for message in first}) > 5
        assert messages_of(recording) == first
        assert messages_of(recording) == first


def test_what_is_kept_is_decompressed_once(path: Path, counted: list[int]) -> None:
    with McapFile(path) as recording:
        messages_of(recording, lambda _: True)
        before = counted.copy()
        messages_of(recording)

    # Those that define channels are read again, for what may be odd about the definitions.
    again = counted[len(before) :]
    assert len(before) > 2 * len(again)
    assert len(set(before)) == len(before)


@pytest.mark.parametrize("most", [0, 2000])
def test_where_there_is_no_room_chunks_are_decompressed_again(
    path: Path, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ahead, "MOST_SPOOLED", most)
    with McapFile(path) as recording:
        first = messages_of(recording, lambda _: True)

        assert messages_of(recording) == first


def test_a_full_disk_is_no_error(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def __init__(self, **_how: Any) -> None: ...

        def seek(self, _place: int) -> None:
            raise OSError(28, "No space left on device")

        def close(self) -> None: ...

    monkeypatch.setattr(ahead, "SpooledTemporaryFile", Full)
    with McapFile(path) as recording:
        first = messages_of(recording, lambda _: True)

        assert messages_of(recording) == first


def test_more_than_memory_holds_goes_to_a_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead, "IN_MEMORY", 1000)
    with McapFile(path) as recording:
        first = messages_of(recording, lambda _: True)

        assert messages_of(recording) == first


@pytest.mark.parametrize("write", [drive, carla_recordings.drive])
def test_frames_do_not_depend_on_what_is_kept(
    write: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "a.mcap", 30)
    kept = blocks(tmp_path / "a.mcap")
    monkeypatch.setattr(ahead, "MOST_SPOOLED", 0)

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
