"""Values of topics at frames by three rules, in find, check and a monitor, against a plain definition."""

from __future__ import annotations

import json
import math
import random
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any

import pytest
from recordings import Recorder, car

import sgstore
from sgstore.collection import Collection, pack
from sgstore.lang.help import words
from sgstore.model.config import from_dict
from sgstore.temporal import Monitor, opened

if TYPE_CHECKING:
    from pathlib import Path

SCHEMA = json.dumps(
    {
        "type": "object",
        "properties": {
            "z": {"type": "number"},
            "state": {"type": "string"},
            "ok": {"type": "boolean"},
            "inner": {"type": "object", "properties": {"odd-name": {"type": "number"}}},
            "values": {"type": "array", "items": {"type": "number"}},
            "header": {
                "type": "object",
                "properties": {
                    "stamp": {
                        "type": "object",
                        "properties": {"sec": {"type": "integer"}, "nanosec": {"type": "integer"}},
                    }
                },
            },
        },
    }
).encode()

Message = tuple[int, dict[str, Any]]
"""Log time in milliseconds, and content."""


def wanted(
    messages: list[Message], frames: list[tuple[int, int]], rule: str, tolerance: float
) -> list[float | None]:
    """The definition: the value of ``z`` at each frame (log time, simulation time); ms.

    Messages with stamps are compared by simulation time, otherwise by log time.
    """
    runs = [*accumulate(b[1] < a[1] for a, b in pairwise([frames[0], *frames]))]
    starts = {run: frames[runs.index(run)][0] for run in runs}
    found: list[float | None] = []
    for (log, sim), run in zip(frames, runs, strict=True):
        ends = starts.get(run + 1, float("inf"))
        now = sim if "header" in messages[0][1] else log
        of_run = [
            (stamped(m) if "header" in m else t, m.get("z"))
            for t, m in messages
            if (t >= starts[run] or not run) and t < ends
        ]
        one_each = sorted(dict(of_run).items())  # of equal times the last one counts
        before = [(now - t, z) for t, z in one_each if t <= now and now - t <= tolerance]
        after = [(t - now, z) for t, z in one_each if t >= now and t - now <= tolerance]
        low, high = (before or [None])[-1], (after or [None])[0]
        if rule == "last" or (rule == "nearest" and (low is None or high is None)):
            one = low or (high if rule == "nearest" else None)
            found.append(one and one[1])
        elif rule == "nearest":
            found.append(low[1] if low[0] <= high[0] else high[1])
        elif low is None or high is None or low[1] is None or high[1] is None:
            found.append(None)
        else:
            share = low[0] / (low[0] + high[0]) if low[0] else 0.0
            found.append(low[1] + (high[1] - low[1]) * share)
    return found


def stamped(message: dict[str, Any]) -> int:
    stamp = message["header"]["stamp"]
    return stamp["sec"] * 1000 + stamp["nanosec"] // 10**6


def recorded(
    path: Path, seed: int, *, stamps: bool = False
) -> tuple[list[Message], list[tuple[int, int]]]:
    """Write a drive with messages at random times: equal times, gaps, missing fields, a clock that jumps."""
    rng = random.Random(seed)
    log, stamp, frames = 1000, 0, list[tuple[int, int]]()
    for _ in range(40):
        log += rng.choice((50, 100, 100, 150, 400))
        # A stamp of 0 without stamps near 0 after it counts as missing.
        stamp = 0 if rng.random() < 0.04 and len(frames) < 38 else stamp + 100
        frames.append((log, stamp))
    times = sorted(
        rng.choice((rng.randrange(900, log + 200), rng.choice(frames)[0])) for _ in range(60)
    )
    times = [t for t in times if not 1800 < t < 2600]
    messages = [(t, content(rng)) for t in times]
    if stamps:
        messages = [(t + rng.randrange(3), with_header(m, rng, t, frames)) for t, m in messages]
        messages.sort(key=lambda one: one[0])
    with Recorder(path) as recorder:
        written = [(t, 1, m) for t, m in messages] + [(t, 0, s) for t, s in frames]
        for t, kind, what in sorted(written, key=lambda one: one[:2]):
            if kind:
                channel = recorder.channel("/imu", "Imu", SCHEMA)
                recorder.write(channel, t / 1000, json.dumps(what).encode())
            else:
                ego, other = car(1, x=t / 100, v=(10, 0)), car(2, x=t / 100 + t % 61)
                recorder.ground_truth(t / 1000, [ego, other], host=1, stamp=what / 1000)
    return messages, frames


def with_header(
    message: dict[str, Any], rng: random.Random, log: int, frames: list[tuple[int, int]]
) -> dict[str, Any]:
    """Add a header: often the exact time of the frame before the message, else a time near it."""
    _, sim = max([frame for frame in frames if frame[0] <= log] or [frames[0]])
    sim = max(sim + rng.choice((0, 0, 0, -120, -7, 5)), 1)
    return message | {"header": {"stamp": {"sec": sim // 1000, "nanosec": sim % 1000 * 10**6}}}


def content(rng: random.Random) -> dict[str, Any]:
    z = {} if rng.random() < 0.1 else {"z": round(rng.uniform(-5, 5), 3)}
    state, values = rng.choice(("GO", "STOP")), [rng.randrange(9) for _ in range(3)]
    inner = {"odd-name": rng.randrange(5)}
    return {**z, "state": state, "ok": rng.random() < 0.5, "inner": inner, "values": values}


RULES = [
    *(("last", 1000), ("last", 120), ("last", None), ("nearest", 60), ("nearest", 1000)),
    *(("linear", 200), ("linear", None)),
]


@pytest.mark.parametrize(("seed", "stamps"), [(0, False), (1, False), (0, True), (1, True)])
def test_values_are_those_of_the_definition(tmp_path: Path, seed: int, stamps: bool) -> None:
    """In find, check and the monitor, from a store with and without the topic as columns."""
    path = tmp_path / "drive.mcap"
    messages, frames = recorded(path, seed, stamps=stamps)
    store = sgstore.open(tmp_path / "s.sgstore", create=True)
    store.ingest(path, config=from_dict({"topics": ["/imu"]} if seed % 2 else {}))
    topics = [
        f"topic('/imu', {rule}, {'INF' if tolerance is None else f'{tolerance}ms'}).z"
        for rule, tolerance in RULES
    ]
    expected = [wanted(messages, frames, rule, tolerance or math.inf) for rule, tolerance in RULES]
    with store.file.snapshot():
        rows = store.find(f"MATCH (e:Ego) RETURN frame.seq, {', '.join(topics)} ORDER BY frame.seq")
        for number, column in enumerate(expected):
            found = [row[number + 1] for row in rows.rows()]
            assert found == pytest.approx(column), RULES[number]
        patterns = [f"MATCH (e:Ego) WHERE {topic} > 1" for topic in topics]
        found = [[one.start_seq for one in store.find(text).intervals()] for text in patterns]
        checks = "; ".join(
            f"CHECK low{n}: ALWAYS {topic} < 4; CHECK known{n}: ALWAYS {topic} < 99"
            for n, topic in enumerate(topics)
        )
        verdicts = {one.check: one.verdict for one in store.check(checks)}
    for number, column in enumerate(expected):
        known = [z for z in column if z is not None]
        rest = "unknown" if None in column else "true"
        assert verdicts[f"known{number}"] == rest
        assert verdicts[f"low{number}"] == ("false" if any(z >= 4 for z in known) else rest)
    seen = {f"pattern {number + 1}": list[int]() for number in range(len(patterns))}
    with opened(str(path), sgstore.Config()) as source:
        text = "; ".join([checks, *patterns])
        monitor = Monitor(text, source.road_map, topics=source.topics, trace=source.name)
        for frame in source.frames:
            for event in monitor.step(frame):
                if event.kind == "found":
                    seen[event.name].append(event.start.seq)
        assert {one.check: one.verdict for one in monitor.finish()} == verdicts
    assert [*seen.values()] == found


WORDS = b'{"words": ["a", "b"]}'


def drive(path: Path, *, planner: bool = True, z: float = 0.0, words: bytes = b"") -> Path:
    """A drive of 2 s. The planner says STOP from 1 s on, every 0.3 s; its ``z`` rises by 1 each time."""
    with Recorder(path) as recorder:
        for i in range(20):
            if planner and i % 3 == 0:
                content = {"state": "STOP" if i >= 10 else "GO", "z": z + i // 3, "values": [i, 7]}
                channel = recorder.channel("/planner", "Planner", SCHEMA)
                recorder.write(channel, i / 10, json.dumps(content).encode())
            if words:
                recorder.channel("/empty", "Empty", b"")
                channel = recorder.channel("/words", "Words", b"")
                recorder.write(channel, i / 10, words)
            cars = [car(1, x=i, v=(10, 0)), car(2, x=70 - i, v=(-10, 0))]
            recorder.ground_truth(i / 10, cars, host=1)
    return path


def test_topics_are_values_in_every_clause(tmp_path: Path) -> None:
    """A trace without the topic is left out with the reason; later recordings are seen."""
    store = sgstore.open(tmp_path / "s.sgstore", create=True)
    store.ingest([drive(tmp_path / "a.mcap"), drive(tmp_path / "b.mcap", planner=False)])
    stop, z = "topic('/planner').state = 'STOP'", "topic('/planner').z"
    with store.file.snapshot():
        found = store.find(f"MATCH (e:Ego), (v:Vehicle) WHERE {stop} AND gap(e, v) > 30")
        assert [row.seq for row in found.rows()] == [12, 13, 14, 15, 16, 17]
        assert found.reasons == {"b": "trace b has no topic /planner"}
        for text, expected in {
            f"WHERE {z} > 5 RETURN MAX({z}) AS z, COUNT(*) AS n": [(6, 2)],
            f"WHERE {stop} RETURN frame.seq AS s ORDER BY {z} DESC, s LIMIT 2": [(18,), (19,)],
            f"WHERE delta({z}, 0.1s) = 1 AND prev({z}) = 5 RETURN min_over({z}, 0.5s)": [(4,)],
            f"WITH e, {z} AS z WHERE z = 6 OPTIONAL MATCH (v:Person) RETURN z, v.name": [
                *(((6, None),) * 2)
            ],
            f"WHERE EXISTS {{(v:Car) WHERE v.x = {z} + 54}} RETURN frame.seq": [(12,)],
            f"WHERE NOT {stop} THEN IMMEDIATELY MATCH (e) WHERE {stop} AS s RETURN t(s)": [(1.2,)],
            f"WHERE ({stop}) AND HISTORICALLY[0s, 0.3s] {stop} RETURN MIN(frame.seq)": [(15,)],
            "WHERE topic('/planner').values[0] + topic('/planner').values[1] = 7 RETURN frame.seq": [
                *((n,) for n in range(3))
            ],
        }.items():
            rows = store.find(f"MATCH (e:Ego) {text}").rows()
            assert [tuple(row) for row in rows] == expected, text
        checks = f"CHECK most: ALWAYS {z} < 5 ROBUSTNESS; CHECK stops: EVENTUALLY {stop}"
        verdicts = {(one.check, one.trace): one for one in store.check(checks)}
        assert verdicts["most", "a"].robustness.value == -1
        assert verdicts["stops", "a"].verdict == "true"
        assert verdicts["stops", "b"].reason == "trace b has no topic /planner"
        why = store.why_not("a#3", f"MATCH (e:Ego) WHERE {stop}")
        assert (why.failed, why.found) == (stop, "topic('/planner').state = 'GO'")
        why = store.why_not("b#3", f"MATCH (e:Ego) WHERE {stop}")
        assert why.found == "trace b has no topic /planner"
        assert "state" in {one["name"] for one in words(store.catalog())["topics"]["/planner"]}
    store.ingest(drive(tmp_path / "c.mcap", z=10))
    counts = store.find(
        f"MATCH (e:Ego) WHERE {z} > 5 RETURN COUNT(*) AS n, trace.name AS t ORDER BY t"
    )
    assert [tuple(row) for row in counts.rows()] == [(2, "a"), (20, "c")]


def test_a_replay_has_the_verdicts_of_the_store(tmp_path: Path) -> None:
    """Of an element of a list of texts, and of a topic without messages."""
    path = drive(tmp_path / "d.mcap", words=WORDS)
    store = sgstore.open(tmp_path / "s.sgstore", create=True)
    store.ingest(path)
    text = (
        "CHECK words: ALWAYS topic('/words', INF).words[1] = 'b';"
        " CHECK none: ALWAYS topic('/empty').z > 1"
    )
    verdicts = {one.check: one.verdict for one in store.check(text)}
    assert verdicts == {"words": "true", "none": "unknown"}
    with opened(str(path), sgstore.Config()) as source:
        monitor = Monitor(text, source.road_map, topics=source.topics, trace=source.name)
        for frame in source.frames:
            monitor.step(frame)
        assert {one.check: one.verdict for one in monitor.finish()} == verdicts


def test_a_collection_has_topics_of_some_stores(tmp_path: Path) -> None:
    names = {"one": True, "two": False}
    for name, planner in names.items():
        store = sgstore.open(tmp_path / f"{name}.sgstore", create=True)
        store.ingest(drive(tmp_path / f"{name}.mcap", planner=planner))
        pack(tmp_path / f"{name}.sgstore", tmp_path / "fleet")
    with Collection(tmp_path / "fleet") as fleet:
        rows = fleet.find(
            "MATCH (e:Ego) RETURN topic('/planner').z AS z, frame.seq AS s ORDER BY z DESC, s LIMIT 2"
        )
        assert [tuple(row) for row in rows.rows()] == [(6, 18), (6, 19)]
        verdicts = fleet.check("CHECK few: ALWAYS topic('/planner').z < 9")
        assert {one.trace: one.verdict for one in verdicts} == {"one": "true", "two": "unknown"}
        with pytest.raises(sgstore.QueryError, match="no topic '/planer'"):
            fleet.find("MATCH (e:Ego) WHERE topic('/planer').z > 1").rows()
        listed = fleet.sql("SELECT trace, max(z) FROM topic('/planner') GROUP BY 1", each=True)
        assert [row[1:] for row in listed] == [("one", 6)]
        assert listed.columns == ("bundle", "trace", "max(z)")
        assert listed.reasons == {"two": "no topic '/planner'"}
        with pytest.raises(sgstore.SgstoreError, match="no topic '/planer'; did you mean"):
            list(fleet.sql("SELECT z FROM topic('/planer')", each=True))
        with pytest.raises(sgstore.SgstoreError, match="topic '/planner' has no field 'zz'"):
            fleet.find("MATCH (e:Ego) WHERE topic('/planner').zz > 1").rows()


def test_a_stored_field_of_some_parts_of_a_collection_is_unknown_in_the_others(
    tmp_path: Path,
) -> None:
    for name, told in (("one", WORDS), ("two", b'{"words": ["a"], "only": 4}')):
        store = sgstore.open(tmp_path / f"{name}.sgstore", create=True)
        store.ingest(drive(tmp_path / f"{name}.mcap", words=told), topics=("/words",))
        pack(tmp_path / f"{name}.sgstore", tmp_path / "fleet")
    text = "MATCH (e:Ego) WHERE topic('/words').only = 4 AND topic('/words').words[0] = 'a' RETURN FRAMES"
    with Collection(tmp_path / "fleet") as fleet:
        assert [row.trace for row in fleet.find(text).rows()] == ["two"] * 20
        asked = "SELECT DISTINCT trace, words, \"only\" FROM topic('/words')"
        listed = fleet.sql(asked, each=True)
        assert sorted(row[1:] for row in listed) == [("one", ["a", "b"], None), ("two", ["a"], 4)]
        assert listed.notes == (
            "field 'only' of topic '/words' is NULL in the bundles without it (1)",
        )
        every = fleet.sql("SELECT * FROM topic('words')", each=True)
        of = {row[every.columns.index("trace")]: row[every.columns.index("only")] for row in every}
        assert of == {"one": None, "two": 4}
        assert fleet.sql("SELECT words FROM topic('words')", each=True).notes == ()


def test_online_frames_carry_messages() -> None:
    """The last message counts within the tolerance; an unknown value is no violation."""
    checks = "CHECK z: ALWAYS topic('/x', 0.2s).a.z[1] < 3; CHECK no: ALWAYS topic('/y').b = 'ok'"
    monitor = sgstore.Monitor(checks)
    events = list[tuple[int, str, str]]()
    for number in range(6):
        frame = sgstore.Frame(number * 100_000_000, ego="hero")
        frame.add("hero", "car", 0, 0)
        if number in {1, 5}:
            frame.topics["/x"] = {"a": {"z": [0, number - 1]}}
        events += [(number, one.kind, one.name) for one in monitor.step(frame)]
    assert events == [(5, "violated", "z")]
    z, no = monitor.finish()
    assert (z.verdict, no.verdict, no.reason) == (
        "false",
        "unknown",
        "trace online has no topic /y",
    )


def test_a_message_belongs_to_the_frame_of_its_stamp(tmp_path: Path) -> None:
    """A message is logged 1 ms after its frame; its stamp is the time of the frame, rounded down."""
    with Recorder(tmp_path / "drive.mcap") as recorder:
        channel = recorder.channel("/planner", "Planner", SCHEMA)
        for frame in range(5):
            log, ns = 100 + frame / 10, 9_003_000_000_000 + frame * 100_000_000 - frame % 2
            recorder.ground_truth(log, [car(1, x=frame)], host=1, stamp=9003 + frame / 10)
            stamp = {"sec": ns // 10**9, "nanosec": ns % 10**9}
            late = {"z": frame, "header": {"stamp": stamp}}
            recorder.write(channel, log + 0.001, json.dumps(late).encode())
            for name, sec in (("/wall_clock", 10**9), ("/two_hours_behind", ns // 10**9 - 7200)):
                other = {"z": frame, "header": {"stamp": {"sec": sec, "nanosec": ns % 10**9}}}
                clock = recorder.channel(name, "Planner", SCHEMA)
                recorder.write(clock, log + 0.001, json.dumps(other).encode())
    store = sgstore.open(tmp_path / "s.sgstore", create=True)
    store.ingest(tmp_path / "drive.mcap")
    rules = ("", ", nearest", ", linear")
    text = ", ".join(f"topic('/planner'{rule}).z" for rule in rules)
    rows = store.find(f"MATCH (e:Ego) RETURN {text} ORDER BY frame.seq").rows()
    values = [[row[number] for number in range(3)] for row in rows]
    assert values == [pytest.approx([frame] * 3) for frame in range(5)]
    for name in ("/wall_clock", "/two_hours_behind"):  # another clock: by log time
        rows = store.find(f"MATCH (e:Ego) RETURN topic('{name}').z ORDER BY frame.seq").rows()
        assert [row[0] for row in rows] == [None, 0, 1, 2, 3]
    rows = store.sql("SELECT t FROM topic('/planner')")
    assert [row[0] for row in rows] == pytest.approx([frame / 10 for frame in range(5)])
