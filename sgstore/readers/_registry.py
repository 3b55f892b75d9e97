"""Choice of the reader for a recording, and access to single messages.

A flavour is a class like :class:`~sgstore.readers.osi._trace.OsiTrace`. It is listed in :data:`READERS`, or an
installed package provides it as an entry point of the group ``sgstore.readers``. It recognises a recording by
the schemas of its channels. ``docs/flavours.md`` explains how to add one.
"""

from __future__ import annotations

import inspect
import re
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from sgstore.base import plugins
from sgstore.base.display import first_of
from sgstore.errors import TraceError
from sgstore.mcap import MAGIC, METADATA, McapFile, log_files, messages_at, open_regular
from sgstore.model.world import TraceReport
from sgstore.readers._file import read_numbered
from sgstore.readers.av2._file import Av2File
from sgstore.readers.carla._recorder_file import ENDINGS as _LOG_ENDINGS
from sgstore.readers.carla._recorder_file import CarlaRecorderFile, is_recorder_log
from sgstore.readers.carla._recorder_file import read_messages as _read_recorder_messages
from sgstore.readers.commonroad._file import ENDINGS as _SCENARIO_ENDINGS
from sgstore.readers.commonroad._file import CommonRoadFile, is_scenario
from sgstore.readers.osi._file import ENDINGS as _OSI_ENDINGS
from sgstore.readers.osi._file import OsiFile
from sgstore.readers.osi._file import read_messages as _read_osi_messages
from sgstore.readers.py123d._file import Py123dFile
from sgstore.readers.rosbags._file import ENDINGS as _BAG_ENDINGS
from sgstore.readers.rosbags._file import RosbagFile
from sgstore.readers.sumo._file import ENDINGS as _SUMO_ENDINGS
from sgstore.readers.sumo._file import SumoFile, is_fcd
from sgstore.readers.sumo._file import read_messages as _read_steps

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from sgstore.maps.roads import RoadMap
    from sgstore.mcap import Recording
    from sgstore.readers._base import MessageTrace


ENDINGS: Final = (
    *(".mcap", *_OSI_ENDINGS, *_LOG_ENDINGS, *_BAG_ENDINGS),
    *dict.fromkeys((*_SCENARIO_ENDINGS, *_SUMO_ENDINGS)),  # Both have the suffix .xml.
)
"""File suffixes of recordings, for the search in a folder; see :func:`is_recording`."""


RecordingFile = (
    McapFile
    | OsiFile
    | CommonRoadFile
    | SumoFile
    | CarlaRecorderFile
    | Av2File
    | RosbagFile
    | Py123dFile
)
"""File of messages in any supported format."""


class RecordingReader(Protocol):
    """Interface of a reader: a callable that opens a recording of one type, such as CARLA or OSI.

    The argument ``mapping`` is optional.
    """

    name: str

    def __call__(self, recording: Recording, *, ego: str, digest: str) -> MessageTrace:
        """Open a recording, and return a trace that yields frames."""
        ...

    def recognises(self, recording: Recording) -> bool:
        """Return True if the reader can read a recording. The schemas of its channels decide this."""
        ...


READERS: Final[tuple[RecordingReader, ...]] = tuple(
    plugins.READERS.load(name) for name in plugins.READERS.own
)
"""Readers of sgstore. The first one that recognises a recording reads it."""


def readers() -> Iterator[RecordingReader]:
    """Yield all readers: those of sgstore first, then those of other packages.

    Raises
    ------
    TraceError
        A reader of another package cannot be loaded.
    """
    for _, reader in plugins.READERS.every(TraceError):
        yield reader


def is_recording(path: Path) -> bool:
    """Return True if a path is a recording, by its suffix; logs and XML files also by their first bytes.

    A folder is a recording if it has the files of a log of Argoverse 2 or 123D, or of a SQLite bag.
    """
    name = path.name.lower()
    if not name.endswith(ENDINGS) or path.is_dir():
        return log_files(path) is not None
    if name.endswith(_LOG_ENDINGS):
        return is_recorder_log(path)
    xml = name.endswith((*_SCENARIO_ENDINGS, *_SUMO_ENDINGS))
    return not xml or is_scenario(path) or is_fcd(path)


def open_recording(path: str | Path) -> RecordingFile:
    """Open a log of messages: an MCAP file, ROS bag, OSI file, CommonRoad scenario or SUMO file.

    OSI files are recognised by their suffix. A CommonRoad scenario or SUMO floating-car data is one XML
    document; its contents are converted into messages.

    Raises
    ------
    TraceError
        The file does not exist or has another format.
    """
    opened, _ = _format_of(Path(path))
    return opened(Path(path))


def open_trace(
    path: str | Path, *, ego: str = "", digest: str = "", mapping: str | Path = ""
) -> MessageTrace:
    """Open a recording with the first reader that can read it.

    Parameters
    ----------
    path : str or Path
    ego : str
        The simulator's id or name of the ego; empty: the ego of the recording.
    digest : str
        SHA-256 of the file, if known.
    mapping : str or Path
        Mapping for messages that do not describe themselves (Foxglove): the name of an included mapping, or the
        path of a TOML file. Empty: the included mapping that fits. Other flavours do not use it.

    Raises
    ------
    TraceError
        The file does not exist or is not a recording, has no known ground truth or no frame, or the given ego
        does not exist.
    """
    path = Path(path)
    recording = open_recording(path)
    try:
        if not recording.channels:
            # Without a summary, channels are known only after a walk.
            for _ in recording.walk(TraceReport()):
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
    """If the reader of an open recording needs the road map, pass it on.

    Such a flavour has a method ``on_map``, which is called before the frames are read.
    """
    tell = getattr(trace, "on_map", None)
    if tell is not None:
        tell(road_map)


def _format_of(
    path: Path,
) -> tuple[Callable[[Path], RecordingFile], Callable[..., Iterator[bytes | memoryview]]]:
    """Return two functions for the format of a file: open it, and read single messages of it."""
    if (files := log_files(path)) is not None:
        return _numbered(_FOLDERS.get(files[0].name, Av2File))
    if is_scenario(path):
        return _numbered(CommonRoadFile)
    if is_fcd(path):
        return SumoFile, _read_steps
    if is_recorder_log(path):
        return CarlaRecorderFile, _read_recorder_messages
    if path.name.lower().endswith(_BAG_ENDINGS):
        return _numbered(RosbagFile)
    return (OsiFile, _read_osi_messages) if _is_single_channel(path) else (McapFile, messages_at)


_FOLDERS: Final[dict[str, Any]] = {METADATA: RosbagFile, "sync.arrow": Py123dFile}
"""Name of a file in a folder → class of the recording that such a folder contains."""


def _numbered(opened: Any) -> tuple[Any, Any]:
    """Return two functions for a file with numbered messages: open it, and read single messages."""
    return opened, partial(read_numbered, opened)


def _is_single_channel(path: Path) -> bool:
    if not path.name.lower().endswith(_OSI_ENDINGS):
        return False
    try:
        with open_regular(path) as file:
            return file.read(len(MAGIC)) != MAGIC
    except (OSError, TraceError):
        return True


def read_message(path: str | Path, *, chunk_offset: int, offset: int, length: int) -> bytes:
    """Return the raw bytes of one message of a recording, from its file position.

    See :class:`~sgstore.model.world.MessageRefs`.

    Raises
    ------
    TraceError
        The file cannot be opened, the chunk is damaged, or the message does not match, because the file was
        replaced.
    """
    (data,) = read_messages(Path(path), [(chunk_offset, offset, length)])
    return bytes(data)


def read_messages(
    path: Path, places: Iterable[tuple[int, int, int]]
) -> Iterator[bytes | memoryview]:
    """Yield the raw bytes of several messages, in the order of the given file positions.

    Parameters
    ----------
    path : Path
        A recording: a file, or the folder of a bag.
    places : iterable of (chunk_offset, offset, length)
        As in :class:`sgstore.model.world.MessageRefs`. Group the messages of a chunk, because only the last
        chunk is cached.

    Raises
    ------
    TraceError
        As :func:`read_message`.
    """
    _, read = _format_of(path)
    return read(path, places)


_LOOKS: Final = (
    (re.compile(r"(autoware|tier4)_"), "Autoware recording"),
    (re.compile(r"carla_msgs/"), "recording of CARLA's ROS bridge"),
    (re.compile(r"apollo\."), "Apollo recording"),
    (re.compile(r"foxglove\."), "recording in Foxglove's schemas"),
    (re.compile(r"osi3\."), "OSI recording"),
    (re.compile(r"\w+/(msg/)?[A-Z]\w*$"), "ROS recording"),
)
"""Regular expression of a schema name → probable format of the recording. The first match counts."""
_TELLS_OBJECTS: Final = re.compile(
    r"object|track|detect|obstacle|truth|actor|entit|marker|scene", re.IGNORECASE
)
_HELP: Final = "see docs/flavours.md to add a reader for them"


def _no_reader(recording: Recording) -> str:
    """Return the error text for a recording that no reader supports, with its format and channels.

    Channels that may contain objects come first.
    """
    listed: list[tuple[bool, str]] = []
    schemas: list[str] = []
    for _, record in sorted(recording.channels.items()):
        schema = recording.schemas.get(record.schema_id)
        name = schema.name if schema else "no schema"
        schemas.append(name)
        listed.append((not _TELLS_OBJECTS.search(name), f"{record.topic!r} ({name})"))
    known = ", ".join(reader.name for reader in READERS)
    if not listed:
        return f"no channel has any message; expected ground truth of a flavour known: {known}"
    looks = (look for begins, look in _LOOKS if any(map(begins.match, schemas)))
    look = next((f"{look}: " for look in looks), "")
    channels = first_of([text for _, text in sorted(listed, key=itemgetter(0))], 12)
    return f"{look}no ground truth of a flavour known ({known}); its channels: {channels}; {_HELP}"
