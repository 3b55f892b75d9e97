"""Configs with names: the default, and those that do what other tools do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.config.settings import Config, Direction, Lanes, Pairs, Proximity, Range
from sgstore.errors import ConfigError
from sgstore.vocabulary import suggestion

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class Preset:
    """A config with a name.

    Attributes
    ----------
    summary : str
        What it is, in a line.
    notes : tuple of str
        What is to be known of it.
    config : Config
    """

    summary: str
    notes: tuple[str, ...]
    config: Config


_CARLASGG: Final = Config(
    range=Range(
        shape="rectangle",
        front=50.0,
        rear=2.0,
        side=25.0,
        static_by="centre",
        height=(-2.0, 2.0),
        grade=0.1,
        height_of_entities=False,
    ),
    proximity=Proximity(between="origins"),
    direction=Direction(ties="carlasgg", sides="closed"),
    pairs=Pairs(
        within=0.0,
        ego_within=25.0,
        kinds=tuple(
            ("Ego", label)
            for label in ("Person", "Bicycle", "Car", "Motorcycle", "Bus", "Train", "Truck")
        ),
    ),
    lanes=Lanes(ahead=50.0, types=("driving",)),
    sees=False,
    kinds=(
        *("Car", "Truck", "Van", "Bus", "Motorcycle", "Bicycle", "Person"),
        *("TrafficLight", "StopSign", "YieldSign", "SpeedLimit", "Sign"),
        *("Lane", "Road", "Junction", "OffRoad"),
    ),
    without=("leads", "follows", "overlaps", "sees"),
)

_ROADSCENE2VEC: Final = Config(
    proximity=Proximity(
        names=("near_coll", "super_near", "very_near", "near", "visible"),
        upper=(4.0, 7.0, 10.0, 16.0, 25.0),
        between="origins",
    ),
    direction=Direction(ties="both"),
    pairs=Pairs(
        within=0.0,
        ego_within=25.0,
        kinds=tuple(
            ("Ego", label)
            for label in ("Car", "Motorcycle", "Bicycle", "Person", "TrafficLight", "Sign")
        ),
    ),
    sees=False,
    without=("leads", "follows", "overlaps", "sees"),
)

PRESETS: Final[Mapping[str, Preset]] = {
    "default": Preset(
        "All round the ego, all kinds, all lane types, storeys kept apart, numbers kept.",
        (),
        Config(),
    ),
    "carlasgg": Preset(
        "The relations of CARLASGG as its code computes them.",
        (),
        _CARLASGG,
    ),
    "roadscene2vec": Preset(
        "The thresholds of RoadScene2Vec, whose bins hold both their bounds.",
        (),
        _ROADSCENE2VEC,
    ),
}
"""All presets by name."""


def preset(name: str) -> Config:
    """The config of a preset.

    Raises
    ------
    ConfigError
        There is no such preset.
    """
    if name not in PRESETS:
        like = suggestion(name, PRESETS)
        hint = f"did you mean '{like}'?" if like else f"there are {', '.join(PRESETS)}"
        raise ConfigError(f"no preset '{name}'; {hint}")
    return PRESETS[name].config
