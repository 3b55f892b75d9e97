"""Features that distinguish the scenes of two selections of frames, one by one and as a decision tree."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.testsets.coverage._classes import shared
from sgstore.testsets.coverage._features import Feature, features, over, weighted
from sgstore.testsets.coverage._frames import ReportTable, of_unknown, query_of_features

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.testsets.coverage._classes import Classed

# S3C uses this to find features of failing test inputs that training inputs lack. (Woodlief et al.,
# ICSE 2024, RQ2.)

DEPTH: Final = 4
"""Greatest depth of the tree."""

SMALLEST: Final = 5
"""Smallest weight of a branch, in classes or in frames."""

_THRESHOLDS: Final = (0, 1, 2, 3)
"""Thresholds for the number of occurrences of a feature. A larger number means yes."""


def tree(
    counts: NDArray[np.integer[Any]],
    names: tuple[Feature, ...],
    ours: Bools,
    weight: Floats,
    depth: int = DEPTH,
) -> list[tuple[tuple[str, ...], float, float]]:
    """Build a decision tree that separates two groups of scenes by their features. Return its leaves.

    The split criterion is Gini's impurity (Breiman et al., "Classification and regression trees",
    1984).

    Parameters
    ----------
    counts : (C, F) int
        Number of occurrences of each feature in each case.
    names : tuple of Feature
    ours : (C,) bool
    weight : (C,) float64
    depth : int

    Returns
    -------
    list of tuple
        For each leaf the answers that lead to it, and its weights of ours and of the others; the
        highest share of ours first.
    """
    leaves: list[tuple[tuple[str, ...], float, float]] = []

    def grow(rows: Ints, asked: tuple[str, ...]) -> None:
        known = counts[rows]
        best = _best(known, ours[rows], weight[rows]) if len(asked) < depth else None
        if best is None:
            good, other = weight[rows[ours[rows]]].sum(), weight[rows[~ours[rows]]].sum()
            leaves.append((asked, float(good), float(other)))
            return
        feature, more_than = best
        yes, text = known[:, feature] > more_than, " ".join(names[feature])
        grow(rows[yes], (*asked, f"{text} > {more_than}" if more_than else text))
        grow(rows[~yes], (*asked, f"{text} <= {more_than}" if more_than else f"no {text}"))

    grow(np.arange(len(counts)), ())
    leaves.sort(key=lambda leaf: (-leaf[1] / max(leaf[1] + leaf[2], 1e-12), -leaf[1]))
    return leaves


def _best(counts: NDArray[np.integer[Any]], ours: Bools, weight: Floats) -> tuple[int, int] | None:
    """Return the best split for a decision tree: a feature, and a threshold for its count."""
    good = np.where(ours, weight, 0.0)
    total, positive = float(weight.sum()), float(good.sum())
    if min(positive, total - positive) < 1e-9:
        return None
    best, most = None, 1e-9 * total
    highest = counts.max(axis=0, initial=0)
    for more_than in _THRESHOLDS:
        columns = np.flatnonzero(highest > more_than)
        if not len(columns):
            break
        yes, good_yes = weighted(counts[:, columns], np.stack([weight, good]), more_than)
        gain = (
            _impurity(positive, total)
            - _impurity(good_yes, yes)
            - _impurity(positive - good_yes, total - yes)
        )
        gain[np.minimum(yes, total - yes) < SMALLEST] = -np.inf
        first = int(np.argmax(gain))
        if gain[first] > most:
            best, most = (int(columns[first]), more_than), float(gain[first])
    return best


def _impurity(positive: Floats | float, total: Floats | float) -> Floats:
    share = positive / np.maximum(total, 1e-12)
    return 2 * share * (1 - share) * total


def explain(
    b: Classed,
    a: Classed,
    abstraction: str,
    *,
    by_frame: bool = False,
    depth: int = DEPTH,
) -> tuple[ReportTable, ReportTable]:
    """Return two tables that show how two selections of frames differ: features, and a decision tree.

    Parameters
    ----------
    b, a : Classed
        A common frame of both counts for ``b`` only.
    abstraction : str
        Abstraction of their classes.
    by_frame : bool
    depth : int
        Greatest depth of the tree.

    Returns
    -------
    differing : ReportTable
        ``feature``, ``share_of_b``, ``share_of_a``, ``difference``, and a ``query`` for the
        feature; the largest difference first.
    leaves : ReportTable
        ``questions``, ``of_b``, ``of_a``, ``share_of_b`` in the leaf.
    """
    a, twice = _without(a, b)
    _, (b, a) = shared(b, a)
    of_b, of_a = features(b, abstraction), features(a, abstraction)
    names = tuple(sorted({*of_b.names, *of_a.names}))
    of_b, of_a = over(of_b, names), over(of_a, names)
    weights = [
        of.frames.astype(np.float64) if by_frame else np.ones(len(of.codes)) for of in (of_b, of_a)
    ]
    shares = [
        weighted(of.counts, weight[None])[0] / max(float(weight.sum()), 1e-12)
        for weight, of in zip(weights, (of_b, of_a), strict=True)
    ]
    order = np.argsort(-np.abs(shares[0] - shares[1]), kind="stable")
    rows: list[tuple[Any, ...]] = [
        (
            " ".join(names[i]),
            float(shares[0][i]),
            float(shares[1][i]),
            float(shares[0][i] - shares[1][i]),
            query_of_features([names[i]]),
        )
        for i in order.tolist()
    ]
    unit = "frames with a class" if by_frame else "distinct classes"
    said = [f"B: {unit} of {b.chosen.text}", f"A: {unit} of {a.chosen.text}"]
    said += [f"{twice} frames of both count for B only"] if twice else []
    said += of_unknown(b.unknown, b.chosen.text) + of_unknown(a.unknown, a.chosen.text)
    counts = np.concatenate([of_b.counts, of_a.counts])
    ours: NDArray[np.bool_] = np.arange(len(counts)) < len(of_b.codes)
    grown = tree(counts, names, ours, np.concatenate(weights), depth)
    leaves = [
        (
            " and ".join(asked) or "(all)",
            good,
            other,
            good / (good + other) if good + other else None,
        )
        for asked, good, other in grown
    ]
    return (
        ReportTable(("feature", "share_of_b", "share_of_a", "difference", "query"), rows, said),
        ReportTable(("questions", "of_b", "of_a", "share_of_b"), leaves),
    )


def _without(a: Classed, b: Classed) -> tuple[Classed, int]:
    """Return a selection without the frames of another one, and the number of removed frames."""
    if a.chosen.place != b.chosen.place:
        return a, 0
    rows = np.flatnonzero(~np.isin(a.frame_id, b.frame_id))
    kept = replace(a, frame_id=a.frame_id[rows], code=a.code[rows])
    return kept, len(a.frame_id) - len(rows)
