"""Frames per second of the scene graph generator, beside the same relations made row by row in plain Python.

::

    python -m bench sgg [--quick]
"""

from __future__ import annotations

import math
import time
import tracemalloc
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import sgstore
from bench.floor import floor
from bench.measure import Measure
from sgstore.base import numba_loops
from sgstore.graphs.relations._bearing import BESIDE
from sgstore.maps.opendrive import read_map
from sgstore.model.config import Config, LaneSettings
from sgstore.model.vocabulary import DIRECTIONS, KIND_CODE, PROXIMITY
from sgstore.model.world import BUCKET_FRAMES, Entities, FrameBlock, MessageRefs, States
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.maps.roads import RoadMap

SECOND = 1_000_000_000
SAMPLE = Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap"
NO_MESSAGES = MessageRefs(*(np.zeros(0, np.int64) for _ in range(5)))


def traffic(entities: int, frames: int, radius: float) -> Iterator[FrameBlock]:
    """Blocks of a made-up trace: an ego that drives on, and cars, lorries and people around it.

    They stay within ``radius`` of the ego; half of them stand at any moment, as in town.
    """
    rng = np.random.default_rng(1)
    n = entities
    kinds = rng.choice(["car", "truck", "bicycle", "person"], n, p=[0.6, 0.1, 0.1, 0.2])
    sizes = {"car": (4.5, 1.9), "truck": (9.0, 2.5), "bicycle": (1.8, 0.6), "person": (0.5, 0.5)}
    length, width = np.array([sizes[kind] for kind in kinds]).T
    distance, angle = radius * np.sqrt(rng.uniform(0, 1, n)), rng.uniform(-math.pi, math.pi, n)
    x, y = distance * np.cos(angle), distance * np.sin(angle)
    x[0] = y[0] = 0
    heading = rng.integers(0, 4, n) * (math.pi / 2) + rng.normal(0, 0.05, n)
    for first in range(0, frames, BUCKET_FRAMES):
        seq = np.arange(first, min(first + BUCKET_FRAMES, frames))
        count = len(seq)
        sway = 3 * np.sin(np.add.outer(seq / 40, np.arange(n)))
        sway[:, ::2] = 3
        one = np.ones((count, 1))
        columns = {
            "node": np.tile(np.arange(n), count),
            "x": (one * x + sway * np.cos(heading)).ravel(),
            "y": (one * y + sway * np.sin(heading)).ravel(),
            "z": np.full(n * count, 0.75),
            "heading": (one * heading).ravel(),
            "length": (one * length).ravel(),
            "width": (one * width).ravel(),
            "height": np.full(n * count, 1.5),
        }
        new = n if first == 0 else 0
        yield FrameBlock(
            seq=seq,
            time_ns=seq * (SECOND // 20),
            log_time_ns=seq * (SECOND // 20),
            offsets=np.arange(count + 1) * n,
            states=States.of(**columns),
            ego=np.zeros(count, np.int64),
            entities=Entities(
                first=first and n,
                ident=tuple(map(str, range(new))),
                kind=np.array([KIND_CODE[kind] for kind in kinds[:new]], np.int8),
                special=("",) * new,
                subkind=("",) * new,
                type_name=("",) * new,
                static=np.zeros(new, np.bool_),
                map_ref=("",) * new,
            ),
            scenery=States.of(node=np.zeros(0, np.int64)),
            messages=NO_MESSAGES,
        )


def row_by_row(block: FrameBlock) -> int:
    """Number of edges of the same relations (without a map), computed pair by pair: the baseline."""
    edges: list[tuple[int, int, str, int]] = []
    of = block.states
    rows = list(zip(of.node, of.x, of.y, of.z, of.heading, of.length, of.width, strict=True))
    for frame in range(len(block)):
        bodies = rows[block.offsets[frame] : block.offsets[frame + 1]]
        ego = next(body for body in bodies if body[0] == block.ego[frame])
        bodies = [body for body in bodies if gap_to(body, ego) <= 50]
        for a in bodies:
            for b in bodies:
                if a is not b:
                    relate(edges, frame, ego, a, b)
    return len(edges)


def gap_to(body: tuple[float, ...], point: tuple[float, ...]) -> float:
    _, x, y, _, heading, length, width = body
    dx, dy = point[1] - x, point[2] - y
    ahead = dx * math.cos(heading) + dy * math.sin(heading)
    aside = dy * math.cos(heading) - dx * math.sin(heading)
    return math.hypot(max(abs(ahead) - length / 2, 0), max(abs(aside) - width / 2, 0))


def relate(
    edges: list[tuple[int, int, str, int]],
    frame: int,
    ego: tuple[float, ...],
    a: tuple[float, ...],
    b: tuple[float, ...],
) -> None:
    distance = math.dist(a[1:4], b[1:4])
    if distance > 25 and a is not ego and b is not ego:
        return
    for name, upper in zip(PROXIMITY, (2, 4, 7, 10, 16, 25), strict=True):
        if distance <= upper:
            edges.append((frame, int(a[0]), name, int(b[0])))
            break
    dx, dy = b[1] - a[1], b[2] - a[2]
    bearing = math.degrees(math.atan2(dy, dx) - a[4])
    bearing = (bearing + 180) % 360 - 180
    sector = sum(abs(bearing) > bound for bound in (45, 90, 135))
    edges.append((frame, int(b[0]), DIRECTIONS[sector], int(a[0])))
    if math.hypot(dx, dy) * abs(math.sin(math.radians(bearing))) > BESIDE:
        side = "toLeftOf" if bearing > 0 else "toRightOf"
        edges.append((frame, int(b[0]), side, int(a[0])))
    if distance < 12 and not separated(a, b) and not separated(b, a):
        edges.append((frame, int(a[0]), "overlaps", int(b[0])))


def separated(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    """Whether a side of box a keeps b away."""
    cos, sin = math.cos(a[4]), math.sin(a[4])
    places: list[tuple[float, float]] = []
    for along, across in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        ahead, aside = along * b[5] / 2, across * b[6] / 2
        dx = b[1] - a[1] + ahead * math.cos(b[4]) - aside * math.sin(b[4])
        dy = b[2] - a[2] + ahead * math.sin(b[4]) + aside * math.cos(b[4])
        places.append((dx * cos + dy * sin, dy * cos - dx * sin))
    (x0, x1), (y0, y1) = ((min(axis), max(axis)) for axis in zip(*places, strict=True))
    return x0 > a[5] / 2 or x1 < -a[5] / 2 or y0 > a[6] / 2 or y1 < -a[6] / 2


def timed(work: Callable[[], object], seconds: float) -> float:
    """Seconds that the work takes: the best of as many runs as fit into the time given, one at least."""
    best, end = math.inf, time.process_time() + seconds
    while best == math.inf or time.process_time() < end:
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def generated(
    blocks: list[FrameBlock],
    road_map: RoadMap | None,
    *,
    sees: bool = True,
    config: Config | None = None,
) -> int:
    """Number of edges of a trace, as the generator makes them."""
    generator = SceneGraphGenerator(road_map, config or Config(sees=sees))
    return sum(len(generator.block(block).edges) for block in blocks)


def in_frames(block: FrameBlock) -> list[FrameBlock]:
    """The same frames as blocks of one, as they come online."""
    none = replace(
        block.entities, first=len(block.entities), ident=(), map_ref=(), kind=np.zeros(0, np.int8)
    )
    return [
        replace(
            block,
            seq=block.seq[i : i + 1],
            time_ns=block.time_ns[i : i + 1],
            log_time_ns=block.log_time_ns[i : i + 1],
            offsets=block.offsets[i : i + 2] - block.offsets[i],
            states=block.states.take(np.arange(block.offsets[i], block.offsets[i + 1])),
            ego=block.ego[i : i + 1],
            entities=none if i else block.entities,
        )
        for i in range(len(block))
    ]


def town(streets: int = 7, apart: float = 60.0) -> str:
    """OpenDRIVE text of a grid of straight streets with a lane and a sidewalk on each side."""
    length = (streets - 1) * apart + 100
    left = lane(2, "sidewalk", 2.0) + lane(1, "driving", 3.5)
    right = lane(-1, "driving", 3.5) + lane(-2, "sidewalk", 2.0)
    roads: list[str] = []
    for number in range(2 * streets):
        aside = (number // 2 - (streets - 1) / 2) * apart
        x, y, heading = (aside, -length / 2, math.pi / 2) if number % 2 else (-length / 2, aside, 0)
        roads.append(
            f'''<road id="{number}" length="{length}" junction="-1"><planView>
            <geometry s="0" x="{x}" y="{y}" hdg="{heading}" length="{length}"><line/></geometry></planView>
            <lanes><laneSection s="0"><left>{left}</left><center><lane id="0" type="none"/></center>
            <right>{right}</right></laneSection></lanes></road>'''
        )
    return f'<OpenDRIVE><header revMajor="1" revMinor="6"/>{"".join(roads)}</OpenDRIVE>'


def lane(number: int, kind: str, width: float) -> str:
    return f'<lane id="{number}" type="{kind}"><width sOffset="0" a="{width}" b="0" c="0" d="0"/></lane>'


def peak_of(work: Callable[[], object]) -> float:
    """Most memory that the work's arrays and objects hold at a time; MB."""
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    return peak


def latency(blocks: list[FrameBlock], road_map: RoadMap) -> float:
    """99th percentile of the time of a frame that comes alone; ms."""
    generator = SceneGraphGenerator(road_map, Config())
    taken: list[float] = []
    for frame in (frame for block in blocks for frame in in_frames(block)):
        start = time.process_time()
        generator.block(frame)
        taken.append(time.process_time() - start)
    return float(np.quantile(taken[1:], 0.99)) * 1e3


def run(quick: bool = False) -> list[Measure]:
    """Frames per second for 10, 40 and 100 entities, and for a crowd of 100 within 25 m of one another."""
    seconds = 0.3 if quick else 2.0
    road_map = read_map(town(), "streets")
    table: list[Measure] = []
    scenes = ((10, 45.0, ""), (40, 45.0, ""), (100, 45.0, ""), (100, 9.0, ", all close"))
    for entities, radius, where in scenes:
        blocks = list(traffic(entities, 300, radius))
        name, frames = f"sgg, {entities} entities{where}", sum(map(len, blocks))
        table += with_loops(name, blocks, road_map, seconds)
        numba_loops.use_loops(math.inf)
        with_map = frames / timed(partial(generated, blocks, road_map), seconds)
        columns = frames / timed(partial(generated, blocks, None, sees=False), seconds)
        few = blocks[:1]
        if row_by_row(few[0]) != generated(few, None, sees=False):
            raise AssertionError("the baseline does not compute the same relations")
        rows = len(few[0]) / timed(partial(row_by_row, few[0]), 0)
        table += [
            Measure(name, with_map, "frames/s"),
            Measure(
                f"{name}, no map", columns, "frames/s", f"{columns / rows:.0f} times row by row"
            ),
            Measure(f"{name}, no map, row by row", rows, "frames/s", "plain Python, pair by pair"),
            Measure(f"{name}, peak memory", peak_of(partial(generated, blocks, road_map)), "MB"),
        ]
    alone = list(traffic(60, 60 if quick else 300, 45))
    for after, how in ((math.inf, ""), (0, ", with numba")):
        if numba_loops.use_loops(after) or not how:
            generated(alone[:1], road_map)
            online = latency(alone, road_map)
            label = f"sgg, 60 entities, one frame alone{how}"
            table.append(Measure(label, online, "ms", "99th percentile"))
    numba_loops.use_loops(math.inf)
    table += [*of_sample(seconds), *in_one_pass(road_map, seconds), *over_time(road_map, quick)]
    numba_loops.use_loops()
    return table


def with_loops(
    name: str, blocks: list[FrameBlock], road_map: RoadMap, seconds: float
) -> list[Measure]:
    """The same with loops that numba compiles, and their share of what a bare loop reaches."""
    if not numba_loops.use_loops(0):
        return [Measure(f"{name}, with numba", math.nan, "frames/s", "numba is not installed")]
    generated(blocks[:1], road_map)
    frames = sum(map(len, blocks))
    speed = frames / timed(partial(generated, blocks, road_map), seconds)
    least = floor(blocks[0], road_map)
    if least is None or not least():
        raise AssertionError("the floor has no edges")
    bare = len(blocks[0]) / timed(least, seconds / 4)
    note = f"{speed / bare:.1%} of a bare loop over pairs and lanes, {bare:,.0f}"
    return [Measure(f"{name}, with numba", speed, "frames/s", note)]


def of_sample(seconds: float) -> list[Measure]:
    """The bundled recording, which drives through the junctions of a town; with lanes and with waypoints."""
    with open_trace(SAMPLE) as recording:
        road_map = read_map(recording.info.map_text, recording.info.map_name)
        blocks = list(recording.blocks(2 * BUCKET_FRAMES))
    frames = sum(map(len, blocks))
    entities = sum(len(block.states) for block in blocks) / frames
    lanes = timed(partial(generated, blocks, road_map), seconds)
    fine = Config(lanes=LaneSettings(granularity="waypoint", spacing=1.0))
    points = timed(partial(generated, blocks, road_map, config=fine), seconds)
    return [
        Measure(f"sgg, the sample, {entities:.0f} entities", frames / lanes, "frames/s"),
        Measure("sgg, the sample, waypoints every metre", frames / points, "frames/s"),
    ]


def in_one_pass(road_map: RoadMap, seconds: float) -> list[Measure]:
    """Three egos in one pass, beside one after the other."""
    blocks = list(traffic(40, 300, 45))
    egos = [[np.full(len(block), node) for node in range(3)] for block in blocks]

    def together() -> None:
        generator = SceneGraphGenerator(road_map, Config())
        for block, of in zip(blocks, egos, strict=True):
            generator.blocks(block, of)

    def one_by_one() -> None:
        for number in range(3):
            generator = SceneGraphGenerator(road_map, Config())
            for block, of in zip(blocks, egos, strict=True):
                generator.blocks(block, of[number : number + 1])

    once, thrice = timed(together, seconds), timed(one_by_one, seconds)
    note = f"{thrice / once:.2f} times as fast as one by one"
    return [Measure("sgg, 40 entities, three egos in one pass", 300 / once, "frames/s", note)]


def over_time(road_map: RoadMap, quick: bool) -> list[Measure]:
    """Peak memory of a trace that is ten times as long, whose blocks are made as they are needed."""

    def drive(frames: int) -> None:
        generator = SceneGraphGenerator(road_map, Config())
        for block in traffic(40, frames, 45):
            generator.block(block)

    frames = 120 if quick else 600
    short, long = (peak_of(partial(drive, n)) for n in (frames, 10 * frames))
    note = f"{long / short:.2f} times that of {frames} frames"
    return [Measure(f"sgg, 40 entities, {10 * frames} frames, peak memory", long, "MB", note)]
