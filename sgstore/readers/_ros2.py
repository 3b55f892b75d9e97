"""ROS 2 messages: definitions, and CDR decoding into columns.

Definitions of ROS 2 messages: the ``.msg`` texts that a recording carries → the structure of its messages.

A schema of encoding ``ros2msg`` is the text of a message's own definition, and behind it, each after a line of
``=`` and a line ``MSG: package/Type``, the texts of all types that it is made of. A layout is always made
from the recording's own text: the same type has other fields in another year (``shape_msgs/SolidPrimitive``
gained one in Humble), and messages that are read by the wrong layout give numbers all the same.

Texts come from strangers: their size, the number of their types and fields, and their depth are bounded.

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

    from sgstore.world import Floats


MAX_TEXT: Final = 1 << 20
"""Greatest size of a schema; bytes. That of ``sensor_msgs/CameraInfo`` takes 8 kB."""
MAX_TYPES: Final = 512
"""Most types in a schema."""
MAX_DEPTH: Final = 32
"""How deep types may be nested."""
MAX_MEMBERS: Final = 4096
"""Most values of a message without its sequences, all levels taken together."""
MAX_ARRAY: Final = 1 << 20
"""Most elements of an array of fixed length."""

MAX_IDENT: Final = 1 << 53
"""Ids are below it, as far as a double is exact."""

LENGTH: Final = 4
"""Bytes of a length in front of a string or a sequence."""


@dataclass(frozen=True, slots=True)
class Number:
    """A number or truth value of ``size`` bytes; ``code`` as :mod:`struct` and numpy have it."""

    code: str
    size: int


@dataclass(frozen=True, slots=True)
class Text:
    """A string; ``bound``: most bytes, -1: any."""

    bound: int


@dataclass(frozen=True, slots=True)
class Sequence:
    """Elements of one type: ``count`` of them, or as many as the message says if that is -1.

    ``bound``: most that a message may say, -1: any.
    """

    element: Type
    count: int
    bound: int


@dataclass(frozen=True, slots=True)
class Struct:
    """Fields in the order in which they stand in a message.

    Attributes
    ----------
    name : str
        ``package/Type``.
    fields : tuple of (str, Type)
        At least one.
    least : int
        Fewest bytes that it can take, padding left out.
    members : int
        Values in it, all levels taken together; a sequence counts as one.
    depth : int
        Levels of structures in it, its own among them.
    align : int
        What the places of its parts depend on: the largest alignment in it.
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
"""Built-in types; of ``char`` the documentation says uint8."""

_EMPTY: Final = (("structure_needs_at_least_one_member", NUMBERS["uint8"]),)
"""What ROS 2 puts into a message without fields, because IDL has no empty structures."""
_BUILT_IN: Final = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
}
"""Definitions that some writers leave out."""
_SEPARATOR: Final = re.compile(r"={3,}")
_NAMED: Final = re.compile(r"MSG:\s*([\w/]{1,200})")
_LINE: Final = re.compile(
    r"(?P<type>[A-Za-z][\w/]{0,200})(?:<=(?P<most>\d{1,10}))?"
    r"(?P<array>\[(?:(?P<upto><=)?(?P<count>\d{1,10}))?\])?"
    r"\s+(?P<name>[A-Za-z_]\w{0,200})\s*(?P<rest>.*)"
)


def parse_definition(name: str, text: bytes) -> Struct:
    """The structure of the messages of a schema.

    Parameters
    ----------
    name : str
        The schema's name: ``package/msg/Type`` or ``package/Type``.
    text : bytes
        The schema's data.

    Raises
    ------
    TraceError
        The text is empty, too large, malformed, lacks a type, nests without end, or has a type that is not
        read (``wstring``).
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
        raise TraceError(f"schema {name}: its definition is no UTF-8 text: {error}") from error
    except TraceError as error:
        raise TraceError(f"schema {name}: {error.reason}") from error


def short_name(name: str) -> str:
    """``package/Type`` of ``package/msg/Type``."""
    package, _, rest = name.partition("/")
    return f"{package}/{rest.removeprefix('msg/')}" if rest else name


def _texts(name: str, text: str) -> dict[str, list[str]]:
    """Name of each type → the lines of its definition; the first definition of a name counts."""
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
    """Makes structures of texts, each once; ``open``: the types that are being made."""

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
        """The field that a line defines: none if it is a constant. Defaults are of no concern here."""
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
    """Fewest bytes that a value of a type can take, padding left out."""
    match kind:
        case Number(size=size) | Struct(least=size):
            return size
        case Text():
            return LENGTH
        case Sequence(element, count, _):
            return LENGTH if count < 0 else count * least(element)


def members(kind: Type) -> int:
    """Values of a type, all levels taken together; a sequence counts as one."""
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


# Messages in CDR, read by their structure: one as a record, or a sequence of many as columns ----
# CDR writes values one after another, each aligned to its own size, counted from the first byte behind a head
# of four. So where a value stands depends on every string and sequence before it. A message that comes now
# and then is read value by value (:func:`decode`). For long sequences of structures there is
# :class:`ColumnReader`: the layout of one element is learned, value by value; an element that begins at the
# same alignment and in which every length says the same has the same layout, and there are mostly many of
# these in a row, so that their numbers are columns of a matrix.
#
# Messages come from strangers: a length is held against the bytes that are left before anything is made of
# it, and what a message may become is bounded. What fails is a :class:`TraceError` for this message.
#
# Source: OMG DDS Interoperability Wire Protocol 2.5, section 10 (plain CDR); rosidl, "legacy interface
# definition".

Data = bytes | bytearray | memoryview

HEAD: Final = 4
"""Bytes before the values: how these are encoded, and options that plain CDR has none of."""
MAX_VALUES: Final = 1_000_000
"""Most values of a message that is read one by one, without numbers in arrays."""
MAX_ROWS: Final = 100_000
"""Most elements of a sequence that is read as columns."""

_ORDERS: Final = {0: ">", 1: "<"}
"""First two bytes of a message → order of the bytes of its numbers."""
_MAX_LAYOUTS: Final = 16
"""Layouts that are remembered for each alignment; the oldest is forgotten."""
_MAX_PREFIXES: Final = 64
"""Lengths in an element whose layout is worth remembering."""


def decode(kind: Struct, data: Data) -> dict[str, Any]:
    """A message as a record: numbers, texts, arrays of numbers, lists and records in it.

    Raises
    ------
    TraceError
        The message is cut, lies about a length, exceeds a bound of its definition or :data:`MAX_VALUES`,
        or is in another encoding than plain CDR.
    """
    return _MessageReader.of(data).struct(kind)


def number(record: dict[str, Any], path: str) -> float:
    """The number at a path (``pose.position.x``) of a record; NaN if there is none."""
    value = _at(record, path)
    return float(value) if isinstance(value, (int, float)) else float("nan")


def text(record: dict[str, Any], path: str) -> str:
    """The text at a path of a record; empty if there is none."""
    value = _at(record, path)
    return value if isinstance(value, str) else ""


def records(record: dict[str, Any], path: str) -> list[dict[str, Any]]:
    """The records in the list at a path of a record; none if there is no such list."""
    value = _at(record, path)
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def ident_of(record: dict[str, Any], path: str) -> int | None:
    """The id at a path of a record; ``None`` if there is none."""
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
class _MessageReader:
    """A message and how far it has been read.

    ``values``: what follows the head; ``order``: of the bytes of numbers; ``place``: the next byte;
    ``left``: how many more values may be made of it.
    """

    values: memoryview
    order: str
    place: int = 0
    left: int = MAX_VALUES

    @classmethod
    def of(cls, data: Data) -> _MessageReader:
        head = bytes(data[:HEAD])
        kind = int.from_bytes(head[:2], "big")
        if len(head) < HEAD:
            raise TraceError(f"a message of {len(head)} bytes, which is no CDR")
        if kind not in _ORDERS:
            raise TraceError(
                f"a message in encoding 0x{kind:04x}; expected plain CDR, 0x0000 or 0x0001"
            )
        return cls(memoryview(data)[HEAD:], _ORDERS[kind])

    def take(self, size: int, align: int) -> int:
        """The place of the next ``size`` bytes, which begin at a multiple of ``align``."""
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
        """The length of what follows, of at least ``least_size`` bytes each."""
        count = _unpacker(self.order + "I")(self.values, self.take(LENGTH, LENGTH))[0]
        left = len(self.values) - self.place
        if count * least_size > left:
            raise TraceError(f"a {what} claims a length of {count} where {left} bytes are left")
        if 0 <= bound < count:
            raise TraceError(f"a {what} has a length of {count}; its definition allows {bound}")
        return count

    def text(self, kind: Text) -> str:
        """A string; bytes that are no UTF-8 become U+FFFD."""
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
        """Number of the elements that follow."""
        smallest = least(kind.element)
        if kind.count < 0:
            return self.length(smallest, kind.bound, "sequence")
        if kind.count * smallest > len(self.values) - self.place:
            raise TraceError(f"a message ends inside an array of {kind.count} elements")
        return kind.count

    def sequence(self, kind: Sequence) -> Any:
        count, element = self.count(kind), kind.element
        if isinstance(element, Number):
            # An empty sequence has no first element that would be aligned.
            start = self.take(count * element.size, element.size if count else 1)
            return np.frombuffer(self.values, _dtype(self.order, element), count, start)
        self.spend(count * members(element))
        return [self.value(element) for _ in range(count)]

    def spend(self, values: int) -> None:
        """Keep account of the values that are made of a message."""
        self.left -= values
        if self.left < 0:
            raise TraceError(f"a message of more than {MAX_VALUES} values")


def _dtype(order: str, kind: Number) -> np.dtype[Any]:
    return np.dtype(order + kind.code.replace("?", "B"))


@dataclass(slots=True)
class _StructLayout:
    """Places of the numbers in an element that begins at a given alignment.

    ``size``: bytes from its begin to that of the next; ``prefixes``: place and value of each length in it;
    ``runs``: first column, place, number and type of numbers that stand side by side.
    """

    size: int
    prefixes: list[tuple[int, int]]
    runs: list[tuple[int, int, int, np.dtype[Any]]]

    def agreeing(self, values: memoryview, order: str, place: int, most: int) -> int:
        """Number of the elements from a place on that have this layout, one after another."""
        for offset, expected in self.prefixes:
            if most < 1:
                break
            lengths = np.ndarray((most,), order + "u4", values, place + offset, (self.size,))
            other = lengths != expected
            if other.any():
                most = int(np.argmax(other))
        return most

    def copy(self, values: memoryview, place: int, to: Floats) -> None:
        """Copy the numbers of as many elements as there are rows in ``to``."""
        for column, offset, count, dtype in self.runs:
            numbers: Any = np.ndarray(
                (len(to), count), dtype, values, place + offset, (self.size, dtype.itemsize)
            )
            to[:, column : column + count] = numbers


class ColumnReader:
    """Reads numbers of messages of one kind as columns, and passes over the rest of them.

    Parameters
    ----------
    kind : Struct
        Of the messages.
    columns : tuple of str
        Paths of the numbers: ``header.stamp.sec``, ``pose.covariance[0]``.
    sequence : str
        The field that is a sequence of structures, each of which is a row with these numbers; empty: the
        message is the only row.

    Raises
    ------
    TraceError
        There is no such sequence.
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
        """The fields before the sequence.

        Raises
        ------
        TraceError
            As :func:`decode`.
        """
        reader = _MessageReader.of(data)
        return {name: reader.value(kind) for name, kind in self._head}

    def read(self, data: Data) -> tuple[dict[str, Any], Floats]:
        """The fields before the sequence, and the numbers.

        Returns
        -------
        head : dict
            As :func:`decode` gives them.
        numbers : (n, columns) float64
            NaN where a row lacks a number: its structure has none of that path, or a sequence in it is
            too short.

        Raises
        ------
        TraceError
            As :func:`decode`; or there are more than :data:`MAX_ROWS` rows.
        """
        reader = _MessageReader.of(data)
        head = {name: reader.value(kind) for name, kind in self._head}
        count = 1 if self._sequence is None else reader.count(self._sequence)
        if count > MAX_ROWS:
            raise TraceError(f"a sequence of {count} elements; at most {MAX_ROWS} are read")
        numbers = np.full((count, len(self._columns)), np.nan)
        row = 0
        while row < count:
            row += self._some(reader, numbers[row:])
        return head, numbers

    def _some(self, reader: _MessageReader, to: Floats) -> int:
        """Read the next element, and those behind it that are alike; how many these are."""
        values, order, place = reader.values, reader.order, reader.place
        layouts = self._layouts.setdefault((order, place % self._align), [])
        for layout in layouts:
            most = min(len(to), (len(values) - place) // layout.size)
            # Of a size that is no multiple of the alignment, the next element is aligned differently.
            most = min(most, 1) if layout.size % self._align else most
            alike = layout.agreeing(values, order, place, most)
            if alike:
                break
        else:
            layout, alike = _learned(reader, self._element, self._columns), 1
            # Keep a layout, as the first that is tried, unless too much would have to agree.
            if len(layout.prefixes) <= _MAX_PREFIXES:
                layouts.insert(0, layout)
                del layouts[_MAX_LAYOUTS:]
        layout.copy(values, place, to[:alike])
        reader.place = place + alike * layout.size
        return alike


def _learned(reader: _MessageReader, kind: Struct, columns: dict[str, int]) -> _StructLayout:
    """The layout of the value that a reader stands before; it stands behind it then."""
    walk = _ElementWalk(reader, columns, reader.place)
    walk.step(kind, "")
    return _StructLayout(reader.place - walk.start, walk.prefixes, _side_by_side(walk.found))


class _ElementWalk:
    """A walk through one element, which takes note of where things stand."""

    def __init__(self, reader: _MessageReader, columns: dict[str, int], start: int) -> None:
        self.start = start
        self.prefixes: list[tuple[int, int]] = []
        self.found: dict[int, tuple[int, np.dtype[Any]]] = {}
        self._reader = reader
        self._columns = columns

    def step(self, kind: Type, path: str) -> None:
        """Walk over a value."""
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
            self.found[column] = place - self.start, _dtype(self._reader.order, kind)

    def _prefix(self, start: int) -> None:
        place = start + -start % LENGTH
        length = _unpacker(self._reader.order + "I")(self._reader.values, place)[0]
        self.prefixes.append((place - self.start, length))


def _side_by_side(
    found: dict[int, tuple[int, np.dtype[Any]]],
) -> list[tuple[int, int, int, np.dtype[Any]]]:
    """Numbers that follow one another in columns and bytes, as runs."""
    runs: list[tuple[int, int, int, np.dtype[Any]]] = []
    for column, (place, dtype) in sorted(found.items()):
        if runs:
            first, start, count, kind = runs[-1]
            if (column, place, dtype) == (first + count, start + count * dtype.itemsize, kind):
                runs[-1] = (first, start, count + 1, kind)
                continue
        runs.append((column, place, 1, dtype))
    return runs
