"""Settings of the scene graph generator, with defaults, limits and comments; read from and written to TOML."""

from sgstore.model.config._files import MAX_CONFIG_BYTES, configured, from_dict, load
from sgstore.model.config._presets import PRESETS, preset
from sgstore.model.config._settings import (
    ALL_EGOS,
    Config,
    Direction,
    LaneSettings,
    PairSettings,
    Payloads,
    Proximity,
    RangeSettings,
    Signs,
)
from sgstore.model.config._text import as_markdown, as_toml

__all__ = [
    "ALL_EGOS",
    "MAX_CONFIG_BYTES",
    "PRESETS",
    "Config",
    "Direction",
    "LaneSettings",
    "PairSettings",
    "Payloads",
    "Proximity",
    "RangeSettings",
    "Signs",
    "as_markdown",
    "as_toml",
    "configured",
    "from_dict",
    "load",
    "preset",
]
