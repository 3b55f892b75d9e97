"""What stands still in the town: buildings, trees, and the masts of the traffic lights.

The list serves the ground truth (OSI stationary objects), the camera and the lidar alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

from draw_map import town

BRICK, CREAM, GREY, OCHRE = (164, 92, 74), (222, 208, 182), (176, 180, 184), (204, 166, 104)
ROSE, MINT, PALE, SLATE = (204, 150, 138), (168, 188, 170), (232, 228, 218), (136, 146, 158)
LEAVES = ((74, 122, 58), (92, 138, 62), (62, 108, 66))


@dataclass(frozen=True)
class Fixture:
    """Something that stands still: OSI type, middle of its footprint, heading, size in metres, colour (RGB).

    ``roof`` is how much higher than the eaves the ridge of a building is; m.
    """

    name: str
    osi_type: str
    x: float
    y: float
    heading: float
    length: float
    width: float
    height: float
    colour: tuple[int, int, int]
    roof: float = 0.0


HOUSES = (
    # north of Main Street
    (-262, 20, 30, 12, 9, CREAM, 3), (-222, 21, 36, 14, 12, BRICK, 0), (-180, 20, 28, 12, 6, OCHRE, 3),
    (-140, 21, 34, 14, 9, PALE, 3), (-98, 20, 30, 12, 12, SLATE, 0), (-52, 21, 36, 14, 9, ROSE, 3),
    # south of Main Street
    (-255, -20, 32, 12, 6, MINT, 3), (-212, -21, 34, 14, 9, GREY, 3), (-166, -20, 38, 12, 12, CREAM, 0),
    (-120, -21, 32, 14, 6, BRICK, 3), (-80, -20, 26, 12, 9, OCHRE, 3), (-42, -21, 30, 14, 12, PALE, 0),
    # around the junction
    (40, 21, 32, 14, 12, GREY, 0), (82, 26, 26, 14, 9, CREAM, 3), (42, -20, 34, 12, 9, BRICK, 3),
    (92, -20, 34, 12, 12, ROSE, 0), (-20, -62, 14, 34, 9, MINT, 0), (20, -58, 12, 28, 6, OCHRE, 0),
    # along North Street
    (-19, 58, 14, 30, 9, BRICK, 0), (-19, 98, 14, 32, 12, PALE, 0), (19, 56, 12, 32, 9, OCHRE, 0),
    (20, 96, 14, 30, 6, ROSE, 0),
    # along Park Lane
    (54, 127, 28, 13, 9, SLATE, 3), (98, 127, 30, 13, 6, CREAM, 3), (-12, 166, 26, 14, 9, MINT, 3),
    (28, 166, 30, 14, 12, GREY, 0), (70, 166, 32, 14, 6, BRICK, 3), (112, 166, 30, 14, 9, PALE, 3),
    (152, 168, 26, 14, 9, OCHRE, 3), (-44, 128, 26, 12, 9, ROSE, 3), (160, 125, 30, 16, 12, GREY, 0),
    (112, 92, 12, 30, 6, MINT, 0), (148, 94, 12, 30, 9, CREAM, 0),
)  # fmt: skip
"""Buildings: middle, length east, width north, height of the eaves, colour, height of the roof over them."""


def tree_places() -> list[tuple[float, float]]:
    """Where trees stand: in gardens along Main Street, on the grass strips of the other streets."""
    places = [(float(x), 11.3) for x in range(-270, -28, 30)] + [
        (float(x), -11.3) for x in range(-255, -28, 30)
    ]
    places += [(float(x), side * 11.3) for x in (36, 62) for side in (-1, 1)]
    places += [(-4.7, float(y)) for y in range(36, 122, 17)] + [
        (4.7, float(y)) for y in (36, 100, 114)
    ]
    places += [(side * 4.7, -y) for y in (40.0, 62.0) for side in (-1, 1)]
    places += [(float(x), 146 + side * 4.7) for x in (28, 45, 62, 90, 108) for side in (-1, 1)]
    places += [(130 + side * 4.7, y) for y in (88.0, 112.0) for side in (-1, 1)]
    return places


@cache
def fixtures() -> tuple[Fixture, ...]:
    """Everything that stands still."""
    houses = [
        Fixture(f"building{i}", "TYPE_BUILDING", x, y, 0.0, length, width, height, colour, roof)
        for i, (x, y, length, width, height, colour, roof) in enumerate(HOUSES, 1)
    ]
    trees = [
        Fixture(
            f"tree{i}", "TYPE_TREE", x, y, 0.0, 0.4, 0.4, 6.0 + (i * 7) % 3 * 0.8, LEAVES[i % 3]
        )
        for i, (x, y) in enumerate(tree_places(), 1)
    ]
    return (*houses, *trees, *(mast.pole for mast in masts()))


@dataclass(frozen=True)
class Mast:
    """A mast at the kerb with an arm over the road, from which lights hang."""

    pole: Fixture
    arm: tuple[tuple[float, float], tuple[float, float]]


@cache
def masts() -> tuple[Mast, ...]:
    """One mast for each street that comes to the lights, at its right kerb."""
    drawn = town()
    found = []
    for i, road in enumerate(dict.fromkeys(light.road for light in drawn.lights), 1):
        lights = [light for light in drawn.lights if light.road == road]
        side = math.copysign(1.0, lights[0].t)
        section, share = drawn.roads[road].section_at(lights[0].s)
        driving = [n for n in section.numbers if n * side > 0 and section.lane(n).kind == "driving"]
        kerb = max(abs(drawn.roads[road].borders(section, n, share)[1]) for n in driving)
        inner = min(abs(light.t) for light in lights)
        s = lights[0].s
        foot = drawn.roads[road].point(s, side * (kerb + 0.5))
        pole = Fixture(f"pole{i}", "TYPE_POLE", *foot, 0.0, 0.2, 0.2, 5.4, (96, 100, 104))
        found.append(Mast(pole, (foot, drawn.roads[road].point(s, side * inner))))
    return tuple(found)
