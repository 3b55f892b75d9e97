"""Scene graph generator: converts frames and a road map into scene graphs, block by block.

*Contents of a graph.* The range of an ego is a disc around its centre or another area; see
:mod:`sgstore.graphs.relations._extent`. An entity is in range if its footprint meets the area. An entity
without a size counts as a point. An entity without a position is out of range, except the ego. *Frames without
an ego*, or with an ego without a position, have no range: their graphs contain all entities and the whole map,
and no ego relations. :meth:`sgstore.graphs.relations._map_context.LaneContact.ground` selects the map parts;
the static edges among them come from the map. Excluded entities and relations
(:mod:`sgstore.graphs.relations._registry`) are treated as absent.

*Surroundings of a graph.* Entities within ``[range] world`` of the ego, but outside its graph. The same
functions compute their states, static entities, map parts and lane places, but no edges.

A relation that needs a missing heading or position is absent. :attr:`SceneGraphGenerator.answers` lists the
relations that the trace can answer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base import numba_loops
from sgstore.base.tables import begins, chained, taken
from sgstore.errors import ConfigError
from sgstore.graphs.abstractions import (
    Classes,
    GraphColumns,
    MapColumns,
    abstraction_named,
    lane_roles,
)
from sgstore.graphs.online import Stepper
from sgstore.graphs.relations import (
    IS_SIGNAL,
    IS_UPRIGHT,
    IS_USER,
    NEAR,
    TOUCHING,
    BlockScene,
    Bodies,
    BodyPairs,
    Crowds,
    DrivenLanes,
    EdgeRoom,
    EgoPoses,
    Extent,
    Hitches,
    Keeping,
    LaneContact,
    Parking,
    StillPairs,
    contacts,
    contacts_of,
    gaps,
    gathered,
    joined_pairs,
    near_pairs,
    of_kinds,
    pieces,
    related_pairs,
    relations_under,
    renamed,
    waypoints_of,
)
from sgstore.model.graph import Edges, GraphBlock, LaneStates, LeftOut, StaticPresence, WorldBlock
from sgstore.model.noise import dead_band
from sgstore.model.pair_numbers import UNEVEN, all_level
from sgstore.model.vocabulary import BEYOND, OWN_RELATIONS, RELATION_CODE, RELATIONS
from sgstore.model.world import States

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.graphs.online import Frame
    from sgstore.graphs.relations import Areas, MapContext, Standing
    from sgstore.maps.roads import RoadMap
    from sgstore.mcap import Loss
    from sgstore.model.config import Config
    from sgstore.model.graph import LaneGaps, SceneGraph, Whole
    from sgstore.model.world import Bools, Codes, Floats, FrameBlock, Ints

    Rows = NDArray[np.intp]
    Gathered = tuple[tuple[Rows, Rows], Bools]


_OTHER_EDGES: Final = 8
"""Number of edges per object for which the initial table has space, without edges between objects."""


class SceneGraphGenerator:
    """Generator of the scene graphs of one trace.

    Parameters
    ----------
    road_map : RoadMap or None
        ``None`` means graphs without map parts and without relations that need a map. :func:`map_of_graphs`
        returns the map with the nodes and static edges of the graphs.
    config : Config

    Attributes
    ----------
    answers : tuple of str
        Relations that these graphs can contain, in the order of the vocabulary. Other relations are unknown.

    Notes
    -----
    Blocks come in the order of the trace. Between blocks, the generator stores only the facts that it needs
    about earlier entities (kinds, scenery). A block of one frame gives the same graph as a block of many.

    Examples
    --------
    >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
    >>> frame = sgstore.Frame(0, ego="hero")
    >>> frame.add("hero", "car", 0, 0, heading=0)
    >>> generator.step(frame)
    <SceneGraph online#0: 1 nodes, 0 edges>
    """

    def __init__(self, road_map: RoadMap | None, config: Config) -> None:
        self._config = config
        self._road_map = road_map
        waypoints = waypoints_of(road_map, config.lanes)
        road_map = road_map if waypoints is None else waypoints.road_map
        self._online: Stepper | None = None
        self._crowds = Crowds()
        self._driven = DrivenLanes(self._road_map)
        self._survey = (
            None
            if road_map is None
            else LaneContact(road_map, config.lanes.ahead, waypoints, self._driven.lanes_of)
        )
        computed = relations_under(config)
        computed = tuple(one for one in computed if road_map is not None or not one.needs_map)
        self._functions = [*dict.fromkeys(one.edges for one in computed if one.edges is not None)]
        own = {one.edges for one in computed if one.name in OWN_RELATIONS}
        self._others = not own.issuperset(self._functions)
        beyond = (one.edges for one in computed if one.name in BEYOND and one.edges is not None)
        self._beyond_functions = [*dict.fromkeys(beyond)]
        self._of_pairs = frozenset(one.name for one in computed if one.of_pairs)
        self._extent = Extent(config.range, road_map)
        beyond = config.range.beyond()
        self._outer = None if beyond is None else Extent(beyond, road_map)
        self._keeping = Keeping(config, road_map)
        self._kinds: Codes = np.zeros(0, np.int8)
        self._left_out: Bools = np.zeros(0, np.bool_)
        self._scenery = States.of(node=np.zeros(0, np.int64))
        self._still = StillPairs(config)
        self._parking = Parking(on_map=road_map is not None)
        self._hitches = Hitches()
        self._grounds: MapColumns | None = None
        self._classes = Classes()
        names = self._keeping.names(computed, with_map=road_map is not None)
        self.answers = tuple(name for name in RELATIONS if name in names)

    def __repr__(self) -> str:
        on = "no map" if self._road_map is None else f"map {self._road_map.name!r}"
        return f"<SceneGraphGenerator on {on}, {len(self.answers)} relations>"

    @property
    def parked(self) -> Codes:
        """Parking state of each entity after all graphs so far, (n,) int8: 1 parked, 0 not parked, -1 unknown.

        Examples
        --------
        >>> from sgstore.apps.demo import bundled
        >>> from sgstore.readers import open_trace
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> with open_trace(bundled()) as trace:
        ...     graphs = generator.block(next(trace.blocks()))
        >>> generator.parked[:3]
        array([0, 0, 0], dtype=int8)
        """
        return self._parking.parked

    @property
    def world_parked(self) -> Codes:
        """Parking state of each entity as in :attr:`parked`, including entities near but outside the graphs.

        Examples
        --------
        >>> from sgstore.apps.demo import bundled
        >>> from sgstore.readers import open_trace
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> with open_trace(bundled()) as trace:
        ...     graphs = generator.block(next(trace.blocks()))
        >>> generator.world_parked[:3]
        array([0, 0, 0], dtype=int8)
        """
        return self._parking.world_parked

    def pieces(self, frames: FrameBlock, egos: int = 1) -> Iterator[FrameBlock]:
        """Split the next frames into blocks whose graphs fit into memory.

        Parameters
        ----------
        frames : FrameBlock
        egos : int
            Number of egos, each with its own graphs.

        Examples
        --------
        >>> from sgstore.apps.demo import bundled
        >>> from sgstore.readers import open_trace
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> with open_trace(bundled()) as trace:
        ...     block = next(trace.blocks())
        >>> [len(piece) for piece in generator.pieces(block)]
        [60]
        """
        entities = renamed(frames.entities, self._config.types)
        kinds = np.concatenate([self._kinds[: entities.first], entities.kind])
        return pieces(frames, kinds, self._config, egos)

    def recorded(self, blocks: Iterable[FrameBlock]) -> Iterator[FrameBlock]:
        """Yield the blocks of a recording with the chosen lanes of its vehicles in junctions.

        The lane in a junction is known only after the vehicle has left the junction, so blocks are held back
        until then. Ingest uses this method. Without it, each frame alone decides the primary lanes.

        Examples
        --------
        >>> from sgstore.apps.demo import bundled
        >>> from sgstore.readers import open_trace
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> with open_trace(bundled()) as trace:
        ...     graphs = [generator.block(block) for block in generator.recorded(trace.blocks())]
        >>> sum(map(len, graphs))
        750
        """
        yield from self._driven.chosen(blocks)

    def block(self, frames: FrameBlock) -> GraphBlock:
        """Return the scene graphs of the next block of frames. Each frame defines its ego.

        Raises
        ------
        ConfigError
            A relation of another package returns undeclared edges.
        ValueError
            A state has an unknown node, or new node ids are not consecutive. This is a defect of the reader.

        Examples
        --------
        >>> from sgstore.apps.demo import bundled
        >>> from sgstore.readers import open_trace
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> with open_trace(bundled()) as trace:
        ...     graphs = generator.block(next(trace.blocks()))
        >>> len(graphs), len(graphs.edges)
        (60, 10648)
        """
        return self.blocks(frames, [frames.ego])[0]

    def blocks(self, frames: FrameBlock, egos: Sequence[Ints]) -> list[GraphBlock]:
        """Return the scene graphs of the next frames for several egos. Shared work is done once.

        Parameters
        ----------
        frames : FrameBlock
            Its own ego is ignored.
        egos : sequence of (F,) int64
            Node id of each ego in each frame; -1 if absent.

        Returns
        -------
        list of GraphBlock
            One for each ego, the same as from a separate generator.

        Raises
        ------
        ValueError
            As for :meth:`block`.

        Examples
        --------
        >>> from sgstore.apps.demo import bundled
        >>> from sgstore.readers import open_trace
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> with open_trace(bundled()) as trace:
        ...     block = next(trace.blocks())
        >>> (graphs,) = generator.blocks(block, [block.ego])
        >>> len(graphs), len(graphs.edges)
        (60, 10648)
        """
        return list(self.one_by_one(frames, egos))

    def one_by_one(self, frames: FrameBlock, egos: Sequence[Ints]) -> Iterator[GraphBlock]:
        """Yield the graphs of each ego for the next frames, as in :meth:`blocks`, but one ego at a time.

        Examples
        --------
        >>> from sgstore.apps.demo import bundled
        >>> from sgstore.readers import open_trace
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> with open_trace(bundled()) as trace:
        ...     block = next(trace.blocks())
        >>> [len(graphs) for graphs in generator.one_by_one(block, [block.ego])]
        [60]
        """
        views, world = self._views(frames, egos)
        for view in views:
            yield self._graphs(view, world)

    # Positions come from files and may be absurd; results that overflow are absent.
    @np.errstate(over="ignore", invalid="ignore")
    def _views(self, frames: FrameBlock, egos: Sequence[Ints]) -> tuple[list[_View], _World]:
        frames = replace(frames, entities=renamed(frames.entities, self._config.types))
        frames = self._learn(frames)
        views = [self._view(replace(frames, ego=ego)) for ego in egos]
        keys = _united([view.keys for view in views])
        beyond = [view.beyond.keys for view in views if view.beyond is not None]
        return views, self._world(frames, keys, _united([keys, *beyond]))

    def _view(self, frames: FrameBlock) -> _View:
        ego, states = _ego_rows(frames), len(frames.states)
        poses = _places(frames, ego)
        areas = self._extent.areas(poses)
        still = self._scenery_in_range(areas)
        held = self._held(frames, areas)
        named = frames.states.node == np.repeat(frames.ego, np.diff(frames.offsets))
        kept = np.flatnonzero(held | named)
        here = np.where(ego < 0, -1, np.searchsorted(kept, ego))
        # An ego without a state is not a node of its graph.
        seen = np.zeros(len(frames), np.bool_)
        seen[frames.frame_of[named]] = True
        frames = replace(frames, ego=np.where(seen, frames.ego, -1))
        keys = np.concatenate([kept, states + still])
        beyond = None
        if self._outer is not None:
            beyond = self._beyond(frames, poses, self._outer, keys)
        left_out = self._counted(frames, named, len(kept), beyond)
        return _View(_reduced(frames, kept), here, areas, keys, beyond, left_out)

    def _counted(
        self, frames: FrameBlock, named: Bools, drawn: int, beyond: _Beyond | None
    ) -> LeftOut:
        """Count the object states that are not in the graphs, by reason."""
        kind = self._kinds[frames.states.node]
        wanted = self._wanted(frames.states.node, kind) | named
        known = 0 if beyond is None else len(beyond.frames.states)
        codes, many = np.unique(kind[~wanted], return_counts=True)
        return LeftOut(
            len(kind),
            int(wanted.sum()) - drawn,
            int(wanted.sum()) - drawn - known,
            tuple(zip(codes.tolist(), many.tolist(), strict=True)),
        )

    def _wanted(self, node: Ints, kind: Codes) -> Bools:
        """Return a mask of the object states that the settings do not exclude."""
        return self._keeping.entities(kind) & ~self._left_out[node]

    def _beyond(self, frames: FrameBlock, poses: EgoPoses, outer: Extent, keys: Ints) -> _Beyond:
        """Return the known entities near one ego but outside its graphs. ``keys``: rows of those inside."""
        if self._config.range.boundless:
            nowhere = np.full(len(frames), np.nan)
            poses = EgoPoses(nowhere, nowhere, nowhere, nowhere)
        areas = outer.areas(poses)
        kept, still = np.flatnonzero(self._held(frames, areas)), self._scenery_in_range(areas)
        every = np.concatenate([kept, len(frames.states) + still])
        others = every[~_in_ascending(keys, every)]
        kept = others[: np.searchsorted(others, len(frames.states))]
        return _Beyond(_reduced(frames, kept), areas, others)

    def _world(self, frames: FrameBlock, keys: Ints, every: Ints) -> _World:
        """Compute the results that all egos share: bodies, pairs, contacts and lanes.

        ``keys`` are the rows in the graphs, ``every`` also those of the surroundings.
        """
        bodies = self._bodies(frames, every)
        rows = every, len(frames.states), len(self._scenery)
        lane = frames.states.lane[every[: np.searchsorted(every, len(frames.states))]]
        standing = None if self._survey is None else self._survey.standing(bodies, lane)
        none = np.zeros(0, np.intp), np.zeros(0, np.intp)
        nothing = none, np.zeros(len(frames), np.bool_)
        whole = _World(every, bodies, rows, nothing, nothing, standing)
        part = whole.of(keys)
        bodies = part.bodies
        if len(frames) > 1:  # Online steps must not wait for the compiler.
            numba_loops.count(int((np.bincount(bodies.frame) ** 2).sum()))
        if self._survey is not None and part.standing is not None and standing is not None:
            self._parking.stand(bodies, part.standing, self._survey.driving)
            self._parking.stand(whole.bodies, standing, self._survey.driving, beyond=True)
        return replace(
            part,
            near=self._near(bodies, part.rows, len(frames)),
            contacts=gathered(partial(contacts, bodies), bodies.frame, len(frames)),
            whole=whole,
            uneven=self._uneven(whole.bodies),
        )

    @staticmethod
    def _uneven(known: Bodies) -> int:
        """Return a bit mask of the special cases in ``UNEVEN``: flat bodies, bridges, carried bodies."""
        flat = ~IS_UPRIGHT[known.kind] & (known.height == 0)
        low, high = known.low_and_high
        near = known.moves | IS_USER[known.kind]
        found = {
            "flat": bool(flat.any()),
            "storeys": not all_level(low, high, known.frame),
            "carried": bool((known.carrier >= 0).any()),
            "near_flat": bool(flat[near].any()),
            "near_storeys": not all_level(low[near], high[near], known.frame[near]),
        }
        return sum(UNEVEN[name] for name, holds in found.items() if holds)

    def _near(self, bodies: Bodies, rows: tuple[Ints, int, int], frames: int) -> Gathered:
        """Return the pairs of nearby bodies.

        ``rows`` are as in :meth:`StillPairs.among`.
        """

        def chunks(unwanted: Bools) -> Iterator[tuple[Rows, Rows]]:
            yield from near_pairs(bodies, self._config, unwanted)
            yield from self._still.among(bodies, *rows, unwanted)

        return gathered(chunks, bodies.frame, frames)

    def _of_view(self, view: _View, world: _World) -> _World:
        """Return the shared results, reduced to the range of one ego.

        A frame may be too crowded for all egos together, but not for this one. Its pairs are then
        computed again.
        """
        part = world.of(view.keys)
        if part is world:
            return world
        bodies, frames = part.bodies, len(view.frames)
        (near, over_near), (touching, over_touching) = part.near, part.contacts
        if over_near.any():
            rows = np.flatnonzero(over_near[bodies.frame])
            keys, states, scenery = part.rows
            few = bodies.take(rows), (keys[rows], states, scenery)
            found, over_near = self._near(*few, frames)
            near = joined_pairs([near, (rows[found[0]], rows[found[1]])])
        if over_touching.any():
            rows = np.flatnonzero(over_touching[bodies.frame])
            few = bodies.take(rows)
            found, over_touching = gathered(partial(contacts, few), few.frame, frames)
            touching = joined_pairs([touching, (rows[found[0]], rows[found[1]])])
        return replace(part, near=(near, over_near), contacts=(touching, over_touching))

    @np.errstate(over="ignore", invalid="ignore")
    def _graphs(self, view: _View, world: _World) -> GraphBlock:
        part = self._of_view(view, world)
        bodies, standing = part.bodies, part.standing
        (near, over_near), (touching, over_touching) = part.near, part.contacts
        ground = None
        if self._survey is not None and standing is not None:
            ground = self._survey.ground(bodies, standing, view.areas, self._keeping.parts)
        pairs = related_pairs(bodies, view.ego, near, self._config)
        if over_touching.any():
            touching = joined_pairs([touching, contacts_of(bodies, view.ego, over_touching)])
        touching = of_kinds(bodies, view.ego, touching, self._config.pairs.kinds)
        room = EdgeRoom(3 * len(pairs) + 2 * len(touching[0]) + _OTHER_EDGES * len(bodies))
        scene = BlockScene(self._config, bodies, view.ego, pairs, touching, ground, room)
        edges = room.chained([edges(scene) for edges in self._functions])
        edges = self._keeping.edges(edges)
        if self._others:
            self._refuse_undeclared(edges)
        return GraphBlock(
            frames=view.frames,
            presence=_presence(bodies, ground and self._keeping.present(ground.present)),
            edges=edges,
            lanes=self._keeping.lane_states(_lane_states(bodies, standing)),
            gaps=self._keeping.gaps(gaps(bodies, ground)),
            crowded=self._crowded(bodies, {NEAR: over_near, TOUCHING: over_touching}),
            world=self._world_of(view, world.whole, ground, edges),
            left_out=view.left_out,
            uneven=world.uneven,
            unsure=_unsure(bodies, ground),
        )

    def _world_of(
        self, view: _View, whole: _World | None, ground: MapContext | None, edges: Edges
    ) -> WorldBlock | None:
        """Return the known entities near one ego but outside its graphs."""
        beyond = view.beyond
        if beyond is None or whole is None:
            return None
        part, present = whole.of(beyond.keys), None
        every, around = whole.of(_united([view.keys, beyond.keys])), None
        if self._survey is not None and every.standing is not None and ground is not None:
            bodies, kept = every.bodies, self._keeping.parts
            around = self._survey.ground(bodies, every.standing, beyond.areas, kept)
            present = self._keeping.present(around.present)
            present &= ~self._keeping.present(ground.present)
        others, following = self._beyond_edges(every.bodies, around, edges)
        return WorldBlock(
            frames=beyond.frames,
            presence=_presence(part.bodies, present),
            edges=others,
            lanes=self._keeping.lane_states(_lane_states(part.bodies, part.standing)),
            gaps=following,
            unsure=_unsure(every.bodies, around),
        )

    def _beyond_edges(
        self, bodies: Bodies, around: MapContext | None, edges: Edges
    ) -> tuple[Edges, LaneGaps]:
        """Return edges that appear or disappear if entities outside the graphs count; and gaps of new edges."""
        if around is None:
            return Edges.chained([]), gaps(bodies, None)
        none = np.zeros(0, np.intp)
        pairs = BodyPairs(bodies, none, none, self._config.proximity.between)
        scene = BlockScene(self._config, bodies, none, pairs, (none, none), around)
        known = Edges.chained([function(scene) for function in self._beyond_functions])
        known, drawn = (
            _of_codes(one, _BEYOND_CODES) for one in (self._keeping.edges(known), edges)
        )
        fresh, gone = _rows_apart(known, drawn)
        fresh = taken(known, fresh)
        following = self._keeping.gaps(gaps(bodies, around))
        follows = _of_codes(fresh, (RELATION_CODE["follows"],))
        keys = _keys(*((of.frame, of.src, of.dst) for of in (following, follows)))
        here = np.flatnonzero(_in_ascending(np.sort(keys[1]), keys[0]))
        return Edges.chained([fresh, taken(drawn, gone)]), taken(following, here)

    @classmethod
    def _of_the_past(cls, road_map: RoadMap | None, config: Config) -> SceneGraphGenerator:
        """Return a generator that chooses driven lanes without later frames, as in online mode."""
        generator = cls(road_map, config)
        if generator._survey is not None:
            generator._survey.online = True
        return generator

    def _refuse_undeclared(self, edges: Edges) -> None:
        """Raise an error if a relation of another package returns edges that it does not declare."""
        names = [tuple(RELATIONS)[code] for code in np.unique(edges.relation)]
        strange = sorted({*names} - {*self.answers} - {*OWN_RELATIONS})
        if strange:
            raise ConfigError(
                f"a relation of another package gives edges {', '.join(strange)}, which none that these"
                " settings ask for declares; expected edges of its own name, or of relations that share"
                " its function"
            )

    def _crowded(
        self, bodies: Bodies, over: Mapping[str, Bools]
    ) -> tuple[tuple[str, int, int], ...]:
        """Return crowded frames whose pairs the settings need: kind of pairs, frame, number of objects."""
        found: list[tuple[str, int, int]] = []
        for what, frames in over.items():
            wanted = {"overlaps"} if what == TOUCHING else self._of_pairs
            rows = np.flatnonzero(frames & bool(wanted & set(self.answers))).tolist()
            found += [(what, frame, int((bodies.frame == frame).sum())) for frame in rows]
        return tuple(found)

    def step(self, frame: Frame) -> SceneGraph:
        """Return the scene graph of the next frame. For callers that pass frames one by one.

        The graph is the same as for a recording. For several egos, see :meth:`steps`.

        Examples
        --------
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", 0, 0, heading=0)
        >>> generator.step(frame)
        <SceneGraph online#0: 1 nodes, 0 edges>
        """
        return self.steps(frame)[0]

    def steps(self, frame: Frame, egos: Sequence[str] = ("",)) -> list[SceneGraph]:
        """Return the scene graphs of the next frame for several egos. Shared work is done once.

        Parameters
        ----------
        frame : Frame
            See :class:`sgstore.graphs.online.Frame`.
        egos : sequence of str
            Ids of the egos. An empty id means the ego of the frame, else that of the config.

        Returns
        -------
        list of SceneGraph
            One for each ego, as from a store. Each entity also has ``ident``, the client's own id. ``trace`` is
            ``online``; ``frame_id`` is ``seq``, the number of the step.

        Raises
        ------
        ValueError
            Two entities of the frame have the same id, a static entity moves, or a moving one is now static.
            The frame is then ignored.

        Notes
        -----
        Memory does not grow with time: see :mod:`sgstore.graphs.online`. Steps and blocks are independent of
        each other.

        Examples
        --------
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> frame = sgstore.Frame(0)
        >>> frame.add("a", "car", 0, 0, heading=0)
        >>> frame.add("b", "car", 9, 0, heading=0)
        >>> generator.steps(frame, ["a", "b"])
        [<SceneGraph online#0: 2 nodes, 5 edges>, <SceneGraph online#0: 2 nodes, 5 edges>]
        """
        if self._online is None:
            fresh = partial(self._of_the_past, self._road_map, self._config)
            shown = map_of_graphs(self._road_map, self._config)
            settings = self._config.ego, self._config.noise
            self._online = Stepper(fresh, shown, DrivenLanes(self._road_map), *settings)
        graphs = self._online.step(frame.meant(self._config.types), egos)
        for graph in self._online.last[0] if self._online.last else ():
            self._crowds.see(graph)
        return graphs

    @property
    def losses(self) -> list[Loss]:
        """Data lost in all steps so far: pairs in crowded frames, and implausible sizes and speeds.

        Examples
        --------
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", 0, 0, length=-4.5)
        >>> graph = generator.step(frame)
        >>> [loss.reason for loss in generator.losses]
        ["length of entity 'hero' is -4.5 m: missing in 1 state"]
        """
        faults = self._online.faults.losses() if self._online is not None else []
        return [*self._crowds.losses(self._config), *faults]

    def class_of(self, abstraction: str = "RSV", number: int = 0) -> str | None:
        """Return the class of the last step's graph in an abstraction. A store has the same class.

        Parameters
        ----------
        abstraction : str
            Its name.
        number : int
            Number of the ego whose graph is used, from 0.

        Returns
        -------
        str or None
            32 hexadecimal digits. ``None`` means that the graph is too symmetric to compute a class.

        Raises
        ------
        AbstractionError
            The abstraction does not exist.
        ValueError
            There was no step yet.

        Examples
        --------
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", 0, 0, heading=0)
        >>> graph = generator.step(frame)
        >>> generator.class_of("RSV")
        '6ecf69623467f5ffd11f63ad25b33ad5'
        """
        seen = self._seen(number)
        (found,) = self._classes.of(abstraction_named(abstraction).function(seen))
        return found or None

    def roles_of(self, number: int = 0) -> dict[int, str]:
        """Return the lane roles in the last step for an ego, such as ``Ego Lane`` and ``Left 1 of Ego Lane``.

        Parameters
        ----------
        number : int
            Number of the ego, from 0.

        Returns
        -------
        dict
            Role by node id, for lanes with a known role; see :func:`sgstore.graphs.abstractions.lane_roles`.

        Raises
        ------
        ValueError
            There was no step yet.

        Examples
        --------
        >>> name, text = store.file.road_map_text("town")
        >>> from sgstore.maps.opendrive import read_map
        >>> generator = sgstore.SceneGraphGenerator(read_map(text, name), sgstore.Config())
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", -230, -1.75, heading=0, length=4.5, width=1.9)
        >>> graph = generator.step(frame)
        >>> sorted(generator.roles_of().values())
        ['Ego Lane', 'Right 1 of Ego Lane']
        """
        _, lanes, roles = lane_roles(self._seen(number))
        return dict(zip(lanes.tolist(), roles, strict=True))

    def _seen(self, number: int) -> GraphColumns:
        """Return the graph of one ego in the last step, as the columns that abstractions use."""
        if self._online is None or self._online.last is None:
            raise ValueError("call step() first")
        graphs, kinds = self._online.last
        if self._grounds is None and self._road_map is not None:
            shown = map_of_graphs(self._road_map, self._config)
            self._grounds = None if shown is None else MapColumns.of(shown)
        return GraphColumns.of(graphs[number], kinds, self._grounds)

    @property
    def kinds(self) -> Codes:
        """Kinds of all entities so far, by node id: (n,) int8.

        Examples
        --------
        >>> from sgstore.apps.demo import bundled
        >>> from sgstore.readers import open_trace
        >>> generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
        >>> with open_trace(bundled()) as trace:
        ...     graphs = generator.block(next(trace.blocks()))
        >>> generator.kinds[:4]
        array([0, 0, 0, 3], dtype=int8)
        """
        return self._kinds

    def _learn(self, frames: FrameBlock) -> FrameBlock:
        """Store the new entities and static objects of a block.

        Return the block with the carriers of carried entities.
        """
        entities, nodes = frames.entities, frames.states.node
        if len(entities):
            if entities.first != len(self._kinds):
                raise ValueError(f"new entities begin at {entities.first}, not {len(self._kinds)}")
            self._kinds = np.concatenate([self._kinds, entities.kind])
            left_out = [ident in self._config.exclude_ids for ident in entities.ident]
            self._left_out = np.append(self._left_out, np.array(left_out, np.bool_))
            self._parking.learn(entities)
            self._hitches.learn(entities)
        if self._survey is not None:
            self._survey.learn(frames)
        if len(frames.scenery):
            self._scenery = chained([self._scenery, frames.scenery])
            if self._still.wanted:
                states = len(frames.states)
                everything = states + np.arange(len(self._scenery))
                self._still.learn(self._bodies(frames, everything))
        for of in (nodes, frames.scenery.node):
            strange = of[(of < 0) | (of >= len(self._kinds))]
            if len(strange):
                raise ValueError(f"a state of node {strange[0]}, which no block has introduced")
        self._parking.see(frames)
        carrier = self._hitches.see(frames, partial(self._bodies, frames))
        return replace(frames, states=replace(frames.states, carrier=carrier))

    def _scenery_in_range(self, areas: Areas) -> Ints:
        """Return the static objects in range, frame by frame. Without an ego, all are in range."""
        scenery = self._scenery
        if not len(scenery):
            return np.zeros(0, np.int64)
        frame, row = areas.near(scenery.x, scenery.y, np.hypot(scenery.length, scenery.width) / 2)
        kind = self._kinds[scenery.node][row]
        boxes, bottom = _boxes(scenery)[row], _bottom(scenery)[row]
        held = areas.hold(frame, boxes, bottom, static=True, hung=IS_SIGNAL[kind])
        held &= self._keeping.entities(kind) & ~self._left_out[scenery.node[row]]
        return frame[held] * len(scenery) + row[held]

    def _held(self, frames: FrameBlock, areas: Areas) -> Bools:
        """Return a mask of the object states that are in range, and that the settings do not exclude."""
        states = frames.states
        kind = self._kinds[states.node]
        held = areas.hold(frames.frame_of, _boxes(states), _bottom(states), hung=IS_SIGNAL[kind])
        return held & self._wanted(states.node, kind)

    def _bodies(self, frames: FrameBlock, keys: Ints) -> Bodies:
        """Return the moving entities of a block and the static scenery as rows of one table."""
        states, scenery = frames.states, self._scenery
        count = int(np.searchsorted(keys, len(states)))
        rows = keys[:count]
        frame, row = np.divmod(keys[count:] - len(states), max(len(scenery), 1))
        node, x, y, z, heading, length, width, height = (
            np.concatenate([getattr(states, name)[rows], getattr(scenery, name)[row]])
            for name in ("node", "x", "y", "z", "heading", "length", "width", "height")
        )
        kind = self._kinds[node]
        return Bodies(
            frame=np.concatenate([frames.frame_of[rows], frame]),
            node=node,
            kind=kind,
            moves=np.arange(len(node)) < count,
            x=x,
            y=y,
            z=z,
            heading=heading,
            length=length,
            width=width,
            height=np.where(IS_UPRIGHT[kind] & (height == 0), np.nan, height),
            pitch=np.concatenate([states.pitch[rows], np.full(len(row), np.nan)]),
            carrier=np.concatenate([states.carrier[rows], scenery.carrier[row]]),
            band=np.append(dead_band(frames.noise, states.derived[rows]), np.zeros(len(row))),
        )


def map_of_graphs(road_map: RoadMap | None, config: Config) -> RoadMap | None:
    """Return the map that a store keeps: with the nodes and static edges that the graphs use."""
    waypoints = waypoints_of(road_map, config.lanes)
    road_map = road_map if waypoints is None else waypoints.road_map
    if road_map is None or config.lanes.sections:
        return road_map
    return road_map.without_sections


@dataclass(frozen=True, slots=True)
class _View:
    """Frames, object states and map parts in the range of one ego.

    Attributes
    ----------
    frames : FrameBlock
        With only the states in range.
    ego : (F,) intp
        Rows of the ego among these; -1 without a state or a position.
    areas : Areas
        Areas of its range.
    keys : int64
        Rows in range, ascending: first the states of the block, then the scenery, frame by frame.
    beyond : _Beyond or None
        Surroundings of the graphs.
    left_out : LeftOut
    """

    frames: FrameBlock
    ego: Rows
    areas: Areas
    keys: Ints
    beyond: _Beyond | None
    left_out: LeftOut


@dataclass(frozen=True, slots=True)
class _Beyond:
    """Known entities near one ego but outside its graphs."""

    frames: FrameBlock
    areas: Areas
    keys: Ints


@dataclass(frozen=True, slots=True)
class _World:
    """Results in the range of all egos together: bodies, pairs and contacts. All egos share them.

    ``whole`` is the same with the surroundings of the graphs, but without pairs.
    """

    keys: Ints
    bodies: Bodies
    rows: tuple[Ints, int, int]
    near: Gathered
    contacts: Gathered
    standing: Standing | None
    whole: _World | None = None
    uneven: int = 0

    def of(self, keys: Ints) -> _World:
        """Select from these results those in the range of one ego."""
        if len(keys) == len(self.keys):
            return self
        rows = np.searchsorted(self.keys, keys)
        place = np.full(len(self.keys), -1)
        place[rows] = np.arange(len(rows))
        return _World(
            keys=keys,
            bodies=self.bodies.take(rows),
            rows=(keys, *self.rows[1:]),
            near=(_among(place, self.near[0]), self.near[1]),
            contacts=(_among(place, self.contacts[0]), self.contacts[1]),
            standing=None if self.standing is None else self.standing.take(place),
            uneven=self.uneven,
        )


def _united(keys: Sequence[Ints]) -> Ints:
    """Return the sorted union of several ascending key arrays."""
    if len(keys) == 1:
        return keys[0]
    every = np.concatenate([np.zeros(0, np.int64), *keys])
    every.sort(kind="stable")  # A stable sort is fast for a few ascending runs.
    return every[begins(every)]


def _in_ascending(keys: Ints, some: Ints) -> Bools:
    """Return a mask of the values that occur in the ascending array ``keys``."""
    if not len(keys):
        return np.zeros(len(some), np.bool_)
    return keys[np.minimum(np.searchsorted(keys, some), len(keys) - 1)] == some


def _reduced(frames: FrameBlock, kept: Rows) -> FrameBlock:
    """Return the frames with only the given object states."""
    states = frames.states
    return replace(
        frames,
        offsets=np.searchsorted(kept, frames.offsets),
        states=states if len(kept) == len(states) else states.take(kept),
    )


_BEYOND_CODES: Final = tuple(RELATION_CODE[name] for name in BEYOND)


def _of_codes(edges: Edges, codes: tuple[int, ...]) -> Edges:
    return taken(edges, np.flatnonzero(np.isin(edges.relation, codes)))


def _rows_apart(one: Edges, other: Edges) -> tuple[Rows, Rows]:
    """Return the rows of edges that only the first table has, and the rows that only the second has."""
    a, b = _keys(*((of.frame, of.relation, of.src, of.dst) for of in (one, other)))
    return (
        np.flatnonzero(~_in_ascending(np.sort(b), a)),
        np.flatnonzero(~_in_ascending(np.sort(a), b)),
    )


def _keys(one: tuple[Whole | Codes, ...], other: tuple[Whole | Codes, ...]) -> tuple[Ints, Ints]:
    """Return a number for each row of two tables, so that equal rows have equal numbers."""
    keys = np.zeros(len(one[0]) + len(other[0]), np.int64)
    for columns in zip(one, other, strict=True):
        column = np.concatenate(columns, dtype=np.int64)
        least = column.min(initial=0)
        keys = keys * (column.max(initial=0) - least + 1) + (column - least)
    return keys[: len(one[0])], keys[len(one[0]) :]


def _among(place: Rows, pairs: tuple[Rows, Rows]) -> tuple[Rows, Rows]:
    """Convert pairs of old row numbers to new ones. Drop each pair in which a row was removed."""
    a, b = place[pairs[0]], place[pairs[1]]
    both = (a >= 0) & (b >= 0)
    return a[both], b[both]


def _ego_rows(frames: FrameBlock) -> Rows:
    """Return the row of the ego's state in each frame; -1 if the state or its position is missing."""
    states = frames.states
    rows = np.flatnonzero(states.node == np.repeat(frames.ego, np.diff(frames.offsets)))
    rows = rows[np.isfinite(states.x[rows]) & np.isfinite(states.y[rows])]
    ego = np.full(len(frames), -1)
    ego[frames.frame_of[rows]] = rows
    return ego


def _places(frames: FrameBlock, ego: Rows) -> EgoPoses:
    """Return the poses of the ego in each frame; NaN without an ego."""
    of = frames.states
    columns = (of.x, of.y, of.heading, _bottom(of))
    return EgoPoses(*(np.append(column, np.nan)[ego] for column in columns))


def _boxes(states: States) -> Floats:
    columns = (states.x, states.y, states.heading, states.length, states.width)
    return np.stack(columns, axis=1)


def _bottom(states: States) -> Floats:
    """Return the bottom height of each box. A box without a height lies at ``z``."""
    return states.z - np.nan_to_num(states.height) / 2


def _presence(bodies: Bodies, present: Bools | None) -> StaticPresence:
    """Return the static nodes of the graphs: static objects and map nodes."""
    still = np.flatnonzero(~bodies.moves)
    frame, column = np.nonzero(present) if present is not None else (still[:0], still[:0])
    return StaticPresence(
        np.concatenate([bodies.frame[still], frame]),
        np.concatenate([bodies.node[still], -1 - column]),
    )


def _unsure(bodies: Bodies, ground: MapContext | None) -> Ints:
    return np.zeros(0, np.int64) if ground is None else bodies.node[ground.unsure]


def _lane_states(bodies: Bodies, standing: Standing | None) -> LaneStates:
    if standing is None:
        none = np.zeros(0, np.int64)
        empty = np.zeros(0)
        false = np.zeros(0, np.bool_)
        return LaneStates(none, none, none, empty, empty, empty, false, empty, false)
    hits = standing.hits
    return LaneStates(
        frame=bodies.frame[hits.row],
        node=bodies.node[hits.row],
        lane=hits.lane,
        overlap=hits.overlap,
        offset=hits.offset,
        heading_error=hits.heading_error,
        primary=hits.primary,
        along=standing.along,
        own=standing.own,
    )
