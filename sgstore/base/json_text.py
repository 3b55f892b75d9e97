"""Values as JSON text. Infinite numbers and NaN are replaced, and numbers have their shortest text."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable


def json_text(value: object, word: Callable[[float], str | None] = lambda _: None) -> str:
    """Return a value as compact JSON text. Infinite numbers and NaN are replaced."""
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    except (TypeError, ValueError):
        return json.dumps(finite(value, word), separators=(",", ":"), ensure_ascii=False)


def finite(value: Any, word: Callable[[float], str | None] = lambda _: None) -> Any:
    """Convert a value to JSON types. ``word(number)`` replaces infinite numbers and NaN.

    Parameters
    ----------
    value : object
        Mappings, lists and tuples are converted recursively. Values without a JSON type become text.
    word : function
        Replacement for infinite numbers and NaN, by default null.
    """
    if isinstance(value, Mapping):
        return {str(key): finite(item, word) for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    if isinstance(value, list | tuple):
        return [finite(item, word) for item in value]  # pyright: ignore[reportUnknownVariableType]
    if hasattr(value, "tolist"):  # a numpy value
        return finite(value.tolist(), word)
    if isinstance(value, float) and not math.isfinite(value):
        return word(value)
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def float32(number: float) -> float | None:
    """Round a number to float32; ``None`` if it is too large."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", number))[0])
    except OverflowError:
        return None


def shortest(number: float | None) -> float | None:
    """Return the float64 number with the shortest decimal text that rounds to the same float32 number."""
    if number is None or not math.isfinite(number):
        return number
    texts = (f"{number:.{digits}g}" for digits in range(6, 10))
    kept = float32(number)
    return next(found for found in map(float, texts) if float32(found) == kept)
