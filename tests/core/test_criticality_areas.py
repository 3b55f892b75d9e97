"""Conflict areas of many pairs at once: the values of each pair alone, in any order, with any cache."""

from __future__ import annotations

import math
import shutil
from dataclasses import astuple
from typing import TYPE_CHECKING

import numpy as np
import pytest
from thorough import LONG

import sgstore
from sgstore.ingest import ingest
from sgstore.model.criticality import (
    RECORDED,
    Encounter,
    Meetings,
    Track,
    encounters,
    encroachment,
)

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.model.world import Bools
    from sgstore.query import Store

TRACES = 4
FRAMES = 40


def drive(rng: np.random.Generator, *, known: bool) -> Track:
    """An object near the origin that drives, stands, or has an unknown size in one frame."""
    count = rng.integers(FRAMES // 2 if known else 1, FRAMES)
    times = np.sort(rng.choice(FRAMES, count, replace=False)).astype(np.float64)
    states = np.zeros((len(times), 10))
    heading = rng.uniform(-3, 3) + np.cumsum(rng.normal(0, 0.05, len(times)))
    pace = np.where(rng.uniform(size=len(times)) < 0.3, 0, rng.choice([0, 0.2, 2]))
    for axis, way in enumerate((np.cos(heading), np.sin(heading))):
        states[:, axis] = rng.normal(0, 8) + np.cumsum(pace * way)
    states[:, 3] = heading if pace.any() else heading[0]
    states[:, 4:6] = rng.choice([0, 0.6, 4.5]), rng.choice([0.6, 1.8])
    if not known and rng.uniform() < 0.1:
        states[rng.integers(len(times)), 4] = math.nan
    return Track(times, states)


def spans(one: Track, inside: Bools) -> tuple[float, float]:
    rows = np.flatnonzero(inside)
    if not len(rows):
        return math.nan, math.nan
    enters = one.times[rows[0]] if rows[0] > 0 else math.nan
    return enters, one.times[rows[-1] + 1] if rows[-1] + 1 < len(one) else math.nan


def frame_by_frame(of: Encounter) -> list[float]:
    """Entry and exit times from all frames in which the footprints touch."""
    inside = [np.zeros(len(one), np.bool_) for one in (of.a, of.b)]
    for rows in of.crossings():
        for on, found in zip(inside, rows, strict=True):
            on[found] = True
    return [*spans(of.a, inside[0]), *spans(of.b, inside[1])]


@pytest.mark.parametrize("seed", range(100 if LONG else 10))
def test_all_pairs_of_an_object_are_those_of_each_pair(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(seed)
    if seed % 2:
        monkeypatch.setattr("sgstore.model.criticality._footprints._TOGETHER", 3)
    ids = (-5, 0, 3, *range(900, 930), 2**30)
    sources = {7: 3, 8: -5, 1 << 38: 4}  # the last one is absent
    drives = {
        (trace, node): drive(rng, known=node == src)
        for trace, src in sources.items()
        for node in ids
    }
    frames, nodes, states = (
        np.concatenate(column)
        for column in zip(
            *(
                ((trace << 24) + one.times.astype(np.int64), np.full(len(one), node), one.states)
                for (trace, node), one in drives.items()
            ),
            strict=True,
        )
    )
    mixed = rng.permutation(len(frames))
    instants = np.unique(frames)
    times = instants, (instants & 0xFFFFFF).astype(np.float64)

    together = Meetings(frames[mixed], nodes[mixed], mixed, states, sources, times)

    pairs = [*zip(together.traces.tolist(), together.nodes.tolist(), strict=True)]
    values = np.array([together.values(name) for name in RECORDED]).T.tolist()
    found = dict(zip(pairs, zip(together.encroachments.tolist(), values, strict=True), strict=True))
    known = 0
    for (trace, node), other in drives.items():
        if node != sources[trace] and (trace, sources[trace]) in drives:
            of = Encounter(drives[trace, sources[trace]], other)
            wanted = frame_by_frame(of)
            alone = encroachment(of)
            areas, measures = found.pop((trace, node))
            assert areas == pytest.approx(wanted, nan_ok=True)
            every = [one.value(of) for one in RECORDED.values()]
            np.testing.assert_array_equal(measures, every)
            assert [*astuple(alone)] == pytest.approx(wanted, nan_ok=True)
            known += sum(not math.isnan(one) for one in wanted)
    assert not found
    assert known


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with several traces: the bundled recording, seen from several of its cars."""
    from sgstore.apps.demo import RECORDING

    folder = tmp_path_factory.mktemp("many")
    ingest(folder / "town.sgstore", [RECORDING], until=0.5)
    town = sgstore.open(folder / "town.sgstore")
    cars = town.sql("SELECT DISTINCT ident FROM nodes WHERE kind = 'car' ORDER BY ident").values
    ingest(folder / "many.sgstore", [RECORDING], egos=[car for (car,) in cars], until=12.0)
    return folder / "many.sgstore"


@pytest.fixture
def copied(many: Path, tmp_path: Path) -> Store:
    """A store without cached values."""
    return sgstore.open(shutil.copy(many, tmp_path / "copy.sgstore"))


@pytest.fixture(scope="module")
def alone(many: Path) -> dict[tuple[int, int, int], tuple[float | None, ...]]:
    """The measures of pairs with and without an ego, one pair at a time."""
    values: dict[tuple[int, int, int], tuple[float | None, ...]] = {}
    store = sgstore.open(many)
    for trace in store.file.traces():
        met = [*encounters(store, trace.name)]
        tracks = {dst: of.b for _, dst, _, of in met} | {src: of.a for src, _, _, of in met}
        for src in dict.fromkeys([met[0][0], *tracks][:3]):
            for dst in tracks.keys() - {src}:
                of = Encounter(tracks[src], tracks[dst])
                told = [RECORDED[name].value(of) for name in RECORDED]
                values[trace.trace_id, src, dst] = tuple(None if math.isnan(v) else v for v in told)
    return values


@pytest.mark.parametrize(
    ("order", "most_bytes", "most_states"),
    [
        ("trace_id, src, dst", 64 << 20, 1 << 20),
        ("trace_id DESC, dst", 64 << 20, 1 << 20),
        ("hash(dst, trace_id)", 64 << 20, 1 << 20),
        ("src, trace_id, dst", 1, 1 << 20),
        ("trace_id, src, dst", 64 << 20, 2000),
        ("trace_id, src, dst", 64 << 20, 12_000),  # two of the traces
    ],
)
def test_values_depend_on_no_order_and_no_cache_size(
    alone: dict[tuple[int, int, int], tuple[float | None, ...]],
    copied: Store,
    monkeypatch: pytest.MonkeyPatch,
    order: str,
    most_bytes: int,
    most_states: int,
) -> None:
    monkeypatch.setattr("sgstore.store._meetings.MOST_BYTES", most_bytes)
    monkeypatch.setattr("sgstore.store._meetings.MOST_STATES", most_states)
    told = ", ".join(f"recorded('known {name}', trace_id, src, dst)" for name in RECORDED)
    pairs = ", ".join(map(str, alone))
    columns = "pair(trace_id, src, dst)"

    copied.file.rows("SELECT max(recorded('pet', trace_id, src, dst)) FROM encounters")
    rows = copied.file.rows(
        f"SELECT trace_id, src, dst, {told} FROM (FROM (VALUES {pairs}) {columns} ORDER BY {order})"
    ).values

    assert {row[:3]: row[3:] for row in rows} == alone
    assert len({trace for trace, *_ in alone}) == TRACES
    assert sum(value is not None for row in alone.values() for value in row) > TRACES
