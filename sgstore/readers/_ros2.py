"""Decoder of ROS 2 messages (CDR format) into records or columns, from their text definitions.

A schema with the encoding ``ros2msg`` is the text of the message definition, followed by the texts of all types
in it, each after a line of ``=`` and a line ``MSG: package/Type``. A layout is always built from the text in
the recording: the fields of a type change between versions (``shape_msgs/SolidPrimitive`` gained one in
Humble), and a wrong layout would give wrong numbers without an error.

Texts are untrusted: their size, depth and number of types and fields are limited.

Source: ROS 2 documentation, "Interfaces"; MCAP registry of schema encodings, ``ros2msg``.
"""

from __future__ import annotations

import re
import struct as binary
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import TraceError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from mcap.records import Schema

    from sgstore.mcap import Recording
    from sgstore.model.world import Floats


MAX_TEXT: Final = 1 << 20
"""Maximum size of a schema; bytes. ``sensor_msgs/CameraInfo`` has 8 kB."""
MAX_TYPES: Final = 512
"""Maximum number of types in a schema."""
MAX_DEPTH: Final = 32
"""Maximum nesting depth of types."""
MAX_MEMBERS: Final = 4096
"""Largest number of values in a message, on all levels, without the content of its sequences."""
MAX_ARRAY: Final = 1 << 20
"""Maximum length of a fixed-size array."""

MAX_IDENT: Final = 1 << 53
"""Largest id for which floating-point numbers are exact."""

LENGTH: Final = 4
"""Size of the length field before a string or sequence; bytes."""


@dataclass(frozen=True, slots=True)
class Number:
    """ROS type: number or boolean of ``size`` bytes.

    ``code`` is its type code in :mod:`struct` and numpy.
    """

    code: str
    size: int


@dataclass(frozen=True, slots=True)
class Text:
    """ROS type: string, with an optional maximum number of bytes.

    ``bound`` is the maximum; -1 means unlimited.
    """

    bound: int


@dataclass(frozen=True, slots=True)
class Sequence:
    """ROS type: array of fixed length, or sequence whose length is in the message.

    ``bound``: maximum length in a message; -1 means unlimited.
    """

    element: Type
    count: int
    bound: int


@dataclass(frozen=True, slots=True)
class Struct:
    """ROS type: structure of named fields in message order.

    Attributes
    ----------
    name : str
        ``package/Type``.
    fields : tuple of (str, Type)
        At least one.
    least : int
        Minimum size without padding; bytes.
    members : int
        Number of values on all levels; a sequence counts as one.
    depth : int
        Levels of nested structures, including itself.
    align : int
        Largest alignment of its parts, which determines their positions.
    """

    name: str
    fields: tuple[tuple[str, Type], ...]
    least: int
    members: int
    depth: int
    align: int


Type = Number | Text | Sequence | Struct

NUMBERS: Final[Mapping[str, Number]] = {
    "bool": Number("?", 1),
    "byte": Number("B", 1),
    "char": Number("B", 1),
    "int8": Number("b", 1),
    "uint8": Number("B", 1),
    "int16": Number("h", 2),
    "uint16": Number("H", 2),
    "int32": Number("i", 4),
    "uint32": Number("I", 4),
    "int64": Number("q", 8),
    "uint64": Number("Q", 8),
    "float32": Number("f", 4),
    "float64": Number("d", 8),
}
"""Built-in number types by name. ``char`` is uint8, as documented by ROS."""

_EMPTY: Final = (("structure_needs_at_least_one_member", NUMBERS["uint8"]),)
"""Field name that ROS 2 adds to an empty message, because IDL does not allow empty structures."""
_BUILT_IN: Final = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
}
"""Definitions of common types, which some writers omit."""
_SEPARATOR: Final = re.compile(r"={3,}")
_NAMED: Final = re.compile(r"MSG:\s*([\w/]{1,200})")
_LINE: Final = re.compile(
    r"(?P<type>[A-Za-z][\w/]{0,200})(?:<=(?P<most>\d{1,10}))?"
    r"(?P<array>\[(?:(?P<upto><=)?(?P<count>\d{1,10}))?\])?"
    r"\s+(?P<name>[A-Za-z_]\w{0,200})\s*(?P<rest>.*)"
)


def parse_definition(name: str, text: bytes) -> Struct:
    """Parse the text definition of a ROS message, and return its structure type.

    Parameters
    ----------
    name : str
        The schema's name: ``package/msg/Type`` or ``package/Type``.
    text : bytes
        The schema's data.

    Raises
    ------
    TraceError
        The text is empty, too large or malformed, lacks a type, nests too deeply, or contains an unsupported
        type (``wstring``).
    """
    if not text.strip():
        reason = f"schema {name}: the file does not hold its definition; record it with one"
        raise TraceError(reason)
    if len(text) > MAX_TEXT:
        raise TraceError(f"schema {name}: a text of {len(text)} bytes; at most {MAX_TEXT} are read")
    try:
        texts = _texts(short_name(name), text.decode())
        return _Parser(texts).struct(short_name(name))
    except UnicodeDecodeError as error:
        raise TraceError(f"schema {name}: its definition is not UTF-8 text: {error}") from error
    except TraceError as error:
        raise TraceError(f"schema {name}: {error.reason}") from error


def short_name(name: str) -> str:
    """Return the short form of a ROS type name: ``package/Type`` for ``package/msg/Type``."""
    package, _, rest = name.partition("/")
    return f"{package}/{rest.removeprefix('msg/')}" if rest else name


def ros_schema(recording: Recording, channel: int) -> Schema | None:
    """Return the schema of a ROS 2 channel; ``None`` for channels of other formats."""
    record = recording.channels[channel]
    schema = recording.schemas.get(record.schema_id)
    is_ros = schema and record.message_encoding == "cdr" and schema.encoding == "ros2msg"
    return schema if is_ros else None


def ros_name(recording: Recording, channel: int) -> str:
    """Return the short schema name of a ROS 2 channel; empty for channels of other formats."""
    schema = ros_schema(recording, channel)
    return "" if schema is None else short_name(schema.name)


def _texts(name: str, text: str) -> dict[str, list[str]]:
    """Split a ROS message definition: type name → lines. If a name is defined twice, the first one counts."""
    texts: dict[str, list[str]] = {name: []}
    lines = texts[name]
    separated = False
    for line in text.splitlines():
        stripped = line.strip()
        if _SEPARATOR.fullmatch(stripped):
            separated = True
        elif separated:
            if not stripped:
                continue
            named = _NAMED.fullmatch(stripped)
            if named is None:
                raise TraceError(
                    f"expected 'MSG: package/Type' behind '===', found {stripped[:80]!r}"
                )
            lines, separated = [], False
            texts.setdefault(short_name(named[1]), lines)
        elif stripped and not stripped.startswith("#"):
            lines.append(stripped)
    if len(texts) > MAX_TYPES:
        raise TraceError(f"{len(texts)} types; at most {MAX_TYPES} are read")
    return texts


@dataclass(slots=True)
class _Parser:
    """Parser of ROS type definitions. Each type is parsed once."""

    texts: dict[str, list[str]]
    made: dict[str, Struct] = field(default_factory=dict[str, Struct])
    open: list[str] = field(default_factory=list[str])

    def struct(self, name: str) -> Struct:
        if name in self.made:
            return self.made[name]
        if name in self.open:
            raise TraceError(f"{name} is a part of itself")
        if len(self.open) >= MAX_DEPTH:
            raise TraceError(f"types are nested more than {MAX_DEPTH} deep")
        lines = self.texts.get(name)
        if lines is None and name in _BUILT_IN:
            lines = _BUILT_IN[name].splitlines()
        if lines is None:
            raise TraceError(f"the definition of {name} is missing")
        self.open.append(name)
        fields = tuple(part for line in lines for part in self._fields(name, line)) or _EMPTY
        self.open.pop()
        struct = Struct(
            name,
            fields,
            sum(least(kind) for _, kind in fields),
            sum(members(kind) for _, kind in fields),
            1 + max(_depth(kind) for _, kind in fields),
            max(_alignment(kind) for _, kind in fields),
        )
        if struct.depth > MAX_DEPTH:
            raise TraceError(f"types are nested more than {MAX_DEPTH} deep")
        if struct.members > MAX_MEMBERS:
            raise TraceError(f"{name} has {struct.members} members; at most {MAX_MEMBERS} are read")
        self.made[name] = struct
        return struct

    def _fields(self, owner: str, line: str) -> tuple[tuple[str, Type], ...]:
        """Parse a line of a ROS definition into a field; empty for a constant. Default values are ignored."""
        found = _LINE.fullmatch(line)
        if found is None:
            raise TraceError(f"{owner}: a line that defines no field: {line[:80]!r}")
        if found["rest"].startswith("="):
            return ()
        element = self._element(owner, found["type"], found["most"])
        return ((found["name"], _array(owner, found, element) if found["array"] else element),)

    def _element(self, owner: str, name: str, most: str | None) -> Type:
        if name == "string":
            return Text(int(most) if most else -1)
        if name == "wstring":
            raise TraceError(f"{owner} has a field of type wstring, which is not read")
        if most is not None:
            raise TraceError(f"{owner}: only a string may have a bound, {name} has one")
        if name in NUMBERS:
            return NUMBERS[name]
        package = owner.partition("/")[0]
        return self.struct(short_name(name if "/" in name else f"{package}/{name}"))


def _array(owner: str, found: re.Match[str], element: Type) -> Sequence:
    count = int(found["count"]) if found["count"] else -1
    if found["upto"]:
        return Sequence(element, -1, count)
    if count == 0 or count > MAX_ARRAY:
        raise TraceError(f"{owner}: an array of {count} elements; expected 1 to {MAX_ARRAY}")
    return Sequence(element, count, -1)


def least(kind: Type) -> int:
    """Return the smallest possible size of a value of a ROS type, without padding; bytes."""
    match kind:
        case Number(size=size) | Struct(least=size):
            return size
        case Text():
            return LENGTH
        case Sequence(element, count, _):
            return LENGTH if count < 0 else count * least(element)


def members(kind: Type) -> int:
    """Return how many values a ROS type has, including nested structures. A sequence counts as one value."""
    return kind.members if isinstance(kind, Struct) else 1


def _depth(kind: Type) -> int:
    match kind:
        case Struct(depth=depth):
            return depth
        case Sequence(element=element):
            return _depth(element)
        case _:
            return 0


def _alignment(kind: Type) -> int:
    match kind:
        case Number(size=size):
            return size
        case Text():
            return LENGTH
        case Struct(align=align):
            return align
        case Sequence(element, count, _):
            return max(_alignment(element), LENGTH if count < 0 else 1)


# Decoding of CDR messages by their structure, into a record, or from a long sequence into columns. CDR stores
# values one after another. Each value is aligned to its size, counted from the first byte after a head of four
# bytes. The position of a value therefore depends on all strings and sequences before it. A rare message is
# decoded value by value (:func:`decode`). :class:`ColumnReader` is for long sequences of structures. It learns
# the layout of one element, value by value. An element with the same alignment and the same lengths has the
# same layout. Usually, many such elements are consecutive, so that their numbers are columns of a matrix.
#
# Messages are untrusted: a length is checked against the remaining bytes first, and the size of the result is
# limited. A failure is a :class:`TraceError` for this message.
#
# Source: OMG DDS Interoperability Wire Protocol 2.5, section 10 (plain CDR); rosidl, "legacy interface
# definition".

Data = bytes | bytearray | memoryview

HEAD: Final = 4
"""Size of the header of a message; bytes. It contains the encoding and unused options."""
MAX_VALUES: Final = 1_000_000
"""Largest number of values in a message that are decoded one by one, without numbers in arrays."""
MAX_ROWS: Final = 100_000
"""Maximum number of elements in a sequence decoded as columns."""

_ORDERS: Final = {0: ">", 1: "<"}
"""First two bytes of a message → byte order of its numbers."""
_MAX_LAYOUTS: Final = 16
"""Largest number of cached layouts for each alignment. The oldest one is dropped."""
_MAX_PREFIXES: Final = 64
"""Largest number of length fields in an element whose layout is cached."""


def decode(kind: Struct, data: Data) -> dict[str, Any]:
    """Decode a ROS message into a record of numbers, texts, arrays, lists and nested records.

    Raises
    ------
    TraceError
        The message is truncated, has a wrong length, exceeds a limit of its definition or :data:`MAX_VALUES`,
        or does not use plain CDR.
    """
    return MessageReader.of(data).struct(kind)


def number(record: dict[str, Any], path: str) -> float:
    """Return the number at a field path of a decoded message, such as ``pose.position.x``; NaN if missing."""
    value = _at(record, path)
    return float(value) if isinstance(value, (int, float)) else float("nan")


def text(record: dict[str, Any], path: str) -> str:
    """Return the text at a field path of a decoded message; empty if it is missing."""
    value = _at(record, path)
    return value if isinstance(value, str) else ""


def records(record: dict[str, Any], path: str) -> list[dict[str, Any]]:
    """Return the list of nested records at a field path of a decoded message; empty if it is missing."""
    value = _at(record, path)
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def ident_of(record: dict[str, Any], path: str) -> int | None:
    """Return the id at a field path of a decoded message; ``None`` if it is missing or too large."""
    value = number(record, path)
    return int(value) if abs(value) < MAX_IDENT else None


def _at(record: Any, path: str) -> Any:
    for name in path.split("."):
        if not isinstance(record, dict):
            return None
        record = record.get(name)
    return record


@cache
def _unpacker(code: str) -> Callable[..., tuple[Any, ...]]:
    return binary.Struct(code).unpack_from


@dataclass(slots=True)
class MessageReader:
    """Current read position in the bytes of a ROS message.

    ``values``: bytes after the head; ``order``: byte order of numbers; ``place``: position of the next byte;
    ``left``: number of further values allowed.
    """

    values: memoryview
    order: str
    place: int = 0
    left: int = MAX_VALUES

    @classmethod
    def of(cls, data: Data) -> MessageReader:
        head = bytes(data[:HEAD])
        kind = int.from_bytes(head[:2], "big")
        if len(head) < HEAD:
            raise TraceError(f"a message of {len(head)} bytes is not CDR")
        if kind not in _ORDERS:
            raise TraceError(
                f"a message in encoding 0x{kind:04x}; expected plain CDR, 0x0000 or 0x0001"
            )
        return cls(memoryview(data)[HEAD:], _ORDERS[kind])

    def take(self, size: int, align: int) -> int:
        """Skip padding and the next ``size`` bytes of a message. Return where these bytes start."""
        start = self.place + -self.place % align
        if start + size > len(self.values):
            raise TraceError(
                f"a message of {len(self.values)} bytes ends before its {start + size}th"
            )
        self.place = start + size
        return start

    def number(self, kind: Number) -> Any:
        start = self.take(kind.size, kind.size)
        return _unpacker(self.order + kind.code)(self.values, start)[0]

    def length(self, least_size: int, bound: int, what: str) -> int:
        """Read the length of a sequence or string. Raise an error if the message is too short for it.

        Each element has at least ``least_size`` bytes.
        """
        count = _unpacker(self.order + "I")(self.values, self.take(LENGTH, LENGTH))[0]
        left = len(self.values) - self.place
        if count * least_size > left:
            raise TraceError(f"a {what} claims a length of {count} where {left} bytes are left")
        if 0 <= bound < count:
            raise TraceError(f"a {what} has a length of {count}; its definition allows {bound}")
        return count

    def prefix(self, start: int) -> tuple[int, int]:
        """Return position and value of a length field that has already been read."""
        place = start + -start % LENGTH
        return place, _unpacker(self.order + "I")(self.values, place)[0]

    def text(self, kind: Text) -> str:
        """Read a string from a message. Invalid UTF-8 bytes become U+FFFD."""
        count = self.length(1, kind.bound + 1 if kind.bound >= 0 else -1, "string")
        start = self.take(count, 1)
        return (
            bytes(self.values[start : start + count]).removesuffix(b"\0").decode(errors="replace")
        )

    def value(self, kind: Type) -> Any:
        match kind:
            case Number():
                return self.number(kind)
            case Text():
                return self.text(kind)
            case Struct():
                return self.struct(kind)
            case Sequence():
                return self.sequence(kind)

    def struct(self, kind: Struct) -> dict[str, Any]:
        return {name: self.value(inner) for name, inner in kind.fields}

    def count(self, kind: Sequence) -> int:
        """Read the number of elements of a sequence from a message."""
        smallest = least(kind.element)
        if kind.count < 0:
            return self.length(smallest, kind.bound, "sequence")
        if kind.count * smallest > len(self.values) - self.place:
            raise TraceError(f"a message ends inside an array of {kind.count} elements")
        return kind.count

    def sequence(self, kind: Sequence) -> Any:
        count, element = self.count(kind), kind.element
        if isinstance(element, Number):
            # An empty sequence has no alignment for its first element.
            start = self.take(count * element.size, element.size if count else 1)
            return np.frombuffer(self.values, dtype_of(self.order, element.code), count, start)
        self.spend(count * members(element))
        return [self.value(element) for _ in range(count)]

    def spend(self, values: int) -> None:
        """Count the decoded values of a message. Raise an error if there are too many."""
        self.left -= values
        if self.left < 0:
            raise TraceError(f"a message of more than {MAX_VALUES} values")


def dtype_of(order: str, code: str) -> np.dtype[Any]:
    """Return the numpy type of numbers in a message. Booleans are read as bytes."""
    return np.dtype(order + code.replace("?", "B"))


@dataclass(slots=True)
class _StructLayout:
    """Byte positions of the numbers in one element of a sequence in a ROS message.

    ``size``: bytes from its start to the next element; ``prefixes``: position and value of each length in it;
    ``runs``: first column, position, number and type of adjacent numbers.
    """

    size: int
    prefixes: list[tuple[int, int]]
    runs: list[tuple[int, int, int, np.dtype[Any]]]

    def agreeing(self, values: memoryview, order: str, place: int, most: int) -> int:
        """Return how many of the next sequence elements have their numbers at these positions."""
        for offset, expected in self.prefixes:
            if most < 1:
                break
            lengths = np.ndarray((most,), order + "u4", values, place + offset, (self.size,))
            other = lengths != expected
            if other.any():
                most = int(np.argmax(other))
        return most

    def copy(self, values: memoryview, place: int, to: Floats) -> None:
        """Copy the numbers of the next sequence elements into an array, with one row per element."""
        for column, offset, count, dtype in self.runs:
            numbers: Any = np.ndarray(
                (len(to), count), dtype, values, place + offset, (self.size, dtype.itemsize)
            )
            to[:, column : column + count] = numbers


class ColumnReader:
    """Fast reader of chosen numbers in ROS messages of one type. It returns columns and skips other fields.

    Parameters
    ----------
    kind : Struct
        Type of the messages.
    columns : tuple of str
        Paths of the numbers: ``header.stamp.sec``, ``pose.covariance[0]``.
    sequence : str
        Field with a sequence of structures; each structure is a row with these numbers. Empty: the message is
        the only row.

    Raises
    ------
    TraceError
        The sequence does not exist.
    """

    def __init__(self, kind: Struct, columns: tuple[str, ...], sequence: str = "") -> None:
        self._head: tuple[tuple[str, Type], ...] = ()
        self._sequence: Sequence | None = None
        self._element = kind
        if sequence:
            names = [name for name, _ in kind.fields]
            found = dict(kind.fields).get(sequence)
            if not isinstance(found, Sequence) or not isinstance(found.element, Struct):
                raise TraceError(f"{kind.name} has no sequence of structures {sequence!r}")
            self._head = kind.fields[: names.index(sequence)]
            self._sequence, self._element = found, found.element
        self._columns = {path: column for column, path in enumerate(columns)}
        self._align = self._element.align
        self._layouts: dict[tuple[str, int], list[_StructLayout]] = {}

    def head(self, data: Data) -> dict[str, Any]:
        """Return the fields of a ROS message that come before its sequence of elements.

        Raises
        ------
        TraceError
            As :func:`decode`.
        """
        reader = MessageReader.of(data)
        return {name: reader.value(kind) for name, kind in self._head}

    def read(self, data: Data) -> tuple[dict[str, Any], Floats]:
        """Return the fields before the sequence of a ROS message, and chosen numbers of its elements.

        Returns
        -------
        head : dict
            As returned by :func:`decode`.
        numbers : (n, columns) float64
            NaN for a missing number: the structure lacks the path, or a sequence in it is too short.

        Raises
        ------
        TraceError
            As :func:`decode`; or there are more than :data:`MAX_ROWS` rows.
        """
        reader = MessageReader.of(data)
        head = {name: reader.value(kind) for name, kind in self._head}
        count = 1 if self._sequence is None else reader.count(self._sequence)
        if count > MAX_ROWS:
            raise TraceError(f"a sequence of {count} elements; at most {MAX_ROWS} are read")
        numbers = np.full((count, len(self._columns)), np.nan)
        row = 0
        while row < count:
            row += self._some(reader, numbers[row:])
        return head, numbers

    def _some(self, reader: MessageReader, to: Floats) -> int:
        """Read the next element and those after it that have the same layout. Return how many were read."""
        values, order, place = reader.values, reader.order, reader.place
        layouts = self._layouts.setdefault((order, place % self._align), [])
        for layout in layouts:
            most = min(len(to), (len(values) - place) // layout.size)
            # If the size is not a multiple of the alignment, the next element has another alignment.
            most = min(most, 1) if layout.size % self._align else most
            alike = layout.agreeing(values, order, place, most)
            if alike:
                break
        else:
            layout, alike = _learned(reader, self._element, self._columns), 1
            # Store the layout as the first one to try, unless it contains too many lengths.
            if len(layout.prefixes) <= _MAX_PREFIXES:
                layouts.insert(0, layout)
                del layouts[_MAX_LAYOUTS:]
        layout.copy(values, place, to[:alike])
        reader.place = place + alike * layout.size
        return alike


def _learned(reader: MessageReader, kind: Struct, columns: dict[str, int]) -> _StructLayout:
    """Decode the next element of a sequence. Return the byte positions of its numbers."""
    walk = _ElementWalk(reader, columns, reader.place)
    walk.step(kind, "")
    return _StructLayout(reader.place - walk.start, walk.prefixes, _side_by_side(walk.found))


class _ElementWalk:
    """Decoder of one element of a sequence. It records the byte positions of the numbers."""

    def __init__(self, reader: MessageReader, columns: dict[str, int], start: int) -> None:
        self.start = start
        self.prefixes: list[tuple[int, int]] = []
        self.found: dict[int, tuple[int, np.dtype[Any]]] = {}
        self._reader = reader
        self._columns = columns

    def step(self, kind: Type, path: str) -> None:
        """Decode a value. Record the byte positions of its numbers."""
        reader = self._reader
        match kind:
            case Number(_, size):
                self._note(path, reader.take(size, size), kind)
            case Text():
                start = reader.place
                reader.text(kind)
                self._prefix(start)
            case Struct(fields=fields):
                reader.spend(kind.members)
                for name, inner in fields:
                    self.step(inner, f"{path}.{name}" if path else name)
            case Sequence():
                self._sequence(kind, path)

    def _sequence(self, kind: Sequence, path: str) -> None:
        reader, element = self._reader, kind.element
        start = reader.place
        count = reader.count(kind)
        if kind.count < 0:
            self._prefix(start)
        if not isinstance(element, Number):
            reader.spend(count * members(element))
            for index in range(count):
                self.step(element, f"{path}[{index}]")
        elif count:
            first = reader.take(count * element.size, element.size)
            for index in range(min(count, len(self._columns))):
                self._note(f"{path}[{index}]", first + index * element.size, element)

    def _note(self, path: str, place: int, kind: Number) -> None:
        column = self._columns.get(path)
        if column is not None:
            self.found[column] = place - self.start, dtype_of(self._reader.order, kind.code)

    def _prefix(self, start: int) -> None:
        place, length = self._reader.prefix(start)
        self.prefixes.append((place - self.start, length))


def _side_by_side(
    found: dict[int, tuple[int, np.dtype[Any]]],
) -> list[tuple[int, int, int, np.dtype[Any]]]:
    """Group numbers that are adjacent both in the message and in the output columns."""
    runs: list[tuple[int, int, int, np.dtype[Any]]] = []
    for column, (place, dtype) in sorted(found.items()):
        if runs:
            first, start, count, kind = runs[-1]
            if (column, place, dtype) == (first + count, start + count * dtype.itemsize, kind):
                runs[-1] = (first, start, count + 1, kind)
                continue
        runs.append((column, place, 1, dtype))
    return runs
