"""A collection of stores: what goes in comes out, and questions have the answers of one store."""

from __future__ import annotations

import json
import random
import shutil
import sys
from collections import Counter
from dataclasses import fields, replace
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any, get_args

import pytest
from counting import calls
from oracle_collection import compare, renamed, texts, worlds
from oracle_worlds import random_world
from thorough import LONG, some

from sgstore.apps.cli import run as run_verb
from sgstore.collection import Collection, PartialAnswerError, gc, pack, unpack, verify
from sgstore.collection import _catalogue as catalogue
from sgstore.collection import _engines as engines
from sgstore.collection import _worker as worker
from sgstore.errors import QueryError, QueryNameError, SqlError, StoreError, TextSpan
from sgstore.lang import catalog as _catalog
from sgstore.lang import ir
from sgstore.lang.bind._aggregates import AGGREGATES
from sgstore.lang.sql import collection_parts as parts
from sgstore.lang.sql import compile_query
from sgstore.lang.syntax import tree as syntax
from sgstore.query import Store
from sgstore.store import CATALOGUE, ParquetTable, StoreFile, _bundles
from sgstore.testsets import coverage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from sgstore.lang.sql import Compiled

pytestmark = [pytest.mark.seconds(44), pytest.mark.usefixtures("own_cache")]

TRACES = 5

QUESTIONS = [
    "MATCH (a:Car)-[:near]->(b)",
    "MATCH (a:Car)-[e:near|visible]->(b) RETURN a.x, b.name, type(e), frame.seq",
    "MATCH (a:Car)-[e:near|visible]->(b) RETURN type(e), b ORDER BY a.speed DESC, b.kind LIMIT 9",
    "MATCH (a:Car)-[:near]->(b) RETURN *, a.speed ORDER BY a.speed DESC LIMIT 9",
    "MATCH (a:Car)-[:near]->(b) LIMIT 3",
    "MATCH (a)-[d:follows|leads]-(b) RETURN *",
    "MATCH (a:Car)-[:near]->(b) RETURN COUNT(*) AS n",
    "MATCH (a:Car)-[:near]->(b) WHERE a.x > 1e9 RETURN COUNT(*) AS n, AVG(a.x), COUNT(DISTINCT b)",
    "MATCH (a:Car)-[:near]->(b) RETURN b.kind AS k, COUNT(*) AS n, COUNT(DISTINCT b) AS d,"
    " COUNT(DISTINCT b.kind), AVG(a.speed) AS v, MAX(a.x) - MIN(a.x) AS w ORDER BY n DESC, k LIMIT 4",
    "MATCH (a:Car) RETURN trace.name, SUM(frame.seq), MIN(a.name)",
    "MATCH (a:Car) OPTIONAL MATCH (a)-[:opposes]->(b) RETURN a, b.kind ORDER BY a.speed, a LIMIT 9",
    "MATCH (a:Car) OPTIONAL MATCH (a)-[:opposes]->(b:Truck) RETURN a.kind, COUNT(*), COUNT(b)",
    "MATCH (a:Car)-[:near]->(b) WITH a, COUNT(b) AS n WHERE n > 1 RETURN trace.name, MAX(n), COUNT(*)",
    "MATCH (a:Car)-[:near]->(b) WITH a, b ORDER BY b.x LIMIT 2 RETURN INTERVALS, b",
    "MATCH (a:Car) WHERE NOT HAPPENS collision(a) RETURN a.kind, COUNT(*)",
    "MATCH (a:Car)-[:near]->(b) RETURN b, COUNT(*) ORDER BY AVG(a.speed)",
    "MATCH (a:Car)-[:near]->(b) RETURN DISTINCT a, b.kind",
    "MATCH (a:Car)-[:near]->(b) RETURN DISTINCT trace.name, b.kind LIMIT 6",
    "MATCH (a:Car)-[:near]->(b) RETURN FRAMES",
    "MATCH (a:Car)-[:near]->(b) RETURN FRAMES, b.kind ORDER BY seq DESC LIMIT 7",
    "MATCH (a:Car)-[:near]->(b) RETURN INTERVALS, b",
    "MATCH (a:Car)-[:near]->(b) RETURN INTERVALS, b, b.kind SAMPLE 2 PER b",
    "USING EGO 'hero1' MATCH (a:Car)-[:near]->(b) RETURN INTERVALS SAMPLE 4 PER trace",
    "MATCH (a:Car)-[:near]->(b) RETURN CLIPS(-1s, +1s)",
    "MATCH (a:Car)-[:near]->(b) RETURN CLIPS(-1s, +1s) ORDER BY start_ns DESC LIMIT 3",
    "MATCH (a:Car)-[:near]->(b) RETURN SUBGRAPHS LIMIT 5",
    "MATCH (a:Car)-[:near]->(b) RETURN a.x SAMPLE 3 PER b.kind",
    "MATCH (a:Car)-[:near]->(b) RETURN a SAMPLE 2 PER a LIMIT 5",
    "MATCH (a:Car)-[:near]->(b) RETURN a.x, frame.seq, trace.name SAMPLE 3 PER b.kind LIMIT 2",
    "MATCH (a:Car)-[:near]->(b) RETURN INTERVALS, b.kind SAMPLE 2 PER b.kind LIMIT 3",
    "MATCH (a:Car) RETURN a ORDER BY a.speed DESC SAMPLE 2 PER a.kind LIMIT 3",
    "MATCH (a:Car)-[:isIn]->(l:Lane), (b)-[:isIn]->(m:Lane) WHERE l.chain = m.chain RETURN COUNT(*) AS n",
    "MATCH (a:Car)-[:near]->(b) THEN MATCH (a)-[:visible]->(b) RETURN a, b",
    "MATCH (a:Car)-[:near]->(b) FOR >= 0.2s RETURN INTERVALS, a",
    "MATCH (a:Car)-[:near]->(b) AS s THEN MATCH (a)-[:visible]->(b) AS t RETURN a, MIN(a.x) OVER match AS x,"
    " MAX(b.y) OVER s..t ORDER BY x LIMIT 9",
    "MATCH (a:Car), (b:Car) WHERE HAPPENS collision(a, b) RETURN a, b, frame.seq",
    "MATCH (a:Car)-[:near]->(b) RETURN HAPPENS collision(a) AS hit, COUNT(*) AS n",
    "MATCH (a:Car) WHERE a.x > 100 THEN (MATCH (a)-[:near]->(b) | MATCH (a)-[:visible]->(b)) RETURN a, b",
    "MATCH (e:Ego) RETURN frame.class, class_count() ORDER BY class_count() DESC LIMIT 5",
    "MATCH (e:Ego) WHERE frame.class IN dataset_classes('trace3') RETURN FRAMES",
    "USING DATASET 'trace[45]' MATCH (a:Car) RETURN COUNT(*)",
    "USING UNKNOWN false MATCH (a:Car)-[:near]->(b) RETURN trace.name, COUNT(*) AS n",
    "USING UNKNOWN false MATCH (a)-[:sees]->(b:Bicycle) RETURN COUNT(*) AS n, MAX(a.x)",
    "USING UNKNOWN false MATCH (a)-[:sees]->(b:Bicycle) RETURN a, b.name",
    "MATCH (a:Car)-[:near]->(b) RETURN b.kind AS k, COUNT(*) AS n HAVING n > 9 ORDER BY n DESC",
    "MATCH (a:Car)-[:near]->(b) RETURN b.kind HAVING COUNT(*) > 9 AND MAX(a.x) > 101 SKIP 1 LIMIT 2",
    "MATCH (a:Car)-[:near]->(b) RETURN COUNT(*) AS n, collect(b) HAVING n > 100000",
    "MATCH (a:Car)-[:near]->(b) WHERE a.x > 1e9 RETURN COUNT(*), collect(b.name), median(a.x)",
    "MATCH (a:Car)-[:near]->(b) RETURN INTERVALS, b HAVING frames > 1 ORDER BY frames DESC SKIP 2",
    "MATCH (a:Car)-[:near]->(b) RETURN trace.name, b.kind, COUNT(*) AS n ORDER BY n LIMIT 1 PER trace.name",
    "MATCH (a:Car)-[:near]->(b) RETURN b, b.kind, COUNT(*) AS n LIMIT 1 PER b",
    "MATCH (a:Car)-[:near]->(b) RETURN DISTINCT b, b.kind LIMIT 1 PER b SKIP 1",
    "MATCH (a:Car)-[:near]->(b) RETURN a.x, frame.seq ORDER BY a.x DESC LIMIT 2 PER b.kind SKIP 1 LIMIT 5",
    "MATCH (a:Car)-[:near]->(b) RETURN a.x, b SAMPLE 4 PER b LIMIT 2 PER b.kind",
    "MATCH (a:Car)-[:near]->(b) RETURN INTERVALS, b, b.kind ORDER BY frames DESC LIMIT 2 PER b LIMIT 9",
    "MATCH (a:Car)-[:near]->(b) RETURN FRAMES, b.kind LIMIT 2 PER trace SKIP 1",
    "MATCH (a:Car)-[:near]->(b) RETURN SUBGRAPHS, b.kind ORDER BY a.x LIMIT 1 PER b.kind",
    "MATCH (a:Car) RETURN a.x AS x ORDER BY x SKIP 5 LIMIT 4",
    "MATCH (a:Car)-[:near]->(b) RETURN median(a.x), percentile(a.x, 90), stddev(a.speed), AVG(DISTINCT"
    " a.width), SUM(DISTINCT frame.seq), MAX(DISTINCT a.x)",
    "MATCH (a:Car)-[:near]->(b) RETURN b.kind, collect(b), collect(DISTINCT b), collect(a.x), collect(b.name)",
    "MATCH (a:Car)-[:near]->(b) RETURN b.width AS w, SUM(a.x) * b.width, b.width / COUNT(*)",
    "MATCH (a:Car)-[:near]->(b) RETURN CASE b.kind WHEN 'car' THEN 'four' ELSE 'other' END AS w, COUNT(*) AS n"
    " ORDER BY CASE WHEN n > 9 THEN 1 ELSE 2 END, w",
    "MATCH (a:Car) WHERE a.x > 100 MATCH (a)-[:near]->(b) RETURN a, b.name LIMIT 7",
    "MATCH (a:Car)-[:near]->(b) RETURN b UNION MATCH (a:Car)-[:visible]->(b) RETURN b",
    "MATCH (a:Car)-[:near]->(b) RETURN b.kind, COUNT(*) AS n ORDER BY n DESC LIMIT 3"
    " UNION ALL MATCH (a:Car)-[:visible]->(b) RETURN b.kind, COUNT(*) AS n",
    "MATCH (a:Car)-[:near]->(b) RETURN INTERVALS, b UNION MATCH (a:Car)-[:visible]->(b) RETURN INTERVALS, b",
    "MATCH (a:Car)-[:near]->(b) RETURN trace.name, b.kind UNION MATCH (b:Car) RETURN trace.name, b.kind",
    "MATCH (a:Car)-[:near]->(b) RETURN SUBGRAPHS LIMIT 4 UNION ALL MATCH (a:Car)-[:visible]->(b)"
    " RETURN SUBGRAPHS LIMIT 3",
    "MATCH (a:Car) WHERE NOT EXISTS {(a)-[:near]->(b)} RETURN trace.map, COUNT(*)",
    "MATCH (a:Car) OPTIONAL MATCH (a)-[:near]->(b) RETURN b, b.kind, COUNT(*) AS n ORDER BY n LIMIT 1 PER b",
    "MATCH (a:Car) OPTIONAL MATCH (a)-[:near]->(b) WHERE b.x > 101",
    "MATCH (a:Car) OPTIONAL MATCH (a)-[:near]->(b) RETURN DISTINCT b, b.name",
    "MATCH (a:Car)-[:near]->(b) WITH b, COUNT(*) AS n, collect(a.name) AS who WHERE n > 1 RETURN b, n, who",
    "MATCH (a:Car)-[:near]->(b) WITH b.kind AS k, COUNT(*) AS n RETURN k, AVG(n), collect(n), COUNT(*)",
    "MATCH (a:Car)-[:near]->(b) WITH a, b ORDER BY dist(a, b) LIMIT 1 RETURN INTERVALS, a, b",
    "MATCH (a:Car)-[:near]->(b) WITH COUNT(*) AS n",
    "MATCH p = (a:Car)-[:near*1..2]->(b) RETURN p, length(p) AS n ORDER BY n DESC LIMIT 40",
    "MATCH p = (a:Car)-[:near*1..2]->(b) WITH a, MIN(length(p)) AS n RETURN SUBGRAPHS, n",
]
CHECKS = [
    "CHECK calm: FORALL (a:Car) ALWAYS a.speed < 8",
    "CHECK slow: FORALL (a:Car) ALWAYS a.speed < 8 ROBUSTNESS;"
    " CHECK ever: FORSOME (a:Car) EVENTUALLY a.x > 100 AND EXISTS {(a)-[:near]->(b)} ROBUSTNESS",
    "CHECK told: FORALL (a:Car) ALWAYS a.speed < 5 RETURN MAX(a.speed) OVER match AS most, a.name",
    "CHECK some: FORALL (a:Car) ALWAYS a.speed < 5 RETURN MAX(a.speed) OVER match AS most HAVING most > 6",
    "CHECK seen: FORSOME (a:Car) EVENTUALLY EXISTS {(a)-[:near]->(b)}; CHECK still: ALWAYS ego.speed < 3",
    "USING RANGE 5 CHECK close: FORALL (a:Car) ALWAYS NOT EXISTS {(a)-[:near]->(b)}",
]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of several traces on two maps."""
    path = tmp_path_factory.mktemp("one") / "one.sgstore"
    StoreFile.create(path)
    world = random_world(5, traces=TRACES, frames=50, maps=2, path=path)
    renamed(world.connection, 5)
    return path


@pytest.fixture(scope="module")
def store(path: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """A copy of it that stays open; the other one is packed."""
    opened = Store(shutil.copy(path, tmp_path_factory.mktemp("open") / "one.sgstore"))
    with opened.file.snapshot():
        yield opened


@pytest.fixture(scope="module")
def place(path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as a collection of three bundles."""
    place = tmp_path_factory.mktemp("many") / "fleet"
    done = pack(path, place, bundle_traces=2)
    assert len(done.bundles) == 3
    return place


@pytest.fixture(scope="module")
def whole(place: Path) -> Collection:
    return Collection(place)


def close(one: Any, other: Any) -> bool:
    """Whether two values are equal, numbers but for what the order of a sum makes of them."""
    if isinstance(one, float) and isinstance(other, float):
        return one == pytest.approx(other, rel=1e-9, abs=1e-12)
    return type(one) is type(other) and one == other


NOTED = [
    "MATCH (a:Car) WHERE a.name = 'carr 1'",
    "MATCH (a:Car)-[:near]->(b) WHERE a.speed > 4000",
    "MATCH (a:Car)-[:near]->(b:Bus)-[:near]->(a) WHERE a.width > 90 AND b.x > 0",
    "MATCH (a:Car) WHERE EXISTS {(a)-[:near]->(b:Bus WHERE b.speed > 9000)}",
    "USING DATASET 'trace[45]' MATCH (a:Car {name: $name}) WHERE a.speed > 4000",
    "MATCH (a:Car) WHERE a.speed > 1 THEN WITHIN 1s MATCH (a) WHERE a.speed > 4000",
]
PLAIN = "MATCH (a:Car)-[:near]->(b)"
UNION = "MATCH (a:Car) WHERE a.speed > 4000 UNION MATCH (a:Car) WHERE a.name = 'no car'"


@pytest.mark.parametrize("text", [PLAIN, UNION, *some(NOTED, 3)])
def test_a_collection_has_the_notes_of_one_store(
    text: str, whole: Collection, store: Store
) -> None:
    values = {"name": "nobody"} if "$name" in text else {}
    one, many = store.find(text, **values), whole.find(text, **values)

    assert many.notes == one.notes
    assert bool(one.notes) == (text != PLAIN)
    assert many.count() == one.count()
    assert many.notes == one.notes


def test_checks_of_a_collection_have_the_notes_of_one_store(
    whole: Collection, store: Store
) -> None:
    text = "CHECK none: FORALL (v:Car) ALWAYS NOT v.name = 'carr 1'"

    assert whole.check(text).notes == store.check(text).notes != ()


def nested(values: Any) -> Any:
    """An array as a list; so is what it holds, as the steps of a path."""
    return [*map(nested, values)] if getattr(values, "ndim", 0) else values


@pytest.mark.parametrize("text", some(QUESTIONS, 7))
def test_rows_and_their_order_are_those_of_one_store(
    store: Store, whole: Collection, text: str
) -> None:
    expected = store.find(text)
    found = whole.find(text)

    assert found.columns == expected.columns
    rows, wanted = found.rows(), expected.rows()
    assert len(rows) == len(wanted)
    for row, other in zip(rows, wanted, strict=True):
        assert all(map(close, row, other)), (row, other)


@pytest.mark.parametrize("text", some([QUESTIONS[i] for i in (0, 14, 19, 22, -2, -4, 2)], 7))
def test_other_forms_are_those_of_one_store(store: Store, whole: Collection, text: str) -> None:
    expected, found = store.find(text), whole.find(text)

    assert found.count() == expected.count()
    if not ("UNION" in text and "SUBGRAPHS" in text):  # these make no table
        arrays, others = found.numpy(), expected.numpy()
        assert {n: nested(a) for n, a in arrays.items()} == {
            n: nested(a) for n, a in others.items()
        }
    assert list(found.frames()) == list(expected.frames())
    assert list(found.intervals()) == list(expected.intervals())
    assert list(found.intervals(bound=True)) == list(expected.intervals(bound=True))
    assert list(found.clips(0.5, 1)) == list(expected.clips(0.5, 1))
    assert list(found.limit(2)) == list(expected.limit(2))
    graphs = [(g.graph, sorted(g.nodes), sorted(g.edges)) for g in found.limit(3).subgraphs()]
    wanted = [(g.graph, sorted(g.nodes), sorted(g.edges)) for g in expected.limit(3).subgraphs()]
    assert graphs == wanted


def test_sequences_that_end_together_come_by_what_they_return(
    store: Store, whole: Collection
) -> None:
    """Of one pair of cars, each run of being near leads to one and the same frame."""
    text = (
        "MATCH (a:Car)-[:near]->(b) AS s THEN MATCH (a) WHERE frame.seq = 45 AS t"
        " RETURN trace.name, a, b, t(s)"
    )
    rows = [tuple(row) for row in store.find(text)]

    together = Counter(row[:3] for row in rows)
    assert max(together.values()) > 2
    for pair in together:
        times = [row[3] for row in rows if row[:3] == pair]
        assert times == sorted(times)
    assert [tuple(row) for row in whole.find(text)] == rows
    for most in (1, 3, 7):
        assert [tuple(row) for row in whole.find(f"{text} LIMIT {most}")] == rows[:most]


@pytest.mark.skipif(not LONG, reason="make cluster asks them")
def test_random_questions_have_the_rows_of_one_store(tmp_path: Path) -> None:
    """``make cluster`` asks a thousand."""
    seen, some = compare(*worlds(3, tmp_path), texts(3))

    assert seen["asked"] > 50
    assert some["asked"] > 20


@pytest.mark.parametrize("text", CHECKS)
def test_verdicts_are_those_of_one_store(store: Store, whole: Collection, text: str) -> None:
    expected = list(store.check(text, status=True))
    found = list(whole.check(text, status=True))

    assert [str(one) for one in found] == [str(one) for one in expected]
    assert [one.violations for one in found] == [one.violations for one in expected]
    assert [one.witnesses for one in found] == [one.witnesses for one in expected]
    assert [one.statuses for one in found] == [one.statuses for one in expected]
    assert [one.robustness for one in found] == [one.robustness for one in expected]
    for one, other in zip(found, expected, strict=True):
        assert [v.false_runs for v in one.violations] == [v.false_runs for v in other.violations]
        assert (one.applied_frames, one.bindings) == (other.applied_frames, other.bindings)


def test_processes_answer_as_this_one_does(
    whole: Collection, place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    several = Collection(place, engine="local:2")

    assert several.find(QUESTIONS[7]).rows() == whole.find(QUESTIONS[7]).rows()
    assert list(map(str, several.check(CHECKS[0]))) == list(map(str, whole.check(CHECKS[0])))
    assert capfd.readouterr().err == ""


def test_tables_of_ones_own_are_joined(path: Path, place: Path, tmp_path: Path) -> None:
    table = tmp_path / "labels.csv"
    table.write_text("trace,seq,label\ntrace1,3,good\ntrace4,5,bad\ntrace5,61,good\n")
    text = "MATCH (a:Car) WHERE labels.label = 'good' RETURN trace.name, frame.seq, a, labels.label"

    with Store(path, tables={"labels": table}) as one:
        expected = one.find(text).rows()
    found = Collection(place, tables={"labels": table}).find(text).rows()

    assert expected
    assert [tuple(row) for row in found] == [tuple(row) for row in expected]


def test_only_bundles_that_may_answer_are_opened(whole: Collection, place: Path) -> None:
    def may_answer(bundle: str, relation: str) -> bool:
        facts = whole.snapshot.of("triple", bundle)
        return any(row[3] == relation and not row[1] for row in facts)

    for relation in ("near", "opposes", "leads", "sees"):
        matches = whole.find(f"USING UNKNOWN false MATCH (a)-[:{relation}]->(b)")
        matches.rows()
        wanted = {b for b in whole.bundles() if may_answer(b, relation)}
        assert set(whole.opened) - {""} == wanted
    whole.find("USING DATASET trace1 MATCH (a)-[:near]->(b)").rows()
    assert len(whole.opened) == 1


OUTCOMES = {f"trace{trace}#{seq}": seq % 3 == 0 for trace in range(1, 6) for seq in range(70)}
MEASURES: list[Callable[..., Any]] = [
    lambda a, b: coverage.classes(a),
    lambda a, b: coverage.classes(a, "run"),
    lambda a, b: coverage.classes(a, "trace"),
    coverage.covered,
    coverage.novel,
    coverage.novel_frames,
    coverage.novel_clips,
    coverage.venn,
    lambda a, b: coverage.growth(a, "run", 7),
    lambda a, b: coverage.combos(a, "ER", 2).missing,
    lambda a, b: coverage.combos(a, "ER", 2, b).shares,
    lambda a, b: coverage.explain(b, a, "ER")[0],
    lambda a, b: coverage.failures(a, b, OUTCOMES)[1],
]


def test_a_process_closes_bundles_that_need_too_much_memory(
    store: Store, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "MATCH (a:Car) WHERE a.speed > 5"
    monkeypatch.setattr(worker, "KEPT_BYTES", 1)
    whole = Collection(place, engine="local")
    assert whole.find(text).rows() == store.find(text).rows()
    assert len(whole.opened) > 1 == len(worker._open)


@pytest.mark.parametrize(("abstraction", "window"), [("E", 3), ("ER", 1)] if LONG else [("ER", 1)])
def test_what_is_covered_is_told_of_all_bundles_together(
    path: Path, place: Path, tmp_path: Path, abstraction: str, window: int
) -> None:
    shutil.copy(path, tmp_path / "one.sgstore")
    found: list[list[str]] = []
    for text in (str(tmp_path / "one.sgstore"), str(place)):
        chosen = [
            coverage.selection_of(f"{text}{more}") for more in ("", ":MATCH (:Car)-[:near]->()")
        ]
        a, b = (coverage.classed(one, abstraction, window) for one in chosen)
        measures = MEASURES if abstraction == "ER" else MEASURES[:2]
        tables = [measure(a, b) for measure in measures]
        told = [repr(table).replace(text, "") for table in tables]
        shares = coverage.specification(chosen[0], SPECIFICATION)[0]
        found.append([*told, repr(shares).replace(text, "")])

    for one, other in zip(*found, strict=True):
        assert other == one


SPECIFICATION = "MATCH (v:Car)-[d:near|visible]->(w) RETURN w.kind, type(d)"


def many_bundles(count: int) -> catalogue.Snapshot:
    """A snapshot of many bundles of a trace each; each hundredth has a triple that the others lack."""
    rng, kinds = random.Random(1), ("car", "truck", "person", "bicycle", "bus")
    facts: Any = {table: [] for table in CATALOGUE}
    facts["config"] = [("c", "{}")]
    answers = '["near", "visible", "opposes"]'
    for number in range(count):
        name = f"{number:064x}"
        facts["bundle"].append((name, 1, 1, 1, catalogue.SCHEMA_VERSION, "", "", 0, 1))
        about = (number + 1, f"t{number}", f"d{number}", "e", "", "", "c", answers, 10, 0, 1)
        facts["trace"].append((name, *about, 100_000_000, "u", (number + 1) << 12, 1, "", ""))
        facts["kind"] += [(name, "moving", kind) for kind in kinds]
        for relation in ("near", "visible"):
            for kind in kinds:
                others = rng.sample(kinds, 2)
                facts["triple"] += [(name, "", True, relation, kind, o, 3) for o in others]
        if not number % 100:
            facts["triple"].append((name, "", True, "opposes", "car", "truck", 1))
    return catalogue.Snapshot(1, facts)


def decided(whole: Collection, compiled: Compiled) -> list[str]:
    """The bundles that may answer, told within few calls for each bundle."""
    with calls() as counted:
        found = whole.may_answer(compiled)
    assert counted.total() < 100 * len(whole.bundles())
    return found


def test_thousands_of_bundles_are_decided_in_few_calls(place: Path) -> None:
    whole = Collection(place)
    whole.snapshot = many_bundles(2_000)
    rare = compile_query("MATCH (a:Car)-[:opposes]->(b:Truck)", whole.catalog, {})
    assert len(decided(whole, rare)) == 20

    def holding(*triples: tuple[str, str, str]) -> set[str]:
        held = {b: {r[3:6] for r in whole.snapshot.of("triple", b)} for b in whole.bundles()}
        return {bundle for bundle, rows in held.items() if rows.issuperset(triples)}

    near, seen = ("near", "car", "truck"), ("visible", "truck", "bus")
    for text, triples in (
        ("MATCH (a:Car)-[:near]->(b:Truck)-[:visible]->(c:Bus)", (near, seen)),
        ("MATCH (a:Car)-[:near]->(b:Truck) OPTIONAL MATCH (b)-[:visible]->(c:Bus)", (near,)),
        (
            "MATCH (a:Car)-[:near]->(b:Truck) WITH b, COUNT(*) AS n WHERE n > 1"
            " MATCH (b)-[:visible]->(c:Bus) RETURN n",
            (near, seen),
        ),
        (
            "MATCH (a:Car)-[:near]->(b:Truck) THEN MATCH (b)-[:visible]->(c:Bus)"
            " RETURN MIN(a.x) OVER match",
            (near, seen),
        ),
        ("MATCH (a:Car)-[:near]->(b:Truck) WHERE HAPPENS collision(a, b)", (near,)),
    ):  # each bundle has other triples
        found = decided(whole, compile_query(text, whole.catalog, {}))
        assert set(found) == holding(*triples), text
    every = compile_query("MATCH (a)-[:near|visible|opposes]->(b)-[:near]-()", whole.catalog, {})
    assert (
        len(decided(whole, every)) == 2_000
    )  # all that they hold matters, and each holds other things


def test_sql_is_asked_of_each_bundle_or_refused(whole: Collection, path: Path) -> None:
    text = "SELECT trace, count(*) AS n FROM frames GROUP BY trace ORDER BY trace"
    found = (
        "SELECT trace, count(*) AS n FROM sgql('MATCH (a:Car)-[:near]->(b)') GROUP BY 1 ORDER BY 1"
    )

    with pytest.raises(SqlError, match="--each"):
        whole.sql(text)
    with pytest.raises(QueryError, match="classes need all bundles"):
        whole.sql("SELECT * FROM sgql('MATCH (a:Car) RETURN class_count()')", each=True)
    with pytest.raises(QueryError, match="neer"):
        whole.sql("SELECT * FROM sgql('MATCH (a:Car)-[:neer]->(b)')", each=True)
    for asked in (found, text):
        rows = list(whole.sql(asked, each=True))
        assert sorted(row[1:] for row in rows) == sorted(map(tuple, Store(path).sql(asked))) != []
    assert {row[0] for row in rows} == set(whole.bundles())


def test_a_statement_of_a_users_sees_no_other_bundle(whole: Collection, place: Path) -> None:
    list(whole.find("MATCH (a:Car)"))  # all bundles are open in this process
    other = whole.bundles()[1]

    seen = "SELECT database_name FROM duckdb_databases() WHERE NOT internal"
    assert sorted(whole.sql(seen, each=True)) == sorted((b, b) for b in whole.bundles())
    for table in (
        f'"file {other}.sgstore".inside.trace',
        f"read_blob('{place / 'bundles' / other}.sgstore')",
    ):
        with pytest.raises(SqlError, match=r"does not exist|disabled"):
            list(whole.sql(f"SELECT count(*) FROM {table}", each=True))


RULES = {
    "Result": parts.MERGED,
    "Query": {
        *("scope", "result", "relations", "injective", "ego", "unknown_is_false"),
        *("steps", "links", "alternatives", "policy", "gaps", "stages", "world", "doubts"),
        "calls",  # only for texts
    },
    "BoundCheck": {
        *("name", "scope", "quantifiers", "formula", "reset", "relations", "injective", "ego"),
        *("unknown_is_false", "end", "gaps", "robustness", "returns", "world", "range", "limit"),
        *("doubts", "having"),
    },
    "Scope": {"nodes", "outer", "edges", "where", "distinct"},
    "Aggregate": {"word", "operand", "distinct", "type", "share"},
}
"""What a query may say. Of what is in ``Result`` and ``Aggregate`` the merging makes one answer; all else is
about one trace."""
VALUES = {
    *(
        "Value",
        "Choices",
        "NodeValue",
        "NodeAttribute",
        "LabelTest",
        "EdgeRelation",
        "EdgeAttribute",
    ),
    *("FrameAttribute", "TraceAttribute", "PairNumber", "Operation", "BlockValue", "Aggregate"),
    *("Tense", "SignalCall", "StepTime", "OverMatch", "GroupKey", "Happened"),
}
"""Values: but for ``Aggregate`` and two units of ``FrameAttribute`` they speak of one trace."""
UNITS = {
    *("plain", "degrees", "east", "north", "up", "light", "derived", "along", "given", "velocity"),
    *("standing", "binding", "owner", "whole", "label", "seconds", "classed", "weather", "clock"),
    *("span", "role", "recording", "own", "counted", "seen", "inside", "chain"),
}
"""Units: ``counted`` and ``seen`` speak of all traces, and are given to each bundle
(lang/sql/collection_parts.py)."""


def test_merging_knows_all_that_a_query_may_say() -> None:
    """What fails here is new in the language: say in lang/sql/collection_parts.py how answers of bundles are
    merged.

    Then say it here, and ask it in ``QUESTIONS``.
    """
    for name, known in RULES.items():
        assert {one.name for one in fields(getattr(ir, name))} == known, name
    assert {of.__name__ for of in get_args(ir.Bound)} == VALUES
    assert {str(unit) for unit in _catalog.DisplayUnit} == UNITS
    assert {of.__name__ for of in get_args(syntax.Statement)} == {
        *("MatchClause", "UnionClause", "Define", "CheckClause"),
    }
    assert set(AGGREGATES) == parts.SUMMED | parts.LISTED


def test_what_merging_does_not_know_is_refused(whole: Collection) -> None:
    ready = compile_query("MATCH (a:Car) RETURN AVG(a.x)", whole.catalog, {})
    result = ready.bound.result
    (column,) = result.columns
    strange = replace(column, value=replace(column.value, word="mode"))
    asked = replace(ready, bound=replace(ready.bound, result=replace(result, columns=(strange,))))

    with pytest.raises(QueryError, match="mode"):
        parts.parted(asked)


def test_mistakes_are_told_before_a_bundle_is_opened(whole: Collection) -> None:
    whole.opened = []
    with pytest.raises(QueryError, match="neer"):
        whole.find("MATCH (a)-[:neer]->(b)")
    with pytest.raises(QueryError, match="unknown dataset"):
        whole.find("USING DATASET nothing MATCH (a)")
    with pytest.raises(QueryError, match="unknown ego"):
        whole.find("USING EGO nobody MATCH (a)")
    assert whole.opened == []


def tables_of(path: Path) -> dict[str, list[tuple[Any, ...]]]:
    file = StoreFile(path)
    listed = "SELECT table_name FROM duckdb_tables() WHERE schema_name = 'inside' ORDER BY ALL"
    names = [row[0] for row in file.rows(listed).values]
    return {
        name: file.rows(f"FROM {name} ORDER BY ALL").values
        for name in names
        if name != "store_info"
    }


@pytest.mark.parametrize("together", [64, 2] if LONG else [2])
def test_a_store_that_is_packed_and_unpacked_is_the_same(
    path: Path, place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, together: int
) -> None:
    monkeypatch.setattr(_bundles, "TOGETHER", together)

    names = unpack(place, tmp_path / "again.sgstore")

    assert names == [f"trace{number}" for number in range(1, TRACES + 1)]
    assert tables_of(tmp_path / "again.sgstore") == tables_of(path)


def test_the_database_of_a_bundle_leaves_memory_for_its_process(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    scratch = _bundles.scratch

    def seen(spill: Path, *, memory: int, threads: int) -> Any:
        asked.append(memory)
        return scratch(spill, memory=memory, threads=threads)

    monkeypatch.setattr(_bundles, "scratch", seen)
    pack(path, tmp_path / "c")

    assert 0 < max(asked) <= 0.7 * _bundles.default_memory()


def test_what_is_there_is_left_as_it_is(path: Path, tmp_path: Path) -> None:
    pack(path, tmp_path / "c", bundle_traces=3)
    before = sorted((tmp_path / "c").rglob("*"))
    done = pack(path, tmp_path / "c")

    assert (done.added, done.bundles, done.number) == ([], [], 1)
    assert len(done.present) == TRACES
    assert sorted((tmp_path / "c").rglob("*")) == before


def test_a_changed_byte_is_found_and_the_bundle_named(place: Path, tmp_path: Path) -> None:
    shutil.copytree(place, tmp_path / "c")
    bundle = min((tmp_path / "c" / "bundles").iterdir())
    data = bytearray(bundle.read_bytes())
    data[len(data) // 2] ^= 1
    bundle.write_bytes(data)

    with pytest.raises(PartialAnswerError, match="not as it was committed") as refused:
        Collection(tmp_path / "c").find("MATCH (a:Car)").rows()
    assert [*refused.value.bundles] == [bundle.stem]
    partial = Collection(tmp_path / "c", partial=True)
    assert partial.find("MATCH (a:Car)").rows()
    assert [*partial.missing] == [bundle.stem]
    faults = verify(tmp_path / "c").faults
    assert [one[0] for one in faults if one[1] == "file"] == [bundle.stem]


def test_two_traces_with_one_id_are_refused_by_name(path: Path, tmp_path: Path) -> None:
    import duckdb

    other = tmp_path / "other.sgstore"
    shutil.copy(path, other)
    with duckdb.connect(str(other)) as connection:
        recording = "(SELECT recording_id FROM inside.trace WHERE name = 'trace2')"
        sql = f"UPDATE inside.recording SET digest = 'another' WHERE recording_id = {recording}"
        connection.execute(sql)
        connection.execute("UPDATE inside.trace SET name = 'stranger' WHERE name = 'trace2'")
    pack(path, tmp_path / "c")

    with pytest.raises(StoreError, match=r"'trace2'.*'stranger'"):
        pack(other, tmp_path / "c")
    assert len(Collection(tmp_path / "c").traces()) == TRACES


def test_garbage_goes_and_what_is_spoken_of_stays(path: Path, tmp_path: Path) -> None:
    place = tmp_path / "c"
    pack(path, place, bundle_traces=3)
    stray = place / "bundles" / f"{'0' * 64}.sgstore"
    stray.write_bytes(b"left behind")

    assert gc(place).young == 1
    assert gc(place, older_s=0, dry_run=True).names == [f"bundles/{stray.name}"]
    assert stray.exists()
    assert gc(place, older_s=0).size == len(b"left behind")
    assert not stray.exists()
    assert Collection(place).find("MATCH (a:Car)").count()


def test_a_folder_that_is_no_collection_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="not a collection"):
        Collection(tmp_path)


OF_RAY = (
    '\x1b[36mray::_done()\x1b[39m (pid=12, ip=10.0.0.1)\n  File "a.py", line 3, in _done\n    f(task)\n'
    "    ^^^^^^^\nKeyError: 'bundle'\n\nDuring handling of the above exception, another one occurred:\n\n"
    '\x1b[36mray::_done()\x1b[39m (pid=12, ip=10.0.0.1)\n  File "b.py", line 4, in f\nValueError: no 7\nat all'
)
OF_SPARK = (
    "An error occurred while calling z:org.apache.spark.api.python.PythonRDD.collectAndServe.\n"
    ": org.apache.spark.SparkException: Job aborted due to stage failure: Task 0 in stage 0.0 failed 4 times\n"
    'Traceback (most recent call last):\n  File "a.py", line 3, in main\n    f()\nMemoryError: 9 GB\n\n'
    "\tat org.apache.spark.api.python.BasePythonRunner.handle(PythonRunner.scala:572)"
)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (OF_RAY, "ValueError: no 7"),
        (OF_SPARK, "MemoryError: 9 GB"),
        ("\n\x1b[31mThe worker died.\x1b[39m\nSee its logs.", "The worker died."),
        ("", "RuntimeError"),
    ],
)
def test_what_a_task_raised_far_away_is_told_in_one_plain_line(text: str, line: str) -> None:
    assert engines._cause(RuntimeError(text)) == line


@pytest.mark.parametrize("where", ["{fleet}", "s3://bucket/fleet"])
@pytest.mark.parametrize(
    "verb",
    [
        "export {} MATCH+(a:Car)",
        "show {} trace1@1",
        "timeline {} MATCH+(a:Car)",
        "shrink {} MATCH+(a:Car)",
        "prioritize {}",
        "criticality {}",
    ],
)
def test_what_is_asked_of_one_store_names_the_verb_that_makes_one(
    verb: str,
    where: str,
    place: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    url = where.format(fleet=place)
    words = verb.format(url).split()

    assert run_verb([word.replace("+", " ") for word in words]) == 1
    told = capsys.readouterr().err
    assert told.startswith(f"sgstore: {url}: a collection, and ")
    assert told.endswith(
        f" one store: 'sgstore collection unpack {url} all.sgstore' makes one of it\n"
    )
    assert told.count("\n") == 1


def test_verbs_ask_collections_as_they_ask_stores(
    path: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(*arguments: str) -> Any:
        assert run_verb([*arguments]) == 0
        return json.loads(capsys.readouterr().out)

    for verb in (["find", QUESTIONS[7]], ["check", "-e", CHECKS[0]]):
        one, *rest = verb
        answers = [said(one, str(of), *rest, "--json") for of in (path, place)]
        assert answers[0] == answers[1]
    assert run_verb(["sql", str(place), "SELECT 1"]) == 2
    assert "--each" in capsys.readouterr().err
    assert [row["trace"] for row in said("info", str(place), "--json")] == [
        f"trace{number}" for number in range(1, TRACES + 1)
    ]
    assert said("sql", str(place), "SELECT count(*) AS n FROM frames", "--each", "--json")
    assert run_verb(["find", str(place), "MATCH (a:Car)", "--count"]) == 0
    assert int(capsys.readouterr().out) == Store(path).find("MATCH (a:Car)").count()
    assert run_verb(["collection", "gc", str(place), "--dry-run", "--json"]) == 0


def test_what_is_wrong_with_a_question_is_no_fault_of_a_bundle(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for engine in ("local", "local:2"):
        for partial in (False, True):
            whole = Collection(place, engine=engine, partial=partial)
            with pytest.raises(SqlError, match='column "nope" was not found'):
                list(whole.sql("SELECT nope", each=True))
            assert not whole.missing
    assert run_verb(["sql", str(place), "SELECT nope", "--each", "--partial"]) == 2
    said = capsys.readouterr().err
    assert 'column "nope" was not found' in said
    assert "bundle" not in said

    span, text = TextSpan(6, 9), "MATCH (a)"
    refused = QueryNameError("no such thing", text=text, span=span, hint="did you mean b?")

    def refuses(task: dict[str, Any]) -> dict[str, Any]:
        raise refused

    monkeypatch.setattr(worker, "answer", refuses)
    with pytest.raises(QueryNameError) as found:
        Collection(place, partial=True).find("MATCH (a:Car)").rows()
    assert (str(found.value), found.value.as_dict()) == (str(refused), refused.as_dict())


def test_a_catalogue_of_before_knows_no_scopes(tmp_path: Path) -> None:
    columns = {"bundle": "VARCHAR", "trace_id": "BIGINT"}
    path = tmp_path / "trace.parquet"
    ParquetTable.write_rows([*columns], [("b", 7)], path, [*columns.values()])

    assert ParquetTable.read_rows(path, [*columns, "scope"], "scope") == [("b", 7, None)]
    snapshot = catalogue.Snapshot()
    assert snapshot.scope(world=True) == {}


# The engine Ray, after the death of Ray itself --------------------------------------------------------


class FakeRay(ModuleType):
    """Ray whose tasks fail after a number of results, as often as it should die."""

    def __init__(self, deaths: int, after: int) -> None:
        super().__init__("ray")
        error = type("RayError", (Exception,), {})
        names = ("RaySystemError", "LocalRayletDiedError", "RayTaskError")
        kinds = {name: type(name, (error,), {}) for name in names}
        self.exceptions = SimpleNamespace(RayError=error, **kinds)
        self.deaths, self.after, self.done, self.starts, self.runs = deaths, after, 0, 0, False

    def is_initialized(self) -> bool:
        return self.runs

    def init(self, **_settings: Any) -> None:
        self.starts, self.runs, self.done = self.starts + 1, True, 0

    def shutdown(self) -> None:
        self.runs = False

    def remote(self, **_settings: Any) -> Callable[[Any], Any]:
        return lambda _function: SimpleNamespace(remote=lambda _name, task: (task["bundle"],))

    def wait(self, pending: list[Any], **_settings: Any) -> tuple[list[Any], list[Any]]:
        return pending[:1], pending[1:]

    def get(self, one: tuple[str]) -> dict[str, Any]:
        if self.deaths and self.done == self.after:
            self.deaths -= 1
            raise self.exceptions.LocalRayletDiedError("the raylet died")
        if one[0] == "bad":
            raise self.exceptions.RayTaskError("broken")
        self.done += 1
        return {"bundle": one[0], "answer": 1}


@pytest.mark.parametrize(("deaths", "starts", "failed"), [(0, 1, 0), (1, 2, 0), (2, 2, 2)])
def test_ray_is_started_again_once(
    deaths: int, starts: int, failed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray = FakeRay(deaths, after=1)
    monkeypatch.setitem(sys.modules, "ray", ray)
    tasks = [{"bundle": name} for name in ("a", "b", "bad", "c")]

    found = [*engines.engine_named("ray").map(engines._done, tasks)]

    assert ray.starts == starts
    assert sorted(one["bundle"] for one in found) == ["a", "b", "bad", "c"]
    assert sum("Ray died" in one.get("error", "") for one in found) == failed
    assert [one["bundle"] for one in found if one.get("error") == "broken"] == ["bad"] * (
        not failed
    )


@pytest.mark.parametrize(
    "condition",
    [
        "trace.name = 'trace3'",
        "trace.name IN ['trace1', 'trace2'] AND a.x > 0",
        "NOT trace.name STARTS WITH 'trace' OR trace.frames > 1000000",
        "trace.duration > 0 AND trace.period < 1 AND trace.ego = 'hero1'",
        "trace.map IS NULL AND trace.id > 0",
        "trace.flavour = 'osi'",
    ],
)
def test_traces_that_the_query_excludes_need_no_reason(
    condition: str, whole: Collection, store: Store
) -> None:
    query = f"MATCH (a)-[:sees]->(b:Bicycle) WHERE {condition}"
    one, other = whole.find(query), store.find(query)
    every = store.find("MATCH (a)-[:sees]->(b:Bicycle)").reasons
    at_once = one.reasons
    one.count()

    assert len(every) > 1
    assert one.reasons == other.reasons
    assert "flavour" in condition or at_once == other.reasons
