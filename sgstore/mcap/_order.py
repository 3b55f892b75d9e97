"""Messages in order of time, whatever their order in the file.

Messages are ordered by log time. Within a channel equal log times keep their place. Between channels equal log
times are ordered by publish time, then by the rank of the channel, then by its topic; never by place.

A file whose messages are in this order already is read as it is (:class:`OrderCheck`). Of any other file an
index is sorted (:class:`TimeOrder`), and messages are handed out in batches: each chunk is read once for a
batch, and only the data of the channels that are asked for are copied.

Notes
-----
Publish times may run back within a channel. A message then counts as published with the message before it, so
that the order of all messages is one order.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.mcap._chunks import IDS, MESSAGE_HEAD, Messages

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from sgstore.mcap._findings import Findings

    Ints = NDArray[np.int64]
    Times = NDArray[np.uint64]

BATCH_MESSAGES: Final = 16_384
"""Messages of a batch, at most."""
BATCH_BYTES: Final = 8 << 20
"""Data that are copied for a batch, at most; bytes. A single message may have more."""
CACHED: Final = 24 << 20
"""Data of runs of the file that are kept from one batch to the next; bytes."""
_PARTS: Final = 32
_SAMPLE: Final = 4096
OFTEN: Final = 2
"""A run of the file that is read more often in one reading is reported."""


class OutOfOrder(Exception):  # noqa: N818  (a signal, not an error)
    """A walk in order of time met messages that are not; the next walk sorts them."""


@dataclass(frozen=True, slots=True)
class SortedMessages(Messages):
    """Messages of several chunks, in order of time; ``chunk_offset`` is that of none of them.

    Attributes
    ----------
    places : int64
        Byte offset of the chunk of each, -1 outside chunks.
    held : list
        The data of each that were copied, else ``None``.
    fetch : callable
        ``fetch(place, offset, length)``: the data of a message that were not copied.
    """

    places: Ints
    held: list[bytes | None]
    fetch: Callable[[int, int, int], memoryview]

    @property
    def chunks(self) -> Ints:
        """Byte offset of the chunk of each message, -1 outside chunks."""
        return self.places

    def chunk_of(self, row: int) -> int:
        """Byte offset of the chunk of one message."""
        return int(self.places[row])

    def data(self, row: int) -> memoryview:
        """The data of one message."""
        held = self.held[row]
        if held is not None:
            return memoryview(held)
        return self.fetch(int(self.places[row]), int(self.offset[row]), int(self.length[row]))

    def take(self, rows: NDArray[np.bool_] | slice) -> SortedMessages:
        """Some of the messages."""
        picked = np.arange(len(self))[rows].tolist()
        return SortedMessages(
            self.chunk_offset,
            self.channel[rows],
            self.sequence[rows],
            self.log_time_ns[rows],
            self.publish_time_ns[rows],
            self.offset[rows],
            self.length[rows],
            self.read,
            self.places[rows],
            [self.held[row] for row in picked],
            self.fetch,
        )


@dataclass(slots=True)
class ChannelRanks:
    """The order of channels at one time.

    Attributes
    ----------
    rank : callable
        Rank of a channel by its id: the least comes first. Below 0: what is read does not depend on its place
        among other channels at one time, so that such a file counts as in order.
    schemas, channels : mapping
        Records by their id; both may grow.
    """

    rank: Callable[[int], int]
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]
    _known: int = -1
    _numbers: Ints = field(default_factory=lambda: np.zeros(IDS, np.int64))
    _loose: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(IDS, np.bool_))

    def of(self, channel: NDArray[Any]) -> Ints:
        """Number of each channel in that order."""
        self._learn()
        return self._numbers[channel]

    def is_loose(self, channel: NDArray[Any]) -> NDArray[np.bool_]:
        """Return for each channel whether its place at one time does not matter."""
        self._learn()
        return self._loose[channel]

    def _learn(self) -> None:
        if self._known != len(self.channels):
            self._known = len(self.channels)
            for number, one in enumerate(sorted(self.channels, key=self._key)):
                self._numbers[one] = number
                self._loose[one] = self.rank(one) < 0

    def _key(self, number: int) -> tuple[Any, ...]:
        record = self.channels[number]
        schema = self.schemas.get(record.schema_id)
        name = schema.name if schema else ""
        about = sorted(record.metadata.items())
        return self.rank(number), record.topic, name, record.message_encoding, about, number


def published(log_time: Ints, publish_time: Times, channel: NDArray[Any]) -> Times:
    """Publish times that do not run back among the messages of one channel and one log time."""
    order = np.lexsort((channel, log_time))  # stable: what is equal keeps its place
    log, number, times = log_time[order], channel[order], publish_time[order]
    same = (log[1:] == log[:-1]) & (number[1:] == number[:-1])
    if not (same & (times[1:] < times[:-1])).any():
        return publish_time
    starts = np.flatnonzero(np.concatenate([[True], ~same]))
    raised = [np.maximum.accumulate(part) for part in np.split(times, starts[1:])]
    found = publish_time.copy()
    found[order] = np.concatenate(raised)
    return found


class OrderCheck:
    """Tells whether messages come in order of time.

    Parameters
    ----------
    ranks : ChannelRanks
    """

    def __init__(self, ranks: ChannelRanks) -> None:
        self._ranks = ranks
        # The last message of each channel among those of the latest log time.
        self._log = np.zeros(0, np.int64)
        self._publish = np.zeros(0, np.uint64)
        self._channel = np.zeros(0, np.int64)

    def follows(self, run: Messages) -> bool:
        """Return whether the messages of a run come in order, and behind all before them."""
        log = np.concatenate([self._log, run.log_time_ns])
        steps = np.diff(log)
        if (steps < 0).any():
            return False
        publish = np.concatenate([self._publish, run.publish_time_ns])
        channel = np.concatenate([self._channel, run.channel])
        if not steps.all():
            publish = published(log, publish, channel)
            if not self._is_in_order(log, publish, channel):
                return False
        last = np.flatnonzero(log == log[-1])
        _, at = np.unique(channel[last][::-1], return_index=True)
        keep = np.sort(last[::-1][at])
        self._log, self._publish, self._channel = log[keep], publish[keep], channel[keep]
        return True

    def _is_in_order(self, log: Ints, publish: Times, channel: Ints) -> bool:
        """Return whether messages of one log time, one behind the other, are in order."""
        bound = ~self._ranks.is_loose(channel)
        log, publish, number = log[bound], publish[bound], self._ranks.of(channel[bound])
        before = publish[1:] < publish[:-1]
        before |= (publish[1:] == publish[:-1]) & (number[1:] < number[:-1])
        return not ((log[1:] == log[:-1]) & before).any()


@dataclass(slots=True)
class _FileRun:
    """Messages that stand together in the file.

    ``place``: byte offset of the chunk, -1 outside chunks; ``offsets``: of the records, outside chunks only.
    """

    place: int
    count: int
    size: int
    offsets: Ints | None


class TimeOrder:
    """The messages of a file, sorted.

    Parameters
    ----------
    runs : iterable of Messages
        All messages, in file order.
    ranks : ChannelRanks
    keeps : callable
        Whether the data of the messages of a channel will be asked for.
    again : callable
        ``again(place, offsets)``: reads the messages of a run once more.

    Attributes
    ----------
    findings : Findings
        What reading the file brought to light.
    """

    def __init__(
        self,
        runs: Iterator[Messages],
        ranks: ChannelRanks,
        keeps: Callable[[int], bool],
        again: Callable[[int, Ints | None], Messages],
        findings: Findings,
    ) -> None:
        self.findings = findings
        self._again = again
        self._runs: list[_FileRun] = []
        self._kept = np.zeros(IDS, np.bool_)
        self._cache: OrderedDict[int, Messages] = OrderedDict()
        self._last = np.zeros(IDS, np.int64)
        self._back = 0
        log, publish, channel, size = bytearray(), bytearray(), bytearray(), bytearray()
        for run in runs:  # 22 bytes a message
            log += run.log_time_ns.tobytes()
            publish += run.publish_time_ns.tobytes()
            channel += run.channel.astype(np.uint16).tobytes()
            size += self._take(run, keeps).tobytes()
        self._sizes = np.frombuffer(size, np.uint32)
        times = np.frombuffer(log, np.int64), np.frombuffer(publish, np.uint64)
        self._order = _sorted(*times, np.frombuffer(channel, np.uint16), ranks)
        self._starts = np.cumsum([0, *(run.count for run in self._runs)])
        self._number = {run.place: number for number, run in enumerate(self._runs)}

    def _take(self, run: Messages, keeps: Callable[[int], bool]) -> NDArray[np.uint32]:
        """Take note of a run; how many bytes of each message will be copied."""
        for number in np.unique(run.channel).tolist():
            self._kept[number] = keeps(number)
            times = run.log_time_ns[run.channel == number]
            back = int(-np.diff(times, prepend=self._last[number]).min())
            self._back = max(self._back, back)
            self._last[number] = times[-1]
        outside = run.chunk_offset < 0
        offsets = run.offset.copy() if outside else None
        size = int(run.length.sum())
        self._runs.append(_FileRun(run.chunk_offset, len(run), size, offsets))
        return np.where(self._kept[run.channel], run.length, 0).astype(np.uint32)

    def walk(
        self, report: Findings, wanted: Callable[[int], bool] | None = None
    ) -> Iterator[Messages]:
        """The messages in order of time; what could not be read goes to ``report``."""
        report.warnings += self.findings.warnings
        for loss in self.findings.losses:
            report.lose(loss)
        if self._back > 0:
            report.warnings.append(
                f"log times run back in the file by up to {self._back / 1e9:g} s on one channel:"
                " messages are read in order of log time"
            )
        reads = np.zeros(len(self._runs), np.int64)
        chosen = np.ones(len(self._runs), np.bool_)
        if wanted is not None:
            chosen[:] = [run.place < 0 or wanted(run.place) for run in self._runs]
        start = 0
        while start < len(self._order):
            numbers = self._order[start : start + BATCH_MESSAGES].astype(np.int64)
            sizes = np.cumsum(self._sizes[numbers], dtype=np.int64)
            numbers = numbers[: max(int(np.searchsorted(sizes, BATCH_BYTES)), 1)]
            start += len(numbers)
            of = np.searchsorted(self._starts, numbers, side="right") - 1
            numbers, of = numbers[chosen[of]], of[chosen[of]]
            if len(numbers):
                yield self._batch(numbers, of, reads)
        often = np.flatnonzero(reads > OFTEN)
        if len(often):
            size = sum(self._runs[run].size for run in often.tolist())
            report.warnings.append(
                f"messages are far from their order in time: {size} bytes in {len(often)} parts of the file"
                f" were read more than {OFTEN} times (at most {reads.max()})"
            )
        self._cache.clear()

    def _batch(self, numbers: Ints, of: Ints, reads: Ints) -> SortedMessages:
        """Some messages by their number in the file; ``of``: the run of each."""
        columns = np.zeros((6, len(numbers)), np.int64)
        held: list[bytes | None] = [None] * len(numbers)
        for run in np.unique(of).tolist():
            messages = self._read(run, reads)
            mine = np.flatnonzero(of == run)
            rows = numbers[mine] - self._starts[run]
            columns[0, mine] = messages.channel[rows]
            columns[1, mine] = messages.sequence[rows]
            columns[2, mine] = messages.log_time_ns[rows]
            columns[3, mine] = messages.publish_time_ns[rows].view(np.int64)
            columns[4, mine] = messages.offset[rows]
            columns[5, mine] = messages.length[rows]
            needed = self._kept[messages.channel[rows]]
            for at, row in zip(mine[needed].tolist(), rows[needed].tolist(), strict=True):
                held[at] = bytes(messages.data(row))
        places = np.array([run.place for run in self._runs], np.int64)[of]
        channel, sequence, log_time, publish_time, offset, length = columns
        return SortedMessages(
            -1,
            channel,
            sequence,
            log_time,
            publish_time.view(np.uint64),
            offset,
            length,
            _no_place,
            places,
            held,
            self._fetch,
        )

    def _read(self, number: int, reads: Ints | None = None) -> Messages:
        """The messages of a run."""
        found = self._cache.get(number)
        if found is not None:
            self._cache.move_to_end(number)
            return found
        if reads is not None:
            reads[number] += 1
        run = self._runs[number]
        found = self._again(run.place, run.offsets)
        if len(found) != run.count:
            raise TraceError("the file was changed while it was read", offset=max(run.place, 0))
        self._cache[number] = found
        while len(self._cache) > 1 and self._cached() > CACHED:
            self._cache.popitem(last=False)
        if run.size > CACHED:
            self._cache.clear()
        return found

    def _cached(self) -> int:
        return sum(self._runs[number].size for number in self._cache)

    def _fetch(self, place: int, offset: int, length: int) -> memoryview:
        """The data of a message that were not copied."""
        if place < 0:
            return self._again(-1, np.array([offset], np.int64)).data(0)
        return self._read(self._number[place]).read(offset + MESSAGE_HEAD.itemsize, length)


def _no_place(_position: int, _length: int) -> memoryview:
    """Messages of several chunks have no bytes by their position alone."""
    raise NotImplementedError


def _sorted(
    log: Ints, publish: Times, channel: NDArray[Any], ranks: ChannelRanks
) -> NDArray[np.uint32]:
    """Numbers of messages in order of time, sorted part by part so that little memory is needed."""
    order = np.empty(len(log), np.uint32)
    sample = np.sort(log[:: max(len(log) // _SAMPLE, 1)])
    edges: list[int | None] = [None]
    if len(sample):
        at = np.linspace(0, len(sample), _PARTS + 1).astype(np.int64)[1:-1]
        edges = [*np.unique(sample[at]).tolist(), None]
    start, rest = 0, np.ones(len(log), np.bool_)
    for edge in edges:
        rows = np.flatnonzero(rest if edge is None else rest & (log < edge))
        rest[rows] = False
        times, number = log[rows], channel[rows]
        keys = ranks.of(number), published(times, publish[rows], number), times
        order[start : start + len(rows)] = rows[np.lexsort(keys)]
        start += len(rows)
    return order
