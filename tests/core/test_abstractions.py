"""Abstractions: what is in them, what it is called, and that a store gives the same as the generator."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import fields

import networkx as nx
import numpy as np
import pytest
from networkx.algorithms.isomorphism import MultiDiGraphMatcher
from thorough import LONG

import sgstore
from sgstore.errors import AbstractionError
from sgstore.graphs.abstractions import (
    ABSTRACTIONS,
    AT_INGEST,
    GraphColumns,
    Labelled,
    MapColumns,
    abstraction_named,
    classes_of,
    contents_of,
    register,
)
from sgstore.graphs.abstractions._literature import roadscene2vec
from sgstore.graphs.abstractions._registry import _REGISTERED as REGISTERED
from sgstore.model.vocabulary import DIRECTIONS, KIND_CODE, PROXIMITY, RELATION_CODE

BETWEEN = {*PROXIMITY, *DIRECTIONS, "toLeftOf", "toRightOf"}
EGO, CAR, BUS, PERSON = range(4)
LEFT, OWN, RIGHT, AGAINST, AHEAD, WALK, ROAD = range(-2, -9, -1)


def grounds() -> MapColumns:
    """Three lanes one way, one against them, one that follows the ego's, a sidewalk; a road."""
    kinds = ["off_road", *["lane"] * 6, "road"]
    types = ["", *["driving"] * 5, "sidewalk", ""]
    edges = [
        ("toLeftOf", LEFT, OWN),
        ("toRightOf", OWN, LEFT),
        ("toRightOf", RIGHT, OWN),
        ("toLeftOf", OWN, RIGHT),
        ("toLeftOf", AGAINST, LEFT),
        ("opposes", AGAINST, LEFT),
        ("opposes", LEFT, AGAINST),
        ("travelsTo", OWN, AHEAD),
        *(("isIn", lane, ROAD) for lane in range(LEFT, ROAD, -1)),
    ]
    empty = np.array([""] * 8, object)
    return MapColumns(
        kind=np.array([KIND_CODE[kind] for kind in kinds], np.int8),
        name=np.array(["off_road", *"abcdef", "7"], object),
        lane_type=np.array(types, object),
        road=np.array(["", *["7"] * 7], object),
        junction=empty,
        lane=np.array([0, 3, 2, 1, 4, 2, 5, 0]),
        relation=np.array([RELATION_CODE[name] for name, *_ in edges], np.int8),
        src=np.array([src for _, src, _ in edges]),
        dst=np.array([dst for *_, dst in edges]),
    )


def scene(
    *edges, places=(), present=(OWN, LEFT, RIGHT, AGAINST, ROAD), ego_lane=OWN
) -> GraphColumns:
    """One frame: an ego, a car, a bus and a person, and edges ``(src, relation, dst)``."""
    kinds = [KIND_CODE[k] for k in ("car", "car", "bus", "person")]
    count = len(kinds) + len(present)
    ground = grounds()
    x, y, z = (np.full(count, np.nan) for _ in range(3))
    places = places or ((0, 0), (10, 3.5), (20, 0), (5, -9))
    x[:4], y[:4], z[:4] = (*zip(*places, strict=True), (0, 0, 0, 0))
    return GraphColumns.sorted(
        1,
        {
            "node_frame": np.zeros(count, np.int64),
            "node": np.array([0, 1, 2, 3, *present]),
            "kind": np.array([*kinds, *(ground.kind[-1 - n] for n in present)], np.int8),
            "is_ego": np.arange(count) == 0,
            "x": x,
            "y": y,
            "z": z,
            "heading": np.zeros(count),
        },
        frame=np.zeros(len(edges), np.int64),
        relation=np.array([RELATION_CODE[name] for _, name, _ in edges], np.int8),
        src=np.array([src for src, *_ in edges], np.int64),
        dst=np.array([dst for *_, dst in edges], np.int64),
        ego_lane=np.array([ego_lane]),
        grounds=ground,
    )


def together(scenes: list[GraphColumns]) -> GraphColumns:
    """Scenes of one frame each as the frames of one."""
    columns = {}
    for field in fields(GraphColumns):
        of = [getattr(one, field.name) for one in scenes]
        if field.name in {"node_frame", "frame"}:
            columns[field.name] = np.concatenate([i + frame for i, frame in enumerate(of)])
        elif isinstance(of[0], np.ndarray):
            columns[field.name] = np.concatenate(of)
    return GraphColumns(frames=len(scenes), grounds=scenes[0].grounds, **columns)


def any_scene(rng: random.Random) -> GraphColumns:
    """One of some thousand scenes."""
    bodies, lanes = (EGO, CAR, BUS, PERSON), (LEFT, OWN, AGAINST)
    edges = [(body, "isIn", rng.choice(lanes)) for body in bodies[: rng.randrange(4)]]
    if rng.random() < 0.5:
        edges.append((EGO, rng.choice(("near", "inSFrontOf", "sees")), rng.choice((CAR, BUS))))
    return scene(
        *rng.sample(edges, len(edges)),
        places=rng.choice((((0, 0), (30, 0), (20, 0), (0, 9)), ())),
        present=rng.choice(((OWN, ROAD), (OWN, LEFT, RIGHT, AGAINST, ROAD))),
        ego_lane=rng.choice((OWN, AGAINST, 0)),
    )


def test_frames_of_equal_contents_are_of_equal_classes() -> None:
    """And nothing else is in the contents: a frame that only has other distances is as one before."""
    rng = random.Random(6)
    scenes = [any_scene(rng) for _ in range(1500)]
    seen = together(scenes)
    named = [classes_of(abstraction_named(name).function(seen)) for name in AT_INGEST]
    contents = contents_of(seen)
    of: dict[bytes, set[tuple[str, ...]]] = {}
    for content, *names in zip(contents, *named, strict=True):
        of.setdefault(content, set()).add(tuple(names))

    assert all(len(names) == 1 for names in of.values())
    assert 100 < len(of) < 1000
    assert len(set(zip(*named, strict=True))) > len(of) / 4
    assert [contents_of(one)[0] for one in scenes[:50]] == contents[:50]
    some = np.arange(3, 1500, 7)
    assert contents_of(seen.taken(some)) == [contents[i] for i in some.tolist()]
    for name, classes in zip(AT_INGEST, named, strict=True):
        function = abstraction_named(name).function
        assert classes_of(function(seen.taken(some))) == [classes[i] for i in some.tolist()]


def lanes_of(seen: GraphColumns) -> dict[str, str]:
    """Entity → the one lane that ``EL`` puts it in."""
    _, edges = abstraction_named("EL").function(seen).named(0)
    return {a: b for a, label, b in edges if label == "isIn" and b != "Root Road"}


def test_lanes_are_called_as_the_ego_has_them() -> None:
    seen = scene(
        (EGO, "isIn", OWN), (CAR, "isIn", LEFT), (BUS, "isIn", RIGHT), (PERSON, "isIn", AGAINST)
    )

    assert lanes_of(seen) == {
        "ego": "Ego Lane",
        "car_1": "Left 1 of Ego Lane",
        "bus_2": "Right 1 of Ego Lane",
        "person_3": "Opposing Lane 0",
    }


def test_the_lane_that_follows_the_egos_is_the_egos() -> None:
    seen = scene((EGO, "isIn", OWN), (BUS, "isIn", AHEAD))

    assert lanes_of(seen)["bus_2"] == "Ego Lane"


def test_opposing_lanes_are_numbered_by_the_nearest_in_them() -> None:
    far = scene((EGO, "isIn", AGAINST), (CAR, "isIn", OWN), (BUS, "isIn", LEFT), ego_lane=AGAINST)
    near = scene(
        (EGO, "isIn", AGAINST),
        (CAR, "isIn", OWN),
        (BUS, "isIn", LEFT),
        ego_lane=AGAINST,
        places=((0, 0), (30, 0), (20, 0), (0, 9)),
    )

    assert lanes_of(far)["car_1"] == "Opposing Lane 0"
    assert lanes_of(far)["bus_2"] == "Opposing Lane 1"
    assert lanes_of(near)["car_1"] == "Opposing Lane 1"


def test_lanes_beside_the_ego_are_there_when_empty_and_others_only_when_not() -> None:
    nodes, _ = abstraction_named("EL").function(scene((EGO, "isIn", OWN))).named(0)

    lanes = {name for name in nodes if "Lane" in name}
    assert lanes == {"Ego Lane", "Left 1 of Ego Lane", "Right 1 of Ego Lane"}


def test_what_is_off_the_road_is_in_off_road_and_sidewalks_do_not_count() -> None:
    seen = scene((EGO, "isIn", OWN), (PERSON, "isIn", WALK), (PERSON, "isIn", -1))

    assert lanes_of(seen)["person_3"] == "Off Road"


def test_without_a_lane_of_the_ego_lanes_have_no_number() -> None:
    nodes, _ = abstraction_named("EL").function(scene((CAR, "isIn", OWN), ego_lane=0)).named(0)

    assert "Lane" in nodes.values()
    assert not any("Opposing" in label for label in nodes.values())


def test_relations_are_those_of_the_literature() -> None:
    seen = scene(
        (CAR, "near", EGO),
        (CAR, "inDFrontOf", EGO),
        (CAR, "leads", EGO),
        (EGO, "sees", CAR),
        (EGO, "isIn", OWN),
    )
    _, related = abstraction_named("ER").function(seen).named(0)
    _, all_of_it = abstraction_named("SG").function(seen).named(0)

    assert set(related) == {("car_1", "near", "ego"), ("car_1", "inDFrontOf", "ego")}
    assert {"leads", "sees", "isIn", "toLeftOf", "opposes"} <= {label for _, label, _ in all_of_it}


def test_an_edge_that_comes_twice_counts_once() -> None:
    once = scene((CAR, "near", EGO), (EGO, "near", CAR))
    twice = scene(*[(CAR, "near", EGO)] * 2, (EGO, "near", CAR))
    related = abstraction_named("ER").function

    assert classes_of(related(once)) == classes_of(related(twice))


def test_junction_has_the_lanes_of_the_map_and_sections_are_one() -> None:
    seen = scene(
        (EGO, "isIn", OWN), (BUS, "isIn", AHEAD), present=(OWN, LEFT, AHEAD, AGAINST, ROAD)
    )
    nodes, edges = abstraction_named("junction").function(seen).named(0)

    assert nodes["Lane 7_+2"] == "Lane"
    assert {("ego", "isIn", "Lane 7_+2"), ("bus_2", "isIn", "Lane 7_+2")} <= set(edges)
    assert ("Lane 7_+2", "travelsTo", "Lane 7_+2") not in edges
    assert ("Lane 7_+4", "opposes", "Lane 7_+3") in edges
    assert edges.count(("Lane 7_+2", "isIn", "Road 7")) == 1


def test_a_place_elsewhere_is_of_the_same_class_in_junction() -> None:
    one = scene((EGO, "isIn", OWN), (CAR, "near", EGO))
    other = scene((EGO, "isIn", OWN), (CAR, "near", EGO))
    object.__setattr__(other.grounds, "road", np.array(["", *["99"] * 7], object))
    object.__setattr__(other.grounds, "name", np.array(["off_road", *"tuvwxy", "99"], object))
    junction = abstraction_named("junction").function

    assert "Road 99" in junction(other).named(0)[0]
    assert classes_of(junction(one)) == classes_of(junction(other))


@pytest.mark.parametrize(
    ("place", "relations"),
    [
        ((4.0, 0.0), {"near_coll", "inDFrontOf"}),
        ((4.001, 0.0), {"super_near", "inDFrontOf"}),
        ((5.0, 5.0), {"very_near", "inDFrontOf", "inSFrontOf"}),
        ((0.0, 9.0), {"very_near", "inSFrontOf", "atSRearOf", "toLeftOf"}),
        ((-20.0, -6.5), {"visible", "atDRearOf", "toRightOf"}),
        ((25.1, 0.0), set()),
    ],
)
def test_roadscene2vec_has_its_own_thresholds_and_inclusive_bins(place, relations) -> None:
    seen = scene(places=((0, 0), place, (99, 0), (99, 0)))
    _, edges = roadscene2vec(seen).named(0)
    found = {label for a, label, b in edges if (a, b) == ("car_1", "ego_car")}
    back = {label for a, label, b in edges if (a, b) == ("ego_car", "car_1")}

    assert found == relations
    assert back == relations & set(PROXIMITY)


def test_roadscene2vec_has_three_lanes_of_twelve_metres() -> None:
    seen = scene(places=((0, 0), (30, 6.0), (30, 6.1), (30, -6.1)))
    _, edges = roadscene2vec(seen).named(0)
    lanes = {a: b for a, label, b in edges if label == "isIn" and b != "Root Road"}

    assert lanes == {
        "ego_car": "Middle Lane",
        "car_1": "Middle Lane",
        "car_2": "Left Lane",
        "ped_3": "Right Lane",
    }


def test_an_unknown_abstraction_is_refused_with_a_suggestion() -> None:
    with pytest.raises(AbstractionError, match="did you mean 'junction'"):
        abstraction_named("juncton")
    for name in ("RSV", "e_r", "", "a b", "1x", "x" * 65):
        with pytest.raises(AbstractionError):
            register(name, lambda seen: Labelled.assembled(seen.frames, [], [], []))


def only_people(seen: GraphColumns) -> Labelled:
    rows = np.flatnonzero(seen.kind == KIND_CODE["person"])
    nodes = (seen.node_frame[rows], seen.node[rows], np.zeros(len(rows), np.int64))
    return Labelled.assembled(seen.frames, [nodes], [], ["person"])


@pytest.fixture(scope="module")
def store(town_store):
    return sgstore.open(town_store)


@pytest.fixture
def people():
    register("only_people", only_people)
    yield "only_people"
    REGISTERED.clear()


@pytest.mark.parametrize("name", [a.name for a in ABSTRACTIONS])
def test_frames_of_a_store_have_equal_classes_exactly_if_networkx_says_isomorphic(
    store, name
) -> None:
    classes = store.classes(name)
    ids, found = classes["frame_id"], classes["class"]
    numbers = np.random.default_rng(3).integers(0, len(ids) - 5, 8)[: None if LONG else 4]
    pairs = [(i, i + step) for i in numbers.tolist() for step in (1, 4)]
    with store.file.snapshot():
        graphs = {i: store.graph(int(ids[i]), abstraction=name) for pair in pairs for i in pair}

    def same_node(a, b):
        return a["base_class"] == b["base_class"]

    def same_edges(a, b):
        return Counter(e["label"] for e in a.values()) == Counter(e["label"] for e in b.values())

    wanted = [
        MultiDiGraphMatcher(graphs[a], graphs[b], same_node, same_edges).is_isomorphic()
        for a, b in pairs
    ]
    assert "" not in set(found)
    assert [found[a] == found[b] for a, b in pairs] == wanted


def test_classes_made_at_ingest_are_those_made_of_what_is_stored(store) -> None:
    for name in AT_INGEST:
        kept = store.classes(name)
        made = [
            cls
            for _, seen in windows(store)
            for cls in classes_of(abstraction_named(name).function(seen))
        ]
        assert kept["class"].tolist() == made


def windows(store):
    from sgstore.store._graphs import Graphs

    (trace,) = store.info()
    with store.file.access.reading() as connection:
        yield from Graphs().of_trace(connection, trace.trace_id)


def test_later_classes_are_computed_once_and_then_kept_and_verified(store, people) -> None:
    before = store.sql("SELECT count(*) FROM classes WHERE abstraction = 'only_people'").values
    first = store.file.abstracted.complete(people)
    again = store.file.abstracted.complete(people)
    (rows,) = store.sql("SELECT count(*) FROM classes WHERE abstraction = 'only_people'").values

    assert (before, first, again) == ([(0,)], 1, 0)
    assert rows == (store.info()[0].frames,)
    assert not store.file.verify().faults
    graph = store.graph("town#100", abstraction=people)
    assert isinstance(graph, nx.MultiDiGraph)
    assert set(nx.get_node_attributes(graph, "base_class").values()) == {"person"}


def test_a_graph_of_an_abstraction_has_the_names_and_labels_of_the_literature(store) -> None:
    graph = store.graph("town#100", abstraction="RSV")

    assert graph.nodes["ego"] == {"name": "ego", "base_class": "ego"}
    assert graph.has_edge("ego", "Ego Lane", key="isIn")
    assert graph.has_edge("Ego Lane", "Root Road", key="isIn")
    assert {d["label"] for *_, d in graph.edges(data=True)} <= BETWEEN | {"isIn"}
    assert graph.graph["abstraction"] == "RSV"
    assert graph.graph["seq"] == 100
    with pytest.raises(AbstractionError, match="there are: E, EL"):
        store.graph("town#100", abstraction="zzz")


@pytest.mark.parametrize(
    ("name", "known"),
    [("ELR", "RSV"), ("elr", "RSV"), ("S3C", "RSV"), ("rs2v", "roadscene2vec"), ("RVS", "RSV")],
)
def test_name_of_a_paper_leads_to_the_abstraction(name: str, known: str) -> None:
    with pytest.raises(AbstractionError, match=f"did you mean '{known}'"):
        abstraction_named(name)
