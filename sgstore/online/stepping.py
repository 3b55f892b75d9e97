"""Frame after frame to scene graph after scene graph, in bounded memory.

Node ids are given in the order of appearance and never to two entities. The tables of a generator grow with
every entity that it meets, so it is made anew when most of those it knows are gone; what it keeps between
blocks saves work and changes no graph, so nobody can tell. What has been absent while :data:`REMEMBERED`
others came is forgotten, and would come back as somebody new.
"""

from __future__ import annotations

import gc
from collections import OrderedDict
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from sgstore.online.frame import NUMBERS, WHOLE
from sgstore.online.records import Known, Records
from sgstore.vocabulary import KINDS
from sgstore.world import Entities, FrameBlock, MessageRefs, Origin, States, as_kept, origin_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sgstore.graph import GraphBlock, SceneGraph
    from sgstore.online.frame import Entity, Frame
    from sgstore.roads import RoadMap
    from sgstore.world import Codes, Ints

REMEMBERED: Final = 20_000
"""Entities that are absent and still known by their ids; some 5 MB."""

SPARE: Final = 2048
"""Entities that may be gone before a generator is made anew."""


class Generator(Protocol):
    """What makes graphs of blocks: :class:`sgstore.sgg.SceneGraphGenerator`."""

    @property
    def kinds(self) -> Codes:
        """Kinds of the entities that it has met, by node id."""
        ...

    def blocks(self, frames: FrameBlock, egos: Sequence[Ints]) -> list[GraphBlock]:
        """The graphs of the next frames, as each ego has them."""
        ...


class Online:
    """Frame after frame to scene graph after scene graph.

    Parameters
    ----------
    make : callable
        Makes a generator that has seen nothing yet.
    road_map : RoadMap or None
        The map that its graphs lie on.
    ego : str
        The ego of frames that name none.

    Attributes
    ----------
    last : tuple or None
        The last graphs as blocks, and the kinds of their entities by the blocks' node ids.
    """

    def __init__(
        self, make: Callable[[], Generator], road_map: RoadMap | None, ego: str = ""
    ) -> None:
        self._make = make
        self._generator = make()
        self._ego = ego
        self._records = Records(road_map)
        self._seq = 0
        self._origin: Origin | None = None
        self.last: tuple[list[GraphBlock], Codes] | None = None
        self._next = 0
        self._moving: OrderedDict[str, Known] = OrderedDict()  # whom the last frame had, at the end
        self._standing: dict[str, tuple[Entity, Known]] = {}
        # The generator's own node ids, which begin anew with it, and what they are outside.
        self._inner: dict[str, int] = {}
        self._introduced = 0
        self._outer: Ints = np.zeros(64, np.int64)

    def step(self, frame: Frame, egos: Sequence[str]) -> list[SceneGraph]:
        """The scene graphs of the next frame; see :meth:`sgstore.sgg.SceneGraphGenerator.step`.

        Parameters
        ----------
        frame : Frame
        egos : sequence of str
            Whose graphs; an empty id means the ego of the frame, else that of the config.
        """
        moving, new = self._met(frame)
        if self._introduced > 2 * (len(moving) + len(self._standing)) + SPARE:
            self._generator, self._inner, self._introduced = self._make(), {}, 0
            new = [entity for entity, _ in self._standing.values()]
        block = self._kept(self._block(frame, moving, new))
        for row, entity in enumerate(new):
            self._records.stand(self._standing[entity.ident][1], block.scenery, row)
        here = {entity.ident for entity in moving}
        named = (ego or frame.ego or self._ego for ego in egos)
        nodes = [self._inner[ego] if ego in here else -1 for ego in named]
        graphs = self._generator.blocks(block, [np.array([node]) for node in nodes])
        self._seq += 1
        self.last = graphs, self._generator.kinds
        while len(self._moving) > len(moving) + REMEMBERED:
            ident, _ = self._moving.popitem(last=False)
            self._inner.pop(ident, None)
        known = {self._moving[e.ident].node: self._moving[e.ident] for e in moving}
        with Uncollected():
            return [self._records.graph(graph, self._outer, known) for graph in graphs]

    def _met(self, frame: Frame) -> tuple[list[Entity], list[Entity]]:
        """What moves in a frame, and what stands in it that was not known.

        Everything is checked before anything is remembered: a frame that is refused has not been.
        """
        moving: dict[str, Entity] = {}
        new: dict[str, Entity] = {}
        for entity in frame.entities:
            ident = entity.ident
            stands = ident in self._standing or ident in new
            known = self._moving.get(ident)
            if ident in moving or (stands and not entity.static):
                raise ValueError(f"two entities have the id {ident!r}")
            if entity.static and known is not None:
                raise ValueError(f"entity {ident!r} moved before and is static now")
            if known is not None and known.kind != KINDS[entity.kind]:
                now = KINDS[entity.kind]
                raise ValueError(f"entity {ident!r} was of kind {known.kind!r} and is {now!r} now")
            if not entity.static:
                moving[ident] = entity
            elif not stands:
                new[ident] = entity
        for entity in frame.entities:
            self._remember(entity, new)
        return list(moving.values()), list(new.values())

    def _remember(self, entity: Entity, new: dict[str, Entity]) -> None:
        ident = entity.ident
        if ident in self._moving:
            self._moving.move_to_end(ident)
        elif ident not in self._standing:
            known = Known(self._next, ident, KINDS[entity.kind], entity.special, entity.subkind)
            self._next += 1
            if ident in new:
                self._standing[ident] = entity, known
            else:
                self._moving[ident] = known

    def _block(self, frame: Frame, moving: list[Entity], standing: list[Entity]) -> FrameBlock:
        """A frame as a block, in the generator's own node ids."""
        first = self._introduced
        new = [*standing, *(e for e in moving if e.ident not in self._inner)]
        self._introduced += len(new)
        while self._introduced > len(self._outer):
            self._outer = np.concatenate([self._outer, self._outer])
        for inner, entity in enumerate(new, start=first):
            self._inner[entity.ident] = inner
            self._outer[inner] = self._node(entity)
        time, none = np.array([frame.time_ns]), np.zeros(0, np.int64)
        return FrameBlock(
            seq=np.array([self._seq]),
            time_ns=time,
            log_time_ns=time,
            offsets=np.array([0, len(moving)]),
            states=self._states(moving),
            ego=np.array([-1]),  # it is told apart from the block
            entities=_entities(first, new),
            scenery=self._states(standing),
            messages=MessageRefs(none, none, none, none, none),
        )

    def _kept(self, block: FrameBlock) -> FrameBlock:
        """A block with the numbers that a store would keep of it, if these frames were its trace."""
        self._origin = self._origin or origin_of(block)
        return as_kept(block, self._origin or Origin(0.0, 0.0, 0.0))

    def _node(self, entity: Entity) -> int:
        known = self._standing[entity.ident][1] if entity.static else self._moving[entity.ident]
        return known.node

    def _states(self, of: list[Entity]) -> States:
        numbers = np.array([e.numbers for e in of], np.float64).reshape(-1, len(NUMBERS))
        whole = np.array([e.whole for e in of], np.int64).reshape(-1, len(WHOLE))
        lights, light_state, derived = whole.T
        return States.of(
            node=np.array([self._inner[e.ident] for e in of], np.int64),
            lights=lights,
            light_state=light_state.astype(np.int8),
            derived=derived,
            **{name: numbers[:, i] for i, name in enumerate(NUMBERS)},
        )


class Uncollected:
    """No garbage is looked for meanwhile, if it is at all.

    The records of a graph are thousands of small objects, none of them garbage. Python would look through them
    several times while they are made, and every few frames through all that the client has: 30 ms and more.
    What is let go again before the end is never looked through: Python counts what is more than it was.
    """

    def __enter__(self) -> None:
        self._running = gc.isenabled()
        gc.disable()

    def __exit__(self, *_exception: object) -> None:
        if self._running:
            gc.enable()


def _entities(first: int, new: list[Entity]) -> Entities:
    return Entities(
        first=first,
        ident=tuple(e.ident for e in new),
        kind=np.array([e.kind for e in new], np.int8),
        special=tuple(e.special for e in new),
        subkind=tuple(e.subkind for e in new),
        type_name=tuple(e.type_name for e in new),
        static=np.array([e.static for e in new], np.bool_),
        map_ref=tuple(e.map_ref for e in new),
    )
