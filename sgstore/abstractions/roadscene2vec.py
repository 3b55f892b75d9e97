"""``roadscene2vec``: the graphs of the tool of that name (Malawade et al., 2022), with its own thresholds.

Its actors (``car``, which is whatever is as large, ``moto``, ``bicycle``, ``ped``, ``light``, ``sign``) are
related to the ego, ``ego_car``, and to nothing else. There are three lanes in ``Root Road``: the ego is in the
middle one, and so is all whose centre is within 6 m to its left and right; the rest is in the left or right
one. A distance has the first of five names whose threshold it does not exceed; bins of direction include both
their ends, so that at exactly 45° there are two relations. What never moves is there without relations. The
tool's slips are not imitated: its angle for CARLA is the difference of yaws.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.abstractions.columns import Labelled
from sgstore.abstractions.literature import ROOT_ROAD
from sgstore.vocabulary import KINDS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sgstore.abstractions.columns import Part, Seen

ACTORS: Final[Mapping[str, str]] = {
    **dict.fromkeys(("car", "truck", "van", "bus", "trailer"), "car"),
    "motorcycle": "moto",
    "bicycle": "bicycle",
    "person": "ped",
    "traffic_light": "light",
    **dict.fromkeys(("stop_sign", "yield_sign", "speed_limit", "sign"), "sign"),
}
"""Our kinds → its actors; other kinds it does not have."""

PROXIMITY: Final = (
    ("near_coll", 4.0),
    ("super_near", 7.0),
    ("very_near", 10.0),
    ("near", 16.0),
    ("visible", 25.0),
)
"""Names and thresholds; m, between centres in space."""

DIRECTIONS: Final = (
    ("inDFrontOf", 0.0, 45.0),
    ("inSFrontOf", 45.0, 90.0),
    ("atSRearOf", 90.0, 135.0),
    ("atDRearOf", 135.0, 180.0),
)
"""Names and bins of the bearing, either way; degrees, both ends included."""

LANE_THRESHOLD: Final = 6.0
"""Half the width of the middle lane; m."""

LANES: Final = ("Left Lane", "Middle Lane", "Right Lane")

_NODES: Final = (*dict.fromkeys(ACTORS.values()), "ego_car", "Root Road", *LANES)
_EDGES: Final = (
    "isIn",
    *(name for name, _ in PROXIMITY),
    *(name for name, *_ in DIRECTIONS),
    *("toLeftOf", "toRightOf"),
)
_LABELS: Final = (*_NODES, *_EDGES)
_LABEL: Final = {text: i for i, text in enumerate(_LABELS)}
_ACTOR: Final = np.array([_LABEL[ACTORS[k]] if k in ACTORS else -1 for k in KINDS])
_LANE_NODES: Final = ROOT_ROAD - 1 - np.arange(len(LANES))


def roadscene2vec(seen: Seen) -> Labelled:
    """``roadscene2vec``: actors, related to the ego, in three lanes."""
    label = np.where(seen.is_ego, _LABEL["ego_car"], _ACTOR[seen.kind])
    rows = np.flatnonzero(label >= 0)
    frames = np.arange(seen.frames)
    fixed = [(frames, np.full(seen.frames, ROOT_ROAD), np.full(seen.frames, _LABEL["Root Road"]))]
    edges: list[Part] = []
    for name, node in zip(LANES, _LANE_NODES.tolist(), strict=True):
        lane = np.full(seen.frames, node)
        fixed.append((frames, lane, np.full(seen.frames, _LABEL[name])))
        edges.append((frames, lane, _all(frames, "isIn"), np.full(seen.frames, ROOT_ROAD)))
    nodes = [(seen.node_frame[rows], seen.node[rows], label[rows]), *fixed]
    return Labelled.assembled(
        seen.frames,
        nodes,
        [*edges, *_of_ego(seen, rows)],
        _LABELS,
    )


def _all(rows: NDArray[np.signedinteger], label: str) -> NDArray[np.signedinteger]:
    return np.full(len(rows), _LABEL[label])


def _of_ego(seen: Seen, rows: NDArray[np.signedinteger]) -> list[Part]:
    """Lanes of all actors, and their relations to the ego; of those whose places are known."""
    ego = np.full(seen.frames, -1)
    own = np.flatnonzero(seen.is_ego)
    ego[seen.node_frame[own]] = own
    middle = int(_LANE_NODES[1])
    edges = [(seen.node_frame[own], seen.node[own], _all(own, "isIn"), np.full(len(own), middle))]
    rows = rows[(ego[seen.node_frame[rows]] >= 0) & ~seen.is_ego[rows]]
    at = ego[seen.node_frame[rows]]
    dx, dy, dz = (getattr(seen, axis)[rows] - getattr(seen, axis)[at] for axis in "xyz")
    heading = seen.heading[at]
    ahead = dx * np.cos(heading) + dy * np.sin(heading)
    left = dy * np.cos(heading) - dx * np.sin(heading)
    known = np.flatnonzero(np.isfinite(ahead) & np.isfinite(left))
    rows, at, ahead, left = rows[known], at[known], ahead[known], left[known]
    distance = np.sqrt(ahead**2 + left**2 + np.nan_to_num(dz[known]) ** 2)
    bearing = np.abs(np.degrees(np.arctan2(left, ahead)))
    frame, node, ego_node = seen.node_frame[rows], seen.node[rows], seen.node[at]
    lane = 1 - (left > LANE_THRESHOLD).astype(np.int64) + (left < -LANE_THRESHOLD)
    edges.append((frame, node, _all(node, "isIn"), _LANE_NODES[lane]))

    def add(label: str, where: NDArray[np.signedinteger], *, both: bool = False) -> None:
        ends = [(node, ego_node), (ego_node, node)][: 2 if both else 1]
        for src, dst in ends:
            part = (frame[where], src[where], _all(where, label), dst[where])
            edges.append(part)

    low = -1.0
    for name, high in PROXIMITY:
        add(name, np.flatnonzero((distance > low) & (distance <= high)), both=True)
        low = high
    near = distance <= PROXIMITY[-1][1]
    for name, first, last in DIRECTIONS:
        add(name, np.flatnonzero(near & (bearing >= first) & (bearing <= last)))
    add("toLeftOf", np.flatnonzero(near & (lane == 0)))
    add("toRightOf", np.flatnonzero(near & (lane == 2)))
    return edges
