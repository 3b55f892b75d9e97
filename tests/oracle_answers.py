"""What a store answers to several queries at once, by their definition: ``python oracle_answers.py 5000``.

``UNION``, ``sgql('…')`` in SQL, a second ``MATCH``, and scenarios whose variables get other names. The rows of
each query are those of the exhaustive search in :mod:`oracle`, or of the sequences in :mod:`oracle_over_time`.
"""

from __future__ import annotations

import random
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from oracle import REMEMBERED, answer, returned, rounded
from oracle_over_time import compare_sequence, random_sequence, worlds
from oracle_parts import online
from oracle_patterns import Writer

from sgstore.errors import QueryError

if TYPE_CHECKING:
    from collections.abc import Callable

    from oracle_worlds import World

    from sgstore.query import Store

Rows = Counter[tuple[Any, ...]]


def two_queries(rng: random.Random) -> list[str]:
    """Queries that return columns of the same names and types."""
    kinds = rng.sample(("{}.kind", "{}.x", "frame.seq", "trace.name", "{}.speed", "{}.is_ego"), 2)
    made: list[str] = []
    for _ in range(2):
        writer = Writer(rng.randrange(10**9))
        text = lenient(writer.query())
        name = rng.choice(writer.nodes or ["ego"])
        made.append(
            f"{text} RETURN " + ", ".join(f"{k.format(name)} AS k{i}" for i, k in enumerate(kinds))
        )
    return made


def lenient(text: str) -> str:
    """A query of which no trace is left out."""
    start, using, rest = text.partition("USING ")
    return f"USING UNKNOWN false, {rest}" if using else f"USING UNKNOWN false {start}"


def rows_of(text: str, world: World) -> Rows:
    return rounded(returned(text, world))


def seen(rows: Any) -> Rows:
    return rounded(Counter(tuple(row) for row in rows))


def of_union(world: World, store: Store, rng: random.Random) -> int:
    """Rows of both: each once, or all of them."""
    one, other = two_queries(rng)
    both = rows_of(one, world) + rows_of(other, world)
    assert seen(store.find(f"{one} UNION ALL {other}")) == both, (one, other)
    once = Counter(dict.fromkeys(both, 1))
    assert seen(store.find(f"{one} UNION {other}")) == once, (one, other)
    return len(both)


def of_sql(world: World, store: Store, rng: random.Random) -> int:
    """A query as a table, alone and joined with another one."""
    one, other = two_queries(rng)
    left, right = rows_of(one, world), rows_of(other, world)
    assert seen(store.sql(f"SELECT * FROM sgql($${one}$$)").values) == left, one
    quoted = other.replace("'", "''")
    asked = f"SELECT s.k0, t.k1 FROM sgql($${one}$$) AS s JOIN sgql('{quoted}') AS t ON s.k0 = t.k0"
    wanted = Rows()
    for (k, _), many in left.items():
        for (same, last), more in right.items():
            wanted[k, last] += many * more * (k is not None and k == same)
    assert seen(store.sql(asked).values) == +wanted, asked
    return len(left)


def of_second(world: World, store: Store, rng: random.Random) -> int:
    """Two patterns of one frame, which are one pattern with both conditions."""
    writer = Writer(rng.randrange(10**9))
    paths, tests = [], []
    for _ in range(2):
        paths.append(writer.path("abc", rng.choice((1, 2)), 2))
        tests.append(writer.condition(2) if rng.random() < 0.6 else "")
    where = [f" WHERE {one}" if one else "" for one in tests]
    apart = f"USING UNKNOWN false MATCH {paths[0]}{where[0]} MATCH {paths[1]}{where[1]}"
    both = " AND ".join(f"({one})" for one in tests if one)
    wanted, frames = answer(
        f"USING UNKNOWN false MATCH {', '.join(paths)}{' WHERE ' * bool(both)}{both}", world
    )
    found = store.find(apart)
    names = [n for n in found.columns[5:] if not n.endswith(".name") and n != "ego"]
    keep = [0, *(found.columns.index(name) for name in sorted(names))]
    assert Counter(tuple(row[i] for i in keep) for row in found) == wanted, apart
    assert found.count() == len(frames), apart
    problem, _ = online(apart.removeprefix("USING UNKNOWN false "), world)
    assert not problem, (apart, problem)
    return len(wanted)


def of_scenario(world: World, store: Store, rng: random.Random) -> int:
    """A scenario whose variables have other names is the sequence that is written with them."""
    text = random_sequence(rng)
    names = {name: rng.choice((name, f"{name}2")) for name in "evw"}
    renamed = re.sub(r"\b[evw]\b(?!:)", lambda found: names[found[0]], text)
    renamed = re.sub(r"\b([evw])(?=:[A-Z])", lambda found: names[found[0]], renamed)
    given = (f"{name} = {new}" for name, new in names.items() if f"({name}" in text and name != new)
    called = f"DEFINE SCENARIO s() AS {text}; {{}}MATCH s({', '.join(given)})"
    return compare_sequence(world, store, renamed, rng.choice(("all", "first", "longest")), called)


CONSTRUCTS: dict[str, Callable[[World, Store, random.Random], int]] = {
    "union": of_union,
    "sql": of_sql,
    "second": of_second,
    "scenario": of_scenario,
}


def run(seeds: range, questions: int, folder: Path) -> Counter[str]:
    """Ask so many questions of each kind of each of some worlds; how many were asked, and found something."""
    told = Counter[str]()
    for seed in seeds:
        world, store = worlds(seed, folder, traces=2, frames=4)
        rng = random.Random(f"answers {seed}")
        with store.file.snapshot():
            for name, construct in CONSTRUCTS.items():
                for _ in range(questions):
                    REMEMBERED.clear()
                    try:
                        rows = construct(world, store, rng)
                    except QueryError:
                        told[f"{name} refused"] += 1
                        continue
                    told[name] += 1
                    told[f"{name} with rows"] += rows > 0
    return told


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    with tempfile.TemporaryDirectory() as made:
        print(dict(run(range(first, first + -(-number // 50)), 50, Path(made))))
