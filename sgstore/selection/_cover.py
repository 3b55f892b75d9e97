"""Set cover: reduction, greedy choice, bounds, and overlapping units.

Reduction leaves out what need not be decided: sets that must be taken, elements and sets that are superfluous;
and it finds parts that have nothing to do with one another.

An element is superfluous if another one is in no other sets than it is: whoever holds that one holds it, too. A
set is superfluous if another one holds all that it holds and costs no more. Each such step may make room for
another, so all are taken again until nothing changes. Of clips that begin anywhere on an axis of time hardly
anything is left then: what comes once is in consecutive clips, and such a cover is decided by these steps
alone (its matrix has consecutive ones).

Source. Garfinkel and Nemhauser, "Integer Programming" (1972), ch. 8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.selection._sets import SetFamily, greedy, met, or_alone, ordered, spread, thinned

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.selection._units import Holdings, Measure, Units
    from sgstore.world import Bools, Floats, Ints


ROUNDING: Final = 1e-7
"""Share of a cost that is due to rounding."""

_COMPARISONS: Final = 100_000_000
"""Steps of comparing, all together: what is found superfluous by then is dropped, the rest stays."""

_BATCH: Final = 2_000_000
"""Pairs that are compared at once."""

_TABLE: Final = 1 << 26
"""Truth values that are kept to look up what is made of what."""


def reduced(family: SetFamily) -> tuple[Ints, list[tuple[SetFamily, Ints]]]:
    """Sets that every answer may be taken to hold; and what is left, in parts, with their sets."""
    need, alive = family.need.copy(), np.ones(len(family), np.bool_)
    forced = np.zeros(len(family), np.bool_)
    wanted = need > 0
    work, size = _COMPARISONS, -1
    if need.max(initial=0) <= 1:  # at first: bundles of a collection have left out as much
        alive &= cheapest_alike(family)
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


def cheapest_alike(family: SetFamily) -> Bools:
    """(S,): of sets that hold the same only the cheapest: enough where each element is needed once."""
    alive = np.ones(len(family), np.bool_)
    _drop_same_sets(family, alive, np.ones(len(family.need), np.bool_))
    return alive & (np.diff(family.starts) > 0)


def _force(family: SetFamily, need: Ints, alive: Bools, forced: Bools) -> None:
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


def _drop_same_elements(family: SetFamily, need: Ints, alive: Bools, wanted: Bools) -> None:
    """Of elements that are in the same sets only the one that needs most counts."""
    rows = alive[family.set_of] & wanted[family.members]
    key = _keys(family.members[rows], family.set_of[rows], len(need), len(family))
    elements = np.flatnonzero(wanted)
    order = elements[np.lexsort((elements, -need[elements], key[1][elements], key[0][elements]))]
    wanted[order[_repeated(key[0][order], key[1][order])]] = False


def _drop_same_sets(family: SetFamily, alive: Bools, wanted: Bools) -> None:
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
    family: SetFamily, need: Ints, alive: Bools, wanted: Bools, most: int
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


def _drop_smaller_sets(family: SetFamily, alive: Bools, wanted: Bools, most: int) -> int:
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
    """Find things that are superfluous because others contain them, or they contain others.

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


def _parts(
    family: SetFamily, need: Ints, alive: Bools, wanted: Bools
) -> list[tuple[SetFamily, Ints]]:
    """Remaining sets, as families that share no element, the one with the first set first."""
    rows = alive[family.set_of] & wanted[family.members]
    sets, members = family.set_of[rows], family.members[rows]
    group = _joined(sets, members, len(family), len(need))[sets]
    order = np.argsort(group, kind="stable")
    ends = np.flatnonzero(np.append(np.diff(group[order]) != 0, True)) + 1 if len(order) else ()
    found: list[tuple[SetFamily, Ints]] = []
    first = 0
    for end in map(int, ends):
        own = order[first:end]
        first = end
        inside, place = np.unique(sets[own], return_inverse=True)
        element, number = np.unique(members[own], return_inverse=True)
        pairs = np.stack([place, number])
        part = SetFamily.of(
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


# Bounds of set covers from below ----------------------------------------------------------------
# A price for each element: if no set costs less than the prices of its elements, no cover costs less than all
# prices together (the dual of the linear programme). Any prices at all give a bound too, if what sets cost less
# than their elements is taken off (Lagrange). Prices are found by steps along subgradients; they also suggest
# covers.
#
# Sources. Held, Wolfe, Crowder, "Validation of subgradient optimization", Mathematical Programming 6 (1974);
# Beasley, "A Lagrangian heuristic for set-covering problems", Naval Research Logistics 37 (1990); Caprara,
# Fischetti, Toth, "A heuristic method for the set covering problem", Operations Research 47 (1999).

ROUNDS: Final = 400
"""Steps along subgradients at most."""

PATIENCE: Final = 20
"""Steps without a better bound after which they become half as long."""

TRIES: Final = 10
"""Every so many steps the prices suggest a cover."""

_MEMBERSHIPS: Final = 200_000_000
"""Memberships that all steps may look at together: fewer steps where there are very many."""


def bounded(family: SetFamily, cover: Ints) -> tuple[float, Ints, Floats]:
    """A bound from below, and a cover at most as dear as a given one.

    Parameters
    ----------
    family : SetFamily
        Each element needs at least one set, and is in as many as it needs.
    cover : int64

    Returns
    -------
    low : float
    cover : int64
    prices : (E,) float64
        Those of the elements that give the bound.
    """
    set_of, need, cost = family.set_of, family.need, family.cost
    often = np.diff(family.starts)
    share = cost / np.maximum(often, 1)
    prices = np.full(len(need), np.inf)
    np.minimum.at(prices, family.members, share[set_of])
    upper = float(cost[cover].sum())
    best, kept, low = cover, prices, -math.inf
    scale, idle = 2.0, 0
    rounds = int(np.clip(_MEMBERSHIPS // max(len(set_of), 1), TRIES, ROUNDS))
    for step in range(rounds):
        left = cost - np.bincount(set_of, prices[family.members], len(cost))
        taken = left < 0
        bound = float((need * prices).sum() + left[taken].sum())
        if bound > low + 1e-9:
            low, kept, idle = bound, prices, 0
        else:
            idle += 1
            if idle == PATIENCE:
                scale, idle, prices = scale / 2, 0, kept
                continue
        if step % TRIES == 0:
            found = _suggested(family, left)
            if cost[found].sum() < upper - ROUNDING:
                best, upper = found, float(cost[found].sum())
        lacking = need - np.bincount(family.members[taken[set_of]], minlength=len(need))
        lacking[(prices == 0) & (lacking < 0)] = 0
        length = float((lacking.astype(np.float64) ** 2).sum())
        if not length or upper - low < ROUNDING or scale < 1e-3:
            break
        prices = np.maximum(prices + scale * (1.02 * upper - bound) / length * lacking, 0.0)
    return max(low, 0.0), best, kept


def _suggested(family: SetFamily, left: Floats) -> Ints:
    """A cover of the sets that cost least beyond the prices of their elements."""
    order = np.lexsort((family.rank, left / np.maximum(np.diff(family.starts), 1)))
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    of_element = np.lexsort((place[family.set_of], family.members))
    starts, _ = family.by_element()
    # Of each element the sets that come first in this order, as many as it needs.
    within = np.arange(len(of_element)) - starts[family.members[of_element]]
    first = within < family.need[family.members[of_element]]
    chosen = np.unique(family.set_of[of_element[first]])
    return thinned(family, chosen[np.argsort(place[chosen])])


# Covers by HiGHS, a solver of integer programmes (the extra [solver]) ----------------------------
# It finds covers that the greedy choice misses, and proves that there is none cheaper. Without it, the greedy
# choice and the bound of prices stand as they are.

NODES: Final = 2_000
"""Nodes of branch and bound, in all parts together: counted, so that answers are the same everywhere."""

LARGEST: Final = 100_000
"""Most memberships of a part that is given to the solver: of larger ones the first relaxation takes minutes."""

SECONDS: Final = 20.0
"""Time for one part at most: a guard against relaxations that do not end; nodes are used up long before."""

_LOOK_S: Final = 0.1
"""How often to look for signals while it solves; s."""


def has_solver() -> bool:
    """Return true if HiGHS is installed."""
    return find_spec("highspy") is not None


def improved(family: SetFamily, cover: Ints, nodes: int) -> tuple[Ints, float, int]:
    """Return a cover at most as dear as a given one, a bound from below, and the nodes that were looked at.

    Parameters
    ----------
    family : SetFamily
        Each element is in as many sets as it needs.
    cover : int64
    nodes : int
        Most nodes of branch and bound. Where nothing is proven the bound is 0.
    """
    if nodes <= 0 or len(family.members) > LARGEST or not has_solver():
        return cover, 0.0, 0
    import highspy  # pyright: ignore[reportMissingImports, reportMissingTypeStubs]

    solver = _silent()
    options = {
        "threads": 1,
        "mip_rel_gap": 0.0,
        "mip_abs_gap": ROUNDING / 10,
        "mip_max_nodes": nodes,
        "time_limit": SECONDS,
    }
    for name, value in options.items():
        solver.setOptionValue(name, value)
    solver.passModel(_programme(family))
    known = highspy.HighsSolution()
    known.col_value = np.isin(np.arange(len(family)), cover).astype(float).tolist()
    solver.setSolution(known)
    _run(solver)
    info = solver.getInfo()
    used = max(int(info.mip_node_count), 1)
    cost = float(family.cost[cover].sum())
    found = np.flatnonzero(np.array(solver.getSolution().col_value) > 0.5)
    covers = bool((family.covered(found) >= family.need).all())
    if covers and family.cost[found].sum() < cost - ROUNDING * max(cost, 1):
        cover, cost = found, float(family.cost[found].sum())
    if solver.getModelStatus() == highspy.HighsModelStatus.kOptimal:
        return cover, cost, used
    low = float(info.mip_dual_bound)
    low = low - ROUNDING * max(abs(low), 1) if math.isfinite(low) else 0.0
    return cover, math.ceil(low) if family.whole else max(low, 0.0), used


def _silent() -> Any:
    """Return a solver that writes nothing: since version 1.15 a new one writes its name to stdout."""
    import highspy  # pyright: ignore[reportMissingImports, reportMissingTypeStubs]

    class Silent(highspy.Highs):
        def enableCallbacks(self) -> None:  # noqa: N802 - its constructor calls this first, and that writes
            self.setOptionValue("output_flag", False)  # noqa: FBT003
            super().enableCallbacks()

    return Silent()


def _run(solver: Any) -> None:
    """Solve in a thread, so that whatever a handler of signals raises meanwhile ends it."""
    # All solvers of a process share one lock; one that was interrupted holds it until it has stopped.
    while not solver.wait(_LOOK_S)[0]:
        pass
    solver.HandleUserInterrupt = True
    solver.startSolve()
    try:
        while not solver.wait(_LOOK_S)[0]:
            pass
    except BaseException:
        solver.cancelSolve()
        raise


def _programme(family: SetFamily) -> Any:
    """Return the integer programme of a cover: 0 or 1 for each set, a row for each element."""
    import highspy  # pyright: ignore[reportMissingImports, reportMissingTypeStubs]

    sets, elements = len(family), len(family.need)
    made = highspy.HighsLp()
    made.num_col_, made.num_row_ = sets, elements
    made.col_cost_ = family.cost
    made.col_lower_, made.col_upper_ = np.zeros(sets), np.ones(sets)
    made.row_lower_ = family.need.astype(np.float64)
    made.row_upper_ = np.full(elements, highspy.kHighsInf)
    made.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    made.a_matrix_.start_ = family.starts.astype(np.int32)
    made.a_matrix_.index_ = family.members.astype(np.int32)
    made.a_matrix_.value_ = np.ones(len(family.members))
    made.integrality_ = [highspy.HighsVarType.kInteger] * sets
    return made


# Set cover: few sets, or cheap ones, that together hold every element as often as is asked ------
# What must be taken is taken, what is superfluous is dropped, what is left falls into parts that have nothing
# to do with one another. Each part is covered greedily and bounded from below; a part whose bound is not met is
# given to HiGHS, if that is installed. So the answer is exact where that is
# cheap, and beside it stands how far from the best it can be at most.
#
# Source. Under a budget: Khuller, Moss, Naor, "The budgeted maximum coverage problem", Information Processing
# Letters 70 (1999).


@dataclass(frozen=True)
class Cover:
    """Sets that were chosen.

    Attributes
    ----------
    chosen : int64
        In the order in which they bring most for what they cost.
    cost : float
        Of all of them.
    bound : float
        No sets that do the same cost less.
    greedy : float
        What the greedy choice would cost, once all that must be taken is taken.
    """

    chosen: Ints
    cost: float
    bound: float
    greedy: float

    @property
    def exact(self) -> bool:
        """True if there is nothing cheaper."""
        return self.cost <= self.bound + ROUNDING * max(self.cost, 1)


def minimal(family: SetFamily, nodes: int = NODES) -> Cover:
    """Return the cheapest sets that hold each element as often as it needs; or cheap ones, and a bound.

    Parameters
    ----------
    family : SetFamily
    nodes : int
        Nodes that the solver may look at, in all parts together; 0: greedy choice and bound alone.
    """
    forced, rest = reduced(family)
    chosen, bound = [forced], float(family.cost[forced].sum())
    plain = bound
    for part, sets in rest:
        own = greedy(part)
        plain += float(part.cost[own].sum())
        low, own, _ = bounded(part, thinned(part, own))
        low = math.ceil(low - ROUNDING) if part.whole else low
        if part.cost[own].sum() > low + ROUNDING:
            own, proven, used = improved(part, own, nodes)
            low, nodes = max(low, proven), nodes - used
        chosen.append(sets[own])
        bound += min(low, float(part.cost[own].sum()))
    all_chosen = np.concatenate(chosen)
    cost = float(family.cost[all_chosen].sum())
    return Cover(ordered(family, all_chosen), cost, min(bound, cost), plain)


@dataclass(frozen=True)
class Fitted:
    """Sets that were chosen under a budget.

    Attributes
    ----------
    chosen : int64
        In order.
    cost : float
    met : int
        How much of all needs they meet: of each element as many sets as it needs at most, times its weight.
    most : float
        No sets within the budget meet more.
    """

    chosen: Ints
    cost: float
    met: int
    most: float


def within(family: SetFamily, budget: float) -> Fitted:
    """Sets within a budget that meet as much as can be: greedy, or the best set alone.

    The bound is that of submodular functions: whatever has been chosen, the best choice meets no more than that
    and the largest gains of single sets that fit the budget together, the last one in part.
    """
    chosen = or_alone(family, greedy(family, budget), budget)
    at = np.unique(np.linspace(0, len(chosen), 16).astype(np.int64)).tolist()
    most = min(_at_most(family, chosen[:many], budget) for many in at)
    reached = met(family, chosen)
    return Fitted(chosen, float(family.cost[chosen].sum()), reached, max(most, reached))


def _at_most(family: SetFamily, chosen: Ints, budget: float) -> float:
    left = family.need - np.minimum(family.covered(chosen), family.need)
    gain = family.gains(left > 0)
    gain[chosen] = 0
    gain[family.cost > budget] = 0
    order = np.argsort(-gain / family.cost, kind="stable")
    cost = np.cumsum(family.cost[order])
    fits = int(np.searchsorted(cost, budget * (1 + 1e-12), side="right"))
    more = float(gain[order[:fits]].sum())
    if fits < len(order):
        room = budget - (float(cost[fits - 1]) if fits else 0.0)
        more += float(gain[order[fits]]) * room / float(family.cost[order[fits]])
    return met(family, chosen) + min(more, float((left * family.weight).sum()))


# Units that overlap, where what they share costs once: few, cheap, or as good as a budget allows ----
# What some clips cost together in frames, seconds or bytes is what their union costs. *Pieces* are the
# stretches between one beginning or end of a unit and the next: each unit is a row of pieces, and pieces do
# not overlap. So a set of pieces is never worse than the units that they are of, and what is known of covers
# by pieces bounds covers by units. Units are chosen greedily, by what they bring for the pieces that no
# chosen one has.


@dataclass(frozen=True)
class UnitPieces:
    """Units as rows of pieces.

    Attributes
    ----------
    begin, end : (U,) int64
        Ascending, both.
    cost : (P,) float64
        Of each piece.
    """

    begin: Ints
    end: Ints
    cost: Floats

    def left(self, one: int, taken: Bools) -> float:
        """Cost of a unit beyond the pieces that are taken."""
        own = slice(int(self.begin[one]), int(self.end[one]))
        return float(self.cost[own][~taken[own]].sum())

    def beside(self, one: int) -> range:
        """The units that share a piece with a unit, and itself."""
        low = int(np.searchsorted(self.end, self.begin[one], side="right"))
        return range(low, int(np.searchsorted(self.begin, self.end[one])))

    def together(self, picked: Ints) -> float:
        """Cost of units together."""
        taken = np.zeros(len(self.cost), np.bool_)
        for one in picked.tolist():
            taken[self.begin[one] : self.end[one]] = True
        return float(self.cost[taken].sum())


def pieces(units: Units, measure: Measure) -> tuple[Units, UnitPieces]:
    """The pieces of units, and the units as rows of them."""
    cuts = np.unique(np.concatenate([units.begin, units.end]))
    parts = replace(units, begin=cuts[:-1], end=cuts[1:])
    cost = parts.summed(units.weights(measure), measure)
    begin, end = np.searchsorted(cuts, units.begin), np.searchsorted(cuts, units.end)
    return parts, UnitPieces(begin.astype(np.int64), end.astype(np.int64), cost)


def cheapest(units: Units, held: Holdings, measure: Measure, rank: Ints) -> Cover:
    """Units that hold everything, and whose union costs little: the greedy choice, or the fewest units.

    The bound is that of the pieces, chosen one by one.
    """
    parts, spans = pieces(units, measure)
    family = held.family(units, units.costs(measure), 1, rank)
    own = _thinned(family, spans, _greedy(family, spans))
    cost = greedy = spans.together(own)
    few = minimal(replace(family, cost=np.ones(len(units)))).chosen
    if spans.together(few) < cost:
        own, cost = few, spans.together(few)
    alone = held.over(parts).family(parts, spans.cost, 1, np.arange(len(parts)))
    return Cover(ordered(family, own), cost, min(minimal(alone).bound, cost), greedy)


def affordable(units: Units, held: Holdings, measure: Measure, rank: Ints, budget: float) -> Fitted:
    """Units whose union is within a budget, and that hold as much as can be: greedy, or the best one alone.

    The bound is that of the pieces, chosen one by one.
    """
    parts, spans = pieces(units, measure)
    family = held.family(units, units.costs(measure), 1, rank)
    chosen = or_alone(family, _greedy(family, spans, budget), budget)
    alone = held.over(parts).family(parts, spans.cost, 1, np.arange(len(parts)))
    reached = met(family, chosen)
    most = max(within(alone, budget).most, reached)
    return Fitted(chosen, spans.together(chosen), reached, most)


def _greedy(family: SetFamily, spans: UnitPieces, budget: float = math.inf) -> Ints:
    """Units, one after another, each the one that brings most for what it costs beyond those before it."""
    taken = np.zeros(len(spans.cost), np.bool_)

    def cheapened(one: int) -> Iterator[tuple[int, float]]:
        """Prices of units that share pieces with one that is taken."""
        taken[spans.begin[one] : spans.end[one]] = True
        for other in spans.beside(one):
            yield other, max(spans.left(other, taken), 1e-9)

    return greedy(family, budget, cheapened)


def _thinned(family: SetFamily, spans: UnitPieces, chosen: Ints) -> Ints:
    """Without the units that the others make superfluous, those first that cost most beyond the others."""
    times = np.zeros(len(spans.cost) + 1, np.int64)
    np.add.at(times, spans.begin[chosen], 1)
    np.add.at(times, spans.end[chosen], -1)
    shared = np.cumsum(times)[:-1] > 1
    saved = np.array([spans.left(one, shared) for one in chosen.tolist()])
    return thinned(family, chosen, np.argsort(-saved, kind="stable"))
