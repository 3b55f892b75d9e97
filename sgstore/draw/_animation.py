"""Animations: every picture at its time, written one by one, so that memory does not grow with their length."""

from __future__ import annotations

import gc
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from PIL import Image
from PIL.GifImagePlugin import getdata, getheader

from sgstore.draw._page import (
    COMMONEST,
    FURTHEST,
    MOST_COLOURS,
    PLACES,
    grown,
    packed,
    with_palette,
)
from sgstore.files import OutputFile

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.draw._page import Colours, Pixels


LEAST_DELAY: Final = 2
"""Hundredths of a second that a frame is shown at least: players take less for a tenth of a second."""
MOST_DELAY: Final = 65535
_AREA: Final = 250
"""Pixels of one colour that are an area."""
_CLOSE: Final = 10.0
"""Distance in RGB that a mixture of colours is moved, if there are places enough."""
_MOST_NEW: Final = 16_000
"""Colours of a picture that are looked up in the palette of the one before."""
_KEPT_FREE: Final = 32
"""Places of a palette for colours of later pictures."""


class Gif:
    """Writes an animation that repeats for ever; to be used in a ``with``.

    Parameters
    ----------
    to : Path
        Gets its name when all is written; a file that is there is replaced.
    """

    def __init__(self, to: Path) -> None:
        self._output = OutputFile(to)
        self._stream = self._output.stream()
        self._waiting: tuple[Pixels, int] | None = None
        self._last: Pixels | None = None
        self._palette = LastingPalette()
        self._shown = 100  # the last frame is shown as long as the one before
        self.frames = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_exception: object) -> None:
        try:
            if kind is None and self._waiting is not None:
                pixels, _ = self._waiting
                self._write(pixels, self._shown)
                self._stream.write(b";")  # the trailer of a GIF
                self._output.keep()
        finally:
            self._output.discard()

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
        if self._last is None:
            height, width, _ = pixels.shape
            # The frames bring their palettes: the file's own one has no colour of use.
            head, _ = getheader(Image.new("P", (width, height)), info={"loop": 0})
            self._stream.write(b"".join(head))
        left, top, right, bottom = changed(self._last, pixels)
        pieces = getdata(
            self._palette.indexed(pixels[top:bottom, left:right]),
            (left, top),
            duration=min(delay, MOST_DELAY) * 10,
            disposal=1,
            include_color_table=True,
        )
        self._stream.write(b"".join(pieces))
        pieces.clear()  # they hang in a cycle of Pillow's
        gc.collect(0)
        self._last = pixels
        self.frames += 1


def changed(before: Pixels | None, now: Pixels) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the part of a picture that is other than before; a pixel at least."""
    height, width, _ = now.shape
    if before is None:
        return 0, 0, width, height
    other = (before != now).reshape(height, 3 * width)
    lines, columns = np.flatnonzero(other.any(axis=1)), np.flatnonzero(other.any(axis=0)) // 3
    if not len(lines):
        return 0, 0, 1, 1
    return int(columns[0]), int(lines[0]), int(columns[-1]) + 1, int(lines[-1]) + 1


class LastingPalette:
    """A palette of 256 colours for pictures that follow one another; it grows, and begins anew when it is full.

    Areas keep their colours as far as there are places for them, and no mixture of colours is moved further
    than in :func:`sgstore.draw._page.indexed`.
    """

    def __init__(self) -> None:
        self._colours = np.zeros((0, 3), np.float32)
        self._places = np.full(1 << 24, -1, np.int16)  # of all colours that have been met

    def indexed(self, picture: Pixels) -> Image.Image:
        """An RGB picture, (height, width, 3), with a palette."""
        whole = packed(picture)
        places = self._places[whole]
        unknown = places < 0
        if not self._colours.size or (unknown.any() and not self._grows(whole[unknown])):
            if not self._begins(whole):
                photo = Image.fromarray(np.ascontiguousarray(picture))
                return photo.quantize(PLACES, dither=Image.Dither.NONE)
            unknown[:] = True
        if unknown.any():
            places[unknown] = self._places[whole[unknown]]
        return with_palette(places.astype(np.uint8), self._colours)

    def _begins(self, whole: NDArray[np.int32]) -> bool:
        """Make a palette of a picture; False if it has too many colours."""
        found, many = np.unique(whole, return_counts=True)
        if len(found) > MOST_COLOURS:
            return False
        found = found[np.argsort(-many, kind="stable")]
        colours, most = _unpacked(found), PLACES - _KEPT_FREE
        palette, nearest, furthest = grown(colours[:COMMONEST], colours, most, _CLOSE)
        if furthest > FURTHEST or len(colours) <= PLACES:
            palette, nearest, furthest = grown(colours[:COMMONEST], colours)
        if furthest > FURTHEST:
            return False
        self._colours = palette
        self._places.fill(-1)
        self._places[found] = nearest
        return True

    def _grows(self, unknown: NDArray[np.int32]) -> bool:
        """Give places to pixels of new colours; False if there are not enough."""
        found, many = np.unique(unknown, return_counts=True)
        areas = np.flatnonzero(many > _AREA)
        if len(found) > _MOST_NEW or len(self._colours) + len(areas) > PLACES:
            return False
        colours = _unpacked(found)
        palette = np.concatenate((self._colours, colours[areas]))
        few = len(self._colours) + len(found) <= PLACES - _KEPT_FREE
        palette, nearest, furthest = grown(palette, colours, PLACES, 0.0 if few else FURTHEST)
        if furthest > FURTHEST:
            return False
        self._colours = palette
        self._places[found] = nearest
        return True


def _unpacked(found: NDArray[np.int32]) -> Colours:
    return np.stack([found >> 16, found >> 8 & 255, found & 255], axis=1).astype(np.float32)
