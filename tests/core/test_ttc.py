"""Times to collision in recordings, by view and by pattern, against boxes sampled a thousand times a second."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from contacts import COLUMNS, disagreements
from thorough import LONG

from sgstore.ingest import ingest
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

HORIZON = 15.0
RECORDINGS = ("esmini/*", "sumo/*", "omega_prime/*", "carla/*") if LONG else ("esmini/cut-in.mcap",)


def boxes(rows: np.ndarray, first: int) -> np.ndarray:
    """The columns of boxes from one on, with headings in radians."""
    found = rows[:, first : first + len(COLUMNS)].copy()
    found[:, 3] = np.radians(found[:, 3])
    # Results print the shortest text of numbers that are kept in 32 bits: sizes and velocities.
    found[:, 4:] = found[:, 4:].astype(np.float32)
    return found


def values(rows: list[tuple[object, ...]]) -> np.ndarray:
    return np.array(rows, float).reshape(len(rows), -1)


def by_view(store: Store, every: int) -> np.ndarray:
    """Times to collision of the ego and the others that move, with their boxes."""
    states = ", ".join(f"{alias}.{name}" for alias in "ab" for name in COLUMNS)
    sql = f"""
      SELECT p.ttc, p.gap, {states} FROM pairs p JOIN frames f USING (frame_id)
      JOIN nodes a ON a.frame_id = p.frame_id AND a.node_id = p.src
      JOIN nodes b ON b.frame_id = p.frame_id AND b.node_id = p.dst
      WHERE p.src_is_ego AND f.seq % {every} = 0 ORDER BY p.frame_id, p.dst
    """
    return values(store.sql(sql).values)


def by_pattern(store: Store, every: int) -> np.ndarray:
    """The same of all entities, those that stand for ever too."""
    states = ", ".join(f"{v}.{name}" for v in "ab" for name in COLUMNS)
    text = f"""
      MATCH (a:Ego), (b:Entity) WHERE frame.seq % {every} = 0
      RETURN ttc(a, b), gap(a, b), {states}
    """
    return values(list(store.find(text)))


@pytest.mark.parametrize("asked", [by_view, by_pattern])
def test_times_to_collision_in_the_sample_are_those_of_sampled_boxes(asked, open_town) -> None:
    rows = asked(open_town, 1 if LONG else 7)

    assert len(rows) > 1000
    assert disagreements(boxes(rows, 2), boxes(rows, 10), rows[:, 0], HORIZON) == []
    assert np.array_equal(rows[:, 0] == 0, rows[:, 1] == 0)


@pytest.fixture(scope="module")
def shared(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """A store of recordings that others made; of one of them, if there is little time."""
    path = tmp_path_factory.mktemp("shared") / "shared.sgstore"
    found = sorted(f for name in RECORDINGS for f in (data / "traces").glob(name) if f.is_file())
    ingest(path, [file for file in found if file.suffix in {".mcap", ".osi"}])
    store = Store(path)
    with store.file.snapshot():
        yield store


@pytest.mark.data
@pytest.mark.parametrize("asked", [by_view, by_pattern])
def test_times_to_collision_in_shared_recordings_are_those_of_sampled_boxes(asked, shared) -> None:
    rows = asked(shared, 1)

    assert len(rows) > 100
    assert disagreements(boxes(rows, 2), boxes(rows, 10), rows[:, 0], HORIZON) == []
    assert np.array_equal(rows[:, 0] == 0, rows[:, 1] == 0)


STANDING = ("traffic_light", "yield_sign", "speed_limit", "building", "pole", "vegetation")
VELOCITY = ("speed", "vx", "vy", "vz")


@pytest.mark.parametrize("kind", STANDING)
def test_what_stands_for_ever_has_velocity_0_wherever_it_is_asked(kind, open_town) -> None:
    label, asked = kind.replace("_", ""), ", ".join(f"n.{name}" for name in VELOCITY)
    sql = f"SELECT DISTINCT {', '.join(VELOCITY)} FROM nodes WHERE kind = '{kind}'"
    pairs = open_town.find(
        f"MATCH (e:Ego), (n:{label}) RETURN rel_speed(e, n), e.vx, e.vy, frame.id"
    )
    found = list(pairs)
    graph = open_town.graph(found[0][-1])
    nodes = [node for _, node in graph.nodes(data=True) if node["kind"] == kind]

    assert open_town.sql(sql).values == [(0, 0, 0, 0)]
    assert set(open_town.find(f"MATCH (n:{label}) RETURN DISTINCT {asked}")) == {(0, 0, 0, 0)}
    assert {tuple(node[name] for name in VELOCITY) for node in nodes} == {(0, 0, 0, 0)}
    for speed, vx, vy, _ in found:
        assert speed == pytest.approx(np.hypot(vx, vy))


def test_lanes_and_roads_have_no_velocity(open_town) -> None:
    kinds = "'lane', 'road', 'junction', 'crosswalk', 'off_road'"
    sql = f"SELECT count(*) > 0, count(speed), count(vx) FROM nodes WHERE kind IN ({kinds})"

    assert open_town.sql(sql).values == [(True, 0, 0)]
