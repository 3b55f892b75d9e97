"""Recent graphs of an online run. They show when pattern parts were true, and the values of attributes."""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import numpy as np

from sgstore.errors import SgstoreError, StoreError
from sgstore.lang.help import parts_of
from sgstore.lang.memory import Binding, FrameView, ScopeSearch
from sgstore.model.pair_numbers import PAIR_FUNCTIONS
from sgstore.model.world import INPUTS, POSE
from sgstore.temporal.truth_lanes import TruthLane, TruthLanes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from sgstore.lang.ir import Query
    from sgstore.model.graph import SceneGraph
    from sgstore.temporal._sequence_monitor import FrameTime

MOST_EDGES: Final = 100_000
"""Largest number of edges in the stored graphs; about 30 MB."""

MOST_FOLLOWED: Final = 36
"""Largest number of updated matches and curves. A page needs one match and eight curves."""

LONGEST_CURVE: Final = 3000
"""Largest number of frames of a curve."""

OF_NODE: Final = (*POSE, *INPUTS, "speed", "accel")
OF_PAIR: Final = {one.column or name: name for name, one in PAIR_FUNCTIONS.items()}
"""Pair values that can be followed as a curve, by their columns in the view ``pairs``."""

W = TypeVar("W", "FollowedMatch", "FollowedCurve")


class NotKeptError(SgstoreError):
    """Error: a query needs data of a past frame, and the monitor has not kept them.

    These data are the frame class and the lane roles.
    """


class FollowedMatch:
    """Frames among the recent ones in which each part of a pattern is true, for the nodes of one match.

    Parameters
    ----------
    query : Query
        Pattern, bound by the monitor.
    nodes : mapping of str to int

    Attributes
    ----------
    begun, seen : int
        First and last evaluated frame; -1: none.

    Raises
    ------
    QueryNameError
        The pattern lacks a variable of the binding.
    """

    def __init__(self, query: Query, nodes: Mapping[str, int]) -> None:
        self._nodes = dict(nodes)
        self._parts = tuple(parts_of(query, {name: [node] for name, node in nodes.items()}))
        self._spans: list[list[tuple[int, int]]] = [[] for _ in self._parts]
        self._search = [
            None
            if part.query.steps  # it also depends on other frames
            else ScopeSearch(part.query.scope, injective=part.query.injective)
            for part in self._parts
        ]
        self.begun = self.seen = -1

    def look(self, views: Iterable[FrameView]) -> None:
        """Evaluate the parts of the pattern in the new frames."""
        for view in views:
            seq = view.frame["seq"]
            if seq <= self.seen:
                continue
            self.begun = seq if self.begun < 0 else self.begun
            self.seen = seq
            for number, (search, spans) in enumerate(zip(self._search, self._spans, strict=True)):
                try:
                    holds = search is not None and any(True for _ in search.run(Binding(view)))
                except NotKeptError:
                    self._search[number], holds = None, False
                if holds and spans and spans[-1][1] == seq - 1:
                    spans[-1] = spans[-1][0], seq
                elif holds:
                    spans.append((seq, seq))

    def lanes(self, trace: str, first: int) -> TruthLanes:
        """For each part of the pattern, return the frames from ``first`` on in which the part is true.

        The format is that of :meth:`sgstore.Store.parts`.
        """
        lanes = (
            TruthLane(part, (), ("values of other frames",))
            if search is None
            else TruthLane(part, tuple(one for one in spans if one[1] >= first))
            for part, search, spans in zip(self._parts, self._search, self._spans, strict=True)
        )
        return TruthLanes(trace, self._nodes, tuple(lanes))


class FollowedCurve:
    """Recent values of an entity's attribute, or of a number of two entities, as a curve over time.

    Parameters
    ----------
    attribute : str
        Column of the view ``nodes`` or ``pairs``.
    node : int
    other : int, optional

    Raises
    ------
    StoreError
        The attribute does not exist or is not a number.
    """

    def __init__(self, attribute: str, node: int, other: int | None) -> None:
        known = OF_NODE if other is None else OF_PAIR
        if attribute not in known:
            told = f"no number {attribute!r} of {'a node' if other is None else 'two'}"
            raise StoreError(f"{told}; there are {', '.join(known)}")
        self._attribute, self._node, self._other = attribute, node, other
        self._told: deque[tuple[int, float, float]] = deque(maxlen=LONGEST_CURVE)
        self._seen = -1

    def look(self, views: Iterable[FrameView]) -> None:
        """Append the values of the new frames to the curve."""
        for view in views:
            seq, about = view.frame["seq"], view.nodes.get(self._node)
            if seq <= self._seen or about is None:
                continue
            self._seen = seq
            if self._other is None:
                value = about.get(self._attribute)
            else:
                value = view.pair(OF_PAIR[self._attribute], self._node, self._other)
            self._told.append((seq, view.frame["t"], math.nan if value is None else float(value)))

    def columns(self) -> dict[str, Any]:
        """Return the curve as arrays of frame numbers, times (s) and values.

        The format is that of :meth:`sgstore.store.StoreFile.series`.
        """
        types = {"seq": np.uint32, "t": np.float64, "value": np.float32}
        told = zip(*self._told, strict=True) if self._told else ((), (), ())
        return {name: np.array(c, types[name]) for name, c in zip(types, told, strict=True)}


class RecentGraphs:
    """Most recent scene graphs of an online run. Requested matches and curves are updated with each new graph.

    Memory is bounded: at most :data:`MOST_EDGES` edges, or one graph, and :data:`MOST_FOLLOWED` matches and
    curves. The object is not thread-safe.
    """

    def __init__(self) -> None:
        self._views: deque[FrameView] = deque()
        self._edges = 0
        self._followed: OrderedDict[tuple[Any, ...], FollowedMatch | FollowedCurve] = OrderedDict()

    def add(self, here: FrameTime, graph: SceneGraph, trace: str) -> None:
        """Add the scene graph of the next frame, and drop old graphs."""
        frame = {"id": here.seq, "seq": here.seq, "time_ns": here.time_ns, "t": here.t}
        view = FrameView(graph, frame, {"id": 0, "name": trace}, _not_kept, _not_kept)
        self._views.append(view)
        self._edges += len(graph.edges)
        while self._edges > MOST_EDGES and len(self._views) > 1:
            self._edges -= len(self._views.popleft().graph.edges)
        for one in self._followed.values():
            one.look([view])

    def view(self, seq: int) -> FrameView:
        """Return the scene graph of a recent frame. The number of a frame that was dropped raises an error.

        Raises
        ------
        StoreError
            The frame is no longer stored.
        """
        for view in self._views:
            if view.frame["seq"] == seq:
                return view
        first = self._views[0].frame["seq"] if self._views else 0
        raise StoreError(f"the graph of frame #{seq} is not kept; those from #{first} on are")

    def match(self, name: str, query: Query, nodes: Mapping[str, int]) -> FollowedMatch:
        """Return the recent frames in which each part of a pattern is true. Later frames update the result.

        Errors: see :class:`FollowedMatch`.
        """
        return self._follow((name, *sorted(nodes.items())), partial(FollowedMatch, query, nodes))

    def curve(self, attribute: str, node: int, other: int | None = None) -> FollowedCurve:
        """Return the curve of a value in recent frames. Later frames update the result.

        Errors: see :class:`FollowedCurve`.
        """
        key = attribute, node, other
        return self._follow(key, partial(FollowedCurve, *key))

    def _follow(self, key: tuple[Any, ...], make: Callable[[], W]) -> W:
        if key not in self._followed:
            self._followed[key] = made = make()
            made.look(self._views)
        self._followed.move_to_end(key)
        while len(self._followed) > MOST_FOLLOWED:
            self._followed.popitem(last=False)
        return cast("W", self._followed[key])


def _not_kept(*_: object) -> Any:
    raise NotKeptError("it is known of the last frame only")
