"""Pixels → PNG: a few lines, no package, nothing lost.

Source: PNG specification (third edition), chapters 9 to 11.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError

if TYPE_CHECKING:
    from numpy.typing import NDArray

COLOURS: Final = {1: 0, 2: 4, 3: 2, 4: 6}
"""Numbers of a pixel → the colour type: grey, grey and alpha, red green blue, these and alpha."""


def png(pixels: NDArray[Any]) -> bytes:
    """A picture as a PNG file.

    Each row is written as its difference to the one above (filter 2), which costs little and makes most
    pictures a third smaller.

    Parameters
    ----------
    pixels : (height, width) or (height, width, 1 … 4), uint8 or uint16
        Grey; grey and alpha; red, green, blue; these and alpha.

    Raises
    ------
    ExportError
        They are no picture of that kind, or it is empty.
    """
    channels = 1 if pixels.ndim == 2 else pixels.shape[-1]
    if pixels.ndim not in {2, 3} or channels not in COLOURS or not pixels.size:
        raise ExportError(f"no picture: an array of shape {pixels.shape}")
    if pixels.dtype.kind != "u" or pixels.dtype.itemsize > 2:
        raise ExportError(f"no picture: numbers of {pixels.dtype}; expected uint8 or uint16")
    height, width = pixels.shape[:2]
    bytes_of = pixels.dtype.itemsize
    big = np.ascontiguousarray(pixels.astype(f">u{bytes_of}")).view(np.uint8)
    rows = big.reshape(height, -1)
    lines = np.empty((height, rows.shape[1] + 1), np.uint8)
    lines[:, 0] = 2
    lines[0, 1:] = rows[0]
    lines[1:, 1:] = rows[1:] - rows[:-1]
    head = struct.pack(">IIBBBBB", width, height, 8 * bytes_of, COLOURS[channels], 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(lines.tobytes(), 1)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + tag + data + struct.pack(">I", zlib.crc32(tag + data))
        for tag, data in parts
    )
