"""Differences between two selections of frames: features, and a decision tree.

S3C asked so what failing test inputs have that training inputs have not. (Woodlief et al., ICSE 2024, RQ2.)
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.coverage._classes import shared
from sgstore.coverage._features import features, over, weighted
from sgstore.coverage._frames import ReportTable, of_unknown, query_of_features

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sgstore.coverage._classes import Classed
    from sgstore.coverage._features import Feature
    from sgstore.world import Bools, Floats, Ints


DEPTH: Final = 4
"""Questions, one after another, in the tree."""

SMALLEST: Final = 5
"""Least weight of a side of a question: of classes, or of frames."""

_THRESHOLDS: Final = (0, 1, 2, 3)
"""How often a feature must occur at least, less one, for the answer yes."""


def tree(
    counts: NDArray[np.integer[Any]],
    names: tuple[Feature, ...],
    ours: Bools,
    weight: Floats,
    depth: int = DEPTH,
) -> list[tuple[tuple[str, ...], float, float]]:
    """A decision tree by Gini's impurity (Breiman et al., "Classification and regression trees", 1984).

    Parameters
    ----------
    counts : (C, F) int
        How often each feature occurs in each case.
    names : tuple of Feature
    ours : (C,) bool
    weight : (C,) float64
    depth : int

    Returns
    -------
    list of tuple
        Of each leaf the answers that lead to it, and its weight of ours and of the others; those with the most
        of ours for what they have of the others first.
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
    """The question that makes both sides purest: a feature, and how often it occurs at most without it."""
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
    """Gini's impurity times the weight."""
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
    """Explain how ``b`` differs from ``a``: classes count once each, or as often as they have frames.

    Parameters
    ----------
    b, a : Classed
        A frame of the same store that is in both counts for ``b`` only.
    abstraction : str
        That of their classes.
    by_frame : bool
    depth : int
        Questions, one after another.

    Returns
    -------
    differing : ReportTable
        ``feature``, ``share_of_b``, ``share_of_a``, ``difference``, and the ``query`` that finds it; the
        largest difference first.
    leaves : ReportTable
        ``questions``, ``of_b``, ``of_a``, ``share_of_b`` among what comes there.
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
    """``a`` without the frames that ``b`` has, too; and how many these are."""
    if a.chosen.store.file.path.resolve() != b.chosen.store.file.path.resolve():
        return a, 0
    rows = np.flatnonzero(~np.isin(a.frame_id, b.frame_id))
    kept = replace(a, frame_id=a.frame_id[rows], code=a.code[rows])
    return kept, len(a.frame_id) - len(rows)
