"""Columns as bytes, read as the explorer's page reads them."""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping


def unpacked(data: bytes) -> tuple[dict[str, Any], Mapping[str, np.ndarray[Any, Any]]]:
    """The header and the columns of bytes, read as the page reads them."""
    length, zero = struct.unpack_from("<II", data)
    assert zero == 0
    header, place = json.loads(data[8 : 8 + length]), (8 + length + 7) // 8 * 8
    columns = {}
    for name, kind, many in header["columns"]:
        column = np.frombuffer(data, f"<{kind}", many, place)
        columns[name] = column
        place = (place + column.nbytes + 7) // 8 * 8
    assert place == len(data)
    return header, columns
