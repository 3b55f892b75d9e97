"""Relations of other packages: by entry point, into stores made before, and where nobody knows them."""

from __future__ import annotations

import json
import re
import tomllib
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from graph_blocks import add_labels

from sgstore.apps.demo import RECORDING
from sgstore.base import plugins
from sgstore.errors import ConfigError, QueryNameError, StoreError
from sgstore.graphs.relations import BlockScene, Relation, edges_between, relations
from sgstore.ingest import ingest
from sgstore.model import vocabulary
from sgstore.model.config import Config, Direction, Proximity, as_toml, from_dict, load
from sgstore.query import Store
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.model.graph import Edges


def edges_of_pairs_abreast(scene: BlockScene) -> Edges:
    pairs = scene.pairs
    abreast = np.abs(np.abs(pairs.bearing) - np.pi / 2) < 0.5
    rows = np.flatnonzero(abreast & (pairs.distance < 5))
    return edges_between(scene, "abreast_of", pairs.b[rows], pairs.a[rows])


ABREAST_OF = Relation(
    name="abreast_of", doc="b → a: b is abreast of a", edges=edges_of_pairs_abreast, of_pairs=True
)
ABREAST = "SELECT frame_id, src, dst FROM edges WHERE relation = 'abreast_of' ORDER BY ALL"


def entry(loaded: Any) -> SimpleNamespace:
    def load() -> Any:
        if isinstance(loaded, Exception):
            raise loaded
        return loaded

    return SimpleNamespace(name="abreast_of", value="package:ABREAST_OF", load=load)


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The relations that are known, as if nothing had been added to those of this package."""
    own = list(vocabulary.OWN_RELATIONS)
    codes = {name: code for code, name in enumerate(own)}
    held: tuple[Any, ...] = (vocabulary._relations, vocabulary._relation_code)
    kept = [(one, one.copy()) for one in (*held, vocabulary._made_known)]

    def put(values: list[Any]) -> None:
        for (held, _), value in zip(kept, values, strict=True):
            held.clear()
            held.extend(value) if isinstance(held, list) else held.update(value)
        relations.cache_clear()
        vocabulary._add_plugins.cache_clear()

    monkeypatch.setattr(plugins, "entry_points", lambda group: [])
    put([own, codes, {}])
    yield vocabulary._relations
    put([before for _, before in kept])


def installed(monkeypatch: pytest.MonkeyPatch, loaded: Any = ABREAST_OF) -> None:
    found = {plugins.RELATIONS.group: [entry(loaded)]}
    monkeypatch.setattr(plugins, "entry_points", lambda group: found.get(group, []))
    relations.cache_clear()
    vocabulary._add_plugins.cache_clear()


def test_a_store_made_before_holds_a_relation_of_another_package(
    names: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "s.db"
    StoreFile.create(path)
    ingest(path, [RECORDING], until=4.0)
    with pytest.raises(QueryNameError, match="unknown relation 'abreast_of'"):
        Store(path).find("MATCH (a)-[:abreast_of]->(b)")
    before = Store(path).sql("SELECT * FROM edges ORDER BY ALL").values

    installed(monkeypatch)
    asked = "MATCH (a)-[:abreast_of]->(b) RETURN COUNT(*) AS n"
    assert list(Store(path).find(asked)) == [(0,)]  # unknown: it there
    ingest(path, [RECORDING], until=4.0, force=True)

    abreast = Store(path).sql(ABREAST).values
    assert abreast
    assert list(Store(path).find(asked)) == [(len(abreast),)]
    rest = "SELECT * FROM edges WHERE relation <> 'abreast_of' ORDER BY ALL"
    assert Store(path).sql(rest).values == before
    assert not Store(path).file.verify().faults


def test_a_store_answers_about_a_relation_that_nothing_here_knows(
    names: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, again = tmp_path / "s.db", tmp_path / "sorted.db"
    installed(monkeypatch)
    StoreFile.create(path)
    ingest(path, [RECORDING], until=4.0)
    abreast = Store(path).sql(ABREAST).values
    del names[len(vocabulary.OWN_RELATIONS) :]
    vocabulary._relation_code.pop("abreast_of")
    vocabulary._made_known.pop(("relation", "abreast_of"))
    installed(monkeypatch, None)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [])
    vocabulary.add_relation("comes_first")  # codes here are others than in the store
    again.write_bytes(path.read_bytes())

    store = Store(again)
    found = store.find("MATCH (a)-[r:abreast_of]->(b) RETURN COUNT(*) AS n")
    frame = abreast[0][0]
    edges = [(a, b) for a, b, name in store.graph(frame).edges(keys=True) if name == "abreast_of"]

    assert list(found) == [(len(abreast),)]
    assert sorted(edges) == sorted((a, b) for f, a, b in abreast if f == frame)
    assert not store.file.verify().faults
    whole = store.graph(frame, abstraction="SG")
    assert {name for *_, name in whole.edges(keys=True)} >= {"abreast_of", "isIn"}
    store.file.compact()
    assert store.sql(ABREAST).values == abreast


@pytest.mark.parametrize("label", ["Near", "vehicle", "a b", "1st", "x" * 41])
def test_a_store_whose_relations_are_no_names_is_refused(
    names: list[str], tmp_path: Path, label: str
) -> None:
    path = tmp_path / "s.db"
    StoreFile.create(path)
    add_labels(path, "relation", [label])

    with pytest.raises(StoreError, match="a relation: "):
        StoreFile(path)


def test_rungs_and_sectors_have_the_names_that_a_client_gives(
    names: list[str], tmp_path: Path
) -> None:
    own, usual = tmp_path / "own.db", tmp_path / "usual.db"
    config = Config(
        proximity=Proximity(("danger", "ok"), (4.0, 25.0)),
        direction=Direction(("fore", "aft"), (90.0,)),
    )
    for path, settings in ((own, config), (usual, Config())):
        StoreFile.create(path)
        ingest(path, [RECORDING], until=4.0, config=settings)
    counted = "SELECT count(*) FROM edges WHERE relation IN ({})"

    for new, old in (
        ("'danger'", "'safety_hazard', 'near_coll'"),
        ("'ok'", "'super_near', 'very_near', 'near', 'visible'"),
        ("'fore'", "'inDFrontOf', 'inSFrontOf'"),
        ("'aft'", "'atSRearOf', 'atDRearOf'"),
    ):
        wanted = Store(usual).sql(counted.format(old)).values
        assert Store(own).sql(counted.format(new)).values == wanted
    ((many,),) = Store(own).sql(counted.format("'danger'")).values
    assert list(Store(own).find("MATCH (a)-[:danger]->(b) RETURN COUNT(*) AS n")) == [(many,)]


@pytest.mark.parametrize("loaded", [ImportError("no such module"), 7])
def test_a_package_whose_relation_cannot_be_loaded_is_named(
    names: list[str], monkeypatch: pytest.MonkeyPatch, loaded: object
) -> None:
    installed(monkeypatch, loaded)

    with pytest.raises(ConfigError, match="the relation 'abreast_of'"):
        relations()


def edges_of_pairs_near_enough(scene: BlockScene) -> Edges:
    rows = np.flatnonzero(scene.pairs.distance < scene.parameters(NEAR_ENOUGH)["reach"])
    return edges_between(scene, "abreast_of", scene.pairs.b[rows], scene.pairs.a[rows])


NEAR_ENOUGH = Relation(
    name="abreast_of",
    doc="b → a: b is near a",
    edges=edges_of_pairs_near_enough,
    of_pairs=True,
    parameters={"reach": 5.0, "loud": False},
)


def test_a_relation_of_another_package_has_settings(
    names: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(monkeypatch, NEAR_ENOUGH)
    path, file = tmp_path / "s.db", tmp_path / "c.toml"
    file.write_text("[relations.abreast_of]\nreach = 3\n", encoding="utf-8")
    config = load(file)
    distances = "SELECT max(p.distance) FROM edges e JOIN pairs p USING (frame_id, src, dst)"
    reached = dict[float, float]()
    for reach, one in {5.0: Config(), 3.0: config}.items():
        StoreFile.create(path)
        ingest(path, [RECORDING], until=4.0, config=one)
        ((reached[reach],),) = Store(path).sql(f"{distances} WHERE relation = 'abreast_of'").values
        ((kept,),) = StoreFile(path).rows("SELECT settings FROM config").values
        assert json.loads(kept)["relations"] == (
            {} if reach == 5 else {"abreast_of": {"reach": 3.0, "loud": False}}
        )
        path.unlink()

    assert 0 < reached[3.0] <= 3 < reached[5.0] <= 5
    assert "[relations.abreast_of]\nreach = 3.0\nloud = false" in as_toml(config)
    assert from_dict(tomllib.loads(as_toml(config))) == config
    assert from_dict(json.loads(json.dumps(config.as_dict()))) == config


def test_a_relation_that_the_tree_lists_has_settings(
    names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(plugins.RELATIONS.own, "abreast_of", "unused:ABREAST_OF")
    monkeypatch.setitem(plugins.RELATIONS._loaded, "abreast_of", NEAR_ENOUGH)
    relations.cache_clear()

    config = from_dict({"relations": {"abreast_of": {"reach": 3}}})

    assert config.relations == {"abreast_of": {"reach": 3.0, "loud": False}}
    with pytest.raises(ConfigError, match="expected a number"):
        from_dict({"relations": {"abreast_of": {"reach": "far"}}})
    with pytest.raises(ConfigError, match="'relations' is 'near'; expected no table"):
        from_dict({"relations": {"near": {}}})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"abreast_of": {"reach": "far"}},
            "'relations.abreast_of.reach' is 'far'; expected a number",
        ),
        ({"abreast_of": {"loud": 1}}, "'relations.abreast_of.loud' is 1; expected true or false"),
        ({"abreast_of": {"raech": 3}}, "did you mean 'relations.abreast_of.reach'"),
        ({"abreast": {"reach": 3}}, "'relations' is 'abreast'; expected 'abreast_of', perhaps"),
        ({"near": {}}, "'relations' is 'near'"),
        ({"abreast_of": 3}, "a table"),
    ],
)
def test_settings_of_a_relation_are_checked(
    names: list[str], monkeypatch: pytest.MonkeyPatch, given: Any, message: str
) -> None:
    installed(monkeypatch, NEAR_ENOUGH)

    with pytest.raises(ConfigError, match=re.escape(message)):
        from_dict({"relations": given})


def test_edges_that_no_relation_declares_are_refused(
    names: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vocabulary.add_relation("strange")

    def strange(scene: BlockScene) -> Edges:
        return edges_between(scene, "strange", scene.pairs.b, scene.pairs.a)

    installed(monkeypatch, Relation(name="abreast_of", doc="", edges=strange, of_pairs=True))
    StoreFile.create(tmp_path / "s.db")

    (outcome,) = ingest(tmp_path / "s.db", [RECORDING], until=1.0)

    assert "a relation of another package gives edges strange" in str(outcome.error)
