"""By how much checks are met: over columns, frame by frame, as it is defined, and as rtamt has it."""

from __future__ import annotations

import json
import math
import random
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from oracle_robustness import compare, compare_rtamt

from sgstore.apps.cli import run as run_verb
from sgstore.errors import QueryError
from sgstore.model.frame_ids import seq_of
from sgstore.temporal._formula import Bound, Proposition, Until, always, eventually
from sgstore.temporal._offline import arrays_of
from sgstore.temporal._robustness import MarginTable

if TYPE_CHECKING:
    from sgstore.query import Store

P, Q = Proposition("a"), Proposition("b")


def test_margins_of_random_formulas_are_what_their_definition_says() -> None:
    rng = random.Random(5)

    assert sum(compare(rng, rng.randint(1, 4)) for _ in range(150)) > 500


def test_margins_are_those_of_rtamt() -> None:
    pytest.importorskip("rtamt")
    rng = random.Random(6)

    assert sum(compare_rtamt(rng, rng.randint(1, 4)) for _ in range(150)) > 50


def test_a_margin_reaches_as_far_as_its_bound() -> None:
    frames = 3000
    columns = {"a": np.full((1, frames), -1.0), "b": np.full((1, frames), 5.0)}
    columns["a"][0, 2000] = 3.0
    table = MarginTable(columns, np.arange(frames, dtype=np.int64) * 10)

    near = table.value(eventually(P, Bound(0, 1000)))[0]
    onward = table.value(Until(Q, P))[0]

    assert near[1900] == near[2000] == 3.0
    assert near[1899] == near[2001] == -1.0
    assert onward[0] == 3.0
    assert onward[2001] == -1.0
    assert table.value(always(P, Bound(10, 20)))[0, -1] == math.inf
    assert table.decisive(eventually(P, Bound(0, 1000)), 0, 1950) == ("a", 2000)


@pytest.fixture
def town(open_town: Store) -> Store:
    return open_town


def test_a_count_of_a_block_that_speaks_of_others_has_its_margin(town: Store) -> None:
    count = "COUNT {(u:Vehicle) WHERE u <> e AND same_lane(e, u) AND lon(e, u) > 0}"
    many = [n for (n,) in town.find(f"MATCH (e:Ego) RETURN {count} AS n")]
    text = f"CHECK c: ALWAYS {count} < 3 ROBUSTNESS".replace("e,", "ego,").replace("<> e", "<> ego")

    (verdict,) = town.check(text)

    assert verdict.robustness is not None
    assert verdict.robustness.value == 3 - max(many) < 3
    before = f"MATCH (e:Ego) RETURN prev({count}) AS n"
    assert [n for (n,) in town.find(before)] == [None, *many[:-1]]


def test_a_check_says_by_how_much_by_whom_and_when(town: Store) -> None:
    text = "CHECK near: FORALL (v:Vehicle ABSENT AS TRUE) ALWAYS dist(ego, v) > 5 ROBUSTNESS"

    (verdict,) = town.check(text)

    least = "MATCH (e:Ego), (v:Vehicle) RETURN dist(e, v) - 5 AS d, v.name, frame.seq, frame.t"
    d, name, seq, t = town.find(f"{least} ORDER BY d LIMIT 1").rows()[0]
    found = verdict.robustness
    assert found is not None
    assert (found.value, found.names["v"], found.seq, found.t) == (d, name, seq, t)
    assert found.condition == "dist(ego, v) > 5"
    assert verdict.verdict == ("true" if d > 0 else "false")
    (plain,) = town.check(text.removesuffix("ROBUSTNESS"))
    assert plain.robustness is None
    assert (plain.verdict, plain.violations) == (verdict.verdict, verdict.violations)


@pytest.mark.parametrize(
    "condition",
    [
        "dist(ego, v) > 5",
        "NOT dist(ego, v) <= 5",
        "(dist(ego, v) > 5 AND gap(ego, v) > 2)",
        "(gap(ego, v) > 2 AND v.speed < 12)",
        "(gap(ego, v) > 2 OR v.speed < 1)",
        "ttc(ego, v) > 3",
        "dist(ego, v) > v.speed",
        "v.length < 6",
    ],
)
def test_robustness_is_the_least_margin_of_all_frames(town: Store, condition: str) -> None:
    run = town.check(f"CHECK FORALL (v:Vehicle) ALWAYS {condition} ROBUSTNESS")

    ((frames, margins),) = run.margins()
    (verdict,) = run

    found = verdict.robustness
    assert found is not None
    assert found.value == margins.min()
    assert found.seq == seq_of(frames[np.argmin(margins)])


def test_a_check_and_its_robustness_read_pairs_once(
    town: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows: list[int] = []

    def arrays(*about: Any) -> Any:
        found = arrays_of(*about)
        rows.append(len(found[0]))
        return found

    monkeypatch.setattr("sgstore.temporal._offline.arrays_of", arrays)
    monkeypatch.delattr("sgstore.temporal._offline.masks_of")
    list(town.check("CHECK FORALL (v:Vehicle) ALWAYS gap(ego, v) > 2 ROBUSTNESS"))

    assert len(rows) == 1


@pytest.mark.parametrize(
    ("formula", "value", "condition"),
    [
        ("ALWAYS NOT off_road(ego)", math.inf, "exists"),
        ("EVENTUALLY EXISTS {(ego)-[:near]->(:Train)}", -math.inf, "exists"),
        ("FORALL (t:Train) ALWAYS t.speed < 1", math.inf, ""),
        ("FORSOME (t:Train) ALWAYS t.speed < 1", -math.inf, ""),
        ("NEXT NEXT WEAKNEXT frame.seq > 1", 2.0, "frame.seq > 1"),
        ("ALWAYS frame.seq >= 0", 0.0, "frame.seq >= 0"),
        ("1 < 2", math.inf, ""),
    ],
)
def test_margins_of_conditions(town: Store, formula: str, value: float, condition: str) -> None:
    (verdict,) = town.check(f"CHECK {formula} ROBUSTNESS")

    assert verdict.robustness is not None
    assert verdict.robustness.value == value
    assert condition in verdict.robustness.condition.lower()


def test_a_forgiving_end_has_no_robustness(town: Store) -> None:
    with pytest.raises(QueryError, match="weak cannot be combined with ROBUSTNESS") as refused:
        town.check("USING END weak CHECK EVENTUALLY ego.speed > 99 ROBUSTNESS")

    assert refused.value.hint is not None


def test_the_verb_shows_by_how_much(town: Store, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(town.file.path)
    calm, near = "CHECK calm: ALWAYS ego.speed < 30", "CHECK near: ALWAYS NOT off_road(ego)"
    asked = ["check", path, "-e", f"{calm} ROBUSTNESS; {near} ROBUSTNESS"]

    assert run_verb([*asked, "--json"]) == 0
    first, second = json.loads(capsys.readouterr().out)
    assert first["robustness"]["condition"] == "ego.speed < 30"
    assert first["robustness"]["value"] > 0
    assert second["robustness"]["value"] is None
    assert run_verb(["check", path, "-e", calm, "--json"]) == 0
    assert "robustness" not in json.loads(capsys.readouterr().out)[0]
    assert run_verb([*asked, "--format", "csv"]) == 0
    assert "ego.speed < 30" in capsys.readouterr().out
