"""Motion from noisy positions: velocities, accelerations, standing and parked vehicles."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from real_terms import noisy
from recordings import Recorder, car

import sgstore
from sgstore import Frame
from sgstore.graphs.online import NUMBERS, Replay
from sgstore.graphs.relations import _crowds
from sgstore.lang.library import patterns
from sgstore.model.config import from_dict
from sgstore.model.noise import DeadBand
from sgstore.model.world import STANDS
from sgstore.pipeline.derive import derive
from sgstore.pipeline.doctor import examine
from sgstore.readers import open_trace
from sgstore.temporal import opened

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.query import Store

PERIOD = 0.1
FRAMES = 150


def driven(t: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Position and speed of a car that drives, brakes with 4 m/s² for 2 s, and stands."""
    speed = np.clip(12 - 4 * np.clip(t - 4, 0, 2) - 2 * np.clip(t - 8, 0, 2), 0, None)
    fine = np.linspace(0, t[-1], 20_001)
    along = np.interp(
        fine,
        fine,
        np.cumsum(np.clip(12 - 4 * np.clip(fine - 4, 0, 2) - 2 * np.clip(fine - 8, 0, 2), 0, None)),
    ) * (fine[1] - fine[0])
    x = np.interp(t, fine, along)
    return x, 0.02 * x, speed * np.hypot(1, 0.02)


def recorded(
    path: Path,
    sigma: float,
    *,
    frames: int = FRAMES,
    wander: bool = False,
    parked: int = 6,
    velocity: tuple[float, float] | None = None,
) -> tuple[NDArray[Any], Path]:
    """Write a recording without velocities: an ego, and parked cars. Return the speed of the ego."""
    rng = np.random.default_rng(7)
    t = np.arange(frames) * PERIOD
    x, y, speed = driven(t)
    with Recorder(path) as recorder:
        keys = rng.normal(0, sigma, (parked + 1, frames // 5 + 2, 2))
        for i in range(frames):
            a = i % 5 / 5
            slow = keys[:, i // 5] * (1 - a) + keys[:, i // 5 + 1] * a
            off = slow if wander else rng.normal(0, sigma, (parked + 1, 2))
            cars = [moved(1, x[i] + off[0, 0], y[i] + off[0, 1])]
            if velocity:
                cars[0].base.velocity.x, cars[0].base.velocity.y = velocity
            cars += [
                moved(k + 2, 15.0 * k + off[k + 1, 0], 8.0 + off[k + 1, 1]) for k in range(parked)
            ]
            recorder.ground_truth(t[i], cars, host=1)
    return speed, path


def moved(ident: int, x: float, y: float) -> Any:
    """A car without recorded motion."""
    found = car(ident, x=x, y=y)
    found.base.ClearField("velocity")
    found.base.ClearField("acceleration")
    found.base.ClearField("orientation_rate")
    return found


def states_of(path: Path, size: int = 60, noise: float = -1.0) -> dict[str, NDArray[Any]]:
    """Columns of all states of a recording."""
    with open_trace(path) as trace:
        trace.noise = noise
        blocks = list(trace.blocks(size))
    names = ("node", "vx", "vy", "ax", "ay", "yaw_rate", "derived")
    return {name: np.concatenate([getattr(b.states, name) for b in blocks]) for name in names}


@pytest.mark.parametrize("sigma", [0.05, 0.1, 0.3])
def test_speed_error_is_a_third_of_difference_quotients(tmp_path: Path, sigma: float) -> None:
    truth, path = recorded(tmp_path / "a.mcap", sigma)
    rms = []
    for noise in (-1.0, 0.0):
        found = states_of(path, noise=noise)
        ego = found["node"] == 0
        speed = np.hypot(found["vx"][ego], found["vy"][ego])
        rms.append(float(np.sqrt(np.nanmean((speed - truth) ** 2))))
    assert rms[0] < rms[1] / 3
    assert not np.isnan(states_of(path)["vx"]).any()


def test_exact_positions_are_differentiated_as_before(tmp_path: Path) -> None:
    _, path = recorded(tmp_path / "a.mcap", 0.0)
    found, exact = states_of(path), states_of(path, noise=0.0)
    for name, column in found.items():
        np.testing.assert_array_equal(column, exact[name])
    assert found["derived"].max() <= 7


@pytest.mark.parametrize("wander", [False, True])
def test_blocks_do_not_change_smooth_values(tmp_path: Path, wander: bool) -> None:
    _, path = recorded(tmp_path / "a.mcap", 0.1, frames=50, wander=wander, parked=3)
    whole = states_of(path, 100)
    for size in (1, 20):
        for name, column in states_of(path, size).items():
            np.testing.assert_array_equal(column, whole[name], err_msg=f"{name}, {size}")


@pytest.mark.parametrize("wander", [False, True])
def test_standing_cars_are_stopped_and_parked(tmp_path: Path, wander: bool) -> None:
    _, path = recorded(tmp_path / "a.mcap", 0.06, wander=wander)
    with sgstore.open(tmp_path / "s.sgstore", create=True) as store:
        store.ingest(path)
        world = "USING SCOPE world "
        stood = store.find(
            f"{world}MATCH (v:Car) WHERE stopped(v) AND NOT v.is_ego RETURN v.ident AS i"
        ).rows()
        assert len(stood) >= 0.98 * 6 * FRAMES
        parked = store.find(
            f"{world}MATCH (v:Car) WHERE v.parked RETURN DISTINCT v.ident AS i"
        ).rows()
        assert {row.i for row in parked} == {"2", "3", "4", "5", "6", "7"}
        fast = store.find("MATCH (e:Ego) WHERE moving(e) RETURN frame.seq AS f").rows()
        assert {row.f for row in fast} >= set(range(90))
        hard = store.find("MATCH (e:Ego) WHERE hard_brake(e) RETURN frame.t AS t").rows()
        assert hard
        assert all(3.5 < row.t < 6.5 for row in hard)


@pytest.mark.parametrize("sigma", [0.05, 0.2])
def test_noise_does_not_break_or_begin_terms_of_motion(tmp_path: Path, sigma: float) -> None:
    rng = np.random.default_rng(2)
    frames = 120
    t = np.arange(frames) * PERIOD
    speed = 5 + 2 * np.clip(
        t - 3, 0, 3
    )  # It gets faster from 3 s to 6 s, and turns from 7 s to 10 s.
    heading = np.radians(15) * np.clip(t - 7, 0, 3)
    x, y = np.cumsum(speed * np.cos(heading)) * PERIOD, np.cumsum(speed * np.sin(heading)) * PERIOD
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i in range(frames):
            off, tilt = rng.normal(0, sigma, (4, 2)), rng.normal(0, 0.03, 4)
            cars = [moved(1, x[i] + off[0, 0], y[i] + off[0, 1])]
            cars += [moved(k + 1, 15 * k + off[k, 0], 30 + off[k, 1]) for k in (1, 2, 3)]
            tilt[0] += heading[i]
            for one, turned in zip(cars, tilt, strict=True):
                one.base.orientation.yaw = turned
            recorder.ground_truth(t[i], cars, host=1)
    with sgstore.open(tmp_path / "s.sgstore", create=True) as store:
        store.ingest(path, config=sgstore.Config(noise=sigma))
        for term, begin, end in (("accelerating", 3, 6), ("turning", 7, 10)):
            query = f"USING SCOPE world MATCH (v:Car) WHERE {term}(v)"
            runs = store.find(f"{query} RETURN INTERVALS").rows()
            told = store.find(f"{query} RETURN v.ident AS i, frame.t AS t").rows()
            assert {row.i for row in told} == {"1"}
            assert len(runs) == 1
            assert abs(min(row.t for row in told) - begin) < 0.8
            assert abs(max(row.t for row in told) - end) < 0.8


@pytest.mark.parametrize(
    ("term", "value", "enter", "leave"),
    [("accelerating", "v.accel", 1, 0.5), ("turning", "abs(v.yaw_rate)", 5, 3)],
)
def test_terms_with_a_band_equal_their_definition(
    open_town: Store, term: str, value: str, enter: float, leave: float
) -> None:
    rows = open_town.find(
        f"MATCH (v:Vehicle) RETURN v.ident AS i, frame.seq AS f, {value} AS x ORDER BY v.ident, frame.seq"
    ).rows()
    expected: set[tuple[str, int]] = set()
    on, last = False, ("", -1)
    for row in rows:
        here = on and last == (row.i, row.f - 1)
        on = row.x is not None and (row.x >= enter or (here and row.x >= leave - 1e-6))
        last = (row.i, row.f)
        if on:
            expected.add(last)
    found = open_town.find(
        f"MATCH (v:Vehicle) WHERE {term}(v) RETURN v.ident AS i, frame.seq AS f"
    ).rows()
    assert expected
    assert {(row.i, row.f) for row in found} == expected


def test_a_jump_gives_no_acceleration(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for i in range(80):
            back = 1.9 if i >= 40 else 0.0
            lone = 3.0 if i == 60 else 0.0
            place = 0.9 * i - back + lone + rng.normal(0, 0.03)
            others = [moved(k + 2, 10.0 * k + rng.normal(0, 0.03), 9.0) for k in range(4)]
            recorder.ground_truth(i * PERIOD, [moved(1, place, 0.0), *others], host=1)
    found = states_of(path)
    ego = found["node"] == 0
    assert np.nanmax(np.abs(found["ax"][ego])) < 2
    assert np.nanmax(np.abs(found["vx"][ego] - 9)) < 0.5


def test_impossible_motion_is_marked(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    rng = np.random.default_rng(3)
    with Recorder(path) as recorder:
        for i in range(60):
            one = moved(1, 8.0 * i * PERIOD + rng.normal(0, 0.03), rng.normal(0, 0.03))
            one.base.orientation.yaw = float(np.remainder(3.0 * max(0, i - 30) * PERIOD, 2 * np.pi))
            others = [moved(k + 2, 10.0 * k + rng.normal(0, 0.03), 9.0) for k in range(4)]
            recorder.ground_truth(i * PERIOD, [one, *others], host=1)
    with sgstore.open(tmp_path / "s.sgstore", create=True) as store:
        (outcome,) = store.ingest(path)
        assert any("yaw rates are impossible" in words for words in outcome.warnings)
        assert (
            store.find("MATCH (e:Ego) WHERE e.unreal_yaw_rate AND e.yaw_rate IS NULL").count() > 20
        )
        assert store.find("MATCH (e:Ego) WHERE e.unreal_accel").count() == 0
        assert store.find("MATCH (e:Ego) WHERE NOT e.stands AND moving(e)").count() == 60


def test_recorded_motion_is_kept_beside_motion_from_positions(tmp_path: Path) -> None:
    _, path = recorded(tmp_path / "a.mcap", 0.1, velocity=(5.0, 0.0))
    with sgstore.open(tmp_path / "s.sgstore", create=True) as store:
        (outcome,) = store.ingest(path, config=sgstore.Config(noise=0.1))
        assert any("recorded speeds differ" in words for words in outcome.warnings)
        (row,) = store.find(
            "MATCH (e:Ego) WHERE frame.seq = 20 RETURN e.speed AS v, e.position_speed AS p"
        ).rows()
        assert row.v == 5.0
        assert abs(row.p - 12) < 0.5


def test_an_examination_has_the_noise_of_an_ingest(tmp_path: Path) -> None:
    _, path = recorded(tmp_path / "a.mcap", 0.1)
    assert 0.05 < examine(path).noise < 0.2
    assert examine(path, config=sgstore.Config(noise=0.3)).noise == 0.3
    assert examine(path, config=sgstore.Config(noise=0.0)).noise == 0


def test_noise_can_be_set(tmp_path: Path) -> None:
    _, path = recorded(tmp_path / "a.mcap", 0.1)
    with pytest.raises(sgstore.ConfigError, match="noise"):
        sgstore.Config(noise=-0.5)
    with sgstore.open(tmp_path / "s.sgstore", create=True) as store:
        (outcome,) = store.ingest(path, config=sgstore.Config(noise=0.0))
        assert not any("noise" in words for words in outcome.warnings)
        assert store.find("MATCH (v) WHERE v.stands").count() == 0


def clients(
    sigma: float, *, velocity: bool = False, frames: int = FRAMES
) -> tuple[NDArray[Any], NDArray[Any], list[Frame]]:
    """Frames of a client with a driven ego and two parked cars; speed and noisy place of the ego."""
    rng = np.random.default_rng(5)
    t = np.arange(frames) * PERIOD
    x, y, speed = driven(t)
    place = np.stack([x, y], axis=1) + rng.normal(0, sigma, (frames, 2))
    found = []
    for i in range(frames):
        frame = Frame(round(i * PERIOD * 1e9), ego="e")
        told = {"vx": speed[i], "vy": 0.0} if velocity else {}
        frame.add("e", "car", *place[i], 0.0, heading=0, length=4, width=2, **told)
        for k in (1, 2):
            told = {"vx": 0.0, "vy": 0.0} if velocity else {}
            off = rng.normal(0, sigma, 2)
            frame.add(f"p{k}", "car", 30 + 8 * k + off[0], 8 + off[1], 0.0, heading=0, **told)
        found.append(frame)
    return speed, place, found


def online(frames: list[Frame], noise: float = -1.0) -> list[dict[str, dict[str, Any]]]:
    """Attributes of the bodies of each graph of the online mode, by their ids."""
    generator = sgstore.SceneGraphGenerator(None, sgstore.Config(noise=noise))
    graphs = [generator.step(frame) for frame in frames]
    return [{node["ident"]: node for node in graph.nodes.values()} for graph in graphs]


@pytest.mark.parametrize("sigma", [0.05, 0.3])
def test_online_speed_error_is_a_third_of_difference_quotients(sigma: float) -> None:
    speed, place, frames = clients(sigma)
    found = online(frames, sigma)
    got = np.array([one["e"].get("speed", np.nan) for one in found])
    quotient = np.hypot(*np.diff(place, axis=0).T) / PERIOD
    known = np.isfinite(got[1:])
    assert known[20:].all()
    errors = [np.sqrt(np.mean((v - speed[1:])[known] ** 2)) for v in (got[1:], quotient)]
    assert errors[0] < errors[1] / 3


@pytest.mark.parametrize("sigma", [0.1, 0.2])
def test_online_terms_hold_without_false_alarms(sigma: float) -> None:
    _, _, frames = clients(sigma)
    rules = """
        MATCH (v) WHERE NOT v.is_ego AND moving(v);
        MATCH (v) WHERE NOT v.is_ego AND hard_brake(v);
        MATCH (e:Ego) WHERE hard_brake(e);
        MATCH (e:Ego) WHERE stopped(e);
        MATCH (v) WHERE NOT v.is_ego AND stopped(v)
    """
    monitor = sgstore.Monitor(rules, None, sgstore.Config(noise=sigma))
    told: dict[str, list[float]] = {}
    for frame in frames:
        for event in monitor.step(frame):
            told.setdefault(event.name, []).append(event.start.t)
    names = [f"pattern {i}" for i in range(1, 6)]
    times = [told.get(name, []) for name in names]
    assert not times[0] + times[1]
    assert len(times[2]) >= 1
    assert all(4 < t < 7.5 for t in times[2])
    assert times[3]
    assert all(t > 9.5 for t in times[3])
    assert len(times[4]) == 2


def test_online_motion_does_not_depend_on_later_frames() -> None:
    _, _, frames = clients(0.1)
    assert online(frames[:70], 0.1) == online(frames, 0.1)[:70]


def test_online_noise_is_estimated_from_the_first_frames() -> None:
    speed, _, frames = clients(0.1)
    found = online(frames)
    assert "speed" not in found[20]["e"]
    assert abs(found[119]["e"]["speed"] - speed[119]) < 1
    assert found[119]["p1"]["stands"]


@pytest.mark.parametrize("velocity", [False, True])
def test_exact_online_motion_is_that_of_the_client(velocity: bool) -> None:
    _, _, frames = clients(0.0, velocity=velocity)
    found = online(frames)
    assert found == online(frames, 0.0)
    assert ("speed" in found[140]["e"]) == velocity


def test_an_online_jump_gives_no_acceleration() -> None:
    rng = np.random.default_rng(3)
    frames = []
    for i in range(120):
        frame = Frame(round(i * PERIOD * 1e9), ego="e")
        place = 0.9 * i - 1.9 * (i >= 40) + 3.0 * (i == 80) + rng.normal(0, 0.05)
        frame.add("e", "car", place, rng.normal(0, 0.05), 0.0, heading=0)
        frames.append(frame)
    found = [one["e"] for one in online(frames, 0.05)]
    assert max(abs(one.get("accel", 0.0)) for one in found) < 3
    assert all(abs(one.get("speed", 9.0) - 9) < 1.2 for one in found)


def test_a_monitor_smooths_a_recording_as_the_online_mode(tmp_path: Path) -> None:
    _, path = recorded(tmp_path / "a.mcap", 0.1)
    config = sgstore.Config(noise=0.1)
    with opened(str(path), config) as source:
        told = [frame.entities[0] for frame in source.frames]
    with open_trace(path) as trace:
        trace.noise = 0.0
        replay = Replay()
        raw = [frame for block in trace.blocks() for frame in replay.frames(block)]
    assert len(told) == len(raw)
    frames = []
    for one in raw:
        frame = Frame(one.time_ns, one.ego)
        for entity in one.entities:
            numbers = dict(zip(NUMBERS, entity.numbers, strict=True))
            numbers["heading"] = np.degrees(numbers["heading"])
            frame.add(entity.ident, "car", **{n: numbers[n] for n in ("x", "y", "z", "heading")})
        frames.append(frame)
    for entity, node in zip(told, online(frames, 0.1), strict=True):
        numbers = dict(zip(NUMBERS, entity.numbers, strict=True))
        one = node[entity.ident]
        np.testing.assert_allclose(numbers["vx"], one.get("vx", np.nan), rtol=1e-5, atol=1e-6)
        assert bool(entity.whole[2] & STANDS) == one["stands"]


def test_windows_around_a_frame_equal_their_definition(open_town: Store) -> None:
    rows = open_town.find(
        "MATCH (e:Ego) RETURN frame.t AS t, e.speed AS v, min_over(e.speed, -1s..0.5s) AS low,"
        " avg_over(e.speed, -3frames..2frames) AS mean"
    ).rows()
    t, v = np.array([row.t for row in rows]), np.array([row.v for row in rows])
    near = [v[(t >= at - 1.001) & (t <= at + 0.501)] for at in t]
    np.testing.assert_array_equal([row.low for row in rows], [part.min() for part in near])
    mean = [v[max(0, i - 3) : i + 3].mean() for i in range(len(v))]
    np.testing.assert_allclose([row.mean for row in rows], mean, atol=1e-5)


@pytest.mark.parametrize(
    ("query", "same"),
    [
        ("EVENTUALLY[-2s, 1s] p", "ONCE[0s, 2s] p OR EVENTUALLY[0s, 1s] p"),
        ("ALWAYS[-2s, 1s] p", "HISTORICALLY[0s, 2s] p AND ALWAYS[0s, 1s] p"),
        ("EVENTUALLY[-3s, -1s] p", "ONCE[1s, 3s] p"),
        ("ONCE[-2s, 1s] p", "EVENTUALLY[0s, 2s] p OR ONCE[0s, 1s] p"),
    ],
)
def test_bounds_on_both_sides_join_two_operators(open_town: Store, query: str, same: str) -> None:
    found, expected = (
        open_town.find(
            f"MATCH (e:Ego) WHERE {text.replace('p', 'e.speed > 5')} RETURN frame.id AS f"
        ).rows()
        for text in (query, same)
    )
    assert found
    assert found == expected


@pytest.mark.parametrize(
    ("condition", "words"),
    [
        ("e.speed > 5 UNTIL[-2s, 1s] e.speed < 3", "a bound of UNTIL cannot be negative"),
        ("EVENTUALLY[2s, -1s] e.speed > 5", "the end of the bound is before its start"),
        ("min_over(e.speed, -1s..3frames) > 1", "in time or in frames"),
        ("-1s..1s > 3", "window of min_over"),
    ],
)
def test_wrong_bounds_name_their_cause(open_town: Store, condition: str, words: str) -> None:
    with pytest.raises(sgstore.QueryError, match=words):
        open_town.find(f"MATCH (e:Ego) WHERE {condition}")
    with pytest.raises(sgstore.QueryError, match="ends at the frame"):
        open_town.check("CHECK ALWAYS min_over(ego.speed, -1s..1s) >= 0")


def test_a_held_place_follows_only_moves_beyond_its_band() -> None:
    """Against the definition, one body and one axis at a time."""
    rng = np.random.default_rng(4)
    frames, bodies, turn = 80, 3, 0.4
    frame, node = np.repeat(np.arange(frames), bodies), np.tile(np.arange(bodies), frames)
    true = np.outer(frames_of := np.arange(frames) * PERIOD, [8, 0]).repeat(bodies, axis=0)
    true[node == 1] = 0  # it stands
    noise = rng.normal(0, 0.1, true.shape)
    band = np.where(node == 2, 0.0, 0.3)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    place = (true + noise) @ axes  # x along the heading
    held = DeadBand().held(node, frame, place, np.full(len(node), turn), band)
    assert len(frames_of) == frames
    for one in range(bodies):
        mine = node == one
        for axis in (0, 1):
            want, at = [], None
            for value in (place[mine] @ axes.T)[:, axis]:
                at = (
                    value
                    if at is None
                    else np.clip(at, value - band[mine][0], value + band[mine][0])
                )
                want.append(at)
            np.testing.assert_allclose((held[mine] @ axes.T)[:, axis], want, atol=1e-9)
    np.testing.assert_array_equal(held[node == 2], place[node == 2])
    again = DeadBand()
    parts = [
        again.held(node[at], frame[at] - start, place[at], np.full(at.sum(), turn), band[at])
        for start in range(0, frames, 7)
        for at in [(frame >= start) & (frame < start + 7)]
    ]
    np.testing.assert_array_equal(np.concatenate(parts), held)


LANES = "MATCH (v:Vehicle)-[:isIn {primary: TRUE}]->(l:Lane) RETURN v.ident, frame.seq, l.id"


def lane_changes(rows: Iterable[tuple[Any, ...]]) -> int:
    """Number of changes of the primary lane to another number of the lane, over all vehicles."""
    lanes: dict[str, list[tuple[int, Any]]] = {}
    for ident, seq, lane in sorted(map(tuple, rows)):
        lanes.setdefault(ident, []).append((seq, lane))
    return sum(a != b for one in lanes.values() for (_, a), (_, b) in pairwise(one))


def test_noise_changes_no_lanes(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a store, after other settings, in small parts, and in a monitor."""
    source = data / "traces/esmini/cut-in.mcap"
    path = tmp_path / "noisy.mcap"
    noisy(source, path, 0.3, derived=True, seed=1)
    config, wide = sgstore.Config(noise=0.3), from_dict({"noise": 0.3, "range": {"radius": 90}})
    found: dict[str, Any] = {}
    for name, recording, how in (
        ("exact", source, sgstore.Config()),
        ("noisy", path, config),
        ("wide", path, wide),
    ):
        with sgstore.open(tmp_path / f"{name}.sgstore", create=True) as store:
            store.ingest(recording, config=how)
            found[name] = set(map(tuple, store.find(LANES).rows()))
    assert lane_changes(found["noisy"]) == lane_changes(found["exact"]) > 0
    derive(tmp_path / "noisy.sgstore", wide, "wide")
    with sgstore.open(tmp_path / "noisy.sgstore") as store:
        told = store.find(f"USING ABSTRACTION wide {LANES}").rows()
        assert set(map(tuple, told)) == found["wide"]
    monkeypatch.setattr(_crowds, "AT_ONCE", 40)
    with sgstore.open(tmp_path / "parts.sgstore", create=True) as store:
        store.ingest(path, config=config)
        assert set(map(tuple, store.find(LANES).rows())) == found["noisy"]
    query = patterns()["changes_lane_left"].written(), patterns()["changes_lane_right"].written()
    counts = []
    for recording, how in ((source, sgstore.Config()), (path, config)):
        with opened(str(recording), how) as replay:
            monitor = sgstore.Monitor(";".join(query), replay.road_map, how)
            events = [event for frame in replay.frames for event in monitor.step(frame)]
            counts.append(len([*events, *monitor.finish()]))
    assert counts[0] == counts[1] > 0
