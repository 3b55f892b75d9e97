"""Swim lanes: what they tell of a trace, as text and as a picture."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from sgstore.apps.assistant import StoreTools
from sgstore.apps.cli import run
from sgstore.apps.demo import RECORDING
from sgstore.draw import Lane, Timeline, draw_timelines, lines_of, parts_timeline, timelines
from sgstore.errors import QueryError
from sgstore.query import Store

if TYPE_CHECKING:
    from pathlib import Path

CLOSE = "CHECK apart: FORALL (v:Vehicle) ALWAYS NOT dist(ego, v) < 7 RESET WHEN dist(ego, v) > 9"


@pytest.fixture(scope="module")
def town(town_store: Path) -> Path:
    return town_store


def test_a_letter_is_full_where_most_of_it_is_covered_and_half_where_some_of_it_is() -> None:
    lane = Lane(
        "brakes",
        "car 3",
        "",
        [(0, 2, False), (1, 3, False), (7.1, 7.2, False)],
    )
    head, line = lines_of(Timeline("drive", 10.0, [lane]), letters=10)

    assert head == "drive  0 … 10.0 s"
    assert line == "  brakes · car 3  ███▌···▌··  found 3 times, 3.1 s"


def test_the_lanes_of_a_store_are_its_violations_and_its_matches(town: Path) -> None:
    store = Store(town)
    text = "MATCH (e:Ego) WHERE e.speed > 8"
    (timeline,) = timelines(store, {"rules": (CLOSE, {}), "fast": (text, {})})
    (verdict,) = store.check(CLOSE)
    violated = {(lane.who, len(lane.spans)) for lane in timeline.lanes if lane.name == "apart"}
    (fast,) = [lane for lane in timeline.lanes if lane.name == "fast"]

    assert violated == {(w.names["v"], len(w.violations)) for w in verdict.witnesses}
    assert [(start, end) for start, end, _ in fast.spans] == [
        (i.start, i.end) for i in store.find(text).intervals()
    ]
    assert timelines(store, {"fast": (text, {})}, "elsewhere") == []


def test_the_verb_prints_lanes_or_draws_them(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["timeline", str(town), CLOSE, "-p", "phi6"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^  phi6 +[█▌·]+  violated once", text, re.MULTILINE)

    picture = tmp_path / "when.svg"
    assert run(["timeline", str(town), CLOSE, "-p", "phi6", "-o", str(picture)]) == 0
    drawn = picture.read_text(encoding="utf-8")
    assert "phi6" in drawn
    assert drawn.count("apart · ") == text.count("apart · ")
    assert run(["timeline", str(town)]) == 2


def test_traces_have_one_scale(tmp_path: Path) -> None:
    lane = Lane("brakes", "car 3", "", [(0, 4.9, False)])
    short, long = Timeline("short", 5.0, [lane]), Timeline("long", 20.0, [lane])

    assert lines_of(short, 8, 20.0)[1].split("  ")[2] == "██"
    assert lines_of(long, 8, 20.0)[1].split("  ")[2] == "██······"
    assert lines_of(short, 8)[1].split("  ")[2] == "████████"
    draw_timelines([short, long], tmp_path / "a.svg")
    drawn = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert drawn.count(">20 s<") == 2
    assert drawn.count("found once, 4.9 s") == 2


def test_only_traces_with_a_hit_are_shown_unless_all_are_asked_for(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = tmp_path / "two.sgstore"
    assert run(["ingest", str(store), str(RECORDING), "--until", "5s", "--json"]) == 0
    assert run(["import", str(store), str(_graph(tmp_path)), "--as", "csv", "--kind", "a=car"]) == 0
    capsys.readouterr()
    rule = "CHECK slow: ALWAYS ego.speed < 1"

    assert run(["timeline", str(store), rule]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("town  0 … ")
    assert "graphs  0" not in out
    assert "1 more traces without matches or violations; --all shows them" in err
    assert run(["timeline", str(store), rule, "--all"]) == 0
    assert "graphs  0" in capsys.readouterr().out


def _graph(folder: Path) -> Path:
    file = folder / "graphs.csv"
    file.write_text("graph,src,relation,dst\n1,a,near,a\n2,a,near,a\n", encoding="utf-8")
    return file


def test_parts_of_a_pattern_have_lanes_and_what_they_have_in_common(
    town: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    query = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed > 3"
    store = Store(town)
    match = next(store.find(query).intervals())
    frame = f"{match.trace}#{match.start_seq}"
    timeline = parts_timeline(store, query, frame, {})
    lanes = store.parts(query, frame)

    assert [lane.name for lane in timeline.lanes] == [
        "(e)-[:near_coll]->(v)",
        "e.speed > 3",
        "all of it",
    ]
    assert [len(lane.spans) for lane in timeline.lanes[:2]] == [
        len(one.spans) for one in lanes.lanes
    ]
    assert (match.start, match.end, False) in timeline.lanes[2].spans

    assert run(["timeline", str(town), query, "--parts", frame]) == 0
    assert "\n  all of it  " in re.sub(" +", lambda found: found[0][:2], capsys.readouterr().out)
    assert run(["timeline", str(town), query, "-p", "phi6", "--parts", frame]) == 2


@pytest.mark.parametrize(
    ("spans", "explained"),
    [
        ([(0.0, 2.0, False)], ["found"]),
        ([(0.0, 2.0, True)], ["violated"]),
        ([(0.0, 2.0, True), (3.0, 4.0, False)], ["found", "violated"]),
        ([], []),
    ],
)
def test_a_picture_explains_the_colours_that_occur(
    tmp_path: Path, spans: list[tuple[float, float, bool]], explained: list[str]
) -> None:
    draw_timelines([Timeline("drive", 10.0, [Lane("a", "b", "", spans)])], tmp_path / "a.svg")

    drawn = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert [word for word in ("found", "violated") if f">{word}<" in drawn] == explained


def test_a_recording_is_watched_by_the_verb(capsys: pytest.CaptureFixture[str]) -> None:
    rule = "CHECK slow: ALWAYS ego.speed < 8; MATCH (e:Ego) WHERE e.speed < 1 THEN MATCH (e) WHERE e.speed > 5"
    asked = ["monitor", str(RECORDING), "-e", rule, "--duration", "12s"]

    assert run([*asked, "--require"]) == 4
    text = capsys.readouterr().out
    assert "violated    slow" in text
    assert text.endswith("slow: false  1 violation\n")

    assert run([*asked, "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert '"event": "verdict", "name": "slow"' in lines[-1]


def test_faces_name_lanes_alike(town: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["cut_in", "MATCH (e:Ego) WHERE e.speed > 8", CLOSE]
    lanes = {"cut_in", "match 1", "apart"}

    (found,) = Store(town).timeline(*asked)
    assert {lane.name for lane in found.lanes} == lanes
    with StoreTools(town, timeout_s=60) as tools:
        (told,) = tools.timeline(asked).data["timelines"]
    assert {lane["name"] for lane in told["lanes"]} == lanes
    assert run(["timeline", str(town), *asked]) == 0
    shown = re.findall(r"^  ([\w ]+?)(?: ·|  )", capsys.readouterr().out, re.MULTILINE)
    assert {*shown} == lanes


def test_parameters_belong_to_the_lane_that_has_them(town: Path) -> None:
    store, text = Store(town), "MATCH (e:Ego) WHERE e.speed > $least"
    values = {"within": 3, "least": 8}
    both = store.timeline("cut_in", text, parameters=values)[0].lanes

    assert {lane.name for lane in both} == {"cut_in", "match"}
    with pytest.raises(QueryError, match="nothing"):
        store.timeline("cut_in", parameters={"nothing": 1})
