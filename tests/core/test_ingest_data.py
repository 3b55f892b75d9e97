"""Real recordings of many producers into one store."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from mcap.reader import make_reader
from thorough import LONG

from sgstore.ingest import ingest
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.pipeline.recording_ingest import TraceOutcome

pytestmark = [pytest.mark.data, pytest.mark.seconds(11)]

FLAVOURS = ("osi_converter", "omega_prime", "esmini", "sumo", "carla")
TWINS = () if LONG else ("Town01_asrecorded.carla", "MovingHostWithStopLine", "cut-in")
"""Recordings that the same program wrote in the same way as another one that is tried."""


@pytest.fixture(scope="module")
def ingested(data, tmp_path_factory) -> Iterator[tuple[StoreFile, list[TraceOutcome]]]:
    paths = [
        path
        for flavour in FLAVOURS
        for path in sorted((data / "traces" / flavour).glob("*.mcap"))
        if path.stem not in TWINS
    ]
    place = tmp_path_factory.mktemp("data") / "s.db"
    outcomes = ingest(place, paths)
    store = StoreFile(place)
    with store.snapshot():
        yield store, outcomes


def said(path: Path, topic: str) -> dict[int, bytes]:
    """Messages of a channel by log time, as the official reader reads them."""
    with path.open("rb") as stream:
        return {m.log_time: m.data for _, _, m in make_reader(stream).iter_messages(topics=[topic])}


def test_everything_comes_in_without_a_loss(ingested) -> None:
    _, outcomes = ingested

    assert len(outcomes) + len(TWINS) == 13
    assert {o.path.stem: (o.status, o.losses, o.error) for o in outcomes} == {
        o.path.stem: ("added", [], None) for o in outcomes
    }


def test_each_message_of_the_leading_channel_is_a_frame_and_is_read_back(ingested) -> None:
    store, _ = ingested
    for trace in store.traces():
        (leading,) = (c.topic for c in store.channels(trace.trace_id) if c.role == "ground_truth")
        messages = said(trace.path, leading)
        sql = "SELECT frame_id, log_time_ns FROM frames WHERE trace_id = ? ORDER BY seq"
        frames = store.rows(sql, [trace.trace_id]).values

        assert [time for _, time in frames] == sorted(messages)
        for frame, time in frames[:: max(len(frames) // 5, 1)]:
            assert store.payload(frame, leading) == messages[time]


def test_lights_change_their_state(ingested) -> None:
    store, _ = ingested
    sql = """
      SELECT n.name, count(DISTINCT n.light_state) FROM nodes n JOIN frames USING (frame_id)
      WHERE n.trace = 'traffic_lights' AND n.kind = 'traffic_light' AND NOT n.is_static GROUP BY n.name
    """

    assert max(states for _, states in store.rows(sql)) > 1


def test_vehicles_of_the_swarm_drive_on_driving_lanes(ingested) -> None:
    store, _ = ingested
    vehicles = "n.kind IN ('car', 'truck', 'van', 'bus', 'motorcycle', 'trailer')"
    sql = f"""
      WITH swarm AS (
        SELECT n.frame_id, n.node_id, f.map FROM nodes n JOIN frames f USING (frame_id)
        WHERE f.trace = 'swarm_Town04' AND NOT n.is_static AND {vehicles})
      SELECT count(DISTINCT (s.frame_id, s.node_id)) FILTER (l.lane_type = 'driving'),
             count(DISTINCT (s.frame_id, s.node_id))
      FROM swarm s LEFT JOIN edges e ON e.frame_id = s.frame_id AND e.src = s.node_id AND e.relation = 'isIn'
           LEFT JOIN lanes l ON l.map = s.map AND l.node_id = e.dst
    """

    ((on_lanes, samples),) = store.rows(sql).values

    assert on_lanes / samples >= 0.97


def test_graphs_are_what_the_views_show(ingested) -> None:
    store, _ = ingested
    for trace in store.traces():
        for seq in (0, trace.frames // 2, trace.frames - 1):
            graph = store.graph(f"{trace.name}#{seq}")
            edges = store.rows(
                "SELECT src, relation, dst FROM edges WHERE frame_id = ?", [graph.frame_id]
            )
            nodes = store.rows("SELECT node_id FROM nodes WHERE frame_id = ?", [graph.frame_id])

            assert Counter((s, r, d) for s, r, d, _ in graph.edges) == Counter(edges)
            assert Counter((node,) for node in graph.nodes) == Counter(nodes)
            assert {end for s, _, d, _ in graph.edges for end in (s, d)} <= graph.nodes.keys()


DAMAGED = {
    "clock_jump": (200, False),
    "cut_mid_chunk": (99, True),
    "flipped_chunk": (167, True),
    "flipped_chunk_nocrc": (167, True),
    "flipped_silent_nocrc": (200, False),
    "nan_poses": (200, True),
    "no_footer": (200, False),
    "unknown_channel": (200, False),
    "zstd_bomb": (6, True),
    "zstd_bomb_fcs": (6, True),
}
"""What the folder's README says can be saved of each file, in frames, and whether something is lost."""
SEEN = DAMAGED if LONG else ("clock_jump", "flipped_chunk", "nan_poses", "zstd_bomb_fcs")
"""Those that come into one store; each of them has one of its own in ``test_damaged.py``."""

INGEST = """
import json, re, sys
from pathlib import Path
from sgstore.ingest import ingest
outcomes = ingest(sys.argv[1], sys.argv[2:])
peak = re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]
print(json.dumps({"peak": int(peak), "outcomes": [outcome.as_dict() for outcome in outcomes]}))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peaks are told by Linux")
def test_all_that_can_be_had_of_damaged_recordings_comes_in_and_the_rest_is_named(
    data, tmp_path
) -> None:
    folder = data / "traces" / "carla" / "damaged"
    paths = [folder / f"{name}.mcap" for name in SEEN]

    run = subprocess.run(
        [sys.executable, "-c", INGEST, tmp_path / "s.db", *paths],
        capture_output=True,
        text=True,
        check=True,
    )

    told = json.loads(run.stdout)
    assert [Path(one["path"]).stem for one in told["outcomes"]] == [*SEEN]
    assert told["peak"] < 512_000
    store = StoreFile(tmp_path / "s.db")
    reports = {trace.path.stem: trace.report for trace in store.traces()}
    for outcome in told["outcomes"]:
        name = Path(outcome["path"]).stem
        frames, lossy = DAMAGED[name]
        assert outcome["status"] == "added", outcome["error"]
        assert outcome["frames"] >= frames, name
        assert bool(outcome["losses"]) == lossy, name
        assert all(loss["reason"] for loss in outcome["losses"])
        assert reports[name]["losses"] == outcome["losses"]
    assert reports["clock_jump"]["clock_jumps"] == 5  # it is read in order of its log times
    assert reports["flipped_chunk"]["gaps"] == 1
    assert store.verify(recordings=True).faults == []
