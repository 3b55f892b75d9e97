"""Values in the conditions of a pattern, true or false, for given and for other nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from sgstore.errors import QueryNameError
from sgstore.query import Store

if TYPE_CHECKING:
    from pathlib import Path

PATTERN = "MATCH (e:Ego)-[:near]->(v:Vehicle)"
CONDITIONS = "WHERE e.speed < 9 AND dist(e, v) < 30 AND slow(v) AND v.kind = 'car' AND NOT v.parked"
LIBRARY = "DEFINE slow(x) AS x.speed < 7 AND x.speed > -1;"


@pytest.fixture(scope="module")
def store(town_store: Path) -> Store:
    return Store(town_store)


def test_values_equal_those_of_return(store: Store) -> None:
    columns = "e.speed AS a, dist(e, v) AS b, v.speed AS c, v.kind AS d"
    rows = store.find(f"{PATTERN} RETURN frame.seq AS s, e, v, {columns}").rows()
    text, seen = f"{LIBRARY} {PATTERN} {CONDITIONS}", set[bool]()
    for seq, e, v, *told in list(rows)[::97]:
        lanes = store.condition_values(text, f"town#{seq}", {"e": e, "v": v})
        parts = store.parts(text, f"town#{seq}", {"e": e, "v": v}).lanes
        assert [len(one) for one in lanes] == [len(lane.part.conditions) for lane in parts]
        found = {one.name: one.value for lane in lanes for of in lane for one in of}
        assert found == pytest.approx(
            dict(zip(("e.speed", "dist(e, v)", "v.speed", "v.kind"), told, strict=True))
        )
        seen.add(all(any(a <= seq <= z for a, z in lane.spans) for lane in parts))
    assert seen == {True, False}


def test_values_of_a_node_that_is_not_given_are_the_nearest(store: Store) -> None:
    text = f"{PATTERN} WHERE v.speed > 60"
    rows = store.find(f"{PATTERN} RETURN frame.seq AS s, v.speed AS x").rows()
    fastest = dict[int, float]()
    for seq, speed in rows:
        fastest[seq] = max(speed, fastest.get(seq, 0.0))
    for seq in list(fastest)[::60]:
        (lane,) = store.condition_values(text, f"town#{seq}", {"e": 0})
        assert lane[0][0].value == pytest.approx(fastest[seq])
        assert lane[0][0].unit == "m/s"


def test_values_of_steps_and_of_absent_nodes(store: Store) -> None:
    text = f"{PATTERN} WHERE e.speed > 1 THEN MATCH (e)-[:very_near]->(v) WHERE dist(e, v) < 4"
    lanes = store.condition_values(text, "town#204", {"e": 0, "v": 3})
    named = [[(one.name, one.unit) for of in lane for one in of] for lane in lanes]
    assert named == [[], [("e.speed", "m/s")], [], [("dist(e, v)", "m")]]
    gone = store.condition_values(text, "town#204", {"e": 0, "v": 2**30})
    assert [[len(of) for of in lane] for lane in gone] == [[], [1], [], [0]]
    with pytest.raises(QueryNameError):
        store.condition_values(text, "town#204", {"x": 0})
