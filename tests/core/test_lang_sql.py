"""The SQL that queries become: values are bound, formulas are those of the views, rules change no answer."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from oracle_worlds import World, random_world

from sgstore.errors import QueryError
from sgstore.lang.catalog import NODE_ATTRIBUTES, DisplayUnit
from sgstore.lang.sql import SqlStatement, Window, compile_query
from sgstore.matches import FIRST_WINDOW, LAST_WINDOW, Windows
from sgstore.model.pair_numbers import (
    COLUMNS,
    HUNG,
    PAIR_FUNCTIONS,
    UPRIGHT,
    PairNumbers,
    low_and_high,
)
from sgstore.model.vocabulary import NOISE_MARKS

if TYPE_CHECKING:
    from collections.abc import Callable


pytestmark = pytest.mark.seconds(5)

NUMBERS = {name: one.column or name for name, one in PAIR_FUNCTIONS.items() if one.sql}
"""Functions of pairs, and what the view ``criticality`` calls them; ``lane_dist`` has tests of its own."""


@pytest.fixture(scope="module")
def world() -> World:
    return random_world(7, traces=3, frames=14)


def rows_of(world: World, statement: SqlStatement) -> list[tuple[Any, ...]]:
    return world.connection.execute(statement.sql, list(statement.values)).fetchall()


def found(world: World, text: str, **parameters: Any) -> list[tuple[Any, ...]]:
    return rows_of(world, compile_query(text, world.catalog, parameters).rows())


# Formulas


def test_pair_numbers_equal_arrays(world: World) -> None:
    calls = ", ".join(f"{function}(a, b)" for function in NUMBERS)
    states = {(frame.frame_id, n): s for frame in world.frames for n, s in frame.states.items()}

    rows = found(world, f"MATCH (a:Entity), (b:Entity) RETURN frame.id, a.id, b.id, {calls}")
    rows = [row for row in rows if (row[0], row[1]) in states and (row[0], row[2]) in states]

    kinds = {
        (frame.frame_id, n): about["kind"]
        for frame in world.frames
        for n, about in frame.trace.entities.items()
    }

    def boxes(side: int) -> np.ndarray:
        chosen = [states[row[0], row[side]] for row in rows]
        wanted = (*COLUMNS, "pitch", "height")
        told = np.array([[np.nan if s.get(c) is None else s[c] for c in wanted] for s in chosen])
        told = told.astype(np.float32).astype(float)  # FLOAT in the tables, as in every store
        of_kind = [kinds[row[0], row[side]] for row in rows]
        hung, upright = (np.isin(of_kind, some) for some in (HUNG, UPRIGHT))
        sides = low_and_high(told[:, 2], told[:, -1], hung, upright)
        unknown = np.full((len(told), 2), np.nan)
        return np.column_stack([told[:, : len(COLUMNS)], *sides, unknown, told[:, -2]])

    numbers = PairNumbers(boxes(1), boxes(2))
    assert len(rows) > 300
    for column, name in enumerate(NUMBERS, start=3):
        expected = numbers[name]
        ours = np.array([np.nan if row[column] is None else row[column] for row in rows])
        np.testing.assert_allclose(ours, expected, atol=1e-9, err_msg=name)


def test_pair_numbers_equal_the_view(world: World) -> None:
    calls = ", ".join(f"{function}(a, b)" for function in NUMBERS)

    ours = found(world, f"MATCH (a:Ego), (b:Vehicle) RETURN frame.id, b.id, {calls}")

    columns = ", ".join(NUMBERS.values())
    sql = f"SELECT frame_id, dst, {columns} FROM criticality WHERE src_is_ego"
    theirs = {row[:2]: row[2:] for row in world.connection.execute(sql).fetchall()}
    moving = [row for row in ours if row[:2] in theirs]
    assert len(moving) > 10
    for row in moving:
        assert row[2:] == pytest.approx(theirs[row[:2]], nan_ok=True, abs=1e-9)


@pytest.mark.parametrize(
    "condition",
    [
        *("gap(a, b) < 3", "gap(a, b) <= 0", "gap(a, b) = 0"),
        *("2 > ttc(a, b)", "ttc(a, b) <= 0", "2 > closing_time(a, b)"),
    ],
)
def test_cheap_bound_keeps_all_matches(condition: str, world: World) -> None:
    (number,) = re.findall(r"(\w+)\(", condition)
    pattern = "MATCH (a:Entity), (b:Entity)"

    bounded = found(world, f"{pattern} WHERE {condition} RETURN frame.id, a.id, b.id")
    every = found(world, f"{pattern} RETURN frame.id, a.id, b.id, {number}(a, b)")

    test: dict[str, Callable[[float], bool]] = {
        "<": lambda g: g < 3,
        "<=": lambda g: g <= 0,
        ">": lambda g: g < 2,
        "=": lambda g: g == 0,
    }
    wanted = test[condition.replace("(a, b)", "").split()[1]]
    assert sorted(bounded) == sorted(
        row[:3] for row in every if row[3] is not None and wanted(row[3])
    )
    assert bounded


VIEW_NAMES = {"id": "node_id"}


@pytest.mark.parametrize("attribute", NODE_ATTRIBUTES.values(), ids=lambda a: a.name)
def test_attributes_equal_columns_of_view_nodes(attribute: Any, world: World) -> None:
    name = VIEW_NAMES.get(attribute.name, attribute.name)
    columns = {row[0] for row in world.connection.execute("DESCRIBE nodes").fetchall()}
    if name not in columns or name == "node_id":
        elsewhere = {
            *["id", "ident", "type", "type_name", "in_junction", "parked", "role", "chain"]
        }
        assert attribute.name in elsewhere | {*NOISE_MARKS}
        return

    ours = found(world, f"MATCH (n) RETURN frame.id, n.id, n.{attribute.name}")

    theirs = world.connection.execute(f"SELECT frame_id, node_id, {name} FROM nodes").fetchall()
    assert len(ours) == len(theirs)
    assert {row[:2]: row[2] for row in ours} == pytest.approx({row[:2]: row[2] for row in theirs})


def test_units_are_display_units(world: World) -> None:
    (row, *_) = found(
        world, "MATCH (a:Car) WHERE a.heading > 10 RETURN a.heading, a.x, a.name, a.kind"
    )

    assert row[0] == pytest.approx(math.degrees(0.5), abs=1e-5) or row[0] > 100
    assert row[1] >= 96  # the trace's origin is at 100 m
    assert row[2].startswith("car ")
    assert row[3] == "car"


def test_entity_constants_are_read_from_their_table(world: World) -> None:
    rows = found(
        world, "MATCH (a:Entity) WHERE a.ident = 'id1' RETURN DISTINCT a.id, a.ident, a.is_static"
    )

    assert rows == [(1, "id1", False)]


def test_every_unit_is_used() -> None:
    used = {a.unit for a in NODE_ATTRIBUTES.values()}

    assert used >= {
        DisplayUnit.binding,
        DisplayUnit.label,
        DisplayUnit.degrees,
        DisplayUnit.east,
        DisplayUnit.light,
        DisplayUnit.along,
    }


# Views


def test_pattern_equals_join_of_view_edges(world: World) -> None:
    sql = """
        SELECT DISTINCT a.frame_id, a.src, a.dst, b.src
        FROM edges a JOIN edges b ON b.frame_id = a.frame_id AND b.dst = a.dst
        WHERE a.relation = 'isIn' AND a.src_is_ego AND a.dst_kind = 'lane'
          AND b.relation = 'isIn' AND NOT b.src_is_ego
    """

    pattern = found(world, "MATCH (e:Ego)-[:isIn]->(l:Lane)<-[:isIn]-(v) RETURN frame.id, e, l, v")

    assert sorted(pattern) == sorted(world.connection.execute(sql).fetchall())
    assert pattern


def test_static_edges_of_view_equal_pattern(world: World) -> None:
    sql = "SELECT frame_id, src, dst FROM edges WHERE relation = 'travelsTo'"

    pattern = found(world, "USING UNKNOWN false MATCH (l)-[:travelsTo]->(m) RETURN frame.id, l, m")

    assert sorted(pattern) == sorted(world.connection.execute(sql).fetchall())


# Compiling


def test_user_values_are_bound(world: World) -> None:
    evil = "x'; DROP TABLE inside.edge; --"

    statement = compile_query(
        "MATCH (a) WHERE a.name = $name", world.catalog, {"name": evil}
    ).rows()

    assert "DROP" not in statement.sql
    assert set(statement.values) == {evil}
    assert rows_of(world, statement) == []


def test_user_names_are_quoted(world: World) -> None:
    rows = found(
        world,
        "MATCH (select:Car)-[from:near]->(where_) RETURN select.id AS group, type(from) AS order",
    )

    assert rows


def test_unused_parameter_is_refused(world: World) -> None:
    with pytest.raises(QueryError, match="no parameter 'y'"):
        compile_query("MATCH (a:Car)", world.catalog, {"y": 3})


@pytest.mark.parametrize(
    ("value", "frames"),
    [
        pytest.param(5, True, id="whole number"),
        pytest.param(5.0, True, id="number"),
        pytest.param([5, 10], True, id="list"),
        pytest.param("5", None, id="text"),
        pytest.param(None, None, id="none"),
        pytest.param({}, None, id="no value"),
    ],
)
def test_parameters_have_types(value: Any, frames: bool | None, world: World) -> None:
    sign = "IN" if isinstance(value, list) else "="
    text = f"MATCH (a) WHERE a.speed {sign} $v"
    if frames is None:
        with pytest.raises(QueryError):
            found(world, text, v=value)
    else:
        assert found(world, text, v=value)


def test_same_text_gives_same_sql(world: World) -> None:
    text = (
        "MATCH (a:Car)-[:near]->(b) WHERE COUNT {(b)-[:isIn]->(:Lane)} > a.speed AND gap(a, b) < 3"
    )

    first, second = (compile_query(text, world.catalog).rows() for _ in range(2))

    assert first == second


def test_stages_can_be_printed(world: World) -> None:
    text = "MATCH (a:Car)-[:near]->(b) WHERE NOT EXISTS {(b)-[:isIn]->(:Lane)} AND a.speed > 3"

    printed = compile_query(text, world.catalog).stages()

    assert [line for line in printed.splitlines() if line.startswith("----")] == [
        "---- parse",
        "---- bind",
        "---- rewrite",
        "---- emit",
    ]
    assert "where (a.speed > 3)" in printed
    assert "$1 = 3" in printed


# Windows


QUERIES = [
    "MATCH (a:Car)-[:near]->(b)",
    "MATCH (a:Car)-[:near]->(b) WHERE a.speed > b.speed RETURN a.id, b.name, frame.t",
    "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) < 8",
    "MATCH (e:Ego) WHERE NOT EXISTS {(e)-[:near]->(v:Car) WHERE v.speed > 1}",
    "MATCH (e:Ego) WHERE COUNT {(e)-[:isIn]->(:Lane)} = 1 RETURN FRAMES",
    "MATCH (a)-[:isIn*1..2]->(b)",
    "MATCH (l:Lane) WHERE frame.seq > 3",
]


@pytest.mark.parametrize("text", QUERIES)
def test_windows_together_give_all_rows(text: str, world: World) -> None:
    compiled = compile_query(text, world.catalog)
    buckets = world.connection.execute(
        "SELECT DISTINCT bucket FROM inside.bucket ORDER BY 1"
    ).fetchall()
    cuts = [bucket for (bucket,) in buckets] + [1 << 40]

    parts = [compiled.rows(Window(a, b)) for a, b in pairwise(cuts)]

    assert len(parts) > 3
    assert [row for part in parts for row in rows_of(world, part)] == rows_of(
        world, compiled.rows()
    )


def test_windows_by_traces_give_all_intervals(world: World) -> None:
    compiled = compile_query("MATCH (a:Car)-[:near]->(b) RETURN a, INTERVALS", world.catalog)
    extents = world.connection.execute(
        "SELECT min(bucket), max(bucket) - min(bucket) + 1 FROM inside.bucket GROUP BY trace_id ORDER BY 1"
    ).fetchall()

    parts = [compiled.rows(Window(first, first + count)) for first, count in extents]

    assert [row for part in parts for row in rows_of(world, part)] == rows_of(
        world, compiled.rows()
    )


@pytest.mark.parametrize("whole_traces", [False, True])
@pytest.mark.parametrize(
    "extents",
    [
        pytest.param([], id="empty"),
        pytest.param([(10, 5), (100, 7)], id="small"),
        pytest.param([(10, 5000), (9000, 1)], id="a long trace"),
        pytest.param([(n * 1000, 100) for n in range(70)], id="many"),
    ],
)
@pytest.mark.parametrize("rows", [0, 1000, 5_000_000])
def test_windows_cover_every_bucket_once(
    rows: int, extents: list[tuple[int, int]], whole_traces: bool
) -> None:
    steps = Windows(extents, whole_traces=whole_traces)
    found: list[Window | None] = []
    for window in steps:
        found.append(window)
        steps.rows = rows

    if found == [None]:
        assert sum(count for _, count in extents) <= FIRST_WINDOW
        return
    every = [bucket for first, count in extents for bucket in range(first, first + count)]
    covered = [b for w in found if w is not None for b in every if w.low <= b < w.high]
    assert covered == every
    starts = {first for first, _ in extents}
    assert not whole_traces or all(w is not None and w.low in starts for w in found)


def test_window_size_follows_number_of_rows() -> None:
    steps = Windows([(0, 100_000)])
    lengths: list[int] = []
    for rows, window in zip((0, 0, 0, 10_000_000, 10_000_000, 0, 0), steps, strict=False):
        lengths.append(length(window))
        steps.rows = rows

    assert lengths == [1024, 16384, 16384, 16384, 1638, 163, 2608]


def test_all_rows_are_read_in_one_window() -> None:
    assert list(Windows([(0, 100), (1000, 60)], first=LAST_WINDOW)) == [None]
    assert len(list(Windows([(0, 100), (1000, 60)], first=100))) == 2


def length(window: Window | None) -> int:
    assert window is not None
    return window.high - window.low
