"""Sets of elements, as columns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sgstore.world import Bools, Floats, Ints


def distinct(values: Ints) -> Ints:
    """Values, ascending, each once; quick where they are nearly so."""
    if (np.diff(values) <= 0).any():
        values = np.sort(values, kind="stable")
        values = values[np.append(True, np.diff(values) != 0)]
    return values


def spread(begin: Ints, end: Ints) -> tuple[Ints, Ints]:
    """Ranges, and all whole numbers in each of them."""
    many = end - begin
    unit = np.repeat(np.arange(len(many)), many)
    return unit, np.arange(len(unit)) + np.repeat(begin - (np.cumsum(many) - many), many)


@dataclass(frozen=True)
class Family:
    """Sets of elements.

    Attributes
    ----------
    starts : (S + 1,) int64
        Where the elements of each set begin in ``members``.
    members : (M,) int64
        Elements, 0 … E - 1, each once in a set.
    cost : (S,) float64
        Above zero.
    need : (E,) int64
        In how many sets of the answer each element must be; of one that is in fewer sets, in all of these.
    rank : (S,) int64
        Of sets that are equally good the one of the lowest rank is taken.
    weight : (E,) int64
        How much an element counts where not all can be had.
    """

    starts: Ints
    members: Ints
    cost: Floats
    need: Ints
    rank: Ints
    weight: Ints

    @classmethod
    def of(
        cls,
        pairs: Ints,
        sets: int,
        elements: int,
        cost: Floats | None = None,
        need: int = 1,
        rank: Ints | None = None,
    ) -> Family:
        """A family of pairs (2, M) of a set and an element, in any order; a pair may come twice."""
        key = distinct(pairs[0].astype(np.int64) * max(elements, 1) + pairs[1])
        of_set, members = np.divmod(key, max(elements, 1))
        starts = np.searchsorted(of_set, np.arange(sets + 1))
        often = np.bincount(members, minlength=elements)
        return cls(
            starts.astype(np.int64),
            members,
            np.ones(sets) if cost is None else cost,
            np.minimum(often, need).astype(np.int64),
            np.arange(sets) if rank is None else rank,
            np.ones(elements, np.int64),
        )

    def __len__(self) -> int:
        return len(self.cost)

    @property
    def set_of(self) -> Ints:
        """(M,): the set of each of ``members``."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))

    def elements(self, one: int) -> Ints:
        """The elements of a set."""
        return self.members[self.starts[one] : self.starts[one + 1]]

    def by_element(self) -> tuple[Ints, Ints]:
        """Where the sets of each element begin, and these sets."""
        order = np.argsort(self.members, kind="stable")
        starts = np.searchsorted(self.members[order], np.arange(len(self.need) + 1))
        return starts, self.set_of[order]

    def gains(self, open_: Bools) -> Floats:
        """(S,): the weight of those elements of each set that are open."""
        rows = open_[self.members]
        weight = self.weight[self.members[rows]].astype(np.float64)
        return np.bincount(self.set_of[rows], weight, len(self)).astype(np.float64)

    def covered(self, chosen: Ints) -> Ints:
        """(E,): how many of some sets hold each element."""
        taken = np.zeros(len(self), np.bool_)
        taken[chosen] = True
        return np.bincount(self.members[taken[self.set_of]], minlength=len(self.need))

    def part(self, sets: Ints, wanted: Bools, need: Ints) -> Family:
        """Only some sets, and of them only the elements that are wanted; these are numbered anew."""
        kept = np.zeros(len(self), np.bool_)
        kept[sets] = True
        rows = kept[self.set_of] & wanted[self.members]
        number = np.cumsum(wanted) - 1
        place = np.full(len(self), -1)
        place[sets] = np.arange(len(sets))
        pairs = np.stack([place[self.set_of[rows]], number[self.members[rows]]])
        found = Family.of(
            pairs, len(sets), int(wanted.sum()), self.cost[sets], rank=self.rank[sets]
        )
        return replace(found, need=need[wanted])
