"""Notebooks: objects that show themselves, the cell %%sgql, and the notebooks of examples/."""

from __future__ import annotations

import ast
import builtins
import importlib
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from notebooks import cells_of
from PIL import Image
from thorough import LONG

import sgstore
from sgstore.apps.demo import RECORDING
from sgstore.apps.notebook import SgqlCell
from sgstore.base.display import cell, html_media, html_table

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.seconds(12)

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.ipynb"))
LEARNING = ROOT / "examples" / "learning.ipynb"
RUN = [path for path in EXAMPLES if path != LEARNING and (LONG or path.stem != "coverage")]
"""What the others do not run, the documentation of coverage does; ``make pyg`` runs the one with torch."""
NEAR = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"
LIDAR = "/ego/lidar/points"


@pytest.fixture(scope="module")
def store(town_store: Path) -> Iterator[sgstore.Store]:
    with sgstore.open(town_store) as store:
        yield store


# Objects that show themselves ------------------------------------------------------------------------


def test_texts_of_recordings_are_no_tags() -> None:
    shown = html_table(["<b>a</b>"], [["<script>alert(1)</script>"]], "<i>", "</div>")
    figure = html_media(b"x", "image/png", "'><script>")

    assert "<script>" not in shown + figure
    assert "<b>" not in shown
    assert "&lt;script&gt;" in shown
    assert [cell(v) for v in (None, True, 1.23456789, float("nan"), [1, "a"], "a\x1b[1m\nb")] == [
        *("", "true", "1.23457", "nan", '[1, "a"]', "a�[1m b")
    ]
    assert len(cell("x" * 1000)) == 200


def test_a_store_and_its_answers_are_tables(store: sgstore.Store) -> None:
    rows = store.sql("SELECT seq FROM frames ORDER BY seq")
    run = store.check("CHECK slow: ALWAYS ego.speed < 5; CHECK still: ALWAYS ego.speed < 50")

    assert ">town</td>" in store._repr_html_()
    assert "1 trace, 750 frames" in store._repr_html_()
    assert rows._repr_html_().count("<tr>") == 21
    assert "the first 20 rows" in rows._repr_html_()
    assert "1 false, 1 true" in run._repr_html_()
    assert ">false</td>" in next(iter(run))._repr_html_()


def test_matches_show_rows_how_many_and_pictures(store: sgstore.Store) -> None:
    matches = store.find(NEAR)
    shown = matches._repr_html_()

    assert f"{matches.count():,} frames" in shown
    assert shown.count("<tr>") == 21
    assert 1 <= shown.count("data:image/jpeg;base64,") <= 4
    assert "nothing matches" in store.find("MATCH (e:Ego) WHERE e.speed > 300")._repr_html_()


def test_a_frame_has_its_graph_its_pictures_and_its_points(store: sgstore.Store) -> None:
    frame = store.frame("town#264")

    assert repr(frame) == "<StoreFrame 'town#264' at 26.4 s>"
    assert set(frame.channels) >= {LIDAR, "/ego/camera/front/image"}
    assert len(frame.graph()) == len(store.graph("town#264"))
    assert len(frame.graph("RSV")) == len(store.graph("town#264", "RSV"))
    assert frame.picture().size == (480, 270)
    assert min(Image.open(io.BytesIO(frame._repr_png_())).size) > 300
    with pytest.raises(sgstore.StoreError):
        store.frame("town#9999")


def test_a_clip_plays(store: sgstore.Store, tmp_path: Path) -> None:
    run = next(store.find(NEAR).intervals())
    clip = next(store.find(f"{NEAR} WHERE e.speed > 9").clips())
    look = {"camera": "none", "fps": 1, "relations": "none"}
    shown = store.animate("town@25s..26s", NEAR, **look)

    assert repr(shown) == "<ClipAnimation from 'town@25s' to 'town@26s': gif>"
    assert "data:image/gif;base64," in shown._repr_html_()
    assert Image.open(io.BytesIO(shown.data)).n_frames >= 2
    assert store._range_of(run) == (f"town#{run.start_seq}", f"town#{run.end_seq}")
    first, last = (store.frame(name).ref for name in store._range_of(clip))
    assert clip.start_ns <= first.log_time_ns <= last.log_time_ns <= clip.end_ns
    shown.save(tmp_path / "clip.gif")
    assert (tmp_path / "clip.gif").read_bytes() == shown.data
    with pytest.raises(sgstore.ExportError, match=r"expected \.gif"):
        shown.save(tmp_path / "clip.mp4")
    with pytest.raises(sgstore.StoreError, match="not a clip"):
        store.animate("town@25s")


@pytest.mark.parametrize(("clip", "fps"), [("town@2s..12s", 10), ("town@2s..62s", 2.5)])
def test_a_long_clip_has_fewer_pictures_a_second(
    clip: str, fps: float, store: sgstore.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float | None] = []

    def drawn(_store: sgstore.Store, _frames: Any, to: Path, **look: Any) -> int:
        asked.append(look.get("fps"))
        return to.write_bytes(b"")

    monkeypatch.setattr("sgstore.draw.draw_clip", drawn)
    store.animate(clip)
    store.animate(clip, fps=4)
    store.animate(clip, form="mp4")

    assert asked == [fps, 4, None]


def points_by_protobuf(log_time_ns: int) -> np.ndarray[Any, Any]:
    """The cloud of the sample nearest to a time, decoded by the descriptors in the file and nothing of ours."""
    with RECORDING.open("rb") as stream:
        found = [(m, schema) for schema, channel, m in make_reader(stream).iter_messages([LIDAR])]
    message, schema = min(found, key=lambda one: abs(one[0].log_time - log_time_ns))
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    cloud = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(
        message.data
    )
    assert [(f.name, f.offset, f.type) for f in cloud.fields][:3] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
    ]
    rows = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)
    return np.ascontiguousarray(rows[:, :12]).view("<f4")


def test_points_are_those_of_the_message(store: sgstore.Store) -> None:
    frame = store.frame("town#264")
    points, expected = store.points("town#264"), points_by_protobuf(frame.ref.log_time_ns)

    assert points.dtype.names[:3] == ("x", "y", "z")
    assert np.array_equal(np.stack([points[axis] for axis in "xyz"], axis=1), expected)
    assert np.array_equal(frame.points(LIDAR), points)
    with pytest.raises(sgstore.ExportError, match="holds no points, but a picture"):
        store.points("town#264", "/ego/camera/front/image")


def test_a_relation_goes_on_from_an_answer(store: sgstore.Store) -> None:
    query = f"{NEAR} RETURN v.kind AS kind, gap(e, v) AS metres, v.light_brake AS brakes"
    matches = store.find(query)
    relation = matches.relation()
    rows = matches.rows()
    near = relation.filter("metres < 3")

    assert isinstance(near, duckdb.DuckDBPyRelation)
    assert relation.columns == ["kind", "metres", "brakes"]
    assert relation.fetchall() == [tuple(row) for row in rows]
    assert near.aggregate("count(*)").fetchall() == [(sum(row.metres < 3 for row in rows),)]
    assert store.sql("SELECT 1 AS one WHERE false").relation().fetchall() == []
    many = store.sql("SELECT * FROM range(30000) AS r(n)").relation()
    assert many.aggregate("sum(n)").fetchall() == [(sum(range(30_000)),)]


# The cell --------------------------------------------------------------------------------------------


@pytest.fixture
def names(store: sgstore.Store) -> dict[str, Any]:
    return {"store": store, "least": 5, "unused": object()}


def test_the_cell_asks_patterns_rules_and_sql(names: dict[str, Any], store: sgstore.Store) -> None:
    ask = SgqlCell(names)
    query = f"{NEAR} WHERE e.speed > $least AND '$unused' <> 'x' -- $unused\n"
    found = ask("store --as near", query)
    verdicts = ask("", "CHECK slow: ALWAYS ego.speed < $least")
    rows = ask("", "  SELECT count(*) AS n FROM frames")

    assert names["near"] is found
    assert found.rows() == store.find(f"{NEAR} WHERE e.speed > 5").rows()
    assert [one.verdict for one in verdicts] == ["false"]
    assert rows.values == [(750,)]
    assert (
        ask(
            "", "DEFINE SCENARIO s(least = 1) AS MATCH (e:Ego) WHERE e.speed > $least; MATCH s()"
        ).count()
        > 9
    )


def test_the_cell_finds_its_store(names: dict[str, Any], town_store: Path) -> None:
    text = "SELECT 1"

    assert SgqlCell(names)("", text) is not None
    assert SgqlCell({})(str(town_store), text) is not None


@pytest.mark.parametrize(
    ("line", "text", "told"),
    [
        ("store", "MATCH (e:Egoo)", "did you mean"),
        ("store --as 1x", "SELECT 1", "expected a name"),
        ("store --rows 3", "SELECT 1", "not understood"),
        ("store 'x", "SELECT 1", "usage"),
        ("nowhere.sgstore", "SELECT 1", "store not found"),
        ("store", "CHECK slow ALWAYS", "a colon"),
    ],
)
def test_a_mistake_in_the_cell_is_told_without_a_traceback(
    names: dict[str, Any], capsys: pytest.CaptureFixture[str], line: str, text: str, told: str
) -> None:
    assert SgqlCell(names)(line, text) is None
    assert told in capsys.readouterr().err


def test_where_several_stores_are_open_the_cell_wants_a_name(
    names: dict[str, Any], town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names["other"] = sgstore.open(town_store)

    assert SgqlCell(names)("", "SELECT 1") is None
    assert SgqlCell({})("", "SELECT 1") is None
    said = capsys.readouterr().err
    assert "2 stores are open: name one" in said
    assert "no store is open" in said


# The notebooks of examples/ --------------------------------------------------------------------------


@pytest.mark.parametrize("path", RUN, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom(path: Path, tmp_path: Path) -> None:
    env = os.environ | {"MPLBACKEND": "Agg", "IPYTHONDIR": str(tmp_path / "ipython")}
    program = ROOT / "tools" / "notebooks.py"
    done = subprocess.run(
        [sys.executable, program, path],
        cwd=tmp_path,
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    told = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"cell"')]

    assert [one["error"] for one in told if one["error"]] == [], done.stderr
    assert done.returncode == 0, done.stderr
    kinds = {kind for one in told for kind in one["shown"]}
    assert kinds >= ({"image/png", "text/html"} if path.stem == "first_look" else {"text/plain"})


def test_names_of_a_notebook_that_does_not_run_here_are_known() -> None:
    code = ast.parse("\n".join(cells_of(LEARNING)))
    imports = [node for node in ast.walk(code) if isinstance(node, ast.Import | ast.ImportFrom)]
    known = set(dir(builtins))
    for node in imports:
        known |= {(name.asname or name.name).partition(".")[0] for name in node.names}
        if isinstance(node, ast.ImportFrom) and node.module.startswith("sgstore"):
            module = importlib.import_module(node.module)
            assert all(hasattr(module, name.name) for name in node.names), ast.unparse(node)
    for node in ast.walk(code):
        if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
            known.add(node.id)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            known.add(node.name)
        elif isinstance(node, ast.arg):
            known.add(node.arg)
    used = {n.id for n in ast.walk(code) if isinstance(n, ast.Name)}

    assert used <= known
    assert {"Export", "GraphDataset", "store"} <= used


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_a_notebook_is_kept_with_its_results_and_uses_no_private_name(path: Path) -> None:
    document = json.loads(path.read_text(encoding="utf-8"))
    code = "\n".join(
        "".join(one["source"]) for one in document["cells"] if one["cell_type"] == "code"
    )

    assert not re.search(r"\b_\w|\._", code)
    cells = [one for one in document["cells"] if one["cell_type"] == "code"]
    if path != LEARNING:  # it needs torch
        assert [one["execution_count"] for one in cells] == [*range(1, len(cells) + 1)]
        results = [data for one in cells for data in one["outputs"]]
        assert len(results) >= 2
        html = sum("text/html" in one.get("data", {}) for one in results)
        assert html >= {"coverage": 6, "first_look": 4}.get(path.stem, 0)  # tables, not texts
        assert path.stat().st_size < 1_000_000
    assert document["nbformat"] == 4
