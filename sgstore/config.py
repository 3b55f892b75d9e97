"""What a client can set: Table I of the paper and more, validated, in TOML in and out.

A :class:`Config` is a value: two configs that are equal give equal graphs. It is recorded with every
trace that was ingested with it.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Final, get_args, get_type_hints

from sgstore.errors import ConfigError
from sgstore.vocabulary import DIRECTIONS, PROXIMITY, suggestion


@dataclass(frozen=True, slots=True)
class Range:
    """Which part of the world is in the graph of an ego.

    Attributes
    ----------
    radius : float
        Everything whose footprint comes within this distance of the ego's centre; m.
    """

    radius: float = 50.0

    def __post_init__(self) -> None:
        _check(
            0 < self.radius < math.inf, "range.radius", self.radius, "a length above 0, in metres"
        )


@dataclass(frozen=True, slots=True)
class Proximity:
    """Distance relations: the first whose upper bound is not exceeded holds, so exactly one or none.

    Attributes
    ----------
    names : tuple of str
        Relations from the nearest to the farthest.
    upper : tuple of float
        Their upper bounds, included, ascending; m. The lower bound of each is the upper one of the
        relation before it, not included; the nearest begins at 0. Distances are from centre to centre, in 3-D.
    """

    names: tuple[str, ...] = PROXIMITY
    upper: tuple[float, ...] = (2.0, 4.0, 7.0, 10.0, 16.0, 25.0)

    def __post_init__(self) -> None:
        _check_steps("proximity", self.names, self.upper, PROXIMITY, len(self.names))


@dataclass(frozen=True, slots=True)
class Direction:
    """Direction relations: the first whose upper bound the absolute bearing does not exceed; else the last.

    Attributes
    ----------
    names : tuple of str
        Relations from ahead to behind.
    upper : tuple of float
        Upper bounds of all but the last, included, ascending; degrees.
    """

    names: tuple[str, ...] = DIRECTIONS
    upper: tuple[float, ...] = (45.0, 90.0, 135.0)

    def __post_init__(self) -> None:
        _check_steps("direction", self.names, self.upper, DIRECTIONS, max(len(self.names) - 1, 0))
        within = all(bound < 180 for bound in self.upper)
        _check(within, "direction.upper", self.upper, "bounds below 180, in degrees")


@dataclass(frozen=True, slots=True)
class Pairs:
    """Which pairs of entities are related to one another.

    Attributes
    ----------
    within : float
        All entities that move, up to this distance between their centres; m. 0: none.
    ego : bool
        The ego with everything in range, whatever the distance.
    static : bool
        Entities that never move with one another too, up to the same distance.
    """

    within: float = 25.0
    ego: bool = True
    static: bool = False

    def __post_init__(self) -> None:
        _check(
            0 <= self.within < math.inf,
            "pairs.within",
            self.within,
            "a length of 0 or more, in metres",
        )


@dataclass(frozen=True, slots=True)
class Lanes:
    """What is asked of the lanes beyond those that an entity is in.

    Attributes
    ----------
    ahead : float
        How far along the lanes the next one ahead is looked for, and how far upstream of a signal lanes may
        be affected by it; m. 0: neither, so that nothing is known of them.
    """

    ahead: float = 100.0

    def __post_init__(self) -> None:
        known = 0 <= self.ahead < math.inf
        _check(known, "lanes.ahead", self.ahead, "a length of 0 or more, in metres")


@dataclass(frozen=True, slots=True)
class Payloads:
    """How sensor messages are joined to frames.

    Attributes
    ----------
    join : str
        ``nearest`` in log time, or ``latest`` at or before the frame.
    tolerance : float
        Greatest difference of log times; s. 0: half the median period of the channel, or of the frames if
        that is longer (``nearest``), the whole of it (``latest``).
    """

    join: str = "nearest"
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        _check(
            self.join in {"nearest", "latest"}, "payloads.join", self.join, "'nearest' or 'latest'"
        )
        waits = 0 <= self.tolerance < math.inf
        _check(waits, "payloads.tolerance", self.tolerance, "0 or more seconds")


@dataclass(frozen=True, slots=True)
class Config:
    """All settings of a scene graph generator.

    Attributes
    ----------
    range, proximity, direction, pairs, lanes, payloads
        See there.
    ego : str
        The simulator's id, role or name of the ego; empty: as the trace says.
    sees : bool
        Whether it is computed what the ego sees; otherwise nothing is known of it.
    """

    range: Range = field(default_factory=Range)
    proximity: Proximity = field(default_factory=Proximity)
    direction: Direction = field(default_factory=Direction)
    pairs: Pairs = field(default_factory=Pairs)
    lanes: Lanes = field(default_factory=Lanes)
    payloads: Payloads = field(default_factory=Payloads)
    ego: str = ""
    sees: bool = True

    def as_dict(self) -> dict[str, Any]:
        """The settings as plain values, as they stand in TOML and JSON."""
        return asdict(self)


MAX_CONFIG_BYTES: Final = 1 << 20


def load(path: str | Path) -> Config:
    """The config in a TOML file; what the file does not name keeps its default.

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
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from error
    try:
        return from_dict(values)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def from_dict(values: dict[str, Any]) -> Config:
    """The config that plain values describe; what they do not name keeps its default.

    Raises
    ------
    ConfigError
        A setting is unknown, of the wrong type, or out of range.
    """
    return _build(Config, values, "")


def _build(cls: type[Any], values: dict[str, Any], prefix: str) -> Any:
    hints = get_type_hints(cls)
    known = {f.name for f in fields(cls)}
    for name in values:
        if name not in known:
            like = suggestion(name, known)
            hint = (
                f"did you mean '{prefix}{like}'?" if like else f"known: {', '.join(sorted(known))}"
            )
            raise ConfigError(f"unknown setting '{prefix}{name}'; {hint}")
    return cls(**{name: _value(hints[name], v, f"{prefix}{name}") for name, v in values.items()})


_PLAIN: Final[dict[object, str]] = {str: "a text", bool: "true or false", int: "a whole number"}


def _value(hint: Any, value: Any, name: str) -> Any:
    if is_dataclass(hint):
        _check(isinstance(value, dict), name, value, f"a table [{name}]")
        return _build(hint, value, f"{name}.")  # pyright: ignore[reportArgumentType]
    if hint is float:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        _check(number and math.isfinite(value), name, value, "a number")
        return float(value)
    if hint in _PLAIN:
        _check(type(value) is hint, name, value, _PLAIN[hint])
        return value
    _check(isinstance(value, (list, tuple)), name, value, "a list")
    return tuple(_value(get_args(hint)[0], item, f"{name}[{i}]") for i, item in enumerate(value))


def _check(holds: bool, name: str, value: object, right: str) -> None:  # noqa: FBT001
    if not holds:
        raise ConfigError(f"setting '{name}' is {value!r}; expected {right}")


def _check_steps(
    name: str, names: tuple[str, ...], upper: tuple[float, ...], known: tuple[str, ...], bounds: int
) -> None:
    for relation in names:
        _check(relation in known, f"{name}.names", relation, f"one of {', '.join(known)}")
    _check(len(set(names)) == len(names), f"{name}.names", names, "each name once")
    _check(len(upper) == bounds, f"{name}.upper", upper, f"{bounds} bounds for {len(names)} names")
    rising = all(a < b < math.inf for a, b in zip((0.0, *upper), upper, strict=False))
    _check(rising, f"{name}.upper", upper, "ascending bounds above 0")
