"""OpenLABEL: what we write comes back equal; files of others have their elements where the standard says."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

import pytest

import sgstore
from sgstore.apps.cli import run
from sgstore.exporters import Export, write_export
from sgstore.model.world import Clip
from sgstore.pipeline.importing import Words, import_graphs

if TYPE_CHECKING:
    from pathlib import Path

S = 1_000_000_000
WHEN = "f.time_ns BETWEEN 24e9 AND 25e9"
NODES = f"""SELECT time_ns, ident, kind::TEXT, type_name, is_ego, is_static, coalesce(light_state::TEXT, '')
FROM nodes JOIN frames f USING (frame_id) WHERE {WHEN} AND node_id >= 0"""
EDGES = f"""SELECT time_ns, a.ident, relation::TEXT, b.ident FROM frames f JOIN edges e USING (frame_id)
JOIN nodes a ON a.frame_id = e.frame_id AND a.node_id = e.src
JOIN nodes b ON b.frame_id = e.frame_id AND b.node_id = e.dst
WHERE {WHEN} AND e.src >= 0 AND e.dst >= 0"""
UUID = "c44c1fc2-ee48-4b17-a20e-829de9be1141"


def faults(told: dict[str, Any], data: Path) -> list[str]:
    """What the schema of the standard finds wrong."""
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((data / "schemas/openlabel_1.0.0.json").read_text(encoding="utf-8"))
    return [fault.message for fault in jsonschema.Draft7Validator(schema).iter_errors(told)]


def exported(store: sgstore.Store, clip: Clip, folder: Path) -> Path:
    (written,) = write_export(Export(store, (clip,)), folder, "openlabel")
    return written.file


@pytest.mark.data
def test_what_was_exported_is_imported_and_exported_the_same(
    town_store: Path, data: Path, tmp_path: Path
) -> None:
    with sgstore.open(town_store) as store:
        first = exported(store, Clip("town", 24 * S, 25 * S), tmp_path / "first")
        there = sorted(store.sql(NODES).values) + sorted(store.sql(EDGES).values)
    (done,) = import_graphs(tmp_path / "again.sgstore", [first], "openlabel")
    assert (done.error, done.lost) == (None, {})
    with sgstore.open(tmp_path / "again.sgstore") as store:
        again = exported(store, Clip(done.name, 24 * S, 25 * S), tmp_path / "second")
        assert sorted(store.sql(NODES).values) + sorted(store.sql(EDGES).values) == there
    told = json.loads(again.read_text(encoding="utf-8"))

    assert told == json.loads(first.read_text(encoding="utf-8"))
    assert faults(told, data) == []


def foreign() -> dict[str, Any]:
    """A file as an annotator writes it: boxes as the ego sees them, actions, relations, tags."""
    half = math.sqrt(0.5)

    def box(*val: float, system: str = "ego") -> dict[str, Any]:
        return {"cuboid": [{"name": "shape", "val": [*val], "coordinate_system": system}]}

    def pose(y: float) -> dict[str, Any]:
        data = {"quaternion": [0, 0, half, half], "translation": [10, y, 0]}
        return {"transforms": {"t": {"src": "ego", "dst": "odom", "transform_src_to_dst": data}}}

    car = box(5, 1, 0.5, 0, 0, half, half, 4, 2, 1.5)
    car["text"] = [{"name": "colour", "val": "red"}]
    return {
        "metadata": {"schema_version": "1.0.0", "annotator": "somebody"},
        "coordinate_systems": {
            "odom": {"type": "scene_cs", "parent": "", "children": ["ego"]},
            "ego": {"type": "local_cs", "parent": "odom", "children": ["lidar"]},
            "lidar": {
                "type": "sensor_cs",
                "parent": "ego",
                "pose_wrt_parent": {"euler_angles": [math.pi, 0, 0], "translation": [1, 0, 2]},
            },
        },
        "frames": {
            "7": {
                "frame_properties": {"timestamp": "2020-04-11 12:00:01", **pose(20)},
                "objects": {
                    "1": {"object_data": car},
                    UUID: {"object_data": box(-4, 0, -1, 0, 0, 0, 1, 1, 1, system="lidar")},
                },
                "actions": {"0": {}},
            },
            "8": {
                "frame_properties": {"timestamp": "2020-04-11 12:00:01.100", **pose(21)},
                "objects": {
                    "1": {"object_data": box(5, 1, 0.5, 0, 0, half, half, 4, 2, 1.5)},
                },
            },
        },
        "objects": {
            "1": {"name": "car1", "type": "http://example.com/types#Car"},
            UUID: {"name": "walker", "type": "Pedestrian", "frame_intervals": []},
        },
        "actions": {"0": {"name": "a", "type": "isWalking"}},
        "tags": {"0": {"type": "RoadType", "tag_data": {"text": [{"val": "motorway"}]}}},
        "relations": {
            "0": {
                "name": "r",
                "type": "isSubjectOfAction",
                "rdf_subjects": [{"uid": UUID, "type": "object"}],
                "rdf_objects": [{"uid": "0", "type": "action"}],
            },
        },
    }


def brought_in(told: dict[str, Any], folder: Path, words: Words | None = None) -> Any:
    file = folder / "labels.json"
    file.write_text(json.dumps({"openlabel": told}), encoding="utf-8")
    (done,) = import_graphs(folder / "labels.sgstore", [file], "openlabel", words=words)
    return done


@pytest.mark.data
def test_elements_of_others_are_nodes_in_the_outermost_axes(data: Path, tmp_path: Path) -> None:
    told = foreign()
    assert faults({"openlabel": told}, data) == []
    done = brought_in(told, tmp_path, Words(unknown_as="own"))
    assert done.error is None
    with sgstore.open(tmp_path / "labels.sgstore") as store:
        sql = "SELECT ident, kind, x, y, z, heading, length FROM nodes JOIN frames USING (frame_id)"
        rows = {row[0]: row[1:] for row in store.sql(f"{sql} WHERE seq = 0")}
        times = [row[0] for row in store.sql("SELECT time_ns FROM frames ORDER BY seq")]
        walks = store.find(
            "MATCH (p:Person)-[:isSubjectOfAction]->(a:Action {type: 'isWalking'}) RETURN p.uid"
        ).rows()
        roads = "MATCH (c:Car), (t:Tag {type: 'RoadType'}) WHERE t.value = 'motorway'"

        # The ego stands at (10, 20) and looks along y: 5 m ahead and 1 m to its left is (9, 25).
        assert rows["car1"] == ("car", *map(pytest.approx, (9, 25, 0.5, 180, 4)))
        # The lidar looks back from 1 m ahead of the ego: 4 m behind it is 5 m ahead of the ego.
        assert rows["walker"] == ("person", *map(pytest.approx, (10, 25, 1, -90, 1)))
        assert rows["a"][0] == "action"
        assert times[1] - times[0] == S // 10
        assert walks == [(UUID,)]
        assert store.find(roads).count() == 2
        assert store.find("MATCH (c:Car) WHERE c.colour = 'red'").count() == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"metadata": {"schema_version": "0.3"}}, "expected schema_version 1.0.0"),
        ({"objects": {}}, "not among the objects of the file"),
        ({"relations": {"0": {"type": "near"}}}, "rdf_subjects and rdf_objects"),
        ({"frames": {"x": {}}}, "expected numbers of frames"),
        ({"objects": {"1": {"name": "x"}}}, "an object with a 'type'"),
    ],
)
def test_what_is_wrong_with_a_file_is_told(
    change: dict[str, Any], said: str, tmp_path: Path
) -> None:
    done = brought_in(foreign() | change, tmp_path)

    assert said in str(done.error)
    assert not (tmp_path / "labels.sgstore").exists()


def test_a_box_that_is_none_and_a_relation_that_nobody_knows_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = foreign()
    told["relations"]["0"]["type"] = "holdsHandsWith"
    assert "--unknown-as own" in str(brought_in(told, tmp_path).error)
    told["frames"]["7"]["objects"]["1"]["object_data"]["cuboid"][0]["val"] = [1, 2]
    file = tmp_path / "labels.json"
    file.write_text(json.dumps({"openlabel": told}), encoding="utf-8")
    command = ["import", str(tmp_path / "x.sgstore"), str(file), "--as", "openlabel"]

    assert run([*command, "--unknown-as", "own"]) != 0
    assert "frame 7, objects 1: expected 9 or 10 numbers" in capsys.readouterr().err
