"""Recordings → blocks of frames: one file for each flavour, and the guarded MCAP reader that all of them use.

A flavour is a class like :class:`~sgstore.readers.osi._trace.OsiTrace` that is listed in :data:`READERS`, or
that an installed package names as an entry point of the group ``sgstore.readers``: it recognises a recording
by the schemas of its channels, and reads it. ``docs/flavours.md`` says how to add one.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from sgstore import plugins
from sgstore.errors import TraceError
from sgstore.mcap import MAGIC, McapFile, messages_at, open_regular
from sgstore.readers.commonroad._file import ENDINGS as _SCENARIO_ENDINGS
from sgstore.readers.commonroad._file import CommonRoadFile, is_scenario
from sgstore.readers.commonroad._file import read_messages as _read_scenario_messages
from sgstore.readers.osi._file import ENDINGS as _OSI_ENDINGS
from sgstore.readers.osi._file import OsiFile
from sgstore.readers.osi._file import read_message as _read_osi_message
from sgstore.readers.sumo._file import ENDINGS as _SUMO_ENDINGS
from sgstore.readers.sumo._file import SumoFile, is_fcd
from sgstore.readers.sumo._file import read_messages as _read_steps
from sgstore.world import TraceReport

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from sgstore.mcap import Recording
    from sgstore.readers._base import MessageTrace
    from sgstore.roads import RoadMap


ENDINGS: Final = (
    *(".mcap", *_OSI_ENDINGS),
    *dict.fromkeys((*_SCENARIO_ENDINGS, *_SUMO_ENDINGS)),  # both have XML
)
"""How the names of recordings end, where a folder is searched for them; see :func:`is_recording`."""


RecordingFile = McapFile | OsiFile | CommonRoadFile | SumoFile
"""A file of messages, whatever it is."""


class RecordingReader(Protocol):
    """A flavour of recording: the class of its traces. One that takes ``mapping`` too is given it."""

    name: str

    def __call__(self, recording: Recording, *, ego: str, digest: str) -> MessageTrace:
        """Open a recording of this flavour."""
        ...

    def recognises(self, recording: Recording) -> bool:
        """Return whether a recording is of this flavour, by the schemas of its channels."""
        ...


READERS: Final[tuple[RecordingReader, ...]] = tuple(
    plugins.READERS.load(name) for name in plugins.READERS.own
)
"""The flavours of recordings, in the order in which they are asked."""


def readers() -> Iterator[RecordingReader]:
    """All flavours, in the order in which they are asked: :data:`READERS`, then those of other packages.

    Raises
    ------
    TraceError
        A package names a flavour that cannot be loaded.
    """
    for _, reader in plugins.READERS.every(TraceError):
        yield reader


def is_recording(path: Path) -> bool:
    """Return whether a file in a folder is a recording, by its name; of an XML file by its beginning, too."""
    name = path.name.lower()
    xml = name.endswith((*_SCENARIO_ENDINGS, *_SUMO_ENDINGS))
    return name.endswith(ENDINGS) and (not xml or is_scenario(path) or is_fcd(path))


def open_recording(path: str | Path) -> RecordingFile:
    """A file of messages: MCAP by how it begins, a single-channel OSI file by how its name ends.

    A CommonRoad scenario or SUMO's floating-car data, each of which is one XML document, is told as messages.

    Raises
    ------
    TraceError
        There is no such file, or it is neither.
    """
    path = Path(path)
    if is_scenario(path):
        return CommonRoadFile(path)
    if is_fcd(path):
        return SumoFile(path)
    return OsiFile(path) if _is_single_channel(path) else McapFile(path)


def open_trace(
    path: str | Path, *, ego: str = "", digest: str = "", mapping: str | Path = ""
) -> MessageTrace:
    """A recording, opened by the first reader that recognises it.

    Parameters
    ----------
    path : str or Path
    ego : str
        The simulator's id or name of the ego; empty: as the recording says.
    digest : str
        SHA-256 of the file, if it is known already.
    mapping : str or Path
        How messages are to be understood that do not say it themselves (Foxglove): the name of a mapping that
        is shipped, or the path of a TOML file; empty: the shipped one that fits. Other flavours need none.

    Raises
    ------
    TraceError
        There is no such file, it is no recording, holds no ground truth that a reader knows, holds no frame,
        or nothing in it bears the name given for the ego.
    """
    path = Path(path)
    recording = open_recording(path)
    try:
        if not recording.channels:
            for _ in recording.walk(TraceReport()):  # no summary: channels come with their messages
                pass
        for reader in readers():
            if reader.recognises(recording):
                takes_mapping = "mapping" in inspect.signature(reader).parameters
                more = {"mapping": mapping} if takes_mapping else {}
                return reader(recording, ego=ego, digest=digest, **more)
        raise TraceError(_no_reader(recording), path=path)
    except TraceError as error:
        recording.close()
        if error.path is None:
            raise TraceError(error.reason, path=path) from error
        raise
    except BaseException:
        recording.close()
        raise


def on_map(trace: MessageTrace, road_map: RoadMap | None) -> None:
    """Tell a trace which road map it is read with, if that matters to its flavour.

    Then the flavour's class has a method ``on_map``; it is called before frames are read.
    """
    tell = getattr(trace, "on_map", None)
    if tell is not None:
        tell(road_map)


def _is_single_channel(path: Path) -> bool:
    if not path.name.lower().endswith(_OSI_ENDINGS):
        return False
    try:
        with open_regular(path) as file:
            return file.read(len(MAGIC)) != MAGIC
    except (OSError, TraceError):
        return True


def read_message(path: str | Path, *, chunk_offset: int, offset: int, length: int) -> bytes:
    """The data of one message of a recording, by its place as :class:`~sgstore.world.MessageRefs` has it.

    Raises
    ------
    TraceError
        The file cannot be opened, the chunk is damaged, or there is no message of that length there: the
        file was replaced.
    """
    (data,) = read_messages(Path(path), [(chunk_offset, offset, length)])
    return bytes(data)


def read_messages(
    path: Path, places: Iterable[tuple[int, int, int]]
) -> Iterator[bytes | memoryview]:
    """The data of messages, in the order in which they are asked for.

    Parameters
    ----------
    path : Path
        A recording: a file, or the folder of a bag.
    places : iterable of (chunk_offset, offset, length)
        As :class:`sgstore.world.MessageRefs` has them. Those of one chunk should come together: the last one
        alone is kept.

    Raises
    ------
    TraceError
        As :func:`read_message`.
    """
    if is_scenario(path):
        yield from _read_scenario_messages(path, ((at, length) for _, at, length in places))
        return
    if is_fcd(path):
        yield from _read_steps(path, ((at, length) for _, at, length in places))
        return
    if not _is_single_channel(path):
        yield from messages_at(path, places)
        return
    for chunk_offset, offset, length in places:
        yield _read_osi_message(path, chunk_offset=chunk_offset, offset=offset, length=length)


_LOOKS: Final = (
    (re.compile(r"(autoware|tier4)_"), "Autoware recording"),
    (re.compile(r"carla_msgs/"), "recording of CARLA's ROS bridge"),
    (re.compile(r"apollo\."), "Apollo recording"),
    (re.compile(r"foxglove\."), "recording in Foxglove's schemas"),
    (re.compile(r"osi3\."), "OSI recording"),
    (re.compile(r"\w+/(msg/)?[A-Z]\w*$"), "ROS recording"),
)
"""How names of schemas begin → what a recording with one of them looks like; the first that fits."""
_TELLS_OBJECTS: Final = re.compile(
    r"object|track|detect|obstacle|truth|actor|entit|marker|scene", re.IGNORECASE
)
_HELP: Final = "docs/flavours.md says how a flavour of your own reads them, in one file"


def _no_reader(recording: Recording) -> str:
    """The reason why nothing recognises a recording: what it looks like, and its channels.

    Those that may tell objects come first.
    """
    listed: list[tuple[bool, str]] = []
    schemas: list[str] = []
    for _, record in sorted(recording.channels.items()):
        schema = recording.schemas.get(record.schema_id)
        name = schema.name if schema else "no schema"
        schemas.append(name)
        listed.append((not _TELLS_OBJECTS.search(name), f"{record.topic!r} ({name})"))
    more = f" and {len(listed) - 12} more" if len(listed) > 12 else ""
    known = ", ".join(reader.name for reader in READERS)
    if not listed:
        return f"no channel has any message; expected ground truth of a flavour known: {known}"
    looks = (look for begins, look in _LOOKS if any(map(begins.match, schemas)))
    look = next((f"{look}: " for look in looks), "")
    channels = ", ".join(text for _, text in sorted(listed, key=lambda one: one[0])[:12])
    return f"{look}no ground truth of a flavour known ({known}); its channels: {channels}{more}; {_HELP}"
