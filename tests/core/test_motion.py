"""Laws of motion: a world that is moved, turned or mirrored has the same scene graphs."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from motions import Motion
from thorough import LONG

from sgstore.apps.demo import RECORDING
from sgstore.maps.map_files import Maps
from sgstore.model.config import Config
from sgstore.model.vocabulary import RELATIONS
from sgstore.model.world import origin_of, quantize
from sgstore.readers import on_map, open_trace
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import FrameBlock

MOTIONS = {
    "shift": Motion(shift=(-731.25, 4096.5, 12.0)),
    "quarter": Motion(turn=np.pi / 2),
    "turn": Motion(turn=1.2345, shift=(100.0, -250.0, 3.0)),
    "mirror": Motion(mirrored=True),
    "all": Motion(turn=-2.1, shift=(-40.0, 77.0, -5.0), mirrored=True),
}
TRACES = ("carla", "esmini", "omega_prime", "osi_converter", "sumo")
FRAMES = 10_000 if LONG else 60


def recordings(data: Path) -> list[Path]:
    """The bundled recording and, in a long run, those of the shared data."""
    paths = [path for folder in TRACES for path in sorted((data / "traces" / folder).glob("*.*"))]
    shared = [path for path in paths if path.suffix in {".mcap", ".osi"}]
    return [Path(RECORDING), *(shared if LONG else shared[-1:])]


def world_of(path: Path) -> tuple[RoadMap | None, list[FrameBlock]]:
    with open_trace(path, digest="0" * 64) as trace:
        road_map, _ = Maps(None, Config().signs).of(trace.info)
        on_map(trace, road_map)
        blocks = list(islice(trace.blocks(60), FRAMES // 60))
    origins = [origin for origin in map(origin_of, blocks) if origin is not None]
    return road_map, [quantize(block, origins[0]) for block in blocks] if origins else blocks


def graphs_of(
    road_map: RoadMap | None, blocks: list[FrameBlock], motion: Motion
) -> list[GraphBlock]:
    """The graphs of each block of the moved world."""
    generator = SceneGraphGenerator(None if road_map is None else motion.map(road_map), Config())
    return [generator.block(motion.block(block)) for block in blocks]


def places_in_lanes(graph: GraphBlock, motion: Motion) -> NDArray[np.float64]:
    """Frame, entity, lane, offset, direction and place along the lane, as in the world at rest."""
    lanes = graph.lanes
    error = motion.side * lanes.heading_error  # -π and π are one direction
    rows = np.stack(
        [
            *(lanes.frame, lanes.node, lanes.lane),
            *(motion.side * lanes.offset, np.cos(error), np.sin(error), lanes.along),
        ]
    )
    return rows[:, np.lexsort(rows[2::-1])]


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_changes_no_edge_and_no_place_in_a_lane(data: Path, name: str) -> None:
    edges = 0
    for path in recordings(data):
        road_map, blocks = world_of(path)
        at_rest = graphs_of(road_map, blocks, Motion())
        motion = MOTIONS[name]
        for rest, moved in zip(at_rest, graphs_of(road_map, blocks, motion), strict=True):
            known = Motion().edges(rest)
            edges += len(known)
            changed = [
                (path.name, RELATIONS[edge[2]], edge) for edge in known ^ motion.edges(moved)
            ]
            assert changed == []
            np.testing.assert_allclose(
                places_in_lanes(moved, motion), places_in_lanes(rest, Motion()), atol=1e-6
            )
    assert edges > 1000
