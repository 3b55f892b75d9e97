"""Measures of criticality over many pairs: seconds for the ego and one other in a million frames.

::

    python -m bench criticality [--quick]

Pairs are boxes that move and accelerate, half of them one behind the other. What is told is processor time of
arrays (:class:`~sgstore.model.pair_numbers.PairNumbers`), each measure with all that it is made of; ``--quick``
takes a tenth of the pairs. Floors: the closed forms 1 s, searches of manoeuvres, which are closed forms here,
20 s.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from bench.measure import Measure
from sgstore.model.pair_numbers import PAIR_FUNCTIONS, PairNumbers

if TYPE_CHECKING:
    from collections.abc import Iterator

PAIRS = 1_000_000
TOGETHER = 1 << 14
"""Pairs at once, so that parts of numbers stay in the caches of a processor."""


def pairs(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """States of both, as columns of :data:`sgstore.model.pair_numbers.COLUMNS`."""
    rng = np.random.default_rng(seed)
    found: list[np.ndarray] = []
    for _ in "ab":
        states = np.empty((count, 10))
        states[:, :2] = rng.uniform(-60, 60, (count, 2))
        states[:, 2] = 0
        states[:, 3] = rng.uniform(-np.pi, np.pi, count)
        states[:, 4:6] = rng.uniform([3, 1.6], [12, 2.6], (count, 2))
        states[:, 6:8] = rng.normal(0, 10, (count, 2))
        states[:, 8:10] = rng.normal(0, 2, (count, 2))
        found.append(states)
    a, b = found
    ahead = np.arange(count) % 2 == 0
    way = np.stack([np.cos(a[:, 3]), np.sin(a[:, 3])], axis=1)
    far = rng.uniform(5, 80, count)[:, None]
    b[ahead, :2] = (a[:, :2] + far * way)[ahead]
    b[ahead, 3] = a[ahead, 3]
    for one in found:
        one[ahead, 6:8] = (rng.uniform(0, 30, count)[:, None] * way)[ahead]
    return a, b


def run(quick: bool = False) -> Iterator[Measure]:
    """Each measure that is an expression, one after the other."""
    count = PAIRS // 10 if quick else PAIRS
    a, b = pairs(count)
    for name, one in PAIR_FUNCTIONS.items():
        if not one.sql or not one.worse:
            continue
        begun = time.process_time()
        known = 0
        for start in range(0, count, TOGETHER):
            part = slice(start, start + TOGETHER)
            known += int((~np.isnan(PairNumbers(a[part], b[part])[name])).sum())
        took = (time.process_time() - begun) * PAIRS / count
        yield Measure(name, took, "s", f"a million pairs; known of {known / count:.0%}")
