"""Lower bounds for the cost of set covers, and cheaper covers by the integer solver HiGHS (optional)."""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.testsets.selection._sets import SetFamily, thinned

if TYPE_CHECKING:
    from sgstore.model.world import Floats, Ints

ROUNDING: Final = 1e-7
"""Tolerance for rounding errors, as a share of a cost."""


# Each element gets a price. If no set costs less than the prices of its elements, no cover costs
# less than the sum of all prices (the dual of the linear programme). Arbitrary prices also give a
# bound, after a correction for sets cheaper than their elements (Lagrange). Subgradient steps find
# the prices; they also suggest covers. Sources: Held, Wolfe, Crowder, "Validation of subgradient
# optimization", Mathematical Programming 6 (1974); Beasley, "A Lagrangian heuristic for
# set-covering problems", Naval Research Logistics 37 (1990); Caprara, Fischetti, Toth, "A heuristic
# method for the set covering problem", Operations Research 47 (1999).

ROUNDS: Final = 400
"""Largest number of steps of the subgradient method."""

PATIENCE: Final = 20
"""Number of steps without a better bound, after which the step length is halved."""

TRIES: Final = 10
"""Number of steps between two attempts to make a cover from the current prices."""

_MEMBERSHIPS: Final = 200_000_000
"""Largest number of memberships that all steps process together. Very large problems get fewer steps."""


def bounded(family: SetFamily, cover: Ints) -> tuple[float, Ints, Floats]:
    """Return a lower bound for the cost of any set cover, a cheap cover, and element prices as a proof.

    Parameters
    ----------
    family : SetFamily
        Each element needs at least one set, and has enough sets.
    cover : int64

    Returns
    -------
    low : float
    cover : int64
    prices : (E,) float64
        Prices of the elements that give the bound.
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
    """Return a set cover. Sets with a low cost, compared with the prices of their elements, are preferred."""
    order = np.lexsort((family.rank, left / np.maximum(np.diff(family.starts), 1)))
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    of_element = np.lexsort((place[family.set_of], family.members))
    starts, _ = family.by_element()
    # For each element the first sets in this order, as many as it needs.
    within = np.arange(len(of_element)) - starts[family.members[of_element]]
    first = within < family.need[family.members[of_element]]
    chosen = np.unique(family.set_of[of_element[first]])
    return thinned(family, chosen[np.argsort(place[chosen])])


# The solver finds covers that the greedy choice misses, and proves optimality. Without it, the
# greedy choice and the price bound remain.

NODES: Final = 2_000
"""Largest number of branch-and-bound nodes for all parts. A count gives equal results on every machine."""

LARGEST: Final = 100_000
"""Largest number of memberships in a part for the solver. Larger parts would take minutes."""

SECONDS: Final = 20.0
"""Time limit of the solver for one part; s. Usually, the limit of nodes is reached earlier."""

_LOOK_S: Final = 0.1
"""Interval at which signals are checked while the solver runs; s."""


def has_solver() -> bool:
    """True if the integer solver HiGHS is installed."""
    return find_spec("highspy") is not None


def improved(family: SetFamily, cover: Ints, nodes: int) -> tuple[Ints, float, int]:
    """Improve a set cover by the integer solver. Return it, a lower bound for the cost, and the steps.

    Parameters
    ----------
    family : SetFamily
        Each element has enough sets.
    cover : int64
    nodes : int
        Greatest number of branch-and-bound nodes. Without a proof the bound is 0.
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
    """Return an integer solver that prints no text."""
    import highspy  # pyright: ignore[reportMissingImports, reportMissingTypeStubs]

    class Silent(highspy.Highs):
        def enableCallbacks(self) -> None:  # noqa: N802 - its constructor calls this first, and that writes
            self.setOptionValue("output_flag", False)  # noqa: FBT003
            super().enableCallbacks()

    return Silent()


def _run(solver: Any) -> None:
    """Run an integer solver in a thread. An exception of a signal handler stops it."""
    # All solvers of a process share one lock; an interrupted solver holds it until it stops.
    _wait(solver)
    solver.HandleUserInterrupt = True
    solver.startSolve()
    try:
        _wait(solver)
    except BaseException:
        solver.cancelSolve()
        _wait(solver)  # a process that ends while the thread runs is aborted
        raise


def _wait(solver: Any) -> None:
    """Wait until an integer solver has ended. A signal handler can raise an exception during the wait."""
    while not solver.wait(_LOOK_S)[0]:
        pass


def _programme(family: SetFamily) -> Any:
    """Express set cover as an integer programme: a 0/1 variable per set, a constraint per element."""
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
