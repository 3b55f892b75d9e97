"""Lanes that a map has in several parts: chains of lanes, and the answers of the library on such maps."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np
import pytest
from library_scenes import BROAD, ENTRY, EXIT, LIMITED, SCENES, TOWN, TWO_WAY, WAYS, on
from scenes import Scene, store_of, street
from thorough import LONG

from sgstore.lang.library import patterns
from sgstore.lang.memory import FrameView
from sgstore.model.graph import MOST_PARTS, lane_chains
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(20)

CUTS = (20.0, 45.0, 70.0)
"""x at which both lanes go on as other parts of the map."""
STREETS: dict[int, tuple[tuple[str, ...], dict[str, Any]]] = {
    id(WAYS): (("driving", "driving"), {}),
    id(TWO_WAY): (("driving",), {"left": ("driving",)}),
    id(ENTRY): (("driving", "driving", "entry"), {}),
    id(EXIT): (("driving", "driving", "exit"), {}),
    id(TOWN): (
        ("driving", "parking", "sidewalk"),
        {"left": ("driving", "sidewalk"), "zebra": 60.0},
    ),
    id(LIMITED): (("driving", "driving"), {"limit": 13.9}),
    id(BROAD): (("driving",) * 3, {}),
}
"""Arguments of the streets of the scenes, by the identity of their road."""
OF_PARTS = {"lane_change_without_indicator", "EnterActorFlowV2", "HighwayExit"}
"""Patterns that bind a part of the map over several steps. Their answers depend on the parts."""
CHANGED = ("cut_in", "cut_out", "CutIn", "iso_cut_in", "iso_lead_brakes", "r157_cut_in")
"""Patterns with other answers on roads in parts, before lanes had chains."""
OTHERS = ("oncoming_in_lane", "ConstructionObstacle", "InvadingTurn", "MergerIntoSlowTrafficV2")
NAMES = [
    name
    for name, (one, _) in SCENES.items()
    if one is not None and id(one.road) in STREETS and name not in OF_PARTS
    if LONG or name in {*CHANGED, *OTHERS}
]


def cuts_of(name: str) -> tuple[float | None, ...]:
    return (None, *(CUTS if name in CHANGED else CUTS[1:2]))


# Chains of a map --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_chains_are_the_connected_parts_of_single_links(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends = rng.integers(-40, -1, (30, 2)).tolist()
    links = [(a, b, bool(rng.random() < 0.9)) for a, b in dict.fromkeys(map(tuple, ends)) if a != b]
    leaving, coming = (Counter(one[end] for one in links) for end in (0, 1))
    graph = nx.Graph((a, b) for a, b, inside in links if inside and leaving[a] == coming[b] == 1)

    expected = {lane: max(of) for of in nx.connected_components(graph) for lane in of}

    assert lane_chains(links) == expected


def test_a_ring_is_one_chain_and_a_long_chain_has_several_numbers() -> None:
    ring = [(-2, -3, True), (-3, -4, True), (-4, -2, True)]
    long = [(-lane, -lane - 1, True) for lane in range(2, 2 * MOST_PARTS + 2)]

    assert lane_chains(ring) == dict.fromkeys((-2, -3, -4), -2)
    assert [*Counter(lane_chains(long).values()).values()] == [MOST_PARTS, MOST_PARTS, 1]


# The same scenes on a road in parts -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    traces: dict[str, list[Scene]] = {}
    for name in NAMES:
        for number, scene in enumerate(SCENES[name][: 2 if name in CHANGED else 1]):
            for cut in cuts_of(name) if scene is not None else ():
                lanes, other = STREETS[id(scene.road)]
                traces[f"{name} {number} {cut}"] = [on(scene, street(*lanes, **other, cut=cut))]
    store = store_of(tmp_path_factory.mktemp("chains") / "s.sgstore", traces)
    with store.file.snapshot():
        yield store


@pytest.mark.parametrize("name", NAMES)
def test_parts_of_the_map_do_not_change_an_answer(store: Store, name: str) -> None:
    one = patterns()[name]
    found: dict[str, list[object]] = {trace.name: [] for trace in store.traces()}
    if one.kind == "property":
        for verdict in store.check(one.text):
            found[verdict.trace] = [verdict.verdict]
    else:
        for match in store.find(one.text).intervals(bound=True):
            found[match.trace].append((match.start_seq, match.end_seq))
    whole = {trace: answer for trace, answer in found.items() if trace.endswith(f"{name} 0 None")}

    assert any(whole.values())
    for number in range(2):
        answers = [
            sorted(found.get(f"{name} {number} {cut}", ()), key=str) for cut in cuts_of(name)
        ]
        assert answers == [answers[0]] * len(answers)


@pytest.mark.parametrize("name", [name for name in NAMES if name in CHANGED])
def test_a_monitor_finds_the_scene_on_a_road_in_parts(store: Store, name: str) -> None:
    told: list[str] = []
    trace = f"{name} 0 {CUTS[1]}"
    ids = store.file.arrays("SELECT frame_id FROM frames WHERE trace = ? ORDER BY 1", [trace])
    monitor = Monitor(
        patterns()[name].text,
        street("driving", "driving", cut=CUTS[1]),
        trace=trace,
        on_event=lambda event: told.append(event.kind),
    )
    for graph in store.file.graphs(ids["frame_id"].astype("int64")):
        monitor.look([graph])
    monitor.finish()

    assert {"violated", "found"} & {*told}


def test_the_number_of_a_chain_is_the_same_in_both_evaluators(store: Store) -> None:
    query = (
        "MATCH (:Ego)-[:isIn]->(l:Lane) RETURN frame.id AS frame, l.id AS lane, l.chain AS chain"
    )
    rows = store.find(f"USING DATASET '{NAMES[0]} 0 {CUTS[1]}' {query}")
    told = {(int(row.frame), int(row.lane)): row.chain for row in rows}
    frames = np.array(sorted({frame for frame, _ in told}))
    views = {int(graph.frame_id): FrameView(graph) for graph in store.file.graphs(frames)}

    assert {type(chain) for chain in told.values()} == {int}
    assert any(lane != chain for (_, lane), chain in told.items())
    assert told == {at: views[at[0]].chain_of(at[1]) for at in told}
