"""Positions and rotations of the ego and its sensors in the map axes, for each frame of a clip.

A viewer can draw sensor data only with the pose of its axes. Each frame of a clip with graphs
contains these poses, as ``foxglove.FrameTransforms``:

* ``map`` → ``ego``: the middle of the underside of the ego's box, on the ground; x ahead, y left, z up;
* ``ego`` → the axes of each sensor with a known pose (:class:`Mount`);
* ``map`` → ``global``, the same axes, for recordings of ASAM OSI: the name of the world in
  converters.

If a recording has its own transforms, the ego's axes are named ``sgstore/ego``, because axes cannot
have two parents.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError
from sgstore.exporters._foxglove import AXES, AxesTransform, quaternion, turn_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    from sgstore.model.graph import SceneGraph

EGO: Final = "ego"
OWN_EGO: Final = "sgstore/ego"
"""Names of the ego's coordinate axes. The second one is for recordings with their own transforms."""
GLOBAL: Final = "global"
"""Name of the world's coordinate axes in converters of OSI."""

FORM: Final = "[PARENT:]CHILD=X,Y,Z[,YAW[,PITCH,ROLL]]"
TOLD: Final = frozenset(
    {
        *("foxglove.FrameTransform", "foxglove.FrameTransforms"),
        *("tf2_msgs/msg/TFMessage", "tf2_msgs/TFMessage"),
    }
)
"""Names of message schemas for transforms in recordings."""


@dataclass(frozen=True, slots=True)
class Mount:
    """Constant pose (position and rotation) of a sensor on the ego, or of coordinate axes in other axes.

    Attributes
    ----------
    child : str
        Axes, by their name in the messages of the sensor (``frame_id``).
    place : tuple of float
        x, y, z of its origin; m.
    yaw, pitch, roll : float
        Turns about z, then about its new y (positive with the nose down), then about its new x;
        degrees. Optical axes of a camera that looks ahead (z ahead, x to the right) are -90, 0,
        -90.
    parent : str
        Reference axes of the pose.
    """

    child: str
    place: tuple[float, float, float]
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    parent: str = EGO


def parse_mounts(texts: Iterable[str]) -> tuple[Mount, ...]:
    """Return sensor mounts from texts ``[PARENT:]CHILD=X,Y,Z[,YAW[,PITCH,ROLL]]``, in m and degrees.

    Raises
    ------
    ExportError
        A text is invalid, or axes have two parents.
    """
    found: dict[str, Mount] = {}
    for text in texts:
        name, _, rest = text.rpartition("=")
        parent, colon, child = name.strip().partition(":")
        if not colon:
            parent, child = EGO, parent
        numbers = _numbers(rest)
        if not child or not parent or len(numbers) not in {3, 4, 6}:
            raise ExportError(f"not a transform: {text!r}; expected {FORM}, in m and degrees")
        if child in found or child in {EGO, AXES} or _ends(parent, found) == child:
            raise ExportError(f"the axes {child!r} have a place already: {text!r}")
        found[child] = Mount(
            child, (numbers[0], numbers[1], numbers[2]), *numbers[3:], parent=parent
        )
    return tuple(found.values())


def _ends(axes: str, mounts: Mapping[str, Mount]) -> str:
    """Follow the parents of coordinate axes, and return the last one."""
    while axes in mounts:
        axes = mounts[axes].parent
    return axes


def _numbers(text: str) -> list[float]:
    """Return the numbers of a comma-separated text; an empty list if a number is invalid or infinite."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        return []
    return numbers if all(map(math.isfinite, numbers)) else []


class FrameTransforms:
    """Positions and rotations of the ego and its sensors in each frame of a recording.

    Parameters
    ----------
    schemas : collection of str
        Names of the schemas of the recording's channels.
    mounts : iterable of Mount
    """

    def __init__(self, schemas: Collection[str], mounts: Iterable[Mount]) -> None:
        names = set(schemas)
        self.ego = OWN_EGO if names & TOLD else EGO
        self._fixed = [
            AxesTransform(
                self.ego if one.parent == EGO else one.parent,
                one.child,
                one.place,
                quaternion(*map(math.radians, (one.yaw, one.pitch, one.roll))),
            )
            for one in mounts
        ]
        if any(name.startswith("osi3.") for name in names) and GLOBAL not in {
            one.child for one in self._fixed
        }:
            self._fixed.append(AxesTransform(AXES, GLOBAL, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))

    def of(self, graph: SceneGraph) -> Iterator[AxesTransform]:
        """Yield the poses (position and rotation) for a frame. Without an ego, yield only the constant ones."""
        about = graph.nodes.get(graph.ego) if graph.ego is not None else None
        if about is not None and "x" in about and "y" in about:
            yield _of_ego(about, self.ego)
        yield from self._fixed


def _of_ego(about: dict[str, Any], name: str) -> AxesTransform:
    turn = turn_of(about)
    centre = np.array([about["x"], about["y"], about.get("z", 0.0)])
    down = matrix(*turn)[:, 2] * about.get("height", 0.0) / 2
    x, y, z = (centre - down).tolist()
    return AxesTransform(AXES, name, (x, y, z), quaternion(*turn))


def matrix(yaw: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of yaw, pitch and roll in radians.

    Its columns are the turned x, y and z.
    """
    cy, cp, cr = (math.cos(angle) for angle in (yaw, pitch, roll))
    sy, sp, sr = (math.sin(angle) for angle in (yaw, pitch, roll))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
