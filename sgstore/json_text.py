"""Values as JSON, which has no word for numbers that are infinite or none."""

from __future__ import annotations

import json
import math
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
