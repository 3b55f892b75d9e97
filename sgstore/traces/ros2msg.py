"""Definitions of ROS 2 messages: the ``.msg`` texts that a recording carries → the structure of its messages.

A schema of encoding ``ros2msg`` is the text of a message's own definition, and behind it, each after a line of
``=`` and a line ``MSG: package/Type``, the texts of all types that it is made of. A layout is always made
from the recording's own text: the same type has other fields in another year (``shape_msgs/SolidPrimitive``
gained one in Humble), and messages that are read by the wrong layout give numbers all the same.

Texts come from strangers: their size, the number of their types and fields, and their depth are bounded.

Source: ROS 2 documentation, "Interfaces"; MCAP registry of schema encodings, ``ros2msg``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from sgstore.errors import TraceError

if TYPE_CHECKING:
    from collections.abc import Mapping

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
