"""Weather and light of OSI ground truth: events of the report, at the beginning and whenever they change.

Source: open-simulation-interface 3.8.0 (osi_environment.proto).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from google.protobuf import message_factory

from sgstore.traces.osi_schema import DECODE_ERRORS
from sgstore.world import Event

if TYPE_CHECKING:
    from sgstore.traces.frames import Roster

TYPE: Final = "osi3.EnvironmentalConditions"
_CLASSES: Final = (
    ("precipitation", "precipitation"),
    ("fog", "fog"),
    ("illumination", "ambient_illumination"),
)
"""Word of an event → field whose value is a class."""


class Environment:
    """The conditions of a trace.

    Parameters
    ----------
    message : type
        Class of the messages of the leading channel, which have the conditions as bytes.
    roster : Roster
        Takes up an event of kind ``environment`` whenever a class of conditions changes; its ``detail`` is
        such as ``precipitation=light, fog=mist, illumination=level5, clouds=six_oktas, time_of_day=13:05:00``.
    """

    def __init__(self, message: type[Any], roster: Roster) -> None:
        self._roster = roster
        self._told = b""
        self._state = ""
        self._unread = 0
        try:
            found = message.DESCRIPTOR.file.pool.FindMessageTypeByName(TYPE)
            self._class = message_factory.GetMessageClass(found)
        except DECODE_ERRORS:
            self._class = None

    def look(self, ground: Any, time_ns: int, log_time_ns: int, seq: int) -> None:
        """Take note of what a ground truth says; what it does not say goes on."""
        told = getattr(ground, "environmental_conditions", b"")
        if not told or told == self._told or self._class is None:
            return
        self._told = told
        try:
            conditions: Any = self._class.FromString(told)
            state, more = classes_of(conditions), numbers_of(conditions)
        except DECODE_ERRORS:  # whatever else is in the message is read all the same
            self._unread += 1
            return
        if state == self._state or not state:
            return
        self._state = state
        detail = ", ".join([state, *more])
        self._roster.happen(Event("environment", time_ns, log_time_ns, seq, detail=detail))

    def settle(self) -> None:
        """Say what could not be read."""
        if self._unread:
            words = f"weather and light cannot be read where they changed {self._unread} times"
            self._roster.report.warnings.append(words)


def classes_of(conditions: Any) -> str:
    """The classes that are told: ``precipitation=light, fog=mist``."""
    told = [(word, _class(conditions, field)) for word, field in _CLASSES]
    if "clouds" in conditions.DESCRIPTOR.fields_by_name and conditions.HasField("clouds"):
        told.append(("clouds", _class(conditions.clouds, "fractional_cloud_cover")))
    return ", ".join(f"{word}={value}" for word, value in told if value)


def numbers_of(conditions: Any) -> list[str]:
    """Time of day and temperature, where they are told."""
    told: list[str] = []
    if conditions.HasField("time_of_day"):
        minutes, seconds = divmod(conditions.time_of_day.seconds_since_midnight % 86_400, 60)
        told.append(f"time_of_day={minutes // 60:02}:{minutes % 60:02}:{seconds:02}")
    if conditions.HasField("temperature"):
        told.append(f"temperature={conditions.temperature:.1f} K")
    return told


def _class(message: Any, field: str) -> str:
    """A value of an enumeration in lower case, without what all values begin with; empty if it is unknown."""
    told = message.DESCRIPTOR.fields_by_name.get(field)
    if told is None or told.enum_type is None or not message.HasField(field):
        return ""
    names = told.enum_type.values_by_number
    number = getattr(message, field)
    if 0 not in names or number not in names or number == 0:
        return ""
    prefix = names[0].name.removesuffix("UNKNOWN")
    return str(names[number].name).removeprefix(prefix).lower()
