"""Binary format of columns, which the web page reads without copying; JSON text that browsers accept.

``u32 length of the header, u32 0``, the header as JSON padded to 8 bytes, then each column, little-endian,
padded to 8 bytes. The header names the columns with their types and lengths under ``columns``.
"""

from __future__ import annotations

import json
import struct
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.json_text import finite, json_text

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sgstore.lang.help import ConditionValues

PAGE: Final = Path(__file__).parent / "page"
"""Folder with the files of the web page."""


def packed(header: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Return a header and numeric columns packed into bytes, for the web page.

    Parameters
    ----------
    header : mapping
        JSON values.
    columns : mapping of str to array
        Numbers, one dimension each.
    """
    listed = [[name, column.dtype.str[1:], len(column)] for name, column in columns.items()]
    text = json.dumps({**header, "columns": listed}).encode()
    parts = [struct.pack("<II", len(text), 0), text, _padding(text)]
    for column in columns.values():
        data = np.ascontiguousarray(column, column.dtype.newbyteorder("<")).tobytes()
        parts += [data, _padding(data)]
    return b"".join(parts)


def _padding(data: bytes) -> bytes:
    return bytes(-len(data) % 8)


def as_json(value: object) -> bytes:
    """Return a value as JSON for browsers. Infinite numbers become texts, such as ``inf``."""
    return json_text(value, str).encode(errors="replace")


def told_values(found: ConditionValues) -> dict[str, Any]:
    """Return the values in the conditions of a pattern as JSON values, by lane and condition."""
    return {"values": finite([[[*map(asdict, of)] for of in lane] for lane in found])}
