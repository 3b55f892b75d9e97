"""What a client can set: Table I of the paper and more, validated, in TOML in and out.

A :class:`Config` is a value: two configs that are equal give equal graphs. It is recorded with every
trace that was ingested with it. It comes from a TOML file (:func:`load`), from plain values
(:func:`from_dict`), from keyword arguments (:func:`configured`), or from a preset (:func:`preset`).
"""

from __future__ import annotations

from sgstore.config.presets import PRESETS, Preset, preset
from sgstore.config.printing import as_markdown, as_toml
from sgstore.config.reading import MAX_CONFIG_BYTES, configured, from_dict, load
from sgstore.config.settings import (
    ALL_EGOS,
    Config,
    Direction,
    Lanes,
    Pairs,
    Payloads,
    Proximity,
    Range,
)

__all__ = [
    "ALL_EGOS",
    "MAX_CONFIG_BYTES",
    "PRESETS",
    "Config",
    "Direction",
    "Lanes",
    "Pairs",
    "Payloads",
    "Preset",
    "Proximity",
    "Range",
    "as_markdown",
    "as_toml",
    "configured",
    "from_dict",
    "load",
    "preset",
]
