"""How things look: vehicles, people, buildings, trees, lights and signs, from a few polygons each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from PIL import ImageFont
from view import Colour, View, inset, lit, mixed

if TYPE_CHECKING:
    from scenery import Fixture
    from tracks import Model

GLASS, TYRE, STEEL = (52, 66, 82), (30, 30, 32), (98, 102, 106)
BRAKE, TAIL, AMBER, LAMP = (255, 32, 24), (126, 22, 24), (255, 168, 32), (250, 246, 222)
SKIN, HAIR, TROUSERS = (224, 180, 150), (70, 48, 36), (48, 50, 60)
LENSES = {"r": (255, 48, 36), "y": (255, 196, 40), "g": (48, 226, 110)}
DARK = {"r": (70, 26, 24), "y": (70, 58, 24), "g": (22, 58, 36)}
SIGN_RED, SIGN_BLUE, SIGN_YELLOW = (196, 28, 36), (32, 84, 168), (238, 192, 40)


@dataclass(frozen=True)
class Place:
    """Axes of a thing: its position on the ground and its heading."""

    x: float
    y: float
    heading: float

    def world(self, points: np.ndarray) -> np.ndarray:
        """Points given as forward, left, up of the thing, in map axes."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + (
            self.x,
            self.y,
            0.0,
        )


def prism(
    x: tuple[float, float],
    y: float,
    z: tuple[float, float],
    taper: tuple[float, float, float] = (0, 0, 0),
) -> dict[str, np.ndarray]:
    """Faces of a box from x[0] to x[1], ±y, z[0] to z[1], by name.

    ``taper`` says how far its top is drawn in at rear, front and sides.
    Corners of each face run counter-clockwise seen from outside, the first edge being the lower one.
    """
    rear, front, side = taper
    low = {(i, j): np.array([x[i], (y, -y)[j], z[0]]) for i in (0, 1) for j in (0, 1)}
    high = {
        (i, j): np.array([x[0] + rear if i == 0 else x[1] - front, (y - side, side - y)[j], z[1]])
        for i in (0, 1) for j in (0, 1)
    }  # fmt: skip
    return {
        "front": np.array([low[1, 1], low[1, 0], high[1, 0], high[1, 1]]),
        "rear": np.array([low[0, 0], low[0, 1], high[0, 1], high[0, 0]]),
        "left": np.array([low[1, 0], low[0, 0], high[0, 0], high[1, 0]]),
        "right": np.array([low[0, 1], low[1, 1], high[1, 1], high[0, 1]]),
        "top": np.array([high[0, 1], high[1, 1], high[1, 0], high[0, 0]]),
    }


def paint(
    view: View, place: Place, faces: dict[str, np.ndarray], colour: Colour
) -> dict[str, np.ndarray]:
    """Draw the faces that can be seen; returns them in map axes, by name."""
    shown = {}
    for name, face in faces.items():
        corners = place.world(face)
        if view.faces(corners):
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            view.polygon(corners, lit(colour, normal))
            shown[name] = corners
    return shown


def wheels(view: View, place: Place, model: Model, radius: float, axles: tuple[float, ...]) -> None:
    """The wheels on the side that can be seen."""
    angle = np.linspace(0, 2 * math.pi, 14, endpoint=False)
    for side in (1, -1):
        y = side * (model.width / 2 + 0.01)
        side_face = place.world(
            prism((-1, 1), model.width / 2, (0, 1))["left" if side > 0 else "right"]
        )
        if not view.faces(side_face):
            continue
        for axle in axles:
            for r, colour in ((radius, TYRE), (radius * 0.55, (150, 152, 156))):
                rim = axle + r * np.cos(angle), np.full(14, y), radius + r * np.sin(angle)
                view.polygon(place.world(np.column_stack(rim)), colour)


def lamps(view: View, shown: dict[str, np.ndarray], lights: str, time: float, high: float) -> None:
    """Lamps at rear and front; indicators blink at 1.5 Hz."""
    blink = (time * 1.5) % 1.0 < 0.5
    for end, left in (("rear", 0), ("front", 1)):
        if end not in shown:
            continue
        face = shown[end]
        for share in (0, 1):
            u = (0.03, 0.2) if share == 0 else (0.8, 0.97)
            on = ("b" in lights) if end == "rear" else True
            colour = (BRAKE if on else TAIL) if end == "rear" else LAMP
            view.polygon(inset(face, *u, high, high + 0.2), colour)
            turns = "l" if share == left else "r"
            if turns in lights and blink:
                u = (0.0, 0.09) if share == 0 else (0.91, 1.0)
                view.polygon(inset(face, *u, high - 0.02, high + 0.2), AMBER)
        low = max(high - 0.28, 0.02)
        view.polygon(
            inset(face, 0.4, 0.6, low, low + 0.035 * 3 / np.ptp(face[:, 2])), (236, 236, 230)
        )


def car(view: View, place: Place, model: Model, lights: str, time: float) -> None:
    """A passenger car: a body, a cabin of glass with a roof, wheels, lamps."""
    half, y, h = model.length / 2, model.width / 2, model.height
    rear, front = (0.42, 0.62) if model.name == "small" else (0.62, 0.78)
    body = prism((-half, half), y, (0.22, 0.58 * h), (0.08, 0.12, 0.04))
    shown = paint(view, place, body, model.colour)
    wheels(view, place, model, 0.33, (-half + 0.85, half - 0.85))
    lamps(view, shown, lights, time, 0.62)
    back = -half + (0.12 if model.name == "small" else 0.45)
    cabin = prism((back, half * 0.42), y - 0.06, (0.56 * h, h), (rear * 0.7, front, 0.2))
    for name, face in paint(view, place, cabin, model.colour).items():
        if name == "top":
            continue
        edges = (0.06, 0.94) if name in {"front", "rear"} else (0.05, 0.48)
        view.polygon(inset(face, *edges, 0.1, 0.88), GLASS)
        if name in {"left", "right"}:
            view.polygon(inset(face, 0.53, 0.95, 0.1, 0.88), GLASS)


def van(view: View, place: Place, model: Model, lights: str, time: float) -> None:
    """A delivery van."""
    half, y, h = model.length / 2, model.width / 2, model.height
    shown = paint(view, place, prism((-half, half), y, (0.28, h), (0.05, 0.75, 0.08)), model.colour)
    wheels(view, place, model, 0.36, (-half + 1.0, half - 1.0))
    lamps(view, shown, lights, time, 0.3)
    windows = {
        "front": (0.08, 0.92),
        "rear": (0.1, 0.9),
        "left": (0.04, 0.24),
        "right": (0.76, 0.96),
    }
    for name, face in shown.items():
        if name in windows:
            view.polygon(inset(face, *windows[name], 0.55, 0.88), GLASS)


def truck(view: View, place: Place, model: Model, lights: str, time: float) -> None:
    """A truck: a cab and a box; the farther one first."""
    half, y, h = model.length / 2, model.width / 2, model.height
    wheels(view, place, model, 0.48, (-half + 1.2, -half + 2.4, half - 1.1))

    def cab() -> None:
        case = prism((half - 2.0, half), y - 0.05, (0.4, h * 0.82), (0, 0.15, 0.05))
        shown = paint(view, place, case, model.colour)
        lamps(view, {k: v for k, v in shown.items() if k == "front"}, lights, time, 0.2)
        for name, face in shown.items():
            window = {"front": (0.06, 0.94), "left": (0.1, 0.6), "right": (0.4, 0.9)}.get(name)
            if window:
                view.polygon(inset(face, *window, 0.5, 0.9), GLASS)

    def box() -> None:
        shown = paint(view, place, prism((-half, half - 2.2), y, (0.75, h)), (226, 224, 218))
        if "rear" in shown:
            bar = place.world(prism((-half, -half + 0.1), y, (0.45, 0.85))["rear"])
            view.polygon(bar, TYRE)
            lamps(view, {"rear": bar}, lights, time, 0.3)

    ahead = view.forward((place.x, place.y, 0)) < view.forward(
        tuple(place.world(np.array([half, 0, 0])))
    )
    for part in (cab, box) if ahead else (box, cab):
        part()


def bus(view: View, place: Place, model: Model, lights: str, time: float) -> None:
    """A city bus with a row of windows."""
    half, y, h = model.length / 2, model.width / 2, model.height
    shown = paint(view, place, prism((-half, half), y, (0.3, h), (0.03, 0.1, 0.05)), model.colour)
    wheels(view, place, model, 0.5, (-half + 2.8, half - 2.6))
    lamps(view, shown, lights, time, 0.14)
    for name, face in shown.items():
        if name in {"left", "right"}:
            for i in range(6):
                view.polygon(inset(face, 0.03 + i * 0.16, 0.165 + i * 0.16, 0.42, 0.84), GLASS)
        elif name in {"front", "rear"}:
            view.polygon(inset(face, 0.06, 0.94, 0.36, 0.78), GLASS)
            view.polygon(inset(face, 0.25, 0.75, 0.84, 0.95), (34, 34, 30))


def two_wheeler(view: View, place: Place, model: Model, lights: str, time: float) -> None:
    """A bicycle or a motorcycle with its rider."""
    half, motor = model.length / 2, model.name == "motorcycle"
    radius = 0.33
    angle = np.linspace(0, 2 * math.pi, 15)
    for axle in (-half + radius, half - radius):
        ring = axle + radius * np.cos(angle), np.zeros(15), radius + radius * np.sin(angle)
        view.line(place.world(np.column_stack(ring)), TYRE, 0.16 if motor else 0.06)
    rear, fork, bar = -half + radius, half - radius - 0.2, half - 0.5
    frame = [
        [rear, 0, radius],
        [-0.05, 0, 0.32],
        [fork, 0, 0.85],
        [-0.25, 0, 0.8],
        [rear, 0, radius],
    ]
    view.line(place.world(np.array(frame)), model.colour, 0.3 if motor else 0.07)
    view.line(place.world(np.array([[bar, -0.28, 1.0], [bar, 0.28, 1.0]])), STEEL, 0.05)
    swing = math.sin(time * 7.0) * (0.0 if motor else 0.14)
    for side in (-1, 1):
        foot = [0.02, side * 0.12, 0.33 + side * swing]
        leg = np.array([[-0.2, side * 0.1, 0.92], [0.16, side * 0.14, 0.66], foot])
        arm = np.array([[0.02, side * 0.2, 1.35], [bar, side * 0.26, 1.02]])
        view.line(place.world(leg), TROUSERS, 0.15)
        view.line(place.world(arm), model.colour, 0.1)
    view.line(place.world(np.array([[-0.24, 0, 0.95], [0.0, 0, 1.38]])), model.colour, 0.36)
    helmet = (240, 240, 240) if motor else (212, 60, 40)
    view.disc(place.world(np.array([[0.1, 0, 1.6]]))[0], 0.14, helmet)
    if motor:
        lamp = BRAKE if "b" in lights else TAIL
        view.disc(place.world(np.array([[-half + 0.1, 0, 0.72]]))[0], 0.06, lamp)


def person(view: View, place: Place, model: Model, pace: float, time: float) -> None:
    """Someone on foot; legs and arms swing with the pace."""
    h = model.height
    beat = math.sin(time * 2 * math.pi * 0.95 + place.x + place.y)
    swing = 0.24 * min(pace / 1.3, 1.2) * beat
    sleeve = mixed(model.colour, (0, 0, 0), 0.15)
    for side in (-1, 1):
        step, out = side * swing, side * 0.05
        leg = h * np.array([[0, out, 0.5], [0.3 * step, out, 0.27], [0.9 * step, out, 0.02]])
        arm = h * np.array(
            [[0, 2.3 * out, 0.79], [-0.4 * step, 3 * out, 0.6], [-0.6 * step, 2.8 * out, 0.46]]
        )
        view.line(place.world(leg), TROUSERS, 0.085 * h)
        view.line(place.world(arm), sleeve, 0.055 * h)
    torso = prism((-0.07 * h, 0.06 * h), 0.095 * h, (0.48 * h, 0.82 * h), (0.0, 0.0, -0.02 * h))
    paint(view, place, torso, model.colour)
    view.line(place.world(np.array([[0, 0, 0.84 * h], [0.01, 0, 0.88 * h]])), SKIN, 0.06 * h)
    head = [((0.02, 0.925, 0.07), SKIN), ((-0.025, 0.95, 0.066), HAIR)]
    if view.depth(place.world(np.array([[1.0, 0, 0]]))[0]) < view.depth((place.x, place.y, 0)):
        head.reverse()
    for (ahead, up, radius), colour in head:
        view.disc(place.world(np.array([[ahead, 0, up * h]]))[0], radius * h, colour)


PAINTERS = {
    "van": van,
    "truck": truck,
    "bus": bus,
    "bicycle": two_wheeler,
    "motorcycle": two_wheeler,
}


def vehicle(view: View, place: Place, model: Model, lights: str, time: float) -> None:
    """Any vehicle."""
    PAINTERS.get(model.name, car)(view, place, model, lights, time)


def panel(
    view: View, face: np.ndarray, colour: Colour, number: int, roof: np.ndarray | None
) -> None:
    """A piece of a building's wall with its windows, and of the roof above it."""
    normal = np.cross(face[1] - face[0], face[2] - face[0])
    wall = lit(colour, normal)
    view.polygon(face, wall)
    view.polygon(inset(face, 0, 1, 0, 0.06), lit(mixed(colour, (60, 60, 60), 0.45), normal))
    if view.depth(face.mean(0)) < 130:
        glass, trim = lit((84, 104, 122), normal), mixed(wall, (255, 255, 255), 0.35)
        floors = max(1, round(float(face[2][2]) / 3))
        for floor in range(floors):
            high = (floor + 0.8) / floors
            for k in (0, 1):
                u = 0.14 + 0.46 * k
                door = floor == 0 and k == 0 and number % 3 == 1
                low = 0.0 if door else (floor + 0.32) / floors
                view.polygon(
                    inset(face, u - 0.02, u + 0.28, max(low - 0.012, 0), high + 0.012), trim
                )
                view.polygon(inset(face, u, u + 0.26, low, high), (88, 60, 48) if door else glass)
    if roof is not None:
        view.polygon(roof, (142, 84, 66))
    else:
        view.polygon(inset(face, 0, 1, 0.965, 1.0), lit(mixed(colour, (40, 40, 40), 0.3), normal))


def tree(view: View, fixture: Fixture) -> None:
    """A round-headed tree."""
    x, y, h = fixture.x, fixture.y, fixture.height
    view.line(np.array([[x, y, 0.0], [x, y, 0.5 * h]]), (98, 74, 54), 0.32)
    dark, light = (
        mixed(fixture.colour, (20, 40, 20), 0.35),
        mixed(fixture.colour, (220, 230, 120), 0.22),
    )
    side = np.array([-math.sin(view.heading), math.cos(view.heading), 0.0])
    for shift, up, radius, colour in ((0.0, 0.6, 1.75, dark), (0.75, 0.66, 1.25, fixture.colour),
                                      (-0.8, 0.62, 1.2, fixture.colour), (0.1, 0.78, 1.25, fixture.colour),
                                      (0.45, 0.8, 0.8, light)):  # fmt: skip
        view.disc(np.array([x, y, up * h]) + side * shift, radius * h / 6.5, colour)


def mast(view: View, foot: tuple[float, float], end: tuple[float, float]) -> None:
    """A mast with an arm over the road."""
    view.line(np.array([[*foot, 0.0], [*foot, 5.4]]), STEEL, 0.18)
    view.line(np.array([[*foot, 5.3], [*end, 5.3]]), STEEL, 0.12)


def light(view: View, place: Place, z: float, state: str) -> None:
    """A traffic light that shows ``r``, ``y`` or ``g`` the way it faces; from behind, its back."""
    case = prism((-0.1, 0.1), 0.2, (z - 0.45, z + 0.45))
    paint(view, place, case, (34, 38, 36))
    front = place.world(case["front"])
    if not view.faces(front):
        return
    view.polygon(front, (22, 24, 24))
    for letter, up in (("r", 0.28), ("y", 0.0), ("g", -0.28)):
        centre = place.world(np.array([[0.12, 0.0, z + up]]))[0]
        if letter == state:
            view.disc(centre, 0.2, mixed(LENSES[letter], (22, 24, 24), 0.6))
        view.disc(centre, 0.14, LENSES[letter] if letter == state else DARK[letter])


def plate(place: Place, z: float, ring: tuple[int, float, float], off: float) -> np.ndarray:
    """Corners of a plate: a regular polygon (corners, radius, turn) that stands ``off`` before its place."""
    corners, radius, turn = ring
    angle = np.linspace(0, 2 * math.pi, corners, endpoint=False) + turn
    flat = np.column_stack(
        [np.full(corners, off), radius * np.cos(angle), z + radius * np.sin(angle)]
    )
    return place.world(flat)


PLATES = {
    "206": ((8, 0.42, math.pi / 8, (245, 245, 245)), (8, 0.38, math.pi / 8, SIGN_RED)),
    "205": ((3, 0.46, -math.pi / 2, SIGN_RED), (3, 0.27, -math.pi / 2, (248, 248, 244))),
    "274": ((16, 0.36, 0.0, SIGN_RED), (16, 0.27, 0.0, (248, 248, 244))),
    "306": ((4, 0.42, 0.0, (248, 248, 244)), (4, 0.32, 0.0, SIGN_YELLOW)),
    "350": ((4, 0.46, math.pi / 4, SIGN_BLUE), (3, 0.28, math.pi / 2, (248, 248, 244))),
}
"""What signs look like, by their number in the StVO: corners, radius, turn and colour of plate and face."""


def sign(view: View, place: Place, kind: str, value: str) -> None:
    """A German traffic sign on its pole; from behind, the grey back of its plate."""
    x, y, z = place.x, place.y, 2.4
    view.line(np.array([[x, y, 0.0], [x, y, z]]), STEEL, 0.07)
    back, face = PLATES[kind]
    if not view.faces(place.world(prism((-0.1, 0.1), 0.2, (1, 2))["front"])):
        view.polygon(plate(place, z, back[:3], 0.01), (120, 122, 124))
        return
    view.polygon(plate(place, z, back[:3], 0.01), back[3])
    view.polygon(plate(place, z, face[:3], 0.02), face[3])
    text = {"206": "STOP", "274": value}.get(kind, "")
    seen = view.seen(np.array([x, y, z]))
    if text and 1.0 < seen[0, 0] < 18:
        ((u, v),) = view.pixels(seen)
        size = (0.22 if kind == "206" else 0.3) * view.focal / float(seen[0, 0])
        ink = (250, 250, 250) if kind == "206" else (20, 20, 20)
        view.canvas.text((u, v), text, fill=ink, font=ImageFont.load_default(size), anchor="mm")
