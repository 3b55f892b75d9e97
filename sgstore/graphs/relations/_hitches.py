"""Relation ``tows``, and the carriers of trailers and riders.

A trailer and its tractor touch all the time, as a rider and the bicycle do. This is not a
collision, and neither follows the other. Therefore they are not a pair: only relations of direction
and sight hold between them, and the numbers of the pair are unknown.

*The carrier* comes from the recording (:attr:`sgstore.model.world.Entities.trailer`), for any kind of
carried entity, or from geometry: a trailer that touches a vehicle ahead of it, or a person with the
centre in the footprint of a two-wheeler and the same heading, in the first frame that has both.
Later contacts do not count. A pair ends for good when the distance exceeds :data:`APART`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.geometry import offsets
from sgstore.graphs.relations._contact import contacts
from sgstore.graphs.relations._scene import (
    IS_VEHICLE,
    Relation,
    edges_between,
    joined,
    kinds_mask,
    relates_pairs,
)
from sgstore.model.pair_numbers import gap
from sgstore.model.vocabulary import KIND_CODE, SUPER_KINDS
from sgstore.model.world import UNTOLD

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sgstore.graphs.relations._scene import BlockScene, Bodies
    from sgstore.model.graph import Edges
    from sgstore.model.world import Bools, Codes, Entities, FrameBlock, Ints

    Rows = NDArray[np.intp]


APART: Final = 5.0
"""Largest gap between a trailer and its towing vehicle; m."""

_FACES: Final = 0.7
"""Smallest cosine of the angle between a rider and the bicycle."""

_TRAILER: Final = KIND_CODE["trailer"]
_PERSON: Final = KIND_CODE["person"]
_IS_TWO_WHEELER: Final = kinds_mask(tuple(SUPER_KINDS["two_wheeler"]))


class Hitches:
    """Carriers in a trace: objects that pull or carry others, such as a towing vehicle or a ridden bicycle."""

    def __init__(self) -> None:
        self._kind: Codes = np.zeros(0, np.int8)
        self._seen: Bools = np.zeros(0, np.bool_)
        self._carrier: Ints = np.zeros(0, np.int64)
        self._vehicles: dict[str, int] = {}
        self._said: dict[str, int] = {}

    def learn(self, entities: Entities) -> None:
        """Record the new objects of a block of frames, as possible carriers and loads."""
        count = len(entities)
        self._kind = np.append(self._kind, entities.kind)
        self._seen = np.append(self._seen, np.zeros(count, np.bool_))
        self._carrier = np.append(self._carrier, np.full(count, -1))
        for row in np.flatnonzero(IS_VEHICLE[entities.kind]).tolist():
            self._vehicles[entities.ident[row]] = entities.first + row
        for row, trailer in enumerate(entities.trailer):
            if trailer:
                self._said[trailer] = entities.first + row
        for trailer in [ident for ident in self._said if ident in self._vehicles]:
            self._carrier[self._vehicles[trailer]] = self._said.pop(trailer)

    def see(self, frames: FrameBlock, bodies: Callable[[Rows], Bodies]) -> Ints:
        """Return the carrier of each object state in a block, as node id; -1 without a carrier.

        Parameters
        ----------
        frames : FrameBlock
        bodies : function
            Function from rows of states to bodies.
        """
        states = frames.states
        carrier = states.carrier
        untold = carrier == UNTOLD
        if not untold.any():
            return carrier
        kind = self._kind[states.node]
        trailer, person = kind == _TRAILER, kind == _PERSON
        apt = IS_VEHICLE[kind] if trailer.any() else _IS_TWO_WHEELER[kind]
        apt = apt | trailer | person
        new = apt & ~self._seen[states.node]
        if new.any() and (trailer | person).any():
            self._meet(bodies, np.flatnonzero(apt & new_frames(frames, new)), states.node)
        self._seen[states.node] = True
        found = np.where(untold, self._carrier[states.node], carrier)
        rows = np.flatnonzero(found >= 0)
        return self._parted(bodies, frames, rows, found) if len(rows) else found

    def _meet(self, bodies: Callable[[Rows], Bodies], rows: Rows, node: Ints) -> None:
        """Find carriers: objects that touch a possible load in the first frame in which both occur."""
        of = bodies(rows)
        first = _first(of.node, of.frame, len(self._seen))
        first[self._seen] = -1
        for a, b in contacts(of, np.zeros(int(of.frame.max(initial=0)) + 1, np.bool_)):
            one, other = np.concatenate([a, b]), np.concatenate([b, a])
            begins = np.maximum(first[of.node[one]], first[of.node[other]]) == of.frame[one]
            begins &= self._carrier[of.node[one]] < 0
            fits = begins & self._fits(of, one, other)
            one, other = one[fits], other[fits]
            away = np.hypot(of.x[other] - of.x[one], of.y[other] - of.y[one])
            order = np.argsort(-away, kind="stable")  # the nearest is written last
            self._carrier[of.node[one[order]]] = of.node[other[order]]

    def _fits(self, of: Bodies, one: Rows, other: Rows) -> Bools:
        """Return a mask of the pairs of objects in which the second can carry or pull the first."""
        dx, dy = of.x[other] - of.x[one], of.y[other] - of.y[one]
        ahead, _ = offsets(dx, dy, of.heading[one])
        pulled = (of.kind[one] == _TRAILER) & IS_VEHICLE[of.kind[other]] & (ahead > 0)
        onward, aside = offsets(dx, dy, of.heading[other])
        within = np.abs(onward) <= of.length[other] / 2
        within &= np.abs(aside) <= of.width[other] / 2
        faces = np.cos(of.heading[one] - of.heading[other]) > _FACES
        ridden = (of.kind[one] == _PERSON) & _IS_TWO_WHEELER[of.kind[other]] & within & faces
        return pulled | ridden

    def _parted(
        self, bodies: Callable[[Rows], Bodies], frames: FrameBlock, rows: Rows, carrier: Ints
    ) -> Ints:
        """Return the carriers in a block of frames. A pair that moves apart has no carrier after that."""
        states, frame = frames.states, frames.frame_of
        a, b = _carried(frame, states.node, rows, carrier[rows])
        parted = gap(bodies(a).boxes, bodies(b).boxes) > APART
        for row in a[parted].tolist():
            node = states.node[row]
            if self._carrier[node] >= 0:
                self._carrier[node] = -1
                carrier = np.where((states.node == node) & (frame >= frame[row]), -1, carrier)
        return carrier


def new_frames(frames: FrameBlock, new: Bools) -> Bools:
    """Return a mask of the object states in frames in which a new object occurs."""
    first = _first(frames.states.node[new], frames.frame_of[new], int(frames.states.node.max()) + 1)
    wanted = np.zeros(len(frames), np.bool_)
    wanted[first[first >= 0]] = True
    return wanted[frames.frame_of]


def _first(node: Ints, frame: Ints, count: int) -> Ints:
    """Return the first frame of each node id from 0 on, (count,); -1 for a node that does not occur."""
    first = np.full(count, -1)
    order = np.lexsort((-frame, node))
    first[node[order]] = frame[order]
    return first


def _edges(scene: BlockScene) -> Edges:
    bodies = scene.bodies
    pulled = np.flatnonzero((bodies.carrier >= 0) & (bodies.kind != _PERSON))
    if not len(pulled):
        return edges_between(scene, "tows", pulled, pulled)
    pulled, pulling = _carried(bodies.frame, bodies.node, pulled, bodies.carrier[pulled])
    return edges_between(scene, "tows", pulling, pulled)


def _carried(frame: Ints, node: Ints, rows: Rows, carrier: Ints) -> tuple[Rows, Rows]:
    """Return the rows of carried objects, and the rows of their carriers in the same frame."""
    count = int(max(node.max(), carrier.max())) + 1
    key = frame * count + node
    order = np.argsort(key, kind="stable")
    one, place = joined(key[order], frame[rows] * count + carrier)
    return rows[one], order[place]


TOWS = Relation(
    name="tows",
    doc="vehicle → trailer: it pulls the trailer; the two are no pair for `overlaps`, proximity, `leads`"
    " and numbers",
    edges=_edges,
    settings=relates_pairs,
    legend="trailer",
)
