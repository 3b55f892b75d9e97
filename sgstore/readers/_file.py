"""Base class for files in formats other than MCAP. They can be read like an MCAP file (log of messages)."""

from __future__ import annotations

import zlib
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self

import numpy as np
from mcap.records import Channel, Schema

from sgstore.errors import TraceError
from sgstore.mcap import MESSAGE_HEAD, RUN_MESSAGES, Loss, Messages, open_regular

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from io import BufferedIOBase
    from pathlib import Path

    from mcap.records import Metadata

    from sgstore.mcap import Findings, RecordPlace


RUN_BYTES: Final = 1 << 20
"""Approximate largest size of a group of messages; bytes."""


def first_bytes(
    path: Path,
    endings: tuple[str, ...],
    size: int,
    opened: Callable[[Path], BufferedIOBase] = open_regular,
) -> bytes:
    """Return the first bytes of a file; empty if it is unreadable or has another suffix."""
    if not path.name.lower().endswith(endings):
        return b""
    try:
        with opened(path) as file:
            return file.read(size)
    except (OSError, EOFError, zlib.error, TraceError):
        return b""


class MessageFile:
    """File of another format that can be read like an MCAP file. It has only channels and messages.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    schemas, channels : dict
    has_log_times : bool
        ``False``: the log time of a message is the time in its data.
    window : tuple of int
        The full range of log times.
    noun : str
        Word for the recording in messages.
    profile, compression : str
    metadata, attachments
        Values for an MCAP file with the same contents.
    """

    has_log_times = False
    window = (0, (1 << 63) - 1)
    noun = "file"
    profile, compression = "", "zstd"
    metadata: Final[Mapping[RecordPlace, Metadata]] = MappingProxyType({})
    attachments: tuple[RecordPlace, ...] = ()

    def __init__(self, path: Path) -> None:
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def add_channel(
        self, topic: str, schema: Schema, encoding: str, about: dict[str, str] | None = None
    ) -> None:
        """Add a channel (topic, schema, encoding, metadata) to the file object."""
        self.schemas[schema.id] = schema
        self.channels[schema.id] = Channel(
            id=schema.id,
            topic=topic,
            message_encoding=encoding,
            metadata=about or {},
            schema_id=schema.id,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Do nothing: this object keeps no file open."""

    def walk(
        self,
        report: Findings,
        wanted: Callable[[int], bool] | None = None,
        keep: Callable[[int], bool] | None = None,
        rank: Callable[[int], int] | None = None,
    ) -> Iterator[Messages]:
        """Yield all messages of the file in file order. Unreadable parts are added to a report.

        ``keep`` and ``rank`` have no effect: messages are not cached, and their order is fixed.

        Raises
        ------
        TraceError
            The file is no longer readable.
        """
        del keep, rank
        return self._walk(report, wanted or (lambda _: True))

    def _walk(self, report: Findings, wanted: Callable[[int], bool]) -> Iterator[Messages]:
        raise NotImplementedError

    def settle_order(self, rank: Callable[[int], int]) -> None:
        """Do nothing: messages in such a file have a fixed order."""
        del rank

    def pieces(self, place: RecordPlace) -> Iterator[memoryview]:
        """Return an empty iterator: files in this format have no attachments."""
        del place
        return iter(())


class NumberedFile(MessageFile):
    """File that makes its messages on request. Message 0 is the road map, the others are time steps.

    A subclass calls :meth:`add_channels`, and defines :meth:`message` and :meth:`time_of`.

    Attributes
    ----------
    counts : dict
        Number of messages by channel.
    losses : list of str
        Unreadable parts of the file.
    """

    RUN: ClassVar[int] = 256
    """Largest number of messages in a group."""

    def add_channels(
        self, named: dict[str, str], steps: int, about: dict[str, str], schemas: dict[str, bytes]
    ) -> None:
        """Add the channels of the steps and of the map.

        Parameters
        ----------
        named : dict
            Topic → schema: of the map, if there is one, and of the steps.
        steps : int
            Number of steps.
        about : dict
            Metadata of the channels.
        schemas : dict
            Name of a schema → JSON schema.
        """
        self.counts = dict[int, int]()
        self.losses = list[str]()
        self._has_map = len(named) == 2
        for number, (topic, name) in enumerate(named.items(), start=3 - len(named)):
            schema = Schema(id=number, data=schemas[name], encoding="jsonschema", name=name)
            self.add_channel(topic, schema, "json", about)
            self.counts[number] = steps if number == 2 else 1

    def message(self, number: int) -> bytes:
        """Return the bytes of a message, given its number. An unknown number raises an ``IndexError``."""
        raise NotImplementedError

    def time_of(self, number: int) -> int:
        """Return the time of a time step, given its number (from 1); ns."""
        raise NotImplementedError

    def _walk(self, report: Findings, wanted: Callable[[int], bool]) -> Iterator[Messages]:
        """Yield the map, then the steps. ``offset`` of a message is its number."""
        for reason in self.losses:
            report.lose(Loss(reason, bytes=0))
        if not wanted(-1):
            return
        total = self.counts[2] + 1
        runs = [range(1)] if self._has_map else []
        runs += [range(at, min(at + self.RUN, total)) for at in range(1, total, self.RUN)]
        for numbers in runs:
            held = {number: self.message(number) for number in numbers}
            yield held_messages(
                held,
                [self.time_of(max(number, 1)) if total > 1 else 0 for number in numbers],
                channel=[2 if number else 1 for number in numbers],
                sequence=[max(number - 1, 0) for number in numbers],
            )


def read_numbered(
    opened: Callable[[Path], Any], path: Path, places: Iterable[tuple[int, int, int]]
) -> Iterator[bytes]:
    """Yield the bytes of messages, given by their number and length.

    ``opened``: class of the file, with a method ``message``.

    Raises
    ------
    TraceError
        The file cannot be read, or a message does not match, because the file was replaced.
    """
    with opened(path) as recording:
        for _, offset, length in places:
            try:
                data = recording.message(offset) if offset >= 0 else b""
            except IndexError:
                data = b""
            if len(data) != length or not data:
                reason = f"no message of {length} bytes at {offset} there"
                raise TraceError(f"{reason}: the {recording.noun} was replaced", path=path)
            yield data


def grouped(
    messages: Iterable[tuple[int, int, bytes]],
) -> Iterator[tuple[dict[int, bytes], list[int]]]:
    """Yield messages in groups. A group has a mapping from offset to bytes, and a list of times."""
    held: dict[int, bytes] = {}
    times: list[int] = []
    size = 0
    for offset, time_ns, data in messages:
        held[offset] = data
        times.append(time_ns)
        size += len(data)
        if size > RUN_BYTES or len(held) >= RUN_MESSAGES:
            yield held, times
            held, times, size = {}, [], 0
    if held:
        yield held, times


def numbered_runs(messages: Iterable[tuple[int, int, bytes]], channel: int) -> Iterator[Messages]:
    """Yield messages (offset, time, bytes) of one channel in groups. ``sequence`` numbers them from 0."""
    first = 0
    for held, times in grouped(messages):
        sequence = range(first, first + len(held))
        yield held_messages(held, times, channel=channel, sequence=sequence)
        first += len(held)


def held_messages(
    held: dict[int, bytes],
    times: Sequence[int],
    *,
    channel: int | list[int],
    sequence: int | range | list[int] = 0,
    chunk_offset: int = -1,
) -> Messages:
    """Return messages in memory as one group of columns.

    Parameters
    ----------
    held : dict
        Offset → message, in order.
    times : sequence of int
        Log time of each message; ns.
    channel, sequence : int or one for each message
    chunk_offset : int
        Byte offset of the compressed part with the messages; -1 means none.
    """
    log_time_ns = np.array(times, np.int64)
    return Messages(
        chunk_offset=chunk_offset,
        channel=np.full(len(held), channel, np.int64),
        sequence=np.full(len(held), sequence, np.int64),
        log_time_ns=log_time_ns,
        publish_time_ns=log_time_ns.astype(np.uint64),
        offset=np.array([*held], np.int64),
        length=np.array([len(data) for data in held.values()], np.int64),
        read=lambda at, _length: memoryview(held[at - MESSAGE_HEAD.itemsize]),
    )
