"""Roads as OpenDRIVE sees them: a reference line of lines, arcs and clothoids, and lanes beside it.

The same description serves two ends: it is written out as OpenDRIVE 1.6, and it is sampled, for the
camera, the lidar and the people of the recording. Axes are OpenDRIVE's: x east, y north, metres, radians;
``s`` runs along a reference line, ``t`` is positive to its left. Lanes to the right have negative numbers.
The town is flat, so there is no height in here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

STEP = 1.0
"""Greatest distance between two samples of a curved line; m."""


@dataclass(frozen=True)
class Piece:
    """A piece of a reference line, of a curvature that changes evenly from ``start`` to ``end`` (1/m)."""

    length: float
    start: float = 0.0
    end: float = 0.0

    def advance(self, x: float, y: float, heading: float, d: float) -> tuple[float, float, float]:
        """Pose after ``d`` metres from a pose at the start of the piece.

        Lines and arcs are exact; a clothoid is summed by Simpson's rule in steps of at most 0.25 m, where
        the error is far below a micrometre for the curvatures of a town.
        """
        slope = (self.end - self.start) / self.length
        if slope == 0 and self.start == 0:
            return x + d * math.cos(heading), y + d * math.sin(heading), heading
        if slope == 0:
            turned = heading + self.start * d
            radius = 1 / self.start
            return (
                x + radius * (math.sin(turned) - math.sin(heading)),
                y - radius * (math.cos(turned) - math.cos(heading)),
                turned,
            )
        n = 2 * max(1, math.ceil(d / 0.25))
        at = np.linspace(0, d, n + 1)
        angle = heading + self.start * at + slope / 2 * at**2
        weight = np.ones(n + 1)
        weight[1:-1:2], weight[2:-1:2] = 4, 2
        weight *= d / n / 3
        end = float(angle[-1])
        return x + float(weight @ np.cos(angle)), y + float(weight @ np.sin(angle)), end


@dataclass(frozen=True)
class Mark:
    """Paint on a lane's outer border, from ``s`` metres after the start of its section."""

    kind: str
    change: str = "none"
    width: float = 0.12
    s: float = 0.0


@dataclass(frozen=True)
class Lane:
    """A lane; its width changes evenly from ``width`` to ``end`` over its section."""

    kind: str
    width: float
    end: float | None = None
    marks: tuple[Mark, ...] = ()

    def width_at(self, share: float) -> float:
        """Width after this share (0 … 1) of the section; m."""
        return self.width + ((self.width if self.end is None else self.end) - self.width) * share


@dataclass(frozen=True)
class Section:
    """Lanes from ``s`` on; ``left`` and ``right`` run from the reference line outward."""

    s: float
    left: tuple[Lane, ...]
    center: tuple[Mark, ...]
    right: tuple[Lane, ...]

    def lane(self, number: int) -> Lane:
        """The lane of that number."""
        return self.left[number - 1] if number > 0 else self.right[-number - 1]

    @property
    def numbers(self) -> list[int]:
        """Lane numbers from left to right, without the centre."""
        return [*range(len(self.left), 0, -1), *range(-1, -len(self.right) - 1, -1)]


@dataclass
class Thing:
    """An object on a road (a crosswalk, a stop line) or a signal: its attributes as OpenDRIVE names them."""

    road: str
    s: float
    t: float
    attributes: dict[str, str]
    outline: tuple[tuple[float, float], ...] = ()
    lanes: tuple[int, ...] = ()
    by_road: bool = False


@dataclass
class Road:
    """A road and whatever stands on it.

    ``before`` and ``after`` are its links: ``("junction", id)`` or ``("road", id, contact point)``.
    ``links`` says for a connecting road which lanes of those two roads each of its lanes joins.
    """

    id: str
    name: str
    start: tuple[float, float, float]
    pieces: tuple[Piece, ...]
    sections: tuple[Section, ...]
    limit: int = 50
    junction: str = "-1"
    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    links: dict[int, tuple[int | None, int | None]] = field(default_factory=dict)
    objects: list[Thing] = field(default_factory=list)
    signals: list[Thing] = field(default_factory=list)

    @property
    def length(self) -> float:
        """Length of the reference line; m."""
        return sum(p.length for p in self.pieces)

    def starts(self) -> list[tuple[float, float, float, float]]:
        """``s, x, y, heading`` at the start of each piece and at the end of the last."""
        poses = [(0.0, *self.start)]
        for piece in self.pieces:
            s, *pose = poses[-1]
            poses.append((s + piece.length, *piece.advance(*pose, piece.length)))
        return poses

    def pose(self, s: float) -> tuple[float, float, float]:
        """Pose of the reference line at ``s``."""
        for piece, (s0, *pose) in zip(self.pieces, self.starts(), strict=False):
            if s <= s0 + piece.length or piece is self.pieces[-1]:
                return piece.advance(*pose, s - s0)
        raise ValueError(f"road {self.id} has no pieces")

    def point(self, s: float, t: float) -> tuple[float, float]:
        """The point at ``s, t``."""
        x, y, heading = self.pose(s)
        return x - t * math.sin(heading), y + t * math.cos(heading)

    def section_at(self, s: float) -> tuple[Section, float]:
        """The section at ``s`` and how much of it lies behind, 0 … 1."""
        ends = [*(x.s for x in self.sections[1:]), self.length]
        for section, end in zip(self.sections, ends, strict=True):
            if s < end or section is self.sections[-1]:
                return section, (s - section.s) / (end - section.s)
        raise ValueError(f"road {self.id} has no sections")

    def borders(self, section: Section, number: int, share: float) -> tuple[float, float]:
        """``t`` of a lane's inner and outer border."""
        side = section.left if number > 0 else section.right
        inner = sum(x.width_at(share) for x in side[: abs(number) - 1])
        outer = inner + side[abs(number) - 1].width_at(share)
        return (inner, outer) if number > 0 else (-inner, -outer)

    def stations(self, start: float, end: float) -> list[float]:
        """Values of ``s`` from start to end, close enough to draw the line through them."""
        at = [start]
        for piece, (s0, *_) in zip(self.pieces, self.starts(), strict=False):
            a, b = max(start, s0), min(end, s0 + piece.length)
            if b - a > 1e-9:
                parts = 1 if piece.start == piece.end == 0 else math.ceil((b - a) / STEP)
                at += [a + (b - a) * i / parts for i in range(1, parts + 1)]
        return at

    def spans(self) -> list[tuple[Section, float, float]]:
        """The sections with their start and end."""
        ends = [*(x.s for x in self.sections[1:]), self.length]
        return [(section, section.s, end) for section, end in zip(self.sections, ends, strict=True)]

    def lane_strip(self, section: Section, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Inner and outer border of a lane in a section, ``(n, 2)`` points each."""
        end = next(end for found, _, end in self.spans() if found is section)
        inner, outer = [], []
        for s in self.stations(section.s, end):
            a, b = self.borders(section, number, (s - section.s) / (end - section.s))
            inner.append(self.point(s, a))
            outer.append(self.point(s, b))
        return np.array(inner), np.array(outer)

    def line(self, s0: float, s1: float, t: float) -> np.ndarray:
        """Points of the line at constant ``t``."""
        return np.array([self.point(s, t) for s in self.stations(s0, s1)])


@dataclass(frozen=True)
class Arm:
    """The end of a road at a junction. Lanes are counted from the middle: 1, 2, … in either direction."""

    road: Road
    at_end: bool

    @property
    def contact(self) -> str:
        """OpenDRIVE's word for this end."""
        return "end" if self.at_end else "start"

    @property
    def section(self) -> Section:
        """The lanes at this end."""
        return self.road.sections[-1 if self.at_end else 0]

    @property
    def s(self) -> float:
        """Where the end is."""
        return self.road.length if self.at_end else 0.0

    def number(self, lane: int, *, incoming: bool) -> int:
        """Lane number in the road of the n-th lane into or out of the junction."""
        return -lane if incoming == self.at_end else lane

    def side(self, *, incoming: bool) -> tuple[Lane, ...]:
        """Lanes into or out of the junction, from the middle outward."""
        return self.section.right if incoming == self.at_end else self.section.left

    def pose(self, lane: int, *, incoming: bool) -> tuple[float, float, float]:
        """Left border of the n-th lane, in its direction of travel."""
        share = 1.0 if self.at_end else 0.0
        t, _ = self.road.borders(self.section, self.number(lane, incoming=incoming), share)
        heading = self.road.pose(self.s)[2]
        return (
            *self.road.point(self.s, t),
            heading if incoming == self.at_end else heading + math.pi,
        )


def fit(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[Piece, ...]:
    """A straight line, or a line, a quarter of a circle and a line, from one pose to another."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    along = dx * math.cos(a[2]) + dy * math.sin(a[2])
    aside = -dx * math.sin(a[2]) + dy * math.cos(a[2])
    if abs(aside) < 1e-9:
        return (Piece(along),)
    radius = min(along, abs(aside))
    curvature = math.copysign(1 / radius, aside)
    pieces = (
        Piece(along - radius),
        Piece(radius * math.pi / 2, curvature, curvature),
        Piece(abs(aside) - radius),
    )
    return tuple(p for p in pieces if p.length > 1e-9)


def side_lanes(a: Arm, b: Arm) -> list[tuple[Lane, int | None, int | None]]:
    """Lanes beside the outermost driving lane that run on from one arm to the other, with their numbers there.

    A lane that only one of the arms has opens or closes over the length of the connecting road.
    """

    def outside(arm: Arm, *, incoming: bool) -> dict[str, tuple[float, int]]:
        lanes = arm.side(incoming=incoming)
        return {
            lane.kind: (lane.width, arm.number(i, incoming=incoming))
            for i, lane in enumerate(lanes, 1)
            if lane.kind != "driving"
        }

    start, end = outside(a, incoming=True), outside(b, incoming=False)
    found = []
    for kind in sorted(dict.fromkeys((*start, *end)), key=lambda k: k == "sidewalk"):
        (w0, n0), (w1, n1) = start.get(kind, (0.0, None)), end.get(kind, (0.0, None))
        marks = () if kind == "sidewalk" else (Mark("curb", width=0.15),)
        found.append((Lane(kind, w0, w1, marks), n0, n1))
    return found


def connect(
    number: str, junction: str, a: Arm, b: Arm, lanes: list[tuple[int, int]], *, kerb: bool = False
) -> Road:
    """The connecting road from arm ``a`` to arm ``b`` for pairs of lanes (n-th in, m-th out).

    With ``kerb`` it also carries the lanes beside the carriageway: the sidewalk round a corner.
    """
    pieces = fit(a.pose(lanes[0][0], incoming=True), b.pose(lanes[0][1], incoming=False))
    right: list[Lane] = []
    links: dict[int, tuple[int | None, int | None]] = {}
    for i, (n, m) in enumerate(lanes, 1):
        w0, w1 = a.side(incoming=True)[n - 1].width, b.side(incoming=False)[m - 1].width
        right.append(Lane("driving", w0, w1, (Mark("none"),)))
        links[-i] = (a.number(n, incoming=True), b.number(m, incoming=False))
    for lane, n0, n1 in side_lanes(a, b) if kerb else ():
        if lane.kind == "sidewalk" and right[-1].kind == "driving":
            right[-1] = Lane("driving", right[-1].width, right[-1].end, (Mark("curb", width=0.15),))
        right.append(lane)
        links[-len(right)] = (n0, n1)
    return Road(
        id=number,
        name=f"{a.road.name} to {b.road.name}",
        start=a.pose(lanes[0][0], incoming=True),
        pieces=pieces,
        sections=(Section(0.0, (), (Mark("none"),), tuple(right)),),
        limit=min(a.road.limit, b.road.limit),
        junction=junction,
        before=("road", a.road.id, a.contact),
        after=("road", b.road.id, b.contact),
        links=links,
    )


def dashes(line: np.ndarray, dash: float, gap: float) -> list[np.ndarray]:
    """Pieces of a polyline, ``dash`` metres long with ``gap`` metres between them."""
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    cut = []
    for start in np.arange(0.0, at[-1] - 0.2, dash + gap):
        inside = at[(at > start) & (at < min(start + dash, at[-1]))]
        where = np.array([start, *inside, min(start + dash, at[-1])])
        cut.append(np.column_stack([np.interp(where, at, line[:, i]) for i in (0, 1)]))
    return cut
