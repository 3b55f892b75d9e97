"""Configs from TOML files, plain values and keyword arguments."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Final, get_args, get_origin, get_type_hints

from sgstore.config.presets import preset
from sgstore.config.settings import Config, check
from sgstore.errors import ConfigError
from sgstore.vocabulary import suggestion

MAX_CONFIG_BYTES: Final = 1 << 20


def load(path: str | Path) -> Config:
    """The config in a TOML file; what the file does not name keeps its default, or what its preset says.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, or holds a setting that is unknown or out of range.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise ConfigError(f"{path}: larger than {MAX_CONFIG_BYTES} bytes, which no config is")
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from error
    try:
        return from_dict(values)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def from_dict(values: Mapping[str, Any]) -> Config:
    """The config that plain values describe.

    Parameters
    ----------
    values : mapping
        As in TOML and JSON. ``preset`` names the preset whose settings hold for what is not named; without it
        the defaults hold.

    Raises
    ------
    ConfigError
        A setting is unknown, of the wrong type, or out of range.
    """
    values = dict(values)
    name = values.pop("preset", "")
    check(isinstance(name, str), "preset", name, "the name of a preset")
    return _changed(preset(name) if name else Config(), values, "")


def configured(**settings: Any) -> Config:
    """The config that keyword arguments describe: tables as values of their classes or as mappings.

    ::

        configured(preset="carlasgg", range={"front": 80}, pairs=Pairs(within=0), rate=2)

    Raises
    ------
    ConfigError
        As :func:`from_dict`.
    """
    return from_dict(settings)


def _changed(config: Any, values: Mapping[str, Any], prefix: str) -> Any:
    """A table of settings with other values for some of them."""
    hints = get_type_hints(type(config))
    known = {f.name for f in fields(config)}
    for name in values:
        if name not in known:
            raise _unknown(prefix, name, known)
    changes = {
        name: _value(hints[name], value, f"{prefix}{name}", getattr(config, name))
        for name, value in values.items()
    }
    return replace(config, **changes)


def _unknown(prefix: str, name: str, known: set[str]) -> ConfigError:
    like = suggestion(name, known)
    hint = f"did you mean '{prefix}{like}'?" if like else f"known: {', '.join(sorted(known))}"
    return ConfigError(f"unknown setting '{prefix}{name}'; {hint}")


_PLAIN: Final[dict[object, str]] = {str: "a text", bool: "true or false", int: "a whole number"}


def _value(hint: Any, value: Any, name: str, default: Any = None) -> Any:
    """A value of the type that a setting has."""
    if is_dataclass(hint):
        return _table(hint, value, name, default)
    if get_origin(hint) is Mapping:
        check(isinstance(value, Mapping), name, value, f"a table [{name}]")
        inner = get_args(hint)[1]
        return {str(key): _value(inner, one, f'{name}."{key}"') for key, one in value.items()}
    if hint is float:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        check(number and math.isfinite(value), name, value, "a number")
        return float(value)
    if hint in _PLAIN:
        check(type(value) is hint, name, value, _PLAIN[hint])
        return value
    check(isinstance(value, (list, tuple)), name, value, "a list")
    return tuple(_value(get_args(hint)[0], item, f"{name}[{i}]") for i, item in enumerate(value))


def _table(cls: Any, value: Any, name: str, default: Any) -> Any:
    if isinstance(value, cls):
        return value
    check(isinstance(value, Mapping), name, value, f"a table [{name}]")
    prefix = f"{name}."
    return _built(cls, value, prefix) if default is None else _changed(default, value, prefix)


def _built(cls: Any, values: Mapping[str, Any], prefix: str) -> Any:
    """A record all of whose parts that have no default are named."""
    hints = get_type_hints(cls)
    for name in values:
        if name not in hints:
            raise _unknown(prefix, name, set(hints))
    for part in fields(cls):
        given = part.name in values or part.default is not MISSING
        check(given, f"{prefix}{part.name}", None, "a value")
    return cls(**{name: _value(hints[name], v, f"{prefix}{name}") for name, v in values.items()})
