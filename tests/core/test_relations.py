"""Families of relations: the laws that all obey, the ends of intervals, and the definitions in plain loops."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import shapely
from builders import PaperMap, Patch, Place, Recording, Thing, edges, frames, graph_of, thing
from hypothesis import example, given, settings
from hypothesis import strategies as st
from thorough import share_of

from sgstore.graphs.relations import BlockScene, Relation, as_markdown, relations, relations_under
from sgstore.model.config import Config, Direction, PairSettings, Proximity, RangeSettings
from sgstore.model.vocabulary import DIRECTIONS, PROXIMITY, SIDES, SIGNALS, VEHICLES
from sgstore.sgg import SceneGraphGenerator

if TYPE_CHECKING:
    from sgstore.query import Store

pytestmark = pytest.mark.seconds(6)

PI = math.pi
TOWN = PaperMap(
    Patch("east", -80, -4, 80, 0, road="main", controlled_by="s1", to=("east on",)),
    Patch("east on", 80, -4, 160, 0, road="main 2"),
    Patch("west", -80, 0, 80, 4, road="main"),
    Patch("path", -80, 4, 80, 6, road="main", lane_type="sidewalk"),
    Patch("cross", -2, -80, 2, 80, road="side", junction="middle", controlled_by="s1"),
    Patch("bridge", -80, -20, 80, -12, road="high", z=6),
    Patch("exit", -80, 12, 80, 16, road="ramp", lane_type="exit"),
    Patch("zebra", 8, -4, 12, 4, kind="crosswalk"),
    objects=(("s1", "traffic_light"),),
)
KINDS = ("car", "truck", "bicycle", "person", "prop", "traffic_light", "animal", "unknown")
SYMMETRIC = {one.name for one in relations() if one.symmetric}
Family = tuple[Relation, ...]
FAMILIES = [
    tuple(one for one in relations() if one.edges is edges)
    for edges in dict.fromkeys(one.edges for one in relations() if one.edges)
]
"""Relations that are computed together."""
family = pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family[0].name)


def crowd(seed: int, count: int = 12, size: float = 40) -> list[Thing]:
    """An ego among things of all kinds, at places that lie on no bound."""
    rng = np.random.default_rng(seed)
    things = [
        Thing(
            f"e{i}" if i else "ego",
            kind=str(rng.choice(KINDS)) if i else "car",
            x=rng.uniform(-size, size),
            y=rng.uniform(-size, size),
            heading=rng.uniform(-PI, PI),
            z=float(rng.choice([0.75, 0.75, 6.75, np.nan], p=[0.6, 0.2, 0.15, 0.05])),
            length=rng.uniform(0.4, 12),
            width=rng.uniform(0.4, 3),
            static=bool(i and rng.random() < 0.15),
        )
        for i in range(count)
    ]
    things += [thing("light", 5, 5, 1.0, kind="traffic_light", map_ref="s1")]
    return [things[0], *(t if rng.random() > 0.05 else blurred(t, rng) for t in things[1:])]


def busy(seed: int) -> list[Thing]:
    """A crowd in which every relation holds: a column of cars, two of which touch, a trailer and a light."""
    column = [thing("c1", 10, -2), thing("c2", 13.5, -2.2), thing("c3", 20, -1.9)]
    column += [thing("c4", -20, -2, length=6), thing("t4", -25, -2, kind="trailer", length=5)]
    light = thing("lamp", 5, 5, 1.0, kind="traffic_light", map_ref="s1")
    return [*crowd(seed, size=20), *column, light]


def blurred(what: Thing, rng: np.random.Generator) -> Thing:
    """A thing with one number missing."""
    name = str(rng.choice(["x", "y", "z", "heading", "length", "width", "height"]))
    return Thing(**(vars(what) | {name: math.nan}))


def found(
    things: list[Thing], family: Family, config: Config | None = None, town: PaperMap = TOWN
) -> list[tuple[str, str, str]]:
    config = config or Config()
    graph = graph_of(frames(things), town, config)
    names = {one.name for one in family}
    return [edge for edge in edges(graph, 0, town) if edge[1] in names]


# Laws of every family ---------------------------------------------------------------------------


@family
def test_a_family_that_needs_a_map_says_so_where_there_is_none(family: Family) -> None:
    nothing: Any = None
    scene = BlockScene(Config(), nothing, nothing, nothing, nothing, ground=None)
    if family[0].needs_map:
        with pytest.raises(ValueError, match=r"needs? a map"):
            family[0].edges(scene)


@family
def test_nothing_is_related_to_itself_and_no_edge_is_given_twice(family: Family) -> None:
    scenes = [found(busy(seed), family) for seed in range(10)]

    assert any(scenes)
    for of in scenes:
        assert all(src != dst for src, _, dst in of)
        assert len(set(of)) == len(of)


@family
@pytest.mark.parametrize("seed", range(10))
def test_symmetric_relations_are_symmetric(family: Family, seed: int) -> None:
    of = {edge for edge in found(busy(seed), family) if edge[1] in SYMMETRIC}

    assert of == {(dst, relation, src) for src, relation, dst in of}


@family
@pytest.mark.parametrize("seed", range(10))
def test_relations_stay_when_the_world_is_moved_and_turned(family: Family, seed: int) -> None:
    rng = np.random.default_rng(seed)
    # A footprint without a heading lies along the x axis, however the world is turned.
    things = [t for t in busy(seed) if not math.isnan(t.heading)]
    to = Place(*rng.uniform(-3000, 3000, 2), rng.uniform(-9, 9), rng.uniform(-50, 50))

    moved = found([t.moved(to) for t in things], family, town=TOWN.moved(to))

    assert moved == found(things, family)


@family
@pytest.mark.parametrize("blocks", [1, 2, 7])
def test_a_block_of_one_frame_gives_what_a_block_of_many_gives(family: Family, blocks: int) -> None:
    scenery = [t for t in crowd(0) if t.static]
    scenes = [
        [t for t in crowd(seed) if not t.static and t.kind == "car"][seed % 2 :] + scenery
        for seed in range(7)
    ]
    many, few = Recording(), Recording()
    whole = graph_of(many.block(*scenes), TOWN)
    expected = [edges(whole, i, TOWN, many.names) for i in range(7)]

    generator = SceneGraphGenerator(TOWN, Config())
    parts = [
        generator.block(few.block(*scenes[i : i + blocks])) for i in range(0, len(scenes), blocks)
    ]

    of = [edges(part, i, TOWN, few.names) for part in parts for i in range(len(part))]
    names = {one.name for one in family}
    assert [[e for e in frame if e[1] in names] for frame in of] == [
        [e for e in frame if e[1] in names] for frame in expected
    ]


def test_only_relations_that_the_settings_ask_for_are_there() -> None:
    config = Config(
        proximity=Proximity(("near", "visible"), (9.0, 30.0)),
        direction=Direction(("inDFrontOf", "atDRearOf"), (90.0,)),
    )
    graph = graph_of(frames(busy(3)), TOWN, config)
    asked = {one.name for one in relations_under(config) if one.edges}

    assert {relation for _, relation, _ in edges(graph, 0, TOWN)} == asked


# Ends of intervals ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distance", "relation"),
    [
        (0, "safety_hazard"),
        (2, "safety_hazard"),
        (math.nextafter(2, 3), "near_coll"),
        (4, "near_coll"),
        (math.nextafter(4, 5), "super_near"),
        (7, "super_near"),
        (10, "very_near"),
        (16, "near"),
        (25, "visible"),
        (math.nextafter(25, 26), None),
    ],
)
def test_a_distance_on_a_bound_belongs_to_the_nearer_relation(
    distance: float, relation: str | None
) -> None:
    of = edges(graph_of(frames([thing("ego"), thing("c", distance)])))
    near = [(src, name, dst) for src, name, dst in of if name in PROXIMITY]

    expected = [("c", relation, "ego"), ("ego", relation, "c")] if relation else []
    assert near == expected


def test_distance_is_measured_in_space() -> None:
    of = edges(graph_of(frames([thing("ego"), thing("c", 6.9, z=0.75 + 1.4)])))

    assert ("c", "very_near", "ego") in of


@pytest.mark.parametrize("heading", [0, PI / 2, PI, -PI / 2, 3 * PI / 4, 1.0])
@pytest.mark.parametrize(
    ("degrees", "direction", "side"),
    [
        (0, "inDFrontOf", None),
        (0.0028, "inDFrontOf", None),
        (0.0029, "inDFrontOf", "toLeftOf"),
        (-0.0029, "inDFrontOf", "toRightOf"),
        (45, "inDFrontOf", "toLeftOf"),
        (-45, "inDFrontOf", "toRightOf"),
        (45.0001, "inSFrontOf", "toLeftOf"),
        (90, "inSFrontOf", "toLeftOf"),
        (-90, "inSFrontOf", "toRightOf"),
        (90.0001, "atSRearOf", "toLeftOf"),
        (135, "atSRearOf", "toLeftOf"),
        (-135, "atSRearOf", "toRightOf"),
        (135.0001, "atDRearOf", "toLeftOf"),
        (179.997, "atDRearOf", "toLeftOf"),
        (180, "atDRearOf", None),
        (-179.997, "atDRearOf", "toRightOf"),
    ],
)
def test_a_bearing_on_a_bound_belongs_to_the_sector_ahead(
    degrees: float, direction: str, side: str | None, heading: float
) -> None:
    angle = heading + math.radians(degrees)
    other = thing("c", 100 + 20 * math.cos(angle), 70 + 20 * math.sin(angle), heading=math.nan)

    of = edges(graph_of(frames([thing("ego", 100, 70, heading), other])))

    expected = [("c", direction, "ego"), *([("c", side, "ego")] if side else [])]
    assert [edge for edge in of if edge[1] in {*DIRECTIONS, *SIDES}] == expected


def test_who_sees_is_the_target() -> None:
    of = edges(graph_of(frames([thing("ego"), thing("c", 10, 3, heading=PI)])))

    assert ("c", "inDFrontOf", "ego") in of
    assert ("c", "toLeftOf", "ego") in of
    assert ("ego", "toLeftOf", "c") in of


# Which pairs are related ------------------------------------------------------------------------


def relations_between(a: Thing, b: Thing, config: Config | None = None) -> set[str]:
    ego = thing("ego", 30, 30)
    of = edges(graph_of(frames([ego, a, b]), None, config))
    return {relation for src, relation, dst in of if {src, dst} == {a.name, b.name}}


def test_moving_entities_are_related_up_to_the_distance_set() -> None:
    a = thing("a")

    assert relations_between(a, thing("b", 25)) >= {"visible", "inDFrontOf", "atDRearOf"}
    assert relations_between(a, thing("b", 25.001)) == set()
    assert relations_between(a, thing("b", 9), Config(pairs=PairSettings(within=8))) == set()
    assert relations_between(a, thing("b", 1), Config(pairs=PairSettings(within=0))) == set()
    assert "inDFrontOf" in relations_between(
        a, thing("b", 29), Config(pairs=PairSettings(within=30))
    )


@pytest.mark.parametrize("kind", ["car", "person", "animal", "bicycle", "unknown"])
def test_whatever_moves_is_related_to_its_neighbours(kind: str) -> None:
    assert relations_between(thing("a"), thing("b", 3, kind=kind))


@pytest.mark.parametrize("kind", SIGNALS)
def test_signals_are_related_to_the_ego_only(kind: str) -> None:
    light = thing("light", 3, kind=kind)

    assert relations_between(thing("a"), light) == set()
    assert ("light", "near_coll", "ego") in edges(graph_of(frames([thing("ego"), light])))


def test_scenery_is_related_to_the_ego_only() -> None:
    parked = thing("parked", 5, static=True)

    assert relations_between(thing("a"), parked) == set()
    assert ("parked", "super_near", "ego") in edges(graph_of(frames([thing("ego"), parked])))


def test_what_never_moves_is_related_to_its_like_when_that_is_asked() -> None:
    post, sign = (
        thing("post", 3, static=True, kind="pole"),
        thing("s", 12, kind="sign", static=True),
    )
    far, mover = thing("far", 45, static=True), thing("mover", -9)
    recording, generator = (
        Recording(),
        SceneGraphGenerator(None, Config(pairs=PairSettings(static=True))),
    )

    blocks = [[thing("ego", -2, 9), post, mover], [thing("ego", 20), sign, far, mover]]
    graphs = [generator.block(recording.block(frame, frame)) for frame in blocks]
    found = [
        {(a, r, b) for a, r, b in edges(graph, 1, None, recording.names) if "ego" not in (a, b)}
        for graph in graphs
    ]

    assert found[0] == set()
    assert ("post", "very_near", "s") in found[1]
    assert ("s", "inDFrontOf", "post") in found[1]
    assert {frozenset((a, b)) for a, _, b in found[1]} == {frozenset(("post", "s"))}


@pytest.mark.parametrize("seed", range(5))
def test_static_pairs_are_those_that_would_be_related_if_they_moved(seed: int) -> None:
    things = [t for t in crowd(seed, 20, 30) if t.kind not in SIGNALS]
    still = [Thing(**(vars(t) | {"static": t.name != "ego"})) for t in things]
    moving = [Thing(**(vars(t) | {"static": False})) for t in things]
    pairs = {*PROXIMITY, *DIRECTIONS, *SIDES}

    found, expected = (
        {e for e in edges(graph_of(frames(scene), None, config)) if e[1] in pairs}
        for scene, config in ((still, Config(pairs=PairSettings(static=True))), (moving, Config()))
    )

    assert found == expected


def test_the_ego_is_related_to_everything_in_range_whatever_the_distance() -> None:
    far = thing("far", 49, 1)

    of = edges(graph_of(frames([thing("ego"), far])))

    assert ("far", "inDFrontOf", "ego") in of
    assert ("far", "toLeftOf", "ego") in of
    assert not [edge for edge in of if edge[1] in PROXIMITY]


def test_without_ego_pairs_the_ego_is_one_of_many() -> None:
    config = Config(pairs=PairSettings(ego=False), sees=False)
    things = [thing("ego"), thing("near", 20), thing("far", 30), thing("post", 5, static=True)]

    of = edges(graph_of(frames(things), None, config))

    assert {frozenset((src, dst)) for src, _, dst in of} == {
        frozenset(("ego", "near")),
        frozenset(("near", "far")),
    }


def test_a_missing_heading_takes_away_only_what_is_seen_from_there() -> None:
    of = edges(graph_of(frames([thing("ego", heading=math.nan), thing("c", 10, 1)])))

    assert [edge for edge in of if edge[1] != "sees"] == [
        ("c", "near", "ego"),
        ("ego", "atDRearOf", "c"),
        ("ego", "near", "c"),
        ("ego", "toRightOf", "c"),
    ]


# Lanes and signals ------------------------------------------------------------------------------


def places(*things: Thing) -> list[tuple[str, str]]:
    graph = graph_of(frames([thing("ego", 15), *things]), TOWN)
    return [(a, b) for a, r, b in edges(graph, 0, TOWN) if r == "isIn" and a != "ego"]


@pytest.mark.parametrize(
    ("what", "where"),
    [
        pytest.param(thing("c", 30, -2), ["east"], id="in a lane"),
        pytest.param(thing("c", 30, 0), ["east", "west"], id="astride"),
        pytest.param(thing("c", 0, -2), ["cross", "east"], id="in a junction"),
        pytest.param(
            thing("c", 20, 5, kind="person", length=0.5, width=0.5),
            ["off_road", "path"],
            id="on a sidewalk: a lane, but none for driving",
        ),
        pytest.param(thing("c", 20, 14), ["exit"], id="a ramp is made for driving"),
        pytest.param(thing("c", 20, 25), ["off_road"], id="in the fields"),
        pytest.param(thing("c", 20, 25, static=True), ["off_road"], id="parked in the fields"),
        pytest.param(
            thing("c", 20, 25, kind="unknown"), ["off_road"], id="whatever moves can leave the road"
        ),
        pytest.param(
            thing("c", 20, 25, kind="building", static=True), [], id="a building was never on it"
        ),
        pytest.param(thing("c", 20, -2, kind="building", static=True), ["east"], id="unless it is"),
        pytest.param(thing("c", 20, -2, kind="traffic_light"), [], id="signals hang over roads"),
        pytest.param(thing("c", 20, -16), ["off_road"], id="below a bridge"),
        pytest.param(thing("c", 20, -16, z=6.75), ["bridge"], id="on it"),
        pytest.param(thing("c", 20, -16, z=math.nan), ["bridge"], id="on any storey"),
        pytest.param(thing("c", 10, -2), ["east", "zebra"], id="on a crosswalk"),
        pytest.param(thing("c", 20, -2, z=3, height=6), ["east"], id="by its lower side"),
        pytest.param(thing("c", math.nan, -2), [], id="nowhere"),
        pytest.param(thing("c", 20, -2, length=math.nan, width=math.nan), ["east"], id="a point"),
        pytest.param(thing("c", 20, -2, height=math.nan), ["east"], id="of unknown height"),
    ],
)
def test_a_footprint_is_in_what_it_meets(what: Thing, where: list[str]) -> None:
    assert places(what) == [("c", place) for place in where]


def test_a_signal_controls_those_of_its_lanes_that_are_in_range() -> None:
    light = thing("light", 5, 5, kind="traffic_light", map_ref="s1")
    stranger = thing("stranger", 5, 5, kind="traffic_light", map_ref="s9")

    near = edges(graph_of(frames([thing("ego"), light, stranger]), TOWN), 0, TOWN)
    at_the_end = edges(
        graph_of(frames([thing("ego", 70), Thing(**vars(light) | {"x": 60})]), TOWN), 0, TOWN
    )

    assert [(a, b) for a, r, b in near if r == "controlsTrafficOf"] == [
        ("light", "cross"),
        ("light", "east"),
    ]
    assert [(a, b) for a, r, b in at_the_end if r == "controlsTrafficOf"] == [("light", "east")]


# The definitions, in plain loops ----------------------------------------------------------------

BOUNDS = (2, 4, 7, 10, 16, 25)
NOISE = math.degrees(1e-6)


DEFINED = {*PROXIMITY, *DIRECTIONS, *SIDES, "isIn", "controlsTrafficOf", "overlaps"}


def told(things: list[Thing]) -> set[tuple[str, str, str]]:
    """The edges that the generator gives, as far as they are defined here."""
    return {e for e in edges(graph_of(frames(things), TOWN), 0, TOWN) if e[1] in DEFINED}


def defined(things: list[Thing], radius: float = 50) -> set[tuple[str, str, str]]:
    """The edges of one frame as the specification has them, pair by pair."""
    ego = things[0]
    inside = [t for t in things if in_range(t, ego, radius)]
    of: set[tuple[str, str, str]] = set()
    for a in inside:
        of |= standing(a, inside, radius)
        for b in inside:
            if a is not b and related(a, b):
                of |= seen(a, b)
            if a is not b and touching(a, b):
                of.add((a.name, "overlaps", b.name))
    return of


def in_range(t: Thing, ego: Thing, radius: float) -> bool:
    if math.isnan(t.x + t.y):
        return False
    size = (t.heading, t.length, t.width)
    heading, length, width = (0, 0, 0) if any(map(math.isnan, size)) else size
    footprint = Place(t.x, t.y, heading).placed(
        shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    )
    return footprint.distance(shapely.Point(ego.x, ego.y)) <= radius


def distance(a: Thing, b: Thing) -> float:
    rise = 0 if math.isnan(a.z - b.z) else b.z - a.z
    return math.dist((a.x, a.y, 0), (b.x, b.y, rise))


def related(a: Thing, b: Thing) -> bool:
    if "ego" in (a.name, b.name):
        return True
    movers = all(not t.static and t.kind not in SIGNALS for t in (a, b))
    return movers and distance(a, b) <= 25


def touching(a: Thing, b: Thing) -> bool:
    """Whether boxes meet, in the plane and in height as far as it is known."""
    if (a.static and b.static) or {a.kind, b.kind} & set(SIGNALS):
        return False
    known = not any(math.isnan(v) for t in (a, b) for v in (t.heading, t.length, t.width))
    if not known or footprint(a).distance(footprint(b)) > 1e-4:
        return False
    return bodies(a, b) and not heights_apart(a, b)


def bodies(a: Thing, b: Thing) -> bool:
    """Whether both are bodies on one storey, and neither rides on the other."""
    return not (flat(a) or flat(b) or storeys_apart(a, b) or rides(a, b) or rides(b, a))


def rides(a: Thing, b: Thing) -> bool:
    """Whether a is a person within the footprint of a two-wheeler who faces its way."""
    if a.kind != "person" or b.kind != "bicycle" or a.static or b.static:
        return False
    faces = math.cos(a.heading - b.heading) > 0.7
    known = not any(math.isnan(v) for v in (a.length, a.width, b.length, b.width))
    return known and faces and footprint(b).intersects(shapely.Point(a.x, a.y))


def flat(t: Thing) -> bool:
    """Whether it is no body: something that may lie on the ground has no height."""
    return t.height == 0 and t.kind in {"prop", "unknown"} | set(SIGNALS)


def storeys_apart(a: Thing, b: Thing) -> bool:
    """Whether two are apart in height by more than a road of 10 % climbs, or than a storey, between them."""
    away = math.hypot(b.x - a.x, b.y - a.y)
    return heights_apart(a, b) and abs(bottom(a) - bottom(b)) > min(0.1 * away, 2.5)


def heights_apart(a: Thing, b: Thing) -> bool:
    """Whether two are apart in height, as far as it is known; signals are on no storey."""
    if {a.kind, b.kind} & set(SIGNALS):
        return False
    apart, reach = abs(a.z - b.z), (a.height + b.height) / 2
    if math.isnan(reach) or 0 in {a.height, b.height}:
        apart, reach = abs(bottom(a) - bottom(b)), 2.5 - 1e-4
    return apart > reach + 1e-4


def footprint(t: Thing) -> Any:
    around = shapely.box(-t.length / 2, -t.width / 2, t.length / 2, t.width / 2)
    return Place(t.x, t.y, t.heading).placed(around)


def bottom(t: Thing) -> float:
    return t.z - (0 if math.isnan(t.height) else t.height / 2)


def seen(a: Thing, b: Thing) -> set[tuple[str, str, str]]:
    """What is said of b as seen from a, and how near they are."""
    of: set[tuple[str, str, str]] = set()
    for name, low, high in zip(PROXIMITY, (-1, *BOUNDS), BOUNDS, strict=False):
        if bodies(a, b) and low < distance(a, b) <= high:
            of.add((a.name, name, b.name))
    if math.isnan(a.heading):
        return of
    ahead = (b.x - a.x) * math.cos(a.heading) + (b.y - a.y) * math.sin(a.heading)
    left = (b.y - a.y) * math.cos(a.heading) - (b.x - a.x) * math.sin(a.heading)
    bearing = 0 if a.x == b.x and a.y == b.y else math.degrees(math.atan2(left, ahead))
    sector = sum(abs(bearing) > bound + NOISE for bound in (45, 90, 135))
    of.add((b.name, DIRECTIONS[sector], a.name))
    if abs(left) > 1e-3:
        of.add((b.name, "toLeftOf" if bearing > 0 else "toRightOf", a.name))
    return of


def standing(t: Thing, inside: list[Thing], radius: float) -> set[tuple[str, str, str]]:
    """The lanes it is in; for a signal, the lanes that it controls and that are in range or stood on."""
    if t.kind in SIGNALS:
        centre = shapely.Point(inside[0].x, inside[0].y)
        near = {name for name, shape in TOWN.shapes.items() if shape.distance(centre) <= radius}
        for other in inside:
            if other.kind not in SIGNALS:
                near |= {p.name for p in touched_by(other, "lane")}
        lanes = [p.name for p in TOWN.patches if t.map_ref and p.controlled_by == t.map_ref]
        return {(t.name, "controlsTrafficOf", name) for name in lanes if name in near}
    touched = touched_by(t, "lane", "crosswalk")
    of = {(t.name, "isIn", p.name) for p in touched}
    users = (*VEHICLES, "person", "animal", "prop")
    if (t.kind in users or not t.static) and not any(
        p.kind == "lane" and p.lane_type in ("driving", "exit") for p in touched
    ):
        of.add((t.name, "isIn", "off_road"))
    return of


def touched_by(t: Thing, *kinds: str) -> list[Patch]:
    box = np.array([t.x, t.y, t.heading, t.length, t.width])
    return [p for kind in kinds for p, _ in TOWN.touched(box, bottom(t), kind)]


@given(st.integers(0, 2**32), st.integers(2, 25), st.sampled_from([8, 30, 70]))
@example(410388, 5, 70)  # a lane out of range in which a body in range stands
@settings(max_examples=share_of(60), deadline=None)
def test_relations_equal_their_definition_on_random_scenes(
    seed: int, count: int, size: float
) -> None:
    things = crowd(seed, count, size)

    assert told(things) == defined(things)


on_a_grid = st.builds(
    lambda x, y, z, quarter, kind, static: thing(
        "?", x, y, quarter * PI / 4, z=z, kind=kind, static=static
    ),
    st.integers(-8, 8),
    st.integers(-8, 8),
    st.sampled_from([0.75, 0.75, 6.75, math.nan]),
    st.integers(-4, 4),
    st.sampled_from(KINDS),
    st.booleans(),
)


@given(st.lists(on_a_grid, max_size=8))
@settings(max_examples=share_of(100), deadline=None)
def test_relations_equal_their_definition_where_everything_lies_on_bounds(
    others: list[Thing],
) -> None:
    things = [thing("ego")]
    things += [Thing(**vars(t) | {"name": f"t{i}"}) for i, t in enumerate(others)]

    of = {edge for edge in told(things) if edge[1] != "isIn"}

    assert of == {edge for edge in defined(things) if edge[1] != "isIn"}


def test_a_crowd_that_is_looked_at_in_parts_is_related_like_any_other() -> None:
    things = [t for t in crowd(1, 60, 25) if t.kind != "traffic_light"]
    scenes = [[t for t in things if t.name != name] for name in ("e1", "e2", "e3")]
    whole = graph_of(frames(*scenes), TOWN)

    parts = graph_of(frames(*scenes * 100), TOWN)  # more pairs than one part holds

    counts = np.bincount(parts.edges.frame).reshape(-1, 3)
    assert (counts == np.bincount(whole.edges.frame)).all()
    for frame in (*range(3), *range(297, 300)):
        assert edges(parts, frame, TOWN) == edges(whole, frame % 3, TOWN)


def test_absurd_positions_are_related_to_nothing_and_disturb_nobody() -> None:
    sane = [thing("a"), thing("b", 3)]
    absurd = [thing("far", 1e300, -1e300), thing("inf", math.inf, 2), thing("minus", -1e18)]

    alone = edges(graph_of(frames(sane), None, Config(range=RangeSettings(40.0))))
    together = edges(graph_of(frames([*absurd, *sane])))

    assert [edge for edge in together if edge[1] in PROXIMITY] == [
        ("a", "near_coll", "b"),
        ("b", "near_coll", "a"),
    ]
    assert together == alone


def test_the_page_of_relations_is_made_from_their_declarations() -> None:
    page = Path(__file__).parents[2] / "docs" / "relations.md"

    assert page.read_text(encoding="utf-8") == as_markdown()


def test_signs_of_the_map_have_numbers_but_no_relations_of_distance(open_town: Store) -> None:
    found = open_town.find(
        "MATCH (e:Ego), (s:Sign) WHERE dist(e, s) < 45 RETURN dist(e, s), e.x, e.y, e.z, s.x, s.y, s.z"
    ).rows()
    assert len(found) > 100
    for row in found[::10]:
        dist, *place = (row[number] for number in range(7))
        assert dist == pytest.approx(math.dist(place[:3], place[3:]), abs=1e-3)
    assert open_town.find("MATCH (e:Ego)-[r]-(s:Sign)").count() == 0
    assert open_town.find("MATCH (e:Ego)-[r:visible|near]-(s:TrafficLight)").count() > 100
