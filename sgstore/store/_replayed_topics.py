"""Topics of a recording that is replayed without a store: their fields, and their values at its frames."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.base.quoting import quoted
from sgstore.base.temporary_folders import working_folder
from sgstore.lang.topics import field_list, field_named
from sgstore.store._schema import INSIDE
from sgstore.store._topic_views import converted, fields_in, topics_in, values_text
from sgstore.store._topics import FrameClock, topic_scratch

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from sgstore.lang.catalog import TopicFacts, TopicField, TopicValue
    from sgstore.model.world import Ints


def recorded_topics(path: Path) -> dict[str, TopicFacts]:
    """Return the topics of a recording, by name. Their fields are read on demand."""
    facts = topics_in(path)
    return {
        name: replace(one, traces=frozenset({0}), source=cache(partial(_fields, path, name)))
        for name, one in facts.items()
    }


def _fields(path: Path, topic: str) -> Mapping[str, TopicField]:
    fields = fields_in(path, topic)
    if fields is None:  # JSON: the messages have the types
        nothing = np.zeros(1, np.int64)
        with working_folder("topics") as folder:
            clock = FrameClock(nothing, nothing, nothing)
            fields = converted(path, topic, folder, clock).fields
    return field_list(fields.items())


def recorded_values(
    path: Path, asked: Iterable[TopicValue], time_ns: Ints, log_time_ns: Ints
) -> dict[TopicValue, list[Any]]:
    """Return the values of topics at all frames of a recording, as a store has them. ``None`` means unknown.

    Parameters
    ----------
    path : Path
    asked : iterable of TopicValue
    time_ns, log_time_ns : (F,) int64
        Times of the frames.
    """
    number = np.arange(len(time_ns))
    clock = FrameClock(number, time_ns, log_time_ns)
    frames = {"frame_id": number, "seq": number, "time_ns": time_ns, "log_time_ns": log_time_ns}
    found: dict[TopicValue, list[Any]] = {}
    with working_folder("topics") as folder, topic_scratch(folder) as connection:
        connection.execute(f"CREATE SCHEMA {INSIDE}")
        connection.register("frames", {**frames, "trace_id": np.zeros_like(number)})
        connection.execute(f"CREATE TABLE {INSIDE}.frame AS FROM frames")
        fields: dict[str, Mapping[str, TopicField]] = {}
        for place, topic in enumerate(dict.fromkeys(one.topic for one in asked)):
            held = folder / str(place)
            file = converted(path, topic, held, clock)
            fields[topic] = field_list(file.fields.items())
            view = quoted(f":messages {topic}")
            connection.execute(f"CREATE TEMP VIEW {view} AS {file.rows(held)}")
        for one in asked:
            found[one] = column = [None] * len(number)
            if not fields[one.topic]:  # JSON without messages
                continue
            field = field_named(fields[one.topic], one.topic, one.field)
            text = values_text(one.topic, field, one.rule, one.tolerance_ns)
            for frame, value in connection.execute(text).fetchall():
                column[frame] = value
    return found
