"""The matches that a query lists: in its order, within its limit, with nodes and the values of RETURN."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from sgstore.query import Store

NEAR = "MATCH (e:Ego)-[:near]->(v:Vehicle)"
RARE = "MATCH (e:Ego)-[:near_coll]->(v:Truck|Van)"
WAITS = f"{RARE} THEN WITHIN 5s MATCH (e) WHERE e.speed < 3"

CHOSEN = {
    "ORDER BY gap(e, v)": "gap(e, v) AS gap",
    "ORDER BY gap(e, v) DESC LIMIT 3": "gap(e, v), v",
    "ORDER BY v.speed, frame.t DESC SKIP 2 LIMIT 5": "v.speed AS t",
    "LIMIT 4": "e.speed AS v",
    "ORDER BY gap(e, v) LIMIT 1 PER v": "v.name",
    "SAMPLE 2 PER v": "v.kind, trace.name",
}
"""Ends of queries, and values to return with each."""


@pytest.mark.parametrize("end", CHOSEN)
@pytest.mark.parametrize("pattern", [NEAR, RARE])
def test_listed_matches_are_the_rows_in_their_order(
    open_town: Store, pattern: str, end: str
) -> None:
    """The same query without RETURN has the frame and the nodes of each row."""
    asked = open_town.find(f"{pattern} RETURN {CHOSEN[end]} {end}")
    listed = [
        (one.trace, one.start_seq, one.end_seq, one.start, one.values["e"], one.values["v"])
        for one in asked.listed()
    ]
    plain = open_town.find(f"{pattern} {end}")
    rows = [(row.trace, row.seq, row.seq, row.t, row.e, row.v) for row in plain]

    assert asked.lists == plain.lists == "chosen"
    assert listed == rows
    assert listed
    assert {one.frames for one in plain.listed()} == {1}


@pytest.mark.parametrize("end", CHOSEN)
def test_values_of_return_come_with_the_matches(open_town: Store, end: str) -> None:
    asked = open_town.find(f"{RARE} RETURN {CHOSEN[end]} {end}")
    values = [tuple(one.values[name] for name in asked.columns) for one in asked.listed()]
    hidden = {"v"} & {*asked.columns}  # the variable has precedence

    if not hidden:
        assert values == list(map(tuple, asked))


def test_matches_of_a_sequence_are_listed_over_all_their_frames(open_town: Store) -> None:
    whole = {
        (one.trace, one.start_seq, one.end_seq, one.values["v"])
        for one in open_town.find(WAITS).intervals(bound=True)
    }
    for end in ("ORDER BY v.speed DESC", "ORDER BY t", "ORDER BY frame_id DESC", "LIMIT 99"):
        plain = open_town.find(f"{WAITS} {end}")
        listed = list(plain.listed())
        assert [(one.end_seq, one.values["v"]) for one in listed] == [
            (row.seq, row.v) for row in plain
        ]
        assert {(o.trace, o.start_seq, o.end_seq, o.values["v"]) for o in listed} == whole
    least = "RETURN MIN(gap(e, v)) OVER match AS least ORDER BY least SAMPLE 5 PER v.kind"
    asked = open_town.find(f"{WAITS} {least}")
    assert [one.values["least"] for one in asked.listed()] == [row.least for row in asked]


def test_frames_intervals_and_graphs_are_listed(open_town: Store) -> None:
    frames = open_town.find(f"{NEAR} RETURN FRAMES ORDER BY t DESC LIMIT 3")
    assert [(one.start_seq, one.values) for one in frames.listed()] == [
        (row.seq, {}) for row in frames
    ]
    graphs = open_town.find(f"{RARE} RETURN SUBGRAPHS ORDER BY gap(e, v) LIMIT 2")
    assert [(one.start_seq, one.values["v"]) for one in graphs.listed()] == [
        (row.seq, next(node["id"] for node in row.nodes if "v" in node["variables"]))
        for row in graphs
    ]
    runs = open_town.find(f"{NEAR} RETURN INTERVALS, v ORDER BY frames DESC LIMIT 4")
    assert [
        (one.start_seq, one.end_seq, one.values["v"], one.values["v.name"].split()[1])
        for one in runs.listed()
    ] == [(row.start_seq, row.end_seq, row.v, str(row.v)) for row in runs]


def test_values_of_several_matches_are_not_listed(open_town: Store) -> None:
    ends = {
        "": "matches",
        "RETURN e.speed": "matches",
        "RETURN FRAMES": "matches",
        "RETURN CLIPS(-1s, 1s)": "matches",
        "RETURN CLIPS(-1s, 1s) LIMIT 2": "values",
        "RETURN MIN(gap(e, v))": "values",
        "RETURN DISTINCT v.kind": "values",
        "RETURN v.kind, COUNT(*) AS n ORDER BY n LIMIT 1": "values",
    }
    found = {end: open_town.find(f"{NEAR} {end}") for end in ends}
    union = open_town.find(f"{NEAR} UNION {RARE}")

    assert {end: one.lists for end, one in found.items()} == ends
    assert not [
        one for end, kind in ends.items() if kind == "values" for one in found[end].listed()
    ]
    assert union.lists == "matches"
    assert list(union.listed()) == list(union.intervals(bound=True))
    assert open_town.find(f"{NEAR} UNION {RARE} ORDER BY gap(e, v)").lists == "values"
    assert found[""].limit(3).lists == "chosen"
    assert len(list(found[""].limit(3).listed())) == 3
