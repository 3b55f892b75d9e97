"""CARLA's recorder log (``client.start_recorder``), read like an MCAP file: one message per frame.

The file is a sequence of packets. Some describe actors once, others have the values of a frame. A message is
the JSON text of one frame, with the descriptions of its moving actors. Its axes are CARLA's (y to the right,
yaw clockwise), in metres and degrees. After damage, reading continues at the next frame.

Source: CARLA documentation, "Recorder binary file format".
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from mcap.records import Schema

from sgstore.errors import TraceError
from sgstore.mcap import Loss, mark_of_open, open_regular
from sgstore.readers._file import MessageFile, first_bytes, numbered_runs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from io import BufferedReader
    from pathlib import Path

    from sgstore.mcap import Findings, Messages

FRAME: Final = "carla.RecorderFrame"
"""Name of the message schema of frames."""
TOWN: Final = "town"
"""Metadata key for the name of the map."""
ENDINGS: Final = (".log",)
"""Suffix of recorder logs. :func:`is_recorder_log` also checks their content."""
MAX_PACKET: Final = 64 << 20
"""Maximum size of a packet; bytes. A packet with the poses of 100,000 actors has 3 MB."""
MAX_ACTORS: Final = 100_000
"""Maximum number of actors that exist at one time."""

_CHANNEL: Final = 1
_MAGIC: Final = b"\x01\x00\x0e\x00CARLA_RECORDER"
_HEAD: Final = struct.Struct("<BI")
_BEGIN, _END, _ADDED, _REMOVED, _COLLISIONS, _POSES, _LIGHTS = 0, 1, 2, 3, 5, 6, 7
_VEHICLES, _WALKERS, _VEHICLE_LIGHTS, _MOTION, _BOXES = 8, 9, 10, 12, 13
_MARK: Final = _HEAD.pack(_BEGIN, 24)
_PIECE: Final = 1 << 20
_FURTHEST: Final = 1_000_000
"""Largest number of frames that can be missing after a damaged part."""
_SIX: Final = np.dtype([("id", "<u4"), ("of", "<f4", 6)])
_TABLES: Final = {
    _REMOVED: np.dtype([("id", "<u4")]),
    _POSES: _SIX,
    _LIGHTS: np.dtype([("id", "<u4"), ("frozen", "u1"), ("elapsed", "<f4"), ("state", "u1")]),
    _VEHICLES: np.dtype([("id", "<u4"), ("of", "<f4", 3), ("hand_brake", "u1"), ("gear", "<i4")]),
    _WALKERS: np.dtype([("id", "<u4"), ("speed", "<f4")]),
    _VEHICLE_LIGHTS: np.dtype([("id", "<u4"), ("bits", "<u4")]),
    _MOTION: _SIX,
    _BOXES: _SIX,
}
"""Number of a packet type → layout of its records."""
_MOVING: Final = ("vehicle.", "walker.")
_STANDING: Final = ("traffic.", "static.")
_LIGHT: Final = "traffic.traffic_light"


def is_recorder_log(path: Path) -> bool:
    """Return True if a file is a log of CARLA's recorder, by its suffix and first bytes."""
    return first_bytes(path, ENDINGS, len(_MAGIC)) == _MAGIC


class CarlaRecorderFile(MessageFile):
    """Log of CARLA's recorder that can be read like an MCAP file (log of messages).

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    path, size, mtime_ns
        The file, its size in bytes, its modification time.
    schemas, channels : dict
        One channel, ``/carla/recorder``, with its schema. Its metadata have the name of the map.
    counts : None
        The number of frames is unknown before the reading.

    Raises
    ------
    TraceError
        The file cannot be opened, or its first bytes are damaged.
    """

    counts = None

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = open_regular(path)
        self.size, self.mtime_ns = mark_of_open(self._file)
        try:
            town = _town(self._file)
        except (ValueError, struct.error) as error:
            self._file.close()
            raise TraceError(
                f"the head of the recorder log is damaged: {error}", path=path
            ) from error
        schema = Schema(id=_CHANNEL, data=b'{"type":"object"}', encoding="jsonschema", name=FRAME)
        self.add_channel("/carla/recorder", schema, "json", {TOWN: town})

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _walk(self, report: Findings, wanted: Callable[[int], bool]) -> Iterator[Messages]:
        """Yield all frames of the log as messages. ``offset`` of a message is its position in the file."""
        if not wanted(-1):
            return
        moments = _moments(self._file, report)
        messages = ((one.offset, one.time_ns, one.message()) for one in moments)
        yield from numbered_runs(messages, _CHANNEL)


def read_messages(path: Path, places: Iterable[tuple[int, int, int]]) -> Iterator[bytes]:
    """Yield the bytes of frames in a log, given by offset and length; see :class:`CarlaRecorderFile`.

    Raises
    ------
    TraceError
        The file cannot be read, or a frame does not match, because the file was replaced.
    """
    from sgstore.model.world import TraceReport

    with open_regular(path) as file:
        moments: Iterator[_Moment] = iter(())
        at = 1 << 63
        for _, offset, length in places:
            if offset <= at:
                _town(file)
                moments = _moments(file, TraceReport())
            found = next((moment for moment in moments if moment.offset >= offset), None)
            at = offset
            data = b"" if found is None or found.offset != offset else found.message()
            if len(data) != length or not data:
                reason = f"no frame of {length} bytes at {offset} there: the file was replaced"
                raise TraceError(reason, path=path)
            yield data


def _town(file: BufferedReader) -> str:
    """Read the head of a log. Return the name of the map. The file is then at its first packet."""
    file.seek(0)
    head = file.read(len(_MAGIC) + 10)
    if not head.startswith(_MAGIC):
        raise ValueError("it does not begin like a log of CARLA's recorder")
    (length,) = struct.unpack_from("<H", head, len(_MAGIC) + 8)
    town = file.read(length)
    if len(town) < length:
        raise ValueError("the name of the map is cut off")
    return town.decode("utf-8", "replace").rpartition("/")[2]


class _LoggedActor(NamedTuple):
    """Type, role and first pose of an actor (cm, degrees). Lights and signs have only this pose."""

    type_name: str
    role: str
    pose: Any


@dataclass(slots=True)
class _LoggedWorld:
    """Actors and their bounding boxes at one time of a log, and the ids of actors described so far.

    ``others``: ids of sensors and the spectator; ``unknown``: ids without a description.
    """

    actors: dict[int, _LoggedActor] = field(default_factory=dict[int, _LoggedActor])
    boxes: dict[int, list[float]] = field(default_factory=dict[int, list[float]])
    told: set[int] = field(default_factory=set[int])
    unknown: set[int] = field(default_factory=set[int])
    others: set[int] = field(default_factory=set[int])


@dataclass(slots=True)
class _Moment:
    """All packets of one frame of a log, and the actors that exist at that time.

    Attributes
    ----------
    offset : int
        Position of the frame in the file.
    number, elapsed : int, float
        Number and time (s) of the frame.
    """

    offset: int
    number: int
    elapsed: float
    world: _LoggedWorld
    tables: dict[int, Any] = field(default_factory=dict[int, Any])
    hits: list[list[int]] = field(default_factory=list[list[int]])

    @property
    def time_ns(self) -> int:
        return round(self.elapsed * 1e9)

    def message(self) -> bytes:
        """Return the frame as JSON text, without infinite and undefined numbers."""
        world, about = self.world, {packet: _by_id(rows) for packet, rows in self.tables.items()}
        told: dict[str, Any] = {"frame": self.number, "elapsed": self.elapsed}
        told |= {"actors": [], "traffic_lights": [], "standing": []}
        poses = about.get(_POSES, {})
        for ident, actor in world.actors.items():
            moves = actor.type_name.startswith(_MOVING)
            if not moves and ident in world.told and actor.type_name != _LIGHT:
                continue
            pose = actor.pose if ident not in poses else poses[ident]["of"].astype(np.float64)
            if (moves and ident not in poses) or not np.isfinite(pose).all():
                continue
            one: dict[str, Any] = {"id": ident, "type": actor.type_name}
            one |= {"role": actor.role} if actor.role else {}
            one |= {"location": (pose[:3] / 100).tolist(), "rotation": pose[3:].tolist()}
            if ident in world.boxes:
                one["box"] = world.boxes[ident]
            if moves:
                told["actors"].append(one | _motion(ident, about))
            elif actor.type_name == _LIGHT:
                shown = about.get(_LIGHTS, {}).get(ident)
                told["traffic_lights"].append(
                    one | ({} if shown is None else {"state": int(shown["state"])})
                )
            else:
                told["standing"].append(one)
        if self.hits:
            told["collisions"] = self.hits
        return json.dumps(told, allow_nan=False, separators=(",", ":")).encode()


def _by_id(rows: Any) -> dict[int, Any]:
    return dict(zip(rows["id"].tolist(), rows, strict=True))


def _motion(ident: int, about: dict[int, dict[int, Any]]) -> dict[str, Any]:
    """Return velocity, controls and lights of an actor in a frame."""
    told: dict[str, Any] = {}
    motion, inputs = about.get(_MOTION, {}).get(ident), about.get(_VEHICLES, {}).get(ident)
    lights, walk = (about.get(packet, {}).get(ident) for packet in (_VEHICLE_LIGHTS, _WALKERS))
    if motion is not None and np.isfinite(motion["of"]).all():
        values = motion["of"].astype(np.float64).tolist()
        told |= {"velocity": values[:3], "angular_velocity": values[3:]}
    if inputs is not None and np.isfinite(inputs["of"]).all():
        told["control"] = dict(
            zip(("steer", "throttle", "brake"), inputs["of"].tolist(), strict=True)
        )
        told["control"] |= {"hand_brake": bool(inputs["hand_brake"]), "gear": int(inputs["gear"])}
    if lights is not None:
        told["lights"] = int(lights["bits"])
    if walk is not None and np.isfinite(walk["speed"]):
        told["animation_speed"] = float(walk["speed"])
    return told


class _PacketReader:
    """Reader of the packets in a log. After a damaged part, it continues with the next frame."""

    def __init__(self, file: BufferedReader, report: Findings) -> None:
        self.file, self.report = file, report

    def packet(self) -> tuple[int, int, bytes] | None:
        """Return position, id and content of the next packet; ``None`` at the end, or if it is damaged."""
        place = self.file.tell()
        head = self.file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            if head:
                self.report.lose(Loss("the file ends inside a packet", bytes=len(head)))
            return None
        ident, length = _HEAD.unpack(head)
        data = self.file.read(length) if length <= MAX_PACKET else b""
        if len(data) < length:
            self.file.seek(place)
            return None
        return place, ident, data

    def resync(self, after: int, last: int) -> bool:
        """Go to the next frame after a position in the file. Its frame number must be above ``last``."""
        self.file.seek(after)
        rest, place = b"", after
        while piece := self.file.read(_PIECE):
            rest += piece
            at = rest.find(_MARK)
            while 0 <= at <= len(rest) - 29:
                number, _, elapsed = struct.unpack_from("<Qdd", rest, at + 5)
                if last < number <= last + _FURTHEST and 0 <= elapsed < 1e9:
                    self.file.seek(place + at)
                    reason = "a part of the file is damaged"
                    self.report.lose(Loss(reason, bytes=place + at - after))
                    return True
                at = rest.find(_MARK, at + 1)
            kept = 28
            place, rest = place + max(len(rest) - kept, 0), rest[-kept:]
        self.report.lose(Loss("the file ends inside a packet", bytes=place + len(rest) - after))
        return False


def _moments(file: BufferedReader, report: Findings) -> Iterator[_Moment]:
    """Yield the frames of a log in order, also after damaged parts."""
    _town(file)
    reader, world = _PacketReader(file, report), _LoggedWorld()
    moment: _Moment | None = None
    last, since = 0, file.tell()
    while True:
        packet = reader.packet()
        begins = packet is not None and packet[1] == _BEGIN
        if packet is None or (begins and (len(packet[2]) != 24 or not _follows(packet[2], last))):
            yield from _whole(moment, report)
            moment = None
            at_end = packet is None and not file.read(1)
            if at_end or not reader.resync(since + 1, last):
                return
            continue
        place, ident, data = packet
        since = place
        if begins:
            yield from _whole(moment, report)
            number, _, elapsed = struct.unpack("<Qdd", data)
            moment, last = _Moment(place, number, elapsed, world), number
        elif moment is not None:
            try:
                _take(moment, ident, data)
            except (ValueError, IndexError, struct.error) as error:
                reason = f"a packet {ident} is malformed: {error}"[:200]
                report.lose(Loss(reason, bytes=len(data)))
        if ident == _END:
            yield from _whole(moment, report)
            moment = None


def _follows(data: bytes, last: int) -> bool:
    """Return True if the data can be the start of the frame after number ``last``."""
    number, _, elapsed = struct.unpack("<Qdd", data)
    return last < number <= last + _FURTHEST and 0 <= elapsed < 1e9


def _whole(moment: _Moment | None, report: Findings) -> Iterator[_Moment]:
    """Yield a frame that has the positions of actors. Count any other frame as lost."""
    if moment is None:
        return
    if _POSES not in moment.tables:
        report.lose(Loss("a frame without positions of actors", bytes=0))
        return
    world = moment.world
    poses = moment.tables[_POSES]["id"].tolist()
    for ident in set(poses) - world.actors.keys() - world.unknown - world.others:
        world.unknown.add(ident)
        report.lose(Loss(f"actor {ident} has no description", bytes=0))
    yield moment
    world.told.update(world.actors)


def _take(moment: _Moment, ident: int, data: bytes) -> None:
    """Add the content of a packet to a frame or to its actors."""
    world = moment.world
    if ident == _ADDED:
        _add_actors(world, data)
    elif ident == _COLLISIONS:
        moment.hits = _pairs(data)
    elif ident in _TABLES:
        rows = _rows(data, _TABLES[ident])
        if ident == _REMOVED:
            for gone in rows["id"].tolist():
                world.actors.pop(gone, None)
                world.boxes.pop(gone, None)
                world.told.discard(gone)
        elif ident == _BOXES:
            for row in rows[np.isfinite(rows["of"]).all(axis=1)]:
                world.boxes[int(row["id"])] = (row["of"].astype(np.float64) / 100).tolist()
        else:
            moment.tables[ident] = rows


def _rows(data: bytes, layout: Any) -> Any:
    (count,) = struct.unpack_from("<H", data)
    if len(data) != 2 + count * layout.itemsize:
        raise ValueError(f"{len(data)} bytes for {count} records of {layout.itemsize}")
    return np.frombuffer(data, layout, count, 2)


def _pairs(data: bytes) -> list[list[int]]:
    """Return the pairs of actor ids that collide, without duplicates. CARLA versions differ in record size."""
    (count,) = struct.unpack_from("<H", data)
    size = (len(data) - 2) // count if count else 12
    if size < 12 or len(data) != 2 + count * size:
        raise ValueError(f"{len(data)} bytes for {count} collisions")
    pairs = (struct.unpack_from("<II", data, 2 + i * size + 4) for i in range(count))
    return [list(pair) for pair in dict.fromkeys(pairs)]


def _add_actors(world: _LoggedWorld, data: bytes) -> None:
    """Add new actors to the world, from their descriptions in a packet."""
    (count,) = struct.unpack_from("<H", data)
    at = 2
    for _ in range(count):
        ident, *pose = struct.unpack_from("<Ix6f", data, at)
        type_name, at = _text(data, at + 33)
        (told,) = struct.unpack_from("<H", data, at)
        at += 2
        about: dict[str, str] = {}
        for _ in range(told):
            name, at = _text(data, at + 1)
            about[name], at = _text(data, at)
        if len(world.actors) >= MAX_ACTORS:
            raise ValueError(f"more than {MAX_ACTORS:,} actors")
        world.unknown.discard(ident)
        if type_name.startswith((*_MOVING, *_STANDING)):
            world.actors[ident] = _LoggedActor(
                type_name, about.get("role_name", ""), np.array(pose)
            )
        else:
            world.others.add(ident)


def _text(data: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<H", data, at)
    stop = at + 2 + length
    if stop > len(data):
        raise ValueError("a text is cut off")
    return data[at + 2 : stop].decode("utf-8", "replace"), stop
