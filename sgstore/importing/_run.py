"""A file of graphs → a trace of a store: read twice, once to understand it, once to bring it in."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.config import Config
from sgstore.errors import SgstoreError, TraceError
from sgstore.importing._blocks import Blocks, parts_map
from sgstore.importing._formats import read_csv, read_nodelink, read_s3c, stem_of
from sgstore.importing._resolve import OWN, Understanding, Words, survey
from sgstore.mcap import Loss, check_name, digest_of, mark_of
from sgstore.store import Folder, Identity, Segment, StoreFile
from sgstore.vocabulary import DIRECTIONS, KINDS, PROXIMITY, RELATIONS
from sgstore.world import BUCKET_FRAMES, MessageRefs, TraceInfo, TraceReport

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from sgstore.graph import GraphBlock
    from sgstore.importing._resolve import FileMeaning, Meant
    from sgstore.roads import RoadMap
    from sgstore.store import Sealed


FORMATS: Final = {"s3c": read_s3c, "nodelink": read_nodelink, "csv": read_csv}
"""What files are written in → what reads their graphs."""

_ANSWERED: Final = {"s3c": ("isIn", *PROXIMITY[1:], *DIRECTIONS, "toLeftOf", "toRightOf")}
"""Relations that all graphs of a format can hold, whether they occur or not."""

_BLOCK: Final = 2 * BUCKET_FRAMES
_BLOCK_SIZE: Final = 200_000
"""Graphs that are brought in together, and their nodes and edges together, unless one has more."""


@dataclass(slots=True)
class Imported:
    """Outcome of a file.

    Attributes
    ----------
    path : Path
    status : str
        ``added``, ``replaced``, ``present`` (it was in the store already) or ``failed``.
    name : str
        Of its trace in the store.
    frames, entities, edges : int
        How many came in.
    lost : dict
        What could not be kept → how often.
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


def import_graphs(  # noqa: PLR0913  as many options as there are ways to read
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
    """Bring files of graphs into a store, which is made if there is none.

    Parameters
    ----------
    store : str or Path
    files : sequence of str or Path
        Each becomes a trace.
    form : str
        One of :data:`FORMATS`.
    words : Words, optional
        What labels and relations mean beside the vocabulary.
    relations : sequence of str
        Relations that the graphs can hold, beside those that occur: of others nothing is known.
    period_s : float
        Time from one frame to the next where the file tells none; s.
    force : bool
        Whether files that are in the store already are read anew, and replaced.
    on_frames : function, optional
        Called with the file and the number of frames done.

    Returns
    -------
    list of Imported
        For each file, in the order given. A file with an error leaves nothing in the store.

    Raises
    ------
    ValueError
        There is no such form or relation, or the period is not positive.
    StoreError
        What is at the place of the store is none.
    """
    if form not in FORMATS or not 0 < period_s < 1e6 or not set(relations) <= set(RELATIONS):
        raise ValueError(f"not a way to import: {form!r}, every {period_s} s, {relations}")
    run = _ImportRun(Path(store), form, words or Words(), (*relations, *_ANSWERED.get(form, ())))
    run.period_ns, run.force, run.on_frames = round(period_s * 1e9), force, on_frames
    return [run.outcome(Path(file)) for file in files]


class _ImportRun:
    """One call of :func:`import_graphs`."""

    period_ns: int
    force: bool
    on_frames: Callable[[Path, int], None] | None

    def __init__(self, store: Path, form: str, words: Words, answers: tuple[str, ...]) -> None:
        self._path = store
        self._form = form
        self._words = words
        self._answers = answers
        self._store = StoreFile(store) if store.exists() else None
        if self._store is not None:
            self._store.settle()

    def outcome(self, path: Path) -> Imported:
        """Import one file, and return the outcome."""
        done = Imported(path)
        try:
            self._import(path, done)
        except SgstoreError as error:
            done.error = error
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
        with Segment(self._path, info, identity, road_map, answers, place=(folder, 1)) as segment:
            kinds: Counter[str] = Counter()
            for some in _blocks(graphs):
                graph = self._append(segment, blocks, some, done)
                kinds.update([KINDS[int(code)] for code in graph.frames.entities.kind])
                if self.on_frames is not None:
                    self.on_frames(info.path, done.frames)
            report = TraceReport(frames=done.frames, losses=_losses(done.lost))
            how = {
                "words": self._words.as_dict(),
                "relations": sorted(set(self._answers)),
                "period_s": self.period_ns / 1e9,
            }
            told = {"imported": self._form, "import": how, "entities": dict(kinds)}
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
        """Identity of a map of named parts: these, and the mapping by which the file was understood."""
        about = {
            "of": self._form,
            "words": self._words.as_dict(),
            "answers": sorted(set(self._answers)),
            "period_ns": 0 if found.timed else self.period_ns,
            "parts": [[kind, name, known] for (kind, name), known in found.parts.items()],
        }
        return json.dumps(about, ensure_ascii=False, sort_keys=True)


def _blocks(graphs: Iterable[Meant]) -> Iterator[list[Meant]]:
    """Graphs in blocks: of very large ones there are few in each."""
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


def _losses(lost: dict[str, int]) -> list[Loss]:
    return [Loss(f"{what} cannot be kept", messages=often) for what, often in sorted(lost.items())]
