"""A pinhole camera that draws polygons, lines and discs of the world, the far ones first."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

WIDTH, HEIGHT = 480, 270
FOCAL = 300.0
"""Focal length in pixels of the finished picture: 77° from side to side."""
CENTRE = (240.0, 135.0)
"""Where the optical axis meets the picture; pixels."""
OVERSAMPLING = 2
NEAR = 0.25
HAZE = np.array([205.0, 216.0, 226.0])
SUN = np.array([-0.45, -0.65, 0.61])
"""Direction to the sun."""

Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Item:
    """Something to draw, and how far away it is."""

    depth: float
    draw: Callable[[], None]


def mixed(a: Sequence[float], b: Sequence[float], share: float) -> Colour:
    """Colour a with a share of b."""
    share = min(max(share, 0.0), 1.0)
    red, green, blue = (round(x + (y - x) * share) for x, y in zip(a, b, strict=True))
    return red, green, blue


def lit(colour: Colour, normal: np.ndarray) -> Colour:
    """A colour as the sun shows it on a face with this normal."""
    size = float(np.linalg.norm(normal))
    bright = 0.60 + 0.42 * max(0.0, float(normal @ SUN) / size if size else 0.0)
    if bright <= 1:
        return mixed((0, 0, 0), colour, bright)
    return mixed(colour, (255, 255, 255), bright - 1)


class View:
    """A picture in the making, seen from a point ``eye`` (x, y, z; m) towards ``heading`` (rad)."""

    def __init__(self, eye: tuple[float, float, float], heading: float) -> None:
        k = OVERSAMPLING
        self.eye = np.array(eye)
        self.heading = heading
        self.image = Image.new("RGB", (WIDTH * k, HEIGHT * k))
        self.canvas = ImageDraw.Draw(self.image)
        self.focal = FOCAL * k
        self.centre = (CENTRE[0] * k, CENTRE[1] * k)
        c, s = math.cos(heading), math.sin(heading)
        self.axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Points as forward, left, up of the camera."""
        return (np.atleast_2d(points) - self.eye) @ self.axes.T

    def pixels(self, seen: np.ndarray) -> list[tuple[float, float]]:
        """Where points before the camera fall on the canvas."""
        scale = self.focal / seen[:, 0]
        u, v = self.centre[0] - seen[:, 1] * scale, self.centre[1] - seen[:, 2] * scale
        return list(zip(u.tolist(), v.tolist(), strict=True))

    def hazed(self, colour: Colour, distance: float) -> Colour:
        """A colour through the air between."""
        return mixed(colour, HAZE, 1 - math.exp(-max(distance - 15.0, 0.0) / 330.0))

    def polygon(self, points: np.ndarray, colour: Colour) -> None:
        """Fill a flat polygon, ``(n, 3)``."""
        seen = self.seen(points)
        if seen[:, 0].max() < NEAR:
            return
        distance = float(seen[:, 0].clip(NEAR).mean())
        clipped = seen if seen[:, 0].min() >= NEAR else clip(seen)
        if len(clipped) > 2:
            fill = self.hazed(colour, distance)
            self.canvas.polygon(self.pixels(clipped), fill=fill, outline=fill)

    def line(self, points: np.ndarray, colour: Colour, width: float) -> None:
        """Draw a line ``width`` metres thick, with round ends."""
        seen = self.seen(points)
        if seen[:, 0].min() < NEAR:
            return
        thick = width * self.focal / float(seen[:, 0].mean())
        fill = self.hazed(colour, float(seen[:, 0].mean()))
        pixels = self.pixels(seen)
        self.canvas.line(pixels, fill=fill, width=max(1, round(thick)), joint="curve")
        if thick > 3:
            for u, v in (pixels[0], pixels[-1]):
                self.dot(u, v, thick / 2, fill)

    def disc(self, point: Sequence[float], radius: float, colour: Colour) -> None:
        """Fill a disc that faces the camera."""
        seen = self.seen(np.array(point))
        if seen[0, 0] < NEAR:
            return
        ((u, v),) = self.pixels(seen)
        r = max(radius * self.focal / float(seen[0, 0]), 0.7)
        self.dot(u, v, r, self.hazed(colour, float(seen[0, 0])))

    def dot(self, u: float, v: float, radius: float, fill: Colour) -> None:
        """Fill a disc of the canvas; pixels."""
        self.canvas.ellipse([u - radius, v - radius, u + radius, v + radius], fill=fill)

    def depth(self, point: Sequence[float]) -> float:
        """Distance to a point; m."""
        return float(np.linalg.norm(np.array(point) - self.eye))

    def forward(self, point: Sequence[float]) -> float:
        """How far ahead a point lies; m."""
        return float(self.seen(np.array(point))[0, 0])

    def faces(self, corners: np.ndarray) -> bool:
        """Whether the outside of a face (corners counter-clockwise seen from outside) can be seen."""
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        return bool(normal @ (self.eye - corners[0]) > 0)

    def finish(self) -> Image.Image:
        """The picture in its proper size."""
        return self.image.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)


def clip(seen: np.ndarray) -> np.ndarray:
    """The part of a polygon that lies before the camera."""
    out: list[np.ndarray] = []
    for a, b in zip(seen, np.roll(seen, -1, axis=0), strict=True):
        if a[0] >= NEAR:
            out.append(a)
        if (a[0] >= NEAR) != (b[0] >= NEAR):
            out.append(a + (b - a) * (NEAR - a[0]) / (b[0] - a[0]))
    return np.array(out) if out else np.zeros((0, 3))


def solid(points: np.ndarray, z: float = 0.0) -> np.ndarray:
    """Points of the plane at a height."""
    return np.column_stack([points, np.full(len(points), z)])


def inset(face: np.ndarray, u0: float, u1: float, v0: float, v1: float) -> np.ndarray:
    """Part of a four-cornered face: shares ``u`` from its first to its second corner, ``v`` to its fourth."""
    a, b, c, d = face
    return np.array([
        (a + (b - a) * u) * (1 - v) + (d + (c - d) * u) * v for u, v in ((u0, v0), (u1, v0), (u1, v1), (u0, v1))
    ])  # fmt: skip
