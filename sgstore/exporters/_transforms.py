"""Transforms of clips: where the ego and its sensors are in the axes of the scene graphs.

A viewer draws what a sensor measured only if it knows where the axes of its messages lie. Each frame of a clip
with graphs tells it, as ``foxglove.FrameTransforms``:

* ``map`` → ``ego``: the middle of the underside of the ego's box, on the ground; x ahead, y left, z up;
* ``ego`` → the axes of each sensor of which somebody said where it sits (:class:`Mount`);
* ``map`` → ``global``, the same axes, for recordings of ASAM OSI: converters call the world so.

Where a recording has transforms of its own, the ego's axes are called ``sgstore/ego``, so that axes have no two
parents.
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

    from sgstore.graph import SceneGraph

EGO: Final = "ego"
OWN_EGO: Final = "sgstore/ego"
"""Axes of the ego; the second where a recording has transforms of its own."""
GLOBAL: Final = "global"
"""The world, as those call it who convert OSI for viewers."""

FORM: Final = "[PARENT:]CHILD=X,Y,Z[,YAW[,PITCH,ROLL]]"
TOLD: Final = frozenset(
    {
        *("foxglove.FrameTransform", "foxglove.FrameTransforms"),
        *("tf2_msgs/msg/TFMessage", "tf2_msgs/TFMessage"),
    }
)
"""Schemas by which recordings tell transforms."""


@dataclass(frozen=True, slots=True)
class Mount:
    """A place that does not change: of a sensor in the axes of the ego, or of any axes in others.

    Attributes
    ----------
    child : str
        Axes, as the messages of the sensor call them (``frame_id``).
    place : tuple of float
        x, y, z of its origin; m.
    yaw, pitch, roll : float
        How it is turned: about z, then about its new y (positive with the nose down), then about its new x;
        degrees. Optical axes of a camera that looks ahead (z ahead, x to the right) are -90, 0, -90.
    parent : str
        Axes in which that is so.
    """

    child: str
    place: tuple[float, float, float]
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    parent: str = EGO


def parse_mounts(texts: Iterable[str]) -> tuple[Mount, ...]:
    """Mounts from texts of the form ``[PARENT:]CHILD=X,Y,Z[,YAW[,PITCH,ROLL]]``; m and degrees.

    Raises
    ------
    ExportError
        One of them has another form, or axes have two parents.
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
    """The axes in which some lie at the last."""
    while axes in mounts:
        axes = mounts[axes].parent
    return axes


def _numbers(text: str) -> list[float]:
    """Finite numbers between commas; none if one of them is not."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        return []
    return numbers if all(map(math.isfinite, numbers)) else []


class FrameTransforms:
    """Transforms that each frame of the clips of one recording tells.

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
        """The transforms of a frame; without an ego, those that do not change."""
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
    """A turn about z, then about the new y, then about the new x, as a matrix; rad.

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
