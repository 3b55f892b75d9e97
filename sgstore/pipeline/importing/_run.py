"""Import of graph files: each file becomes a trace, stored in blocks of frames as in an ingest.

A file is read twice: once to resolve its labels, once to store its graphs.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import SgstoreError, TraceError, failure
from sgstore.maps.roads import MapEdges, MapNodes, Ribbons, RoadMap
from sgstore.mcap import Loss, check_name, digest_of, mark_of
from sgstore.model.config import Config
from sgstore.model.graph import Edges, GraphBlock, LaneGaps, LaneStates, StaticPresence
from sgstore.model.vocabulary import (
    DIRECTIONS,
    KIND_CODE,
    KINDS,
    MAP_KINDS,
    PROXIMITY,
    RELATION_CODE,
    RELATIONS,
)
from sgstore.model.world import (
    BUCKET_FRAMES,
    Entities,
    FrameBlock,
    MessageRefs,
    States,
    TraceInfo,
    TraceReport,
)
from sgstore.pipeline.importing._formats import read_csv, read_nodelink, read_s3c, stem_of
from sgstore.pipeline.importing._openlabel import metadata_of, read_openlabel
from sgstore.pipeline.importing._resolve import (
    LONGEST,
    OWN,
    Understanding,
    Words,
    columns_of,
    gap_of,
    lane_state_of,
    part_of,
    state_of,
    survey,
)
from sgstore.store import Folder, Identity, OnMap, Segment, StoreFile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.model.world import Ints
    from sgstore.pipeline.importing._resolve import (
        FileMeaning,
        GivenNode,
        LabelMeaning,
        Meant,
        Part,
    )
    from sgstore.store import Sealed


FORMATS: Final = {
    "s3c": read_s3c,
    "nodelink": read_nodelink,
    "csv": read_csv,
    "openlabel": read_openlabel,
}
"""Name of a format → function that reads its graphs."""

_ANSWERED: Final = {"s3c": ("isIn", *PROXIMITY[1:], *DIRECTIONS, "toLeftOf", "toRightOf")}
"""Format → relations that its graphs can contain, even if no graph of a file has them."""

_BLOCK: Final = 2 * BUCKET_FRAMES
_BLOCK_SIZE: Final = 200_000
"""Largest number of graphs, and of nodes and edges, in a block. A larger graph gets its own block."""


@dataclass(slots=True)
class Imported:
    """Result of the import of one graph file.

    Attributes
    ----------
    path : Path
    status : str
        ``added``, ``replaced``, ``present`` (already in the store) or ``failed``.
    name : str
        Name of its trace in the store.
    frames, entities, edges : int
        Number of imported frames, entities and edges.
    lost : dict
        Number of losses by description.
    error : SgstoreError or None
    """

    path: Path
    status: str = "failed"
    name: str = ""
    frames: int = 0
    entities: int = 0
    edges: int = 0
    lost: dict[str, int] = field(default_factory=dict[str, int])
    error: SgstoreError | None = None


def import_graphs(  # noqa: PLR0913  one option per way to read
    store: str | Path,
    files: Sequence[str | Path],
    form: str,
    *,
    words: Words | None = None,
    relations: Sequence[str] = (),
    period_s: float = 1.0,
    force: bool = False,
    on_frames: Callable[[Path, int], None] | None = None,
) -> list[Imported]:
    """Import graph files into a store. A missing store is created.

    Parameters
    ----------
    store : str or Path
    files : sequence of str or Path
        Each becomes a trace.
    form : str
        One of :data:`FORMATS`.
    words : Words, optional
        Additional meanings of labels and relations.
    relations : sequence of str
        Relations that the graphs can contain, in addition to those that occur. Other relations are unknown.
    period_s : float
        Time between frames, for files without times; s.
    force : bool
        Import files again that the store already contains, and replace their traces.
    on_frames : function, optional
        Called with the file and the number of frames done.

    Returns
    -------
    list of Imported
        For each file, in the given order. A file with an error leaves nothing in the store.

    Raises
    ------
    ValueError
        The form or a relation does not exist, or the period is not positive.
    StoreError
        The file at the path of the store is not a store.
    """
    if form not in FORMATS or not 0 < period_s < 1e6 or not set(relations) <= set(RELATIONS):
        raise ValueError(f"not a way to import: {form!r}, every {period_s} s, {relations}")
    run = _ImportRun(Path(store), form, words or Words(), (*relations, *_ANSWERED.get(form, ())))
    run.period_ns, run.force, run.on_frames = round(period_s * 1e9), force, on_frames
    return [run.outcome(Path(file)) for file in files]


class _ImportRun:
    """Import of graph files with given options."""

    period_ns: int
    force: bool
    on_frames: Callable[[Path, int], None] | None

    def __init__(self, store: Path, form: str, words: Words, answers: tuple[str, ...]) -> None:
        self._path = store
        self._form = form
        self._words = words
        self._answers = answers
        Folder.refuse_name(store)
        self._store = StoreFile(store) if store.exists() else None
        if self._store is not None:
            self._store.settle()

    def outcome(self, path: Path) -> Imported:
        """Import one graph file, and return the result."""
        done = Imported(path)
        try:
            self._import(path, done)
        except Exception as error:  # noqa: BLE001  the other files must still be imported
            done.error = failure(error, path)
        return done

    def _import(self, path: Path, done: Imported) -> None:
        check_name(path)
        try:
            size, mtime_ns = mark_of(path)
        except OSError as error:
            raise TraceError(f"cannot be read: {error.strerror}", path=path) from error
        digest = digest_of(path)
        found = survey(path, FORMATS[self._form](path), self._words)
        info = TraceInfo(
            path=path,
            size=size,
            mtime_ns=mtime_ns,
            digest=digest,
            flavour=self._form,
            channels=(),
            ego=found.ego,
            map_text="",
            map_name="",
            context=MessageRefs(*(np.zeros(0, np.int64) for _ in range(5))),
        )
        road_map = parts_map(f"{stem_of(path)} (parts)", self._variant(found), found.parts)
        if self._store is not None and not self.force:
            known = self._store.stored(info, Config(), road_map)
            if known is not None:
                done.status, done.name = "present", known
                done.frames = self._store.trace(known).frames
                return
        with Folder(self._path) as folder:
            sealed = self._sealed(info, road_map, found, folder.path, done)
            if digest_of(path) != digest:
                raise TraceError("was changed while it was read; import it again", path=path)
            store = self._store = self._store or StoreFile.create(self._path)
            known = store.has(sealed, as_it_is=False)
            done.name = store.publish(sealed, replace=self.force)
            done.status = "added" if known is None else "replaced"

    def _sealed(
        self, info: TraceInfo, road_map: RoadMap, found: FileMeaning, folder: Path, done: Imported
    ) -> Sealed:
        occur = {RELATIONS[code] for code in found.relations} | set(self._answers)
        answers = tuple(name for name in RELATIONS if name in occur)
        understanding = Understanding(info.path, self._words)
        any_state = self._words.unknown_as == OWN
        blocks = Blocks(info.path, road_map, self.period_ns, any_state=any_state)
        graphs = map(understanding.of, FORMATS[self._form](info.path))
        identity = Identity.of(info, Config(), road_map)
        with Segment(
            self._path, info, identity, OnMap(road_map), answers, place=(folder, 1)
        ) as segment:
            kinds: Counter[str] = Counter()
            for some in _blocks(graphs):
                graph = self._append(segment, blocks, some, done)
                kinds.update([KINDS[int(code)] for code in graph.frames.entities.kind])
                if self.on_frames is not None:
                    self.on_frames(info.path, done.frames)
            losses = [
                Loss(f"{what} cannot be kept", messages=often)
                for what, often in sorted(done.lost.items())
            ]
            report = TraceReport(frames=done.frames, losses=losses)
            how = {
                "words": self._words.as_dict(),
                "relations": sorted(set(self._answers)),
                "period_s": self.period_ns / 1e9,
            }
            told = {"imported": self._form, "import": how, "entities": dict(kinds)}
            if self._form == "openlabel":  # An export repeats them.
                told["metadata"] = metadata_of(info.path)
            return segment.seal(report, told)

    def _append(
        self, segment: Segment, blocks: Blocks, graphs: Sequence[Meant], done: Imported
    ) -> GraphBlock:
        graph = blocks.block(graphs)
        segment.append(graph)
        segment.name_frames(
            graph.frames.seq,
            graphs=[one.graph.name for one in graphs],
            places=np.array([one.graph.place for one in graphs], np.int64),
            images=np.array([one.graph.images for one in graphs], np.int64),
        )
        segment.keep_attributes(graph.frames.seq, blocks.own)
        done.frames += len(graphs)
        done.entities += len(graph.frames.entities)
        done.edges += len(graph.edges)
        for one in graphs:
            for what, often in one.graph.lost.items():
                done.lost[what] = done.lost.get(what, 0) + often
        return graph

    def _variant(self, found: FileMeaning) -> str:
        """Return a JSON text that is equal for files with the same map: map parts and import options."""
        about = {
            "of": self._form,
            "words": self._words.as_dict(),
            "answers": sorted(set(self._answers)),
            "period_ns": 0 if found.timed else self.period_ns,
            "parts": [[kind, name, known] for (kind, name), known in found.parts.items()],
        }
        return json.dumps(about, ensure_ascii=False, sort_keys=True)


def _blocks(graphs: Iterable[Meant]) -> Iterator[list[Meant]]:
    """Yield groups of consecutive graphs. The total size of a group is limited."""
    some: list[Meant] = []
    size = 0
    for graph in graphs:
        more = len(graph.entities) + len(graph.parts) + len(graph.edges)
        if some and (len(some) == _BLOCK or size + more > _BLOCK_SIZE):
            yield some
            some, size = [], 0
        some.append(graph)
        size += more
    if some:
        yield some


# Resolved graphs as blocks of scene graphs.

_IS_IN: Final = RELATION_CODE["isIn"]
_FOLLOWS: Final = RELATION_CODE["follows"]
_LEADS: Final = RELATION_CODE["leads"]
_LANE_COLUMNS: Final = ("overlap", "offset", "heading_error", "along")
_OF_EDGES: Final = frozenset({"lane_dist"})
"""Attributes of exported edges that follow from other attributes."""
_LONGEST_VALUE: Final = 10_000
"""Largest length of a user-defined attribute value as JSON; characters."""


def parts_map(name: str, variant: str, parts: Mapping[Part, Mapping[str, Any]]) -> RoadMap:
    """Return a road map with only the names of the imported lanes and roads, without their shapes.

    Parameters
    ----------
    name, variant : str
        As in :class:`sgstore.maps.roads.RoadMap`; the map has no text.
    parts : mapping
        Kind and name of each part → its known attributes; ``off_road`` is the first.
    """
    order = sorted(parts, key=lambda part: MAP_KINDS.index(part[0]))
    order.insert(0, order.pop(next(i for i, part in enumerate(order) if part[0] == "off_road")))
    nodes = MapNodes.of([kind for kind, _ in order], [own for _, own in order])
    for row, part in enumerate(order):
        known = parts[part]
        for column in ("x", "y", "z", "heading", "length", "width", "speed_limit", "curvature"):
            getattr(nodes, column)[row] = known.get(column, np.nan)
        for column in ("section", "lane"):
            getattr(nodes, column)[row] = known.get(column, 0)
    texts: dict[str, Any] = {
        column: tuple(str(parts[part].get(column, "")) for part in order)
        for column in ("road", "junction", "turn")
    }
    texts["lane_type"] = tuple(
        parts[part].get("lane_type", "driving") if part[0] == "lane" else "" for part in order
    )
    none = np.zeros(0, np.int64)
    empty = Ribbons(np.zeros(1, np.int64), *(np.zeros(0) for _ in range(8)))
    return RoadMap(
        name=name,
        text="",
        variant=variant,
        nodes=replace(nodes, **texts),
        edges=MapEdges(none.astype(np.int8), none, none),
        ribbons=empty,
        shapes=np.full(len(order), None, object),
    )


class Blocks:
    """Converter of imported graphs to blocks of frames. Entities keep their node ids between blocks.

    Parameters
    ----------
    path : Path
    road_map : RoadMap
        Of :func:`parts_map`.
    period_ns : int
        Time between graphs, for files without times; ns.
    any_state : bool
        True if traffic lights may have states outside the vocabulary.

    Attributes
    ----------
    own : list
        Custom attributes in the last block: frame, node, relation (-1 for an attribute of the node) and other
        end, name, value as JSON.
    """

    def __init__(
        self, path: Path, road_map: RoadMap, period_ns: int, *, any_state: bool = False
    ) -> None:
        self._path = path
        self._period = period_ns
        self._any_state = any_state
        self.own: list[tuple[int, int, int, int, str, str]] = []
        names = zip(road_map.nodes.kind.tolist(), road_map.nodes.name, strict=True)
        codes = {code: kind for kind, code in KIND_CODE.items()}
        self._parts = {(codes[kind], name): -1 - row for row, (kind, name) in enumerate(names)}
        self._entities: dict[tuple[str, str], int] = {}
        self._seq = 0

    def block(self, graphs: Sequence[Meant]) -> GraphBlock:
        """Return imported graphs as a block of frames. For each graph, count the values that are lost."""
        new: list[tuple[GivenNode, LabelMeaning]] = []
        self.own = []
        first = len(self._entities)
        ids = [self._ids(meant, new) for meant in graphs]
        seq = self._seq + np.arange(len(graphs))
        self._seq += len(graphs)
        told = [meant.graph.time_ns for meant in graphs]
        time_ns = np.array(
            [s * self._period if t is None else t for s, t in zip(seq.tolist(), told, strict=True)],
            np.int64,
        )
        many = [sum(not node.static for node, _ in meant.entities.values()) for meant in graphs]
        ego = [of[meant.ego] if meant.ego else -1 for of, meant in zip(ids, graphs, strict=True)]
        frames = FrameBlock(
            seq=seq,
            time_ns=time_ns,
            log_time_ns=time_ns,
            offsets=np.cumsum([0, *many], dtype=np.int64),
            states=self._states(graphs, ids),
            ego=np.array(ego, np.int64),
            entities=_entities(first, new),
            scenery=self._scenery(first, new),
            messages=MessageRefs(*(np.zeros(0, np.int64) for _ in range(5))),
        )
        presence = [
            (frame, self._parts[part])
            for frame, meant in enumerate(graphs)
            for part in meant.parts.values()
        ]
        presence += [
            (frame, of[name])
            for frame, (meant, of) in enumerate(zip(graphs, ids, strict=True))
            for name, (node, _) in meant.entities.items()
            if node.static
        ]
        for frame, meant in enumerate(graphs):
            for name, part in meant.parts.items():
                node = meant.graph.nodes[name]
                _, own = part_of(self._path, node.where, node.attributes)
                self._keep(meant.graph.lost, (frame, self._parts[part], -1, 0), own)
        edges, lanes, gaps = self._edges(graphs, ids)
        return GraphBlock(frames, StaticPresence(*_whole(presence, 2)), edges, lanes, gaps)

    def _keep(
        self, lost: dict[str, int], at: tuple[int, int, int, int], own: Mapping[str, Any]
    ) -> None:
        """Store the custom attributes of an imported node or edge; invalid values are counted as losses."""
        for name, value in own.items():
            if value is None or name in _OF_EDGES:
                continue
            try:
                text = json.dumps(value, ensure_ascii=False, allow_nan=False)
            except ValueError:
                text = ""
            if 0 < len(text) <= _LONGEST_VALUE and 0 < len(name) <= LONGEST:
                self.own.append((*at, name, text))
            else:
                what = f"attribute {name[:80]}" + (" of edges" if at[2] >= 0 else "")
                lost[what] = lost.get(what, 0) + 1

    def _ids(self, meant: Meant, new: list[tuple[GivenNode, LabelMeaning]]) -> dict[str, int]:
        """Return each node's id by its name in a graph. Append new entities to the list ``new``."""
        found = {name: self._parts[part] for name, part in meant.parts.items()}
        for name, (node, meaning) in meant.entities.items():
            key = (name, meaning.kind)
            if key not in self._entities:
                self._entities[key] = len(self._entities)
                new.append((node, meaning))
            found[name] = self._entities[key]
        return found

    def _states(self, graphs: Sequence[Meant], ids: Sequence[Mapping[str, int]]) -> States:
        nodes: list[int] = []
        rows: list[dict[str, float]] = []
        for frame, (meant, of) in enumerate(zip(graphs, ids, strict=True)):
            lost = meant.graph.lost
            for name in sorted(meant.entities, key=of.__getitem__):
                node = meant.entities[name][0]
                state, own = state_of(
                    self._path, node.where, node.attributes, lost, any_state=self._any_state
                )
                if not node.static:
                    nodes.append(of[name])
                    rows.append(state)
                self._keep(lost, (frame, of[name], -1, 0), own)
        return States.of(node=np.array(nodes, np.int64), **columns_of(rows))

    def _scenery(self, first: int, new: Sequence[tuple[GivenNode, LabelMeaning]]) -> States:
        """Return the states of new static entities of an imported graph."""
        still = [(first + row, node) for row, (node, _) in enumerate(new) if node.static]
        rows = [
            state_of(self._path, node.where, node.attributes, {}, any_state=self._any_state)[0]
            for _, node in still
        ]
        return States.of(node=np.array([row for row, _ in still], np.int64), **columns_of(rows))

    def _edges(
        self, graphs: Sequence[Meant], ids: Sequence[Mapping[str, int]]
    ) -> tuple[Edges, LaneStates, LaneGaps]:
        rows: list[tuple[int, int, int, int]] = []
        inside: dict[tuple[int, int, int], dict[str, float]] = {}
        gaps: dict[tuple[int, int, int], float] = {}
        for frame, (meant, of) in enumerate(zip(graphs, ids, strict=True)):
            for edge, relation in meant.edges:
                own = edge.attributes
                src, dst = of[edge.src], of[edge.dst]
                rows.append((frame, relation, src, dst))
                part = meant.parts.get(edge.dst, ("",))[0]
                if relation == _IS_IN and src >= 0 and part == "lane":
                    state, own = lane_state_of(self._path, edge.where, edge.attributes)
                    inside[frame, src, dst] = state
                elif relation in {_FOLLOWS, _LEADS}:
                    ends = (src, dst) if relation == _FOLLOWS else (dst, src)
                    gap, own = gap_of(self._path, edge.where, edge.attributes)
                    gaps[frame, *ends] = gaps.get((frame, *ends), gap) if math.isnan(gap) else gap
                if own:
                    self._keep(meant.graph.lost, (frame, src, relation, dst), own)
        frame, relation, src, dst = _whole(rows, 4)
        edges = Edges(frame, relation.astype(np.int8), src, dst)
        frame, src, dst = _whole(list(gaps), 3)
        distances = LaneGaps(frame, src, dst, np.array(list(gaps.values()), np.float64))
        return edges, _lane_states(inside), distances


def _entities(first: int, new: Sequence[tuple[GivenNode, LabelMeaning]]) -> Entities:
    def text(node: GivenNode, name: str, otherwise: str) -> str:
        told = node.attributes.get(name)
        return told[:200] if isinstance(told, str) else otherwise

    return Entities(
        first=first,
        ident=tuple(text(node, "ident", node.name) for node, _ in new),
        kind=np.array([KIND_CODE[meaning.kind] for _, meaning in new], np.int8),
        special=tuple(text(node, "special", meaning.special) for node, meaning in new),
        subkind=tuple(text(node, "subkind", meaning.subkind) for node, meaning in new),
        type_name=tuple(text(node, "type_name", meaning.type_name) for node, meaning in new),
        static=np.array([node.static for node, _ in new], np.bool_),
        map_ref=tuple(text(node, "map_ref", "") for node, _ in new),
    )


def _lane_states(inside: Mapping[tuple[int, int, int], dict[str, float]]) -> LaneStates:
    """Return the lanes of imported entities. A lane is primary if it is marked so, or if it is the only one."""
    frame, node, lane = _whole(list(inside), 3)
    rows = list(inside.values())
    known = {
        name: np.array([row.get(name, np.nan) for row in rows])
        for name in (*_LANE_COLUMNS, "primary")
    }
    _, whose, often = np.unique(
        np.stack([frame, node]), axis=1, return_inverse=True, return_counts=True
    )
    only = often[whose.reshape(-1)] == 1
    primary = np.where(np.isnan(known["primary"]), only, known["primary"] == 1).astype(np.bool_)
    columns: dict[str, Any] = known | {"frame": frame, "node": node, "lane": lane}
    columns |= {"primary": primary, "own": primary}
    return LaneStates(**{column.name: columns[column.name] for column in fields(LaneStates)})


def _whole(rows: Sequence[tuple[int, ...]], width: int) -> list[Ints]:
    """Convert rows of integers to columns, as int64 arrays."""
    return list(np.array(rows, np.int64).reshape(-1, width).T.copy())
