"""Clocks jitter: times that miss a bound by a hundredth of a period, or by a microsecond, keep it."""

from __future__ import annotations

import random
import re
from collections import Counter
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from oracle_over_time import condition, edge_questions, random_sequence, worlds
from recordings import Recorder, car
from thorough import LONG

import sgstore
from sgstore.errors import StoreError
from sgstore.exporters import Export, write_export
from sgstore.graphs.online import Frame
from sgstore.ingest import ingest
from sgstore.model.world import tolerance_ns
from sgstore.query import Store
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.seconds(11)

JITTER_NS = 400_000
"""Two times that are off by so much each differ by less than a hundredth of 0.1 s."""


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Store, Store]]:
    """A random world, and the same with clocks that jitter."""
    folder = tmp_path_factory.mktemp("worlds")
    stores: list[Store] = []
    for name in ("even", "odd"):
        (folder / name).mkdir()
        _, store = worlds(11, folder / name)
        stores.append(store)
    stores[1].close()
    with duckdb.connect(str(stores[1].file.path)) as connection:
        off = f"CAST(hash(frame_id) % {2 * JITTER_NS} AS BIGINT) - {JITTER_NS}"
        connection.execute(
            f"UPDATE inside.frame SET time_ns = time_ns + {off}, log_time_ns = log_time_ns + {off}"
        )
        connection.execute(
            "UPDATE inside.trace SET start_ns = first, end_ns = last FROM (SELECT trace_id AS id,"
            " min(time_ns) AS first, max(time_ns) AS last FROM inside.frame GROUP BY 1) WHERE id = trace_id"
        )
    even, odd = stores[0], sgstore.open(stores[1].file.path)
    with even.file.snapshot(), odd.file.snapshot():
        yield even, odd


def same(pair: tuple[Store, Store], text: str) -> int:
    """Ask two stores; the number of rows that both have."""
    even, odd = (Counter(tuple(row) for row in store.find(text)) for store in pair)
    assert even == odd, (text, even - odd, odd - even)
    return sum(even.values())


def test_jitter_changes_no_sequence(pair: tuple[Store, Store]) -> None:
    rng, found = random.Random(5), 0
    for number in range(40 if LONG else 15):
        policy = ("all", "first", "longest")[number % 3]
        text = f"USING UNKNOWN false, MATCHES {policy} {random_sequence(rng)}"
        even, odd = (
            Counter((i.trace, i.start_seq, i.end_seq) for i in store.find(text).intervals())
            for store in pair
        )
        assert even == odd, (text, even - odd, odd - even)
        found += sum(even.values())

    assert found > (20 if LONG else 5)


def test_jitter_changes_no_condition_over_time(pair: tuple[Store, Store]) -> None:
    rng, found = random.Random(6), 0
    for _ in range(30 if LONG else 12):
        where = condition(rng, pair=True, depth=rng.randint(0, 2), temporal=True)
        pattern = f"USING UNKNOWN false MATCH (e:Ego), (v:Entity) WHERE {where}"
        found += same(pair, f"{pattern} RETURN trace.name, frame.seq, e, v, delta(e.x, 0.2s) AS d")
    for pattern, where, _ in edge_questions(rng):
        found += same(
            pair, f"USING UNKNOWN false MATCH {pattern} WHERE {where} RETURN frame.id, e, v"
        )

    assert found > 100


def test_jitter_changes_no_verdict(pair: tuple[Store, Store]) -> None:
    rng, told = random.Random(7), Counter[str]()
    for number in range(30 if LONG else 12):
        end = ("strong", "weak", "pending")[number % 3]
        formula = condition(rng, pair=False, depth=rng.randint(1, 3), temporal=True)
        formula = re.sub(r"\be\b", "ego", formula)
        text = f"USING UNKNOWN false, END {end} CHECK c: {formula}"
        even, odd = (
            {
                v.trace: (v.verdict, [(i.start_seq, i.end_seq) for i in v.violations])
                for v in store.check(text)
            }
            for store in pair
        )
        assert even == odd, text
        told.update(verdict for verdict, _ in even.values())

    assert told["false"] > (5 if LONG else 1)


def test_jitter_changes_no_number_of_clips(pair: tuple[Store, Store]) -> None:
    for pattern in ("(e:Ego)", "(e:Ego)-[:near]->(v)", "(v:Car) WHERE v.speed > 1"):
        text = f"MATCH {pattern} RETURN FRAMES LIMIT 100"
        many = [len(list(store.find(text).clips(0.05, 0.05))) for store in pair]

        assert many[0] == many[1]


ONLINE = """
MATCH (v:Vehicle) WHERE v.speed > 5 FOR >= 0.3s;
MATCH (v:Vehicle) WHERE v.speed > 5 FOR < 0.3s;
MATCH (v:Vehicle) WHERE v.speed > 5 FOR > 0.2s AS a THEN WITHIN 0.3s MATCH (v) WHERE v.speed < 2;
MATCH (v:Vehicle) WHERE v.speed > 5 THEN AFTER 0.2s WITHIN 0.4s MATCH (v) WHERE v.speed < 2;
MATCH (v:Vehicle) WHERE v.speed > 5 THEN WITHIN 0.2s NOT MATCH (v) WHERE v.speed < 2;
MATCH (v:Vehicle) WHERE EVENTUALLY[0.1s, 0.2s] v.speed < 2 AND ONCE[0.2s, 0.3s] v.speed > 5;
MATCH (v:Vehicle) WHERE delta(v.speed, 0.3s) > 3 AND run_length(v.speed > 5) <= 0.2s;
MATCH (v:Vehicle) WHERE since_true(v.speed > 5) = 0.2s OR age(v) < 0.3s;
CHECK slow: ALWAYS (ego.speed > 5 IMPLIES EVENTUALLY[0s, 0.2s] ego.speed < 2) RESET WHEN ego.speed < 1;
CHECK late: ALWAYS (ego.speed < 2 IMPLIES EVENTUALLY[0.3s, 0.5s] ego.speed > 5) RESET WHEN ego.speed > 5
"""


def test_jitter_changes_nothing_that_a_monitor_tells() -> None:
    found = 0
    for seed in range(12):
        rng = random.Random(seed)
        speeds = [rng.choice((0.0, 3.0, 8.0)) for _ in range(40)]
        times = [100_000_000 * (n + 3 * (n > 20)) for n in range(40)]
        off = [rng.randint(-JITTER_NS, JITTER_NS) for _ in speeds]
        even, odd = (
            watched(speeds, [t + o * on for t, o in zip(times, off, strict=True)]) for on in (0, 1)
        )
        assert even == odd, seed
        found += len(even)

    assert found > 200


MARGINS = """
CHECK far: ALWAYS (ego.speed > 5 IMPLIES EVENTUALLY[0s, 0.2s] ego.speed < 2) ROBUSTNESS;
CHECK near: ALWAYS (ego.speed < 2 IMPLIES EVENTUALLY[0.3s, 0.5s] ego.speed > 5) ROBUSTNESS;
CHECK back: ALWAYS (ego.speed < 2 IMPLIES ONCE[0.1s, 0.3s] ego.speed > 5) ROBUSTNESS;
CHECK kept: ALWAYS (ego.speed > 5 IMPLIES (ego.speed > 2 UNTIL[0.1s, 0.3s] ego.speed < 2)) ROBUSTNESS;
CHECK past: ALWAYS (ego.speed < 2 IMPLIES (ego.speed < 5 SINCE[0.1s, 0.3s] ego.speed > 5)) ROBUSTNESS
"""


def test_jitter_changes_no_margin_of_a_monitor() -> None:
    found: set[tuple[Any, ...]] = set()
    for seed in range(3):
        rng = random.Random(seed)
        speeds = [rng.choice((0.0, 3.0, 8.0)) for _ in range(14)]
        times = [100_000_000 * n for n in range(14)]
        off = [rng.randint(-JITTER_NS, JITTER_NS) for _ in speeds]
        even, odd = (
            margins(speeds, [t + o * on for t, o in zip(times, off, strict=True)]) for on in (0, 1)
        )
        assert even == odd, seed
        found.update(even)

    assert len(found) > 7


def margins(speeds: list[float], times: list[int]) -> list[tuple[Any, ...]]:
    monitor = Monitor(MARGINS, period_s=0.1)
    for speed, time_ns in zip(speeds, times, strict=True):
        monitor.step(driven(speed, time_ns))
    found = ((v.check, v.verdict, v.robustness) for v in monitor.finish())
    return [(name, verdict, of and (of.value, of.condition, of.seq)) for name, verdict, of in found]


def driven(speed: float, time_ns: int) -> Frame:
    frame = Frame(time_ns=time_ns, ego="ego")
    size = {"heading": 0.0, "length": 4.0, "width": 2.0}
    frame.add("ego", "car", 0.0, 0.0, 0.0, **size, vx=speed, vy=0.0)
    return frame


def watched(speeds: list[float], times: list[int]) -> list[tuple[Any, ...]]:
    monitor = Monitor(ONLINE, period_s=0.1)
    told: list[Any] = []
    for speed, time_ns in zip(speeds, times, strict=True):
        told += monitor.step(driven(speed, time_ns))
    verdicts = monitor.finish()
    events = [(e.kind, e.name, e.told.seq, e.start.seq, e.end.seq) for e in told]
    return events + [(v.check, v.verdict, len(v.violations)) for v in verdicts]


# Recordings


TRUNCATED = [n * 0.05 - (1e-9 if n % 3 else 0) for n in range(20)]
"""Times of frames as esmini has them: cut off below the nanosecond."""


@pytest.fixture(scope="module")
def truncated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Store]]:
    """A recording with such times, of which frames 10 and 11 are missing, and its store."""
    folder = tmp_path_factory.mktemp("truncated")
    path = folder / "cut.mcap"
    with Recorder(path) as recorder:
        for n, time in enumerate(TRUNCATED):
            if n not in {10, 11}:
                recorder.ground_truth(time, [car(7, 10 * time, v=(10 if n < 9 else 2, 0))], host=7)
    store = folder / "cut.sgstore"
    ingest(store, [path])
    opened = Store(store)
    with opened.file.snapshot():
        yield path, opened


def test_a_frame_is_found_at_the_time_that_it_should_have(truncated: tuple[Path, Store]) -> None:
    _, store = truncated

    for n, seq in ((0, 0), (1, 1), (8, 8), (19, 17)):
        assert store.file.frame(f"cut@{n * 0.05:.2f}s").seq == seq
    assert store.file.frame("cut@0.049s").seq == 0
    with pytest.raises(StoreError, match="no frame at"):
        store.file.frame("cut@0.952s")


def test_a_part_of_a_recording_ends_with_the_frames_at_its_ends(
    truncated: tuple[Path, Store], tmp_path: Path
) -> None:
    path, _ = truncated
    ingest(tmp_path / "part.sgstore", [path], since=0.1, until=0.35)

    rows = Store(tmp_path / "part.sgstore").sql("SELECT min(time_ns), max(time_ns) FROM frames")

    assert [round(t / 1e9, 6) for t in rows.values[0]] == [0.1, 0.35]


def test_a_clip_has_the_frames_at_its_ends(truncated: tuple[Path, Store], tmp_path: Path) -> None:
    _, store = truncated
    clips = list(store.find("MATCH (e:Ego) WHERE frame.seq = 3").clips(0.1, 0.1))
    rows = store.sql("SELECT seq, log_time_ns FROM frames ORDER BY seq").values
    lies = {seq for seq, log in rows if clips[0].start_ns - 500 <= log <= clips[0].end_ns + 500}

    (written,) = write_export(Export(store, tuple(clips)), tmp_path / "clips")
    ingest(tmp_path / "clip.sgstore", [written.file])
    (trace,) = Store(tmp_path / "clip.sgstore").info()

    assert lies == set(range(1, 6))
    assert trace.frames == 5


def test_a_table_of_ones_own_meets_frames_half_a_period_off(truncated: tuple[Path, Store]) -> None:
    path = truncated[1].file.path
    table = path.with_name("mine.csv")
    lines = [f"cut,{time:.3f},{n}" for n, time in enumerate((0.1, 0.975, 0.977))]
    table.write_text("\n".join(["trace,t,label", *lines]))
    store = sgstore.open(path, tables={"mine": table})

    rows = store.sql("SELECT frame_id & 63, label FROM mine ORDER BY label").values

    assert [row[0] for row in rows] == [2, 17, None]


def test_a_gap_is_told_apart_with_the_same_tolerance_everywhere(tmp_path: Path) -> None:
    # Steps of 2.5 periods, give or take 1 ns: no gap. And of 2.52: one.
    steps = [0.1] * 9 + [0.25 + 2e-9, 0.1, 0.25 - 2e-9, 0.1, 0.252, 0.1]
    path, time = tmp_path / "steps.mcap", 0.0
    with Recorder(path) as recorder:
        for step in [0.0, *steps]:
            time += step
            recorder.ground_truth(time, [car(7, time, v=(1, 0))], host=7)
    ingest(tmp_path / "s.sgstore", [path])
    store = Store(tmp_path / "s.sgstore")
    spans = [(i.start_seq, i.end_seq) for i in store.find("MATCH (e:Ego)").intervals()]
    held = store.find("MATCH (e:Ego) FOR >= 0.1s").intervals()
    (trace,) = store.info()

    assert spans == [(0, 13), (14, 15)]
    assert [(i.start_seq, i.end_seq) for i in held] == spans
    assert trace.report["gaps"] == 1
    assert not store.file.verify().faults


def test_the_tolerance_is_a_hundredth_of_the_period_and_at_least_a_microsecond() -> None:
    assert [tolerance_ns(ns) for ns in (0, 1_000, 50_000_000)] == [1_000, 1_000, 500_000]
