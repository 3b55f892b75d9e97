"""Logs of CARLA's recorder, written packet by packet as the simulator writes them, and logs as MCAP files."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

from mcap.writer import Writer

from sgstore.model.world import TraceReport
from sgstore.readers import open_recording

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

HEAD = b"\x01\x00\x0e\x00CARLA_RECORDER" + struct.pack("<q", 1637676528) + b"\x06\x00Town01"


def packet(ident: int, content: bytes = b"") -> bytes:
    return struct.pack("<BI", ident, len(content)) + content


def text(word: str) -> bytes:
    return struct.pack("<H", len(word.encode())) + word.encode()


def rows(ident: int, layout: str, values: Iterable[tuple[Any, ...]]) -> bytes:
    records = [struct.pack(f"<{layout}", *row) for row in values]
    return packet(ident, struct.pack("<H", len(records)) + b"".join(records))


def added(*actors: tuple[int, str, str, tuple[float, ...]]) -> bytes:
    """Packet of new actors: id, type, role, pose (cm, degrees: x y z roll pitch yaw)."""
    content = struct.pack("<H", len(actors))
    for ident, kind, role, pose in actors:
        content += struct.pack("<IB6fI", ident, 1, *pose, 0) + text(kind)
        content += struct.pack("<HB", 1, 0) + text("role_name") + text(role)
    return packet(2, content)


def begin(number: int, elapsed: float) -> bytes:
    return packet(0, struct.pack("<Qdd", number, 0.1, elapsed))


ACTORS = (
    (7, "vehicle.lincoln.mkz_2017", "hero", (0.0,) * 6),
    (8, "vehicle.bh.crossbike", "", (0.0,) * 6),
    (9, "walker.pedestrian.0001", "", (0.0,) * 6),
    (20, "traffic.traffic_light", "", (5000.0, 800.0, 10.0, 0.0, 0.0, 90.0)),
    (21, "static.prop.barrel", "", (300.0, 400.0, 0.0, 0.0, 0.0, 0.0)),
    (30, "sensor.camera.rgb", "front", (0.0,) * 6),
)
BOXES = (
    (7, 10.0, 0.0, 70.0, 240.0, 100.0, 70.0),
    (8, 0, 0, 60, 90, 30, 60),
    (9, 0, 0, 0, 20, 20, 90),
)


def frame(i: int, hidden: int = 3) -> bytes:
    """The hero drives at 10 m/s past a bicycle, hits it in frame 5; a walker is hidden in the first frames."""
    start, t = (added(*ACTORS) + packet(3, b"\0\0")) if i == 0 else b"", i / 10
    poses = [
        (7, 1000 * t, 0.0, 0.0, 0.0, 0.0, 10.0),
        (8, 500.0, 150.0, 0.0, 0.0, 0.0, 0.0),
        (9, 700.0, -300.0 + i, -50000.0 if i < hidden else 90.0, 0.0, 0.0, 90.0),
        (30, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ]
    hits = [(1, 7, 8, 1, 0)] if i == 5 else []
    parts = [
        *(begin(i + 1, t), start, rows(4, "II", []), rows(5, "IIIBB", hits), rows(6, "I6f", poses)),
        rows(7, "IBfB", [(20, 0, 0.0, 0 if i < 4 else 2)]),
        rows(8, "I3fBi", [(7, 0.25, 0.5, 0.0, 0, 2)]),
        rows(9, "If", [(9, 0.1)]),
        rows(10, "II", [(7, 0x8 | 0x20)]),
        rows(12, "I6f", [(7, 9.8, 1.7, 0, 0, 0, 5), (8, 0, 0, 0, 0, 0, 0)]),
        rows(13, "I6f", BOXES if i == 0 else []),
        packet(14, struct.pack("<d", t)),
        packet(200, b"a packet of a later version"),
        packet(1),
    ]
    return b"".join(parts)


def drive(path: Path, frames: int = 25, hidden: int = 3) -> Path:
    path.write_bytes(HEAD + b"".join(frame(i, hidden) for i in range(frames)))
    return path


def packets(frames: int) -> list[bytes]:
    """The head and each packet of a log."""
    found = [HEAD]
    for data in map(frame, range(frames)):
        at = 0
        while at < len(data):
            size = 5 + struct.unpack_from("<xI", data, at)[0]
            found.append(data[at : at + size])
            at += size
    return found


def as_mcap(path: Path, source: Path) -> Path:
    """The messages of a recording in another format as an MCAP file, as a clip has them."""
    with path.open("wb") as stream, open_recording(source) as recording:
        writer = Writer(stream, chunk_size=3000)
        writer.start("", "tests")
        ids: dict[int, int] = {}
        for number, channel in recording.channels.items():
            schema = recording.schemas[channel.schema_id]
            known = writer.register_schema(schema.name, schema.encoding, schema.data)
            ids[number] = writer.register_channel(
                channel.topic, channel.message_encoding, known, dict(channel.metadata)
            )
        for run in recording.walk(TraceReport()):
            for row, number in enumerate(run.channel.tolist()):
                time = int(run.log_time_ns[row])
                data = bytes(run.data(row))
                writer.add_message(ids[number], time, data, time, int(run.sequence[row]))
        writer.finish()
    return path
