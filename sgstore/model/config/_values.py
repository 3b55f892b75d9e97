"""Conversion of plain values to tables of settings. Unknown names and wrong types raise errors."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Final, get_args, get_origin, get_type_hints

from sgstore.errors import ConfigError
from sgstore.model.vocabulary import suggestion

if TYPE_CHECKING:
    from collections.abc import Iterable


def check(holds: bool, name: str, value: object, right: str) -> None:  # noqa: FBT001
    """Raise an error with the expected value if a setting is invalid.

    Raises
    ------
    ConfigError
        The message names the setting, its value, and the expected value.
    """
    if not holds:
        raise ConfigError(f"setting '{name}' is {value!r}; expected {right}")


def one_of(words: Iterable[str]) -> str:
    """Format words as an enumeration: ``'a', 'b' or 'c'``."""
    *most, last = (f"'{word}'" for word in words)
    return f"{', '.join(most)} or {last}"


def changed(config: Any, values: Mapping[str, Any], prefix: str) -> Any:
    """Return a copy of a table of settings with some values changed."""
    hints = get_type_hints(type(config))
    known = {f.name for f in fields(config)}
    for name in values:
        if name not in known:
            raise unknown_setting(prefix, name, known)
    changes = {
        name: value_of(hints[name], value, f"{prefix}{name}", getattr(config, name))
        for name, value in values.items()
    }
    return replace(config, **changes)


def unknown_setting(prefix: str, name: str, known: set[str]) -> ConfigError:
    like = suggestion(name, known)
    hint = f"did you mean '{prefix}{like}'?" if like else f"known: {', '.join(sorted(known))}"
    return ConfigError(f"unknown setting '{prefix}{name}'; {hint}")


_ENDLESS: Final = frozenset({"range.world"})
"""Names of settings that can be infinite."""

_PLAIN: Final[dict[object, str]] = {str: "a text", bool: "true or false", int: "a whole number"}


def value_of(hint: Any, value: Any, name: str, default: Any = None) -> Any:
    """Convert a plain value to the type of a setting. An invalid value raises an error."""
    if is_dataclass(hint):
        return _table(hint, value, name, default)
    if get_origin(hint) is Mapping:
        check(isinstance(value, Mapping), name, value, f"a table [{name}]")
        inner = get_args(hint)[1]
        return {str(key): value_of(inner, one, f'{name}."{key}"') for key, one in value.items()}
    if hint is float:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        endless = number and value == math.inf and name in _ENDLESS
        check(endless or (number and abs(value) <= sys.float_info.max), name, value, "a number")
        return float(value)
    if hint is Any:
        return value
    if hint in _PLAIN:
        check(type(value) is hint, name, value, _PLAIN[hint])
        return value
    check(isinstance(value, (list, tuple)), name, value, "a list")
    return tuple(value_of(get_args(hint)[0], item, f"{name}[{i}]") for i, item in enumerate(value))


def _table(cls: Any, value: Any, name: str, default: Any) -> Any:
    if isinstance(value, cls):
        return value
    check(isinstance(value, Mapping), name, value, f"a table [{name}]")
    prefix = f"{name}."
    return _built(cls, value, prefix) if default is None else changed(default, value, prefix)


def _built(cls: Any, values: Mapping[str, Any], prefix: str) -> Any:
    """Build a settings object from plain values. Fields without a default are required."""
    hints = get_type_hints(cls)
    for name in values:
        if name not in hints:
            raise unknown_setting(prefix, name, set(hints))
    for part in fields(cls):
        given = part.name in values or part.default is not MISSING
        check(given, f"{prefix}{part.name}", None, "a value")
    return cls(**{name: value_of(hints[name], v, f"{prefix}{name}") for name, v in values.items()})
