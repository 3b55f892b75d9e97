"""What moved, and when: the poses of every actor on one clock, and what follows from them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

STEP = 0.1
"""Seconds between two poses of a track."""


@dataclass(frozen=True)
class Model:
    """What an actor looks like: OSI type names, the size of its box in metres, its colour (RGB)."""

    name: str
    osi_type: str
    length: float
    width: float
    height: float
    colour: tuple[int, int, int]
    role: str = "ROLE_CIVIL"


@dataclass
class Track:
    """The way of one actor. Row i is the pose of the box's centre on the ground at ``(first + i) · STEP``.

    ``lights`` holds letters of what is lit: ``l`` and ``r`` indicators, ``b`` brake.
    """

    name: str
    model: Model
    first: int = 0
    rows: list[tuple[float, float, float]] = field(default_factory=list)
    lights: list[str] = field(default_factory=list)
    poses: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    moves: np.ndarray = field(default_factory=lambda: np.zeros((0, 5)))

    def finish(self) -> None:
        """Smooth the way and derive the motion: ``moves`` has columns vx, vy, ax, ay, yaw rate.

        SUMO leads vehicles along polylines, so headings jump by a few degrees at each corner. A binomial
        filter over 0.4 s takes these jumps out of the poses, and with them the spikes out of what is
        derived; it shifts no pose in time and leaves straight, even motion as it was.
        """
        rows = np.array(self.rows)
        rows[:, 2] = np.unwrap(rows[:, 2])
        for _ in range(2):
            rows = smoothed(rows)
        moves = np.zeros((len(rows), 5))
        if len(rows) > 1:
            moves[:, 0:2] = np.gradient(rows[:, :2], STEP, axis=0)
            moves[:, 2:4] = np.gradient(moves[:, 0:2], STEP, axis=0)
            moves[:, 4] = np.gradient(rows[:, 2], STEP)
        self.poses, self.moves = rows, moves

    def present(self, step: int) -> bool:
        """Whether the actor is there at a step."""
        return self.first <= step < self.first + len(self.rows)

    def pose_at(self, time: float) -> tuple[float, float, float] | None:
        """x, y and heading at a time in seconds, between two steps if need be; None when it is not there."""
        at = time / STEP - self.first
        if not 0 <= at <= len(self.rows) - 1:
            return None
        i = min(int(at), max(len(self.rows) - 2, 0))
        a, b = self.poses[i], self.poses[min(i + 1, len(self.rows) - 1)]
        x, y, heading = (float(v) for v in a + (b - a) * (at - i))
        return x, y, heading

    def lights_at(self, time: float) -> str:
        """What is lit at a time."""
        return self.lights[min(max(int(time / STEP - self.first), 0), len(self.lights) - 1)]


def smoothed(rows: np.ndarray) -> np.ndarray:
    """Rows filtered by (1, 2, 1) / 4; the ends are kept."""
    if len(rows) < 3:
        return rows
    out = rows.copy()
    out[1:-1] = (rows[:-2] + 2 * rows[1:-1] + rows[2:]) / 4
    return out


def box(pose: tuple[float, float, float], length: float, width: float) -> np.ndarray:
    """Corners of a footprint, ``(4, 2)``: front left, front right, rear right, rear left."""
    x, y, heading = pose
    c, s = math.cos(heading), math.sin(heading)
    local = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (length / 2, width / 2)
    return local @ np.array([[c, s], [-s, c]]) + (x, y)
