"""Pictures in ``osi3.SensorView``: what a camera saw, as a PNG, or as the file that is there already.

OSI's picture is bare pixels; how many, of what, and in which order its configuration says. What a PNG can hold
without loss (grey and red-green-blue, of 8 and 16 bits) becomes one; of any other the message is all there is.

Source: open-simulation-interface 3.8.0 (osi_sensorview.proto, osi_sensorviewconfiguration.proto); PNG (ISO
15948), chunks IHDR, IDAT, IEND.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.readers.osi._schema import DECODE_ERRORS, message_class

if TYPE_CHECKING:
    from collections.abc import Callable

    from mcap.records import Schema
    from numpy.typing import NDArray


_FIELDS: Final[dict[str, Any]] = {
    "camera_sensor_view": {
        "view_configuration": dict.fromkeys(
            (
                "number_of_pixels_horizontal",
                "number_of_pixels_vertical",
                "channel_format",
                "pixel_order",
            )
        ),
        "image_data": None,
    }
}
_LAYOUTS: Final = {
    "CHANNEL_FORMAT_MONO_U8_LIN": (1, "u1"),
    "CHANNEL_FORMAT_MONO_U16_LIN": (1, "<u2"),
    "CHANNEL_FORMAT_RGB_U8_LIN": (3, "u1"),
    "CHANNEL_FORMAT_RGB_U16_LIN": (3, "<u2"),
}
"""Formats of channels → how many there are, and the type of their numbers."""
_FILES: Final = (b"\xff\xd8\xff", b"\x89PNG")
"""How the files begin that some producers put in the place of pixels: JPEG, PNG."""
_RIGHT_TO_LEFT, _BOTTOM_TO_TOP = 2, 3
_GREY, _COLOUR = 0, 2
MAX_SIDE: Final = 1 << 16
"""Most pixels of a picture from side to side; more than any camera has."""


def camera_of(schema: Schema) -> Callable[[bytes], tuple[bytes, str]]:
    """A function that gives the picture in a message of ``osi3.SensorView``, and what it is.

    The picture is that of the first camera that has one; empty where there is none that a file can hold.

    Raises
    ------
    TraceError
        The schema's descriptors are malformed.
    """
    message = message_class(schema, _FIELDS)

    def picture(data: bytes) -> tuple[bytes, str]:
        try:
            cameras = getattr(message.FromString(data), "camera_sensor_view", ())
            seen = next((camera for camera in cameras if camera.image_data), None)
            return _picture(seen) if seen is not None else (b"", "")
        except DECODE_ERRORS:
            return b"", ""

    return picture


def _picture(camera: Any) -> tuple[bytes, str]:
    """The picture of a ``CameraSensorView``: the file that it is, or the one that its pixels make."""
    data, told = bytes(camera.image_data), camera.view_configuration
    if data.startswith(_FILES):
        return data, ""
    names = told.DESCRIPTOR.fields_by_name["channel_format"].enum_type.values_by_number
    formats = [names[number].name for number in told.channel_format if number in names]
    width, height = told.number_of_pixels_horizontal, told.number_of_pixels_vertical
    if len(formats) != 1 or formats[0] not in _LAYOUTS:
        return b"", ""
    channels, kind = _LAYOUTS[formats[0]]
    size = width * height * channels * np.dtype(kind).itemsize
    if size != len(data) or not size or max(width, height) > MAX_SIDE:
        return b"", ""
    pixels = np.frombuffer(data, kind).reshape(height, width * channels)
    if told.pixel_order == _RIGHT_TO_LEFT:
        pixels = pixels.reshape(height, width, channels)[:, ::-1].reshape(height, -1)
    elif told.pixel_order == _BOTTOM_TO_TOP:
        pixels = pixels[::-1]
    return png(pixels, channels), "png"


def png(pixels: NDArray[Any], channels: int) -> bytes:
    """A PNG of rows of numbers of 8 or 16 bits; 1 channel: grey, 3: red, green, blue."""
    height, across = pixels.shape
    bits = 8 * pixels.dtype.itemsize
    rows = pixels.astype(f">u{bits // 8}", order="C").view(np.uint8).reshape(height, -1)
    plain = np.hstack([np.zeros((height, 1), np.uint8), rows])  # each row behind its filter: none
    colour = _COLOUR if channels == 3 else _GREY
    head = struct.pack(">IIBBBBB", across // channels, height, bits, colour, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(plain.tobytes(), 1)), (b"IEND", b""))
    chunks = [
        struct.pack(">I", len(content)) + name + content
        + struct.pack(">I", zlib.crc32(name + content))
        for name, content in parts
    ]  # fmt: skip
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
