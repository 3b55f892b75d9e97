"""Where something holds in one trace: bindings, and for each the frames; looked up many at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.temporal.measures import Column

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from sgstore.world import Bools, Ints

    Keys = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Relation:
    """Bindings and frames.

    Attributes
    ----------
    keys : (K, n) int64
        The bindings, each once, in ascending order.
    starts : (K + 1,) int64
        Where the frames of each begin.
    frames : (R,) int64
        Numbers of frames, ascending for each binding.
    values : tuple of (R,) arrays
        What was asked of each match; masked where it is unknown.
    """

    keys: Keys
    starts: Ints
    frames: Ints
    values: tuple[Any, ...] = ()

    @classmethod
    def of(cls, frames: Ints, keys: Keys, values: Sequence[Any] = ()) -> Relation:
        """From rows in any order; of rows with the same binding and frame one is kept.

        Parameters
        ----------
        frames : (R,) int64
        keys : (R, n) int64
        values : sequence of (R,) arrays
        """
        order = np.lexsort((frames, *keys.T[::-1]))
        frames, keys = frames[order], keys[order]
        new = np.ones(len(frames), np.bool_)
        new[1:] = np.any(keys[1:] != keys[:-1], axis=1)
        fresh = new.copy()
        fresh[1:] |= frames[1:] != frames[:-1]
        if not fresh.all():
            order, frames, keys, new = order[fresh], frames[fresh], keys[fresh], new[fresh]
        first = np.flatnonzero(new)
        starts = np.append(first, len(frames))
        return cls(keys[first], starts, frames, tuple(value[order] for value in values))

    def find(self, wanted: Keys) -> Ints:
        """(B,) the place of each of some bindings (B, n) among the keys; -1: it is not there."""
        if not len(self.keys) or not len(wanted):
            return np.full(len(wanted), -1)
        if not wanted.shape[1]:
            return np.zeros(len(wanted), np.int64)
        both = np.concatenate((self.keys, wanted))
        _, codes = np.unique(both, axis=0, return_inverse=True)
        codes = codes.reshape(-1)
        place = np.full(int(codes.max()) + 1, -1)
        place[codes[: len(self.keys)]] = np.arange(len(self.keys))
        return place[codes[len(self.keys) :]]

    def rows_of(self, places: Ints) -> tuple[Ints, Ints]:
        """The rows of some keys: for each, which of the places it belongs to, and its number here."""
        known = np.flatnonzero(places >= 0)
        first, end = self.starts[places[known]], self.starts[places[known] + 1]
        counts = end - first
        owner = np.repeat(known, counts)
        offset = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
        return owner, np.repeat(first, counts) + offset

    def flags(self, places: Ints, length: int) -> Bools:
        """(B, length) in which frames each of some keys holds; -1 holds in none."""
        found = np.zeros((len(places), length), np.bool_)
        owner, rows = self.rows_of(places)
        found[owner, self.frames[rows]] = True
        return found

    def column(self, places: Ints, length: int, number: int = 0) -> Column:
        """A value in each frame for some keys."""
        told = self.values[number]
        plain = np.ma.getdata(told)
        kind = np.float64 if plain.dtype.kind in "iuf" else plain.dtype
        values = np.zeros((len(places), length), kind)
        if plain.dtype.kind == "O":
            values[:] = ""
        known = np.zeros((len(places), length), np.bool_)
        owner, rows = self.rows_of(places)
        at = owner, self.frames[rows]
        values[at] = plain[rows]
        known[at] = ~np.ma.getmaskarray(told)[rows]
        if kind is np.float64:
            known &= ~np.isnan(values)
        return Column(values, known)
