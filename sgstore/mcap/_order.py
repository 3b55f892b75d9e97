"""Reading of messages sorted by log time, whatever their order in the file.

Messages are ordered by log time. Within a channel, messages of equal log time keep their order. Between
channels, equal log times are ordered by publish time, then by the rank of the channel, then by its topic. The
position in the file never decides between channels.

A file with messages in this order is read directly (:class:`OrderCheck`). For any other file, an index is
sorted (:class:`TimeOrder`), and messages are read in batches. A batch reads each of its chunks once, and copies
the data of the channels that a reader needs.

Notes
-----
Publish times may run backwards within a channel. Such a message counts as published with the message before it.
Without this rule, all messages together would have no unique order.

The index needs 21 bytes per message during building and sorting, and 5 bytes afterwards. It consists of blocks,
each sorted by log time. The blocks are merged part by part. A part contains the messages of all blocks up to
some time, and is removed from the blocks after its sorting. If one time has more messages than a part may have,
they are divided by publish time, then by channel.
"""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, NamedTuple

import numpy as np

from sgstore.errors import TraceError
from sgstore.mcap._chunks import IDS, MESSAGE_HEAD, Messages
from sgstore.mcap._findings import Passes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from mcap.records import Channel, Schema
    from numpy.typing import NDArray

    from sgstore.mcap._findings import Findings

    Ints = NDArray[np.int64]
    Numbers = NDArray[np.uint32]
    Times = NDArray[np.uint64]
    Edge = tuple[Any, Literal["left", "right"]] | None

BATCH_MESSAGES: Final = 16_384
"""Maximum number of messages in a batch."""
BATCH_BYTES: Final = 8 << 20
"""Maximum size of the copied data of a batch; bytes. A single message may be larger."""
CACHED: Final = 24 << 20
"""Memory for chunks that are cached between two batches; bytes."""
COLUMN_BYTES: Final = 8 * 6
"""Memory that the columns of one message need, without its data; bytes."""
OFTEN: Final = 2
"""Number of times that a chunk may be read in one pass without a warning."""

MIXED: Final = 20
"""Smallest number of changes between the passes of a file, in order of time, that count as mixed passes."""
LONG: Final = 0.5
"""Smallest share of the longest step back for a new pass. Shorter steps are jitter of the log times."""
MOST_PASSES: Final = 16
"""Largest number of passes of a file. A channel with more steps back is merely unsorted."""

_ENTRY: Final = np.dtype([("log", "i8"), ("publish", "u8"), ("channel", "u2"), ("row", "u2")])
_BLOCK: Final = 1 << 15  # A block has less than twice as many messages, because a row has 16 bits.
_PARTS: Final = 64
_SAMPLE: Final = 4096
_KEYS: Final = ("log", "publish", "channel")
_SIZES: Final = np.floor(2 ** (np.arange(256) / 8)).astype(np.int64)
"""Size code → size; bytes. A code fits into one byte, because sizes are rounded up by at most 9 %."""


class OutOfOrder(Exception):  # noqa: N818  (a signal, not an error)
    """Signal for internal use: the messages are not sorted by time. The next reading must sort them."""


@dataclass(frozen=True, slots=True)
class SortedMessages(Messages):
    """Messages sorted by time. They can come from several chunks of a file.

    Attributes
    ----------
    places : int64
        Byte offset of the chunk of each message, -1 outside chunks. ``chunk_offset`` has no meaning here.
    held : object
        Copied data of each message as bytes; ``None`` means not copied.
    fetch : callable
        ``fetch(place, offset, length)``: returns the data of a message without a copy.
    """

    COLUMNS: ClassVar[tuple[str, ...]] = (*Messages.COLUMNS, "places", "held")

    places: Ints
    held: NDArray[np.object_]
    fetch: Callable[[int, int, int], memoryview]

    @property
    def chunks(self) -> Ints:
        """Byte offset of the chunk of each message; -1 outside chunks."""
        return self.places

    def chunk_of(self, row: int) -> int:
        """Return the byte offset of the chunk of one message; -1 outside chunks."""
        return int(self.places[row])

    def data(self, row: int) -> memoryview:
        """Return the bytes of one message."""
        held: bytes | None = self.held[row]
        if held is not None:
            return memoryview(held)
        return self.fetch(int(self.places[row]), int(self.offset[row]), int(self.length[row]))


@dataclass(slots=True)
class ChannelRanks:
    """Order in which to read channels, for messages with equal times.

    Attributes
    ----------
    rank : callable
        Channel id → rank; the least comes first. A rank below 0 means that a reader does not depend on the
        place of the channel among others of one time. Such a file counts as in order.
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
        """Return the place of each channel in the order of reading, (N,), for messages with equal times."""
        self._learn()
        return self._numbers[channel]

    def is_loose(self, channel: NDArray[Any]) -> NDArray[np.bool_]:
        """Return a mask of the channels that may come in any order among messages with equal times."""
        self._learn()
        return self._loose[channel]

    def _learn(self) -> None:
        if self._known != len(self.channels):
            self._known = len(self.channels)
            for number, channel in enumerate(sorted(self.channels, key=self._key)):
                self._numbers[channel] = number
                self._loose[channel] = self.rank(channel) < 0

    def _key(self, number: int) -> tuple[Any, ...]:
        record = self.channels[number]
        schema = self.schemas.get(record.schema_id)
        name = schema.name if schema else ""
        metadata = sorted(record.metadata.items())
        return self.rank(number), record.topic, name, record.message_encoding, metadata, number


def published(log_time: Ints, publish_time: Times, channel: NDArray[Any]) -> Times:
    """Return publish times that never decrease for messages of one channel with equal log time."""
    order = np.lexsort((channel, log_time))  # stable: equal messages keep their place
    log, number, times = log_time[order], channel[order], publish_time[order]
    same = (log[1:] == log[:-1]) & (number[1:] == number[:-1])
    if not (same & (times[1:] < times[:-1])).any():
        return publish_time
    group = np.concatenate([[0], np.cumsum(~same)])
    step, longest = 1, np.bincount(group).max()
    while step < longest:  # after it, each time is the greatest of 2 * step in its group
        earlier = np.where(group[step:] == group[:-step], times[:-step], 0)
        times[step:] = np.maximum(times[step:], earlier)
        step *= 2
    result = np.empty_like(publish_time)
    result[order] = times
    return result


class _Step(NamedTuple):
    """Step of a channel's log times back to an earlier time.

    ``start_ns``, ``end_ns``: log times after and before it. ``message``, ``number``: number of the message
    after it in the file, from 0, and in its channel, from 1.
    """

    message: int
    channel: int
    number: int
    start_ns: int
    end_ns: int


class OrderCheck:
    """Check that the messages of a file are sorted by time, group by group.

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
        """Return True if a group of messages is sorted and follows all earlier groups. Remember its end."""
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
        """Return True if consecutive messages with equal log time are sorted by publish time and channel."""
        bound = ~self._ranks.is_loose(channel)
        log, publish, number = log[bound], publish[bound], self._ranks.of(channel[bound])
        before = publish[1:] < publish[:-1]
        before |= (publish[1:] == publish[:-1]) & (number[1:] < number[:-1])
        return not ((log[1:] == log[:-1]) & before).any()


# Sorted index.


@dataclass(slots=True)
class _IndexBlock:
    """Part of the sort index of a file: one entry per message, for consecutive messages.

    ``first`` is the number of the first message.
    """

    first: int
    entries: NDArray[np.void]

    def sort(self, key: str) -> None:
        """Sort the index entries by a key, in stable order."""
        self.entries = self.entries[np.argsort(self.entries[key], kind="stable")]

    def split(self, key: str, edge: Edge) -> _IndexBlock:
        """Remove the index entries before a given value of the key, and return them.

        ``None`` means all. The entries must be sorted by the key.
        """
        at = len(self.entries) if edge is None else np.searchsorted(self.entries[key], *edge)
        # A copy, because the block must become smaller.
        part = _IndexBlock(self.first, self.entries[:at].copy())
        if at:
            self.entries = self.entries[at:].copy()
        return part

    def numbers(self) -> Numbers:
        """Return the index of each message in the whole file, from 0."""
        return (self.first + self.entries["row"].astype(np.int64)).astype(np.uint32)


class TimeOrder:
    """Sort index of a file, to read its messages in order of time.

    Parameters
    ----------
    runs : iterable of Messages
        All messages, in file order.
    ranks : ChannelRanks
    keeps : callable
        True for a channel if the data of its messages will be needed.
    again : callable
        ``again(place, count)``: reads a run of ``count`` messages again. ``place``: byte offset of its
        chunk, or of its first record outside chunks.

    Attributes
    ----------
    findings : Findings
        Losses and warnings of reading the file.
    """

    def __init__(
        self,
        runs: Iterable[Messages],
        ranks: ChannelRanks,
        keeps: Callable[[int], bool],
        again: Callable[[int, int], Messages],
        findings: Findings,
    ) -> None:
        self.findings = findings
        self._again = again
        self._kept = np.zeros(IDS, np.bool_)
        self._cache: OrderedDict[int, Messages] = OrderedDict()
        self._last = np.zeros(IDS, np.int64)
        self._back = 0
        # For each channel: its number of messages, and its steps back in log time.
        self._counts = np.zeros(IDS, np.int64)
        self._steps: dict[int, list[_Step]] = {}
        # For each run: its file offset, its first message number, its data size, and a flag for chunks.
        self._places, self._starts = array("q"), array("q", [0])
        self._bytes, self._is_chunk = array("q"), array("b")
        codes = bytearray()
        blocks = [*self._blocks(runs, keeps, codes)]
        self._codes = np.frombuffer(codes, np.uint8)
        for block in blocks:
            block.entries["channel"] = ranks.of(block.entries["channel"])
        most = max(len(codes) // _PARTS, _SAMPLE)
        parts = [*_in_order(blocks, _KEYS, most)] if blocks else []
        self._order = np.concatenate([np.zeros(0, np.uint32), *parts])
        self._passes = self._mixed(ranks)

    def _mixed(self, ranks: ChannelRanks) -> Passes | None:
        """If sorting by time mixes the passes of a file (parts with the same log times), return the passes."""
        steps = [one for of_channel in self._steps.values() for one in of_channel]
        if not steps or max(map(len, self._steps.values())) >= MOST_PASSES:
            return None
        least = max(one.end_ns - one.start_ns for one in steps) * LONG
        steps = sorted(one for one in steps if one.end_ns - one.start_ns >= least)
        first = steps[0]
        begins = np.array([one.message for one in steps if one.channel == first.channel])
        of = np.searchsorted(begins, self._order, side="right")
        if np.count_nonzero(np.diff(of)) < MIXED:
            return None
        ends = min(one.start_ns for one in steps), max(one.end_ns for one in steps)
        return Passes(len(begins) + 1, *ends, ranks.channels[first.channel].topic, first.number)

    def _blocks(
        self, runs: Iterable[Messages], keeps: Callable[[int], bool], codes: bytearray
    ) -> Iterator[_IndexBlock]:
        """Yield the parts of the sort index, each sorted by log time.

        Codes of message sizes are added to ``codes``.
        """
        waiting, first = bytearray(), 0
        for run in runs:
            self._note(run, keeps)
            sizes = np.where(self._kept[run.channel], run.length, 0)
            codes += np.minimum(np.ceil(8 * np.log2(sizes + 1)), 255).astype(np.uint8).tobytes()
            for start in range(0, len(run), _BLOCK):
                waiting += _entries_of(run.span(start, start + _BLOCK))
                if len(waiting) >= _BLOCK * _ENTRY.itemsize:
                    yield (block := _block_of(waiting, first))
                    waiting, first = bytearray(), first + len(block.entries)
        if waiting:
            yield _block_of(waiting, first)

    def _note(self, run: Messages, keeps: Callable[[int], bool]) -> None:
        """Record position and channels of a group of messages, and the largest step back in log time."""
        for number in np.unique(run.channel).tolist():
            self._kept[number] = keeps(number)
            rows = np.flatnonzero(run.channel == number)
            times = run.log_time_ns[rows]
            before = np.append(self._last[number], times[:-1])
            for at in np.flatnonzero(times < before).tolist():
                ends = int(times[at]), int(before[at])
                self._back = max(self._back, ends[1] - ends[0])
                steps = self._steps.setdefault(number, [])
                if len(steps) < MOST_PASSES:
                    message, count = self._starts[-1] + int(rows[at]), int(self._counts[number])
                    steps.append(_Step(message, number, count + at + 1, *ends))
            self._counts[number] += len(rows)
            self._last[number] = times[-1]
        is_chunk = run.chunk_offset >= 0
        self._places.append(run.chunk_offset if is_chunk else int(run.offset[0]))
        self._starts.append(self._starts[-1] + len(run))
        self._bytes.append(int(run.length.sum()))
        self._is_chunk.append(is_chunk)

    def walk(
        self, report: Findings, wanted: Callable[[int], bool] | None = None
    ) -> Iterator[Messages]:
        """Yield the messages of a file in order of time, in groups.

        Losses and warnings are added to ``report``.

        ``wanted``: true for the offset of a chunk to read; other chunks are skipped.
        """
        report.warnings += self.findings.warnings
        for loss in self.findings.losses:
            report.lose(loss)
        report.passes = self._passes
        if self._passes is not None:
            report.warnings.append(self._passes.reason)
        elif self._back > 0:
            report.warnings.append(
                f"log times run back in the file by up to {self._back / 1e9:g} s on one channel:"
                " messages are read in order of log time"
            )
        reads = np.zeros(len(self._places), np.uint32)
        chosen = np.ones(len(self._places), np.bool_)
        if wanted is not None:
            runs = zip(self._places, self._is_chunk, strict=True)
            chosen[:] = [not is_chunk or wanted(place) for place, is_chunk in runs]
        starts = np.frombuffer(self._starts, np.int64)
        start = 0
        while start < len(self._order):
            numbers = self._order[start : start + BATCH_MESSAGES].astype(np.int64)
            sizes = np.cumsum(_SIZES[self._codes[numbers]])
            numbers = numbers[: max(int(np.searchsorted(sizes, BATCH_BYTES)), 1)]
            start += len(numbers)
            of = np.searchsorted(starts, numbers, side="right") - 1
            numbers, of = numbers[chosen[of]], of[chosen[of]]
            if len(numbers):
                yield self._batch(numbers - starts[of], of, reads)
        often = np.flatnonzero(reads > OFTEN)
        if len(often):
            size = sum(self._bytes[run] for run in often.tolist())
            report.warnings.append(
                f"messages are far from their order in time: {size} bytes in {len(often)} parts of the file"
                f" were read more than {OFTEN} times (at most {reads.max()})"
            )
        self._cache.clear()

    def _batch(self, rows: Ints, of: Ints, reads: Numbers) -> SortedMessages:
        """Read some messages of several chunks as one group, in order of time."""
        columns = np.zeros((len(Messages.COLUMNS), len(rows)), np.int64)
        places = np.zeros(len(rows), np.int64)
        held = np.full(len(rows), None, np.object_)
        for run in np.unique(of).tolist():
            messages = self._read(run, reads)
            mine = np.flatnonzero(of == run)
            row = rows[mine]
            columns[:, mine] = messages.take(row).stacked()
            places[mine] = messages.chunk_offset
            needed = self._kept[messages.channel[row]]
            for at, one in zip(mine[needed].tolist(), row[needed].tolist(), strict=True):
                held[at] = bytes(messages.data(one))
        return SortedMessages(
            chunk_offset=-1,
            **Messages.unstacked(columns),
            read=_no_place,
            places=places,
            held=held,
            fetch=self._fetch,
        )

    def _read(self, number: int, reads: Numbers | None = None) -> Messages:
        """Read a group of consecutive messages again from the file."""
        messages = self._cache.get(number)
        if messages is not None:
            self._cache.move_to_end(number)
            return messages
        if reads is not None:
            reads[number] += 1
        place, count = self._places[number], self._count(number)
        messages = self._again(place, count)
        if len(messages) != count:
            raise TraceError("the file was changed while it was read", offset=place)
        self._cache[number] = messages
        while len(self._cache) > 1 and sum(map(self._memory, self._cache)) > CACHED:
            self._cache.popitem(last=False)
        if self._memory(number) > CACHED:
            self._cache.clear()
        return messages

    def _count(self, number: int) -> int:
        return self._starts[number + 1] - self._starts[number]

    def _memory(self, number: int) -> int:
        """Return the memory needed for the messages of a group; bytes."""
        return self._bytes[number] + COLUMN_BYTES * self._count(number)

    def _fetch(self, place: int, offset: int, length: int) -> memoryview:
        """Return the bytes of a message without a copy."""
        number = bisect_right(self._places, offset if place < 0 else place) - 1
        return self._read(number).read(offset + MESSAGE_HEAD.itemsize, length)


def _no_place(_position: int, _length: int) -> memoryview:
    """Raise an error: messages of several chunks cannot be read by one byte position."""
    raise NotImplementedError


def _entries_of(run: Messages) -> bytes:
    """Return the sort index entries of a group of messages."""
    entries = np.zeros(len(run), _ENTRY)
    entries["log"], entries["publish"] = run.log_time_ns, run.publish_time_ns
    entries["channel"] = run.channel
    return entries.tobytes()


def _block_of(entries: bytearray, first: int) -> _IndexBlock:
    block = _IndexBlock(first, np.frombuffer(entries, _ENTRY))
    block.entries["row"] = np.arange(len(block.entries))
    block.sort("log")
    return block


def _in_order(blocks: Sequence[_IndexBlock], keys: Sequence[str], most: int) -> Iterator[Numbers]:
    """Yield the indices of all messages in order of time, part by part. The given index is emptied.

    Parameters
    ----------
    blocks : sequence of _IndexBlock
        In file order, each sorted by the first of the keys.
    keys : sequence of str
        The keys of ``_KEYS`` in which messages may differ.
    most : int
        Maximum number of messages sorted at once.
    """
    key, *others = keys
    for edge in _edges(blocks, key, most):
        part = [one for block in blocks if len((one := block.split(key, edge)).entries)]
        if not part:
            continue
        if sum(len(block.entries) for block in part) <= most:
            yield _sorted(part)
        elif len(np.unique([block.entries[key][[0, -1]] for block in part])) > 1:
            yield from _in_order(part, keys, most)
        elif others:
            if key == "log":
                _raise_publish_times(part)
            for block in part:
                block.sort(others[0])
            yield from _in_order(part, others, most)
        else:  # Messages of one channel and one time keep their order.
            yield from (block.numbers() for block in part)


def _edges(blocks: Sequence[_IndexBlock], key: str, most: int) -> list[Edge]:
    """Return key values, such as times, at which to split an index into parts small enough to sort.

    A value with many messages becomes a separate part. The last part begins at the greatest value.
    """
    count = sum(len(block.entries) for block in blocks)
    step = max(count // _SAMPLE, 1)
    picked = [block.entries[key][at] for block in blocks for at in (slice(None, None, step), [-1])]
    sample = np.sort(np.concatenate(picked))
    at = np.linspace(0, len(sample) - 1, 2 * count // most + 2).astype(np.int64)
    edges: list[Edge] = []
    for value, times in zip(*np.unique(sample[at], return_counts=True), strict=True):
        edges.append((value, "left"))
        if times > 1:
            edges.append((value, "right"))
    return [*edges, None]


def _raise_publish_times(blocks: Sequence[_IndexBlock]) -> None:
    """In a sort index, replace publish times that decrease within a channel by its latest time."""
    latest = np.zeros(IDS, np.uint64)
    for block in blocks:
        channel = block.entries["channel"]
        times = np.maximum(block.entries["publish"], latest[channel])
        block.entries["publish"] = published(block.entries["log"], times, channel)
        np.maximum.at(latest, channel, block.entries["publish"])


def _sorted(blocks: Sequence[_IndexBlock]) -> Numbers:
    """Return the indices of the messages in some parts of a sort index, in order of time."""
    entries = np.concatenate([block.entries for block in blocks])
    log, channel = entries["log"], entries["channel"]
    order = np.lexsort((channel, published(log, entries["publish"], channel), log))
    return np.concatenate([block.numbers() for block in blocks])[order]
