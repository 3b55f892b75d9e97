"""Topics of a recording as columns: protobuf, ROS 2 (CDR) and JSON messages of any channel.

Nested fields have dotted names, enumerations have names as values, lists of numbers and texts are lists, and
other lists are JSON. Messages are decoded in batches of bounded size. Messages are untrusted: a message that
cannot be decoded is a counted loss.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Protocol, cast

import numpy as np

from sgstore.errors import TraceError
from sgstore.lang.catalog import TopicFacts
from sgstore.lang.topics import TopicError, field_list, fields_of, refusal, topic_of
from sgstore.mcap import MESSAGE_HEAD, Messages
from sgstore.readers._ros2 import parse_definition
from sgstore.readers._topic_cdr import CdrColumns
from sgstore.readers._topic_values import (
    MAX_DEPTH,
    MAX_FIELDS,
    Losses,
    TopicNames,
    as_number,
    column_of,
    guessed,
    wider,
)
from sgstore.readers.osi._schema import DECODE_ERRORS, message_class

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from google.protobuf.descriptor import Descriptor, FieldDescriptor
    from mcap.records import Schema
    from numpy.typing import NDArray

    from sgstore.lang.catalog import TopicField
    from sgstore.mcap import Findings, Recording
    from sgstore.readers._topic_values import Column

    Ints = NDArray[np.int64]
    Columns = dict[str, tuple[str, Column]]


BATCH_ROWS: Final = 50_000
"""Maximum number of messages of a batch."""
BATCH_BYTES: Final = 2 << 20
"""Approximate largest size of the messages in a batch; bytes. Decoded nested messages need much more memory."""
FLAT_BYTES: Final = 24 << 20
"""Approximate largest size of a batch whose messages contain only numbers and texts; bytes."""
MAX_MESSAGE: Final = 8 << 20
"""Maximum size of a protobuf or JSON message; bytes."""


class TopicColumns(Protocol):
    """Decoder of the messages of one channel into columns.

    ``fields``: fields by name; those of JSON can grow with each batch.
    """

    @property
    def fields(self) -> Mapping[str, TopicField]: ...

    def columns(
        self, data: bytes, lengths: Ints, losses: Losses
    ) -> tuple[Columns, NDArray[np.intp]]: ...


@dataclass(frozen=True, slots=True)
class TopicBatch:
    """Several messages of one topic, as columns.

    Attributes
    ----------
    topic : str
    number : (n,) int64
        Number of each message in its topic, in file order.
    log_time_ns, publish_time_ns : (n,) int64
    columns : dict
        Name of the field → database type and values.
    """

    topic: str
    number: Ints
    log_time_ns: Ints
    publish_time_ns: Ints
    columns: Columns

    def take(self, rows: NDArray[np.intp]) -> TopicBatch:
        """Return the batch with only the given rows."""
        columns = {name: (kind, values[rows]) for name, (kind, values) in self.columns.items()}
        stamps = self.number[rows], self.log_time_ns[rows], self.publish_time_ns[rows]
        return TopicBatch(self.topic, *stamps, columns)


def decoder_of(message_encoding: str, schema: Schema | None) -> TopicColumns:
    """Return the decoder for a channel.

    Raises
    ------
    TraceError
        Messages of this encoding are not read, or the schema is malformed.
    """
    names = TopicNames()
    encoding = schema.encoding if schema else ""
    if reason := refusal(message_encoding, encoding):
        raise TraceError(reason)
    if message_encoding == "json":
        return JsonColumns(schema, names)
    if schema is not None and message_encoding == "cdr":
        return CdrColumns(parse_definition(schema.name, schema.data), names)
    return ProtobufColumns(message_class(cast("Schema", schema), whole=True), names)


class ProtobufColumns:
    """Decoder of protobuf messages of one type into columns.

    Parameters
    ----------
    message : type
    names : TopicNames

    Raises
    ------
    TraceError
        The type has too many fields.
    """

    def __init__(self, message: type[Any], names: TopicNames) -> None:
        self._message = message
        self._types: list[tuple[str, str]] = []
        self._names = names
        self._root = self._node(message.DESCRIPTOR, "", ())
        self.fields = field_list(self._types)

    def _node(
        self, of: Descriptor, path: str, above: tuple[str, ...]
    ) -> list[tuple[FieldDescriptor, Any]]:
        """Return the fields of a message type. Each has its column number, or its own fields."""
        found: list[tuple[FieldDescriptor, Any]] = []
        above = (*above, of.full_name)
        for one in of.fields:
            at = f"{path}.{one.name}" if path else one.name
            inner = one.message_type
            if (
                inner
                and not _is_repeated(one)
                and inner.full_name not in above
                and len(above) < MAX_DEPTH
            ):
                found.append((one, self._node(inner, at, above)))
                continue
            if len(self._types) >= MAX_FIELDS:
                raise TraceError(f"{of.full_name}: more than {MAX_FIELDS} fields")
            found.append((one, len(self._types)))
            self._types.append((self._names.of(at), _declared(one)))
        return found

    def columns(
        self, data: bytes, lengths: Ints, losses: Losses
    ) -> tuple[Columns, NDArray[np.intp]]:
        values: list[list[Any]] = []
        rows: list[int] = []
        for row, some in enumerate(_messages(data, lengths)):
            try:
                _check_size(some)
                message = self._message.FromString(bytes(some))
                found: list[Any] = [None] * len(self._types)
                _fill(message, self._root, found)
            except DECODE_ERRORS as error:
                losses.lose(error)
                continue
            rows.append(row)
            values.append(found)
        return _as_columns(self._types, values, losses), np.array(rows, np.intp)


def _fill(message: Any, node: list[tuple[FieldDescriptor, Any]], found: list[Any]) -> None:
    for one, inner in node:
        if one.has_presence and not message.HasField(one.name):
            continue
        value = getattr(message, one.name)
        if isinstance(inner, list):
            _fill(value, inner, found)
        else:
            found[inner] = _plain(one, value)


_KINDS: Final = (
    *(
        "",
        "DOUBLE",
        "FLOAT",
        "BIGINT",
        "UBIGINT",
        "INTEGER",
        "UBIGINT",
        "UINTEGER",
        "BOOLEAN",
        "VARCHAR",
    ),
    *("JSON", "JSON", "BLOB", "UINTEGER", "VARCHAR", "INTEGER", "BIGINT", "INTEGER", "BIGINT"),
)
"""Number of a protobuf field type → database type."""


def _declared(one: FieldDescriptor) -> str:
    kind = _KINDS[one.type]
    if not _is_repeated(one):
        return kind
    return "JSON" if kind in {"JSON", "BLOB"} else f"{kind}[]"


def _is_repeated(one: FieldDescriptor) -> bool:
    known = getattr(one, "is_repeated", None)  # protobuf before 6 has only the label
    return cast("Any", one).label == _REPEATED if known is None else known


_REPEATED: Final = 3
"""Number of the label for repeated fields in protobuf."""


def _plain(one: FieldDescriptor, value: Any) -> Any:
    """Return a protobuf value as plain Python values: enumerations as names, messages as dicts."""
    if _is_repeated(one):
        inner = one.message_type
        if inner is not None and inner.GetOptions().map_entry:
            of = inner.fields_by_name["value"]
            return {str(key): _single(of, value[key]) for key in value}
        return [_single(one, item) for item in value]
    return _single(one, value)


def _single(one: FieldDescriptor, value: Any) -> Any:
    if one.enum_type is not None:
        found = one.enum_type.values_by_number.get(value)
        return found.name if found else str(value)
    if one.message_type is not None:
        return {inner.name: _plain(inner, held) for inner, held in value.ListFields()}
    return value


class JsonColumns:
    """Decoder of JSON messages into columns. The fields come from the schema and from the messages.

    Parameters
    ----------
    schema : Schema or None
        A JSON schema, if the channel has one.
    names : TopicNames
    """

    def __init__(self, schema: Schema | None, names: TopicNames) -> None:
        self._names = names
        self._types: dict[str, str] = {}
        if schema is not None and schema.encoding == "jsonschema":
            try:
                self._declare(json.loads(schema.data), "", 1)
            except (ValueError, RecursionError) as error:
                raise TraceError(f"schema {schema.name}: not a JSON schema: {error}") from error

    @property
    def fields(self) -> Mapping[str, TopicField]:
        """Fields known so far, by name."""
        return field_list(
            (self._names.of(path), _stored_type(kind)) for path, kind in self._types.items() if kind
        )

    def _declare(self, schema: Any, path: str, depth: int) -> None:
        """Add the fields of a JSON schema. If a field has several types, the messages determine its type."""
        properties = schema.get("properties") if isinstance(schema, dict) else None
        if depth > MAX_DEPTH or not isinstance(properties, dict):
            return
        for name, inner in properties.items():
            at = f"{path}.{name}" if path else str(name)
            if isinstance(inner, dict) and len(self._types) < MAX_FIELDS:
                if inner.get("type") == "object":
                    self._declare(inner, at, depth + 1)
                elif kind := _of_schema(inner):
                    self._types[at] = kind

    def columns(
        self, data: bytes, lengths: Ints, losses: Losses
    ) -> tuple[Columns, NDArray[np.intp]]:
        flat: list[dict[str, Any]] = []
        rows: list[int] = []
        for row, some in enumerate(_messages(data, lengths)):
            found: dict[str, Any] = {}
            try:
                _check_size(some)
                value = json.loads(bytes(some))
                _flatten(value if isinstance(value, dict) else {"value": value}, "", 1, found)
            except (ValueError, RecursionError, MemoryError) as error:
                losses.lose(error)
                continue
            rows.append(row)
            flat.append(found)
        self._learn(flat, losses)
        return {
            self._names.of(path): (
                _stored_type(kind),
                column_of(_stored_type(kind), self._values(path, kind, flat), losses),
            )
            for path, kind in self._types.items()
            if kind
        }, np.array(rows, np.intp)

    def _learn(self, flat: list[dict[str, Any]], losses: Losses) -> None:
        """Add the fields of some messages. If values do not fit the type of a field, use a wider type."""
        for record in flat:
            for path, value in record.items():
                if value is None:
                    continue
                known, kind = self._types.get(path), guessed(value)
                if known is None and len(self._types) >= MAX_FIELDS:
                    losses.values += 1
                elif known is None:
                    self._types[path] = kind
                elif kind != known:
                    self._types[path] = wider((known, kind))

    @staticmethod
    def _values(path: str, kind: str, flat: list[dict[str, Any]]) -> list[Any]:
        values = [record.get(path) for record in flat]
        if kind == "DOUBLE":
            return [None if value is None else as_number(value) for value in values]
        return values


def _stored_type(kind: str) -> str:
    """Return the type of a column. Lists that have all been empty so far count as lists of numbers."""
    return "DOUBLE[]" if kind == "[]" else kind


def _of_schema(schema: dict[str, Any]) -> str:
    """Return the database type of a JSON schema; empty for an unknown one."""
    plain = {"number": "DOUBLE", "integer": "BIGINT", "string": "VARCHAR", "boolean": "BOOLEAN"}
    kind = schema.get("type")
    if kind == "array":
        items = schema.get("items")
        of = plain.get(str(items.get("type"))) if isinstance(items, dict) else None
        return f"{of}[]" if of else ""
    return plain.get(str(kind), "")


def _flatten(value: dict[str, Any], path: str, depth: int, found: dict[str, Any]) -> None:
    for name, inner in value.items():
        at = f"{path}.{name}" if path else name
        if isinstance(inner, dict) and depth < MAX_DEPTH:
            _flatten(inner, at, depth + 1, found)
        else:
            found[at] = inner


def _as_columns(types: list[tuple[str, str]], rows: list[list[Any]], losses: Losses) -> Columns:
    columns = zip(*rows, strict=True) if rows else [()] * len(types)
    return {
        name: (kind, column_of(kind, values, losses))
        for (name, kind), values in zip(types, columns, strict=True)
    }


def _messages(data: bytes, lengths: Ints) -> Iterator[memoryview]:
    view = memoryview(data)
    end = 0
    for size in lengths.tolist():
        yield view[end : end + size]
        end += size


def _check_size(data: memoryview) -> None:
    if len(data) > MAX_MESSAGE:
        raise ValueError(f"a message of {len(data)} bytes; at most {MAX_MESSAGE} are decoded")


@dataclass(slots=True)
class _Waiting:
    """Messages of a topic that wait for the next batch."""

    data: list[bytes] = field(default_factory=list[bytes])
    stamps: list[Ints] = field(default_factory=list["Ints"])
    rows: int = 0
    size: int = 0
    first: int = 0


class TopicReading:
    """Reader of some topics of an open recording, as columns.

    Several channels of one topic are one topic.

    Parameters
    ----------
    recording : Recording
    topics : collection of str
        Names of topics; a leading ``/`` can be missing.

    Attributes
    ----------
    known : dict of str to TopicFacts
        All topics of the recording.
    channels : dict of int to str
        Channel → topic.
    decoders : dict
        Channel → decoder.
    losses : dict of str to Losses
        Counts of each topic, complete after the reading.

    Raises
    ------
    TopicError
        The recording has no such topic, or its messages cannot be decoded.
    """

    def __init__(self, recording: Recording, topics: Collection[str]) -> None:
        self.recording = recording
        self.known = known = topics_of(recording)
        names = [topic_of(known, name).name for name in topics]
        self.losses = {name: Losses() for name in names}
        for name in names:
            fields_of(known[name])
        self.channels = {
            number: record.topic
            for number, record in recording.channels.items()
            if record.topic in self.losses
        }
        self.decoders = {number: self._decoder(number) for number in self.channels}

    def _decoder(self, channel: int) -> TopicColumns:
        record = self.recording.channels[channel]
        schema = self.recording.schemas.get(record.schema_id)
        try:
            return decoder_of(record.message_encoding, schema)
        except TraceError as error:
            hint = "record it with its definition"
            raise TopicError(f"topic {record.topic!r}: {error.reason}", hint) from error

    def schema(self, topic: str) -> tuple[str, str]:
        """Return the schema name and the message encoding of a topic."""
        record = next(r for r in self.recording.channels.values() if r.topic == topic)
        schema = self.recording.schemas.get(record.schema_id)
        return schema.name if schema else "", record.message_encoding

    def fields(self, topic: str) -> Mapping[str, TopicField] | None:
        """Return the fields of a topic by name; ``None`` if they are unknown before reading (JSON)."""
        found: dict[str, TopicField] = {}
        for number in (number for number, name in self.channels.items() if name == topic):
            if isinstance(self.decoders[number], JsonColumns):
                return None
            found |= self.decoders[number].fields
        return found

    def batches(self, report: Findings) -> Iterator[TopicBatch]:
        """Yield the messages in batches, in file order. Each topic has at least one batch.

        ``report`` receives unreadable parts of the file.
        """
        waiting = {channel: _Waiting() for channel in self.channels}
        most = {
            channel: FLAT_BYTES if getattr(decoder, "is_flat", False) else BATCH_BYTES
            for channel, decoder in self.decoders.items()
        }
        for run in self.recording.walk(report):
            for channel in np.unique(run.channel).tolist():
                if (held := waiting.get(channel)) is None:
                    continue
                rows = np.flatnonzero(run.channel == channel)
                for some in _pieces(rows, run.length[rows], most[channel]):
                    _hold(held, run, some)
                    if held.rows >= BATCH_ROWS or held.size >= most[channel]:
                        yield self._batch(channel, held)
        for channel, held in waiting.items():
            if held.rows or not held.first:
                yield self._batch(channel, held)

    def _batch(self, channel: int, held: _Waiting) -> TopicBatch:
        topic = self.channels[channel]
        stamps = np.concatenate([np.zeros((3, 0), np.int64), *held.stamps], axis=1)
        columns, rows = self.decoders[channel].columns(
            b"".join(held.data), stamps[2], self.losses[topic]
        )
        batch = TopicBatch(topic, held.first + rows, stamps[0][rows], stamps[1][rows], columns)
        held.first += stamps.shape[1]
        held.data, held.stamps, held.rows, held.size = [], [], 0, 0
        return batch


def topics_of(recording: Recording) -> dict[str, TopicFacts]:
    """Return the topics of a recording by name, without their fields."""
    found: dict[str, TopicFacts] = {}
    for record in recording.channels.values():
        schema = recording.schemas.get(record.schema_id)
        reason = refusal(record.message_encoding, schema.encoding if schema else "")
        if reason or record.topic not in found:
            found[record.topic] = TopicFacts(
                record.topic, frozenset(), stored=False, refused=reason, source=dict
            )
    return found


def _pieces(rows: NDArray[np.intp], lengths: Ints, most: int) -> Iterator[NDArray[np.intp]]:
    """Split row numbers into pieces, each with a limited number of bytes."""
    cuts = np.flatnonzero(np.diff(np.cumsum(lengths) // most)) + 1
    yield from np.split(rows, cuts)


def _hold(held: _Waiting, run: Messages, rows: NDArray[np.intp]) -> None:
    held.data.append(_joined(run, rows))
    publish = np.minimum(run.publish_time_ns[rows], np.uint64((1 << 63) - 1)).astype(np.int64)
    held.stamps.append(np.stack([run.log_time_ns[rows], publish, run.length[rows]]))
    held.rows += len(rows)
    held.size += len(held.data[-1])


def _joined(run: Messages, rows: NDArray[np.intp]) -> bytes:
    """Return the data of the given messages, joined into one bytes object."""
    if type(run) is not Messages:
        return b"".join(map(run.data, rows.tolist()))
    starts = run.offset[rows] + MESSAGE_HEAD.itemsize
    return b"".join(map(run.read, starts.tolist(), run.length[rows].tolist()))
