"""Stored precision and requested precision: a number of 32 bits is compared with a number of 32 bits."""

from __future__ import annotations

import csv
import math
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from recordings import Recorder, car

import sgstore
from sgstore.apps.cli import run as run_verb
from sgstore.base.json_text import float32, shortest
from sgstore.ingest import ingest
from sgstore.model.config import Config
from sgstore.temporal import Monitor, opened

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.query import Store

FRAMES = 100
SPEED, WIDTH, LENGTH = 8.3, 1.8, 4.7
ANGLES, YAW_RATE = (12.3, 1.7, -3.3), 5.3
"""Numbers that 32 bits hold as less, or more, than the text."""


def _things(t: float) -> list[Any]:
    """An ego and a car of equal speed, width and length, and a slower car."""
    things = [
        car(7, SPEED * t, v=(SPEED, 0.0), a=(-3.1, 0.0), yaw=math.pi, name="Ego"),
        car(3, 20 + SPEED * t, v=(SPEED, 0.0)),
        car(4, -10 + 5 * t, v=(5.0, 0.0)),
    ]
    for thing in things[:2]:
        thing.base.dimension.width, thing.base.dimension.length = WIDTH, LENGTH
    turned, rate = things[2].base.orientation, things[2].base.orientation_rate
    turned.yaw, turned.pitch, turned.roll = (math.radians(angle) for angle in ANGLES)
    rate.yaw = math.radians(YAW_RATE)
    return things


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its clock loses the last nanosecond of every other frame, as those of simulators do."""
    path = tmp_path_factory.mktemp("precision") / "drive.mcap"
    with Recorder(path) as recorder:
        for i in range(FRAMES):
            t = i * 0.1
            stamp = t - (1e-9 if i % 2 else 0)
            recorder.ground_truth(t, _things(t), host=7, stamp=stamp)
    return path


@pytest.fixture(scope="module")
def store(recording: Path) -> Iterator[Store]:
    path = recording.with_name("drives.sgstore")
    ingest(path, [recording])
    with sgstore.open(path) as opened:
        yield opened


CONDITIONS: list[tuple[str, str, int]] = [
    ("v.speed > 8.3", "speed > 8.3", 0),
    ("v.speed >= 8.3", "speed >= 8.3", 2 * FRAMES),
    ("v.speed = 8.3", "speed = 8.3", 2 * FRAMES),
    ("v.speed <> 8.3", "speed <> 8.3", FRAMES),
    ("8.3 < v.speed", "8.3 < speed", 0),
    ("v.speed IN [8.3, 7.1]", "speed IN (8.3, 7.1)", 2 * FRAMES),
    ("v.vx <= 8.3", "vx <= 8.3", 3 * FRAMES),
    ("v.width >= 1.8", "width >= 1.8", 3 * FRAMES),
    ("v.width <= 1.8", "width <= 1.8", 2 * FRAMES),
    ("v.length = 4.7", "length = 4.7", 2 * FRAMES),
    ("v.ax <= -3.1", "ax <= -3.1", FRAMES),
]
"""A condition, the same in SQL on the view, and in how many rows it is true."""


@pytest.mark.parametrize(("sgql", "sql", "rows"), CONDITIONS)
def test_a_literal_is_rounded_to_the_precision_of_the_column(
    store: Store, sgql: str, sql: str, rows: int
) -> None:
    assert len(list(store.find(f"MATCH (v:Vehicle) WHERE {sgql} RETURN v.id"))) == rows
    counted = f"SELECT count(*) FROM nodes WHERE {sql} AND kind = 'car'"
    assert store.sql(counted).values == [(rows,)]


@pytest.mark.parametrize(
    ("sgql", "rows"),
    [
        ("v.speed > $x", 0),
        ("v.speed <= $x AND v.speed >= $x", 2 * FRAMES),
        ("v.speed IN $xs", 2 * FRAMES),
        ("v.width < 18 / 10", 0),
        ("v.width = 2 * 0.9", 2 * FRAMES),
        ("min(v.speed, 100) = 8.3", 2 * FRAMES),
        ("coalesce(v.speed, 8.3) >= 8.3", 2 * FRAMES),
        ("CASE WHEN v.is_ego THEN 8.3 ELSE v.speed END <= 8.3", 3 * FRAMES),
        ("abs(-v.speed) > 8.3", 0),
        ("v.heading <= 180", 3 * FRAMES),
        ("v.accel <= -3.1 OR v.accel >= 3.1", FRAMES),
        ("v.speed < 1e39", 3 * FRAMES),
        ("v.speed < 1e20 * 1e20", 0),
    ],
)
def test_what_is_computed_is_rounded_too(store: Store, sgql: str, rows: int) -> None:
    found = store.find(f"MATCH (v:Vehicle) WHERE {sgql} RETURN v.id", **_given(sgql))
    assert len(list(found)) == rows


CONVERTED = ("heading", "pitch", "roll", "yaw_rate", "accel")
SIGNS = (">=", "<=", "=", "<>", ">", "<")


@pytest.mark.parametrize("name", CONVERTED)
def test_converted_columns_are_compared_in_32_bits_in_each_way(store: Store, name: str) -> None:
    """The view has 64 bits of them, which SQL casts: ``heading::FLOAT >= 12.3``."""
    column = f"{name}::FLOAT"
    values = {value for (value,) in store.sql(f"SELECT DISTINCT {column} FROM nodes").values}
    values -= {None}
    known = {"heading": 12.3, "pitch": 1.7, "roll": -3.3, "yaw_rate": 5.3, "accel": 3.1}
    assert known[name] in values
    frames = [row[0] for row in store.sql("SELECT frame_id FROM frames ORDER BY 1 LIMIT 3").values]
    for value in values:
        for sign in SIGNS:
            asked = list(store.find(f"MATCH (v:Car) WHERE v.{name} {sign} {value} RETURN v.id"))
            sql = f"SELECT count(*) FROM nodes WHERE kind = 'car' AND {column} {sign} {value}"
            assert store.sql(sql).values == [(len(asked),)], sign
            query = (
                f"MATCH (v:Car) WHERE frame.id IN $frames AND v.{name} {sign} {value} RETURN v.id"
            )
            part = len(list(store.find(query, frames=frames)))
            events: list[Any] = []
            online = (
                f"MATCH (v:Car) WHERE v.{name} {sign} {value} RETURN FIRST(v.{name}) OVER match"
            )
            for frame in frames:
                monitor = Monitor(online, period_s=0.1, on_event=events.append)
                monitor.look([store.file.graph(frame)])
                monitor.finish()
            assert len(events) == part
        assert len(list(store.find(f"MATCH (v:Car) WHERE v.{name} = {value} RETURN v.id"))) > 0


def _given(text: str) -> dict[str, Any]:
    given: dict[str, Any] = {"x": SPEED, "xs": [SPEED, 7.1]}
    return {name: value for name, value in given.items() if re.search(rf"\${name}\b", text)}


@pytest.mark.parametrize(
    "text",
    [
        "MATCH (v:Vehicle {speed: 8.3}) RETURN COUNT(*)",
        "MATCH (v:Vehicle) WITH v, AVG(v.speed) AS s WHERE s = 8.3 RETURN COUNT(*)",
        "MATCH (v:Vehicle) WITH v.speed AS s, v WHERE s >= 8.3 RETURN COUNT(*)",
        "MATCH (v:Vehicle) WHERE MAX {(v)-[:near|very_near|!near]-(w:Vehicle) | v.speed} = 8.3 "
        "OR v.speed = 8.3 RETURN COUNT(*)",
    ],
)
def test_values_of_parts_and_blocks_are_rounded(store: Store, text: str) -> None:
    assert [tuple(row) for row in store.find(text)] == [(2 * FRAMES,)]


@pytest.mark.parametrize("word", ["MEDIAN(v.speed)", "PERCENTILE(v.speed, 95)", "AVG(v.speed)"])
def test_groups_are_compared_with_what_is_stored(store: Store, word: str) -> None:
    text = f"MATCH (v:Vehicle) RETURN v.id, {word} AS s HAVING s >= 8.3 AND s <= 8.3"
    assert [float32(row[1]) for row in store.find(text)] == [float32(SPEED)] * 2


def test_a_check_holds_at_its_limit(store: Store) -> None:
    for text in ("ego.speed <= 8.3", "ego.speed >= 8.3", "NOT ego.speed > 8.3"):
        (verdict,) = store.check(f"CHECK c: ALWAYS ({text}) ROBUSTNESS")
        assert verdict.verdict == "true", text
        assert verdict.robustness is not None
        assert verdict.robustness.value == 0
    text = "CHECK c: FORALL (v:Vehicle) ALWAYS (prev(v.speed) <= 8.3 OR frame.t = 0)"
    (verdict,) = store.check(text)
    assert verdict.verdict == "true"


def test_the_monitor_compares_as_the_store(recording: Path, store: Store) -> None:
    text = """CHECK limit: ALWAYS ego.speed <= 8.3; CHECK wide: FORALL (v:Vehicle) ALWAYS v.width >= 1.8;
              CHECK over: ALWAYS ego.speed > 8.3; CHECK turn: FORALL (v:Vehicle) ALWAYS v.heading <= 180;
              CHECK later: ALWAYS (frame.t <> 0.7 OR ego.speed > 8.3)"""
    stored = {one.check: one.verdict for one in store.check(text)}
    with opened(str(recording), Config()) as source:
        told = {one.check: one.verdict for one in Monitor(text).run(source.frames)}
    assert stored == told
    assert stored == {
        "limit": "true",
        "wide": "true",
        "over": "false",
        "turn": "true",
        "later": "false",
    }


def test_times_count_microseconds(store: Store) -> None:
    for number in range(FRAMES):
        text = f"MATCH (e:Ego) WHERE frame.t = {number / 10} RETURN frame.seq, frame.t"
        assert [tuple(row) for row in store.find(text)] == [(number, number / 10)]
    assert store.sql("SELECT t FROM frames ORDER BY seq").values == [
        (n / 10,) for n in range(FRAMES)
    ]
    assert next(store.find("MATCH (e:Ego) WHERE frame.seq = 7").frames()).t == 0.7
    assert [row[0] for row in store.find("MATCH (e:Ego) RETURN DISTINCT trace.duration")] == [9.9]


def test_every_format_has_the_shortest_text(store: Store, tmp_path: Path, capsys: Any) -> None:
    path = str(store.file.path)
    find = "MATCH (v:Vehicle) WHERE v.speed = 8.3 AND frame.seq < 2 RETURN v.id, v.speed, v.width"
    sql = "SELECT node_id, speed, width FROM nodes WHERE speed = 8.3 LIMIT 4"
    for verb, text in (("find", find), ("sql", sql)):
        for form in ("json", "csv", "ndjson", "table"):
            assert run_verb([verb, path, text, "--format", form]) == 0
            printed = capsys.readouterr().out
            assert "8.3" in printed
            assert "1.8" in printed
            assert "8.30000" not in printed
            assert "1.79999" not in printed
    rows = store.find(find)
    assert rows.rows()[0][1:] == (SPEED, WIDTH)
    assert store.sql(sql).values[0][1:] == (SPEED, WIDTH)
    assert rows.numpy()["v.speed"].tolist() == [SPEED] * 4
    store.sql(sql).csv(tmp_path / "rows.csv")
    with (tmp_path / "rows.csv").open() as file:
        assert list(csv.reader(file))[1][1:] == ["8.3", "1.8"]


@pytest.mark.parametrize(
    "returned",
    [
        "v.speed",
        "DISTINCT v.speed",
        "v.speed, COUNT(*) AS n ORDER BY n DESC, v.speed",
        "MAX(v.speed) AS most",
        "v.speed AS s, v.width ORDER BY s SKIP 1",
        "v.speed AS s SAMPLE 3 PER v.speed",
        "INTERVALS, v.speed",
        "WITH v, v.speed AS s, MAX(v.width) AS w RETURN s, w",
        "INTERVALS, MAX(v.speed) OVER match AS most",
    ],
)
def test_every_kind_of_result_has_the_shortest_text(store: Store, returned: str) -> None:
    returned = returned if returned.startswith("WITH") else f"RETURN {returned}"
    rows = [tuple(row) for row in store.find(f"MATCH (v:Vehicle) {returned}")]
    numbers = {value for row in rows for value in row if isinstance(value, float)}
    assert SPEED in numbers
    assert not numbers & {float32(SPEED), float32(WIDTH)}


def test_the_shortest_text_is_the_same_number() -> None:
    random = np.random.default_rng(3)
    for number in [*(random.random(500) * 100), *(random.random(100) * 1e-5), 0.0, -8.3, 1e30]:
        kept = float32(float(number))
        assert kept is not None
        told = shortest(kept)
        assert told is not None
        assert float32(told) == kept
        assert len(repr(told)) <= len(str(np.float32(kept))) + 4
    assert float32(1e39) is None
    assert shortest(None) is None
