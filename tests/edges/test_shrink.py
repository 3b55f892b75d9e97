"""Shortest clips: the oracle asks a store in which every range of frames of a drive is a trace of its own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scenes import Scene, actor, along, ego, path, store_of, street

from sgstore.apps.cli import run
from sgstore.base.tables import taken
from sgstore.errors import QueryError, StoreError
from sgstore.ingest import ingest
from sgstore.query import Store
from sgstore.temporal._shrink import fewest

if TYPE_CHECKING:
    from sgstore.model.world import FrameBlock

ROAD = street("driving", "driving")
DRIVE = Scene(
    ROAD,
    ego(along(-1.75), [(0, 6), (0.6, 6), (1.2, 0), (2, 4)]),
    actor("v", path((0, -5.25), (20, -5.25), (28, -1.75), (400, -1.75)), 8, start=14),
    actor("w", along(-1.75), [(0, 5), (0.8, 1), (2, 5)], start=24),
    actor("late", along(-5.25), 2, start=5, since=1.0),
    seconds=2.0,
    rate=5.0,
)
FRAMES = len(DRIVE.times)


class Part(Scene):
    """Some frames of a scene, and who is in them."""

    range: slice

    def __init__(self, whole: Scene, first: int, last: int) -> None:
        seen = [a for a in whole.actors if a.since <= whole.times[last]]
        super().__init__(whole.road, *seen, seconds=whole.seconds, rate=whole.rate)
        object.__setattr__(self, "range", slice(first, last + 1))

    def block(self, number: int = 0, first: int = 0, seq: int = 0) -> FrameBlock:
        whole, rows = super().block(number, first, seq), self.range
        low, high = whole.offsets[rows.start], whole.offsets[rows.stop]
        return replace(
            whole,
            seq=whole.seq[rows] - rows.start,
            time_ns=whole.time_ns[rows],
            log_time_ns=whole.log_time_ns[rows],
            offsets=whole.offsets[rows.start : rows.stop + 1] - low,
            states=taken(whole.states, np.arange(low, high)),
            ego=whole.ego[rows],
        )


RANGES = [(i, j) for i in range(FRAMES) for j in range(i, FRAMES)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return store_of(tmp_path_factory.mktemp("whole") / "s.sgstore", {"drive": [DRIVE]})


@pytest.fixture(scope="module")
def ranges(tmp_path_factory: pytest.TempPathFactory) -> Store:
    traces = {f"{i}-{j}": [Part(DRIVE, i, j)] for i, j in RANGES}
    return store_of(tmp_path_factory.mktemp("ranges") / "s.sgstore", traces)


QUERIES = [
    "MATCH (e:Ego) WHERE e.speed < 3",
    "MATCH (e:Ego) WHERE e.speed > 5 THEN MATCH (e) WHERE e.speed < 2",
    "MATCH (v:Vehicle) WHERE v.speed > 3 THEN WITHIN 1s MATCH (v) WHERE v.speed < 2",
    "MATCH (v:Vehicle) WHERE v.speed < 3 FOR >= 0.4s",
    "MATCH (v:Vehicle) WHERE v.speed < 3 FOR < 0.4s THEN MATCH (v) WHERE v.speed > 3",
    "MATCH (e:Ego), (v:Vehicle) WHERE run_length(same_lane(e, v)) >= 3frames",
    "MATCH (e:Ego) WHERE delta(e.speed, 0.4s) < -3 THEN MATCH (e) WHERE e.speed < 1",
    "MATCH (e:Ego) WHERE e.speed > 5 THEN NOT MATCH (e) WHERE e.speed < 1 THEN MATCH (e) WHERE e.speed > 2",
    "MATCH (e:Ego) WHERE e.speed > 5 THEN WITHIN 0.6s NOT MATCH (e) WHERE e.speed < 5",
    "MATCH (e:Ego) WHERE EVENTUALLY[0s, 1s] e.speed < 1 THEN MATCH (e) WHERE e.speed > 1",
    "MATCH (e:Ego) WHERE e.speed > 1 AND NOT EVENTUALLY[0s, 1s] e.speed < 1 THEN MATCH (e) WHERE e.speed > 1",
    "MATCH (v:Vehicle) WHERE ONCE[0s, 0.6s] v.speed > 4 AND v.speed < 2",
    "MATCH (v:Vehicle) WHERE v.speed > 7 UNTIL MATCH (e:Ego), (v) WHERE same_lane(e, v)",
    "MATCH (e:Ego) WHERE e.speed < 0.5 UNION MATCH (e:Ego) WHERE e.speed > 5 THEN MATCH (e) WHERE e.speed < 3",
    "MATCH (e:Ego) WHERE e.speed > 50 THEN MATCH (e) WHERE e.speed < 2",
]
CHECKS = [
    "CHECK c: ALWAYS ego.speed > 3",
    "CHECK c: ALWAYS (ego.speed > 5 IMPLIES NEXT ego.speed > 5)",
    "CHECK c: ALWAYS (ego.speed < 1 IMPLIES ONCE[0s, 1s] ego.speed > 5)",
    "CHECK c: ALWAYS NOT run_length(ego.speed < 4) >= 3frames",
    "CHECK c: FORALL (v:Vehicle) ALWAYS (same_lane(ego, v) IMPLIES NOT v.speed < 2)",
    "CHECK c: FORALL (v:Vehicle) ALWAYS dist(ego, v) < 20",
    "CHECK c: FORALL (v:Vehicle) EVENTUALLY[0s, 0.6s] v.speed > 3",
    "CHECK c: FORALL (v:Vehicle WHERE v.speed > 6) ALWAYS NOT same_lane(ego, v)",
    "CHECK c: FORSOME (v:Vehicle) ALWAYS v.speed > 3",
    "CHECK c: ego.speed > 5 UNTIL ego.speed < 1",
    "CHECK c: EVENTUALLY ego.speed > 50",
    "CHECK c: ALWAYS (ego.speed > 5 IMPLIES EVENTUALLY[0s, 0.4s] ego.speed < 1) RESET WHEN ego.speed < 1",
]


def least(having: set[str]) -> tuple[int, int] | None:
    """The shortest range, the earliest of these, of those whose traces have something."""
    return min(
        (r for r in RANGES if "{}-{}".format(*r) in having),
        key=lambda r: (r[1] - r[0], r),
        default=None,
    )


def cut(store: Store, text: str) -> tuple[int, int] | None:
    found = [*store.shrink(text)]
    assert len(found) <= 1
    return (found[0].start_seq, found[0].end_seq) if found else None


@pytest.mark.parametrize("text", QUERIES)
def test_no_range_with_a_match_is_shorter(whole: Store, ranges: Store, text: str) -> None:
    assert cut(whole, text) == least({frame.trace for frame in ranges.find(text).frames()})


@pytest.mark.parametrize("text", CHECKS)
def test_no_range_with_a_violation_is_shorter(whole: Store, ranges: Store, text: str) -> None:
    verdicts = ranges.check(f"USING END weak {text}")

    assert cut(whole, text) == least({one.trace for one in verdicts if one.violated})


def test_a_part_that_still_has_it_need_not_have_it_when_more_follows() -> None:
    has = {(0, 1), (2, 2), (1, 3)}
    grown = {(i, j) for i in range(5) for j in range(5) if i <= 2 <= j}

    assert fewest(5, lambda i, j: (i, j) in has, grows=False) == (2, 2)
    assert fewest(5, lambda i, j: (i, j) in grown, grows=True) == (2, 2)
    assert fewest(5, lambda i, j: False, grows=True) is None


def test_a_clip_is_cut_within_its_ends(whole: Store) -> None:
    text = "MATCH (e:Ego) WHERE e.speed < 3"
    (found,) = whole.shrink(text)
    (later,) = whole.shrink(text, f"drive#{found.start_seq + 1}..{FRAMES - 1}")

    assert later.start_seq == found.start_seq + 1
    assert (found.of, later.of) == (FRAMES, FRAMES - found.start_seq - 1)
    assert not [*whole.shrink(text, "drive#0..1")]


@pytest.mark.parametrize(
    ("text", "clip", "error"),
    [
        ("MATCH (e:Ego) WHERE e.sped > 1", None, QueryError),
        ("MATCH (e:Ego)", "drive@1s", StoreError),
        ("MATCH (e:Ego)", "drive#5..2", StoreError),
        ("MATCH (e:Ego)", "nowhere#0..2", StoreError),
    ],
)
def test_what_cannot_be_cut_is_refused(
    whole: Store, text: str, clip: str | None, error: type[Exception]
) -> None:
    with pytest.raises(error):
        list(whole.shrink(text, clip))


def shrunk(capsys: pytest.CaptureFixture[str], *line: Any) -> list[dict[str, Any]]:
    assert run(["shrink", *map(str, line), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_what_is_cut_out_of_a_recording_still_has_it_there(
    town_store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The clip has the messages as they were, and a store of it alone has the match, and the violation."""
    rule = "CHECK slow: ALWAYS NOT (ego.speed < 1 AND ONCE[0s, 5s] ego.speed > 3)"
    (tmp_path / "rule.sgql").write_text(rule)
    asked = [("-p", "cut_in"), ("-f", tmp_path / "rule.sgql")]

    for number, question in enumerate(asked):
        to = tmp_path / str(number)
        (row,) = shrunk(capsys, town_store, *question, "--to", to)
        ingest(to / "cut.sgstore", [to / Path(row["file"]).name])
        cut_out = Store(to / "cut.sgstore")

        assert row["frames"] < row["of"] / 5
        assert sum(trace.frames for trace in cut_out.info()) == row["frames"]
        if number:
            assert [one.verdict for one in cut_out.check(rule)] == ["false"]
        else:
            assert cut_out.find("MATCH cut_in()").count() == 1


@pytest.mark.parametrize(
    ("name", "told"),
    [("file", "a file; an export needs a folder"), ("used", "manifest.json exists already")],
)
@pytest.mark.parametrize("verb", ["shrink", "export"])
def test_a_folder_is_refused_before_anything_is_searched(
    town_store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    verb: str,
    name: str,
    told: str,
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "manifest.json").touch()
    for search in ("shrink", "find"):
        monkeypatch.setattr(Store, search, lambda *_, **__: pytest.fail("it searches"))

    assert run([verb, str(town_store), "-p", "cut_in", "--to", str(tmp_path / name)]) != 0

    assert told in " ".join(capsys.readouterr().err.split())


def test_what_has_nothing_to_cut_says_so(
    town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for text, told in (
        ("CHECK ALWAYS ego.speed < 99", "no violations"),
        ("MATCH (e:Ego) WHERE e.speed > 99", "no matches"),
    ):
        assert run(["shrink", str(town_store), text]) == 0
        assert f"{told} to cut" in capsys.readouterr().err
