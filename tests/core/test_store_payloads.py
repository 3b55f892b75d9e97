"""Messages joined to frames: against trying them all, and byte for byte against the recording."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from recordings import Recorder, car, drive
from thorough import share_of

import sgstore.store._payloads as payloads
from sgstore.errors import StoreError, TraceError
from sgstore.ingest import ingest
from sgstore.model.config import Config, Payloads
from sgstore.model.frame_ids import frame_ids
from sgstore.model.world import Channel, Event
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.seconds(8)

CHANNELS = tuple(
    Channel(number, topic, "s", "protobuf", "protobuf", -1, role)
    for number, topic, role in (
        (1, "truth", "ground_truth"),
        (2, "camera", "payload"),
        (5, "lidar", "payload"),
        (6, "map", "map"),
    )
)

TIMES = st.lists(st.integers(0, 60), min_size=1, max_size=8)
SAID = st.lists(st.tuples(st.sampled_from([2, 5, 6]), st.integers(-5, 70)), max_size=14)


def joined(frames: list[int], said: list[Any], how: Payloads) -> set[tuple[int, int, int, int]]:
    """Frame, channel, log time and offset of the messages that belong to frames."""
    periods = payloads.Periods()
    periods.see(payloads.FRAMES, np.array(frames))
    messages = [(1, time, 0, i, 1) for i, time in enumerate(frames)]
    for offset, (channel, time) in enumerate(said):
        messages.append((channel, time, 0, offset, 1))
        periods.see(channel, np.array([time]))
    names = ("channel", "log_time_ns", "chunk_offset", "offset", "length")

    def pieces() -> Iterator[dict[str, Any]]:
        for first in range(0, len(messages), 3):
            rows = np.array(messages[first : first + 3], np.int64)
            yield dict(zip(names, rows.T, strict=True))

    times = payloads.FrameTimes(np.array(frames, np.int64))
    found: list[tuple[int, int, int, int]] = []
    for columns in payloads.joined(times, pieces, CHANNELS, periods, how):
        of = [columns[name].tolist() for name in ("seq", "channel_id", "log_time_ns", "offset")]
        found += zip(*of, strict=True)
    assert found == sorted(found, key=lambda row: (row[1], row[0]))
    return set(found)


def tried(frames: list[int], said: list[Any], how: Payloads) -> set[tuple[int, int, int, int]]:
    """The same by trying every message for every frame."""
    found = set()
    for i, now in enumerate(frames):
        found.add((i, 1, now, i))
        for channel in (2, 5):
            mine = [(time, offset) for offset, (c, time) in enumerate(said) if c == channel]
            most = how.tolerance * 1e9 or period(mine, frames) * (
                0.5 if how.join == "nearest" else 1
            )
            near = [
                (abs(time - now), time, -offset)
                for time, offset in mine
                if abs(time - now) <= int(most) and (how.join == "nearest" or time <= now)
            ]
            if near:
                _, time, offset = min(near)
                found.add((i, channel, time, -offset))
    return found


def period(mine: list[Any], frames: list[int]) -> float:
    """The longer of the median periods of a channel and of the frames."""
    steps = [np.diff(sorted(times)) for times in ([t for t, _ in mine], frames)]
    return max(float(np.median(s)) if len(s) else 0.0 for s in steps)


@pytest.mark.parametrize("together", [1, 250_000])
@pytest.mark.parametrize("join", ["nearest", "latest"])
@pytest.mark.parametrize("tolerance_ns", [0, 3, 1000])
@given(frames=TIMES, said=SAID)
@settings(max_examples=25, deadline=None)
def test_a_message_belongs_to_a_frame_as_trying_them_all_says(
    together: int, join: Any, tolerance_ns: Any, frames: Any, said: Any
) -> None:
    how = Payloads(join=join, tolerance=tolerance_ns / 1e9)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(payloads, "_AT_ONCE", together)
        assert joined(frames, said, how) == tried(frames, said, how)


def test_of_frames_of_one_time_each_is_its_own_message() -> None:
    assert {row for row in joined([5, 5, 5], [], Payloads()) if row[1] == 1} == {
        (0, 1, 5, 0),
        (1, 1, 5, 1),
        (2, 1, 5, 2),
    }


def test_the_period_of_a_channel_is_told_from_its_beginning_in_bounded_memory() -> None:
    periods = payloads.Periods()
    for first in range(0, 1_000_000, 10_000):
        periods.see(1, np.arange(first, first + 10_000) * 50)

    assert periods.of(1) == 50
    assert sum(len(piece) for piece in periods.times[1]) < 10_000


# The nearest frame of an event


class Frames:
    """As much of a block as counts here."""

    def __init__(self, seq: np.ndarray, time_ns: np.ndarray, events: tuple[Event, ...]) -> None:
        self.seq, self.time_ns, self.log_time_ns, self.events = seq, time_ns, time_ns, events


@settings(max_examples=share_of(200))
@given(
    steps=st.lists(st.integers(1, 50), min_size=1, max_size=30),
    places=st.lists(st.integers(-100, 1500), max_size=20),
    size=st.integers(1, 10),
    early=st.integers(0, 3),
)
def test_the_nearest_frame_does_not_depend_on_blocks(
    steps: list[int], places: list[int], size: int, early: int
) -> None:
    times = np.cumsum(steps)
    events = [Event("x", time, time, 0, detail=str(i)) for i, time in enumerate(sorted(places))]
    happenings, found = payloads.Happenings(7), {}

    def take(columns: Any) -> None:
        for detail, frame in zip(columns["detail"], columns["frame_id"].tolist(), strict=True):
            assert detail not in found
            found[detail] = frame

    left = events
    for start in range(0, len(times), size):
        block = times[start : start + size]
        # What stands in the file with these frames, and a little of what comes later.
        upto = block[-1] + early * 20 if start + size < len(times) else np.inf
        now, left = [e for e in left if e.time_ns <= upto], [e for e in left if e.time_ns > upto]
        seq = np.arange(start, start + len(block))
        take(happenings.of(Frames(seq, block, tuple(now))))
    take(happenings.rest())

    ids = frame_ids(7, np.arange(len(times)))
    assert found.keys() == {event.detail for event in events}
    for event in events:
        apart = np.abs(times - event.time_ns)
        assert apart[ids.tolist().index(found[event.detail])] == apart.min()


def test_the_first_events_of_a_block_come_with_many_of_the_one_before() -> None:
    times = np.arange(400) * 100
    events = [Event("x", int(time), int(time), 0) for time in times for _ in range(60)]
    happenings, upto = payloads.Happenings(7), 201 * 60

    told = [
        happenings.of(Frames(np.arange(200), times[:200], tuple(events[:upto]))),
        happenings.of(Frames(np.arange(200, 400), times[200:], tuple(events[upto:]))),
        happenings.rest(),
    ]

    found = np.concatenate([columns["frame_id"] for columns in told])
    assert np.unique(found, return_counts=True)[1].tolist() == [60] * 400


def test_a_stamp_of_another_clock_goes_by_log_time() -> None:
    frames = Frames(np.arange(3), np.array([0, 100, 200]) * 1_000_000, ())
    event = Event("collision", 10**18, 110_000_000, 1)
    happenings = payloads.Happenings(7)
    frames.events = (event,)

    told = happenings.of(frames)

    assert told["frame_id"].tolist() == frame_ids(7, np.array([1])).tolist()


# In a store


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[StoreFile, Path]]:
    folder = tmp_path_factory.mktemp("recorded")
    path = drive(folder / "drive.mcap", frames=20)
    (outcome,) = ingest(folder / "s.db", [path])
    assert outcome.status == "added"
    store = StoreFile(folder / "s.db")
    with store.snapshot():
        yield store, path


def messages(path: Path, topic: str) -> dict[int, bytes]:
    """The messages of a topic by log time, as the official reader reads them."""
    with path.open("rb") as stream:
        return {
            message.log_time: message.data
            for _, _, message in make_reader(stream).iter_messages(topics=[topic])
        }


def test_a_payload_read_back_is_the_message_in_the_file(recorded: Any) -> None:
    store, path = recorded
    pictures, truth = messages(path, "camera"), messages(path, "truth")

    for row in store.rows("SELECT frame_id, channel, log_time_ns FROM payloads"):
        frame, channel, time = row
        expected = pictures if channel == "camera" else truth
        assert store.payload(frame, channel) == expected[time]


def test_every_frame_has_its_own_ground_truth(recorded: Any) -> None:
    store, _ = recorded
    sql = "SELECT f.log_time_ns - p.log_time_ns, offset_s FROM payloads p JOIN frames f USING (frame_id)"

    assert set(store.rows(f"{sql} WHERE channel = 'truth'").values) == {(0, 0.0)}
    assert store.rows("SELECT count(*) FROM payloads WHERE channel = 'truth'").values == [(20,)]


def test_pictures_every_other_frame_belong_to_the_frames_that_are_near(recorded: Any) -> None:
    store, _ = recorded
    sql = "SELECT seq, offset_s FROM payloads JOIN frames USING (frame_id) WHERE channel = 'camera'"

    found = dict(store.rows(sql).values)

    # Pictures come 25 ms after every second frame: within half of their own period of all frames.
    assert found == {seq: pytest.approx(0.025 if seq % 2 == 0 else -0.075) for seq in range(20)}


def test_views_say_where_a_message_stands(recorded: Any) -> None:
    store, path = recorded
    row = store.rows("SELECT * FROM payloads WHERE channel = 'camera' LIMIT 1").dicts()[0]

    assert (row["schema"], row["file"], row["length"]) == ("pictures.Image", str(path), 200)


@pytest.mark.parametrize(
    ("channel", "reason"),
    [
        ("kamera", "no channel 'kamera' in 'drive'; did you mean 'camera'?"),
        ("radar-7", "there are: 'camera', 'map', 'truth'"),
        ("map", "it holds the map, which belongs to all frames"),
    ],
)
def test_a_channel_that_gives_nothing_is_told(recorded: Any, channel: Any, reason: Any) -> None:
    store, _ = recorded

    with pytest.raises(StoreError, match=reason):
        store.payload("drive#3", channel)


def test_a_frame_without_a_message_is_told(tmp_path: Path) -> None:
    with Recorder(tmp_path / "d.mcap") as recorder:
        for i in range(5):
            recorder.ground_truth(i / 10, [car(1)], host=1)
        recorder.camera(0.0)
    ingest(tmp_path / "s.db", [tmp_path / "d.mcap"])
    store = StoreFile(tmp_path / "s.db")

    assert len(store.payload("d#0", "camera")) == 200
    with pytest.raises(StoreError, match="'camera' belongs to d#4: no message near enough in time"):
        store.payload("d#4", "camera")


def test_the_latest_message_is_joined_where_that_is_asked_for(tmp_path: Path) -> None:
    path = drive(tmp_path / "d.mcap", frames=6)
    config = Config(payloads=Payloads(join="latest", tolerance=10))
    ingest(tmp_path / "s.db", [path], config=config)
    sql = "SELECT offset_s FROM payloads JOIN frames USING (frame_id) WHERE channel = 'camera' ORDER BY seq"

    offsets = [offset for (offset,) in StoreFile(tmp_path / "s.db").rows(sql)]

    assert offsets == pytest.approx([-0.075, -0.175, -0.075, -0.175, -0.075])


def test_a_recording_that_is_gone_or_another_is_told(tmp_path: Path) -> None:
    path = drive(tmp_path / "d.mcap", frames=6)
    ingest(tmp_path / "s.db", [path])
    store = StoreFile(tmp_path / "s.db")

    content = path.read_bytes()
    for other in (content + b"x", content.replace(b"pictures", b"pinkures")):
        path.write_bytes(other)
        with pytest.raises(TraceError, match=r"d\.mcap: not the file that was ingested"):
            store.payload("d#5", "truth")
    path.unlink()
    with pytest.raises(TraceError, match="No such file"):
        store.payload("d#5", "truth")


def test_a_recording_that_was_only_touched_is_the_same(tmp_path: Path) -> None:
    path = drive(tmp_path / "d.mcap", frames=6)
    ingest(tmp_path / "s.db", [path])

    os.utime(path, ns=(1, 1))

    assert StoreFile(tmp_path / "s.db").payload("d#5", "truth") in messages(path, "truth").values()
