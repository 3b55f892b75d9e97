"""Exports of clips of a store: the laws of every format, and what each holds, against the store itself."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import networkx as nx
import numpy as np
import pyarrow.parquet as pq
import pytest
from thorough import LONG

import sgstore
from sgstore.apps.cli import run
from sgstore.apps.demo import RECORDING
from sgstore.errors import AbstractionError, ExportError, QueryError, TraceError
from sgstore.exporters import (
    EXPORTERS,
    Export,
    Exporter,
    Mount,
    WrittenFile,
    exporter_named,
    exporters,
    graphs_of,
    labelled,
    parse_labels,
    write_export,
)
from sgstore.exporters._clips import clip_name, export_folder, safe_name
from sgstore.exporters._pyg import ACTORS, RELATIONS, UNKNOWN
from sgstore.exporters.graph_data import GraphData
from sgstore.ingest import ingest
from sgstore.model.world import Clip

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(25)

FORMATS = [exporter.name for exporter in EXPORTERS if exporter.name not in {"rrd", "lance"}]
"""All but those of Rerun and Lance, which are large: test_export_rerun.py, test_clients.py."""
each_format = pytest.mark.parametrize("form", FORMATS)

S = 1_000_000_000
TEXTS = {
    "fast": "ego.speed > 8",
    "kmh": "ego.speed * 3.6",
    "people": "COUNT {(ego)-[:near|very_near|super_near|near_coll]->(:Person)}",
    "close": "MATCH (e:Ego)-[:near]->(:Person)",
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copy(RECORDING, tmp_path_factory.mktemp("recording") / "town.mcap"))


@pytest.fixture(scope="module")
def store(recording: Path) -> Iterator[Store]:
    path = recording.with_name("town.sgstore")
    ingest(path, [recording], until=27)
    store = sgstore.open(path)
    with store.file.snapshot():
        yield store


@pytest.fixture(scope="module")
def export(store: Store) -> Export:
    """Two clips that overlap, with labels."""
    clips = (Clip("town", 24 * S, 24 * S + S // 2), Clip("town", 24 * S + 3 * S // 10, 25 * S))
    return labelled(Export(store, clips, provenance={"query": "MATCH (e:Ego)"}), TEXTS)


@pytest.fixture(scope="module")
def progress() -> dict[Path, list[tuple[int, int]]]:
    """The progress calls of each export that ``written`` made."""
    return {}


@pytest.fixture(scope="module")
def written(
    export: Export,
    progress: dict[Path, list[tuple[int, int]]],
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[..., Path]:
    """The folder of an export, made once for each way of making it."""
    made: dict[tuple[str, ...], Path] = {}

    def folder(form: str, **options: Any) -> Path:
        key = (form, *map(str, options.items()))
        if key not in made:
            made[key] = tmp_path_factory.mktemp("exports") / form
            calls = progress.setdefault(made[key], [])
            options["progress"] = lambda *of: calls.append(of)
            write_export(replace(export, **options), made[key], form)
        return made[key]

    return folder


def files_of(folder: Path) -> dict[str, bytes]:
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def frames_in(export: Export) -> list[tuple[int, int]]:
    """Clip and frame_id of all frames, by a plain question to the store."""
    found: list[tuple[int, int]] = []
    for number, clip in enumerate(export.clips, 1):
        sql = (
            "SELECT frame_id FROM frames WHERE log_time_ns BETWEEN"
            f" {clip.start_ns} AND {clip.end_ns} ORDER BY frame_id"
        )
        found += [(number, row[0]) for row in export.store.sql(sql)]
    return found


# The laws of every format ----------------------------------------------------------------------------


@each_format
def test_the_same_export_is_the_same_bytes(
    export: Export, written: Callable[..., Path], tmp_path: Path, form: str
) -> None:
    if form == "duckdb":
        pytest.skip("DuckDB gives each file an identity of its own")
    write_export(export, tmp_path / "again", form)

    assert files_of(tmp_path / "again") == files_of(written(form))


@each_format
def test_a_manifest_tells_of_everything_that_is_there(
    export: Export, written: Callable[..., Path], form: str
) -> None:
    folder = written(form)
    manifest = json.loads((folder / "manifest.json").read_text())
    told = {item["file"]: item["sha256"] for item in manifest.get("files", manifest["clips"])}

    assert set(told) == {entry.name for entry in folder.iterdir()} - {"manifest.json"}
    for name, digest in told.items():
        if (folder / name).is_file():
            assert digest == hashlib.sha256((folder / name).read_bytes()).hexdigest()
        else:
            assert digest == ""
    assert manifest["tool"].startswith("sgstore ")
    assert [(c["start_ns"], c["end_ns"]) for c in manifest["clips"]] == [
        (clip.start_ns, clip.end_ns) for clip in export.clips
    ]
    provenance = manifest.get("provenance") or manifest["clips"][0]["provenance"]
    assert provenance["query_sha256"] == hashlib.sha256(b"MATCH (e:Ego)").hexdigest()


@each_format
def test_nothing_that_is_there_is_overwritten(
    export: Export, written: Callable[..., Path], tmp_path: Path, form: str
) -> None:
    names = sorted(entry.name for entry in written(form).iterdir())
    # Between them lie files that are written in the same way.
    tried = {names[0], names[-1], "manifest.json"} if LONG else {names[0], "manifest.json"}
    for number, name in enumerate(tried):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / name).write_text("mine")

        with pytest.raises(ExportError, match="exists already and is not overwritten"):
            write_export(export, folder, form)

        assert files_of(folder) == {name: b"mine"}


@each_format
def test_an_export_that_is_interrupted_leaves_nothing(
    export: Export, tmp_path: Path, form: str
) -> None:
    def interrupt(done: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_export(replace(export, progress=interrupt), tmp_path / "out", form)

    assert not (tmp_path / "out").exists()


@each_format
def test_the_progress_goes_up_to_the_end(
    written: Callable[..., Path], progress: dict[Path, list[tuple[int, int]]], form: str
) -> None:
    told = progress[written(form)]

    assert told[-1] == (2, 2)
    assert {of for _, of in told} == {2}


@each_format
def test_a_clip_without_frames_is_named_and_leaves_nothing(
    export: Export, tmp_path: Path, form: str
) -> None:
    empty = replace(export, clips=(Clip("town", 900 * S, 901 * S),), labels=None)

    with pytest.raises(ExportError, match="900000000000"):
        write_export(empty, tmp_path / "out", form)

    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def evil(recording: Path) -> Iterator[Store]:
    """A store with a trace that wants out."""
    path = recording.with_name("evil.sgstore")
    ingest(path, [recording], until=1.0)
    with duckdb.connect(str(path)) as connection:
        connection.execute("UPDATE inside.trace SET name = '../../../escaped/evil'")
    store = sgstore.open(path)
    with store.file.snapshot():
        yield store


@each_format
def test_traces_of_any_name_stay_in_the_folder(evil: Store, tmp_path: Path, form: str) -> None:
    folder = tmp_path / "deep" / "er" / "out"
    before = set(tmp_path.rglob("*"))

    write_export(Export(evil, (Clip("../../../escaped/evil", 0, S // 2),)), folder, form)

    new = set(tmp_path.rglob("*")) - before
    assert all(one.is_relative_to(tmp_path / "deep") for one in new)
    assert all(one.is_relative_to(folder) or one in folder.parents for one in new - {folder})


@each_format
def test_options_that_a_format_does_not_mind_are_refused(
    export: Export, tmp_path: Path, form: str
) -> None:
    ways = {
        "abstraction": "RSV",
        "with_graph": True,
        "mounts": (Mount("lidar", (0.0, 0.0, 1.75)),),
        "rebase_context": True,
        "graphml": True,
        "channels": ("/ego/lidar/points",),
        "clouds": "npy",
        "storage": "v1.2.0",
        "crs": "EPSG:32632",
    }
    minded = exporter_named(form).options
    for option in ways.keys() - minded:
        with pytest.raises(ExportError, match=f"cannot be used with the format '{form}'"):
            write_export(replace(export, **{option: ways[option]}), tmp_path / "out", form)
    assert minded <= ways.keys()
    assert not (tmp_path / "out").exists()


def test_an_export_under_way_has_no_manifest(tmp_path: Path) -> None:
    with export_folder(tmp_path) as work:
        (work / "table.csv").touch()
        (work / "manifest.json").touch()
        during = {entry.name for entry in tmp_path.iterdir()}

    assert not during & {"table.csv", "manifest.json"}
    assert {entry.name for entry in tmp_path.iterdir()} == {"table.csv", "manifest.json"}


@pytest.mark.parametrize("name", ["a.csv", "folder", "manifest.json"])
def test_what_came_into_being_meanwhile_is_not_overwritten(tmp_path: Path, name: str) -> None:
    def write() -> None:
        with export_folder(tmp_path) as work:
            for one in ("a.csv", "manifest.json"):
                (work / one).write_text("ours")
            (work / "folder").mkdir()
            (work / "folder" / "file").touch()
            (tmp_path / name).write_text("mine")

    with pytest.raises(ExportError):
        write()

    assert files_of(tmp_path) == {name: b"mine"}


def test_a_format_is_found_by_its_name_and_others_are_named() -> None:
    assert exporter_named("mcap") is EXPORTERS[0]
    with pytest.raises(ExportError, match="no export format 'mcp'; did you mean 'mcap'"):
        exporter_named("mcp")


def test_a_format_of_another_package_is_found(
    export: Export, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Point:
        name, value = "lines", "elsewhere:LINES"

        def load(self) -> Exporter:
            def write(export: Export, folder: Path) -> list[WrittenFile]:
                ids = [str(i) for frames in export.windows() for i in frames.frame_id]
                (folder / "lines.txt").write_text("\n".join(ids))
                return [WrittenFile.of(folder / "lines.txt", "frames", len(ids))]

            return Exporter("lines", write)

    class Broken(Point):
        name = "broken"

        def load(self) -> Exporter:
            raise ImportError("no module named elsewhere")

    monkeypatch.setattr("sgstore.base.plugins.entry_points", lambda group: [Point()])
    (file,) = write_export(export, tmp_path / "out", "lines")
    assert isinstance(file, WrittenFile)
    assert file.file.read_text().split() == [str(i) for _, i in frames_in(export)]
    assert list(exporters()) == [*(one.name for one in EXPORTERS), "lines"]

    monkeypatch.setattr("sgstore.base.plugins.entry_points", lambda group: [Broken()])
    with pytest.raises(ExportError, match=r"'broken' .* cannot be loaded: ImportError"):
        exporter_named("nothing")


@pytest.mark.parametrize(
    ("given", "said"),
    [(ZeroDivisionError("so many"), "ZeroDivisionError('so many')"), (["a.txt"], "got 'a.txt'")],
)
def test_a_format_that_breaks_is_told_by_its_name_in_one_line(
    given: Any, said: str, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    class Point:
        name, value = "lines", "elsewhere:LINES"

        def load(self) -> Exporter:
            def write(export: Export, folder: Path) -> Any:
                (folder / "lines.txt").touch()
                if isinstance(given, Exception):
                    raise given
                return given

            return Exporter("lines", write)

    monkeypatch.setattr("sgstore.base.plugins.entry_points", lambda group: [Point()])
    line = ["export", str(store.file.path), "MATCH (e:Ego)", "--as", "lines", "--to"]

    assert run([*line, str(tmp_path / "out")]) == 1
    (told,) = capsys.readouterr().err.splitlines()
    assert told.startswith("sgstore: the format 'lines' cannot be written: ")
    assert said in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("/ego/camera/front", "ego_camera_front"),
        ("../../etc/passwd", "etc_passwd"),
        ("C:\\Windows\\system32", "C_Windows_system32"),
        ("nul", "_nul"),
        ("\0", "sensor"),
        (".hidden", "hidden"),
    ],
)
def test_a_name_is_safe_whatever_a_sensor_is_called(text: str, name: str) -> None:
    assert safe_name(text, "sensor") == name


@pytest.mark.parametrize(
    ("trace", "name"),
    [
        ("swarm_Town04", "swarm_Town04_007.mcap"),
        ("../../etc/passwd", "etc_passwd_007.mcap"),
        ("a/b\\c:d\0e", "a_b_c_d_e_007.mcap"),
        ("CON", "_CON_007.mcap"),
        ("com1.txt", "_com1.txt_007.mcap"),
        ("...", "clip_007.mcap"),
        ("", "clip_007.mcap"),
        ("Größe", "Gr_e_007.mcap"),
        ("x" * 300, "x" * 80 + "_007.mcap"),
    ],
)
def test_a_clips_name_is_safe_whatever_the_trace_is_called(trace: str, name: str) -> None:
    assert clip_name(trace, 7, ".mcap") == name
    assert os.sep not in name


# Labels ----------------------------------------------------------------------------------------------


def test_labels_are_what_the_language_says_of_each_frame(export: Export) -> None:
    assert export.labels is not None
    ids = np.unique([frame_id for _, frame_id in frames_in(export)])
    near = {frame.frame_id for frame in export.store.find(TEXTS["close"]).frames()}
    values = export.labels.of(ids)

    for row, frame_id in enumerate(ids.tolist()):
        graph = export.store.graph(frame_id)
        speed = graph.nodes[graph.graph["ego"]]["speed"]
        assert values["fast"][row] is (speed > 8)
        assert values["kmh"][row] == pytest.approx(speed * 3.6)
        assert values["close"][row] is (frame_id in near)
    assert {type(value) for value in values["people"]} == {int}


def test_a_label_is_unknown_where_there_is_no_ego(tmp_path: Path) -> None:
    from recordings import Recorder, car

    path = tmp_path / "drive.mcap"
    with Recorder(path) as recorder:
        for i in range(4):
            recorder.ground_truth(i * 0.1, [car(7, i, v=(i, 0)), car(3, 9)])
    ingest(tmp_path / "s.sgstore", [path])
    store = sgstore.open(tmp_path / "s.sgstore")
    texts = {"speed": "ego.speed", "cars": "COUNT {(:Car)}"}

    labels = labelled(Export(store, (Clip("drive", 0, S),)), texts).labels

    assert labels is not None
    assert labels.values["speed"].tolist() == [None] * 4
    assert labels.values["cars"].tolist() == [2] * 4


def test_a_label_is_unknown_in_traces_that_cannot_answer(tmp_path: Path) -> None:
    from recordings import drive

    path = drive(tmp_path / "drive.mcap", frames=4)
    ingest(tmp_path / "s.sgstore", [path])
    store = sgstore.open(tmp_path / "s.sgstore")
    texts = {
        "query": "MATCH (:Ego)-[:leads]->(:Car)",
        "expression": "EXISTS {(ego)-[:leads]->(:Car)}",
        "known": "ego.speed > 1",
    }

    labels = labelled(Export(store, (Clip("drive", 0, S),)), texts).labels

    assert labels is not None
    assert labels.values["query"].tolist() == labels.values["expression"].tolist() == [None] * 4
    assert labels.values["known"].tolist() == [True] * 4


def test_a_label_may_look_ahead_beyond_its_clip(store: Store) -> None:
    text = "EXISTS {(ego)-[:near|very_near]->(:Person)}"
    export = labelled(
        Export(store, (Clip("town", 3 * S, 6 * S),)),
        {"now": text, "soon": f"EVENTUALLY[0s, 2s] {text}", "always": f"ALWAYS[0s, 1s] {text}"},
    )
    whole = labelled(Export(store, (Clip("town", 3 * S, 8 * S),)), {"now": text}).labels

    assert export.labels is not None
    assert whole is not None
    now = whole.values["now"].tolist()
    assert export.labels.values["now"].tolist() == now[:31]
    assert export.labels.values["soon"].tolist() == [any(now[i : i + 21]) for i in range(31)]
    assert export.labels.values["always"].tolist() == [all(now[i : i + 11]) for i in range(31)]
    assert 0 < sum(now) < len(now)


def test_a_label_may_be_a_value_over_each_match(store: Store) -> None:
    text = "MATCH (e:Ego) WHERE e.speed > 8 AS a THEN MATCH (e) WHERE e.speed < 8 RETURN MAX(e.speed) OVER a"
    fast = "MATCH (e:Ego) WHERE e.speed > 8 RETURN frame.seq, MAX(e.speed) OVER match AS top"
    clip = Export(store, (Clip("town", 0, 60 * S),))

    labels = labelled(clip, {"top": fast.replace("frame.seq, ", ""), "then": text}).labels

    assert labels is not None
    top = dict(map(tuple, store.find(fast)))
    seqs = (labels.frame_id >> 6) * 60 + (labels.frame_id & 63)
    first = [seq - seqs[0] for seq in seqs.tolist()]
    assert labels.values["top"].tolist() == [top.get(seq) for seq in first]
    (one, *_) = store.find(text.replace(" RETURN", " RETURN INTERVALS,"))
    told = {seq for seq, value in zip(first, labels.values["then"].tolist(), strict=True) if value}
    assert {*range(one.start_seq, one.end_seq + 1)} <= told
    near = "MATCH (e:Ego), (v:Vehicle) WHERE dist(e, v) < 40 RETURN MIN(dist(e, v)) OVER match"
    with pytest.raises(ExportError, match="matches overlap"):
        labelled(clip, {"d": near})


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("ego.sped > 5", QueryError),
        ("MATCH (e:Egg)", QueryError),
        ("ego.speed AS a, ego.x", ExportError),
        ("1) AS a, (2", ExportError),
    ],
)
def test_a_label_that_is_no_expression_is_refused(
    store: Store, text: str, error: type[Exception]
) -> None:
    with pytest.raises((error, QueryError)):
        labelled(Export(store, (Clip("town", 0, S),)), {"bad": text})


def test_labels_take_parameters(store: Store) -> None:
    labels = labelled(
        Export(store, (Clip("town", 0, S),)), {"fast": "ego.speed > $v"}, v=1000
    ).labels

    assert labels is not None
    assert set(labels.values["fast"].tolist()) == {False}


@pytest.mark.parametrize(
    "pair", ["fast", "=ego.speed", "a b=1", "fast=", "frame_id=1", "T=1", "../x=1", "a;b=1"]
)
def test_a_name_of_a_label_is_a_name_of_a_column(pair: str) -> None:
    with pytest.raises(ExportError):
        parse_labels([pair])


def test_labels_keep_their_texts_and_names_differ() -> None:
    assert parse_labels(["a=b = c", "d=1"]) == {"a": "b = c", "d": "1"}
    with pytest.raises(ExportError, match="another name"):
        parse_labels(["a=1", "A=2"])


# The graphs ------------------------------------------------------------------------------------------


def test_graphs_of_a_window_are_those_of_the_store(export: Export) -> None:
    with export.store.file.snapshot():
        for frames in export.windows():
            for graph in graphs_of(export, frames):
                single = export.store.file.graph(graph.frame_id)
                key = [edge[:3] for edge in single.edges]
                assert replace(graph, edges=[]) == replace(single, edges=[])
                assert sorted(graph.edges, key=lambda edge: edge[:3]) == sorted(
                    single.edges, key=lambda edge: edge[:3]
                )
                assert len(set(key)) == len(key) > 50


# Tables ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", ["frames", "nodes", "edges", "payloads"])
def test_a_table_of_parquet_is_the_view_of_the_store(
    export: Export, written: Callable[..., Path], table: str
) -> None:
    found = pq.read_table(written("parquet") / f"{table}.parquet")
    rows = found.to_pylist()
    clips = frames_in(export)

    assert sorted({(row["clip"], row["frame_id"]) for row in rows}) == clips
    first = [row for row in rows if row["clip"] == 1]
    ids = ", ".join(str(frame_id) for clip, frame_id in clips if clip == 1)
    view = export.store.sql(f"SELECT * FROM {table} WHERE frame_id IN ({ids})").dicts()
    names = [name for name in view[0] if name != "gap"]

    def key(row: dict[str, Any]) -> list[str]:
        """The values as texts; the view gives the shortest text of a number of 32 bits."""
        values = [row[name] for name in names]
        return [str(np.float32(v) if isinstance(v, float) else v) for v in values]

    assert sorted(map(key, first)) == sorted(map(key, view))


def test_parquet_has_labels_lanes_and_gaps(export: Export, written: Callable[..., Path]) -> None:
    folder = written("parquet")
    frames = pq.read_table(folder / "frames.parquet").to_pylist()
    edges = pq.read_table(folder / "edges.parquet").to_pylist()

    assert export.labels is not None
    for row in frames:
        labels = {name: of[0] for name, of in export.labels.of(np.array([row["frame_id"]])).items()}
        assert {name: row[name] for name in TEXTS} == labels
    graphs = {
        frame_id: {edge[:3]: edge[3] for edge in export.store.file.graph(frame_id).edges}
        for frame_id in {row["frame_id"] for row in frames[:5]}
    }
    about = [row for row in edges if row["frame_id"] in graphs and row["clip"] == 1]
    attributes = ("overlap", "lane_offset", "heading_error", "is_primary", "along", "gap")
    assert about
    for row in about:
        known = graphs[row["frame_id"]][row["src"], row["relation"], row["dst"]]
        assert {k: row[k] for k in attributes if row[k] is not None} == {
            k: v for k, v in known.items() if k in attributes
        }


def test_parquet_says_who_is_who(export: Export, written: Callable[..., Path]) -> None:
    folder = written("parquet")
    entities = pq.read_table(folder / "entities.parquet").to_pylist()
    nodes = pq.read_table(folder / "nodes.parquet").to_pylist()

    present = {(row["clip"], row["node_id"]) for row in nodes if row["node_id"] >= 0}
    assert [(row["clip"], row["node_id"]) for row in entities] == sorted(present)
    told = export.store.sql("SELECT ident, type_name, kind FROM entities").dicts()
    known = {tuple(row.values()) for row in told}
    assert {(row["ident"], row["type_name"], row["kind"]) for row in entities} <= known


def test_parquet_says_what_its_columns_are_and_is_a_data_set(
    written: Callable[..., Path],
) -> None:
    folder = written("parquet")
    fields = json.loads((folder / "fields.json").read_text(encoding="utf-8"))
    card = (folder / "README.md").read_text(encoding="utf-8")

    tables = sorted(path.stem for path in folder.glob("*.parquet"))
    assert sorted(fields) == tables
    for table in tables:
        told = [column["name"] for column in fields[table]["columns"]]
        assert told == pq.read_schema(folder / f"{table}.parquet").names
        assert fields[table]["about"].startswith(("One row", "How", "The message"))
        assert f"- config_name: {table}\n  data_files: {table}.parquet\n" in card
    units = {c["name"]: c.get("unit") for c in fields["nodes"]["columns"]}
    assert (units["speed"], units["yaw_rate"], units["kind"]) == ("m/s", "degrees/s", None)
    assert card.startswith("---\n")


# OpenLABEL -------------------------------------------------------------------------------------------


def test_openlabel_has_everybody_in_every_frame_with_boxes_and_relations(
    export: Export, written: Callable[..., Path]
) -> None:
    folder = written("openlabel")
    ids = [frame_id for clip, frame_id in frames_in(export) if clip == 1]
    told = json.loads((folder / "town_001.openlabel.json").read_text(encoding="utf-8"))
    told = told["openlabel"]

    named = {node: one["name"] for node, one in told["objects"].items()}
    known = export.store.sql("SELECT node_id, ident FROM entities").dicts()
    assert named.items() <= {str(one["node_id"]): one["ident"] for one in known}.items()
    for frame_id in ids[:: max(len(ids) // 8, 1)]:
        graph = export.store.file.graph(frame_id)
        frame = told["frames"][str(graph.seq)]
        there = {node: about for node, about in graph.nodes.items() if node >= 0}
        assert {*map(int, frame["objects"])} == {*there}
        assert frame["frame_properties"]["labels"].keys() == TEXTS.keys()
        for node, about in there.items():
            held = frame["objects"][str(node)] or told["objects"][str(node)]
            (box,) = held["object_data"]["cuboid"]
            x, y, z, _, _, qz, qw, *size = box["val"]
            assert (x, y, z) == pytest.approx([about[key] for key in "xyz"], abs=6e-5)
            assert size == pytest.approx(
                [about[k] for k in ("length", "width", "height")], abs=1e-5
            )
            if not about.get("pitch") and not about.get("roll"):
                turn = math.remainder(
                    2 * math.atan2(qz, qw) - math.radians(about["heading"]), math.tau
                )
                assert turn == pytest.approx(0, abs=1e-5)
        held = {
            (int(r["rdf_subjects"][0]["uid"]), r["type"], int(r["rdf_objects"][0]["uid"]))
            for r in told["relations"].values()
            if any(s["frame_start"] <= graph.seq <= s["frame_end"] for s in r["frame_intervals"])
        }
        assert held == {edge[:3] for edge in graph.edges if edge[0] >= 0 and edge[2] >= 0}


@pytest.mark.data
def test_openlabel_is_valid_by_its_schema(data: Path, written: Callable[..., Path]) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((data / "schemas/openlabel_1.0.0.json").read_text(encoding="utf-8"))
    check = jsonschema.Draft7Validator(schema)

    for file in written("openlabel").glob("*.openlabel.json"):
        faults = check.iter_errors(json.loads(file.read_text(encoding="utf-8")))
        assert next(faults, None) is None


# networkx --------------------------------------------------------------------------------------------


def test_networkx_reads_the_graphs_of_the_store(
    export: Export, written: Callable[..., Path]
) -> None:
    folder = written("nx", graphml=True)
    lines = (folder / "town_001.jsonl").read_text().splitlines()
    ids = [frame_id for clip, frame_id in frames_in(export) if clip == 1]

    assert len(lines) == len(ids)
    for line, frame_id in zip(lines, ids, strict=True):
        graph = nx.node_link_graph(json.loads(line), edges="edges")
        again = export.store.graph(frame_id)
        assert (graph.nodes, graph.adj) == (again.nodes, again.adj)
        assert graph.graph["label_fast"] in {True, False}
        drawn = nx.read_graphml(
            folder / "town_001" / f"{graph.graph['seq']:06d}.graphml",
            node_type=int,
            force_multigraph=True,
        )
        assert set(drawn.edges(keys=True)) == set(graph.edges(keys=True))
        assert drawn.nodes[0]["kind"] == graph.nodes[0]["kind"]
        assert drawn.graph["label_kmh"] == pytest.approx(graph.graph["label_kmh"])


def test_graphml_is_written_where_it_is_asked_for(written: Callable[..., Path]) -> None:
    assert not [*written("nx").rglob("*.graphml")]
    with pytest.raises(
        ExportError, match="--graphml cannot be used with the format 'parquet'; add --as nx"
    ):
        written("parquet", graphml=True)


def test_networkx_reads_graphs_as_an_abstraction_has_them(
    export: Export, written: Callable[..., Path]
) -> None:
    folder = written("nx", abstraction="RSV", labels=None)
    line = (folder / "town_002.jsonl").read_text().splitlines()[3]
    graph = nx.node_link_graph(json.loads(line), edges="edges")

    again = export.store.graph(graph.graph["frame_id"], "RSV")

    assert (graph.nodes, graph.adj) == (again.nodes, again.adj)
    assert graph.graph["abstraction"] == "RSV"


def test_an_abstraction_that_is_none_is_named(export: Export, tmp_path: Path) -> None:
    for form in ("nx", "pyg", "s3c"):
        with pytest.raises(AbstractionError, match="RVS"):
            write_export(replace(export, abstraction="RVS"), tmp_path / form, form)
        assert not (tmp_path / form).exists()


# S3C -------------------------------------------------------------------------------------------------


def test_rows_of_s3c_are_the_edges_of_the_abstraction(
    export: Export, written: Callable[..., Path]
) -> None:
    rows = rows_of(written("s3c") / "graphs.csv")
    labels = rows_of(written("s3c") / "labels.csv")
    names = {f"town#{export.store.file.frame(i).seq}": i for i in {i for _, i in frames_in(export)}}

    assert list(rows[0]) == ["ds", "sg", "n_img", "t_id", "node1", "edge", "node2"]
    assert {row["sg"] for row in rows} == set(names) == {row["sg"] for row in labels}
    for name in list(names)[::7]:
        graph = export.store.graph(names[name], "RSV")
        mine = [row for row in rows if row["sg"] == name]
        assert sorted((r["node1"], r["edge"], r["node2"]) for r in mine) == sorted(
            (a, label, b) for a, b, label in graph.edges.data("label")
        )
        assert [int(row["t_id"]) for row in mine] == list(range(len(mine)))
    assert len(labels) == len(names)
    assert set(labels[0]) == {"sg", *TEXTS}


def test_nodes_that_no_row_can_hold_are_a_note(export: Export, tmp_path: Path) -> None:
    (file, *_) = write_export(replace(export, abstraction="E"), tmp_path / "out", "s3c")

    assert "nodes without an edge" in file.notes[0]
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert manifest["files"][0]["notes"] == [*file.notes]
    assert file.losses == ()


# Graphs to learn from --------------------------------------------------------------------------------


def test_graphs_to_learn_from_are_those_of_the_abstraction(
    export: Export, written: Callable[..., Path]
) -> None:
    data = GraphData(written("pyg"))
    assert data.about["format"] == "sgstore.graphs"
    lanes = {"Left Lane": "lane", "Middle Lane": "lane", "Right Lane": "lane", "Root Road": "road"}

    assert data.about["node_types"] == list(ACTORS)
    assert data.about["relations"] == list(RELATIONS)
    assert [int(i) for i in data.columns["frame_id"]] == [i for _, i in frames_in(export)]
    for number in range(0, len(data), 5):
        arrays = data.arrays(number)
        graph = export.store.graph(int(arrays["frame_id"]), "roadscene2vec")
        kinds = [lanes.get(kind, kind) for _, kind in graph.nodes.data("base_class")]
        assert sorted(ACTORS[kind] for kind in arrays["node_type"]) == sorted(kinds)
        named = {
            (_of_node(arrays, a), RELATIONS[kind], _of_node(arrays, b))
            for (a, b), kind in zip(arrays["edge_index"].T, arrays["edge_type"], strict=True)
        }
        assert named == {
            (_of_name(graph, a), label, _of_name(graph, b))
            for a, b, label in graph.edges.data("label")
        }


def test_nodes_to_learn_from_have_the_names_of_the_simulator(
    export: Export, written: Callable[..., Path]
) -> None:
    data = GraphData(written("pyg"))
    sql = "SELECT node_id, ident, type_name FROM entities"
    known = {node: (ident, kind) for node, ident, kind in export.store.sql(sql)}

    for number in (0, len(data) - 1):
        nodes = data.arrays(number)["node_id"].tolist()
        assert data.identities(number) == [known.get(node, ("", "")) for node in nodes]
    with pytest.raises(IndexError):
        data.identities(len(data))


def _of_node(arrays: dict[str, Any], row: int) -> tuple[str, int]:
    kind, node = ACTORS[arrays["node_type"][row]], int(arrays["node_id"][row])
    return kind, node if node >= 0 and kind != "ego_car" else -1


def _of_name(graph: nx.MultiDiGraph, name: str) -> tuple[str, int]:
    kind = graph.nodes[name]["base_class"]
    if kind in {"Left Lane", "Middle Lane", "Right Lane"}:
        return "lane", -1
    if kind == "Root Road":
        return "road", -1
    return kind, -1 if kind == "ego_car" else int(name.rpartition("_")[2])


def test_places_are_as_the_ego_sees_them(export: Export, written: Callable[..., Path]) -> None:
    data = GraphData(written("pyg"))
    arrays = data.arrays(4)
    pairs = export.store.sql(
        f"SELECT dst, lon, lat, rel_heading FROM pairs WHERE src_is_ego AND frame_id = {arrays['frame_id']}"
    )
    rows = {int(node): row for row, node in enumerate(arrays["node_id"])}

    checked = 0
    for dst, lon, lat, turned in pairs:
        if dst in rows:
            ahead, left, _, heading = arrays["node_feature"][rows[dst]]
            assert (ahead, left) == pytest.approx((lon, lat), abs=1e-3)
            assert np.cos(heading - np.radians(turned)) == pytest.approx(1, abs=1e-6)
            checked += 1
    assert checked > 3


def test_unknown_places_are_those_of_the_map(written: Callable[..., Path]) -> None:
    data = GraphData(written("pyg"))
    types = np.array(data.about["node_types"])[data.columns["node_type"]]
    unknown = np.isnan(data.columns["node_feature"])

    assert set(types[unknown.all(axis=1)]) == {"lane", "road", "sign"} & set(types)
    assert (unknown.all(axis=1) == unknown.any(axis=1)).all()
    told = {feature["unknown"] for feature in data.about["node_features"]}
    assert told == {UNKNOWN}
    assert "lanes, roads and signs" in UNKNOWN


def test_labels_to_learn_are_numbers(export: Export, written: Callable[..., Path]) -> None:
    data = GraphData(written("pyg"))

    assert export.labels is not None
    values = export.labels.of(np.array(data.columns["frame_id"]))
    for name in ("fast", "kmh", "people", "close"):
        assert data.columns[f"label_{name}"].tolist() == pytest.approx(
            [float(v) for v in values[name]]
        )
    assert data.about["labels"]["fast"] == {"text": TEXTS["fast"], "kind": "bool", "words": []}
    assert [list(clip) for clip in data.sequences()] == [list(range(6)), list(range(6, 14))]
    assert data.by_trace() == {"town": list(range(14))}


def test_words_and_unknown_labels_are_numbers_too(store: Store, tmp_path: Path) -> None:
    export = labelled(
        Export(store, (Clip("town", 0, S),)),
        {"word": "coalesce(ego.special, 'none')", "missing": "ego.special", "up": "upper('b')"},
    )
    write_export(export, tmp_path / "out", "pyg")
    data = GraphData(tmp_path / "out")

    assert data.about["labels"]["word"]["words"] == ["none"]
    assert data.about["labels"]["up"]["words"] == ["B"]
    assert np.isnan(data.columns["label_missing"]).all()
    assert set(data.columns["label_word"].tolist()) == {0.0}


@pytest.mark.parametrize("abstraction", ["E", "ER", "RSV", "SG"])
def test_any_abstraction_can_be_learned_from(
    export: Export, written: Callable[..., Path], abstraction: str
) -> None:
    data = GraphData(written("pyg", abstraction=abstraction))
    arrays = data.arrays(7)
    graph = export.store.graph(int(arrays["frame_id"]), abstraction)
    types, relations = data.about["node_types"], data.about["relations"]

    assert types == sorted(types)
    assert sorted(types[kind] for kind in arrays["node_type"]) == sorted(
        kind for _, kind in graph.nodes.data("base_class")
    )
    mine = [
        (types[arrays["node_type"][a]], relations[kind], types[arrays["node_type"][b]])
        for (a, b), kind in zip(arrays["edge_index"].T, arrays["edge_type"], strict=True)
    ]
    kinds = dict(graph.nodes.data("base_class"))
    assert sorted(mine) == sorted(
        (kinds[a], of, kinds[b]) for a, b, of in graph.edges.data("label")
    )


def test_graphs_that_were_hurt_are_refused(written: Callable[..., Path], tmp_path: Path) -> None:
    for number, (name, hurt) in enumerate(
        [
            ("graphs.json", lambda file: file.write_text("{}")),
            ("graphs.json", lambda file: file.write_text("[1]")),
            ("graphs.json", Path.unlink),
            ("graphs/node_type.npy", lambda file: file.write_bytes(b"\x80\x04.")),
            ("graphs/edge_index.npy", lambda file: np.save(file, np.full((9, 2), 77, np.int32))),
            ("graphs/node_ptr.npy", lambda file: np.save(file, np.arange(15)[::-1])),
            ("graphs/edge_type.npy", Path.unlink),
        ]
    ):
        folder = Path(shutil.copytree(written("pyg"), tmp_path / str(number)))
        hurt(folder / name)

        with pytest.raises(ExportError):
            GraphData(folder).check()


def test_a_recording_that_was_replaced_is_refused(recording: Path, tmp_path: Path) -> None:
    own = Path(shutil.copy(recording, tmp_path / "own.mcap"))
    ingest(tmp_path / "s.sgstore", [own], until=1.0)
    own.write_bytes(own.read_bytes() + b"\0")
    export = Export(sgstore.open(tmp_path / "s.sgstore"), (Clip("own", 0, S // 2),))

    for form in ("mcap", "frames"):
        with pytest.raises(ExportError, match="has changed since it was ingested"):
            write_export(export, tmp_path / form, form)
    own.unlink()
    for form in ("mcap", "frames"):
        with pytest.raises((ExportError, TraceError)):
            write_export(export, tmp_path / form, form)


# Out and in again ------------------------------------------------------------------------------------


def test_rows_of_s3c_come_in_again_as_the_same_classes(store: Store, tmp_path: Path) -> None:
    from sgstore.pipeline.importing import import_graphs

    export = Export(store, (Clip("town", 5 * S, 8 * S), Clip("town", 24 * S, 24 * S)))
    write_export(export, tmp_path / "out", "s3c")
    import_graphs(tmp_path / "again.sgstore", [tmp_path / "out" / "graphs.csv"], "s3c")
    ids = [frame_id for _, frame_id in frames_in(export)]
    # A node without any edge stands in no row.
    whole = [all(dict(store.graph(i, "RSV").degree()).values()) for i in ids]

    classes = dict(zip(*store.classes("RSV").values(), strict=True))
    found = sgstore.open(tmp_path / "again.sgstore").classes("RSV")["class"].tolist()

    assert 20 < sum(whole) < len(whole)
    assert [classes[i] == mine for i, mine in zip(ids, found, strict=True)] == whole


def test_lines_of_networkx_come_in_again_as_the_same_graphs(
    export: Export, written: Callable[..., Path], tmp_path: Path
) -> None:
    from sgstore.pipeline.importing import import_graphs

    import_graphs(tmp_path / "again.sgstore", [written("nx") / "town_001.jsonl"], "nodelink")
    again = sgstore.open(tmp_path / "again.sgstore")
    ids = [frame_id for clip, frame_id in frames_in(export) if clip == 1]
    # Classes that are asked for are kept, and nobody writes to a store that stays open.
    own = sgstore.open(shutil.copy(export.store.file.path, tmp_path / "own.sgstore"))

    for abstraction in ("E", "SG"):
        classes = dict(zip(*own.classes(abstraction).values(), strict=True))
        assert again.classes(abstraction)["class"].tolist() == [classes[i] for i in ids]
