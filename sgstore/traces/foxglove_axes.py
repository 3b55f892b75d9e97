"""Axes that move in other axes: a tree of ``foxglove.FrameTransform``, asked for the pose of any at any time.

Between two transforms a pose is interpolated: places along the line, turns along the shorter arc. Before the
first and behind the last transform it is the nearest one.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from sgstore.world import Floats

MAX_AXES: Final = 10_000
"""Axes of a recording; those of more are not taken up."""
MAX_DEPTH: Final = 64
"""Greatest number of transforms from any axes to those that stand still."""
MAX_KEPT: Final = 4096
"""Transforms of one pair of axes that are remembered at once."""

Pose = tuple["Floats", "Floats"]
"""Place (3,) and turn (4,), a quaternion x, y, z, w of length 1."""

STILL: Final = np.array([0.0, 0.0, 0.0, 1.0])
ORIGIN: Final = np.zeros(3)


@dataclass(slots=True)
class _Track:
    """Where axes were in their parent: times, ascending, and poses."""

    parent: str
    times: list[int] = field(default_factory=list[int])
    poses: list[Pose] = field(default_factory=list)  # pyright: ignore[reportUnknownVariableType]

    def at(self, time_ns: int) -> Pose:
        behind = bisect_left(self.times, time_ns)
        if behind == len(self.times):
            return self.poses[-1]
        if behind == 0 or self.times[behind] == time_ns:
            return self.poses[behind]
        start, stop = self.times[behind - 1], self.times[behind]
        share = (time_ns - start) / (stop - start)
        (p0, q0), (p1, q1) = self.poses[behind - 1], self.poses[behind]
        q1 = -q1 if float(q0 @ q1) < 0 else q1
        return p0 + share * (p1 - p0), normed(q0 + share * (q1 - q0))


@dataclass(slots=True)
class Axes:
    """The axes of a recording.

    Attributes
    ----------
    parents : dict
        Axes → the axes that they move in, as was told first.
    """

    parents: dict[str, str] = field(default_factory=dict[str, str])
    _tracks: dict[str, _Track] = field(default_factory=dict[str, _Track])

    def tell(self, child: str, parent: str, time_ns: int, pose: Pose) -> bool:
        """Take up where axes are in others; ``False`` if that contradicts what was told, or is too much."""
        track = self._tracks.get(child)
        if track is None:
            if len(self._tracks) >= MAX_AXES or child == parent:
                return False
            track = self._tracks[child] = _Track(parent)
            self.parents[child] = parent
        if track.parent != parent:
            return False
        if not track.times or time_ns > track.times[-1]:
            track.times.append(time_ns)
            track.poses.append(pose)
        else:
            at = bisect_left(track.times, time_ns)
            if at < len(track.times) and track.times[at] == time_ns:
                track.poses[at] = pose
            else:
                insort(track.times, time_ns)
                track.poses.insert(at, pose)
        if len(track.times) > MAX_KEPT:
            del track.times[: MAX_KEPT // 2], track.poses[: MAX_KEPT // 2]
        return True

    def pose(self, axes: str, root: str, time_ns: int) -> Pose | None:
        """The pose of axes in others that they move in, directly or not; ``None`` if they do not."""
        place, turn = ORIGIN, STILL
        for _ in range(MAX_DEPTH):
            if axes == root:
                return place, turn
            track = self._tracks.get(axes)
            if track is None:
                return None
            outer_place, outer_turn = track.at(time_ns)
            place = outer_place + rotated(outer_turn, place)
            turn = product(outer_turn, turn)
            axes = track.parent
        return None

    def root(self) -> str:
        """The axes that move in no others, if there is one such; else the empty string."""
        roots = set(self.parents.values()) - set(self.parents)
        return roots.pop() if len(roots) == 1 else ""

    def forget(self, before_ns: int) -> None:
        """Forget what is not needed any more to know poses from a time on."""
        for track in self._tracks.values():
            keep = bisect_right(track.times, before_ns) - 1
            if keep > 0:
                del track.times[:keep], track.poses[:keep]


def normed(turn: Floats) -> Floats:
    """A quaternion of length 1; the one that turns nothing for one of no length."""
    largest = float(np.abs(turn).max())
    if not 0 < largest < np.inf:
        return STILL
    scaled = turn / largest  # the squares of very small numbers are 0
    return scaled / np.sqrt(scaled @ scaled)


def product(a: Floats, b: Floats) -> Floats:
    """The turn b followed by the turn a."""
    ax, ay, az, aw = a.tolist()
    bx, by, bz, bw = b.tolist()
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def rotated(turn: Floats, vectors: Floats) -> Floats:
    """Vectors (3,) or (n, 3), turned."""
    x, y, z, w = turn.tolist()
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return vectors @ matrix.T


def angles(turn: Floats) -> tuple[float, float, float]:
    """Heading, pitch and roll of a quaternion; rad. Pitch is positive with the nose down, as in OSI."""
    x, y, z, w = turn.tolist()
    sine = max(-1.0, min(1.0, 2 * (w * y - z * x)))
    return (
        float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))),
        float(np.arcsin(sine)),
        float(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))),
    )
