"""ROS bags, read like MCAP files: CDR messages with the definitions of their types.

The readers of ROS flavours therefore read these containers, too. A place in a bag is the number of a message in
the container.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mcap.records import Schema

from sgstore.errors import TraceError
from sgstore.mcap import Loss, log_files, mark_of
from sgstore.readers._file import MessageFile, grouped, held_messages
from sgstore.readers.rosbags._definitions import Definitions
from sgstore.readers.rosbags._ros1 import Ros1Bag
from sgstore.readers.rosbags._sqlite import SqliteBag

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from sgstore.mcap import Findings, Messages
    from sgstore.readers.rosbags._sqlite import Topic

ENDINGS = (".db3", ".bag")
"""File suffixes of ROS bags."""


class RosbagFile(MessageFile):
    """Bag of ROS messages that can be read like an MCAP file (log of messages).

    Parameters
    ----------
    path : Path
        A SQLite file, the folder of a bag with such files, or a bag of ROS 1.

    Attributes
    ----------
    path, size, mtime_ns
        The bag, its size in bytes, its modification time.
    schemas, channels : dict
        A channel for each topic.
    counts : dict
        Number of messages by channel.

    Raises
    ------
    TraceError
        The bag cannot be opened.
    """

    has_log_times = True
    profile, noun = "ros2", "bag"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            self.size, self.mtime_ns = mark_of(path)
        except OSError as error:
            raise TraceError(f"cannot be opened: {error.strerror}", path=path) from error
        self._losses: list[str] = []
        if path.name.lower().endswith(".bag"):
            self._bag: Ros1Bag | SqliteBag = Ros1Bag(path, self._losses.append)
        else:
            self._bag = SqliteBag(path, log_files(path) or [path], self._losses.append)
        self._convert: dict[int, Callable[[bytes], bytes]] = {}
        try:
            definitions = Definitions(self._bag, self._losses.append)
            for number, topic in self._bag.topics.items():
                self._add_topic(number, topic, definitions)
        except BaseException:
            self._bag.close()
            raise
        found = np.bincount(self._bag.channel, minlength=len(self.channels) + 1).tolist()
        self.counts = {number: found[number] for number in self.channels}

    def _add_topic(self, number: int, topic: Topic, definitions: Definitions) -> None:
        text = definitions.text(topic)
        name = topic.type.replace("/", "/msg/") if topic.type.count("/") == 1 else topic.type
        encoding = "ros2msg" if text else ""
        schema = Schema(id=number, data=text.encode(), encoding=encoding, name=name)
        self.add_channel(topic.name, schema, "cdr" if text or not topic.is_ros1 else "ros1")
        if topic.is_ros1 and text:
            self._convert[number] = definitions.converter(topic)

    def close(self) -> None:
        """Close the files of the bag."""
        self._bag.close()

    def message(self, number: int) -> bytes:
        """Return the bytes of a message in CDR, given its number.

        Raises
        ------
        IndexError
            The number is too large.
        TraceError
            The message cannot be read or converted.
        """
        data = self._bag.data(number)
        convert = self._convert.get(int(self._bag.channel[number]))
        return data if convert is None else convert(data)

    def walk(
        self,
        report: Findings,
        wanted: Callable[[int], bool] | None = None,
        keep: Callable[[int], bool] | None = None,
        rank: Callable[[int], int] | None = None,
    ) -> Iterator[Messages]:
        """Yield all messages sorted by log time, then by rank of the channel, then by topic."""
        del keep
        for reason in self._losses:
            report.lose(Loss(reason, bytes=0))
        if wanted is not None and not wanted(-1):
            return
        channel, times = self._bag.channel, self._bag.times
        names = sorted(
            self.channels, key=lambda one: (rank(one) if rank else 0, self.channels[one].topic)
        )
        place = np.zeros(len(self.channels) + 1, np.int64)
        place[names] = np.arange(len(names))
        order = np.lexsort((np.arange(len(times)), place[channel], times))
        usable = order[times[order] >= 0].tolist()
        for held, log_times in grouped(self._readable(usable, report)):
            rows = [*held]
            yield held_messages(held, log_times, channel=channel[rows].tolist(), sequence=rows)

    def _readable(self, rows: list[int], report: Findings) -> Iterator[tuple[int, int, bytes]]:
        """Yield number, time and bytes of each message. Report unreadable messages as lost."""
        for number in rows:
            time_ns = int(self._bag.times[number])
            try:
                data = self.message(number)
            except TraceError as error:
                report.lose(Loss(error.reason, bytes=0, start_ns=time_ns, end_ns=time_ns))
            else:
                yield number, time_ns, data
