"""Average percentage of faults detected (APFD): measures how soon an order of cases finds failures.

Rothermel, Untch, Chu and Harrold, "Prioritizing Test Cases for Regression Testing" (TSE 2001), with
each failing case as its own fault: with failures at the places p of n cases, 1 - mean(p) / n + 1 /
(2 n). The mean of a random order is one half.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.errors import ConfigError

if TYPE_CHECKING:
    from sgstore.model.world import Bools, Floats

SHARES: Final = (0.05, 0.1, 0.2)
"""Shares of the test cases for which the number of found failures is reported."""

_DRAWS: Final = 2_000


@dataclass(frozen=True)
class FaultDetection:
    """Measures (such as APFD) of how early an order of test cases finds the failures.

    Attributes
    ----------
    cases, failures : int
    apfd : float
        Average percentage of faults detected, 0 … 1; one half is chance.
    low, high : float
        Its 95 % interval, by bootstrap over the failures.
    found : dict of float to float
        Share of the failures in the first 5, 10 and 20 % of the cases.
    """

    cases: int
    failures: int
    apfd: float
    low: float
    high: float
    found: dict[float, float]


def fault_detection(failed: Bools, seed: int = 0) -> FaultDetection:
    """Return measures of how early an order of test cases finds the failures.

    Parameters
    ----------
    failed : (N,) bool
        Mask of failing cases, in their order.
    seed : int
        Random seed of the interval.

    Raises
    ------
    ConfigError
        No case fails.

    Examples
    --------
    >>> fault_detection(np.array([True, False, False, False])).apfd
    0.875
    """
    where = np.flatnonzero(failed)
    if not len(where):
        raise ConfigError(
            f"none of {len(failed):,} cases failed; early detection cannot be measured"
        )
    left = 1 - (where + 0.5) / len(failed)
    rng = np.random.Generator(np.random.PCG64(seed))
    means = np.array([_drawn(left, rng) for _ in range(_DRAWS)])
    low, high = np.quantile(means, (0.025, 0.975)).tolist()
    found = {share: float((where < np.ceil(share * len(failed) - 1e-9)).mean()) for share in SHARES}
    return FaultDetection(len(failed), len(where), float(left.mean()), low, high, found)


def failure_curve(failed: Bools, points: int = 200) -> list[tuple[int, int, float, float]]:
    """Return points of a curve: how many failures the first n test cases of an order have.

    Parameters
    ----------
    failed : (N,) bool
        Outcomes of the cases, in their order.
    points : int
        Greatest number of rows.

    Returns
    -------
    list of tuple
        Number of cases, failures among them, their share of all failures, and the mean number of
        failures among as many cases in random order.
    """
    cases = np.unique(np.ceil(np.linspace(0, len(failed), points + 1)[1:]).astype(np.int64))
    found = np.cumsum(failed)[cases - 1]
    total = max(int(failed.sum()), 1)
    return [
        (many, got, got / total, failed.sum() * many / len(failed))
        for many, got in zip(cases.tolist(), found.tolist(), strict=True)
    ]


def _drawn(left: Floats, rng: np.random.Generator) -> float:
    """Draw failures at random with repetition, and return their mean: a bootstrap sample of the APFD."""
    return float(left[rng.integers(0, len(left), len(left))].mean())
