"""Mutants of correct queries, and how many of them an error or a note reports.

``python -m query_mutants 2000 STORE…`` (in this folder) makes that many mutants and correct queries for
stores of recordings. A mutant has one wrong edge direction, kind, unit or range. Mutants that still match are
queries of their own and do not count. A correct query matches something in its store.
"""

from __future__ import annotations

import random
import re
import sys
from collections import Counter
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import sgstore
from sgstore.errors import SgstoreError
from sgstore.lang.library import patterns

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.query import Store

DOCS = Path(__file__).parents[2] / "docs"
_BLOCK = re.compile(r"```sgql\n(.*?)```", re.DOTALL)
_NODE = r"\((\w*)((?::[\w|&!]+)?)([^()]*)\)"
_EDGE = re.compile(rf"{_NODE}(<?-\[(\w*):(\w+)([^\]]*)\]->?){_NODE}")
_LIMIT = re.compile(
    r"\b(\w+\.(\w+)|(\w+)\(\w+, \w+\))\s*(<=|>=|<|>|=)\s*(-?\d+(?:\.\d+)?)(?![\w.%])"
)

SEVERAL = ("Vehicle", "Person", "Lane", "Junction", "Road", "TrafficLight", "Crosswalk")
WRONG_ENDS = {
    "isIn": (("Lane", "Junction", "TrafficLight"), ("Person", "Junction", "TrafficLight")),
    "controlsTrafficOf": (("Car", "Person", "Lane"), ("Road", "Car", "Junction")),
    "leads": (("Person", "Lane", "TrafficLight"), ("Person", "Lane", "Road")),
    "tows": (("Person", "Lane", "Pole"), ("Person", "Lane", "Road")),
    "travelsTo": (("Road", "Car", "Junction"), ("Road", "Car", "Junction")),
    "near": (("Lane", "Road", "Junction"), ("Lane", "Junction", "OffRoad")),
}
"""Labels that no node at the two ends of a relation can have. Other relations are like these."""
ALIKE = {
    **dict.fromkeys(("mayAffect",), "controlsTrafficOf"),
    **dict.fromkeys(("follows",), "leads"),
    **dict.fromkeys(("laneChange", "opposes", "conflictsWith"), "travelsTo"),
}
ONE_WAY = frozenset({"isIn", "controlsTrafficOf", "mayAffect", "sees", "tows"})
ANGLES = frozenset({"heading", "bearing", "rel_heading", "heading_error", "pitch", "roll"})
SHARES = frozenset({"brake", "throttle", "overlap"})
LENGTHS = frozenset({"dist", "gap", "length", "width", "height", "lon_gap", "lat_gap"})
TIMES = frozenset({"ttc", "headway", "t", "wttc", "ttce", "pet"})
SPEEDS = frozenset({"speed", "speed_limit"})


@dataclass(frozen=True)
class Mutant:
    """Mutant of a query: what was changed, and the text."""

    sort: str
    text: str


def queries_of_docs() -> Iterator[str]:
    """Yield the queries of the pages, and those that name a pattern of the library."""
    for page in sorted(DOCS.glob("*.md")):
        for block in _BLOCK.findall(page.read_text()):
            yield block.strip()
    for pattern in patterns():
        yield f"MATCH {pattern}()"


def mutants(text: str, rng: random.Random) -> Iterator[Mutant]:
    """Yield the mutants of a query, in random order."""
    found = [*_turned(text), *_of_kinds(text, rng), *_of_limits(text, rng)]
    rng.shuffle(found)
    yield from found


def _turned(text: str) -> Iterator[Mutant]:
    for edge in _EDGE.finditer(text):
        arrow, relation = edge[4], edge[6]
        if (
            relation in ONE_WAY
            and "*" not in edge[7]
            and arrow.startswith("<") != arrow.endswith(">")
        ):
            turned = f"-{arrow[2:]}>" if arrow.startswith("<") else f"<{arrow[:-1]}"
            yield Mutant("direction", text[: edge.start(4)] + turned + text[edge.end(4) :])


def _of_kinds(text: str, rng: random.Random) -> Iterator[Mutant]:
    for edge in _EDGE.finditer(text):
        relation, backward = edge[6], edge[4].startswith("<")
        ends = WRONG_ENDS[relation if relation in WRONG_ENDS else ALIKE.get(relation, "near")]
        for group, end in ((2, ends[backward]), (9, ends[not backward])):
            if edge[group] and "*" not in edge[7]:
                wrong = f":{rng.choice(end)}"
                yield Mutant("kind", text[: edge.start(group)] + wrong + text[edge.end(group) :])
    for node in re.finditer(r"\((\w+):(Vehicle|Car|Person|Lane)\)", text):
        wrong = rng.choice([k for k in ("person", "lane", "car") if k != node[2].lower()])
        if node[2] == "Vehicle" and wrong == "car":
            wrong = "person"
        changed = f"({node[1]}:{node[2]} WHERE {node[1]}.kind = '{wrong}')"
        yield Mutant("kind", text[: node.start()] + changed + text[node.end() :])


def _of_limits(text: str, rng: random.Random) -> Iterator[Mutant]:
    for limit in _LIMIT.finditer(text):
        name, sign, value = limit[2] or limit[3], limit[4], float(limit[5])
        for sort, number in _wrong_numbers(name, sign, value, rng):
            yield Mutant(sort, f"{text[: limit.start(5)]}{number:.6g}{text[limit.end(5) :]}")


def _wrong_numbers(
    name: str, sign: str, value: float, rng: random.Random
) -> Iterator[tuple[str, float]]:
    upward = sign in {">", ">=", "="}
    if name in ANGLES:
        yield "range", rng.choice((190.0, 200.0, 270.0, 359.0)) * (1 if upward else -1)
        if upward and value:
            yield "unit", value * 57.2958
    elif name in SHARES:
        yield "range", 1.5 if upward else -0.5
        yield "unit", 100 * value if upward and value > 0 else 50.0
    elif name in SPEEDS | LENGTHS | TIMES:
        if not upward:
            yield "range", -1.0 - abs(value)
        elif value > 0:
            yield "unit", value * (3.6 if name in SPEEDS else 1000)


def random_query(rng: random.Random, store: Store) -> str:
    """Return a random query about things that a store has."""
    catalog = store.catalog()
    triples = sorted({**catalog.edges, **catalog.map_edges})
    first = rng.choice(triples)
    a, b = (_label(kind, rng) for kind in first[1:])
    text = f"MATCH (a{a})-[:{first[0]}]->(b{b})"
    more = [t for t in triples if t[1] == first[2]]
    if more and rng.random() < 0.4:
        second = rng.choice(more)
        text += f", (b)-[:{second[0]}]->(c{_label(second[2], rng)})"
    tests = [*_tests("a", first[1], rng), *_tests("b", first[2], rng)]
    if first[1] not in MAPPED and first[2] not in MAPPED:
        number = rng.choice(("dist", "gap", "lon_gap", "ttc", "headway"))
        tests.append(f"{number}(a, b) {rng.choice('<>')} {rng.choice((2, 5, 10, 20))}")
        tests.append(f"bearing(a, b) > {rng.choice((-90, 0, 45))}")
    chosen = rng.sample(tests, min(len(tests), rng.choice((0, 1, 1, 2))))
    if chosen:
        text += f" WHERE {' AND '.join(chosen)}"
    if rng.random() < 0.2:
        text += f"{' AND' if chosen else ' WHERE'} NOT EXISTS {{(b)-[:near]->(:Person)}}"
    return text


MAPPED = frozenset({"lane", "road", "junction", "crosswalk", "off_road", "roundabout"})


def _label(kind: str, rng: random.Random) -> str:
    vehicle = kind in {"car", "truck", "van", "bus", "motorcycle", "bicycle", "trailer"}
    camel = "".join(part.capitalize() for part in kind.split("_"))
    return f":{'Vehicle' if vehicle and rng.random() < 0.5 else camel}"


def _tests(name: str, kind: str, rng: random.Random) -> Iterator[str]:
    if kind in MAPPED:
        if kind == "lane":
            yield f"{name}.length > {rng.choice((5, 20, 50))}"
            yield f"{name}.speed_limit < {rng.choice((9, 15, 30))}"
        return
    yield f"{name}.speed > {rng.choice((0, 1, 5, 8))}"
    yield f"{name}.speed < {rng.choice((5, 10, 20))}"
    yield f"{name}.heading {rng.choice('<>')} {rng.choice((-90, 0, 45, 90))}"
    yield f"{name}.length > {rng.choice((0.3, 2, 4))}"


@dataclass
class Figures:
    """Counts of mutants by sort, and of correct queries with a false note."""

    reported: Counter[str]
    silent: list[Mutant]
    noted: list[tuple[str, tuple[str, ...]]]
    correct: int = 0

    def __str__(self) -> str:
        of = Counter(one.sort for one in self.silent)
        lines = [
            f"{sort:10} {self.reported[sort]:5} of {self.reported[sort] + of[sort]:5} reported"
            for sort in ("direction", "kind", "unit", "range")
        ]
        all_of = self.reported.total() + len(self.silent)
        share = self.reported.total() / max(all_of, 1)
        lines.append(f"{'mutants':10} {self.reported.total():5} of {all_of:5}: {share:.1%}")
        false = len(self.noted) / max(self.correct, 1)
        lines.append(
            f"{'correct':10} {len(self.noted):5} of {self.correct:5} with a note: {false:.2%}"
        )
        return "\n".join(lines)


def matches_something(text: str, store: Store) -> bool:
    """True if a query has a match, or a check has a verdict."""
    if text.lstrip().upper().startswith("CHECK"):
        return any(True for _ in store.check(text))
    return bool(store.find(text).limit(1).rows())


def measured(stores: Sequence[Store], mutant_count: int, correct_count: int, seed: int) -> Figures:
    """Return the figures of so many mutants and correct queries of some stores."""
    rng, figures = random.Random(seed), Figures(Counter(), [], [])
    fixed = [(text, store) for text in queries_of_docs() for store in stores]
    rng.shuffle(fixed)
    for text, store in _endless(fixed, rng, stores):
        many = figures.reported.total() + len(figures.silent)
        if many >= mutant_count and figures.correct >= correct_count:
            return figures
        try:
            if not matches_something(text, store):
                continue
            if figures.correct < correct_count:
                figures.correct += 1
                if notes := _notes(text, store):
                    figures.noted.append((text, notes))
        except SgstoreError:
            continue
        for mutant in islice(mutants(text, rng), 4 if many < mutant_count else 0):
            _judge(mutant, store, figures)
    return figures


def _endless(
    fixed: Sequence[tuple[str, Store]], rng: random.Random, stores: Sequence[Store]
) -> Iterator[tuple[str, Store]]:
    for one in fixed:
        yield one
        for _ in range(3):
            store = rng.choice(stores)
            yield random_query(rng, store), store
    while True:
        store = rng.choice(stores)
        yield random_query(rng, store), store


def _notes(text: str, store: Store) -> tuple[str, ...]:
    if text.lstrip().upper().startswith("CHECK"):
        return store.check(text).notes
    return store.find(text).notes


def _judge(mutant: Mutant, store: Store, figures: Figures) -> None:
    """Count a mutant, unless it still matches something."""
    check = mutant.text.lstrip().upper().startswith("CHECK")
    try:
        if (not check and matches_something(mutant.text, store)) or (
            check and mutant.sort == "unit"
        ):
            return
        reported = bool(_notes(mutant.text, store))
    except SgstoreError:
        reported = True
    if reported:
        figures.reported[mutant.sort] += 1
    else:
        figures.silent.append(mutant)


if __name__ == "__main__":
    made = measured([sgstore.open(path) for path in sys.argv[2:]], *[int(sys.argv[1])] * 2, 7)
    print(made)
    for silent in made.silent[:40]:
        print("\nSILENT", silent.sort, silent.text)
    for query, notes in made.noted[:40]:
        print("\nNOTED", query, *notes, sep="\n   ")
