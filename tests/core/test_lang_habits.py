"""Notes on silent habits, suggestions by meaning, and texts in the words of the query."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

import sgstore
from sgstore.errors import QueryError
from sgstore.temporal import verdict_rows

if TYPE_CHECKING:
    from sgstore.query import Store

HABITS = {
    "MATCH (e:Ego) RETURN percentile(e.speed, 0.95)": "write 95",
    "MATCH (e:Ego) RETURN AVG(e.heading)": "angles",
    "MATCH (e:Ego) RETURN SUM(e.heading) AS s": "angles",
    "MATCH (e:Ego)-[:near]->(v) RETURN stddev(bearing(e, v))": "angles",
    "MATCH (e:Ego) RETURN CLIPS(3s, 5s)": "CLIPS(-3s, …)",
    "MATCH (v:Vehicle) WHERE v.brake > 0.5 OR v.speed > 1": "brake is unknown",
}
USUAL = (
    "MATCH (e:Ego) RETURN percentile(e.speed, 95), percentile(e.speed, 5)",
    "MATCH (e:Ego) RETURN AVG(e.speed), MIN(e.heading)",
    "MATCH (e:Ego) RETURN CLIPS(-3s, 5s)",
    "MATCH (v:Vehicle) WHERE v.length > 50 OR v.speed > 1",
)
MEANINGS = {
    "MATCH (v:Vehicle) WHERE v.braking": "hard_brake(v)",
    "MATCH (v:Vehicle) WHERE braking(v)": "hard_brake(v)",
    "MATCH (v:Ambulance)": "special: 'emergency'",
    "MATCH (v:Vehicle) WHERE v.kind = 'ambulance'": "special: 'emergency'",
    "MATCH (v:Taxi)": "special: 'taxi'",
    "MATCH (v:Vehicle) WHERE speeding(v)": "speed_limit",
    "MATCH (v:Vehicle) WHERE v.speeding": "speed_limit",
    "MATCH (p:Person) WHERE crossing(p)": "on_crosswalk(p)",
    "MATCH (p:Person)-[:crossing]->(l:Lane)": "on_crosswalk(p)",
    "MATCH (p:Crossing)": "Crosswalk",
    "MATCH (v:Vehicle) WHERE v.speed > 50km/h": "write 50 / 3.6",
    "MATCH cut_inn()": "'cut_in'",
    "MATCH (v:Vehicle) WHERE cut_inn(v)": "MATCH cut_in()",
    "MATCH (v:Car) THEN WITHIN -2s MATCH (v)": "ONCE[0s, 2s]",
}


@pytest.mark.parametrize("text", HABITS)
def test_a_silent_habit_gets_a_note(text: str, open_town: Store) -> None:
    (note,) = open_town.find(text).notes
    assert HABITS[text] in note


@pytest.mark.parametrize("text", USUAL)
def test_a_usual_query_gets_no_note(text: str, open_town: Store) -> None:
    assert open_town.find(text).notes == ()


@pytest.mark.parametrize("text", MEANINGS)
def test_suggestions_are_by_meaning(text: str, open_town: Store) -> None:
    with pytest.raises(QueryError) as raised:
        open_town.find(text)
    assert MEANINGS[text] in (raised.value.hint or "")


def test_letters_of_logics_are_known(open_town: Store) -> None:
    for letter, word in {
        "G": "ALWAYS",
        "F": "EVENTUALLY",
        "O": "ONCE",
        "H": "HISTORICALLY",
    }.items():
        with pytest.raises(QueryError) as raised:
            open_town.check(f"CHECK a: {letter}[0s,2s] ego.speed > 3")
        assert f"{word}[0s, 2s]" in (raised.value.hint or "")


def test_an_ego_of_another_kind_is_not_a_missing_ego(open_town: Store) -> None:
    (reason,) = open_town.find("MATCH (q:Ego&!Vehicle)").reasons.values()
    assert reason == "its ego is of another kind, or it has none"


def test_the_deciding_condition_is_in_the_words_of_the_query(open_town: Store) -> None:
    block = "COUNT {(v)-[:near]->(w:Person) WHERE w.speed > 1}"
    text = f"CHECK a: FORALL (v:Vehicle) ALWAYS {block} < 1 ROBUSTNESS"
    monitor = sgstore.Monitor(text)
    assert monitor.names == ("a",)
    (verdict,) = open_town.check(text)
    (row, *_) = verdict_rows(verdict, margin=True)
    told = " ".join(map(str, row))
    assert f"{block} < 1" in told


NEAR = "MATCH (e:Ego)-[:near]->(v:Vehicle)"
LISTS = f"{NEAR} WITH e, collect(v.name) AS names"


def test_a_collected_list_has_a_length_and_members(open_town: Store) -> None:
    every = open_town.find(f"{LISTS} RETURN frame.seq, names").rows()
    for condition, test in {
        "length(names) > 1": lambda names: len(names) > 1,
        "'car 2' IN names": lambda names: "car 2" in names,
        "NOT 'car 2' IN names AND length(names) = 1": lambda names: (
            names != ["car 2"] and len(names) == 1
        ),
    }.items():
        found = open_town.find(f"{LISTS} WHERE {condition} RETURN frame.seq, names").rows()
        assert found == [row for row in every if test(row[1])]
        assert found


def test_a_list_of_a_group_can_be_tested(open_town: Store) -> None:
    text = f"{NEAR} RETURN v.name AS name, collect(frame.seq) AS seqs, length(collect(v.x)) AS many"
    every = open_town.find(text).rows()

    assert all(len(row.seqs) == row.many for row in every)
    found = open_town.find(f"{text} HAVING 57 IN seqs AND length(seqs) > 5").rows()
    assert found
    assert found == [row for row in every if 57 in row.seqs and row.many > 5]
    for wrong in ("'a' IN seqs", "length(name) > 2"):
        with pytest.raises(QueryError):
            open_town.find(f"{text} HAVING {wrong}")


def test_a_sum_of_no_values_is_the_same_everywhere(open_town: Store) -> None:
    for text in (
        "MATCH (v:Train) RETURN SUM(v.speed) AS s",
        "MATCH (v:Ego) RETURN SUM(v.brake) AS s",
        "MATCH (e:Ego) WITH e, SUM(e.brake) AS s RETURN DISTINCT s",
        "MATCH (e:Ego) RETURN DISTINCT SUM {(v:Train) | v.speed} AS s",
        "MATCH (e:Ego) RETURN DISTINCT SUM {(v:Vehicle) | v.brake} AS s",
    ):
        assert [tuple(row) for row in open_town.find(text).rows()] == [(0,)]
