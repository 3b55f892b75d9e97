"""ROS 2 messages of one type as columns.

The byte positions of all fields follow from the lengths of the texts and sequences in a message. Messages of
equal size and with equal lengths are therefore decoded together, as columns of a matrix of bytes. A type with
a sequence of structures or of texts is decoded message by message.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.lang.topics import field_list
from sgstore.readers._ros2 import (
    HEAD,
    MessageReader,
    Number,
    Sequence,
    Struct,
    Text,
    decode,
    dtype_of,
)
from sgstore.readers._topic_values import (
    MAX_DEPTH,
    MAX_FIELDS,
    MAX_TEXT,
    TopicNames,
    column_of,
    joined_columns,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sgstore.readers._ros2 import Type
    from sgstore.readers._topic_values import Column, Losses

    Part = tuple[NDArray[np.intp], Column]

MAX_LAYOUTS: Final = 256
"""Largest number of layouts for which messages of equal size are decoded in groups."""

_DECLARED: Final = {
    "?": "BOOLEAN",
    "b": "TINYINT",
    "B": "UTINYINT",
    "h": "SMALLINT",
    "H": "USMALLINT",
    "i": "INTEGER",
    "I": "UINTEGER",
    "q": "BIGINT",
    "Q": "UBIGINT",
    "f": "FLOAT",
    "d": "DOUBLE",
}
"""Type code of :mod:`struct` → database type."""


def _declared(kind: Type) -> str:
    """Return the database type for a field type of a ROS message."""
    match kind:
        case Number(code=code):
            return _DECLARED[code]
        case Text():
            return "VARCHAR"
        case Sequence(Number(code="B"), count, _) if count < 0:
            return "BLOB"
        case Sequence(Number(code=code)):
            return f"{_DECLARED[code]}[]"
        case Sequence(Text()):
            return "VARCHAR[]"
        case _:
            return "JSON"


def _leaves(kind: Struct, path: str = "", depth: int = 1) -> Iterator[tuple[str, Type]]:
    """Yield path and type of each field in a structure. A structure that is nested too deeply is one field."""
    for name, inner in kind.fields:
        at = f"{path}.{name}" if path else name
        if isinstance(inner, Struct) and depth < MAX_DEPTH:
            yield from _leaves(inner, at, depth + 1)
        else:
            yield at, inner


class CdrColumns:
    """Decoder of ROS 2 messages of one type into columns.

    Parameters
    ----------
    kind : Struct
    names : TopicNames

    Attributes
    ----------
    fields : dict of str to TopicField
    is_flat : bool
        True if messages of equal lengths are decoded together.

    Raises
    ------
    TraceError
        The type has too many fields.
    """

    def __init__(self, kind: Struct, names: TopicNames) -> None:
        self._kind = kind
        leaves = [*_leaves(kind)]
        if len(leaves) > MAX_FIELDS:
            raise TraceError(f"{kind.name} has {len(leaves)} fields; at most {MAX_FIELDS} are read")
        self._leaves = [(names.of(path), path.split("."), _declared(of)) for path, of in leaves]
        self.fields = field_list((name, declared) for name, _, declared in self._leaves)
        self.is_flat = all(_is_flat(of) for _, of in leaves)
        self._columns = {tuple(path): name for name, path, _ in self._leaves}

    def columns(
        self, data: bytes, lengths: NDArray[np.int64], losses: Losses
    ) -> tuple[dict[str, tuple[str, Column]], NDArray[np.intp]]:
        """Decode messages that follow one another directly in ``data``. Return their columns.

        Returns
        -------
        columns : dict
            Name of the field → database type and values.
        rows : (n,) intp
            Numbers of the messages that can be decoded.
        """
        if not self.is_flat:
            return self._one_by_one(data, lengths, losses)
        parts: dict[str, list[Part]] = {name: [] for name in self.fields}
        ends = np.cumsum(lengths)
        good = np.zeros(len(lengths), np.bool_)
        for size in np.unique(lengths).tolist():
            rows = np.flatnonzero(lengths == size)
            some = data
            if len(rows) < len(lengths):
                some = b"".join(data[end - size : end] for end in ends[rows].tolist())
            for alike, columns in self._alike(some, size, len(rows), losses):
                good[rows[alike]] = True
                for name, values in columns.items():
                    parts[name].append((rows[alike], values))
        kept = np.flatnonzero(good)
        place = np.cumsum(good) - 1
        return {
            name: (
                of.declared,
                joined_columns(
                    of.declared, len(kept), [(place[r], v) for r, v in parts[name]], losses
                ),
            )
            for name, of in self.fields.items()
        }, kept

    def _alike(
        self, data: bytes, size: int, count: int, losses: Losses
    ) -> Iterator[tuple[NDArray[np.intp], dict[str, Column]]]:
        """Group messages of one size by their layout. Yield the row numbers and columns of each group.

        After :data:`MAX_LAYOUTS` groups, the rest is decoded one by one. Otherwise, time would grow with the
        square of the number of layouts.
        """
        left = np.arange(count)
        for _ in range(MAX_LAYOUTS):
            if not len(left):
                return
            first = int(left[0]) * size
            message = memoryview(data)[first : first + size]
            try:
                layout = _MessageLayout.learn(self._kind, message, self._columns)
            except TraceError as error:
                losses.lose(error.reason)
                left = left[1:]
                continue
            agrees = layout.agreeing(data, size, left)
            yield left[agrees], layout.read(data, size, left[agrees], losses)
            left = left[~agrees]
        rest = b"".join(data[row * size : (row + 1) * size] for row in left.tolist())
        found, rows = self._one_by_one(rest, np.full(len(left), size), losses)
        yield left[rows], {name: values for name, (_, values) in found.items()}

    def _one_by_one(
        self, data: bytes, lengths: NDArray[np.int64], losses: Losses
    ) -> tuple[dict[str, tuple[str, Column]], NDArray[np.intp]]:
        values: list[list[Any]] = [[] for _ in self._leaves]
        rows: list[int] = []
        for row, (end, size) in enumerate(
            zip(np.cumsum(lengths).tolist(), lengths.tolist(), strict=True)
        ):
            try:
                record = decode(self._kind, memoryview(data)[end - size : end])
            except TraceError as error:
                losses.lose(error.reason)
                continue
            rows.append(row)
            for held, (_, path, _) in zip(values, self._leaves, strict=True):
                value: Any = record
                for name in path:
                    value = value[name]
                held.append(value)
        found = {
            name: (declared, column_of(declared, held, losses))
            for (name, _, declared), held in zip(self._leaves, values, strict=True)
        }
        return found, np.array(rows, np.intp)


def _is_flat(kind: Type) -> bool:
    """True if at most one length in the message determines the byte positions of a field."""
    return isinstance(kind.element if isinstance(kind, Sequence) else kind, Number) or isinstance(
        kind, Text
    )


@dataclass(slots=True)
class _MessageLayout:
    """Byte positions of all fields, for messages with the same lengths of lists and texts.

    ``head``: first bytes; ``prefixes``: position and value of each length; ``numbers``: column, position,
    number of elements (-1: no list), type; ``texts``: column, position, size.
    """

    head: bytes
    order: str
    prefixes: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    numbers: list[tuple[str, int, int, str]] = field(
        default_factory=list[tuple[str, int, int, str]]
    )
    texts: list[tuple[str, int, int]] = field(default_factory=list[tuple[str, int, int]])

    @classmethod
    def learn(
        cls, kind: Struct, data: memoryview, columns: dict[tuple[str, ...], str]
    ) -> _MessageLayout:
        """Decode a message. Return the positions of its fields."""
        reader = MessageReader.of(data)
        layout = cls(bytes(data[:HEAD]), reader.order)
        layout._step(reader, kind, (), columns)
        return layout

    def _step(
        self,
        reader: MessageReader,
        kind: Type,
        path: tuple[str, ...],
        columns: dict[tuple[str, ...], str],
    ) -> None:
        if isinstance(kind, Struct):
            for name, inner in kind.fields:
                self._step(reader, inner, (*path, name), columns)
            return
        name = columns[path]
        start = reader.place
        if isinstance(kind, Number):
            place = reader.take(kind.size, kind.size)
            self.numbers.append((name, place + HEAD, -1, kind.code))
        elif isinstance(kind, Text):
            reader.text(kind)
            size = self._prefix(reader, start)
            self.texts.append((name, reader.place - size + HEAD, size))
        elif isinstance(kind.element, Number):
            count = reader.count(kind)
            if kind.count < 0:
                self._prefix(reader, start)
            element = kind.element
            place = reader.take(count * element.size, element.size if count else 1)
            self.numbers.append((name, place + HEAD, count, element.code))

    def _prefix(self, reader: MessageReader, start: int) -> int:
        place, size = reader.prefix(start)
        self.prefixes.append((place + HEAD, size))
        return size

    def agreeing(self, data: bytes, size: int, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return a mask of the messages with this layout."""
        count = len(data) // size
        heads = np.ndarray((count,), f"V{HEAD}", data, 0, (size,))[rows]
        found = heads.view(np.uint32) == np.frombuffer(self.head, np.uint32)[0]
        for place, expected in self.prefixes:
            lengths = np.ndarray((count,), f"{self.order}u4", data, place, (size,))[rows]
            found &= lengths == expected
        return found

    def read(
        self, data: bytes, size: int, rows: NDArray[np.intp], losses: Losses
    ) -> dict[str, Column]:
        """Return the columns of messages that have this layout."""
        count = len(data) // size
        whole = len(rows) == count
        found: dict[str, Column] = {}
        for name, place, length, code in self.numbers:
            dtype = dtype_of(self.order, code)
            shape, strides = (
                ((count,), (size,))
                if length < 0
                else (
                    (count, length),
                    (size, dtype.itemsize),
                )
            )
            values: Any = np.ndarray(shape, dtype, data, place, strides)
            values = values if whole else values[rows]
            kind = np.bool_ if code == "?" else dtype.newbyteorder("=")
            found[name] = values.astype(kind)
        for name, place, length in self.texts:
            found[name] = _texts(data, size, place, length, rows, losses)
        return found


def _texts(
    data: bytes, size: int, place: int, length: int, rows: NDArray[np.intp], losses: Losses
) -> Column:
    """Return the texts (of equal length) at one position of messages. Too long ones count as lost."""
    column = np.full(len(rows), "", object)
    if length > MAX_TEXT:
        losses.values += len(rows)
        return np.full(len(rows), None, object)
    if length < 2:
        return column
    held: Any = np.ndarray((len(data) // size, length), np.uint8, data, place, (size, 1))[rows]
    if (held == held[0]).all():
        column[:] = _decoded(held[0].tobytes())
        return column
    cache: dict[bytes, str] = {}
    for row, one in enumerate(held):
        raw = one.tobytes()
        text = cache.get(raw)
        if text is None:
            text = cache[raw] = _decoded(raw)
        column[row] = text
    return column


def _decoded(raw: bytes) -> str:
    return raw.removesuffix(b"\0").decode(errors="replace")
