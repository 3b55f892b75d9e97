"""MessagePack values with numpy arrays, as 123D stores them in Arrow files.

Source: MessagePack specification, ``spec.md``.
"""

from __future__ import annotations

import struct
from typing import Any, Final

import numpy as np

MAX_DEPTH: Final = 20
_NUMBERS: Final = {
    0xCA: ">f", 0xCB: ">d", 0xCC: ">B", 0xCD: ">H", 0xCE: ">I", 0xCF: ">Q",
    0xD0: ">b", 0xD1: ">h", 0xD2: ">i", 0xD3: ">q",
}  # fmt: skip
_SIZES: Final = {
    **dict.fromkeys((0xC4, 0xD9), ">B"),
    **dict.fromkeys((0xC5, 0xDA, 0xDC, 0xDE), ">H"),
    **dict.fromkeys((0xC6, 0xDB, 0xDD, 0xDF), ">I"),
}
_MAP, _ARRAY, _TEXT, _BYTES = 0x80, 0x90, 0xA0, 0xC4
_KINDS: Final = {
    **dict.fromkeys((0xC4, 0xC5, 0xC6), _BYTES),
    **dict.fromkeys((0xD9, 0xDA, 0xDB), _TEXT),
    **dict.fromkeys((0xDC, 0xDD), _ARRAY),
    **dict.fromkeys((0xDE, 0xDF), _MAP),
}
_CONSTANTS: Final = {0xC0: None, 0xC2: False, 0xC3: True}
_DTYPES: Final = ("<f8", "<f4", "<i8", "<i4")


def unpacked(data: bytes) -> Any:
    """Return the value in MessagePack data. Arrays of numbers become numpy arrays.

    Raises
    ------
    ValueError
        The data are malformed, or contain other types.
    """
    try:
        value, at = _value(data, 0, 0)
    except (struct.error, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"malformed MessagePack data: {error!r}") from error
    if at != len(data):
        raise ValueError("MessagePack data with bytes after their end")
    return value


def _value(data: bytes, at: int, depth: int) -> tuple[Any, int]:
    """Return the MessagePack value at a byte position, and the position after the value."""
    code = data[at]
    at += 1
    if code < 0x80 or code >= 0xE0:  # A small number is the code itself.
        return code if code < 0x80 else code - 0x100, at
    if code in _CONSTANTS:
        return _CONSTANTS[code], at
    if code in _NUMBERS:
        return struct.unpack_from(_NUMBERS[code], data, at)[0], at + struct.calcsize(_NUMBERS[code])
    if code < 0xC0:  # The size is in the code: a map, an array, or a text.
        size, kind = code & (0x0F if code < 0xA0 else 0x1F), code & (0xF0 if code < 0xA0 else 0xE0)
    else:
        (size,) = struct.unpack_from(_SIZES[code], data, at)
        at, kind = at + struct.calcsize(_SIZES[code]), _KINDS[code]
    if kind in {_BYTES, _TEXT}:
        part = data[at : at + size]
        if len(part) < size:
            raise ValueError("MessagePack data are cut off")
        return (part if kind == _BYTES else part.decode("utf-8")), at + size
    if depth > MAX_DEPTH:
        raise ValueError("MessagePack data are nested too deeply")
    items: list[Any] = []
    for _ in range(size if kind == _ARRAY else 2 * size):
        item, at = _value(data, at, depth + 1)
        items.append(item)
    return (
        items if kind == _ARRAY else _array(dict(zip(items[::2], items[1::2], strict=True)))
    ), at


def _array(told: dict[Any, Any]) -> Any:
    """Convert a mapping with the key ``__ndarray__`` to a numpy array. Return other mappings unchanged."""
    if b"__ndarray__" not in told:
        return told
    if told[b"dtype"] not in _DTYPES:
        raise ValueError(f"an array of {told[b'dtype']!r}")
    return np.frombuffer(told[b"data"], told[b"dtype"]).reshape(told[b"shape"])
