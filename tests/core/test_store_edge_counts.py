"""Counts of edges in SQL: from masks, equal to the counts of single rows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from recordings import Recorder, car

from sgstore.ingest import ingest
from sgstore.query import Store
from sgstore.store._edge_counts import counted_edges

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    folder = tmp_path_factory.mktemp("counts")
    with Recorder(folder / "run.mcap") as recorder:
        for number in range(70):
            cars = [car(7 + i, x + number, v=(10, 0)) for i, x in enumerate((0, 12, 25))]
            recorder.ground_truth(number / 10, cars[: 2 + number % 2], host=7)
    ingest(folder / "x.sgstore", [folder / "run.mcap"])
    with Store(folder / "x.sgstore") as opened:
        yield opened


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT relation, count(*) FROM edges GROUP BY relation ORDER BY relation",
        "SELECT e.src, count(*) AS n FROM main.edges AS e WHERE relation IN ('near', 'visible')"
        " AND src_is_ego GROUP BY 1 HAVING count(*) > 3 ORDER BY n DESC, 1",
        "SELECT count(*) FROM edges",
        "SELECT count(*) FROM edges WHERE relation = 'tows'",
        "FROM edges SELECT src_kind, dst, count(*) GROUP BY ALL ORDER BY 1, 2",
    ],
)
def test_counts_from_masks_equal_those_of_rows(sql: str, store: Store) -> None:
    of_rows = sql.replace("count(*)", "count(frame_id)")

    assert counted_edges(sql) is not None
    assert counted_edges(of_rows) is None
    assert store.sql(sql).values == store.sql(of_rows).values


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT frame_id, count(*) FROM edges GROUP BY frame_id",
        "SELECT relation, count(DISTINCT frame_id) FROM edges GROUP BY relation",
        "SELECT count(*) FROM edges WHERE random() < 0.5",
        "SELECT count(*) FROM edges JOIN frames USING (frame_id)",
        "SELECT count(*) FROM edges WHERE src IN (SELECT node_id FROM nodes)",
        "SELECT relation, count(*) FILTER (WHERE src_is_ego) FROM edges GROUP BY relation",
        "SELECT relation, count(*) OVER () FROM edges",
        "WITH edges AS (SELECT 1 AS relation) SELECT count(*) FROM edges",
        "SELECT relation AS src, count(*) FROM edges GROUP BY relation",
        "SELECT count(*) FROM edges; SELECT 1",
        "SELECT count( FROM edges",
    ],
)
def test_other_statements_stay_as_they_are(sql: str) -> None:
    assert counted_edges(sql) is None
