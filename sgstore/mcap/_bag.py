"""Several MCAP files as one: the files that rosbag2 split a recording into."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.errors import TraceError
from sgstore.mcap._chunks import IDS, MAX_LOSSES, RecordPlace
from sgstore.mcap._fetch import METADATA, BagPart, mark_of, part_at, parts_of
from sgstore.mcap._read_ahead import Spool
from sgstore.mcap._reader import McapFile
from sgstore.world import Loss, TraceReport

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from mcap.records import Channel, Schema

    from sgstore.mcap._chunks import Messages


class McapBag(McapFile):
    """The MCAP files of a bag, read one after another; places count from the beginning of the first.

    Parameters
    ----------
    path : Path
        The folder, or the ``metadata.yaml`` in it.

    Attributes
    ----------
    path, size, mtime_ns
        The folder; the size of all files together, and the latest time of change among them.
    others
        As :class:`~sgstore.mcap._reader.McapFile` has them, of all files together. A channel is the same
        in two files if its topic, its encodings and its definition are; ids are those of the first file that
        has it, or new ones where another channel bears these.

    Raises
    ------
    TraceError
        The metadata cannot be read, or no file is there and is an MCAP file.
    """

    def __init__(self, path: Path, spool: Spool | None = None) -> None:
        self._spool, self._own_spool = spool or Spool(), spool is None
        self.path = path.parent if path.name == METADATA else path
        self.size, self.mtime_ns = mark_of(self.path)
        self.schemas = {}
        self.channels = {}
        self.metadata = {}
        self.attachments = []
        self.counts = {}
        self._parts = parts_of(self.path)
        self._files: dict[int, McapFile] = {}
        self._faults: list[Loss] = []
        self._ids: dict[tuple[Any, ...], int] = {}
        self._own: dict[tuple[Path, int], int] = {}
        self._told: dict[Path, tuple[int, int, int]] = {}
        for part in self._parts:
            self._open(part)
        if not self._files:
            raise TraceError(self._faults[0].reason, path=self.path)
        first = next(iter(self._files.values()))
        self.profile, self.library = first.profile, first.library

    def _open(self, part: BagPart) -> None:
        """Learn what a file says of itself; it is open only while it is read."""
        name = part.path.name
        if part.size < 0:
            self._faults.append(Loss(f"{name}: {METADATA} lists it, but there is no such file"))
            return
        try:
            file = McapFile(part.path, self._spool)
        except TraceError as error:
            self._faults.append(Loss(f"{name}: {error.reason}", bytes=part.size, offset=part.base))
            return
        file.close()
        self._files[part.base] = file
        self._learn(file)
        if self.counts is None or file.counts is None:
            self.counts = None
            return
        for number in file.counts.keys() & file.channels.keys():
            own = self._own[file.path, number]
            self.counts[own] = self.counts.get(own, 0) + file.counts[number]

    def close(self) -> None:
        """Close all files."""
        for file in self._files.values():
            file.close()
        if self._own_spool:
            self._spool.close()

    @property
    def compression(self) -> str:
        """That of the first chunk; ``zstd`` before a chunk was met."""
        return next(iter(self._files.values())).compression

    def walk(
        self,
        report: TraceReport,
        wanted: Callable[[int], bool] | None = None,
        keep: Callable[[int], bool] | None = None,
    ) -> Iterator[Messages]:
        """All messages, file by file; what cannot be read goes to ``report``."""
        report.losses += self._faults
        for base, file in self._files.items():
            found = TraceReport()
            here = None if wanted is None else _moved(wanted, base)
            kept = None if keep is None else self._meant(keep, file)
            file.reopen()
            try:
                for run in file.walk(found, here, kept):
                    self._learn(file)
                    yield self._placed(file, run, base)
                self._learn(file)
            finally:
                file.close()
                _take_up(found, report, file.path.name, base)

    def pieces(self, place: RecordPlace) -> Iterator[memoryview]:
        """The bytes of a record, with its head, piece by piece."""
        part = part_at(self._parts, place.offset)
        if part is None or part.base not in self._files:
            raise TraceError("no file of the bag is there", path=self.path, offset=place.offset)
        file = self._files[part.base]
        file.reopen()
        try:
            yield from file.pieces(RecordPlace(place.offset - part.base, place.length))
        finally:
            file.close()

    def _learn(self, file: McapFile) -> None:
        """Take up the channels of a file, and its other records, that were not known yet."""
        told = len(file.channels), len(file.metadata), len(file.attachments)
        if self._told.get(file.path) == told:
            return
        self._told[file.path] = told
        for number, channel in file.channels.items():
            if (file.path, number) not in self._own:
                self._own[file.path, number] = self._take(
                    channel, file.schemas.get(channel.schema_id)
                )
        base = next(base for base, one in self._files.items() if one is file)
        for place, record in file.metadata.items():
            self.metadata.setdefault(RecordPlace(place.offset + base, place.length), record)
        known = set(self.attachments)
        moved = (RecordPlace(place.offset + base, place.length) for place in file.attachments)
        self.attachments += [place for place in moved if place not in known]

    def _take(self, channel: Channel, schema: Schema | None) -> int:
        """The id of a channel in the bag."""
        meant = (schema.name, schema.encoding, schema.data) if schema else ()
        key = (channel.topic, channel.message_encoding, *meant)
        if key not in self._ids:
            number = self._free(channel.id, self.channels)
            schema_id = 0
            if schema is not None:
                schema_id = self._ids.setdefault(meant, self._free(schema.id, self.schemas))
                self.schemas.setdefault(schema_id, replace(schema, id=schema_id))
            self.channels[number] = replace(channel, id=number, schema_id=schema_id)
            self._ids[key] = number
        return self._ids[key]

    def _free(self, number: int, taken: dict[int, Any]) -> int:
        """The id, or the next one that is free."""
        free = number if number not in taken else max(taken) + 1
        if free >= IDS:  # of all files together
            raise TraceError(f"more than {IDS} channels or schemas", path=self.path)
        return free

    def _meant(self, keep: Callable[[int], bool], file: McapFile) -> Callable[[int], bool]:
        """The same question about the ids that a file has."""
        return lambda number: keep(self._own[file.path, number])

    def _placed(self, file: McapFile, run: Messages, base: int) -> Messages:
        """The messages of a file under the ids and the places of the bag."""
        ids, index = np.unique(run.channel, return_inverse=True)
        own = np.array([self._own[file.path, number] for number in ids.tolist()], np.int64)
        if run.chunk_offset >= 0:
            return replace(run, chunk_offset=run.chunk_offset + base, channel=own[index])

        def read(place: int, length: int) -> memoryview:
            return run.read(place - base, length)

        return replace(run, channel=own[index], offset=run.offset + base, read=read)


def _moved(wanted: Callable[[int], bool], base: int) -> Callable[[int], bool]:
    return lambda offset: wanted(offset + base)


def _take_up(found: TraceReport, report: TraceReport, name: str, base: int) -> None:
    """Say in a report of the bag what reading a file brought to light."""
    report.warnings += [f"{name}: {warning}" for warning in found.warnings]
    for loss in found.losses[: max(MAX_LOSSES - len(report.losses), 1)]:
        place = loss.offset + base if loss.offset >= 0 else -1
        report.losses.append(replace(loss, reason=f"{name}: {loss.reason}", offset=place))
