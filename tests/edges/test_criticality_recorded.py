"""Measures of what was recorded: against frames looked at one by one, a raster, and definitions."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import time
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import shapely
from thorough import LONG
from typer.testing import CliRunner

import sgstore
from sgstore.apps.cli import app
from sgstore.base.geometry import corners
from sgstore.errors import ConfigError, QueryError, SqlError, StoreError
from sgstore.model.criticality import (
    RECORDED,
    Encounter,
    Meetings,
    Track,
    cpi,
    crash_probability,
    dce_recorded,
    encounters,
    encroachment,
    et_recorded,
    headway_recorded,
    pet,
    recorded,
    tet,
    tit,
    ttc_recorded,
    ttce_recorded,
)
from sgstore.model.vocabulary import VEHICLES
from sgstore.temporal import Monitor
from sgstore.testsets.coverage import ChosenFrames
from sgstore.testsets.selection import PrioritySpec, SelectionUnit, prioritize

if TYPE_CHECKING:
    from sgstore.model.world import Floats
    from sgstore.query import Store

STEP = 0.1


def clock(frames: int) -> Floats:
    return np.arange(frames, dtype=np.float64) * np.float64(STEP)


def bend(rng: np.random.Generator, frames: int, **fixed: float) -> Track:
    """A drive on an arc about the origin's surroundings, which stands for a while in some."""
    speed, heading, turn = rng.uniform(2, 14), rng.uniform(-3, 3), rng.normal(0, 0.15)
    times = clock(frames)
    pace = np.where((times > 1) & (times < 1 + rng.uniform(-1, 1.5)), 0.0, speed)
    angle = heading + turn * np.cumsum(pace) * STEP / 5
    states = np.zeros((frames, 10))
    for axis, way in enumerate((np.cos(angle), np.sin(angle))):
        along = np.cumsum(pace * way) * STEP
        states[:, axis] = along - along[frames // 2] + rng.normal(0, 3)
        states[:, 6 + axis] = pace * way
        states[:, 8 + axis] = np.gradient(pace * way, STEP)
    states[:, 3] = angle
    states[:, 4:6] = (fixed.get("length", 4.5), fixed.get("width", 1.8))
    return Track(times, states)


def boxes(track: Track) -> Any:
    return shapely.polygons(corners(track.states[:, [0, 1, 3, 4, 5]]))


def drives(count: int, seed: int, frames: int = 45) -> list[Encounter]:
    rng = np.random.default_rng(seed)
    found = [Encounter(bend(rng, frames), bend(rng, frames)) for _ in range(count)]
    walker = {"length": 0.6, "width": 0.6}
    return [*found, Encounter(bend(rng, frames), bend(rng, frames, **walker))]


COUNT = 200 if LONG else 40


def first(values: Any) -> float:
    return float(values[0]) if len(values) else math.nan


@pytest.mark.parametrize("seed", range(10 if LONG else 1))
def test_encroachment_is_that_of_all_frames_with_all_others(seed: int) -> None:
    kinds = {"known": 0, "unknown": 0}
    for one in drives(COUNT, seed):
        a, b = boxes(one.a), boxes(one.b)
        on = shapely.intersects(a[:, None], b[None, :])

        spans: list[tuple[float, float]] = []
        for track, inside in ((one.a, on.any(axis=1)), (one.b, on.any(axis=0))):
            rows = np.flatnonzero(inside)
            enters = float(track.times[rows[0]]) if len(rows) and rows[0] > 0 else math.nan
            last = rows[-1] + 1 if len(rows) else len(track)
            leaves = float(track.times[last]) if last < len(track) else math.nan
            spans.append((enters, leaves))
        (enters_a, leaves_a), (enters_b, leaves_b) = spans
        wanted = math.nan
        if leaves_a <= enters_b:
            wanted = enters_b - leaves_a
        elif leaves_b <= enters_a:
            wanted = enters_a - leaves_b

        found = encroachment(one)
        assert (found.enters_a, found.leaves_a) == pytest.approx(spans[0], nan_ok=True)
        assert (found.enters_b, found.leaves_b) == pytest.approx(spans[1], nan_ok=True)
        assert pet(one) == pytest.approx(wanted, nan_ok=True)
        assert et_recorded(one) == pytest.approx(leaves_a - enters_a, nan_ok=True)
        assert pet(Encounter(one.b, one.a)) == pytest.approx(wanted, nan_ok=True)
        kinds["unknown" if math.isnan(wanted) else "known"] += 1

    assert min(kinds.values()) > COUNT / 8


def crossing(rng: np.random.Generator, frames: int = 80, most: int = 30) -> Encounter:
    """Two on arcs that cross, most of them one after the other."""
    a, b = bend(rng, frames), bend(rng, frames + 2 * most)
    first = most + int(rng.choice([-1, 1]) * rng.integers(8, most + 1))
    return Encounter(a, Track(a.times, b.states[first : first + frames]))


def covered(track: Track, cells: Any, grow: float) -> Any:
    """(frames, cells): whether the footprint, longer and wider by so much on each side, has a cell's middle."""
    x, y, _, heading, length, width, *_ = track.states.T[:, :, None]
    away = (cells - (x + 1j * y)) * np.exp(-1j * heading)
    return (np.abs(away.real) <= length / 2 + grow) & (np.abs(away.imag) <= width / 2 + grow)


def on_a_raster(one: Encounter, finest: float) -> tuple[list[Any], list[Any]]:
    """Frames in which each is in the area that both cover: those in which it surely is, and those it may be.

    Who has the middle of a cell that the other one has, too, is in the area. Who is in it has such a middle at
    least if both are grown by half the diagonal of a cell. Cells that may decide more are quartered.
    """
    tracks, cell = (one.a, one.b), 1.6
    middle = [t.states[:, 0] + 1j * t.states[:, 1] for t in tracks]
    places = np.unique(np.round(np.concatenate(middle) / cell))
    around = np.arange(-3, 4)
    cells = np.unique(places[:, None] + (around[:, None] + 1j * around).ravel()) * cell
    sure = [np.zeros(len(t), np.bool_) for t in tracks]
    while True:
        has, may = ([covered(t, cells, g) for t in tracks] for g in (0.0, cell * math.sqrt(0.5)))
        both = has[0].any(axis=0) & has[1].any(axis=0)
        sure = [known | told[:, both].any(axis=1) for known, told in zip(sure, has, strict=True)]
        both = may[0].any(axis=0) & may[1].any(axis=0)
        maybe = [told[:, both].any(axis=1) for told in may]
        open_ = [told & ~known for told, known in zip(maybe, sure, strict=True)]
        asked = [told[rows].any(axis=0) for told, rows in zip(may, open_, strict=True)]
        cells = cells[both & (asked[0] | asked[1])]
        if cell <= finest or not len(cells):
            return sure, [known | told for known, told in zip(sure, open_, strict=True)]
        quarter = np.array([1 + 1j, 1 - 1j, -1 + 1j, -1 - 1j]) * cell / 4
        cells, cell = (cells[:, None] + quarter).ravel(), cell / 2


def pet_of(inside: list[Any]) -> float:
    """Post-encroachment time by its definition, of the frames in which each is in the area."""
    rows = [np.flatnonzero(one) for one in inside]
    for first, second in (rows, rows[::-1]) if all(map(len, rows)) else ():
        if first[-1] < second[0]:
            return STEP * float(second[0] - first[-1] - 1)
    return math.nan


@pytest.mark.parametrize("seed", range(20 if LONG else 1))
def test_the_post_encroachment_time_is_that_of_a_raster(seed: int) -> None:
    """Whatever its cells leave open is as long as it takes to drive the diagonal of one, or one frame."""
    rng = np.random.default_rng(71 + seed)
    settled = known = 0
    drawn = [crossing(rng) for _ in range(300)]
    for one in drawn:
        sure, maybe = on_a_raster(one, finest=0.005)
        most, least, found = pet_of(sure), pet_of(maybe), pet(one)
        if most == pytest.approx(least, nan_ok=True):
            assert found == pytest.approx(most, nan_ok=True)
            settled += 1
        else:  # the times in the area that surely are in it and that may be, are on both sides
            assert math.isnan(found) or not (found > most + 1e-9 or found < least - 1e-9)
        known += not math.isnan(found)

    assert settled > 0.95 * len(drawn)
    assert known > 0.4 * len(drawn)


def test_one_after_the_other_over_a_crossing() -> None:
    times = clock(100)

    def straight(speed: float, start: float, heading: float) -> Track:
        states = np.zeros((100, 10))
        along = start + speed * times
        states[:, 0], states[:, 1] = along * math.cos(heading), along * math.sin(heading)
        states[:, 3:6] = heading, 4, 2
        states[:, 6:8] = speed * math.cos(heading), speed * math.sin(heading)
        return Track(times, states)

    # The first one has its rear, 2 m behind, beyond the other's side, 1 m from the middle, after 23.05 m.
    # The second one's front, 2 m ahead, comes to the first one's side after 46.95 m: 4.7 s.
    one = Encounter(straight(10, -20.05, 0), straight(10, -50.05, math.pi / 2))

    assert encroachment(one).leaves_a == pytest.approx(2.4)
    assert encroachment(one).enters_b == pytest.approx(4.8)
    assert pet(one) == pytest.approx(2.4)
    assert et_recorded(one) == pytest.approx(2.4 - 1.8)
    assert math.isnan(first(ttc_recorded(one)))


def test_what_follows_is_looked_up_frame_by_frame() -> None:
    met = 0
    for one in drives(COUNT, seed=72):
        a, b = boxes(one.a), boxes(one.b)
        gap = shapely.distance(a, b)
        on = shapely.intersects(a[:, None], b[None, :])
        for found, wanted in (
            (
                ttc_recorded(one),
                [first(np.flatnonzero(gap[t:] == 0) * STEP) for t in range(len(a))],
            ),
            (dce_recorded(one), [gap[t:].min() for t in range(len(a))]),
            (ttce_recorded(one), [STEP * gap[t:].argmin() for t in range(len(a))]),
            (
                headway_recorded(one),
                [first(np.flatnonzero(on[t:, t]) * STEP) for t in range(len(a))],
            ),
        ):
            assert found == pytest.approx(np.array(wanted), abs=1e-9, nan_ok=True)
        met += bool((gap == 0).any())

    assert COUNT / 8 < met < COUNT


def test_exposure_adds_up_the_time_to_collision() -> None:
    exposed = 0
    for one in drives(COUNT, seed=73):
        ttc = one.numbers["ttc"].tolist()
        low = [t for t in ttc[:-1] if t <= 2]

        assert tet(one) == pytest.approx(STEP * len(low))
        assert tit(one) == pytest.approx(STEP * sum(2 - t for t in low))
        exposed += bool(low)

    assert exposed > COUNT / 4


def test_the_crash_potential_is_the_mean_of_what_was_drawn() -> None:
    rng = np.random.default_rng(74)
    drawn = rng.normal(8.45, 1.40, 400_000)
    drawn = drawn[(drawn >= 4.23) & (drawn <= 12.68)]
    asked = np.array([0, 4.2, 5, 7, 8.45, 10, 12, 12.7, 40, math.nan])

    found = crash_probability(asked)

    wanted = [(drawn < one).mean() for one in asked[:-1]]
    assert found[:-1] == pytest.approx(np.array(wanted), abs=3e-3)
    assert math.isnan(found[-1])


def following(gap: Floats, speed: float, other: float) -> Encounter:
    """One behind the other, with gaps of one's choice."""
    frames = len(gap)
    times, a, b = clock(frames), *np.zeros((2, frames, 10))
    a[:, 4:6] = b[:, 4:6] = 4, 2
    a[:, 6], b[:, 6], b[:, 0] = speed, other, gap + 4
    return Encounter(Track(times, a), Track(times, b))


def test_the_crash_potential_of_frames() -> None:
    # (10 m/s)² / 2d: 10, 5 and 2.5 m/s²; touching; overlapping in another place behind
    of = following(np.array([5.0, 10, 20, 0, -40]), 20, 10)

    wanted = [*crash_probability(np.array([10.0, 5, 2.5])), 1, 0]
    assert cpi(of) == pytest.approx(np.mean(wanted))
    of.b.states[1, 8] = math.nan
    fresh = Encounter(of.a, of.b)
    assert cpi(fresh) == pytest.approx(np.mean([wanted[i] for i in (0, 2, 3, 4)]))


def test_tracks_need_not_begin_or_end_together() -> None:
    (one, *_) = drives(1, seed=75, frames=60)
    part = Encounter(
        Track(one.a.times[:40], one.a.states[:40]), Track(one.b.times[10:], one.b.states[10:])
    )

    assert part.times == pytest.approx(one.a.times[10:40])
    assert dce_recorded(part)[0] == pytest.approx(np.min(one.numbers["gap"][10:40]))
    on = shapely.intersects(boxes(part.a)[:, None], boxes(part.b)[None, :])
    assert math.isnan(encroachment(part).enters_a) == (not on.any() or bool(on[0].any()))


def test_what_has_no_size_encroaches_on_nothing_that_is_known() -> None:
    (one, *_) = drives(1, seed=76)
    one.b.states[:, 4] = math.nan

    assert math.isnan(pet(one))
    assert np.isnan(dce_recorded(one)).all()
    assert np.isnan(headway_recorded(one)).all()


def test_a_store_tells_the_measures_of_its_egos(open_town: Store) -> None:
    table = recorded(open_town)

    assert table.columns == ("trace", "src", "dst", "kind", *RECORDED)
    sql = """SELECT trace, dst, min(gap) FROM criticality JOIN frames USING (frame_id)
      WHERE src_is_ego GROUP BY ALL"""
    nearest = {row[:2]: row[2] for row in open_town.sql(sql).values}
    told = {(row["trace"], row["dst"]): row for row in table.dicts()}
    assert len(told) > 5
    for key, row in told.items():
        if key in nearest:
            assert row["dce_recorded"] == pytest.approx(nearest[key], abs=1e-6)
    assert {row["kind"] for row in told.values()} <= {*VEHICLES, "person", "animal"}
    (trace,) = {trace for trace, _ in told}
    assert len([*encounters(open_town, trace)]) == len(told)


def test_a_measure_that_is_none_is_refused(open_town: Store) -> None:
    with pytest.raises(ConfigError, match="no recorded measure: 'ttc'; expected some of pet"):
        recorded(open_town, ["ttc"])


def test_the_verb_makes_a_table_that_patterns_and_orders_understand(
    town_store: Path, open_town: Store, tmp_path: Path
) -> None:
    file = tmp_path / "close.csv"
    line = ["criticality", str(town_store), "-m", "dce_recorded", "--most", "5", "-o", str(file)]
    assert CliRunner().invoke(app, line).exit_code == 0
    every = recorded(open_town, ["dce_recorded"]).dicts()
    close = {(row["trace"], row["dst"]) for row in every if row["dce_recorded"] <= 5}
    store = sgstore.open(town_store, tables={"close": file})

    listed = {(row["trace"], int(row["dst"])) for row in csv.DictReader(StringIO(file.read_text()))}
    found = store.find(
        "MATCH (e:Ego), (v:Entity) WHERE HAPPENS close(e, v) RETURN trace.name, v.id"
    )
    there = store.sql("SELECT DISTINCT trace, dst FROM close WHERE dce_recorded <= 5").values

    assert listed == close == set(there)
    assert 0 < len(close) < len(every)
    assert set(found) == close


def test_cases_are_put_in_order_by_what_was_recorded_later(open_town: Store) -> None:
    chosen = ChosenFrames("town", open_town)
    names = ("dce_recorded", "tet")
    spec = PrioritySpec(measures=names, unit=SelectionUnit.clip)
    frames = {
        row[0]: row[1:] for row in open_town.sql("SELECT frame_id, trace, t FROM frames").values
    }
    wanted: dict[int, list[float]] = {}
    for trace in {trace for trace, _ in frames.values()}:
        for _, _, _, one in encounters(open_town, trace):
            times = set(one.times.tolist())
            values = dce_recorded(one)[0], -tet(one)
            for frame, (of, t) in frames.items():
                if of == trace and t in times:
                    known = wanted.setdefault(frame, [math.inf, math.inf])
                    wanted[frame] = [min(pair) for pair in zip(known, values, strict=True)]

    order = prioritize(chosen, spec)

    units = order.units
    for worst, sign, place in zip(order.worst, (1, -1), (0, 1), strict=True):
        for unit in range(len(units)):
            ids = units.frame_id[units.begin[unit] : units.end[unit]].tolist()
            least = min(wanted[frame][place] for frame in ids)
            assert sign * worst.value[unit] == pytest.approx(least)
    assert f"{order.worst[0].value[order.picked[0]]:.3g} m with" in order.reasons()[0]


def test_patterns_sql_and_the_verb_have_the_measures_of_all_pairs(open_town: Store) -> None:
    names = [*RECORDED]
    told = ", ".join(f"{name}(e, v)" for name in names)
    asked = f"MATCH (e:Ego), (v:Entity) RETURN DISTINCT trace.name, e.id, v.id, {told}"
    query = f"USING SCOPE world {asked}"
    patterns = {tuple(row[:3]): tuple(row[3:]) for row in open_town.find(query)}
    sql = f"SELECT trace, src, dst, {', '.join(names)} FROM encounters"
    view = {row[:3]: row[3:] for row in open_town.sql(sql).values}
    verb = {row[:3]: row[4:] for row in recorded(open_town).values}

    known = 0
    assert view == verb
    for trace in {trace for trace, *_ in verb}:
        for src, dst, _, of in encounters(open_town, trace):
            values = [RECORDED[name].value(of) for name in names]
            wanted = tuple(None if math.isnan(one) else one for one in values)
            assert view[trace, src, dst] == wanted
            if (trace, src, dst) in patterns:  # in a frame with the ego
                assert patterns[trace, src, dst] == wanted
                known += sum(one is not None for one in wanted)
    assert known > 100
    # What stands fast is met by nobody, and so not known.
    fast = [row for key, row in patterns.items() if key not in view]
    assert all(set(row) == {None} for row in fast)


def test_conditions_on_what_was_recorded_are_those_of_sql(open_town: Store) -> None:
    rows = recorded(open_town, ["dce_recorded", "tet"]).values
    close = {(row[0], row[2]) for row in rows if row[4] is not None and row[4] < 2}
    frames = open_town.sql(
        """SELECT count(DISTINCT frame_id) FROM pairs p JOIN frames f USING (frame_id)
        JOIN encounters c ON c.trace = f.trace AND c.src = p.src AND c.dst = p.dst
        WHERE c.dce_recorded < 2 AND p.distance < 30 AND p.src_is_ego"""
    ).values[0][0]
    where = "WHERE dce_recorded(e, v) < 2 AND dist(e, v) < 30"

    found = open_town.find(f"MATCH (e:Ego), (v:Entity) {where}")
    inside = open_town.find(f"MATCH (e:Ego) WHERE EXISTS {{(v:Entity) {where}}}")
    ranked = open_town.find(
        f"MATCH (e:Ego), (v:Entity) {where} RETURN v.id, MIN(dce_recorded(e, v)) OVER match AS d"
    )
    rule = "CHECK FORALL (v:Entity) ALWAYS (dist(ego, v) < 30 IMPLIES NOT dce_recorded(ego, v) < 2)"

    assert found.count() == inside.count() == frames > 0
    assert {row.v_id for row in ranked} <= {dst for _, dst in close}
    assert all(row.d < 2 for row in ranked)
    assert any(verdict.violated for verdict in open_town.check(rule))
    sequence = "MATCH (e:Ego)-[:near]->(v:Vehicle) WHERE dce_recorded(e, v) < 2 THEN MATCH (e)-[:near]->(v)"
    assert {row.v_id for row in open_town.find(f"{sequence} RETURN v.id")} <= {d for _, d in close}


@pytest.fixture
def copied(town_store: Path, tmp_path: Path) -> Store:
    """A store of which nothing is worked out already."""
    return sgstore.open(shutil.copy(town_store, tmp_path / "copy.sgstore"))


def test_windows_of_any_size_have_the_same_values(
    copied: Store, open_town: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sgstore.store._meetings.MOST_STATES", 1000)
    monkeypatch.setattr("sgstore.model.criticality._meetings._TOGETHER", 7)
    monkeypatch.setattr("sgstore.model.criticality._footprints._TOGETHER", 3)

    assert recorded(copied).values == recorded(open_town).values


def test_measures_end_with_their_statement(copied: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[Meetings]()

    def slow(of: Meetings, _: str) -> Floats:
        asked.append(of)
        time.sleep(0.05)
        return np.ones(len(of))

    monkeypatch.setattr(Meetings, "values", slow)
    sql = "SELECT sum(recorded('cpi', trace_id, dst, src)) FROM encounters"
    with pytest.raises(SqlError, match="stopped after"):
        copied.sql(sql, timeout_s=0.3)
    assert len(asked) < 10

    with pytest.raises(StoreError, match=r"no recorded measure: 'ttc'; expected pet"):
        copied.file.rows("SELECT recorded('ttc', trace_id, src, dst) FROM encounters")


def test_a_monitor_refuses_what_is_recorded_later(open_town: Store) -> None:
    close = "(e:Ego), (v:Vehicle) WHERE pet(e, v) < 1"

    for text in (f"MATCH {close}", f"CHECK ALWAYS NOT EXISTS {{{close}}}"):
        with pytest.raises(QueryError, match=r"pet\(\) needs later frames, which a monitor"):
            Monitor(text)
    with pytest.raises(QueryError, match=r"pet\(\) takes 2 arguments(.|\n)*post-encroachment time"):
        open_town.find("MATCH (e:Ego) WHERE pet(e) < 1")


def test_why_not_knows_what_was_recorded_later(open_town: Store) -> None:
    frame = next(open_town.find("MATCH (e:Ego), (v:Vehicle) RETURN FRAMES").frames())

    said = str(open_town.why_not(frame, "MATCH (e:Ego), (v:Vehicle) WHERE dce_recorded(e, v) < 0"))

    assert "FAILS   dce_recorded(e, v) < 0" in said
    assert "found   dce_recorded(e, v) = " in said


PAGE = Path(__file__).parents[2] / "docs" / "criticality.md"


def test_the_page_lists_the_recorded_measures() -> None:
    page = PAGE.read_text(encoding="utf-8")
    begin, end = (
        "<!-- recorded, made from sgstore/model/criticality -->\n",
        "<!-- end of recorded -->",
    )
    rows = "".join(f"| `{name}` | {one.doc} | {one.unit} |\n" for name, one in RECORDED.items())
    head, rest = page.split(begin)
    table = f"| measure | is | unit |\n|---|---|---|\n{rows}"
    expected = f"{head}{begin}{table}{end}{rest.partition(end)[2]}"
    if os.environ.get("SGSTORE_UPDATE_GOLDEN"):
        PAGE.write_text(expected, encoding="utf-8")
        page = expected

    assert page == expected


def test_the_verb_lists_the_most_critical_encounters_with_names(town_store: Path) -> None:
    line = ["criticality", str(town_store), "-m", "pet", "-m", "cpi"]
    rows = json.loads(CliRunner().invoke(app, [*line, "--json"]).stdout)
    table = CliRunner().invoke(app, line)
    short = CliRunner().invoke(app, [*line, "--limit", "3"])
    pets = [row["pet"] for row in rows if row["pet"] is not None]

    assert pets == sorted(pets)
    assert [row["pet"] for row in rows[: len(pets)]] == pets
    assert len(rows) > 40
    assert table.stdout.splitlines()[0].split() == ["trace", "ego", "other", "pet", "cpi"]
    assert f"town   car 0  {rows[0]['kind']} {rows[0]['dst']}" in table.stdout
    assert len(table.stdout.splitlines()) == 2 + 40
    assert f"{len(rows) - 3} more rows; --limit 0 shows all" in short.stderr


def test_encounters_without_a_value_are_left_out(open_town: Store) -> None:
    every = recorded(open_town, ["pet"]).dicts()
    known = [row for row in every if row["pet"] is not None]

    assert 0 < len(known) < len(every)
    assert len(open_town.criticality(measures=["pet"]).rows) == len(known)
