"""Computation of motion from noisy positions: noise of a recording, smooth velocities, standing vehicles.

Positions of measured recordings tremble, those of simulators do not. :func:`noise_of` estimates the noise
from the first frames. :class:`Smoother` fits polynomials to the noisy positions around each frame.

Notes
-----
A velocity is the slope of a line over up to two seconds, an acceleration the bend of a parabola over two
seconds. At the ends of a track the window has one side; the acceleration then corrects the slope. An impossible
step divides a track. A single position far off its neighbours is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from sgstore.model.world import POSE, SMOOTHED, STANDS, UNREAL_ACCELERATION, UNREAL_TURN

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.world import Bools, Floats, Ints

ESTIMATED: Final = 120
"""Number of first frames from which the noise of a recording is estimated."""

HALF: Final = 0.5
"""Half the length of the time window in which the position of a standing body must not change; s."""

WIDE: Final = 1.0
"""Half the length of the time window for accelerations. Windows for velocities are not longer; s."""

MOST_ROWS: Final = 30
"""Largest number of frames on each side of a time window."""

CALM: Final = 0.05
"""Standard deviation that velocities should not exceed. It determines the length of the time window; m/s."""

STILL: Final = 0.01
"""Noise below which positions count as exact; m."""

BODIES: Final = 5
"""Smallest number of bodies that must show kinks, for positions to count as interpolated."""

KINKED: Final = 0.9
"""Smallest share of curvature at kinks, relative to a smooth curve, for positions to count as interpolated."""

USUAL: Final = 1.5
"""Usual acceleration of a body. An acceleration from a short, noisy window is reduced towards 0; m/s²."""

JUMP: Final = 0.5
"""Difference of a step from its neighbours, beyond noise and acceleration, that divides a track; m."""

UNREAL: Final = 12.0
"""Acceleration, along or across, above which a value is physically impossible; m/s²."""

SPINNING: Final = np.radians(120.0)
"""Yaw rate above which a value is physically impossible for a vehicle; rad/s."""

_X, _HEADING, _VELOCITY, _ACCELERATION, _YAW_RATE = (
    POSE.index(name) for name in ("x", "heading", "vx", "ax", "yaw_rate")
)


FROM_POSITIONS: Final = ("position_speed", "position_accel", "position_yaw_rate")
"""Attributes with motion from positions, if the motion is also recorded; m/s, m/s², degrees/s."""


class Noise(NamedTuple):
    """Noise of the recorded positions of bodies.

    Attributes
    ----------
    jitter : float
        Standard deviation from frame to frame; m.
    wander : float
        Standard deviation of the positions of bodies that stand, over seconds; m.
    """

    jitter: float = 0.0
    wander: float = 0.0

    def __bool__(self) -> bool:
        return bool(max(self) > 0)

    @property
    def enter(self) -> float:
        """Speed below which a moving body counts as standing; m/s."""
        return float(np.clip(0.1 + 3 * self.wander, 0.1, 0.35))

    @property
    def leave(self) -> float:
        """Speed above which a standing body counts as moving; m/s."""
        return 1.3 * self.enter

    def half(self, period: float) -> float:
        """Return half the length of the shortest time window that reduces the noise of velocities enough; s."""
        most = max(1, min(MOST_ROWS, int(WIDE / period)))
        squares = 2 * np.cumsum(np.arange(1, most + 1) ** 2.0)
        calm = self.jitter / (period * np.sqrt(squares)) <= CALM
        return period * (int(np.argmax(calm)) + 1 if calm.any() else most)


@dataclass(slots=True)
class Tracks:
    """States of bodies, sorted by body and time. A track is divided at movements that are too fast.

    Attributes
    ----------
    order : (n,) int64
        Rows in this order.
    frame, time : (n,) int64
        Number of the frame, and ns since the first one.
    place : (n, 3) float64
        x, y and z; m.
    turn : (n,) float64
        Heading; rad.
    part : (n,) int64
        Number of the part of a track.
    used : (n,) bool
        Rows with a usable position.
    period : float
        Time between frames; s.
    """

    order: Ints
    frame: Ints
    time: Ints
    place: Floats
    turn: Floats
    part: Ints
    used: Bools
    period: float

    @classmethod
    def of(
        cls,
        node: Ints,
        frame: Ints,
        seconds: Floats,
        values: Floats,
        jitter: float,
        period: float,
    ) -> Tracks:
        """Group the states of some frames into one track per body. See :meth:`Smoother.fill` for arguments."""
        order = np.lexsort([frame, node])
        # Whole nanoseconds: differences are then the same in every block.
        clock = np.cumsum(np.rint(np.where(seconds > 0, seconds, 0.0) * 1e9).astype(np.int64))
        torn = np.cumsum(~(seconds > 0))
        at, time = frame[order], clock[frame[order]]
        place = values[order, _X : _X + 3]
        used: Bools = np.isfinite(place[:, 0]) & np.isfinite(place[:, 1])
        breaks = np.ones(len(order), np.bool_)
        ahead = np.diff(at)
        breaks[1:] = (np.diff(node[order]) != 0) | (ahead > 3) | (np.diff(torn[at]) != 0)
        if len(order) > 3:
            far = _jumps(time, place[:, :2], np.cumsum(breaks, dtype=np.int64), jitter)
            # A row with a jump before and behind, but none over it, is an outlier.
            lone = np.flatnonzero(far[:-1] & far[1:]) if len(far) > 1 else np.zeros(0, np.int64)
            lone = lone[_close(time, place[:, :2], lone, jitter)]
            far[lone], far[lone + 1] = False, False
            used[lone] = False
            breaks |= far
        return cls(
            order,
            at,
            time,
            place,
            values[order, _HEADING],
            np.cumsum(breaks, dtype=np.int64),
            used,
            period,
        )

    def shifted(self, by: int) -> tuple[Ints, Bools]:
        """Return the rows ``by`` places later, and a mask of those in the same part of the same track."""
        rows = np.arange(len(self.order)) + by
        there = np.clip(rows, 0, len(rows) - 1)
        return there, (rows == there) & (self.part[there] == self.part) & self.used[there]

    def most(self, half: float) -> int:
        """Return the largest number of frames on each side of the middle of a time window."""
        return min(MOST_ROWS, round(half / self.period))

    def fits(self, values: Floats, half: float, degree: int, turn: float = 0.0) -> Fit:
        """Fit a polynomial to the values around each row, by least squares.

        Parameters
        ----------
        values : (n, c) float64
        half : float
            Half the window; s.
        degree : int
            1 or 2.
        turn : float
            Period of the values, such as 2π. 0: none.
        """
        sums = np.zeros((2 * degree + 1, len(values)))
        moments = np.zeros((degree + 1, *values.shape))
        low, high = np.zeros(len(values)), np.zeros(len(values))
        most = self.most(half)
        for by in range(-most, most + 1):
            there, inside = self.shifted(by)
            away = (self.time[there] - self.time) / 1e9
            inside &= (np.abs(away) <= half * 1.01) & (
                np.abs(self.frame[there] - self.frame) <= most
            )
            if not inside.any():
                continue
            rise = values[there] - values
            if turn:
                rise = rise - turn * np.round(rise / turn)
            known = inside & np.isfinite(rise).all(axis=1)
            away, rise = np.where(known, away, 0.0), np.where(known[:, None], rise, 0.0)
            power = known.astype(np.float64)
            for i in range(2 * degree + 1):
                sums[i] += power
                if i <= degree:
                    moments[i] += power[:, None] * rise
                power = power * away
            low, high = np.minimum(low, away), np.maximum(high, away)
        return Fit.of(sums, moments, high - low)


@dataclass(slots=True)
class Fit:
    """Polynomials fitted around each row: first and second derivative in the middle of the window.

    Attributes
    ----------
    slope, bend : (n, c) float64
        First and second derivative; NaN without enough rows.
    middle : (n,) float64
        Mean time of the window, from the time of the row; s.
    span : (n,) float64
        Length of the window; s.
    loose : (n,) float64
        Variance of the bend, if that of the values is 1; NaN without a bend.
    """

    slope: Floats
    bend: Floats
    middle: Floats
    span: Floats
    loose: Floats

    @classmethod
    def of(cls, sums: Floats, moments: Floats, span: Floats) -> Fit:
        """Compute the polynomials from sums of powers of time, and from weighted sums of the values."""
        with np.errstate(all="ignore"):
            middle = sums[1] / sums[0]
            degree = len(moments) - 1
            # Moments around the middle: the equations of slope and bend are then nearly independent.
            s2 = sums[2] / sums[0] - middle**2
            m0 = moments[0] / sums[0][:, None]
            m1 = moments[1] / sums[0][:, None] - middle[:, None] * m0
            slope = m1 / s2[:, None]
            bend, loose = np.full_like(slope, np.nan), np.full_like(middle, np.nan)
            if degree == 2:
                s3 = sums[3] / sums[0] - 3 * middle * sums[2] / sums[0] + 2 * middle**3
                s4 = sums[4] / sums[0] - 4 * middle * sums[3] / sums[0]
                s4 = s4 + 6 * middle**2 * sums[2] / sums[0] - 3 * middle**4
                m2 = (
                    moments[2] / sums[0][:, None]
                    - 2 * middle[:, None] * moments[1] / sums[0][:, None]
                )
                m2 = m2 + (middle**2)[:, None] * m0 - s2[:, None] * m0
                rest = s4 - s2**2 - s3**2 / s2
                bend = 2 * (m2 - (s3 / s2)[:, None] * m1) / rest[:, None]
                slope = slope - (s3 / s2)[:, None] * bend / 2
                bend[sums[0] < 4] = np.nan
                loose = 4 / (rest * sums[0])
        return cls(slope, bend, middle, span, loose)

    def instead(self, other: Fit, rows: Bools) -> Fit:
        """Return these fitted polynomials, but in some rows those of another fit."""
        return Fit(
            np.where(rows[:, None], other.slope, self.slope),
            np.where(rows[:, None], other.bend, self.bend),
            np.where(rows, other.middle, self.middle),
            np.where(rows, other.span, self.span),
            np.where(rows, other.loose, self.loose),
        )


def _jumps(time: Ints, place: Floats, part: Ints, jitter: float) -> Bools:
    """Return a mask of the rows that are too far from the row before for a real movement."""
    step = np.diff(time) / 1e9
    moved = np.diff(place, axis=0)
    whole = np.diff(part) == 0
    with np.errstate(all="ignore"):
        speed = moved / step[:, None]
        near = np.full((5, *speed.shape), np.nan)
        for i, by in enumerate((-2, -1, 1, 2, 0)):
            rows = np.arange(len(speed)) + by
            there = np.clip(rows, 0, len(speed) - 1)
            same = (rows == there) & whole[there] & (part[there + 1] == part[1:])
            near[i, same] = speed[there[same]]
        middle = _median(near)
        away = np.linalg.norm(moved - middle * step[:, None], axis=1)
    far = whole & (away > JUMP + 6 * jitter + 2 * UNREAL * step**2)
    return np.append(False, far)


def _median(values: Floats) -> Floats:
    """Return the median over the first axis without NaN values. It is NaN if all values are NaN."""
    ranked = np.sort(values, axis=0)
    count = np.isfinite(values).sum(axis=0)
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1)
    return (_nth(ranked, low) + _nth(ranked, high)) / 2


def _nth(values: Floats, which: Ints) -> Floats:
    return np.take_along_axis(values, which[None], axis=0)[0]


def _close(time: Ints, place: Floats, rows: Ints, jitter: float) -> Bools:
    """Return a mask of outliers: without such a row, the rows before and after it fit together."""
    inside = (rows >= 2) & (rows + 2 < len(time))
    rows = np.clip(rows, 2, max(2, len(time) - 3))
    with np.errstate(all="ignore"):  # Rows of other bodies and times do not count.
        before = (
            (place[rows - 1] - place[rows - 2]) / (time[rows - 1] - time[rows - 2])[:, None] * 1e9
        )
        step = (time[rows + 1] - time[rows - 1]) / 1e9
        away = place[rows + 1] - place[rows - 1] - before * step[:, None]
        limit = JUMP + 8 * jitter + 2 * UNREAL * step**2
    return inside & (np.linalg.norm(away, axis=1) <= limit)


@dataclass(slots=True)
class GapFiller:
    """Base class: fills in missing motion of bodies. Subclasses estimate it from noisy positions.

    Parameters
    ----------
    noise : Noise
    period : float
        Time between frames; s.

    Attributes
    ----------
    unreal : (2,) int64
        Number of impossible accelerations and yaw rates.
    apart : (5001,) int64
        Counts of differences between recorded speeds and speeds of positions, in steps of 0.01 m/s.
    """

    noise: Noise
    period: float
    unreal: Ints = field(default_factory=lambda: np.zeros(2, np.int64))
    apart: Ints = field(default_factory=lambda: np.zeros(5001, np.int64))

    def second(self, values: Floats, found: Floats) -> list[Mapping[str, float] | None]:
        """Compute motion from positions where velocity is recorded, else ``None``. Count speed differences."""
        added: list[Mapping[str, float] | None] = [None] * len(values)
        rows = np.flatnonzero(np.isfinite(values[:, _VELOCITY]))
        if not len(rows):
            return added
        found, heading = found[rows], values[rows, _HEADING]
        table = np.column_stack(
            [
                np.linalg.norm(found[:, :3], axis=1),
                found[:, 3] * np.cos(heading) + found[:, 4] * np.sin(heading),
                np.degrees(found[:, 6]),
            ]
        )
        speed = np.linalg.norm(values[rows, _VELOCITY : _VELOCITY + 3], axis=1)
        apart = np.abs(speed - table[:, 0])
        apart = np.clip(np.rint(100 * apart[np.isfinite(apart)]), 0, len(self.apart) - 1)
        self.apart += np.bincount(apart.astype(np.int64), minlength=len(self.apart))
        for row, numbers in zip(rows.tolist(), table.tolist(), strict=True):
            named = zip(FROM_POSITIONS, numbers, strict=True)
            added[row] = {name: value for name, value in named if math.isfinite(value)}
        return added

    def filled(
        self, values: Floats, found: Floats, fixed: Bools, stands: Bools
    ) -> tuple[Floats, Ints]:
        """Fill in missing motion, but no impossible values. Return the values, and bits of computed ones."""
        wanted, derived = values.copy(), np.zeros(len(values), np.int64)
        for bit, (column, first, width) in enumerate(
            ((_VELOCITY, 0, 3), (_ACCELERATION, 3, 3), (_YAW_RATE, 6, 1))
        ):
            part = found[:, first : first + width]
            takes = np.isnan(values[:, column]) & ~fixed & np.isfinite(part[:, 0])
            wanted[takes, column : column + width] = part[takes]
            derived |= takes.astype(np.int64) << bit
        with np.errstate(invalid="ignore"):
            hard = np.hypot(wanted[:, _ACCELERATION], wanted[:, _ACCELERATION + 1]) > UNREAL
            speed = np.hypot(wanted[:, _VELOCITY], wanted[:, _VELOCITY + 1])
            rate = np.abs(wanted[:, _YAW_RATE])
            spun = (rate > SPINNING) | (rate * speed > UNREAL)
        self.unreal += [int(hard.sum()), int(spun.sum())]
        wanted[hard & (derived & 2 > 0), _ACCELERATION : _ACCELERATION + 3] = np.nan
        wanted[spun & (derived & 4 > 0), _YAW_RATE] = np.nan
        for mask, bit in (
            (stands & ~fixed, STANDS),
            (hard, UNREAL_ACCELERATION),
            (spun, UNREAL_TURN),
            (~fixed, SMOOTHED),
        ):
            derived[mask] |= bit
        return wanted, derived

    def warnings(self) -> list[str]:
        """Return warnings about the noise and about impossible values, for a report."""
        noise, (hard, spun) = self.noise, self.unreal.tolist()
        found = [f"positions have a noise of {max(noise):.2g} m: missing motion is smoothed"]
        if count := int(self.apart.sum()):
            usual, most = np.searchsorted(np.cumsum(self.apart), [0.5 * count, 0.95 * count]) / 100
            words = f"{usual:.2g} m/s (median), {most:.2g} m/s (95 %)"
            found.append(f"recorded speeds differ from those of positions by {words}")
        if hard:
            found.append(f"{hard} accelerations above {UNREAL:g} m/s² are impossible")
        if spun:
            found.append(f"{spun} yaw rates are impossible")
        return found


@dataclass(slots=True)
class Smoother(GapFiller):
    """Velocities, accelerations and yaw rates computed from noisy positions, one block after another.

    The windows are centred: a block needs frames after it. See :class:`OnlineSmoother` for the causal form.
    """

    _stands: dict[int, bool] = field(default_factory=dict[int, bool])

    @property
    def reach(self) -> int:
        """Number of frames before and after a frame that influence its values."""
        return min(MOST_ROWS, int(np.ceil(WIDE / self.period))) + 3

    def fill(
        self, node: Ints, frame: Ints, seconds: Floats, values: Floats, fixed: Bools, rows: slice
    ) -> tuple[Floats, Ints, list[Mapping[str, float] | None]]:
        """Fill in missing motion. Return the values, bits that mark computed quantities, and attributes.

        Parameters and result are those of :func:`sgstore.readers._blocks.derive`. The attributes are motion
        from positions, of rows whose motion is recorded.
        """
        tracks = Tracks.of(node, frame, seconds, values, self.noise.jitter, self.period)
        half = self.noise.half(self.period)
        near = tracks.fits(tracks.place, half, 1)
        calm = tracks.fits(tracks.place, HALF, 1) if half < HALF else near
        if self.noise.jitter:  # At the end of a track, the window on one side must be longer.
            near = near.instead(calm, near.span < 1.9 * half)
        wide = tracks.fits(tracks.place, WIDE, 2)
        turns = tracks.fits(tracks.turn[:, None], HALF, 1, 2 * np.pi)
        sure = USUAL**2 / (USUAL**2 + self.noise.jitter**2 * wide.loose)
        bend = np.where((wide.span >= HALF)[:, None], wide.bend * sure[:, None], np.nan)
        moved = near.slope - np.nan_to_num(bend) * near.middle[:, None]
        moved[:, 2] = calm.slope[:, 2]
        back = np.empty(len(node), np.int64)
        back[tracks.order] = np.arange(len(node))
        at = back[rows]
        found = np.column_stack([moved, bend, turns.slope])[at]
        speed = np.hypot(calm.slope[:, 0], calm.slope[:, 1])
        stands = self._standing(node[rows], frame[rows], speed[at])
        found[stands & np.isfinite(found[:, 2]), 2] = 0.0  # The height of boxes trembles, too.
        filled, derived = self.filled(values[rows], found, fixed[rows], stands)
        return filled, derived, self.second(values[rows], found)

    def _standing(self, node: Ints, frame: Ints, speed: Floats) -> Bools:
        """Return a mask of the rows with a standing body: slow, or not yet fast enough to count as moving."""
        enter, leave = self.noise.enter, self.noise.leave
        sure = np.where(speed <= enter, 1, np.where(speed > leave, -1, 0))
        order = np.lexsort([frame, node])
        ids = node[order]
        starts = np.diff(ids, prepend=-1) != 0
        first = np.array([self._stands.get(one, False) for one in ids[starts].tolist()], np.int64)
        kept = sure[order]
        begin = np.flatnonzero(starts)
        kept[begin] = np.where(kept[begin] == 0, 2 * first - 1, kept[begin])
        last = np.maximum.accumulate(np.where(kept != 0, np.arange(len(kept)), 0))
        result = np.empty(len(node), np.bool_)
        result[order] = kept[last] > 0
        ends = np.append(begin[1:], len(ids)) - 1
        self._stands.update(zip(ids[ends].tolist(), result[order][ends].tolist(), strict=True))
        return result


PLACE: Final = 3.0
"""Dead band of a noisy place for lanes, in units of the noise."""


def dead_band(noise: float, derived: Ints) -> Floats:
    """Return half the width of the dead band of each position, (n,); m. 0 for a position without smoothing."""
    return np.where(derived & SMOOTHED > 0, PLACE * noise, 0.0)


class DeadBand:
    """Filter of noisy positions with a dead band: a returned position stays until the input leaves the band.

    Each returned place is within the band of the position. A lane therefore does not change by noise.
    """

    MOST: Final = 20_000
    """Number of bodies that are remembered."""

    def __init__(self) -> None:
        # Node → last position, and its distance from the returned place along and across the heading.
        self._last: dict[int, tuple[float, ...]] = {}

    def held(self, node: Ints, frame: Ints, place: Floats, heading: Floats, band: Floats) -> Floats:
        """Return the filtered positions of bodies.

        Parameters
        ----------
        node, frame : (n,) int64
        place : (n, 2) float64
            Positions; m.
        heading : (n,) float64
            rad
        band : (n,) float64
            Half width of the dead band along and across the heading; m. 0: the position is exact.
        """
        found = place.copy()
        noisy = np.flatnonzero((band > 0) & np.isfinite(place).all(axis=1))
        for number in np.unique(frame[noisy]):
            at = noisy[frame[noisy] == number]
            ids = node[at].tolist()
            last = np.array(
                [self._last.pop(one, (np.nan,) * 4) for one in ids], np.float64
            ).reshape(-1, 4)
            cos, sin = np.cos(heading[at]), np.sin(heading[at])
            x, y = (place[at] - last[:, :2]).T
            moved = np.stack([x * cos + y * sin, y * cos - x * sin], axis=1)
            apart = np.nan_to_num(last[:, 2:] + moved)
            apart = np.clip(apart, -band[at, None], band[at, None])
            found[at, 0] -= apart[:, 0] * cos - apart[:, 1] * sin
            found[at, 1] -= apart[:, 0] * sin + apart[:, 1] * cos
            rows = np.column_stack([place[at], apart]).tolist()
            self._last.update(zip(ids, map(tuple, rows), strict=True))
        while len(self._last) > self.MOST:
            del self._last[next(iter(self._last))]
        return found


def noise_of(node: Ints, frame: Ints, seconds: Floats, values: Floats, fixed: Bools) -> Noise:
    """Estimate the noise of positions. See :meth:`Smoother.fill` for the arguments.

    A noisy body that stands stays within a metre for two seconds, and turns back on its way. Bodies of a
    simulator stay exactly, or move on. Third differences show the noise from frame to frame.
    """
    rows = np.flatnonzero(~fixed)
    period = float(np.nanmedian(seconds)) if np.isfinite(seconds).any() else 0.1
    tracks = Tracks.of(node[rows], frame[rows], seconds, values[rows], 0.1, period)
    place = tracks.place[:, :2]
    whole = np.diff(tracks.part) == 0
    steps = np.linalg.norm(np.diff(place, axis=0), axis=1)
    wander: list[float] = []
    starts = np.flatnonzero(np.append(True, ~whole))
    for a, b in zip(starts, np.append(starts[1:], len(place)), strict=True):
        part, seen = place[a:b], tracks.time[a:b]
        if b - a < 5 or seen[-1] - seen[0] < 2e9 * WIDE:
            continue
        size = float(np.hypot(*np.ptp(part, axis=0)))
        if size <= 1 and steps[a : b - 1].sum() > 1.5 * size:
            wander.append(float(np.std(part, axis=0).max()))
    calm = float(np.median(wander)) if wander else 0.0
    jitter, rough = _jitter(tracks)
    if max(calm, jitter) < STILL and not rough:
        return Noise()
    return Noise(jitter if jitter >= STILL / 2 else 0.0, max(calm, jitter, STILL))


def _jitter(tracks: Tracks) -> tuple[float, bool]:
    """Return the noise between frames (m), and True if positions seem interpolated between few points."""
    place, n = tracks.place[:, :2], len(tracks.place)
    if n < 20:
        return 0.0, False
    whole = tracks.part[3:] == tracks.part[:-3]
    third = np.linalg.norm(np.diff(place, 3, axis=0)[whole], axis=1)
    jitter = float(np.median(third)) / (1.1774 * 20**0.5) if len(third) else 0.0
    wide = tracks.fits(place, HALF, 2)
    middle = tracks.part[2:] == tracks.part[:-2]
    step = (tracks.time[2:] - tracks.time[:-2])[:, None] / 2e9
    with np.errstate(all="ignore"):
        bend = np.diff(place, 2, axis=0) / step**2
        smooth = wide.bend[1:-1]
        apart = np.linalg.norm(bend - smooth, axis=1)
        both = np.linalg.norm(bend, axis=1) + np.linalg.norm(smooth, axis=1)
        bent = middle & (np.linalg.norm(smooth, axis=1) > 0.3)
        share = (apart / both)[bent]
    bodies = len(np.unique(tracks.part[1:-1][bent]))
    return jitter, bodies >= BODIES and float(np.median(share)) > KINKED
