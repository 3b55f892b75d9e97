"""Settings from end to end: what a store holds of a recording that was ingested with them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from conftest import REPOSITORY

from sgstore.apps.cli import run
from sgstore.ingest import ingest
from sgstore.maps.map_files import Maps
from sgstore.maps.opendrive import SIGNS
from sgstore.model.config import Config, configured, from_dict, preset
from sgstore.model.vocabulary import KIND_CODE, TypeMeaning
from sgstore.query import Store
from sgstore.readers import open_trace
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap

SAMPLE = REPOSITORY / "sgstore/apps/sample/town.mcap"


def stored(folder: Path, config: Config) -> Path:
    (outcome,) = ingest(folder / "s.db", [SAMPLE], config=config)
    assert (outcome.error, outcome.status) == (None, "added")
    return folder / "s.db"


def rows(store: Path, sql: str) -> list[tuple[Any, ...]]:
    return list(Store(store).sql(sql))


def test_a_preset_by_name_is_recorded_with_the_trace(tmp_path: Path) -> None:
    store = tmp_path / "s.db"

    line = ["ingest", str(store), str(SAMPLE), "--until", "1s", "--preset", "carlasgg", "--json"]
    assert run(line) == 0

    (trace,) = StoreFile(store).traces()
    assert from_dict(trace.settings) == preset("carlasgg")


def test_lanes_without_sections_stay_so_in_the_store(tmp_path: Path) -> None:
    config = configured(lanes={"sections": False}, rate=0.5)

    store = stored(tmp_path, config)

    names = {name for (name,) in rows(store, "SELECT DISTINCT name FROM nodes WHERE kind = 'lane'")}
    assert names
    assert not any("/" in name for name in names)
    flows = "SELECT count(*) FROM edges WHERE relation = 'travelsTo'"
    assert rows(store, flows)[0][0] > 0
    (again,) = ingest(store, [SAMPLE], config=config)
    assert again.status == "present"


def test_types_are_in_the_store_as_the_client_says(tmp_path: Path) -> None:
    told = {"TYPE_PEDESTRIAN": TypeMeaning("animal", "service", "dog")}
    (name,) = {"TYPE_PEDESTRIAN"}

    store = stored(tmp_path, Config(types=told, rate=0.5))

    kinds = rows(
        store, f"SELECT DISTINCT kind, special, subkind FROM entities WHERE type_name = '{name}'"
    )
    assert kinds == [("animal", "service", "dog")]
    assert rows(store, "SELECT count(*) FROM entities WHERE kind = 'person'") == [(0,)]


@pytest.mark.parametrize("of", ["rectangle", "corridor"])
def test_graphs_in_a_store_have_the_range_that_was_asked_for(tmp_path: Path, of: str) -> None:
    config = configured(range={"shape": of, "front": 30, "rear": 0, "side": 9}, rate=0.5)

    store = stored(tmp_path, config)

    ahead = """
        SELECT max(abs(p.lat)), min(p.lon), max(p.lon) FROM pairs p
        WHERE p.src_is_ego AND p.dst_kind = 'car'
    """
    (aside, behind, before) = rows(store, ahead)[0]
    assert behind > (-4 if of == "rectangle" else -9)
    assert before <= (30 if of == "rectangle" else 100) + 6
    assert aside <= (9 if of == "rectangle" else 100) + 6


def test_signs_of_a_recordings_own_map_are_what_the_client_says() -> None:
    config = Config(types={"306": TypeMeaning("yield_sign"), "TYPE_CAR": TypeMeaning("bus")})
    with open_trace(SAMPLE) as trace:
        plain, told = (Maps(None, signs).of(trace.info)[0] for signs in (SIGNS, config.signs))
    assert plain is not None
    assert told is not None

    def count(of: RoadMap) -> int:
        return int((of.nodes.kind == KIND_CODE["yield_sign"]).sum())

    assert (count(plain), count(told)) == (1, 2)
    assert plain.digest != told.digest
