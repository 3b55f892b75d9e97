"""``UNION``: the answers of several queries as one, by the definition, from the answers of each."""

from __future__ import annotations

import json
from itertools import product
from typing import TYPE_CHECKING, Any

import pytest
from oracle_answers import run
from oracle_over_time import worlds
from thorough import LONG

from sgstore.apps.cli import run as run_verb
from sgstore.errors import QueryError
from sgstore.graphs.online import Frame
from sgstore.model.vocabulary import natural
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(6)

NEAR = "MATCH (e:Ego)-[:near|visible]-(v:Entity)"
FAST = "MATCH (v:Entity) WHERE v.speed > $least"
LATER = "MATCH (e:Ego)-[:near|visible]-(v:Entity) AS a THEN MATCH (v) WHERE v.speed > 0.5"
RETURNS = {
    "frames": "FRAMES",
    "values of frames": "v.name AS n, FRAMES",
    "intervals": "v.kind AS k, INTERVALS",
    "clips": "CLIPS(-0.1s, +0.1s)",
    "groups": "trace.name AS run, v.kind AS k, COUNT(*) AS n",
    "values": "v.kind AS k, v.x AS x",
}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    _, store = worlds(7, tmp_path_factory.mktemp("worlds"))
    with store.file.snapshot():
        yield store


def asked(store: Store, *queries: str, word: str = "UNION") -> Any:
    text = f" {word} ".join(queries)
    return store.find(text, **({"least": 1} if "$least" in text else {}))


def key(row: tuple[Any, ...]) -> tuple[Any, ...]:
    """NULL last, names of traces as people count, everything else as it is."""
    return tuple((v is None, natural(v) if str(v).startswith("trace") else v) for v in row)


def test_random_answers_are_what_their_definition_says(tmp_path: Path) -> None:
    found = run(range(4) if LONG else range(1), 50 if LONG else 2, tmp_path)

    assert {"union", "sql", "second", "scenario", "tables", "intervals"} <= found.keys()


@pytest.mark.parametrize("form", RETURNS)
@pytest.mark.parametrize(("one", "other"), [(NEAR, FAST), (FAST, LATER)])
def test_rows_are_those_of_both_parts(one: str, other: str, form: str, store: Store) -> None:
    queries = [f"{part} RETURN {RETURNS[form]}" for part in (one, other)]
    parts = [[tuple(row) for row in asked(store, query)] for query in queries]
    skip = 1 if form in {"frames", "values of frames"} else 0  # trace and time, before the id

    either = asked(store, *queries)
    every = asked(store, *queries, word="UNION ALL")

    wanted = sorted({*parts[0], *parts[1]}, key=lambda row: key(row[skip:]))
    assert [tuple(row) for row in either] == wanted
    if form in {"groups", "values"}:
        assert [tuple(row) for row in every] == parts[0] + parts[1]
    else:
        assert [tuple(row) for row in every] == sorted(
            parts[0] + parts[1], key=lambda row: key(row[skip:])
        )
    assert either.columns == asked(store, queries[0]).columns
    assert [tuple(row) for row in either.limit(3)] == wanted[:3]
    assert len(either.numpy()[either.columns[0]]) == len(wanted)
    assert either.arrow().num_rows == len(wanted)
    assert wanted


def test_frames_clips_and_intervals_are_those_of_both_parts(store: Store) -> None:
    queries = [f"{part} RETURN v.name AS n, FRAMES" for part in (NEAR, FAST)]
    one, other = (asked(store, query) for query in queries)
    either = asked(store, *queries)

    frames = {frame.frame_id: frame for frame in (*one.frames(), *other.frames())}
    ordered = sorted(frames.values(), key=lambda frame: (natural(frame.trace), frame.seq))
    assert list(either.frames()) == ordered
    assert either.count() == len(ordered)
    intervals = {repr(i): i for part in (one, other) for i in part.intervals()}
    assert {repr(i) for i in either.intervals()} == set(intervals)
    for clip, part in product(list(either.clips(0.1)), (one, other)):
        inside = [
            c for c in part.clips(0.1) if c.trace == clip.trace and c.start_ns >= clip.start_ns
        ]
        assert all(c.end_ns <= clip.end_ns or c.start_ns > clip.end_ns for c in inside)
    first = ordered[0]
    assert either.bindings(first) == one.bindings(first) + other.bindings(first)
    graphs = f"{NEAR} RETURN SUBGRAPHS UNION {NEAR} RETURN SUBGRAPHS"
    assert len(store.find(graphs).rows()) == len(store.find(f"{NEAR} RETURN SUBGRAPHS").rows())


def test_parts_have_settings_orders_and_limits_of_their_own(store: Store) -> None:
    text = (
        "DEFINE PREDICATE quick(x) AS x.speed > $least;"
        " MATCH (v:Car) WHERE quick(v) RETURN v.x AS x ORDER BY x LIMIT 2"
        " UNION ALL USING NODES any MATCH (v:Entity) RETURN v.x AS x ORDER BY x DESC LIMIT 3"
    )
    first = store.find("MATCH (v:Car) WHERE v.speed > 1 RETURN v.x AS x ORDER BY x LIMIT 2").rows()
    other = store.find("MATCH (v:Entity) RETURN v.x AS x ORDER BY x DESC LIMIT 3").rows()

    assert store.find(text, least=1).rows() == first + other
    assert store.sql(f"SELECT count(*) FROM sgql($${text}$$, least := 1)").values == [(5,)]


def test_nodes_of_several_traces_are_not_mixed_up(store: Store) -> None:
    text = "MATCH (v:Car) RETURN v"

    assert (
        store.find(f"{text} UNION {text}").rows()
        == store.find("MATCH (v:Car) RETURN DISTINCT v").rows()
    )


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("MATCH (v:Car) RETURN v UNION MATCH (v:Car)", "the parts of a UNION return the same"),
        (
            "MATCH (v:Car) RETURN v.x AS x UNION MATCH (v:Car) RETURN v.name AS x",
            "'x' is a number in the first part of the UNION, and a text here",
        ),
        ("MATCH (v:Car) UNION MATCH (v:Car) WHERE v.sped > 3", "unknown attribute 'sped'"),
        (
            "MATCH (v:Car) UNION MATCH (v:Car) UNION ALL MATCH (v:Car)",
            "a query cannot contain both UNION and UNION ALL",
        ),
        (
            "MATCH (v:Car) UNION MATCH (v:Car); MATCH (v)",
            "expected only the UNION",
        ),
        ("MATCH (v:Car) UNION", "expected MATCH or USING, but the text ends"),
    ],
)
def test_parts_that_do_not_fit_are_refused(text: str, reason: str, store: Store) -> None:
    with pytest.raises(QueryError, match=reason) as caught:
        store.find(text)

    assert caught.value.text == text


def test_a_parameter_that_no_part_has_is_refused(store: Store) -> None:
    with pytest.raises(QueryError, match="the query has no parameter 'most'"):
        store.find(f"{FAST} UNION {NEAR}", least=1, most=2)


def test_what_takes_one_pattern_says_so(store: Store) -> None:
    with pytest.raises(QueryError, match="a UNION combines several queries"):
        store.why_not(next(store.find("MATCH (e:Ego)").frames()), f"{NEAR} UNION {NEAR}")


def test_a_shell_shows_a_union(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    text = f"{NEAR} RETURN v.kind AS k UNION MATCH (v:Lane) RETURN v.kind AS k"

    assert run_verb(["find", str(store.file.path), text, "--json"]) == 0

    kinds = {row["k"] for row in json.loads(capsys.readouterr().out)}
    assert kinds == {row.k for row in store.find(text)}


def test_a_monitor_watches_each_part() -> None:
    watch = Monitor("MATCH (e:Ego) WHERE e.speed > 3 UNION MATCH (e:Ego) WHERE e.speed > 5")
    events = [
        (event.name, event.kind)
        for number, speed in enumerate((2.0, 4.0, 6.0))
        for event in watch.step(frame(number, speed))
    ]

    assert {name for name, _ in events} == {"pattern 1", "pattern 2"}


def frame(number: int, speed: float) -> Frame:
    made = Frame(time_ns=number * 100_000_000, ego="ego")
    made.add("ego", "car", 0.0, 0.0, 0.0, heading=0.0, length=4.0, width=2.0, vx=speed, vy=0.0)
    return made
