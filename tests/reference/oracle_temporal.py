"""Temporal formulas as the textbook defines them, and random ones: ``python oracle_temporal.py 100000``."""

from __future__ import annotations

import random
import sys
from typing import TYPE_CHECKING

import numpy as np
from formulas import OnlineFormula, prefix_verdicts

from sgstore.temporal import Formula, evaluate
from sgstore.temporal._formula import (
    And,
    Bound,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    TruthConstant,
    Until,
    always,
    eventually,
    historically,
    once,
    release,
)
from sgstore.temporal._verdicts import PRESUMABLY_TRUE, Settled

if TYPE_CHECKING:
    from collections.abc import Sequence

NAMES = "abc"
Word = list[dict[str, bool]]


def holds(formula: Formula, word: Word, times: Sequence[int], i: int) -> bool:  # noqa: PLR0911
    """Whether a formula is true at frame i of a finite word."""
    n = len(word)
    match formula:
        case TruthConstant(value=value):
            return value
        case Proposition(name=name):
            return word[i][name]
        case Not(operand=operand):
            return not holds(operand, word, times, i)
        case And(operands=operands):
            return all(holds(operand, word, times, i) for operand in operands)
        case Or(operands=operands):
            return any(holds(operand, word, times, i) for operand in operands)
        case Next(operand=operand, weak=weak):
            return holds(operand, word, times, i + 1) if i + 1 < n else weak
        case Previous(operand=operand):
            return i > 0 and holds(operand, word, times, i - 1)
        case Until(left=left, right=right, bound=bound):
            return any(
                within(bound, j - i, times[j] - times[i])
                and holds(right, word, times, j)
                and all(holds(left, word, times, k) for k in range(i, j))
                for j in range(i, n)
            )
        case Since(left=left, right=right, bound=bound):
            return any(
                within(bound, i - j, times[i] - times[j])
                and holds(right, word, times, j)
                and all(holds(left, word, times, k) for k in range(j + 1, i + 1))
                for j in range(i + 1)
            )


def within(bound: Bound, frames: int, time: int) -> bool:
    age = frames if bound.frames else time
    return bound.low <= age and (bound.high is None or age <= bound.high)


def random_formula(rng: random.Random, depth: int) -> Formula:
    if depth == 0 or rng.random() < 0.1:
        return rng.choice(
            (Proposition(rng.choice(NAMES)), Proposition(rng.choice(NAMES)), TruthConstant(True))
        )

    def inner() -> Formula:
        return random_formula(rng, depth - 1)

    makers = [
        lambda: Not(inner()),
        lambda: And((inner(), inner())),
        lambda: Or((inner(), inner())),
        lambda: Next(inner(), weak=rng.random() < 0.5),
        lambda: Previous(inner()),
        lambda: Until(inner(), inner(), random_bound(rng)),
        lambda: Since(inner(), inner(), random_bound(rng)),
        lambda: always(inner(), random_bound(rng)),
        lambda: eventually(inner(), random_bound(rng)),
        lambda: once(inner(), random_bound(rng)),
        lambda: historically(inner(), random_bound(rng)),
        lambda: release(inner(), inner(), random_bound(rng)),
    ]
    return rng.choice(makers)()


def random_bound(rng: random.Random) -> Bound:
    frames = rng.random() < 0.3
    scale = 1 if frames else 10
    low = rng.choice((0, 0, 1, 2)) * scale
    high = rng.choice((None, None, low, low + scale, low + 3 * scale))
    return Bound(low, high, frames)


def random_word(rng: random.Random) -> tuple[Word, list[int]]:
    """A word on an irregular clock with gaps."""
    length = rng.randint(1, 10)
    times = [rng.randint(-20, 20)]
    for _ in range(length - 1):
        times.append(times[-1] + rng.choice((1, 7, 10, 10, 13, 60)))
    bias = rng.choice((0.2, 0.5, 0.8))
    return [{name: rng.random() < bias for name in NAMES} for _ in times], times


def try_formulas(first: int, count: int, depth: int = 4) -> int:
    """Both engines against the definition; how many values were true."""
    true = 0
    for seed in range(first, first + count):
        rng = random.Random(seed)
        formula, (word, times) = random_formula(rng, depth), random_word(rng)
        wanted = [holds(formula, word, times, i) for i in range(len(word))]
        columns = {name: np.array([letter[name] for letter in word]) for name in NAMES}
        clock = np.array(times, np.int64)
        assert evaluate(formula, columns, clock).tolist() == wanted, (seed, formula)

        engine, told = OnlineFormula(formula), {}
        verdicts = []
        for letter, time in zip(word, times, strict=True):
            for number, value in engine.step(letter, time):
                assert number not in told
                told[number] = value
            verdicts.append(engine.verdict)
        told |= dict(engine.finish())
        assert [told[i] for i in range(len(word))] == wanted, (seed, formula)

        prefixes = [holds(formula, word[: i + 1], times, 0) for i in range(len(word))]
        assert verdicts == prefixes, (seed, formula)
        assert prefix_verdicts(formula, columns, clock).tolist() == prefixes, (seed, formula)
        statuses = Settled(formula, columns, clock).statuses()
        assert (statuses >= PRESUMABLY_TRUE).tolist() == prefixes, (seed, formula)
        true += sum(wanted)
    return true


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    print(f"{number} formulas, no difference; {try_formulas(0, number)} values were true")
