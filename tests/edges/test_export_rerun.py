"""Clips for Rerun, read by its own reader: ``make viewers`` runs these, because Rerun is large."""

from __future__ import annotations

import io
import json
import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

import sgstore
from sgstore.errors import MissingExtraError
from sgstore.exporters import Export, parse_mounts, write_export
from sgstore.model.world import Clip

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

S = 1_000_000_000
rerun = pytest.mark.skipif(
    find_spec("rerun") is None, reason="Rerun is not installed: make viewers"
)


@pytest.fixture(scope="module")
def store(town_store: Path) -> Iterator[sgstore.Store]:
    with sgstore.open(town_store) as store:
        yield store


@pytest.fixture(scope="module")
def chunks(
    store: sgstore.Store, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, list[dict[str, Any]]]:
    """Rows of each path: what Rerun's reader gives."""
    from rerun.chunk import RrdReader

    mounts = parse_mounts(["ego/lidar=0,0,1.75"])
    export = Export(store, (Clip("town", 36 * S, 38 * S),), mounts=mounts)
    (written,) = write_export(export, tmp_path_factory.mktemp("rerun") / "out", "rrd")
    found: dict[str, list[dict[str, Any]]] = {}
    for chunk in RrdReader(str(written.file)).stream().to_chunks():
        batch = chunk.to_record_batch()
        names = [one for one in batch.schema.names if one not in {"time", "log_time"}]
        rows = batch.select(names).to_pylist()  # without times of nanoseconds, which Python has not
        found.setdefault(str(chunk.entity_path), []).extend(rows)
    assert written.losses == ()
    return found


def by_frame(rows: list[dict[str, Any]]) -> dict[int, dict[str, Any]]:
    return {row["frame"]: row for row in rows if row.get("frame") is not None}


@rerun
def test_boxes_and_edges_are_those_of_the_graphs(
    store: sgstore.Store, chunks: dict[str, list[dict[str, Any]]]
) -> None:
    boxes = by_frame(chunks["/world/boxes"])

    assert sorted(boxes) == list(range(360, 381))
    for seq, row in boxes.items():
        graph = store.graph(f"town#{seq}")
        solid = {
            about["name"]: (about["x"], about["y"], about["z"])
            for node, about in graph.nodes(data=True)
            if node >= 0 and about.get("length") and about.get("width") and about.get("height")
        }
        told = dict(zip(row["Boxes3D:labels"], row["Boxes3D:centers"], strict=True))
        assert told.keys() == solid.keys()
        for name, place in solid.items():
            assert np.abs(np.array(told[name]) - place).max() < 0.001, (seq, name)
        near = [key for *_, key in graph.edges(keys=True) if key == "near_coll"]
        lines = by_frame(chunks["/world/edges/near_coll"]).get(seq, {})
        assert len(lines.get("LineStrips3D:strips") or []) == len(near)
    assert {one for one in chunks if one.startswith("/world/map/")} >= {"/world/map/driving"}


@rerun
def test_the_graph_has_its_nodes_and_edges(
    store: sgstore.Store, chunks: dict[str, list[dict[str, Any]]]
) -> None:
    for seq, row in by_frame(chunks["/graph"]).items():
        graph = store.graph(f"town#{seq}")
        placed = {node for node, about in graph.nodes(data=True) if "x" in about}
        pairs = {(str(a), str(b)) for a, b in graph.edges() if {a, b} <= placed}
        told = {(one["first"], one["second"]) for one in row["GraphEdges:edges"]}
        assert set(row["GraphNodes:node_ids"]) == {str(node) for node in placed}
        assert told == pairs
        ego = row["GraphNodes:node_ids"].index(str(graph.graph["ego"]))
        assert row["GraphNodes:positions"][ego] == pytest.approx([0, 0])


@rerun
def test_every_path_has_its_place(
    store: sgstore.Store, chunks: dict[str, list[dict[str, Any]]]
) -> None:
    graphs = [store.graph(f"town#{seq}") for seq in range(360, 381)]
    relations = {key for graph in graphs for *_, key in graph.edges(keys=True)}
    areas = {"crosswalk", "driving", "none", "parking", "sidewalk"}

    assert {path for path in chunks if not path.startswith("/__")} == {
        "/graph",
        "/world",
        "/world/boxes",
        "/world/ego",
        r"/world/ego/ego\/lidar",
        r"/world/ego/ego\/lidar/\/ego\/lidar\/points",
        r"/camera/\/ego\/camera\/front\/image",
        *(f"/world/map/{area}" for area in areas),
        *(f"/world/edges/{relation}" for relation in relations),
    }
    assert all(chunks.values())


@rerun
def test_pictures_points_and_axes_are_there(
    store: sgstore.Store, chunks: dict[str, list[dict[str, Any]]]
) -> None:
    (camera,) = (path for path in chunks if path.startswith("/camera/"))
    (cloud,) = (path for path in chunks if path.endswith("points"))
    ego = by_frame(chunks["/world/ego"])
    blobs = [bytes(row["EncodedImage:blob"][0]) for row in chunks[camera]]
    seen = {
        store.file.carried(store.file.frame(f"town#{n}").frame_id, "/ego/camera/front/image").data
        for n in range(360, 381)
    }

    assert set(blobs) == seen
    assert Image.open(io.BytesIO(blobs[0])).size == (480, 270)
    assert "lidar" in cloud
    points = store.points("town#365")
    expected = np.stack([points[axis] for axis in "xyz"], axis=1)
    assert any(
        np.array_equal(np.array(row["Points3D:positions"], np.float32), expected)
        for row in chunks[cloud]
    )
    node = store.graph("town#370").nodes[store.graph("town#370").graph["ego"]]
    assert ego[370]["Transform3D:translation"][0][:2] == pytest.approx([node["x"], node["y"]])
    assert json.dumps(sorted(chunks))  # each path is a text


def test_without_rerun_it_is_said_what_to_install(
    store: sgstore.Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)

    with pytest.raises(MissingExtraError, match="rerun"):
        write_export(Export(store, (Clip("town", 0, S),)), tmp_path / "out", "rrd")
    assert not (tmp_path / "out").exists()
