"""The schema against the vocabulary, and what it promises in public."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import duckdb
import pytest

import sgstore
import sgstore.store._schema as shape
from sgstore.model.vocabulary import OWN_KINDS, OWN_LIGHT_STATES, OWN_RELATIONS, VEHICLE_LIGHTS
from sgstore.model.world import BUCKET_FRAMES
from sgstore.store import StoreFile
from sgstore.store._schema import schema_sql, schema_version

VIEWS = {
    "frames": "frame_id trace_id seq time_ns ego trace t log_time_ns map",
    "nodes": "frame_id node_id kind is_ego name special subkind is_static x y z heading pitch roll speed"
    " vx vy vz accel ax ay az yaw_rate length width height light_state",
    "edges": "frame_id src relation dst src_kind dst_kind src_is_ego dst_is_ego trace",
    "lane_states": "frame_id src dst src_kind overlap lane_offset heading_error is_primary along is_own",
    "lane_courses": "frame_id node_id kind lane along curvature slope",
    "lane_gaps": "frame_id src dst gap",
    "pairs": "frame_id src dst distance gap bearing rel_heading lon lat closing_speed ttc headway"
    " rel_speed src_kind dst_kind src_is_ego dst_is_ego lon_gap lat_gap apparent_heading closing_time",
    "criticality": "frame_id src dst distance gap bearing rel_heading lon lat closing_speed ttc headway"
    " rel_speed src_kind dst_kind src_is_ego dst_is_ego lon_gap lat_gap apparent_heading closing_time"
    " dce ttce dce_3s wttc ttc_accel pttc ttb tts ttr drac decel_to_safety_time a_long_req a_lat_req a_req"
    " btn stn pret spret et psd delta_v ci rss_lon rss_lat rss_margin",
    "lane_dists": "frame_id src dst lane_dist src_kind dst_kind src_is_ego dst_is_ego",
    "roles": "frame_id node_id role",
    "classes": "frame_id abstraction class",
    "lanes": "map node_id name lane_type road section lane junction turn x y z heading length width",
    "entities": "trace_id node_id kind name ident special subkind type_name is_static map_ref"
    " x y z heading length width height parked lifetime trace",
    "events": "frame_id trace_id trace kind time_ns t log_time_ns node_id other value detail ident other_ident",
    "traces": "trace trace_id file flavour ego map frames seconds start_ns end_ns since until losses scope",
    "imports": "frame_id graph place images",
    "attributes": "frame_id node_id name text value",
    "edge_attributes": "frame_id src relation dst name text value",
    "payloads": "frame_id channel log_time_ns offset_s schema file chunk_offset message_offset length",
}
VIEWS |= {
    f"world_{name}": VIEWS[name]
    for name in ("nodes", "lane_states", "pairs", "criticality", "lane_dists")
}


@pytest.fixture(scope="module")
def empty() -> duckdb.DuckDBPyConnection:
    connection = duckdb.connect()
    connection.execute(schema_sql())
    return connection


@pytest.mark.parametrize(
    ("enum", "names"),
    [("kind", OWN_KINDS), ("relation", OWN_RELATIONS), ("light_state", OWN_LIGHT_STATES)],
)
def test_enumerations_are_the_vocabulary_in_its_order(
    empty: duckdb.DuckDBPyConnection, enum: str, names: tuple[str, ...]
) -> None:
    ((values,),) = empty.execute(f"SELECT enum_range(NULL::{enum})").fetchall()

    assert tuple(values) == names[: len(values)]  # Stores add later relations themselves.


@pytest.mark.parametrize("view", VIEWS)
def test_public_views_keep_their_columns(empty: duckdb.DuckDBPyConnection, view: str) -> None:
    columns = [c[0] for c in empty.execute(f"SELECT * FROM {view}").description]

    assert columns[: len(VIEWS[view].split())] == VIEWS[view].split()


@pytest.mark.parametrize("view", VIEWS)
def test_a_column_of_a_public_view_needs_no_quotes(
    empty: duckdb.DuckDBPyConnection, view: str
) -> None:
    columns = [column[0] for column in empty.execute(f"FROM {view}").description]

    bare = empty.execute(f"SELECT {', '.join(columns)} FROM {view}").description

    assert [column[0] for column in bare] == columns


def test_every_view_is_public_and_commented(empty: duckdb.DuckDBPyConnection) -> None:
    found = empty.execute(
        "SELECT view_name, comment FROM duckdb_views() WHERE NOT internal AND schema_name = 'main'"
    ).fetchall()

    assert {name for name, _ in found} == set(VIEWS)
    assert all(comment for _, comment in found)


def test_views_among_the_tables_have_no_name_of_a_public_one(
    empty: duckdb.DuckDBPyConnection,
) -> None:
    found = empty.execute(
        "SELECT view_name FROM duckdb_views() WHERE NOT internal AND schema_name = 'inside'"
    ).fetchall()

    own = {"lane_state", "lane_gap"}
    own |= {f"known_{name}" for name in ("state", "node", "edge", *own)}
    assert {name for (name,) in found} == own
    assert {name for (name,) in found}.isdisjoint(VIEWS)


def test_lights_of_vehicles_are_the_vocabulary_bit_by_bit(empty: duckdb.DuckDBPyConnection) -> None:
    columns = [c[0] for c in empty.execute("SELECT * FROM nodes").description]
    loose = duckdb.connect()  # where nothing has to be known
    loose.execute(re.sub(r"(?<!IS) NOT NULL", "", schema_sql()))
    loose.execute("INSERT INTO inside.trace BY NAME SELECT 0 AS trace_id")
    loose.execute("INSERT INTO inside.entity BY NAME SELECT 0 AS trace_id, 0 AS node_id")
    for bit in range(len(VEHICLE_LIGHTS)):
        row = f"{bit} AS frame_id, 0 AS node_id, {1 << bit} AS lights"
        loose.execute(f"INSERT INTO inside.state BY NAME SELECT {row}")
    lights = ", ".join(c for c in columns if c.startswith("light_") and c != "light_state")
    rows = loose.execute(f"SELECT {lights} FROM nodes ORDER BY frame_id").fetchall()

    assert lights == ", ".join(VEHICLE_LIGHTS)
    assert [row.index(True) for row in rows] == list(range(len(VEHICLE_LIGHTS)))
    assert all(row.count(True) == 1 for row in rows)


def test_bits_are_those_of_the_frames_of_a_bucket(empty: duckdb.DuckDBPyConnection) -> None:
    assert empty.execute("SELECT bit, m FROM inside.bits ORDER BY bit").fetchall() == [
        (bit, 1 << bit) for bit in range(BUCKET_FRAMES)
    ]


def test_no_table_has_keys_that_loading_would_pay_for(empty: duckdb.DuckDBPyConnection) -> None:
    found = empty.execute("SELECT DISTINCT constraint_type FROM duckdb_constraints()").fetchall()

    assert found == [("NOT NULL",)]


@pytest.mark.skipif(duckdb.__version__ < "2", reason="this version's words are compared")
def test_the_objects_of_a_store_are_those_that_are_known_by_their_digest(tmp_path: Path) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    with store.access.reading() as connection:
        objects = shape.objects_of(connection, shape.database_of(connection))

    known, found = shape.KNOWN, shape.digest_of(objects)
    if "SGSTORE_UPDATE_GOLDEN" in os.environ:
        source = Path(shape.__file__)
        source.write_text(source.read_text().replace(known, found))
        known = found
    assert known == found, "SGSTORE_UPDATE_GOLDEN=1 writes it"


def without_trace(path: Path, digest: str) -> None:
    """Make a store an older one, whose views have no column ``trace``."""
    with duckdb.connect(str(path)) as connection:
        for name in shape.BEFORE_TRACE[digest]:
            if name in shape.NEW_VIEWS:
                connection.execute(f"DROP VIEW main.{name}")
                continue
            text = shape._TRACE.sub("", shape.expected().views[name])
            assert text != shape.expected().views[name]
            connection.execute(f"CREATE OR REPLACE VIEW main.{name} AS {text}")
        connection.execute(
            "UPDATE inside.store_info SET value = ? WHERE key = 'schema_digest'",
            [digest],
        )


def test_views_with_a_trace_id_or_nodes_have_the_trace(empty: duckdb.DuckDBPyConnection) -> None:
    rows = empty.execute(
        "SELECT table_name, list(column_name) FROM duckdb_columns() WHERE schema_name = 'main' GROUP BY 1"
    ).fetchall()

    lacking = {name for name, columns in rows if "trace_id" in columns and "trace" not in columns}
    assert (len(rows) > 20, lacking) == (True, set())


@pytest.mark.parametrize("digest", shape.BEFORE_TRACE)
def test_views_of_an_older_store_have_the_trace_and_a_write_adds_it(
    digest: str, tmp_path: Path, town_store: Path
) -> None:
    path = Path(shutil.copy(town_store, tmp_path / "old.sgstore"))
    views = shape.BEFORE_TRACE[digest]
    without_trace(path, digest)
    counts = "SELECT trace, count(*) FROM {} GROUP BY trace"
    store = sgstore.open(path)
    found = [store.sql(counts.format(view)).values for view in views]
    plain = [store.sql(f"SELECT count(*) FROM {view}").values for view in views]

    assert found == [[("town", count)] for ((count,),) in plain]
    assert list(store.file.verify().faults) == []
    store.file.remove("town")
    store.close()
    with duckdb.connect(str(path), read_only=True) as connection:
        for view in views:
            assert connection.execute(counts.format(view)).fetchall() == []
        objects = shape.objects_of(connection, shape.database_of(connection))
        assert [*shape._changed(objects, shape._expected_views(connection))] == []
    assert list(sgstore.open(path).file.verify().faults) == []


@pytest.mark.parametrize("digest", shape.BEFORE_TRACE)
def test_a_table_of_a_user_keeps_the_name_of_a_new_view_in_an_older_store(
    digest: str, tmp_path: Path, town_store: Path
) -> None:
    path = Path(shutil.copy(town_store, tmp_path / "old.sgstore"))
    without_trace(path, digest)
    with duckdb.connect(str(path)) as connection:
        connection.execute("CREATE TABLE traces AS SELECT 'mine' AS x")

    for _ in range(2):
        store = sgstore.open(path)
        assert store.sql("SELECT x FROM traces").values == [("mine",)]
        assert list(store.file.verify().faults) == []
        store.file.remove(*(one.name for one in store.traces()))
        store.close()


def test_traces_are_those_of_info(tmp_path: Path, town_store: Path) -> None:
    store = sgstore.open(town_store)
    (one,) = store.traces()
    names = "trace, trace_id, file, flavour, ego, map, frames, start_ns, end_ns, losses, sha256, version"
    (row,) = store.sql(f"SELECT {names} FROM traces").values
    ((seconds, scope),) = store.sql("SELECT seconds, scope FROM traces").values

    assert row == (
        *(one.name, one.trace_id, str(one.path), one.flavour, one.ego, one.map, one.frames),
        *(one.start_ns, one.end_ns, len(one.report["losses"]), one.digest, one.version),
    )
    assert seconds == pytest.approx(one.seconds, abs=1e-3)
    assert json.loads(scope) == one.report["scope"]


@pytest.mark.skipif(duckdb.__version__ < "2", reason="this version's words are compared")
@pytest.mark.parametrize(
    ("digest", "known"), [*zip(shape.BEFORE_TRACE, shape.KNOWN_BEFORE_TRACE, strict=True)]
)
def test_the_objects_of_an_older_store_are_known_by_their_digest(
    digest: str, known: str, tmp_path: Path
) -> None:
    StoreFile.create(tmp_path / "s.db").close()
    without_trace(tmp_path / "s.db", digest)
    with duckdb.connect(str(tmp_path / "s.db"), read_only=True) as connection:
        found = shape.digest_of(shape.objects_of(connection, "s"))

    if "SGSTORE_UPDATE_GOLDEN" in os.environ:
        source = Path(shape.__file__)
        source.write_text(source.read_text().replace(known, found))
        known = found
    assert known == found, "SGSTORE_UPDATE_GOLDEN=1 writes it"


def test_no_view_has_what_versions_of_the_database_write_down_in_different_ways() -> None:
    views = shape.expected().views | shape.expected().inner
    connection = duckdb.connect()
    for name, text in views.items():
        (written,) = connection.execute(
            "SELECT json_deserialize_sql(json_serialize_sql(?))", [text]
        ).fetchall()[0]
        assert " NOT IN " not in text, name
        assert "[" not in text, name
        # A union of three is nested to the right.
        assert not re.search(r"\bUNION (ALL )?\(\(SELECT", written), name


def test_the_digest_of_the_statements_is_known_by_that_of_the_text() -> None:
    found = shape.text_digest(), shape.statements_digest()
    if "SGSTORE_UPDATE_GOLDEN" in os.environ and found != shape.TEXT:
        source = Path(shape.__file__)
        text = source.read_text()
        for known, new in zip(shape.TEXT, found, strict=True):
            text = text.replace(known, new)
        source.write_text(text)
        return
    assert found == shape.TEXT, "SGSTORE_UPDATE_GOLDEN=1 writes it"


def test_the_head_says_the_version_that_a_store_is_made_with(tmp_path: Path) -> None:
    store = StoreFile.create(tmp_path / "s.db")
    (version,) = re.findall(
        r"^-- sgstore: what is in a store, version (\d+)\.$", schema_sql(), re.MULTILINE
    )

    sql = "SELECT value FROM inside.store_info WHERE key = 'schema_version'"
    assert store.rows(sql).values == [(version,)]
    assert f"--   * Version {version}: " in schema_sql()


def test_a_schema_that_says_no_version_is_no_schema(monkeypatch: pytest.MonkeyPatch) -> None:
    headless = schema_sql().partition("\n")[2]
    monkeypatch.setattr(shape, "schema_sql", lambda: headless)

    with pytest.raises(ValueError, match="contains no version"):
        schema_version()
