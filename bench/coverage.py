"""Coverage of a million frames: classes, what one part covers of another, novelty; beside pairwise isomorphism.

::

    python -m bench coverage [--quick]

Two stores are made up, of 800,000 and 200,000 frames: an ego in lanes with up to six others around it, scene
after scene; how often a scene comes falls with its rank as in driving (S3C: a quarter of all images are of one
class, two thirds of the classes come once). A message of 50 to 200 kB belongs to each frame. ``--quick`` takes
a fiftieth. The baseline is S3C's way: each graph is held against the representatives of all classes with as
many nodes, edges and labels, by VF2, here networkx's. ``SGSTORE_BENCH_COVERAGE=FOLDER`` keeps the stores, and
takes them if they are there; ``SGSTORE_BENCH_STORE=FILE`` takes another store instead, for both.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from networkx.algorithms.isomorphism import MultiDiGraphMatcher

from bench.measure import Measure
from sgstore.graphs.abstractions import Classes, GraphColumns, MapColumns, abstraction_named
from sgstore.model.config import Config
from sgstore.model.graph import Edges, GraphBlock, LaneGaps, LaneStates, StaticPresence, named_graph
from sgstore.model.vocabulary import DIRECTIONS, KIND_CODE, PROXIMITY, RELATION_CODE, RELATIONS
from sgstore.model.world import (
    Channel,
    Entities,
    FrameBlock,
    MessageRefs,
    States,
    TraceInfo,
    TraceReport,
)
from sgstore.pipeline.importing._run import parts_map
from sgstore.store import StoreFile
from sgstore.testsets.coverage import (
    classed,
    classes,
    combos,
    covered,
    explain,
    growth,
    novel,
    selection_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import networkx as nx
    from numpy.typing import NDArray

    from sgstore.maps.roads import RoadMap

    Ints = NDArray[np.int64]

FRAMES = {"a": 800_000, "b": 200_000}
TRACE = 50_000
BLOCK = 1_200
PERIOD_NS = 100_000_000
SCENES = 60_000
"""Scenes that may come, most of them hardly ever."""
SAMPLE = 1_000
"""Frames that are held against one another."""
SLOTS = {"car": 6, "truck": 3, "person": 3}
LANES = ("Ego Lane", "Left 1 of Ego Lane", "Right 1 of Ego Lane", "Opposing Lane 0")
PARTS = {
    ("off_road", "off_road"): {},
    ("road", "Root Road"): {},
    **{("lane", name): {} for name in LANES},
}
NONE = np.zeros(0, np.int64)
IS_IN = RELATION_CODE["isIn"]


class Library:
    """All scenes, one after another: their entities, and edges as (relation, source, destination)."""

    def __init__(self, rng: np.random.Generator, road_map: RoadMap) -> None:
        lanes = [-1 - road_map.nodes.name.index(name) for name in LANES]
        slots = [(kind, i) for kind, many in SLOTS.items() for i in range(many)]
        number = {slot: 1 + i for i, slot in enumerate(slots)}
        nodes: list[list[tuple[int, ...]]] = []
        edges: list[list[tuple[int, ...]]] = []
        drawn = _drawn(rng)
        for scene in range(SCENES):
            used: Counter[str] = Counter()
            present, rows = [(0,)], [(IS_IN, 0, lanes[0])]
            for kind, lane, near, ahead, side in next(drawn)[: scene > 0 and 1 + scene % 6]:
                if used[kind] == SLOTS[kind]:
                    continue
                node = number[kind, used[kind]]
                used[kind] += 1
                present.append((node,))
                rows += [(IS_IN, node, lanes[lane]), (near, node, 0), (near, 0, node)]
                rows += [(ahead, node, 0), (side, node, 0)]
            nodes.append(sorted(present))
            edges.append(rows)
        self.nodes, self.node_starts = _flat(nodes)
        self.edges, self.edge_starts = _flat(edges)
        self.kinds = [KIND_CODE["car"], *(KIND_CODE[kind] for kind, _ in slots)]


def _drawn(rng: np.random.Generator) -> Iterator[list[tuple[str, int, int, int, int]]]:
    """Six others of a scene: kind, lane, and relations to the ego."""
    many = (SCENES, 6)
    kinds = rng.choice(list(SLOTS), many, p=(0.7, 0.2, 0.1)).tolist()
    lanes = rng.choice(4, many, p=(0.3, 0.2, 0.2, 0.3)).tolist()
    near = rng.choice([RELATION_CODE[name] for name in PROXIMITY[1:]], many).tolist()
    ahead = rng.choice([RELATION_CODE[name] for name in DIRECTIONS], many).tolist()
    side = rng.choice([RELATION_CODE[name] for name in ("toLeftOf", "toRightOf")], many).tolist()
    for row in zip(kinds, lanes, near, ahead, side, strict=True):
        yield list(zip(*row, strict=True))


def _flat(rows: list[list[tuple[int, ...]]]) -> tuple[Ints, Ints]:
    starts = np.cumsum([0, *map(len, rows)])
    return np.array([row for some in rows for row in some], np.int64), starts


def taken(starts: Ints, scene: Ints) -> tuple[Ints, Ints]:
    """Frame and row of what scenes are made of."""
    many = starts[scene + 1] - starts[scene]
    frame = np.repeat(np.arange(len(scene)), many)
    first = np.repeat(np.cumsum(many) - many, many)
    return frame, starts[scene][frame] + np.arange(len(frame)) - first


def block(library: Library, road_map: RoadMap, seq: Ints, scene: Ints) -> GraphBlock:
    """Frames that show scenes."""
    frame, row = taken(library.node_starts, scene)
    node = library.nodes[row, 0]
    first = int(seq[0]) == 0
    new = library.kinds if first else []
    texts = ("",) * len(new)
    frames = FrameBlock(
        seq=seq,
        time_ns=seq * PERIOD_NS,
        log_time_ns=seq * PERIOD_NS,
        offsets=np.concatenate([[0], np.cumsum(np.bincount(frame, minlength=len(seq)))]),
        states=States.of(node=node),
        ego=np.zeros(len(seq), np.int64),
        entities=Entities(
            first=0 if first else len(library.kinds),
            ident=tuple(map(str, range(len(new)))),
            kind=np.array(new, np.int8),
            special=texts,
            subkind=texts,
            type_name=texts,
            static=np.zeros(len(new), np.bool_),
            map_ref=texts,
        ),
        scenery=States.of(node=NONE),
        messages=_pictures(seq, scene),
    )
    frame, row = taken(library.edge_starts, scene)
    relation, src, dst = library.edges[row].T
    inside = np.flatnonzero(relation == IS_IN)
    lane = np.unique(np.stack([frame[inside], dst[inside]]), axis=1)
    numbers = np.full(len(inside), np.nan)
    own = np.ones(len(inside), np.bool_)
    lanes = LaneStates(
        *(frame[inside], src[inside], dst[inside]), numbers, numbers, numbers, own, numbers, own
    )
    gaps = LaneGaps(NONE, NONE, NONE, np.zeros(0))
    edges = Edges(frame, relation.astype(np.int8), src, dst)
    return GraphBlock(frames, StaticPresence(lane[0], lane[1]), edges, lanes, gaps)


def _pictures(seq: Ints, scene: Ints) -> MessageRefs:
    """A message a frame, outside of chunks; how long it is follows from the scene."""
    length = 50_000 + 37 * (scene % 4001)
    return MessageRefs(
        np.zeros_like(seq), seq * PERIOD_NS, np.full_like(seq, -1), 200_000 * seq, length
    )


def driven(rng: np.random.Generator, frames: int) -> Ints:
    """Scene after scene, each for some frames; how often one comes falls with its rank."""
    weight = 1 / (np.arange(SCENES) + 1.6) ** 1.05
    runs = rng.choice(SCENES, frames // 3, p=weight / weight.sum())
    return np.repeat(runs, rng.geometric(1 / 6, len(runs)))[:frames]


def made(path: Path, frames: int, seed: int, library: Library, road_map: RoadMap) -> float:
    """Make a store; seconds."""
    start = time.perf_counter()
    rng = np.random.default_rng(seed)
    store = StoreFile.create(path)
    for number in range(-(-frames // TRACE)):
        length = min(TRACE, frames - number * TRACE)
        scene = driven(rng, length)
        info = TraceInfo(
            path=Path(f"/made/up/{path.stem}-{number}.mcap"),
            size=1,
            mtime_ns=1,
            digest=f"{seed:032x}{number:032x}"[::-1],
            flavour="made up",
            channels=(Channel(1, "/camera", "", "", "", length, "payload"),),
            ego="0",
            map_text="",
            map_name="",
            context=MessageRefs(NONE, NONE, NONE, NONE, NONE),
        )
        with store.segment(info, Config(), road_map=road_map, answers=RELATIONS) as segment:
            for first in range(0, len(scene), BLOCK):
                some = scene[first : first + BLOCK]
                segment.append(block(library, road_map, first + np.arange(len(some)), some))
            store.publish(segment.seal(TraceReport()))
    store.compact()
    return time.perf_counter() - start


def theirs(graphs: list[nx.MultiDiGraph[str]]) -> int:
    """How many classes graphs have, as S3C finds it."""

    def same_node(x: dict[str, str], y: dict[str, str]) -> bool:
        return x["base_class"] == y["base_class"]

    def same_edges(x: dict[str, dict[str, str]], y: dict[str, dict[str, str]]) -> bool:
        return sorted(e["label"] for e in x.values()) == sorted(e["label"] for e in y.values())

    known: dict[tuple[object, ...], list[nx.MultiDiGraph[str]]] = defaultdict(list)
    for graph in graphs:
        nodes = Counter(label for _, label in graph.nodes(data="base_class"))
        edges = Counter(label for _, _, label in graph.edges(data="label"))
        alike = known[frozenset(nodes.items()), frozenset(edges.items())]
        if not any(
            MultiDiGraphMatcher(one, graph, same_node, same_edges).is_isomorphic() for one in alike
        ):
            alike.append(graph)
    return sum(map(len, known.values()))


def best(times: int, ask: Callable[[], object]) -> tuple[float, float]:
    """Best time of a question, and of the processor."""
    took: list[tuple[float, float]] = []
    for _ in range(times):
        start, busy = time.perf_counter(), time.process_time()
        ask()
        took.append((time.perf_counter() - start, time.process_time() - busy))
    return min(took)


def run(quick: bool = False) -> Iterator[Measure]:
    """Build, ask, and compare."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(os.environ.get("SGSTORE_BENCH_COVERAGE") or name)
        road_map = parts_map("bench", '{"format": "bench"}', PARTS)
        wanted = {one: folder / f"{one}{'-quick' if quick else ''}.sgstore" for one in FRAMES}
        library = Library(np.random.default_rng(0), road_map)
        given = os.environ.get("SGSTORE_BENCH_STORE")
        if given:
            wanted = dict.fromkeys(FRAMES, Path(given))
        if not all(path.exists() for path in wanted.values()):
            for seed, (one, path) in enumerate(wanted.items(), start=1):
                frames = FRAMES[one] // (50 if quick else 1)
                seconds = made(path, frames, seed, library, road_map)
                speed = frames / seconds
                yield Measure(f"store {one} made", speed, "frames/s", f"{frames:,} frames")
        yield from _asked(str(wanted["a"]), str(wanted["b"]))
        yield from _compared(library, road_map)


def _asked(a: str, b: str) -> list[Measure]:
    one, other = classed(selection_of(a)), classed(selection_of(b))
    frames = len(one.frame_id) + len(other.frame_id)
    seconds = {
        "classes of A": best(3, lambda: classes(classed(selection_of(a)))),
        "coverage of B by A": best(
            3, lambda: covered(classed(selection_of(b)), classed(selection_of(a)))
        ),
        "novelty: B not in A": best(
            3, lambda: novel(classed(selection_of(b)), classed(selection_of(a)))
        ),
    }
    found = len(one.present()), len(other.present())
    notes = (
        f"{found[0]:,} classes in {len(one.frame_id):,} frames",
        f"{covered(other, one).rows[0][3]:.1%} of {found[1]:,} classes of B",
        "",
    )
    measures = [
        Measure(text, value, "s", f"{busy:.2f} s of the processor; {note}".removesuffix("; "))
        for (text, (value, busy)), note in zip(seconds.items(), notes, strict=True)
    ]
    wall, busy = (sum(values) for values in zip(*seconds.values(), strict=True))
    note = f"{busy:.2f} s of the processor; {frames:,} frames; wanted: 2 s"
    measures.append(Measure("all three", wall, "s", note))
    reading = best(3, lambda: classed(selection_of(a)))[0]
    measures.append(Measure("    of which reading A's classes, once", reading, "s"))
    growing = best(2, lambda: growth(one))[0]
    measures.append(Measure("growth of A, once its classes are read", growing, "s"))
    pairs = best(1, lambda: combos(one, "RSV", 2))[0]
    measures.append(Measure("pairs of features of A", pairs, "s", "wanted: 30 s"))
    telling = best(1, lambda: explain(other, one, "RSV", by_frame=True))[0]
    measures.append(Measure("what tells B from A", telling, "s", "wanted: 30 s"))
    return measures


def _compared(library: Library, road_map: RoadMap) -> list[Measure]:
    """S3C's way on a sample, beside ours on the same frames."""
    scene = driven(np.random.default_rng(9), SAMPLE)
    graph = block(library, road_map, np.arange(SAMPLE), scene)
    seen = GraphColumns.of(graph, np.array(library.kinds, np.int8), MapColumns.of(road_map))
    function = abstraction_named("RSV").function
    start = time.perf_counter()
    labelled = function(seen)
    ours = Classes().of(labelled)
    hashing = time.perf_counter() - start
    graphs = [named_graph(*labelled.named(frame)) for frame in range(SAMPLE)]
    start = time.perf_counter()
    clusters = theirs(graphs)
    vf2 = time.perf_counter() - start
    if len(set(ours)) != clusters:
        raise SystemExit(f"{len(set(ours))} classes, but VF2 finds {clusters}")
    note = f"{clusters} classes in {SAMPLE} frames, both ways"
    return [
        Measure("S3C's pairwise VF2 on a sample", SAMPLE / vf2, "frames/s", note),
        Measure("    abstraction and canonical forms of the same", vf2 / hashing, "times as fast"),
    ]
