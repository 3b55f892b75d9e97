"""Values of topics in an online monitor, read from the messages of the frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.lang.ir import FrameAttribute

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from contextlib import ExitStack

    from sgstore.graphs.online import Frame
    from sgstore.lang.catalog import TopicFacts, TopicValue
    from sgstore.mcap import Recording
    from sgstore.model.world import FrameBlock


def topics_of(part: object) -> Iterator[TopicValue]:
    """Yield the topic values, such as a field of ``/imu``, in part of a query or check."""
    if isinstance(part, FrameAttribute):
        if (value := part.attribute.topic) is not None:
            yield value
    elif isinstance(part, Mapping):
        yield from topics_of([*part.values()])  # pyright: ignore[reportUnknownArgumentType]
    elif isinstance(part, tuple | list | frozenset):
        for item in part:  # pyright: ignore[reportUnknownVariableType]
            yield from topics_of(item)  # pyright: ignore[reportUnknownArgumentType]
    elif is_dataclass(part):
        for one in fields(part):
            yield from topics_of(getattr(part, one.name))


class RecordedTopics:
    """Topics of a recording that a monitor replays.

    Parameters
    ----------
    recording : Recording
    again : callable
        Returns the blocks of frames from the start.
    until : ExitStack
        Ends with the replay.

    Attributes
    ----------
    asked : list of TopicValue
        Values that the monitor needs. They are decoded with the first frame.
    """

    def __init__(
        self, recording: Recording, again: Callable[[], Iterator[FrameBlock]], until: ExitStack
    ) -> None:
        self._recording, self._again, self._until = recording, again, until
        self.asked: list[TopicValue] = []
        self._waiting: Iterator[dict[str, Any]] = iter(())

    @cached_property
    def _decoded(self) -> Any:
        from sgstore.store import StoreFile  # online, no database is needed

        return self._until.enter_context(StoreFile.replayed_topics(self._recording))

    @property
    def facts(self) -> Mapping[str, TopicFacts]:
        """Topics by name, with the types of their fields."""
        return self._decoded.facts

    def followed(self, blocks: Iterable[FrameBlock]) -> Iterator[FrameBlock]:
        """Read the topic values of all frames; then yield the blocks of frames unchanged."""
        if self.asked:
            asked = [*dict.fromkeys(self.asked)]
            times = [np.stack([block.time_ns, block.log_time_ns]) for block in self._again()]
            found = self._decoded.values(asked, *np.hstack([np.zeros((2, 0), np.int64), *times]))
            there: dict[str, Any] = dict.fromkeys((one.topic for one in asked), True)
            rows = zip(*found.values(), strict=True)
            names = [one.written for one in found]
            self._waiting = (there | dict(zip(names, row, strict=True)) for row in rows)
        yield from blocks

    def on(self, frame: Frame) -> Frame:
        """Return the next frame, after its topic values were added."""
        frame.topics = next(self._waiting, {})
        return frame


class TopicMemory:
    """Last message of each topic that a monitor needs.

    Parameters
    ----------
    asked : iterable of TopicValue

    Attributes
    ----------
    asked : tuple of TopicValue
    """

    def __init__(self, asked: Iterable[TopicValue]) -> None:
        self.asked = tuple(dict.fromkeys(asked))
        self._last: dict[str, tuple[int, Any]] = {}

    def values(self, time_ns: int, messages: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of all fields at a frame: text in the query → value, or None if unknown.

        Parameters
        ----------
        time_ns : int
            Time of the frame.
        messages : mapping of str to message
            Messages of the frame by topic. A replayed recording adds the values themselves, by text.
        """
        found: dict[str, Any] = {}
        for topic in {one.topic for one in self.asked}:
            if (message := message_of(messages, topic)) is not None:
                self._last[topic] = time_ns, message
        for one in self.asked:
            if one.written in messages:
                found[one.written] = messages[one.written]
            elif one.topic in self._last:
                since, message = self._last[one.topic]
                limit = 0 if one.rule == "linear" else one.tolerance_ns
                if limit is None or 0 <= time_ns - since <= limit:
                    found[one.written] = _field(message, one.field)
        return found


def message_of(messages: Mapping[str, Any], topic: str) -> Any:
    """Return the message of a topic. The topic's name may lack its first slash."""
    return messages.get(topic, messages.get(f"/{topic}"))


def _field(message: Any, path: str) -> Any:
    """Return a field of a message (mapping or object); None if the field is missing or unknown."""
    for part in path.replace("[", ".[").split("."):
        if part.startswith("["):
            index = int(part[1:-1])
            message = message[index] if index < len(message) else None
        elif isinstance(message, Mapping):
            message = message.get(part)  # pyright: ignore[reportUnknownMemberType]
        else:
            message = getattr(message, part, None)
        if message is None:
            return None
    unknown = isinstance(message, float) and math.isnan(message)
    return None if unknown else message
