"""The ground of the town as flat pieces, layer by layer: grass strips, lanes, paint, kerbs, sidewalks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from draw_map import Town, town
from road_model import Mark, Road, Section, dashes
from view import Colour, solid
from xodr import DASH, GAP

if TYPE_CHECKING:
    from collections.abc import Iterator

ASPHALT, PAVING, KERB = (96, 98, 102), (182, 174, 164), (206, 204, 198)
VERGE, BAY, PAINT = (112, 142, 84), (112, 110, 112), (236, 236, 230)
KERB_HEIGHT = 0.12
PIECE = 9.0
"""Longest piece of ground that is drawn in one colour; m."""


@dataclass(frozen=True)
class Patch:
    """A piece of ground: its corners, its colour, and a circle round it, which tells soon what is in sight."""

    corners: np.ndarray
    colour: Colour
    middle: np.ndarray
    radius: float


def patch(corners: np.ndarray, colour: Colour) -> Patch:
    """A piece of ground."""
    middle = corners.mean(0)
    return Patch(corners, colour, middle, float(np.hypot(*(corners - middle)[:, :2].T).max()))


def strips(inner: np.ndarray, outer: np.ndarray, colour: Colour, z: float = 0.0) -> Iterator[Patch]:
    """A strip between two lines, cut into pieces."""
    for (a, b), (d, c) in zip(pairwise(inner), pairwise(outer), strict=True):
        parts = max(1, math.ceil(math.dist(a, b) / PIECE))
        for i in range(parts):
            u, v = i / parts, (i + 1) / parts
            quad = np.array([a + (b - a) * u, a + (b - a) * v, d + (c - d) * v, d + (c - d) * u])
            yield patch(solid(quad, z), colour)


def ribbon(line: np.ndarray, width: float) -> Iterator[Patch]:
    """Paint along a line."""
    d = np.gradient(line, axis=0)
    normal = np.column_stack([-d[:, 1], d[:, 0]]) / np.hypot(*d.T)[:, None] * width / 2
    yield from strips(line + normal, line - normal, PAINT)


def border_marks(
    road: Road, section: Section, end: float
) -> Iterator[tuple[Mark, float, float, float]]:
    """The marks of a section's lane borders, each with where it starts and ends, and its ``t``."""
    lines = [(section.center, 0.0)]
    lines += [(section.lane(n).marks, road.borders(section, n, 0.0)[1]) for n in section.numbers]
    for marks, t in lines:
        bounds = [*(section.s + mark.s for mark in marks), end]
        for mark, (start, stop) in zip(marks, pairwise(bounds), strict=True):
            yield mark, start, stop, t


def painted(road: Road, section: Section, end: float) -> Iterator[Patch]:
    """The painted lines of a section; junctions have none."""
    for mark, start, stop, t in border_marks(road, section, end):
        if road.junction != "-1" or mark.kind in {"none", "curb"}:
            continue
        sides = (-mark.width, mark.width) if mark.kind == "solid solid" else (0.0,)
        for side in sides:
            line = road.line(start, stop, t + side)
            for piece in dashes(line, DASH, GAP) if mark.kind == "broken" else [line]:
                yield from ribbon(piece, mark.width)


def kerb(inner: np.ndarray) -> Iterator[Patch]:
    """Kerb stones along a sidewalk: an upright face."""
    for a, b in pairwise(inner):
        parts = max(1, math.ceil(math.dist(a, b) / PIECE))
        for i in range(parts):
            p, q = a + (b - a) * i / parts, a + (b - a) * (i + 1) / parts
            face = np.array([[*p, 0], [*q, 0], [*q, KERB_HEIGHT], [*p, KERB_HEIGHT]])
            yield patch(face, KERB)


def stripes(drawn: Town) -> Iterator[Patch]:
    """Crosswalks and stop lines."""
    for thing in (o for road in drawn.roads.values() for o in road.objects):
        road = drawn.roads[thing.road]
        half = float(thing.attributes["width"]) / 2
        depth = float(thing.attributes["length"]) / 2
        spans = [(-half, half)]
        if thing.attributes["type"] == "crosswalk":
            spans = [(float(t), float(t) + 0.5) for t in np.arange(-half + 0.35, half - 0.5, 1.0)]
        for low, high in spans:
            corners = ((-depth, low), (depth, low), (depth, high), (-depth, high))
            quad = np.array([road.point(thing.s + u, thing.t + v) for u, v in corners])
            yield patch(solid(quad), PAINT)


def middles(drawn: Town) -> Iterator[Patch]:
    """The middle of each junction, which no lane covers: between the ends of the roads' middle lines."""
    for junction in drawn.junctions:
        roads = {road.before[1]: drawn.roads[road.before[1]] for road in junction.roads}.values()
        here = ("junction", junction.id)
        points = np.array([
            road.pose(0.0 if road.before == here else road.length)[:2] for road in roads
        ])  # fmt: skip
        out = points - points.mean(0)
        yield patch(solid(points[np.argsort(np.arctan2(out[:, 1], out[:, 0]))]), ASPHALT)


@cache
def ground() -> tuple[list[Patch], ...]:
    """Layers of the ground, the lowest first."""
    drawn = town()
    colours = {"driving": ASPHALT, "none": VERGE, "parking": BAY}
    low, lanes, marks, walks = list(middles(drawn)), [], [], []
    for road in drawn.roads.values():
        for section, _, end in road.spans():
            marks += painted(road, section, end)
            for n in section.numbers:
                kind = section.lane(n).kind
                inner, outer = road.lane_strip(section, n)
                if kind == "sidewalk":
                    low += kerb(inner)
                    walks += strips(inner, outer, PAVING, KERB_HEIGHT)
                else:
                    layer = lanes if kind == "driving" else low
                    layer += strips(inner, outer, colours[kind])
    return low, lanes, [*marks, *stripes(drawn)], walks
