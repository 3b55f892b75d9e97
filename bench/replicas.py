"""Stores of many traces, from a few real recordings: each replica is moved and turned by a random rigid motion.

A recording is read once for each of its egos, and its scene graphs are written again and again under new
names and ids. What is written is moved and turned in the plane as a whole, another way each time: relations,
lanes and the numbers of pairs stay as they are, but no column is small because it repeats. Maps are not moved:
replicas of one recording share its map. Everything follows from the seed.

::

    python -m bench.replicas STORE TRACES [RECORDING …]

makes such a store; without recordings of those in ``SGSTORE_DATA`` (default ``../shared/data``).
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config
from sgstore.model.vocabulary import KIND_CODE, kinds_labelled
from sgstore.model.world import Origin, origin_of, quantize
from sgstore.readers import on_map, open_trace
from sgstore.sgg import SceneGraphGenerator, map_of_graphs
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import FrameBlock, States, TraceInfo, TraceReport

DATA = Path(os.environ.get("SGSTORE_DATA") or Path(__file__).parents[2] / "shared/data").resolve()
RECORDINGS = (
    "traces/esmini/swarm_Town04.mcap",
    "traces/sumo/Town10HD_sumo_osi.mcap",
    "traces/carla/Town01.carla.mcap",
    "traces/esmini/traffic_lights.mcap",
    "traces/esmini/highway_merge.mcap",
    "traces/esmini/cut-in.mcap",
)
"""Real traffic on Town04, Town10HD, Town01 and maps of esmini."""
EGOS = 4
"""Egos of each recording, at most: those that are in it the longest."""
SPREAD = 20_000.0
"""How far a replica is moved, at most, along each axis; m."""
BLOCK = 240
_VEHICLES = np.array([KIND_CODE[kind] for kind in kinds_labelled("Vehicle") or ()])


@dataclass
class Source:
    """The scene graphs of a recording as one ego has them, and what a store wants to know beside them."""

    info: TraceInfo
    road_map: RoadMap | None
    answers: tuple[str, ...]
    graphs: list[GraphBlock]
    report: TraceReport

    @property
    def frames(self) -> int:
        return sum(map(len, self.graphs))


def sources(
    recordings: Iterable[Path], *, egos: int = EGOS, frames: int | None = None
) -> Iterator[Source]:
    """Each recording as its own ego has it, and as other vehicles do.

    Parameters
    ----------
    recordings : iterable of Path
    egos : int
        Of each recording, at most.
    frames : int, optional
        Frames of each recording, from its beginning; without it all of them.
    """
    for path in recordings:
        for ego in _egos(path, egos, frames):
            yield _read(path, ego, frames)


def _egos(path: Path, most: int, frames: int | None) -> list[str]:
    """The recording's own ego ('' without one), and the vehicles that are in the most of its frames."""
    seen: dict[str, int] = {}
    with open_trace(path) as trace:
        if most == 1:
            return [trace.info.ego]
        idents: list[str] = []
        drives: list[bool] = []
        for block in trace.blocks(BLOCK):
            idents += block.entities.ident
            drives += np.isin(block.entities.kind, _VEHICLES).tolist()
            for node, count in zip(*np.unique(block.states.node, return_counts=True), strict=True):
                if drives[node]:
                    seen[idents[node]] = seen.get(idents[node], 0) + int(count)
            if frames is not None and block.seq[-1] >= frames:
                break
        own = trace.info.ego
    ranked = sorted((ident for ident in seen if ident != own), key=lambda i: (-seen[i], i))
    return [own, *ranked][:most]


def _read(path: Path, ego: str, frames: int | None) -> Source:
    with open_trace(path, ego=ego) as trace:
        config = Config()
        road_map = (
            read_map(trace.info.map_text, trace.info.map_name) if trace.info.map_text else None
        )
        on_map(trace, road_map)
        generator = SceneGraphGenerator(road_map, config)
        origin: Origin | None = None
        graphs: list[GraphBlock] = []
        done = 0
        for block in trace.blocks(min(BLOCK, frames or BLOCK)):
            origin = origin or origin_of(block)
            graphs.append(generator.block(quantize(block, origin or Origin(0.0, 0.0, 0.0))))
            done += len(block)
            if frames is not None and done >= frames:
                break
        shown = map_of_graphs(road_map, config)
        return Source(replace(trace.info, ego=ego), shown, generator.answers, graphs, trace.report)


@dataclass(frozen=True)
class Motion:
    """A turn about the origin of the axes, then a shift in the plane."""

    angle: float
    x: float
    y: float

    @classmethod
    def random(cls, random: np.random.Generator) -> Motion:
        """Any turn, and a shift of up to :data:`SPREAD`."""
        return cls(random.uniform(-np.pi, np.pi), *random.uniform(-SPREAD, SPREAD, 2).tolist())

    def of(self, frames: FrameBlock) -> FrameBlock:
        """Frames after the motion."""
        return replace(
            frames, states=self._moved(frames.states), scenery=self._moved(frames.scenery)
        )

    def _moved(self, states: States) -> States:
        x, y = self._turned(states.x, states.y)
        vx, vy = self._turned(states.vx, states.vy)
        ax, ay = self._turned(states.ax, states.ay)
        heading = states.heading + self.angle
        return replace(
            states, x=x + self.x, y=y + self.y, vx=vx, vy=vy, ax=ax, ay=ay, heading=heading
        )

    def _turned(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return cos * x - sin * y, sin * x + cos * y


def replicate(store: StoreFile, made: Sequence[Source], traces: int, *, seed: int = 0) -> int:
    """Bring replicas into a store, one source after another and again from the first; frames written."""
    random, frames = np.random.default_rng(seed), 0
    for number in range(traces):
        source = made[number % len(made)]
        motion = Motion.random(random)
        name = f"{source.info.path.stem}-{source.info.ego or 'none'}-{number}"
        info = replace(
            source.info, path=source.info.path.with_stem(name), digest=random.bytes(32).hex()
        )
        with store.segment(
            info, Config(), road_map=source.road_map, answers=source.answers
        ) as segment:
            for graph in source.graphs:
                moved, world = segment.as_kept(motion.of(graph.frames)), graph.world
                if world is not None:
                    world = replace(world, frames=segment.as_kept(motion.of(world.frames)))
                segment.append(replace(graph, frames=moved, world=world))
            store.publish(segment.seal(source.report))
        frames += source.frames
    return frames


def given() -> list[Path]:
    """The recordings of :data:`RECORDINGS` that are there."""
    return [DATA / name for name in RECORDINGS if (DATA / name).exists()]


def main(place: str, traces: str, *recordings: str) -> None:
    """Make a store, and say how large it is and how long that took."""
    start = time.perf_counter()
    made = list(sources(map(Path, recordings) if recordings else given()))
    print(f"{len(made)} sources, {time.perf_counter() - start:.1f} s", flush=True)
    frames = replicate(StoreFile.create(place), made, int(traces))
    StoreFile(place).compact()
    print(f"{frames:,} frames in {traces} traces, {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main(*sys.argv[1:])
