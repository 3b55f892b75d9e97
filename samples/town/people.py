"""People on foot: they keep to the sidewalks, cross at the crosswalks, mind the lights and the vehicles.

SUMO's own pedestrians leave the sidewalks of an OpenDRIVE map at corners and cross where netconvert guesses,
not where the map has its crosswalks; so people are led by this small model of ours instead, and SUMO's
vehicles are told to give way to them (see ``traffic.py``).

A walk is a polyline: along the middle of a sidewalk, over crosswalks, along the next sidewalk. At each kerb
there is a gate. A gate with lights opens while vehicles on the road to be crossed have red for long enough;
one without opens when no vehicle comes; a scripted one opens at its time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from draw_map import Town, town
from tracks import STEP, Model, Track

if TYPE_CHECKING:
    from collections.abc import Callable

ACCELERATION = 1.5
"""How quickly a person starts and stops; m/s²."""
KERB = 0.6
"""How far from the kerb a person waits; m."""

ADULT = Model("person", "TYPE_PEDESTRIAN", 0.45, 0.6, 1.75, (60, 80, 140), "")
CHILD = Model("child", "TYPE_PEDESTRIAN", 0.4, 0.5, 1.3, (200, 90, 40), "")


@dataclass(frozen=True)
class Gate:
    """A kerb on a walk: ``start`` and ``end`` of the carriageway along it, and who may open it.

    ``opens`` is a time in seconds for a scripted walker; without it the crosswalk's rule holds.
    """

    start: float
    end: float
    crosswalk: str
    opens: float | None = None


@dataclass
class Walker:
    """A person on a walk."""

    track: Track
    line: np.ndarray
    speed: float
    gates: list[Gate] = field(default_factory=list)
    done: float = 0.0
    pace: float = 0.0
    at: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        self.at = distances(self.line)

    @property
    def position(self) -> tuple[float, float]:
        """Where the person is."""
        return (
            float(np.interp(self.done, self.at, self.line[:, 0])),
            float(np.interp(self.done, self.at, self.line[:, 1])),
        )

    @property
    def heading(self) -> float:
        """Which way the person goes."""
        b = min(self.done + 0.3, float(self.at[-1]))
        a = min(self.done, b - 0.05)
        xs, ys = (np.interp([a, b], self.at, self.line[:, i]) for i in (0, 1))
        return math.atan2(ys[1] - ys[0], xs[1] - xs[0])

    @property
    def on_road(self) -> bool:
        """Whether the person is on a carriageway."""
        return any(g.start < self.done < g.end for g in self.gates)

    def advance(self, may_enter: Callable[[Gate], bool], blocked: bool) -> None:
        """One step further, or a step slower before a closed gate, a vehicle, or the end of the walk."""
        stop = float(self.at[-1])
        for gate in self.gates:
            if self.done < gate.start and not may_enter(gate):
                stop = min(stop, gate.start - KERB)
        room = max(stop - self.done, 0.0)
        allowed = 0.0 if blocked else min(self.speed, math.sqrt(2 * ACCELERATION * room))
        change = ACCELERATION * STEP
        self.pace += min(max(allowed - self.pace, -2 * change), change)
        self.done = min(self.done + max(self.pace, 0.0) * STEP, float(self.at[-1]))


@cache
def kerb_walks() -> tuple[np.ndarray, ...]:
    """Middle lines of the sidewalks, joined round the corners; each from one end of the town to another."""
    lines = []
    for road in town().roads.values():
        for section in road.sections:
            for n in section.numbers:
                if section.lane(n).kind == "sidewalk":
                    inner, outer = road.lane_strip(section, n)
                    lines.append((inner + outer) / 2)
    chains = []
    while lines:
        chain = lines.pop(0)
        grown = True
        while grown:
            grown = False
            for i, other in enumerate(lines):
                joined = join(chain, other)
                if joined is not None:
                    chain, grown = joined, True
                    lines.pop(i)
                    break
        chains.append(chain)
    return tuple(chains)


def join(a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """Two polylines as one if they share an end, else None."""
    for first in (a, a[::-1]):
        for second in (b, b[::-1]):
            if math.dist(first[-1], second[0]) < 0.01:
                return np.vstack([first, second[1:]])
    return None


def distances(line: np.ndarray) -> np.ndarray:
    """How far along a polyline each of its points lies; m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])


def project(line: np.ndarray, point: tuple[float, float]) -> tuple[float, float]:
    """How far along a polyline the nearest point to ``point`` lies, and how far away it is; m."""
    line = line[np.concatenate([[True], np.hypot(*np.diff(line, axis=0).T) > 1e-9])]
    if len(line) < 2:
        return 0.0, math.dist(line[0], point)
    a, d = line[:-1], np.diff(line, axis=0)
    share = np.clip(((point - a) * d).sum(1) / (d * d).sum(1), 0, 1)
    gap = np.hypot(*(a + d * share[:, None] - point).T)
    i = int(gap.argmin())
    return float(distances(line)[i] + share[i] * np.hypot(*d[i])), float(gap[i])


def stretch(line: np.ndarray, a: float, b: float) -> np.ndarray:
    """The part of a polyline from ``a`` to ``b`` metres along it; backwards if b < a."""
    along = distances(line)
    low, high = min(a, b), max(a, b)
    at = np.array([low, *along[(along > low) & (along < high)], high])
    part = np.column_stack([np.interp(at, along, line[:, i]) for i in (0, 1)])
    return part if a <= b else part[::-1]


def chain_at(point: tuple[float, float]) -> np.ndarray:
    """The sidewalk nearest to a point."""
    return min(kerb_walks(), key=lambda line: project(line, point)[1])


def ends_of(drawn: Town, ident: str) -> tuple[list[tuple[float, float]], float]:
    """Where a crosswalk's middle line meets the middles of the sidewalks, and half its length."""
    thing = next(c for c in drawn.crosswalks if c.attributes["id"] == ident)
    half = float(thing.attributes["width"]) / 2
    road = drawn.roads[thing.road]
    return [road.point(thing.s, side * (half + 1.25)) for side in (-1, 1)], half


def shifted(line: np.ndarray, aside: float) -> np.ndarray:
    """A polyline moved to the left of its direction."""
    d = np.gradient(line, axis=0)
    normal = np.column_stack([-d[:, 1], d[:, 0]]) / np.hypot(*d.T)[:, None]
    return line + normal * aside


def rounded(line: np.ndarray) -> np.ndarray:
    """A polyline with its corners worn off: points every 0.25 m, averaged over a metre."""
    along = distances(line)
    at = np.linspace(0, along[-1], max(2, round(along[-1] / 0.25)))
    dense = np.column_stack([np.interp(at, along, line[:, i]) for i in (0, 1)])
    padded = np.vstack([dense[:1]] * 2 + [dense] + [dense[-1:]] * 2)
    return np.column_stack([np.convolve(padded[:, i], np.full(5, 0.2), "valid") for i in (0, 1)])


def walk(
    start: tuple[float, float],
    crosswalks: tuple[tuple[str, float | None], ...],
    end: tuple[float, float],
    aside: float,
) -> tuple[np.ndarray, list[Gate]]:
    """A walk from a place over crosswalks (id, and the time at which a scripted gate opens) to a place.

    ``aside`` moves the whole walk to its left, so that people do not tread in each other's steps.
    """
    legs: list[np.ndarray] = []
    here = start
    for ident, _ in crosswalks:
        ends, _ = ends_of(town(), ident)
        chain = chain_at(here)
        near, far = sorted(ends, key=lambda p: project(chain, p)[1])
        legs.append(stretch(chain, project(chain, here)[0], project(chain, near)[0]))
        legs.append(np.array([near, far]))
        here = far
    chain = chain_at(here)
    legs.append(stretch(chain, project(chain, here)[0], project(chain, end)[0]))
    moved = [shifted(leg, aside) for leg in legs if len(leg) > 1 and np.ptp(leg) > 0]
    line = rounded(np.vstack(moved))
    return line, gates_of(line, crosswalks)


def gates_of(line: np.ndarray, crosswalks: tuple[tuple[str, float | None], ...]) -> list[Gate]:
    """The gates of a walk: where it comes onto each carriageway and where it leaves it."""
    along = distances(line)
    gates = []
    for ident, opens in crosswalks:
        ends, half = ends_of(town(), ident)
        way = np.subtract(ends[1], ends[0]) / math.dist(*ends)
        past = (line - np.mean(ends, axis=0)) @ way
        aside = (line - np.mean(ends, axis=0)) @ np.array([-way[1], way[0]])
        on = np.flatnonzero((np.abs(past) < half) & (np.abs(aside) < 3.0))
        gates.append(Gate(float(along[on[0]]), float(along[on[-1]]), ident, opens))
    return gates
