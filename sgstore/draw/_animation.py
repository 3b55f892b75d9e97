"""Writers of animations (GIF, MP4, WebM). Each picture is written immediately, to limit the memory."""

from __future__ import annotations

import gc
from abc import ABC, abstractmethod
from collections import deque
from contextlib import contextmanager, suppress
from fractions import Fraction
from importlib.util import find_spec
from typing import TYPE_CHECKING, ClassVar, Final, Self, cast

import numpy as np
from PIL import Image
from PIL.GifImagePlugin import getdata, getheader

from sgstore.base.output_files import OutputFile
from sgstore.draw._page import greatest_change, quantized
from sgstore.errors import ExportError, MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from av import VideoFrame, VideoStream
    from av.container import OutputContainer

    from sgstore.draw._page import Pixels


LEAST_DELAY: Final = 2
"""Shortest display time of a picture, in hundredths of a second. Many players show shorter ones for a tenth
of a second."""
MOST_DELAY: Final = 65535
CODECS: Final[dict[str, tuple[tuple[str, ...], dict[str, str]]]] = {
    ".mp4": (("libx264", "libopenh264"), {"preset": "veryfast", "crf": "20", "rc-lookahead": "8"}),
    ".webm": (
        ("libvpx-vp9",),
        {"crf": "30", "deadline": "good", "cpu-used": "6", "lag-in-frames": "8"},
    ),
}
"""Kind of video → possible encoders, best first, with their settings."""
FILM_CHANGE: Final = 40
"""Largest change of a colour channel (0 … 255) for which a picture uses the palette of an earlier one."""


class Animation(ABC):
    """Writer of an animation file; a context manager. Its pictures are added one by one.

    Parameters
    ----------
    to : Path
        Receives its name when all is written; an existing file is replaced.
    """

    TICKS: ClassVar[int]
    """Number of time units per second in the file format."""

    def __init__(self, to: Path) -> None:
        self._output = OutputFile(to)
        self._waiting: tuple[Pixels, int] | None = None
        self._shown = self.TICKS  # the last frame is shown as long as the previous one
        self.frames = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_exception: object) -> None:
        try:
            if kind is None and self._waiting is not None:
                pixels, _ = self._waiting
                self._write(pixels, self._shown)
                self._end()
                self._output.keep()
        finally:
            self._drop()
            self._output.discard()

    def add(self, pixels: Pixels, time_s: float) -> None:
        """Add a picture (height, width, 3) to the animation, shown from a time in seconds.

        All pictures have one size, and times ascend.
        """
        start = round(time_s * self.TICKS)
        if self._waiting is not None:
            before, since = self._waiting
            self._shown = max(start - since, self.TICKS * LEAST_DELAY // 100)
            self._write(before, self._shown)
        self._waiting = (pixels, start)

    @abstractmethod
    def _write(self, pixels: Pixels, delay: int) -> None:
        """Write a picture to the animation file, with its display time."""

    @abstractmethod
    def _end(self) -> None:
        """Write the end of the animation file after the last picture."""

    @abstractmethod
    def _drop(self) -> None:
        """Release all resources of the animation writer, but keep the file."""


def animation(to: Path) -> Animation:
    """Return a writer of an animation, in the format of the file ending.

    Raises
    ------
    ExportError
        The ending is unknown, or the file cannot be written.
    MissingExtraError
        The package that writes videos is not installed.
    """
    ending = to.suffix.lower()
    if ending == ".gif":
        return Gif(to)
    if ending in CODECS:
        return Video(to)
    raise ExportError(f"cannot draw a clip into {to.name!r}: end the name in .gif, .mp4 or .webm")


class Gif(Animation):
    """Writer of a GIF animation that repeats endlessly."""

    TICKS = 100

    def __init__(self, to: Path) -> None:
        super().__init__(to)
        self._stream = self._output.stream()
        self._last: Pixels | None = None
        self._palette: Image.Image | None = None

    def _end(self) -> None:
        self._stream.write(b";")  # the trailer of a GIF

    def _drop(self) -> None:
        """Do nothing: the output file closes its stream itself."""

    def _write(self, pixels: Pixels, delay: int) -> None:
        """Write a picture to the GIF file, with its display time in hundredths of a second."""
        if self._last is None:
            height, width, _ = pixels.shape
            # The frames have their own palettes: the palette of the file is not used.
            head, _ = getheader(Image.new("P", (width, height)), info={"loop": 0})
            self._stream.write(b"".join(head))
        box = changed(self._last, pixels)
        pieces = getdata(
            self._indexed(Image.fromarray(pixels), box),
            box[:2],
            duration=min(delay, MOST_DELAY) * 10,
            disposal=1,
            include_color_table=True,
        )
        self._stream.write(b"".join(pieces))
        pieces.clear()  # Pillow keeps them in a reference cycle
        gc.collect(0)
        self._last = pixels
        self.frames += 1

    def _indexed(self, picture: Image.Image, box: tuple[int, int, int, int]) -> Image.Image:
        """Return part of a picture with indexed colours. Use the earlier palette if it fits, else a new one."""
        if self._palette is not None:
            part = picture.crop(box)
            made = part.quantize(palette=self._palette, dither=Image.Dither.NONE)
            if greatest_change(made, part) <= FILM_CHANGE:
                return made
        self._palette = quantized(picture)
        return self._palette.crop(box)


class Video(Animation):
    """Writer of a video file: H.264 in MP4, or VP9 in WebM. A picture is encoded when the next one arrives."""

    TICKS = 1000

    def __init__(self, to: Path) -> None:
        if find_spec("av") is None:
            raise MissingExtraError("videos", "video")
        super().__init__(to)
        self._to = to
        self._opened: tuple[OutputContainer, VideoStream] | None = None
        self._until = 0
        self._delays: deque[int] = deque()

    def _write(self, pixels: Pixels, delay: int) -> None:
        from av import VideoFrame

        # Two neighbouring pixels share a colour sample in both directions: an odd side gets one
        # more pixel.
        height, width, _ = pixels.shape
        even = np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        with self._told():
            self._opened = self._opened or self._begun(*even.shape[:2])
            frame = VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709")
            frame.pts, frame.time_base = self._until, Fraction(1, self.TICKS)
            self._until += delay
            self._delays.append(delay)
            self._mux(*self._opened, frame)
        self.frames += 1

    def _begun(self, height: int, width: int) -> tuple[OutputContainer, VideoStream]:
        """Open the video file, and return its container and its stream."""
        import av

        kind = self._to.suffix.lower()
        codecs, look = CODECS[kind]
        known = [name for name in codecs if name in av.codecs_available]
        if not known:
            raise ExportError(f"{self._to}: the installed av has no encoder {' or '.join(codecs)}")
        options = {"movflags": "+faststart"} if kind == ".mp4" else {}
        path = str(self._output.path())
        container = av.open(path, "w", format=kind[1:], container_options=options)
        stream = cast("VideoStream", container.add_stream(known[0], rate=25, options=look))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.time_base = stream.time_base = Fraction(1, self.TICKS)
        context.bit_rate = 0
        context.max_b_frames = 0  # so that packets have the order of the pictures
        context.colorspace, context.color_range = 1, 1  # BT.709, of 16 to 235
        context.color_primaries, context.color_trc = 1, 1
        return container, stream

    def _mux(
        self, container: OutputContainer, stream: VideoStream, frame: VideoFrame | None
    ) -> None:
        """Encode a picture, and write the finished packets to the video file. ``None`` ends the stream."""
        for packet in stream.encode(frame):
            packet.duration = self._delays.popleft()
            container.mux(packet)

    def _end(self) -> None:
        if self._opened is not None:
            with self._told():
                self._mux(*self._opened, None)
                self._opened[0].close()
            self._opened = None

    def _drop(self) -> None:
        if self._opened is not None:
            with suppress(Exception):
                self._opened[0].close()

    @contextmanager
    def _told(self) -> Generator[None]:
        """Context manager that converts errors of the video encoder to :class:`ExportError`."""
        from av.error import FFmpegError

        try:
            yield
        except (FFmpegError, OSError) as error:
            raise ExportError(f"{self._to}: {error.strerror or error}") from error


def changed(before: Pixels | None, now: Pixels) -> tuple[int, int, int, int]:
    """Return the smallest rectangle that contains all differences of two pictures, at least one pixel."""
    height, width, _ = now.shape
    if before is None:
        return 0, 0, width, height
    other = (before != now).reshape(height, 3 * width)
    lines, columns = np.flatnonzero(other.any(axis=1)), np.flatnonzero(other.any(axis=0)) // 3
    if not len(lines):
        return 0, 0, 1, 1
    return int(columns[0]), int(lines[0]), int(columns[-1]) + 1, int(lines[-1]) + 1
