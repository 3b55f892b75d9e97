"""Scene graphs and labels in clips, against the store and Foxglove's own definitions; and MCAP's rules."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from carla_recordings import drive as carla_drive
from clipping import Source, write_clips
from foxglove_scenes import SceneRecorder, cube
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Schema,
    Statistics,
)
from mcap_doctor import examine
from recordings import drive

import sgstore
import sgstore.exporters._foxglove as foxglove_scene
from sgstore.apps.demo import RECORDING
from sgstore.errors import ExportError
from sgstore.exporters import Export, labelled, write_export
from sgstore.ingest import ingest
from sgstore.model.world import Clip
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mcap.writer import Writer

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(11)

S = 1_000_000_000
OURS = {"/sgstore/graph", "/sgstore/scene", "/sgstore/tf", "/sgstore/labels"}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    folder = tmp_path_factory.mktemp("town")
    recording = Path(shutil.copy(RECORDING, folder / "town.mcap"))
    ingest(folder / "town.sgstore", [recording], until=27)
    store = sgstore.open(folder / "town.sgstore")
    with store.file.snapshot():
        yield store


@pytest.fixture(scope="module")
def clip(store: Store, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds with graphs and a label."""
    export = Export(store, (Clip("town", 24 * S, 26 * S),), with_graph=True)
    export = labelled(export, {"fast": "ego.speed > 8", "what": "ego.special"})
    (written,) = write_export(export, tmp_path_factory.mktemp("clip") / "out")
    return written.file


def messages(path: Path) -> list[tuple[str, int, int, bytes]]:
    with path.open("rb") as stream:
        return [
            (channel.topic, message.log_time, message.sequence, message.data)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages(
                log_time_order=False
            )
        ]


def of(path: Path, topic: str) -> list[tuple[int, bytes]]:
    return [(time, data) for name, time, _, data in messages(path) if name == topic]


def store_of(path: Path, folder: Path) -> Store:
    ingest(folder / "again.sgstore", [path])
    return sgstore.open(folder / "again.sgstore")


# Scene graphs ----------------------------------------------------------------------------------------


def test_a_clip_brings_the_graph_of_every_frame_as_the_store_has_it(
    store: Store, clip: Path
) -> None:
    found = of(clip, "/sgstore/graph")

    assert [time for time, _ in found] == [24 * S + i * S // 10 for i in range(21)]
    for time, data in found:
        told = json.loads(data)
        graph = store.graph(int(told["frame_id"]))
        assert told["timestamp"] == {"sec": time // S, "nsec": time % S}
        assert (told["trace"], told["seq"]) == ("town", graph.graph["seq"])
        assert told["ego"] == graph.graph["ego"]
        assert {node.pop("id"): node for node in told["nodes"]} == dict(graph.nodes(data=True))
        edges = {(e.pop("src"), e["relation"], e.pop("dst")): e for e in told["edges"]}
        assert edges == {
            (a, key, b): about for a, b, key, about in graph.edges(keys=True, data=True)
        }


def test_labels_stand_in_the_graph_and_what_is_not_known_is_null(store: Store, clip: Path) -> None:
    for _, data in of(clip, "/sgstore/graph"):
        told = json.loads(data)
        graph = store.graph(int(told["frame_id"]))
        fast = graph.nodes[graph.graph["ego"]]["speed"] > 8
        assert told["labels"] == {"fast": fast, "what": None}


def test_the_schema_of_the_graph_names_what_is_in_it(clip: Path) -> None:
    with clip.open("rb") as stream:
        schemas = make_reader(stream).get_summary().schemas.values()
    (schema,) = [json.loads(one.data) for one in schemas if one.name == "sgstore.SceneGraph"]
    told = json.loads(of(clip, "/sgstore/graph")[0][1])

    assert told.keys() <= schema["properties"].keys()
    assert set(schema["required"]) <= told.keys()
    for thing in ("nodes", "edges"):
        items = schema["properties"][thing]["items"]
        assert all(set(items["required"]) <= one.keys() for one in told[thing])


def test_labels_alone_have_a_channel_of_their_own(store: Store, tmp_path: Path) -> None:
    export = labelled(Export(store, (Clip("town", 0, S),)), {"fast": "ego.speed > 1e6"})
    (written,) = write_export(export, tmp_path)

    found = [json.loads(data) for _, data in of(written.file, "/sgstore/labels")]

    assert [told["labels"] for told in found] == [{"fast": False}] * 11
    assert [told["seq"] for told in found] == list(range(11))
    assert not {"/sgstore/graph", "/sgstore/scene"} & {m[0] for m in messages(written.file)}


def test_foxgloves_own_classes_read_the_scene(store: Store, clip: Path) -> None:
    graphs = [json.loads(data) for _, data in of(clip, "/sgstore/graph")]
    scenes = of(clip, "/sgstore/scene")

    assert len(scenes) == len(graphs)
    for (time, data), graph in zip(scenes, graphs, strict=True):
        scene = SceneUpdate.FromString(data)
        (gone,) = scene.deletions
        assert (gone.type, gone.timestamp.ToNanoseconds()) == (1, time)
        entities = {one.id: one for one in scene.entities}
        assert len(entities) == len(scene.entities)
        assert {one.frame_id for one in scene.entities} == {"map"}
        assert {one.timestamp.ToNanoseconds() for one in scene.entities} == {time}
        for node in [one for one in graph["nodes"] if "x" in one]:
            entity = entities[node["name"]]
            (body,) = [*entity.cubes, *entity.spheres]
            place = body.pose.position
            assert (place.x, place.y) == (node["x"], node["y"])
            assert {pair.key: pair.value for pair in entity.metadata}["kind"] == node["kind"]
            if node["id"] >= 0 and not node["is_static"]:
                assert (body.size.x, body.size.y) == (node["length"], node["width"])
                assert entity.texts[0].text == node["name"]
        for relation in {edge["relation"] for edge in graph["edges"]}:
            (lines,) = entities[f"edges {relation}"].lines
            placed = {node["id"] for node in graph["nodes"] if "x" in node}
            count = sum(
                edge["relation"] == relation and {edge["src"], edge["dst"]} <= placed
                for edge in graph["edges"]
            )
            assert (lines.type, len(lines.points)) == (2, 2 * count)


def test_the_descriptors_of_the_scene_are_foxgloves() -> None:
    from google.protobuf import descriptor_pb2

    ours = descriptor_pb2.FileDescriptorSet.FromString(foxglove_scene.schema(foxglove_scene.SCENE))
    for message in next(f for f in ours.file if f.package == "foxglove").message_type:
        official = SceneUpdate.DESCRIPTOR.file.pool.FindMessageTypeByName(
            f"foxglove.{message.name}"
        )
        theirs = descriptor_pb2.DescriptorProto()
        official.CopyToProto(theirs)
        assert fields(message) == fields(theirs), message.name


def fields(message: Any) -> dict[str, tuple[Any, ...]]:
    return {
        one.name: (one.number, one.type, one.label, one.type_name.rpartition(".")[2])
        for one in message.field
    }


def test_entities_without_a_place_or_a_size_are_drawn_as_far_as_they_can_be() -> None:
    from sgstore.model.graph import SceneGraph

    nodes = {
        1: {"kind": "car", "name": "car 1", "is_ego": True, "x": 1.0, "y": 2.0},
        2: {"kind": "car", "name": "car 2", "is_ego": False},
        -3: {"kind": "road", "name": "7", "is_ego": False, "x": 0.0, "y": 0.0, "z": 1.0},
    }
    edges = [(1, "near", 2, {}), (1, "isIn", -3, {})]
    graph = SceneGraph(5, "drive", 0, 0, 1, nodes, edges)

    scene = SceneUpdate.FromString(foxglove_scene.message(graph, 7))

    assert [one.id for one in scene.entities] == ["car 1", "7", "edges isIn"]
    assert len(scene.entities[0].spheres) == 1


# The clip is the same clip ---------------------------------------------------------------------------


def test_all_other_messages_are_as_they_are_without_graphs(
    store: Store, clip: Path, tmp_path: Path
) -> None:
    (plain,) = write_export(Export(store, (Clip("town", 24 * S, 26 * S),)), tmp_path)

    assert [m for m in messages(clip) if m[0] not in OURS] == messages(plain.file)
    times = [m[1] for m in messages(clip) if m[1] >= 24 * S]
    assert times == sorted(times)


def test_a_clip_with_graphs_is_read_again_as_the_same_frames(
    store: Store, clip: Path, tmp_path: Path
) -> None:
    (plain,) = write_export(Export(store, (Clip("town", 24 * S, 26 * S),)), tmp_path / "plain")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    edges = "SELECT f.log_time_ns, src, relation, dst FROM edges JOIN frames f USING (frame_id) ORDER BY ALL"

    with_graphs, without = store_of(clip, tmp_path / "a"), store_of(plain.file, tmp_path / "b")

    assert with_graphs.sql(edges).values == without.sql(edges).values
    assert len(with_graphs.sql(edges)) > 1000


@pytest.mark.parametrize("flavour", ["osi", "carla", "foxglove"])
def test_a_clip_with_graphs_is_of_the_flavour_of_its_source(tmp_path: Path, flavour: str) -> None:
    path = tmp_path / "drive.mcap"
    if flavour == "osi":
        drive(path)
    elif flavour == "carla":
        carla_drive(path)
    else:
        with SceneRecorder.of(path, "protobuf") as recorder:
            for i in range(20):
                recorder.transform(i * 0.1, "map", "base_link", (i, 2, 0))
                recorder.scene(i * 0.1, [cube("ego", (i, 2, 0)), cube("b", (9, 0, 1))])
    ingest(tmp_path / "s.sgstore", [path])
    store = sgstore.open(tmp_path / "s.sgstore")
    (info,) = store.info()
    assert info.flavour == flavour
    whole = (Clip("drive", 0, 1 << 62),)

    for name, options in (("graphs", {"with_graph": True}), ("plain", {})):
        (written,) = write_export(Export(store, whole, **options), tmp_path / name)
        (tmp_path / name / "store").mkdir()
        again = store_of(written.file, tmp_path / name / "store")
        (read,) = again.info()
        assert (read.flavour, read.frames) == (flavour, info.frames)
        rows = "SELECT log_time_ns, n.kind, n.x, n.y FROM nodes n JOIN frames USING (frame_id) ORDER BY ALL"
        assert again.sql(rows).values == store.sql(rows).values


def test_a_clip_of_a_clip_has_its_own_graphs_once(clip: Path, tmp_path: Path) -> None:
    again = store_of(clip, tmp_path)
    (info,) = again.info()
    part = (Clip(info.name, 25 * S, 26 * S),)

    (kept,) = write_export(Export(again, part), tmp_path / "kept")
    (fresh,) = write_export(Export(again, part, with_graph=True), tmp_path / "fresh")

    assert [t for t, _ in of(kept.file, "/sgstore/graph")] == [
        t for t, _ in of(fresh.file, "/sgstore/graph")
    ]
    assert of(kept.file, "/sgstore/graph") == [
        m for m in of(clip, "/sgstore/graph") if m[0] >= 25 * S
    ]
    told = [json.loads(data)["trace"] for _, data in of(fresh.file, "/sgstore/graph")]
    assert set(told) == {info.name} != {"town"}


def test_graphs_in_clips_keep_to_their_own_numbers(tmp_path: Path) -> None:
    from sgstore.exporters._mcap_graphs import Added

    path = drive(tmp_path / "drive.mcap")
    ingest(tmp_path / "s.sgstore", [path])
    export = Export(sgstore.open(tmp_path / "s.sgstore"), (Clip("drive", 0, S),), with_graph=True)

    with pytest.raises(ExportError, match="leaves no numbers"):
        list(Added(export).definitions({65535: Schema(65535, b"", "", "")}, {}))
    numbers = [one.id for one in Added(export).definitions({4: Schema(4, b"", "", "")}, {})]
    assert numbers == [5, 1, 6, 2, 7, 3]


# The rules of MCAP -----------------------------------------------------------------------------------


def test_clips_keep_to_the_rules_of_the_doctor(store: Store, clip: Path, tmp_path: Path) -> None:
    found = examine(clip)

    assert (found.errors, found.warnings) == ([], [])
    for compression in ("zstd", "lz4", ""):
        path = drive(
            tmp_path / f"{compression}.mcap",
            frames=60,
            camera=False,
            compression=compression,
            chunk_size=900,
        )
        ingest(tmp_path / "s.sgstore", [path])
        own = sgstore.open(tmp_path / "s.sgstore")
        name = own.file.traces()[-1].name
        export = Export(own, (Clip(name, S, 4 * S),), with_graph=True)
        (written,) = write_export(export, tmp_path / f"out{compression}")
        assert examine(written.file).errors == []


@pytest.mark.data
@pytest.mark.parametrize(
    "name",
    [
        "osi_converter/testBrakeAndIndicatorLights.mcap",
        "esmini/cut-in.mcap",
        "omega_prime/osi_centerline_example.mcap",
        "carla/Town01.carla.mcap",
    ],
)
def test_clips_of_recordings_of_all_producers_keep_to_the_rules(
    data: Path, tmp_path: Path, name: str
) -> None:
    path = data / "traces" / name
    with open_trace(path) as trace:
        first = next(iter(trace.blocks())).log_time_ns
        source = Source(path, trace.info.digest, trace.info.context)
    span = Clip("t", int(first[0]), int(first[-1]))
    (written,) = write_clips([span], {"t": source}, tmp_path)

    assert examine(written.file).errors == []


SCHEMA = Schema(1, b"{}", "jsonschema", "Thing")
EMPTY = {"data": b"", "encoding": ""}
CHANNEL = Channel(1, "things", "json", {}, 1)


def said(time: int, number: int = 0) -> Message:
    return Message(channel_id=1, data=b"{}", log_time=time, publish_time=time, sequence=number)


def parts(**changed: Any) -> bytes:
    """A file of three messages, with some of its records, or of their values, changed."""
    stream, places = BytesIO(b"\x89MCAP0\r\n"), {}
    stream.seek(0, 2)

    def put(name: str, record: Any) -> int:
        at = stream.tell()
        for one in changed.get(name, [record]):
            builder = RecordBuilder()
            (replace(record, **one) if isinstance(one, dict) else one).write(builder)
            stream.write(builder.end())
        return at

    put("header", Header("", "a test"))
    put("schema", SCHEMA)
    put("channel", CHANNEL)
    inner = RecordBuilder()
    for i, time in enumerate(changed.get("times", (10, 20, 30))):
        places[inner.count] = time
        said(time, i).write(inner)
    records = inner.end()
    chunk = Chunk(
        compression="",
        data=records,
        message_start_time=10,
        message_end_time=30,
        uncompressed_crc=0,
        uncompressed_size=len(records),
    )
    at = put("chunk", chunk)
    length = stream.tell() - at
    index = [(time, place) for place, time in places.items()]
    start = put("index", MessageIndex(1, index))
    indexed = stream.tell() - start
    put("data_end", DataEnd(0))
    summary = put("schema_again", SCHEMA)
    put("channel_again", CHANNEL)
    put("statistics", Statistics(0, 1, {1: 3}, 1, 3, 30, 10, 0, 1))
    put(
        "chunk_index",
        ChunkIndex(length, at, "", len(records), 30, indexed, {1: start}, 10, len(records)),
    )
    put("footer", Footer(summary, 0, 0))
    stream.write(b"\x89MCAP0\r\n")
    return stream.getvalue()


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"schema": [{"id": 0}]}, "the id 0"),
        ({"schema": [{"encoding": ""}]}, "has data and no encoding"),
        ({"schema_again": [{"name": "Other"}]}, "two schema records of the id 1 differ"),
        ({"schema_again": [{"id": 9}]}, "schema 9 is in the summary and not in the data"),
        ({"schema_again": []}, "schema 1 of an indexed chunk is not in the summary"),
        ({"channel": [{"schema_id": 8}]}, "has a schema that is not known: 8"),
        ({"channel_again": [{"topic": "x"}]}, "two channel records of the id 1 differ"),
        ({"channel_again": []}, "channel 1 of an indexed chunk is not in the summary"),
        ({"channel": [], "channel_again": []}, "a message comes before its channel: 1"),
        ({"chunk": [{"compression": "zip"}]}, "unknown compression: 'zip'"),
        ({"chunk": [{"uncompressed_size": 7}]}, "bytes, not 7"),
        ({"chunk": [{"uncompressed_crc": 7}]}, "has another checksum"),
        ({"chunk": [{"message_start_time": 9}]}, "messages of other times than it says"),
        ({"chunk": [{"message_end_time": 31}]}, "messages of other times than it says"),
        ({"index": [{"records": [(11, 0)]}]}, "the index says 11 of a message at 10"),
        ({"chunk": []}, "a message index is behind no chunk"),
        ({"chunk": []}, "where no chunk begins"),
        ({"data_end": []}, "no DataEnd"),
        ({"footer": []}, "cannot be read"),
        ({"statistics": [{"message_count": 4}]}, "the statistics say 4 messages; there are 3"),
        ({"statistics": [{"channel_message_counts": {1: 2}}]}, "say 2 messages of channel 1, not 3"),
        ({"statistics": [{"message_start_time": 0}]}, "the times are 10 and 30"),
        ({"statistics": [{}, {}]}, "several statistics"),
        ({"chunk_index": [{}, {}]}, "several indexes of the chunk"),
        ({"chunk_index": [{"chunk_length": 3}]}, "length 3, not"),
        ({"chunk_index": [{"message_start_time": 3}]}, "first time 3, not 10"),
        ({"chunk_index": [{"message_end_time": 3}]}, "last time 3, not 30"),
        ({"chunk_index": [{"compression": "lz4"}]}, "compression lz4, not"),
        ({"chunk_index": [{"compressed_size": 3}]}, "stored size 3, not"),
        ({"chunk_index": [{"uncompressed_size": 3}]}, "size 3, not"),
        ({"chunk_index": [{"chunk_start_offset": 3}]}, "an index points to 3"),
        ({"chunk": [{}, {"data": b"\x0f" + b"\0" * 8, "uncompressed_size": 9}]}, "of the opcode 15"),
        (
            {"data_end": [said(9), said(8), DataEnd(0)]},
            "a message outside chunks is at 8",
        ),
    ],
)  # fmt: skip
def test_a_file_that_breaks_a_rule_is_found_out(
    tmp_path: Path, changed: dict[str, Any], says: str
) -> None:
    path = tmp_path / "file.mcap"
    path.write_bytes(parts(**changed))

    assert any(says in error for error in examine(path).errors), examine(path).errors


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"header": [{"library": ""}]}, "names no library"),
        ({"header": [{"profile": "mine"}]}, "not well known: 'mine'"),
        ({"schema": [{}, {}]}, "schema 1 is defined twice"),
        ({"channel": [{}, {}]}, "channel 1 is defined twice"),
        ({"schema": [EMPTY], "schema_again": [EMPTY]}, "is empty"),
        ({"times": (10, 30, 20)}, "a message at 20 comes after one at 30"),
        ({"index": []}, "no message index for a chunk"),
        ({"index": [{}, {}]}, "two message indexes of channel 1"),
        ({"index": [{"records": []}]}, "is not in its index"),
    ],
)  # fmt: skip
def test_what_is_unusual_is_a_warning(tmp_path: Path, changed: dict[str, Any], says: str) -> None:
    path = tmp_path / "file.mcap"
    path.write_bytes(parts(**changed))

    found = examine(path)

    assert any(says in warning for warning in found.warnings)
    assert found.errors == []


def test_a_file_without_fault_has_none(tmp_path: Path) -> None:
    path = tmp_path / "file.mcap"
    path.write_bytes(parts())

    assert (examine(path).errors, examine(path).warnings) == ([], [])


def test_a_clip_that_the_official_reader_reads_otherwise_is_not_handed_out(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sgstore.exporters._mcap as writer

    def forgets(self: Writer, *_message: Any) -> None:
        pass

    monkeypatch.setattr(writer.Writer, "add_message", forgets)
    with pytest.raises(ExportError, match="messages were written, 0 and 0 are read back"):
        write_export(Export(store, (Clip("town", 0, S),)), tmp_path / "out")
    assert not (tmp_path / "out").exists()
