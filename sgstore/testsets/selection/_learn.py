"""Failure probabilities of test cases, learned from the results of other test cases.

The features of a case come from the ego's three most critical neighbours in its most critical
frame. The model is gradient boosting of trees (scikit-learn, the extra ``[learn]``), or else a
logistic regression on ranks. A model never judges a case whose outcome it was trained on: cases
with known outcomes are judged in five folds, and the others by a model of all outcomes.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ConfigError
from sgstore.testsets.selection._situations import OTHERS, frames_in_parts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.testsets.selection._units import Units

    Singles = NDArray[np.float32]

NEIGHBOURS: Final = 3
_NUMBERS: Final = (
    *("gap", "closing_time", "ttc", "dce_3s", "ttce", "wttc"),
    *("closing_speed", "rel_speed", "lon", "lat", "rel_heading"),
)
_PARTS: Final = 5
_THREADED: Final = 100_000
_TOGETHER: Final = 1 << 17
"""Number of test cases that the logistic model evaluates at once."""


def boosted() -> bool:
    """True if gradient boosting (an optional package) is installed."""
    return find_spec("sklearn") is not None


def model_name() -> str:
    """Return the name of the statistical model: gradient boosting or logistic regression."""
    return "gradient boosting" if boosted() else "logistic regression on ranks"


def features_of(units: Units, rows: Ints) -> Singles:
    """For each test case, return numbers about the ego and its most critical neighbours in one frame.

    Parameters
    ----------
    units : Units
    rows : (U,) int64
        Row of the frame of each unit.

    Returns
    -------
    (U, 44) float32
        NaN for unknown values and missing neighbours.
    """
    wide = len(_NUMBERS) + 3
    frames, place = np.unique(units.frame_id[rows], return_inverse=True)
    told = np.full((len(frames), NEIGHBOURS * wide + 2), np.nan, np.float32)
    told[:, -1] = 0
    for start, part in frames_in_parts(frames):
        found = units.chosen.one_store.file.arrays(_sql(), [int(part[0]), int(part[-1])])
        at = np.searchsorted(part, found["frame_id"].astype(np.int64))
        here = part[np.minimum(at, len(part) - 1)] == found["frame_id"].astype(np.int64)
        at, turn = start + at[here], found["place"].astype(np.int64)[here]
        names = [*_NUMBERS, "speed", "length", "width"]
        for column, name in enumerate(names):
            told[at, turn * wide + column] = _filled(found[name])[here]
        told[at, -2] = _filled(found["ego_speed"])[here]
        told[at, -1] = found["others"].astype(np.float64)[here]
    return told[place]


def _filled(column: Any) -> Floats:
    """Return a column with NaN for NULL. Values beyond the range of float32 are limited to this range."""
    most = float(np.finfo(np.float32).max)
    return np.clip(np.ma.filled(np.ma.asarray(column).astype(np.float64), np.nan), -most, most)


def _sql() -> str:
    columns = ", ".join(f"c.{name}" for name in _NUMBERS)
    return f"""
      SELECT c.frame_id, {columns}, n.speed, n.length, n.width, e.speed AS ego_speed,
        count(*) OVER (PARTITION BY c.frame_id) AS others,
        row_number() OVER (
          PARTITION BY c.frame_id ORDER BY c.closing_time NULLS LAST, c.dce_3s NULLS LAST, c.dst
        ) - 1 AS place
      FROM world_criticality c
      JOIN world_nodes n ON n.frame_id = c.frame_id AND n.node_id = c.dst
      JOIN nodes e ON e.frame_id = c.frame_id AND e.node_id = c.src
      WHERE {OTHERS} AND c.frame_id BETWEEN ? AND ?
      QUALIFY place < {NEIGHBOURS}
    """  # noqa: S608  names of ours


def cross_fitted(x: Singles, failed: Bools, known: Bools, seed: int) -> Floats:
    """Return the failure probability of each test case, (U,), from a model trained on other test cases.

    Parameters
    ----------
    x : (U, F) float32
    failed, known : (U,) bool
        The outcomes.
    seed : int

    Raises
    ------
    ConfigError
        The outcomes have no failures, or only failures.
    """
    _check(failed, known)
    found = np.empty(len(x))
    if not known.all():
        found[~known] = fitted(x[known], failed[known], x[~known], seed)
    # Neighbours in time are similar: folds are contiguous parts of the store, not random.
    for part in np.array_split(np.flatnonzero(known), _PARTS):
        others = known.copy()
        others[part] = False
        if len(part):
            found[part] = fitted(x[others], failed[others], x[part], seed)
    return found


def learned_elsewhere(
    x: Singles, others: Singles, failed: Bools, known: Bools, seed: int
) -> Floats:
    """Return the failure probability of each test case, (U,), learned from another set of test cases.

    Raises
    ------
    ConfigError
        The outcomes have no failures, or only failures.
    """
    _check(failed, known)
    return fitted(others[known], failed[known], x, seed)


def _check(failed: Bools, known: Bools) -> None:
    wrong = int((failed & known).sum())
    if not 0 < wrong < int(known.sum()):
        raise ConfigError(
            f"{wrong:,} of the {int(known.sum()):,} cases with a known outcome failed: to learn takes failures"
            " and others"
        )


def fitted(x: Singles, failed: Bools, asked: Singles, seed: int) -> Floats:
    """Train a model on test results. Return the failure probabilities of Q other test cases, (Q,)."""
    told = ~np.isnan(x).all(axis=0)  # boosting rejects columns without known values
    x, asked = x[:, told], asked[:, told]
    if len(np.unique(failed)) < 2 or not told.any():
        return np.full(len(asked), float(failed.mean()) if len(failed) else 0.5)
    if not boosted():
        return _logistic(x, failed, asked)
    from sklearn.ensemble import (  # pyright: ignore[reportMissingImports, reportMissingTypeStubs]
        HistGradientBoostingClassifier as Boosting,
    )
    from threadpoolctl import (  # pyright: ignore[reportMissingImports, reportMissingTypeStubs]
        threadpool_limits,
    )

    # Small trees with a low learning rate: failures are rare.
    made: Any = Boosting
    model = made(
        max_iter=200,
        learning_rate=0.05,
        max_leaf_nodes=8,
        l2_regularization=1.0,
        early_stopping=False,
        random_state=seed % (1 << 32),
    )
    # For few cases threads wait longer than they work.
    with threadpool_limits(1 if len(x) < _THREADED else None):
        return model.fit(x, failed).predict_proba(asked)[:, 1]


def _logistic(x: Singles, failed: Bools, asked: Singles) -> Floats:
    """Return failure probabilities by a logistic regression on ranks (Newton's method, L2 penalty)."""
    columns = [np.sort(column[~np.isnan(column)]) for column in x.T]
    known = _ranked(x, columns)
    weights, penalty = np.zeros(known.shape[1]), np.ones(known.shape[1])
    penalty[0] = 0
    for _ in range(_STEPS):
        p = 1 / (1 + np.exp(-np.clip(known @ weights, -30, 30)))
        slope = known.T @ (p - failed) + penalty * weights
        bend = (known * (p * (1 - p))[:, None]).T @ known + np.diag(penalty + 1e-9)
        step = np.linalg.solve(bend, slope)
        weights -= step
        if np.abs(step).max() < 1e-9:
            break
    parts = [asked[start : start + _TOGETHER] for start in range(0, len(asked), _TOGETHER)]
    linear = np.concatenate([_ranked(part, columns) @ weights for part in parts])
    return 1 / (1 + np.exp(-np.clip(linear, -30, 30)))


_STEPS: Final = 50


def _ranked(x: Singles, columns: Sequence[Singles]) -> Floats:
    """Return a column of ones; and for each feature, its rank (−½ … ½), and 1 if its value is known."""
    parts = [np.ones(len(x))]
    for values, known in zip(x.T, columns, strict=True):
        there = ~np.isnan(values)
        low, high = (np.searchsorted(known, values, side) for side in ("left", "right"))
        parts += [np.where(there, (low + high) / 2 / max(len(known), 1) - 0.5, 0), there - 0.5]
    return np.stack(parts, axis=1)
