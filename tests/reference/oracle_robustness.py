"""Robustness as it is defined, and as rtamt has it: ``python oracle_robustness.py 100000``.

Random formulas over random margins: every operator looks at every frame. Of formulas whose bounds count frames
rtamt (0.4, discrete time) is asked, too, where it is installed.
"""

from __future__ import annotations

import math
import random
import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np
from oracle_temporal import random_formula, within

from sgstore.temporal._formula import (
    TRUE,
    WHOLE,
    And,
    Bound,
    Formula,
    Next,
    Not,
    Or,
    Previous,
    Proposition,
    Since,
    TruthConstant,
    Until,
    propositions,
    walk,
    with_operands,
)
from sgstore.temporal._progression import Tick
from sgstore.temporal._robustness import MarginTable
from sgstore.temporal._robustness_monitor import MOST_OPEN, MarginStream

if TYPE_CHECKING:
    from collections.abc import Sequence

NAMES = "abc"
Numbers = dict[str, list[float]]


def margin(formula: Formula, word: Numbers, times: Sequence[int], i: int) -> float:  # noqa: PLR0911
    """The margin of a formula at frame i of a finite word."""
    n = len(times)
    match formula:
        case TruthConstant(value=value):
            return math.inf if value else -math.inf
        case Proposition(name=name):
            return word[name][i]
        case Not(operand=operand):
            return -margin(operand, word, times, i)
        case And(operands=operands):
            return min(margin(operand, word, times, i) for operand in operands)
        case Or(operands=operands):
            return max(margin(operand, word, times, i) for operand in operands)
        case Next(operand=operand, weak=weak):
            end = math.inf if weak else -math.inf
            return margin(operand, word, times, i + 1) if i + 1 < n else end
        case Previous(operand=operand):
            return margin(operand, word, times, i - 1) if i else -math.inf
        case Until(left=left, right=right, bound=bound):
            ways = [
                min(
                    margin(right, word, times, j),
                    *(margin(left, word, times, k) for k in range(i, j)),
                    math.inf,
                )
                for j in range(i, n)
                if within(bound, j - i, times[j] - times[i])
            ]
            return max(ways, default=-math.inf)
        case Since(left=left, right=right, bound=bound):
            ways = [
                min(
                    margin(right, word, times, j),
                    *(margin(left, word, times, k) for k in range(j + 1, i + 1)),
                    math.inf,
                )
                for j in range(i + 1)
                if within(bound, i - j, times[i] - times[j])
            ]
            return max(ways, default=-math.inf)


def random_margins(rng: random.Random, frames: int) -> Numbers:
    """Margins of propositions; of some of them only a few values, of some infinite ones."""
    of = rng.choice(
        (
            lambda: rng.gauss(0, 1),
            lambda: float(rng.randint(-2, 2)),
            lambda: rng.choice((math.inf, -math.inf, rng.gauss(0, 1))),
        )
    )
    return {name: [of() for _ in range(frames)] for name in NAMES}


def compare(rng: random.Random, depth: int) -> int:
    """A formula over columns, in a stream, and as it is defined; how many frames there are."""
    formula = random_formula(rng, depth)
    frames = rng.randint(1, 9)
    times = np.cumsum([rng.choice((1, 2, 7, 10)) for _ in range(frames)]).tolist()
    word = random_margins(rng, frames)
    wanted = [margin(formula, word, times, i) for i in range(frames)]
    columns = {name: np.array([values]) for name, values in word.items()}
    table = MarginTable(columns, np.array(times, np.int64))
    found = np.broadcast_to(table.value(formula), (1, frames))[0].tolist()
    assert found == wanted, (formula, word, times, found, wanted)
    for i in range(frames):
        decisive = table.decisive(formula, 0, i)
        if decisive is not None:
            name, at = decisive
            assert abs(word[name][at]) == abs(wanted[i]), (formula, word, times, i, decisive)
    open_ends = {p for p in walk(formula) if isinstance(p, Until) and p.bound.high is None}
    if 2 * len(open_ends) > MOST_OPEN:
        return frames
    stream = MarginStream(formula)
    for i in range(frames):
        told = {name: np.array([values[i]]) for name, values in word.items()}
        stream.step(told, Tick(times[i], i), np.zeros(1, np.int64))
        part = {name: values[: i + 1] for name, values in word.items()}
        now = margin(formula, part, times[: i + 1], 0)
        (told_now,) = stream.margins()
        assert told_now["value"] == now, (formula, part, times[: i + 1])
        if told_now["name"] >= 0:
            name, at = stream.name(int(told_now["name"])), int(told_now["frame"])
            assert abs(word[name][at]) == abs(now), (formula, part, times[: i + 1])
            assert told_now["time"] == times[at]
    return frames


# rtamt ----------------------------------------------------------------------------------------------


def counting(formula: Formula, rng: random.Random) -> Formula:
    """A formula with bounds in frames, as rtamt has them: both ends, or none."""
    found = with_operands(formula, lambda part: counting(part, rng))
    if not isinstance(found, Until | Since):
        return found
    low = rng.randint(0, 3)
    bound = Bound(low, low + rng.randint(0, 4), frames=True) if rng.random() < 0.7 else WHOLE
    return type(found)(found.left, found.right, bound)


def as_rtamt(formula: Formula) -> str:  # noqa: C901, PLR0911 - a case each
    """A formula as rtamt writes it; its *until* has the same meaning, one frame at a time."""
    match formula:
        case TruthConstant(value=value):
            return "(a >= 0) or not (a >= 0)" if value else "(a >= 0) and not (a >= 0)"
        case Proposition(name=name):
            return f"({name} >= 0)"
        case Not(operand=operand):
            return f"(not ({as_rtamt(operand)}))"
        case And(operands=operands):
            return "(" + " and ".join(map(as_rtamt, operands)) + ")"
        case Or(operands=operands):
            return "(" + " or ".join(map(as_rtamt, operands)) + ")"
        case Next(operand=operand, weak=weak):
            return f"{'next' if weak else 's_next'}({as_rtamt(operand)})"
        case Previous(operand=operand):
            return f"s_prev({as_rtamt(operand)})"
        case Until(left=left, right=right) if left == TRUE:
            return f"eventually{_bound(formula.bound)}({as_rtamt(right)})"
        case Since(left=left, right=right) if left == TRUE:
            return f"once{_bound(formula.bound)}({as_rtamt(right)})"
        case Until(left=left, right=right):
            return f"(({as_rtamt(left)}) until{_bound(formula.bound)} ({as_rtamt(right)}))"
        case Since(left=left, right=right):
            return f"(({as_rtamt(left)}) since{_bound(formula.bound)} ({as_rtamt(right)}))"


def _bound(bound: Bound) -> str:
    return "" if bound == WHOLE else f"[{bound.low}:{bound.high}]"


def expressible(formula: Formula) -> bool:
    """Whether rtamt can say it: its constants are numbers, and no formulas."""
    return not any(
        isinstance(part, TruthConstant)
        and not any(
            isinstance(whole, Until | Since) and whole.left is part for whole in walk(formula)
        )
        for part in walk(formula)
    )


def of_rtamt(formula: Formula, word: Numbers) -> list[float]:
    import rtamt

    spec = rtamt.StlDiscreteTimeOfflineSpecification()
    for name in [*NAMES, "out"]:
        spec.declare_var(name, "float")
    spec.spec = f"out = {as_rtamt(formula)}"
    spec.parse()
    frames = len(word["a"])
    told = {name: list(values) for name, values in word.items()}
    return [value for _, value in spec.evaluate({"time": list(range(frames)), **told})]


def compare_rtamt(rng: random.Random, depth: int) -> bool:
    """A formula over columns, and as rtamt evaluates it; whether it can say it."""
    formula = counting(random_formula(rng, depth), rng)
    if not (expressible(formula) and propositions(formula)):
        return False
    frames = rng.randint(2, 20)  # rtamt fails on a single one
    word = {name: [rng.gauss(0, 1) for _ in range(frames)] for name in NAMES}
    columns = {name: np.array([values]) for name, values in word.items()}
    times = np.arange(frames, dtype=np.int64) * 10**9
    found = MarginTable(columns, times).value(formula)[0]
    wanted = np.array(of_rtamt(formula, word))
    assert np.array_equal(found, wanted), (formula, word, found, wanted)
    return True


def asked_of_rtamt(rng: random.Random, count: int) -> int:
    """Compare so many formulas that rtamt can say; how many were made for them."""
    tried = asked = 0
    while asked < count:
        tried, asked = tried + 1, asked + compare_rtamt(rng, rng.randint(1, 4))
    return tried


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    rng = random.Random(int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    seen = sum(compare(rng, rng.randint(1, 4)) for _ in range(count))
    peer = "rtamt is not installed (pip install --group dev)"
    if find_spec("rtamt") is not None:
        peer = f"rtamt was asked {count}, of {asked_of_rtamt(rng, count)}"
    sys.stdout.write(f"no difference in {count} formulas, {seen} frames; {peer}\n")
