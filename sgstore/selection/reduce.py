"""What a set cover need not decide: sets that must be taken, elements and sets that are superfluous; and parts.

An element is superfluous if another one is in no other sets than it is: whoever holds that one holds it, too. A
set is superfluous if another one holds all that it holds and costs no more. Each such step may make room for
another, so all are taken again until nothing changes. Of clips that begin anywhere on an axis of time hardly
anything is left then: what comes once is in consecutive clips, and such a cover is decided by these steps
alone (its matrix has consecutive ones).

Source. Garfinkel and Nemhauser, "Integer Programming" (1972), ch. 8.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.selection.family import Family, spread

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.world import Bools, Ints

_WORK: Final = 100_000_000
"""Steps of comparing, all together: what is found superfluous by then is dropped, the rest stays."""

_BATCH: Final = 2_000_000
"""Pairs that are compared at once."""

_TABLE: Final = 1 << 26
"""Truth values that are kept to look up what is made of what."""


def reduced(family: Family) -> tuple[Ints, list[tuple[Family, Ints]]]:
    """Sets that every answer may be taken to hold; and what is left, in parts, with their sets."""
    need, alive = family.need.copy(), np.ones(len(family), np.bool_)
    forced = np.zeros(len(family), np.bool_)
    wanted = need > 0
    work, size = _WORK, -1
    while size != (size := int(alive.sum()) + int(wanted.sum())):
        _force(family, need, alive, forced)
        wanted &= need > 0
        _drop_same_elements(family, need, alive, wanted)
        work -= _drop_larger_elements(family, need, alive, wanted, work)
        if need[wanted].max(initial=0) == 1:
            _drop_same_sets(family, alive, wanted)
            work -= _drop_smaller_sets(family, alive, wanted, work)
        alive &= np.bincount(family.set_of[wanted[family.members]], minlength=len(family)) > 0
    return np.flatnonzero(forced), _parts(family, need, alive, wanted)


def _force(family: Family, need: Ints, alive: Bools, forced: Bools) -> None:
    """Take all sets of elements that are in no more sets than they need."""
    while True:
        rows = alive[family.set_of]
        often = np.bincount(family.members[rows], minlength=len(need))
        tight = (need > 0) & (often <= need)
        taken = np.zeros(len(family), np.bool_)
        taken[family.set_of[rows & tight[family.members]]] = True
        if not taken.any():
            return
        forced[taken], alive[taken] = True, False
        need -= np.bincount(family.members[taken[family.set_of]], minlength=len(need))
        np.maximum(need, 0, out=need)


def _drop_same_elements(family: Family, need: Ints, alive: Bools, wanted: Bools) -> None:
    """Of elements that are in the same sets only the one that needs most counts."""
    rows = alive[family.set_of] & wanted[family.members]
    key = _keys(family.members[rows], family.set_of[rows], len(need), len(family))
    elements = np.flatnonzero(wanted)
    order = elements[np.lexsort((elements, -need[elements], key[1][elements], key[0][elements]))]
    wanted[order[_repeated(key[0][order], key[1][order])]] = False


def _drop_same_sets(family: Family, alive: Bools, wanted: Bools) -> None:
    """Of sets that hold the same only the cheapest counts."""
    rows = alive[family.set_of] & wanted[family.members]
    key = _keys(family.set_of[rows], family.members[rows], len(family), len(wanted))
    sets = np.flatnonzero(alive)
    order = sets[np.lexsort((family.rank[sets], family.cost[sets], key[1][sets], key[0][sets]))]
    alive[order[_repeated(key[0][order], key[1][order])]] = False


def _keys(of: Ints, what: Ints, size: int, things: int) -> tuple[Ints, Ints]:
    """Two numbers for each set of things, 106 bits together: equal where the sets are."""
    words = np.random.Generator(np.random.PCG64(20_24)).integers(1 << 31, size=(2, 2, things))
    found: list[Ints] = []
    for low, high in words:
        # Sums of numbers below 2³¹ are exact in floating point, if there are below 2²² of them.
        first = np.bincount(of, low[what], size).astype(np.int64)
        second = np.bincount(of, high[what], size).astype(np.int64)
        found.append(first * (1 << 31) ^ second)
    return found[0], found[1]


def _repeated(*keys: Ints) -> Bools:
    same = np.zeros(len(keys[0]), np.bool_)
    same[1:] = np.logical_and.reduce([key[1:] == key[:-1] for key in keys])
    return same


def _drop_larger_elements(
    family: Family, need: Ints, alive: Bools, wanted: Bools, most: int
) -> int:
    """Drop elements that are in all sets that another one is in. Returns how many steps that took."""
    rows = alive[family.set_of] & wanted[family.members]

    def superfluous(small: Ints, large: Ints) -> Ints:
        return large[need[large] <= need[small]]

    gone, work = _contained(
        family.members[rows], family.set_of[rows], len(need), len(family), superfluous, most
    )
    wanted[gone] = False
    return work


def _drop_smaller_sets(family: Family, alive: Bools, wanted: Bools, most: int) -> int:
    """Drop sets that another one holds for no more. Returns how many steps that took."""
    rows = alive[family.set_of] & wanted[family.members]

    def superfluous(small: Ints, large: Ints) -> Ints:
        return small[family.cost[large] <= family.cost[small]]

    gone, work = _contained(
        family.set_of[rows], family.members[rows], len(family), len(wanted), superfluous, most
    )
    alive[gone] = False
    return work


def _contained(
    one: Ints,
    other: Ints,
    ones: int,
    others: int,
    superfluous: Callable[[Ints, Ints], Ints],
    most: int,
) -> tuple[Bools, int]:
    """Which things are superfluous by what is contained in what.

    Parameters
    ----------
    one, other : (M,) int64
        Things, and what each is made of; no two of the same.
    ones, others : int
        How many of each there may be.
    superfluous : callable
        Things that are contained in others, and these → those of them that are superfluous.
    most : int
        Steps of comparing.

    Returns
    -------
    gone : (ones,) bool
    work : int
        Steps that it took.
    """
    gone, done = np.zeros(ones, np.bool_), np.zeros(ones, np.bool_)
    # What is rare tells things apart: it is looked at first.
    common = np.bincount(other, minlength=others)
    rare = np.empty(others, np.int64)
    rare[np.argsort(common, kind="stable")] = np.arange(others)
    other = rare[other]
    work, batch = 0, _BATCH // 16
    while work < most:
        rows = ~gone[one]
        key = np.sort(one[rows] * others + other[rows])
        one, other = np.divmod(key, others)
        things, pairs = _compared(one, other, (ones, others), done, batch)
        if not len(things):
            break
        done[things] = True
        small, large, used = _holding(key, (ones, others), pairs, most - work)
        work += used
        gone[superfluous(small, large)] = True
        batch = _BATCH
    return gone, work


def _compared(
    one: Ints, other: Ints, sizes: tuple[int, int], done: Bools, batch: int
) -> tuple[Ints, tuple[Ints, Ints]]:
    """Some things that are not done, the smallest first; each with all that may contain it.

    What contains a thing has all that it is made of: also the first of that, which hardly any others have.
    """
    many = np.bincount(one, minlength=sizes[0])
    common = np.bincount(other, minlength=sizes[1])
    first = np.flatnonzero(np.append(True, np.diff(one) != 0)) if len(one) else one
    first = first[~done[one[first]]]
    first = first[np.argsort(many[one[first]], kind="stable")]
    fits = max(int(np.searchsorted(np.cumsum(common[other[first]]), batch)), 1)
    first = first[:fits]
    by_other = np.argsort(other, kind="stable")
    starts = np.searchsorted(other[by_other], np.arange(sizes[1] + 1))
    begin = starts[other[first]]
    which, place = spread(begin, begin + common[other[first]])
    small, large = one[first][which], one[by_other[place]]
    kept = (many[large] >= many[small]) & (large != small)
    return one[first], (small[kept], large[kept])


def _holding(
    key: Ints, sizes: tuple[int, int], pairs: tuple[Ints, Ints], most: int
) -> tuple[Ints, Ints, int]:
    """Those pairs whose second thing has all that the first one is made of; and how many steps that took.

    Pairs share the first of it already. What was not found out within so many steps is not among them.
    """
    small, large = pairs
    starts = np.searchsorted(key, np.arange(sizes[0] + 1) * sizes[1])
    # Looked up in a table as long as there is room for one.
    table = np.zeros(sizes[0] * sizes[1] if sizes[0] * sizes[1] <= _TABLE else 0, np.bool_)
    if len(table):
        table[key] = True
    held: list[tuple[Ints, Ints]] = [(small[:0], large[:0])]
    place, work = 1, len(small)
    while len(small) and work < most:
        ended = starts[small] + place >= starts[small + 1]
        held.append((small[ended], large[ended]))
        small, large = small[~ended], large[~ended]
        wanted = large * sizes[1] + key[starts[small] + place] % sizes[1]
        if len(table):
            kept = table[wanted]
        else:
            kept = key[np.minimum(np.searchsorted(key, wanted), len(key) - 1)] == wanted
        work += len(small)
        small, large = small[kept], large[kept]
        place += 1
    found = np.concatenate([np.stack(some) for some in held], axis=1)
    return found[0], found[1], work


def _parts(family: Family, need: Ints, alive: Bools, wanted: Bools) -> list[tuple[Family, Ints]]:
    """What is left, as families that share no element, the one with the first set first."""
    rows = alive[family.set_of] & wanted[family.members]
    sets, members = family.set_of[rows], family.members[rows]
    group = _joined(sets, members, len(family), len(need))[sets]
    order = np.argsort(group, kind="stable")
    ends = np.flatnonzero(np.append(np.diff(group[order]) != 0, True)) + 1 if len(order) else ()
    found: list[tuple[Family, Ints]] = []
    first = 0
    for end in map(int, ends):
        own = order[first:end]
        first = end
        inside, place = np.unique(sets[own], return_inverse=True)
        element, number = np.unique(members[own], return_inverse=True)
        pairs = np.stack([place, number])
        part = Family.of(
            pairs, len(inside), len(element), family.cost[inside], 1, family.rank[inside]
        )
        found.append((replace(part, need=need[element]), inside))
    return found


def _joined(sets: Ints, members: Ints, many: int, elements: int) -> Ints:
    """(many,): of each set the first one that it has to do with, by elements that they share, and so on."""
    first = np.arange(many)
    while True:
        # Of each element the first set that is known; what is first of its sets learns of it, and all of these.
        least = np.full(elements, many)
        np.minimum.at(least, members, first[sets])
        found = first.copy()
        np.minimum.at(found, first[sets], least[members])
        while (found[found] != found).any():
            found = found[found]
        if (found == first).all():
            return first
        first = found
