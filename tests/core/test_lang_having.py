"""``HAVING`` with values over a match, and their names."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from sgstore.errors import QueryError
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from sgstore.query import Store

NEAR = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"
LEAST = "MIN(gap(e, v)) OVER match"
FORMS = {
    "rows": f"{NEAR} RETURN frame.seq, v.name, {LEAST} AS least",
    "distinct rows": f"{NEAR} RETURN DISTINCT v.name, {LEAST} AS least",
    "whole matches": f"{NEAR} RETURN *, {LEAST} AS least",
    "intervals": f"{NEAR} RETURN v.name, INTERVALS, {LEAST} AS least",
    "clips": f"{NEAR} RETURN v.name, CLIPS(-1s, 1s), {LEAST} AS least",
    "a sequence": f"{NEAR} AS a THEN WITHIN 3s MATCH (e)-[:near]->(v) RETURN v.name, {LEAST} AS least",
    "intervals of a sequence": f"{NEAR} AS a THEN WITHIN 3s MATCH (e)-[:near]->(v)"
    f" RETURN v.name, INTERVALS, {LEAST} AS least",
}


def rows(text: str, store: Store) -> list[tuple[Any, ...]]:
    return [tuple(row) for row in store.find(text).rows()]


@pytest.mark.parametrize("form", FORMS)
def test_having_chooses_by_a_value_over_the_match(form: str, open_town: Store) -> None:
    text = FORMS[form]
    wanted = [row for row in rows(text, open_town) if row[-1] < 1]

    assert wanted
    assert rows(f"{text} HAVING least < 1", open_town) == wanted
    assert rows(f"{text} HAVING {LEAST} < 1", open_town) == wanted
    if form != "whole matches":
        others = [row for row in wanted if "car 2" not in row]
        assert rows(f"{text} HAVING 1 - least > 0 AND v.name <> 'car 2'", open_town) == others
    unnamed = text.replace(f", {LEAST} AS least", "")
    assert rows(f"{unnamed} HAVING {LEAST} < 1", open_town) == [row[:-1] for row in wanted]


def test_frames_and_counts_are_those_of_the_chosen_rows(open_town: Store) -> None:
    matches = open_town.find(f"{FORMS['rows']} HAVING least < 1")
    seqs = [row[0] for row in rows(f"{FORMS['rows']} HAVING least < 1", open_town)]

    assert [frame.seq for frame in matches.frames()] == list(dict.fromkeys(seqs))
    assert matches.count() == len(set(seqs))


def test_steps_have_times_after_having(open_town: Store) -> None:
    text = (
        f"{NEAR} AS a THEN WITHIN 3s MATCH (e)-[:near]->(v) AS c RETURN v.name, t(c) - t(a) AS took"
    )
    wanted = [row for row in rows(text, open_town) if row[1] < 0.5]

    assert rows(f"{text} HAVING took < 0.5", open_town) == wanted
    assert rows(f"{text} HAVING t(c) - t(a) < 0.5", open_town) == wanted


@pytest.mark.parametrize("form", ["", ", INTERVALS", ", COUNT(*) AS n"])
def test_a_value_of_one_frame_is_still_refused(form: str, open_town: Store) -> None:
    with pytest.raises(QueryError):
        open_town.find(f"{NEAR} RETURN v.name{form} HAVING v.speed > 2")


APART = (
    "CHECK apart: FORALL (v:Vehicle) ALWAYS NOT dist(ego, v) < 8 RESET WHEN dist(ego, v) > 9"
    " RETURN MIN(dist(ego, v)) OVER match AS least, v.speed AS speed"
)


@pytest.mark.parametrize(
    "condition",
    [
        "least < 5",
        "MIN(dist(ego, v)) OVER match < 5",
        "least < 5 AND speed > -1",
        "5 > least AND v.speed >= 0",
    ],
)
def test_having_chooses_the_listed_violations_of_a_check(condition: str, open_town: Store) -> None:
    (every,) = open_town.check(APART)
    (chosen,) = open_town.check(f"{APART} HAVING {condition}")
    wanted = [
        (witness.names, [one for one in witness.violations if one.values["least"] < 5])
        for witness in every.witnesses
    ]

    assert [(witness.names, [*witness.violations]) for witness in chosen.witnesses] == wanted
    assert 0 < len(chosen.violations) < len(every.violations)
    assert chosen.verdict == every.verdict == "false"


def test_a_check_stays_violated_if_having_keeps_no_violation(open_town: Store) -> None:
    (found,) = open_town.check(f"{APART} HAVING least < 0")

    assert found.violated
    assert found.violations == ()
    assert found.first_violation is None


@pytest.mark.parametrize(
    ("returned", "wrong"),
    [
        ("v.name, COUNT(*) AS n HAVING n > 1", "HAVING has no groups"),
        ("v.name, INTERVALS HAVING frames > 3", "'frames' of intervals"),
    ],
)
def test_a_monitor_rejects_having_of_groups_and_of_intervals(returned: str, wrong: str) -> None:
    with pytest.raises(QueryError, match=wrong) as error:
        Monitor(f"MATCH (v:Vehicle) RETURN {returned}")

    assert "HAVING MIN(x) OVER match" in str(error.value)


@pytest.mark.parametrize("form", ["v.name, ", "*, "])
def test_intervals_are_those_that_having_chooses(form: str, open_town: Store) -> None:
    text = f"{NEAR} RETURN {form}{LEAST} AS least"
    named = f"{NEAR} RETURN v.name, INTERVALS, {LEAST} AS least"
    chosen = [row for row in rows(named, open_town) if row[-1] < 1]
    matches = open_town.find(f"{text} HAVING least < 1")

    assert 0 < len(chosen) < len(rows(named, open_town))
    for bound in (False, True):
        found = [*matches.intervals(bound=bound)]
        assert [(i.trace, i.start_seq, i.values["v.name"]) for i in found] == [
            (row[0], row[1], row[8]) for row in chosen
        ]


@pytest.mark.parametrize(
    ("returned", "bound", "wrong"),
    [
        ("v.name, COUNT(*) AS n HAVING n > 20", False, "HAVING has no groups"),
        ("v.name, COUNT(*) AS n HAVING n > 20", True, "HAVING has no groups"),
        ("v.name, CLIPS(-1s, 1s) HAVING start_ns > 3", False, "'start_ns' of clips"),
        ("v.name, INTERVALS HAVING frames > 3", True, "'frames' of intervals"),
    ],
)
def test_intervals_do_not_ignore_having(
    returned: str, bound: bool, wrong: str, open_town: Store
) -> None:
    with pytest.raises(QueryError, match=wrong):
        next(open_town.find(f"{NEAR} RETURN {returned}").intervals(bound=bound))


SEQUENCE = "MATCH (e:Ego)-[:near]->(v:Vehicle) THEN WITHIN 2s MATCH (e)-[:near_coll]->(v)"


@pytest.mark.parametrize(
    "query",
    [
        f"{NEAR} RETURN v.name, INTERVALS LIMIT 2",
        f"{NEAR} RETURN v.name, INTERVALS ORDER BY frames DESC LIMIT 3",
        f"{NEAR} RETURN v.name, INTERVALS SKIP 4",
        f"{NEAR} RETURN v.name, INTERVALS LIMIT 1 PER trace.name",
        f"{NEAR} RETURN v.name, {LEAST} AS least, INTERVALS HAVING least < 1",
        f"{SEQUENCE} RETURN v.name, INTERVALS LIMIT 1",
        f"{NEAR} RETURN v.name, INTERVALS HAVING {LEAST} < 0",
    ],
)
def test_frames_and_clips_are_of_the_chosen_intervals(query: str, open_town: Store) -> None:
    matches, every = open_town.find(query), open_town.find(query.partition(" RETURN ")[0])
    spans = [range(one.start_seq, one.end_seq + 1) for one in matches.intervals()]
    wanted = {one.seq for one in every.frames() if any(one.seq in span for span in spans)}
    times = {one.seq: one.log_time_ns for one in every.frames()}

    assert [one.seq for one in matches.frames()] == sorted(wanted)
    assert matches.count() == len(wanted) < every.count()
    assert {
        n for n, at in times.items() for c in matches.clips() if c.start_ns <= at <= c.end_ns
    } == wanted
