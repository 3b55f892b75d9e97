"""What a store answers to several queries at once, by their definition: ``python oracle_answers.py 5000``.

``UNION``, ``sgql('…')`` in SQL, a second ``MATCH``, scenarios whose variables get other names, what happens by
tables of one's own, and intervals that are chosen. The rows of each query are those of the exhaustive search in
:mod:`oracle`, or of the sequences in :mod:`oracle_over_time`.
"""

from __future__ import annotations

import random
import re
import sys
import tempfile
from collections import Counter
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import polars as pl
from oracle import REMEMBERED, answer, compare, returned, rounded
from oracle_over_time import (
    ATOMS,
    BOUNDS,
    PAIRS,
    Told,
    compare_sequence,
    compare_values,
    periods,
    random_sequence,
    worlds,
)
from oracle_parts import lenient, online, online_of
from oracle_patterns import SIMPLE, Writer

import sgstore
from sgstore.errors import QueryError
from sgstore.model.vocabulary import natural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from oracle_worlds import Frame, World

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


# Tables of one's own --------------------------------------------------------------------------------

Happened = tuple[str, int | None, int | None]


@contextmanager
def with_tables(world: World, store: Store, rng: random.Random) -> Iterator[Store]:
    """A store beside which stand random tables of what happened; the frames of the world tell it, too."""
    told: list[tuple[Frame, Happened]] = []
    tables: dict[str, dict[str, list[Any]]] = {}
    for kind, (a, b) in TABLES.items():
        by = rng.choice(("seq", "time_ns", "frame_id"))
        rows: dict[str, list[Any]] = {name: [] for name in ("trace", by, a, b) if name}
        for trace in world.traces:
            ids = {node: about["ident"] for node, about in trace.entities.items()}
            for frame in trace.frames:
                for _ in range(rng.choice((0, 0, 1, 2))):
                    one, other = (rng.choice([*ids, None]) if end else None for end in (a, b))
                    told.append((frame, (kind, one, other)))
                    place = {"frame_id": frame.frame_id, "seq": frame.seq}
                    # A frame is the nearest one up to half a period away.
                    place["time_ns"] = frame.time_ns + rng.randint(-40_000_000, 40_000_000)
                    known = {"trace": trace.name, by: place[by]}
                    known |= {
                        name: ids.get(node) if "ident" in name else node
                        for name, node in ((a, one), (b, other))
                        if name
                    }
                    for name, values in rows.items():
                        values.append(known[name])
        types = {
            name: pl.String if "ident" in name or name == "trace" else pl.Int64 for name in rows
        }
        tables[kind] = pl.DataFrame(rows, schema=types)  # type: ignore[assignment]
    for frame, event in told:
        frame.events.append(event)
    for trace in world.traces:
        trace.records |= TABLES.keys()
    try:
        yield sgstore.open(store.file.path, tables=tables)
    finally:
        for frame, event in told:
            frame.events.remove(event)
        for trace in world.traces:
            trace.records -= TABLES.keys()


TABLES = {"takeover": ("node_id", "other"), "named": ("ident", "other_ident"), "noted": ("", "")}
"""Tables, and their columns of those to whom it happens."""
OF_TABLES = tuple(
    f"HAPPENS {kind}({nodes})"
    for kind, (_, other) in TABLES.items()
    for nodes in (("e, v", "v, e", "e", "v", "") if other else ("",))
)


def of_tables(world: World, store: Store, rng: random.Random) -> Counter[str]:
    """Conditions on what happens by tables of one's own, now and over time, as values and behind WHERE."""

    def told(depth: int) -> str:
        if depth == 0:
            return rng.choice(OF_TABLES * 3 + ATOMS + PAIRS)
        one, other, bound = told(depth - 1), told(depth - 1), rng.choice(BOUNDS)
        shapes = (f"NOT ({one})", f"({one}) AND ({other})", f"({one}) OR ({other})")
        shapes += tuple(f"{word}{bound} ({one})" for word in ("ALWAYS", "EVENTUALLY", "ONCE"))
        shapes += (f"NEXT ({one})", f"({one}) UNTIL{bound} ({other})", f"PREVIOUS ({one})")
        return rng.choice((*shapes, f"({one}) SINCE{bound} ({other})"))

    def value() -> str:
        happens = rng.choice(OF_TABLES)
        shapes = (
            happens,
            f"since_true({happens})",
            f"run_length({happens})",
            f"({happens}) IS KNOWN",
        )
        return rng.choice((*shapes, f"CASE WHEN {told(1)} THEN 1 ELSE 0 END", told(2)))

    many = 6 * POOL
    with with_tables(world, store, rng) as joined:
        values = [value() for _ in range(many)]
        rows = compare_values(world, joined, told(rng.choice((0, 1))), values)
    return Counter({"HAPPENS by table": many, "HAPPENS by table with rows": many * (rows > 0)})


# Intervals that are chosen --------------------------------------------------------------------------


def of_intervals(world: World, store: Store, rng: random.Random) -> Counter[str]:
    """Intervals behind HAVING, in an order, the first of each, some left out."""
    simple, names = rng.choice(SIMPLE)
    kinds = rng.sample(("{}.kind", "{}.is_ego", "{}", "{}.speed > 2"), rng.choice((0, 1, 2)))
    keys = [kind.format(rng.choice(names)) for kind in kinds]
    items = "".join(f"{key} AS k{i}, " for i, key in enumerate(keys))
    bare = f"USING UNKNOWN false MATCH {simple}"
    plain = returned(f"{bare} RETURN DISTINCT {items}frame.id", world)
    nodes = [f"k{i}" for i, kind in enumerate(kinds) if kind == "{}"]
    spans = intervals_of(world, plain, periods(store), nodes)
    told = Counter[str]()
    for _ in range(POOL):
        text, wanted = chosen_of(spans, [f"k{i}" for i in range(len(keys))], rng)
        found = store.find(f"{bare} RETURN {items}INTERVALS{text}")
        place = [found.columns.index(name) for name in ("trace", "start_seq", "end_seq")]
        place += [found.columns.index(f"k{i}") for i in range(len(keys))]
        rows = [tuple(row[i] for i in place) for row in found]
        assert rows == wanted, (bare, items, text, rows, wanted)
        told += Counter({"chosen INTERVALS": 1, "chosen INTERVALS with rows": int(bool(rows))})
    return told


def intervals_of(
    world: World, rows: Iterable[Any], period: dict[str, int], nodes: list[str]
) -> list[dict[str, Any]]:
    """The runs of frames in which values stay the same; of a row the id of its frame comes last."""
    frames: dict[Any, set[int]] = {}
    place = {f.frame_id: (n, i) for n, t in enumerate(world.traces) for i, f in enumerate(t.frames)}
    for *values, frame_id in rows:
        number, i = place[frame_id]
        frames.setdefault((number, *values), set()).add(i)
    found: list[dict[str, Any]] = []
    clocks = [Told(trace, period[trace.name]) for trace in world.traces]
    for (number, *values), some in frames.items():
        told = clocks[number]
        for run in told.runs(some):
            first, last = told.frames[run[0]], told.frames[run[-1]]
            seqs = {"start_seq": first.seq, "end_seq": last.seq, "frames": len(run)}
            seconds = {"start": told.seconds(run[0]), "end": told.seconds(run[-1])}
            keys = {f"k{n}": value for n, value in enumerate(values)}
            whose = {f"{name} of": told.trace.owner(keys[name]) for name in nodes}
            found.append({"trace": told.trace.name, **seqs, **seconds, **keys, **whose})
    return found


def chosen_of(
    spans: list[dict[str, Any]], keys: list[str], rng: random.Random
) -> tuple[str, list[tuple[Any, ...]]]:
    """What stands behind ``INTERVALS``, and the intervals that it leaves: trace, both ends, values."""
    text, rows = "", [*spans]
    if rng.random() < 0.7:
        name, sign = (
            rng.choice(("frames", "start", "end", "end_seq")),
            rng.choice((">=", "<", "<>")),
        )
        least = rng.choice((1, 2, 3, 0.3))
        text += f" HAVING {name} {sign} {least}"
        rows = [row for row in rows if compare(sign, row[name], least)]
    rows = in_order(rows, [("trace", False), ("start", False), *((k, False) for k in keys)])
    if rng.random() < 0.6:
        order = [(rng.choice(("frames", "start", "end", *keys)), rng.random() < 0.5)]
        order += [("frames", False)] * (rng.random() < 0.3 and order[0][0] != "frames")
        text += " ORDER BY " + ", ".join(f"{name}{' DESC' * down}" for name, down in order)
        rows = in_order(rows, order)
    if rng.random() < 0.5:
        per, least = rng.choice(("trace", *keys)), rng.choice((1, 2))
        text += f" LIMIT {least} PER {per}"
        met = Counter[Any]()
        kept = []
        for row in rows:
            one = row[per], row.get(f"{per} of")
            met[one] += 1
            kept += [row] if met[one] <= least else []
        rows = kept
    skip, limit = rng.choice((0, 0, 1, 2)), rng.choice((None, None, 1, 3))
    text += f" SKIP {skip}" * (skip > 0) + (f" LIMIT {limit}" if limit else "")
    rows = rows[skip : None if limit is None else skip + limit]
    return text, [tuple(row[n] for n in ("trace", "start_seq", "end_seq", *keys)) for row in rows]


def in_order(rows: list[dict[str, Any]], order: list[tuple[str, bool]]) -> list[dict[str, Any]]:
    """Rows by some columns, the first of them first; NULL last, and traces as people count."""

    def shown(row: dict[str, Any], name: str) -> Any:
        return natural(row[name]) if name == "trace" else row[name]

    for name, down in reversed(order):
        known = [row for row in rows if row[name] is not None]
        known.sort(key=lambda row: shown(row, name), reverse=down)
        rows = known + [row for row in rows if row[name] is None]
    return rows


CONSTRUCTS: dict[str, Callable[[World, Store, random.Random], Any]] = {
    "union": of_union,
    "sql": of_sql,
    "second": of_second,
    "scenario": of_scenario,
    "tables": of_tables,
    "intervals": of_intervals,
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
