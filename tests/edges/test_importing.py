"""Graphs from elsewhere: what a file holds is in the store; what is wrong with it is said, with its place."""

from __future__ import annotations

import csv
import gzip
import json
import lzma
import os
import random
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import networkx as nx
import pytest
from thorough import some

import sgstore
from sgstore.apps.cli import run
from sgstore.errors import ConfigError, QueryError, TraceError
from sgstore.ingest import ingest
from sgstore.lang.memory import Binding, FrameView, ScopeSearch
from sgstore.lang.sql import compile_query
from sgstore.pipeline.importing import FORMATS, Words, import_graphs
from sgstore.pipeline.importing._resolve import Understanding, survey
from sgstore.pipeline.importing._run import Blocks, parts_map
from sgstore.query import Store
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterable

pytestmark = pytest.mark.seconds(25)

HEADER = "ds,sg,n_img,t_id,node1,edge,node2\n"
TWO = HEADER + (
    "d,a.png,3,0,Ego Lane,isIn,Root Road\n"
    "d,a.png,3,1,ego,isIn,Ego Lane\n"
    "d,a.png,3,2,car_0,isIn,Left 1 of Ego Lane\n"
    "d,a.png,3,3,car_0,near,ego\n"
    "d,b.png,1,0,ego,isIn,Ego Lane\n"
    "d,b.png,1,1,truck_1,isIn,Off Road\n"
)


def imported(folder: Path, text: str, form: str, **options: Any):
    """The store of one file; an error is raised."""
    file = folder / f"graphs.{'json' if form == 'nodelink' else 'csv'}"
    file.write_text(text, encoding="utf-8")
    (done,) = import_graphs(folder / "x.sgstore", [file], form, **options)
    if done.error is not None:
        raise done.error
    return sgstore.open(folder / "x.sgstore"), done


def edges(graph: nx.MultiDiGraph[Any]) -> set[tuple[str, str, str]]:
    return {(a, d["label"], b) for a, b, d in graph.edges(data=True)}


def test_a_graph_of_s3c_is_a_frame_whose_scene_is_what_the_rows_say(tmp_path: Path) -> None:
    store, done = imported(tmp_path, TWO, "s3c")

    assert (done.status, done.frames, done.entities, done.edges) == ("added", 2, 3, 6)
    assert edges(store.graph("graphs#0", "RSV")) == {
        ("Ego Lane", "isIn", "Root Road"),
        ("Left 1 of Ego Lane", "isIn", "Root Road"),  # every lane of RSV is
        ("ego", "isIn", "Ego Lane"),
        ("car_1", "isIn", "Left 1 of Ego Lane"),
        ("car_1", "near", "ego"),
    }
    assert edges(store.graph("graphs#1", "RSV")) == {
        ("ego", "isIn", "Ego Lane"),
        ("Ego Lane", "isIn", "Root Road"),
        ("truck_2", "isIn", "Off Road"),
    }
    assert store.sql("SELECT graph, place, images FROM imports ORDER BY place").values == [
        ("a.png", 2, 3),
        ("b.png", 6, 1),
    ]


def test_imported_frames_are_found_by_patterns_sql_and_names_of_lanes(tmp_path: Path) -> None:
    store, _ = imported(tmp_path, TWO, "s3c")
    left = "MATCH (c:Car&!Ego)-[:isIn]->(:Lane {name: 'Left 1 of Ego Lane'}) RETURN c.ident"

    assert store.find(left).rows() == [("car_0",)]
    assert [f.seq for f in store.find("MATCH (e:Ego)-[:isIn]->(:Lane)").frames()] == [0, 1]
    assert store.sql("SELECT count(*) FROM edges WHERE relation = 'isIn'").values == [(5,)]
    assert store.find("MATCH (a)-[:opposes]->(b)").left_out == ("graphs",)
    assert store.find("MATCH (a)-[:visible]->(b)").left_out == ()


@pytest.mark.parametrize(
    "name",
    [
        "carla_max_vehicle_v3_Town02",
        "carla_zero_vehicle_v3_Town02",
        "carla_zero_vehicle_v3_Town04",
        "carla_zero_vehicle_v3",
    ],
)
def test_every_row_that_s3c_published_comes_back_from_the_store(
    data: Path, tmp_path: Path, name: str
) -> None:
    file = data / "s3c" / f"{name}.csv.xz"
    (done,) = import_graphs(tmp_path / "x.sgstore", [file], "s3c")
    wanted = set()
    with lzma.open(file, "rt", encoding="utf-8") as text:
        for row in csv.DictReader(text):
            wanted.add((row["sg"], row["node1"], row["edge"], row["node2"]))
    found = sgstore.open(tmp_path / "x.sgstore").sql(
        """
        WITH names AS (
          SELECT frame_id, n.node_id, coalesce(x.ident, n.name) AS name
          FROM nodes n JOIN frames f USING (frame_id)
               LEFT JOIN entities x ON x.trace_id = f.trace_id AND x.node_id = n.node_id)
        SELECT i.graph, a.name, e.relation::VARCHAR, b.name FROM edges e JOIN imports i USING (frame_id)
        JOIN names a ON a.frame_id = e.frame_id AND a.node_id = e.src
        JOIN names b ON b.frame_id = e.frame_id AND b.node_id = e.dst
        """
    )

    assert done.error is None
    assert set(found.values) == wanted
    assert len(found.values) == len(wanted)


def test_classes_are_those_that_s3c_published(data: Path, tmp_path: Path) -> None:
    """One graph for each class of isomorphic ones: 1,254, 3, 6 and 8."""
    numbers = {"max_vehicle_v3_Town02": 1254, "zero_vehicle_v3_Town02": 3, "zero_vehicle_v3": 8}
    files = [data / "s3c" / f"carla_{name}.csv.xz" for name in numbers]
    import_graphs(tmp_path / "x.sgstore", files, "s3c")
    store = sgstore.open(tmp_path / "x.sgstore")

    for abstraction in ("RSV", "SG"):
        found = [
            len(set(store.classes(abstraction, f"carla_{name}.csv")["class"])) for name in numbers
        ]
        assert found == list(numbers.values())


def test_what_networkx_writes_comes_back_with_its_attributes(tmp_path: Path) -> None:
    graph = nx.MultiDiGraph(time_ns="9007199254740993", ego=1)
    graph.add_node(1, kind="car", x=1.5, y=-2.0, z=0.0, heading=90.0, speed=3.0, light_brake=True)
    graph.add_node("p", kind="person", x=4.0, y=0.0, z=0.0, pose="odd")
    graph.add_node(-3, kind="lane", name="5/0/-1", lane_type="driving", width=3.5)
    graph.add_edge(1, -3, key="isIn", relation="isIn", overlap=0.8, is_primary=True)
    graph.add_edge("p", 1, key="near", relation="near")
    text = json.dumps(nx.node_link_data(graph, edges="edges"))
    store, done = imported(tmp_path, text, "nodelink")
    found = store.graph("graphs#0")
    ego = found.nodes[found.graph["ego"]]

    assert not done.lost
    assert {data.get("pose") for _, data in found.nodes(data=True)} == {None, "odd"}
    assert found.graph["time_ns"] == 9007199254740993
    assert ego["heading"] == pytest.approx(90)
    assert (ego["vx"], ego["vy"], ego["light_brake"]) == (pytest.approx(0, abs=1e-6), 3.0, True)
    assert {n["name"] for _, n in found.nodes(data=True) if n["kind"] == "lane"} == {"5/0/-1"}
    (lane,) = [d for _, _, d in found.edges(data=True) if d["relation"] == "isIn"]
    assert (lane["overlap"], lane["is_primary"]) == (pytest.approx(0.8), True)
    assert store.find("MATCH (e:Ego)<-[:near]-(p:Person) WHERE dist(e, p) < 4").count() == 1


def test_graphs_of_this_house_have_the_same_classes_when_they_come_back(tmp_path: Path) -> None:
    """Entities and their relations: what is known without a map."""
    sample = Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap"
    ingest(tmp_path / "town.sgstore", [sample], rate=1, until=9)
    town = sgstore.open(tmp_path / "town.sgstore")
    frames = town.classes("ER")["frame_id"].tolist()
    lines = []
    for frame in frames:
        graph = town.graph(frame)
        graph.graph["time_ns"] = str(graph.graph["time_ns"])
        lines.append(json.dumps(nx.node_link_data(graph, edges="links")))
    store, done = imported(tmp_path, "\n".join(lines), "nodelink")

    assert done.frames == len(frames) == 10
    for abstraction in ("E", "ER"):
        wanted = town.classes(abstraction)["class"].tolist()
        assert store.classes(abstraction)["class"].tolist() == wanted


@pytest.mark.parametrize("seed", range(2))
def test_a_graph_and_the_same_in_another_order_have_one_class_in_all_formats(
    tmp_path: Path, seed: int
) -> None:
    rng = random.Random(seed)
    nodes = ["ego", *(f"{rng.choice(['car', 'truck', 'person'])}_{i}" for i in range(6))]
    relations = ["near", "visible", "inDFrontOf", "toLeftOf"]
    rows = {(*rng.sample(nodes, 2), rng.choice(relations)) for _ in range(15)}
    rows = sorted({*rows, *((n, "ego", "near") for n in nodes[1:])})
    graph = nx.MultiDiGraph()
    graph.add_nodes_from((n, {"base_class": re.sub(r"_\d+", "", n)}) for n in nodes)
    for a, b, r in rng.sample(rows, len(rows)):
        graph.add_edge(a, b, label=r)
    text = "graph,src,relation,dst\n" + "".join(f"g,{a},{r},{b}\n" for a, b, r in rows)
    s3c = HEADER + "".join(f"d,g,1,{i},{a},{r},{b}\n" for i, (a, b, r) in enumerate(rows))
    listed = json.dumps([nx.node_link_data(graph, edges="links")], indent=1)
    found = set()
    for form, content in (("csv", text), ("s3c", s3c), ("nodelink", listed)):
        (tmp_path / form).mkdir()
        store, _ = imported(tmp_path / form, content, form)
        found.update(store.classes("ER")["class"].tolist())

    assert len(found) == 1


CSV = "graph,src,relation,dst\n"
WRONG = [
    ("s3c", "a,b\n", "row 1: expected the header of S3C"),
    ("s3c", HEADER, "no row beside the header"),
    ("s3c", "", "empty; expected a header"),
    ("s3c", HEADER + "d,a,1,0,ego,isIn\n", "row 2: 6 columns, expected 7"),
    ("s3c", HEADER + "d,a,x,0,ego,isIn,Ego Lane\n", "row 2, column n_img: expected a number"),
    (
        "s3c",
        HEADER + "d,a,1,0,ego,isIn,dragon_3\n",
        "row 2, column node2: 'dragon' is an unknown kind",
    ),
    ("s3c", HEADER + "d,a,1,0,ego,nearr,car_1\n", r"row 2, column edge: .*did you mean 'near'"),
    ("s3c", HEADER + "d,,1,0,ego,near,car_1\n", "row 2, column sg: expected the name of a graph"),
    ("s3c", HEADER + "d,a,1,0,ego,near,\n", "row 2, column node2: expected the name of a node"),
    ("s3c", HEADER + "d,a,1,0,ego,,car_1\n", "row 2, column edge: empty"),
    ("s3c", HEADER + 'd,a,1,0,ego,near,"car\n', "no CSV"),
    (
        "s3c",
        HEADER + "d,a,1,0,ego,near,car_1\nd,b,1,0,ego,near,car_1\nd,a,1,1,ego,near,car_2\n",
        "row 4: a graph of the same name begins at 2 already",
    ),
    ("s3c", HEADER + "d,a,1,0,ego,near,hero\n", "both the ego of graph 'a'"),
    ("csv", "graph,src,relation\n", "row 1: no column 'dst'"),
    ("csv", "graph,src,relation,dst,node1\n", "columns src and node1 both say 'src'"),
    (
        "csv",
        "graph,src,relation,dst,t\na,ego,near,car_1,nan\n",
        "row 2, column t: nan is out of range",
    ),
    (
        "csv",
        "graph,src,relation,dst,src_kind\na,x,near,ego,car\na,x,near,ego,truck\n",
        "row 3, column src: 'x' is 'truck' here and 'car' in row 2",
    ),
    ("csv", CSV + "a,vru,near,ego\n", "it can be any of person, bicycle, motorcycle"),
    ("nodelink", "", "empty; expected a graph"),
    ("nodelink", "[]", "an empty list"),
    ("nodelink", "{", "no JSON"),
    ("nodelink", "[" * 100_000, "nested too deeply"),
    ("nodelink", "3", "no node-link graph"),
    ("nodelink", '{"nodes": [], "graph": {"t": "²"}}', "line 1: expected a time in 't'"),
    ("nodelink", '{"nodes": [], "graph": {"time_ns": "--5"}}', "expected a time in 'time_ns'"),
    ("nodelink", '{"nodes": [], "edges": {}}', "expected a list 'edges'"),
    ("nodelink", '{"directed": false, "nodes": []}', "an undirected graph"),
    ("nodelink", '{"nodes": [{"id": 1}, {"id": 1}]}', "line 1, node 1: the id '1' comes twice"),
    ("nodelink", '{"nodes": [{"kind": "car"}]}', "line 1, node 0: expected an object with an 'id'"),
    (
        "nodelink",
        '{"nodes": [{"id": "ego"}], "edges": [{"source": "ego", "target": "x", "label": "near"}]}',
        "line 1, edge 0: no node 'x' in this graph",
    ),
    (
        "nodelink",
        '{"nodes": [{"id": "ego"}, {"id": "car_1"}], "edges": [{"source": "ego", "target": "car_1"}]}',
        "line 1, edge 0: names no relation",
    ),
    (
        "nodelink",
        '{"nodes": [{"id": "ego", "x": "left"}]}',
        "line 1, node 0: expected a number as 'x'",
    ),
    ("nodelink", '{"nodes": [{"id": "ego"}]}\n{"nodes": 3}', "line 2: no node-link graph"),
    (
        "nodelink",
        '{"nodes": [{"id": "ego"}]}\n{"graph": {"t": 1}, "nodes": [{"id": "ego"}]}',
        "do not agree on whether there are times",
    ),
    ("nodelink", '{"nodes": [{"id": "Ego Lane", "is_ego": true}]}', "the ego cannot be a lane"),
    (
        "nodelink",
        '{"nodes": [{"id": 1, "kind": "lane", "name": "a"}, {"id": 2, "kind": "lane", "name": "a"}]}',
        "line 1, node 1: '1' and '2' are the same lane 'a'",
    ),
    (
        "nodelink",
        '{"nodes": [{"id": "light", "kind": "traffic_light", "light_state": "pink"}]}',
        "no state of a light: 'pink'",
    ),
]


@pytest.mark.parametrize(("form", "text", "said"), WRONG)
def test_what_is_wrong_with_a_file_is_said_and_nothing_comes_into_the_store(
    tmp_path: Path, form: str, text: str, said: str
) -> None:
    with pytest.raises(TraceError, match=said) as error:
        imported(tmp_path, text, form)

    assert "graphs." in str(error.value)
    assert not (tmp_path / "x.sgstore").exists()
    assert len(list(tmp_path.iterdir())) == 1


def mutated(text: str, rng: random.Random) -> bytes:
    """A text that was hurt in a few places."""
    raw = bytearray(text.encode())
    for _ in range(rng.randrange(1, 6)):
        at = rng.randrange(len(raw) or 1)
        match rng.randrange(4):
            case 0:
                raw[at : at + 1] = bytes([rng.randrange(256)])
            case 1:
                del raw[at : at + rng.randrange(1, 9)]
            case 2:
                raw[at:at] = rng.choice(
                    [b",", b'"', b"\n", b"{", b"]", b"null", b"1e999", b"NaN", b"\0"]
                )
            case _:
                raw[at:at] = raw[at : at + 30] * rng.randrange(1, 4)
    return bytes(raw)


HURT = int(os.environ.get("SGSTORE_HURT_GRAPHS", "200"))
"""Files that are hurt; ``make oracle`` takes 20,000."""


@pytest.mark.parametrize("form", ["s3c", "csv", "nodelink"])
def test_a_hurt_file_is_read_or_refused_and_nothing_else_happens(tmp_path: Path, form: str) -> None:
    rng = random.Random(form)
    graphs = [
        {
            "directed": True,
            "graph": {"t": i / 2, "ego": "ego"},
            "nodes": [
                {"id": "ego", "kind": "car", "x": 1.5, "heading": 90.0, "light_brake": True},
                {"id": 2, "label": "person", "speed": 1},
                {"id": "l", "kind": "lane", "lane_type": "driving", "section": 0},
            ],
            "links": [
                {"source": "ego", "target": "l", "key": "isIn", "overlap": 0.5},
                {"source": 2, "target": "ego", "relation": "follows", "gap": 3},
            ],
        }
        for i in range(3)
    ]
    text = {
        "s3c": TWO,
        "csv": CSV.replace("dst", "dst,t")
        + "g,ego,near,car_1,0\ng,car_1,isIn,Lane 1,0\nh,ego,,,1\n",
        "nodelink": "\n".join(map(json.dumps, graphs)),
    }[form]
    file = tmp_path / "hurt"
    good, said = 0, list[str]()
    for _ in range(HURT):
        file.write_bytes(mutated(text, rng))
        words = Words(unknown_as=rng.choice(["", "other"]))
        try:
            found = survey(file, FORMATS[form](file), words)
            understanding = Understanding(file, words)
            blocks = Blocks(file, parts_map("m", "", found.parts), 10**9)
            block = blocks.block([understanding.of(graph) for graph in FORMATS[form](file)])
            assert len(block) == found.graphs
            good += 1
        except TraceError as error:
            said.append(str(error))

    assert good > 0
    assert good + len(said) == HURT
    assert all(str(file) in one for one in said)


def test_text_that_is_no_utf_8_and_a_broken_archive_are_errors_with_their_line(
    tmp_path: Path,
) -> None:
    plain, packed = tmp_path / "a.csv", tmp_path / "b.csv.gz"
    plain.write_bytes(HEADER.encode() + b"d,a,1,0,ego,near,car_\xff\n")
    packed.write_bytes(gzip.compress(TWO.encode())[:-20])
    done = import_graphs(tmp_path / "x.sgstore", [plain, packed, tmp_path / "none.csv"], "s3c")

    assert [one.status for one in done] == ["failed"] * 3
    assert "line 2: no UTF-8 at byte 21" in str(done[0].error)
    assert "cannot be read" in str(done[1].error)
    assert "No such file" in str(done[2].error)


def test_an_archive_of_nothing_but_air_is_refused_before_it_fills_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sgstore.pipeline.importing._formats as lines

    monkeypatch.setattr(lines, "_FREE", 1 << 16)
    monkeypatch.setattr(lines, "MAX_RATIO", 10)
    file = tmp_path / "air.csv.xz"
    file.write_bytes(lzma.compress(HEADER.encode() + b"\n" * 500_000))
    (done,) = import_graphs(tmp_path / "x.sgstore", [file], "s3c")

    assert "unpacked, from a file of" in str(done.error)


M = 1 << 20
S3C = HEADER.encode()
BOMBS: dict[str, tuple[str, Iterable[bytes], str]] = {
    "rows of one graph": ("csv", [S3C, *[b"d,a,1,0,ego,near,car_1\n" * 1000] * 1001], "edges"),
    "nodes of one graph": (
        "csv",
        [S3C, *(b"d,a,1,0,car_%d,,\n" % number for number in range(200_001))],
        "nodes",
    ),
    "columns of one row": ("csv", [S3C, b"," * (2 * M), b"\n"], "characters"),
    "a row over many lines": ("csv", [S3C, *[b'"\n",' * 1000] * 12_000], "characters"),
    "long names": (
        "csv",
        [S3C, *(b"d,a,1,0,%s_%d,,\n" % (b"x" * 980, number) for number in range(40_000))],
        "characters of names",
    ),
    "one line": ("csv", [S3C, *[b"x" * M] * 40], "longer than"),
    "objects": ("json", [b'{"nodes":[{}', *[b",{}" * (M // 3)] * 20, b"]}\n"], "values"),
    "objects on lines": ("json", [b'{"nodes":[\n', *[b"{},\n" * M] * 8, b"{}]}\n"], "values"),
    "lists": ("json", [*[b"[]," * M] * 10, b"[]\n"], "values"),
    "wide letters": ("json", ['{"nodes":["😀'.encode(), *[b"x" * M] * 31, b'"]}\n'], "an 'id'"),
}
"""What small files unpack to: the format, the content, and a word of the refusal."""


@pytest.mark.parametrize("bomb", some([*BOMBS], 3))
def test_what_a_small_file_unpacks_to_is_refused_before_it_fills_the_memory(
    tmp_path: Path, bomb: str
) -> None:
    ending, parts, word = BOMBS[bomb]
    file = tmp_path / f"bomb.{ending}.xz"
    with lzma.open(file, "wb", preset=1) as packed:
        for part in parts:
            packed.write(part)
    program = (
        "import resource, sys\n"
        "from sgstore.pipeline.importing import import_graphs\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "(done,) = import_graphs(*sys.argv[1:2], sys.argv[2:3], sys.argv[3])\n"
        "print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024, done.error)\n"
    )
    form = "s3c" if ending == "csv" else "nodelink"
    arguments = [str(tmp_path / "x.sgstore"), str(file), form]
    run = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True
    )
    used, _, error = run.stdout.partition(" ")

    assert file.stat().st_size < 200_000
    assert word in error
    assert int(used) < 400, "MB"
    assert not (tmp_path / "x.sgstore").exists()


def test_graphs_of_many_edges_come_in_as_well_as_small_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sgstore.pipeline.importing._run as running

    rows = "".join(
        f"d,g{graph},1,0,ego,near,car_{car}\n"
        for graph in range(130)
        for car in range(graph % 7 + 1)
    )
    whole, _ = imported(tmp_path, HEADER + rows, "s3c")
    monkeypatch.setattr(running, "_BLOCK_SIZE", 9)
    (tmp_path / "pieces").mkdir()
    pieces, _ = imported(tmp_path / "pieces", HEADER + rows, "s3c")

    for view in ("edges", "nodes", "imports"):
        query = f"SELECT * EXCLUDE (frame_id), frame_id & 16777215 FROM {view} ORDER BY ALL"
        assert pieces.sql(query).values == whole.sql(query).values
        assert whole.sql(query).values


def test_a_client_says_what_words_mean_and_what_nobody_knows_is_counted(tmp_path: Path) -> None:
    text = HEADER + (
        "d,a,1,0,ego,nextTo,dragon_3\nd,a,1,1,dragon_3,guards,ego\nd,a,1,2,elf_1,near,ego\n"
    )
    told = Words({"dragon": "animal"}, {"nextTo": "near"}, unknown_as="other")
    store, done = imported(tmp_path, text, "s3c", words=told)

    assert done.lost == {"relation guards": 1}
    assert store.sql(
        "SELECT kind::VARCHAR, ident, type_name, subkind FROM entities ORDER BY 1"
    ).values == [
        ("animal", "dragon_3", "dragon", None),
        ("car", "ego", None, None),
        ("unknown", "elf_1", "elf", "elf"),
    ]
    assert store.find("MATCH (:Ego)-[:near]->(:Animal)").count() == 1
    assert store.info()[0].report["losses"][0]["messages"] == 1


@pytest.mark.parametrize(
    "given",
    [
        {"kinds": {"x": "dragon"}},
        {"kinds": {"x": "vru"}},
        {"relations": {"x": "nearr"}},
        {"unknown_as": "lane"},
        {"unknown_as": "dragon"},
    ],
)
def test_a_meaning_that_is_none_is_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        Words(**given)


def test_a_file_comes_in_once_unless_it_is_forced_and_another_way_to_read_it_is_told(
    tmp_path: Path,
) -> None:
    store, _ = imported(tmp_path, TWO, "s3c")
    file = tmp_path / "graphs.csv"
    path = tmp_path / "x.sgstore"
    again = import_graphs(path, [file], "s3c")[0]
    otherwise = import_graphs(path, [file], "s3c", period_s=0.5)[0]
    forced = import_graphs(path, [file], "s3c", period_s=0.5, force=True)[0]

    assert (again.status, again.frames) == ("present", 2)
    assert "already in the store" in str(otherwise.error)
    assert forced.status == "replaced"
    assert store.sql("SELECT seq, t FROM frames ORDER BY seq").values == [(0, 0.0), (1, 0.5)]
    assert not StoreFile(path).verify(recordings=True).faults


def test_a_graph_of_more_than_a_bucket_of_frames_keeps_entities_and_order(tmp_path: Path) -> None:
    rows = "".join(f"g{i},car_{i % 7},near,ego\n" for i in range(300))
    store, done = imported(tmp_path, CSV + rows, "csv")
    found = store.sql(
        "SELECT i.graph, x.ident FROM imports i JOIN frames f USING (frame_id) JOIN edges e USING (frame_id)"
        " JOIN entities x ON x.trace_id = f.trace_id AND x.node_id = e.src ORDER BY f.seq"
    )

    assert (done.frames, done.entities) == (300, 8)
    assert found.values == [(f"g{i}", f"car_{i % 7}") for i in range(300)]


@pytest.mark.parametrize("what", ["imported", "ingested"])
def test_what_is_exported_as_s3c_comes_back_with_the_same_classes(
    tmp_path: Path, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    first = tmp_path / "first.sgstore"
    if what == "imported":
        (tmp_path / "two.csv").write_text(TWO)
        import_graphs(first, [tmp_path / "two.csv"], "s3c")
    else:
        sample = Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap"
        ingest(first, [sample], rate=1, until=9)
    command = [
        "export",
        str(first),
        "MATCH (:Ego)",
        "--as",
        "s3c",
        "-o",
        str(tmp_path / "out"),
    ]
    assert run(command) == 0
    lost = re.findall(r"(\d+) nodes? without an edge in no row", capsys.readouterr().err)
    (done,) = import_graphs(tmp_path / "again.sgstore", [tmp_path / "out" / "graphs.csv"], "s3c")
    one, other = sgstore.open(first), sgstore.open(tmp_path / "again.sgstore")

    assert done.error is None
    for abstraction in ("E", "EL", "ER", "RSV"):
        found, wanted = (store.classes(abstraction)["class"].tolist() for store in (other, one))
        assert sum(a != b for a, b in zip(found, wanted, strict=True)) <= sum(map(int, lost))
        assert len(set(found)) > 1


def test_what_was_imported_is_looked_at_and_nothing_is_derived_from_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imported(tmp_path, TWO, "s3c")
    store, picture = str(tmp_path / "x.sgstore"), tmp_path / "graph.png"
    codes = [
        run(["info", store, "--trace", "graphs"]),
        run(["show", store, "graphs#0", "--graph", "-o", str(picture)]),
        run(["derive", store, "--name", "other"]),
    ]
    out, err = capsys.readouterr()

    assert codes == [0, 0, 2]
    assert "truck" in out
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "was imported as graphs" in err


def test_the_verb_imports_and_its_exit_code_says_what_was_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, odd = tmp_path / "two.csv", tmp_path / "odd.csv"
    file.write_text(TWO)
    odd.write_text(HEADER + "d,a,1,0,ego,guards,elf_1\n")
    store = str(tmp_path / "x.sgstore")
    codes = [
        run(["import", store, str(file), "--as", "s3c", "--json"]),
        run(["import", store, str(odd), "--as", "s3c"]),
        run(["import", store, str(odd), "--as", "s3c", "--unknown-as", "other"]),
        run(["import", store, str(odd), "--as", "s3c", "--kind", "elf"]),
    ]
    out, err = capsys.readouterr()

    assert codes == [0, 1, 3, 2]
    assert json.loads(out[: out.index("]") + 1])[0]["frames"] == 2
    assert "relation guards: 1 time, cannot be kept" in err
    assert "'elf' is an unknown kind" in err


# Values keep their types ------------------------------------------------------------------------------


def nodelink(folder: Path, name: str, *graphs: list[dict[str, Any]]) -> Path:
    """A file of graphs, each of some nodes; one near the other."""
    file = folder / f"{name}.jsonl"
    lines = [
        {
            "directed": True,
            "multigraph": True,
            "graph": {"name": f"{name}{i}", "t": i},
            "nodes": [{"id": str(n), "kind": "car"} | node for n, node in enumerate(nodes)],
            "links": [{"source": "0", "target": "1", "relation": "near", "w": nodes[0].get("n")}]
            if len(nodes) > 1
            else [],
        }
        for i, nodes in enumerate(graphs)
    ]
    file.write_text("".join(f"{json.dumps(line)}\n" for line in lines), encoding="utf-8")
    return file


def held(store: Store, frame: str, text: str, **values: Any) -> int:
    """How often a pattern is found in a graph in memory."""
    query = compile_query(text, store.file.catalog(), values).bound
    at = Binding(FrameView(store.file.graph(store.file.frame(frame).frame_id)))
    return sum(1 for _ in ScopeSearch(query.scope, injective=True).run(at))


LARGE = 2**53 + 1
"""No float is equal to it."""


def test_whole_numbers_that_no_float_is_equal_to_are_compared_and_given_exactly(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [[{"n": n}, {"n": n - 1}] for n in (LARGE, LARGE - 1, -LARGE, 7, 2**64 + 1)]
    path = tmp_path / "s.sgstore"
    (done,) = import_graphs(path, [nodelink(tmp_path, "a", *frames)], "nodelink")
    assert done.error is None
    store = Store(path)

    def seqs(condition: str, **values: Any) -> list[int]:
        text = (
            f"MATCH (a:Car)-[r:near]->(b:Car) WHERE {condition} RETURN frame.seq ORDER BY frame.seq"
        )
        found = [row[0] for row in store.find(text, **values)]
        assert found == [n for n in range(len(frames)) if held(store, f"a#{n}", text, **values)]
        return found

    assert seqs(f"a.n = {LARGE}") == [0]
    assert seqs("a.n = $n", n=LARGE - 1) == [1]
    assert seqs(f"a.n > {LARGE - 1}") == [0, 4]
    assert seqs(f"a.n = -{LARGE}") == [2]
    assert seqs(f"a.n IN [{LARGE}, 7]") == [0, 3]
    assert seqs("a.n > b.n") == [0, 1, 2, 3, 4]
    assert seqs("a.n = b.n") == []
    assert seqs(f"r.w = {LARGE}") == [0]
    rows = [row[0] for row in store.find("MATCH (a:Car)-[:near]->(b) RETURN a.n ORDER BY a.n")]
    assert rows == [-LARGE, 7, LARGE - 1, LARGE, 2**64 + 1]
    values = store.sql("SELECT value::VARCHAR FROM attributes WHERE name = 'n'").values
    assert {str(LARGE), str(2**64 + 1)} <= {value for (value,) in values}
    assert run(["find", str(path), f"MATCH (a:Car) WHERE a.n = {LARGE} RETURN a.n", "--json"]) == 0
    assert str(LARGE) in capsys.readouterr().out


@pytest.mark.parametrize(
    "text",
    [
        "MATCH (a:Car)-[r:near]->(b:Car) RETURN FIRST(a.n) OVER match",
        "MATCH (a:Car)-[r:near]->(b:Car) RETURN MAX(abs(a.n) + 1) OVER match",
        "MATCH (a:Car)-[r:near]->(b:Car) RETURN SUM(r.w) OVER match",
        f"MATCH (a:Car)-[r:near]->(b:Car) WHERE prev(a.n) = {LARGE}",
        "MATCH (a:Car)-[r:near]->(b:Car) RETURN frame.seq, delta(a.n, 1s)",
        f"CHECK c: FORALL (a:Car) ALWAYS prev(a.n) <> {LARGE}",
        f"CHECK c: FORALL (a:Car) ALWAYS a.n <> {LARGE} RETURN a.n",
    ],
)
def test_large_whole_numbers_over_time_are_exact_or_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "s.sgstore"
    frames = [[{"n": n}, {"n": n - 1}] for n in (LARGE, LARGE - 1, LARGE, LARGE + 1)]
    import_graphs(path, [nodelink(tmp_path, "a", *frames)], "nodelink")
    store = Store(path)

    with pytest.raises(QueryError, match=r"values of '[nw]' lie beyond 2\^53"):
        list(store.check(text) if text.startswith("CHECK") else store.find(text))


def test_conditions_on_large_whole_numbers_are_exact_in_each_frame(tmp_path: Path) -> None:
    path = tmp_path / "s.sgstore"
    frames = [[{"n": n}, {"n": n - 1}] for n in (LARGE, LARGE - 1, LARGE, LARGE + 1)]
    import_graphs(path, [nodelink(tmp_path, "a", *frames)], "nodelink")
    store = Store(path)

    query = f"MATCH (a:Car)-[:near]->(b:Car) WHERE prev(a.n = {LARGE}) RETURN frame.seq"
    assert [row[0] for row in store.find(query)] == [1, 3]
    query = f"MATCH (a:Car)-[:near]->(b:Car) RETURN MAX(CASE WHEN a.n = {LARGE} THEN 1 ELSE 0 END) OVER match"
    assert {row[0] for row in store.find(query)} == {1}
    later = f"THEN MATCH (a) WHERE a.n = {LARGE - 1}"
    query = f"MATCH (a:Car)-[:near]->(b:Car) WHERE a.n = {LARGE} {later} RETURN a.n"
    assert [row[0] for row in store.find(query)] == [LARGE - 1]
    (verdict,) = store.check(f"CHECK c: FORALL (a:Car) ALWAYS a.n <> {LARGE}")
    assert [(v.start_seq, v.values["a"]) for v in verdict.violations] == [
        (0, "car 0"),
        (3, "car 1"),
    ]


def test_a_text_in_one_file_leaves_the_numbers_of_others_numbers(tmp_path: Path) -> None:
    path = tmp_path / "s.sgstore"
    numbers = nodelink(tmp_path, "numbers", [{"q": 5}, {"q": 50}, {"q": 9}])
    texts = nodelink(tmp_path, "texts", [{"q": "n/a"}, {"q": "7"}])
    other = "MATCH (b:Car) WHERE b.q > 6 RETURN b.q ORDER BY b.q"
    for file in (numbers, texts):
        (done,) = import_graphs(path, [file], "nodelink")
        assert done.error is None
        store = Store(path)
        assert [row[0] for row in store.find("MATCH (b:Car) RETURN MAX(b.q)")] == [50]
        assert [row[0] for row in store.find(other)] == [9, 50]
        assert held(store, "numbers#0", other) == 2
    assert held(store, "texts#0", other) == 0
    kept = store.sql("SELECT text FROM attributes WHERE name = 'q' ORDER BY text").values
    assert [text for (text,) in kept] == ["5", "50", "7", "9", "n/a"]


def test_an_attribute_that_is_mixed_in_one_trace_is_text(tmp_path: Path) -> None:
    path = tmp_path / "s.sgstore"
    import_graphs(path, [nodelink(tmp_path, "mixed", [{"q": 5}, {"q": "n/a"}])], "nodelink")
    found = Store(path).find("MATCH (b:Car) WHERE b.q = 'n/a' RETURN b.q")
    assert [row[0] for row in found] == ["n/a"]


def test_an_imported_size_that_no_body_has_is_a_loss(tmp_path: Path) -> None:
    path = tmp_path / "s.sgstore"
    node = {"x": 1.0, "y": 2.0, "length": -4.5, "width": 2.0, "vx": 400.0, "vy": 0.0}
    (done,) = import_graphs(path, [nodelink(tmp_path, "a", [node])], "nodelink")
    assert {*done.lost} == {"length is -4.5 m: it", "speed is 400 m/s: it"}
    rows = Store(path).sql("SELECT length, width, vx FROM nodes WHERE kind = 'car'").values
    assert [tuple(row) for row in rows] == [(None, 2.0, None)]
