"""Small logs in the layout of 123D. ``oracle_py123d.py`` compares the layout with its own writer."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from recorder_logs import as_mcap

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["as_mcap", "drive", "packed"]

START_US = 1_600_000_000_000_000
BOXES, EGO, LIGHTS = "box_detections_se3", "ego_state_se3", "traffic_light_detections"
FIELDS = {
    BOXES: {
        "timestamp_us": pa.int64(),
        "bounding_box_se3": pa.list_(pa.list_(pa.float64(), 10)),
        "track_token": pa.list_(pa.string()),
        "label": pa.list_(pa.uint16()),
        "velocity_3d": pa.list_(pa.list_(pa.float64(), 3)),
    },
    EGO: {
        "timestamp_us": pa.int64(),
        "imu_se3": pa.list_(pa.float64(), 7),
        "dynamic_state_se3": pa.list_(pa.float64(), 9),
    },
    LIGHTS: {
        "timestamp_us": pa.int64(),
        "lane_id": pa.list_(pa.int32()),
        "status": pa.list_(pa.uint8()),
    },
}
LABELS = "py123d.parser.registry.NuPlanBoxDetectionLabel"
NORTH = [2**-0.5, 0.0, 0.0, 2**-0.5]


def packed(value: Any) -> bytes:  # noqa: PLR0911  (a case a type)
    """A value as MessagePack, in the long forms."""
    match value:
        case None:
            return b"\xc0"
        case bool():
            return b"\xc3" if value else b"\xc2"
        case int():
            return b"\xd3" + struct.pack(">q", value)
        case float():
            return b"\xcb" + struct.pack(">d", value)
        case str():
            return b"\xdb" + struct.pack(">I", len(value.encode())) + value.encode()
        case bytes():
            return b"\xc6" + struct.pack(">I", len(value)) + value
        case np.ndarray():
            told = {b"__ndarray__": True, b"dtype": value.dtype.str, b"shape": list(value.shape)}
            return packed(told | {b"data": value.tobytes()})
        case dict():
            pairs = b"".join(packed(key) + packed(of) for key, of in value.items())
            return b"\xdf" + struct.pack(">I", len(value)) + pairs
    return b"\xdd" + struct.pack(">I", len(value)) + b"".join(map(packed, value))


def write(path: Path, table: pa.Table, about: dict[str, Any]) -> None:
    table = table.replace_schema_metadata({b"metadata": packed(about)})
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_file(file, table.schema) as writer:
        writer.write_table(table, max_chunksize=10)


def table_of(key: str, rows: list[dict[str, Any]]) -> pa.Table:
    schema = pa.schema([(f"{key}.{name}", kind) for name, kind in FIELDS[key].items()])
    told = [{f"{key}.{name}": value for name, value in row.items()} for row in rows]
    return pa.Table.from_pylist(told, schema)


def drive(path: Path, frames: int = 25) -> Path:
    """The ego drives north at 10 m/s behind a vehicle, at a red light that turns green."""
    path.mkdir(parents=True)
    boxes: list[dict[str, Any]] = []
    egos: list[dict[str, Any]] = []
    lights: list[dict[str, Any]] = []
    for i in range(frames):
        time, y = START_US + i * 100_000, 50.0 + i
        box = [100.0, y + 20, 10.7, *NORTH, 4.5, 1.9, 1.5]
        cone = [103.0, 70.0, 10.4, 1.0, 0.0, 0.0, 0.0, 0.3, 0.3, 0.8]
        boxes.append(
            {
                "timestamp_us": time,
                "bounding_box_se3": [box, cone],
                "track_token": ["v1", "c1"],
                "label": [0, 3],
                "velocity_3d": [[0.0, 10.0, 0.0], None],
            }
        )
        motion = [10.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.1]
        pose = [100.0, y, 10.0, *NORTH]
        egos.append({"timestamp_us": time, "imu_se3": pose, "dynamic_state_se3": motion})
        lights.append({"timestamp_us": time, "lane_id": [12], "status": [2 if i < 5 else 0]})
    about = {"dataset": "nuplan", "split": "nuplan_val", "log_name": "drive", "location": "boston"}
    write(
        path / "sync.arrow",
        pa.table({"sync.timestamp_us": [row["timestamp_us"] for row in boxes]}),
        about,
    )
    write(path / f"{BOXES}.arrow", table_of(BOXES, boxes), {"box_detection_label_class": LABELS})
    size = {"vehicle_name": "van", "length": 5.2, "width": 2.3, "height": 1.8, "wheel_base": 3.1}
    places = {"center_to_imu_se3": [1.5, 0.0, 0.8, 1.0, 0.0, 0.0, 0.0]}
    write(path / f"{EGO}.arrow", table_of(EGO, egos), size | places)
    write(path / f"{LIGHTS}.arrow", table_of(LIGHTS, lights), {})
    write(path / "map.arrow", pa.table(world()), about)
    return path


def north(x: float, low: float, high: float) -> Any:
    return np.array([[x, low, 10.0], [x, high, 10.0]])


def lane(left: Any, right: Any, **more: Any) -> dict[str, Any]:
    told = {"lane_type": 2, "lane_group_id": 5, "left_boundary": left, "right_boundary": right}
    told |= {
        "left_lane_id": None,
        "right_lane_id": None,
        "predecessor_ids": [],
        "successor_ids": [],
    }
    return told | {"speed_limit_mps": 13.4} | more


def world() -> dict[str, Any]:
    """Two lanes one after the other, the second in an intersection, and a crosswalk."""
    objects = [
        (11, 0, lane(north(98, 40, 80), north(102, 40, 80), successor_ids=[12, 99])),
        (12, 0, lane(north(98, 80, 99), north(102, 80, 99), predecessor_ids=[11], lane_group_id=6)),
        (5, 1, {"intersection_id": None}),
        (6, 1, {"intersection_id": 7}),
        (9, 3, {"outline": np.array([[96.0, 76, 10], [104, 76, 10], [104, 79, 10], [96, 79, 10]])}),
    ]
    columns = zip(*((ident, layer, packed(told)) for ident, layer, told in objects), strict=True)
    return dict(zip(("object_id", "map_layer", "features"), map(list, columns), strict=True))
