"""Join of sequence steps: node combinations that match all steps and agree on shared variables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.temporal._offline import refuse_many
from sgstore.temporal._trace_group import codes_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from numpy.typing import NDArray

    from sgstore.model.world import Ints
    from sgstore.temporal._trace_group import TimedRelation

    Keys = NDArray[np.int64]

ROWS: Final = 2_000_000
"""Number of rows, over all steps, that are processed at once."""


@dataclass(frozen=True, slots=True)
class JoinedBindings:
    """Node combinations that match several sequence steps, and the row of each in the table of every step.

    Attributes
    ----------
    variables : tuple of str
    bindings : (J, n) int64
    places : (J, r) int64
        Index of the key in each relation.
    """

    variables: tuple[str, ...]
    bindings: Keys
    places: Ints

    def parts(self, relations: Sequence[TimedRelation]) -> Iterator[JoinedBindings]:
        """Split the node combinations into groups with a limited number of rows (one per matching frame)."""
        if not len(self.bindings):
            return
        rows = np.zeros(len(self.bindings), np.int64)
        for number, one in enumerate(relations):
            rows += np.diff(one.starts)[self.places[:, number]]
        part = np.cumsum(rows) // ROWS
        starts = np.flatnonzero(np.diff(part, prepend=-1))
        for low, high in zip(starts, np.append(starts[1:], len(part)), strict=True):
            yield JoinedBindings(self.variables, self.bindings[low:high], self.places[low:high])


def joined(
    relations: Sequence[tuple[tuple[str, ...], TimedRelation]], apart: Collection[str]
) -> JoinedBindings:
    """Return the node combinations in which all steps match and agree on their common variables.

    Parameters
    ----------
    relations : sequence of (variables, TimedRelation)
    apart : collection of str
        Variables that must differ from each other.
    """
    variables, first = relations[0]
    found = JoinedBindings(variables, first.keys, np.arange(len(first.keys))[:, None])
    for more, other in relations[1:]:
        found = _with(found, more, other, apart)
    return found


def written(key: str) -> str:
    """Return the name of a node as the query writes it, from its internal key such as ``v~2``."""
    return key.partition("~")[0]


def _with(
    found: JoinedBindings,
    variables: tuple[str, ...],
    relation: TimedRelation,
    apart: Collection[str],
) -> JoinedBindings:
    shared = [name for name in variables if name in found.variables]
    new = [name for name in variables if name not in found.variables]
    left = found.bindings[:, [found.variables.index(name) for name in shared]]
    right = relation.keys[:, [variables.index(name) for name in shared]]
    rows, others = _pairs(left, right)
    added = relation.keys[others][:, [variables.index(name) for name in new]]
    bindings = np.concatenate((found.bindings[rows], added), axis=1)
    names = (*found.variables, *new)
    kept = np.ones(len(rows), np.bool_)
    for at, name in enumerate(found.variables):
        for column, other in enumerate(new):
            if name in apart and other in apart and written(name) != written(other):
                kept &= bindings[:, at] != added[:, column]
    places = np.column_stack((found.places[rows], others))
    return JoinedBindings(names, bindings[kept], places[kept])


def _pairs(left: Keys, right: Keys) -> tuple[Ints, Ints]:
    """Return all pairs of equal rows of two tables as two arrays of indices, ordered by the first table."""
    if not len(left) or not len(right):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    codes = codes_of(np.concatenate((left, right)))
    one, other = codes[: len(left)], codes[len(left) :]
    order = np.argsort(other, kind="stable")
    low = np.searchsorted(other[order], one, "left")
    counts = np.searchsorted(other[order], one, "right") - low
    refuse_many(int(counts.sum()), "the steps together hold for too much")
    rows = np.repeat(np.arange(len(left)), counts)
    offset = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    return rows, order[np.repeat(low, counts) + offset]
