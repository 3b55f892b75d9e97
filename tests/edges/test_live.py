"""A monitor as a page: what it is sent is what a store has of the recording, frame by frame."""

from __future__ import annotations

import asyncio
import base64
import gc
import json
import socket
import time
from itertools import islice
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("starlette", reason="the extra [ui] is not installed")

pytest.importorskip("httpx")

import httpx
import numpy as np
from columns_read import unpacked

from sgstore.apps.demo import RECORDING
from sgstore.apps.explorer import LiveRun, live_application, serve_live
from sgstore.errors import QueryNameError, StoreError
from sgstore.graphs.online import Frame
from sgstore.model.config import Config
from sgstore.store import StateColumns
from sgstore.temporal import Monitor, MonitorEvent, opened, paced

if TYPE_CHECKING:
    from sgstore.query import Store

FRAMES = 60
NEAR = "MATCH (e:Ego)-[:near]->(v:Vehicle) WHERE v.speed > 1 AND e.speed < 20"
CHECK = "CHECK calm: FORALL (v:Vehicle) ALWAYS v.speed < 4"


async def told(run: LiveRun) -> list[tuple[str, Any]]:
    """Events that a page is sent, up to the end of the run."""
    found: list[tuple[str, Any]] = []
    async for part in run.messages():
        for message in part.decode().split("\n\n")[:-1]:
            event, data = message.split("\n")
            name, data = event.removeprefix("event: "), data.removeprefix("data: ")
            is_frame = name == "frame"
            found.append((name, unpacked(base64.b64decode(data)) if is_frame else json.loads(data)))
        if found[-1][0] == "end":
            return found
    raise AssertionError("it ended without its end")


@pytest.fixture(scope="module")
def watched() -> tuple[LiveRun, list[MonitorEvent], list[tuple[str, Any]]]:
    events: list[MonitorEvent] = []
    with opened(str(RECORDING), Config()) as source:
        run = LiveRun("town", source.road_map, source.cameras)

        def tell(event: MonitorEvent) -> None:
            events.append(event)
            run.event(event)

        monitor = Monitor(
            f"{CHECK};{NEAR}", source.road_map, Config(), on_event=tell, on_step=run.step
        )
        run.follow(monitor)
        run.end(monitor.run(islice(source.frames, FRAMES)))
    return run, events, asyncio.run(told(run))


def test_frames_are_those_of_a_store(watched: Any, open_town: Store) -> None:
    (_, hello), *frames, _ = watched[2]
    sql = (
        "SELECT n.node_id, n.kind, n.x, n.y, n.speed FROM nodes n JOIN frames f USING (frame_id)"
        " WHERE NOT n.is_static AND n.node_id >= 0 AND f.seq = $seq ORDER BY n.node_id"
    )
    kinds = hello["about"]["codes"]["kind"]
    times = open_town.sql("SELECT t FROM frames ORDER BY frame_id").values
    assert [header["seq"] for _, (header, _) in frames] == list(range(FRAMES))
    for _, (header, columns) in frames[::20]:
        rows = open_town.sql(sql.replace("$seq", str(header["seq"]))).values
        assert columns["node"].tolist() == [row[0] for row in rows]
        assert [kinds[code] for code in columns["kind"]] == [row[1] for row in rows]
        assert header["t"] == times[header["seq"]][0]
        places = np.stack([columns["x"], columns["y"]], 1) + header["origin"]
        assert np.allclose(places, [row[2:4] for row in rows], rtol=0, atol=1e-9)
        speeds = np.array([row[4] for row in rows], float)
        assert np.allclose(columns["speed"], speeds, atol=1e-3, equal_nan=True)
        assert columns["node"][columns["ego"] == 1].tolist() == [header["ego"]]


def test_events_come_with_their_frames(watched: Any) -> None:
    _, events, ((_, hello), *frames, (_, end)) = watched
    sent = [event for _, (header, _) in frames for event in header["events"]] + end["events"]

    assert hello["about"]["checks"] == ["calm"]
    assert hello["about"]["patterns"] == ["pattern"]
    assert len(events) > 3
    assert [(e.kind, e.name, e.start.seq, dict(e.nodes)) for e in events] == [
        (e["kind"], e["name"], e["first"], e["nodes"]) for e in sent
    ]
    assert end["verdicts"][0][:2] == ["calm", "false"]
    assert frames[-1][1][0]["status"] == {"calm": "false"}


def test_lanes_of_truth_are_those_of_a_store(watched: Any, open_town: Store) -> None:
    run, events, _ = watched
    found = [event for event in events if event.kind == "found"]
    assert len(found) == 3
    for event in found:
        lanes = run.parts("pattern", event.nodes)
        assert lanes["known"] == [0, FRAMES - 1]
        parts = open_town.parts(NEAR, f"town#{event.start.seq}", event.nodes).lanes
        assert [lane["text"] for lane in lanes["lanes"]] == [one.part.text for one in parts]
        for lane, one in zip(lanes["lanes"], parts, strict=True):
            seqs = {seq for a, z in lane["spans"] for seq in range(a, z + 1)}
            kept = range(FRAMES)
            assert seqs == {seq for a, z in one.spans for seq in range(a, z + 1) if seq in kept}


def test_graphs_and_why_not_are_those_of_a_store(watched: Any, open_town: Store) -> None:
    run, events, _ = watched
    found = next(event for event in events if event.kind == "found")
    for seq in (found.start.seq, FRAMES - 1):
        graph, of = run.frame(seq), open_town.graph(f"town#{seq}")
        assert {node["id"]: node["kind"] for node in graph["nodes"] if node["id"] >= 0} == {
            node: about["kind"] for node, about in of.nodes(data=True) if node >= 0
        }
        joined = {(edge["src"], edge["dst"], edge["relation"]) for edge in graph["edges"]}
        assert joined == {(src, dst, relation) for src, dst, relation in of.edges(keys=True)}
        why = open_town.why_not(f"town#{seq}", NEAR).as_dict()
        assert run.why("pattern", seq)["failed"] == why["failed"]
    with pytest.raises(StoreError, match="not kept; those from #0 on are"):
        run.frame(FRAMES)


def test_values_of_conditions_are_those_of_a_store(watched: Any, open_town: Store) -> None:
    run, events, _ = watched
    nodes = next(event for event in events if event.kind == "found").nodes
    for seq in (0, FRAMES // 2, FRAMES - 1):
        values = run.values("pattern", seq, nodes)["values"]
        of_store = open_town.condition_values(NEAR, f"town#{seq}", nodes)
        assert [lane["text"] for lane in run.parts("pattern", nodes)["lanes"]][1:] == [
            "v.speed > 1",
            "e.speed < 20",
        ]
        for lane, of in zip(values, of_store, strict=True):
            for condition, stored in zip(lane, of, strict=True):
                assert [(one["name"], one["unit"]) for one in condition] == [
                    (one.name, one.unit) for one in stored
                ]
                assert [one["value"] for one in condition] == pytest.approx(
                    [one.value for one in stored], abs=1e-3
                )
    assert values[1][0][0]["name"] == "v.speed"
    with pytest.raises(StoreError, match="not kept; those from #0 on are"):
        run.values("pattern", FRAMES, nodes)
    with pytest.raises(QueryNameError, match="no pattern 'other'"):
        run.values("other", 0, nodes)


def test_curves_are_those_of_a_store(watched: Any, open_town: Store) -> None:
    run, events, _ = watched
    nodes = next(event for event in events if event.kind == "found").nodes
    e, v = nodes["e"], nodes["v"]
    (trace,) = open_town.traces()
    asked = [(name, v, None) for name in ("speed", "heading", "accel", "steer")]
    asked += [
        (name, e, v) for name in ("distance", "gap", "ttc", "headway", "bearing", "closing_speed")
    ]
    for attribute, node, other in asked:
        _, mine = unpacked(run.series(attribute, node, other))
        of = StateColumns(open_town.file).series(trace.trace_id, attribute, node, other)
        known = dict(zip(of["seq"].tolist(), zip(of["t"], of["value"], strict=True), strict=True))
        curve = dict(
            zip(mine["seq"].tolist(), zip(mine["t"], mine["value"], strict=True), strict=True)
        )
        kept = {seq: told for seq, told in known.items() if seq < FRAMES}
        assert len(kept) > 10
        assert (
            other is not None or curve.keys() == kept.keys()
        )  # the view of pairs has near ones alone
        for seq, told in kept.items():
            assert curve[seq] == pytest.approx(told, abs=1e-5, nan_ok=True)
    with pytest.raises(StoreError, match="no number 'wings' of a node; there are x, y"):
        run.series("wings", v)


def test_pictures_are_those_of_a_store(watched: Any, open_town: Store) -> None:
    run = watched[0]
    (topic,) = run.about()["traces"][0]["cameras"]
    for seq in (0, 31, FRAMES - 1):
        assert run.picture(seq, topic)[0] == open_town.file.carried(f"town#{seq}", topic).data
    assert run.picture(100_000, topic)[0] == b""
    with pytest.raises(StoreError, match="no camera 'other'"):
        run.picture(0, "other")


def test_a_part_over_time_is_not_known(open_town: Store) -> None:
    text = "MATCH (v:Vehicle) WHERE v.speed > 1 AND run_length(v.speed > 1) >= 0.1s"
    run = LiveRun("x", None)
    events: list[MonitorEvent] = []
    monitor = Monitor(text, on_event=events.append, on_step=run.step)
    run.follow(monitor)
    for i in range(5):
        monitor.step(moving(i, 3.0))
    lanes = run.parts("pattern", events[0].nodes)["lanes"]

    assert [bool(lane["unknown"]) for lane in lanes] == [False, True]
    assert lanes[0]["spans"] == ((0, 4),)
    with pytest.raises(QueryNameError, match="no pattern 'other'"):
        run.parts("other", {})


def moving(i: int, speed: float) -> Frame:
    frame = Frame(i * 100_000_000, "e")
    frame.add("e", "car", 0.0, 0.0, heading=0.0, length=4.0, width=2.0, vx=0.0, vy=0.0)
    frame.add("v", "car", 9.0 + i, 0.0, heading=0.0, length=4.0, width=2.0, vx=speed, vy=0.0)
    return frame


def test_a_page_with_all_its_curves_keeps_their_history(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two pages follow a match and eight curves each; they ask for all of them again and again."""
    import sgstore.temporal._followed as followed

    monkeypatch.setattr(followed, "MOST_EDGES", 12)  # of the first frames only the curves know
    run = LiveRun("x", None)
    monitor = Monitor("MATCH (v:Vehicle) WHERE v.speed > 1", on_event=run.event, on_step=run.step)
    run.follow(monitor)
    names = ("x", "y", "z", "vx", "vy", "speed", "length", "width")
    for i in range(40):
        monitor.step(moving(i, 3.0))
        curves = [
            len(unpacked(run.series(name, node))[1]["seq"]) for node in (0, 1) for name in names
        ]
        for node in (0, 1):
            run.parts("pattern", {"v": node})
        assert curves == [i + 1] * 16


def test_messages_end_with_the_server() -> None:
    async def end() -> int:
        run = LiveRun("x", None)
        run.stop()
        return len([one async for one in run.messages()])

    assert asyncio.run(asyncio.wait_for(end(), 300)) == 1


def test_an_answer_does_not_wait_for_the_one_before_it() -> None:
    """Small packets that are held back until others are confirmed take 40 ms each."""
    addresses = list[str]()
    with serve_live(LiveRun("x", None), on_start=addresses.append), httpx.Client() as client:
        client.get(addresses[0])
        port = httpx.URL(addresses[0]).port
        sockets = [one for one in gc.get_objects() if isinstance(one, socket.socket)]
        served = [
            one.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            for one in sockets
            if one.fileno() >= 0
            and one.family == socket.AF_INET
            and one.getsockname()[1] == port
            and not one.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
        ]

    assert len(served) == 1
    assert served[0]


def test_what_is_kept_does_not_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    import sgstore.apps.explorer._live as live
    import sgstore.temporal._followed as followed

    monkeypatch.setattr(live, "MOST_FRAMES", 10)
    monkeypatch.setattr(followed, "MOST_EDGES", 12)
    run = LiveRun("x", None)
    monitor = Monitor("MATCH (v:Vehicle) WHERE v.speed > 1", on_event=run.event, on_step=run.step)
    run.follow(monitor)
    for i in range(40):
        monitor.step(moving(i % 3, 3.0) if i % 3 else moving(0, 3.0))
    run.end(monitor.finish())
    sent = asyncio.run(told(run))

    assert [name for name, _ in sent] == ["hello", *["frame"] * 9, "end"]
    assert sent[1][1][0]["seq"] == 31
    ((first, last),) = run.parts("pattern", {"v": 1})["lanes"][0]["spans"]
    assert 30 < first < last == 39  # the graphs before are let go


def test_a_recording_comes_in_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now, slept = 1000.0, list[float]()

    def sleep(seconds: float) -> None:
        nonlocal now
        now += seconds
        slept.append(seconds)

    monkeypatch.setattr(time, "monotonic", lambda: now)
    monkeypatch.setattr(time, "sleep", sleep)
    assert len(list(paced(moving(i, 1.0) for i in range(4)))) == 4
    assert slept == pytest.approx([0.1] * 3)


def test_the_page_is_behind_its_token_and_knows_the_map(watched: Any) -> None:
    run = watched[0]
    app = live_application(run, "secret", ("127.0.0.1:1",), "sgstore-1")

    async def all_of() -> list[httpx.Response]:
        transport = httpx.ASGITransport(app=app)
        headers = {"cookie": "sgstore-1=secret"}
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:1") as client:
            return [
                await client.get("/api/store"),
                await client.get("/", headers=headers),
                await client.get("/static/js/live.js", headers=headers),
                await client.get("/api/map", headers=headers),
                await client.post("/api/parts", headers=headers, json={"text": "no"}),
                await client.get("/api/states", headers=headers),
            ]

    found = asyncio.run(all_of())
    assert [one.status_code for one in found] == [403, 200, 200, 200, 422, 404]
    assert 'src="static/js/live.js"' in found[1].text
    assert len(unpacked(found[3].content)[1]["start"]) > 20
