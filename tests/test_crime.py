"""Measures of criticality beside those of CommonRoad-CriMe 0.4.5 on its own scenarios.

``golden/crime.jsonl.xz`` is what that package says (``crime_values.py`` wrote it), each row a scenario, an
ego, another obstacle, a step, and values by name. Where it differs from ours, its number is made here again
from the same states and some of these causes, by its own definition:

* ``last step``: its loop ends before the last step of the ego.
* ``circles``: who walks is a circle of half its radius in DCE, and a box here; in WTTC a vehicle is a circle
  around a third of its box.
* ``set``: of the other one a set of places is told, where it may be, and no trajectory, which we do not read.
* ``tie``: the gap is the least twice, to a tenth of a millimetre.
* ``rounded``: WTTC is rounded to as many digits as the length of a step has.
* ``stands``: in WTTC what is a static obstacle does not accelerate.
* ``first root``: of the roots of WTTC's quartic the first one that is listed, and not the least; never 0.
* ``speed as vx``: of states that tell no more than place, orientation, speed and acceleration, the velocity
  is (v, v sin ψ) instead of (v cos ψ, v sin ψ).
* ``sum``: ΔV adds the speeds of two that drive in one direction, instead of taking their difference.

The file has 19 of the 24 scenarios, and of those with many obstacles some egos only (``CRIME_PAIRS=30``).
Measures along the lane (HW, TTC, THW, required accelerations, MSD) and those of areas of lanelets (ET, PET,
PSD, CI) are in the file, too; ours are along the ego's axis and of footprints, and are not compared here.
"""

from __future__ import annotations

import json
import lzma
import math
import os
from collections import Counter
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from thorough import some

from sgstore.criticality import Encounter, Track, dce_recorded, ttc_recorded, ttce_recorded
from sgstore.pair_numbers import PairNumbers
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.world import Floats

DATA = Path(os.environ.get("SGSTORE_DATA") or Path(__file__).parents[2] / "shared/data")
FOLDER = DATA / "commonroad"
GOLDEN = Path(__file__).parent / "golden" / "crime.jsonl.xz"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no scenarios in {FOLDER}")
COLUMNS = ("x", "y", "z", "heading", "length", "width", "vx", "vy", "ax", "ay")
NEAR = 0.01 + 1e-9


class Known(NamedTuple):
    """A scenario as we read it, and what its document says beside."""

    tracks: dict[str, Track]
    standing: dict[str, Floats]
    step: float
    radius: dict[str, float]
    plain: set[str]
    sets: set[str]


@cache
def known(stem: str) -> Known:
    path = FOLDER / f"{stem}.xml"
    found: dict[str, list[tuple[float, Floats]]] = {}
    standing: dict[str, Floats] = {}
    idents: list[str] = []
    with open_trace(path) as trace:
        for block in trace.blocks():
            idents += block.entities.ident
            rows = np.stack([getattr(block.states, name) for name in COLUMNS], axis=1)
            for frame, time in enumerate(block.time_ns.tolist()):
                for row in range(*block.offsets[frame : frame + 2].tolist()):
                    ident = idents[int(block.states.node[row])]
                    found.setdefault(ident, []).append((time / 1e9, rows[row]))
            pose = [getattr(block.scenery, name) for name in COLUMNS[:6]]
            for row, node in enumerate(block.scenery.node.tolist()):
                standing[idents[node]] = np.array([*(one[row] for one in pose), 0, 0, 0, 0])
    root = ET.parse(path).getroot()
    obstacles = [one for one in root if one.tag.endswith("bstacle")]
    told = {"time", "position", "orientation", "velocity", "acceleration"}
    return Known(
        {
            ident: Track(np.array([t for t, _ in rows]), np.array([row for _, row in rows]))
            for ident, rows in found.items()
        },
        standing,
        float(root.attrib["timeStepSize"]),
        {
            one.attrib["id"]: float(one.findtext("shape/circle/radius") or 0)
            for one in obstacles
            if one.find("shape/circle") is not None
        },
        {
            one.attrib["id"]
            for one in obstacles
            if all({part.tag for part in s} == told for s in one.findall("trajectory/state"))
        },
        {one.attrib["id"] for one in obstacles if one.find("occupancySet") is not None},
    )


class Case(NamedTuple):
    """An ego and another obstacle from a step on."""

    scenario: Known
    ids: tuple[str, str]
    encounter: Encounter
    told: dict[str, float]

    @property
    def states(self) -> tuple[Floats, Floats]:
        return self.encounter.a.states[0], self.encounter.b.states[0]

    def velocity(self, side: int) -> complex:
        """The velocity that the other package takes."""
        state = self.states[side]
        right = complex(*state[6:8])
        if self.ids[side] not in self.scenario.plain:
            return right
        speed = (right * np.exp(-1j * state[3])).real
        return complex(speed, speed * math.sin(state[3]))


def cases(measure: str) -> Iterator[Case]:
    with lzma.open(GOLDEN, "rt", encoding="utf-8") as lines:
        rows = [json.loads(line) for line in lines]
    for stem, ego, other, step, told in some([row for row in rows if measure in row[4]], 7):
        scenario = known(stem)
        a = from_step(scenario.tracks[str(ego)], step * scenario.step)
        if other is None:
            yield Case(scenario, (str(ego), ""), Encounter(a, a), told)
            continue
        if str(other) in scenario.standing:
            b = Track(a.times, np.repeat(scenario.standing[str(other)][None], len(a), axis=0))
        else:
            b = from_step(scenario.tracks[str(other)], step * scenario.step)
        yield Case(scenario, (str(ego), str(other)), Encounter(a, b), told)


def from_step(track: Track, time: float) -> Track:
    row = int(np.searchsorted(track.times, time - 1e-6))
    assert track.times[row] == pytest.approx(time)
    return Track(track.times[row:], track.states[row:])


def shorter(case: Case) -> Encounter:
    a = case.encounter.a
    return Encounter(Track(a.times[:-1], a.states[:-1]), case.encounter.b)


def near(ours: Any, theirs: float, by: float = NEAR) -> bool:
    return bool(abs(float(ours) - theirs) <= by)


def dce(case: Case) -> str:
    theirs = case.told["DCE"]
    if near(dce_recorded(case.encounter)[0], theirs):
        return "equal"
    early = dce_recorded(shorter(case))
    if len(early) and near(early[0], theirs):
        return "last step"
    if case.ids[1] in case.scenario.sets:
        return "set"
    points = [
        Track(
            track.times,
            track.states * [1, 1, 1, 1, 0, 0, 1, 1, 1, 1]
            if ident in case.scenario.radius
            else track.states,
        )
        for ident, track in zip(case.ids, (shorter(case).a, case.encounter.b), strict=True)
    ]
    half = sum(case.scenario.radius.get(one, 0) for one in case.ids) / 2
    round_ones = dce_recorded(Encounter(*points))
    return "circles" if half and near(round_ones[0] - half, theirs) else "unexplained"


def ttce(case: Case) -> str:
    theirs = case.told["TTCE"]
    if near(ttce_recorded(case.encounter)[0], theirs):
        return "equal"
    early = ttce_recorded(shorter(case))
    if not len(early) or near(early[0], theirs):
        return "last step"
    if case.ids[1] in case.scenario.sets:
        return "set"
    encounter = shorter(case)
    at = int(np.argmin(np.abs(encounter.times - encounter.times[0] - theirs)))
    return (
        "tie"
        if near(encounter.numbers["gap"][at], dce_recorded(encounter)[0], 1e-4)
        else "unexplained"
    )


def wttc(case: Case) -> str:
    theirs = case.told["WTTC"]
    a, b = case.states
    ours = PairNumbers(a[None], b[None])["wttc"][0]
    if near(ours, theirs):
        return "equal"
    digits = str(case.scenario.step)[::-1].find(".")
    for speeds in ((complex(*a[6:8]), complex(*b[6:8])), (case.velocity(0), case.velocity(1))):
        roots = worst_roots(case, speeds)
        least = min(roots, default=math.nan)
        cause = "circles, rounded"
        cause += ", stands" if case.ids[1] in case.scenario.standing else ""
        cause += "" if speeds[0] == complex(*a[6:8]) else ", speed as vx"
        for root, more in ((least, ""), *((one, ", first root") for one in roots)):
            if near(math.floor(root * 10**digits + 0.5) / 10**digits, theirs):
                return cause + more
    return "unexplained"


def worst_roots(case: Case, velocity: tuple[complex, complex]) -> list[float]:
    """Positive roots of the quartic of discs that grow, by the sizes that the other package takes."""
    a, b = case.states
    radii = [
        case.scenario.radius.get(one) or math.hypot(state[4] / 6, state[5] / 2)
        for one, state in zip(case.ids, (a, b), strict=True)
    ]
    push = 11.5 if case.ids[1] in case.scenario.standing else 23.0
    place, speed = complex(*(b - a)[:2]), velocity[1] - velocity[0]
    dotted = 2 * (place.real * speed.real + place.imag * speed.imag)
    reach = sum(radii)
    found = np.roots(
        [-(push**2) / 4, 0, abs(speed) ** 2 - push * reach, dotted, abs(place) ** 2 - reach**2]
    )
    return sorted(root.real for root in found if abs(root.imag) < 1e-9 and root.real > 0)


def delta_v(case: Case) -> str:
    theirs = case.told["DeltaV"]
    a, b = case.states
    if near(PairNumbers(a[None], b[None])["delta_v"][0], theirs):
        return "equal"
    turn = math.cos(a[3] - b[3])
    right = math.hypot(*a[6:8]) + math.hypot(*b[6:8]) * turn
    if near(right / 2, theirs):
        return "sum"
    wrong = abs(case.velocity(0)) + abs(case.velocity(1)) * turn
    return "sum, speed as vx" if near(wrong / 2, theirs) else "unexplained"


COMPARED = {"DCE": dce, "TTCE": ttce, "WTTC": wttc, "DeltaV": delta_v}


@pytest.mark.parametrize("measure", COMPARED)
def test_values_are_equal_or_differ_for_a_cause(measure: str) -> None:
    counts = Counter(COMPARED[measure](case) for case in cases(measure))

    print(measure, dict(counts))
    assert counts["unexplained"] == 0
    assert sum(counts.values()) > 100
    assert counts["equal"] > (0.5 if measure in {"DCE", "TTCE"} else 0) * sum(counts.values())


def test_recorded_collisions_are_those_that_are_found_there() -> None:
    """TTC*: there the edge of the road counts, too, so ours is never sooner."""
    met = 0
    for case in cases("TTCStar"):
        scenario, a = case.scenario, case.encounter.a
        others = [one for ident, one in scenario.tracks.items() if ident != case.ids[0]]
        others += [
            Track(a.times, np.repeat(box[None], len(a), axis=0))
            for box in scenario.standing.values()
            if not np.isnan(box[4])
        ]
        found = [ttc_recorded(Encounter(a, other)) for other in others]
        first = min((float(f[0]) for f in found if len(f) and f[0] == f[0]), default=math.inf)
        theirs = case.told["TTCStar"]
        assert first >= theirs - NEAR
        met += near(first, theirs)
    assert met > 0
