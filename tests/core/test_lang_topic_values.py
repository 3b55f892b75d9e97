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
        },
    }
).encode()

Message = tuple[int, dict[str, Any]]
"""Log time in milliseconds, and content."""


def wanted(
    messages: list[Message], frames: list[tuple[int, int]], rule: str, tolerance: float
) -> list[float | None]:
    """The definition: the value of ``z`` at each frame (log time, simulation time); ms."""
    runs = [*accumulate(b[1] < a[1] for a, b in pairwise([frames[0], *frames]))]
    starts = {run: frames[runs.index(run)][0] for run in runs}
    found: list[float | None] = []
    for (now, _), run in zip(frames, runs, strict=True):
        ends = starts.get(run + 1, float("inf"))
        of_run = [
            (t, m.get("z")) for t, m in messages if (t >= starts[run] or not run) and t < ends
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


def recorded(path: Path, seed: int) -> tuple[list[Message], list[tuple[int, int]]]:
    """Write a drive with messages at random times: equal times, gaps, missing fields, a clock that jumps."""
    rng = random.Random(seed)
    log, stamp, frames = 1000, 0, list[tuple[int, int]]()
    for _ in range(40):
        log += rng.choice((50, 100, 100, 150, 400))
        stamp = 0 if rng.random() < 0.04 else stamp + 100
        frames.append((log, stamp))
    times = sorted(
        rng.choice((rng.randrange(900, log + 200), rng.choice(frames)[0])) for _ in range(60)
    )
    times = [t for t in times if not 1800 < t < 2600]
    messages = [(t, content(rng)) for t in times]
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


def content(rng: random.Random) -> dict[str, Any]:
    z = {} if rng.random() < 0.1 else {"z": round(rng.uniform(-5, 5), 3)}
    state, values = rng.choice(("GO", "STOP")), [rng.randrange(9) for _ in range(3)]
    inner = {"odd-name": rng.randrange(5)}
    return {**z, "state": state, "ok": rng.random() < 0.5, "inner": inner, "values": values}


RULES = [
    *(("last", 1000), ("last", 120), ("last", None), ("nearest", 60), ("nearest", 1000)),
    *(("linear", 200), ("linear", None)),
]


@pytest.mark.parametrize("seed", range(2))
def test_values_are_those_of_the_definition(tmp_path: Path, seed: int) -> None:
    """In find, check and the monitor, from a store with and without the topic as columns."""
    path = tmp_path / "drive.mcap"
    messages, frames = recorded(path, seed)
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
