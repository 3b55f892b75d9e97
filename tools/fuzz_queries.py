"""Random queries on a store of many traces: each is answered, or refused with a reason. No engine error.

::

    python tools/fuzz_queries.py 5000                            # a store of 300 replicas, made for this run
    python tools/fuzz_queries.py 5000 --store many.sgstore       # made once, and kept for the next run
    python tools/fuzz_queries.py 2500 --seed 2500 --store many.sgstore     # other queries of the same store

Replicas are of the shared recordings, with several egos, on at least four maps. Asked are the library's
patterns and checks, the documented ones, and random ones with every form of RETURN, blocks, numbers of pairs,
operators of time, sequences, checks.

What a user did wrong is a ``QueryError``, and a question that takes too long is stopped: both are counted. Any
other exception is a failure, and so is a query that does not stop when it should, or if too many are stopped.
"""

from __future__ import annotations

import argparse
import random
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).parents[1]))  # for bench

import sgstore
from bench.replicas import EGOS, given, replicate, sources
from sgstore.errors import QueryError, SqlError
from sgstore.lang.library import patterns
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.query import Store

TRACES, FRAMES, MAPS = 300, 100, 4
SECONDS = 10.0
"""After how long a query is stopped."""
SOON = 10.0
"""How long it may take from there until it has stopped."""
EVERY = 100
"""How many queries are asked between two words of how far it is."""
STOPPED = 0.05
"""The share of queries that may be stopped; more would mean that too little is tried."""
LABELS = (
    *("", ":Ego", ":Ego", ":Car", ":Vehicle", ":Vehicle", ":Person", ":Lane", ":Lane", ":Entity"),
    *(
        ":TrafficLight",
        ":Truck|Bus",
        ":Vehicle&!Ego",
        ":!Lane",
        ":Road",
        ":Junction",
        ":Crosswalk",
        ":%",
    ),
)
RELATIONS = (
    *(
        "",
        "near",
        "near|very_near",
        "isIn",
        "isIn",
        "isIn",
        "visible",
        "leads",
        "follows",
        "travelsTo",
    ),
    *(
        "inDFrontOf",
        "toLeftOf",
        "opposes",
        "laneChange",
        "controlsTrafficOf",
        "overlaps",
        "!near",
        "sees",
    ),
    *("travelsTo*1..2", "isIn*2", "super_near|near_coll|safety_hazard"),
)
NUMBERS = (
    "speed",
    "accel",
    "heading",
    "x",
    "y",
    "length",
    "width",
    "yaw_rate",
    "speed_limit",
    "vx",
)
TRUTHS = ("is_ego", "is_static", "parked", "light_left", "light_brake", "derived_velocity")
PAIRS = (
    *(
        "dist",
        "gap",
        "lon",
        "lat",
        "bearing",
        "rel_heading",
        "lon_gap",
        "lat_gap",
        "apparent_heading",
    ),
    *("lane_dist", "closing_speed", "rel_speed", "ttc", "headway"),
)
NEXT = ("to_junction", "to_crosswalk", "to_stop_line", "to_traffic_light", "to_stop_sign")
PREDICATES = (
    *(
        "lead",
        "ahead",
        "behind",
        "adjacent",
        "same_lane",
        "oncoming_lane",
        "beside",
        "crossing_heading",
    ),
    *("in_range", "lane_blocked", "same_junction"),
)
WINDOWS = ("min_over", "max_over", "avg_over", "sum_over")
OF_ONE = ("sin", "cos", "tan", "exp", "log", "sqrt", "sign", "degrees", "radians")
ALONE = (
    "stopped",
    "moving",
    "in_junction",
    "off_road",
    "turning_left",
    "red_for",
    "two_way",
    "signalized",
)
BOUNDS = ("", "[0s, 1s]", "[0.5s, 2s]", "[1frames, 5frames]", "[1s, INF]")
LINKS = (
    "THEN",
    "THEN WITHIN 2s",
    "THEN AFTER 0.5s WITHIN 4s",
    "THEN IMMEDIATELY",
    "UNTIL",
    "WHILE",
)
HOLDS = ("", "", " FOR >= 0.5s", " FOR < 2s", " FOR >= 3frames")
DEPTH = 2


class Writer:
    """Writes one random query; the same seed writes the same."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.names: list[str] = []
        self.edges: list[str] = []

    def text(self) -> str:
        kind = self.rng.random()
        if kind < 0.6:
            return self.pattern()
        return self.sequence() if kind < 0.8 else self.check()

    def pattern(self) -> str:
        using = self.rng.choice(
            ("",) * 8 + ("USING NODES any ", "USING UNKNOWN false ", "USING EGO 'Ego' ")
        )
        if self.rng.random() < 0.08:
            using = f"USING ABSTRACTION {self.rng.choice(('ER', 'EL', 'RSV', 'junction'))} "
        return f"{using}MATCH {self.block(DEPTH)}{self.returned()}"

    def sequence(self) -> str:
        text, parts = f"MATCH {self.block(1)}{self.rng.choice(HOLDS)} AS s0", ["match", "s0"]
        for number in range(1, self.rng.randint(2, 3)):
            nodes = ", ".join(f"({name})" for name in self.names) or "(e:Ego)"
            absent = self.rng.random() < 0.15
            text += f" {self.rng.choice(LINKS)} {'NOT ' * absent}MATCH {nodes}"
            text += f" WHERE {self.condition(1)}"
            text += "" if absent else f"{self.rng.choice(HOLDS)} AS s{number}"
            parts += [] if absent else [f"s{number}", f"s0..s{number}"]
        ends = (
            "",
            "",
            " RETURN trace.name, COUNT(*) AS n",
            " RETURN INTERVALS",
            " RETURN CLIPS(-1s, +1s)",
        )
        over = f" RETURN {self.over(parts)}, {self.rng.choice(('t(s0)', 'INTERVALS'))}"
        ends = (*ends, over, " RETURN FRAMES LIMIT 5", " RETURN t(s0), INTERVALS")
        return text + self.rng.choice(ends)

    def check(self) -> str:
        self.names = self.rng.choice(([], ["v"]))
        head = "FORALL (v:Vehicle) " if self.names else ""
        self.names = [*self.names, "ego"]
        reset = f" RESET WHEN {self.test(0)}" if self.rng.random() < 0.2 else ""
        margin = self.rng.choice(("", " ROBUSTNESS"))
        returned = f" RETURN {self.over(['match'])}" if self.rng.random() < 0.3 else ""
        return f"CHECK c: {head}{self.timed(2)}{reset}{margin}{returned}"

    def over(self, parts: list[str]) -> str:
        """A value over a match, or over a part of it."""
        names = self.names or ["ego"]
        a, b = self.rng.choice(names), self.rng.choice(names)
        operands = f"{a}.speed", f"dist({a}, {b})", f"delta({a}.x, 1s)", f"{a}.speed + {b}.x"
        word = self.rng.choice(("MIN", "MAX", "AVG", "SUM", "FIRST", "LAST", "ARGMIN", "ARGMAX"))
        more = ", frame.seq" if word[:3] == "ARG" and self.rng.random() < 0.5 else ""
        return f"{word}({self.rng.choice(operands)}{more}) OVER {self.rng.choice(parts)} AS o"

    def block(self, depth: int) -> str:
        paths = [self.path(depth) for _ in range(self.rng.choice((1, 1, 2)))]
        where = f" WHERE {self.condition(depth)}" if self.rng.random() < 0.8 else ""
        return ", ".join(paths) + where

    def path(self, depth: int) -> str:
        text = self.node()
        for _ in range(self.rng.choice((0, 1, 1, 2))):
            text += self.edge(depth) + self.node()
        return text

    def node(self) -> str:
        name = self.rng.choice((*"abcd", ""))
        known = name in self.names
        if name and not known:
            self.names.append(name)
        inner = self.rng.choice(("", "", "", f" WHERE {name}.speed > 1")) if name else ""
        return f"({name}{'' if known else self.rng.choice(LABELS)}{'' if known else inner})"

    def edge(self, depth: int) -> str:
        relation = self.rng.choice(RELATIONS)
        name = ""
        if self.rng.random() < 0.2 and "*" not in relation:
            name = f"r{len(self.edges)}_{depth}"
            self.edges.append(name)
        body = name + (f":{relation}" if relation else "")
        return self.rng.choice(("-[{}]->", "<-[{}]-", "-[{}]-")).format(body)

    def condition(self, depth: int) -> str:
        parts = [self.test(depth) for _ in range(self.rng.choice((1, 1, 2, 3)))]
        parts = [f"NOT ({part})" if self.rng.random() < 0.2 else part for part in parts]
        if self.rng.random() < 0.15:
            parts.append(self.timed(1))
        return self.rng.choice((" AND ", " AND ", " OR ")).join(f"({part})" for part in parts)

    def timed(self, depth: int) -> str:
        if depth == 0:
            return self.test(0)
        one, other = (f"({self.timed(depth - 1)})" for _ in range(2))
        bound = self.rng.choice(BOUNDS)
        return self.rng.choice(
            (
                *(
                    f"{word}{bound} {one}"
                    for word in ("ALWAYS", "EVENTUALLY", "ONCE", "HISTORICALLY")
                ),
                *(f"{word} {one}" for word in ("NEXT", "PREVIOUS", "NOT")),
                *(f"{one} {word}{bound} {other}" for word in ("UNTIL", "SINCE")),
                *(f"{one} {word} {other}" for word in ("AND", "IMPLIES")),
            )
        )

    def test(self, depth: int) -> str:
        names = self.names or ["ego"]
        a, b = self.rng.choice(names), self.rng.choice(names)
        sign = self.rng.choice(("<", "<=", ">", ">=", "=", "<>"))
        value = self.rng.choice(("0", "1", "2.5", "10", "45"))
        tests = [
            f"{a}.{self.rng.choice(NUMBERS)} {sign} {value}",
            f"{a}.{self.rng.choice(NUMBERS)} {sign} {b}.{self.rng.choice(NUMBERS)} + {value}",
            f"{a}.{self.rng.choice(TRUTHS)}",
            f"{a}.kind {self.rng.choice(('=', '<>'))} 'car'",
            f"{a}.name =~ '.*1.*'",
            f"{self.rng.choice(PAIRS)}({a}, {b}) {sign} {value}",
            f"{self.rng.choice(PREDICATES)}({a}, {b})",
            f"{self.rng.choice(ALONE)}({a})",
            f"trace.map STARTS WITH '{self.rng.choice(('Town', 'e6', 'f'))}'",
            f"frame.t {sign} {value}",
            f"prev({a}.speed) {sign} {a}.speed",
            f"delta({a}.speed, 1s) {sign} {value}",
            f"{self.rng.choice(WINDOWS)}({a}.speed, {self.rng.choice(('2s', '5frames'))}) {sign} {value}",
            f"robustness({a}.speed {sign} {value} OR {b}.x > {a}.x) > -2",
            f"{self.rng.choice(OF_ONE)}({a}.y) {sign} pow({b}.x, {value})",
            f"{self.rng.choice(NEXT)}({a}) {sign} {value}",
        ]
        if depth and self.rng.random() < 0.35:
            return self.inner(depth, sign)
        if self.edges and self.rng.random() < 0.3:
            edge = self.rng.choice(self.edges)
            tests = [f"type({edge}) = 'near'", f"{edge}.overlap > 0.5", f"{edge}.gap < 20"]
        return self.rng.choice(tests)

    def inner(self, depth: int, sign: str) -> str:
        names, edges = list(self.names), list(self.edges)
        block = self.block(depth - 1)
        new = [name for name in self.names if name not in names]
        self.names, self.edges = names, edges
        if new and self.rng.random() < 0.2:
            word = self.rng.choice(("MIN", "MAX", "AVG", "SUM"))
            return f"{word} {{{block} | {new[0]}.speed}} {sign} 3"
        word = self.rng.choice(("EXISTS", "NOT EXISTS", "COUNT"))
        return f"{word} {{{block}}}" + (f" {sign} 2" if word == "COUNT" else "")

    def returned(self) -> str:
        if self.rng.random() < 0.2:
            return ""
        names = self.names or ["ego"]
        a, b = self.rng.choice(names), self.rng.choice(names)
        plain = [
            *(
                f"{a}.name",
                f"{a}.speed AS v",
                "trace.name",
                "frame.t",
                f"{a}",
                f"{a}.kind",
                "trace.map",
            ),
            *(f"{self.rng.choice(PAIRS)}({a}, {b}) AS q", f"COUNT {{({a})-[:near]->()}} AS n"),
        ]
        counted = [
            "COUNT(*) AS n",
            f"AVG({a}.speed) AS m",
            f"COUNT(DISTINCT {b}) AS d",
            f"MAX({b}.x) AS x",
        ]
        kind = self.rng.random()
        chosen = self.rng.sample(plain, self.rng.choice((1, 2)))
        order = self.rng.choice(("", "", f" ORDER BY {chosen[0].split(' AS ')[-1]} DESC"))
        if kind < 0.3:
            keys = self.rng.sample(plain[:7], self.rng.choice((0, 1, 2)))
            return f" RETURN {', '.join([*keys, *self.rng.sample(counted, 2)])}"
        if kind < 0.5:
            limit = self.rng.choice((" LIMIT 10", " SAMPLE 2 PER trace.name", ""))
            return f" RETURN {self.rng.choice(('', 'DISTINCT '))}{', '.join(chosen)}{order}{limit}"
        form = self.rng.choice(
            ("FRAMES", "INTERVALS", "CLIPS(-1s, +2s)", "SUBGRAPHS LIMIT 20", "*")
        )
        return f" RETURN {chosen[0]}, {form}" if self.rng.random() < 0.5 else f" RETURN {form}"


def documented() -> Iterator[str]:
    """The queries of the README and of the page of the language, and what the library holds."""
    root = Path(__file__).parents[1]
    yield from re.findall(r"```sgql\n(.*?)```", (root / "docs/language.md").read_text(), re.DOTALL)
    for part in re.findall(r"(?:^    .*\n)+", (root / "README.md").read_text(), re.MULTILINE):
        if part.lstrip().startswith(("MATCH", "CHECK")):
            yield re.sub(" -- .*", "", part)
    yield from (one.text for one in patterns().values() if one.kind != "predicate")


def many(path: Path, traces: int = TRACES, frames: int = FRAMES, egos: int = EGOS) -> Store:
    """A store of replicas of the shared recordings."""
    made = list(sources(given(), egos=egos, frames=frames))
    replicate(StoreFile.create(path), made, traces)
    return sgstore.open(path)


def outcome(store: Store, text: str, seconds: float = SECONDS) -> str:
    """How a query ended: ``rows``, ``none``, ``refused`` or ``stopped``; anything else is raised."""
    signal.signal(signal.SIGALRM, _stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        if re.match(r"\s*(USING .*)?CHECK", text):
            found = sum(1 for _ in store.check(text))
        else:
            found = sum(1 for _, _ in zip(store.find(text), range(20_000), strict=False))
    except (QueryError, SqlError):
        return "refused"
    except (_StopError, KeyboardInterrupt):  # the database makes the latter of it
        return "stopped"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return "rows" if found else "none"


class _StopError(Exception):
    """The time of a query is up."""


def _stop(*_: object) -> None:
    raise _StopError


def run(store: Store, first: int, count: int) -> tuple[Counter[str], list[tuple[str, str]]]:
    """Ask so many random queries; how they ended, and the failures."""
    ended: Counter[str] = Counter()
    failures: list[tuple[str, str]] = []
    texts = list(documented()) if first == 0 else []
    texts += [Writer(seed).text() for seed in range(first, first + count)]
    begun = time.monotonic()
    for number, text in enumerate(texts, 1):
        start, problem = time.perf_counter(), ""
        try:
            how = outcome(store, text)
        except Exception as error:  # noqa: BLE001  (whatever it is, it is a failure)
            how, problem = "failed", f"{type(error).__name__}: {error}"[:500]
        spent = time.perf_counter() - start
        if spent > SECONDS + SOON:
            how, problem = "failed", problem or f"ended after {spent:.0f} s, and not when stopped"
        if problem:
            failures.append((text, problem))
            print(f"FAILED {text}\n    {problem}", flush=True)
        elif how == "stopped":
            print(f"stopped after {spent:.0f} s: {' '.join(text.split())}", flush=True)
        ended[how] += 1
        if number % EVERY == 0 or number == len(texts):
            told = ", ".join(f"{many} {name}" for name, many in ended.most_common())
            print(f"{number}/{len(texts)}, {time.monotonic() - begun:.0f} s: {told}", flush=True)
    return ended, failures


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("count", nargs="?", type=int, default=5_000, help="random queries")
    parser.add_argument("--traces", type=int, default=TRACES, help="of a store that is made")
    parser.add_argument("--seed", type=int, default=0, help="the first query")
    parser.add_argument("--store", type=Path, help="asked if it is there, else made and kept")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        path = given.store or Path(name) / "many.sgstore"
        if path.exists():
            store = sgstore.open(path)
        else:
            made = many(path.with_name(f"{path.name}.made"), given.traces)
            made.file.path.rename(path)
            store = sgstore.open(path)
        ((traces, maps),) = store.sql(
            "SELECT count(DISTINCT trace), count(DISTINCT map) FROM frames"
        )
        print(f"{traces} traces on {maps} maps", flush=True)
        assert maps >= MAPS, maps
        ended, failures = run(store, given.seed, given.count)
    stopped = ended["stopped"] / ended.total()
    print(f"{dict(ended)}; {stopped:.1%} stopped, {len(failures)} failed")
    return int(bool(failures) or stopped > STOPPED)


if __name__ == "__main__":
    sys.exit(main())
