"""Which nodes of several traces are the same: an entity is a trace and a number, a lane a map and a number."""

from __future__ import annotations

import json
import re
from collections import Counter
from itertools import product
from typing import TYPE_CHECKING, Any

import pytest
from oracle_worlds import World, random_world

import sgstore
from sgstore.apps.cli import run
from sgstore.apps.sandbox import Sandbox
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(7)

KINDS = ("Entity", "Car", "Lane", "%", "Ego", "OffRoad", "Vehicle&!Ego", "Signal")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("identity") / "four.sgstore"


@pytest.fixture(scope="module")
def world(path: Path) -> World:
    """Four traces, three of which share a map; ids of nodes are the same in all of them."""
    StoreFile.create(path)
    world = random_world(5, traces=4, frames=8, maps=2, path=path)
    world.connection.close()
    return world


@pytest.fixture(scope="module")
def store(world: World, path: Path) -> Iterator[Store]:
    assert len({trace.map_id for trace in world.traces}) == 2
    store = sgstore.open(path)
    with store.file.snapshot():
        yield store


def matched(store: Store, label: str) -> list[tuple[str, str, int]]:
    """Trace, map and id of each match, told by values that no rule about entities concerns."""
    return store.find(f"MATCH (v:{label}) RETURN trace.name, trace.map, v.id").rows()


def entity(trace: str, road_map: str, node: int) -> tuple[str, int]:
    return (trace, node) if node >= 0 else (f"map {road_map}", node)


@pytest.mark.parametrize("label", KINDS)
def test_nodes_are_counted_per_trace(label: str, store: Store) -> None:
    entities = [entity(*row) for row in matched(store, label)]

    assert store.find(f"MATCH (v:{label}) RETURN COUNT(DISTINCT v), COUNT(v)").rows() == [
        (len(set(entities)), len(entities))
    ]


@pytest.mark.parametrize("label", KINDS)
def test_nodes_are_grouped_per_trace(label: str, store: Store) -> None:
    wanted = Counter(entity(*row) for row in matched(store, label))

    rows = store.find(f"MATCH (v:{label}) RETURN v, COUNT(*)").rows()
    of_frames = store.find(
        f"MATCH (v:{label}) RETURN v, COUNT(frame.seq) AS n, MAX(frame.seq)"
    ).rows()

    assert Counter(rows) == Counter((node, many) for (_, node), many in wanted.items())
    assert Counter(row[:2] for row in of_frames) == Counter(rows)


@pytest.mark.parametrize("label", KINDS)
def test_nodes_of_several_traces_are_distinct(label: str, store: Store) -> None:
    entities = {entity(*row) for row in matched(store, label)}
    wanted = sorted(node for _, node in entities)

    matches = store.find(f"MATCH (v:{label}) RETURN DISTINCT v ORDER BY v")

    assert [row[0] for row in matches.rows()] == wanted
    assert matches.numpy()["v"].tolist() == wanted
    assert len(store.find(f"MATCH (v:{label}) RETURN DISTINCT v, v.kind LIMIT 7").rows()) == min(
        7, len(entities)
    )


def test_two_variables_are_distinguished_by_trace(store: Store) -> None:
    rows = store.find(
        "MATCH (a:Car)-[:isIn]->(l:Lane) RETURN trace.name, trace.map, a.id, l.id"
    ).rows()
    pairs = Counter((entity(t, m, a), entity(t, m, lane)) for t, m, a, lane in rows)

    found = store.find("MATCH (a:Car)-[:isIn]->(l:Lane) RETURN a, l, COUNT(*)").rows()

    wanted = Counter((a, lane, many) for ((_, a), (_, lane)), many in pairs.items())
    assert Counter(found) == wanted
    assert len(store.find("MATCH (a:Car)-[:isIn]->(l:Lane) RETURN DISTINCT a, l").rows()) == len(
        pairs
    )


def test_sample_per_entity(store: Store) -> None:
    entities = {entity(*row) for row in matched(store, "%")}
    present = store.find("MATCH (v) RETURN v, INTERVALS SAMPLE 1 PER v").rows()

    assert len(store.find("MATCH (v) RETURN v.id, v.kind SAMPLE 1 PER v").rows()) == len(entities)
    assert len(store.find("MATCH (v) RETURN v AS who, frame.seq SAMPLE 1 PER who").rows()) == len(
        entities
    )
    assert Counter(row[-1] for row in present) == Counter(node for _, node in entities)


def test_sequences_distinguish_entities(store: Store) -> None:
    text = f"{MOVES} {WEST}"
    rows = store.find(text.format("trace.name, v.id")).rows()

    counted = store.find(text.format("COUNT(DISTINCT v), COUNT(*)")).rows()
    grouped = store.find(text.format("v, COUNT(*)")).rows()

    assert len({trace for trace, _ in rows}) > 1
    assert counted == [(len(set(rows)), len(rows))]
    assert Counter(grouped) == Counter((v, many) for (_, v), many in Counter(rows).items())
    assert len(store.find(text.format("DISTINCT v")).rows()) == len(set(rows))


def test_returned_trace_distinguishes_nodes(store: Store) -> None:
    for told in ("trace.name", "trace.id", "frame.id"):
        rows = store.find(f"MATCH (v:Car) RETURN {told} AS t, v.id").rows()
        found = store.find(f"MATCH (v:Car) RETURN {told} AS t, v, COUNT(*)").rows()
        assert Counter({row[:2]: row[2] for row in found}) == Counter(rows)


def test_cli_and_sandbox_counts_equal_python(
    store: Store, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "MATCH (v) RETURN COUNT(DISTINCT v) AS many"
    ((many,),) = store.find(text).rows()

    assert run(["find", str(path), text, "--format", "ndjson"]) == 0
    with Sandbox(path) as sandbox:
        safe: Any = sandbox.find(text)

    assert json.loads(capsys.readouterr().out)["many"] == many
    assert [tuple(row) for row in safe.rows] == [(many,)]


# Samples and their order


def test_sample_is_first_in_order(store: Store) -> None:
    rows = store.find("MATCH (v:Vehicle) RETURN trace.name, v.x AS x ORDER BY x DESC").rows()
    for direction, end in (("DESC", 1), ("", -1)):
        found = store.find(
            f"MATCH (v:Vehicle) RETURN trace.name, v.x AS x ORDER BY x {direction} SAMPLE 3 PER trace.name"
        ).rows()
        for trace in {row[0] for row in rows}:
            wanted = [x for name, x in rows if name == trace][::end][:3]
            assert [x for name, x in found if name == trace] == wanted


def test_interval_sample_is_first_in_order(store: Store) -> None:
    text = "MATCH (v:Vehicle) RETURN v, INTERVALS ORDER BY frames DESC"
    whole = store.find(text).rows()
    found = store.find(f"{text} SAMPLE 2 PER trace").rows()

    for trace in {row[0] for row in whole}:
        wanted = [row[7] for row in whole if row[0] == trace][:2]
        assert [row[7] for row in found if row[0] == trace] == wanted


def test_sample_without_order_is_repeatable(store: Store) -> None:
    text = "MATCH (v:Vehicle) RETURN frame.id AS id, v SAMPLE 2 PER trace.name"
    whole = store.find("MATCH (v:Vehicle) RETURN frame.id AS id, v").rows()

    rows = store.find(text).rows()

    assert rows == store.find(text).rows()
    assert len(rows) == 8
    assert set(rows) <= set(whole)
    assert rows != [row for trace in range(1, 5) for row in whole if row[0] >> 24 == trace][:8]


# The ego, wherever it is named

PLACES = {
    "MATCH": "MATCH (v:Car), (ego)",
    "label": "MATCH (v:Car), (ego:Car)",
    "WHERE": "MATCH (v:Car) WHERE ego.speed IS NULL OR NOT ego.speed IS NULL",
    "inline": "MATCH (v:Car WHERE known(ego))",
    "block": "MATCH (v:Car) WHERE COUNT {(ego)-[:near]->(v)} >= 0",
    "block of a block": "MATCH (v:Car) WHERE NOT EXISTS {(x) WHERE EXISTS {(y) WHERE y.x > ego.x AND v.x = 0}}",
    "RETURN": "MATCH (v:Car) RETURN ego, {}",
    "value": "MATCH (v:Car) RETURN ego.speed, {}",
    "pair": "MATCH (v:Car) RETURN dist(ego, v), {}",
    "counted block": "MATCH (v:Car) RETURN COUNT {{(ego)-[:near]->(v)}} AS n, {}",
    "over time": "MATCH (v:Car) RETURN prev(ego.speed), {}",
    "operator": "MATCH (v:Car) WHERE EVENTUALLY (ego.x > 0 OR TRUE)",
    "ORDER BY": "MATCH (v:Car) RETURN {} ORDER BY ego.speed",
    "SAMPLE": "MATCH (v:Car) RETURN {} SAMPLE 9999 PER ego.id",
    "step": "MATCH (v:Car) FOR >= 0s RETURN ego.speed, {}",
    "grouped": "MATCH (v:Car) RETURN {}, MAX(ego.speed)",
    "DISTINCT": "MATCH (v:Car) RETURN DISTINCT {}, ego.x",
    "predicate": "DEFINE PREDICATE far(x) AS dist(ego, x) > 0 OR TRUE; MATCH (v:Car) WHERE far(v)",
}


@pytest.mark.parametrize("place", PLACES)
def test_other_nodes_are_not_the_named_ego(place: str, store: Store) -> None:
    told = "frame.id AS f, v.id AS who"
    text = PLACES[place]
    text = text.format(told) if "{}" in text else f"{text} RETURN {told}"
    plain = f"MATCH (v:Car), (e:Ego) RETURN {told}"
    wanted = sorted(set(store.find(plain).rows()))
    if place.startswith("block of"):
        wanted = sorted(
            set(
                store.find(
                    text.replace("ego.x", "e.x").replace("MATCH (v", "MATCH (e:Ego), (v")
                ).rows()
            )
        )

    matches = store.find(text)
    at = [matches.columns.index(name) for name in ("f", "who")]

    assert sorted({tuple(row[i] for i in at) for row in matches.rows()}) == wanted
    assert store.find("MATCH (v:Car) RETURN frame.id AS f, v.id AS who").rows() != wanted


def test_labelled_ego_is_the_named_ego(store: Store) -> None:
    rows = store.find("MATCH (e:Ego) RETURN frame.id, e.id, ego.id, ego.speed, e.speed").rows()

    assert len(rows) == store.find("MATCH (e:Ego)").count()
    assert all(row[1] == row[2] and row[3] == row[4] for row in rows)


LISTED = {
    "labelled, without a name": "(:Ego)-[:near|visible]->()",
    "labelled, at the other end": "()-[:near]->(:Ego)",
    "labelled, between two": "()-[:near]->(:Ego)<-[:near]-()",
    "labelled, beside others": "(:Car), (:Ego), (:Lane)",
    "with a name": "(e:Ego)-[:near|visible]->()",
    "with its own name": "(ego)-[:near|visible]->()",
    "by two labels": "(:Vehicle&Ego)-[:near]-(:Entity)",
    "alone": "(:Ego)",
    "not in the pattern": "(:Car)",
    "not in the pattern, two others": "()-[:near]->(:Entity)",
    "not in the pattern, named ones": "(a:Car), (b:Lane)",
}


NONE = [(0, 0, None)]
"""What is counted, and the greatest, where nothing matches."""


def listed(pattern: str, world: World, hero: str) -> list[tuple[int, str, int, dict[str, Any]]]:
    """Frame, trace, ego and the values of the ego of every match; every node of a frame is tried for each."""
    rows: list[tuple[int, str, int, dict[str, Any]]] = []
    nodes = re.findall(r"\((\w*)(:[^)]*)?\)", pattern)
    edges = re.findall(r"\)(<?)-\[:([^\]]*)\]-(>?)\(", pattern)
    asked = {relation for _, names, _ in edges for relation in names.split("|")}
    for frame in world.frames:
        if frame.ego is None or hero not in {"", frame.trace.hero}:
            continue
        if not asked <= set(frame.trace.answers):
            continue
        graph = frame.graph
        choices = [[n for n in graph if is_a(label, graph.nodes[n])] for _, label in nodes]
        choices = [
            [frame.ego] if name == "ego" else c for (name, _), c in zip(nodes, choices, strict=True)
        ]
        if not any(name == "ego" or "Ego" in label for name, label in nodes):
            choices.append([frame.ego])
        for found in product(*choices):
            if len({*found}) < len(found):
                continue
            ways = [
                any(
                    relation in graph.get_edge_data(*way, default={})
                    for relation in names.split("|")
                    for way in ([(a, b)] * (not left) + [(b, a)] * (not right))
                )
                for (left, names, right), a, b in zip(edges, found, found[1:], strict=False)
            ]
            if all(ways):
                values = graph.nodes[frame.ego]
                rows.append((frame.frame_id, frame.trace.name, frame.ego, values))
    return rows


def is_a(label: str, node: dict[str, Any]) -> bool:
    """Whether a node has all the labels of a pattern."""
    vehicle = node["kind"] in {"car", "truck", "van", "bus", "motorcycle", "bicycle", "trailer"}
    moving = node["kind"] not in {"lane", "road", "junction", "crosswalk", "off_road"}
    having = {"Ego": node["is_ego"], "Vehicle": vehicle, "Entity": moving}
    names = label.lstrip(":").split("&") if label else []
    return all(having.get(name, node["kind"] == name.lower()) for name in names)


@pytest.mark.parametrize(
    ("place", "hero"),
    [(place, "") for place in LISTED]
    + [(place, "hero2") for place in ("labelled, at the other end", "alone", "not in the pattern")],
)
def test_ego_values_are_equal_in_every_match(
    place: str, hero: str, store: Store, world: World
) -> None:
    match = f"USING EGO '{hero}' MATCH {LISTED[place]}" if hero else f"MATCH {LISTED[place]}"
    wanted = listed(LISTED[place], world, hero)
    high = [row for row in wanted if row[3]["x"] > 105]

    def asked(text: str) -> list[Any]:
        return store.find(f"{match} {text}").rows()

    def near(found: list[Any], rows: list[Any]) -> None:
        assert len(found) == len(rows)
        assert all(a == pytest.approx(b) for a, b in zip(found, rows, strict=True))

    def groups(*at: int) -> list[tuple[Any, ...]]:
        """Traces and egos, how many matches they have, of how many the speed is known, and the greatest x."""
        found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
        for row in wanted:
            found.setdefault(tuple(row[i] for i in at), []).append(row[3])
        return sorted(
            (*key, len(v), sum(known(one) for one in v), max(one["x"] for one in v))
            for key, v in found.items()
        )

    def known(values: dict[str, Any]) -> bool:
        return values.get("speed") is not None

    assert wanted or hero
    told = sorted((frame, ego, values["x"]) for frame, _, ego, values in wanted)
    near(sorted(asked("RETURN frame.id, ego.id, ego.x")), told)
    near(sorted(asked("RETURN DISTINCT frame.id, ego.id, ego.x")), sorted({*told}))
    by_x = sorted((x for _, _, x in told), reverse=True)
    near([x for (x,) in asked("RETURN ego.x ORDER BY ego.x DESC")], by_x)
    near(
        sorted(asked("WHERE ego.x > 105 RETURN frame.id, ego.x")),
        sorted((frame, values["x"]) for frame, _, _, values in high),
    )
    assert asked("WHERE ego.x > 105 RETURN COUNT(*)") == [(len(high),)]
    near(asked("RETURN COUNT(*), COUNT(ego.speed), MAX(ego.x)"), groups() if wanted else NONE)
    near(sorted(asked("RETURN trace.name, COUNT(*), COUNT(ego.speed), MAX(ego.x)")), groups(1))
    near(
        sorted(asked("RETURN trace.name, ego.id, COUNT(ego), COUNT(ego.speed), MAX(ego.x)")),
        groups(1, 2),
    )
    egos = len({(trace, ego) for _, trace, ego, _ in wanted})
    assert asked("RETURN COUNT(DISTINCT ego)") == [(egos,)]


MOVES, WEST = "MATCH (v:Vehicle) WHERE v.speed > 0", "THEN MATCH (v) WHERE v.x < 110 RETURN {}"


@pytest.mark.parametrize(
    "text",
    [
        f"{MOVES} {WEST}, ego.speed",
        f"{MOVES} {WEST}, ego",
        f"{MOVES} AND ego.x > 0 {WEST}",
        f"{MOVES} {WEST}, dist(ego, v), prev(ego.x)",
        f"{MOVES} THEN NOT MATCH (v)-[:near]->(ego) {WEST}",
    ],
)
def test_other_nodes_in_sequences_are_not_the_ego(text: str, store: Store) -> None:
    told = "trace.name AS t, v.id AS who"
    whole = store.find(f"{text.partition(' THEN')[0]} RETURN DISTINCT {told}").rows()
    matches = store.find(text.format(told))
    at = [matches.columns.index(name) for name in ("t", "who")]

    rows = {tuple(row[i] for i in at) for row in matches.rows()}

    egos = set(store.find("MATCH (e:Ego) RETURN trace.name, e.id").rows())
    assert rows
    assert not rows & egos
    assert rows <= set(whole)


def test_returned_ego_costs_no_more_than_matched_ego(store: Store) -> None:
    for pattern in ("(a)", "(a)-[:near]->(b)", "(a), (b:Lane)"):
        one = store.find(f"MATCH {pattern}, (e:Ego) RETURN frame.id, a.id, e.x").rows()
        other = store.find(f"MATCH {pattern} RETURN frame.id, a.id, ego.x").rows()
        assert one == other


# Names behind AS


def test_alias_hides_variable(store: Store) -> None:
    speeds = [s for (s,) in store.find("MATCH (w:Car) RETURN w.speed").rows() if s is not None]

    def ordered(order: str) -> list[float]:
        rows = store.find(f"MATCH (v:Car) RETURN v.speed AS v ORDER BY {order}").rows()
        return [row[0] for row in rows][: len(speeds)]

    assert ordered("v") == sorted(speeds)
    assert ordered("v DESC") == sorted(speeds, reverse=True)
    assert ordered("0 - v") == sorted(speeds, reverse=True)
    assert ordered("v SAMPLE 1 PER v") != ordered("v")
    assert ordered("abs(v - 5), v") == sorted(speeds, key=lambda s: (abs(s - 5), s))


def test_alias_hides_variable_in_samples_and_intervals(store: Store) -> None:
    kinds = {kind for (kind,) in store.find("MATCH (v:Vehicle) RETURN DISTINCT v.kind").rows()}

    rows = store.find("MATCH (v:Vehicle) RETURN v.kind AS v, frame.id AS f SAMPLE 1 PER v").rows()
    spans = store.find("MATCH (v:Car) RETURN v.name AS v, INTERVALS ORDER BY v DESC").rows()

    assert sorted(kind for kind, _ in rows) == sorted(kinds)
    assert [row[-1] for row in spans] == sorted((row[-1] for row in spans), reverse=True)


# Backslashes in texts


@pytest.mark.parametrize(
    ("written", "means"),
    [
        (r"'car \d+'", r"car \d+"),
        (r"'\w+ \d'", r"\w+ \d"),
        (r"'car\s[0-9]'", r"car\s[0-9]"),
        (r"'car \\d+'", r"car \d+"),
        (r"'car \S+'", r"car \S+"),
        (r"'\bcar\b.*'", r"\bcar\b.*"),
        (r"'(car|truck)\x20\d'", r"(car|truck)\x20\d"),
    ],
)
def test_regular_expression_keeps_backslashes(written: str, means: str, store: Store) -> None:
    names = [name for (name,) in store.find("MATCH (v) RETURN DISTINCT v.name AS name").rows()]

    rows = store.find(f"MATCH (v) WHERE v.name =~ {written} RETURN DISTINCT v.name AS name").rows()

    wanted = [name for name in names if re.fullmatch(means, name)]
    assert rows == [(name,) for name in wanted]
    assert wanted


@pytest.mark.parametrize(
    ("written", "means"),
    [
        (r"'it\'s'", "it's"),
        (r'"a \"b\""', 'a "b"'),
        (r"'C:\\new'", r"C:\new"),
        (r"'a\tb\nc\rd'", "a\tb\nc\rd"),
        (r"'50\%'", r"50\%"),
    ],
)
def test_backslash_in_text(written: str, means: str, store: Store) -> None:
    (row,) = store.find(f"MATCH (e:Ego) RETURN {written} AS text LIMIT 1").rows()

    assert row == (means,)
