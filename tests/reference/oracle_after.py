"""What is done with matches once they are found, by its definition: groups, HAVING, order, LIMIT n PER.

The matches are those of the exhaustive search in :mod:`oracle`. ``python -m oracle_after 5000`` (in this
folder) tries that many random queries on random worlds.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any

from oracle import (
    Edge,
    Search,
    asked,
    assignments,
    identity,
    shown,
    try_each,
)
from oracle_patterns import SIMPLE, Writer

from sgstore.lang.syntax import parse
from sgstore.lang.syntax import tree as s
from sgstore.model.vocabulary import natural

if TYPE_CHECKING:
    from oracle import Binding, Compared
    from oracle_worlds import World

    At = tuple[Search, Binding]

AGGREGATES = {"count", "min", "max", "avg", "sum", "median", "percentile", "stddev", "collect"}


def treated(text: str, world: World) -> list[tuple[Any, ...]]:
    """The rows of a query that returns values, in their order."""
    match = parse(text)[-1]
    assert isinstance(match, s.MatchClause)
    returns = match.returns
    assert returns is not None
    named = {item.name or said(item.value, text): item.value for item in returns.items}
    found = sorted(assignments(match, world), key=place)
    having = [] if returns.having is None else [returns.having]
    if any(is_counted(part) for part in (*named.values(), *having)):
        rows = groups(found, named, returns, text)
    else:
        rows = [Single(search, binding, named) for search, binding in found]
        if returns.distinct:
            rows = list({tuple(row.identities): row for row in rows}.values())
    if returns.distinct or (rows and isinstance(rows[0], Group)):
        rows = ordered(rows, [(value, False) for value in named.values()])
    rows = ordered(rows, [(sort.value, sort.descending) for sort in returns.order])
    if returns.top is not None:
        rows = first_of_each(rows, returns.top)
    end = None if returns.limit is None else returns.skip + returns.limit
    return [row.told for row in rows[returns.skip : end]]


class Single(Search):
    """A match as a row."""

    def __init__(self, search: Search, binding: Binding, named: dict[str, Any]) -> None:
        super().__init__(search.frame, search.graph, search.injective)
        self.named, self.binding = named, binding

    def of(self, e: s.Expression) -> Any:
        """A value of the row, or which entity it is; a name of a result is that result."""
        if isinstance(e, s.Variable) and e.name in self.named:
            e = self.named[e.name]
        return identity(e, self, self.binding)

    @property
    def identities(self) -> list[Any]:
        return [self.of(value) for value in self.named.values()]

    @property
    def told(self) -> tuple[Any, ...]:
        return shown(tuple(self.identities))


class Group(Single):
    """Matches that have the same values in what is not counted, as a row."""

    def __init__(self, members: list[At], named: dict[str, Any], keys: dict[str, Any]) -> None:
        self.named, self.binding, self.members, self.keys = named, {}, members, keys

    def of(self, e: s.Expression) -> Any:
        if isinstance(e, s.Variable) and e.name in self.named:
            e = self.named[e.name]
        return self.value(e, {})

    def value(self, e: s.Expression, binding: Binding) -> Any:
        if isinstance(e, s.Variable) and e.name in self.named and e is not self.named[e.name]:
            return self.value(self.named[e.name], binding)
        if said(e, self.text) in self.keys:
            return self.keys[said(e, self.text)]
        return over(e, self.members) if is_aggregate(e) else super().value(e, binding)

    text = ""


def groups(found: list[At], named: dict[str, Any], returns: s.Returns, text: str) -> list[Single]:
    plain = {said(value, text): value for value in named.values() if not is_counted(value)}
    members: dict[tuple[Any, ...], list[At]] = {} if plain else {(): []}
    for search, binding in found:
        key = tuple(identity(value, search, binding) for value in plain.values())
        members.setdefault(key, []).append((search, binding))
    rows: list[Single] = []
    for key, some in members.items():
        row = Group(some, named, dict(zip(plain, key, strict=True)))
        row.text = text
        if returns.having is None or row.of(returns.having) is True:
            rows.append(row)
    return rows


def said(e: Any, text: str) -> str:
    return " ".join(text[e.span.start : e.span.end].split())


def is_aggregate(e: Any) -> bool:
    if isinstance(e, s.CountAll):
        return True
    name = e.name.lower() if isinstance(e, s.Call) else ""
    return name in AGGREGATES and (name not in {"min", "max"} or len(e.arguments) == 1)


def is_counted(part: Any) -> bool:
    if is_aggregate(part):
        return True
    if isinstance(part, tuple | list):
        return any(map(is_counted, part))
    fields = getattr(part, "__dataclass_fields__", ())
    return any(is_counted(getattr(part, name)) for name in fields)


def over(e: Any, members: list[At]) -> Any:  # noqa: PLR0911 - a case each
    """A value of all matches of a group."""
    if isinstance(e, s.CountAll):
        return len(members)
    values = [identity(e.arguments[0], *at) for at in members]
    known = [value for value in values if value is not None]
    if e.distinct:
        known = list(dict.fromkeys(known))
    name = e.name.lower()
    if name == "count":
        return len(known)
    if name == "collect":
        listed = list(shown(tuple(known)))
        return sorted(listed) if e.distinct else listed
    if not known:
        return 0 if name == "sum" else None
    if name in {"min", "max"}:
        return min(known) if name == "min" else max(known)
    if name in {"sum", "avg"}:
        return math.fsum(known) / (len(known) if name == "avg" else 1)
    if name == "stddev":
        return spread(known)
    share = 50 if name == "median" else e.arguments[1].value
    return quantile(known, share)


def spread(values: list[float]) -> float | None:
    if len(values) < 2:
        return None
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (len(values) - 1))


def quantile(values: list[float], share: float) -> float:
    """The value below which so many per cent lie; between two values in proportion."""
    values = sorted(values)
    at = (len(values) - 1) * share / 100
    low, high = values[math.floor(at)], values[math.ceil(at)]
    return low + (high - low) * (at - math.floor(at))


def place(at: At) -> tuple[Any, ...]:
    """Where a match comes if nothing else is said: by trace, time, and what is bound."""
    search, binding = at
    frame = search.frame
    unnamed = [node for name, node in binding.items() if name[:1] == "#"]
    nodes = [binding[n] for n in sorted(binding) if n.isidentifier() and n != "ego"]
    nodes = [node for node in nodes if not isinstance(node, Edge)]
    return natural(frame.trace.name), frame.seq, unnamed, nodes


def ordered(rows: list[Single], keys: list[tuple[s.Expression, bool]]) -> list[Single]:
    """Rows by some keys, the first of them first; NULL last whatever the direction."""
    for key, descending in reversed(keys):
        values = {id(row): shown((row.of(key),))[0] for row in rows}
        known = [row for row in rows if values[id(row)] is not None]
        known.sort(key=lambda row: values[id(row)], reverse=descending)  # stable either way
        rows = known + [row for row in rows if values[id(row)] is None]
    return rows


def first_of_each(rows: list[Single], top: s.Sample) -> list[Single]:
    seen = Counter[Any]()
    kept: list[Single] = []
    for row in rows:
        value = row.of(top.per)
        seen[value] += 1
        if seen[value] <= top.number:
            kept.append(row)
    return kept


# Random queries -----------------------------------------------------------------------------------


class AfterWriter(Writer):
    """Writes what is done with the matches of a random pattern."""

    def query(self) -> str:
        """A random pattern, or more often one that most frames have."""
        if self.rng.random() < 0.4:
            return super().query()
        text, nodes = self.rng.choice(SIMPLE)
        self.nodes += nodes
        return f"MATCH {text}"

    def after(self) -> str:
        names = [name for name in self.nodes if name != "ego"] or ["ego"]
        a, b = self.rng.choice(names), self.rng.choice(names)
        number = self.rng.choice(("0", "1", "2.5", "101.7"))
        case = self.case(a, b, number)
        keys = [f"{a}.kind", f"{b}.name", "trace.name", f"{a}.is_ego", "frame.seq % 2", case]
        values = [f"{a}.x", f"{b}.y", f"{a}.speed", f"{b}.width", "frame.seq", f"{a}.x - {b}.y"]
        if self.rng.random() < 0.25:
            return self.listed([*keys, *values], names)
        counted = self.counted(values, keys)
        chosen = self.rng.sample(keys, self.rng.choice((0, 1, 1, 2)))
        names = [*(f"k{i}" for i in range(len(chosen)))]
        items = [f"{key} AS {name}" for key, name in zip(chosen, names, strict=True)]
        told = self.rng.sample(counted, self.rng.randint(3, len(counted)))
        items += [f"{value} AS n{i}" for i, value in enumerate(told)]
        if chosen and self.rng.random() < 0.2:
            items.append(f"CASE WHEN COUNT(*) > 1 THEN {chosen[0]} END AS mixed")
        self.rng.shuffle(items)
        items.sort(key=lambda item: "stddev" in item)  # the last bits of one order no rows
        text = f" RETURN {', '.join(items)}"
        if self.rng.random() < 0.8:
            text += f" HAVING {self.having(counted, names)}"
        return text + self.chosen(["COUNT(*)", *names], names)

    def listed(self, values: list[str], names: list[str]) -> str:
        chosen = self.rng.sample(values, 2)
        distinct = self.rng.random() < 0.3
        items = [f"{value} AS r{i}" for i, value in enumerate(chosen)]
        text = f" RETURN {'DISTINCT ' * distinct}{', '.join(items)}"
        per = ["r0", "r1"] if distinct else ["r0", "r1", "trace.name", *names]
        return text + self.chosen(["r0", "r1"], per)

    def chosen(self, orders: list[str], per: list[str]) -> str:
        """``ORDER BY``, ``LIMIT n PER``, ``SKIP``, ``LIMIT``; what they choose depends on no enumeration."""
        text = ""
        if self.rng.random() < 0.5:
            some = self.rng.sample(orders, self.rng.choice((1, min(2, len(orders)))))
            text += " ORDER BY " + ", ".join(k + self.rng.choice(("", " DESC")) for k in some)
        if self.edges:
            return text
        if per and self.rng.random() < 0.7:
            text += f" LIMIT {self.rng.choice('123')} PER {self.rng.choice(per)}"
        if self.rng.random() < 0.6:
            text += f" SKIP {self.rng.choice('0125')}"
        if self.rng.random() < 0.25:
            text += f" LIMIT {self.rng.choice('1359')}"
        return text

    def case(self, a: str, b: str, number: str) -> str:
        return self.rng.choice(
            (
                f"CASE WHEN {a}.speed > {number} THEN 'fast' WHEN {a}.x < {b}.x THEN 'behind' END",
                f"CASE {a}.kind WHEN 'car' THEN 1 WHEN 'person' THEN {b}.width ELSE {number} END",
                f"CASE WHEN {a}.width IS NULL THEN {b}.is_ego ELSE {a}.speed < {number} END",
            )
        )

    def counted(self, values: list[str], keys: list[str]) -> list[str]:
        x, y = self.rng.sample(values, 2)
        # Eighths are exact in binary; in DuckDB 5 % of equal numbers is one bit above them.
        share = self.rng.choice(("0", "12.5", "37.5", "87.5", "100"))
        distinct = self.rng.choice(("", "", "DISTINCT "))
        some = [
            "COUNT(*)",
            f"COUNT({distinct}{x})",
            f"MAX({x}) - MIN({y})",
            f"median({distinct}{x})",
            f"percentile({x}, {share})",
            f"stddev({distinct}{y})",
            f"SUM(CASE WHEN {x} > 1 THEN 1 ELSE 0 END) / COUNT(*)",
            f"AVG({distinct}{x}) + COUNT(*)",
            f"collect(DISTINCT {self.rng.choice([x, keys[0], keys[2]])})",
            f"coalesce(MIN({x}), 0) * 2",
        ]
        return some if self.edges else [*some, f"collect({y})", f"collect({keys[1]})"]

    def having(self, counted: list[str], keys: list[str]) -> str:
        numbers = [one for one in counted if not one.startswith("collect")]
        tests = [
            f"{self.rng.choice(numbers)} {self.rng.choice(('>', '<=', '<>'))} 1.0625",
            f"COUNT(*) >= {self.rng.choice('123')}",
            f"{self.rng.choice(numbers)} IS NOT NULL",
            *(f"{key} IS NOT NULL" for key in keys),
        ]
        return self.rng.choice((" AND ", " OR ")).join(self.rng.sample(tests, 2))


def rounded(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return tuple(map(rounded, value))
    return round(value, 6) + 0.0 if isinstance(value, float) else value


def disagreement_after(text: str, world: World, *, in_order: bool = True) -> tuple[str, int]:
    """What the compiled query and the definition do not agree on; how many rows there are."""
    from sgstore.lang.sql import compile_query

    statement = compile_query(text, world.catalog).rows()
    wanted = [rounded(row) for row in treated(text, world)]
    found = [rounded(row) for row in asked(statement, world)]
    same = found == wanted if in_order else Counter(found) == Counter(wanted)
    return ("" if same else f"found\n{found}\nwanted\n{wanted}"), len(wanted)


ROWS = {
    "HAVING": r"HAVING",
    "of aggregates": r"COUNT\(\*\) \*|MAX\(.*\) - MIN|/ COUNT|\+ COUNT",
    "CASE of rows": r"CASE",
    "median": r"median",
    "percentile": r"percentile",
    "stddev": r"stddev",
    "collect": r"collect",
    "LIMIT n PER": r"LIMIT \d PER",
    "SKIP": r"SKIP",
}
"""Constructs, and how they are told in a query."""


def try_many_after(first: int, count: int) -> Counter[str]:
    """Random queries on random worlds."""

    def made(number: int) -> tuple[str, Compared]:
        writer = AfterWriter(number)
        text = writer.query()
        text += writer.after()
        return text, partial(disagreement_after, text, in_order=not writer.edges)

    return try_each(first, count, made, rows=ROWS)


if __name__ == "__main__":
    print(dict(try_many_after(int((sys.argv[2:] or ["0"])[0]), int(sys.argv[1]))))
