"""Pairs of objects that can have relations, computed with limited memory.

This module finds related bodies, and computes the numbers that the relations need.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.numba_loops import worth
from sgstore.base.tables import spread
from sgstore.graphs.relations._scene import (
    CHUNK,
    IS_SIGNAL,
    Bodies,
    BodyPairs,
    distances,
    levels,
    parts,
    span_up_to,
    spans,
)
from sgstore.model.vocabulary import KIND_CODE, KINDS, kinds_labelled, normalize_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from sgstore.model.config import Config
    from sgstore.model.world import Bools, Ints

    Rows = NDArray[np.intp]
    Halves = tuple[Rows, Rows]


CELLS: Final = 8
"""Number of grid strips for each search distance. More strips give slightly fewer candidates."""

FAR_STRIP: Final = 1 << 40
"""Largest number of a grid strip, so that keys fit into 64 bits. Positions beyond it share this strip."""

NO_PAIRS: Final[Halves] = (np.zeros(0, np.intp), np.zeros(0, np.intp))


def near_pairs(bodies: Bodies, config: Config, unwanted: Bools) -> Iterator[Halves]:
    """Yield pairs of moving objects that are near each other in a frame. Traffic signals are left out.

    Parameters
    ----------
    bodies : Bodies
    config : Config
    unwanted : (F,) bool
        Frames to skip; the caller may change it between chunks.

    Yields
    ------
    a, b : intp
        Rows, in chunks.
    """
    rows = np.flatnonzero(bodies.moves & ~IS_SIGNAL[bodies.kind])
    return pairs_among(bodies, rows, config, unwanted)


def pairs_among(bodies: Bodies, rows: Rows, config: Config, unwanted: Bools) -> Iterator[Halves]:
    """Yield the pairs of near objects among the given ones, whether they move or not."""
    within, between = config.pairs.within, config.proximity.between
    if within > 0 and between != "footprints" and worth():
        yield from _near_in_loops(bodies, rows, within, between, unwanted)
    elif within > 0:
        yield from _near_pairs(bodies, rows, within, between, unwanted)


def related_pairs(bodies: Bodies, ego: Rows, near: Halves, config: Config) -> BodyPairs:
    """Return all pairs that can have relations: the ego with each other object, and pairs of near objects.

    Parameters
    ----------
    bodies : Bodies
    ego : (F,) intp
        Row of the ego of each frame, or -1.
    near : tuple of intp arrays
        Other pairs: bodies that are near each other.
    config : Config
        Signals and scenery are related to the ego only, unless the settings also relate static
        entities to each other (:mod:`sgstore.graphs.relations._pairs`). A body without a position is near
        no other; it is still related to the ego, with missing numbers, unless the ego has a
        distance limit too.
    """
    settings, between = config.pairs, config.proximity.between
    if not settings.ego:
        return BodyPairs(bodies, *of_kinds(bodies, ego, near, settings.kinds), between)
    mine = ego[bodies.frame]
    is_ego = mine == np.arange(len(bodies))
    others = np.flatnonzero((mine >= 0) & ~is_ego)
    a, b = near
    further = np.flatnonzero(~(is_ego[a] | is_ego[b]))
    with_ego = mine[others], others
    if settings.ego_within > 0:
        close = distances(bodies, *with_ego, between) <= settings.ego_within
        with_ego = with_ego[0][close], with_ego[1][close]
    halves = _behind(with_ego, near, further)
    halves = of_kinds(bodies, ego, halves, settings.kinds)
    return BodyPairs(bodies, *halves, between)


def _behind(pairs: Halves, others: Halves, rows: Rows) -> Halves:
    """Append some rows of a second list of object pairs to the first list."""
    count = len(pairs[0])
    a, b = np.empty((2, count + len(rows)), np.intp)
    for column, first, rest in zip((a, b), pairs, others, strict=True):
        column[:count] = first
        np.take(rest, rows, out=column[count:], mode="clip")  # this copies only the selected rows
    return a, b


def of_kinds(
    bodies: Bodies, ego: Rows, pairs: Halves, kinds: tuple[tuple[str, ...], ...]
) -> Halves:
    """Return the object pairs whose kinds are a listed pair, in either order. An empty list allows all."""
    if not kinds:
        return pairs
    a, b = pairs
    kept = are_of_kinds(bodies, ego, pairs, kinds)
    return a[kept], b[kept]


def are_of_kinds(
    bodies: Bodies, ego: Rows, pairs: Halves, kinds: tuple[tuple[str, ...], ...]
) -> Bools:
    """Return a mask of the object pairs whose kinds are a listed pair, in either order."""
    listed = np.zeros((len(KINDS) + 1, len(KINDS) + 1), np.bool_)  # the last row is the ego
    for one, other in kinds:
        listed[np.ix_(_kind_codes(one), _kind_codes(other))] = True
    listed |= listed.T
    a, b = pairs
    of_a, of_b = bodies.kind[a].astype(np.intp), bodies.kind[b].astype(np.intp)
    kept = listed[of_a, of_b]
    kept |= listed[-1, of_b] & (ego[bodies.frame[a]] == a)
    return kept | listed[of_a, -1] & (ego[bodies.frame[b]] == b)


def _kind_codes(label: str) -> list[int]:
    if normalize_name(label) == "ego":
        return [len(KINDS)]
    return [KIND_CODE[kind] for kind in kinds_labelled(label) or ()]


def joined_pairs(halves: list[Halves]) -> Halves:
    """Concatenate lists of object pairs."""
    return np.concatenate([a for a, _ in halves]), np.concatenate([b for _, b in halves])


def _near_pairs(
    bodies: Bodies, rows: Rows, within: float, between: str, unwanted: Bools
) -> Iterator[tuple[Rows, Rows]]:
    """Yield the pairs of given objects that are within a distance of each other in the same frame.

    The rows are sorted by frame and by strips across the x axis. The candidates of a row are the
    later rows in its own strip and in the next few strips: a range of the sorted rows.
    """
    rows = rows[np.isfinite(bodies.x[rows])]
    reach = within
    if between == "footprints":
        reach += float(np.nan_to_num(np.hypot(bodies.length, bodies.width)[rows]).max(initial=0))
    strip = np.clip(np.floor(bodies.x[rows] * (CELLS / reach)), -FAR_STRIP, FAR_STRIP).astype(
        np.int64
    )
    key = (bodies.frame[rows] << 43) + strip + FAR_STRIP
    order = np.argsort(key, kind="stable")
    rows, key = rows[order], key[order]
    start = np.arange(1, len(rows) + 1)
    # One strip more than the distance: the division above may round up.
    count = np.searchsorted(key, key + CELLS + 1, side="right") - start
    frame, limit = bodies.frame[rows], span_up_to(within, between)
    for part in parts(count):
        if unwanted[frame[part]].all():
            continue
        owner, index = spread(start[part], count[part])
        first, second = rows[part][owner], rows[index]
        near = np.flatnonzero(spans(bodies, first, second, between) <= limit)
        yield first[near], second[near]


def _near_in_loops(
    bodies: Bodies, rows: Rows, within: float, between: str, unwanted: Bools
) -> Iterator[Halves]:
    """Yield the same object pairs as :func:`_near_pairs` with compiled loops, in another order."""
    from sgstore.graphs.relations import _loops

    rows = rows[np.isfinite(bodies.x[rows])]
    order = rows[np.lexsort((bodies.x[rows], bodies.frame[rows]))]
    frame = bodies.frame[order]
    end = np.searchsorted(frame, frame, side="right")
    count = end - np.arange(len(end))
    room = max(min(int(count.sum()), AT_ONCE), CHUNK, int(count.max(initial=0)))
    a, b = found = np.empty(room, np.intp), np.empty(room, np.intp)
    place, limit = (bodies.x, bodies.y, levels(bodies, between)), span_up_to(within, between)
    first = 0
    while first < len(order):
        if unwanted[frame[first]]:
            first = int(end[first])
            continue
        many, first = _loops.near_pairs(first, order, end, place, limit, found)
        if first == len(order):
            yield a[:many], b[:many]
        else:
            yield a[:many].copy(), b[:many].copy()


# Pairs of static entities: found once, on their first appearance, and looked up where both are in
# range.

MOST_LEARNT: Final = 1 << 22
"""Largest number of cached pairs of static objects. Above it, each frame computes them again."""


class StillPairs:
    """Pairs of near static objects in a trace. Empty unless the settings request them.

    Parameters
    ----------
    config : Config
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._a, self._b = NO_PAIRS
        self._too_many = False

    @property
    def wanted(self) -> bool:
        """True if the settings request relations between static objects."""
        return self._config.pairs.static and self._config.pairs.within > 0

    def learn(self, scenery: Bodies) -> None:
        """Find the pairs of near objects among all static objects so far, unless there are too many."""
        rows = np.arange(len(scenery))
        (a, b), over = gathered(
            lambda unwanted: pairs_among(scenery, rows, self._config, unwanted),
            np.zeros(len(scenery), np.int64),
            frames=1,
            most=MOST_LEARNT,
        )
        order = np.argsort(a, kind="stable")
        self._a, self._b = a[order], b[order]
        self._too_many = bool(over.any())

    def among(
        self, bodies: Bodies, keys: Ints, states: int, count: int, unwanted: Bools
    ) -> Iterator[tuple[Rows, Rows]]:
        """Yield the pairs of near static objects if both are in range of the ego.

        Parameters
        ----------
        bodies : Bodies
            Bodies in range.
        keys : int64
            Entities in range, ascending: from ``states`` on, frame times ``count`` plus the row of
            the scenery.
        states, count : int
            Rows of the block's states, and of the scenery.
        unwanted : (F,) bool
            Frames to skip; the caller may change it between chunks.

        Yields
        ------
        a, b : intp
            Places in ``keys``, in chunks.
        """
        if self._too_many:
            yield from pairs_among(bodies, np.flatnonzero(~bodies.moves), self._config, unwanted)
        if not len(self._a):
            return
        first = int(np.searchsorted(keys, states))
        still = keys[first:] - states
        start = np.searchsorted(self._a, still % count)
        length = np.searchsorted(self._a, still % count, side="right") - start
        frame = bodies.frame[first:]
        for part in parts(length):
            if unwanted[frame[part]].all():
                continue
            owner, pair = spread(start[part], length[part])
            owner += part.start
            other = still[owner] - self._a[pair] + self._b[pair]
            place = np.minimum(np.searchsorted(still, other), max(len(still) - 1, 0))
            found = np.flatnonzero(still[place] == other)
            yield first + owner[found], first + place[found]


# Memory bounds of crowded frames. n bodies in one place have n² / 2 pairs, and each pair can have
# several edges. Two bounds limit the memory: a block is cut into pieces of frames with at most
# :data:`AT_ONCE` pairs; and one frame relates at most :data:`MOST_PAIRS`. In a frame above this
# limit bodies are related to the ego only; the store records this as a loss.

MOST_PAIRS: Final = 1 << 18
"""Largest number of related or touching pairs in one frame, each pair counted once. 724 mutually near objects
reach it, or 5,000 objects with a hundred neighbours each."""

AT_ONCE: Final = 1 << 18
"""Estimated number of pairs in the frames of one computation: about 200 MB with all results."""


def gathered(
    chunks: Callable[[Bools], Iterable[Halves]], frame: Ints, frames: int, most: int | None = None
) -> tuple[Halves, Bools]:
    """Collect the object pairs of all frames. Leave out frames with too many pairs.

    Parameters
    ----------
    chunks : function
        Function that yields pairs of rows. Its argument is a mask of frames to skip, which changes
        while pairs are read.
    frame : (N,) int64
        Frame of each row.
    frames : int
        Number of frames.
    most : int, optional
        Greatest number of pairs per frame; by default :data:`MOST_PAIRS`.

    Returns
    -------
    pairs : tuple of intp arrays
    over : (frames,) bool
        Frames with more pairs; their pairs are left out.
    """
    most = MOST_PAIRS if most is None else most
    over, count = np.zeros(frames, np.bool_), np.zeros(frames, np.int64)
    found: list[Halves] = [NO_PAIRS]
    crowd = int(np.bincount(frame, minlength=1).max())
    for chunk in chunks(over):
        found.append(chunk)
        if crowd * (crowd - 1) // 2 <= most:
            continue
        count += np.bincount(frame[chunk[0]], minlength=frames)
        new = (count > most) & ~over
        if new.any():
            over |= new
            found = [_without(pairs, over[frame[pairs[0]]]) for pairs in found]
        elif over.any():
            found[-1] = _without(chunk, over[frame[chunk[0]]])
    return found[1] if len(found) == 2 else joined_pairs(found), over


def _without(pairs: Halves, left_out: Bools) -> Halves:
    return pairs[0][~left_out], pairs[1][~left_out]
