"""Bags that were split: their files give what the whole gives, and what is wrong with one is named."""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from carla_recordings import COMPRESSIONS, drive, idents, kinds, read, reasons, states
from clipping import Source, write_clips
from mcap.reader import make_reader
from mcap.writer import Writer

import sgstore
from sgstore.apps.cli import run
from sgstore.errors import TraceError
from sgstore.ingest import ingest, recordings
from sgstore.mcap import McapFile, digest_of, parts_of
from sgstore.model.world import Clip, TraceReport
from sgstore.readers import open_trace, read_message

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(6)

METADATA = """\
rosbag2_bagfile_information:
  version: 8
  storage_identifier: mcap
  duration:
    nanoseconds: 1900000000
  message_count: 97
  topics_with_message_count:
    - topic_metadata:
        name: /carla/objects
        type: derived_object_msgs/msg/ObjectArray
        offered_qos_profiles: "- history: 1\\n  depth: 10"
      message_count: 20
  compression_format: ""
  compression_mode: ""
  relative_file_paths:
{files}
  files:
    - path: other.mcap
      message_count: 1
  ros_distro: humble
"""


def split(
    path: Path, folder: Path, parts: int, *, chunked: bool = True, compression: str = "zstd"
) -> Path:
    """The messages of a file as a bag of several, in each of which channels have other ids."""
    with path.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages())
    folder.mkdir()
    names = []
    for number, some in enumerate(np.array_split(np.arange(len(messages)), parts)):
        names.append(f"drive_{number}.mcap")
        with (folder / names[-1]).open("wb") as stream:
            writer = Writer(
                stream,
                chunk_size=3000,
                use_chunking=chunked,
                compression=COMPRESSIONS[compression],
            )
            writer.start("ros2", "tests")
            for unused in range(number):
                writer.register_channel(f"/unused{unused}", "json", 0)
            ids: dict[int, int] = {}
            for schema, channel, message in (messages[i] for i in some):
                if channel.id not in ids:
                    known = writer.register_schema(schema.name, schema.encoding, schema.data)
                    ids[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, known
                    )
                writer.add_message(
                    ids[channel.id],
                    message.log_time,
                    message.data,
                    message.publish_time,
                    message.sequence,
                )
            writer.finish()
    listing(folder, *names)
    return folder


def listing(folder: Path, *names: str) -> None:
    text = "\n".join(f"    - {name}" for name in names)
    (folder / "metadata.yaml").write_text(METADATA.replace("{files}", text))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return drive(tmp_path / "drive.mcap", everything=True)


# Bags as they should be ---------------------------------------------------------------------------


@pytest.mark.parametrize("how", [{}, {"compression": ""}, {"chunked": False}], ids=str)
@pytest.mark.parametrize("parts", [1, 2, 7])
def test_a_bag_gives_what_the_whole_recording_gives(
    tmp_path: Path, path: Path, parts: int, how: dict[str, Any]
) -> None:
    bag = split(path, tmp_path / "bag", parts, **how)
    whole, one = read(path, 6), read(bag, 6)

    assert one[0].path == bag
    assert (one[0].ego, one[0].map_text) == (whole[0].ego, whole[0].map_text)
    assert kinds(one[1]) == kinds(whole[1])
    np.testing.assert_equal(states(one[1]), states(whole[1]))
    assert one[2] == whole[2]


@pytest.mark.parametrize("chunked", [True, False])
def test_every_message_of_a_bag_is_read_back_by_its_place(
    tmp_path: Path, path: Path, chunked: bool
) -> None:
    bag = split(path, tmp_path / "bag", 3, chunked=chunked)
    with path.open("rb") as stream:
        expected = [
            (channel.topic, message.data)
            for _, channel, message in make_reader(stream).iter_messages()
        ]

    with McapFile(bag) as recording:
        found = [
            (
                recording.channels[int(run.channel[row])].topic,
                read_message(
                    bag,
                    chunk_offset=run.chunk_offset,
                    offset=int(run.offset[row]),
                    length=int(run.length[row]),
                ),
            )
            for run in recording.walk(TraceReport())
            for row in range(len(run))
        ]

    assert sorted(found) == sorted(expected)
    with pytest.raises(TraceError, match="replaced"):
        read_message(bag, chunk_offset=1 << 40, offset=0, length=1)


def test_a_bag_is_known_by_its_folder_and_by_its_metadata(tmp_path: Path, path: Path) -> None:
    bag = split(path, tmp_path / "bag", 2)
    parts = [(bag / f"drive_{i}.mcap").read_bytes() for i in range(2)]

    assert read(bag)[0].path == read(bag / "metadata.yaml")[0].path == bag
    assert digest_of(bag) == hashlib.sha256(b"".join(parts)).hexdigest()


def test_counts_of_a_bag_are_those_of_its_files_together(tmp_path: Path, path: Path) -> None:
    bag = split(path, tmp_path / "bag", 4)
    counts = {c.topic: c.messages for c in read(bag)[0].channels}

    assert {t: n for t, n in counts.items() if not t.startswith("/unused")} == {
        c.topic: c.messages for c in read(path)[0].channels
    }


def test_a_clip_of_a_bag_is_the_clip_of_the_whole(tmp_path: Path, path: Path) -> None:
    clips = []
    for source in (path, split(path, tmp_path / "bag", 5)):
        with open_trace(source) as trace:
            info = trace.info
        cut = Clip("drive", 1_000_000_000, 1_500_000_000)
        given = {"drive": Source(source, info.digest, info.context)}
        (clip,) = write_clips([cut], given, tmp_path / f"clips{len(clips)}")
        with clip.file.open("rb") as stream:
            clips.append(
                [(c.topic, m.log_time, m.data) for _, c, m in make_reader(stream).iter_messages()]
            )

    assert sorted(clips[0]) == sorted(clips[1])
    assert len(clips[0]) > 50


# Bags that are hurt -------------------------------------------------------------------------------


def test_a_file_that_is_missing_is_named_and_the_others_are_read(
    tmp_path: Path, path: Path
) -> None:
    bag = split(path, tmp_path / "bag", 4)
    whole = read(bag)[2].frames
    (bag / "drive_2.mcap").unlink()

    _, _, report = read(bag)

    assert whole / 2 < report.frames < whole
    assert "drive_2.mcap: metadata.yaml lists it, but the file is missing" in reasons(report)


def test_a_file_that_is_hurt_is_named_and_the_others_are_read(tmp_path: Path, path: Path) -> None:
    bag = split(path, tmp_path / "bag", 3)
    whole = read(bag)[2].frames
    first = (bag / "drive_0.mcap").stat().st_size
    second = bag / "drive_1.mcap"
    second.write_bytes(second.read_bytes()[: second.stat().st_size // 5])
    third = bag / "drive_2.mcap"
    third.write_bytes(b"hello")

    _, blocks, report = read(bag)

    assert 0 < report.frames < whole
    assert "drive_1.mcap: the file ends inside" in reasons(report)
    assert "drive_2.mcap: not an MCAP file" in reasons(report)
    assert all(loss.offset >= first for loss in report.losses)
    assert len(idents(blocks)) == 4


def test_a_bag_without_any_file_is_refused(tmp_path: Path, path: Path) -> None:
    bag = split(path, tmp_path / "bag", 2)
    for file in bag.glob("*.mcap"):
        file.unlink()

    with pytest.raises(TraceError, match=r"none of the 2 files that its metadata\.yaml lists"):
        read(bag)
    (bag / "drive_0.mcap").write_bytes(b"hello")
    with pytest.raises(TraceError, match=r"drive_0\.mcap: not an MCAP file"):
        read(bag)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "it lists 0 files"),
        ("\xff", "it lists 0 files"),
        ("relative_file_paths:\n  - /etc/passwd", "'/etc/passwd', which is not in its folder"),
        ("relative_file_paths:\n  - a/../../b.mcap", "which is not in its folder"),
        ('relative_file_paths:\n  - "a\\0b"', "none of the 1 files"),
        ("relative_file_paths:\n" + "  - a\n" * 10_001, "it lists 10001 files"),
        ("storage_identifier: sqlite3\nrelative_file_paths: [a.db3]", "it lists no file that"),
        ("compression_mode: FILE\nrelative_file_paths: [a]", "compressed as a whole"),
        ("x" * (17 << 20), "more than 16777216 bytes"),
    ],
    ids=range(9),
)
def test_metadata_that_cannot_be_used_are_refused(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)

    with pytest.raises(TraceError, match=reason):
        read(tmp_path / "metadata.yaml")


def test_metadata_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_bytes(b"\xff\xfe\x00")

    with pytest.raises(TraceError, match="cannot be read"):
        read(tmp_path / "metadata.yaml")
    with pytest.raises(TraceError, match="a folder; expected an MCAP recording"):
        read(tmp_path)


def test_in_a_folder_a_bag_is_one_recording(
    tmp_path: Path, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = split(path, tmp_path / "bag", 3)
    (bag / "beside.mcap").write_bytes(path.read_bytes())
    (bag / "drive_1.mcap").unlink()
    store = tmp_path / "s.db"

    assert recordings([tmp_path]) == [bag, bag / "beside.mcap", path]
    assert recordings([bag / "metadata.yaml"]) == [bag]
    code = run(["ingest", str(store), str(bag / "metadata.yaml"), "--json"])
    out, err = capsys.readouterr()
    (row,) = json.loads(out)

    assert code == 3, err
    assert (row["trace"], row["status"]) == ("bag", "added")
    assert "drive_1.mcap: metadata.yaml lists it, but the file is missing" in err
    opened = sgstore.open(store)
    picture = opened.payload("bag#0", "/carla/hero/rgb_front/image/compressed")
    last = opened.payload(f"bag#{row['frames'] - 1}", "/carla/objects")
    with path.open("rb") as stream:
        told = {(c.topic, m.data) for _, c, m in make_reader(stream).iter_messages()}
    assert ("/carla/hero/rgb_front/image/compressed", picture) in told
    assert ("/carla/objects", last) in told


@pytest.mark.parametrize(
    "text",
    [
        "relative_file_paths:\n  - a b.mcap\n  - c.mcap\nother:\n  - d",
        "relative_file_paths:\n- a b.mcap   # the first\n- c.mcap\nother: d",
        "r:\n  relative_file_paths:\n  # none\n\n  - 'a b.mcap'\n  - \"c.mcap\"\n  files:\n  - path: x",
        "relative_file_paths: [a b.mcap, c.mcap]\nrelative_file_paths:\n  - d",
        "relative_file_paths:\r\n  - a b.mcap\r\n  - c.mcap\r\n",
    ],
    ids=range(5),
)
def test_lists_of_files_are_read_as_yaml_writes_them(tmp_path: Path, text: str) -> None:
    assert listed(tmp_path, text) == ["a b.mcap", "c.mcap"]


def test_quotes_in_names_are_undone(tmp_path: Path) -> None:
    text = "relative_file_paths:\n  - 'it''s.mcap'\n  - \"a\\\\b\\\"c.mcap\""

    assert listed(tmp_path, text) == ["it's.mcap", 'a\\b"c.mcap']


def listed(folder: Path, metadata: str) -> list[str]:
    """Names of the files of a bag with these metadata; one of them is there, or it would be refused."""
    (folder / "metadata.yaml").write_text(metadata, encoding="utf-8", newline="")
    for name in ("a b.mcap", "it's.mcap"):
        (folder / name).touch()
    return [part.path.name for part in parts_of(folder)]


def test_the_folder_s_name_before_a_file_is_passed_over(tmp_path: Path, path: Path) -> None:
    bag = split(path, tmp_path / "bag", 2)
    listing(bag, "bag/drive_0.mcap", "bag/drive_1.mcap")

    assert read(bag)[2].frames == 20


@pytest.mark.data
def test_a_real_recording_in_two_files_is_what_it_was(data: Path, tmp_path: Path) -> None:
    path = data / "traces/carla/Town01.carla.mcap"
    bag = split(path, tmp_path / "bag", 2)

    whole, one = read(path), read(bag)

    assert kinds(one[1]) == kinds(whole[1])
    for ours, theirs in zip(one[1], whole[1], strict=True):
        for column in ("x", "y", "heading", "light_state", "throttle"):
            np.testing.assert_array_equal(
                getattr(ours.states, column), getattr(theirs.states, column)
            )
    assert one[2].losses == []


def test_a_bag_whose_file_was_replaced_gives_no_message_of_it(tmp_path: Path, path: Path) -> None:
    bag, store = split(path, tmp_path / "bag", 2), tmp_path / "s.db"
    topic = "/carla/objects"
    ingest(store, [bag])
    (bag / "notes.txt").write_text("what lies beside its files is of no concern")
    before = sgstore.open(store).payload("bag#0", topic)
    (bag / "drive_1.mcap").write_bytes((bag / "drive_1.mcap").read_bytes() + b"\0")

    assert read(bag)[0].size == sum(file.stat().st_size for file in bag.glob("*.mcap"))
    assert before in [data for _, _, data in messages(path, topic)]
    with pytest.raises(TraceError, match="not the file that was ingested"):
        sgstore.open(store).payload("bag#0", topic)


def messages(path: Path, topic: str) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        return [
            (c.topic, m.log_time, m.data) for _, c, m in make_reader(stream).iter_messages([topic])
        ]
