"""Bindings of several steps together: those that agree on the variables that they share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from numpy.typing import NDArray

    from sgstore.history.relations import Relation
    from sgstore.world import Ints

    Keys = NDArray[np.int64]

ROWS = 2_000_000
"""Rows of all steps together that are looked at at once."""


@dataclass(frozen=True, slots=True)
class Joined:
    """Bindings of several relations together.

    Attributes
    ----------
    variables : tuple of str
    bindings : (J, n) int64
    places : (J, r) int64
        For each relation the place of its key.
    """

    variables: tuple[str, ...]
    bindings: Keys
    places: Ints

    def parts(self, relations: Sequence[Relation]) -> Iterator[Joined]:
        """The same in parts of which each has not too many rows."""
        if not len(self.bindings):
            return
        rows = np.zeros(len(self.bindings), np.int64)
        for number, relation in enumerate(relations):
            rows += np.diff(relation.starts)[self.places[:, number]]
        part = np.cumsum(rows) // ROWS
        starts = np.flatnonzero(np.diff(part, prepend=-1))
        for low, high in zip(starts, np.append(starts[1:], len(part)), strict=True):
            yield Joined(self.variables, self.bindings[low:high], self.places[low:high])


def joined(relations: Sequence[tuple[tuple[str, ...], Relation]], apart: Collection[str]) -> Joined:
    """All bindings of some relations, each with its variables, that agree on what these share.

    Parameters
    ----------
    relations : sequence of (variables, Relation)
    apart : collection of str
        Variables of which no two may be the same.
    """
    variables, first = relations[0]
    found = Joined(variables, first.keys, np.arange(len(first.keys))[:, None])
    for more, relation in relations[1:]:
        found = _with(found, more, relation, apart)
    return found


def _with(
    found: Joined, variables: tuple[str, ...], relation: Relation, apart: Collection[str]
) -> Joined:
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
            if name in apart and other in apart:
                kept &= bindings[:, at] != added[:, column]
    places = np.column_stack((found.places[rows], others))
    return Joined(names, bindings[kept], places[kept])


def _pairs(left: Keys, right: Keys) -> tuple[Ints, Ints]:
    """Numbers of the rows of two tables that are equal, ordered by the first."""
    if not len(left) or not len(right):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    both = np.concatenate((left, right))
    if both.shape[1]:
        _, codes = np.unique(both, axis=0, return_inverse=True)
        codes = codes.reshape(-1)
    else:
        codes = np.zeros(len(both), np.int64)
    one, other = codes[: len(left)], codes[len(left) :]
    order = np.argsort(other, kind="stable")
    low = np.searchsorted(other[order], one, "left")
    counts = np.searchsorted(other[order], one, "right") - low
    rows = np.repeat(np.arange(len(left)), counts)
    offset = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    return rows, order[np.repeat(low, counts) + offset]
