"""The public API: names, what importing them costs, and what they give."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from api_page import PAGE, PARTS, page

import sgstore
from sgstore.apps.demo import RECORDING

if TYPE_CHECKING:
    from pathlib import Path

NEAR = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"
CAMERA = "/ego/camera/front/image"


@pytest.fixture
def store(town_store: Path) -> sgstore.Store:
    return sgstore.open(town_store)


def test_the_package_has_about_25_names_and_the_page_describes_each_once() -> None:
    told = [name for names in PARTS.values() for name in names]

    assert sorted(told) == sorted(sgstore.__all__)
    assert len(told) <= 30
    assert [name for name in told if not getattr(sgstore, name).__doc__] == []


def test_the_page_of_the_api_is_that_of_the_docstrings() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run make api"


def test_importing_the_package_loads_none_of_its_rooms() -> None:
    program = (
        "import sys, sgstore; sgstore.__version__\n"
        "print(*sorted(m for m in sys.modules if m.startswith(('sgstore.', 'numpy', 'duckdb'))))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )

    assert done.stdout.split() == []


def test_a_store_is_created_and_filled_where_there_is_none(tmp_path: Path) -> None:
    path = tmp_path / "new.sgstore"
    with pytest.raises(sgstore.StoreError, match="store not found"):
        sgstore.open(path)

    with sgstore.open(path, create=True) as store:
        assert store.traces() == ()
        (outcome,) = store.ingest(RECORDING, until=3)
        assert repr(outcome) == "<TraceOutcome 'town': added, 31 frames, 0 losses>"
        assert [trace.name for trace in store.traces()] == ["town"]
    with sgstore.open(path, create=True) as again:
        assert [trace.frames for trace in again.traces()] == [31]


def test_rows_are_tuples_with_names(store: sgstore.Store) -> None:
    matches = store.find(NEAR)
    row = next(iter(matches))

    assert tuple(row) == row == matches.rows()[0]
    assert row._fields == ("frame_id", "trace", "seq", "time_ns", "t", "e", "e_name", "v", "v_name")
    assert (row.trace, row.v_name) == ("town", row[-1])
    (counted,) = store.find(f"{NEAR} RETURN COUNT(*), avg(v.speed) AS count, 1 + 1")
    assert counted._fields == ("COUNT", "count", "_2")


def test_a_limit_is_that_of_the_language(store: sgstore.Store) -> None:
    matches = store.find(NEAR)
    three, said = matches.limit(3), store.find(f"{NEAR} LIMIT 3")

    assert three.rows() == said.rows() == matches.rows()[:3]
    assert (three.count(), list(three.clips())) == (said.count(), list(said.clips()))
    assert three.limit(9).rows() == three.rows()
    assert matches.limit(0).rows() == []
    assert len(three.arrow()) == len(three.polars()) == 3
    assert matches.count() > 3
    ordered = store.find(f"{NEAR} RETURN v.speed AS speed ORDER BY speed DESC LIMIT 9")
    assert ordered.limit(2).rows() == ordered.rows()[:2]
    with pytest.raises(ValueError, match="expected 0 or more"):
        matches.limit(-1)


def test_a_limit_among_the_parameters_is_told_where_it_belongs(store: sgstore.Store) -> None:
    with pytest.raises(sgstore.QueryError, match=r"call \.limit\(n\) on its matches"):
        store.find(NEAR, limit=2)


def test_a_limit_holds_after_the_store_has_changed(tmp_path: Path) -> None:
    with sgstore.open(tmp_path / "new.sgstore", create=True) as store:
        store.ingest(RECORDING, until=3)
        limited = store.find("MATCH (e:Ego)").limit(2)
        store.ingest(RECORDING, until=5, force=True)

        assert len(limited.rows()) == 2


def test_the_picture_of_a_camera_is_an_image(store: sgstore.Store) -> None:
    assert store.picture("town#264", CAMERA).size == (480, 270)
    with pytest.raises(sgstore.ExportError, match="holds no picture"):
        store.picture("town#264", "/ego/lidar/points")
    with pytest.raises(sgstore.StoreError, match="no channel"):
        store.picture("town#264", "/ego/lidar/point")


def test_a_frame_is_shown_with_and_without_its_match(store: sgstore.Store) -> None:
    frame = next(store.find(NEAR).frames())
    plain, marked = (store.show(frame, query, camera="none") for query in (None, NEAR))

    assert min(plain.size) > 300
    assert plain.tobytes() != marked.tobytes()


def test_public_objects_say_what_they_are(store: sgstore.Store) -> None:
    long = store.find(f"{NEAR} WHERE " + " AND ".join(["e.speed > 1"] * 20))
    config = sgstore.Config(ego="hero", rate=5.0)
    generator = sgstore.SceneGraphGenerator(None, sgstore.Config())
    graph = generator.step(sgstore.Frame(0))

    assert repr(store).startswith("Store('")
    assert repr(store.find(NEAR).limit(2)) == f"<Matches of '{NEAR}', at most 2 rows>"
    assert len(repr(long)) < 110
    assert repr(store.traces()) == (
        "(<StoredTrace 'town': 750 frames, 74.9 s, ego 'ego', map 'town.xodr'>,)"
    )
    assert repr(store.sql("SELECT 1 AS one, 'x' AS two")) == "<1 row of one, two>"
    assert repr(store.check("CHECK slow: ALWAYS ego.speed < 14")) == "<CheckRun of slow>"
    assert repr(next(iter(store.check("CHECK still: ALWAYS ego.speed < 0")))) == (
        "<Verdict 'still' of 'town': false, 1 violation>"
    )
    assert repr(next(iter(store.like("town#3")))) == (
        "<SimilarFrames from 'town#2': 2 frames, similarity 1>"
    )
    assert repr(sgstore.Pattern().node("e", "Ego")) == "<Pattern 'MATCH (e:Ego)'>"
    assert repr(sgstore.Monitor("CHECK slow: ALWAYS ego.speed < 14")) == (
        "<Monitor of slow after 0 frames>"
    )
    assert repr(config) == "Config(ego='hero', rate=5.0)"
    assert repr(sgstore.Config()) == "Config()"
    assert repr(generator) == "<SceneGraphGenerator on no map, 15 relations>"
    assert repr(graph) == "<SceneGraph online#0: 0 nodes, 0 edges>"
