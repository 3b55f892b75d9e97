"""Small logs in the layout of Argoverse 2: a folder with annotations, poses of the ego, and a map."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pyarrow as pa
from pyarrow import feather
from recorder_logs import as_mcap

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["as_mcap", "drive", "write_boxes"]

START = 315_971_916_960_141_000
POSES = "city_SE3_egovehicle.feather"
NORTH = 2**-0.5  # Half a right angle to the left.


def drive(path: Path, frames: int = 25, *, ego: bool = True) -> Path:
    """The ego drives north at 10 m/s behind a bicycle, past a cone that appears in the second frame."""
    (path / "map").mkdir(parents=True)
    poses = [
        pose(START + i * 50_000_000, 100.0, 50.0 + i / 2, 10.0, NORTH, NORTH)
        for i in range(2 * frames)
    ]
    write(path / POSES, poses)
    write_boxes(path, frames, ego=ego)
    (path / "map/log_map_archive_log.json").write_text(json.dumps(world()))
    return path


def pose(
    time: int, x: float, y: float, z: float, w: float = 1.0, turn: float = 0.0
) -> dict[str, Any]:
    angles = {"qw": w, "qx": 0.0, "qy": 0.0, "qz": turn}
    return {"timestamp_ns": time} | angles | {"tx_m": x, "ty_m": y, "tz_m": z}


def box(
    time: int, track: str, category: str, *place: float, size: tuple[float, ...]
) -> dict[str, Any]:
    told = {"track_uuid": track, "category": category}
    told |= dict(zip(("length_m", "width_m", "height_m"), size, strict=True))
    return pose(time, *place) | told


def write_boxes(path: Path, frames: int, *, ego: bool = True, bad: bool = False) -> None:
    rows: list[dict[str, Any]] = []
    for i in range(frames):
        time = START + i * 100_000_000
        rows += [box(time, "me", "EGO_VEHICLE", 0.0, 0.0, 0.0, size=(4.9, 2.0, 1.5))] if ego else []
        rows.append(box(time, "bike", "BICYCLE", 10.0, 2.0, 0.5, size=(1.8, 0.6, 1.2)))
        if i:
            rows.append(
                box(time, "cone", "CONSTRUCTION_CONE", 30.0 - i, -3.0, 0.4, size=(0.3, 0.3, 0.8))
            )
    if bad:
        rows[-1]["tx_m"] = float("nan")
    write(path / "annotations.feather", rows)


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    feather.write_feather(pa.Table.from_pylist(rows), str(path), chunksize=30)


def line(*points: tuple[float, float]) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": 10.0} for x, y in points]


def north(x: float, *ys: float) -> list[tuple[float, float]]:
    return [(x, y) for y in ys]


def segment(ident: int, left: Any, right: Any, **more: Any) -> dict[str, Any]:
    told: dict[str, Any] = {"id": ident, "is_intersection": False, "lane_type": "VEHICLE"}
    told |= {"left_lane_boundary": line(*left), "right_lane_boundary": line(*right)}
    told |= {"left_lane_mark_type": "SOLID_YELLOW", "right_lane_mark_type": "DASHED_WHITE"}
    told |= {
        "successors": [],
        "predecessors": [],
        "left_neighbor_id": None,
        "right_neighbor_id": None,
    }
    return told | more


def world() -> dict[str, Any]:
    """A lane to the north, a bus lane to its right, a way through an intersection, and a crosswalk."""
    dashed = {"left_lane_mark_type": "DASHED_WHITE"}
    lanes = [
        segment(1, north(98, 40, 80), north(102, 40, 80), right_neighbor_id=2, successors=[3, 9]),
        segment(2, north(102, 40, 80), north(105, 40, 60, 80), left_neighbor_id=1, **dashed),
        segment(3, north(98, 80, 90), north(102, 80, 90), is_intersection=True, predecessors=[1]),
    ]
    lanes[1]["lane_type"] = "BUS"
    walk = {"id": 7, "edge1": line((96, 84), (104, 84)), "edge2": line((96, 88), (104, 88))}
    return {
        "lane_segments": {str(one["id"]): one for one in lanes},
        "pedestrian_crossings": {"7": walk},
        "drivable_areas": {},
    }
