"""Contradictions in the motion of bodies from frame to frame, and votes for their probable cause.

Each function compares two columns that describe the same fact, such as recorded velocity and displacement.
A contradicting row votes for a *cause*: a factor, an angle or an axis. The verdict follows from the votes of
all frames (:mod:`sgstore.pipeline.plausibility`), because noise does not agree on a cause.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from sgstore.base.geometry import wrapped
from sgstore.base.tables import taken
from sgstore.model.vocabulary import KIND_CODE, KINDS, kinds_labelled

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.model.world import Bools, Floats, FrameBlock, Ints

COLUMNS: Final = (
    *("x", "y", "z", "heading", "vx", "vy", "ax", "ay", "yaw_rate"),
    *("length", "width", "height", "derived", "light_state"),
)
X, HEADING, VX, AX, YAW_RATE, LENGTH, HEIGHT, DERIVED, LIGHT = 0, 3, 4, 6, 8, 9, 11, 12, 13

MOVES: Final = 1.5
"""Smallest difference of recorded and real velocity that counts; m/s. Boxes jitter by 0.3, SUMO people by 1."""

UNLIKE: Final = 0.3
"""Smallest ratio of this difference to the larger speed. The smallest wrong factor is 1.6 (miles for km)."""

COURSE: Final = 3.0
"""Smallest speed at which a vehicle must face its direction of movement; m/s."""

ASKEW: Final = 0.26
"""Smallest angle between heading and movement that counts; rad (15°). Cars slip by less than 10°."""

BACKWARDS: Final = 8.0
"""Highest speed in reverse gear; m/s."""

AGREEING: Final = 10
"""Smallest number of rows that must agree on a contradiction: one second at 10 Hz."""

STANDING: Final = 5
"""Smallest number of rows in which a body reports a speed, but does not move at all."""

RANDOM: Final = 0.82
"""Share of headings off the movement above which they are random. Random ones have 84 %, noise 80 %."""

SHARE: Final = 0.8
"""Smallest share of the contradicting rows that must agree."""

UNITS: Final = {
    1e3: "in mm/s",
    100.0: "in cm/s",
    3.6: "in km/h",
    2.237: "in mph",
    3.281: "in ft/s",
    2.0: "doubled, or the clock runs at half the speed",
    0.5: "halved, or the clock runs at twice the speed",
    1 / 3.281: "in m/s, but positions are in feet",
    0.01: "in m/s, but positions are in centimetres",
    1e-3: "in m/s, but positions are in millimetres, or time in ms instead of s",
}
"""Factor between recorded and real velocity → the probable wrong unit."""

QUICKEST: Final = {"person": 13.0, "animal": 35.0, "bicycle": 40.0}
"""Highest possible speed by kind; m/s. The records of a sprinter and a cheetah are 12.4 m/s and 29 m/s."""

SIGHT: Final = 600
"""Number of frames after which an absent body is forgotten."""

_BINS: Final = 10
"""Number of bins of votes for a factor, for each step of the natural logarithm by one: a bin covers 10 %."""

_DEGREES: Final = 5.0
_HALF: Final = 36
"""Number of bins of votes for an angle in half a turn: a bin covers 5°."""

FROZEN, STILL = 900, 901
MIRRORED, SWAPPED, REVERSED, LEFT, RIGHT, OWN_AXES = 902, 903, 904, 905, 906, 907
NEGATIVE, OFFSET, MIRROR, IN_DEGREES = 400, 1_000, 2_000, 3_000
"""Codes of causes. The last three are offsets of angle bins (-36 … 36); factors have bins -200 … 200."""

_NONE, _KEYS = -1_000, 10_000

_VEHICLE: Final = np.array([KIND_CODE[kind] for kind in kinds_labelled("Vehicle") or ()])


class Contradiction(NamedTuple):
    """Contradiction of one kind: the first body and frame, all bodies, the row count and a description."""

    kind: str
    node: int
    frame: int
    nodes: tuple[int, ...]
    rows: int
    value: str


@dataclass(slots=True)
class Vote:
    """Contradicting rows of one body: row count, first frame, its two values, and votes for causes."""

    frame: int
    values: tuple[float, float]
    rows: int = 0
    causes: Counter[int] = field(default_factory=Counter[int])


@dataclass(frozen=True, slots=True)
class BodyRows:
    """States of bodies in a block, and their last states in earlier blocks; sorted by node and frame.

    Attributes
    ----------
    node, frame, time_ns : (n,) int64
    values : (n, 14) float64
        Columns :data:`COLUMNS`.
    fresh : (n,) bool
        True for the rows of the block.
    """

    node: Ints
    frame: Ints
    time_ns: Ints
    values: Floats
    fresh: Bools


@dataclass(frozen=True, slots=True)
class Steps:
    """Pairs of successive states of a body.

    Attributes
    ----------
    rows : BodyRows
    at, node, frame, frames : (n,) int64
        Row before the step, node id, frame after the step, and number of frames between them.
    seconds : (n,) float64
        Duration; s.
    away : (n, 3) float64
        Displacement; m.
    derived : (n,) int64
        Bit 0: velocity, bit 1: acceleration, bit 2: yaw rate is not recorded at both ends.
    known : (n,) bool
        True for steps with positions at both ends, and with time between them.
    """

    rows: BodyRows
    at: Ints
    node: Ints
    frame: Ints
    frames: Ints
    seconds: Floats
    away: Floats
    derived: Ints
    known: Bools

    @classmethod
    def of(cls, block: FrameBlock, before: BodyRows | None) -> Steps:
        """Return the steps (pairs of successive states) that end in a block. Some begin before it."""
        states, frame_of = block.states, block.frame_of
        node, frame, time_ns = states.node, block.seq[frame_of], block.time_ns[frame_of]
        values = np.column_stack([getattr(states, name) for name in COLUMNS])
        fresh = np.ones(len(node), np.bool_)
        if before is not None and len(before.node):
            last = np.ones(len(before.node), np.bool_)
            last[:-3] = before.node[3:] != before.node[:-3]
            last &= before.frame > block.seq[0] - SIGHT
            node = np.concatenate([before.node[last], node])
            frame = np.concatenate([before.frame[last], frame])
            time_ns = np.concatenate([before.time_ns[last], time_ns])
            values = np.concatenate([before.values[last], values])
            fresh = np.concatenate([np.zeros(int(last.sum()), np.bool_), fresh])
        # Numbers of 16 bits are sorted by radix.
        small = len(node) and node.max() < 1 << 16
        order = np.argsort(node.astype(np.uint16) if small else node, kind="stable")
        rows = taken(BodyRows(node, frame, time_ns, values, fresh), order)
        same = (rows.node[1:] == rows.node[:-1]) & rows.fresh[1:] & (rows.values[1:, LIGHT] < 0)
        at = np.flatnonzero(same)
        after = at + 1
        derived = rows.values[:, DERIVED].astype(np.int64)
        seconds = (rows.time_ns[after] - rows.time_ns[at]) / 1e9
        away = rows.values[after, X : X + 3] - rows.values[at, X : X + 3]
        return cls(
            rows,
            at,
            rows.node[at],
            rows.frame[after],
            rows.frame[after] - rows.frame[at],
            seconds,
            away,
            derived[at] | derived[after],
            np.isfinite(away[:, :2]).all(axis=1) & (seconds > 0),
        )


@dataclass(slots=True)
class Tally:
    """Votes for the causes of contradictions, and counts of compared pairs of states, by quantity and body."""

    votes: dict[tuple[str, int], Vote] = field(default_factory=dict[tuple[str, int], Vote])
    compared: dict[str, Ints] = field(default_factory=dict[str, "Ints"])

    def total(self, quantity: str, node: int | None = None) -> int:
        """Return how many pairs of successive states were compared, for one body or for all."""
        counts = self.compared.get(quantity, np.zeros(0, np.int64))
        return int((counts if node is None else counts[node : node + 1]).sum())

    def add(
        self,
        quantity: str,
        steps: Steps,
        compared: Bools,
        bad: Bools,
        values: tuple[Floats, Floats],
        *causes: Floats,
    ) -> None:
        """Count compared and contradicting pairs of states. Contradicting ones vote for their possible causes.

        ``values`` has a row per step, and a cause per contradicting step.
        """
        before = self.compared.get(quantity, np.zeros(0, np.int64))
        total = np.bincount(steps.node[compared], minlength=len(before))
        total[: len(before)] += before
        self.compared[quantity] = total
        rows = np.flatnonzero(bad)
        if not len(rows):
            return
        node, (recorded, actual) = steps.node[rows], values
        found = np.unique(node, return_index=True, return_counts=True)
        for one, first, count in zip(*(column.tolist() for column in found), strict=True):
            row = rows[first]
            example = int(steps.frame[row]), (float(recorded[row]), float(actual[row]))
            self.votes.setdefault((quantity, one), Vote(*example)).rows += count
        for cause in causes:
            chosen = np.isfinite(cause)
            codes = np.clip(np.rint(cause[chosen]), _NONE, _KEYS + _NONE - 1)
            keys = node[chosen] * _KEYS - _NONE + codes.astype(np.int64)
            distinct = np.unique(keys, return_counts=True)
            for key, count in zip(*(column.tolist() for column in distinct), strict=True):
                one, code = divmod(key, _KEYS)
                self.votes[quantity, one].causes[code + _NONE] += count


def factor_of(cause: float) -> float:
    """Convert the number of a histogram bin back to a factor, such as 3.6."""
    return float(np.exp(cause / _BINS))


def add_contradictions(steps: Steps, kinds: Ints, tally: Tally) -> None:
    """Compare recorded velocity, heading, acceleration and yaw rate with the movement. Count contradictions.

    Parameters
    ----------
    steps : Steps
        Only those with known positions in consecutive frames are compared.
    kinds : (K,) int64
        Kind code of each node.
    tally : Tally
    """
    joined = steps.known & (steps.frames == 1)
    motion = steps.rows.values[:, : YAW_RATE + 1]
    ends = motion[steps.at], motion[steps.at + 1]
    mean, change = (ends[0] + ends[1]) / 2, ends[1] - ends[0]
    with np.errstate(all="ignore"):
        velocity = steps.away[:, :2] / steps.seconds[:, None]
        speed = np.hypot(*velocity.T)
        _velocities(steps, joined, mean, velocity, tally)
        fast = joined & (speed > COURSE)
        fast[fast] = np.isin(kinds[steps.node[fast]], _VEHICLE)
        _headings(steps, fast, velocity, tally)
        change[:, HEADING] = wrapped(change[:, HEADING])
        # A faster turn can be the noise of a body that stands.
        change[np.abs(change[:, HEADING]) > 1, HEADING] = np.nan
        change /= steps.seconds[:, None]
        for quantity, bit, column, of, least in (
            ("acceleration", 2, slice(AX, AX + 2), slice(VX, VX + 2), 0.5),
            ("yaw rate", 4, [YAW_RATE], [HEADING], 0.03),
        ):
            if not (steps.derived & bit).all():
                read = joined & (steps.derived & bit == 0)
                _rates(quantity, steps, read, (mean[:, column], change[:, of]), least, tally)
        limit = np.full(len(KINDS), np.inf)
        limit[[KIND_CODE[kind] for kind in QUICKEST]] = [*QUICKEST.values()]
        fast = joined & (speed > limit[kinds[steps.node]])
        if fast.any():
            tally.add("speed", steps, fast, fast, (speed, speed), 0 * speed[fast])


def _velocities(steps: Steps, joined: Bools, mean: Floats, velocity: Floats, tally: Tally) -> None:
    """Compare recorded velocities with displacements."""
    told = mean[:, VX : VX + 2]
    read = joined & (steps.derived & 1 == 0) & np.isfinite(told).all(axis=1)
    speeds = np.hypot(*told.T), np.hypot(*velocity.T)
    apart = np.hypot(*(told - velocity).T)
    bad = read & (apart > np.maximum(MOVES, UNLIKE * np.maximum(*speeds)))
    if not bad.any():
        tally.add("velocity", steps, read, bad, speeds)
        return
    told, (x, y), (told_speed, speed) = told[bad], velocity[bad].T, (one[bad] for one in speeds)
    ratio = told_speed / speed
    along = (told[:, 0] * x + told[:, 1] * y) / (speed * told_speed)
    heading = steps.rows.values[steps.at[bad], HEADING]
    cos, sin = np.cos(heading), np.sin(heading)
    others = (
        (OWN_AXES, (x * cos + y * sin, y * cos - x * sin)),
        (MIRRORED, (x, -y)),
        (REVERSED, (-x, -y)),
        (SWAPPED, (y, x)),
        (RIGHT, (y, -x)),
        (LEFT, (-y, x)),
    )
    causes = [
        np.where(np.hypot(told[:, 0] - one, told[:, 1] - other) < UNLIKE * speed, code, np.nan)
        for code, (one, other) in others
    ]
    factor = np.where(along > 0.95, _BINS * np.log(ratio), np.nan)
    factor[(speed == 0) | (~(along > 0.95) & (ratio > 20))] = FROZEN
    factor[told_speed == 0] = STILL
    tally.add("velocity", steps, read, bad, speeds, factor, *causes)


def _headings(steps: Steps, moving: Bools, velocity: Floats, tally: Tally) -> None:
    """Compare the headings of vehicles with their directions of movement."""
    row = np.flatnonzero(moving)
    heading, (x, y) = steps.rows.values[steps.at[row], HEADING], velocity[row].T
    course, speed = np.arctan2(y, x), np.hypot(x, y)
    apart = np.abs(wrapped(heading - course))
    # A vehicle can drive backwards, but not fast.
    is_reverse = (apart > np.pi - ASKEW) & (speed < BACKWARDS)
    bad, reverse = np.zeros((2, len(moving)), np.bool_)
    reverse[row[is_reverse]] = True
    bad[row[(apart > ASKEW) & ~is_reverse]] = True
    shown = np.full((2, len(moving)), np.nan)
    shown[:, row] = np.degrees(wrapped(heading)), np.degrees(course)
    if reverse.any():
        tally.add("reverse", steps, reverse, reverse, (shown[0], shown[1]))
    vx, vy = steps.rows.values[steps.at[bad], VX : VX + 2].T
    heading, course = np.radians(shown[:, bad])
    # Only the direction of the state is exact enough, because degrees magnify its error.
    exact = np.arctan2(vy, vx)
    exact[np.abs(wrapped(exact - course)) > ASKEW] = np.nan
    causes = [
        base + (np.rint(np.degrees(wrapped(angle)) / _DEGREES) + _HALF) % (2 * _HALF) - _HALF
        for base, angle in (
            (OFFSET, heading - course),
            (MIRROR, heading + course),
            (IN_DEGREES, heading - np.degrees(exact)),
        )
    ]
    tally.add("heading", steps, moving, bad, (shown[0], shown[1]), *causes)


def _rates(
    quantity: str,
    steps: Steps,
    read: Bools,
    values: tuple[Floats, Floats],
    least: float,
    tally: Tally,
) -> None:
    """Compare recorded accelerations with changes of velocity, or yaw rates with changes of heading."""
    told, actual = values
    told_size, size = (np.sqrt((one * one).sum(axis=1)) for one in values)
    read &= (size > least) & (told_size > 1e-6)
    along = (told * actual).sum(axis=1) / (told_size * size)
    ratio = told_size / size
    bad = read & (((ratio > 2) | (ratio < 0.5)) & (along > 0.9) | (along < -0.9))
    cause = _BINS * np.log(ratio[bad]) + np.where(along[bad] < 0, NEGATIVE, 0)
    tally.add(quantity, steps, read, bad, (told_size, size), cause)


def judged(tally: Tally) -> Iterator[Contradiction]:
    """Yield the contradictions for which enough votes agree: for single bodies, or for all together."""
    quantities: dict[str, dict[int, Vote]] = {}
    for (quantity, node), vote in tally.votes.items():
        quantities.setdefault(quantity, {})[node] = vote
    wrong_speed = False
    for quantity, votes in sorted(quantities.items(), key=lambda one: one[0] != "velocity"):
        if sum(vote.rows for vote in votes.values()) < STANDING:
            continue
        if wrong_speed and quantity == "acceleration":  # It follows from the velocities.
            continue
        kinds: dict[str, list[tuple[int, Vote, str]]] = {}
        for node, vote, (kind, value) in _agreed(quantity, votes, tally):
            kinds.setdefault(kind, []).append((node, vote, value))
        wrong_speed |= quantity == "velocity" and bool(kinds)
        for kind, same in kinds.items():
            node, vote, value = min(same, key=lambda one: one[1].frame)
            nodes, rows = tuple(one for one, *_ in same), sum(one.rows for _, one, _ in same)
            yield Contradiction(kind, node, vote.frame, nodes, rows, value)


def _agreed(
    quantity: str, votes: dict[int, Vote], tally: Tally
) -> list[tuple[int, Vote, tuple[str, str]]]:
    """Return the bodies with a contradiction. If no body has one, judge the votes of all bodies together."""
    told = [
        (node, vote, _verdict(quantity, vote, tally.total(quantity, node)))
        for node, vote in votes.items()
    ]
    found = [(node, vote, verdict) for node, vote, verdict in told if verdict]
    if found or quantity == "speed":
        return found
    node, first = min(votes.items(), key=lambda one: one[1].frame)
    whole = Vote(first.frame, first.values, sum(one.rows for one in votes.values()))
    for one in votes.values():
        whole.causes.update(one.causes)
    if quantity == "reverse":
        is_rule = len(votes) > 1 and whole.rows >= max(AGREEING, SHARE * tally.total("heading"))
        return [(node, whole, ("backwards", "vehicles move backwards"))] if is_rule else []
    compared = tally.total(quantity)
    if whole.rows < compared / 2:
        return []
    verdict = _verdict(quantity, whole, compared)
    if verdict is None and quantity == "heading" and whole.rows > max(20, RANDOM * compared):
        verdict = "heading", "headings do not follow the movement"
    return [(node, whole, verdict)] if verdict else []


def _alike(cause: int) -> tuple[int, ...]:
    """Return the histogram bin of a factor or angle, and the two bins next to it."""
    base = (cause + 500) // 1_000 * 1_000
    if not base:
        return cause - 1, cause, cause + 1
    return tuple(base + (cause - base + i + _HALF) % (2 * _HALF) - _HALF for i in (-1, 0, 1))


def _verdict(quantity: str, vote: Vote, compared: int) -> tuple[str, str] | None:
    """Return the kind and the text of a contradiction. ``None`` if the rows do not agree."""
    causes = vote.causes
    if quantity == "velocity" and causes[FROZEN] >= STANDING:
        return "frozen", f"speed {vote.values[0]:.3g} m/s is recorded, but it does not move"
    wide = {
        c: n if FROZEN <= c <= OWN_AXES else sum(causes[one] for one in _alike(c))
        for c, n in causes.items()
    }
    cause = max(wide, key=lambda one: (wide[one], causes[one]), default=None)
    agree = 0 if cause is None else wide[cause]
    if quantity == "speed":
        value = f"{vote.values[0]:.3g} m/s"
        return ("impossible speed", value) if agree >= AGREEING else None
    if quantity != "velocity" and vote.rows < SHARE * compared:
        return None
    if cause is None or agree < max(AGREEING, SHARE * vote.rows):
        return None
    return _DESCRIBED[quantity](cause, *vote.values)


def _of_velocity(cause: int, recorded: float, actual: float) -> tuple[str, str] | None:
    value = f"recorded {recorded:.4g} m/s, moved {actual:.4g} m/s"
    if cause == STILL:
        return "velocity missing", value
    if cause in _AXES:
        return "velocity axes", f"recorded velocities are {_AXES[cause]}"
    unit = _near(recorded / actual, UNITS)
    value += f": factor {recorded / actual:.3g}"
    return "velocity unit", f"{value}, {unit}" if unit else value


def _of_heading(cause: int, heading: float, course: float) -> tuple[str, str] | None:
    value = f"heading {heading:.0f}°, movement {course:.0f}°"
    if cause > IN_DEGREES - 100:
        return (
            ("angle unit", f"{value}: degrees for radians") if abs(cause - IN_DEGREES) < 3 else None
        )
    mirrored = cause > MIRROR - 100
    degrees = (cause - (MIRROR if mirrored else OFFSET)) * 5
    if not mirrored and abs(degrees) >= 175:
        return "backwards", value
    words = f"mirrored and off by {degrees}°" if mirrored else f"off by {degrees}°"
    return "heading", f"{value}: {words}"


def _of_acceleration(cause: int, recorded: float, actual: float) -> tuple[str, str] | None:
    opposite = cause > NEGATIVE - 201
    unit = _near(factor_of(cause - NEGATIVE if opposite else cause), _ACCELERATIONS)
    value = f"recorded {recorded:.3g} m/s², speed changes by {actual:.3g} m/s²"
    words = f"{'opposite, ' if opposite else ''}{unit}"
    return (
        ("acceleration unit", f"{value}: {words}") if unit and (opposite or unit != _SAME) else None
    )


def _of_yaw_rate(cause: int, recorded: float, actual: float) -> tuple[str, str] | None:
    opposite = cause > NEGATIVE - 201
    unit = _near(factor_of(cause - NEGATIVE if opposite else cause), _YAW_RATES)
    if not unit:
        return None
    value = f"recorded {recorded:.3g} rad/s, heading turns by {actual:.3g} rad/s: {unit}"
    return "yaw rate sign" if unit == _SAME else "yaw rate unit", value


def _near(factor: float, names: dict[float, str]) -> str:
    """Return the name of a known factor within 12 % of the given one; otherwise an empty text."""
    near = min(names, key=lambda one: abs(np.log(one / factor)))
    return names[near] if abs(np.log(near / factor)) < 0.12 else ""


_SAME: Final = "opposite sign"
_ACCELERATIONS: Final = {
    1.0: _SAME,
    9.81: "in m/s² · 9.81",
    1 / 9.81: "in g",
    100.0: "in cm/s²",
    3.6: "in km/h per second",
    1000.0: "in mm/s²",
}
_YAW_RATES: Final = {1.0: _SAME, 57.3: "in degrees/s", 1 / 57.3: "converted to radians twice"}
_AXES: Final = {
    OWN_AXES: "in the axes of the body",
    MIRRORED: "mirrored (y downwards)",
    REVERSED: "opposite to the movement",
    SWAPPED: "swapped (x for y)",
    RIGHT: "turned by -90°",
    LEFT: "turned by 90°",
}
_DESCRIBED: Final = {
    "velocity": _of_velocity,
    "heading": _of_heading,
    "acceleration": _of_acceleration,
    "yaw rate": _of_yaw_rate,
}
