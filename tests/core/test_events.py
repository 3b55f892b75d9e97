"""What the simulator says has happened: in the store without end, each at the frame that is nearest in time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from carla_recordings import Bridge, vehicle
from recordings import Recorder, car

import sgstore
from sgstore.ingest import ingest
from sgstore.model.config import Config
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(5)

HERO = {1: ("vehicle.tesla.model3", "hero"), 2: ("vehicle.audi.tt", "hero2")}


def bumpy(path: Path, frames: int = 4) -> Path:
    """A drive at 10 Hz from 0.1 s on, with a crossed marking before it and two collisions in it."""
    with Bridge(path) as bridge:
        bridge.actors(HERO)
        bridge.lane_invasion(0.0, [1])
        for i in range(frames):
            bridge.objects(0.1 + i / 10, [vehicle(1, float(i)), vehicle(2, 20.0)])
            if i == 1:
                bridge.collision(0.2, 2, (3, 0, 4))
                bridge.lane_invasion(0.26, [2, 1], role="hero2")
                bridge.collision(0.24, 0, (0, 0, 0))
    return path


def rows(store: Path, sql: str) -> list[Any]:
    return [tuple(row) for row in sgstore.open(store).sql(sql)]


def stored(path: Path, store: Path, **how: Any) -> Path:
    outcomes = ingest(store, [path], **how)
    assert all(outcome.status in {"added", "replaced"} for outcome in outcomes), outcomes
    return store


def test_events_are_a_view_with_the_nearest_frame_and_the_entities(tmp_path: Path) -> None:
    store = stored(bumpy(tmp_path / "a.mcap"), tmp_path / "s.db")

    found = rows(
        store,
        "SELECT e.kind, f.seq, e.t, e.ident, n.ident, o.ident, e.other_ident, e.value, e.detail"
        " FROM events e JOIN frames f USING (frame_id)"
        " LEFT JOIN entities n ON n.node_id = e.node_id LEFT JOIN entities o ON o.node_id = e.other"
        " ORDER BY e.time_ns",
    )

    assert found == [
        ("lane_invasion", 0, pytest.approx(-0.1), "1", "1", None, None, None, "broken"),
        ("collision", 1, pytest.approx(0.1), "1", "1", "2", "2", 5.0, None),
        ("collision", 1, pytest.approx(0.14), "1", "1", None, "0", 0.0, None),
        ("lane_invasion", 2, pytest.approx(0.16), "2", "2", None, None, None, "solid, broken"),
    ]


def test_a_recording_without_events_has_none(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.ground_truth(0.0, [car(1)])
    store = stored(tmp_path / "a.mcap", tmp_path / "s.db")

    assert rows(store, "SELECT count(*) FROM events") == [(0,)]


def test_each_ego_has_the_events_and_they_go_with_their_trace(tmp_path: Path) -> None:
    path = bumpy(tmp_path / "a.mcap")
    store = stored(path, tmp_path / "s.db", egos=("hero", "hero2"))
    counts = "SELECT count(*) FROM events GROUP BY trace_id"
    assert rows(store, counts) == [(4,), (4,)]

    stored(path, store, egos=("hero",), force=True)
    assert rows(store, counts) == [(4,), (4,)]

    file = StoreFile(store)
    file.remove(file.traces()[0].name)
    assert rows(store, counts) == [(4,)]


def test_a_part_has_the_events_of_its_time(tmp_path: Path) -> None:
    path = bumpy(tmp_path / "a.mcap", 30)
    store = stored(path, tmp_path / "s.db", since=0.3, until=0.5)

    assert rows(store, "SELECT time_ns FROM events ORDER BY 1") == []

    store = stored(path, tmp_path / "t.db", since=0.05, until=1.0, config=Config(rate=5.0))

    found = rows(store, "SELECT e.time_ns, f.time_ns FROM events e JOIN frames f USING (frame_id)")
    assert sorted(found) == [
        (200_000_000, 300_000_000),
        (240_000_000, 300_000_000),
        (260_000_000, 300_000_000),
    ]


def test_more_events_than_a_report_lists_are_in_the_store(tmp_path: Path) -> None:
    with Bridge(tmp_path / "a.mcap") as bridge:
        bridge.actors(HERO)
        for i in range(200):
            bridge.objects(i / 10, [vehicle(1)])
            for _ in range(60):
                bridge.collision(i / 10, 2, (1, 0, 0))
    store = stored(tmp_path / "a.mcap", tmp_path / "s.db")

    assert rows(store, "SELECT count(*), count(DISTINCT frame_id) FROM events") == [(12_000, 200)]
    assert rows(
        store, "SELECT DISTINCT n FROM (SELECT count(*) AS n FROM events GROUP BY frame_id)"
    ) == [(60,)]
