"""Graphs are the same with loops that numba compiles (the extra ``[fast]``) and with numpy alone."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import fields
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from builders import Thing, frames, thing
from test_relations import TOWN, busy, crowd

from sgstore.apps.demo import RECORDING
from sgstore.base import numba_loops
from sgstore.graphs.relations import _loops
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config, configured
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import GraphBlock
    from sgstore.model.world import FrameBlock

pytestmark = pytest.mark.seconds(20)

CONFIGS = [
    Config(),
    configured(direction={"ties": "carlasgg", "sides": "closed"}, proximity={"between": "origins"}),
    configured(direction={"ties": "both", "within": 12}, pairs={"static": True, "within": 40}),
    configured(proximity={"between": "footprints"}, direction={"sides": "none"}),
    configured(direction={"kinds": [["Ego", "Vehicle"]]}, pairs={"ego": False}),
]


@pytest.fixture
def _ends_without_loops() -> Iterator[None]:
    yield
    numba_loops.use_loops()


def columns(graph: GraphBlock) -> list[np.ndarray[Any, Any]]:
    """All columns of a block of graphs: edges in order, numbers as they are."""
    edges = graph.edges.distinct()
    tables = (edges, graph.lanes, graph.gaps, graph.presence)
    return [getattr(table, field.name) for table in tables for field in fields(table)]


def assert_same_both_ways(
    blocks: list[FrameBlock], road_map: RoadMap | None, config: Config
) -> None:
    found: list[list[np.ndarray[Any, Any]]] = []
    for after in (math.inf, 0):
        if not numba_loops.use_loops(after):
            pytest.skip("numba is not installed")
        generator = SceneGraphGenerator(road_map, config)
        found.append([column for block in blocks for column in columns(generator.block(block))])
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def on_a_grid(seed: int) -> list[Thing]:
    """Things of many kinds whose bearings and distances lie on bounds, two of them in one place."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(-8, 8, (2, 20))
    heading = rng.integers(-4, 5, 20) * (np.pi / 4)
    kinds = rng.choice(["car", "person", "truck", "traffic_light"], 20)
    things = [
        thing(f"t{i}", float(x[i]), float(y[i]), float(heading[i]), kind=str(kinds[i]))
        for i in range(20)
    ]
    return [thing("ego"), thing("twin"), *things, thing("turned", 3, 3, 1e5)]


@cache
def sample() -> tuple[list[FrameBlock], RoadMap]:
    with open_trace(RECORDING) as recording:
        road_map = read_map(recording.info.map_text, recording.info.map_name)
        return [block for block, _ in zip(recording.blocks(20), range(2), strict=False)], road_map


@pytest.mark.usefixtures("_ends_without_loops")
@pytest.mark.parametrize("config", CONFIGS, ids=range(len(CONFIGS)))
def test_loops_and_numpy_give_the_same_graphs_of_random_scenes(config: Config) -> None:
    scenes = [busy(1), crowd(2, 40, 20), crowd(3, 25, 60), on_a_grid(4), on_a_grid(5), [thing("x")]]
    block = frames(*scenes)
    assert_same_both_ways([block], TOWN, config)
    assert_same_both_ways([block], None, config)


@pytest.mark.usefixtures("_ends_without_loops")
@pytest.mark.parametrize("config", CONFIGS[:2], ids=range(2))
def test_loops_and_numpy_give_the_same_graphs_of_the_sample(config: Config) -> None:
    assert_same_both_ways(*sample(), config)


@pytest.mark.usefixtures("_ends_without_loops")
def test_loops_are_used_when_they_are_worth_it() -> None:
    if not numba_loops.use_loops():
        pytest.skip("numba is not installed")

    numba_loops.count(numba_loops.WORTH - 1)
    assert not numba_loops.worth()
    numba_loops.count(1)
    assert numba_loops.worth()


@pytest.mark.usefixtures("_ends_without_loops")
def test_frames_that_come_alone_do_not_start_the_compiler() -> None:
    if not numba_loops.use_loops(after=2):
        pytest.skip("numba is not installed")

    SceneGraphGenerator(None, Config()).block(frames([thing("ego"), thing("a", 5), thing("b", 9)]))
    assert not numba_loops.worth()
    SceneGraphGenerator(None, Config()).block(frames([thing("ego")], [thing("ego")]))
    assert numba_loops.worth()


@pytest.mark.parametrize(("room", "told"), [(9, (1, 3)), (3, (1, 3)), (2, (0, 0))])
def test_pairs_are_looked_for_while_there_is_room_for_all_of_a_body(
    room: int, told: tuple[int, int]
) -> None:
    loop = getattr(_loops.near_pairs, "py_func", _loops.near_pairs)
    order, end = np.arange(3), np.full(3, 3)
    place = (np.array([0.0, 1.0, 9.0]), np.zeros(3), np.zeros(3))
    found = np.zeros(room, int), np.zeros(room, int)

    assert loop(0, order, end, place, 4.0, found) == told


def test_without_numba_nothing_is_compiled() -> None:
    program = """if True:
        import sys
        sys.modules["numba"] = None
        from sgstore.base import numba_loops
        assert not numba_loops.use_loops(0) and not numba_loops.worth()
        from sgstore.graphs.relations import _loops
        import numpy as np
        order, end = np.arange(3), np.full(3, 3)
        place, found = (np.array([0.0, 1.0, 9.0]), *np.zeros((2, 3))), tuple(np.zeros((2, 9), int))
        assert _loops.near_pairs(0, order, end, place, 4.0, found) == (1, 3)
        import sgstore.sgg
        assert "numba" not in {name for name, module in sys.modules.items() if module is not None}
    """
    subprocess.run([sys.executable, "-c", program], check=True)
