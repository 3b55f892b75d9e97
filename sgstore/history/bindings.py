"""Quantifiers: which entities of a trace they are about, and what is true of all, or of some, of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.over_time import Quantifier
    from sgstore.world import Bools, Ints

    Keys = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Level:
    """The bindings up to one quantifier.

    Attributes
    ----------
    word : str
        ``FORALL`` or ``FORSOME``.
    bindings : (B, n) int64
        Of the variables of this quantifier and of those before it.
    parents : (B,) int64
        The binding of the quantifiers before that each goes on from.
    """

    word: str
    bindings: Keys
    parents: Ints


def innermost(levels: Sequence[Level]) -> Keys:
    """(B, n): the bindings of all variables; without quantifiers the one of none."""
    return levels[-1].bindings if levels else np.zeros((1, 0), np.int64)


def levels_of(
    quantifiers: Sequence[Quantifier],
    domains: Mapping[str, Ints],
    *,
    apart: Ints | None,
    counts: Callable[[Quantifier, tuple[str, ...], Keys], Bools],
) -> list[Level]:
    """The bindings of each quantifier, as they go on from one another.

    Parameters
    ----------
    quantifiers : sequence of Quantifier
    domains : mapping of str to (E,) int64
        The entities that each variable may be.
    apart : (A,) int64, optional
        What no variable may be, since different variables are different entities; ``None``: variables may be
        the same.
    counts : function
        Of a quantifier, the variables so far and bindings of these: which of them count.
    """
    variables: tuple[str, ...] = ()
    bindings, levels = np.zeros((1, 0), np.int64), list[Level]()
    for quantifier in quantifiers:
        parents = np.arange(len(bindings))
        for node in quantifier.nodes:
            domain = domains[node]
            if apart is not None:
                domain = domain[~np.isin(domain, apart)]
            rows = np.repeat(np.arange(len(bindings)), len(domain))
            added = np.tile(domain, len(bindings))
            if apart is not None:
                fresh = ~np.any(bindings[rows] == added[:, None], axis=1)
                rows, added = rows[fresh], added[fresh]
            bindings = np.column_stack((bindings[rows], added))
            parents = parents[rows]
            variables = (*variables, node)
        kept = counts(quantifier, variables, bindings)
        bindings, parents = bindings[kept], parents[kept]
        levels.append(Level(quantifier.word, bindings, parents))
    return levels


def folded_values(levels: Sequence[Level], values: Bools) -> list[Bools]:
    """What is true of the bindings of each level, the outermost first, before them all the one of none.

    Parameters
    ----------
    levels : sequence of Level
    values : (B,) bool
        Of the bindings of the last level; without quantifiers (1,).
    """
    found = [values]
    for number in range(len(levels) - 1, -1, -1):
        level = levels[number]
        outer = len(levels[number - 1].bindings) if number else 1
        every = level.word == "FORALL"
        joined = np.full(outer, every)
        (np.logical_and if every else np.logical_or).at(joined, level.parents, found[0])
        found.insert(0, joined)
    return found
