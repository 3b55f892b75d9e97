"""Features of scene graphs, such as (car, near, ego), and combinations of k features in frames.

Equal classes have equal features; therefore one frame per class is read.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, combinations
from math import comb
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ConfigError
from sgstore.testsets.coverage._frames import (
    SHARES,
    ReportTable,
    is_of_ego,
    of_unknown,
    query_of_features,
    share,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.testsets.coverage._classes import Classed


Feature = tuple[str, ...]
"""Labels of source, edge and destination of an edge; without edges in the abstraction, label of a node."""

MOST: Final = 5_000_000
"""Largest number of combinations. More combinations raise an error, so that a result is always complete."""

LARGEST: Final = 4_000_000_000
"""Largest size of the feature counts of all classes; bytes."""

_ROWS: Final = 8_192
"""Number of classes that are multiplied at once."""


@dataclass(frozen=True)
class ClassFeatures:
    """Counts of features: how often each feature occurs in the graph of each scene class.

    Attributes
    ----------
    names : tuple of Feature
        In alphabetical order.
    codes : (C,) int64
        The classes, ascending.
    counts : (C, F) unsigned
        Number of occurrences of each feature in each class.
    frames : (C,) int64
        Number of frames of each class.
    """

    names: tuple[Feature, ...]
    codes: Ints
    counts: NDArray[np.unsignedinteger[Any]]
    frames: Ints

    @property
    def there(self) -> Bools:
        """Return a mask (C, F) for C scene classes and F features: True if the class has the feature."""
        return self.counts > 0

    def matrix(self, most: int) -> dict[str, Any]:
        """For each pair of frequent features, return the number of frames that have both.

        Features of all frames are left out, because they have no gaps; and so are relations from the ego
        where relations to it are known, because most of them are the same in the other direction.

        Returns
        -------
        dict
            ``names`` of the features; ``frames`` with both, a row for each feature; ``queries`` for the pairs
            without frames, by their places: ``"3 7"``.
        """
        alone = self.frames @ self.there
        order = np.argsort(-alone, kind="stable").tolist()
        some = [i for i in order if alone[i] < self.frames.sum()]
        of_ego = [
            i
            for i in some
            if "ego" in {self.names[i][-1], *self.names[i][:1]} and len(self.names[i]) == 3
        ]
        to_ego = [i for i in of_ego if self.names[i][2] == "ego" or self.names[i][1] == "isIn"]
        some = (to_ego or some)[:most]
        there = self.there[:, some].astype(np.int64)
        frames = there.T @ (there * self.frames[:, None])
        gaps = np.argwhere(np.triu(frames == 0)).tolist()
        pairs = {
            f"{i} {j}": query_of_features([self.names[some[i]], self.names[some[j]]])
            for i, j in gaps
        }
        names = [" ".join(self.names[i]) for i in some]
        return {"names": names, "frames": frames.tolist(), "queries": pairs}


def features(a: Classed, abstraction: str, *, of_ego: bool = False) -> ClassFeatures:
    """Return the features of the scene classes that occur in selected frames.

    Parameters
    ----------
    a : Classed
        Its classes must belong to this abstraction.
    abstraction : str
    of_ego : bool
        True: only features of the ego, and of lanes by their role for it.

    Raises
    ------
    ConfigError
        They exceed the memory limit.
    """
    codes, first = a.present(), a.first()
    order = np.argsort(first[codes], kind="stable")
    number: dict[Feature, int] = {}
    parts: list[tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]] = []
    read = a.chosen.abstracted.features(abstraction, first[codes[order]])
    for row, some in read:
        own = np.array([number.setdefault(name, len(number)) for name in some.names] or [0])
        rows, columns = order[row[some.frame]].astype(np.int32), own[some.feature].astype(np.int32)
        parts.append((rows, columns, some.often.astype(np.int32)))
    edges = any(len(name) == 3 for name in number)
    known = {name for name in number if len(name) == 3 or not edges}
    names = tuple(sorted(name for name in known if not of_ego or is_of_ego(name)))
    place = {name: i for i, name in enumerate(names)}
    at = np.array([place.get(name, -1) for name in number] or [-1])
    most = max((int(often.max(initial=0)) for *_, often in parts), default=0)
    counts = zeros((len(codes), len(names)), np.min_scalar_type(most))
    for rows, columns, often in parts:
        column = at[columns]
        kept = np.flatnonzero(column >= 0)
        counts[rows[kept], column[kept]] = often[kept]
    return ClassFeatures(names, codes, counts, a.sizes()[codes])


def zeros(shape: tuple[int, int], kind: np.dtype[Any]) -> NDArray[np.unsignedinteger[Any]]:
    """Return an array of zeros for feature counts. An array that is too large raises an error.

    Raises
    ------
    ConfigError
        It exceeds the memory limit.
    """
    if shape[0] * shape[1] * kind.itemsize > LARGEST:
        raise ConfigError(
            f"{shape[1]:,} features in {shape[0]:,} classes would take more than {LARGEST:,} bytes: ask of"
            " fewer frames, or for an abstraction with fewer labels"
        )
    return np.zeros(shape, kind)


def weighted(counts: NDArray[np.integer[Any]], weights: Floats, more_than: int = 0) -> Floats:
    """For each feature, sum the weights of the classes with more than ``more_than`` occurrences, (K, F)."""
    total = np.zeros((len(weights), counts.shape[1]))
    # Integers below 2²⁴ are exact in 32 bits.
    small = np.abs(weights).sum() < 1 << 24 and (weights == np.round(weights)).all()
    kind = np.float32 if small else np.float64
    for first in range(0, len(counts), _ROWS):
        there = (counts[first : first + _ROWS] > more_than).astype(kind)
        total += weights[:, first : first + _ROWS].astype(kind) @ there
    return total


@dataclass(frozen=True)
class Combinations:
    """Combinations of k features that occur together, with the number of frames of each.

    Attributes
    ----------
    features : ClassFeatures
    k : int
    members : (M, k) int64
        All combinations: ascending indices of features.
    frames : (M,) int64
        Number of frames with each combination.
    """

    features: ClassFeatures
    k: int
    members: Ints
    frames: Ints

    def texts(self, rows: Sequence[int] | Ints) -> list[str]:
        """Return some combinations of features as readable texts."""
        names = [" ".join(name) for name in self.features.names]
        return [" & ".join(names[i] for i in one) for one in self.members[rows].tolist()]

    @staticmethod
    def of(found: ClassFeatures, k: int) -> Combinations:
        """Return all combinations of k features that occur in a frame, each with its frame count.

        Raises
        ------
        ConfigError
            k is not positive, or there are too many combinations.
        """
        many = len(found.names)
        if k < 1 or comb(many, k) > MOST:
            raise ConfigError(
                f"{comb(many, max(k, 0)):,} combinations of {k} of {many} features;"
                f" {MOST:,} can be gone through: ask for a smaller k, or for an abstraction"
                " with fewer labels"
            )
        size = min(k, many + 1)  # larger sizes have no combinations either
        listed = chain.from_iterable(combinations(range(many), size))
        members = np.fromiter(listed, np.int64, comb(many, size) * size).reshape(-1, size)
        if k == 2:
            frames = _together(found)[members[:, 0], members[:, 1]]
        else:
            frames = np.fromiter(_counted(found, members), np.int64, len(members))
        return Combinations(found, k, members, frames)


def _counted(found: ClassFeatures, members: Ints) -> Iterator[int]:
    """For each combination of features, yield the number of frames that have all of them."""
    packed = np.packbits(found.there, axis=0).T.copy()
    for row in members.tolist():
        both = np.bitwise_and.reduce(packed[row], axis=0)
        classes = np.flatnonzero(np.unpackbits(both, count=len(found.codes)))
        yield int(found.frames[classes].sum())


@dataclass(frozen=True)
class Combos:
    """Combinations of features that occur in a selection of frames, and those that are missing.

    Attributes
    ----------
    shares : ReportTable
    found : Combinations
        Combinations of the selection, over the features of both.
    gaps : int64
        Indices of missing combinations, the most frequent in the reference first.
    reference : ClassFeatures or None
        Features of the reference, over the features of both.
    there : int64 or None
        Number of frames of the reference with each combination.
    """

    shares: ReportTable
    found: Combinations
    gaps: Ints
    reference: ClassFeatures | None
    there: Ints | None

    @property
    def missing(self) -> ReportTable:
        """Return a table of the missing combinations of features.

        The columns are ``combination``, ``frames_in_reference`` (or ``None``), ``query``.
        """
        names, members = self.found.features.names, self.found.members[self.gaps]
        often = [None] * len(members) if self.there is None else self.there[self.gaps].tolist()
        queries = [query_of_features([names[i] for i in one]) for one in members.tolist()]
        rows = zip(self.found.texts(self.gaps), often, queries, strict=True)
        return ReportTable(("combination", "frames_in_reference", "query"), list(rows))

    @property
    def covered(self) -> ReportTable:
        """Return a table of the occurring combinations of features, the most frequent first."""
        found = self.found
        rows = np.flatnonzero(found.frames)
        rows = rows[np.argsort(-found.frames[rows], kind="stable")]
        listed = zip(found.texts(rows), found.frames[rows].tolist(), strict=True)
        return ReportTable(("combination", "frames"), list(listed))

    def matrix(self) -> tuple[list[str], Ints, Bools]:
        """Return names of features, frame counts for pairs of features, and a mask of required pairs."""
        own = self.found.features
        frames = _together(own)
        wanted = np.ones(frames.shape, np.bool_)
        if self.reference is not None:
            wanted = _together(self.reference) > 0
        return [" ".join(name) for name in own.names], frames, wanted


def combos(
    a: Classed,
    abstraction: str,
    k: int,
    reference: Classed | None = None,
    *,
    of_ego: bool = False,
) -> Combos:
    """Count the combinations of k features in selected frames, and list the missing combinations.

    Parameters
    ----------
    a : Classed
    abstraction : str
    k : int
    reference : Classed, optional
        Selection whose combinations are the reference. By default all combinations of features of
        ``a``.
    of_ego : bool
        As in :func:`features`.

    Raises
    ------
    ConfigError
        There are too many combinations.
    """
    own = features(a, abstraction, of_ego=of_ego)
    other = None if reference is None else features(reference, abstraction, of_ego=of_ego)
    names = tuple(sorted({*own.names, *(other.names if other else ())}))
    other = None if other is None else over(other, names)
    found = Combinations.of(over(own, names), k)
    name, kinds = (
        a.chosen.text,
        f"combinations of {k} of the {len(names)} features{' of the ego' if of_ego else ''}",
    )
    if other is None or reference is None:
        wanted, there = np.ones(len(found.frames), np.bool_), None
        denominator = f"all {kinds} of {name}, whether they can be or not (product)"
    else:
        theirs = Combinations.of(other, k)
        there = theirs.frames
        wanted = there > 0
        denominator = f"{kinds} that occur in {reference.chosen.text} (observed)"
    covered = (found.frames > 0) & wanted
    shares = ReportTable(
        SHARES,
        [share(f"{k}-way combinations", int(covered.sum()), int(wanted.sum()), denominator)],
        of_unknown(a.unknown, name),
    )
    gaps = np.flatnonzero(wanted & (found.frames == 0))
    if there is not None:
        gaps = gaps[np.argsort(-there[gaps], kind="stable")]
    return Combos(shares, found, gaps, other, there)


def over(own: ClassFeatures, names: tuple[Feature, ...]) -> ClassFeatures:
    """Return the feature counts of classes with one column for each feature of the given list."""
    place = {name: i for i, name in enumerate(names)}
    counts = zeros((len(own.codes), len(names)), own.counts.dtype)
    for column, name in enumerate(own.names):
        if name in place:
            counts[:, place[name]] = own.counts[:, column]
    return ClassFeatures(names, own.codes, counts, own.frames)


def _together(found: ClassFeatures) -> Ints:
    """For each pair of the F features, return the number of frames with both, (F, F)."""
    total = np.zeros((len(found.names), len(found.names)))
    kind = np.float32 if found.frames.sum() < 1 << 24 else np.float64  # exact for integers
    for first in range(0, len(found.codes), _ROWS):
        there = (found.counts[first : first + _ROWS] > 0).astype(kind)
        total += (there * found.frames[first : first + _ROWS, None].astype(kind)).T @ there
    return total.astype(np.int64)
