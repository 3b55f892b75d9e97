"""Laws of entities and of motion in every flavour: who an id is, what a body can be, what is derived."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import autoware_recordings as autoware
import carla_recordings as carla
import foxglove_scenes as foxglove
import numpy as np
import pytest
import recordings as osi
import sumo_recordings as sumo

from sgstore.apps.cli import run
from sgstore.graphs.online import Frame, Replay
from sgstore.ingest import ingest
from sgstore.model.config import Config
from sgstore.model.vocabulary import KINDS
from sgstore.pipeline import doctor, recording_ingest
from sgstore.pipeline.recording_ingest import TraceOutcome
from sgstore.query import Store
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from sgstore.model.world import FrameBlock, TraceReport

Size = tuple[float, float, float]


@dataclass(frozen=True)
class Body:
    """A thing of a scene, whatever the flavour. ``v``: its speed along x; ``None``: the recording has none."""

    ident: int
    x: float
    kind: str = "car"
    size: Size = (4.5, 1.9, 1.5)
    v: float | None = None


Scene = tuple[float, list[Body]]
"""A time, and what there is."""


def _osi_things(bodies: list[Body]) -> list[Any]:
    things: list[Any] = []
    for body in bodies:
        thing = osi.car(body.ident, body.x, v=None if body.v is None else (body.v, 0.0))
        if body.kind == "person":
            thing.type = osi.PEDESTRIAN
            thing.ClearField("vehicle_classification")
        box = thing.base.dimension
        box.length, box.width, box.height = body.size
        things.append(thing)
    return things


def write_osi(path: Path, scenes: list[Scene]) -> Path:
    with osi.Recorder(path.with_suffix(".mcap")) as recorder:
        for time, bodies in scenes:
            recorder.ground_truth(time, _osi_things(bodies))
    return recorder.path


def write_osi_topics(path: Path, scenes: list[Scene]) -> Path:
    with osi.Recorder(path.with_suffix(".mcap")) as recorder:
        for time, bodies in scenes:
            for topic, some in (("a", bodies[:2]), ("b", bodies[2:])):
                recorder.ground_truth(time, _osi_things(some), topic=topic)
    return recorder.path


def write_osi_file(path: Path, scenes: list[Scene]) -> Path:
    messages = [osi.ground_truth(t, _osi_things(b)).SerializeToString() for t, b in scenes]
    path = path.with_suffix(".osi")
    path.write_bytes(b"".join(struct.pack("<I", len(one)) + one for one in messages))
    return path


def write_carla(path: Path, scenes: list[Scene]) -> Path:
    with carla.Bridge(path.with_suffix(".mcap")) as bridge:
        for time, bodies in scenes:
            of = {"car": carla.vehicle, "person": carla.walker}
            v = [(body.v or 0.0, 0.0, 0.0) for body in bodies]
            bridge.objects(
                time,
                [
                    of[body.kind](body.ident, body.x, v=speed, size=list(body.size), time=time)
                    for body, speed in zip(bodies, v, strict=True)
                ],
            )
    return bridge.path


def write_foxglove(path: Path, scenes: list[Scene]) -> Path:
    words = {"car": "car", "person": "pedestrian"}
    with foxglove.SceneRecorder.of(path.with_suffix(".mcap"), "json") as recorder:
        for time, bodies in scenes:
            cubes = [
                foxglove.cube(
                    str(body.ident), (body.x, 0, 0), size=body.size, type=words[body.kind]
                )
                for body in bodies
            ]
            recorder.scene(time, cubes, clear=True)
    return recorder.path


def write_autoware(path: Path, scenes: list[Scene]) -> Path:
    words = {"car": "car", "person": "pedestrian"}
    with autoware.Stack(path.with_suffix(".mcap")) as stack:
        for time, bodies in scenes:
            stack.pose(time, -20.0, 0.0)
            stack.objects(
                time,
                [
                    autoware.thing(
                        words[b.kind], b.x, 0.0, str(b.ident), size=b.size, v=(b.v or 0.0,)
                    )
                    for b in bodies
                ],
            )
    return Path(stack.path)


def write_sumo(path: Path, scenes: list[Scene]) -> Path:
    steps = [
        sumo.step(
            time,
            *(
                sumo.vehicle(
                    str(body.ident),
                    body.x,
                    0.0,
                    tag="vehicle" if body.kind == "car" else "person",
                    type="car" if body.kind == "car" else "DEFAULT_PEDTYPE",
                    speed=body.v or 0.0,
                    length=body.size[0],
                    width=body.size[1],
                    height=body.size[2],
                )
                for body in bodies
            ),
        )
        for time, bodies in scenes
    ]
    path = path.with_suffix(".xml")
    path.write_text(sumo.export(*steps))
    return path


Writer = Callable[[Path, list[Scene]], Path]
FLAVOURS: dict[str, Writer] = {
    "osi": write_osi,
    "osi topics": write_osi_topics,
    "osi file": write_osi_file,
    "carla": write_carla,
    "foxglove": write_foxglove,
    "autoware": write_autoware,
    "sumo": write_sumo,
}
DERIVING = {name: FLAVOURS[name] for name in ("osi", "osi file", "foxglove")}
"""Flavours that may come without velocities."""


def every(flavours: dict[str, Writer]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("write", flavours.values(), ids=list(flavours))


def read(path: Path, size: int = 60) -> tuple[list[FrameBlock], TraceReport]:
    with open_trace(path) as trace:
        return list(trace.blocks(size)), trace.report


def tracks(blocks: list[FrameBlock], ident: int) -> dict[int, tuple[str, list[int]]]:
    """Lifetime → kind and frames, of the entities with an id."""
    names: dict[int, tuple[str, int, str]] = {}
    seen: dict[int, list[int]] = {}
    for block in blocks:
        new = block.entities
        lives = new.lifetime or (1,) * len(new)
        rows = zip(new.ident, lives, new.kind.tolist(), strict=True)
        for node, (name, life, kind) in enumerate(rows, start=new.first):
            names[node] = name, life, KINDS[kind]
        for node, frame in zip(block.states.node.tolist(), block.frame_of.tolist(), strict=True):
            seen.setdefault(node, []).append(int(block.seq[frame]))
    wanted = {str(ident), autoware.hex_of(str(ident))}
    return {
        life: (kind, seen.get(node, []))
        for node, (name, life, kind) in names.items()
        if name in wanted
    }


def column(blocks: list[FrameBlock], ident: int, name: str) -> list[float]:
    """A column of the states of the entities with an id, in order of the frames."""
    names: list[str] = []
    found: list[float] = []
    for block in blocks:
        names += block.entities.ident
        for row, node in enumerate(block.states.node.tolist()):
            if names[node] in {str(ident), autoware.hex_of(str(ident))}:
                found.append(float(getattr(block.states, name)[row]))
    return found


def stand(frames: int, *bodies: Body, start: float = 0.0) -> list[Scene]:
    return [(start + i / 10, list(bodies)) for i in range(frames)]


# Who an id is -----------------------------------------------------------------------------------------


@every({name: write for name, write in FLAVOURS.items() if name not in {"autoware", "sumo"}})
def test_an_id_that_returns_as_another_kind_is_a_new_entity(tmp_path: Path, write: Writer) -> None:
    other, person = Body(3, 5.0), Body(7, 20.0, "person", (0.5, 0.5, 1.8))
    scenes = [
        *stand(3, other, Body(7, 20.0)),
        *stand(2, other, start=0.3),
        *stand(3, other, person, Body(5, 40.0), start=0.5),
        *stand(2, other, person, Body(9, 30.0), start=0.8),
    ]
    path = write(tmp_path / "reuse", scenes)
    for size in (1, 2, 3, 60):
        blocks, report = read(path, size)

        assert tracks(blocks, 7) == {1: ("car", [0, 1, 2]), 2: ("person", [5, 6, 7, 8, 9])}
        assert tracks(blocks, 3) == {1: ("car", [*range(10)])}
        assert tracks(blocks, 5) == {1: ("car", [5, 6, 7])}
        assert tracks(blocks, 9) == {1: ("car", [8, 9])}
        assert any("7#2" in warning for warning in report.warnings)


@every(FLAVOURS)
def test_an_id_at_an_impossible_place_is_a_new_entity(tmp_path: Path, write: Writer) -> None:
    scenes = [*stand(4, Body(7, 20.0)), *stand(4, Body(7, 520.0), Body(8, 0.0), start=0.4)]
    path = write(tmp_path / "leap", scenes)
    for size in (1, 3, 60):
        blocks, report = read(path, size)

        assert {life: frames for life, (_, frames) in tracks(blocks, 7).items()} == {
            1: [0, 1, 2, 3],
            2: [4, 5, 6, 7],
        }
        assert {life: frames for life, (_, frames) in tracks(blocks, 8).items()} == {
            1: [4, 5, 6, 7]
        }
        assert np.nanmax(np.abs(column(blocks, 7, "vx"))) < 1
        assert any("#2" in warning for warning in report.warnings)


@every(FLAVOURS)
def test_a_fast_car_and_a_jump_of_the_clock_make_no_new_entity(
    tmp_path: Path, write: Writer
) -> None:
    fast = [(i / 10, [Body(7, 8.0 * i, v=80.0)]) for i in range(10)]
    blocks, _ = read(write(tmp_path / "fast", fast))

    assert len(tracks(blocks, 7)) == 1


@pytest.mark.parametrize(("apart", "kind"), [(45.0, "car"), (45.0, "person"), (1.0, "person")])
def test_two_entities_that_have_one_id_by_turns_both_go_on(
    tmp_path: Path, apart: float, kind: str
) -> None:
    bodies = Body(7, 0.0), Body(7, apart, kind)
    scenes = [(i / 10, [bodies[i % 2]]) for i in range(12)]
    blocks, _ = read(write_osi(tmp_path / "twins", scenes))
    online = steps(*scenes)

    assert tracks(blocks, 7) == {
        1: ("car", [0, 2, 4, 6, 8, 10]),
        2: (kind, [1, 3, 5, 7, 9, 11]),
    }
    assert [frame["7"] for frame in online] == [(1, "car", 1), (2, kind, 2)] * 6


def test_a_vehicle_and_a_person_of_sumo_with_one_id_stay_apart(tmp_path: Path) -> None:
    car, person = Body(1, 10.0), Body(1, 14.0, "person", (0.5, 0.5, 1.8))
    scenes = [*stand(2, car, person), *stand(2, person, start=0.2), *stand(2, car, start=0.4)]
    blocks, report = read(write_sumo(tmp_path / "both", scenes))

    assert tracks(blocks, 1) == {1: ("car", [0, 1, 4, 5])}
    idents = [ident for block in blocks for ident in block.entities.ident]
    assert idents == ["1", "person 1"]
    assert sum(len(block.states) for block in blocks) == 8
    assert not report.losses


def test_an_autoware_object_at_an_impossible_place_has_the_class_that_it_has_there(
    tmp_path: Path,
) -> None:
    person = Body(7, 520.0, "person", (0.5, 0.5, 1.8))
    scenes = [*stand(5, Body(7, 20.0)), *stand(3, person, start=0.5)]
    blocks, _ = read(write_autoware(tmp_path / "leap", scenes))

    assert tracks(blocks, 7) == {1: ("car", [0, 1, 2, 3, 4]), 2: ("person", [5, 6, 7])}


# What a body can be -----------------------------------------------------------------------------------


@every(FLAVOURS)
@pytest.mark.parametrize(
    ("size", "lost"),
    [((-4.5, 1.9, 1.5), "length"), ((4.5, -1.9, 1.5), "width"), ((4.5, 1.9, 2000.0), "height")],
)
def test_a_size_that_no_body_has_is_missing_and_a_loss(
    tmp_path: Path, write: Writer, size: Size, lost: str
) -> None:
    path = write(tmp_path / "odd", stand(4, Body(7, 20.0, size=size), Body(3, 5.0)))
    blocks, report = read(path)

    for name, told in zip(("length", "width", "height"), size, strict=True):
        expected = np.nan if name == lost else told
        np.testing.assert_allclose(column(blocks, 7, name), [expected] * 4, rtol=1e-6)
    assert np.isfinite(column(blocks, 3, lost)).all()
    assert [loss.reason.split()[0] for loss in report.losses] == [lost]
    assert "missing in 4 states" in report.losses[0].reason


@every({name: write for name, write in FLAVOURS.items() if name != "foxglove"})
def test_a_speed_that_no_body_has_is_missing_and_a_loss(tmp_path: Path, write: Writer) -> None:
    path = write(tmp_path / "odd", stand(4, Body(7, 20.0, v=400.0), Body(3, 5.0, v=100.0)))
    blocks, report = read(path)

    assert np.nanmax(np.abs(column(blocks, 7, "vx"))) < 1  # derived: it stands
    assert column(blocks, 3, "vx") == pytest.approx([100.0] * 4)
    assert [loss.reason.split()[0] for loss in report.losses] == ["speed"]


def test_numbers_that_no_body_has_are_missing_in_a_frame() -> None:
    frame = Frame(0, ego="a")
    frame.add("a", "car", 0.0, 0.0, length=-4.5, width=1.9, height=1.5, vx=3.0)
    frame.add("b", "car", 9.0, 0.0, length=4.5, width=1001.0, height=1.5, vx=90.0, vy=130.0)
    frame.add("c", "car", 18.0, 0.0, length=0.0, width=1000.0, vx=90.0, vy=110.0)

    online = SceneGraphGenerator(None, Config())
    graph = online.step(frame)
    reasons = [loss.reason for loss in online.losses]
    assert reasons[0] == "length of entity 'a' is -4.5 m: missing in 1 state"
    assert len(reasons) == 3
    about = {node["ident"]: node for node in graph.nodes.values()}
    assert "length" not in about["a"]
    assert about["a"]["width"] == pytest.approx(1.9)
    assert "width" not in about["b"]
    assert "vx" not in about["b"]
    assert about["c"]["length"] == 0
    assert about["c"]["vx"] == 90
    assert frame.losses == [
        ("a", "length is -4.5 m"),
        ("b", "width is 1001 m"),
        ("b", f"speed is {np.hypot(90, 130):g} m/s"),
    ]


# What is derived --------------------------------------------------------------------------------------


@every(DERIVING)
def test_nothing_is_derived_across_a_gap(tmp_path: Path, write: Writer) -> None:
    times = [*(i / 10 for i in range(6)), *(30 + i / 10 for i in range(6))]
    places = [*(0.5 * i for i in range(6)), *(100 + 0.5 * i for i in range(6))]
    scenes = [(t, [Body(7, x)]) for t, x in zip(times, places, strict=True)]
    path = write(tmp_path / "gap", scenes)
    for size in (1, 5, 60):
        blocks, report = read(path, size)

        assert column(blocks, 7, "vx") == pytest.approx([5.0] * 12)
        accelerations = column(blocks, 7, "ax")
        assert np.isnan(accelerations)[[0, 5, 6, 11]].all()
        assert np.nanmax(np.abs(accelerations)) < 1e-6
        assert any("longest 29.5 s" in warning for warning in report.warnings)


@every(DERIVING)
def test_a_gap_at_the_beginning_is_one_by_the_steps_behind_it(
    tmp_path: Path, write: Writer
) -> None:
    scenes = [(1.0, [Body(7, 0.0)]), *((9 + i / 10, [Body(7, 9 + 0.1 * i)]) for i in range(5))]
    blocks, _ = read(write(tmp_path / "gap", scenes), 1)

    speeds = column(blocks, 7, "vx")
    assert np.isnan(speeds[0])
    assert speeds[1:] == pytest.approx([1.0] * 5)


@every(DERIVING)
def test_two_missing_frames_are_no_gap_to_derive_across(tmp_path: Path, write: Writer) -> None:
    scenes = [(i / 10, [Body(7, 0.1 * i)]) for i in range(12) if i not in {5, 6}]
    blocks, _ = read(write(tmp_path / "few", scenes))

    assert column(blocks, 7, "vx") == pytest.approx([1.0] * 10)


def test_what_a_jump_would_give_is_missing_and_counted(tmp_path: Path) -> None:
    scenes = [(i / 1000, [Body(7, 0.4 if i == 3 else 0.0)]) for i in range(7)]  # too short a leap
    blocks, report = read(write_osi(tmp_path / "noise", scenes))

    speeds = column(blocks, 7, "vx")
    assert np.isnan(speeds[3])
    assert [*speeds[:3], *speeds[4:]] == pytest.approx([0.0] * 6)
    assert np.nanmax(np.abs(column(blocks, 7, "ax"))) <= 30
    assert any("velocities" in warning for warning in report.warnings)


def test_a_derived_acceleration_that_no_body_has_is_missing_and_counted(tmp_path: Path) -> None:
    places = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
    scenes = [(i / 10, [Body(7, x)]) for i, x in enumerate(places)]
    blocks, report = read(write_osi(tmp_path / "hop", scenes))

    accelerations = column(blocks, 7, "ax")
    assert np.isnan(accelerations[2])
    assert np.isnan(accelerations[3])
    assert [accelerations[1], accelerations[4]] == pytest.approx([0.0, 0.0])
    assert "2 derived accelerations above 30 m/s² are missing" in report.warnings


# Online -----------------------------------------------------------------------------------------------


def steps(*frames: tuple[float, list[Body]]) -> list[dict[str, tuple[int, str, int]]]:
    """Frame by frame the node id, kind and lifetime of each entity, by its id."""
    online = SceneGraphGenerator(None, Config())
    found = []
    for time, bodies in frames:
        frame = Frame(round(time * 1e9), ego="1")
        frame.add("1", "car", 0.0, 0.0)
        for body in bodies:
            frame.add(body.ident, body.kind, body.x, 0.0)
        nodes = online.step(frame).nodes
        found.append(
            {
                about["ident"]: (node, about["kind"], about.get("lifetime", 1))
                for node, about in nodes.items()
            }
        )
    return found


def test_an_id_that_returns_online_is_a_new_entity() -> None:
    first, same, kind, place, back = steps(
        (0.0, [Body(7, 5.0)]),
        (0.1, [Body(7, 6.0)]),
        (0.2, [Body(7, 6.0, "person"), Body(8, 9.0)]),
        (0.3, [Body(7, -40.0, "person"), Body(8, 9.0)]),
        (0.1, [Body(7, 40.0, "person"), Body(8, 9.0)]),
    )

    assert first["7"] == same["7"] == (1, "car", 1)
    assert kind["8"] == place["8"] == back["8"] == (2, "car", 1)
    assert kind["7"] == (3, "person", 2)
    assert place["7"] == back["7"] == (4, "person", 3)  # the clock jumped back: no place is judged


@pytest.mark.parametrize("write", [write_osi, write_foxglove])
def test_a_replay_has_the_entities_of_the_recording(tmp_path: Path, write: Writer) -> None:
    other, person = Body(3, 5.0), Body(7, 20.0, "person", (0.5, 0.5, 1.8))
    scenes = [
        *stand(3, other, Body(7, 20.0)),
        *stand(3, other, person, start=0.3),
        *stand(3, other, replace(person, x=-30.0), Body(9, 30.0), start=0.6),
    ]
    blocks, _ = read(write(tmp_path / "reuse", scenes), 4)
    online = SceneGraphGenerator(None, Config())
    replay = Replay()
    found = [online.step(frame) for block in blocks for frame in replay.frames(block)]

    lives = {about["ident"]: about.get("lifetime", 1) for about in found[-1].nodes.values()}
    assert lives == {"3": 1, "7": 3, "9": 1}
    stored = [node for block in blocks for node in block.states.node.tolist()]
    assert [node for graph in found for node in sorted(graph.nodes)] == [
        node
        for block in blocks
        for start, stop in zip(block.offsets, block.offsets[1:], strict=False)
        for node in sorted(block.states.node[start:stop].tolist())
    ]
    assert max(stored) == 4


def turning_scenes(draw: random.Random, *, steps: Sequence[float]) -> list[Scene]:
    """Scenes in which ids are used by turns, by entities of several kinds at several places."""
    size: dict[str, Size] = {"car": (4.5, 1.9, 1.5), "person": (0.5, 0.5, 1.8)}
    users = {
        ident: [
            (draw.choice((0.0, 3.0, 400.0, 900.0)) + 20 * ident, draw.choice(("car", "person")))
            for _ in range(draw.randint(1, 3))
        ]
        for ident in range(1, 5)
    }
    turns = {ident: draw.choice((1, 1, 3, 9)) for ident in users}
    scenes: list[Scene] = []
    time = 60.0
    for number in range(40):
        bodies: list[Body] = []
        for ident, some in users.items():
            x, kind = some[number // turns[ident] % len(some)]
            if draw.random() < 0.9:
                bodies.append(Body(ident, x + 0.5 * time, kind, size[kind]))
        scenes.append((time, [Body(9, -5.0), *bodies]))
        time = round(time + draw.choice(steps), 1)
    return scenes


@pytest.mark.parametrize(
    ("write", "steps"),
    [
        (write_osi, (0.1, 0.1, 0.3, 1.5)),
        (write_osi_file, (0.1, 0.1, 0.1, 1.5, -1.0)),
        (write_carla, (0.1, 0.1, 0.3, 1.5)),
        (write_foxglove, (0.1, 0.1, 0.3, 1.5)),
    ],
)
def test_the_same_frames_have_the_same_entities_online_and_stored(
    tmp_path: Path, write: Writer, steps: Sequence[float]
) -> None:
    lifetimes = 0
    for seed in range(4):
        draw = random.Random(seed)
        scenes = turning_scenes(draw, steps=steps)
        blocks, _ = read(write(tmp_path / str(seed), scenes), draw.choice((1, 7, 60)))
        rows = [row for block in blocks for row in zip(*named(block), strict=True)]
        stored: list[list[tuple[str, int, str]]] = []
        nodes: list[list[int]] = []
        for block in blocks:
            for start, stop in zip(block.offsets, block.offsets[1:], strict=False):
                node = sorted(block.states.node[start:stop].tolist())
                nodes.append(node)
                stored.append(sorted(rows[one] for one in node))
        lifetimes = max(lifetimes, *(life for _, life, _ in rows))

        replay, online = Replay(), SceneGraphGenerator(None, Config())
        again = [online.step(frame) for block in blocks for frame in replay.frames(block)]
        assert [sorted(graph.nodes) for graph in again] == nodes
        plain = SceneGraphGenerator(None, Config())
        for graph, (time, bodies), expected in zip(again, scenes, stored, strict=True):
            frame = Frame(round(time * 1e9))
            for body in bodies:
                frame.add(body.ident, body.kind, body.x, 0.0)
            for one in (graph, plain.step(frame)):
                assert expected == sorted(
                    (about["ident"], about["lifetime"], about["kind"])
                    for about in one.nodes.values()
                )

    assert lifetimes >= 3


def named(block: FrameBlock) -> tuple[Sequence[str], Sequence[int], list[str]]:
    """Ids, lifetimes and kinds of the entities that are new in a block."""
    new = block.entities
    return new.ident, new.lifetime or [1] * len(new), [KINDS[kind] for kind in new.kind.tolist()]


# Batches ----------------------------------------------------------------------------------------------


def test_any_exception_of_one_recording_fails_it_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = {"a": 20.0, "b": 21.0, "c": 22.0}
    paths = [write_osi(tmp_path / name, stand(3, Body(7, x))) for name, x in places.items()]
    opened = recording_ingest.open_trace

    def broken(path: Path, **how: Any) -> Any:
        if path.stem == "b":
            raise ZeroDivisionError("by nothing")
        return opened(path, **how)

    monkeypatch.setattr(recording_ingest, "open_trace", broken)
    monkeypatch.setattr(doctor, "open_trace", broken)
    outcomes = ingest(tmp_path / "s.sgstore", paths)

    assert [outcome.status for outcome in outcomes] == ["added", "failed", "added"]
    assert "ZeroDivisionError: by nothing" in str(outcomes[1].error)
    assert str(TraceOutcome.from_dict(outcomes[1].as_dict()).error) == str(outcomes[1].error)
    assert [trace.name for trace in Store(tmp_path / "s.sgstore").info()] == ["a", "c"]
    assert "ZeroDivisionError: by nothing" in doctor.examine(paths[1]).error


def test_gaps_are_listed_by_info_and_doctor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = [*(i / 10 for i in range(6)), *(30 + i / 10 for i in range(6))]
    path = write_osi(tmp_path / "gap", [(t, [Body(7, 0.0)]) for t in times])
    store = str(tmp_path / "s.sgstore")
    assert run(["ingest", store, str(path)]) == 0
    assert "1 gap longer than three periods" in capsys.readouterr().err
    assert run(["info", store]) == 0
    assert "gap: 1 gap; info" in capsys.readouterr().err
    for command in (["info", store, "--trace", "gap"], ["doctor", str(path)]):
        assert run(command) == 0
        assert "+29.5 s before #6" in capsys.readouterr().out
