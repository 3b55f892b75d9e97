"""Lanes of truth: their intersection is the match, and each lane is what its part finds alone."""

from __future__ import annotations

import re
from itertools import islice
from typing import TYPE_CHECKING

import pytest
from thorough import LONG, some

from sgstore.errors import QueryNameError
from sgstore.ingest import ingest
from sgstore.lang.library import NamedPattern, patterns
from sgstore.query import Store

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(13)

LIBRARY = [p for p in patterns().values() if p.kind in {"concept", "scenario"}]
STEP = re.compile(
    r"\b(?:THEN(?:\s+IMMEDIATELY|\s+WITHIN\s+[\w.$]+)?(?:\s+NOT)?|UNTIL)\s+(?=MATCH\b)"
)
HOLD = re.compile(r"\s+FOR\s+>=\s+[\w.]+\s*$")
ONE_STEP = [p for p in LIBRARY if not STEP.search(p.text)]
SEQUENCES = [p for p in LIBRARY if STEP.search(p.text)]


@pytest.fixture(scope="module")
def store(town_store: Path) -> Store:
    return Store(town_store)


def frames_with(store: Store, query: str, trace: str, binding: dict[str, int]) -> set[int]:
    """Frames of a trace that match with a binding: by rows of the query as it is."""
    found = store.find(query)
    # A variable that is called as a column of frames has ".id" behind its name.
    names = [f"{name}.id" if f"{name}.id" in found.columns else name for name in binding]
    places = [found.columns.index(name) for name in names]
    return {
        row[2]
        for row in found
        if row[1] == trace
        and all(row[i] == node for i, node in zip(places, binding.values(), strict=True))
    }


def in_spans(spans: tuple[tuple[int, int], ...]) -> set[int]:
    return {seq for first, last in spans for seq in range(first, last + 1)}


@pytest.mark.parametrize(
    "query",
    [
        "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed > 5",
        "MATCH (e:Ego)-[:isIn]->(:Lane)<-[:isIn]-(v:Vehicle) WHERE dist(e, v) < 40",
        "MATCH (e:Ego)-[:isIn]->(l:Lane), (v:Vehicle)-[r:isIn]->(l) WHERE r.overlap > 0.5",
        "MATCH (e:Ego), (:Person), (:Person) WHERE e.speed > 2",
        "MATCH (e:Ego), (v:Vehicle), (:Vehicle) WHERE v.speed > 1 OR e.speed < 3",
        "MATCH (e:Ego), (v:Vehicle) WHERE NOT EXISTS {(e)-[:near_coll]->(v)} AND frame.t > 3",
        "MATCH (e:Ego) WHERE COUNT {(v:Vehicle) WHERE v.speed > e.speed} >= 2 AND e.speed > 1",
    ],
)
def test_the_intersection_of_the_lanes_is_the_match(store: Store, query: str) -> None:
    spans = list(islice(store.find(query).intervals(bound=True), 3))
    assert spans
    for span in spans:
        binding = {key: v for key, v in span.values.items() if isinstance(v, int)}
        lanes = store.parts(query, f"{span.trace}#{span.start_seq}", binding)

        assert in_spans(lanes.together()) == frames_with(store, query, span.trace, binding)
        assert len(lanes.lanes) > 1 or "COUNT" not in query


def test_without_a_binding_it_is_that_of_the_frame(store: Store) -> None:
    query = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE v.speed > 1"
    row = next(iter(store.find(query)))
    lanes = store.parts(query, row.frame_id)

    assert lanes.binding == {"e": row.e, "v": row.v}
    assert row.seq in in_spans(lanes.together())
    assert [lane.part.text for lane in lanes.lanes] == ["(e)-[:near_coll]->(v)", "v.speed > 1"]


def test_words_of_the_library_are_shown_as_written(store: Store) -> None:
    """The parts of a call are lanes of their own; each has the call, and its condition in full."""
    define = "DEFINE passes(a, c) AS a.speed > 3 AND c.speed < 2 AND dist(a, c) < 40;"
    query = (
        f"{define} MATCH (e:Ego), (v:Vehicle) WHERE passes(e, v) AND NOT stopped(e) AND lead(e, v)"
    )
    parts = [one.part for one in store.parts(query, "town#50").lanes]

    assert [(one.call, one.text) for one in parts] == [
        *(("passes(e, v)", text) for text in ("e.speed > 3", "v.speed < 2", "dist(e, v) < 40")),
        *(("", text) for text in ("NOT stopped(e)", "lead(e, v)")),
    ]
    assert [one.conditions for one in parts] == [(one.text,) for one in parts]
    assert [one.meanings == one.conditions for one in parts] == [True, True, True, False, False]
    assert "leads" in parts[-1].meanings[0]
    sequence = f"{define} MATCH (e:Ego), (v:Vehicle) WHERE EVENTUALLY WITHIN 3s lead(e, v)"
    (over_time,) = (one.part for one in store.parts(sequence, "town#50").lanes)
    assert over_time.text == "EVENTUALLY[0s, 3s] lead(e, v)"
    # Conditions that share a variable without a node are one part, with the call as a whole.
    (whole,) = (one.part for one in store.parts(query, "town#50", {}).lanes)
    assert whole.call == ""
    assert whole.conditions[0] == "passes(e, v)"
    assert whole.meanings[0].count("AND") == 2


def test_where_nothing_matches_it_is_what_comes_nearest(store: Store) -> None:
    query = "MATCH (e:Ego), (v:Vehicle) WHERE e.speed > 500 AND v.speed > 0"
    lanes = store.parts(query, "town#3")

    assert lanes.binding.keys() == {"e", "v"}
    assert not lanes.together()
    assert [bool(lane.spans) for lane in lanes.lanes] == [False, True]


def test_what_must_differ_and_is_not_given_stays_together(store: Store) -> None:
    query = "MATCH (e:Ego), (v:Vehicle) WHERE e.speed > 2 AND v.speed > 2"

    assert len(store.parts(query, "town#3", {}).lanes) == 1
    assert len(store.parts(query, "town#3", {"e": 0}).lanes) == 2


def test_a_sequence_has_lanes_for_each_step(store: Store) -> None:
    query = "MATCH (e:Ego) WHERE e.speed > 3 THEN WITHIN 20s MATCH (e) WHERE e.speed < 1"
    (row, *_) = store.find(query)
    lanes = store.parts(query, row.frame_id, {"e": row.e})

    assert lanes.steps == (1, 2)
    for step, test in ((1, "e.speed > 3"), (2, "e.speed < 1")):
        alone = frames_with(store, f"MATCH (e:Ego) WHERE {test}", row.trace, {"e": row.e})
        assert in_spans(lanes.together(step)) == alone


def test_a_condition_over_time_has_a_lane(store: Store) -> None:
    query = "MATCH (e:Ego) WHERE e.speed < 3 AND PREVIOUS e.speed >= 3"
    rows = store.find(query).rows()
    lanes = store.parts(query, rows[0].frame_id)
    found = {row.seq for row in rows if row.trace == rows[0].trace}

    assert in_spans(lanes.together(1)) == found
    assert len(lanes.lanes) == 2


@pytest.mark.parametrize("pattern", some(ONE_STEP, 3), ids=lambda one: one.name)
def test_patterns_of_the_library(store: Store, pattern: NamedPattern) -> None:
    compare_lanes(store, pattern, None if LONG else 1)


@pytest.mark.data
@pytest.mark.skipif(not LONG, reason="make oracle: a minute")
@pytest.mark.parametrize("trace", ["sumo/Town10HD_sumo_osi", "carla/Town01.carla"])
def test_patterns_of_the_library_in_other_towns(data: Path, tmp_path: Path, trace: str) -> None:
    (outcome,) = ingest(tmp_path / "other.sgstore", [data / "traces" / f"{trace}.mcap"])
    assert outcome.error is None
    store = Store(tmp_path / "other.sgstore", memory=4 << 30)  # a step alone may hold of most pairs
    with store.file.snapshot():
        for pattern in ONE_STEP:
            compare_lanes(store, pattern, None)
        for pattern in SEQUENCES:
            compare_steps(store, pattern, 5)


def compare_lanes(store: Store, pattern: NamedPattern, most: int | None) -> None:
    """Compare the lanes of matches with the frames in which the query has the same nodes."""
    found: dict[tuple[str, tuple[tuple[str, int], ...]], set[int]] = {}
    for span in store.find(pattern.text).intervals(bound=True):
        nodes = tuple((k, v) for k, v in span.values.items() if isinstance(v, int))
        seqs = range(span.start_seq, span.end_seq + 1)
        found.setdefault((span.trace, nodes), set()).update(seqs)
    for (trace, nodes), seqs in islice(found.items(), most):
        lanes = store.parts(pattern.text, f"{trace}#{min(seqs)}", dict(nodes))
        (step,) = lanes.steps
        together = in_spans(lanes.together(step))
        # A hold asks how long all of it is true, which no part says.
        assert seqs <= together if HOLD.search(pattern.text) else seqs == together, pattern.name


@pytest.mark.parametrize("pattern", some(SEQUENCES, 2), ids=lambda one: one.name)
def test_sequences_of_the_library(store: Store, pattern: NamedPattern) -> None:
    compare_steps(store, pattern, None if LONG else 1)


def compare_steps(store: Store, pattern: NamedPattern, most: int | None) -> None:
    """Compare the lanes of each step with frames in which it has the same nodes as a query of its own."""
    steps = [HOLD.sub("", one) for one in STEP.split(pattern.text)]
    bindings: dict[tuple[str, tuple[tuple[str, int], ...]], int] = {}
    for span in store.find(pattern.text).intervals(bound=True):
        nodes = tuple((k, v) for k, v in span.values.items() if isinstance(v, int))
        bindings.setdefault((span.trace, nodes), span.start_seq)
    for (trace, nodes), seq in islice(bindings.items(), most):
        lanes = store.parts(pattern.text, f"{trace}#{seq}", dict(nodes))
        assert lanes.steps == tuple(range(1, len(steps) + 1)), pattern.name
        for number, step in enumerate(steps, start=1):
            here = {name: node for name, node in nodes if re.search(rf"\b{name}\b", step)}
            assert in_spans(lanes.together(number)) == frames_with(store, step, trace, here), (
                pattern.name,
                number,
                nodes,
            )


def test_a_union_has_the_lanes_of_the_part_that_matches(store: Store) -> None:
    near, slow = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)", "MATCH (e:Ego) WHERE e.speed < 1"
    both = f"{near} RETURN FRAMES UNION {slow} RETURN FRAMES"
    spans = list(store.find(both).intervals(bound=True))

    for query in (near, slow):
        span = next(store.find(query).intervals(bound=True))
        assert span in spans
        binding = {key: v for key, v in span.values.items() if isinstance(v, int)}
        frame = f"{span.trace}#{span.start_seq}"
        lanes = store.parts(both, frame, binding)
        assert [(one.part.text, one.spans) for one in lanes.lanes] == [
            (one.part.text, one.spans) for one in store.parts(query, frame, binding).lanes
        ]


def test_an_unknown_variable_is_refused(store: Store) -> None:
    with pytest.raises(QueryNameError, match="no node 'w'"):
        store.parts("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)", "town#3", {"w": 1})
