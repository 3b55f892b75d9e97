"""Animations, written frame by frame: memory does not grow with their length.

The container is put together here, because the drawing package would first gather all frames. Each frame is
the rectangle in which it differs from the one before, with a palette of its own.

Source: Graphics Interchange Format, version 89a; Netscape's application extension for loops.
"""

from __future__ import annotations

import io
import struct
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from PIL import Image

from sgstore.draw.indexed import indexed
from sgstore.errors import ExportError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Pixels = NDArray[np.uint8]

LEAST_DELAY: Final = 2
"""Hundredths of a second that a frame is shown at least: players take less for a tenth of a second."""
_LOOP: Final = b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"
_EXTENSION, _IMAGE = 0x21, 0x2C


class Gif:
    """Writes an animation that repeats for ever; to be used in a ``with``.

    Parameters
    ----------
    to : Path
        Gets its name when all is written; a file that is there is replaced.
    """

    def __init__(self, to: Path) -> None:
        self._to = to
        self._aside = to.with_name(f"{to.name}.part")
        self._waiting: tuple[Pixels, int] | None = None
        self._last: Pixels | None = None
        self._shown = 100  # the last frame is shown as long as the one before
        self.frames = 0
        try:
            self._stream = self._aside.open("wb")
        except OSError as error:
            raise ExportError(f"cannot write the animation {to}: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_exception: object) -> None:
        try:
            if kind is None and self._waiting is not None:
                pixels, _ = self._waiting
                self._write(pixels, self._shown)
                self._stream.write(b"\x3b")
        finally:
            self._stream.close()
        if kind is None and self.frames:
            self._aside.replace(self._to)
        else:
            self._aside.unlink()

    def add(self, pixels: Pixels, time_s: float) -> None:
        """Show a picture, (height, width, 3), from a time on; s. All are of one size, and times ascend."""
        start = round(time_s * 100)
        if self._waiting is not None:
            before, since = self._waiting
            self._shown = max(start - since, LEAST_DELAY)
            self._write(before, self._shown)
        self._waiting = (pixels, start)

    def _write(self, pixels: Pixels, delay: int) -> None:
        """Write a frame that is shown for so many hundredths of a second."""
        try:
            if self._last is None:
                height, width, _ = pixels.shape
                self._stream.write(
                    b"GIF89a" + struct.pack("<HHBBB", width, height, 0x70, 0, 0) + _LOOP
                )
            left, top, right, bottom = changed(self._last, pixels)
            palette, content = _coded(pixels[top:bottom, left:right])
            size = (len(palette) // 3 - 1).bit_length() - 1  # of 2^(size + 1) colours
            self._stream.write(
                struct.pack("<BBBBHBB", _EXTENSION, 0xF9, 4, 0x04, min(delay, 65535), 0, 0)
            )
            where = (left, top, right - left, bottom - top)
            self._stream.write(struct.pack("<BHHHHB", _IMAGE, *where, 0x80 | size))
            self._stream.write(palette + content)
        except OSError as error:
            raise ExportError(f"cannot write the animation {self._to}: {error.strerror}") from error
        self._last = pixels
        self.frames += 1


def changed(before: Pixels | None, now: Pixels) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the part of a picture that is other than before; a pixel at least."""
    height, width, _ = now.shape
    if before is None:
        return 0, 0, width, height
    other = (before != now).any(axis=2)
    lines, columns = np.flatnonzero(other.any(axis=1)), np.flatnonzero(other.any(axis=0))
    if not len(lines):
        return 0, 0, 1, 1
    return int(columns[0]), int(lines[0]), int(columns[-1]) + 1, int(lines[-1]) + 1


def _coded(pixels: Pixels) -> tuple[bytes, bytes]:
    """Palette and coded pixels of a picture, as a file of its own has them."""
    picture = indexed(Image.fromarray(np.ascontiguousarray(pixels)))
    if picture.mode != "P":
        picture = picture.quantize(256, dither=Image.Dither.NONE)
    written = io.BytesIO()
    picture.save(written, "GIF", optimize=False, interlace=False)
    return _parts(written.getvalue())


def _parts(file: bytes) -> tuple[bytes, bytes]:
    """The palette of a file with one picture, and its coded pixels."""
    packed, at = file[10], 13
    palette = b""
    if packed & 0x80:
        length = 3 << ((packed & 7) + 1)
        palette, at = file[at : at + length], at + length
    while file[at] == _EXTENSION:
        at = _behind_blocks(file, at + 2)
    packed, at = file[at + 9], at + 10
    if packed & 0x80:
        length = 3 << ((packed & 7) + 1)
        palette, at = file[at : at + length], at + length
    return palette, file[at : _behind_blocks(file, at + 1)]


def _behind_blocks(file: bytes, at: int) -> int:
    while file[at]:
        at += file[at] + 1
    return at + 1
