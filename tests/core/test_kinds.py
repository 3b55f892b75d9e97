"""What things are: no more and no less than a recording says, and the same in every room."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from recordings import Recorder, car
from test_cli_ingest import in_json, sgstore

import sgstore as library
from sgstore import exporters
from sgstore.exporters import Export, write_export
from sgstore.graphs.online import Frame
from sgstore.ingest import ingest
from sgstore.lang.syntax import node_of_kind
from sgstore.model.vocabulary import ENTITY_KINDS, SUPER_KINDS, VEHICLES
from sgstore.model.world import Clip
from sgstore.pipeline.importing import import_graphs

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store

MOVING = (*VEHICLES, "person", "animal", "unknown")


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A store of a recording with one entity of every kind, named after it, around an ego that is a car."""
    folder = tmp_path_factory.mktemp("kinds")
    with exporters.Recorder(folder / "all.mcap") as recording:
        for step in range(3):
            frame = Frame(step * 10**8, ego="ego")
            frame.add("ego", "car", 0.0, 0.0, 0.7, heading=0.0, length=4.0, width=2.0, height=1.4)
            for i, kind in enumerate(ENTITY_KINDS):
                static = kind not in {*MOVING, "traffic_light"}
                box = {} if static else {"length": 1.0, "width": 1.0, "height": 1.0}
                frame.add(kind, kind, 3.0 + i, 5.0, 1.0, heading=0.0, static=static, **box)
            recording.frame(frame)
    (outcome,) = ingest(folder / "s.sgstore", [folder / "all.mcap"])
    assert outcome.error is None
    return library.open(folder / "s.sgstore")


def found(store: Store, pattern: str) -> set[str]:
    """The kinds of those that a pattern of the variable x finds."""
    return {row[0] for row in store.find(f"MATCH {pattern} RETURN DISTINCT x.kind")}


def test_every_kind_comes_back_from_a_recording_in_osi(everything: Store) -> None:
    rows = everything.sql("SELECT kind FROM entities WHERE ident <> 'ego'").values

    assert sorted(kind for (kind,) in rows) == sorted(ENTITY_KINDS)


@pytest.mark.parametrize("kind", ENTITY_KINDS)
def test_a_kind_is_found_by_its_own_name_alone(everything: Store, kind: str) -> None:
    assert found(everything, node_of_kind(kind, "x")) == {kind}
    assert found(everything, f"(x:!Ego {{kind: '{kind}'}})") == {kind}


@pytest.mark.parametrize("label", SUPER_KINDS)
def test_a_label_of_several_kinds_finds_them_all(everything: Store, label: str) -> None:
    assert found(everything, f"(x:{label}&!Ego)") == set(SUPER_KINDS[label])


def test_a_vehicle_of_which_no_more_is_said_is_a_vehicle_and_no_car(everything: Store) -> None:
    assert "vehicle" in found(everything, "(x:Vehicle)")
    assert found(everything, "(x:Car&!Ego)") == {"car"}


def test_an_example_with_such_a_vehicle_finds_its_own_frame_and_says_the_kind(
    everything: Store,
) -> None:
    ignored = [kind for kind in ENTITY_KINDS if kind not in VEHICLES]
    text = everything.pattern("all#1", ignore=ignored)

    assert "{kind: 'vehicle'}" in text
    assert everything.find(text).count() == 3


def test_each_vehicle_but_a_train_is_an_actor_of_roadscene2vec(everything: Store) -> None:
    seen = everything.graph("all#1", "roadscene2vec").nodes(data="base_class")
    ridden = [actor for _, actor in seen if actor in {"car", "moto", "bicycle"}]

    assert len(ridden) == len(VEHICLES) - 1


def test_each_vehicle_has_a_colour_of_its_own_kind(everything: Store, tmp_path: Path) -> None:
    export = Export(everything, (Clip("all", 0, 10**9),), with_graph=True)
    (written,) = write_export(export, tmp_path / "out")
    with written.file.open("rb") as file:
        found = make_reader(file).iter_messages(topics=["/sgstore/scene"])
        scene = SceneUpdate.FromString(next(message.data for _, _, message in found))
    colours = {
        next(pair.value for pair in one.metadata if pair.key == "kind"): (
            body.color.r,
            body.color.g,
        )
        for one in scene.entities
        for body in [*one.cubes, *one.spheres]
        if one.id != "ego"
    }

    assert {*VEHICLES} <= colours.keys()
    assert {colours[kind] for kind in VEHICLES}.isdisjoint({colours["prop"], colours["unknown"]})


def test_a_vehicle_of_a_graph_from_elsewhere_is_one_and_no_more(tmp_path: Path) -> None:
    rows = "graph,src,relation,dst\na,vehicle,near,ego\na,vehicle.my.own_1,near,ego\n"
    (tmp_path / "g.csv").write_text(rows)
    import_graphs(tmp_path / "s.sgstore", [tmp_path / "g.csv"], "csv")

    kinds = library.open(tmp_path / "s.sgstore").sql("SELECT kind FROM nodes WHERE NOT is_ego")
    assert kinds.values == [("vehicle",)] * 2


OSI_TYPES = {0: "unknown", 1: "unknown", 2: "vehicle", 3: "person", 4: "animal", 99: "unknown"}
"""``MovingObject.Type`` → the kind without a class."""
OSI_CLASSES = {0: "", 1: "", 4: "car", 6: "van", 7: "truck", 11: "bicycle", 99: ""}
"""``VehicleClassification.Type`` → the kind that it says."""


def test_osi_says_a_class_of_vehicles_and_of_what_it_gives_no_type(tmp_path: Path) -> None:
    things, expected = [], {}
    for ident, (type_, class_) in enumerate(product(OSI_TYPES, OSI_CLASSES), start=1000):
        thing = car(ident, 6.0 * ident)
        raw = thing.SerializeToString()
        # Numbers that the schema does not have cannot be set, only written.
        raw = raw.replace(b"\x18\x02", bytes((0x18, type_)), 1)
        raw = raw.replace(b"\x08\x04", bytes((0x08, class_)), 1) if class_ != 4 else raw
        thing = type(thing).FromString(raw)
        things.append(thing)
        told = OSI_CLASSES[class_]
        if type_ in {0, 2}:  # whatever class it has, it is one of vehicles
            expected[str(ident)] = told or ("vehicle" if class_ else OSI_TYPES[type_])
        else:
            expected[str(ident)] = OSI_TYPES[type_]
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.ground_truth(0.0, things)
        recorder.ground_truth(0.1, things)

    (outcome,) = ingest(tmp_path / "s.sgstore", [tmp_path / "a.mcap"])
    assert outcome.error is None
    rows = library.open(tmp_path / "s.sgstore").sql("SELECT ident, kind FROM entities").values
    assert dict(rows) == expected


def test_what_is_said_of_a_type_without_a_kind_ends_with_what_helps(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        for time in (0.0, 0.1):
            recorder.ground_truth(time, [car(1, type=0), car(2, 9.0, type=0), car(3, 18.0)])

    run = sgstore("ingest", tmp_path / "s.sgstore", tmp_path / "a.mcap")
    (line,) = [one for one in run.stderr.decode().splitlines() if "TYPE_VEHICLE" in one]
    assert "2 entities of type 'TYPE_VEHICLE'" in line

    head, remedy = line.rsplit("[types] ", 1)
    assert "--config" in head
    (tmp_path / "types.toml").write_text("[types]\n" + remedy.replace("…", "truck"))
    run = sgstore(
        *("ingest", tmp_path / "s.sgstore", tmp_path / "a.mcap", "--force"),
        *("--config", tmp_path / "types.toml"),
    )
    assert "TYPE_VEHICLE" not in run.stderr.decode()
    rows = in_json("sql", tmp_path / "s.sgstore", "SELECT kind FROM entities ORDER BY ident")
    assert [row["kind"] for row in rows] == ["truck", "truck", "car"]
