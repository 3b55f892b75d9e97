"""Measures of criticality beside those of CommonRoad-CriMe 0.4.5 on its own scenarios.

``golden/crime.jsonl.xz`` is what that package says (``crime_values.py`` wrote it), each row a scenario, an
ego, another obstacle, a step, values by name, and what they are made of. Two of the 24 scenarios are not in
it, because the package ends in a segmentation fault with each ego (OSC_Overtake, DEU_Moabit); of those with
many obstacles some egos only (``CRIME_PAIRS=30``). Where a value differs from ours, it is made here again from
the same states, in one of these ways:

* ``as taken``: our function says the same, given what theirs takes. Distances are along its lanelets;
  velocities and accelerations along a lane are lengths times the cosine of the lanelet's direction on the map,
  accelerations are differences; DST is three times as much, by velocities along the x axis; a vehicle is the
  circle around a third of its box in WTTC, whose values are rounded to the length of a step.
* ``last step``: our function says the same without the last step, before which its loop ends.

or by its own definition and one of these causes:

* ``NULL here``: its 0 says that there is nothing to avoid.
* ``corner``: HW adds half the length of a vehicle to x and to y, whatever its heading; ``along the lane``: and
  ours is along the ego's axis. In THW: by the lane, where ours asks whether the footprint came there.
* ``goes away``: what is required so that they do not meet is asked of those who drive apart, too; ``stands
  before``: and of who brakes as if it then reversed. ``lost already``: DST where the 2 s are lost.
* ``nobody ahead``, ``no lane in common``, ``no collision``: 0, or the other one's deceleration, where by
  lanelets nobody is ahead, and by the ego's axis somebody is. ``direction 0``: 0 if a lanelet runs along the x
  axis.
* ``passes``: the lateral acceleration is asked for, too, if they pass one another anyway.
* ``ages``: of two with the same acceleration, but for rounding.
* ``area``, ``no area``: the conflict area is that of two lanelets that cross, and is entered a step early;
  ``brackets``: brackets are missing in CI.
* ``edge of the road``: this, too, is run into; ours asks for obstacles only.
* ``simulated``: TTB and TTK search the last step in which a manoeuvre that is simulated, with bounds on
  acceleration and jerk, is free of all that was recorded later; ours are closed forms. ``steers``: TTR is TTS.
* ``circles``: who walks is a circle of half its radius in DCE, and a box here.
* ``set``: of the other one a set of places is told, where it may be, and no trajectory, which we do not read.
* ``tie``: the gap is the least twice, to a tenth of a millimetre. ``told again``: the loop is empty, and the
  step that was found for the pair at the step before is told once more, though it is past.
* ``stands``: in WTTC what is a static obstacle does not accelerate. ``first root``: of the roots of WTTC's
  quartic the first one that is listed, and not the least; never 0.
* ``speed as vx``: of states that tell no more than place, orientation, speed and acceleration, the velocity is
  (v, v sin ψ) instead of (v cos ψ, v sin ψ), but for the first one.
* ``sum``: ΔV adds the speeds of two that drive in one direction, instead of taking their difference.
"""

from __future__ import annotations

import json
import lzma
import math
import os
from collections import Counter
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import shapely
from thorough import LONG, some

from sgstore.base.geometry import corners
from sgstore.model.criticality import (
    Encounter,
    Track,
    cpi,
    crash_probability,
    dce_recorded,
    et_recorded,
    headway_recorded,
    pet,
    tet,
    tit,
    ttc_recorded,
    ttce_recorded,
)
from sgstore.model.pair_numbers import PairNumbers
from sgstore.readers import open_trace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.model.world import Floats

DATA = Path(os.environ.get("SGSTORE_DATA") or Path(__file__).parents[3] / "shared/data")
FOLDER = DATA / "commonroad"
GOLDEN = Path(__file__).parents[1] / "golden" / "crime.jsonl.xz"
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
    given: dict[str, Any]
    step: int
    before: tuple[int, float] | None = None
    """Another step of both that was asked for right before, and what was told then."""

    @property
    def states(self) -> tuple[Floats, Floats]:
        return self.encounter.a.states[0], self.encounter.b.states[0]

    @property
    def numbers(self) -> PairNumbers:
        a, b = self.states
        return PairNumbers(a[None], b[None])

    def velocity(self, side: int, time: float | None = None) -> complex:
        """The velocity that the other package takes; of the first state the right one."""
        track = self.scenario.tracks.get(self.ids[side])
        if track is None:
            return 0j
        at = from_step(track, self.step * self.scenario.step if time is None else time)
        right = complex(*at.states[0, 6:8])
        if self.ids[side] not in self.scenario.plain or at.times[0] == track.times[0]:
            return right
        speed = (right * np.exp(-1j * at.states[0, 3])).real
        return complex(speed, speed * math.sin(at.states[0, 3]))


def cases(measure: str) -> Iterator[Case]:
    with lzma.open(GOLDEN, "rt", encoding="utf-8") as lines:
        rows = [row for line in lines if measure in (row := json.loads(line))[4]]
    before = {
        tuple(row[:4]): (last[3], last[4][measure])
        for last, row in pairwise(rows)
        if last[:3] == row[:3]
    }
    for stem, ego, other, step, told, given in some(rows, 7):
        scenario = known(stem)
        a = from_step(scenario.tracks[str(ego)], step * scenario.step)
        if other is None:
            yield Case(scenario, (str(ego), ""), Encounter(a, a), told, given, step)
            continue
        if str(other) in scenario.standing:
            b = Track(a.times, np.repeat(scenario.standing[str(other)][None], len(a), axis=0))
        else:
            b = from_step(scenario.tracks[str(other)], step * scenario.step)
        last = before.get((stem, ego, other, step))
        yield Case(scenario, (str(ego), str(other)), Encounter(a, b), told, given, step, last)


Judge: TypeAlias = "Callable[[Case], str]"
"""Says why a value is another one than ours."""


def from_step(track: Track, time: float) -> Track:
    row = int(np.searchsorted(track.times, time - 1e-6))
    assert track.times[row] == pytest.approx(time)
    return Track(track.times[row:], track.states[row:])


def shorter(case: Case) -> Encounter:
    """Without the last step; of who comes late, without as many as it came late."""
    a = case.encounter.a
    last = max(len(case.scenario.tracks[case.ids[0]]) - 1 - case.step, 0)
    return Encounter(Track(a.times[:last], a.states[:last]), case.encounter.b)


def near(ours: Any, theirs: float, by: float = NEAR) -> bool:
    return bool(abs(float(ours) - theirs) <= by)


def as_points(case: Case) -> tuple[Encounter, float]:
    """Who walks as a point, and how much nearer its circle is."""
    early = shorter(case)
    tracks = [
        Track(
            t.times,
            t.states * ([1, 1, 1, 1, 0, 0, 1, 1, 1, 1] if ident in case.scenario.radius else 1),
        )
        for ident, t in zip(case.ids, (early.a, early.b), strict=True)
    ]
    half = sum(case.scenario.radius.get(one, 0) for one in case.ids) / 2
    return Encounter(*tracks), half


def dce(case: Case) -> str:
    theirs, early = case.told["DCE"], shorter(case)
    tries = [("equal", first(dce_recorded(case.encounter)))]
    tries += [("last step", first(dce_recorded(early)))]
    tries += [("set", theirs)] if case.ids[1] in case.scenario.sets else []
    points, half = as_points(case)
    tries += [("circles", max(first(dce_recorded(points)) - half, 0.0))] if half else []
    return cause(theirs, *tries)


def ttce(case: Case) -> str:
    theirs, early = case.told["TTCE"], shorter(case)
    tries = [("equal", first(ttce_recorded(case.encounter)))]
    tries += [("last step", first(ttce_recorded(early)))]
    if case.before is not None and not len(early.a):
        step, told = case.before
        tries += [("told again", told - (case.step - step) * case.scenario.step)]
    tries += [("set", theirs)] if case.ids[1] in case.scenario.sets else []
    if (found := cause(theirs, *tries)) != "unexplained":
        return found
    points, half = as_points(case)
    for of, why, wide in ((early, "tie", 0.0), (points, "circles", half)):
        at = int(np.argmin(np.abs(of.times - of.times[0] - theirs)))
        least, there = (
            np.maximum(x - wide, 0) for x in (dce_recorded(of)[0], of.numbers["gap"][at])
        )
        if near(there, least, 1e-4):
            return why
    return "unexplained"


def first(values: Floats) -> float:
    return float(values[0]) if len(values) else math.nan


def wttc(case: Case) -> str:
    theirs = case.told["WTTC"]
    a, b = case.states
    ours = PairNumbers(a[None], b[None])["wttc"][0]
    if near(ours, theirs):
        return "equal"
    digits = str(case.scenario.step)[::-1].find(".")
    for speeds in ((complex(*a[6:8]), complex(*b[6:8])), (case.velocity(0), case.velocity(1))):
        wrong = "" if speeds[0] == complex(*a[6:8]) else ", speed as vx"
        place, speed = complex(*(b - a)[:2]), speeds[1] - speeds[0]
        dotted = place.real * speed.real + place.imag * speed.imag
        discs = sum(circle(case, side) for side in (0, 1))
        given = {"planar": abs(place), "rel_speed": abs(speed), "dotted": dotted, "discs": discs}
        if near(rounded(of_taken("wttc", **given), digits), theirs):
            return "as taken" + wrong
        stands = ", stands" if case.ids[1] in case.scenario.standing else ""
        roots = worst_roots(case, speeds)
        for root, more in (
            (min(roots, default=math.nan), ""),
            *((r, ", first root") for r in roots),
        ):
            if near(rounded(root, digits), theirs):
                return f"circles{stands}{wrong}{more}"
    return "unexplained"


def circle(case: Case, side: int) -> float:
    """The radius that it takes in WTTC."""
    length, width = case.states[side][4:6]
    return case.scenario.radius.get(case.ids[side]) or math.hypot(length / 6, width / 2)


def of_taken(name: str, **numbers: float) -> float:
    """A measure of ours, given what theirs takes."""
    taken = PairNumbers(np.zeros((1, 10)), np.zeros((1, 10)))
    taken.update({one: np.array([value]) for one, value in numbers.items()})
    return float(taken[name][0])


def worst_roots(case: Case, velocity: tuple[complex, complex]) -> list[float]:
    """Positive roots of the quartic of discs that grow, by the sizes that the other package takes."""
    a, b = case.states
    push = 11.5 if case.ids[1] in case.scenario.standing else 23.0
    place, speed = complex(*(b - a)[:2]), velocity[1] - velocity[0]
    dotted = 2 * (place.real * speed.real + place.imag * speed.imag)
    reach = circle(case, 0) + circle(case, 1)
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


# Along the lane --------------------------------------------------------------------------------------


class Taken:
    """What it takes for a measure along the lane: distance, speeds and accelerations."""

    def __init__(self, case: Case) -> None:
        given = case.given
        (vx1, vy1, ax1, ay1), (vx2, vy2, ax2, ay2) = given["moves"]
        self.one_lane: bool = given["same"]
        self.turns: list[float | None] = given["turn"]
        turn1, turn2 = (turn or 0.0 for turn in self.turns)
        self.speed1, self.speed2 = math.hypot(vx1, vy1), math.hypot(vx2, vy2)
        self.push2 = math.hypot(ax2, ay2)
        self.v1, self.v2 = self.speed1 * math.cos(turn1), self.speed2 * math.cos(turn2)
        self.a1 = math.copysign(math.hypot(ax1, ay1), ax1) * math.cos(turn1) * (ax1 != 0)
        self.a2 = self.push2 * math.cos(turn2)
        self.vx1, self.vx2 = vx1, vx2
        front, rear = given["s"][4:6]
        far = math.inf if front is None or rear is None or rear < front else rear - front
        self.distance = rounded(far) if self.one_lane else math.inf

    @property
    def ttc(self) -> float:
        """Its time to collision: ours with what it takes."""
        v1 = self.v1 if self.vx1 >= 0 else -self.v1
        slow = abs(self.a2 - self.a1) <= 0.1 and self.v2 < v1
        a1, a2 = (0.0, 0.0) if slow else (self.a1, self.a2)
        if not math.isfinite(self.distance):
            return math.inf
        found = of_taken("ttc_accel", lead=self.distance, v1=v1, v2=self.v2, a1=a1, a2=a2)
        return math.inf if math.isnan(found) else rounded(found)


def rounded(value: float, digits: int = 2) -> float:
    if not math.isfinite(value):
        return value
    return math.copysign(math.floor(abs(value) * 10**digits + 0.5) / 10**digits, value)


def cause(theirs: float, *tries: tuple[str, float], by: float = 0.0) -> str:
    """Say which of some values is theirs; ``by``: how far it may be off, as a share of it, beside 0.01."""
    within = NEAR + by * abs(theirs)
    return next((name for name, value in tries if near(value, theirs, within)), "unexplained")


def null_here(ours: float) -> tuple[str, float]:
    """Where ours is NULL, because there is nothing to avoid, theirs is 0."""
    return ("NULL here", 0.0) if math.isnan(ours) else ("equal", ours)


def hw(case: Case) -> str:
    theirs, (_, _, front, rear, *_) = case.told["HW"], case.given["s"]
    ours = float(case.numbers["lead"][0])
    right = math.nan if front is None or rear is None else rear - front
    corner = "corner" if near(ours, right) else "corner, along the lane"
    return cause(theirs, ("equal", ours), (corner, Taken(case).distance))


def thw(case: Case) -> str:
    _, other = case.given["s"][:2]
    far = other - sum(
        case.scenario.radius.get(ident, state[4] / 2)
        for ident, state in zip(case.ids, case.states, strict=True)
    )
    later = [s is not None and s > far for s in case.given["later"]]
    passed = (1 + later.index(True)) * case.scenario.step if any(later) else math.nan
    ours = float(headway_recorded(case.encounter)[0])
    return cause(case.told["THW"], ("equal", ours), ("along the lane", passed))


def ttc(case: Case) -> str:
    theirs, taken = case.told["TTC"], Taken(case)
    tries = [("equal", float(case.numbers["ttc_accel"][0])), ("as taken", taken.ttc)]
    if abs(taken.a2 - taken.a1) < 1e-9:  # and not 0, by rounding
        tries.append(("ages", max(theirs, 1e6)))
    return cause(theirs, *tries, by=1e-6)


def along(case: Case) -> str:
    theirs, taken = case.told["ALongReq"], Taken(case)
    far, v1, v2, a2 = taken.distance, taken.v1, taken.v2, taken.a2
    if not taken.one_lane:
        more = [("no lane in common", 0.0)]
    elif not all(taken.turns):
        more = [("direction 0", 0.0)]
    elif math.isinf(far):
        more = [("nobody ahead", min(a2, 0.0))]
    else:
        asked = of_taken("a_long_req", lead=far, v1=v1, v2=v2, a2=a2)
        other = "goes away" if v2 >= v1 else "stands before"
        more = [("as taken", asked), (other, min(a2 - (v2 - v1) ** 2 / (2 * far), 0.0))]
    return cause(theirs, null_here(float(case.numbers["a_long_req"][0])), *more, by=1e-3)


def aside(case: Case) -> str:
    theirs, taken = case.told["ALatReq"], Taken(case)
    time = taken.ttc
    if not taken.one_lane:
        more = [("no lane in common", 0.0)]
    elif math.isinf(time) or None in taken.turns:
        more = [("no collision", 0.0)]
    else:
        turn1, turn2 = (turn or 0.0 for turn in taken.turns)
        drift = (taken.speed2 * math.sin(turn2) - taken.speed1) * math.sin(turn1)
        push = taken.push2 * math.sin(turn2)
        half = case.states[0][5] / 2
        half += case.scenario.radius.get(case.ids[1], case.states[1][5] / 2)
        off = drift * time + push * time * time / 2
        both = [abs(push - 2 * (side * half - drift * time) / time**2) for side in (1, -1)]
        asked = of_taken("a_lat_req", aside=off, reach2=half, ttc_accel=time)
        more = [("as taken", asked), ("passes", min(both))]
    return cause(theirs, null_here(float(case.numbers["a_lat_req"][0])), *more, by=0.02)


def followed(case: Case, measure: str, ours: str, of: dict[str, Judge]) -> str:
    """The judgement of a measure that is made of others, by the same formula as ours."""
    told = {name: case.told[other] for name, other in MADE_OF[measure].items()}
    theirs = case.told[measure]
    if near(case.numbers[ours][0], theirs):
        return "equal"
    if not near(of_taken(ours, **told), theirs):
        return "unexplained"
    causes = [of[one](case) for one in MADE_OF[measure].values()]
    return next((one for one in causes if one != "equal"), "equal")


def dst(case: Case) -> str:
    theirs, taken = case.told["DST"], Taken(case)
    far, v1, v2 = taken.distance, taken.vx1, taken.vx2
    if not taken.one_lane:
        more = [("no lane in common", 0.0)]
    elif math.isinf(far):
        more = [("nobody ahead", 0.0)]
    else:
        asked = 3 * of_taken("decel_to_safety_time", lead=far, v1=v1, v2=v2)
        other = "goes away" if v2 >= v1 else "lost already"
        more = [("as taken", asked), (other, 3 * (v1 - v2) ** 2 / (2 * (far - 2 * v2)))]
    return cause(theirs, null_here(float(case.numbers["decel_to_safety_time"][0])), *more, by=0.01)


def msd(case: Case) -> str:
    (vx, vy, *_), turn = case.given["moves"][0], case.given["turn"][0]
    taken = PairNumbers(case.states[0][None], case.states[0][None])
    taken["pace"] = np.array([math.hypot(vx, vy) * math.cos(turn)])
    tries = ("equal", float(case.numbers["msd"][0])), ("as taken", float(taken["msd"][0]))
    return cause(case.told["MSD"], *tries)


# Of a course, and of areas ---------------------------------------------------------------------------


def exposed(case: Case, measure: str, of: Callable[[Encounter], float]) -> str:
    a = case.encounter.a
    times = {step - case.step: time for step, time, _ in case.given["course"] if time is not None}
    taken = Encounter(a, a)
    taken.numbers["ttc"] = np.array([times.get(i, math.nan) for i in range(len(a))])
    return cause(case.told[measure], ("equal", of(case.encounter)), ("as taken", of(taken)))


def crash(case: Case) -> str:
    steps = len(case.encounter.a) - 1
    needed = [-(push or 0) for step, _, push in case.given["course"] if step < case.step + steps]
    share = crash_probability(np.array(needed)).sum() / max(steps, 1)
    return cause(case.told["CPI"], ("equal", cpi(case.encounter)), ("as taken", share))


def stays(case: Case) -> list[tuple[float, float]]:
    """When both come into its area and leave it, in steps, found by their footprints."""
    area = shapely.from_wkt(case.given["area"])
    found: list[tuple[float, float]] = []
    for track in (case.encounter.a, case.encounter.b):
        boxes = shapely.polygons(corners(track.states[:, [0, 1, 3, 4, 5]]))
        inside = shapely.intersects(boxes, area)[: len(track) - 1]
        rows = np.flatnonzero(inside)
        if not len(rows):
            found.append((math.inf, math.inf))
            continue
        left = np.flatnonzero(~inside[rows[0] :])
        leaves = float(rows[0] + left[0]) if len(left) else math.inf
        found.append((max(float(rows[0]) + case.step - 1, 0.0), leaves + case.step))
    return found


def encroaches(case: Case) -> str:
    enters, leaves = stays(case)[0]
    lasts = (leaves - enters) * case.scenario.step
    return cause(case.told["ET"], ("equal", et_recorded(case.encounter)), ("area", lasts))


def after(case: Case) -> str:
    (enters_a, leaves_a), (enters_b, leaves_b) = stays(case)
    between = max(enters_b - leaves_a, enters_a - leaves_b) * case.scenario.step
    return cause(case.told["PET"], ("equal", pet(case.encounter)), ("area", between))


def stopping(case: Case) -> str:
    enters = int(stays(case)[0][0])
    at = case.encounter.a.states[1 : enters - case.step + 2, :2]
    way = float(np.hypot(*np.diff(at, axis=0).T).sum()) if len(at) > 1 else 0.0
    (vx, vy, *_), turn = case.given["moves"][0], case.given["turn"][0]
    room = rounded((math.hypot(vx, vy) * math.cos(turn)) ** 2 / 23)
    tries = ("equal", float(case.numbers["psd"][0])), ("area", way / room)
    return cause(case.told["PSD"], *tries, by=0.01)


def conflict(case: Case) -> str:
    theirs, ours = case.told["CI"], float(case.numbers["ci"][0])
    if "PET" not in case.told:
        return cause(theirs, null_here(ours), ("no area", 0.0))
    m, speeds, turns = 1093.2952334674046, [], []
    for side, (enters, _) in enumerate(stays(case)):
        time = enters * case.scenario.step
        speeds.append(abs(case.velocity(side, time)))
        turns.append(from_step(case.scenario.tracks[case.ids[side]], time).states[0, 3])
    (u1, u2), (turn1, turn2) = speeds, turns
    mixed = m * u1 * math.sin(turn1) + u2 * math.sin(turn2) * u1 * math.cos(turn1)
    mixed += m * u2 * math.cos(turn2)
    left = (u1 * math.sin(turn1) + u2 * math.sin(turn2)) / (2 * math.sin(math.atan(mixed)))
    lost = m * (u1**2 + u2**2) / 2 - m * left**2
    right = lost / math.exp(case.told["PET"])
    return cause(theirs, ("equal", ours), ("area, brackets", right), by=1e-4)


# Of manoeuvres ---------------------------------------------------------------------------------------


def met(case: Case) -> list[Track]:
    """All that somebody could run into, as far as we read it."""
    a = case.encounter.a
    tracks = [one for ident, one in case.scenario.tracks.items() if ident != case.ids[0]]
    standing = [box for box in case.scenario.standing.values() if not np.isnan(box[4])]
    return tracks + [Track(a.times, np.repeat(box[None], len(a.times), axis=0)) for box in standing]


def meets(case: Case) -> str:
    theirs, without = case.told["TTCStar"], case.given["star"]
    found = [ttc_recorded(Encounter(case.encounter.a, other)) for other in met(case)]
    first = min((float(f[0]) for f in found if len(f) and f[0] == f[0]), default=math.inf)
    told = math.inf if without is None else without
    if first > theirs and near(theirs, told) and case.scenario.sets:
        return "set"
    edge = theirs if first > theirs and (first == told or near(first, told)) else math.nan
    return cause(theirs, ("equal", first), ("edge of the road", edge))


def brakes(case: Case) -> str:
    return searched(case, "TTB", -11.5)


def hurries(case: Case) -> str:
    return searched(case, "TTK", 11.5)


def reacts(case: Case) -> str:
    told = {name: case.told[name] for name in ("TTB", "TTK", "TTS") if name in case.told}
    best = max(told, key=lambda name: told[name])
    if not near(told[best], case.told["TTR"]):
        return "unexplained"
    return {"TTB": brakes, "TTK": hurries}[best](case) if best != "TTS" else "steers"


def searched(case: Case, measure: str, push: float) -> str:
    """The last step in which a simulated manoeuvre is free of what was recorded, found by bisection."""
    theirs, step = case.told[measure], case.scenario.step
    if case.given["star"] != case.told["TTCStar"]:
        return "edge of the road"
    if case.scenario.sets:
        return "set"
    low, high = 0, round(case.told["TTCStar"] / step)
    others = met(case)
    while low < high:
        middle = (low + high) // 2
        way = pushed(case, middle, push)
        free = not any((Encounter(way, one).numbers["gap"] <= 0).any() for one in others)
        low, high = (middle + 1, high) if free else (low, middle)
    return "simulated" if near((low - 1) * step, theirs) else "unexplained"


def pushed(case: Case, start: int, push: float) -> Track:
    """The way of a point mass that is pushed from a step on, with its bounds of acceleration and jerk."""
    track, step = case.encounter.a, case.scenario.step
    states = track.states.copy()
    speed = np.hypot(states[:, 6], states[:, 7])
    way = np.exp(1j * states[start, 3])
    place, velocity = complex(*states[start, :2]), speed[start] * way
    push_now = np.gradient(speed, step)[start] * way
    for row in range(start + 1, len(states)):
        heading = np.exp(1j * math.atan2(velocity.imag, velocity.real))
        much = (
            push * min(1.0, 7.319 / max(velocity.real, 1e-9))
            if push > 0 and velocity.real > 7.319
            else push
        )
        wanted = much * heading
        bounds = ((now - 25 * step, now + 25 * step) for now in (push_now.real, push_now.imag))
        x, y = (
            min(max(want, least, -8.0), most, 8.0)
            for want, (least, most) in zip((wanted.real, wanted.imag), bounds, strict=True)
        )
        push_now = complex(x, y)
        after_it = velocity + push_now * step
        if abs(after_it) < 0.2:
            states[row:] = states[row - 1]
            break
        place += velocity * step + push_now * step**2 / 2
        velocity = after_it
        states[row, :2] = place.real, place.imag
        states[row, 3] = math.atan2(velocity.imag, velocity.real)
    return Track(track.times, states)


MADE_OF = {
    "AReq": {"a_long_req": "ALongReq", "a_lat_req": "ALatReq"},
    "BTN": {"a_long_req": "ALongReq"},
    "STN": {"a_lat_req": "ALatReq"},
}
REQUIRED: dict[str, Judge] = {"ALongReq": along, "ALatReq": aside}
COMPARED: dict[str, tuple[str, Judge]] = {
    "DCE": ("dce_recorded", dce),
    "TTCE": ("ttce_recorded", ttce),
    "TTCStar": ("ttc_recorded", meets),
    "THW": ("headway_recorded", thw),
    "TET": ("tet", partial(exposed, measure="TET", of=tet)),
    "TIT": ("tit", partial(exposed, measure="TIT", of=tit)),
    "CPI": ("cpi", crash),
    "ET": ("et_recorded", encroaches),
    "PET": ("pet", after),
    "HW": ("lon_gap", hw),
    "TTC": ("ttc_accel", ttc),
    "WTTC": ("wttc", wttc),
    "ALongReq": ("a_long_req", along),
    "ALatReq": ("a_lat_req", aside),
    "AReq": ("a_req", partial(followed, measure="AReq", ours="a_req", of=REQUIRED)),
    "BTN": ("btn", partial(followed, measure="BTN", ours="btn", of=REQUIRED)),
    "STN": ("stn", partial(followed, measure="STN", ours="stn", of=REQUIRED)),
    "DST": ("decel_to_safety_time", dst),
    "MSD": ("msd", msd),
    "PSD": ("psd", stopping),
    "CI": ("ci", conflict),
    "DeltaV": ("delta_v", delta_v),
    "TTB": ("ttb", brakes),
    "TTK": ("ttk", hurries),
    "TTR": ("ttr", reacts),
}
"""Names there, ours, and what says why a value is another one."""
MANOEUVRES = {"TTB", "TTK", "TTR"}


@pytest.mark.parametrize("measure", COMPARED)
def test_values_are_equal_or_differ_for_a_cause(measure: str) -> None:
    counts = Counter(COMPARED[measure][1](case) for case in cases(measure))

    print(measure, dict(counts))
    assert counts["unexplained"] == 0
    assert counts.total() > 0
    if LONG and measure not in {"ET", *MANOEUVRES}:
        assert counts["equal"] > 0
