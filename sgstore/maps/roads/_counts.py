"""Summary of a road map: numbers of lanes, roads, junctions and so on."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from sgstore.model.vocabulary import ENTITY_KINDS, KINDS, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sgstore.maps.roads._map import RoadMap


@dataclass(frozen=True, slots=True)
class MapCount:
    """Number and total length of all map parts of one kind, such as driving lanes.

    Attributes
    ----------
    part : str
        ``lane``, ``road``, ``junction``, ``crosswalk``, ``signal``, ``controller``, ``object`` or ``warning``.
    kind : str
        Type of the lanes, roads or junctions; kind of the signals or objects; text of the warning.
    count : int
    length : float or None
        Total length; m.
    """

    part: str
    kind: str
    count: int
    length: float | None = None


def summary(road_map: RoadMap) -> list[MapCount]:
    """Summarise a road map: numbers of lanes by type, of roads, junctions and so on, and warnings.

    A road with several types counts under each type, with its length of that type.
    """
    nodes = road_map.nodes
    kinds = [KINDS[int(code)] for code in nodes.kind]
    lanes = [(nodes.lane_type[row], float(nodes.length[row])) for row in _of(kinds, "lane")]
    junctions = [road_map.junction_types.get(nodes.name[r], "") for r in _of(kinds, "junction")]
    signals = Counter(kind for kind in kinds if kind in SIGNALS)
    objects = Counter(kind for kind in kinds if kind in ENTITY_KINDS and kind not in SIGNALS)
    single = [
        MapCount("crosswalk", "", kinds.count("crosswalk")),
        *(MapCount("signal", kind, count) for kind, count in signals.most_common()),
        MapCount("controller", "", len(road_map.controllers)),
        *(MapCount("object", kind, count) for kind, count in objects.most_common()),
    ]
    return [
        *_measured("lane", lanes),
        *_measured("road", _stretches(road_map, kinds)),
        *(MapCount("junction", kind, count) for kind, count in Counter(junctions).most_common()),
        *(part for part in single if part.count),
        *(MapCount("warning", text, count) for text, count in Counter(road_map.warnings).items()),
    ]


def _of(kinds: list[str], kind: str) -> list[int]:
    return [row for row, found in enumerate(kinds) if found == kind]


def _measured(part: str, lengths: Iterable[tuple[str, float]]) -> list[MapCount]:
    """Count map parts (such as lanes) by kind, with their total length. The longest kind comes first."""
    count: Counter[str] = Counter()
    total: defaultdict[str, float] = defaultdict(float)
    for kind, length in lengths:
        count[kind] += 1
        total[kind] += float(np.nan_to_num(length))
    order = sorted(count, key=lambda kind: (-total[kind], kind))
    return [MapCount(part, kind, count[kind], total[kind]) for kind in order]


def _stretches(road_map: RoadMap, kinds: list[str]) -> Iterable[tuple[str, float]]:
    """Yield type and length of each section of a road that has one road type. An unknown type is empty."""
    nodes = road_map.nodes
    for row in _of(kinds, "road"):
        length = float(nodes.length[row])
        types = road_map.road_types.get(nodes.name[row], ())
        cuts = [start if 0 <= start <= length else 0.0 for start, _ in types] + [length]
        held: defaultdict[str, float] = defaultdict(float)
        for (_, kind), (start, end) in zip(types, pairwise(cuts), strict=True):
            held[kind] += max(end - start, 0.0)
        yield from held.items() or [("", length)]
