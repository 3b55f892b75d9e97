"""Files for other clients: DuckDB of older versions, Lance, GeoJSON; and the clients that are installed."""

from __future__ import annotations

import json
import os
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import pytest
from client_matrix import answer
from clients import CLIENTS
from recordings import drive

import sgstore
from sgstore.apps.cli import run
from sgstore.apps.demo import RECORDING
from sgstore.errors import ExportError
from sgstore.exporters import Export, labelled, whole_clips, write_export
from sgstore.exporters._geojson import _projection
from sgstore.ingest import ingest
from sgstore.model.world import Clip
from sgstore.testsets.scenes import phrases

if TYPE_CHECKING:
    from sgstore.query import Store

S = 1_000_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("clients")
    ingest(place / "town.sgstore", [RECORDING], until=4)
    return place


@pytest.fixture(scope="module")
def store(folder: Path) -> Store:
    return sgstore.open(folder / "town.sgstore")


@pytest.fixture(scope="module")
def scenes(store: Store, folder: Path) -> Path:
    """A database of all frames."""
    whole = Export(store, tuple(whole_clips(store)))
    write_export(whole, folder / "duckdb", "duckdb")
    return folder / "duckdb" / "scenes.duckdb"


def views_of(path: Path, where: str = "") -> dict[str, Any]:
    """Number and hashes of the rows of each view; of those with frames only the chosen ones."""
    found: dict[str, Any] = {}
    with duckdb.connect(str(path), read_only=True) as connection:
        sql = "SELECT view_name FROM duckdb_views() WHERE NOT internal AND schema_name = 'main'"
        for (name,) in connection.execute(sql).fetchall():
            columns = [row[0] for row in connection.execute(f"DESCRIBE {name}").fetchall()]
            own = where if "frame_id" in columns else ""
            rows = f"SELECT count(*), sum(hash(v::VARCHAR)) FROM (FROM {name} {own}) v"
            found[name] = (columns, connection.execute(rows).fetchall())
    return found


def test_a_database_has_the_rows_of_all_views(store: Store, scenes: Path) -> None:
    store.close()

    assert views_of(scenes) == views_of(store.file.path)


def test_a_database_of_clips_has_the_rows_of_their_frames_and_the_labels(
    store: Store, tmp_path: Path
) -> None:
    clips = (
        Clip("town", 1 * S, 2 * S),
        Clip("town", 2 * S - S // 2, 3 * S),
        Clip("town", 3 * S + S // 2, 4 * S),
    )
    export = labelled(Export(store, clips), {"fast": "ego.speed > 8", "kmh": "ego.speed * 3.6"})
    write_export(export, tmp_path / "out", "duckdb")
    path = tmp_path / "out" / "scenes.duckdb"
    store.close()
    chosen = (
        "WHERE frame_id IN (SELECT frame_id FROM frames WHERE log_time_ns BETWEEN 1e9 AND 3e9"
        " OR log_time_ns BETWEEN 35e8 AND 4e9)"
    )
    found, expected = views_of(path), views_of(store.file.path, chosen)

    assert found == expected
    with duckdb.connect(str(path), read_only=True) as connection:
        labels = connection.execute("SELECT frame_id, fast, kmh FROM labels ORDER BY 1").fetchall()
    frames = store.sql(f"SELECT frame_id FROM frames {chosen} ORDER BY frame_id").values
    rows = dict(store.find("MATCH (e:Ego) RETURN frame.id, e.speed").rows())
    assert [row[0] for row in labels] == [frame for (frame,) in frames]
    assert all(
        fast == (rows[f] > 8) and kmh == pytest.approx(rows[f] * 3.6) for f, fast, kmh in labels
    )


@pytest.mark.parametrize(("storage", "tag"), [("v1.0.0", "v1.0.0"), ("v1.2.0", "v1.2.0")])
def test_the_file_has_the_storage_version(
    folder: Path, tmp_path: Path, storage: str, tag: str
) -> None:
    store = str(folder / "town.sgstore")
    query = "MATCH (e:Ego) WHERE frame.t < 1"
    command = ["export", store, query, "--as", "duckdb", "--storage", storage]
    assert run([*command, "--to", str(tmp_path / "out")]) == 0
    with duckdb.connect() as connection:
        connection.execute(f"ATTACH '{tmp_path / 'out' / 'scenes.duckdb'}' AS s (READ_ONLY)")
        sql = "SELECT tags['storage_version'] FROM duckdb_databases() WHERE database_name = 's'"
        ((found,),) = connection.execute(sql).fetchall()

    assert found.startswith(tag)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--as", "duckdb", "--storage", "1"], "expected v1.0.0, v1.2.0, …"),
        (
            ["--as", "duckdb", "--storage", "v9.0.0"],
            "cannot write the storage version 'v9.0.0'",
        ),
        (["--as", "parquet", "--storage", "v1.2.0"], "--storage cannot be used"),
        (["--as", "geojson", "--crs", "EPSG:0"], "coordinate system 'EPSG:0' is unknown"),
        (["--as", "mcap"], "the format 'mcap' copies recordings; add a query"),
        (["--as", "frames"], "the format 'frames' copies recordings; add a query"),
    ],
)
def test_a_wrong_option_is_refused_and_nothing_is_written(
    folder: Path, tmp_path: Path, options: list[str], reason: str, capsys: Any
) -> None:
    command = ["export", str(folder / "town.sgstore"), *options, "--to", str(tmp_path / "out")]

    assert run(command) != 0
    assert reason in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("form", ["pyg", "nx", "s3c", "openlabel"])
def test_an_export_without_a_query_has_all_frames(folder: Path, tmp_path: Path, form: str) -> None:
    command = ["export", str(folder / "town.sgstore"), "--as", form]

    assert run([*command, "--to", str(tmp_path / "out")]) == 0
    about = json.loads((tmp_path / "out" / "manifest.json").read_text())
    (clip,) = about["clips"]
    assert clip["trace"] == "town"
    assert clip["end_ns"] - clip["start_ns"] == 4 * S


def features(file: Path) -> list[dict[str, Any]]:
    return json.loads(file.read_text(encoding="utf-8"))["features"]


def test_geojson_has_each_box_in_metres_and_a_note(
    folder: Path, store: Store, tmp_path: Path, capsys: Any
) -> None:
    command = ["export", str(folder / "town.sgstore"), "MATCH (e:Ego) WHERE frame.t < 1"]
    assert run([*command, "--after", "0s", "--as", "geojson", "--to", str(tmp_path / "o")]) == 0
    found = features(tmp_path / "o" / "town_001.geojson")
    rows = store.sql(
        "SELECT frame_id, node_id, x, y FROM nodes WHERE node_id >= 0 AND frame_id IN"
        " (SELECT frame_id FROM frames WHERE t < 1) ORDER BY frame_id, node_id"
    ).values

    assert "it has no coordinate system; --crs EPSG:32632 sets one" in capsys.readouterr().err
    keys = [(int(f["properties"]["frame_id"]), f["properties"]["node_id"]) for f in found]
    assert keys == [row[:2] for row in rows]
    for one, (_, _, x, y) in zip(found, rows, strict=True):
        shape = one["geometry"]["coordinates"]
        points = np.array(shape[0][:4] if one["geometry"]["type"] == "Polygon" else [shape])
        assert np.allclose(points.mean(axis=0), (x, y), atol=2e-3)
    lanes = features(tmp_path / "o" / "map_town.geojson")
    named = {f["properties"].get("name") for f in lanes if f["properties"]["kind"] == "lane"}
    assert named == {name for (name,) in store.sql("SELECT name FROM lanes").values}


def test_an_entity_without_a_place_is_no_feature(tmp_path: Path) -> None:
    graph = {"directed": True, "multigraph": True, "links": []}
    places = ({"x": 3.0, "y": 4.0}, {"x": 3.0})
    graph["nodes"] = [{"id": i, "kind": "car", **place} for i, place in enumerate(places)]
    (tmp_path / "one.jsonl").write_text(json.dumps(graph))
    store = str(tmp_path / "one.sgstore")
    assert run(["import", store, str(tmp_path / "one.jsonl"), "--as", "nodelink"]) == 0
    assert run(["export", store, "--as", "geojson", "--to", str(tmp_path / "out")]) == 0
    (found,) = features(tmp_path / "out" / "one_001.geojson")

    assert found["geometry"]["coordinates"] == [3.0, 4.0]


def test_coordinates_are_longitude_and_latitude_with_a_coordinate_system(
    folder: Path, tmp_path: Path
) -> None:
    pyproj = pytest.importorskip("pyproj")
    command = ["export", str(folder / "town.sgstore"), "MATCH (e:Ego) WHERE frame.t < 0.5"]
    for number, more in enumerate(([], ["--crs", "EPSG:32632"])):
        to = ["--as", "geojson", "--to", str(tmp_path / f"{number}")]
        assert run([*command, *to, *more]) == 0
    local, there = (features(tmp_path / f"{n}" / "town_001.geojson") for n in (0, 1))
    utm = pyproj.Proj(proj="utm", zone=32, ellps="WGS84")
    for one, other in zip(local[:20], there[:20], strict=True):
        point = utm(*np.ravel(one["geometry"]["coordinates"])[:2], inverse=True)
        assert np.allclose(np.ravel(other["geometry"]["coordinates"])[:2], point, atol=1e-7)


def test_the_reference_and_offset_of_opendrive_count() -> None:
    pytest.importorskip("pyproj")
    text = (
        "<header><geoReference><![CDATA[+proj=tmerc +lat_0=48.8 +lon_0=9.2 +datum=WGS84]]>"
        '</geoReference><offset x="0" y="1000" z="0" hdg="1.5707963267948966"/></header>'
    )
    placed, note = _projection(text, "")
    assert placed is not None
    east, north = placed(np.array([[0.0, 0.0], [100.0, 0.0]]))

    assert note == ""
    assert np.allclose(east, (9.2, 48.8 + 1000 / 111_200), atol=1e-4)
    assert north[0] == pytest.approx(9.2, abs=1e-6)
    assert (north[1] - east[1]) * 111_200 == pytest.approx(100, abs=0.3)


def test_without_pyproj_the_note_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyproj", None)

    assert _projection("", "EPSG:32632") == (
        None,
        "coordinates are metres in the axes of the road map: longitude and latitude need pyproj:"
        " pip install 'sgstore[geo]'",
    )


def test_lance_has_the_tables(store: Store, tmp_path: Path) -> None:
    lance = pytest.importorskip("lance")
    write_export(Export(store, (Clip("town", 0, S),)), tmp_path / "out", "lance")
    nodes = lance.dataset(str(tmp_path / "out" / "nodes.lance")).to_table()

    assert (
        nodes.num_rows
        == store.sql(
            "SELECT count(*) FROM nodes WHERE frame_id IN (SELECT frame_id FROM frames WHERE t <= 1)"
        ).values[0][0]
    )


def test_lance_names_its_extra(store: Store, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setitem(sys.modules, "lance", None)
    with pytest.raises(sgstore.MissingExtraError, match=r"sgstore\[lance\]"):
        write_export(Export(store, (Clip("town", 0, S),)), tmp_path / "out", "lance")
    assert not (tmp_path / "out").exists()


def installed(name: str) -> bool:
    client = CLIENTS[name]
    version = client.packages[0].partition("==")[2].rstrip("*")
    if name.startswith("duckdb") and not duckdb.__version__.startswith(version):
        return False
    if name == "spark" and not (shutil.which("java") and os.environ.get("SGSTORE_LONG")):
        return False
    try:
        return all(find_spec(module) for module in client.modules)
    except ModuleNotFoundError:
        return False


@pytest.mark.parametrize("name", [name for name in CLIENTS if installed(name)])
def test_a_client_reads_the_export(name: str, store: Store, scenes: Path, folder: Path) -> None:
    tables = folder / "parquet"
    if not tables.exists():
        write_export(Export(store, tuple(whole_clips(store))), tables, "parquet")
    store.close()

    assert answer(sys.executable, CLIENTS[name], folder) == "41"


def test_every_client_has_a_program() -> None:
    assert {name.split()[0] for name in CLIENTS} == {
        *("duckdb", "ibis", "dbt", "pandas", "polars", "datasets", "spark", "sqlalchemy", "lance")
    }


def test_an_altered_store_is_refused(folder: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(folder / "town.sgstore", tmp_path / "s.sgstore"))
    store = sgstore.open(path)
    with pytest.raises(ExportError, match="storage version"):
        store.file.write_portable(tmp_path / "x", np.array([1]), "x'y", {})
    assert not (tmp_path / "x").exists()


def printed(capsys: Any, *command: str) -> tuple[str, str]:
    assert run([*command]) == 0
    return capsys.readouterr()


def test_a_table_shows_names_of_returned_nodes_and_json_their_ids(
    folder: Path, capsys: Any
) -> None:
    store = str(folder / "town.sgstore")
    query = "MATCH (e:Ego)-[:isIn]->(l:Lane) RETURN e, l AS lane, e.speed LIMIT 1"
    table, _ = printed(capsys, "find", store, query)
    rows, _ = printed(capsys, "find", store, query, "--json")

    assert table.splitlines()[0].split() == ["e", "lane", "e.speed"]
    assert table.splitlines()[2].startswith("car 0")
    assert json.loads(rows)[0]["e"] == 0


def test_groups_by_name_over_several_traces_have_a_note(
    folder: Path, tmp_path: Path, capsys: Any
) -> None:
    path = Path(shutil.copy(folder / "town.sgstore", tmp_path / "two.sgstore"))
    merging = "MATCH (e:Ego)-[:near]->(v:Vehicle) RETURN v.name, COUNT(*) AS n"
    single, several = f"{merging}", f"{merging}, trace.name"
    assert sgstore.open(path).find(single).mistakes == ()
    ingest(path, [drive(tmp_path / "other.mcap", frames=5)])
    store = sgstore.open(path)
    (note,) = store.find(single).mistakes

    assert note == (
        "v.name is unique only in its trace: entities of several traces merge in a row;"
        " add trace.name"
    )
    assert store.find(several).mistakes == ()
    assert store.find("MATCH (e:Ego) RETURN DISTINCT e").mistakes[0].startswith("e is unique")
    assert store.find("MATCH (e:Ego)-[:isIn]->(l:Lane) RETURN l.name, COUNT(*)").mistakes == ()
    assert store.find("MATCH (v:Vehicle) RETURN v.name, v.speed").mistakes == ()
    assert note in " ".join(printed(capsys, "find", str(path), single)[1].split())


def test_a_class_has_a_phrase_in_a_table_and_none_in_json(folder: Path, capsys: Any) -> None:
    store = str(folder / "town.sgstore")
    table, _ = printed(capsys, "coverage", "classes", store, "--limit", "3")
    rows, _ = printed(capsys, "coverage", "classes", store, "--limit", "1", "--json")
    (first,) = json.loads(rows)
    near = "SELECT count(DISTINCT dst) FROM edges WHERE src_is_ego AND relation IN"
    near += " ('near_coll', 'super_near', 'very_near', 'near') AND dst_kind = 'car' AND frame_id ="
    frame = sgstore.open(store).frame(first["frame"]).ref.frame_id
    ((cars,),) = sgstore.open(store).sql(f"{near} {frame}").values
    phrase = table.splitlines()[2].rpartition("  ")[2]

    assert "scene" not in first
    assert table.splitlines()[0].split()[-1] == "scene"
    assert phrase.startswith("ego")
    assert (f"{cars} car{'s' * (cars > 1)} near" in phrase) == (cars > 0)


def test_scenes_are_told_by_one_function_in_each_table(folder: Path, capsys: Any) -> None:
    store = str(folder / "town.sgstore")
    early, late = (f"{store}:MATCH (e:Ego) WHERE frame.seq {of} 20" for of in ("<", ">="))
    opened = sgstore.open(store)
    for words in (["diff", early, late], ["coverage", "novel", late, "--by", early]):
        rows = json.loads(printed(capsys, *words, "--json")[0])
        table = printed(capsys, *words)[0].splitlines()
        frames = [row["frame"] for row in rows[: len(table) - 2]]
        told = [line.rpartition("  ")[2] for line in table[2:]]
        assert "scene" not in rows[0]
        assert table[0].split()[-1] == "scene"
        assert told == phrases(opened, frames)
        assert all(one.startswith("ego, ") for one in told)


def test_a_vanished_scene_has_the_phrase_of_its_own_store(
    folder: Path, tmp_path: Path, capsys: Any
) -> None:
    drive(tmp_path / "town.mcap", frames=9)
    ingest(tmp_path / "other.sgstore", [tmp_path / "town.mcap"])
    stores = [str(folder / "town.sgstore"), str(tmp_path / "other.sgstore")]
    rows = json.loads(printed(capsys, "diff", *stores, "--json")[0])
    table = printed(capsys, "diff", *stores)[0].splitlines()[2:]
    of = {"vanished": sgstore.open(stores[0]), "appeared": sgstore.open(stores[1])}
    told = {line.rpartition("  ")[2] for line in table if line.startswith("vanished")}

    assert {row["change"] for row in rows} == {*of}
    frames = {row["frame"] for row in rows if row["change"] == "vanished"}
    assert told <= {*phrases(of["vanished"], [*frames])}
    assert "town#0" in frames
    assert phrases(of["appeared"], ["town#0"]) != phrases(of["vanished"], ["town#0"])
    assert phrases(of["appeared"], ["nowhere#0"]) == ["no ego"]


def test_a_shard_names_its_traces(tmp_path: Path, capsys: Any) -> None:
    drive(tmp_path / "one.mcap", frames=3)
    command = ["ingest", str(tmp_path / "fleet"), str(tmp_path / "one.mcap"), "--shard", "1/1"]

    assert run(command) == 0
    assert "share 1/1 of 1 recording: one" in capsys.readouterr().err
