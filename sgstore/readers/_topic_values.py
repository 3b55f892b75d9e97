"""Values of topics as columns: arrays of numbers, or texts that the database converts to the field's type.

Message data are untrusted. A value that is too large is missing, and counted.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.display import number_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    Column = NDArray[Any]
    """Values of a field: numbers (masked if missing), lists of numbers (n, length), or texts."""


MAX_FIELDS: Final = 2048
"""Largest number of fields in a topic."""
MAX_DEPTH: Final = 12
"""Largest nesting depth of a field. Deeper values become JSON."""
MAX_VALUE: Final = 1 << 16
"""Largest size of a value: number of bytes, or of elements of a list."""
MAX_TEXT: Final = 1 << 20
"""Largest length of a text, also of nested lists as JSON; characters."""
OWN: Final = ("trace", "t", "log_time_ns", "publish_time_ns")
"""Columns that every topic has, in addition to its fields."""

NUMPY: Final[Mapping[str, type[np.generic]]] = {
    "BOOLEAN": np.bool_,
    "TINYINT": np.int8,
    "UTINYINT": np.uint8,
    "SMALLINT": np.int16,
    "USMALLINT": np.uint16,
    "INTEGER": np.int32,
    "UINTEGER": np.uint32,
    "BIGINT": np.int64,
    "UBIGINT": np.uint64,
    "FLOAT": np.float32,
    "DOUBLE": np.float64,
}
"""Database type → numpy type of the array."""

_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")


@dataclass(slots=True)
class TopicNames:
    """Column names of a topic. Names that differ only by case are made different.

    Attributes
    ----------
    taken : dict
        Path in a message → column.
    """

    taken: dict[str, str] = field(default_factory=dict[str, str])
    _folded: set[str] = field(default_factory=lambda: {*OWN})

    def of(self, path: str) -> str:
        """Return the column name of a field. If another column has the name, append ``_``."""
        if (known := self.taken.get(path)) is not None:
            return known
        name = _CONTROL.sub("?", path)[:200] or "_"
        while name.lower() in self._folded:
            name += "_"
        self._folded.add(name.lower())
        self.taken[path] = name
        return name


@dataclass(slots=True)
class Losses:
    """Counts of the messages and values of a topic that could not be decoded.

    Attributes
    ----------
    messages : int
    reason : str
        Reason of the first lost message.
    values : int
        Values that are too large, or of another type than their field.
    """

    messages: int = 0
    reason: str = ""
    values: int = 0

    def lose(self, reason: object, messages: int = 1) -> None:
        """Count messages that cannot be decoded."""
        self.messages += messages
        self.reason = self.reason or " ".join(str(reason).split())[:200]

    def texts(self) -> list[str]:
        """Return a text for each kind of loss: number of messages, number of values."""
        found: list[str] = []
        if self.messages:
            found.append(
                f"{number_of(self.messages, 'message')} not decodable, the first: {self.reason}"
            )
        if self.values:
            found.append(
                f"{number_of(self.values, 'value')} left out: too large, or of another type"
            )
        return found


def column_of(declared: str, values: Sequence[Any], losses: Losses) -> Column:
    """Return Python values of a field as a column of its database type; ``None`` is a missing value."""
    if (kind := NUMPY.get(declared)) is not None:
        return _numbers(kind, values, losses)
    column = np.empty(len(values), object)
    column[:] = [None if value is None else _text(declared, value, losses) for value in values]
    return column


def _numbers(kind: type[np.generic], values: Sequence[Any], losses: Losses) -> Column:
    missing = [value is None for value in values]
    known = [kind(0) if value is None else value for value in values]
    try:
        with np.errstate(over="raise"):
            return np.ma.masked_array(np.array(known, kind), missing)
    except (OverflowError, ValueError, TypeError, FloatingPointError):
        fits = [_fits(kind, value) for value in known]
        losses.values += fits.count(False)
        known = [value if fit else kind(0) for value, fit in zip(known, fits, strict=True)]
        hidden = [gone or not fit for gone, fit in zip(missing, fits, strict=True)]
        return np.ma.masked_array(np.array(known, kind), hidden)


def _fits(kind: type[np.generic], value: Any) -> bool:
    try:
        np.array([value], kind)
    except (OverflowError, ValueError, TypeError):
        return False
    return True


def _text(declared: str, value: Any, losses: Losses) -> str | None:
    """Return a value as text for the database. A value that is too long counts as lost: ``None``."""
    if declared == "VARCHAR":
        found = value if isinstance(value, str) else as_json(value)
    elif declared == "BLOB":
        found = bytes(value[: MAX_VALUE + 1]).hex()
    elif declared.endswith("[]"):
        found = None if len(value) > MAX_VALUE else as_json(value)
        if found and declared in {"FLOAT[]", "DOUBLE[]"}:
            found = _without_nan(found)
    else:
        found = as_json(value)
    if found is None or len(found) > (2 * MAX_VALUE if declared == "BLOB" else MAX_TEXT):
        losses.values += 1
        return None
    return plain_text(found)


def _without_nan(numbers: str) -> str:
    """Return the text of a list of numbers with ``null`` instead of ``NaN``."""
    return numbers.replace("NaN", "null")


def plain_text(text: str) -> str:
    """Return a text with surrogates replaced, because UTF-8 cannot encode them."""
    if text.isascii():
        return text
    return text.encode("utf-8", "replace").decode()


def as_json(value: Any) -> str:
    """Return a value of a message as JSON. Arrays are lists, bytes are hexadecimal."""
    return json.dumps(value, default=_json_value, ensure_ascii=False)


def _json_value(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, bytes | memoryview):
        return value.hex()
    return str(value)


def list_column(declared: str, rows: Column, losses: Losses) -> Column:
    """Return lists of numbers (n, length) as they are; as texts if they are long or contain bytes."""
    if rows.shape[1] > MAX_VALUE:
        losses.values += len(rows)
        return np.full(len(rows), None, object)
    column = np.empty(len(rows), object)
    if declared == "BLOB":
        column[:] = [row.tobytes().hex() for row in rows]
    else:
        column[:] = [_without_nan(as_json(row)) for row in rows.tolist()]
    return column


def joined_columns(
    declared: str, count: int, parts: Iterable[tuple[NDArray[np.intp], Column]], losses: Losses
) -> Column:
    """Join several parts of a column, each with its row numbers, into one column.

    Lists of different lengths become texts.
    """
    parts = list(parts)
    shapes = {values.shape[1:] for _, values in parts}
    if len(shapes) == 1 and _is_short(declared, parts[0][1]):
        whole = np.empty((count, *shapes.pop()), parts[0][1].dtype)
        for rows, values in parts:
            whole[rows] = values
        return whole
    column = np.full(count, None, object)
    for rows, values in parts:
        texts = values if values.ndim == 1 else list_column(declared, values, losses)
        column[rows] = texts
    return column


MAX_LISTED: Final = 64
"""Largest length of lists that the database receives as arrays."""


def _is_short(declared: str, values: Column) -> bool:
    """True if the values of a column need not be converted to texts."""
    return values.ndim == 1 or (declared != "BLOB" and 0 < values.shape[1] <= MAX_LISTED)


def guessed(value: Any) -> str:
    """Return the database type of a JSON value."""
    if isinstance(value, bool):
        return "BOOLEAN"
    if isinstance(value, int):
        return "BIGINT" if -(1 << 63) <= value < 1 << 63 else "DOUBLE"
    if isinstance(value, float):
        return "DOUBLE"
    if isinstance(value, list):
        kinds = {guessed(item) for item in value if item is not None} or {""}
        return f"{wider(kinds)}[]" if kinds <= _OF_LISTS else "JSON"
    return "VARCHAR" if isinstance(value, str) else "JSON"


_OF_LISTS: Final = {"", "BOOLEAN", "BIGINT", "DOUBLE", "VARCHAR"}


def wider(kinds: Iterable[str]) -> str:
    """Return the database type that fits several types of JSON values. An empty list has the type ``[]``."""
    found = {*kinds}
    if len(found) == 1:
        return found.pop()
    if all(kind.endswith("[]") for kind in found):
        return f"{wider(kind.removesuffix('[]') for kind in found)}[]"
    found.discard("")
    if found <= {"BIGINT", "DOUBLE"}:
        return wider(found) if len(found) == 1 else "DOUBLE"
    if len(found) == 1:
        return found.pop()
    return "VARCHAR" if not any(kind.endswith("]") for kind in found) else "JSON"


def as_number(value: Any) -> Any:
    """Return a JSON number that fits into a double. Integers that are too large become infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf
