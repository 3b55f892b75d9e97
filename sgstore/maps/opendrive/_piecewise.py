"""Arrays divided into groups, and cubic polynomials that apply to parts of a road."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.base.tables import spread

if TYPE_CHECKING:
    from sgstore.model.world import Floats, Ints


def starts_of(counts: Ints) -> Ints:
    """Return the index at which each of the consecutive groups starts, and the end, (n + 1,)."""
    return np.concatenate((np.zeros(1, np.int64), np.cumsum(counts, dtype=np.int64)))


def ragged(counts: Ints) -> tuple[Ints, Ints]:
    """For consecutive groups of the given sizes, return each row's group, and its index in the group.

    >>> ragged(np.array([2, 0, 3]))
    (array([0, 0, 2, 2, 2]), array([0, 1, 0, 1, 2]))
    """
    return spread(np.zeros_like(counts), counts)


def last_before(group: Ints, at: Floats, asked_group: Ints, asked_at: Floats) -> Ints:
    """For each position on a road, find the last record of the road that starts at or before it.

    Parameters
    ----------
    group, at : (n,)
        Group and start of each record, in any order; of records with the same start the later one
        counts.
    asked_group, asked_at : (m,)
        Places.

    Returns
    -------
    (m,) int64
        Rows of the records. Before the first record of a group the first one counts; -1 for an
        empty group.
    """
    n, m = len(group), len(asked_group)
    if n == 0:
        return np.full(m, -1, np.int64)
    order = np.lexsort((at, group))
    groups, starts = group[order], at[order]
    # One sort of records and places together: a place follows the records with the same start.
    both_group = np.concatenate((groups, asked_group))
    both_at = np.concatenate((starts, asked_at))
    is_place = np.arange(n + m) >= n
    merged = np.lexsort((is_place, both_at, both_group))
    seen = np.cumsum(~is_place[merged]) - 1
    found = np.empty(m, np.int64)
    places = merged[is_place[merged]] - n
    found[places] = seen[is_place[merged]]
    first = np.searchsorted(groups, asked_group, side="left")
    found = np.maximum(found, first)
    exists = (first < n) & (groups[np.minimum(first, n - 1)] == asked_group)
    return np.where(exists, order[np.minimum(found, n - 1)], -1)


def cubic(coefficients: Floats, at: Floats) -> Floats:
    """Evaluate cubic polynomials with coefficients ``(..., 4)``, constant first."""
    c = coefficients
    return c[..., 0] + at * (c[..., 1] + at * (c[..., 2] + at * c[..., 3]))


def cubic_slope(coefficients: Floats, at: Floats) -> Floats:
    """Return the first derivatives of cubic polynomials ``(..., 4)`` at given positions."""
    c = coefficients
    return c[..., 1] + at * (2 * c[..., 2] + at * 3 * c[..., 3])


def cubic_bend(coefficients: Floats, at: Floats) -> Floats:
    """Return the second derivatives of cubic polynomials ``(..., 4)`` at given positions."""
    c = coefficients
    return 2 * c[..., 2] + at * 6 * c[..., 3]
