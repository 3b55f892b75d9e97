"""How much has not been seen, from how often what was seen was seen.

Sources. Good–Turing: Good, "The population frequencies of species", Biometrika 40 (1953). Chao1, its variance
and interval: Chao, "Nonparametric estimation of the number of classes in a population" (1984), bias-corrected
as in Chao and Chiu, "Species richness: estimation and comparison" (2016), eq. 4, 7 and 8. Rarefaction:
Hurlbert, "The nonconcept of species diversity", Ecology 52 (1971).

All of them hold for samples that are drawn independently. Frames one after another are not: count runs or
traces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sgstore.world import Floats, Ints


@dataclass(frozen=True, slots=True)
class Estimate:
    """What can be said of classes that were not seen.

    Attributes
    ----------
    units : int
        How many units were counted.
    seen : int
        How many classes they have.
    once, twice : int
        How many classes were seen in one unit, and in two.
    unseen_mass : float
        Good–Turing: the share of further units whose class is new; NaN without units.
    chao1 : float
        How many classes there are at least, seen and unseen; a lower bound in expectation.
    low, high : float
        Its 95 % interval.
    """

    units: int
    seen: int
    once: int
    twice: int
    unseen_mass: float
    chao1: float
    low: float
    high: float


def estimate(sizes: Ints, samples: int = 0) -> Estimate:
    """What can be said of what was not seen.

    Parameters
    ----------
    sizes : (S,) int64
        How often each class was seen; those that are 0 do not count.
    samples : int
        How many samples there were, if a sample has many classes, each of which counts once in it: traces.
        ``chao1`` is then Chao2 of these incidences. 0: each unit is a sample of its own.
    """
    sizes = sizes[sizes > 0]
    units, seen = int(sizes.sum()), len(sizes)
    once, twice = int((sizes == 1).sum()), int((sizes == 2).sum())
    if not units:
        return Estimate(0, 0, 0, 0, math.nan, 0.0, 0.0, 0.0)
    factor = ((samples or units) - 1) / (samples or units)
    if twice:
        ratio = once / twice
        unseen = factor * once**2 / (2 * twice)
        variance = twice * (factor * ratio**2 / 2 + factor**2 * ratio**3 + factor**2 * ratio**4 / 4)
    else:
        unseen = factor * once * (once - 1) / 2
        total = seen + unseen
        variance = (
            factor * once * (once - 1) / 2
            + factor**2 * once * (2 * once - 1) ** 2 / 4
            - factor**2 * once**4 / (4 * total)
        )
    low, high = _interval(seen, unseen, max(variance, 0.0))
    return Estimate(units, seen, once, twice, once / units, seen + unseen, low, high)


def _interval(seen: int, unseen: float, variance: float) -> tuple[float, float]:
    """The 95 % interval of a number of classes that cannot be less than what was seen: log-normal."""
    if unseen <= 0:
        return float(seen), float(seen)
    width = math.exp(1.96 * math.sqrt(math.log(1 + variance / unseen**2)))
    return seen + unseen / width, seen + unseen * width


def expected_classes(sizes: Ints, drawn: Ints) -> Floats:
    """How many classes a random part has in the mean: rarefaction, exact.

    Parameters
    ----------
    sizes : (S,) int64
        How often each class was seen.
    drawn : (K,) int64
        How many units are drawn without putting them back; at most the sum of ``sizes``.
    """
    sizes = sizes[sizes > 0]
    units = int(sizes.sum())
    if not units:
        return np.zeros(len(drawn))
    logs = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, units + 1)))])
    distinct, often = np.unique(sizes, return_counts=True)
    expected = np.full(len(drawn), float(len(sizes)))
    for size, many in zip(distinct.tolist(), often.tolist(), strict=True):
        rest = units - size - drawn
        possible = rest >= 0
        left = np.maximum(rest, 0)
        # C(units - size, drawn) / C(units, drawn), in logarithms
        share = logs[units - size] - logs[left] - logs[units] + logs[units - drawn]
        expected -= many * np.where(possible, np.exp(share), 0.0)
    return expected
