"""Quantifiers of a check (``FORALL``, ``FORSOME``): combinations of entities, and combined values."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.temporal._offline import refuse_many

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.ir import BoundCheck, BoundQuantifier
    from sgstore.model.world import Bools, Floats, Ints

    Codes = NDArray[np.int8]
    Keys = NDArray[np.int64]
    Statuses = NDArray[np.int8]
    Array = NDArray[Any]

VIOLATED, UNKNOWN, PENDING, HOLDS = range(4)
"""Verdict codes in order. The minimum is the code of a conjunction, the maximum of a disjunction."""

NEWCOMER: Final = -(1 << 60)
"""First id of the placeholders for entities that may appear later."""


@dataclass(frozen=True, slots=True)
class Level:
    """Combinations of entities for one quantifier: its variables, and those of the quantifiers outside it.

    Attributes
    ----------
    word : str
        ``FORALL`` or ``FORSOME``.
    bindings : (B, n) int64
        Bindings of the variables of this quantifier and of those before it.
    parents : (B,) int64
        Index of the outer binding that each binding extends.
    """

    word: str
    bindings: Keys
    parents: Ints


def innermost(levels: Sequence[Level]) -> Keys:
    """Return all combinations of entities for the variables of a check: one per row, (B, n).

    Without quantifiers, B is 1 and n is 0.
    """
    return levels[-1].bindings if levels else np.zeros((1, 0), np.int64)


def levels_of(
    quantifiers: Sequence[BoundQuantifier],
    domains: Mapping[str, Ints],
    *,
    apart: Ints | None,
    counts: Callable[[BoundQuantifier, tuple[str, ...], Keys], Bools],
) -> list[Level]:
    """Return, for each quantifier of a check, its combinations of entities.

    Each level extends the combinations of the level before.

    Parameters
    ----------
    quantifiers : sequence of BoundQuantifier
    domains : mapping of str to (E,) int64
        Variable → its possible entities.
    apart : (A,) int64, optional
        Entities that no variable may be, because different variables are different entities. ``None`` means
        that variables may be equal.
    counts : function
        Function from a quantifier, the variables so far and their bindings to a mask of the valid bindings.

    Raises
    ------
    QueryError
        The check has too many bindings.
    """
    variables: tuple[str, ...] = ()
    bindings, levels = np.zeros((1, 0), np.int64), list[Level]()
    for quantifier in quantifiers:
        parents = np.arange(len(bindings))
        for node in quantifier.nodes:
            domain = domains[node]
            if apart is not None:
                domain = domain[~np.isin(domain, apart)]
            named = f"{quantifier.word} {', '.join((*variables, node))} is about too much"
            refuse_many(len(bindings) * len(domain), named)
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


def levels_among(
    quantifiers: Sequence[BoundQuantifier],
    bindings: Keys,
    *,
    counts: Callable[[BoundQuantifier, tuple[str, ...], Keys], Bools],
) -> list[Level]:
    """Return, for each quantifier, its part of the given combinations of entities.

    Parameters
    ----------
    quantifiers : sequence of BoundQuantifier
    bindings : (B, n) int64
        Ascending.
    counts : function
        See :func:`levels_of`.
    """
    variables: tuple[str, ...] = ()
    for quantifier in quantifiers:
        variables = (*variables, *quantifier.nodes)
        head, members = np.unique(bindings[:, : len(variables)], axis=0, return_inverse=True)
        bindings = bindings[counts(quantifier, variables, head)[members.reshape(-1)]]
    levels = list[Level]()
    many = 0
    outer = np.zeros(len(bindings), np.int64)
    for quantifier in quantifiers:
        many += len(quantifier.nodes)
        head, first, members = np.unique(
            bindings[:, :many], axis=0, return_index=True, return_inverse=True
        )
        levels.append(Level(quantifier.word, head, outer[first]))
        outer = members.reshape(-1)
    return levels


def newcomers(check: BoundCheck, domains: Mapping[str, Ints]) -> dict[str, Ints]:
    """Return the entities of each variable. A ``FORSOME`` variable gets one more for entities yet to come."""
    some = [node for q in check.quantifiers if q.word == "FORSOME" for node in q.nodes]
    return {
        node: np.append(domain, NEWCOMER + some.index(node)) if node in some else domain
        for node, domain in domains.items()
    }


def waits_for_newcomers(
    check: BoundCheck, levels: Sequence[Level], wider: Sequence[Level], codes: Codes
) -> bool:
    """True if a false check can still become true: a ``FORSOME`` may find an entity that appears later.

    Parameters
    ----------
    check : BoundCheck
    levels : sequence of Level
        Current bindings of the check.
    wider : sequence of Level
        Current bindings plus newcomers, and plus entities for which ``WHERE`` was not yet true.
    codes : (B,) int8
        Verdict codes of the last level of ``wider``. The wait for newcomers is unbounded, so ``HOLDS`` counts
        as pending only with ``end`` = ``pending``.
    """
    known = set(map(tuple, innermost(levels).tolist()))
    late = np.array([tuple(row) not in known for row in innermost(wider).tolist()], np.bool_)
    due = (codes != VIOLATED) & ((codes != HOLDS) | (check.end == "pending"))
    codes = np.where(late, np.where(due, PENDING, VIOLATED), codes).astype(np.int8)
    return int(folded_values(wider, codes, HOLDS)[0][0]) != VIOLATED


def number_of_bindings(domains: Sequence[Collection[int]], *, injective: bool) -> int:
    """Return the number of combinations of one entity from each set.

    If ``injective``, no entity occurs twice in a combination.
    """
    if not injective:
        return prod(map(len, domains))
    kinds = Counter(tuple(one in some for some in domains) for one in set[int]().union(*domains))

    def combined(at: int) -> int:
        total = 0
        for kind, many in list(kinds.items()) if at < len(domains) else ():
            if kind[at] and many:
                kinds[kind] -= 1
                total += many * combined(at + 1)
                kinds[kind] += 1
        return total if at < len(domains) else 1

    return combined(0)


def may_wait(check: BoundCheck) -> bool:
    """True if the settings of a check let entities that appear later make a false check true."""
    return check.end in {"bounded", "pending"} and any(
        q.word == "FORSOME" for q in check.quantifiers
    )


def folded_values(levels: Sequence[Level], values: Array, most: int = 1) -> list[Array]:
    """Combine the values of entity combinations, quantifier by quantifier, innermost first.

    ``FORALL`` takes the minimum, ``FORSOME`` the maximum. Return the values of each level,
    outermost first.

    Parameters
    ----------
    levels : sequence of Level
    values : (B, …) bool or int8
        Values of the bindings of the last level; without quantifiers (1, …).
    most : int
        Largest value: the result of ``FORALL`` without bindings. The result of ``FORSOME`` is 0.
    """
    found = [values]
    for number in range(len(levels) - 1, -1, -1):
        level = levels[number]
        outer = len(levels[number - 1].bindings) if number else 1
        every = level.word == "FORALL"
        joined = np.full((outer, *values.shape[1:]), most if every else 0, values.dtype)
        (np.minimum if every else np.maximum).at(joined, level.parents, found[0])
        found.insert(0, joined)
    return found


def folded_margins(levels: Sequence[Level], values: Floats) -> tuple[float, int | None]:
    """Return the robustness margin of a check, and the index of the entity combination that decides it.

    ``None`` means that no combination decides.

    Parameters
    ----------
    levels : sequence of Level
    values : (B,) float64
        Margins of the bindings of the last level.
    """
    if not levels:
        return float(values[0]), 0
    rows = np.arange(len(values))
    for number in range(len(levels) - 1, -1, -1):
        level = levels[number]
        outer = len(levels[number - 1].bindings) if number else 1
        every = level.word == "FORALL"
        order = np.lexsort((values if every else -values, level.parents))
        parents, where = np.unique(level.parents[order], return_index=True)
        joined = np.full(outer, np.inf if every else -np.inf)
        chosen = np.full(outer, -1)
        joined[parents], chosen[parents] = values[order][where], rows[order][where]
        values, rows = joined, chosen
    return float(values[0]), int(rows[0]) if rows[0] >= 0 else None
