"""Unknown values: the catalog names the kinds that lack them; conditions on other kinds are left out."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from thorough import LONG

from sgstore.apps.demo import RECORDING
from sgstore.ingest import ingest
from sgstore.lang.library import patterns
from sgstore.query import Store
from sgstore.store import _catalog

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(30)

CHANGES = {
    "whole": [],
    "some headings": ["UPDATE {0} SET heading = NULL WHERE kind = 'car' AND frame_id % 7 < 3"],
    "a size": ["UPDATE {0} SET length = NULL, width = NULL WHERE kind = 'person'"],
    "the ego": ["UPDATE {0} SET heading = NULL, speed = NULL WHERE is_ego AND frame_id % 5 = 0"],
    "many": [
        "UPDATE {0} SET height = NULL WHERE node_id % 3 = 0",
        "UPDATE {0} SET speed = NULL WHERE node_id % 4 = 1 AND frame_id % 2 = 0",
        "UPDATE {0} SET width = NULL WHERE is_ego",
    ],
}
"""Values that are taken away from the tables of states."""

CHECKS = ["phi1", "phi4", "phi5", "phi6", "phi7", "rss_distance", "r_i1_stopping"]
OWN = [
    "CHECK ALWAYS NOT EXISTS {(ego)-[:isIn]->(:Lane)<-[:isIn]-(v:Vehicle) WHERE dist(ego, v) < 8}",
    "CHECK FORALL (v:Vehicle) ALWAYS NOT EXISTS {(ego)-[:overlaps]->(v)}",
    "CHECK EVENTUALLY COUNT {(ego)-[:isIn]->(:Lane)<-[:isIn]-(v:Entity)} > 2",
    "CHECK FORALL (p:Person) ALWAYS (EXISTS {(p)-[:inDFrontOf]->(ego)} IMPLIES p.speed < 9)",
    "CHECK ALWAYS ego.heading IS NOT NULL",
]


def verdicts(path: Path) -> list[Any]:
    """Every verdict with its violations, and what patterns match."""
    store = Store(path)
    with store.file.snapshot():
        texts = [*(patterns()[name].text for name in CHECKS), *OWN]
        found: list[Any] = [
            (one.check, one.trace, one.verdict, str(one.violations))
            for text in texts
            for one in store.check(text)
        ]
        missing = "MATCH (v:Vehicle) WHERE v.width IS NULL OR v.heading IS NULL RETURN COUNT(*)"
        optional = (
            "MATCH (e:Ego) OPTIONAL MATCH (e)-[:near_coll]->(v:Car)"
            " WITH e, v WHERE v.length IS NULL RETURN COUNT(*)"
        )
        found += [[tuple(row) for row in store.find(text).rows()] for text in (missing, optional)]
        return found


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first part of the bundled recording; ``make oracle`` uses all of it."""
    path = tmp_path_factory.mktemp("town") / "town.sgstore"
    (outcome,) = ingest(path, [RECORDING], until=None if LONG else 27)
    assert outcome.error is None
    return path


@pytest.mark.parametrize("changed", CHANGES if LONG else ["some headings", "many"])
def test_conditions_left_out_change_no_answer(
    changed: str, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "town.sgstore"
    shutil.copy(store, path)
    with duckdb.connect(str(path)) as connection:
        for table in ("inside.state", "inside.world_state"):
            for text in CHANGES[changed]:
                connection.execute(text.format(table))

    ours = verdicts(path)
    copy = tmp_path / "other.sgstore"  # another name, because catalogs are kept
    shutil.copy(path, copy)
    monkeypatch.setattr(_catalog, "_lacking", lambda *_: {})
    theirs = verdicts(copy)

    assert ours == theirs
    assert len({verdict for *_, verdict, _ in ours[: len(CHECKS)]}) > 1


@pytest.mark.parametrize("name", ["heading", "length", "width", "height", "speed", "vx"])
def test_parts_of_the_map_lack_values_too(name: str, open_town: Store) -> None:
    found = open_town.find(f"MATCH (n) WHERE n.{name} IS NULL RETURN COUNT(*)").rows()
    assert found == open_town.sql(f"SELECT count(*) FROM nodes WHERE {name} IS NULL").values


def test_the_catalog_names_the_kinds_that_lack_a_value(town_store: Path, tmp_path: Path) -> None:
    path = tmp_path / "town.sgstore"
    shutil.copy(town_store, path)
    with duckdb.connect(str(path)) as connection:
        connection.execute(
            "UPDATE inside.state SET heading = NULL WHERE kind = 'car' AND frame_id % 60 = 1"
        )
        (cars,) = connection.execute(
            "SELECT count(*) FROM inside.state WHERE heading IS NULL"
        ).fetchone() or (0,)

    lacking = Store(path).file.catalog().lacking

    assert cars
    assert lacking["heading"] & {"car", "truck", "person"} == {"car"}
    assert not lacking["speed"] & {"car", "truck", "person"}
