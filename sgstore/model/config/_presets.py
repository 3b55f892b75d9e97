"""Presets of the settings: the default, and presets that reproduce other tools."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Final

from sgstore.errors import ConfigError
from sgstore.model.config._settings import Config
from sgstore.model.config._values import changed
from sgstore.model.vocabulary import suggestion

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class Preset:
    """Named set of settings for the scene graph generator, with a description.

    Attributes
    ----------
    summary : str
        Description in one line.
    notes : str
        Notes for users, as lines of Markdown.
    config : Config
    """

    summary: str
    notes: str
    config: Config


_FILE: Final = resources.files("sgstore.model.config").joinpath("presets.toml")

PRESETS: Final[Mapping[str, Preset]] = {
    name: Preset(one["summary"], one["notes"], changed(Config(), one.get("settings", {}), ""))
    for name, one in tomllib.loads(_FILE.read_text(encoding="utf-8")).items()
}
"""All presets by name."""


def preset(name: str) -> Config:
    """Return the settings of a preset by name.

    Raises
    ------
    ConfigError
        The preset does not exist.
    """
    if name not in PRESETS:
        like = suggestion(name, PRESETS)
        hint = f"did you mean '{like}'?" if like else f"there are {', '.join(PRESETS)}"
        raise ConfigError(f"no preset '{name}'; {hint}")
    return PRESETS[name].config
