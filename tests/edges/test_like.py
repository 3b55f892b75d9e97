"""Frames like another, against brute force in networkx; and patterns that a frame gives as its example."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Any

import networkx as nx
import pytest
from thorough import some
from typer.testing import CliRunner

from sgstore.apps.cli import app
from sgstore.errors import AbstractionError, QueryError, StoreError

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(15)

ALL = 1_000_000


@pytest.fixture(scope="module")
def path(town_store: Path) -> Path:
    return town_store


@pytest.fixture(scope="module")
def store(open_town: Store) -> Store:
    return open_town


@pytest.fixture(scope="module")
def every(store: Store) -> list[Any]:
    """All runs, compared with one example."""
    return store.like("town#300", limit=ALL)


def features(graph: nx.MultiDiGraph[Any], *ignored: str) -> Counter[str]:
    """Nodes and edges by label, counted one by one."""
    label = dict(graph.nodes(data="base_class"))
    left = {n for n, of in label.items() if of not in ignored}
    counts = Counter(label[node] for node in left)
    for src, dst, of in graph.edges(data="label"):
        if {src, dst} <= left and of not in ignored:
            counts[f"({label[src]})-[{of}]->({label[dst]})"] += 1
    return counts


def jaccard(a: Counter[str], b: Counter[str]) -> float:
    return (a & b).total() / (a | b).total()


def isomorphic(a: nx.MultiDiGraph[Any], b: nx.MultiDiGraph[Any]) -> bool:
    def same_edges(one: dict[Any, Any], other: dict[Any, Any]) -> bool:
        return Counter(e["label"] for e in one.values()) == Counter(
            e["label"] for e in other.values()
        )

    nodes = nx.isomorphism.categorical_node_match("base_class", None)
    return nx.is_isomorphic(a, b, node_match=nodes, edge_match=same_edges)


@pytest.mark.parametrize("abstraction", ["RSV", "EL", "roadscene2vec"])
def test_every_frame_is_as_like_as_brute_force_says(abstraction: str, store: Store) -> None:
    example = store.graph("town#210", abstraction)
    ours = {}
    for run in store.like("town#210", abstraction=abstraction, limit=ALL):
        for seq in range(run.frame.seq, run.frame.seq + run.frames):
            assert seq not in ours
            ours[seq] = run

    assert sorted(ours) == list(range(750))
    for seq in [*range(0, 750, 120), *range(204, 217, 4)]:
        graph = store.graph(f"town#{seq}", abstraction)
        one, other = features(example), features(graph)
        run = ours[seq]
        assert run.similarity == pytest.approx(jaccard(one, other)), seq
        assert run.shared == dict(one & other)
        assert run.missing == dict(one - other)
        assert run.extra == dict(other - one)
        assert run.same is isomorphic(example, graph)


def test_what_is_ignored_does_not_count(store: Store) -> None:
    ignored = ("car", "toLeftOf", "toRightOf")
    example = features(store.graph("town#210", "ER"), *ignored)

    runs = store.like(
        "town#210", abstraction="ER", ignore=("Car", "to_left_of", "toRightOf"), limit=ALL
    )

    for run in runs[::60]:
        other = features(store.graph(run.frame, "ER"), *ignored)
        assert run.similarity == pytest.approx(jaccard(example, other))
        assert not any("car" in text or "toLeft" in text for text in [*run.shared, *run.extra])


def test_lane_stands_for_every_label_that_speaks_of_one(store: Store) -> None:
    with_lanes = store.like("town#210", abstraction="EL", limit=1)[0]
    without = store.like("town#210", abstraction="EL", ignore=["lane"], limit=1)[0]

    assert any("Ego Lane" in text for text in with_lanes.shared)
    assert not any("Lane" in text for text in without.shared)
    assert without.shared["ego"] == 1


def test_the_best_come_first_and_then_the_order_of_the_store(
    store: Store, every: list[Any]
) -> None:
    few = store.like("town#300", limit=7)

    keys = [(-run.similarity, run.same is not True, run.frame.seq) for run in every]
    assert keys == sorted(keys)
    assert few == every[:7]
    assert (every[0].similarity, every[0].same) == (1, True)
    assert every[0].frame.seq <= 300 < every[0].frame.seq + every[0].frames


def test_frames_of_the_same_class_are_told_from_those_with_equal_counts(store: Store) -> None:
    classes = store.classes("E")
    number = dict(zip(classes["frame_id"].tolist(), classes["class"].tolist(), strict=True))
    example = max(number, key=lambda frame: list(number.values()).count(number[frame]))

    same = {
        run.frame.frame_id + i
        for run in store.like(example, abstraction="E", limit=ALL)
        if run.same
        for i in range(run.frames)
    }

    assert len(same) == sum(of == number[example] for of in number.values()) > 3


@pytest.mark.parametrize(
    ("arguments", "error", "reason"),
    [
        ({"frame": "town#9999"}, StoreError, "9999"),
        ({"frame": "town#1", "abstraction": "RSVP"}, AbstractionError, "did you mean 'RSV'"),
        ({"frame": "town#1", "ignore": ["neer"]}, AbstractionError, "did you mean 'near'"),
    ],
)
def test_what_is_not_there_is_told(arguments, error, reason, store: Store) -> None:
    with pytest.raises(error, match=reason):
        store.like(arguments.pop("frame"), **arguments)


# Patterns by example


@pytest.mark.parametrize("seq", some(range(0, 750, 83), 2))
def test_the_pattern_of_a_frame_matches_it(seq: int, store: Store) -> None:
    text = store.pattern(f"town#{seq}")
    found = {frame.seq for frame in store.find(text).frames()}

    assert seq in found
    assert len(found) < 200
    assert not store.why_not(f"town#{seq}", text).failed


def test_the_pattern_counts_what_is_there_more_than_once(store: Store) -> None:
    texts = [
        store.pattern(f"town#{seq}", ignore=["toLeftOf", "toRightOf", "lane"])
        for seq in range(0, 750, 50)
    ]

    assert any("COUNT {" in text for text in texts)
    for number, text in enumerate(texts):
        assert "toLeftOf" not in text
        assert "Lane" not in text
        assert number * 50 in {frame.seq for frame in store.find(text).frames()}


def test_less_is_asked_of_more_frames(store: Store) -> None:
    whole = {f.seq for f in store.find(store.pattern("town#300")).frames()}
    less = {
        f.seq
        for f in store.find(
            store.pattern("town#300", ignore=["car", "person", "traffic_light", "bicycle"])
        ).frames()
    }

    assert whole < less


def test_a_pattern_without_what_nothing_is_called_is_refused(store: Store) -> None:
    with pytest.raises(QueryError, match="unknown kind or relation 'buss' to ignore"):
        store.pattern("town#3", ignore=["buss"])


def test_of_each_trace_its_best_run_that_is_not_beside_the_example(
    store: Store, every: list[Any]
) -> None:
    (alone,) = store.like("town#300", each_trace=True)
    (at,) = store.sql("SELECT t FROM frames WHERE seq = 300").values[0]
    far = {seq for seq, t in store.sql("SELECT seq, t FROM frames").values if abs(t - at) >= 5}
    best = next(run for run in every if run.frame.seq in far)

    assert {*range(alone.frame.seq, alone.frame.seq + alone.frames)} <= far
    assert alone.similarity == best.similarity
    assert alone.frame.seq == best.frame.seq
    assert store.like("town#300", each_trace=True, limit=0) == []


# The command line


def test_the_command_line_gives_runs_and_what_differs(path: Path) -> None:
    arguments = ["like", str(path), "town#300", "--limit", "3", "--all"]

    table = CliRunner().invoke(app, arguments).stdout
    rows = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)

    assert [row["similarity"] for row in rows] == sorted(
        (r["similarity"] for r in rows), reverse=True
    )
    assert rows[0]["same"] is True
    (alone,) = json.loads(CliRunner().invoke(app, [*arguments[:3], "--json"]).stdout)
    assert alone["similarity"] < rows[2]["similarity"]
    assert rows[1]["missing"] != rows[1]["extra"]
    assert table.splitlines()[0].split() == [
        "frame", "t", "frames", "similarity", "same", "missing", "extra",
    ]  # fmt: skip


def test_the_command_line_prints_a_pattern_that_find_takes(path: Path) -> None:
    text = CliRunner().invoke(app, ["like", str(path), "town#300", "--describe"]).stdout
    found = CliRunner().invoke(app, ["find", str(path), text, "--count"])

    assert text.startswith("MATCH (ego:Car&Ego)")
    assert int(found.stdout) >= 1
