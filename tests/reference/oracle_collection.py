"""One store against collections of it: random questions have the same rows in the same order.

``python -m oracle_collection 1000`` (in this folder) asks that many, of collections of 1, 3 and 20 bundles;
``python -m oracle_collection 1000 ray`` by an engine, ``python -m oracle_collection 1000 local+ray 3`` by two,
of 3 bundles, ``python -m oracle_collection 500:1000 ray`` the second half of them. At the end it says how many
questions there were of each sort, and how many of these had an answer.

What is right is what one store says: it is held against exhaustive search in :mod:`oracle`, :mod:`oracle_after`
and :mod:`oracle_over_time`.
"""

from __future__ import annotations

import math
import random
import re
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from oracle_after import AfterWriter
from oracle_over_time import over_values, random_check, random_expression, random_sequence
from oracle_parts import PartsWriter
from oracle_worlds import random_world

from sgstore.collection import Collection, pack
from sgstore.errors import QueryError
from sgstore.query import Store
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    import duckdb

    Asked = tuple[Store, list[Collection]]
    """A store, and collections that hold the same."""

TRACES = 20
BUNDLES = (1, 3, 20)
QUESTIONS = 100
"""Questions that are asked of one world."""


EXPRESSED = (
    "",
    " RETURN INTERVALS",
    " RETURN trace.name, COUNT(*)",
    " RETURN FRAMES LIMIT 5",
    " LIMIT 4",
)
"""What may end a question whose steps have alternatives or are repeated."""


class CollectionWriter(AfterWriter):
    """Writes a question of any form."""

    def text(self) -> str:
        shapes = {
            0.12: lambda: self.settings(check=True) + self.check(),
            0.25: lambda: self.settings() + random_sequence(self.rng) + self.ended(),
            0.30: lambda: self.settings() + self.over_match(),
            0.33: lambda: (
                self.settings() + random_expression(self.rng) + self.rng.choice(EXPRESSED)
            ),
            0.40: self.union,
            0.52: self.in_parts,
            0.57: lambda: self.settings() + self.of_classes(),
            0.64: self.beside,
            1.00: self.pattern,
        }
        roll = self.rng.random()
        return next(shape() for below, shape in shapes.items() if roll < below)

    def pattern(self) -> str:
        """A question about single frames, with values, or in another form."""
        text = self.query()
        if not text.startswith("USING"):
            text = self.settings() + text
        roll = self.rng.random()
        if roll < 0.4:
            return text + self.after()
        return text + (self.values() if roll < 0.75 else self.form())

    def beside(self) -> str:
        """A question about tables of a user's own, which stand beside the store."""
        score, label = self.rng.choice((2, 5, 8)), self.rng.choice(("good", "bad"))
        happened = "EVENTUALLY[0s, 1s] HAPPENS takeover(e)"
        tests = [f"labels.score > {score}", f"labels.label = '{label}'", "labels.label IS NULL"]
        tests += [f"NOT labels.score < {score}", "HAPPENS takeover(v)", "HAPPENS takeover()"]
        test = self.rng.choice(tests)
        if self.rng.random() < 0.25:
            formula = test.replace("(v)", "(ego)")
            return f"CHECK c: {self.rng.choice(('ALWAYS', 'EVENTUALLY'))} ({formula})"
        if self.rng.random() < 0.2:
            return f"MATCH (e:Ego) WHERE {happened} RETURN trace.name, COUNT(*)"
        told = ["labels.label, COUNT(*), AVG(labels.score)", "FRAMES, v", "INTERVALS", "v"]
        told += ["v, labels.score ORDER BY labels.score DESC LIMIT 5", "DISTINCT labels.label"]
        told += ["trace.name, MAX(labels.score)", "v.kind, labels.label SAMPLE 3 PER labels.label"]
        return f"MATCH (v:Entity) WHERE {test} RETURN {self.rng.choice(told)}"

    def check(self) -> str:
        """A check, by how much it is met, or with values over its violations."""
        text, roll = random_check(self.rng), self.rng.random()
        if roll < 0.35:
            return f"{text} ROBUSTNESS"
        if roll < 0.6:
            return text
        values = over_values(self.rng, [], pair="(v:Entity)" in text)
        told = ", ".join(f"{value} AS y{n}" for n, value in enumerate(values))
        of_ego = re.sub(r"\be\b", "ego", told)
        return f"{text} RETURN {of_ego}"

    def over_match(self) -> str:
        """Values over the matches of a sequence, or over the runs of a pattern."""
        if self.rng.random() < 0.6:
            text = random_sequence(self.rng)
            names = re.findall(r" AS (s\d)", text)
            keys = ["trace.name", "t(s0)"]
        else:
            text, names = "MATCH (e:Ego), (v:Entity) WHERE dist(e, v) < 9", []
            keys = ["trace.name", "frame.seq", "v"]
        values = over_values(self.rng, names, pair="(v" in text)
        told = [f"{value} AS y{n}" for n, value in enumerate(values)]
        order = self.rng.choice(("", "", " ORDER BY y1 DESC", " LIMIT 5", " ORDER BY y0 LIMIT 3"))
        return f"{text} RETURN {', '.join([*keys, *told])}{order}"

    def in_parts(self) -> str:
        """A question with ``OPTIONAL MATCH``, ``WITH`` and paths."""
        writer = PartsWriter(self.seed)
        text = writer.whole()
        if self.rng.random() < 0.7:
            return text + writer.told() + self.rng.choice(("", "", " LIMIT 4", " SKIP 2"))
        return text + self.rng.choice(("", " RETURN FRAMES", " RETURN INTERVALS", " LIMIT 5"))

    def of_classes(self) -> str:
        """A question about the classes of frames in all bundles."""
        known = self.rng.choice(("'trace1*'", "'trace7'", "'trace?'"))
        tests = [
            "class_count() > 1",
            "class_count() <= 2",
            f"frame.class IN dataset_classes({known})",
        ]
        tests += [f"NOT frame.class IN dataset_classes({known})", "frame.class IS NOT NULL"]
        told = ["frame.class, class_count() ORDER BY class_count() DESC LIMIT 5", "FRAMES"]
        told += ["class_count() AS n, COUNT(*) AS m", "trace.name, MAX(class_count())", "INTERVALS"]
        return f"MATCH (e:Ego) WHERE {self.rng.choice(tests)} RETURN {self.rng.choice(told)}"

    def union(self) -> str:
        """The answers of two patterns as one."""
        form = self.rng.choice(("", "", "INTERVALS, ", "FRAMES, "))
        parts: list[str] = []
        for seed in (self.seed, self.seed + 1_000_000):
            writer = CollectionWriter(seed)
            text = writer.query()
            node = next(iter(writer.nodes), "ego")
            values = self.rng.choice((f"{node}.kind AS k", f"{node}.kind AS k, COUNT(*) AS n"))
            limit = self.rng.choice(("", "", " LIMIT 4", " ORDER BY k DESC"))
            parts.append(
                f"{text} RETURN {form}{values if not form else f'{node}.kind AS k'}{limit}"
            )
        return self.rng.choice((" UNION ", " UNION ALL ")).join(parts)

    def settings(self, *, check: bool = False) -> str:
        some = ["", "", "", "UNKNOWN false", "EGO 'hero1'", "DATASET 'trace1*'", "DATASET 'trace7'"]
        some += ["ABSTRACTION EL", "ABSTRACTION ER", "DATASET 'trace?', UNKNOWN false"]
        chosen = self.rng.choice([one for one in some if not (check and "ABSTR" in one)])
        return f"USING {chosen} " if chosen else ""

    def values(self) -> str:
        """Values, counted or listed, in an order of the query, of which some are wanted."""
        text = self.results()
        if not text.partition("RETURN")[2].strip():
            text = " RETURN COUNT(*)"
        counted = any(f"{word}(" in text for word in ("COUNT", "MAX", "MIN", "AVG", "SUM"))
        return text + self.wanted(listed=not (counted or "DISTINCT" in text))

    def form(self) -> str:
        node = next(iter(self.nodes), None)
        kept = self.rng.choice(["", "", f", {node}", f", {node}.kind", f", {node}.name"])
        kept = kept if node else ""
        forms = ["", " RETURN *", f" RETURN FRAMES{kept}", f" RETURN INTERVALS{kept}"]
        forms += [" RETURN CLIPS(-1s, +0.5s)", " RETURN SUBGRAPHS", " RETURN DISTINCT *"]
        form = self.rng.choice(forms)
        if not form:
            return self.rng.choice(["", " LIMIT 3", " LIMIT 20"])
        return form + self.wanted(listed=True, keys=())

    def wanted(self, *, listed: bool, keys: Iterable[str] = ("trace.name",)) -> str:
        node = next(iter(self.nodes), None)
        some = [*keys, *([f"{node}.x", f"{node}.kind", f"{node}.speed"] if node and listed else [])]
        text = ""
        if some and listed and self.rng.random() < 0.4:
            order = self.rng.sample(some, self.rng.choice((1, min(2, len(some)))))
            text += " ORDER BY " + ", ".join(k + self.rng.choice(("", " DESC")) for k in order)
        if listed and self.rng.random() < 0.25:
            per = self.rng.choice(["", " PER trace", *([f" PER {node}.kind"] if node else [])])
            text += f" SAMPLE {self.rng.choice('123')}{per}"
        if listed and node and self.rng.random() < 0.15:
            text += f" LIMIT {self.rng.choice('12')} PER {node}.kind"
        if self.rng.random() < 0.1:
            text += f" SKIP {self.rng.choice('0127')}"
        if self.rng.random() < 0.35:
            text += f" LIMIT {self.rng.choice(('1', '2', '5', '9', '40'))}"
        return text

    def ended(self) -> str:
        forms = [
            "",
            "",
            " RETURN INTERVALS",
            " RETURN CLIPS(-1s, +1s)",
            " RETURN trace.name, COUNT(*)",
        ]
        forms += [" RETURN FRAMES LIMIT 5", " RETURN e, t(s0) ORDER BY t(s0) DESC LIMIT 4"]
        forms += [" RETURN e.kind, MAX(t(s1)), COUNT(DISTINCT e)", " RETURN DISTINCT e", " LIMIT 3"]
        return self.rng.choice(forms)


def close(one: Any, other: Any) -> bool:
    """Whether two values are equal, numbers but for what the order of a sum makes of them."""
    if isinstance(one, float) and isinstance(other, float):
        same = one == other or (math.isnan(one) and math.isnan(other))
        return same or math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(close, one, other))
    return type(one) is type(other) and one == other


def verdicts(asked: Iterable[Any]) -> list[Any]:
    return [
        (str(one), one.violations, one.witnesses, one.statuses, one.robustness) for one in asked
    ]


def refused(asked: Store | Collection, text: str) -> str:
    """Why a question is refused; empty if it is not."""
    try:
        asked.check(text) if "CHECK" in text else asked.find(text)
    except QueryError as error:
        return error.reason
    return ""


def answers(asked: Store | Collection, text: str, form: str) -> list[Any]:
    """The answer to a question as it stands, or, of ``form``, in another form."""
    if "CHECK" in text:
        return verdicts(asked.check(text, status=True))
    found = asked.find(text)
    if form == "intervals" and ("SUBGRAPHS" in text or "*" in text):
        form = "rows"
    ask: dict[str, Callable[[], Iterable[Any]]] = {
        "rows": found.rows,
        "count": lambda: [[found.count()]],
        "frames": found.frames,
        "clips": lambda: found.clips(0.5, 1),
        "intervals": found.intervals,
        "limited": lambda: found.limit(2),
    }
    return [tuple(one) if isinstance(one, tuple) else one for one in ask[form]()]


SORTS = {
    "no RETURN": r"^(?!.*(RETURN|CHECK))",
    "RETURN *": r"RETURN (DISTINCT )?\*",
    "FRAMES": "RETURN FRAMES",
    "SUBGRAPHS": "SUBGRAPHS",
    "INTERVALS": "INTERVALS",
    "CLIPS": "CLIPS",
    **{word: rf"\b{word}\(" for word in ("COUNT", "MIN", "MAX", "AVG", "SUM")},
    "COUNT(DISTINCT …)": r"COUNT\(DISTINCT",
    "DISTINCT": "RETURN DISTINCT",
    "ORDER BY": "ORDER BY",
    "LIMIT": r"LIMIT \d(?! PER)",
    "LIMIT n PER": r"LIMIT \d PER",
    "SKIP": "SKIP",
    "SAMPLE": "SAMPLE",
    "HAVING": "HAVING",
    "median, percentile, stddev, collect": r"(?i)\b(median|percentile|stddev|collect)\(",
    "class_count": "class_count",
    "dataset_classes": "dataset_classes",
    "DATASET": "USING.*DATASET",
    "EGO": "USING.*EGO",
    "ABSTRACTION": "ABSTRACTION",
    "UNKNOWN": "UNKNOWN false",
    "tables beside": r"labels\.|takeover",
    "HAPPENS": "HAPPENS",
    "sequences": r"\bTHEN\b",
    "repeated or alternative steps": r"\)[+*{]|\}\s*\{|\| *\(",
    "OPTIONAL MATCH": "OPTIONAL",
    "WITH": r"\bWITH (?!IN)",
    "UNION": "UNION",
    "OVER": r"\bOVER\b",
    "CHECK": "CHECK",
    "CHECK … RETURN": "CHECK.*RETURN",
    "CHECK … ROBUSTNESS": "CHECK.*ROBUSTNESS",
}
"""Sort of question → a pattern of its text."""

FORMS = ("count", "frames", "clips", "intervals", "limited")
"""Forms in which an answer is asked for beside its rows: one of them for each second question."""


def worlds(
    seed: int, folder: Path, engines: str = "local", bundles: Sequence[int] = BUNDLES
) -> tuple[Asked, Asked]:
    """A store, and collections of it of so many bundles by each engine; the same with tables beside them."""
    path = folder / f"{seed}.sgstore"
    StoreFile.create(path)
    world = random_world(seed, traces=TRACES, frames=6 + seed % 5, maps=1 + seed % 2, path=path)
    renamed(world.connection, seed)
    for number in bundles:
        size = -(-TRACES // number)
        done = pack(path, folder / f"{seed}-{number}", bundle_traces=size)
        assert len(done.bundles) == number
    tables = tables_beside(path, folder, seed)
    places = [folder / f"{seed}-{number}" for number in bundles]
    made = [(place, engine) for engine in engines.split("+") for place in places]
    plain = Store(path), [Collection(place, engine=engine) for place, engine in made]
    return plain, (Store(path, tables=tables), [whole.joined(tables) for whole in plain[1]])


def tables_beside(path: Path, folder: Path, seed: int) -> dict[str, object]:
    """Labels of some frames, and takeovers by some who are in them."""
    rng = random.Random(seed)
    with Store(path) as store:
        rows = store.find("MATCH (v:Entity) RETURN trace.name, frame.seq, v.id").rows()
    frames = sorted({tuple(row[:2]) for row in rows})
    labels = [
        f"{name},{seq},{rng.choice(('good', 'bad', ''))},{rng.randrange(100) / 10}\n"
        for name, seq in rng.sample(frames, len(frames) // 2)
    ]
    takeovers = [f"{name},{seq},{node}\n" for name, seq, node in rng.sample(rows, 20)]
    tables = dict[str, object]()
    for name, columns, lines in (
        ("labels", "trace,seq,label,score\n", labels),
        ("takeover", "trace,seq,node_id\n", takeovers),
    ):
        table = folder / f"{seed}-{name}.csv"
        table.write_text(columns + "".join(lines))
        tables[name] = table
    return tables


def renamed(connection: duckdb.DuckDBPyConnection, seed: int) -> None:
    """Give the traces of a store one another's names, and close it: as a rule ids are in another order."""
    ids = [
        number for (number,) in connection.execute("SELECT trace_id FROM inside.trace").fetchall()
    ]
    names = [f"trace{number}" for number in range(1, len(ids) + 1)]
    random.Random(seed).shuffle(names)
    rows = [list(row) for row in zip([f"{name}!" for name in names], ids, strict=True)]
    connection.executemany("UPDATE inside.trace SET name = $1 WHERE trace_id = $2", rows)
    connection.execute("UPDATE inside.trace SET name = rtrim(name, '!')")
    connection.close()


def texts(seed: int) -> Iterator[str]:
    for number in range(QUESTIONS):
        yield CollectionWriter(seed * QUESTIONS + number).text()


def compare(plain: Asked, beside: Asked, asked: Iterable[str]) -> tuple[Counter[str], Counter[str]]:
    """Ask random questions of a store and of collections; how many of each sort, and how many have answers."""
    seen, some = Counter[str](), Counter[str]()
    for number, text in enumerate(asked):
        store, wholes = beside if re.search(r"labels\.|takeover", text) else plain
        if reason := refused(store, text):
            seen["refused"] += 1
            assert {refused(whole, text) for whole in wholes} == {reason}, text
            continue
        other = FORMS[number // 2 % len(FORMS)]
        sorts = ["asked", *(name for name, word in SORTS.items() if re.search(word, text))]
        for form in ("rows",) if number % 2 or "CHECK" in text else ("rows", other):
            wanted = answers(store, text, form)
            told = sorts if form == "rows" else [f"asked for {form}"]
            seen.update(told)
            some.update(told if wanted and wanted != [[0]] else ())
            for whole in wholes:
                found = answers(whole, text, form)
                assert close(wanted, found), (
                    f"{whole}: {text}\n{form} wanted\n{wanted}\nfound\n{found}"
                )
    return seen, some


def run(questions: str, folder: Path, engines: str = "local", *bundles: str) -> str:
    """Ask so many questions, and say after each world how far it is; what was asked, by sort."""
    seen, some = Counter[str](), Counter[str]()
    first, last = map(int, questions.split(":") if ":" in questions else (0, questions))
    for seed in range(first // QUESTIONS, -(-last // QUESTIONS)):
        began = time.monotonic()
        plain, beside = worlds(seed, folder, engines, [*map(int, bundles)] or BUNDLES)
        with plain[0].file.snapshot(), beside[0].file.snapshot():
            more, answered = compare(plain, beside, texts(seed))
        seen, some = seen + more, some + answered
        told = f"world {seed}, {time.monotonic() - began:.0f} s: {seen['asked']} asked"
        sys.stdout.write(f"{engines} {' '.join(bundles)} {told}, {some['asked']} with an answer\n")
        sys.stdout.flush()
    return "\n".join(f"{sort}: {some[sort]} of {number}" for sort, number in seen.items())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        told = run(sys.argv[1], Path(made), *sys.argv[2:])
    sys.stdout.write(f"no difference; of each sort, how many have an answer:\n{told}\n")
