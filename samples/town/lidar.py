"""The ego's lidar: rays cast against boxes, the ground and nothing else."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scenery import fixtures

if TYPE_CHECKING:
    from tracks import Track
    from traffic import Recording

MOUNT = (0.0, 0.0, 1.75)
"""Where the lidar sits in the ego's axes; m."""
BEAMS = np.radians(np.concatenate([np.linspace(-17, -3.2, 10), np.linspace(-2.4, 5.5, 8)]))
TURN = 230
"""Rays of each beam in a turn."""
REACH = 60.0
NOISE = 0.012
"""Standard deviation of a range; m."""
GRAIN = 1 / 64
"""Coordinates are multiples of this; m. It keeps the recording small, and exact in 32-bit floats."""
SHINE = {"TYPE_PEDESTRIAN": 60, "TYPE_BUILDING": 95, "TYPE_TREE": 40, "TYPE_POLE": 150}

DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1")])


def rays() -> np.ndarray:
    """Directions of all rays in the sensor's axes, ``(n, 3)``."""
    azimuth = np.linspace(-math.pi, math.pi, TURN, endpoint=False)
    up, turn = (g.ravel() for g in np.meshgrid(BEAMS, azimuth, indexing="ij"))
    return np.column_stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)])


def boxes_near(recording: Recording, ego: Track, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Boxes within reach as rows x, y, heading, length, width, bottom, top, and how bright they shine."""
    x, y, _ = ego.pose_at(time) or (0.0, 0.0, 0.0)
    rows, shine = [], []
    for track in recording.tracks:
        pose = track.pose_at(time)
        if track is not ego and pose is not None:
            m = track.model
            rows.append((*pose, m.length, m.width, 0.15 if m.width > 1 else 0.0, m.height))
            shine.append(SHINE.get(m.osi_type, 110))
    for f in fixtures():
        rows.append((f.x, f.y, f.heading, f.length, f.width, 0.0, f.height))
        shine.append(SHINE[f.osi_type])
        if f.osi_type == "TYPE_TREE":
            rows.append((f.x, f.y, 0.7, 2.6, 2.6, 0.45 * f.height, f.height))
            shine.append(SHINE[f.osi_type])
    table = np.array(rows)
    near = np.hypot(table[:, 0] - x, table[:, 1] - y) < REACH + table[:, 3] / 2
    return table[near], np.array(shine)[near]


def strike(origin: np.ndarray, way: np.ndarray, row: np.ndarray) -> np.ndarray:
    """How far along each ray a box is met; infinite where it is missed. Slabs, in the box's own axes."""
    x, y, heading, length, width, low, high = row
    c, s = math.cos(heading), math.sin(heading)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    start = turn @ (origin - (x, y, 0.0))
    d = way @ turn.T
    d = np.where(np.abs(d) < 1e-9, 1e-9, d)
    a = (np.array([-length / 2, -width / 2, low]) - start) / d
    b = (np.array([length / 2, width / 2, high]) - start) / d
    enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    return np.where((enter <= leave) & (enter > 0.3), enter, np.inf)


def cloud(recording: Recording, ego: Track, time: float, seed: int) -> np.ndarray:
    """Points in the sensor's axes (forward, left, up; m), of :data:`DTYPE`.

    The noise is that of the seed: the same seed gives the same points.
    """
    pose = ego.pose_at(time)
    if pose is None:
        raise ValueError(f"the ego is not there at {time} s")
    x, y, heading = pose
    c, s = math.cos(heading), math.sin(heading)
    local = rays()
    way = local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    origin = np.array([x + MOUNT[0] * c, y + MOUNT[0] * s, MOUNT[2]])
    with np.errstate(divide="ignore"):
        far = np.where(way[:, 2] < -1e-6, -origin[2] / way[:, 2], np.inf)
    bright = np.full(len(way), 35)
    table, shine = boxes_near(recording, ego, time)
    for row, glow in zip(table, shine, strict=True):
        hit = strike(origin, way, row)
        bright = np.where(hit < far, glow, bright)
        far = np.minimum(far, hit)
    kept = far < REACH
    far = far + np.random.default_rng(seed).normal(0.0, NOISE, len(far))
    points = np.round(local[kept] * far[kept, None] / GRAIN) * GRAIN
    out = np.zeros(int(kept.sum()), DTYPE)
    out["x"], out["y"], out["z"] = points.T
    out["intensity"] = np.clip(bright[kept] * (1 - far[kept] / 150), 1, 255).astype(np.uint8)
    return out
