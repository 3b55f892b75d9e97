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
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from oracle import REMEMBERED, answer, returned, rounded
from oracle_over_time import compare_sequence, random_sequence, worlds
from oracle_parts import lenient, online, online_of
from oracle_patterns import SIMPLE, Writer

from sgstore.errors import QueryError

if TYPE_CHECKING:
    from collections.abc import Callable

    from oracle_worlds import World

    from sgstore.query import Store

Rows = Counter[tuple[Any, ...]]
POOL = 5
"""Queries of which a case takes some."""


def bare_queries(store: Store, rng: random.Random) -> tuple[list[str], list[str]]:
    """Some queries, and what follows ``MATCH`` so that they return columns of the same names and types."""
    kinds = rng.sample(("{}.kind", "{}.x", "frame.seq", "trace.name", "{}.speed", "{}.is_ego"), 2)
    bare: list[str] = []
    returns: list[str] = []
    while len(bare) < POOL:
        writer = Writer(rng.randrange(10**9))
        text, names = writer.query(), writer.nodes
        if rng.random() < 0.5:
            simple, names = rng.choice(SIMPLE)
            text = f"MATCH {simple}"
        text, name = lenient(text), rng.choice(names or ["ego"])
        told = ", ".join(f"{kind.format(name)} AS k{i}" for i, kind in enumerate(kinds))
        with suppress(QueryError):
            store.find(f"{text} RETURN {told}")
            bare.append(text)
            returns.append(f"{text} RETURN {told}")
    return bare, returns


def rows_of(text: str, world: World) -> Rows:
    return rounded(returned(text, world))


def seen(rows: Any) -> Rows:
    return rounded(Counter(tuple(row) for row in rows))


def of_union(world: World, store: Store, rng: random.Random) -> Counter[str]:
    """Rows of some queries: each once, or all of them; a monitor watches all."""
    bare, texts = bare_queries(store, rng)
    wanted = [rows_of(text, world) for text in texts]
    told = Counter[str]()
    for _ in range(POOL):
        some = rng.sample(range(POOL), rng.choice((2, 2, 3)))
        every = sum((wanted[n] for n in some), Rows())
        text = " UNION ALL ".join(texts[n] for n in some)
        assert seen(store.find(text)) == every, text
        text = " UNION ".join(texts[n] for n in some)
        assert seen(store.find(text)) == Counter(dict.fromkeys(every, 1)), text
        told += Counter({"UNION": 1, "UNION with rows": int(bool(every))})
    problem, _ = online_of(
        [text.replace("UNKNOWN false, ", "").replace("USING UNKNOWN false ", "") for text in bare],
        world,
    )
    assert not problem, (bare, problem)
    return told


def of_sql(world: World, store: Store, rng: random.Random) -> Counter[str]:
    """Queries as tables, alone and joined with another one."""
    _, texts = bare_queries(store, rng)
    wanted = [rows_of(text, world) for text in texts]
    told = Counter[str]()
    for text, rows in zip(texts, wanted, strict=True):
        assert seen(store.sql(f"SELECT * FROM sgql($${text}$$)").values) == rows, text
        told += Counter({"sgql()": 1, "sgql() with rows": int(bool(rows))})
    for _ in range(POOL):
        one, other = rng.sample(range(POOL), 2)
        quoted = texts[other].replace("'", "''")
        asked = f"SELECT s.k0, t.k1 FROM sgql($${texts[one]}$$) AS s JOIN sgql('{quoted}') AS t ON s.k0 = t.k0"
        joined = Rows()
        for (k, _), many in wanted[one].items():
            for (same, last), more in wanted[other].items():
                joined[k, last] += many * more * (k is not None and k == same)
        assert seen(store.sql(asked).values) == +joined, asked
        told += Counter({"sgql()": 1, "sgql() with rows": int(bool(+joined))})
    return told


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


CONSTRUCTS: dict[str, Callable[[World, Store, random.Random], Any]] = {
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
                    told[f"{name} with rows"] += bool(rows)
    return told


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    with tempfile.TemporaryDirectory() as made:
        print(dict(run(range(first, first + -(-number // 50)), 50, Path(made))))
