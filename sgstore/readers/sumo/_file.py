"""SUMO floating-car data, read like an MCAP file: one message per time step.

The file is one XML document of any length, plain or gzip-compressed. It is read in pieces and split at the
start and end of each time step. The contents of a step are parsed later. A step above the size limit, or bytes
after damage, are a loss.
"""

from __future__ import annotations

import gzip
import math
import re
import zlib
from typing import TYPE_CHECKING, Final

from mcap.records import Schema

from sgstore.base.markup import MarkupError, MarkupParser
from sgstore.errors import TraceError
from sgstore.mcap import Loss, mark_of_open, open_regular
from sgstore.readers._file import MessageFile, first_bytes, numbered_runs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from io import BufferedIOBase
    from pathlib import Path

    from sgstore.mcap import Findings, Messages

STEP: Final = "sumo.Timestep"
"""Name of the message schema of time steps."""
MAX_STEP: Final = 64 << 20
"""Maximum size of a time step; bytes. A step with 100,000 vehicles has 20 MB."""

ENDINGS: Final = (".xml", ".xml.gz")
"""Suffixes of SUMO files."""

_CHANNEL: Final = 1
_PIECE: Final = 1 << 20
_HEAD: Final = 1 << 16
_BEGIN: Final = re.compile(rb"<timestep\b[^>]{0,1000}?(/?)>")
_TIME: Final = re.compile(rb"""\stime\s*=\s*["']([0-9.:eE+-]{1,40})["']""")
_CLOSE: Final = b"</timestep>"
_GZIP: Final = b"\x1f\x8b"
_DAMAGED: Final = (OSError, EOFError, zlib.error)


def is_fcd(path: Path) -> bool:
    """Return True if a file is SUMO floating-car data, by its suffix and first XML element."""
    return b"<fcd-export" in first_bytes(path, ENDINGS, _HEAD, opened)


def opened(path: Path) -> BufferedIOBase:
    """Open a SUMO file for reading as bytes; gzip is decompressed.

    Raises
    ------
    TraceError
        The file cannot be opened.
    """
    file = open_regular(path)
    packed = file.read(2) == _GZIP
    file.seek(0)
    return _Unpacked(file) if packed else file


def parse(path: Path, start: Callable[[str, dict[str, str], int], None], what: str) -> None:
    """Read the XML elements of a SUMO file. Call ``start`` with tag, attributes and depth of each.

    Raises
    ------
    TraceError
        The file cannot be read, or ``start`` refuses an element. ``what`` names its content.
    """
    parser = MarkupParser(start, most=None, whose="recordings")
    try:
        with opened(path) as file:
            while piece := file.read(_PIECE):
                parser.feed(piece)
        parser.feed(b"", last=True)
    except (MarkupError, *_DAMAGED) as error:
        raise TraceError(f"{what} cannot be read: {error}", path=path) from error


class _Unpacked(gzip.GzipFile):
    """Gzip file. Closing it also closes the compressed file below."""

    def __init__(self, file: BufferedIOBase) -> None:
        super().__init__(fileobj=file, mode="rb")
        self._beneath = file

    def close(self) -> None:
        super().close()
        self._beneath.close()


def time_ns(step: bytes) -> int | None:
    """Return the time of a SUMO time step (in seconds or ``h:m:s``); ns. ``None`` if it is missing."""
    found = _TIME.search(step[:1000])
    seconds = seconds_of(found and found[1].decode())
    return None if math.isnan(seconds) else round(seconds * 1e9)


def seconds_of(text: str | None) -> float:
    """Convert a SUMO time text to seconds; NaN if it is invalid."""
    seconds = 0.0
    try:
        for part in (text or "none").split(":"):
            seconds = seconds * 60 + float(part)
    except ValueError:
        return math.nan
    return seconds if abs(seconds) < 1e9 else math.nan


class SumoFile(MessageFile):
    """SUMO floating-car data that can be read like an MCAP file (log of messages).

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    path, size, mtime_ns
        The file, its size in bytes, its modification time.
    schemas, channels : dict
        One channel, ``/sumo/fcd``, with its schema.
    counts : None
        The number of steps is unknown before the reading.

    Raises
    ------
    TraceError
        The file cannot be opened.
    """

    counts = None

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with open_regular(path) as file:
            self.size, self.mtime_ns = mark_of_open(file)
        self._file = opened(path)
        schema = Schema(id=_CHANNEL, data=b"", encoding="", name=STEP)
        self.add_channel("/sumo/fcd", schema, "xml")

    def close(self) -> None:
        """Close the SUMO file."""
        self._file.close()

    def _walk(self, report: Findings, wanted: Callable[[int], bool]) -> Iterator[Messages]:
        """Yield all time steps of a SUMO file as messages, in order.

        ``offset`` of a message is its position in the file.
        """
        if not wanted(-1):
            return
        yield from numbered_runs(self._timed(report), _CHANNEL)

    def _timed(self, report: Findings) -> Iterator[tuple[int, int, bytes]]:
        """Yield position, time and bytes of each time step. Time steps without a time are lost."""
        for place, data in _steps(self._file, report):
            time = time_ns(data)
            if time is None or time < 0:
                report.lose(Loss("a time step without a time", bytes=len(data)))
            else:
                yield place, time, data


def read_messages(path: Path, places: Iterable[tuple[int, int, int]]) -> Iterator[bytes]:
    """Yield the bytes of time steps in a SUMO file, given by offset and length.

    See :meth:`SumoFile.walk`.

    Raises
    ------
    TraceError
        The file cannot be read, or a step does not match, because the file was replaced.
    """
    with opened(path) as file:
        for _, offset, length in places:
            try:
                file.seek(max(offset, 0))
                data = file.read(length) if 0 < length <= MAX_STEP and offset >= 0 else b""
            except _DAMAGED:
                data = b""
            if len(data) != length or not data.startswith(b"<timestep"):
                reason = f"no time step of {length} bytes at {offset} there: the file was replaced"
                raise TraceError(reason, path=path)
            yield data


def _pieces(file: BufferedIOBase, report: Findings) -> Iterator[bytes]:
    """Yield the bytes of a SUMO file in pieces. After an undamaged file, the last piece is empty."""
    while True:
        try:
            piece = file.read1(_PIECE)
        except _DAMAGED as error:
            report.lose(Loss(f"the compressed file is damaged: {error}", bytes=0))
            return
        yield piece
        if not piece:
            return


def _steps(file: BufferedIOBase, report: Findings) -> Iterator[tuple[int, bytes]]:
    """Yield position and bytes of each SUMO time step, from start tag to end tag."""
    file.seek(0)
    rest, place = b"", 0  # Unused bytes, and their position in the file.
    for piece in _pieces(file, report):
        rest += piece
        used = 0
        while (begin := _BEGIN.search(rest, used)) is not None:
            stop = begin.end()
            if not begin[1]:
                close = rest.find(_CLOSE, stop)
                if close < 0:
                    break
                stop = close + len(_CLOSE)
            yield place + begin.start(), rest[begin.start() : stop]
            used = stop
        if not piece:
            left = rest[used:]
            if b"<timestep" in left:
                report.lose(Loss("the file ends inside a time step", bytes=len(left)))
            elif b"</fcd-export>" not in left:
                report.lose(Loss("the file ends before its last element does", bytes=0))
            return
        if begin is None:
            used = max(used, len(rest) - 1100)  # A tag may be split.
        elif len(rest) - begin.start() > MAX_STEP:
            report.lose(Loss(f"a time step larger than {MAX_STEP:,} bytes", bytes=len(rest)))
            used = len(rest)
        else:
            used = begin.start()
        rest, place = rest[used:], place + used
