"""CommonRoad scenarios, read like MCAP files: a map message, and a message per time step.

A scenario contains each obstacle with all of its states. The file is therefore read as a whole at the first
access. Its messages are JSON and always the same. The first one is the road map as a text of lanes; each
further one contains one step. In a clip, these are the messages of an MCAP file, which is read like the
scenario itself.
"""

from __future__ import annotations

import json
import math
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import MapError, TraceError
from sgstore.mcap import mark_of_open, open_regular
from sgstore.readers._file import NumberedFile, first_bytes
from sgstore.readers.commonroad._document import (
    MAX_BYTES,
    ROOT,
    Obstacle,
    TrafficScenario,
    read_scenario,
)
from sgstore.readers.commonroad._lanelets import light_place, map_text, meaning_of

if TYPE_CHECKING:
    from pathlib import Path

ENDINGS: Final = (".xml",)
"""Suffixes of scenario files. :func:`is_scenario` also checks their content."""
MAP: Final = "commonroad.Map"
STEP: Final = "commonroad.Step"
"""Names of the message schemas of time steps and of the map."""
NAME: Final = "scenario"
"""Metadata key for the name of the scenario."""

_HEAD: Final = 4096


def is_scenario(path: Path) -> bool:
    """Return True if a file is a CommonRoad scenario, by its suffix and first XML element."""
    return f"<{ROOT}".encode() in first_bytes(path, ENDINGS, _HEAD)


class CommonRoadFile(NumberedFile):
    """CommonRoad scenario that can be read like an MCAP file (log of messages).

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    path, size, mtime_ns
        The file, its size in bytes, its modification time.
    schemas, channels : dict
        ``/commonroad/map`` and ``/commonroad/steps``, with their schemas.
    counts : dict
        Number of messages by channel.

    Raises
    ------
    TraceError
        The file cannot be opened, or is not a scenario.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with open_regular(path) as file:
            self.size, self.mtime_ns = mark_of_open(file)
            if self.size > MAX_BYTES:
                raise TraceError(
                    f"larger than {MAX_BYTES:,} bytes, which no scenario is", path=path
                )
            data = file.read(MAX_BYTES + 1)
        try:
            self._scenario = read_scenario(data)
            self._map = map_text(self._scenario).encode()
        except (TraceError, MapError) as error:
            raise TraceError(str(error), path=path) from error
        self._steps = _steps(self._scenario)
        self._standing = [one for one in self._scenario.obstacles.values() if one.static]
        about = {NAME: self._scenario.name or path.stem}
        named = {"/commonroad/map": MAP} if self._map else {}
        named["/commonroad/steps"] = STEP
        self.add_channels(
            named, len(self._steps), about, {name: _schema(name) for name in (MAP, STEP)}
        )
        self.losses += self._scenario.lost
        if self._scenario.more_lost:
            self.losses.append(f"{self._scenario.more_lost} more of the same kinds")

    def message(self, number: int) -> bytes:
        """Return the bytes of a message, given its number: 0 is the map, the others are time steps.

        Raises
        ------
        IndexError
            The number is too large.
        """
        if number == 0:
            return self._map
        standing = self._standing if number == 1 else []
        return _step_message(self._scenario, self._steps[number - 1], standing)

    def time_of(self, number: int) -> int:
        """Return the time of a time step, given its number (from 1); ns."""
        return round(self._steps[number - 1] * self._scenario.step * 1e9)


def _steps(scenario: TrafficScenario) -> list[int]:
    """Return the time steps of a scenario with obstacle states, in order.

    A scenario with only static obstacles, or only lanelets, has one step.
    """
    moving = {step for one in scenario.obstacles.values() if not one.static for step in one.states}
    if not moving and (scenario.obstacles or scenario.lanelets):
        return [0]
    return sorted(moving)


def _step_message(scenario: TrafficScenario, step: int, standing: list[Obstacle]) -> bytes:
    """Return the obstacle and light states of a time step as JSON, without unknown values."""
    told = {
        "time": round(step * scenario.step, 9),
        "step": step,
        "obstacles": [
            _obstacle(one, step)
            for one in scenario.obstacles.values()
            if not one.static and step in one.states
        ],
    }
    if scenario.lights:
        lights = ((one, light_place(scenario, one)) for one in scenario.lights.values())
        told["lights"] = [
            {"id": light.ident, **_placed(place), "state": light.shows(step)}
            for light, place in lights
            if place is not None and light.ident not in scenario.obstacles
        ]
    if standing:
        told["standing"] = [_obstacle(one, next(iter(one.states))) for one in standing]
    if step == _steps_first(scenario):
        told["signs"] = [
            {"id": sign.ident, **_placed(sign.place), **_about(meaning_of(sign))}
            for sign in scenario.signs.values()
            if sign.place is not None and not sign.virtual and sign.ident not in scenario.obstacles
        ]
    return json.dumps(told, allow_nan=False, separators=(",", ":")).encode()


def _steps_first(scenario: TrafficScenario) -> int:
    return min(
        (min(one.states) for one in scenario.obstacles.values() if not one.static), default=0
    )


def _obstacle(one: Obstacle, step: int) -> dict[str, Any]:
    state, body = one.states[step], one.body
    heading = state.heading
    cos, sin = (1.0, 0.0) if math.isnan(heading) else (math.cos(heading), math.sin(heading))
    moves = not math.isnan(heading)
    across = 0.0 if math.isnan(state.across) else state.across
    sideways = state.along * state.yaw_rate
    sideways = 0.0 if math.isnan(sideways) else sideways
    found = {
        "x": state.x + body.ahead * cos - body.left * sin,
        "y": state.y + body.ahead * sin + body.left * cos,
        "z": state.z,
        "heading": heading + body.turn,
        "length": body.length,
        "width": body.width,
        "vx": state.along * cos - across * sin if moves else math.nan,
        "vy": state.along * sin + across * cos if moves else math.nan,
        "ax": state.acceleration * cos - sideways * sin if moves else math.nan,
        "ay": state.acceleration * sin + sideways * cos if moves else math.nan,
        "yaw_rate": state.yaw_rate,
    }
    told: dict[str, Any] = {"id": one.ident, "type": one.type}
    told |= {key: value for key, value in found.items() if math.isfinite(value)}
    if step in one.lights:
        told["signals"] = list(one.lights[step])
    return told


def _placed(place: tuple[float, float, float] | None) -> dict[str, float]:
    return dict(zip("xyz", place, strict=True)) if place else {}


def _about(meaning: Any) -> dict[str, str]:
    return {"kind": meaning.kind, **({"subkind": meaning.subkind} if meaning.subkind else {})}


@cache
def _schema(name: str) -> bytes:
    """Return the JSON schema of the messages made from a scenario, for viewers."""
    number, text = {"type": "number"}, {"type": "string"}
    box = dict.fromkeys(("x", "y", "z", "heading", "length", "width"), number)
    motion = dict.fromkeys(("vx", "vy", "ax", "ay", "yaw_rate"), number)
    thing = {"type": "object", "properties": {"id": text, "type": text, **box, **motion}}
    parts: dict[str, Any] = {"time": number, "step": {"type": "integer"}}
    for key in ("obstacles", "standing", "lights", "signs"):
        parts[key] = {"type": "array", "items": thing}
    if name == MAP:
        parts = {"format": text, "version": number, "lanes": {"type": "array"}}
    return json.dumps({"title": name, "type": "object", "properties": parts}).encode()
