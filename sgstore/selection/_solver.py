"""Set covers by HiGHS, a solver of integer programmes (the extra ``[solver]``).

HiGHS finds covers that the greedy choice misses, and proves that there is none cheaper. Without it, the greedy
choice and the bound of prices stand as they are.
"""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from sgstore.selection._sets import SetFamily
    from sgstore.world import Ints


NODES: Final = 2_000
"""Nodes of branch and bound, in all parts together: counted, so that answers are the same everywhere."""

LARGEST: Final = 100_000
"""Most memberships of a part that is given to the solver: of larger ones the first relaxation takes minutes."""

SECONDS: Final = 20.0
"""Time for one part at most: a guard against relaxations that do not end; nodes are used up long before."""

_LOOK_S: Final = 0.1
"""How often to look for signals while it solves; s."""

ROUNDING: Final = 1e-7
"""Share of a cost that is due to rounding."""


class Solver:
    """Improves covers within a number of nodes.

    Parameters
    ----------
    nodes : int
        For all parts together.
    """

    def __init__(self, nodes: int = NODES) -> None:
        self._left = nodes if find_spec("highspy") else 0

    def improved(self, family: SetFamily, cover: Ints) -> tuple[Ints, float]:
        """Return a cover at most as dear as a given one, and a bound from below; 0 if nothing is proven.

        Parameters
        ----------
        family : SetFamily
            Each element is in as many sets as it needs.
        cover : int64
        """
        if self._left <= 0 or len(family.members) > LARGEST:
            return cover, 0.0
        import highspy  # pyright: ignore[reportMissingImports, reportMissingTypeStubs]

        solver = highspy.Highs()
        options = {
            "output_flag": False,
            "threads": 1,
            "mip_rel_gap": 0.0,
            "mip_abs_gap": ROUNDING / 10,
            "mip_max_nodes": self._left,
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
        self._left -= max(int(info.mip_node_count), 1)
        cost = float(family.cost[cover].sum())
        found = np.flatnonzero(np.array(solver.getSolution().col_value) > 0.5)
        covers = bool((family.covered(found) >= family.need).all())
        if covers and family.cost[found].sum() < cost - ROUNDING * max(cost, 1):
            cover, cost = found, float(family.cost[found].sum())
        if solver.getModelStatus() == highspy.HighsModelStatus.kOptimal:
            return cover, cost
        low = float(info.mip_dual_bound)
        low = low - ROUNDING * max(abs(low), 1) if math.isfinite(low) else 0.0
        return cover, math.ceil(low) if family.whole else max(low, 0.0)


def _run(solver: Any) -> None:
    """Solve in a thread, so that whatever a handler of signals raises meanwhile ends it."""
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
