"""States of a monitor against verdicts over columns, random formulas: ``python oracle_monitor.py 100000``."""

from __future__ import annotations

import random
import sys

import numpy as np
from oracle_temporal import NAMES, random_formula

from sgstore.temporal import evaluate
from sgstore.temporal._check_monitor import Automaton
from sgstore.temporal._formula import looks_ahead
from sgstore.temporal._progression import Tick
from sgstore.temporal._verdicts import Settled

Spans = list[tuple[int, int, bool]]

BITS = {name: 1 << number for number, name in enumerate(NAMES)}


def told(seed: int) -> tuple[Spans, Spans, str] | None:
    """Violations as a monitor tells them, as columns do, and of what; ``None``: the formulas do not fit."""
    rng = random.Random(seed)
    formula, reset = random_formula(rng, rng.randint(1, 4)), random_formula(rng, rng.randint(0, 2))
    with_reset = rng.random() < 0.7
    if with_reset and looks_ahead(reset):
        return None
    frames, held = rng.randint(1, 24), rng.choice((1, 1, 4, 8))
    times = np.cumsum([rng.randint(1, rng.choice((6, 25))) for _ in range(frames)])
    columns = {
        name: np.repeat([rng.random() < 0.5 for _ in range(frames)], held)[:frames]
        for name in NAMES
    }
    resets = evaluate(reset, columns, times) if with_reset else None
    wanted = Settled(formula, columns, times).violations(resets)
    automaton = Automaton(formula, None if resets is None else reset, (), BITS)
    state, spans, since = automaton.begun, list[tuple[int, int, bool]](), -1
    for number, time in enumerate(times.tolist()):
        letter = sum(bit for name, bit in BITS.items() if columns[name][number])
        step = automaton.step(state, letter & automaton.mask, Tick(time, number), {})
        state, since = step.state, number if step.started else since
        if step.ended:
            spans.append((since, number, False))
            since = -1
    if since >= 0:
        spans.append((since, frames - 1, False))
    elif not state.ended:
        spans.append((frames - 1, frames - 1, True))
    return spans, wanted, f"{seed}: {formula}, {reset}"


def try_states(first: int, count: int) -> tuple[int, int]:
    """How many formulas were tried, and how many violations they had."""
    tried = violations = 0
    for seed in range(first, first + count):
        found = told(seed)
        if found is not None:
            tried += 1
            violations += len(found[0])
            assert found[0] == found[1], found
    return tried, violations


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    print("{} formulas, no difference; {} violations".format(*try_states(0, number)))
