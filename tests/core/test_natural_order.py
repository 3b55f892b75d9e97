"""Rows come by name of the trace as people count, then by time, wherever nothing else is said."""

from __future__ import annotations

import csv
import json
from itertools import groupby, pairwise
from typing import TYPE_CHECKING, Any

import pytest
from recordings import Recorder, car

from sgstore import matches as streams
from sgstore.apps.cli import run as run_verb
from sgstore.ingest import ingest
from sgstore.query import Store
from sgstore.testsets.diff import verdicts

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

NAMES = ["t1", "t2", "T3", "t10", "t11"]
"""In order."""

CARS = "MATCH (a:Car)-[:near]->(b:Car)"
MOVES = "MATCH (e:Ego) WHERE e.speed > 1 THEN MATCH (e) WHERE e.speed > 1"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """Five traces of several buckets, read in another order; one has no ego."""
    folder = tmp_path_factory.mktemp("order")
    for number, name in enumerate(NAMES):
        with Recorder(folder / f"{name}.mcap") as recorder:
            for i in range(130 + number):
                moving = [car(7, i, v=(10, 0)), car(8, i + 12, v=(9, 0)), car(9, i + 6, 3)]
                recorder.ground_truth(i * 0.1, moving, host=None if name == "t2" else 7)
    shuffled = ["t10", "T3", "t11", "t1", "t2"]
    ingest(folder / "s.sgstore", [folder / f"{name}.mcap" for name in shuffled])
    store = Store(folder / "s.sgstore")
    ids = [store.file.trace(name).trace_id for name in NAMES]
    assert ids != sorted(ids)
    assert any(min(two) < one < max(two) for two in pairwise(ids) for one in ids)
    with store.file.snapshot():
        yield store


@pytest.fixture(params=[1, 4, 7, 64])
def windowed(
    store: Store, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Store:
    """The store, looked at in windows: parts of traces, some traces, or all at once."""
    in_windows(monkeypatch, request.param)
    return store


def in_windows(monkeypatch: pytest.MonkeyPatch, first: int) -> None:
    """Every answer comes in windows, the first of which is so long."""
    for name in ("FIRST_WINDOW", "LAST_WINDOW"):
        monkeypatch.setattr(streams, name, first)


def in_order(rows: list[Any], ego: bool = False) -> None:
    """Rows are ``(trace, time)``: each trace once, in order, and time does not go back in it."""
    assert [name for name, _ in groupby(rows, lambda row: row[0])] == [
        name for name in NAMES if not (ego and name == "t2")
    ]
    for _, of_trace in groupby(rows, lambda row: row[0]):
        times = [time for _, time in of_trace]
        assert times == sorted(times)


@pytest.mark.parametrize(
    "told",
    [
        "RETURN trace.name, frame.seq",
        "RETURN trace.name, frame.seq, a.name, b.name",
        "RETURN DISTINCT trace.name, frame.seq",
        "RETURN trace.name, frame.seq, COUNT(*)",
        "RETURN trace.name, COUNT(*)",
        "RETURN trace.name, MIN(frame.seq) ORDER BY MIN(frame.seq)",
        "RETURN trace.name AS name, frame.seq, COUNT(*) LIMIT 100000",
        "RETURN trace.name, a.name, COUNT(*) ORDER BY COUNT(*) > 0",
        "RETURN trace.name, frame.seq ORDER BY a.speed IS NULL AND FALSE",
        "RETURN trace.name, frame.seq SAMPLE 3 PER trace.name",
        "RETURN trace.name, frame.seq LIMIT 100000",
    ],
)
def test_values_come_in_order(windowed: Store, told: str) -> None:
    rows = windowed.find(f"{CARS} {told}").rows()

    in_order([(row[0], row[1] if "seq" in told.partition("ORDER")[0] else 0) for row in rows])


@pytest.mark.parametrize(
    "told",
    [
        "",
        "LIMIT 100000",
        "RETURN FRAMES",
        "RETURN FRAMES, a.name",
        "RETURN FRAMES, a.speed > 1000 AS fast ORDER BY fast",
        "RETURN FRAMES SAMPLE 5 PER trace",
        "RETURN DISTINCT *",
        "RETURN SUBGRAPHS",
    ],
)
def test_frames_come_in_order(windowed: Store, told: str) -> None:
    rows = windowed.find(f"{CARS} {told}").rows()

    in_order([(row[1], row[2]) for row in rows])


@pytest.mark.parametrize("text", [CARS, f"{CARS} RETURN INTERVALS", f"{CARS} LIMIT 100000"])
def test_every_way_of_asking_tells_in_order(windowed: Store, text: str) -> None:
    found = windowed.find(text)

    in_order([(one.trace, one.seq) for one in found.frames()])
    in_order([(one.trace, one.start_seq) for one in found.intervals()])
    in_order([(one.trace, one.start_ns) for one in found.clips()])
    in_order([(one.graph["trace"], one.graph["seq"]) for one in found.subgraphs()])


@pytest.mark.parametrize("text", [MOVES, "MATCH (e:Ego) WHERE EVENTUALLY e.speed > 1"])
def test_what_looks_at_several_frames_comes_in_order(windowed: Store, text: str) -> None:
    found = windowed.find(text)

    in_order([(row[1], row[2]) for row in found], ego=True)
    in_order([(one.trace, one.seq) for one in found.frames()], ego=True)
    in_order([(one.trace, one.start_seq) for one in found.intervals()], ego=True)
    in_order([(one.trace, one.start_ns) for one in found.clips()], ego=True)


def test_the_same_is_found_in_windows_of_any_size(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = [CARS, f"{CARS} RETURN INTERVALS", MOVES, f"{CARS} RETURN FRAMES, a.name"]
    whole = [store.find(text).rows() for text in texts]

    for size, rows in ((1, 200_000), (1, 40), (4, 200_000), (7, 3_000), (9, 10)):
        in_windows(monkeypatch, size)
        monkeypatch.setattr(streams, "ROWS", rows)
        assert [store.find(text).rows() for text in texts] == whole


def test_a_limit_takes_the_first_traces_and_reads_no_more(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streams, "FIRST_WINDOW", 1)
    asked: list[Any] = []
    batches = type(store.file).batches

    def counted(self: Any, *args: Any, **given: Any) -> Any:
        asked.append(args)
        return batches(self, *args, **given)

    monkeypatch.setattr(type(store.file), "batches", counted)

    assert [row[1] for row in store.find(f"{CARS} LIMIT 3")] == ["t1"] * 3
    assert len(asked) == 1


def test_verdicts_come_in_order_unknown_ones_among_them(windowed: Store) -> None:
    texts = "CHECK fast: ALWAYS ego.speed > 1; CHECK all: FORALL (v:Car) ALWAYS v.speed < 99"
    found = [(one.check, one.trace, one.verdict) for one in windowed.check(texts)]

    assert [row[:2] for row in found] == [(c, name) for c in ("fast", "all") for name in NAMES]
    assert {name for _, name, verdict in found if verdict == "unknown"} == {"t2"}
    table = verdicts(windowed, windowed, texts, {})
    assert [row[1:3] for row in table.rows] == [row[:2] for row in found]


def test_verbs_tell_in_order(
    windowed: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(windowed.file.path)

    def told(*asked: str) -> list[dict[str, Any]]:
        assert run_verb([asked[0], path, *asked[1:], "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    in_order([(row["trace"], row["seq"]) for row in told("find", CARS)])
    in_order([(row["trace"], row["start_seq"]) for row in told("find", f"{CARS} RETURN INTERVALS")])
    assert [row["trace"] for row in told("check", "-e", "CHECK c: ALWAYS ego.speed > 1")] == NAMES
    assert [row["trace"] for row in told("info")] == NAMES

    lock, out = tmp_path / "cases.lock", tmp_path / "clips"
    assert run_verb(["select", path, CARS, "--unit", "trace", "-o", str(lock)]) == 0
    document = json.loads(lock.read_text())
    assert [one["name"] for one in document["traces"]] == NAMES
    assert [one["trace"] for one in document["cases"]] == NAMES
    assert run_verb(["lock", "union", str(lock), str(lock), "-o", str(tmp_path / "b.lock")]) == 0
    both = json.loads((tmp_path / "b.lock").read_text())
    assert [one["trace"] for one in both["cases"]] == NAMES
    capsys.readouterr()
    assert run_verb(["export", path, CARS, "--as", "frames", "--to", str(out)]) == 0
    with (out / "frames.csv").open(newline="") as stream:
        in_order([(row["trace"], int(row["seq"])) for row in csv.DictReader(stream)])
