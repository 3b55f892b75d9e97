"""Decoders of sensor messages: pictures, point clouds and video packets."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from sgstore.errors import ExportError, TraceError
from sgstore.readers import picture_form, png, record_reader

if TYPE_CHECKING:
    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from sgstore.store import StoreFile

# Content of a sensor message: a picture or a point cloud, by the schema in the file. Messages with
# the file of a picture (``data`` and ``format``) give that file. Messages with pixels (``width``,
# ``height``, ``encoding``, ``data``) give a PNG, or an array if PNG cannot hold them. Messages with
# points (``fields`` and their offsets in ``data``) give columns. Other messages are not supported.
# Source: ROS 2, ``sensor_msgs`` (``Image``, ``PointCloud2``; ``image_encodings.hpp``); Foxglove's
# schemas ``RawImage``, ``CompressedImage``, ``PointCloud``, ``PackedElementField``.

VIDEO: Final = re.compile("26[45]|avc|hevc|av1|vp9", re.IGNORECASE)
"""Names of video formats."""

MAX_POINTS: Final = 20_000_000
"""Largest number of points in a point cloud."""

_ROS: Final = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), 1))

_FOXGLOVE: Final = dict(enumerate(("u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"), 1))

_FOXGLOVE_WORDS: Final = (
    *("UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64"),
)
"""Names of the number types of Foxglove, indexed by their number."""

_LAYOUTS: Final = {
    **dict.fromkeys(("mono8", "8uc1"), ("u1", 1, "")),
    **dict.fromkeys(("mono16", "16uc1"), ("u2", 1, "")),
    **dict.fromkeys(("rgb8", "8uc3"), ("u1", 3, "")),
    "rgb16": ("u2", 3, ""),
    "bgr8": ("u1", 3, "bgr"),
    "bgr16": ("u2", 3, "bgr"),
    **dict.fromkeys(("rgba8", "8uc4"), ("u1", 4, "")),
    "bgra8": ("u1", 4, "bgr"),
    "rgba16": ("u2", 4, ""),
    "bgra16": ("u2", 4, "bgr"),
    **dict.fromkeys(("yuv422", "uyvy", "yuv422_yuy2", "yuyv"), ("u1", 2, "array")),
}
"""Pixel encoding → type and number of values; and the order in a PNG (reversed, or no PNG possible)."""

_BAYER: Final = re.compile(r"bayer_[a-z]{4}(8|16)")

_OPENCV: Final = re.compile(r"(8|16|32|64)([usf])c(\d)")


class Sensed(NamedTuple):
    """Decoded content of a sensor message: a picture, a point cloud or a video packet.

    Attributes
    ----------
    holds : str
        ``picture``: content of a file; ``video``: one of its pictures; ``cloud``: points.
    form : str
        For a picture ``jpeg``, ``png``, ``webp``, ``tiff``, ``bmp`` or ``npy``; for a video the
        name in the message.
    data : bytes or structured array
        Points are little endian, without gaps.
    """

    holds: Literal["picture", "video", "cloud"]
    form: str
    data: Any


Record = Mapping[str, Any]


def sensor_of(channel: Channel, schema: Schema | None) -> Callable[[bytes], Sensed | None]:
    """Return a function that decodes the messages of a channel. For other data, the function returns ``None``.

    It raises ``TraceError`` for an inconsistent picture or cloud.
    """
    read = record_reader(channel, schema)

    def sensed(message: bytes) -> Sensed | None:
        record = read(message)
        return None if record is None else _of_record(record)

    return sensed


def cloud_of(file: StoreFile, frame: int | str, channel: str) -> NDArray[Any]:
    """Return the point cloud of a channel for a frame, as a structured array.

    Returns
    -------
    (N,) structured array
        One field per number of a point, with its name in the message; little endian.

    Raises
    ------
    StoreError
        The frame or channel is missing, or the frame has no message of the channel.
    TraceError
        The recording is missing, was replaced, or is damaged at this place.
    ExportError
        The message has no points.
    """
    known, schema, data = file.recorded(frame, channel)
    found = sensor_of(known, schema)(data)
    if found is None or found.holds != "cloud":
        held = "" if found is None else f", but a {found.holds}"
        raise ExportError(f"{channel}: the message holds no points{held}")
    return found.data


def _of_record(record: Record) -> Sensed | None:
    data = record.get("data")
    if isinstance(data, np.ndarray) and data.dtype.itemsize == 1:
        data = data.tobytes()
    if not isinstance(data, bytes):
        return None
    if isinstance(record.get("format"), str):
        return _of_file(data, record["format"])
    try:
        if isinstance(record.get("encoding"), str) and "width" in record and "height" in record:
            return _of_pixels(data, record)
        if "fields" in record and ("point_step" in record or "point_stride" in record):
            return Sensed("cloud", "", _points(data, record))
    except (ValueError, TypeError, LookupError, OverflowError) as error:
        raise TraceError(f"does not match its encoding: {error}") from error
    return None


def _of_file(data: bytes, form: str) -> Sensed | None:
    picture = picture_form(data)
    if picture:
        return Sensed("picture", picture, data)
    return Sensed("video", form, data) if VIDEO.search(form) else None


def _of_pixels(data: bytes, record: Record) -> Sensed:
    width, height = int(record["width"]), int(record["height"])
    encoding = str(record["encoding"]).lower()
    dtype, channels, how = _layout(encoding)
    big = bool(record.get("is_bigendian", False))
    kind = np.dtype(f"{'>' if big else '<'}{dtype}")
    across = width * channels * kind.itemsize
    step = int(record.get("step") or across)
    if width <= 0 or height <= 0 or step < across or step * height > len(data) + step - across:
        raise TraceError(
            f"a picture of {width} x {height} pixels ({encoding}) in {len(data)} bytes, {step} a row"
        )
    rows = np.frombuffer(data, np.uint8, step * (height - 1) + across)
    rows = np.lib.stride_tricks.as_strided(rows, (height, across), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)
    if how == "array":
        return Sensed("picture", "npy", _npy(pixels.astype(kind.newbyteorder("<"))))
    if how == "bgr":
        pixels = pixels[..., [2, 1, 0, *range(3, channels)]]
    return Sensed("picture", "png", png(pixels.astype(kind.newbyteorder("="))))


def _layout(encoding: str) -> tuple[str, int, str]:
    if encoding in _LAYOUTS:
        return _LAYOUTS[encoding]
    bayer = _BAYER.fullmatch(encoding)
    if bayer is not None:  # stored as grey, like the sensor's values
        return f"u{int(bayer[1]) // 8}", 1, ""
    opencv = _OPENCV.fullmatch(encoding)
    if opencv is not None:
        kind = {"u": "u", "s": "i", "f": "f"}[opencv[2]]
        return f"{kind}{int(opencv[1]) // 8}", int(opencv[3]), "array"
    raise TraceError(f"pixels in an encoding that is not known: {encoding!r}")


def _npy(array: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)
    return stream.getvalue()


def _points(data: bytes, record: Record) -> NDArray[Any]:
    ros = "point_step" in record
    step = int(record["point_step" if ros else "point_stride"])
    order = ">" if ros and record.get("is_bigendian") else "<"
    fields = [_field(one, order, ros=ros) for one in record["fields"]]
    names = [name for name, *_ in fields]
    kind = np.dtype(
        {
            "names": names,
            "formats": [form for _, form, _ in fields],
            "offsets": [offset for *_, offset in fields],
            "itemsize": step,
        }
    )
    if ros:
        width, height = int(record["width"]), int(record["height"])
        row = int(record.get("row_step") or width * step)
        if min(width, height) < 0 or row < width * step or row * height > len(data):
            raise TraceError(f"{width} x {height} points of {step} bytes in {len(data)} bytes")
        count, flat = width * height, row == width * step
    else:
        count, flat, width, height, row = len(data) // step if step else 0, True, 0, 0, 0
    if count > MAX_POINTS:
        raise TraceError(f"{count} points; at most {MAX_POINTS} are read")
    if flat:
        found = np.frombuffer(data, kind, count)
    else:
        rows = [np.frombuffer(data, kind, width, i * row) for i in range(height)]
        found = np.concatenate(rows) if rows else np.zeros(0, kind)
    packed = np.empty(count, [(name, kind[name].newbyteorder("<")) for name in names])
    for name in names:
        packed[name] = found[name]
    return packed


def _field(told: Any, order: str, *, ros: bool) -> tuple[str, Any, int]:
    """Return the name, data type and byte offset of a field of a point cloud."""
    number = told["datatype"] if ros else told["type"]
    if isinstance(number, str):
        number = _FOXGLOVE_WORDS.index(number)
    form = (_ROS if ros else _FOXGLOVE).get(int(number))
    if form is None:
        raise TraceError(f"points with numbers of a type that is not known: {number}")
    count = int(told.get("count") or 1) if ros else 1
    if not 1 <= count <= 4096:
        raise TraceError(f"points with {count} numbers in one field")
    kind = f"{order}{form}"
    return str(told["name"]), kind if count == 1 else (kind, (count,)), int(told["offset"])


def cloud_file(points: NDArray[Any], form: str) -> bytes:
    """Return a point cloud as the bytes of a file, in a given format.

    Parameters
    ----------
    points : structured array
    form : str
        ``pcd``: the Point Cloud Library's format 0.7, binary. ``npy``: numpy's, structured.
        ``bin``: as in KITTI, x, y, z and intensity in float32, 0 for missing ones.
    """
    if form == "npy":
        return _npy(points)
    if form == "bin":
        columns = [
            points[name] if name in (points.dtype.names or ()) else np.zeros(len(points))
            for name in ("x", "y", "z", "intensity")
        ]
        return np.stack(columns, axis=1).astype("<f4").tobytes()
    return _pcd(points)


def _pcd(points: NDArray[Any]) -> bytes:
    """Return a point cloud as the bytes of a PCD file (version 0.7)."""
    names = points.dtype.names or ()
    kinds = [points.dtype[name] for name in names]
    letters = {"f": "F", "i": "I", "u": "U"}
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(re.sub(r"\W", "_", name) or "_" for name in names),
        "SIZE " + " ".join(str(kind.base.itemsize) for kind in kinds),
        "TYPE " + " ".join(letters[kind.base.kind] for kind in kinds),
        "COUNT " + " ".join(str(int(np.prod(kind.shape, dtype=int))) for kind in kinds),
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode("ascii", "replace") + points.tobytes()
