"""Messages in CDR and their definitions, held against the encoder and decoder of ``mcap-ros2-support``."""

from __future__ import annotations

import math
import re
import struct
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from carla_recordings import definition, header, thing
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from thorough import share_of

from sgstore.errors import TraceError
from sgstore.readers import decode, parse_definition
from sgstore.readers._ros2 import (
    MAX_ROWS,
    MAX_VALUES,
    NUMBERS,
    ColumnReader,
    Sequence,
    Struct,
    Text,
    number,
    records,
    text,
)

RULE = "=" * 80
OBJECTS = "derived_object_msgs/msg/ObjectArray"


def encoded(content: str, message: dict[str, Any]) -> bytes:
    return bytes(serialize_dynamic("pkg/msg/Top", content)["pkg/msg/Top"](message))


def plain(value: Any) -> Any:
    """What was decoded, by either decoder, as plain values."""
    if isinstance(value, dict):
        return {name: plain(inner) for name, inner in value.items()}
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, bytes | bytearray | memoryview):
        return list(value)
    if isinstance(value, np.ndarray):
        return [plain(inner) for inner in value.tolist()]
    return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value


# Definitions and values at random -----------------------------------------------------------------

LIMITS = {
    "bool": st.booleans(),
    "byte": st.integers(0, 255),
    "char": st.integers(0, 127),  # beyond, the other package takes it for a number with a sign
    "int8": st.integers(-128, 127),
    "uint8": st.integers(0, 255),
    "int16": st.integers(-(1 << 15), (1 << 15) - 1),
    "uint16": st.integers(0, (1 << 16) - 1),
    "int32": st.integers(-(1 << 31), (1 << 31) - 1),
    "uint32": st.integers(0, (1 << 32) - 1),
    "int64": st.integers(-(1 << 63), (1 << 63) - 1),
    "uint64": st.integers(0, (1 << 64) - 1),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
    "string": st.text(
        st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9
    ),
}
NO_ARRAYS = {"bool", "byte", "char"}
"""Types whose arrays the two encodings of the other package disagree about, or take bytes for."""


@st.composite
def fields(draw: st.DrawFn, inner: tuple[str, ...]) -> list[tuple[str, str, int | None]]:
    """Type, suffix and fixed length of some fields."""
    found = []
    for _ in range(draw(st.integers(1, 6))):
        kind = draw(st.sampled_from([*LIMITS, *inner]))
        suffix, count = "", None
        if kind not in NO_ARRAYS and draw(st.booleans()):
            count = draw(st.sampled_from([None, None, 1, 3]))
            suffix = f"[{count}]" if count else draw(st.sampled_from(["[]", "[<=9]"]))
        found.append((kind, suffix, count))
    return found


@st.composite
def examples(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    """The text of a schema and a message of it."""
    types: dict[str, Any] = {}
    types["Leaf"] = draw(fields(()))
    types["Branch"] = draw(fields(("Leaf",)))
    types["Top"] = draw(fields(("Leaf", "pkg/Branch")))

    def written(name: str) -> str:
        lines = [f"{kind}{suffix} f{i}" for i, (kind, suffix, _) in enumerate(types[name])]
        return "\n".join(["# a comment", "uint8 CONSTANT=5", *lines, ""])

    def value(kind: str) -> Any:
        name = kind.removeprefix("pkg/")
        return message(name) if name in types else draw(LIMITS[kind])

    def message(name: str) -> dict[str, Any]:
        made = {}
        for i, (kind, suffix, count) in enumerate(types[name]):
            many = draw(st.integers(0, 3)) if count is None else count
            made[f"f{i}"] = [value(kind) for _ in range(many)] if suffix else value(kind)
        return made

    top = message("Top")
    rest = "".join(f"{RULE}\nMSG: pkg/{name}\n{written(name)}" for name in ("Leaf", "Branch"))
    return written("Top") + rest, top


@settings(max_examples=share_of(120), deadline=None, suppress_health_check=list(HealthCheck))
@given(examples())
def test_any_message_is_decoded_as_it_was_meant(case: tuple[str, dict[str, Any]]) -> None:
    content, message = case
    data = encoded(content, message)

    found = plain(decode(parse_definition("pkg/msg/Top", content.encode()), data))

    assert found == plain(message)
    assert found == plain(generate_dynamic("pkg/msg/Top", content)["pkg/msg/Top"](data))


@settings(max_examples=share_of(60), deadline=None, suppress_health_check=list(HealthCheck))
@given(examples())
def test_fields_are_those_of_the_whole_message(case: tuple[str, dict[str, Any]]) -> None:
    content, message = case
    kind = parse_definition("pkg/msg/Top", content.encode())
    data = encoded(content, message)
    paths = [*(f"f{i}" for i in range(6)), "f0.f0", "f1[0]", "f2[1].f0", "f3.f1.f2"]
    reader = ColumnReader(kind, tuple(paths))

    def told(path: str) -> float:
        value: Any = decode(kind, data)
        for step in re.findall(r"\w+", path):
            inside = isinstance(value, dict) and step in value
            listed = (
                isinstance(value, list | np.ndarray) and step.isdigit() and int(step) < len(value)
            )
            if not (inside or listed):
                return math.nan
            value = value[step if inside else int(step)]
        return float(value) if isinstance(value, int | float | np.number) else math.nan

    for _ in range(2):  # learned, then remembered
        np.testing.assert_array_equal(reader.read(data)[1][0], [told(path) for path in paths])
    for length in range(0, len(data), 3):
        with pytest.raises(TraceError):
            reader.read(data[:length])


@settings(max_examples=share_of(80), deadline=None, suppress_health_check=list(HealthCheck))
@given(examples(), st.floats(0, 1), st.integers(0, (1 << 32) - 1))
def test_any_message_that_is_cut_or_spoiled_ends_in_a_message_or_an_error(
    case: tuple[str, dict[str, Any]], where: float, value: int
) -> None:
    content, message = case
    data = encoded(content, message)
    kind = parse_definition("pkg/msg/Top", content.encode())
    at = int(where * len(data)) & ~3

    for spoiled in (data[:at], data[:at] + struct.pack("<I", value) + data[at + 4 :]):
        with suppress(TraceError):
            assert decode(kind, spoiled).keys() == message.keys()


def test_big_endian_numbers_are_read() -> None:
    kind = parse_definition("pkg/msg/Top", b"uint8 a\nfloat64 b\nuint16[] c\nstring d")
    data = b"\0\0\0\0" + b"\x07" + bytes(7) + struct.pack(">d", 2.5)
    data += struct.pack(">IHH", 2, 258, 3) + struct.pack(">I", 3) + b"ab\0"

    assert plain(decode(kind, data)) == {"a": 7, "b": 2.5, "c": [258, 3], "d": "ab"}


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "a message of 0 bytes"),
        (b"\0\1\0", "a message of 3 bytes"),
        (b"\0\3\0\0" + bytes(40), "encoding 0x0003"),
        (b"\0\1\0\0", "ends before its 4th"),
        (b"\0\1\0\0\xff\xff\xff\xff", "claims a length of 4294967295 where 0 bytes are left"),
        (b"\0\1\0\0\2\0\0\0a\0\0\0\x09\0\0\0" + bytes(80), "its definition allows 3"),
    ],
    ids=range(6),
)
def test_what_is_wrong_with_a_message_is_named(data: bytes, reason: str) -> None:
    kind = parse_definition("pkg/msg/Top", b"string a\nuint8[<=3] b\nfloat64 c")

    with pytest.raises(TraceError, match=reason):
        decode(kind, data)


def test_a_message_of_endless_small_things_is_refused_quickly() -> None:
    nested = f"Leaf[] f\n{RULE}\nMSG: pkg/Leaf\nstring[] g"
    kind = parse_definition("pkg/msg/Top", nested.encode())
    data = b"\0\1\0\0" + struct.pack("<I", MAX_VALUES + 1) + bytes(4 * MAX_VALUES + 4)

    with pytest.raises(TraceError, match=f"more than {MAX_VALUES} values"):
        decode(kind, data)


def test_records_are_asked_by_path_and_lack_what_is_not_there() -> None:
    record = {"a": {"b": 2, "c": "x", "d": [{"e": 1}, 5]}, "f": True}

    assert number(record, "a.b") == 2
    assert number(record, "f") == 1
    assert text(record, "a.c") == "x"
    assert records(record, "a.d") == [{"e": 1}]
    assert math.isnan(number(record, "a.c"))
    assert math.isnan(number(record, "a.b.c"))
    assert (text(record, "a.b"), records(record, "a.c")) == ("", [])


# Sequences as columns -----------------------------------------------------------------------------

COLUMNS = ("id", "pose.position.x", "shape.dimensions[1]", "polygon.points[0].y", "nowhere")


def objects_of(things: list[dict[str, Any]], frame: str = "map") -> bytes:
    content = definition("derived_object_msgs/ObjectArray")
    message = {"header": header(1.5, frame), "objects": things}
    return bytes(serialize_dynamic(OBJECTS, content)[OBJECTS](message))


def table() -> ColumnReader:
    content = definition("derived_object_msgs/ObjectArray")
    return ColumnReader(parse_definition(OBJECTS, content.encode()), COLUMNS, "objects")


sizes = st.sampled_from([[], [1.0], [1.0, 2.0], [1.0, 2.0, 3.0]])
points = st.lists(st.just({"x": 1.0, "y": 2.5, "z": 0.0}), max_size=3)
things = st.builds(
    lambda frame, size, polygon, x: thing(5, x, frame=frame, size=size, polygon=polygon),
    st.sampled_from(["", "m", "map", "a/longer/name"]),
    sizes,
    points,
    st.floats(-1e6, 1e6),
)


@settings(max_examples=share_of(60), deadline=None)
@given(st.lists(st.lists(things, max_size=12), min_size=1, max_size=4))
@example([[thing(1), thing(2, frame="some/other"), thing(3)]])
def test_a_table_is_what_decoding_one_by_one_gives(messages: list[list[dict[str, Any]]]) -> None:
    reader = table()
    kind = parse_definition(OBJECTS, definition("derived_object_msgs/ObjectArray").encode())
    for some in messages:
        data = objects_of(some)
        head, numbers = reader.read(data)
        told = decode(kind, data)["objects"]

        assert head == {"header": decode(kind, data)["header"]}
        expected = [
            [
                one["id"],
                one["pose"]["position"]["x"],
                [*one["shape"]["dimensions"], *[math.nan] * 2][1],
                one["polygon"]["points"][0]["y"] if one["polygon"]["points"] else math.nan,
                math.nan,
            ]
            for one in told
        ]
        np.testing.assert_array_equal(numbers, np.reshape(expected, (-1, 5)))


def test_a_table_that_is_cut_anywhere_is_refused() -> None:
    data = objects_of([thing(i) for i in range(3)])
    reader = table()
    reader.read(data)

    for length in range(len(data)):
        with pytest.raises(TraceError):
            reader.read(data[:length])


def test_a_table_of_too_many_rows_is_refused() -> None:
    kind = parse_definition("pkg/msg/Top", f"Leaf[] f\n{RULE}\nMSG: pkg/Leaf\nuint8 a".encode())
    data = b"\0\1\0\0" + struct.pack("<I", MAX_ROWS + 1) + bytes(MAX_ROWS + 1)

    with pytest.raises(TraceError, match="at most 100000 are read"):
        ColumnReader(kind, ("a",), "f").read(data)
    with pytest.raises(TraceError, match="no sequence of structures 'g'"):
        ColumnReader(kind, ("a",), "g")


# Definitions --------------------------------------------------------------------------------------


def test_a_definition_becomes_a_structure() -> None:
    content = (
        "# comment\n\nstring<=5 name 'x'  # default\nfloat64[3] a\nint8[<=2] b\nTime t\nuint8 K=3\n"
        f"{RULE}\nMSG: pkg/Time\nbuiltin_interfaces/Time stamp\n"
    )
    kind = parse_definition("pkg/msg/Top", content.encode())
    stamp = dict(dict(kind.fields)["t"].fields)["stamp"]  # type: ignore[union-attr]

    assert [name for name, _ in kind.fields] == ["name", "a", "b", "t"]
    assert dict(kind.fields)["name"] == Text(5)
    assert dict(kind.fields)["a"] == Sequence(NUMBERS["float64"], 3, -1)
    assert dict(kind.fields)["b"] == Sequence(NUMBERS["int8"], -1, 2)
    assert isinstance(stamp, Struct)
    assert [name for name, _ in stamp.fields] == ["sec", "nanosec"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "does not hold its definition"),
        ("   \n ", "does not hold its definition"),
        ("Other a", "the definition of pkg/Other is missing"),
        ("Top a", "pkg/Top is a part of itself"),
        ("Top[] a", "pkg/Top is a part of itself"),
        ("???", "a line that defines no field"),
        ("uint8", "a line that defines no field"),
        ("uint8<=3 a", "only a string may have a bound"),
        ("uint8[0] a", "an array of 0 elements"),
        ("uint8[99999999] a", "an array of 99999999 elements"),
        ("wstring a", "wstring, which is not read"),
        (f"uint8 a\n{RULE}\nuint8 b", "expected 'MSG: package/Type'"),
        ("uint8 a\n" * 5000, "has 5000 members"),
        ("#" * (2 << 20), "bytes; at most"),
        ("uint8 a" + "".join(f"\n{RULE}\nMSG: p/T{i}\nuint8 a" for i in range(600)), "601 types"),
        (
            "T0 a" + "".join(f"\n{RULE}\nMSG: pkg/T{i}\nT{i + 1} a" for i in range(99)),
            "nested more than 32 deep",
        ),
        (
            "T0[2] a"
            + "".join(f"\n{RULE}\nMSG: pkg/T{i}\nT{i + 1} a\nT{i + 1} b" for i in range(20))
            + f"\n{RULE}\nMSG: pkg/T20\nuint8 a",
            "members; at most",
        ),
    ],
    ids=range(17),
)
def test_what_is_wrong_with_a_definition_is_named(content: str, reason: str) -> None:
    with pytest.raises(TraceError, match=reason):
        parse_definition("pkg/msg/Top", content.encode())


def test_a_message_without_fields_has_the_one_that_stands_for_none() -> None:
    kind = parse_definition("pkg/msg/Top", b"uint8 ONLY_A_CONSTANT=1")

    assert plain(decode(kind, b"\0\1\0\0\0")) == {"structure_needs_at_least_one_member": 0}
