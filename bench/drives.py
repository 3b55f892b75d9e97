"""Made-up drives, as many as wanted: coherent in time, an ego among 14 others, on one of eight streets.

At 10 Hz; the length of a drive is lognormal between 15 s and 200 s (a median of 45 s). The ego keeps to its
lane and stops now and then, as at lights. Four vehicles go its way, clear of it, at distances that wander as if
drawn by a spring; four come towards it, one after the other, in the lane beside; three stand at the kerb, every
150 m; two people walk on the sidewalk, and one crosses the street, to and fro. Of the vehicles 3 in 4 are cars,
the others vans, trucks and buses. Everything follows from the seed.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sgstore.vocabulary import KIND_CODE
from sgstore.world import Channel, Entities, FrameBlock, MessageRefs, States, TraceInfo

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

PERIOD_NS = 100_000_000
BLOCK = 600
MAPS = 8
SECTION = 300.0
"""Length of a road; m."""
ROADS = 12
WIDTH = 3.5
KINDS = ("car", "car", "car", "van", "car", "car", "car", "truck", "car", "car", "car", "bus")
SIZE = {"car": (4.5, 1.9, 1.5), "van": (5.5, 2.0, 2.2), "truck": (9.0, 2.5, 3.2)}
SIZE |= {"bus": (12.0, 2.5, 3.2), "person": (0.5, 0.5, 1.75)}
PEOPLE = 3


def street(number: int) -> str:
    """OpenDRIVE text of roads one behind the other: two lanes ahead, one against, a sidewalk."""
    roads = "".join(_road(number, k) for k in range(ROADS))
    return (
        f'<OpenDRIVE><header revMajor="1" revMinor="6" name="street {number}"/>{roads}</OpenDRIVE>'
    )


def _road(number: int, k: int) -> str:
    name = f"{100 * number + k}"
    links = "".join(
        f'<{tag} elementType="road" elementId="{100 * number + other}" contactPoint="{end}"/>'
        for tag, other, end in (("predecessor", k - 1, "end"), ("successor", k + 1, "start"))
        if 0 <= other < ROADS
    )
    lanes = {1: "driving", 0: "none", -1: "driving", -2: "driving", -3: "sidewalk"}
    left, right = (
        "".join(_lane(n, kind) for n, kind in lanes.items() if (n > 0) == ahead and n)
        for ahead in (True, False)
    )
    return (
        f'<road name="" length="{SECTION}" id="{name}" junction="-1"><link>{links}</link><planView>'
        f'<geometry s="0" x="{SECTION * k}" y="{1000.0 * number}" hdg="0" length="{SECTION}"><line/></geometry>'
        f'</planView><lanes><laneSection s="0"><left>{left}</left><center><lane id="0" type="none"/></center>'
        f"<right>{right}</right></laneSection></lanes></road>"
    )


def _lane(number: int, kind: str) -> str:
    link = f'<link><predecessor id="{number}"/><successor id="{number}"/></link>'
    mark = '<roadMark sOffset="0" type="broken" color="white" laneChange="both"/>'
    width = f'<width sOffset="0" a="{WIDTH}" b="0" c="0" d="0"/>'
    return f'<lane id="{number}" type="{kind}">{link}{width}{mark}</lane>'


def lengths(frames: int, seed: int = 0) -> list[int]:
    """Frames of each drive, ``frames`` in all."""
    random = np.random.default_rng(seed)
    found: list[int] = []
    while sum(found) < frames:
        found.append(int(np.clip(random.lognormal(6.1, 0.6), 150, 2000)))
    found[-1] -= sum(found) - frames
    return found


def info(number: int, frames: int) -> TraceInfo:
    """What is known of a drive before it is read."""
    none = np.zeros(0, np.int64)
    return TraceInfo(
        path=Path(f"drive-{number:05}.mcap"),
        size=0,
        mtime_ns=0,
        digest=f"{number:032x}{frames:032x}",
        flavour="osi",
        channels=(Channel(1, "/truth", "osi3.GroundTruth", "protobuf", "protobuf", frames, "ground_truth"),),
        ego="0",
        map_text="",
        map_name=f"street {number % MAPS}",
        context=MessageRefs(none, none, none, none, none),
    )  # fmt: skip


def drive(number: int, frames: int) -> Iterator[FrameBlock]:
    """The frames of a drive, in blocks."""
    x, y, heading, speed = _motion(np.random.default_rng(number), frames)
    y = y + 1000.0 * (number % MAPS)
    actors = x.shape[1]
    kinds = [KINDS[(number + k) % len(KINDS)] if k else "car" for k in range(actors - PEOPLE)]
    kinds += ["person"] * PEOPLE
    length, width, height = np.array([SIZE[kind] for kind in kinds]).T
    entities = Entities(
        first=0,
        ident=tuple(map(str, range(actors))),
        kind=np.array([KIND_CODE[kind] for kind in kinds], np.int8),
        special=("",) * actors,
        subkind=("",) * actors,
        type_name=("",) * actors,
        static=np.zeros(actors, np.bool_),
        map_ref=("",) * actors,
    )
    nobody = Entities(actors, (), np.zeros(0, np.int8), (), (), (), np.zeros(0, np.bool_), ())
    none = np.zeros(0, np.int64)
    for start in range(0, frames, BLOCK):
        rows = slice(start, min(start + BLOCK, frames))
        seq = np.arange(rows.start, rows.stop)
        n = len(seq)
        velocity = speed[rows].ravel()
        towards = np.broadcast_to(heading[rows], (n, actors)).ravel()
        states = States.of(
            node=np.tile(np.arange(actors), n),
            x=x[rows].ravel(),
            y=y[rows].ravel(),
            z=np.tile(height / 2, n),
            heading=towards,
            pitch=np.zeros(n * actors),
            roll=np.zeros(n * actors),
            vx=velocity * np.cos(towards),
            vy=velocity * np.sin(towards),
            vz=np.zeros(n * actors),
            length=np.tile(length, n),
            width=np.tile(width, n),
            height=np.tile(height, n),
        )
        yield FrameBlock(
            seq=seq,
            time_ns=seq * PERIOD_NS,
            log_time_ns=seq * PERIOD_NS,
            offsets=np.arange(n + 1) * actors,
            states=states,
            ego=np.zeros(n, np.int64),
            entities=nobody if start else entities,
            scenery=States.of(node=none),
            messages=MessageRefs(none, none, none, none, none),
        )


def _motion(random: np.random.Generator, n: int) -> tuple[NDArray[np.float64], ...]:
    """x, y, heading and speed of all actors, (frames, actors): the ego, then the others as the module says."""
    t = np.arange(n)[:, None] / 10
    wish = 8 + 4 * np.sin(t[:, 0] / random.uniform(8, 20) + random.uniform(0, 6))
    wish[np.sin(t[:, 0] / random.uniform(10, 25)) > 0.8] = 0
    speed = _followed(wish[:, None], 0.05)
    ego_x = 200 + random.uniform(0, 200) + np.cumsum(speed, axis=0) / 10
    ego_y = np.full((n, 1), -0.5 * WIDTH)

    ahead = np.array([[24.0, -24.0, 4.0, 44.0]]) + random.normal(0, 3, (1, 4))
    wander = _followed(random.normal(0, 40, (n, 4)), 0.02)
    convoy_x = ego_x + ahead + wander
    lane = np.array([[-0.5, -0.5, -1.5, -1.5]]) * WIDTH
    changes = np.sign(np.sin(t / random.uniform(10, 30, (1, 4))))
    convoy_y = _followed(np.where(changes > 0, lane, -2 * WIDTH - lane), 0.03)
    convoy_speed = np.maximum(np.gradient(convoy_x, 0.1, axis=0) if n > 1 else speed, 0)

    towards = 400 * np.arange(4) + random.uniform(0, 300) - 9 * t
    oncoming_x = ego_x + np.mod(towards, 1600) - 200
    oncoming_y = np.full((n, 4), 0.5 * WIDTH)

    kerb_x = np.broadcast_to(np.floor(ego_x[:1] / 150) * 150 + 150 * np.array([[0, 1, 3]]), (n, 3))
    kerb_y = np.full((n, 3), -2.05 * WIDTH)

    walk_x = ego_x[:1] + np.array([[20.0, 70.0]]) + 1.3 * t * np.array([[1, -1]])
    walk_y = np.full((n, 2), -2.5 * WIDTH)
    cross_x = np.floor(ego_x / 80) * 80 + 60
    cross_y = -0.75 * WIDTH + 2.2 * WIDTH * np.sin(t / random.uniform(3, 6))

    zeros = np.zeros((n, 1))
    x = np.hstack([ego_x, convoy_x, oncoming_x, kerb_x, walk_x, cross_x])
    y = np.hstack([ego_y, convoy_y, oncoming_y, kerb_y, walk_y, cross_y])
    speeds = np.hstack(
        [
            speed,
            convoy_speed,
            np.full((n, 4), 9.0),
            np.zeros((n, 3)),
            np.full((n, 2), 1.3),
            zeros + 1,
        ]
    )
    turned = np.hstack(
        [zeros, np.zeros((n, 4)), np.full((n, 4), np.pi), np.zeros((n, 3)), zeros, zeros + np.pi, zeros + 1.57]
    )  # fmt: skip
    return x, y, turned, speeds


def _followed(wish: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """What follows a wish, each step by a share of what is missing: a running mean with a long tail."""
    weights = rate * (1 - rate) ** np.arange(int(6 / rate))
    weights /= weights.sum()
    padded = np.vstack([np.repeat(wish[:1], len(weights) - 1, axis=0), wish])
    return np.stack([np.convolve(column, weights, mode="valid") for column in padded.T], axis=1)
