"""Reading of settings from TOML files, plain values and keyword arguments."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import ConfigError
from sgstore.model.config._presets import preset
from sgstore.model.config._settings import Config
from sgstore.model.config._values import changed, check

if TYPE_CHECKING:
    from collections.abc import Mapping


MAX_CONFIG_BYTES: Final = 1 << 20


def load(path: str | Path) -> Config:
    """Read settings from a TOML file. Missing settings come from the file's preset, or keep their defaults.

    Raises
    ------
    ConfigError
        The file is not readable, is not TOML, or has an unknown or invalid setting.
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
    """Return the settings for a dict of plain values.

    Parameters
    ----------
    values : mapping
        Values as in TOML and JSON. ``preset`` names the preset for missing settings; without it, the defaults
        apply.

    Raises
    ------
    ConfigError
        A setting is unknown, of the wrong type, or out of range.
    """
    values = dict(values)
    name = values.pop("preset", "")
    check(isinstance(name, str), "preset", name, "the name of a preset")
    return changed(preset(name) if name else Config(), values, "")


def configured(**settings: Any) -> Config:
    """Return the settings for keyword arguments. Each table is given as a mapping or as an object.

    ::

        configured(preset="carlasgg", range={"front": 80}, pairs=PairSettings(within=0), rate=2)

    Raises
    ------
    ConfigError
        See :func:`from_dict`.
    """
    return from_dict(settings)
