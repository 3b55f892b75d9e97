"""Topics of recordings as columns: values against other decoders, in SQL, stored and read from recordings."""

from __future__ import annotations

import hashlib
import json
import struct
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
import pytest
from mcap.reader import make_reader
from recordings import Recorder
from topic_recordings import control, ros, topic_recording

import sgstore
from sgstore.apps.cli import run as run_verb
from sgstore.errors import SgstoreError, SqlError
from sgstore.ingest import ingest
from sgstore.lang.topics import TopicError, field_of
from sgstore.readers import _topic_cdr
from sgstore.store import StoreFile
from sgstore.store._checksums import expressions
from sgstore.store._topic_views import topic_values

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.seconds(6)

TOPICS = ("/imu", "/status", "/control", "/planner")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return topic_recording(tmp_path_factory.mktemp("topics") / "run.mcap")


@pytest.fixture(scope="module")
def stores(recording: Path) -> dict[str, sgstore.Store]:
    """The same recording with stored topics, and without."""
    made: dict[str, sgstore.Store] = {}
    for name, topics in (("stored", TOPICS), ("read", ())):
        path = recording.with_name(f"{name}.sgstore")
        (outcome,) = ingest(path, [recording], topics=topics)
        assert outcome.error is None, outcome.error
        made[name] = sgstore.open(path)
    return made


each = pytest.mark.parametrize("how", ["stored", "read"])


def flat(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """An independent flattening: dicts and objects of rosbags have dotted names, NaN is None."""
    if hasattr(value, "__dataclass_fields__"):
        value = {
            name: getattr(value, name)
            for name in value.__dataclass_fields__
            if name[0] != "_" and not name.isupper()
        }
    if isinstance(value, dict):
        for name, inner in value.items():
            if name != "__msgtype__":
                yield from flat(inner, f"{path}.{name}" if path else name)
    else:
        yield path, value


def of_control(message: Any) -> dict[str, Any]:
    names = control()[1].DESCRIPTOR.enum_types_by_name, {0: "PARK", 1: "DRIVE"}
    target = message.target if message.HasField("target") else None
    child = {"steer": message.child.steer} if message.HasField("child") else None
    return {
        "gear": names[1][message.gear],
        "steer": message.steer,
        "target.x": target and target.x,
        "target.y": target and target.y,
        "limit": message.limit if message.HasField("limit") else None,
        "path": [{"x": one.x, "y": one.y} for one in message.path],
        "gears": [names[1].get(one, str(one)) for one in message.gears],
        "times": [*message.times],
        "raw": message.raw,
        "child": child,
        "id": message.id,
        "on": message.on,
    }


def expected(recording: Path, topic: str) -> list[dict[str, Any]]:
    """The messages of a topic, by the packages of the encodings."""
    found: list[dict[str, Any]] = []
    with recording.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(topics=[topic]):
            data = message.data
            if channel.message_encoding == "cdr":
                assert schema is not None
                values = dict(flat(ros().deserialize_cdr(data, schema.name)))
            elif channel.message_encoding == "json":
                values = dict(flat(json.loads(data)))
            else:
                values = of_control(control()[1].FromString(data))
            found.append(
                {"log_time_ns": message.log_time, "publish_time_ns": message.publish_time, **values}
            )
    return found


NAMES = {"State": "State_", "t": "t_"}
"""Fields whose names are taken: of a column of each topic, or of another field but for case."""


def plain(value: Any) -> Any:
    """A value as it is compared: arrays are lists, parts of ROS messages are dicts."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list):
        return [dict(flat(one)) if hasattr(one, "__dataclass_fields__") else one for one in value]
    return value.item() if isinstance(value, np.generic) else value


@each
@pytest.mark.parametrize("topic", TOPICS)
def test_values_are_those_of_other_decoders(
    stores: dict[str, sgstore.Store], recording: Path, topic: str, how: str
) -> None:
    rows = stores[how].sql(f"SELECT * FROM topic('{topic}') ORDER BY log_time_ns")
    assert rows.columns[:4] == ("trace", "t", "log_time_ns", "publish_time_ns")
    wanted = expected(recording, topic)
    assert len(rows) == len(wanted)
    kinds = dict(zip(rows.columns, rows.types, strict=True))
    for row, values in zip(rows.dicts(), wanted, strict=True):
        assert row["trace"] == "run"
        assert row["t"] == pytest.approx(values["log_time_ns"] / 1e9, abs=1e-6)
        for name, value in values.items():
            column = NAMES.get(name, name) if topic == "/planner" else name
            if column == "none":
                assert column not in row
                continue
            found = row[column]
            if kinds[column] == "JSON":
                found = None if found is None else json.loads(found)
            told = plain(value)
            if kinds[column] == "BLOB":
                told = bytes(told)
            if kinds[column].startswith("FLOAT"):
                told = np.float32(told).tolist()
                found = np.float32(found).tolist()
            assert found == told, (column, row)


def test_fields_have_types_of_their_encoding(stores: dict[str, sgstore.Store]) -> None:
    topics = stores["read"].catalog().topics
    kinds = {
        topic: {name: one.declared for name, one in topics[topic].source().items()}
        for topic in TOPICS
    }
    assert kinds["/imu"]["header.stamp.nanosec"] == "UINTEGER"
    assert kinds["/imu"]["angular_velocity_covariance"] == "DOUBLE[]"
    assert kinds["/status"] == {
        "ready": "BOOLEAN",
        "count": "BIGINT",
        "large": "UBIGINT",
        "load": "FLOAT",
        "name": "VARCHAR",
        "raw": "BLOB",
        "ranges": "FLOAT[]",
        "fixed": "SMALLINT[]",
        "words": "VARCHAR[]",
        "parts": "JSON",
    }
    assert kinds["/control"]["gear"] == "VARCHAR"
    assert kinds["/control"]["gears"] == "VARCHAR[]"
    assert kinds["/planner"]["plan.speed"] == "DOUBLE"
    assert kinds["/planner"]["plan.why.ids"] == "VARCHAR[]"
    assert field_of(topics["/imu"], "angular_velocity_covariance[2]").declared == "DOUBLE"


@pytest.mark.parametrize(
    ("sql", "message"),
    [
        ("SELECT * FROM topic('/imuu')", "no topic '/imuu'; did you mean '/imu'?"),
        (
            "SELECT statee FROM topic('/planner')",
            "topic '/planner' has no field 'statee'; did you mean 'state'?",
        ),
        (
            "SELECT angular_velocity.x FROM topic('/imu')",
            "topic '/imu' has no table 'angular_velocity'; write a dotted field in double quotes:"
            ' "angular_velocity.x"',
        ),
        (
            "SELECT * FROM topic('/odd')",
            "topic '/odd' cannot be decoded; its encoding is 'cbor' without a schema; protobuf, JSON, and CDR"
            " with ros2msg can be decoded",
        ),
    ],
)
def test_mistakes_are_one_line(stores: dict[str, sgstore.Store], sql: str, message: str) -> None:
    with pytest.raises(SgstoreError) as error:
        _ = stores["stored"].sql(sql).values
    assert str(error.value) == message


def test_a_wrong_topic_is_an_error_of_the_ingest(recording: Path, tmp_path: Path) -> None:
    for topic, message in (
        ("/planer", "did you mean '/planner'?"),
        ("/odd", "its encoding is 'cbor'"),
    ):
        (outcome,) = ingest(tmp_path / "a.sgstore", [recording], topics=[topic])
        assert outcome.status == "failed"
        assert message in str(outcome.error)


def test_a_missing_recording_has_a_remedy(tmp_path: Path) -> None:
    moved = topic_recording(tmp_path / "moved.mcap", frames=5)
    ingest(tmp_path / "a.sgstore", [moved], topics=["/imu"])
    moved.unlink()
    store = sgstore.open(tmp_path / "a.sgstore")
    assert store.sql("SELECT count(*) FROM topic('/imu')").values == [(25,)]
    with pytest.raises(TopicError, match=r"cannot be read.*--topics /status.*--root"):
        _ = store.sql("SELECT * FROM topic('/status')").values


def test_sql_over_a_recording_needs_no_store(
    stores: dict[str, sgstore.Store], recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sql = "SELECT * FROM topic('/planner') ORDER BY log_time_ns"
    asked = StoreFile.recording_sql(recording, sql)
    assert asked.rows().values == stores["stored"].sql(sql).values
    assert run_verb(["sql", str(recording), f"SELECT count(*) AS n FROM ({sql})", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [{"n": 20}]
    with pytest.raises(SqlError, match="has no table 'frames'; it has only topics"):
        StoreFile.recording_sql(recording, "SELECT * FROM frames").rows()
    with pytest.raises(SqlError, match="file system operations are disabled"):
        StoreFile.recording_sql(recording, f"SELECT * FROM read_text('{recording}')").rows()


def test_lists_that_are_all_empty_are_lists(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.write(recorder.channel("/a", "A", b""), 0.1, b'{"a": [], "b": 1}')
    asked = StoreFile.recording_sql(tmp_path / "a.mcap", "SELECT a, b FROM topic('/a')")
    assert asked.rows().values == [([], 1)]


def test_messages_of_one_size_in_many_layouts_are_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some layouts in groups, the others one by one."""
    monkeypatch.setattr(_topic_cdr, "MAX_LAYOUTS", 3)
    texts = [("x" * (4 * i), "y" * (40 - 4 * i)) for i in range(10)] * 2
    with Recorder(tmp_path / "a.mcap") as recorder:
        kind = recorder.writer.register_schema("x/msg/Two", "ros2msg", b"string a\nstring b\n")
        channel = recorder.writer.register_channel("/a", "cdr", kind)
        for i, pair in enumerate(texts):
            parts = (struct.pack("<I", len(one) + 1) + one.encode() + bytes(4) for one in pair)
            recorder.write(channel, i / 10, b"\0\1\0\0" + b"".join(parts))
    asked = StoreFile.recording_sql(tmp_path / "a.mcap", "SELECT a, b FROM topic('/a') ORDER BY t")
    assert asked.rows().values == texts


FIELDS = (
    ("/planner", "state"),
    ("/planner", "plan.speed"),
    ("/imu", "linear_acceleration.z"),
    ("/status", "ranges[1]"),
)


@each
@pytest.mark.parametrize("rule", ["last", "nearest", "linear"])
@pytest.mark.parametrize("tolerance", [None, 40_000_000])
def test_values_at_frames_are_those_of_the_definition(
    stores: dict[str, sgstore.Store], recording: Path, how: str, rule: str, tolerance: int | None
) -> None:
    file = stores[how].file
    frames = file.rows("SELECT frame_id, log_time_ns FROM frame").values
    known = file.catalog().topics
    for topic, path in FIELDS:
        if rule == "linear" and path == "state":
            continue
        with file.asked(
            lambda at, topic=topic, path=path: dict(
                at.execute(
                    topic_values(at, file.access, known[topic], path, rule, tolerance)
                ).fetchall()
            )
        ) as found:
            name, _, index = path.partition("[")
            messages = [(one["log_time_ns"], one.get(name)) for one in expected(recording, topic)]
            if index:
                messages = [(t, value[1] if len(value) > 1 else None) for t, value in messages]
            wanted = {frame: defined(messages, at, rule, tolerance) for frame, at in frames}
            assert found == {frame: one for frame, one in wanted.items() if one is not None}


def defined(messages: list[Any], at: int, rule: str, tolerance: int | None) -> float | None:
    """The value at a time, by trying all messages."""
    last = {t: value for t, value in messages if tolerance is None or abs(t - at) <= tolerance}
    before = max((t for t in last if t <= at), default=None)
    after = min((t for t in last if t >= at), default=None)
    if rule == "last":
        return None if before is None else last[before]
    if rule == "nearest":
        near = [t for t in (before, after) if t is not None]
        return last[min(near, key=lambda t: (abs(t - at), t))] if near else None
    if before is None or after is None or None in {last[before], last[after]}:
        return None
    share = (at - before) / (after - before) if after > before else 0
    return pytest.approx(last[before] + (last[after] - last[before]) * share)


@pytest.mark.parametrize("kind", ["DOUBLE[]", "FLOAT[]"])
@pytest.mark.parametrize(
    "first", ["[1, 0]", "[1, -0.0]", "NULL", "[]", "[NULL]", "['nan'::FLOAT, 1]"]
)
def test_checksums_of_lists_are_those_of_their_texts(first: str, kind: str) -> None:
    others = [
        "[1, 0]",
        "[1, -0.0]",
        "NULL",
        "[]",
        "[NULL]",
        "[1, NULL]",
        "['nan'::FLOAT, 1]",
        "[2.5, 'inf'::FLOAT]",
    ]
    with duckdb.connect() as connection:
        connection.execute("CREATE SCHEMA inside")
        connection.execute(f"CREATE TABLE inside.topic_a(x {kind})")
        for text in [first, *others, *others[::-1]]:
            connection.execute(f"INSERT INTO inside.topic_a VALUES (CAST({text} AS {kind}))")
        told = expressions(connection, "topic_a")
        rows = connection.execute(f"SELECT {told} FROM inside.topic_a ORDER BY rowid").fetchall()
        texts = connection.execute(
            "SELECT x::VARCHAR FROM inside.topic_a ORDER BY rowid"
        ).fetchall()
    want = [text and int(hashlib.md5(text.encode()).hexdigest()[:15], 16) for (text,) in texts]
    assert [number for (number,) in rows] == want
    assert len(set(want)) == len({str(text) for text in texts}) > 6


CARLA_TOPICS = (
    "/carla/hero/vehicle_status",
    "/carla/hero/odometry",
    "/carla/vehicle_lights",
    "/carla/traffic_lights/status",
    "/tf",
)


def test_topics_that_an_ingest_stores_are_those_of_the_recording(
    data: Path, tmp_path: Path
) -> None:
    """The ingest reads chunks of this recording from its cache of messages, which has parts of them."""
    recording = data / "traces/carla/Town01.carla.mcap"
    (stored,) = ingest(tmp_path / "stored.sgstore", [recording], topics=CARLA_TOPICS)
    (read,) = ingest(tmp_path / "read.sgstore", [recording])
    assert (stored.error, read.error) == (None, None)

    for topic in CARLA_TOPICS:
        rows = [
            sgstore.open(tmp_path / f"{one}.sgstore")
            .sql(f"SELECT * EXCLUDE (trace) FROM topic('{topic}') ORDER BY ALL")
            .values
            for one in ("stored", "read")
        ]
        with recording.open("rb") as file:
            found = [message for _, _, message in make_reader(file).iter_messages(topics=[topic])]
        assert len(rows[0]) == len(found) > 0
        assert rows[0] == rows[1], topic
        if topic == "/carla/vehicle_lights":
            frames = sgstore.open(tmp_path / "stored.sgstore").sql(
                f"SELECT frame FROM topic('{topic}')"
            )
            wanted = [json.loads(message.data)["frame"] for message in found]
            assert sorted(frame for (frame,) in frames.values) == wanted
