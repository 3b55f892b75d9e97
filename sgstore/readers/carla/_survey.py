"""The first reading of a CARLA recording: what must be known before its frames can be read.

What an object is stands in the list of actors, which may come once and late, as may the places of lights and
the map. All of that is gathered when a recording is opened.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.readers._base import LossTally, Ref, ref_of
from sgstore.readers._ros2 import ColumnReader, decode, number, records, text
from sgstore.readers.carla._actors import (
    ACTORS,
    FOR_FRAMES,
    LASTING,
    LIGHT_PLACES,
    LIGHT_STATES,
    MAX_IDENT,
    OBJECTS,
    ODOMETRY,
    OF_ONE_VEHICLE,
    TEXT,
    VEHICLE,
    WORLD,
    Actor,
    Egos,
    content_of,
    ident_of,
    role_in,
    stamp_of,
    structure,
)
from sgstore.readers.carla._signals import read_places
from sgstore.world import TraceReport

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.mcap import Messages, Recording
    from sgstore.readers._ros2 import Struct
    from sgstore.readers.carla._signals import Light
    from sgstore.world import Floats


BEGINNING: Final = 1_000_000_000
"""How long after the first frame a message still comes with it; ns of log time."""
SAME_TICK: Final = 1_000_000
"""Greatest difference of the stamps of one instant, which the bridge cuts off unevenly; ns."""
SAME_PLACE: Final = 0.01
"""How far an object may be from the odometry of the vehicle that it is; m."""

_PLACES: Final = ("id", "pose.position.x", "pose.position.y", "pose.position.z")
_ODOMETRY: Final = tuple(f"pose.{path}" for path in _PLACES[1:])
_MAP_BEGINS: Final = 4096
_MOST_TRIES: Final = 200
_MOST_NOTES: Final = 100


@dataclass(slots=True)
class CarlaLead:
    """A channel that may lead: how many frames it has, their bytes, and their least log time."""

    frames: int = 0
    bytes: int = 0
    first_ns: int = (1 << 63) - 1


@dataclass(slots=True)
class _Whereabouts:
    """Places of the vehicles with a role, to find them among objects that no list of actors names.

    ``objects``: stamp, ids and places of those of the last frame; ``tries``: how often it was attempted.
    """

    odometry: dict[str, tuple[int, Floats]] = field(default_factory=dict[str, "tuple[int, Floats]"])
    objects: tuple[int, Floats] = (0, np.zeros((0, 4)))
    tries: int = 0

    def found(self) -> dict[str, int]:
        """Role → id of the only object that is where its odometry says, at the same instant."""
        stamp, table = self.objects
        self.tries += 1
        ids: dict[str, int] = {}
        for role, (when, place) in self.odometry.items():
            near = np.abs(table[:, 1:] - place).max(axis=1, initial=0) <= SAME_PLACE
            if abs(when - stamp) <= SAME_TICK and near.sum() == 1:
                ids[role] = int(table[near, 0][0])
        return ids


class CarlaSurvey:
    """Findings of the first reading of a recording.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id or role name that the user gave for the ego; empty: as the recording says.

    Attributes
    ----------
    contents : dict
        Channel id → what its messages are (:mod:`sgstore.readers.carla._actors`).
    structures : dict
        Channel id → structure of its messages.
    leads : dict
        Channel id → :class:`CarlaLead`, of the channels with objects.
    egos : Egos
        With the actors of the recording.
    lights : dict
        Id → :class:`~sgstore.readers.carla._signals.Light`.
    map_text, map_name : str
    notes : list of str
        What is odd but lost nothing.
    lost : LossTally
        What could not be used.

    Raises
    ------
    TraceError
        The file cannot be read.
    """

    def __init__(self, recording: Recording, ego: str) -> None:
        self.contents: dict[int, str] = {}
        self.structures: dict[int, Struct] = {}
        self.leads: dict[int, CarlaLead] = {}
        self.egos = Egos(ego)
        self.lights: dict[int, Light] = {}
        self.map_text = ""
        self.map_name = ""
        self.notes: list[str] = []
        self.lost = LossTally()
        self._recording = recording
        self._tables: dict[int, ColumnReader] = {}
        self._whereabouts = _Whereabouts()
        self._last: dict[int, bytes] = {}
        self._lasting: list[Ref] = []
        self._others: dict[int, tuple[int, Ref]] = {}
        walk = recording.walk(TraceReport(), keep=lambda channel: self._meet(channel) in FOR_FRAMES)
        for run in walk:  # what it loses is reported when frames are read
            self._look_at(run)

    @property
    def leading(self) -> int | None:
        """The channel with most frames, then with most in them; ``None`` if none has any."""
        ranked = [(lead.frames, lead.bytes, -channel) for channel, lead in self.leads.items()]
        best = max(ranked, default=(0, 0, 0))
        return -best[2] if best[0] else None

    @property
    def driven(self) -> dict[int, str]:
        """Channel id → role name of the vehicle, of the channels that are of a single vehicle."""
        return {
            channel: role_in(self.topic(channel))
            for channel, content in self.contents.items()
            if content in OF_ONE_VEHICLE
        }

    def topic(self, channel: int) -> str:
        """The topic of a channel."""
        return self._recording.channels[channel].topic

    def context(self, leading: int) -> list[Ref]:
        """Messages that later ones depend on.

        Those that tell what lasts, where it was not told just so before; and the only message of a channel if
        it comes with the first frame, such as the calibration of a camera.
        """
        latest = self.leads[leading].first_ns + BEGINNING
        once = [ref for count, ref in self._others.values() if count == 1 and ref[1] <= latest]
        return [*self._lasting, *once]

    # One run of messages -----------------------------------------------------------------------------

    def _look_at(self, run: Messages) -> None:
        counts = np.bincount(run.channel)
        watched = np.zeros(len(counts), np.bool_)
        for channel in np.flatnonzero(counts).tolist():
            content = self._meet(channel)
            if content == OBJECTS:
                self._count(channel, run)
            if content not in LASTING | {OBJECTS}:
                before, ref = self._others.get(channel) or (0, _first(run, channel))
                self._others[channel] = (before + int(counts[channel]), ref)
            watched[channel] = self._is_watched(channel, content)
        for row in np.flatnonzero(watched[run.channel]).tolist():
            try:
                self._look(run, row)
            except TraceError as error:
                self._lose(run, row, error)

    def _meet(self, channel: int) -> str:
        """Kind of content that the messages of a channel have; empty if they are of no concern."""
        if channel not in self.contents:
            self.contents[channel] = content = content_of(self._recording, channel)
            try:
                self._learn(channel, content)
            except TraceError as error:
                self.contents[channel] = ""
                reason = f"channel {self.topic(channel)!r}: {error.reason}"
                if content:
                    self.lost.add(reason, 0)
                else:
                    self._note(f"{reason}; its messages can only be handed on as they are")
        return self.contents[channel]

    def _learn(self, channel: int, content: str) -> None:
        """Learn the structure of a channel's messages, if these are ROS messages."""
        found = structure(self._recording, channel)
        if found is None:
            return
        self.structures[channel] = found
        if content == OBJECTS:
            self._tables[channel] = ColumnReader(found, "objects", _PLACES)
            self.leads[channel] = CarlaLead()

    def _is_watched(self, channel: int, content: str) -> bool:
        if content == TEXT:
            return channel not in self._last  # a text that is no map is not looked at again
        return content in LASTING | {OBJECTS} or (content == ODOMETRY and self._is_lost(channel))

    def _count(self, channel: int, run: Messages) -> None:
        start, end = self._recording.window
        inside = (run.channel == channel) & (run.log_time_ns >= start) & (run.log_time_ns <= end)
        if inside.any():
            lead = self.leads[channel]
            lead.frames += int(inside.sum())
            lead.bytes += int(run.length[inside].sum())
            lead.first_ns = min(lead.first_ns, int(run.log_time_ns[inside].min()))

    def _lose(self, run: Messages, row: int, error: TraceError) -> None:
        topic = self._recording.channels[int(run.channel[row])].topic
        reason = f"a message of {topic!r} cannot be read: {error.reason}"
        self.lost.add(reason, int(run.log_time_ns[row]), int(run.length[row]))

    # One message -----------------------------------------------------------------------------------

    def _look(self, run: Messages, row: int) -> None:
        channel = int(run.channel[row])
        content = self.contents[channel]
        if content == OBJECTS:
            with suppress(TraceError):  # reported when frames are read
                self._look_for_egos(run.data(row), channel)
            return
        data = bytes(run.data(row))
        if content == ODOMETRY:
            self._take_odometry(channel, decode(self.structures[channel], data))
        elif self._last.get(channel) != data:  # the bridge says many things again and again
            news = content == LIGHT_STATES  # which are read with the frames
            news = news or self._take[content](decode(self.structures[channel], data))
            self._last[channel] = data
            if news and content in LASTING:
                self._lasting.append(ref_of(run, row))

    @property
    def _take(self) -> dict[str, Callable[[dict[str, Any]], bool]]:
        """Functions that take messages whose contents last; each returns whether they say anything new."""
        return {
            ACTORS: self._take_actors,
            LIGHT_PLACES: self._take_lights,
            WORLD: lambda told: self._take_map(text(told, "opendrive"), text(told, "map_name")),
            TEXT: self._take_text,
            VEHICLE: self._take_vehicle,
        }

    def _take_lights(self, message: dict[str, Any]) -> bool:
        self.lights = read_places(message) | self.lights
        return True

    def _take_vehicle(self, message: dict[str, Any]) -> bool:
        ident = ident_of(message, "id")
        if ident is not None:
            self.egos.by_role.setdefault(text(message, "rolename"), ident)
        return True

    def _take_text(self, message: dict[str, Any]) -> bool:
        told = text(message, "data")
        return "<OpenDRIVE" in told[:_MAP_BEGINS] and self._take_map(told, "")

    def _take_actors(self, message: dict[str, Any]) -> bool:
        """Take up a list of actors; whether any of them was not known."""
        actors = self.egos.actors
        known = len(actors)
        for told in records(message, "actors"):
            ident, role = ident_of(told, "id"), text(told, "rolename")
            if ident is None:
                continue
            actor = Actor(text(told, "type"), "" if role == "None" else role)
            before = actors.setdefault(ident, actor)
            if before.type_name != actor.type_name:
                note = (
                    f"actor {ident} is called {before.type_name!r} and {actor.type_name!r};"
                    " the first name counts"
                )
                self._note(note)
        return len(actors) > known

    def _take_map(self, content: str, name: str) -> bool:
        if not self.map_text:
            self.map_text = content
            self.map_name = PurePosixPath(name).name
        elif content and content != self.map_text:
            self._note("the recording carries more than one road map; the first one counts")
        return True

    def _note(self, note: str) -> None:
        """Take note of something odd, once; of very much that is odd only the first."""
        if note not in self.notes and len(self.notes) <= _MOST_NOTES:
            more = "and more that is as odd"
            self.notes.append(note if len(self.notes) < _MOST_NOTES else more)

    # Vehicles under test that no list names -----------------------------------------------------------

    def _is_lost(self, channel: int) -> bool:
        """Return whether nobody knows which object the vehicle of an odometry is."""
        role = role_in(self._recording.channels[channel].topic)
        tried = self._whereabouts.tries >= _MOST_TRIES
        return bool(role) and not tried and self.egos.id_of(role) is None

    def _take_odometry(self, channel: int, message: dict[str, Any]) -> None:
        place = np.array([number(message, path) for path in _ODOMETRY])
        role = role_in(self._recording.channels[channel].topic)
        self._whereabouts.odometry[role] = (stamp_of(message), place)
        self._find_egos()

    def _look_for_egos(self, data: memoryview, channel: int) -> None:
        egos, wanted = self.egos, self.egos.wanted
        named = wanted.isdecimal() and int(wanted) not in egos.actors.keys() | egos.seen
        lost = any(egos.id_of(role) is None for role in self._whereabouts.odometry)
        if not egos.seen or named or (lost and self._whereabouts.tries < _MOST_TRIES):
            head, table = self._tables[channel].read(data)
            table = table[(np.abs(table) < MAX_IDENT).all(axis=1)]
            egos.seen.update(table[:, 0].astype(np.int64).tolist())
            self._whereabouts.objects = stamp_of(head), table
            self._find_egos()

    def _find_egos(self) -> None:
        for role, ident in self._whereabouts.found().items():
            self.egos.by_role.setdefault(role, ident)


def _first(run: Messages, channel: int) -> Ref:
    """Reference to the first message of a channel."""
    return ref_of(run, int(np.argmax(run.channel == channel)))
