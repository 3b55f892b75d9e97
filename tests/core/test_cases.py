"""Small recordings that once gave a wrong answer: each gives the right one.

Each test is named after a folder of ``cases/`` of the shared data. Its ``expected.txt`` describes the fault.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from sgstore.apps.cli import run

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

Rows = list[dict[str, Any]]
EGO_SPEED = "MATCH (e:Ego) RETURN frame.seq, frame.t, e.speed, e.accel"
SIZES = "MATCH (v:Vehicle) RETURN frame.seq, v.ident, v.length, v.width, v.height"


class Case:
    """The folder of a case and the store that the test fills."""

    def __init__(self, folder: Path, store: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self.store, self.capsys = folder, store, capsys

    def ingest(self, *names: str, options: tuple[str, ...] = ()) -> tuple[int, str]:
        """Return the exit code and the text on both streams."""
        paths = [str(self.folder / name) for name in names]
        code = run(["ingest", str(self.store), *paths, *options])
        captured = self.capsys.readouterr()
        return code, captured.out + captured.err

    def find(self, query: str) -> Rows:
        assert run(["find", str(self.store), query, "--json"]) == 0
        return json.loads(self.capsys.readouterr().out)

    def values(self, query: str) -> list[tuple[Any, ...]]:
        return [tuple(row.values()) for row in self.find(query)]

    def report(self) -> str:
        """What info and the reports of reading say."""
        run(["info", str(self.store), "--json"])
        captured = self.capsys.readouterr()
        return (captured.out + captured.err).lower()


@pytest.fixture
def case(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[[str], Case]:
    def made(name: str) -> Case:
        folder = data / "cases" / name
        if not folder.is_dir():
            pytest.skip(f"no case at {folder}")
        return Case(folder, tmp_path / f"{name}.sgstore", capsys)

    return made


def test_bugs_01_log_time_order_osi(case: Callable[[str], Case]) -> None:
    query = (
        "MATCH (e:Ego), (v:Car) WHERE dist(e, v) > 23"
        " THEN MATCH (e), (v) WHERE dist(e, v) < 23 RETURN INTERVALS"
    )
    order = case("bugs-01-log-time-order-osi")
    order.ingest("swapped.mcap")

    assert [(row["start_seq"], row["end_seq"]) for row in order.find(query)] == [(0, 4)]


def test_bugs_02_split_truth_by_topic(case: Callable[[str], Case]) -> None:
    split = case("bugs-02-split-truth-by-topic")
    split.ingest("split0.mcap", "split1.mcap")
    per_trace = [
        split.values(
            f"MATCH (v:Car) WHERE trace.name = '{name}' RETURN frame.seq, v.ident ORDER BY frame.seq, v.ident"
        )
        for name in ("split0", "split1")
    ]

    assert per_trace[0] == per_trace[1]
    assert [seq for seq, ident in per_trace[0] if ident == "3"] == [0, 1, 2, 3, 4, 5]


def test_bugs_03_carla_controls_by_topic(case: Callable[[str], Case]) -> None:
    late = case("bugs-03-carla-controls-by-topic")
    late.ingest("c_late0.mcap")

    throttle = [value for (value,) in late.values("MATCH (e:Ego) RETURN e.throttle")]
    assert throttle == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])


def test_bugs_04_autoware_ego_by_topic(case: Callable[[str], Case]) -> None:
    late = case("bugs-04-autoware-ego-by-topic")
    late.ingest("aw_t.mcap")

    assert late.values("MATCH (e:Ego) RETURN frame.seq") == [(seq,) for seq in range(5)]


def test_bugs_05_foxglove_ego_axes_by_topic(case: Callable[[str], Case]) -> None:
    late = case("bugs-05-foxglove-ego-axes-by-topic")
    late.ingest("tf_first.mcap", "tf_late.mcap")
    query = "MATCH (e:Ego) WHERE trace.name = '{}' RETURN frame.seq, e.x"

    assert len(late.values(query.format("tf_first"))) == 5
    assert late.values(query.format("tf_late")) == late.values(query.format("tf_first"))


def test_bugs_06_looped_playback(case: Callable[[str], Case]) -> None:
    loop = case("bugs-06-looped-playback")
    loop.ingest("looped.mcap")

    sequence = "MATCH (e:Ego) WHERE e.x > 3 THEN MATCH (e) WHERE e.x < 1 RETURN INTERVALS"
    assert loop.find(sequence) == []
    steps = loop.values("MATCH (v:Car {ident: '3'}) RETURN frame.seq, delta(v.x, 100ms) AS d")
    assert steps == [(seq, None if seq in {0, 6} else -1.0) for seq in range(12)]


def test_bugs_07_stamp_zero_is_a_time_foxglove(case: Callable[[str], Case]) -> None:
    zero = case("bugs-07-stamp-zero-is-a-time-foxglove")
    zero.ingest("f_epoch.mcap")

    rows = zero.values("MATCH (v:Car {ident: 'a'}) RETURN frame.t, v.speed")
    assert [t for t, _ in rows] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert rows[0][1] is not None


def test_bugs_08_stamp_zero_is_a_time_autoware(case: Callable[[str], Case]) -> None:
    zero = case("bugs-08-stamp-zero-is-a-time-autoware")
    zero.ingest("a_epoch.mcap", "aw_i.mcap")

    cars = "MATCH (v:Car) WHERE NOT v.is_ego AND trace.name = 'a_epoch' RETURN frame.t"
    assert [t for (t,) in zero.values(cars)] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    egos = zero.values("MATCH (e:Ego) WHERE trace.name = 'aw_i' RETURN frame.t, e.x")
    assert [t for t, _ in egos] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert [x for _, x in egos] == pytest.approx([1.345 + 10 * n for n in range(5)], abs=1e-4)


def test_bugs_09_one_missing_stamp(case: Callable[[str], Case]) -> None:
    missing = case("bugs-09-one-missing-stamp")
    missing.ingest("stamp_nosome.mcap")

    rows = missing.values(EGO_SPEED)
    assert [t for _, t, *_ in rows] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert [speed for *_, speed, _ in rows] == pytest.approx([10.0] * 6)


def test_bugs_10_foxglove_deletion_timestamp(case: Callable[[str], Case], tmp_path: Path) -> None:
    deletion = case("bugs-10-foxglove-deletion-timestamp")
    config = tmp_path / "config.toml"
    config.write_text(f"mapping = {json.dumps(str(deletion.folder / 'olddel.toml'))}\n")
    deletion.ingest("olddel.mcap", options=("--config", str(config)))

    found = deletion.values("MATCH (v:Car) RETURN v.ident, frame.seq ORDER BY v.ident, frame.seq")
    # The text of the case leaves out frame 0, in which both are told.
    assert found == [("a", 0), ("a", 1), ("a", 2), ("a", 3), ("b", 0), ("b", 1)]


def test_bugs_11_integers_beyond_2_53(case: Callable[[str], Case], tmp_path: Path) -> None:
    odd = case("bugs-11-integers-beyond-2-53")
    run(["import", str(odd.store), str(odd.folder / "odd.jsonl"), "--as", "nodelink"])
    odd.capsys.readouterr()

    found = odd.values("MATCH (b:Car) WHERE b.n = 9007199254740993 RETURN frame.seq, b.n")
    assert [(seq, int(number)) for seq, number in found] == [(0, 9007199254740993)]


def test_bugs_12_attribute_changes_type(case: Callable[[str], Case]) -> None:
    types = case("bugs-12-attribute-changes-type")
    for name in ("ty3.jsonl", "ty2.jsonl"):
        run(["import", str(types.store), str(types.folder / name), "--as", "nodelink"])
    types.capsys.readouterr()

    assert types.values("MATCH (b:Vehicle) RETURN MAX(b.q) AS m") == [(50,)]
    ordered = "MATCH (b:Vehicle) WHERE trace.name = 'ty3' RETURN b.q ORDER BY b.q"
    assert [float(q) for (q,) in types.values(ordered)] == [5, 9, 50]


def test_bugs_13_osi_id_of_another_kind(case: Callable[[str], Case]) -> None:
    reuse = case("bugs-13-osi-id-of-another-kind")
    reuse.ingest("reuse.mcap")

    assert reuse.values("MATCH (p:Person) RETURN frame.seq") == [(2,), (3,)]
    kinds = reuse.values("MATCH (v {ident: '1'}) RETURN frame.seq, v.kind ORDER BY frame.seq")
    assert kinds == [(0, "car"), (1, "car"), (2, "person"), (3, "person")]


def test_bugs_14_bridge_ttc(case: Callable[[str], Case]) -> None:
    bridge = case("bugs-14-bridge-ttc")
    bridge.ingest("bridge.mcap")

    near = "MATCH (e:Ego),(v:Car) WHERE ttc(e, v) < 2 OR gap(e, v) < 30 RETURN frame.seq, v.ident"
    assert bridge.find(near) == []
    related = bridge.values("MATCH (e:Ego)-[r]->(v:Car) RETURN DISTINCT type(r)")
    assert {name for (name,) in related} & {"super_near", "sees", "overlaps", "near_coll"} == set()


def test_truth_01_negative_length(case: Callable[[str], Case], tmp_path: Path) -> None:
    negative = case("truth-01-negative-length")
    code, said = negative.ingest("gap_29s.osi", "negative_length.osi", "teleport.osi")

    assert "Traceback" not in said
    assert code in {0, 3}
    names = {name for (name,) in negative.values("MATCH (e:Ego) RETURN DISTINCT trace.name")}
    assert {"gap_29s", "teleport"} <= names
    assert all(length is None or length > 0 for _, _, length, *_ in negative.values(SIZES))
    assert "length" in said + negative.report()


@pytest.mark.parametrize("name", ["negative_width", "negative_height"])
def test_truth_02_negative_width_height(case: Callable[[str], Case], name: str) -> None:
    negative = case("truth-02-negative-width-height")
    negative.ingest(f"{name}.osi")

    sizes = [size for _, _, *row in negative.values(SIZES) for size in row]
    assert None in sizes
    assert all(size is None or size > 0 for size in sizes)
    assert name.removeprefix("negative_") in negative.report()


def test_truth_03_foxglove_negative_size(case: Callable[[str], Case]) -> None:
    negative = case("truth-03-foxglove-negative-size")
    code, said = negative.ingest("foxglove_negative_size.mcap")

    assert (code, "Traceback" in said) == (3, False)  # a loss
    sizes = [size for _, _, *row in negative.values(SIZES) for size in row]
    assert None in sizes
    assert all(size is None or size > 0 for size in sizes)


def test_truth_04_recording_gap(case: Callable[[str], Case]) -> None:
    gap = case("truth-04-recording-gap")
    _, said = gap.ingest("gap_29s.osi")

    rows = gap.values(EGO_SPEED)
    assert [speed for *_, speed, _ in rows] == pytest.approx([5.0] * 20, abs=1e-3)
    assert all(accel is None or abs(accel) < 0.05 for *_, accel in rows)
    assert "gap" in said + gap.report()


def test_truth_05_teleport(case: Callable[[str], Case]) -> None:
    teleport = case("truth-05-teleport")
    _, said = teleport.ingest("teleport.osi")

    rows = teleport.values("MATCH (v:Car) WHERE NOT v.is_ego RETURN v.speed, v.accel")
    assert all(speed is None or speed < 150 for speed, _ in rows)
    assert all(accel is None or abs(accel) < 30 for _, accel in rows)
    assert "teleport" in (said + teleport.report()).replace("teleport.osi", "")


def test_truth_06_id_comes_back_as_another_kind(case: Callable[[str], Case]) -> None:
    reuse = case("truth-06-id-comes-back-as-another-kind")
    reuse.ingest("id_reused_other_kind.osi")

    persons = reuse.values("MATCH (p:Person) RETURN frame.seq, p.ident")
    assert persons == [(seq, "7") for seq in range(8, 16)]
    cars = reuse.values("MATCH (v:Car) WHERE NOT v.is_ego RETURN frame.seq, v.ident")
    assert cars == [(seq, "7") for seq in range(5)]


def test_truth_07_own_trailer(case: Callable[[str], Case]) -> None:
    hitch = case("truth-07-own-trailer")
    hitch.ingest("own_trailer.osi")

    related = hitch.values("MATCH (a {ident: '1'})-[r]->(b {ident: '2'}) RETURN DISTINCT type(r)")
    related += hitch.values("MATCH (a {ident: '2'})-[r]->(b {ident: '1'}) RETURN DISTINCT type(r)")
    close = {
        "overlaps",
        "leads",
        "follows",
        "safety_hazard",
        "near_coll",
        "super_near",
        "very_near",
    }
    assert {name for (name,) in related} & (close | {"near", "visible"}) == set()
    assert ("tows",) in related


def test_truth_08_reversing_headway(case: Callable[[str], Case]) -> None:
    reverse = case("truth-08-reversing-headway")
    reverse.ingest("reversing_headway.osi")

    rows = reverse.values("MATCH (e:Ego), (v:Car {ident: '2'}) RETURN headway(e, v)")
    assert rows == [(None,)] * 20


def test_truth_09_autoware_tracked_objects(case: Callable[[str], Case]) -> None:
    guard = case("truth-09-autoware-tracked-objects")
    guard.ingest("ok_autoware_tracked.mcap")

    kinds = guard.values(
        "MATCH (v) WHERE v.speed >= 0 AND NOT v.is_ego RETURN DISTINCT v.ident, v.kind"
    )
    assert [kind for _, kind in sorted(kinds)] == [
        *("car", "truck", "bus", "trailer", "motorcycle", "bicycle", "person", "unknown"),
    ]
    query = (
        "MATCH (v) WHERE v.speed >= 0 AND NOT v.is_ego AND frame.seq = 5 RETURN v.ident, v.x, v.y"
    )
    rows = sorted(guard.values(query))
    assert rows[0][1:] == pytest.approx((101.0, 50.0), abs=1e-3)
    assert rows[1][1:] == pytest.approx((109.433, 50.4433), abs=1e-3)


TRAVELS = "MATCH (a:Lane)-[:travelsTo]->(b:Lane) RETURN DISTINCT a.name, b.name"


@pytest.mark.parametrize(
    ("folder", "name", "line"),
    [
        ("bugs-16-lane-links-in-junction-only", "j_nolinks", ""),
        ("bugs-17-signal-beyond-its-road", "sig_long", "<signal> 's1': its s = 250 m is beyond"),
        ("bugs-18-negative-lane-width", "negw", "lane 1/0/-2: its width is negative (-3 m)"),
        (
            "bugs-19-road-length-contradicts",
            "len_short",
            "length is 60 m, but its planView has 100 m",
        ),
    ],
)
def test_bugs_16_to_19_maps(case: Callable[[str], Case], folder: str, name: str, line: str) -> None:
    odd = case(folder)
    _, reported = odd.ingest(f"{name}.mcap", options=("--map", str(odd.folder / f"{name}.xodr")))
    run(["map", str(odd.folder / f"{name}.xodr"), "--json"])
    listed = odd.capsys.readouterr().out

    assert line in reported
    assert line in listed
    if name == "j_nolinks":
        assert odd.values(TRAVELS) == [("1/0/-1", "3/0/-1"), ("3/0/-1", "2/0/-1")]
    if name == "negw":
        offsets = odd.values("MATCH (v:Car)-[r:isIn]->(l) RETURN l.name, r.offset")
        assert [name for name, _ in offsets] == ["1/0/-3"] * 2
        assert [offset for _, offset in offsets] == pytest.approx([0.75, 0.25], abs=1e-3)


def test_bugs_15_lane_link_told_one_way(case: Callable[[str], Case]) -> None:
    one_way = case("bugs-15-lane-link-told-one-way")
    one_way.ingest("ow01.mcap", options=("--map", str(one_way.folder / "ow01.xodr")))

    assert sorted(one_way.values(TRAVELS)) == [("1/0/-1", "2/0/-1"), ("2/0/1", "1/0/1")]
