"""Check for impossible data in valid recordings: wrong units or axes, jumps, reused ids, impossible lights.

:class:`Plausibility` sees the blocks of a recording during an ingest or ``doctor``. It compares values that
describe the same fact: recorded velocities with displacements, headings with directions of movement, lights
with the lanes of the map. It judges the contradictions after the last block.

Notes
-----
A threshold must be far from the noise of measured data. Each constant has its reason. A contradiction of
numbers counts only if most rows agree on one factor, angle or axis. Noise does not agree.
"""

from __future__ import annotations

import re
from array import array
from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from sgstore.base.display import number_of
from sgstore.graphs.online import entities_of
from sgstore.mcap import Findings
from sgstore.model.vocabulary import (
    DRIVING,
    KIND_CODE,
    KINDS,
    LIGHT_STATE_CODE,
    LIGHT_STATES,
    kinds_labelled,
)
from sgstore.model.world import INPUTS, POSE, FrameBlock, MessageRefs, States
from sgstore.pipeline.contradictions import (
    AGREEING,
    COURSE,
    HEIGHT,
    LENGTH,
    LIGHT,
    SHARE,
    STANDING,
    VX,
    BodyRows,
    Steps,
    Tally,
    X,
    add_contradictions,
    judged,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from sgstore.graphs.online import Entity, Frame
    from sgstore.maps.roads import RoadMap
    from sgstore.mcap import Loss
    from sgstore.model.world import Bools, Floats, Ints

JUMP: Final = 2.5
"""Smallest jump of a vehicle that counts, beyond the movement that its speed explains; m. Half a car."""

STRIDE: Final = 5.0
"""Smallest jump of other bodies that counts; m. People in SUMO jump by up to 3.8 m between lanes."""

BRAKING: Final = 10.0
"""Largest acceleration of a body while it is absent; m/s². It is the limit of tyres on dry roads."""

GROWTH: Final = 1.5
GROWN: Final = 0.5
"""Smallest change of size of a rigid body that counts: as a share of the size, and in m."""

NOISY: Final = 4.0
"""Factor between the sizes of bodies whose size changes often, as in measured tracks, that counts."""

LARGEST: Final = {"person": 3.0, "bicycle": 5.0, "motorcycle": 6.0, "train": 500.0}
"""Largest possible length and width by kind; m. For other vehicles: 60 m. Road trains have 53.5 m."""

LEAST: Final = {"person": 0.1, "bicycle": 0.5, "motorcycle": 0.8}
"""Smallest possible length by kind; m. Other vehicles: 1 m."""

FLICKER_NS: Final = 400_000_000
"""Smallest duration of a light state; ns. A flashing light is on for half a second."""

CYCLE_NS: Final = 120_000_000_000
"""Longest time without a change of any light; ns. It is the longest cycle of the German guidelines (RiLSA)."""

FAR: Final = 1e6
"""Coordinate from which positions in 32 bits are coarse; m. Their steps are then 6 cm or more."""

ASIDE: Final = 30.0
"""Largest distance of the ego from all lanes; m. Parking areas are nearer than this."""

ON_LANES: Final = 0.5
"""Largest share of moving vehicles outside all lanes: 0.22 in Argoverse 2, 0.5 to 1 with mirrored axes."""

SAMPLED: Final = 10
"""Interval of frames that are compared with the map, and searched for duplicate bodies."""

SHORTEST_NS: Final = 100_000
LONGEST_NS: Final = 10_000_000_000
"""Longest plausible time between frames; ns. A longer time means a wrong unit."""

REMEDY: Final = {
    "mixed passes": "write the messages before the step and those after it to two files",
    "velocity unit": "write m/s, metres and nanoseconds",
    "velocity axes": "write velocities in the axes of the positions (x east, y north)",
    "velocity missing": "leave out a velocity that is unknown, instead of 0",
    "frozen": "check the source of the positions; leave out bodies without new positions",
    "heading": "write headings in radians, counter-clockwise from the x axis (east)",
    "backwards": "turn headings by 180°: the front of a body points along its x axis",
    "acceleration unit": "write accelerations in m/s²",
    "gravity": "subtract gravity from accelerations",
    "yaw rate unit": "write yaw rates in rad/s",
    "yaw rate sign": "write yaw rates counter-clockwise: check the handedness of the axes",
    "angle unit": "write angles in radians",
    "upside down": "write roll and pitch in radians; z points up",
    "z down": "write z upwards: a body stands on the ground",
    "impossible speed": "check the unit of velocities (m/s) and of positions (m)",
    "teleport": "check positions, or give a body that is set elsewhere a new id",
    "swapped ids": "give each body the same id in all frames",
    "reused id": "give each body its own id",
    "doubled body": "write each body once; check if the ego is also an object",
    "size jump": "write one size per body",
    "impossible size": "write full length, width and height in metres; leave out unknown ones",
    "width and length swapped": "write the length along the x axis of the body",
    "half sizes": "write full sizes, not half extents",
    "placeholder size": "leave out unknown sizes",
    "rounded positions": "write 64-bit positions, or subtract an offset first",
    "doubled stamps": "write the time of each frame once",
    "unsorted stamps": "sort the frames by time",
    "time unit": "write time in nanoseconds",
    "ego missing": "write the ego in each frame, or name another ego",
    "off the map": "use the road map and the axes of this recording",
    "wrong way": "check the axes (y to the left of x), and the side of traffic of the map",
    "light without lanes": "refer to the light's signal in the map, or to its lanes",
    "light order": "check the order of the states of the light",
    "light flickers": "check the states of the light",
    "lights never change": "check the source of the light states",
    "control range": "write throttle and brake from 0 to 1, steering from -1 to 1",
}
"""Kind of implausible data → what the user can do about it."""

_OF_STEPS: Final = frozenset(
    (
        *("velocity unit", "velocity axes", "velocity missing", "frozen", "heading", "backwards"),
        *("acceleration unit", "gravity", "yaw rate unit", "yaw rate sign", "impossible speed"),
        *("teleport", "swapped ids", "reused id", "size jump", "doubled stamps", "unsorted stamps"),
        *("light order", "light flickers"),
    )
)
"""Kinds that compare frames. Mixed passes of a recording cause them, too."""

_VEHICLES: Final = np.array([KIND_CODE[kind] for kind in kinds_labelled("Vehicle") or ()])
_ON_ROAD: Final = np.array([KIND_CODE[kind] for kind in ("car", "truck", "van", "bus")])
_FAULT: Final = re.compile(
    r"(\w+) of entity '(.*)' is (\S+ m(?:/s)?): missing in (\d+) states(?:, first in frame (\d+))?"
)


@dataclass(frozen=True, slots=True)
class Finding:
    """Implausible data of one kind in a recording: first place, value and remedy.

    Attributes
    ----------
    kind : str
        Name of the kind: a key of :data:`REMEDY`.
    entity : str
        Id of the first entity; empty for the recording.
    frame : int
        Number of the first frame.
    seconds : float
        Time of this frame since the start; s.
    entities, times : int
        Number of entities, and of observations.
    value : str
        What contradicts what.
    remedy : str
        What the user can do.
    """

    kind: str
    entity: str
    frame: int
    seconds: float
    entities: int
    times: int
    value: str
    remedy: str

    def as_dict(self) -> dict[str, Any]:
        """Return the finding as JSON values."""
        return asdict(self)

    def __str__(self) -> str:
        of = f"entity {self.entity!r}, " if self.entity else ""
        more = f" and {self.entities - 1} more entities" if self.entities > 1 else ""
        place = f"{of}frame {self.frame} ({self.seconds:g} s){more}"
        return f"{self.kind}: {self.value}; {place}; {self.remedy}"


@dataclass(slots=True)
class _Event:
    """All cases of one kind of implausible data: the first case, the entities, and the number of cases."""

    node: int
    frame: int
    value: str
    times: int = 0
    nodes: set[int] = field(default_factory=set[int])


class Plausibility:
    """Check of the blocks of one recording for implausible data.

    Parameters
    ----------
    road_map : RoadMap, optional
        The map of the recording.

    Examples
    --------
    >>> from sgstore.pipeline.plausibility import Plausibility
    >>> Plausibility().findings()
    []
    """

    def __init__(self, road_map: RoadMap | None = None) -> None:
        self._map = road_map
        self._idents: list[str] = []
        self._nodes: dict[str, int] = {}
        self._client_nodes: dict[str, int] = {}
        self._kinds: Ints = np.zeros(0, np.int64)
        self._rows: BodyRows | None = None
        self._time_ns, self._log_time_ns = array("q"), array("q")
        self._tally = Tally()
        self._events: dict[str, _Event] = {}
        self._moves: list[_Move] = []
        self._sizes: dict[str, set[int]] = {name: set() for name in ("all", "cars", *_SIZE_KINDS)}
        self._steady: Counter[int] = Counter()
        self._grown: dict[int, tuple[int, str]] = {}
        self._shares: Counter[str] = Counter()
        self._doubled: Counter[tuple[int, int]] = Counter()
        self._changed: dict[int, tuple[int, int]] = {}
        self._orders: dict[int, set[tuple[str, str]]] = {}
        self._lit: set[int] = set()
        self._lights: dict[int, str] = {}
        self._places: list[Floats] = []
        self._sampled = 0
        self._has_lanes = road_map is not None and bool(
            np.isin(road_map.nodes.lane_type, [*DRIVING]).any()
        )

    def see(self, block: FrameBlock) -> None:
        """Check the next block of frames for implausible data."""
        entities = block.entities
        before = len(self._idents)
        self._idents += entities.ident
        lights = np.flatnonzero(entities.kind == KIND_CODE["traffic_light"]).tolist()
        self._lights |= {before + row: entities.map_ref[row] for row in lights}
        self._kinds = np.concatenate([self._kinds, entities.kind.astype(np.int64)])
        self._time_ns.frombytes(block.time_ns.astype(np.int64).tobytes())
        self._log_time_ns.frombytes(block.log_time_ns.astype(np.int64).tobytes())
        missing = np.flatnonzero(block.ego < 0)
        present = np.flatnonzero(block.ego >= 0)
        if len(present):
            self._shares["ego"] = int(block.seq[present[-1]]) + 1
        if len(missing):
            self._happen("ego missing", -1, int(block.seq[missing[0]]), "the frame has no ego")
            self._events["ego missing"].times += len(missing) - 1
        steps = Steps.of(block, self._rows)
        self._rows = rows = steps.rows
        add_contradictions(steps, self._kinds, self._tally)
        self._see_jumps(rows)
        if entities.lifetime:
            self._see_returned(rows, before)
        if (steps.known & (steps.frames > 1)).any():
            self._see_absences(steps)
        self._see_growth(steps)
        self._see_bodies(block)
        self._see_samples(block)
        if (rows.values[:, LIGHT] >= 0).any():
            self._see_lights(rows)

    def watched(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames of a client (monitor or running simulator) as they are, and check them.

        Examples
        --------
        >>> checked = Plausibility()
        >>> frames = [sgstore.Frame(time_ns) for time_ns in (0, 100_000_000, 100_000_000)]
        >>> len(list(checked.watched(frames)))
        3
        >>> print(checked.findings()[0])
        doubled stamps: simulation time stands still 1 time; frame 2 (0.1 s); write the time of each frame once
        """
        waiting: list[Frame] = []
        try:
            for frame in frames:
                waiting.append(frame)
                if len(waiting) == _TOGETHER:
                    self._see_frames(waiting)
                    waiting = []
                yield frame
        finally:
            self._see_frames(waiting)

    def _see_frames(self, frames: list[Frame]) -> None:
        """Check frames of a client after their conversion to a block."""
        if not frames:
            return
        known = self._client_nodes
        new: list[Entity] = []
        for entity in (entity for frame in frames for entity in frame.entities):
            if entity.ident not in known:
                known[entity.ident] = len(known)
                new.append(entity)
        rows = [e for frame in frames for e in frame.entities if not e.static]
        names = (*POSE, *INPUTS, "lights", "light_state", "derived")
        numbers = np.array([(*e.numbers, *e.whole) for e in rows]).reshape(-1, len(names))
        columns = dict(zip(names, numbers.T, strict=True))
        columns |= {name: columns[name].astype(np.int64) for name in names[-3:]}
        counts = [sum(not e.static for e in frame.entities) for frame in frames]
        first = len(self._time_ns)
        none = np.zeros(0, np.int64)
        self.see(
            FrameBlock(
                seq=np.arange(first, first + len(frames)),
                time_ns=np.array([frame.time_ns for frame in frames]),
                log_time_ns=np.zeros(len(frames), np.int64),
                offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
                states=States.of(
                    node=np.array([known[e.ident] for e in rows], np.int64),
                    **columns,
                ),
                ego=np.array([known.get(frame.ego, -1) for frame in frames], np.int64),
                entities=entities_of(len(self._idents), new),
                scenery=States.of(node=none),
                messages=MessageRefs(none, none, none, none, none),
            )
        )

    def findings(self, report: Findings | None = None) -> list[Finding]:
        """Return the implausible data, one finding for each kind. Call it once, after the last block.

        Parameters
        ----------
        report : Findings, optional
            Report of the reader. Values that are impossible alone are among its losses. If passes of the
            recording are mixed, one finding with the reason replaces those that begin among mixed frames.
        """
        report = report or Findings()
        losses, passes = report.losses, report.passes
        contradicting = sum(vote.rows for vote in self._tally.votes.values())
        found = [
            self._finding(one.kind, one.node, one.frame, one.nodes, one.rows, one.value)
            for one in (judged(self._tally) if contradicting >= STANDING else ())
            if one.kind not in self._events
        ]
        found += self._lost(losses) if losses else ()
        if self._moves or self._grown:
            self._judge_moves()
        if self._lit:
            self._judge_lights()
        self._judge()
        steps = np.diff(self._time_ns)
        for kind, words, wrong in (
            ("doubled stamps", "stands still", steps == 0),
            ("unsorted stamps", "runs backwards", steps < 0),
        ):
            if times := int(wrong.sum()):
                value = f"simulation time {words} {number_of(times, 'time')}"  # as the reader
                self._events[kind] = _Event(-1, int(wrong.argmax()) + 1, value, times)
        ahead = steps[steps > 0]
        if len(ahead) and not SHORTEST_NS <= (period := int(np.median(ahead))) <= LONGEST_NS:
            self._happen("time unit", -1, 0, f"frames are {period} ns apart")
        if self._places and self._map is not None:
            self._judge_places(self._map)
        for kind, event in self._events.items():
            found.append(
                self._finding(kind, event.node, event.frame, event.nodes, event.times, event.value)
            )
        if passes is not None:
            logged = np.array(self._log_time_ns)
            within = (logged >= passes.start_ns) & (logged <= passes.end_ns)
            mixed = {row + later for row in np.flatnonzero(within).tolist() for later in (0, 1)}
            found = [one for one in found if one.kind not in _OF_STEPS or one.frame not in mixed]
            first, times = min(mixed, default=0), int(within.sum())
            found.append(self._finding("mixed passes", -1, first, (), times, passes.reason))
        order = list(REMEDY)
        return sorted(found, key=lambda one: order.index(one.kind))

    def _finding(
        self, kind: str, node: int, frame: int, nodes: Iterable[int], times: int, value: str
    ) -> Finding:
        ident = self._idents[node] if node >= 0 else ""
        entities = len({self._idents[one] for one in nodes if one >= 0})
        seconds = self._seconds(frame)
        return Finding(kind, ident, frame, seconds, entities, times, value, REMEDY[kind])

    def _seconds(self, frame: int) -> float:
        times = self._time_ns
        return int(times[min(frame, len(times) - 1)] - times[0]) / 1e9

    def _happen(self, kind: str, node: int, frame: int, value: str) -> None:
        event = self._events.setdefault(kind, _Event(node, frame, value))
        event.times += 1
        event.nodes.add(node)

    def _happen_each(self, kind: str, block: FrameBlock, rows: Bools, value: str) -> None:
        """Count each row in a mask as a fault. ``value``: message, with numbers of the first row inserted."""
        at = np.flatnonzero(rows)
        states, first = block.states, int(at[0])
        shown = {name: float(getattr(states, name)[first]) for name in _SHOWN}
        frame = int(block.seq[block.frame_of[first]])
        self._happen(kind, int(states.node[first]), frame, value.format(**shown))
        event = self._events[kind]
        event.times += len(at) - 1
        event.nodes |= set(np.unique(states.node[at]).tolist())

    # Numbers that contradict the movement.

    def _lost(self, losses: Sequence[Loss]) -> Iterator[Finding]:
        """Yield a finding for each kind of impossible value that a reader removed."""
        kinds: dict[str, list[tuple[str, str, int, int]]] = {}
        for loss in losses:
            if (told := _FAULT.fullmatch(loss.reason)) is not None:
                name, ident, value, times, frame = told.groups()
                kind = "impossible speed" if name == "speed" else "impossible size"
                one = (ident, f"{name} {value}", int(times), int(frame or 0))
                kinds.setdefault(kind, []).append(one)
        for kind, found in kinds.items():
            ident, value, _, frame = min(found, key=lambda one: one[3])
            entities, times = len({one[0] for one in found}), sum(one[2] for one in found)
            seconds = self._seconds(frame)
            yield Finding(kind, ident, frame, seconds, entities, times, value, REMEDY[kind])

    # Jumps, reused ids, sizes.

    def _see_jumps(self, rows: BodyRows) -> None:
        """Find steps that are much longer or much shorter than the steps before and after them."""
        values, frame = rows.values, rows.frame
        seconds = np.diff(rows.time_ns) / 1e9
        joined = (np.diff(rows.node) == 0) & (np.diff(frame) == 1) & (seconds > 0)
        joined &= values[1:, LIGHT] < 0
        with np.errstate(all="ignore"):
            velocity = np.diff(values[:, X : X + 2], axis=0) / seconds[:, None]
            at = np.flatnonzero(joined[:-2] & joined[1:-1] & joined[2:] & rows.fresh[3:]) + 1
            apart = [
                np.hypot(*(velocity[at] - velocity[at + side]).T) * seconds[at] for side in (-1, 1)
            ]
        is_vehicle = np.isin(self._kinds[rows.node[at]], _VEHICLES)
        limit = np.maximum(np.where(is_vehicle, JUMP, STRIDE), BRAKING * seconds[at] ** 2)
        for row in at[np.minimum(*apart) > limit].tolist():
            ends = values[row, X : X + 2], values[row + 1, X : X + 2]
            self._move(int(rows.node[row]), int(frame[row + 1]), *ends)

    def _move(self, node: int, frame: int, start: Floats, end: Floats) -> None:
        if len(self._moves) < _MOST_MOVES:
            self._moves.append(_Move(node, frame, complex(*start), complex(*end)))

    def _see_returned(self, rows: BodyRows, before: int) -> None:
        """Find new bodies with an id that another body had until the frame before."""
        if not self._nodes:
            self._nodes = {ident: node for node, ident in enumerate(self._idents[:before])}
        for node in range(before, len(self._idents)):
            earlier = self._nodes.get(self._idents[node])
            self._nodes[self._idents[node]] = node
            first = int(np.searchsorted(rows.node, node))
            if earlier is None or first == len(rows.node) or rows.node[first] != node:
                continue
            frame = int(rows.frame[first])
            old = slice(*np.searchsorted(rows.node, [earlier, earlier + 1]).tolist())
            last = old.start + int(np.searchsorted(rows.frame[old], frame)) - 1
            is_joined = last >= old.start and rows.frame[last] == frame - 1
            if is_joined and self._kinds[node] == self._kinds[earlier]:
                self._move(node, frame, rows.values[last, X : X + 2], rows.values[first, X : X + 2])
            else:
                self._happen("reused id", node, frame, "it returns as another body")

    def _see_absences(self, steps: Steps) -> None:
        """Find bodies that disappear and come back farther away than they could have moved."""
        values, at, seconds = steps.rows.values, steps.at, steps.seconds
        speeds = [np.hypot(*np.nan_to_num(values[row, VX : VX + 2]).T) for row in (at, at + 1)]
        reach = (speeds[0] + speeds[1]) / 2 * seconds + BRAKING / 4 * seconds**2 + STRIDE
        away = np.hypot(steps.away[:, 0], steps.away[:, 1])
        lost = steps.known & (steps.frames > 1) & (away > reach)
        for row in np.flatnonzero(lost).tolist():
            value = f"it returns {away[row]:.4g} m away after {seconds[row]:g} s"
            self._happen("reused id", int(steps.node[row]), int(steps.frame[row]), value)

    def _see_growth(self, steps: Steps) -> None:
        """Find rigid bodies that change their size."""
        values = steps.rows.values
        sizes = slice(LENGTH, HEIGHT + 1)
        before, after = values[steps.at, sizes], values[steps.at + 1, sizes]
        apart = np.abs(after - before)
        if not (apart > 1e-3).any():
            return
        ratio = np.fmax(before, after) / np.fmax(np.fmin(before, after), 1e-9)
        ratio[(ratio < GROWTH) | ~(apart > GROWN)] = 0.0
        grown = ratio.any(axis=1)
        self._steady.update(steps.node[(apart > 1e-3).any(axis=1) & ~grown].tolist())
        for row in np.flatnonzero(grown).tolist():
            node, frame, column = int(steps.node[row]), int(steps.frame[row]), ratio[row].argmax()
            name = ("length", "width", "height")[column]
            old, new = before[row, column], after[row, column]
            value = f"{name} changes from {old:.3g} to {new:.3g} m"
            if steps.frames[row] > 1:
                self._happen("reused id", node, frame, f"it returns as another body: {value}")
            elif ratio[row, column] > NOISY:
                self._happen("size jump", node, frame, value)
            else:
                self._grown.setdefault(node, (frame, value))

    def _judge_moves(self) -> None:
        """Count jumps as faults: ``swapped ids`` if two objects exchange places, else ``teleport``."""
        frames: dict[int, list[_Move]] = {}
        step = _USUAL * float(np.median(np.diff(self._time_ns))) / 1e9 if self._moves else 0.0
        for move in self._moves:
            frames.setdefault(move.frame, []).append(move)
        for frame, moves in frames.items():
            starts, ends = (
                np.array([getattr(m, side) for m in moves]) for side in ("start", "end")
            )
            lengths = np.abs(ends - starts)
            near = np.minimum(max(STRIDE, step), lengths / 2)[:, None]
            met = np.abs(ends[:, None] - starts) < near
            swapped = np.flatnonzero((met & met.T).any(axis=1)).tolist()
            for row, (move, length) in enumerate(zip(moves, lengths.tolist(), strict=True)):
                is_swapped = row in swapped
                kind = "swapped ids" if is_swapped else "teleport"
                words = "to the place of another body" if is_swapped else "between two frames"
                self._happen(kind, move.node, frame, f"it jumps {length:.4g} m {words}")
        for node, (frame, value) in self._grown.items():
            if self._steady[node] < _STEADY:
                self._happen("size jump", node, frame, value)

    def _see_bodies(self, block: FrameBlock) -> None:
        """Find impossible sizes, angles and controls, and bodies with placeholder values."""
        states = block.states
        kinds = self._kinds[states.node]
        body = states.light_state < 0
        vehicle = body & np.isin(kinds, _VEHICLES)
        is_person = kinds == KIND_CODE["person"]
        sized = vehicle | (body & is_person)
        length, width = states.length, states.width
        least, largest = np.full(len(KINDS), 1.0), np.full(len(KINDS), 60.0)
        for limits, known in ((least, LEAST), (largest, LARGEST)):
            limits[[KIND_CODE[kind] for kind in known]] = [*known.values()]
        small = sized & (length < least[kinds])
        large = sized & ((length > largest[kinds]) | (width > largest[kinds]))
        large |= sized & ((states.height > 8) | (vehicle & (width > 8)))
        controls = (np.abs(states.steer) > 1.01) | (np.abs(states.throttle - 0.5) > 0.51)
        tilt = np.fmax(np.abs(states.roll), np.abs(states.pitch))
        tilted = tilt > np.pi / 2
        heavy = (np.abs(np.abs(states.az) - 9.81) < 0.5) & (states.derived & 2 == 0)
        far = np.abs(states.x) > FAR
        coarse = far & (states.x == states.x.astype(np.float32))
        self._shares["exact"] += int((far & ~coarse).sum())
        box = "{length:.3g} x {width:.3g} x {height:.3g} m"
        for kind, rows, value in (
            ("impossible size", small | large, box),
            (
                "angle unit",
                body & (np.fmax(np.abs(states.heading), tilt) > 7),
                "heading {heading:.4g}, pitch {pitch:.4g}, roll {roll:.4g} rad",
            ),
            (
                "control range",
                controls | (np.abs(states.brake - 0.5) > 0.51),
                "throttle {throttle:.3g}, brake {brake:.3g}, steering {steer:.3g}",
            ),
            ("upside down", vehicle & tilted, "roll {roll:.3g} rad, pitch {pitch:.3g} rad"),
            ("gravity", vehicle & heavy, "vertical acceleration {az:.3g} m/s²"),
            ("rounded positions", coarse, "x is {x} m: a 32-bit number"),
        ):
            if rows.any():
                self._happen_each(kind, block, rows, value)
        on_road = body & np.isin(kinds, _ON_ROAD) & (length > 0) & (width > 0)
        is_car = kinds == KIND_CODE["car"]
        for name, rows in (
            ("all", on_road),
            ("cars", is_car),
            ("width and length swapped", length < width * 0.8),
            ("half sizes", is_car & (length < 3.2) & (width < 1.2)),
            ("placeholder size", length == width),
        ):
            self._sizes[name] |= set(np.unique(states.node[on_road & rows]).tolist())
        self._shares["vehicles"] += int(vehicle.sum())

    def _judge(self) -> None:
        """Drop kinds of findings with too few cases. Add findings of changing sizes and impossible heights."""
        events, shares = self._events, self._shares
        rare = {
            kind
            for kind in ("upside down", "gravity")
            if kind in events and events[kind].times < max(AGREEING, SHARE * shares["vehicles"])
        }
        if shares["exact"]:
            rare.add("rounded positions")
        ego = events.get("ego missing")
        # The reader reports a recording without an ego. At the end, an ego can leave first.
        if ego is not None and (
            not shares["ego"] or (ego.frame >= shares["ego"] and ego.times < STANDING)
        ):
            rare.add("ego missing")
        for kind in rare & events.keys():
            del events[kind]
        for kind in _SIZE_KINDS:
            nodes = self._sizes[kind]
            of = len(self._sizes["cars" if kind == "half sizes" else "all"])
            if nodes and len(nodes) >= of / 2:
                value = f"{len(nodes)} of {of} vehicles"
                events[kind] = _Event(min(nodes), 0, value, len(nodes), nodes)
        levels = shares["levels"]
        if levels >= 3 and shares["tops"] >= SHARE * levels and not shares["bottoms"]:
            self._happen("z down", -1, 0, "bodies of different heights end at the same height")

    # Samples: doubled bodies, heights, places on the map.

    def _see_samples(self, block: FrameBlock) -> None:
        chosen = np.flatnonzero(block.seq % SAMPLED == 0)
        if not len(chosen):
            return
        states, frame_of = block.states, block.frame_of
        rows = np.flatnonzero(np.isin(frame_of, chosen) & (states.light_state < 0))
        kinds = self._kinds[states.node[rows]]
        moves = np.isin(kinds, _VEHICLES) | (kinds == KIND_CODE["person"])
        rows = rows[moves & np.isfinite(states.x[rows])]
        frame, node = frame_of[rows], states.node[rows]
        columns = (states.x, states.y, states.length, states.z)
        x, y, length, z = (column[rows] for column in columns)
        order = np.lexsort((y, x, frame))
        one, other = order[:-1], order[1:]
        same = (frame[one] == frame[other]) & (np.abs(x[one] - x[other]) < 0.01)
        same &= (np.abs(y[one] - y[other]) < 0.01) & ~(np.abs(z[one] - z[other]) > 1)
        same &= np.abs(length[one] - length[other]) < 0.02
        for a, b in zip(node[one[same]].tolist(), node[other[same]].tolist(), strict=True):
            self._doubled[min(a, b), max(a, b)] += 1
            if self._doubled[min(a, b), max(a, b)] == 3:
                value = f"entity {self._idents[a]!r} is at the same place"
                self._happen("doubled body", b, int(block.seq[chosen[-1]]), value)
        half = states.height[rows] / 2
        for row in np.unique(frame).tolist():
            here = (frame == row) & np.isfinite(half + z)
            if here.sum() > 1 and np.ptp(half[here]) > 0.1:
                self._shares["levels"] += 1
                self._shares["tops"] += bool(np.ptp((z + half)[here]) < 0.02)
                self._shares["bottoms"] += bool(np.ptp((z - half)[here]) < 0.02)
        if self._has_lanes and self._sampled < _MOST_SAMPLES:
            self._sampled += len(rows)
            named = ("x", "y", "heading", "length", "width", "vx", "vy")
            columns = [getattr(states, name)[rows] for name in named]
            is_ego = node == block.ego[frame]
            on_wheels = np.isin(self._kinds[node], _VEHICLES)
            self._places.append(
                np.column_stack([node, block.seq[frame], is_ego, on_wheels, *columns]).astype(
                    np.float64
                )
            )

    def _judge_places(self, road_map: RoadMap) -> None:
        """Compare a sample of ego positions with the lanes. Without an ego, use positions of all vehicles."""
        places = np.concatenate(self._places)
        places = places[places[:, 3] > 0]
        own = places[places[:, 2] > 0] if places[:, 2].any() else places
        x, y = own[:, 4:6].T
        outside, value = np.zeros(0, np.bool_), f"more than {ASIDE:g} m from all lanes"
        for words, at in (
            ("", (x, y)),
            ("y were mirrored", (x, -y)),
            ("x were mirrored", (-x, y)),
            ("x and y were swapped", (y, x)),
            ("positions were in centimetres", (x / 100, y / 100)),
        ):
            beyond = np.ones(len(x), np.bool_)
            row, node = road_map.near(*at, ASIDE)
            beyond[row[road_map.nodes.kind[-1 - node] == KIND_CODE["lane"]]] = False
            outside = outside if words else beyond
            if words and not beyond.any():
                value += f"; it would be on the map if {words}"
            if not beyond.any() or outside.mean() < SHARE:
                break
        if outside.any():
            node, frame = own[outside.argmax(), :2].astype(int).tolist()
            nodes = {int(one) for one in own[outside, 0]}
            self._events["off the map"] = _Event(node, frame, value, int(outside.sum()), nodes)
        moving = places[np.hypot(places[:, 9], places[:, 10]) > COURSE]
        hits = road_map.lanes_of(moving[:, 4:9], np.full(len(moving), np.nan))
        apart = np.setdiff1d(np.arange(len(moving)), hits.row)
        if len(apart) > max(AGREEING, ON_LANES * len(moving)):
            node, frame = moving[apart[0], :2].astype(int).tolist()
            nodes = {int(one) for one in moving[apart, 0]}
            value = f"{len(apart)} of {len(moving)} places of moving vehicles are on no lane"
            event = _Event(node, frame, value, len(apart), nodes)
            self._events.setdefault("off the map", event)
        row, error = hits.row[hits.primary], np.abs(hits.heading_error[hits.primary])
        against = moving[row[error > 3 * np.pi / 4]]
        nodes = {int(one) for one in against[:, 0]}
        if len(nodes) > 1 and len(against) >= max(AGREEING, SHARE * len(row)):
            node, frame = against[0, :2].astype(int).tolist()
            value = "vehicles drive against their lanes"
            self._events["wrong way"] = _Event(node, frame, value, len(against), nodes)

    # Traffic lights.

    def _see_lights(self, rows: BodyRows) -> None:
        """Check the lights: order of states, and flicker. Remember which lights need lanes in the map."""
        shown = rows.values[:, LIGHT].astype(np.int64)
        lit = rows.fresh & (shown >= 0)
        # A light that is always off needs no lanes.
        self._lit |= set(np.unique(rows.node[lit & np.isin(shown, _COLOURS)]).tolist())
        same = (np.diff(rows.node) == 0) & lit[1:] & (shown[:-1] >= 0) & (np.diff(shown) != 0)
        for row in np.flatnonzero(same).tolist():
            node, time, frame = (int(c[row + 1]) for c in (rows.node, rows.time_ns, rows.frame))
            before, after = (LIGHT_STATES[int(code)] for code in shown[row : row + 2])
            since = self._changed.get(node)
            self._changed[node] = time, frame
            self._orders.setdefault(node, set()).add((before, after))
            if (before, after) in _IMPOSSIBLE:
                self._happen("light order", node, frame, f"{before} changes to {after}")
            steady = shown[row] in _COLOURS
            if since is not None and 0 < time - since[0] < FLICKER_NS and steady:
                value = f"{before} lasts {(time - since[0]) / 1e9:g} s"
                self._happen("light flickers", node, frame, value)

    def _judge_lights(self) -> None:
        road_map = self._map
        if road_map is not None and self._has_lanes:
            for node in sorted(self._lit & self._lights.keys()):
                ref = self._lights[node]
                if not len(road_map.lanes_of_signal(ref)):
                    value = f"it refers to {ref!r}" if ref else "it has no reference to the map"
                    self._happen("light without lanes", node, 0, f"{value}: no lane")
        for node, orders in self._orders.items():
            if ("green", "red") in orders and ("yellow", "green") in orders:
                frame = self._changed[node][1]
                self._happen(
                    "light order", node, frame, "yellow changes to green, and green to red"
                )
        flickers = self._events.get("light flickers")
        if flickers is not None and flickers.times < 2:
            del self._events["light flickers"]
        span = self._time_ns[-1] - self._time_ns[0] if self._time_ns else 0
        if self._lit and not self._changed and span > CYCLE_NS:
            value = f"no light changes in {span / 1e9:g} s"
            self._happen("lights never change", min(self._lit), 0, value)


_SIZE_KINDS: Final = ("width and length swapped", "half sizes", "placeholder size")
_SHOWN: Final = (
    *("x", "y", "heading", "pitch", "roll", "length", "width", "height", "az"),
    *("throttle", "brake", "steer"),
)
_STEADY: Final = 3
"""Number of small changes of size after which the size counts as measured."""
_USUAL: Final = 30.0
"""Speed up to which positions of different bodies are compared with each other; m/s."""
_MOST_MOVES: Final = 10_000
_MOST_SAMPLES: Final = 5_000
"""Largest number of positions that are compared with the map."""
_TOGETHER: Final = 120
"""Number of frames of a client that are checked together."""
_COLOURS: Final = [
    LIGHT_STATE_CODE[name] for name in ("red", "yellow", "green", "red_yellow", "flashing")
]
_IMPOSSIBLE: Final = {
    ("green", "red_yellow"),
    ("yellow", "red_yellow"),
    ("red_yellow", "red"),
    ("red_yellow", "yellow"),
}


class _Move(NamedTuple):
    """Jump of a body between two frames: node, later frame, and positions before and after."""

    node: int
    frame: int
    start: complex
    end: complex
