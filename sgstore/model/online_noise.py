"""Motion from noisy positions without later frames: online version of :mod:`sgstore.model.noise`.

Notes
-----
A Kalman filter with Singer's model follows each body: its acceleration is usual (:data:`ACCELERATION`) and
fades (:data:`FADES`). A line through the last positions, with weights that fade, decides if the body stands.
Of a body that was seen for a short time, the motion is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from sgstore.base.geometry import wrapped
from sgstore.base.tables import chained, taken
from sgstore.model.noise import (
    ESTIMATED,
    HALF,
    JUMP,
    WIDE,
    GapFiller,
    Noise,
    noise_of,
)
from sgstore.model.world import POSE, SMOOTHED

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.world import Bools, Floats, FrameBlock, Ints

ACCELERATION: Final = 2.0
"""Usual acceleration of a body; m/s². For its heading; rad/s²."""

FADES: Final = 2.0
"""Time constant with which an acceleration decreases; s."""

SPEED: Final = 15.0
"""Usual speed of a body that is seen for the first time; m/s."""

CALMEST: Final = 0.3
"""Smallest time constant for the weights of earlier positions; s. The largest is that of ``WIDE``."""

TRIED: Final = (30, 60, ESTIMATED)
"""Numbers of frames after which an estimate of the noise is tried."""

_FOLLOWED: Final = [POSE.index(name) for name in ("x", "y", "z", "heading")]
_VELOCITY: Final = POSE.index("vx")


@dataclass(slots=True)
class _Followed:
    """Filter state of each body seen in the last frames, sorted by node id.

    Attributes
    ----------
    node : (n,) int64
    seen, since : (n,) float64
        Times of the last and of the first position; s.
    mean : (n, 3, 4) float64
        Value, rate and acceleration of x, y, z and heading.
    spread : (n, 3, 3) float64
        Covariance of each of them.
    last : (n, 2) float64
        Last position.
    sums : (n, 3) float64
        Fading weights of the positions: sum, first and second moment of their times from now.
    moments : (n, 2, 2) float64
        Weighted x and y from the last position: sum, and first moment.
    stands, lone : (n,) bool
        True if the body stands; if the last position was far off.
    """

    node: Ints
    seen: Floats
    since: Floats
    mean: Floats
    spread: Floats
    last: Floats
    sums: Floats
    moments: Floats
    stands: Bools
    lone: Bools

    @classmethod
    def new(cls, node: Ints, place: Floats, now: float, variance: float) -> _Followed:
        """Return the filter state of bodies in their first frame."""
        n = len(node)
        mean, sums = np.zeros((n, 3, 4)), np.zeros((n, 3))
        mean[:, 0], sums[:, 0] = np.nan_to_num(place), 1.0
        spread = np.tile(np.diag([variance, SPEED**2, ACCELERATION**2]), (n, 1, 1))
        time, no, line = np.full(n, now), np.zeros(n, np.bool_), np.zeros((n, 2, 2))
        seen = node, time, time.copy(), mean, spread, place[:, :2].copy(), sums, line
        return cls(*seen, no, no.copy())

    def put(self, rows: Ints | Bools, other: _Followed) -> None:
        """Overwrite some rows with the rows of another table. The node ids stay as they are."""
        for column in fields(self)[1:]:
            getattr(self, column.name)[rows] = getattr(other, column.name)


@dataclass(slots=True)
class OnlineSmoother(GapFiller):
    """Velocities, accelerations and yaw rates computed from noisy positions, without later frames."""

    _clock: float = 0.0
    _bodies: _Followed = field(
        default_factory=lambda: _Followed.new(np.zeros(0, np.int64), np.zeros((0, 4)), 0.0, 0.0)
    )

    def fill(
        self, node: Ints, frame: Ints, seconds: Floats, values: Floats, fixed: Bools, rows: slice
    ) -> tuple[Floats, Ints, list[Mapping[str, float] | None]]:
        """Fill in missing motion in the next frames. Return values, bits of computed ones, and attributes.

        Parameters and result are those of :meth:`sgstore.model.noise.Smoother.fill`.
        """
        node, frame, values, fixed = node[rows], frame[rows], values[rows], fixed[rows]
        found, stands = np.full((len(node), 7), np.nan), np.zeros(len(node), np.bool_)
        placed = np.isfinite(values[:, _FOLLOWED[:2]]).all(axis=1) & ~fixed
        first = int(frame[0]) if len(frame) else 0
        for number in range(first, int(frame[-1]) + 1 if len(frame) else 0):
            of = np.flatnonzero((frame == number) & placed)
            of = of[np.argsort(node[of])]
            place = values[of][:, _FOLLOWED]
            found[of], stands[of] = self._step(node[of], float(seconds[number]), place)
        found[stands & np.isfinite(found[:, 2]), 2] = 0.0
        filled, derived = self.filled(values, found, fixed, stands)
        return filled, derived, self.second(values, found)

    def smoothed(self, block: FrameBlock, node: Ints, seconds: float) -> FrameBlock:
        """Return a block of one frame with motion filled in. ``seconds``: time since the frame before.

        Rows that a reader has smoothed stay the same.
        """
        states = block.states
        values = np.stack([getattr(states, name) for name in POSE], axis=1)
        fixed = (states.light_state >= 0) | (states.derived & SMOOTHED > 0)
        whole = np.zeros(len(node), np.int64), np.array([seconds])
        filled, derived, more = self.fill(node, *whole, values, fixed, slice(0, len(node)))
        own = states.own.copy()
        for row, one in enumerate(more):
            if one:
                own[row] = {**(own[row] or {}), **one}
        columns = {name: filled[:, i] for i, name in enumerate(POSE)}
        moved = replace(states, derived=states.derived | derived, own=own, **columns)
        return replace(block, states=moved, noise=max(self.noise))

    def _step(self, node: Ints, seconds: float, place: Floats) -> tuple[Floats, Bools]:
        """Return velocity, acceleration, yaw rate of the next frame's bodies, and a mask of standing ones."""
        before, step = self._bodies, seconds if seconds > 0 else self.period
        variance, calm = self._white(step)
        longest = max(HALF, 3.01 * step) if seconds > 0 else -1.0
        self._clock += step
        before = taken(before, np.flatnonzero(self._clock - before.seen <= longest))
        at = np.searchsorted(before.node, node)
        known = np.isin(node, before.node)
        bodies = _Followed.new(node, place, self._clock, variance)
        old = taken(before, at[known])
        bodies.put(known, self._followed(old, place[known], variance, calm))
        motion = self._motion(bodies, place, calm)
        absent = taken(before, np.flatnonzero(~np.isin(before.node, node)))
        both = chained([bodies, absent])
        self._bodies = taken(both, np.argsort(both.node))
        return motion

    def _white(self, step: float) -> tuple[float, float]:
        """Return the variance of white noise that has the same effect, and the decay time of the weights; s."""
        jitter, wander = self.noise
        slow = max(0.0, wander**2 - jitter**2) * max(1.0, HALF / step)
        variance = jitter**2 + slow
        calm = (4 * step * variance / self.noise.enter**2) ** (1 / 3)
        return variance, float(np.clip(calm, CALMEST, WIDE))

    def _followed(
        self, bodies: _Followed, place: Floats, variance: float, calm: float
    ) -> _Followed:
        """Return the filter state of already known bodies after the next frame."""
        step = self._clock - bodies.seen
        mean, spread = _predicted(bodies, step)
        rest = place - mean[:, 0]
        rest[:, 3] = wrapped(rest[:, 3])
        total = spread[:, 0, 0] + variance
        far = np.hypot(rest[:, 0], rest[:, 1]) > JUMP + 6 * np.sqrt(total)
        gain = np.where(far[:, None], 0.0, spread[:, :, 0] / total[:, None])
        mean += gain[:, :, None] * np.nan_to_num(rest)[:, None]
        spread -= gain[:, :, None] * spread[:, :1]
        last = np.where(far[:, None], bodies.last, place[:, :2])
        sums, line = _faded(bodies, last - bodies.last, step, calm)
        sums[:, 0] += ~far
        now = np.full(len(step), self._clock)
        times = bodies.node, now, bodies.since
        result = _Followed(*times, mean, spread, last, sums, line, bodies.stands, far)
        again = far & bodies.lone  # Two positions far off: the body jumped.
        fresh = _Followed.new(bodies.node[again], place[again], self._clock, variance)
        result.put(again, fresh)
        return result

    def _motion(self, bodies: _Followed, place: Floats, calm: float) -> tuple[Floats, Bools]:
        """Return velocity, acceleration and yaw rate of bodies, and a mask of those that stand."""
        (s0, s1, s2), (m0, m1) = bodies.sums.T, bodies.moments.transpose(1, 2, 0)
        with np.errstate(all="ignore"):
            slope = ((m1 * s0 - s1 * m0) / (s2 * s0 - s1**2)).T
        slow = np.hypot(*slope.T)
        fast = np.hypot(*bodies.mean[:, 1, :2].T) - 5 * np.sqrt(bodies.spread[:, 1, 1])
        age = bodies.seen - bodies.since + 1e-6
        limit = np.where(bodies.stands | (age < 3 * calm), self.noise.leave, self.noise.enter)
        seen = age >= 2 * calm
        bodies.stands = seen & (slow <= limit) & (fast <= limit)
        speed = bodies.mean[:, 1, :3].copy()
        speed[bodies.stands, :2] = slope[bodies.stands]
        found = np.column_stack([speed, bodies.mean[:, 2, :3], bodies.mean[:, 1, 3]])
        found[~seen] = np.nan
        unknown = np.isnan(place[:, 2])
        found[unknown, 2] = found[unknown, 5] = np.nan
        found[np.isnan(place[:, 3]), 6] = np.nan
        return found, bodies.stands


def _predicted(bodies: _Followed, step: Floats) -> tuple[Floats, Floats]:
    """Predict mean and covariance after a time ``step`` (s), with Singer's motion model."""
    fade = np.exp(-step / FADES)
    speed = FADES * (1 - fade)
    ahead = np.tile(np.eye(3), (len(step), 1, 1))
    ahead[:, 0, 1], ahead[:, 1, 2], ahead[:, 2, 2] = step, speed, fade
    ahead[:, 0, 2] = FADES * (step - speed)
    power = step[:, None] ** np.arange(1, 6)
    added = np.empty((len(step), 3, 3))
    for i in range(3):
        for j in range(3):
            k = 4 - i - j
            added[:, i, j] = power[:, k] / ((k + 1) * (1, 1, 2)[2 - i] * (1, 1, 2)[2 - j])
    added *= 2 * ACCELERATION**2 / FADES
    return ahead @ bodies.mean, ahead @ bodies.spread @ ahead.transpose(0, 2, 1) + added


def _faded(bodies: _Followed, moved: Floats, step: Floats, calm: float) -> tuple[Floats, Floats]:
    """Reduce the weights of old positions after a time step. Return sums relative to the new position."""
    s0, s1, s2 = bodies.sums.T
    m0, m1 = bodies.moments[:, 0], bodies.moments[:, 1]
    fade = np.exp(-step / calm)
    sums = np.stack([s0, s1 - step * s0, s2 - 2 * step * s1 + step**2 * s0], axis=1)
    first = m0 - moved * s0[:, None]
    second = m1 - step[:, None] * m0 - moved * (s1 - step * s0)[:, None]
    return sums * fade[:, None], np.stack([first, second], axis=1) * fade[:, None, None]


@dataclass(slots=True)
class ClientNoise:
    """Smoother for the frames of a client. It takes the noise from the settings or the first frames.

    Parameters
    ----------
    noise : float
        Setting ``noise``; m. 0: exact. -1: estimated, if no body of the first frames has a velocity.
    """

    noise: float
    _smoother: OnlineSmoother | None = None
    _time_ns: int | None = None
    _first: list[_Seen] | None = field(default_factory=list["_Seen"])

    def smoothed(self, block: FrameBlock, node: Ints) -> FrameBlock:
        """If the positions have noise, return a block of one frame with motion filled in."""
        now = int(block.time_ns[0])
        before, self._time_ns = self._time_ns, now
        seconds = (now - before) / 1e9 if before is not None else np.nan
        if self._first is not None:
            self._watch(self._first, _Seen(block, node, seconds))
        return self._smoother.smoothed(block, node, seconds) if self._smoother else block

    def _watch(self, first: list[_Seen], seen: _Seen) -> None:
        """Create the smoother as soon as the noise is known from the settings or the first frames."""
        states, noise = seen.block.states, Noise(self.noise, self.noise)
        if self.noise < 0:
            moved = np.isfinite(states.vx) | (states.derived & SMOOTHED > 0)
            if moved.any():
                self._first = None
                return
            first.append(seen)
            count = len(first)
            if count not in TRIED:
                return
            noise = _noise_of(first)
            if not noise and count < TRIED[-1]:
                return
        if noise:
            self._smoother = OnlineSmoother(noise, 0.1)
            for one in first[:-1]:
                self._smoother.smoothed(*one)
        self._first = None


class _Seen(NamedTuple):
    """Frame of a client: its block, final node ids, and the time since the frame before; s."""

    block: FrameBlock
    node: Ints
    seconds: float


def _noise_of(frames: list[_Seen]) -> Noise:
    """Estimate the noise of the positions in some frames."""
    states = chained([one.block.states for one in frames])
    return noise_of(
        np.concatenate([one.node for one in frames]),
        np.repeat(np.arange(len(frames)), [len(one.node) for one in frames]),
        np.array([one.seconds for one in frames]),
        np.stack([getattr(states, name) for name in POSE], axis=1),
        states.light_state >= 0,
    )
