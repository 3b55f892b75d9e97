"""Clips: the messages of an interval as they were, what they depend on, and all of it or nothing."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from clipping import Source, source, write_clips
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from recordings import Recorder, bulb, car, drive, house, ns

from sgstore.errors import ExportError, TraceError
from sgstore.model.world import Clip, MessageRefs, States
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.model.world import FrameBlock

Key = tuple[str, int, int, int, bytes]


def cut(path: Path, to: Path, *intervals: tuple[float, float], **how: Any) -> list[Path]:
    """Clips of a recording, by their intervals in s."""
    clips = [Clip("drive", ns(start), ns(end)) for start, end in intervals]
    return [clip.file for clip in write_clips(clips, {"drive": source(path)}, to, **how)]


def messages(path: Path) -> list[Key]:
    """Every message as the official reader finds it, in file order."""
    with path.open("rb") as stream:
        return [
            (channel.topic, m.log_time, m.publish_time, m.sequence, m.data)
            for _, channel, m in make_reader(stream, validate_crcs=True).iter_messages(
                log_time_order=False
            )
        ]


def within(path: Path, start: float, end: float) -> list[Key]:
    return [m for m in messages(path) if ns(start) <= m[1] <= ns(end)]


def summary(path: Path) -> Any:
    with path.open("rb") as stream:
        return make_reader(stream).get_summary()


def attached(path: Path) -> tuple[list[Any], list[Any]]:
    """Metadata, without the clip's own, and attachments."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        own = [(m.name, m.metadata) for m in reader.iter_metadata() if m.name != "sgstore.clip"]
        return own, list(reader.iter_attachments())


def frames(path: Path) -> dict[int, dict[str, tuple[float, ...]]]:
    """Log time → ident → what is known of the entity then."""
    found: dict[int, dict[str, tuple[float, ...]]] = {}
    names: list[str] = []
    with open_trace(path) as trace:
        for block in trace.blocks():
            names += block.entities.ident
            for f in range(len(block)):
                rows = slice(block.offsets[f], block.offsets[f + 1])
                found[int(block.log_time_ns[f])] = _rows(names, block, rows)
            for row, node in enumerate(block.scenery.node):
                found.setdefault(-1, {})[names[node]] = (float(block.scenery.x[row]),)
    return found


def _rows(names: list[str], block: FrameBlock, rows: slice) -> dict[str, tuple[float, ...]]:
    columns = [name for name in States.__dataclass_fields__ if name not in {"node", "own"}]
    values = np.array([getattr(block.states, name)[rows] for name in columns], float).T
    ids = [names[node] for node in block.states.node[rows]]
    return {ident: tuple(np.nan_to_num(v, nan=-99)) for ident, v in zip(ids, values, strict=True)}


LAYOUTS = [
    pytest.param({"compression": "zstd", "chunk_size": 3000}, id="zstd"),
    pytest.param({"compression": "lz4", "chunk_size": 3000}, id="lz4"),
    pytest.param({"compression": "", "chunk_size": 3000}, id="stored"),
    pytest.param({"use_chunking": False}, id="without chunks"),
    pytest.param({"summary": False, "chunk_size": 3000}, id="without definitions in the summary"),
]

# What is in a clip -----------------------------------------------------------------------------------


@pytest.mark.parametrize("how", LAYOUTS)
def test_a_clip_has_the_messages_of_its_interval_as_they_were(
    tmp_path: Path, how: dict[str, Any]
) -> None:
    path = drive(tmp_path / "drive.mcap", frames=30, **how)
    plain = drive(tmp_path / "plain.mcap", frames=30)  # one that the official reader can index

    (clip,) = cut(path, tmp_path / "out", (1.0, 2.0))

    inside = [m for m in messages(clip) if ns(1.0) <= m[1] <= ns(2.0)]
    assert inside == within(plain, 1.0, 2.0)
    assert len(inside) == 11 + 5


def test_a_clip_brings_the_map_and_static_data_from_before_its_start(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", frames=30, chunk_size=3000)

    (clip,) = cut(path, tmp_path / "out", (1.0, 2.0))

    carried = [m for m in messages(clip) if not ns(1.0) <= m[1] <= ns(2.0)]
    assert carried == [m for m in messages(path) if m[1] == 0 and m[0] in {"map", "truth"}]
    assert messages(clip)[: len(carried)] == carried


def test_what_is_carried_in_may_stand_right_beside_the_clip(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", frames=300, chunk_size=3000)
    (plain,) = cut(path, tmp_path / "plain", (20.0, 21.0))
    (clip,) = cut(path, tmp_path / "out", (20.0, 21.0), rebased=True)
    before, after = messages(plain), messages(clip)
    inside = [m for m in after if ns(20.0) <= m[1] <= ns(21.0)]

    # The same bytes, channels, sequence numbers and times of publication; log times within 1 ns of the clip.
    assert sorted((m[0], *m[2:]) for m in after) == sorted((m[0], *m[2:]) for m in before)
    assert inside == [m for m in before if ns(20.0) <= m[1] <= ns(21.0)]
    assert len(after) > len(inside)
    start, end = (
        getattr(summary(clip).statistics, f"message_{name}_time") for name in ("start", "end")
    )
    assert ns(21.0) - ns(20.0) <= end - start < ns(1.01)
    assert frames(clip) == frames(plain)


def test_what_is_carried_in_from_behind_stands_behind(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with Recorder(path, chunk_size=300) as recorder:
        for i in range(20):
            recorder.ground_truth(i * 0.1, [car(1)], host=1)
        recorder.map("<OpenDRIVE/>", 30.0)

    (clip,) = cut(path, tmp_path / "out", (0.5, 1.0), rebased=True)

    assert messages(clip)[-1][0] == "map"
    assert ns(1.0) < messages(clip)[-1][1] < ns(1.01)


def test_a_calibration_told_once_is_brought_and_a_later_event_is_not(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with Recorder(path, chunk_size=300) as recorder:
        recorder.camera(0.0, topic="calibration")
        for i in range(40):
            recorder.ground_truth(i * 0.1, [car(1)], host=1)
            if i == 15:
                recorder.camera(1.5, topic="collision")

    (clip,) = cut(path, tmp_path / "out", (2.0, 3.0))

    assert {m[0] for m in messages(clip)} == {"truth", "calibration"}


def test_a_map_that_was_recorded_last_is_brought_too(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with Recorder(path, chunk_size=300) as recorder:
        for i in range(20):
            recorder.ground_truth(i * 0.1, [car(1)], host=1, houses=[house(50)] if i == 15 else [])
        recorder.map("<OpenDRIVE/>", 2.0)

    (clip,) = cut(path, tmp_path / "out", (0.5, 1.0))

    assert [m[0] for m in messages(clip)] == ["truth"] * 6 + ["map"]
    with open_trace(clip) as trace:
        assert trace.info.map_text == "<OpenDRIVE/>"


def test_definitions_metadata_and_attachments_are_the_sources(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with Recorder(path, chunk_size=1000, profile="ros2") as recorder:
        recorder.camera(0.0, topic="left")
        recorder.camera(0.1, topic="left")
        for i in range(20):
            recorder.ground_truth(i * 0.1, [car(1)], host=1)
        recorder.writer.add_metadata("net.asam.osi.trace", {"version": "3.7.0", "naïve": "é"})
        recorder.writer.add_attachment(5, 6, "notes.txt", "text/plain", b"hello" * 1000)

    (clip,) = cut(path, tmp_path / "out", (1.0, 1.5))

    assert attached(clip) == attached(path)
    assert summary(clip).schemas == summary(path).schemas
    assert summary(clip).channels == summary(path).channels  # the camera's too, which is empty here
    assert summary(clip).statistics.channel_message_counts == {2: 6}
    assert summary(clip).statistics.attachment_count == 1
    with clip.open("rb") as stream:
        header = make_reader(stream).get_header()
    assert header.profile == "ros2"
    assert header.library.startswith("sgstore ")


@pytest.mark.data
def test_a_channel_is_the_same_whatever_its_number_is(data: Path, tmp_path: Path) -> None:
    path = data / "traces/osi_converter/testBrakeAndIndicatorLights.mcap"

    (clip,) = cut(path, tmp_path, (1.0, 1.2))

    (theirs,), (ours,) = summary(path).channels.values(), summary(clip).channels.values()
    assert (theirs.id, ours.id) == (82, 1)
    assert replace(ours, id=82, schema_id=theirs.schema_id) == theirs
    schemas = summary(path).schemas[theirs.schema_id], summary(clip).schemas[ours.schema_id]
    assert replace(schemas[1], id=schemas[0].id) == schemas[0]
    assert messages(clip) == within(path, 1.0, 1.2)


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_clip_is_compressed_as_its_source_and_every_chunk_has_a_checksum(
    tmp_path: Path, compression: str
) -> None:
    path = drive(tmp_path / "drive.mcap", compression=compression, enable_crcs=False)

    (clip,) = cut(path, tmp_path / "out", (0.0, 9.0))

    assert {index.compression for index in summary(clip).chunk_indexes} == {compression}
    with open_trace(clip) as trace:
        list(trace.blocks())
        assert trace.report.warnings == []  # among them: that there are no checksums


def test_a_clip_says_of_what_it_is_a_clip(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap")

    (clip,) = cut(path, tmp_path / "out", (0.5, 1.0), query="MATCH (a)", by="me")

    with clip.open("rb") as stream:
        (record,) = [m for m in make_reader(stream).iter_metadata() if m.name == "sgstore.clip"]
    tool = record.metadata.pop("tool")
    assert tool.startswith("sgstore ")
    assert record.metadata == {
        "query": "MATCH (a)",
        "query_sha256": hashlib.sha256(b"MATCH (a)").hexdigest(),
        "by": "me",
        "trace": "drive",
        "start_ns": "499999000",  # with the tolerance of times
        "end_ns": "1000001000",
        "source": "drive.mcap",
        "source_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "context": "messages outside start_ns..end_ns, such as the map, are no frames of the clip",
    }


def test_a_clip_is_read_again_as_the_same_frames(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with Recorder(path, chunk_size=800) as recorder:
        recorder.map("<OpenDRIVE/>")
        for i in range(30):
            lights = [bulb(9, 2, 2 + (i // 8) % 2, (5, 1, 4))] if i % 8 == 0 else []
            statics = [house(50 + i)] if i in {0, 4} else []
            moving = [car(1, i, v=(10, 0), a=(0, 0)), car(2, -i, v=(1, 0), a=(0, 0))]
            for thing in moving:
                thing.base.orientation_rate.yaw = 0.5
            recorder.ground_truth(i * 0.1, moving, host=1, lights=lights, houses=statics)

    (clip,) = cut(path, tmp_path / "out", (1.2, 2.0))

    whole, part = frames(path), frames(clip)
    assert part.pop(-1) == whole.pop(-1)
    assert part == {t: rows for t, rows in whole.items() if ns(1.2) <= t <= ns(2.0)}
    assert len(part) == 9


@pytest.mark.data
def test_a_clip_of_a_real_recording_is_read_again_as_the_same_frames(
    data: Path, tmp_path: Path
) -> None:
    path = data / "traces/esmini/traffic_lights.mcap"

    (clip,) = cut(path, tmp_path, (3.0, 9.9))

    whole, part = frames(path), frames(clip)
    assert part.pop(-1) == whole.pop(-1)
    within_reach = range(ns(3.0) - 1000, ns(9.9) + 1001)  # the tolerance of times
    assert part == {t: rows for t, rows in whole.items() if t in within_reach}


def test_a_clip_of_a_clip_is_that_clip_of_the_whole(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", frames=30)

    (first,) = cut(path, tmp_path / "first", (0.5, 2.5))
    (second,) = cut(first, tmp_path / "second", (1.0, 2.0))
    (straight,) = cut(path, tmp_path / "straight", (1.0, 2.0))

    assert messages(second) == messages(straight)
    assert list(frames(second)) == list(frames(straight))
    with second.open("rb") as stream:
        names = [m.name for m in make_reader(stream).iter_metadata()]
    assert names == ["sgstore.clip"]


def test_clips_may_overlap_and_come_in_any_order(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", frames=30, camera=False)
    other = drive(tmp_path / "other.mcap", frames=10, camera=False)
    clips = [
        Clip("drive", ns(2.0), ns(2.5)),
        Clip("other", ns(0.0), ns(0.3)),
        Clip("drive", ns(1.8), ns(2.2)),
    ]

    written = write_clips(clips, {"drive": source(path), "other": source(other)}, tmp_path / "out")

    assert [clip.file.name for clip in written] == [
        "drive_001.mcap",
        "other_001.mcap",
        "drive_002.mcap",
    ]
    counts = [{c.topic: c.messages for c in clip.messages}["truth"] for clip in written]
    assert counts == [6 + 1, 4, 5 + 1]
    assert [clip.context for clip in written] == [2, 0, 2]
    for clip in written:
        with clip.file.open("rb") as stream:
            times = [message.log_time for _, _, message in make_reader(stream).iter_messages()]
        assert clip.first_ns == min(times)


def test_the_whole_file_stands_the_test_of_the_official_reader_record_by_record(
    tmp_path: Path,
) -> None:
    (clip,) = cut(drive(tmp_path / "drive.mcap", frames=600), tmp_path / "out", (0.0, 60.0))

    with clip.open("rb") as stream:
        found = [
            r for r in StreamReader(stream, validate_crcs=True).records if isinstance(r, Message)
        ]
    indexed = summary(clip)
    assert len(found) == indexed.statistics.message_count == len(messages(clip))
    assert indexed.statistics.message_start_time == min(m.log_time for m in found)
    assert indexed.statistics.message_end_time == max(m.log_time for m in found)
    assert len(indexed.chunk_indexes) == indexed.statistics.chunk_count


def test_a_small_interval_found_by_its_index_is_what_was_written(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", frames=2500, camera=False)
    (clip,) = cut(path, tmp_path / "out", (0.0, 300.0))

    assert len(summary(clip).chunk_indexes) > 1
    with clip.open("rb") as stream:
        found = [
            m.data
            for _, _, m in make_reader(stream).iter_messages(
                topics=["truth"], starting_at=ns(200.0), ending_before=ns(201.0)
            )
        ]
    assert found == [m[-1] for m in within(path, 200.0, 200.95)]


# All of it or nothing ---------------------------------------------------------------------------------


def test_the_same_clips_are_the_same_bytes(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", frames=30)
    clips = [Clip("drive", ns(0.5), ns(1.0)), Clip("drive", ns(1.5), ns(2.0))]

    for name in ("one", "two"):
        write_clips(clips, {"drive": source(path)}, tmp_path / name, query="MATCH (a)")

    one, two = sorted((tmp_path / "one").iterdir()), sorted((tmp_path / "two").iterdir())
    assert [file.name for file in one] == [file.name for file in two]
    assert [file.read_bytes() for file in one] == [file.read_bytes() for file in two]


def test_a_manifest_tells_of_every_clip(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", frames=30)
    clips = [Clip("drive", ns(0.5), ns(1.0)), Clip("drive", ns(1.5), ns(2.0))]

    written = write_clips(clips, {"drive": source(path)}, tmp_path / "out", query="MATCH (a)")
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())

    assert manifest["format"] == "sgstore.clips"
    for clip, told in zip(written, manifest["clips"], strict=True):
        assert told["file"] == clip.file.name
        assert told["sha256"] == hashlib.sha256(clip.file.read_bytes()).hexdigest()
        assert told["source_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert (told["start_ns"], told["end_ns"]) == (clip.start_ns, clip.end_ns)
        assert told["provenance"]["query"] == "MATCH (a)"
        assert told["provenance"]["query_sha256"] == hashlib.sha256(b"MATCH (a)").hexdigest()
        assert told["provenance"]["tool"] == manifest["tool"]
        assert {c["topic"]: c["messages"] for c in told["messages"]}["truth"] == 6 + 1


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap")
    clips, sources = [Clip("drive", 0, ns(1.0))], {"drive": source(path)}
    for name in ("drive_001.mcap", "manifest.json"):
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        (folder / name).write_text("mine")

        with pytest.raises(ExportError, match="exists already and is not overwritten"):
            write_clips(clips, sources, folder)

        assert [file.read_text() for file in folder.iterdir()] == ["mine"]


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap")
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "drive_001.mcap").symlink_to(tmp_path / "elsewhere")

    with pytest.raises(ExportError):
        write_clips([Clip("drive", 0, ns(1.0))], {"drive": source(path)}, folder)

    assert not (tmp_path / "elsewhere").exists()


def test_an_export_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap")
    good, empty = Clip("drive", 0, ns(1.0)), Clip("drive", ns(50.0), ns(60.0))
    folder = tmp_path / "out"

    with pytest.raises(ExportError, match="no message between 50000000000 and 60000000000 ns"):
        write_clips([good, empty], {"drive": source(path)}, folder)

    assert not folder.exists()


def test_what_cannot_be_exported_is_named(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap")
    known = {"drive": source(path)}
    with pytest.raises(ExportError, match="before its start"):
        write_clips([Clip("drive", 9, 5)], known, tmp_path / "out")

    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(ExportError, match="has changed since it was ingested"):
        write_clips([Clip("drive", 0, 5)], known, tmp_path / "out")

    path.unlink()
    with pytest.raises(TraceError, match="file not found"):
        write_clips([Clip("drive", 0, 5)], known, tmp_path / "out")


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap")
    (tmp_path / "file").touch()

    with pytest.raises(ExportError, match="cannot be written"):
        write_clips([Clip("drive", 0, 5)], {"drive": source(path)}, tmp_path / "file" / "out")


def test_what_was_lost_of_the_source_is_told(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap", frames=40, chunk_size=2000, compression="")
    refs = source(path)
    index = summary(path).chunk_indexes[4]
    data = bytearray(path.read_bytes())
    data[index.chunk_start_offset + 200] ^= 0x55
    path.write_bytes(data)
    span = (index.message_start_time - ns(0.5), index.message_end_time + ns(0.5))

    (clip,) = write_clips(
        [Clip("drive", *span)], {"drive": Source(path, "", refs.context)}, tmp_path / "out"
    )

    assert "checksum" in clip.losses[0].reason
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert manifest["clips"][0]["losses"][0]["bytes"] == index.chunk_length
    far = write_clips(
        [Clip("drive", 0, index.message_start_time - 1)],
        {"drive": Source(path, "", refs.context)},
        tmp_path / "far",
    )
    assert far[0].losses == ()


def test_a_source_without_context_has_none(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive.mcap")
    none = MessageRefs(*(np.zeros(0, np.int64) for _ in range(5)))

    (clip,) = write_clips(
        [Clip("drive", ns(0.5), ns(1.0))], {"drive": Source(path, "", none)}, tmp_path / "out"
    )

    assert clip.context == 0
    assert messages(clip.file) == within(path, 0.5, 1.0)
