"""Time: formulas over columns and frame by frame, beside a DFA of LTLf that is stepped in Python."""

from __future__ import annotations

import random
import resource
import shutil
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.measure import Measure
from sgstore.graphs.online import Frame
from sgstore.temporal import Monitor, MonitorEvent, evaluate
from sgstore.temporal._formula import Bound, Not, Or, Proposition, Since, Until, always, eventually
from sgstore.temporal._robustness import MarginTable
from sgstore.temporal._verdicts import Settled

sys.path.extend(str(Path(__file__).parents[1] / "tests" / name) for name in ("worlds", "reference"))
from formulas import OnlineFormula, formula_of  # pyright: ignore[reportMissingImports]
from oracle_robustness import of_rtamt  # pyright: ignore[reportMissingImports]

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.temporal import Formula

FORMULAS: Final = (
    "ALWAYS NOT a",
    "ALWAYS (a IMPLIES b)",
    "ALWAYS (a IMPLIES EVENTUALLY[0s, 2s] b)",
    "ALWAYS (a AND NEXT NOT a IMPLIES b)",
    "EVENTUALLY (a AND EVENTUALLY b)",
    "(NOT a) UNTIL b",
    "ALWAYS ((a AND NEXT NOT a) IMPLIES NEXT (NOT a UNTIL (b OR ALWAYS NOT a)))",
    "ALWAYS (ALWAYS[0s, 5s] a IMPLIES EVENTUALLY[0s, 10s] NOT a)",
    "ALWAYS (b IMPLIES ONCE[0s, 3s] a)",
    "ALWAYS (a SINCE[0s, 8s] b OR NOT c)",
    "ALWAYS (c IMPLIES HISTORICALLY[1s, 4s] NOT b)",
    "ALWAYS (a IMPLIES (b UNTIL[0s, 6s] c))",
    "ALWAYS (PREVIOUS a AND b IMPLIES c RELEASE b)",
)
"""Thirteen properties of the kinds that the literature asks."""

PLAIN: Final = (
    ("ALWAYS (a IMPLIES EVENTUALLY b)", "G(a -> F b)"),
    ("ALWAYS (a AND NEXT NOT a IMPLIES b)", "G((a & X(!a)) -> b)"),
    ("(NOT a) UNTIL (b AND NEXT c)", "(!a) U (b & X(c))"),
)
"""Formulas without bounds and past, and the same as ltlf2dfa reads them."""

PERIOD: Final = 50_000_000

CHECKS: Final = "\n".join(
    [
        *(
            f"CHECK near_{n}: FORALL (v:Vehicle) ALWAYS (dist(ego, v) < {n} IMPLIES"
            f" EVENTUALLY[0s, 2s] dist(ego, v) > {n}) RESET WHEN dist(ego, v) > {n};"
            for n in range(4, 10)
        ),
        *(f"CHECK fast_{n}: FORALL (v:Vehicle) ALWAYS NOT v.speed > {n};" for n in range(14, 18)),
        *(
            f"CHECK brakes_{n}: FORALL (v:Vehicle) ALWAYS"
            f" (v.accel < -{n} IMPLIES ONCE[0s, 3s] dist(ego, v) < 30);"
            for n in range(3, 7)
        ),
        *(
            f"CHECK ego_{n}: ALWAYS (ego.speed > {n} IMPLIES EVENTUALLY[0s, 5s] ego.speed < {n});"
            for n in range(5, 9)
        ),
        "CHECK people: ALWAYS NOT EXISTS {(ego)-[:near_coll]->(:Person)} RESET WHEN ego.speed < 1;",
        "CHECK lead: ALWAYS (EXISTS {(:Vehicle)-[:inDFrontOf]->(ego)} SINCE ego.speed < 50)",
    ]
)
"""Twenty properties."""


def run(quick: bool) -> Iterator[Measure]:
    """Measure."""
    yield from _columns(100_000 if quick else 1_000_000, 1_000_000 if quick else 10_000_000)
    yield from _beside_dfa(20_000 if quick else 200_000)
    yield from _margins(100_000 if quick else 1_000_000)
    yield from _monitor(200 if quick else 1000)


def _made(frames: int) -> tuple[dict[str, Bools], np.ndarray[Any, np.dtype[np.int64]]]:
    """Propositions that hold for a while, on a clock of 20 Hz."""
    rng = np.random.default_rng(3)
    columns = {
        name: np.repeat(rng.random(frames // 20 + 1) < share, 20)[:frames]
        for name, share in (("a", 0.3), ("b", 0.5), ("c", 0.2))
    }
    return columns, np.arange(frames, dtype=np.int64) * PERIOD


def _columns(frames: int, many: int) -> Iterator[Measure]:
    columns, times = _made(frames)
    formulas = [formula_of(text) for text in FORMULAS]
    work = [partial(evaluate, f, columns, times) for f in formulas]
    seconds = _taken(lambda: [one() for one in work])
    yield Measure(f"{len(FORMULAS)} properties over {frames:,} frames, one core", seconds, "s")
    with ThreadPoolExecutor(2) as pool:
        both = _taken(lambda: [one.result() for one in [pool.submit(one) for one in work]])
    yield Measure("… on two cores", both, "s", "goal at 1,000,000: 5 s")
    resets = columns["c"]
    settled = [partial(_settled, f, columns, times, resets) for f in formulas]
    worst = [(_taken(one), text) for one, text in zip(settled, FORMULAS, strict=True)]
    slowest, text = max(worst)
    yield Measure(
        "… what was known at each frame, and all violations", sum(t for t, _ in worst), "s"
    )
    yield Measure("… the slowest of them", slowest, "s", text)
    columns, times = _made(many)
    worst = [
        (_taken(partial(evaluate, f, columns, times)), text)
        for f, text in zip(formulas, FORMULAS, strict=True)
    ]
    slowest, text = max(worst)
    yield Measure(
        f"the slowest of them over {many:,} frames",
        slowest,
        "s",
        f"goal at 10,000,000: 2 s; {text}",
    )
    middle = sorted(seconds for seconds, _ in worst)[len(worst) // 2]
    yield Measure("… the median of them", middle, "s")


def _settled(formula: Formula, columns: Mapping[str, Bools], times: Ints, resets: Bools) -> None:
    settled = Settled(formula, columns, times)
    settled.statuses()
    settled.violations(resets)


def _beside_dfa(frames: int) -> Iterator[Measure]:
    columns, times = _made(frames)
    letters = [
        dict(zip(columns, row, strict=True))
        for row in zip(*(c.tolist() for c in columns.values()), strict=True)
    ]
    stepped = {text: _online(text, letters) for text, _ in PLAIN}
    for text, (seconds, verdict) in stepped.items():
        whole = bool(evaluate(formula_of(text), columns, times)[0])
        if whole != verdict:
            raise AssertionError(f"{text}: {whole} over columns, {verdict} frame by frame")
        yield Measure(f"frame by frame: {text}", seconds / frames * 1e6, "µs a frame")
    missing = _missing()
    if missing:
        print(f"beside an LTLf DFA: left out, {missing}", file=sys.stderr)
        return
    for text, ltlf in PLAIN:
        machine = _dfa(ltlf)
        began = time.perf_counter()
        accepted = machine(letters)
        seconds = time.perf_counter() - began
        if accepted != stepped[text][1]:
            raise AssertionError(f"{text}: the DFA says {accepted}")
        _agree(text, machine)
        ratio = seconds / stepped[text][0]
        yield Measure(
            f"an LTLf DFA beside it: {ltlf}",
            seconds / frames * 1e6,
            "µs a frame",
            f"{ratio:.2f} times",
        )
        columnar = _taken(partial(evaluate, formula_of(text), columns, times))
        yield Measure("… and beside columns", seconds / columnar, "times")


def _margins(frames: int) -> Iterator[Measure]:
    """Margins over columns: each operator, and nested ones beside rtamt; processor time."""
    rng, times = np.random.default_rng(3), np.arange(frames, dtype=np.int64) * PERIOD
    columns = {name: rng.normal(size=(1, frames)) for name in "abc"}
    a, b, c = map(Proposition, "abc")
    near, far = (Bound(0, n, frames=True) for n in (20, 100))
    one = {
        "ALWAYS[0, 100]": always(a, far),
        "EVENTUALLY": eventually(a),
        "UNTIL[0, 100]": Until(a, b, far),
        "UNTIL": Until(a, b),
        "SINCE[0, 100]": Since(a, b, far),
    }
    for text, formula in one.items():
        spent = min(_worked(partial(_margin, formula, columns, times)) for _ in range(2))
        yield Measure(f"margin: {text}, {frames:,} frames", spent, "s", "goal at 1,000,000: 0.1 s")
    if find_spec("rtamt") is None:
        print("margins beside rtamt: left out, pip install --group dev", file=sys.stderr)
        return
    nested = {
        "ALWAYS[0, 20] EVENTUALLY[0, 20]": always(eventually(a, near), near),
        "ALWAYS[0, 100] (NOT a OR EVENTUALLY[0, 100] b)": always(
            Or((Not(a), eventually(b, far))), far
        ),
        "(a UNTIL[0, 20] b) SINCE[0, 20] c": Since(Until(a, b, near), c, near),
    }
    some = {name: column[:, :PEER_FRAMES] for name, column in columns.items()}
    word = {name: column[0].tolist() for name, column in some.items()}
    for text, formula in nested.items():
        theirs = _worked(partial(of_rtamt, formula, word))
        own = partial(_margin, formula, some, times[:PEER_FRAMES])
        if not np.array_equal(own()[0], of_rtamt(formula, word)):
            raise AssertionError(f"{text}: rtamt has other margins")
        ratio = theirs / min(_worked(own) for _ in range(5))
        yield Measure(
            f"rtamt beside it: {text}", ratio, "times", f"{PEER_FRAMES:,} frames, goal 20"
        )


PEER_FRAMES: Final = 5_000


def _margin(formula: Formula, columns: Mapping[str, Floats], times: Ints) -> Floats:
    return MarginTable(columns, times).value(formula)


def _worked(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def _agree(text: str, machine: Callable[[Sequence[Mapping[str, bool]]], bool]) -> None:
    """Hold the automaton to the same answers on short words."""
    rng = random.Random(5)
    for _ in range(500):
        word = [{name: rng.random() < 0.5 for name in "abc"} for _ in range(rng.randint(1, 8))]
        if machine(word) != _online(text, word)[1]:
            raise AssertionError(f"{text}: the DFA and the progression differ on {word}")


def _missing() -> str:
    if find_spec("ltlf2dfa") is None:
        return "pip install --group peers, and apt install mona"
    return "" if shutil.which("mona") else "MONA is not there: apt install mona"


def _online(text: str, letters: Sequence[Mapping[str, bool]]) -> tuple[float, bool]:
    engine = OnlineFormula(formula_of(text), every=False)
    began = time.perf_counter()
    for number, letter in enumerate(letters):
        engine.step(letter, number * PERIOD)
    return time.perf_counter() - began, bool(engine.verdict)


def _dfa(ltlf: str) -> Callable[[Sequence[Mapping[str, bool]]], bool]:
    """The automaton that MONA makes of a formula, stepped as SGSM does: guard by guard."""
    parsed = import_module("ltlf2dfa.parser.ltlf").LTLfParser()(ltlf)
    dot: str = parsed.to_dfa()
    accepting: set[str] = set()
    guards: dict[str, list[tuple[str, dict[str, bool]]]] = {}
    for line in dot.splitlines():
        text = line.strip().rstrip(";")
        if "doublecircle" in text:
            accepting = set(text.partition("]")[2].replace(";", " ").split())
        if "->" in text and "label" in text:
            ends, _, label = text.partition('[label="')
            src, dst = (end.strip() for end in ends.split("->"))
            for guard in label.rstrip('"];').split("|"):
                words = [word.strip(" ()") for word in guard.split("&")]
                wanted = {w.lstrip("~ "): not w.startswith("~") for w in words if w != "true"}
                guards.setdefault(src, []).append((dst, wanted))

    def machine(letters: Sequence[Mapping[str, bool]]) -> bool:
        state = "1"
        for letter in letters:
            for dst, wanted in guards[state]:
                if all(letter[name] == value for name, value in wanted.items()):
                    state = dst
                    break
        return state in accepting

    return machine


class _Timed(Monitor):
    """A monitor that takes down how long its parts take; processor time."""

    made: list[float]
    asked: list[float]
    told: list[float]

    def _step(self, frame: Frame) -> tuple[MonitorEvent, ...]:
        times = [time.thread_time()]
        graphs = self.generator.steps(frame, [""])
        times.append(time.thread_time())
        questions = self._ask(graphs, classed=True)
        times.append(time.thread_time())
        events = self._tell(*questions)
        times.append(time.thread_time())
        for taken, (a, z) in zip((self.made, self.asked, self.told), pairwise(times), strict=True):
            taken.append(z - a)
        return events


def _monitor(frames: int) -> Iterator[Measure]:
    """A hundred vehicles that drive about the ego, and twenty properties."""
    monitor = _Timed(CHECKS)
    monitor.made, monitor.asked, monitor.told = [], [], []
    wall: list[float] = []
    sizes: list[int] = []
    for number in range(frames):
        frame = _frame(number)
        began = time.perf_counter()
        monitor.step(frame)
        wall.append(time.perf_counter() - began)
        if number % (frames // 4) == frames // 4 - 1:
            sizes.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    told = monitor.told
    whole = [a + b for a, b in zip(monitor.asked, told, strict=True)]
    made = sum(monitor.made)
    yield Measure(
        "monitor, 100 nodes, 20 properties: time, median", _share(told, 0.5) * 1e3, "ms a frame"
    )
    yield Measure("… 99th percentile", _share(told, 0.99) * 1e3, "ms a frame", "goal: 1 ms")
    yield Measure("… with atoms, median", _share(whole, 0.5) * 1e3, "ms a frame")
    yield Measure("… 99th percentile", _share(whole, 0.99) * 1e3, "ms a frame", "goal: 10 ms")
    yield Measure("… beside the making of the graph", sum(whole) / made, "times")
    yield Measure("a whole step, by the clock, median", _share(wall, 0.5) * 1e3, "ms a frame")
    yield Measure("… 99th percentile", _share(wall, 0.99) * 1e3, "ms a frame")
    yield Measure(
        "… memory from a quarter of the run to its end", sizes[-1] / sizes[0], "times", "goal: 1"
    )


def _frame(number: int) -> Frame:
    rng = random.Random(number // 10)
    frame = Frame(time_ns=number * PERIOD, ego="ego")
    frame.add(
        "ego",
        "car",
        0.0,
        0.0,
        heading=0.0,
        length=4.5,
        width=1.9,
        vx=6 + number % 40 / 20,
        vy=0.0,
        ax=0.0,
        ay=0.0,
    )
    for who in range(99):
        x, y = (who % 10 - 5) * 9 + number % 60 / 20, (who // 10 - 5) * 9 + rng.random()
        speed = 5 + rng.random() * 10
        kind = "person" if who % 10 == 0 else "car"
        frame.add(
            f"v{who}",
            kind,
            x,
            y,
            heading=0.0,
            length=4.5,
            width=1.9,
            vx=speed,
            vy=0.0,
            ax=-rng.random() * 4,
            ay=0.0,
        )
    return frame


def _share(values: list[float], share: float) -> float:
    return sorted(values)[int(share * (len(values) - 1))]


def _taken(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
