"""Presets of the settings: the default, and presets that reproduce other tools."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.errors import ConfigError
from sgstore.model.config._settings import (
    Config,
    Direction,
    LaneSettings,
    PairSettings,
    Proximity,
    RangeSettings,
)
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


_MET_BY_CARLASGG: Final = ("Person", "Bicycle", "Car", "Motorcycle", "Bus", "Train", "Truck")

_CARLASGG: Final = Config(
    range=RangeSettings(
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
    pairs=PairSettings(
        within=0.0,
        ego_within=25.0,
        kinds=tuple(("Ego", kind) for kind in _MET_BY_CARLASGG),
    ),
    lanes=LaneSettings(ahead=50.0, types=("driving",), sections=False),
    sees=False,
    kinds=(
        *("Car", "Truck", "Van", "Bus", "Motorcycle", "Bicycle", "Person"),
        *("TrafficLight", "StopSign", "YieldSign", "SpeedLimit", "Sign"),
        *("Lane", "Road", "Junction", "OffRoad"),
    ),
    without=("leads", "follows", "overlaps", "sees", "tows"),
)

_ROADSCENE2VEC: Final = Config(
    proximity=Proximity(
        names=("near_coll", "super_near", "very_near", "near", "visible"),
        upper=(4.0, 7.0, 10.0, 16.0, 25.0),
    ),
    direction=Direction(ties="both"),
    pairs=PairSettings(
        within=0.0,
        ego_within=25.0,
        kinds=(("Ego", "Vehicle"), ("Ego", "Person"), ("Ego", "Signal")),
    ),
    sees=False,
    without=("leads", "follows", "overlaps", "sees", "tows"),
)

_OF_CARLASGG: Final = """\
* *Imitated.* The rectangle, 50 m ahead, 2 m behind, 25 m to each side; in it count the footprints of
  what moves and the centres of what stands. The rule that keeps roads of other storeys out (less than 2
  m higher or lower, or a grade of less than 0.1), for the map alone. Distances between the origins of
  actors. Which bearing is what, and who has the ties; what is dead ahead or dead behind is to the left.
  Relations of the ego with people, bicycles, cars, motorcycles, buses, trains and trucks up to 25 m, and
  of nobody else; vans it leaves out. Lanes of type driving alone, whatever their section, and `off_road`
  for what touches none of them.
* *Defects, not imitated.* It has no lane changes, although its documentation promises them. Its lanes
  stick out by 1 m beyond their ends and beside their bends, and stop up to 2 m short of their ends. Of
  lanes that begin in one place, one seems to lead to the others. A traffic light is there twice, as a
  pole and as a landmark. What has no edge to a lane is "Off Road", lights and signs too. An entity is in
  the lanes of every storey above and below it.
* `python -m bench.against_carlasgg TRACE ORACLE` counts all of it against graphs that CARLASGG itself
  made; its exit status is 1 where a row falls below its mark or a difference has no cause.
"""

_OF_ROADSCENE2VEC: Final = """\
* On a bound of two directions both hold. Of the distances one holds, the nearest, as there.
* Relations of the ego alone, up to 25 m, with what RoadScene2Vec knows: cars (whatever is as large, trams
  too), motorcycles, bicycles, people, lights and signs.
* The settings are those of relations. Its three lanes, and left and right by them, are what the abstraction
  `roadscene2vec` makes of any graph, ingested with whatever settings.
"""

PRESETS: Final[Mapping[str, Preset]] = {
    "default": Preset(
        "All round the ego, all kinds, all lane types, storeys kept apart, numbers kept.",
        "",
        Config(),
    ),
    "carlasgg": Preset(
        "The graphs of CARLASGG as its code computes them, without its defects.",
        _OF_CARLASGG,
        _CARLASGG,
    ),
    "roadscene2vec": Preset(
        "The relations and thresholds of RoadScene2Vec, whose bins hold both their bounds.",
        _OF_ROADSCENE2VEC,
        _ROADSCENE2VEC,
    ),
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
