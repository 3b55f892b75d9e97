"""Every newer construct of the language, by all that answers: ``python oracle_constructs.py 5000``.

So many random cases of each are asked of random worlds: of a store (SQL, and columns over time), of graphs in
memory, frame by frame by a monitor, and of an exhaustive definition that shares no code with them. Printed is a
table: who was asked, how many cases there were, which share of them is about something that was found, how many
queries were refused, and the time of the processor. "monitor": a monitor searches the graph of each frame in
memory. "at end": about rows of all traces, which only a store has. "columns": conditions over time are worked
out on columns of a store, beside which tables stand; a monitor has none.

A case is one random expression of the construct, asked of all traces of a world; a query asks several at once.
Names behind the number choose constructs: ``python oracle_constructs.py 5000 UNION HAPPENS``.
"""

from __future__ import annotations

import random
import re
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import oracle_after
import oracle_answers
import oracle_lanes
import oracle_parts
from oracle import REMEMBERED, WORLD
from oracle_over_time import (
    ATOMS,
    BOUNDS,
    PAIRS,
    WINDOWS,
    compare_check,
    compare_expression,
    compare_over_check,
    compare_over_pattern,
    compare_over_sequence,
    over_values,
    random_check,
    short_expression,
    worlds,
)

from sgstore.errors import QueryError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from oracle_worlds import World

    from sgstore.query import Store

    Asked = Callable[[World, Store, random.Random], int | Counter[str]]
    """Asks a query; how much it found, or cases of constructs, and how many of these found something."""

MANY = 24
"""Cases that a query asks at once."""


# Random values ------------------------------------------------------------------------------------

OF_NODES = ("e.speed", "v.speed", "e.x", "v.y", "e.width", "v.length", "frame.t", "v.vx")
OF_PAIRS = ("dist(e, v)", "lat(e, v)", "lon(v, e)", "e.speed - v.speed", "e.x * 0.25 - v.x")
NUMBERS = OF_NODES + OF_PAIRS
LENGTHS = ("0.1s", "0.2s", "0.3s", "0.5s", "1s", "1.4s", "1frames", "2frames", "3frames", "5frames")
EDGES = (
    ("(v:Entity)-[r:follows]->(e:Ego)", ("r.gap",)),
    ("(v:Entity)<-[r:leads]-(e:Ego)", ("r.gap",)),
    ("(e:Ego)-[r:isIn]->(v:Lane)", ("r.overlap", "r.offset")),
)


def over(rng: random.Random, value: str) -> str:
    """A value over the frames of a match, so that a monitor tells it, too."""
    truth = value.endswith("KNOWN") or value.startswith("HAPPENS")
    return f"{rng.choice(('FIRST', 'LAST', 'MIN', 'MAX')[: 2 if truth else 4])}({value}) OVER match"


def window(rng: random.Random, values: tuple[str, ...] = NUMBERS) -> str:
    return f"{rng.choice(sorted(WINDOWS))}({rng.choice(values)}, {rng.choice(LENGTHS)})"


def lately(rng: random.Random, atoms: tuple[str, ...], depth: int) -> str:
    """A condition that looks at no later frame."""
    if depth == 0:
        return rng.choice(atoms)
    one, other = lately(rng, atoms, depth - 1), lately(rng, atoms, depth - 1)
    bound = rng.choice(BOUNDS)
    shapes = [
        f"NOT ({one})",
        f"({one}) AND ({other})",
        f"({one}) OR ({other})",
        f"PREVIOUS ({one})",
    ]
    shapes += [
        f"ONCE{bound} ({one})",
        f"HISTORICALLY{bound} ({one})",
        f"({one}) SINCE{bound} ({other})",
    ]
    return rng.choice(shapes)


def margin(rng: random.Random) -> str:
    sign = rng.choice(("<", "<=", ">", ">=", "=", "<>"))
    compared = tuple(f"{value} {sign} {rng.choice((0, 1, 2.5, 5, 99))}" for value in NUMBERS)
    one, other, third = (rng.choice(compared + ATOMS + PAIRS) for _ in "abc")
    shapes = (one, f"NOT {one}", f"{one} AND {other}", f"({one} OR {other}) AND NOT {third}")
    return f"robustness({rng.choice((*shapes, f'{one} IMPLIES {other}', f'{one} XOR {other}'))})"


def happening(rng: random.Random) -> str:
    """Whether something happens, or did, or since when it has."""
    kinds = ("collision(e, v)", "collision(v, e)", "collision(e)", "collision(v)", "collision()")
    kinds += ("lane_invasion(e)", "lane_invasion(v)", "lane_invasion()", "environment()")
    told = tuple(f"HAPPENS {kind}" for kind in kinds)
    return rng.choice(
        (
            rng.choice(told),
            f"CASE WHEN {lately(rng, told * 2 + ATOMS, rng.choice((0, 1, 1, 2)))} THEN 1 ELSE 0 END",
            f"since_true({rng.choice(told)})",
            f"run_length({rng.choice(told)} OR {rng.choice(ATOMS)})",
            f"CASE WHEN {rng.choice(told)} THEN {rng.choice(NUMBERS)} END",
            f"({rng.choice(told)}) IS KNOWN",
        )
    )


def hops(rng: random.Random) -> str:
    """Whether, or by how many lanes, so many lanes after one another are led to."""
    low = rng.choice((1, 1, 2, 3))
    way = f"[:travelsTo*{low}..{low + rng.choice((0, 1, 2))}]"
    shapes = ("(e)-[:isIn]->(:Lane)-{}->(:Lane)", "(:Lane)<-{}-(:Lane)<-[:isIn]-(v)")
    shapes += (
        "(e)-[:isIn]->(:Lane)-{}->(:Lane)<-[:isIn]-(v)",
        "(v)-[:isIn]->(:Lane)-{}->(:Lane)<-[:isIn]-(e)",
    )
    block = rng.choice(shapes).format(way)
    return rng.choice((f"CASE WHEN EXISTS {{{block}}} THEN 1 ELSE 0 END", f"COUNT {{{block}}}"))


FUNCTIONS = ("sin", "cos", "tan", "exp", "log", "sqrt", "sign", "degrees", "radians", "abs")


def of_numbers(rng: random.Random) -> str:
    """Functions of numbers, in one another, and whether a value is known."""
    one, other = rng.choice(NUMBERS), rng.choice((*NUMBERS, "2", "-0.5", "0"))
    inner = f"{rng.choice(FUNCTIONS)}({one})"
    return rng.choice(
        (
            inner,
            f"{rng.choice(FUNCTIONS)}({inner} / 3 - 0.25)",
            f"{rng.choice(('pow', 'atan2'))}({one}, {other})",
            f"{rng.choice(('pow', 'atan2'))}({inner}, {other} / 7)",
            f"{one} IS KNOWN",
            f"{inner} IS NOT KNOWN",
            f"coalesce({inner}, {other})",
        )
    )


def conditional(rng: random.Random) -> str:
    one, other = (lately(rng, ATOMS + PAIRS, rng.choice((0, 0, 0, 1))) for _ in "ab")
    x, y, z = rng.choice(NUMBERS), rng.choice(NUMBERS), rng.choice((*NUMBERS, "prev(e.x)", "2"))
    otherwise = rng.choice(("", f" ELSE {z}"))
    return f"CASE WHEN {one} THEN {x} WHEN {other} THEN {y}{otherwise} END"


def of_values(value: Callable[[random.Random], str]) -> Asked:
    """Asks for some random values over runs of a random pattern."""

    def asked(world: World, store: Store, rng: random.Random) -> int:
        values = [over(rng, value(rng)) for _ in range(MANY)]
        return compare_over_pattern(world, store, rng, values)

    return asked


def of_edges(world: World, store: Store, rng: random.Random) -> int:
    pattern, values = rng.choice(EDGES)
    asked = [over(rng, window(rng, values)) for _ in range(MANY)]
    return compare_over_pattern(world, store, rng, asked, pattern)


STEPS = {"steps A | B": r" \| ", "steps {m,n}": r"\{\d"}
"""Constructs, and how they are told in an expression of steps."""


def of_steps(world: World, store: Store, rng: random.Random) -> Counter[str]:
    text = short_expression(rng)
    found = compare_expression(world, store, rng, text) > 0
    told = [name for name, sign in STEPS.items() if re.search(sign, text)]
    return Counter(told) + Counter(f"{name} with rows" for name in told if found)


def of_checks(world: World, store: Store, rng: random.Random) -> int:
    return compare_check(world, store, *(random_check(rng) for _ in range(MANY)))


ASKED: dict[str, Asked] = {
    "windows of nodes": of_values(partial(window, values=OF_NODES)),
    "windows of pairs": of_values(partial(window, values=OF_PAIRS)),
    "windows of edges": of_edges,
    "robustness()": of_values(margin),
    "ROBUSTNESS": of_checks,
    "HAPPENS": of_values(happening),
    "functions": of_values(of_numbers),
    "CASE": of_values(conditional),
    "k lane hops": of_values(hops),
}
"""Queries that have so many cases as :data:`MANY` says."""


# The table ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Program:
    """Random queries of some constructs, and who answers them: a store by SQL, memory, a monitor."""

    rows: tuple[str, ...]
    """Names of the constructs."""
    faces: tuple[str, str, str]
    tried: Callable[[int], Counter[str]]
    """What was seen on the world of a number: queries, refused ones, those with rows, and cases of each row."""


def of_store(
    rows: str | Collection[str],
    faces: tuple[str, str, str],
    asked: Asked,
    cases: int,
    **size: int,
) -> Program:
    """Random queries of stores of random worlds of some size, each of so many cases."""
    rows = (rows,) if isinstance(rows, str) else tuple(rows)

    def tried(number: int) -> Counter[str]:
        seen = Counter[str]()
        with tempfile.TemporaryDirectory() as folder:
            world, store = worlds(number, Path(folder), **size)
            rng = random.Random(f"{rows[0]} {number}")
            with store.file.snapshot():
                for _ in range(WORLD if cases == 1 else 50):
                    REMEMBERED.clear()
                    try:
                        found = asked(world, store, rng)
                    except QueryError:
                        seen["refused"] += 1
                        continue
                    seen["tried"] += 1
                    if isinstance(found, Counter):
                        seen.update(found)
                    else:
                        seen[rows[0]] += cases
                        seen[f"{rows[0]} with rows"] += cases * (found > 0)
        return seen

    return Program(rows, faces, tried)


def of_writer(
    faces: tuple[str, str, str],
    rows: dict[str, str],
    try_many: Callable[[int, int], Counter[str]],
) -> Program:
    """Random queries that have several constructs each; what stands in a query is a case of its construct."""

    def tried(number: int) -> Counter[str]:
        return try_many(number * WORLD, WORLD)

    return Program(tuple(rows), faces, tried)


ALL = ("yes", "yes", "yes")
WATCHED = ("yes", "monitor", "yes")
"""A monitor searches the graph of each frame in memory."""
OF_ROWS = ("yes", "at end", "at end")
"""About the rows of all traces, which are known when the last of them has ended: only a store answers."""
OF_TABLES = ("yes", "columns", "no")
"""Tables stand beside a store: conditions over time are read as columns, and a monitor has none."""
SMALL = {"traces": 2, "frames": 7}

PROGRAMS = (
    of_store(
        "over match",
        WATCHED,
        lambda *at: compare_over_pattern(*at, over_values(at[2], [], pair=True, many=MANY)),
        MANY + 1,
    ),
    of_store(
        "over steps",
        WATCHED,
        partial(compare_over_sequence, many=MANY),
        MANY + 1,
    ),
    of_store(
        "over alternatives",
        WATCHED,
        partial(compare_over_sequence, many=MANY, expression=True),
        MANY + 1,
        **SMALL,
    ),
    of_store(
        "over violations",
        WATCHED,
        partial(compare_over_check, many=MANY),
        MANY + 2,
    ),
    *(of_store(name, WATCHED, asked, MANY, **SMALL) for name, asked in ASKED.items()),
    of_store(STEPS, WATCHED, of_steps, 1, **SMALL),
    of_store("MATCH s(v = w)", WATCHED, oracle_answers.of_scenario, 1, **SMALL),
    of_store("second MATCH", WATCHED, oracle_answers.of_second, 1, **SMALL),
    of_store("UNION", WATCHED, oracle_answers.of_union, oracle_answers.POOL, **SMALL),
    of_store("sgql()", OF_ROWS, oracle_answers.of_sql, 2 * oracle_answers.POOL, **SMALL),
    of_store(
        "HAPPENS by table", OF_TABLES, oracle_answers.of_tables, 6 * oracle_answers.POOL, **SMALL
    ),
    of_store(
        "chosen INTERVALS", OF_ROWS, oracle_answers.of_intervals, oracle_answers.POOL, **SMALL
    ),
    of_writer(ALL, oracle_parts.ROWS, oracle_parts.try_many_parts),
    of_writer(OF_ROWS, oracle_after.ROWS, oracle_after.try_many_after),
    Program(oracle_lanes.ROWS, ("yes", "yes", "yes"), oracle_lanes.tried),
)

COLUMNS = (
    "construct",
    "SQL",
    "memory",
    "online",
    "definition",
    "cases",
    "answered",
    "refused",
    "CPU s",
)


def main(count: int, names: Collection[str], first: int) -> None:
    """Try so many cases of some constructs, or of all; print a line for each as soon as it is known."""
    rows = [row for program in PROGRAMS for row in program.rows]
    unknown = [name for name in names if name not in rows]
    if unknown:
        raise SystemExit(f"no construct is called {unknown[0]!r}; there are: {', '.join(rows)}")
    print(LINE.format(*COLUMNS))
    for program in PROGRAMS:
        if names and not set(program.rows) & set(names):
            continue
        seen, number, began = Counter[str](), first, time.process_time()
        while min(seen[name] for name in program.rows) < count:
            seen += program.tried(number)
            number += 1
        spent = time.process_time() - began
        for name in program.rows:
            share = f"{seen[f'{name} with rows'] / seen[name]:.0%}"
            about = seen[name], share, seen["refused"], round(spent)
            print(LINE.format(name, *program.faces, "yes", *about), flush=True)


LINE = "| {:<16} | {:<8} | {:<8} | {:<9} | {:<10} | {:>6} | {:>8} | {:>7} | {:>5} |"

if __name__ == "__main__":
    options = [int(one) for one in sys.argv[1:] if one.isdecimal()]
    main(
        *(options[:1] or [200]),
        [one for one in sys.argv[1:] if not one.isdecimal()],
        *(options[1:] or [0]),
    )
