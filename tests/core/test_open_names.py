"""Kinds, relations and states of lights that no vocabulary has, and attributes of a client's own."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections import Counter
from typing import TYPE_CHECKING, Any

import networkx as nx
import pytest
from graph_blocks import add_labels

import sgstore
from sgstore.errors import ConfigError, QueryError, QueryNameError, StoreError
from sgstore.ingest import ingest
from sgstore.lang.catalog import Catalog
from sgstore.lang.sql import compile_query
from sgstore.model import vocabulary
from sgstore.model.config import Config, load
from sgstore.pipeline.importing import Words, import_graphs
from sgstore.store import StoreFile, verify_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from sgstore.query import Store

pytestmark = pytest.mark.usefixtures("own_names")


def scene(name: str) -> nx.MultiDiGraph[str]:
    """An image as Visual Genome describes it: objects, relations, attributes."""
    graph: nx.MultiDiGraph[str] = nx.MultiDiGraph(name=name)
    graph.add_node(
        "o1", label="traffic cone", attributes=["orange", "small"], synset="cone.n.01", w=31
    )
    graph.add_node("o2", label="man", color="blue", score=0.5, seen=True)
    graph.add_node("o3", label="Hydrant", color="red")
    graph.add_node("o4", kind="traffic_light", light_state="Green Arrow")
    graph.add_edge("o1", "o2", relation="next to", confidence=0.25)
    graph.add_edge("o2", "o3", relation="sitting on")
    return graph


def brought_in(folder: Path, *graphs: nx.MultiDiGraph[Any], **options: Any) -> Store:
    file = folder / "genome.json"
    file.write_text("\n".join(json.dumps(nx.node_link_data(g, edges="edges")) for g in graphs))
    (done,) = import_graphs(folder / "x.sgstore", [file], "nodelink", **options)
    assert done.error is None
    assert not done.lost
    return sgstore.open(folder / "x.sgstore")


def as_told(graph: nx.MultiDiGraph[Any]) -> tuple[set[str], set[tuple[str, str, str]]]:
    kinds = {n: d["kind"] for n, d in graph.nodes(data=True)}
    return set(kinds.values()), {
        (kinds[a], d["relation"], kinds[b]) for a, b, d in graph.edges(data=True)
    }


def test_labels_relations_and_attributes_of_a_stranger_come_back(tmp_path: Path) -> None:
    store = brought_in(tmp_path, scene("a.jpg"), scene("b.jpg"), words=Words(unknown_as="own"))
    kinds, edges = as_told(store.graph("genome#1"))
    nodes = {d["kind"]: d for _, d in store.graph("genome#1").nodes(data=True)}
    ((_, _, near),) = [e for e in store.graph("genome#1").edges(data=True) if "confidence" in e[2]]

    assert kinds == {"traffic_cone", "man", "hydrant", "traffic_light"}
    assert edges == {("traffic_cone", "next_to", "man"), ("man", "sitting_on", "hydrant")}
    assert nodes["traffic_cone"]["attributes"] == ["orange", "small"]
    assert (nodes["traffic_cone"]["synset"], nodes["traffic_cone"]["w"]) == ("cone.n.01", 31)
    assert (nodes["man"]["score"], nodes["man"]["seen"]) == (0.5, True)
    assert nodes["traffic_light"]["light_state"] == "green_arrow"
    assert near["confidence"] == 0.25
    found = store.find("MATCH (c:TrafficCone)-[:next_to]->(m:man) RETURN c.type, m.kind")
    assert list(found) == [("traffic cone", "man")] * 2
    lit = store.find("MATCH (l:TrafficLight) WHERE l.light_state = 'green_arrow'")
    assert lit.count() == 2
    assert len(list(store.find("MATCH (x:Entity) RETURN x.kind"))) == 8
    assert len(list(store.find("MATCH (x:Entity&!TrafficCone) RETURN x.kind"))) == 6
    texts = "SELECT text, count(*) FROM attributes WHERE name = 'color' GROUP BY ALL ORDER BY 1"
    assert store.sql(texts).values == [("blue", 2), ("red", 2)]
    assert store.sql("SELECT DISTINCT relation, text FROM edge_attributes").values == [
        ("next_to", "0.25")
    ]
    assert not store.file.verify().faults
    assert len(set(store.classes("SG")["class"])) == 1
    store.file.compact()
    assert list(store.find("MATCH (c:TrafficCone)-[:next_to]->(m:man) RETURN c.type, m.kind"))
    assert not verify_file(store.file.path).faults


def of_its_own(rng: random.Random) -> dict[str, Any]:
    """Attributes that somebody else gave, of several types; some are missing."""
    values = {
        "color": rng.choice(("red", "blue", "it's", None)),
        "weight": rng.choice((1, 2.5, -3, 10**6)),
        "isNew": rng.random() < 0.5,
        "tags": rng.choice(([], ["small", "wet"], {"a": [1]})),
        "mixed": rng.choice((1, "1", 0.5, True, None)),
        "SIZE": rng.choice((1, 2)),
        "size": rng.choice(("big", "huge")),
    }
    return {name: value for name, value in values.items() if rng.random() < 0.7}


def strange(number: int) -> nx.MultiDiGraph[str]:
    """A random graph whose nodes and edges have attributes of their own."""
    rng = random.Random(number)
    graph: nx.MultiDiGraph[str] = nx.MultiDiGraph(name=f"{number}.jpg")
    for node in range(rng.choice((2, 4, 6))):
        held = of_its_own(rng)
        graph.add_node(f"o{node}", kind=rng.choice(("car", "person")), **held)
    for _ in range(8):
        a, b = rng.sample(sorted(graph.nodes), 2)
        graph.add_edge(a, b, relation=rng.choice(("near", "visible")), **of_its_own(rng))
    return graph


def text_of(value: Any) -> str | None:
    return value if isinstance(value, str | None) else json.dumps(value, separators=(",", ":"))


OWN: dict[str, Callable[[dict[str, Any]], bool]] = {
    "x.color = 'red'": lambda x: x.get("color") == "red",
    "NOT x.color = 'red'": lambda x: x.get("color") not in {None, "red"},
    "x.color IN ['blue', 'it\\'s']": lambda x: x.get("color") in {"blue", "it's"},
    "x.color IS NULL": lambda x: x.get("color") is None,
    "x.weight > 1.5": lambda x: x.get("weight", -9) > 1.5,
    "x.weight + 1 = 2 OR x.is_new": lambda x: x.get("weight") == 1 or x.get("isNew", False),
    "NOT x.isNew": lambda x: x.get("isNew") is False,
    "x.TAGS CONTAINS 'wet'": lambda x: "wet" in x.get("tags", ()),
    "x.tags = '{\"a\":[1]}'": lambda x: x.get("tags") == {"a": [1]},
    "x.mixed = '1'": lambda x: text_of(x.get("mixed")) == "1",
    "x.mixed IN ['true', '0.5']": lambda x: text_of(x.get("mixed")) in {"true", "0.5"},
    "x.SIZE = 1 AND x.size = 'big'": lambda x: x.get("SIZE") == 1 and x.get("size") == "big",
    "coalesce(x.color, 'none') = 'none'": lambda x: x.get("color") is None,
}


@pytest.fixture(scope="module")
def attributed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    store = brought_in(tmp_path_factory.mktemp("own"), *map(strange, range(12)))
    with store.file.snapshot():
        yield store


@pytest.fixture(scope="module")
def graphs(attributed: Store) -> dict[int, nx.MultiDiGraph[Any]]:
    return {n: attributed.graph(f"genome#{n}") for n in range(12)}


@pytest.mark.parametrize("condition", OWN)
def test_attributes_of_a_client_are_asked_for_in_patterns(
    attributed: Store, graphs: dict[int, nx.MultiDiGraph[Any]], condition: str
) -> None:
    fits = OWN[condition]
    single = {(n, i) for n, g in graphs.items() for i, x in g.nodes(data=True) if fits(x)}
    ends = {(n, a) for n, g in graphs.items() for a, b in g.edges() if (n, b) in single}
    pattern = f"MATCH (x) WHERE {condition} RETURN frame.seq, x.id"
    beside = f"EXISTS {{(a)-[:near|visible]->(x) WHERE {condition}}}"

    assert {(row.frame_seq, row.x_id) for row in attributed.find(pattern)} == single
    assert single
    found = attributed.find(f"MATCH (a) WHERE {beside} RETURN frame.seq, a.id")
    assert {(row.frame_seq, row.a_id) for row in found} == ends
    found = attributed.find(
        f"MATCH (a)-[:near|visible]->(x) WHERE {condition} RETURN frame.seq, a.id"
    )
    assert {(row.frame_seq, row.a_id) for row in found} == ends
    for number in range(0, 12, 4):  # in memory
        answer = attributed.why_not(f"genome#{number}", f"MATCH (x) WHERE {condition}")
        assert answer.as_dict()["matches"] == (number in {n for n, _ in single})


@pytest.mark.parametrize("condition", OWN)
def test_attributes_of_edges_are_asked_for_in_patterns(
    attributed: Store, graphs: dict[int, nx.MultiDiGraph[Any]], condition: str
) -> None:
    fits, asked = OWN[condition], condition.replace("x.", "r.")
    edges, near = set[Any](), set[Any]()
    for n, graph in graphs.items():
        for a, b, r in graph.edges(data=True):
            if fits(r):
                edges.add((n, a, b, r["relation"], text_of(r.get("color"))))
                near |= {(n, a)} if r["relation"] == "near" else set()

    rows = attributed.find(
        f"MATCH (a)-[r]->(b) WHERE {asked} RETURN frame.seq, a.id, b.id, type(r), r.color"
    )
    assert set(rows) == edges
    assert edges
    there = f"EXISTS {{(a)-[r:near]->() WHERE {asked}}}"
    assert set(attributed.find(f"MATCH (a) WHERE {there} RETURN frame.seq, a.id")) == near
    for number in range(0, 12, 4):  # in memory
        answer = attributed.why_not(f"genome#{number}", f"MATCH (a)-[r]->(b) WHERE {asked}")
        assert answer.as_dict()["matches"] == (number in {row[0] for row in edges})
    with pytest.raises(QueryError, match="only a single directed edge has"):
        attributed.find(f"MATCH (a)-[r]-(b) WHERE {asked}")


def test_attributes_of_a_client_are_returned(
    attributed: Store, graphs: dict[int, nx.MultiDiGraph[Any]]
) -> None:
    nodes = [(n, i, x) for n, g in graphs.items() for i, x in g.nodes(data=True)]
    rows = attributed.find("MATCH (x) RETURN frame.seq, x.id, x.color, x.weight, x.is_new, x.mixed")
    names = ("color", "weight", "isNew")

    assert sorted(rows.rows(), key=lambda row: row[:2]) == [
        (n, i, *(x.get(name) for name in names), text_of(x.get("mixed"))) for n, i, x in nodes
    ]
    counted = attributed.find("MATCH (x) WHERE x.color IS NOT NULL RETURN x.color, count(*)")
    assert dict(counted) == Counter(x["color"] for *_, x in nodes if x.get("color"))
    heaviest = attributed.find("MATCH (x) RETURN max(x.weight)").rows()
    assert heaviest == [(max(x.get("weight", 0) for *_, x in nodes),)]
    runs = attributed.find("MATCH (x) WHERE x.color = 'red' RETURN INTERVALS, x.color")
    assert {run["color"] for run in ({"color": row[-1]} for row in runs)} == {"red"}


def test_an_attribute_that_nobody_has_is_an_error_as_before(attributed: Store) -> None:
    with pytest.raises(QueryNameError, match="unknown attribute 'colr'") as caught:
        attributed.find("MATCH (x) WHERE x.colr = 'red'")
    assert caught.value.hint == "did you mean 'color'?"
    with pytest.raises(QueryError, match="a text cannot be compared with a number"):
        attributed.find("MATCH (x) WHERE x.color = 5")
    with pytest.raises(QueryNameError, match="unknown attribute 'color'"):
        compile_query("MATCH (x) WHERE x.color = 'red'", Catalog())


def test_what_is_exported_comes_in_again_as_it_was(tmp_path: Path) -> None:
    first = brought_in(tmp_path, scene("a.jpg"), words=Words(unknown_as="own"))
    (tmp_path / "again").mkdir()
    graph = first.graph("genome#0")
    second = brought_in(tmp_path / "again", graph, words=Words(unknown_as="own"))
    back = second.graph("genome#0")

    assert as_told(back) == as_told(graph)
    for name in ("attributes", "synset", "w", "color", "score", "seen"):
        values = [
            sorted(map(repr, (d.get(name) for _, d in g.nodes(data=True)))) for g in (back, graph)
        ]
        assert values[0] == values[1]


def test_a_store_with_new_names_is_asked_in_a_process_that_knows_none(tmp_path: Path) -> None:
    store = brought_in(tmp_path, scene("a.jpg"), words=Words(unknown_as="own"))
    script = """
import sys, sgstore
from sgstore.model import vocabulary
vocabulary.add_kind("comes_first"); vocabulary.add_light_state("purple")  # other codes than in the store
store = sgstore.open(sys.argv[1])
print(store.find("MATCH (h:Hydrant)<-[:sitting_on]-(m:Man)").count(), len(store.file.verify().faults))
print(sorted(d["base_class"] for _, d in store.graph("genome#0", abstraction="E").nodes(data=True)))
print(*store.find("MATCH (l) WHERE l.light_state = 'green_arrow' RETURN l.kind"))
"""
    told = subprocess.run(
        [sys.executable, "-c", script, str(store.file.path)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout

    assert told.splitlines()[0] == "1 0"
    assert "hydrant" in told
    assert "traffic_light" in told.splitlines()[2]


def test_a_store_made_before_takes_new_kinds_beside_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.sgstore"
    sample = sgstore.__path__[0] + "/apps/sample/town.mcap"
    ingest(path, [sample], until=3.0)
    before = sgstore.open(path).sql("SELECT * FROM nodes ORDER BY ALL").values
    store = brought_in(tmp_path, scene("a.jpg"), words=Words(unknown_as="own"))
    of_town = (
        "SELECT n.* FROM nodes n JOIN frames USING (frame_id) WHERE n.trace = 'town' ORDER BY ALL"
    )

    assert store.sql(of_town).values == before
    assert store.find("MATCH (h:Hydrant)").count() == 1
    assert not store.file.verify().faults
    store.file.remove("genome")
    assert not store.file.verify().faults


def test_labels_for_which_there_is_no_room_are_unknown_and_keep_their_type(tmp_path: Path) -> None:
    graph: nx.MultiDiGraph[str] = nx.MultiDiGraph(name="many")
    for number in range(150):
        graph.add_node(f"o{number}", label=f"thing {'abcdefghij'[number // 15]}{number % 15}x")
    store = brought_in(tmp_path, graph, words=Words(unknown_as="own"))
    kinds = store.sql(
        "SELECT kind = 'unknown', count(DISTINCT type_name) FROM entities GROUP BY 1 ORDER BY 1"
    )

    room = vocabulary.MOST_KINDS - len(vocabulary.OWN_KINDS)
    assert kinds.values == [(False, room), (True, 150 - room)]


def test_a_type_of_a_recording_is_of_a_kind_that_the_settings_name(tmp_path: Path) -> None:
    sample = sgstore.__path__[0] + "/apps/sample/town.mcap"
    types = StoreFile.create(tmp_path / "types.db")
    ingest(types.path, [sample], until=2.0)
    ((name,),) = sgstore.open(types.path).sql(
        "SELECT type_name FROM entities WHERE kind = 'car' AND type_name IS NOT NULL ORDER BY 1 LIMIT 1"
    ).values or [("",)]
    config = Config(new_kinds=("patrol_car",), types={name: vocabulary.TypeMeaning("patrol_car")})
    for jobs in (1, 2):
        path = tmp_path / f"{jobs}.db"
        ingest(path, [sample], until=2.0, config=config, jobs=jobs)
        store = sgstore.open(path)
        assert set(store.find("MATCH (x:PatrolCar) RETURN x.kind")) == {("patrol_car",)}
        assert store.find("MATCH (x:PatrolCar)-[:visible]-(y:Car)").count() > 0
        assert not store.file.verify().faults


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            '[types]\nx = { kind = "trcuk" }',
            "'truck', perhaps; new_kinds names those of your own",
        ),
        ('new_kinds = ["Vehicle"]', "could be confused with the label"),
        ('new_kinds = ["near"]', "could be confused with the relation 'near'"),
        ('new_kinds = ["a b"]', "is not a name"),
        ('new_kinds = ["ego"]', "could be confused with the label"),
    ],
)
def test_a_kind_that_cannot_be_is_told(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(ConfigError, match=told):
        load(tmp_path / "c.toml")


def test_a_store_whose_kinds_are_no_names_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.sgstore"
    StoreFile.create(path)
    add_labels(path, "kind", ["a b"])

    with pytest.raises(StoreError, match="a kind: 'a b' is not a name"):
        StoreFile(path)


def with_names(path: Path, **names: list[str]) -> Path:
    """A store of the sample whose enumerations have more names, as another process may have made it."""
    ingest(path, [sgstore.__path__[0] + "/apps/sample/town.mcap"], until=1.0)
    for enum, labels in names.items():
        add_labels(path, enum, labels)
    return path


def test_a_store_opens_whatever_its_names_look_like_and_exact_text_decides(tmp_path: Path) -> None:
    vocabulary.add_relation("danger")
    vocabulary.add_kind("wheel_chair")
    path = with_names(tmp_path / "x.sgstore", relation=["Danger"], kind=["wheelchair"])
    relation = "UPDATE inside.edge SET relation = 'Danger' WHERE relation = 'near'"
    import duckdb

    with duckdb.connect(str(path)) as connection:
        (near,) = connection.execute(
            "SELECT count(*) FROM edges WHERE relation = 'near'"
        ).fetchall()
        connection.execute(relation)
        connection.execute(
            "UPDATE inside.trace SET answers = list_append(list_append(answers, 'Danger'), 'danger')"
        )
        of_edges = (("edge", "src_kind"), ("edge", "dst_kind"))
        of_lanes = ("lane_single", "lane_repeated")
        for table, column in (*((t, "kind") for t in ("entity", "state", *of_lanes)), *of_edges):
            connection.execute(
                f"UPDATE inside.{table} SET {column} = 'wheelchair' WHERE {column} = 'person'"
            )
    store = sgstore.open(path)
    people = store.sql("SELECT count(*) FROM nodes WHERE kind = 'wheelchair'").values[0]

    asked = "MATCH (a)-[r:{}]->(b) RETURN COUNT(*) AS n"
    assert near[0] > 0
    assert list(store.find(asked.format("Danger"))) == [near]
    assert list(store.find(asked.format("DANGER"))) == [near], (
        "the store's, before others that look alike"
    )
    assert list(store.find(asked.format("danger"))) == [(0,)], "another name"
    typed = "MATCH (a)-[r]->(b) WHERE type(r) = '{}' RETURN COUNT(*) AS n"
    assert list(store.find(typed.format("Danger"))) == [near]
    assert list(store.find(typed.format("danger"))) == [(0,)]
    assert people[0] > 0
    for word, count in (("wheelchair", people), ("Wheelchair", people), ("WheelChair", (0,))):
        assert list(store.find(f"MATCH (x:{word}) RETURN COUNT(*) AS n")) == [count], word


@pytest.fixture(scope="module")
def two_stores(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A store, and one with names of its own."""
    folder = tmp_path_factory.mktemp("two")
    names = {"relation": ["charms"], "kind": ["unicorn"], "light_state": ["purple"]}
    return with_names(folder / "plain.sgstore"), with_names(folder / "other.sgstore", **names)


@pytest.mark.parametrize(
    "text",
    [
        "MATCH (x:Unicorn)",
        "MATCH (x:Unicron)",
        "MATCH (x)-[:charms]->(y)",
        "MATCH (x)-[:charm]->(y)",
        "MATCH (x) WHERE x.kind = 'unicorn'",
        "MATCH (x)-[r]->(y) WHERE type(r) = 'charms'",
        "MATCH (x:TrafficLight) WHERE x.light_state = 'purple'",
        "MATCH (a:charms)-[:unicorn]->(b)",
    ],
)
def test_names_that_one_store_brought_change_no_error_of_another(
    two_stores: tuple[Path, Path], text: str
) -> None:
    plain, other = two_stores

    def error() -> str:
        with pytest.raises(QueryError) as raised:
            sgstore.open(plain).find(text).count()
        return f"{raised.value} {raised.value.hint}"

    before = error()
    store = sgstore.open(other)
    known = [
        "MATCH (x:Unicorn)",
        "MATCH (x)-[:charms]->(y)",
        "MATCH (x:TrafficLight) WHERE x.light_state = 'purple'",
    ]
    assert [store.find(one).count() for one in known] == [0, 0, 0]

    assert error() == before
