"""Digests of graphs: a change of one value changes the digests of the same frames as in format 1."""

from __future__ import annotations

import random
import shutil
from typing import TYPE_CHECKING

import duckdb
import pytest
from graph_blocks import RandomTrace, map_stub, publish
from thorough import some

from sgstore.store import StoreFile, graph_digests

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(4)

CHANGES = {
    "frame": ("ego", "bit"),
    "state": ("x", "kind", "node_id", "frame_id", "lights", "special", "vy", "is_ego"),
    "node": ("mask", "node_id", "bucket"),
    "edge": ("mask", "relation", "src", "dst", "bucket"),
    "lane_single": ("lane_offset", "lane", "bit"),
    "lane_repeated": ("along", "mask", "is_primary"),
    "gap_single": ("gap", "dst"),
    "entity": ("node_id", "subkind", "length"),
    "map_node": ("x", "junction", "node_id"),
    "map_edge": ("dst", "relation"),
    "trace": ("origin_x", "map_id"),
    "bucket": ("map_id",),
}
KNOWN = [(table, column) for table, columns in CHANGES.items() for column in columns]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("digests") / "s.db"
    store = StoreFile.create(path)
    roads = map_stub()
    for number, frames in ((1, 64), (2, 4)):
        publish(store, RandomTrace(number, frames=frames, road_map=roads, path=str(number)))
    store.close()
    return path


def digests(path: Path) -> list[set[tuple[int, str]]]:
    """Frame ids with their digests: of format 1, and of format 2."""
    file = StoreFile(path)
    try:
        ids = file.abstracted.times()[0]
        groups = [ids[i : i + 1] for i in range(len(ids))]
        both = (graph_digests(file, groups, older=older) for older in (True, False))
        return [set(zip(ids.tolist(), found, strict=True)) for found in both]
    finally:
        file.close()


@pytest.mark.parametrize(("table", "column"), some(KNOWN, 4))
def test_a_changed_value_changes_the_digests_of_its_frames(
    whole: Path, tmp_path: Path, table: str, column: str
) -> None:
    before = digests(whole)
    changed = tmp_path / "s.db"
    shutil.copyfile(whole, changed)
    with duckdb.connect(str(changed)) as connection:
        place = f"inside.{table}"
        types = {
            name: kind for name, kind, *_ in connection.execute(f"DESCRIBE {place}").fetchall()
        }
        other = {
            "BOOLEAN": f"NOT {column}",
            "VARCHAR": f"coalesce({column}, '') || 'x'",
            "ENUM": f"enum_range({column})[2 - enum_code({column})::INTEGER % 2]",
        }.get(types[column].partition("(")[0], f"coalesce({column}, 0) + 1")
        other = "xor(mask, 5)" if column == "mask" else other
        rows = connection.execute(f"SELECT rowid FROM {place}").fetchall()
        (row,) = random.choice(rows)
        connection.execute(f"UPDATE {place} SET {column} = {other} WHERE rowid = {row}")

    after = digests(changed)

    old, new = ({i for i, _ in was ^ now} for was, now in zip(before, after, strict=True))
    assert old <= new
