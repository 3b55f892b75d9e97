"""CommonRoad scenarios with the interface of an MCAP file: one map message, and one message per time step.

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

from mcap.records import Schema

from sgstore.errors import MapError, TraceError
from sgstore.mcap import Loss, mark_of_open, open_regular
from sgstore.readers._file import MessageFile, held_messages
from sgstore.readers.commonroad._document import (
    MAX_BYTES,
    ROOT,
    Obstacle,
    TrafficScenario,
    read_scenario,
)
from sgstore.readers.commonroad._lanelets import light_place, map_text, meaning_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from sgstore.mcap import Findings, Messages

ENDINGS: Final = (".xml",)
"""Suffixes of such files; :func:`is_scenario` checks the contents."""
MAP: Final = "commonroad.Map"
STEP: Final = "commonroad.Step"
"""Schemas of the messages."""
NAME: Final = "scenario"
"""Key of the scenario name in the metadata of a channel."""

_MAP_CHANNEL, _STEP_CHANNEL = 1, 2
_HEAD: Final = 4096
_RUN: Final = 256
"""Maximum number of messages in a run."""


def is_scenario(path: Path) -> bool:
    """Return True if a file is a CommonRoad scenario, by its suffix and first XML element."""
    if not path.name.lower().endswith(ENDINGS):
        return False
    try:
        with open_regular(path) as file:
            return f"<{ROOT}".encode() in file.read(_HEAD)
    except (OSError, TraceError):
        return False


class CommonRoadFile(MessageFile):
    """CommonRoad scenario with the interface of an MCAP file (log of messages).

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
        for number, name, topic in (
            (_MAP_CHANNEL, MAP, "/commonroad/map"),
            (_STEP_CHANNEL, STEP, "/commonroad/steps"),
        ):
            schema = Schema(id=number, data=_schema(name), encoding="jsonschema", name=name)
            self.schemas[number] = schema
            if self._map or number != _MAP_CHANNEL:
                self.add_channel(topic, schema, "json", about)
        self.counts = {_STEP_CHANNEL: len(self._steps)}
        if self._map:
            self.counts[_MAP_CHANNEL] = 1

    def _walk(self, report: Findings, wanted: Callable[[int], bool]) -> Iterator[Messages]:
        """Yield all messages of the scenario: the map, then one per time step.

        The ``offset`` of a message is its number.
        """
        for reason in self._scenario.lost:
            report.lose(Loss(reason, bytes=0))
        if self._scenario.more_lost:
            report.lose(Loss(f"{self._scenario.more_lost} more of the same kinds", bytes=0))
        if not wanted(-1):
            return
        if self._map:
            yield self._messages(range(1))
        total = len(self._steps) + 1
        for start in range(1, total, _RUN):
            yield self._messages(range(start, min(start + _RUN, total)))

    def message(self, number: int) -> bytes:
        """Return the bytes of a message by number: 0 is the map, followed by the time steps.

        Raises
        ------
        IndexError
            The number is too large.
        """
        if number == 0:
            return self._map
        standing = self._standing if number == 1 else []
        return _step_message(self._scenario, self._steps[number - 1], standing)

    def _messages(self, numbers: range) -> Messages:
        held = {number: self.message(number) for number in numbers}
        return held_messages(
            held,
            [self._time(number) for number in numbers],
            channel=[_STEP_CHANNEL if number else _MAP_CHANNEL for number in numbers],
            sequence=[max(number - 1, 0) for number in numbers],
        )

    def _time(self, number: int) -> int:
        """Return the time of a message; ns. The map has the time of the first step."""
        steps = self._steps
        step = steps[max(number - 1, 0)] if steps else 0
        return round(step * self._scenario.step * 1e9)


def read_messages(path: Path, places: Iterable[tuple[int, int, int]]) -> Iterator[bytes]:
    """Yield the bytes of messages of a scenario, by their offsets and lengths.

    See :meth:`CommonRoadFile.walk`.

    Raises
    ------
    TraceError
        The file cannot be read, or a message does not match, because the file was replaced.
    """
    with CommonRoadFile(path) as recording:
        for _, offset, length in places:
            try:
                data = recording.message(offset) if offset >= 0 else b""
            except IndexError:
                data = b""
            if len(data) != length or not data:
                reason = f"no message of {length} bytes at {offset} there: the file was replaced"
                raise TraceError(reason, path=path)
            yield data


def _steps(scenario: TrafficScenario) -> list[int]:
    """Return the time steps of a scenario with obstacle states, in order.

    A scenario with only static obstacles has one step.
    """
    moving = {step for one in scenario.obstacles.values() if not one.static for step in one.states}
    if not moving and scenario.obstacles:
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
