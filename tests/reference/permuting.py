"""The law of order: a recording and any permutation of its messages have the same rows in all views.

A permutation keeps, within a channel, the order of messages of equal log time. Chunks, compression and files
are free. Digests, ids made of digests and places of messages may differ.
"""

from __future__ import annotations

import random
from contextlib import closing
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from frozen import plain, views_of
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

import sgstore
from sgstore.ingest import ingest
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from mcap.records import Channel, Message, Metadata, Schema

PLACES = {"chunk_offset", "message_offset", "file", "trace_id"}
"""Columns that a permutation may change."""
SEQ = (1 << 24) - 1
"""The part of a frame_id that is no id of its trace."""


@dataclass
class Recorded:
    """What is in an MCAP file; messages in file order."""

    profile: str
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    messages: list[Message]
    metadata: list[Metadata]

    @classmethod
    def of(cls, path: Path) -> Recorded:
        with path.open("rb") as stream:
            reader = make_reader(stream)
            channels: dict[int, Channel] = {}
            schemas: dict[int, Schema] = {}
            messages: list[Message] = []
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                channels[channel.id] = channel
                if schema is not None:
                    schemas[schema.id] = schema
                messages.append(message)
            header = reader.get_header()
            return cls(header.profile, schemas, channels, messages, list(reader.iter_metadata()))

    def permuted(self, draw: random.Random) -> Recorded:
        """The same messages in another order: any, by channel, backwards, or with neighbours swapped."""
        order = list(range(len(self.messages)))
        kind = draw.choice(("any", "channels", "backwards", "neighbours"))
        if kind == "any":
            draw.shuffle(order)
        elif kind == "channels":
            ranks = {channel: draw.random() for channel in self.channels}
            order.sort(key=lambda i: ranks[self.messages[i].channel_id])
        elif kind == "backwards":
            order.reverse()
        else:
            for i in range(0, len(order) - 1, 2):
                order[i : i + 2] = draw.sample(order[i : i + 2], 2)
        return Recorded(self.profile, self.schemas, self.channels, self._kept(order), self.metadata)

    def split(self) -> Recorded:
        """The same messages, every second instant of each channel on another channel of its topic."""
        beyond = max(self.channels) + 1
        more = {
            number + beyond: replace(channel, id=number + beyond)
            for number, channel in self.channels.items()
        }
        times: dict[int, list[int]] = {}
        messages: list[Message] = []
        for one in self.messages:
            told = times.setdefault(one.channel_id, [])
            if one.log_time not in told[-1:]:
                told.append(one.log_time)
            moved = one.channel_id + beyond * (len(told) % 2 == 0)
            messages.append(replace(one, channel_id=moved))
        channels = self.channels | more
        return Recorded(self.profile, self.schemas, channels, messages, self.metadata)

    def _kept(self, order: list[int]) -> list[Message]:
        """Messages in an order, but those of one channel and log time in the order that they have here."""
        groups: dict[tuple[int, int], list[int]] = {}
        for at, number in enumerate(order):
            message = self.messages[number]
            groups.setdefault((message.channel_id, message.log_time), []).append(at)
        found = order.copy()
        for places in groups.values():
            for at, number in zip(places, sorted(order[at] for at in places), strict=True):
                found[at] = number
        return [self.messages[number] for number in found]

    def write(
        self,
        path: Path,
        draw: random.Random,
        *,
        size: int | None = None,
        chunking: bool | None = None,
    ) -> Path:
        """Write them into a file: in chunks of any size and compression, or without chunks."""
        size = size or draw.choice((300, 3000, 100_000, 1 << 20))
        compression = draw.choice([*CompressionType])
        chunking = draw.random() < 0.85 if chunking is None else chunking
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as stream:
            writer = Writer(stream, size, compression, use_chunking=chunking)
            writer.start(self.profile)
            schemas = {0: 0}
            for number, one in sorted(self.schemas.items()):
                schemas[number] = writer.register_schema(one.name, one.encoding, one.data)
            channels = {
                number: writer.register_channel(
                    one.topic, one.message_encoding, schemas[one.schema_id], one.metadata
                )
                for number, one in self._registered(draw)
            }
            for record in self.metadata:
                writer.add_metadata(record.name, record.metadata)
            for one in self.messages:
                writer.add_message(
                    channels[one.channel_id],
                    one.log_time,
                    one.data,
                    one.publish_time,
                    one.sequence,
                )
            writer.finish()
        return path

    def _registered(self, draw: random.Random) -> list[tuple[int, Channel]]:
        """The channels in the order in which they get their ids; those of one topic in the order of theirs."""
        ranks = {
            topic: draw.random() for topic in sorted({c.topic for c in self.channels.values()})
        }
        return sorted(self.channels.items(), key=lambda item: (ranks[item[1].topic], item[0]))

    def bag(self, folder: Path, draw: random.Random) -> Path:
        """Write them into a bag of three files: those of one channel and log time into any of them."""
        parts: list[list[Message]] = [[], [], []]
        chosen: dict[tuple[int, int], int] = {}
        for one in self.messages:
            instant = one.channel_id, one.log_time
            parts[chosen.setdefault(instant, draw.randrange(3))].append(one)
        names = [f"{folder.name}_{i}.mcap" for i in range(3)]
        for name, messages in zip(names, parts, strict=True):
            some = Recorded(self.profile, self.schemas, self.channels, messages, self.metadata)
            some.write(folder / name, draw)
        listed = "\n".join(f"    - {name}" for name in names)
        text = f"rosbag2_bagfile_information:\n  storage_identifier: mcap\n  relative_file_paths:\n{listed}\n"
        (folder / "metadata.yaml").write_text(text)
        return folder


def permutations(path: Path, folder: Path, count: int, seed: int = 0) -> Iterator[Path]:
    """Permutations of a recording, as files of its name."""
    whole = Recorded.of(path)
    for number in range(count):
        draw = random.Random(f"{seed} {number}")
        yield whole.permuted(draw).write(folder / str(number) / path.name, draw)


def view_rows(path: Path, place: Path, **how: Any) -> dict[str, list[tuple[Any, ...]]]:
    """The rows of every public view of a recording, in order."""
    place.parent.mkdir(parents=True, exist_ok=True)
    (outcome,) = ingest(place, [path], **how)
    assert outcome.error is None, outcome.error
    found: dict[str, list[tuple[Any, ...]]] = {}
    with closing(sgstore.open(place)) as store:
        for view, columns in views_of(store).items():
            names = [name for name in columns if name not in PLACES]
            listed = ", ".join(
                f'"{name}" & {SEQ} AS "{name}"' if name == "frame_id" else f'"{name}"'
                for name in names
            )
            arrays = store.file.arrays(f"SELECT {listed} FROM {view} ORDER BY ALL")
            columns_ = [[repr(value) for value in plain(arrays[name]).tolist()] for name in names]
            found[view] = list(zip(*columns_, strict=True))
    return found


def block_rows(path: Path, **how: Any) -> list[tuple[str, Any]]:
    """What a reader makes of a recording, but for places: quicker than views, and no less strict."""
    with open_trace(path, **how) as trace:
        info = trace.info
        found: list[tuple[str, Any]] = [
            (name, getattr(info, name)) for name in ("flavour", "ego", "map_text", "map_name")
        ]
        topics = [c.topic for c in info.channels]
        found.append(("channels", sorted((c.topic, c.schema, c.role) for c in info.channels)))
        found.append(("context", _refs(info.context, topics)))
        for block in trace.blocks():
            for part in (block, block.states, block.entities, block.scenery):
                for field in fields(part):
                    value = getattr(part, field.name)
                    if isinstance(value, np.ndarray):
                        raw = value.tolist() if value.dtype.hasobject else value.tobytes()
                        found.append((field.name, (value.dtype.str, raw)))
                    elif isinstance(value, tuple | str | int):
                        found.append((field.name, value))
            found.append(("messages", _refs(block.messages, topics)))
        losses = sorted((loss.reason, loss.messages) for loss in trace.report.losses)
        found += [("losses", losses), ("frames", trace.report.frames)]
    return found


def _refs(refs: Any, topics: Sequence[str]) -> list[tuple[str, int, int]]:
    """Topic, log time and length of messages."""
    named = [topics[channel] for channel in refs.channel.tolist()]
    return sorted(zip(named, refs.log_time_ns.tolist(), refs.length.tolist(), strict=True))


def first_difference(ours: Any, theirs: Any) -> str:
    """What differs first, in words; empty: nothing."""
    if isinstance(ours, dict):
        ours, theirs = [*ours.items()], [*theirs.items()]
    if len(ours) != len(theirs):
        return f"{len(ours)} and {len(theirs)} parts"
    for (name, one), (_, other) in zip(ours, theirs, strict=True):
        if one != other:
            return f"{name}: {str(one)[:300]} and {str(other)[:300]}"
    return ""
