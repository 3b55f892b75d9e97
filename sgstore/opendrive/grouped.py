"""Columns in groups: what many records along many roads have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sgstore.opendrive.document import Document
    from sgstore.world import Floats, Ints


def starts_of(counts: Ints) -> Ints:
    """(n + 1,) int64: where groups of these sizes start when they follow one another, and the end."""
    return np.concatenate((np.zeros(1, np.int64), np.cumsum(counts, dtype=np.int64)))


def ragged(counts: Ints) -> tuple[Ints, Ints]:
    """Groups of these sizes spelled out: the group of each row, and the row's number in its group.

    >>> ragged(np.array([2, 0, 3]))
    (array([0, 0, 2, 2, 2]), array([0, 1, 0, 1, 2]))
    """
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - starts_of(counts)[group]


def last_before(group: Ints, at: Floats, asked_group: Ints, asked_at: Floats) -> Ints:
    """The record that holds at each place: the last of its group that starts at or before it.

    Parameters
    ----------
    group, at : (n,)
        Group and start of each record, in any order; of records that start together the later holds.
    asked_group, asked_at : (m,)
        Places.

    Returns
    -------
    (m,) int64
        Rows of the records. Before the first record of a group the first holds; -1: the group is empty.
    """
    n, m = len(group), len(asked_group)
    if n == 0:
        return np.full(m, -1, np.int64)
    order = np.lexsort((at, group))
    groups, starts = group[order], at[order]
    # One sort of records and places together: a place comes after the records that start with it.
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
    """Values of cubics ``(..., 4)``, constant first, at ``at``."""
    c = coefficients
    return c[..., 0] + at * (c[..., 1] + at * (c[..., 2] + at * c[..., 3]))


def cubic_slope(coefficients: Floats, at: Floats) -> Floats:
    """First derivatives of cubics ``(..., 4)`` at ``at``."""
    c = coefficients
    return c[..., 1] + at * (2 * c[..., 2] + at * 3 * c[..., 3])


def cubic_bend(coefficients: Floats, at: Floats) -> Floats:
    """Second derivatives of cubics ``(..., 4)`` at ``at``."""
    c = coefficients
    return 2 * c[..., 2] + at * 6 * c[..., 3]


def coefficients_of(document: Document, kind: str) -> Floats:
    """(n, 4): ``a``, ``b``, ``c``, ``d`` of all elements of a kind; those that are absent are 0."""
    return np.stack([document.numbers(kind, letter, 0.0) for letter in "abcd"], axis=1)
