"""The library of named patterns: each finds the scene that is drawn beside it, and not its counter-example."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import library_page
import numpy as np
import pytest
from formulas import formula_of
from library_scenes import LEFT, RIGHT, SCENES, WAYS, aside, is_of_the_ego, traces
from scenes import APART, Scene, actor, along, ego, store_of, street
from test_sample import told
from test_temporal import FORMULAS, FORMULAS_OF_TIME, never, property_named
from thorough import LONG, some

from sgstore.errors import QueryError, QueryNameError
from sgstore.lang.library import entries, pattern_named, patterns, predicates
from sgstore.lang.syntax import parse
from sgstore.lang.syntax.tree import CheckClause, Define, MatchClause
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.query import Store
    from sgstore.temporal import Formula, Verdict

pytestmark = pytest.mark.seconds(42)

FOUND = [name for name, one in patterns().items() if one.kind in {"concept", "scenario"}]
RULES = [name for name, one in patterns().items() if one.kind == "property"]


@pytest.fixture(scope="module")
def store(town_store: Path) -> Iterator[Store]:
    """A store of the bundled recording, and of all scenes; it stays open."""
    store = store_of(town_store, TRACES)
    with store.file.snapshot():
        yield store


TRACES, PLACES = traces()


# What is in it ----------------------------------------------------------------------------------------------


def test_the_library_has_what_it_says() -> None:
    kinds = [(one.library, one.kind) for one in patterns().values()]

    assert kinds.count(("leaderboard", "scenario")) == 48
    assert kinds.count(("concepts", "concept")) >= 20
    assert kinds.count(("nuplan", "scenario")) == 13
    assert kinds.count(("sgsm", "property")) == 2 * 9
    assert kinds.count(("sceneflow", "property")) >= 8
    assert kinds.count(("rules", "property")) >= 11
    assert kinds.count(("std", "predicate")) >= 25


@pytest.mark.parametrize("name", patterns())
def test_a_text_is_one_sentence_of_its_kind(name: str) -> None:
    one = patterns()[name]
    (statement,) = parse(one.text)
    kind = {"predicate": Define, "property": CheckClause}.get(one.kind, MatchClause)

    assert isinstance(statement, kind)
    assert one.sentence.endswith(".")
    if isinstance(statement, Define | CheckClause):
        assert statement.name == name


def test_every_pattern_has_a_drawn_example() -> None:
    drawn = {name for name, one in patterns().items() if one.example}

    assert drawn == set(SCENES) == {*FOUND, *RULES}


def test_the_page_and_the_drawings_are_up_to_date() -> None:
    again = "python tools/library_page.py makes it again"

    assert library_page.DRAWINGS.read_text(encoding="utf-8") == library_page.drawings(), again
    assert library_page.PAGE.read_text(encoding="utf-8") == library_page.page(), again


# Names, parameters, files -----------------------------------------------------------------------------------


def test_a_name_may_be_written_otherwise_where_only_one_is_meant() -> None:
    assert pattern_named("Hard-Braking".replace("-", "")).name == "hard_braking"
    assert pattern_named("CutIn").library == "leaderboard"
    assert pattern_named("cut_in").library == "concepts"
    with pytest.raises(QueryNameError, match="'CUTIN' may be cut_in or CutIn"):
        pattern_named("CUTIN")


def test_a_name_that_is_not_there_gets_a_suggestion() -> None:
    with pytest.raises(QueryNameError) as caught:
        pattern_named("jaywalkin")

    assert caught.value.hint == "did you mean 'jaywalking'?"


def test_parameters_are_written_into_the_text_as_their_types_are() -> None:
    cut_in = pattern_named("cut_in")

    assert "$" not in cut_in.text
    assert "THEN WITHIN 4s" in cut_in.text
    assert "THEN WITHIN 2.5s" in cut_in.written(within=2.5)
    assert "THEN WITHIN 300ms" in cut_in.written(within="300ms")
    assert "< 0.5 * e.speed" in cut_in.written(headway=0.5)
    assert "ego.speed > 12" in pattern_named("phi4").written(S="12")


@pytest.mark.parametrize("value", ["soon", True, float("nan"), "2; MATCH (e)", None, "-1s", -1])
def test_a_value_of_another_type_is_refused(value: object) -> None:
    with pytest.raises(QueryError, match="parameter 'within' cannot be") as caught:
        pattern_named("cut_in").written(within=value)

    assert caught.value.hint == "expected a duration such as 4s"


def test_a_parameter_that_a_pattern_does_not_have_is_refused() -> None:
    with pytest.raises(QueryNameError, match="cut_in has no parameter 'speed'") as caught:
        pattern_named("cut_in").written(speed=3)

    assert caught.value.hint == "it has: headway, within, hold"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("-- recipe x: S.\nMATCH (e)", "line 2: expected '-- KIND NAME: sentence'"),
        ("MATCH (e)", "line 1: expected '-- KIND NAME: sentence'"),
        ("-- concept x: S.\n-- param a: 3", "line 2: expected '-- param NAME = DEFAULT: meaning'"),
        ("-- concept x: S.\n-- param a = soon: m", "line 2: expected '-- param NAME = DEFAULT"),
        ("-- concept x: S.\n-- param a = 3: m\nMATCH (e)", "'a' is not both declared and used"),
        ("-- concept x: S.\n-- source: s\nMATCH (e) LIMIT $n", "'n' is not both declared and used"),
        ("-- concept x: S.\nMATCH (e)", "'x': the source is missing"),
        ("-- concept x: S.\n-- source: s\n", "'x': the text is missing"),
    ],
)
def test_a_file_that_cannot_be_read_says_where(text: str, reason: str) -> None:
    with pytest.raises(QueryError, match=rf"^mine\.sgql.*{re.escape(reason)}"):
        list(entries(text, "mine"))


def test_what_a_head_says_may_take_several_lines() -> None:
    head = "-- concept x: One\n--   two.\n-- param a = 3: m,\n--   n\n-- source: s\n--   t\n"
    text = head + "MATCH (e) LIMIT $a\n\n-- end"
    (one,) = entries(text, "mine")

    assert (one.sentence, one.source, one.parameters["a"].meaning) == ("One two.", "s t", "m, n")
    assert one.text == "MATCH (e) LIMIT 3"


def test_predicates_are_looked_up_without_regard_to_case() -> None:
    assert predicates()["hardbrake"].name == "hard_brake"
    assert "cutin" not in predicates()
    assert len(predicates()) == len([*predicates()])


# Rules of SGSM are the published formulas -------------------------------------------------------------------


def published(name: str) -> Formula:
    """A rule as coded, as a formula over the propositions that SGSM published under the names of its atoms.

    ``name`` is that of the published file: ``Phi7_T_10`` are 10 s at 2 Hz.
    """
    number, *of = name.lower().split("_")
    value = {} if not of else {"N": f"{2 * int(of[1])}frames"} if of[0] == "t" else {"S": of[1]}
    text = pattern_named(f"{number}_as_coded").written(**value).split(":", 1)[1]
    view = pattern_named("nothing_in_view").query.split(" AS", 1)[1]
    text = text.replace("nothing_in_view()", f"({view})")
    text = re.sub(r"ego_is_faster_than\(\d+\)", "ego_is_faster_than_s", text)
    text = text.replace("()", "")
    if found := re.fullmatch(r"\s*NOT EVENTUALLY run_length\((.*)\) >= (\d+)frames\s*", text):
        # A run of n frames that ends somewhere: SGSM's $[n][…].
        row = formula_of(found[1].replace("is_in_junction", "is_in_juntion"))
        return never(row, int(found[2]))
    return formula_of(text)


@pytest.mark.parametrize("name", [*FORMULAS, *FORMULAS_OF_TIME])
def test_a_rule_of_sgsm_is_the_formula_whose_published_verdicts_are_met(name: str) -> None:
    assert published(name) == property_named(name)


# Examples of the literature ---------------------------------------------------------------------------------

TEXT = (Path(__file__).parents[1] / "examples.sgql").read_text(encoding="utf-8")
EXAMPLES = {one.name: one for one in entries(TEXT, "examples")}


@pytest.mark.parametrize("name", [n for n, one in EXAMPLES.items() if not one.is_check])
def test_an_example_of_the_literature_can_be_asked(store: Store, name: str) -> None:
    matches = store.find(EXAMPLES[name].text)

    assert len(matches.rows()) >= {"e13": 1, "e15": 750, "e20": 1}.get(name, 0)


@pytest.mark.parametrize("name", [n for n, one in EXAMPLES.items() if one.is_check])
def test_a_rule_of_the_literature_has_a_verdict(store: Store, name: str) -> None:
    verdicts = {one.trace: one for one in store.check(EXAMPLES[name].text)}

    assert answered(verdicts["town"])


# What they find ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FOUND)
def test_a_pattern_finds_its_drawn_example_and_not_its_counter_example(
    store: Store, name: str
) -> None:
    example, *others = PLACES[name]
    matches = store.find(patterns()[name].text)
    found = {(i.trace, int(i.start // APART)) for i in matches.intervals()}

    assert example in found
    assert not set(others) & found
    assert "town" not in matches.left_out or "never has a value" in matches.reasons["town"]


@pytest.mark.parametrize("name", FOUND)
def test_a_sequence_is_over_when_its_last_step_is(name: str) -> None:
    (statement,) = parse(patterns()[name].text)
    *before, last = statement.sequence.steps

    assert not before or last.hold is None, "with FOR it would go on for as long as that holds"


def test_the_cut_in_of_the_sample_lasts_as_long_as_its_story(store: Store) -> None:
    start, end = told()["cut_in"]
    (found,) = (i for i in store.find(patterns()["cut_in"].text).intervals() if i.trace == "town")

    assert (found.start, found.end) == pytest.approx((start, end), abs=0.5)


@pytest.mark.parametrize(
    "name", ["cut_in", "CutIn", "near_miss", "merge_conflict", "starting_left_turn"]
)
def test_a_pattern_is_a_step_by_its_name(store: Store, name: str) -> None:
    one, other = (store.find(text) for text in (f"MATCH {name}()", patterns()[name].text))
    rows = [dict(zip(other.columns, row, strict=True)) for row in other]

    assert [dict(zip(one.columns, row, strict=True)) for row in one] == rows != []


@pytest.mark.parametrize("name", [n for n in FOUND if patterns()[n].kind == "concept"])
def test_a_concept_has_a_counter_example(name: str) -> None:
    assert len(PLACES[name]) == 2


# Rules ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", RULES)
def test_a_rule_is_violated_in_its_example_and_kept_in_the_other(store: Store, name: str) -> None:
    verdicts = {one.trace: one for one in store.check(patterns()[name].text)}
    violated, kept = (verdicts[trace] for trace, _ in PLACES[name])

    if is_of_the_ego(name):
        assert (violated.verdict, kept.verdict) == ("false", "true")
    else:
        example, other = PLACES[name]
        assert broken_in(violated) >= {example[1]}
        assert other[1] not in broken_in(kept)
    assert answered(verdicts["town"])


@pytest.mark.parametrize(
    "name", some([n for n in (*FOUND, *RULES) if patterns()[n].library == "rules"], 2)
)
def test_a_rule_watched_is_violated_and_kept_in_the_same_scenes(store: Store, name: str) -> None:
    for (trace, number), violated in zip(PLACES[name], (True, False), strict=True):
        span = number * APART, (number + 1) * APART
        sql = "SELECT frame_id FROM frames WHERE trace = ? AND t >= ? AND t < ? ORDER BY frame_id"
        ids = store.file.arrays(sql, [trace, *span])["frame_id"].astype(np.int64)
        told: list[str] = []
        monitor = Monitor(
            patterns()[name].text,
            TRACES[trace][number].road,
            trace=trace,
            on_event=lambda event, told=told: told.append(event.kind),
        )
        for graph in store.file.graphs(ids):
            monitor.look([graph])
        monitor.finish()

        assert bool({"violated", "found"} & {*told}) == violated, told


MEASURED = [name for name in RULES if patterns()[name].library == "rules"]


@pytest.mark.parametrize("name", MEASURED if LONG else ["r_g1_safe_distance", "r_g3_speed_limit"])
def test_a_rule_says_by_how_much_it_is_kept(store: Store, name: str) -> None:
    text = f"{patterns()[name].text.rstrip().rstrip(';')} ROBUSTNESS"

    told = {one.trace: one for one in store.check(text)}

    (violated, _), (kept, _) = PLACES[name]
    for trace in {violated, kept}:
        robustness = told[trace].robustness
        assert robustness is not None
        kept = 1 if told[trace].verdict == "true" else -1
        assert kept * robustness.value >= 0  # a gap is 0 where footprints touch
    assert told[violated].verdict == "false"


def answered(verdict: Verdict) -> bool:
    """Whether a verdict is told, or what the recording does not say is: it has no control inputs."""
    return verdict.verdict != "unknown" or "never has a value" in verdict.reason


def broken_in(verdict: Verdict) -> set[int]:
    """The scenes of a trace in which a rule of several is violated, told by who violates it."""
    of: list[int] = []
    for number, scene in enumerate(TRACES[verdict.trace]):
        of += [number] * len(scene.actors)
    return {
        of[node] for witness in verdict.witnesses for node in witness.nodes.values() if node >= 0
    }


# Scenes that are nearly a manoeuvre -------------------------------------------------------------------------

COMES_OVER = Scene(WAYS, ego(aside(40, LEFT, RIGHT), 15), actor("v", along(RIGHT), 15, start=12))
"""The ego changes into the lane of a vehicle ahead."""
DRIVES_ON = Scene(
    street("driving", "driving", cut=60.0),
    ego(along(RIGHT), 12),
    actor("v", along(RIGHT), [(0, 14), (3, 14), (6, 8)], start=30),
    seconds=8,
)
"""Two vehicles in one lane, which is two parts of the map."""


@pytest.mark.parametrize("name", ["cut_in", "CutIn", "iso_cut_in", "iso_change_cut_in"])
@pytest.mark.parametrize("scene", [COMES_OVER, DRIVES_ON], ids=["comes over", "drives on"])
def test_no_vehicle_cuts_in_if_only_the_ego_changes_lanes(
    scene: Scene, name: str, tmp_path: Path
) -> None:
    store = store_of(tmp_path / "s.sgstore", {"scene": [scene]})

    assert store.find(patterns()[name].text).count() == 0


def test_a_contact_does_not_restore_the_following_distance(tmp_path: Path) -> None:
    """The ego runs through a slower vehicle, which is then no longer its lead."""
    scene = Scene(WAYS, ego(along(RIGHT), 12), actor("v", along(RIGHT), 6, start=40), seconds=12)
    store = store_of(tmp_path / "s.sgstore", {"scene": [scene]})

    (found,) = store.check(patterns()["r157_following"].text)

    assert found.verdict == "false"
