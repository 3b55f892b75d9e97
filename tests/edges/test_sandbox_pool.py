"""A pool of sandboxes: a runaway keeps nobody waiting, and is stopped at once."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from sgstore.apps import sandbox
from sgstore.apps.sandbox import Sandbox, SandboxPool
from sgstore.errors import QueryError, SqlError
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.seconds(9)

RUNAWAY = "SELECT max((a.range * b.range) % 7) FROM range(1000000) a, range(1000000) b"
"""Takes much time and little memory."""
NEAR = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"


@pytest.fixture(scope="module")
def pool(town_store: Path) -> Iterator[SandboxPool]:
    with SandboxPool(town_store, timeout_s=60, worker="sgstore.apps.explorer._worker") as pool:
        yield pool


def asked(pool: SandboxPool, ask: str, text: str, key: str = "k", **more: Any) -> list[Any]:
    return list(pool.ask({"ask": ask, "text": text, "parameters": {}, **more}, key))


def test_matches_come_as_intervals_with_bindings(pool: SandboxPool, town_store: Path) -> None:
    head, names, *batches, last = asked(pool, "matches", NEAR)
    rows = [row for batch in batches for row in batch["matches"]]
    spans = list(Store(town_store).find(NEAR).intervals())

    assert head["reasons"] == {}
    assert names["names"] == list(spans[0].values)
    assert [row[:3] for row in rows] == [[s.trace, s.start_seq, s.end_seq] for s in spans]
    assert [row[5:] for row in rows] == [list(s.values.values()) for s in spans]
    assert last == {"count": len(spans), "truncated": False, "notes": []}


def test_parts_and_why_not_are_those_of_the_store(pool: SandboxPool, town_store: Path) -> None:
    query, store = f"{NEAR} WHERE e.speed > 500", Store(town_store)
    frame = store.file.frame("town#100").frame_id
    (parts,) = asked(pool, "parts", query, frame=frame, binding=None)
    (why,) = asked(pool, "why", query, frame=frame)
    lanes = store.parts(query, frame)

    assert [lane["text"] for lane in parts["lanes"]] == [one.part.text for one in lanes.lanes]
    assert [lane["spans"] for lane in parts["lanes"]] == [
        [list(span) for span in one.spans] for one in lanes.lanes
    ]
    told = store.why_not(frame, query).as_dict()
    assert {key: why[key] for key in told} == told


def test_a_number_that_keeps_a_frame_from_matching_is_told(
    pool: SandboxPool, town_store: Path
) -> None:
    query, store = "MATCH (e:Ego) WHERE e.speed > 500 AND frame.seq < 500", Store(town_store)
    frame = store.file.frame("town#100").frame_id
    (why,) = asked(pool, "why", query, frame=frame)
    (change,) = why["relax"]
    relaxed = query[: change["start"]] + change["text"] + query[change["end"] :]

    assert query[change["start"] : change["end"]] == "500"
    assert change["end"] < query.index("AND")
    assert not store.why_not(frame, relaxed).failed  # type: ignore[union-attr]


def test_an_error_of_a_query_is_that_of_the_query(pool: SandboxPool) -> None:
    with pytest.raises(QueryError, match="near_coll") as found:
        asked(pool, "matches", "MATCH (e:Ego)-[:near_kol]->(v)")

    assert found.value.span is not None


def test_a_question_behind_a_runaway_is_answered_at_once(pool: SandboxPool) -> None:
    def run_away() -> None:
        with pytest.raises(SqlError, match="stopped"):
            asked(pool, "sql", RUNAWAY, "r")

    thread = threading.Thread(target=run_away)
    thread.start()
    time.sleep(1.0)
    (answer,) = asked(pool, "sql", "SELECT 41 + 1 AS x")
    assert answer["rows"] == [[42]]

    assert pool.cancel("r")  # it runs on
    thread.join(300)
    assert not thread.is_alive()
    assert not pool.cancel("r")
    assert asked(pool, "sql", "SELECT 1 AS x")[0]["rows"] == [[1]]


def test_a_small_question_waits_for_none_of_the_others(town_store: Path) -> None:
    worker = "sgstore.apps.explorer._worker"
    with SandboxPool(town_store, size=1, small=("why",), timeout_s=60, worker=worker) as pool:
        away = pool.ask({"ask": "matches", "text": NEAR, "parameters": {}}, "away")
        next(away)  # it holds the only turn
        frame = Store(town_store).file.frame("town#100").frame_id
        assert asked(pool, "why", NEAR, frame=frame)[0]["relax"] == []
        away.close()  # type: ignore[attr-defined]


def test_who_stops_reading_stops_the_question(pool: SandboxPool) -> None:
    found = pool.ask({"ask": "matches", "text": NEAR, "parameters": {}}, "half")
    next(found)
    found.close()  # type: ignore[attr-defined]

    assert not pool.cancel("half")
    assert asked(pool, "sql", "SELECT 1 AS x", "half")[0]["rows"] == [[1]]


def test_two_questions_of_one_key_are_told_apart(pool: SandboxPool) -> None:
    found = pool.ask({"ask": "matches", "text": NEAR, "parameters": {}}, "same")
    next(found)
    with pytest.raises(QueryError, match="under way"):
        asked(pool, "sql", "SELECT 1", "same")
    found.close()  # type: ignore[attr-defined]


def test_a_closed_pool_starts_no_more_processes(
    town_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closing, made, asked = threading.Event(), list[Sandbox](), list[object]()

    class Watched(Sandbox):
        def __init__(self, *args: Any, **how: Any) -> None:
            made.append(self)
            if len(made) > 1:  # the first one is there before the others start
                closing.wait(60)
            super().__init__(*args, **how)

        def ask(self, question: Any, *how: Any) -> dict[str, Any]:
            asked.append(question)
            return super().ask(question, *how)

        def stop(self) -> None:
            closing.set()  # the pool stops its processes after it counts as closed
            super().stop()

    monkeypatch.setattr(sandbox, "Sandbox", Watched)
    pool = SandboxPool(
        town_store, small=("parts", "values", "why"), first={"find": "MATCH (e:Ego)"}
    )
    pool.close()

    assert len(made) <= 3  # the first, and one of each of the two threads
    assert asked == []
    assert not any(one.is_ready for one in made)
