"""Made-up drives, as many as wanted: coherent in time, an ego among others, on one of eight streets.

At 10 Hz; the length of a drive is lognormal between 15 s and 200 s (a median of 45 s). About 17 nodes a frame
(5 cars with the ego, 1 van, truck or bus, 3 people, 5 lanes, road and off_road), and 48 edges with the settings
of :mod:`bench.patterns`.

* The ego keeps to its lane, at 4 to 12 m/s, and stops now and then, as at lights; who drives stops with it.
* Two vehicles go ahead of it and two behind, at distances that wander, and change lanes; the nearer of those
  behind stays in the lane at the kerb, much of the time beside the ego.
* In the lane of the other direction one comes every 200 m, and at the kerb a car or van stands every 130 m.
* A person walks on the sidewalk every 175 m, one stands across the street every 40 m, and where the ego stops,
  one has waited at the kerb and walks across the street in front of it.

Distances from one to the next are drawn, and so are kinds: of 12 vehicles 9 are cars. Nobody ever comes nearer
to another than half a metre. Everything follows from the seed.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sgstore.model.vocabulary import KIND_CODE
from sgstore.model.world import Channel, Entities, FrameBlock, MessageRefs, States, TraceInfo

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

PERIOD_NS = 100_000_000
BLOCK = 600
MAPS = 8
SECTION = 300.0
"""Length of a road; m."""
ROADS = 12
WIDTH = 3.5
SIZE = {
    "car": (4.5, 1.9, 1.5),
    "van": (5.5, 2.0, 2.2),
    "truck": (9.0, 2.5, 3.2),
    "bus": (12.0, 2.5, 3.2),
    "person": (0.5, 0.5, 1.75),
}
KINDS = ("car", "car", "car", "van", "car", "car", "car", "truck", "car", "car", "car", "bus")
ONCOMING, PARKED, WALKING, WAITING = 200.0, 130.0, 175.0, 40.0
"""From one to the next in the mean: against the ego, at the kerb, on the sidewalk, across the street; m."""
LANES = (0.5 * WIDTH, -0.5 * WIDTH, -5.1)
"""Where one drives: against, ahead, and ahead beside the kerb; y in m."""
PARKED_Y, WALKING_Y, WAITING_Y = -8.0, -9.8, 24.0
CROSSING_Y = (-8.0, 5.0)
CROSSING = 3.65
"""How far ahead of the middle of the ego one crosses: of its column, none is within 1 m of this; m."""
WALK = 1.4
"""Of people; m/s."""
AHEAD, BEHIND = (13.0, 42.0), (-5.0, -24.0)
"""Where the rears of those ahead, and the fronts of those behind, would be: from the middle of the ego; m."""
COLUMN = len(AHEAD) + len(BEHIND)
CLEAR = 2.5
"""From one of the column to the next, at least; m."""
FASTER = 1.3
"""How much faster than the ego those are that come towards it."""


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
        digest=f"{frames:032x}{number:032x}"[::-1],  # the first digits tell recordings apart
        flavour="osi",
        channels=(Channel(1, "/truth", "osi3.GroundTruth", "protobuf", "protobuf", frames, "ground_truth"),),
        ego="0",
        map_text="",
        map_name=f"street {number % MAPS}",
        context=MessageRefs(none, none, none, none, none),
    )  # fmt: skip


def drive(number: int, frames: int) -> Iterator[FrameBlock]:
    """The frames of a drive, in blocks."""
    random = np.random.default_rng(number)
    actors = _traffic(random, frames)
    count = len(actors.kinds)
    y = actors.y + 1000.0 * (number % MAPS)
    length, width, height = np.array([SIZE[kind] for kind in actors.kinds]).T
    entities = Entities(
        first=0,
        ident=tuple(map(str, range(count))),
        kind=np.array([KIND_CODE[kind] for kind in actors.kinds], np.int8),
        special=("",) * count,
        subkind=("",) * count,
        type_name=("",) * count,
        static=np.zeros(count, np.bool_),
        map_ref=("",) * count,
    )
    nobody = Entities(count, (), np.zeros(0, np.int8), (), (), (), np.zeros(0, np.bool_), ())
    none = np.zeros(0, np.int64)
    for start in range(0, frames, BLOCK):
        rows = slice(start, min(start + BLOCK, frames))
        seq = np.arange(rows.start, rows.stop)
        n = len(seq)
        velocity = actors.speed[rows].ravel()
        towards = actors.heading[rows].ravel()
        states = States.of(
            node=np.tile(np.arange(count), n),
            x=actors.x[rows].ravel(),
            y=y[rows].ravel(),
            z=np.tile(height / 2, n),
            heading=towards,
            pitch=np.zeros(n * count),
            roll=np.zeros(n * count),
            vx=velocity * np.cos(towards),
            vy=velocity * np.sin(towards),
            vz=np.zeros(n * count),
            length=np.tile(length, n),
            width=np.tile(width, n),
            height=np.tile(height, n),
        )
        yield FrameBlock(
            seq=seq,
            time_ns=seq * PERIOD_NS,
            log_time_ns=seq * PERIOD_NS,
            offsets=np.arange(n + 1) * count,
            states=states,
            ego=np.zeros(n, np.int64),
            entities=nobody if start else entities,
            scenery=States.of(node=none),
            messages=MessageRefs(none, none, none, none, none),
        )


class _Actors(NamedTuple):
    """Some that move: their kinds, and in each frame x, y, heading and speed, (frames, actors)."""

    kinds: list[str]
    x: Floats
    y: Floats
    heading: Floats
    speed: Floats


def _traffic(random: np.random.Generator, frames: int) -> _Actors:
    """All actors of a drive: the ego first, then the others as the module says."""
    t = np.arange(frames)[:, None] / 10
    speed = _ego_speed(random, t)
    way = np.cumsum(speed, axis=0) / 10
    begin = 200 + random.uniform(0, 200)
    until = begin + way[-1, 0]
    walked = WALK * t
    stops = np.flatnonzero((speed[:, 0] == 0) & (np.roll(speed[:, 0], 1) > 0))
    crossing_x = begin + way[stops, 0] + CROSSING
    since = np.clip(t - t[stops, 0] - 1, 0, (CROSSING_Y[1] - CROSSING_Y[0]) / WALK)
    crossing_y = CROSSING_Y[0] + WALK * since
    crossing = np.diff(crossing_y, axis=0, prepend=CROSSING_Y[0]) > 0
    oncoming = _places(random, ONCOMING, begin, until + FASTER * way[-1, 0])
    oncoming = oncoming[_clear(oncoming[:, None] - FASTER * way[stops, 0], crossing_x)]
    parked = _places(random, PARKED, begin, until)
    parked = parked[_clear(parked[:, None], crossing_x)]
    walking = _places(random, WALKING, begin - walked[-1, 0], until)
    waiting = _places(random, WAITING, begin, until)
    groups = (
        _driven(random, begin, oncoming, way, speed),
        _standing(random, parked, frames),
        _people(walking + walked, WALKING_Y, 0.0, WALK),
        _people(waiting + 0 * t, WAITING_Y, -0.5 * np.pi, 0.0),
        _people(crossing_x, crossing_y, 0.5 * np.pi, WALK * crossing),
    )
    kinds = [kind for group in groups for kind in group.kinds]
    return _Actors(kinds, *(np.hstack([group[i] for group in groups]) for i in range(1, 5)))


def _ego_speed(random: np.random.Generator, t: Floats) -> Floats:
    """From 4 to 12 m/s, and 0 for 13 to 32 s at a time, never in the first frame."""
    wish = 8 + 4 * np.sin(t / random.uniform(8, 20) + random.uniform(0, 6))
    light = np.sin(t / random.uniform(10, 25) + random.uniform(2.5, 6.8))
    return wish * np.clip(4 * (0.8 - light), 0, 1)


def _places(random: np.random.Generator, mean: float, begin: float, until: float) -> Floats:
    """Places along the street, from 60 m before to 60 m behind, every ``mean`` metres or so."""
    count = int((until - begin + 120) / mean) + 1
    gaps = mean * random.uniform(0.5, 1.5, 2 * count)
    found = begin - 60 - mean * random.random() + np.cumsum(gaps)
    return found[found < until + 60]


def _clear(x: Floats, crossing_x: Floats) -> NDArray[np.bool_]:
    """Which vehicles stand clear of all places where one crosses; the longest is 12 m long."""
    return np.all(np.abs(x - crossing_x) > 8, axis=1)


def _kinds(random: np.random.Generator, count: int) -> list[str]:
    return [KINDS[i] for i in random.integers(len(KINDS), size=count)]


def _standing(random: np.random.Generator, x: Floats, frames: int) -> _Actors:
    """Cars and vans at the kerb."""
    shape = (frames, len(x))
    kinds = [kind if kind == "van" else "car" for kind in _kinds(random, len(x))]
    still = np.zeros(shape)
    return _Actors(kinds, np.broadcast_to(x, shape), np.full(shape, PARKED_Y), still, still)


def _people(x: Floats, y: float | Floats, heading: float, speed: float | Floats) -> _Actors:
    shape = np.broadcast_shapes(x.shape, np.shape(y))
    return _Actors(
        ["person"] * shape[1],
        *(np.broadcast_to(value, shape) for value in (x, y, heading, speed)),
    )


def _driven(
    random: np.random.Generator, begin: float, oncoming: Floats, way: Floats, speed: Floats
) -> _Actors:
    """The ego, those that go its way, and those that come towards it: all a function of its way.

    So they stop where it stops, and their speed is in proportion to its own.
    """
    kinds = ["car", *_kinds(random, COLUMN + len(oncoming))]
    length = np.array([SIZE[kind][0] for kind in kinds[1 : COLUMN + 1]])
    far, near, between = random.uniform([[4], [1], [60]], [[7], [3], [150]], (3, COLUMN))
    phase = random.uniform(0, 2 * np.pi, (3, COLUMN))
    swerve = random.uniform(0, 2 * np.pi, len(kinds))

    def placed(way: Floats) -> tuple[Floats, Floats]:
        slow, fast, change = (
            np.sin(way / wave + p) for wave, p in zip((40, 15, between), phase, strict=True)
        )
        right = 0.5 + 0.5 * np.tanh(5 * change)
        right[:, len(AHEAD)] = 1
        y = LANES[1] + (LANES[2] - LANES[1]) * np.hstack([np.zeros(way.shape), right])
        against = oncoming - FASTER * way
        x = np.hstack(
            [begin + way, begin + way + _column(far * slow + near * fast, length), against]
        )
        y = np.hstack([y, np.full(against.shape, LANES[0])])
        return x, y + 0.12 * np.sin(way / 25 + swerve)

    step = 0.1
    x, y = placed(way)
    dx, dy = (after - now for now, after in zip((x, y), placed(way + step), strict=True))
    return _Actors(kinds, x, y, np.arctan2(dy, dx), speed * np.hypot(dx, dy) / step)


def _column(wander: Floats, length: Floats) -> Floats:
    """How far each is ahead of the ego, (frames, vehicles), from middle to middle.

    Nobody passes another, whatever their lanes: each keeps clear of those nearer to the ego. Only the first of
    those behind may be beside the ego.
    """
    x = np.empty(wander.shape)
    free = np.full(len(x), CROSSING + 1)
    for k, wish in enumerate(AHEAD):
        rear = _smooth_max(wish + wander[:, k], free)
        x[:, k] = rear + length[k] / 2
        free = rear + length[k] + CLEAR
    free = np.full(len(x), CROSSING - 1)
    for k, wish in enumerate(BEHIND, len(AHEAD)):
        front = -_smooth_max(-wish - wander[:, k], -free)
        x[:, k] = front - length[k] / 2
        free = np.minimum(front - length[k], -SIZE["car"][0] / 2) - CLEAR
    return x


def _smooth_max(a: Floats, b: Floats) -> Floats:
    """At least the greater of both, and at most 2 m more; as one brakes, not as one bounces."""
    return 0.5 * (a + b + np.hypot(a - b, 4))
