"""Values as JSON, which has no word for infinite or missing numbers, and the shortest text of numbers."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable


def json_text(value: object, word: Callable[[float], str | None] = lambda _: None) -> str:
    """A value as compact JSON; numbers that are not finite as :func:`finite` tells them."""
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    except (TypeError, ValueError):
        return json.dumps(finite(value, word), separators=(",", ":"), ensure_ascii=False)


def finite(value: Any, word: Callable[[float], str | None] = lambda _: None) -> Any:
    """A value as JSON holds it.

    Parameters
    ----------
    value : object
        Mappings, lists and tuples are gone through; what JSON does not hold becomes its text.
    word : function
        What stands for a number that is infinite or none, by default null.
    """
    if isinstance(value, Mapping):
        return {str(key): finite(item, word) for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    if isinstance(value, list | tuple):
        return [finite(item, word) for item in value]  # pyright: ignore[reportUnknownVariableType]
    if hasattr(value, "tolist"):  # of numpy
        return finite(value.tolist(), word)
    if isinstance(value, float) and not math.isfinite(value):
        return word(value)
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def float32(number: float) -> float | None:
    """Round a number to 32 bits; ``None`` if it is too large for them."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", number))[0])
    except OverflowError:
        return None


def shortest(number: float | None) -> float | None:
    """Return the number of 64 bits whose text is the shortest one of a number of 32 bits."""
    if number is None or not math.isfinite(number):
        return number
    texts = (f"{number:.{digits}g}" for digits in range(6, 10))
    kept = float32(number)
    return next(found for found in map(float, texts) if float32(found) == kept)
