"""``osi3.BaseMoving`` of many objects as columns, straight from their bytes.

A ``BaseMoving`` is almost nothing but doubles, and those of a frame mostly have the same sub-messages:
then the same bytes stand at the same places, and the numbers between them are columns of a matrix. So
the layout of one message is learned, byte by byte, and all that agree with it in every byte that is no
number are read at once; what is left over teaches the next layout. Reading the same numbers as
attributes takes four times as long.

The bytes are those that protobuf itself writes for a message it has parsed, so they are well formed,
whatever the recording holds.

Source: protobuf encoding (protobuf.dev/programming-guides/encoding).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.traces.frames import FAR, POSE
from sgstore.traces.osi_fields import fields_of

if TYPE_CHECKING:
    from google.protobuf.descriptor import Descriptor

    from sgstore.world import Bools, Floats, Ints

_PARTS: Final = {
    "position": ("x", "y", "z"),
    "orientation": ("heading", "pitch", "roll"),
    "velocity": ("vx", "vy", "vz"),
    "acceleration": ("ax", "ay", "az"),
    "orientation_rate": ("yaw_rate",),
    "dimension": ("length", "width", "height"),
}
"""Sub-message → the columns of :data:`sgstore.traces.frames.POSE` that it tells."""
_NAMES: Final = {
    "position": ("x", "y", "z"),
    "orientation": ("yaw", "pitch", "roll"),
    "velocity": ("x", "y", "z"),
    "acceleration": ("x", "y", "z"),
    "orientation_rate": ("yaw",),
    "dimension": ("length", "width", "height"),
}
_VARINT, _FIXED64, _BYTES, _GROUP, _GROUP_END = 0, 1, 2, 3, 4
_ROUNDS: Final = 64
"""Layouts that are tried for the messages of one length in a frame; what is left is read one by one."""
_MOST_LAYOUTS: Final = 256
"""Layouts that are remembered for messages of one length; then they are forgotten and learned anew."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where things stand in messages of one shape.

    ``fixed`` and ``expected``: places and values of all bytes that are no numbers. ``places``: where the
    doubles begin; ``columns``: what they are. ``zero``: columns of sub-messages that are there but leave
    the number out. ``oriented``, ``placed``: whether there is an orientation and a position.
    """

    fixed: Ints
    expected: np.ndarray[Any, np.dtype[np.uint8]]
    places: Ints
    columns: Ints
    zero: Ints
    oriented: bool
    placed: bool


class Bases:
    """Reads the bases of moving objects.

    Parameters
    ----------
    descriptor : Descriptor
        Of ``BaseMoving``, in the recording's version of OSI.
    """

    def __init__(self, descriptor: Descriptor) -> None:
        self._fields: dict[int, tuple[str, dict[int, int]]] = {}
        for part, columns in _PARTS.items():
            field = descriptor.fields_by_name.get(part)
            if field is None or field.message_type is None:
                continue
            inner = field.message_type.fields_by_name
            self._fields[field.number] = (
                part,
                {
                    inner[name].number: POSE.index(column)
                    for name, column in zip(_NAMES[part], columns, strict=True)
                    if name in inner
                },
            )
        self._layouts: dict[int, list[_Layout]] = {}

    def read(self, bases: list[bytes]) -> tuple[Floats, Bools]:
        """The numbers of serialised bases.

        Returns
        -------
        values : (n, 16) float64
            Columns :data:`sgstore.traces.frames.POSE`; NaN where the sub-message is missing, 0 where only
            the number is.
        usable : (n,) bool
            Whether there is a position on earth, and an orientation that is a number if there is one.
        """
        values = np.full((len(bases), len(POSE)), np.nan)
        usable = np.zeros(len(bases), np.bool_)
        lengths = np.fromiter(map(len, bases), np.int64, len(bases))
        starts = np.cumsum(lengths) - lengths
        joined = np.frombuffer(b"".join(bases), np.uint8)
        for length in np.unique(lengths):
            rows = np.flatnonzero(lengths == length)
            bytes_of = joined[starts[rows, None] + np.arange(length)]
            for _ in range(_ROUNDS):
                if not len(rows):
                    break
                layout, agree = self._agreeing(bytes_of)
                values[rows[agree]], usable[rows[agree]] = _numbers(layout, bytes_of[agree])
                rows, bytes_of = rows[~agree], bytes_of[~agree]
            for row, base in zip(rows, bytes_of, strict=True):
                layout = self._learn(base.tobytes())
                values[[row]], usable[[row]] = _numbers(layout, base[None])
        return values, usable

    def _agreeing(self, bytes_of: np.ndarray[Any, np.dtype[np.uint8]]) -> tuple[_Layout, Bools]:
        """A layout that at least the first of some messages of equal length has, and which have it."""
        layouts = self._layouts.setdefault(bytes_of.shape[1], [])
        first = bytes_of[0]
        for layout in layouts:
            if np.array_equal(first[layout.fixed], layout.expected):
                break
        else:
            if len(layouts) >= _MOST_LAYOUTS:
                layouts.clear()
            layout = self._learn(first.tobytes())
            layouts.append(layout)
        return layout, (bytes_of[:, layout.fixed] == layout.expected).all(axis=1)

    def _learn(self, base: bytes) -> _Layout:
        number = np.zeros(len(base), np.bool_)
        found: dict[int, int] = {}
        parts: set[str] = set()
        zero: list[int] = []
        for field, wire, start, stop in _walk(base, 0, len(base)):
            known = self._fields.get(field) if wire == _BYTES else None
            if known is None:
                number[start:stop] = wire != _VARINT
                continue
            part, columns = known
            parts.add(part)
            zero += columns.values()
            for inner, inner_wire, at, end in _walk(base, start, stop):
                number[at:end] = inner_wire != _VARINT
                if inner_wire == _FIXED64 and inner in columns:
                    found[columns[inner]] = at
        fixed = np.flatnonzero(~number)
        return _Layout(
            fixed=fixed,
            expected=np.frombuffer(base, np.uint8)[fixed],
            places=np.array(list(found.values()), np.int64),
            columns=np.array(list(found), np.int64),
            zero=np.array([column for column in zero if column not in found], np.int64),
            oriented="orientation" in parts,
            placed="position" in parts,
        )


def _numbers(
    layout: _Layout, bytes_of: np.ndarray[Any, np.dtype[np.uint8]]
) -> tuple[Floats, Bools]:
    count = len(bytes_of)
    values = np.full((count, len(POSE)), np.nan)
    values[:, layout.zero] = 0.0
    if len(layout.places):
        eight = (layout.places[:, None] + np.arange(8)).ravel()
        values[:, layout.columns] = np.ascontiguousarray(bytes_of[:, eight]).view("<f8")
    with np.errstate(invalid="ignore"):
        near = np.abs(values[:, :4]) < FAR
    needed = near if layout.oriented else near[:, :3]
    return values, np.all(needed, axis=1) & np.full(count, layout.placed)


def _walk(message: bytes, start: int, stop: int) -> list[tuple[int, int, int, int]]:
    """Fields of a message: number, wire type, where the content begins and where it ends; groups left out."""
    fields: list[tuple[int, int, int, int]] = []
    depth = 0
    for number, wire, at, end in fields_of(message, start, stop):
        if wire in {_GROUP, _GROUP_END}:
            depth += 1 if wire == _GROUP else -1
        elif not depth:
            fields.append((number, wire, at, end))
    return fields
