"""The ego's front camera: the scene drawn in perspective, as a JPEG picture.

Painter's algorithm: sky and hills, the ground layer by layer, then whatever stands or moves on it, the far
things first. Drawn at twice the size and scaled down.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np
from draw_map import Town, town
from ground import ASPHALT, ground
from scenery import Fixture, fixtures, masts
from shapes import Place, light, mast, panel, person, sign, tree, vehicle
from tracks import STEP, Track, box
from view import FOCAL, HEIGHT, OVERSAMPLING, WIDTH, Colour, Item, View, mixed, solid

if TYPE_CHECKING:
    from collections.abc import Iterator

    from road_model import Thing
    from traffic import Recording

MOUNT = (0.45, 1.42)
"""Where the camera sits: ahead of the middle of the ego's box, and above the ground; m."""
QUALITY = 66
"""Of the JPEG, 0 … 95."""
SIGHT = 260.0
"""How far the camera draws; m."""
LIGHT_HEIGHT = 4.95
"""Height of the middle of a traffic light; m."""

GRASS = (122, 148, 92)
SKY, HORIZON, CLOUD = (104, 156, 214), (214, 226, 236), (228, 236, 242)
HILLS = ((30, (168, 188, 204)), (17, (150, 176, 166)))
"""Height in pixels and colour of the ranges of hills, the farther first."""
PUFFS = ((0.0, 0.0, 1.0), (1.1, 4.0, 0.75), (-1.15, 5.0, 0.7), (0.4, -7.0, 0.7))
"""The parts of a cloud: aside, down, size."""


@dataclass(frozen=True)
class Wall:
    """A piece of a building's wall and the piece of roof above it."""

    face: np.ndarray
    roof: np.ndarray | None
    colour: Colour
    number: int


@cache
def walls() -> tuple[Wall, ...]:
    """The walls of all buildings, in pieces of some five metres, so that they can be sorted by distance."""
    found: list[Wall] = []
    for house in (f for f in fixtures() if f.osi_type == "TYPE_BUILDING"):
        corners = box((house.x, house.y, 0.0), house.length, house.width)[::-1]
        for side in range(4):
            a, b = corners[side], corners[(side + 1) % 4]
            parts = max(1, round(math.dist(a, b) / 5.0))
            for i in range(parts):
                p, q = a + (b - a) * i / parts, a + (b - a) * (i + 1) / parts
                face = np.array([[*p, 0], [*q, 0], [*q, house.height], [*p, house.height]])
                roof = roof_over(house, p, q) if house.roof > 0 else None
                found.append(Wall(face, roof, house.colour, len(found)))
    return tuple(found)


def roof_over(house: Fixture, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The piece of roof, or of gable, above the wall between p and q; the ridge runs along the house."""
    along = house.length >= house.width
    half = (house.width if along else house.length) / 2
    eaves = house.height

    def above(v: np.ndarray) -> tuple[float, float, float]:
        off = abs(v[1] - house.y) if along else abs(v[0] - house.x)
        if off > half - 1e-6 and abs((q - p)[0 if along else 1]) > 1e-6:
            ridge = (v[0], house.y) if along else (house.x, v[1])
            return (*ridge, eaves + house.roof)
        return v[0], v[1], eaves + house.roof * (1 - off / half)

    return np.array([[*p, eaves], [*q, eaves], above(q), above(p)])


def backdrop(view: View) -> None:
    """Sky, clouds, hills and grass."""
    width, horizon = WIDTH * OVERSAMPLING, view.centre[1]
    for row in range(HEIGHT * OVERSAMPLING):
        if row < horizon:
            colour = mixed(SKY, HORIZON, (row / horizon) ** 1.3)
        else:
            distance = view.eye[2] * view.focal / max(row - horizon, 1.0)
            colour = view.hazed(GRASS, min(distance, 900.0))
        view.canvas.line([(0, row), (width, row)], fill=colour)
    for number in range(9):
        cloud(view, number)
    columns = np.arange(0, width + 8, 8)
    azimuth = view.heading + np.arctan((view.centre[0] - columns) / view.focal)
    for rise, colour in HILLS:
        waves = 0.28 * np.sin(azimuth * 3 + rise) + 0.17 * np.sin(azimuth * 7.3 + 2 * rise)
        height = horizon - OVERSAMPLING * 0.8 * rise * (0.55 + waves)
        top = list(zip(columns.tolist(), height.tolist(), strict=True))
        view.canvas.polygon([*top, (width + 8, horizon + 2), (0, horizon + 2)], fill=colour)


def cloud(view: View, number: int) -> None:
    """A cloud that stays where it is as the ego turns."""
    off = math.remainder(number * 0.71 + 0.3 - view.heading, 2 * math.pi)
    if abs(off) > 1.0:
        return
    k, horizon = OVERSAMPLING, view.centre[1]
    x = view.centre[0] - math.tan(off) * view.focal
    y = horizon * (0.22 + 0.13 * (number % 4))
    for aside, down, size in PUFFS:
        w = (26 + 9 * (number % 3)) * size * k
        u, v = x + aside * 30 * k, y + down * k
        view.canvas.ellipse([u - w, v - w * 0.3, u + w, v + w * 0.3], fill=CLOUD)


def lay_ground(view: View) -> None:
    """Draw the ground that is in sight."""
    for layer in ground():
        for piece in layer:
            forward, left, _ = view.seen(piece.middle)[0]
            if -piece.radius < forward < SIGHT and abs(left) < forward * 0.85 + piece.radius + 3:
                view.polygon(piece.corners, piece.colour)


def in_sight(view: View, x: float, y: float, margin: float) -> bool:
    """Whether something ``margin`` metres large round a point can be in the picture."""
    forward, left, _ = view.seen(np.array([x, y, 0.0]))[0]
    edge = max(forward, 0.0) * WIDTH / 2 / FOCAL * 1.05
    return -margin < forward < SIGHT and abs(left) < edge + margin


def standing(view: View) -> Iterator[Item]:
    """Buildings, trees and masts in sight."""
    for wall in walls():
        x, y, z = wall.face.mean(0)
        if in_sight(view, x, y, 8.0) and view.faces(wall.face):
            draw = partial(panel, view, wall.face, wall.colour, wall.number, wall.roof)
            yield Item(view.depth((x, y, z)), draw)
    for fixture in fixtures():
        if fixture.osi_type == "TYPE_TREE" and in_sight(view, fixture.x, fixture.y, 3.0):
            yield Item(view.depth((fixture.x, fixture.y, 0.0)), partial(tree, view, fixture))
    for m in masts():
        if in_sight(view, *m.arm[1], 8.0):
            yield Item(view.depth((*m.arm[1], 2.0)) + 0.5, partial(mast, view, *m.arm))


def signals(view: View, lights: dict[str, str]) -> Iterator[Item]:
    """Traffic lights and signs in sight."""
    drawn = town()
    for thing in drawn.signals:
        x, y, facing = stand_of(drawn, thing)
        if not in_sight(view, x, y, 1.0):
            continue
        kind, ident = thing.attributes["type"], thing.attributes["id"]
        if ident in lights:
            draw = partial(light, view, Place(x, y, facing), LIGHT_HEIGHT, lights[ident])
        else:
            draw = partial(sign, view, Place(x, y, facing), kind, thing.attributes.get("value", ""))
        yield Item(view.depth((x, y, 2.0)), draw)


def stand_of(drawn: Town, thing: Thing) -> tuple[float, float, float]:
    """Where a signal stands and which way it looks: towards those it is for."""
    road = drawn.roads[thing.road]
    turned = math.pi if thing.attributes["orientation"] == "+" else 0.0
    return (*road.point(thing.s, thing.t), road.pose(thing.s)[2] + turned)


def moving(view: View, tracks: list[Track], ego: Track, time: float) -> Iterator[Item]:
    """Vehicles and people in sight; their shadows are drawn at once."""
    for track in tracks:
        pose = track.pose_at(time)
        if track is ego or pose is None or not in_sight(view, pose[0], pose[1], 8.0):
            continue
        around = box(pose, track.model.length + 0.25, track.model.width + 0.3) + np.array(
            [0.12, 0.18]
        )
        view.polygon(solid(around), mixed(ASPHALT, (0, 0, 0), 0.45))
        if track.model.osi_type == "TYPE_PEDESTRIAN":
            step = min(max(round(time / STEP) - track.first, 0), len(track.moves) - 1)
            pace = float(np.hypot(*track.moves[step, :2]))
            draw = partial(person, view, Place(*pose), track.model, pace, time)
        else:
            draw = partial(vehicle, view, Place(*pose), track.model, track.lights_at(time), time)
        yield Item(view.depth((pose[0], pose[1], 0.7)), draw)


def bonnet(view: View, colour: Colour) -> None:
    """The edge of the ego's own bonnet."""
    k = OVERSAMPLING
    w, h = WIDTH * k, HEIGHT * k
    curve = [(u, h - k * 13 * (1 - ((u - w / 2) / (w * 0.47)) ** 2)) for u in range(0, w + 1, 16)]
    view.canvas.polygon([(0, h), *curve, (w, h)], fill=mixed(colour, (60, 66, 74), 0.30))
    view.canvas.line(curve, fill=mixed(colour, (255, 255, 255), 0.2), width=2 * k)


def picture(recording: Recording, ego: Track, time: float) -> bytes:
    """What the camera sees at a time, as JPEG."""
    pose = ego.pose_at(time)
    if pose is None:
        raise ValueError(f"the ego is not there at {time} s")
    x, y, heading = pose
    ahead, up = MOUNT
    view = View((x + ahead * math.cos(heading), y + ahead * math.sin(heading), up), heading)
    backdrop(view)
    lay_ground(view)
    lights = recording.lights[min(round(time / STEP), len(recording.lights) - 1)]
    items = [*moving(view, recording.tracks, ego, time), *standing(view), *signals(view, lights)]
    for item in sorted(items, key=lambda i: -i.depth):
        item.draw()
    bonnet(view, ego.model.colour)
    out = io.BytesIO()
    view.finish().save(out, "JPEG", quality=QUALITY, optimize=True)
    return out.getvalue()
