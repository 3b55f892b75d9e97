"""123D's own writer beside what we read of its logs (``make py123d``): boxes, ego, lights and lanes.

Needs the package py123d, which is no dependency of sgstore. It writes a log with random poses.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from py123d.api.map.arrow.arrow_map_writer import ArrowMapWriter
from py123d.api.scene.arrow.modalities.arrow_box_detections_se3 import ArrowBoxDetectionsSE3Writer
from py123d.api.scene.arrow.modalities.arrow_ego_state_se3 import ArrowEgoStateSE3Writer
from py123d.api.scene.arrow.modalities.arrow_traffic_light_detections import (
    ArrowTrafficLightDetectionsWriter,
)
from py123d.api.utils.arrow_metadata_utils import add_metadata_to_arrow_schema
from py123d.datatypes import (
    BoxDetectionAttributes,
    BoxDetectionSE3,
    BoxDetectionsSE3,
    BoxDetectionsSE3Metadata,
    DynamicStateSE3,
    EgoStateSE3,
    EgoStateSE3Metadata,
    Lane,
    LaneType,
    LogMetadata,
    MapMetadata,
    Timestamp,
    TrafficLightDetection,
    TrafficLightDetections,
    TrafficLightDetectionsMetadata,
    TrafficLightStatus,
)
from py123d.geometry import BoundingBoxSE3, Polyline3D, PoseSE3, Vector3D
from py123d.parser.registry import NuScenesBoxDetectionLabel

from sgstore.readers import open_trace

FRAMES = 20


def write(logs: Path) -> tuple[Path, dict[tuple[int, str], Any]]:
    """Write a log by the writer of 123D. Return its folder, and the boxes by frame and track."""
    import pyarrow as pa

    rng = np.random.default_rng(5)
    log = logs / "nuscenes_val" / "drive"
    log.mkdir(parents=True)
    about = LogMetadata("nuscenes", "nuscenes_val", "drive", "boston")
    centre = PoseSE3(1.4, 0.1, 0.8, 1.0, 0.0, 0.0, 0.0)
    still = PoseSE3(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    ego = EgoStateSE3Metadata("zoe", 1.7, 4.1, 1.5, 2.6, centre, still)
    boxes = BoxDetectionsSE3Metadata(NuScenesBoxDetectionLabel)
    lights = TrafficLightDetectionsMetadata()
    writers = (
        ArrowEgoStateSE3Writer(log, ego, ipc_compression="lz4"),
        ArrowBoxDetectionsSE3Writer(log, boxes, ipc_compression="zstd"),
        ArrowTrafficLightDetectionsWriter(log, lights),
    )
    want: dict[tuple[int, str], Any] = {}
    times: list[int] = []
    for frame in range(FRAMES):
        time = Timestamp.from_us(10**15 + frame * 50_000)
        times.append(time.time_us)
        turn = rng.normal(size=4)
        turn /= np.linalg.norm(turn)
        state = EgoStateSE3.from_imu(
            PoseSE3(frame / 2, 1.0, 2.0, *turn.tolist()), ego, time,
            DynamicStateSE3(Vector3D(10, 0, 0), Vector3D(0.1, 0, 0), Vector3D(0, 0, 0.2)),
        )  # fmt: skip
        writers[0].write_modality(state)
        want[frame, "ego"] = state.center_se3.array[:3]
        told = []
        for number in range(5):
            place, angle = rng.normal(0, 30, 3), rng.uniform(-3, 3)
            pose = PoseSE3(*place.tolist(), np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))
            label = NuScenesBoxDetectionLabel(number)
            box = BoundingBoxSE3(pose, 4.0, 2.0, 1.5)
            attributes = BoxDetectionAttributes(label, f"track {number}", 7)
            told.append(BoxDetectionSE3(attributes, box, Vector3D(1.0, 2.0, 0.0)))
            want[frame, f"track {number}"] = place
        writers[1].write_modality(BoxDetectionsSE3(told, time, boxes))
        shown = [TrafficLightDetection(1, TrafficLightStatus(frame % 3))]
        writers[2].write_modality(TrafficLightDetections(shown, time, lights))
    for writer in writers:
        writer.close()
    schema = add_metadata_to_arrow_schema(pa.schema([("sync.timestamp_us", pa.int64())]), about)
    with pa.OSFile(str(log / "sync.arrow"), "wb") as file, pa.ipc.new_file(file, schema) as out:
        out.write_table(pa.table({"sync.timestamp_us": times}, schema=schema))
    town = ArrowMapWriter(force_map_conversion=True, maps_root=logs.parent / "maps", logs_root=logs)
    town.reset(MapMetadata("nuscenes", "boston", map_has_z=True, map_is_per_log=False))
    for ident, low, high in ((1, 0.0, 40.0), (2, 40.0, 90.0)):
        sides = [np.array([[low, y, 0.0], [high, y, 0.0]]) for y in (2.0, -2.0, 0.0)]
        ways = {
            "predecessor_ids": [1] if ident == 2 else [],
            "successor_ids": [2] if ident == 1 else [],
        }
        lines = [Polyline3D.from_array(side) for side in sides]
        town.write_map_object(
            Lane(ident, LaneType.SURFACE_STREET, *lines, **ways, speed_limit_mps=13.0)
        )
    town.close()
    return log, want


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        log, want = write(Path(folder) / "logs")
        with open_trace(log) as trace:
            blocks = list(trace.blocks())
            info, report = trace.info, trace.report
    assert report.frames == FRAMES, report.frames
    assert report.losses == [], report.losses
    idents = [ident for block in blocks for ident in block.entities.ident]
    found: dict[tuple[int, str], Any] = {}
    for block in blocks:
        frames = np.repeat(block.seq, np.diff(block.offsets)).tolist()
        for row, (frame, node) in enumerate(zip(frames, block.states.node.tolist(), strict=True)):
            place = [getattr(block.states, axis)[row] for axis in "xyz"]
            found[frame, idents[node].partition("#")[0]] = place
    apart = [np.abs(np.array(found[key]) - want[key]).max() for key in want]
    assert max(apart) < 1e-6, max(apart)
    assert '"name": "1"' in info.map_text, info.map_text[:300]
    assert any(ident.startswith("light") for ident in idents), idents
    print(f"{len(want)} poses of 123D are equal, at most {max(apart):.1e} m apart; {info.map_name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
