"""What the ego sees: cases that tell the rules, and every line held against shapely."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import shapely
from builders import Place, Recording, Thing, edges, frames, graph_of, thing
from hypothesis import given, settings
from hypothesis import strategies as st
from test_relations import storeys_apart
from thorough import share_of

from sgstore.model.config import Config, RangeSettings
from sgstore.model.vocabulary import SIGNALS
from sgstore.sgg import SceneGraphGenerator

PI = math.pi
WIDE = Config(range=RangeSettings(200))


def seen(*things: Thing, config: Config = WIDE) -> set[str]:
    """Names of what the ego sees; it stands at the origin."""
    of = edges(graph_of(frames([thing("ego"), *things]), None, config))
    assert all(src == "ego" for src, relation, _ in of if relation == "sees")
    return {dst for _, relation, dst in of if relation == "sees"}


def person(x: float, y: float = 0, **other: Any) -> Thing:
    return thing("p", x, y, kind="person", length=0.5, width=0.5, z=0.9, height=1.8, **other)


@pytest.mark.parametrize(
    ("cover", "sees"),
    [
        pytest.param(thing("c", 10), False, id="behind a car"),
        pytest.param(thing("c", 30), True, id="before it"),
        pytest.param(thing("c", -10), True, id="on the other side"),
        pytest.param(thing("c", 10, 1.1), True, id="beside its shadow"),
        pytest.param(thing("c", 10, 0.9), True, id="a corner looks out of its shadow"),
        pytest.param(thing("c", 10, 0.7), False, id="wholly in its shadow"),
        pytest.param(thing("c", 10, 0, PI / 2), False, id="behind a car that crosses"),
        pytest.param(thing("c", 10, static=True), False, id="behind one that is parked"),
        pytest.param(thing("c", 10, kind="barrier", height=0.5, z=0.25), True, id="over a kerb"),
        pytest.param(thing("c", 10, kind="barrier", height=1.4, z=0.7), False, id="over a wall"),
        pytest.param(thing("c", 19, kind="barrier", height=1.4, z=0.7), False, id="near to a wall"),
        pytest.param(thing("c", 10, z=7), True, id="a bridge is above"),
        pytest.param(thing("c", 10, height=math.nan), True, id="what has no height hides nothing"),
        pytest.param(thing("c", 10, height=0), True, id="nor what is flat"),
        pytest.param(
            thing("c", 10, z=math.nan), False, id="at an unknown height, the plane counts"
        ),
        pytest.param(thing("c", 10, length=math.nan), True, id="what has no size hides nothing"),
        pytest.param(thing("c", 10, heading=math.nan), True, id="nor what lies in no direction"),
        pytest.param(thing("c", 10, kind="traffic_light"), True, id="nor a signal"),
        pytest.param(thing("c", 1, length=9, width=9), True, id="nor what the eye is in"),
        pytest.param(thing("c", 20), False, id="within it"),
    ],
)
def test_a_person_behind_something(cover: Thing, sees: bool) -> None:
    assert ("p" in seen(person(20), cover)) == sees


@pytest.mark.parametrize(
    ("target", "sees"),
    [
        pytest.param(thing("t", 20), False, id="a car"),
        pytest.param(thing("t", 20, z=2, height=4, width=2.5), True, id="a lorry looks over it"),
        pytest.param(thing("t", 20, z=2, height=4, width=1), True, id="however narrow"),
        pytest.param(thing("t", 20, kind="bus", z=1.5, height=3, width=8), True, id="beside it"),
        pytest.param(thing("t", 40, 0, kind="traffic_light", z=5, height=1), True, id="a light"),
        pytest.param(thing("t", 40, 0, kind="sign", z=1, height=0.5), False, id="a low sign"),
        pytest.param(thing("t", 20, length=math.nan, z=0.9), False, id="a point"),
        pytest.param(thing("t", 20, 5, length=math.nan), True, id="a point beside"),
        pytest.param(thing("t", 20, z=math.nan), False, id="at an unknown height"),
        pytest.param(thing("t", math.nan), False, id="nowhere"),
        pytest.param(thing("t", 20, static=True), False, id="a parked car"),
        pytest.param(thing("t", 1), True, id="one that the ego runs into"),
    ],
)
def test_something_behind_a_car(target: Thing, sees: bool) -> None:
    assert ("t" in seen(target, thing("c", 10))) == sees


def test_a_lorry_sees_more_than_a_car() -> None:
    behind = [person(20), thing("c", 8)]

    low = edges(graph_of(frames([thing("ego"), *behind])))
    high = edges(graph_of(frames([thing("ego", z=2, height=4), *behind])))

    assert ("ego", "sees", "p") not in low
    assert ("ego", "sees", "p") in high


def test_two_may_hide_what_neither_hides() -> None:
    bus = thing("t", 30, 0, PI / 2, z=1.5, height=3, length=8)
    left, right = (thing(name, 15, y, z=2, height=4, width=3) for name, y in (("l", 1), ("r", -1)))

    assert "t" in seen(bus, left)
    assert "t" in seen(bus, right)
    assert "t" not in seen(bus, left, right)


def test_without_an_ego_nobody_sees() -> None:
    of = edges(graph_of(frames([thing("a"), thing("b", 5)])))

    assert not {e for e in of if e[1] == "sees"}


def test_what_is_not_computed_is_not_known() -> None:
    blind = Config(sees=False)

    assert "sees" in SceneGraphGenerator(None, Config()).answers
    assert "sees" not in SceneGraphGenerator(None, blind).answers
    assert seen(thing("c", 5), config=blind) == set()


# … line by line ---------------------------------------------------------------------------------


def looked(things: list[Thing], ego: Thing) -> tuple[set[str], set[str]]:
    """What is seen, and what may be seen or not because a line all but touches: by shapely."""
    free, doubtful = set[str](), set[str]()
    eye = ego.z + (0 if math.isnan(ego.height) else ego.height / 2)
    for t in things:
        if t is ego or math.isnan(t.x + t.y) or storeys_apart(t, ego):
            continue
        covers = [c for c in things if c is not t and c is not ego and hides(c, ego)]
        best = max(
            min((clearance(ego, eye, t, point, c) for c in covers), default=math.inf)
            for point in points(t)
        )
        if abs(best) < 1e-5:
            doubtful.add(t.name)
        elif best > 0:
            free.add(t.name)
    return free, doubtful


def footprint(t: Thing) -> Any:
    around = shapely.box(-t.length / 2, -t.width / 2, t.length / 2, t.width / 2)
    return Place(t.x, t.y, t.heading).placed(around)


def hides(c: Thing, ego: Thing) -> bool:
    known = not any(map(math.isnan, (c.x, c.y, c.heading, c.length, c.width)))
    if not known or c.kind in SIGNALS or not c.height > 0:
        return False
    return not footprint(c).intersects(shapely.Point(ego.x, ego.y))


def points(t: Thing) -> list[tuple[float, float]]:
    if any(map(math.isnan, (t.heading, t.length, t.width))):
        return [(t.x, t.y)]
    return [(t.x, t.y), *list(footprint(t).exterior.coords)[:4]]


def clearance(ego: Thing, eye: float, t: Thing, point: tuple[float, float], c: Thing) -> float:
    """By how much a line misses a cover; below zero: how deep it runs through it."""
    line = shapely.LineString([(ego.x, ego.y), point])
    body = footprint(c)
    part = line.intersection(body)
    if part.is_empty or part.length == 0:
        return float(line.distance(body)) + 1e-9
    aside = -depth(line, body)
    shares = [line.project(shapely.Point(p), normalized=True) for p in part.coords]
    heights = [eye + share * (t.z - eye) for share in shares]
    if any(map(math.isnan, [*heights, c.z])):
        return aside
    under, over = c.z - c.height / 2 - max(heights), min(heights) - c.z - c.height / 2
    return max(aside, under, over)


def depth(line: Any, body: Any) -> float:
    """How far a line through a body is from missing it."""
    (x0, y0), (x1, y1) = line.coords
    length = math.hypot(x1 - x0, y1 - y0) or 1
    sides = [
        ((x - x0) * (y1 - y0) - (y - y0) * (x1 - x0)) / length for x, y in body.exterior.coords
    ]
    return min(max(sides), -min(sides), line.intersection(body).length)


def crowd(seed: int, count: int, size: float) -> list[Thing]:
    rng = np.random.default_rng(seed)
    kinds = ("car", "truck", "person", "prop", "building", "traffic_light", "unknown")
    things = [thing("ego", 0, 0, rng.uniform(-PI, PI))]
    for i in range(count):
        values = {
            "x": rng.uniform(-size, size),
            "y": rng.uniform(-size, size),
            "heading": rng.uniform(-PI, PI),
            "length": rng.uniform(0.3, 10),
            "width": rng.uniform(0.3, 3),
            "height": float(rng.choice([0.4, 1.5, 1.5, 4, 0])),
        }
        values["z"] = values["height"] / 2 + float(rng.choice([0, 0, 0, 5]))
        if rng.random() < 0.1:
            values[str(rng.choice(list(values)))] = math.nan
        kind = str(rng.choice(kinds))
        things.append(Thing(f"t{i}", kind, static=bool(rng.random() < 0.2), **values))
    return things


@given(st.integers(0, 2**32), st.integers(1, 14), st.sampled_from([6, 15, 40]))
@settings(max_examples=share_of(150), deadline=None)
def test_what_is_seen_is_what_a_free_line_leads_to(seed: int, count: int, size: float) -> None:
    things = crowd(seed, count, size)

    found = seen(*things[1:]) if things[0].heading == 0 else looked_from(things)

    free, doubtful = looked(things, things[0])
    assert found - doubtful == free - doubtful


def looked_from(things: list[Thing]) -> set[str]:
    of = edges(graph_of(frames(things), None, WIDE))
    return {dst for _, relation, dst in of if relation == "sees"}


def test_a_body_less_hides_nothing_more() -> None:
    for seed in range(20):
        things = crowd(seed, 12, 12)
        before = looked_from(things)
        for gone in things[1:]:
            after = looked_from([t for t in things if t is not gone])
            assert before - {gone.name} <= after


def test_a_crowd_that_is_looked_at_in_parts_is_seen_like_any_other() -> None:
    scenes = [crowd(seed, 40, 15) for seed in range(3)]
    whole = graph_of(Recording().block(*scenes), None, WIDE)

    parts = graph_of(Recording().block(*scenes * 200), None, WIDE)  # more than one part holds

    counts = np.bincount(parts.edges.frame).reshape(-1, 3)
    assert (counts == np.bincount(whole.edges.frame)).all()
    for frame in (*range(3), *range(597, 600)):
        assert edges(parts, frame) == edges(whole, frame % 3)
