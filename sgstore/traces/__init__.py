"""Recordings → blocks of frames: one file for each flavour, and the guarded MCAP reader that all of them use.

A flavour is a class like :class:`~sgstore.traces.osi.OsiTrace` that is listed in :data:`READERS`: it
recognises a recording by the schemas of its channels, and reads it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol, Self

from sgstore.errors import TraceError
from sgstore.traces.fetch import digest_of
from sgstore.traces.fetch import read_message as _read_message
from sgstore.traces.mcap_file import McapFile
from sgstore.traces.osi import OsiTrace
from sgstore.world import TraceReport

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.world import FrameBlock, TraceInfo

__all__ = ["READERS", "Trace", "digest_of", "open_trace", "read_message"]


class Trace(Protocol):
    """A recording that is open.

    Attributes
    ----------
    info : TraceInfo
        What is known before frames are read.
    report : TraceReport
        What reading them brought to light; filled while blocks are read.
    """

    info: TraceInfo
    report: TraceReport

    def __enter__(self) -> Self: ...

    def __exit__(self, *_exception: object) -> None: ...

    def close(self) -> None:
        """Close the file."""
        ...

    def blocks(self, size: int = 60) -> Iterator[FrameBlock]:
        """The frames, ``size`` at a time; block i begins at frame ``i * size``."""
        ...


class Reader(Protocol):
    """A flavour of recording: the class of its traces."""

    name: str

    def __call__(self, recording: McapFile, *, ego: str, digest: str) -> Trace:
        """Open a recording of this flavour."""
        ...

    def recognises(self, recording: McapFile) -> bool:
        """Whether a recording is of this flavour, by the schemas of its channels."""
        ...


READERS: Final[tuple[Reader, ...]] = (OsiTrace,)
"""The flavours of recordings, in the order in which they are asked."""


def open_trace(path: str | Path, *, ego: str = "", digest: str = "") -> Trace:
    """A recording, opened by the first reader that recognises it.

    Parameters
    ----------
    path : str or Path
    ego : str
        The simulator's id or name of the ego; empty: as the recording says.
    digest : str
        SHA-256 of the file, if it is known already.

    Raises
    ------
    TraceError
        There is no such file, it is no MCAP file, holds no ground truth that a reader knows, holds no frame,
        or nothing in it bears the name given for the ego.
    """
    path = Path(path)
    recording = McapFile(path)
    try:
        if not recording.channels:
            for _ in recording.walk(TraceReport()):  # no summary: channels come with their messages
                pass
        for reader in READERS:
            if reader.recognises(recording):
                return reader(recording, ego=ego, digest=digest)
        raise TraceError(_no_reader(recording), path=path)
    except TraceError as error:
        recording.close()
        if error.path is None:
            raise TraceError(error.reason, path=path) from error
        raise
    except BaseException:
        recording.close()
        raise


def read_message(path: str | Path, *, chunk_offset: int, offset: int, length: int) -> bytes:
    """The data of one message of a recording, by its place as :class:`~sgstore.world.MessageRefs` has it.

    Raises
    ------
    TraceError
        The file cannot be opened, the chunk is damaged, or there is no message of that length there: the
        file was replaced.
    """
    return _read_message(Path(path), chunk_offset=chunk_offset, offset=offset, length=length)


def _no_reader(recording: McapFile) -> str:
    """Why nothing recognises a recording, and what is in it."""
    listed: list[str] = []
    for _, record in sorted(recording.channels.items()):
        schema = recording.schemas.get(record.schema_id)
        listed.append(f"{record.topic!r} ({schema.name if schema else 'no schema'})")
    more = f" and {len(listed) - 12} more" if len(listed) > 12 else ""
    known = ", ".join(reader.name for reader in READERS)
    if not listed:
        return f"no channel has any message; expected ground truth of a flavour known: {known}"
    return f"no ground truth of a flavour known ({known}); its channels: {', '.join(listed[:12])}{more}"
