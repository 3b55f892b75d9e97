"""Pictures, clouds and videos as files: what is in a message, in every encoding, is what was put into it."""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import json
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from mcap.records import Channel, Schema
from PIL import Image
from recordings import Recorder, car

import sgstore
import sgstore.exporters._foxglove as foxglove
from sgstore.errors import ExportError, TraceError
from sgstore.exporters import Export, labelled, write_export
from sgstore.exporters._sensor_data import Sensed, cloud_file, sensor_of
from sgstore.ingest import ingest
from sgstore.model.world import Clip
from sgstore.readers import png

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.query import Store

S = 1_000_000_000
RNG = np.random.default_rng(7)


def opened(data: bytes) -> np.ndarray:
    """The pixels of a picture, as Pillow reads it."""
    return np.asarray(Image.open(io.BytesIO(data)))


# PNG -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(
    "shape", [(5, 7), (5, 7, 1), (5, 7, 2), (5, 7, 3), (5, 7, 4), (1, 1), (3, 1, 3)]
)
def test_pillow_reads_the_pixels_that_were_written(shape: tuple[int, ...], dtype: Any) -> None:
    if dtype == np.uint16 and shape[2:] == (2,):
        pytest.skip("Pillow makes something else of two numbers of 16 bits")
    pixels = RNG.integers(0, np.iinfo(dtype).max, shape, dtype)

    found = opened(png(pixels))

    if dtype == np.uint16 and len(shape) == 3 and shape[-1] > 1:
        found, pixels = found.astype(np.uint16), pixels >> 8  # Pillow has 8 bits for colours
    assert (found.reshape(pixels.shape) == pixels).all()


@pytest.mark.parametrize(
    "pixels",
    [np.zeros((0, 3), np.uint8), np.zeros((2, 2), np.float32), np.zeros((2, 2, 5), np.uint8)],
)
def test_what_is_no_picture_is_refused(pixels: np.ndarray) -> None:
    with pytest.raises(ExportError, match="no picture"):
        png(pixels)


# Messages --------------------------------------------------------------------------------------------

IMAGE = b"""std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
CLOUD = b"""std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


class Cdr:
    """A message in CDR, value by value."""

    def __init__(self) -> None:
        self.data = bytearray(b"\0\1\0\0")
        self.number(0, "i").number(0, "I").text("camera")

    def number(self, value: float, code: str) -> Cdr:
        size = struct.calcsize(code)
        self.data += b"\0" * (-(len(self.data) - 4) % size) + struct.pack(f"<{code}", value)
        return self

    def text(self, value: str) -> Cdr:
        self.number(len(value) + 1, "I")
        self.data += value.encode() + b"\0"
        return self

    def bytes(self, value: bytes) -> Cdr:
        self.number(len(value), "I")
        self.data += value
        return self


def ros_image(
    pixels: np.ndarray, encoding: str, *, step: int = 0, big: bool = False, cut: int = 0
) -> bytes:
    height, width = pixels.shape[:2]
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).reshape(height, -1)
    rows = rows.view(np.uint8)
    step = step or rows.shape[1]
    padded = np.zeros((height, step), np.uint8)
    padded[:, : rows.shape[1]] = rows
    told = Cdr().number(height, "I").number(width, "I").text(encoding).number(big, "B")
    return bytes(told.number(step, "I").bytes(padded.tobytes()[: padded.size - cut]).data)


def ros(name: str, text: bytes) -> Callable[[bytes], Any]:
    return sensor_of(Channel(1, "/t", "cdr", {}, 1), Schema(1, text, "ros2msg", name))


def as_json(name: str = "foxglove.RawImage") -> Callable[[bytes], Any]:
    return sensor_of(Channel(1, "/t", "json", {}, 1), Schema(1, b"{}", "jsonschema", name))


def image_of(pixels: np.ndarray, encoding: str, **how: Any) -> Any:
    return ros("sensor_msgs/msg/Image", IMAGE)(ros_image(pixels, encoding, **how))


COLOUR = RNG.integers(0, 255, (6, 5, 3), np.uint8)
WITH_ALPHA = RNG.integers(0, 255, (6, 5, 4), np.uint8)
GREY = RNG.integers(0, 255, (6, 5), np.uint8)
DEEP = RNG.integers(0, 65535, (6, 5), np.uint16)


@pytest.mark.parametrize(
    ("encoding", "sent", "expected"),
    [
        ("rgb8", COLOUR, COLOUR),
        ("bgr8", COLOUR, COLOUR[..., ::-1]),
        ("8UC3", COLOUR, COLOUR),
        ("rgba8", WITH_ALPHA, WITH_ALPHA),
        ("bgra8", WITH_ALPHA, WITH_ALPHA[..., [2, 1, 0, 3]]),
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("bayer_rggb8", GREY, GREY),
        ("mono16", DEEP, DEEP),
        ("16UC1", DEEP, DEEP),
        ("bayer_gbrg16", DEEP, DEEP),
    ],
)
@pytest.mark.parametrize("how", [{}, {"step": 64}, {"big": True}])
def test_pixels_become_a_picture(
    encoding: str, sent: np.ndarray, expected: np.ndarray, how: dict[str, Any]
) -> None:
    found = image_of(sent, encoding, **how)

    assert found is not None
    assert found.holds == "picture"
    assert found.form == "png"
    assert (opened(found.data) == expected).all()


@pytest.mark.parametrize(
    ("encoding", "sent"),
    [
        ("32FC1", RNG.random((4, 3), np.float32)),
        ("64FC2", RNG.random((4, 3, 2))),
        ("16SC1", DEEP[:4, :3].astype(np.int16)),
        ("32SC3", RNG.integers(-9, 9, (4, 3, 3), np.int32)),
        ("8UC2", COLOUR[:4, :3, :2]),
        ("uyvy", COLOUR[:4, :3, :2]),
        ("yuv422_yuy2", COLOUR[:4, :3, :2]),
    ],
)
@pytest.mark.parametrize("big", [False, True])
def test_what_no_png_can_hold_becomes_an_array(encoding: str, sent: np.ndarray, big: bool) -> None:
    found = image_of(sent, encoding, big=big)

    assert found.form == "npy"
    array = np.load(io.BytesIO(found.data), allow_pickle=False)
    assert (array.reshape(sent.shape) == sent).all()
    assert array.dtype == sent.dtype


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"encoding": "nv21"}, "not known: 'nv21'"),
        ({"cut": 9}, "5 x 6 pixels"),
        ({"step": 4}, "5 x 6 pixels"),
    ],
)
def test_a_picture_that_lies_is_refused(how: dict[str, Any], says: str) -> None:
    told = {"pixels": COLOUR, "encoding": "rgb8"} | how
    if "step" in how:
        data = bytearray(ros_image(COLOUR, "rgb8"))
        at = data.index(struct.pack("<I", 15), 40)
        data[at : at + 4] = struct.pack("<I", 4)
        with pytest.raises(TraceError, match=says):
            ros("sensor_msgs/msg/Image", IMAGE)(bytes(data))
        return

    with pytest.raises(TraceError, match=says):
        image_of(told.pop("pixels"), told.pop("encoding"), **told)


def test_pixels_in_json_and_files_of_pictures_are_found_too() -> None:
    data = base64.b64encode(COLOUR.tobytes()).decode()
    raw = {"width": 5, "height": 6, "step": 15, "encoding": "rgb8", "data": data}
    file = {"format": "jpeg", "data": base64.b64encode(png(COLOUR)).decode()}
    video = {"format": "h264", "data": data}

    assert (opened(as_json()(json.dumps(raw).encode()).data) == COLOUR).all()
    assert as_json()(json.dumps(file).encode()) == Sensed("picture", "png", png(COLOUR))
    assert as_json()(json.dumps(video).encode()).holds == "video"
    for other in (
        b"[1]",
        b"{",
        b'{"data": 5}',
        b'{"data": "%%"}',
        b'{"x": 1}',
        b"\xff",
        b"[" * 100_000,
    ):
        assert as_json()(other) is None


def test_a_message_of_foxgloves_is_read_by_the_schema_in_the_file() -> None:
    channel = Channel(1, "/t", "protobuf", {}, 1)

    def of(name: str) -> Callable[[bytes], Any]:
        return sensor_of(channel, Schema(1, foxglove.schema(name), "protobuf", f"foxglove.{name}"))

    points = np.array(
        [(1, 2, 3, 4), (5, 6, 7, 8)], [(n, "<f4") for n in ("x", "y", "z", "intensity")]
    )
    cloud = of("PointCloud")(foxglove.cloud(points, 0, "lidar"))
    assert cloud.holds == "cloud"
    assert cloud.data.tolist() == points.tolist()
    assert (opened(of("CompressedImage")(foxglove.image(COLOUR, 0, "c")).data) == COLOUR).all()
    assert of("CameraCalibration")(foxglove.calibration(4, 3, 90, 0, "c")) is None
    with pytest.raises(TraceError, match="malformed"):
        of("PointCloud")(b"\xff" * 9)


def ros_cloud(
    points: np.ndarray, *, height: int = 1, padding: int = 0, big: bool = False, cut: int = 0
) -> bytes:
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    width = len(points) // height
    told = Cdr().number(height, "I").number(width, "I").number(len(points.dtype.names), "I")
    for name in points.dtype.names:
        kind, offset = points.dtype.fields[name][:2]
        told.text(name).number(offset, "I").number(codes[kind.base.str[1:]], "B")
        told.number(int(np.prod(kind.shape, dtype=int)), "I")
    step = points.dtype.itemsize
    row = width * step + padding
    rows = [points[i * width : (i + 1) * width].tobytes() + b"\0" * padding for i in range(height)]
    data = b"".join(rows)
    told.number(big, "B").number(step, "I").number(row, "I").bytes(data[: len(data) - cut])
    return bytes(told.number(1, "B").data)


POINTS = np.zeros(
    6,
    np.dtype(
        {
            "names": ["x", "y", "z", "ring"],
            "formats": ["<f4", "<f4", "<f8", "<u2"],
            "offsets": [0, 4, 16, 8],
            "itemsize": 26,
        }
    ),
)
for _name in POINTS.dtype.names or ():
    POINTS[_name] = RNG.integers(0, 99, 6)


@pytest.mark.parametrize("how", [{}, {"height": 2, "padding": 5}, {"height": 3}])
def test_points_with_gaps_in_rows_become_columns(how: dict[str, Any]) -> None:
    found = ros("sensor_msgs/msg/PointCloud2", CLOUD)(ros_cloud(POINTS, **how)).data

    assert found.dtype == np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f8"), ("ring", "<u2")])
    assert found.tolist() == POINTS.tolist()


def test_points_of_several_numbers_and_of_the_other_order_are_read() -> None:
    points = np.zeros(2, [("x", ">f4"), ("normal", ">f4", (3,))])
    points["x"], points["normal"] = (1, 2), [[1, 2, 3], [4, 5, 6]]
    data = ros_cloud(points, big=True)

    found = ros("sensor_msgs/msg/PointCloud2", CLOUD)(data).data

    assert found["normal"].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert found.dtype["normal"].base.str == "<f4"


@pytest.mark.parametrize("how", [{"cut": 1}, {"padding": -4}])
def test_points_that_are_not_there_are_refused(how: dict[str, Any]) -> None:
    data = ros_cloud(POINTS, cut=how.get("cut", 0))
    if "padding" in how:
        row = struct.pack("<I", 26 * 6)
        data = data.replace(row, struct.pack("<I", 7), 1)

    with pytest.raises(TraceError, match="6 x 1 points"):
        ros("sensor_msgs/msg/PointCloud2", CLOUD)(data)


@pytest.mark.parametrize(
    "fields",
    [
        [{"name": "x", "offset": 90, "type": 7}],
        [{"name": "x", "offset": 0, "type": 77}],
        [{"name": "x", "offset": 0, "type": "COMPLEX"}],
        [{"name": "x", "offset": 0, "type": 7}, {"name": "x", "offset": 4, "type": 7}],
        [{"name": "x", "offset": -4, "type": 7}],
        [{"name": "x"}],
        "xyz",
    ],
)
def test_points_that_lie_about_their_fields_are_refused(fields: Any) -> None:
    told = {"fields": fields, "point_stride": 8, "data": base64.b64encode(b"\0" * 16).decode()}

    with pytest.raises(TraceError):
        as_json("foxglove.PointCloud")(json.dumps(told).encode())


# Clouds as files -------------------------------------------------------------------------------------


def test_a_cloud_is_the_same_in_every_format() -> None:
    points = np.zeros(
        3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("t s", "<f8")]
    )
    points["x"], points["intensity"] = (1, 2, 3), (7, 8, 9)

    head, _, body = cloud_file(points, "pcd").partition(b"DATA binary\n")
    told = dict(line.split(" ", 1) for line in head.decode().splitlines() if line[0] != "#")
    assert told["FIELDS"].split() == ["x", "y", "z", "intensity", "t_s"]
    assert told["TYPE"].split() == ["F", "F", "F", "U", "F"]
    assert told["SIZE"].split() == ["4", "4", "4", "1", "8"]
    assert (told["COUNT"], told["POINTS"], told["WIDTH"]) == ("1 1 1 1 1", "3", "3")
    assert np.frombuffer(body, points.dtype).tolist() == points.tolist()
    array = np.load(io.BytesIO(cloud_file(points, "npy")), allow_pickle=False)
    assert array.tolist() == points.tolist()
    kitti = np.frombuffer(cloud_file(points, "bin"), "<f4").reshape(-1, 4)
    assert kitti.tolist() == [[1, 0, 0, 7], [2, 0, 0, 8], [3, 0, 0, 9]]


def test_a_cloud_without_points_is_a_file_too() -> None:
    points = np.zeros(0, [("x", "<f4")])

    assert b"POINTS 0\n" in cloud_file(points, "pcd")
    assert cloud_file(points, "bin") == b""


# Folders ---------------------------------------------------------------------------------------------


def video(frames: int, key_every: int) -> list[bytes]:
    """Frames of H.264, as an encoder makes them, one access unit each."""
    import av

    stream = av.CodecContext.create("libx264", "w")
    stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
    stream.framerate = 10
    stream.options = {
        "tune": "zerolatency",
        "x264-params": f"keyint={key_every}:scenecut=0:repeat-headers=1",
    }
    units: list[bytes] = []
    for i in range(frames):
        pixels = np.full((48, 64, 3), 5 * i, np.uint8)
        units += [
            bytes(p) for p in stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24"))
        ]
    return units + [bytes(p) for p in stream.encode(None)]


def decoded(file: Path) -> list[int]:
    """Mean brightness of each picture of a video."""
    import av

    with av.open(str(file), format="h264") as container:
        return [int(frame.to_ndarray(format="rgb24").mean()) for frame in container.decode(video=0)]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Two seconds: a camera of files at half the rate, one of video at twice, a cloud, and other things."""
    folder = tmp_path_factory.mktemp("sensors")
    units = video(40, 8)
    points = np.array([(1, 2, 3)], [(n, "<f4") for n in "xyz"])

    def put(recorder: Recorder, topic: str, name: str, time: float, data: bytes) -> None:
        if topic not in recorder.channels:
            writer, schema = recorder.writer, foxglove.schema(name)
            number = writer.register_schema(f"foxglove.{name}", "protobuf", schema)
            recorder.channels[topic] = writer.register_channel(topic, "protobuf", number)
        recorder.write(recorder.channels[topic], time, data)

    with Recorder(folder / "drive.mcap", chunk_size=3000) as recorder:
        for i in range(20):
            t = i * 0.1
            recorder.ground_truth(t, [car(7, i, v=(i, 0), name="Ego")], host=7)
            if i % 2 == 0:
                picture = foxglove.image(np.full((4, 4, 3), i, np.uint8), 0, "c")
                put(recorder, "/../../cam/front", "CompressedImage", t + 0.01, picture)
            cloud = foxglove.cloud(points, 0, "l")
            put(recorder, "/cam_front", "PointCloud", t, b"\xff" if i == 5 else cloud)
            for half in (0, 1):
                message = foxglove.message_type("CompressedImage")(
                    format="h264", data=units[2 * i + half]
                )
                put(
                    recorder,
                    "/video",
                    "CompressedImage",
                    t + half * 0.05,
                    message.SerializeToString(),
                )
            recorder.camera(t, topic="/imu")
    ingest(folder / "s.sgstore", [folder / "drive.mcap"])
    return sgstore.open(folder / "s.sgstore")


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def written(store: Store, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    to = tmp_path_factory.mktemp("frames") / "out"
    export = labelled(Export(store, (Clip("drive", 5 * S // 10, 15 * S // 10),)), {"x": "ego.x"})
    files = write_export(export, to, "frames")
    return SimpleNamespace(to=to, files=files, rows=rows(to / "files.csv"))


def test_files_of_pictures_are_what_the_store_hands_out(
    store: Store, written: SimpleNamespace
) -> None:
    mine = [row for row in written.rows if row["channel"] == "/../../cam/front"]

    assert len(mine) == 11
    for row in mine:
        data = (written.to / row["file"]).read_bytes()
        assert data == store.file.carried(int(row["frame_id"]), row["channel"]).data
        assert row["sha256"] == hashlib.sha256(data).hexdigest()
        assert (row["holds"], row["form"]) == ("picture", "png")
    assert len({row["file"] for row in mine}) in {5, 6}  # two frames share a picture


def test_topics_cannot_leave_the_folder_or_meet_in_one(written: SimpleNamespace) -> None:
    folders = {row["channel"]: Path(row["file"]).parent.name for row in written.rows}

    assert folders["/../../cam/front"] == "cam_front"
    assert folders["/cam_front"] == "cam_front_2"
    files = {
        file.relative_to(written.to).as_posix() for file in written.to.rglob("*") if file.is_file()
    }
    tables = {"files.csv", "frames.csv", "channels.csv", "manifest.json"}
    assert files == {row["file"] for row in written.rows} | tables


def test_a_video_is_one_file_that_can_be_decoded_and_rows_say_which_picture(
    store: Store, written: SimpleNamespace
) -> None:
    mine = [row for row in written.rows if row["channel"] == "/video"]
    pictures = decoded(written.to / mine[0]["file"])

    assert {row["file"] for row in mine} == {"drive_001/video.h264"}
    assert len(mine) == 11
    for row in mine:
        last = store.file.carried(int(row["frame_id"]), "/video").data
        single = written.to.parent / "one.h264"
        single.write_bytes(last)
        assert pictures[int(row["picture"])] == decoded(single)[-1]
    assert [int(row["picture"]) for row in mine] == sorted(int(row["picture"]) for row in mine)
    assert len(pictures) == int(mine[-1]["picture"]) + 1


def test_messages_that_are_hurt_are_a_loss_and_all_others_are_there(
    written: SimpleNamespace,
) -> None:
    table = {row["channel"]: row for row in rows(written.to / "channels.csv")}
    (loss,) = [loss for one in written.files for loss in one.losses]

    assert "'/cam_front': 1 messages are not there" in loss.reason
    assert table["/cam_front"]["lost"] == "1"
    assert len([row for row in written.rows if row["channel"] == "/cam_front"]) == 10
    assert table["/imu"]["holds"] == "message"
    assert table["/imu"]["files"] == "0"
    assert table["truth"]["holds"] == "message"


def test_the_table_of_frames_has_all_frames_and_labels(
    store: Store, written: SimpleNamespace
) -> None:
    frames = rows(written.to / "frames.csv")

    assert [int(row["seq"]) for row in frames] == list(range(5, 16))
    assert [float(row["x"]) for row in frames] == [float(i) for i in range(5, 16)]


def test_one_sensor_can_be_chosen_and_its_format(store: Store, tmp_path: Path) -> None:
    whole = (Clip("drive", 0, 2 * S),)
    for form in ("npy", "bin", "pcd"):
        to = tmp_path / form
        write_export(Export(store, whole, channels=("/cam_front",), clouds=form), to, "frames")
        assert {path.suffix for path in (to / "drive_001").rglob("*.*")} == {f".{form}"}
        assert [row["channel"] for row in rows(to / "channels.csv")] == ["/cam_front"]

    with pytest.raises(ExportError, match="did you mean '/cam_front'"):
        write_export(Export(store, whole, channels=("/camfront",)), tmp_path / "no", "frames")


def test_windows_of_few_frames_make_the_same_files(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Export(store, (Clip("drive", 3 * S // 10, 2 * S),))
    write_export(whole, tmp_path / "one", "frames")
    monkeypatch.setattr("sgstore.exporters._frames.WINDOW", 3)
    write_export(whole, tmp_path / "many", "frames")

    def content(folder: Path) -> dict[str, bytes]:
        found = [file for file in folder.rglob("*") if file.is_file()]
        return {file.relative_to(folder).as_posix(): file.read_bytes() for file in found}

    assert content(tmp_path / "many") == content(tmp_path / "one")


def test_messages_that_are_hurt_at_random_are_read_or_refused() -> None:
    ways = {
        "image": (ros("sensor_msgs/msg/Image", IMAGE), ros_image(DEEP, "mono16", step=12)),
        "cloud": (
            ros("sensor_msgs/msg/PointCloud2", CLOUD),
            ros_cloud(POINTS, height=2, padding=3),
        ),
        "foxglove": (
            sensor_of(
                Channel(1, "/t", "protobuf", {}, 1),
                Schema(1, foxglove.schema("PointCloud"), "protobuf", "foxglove.PointCloud"),
            ),
            foxglove.cloud(np.ones(3, [("x", "<f4"), ("y", "<u4")]), 5, "lidar"),
        ),
        "json": (
            as_json(),
            json.dumps(
                {"width": 5, "height": 6, "step": 15, "encoding": "rgb8", "data": "AAAA" * 30}
            ).encode(),
        ),
    }
    rng = np.random.default_rng(13)
    outcomes: set[str] = set()
    for read, message in ways.values():
        for _ in range(600):
            hurt = bytearray(message)
            for at in rng.integers(0, len(hurt), rng.integers(1, 4)):
                hurt[at] = rng.integers(0, 256)
            try:
                found = read(bytes(hurt[: rng.integers(len(hurt) // 2, len(hurt) + 1)]))
            except (TraceError, ExportError):
                outcomes.add("refused")
                continue
            outcomes.add("nothing" if found is None else found.holds)
            if found is not None and found.holds == "cloud":
                assert all(
                    cloud_file(found.data, form) is not None for form in ("pcd", "npy", "bin")
                )
    assert outcomes >= {"refused", "picture", "cloud"}


# Colours of scenes in a viewer ----------------------------------------------------------------------


def luminance(colour: tuple[float, ...]) -> float:
    """Relative luminance of sRGB. (WCAG 2.2.)"""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour[:3]]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(colour: tuple[float, ...], ground: float) -> float:
    """Contrast ratio of a colour, as far as it covers, to a grey ground."""
    seen = [c * colour[3] + ground * (1 - colour[3]) for c in colour[:3]]
    low, high = sorted((luminance((*seen,)), luminance((ground,) * 3)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("ground", [0.0, 1.0], ids=["black", "white"])
def test_a_scene_reads_on_light_and_on_dark(ground: float) -> None:
    solid = [foxglove.EGO_COLOUR, foxglove.OTHERS]
    solid += [*foxglove.COLOURS.values(), *foxglove.LIGHTS.values()]
    edges = [*foxglove.RELATION_COLOURS.values(), foxglove.OTHER_RELATIONS]

    assert contrast(foxglove.TEXT_COLOUR, ground) >= 4.5
    assert min(contrast(one, ground) for one in solid) >= 3
    assert min(contrast(one, ground) for one in edges) >= 1.5
    assert contrast(foxglove.RELATION_COLOURS["overlaps"], ground) >= 3
