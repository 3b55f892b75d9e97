"""Pictures of sensor views by key of their frame, and single-channel files end to end."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.reader import make_reader
from PIL import Image
from recordings import Recorder, car, ground_truth
from test_osi_file import messages, packed

import sgstore
from sgstore.exporters import Export, write_export
from sgstore.ingest import ingest
from sgstore.model.world import TraceReport
from sgstore.readers import OsiFile, descriptors, message_class, open_trace
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(8)

WIDTH, HEIGHT = 5, 3
KINDS = {
    "MONO_U8": (2, "u1", 1),
    "MONO_U16": (3, "<u2", 1),
    "RGB_U8": (6, "u1", 3),
    "RGB_U16": (7, "<u2", 3),
    "BAYER": (10, "u1", 1),
}


class Everything(Recorder):
    """Writes sensor views with all of sgstore's own descriptors."""


def view_class() -> Any:
    from mcap.records import Schema

    schema = Schema(1, descriptors(), "protobuf", "osi3.SensorView")
    return message_class(
        schema, {"camera_sensor_view": None, "global_ground_truth": None, "timestamp": None}
    )


def view(time: float, image: bytes, kind: int = 6, order: int = 0, **size: int) -> bytes:
    """A sensor view with a camera; ``kind``, ``order``: numbers of the format and of the order of pixels."""
    told = view_class()()
    camera = told.camera_sensor_view.add()
    camera.image_data = image
    configuration = camera.view_configuration
    configuration.number_of_pixels_horizontal = size.get("width", WIDTH)
    configuration.number_of_pixels_vertical = size.get("height", HEIGHT)
    configuration.channel_format.append(kind)
    configuration.pixel_order = order
    ground = ground_truth(time, [car(1, 10 * time)], host=1).SerializeToString()
    return (
        told.SerializeToString()
        + b"\x3a"
        + bytes([len(ground) & 0x7F | 0x80, len(ground) >> 7])
        + ground
    )


def pixels(kind: str, seed: int = 0) -> np.ndarray[Any, Any]:
    _, dtype, channels = KINDS[kind]
    top = np.iinfo(dtype).max
    shape = (HEIGHT, WIDTH, channels) if channels > 1 else (HEIGHT, WIDTH)
    return np.random.default_rng(seed).integers(0, top, shape, endpoint=True).astype(dtype)


def drive(path: Path, kind: str, order: int = 0, frames: int = 3) -> Path:
    with Everything(path) as recorder:
        channel = recorder.channel("view", "osi3.SensorView")
        for i in range(frames):
            data = view(i / 10, pixels(kind, i).tobytes(), KINDS[kind][0], order)
            recorder.write(channel, i / 10, data)
    return path


def carried(tmp_path: Path, recording: Path, frame: int) -> Any:
    store = tmp_path / "s.sgstore"
    (outcome,) = ingest(store, [recording])
    assert outcome.error is None
    file = StoreFile(store)
    return file.carried(f"{outcome.name}#{frame}", "view")


@pytest.fixture(autouse=True)
def all_of_osi(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings carry the descriptors that sgstore ships, which have cameras."""

    def channel(self: Recorder, topic: str, schema: str, data: bytes | None = None) -> int:
        del data
        if topic not in self.channels:
            number = self.writer.register_schema(schema, "protobuf", descriptors())
            self.channels[topic] = self.writer.register_channel(topic, "protobuf", number)
        return self.channels[topic]

    monkeypatch.setattr(Everything, "channel", channel)


@pytest.mark.parametrize("kind", ["MONO_U8", "MONO_U16", "RGB_U8"])
def test_a_picture_by_key_has_the_pixels_of_the_message(tmp_path: Path, kind: str) -> None:
    found = carried(tmp_path, drive(tmp_path / "a.mcap", kind), 2)

    assert found.form == "png"
    with Image.open(io.BytesIO(found.data)) as picture:
        np.testing.assert_array_equal(np.asarray(picture), pixels(kind, 2))


def test_sixteen_bits_of_colour_are_kept(tmp_path: Path) -> None:
    found = carried(tmp_path, drive(tmp_path / "a.mcap", "RGB_U16"), 0)

    assert (found.form, found.data[24:26]) == ("png", b"\x10\x02")  # 16 bits, red green blue
    with Image.open(io.BytesIO(found.data)) as picture:  # which gives the upper 8
        np.testing.assert_array_equal(np.asarray(picture), pixels("RGB_U16") >> 8)


@pytest.mark.parametrize(("order", "axis"), [(2, 1), (3, 0)])
def test_pixels_in_another_order_are_turned_round(tmp_path: Path, order: int, axis: int) -> None:
    found = carried(tmp_path, drive(tmp_path / "a.mcap", "RGB_U8", order), 0)

    with Image.open(io.BytesIO(found.data)) as picture:
        np.testing.assert_array_equal(np.asarray(picture), np.flip(pixels("RGB_U8"), axis))


def test_a_jpeg_in_the_place_of_pixels_is_given_as_it_is(tmp_path: Path) -> None:
    stream = io.BytesIO()
    Image.fromarray(pixels("RGB_U8")).save(stream, "jpeg")
    path = tmp_path / "a.mcap"
    with Everything(path) as recorder:
        channel = recorder.channel("view", "osi3.SensorView")
        recorder.write(channel, 0.0, view(0.0, stream.getvalue(), 1))
    found = carried(tmp_path, path, 0)

    assert (found.form, found.data) == ("jpeg", stream.getvalue())


def test_a_jpeg_in_the_place_of_pixels_is_exported_under_its_own_ending(tmp_path: Path) -> None:
    stream = io.BytesIO()
    Image.fromarray(pixels("RGB_U8")).save(stream, "jpeg")
    with Everything(tmp_path / "a.mcap") as recorder:
        channel = recorder.channel("view", "osi3.SensorView")
        recorder.write(channel, 0.0, view(0.0, stream.getvalue(), 1))
    ingest(tmp_path / "s.sgstore", [tmp_path / "a.mcap"])
    store = sgstore.open(tmp_path / "s.sgstore")
    clips = list(store.find("MATCH (e:Ego)").clips(0.0, 0.0))

    write_export(Export(store, tuple(clips)), tmp_path / "clips", "frames")

    (file,) = (tmp_path / "clips").rglob("*.jpg")
    assert file.read_bytes() == stream.getvalue()


@pytest.mark.parametrize(
    "how",
    [{"kind": 10}, {"kind": 1}, {"width": 6}, {"width": 0, "height": 0}, {"height": 1 << 31}],
)
def test_what_no_file_can_hold_is_the_message(tmp_path: Path, how: dict[str, int]) -> None:
    data = view(0.0, pixels("RGB_U8").tobytes(), **how)
    path = tmp_path / "a.mcap"
    with Everything(path) as recorder:
        recorder.write(recorder.channel("view", "osi3.SensorView"), 0.0, data)
    found = carried(tmp_path, path, 0)

    assert (found.form, found.data) == ("message", data)


# Single-channel files, from end to end ------------------------------------------------------------------


def test_a_single_channel_file_is_ingested_asked_read_and_cut(tmp_path: Path) -> None:
    told = messages(20)
    path = tmp_path / "drive.osi"
    path.write_bytes(packed(told))
    store_path = tmp_path / "s.sgstore"
    (outcome,) = ingest(store_path, [path])
    assert (outcome.status, outcome.frames) == ("added", 20), outcome.error

    store = sgstore.open(store_path)
    found = store.find("MATCH (e:Ego) WHERE e.x >= 5 AND e.x < 8 RETURN e.ident, e.x")
    assert [row[-1] for row in found] == [5.0, 6.0, 7.0]
    assert store.payload("drive#6", "ground_truth") == told[6]
    assert StoreFile(store_path).carried("drive#6", "ground_truth").data == told[6]

    matches = store.find("MATCH (e:Ego) WHERE e.x >= 5 AND e.x < 8")
    write_export(Export(store, tuple(matches.clips(0.0, 0.0))), tmp_path / "clips")
    (clip,) = (tmp_path / "clips").glob("*.mcap")
    with clip.open("rb") as stream:
        cut = [message.data for _, _, message in make_reader(stream).iter_messages()]
    assert cut[-3:] == told[5:8]
    with open_trace(clip) as trace:
        blocks = list(trace.blocks())
        assert sum(len(block) for block in blocks) == 3
        assert "50" in blocks[0].entities.ident  # the house, which only the first message told


def test_a_single_channel_file_has_nothing_beside_its_messages(tmp_path: Path) -> None:
    path = tmp_path / "drive.osi"
    path.write_bytes(packed(messages(2)))
    with OsiFile(path) as recording:
        assert dict(recording.metadata) == {}
        assert recording.attachments == ()
        assert sum(len(run) for run in recording.walk(TraceReport())) == 2
