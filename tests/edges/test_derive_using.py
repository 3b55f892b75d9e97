"""``USING ABSTRACTION`` and ``frame.class``: a derived set answers as a store made with its settings does."""

from __future__ import annotations

from importlib import resources

import pytest
from recordings import Recorder, car

import sgstore
from sgstore.apps.cli import run
from sgstore.errors import AbstractionError, QueryError, QueryNameError
from sgstore.graphs.abstractions import SUBSETS
from sgstore.ingest import ingest
from sgstore.model.config import configured
from sgstore.model.vocabulary import RELATIONS
from sgstore.pipeline.derive import derive, keep_abstraction

pytestmark = pytest.mark.seconds(6)

SAMPLE = resources.files("sgstore") / "apps" / "sample" / "town.mcap"
OTHER = configured(
    range={"radius": 28.0, "by": "centre"},
    proximity={"upper": [3.0, 5.0, 9.0, 12.0, 18.0, 28.0]},
    direction={"upper": [30.0, 60.0, 120.0]},
    without=["overlaps"],
)
QUERIES = [
    "MATCH (v:Vehicle)",
    "MATCH (p:Person) WHERE p.speed > 1",
    "MATCH (e:Ego)",
    "MATCH (e:Ego)-[d:near_coll|very_near]->(v)",
    "MATCH (a)-[:inDFrontOf]->(b:Ego), (a)-[:isIn]->(l:Lane) WHERE dist(a, b) < 20",
    "MATCH (l:Lane)-[:opposes]->(m:Lane) RETURN l.name, m.name, COUNT(*) AS n",
    "MATCH (e:Ego)-[:isIn*2]->(r:Road) RETURN r.id, COUNT(*) AS n",
    "MATCH (e:Ego) WHERE COUNT {(v:Vehicle)} > 2 RETURN frame.seq",
    "MATCH (e:Ego) WHERE NOT EXISTS {(e)-[:visible]-(:Person)} RETURN INTERVALS",
    "MATCH (s:Vegetation) RETURN s.id, COUNT(*) AS n",
    "MATCH (a:Car), (b:Car) WHERE gap(a, b) < 3 RETURN a.id, b.id, COUNT(*) AS n",
    "MATCH (a)-[r]->(b) RETURN type(r) AS r, a.kind AS a, b.kind AS b, COUNT(*) AS n",
    "MATCH (v:Vehicle) RETURN CLIPS(-1s, +1s)",
]


def made(path, config=None):
    (outcome,) = ingest(path, [str(SAMPLE)], config=config, until=20.0)
    assert outcome.error is None
    return sgstore.open(path)


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("using")
    first = made(folder / "a.sgstore")
    derive(first.file.path, OTHER, "other")
    return first, made(folder / "b.sgstore", OTHER)


@pytest.mark.parametrize("query", QUERIES)
def test_a_derived_set_answers_as_a_store_made_with_its_settings(stores, query) -> None:
    derived, ingested = stores
    ours = derived.find(f"USING ABSTRACTION other {query}")
    theirs = ingested.find(query)

    assert sorted(map(repr, ours.rows())) == sorted(map(repr, theirs.rows()))
    assert ours.count() == theirs.count() > 0
    assert list(ours.frames()) == list(theirs.frames())
    assert list(ours.clips(1, 1)) == list(theirs.clips(1, 1))


@pytest.mark.parametrize("relation", RELATIONS)
def test_a_relation_that_a_set_lacks_is_an_error(stores, relation: str) -> None:
    derived, ingested = stores
    answers = derived.file.deriving.sets()[0].answers
    query = f"MATCH (a) WHERE NOT EXISTS {{(a)-[:{relation}]->(b)}}"

    assert (ingested.find(query).left_out == ()) == (relation in answers)
    if relation in answers:
        assert derived.find(f"USING ABSTRACTION other {query}").left_out == ()
        return
    for ask in (derived.find, derived.check):
        text = query if ask == derived.find else f"CHECK ALWAYS EXISTS {{(a)-[:{relation}]->(b)}}"
        with pytest.raises(QueryError, match=f"'other' has no relation '{relation}'") as raised:
            list(ask(f"USING ABSTRACTION other {text}"))
        assert "it has: " in (raised.value.hint or "")


def test_a_set_of_traces_without_a_map_knows_nothing_of_lanes(tmp_path) -> None:
    with Recorder(tmp_path / "field.mcap") as recorder:
        recorder.ground_truth(0.0, [car(1, 0, 0), car(2, 9, 0)], host=1)
    assert ingest(tmp_path / "s.sgstore", [tmp_path / "field.mcap"])[0].error is None
    derive(tmp_path / "s.sgstore", OTHER, "other")
    store = sgstore.open(tmp_path / "s.sgstore")

    assert store.find("USING ABSTRACTION other MATCH (a)-[:isIn]->(b)").left_out == ("field",)
    with pytest.raises(QueryError, match="'other' has no relation 'overlaps'"):
        store.find("USING ABSTRACTION other MATCH (a)-[:overlaps]->(b)")


def test_the_name_may_be_a_parameter_and_case_does_not_matter(stores) -> None:
    store, _ = stores
    query = "USING ABSTRACTION {0} MATCH (e:Ego)-[:near]->(v)"
    wanted = store.find(query.format("other")).rows()

    assert store.find(query.format("Other")).rows() == wanted
    assert store.find(query.format("$set"), set="other").rows() == wanted
    assert store.find("MATCH (e:Ego)-[:near]->(v)").rows() != wanted


@pytest.mark.parametrize("name", SUBSETS)
def test_abstractions_of_the_literature_show_their_own_nodes_and_relations(stores, name) -> None:
    store, _ = stores
    rows = store.find(
        f"USING ABSTRACTION {name} MATCH (a)-[r]->(b) RETURN type(r) AS r, a.kind AS a, b.kind AS b"
    ).rows()
    nodes = store.find(f"USING ABSTRACTION {name} MATCH (a) RETURN DISTINCT a.kind").rows()
    of = SUBSETS[name]

    if of.kinds is None:
        return
    assert {r for r, *_ in rows} <= of.moving | of.lasting
    assert bool(rows) == bool(of.moving)
    assert {kind for (kind,) in nodes} <= of.kinds
    assert ("lane",) in nodes or name in {"E", "ER"}


def test_a_relation_that_an_abstraction_has_not_is_an_error(stores) -> None:
    store, _ = stores

    with pytest.raises(QueryError, match="'E' has no relation 'near'"):
        store.find("USING ABSTRACTION E MATCH (a)-[:near]->(b)")
    with pytest.raises(QueryNameError, match="unknown abstraction 'othr'"):
        store.find("USING ABSTRACTION othr MATCH (a:Ego)")


def test_frames_are_found_by_their_class(stores) -> None:
    store, _ = stores
    classes = store.classes("E")
    wanted = classes["class"][40]
    same = [int(f) for f, c in zip(*classes.values(), strict=True) if c == wanted]
    query = "MATCH (e:Ego) WHERE frame.class('E') = $c RETURN frame.id, frame.class"
    found = store.find(query, c=wanted).rows()
    rsv = dict(zip(*(column.tolist() for column in store.classes("RSV").values()), strict=True))

    assert [frame for frame, _ in found] == same
    assert all(rsv[frame] == cls for frame, cls in found)
    assert store.find("MATCH (e:Ego) WHERE frame.class_E = $c", c=wanted).count() == len(same)
    rows = store.sql(f"SELECT count(*) FROM classes WHERE abstraction = 'E' AND class = '{wanted}'")
    assert rows.values == [(len(same),)]


@pytest.mark.parametrize(
    "query", ["MATCH (e:Ego) RETURN frame.class('none')", "MATCH (e:Ego) RETURN e.class('E')"]
)
def test_a_class_that_is_not_known_is_an_error(stores, query) -> None:
    with pytest.raises(QueryError):
        stores[0].find(query)


def test_roadscene2vec_can_be_kept_and_asked(stores) -> None:
    store, _ = stores
    with pytest.raises(QueryNameError):
        store.find("USING ABSTRACTION roadscene2vec MATCH (e:Ego)")
    (first,) = keep_abstraction(store.file.path, "RoadScene2Vec")
    (again,) = keep_abstraction(store.file.path, "roadscene2vec")
    found = store.find(
        "USING ABSTRACTION roadscene2vec MATCH (a)-[r]->(b:Ego) RETURN frame.seq, a.id, type(r)"
    ).rows()
    wanted = {
        (seq, int(a.rsplit("_", 1)[1]), label)
        for seq in range(0, 200, 40)
        for a, b, label in store.graph(f"town#{seq}", abstraction="roadscene2vec").edges(
            data="label"
        )
        if b == "ego_car"
    }

    assert (first.status, again.status) == ("derived", "present")
    assert {row for row in found if row[0] in range(0, 200, 40)} == wanted
    assert wanted
    assert not store.file.verify().faults
    with pytest.raises(AbstractionError, match="without a derived set"):
        keep_abstraction(store.file.path, "RSV")


def test_the_verb_derives_lists_and_removes(stores, tmp_path, capsys) -> None:
    store, _ = stores
    config = tmp_path / "near.toml"
    config.write_text("[pairs]\nwithin = 5\n", encoding="utf-8")
    path = str(store.file.path)

    assert run(["derive", path, "--config", str(config), "--name", "near5"]) == 0
    assert run(["derive", path, "--json"]) == 0
    assert '"near5"' in capsys.readouterr().out
    assert run(["derive", path, "--config", str(config), "--name", "RSV"]) == 1
    assert run(["derive", path, "--config", str(config)]) == 2
    config.write_text("[range]\nradius = 500\n", encoding="utf-8")
    assert run(["derive", path, "--config", str(config), "--name", "far"]) == 2
    assert "ingest the recording anew" in capsys.readouterr().err
    assert run(["derive", path, "--remove", "near5"]) == 0
    assert run(["derive", path, "--remove", "near5"]) == 1
