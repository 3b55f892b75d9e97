"""The driven lane in junctions, by entry and exit: ``python oracle_driven_lanes.py RECORDING ...``.

A passage is a run of frames with the centre of a vehicle in lanes of a junction alone. The lane before it
(entry) and the lane after it (exit) are certain: they do not overlap others. The driven lanes are the lanes of
the junction on the ways from entry to exit. A passage without both ends, or without a way, has no reference.
A store must have a driven lane as the primary lane in each of the frames. A vehicle turns left or right in a
passage if all its ways do, and the words `turns_left` and `turns_right` of the library must find it there.
"""

from __future__ import annotations

import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import networkx as nx
import numpy as np
import shapely

from sgstore.ingest import ingest
from sgstore.maps.map_files import Maps
from sgstore.model.config import Config, RangeSettings
from sgstore.model.vocabulary import DRIVING, KIND_CODE, RELATION_CODE, VEHICLES
from sgstore.query import Store
from sgstore.readers import on_map, open_trace

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap

CODES = [KIND_CODE[kind] for kind in VEHICLES]
WIDE = Config(range=RangeSettings(radius=2000.0))
"""Settings with all vehicles in the graphs."""
LOST = 20
"""Frames without a lane below the centre, within a passage or at its ends."""
BOX = ("x", "y", "heading", "length", "width")
LONGEST = 8
"""Most lanes of a way through a junction."""


@dataclass
class Passage:
    """Frames of a vehicle in a junction, and the lanes of its ways; no lanes without a reference."""

    node: int
    first: int
    last: int
    lanes: set[int] = field(default_factory=set)
    turn: str = ""

    def has(self, node: int, seq: int) -> bool:
        """True if a frame of a vehicle belongs to the passage."""
        return self.node == node and self.first <= seq <= self.last


class Ways:
    """Lanes of a map that contain points, and the ways through its junctions."""

    def __init__(self, road_map: RoadMap) -> None:
        nodes, edges = road_map.nodes, road_map.edges
        self.map, self.turn = road_map, nodes.turn
        self.lanes = [-1 - c for c, kind in enumerate(nodes.lane_type) if kind in DRIVING]
        self.inner = {lane for lane in self.lanes if nodes.junction[-1 - lane]}
        self.shapes = road_map.outlines()
        flow = edges.relation == RELATION_CODE["travelsTo"]
        self.graph = nx.DiGraph(
            zip(edges.src[flow].tolist(), edges.dst[flow].tolist(), strict=True)
        )
        shapely.prepare(self.shapes)

    def holding(self, boxes: np.ndarray, bottom: np.ndarray) -> list[set[int]]:
        """Return the driving lanes that contain each centre and lead the way that the body faces."""
        hits = self.map.lanes_of(boxes, bottom)
        found: list[set[int]] = [set() for _ in boxes]
        known = set(self.lanes)
        points = shapely.points(boxes[:, :2])
        for row, lane, turned in zip(
            hits.row.tolist(), hits.lane.tolist(), hits.heading_error.tolist(), strict=True
        ):
            shape = self.shapes[-1 - lane]
            if lane in known and not abs(turned) > np.pi / 2 and shape.covers(points[row]):
                found[row].add(lane)
        return found

    def between(self, entry: int, out: int) -> list[list[int]]:
        """Return the lanes of each way from an entry to an exit through lanes of junctions."""
        if entry not in self.graph or out not in self.graph:
            return []
        inside = self.graph.subgraph(self.inner | {entry, out})
        return [way[1:-1] for way in nx.all_simple_paths(inside, entry, out, LONGEST)]

    def passages(self, node: int, frames: list[int], held: list[set[int]]) -> list[Passage]:
        """Return the passages of a vehicle; ``held`` are the lanes in each of its frames."""
        found: list[Passage] = []
        frames = [seq for seq, lanes in zip(frames, held, strict=True) if lanes]
        held = [lanes for lanes in held if lanes]
        inside = [lanes <= self.inner for lanes in held]
        start = 0
        for at in range(1, len(frames) + 1):
            joined = at < len(frames) and frames[at] <= frames[at - 1] + LOST
            if joined and inside[at] == inside[start]:
                continue
            if inside[start]:
                one = Passage(node, frames[start], frames[at - 1])
                before = (
                    held[start - 1] if start and one.first <= frames[start - 1] + LOST else set()
                )
                after = held[at] if joined else set()
                ways = [
                    way
                    for entry in before - self.inner
                    for out in after - self.inner
                    for way in self.between(entry, out)
                ]
                one.lanes = {lane for way in ways for lane in way}
                turns = {self.turn[-1 - lane] for lane in one.lanes} - {""}
                one.turn = turns.pop() if len(turns) == 1 else ""
                found.append(one)
            start = at
        return found


def passages_of(path: Path, road_map: Path | None = None) -> tuple[list[Passage], RoadMap]:
    """Return the passages of all vehicles of a recording, and the map."""
    boxes: dict[int, list[tuple[int, list[float], float]]] = defaultdict(list)
    kinds = np.zeros(0, np.int8)
    with open_trace(path) as trace:
        found, _ = Maps(road_map, Config().signs).of(trace.info)
        on_map(trace, found)
        for block in trace.blocks():
            kinds, states = np.append(kinds, block.entities.kind), block.states
            for row in np.flatnonzero(np.isin(kinds[states.node], CODES)).tolist():
                box = [float(getattr(states, n)[row]) for n in BOX]
                bottom = float(states.z[row] - np.nan_to_num(states.height[row]) / 2)
                seq = int(block.seq[block.frame_of[row]])
                boxes[int(states.node[row])].append((seq, box, bottom))
    assert found is not None
    ways, passages = Ways(found), list[Passage]()
    for node, rows in boxes.items():
        held = ways.holding(np.array([b for _, b, _ in rows]), np.array([z for *_, z in rows]))
        passages += ways.passages(node, [seq for seq, *_ in rows], held)
    return passages, found


@dataclass
class Figures:
    """Frames and passages with a reference, right frames, and found turns."""

    passages: int = 0
    unknown: int = 0
    frames: int = 0
    lacking: int = 0
    wrong: int = 0
    wrong_turn: int = 0
    wrong_passages: int = 0
    turns: int = 0
    hit: int = 0
    found: int = 0
    right: int = 0
    unknown_turns: int = 0

    @property
    def share(self) -> float:
        """Share of the frames with the driven lane as the primary lane."""
        return 1 - self.wrong / max(self.frames, 1)

    @property
    def recall(self) -> float:
        """Share of the turns that are found."""
        return self.hit / max(self.turns, 1)

    @property
    def precision(self) -> float:
        """Share of the found turns that are turns."""
        return self.right / max(self.found, 1)

    def __str__(self) -> str:
        return (
            f"{self.frames} frames of {self.passages} passages ({self.unknown} without reference,"
            f" {self.lacking} frames not stored): driven lane right in {self.share:.2%}, another turn in"
            f" {self.wrong_turn} frames, wrong in {self.wrong_passages} passages; {self.turns} turns:"
            f" precision {self.precision:.3f} ({self.found} found, {self.unknown_turns} without"
            f" reference), recall {self.recall:.3f}"
        )


def measured(store: Store, trace: str, passages: list[Passage], road_map: RoadMap) -> Figures:
    """Compare the primary lanes and the turns of a trace with the passages of its vehicles."""
    rows = store.sql(
        "SELECT f.seq, l.src, l.dst FROM world_lane_states l JOIN frames f USING (frame_id)"
        f" WHERE l.is_primary AND f.trace = '{trace}'"
    )
    primary = {(int(seq), int(node)): int(lane) for seq, node, lane in rows.values}
    figures, turn = Figures(), road_map.nodes.turn
    for one in passages:
        if not one.lanes:
            figures.unknown += 1
            continue
        lanes = [primary.get((seq, one.node)) for seq in range(one.first, one.last + 1)]
        known = [lane for lane in lanes if lane is not None]
        wrong = [lane for lane in known if lane not in one.lanes]
        words = {turn[-1 - lane] for lane in one.lanes}
        figures.passages += 1
        figures.frames += len(known)
        figures.lacking += len(lanes) - len(known)
        figures.wrong += len(wrong)
        figures.wrong_turn += sum(turn[-1 - lane] not in words for lane in wrong)
        figures.wrong_passages += bool(wrong)
    for word in ("left", "right"):
        found = store.find(f"MATCH turns_{word}() RETURN x.id, frame.seq")
        events = {(int(node), int(seq)) for node, seq in found.rows()}
        _count(figures, passages, word, events)
    return figures


def _count(
    figures: Figures, passages: list[Passage], word: str, events: set[tuple[int, int]]
) -> None:
    """Add the turns of a direction: those of the passages, and the found ones."""
    turns = [one for one in passages if one.lanes and one.turn == word]
    figures.turns += len(turns)
    figures.hit += sum(any(one.has(*event) for event in events) for one in turns)
    for event in events:
        here = [one for one in passages if one.has(*event)]
        if any(one.lanes for one in here):
            figures.found += 1
            figures.right += any(one.turn == word for one in here)
        figures.unknown_turns += not any(one.lanes for one in here)


def main() -> None:
    """Print the figures of recordings."""
    for path in map(Path, sys.argv[1:]):
        passages, road_map = passages_of(path)
        with tempfile.TemporaryDirectory() as folder:
            (outcome,) = ingest(Path(folder) / "s.sgstore", [path], config=WIDE, jobs=1)
            figures = measured(Store(Path(folder) / "s.sgstore"), outcome.name, passages, road_map)
        print(f"{path.name}: {figures}")


if __name__ == "__main__":
    main()
