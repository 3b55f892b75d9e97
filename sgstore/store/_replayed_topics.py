"""Topics of a recording that is replayed without a store: their fields, and their values at its frames."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.base.quoting import quoted
from sgstore.base.temporary_folders import working_folder
from sgstore.lang.topics import field_list, field_named
from sgstore.mcap import Findings
from sgstore.store._schema import INSIDE
from sgstore.store._topic_views import stamp_text, values_text
from sgstore.store._topics import FrameClock, TopicWriter, topic_scratch

if TYPE_CHECKING:
    from collections.abc import Collection, Generator, Iterable, Mapping
    from pathlib import Path

    from sgstore.lang.catalog import TopicFacts, TopicField, TopicValue
    from sgstore.mcap import Recording
    from sgstore.model.world import Ints
    from sgstore.store._topics import TopicFile


@contextmanager
def replayed_topics(recording: Recording) -> Generator[ReplayedTopics]:
    """Context manager that yields the topics of an open recording. At the end, it deletes decoded messages."""
    with working_folder("topics") as folder:
        yield ReplayedTopics(recording, folder)


class ReplayedTopics:
    """Topics of an open recording. One pass decodes the messages of several topics, each message once.

    Parameters
    ----------
    recording : Recording
    folder : Path
        Empty folder for decoded messages.
    """

    def __init__(self, recording: Recording, folder: Path) -> None:
        self._recording, self._folder = recording, folder
        self._files: dict[str, tuple[Path, TopicFile]] = {}

    @cached_property
    def facts(self) -> dict[str, TopicFacts]:
        """Topics of the recording, by name. Their fields are read on demand."""
        from sgstore.readers import TopicReading  # most monitors name no topic

        known = TopicReading(self._recording, ()).known
        return {
            name: replace(one, traces=frozenset({0}), source=cache(partial(self._fields, name)))
            for name, one in known.items()
        }

    def _fields(self, topic: str) -> Mapping[str, TopicField]:
        from sgstore.readers import TopicReading

        fields = TopicReading(self._recording, [topic]).fields(topic)
        if fields is None:  # JSON: the messages have the types
            self._decode([topic])
            fields = field_list(self._files[topic][1].fields.items())
        return fields

    def _decode(self, topics: Collection[str]) -> None:
        """Write the messages of topics to files, if they are not in files yet."""
        from sgstore.readers import TopicReading

        topics = [topic for topic in topics if topic not in self._files]
        if not topics:
            return
        folder = self._folder / str(len(self._files))
        folder.mkdir()
        nothing = np.zeros(1, np.int64)
        reading = TopicReading(self._recording, topics)
        with topic_scratch(folder) as connection:
            # The clock of the frames is not known yet.
            writer = TopicWriter(connection, folder, FrameClock(nothing, nothing, nothing))
            for batch in reading.batches(Findings()):
                writer.add(batch)
            self._files |= {file.topic: (folder, file) for file in writer.files(reading)}

    def values(
        self, asked: Iterable[TopicValue], time_ns: Ints, log_time_ns: Ints
    ) -> dict[TopicValue, list[Any]]:
        """Return the values of topics at all frames, as a store has them; ``None`` if unknown.

        Parameters
        ----------
        asked : iterable of TopicValue
        time_ns, log_time_ns : (F,) int64
            Times of the frames.
        """
        number = np.arange(len(time_ns))
        clock = FrameClock(number, time_ns, log_time_ns)
        frames = {"frame_id": number, "seq": number, "time_ns": time_ns, "log_time_ns": log_time_ns}
        topics = [*dict.fromkeys(one.topic for one in asked)]
        self._decode(topics)
        found: dict[TopicValue, list[Any]] = {}
        with topic_scratch(self._folder) as connection:
            connection.execute(f"CREATE SCHEMA {INSIDE}")
            connection.register("frames", {**frames, "trace_id": np.zeros_like(number)})
            connection.execute(f"CREATE TABLE {INSIDE}.frame AS FROM frames")
            for place, topic in enumerate(topics):
                folder, file = self._files[topic]
                rows = file.rows(folder)
                times = connection.execute(f"SELECT DISTINCT log_time_ns FROM ({rows})")
                log_time = np.ma.getdata(times.fetchnumpy()["log_time_ns"])
                placed = clock.columns(log_time)
                times = {"log_time_ns": log_time, "run": placed[":run"], "time": placed[":time_ns"]}
                connection.register(f"times{place}", times)
                view = quoted(f":messages {topic}")
                connection.execute(
                    f'CREATE TEMP VIEW {view} AS SELECT * REPLACE (run AS ":run", time AS ":time_ns")'
                    f" FROM ({rows}) JOIN times{place} USING (log_time_ns)"
                )
            for one in asked:
                found[one] = column = [None] * len(number)
                declared = self._files[one.topic][1].fields
                if not declared:  # JSON without messages
                    continue
                field = field_named(field_list(declared.items()), one.topic, one.field)
                stamp = stamp_text(declared)
                text = values_text(one.topic, field, one.rule, one.tolerance_ns, stamp)
                for frame, value in connection.execute(text).fetchall():
                    column[frame] = value
        return found
