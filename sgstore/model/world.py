"""Input data of scene graphs: object states of a trace as arrays, its events, and positions of messages.

Readers pass these values to the scene graph generator and to the store. The store rounds them. Conventions of
axes, units and signs are those of :mod:`sgstore.base.geometry`: OpenDRIVE's inertial axes, metres, radians,
seconds, ``int64`` nanoseconds. A missing number is NaN, a missing code -1.

A *node id* names an entity within its trace: 0, 1, 2, … in the order of appearance. Ids below zero
belong to the road map (:mod:`sgstore.maps.roads`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np

from sgstore.base.display import number_of
from sgstore.base.geometry import wrapped
from sgstore.base.tables import taken
from sgstore.mcap import Findings, Loss

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path
    from typing import Any

    from numpy.typing import NDArray

Floats: TypeAlias = "NDArray[np.float64]"
Ints: TypeAlias = "NDArray[np.int64]"
Codes: TypeAlias = "NDArray[np.int8]"
Bools: TypeAlias = "NDArray[np.bool_]"

BUCKET_FRAMES = 60
"""Number of frames in a mask of the store. Blocks should start at multiples of it."""

GAP: Final = 2.5
"""Number of median periods above which frames are missing between two frames."""

JUMP_NS: Final = 86_400_000_000_000
"""Assumed time between two frames at a backward clock jump: a day; ns."""

AT_ZERO_NS: Final = 100_000_000
"""Largest expected time at which a stamp of 0 in another channel is accepted as a real time; ns."""

TOLERANCE_NS: Final = 1_000
"""Smallest time tolerance for equality; ns."""

TOLERANCE_SHARE: Final = 100
"""Divisor of the median period for the time tolerance."""


LONGEST_NAME: Final = 200
"""Maximum length of an attribute name; characters."""

LONGEST_TEXT: Final = 10_000
"""Maximum length of an attribute text; characters."""

ATTRIBUTE: Final = "attribute:"
"""Prefix of an OSI identifier for an attribute without an OSI field: ``attribute:control_steer=0.2``."""


def seconds_of(ns: int) -> float:
    """Convert nanoseconds to seconds, rounded to whole microseconds.

    Simulator clocks lose the last nanosecond: 7.499999999 s means 7.5 s.
    """
    whole = (abs(ns) + 500) // 1000 / 1e6
    return whole if ns >= 0 else -whole


def covered_s(start_ns: int, end_ns: int, frames: int, period_ns: int) -> float:
    """Return the duration of a trace; s.

    If its clock ends before its start, the duration is that of its frames at their usual distance.

    Examples
    --------
    >>> covered_s(0, 3_000_000_000, 31, 100_000_000)
    3.0
    >>> covered_s(9_000_000_000, 1_000_000_000, 31, 100_000_000)
    3.0
    """
    return (end_ns - start_ns if end_ns >= start_ns else (frames - 1) * abs(period_ns)) / 1e9


def tolerance_ns(period_ns: int) -> int:
    """Return the clock tolerance of a trace: a time difference that still counts as equal; ns.

    All comparisons of time use this tolerance in favour of equality: ``>= 3 s`` is true for 2.9999 s, ``< 3 s``
    is false.

    Parameters
    ----------
    period_ns : int
        Median time between two frames; ns.

    Returns
    -------
    int
        Tolerance; ns. A hundredth of the period, at least a microsecond.
    """
    return max(TOLERANCE_NS, period_ns // TOLERANCE_SHARE)


def own_column(values: Sequence[Mapping[str, Any] | None]) -> NDArray[np.object_]:
    """Return the column :attr:`States.own`: for each row, the attributes without a column of their own."""
    column = np.full(len(values), None, object)
    column[:] = values
    return column


def valid_attributes(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return only the attributes that a store can hold: finite numbers, texts and truth values.

    Names have 1 to :data:`LONGEST_NAME` characters, texts at most :data:`LONGEST_TEXT`.
    """
    return {
        name: value
        for name, value in values.items()
        if 0 < len(name) <= LONGEST_NAME
        and isinstance(value, (bool, int, float, str))
        and not (isinstance(value, float) and not math.isfinite(value))
        and not (isinstance(value, str) and len(value) > LONGEST_TEXT)
    }


def derivable_ns(period_ns: float) -> float:
    """Return the longest time between two frames from which speeds are derived; ns."""
    return 3 * period_ns + tolerance_ns(int(period_ns))


def longest_step_ns(period_ns: int) -> float:
    """Return the longest step between two frames that does not count as a gap; ns."""
    return GAP * period_ns + tolerance_ns(period_ns)


POSE: Final = (
    *("x", "y", "z", "heading", "pitch", "roll"),
    *("vx", "vy", "vz", "ax", "ay", "az", "yaw_rate"),
    *("length", "width", "height"),
)
"""Columns of :class:`States` for the pose, motion and size of a body, in order."""

LARGEST: Final = 1_000.0
"""Largest valid length, width or height of a body; m."""

FASTEST: Final = 150.0
"""Highest valid speed of a body; m/s."""

HARDEST: Final = 30.0
"""Highest valid acceleration derived from positions or velocities; m/s²."""

STANDS, UNREAL_ACCELERATION, UNREAL_TURN, SMOOTHED = 8, 16, 32, 64
"""Bits of ``derived`` that only recordings with noise have; see :class:`States`."""

LEAP: Final = 5.0
"""Distance beyond the reach at :data:`FASTEST` from which a position belongs to another body; m."""

INPUTS: Final = ("steer", "throttle", "brake", "gear", "hand_brake")
"""Columns of :class:`States` for the control inputs of a vehicle, in order."""

_SPEEDS: Final = slice(POSE.index("vx"), POSE.index("vz") + 1)
_SIZES: Final = slice(POSE.index("length"), POSE.index("height") + 1)


def implausible(values: Floats) -> Bools:
    """Return a mask of impossible sizes and velocities of objects.

    All readers and the online mode use this check.

    Parameters
    ----------
    values : (n, 16) float64
        Columns :data:`POSE`.

    Returns
    -------
    (n, 16) bool
        Sizes below 0 or above :data:`LARGEST`; all three parts of a velocity above :data:`FASTEST`.
    """
    found = np.zeros(values.shape, np.bool_)
    sizes, speeds = values[:, _SIZES], values[:, _SPEEDS]
    found[:, _SIZES] = (sizes < 0) | (sizes > LARGEST)
    with np.errstate(over="ignore"):
        found[:, _SPEEDS] = (np.nansum(speeds * speeds, axis=1) > FASTEST**2)[:, None]
    return found


def is_plausible(
    vx: float, vy: float, vz: float, length: float, width: float, height: float
) -> bool:
    """Return True if the size and velocity of an object are surely plausible (fast test)."""
    # A comparison with NaN is false.
    if any(size < 0 or size > LARGEST for size in (length, width, height)):
        return False
    return not any(abs(part) > FASTEST / 2 for part in (vx, vy, vz))


def without_implausible(values: Floats) -> tuple[Floats, list[tuple[int, str]]]:
    """Set impossible sizes and velocities to NaN. Return the values, and the faults as text.

    Parameters
    ----------
    values : (n, 16) float64
        Columns :data:`POSE`.

    Returns
    -------
    values : (n, 16) float64
        Cleaned values, or the input array without faults.
    faults : list of (int, str)
        Row and fault: ``"length is -4.5 m"``, ``"speed is 900 m/s"``.
    """
    found = implausible(values)
    if not found.any():
        return values, []
    faults = [
        (row, f"{POSE[column]} is {values[row, column]:g} m")
        for row, column in np.argwhere(found).tolist()
        if column >= _SIZES.start
    ]
    fast = np.flatnonzero(found[:, _SPEEDS.start])
    with np.errstate(over="ignore"):
        speeds = np.sqrt(np.nansum(values[fast, _SPEEDS] ** 2, axis=1)).tolist()
    faults += [
        (row, f"speed is {speed:g} m/s") for row, speed in zip(fast.tolist(), speeds, strict=True)
    ]
    return np.where(found, np.nan, values), faults


class FaultTally:
    """Counts of impossible values (sizes, velocities) by object, with the first value of each."""

    MOST: Final = 1000
    """Largest number of faults that are listed. Further faults are only counted."""

    def __init__(self) -> None:
        self._found: dict[str, tuple[str, int, int]] = {}
        self._more = 0

    def add(self, ident: str, words: str, frame: int = -1) -> None:
        """Count one impossible value of an object, such as ``length is -4.5 m``.

        ``frame``: number of the frame; -1 if unknown.
        """
        number, _, value = words.partition(" ")
        what = f"{number} of entity {ident!r}"
        if what not in self._found and len(self._found) == self.MOST:
            self._more += 1
            return
        first, count, since = self._found.get(what, (value, 0, frame))
        self._found[what] = first, count + 1, since

    def losses(self) -> list[Loss]:
        """Return one report entry for each object attribute with impossible values."""
        reasons = [
            f"{what} {first}: missing in {number_of(count, 'state')}"
            + (f", first in frame {frame}" if frame >= 0 else "")
            for what, (first, count, frame) in self._found.items()
        ]
        if self._more:
            reasons.append(f"{self._more} more sizes and speeds that no body has are missing")
        return [Loss(reason, 0, 0) for reason in reasons]


def is_leap(away: float, seconds: float) -> bool:
    """Return True if an object cannot move so far in the given time.

    Parameters
    ----------
    away : float
        Distance; m.
    seconds : float
        Duration of the movement; s. At 0 or less, the clock stands or jumps, and the result is false.
    """
    return seconds > 0 and away > FASTEST * seconds + LEAP


def leaps(away: Floats, seconds: Floats) -> Bools:
    """Return a mask: True if an object cannot move so far in the given time."""
    return (seconds > 0) & (away > FASTEST * seconds + LEAP)


TWINS_NS: Final = 1_000_000_000
"""Longest absence of an entity if another entity uses the same id in the meantime; ns."""

TWINS: Final = 4
"""Largest number of entities that are remembered for one shared id."""

AnyEntity = TypeVar("AnyEntity")


class Sight(NamedTuple):
    """Position and time of one observation of an object.

    Attributes
    ----------
    place : tuple of float
        x, y and z; m. NaN means unknown.
    time_ns : int
        Simulation time; ns.
    run : int
        Number of the clock run. A backward jump starts a new run.
    """

    place: tuple[float, ...]
    time_ns: int
    run: int

    @property
    def is_placed(self) -> bool:
        """True if the position in the plane is known."""
        return not (math.isnan(self.place[0]) or math.isnan(self.place[1]))


class Life(NamedTuple, Generic[AnyEntity]):
    """Object with an id that other objects also use at other times. Its last position is kept."""

    entity: AnyEntity
    kind: int
    seen: Sight | None = None

    def goes_on(self, kind: int | None, here: Sight) -> bool:
        """Return True if an observation can belong to this object: the same kind, at a possible distance.

        The kinds must be equal (``None``: uncertain kind), and the distance must be possible. After a clock
        jump, any distance is possible.
        """
        seen = self.seen
        if kind is not None and kind != self.kind:
            return False
        if seen is None or seen.run != here.run or not here.is_placed:
            return True
        (x, y, z), (x_then, y_then, z_then) = here.place, seen.place
        up = z - z_then
        away = math.hypot(x - x_then, y - y_then, 0.0 if math.isnan(up) else up)
        return not is_leap(away, (here.time_ns - seen.time_ns) / 1e9)

    def is_recent(self, here: Sight) -> bool:
        """Return True if the object was last seen a short time ago, or before a clock jump."""
        seen = self.seen
        if seen is None or seen.run != here.run:
            return True
        return 0 <= here.time_ns - seen.time_ns <= TWINS_NS


class Lives(Generic[AnyEntity]):
    """Objects that have used the same id, at different times.

    If an id returns with another kind, or at an impossible distance, it denotes another entity from then on.
    Entities that use one id in turns continue.

    Parameters
    ----------
    last : Life
        Current entity of the id.

    Attributes
    ----------
    last : Life
    left : sequence of Life
        Earlier entities of the id that may continue, latest last.
    count : int
        Number of entities so far.
    """

    __slots__ = ("count", "last", "left")

    def __init__(self, last: Life[AnyEntity]) -> None:
        self.last = last
        self.left: Sequence[Life[AnyEntity]] = ()
        self.count = 1

    def follow(
        self, kind: int, here: Sight, enter: Callable[[], AnyEntity], *, sure_kind: bool = True
    ) -> AnyEntity:
        """Return the object to which an observation with a shared id belongs. It may be a new one.

        Parameters
        ----------
        kind : int
            Kind of the observed entity.
        here : Sight
            Place and time of the observation.
        enter : callable
            Creates a new entity if no earlier one fits.
        sure_kind : bool
            False if the kind is a guess. A different kind alone then does not mean another entity.
        """
        last, judged = self.last, kind if sure_kind else None
        if not last.goes_on(judged, here):
            twins = (one for one in self.left if one.is_recent(here) and one.goes_on(judged, here))
            after = next(twins, None)
            if after is None:
                after = Life(enter(), kind)
                self.count += 1
            self.left = [one for one in (*self.left, last) if one is not after][-TWINS:]
            last = after
        self.last = last._replace(seen=here) if here.is_placed else last
        return last.entity


UNTOLD: Final = -2
"""Value of the carrier that readers set if the generator is to compute the carrier."""

HIGHEST_GEAR: Final = 127
"""Highest valid gear, forwards and backwards, because a store has 8 bits for it."""


@dataclass(frozen=True, slots=True)
class Entities:
    """Constant properties of the objects that first occur in a block of frames, by node id.

    Attributes
    ----------
    first : int
        Node id of the first row; the following rows follow in steps of one.
    ident : tuple of str
        The simulator's own id.
    kind : (n,) int8
        Codes of :data:`sgstore.model.vocabulary.KINDS`.
    special, subkind, type_name : tuple of str
        Special kind, subkind, and the simulator's own type name; empty if missing.
    static : (n,) bool
        True if the entity never moves. Its only pose is in :attr:`FrameBlock.scenery`.
    map_ref : tuple of str
        Id of the matching OpenDRIVE signal or object, or an empty string. For a signal that the map lacks: its
        lanes, in the format of :meth:`sgstore.maps.roads.RoadMap.lanes_ref`.
    lifetime : tuple of int
        1 for the first entity with an id, 2 for the next one with the same id, and so on. Empty means 1 for
        all.
    trailer : tuple of str
        Id of the trailer at the first observation, or an empty string. Without the column, trailers are
        unknown.
    """

    first: int
    ident: tuple[str, ...]
    kind: Codes
    special: tuple[str, ...]
    subkind: tuple[str, ...]
    type_name: tuple[str, ...]
    static: Bools
    map_ref: tuple[str, ...]
    lifetime: tuple[int, ...] = ()
    trailer: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.ident)


@dataclass(frozen=True, slots=True)
class States:
    """States of objects (pose, size, motion, lights) as columns, one row per object and time; shape (N,).

    Attributes
    ----------
    node : int64
        Node id.
    x, y, z : float64
        Centre of the box; m.
    heading, pitch, roll : float64
        Orientation; rad.
    vx, vy, vz, ax, ay, az : float64
        Velocity and acceleration in map axes; m/s, m/s².
    yaw_rate : float64
        rad/s.
    length, width, height : float64
        Full extents of the box; m.
    lights : int64
        Lights of a vehicle: bit i is :data:`sgstore.model.vocabulary.VEHICLE_LIGHTS` [i]; -1: unknown.
    light_state : int8
        State of a traffic light: code of :data:`sgstore.model.vocabulary.LIGHT_STATES`; -1: no light.
    steer, throttle, brake : float64
        Control inputs, if recorded; -1 … 1 (positive to the left), 0 … 1, 0 … 1.
    gear : float64
        1, 2, …; 0: neutral; below 0: backwards.
    hand_brake : float64
        1: on, 0: off.
    derived : int64
        Bit 0: velocity, bit 1: acceleration, bit 2: yaw rate was computed by differences, not read. Recordings
        with noise have more bits: 3: it stands; 4: impossible acceleration; 5: impossible yaw rate; 6: the
        other bits are known.
    carrier : int64
        Node id of the carrier or towing vehicle; -1: none; :data:`UNTOLD`: not yet computed.
    own : object
        Attributes without a column, as a mapping (name → number, text or truth value), or ``None``.
    lane : int64
        Node id of the lane that the entity drives in a junction. Its negative: other lanes are as likely.
        0: not chosen, the footprint decides.
    """

    node: Ints
    x: Floats
    y: Floats
    z: Floats
    heading: Floats
    pitch: Floats
    roll: Floats
    vx: Floats
    vy: Floats
    vz: Floats
    ax: Floats
    ay: Floats
    az: Floats
    yaw_rate: Floats
    length: Floats
    width: Floats
    height: Floats
    lights: Ints
    light_state: Codes
    steer: Floats
    throttle: Floats
    brake: Floats
    gear: Floats
    hand_brake: Floats
    derived: Ints
    carrier: Ints
    own: NDArray[np.object_]
    lane: Ints

    def __post_init__(self) -> None:
        for column in fields(self):
            shape = getattr(self, column.name).shape
            if shape != self.node.shape or len(shape) != 1:
                raise ValueError(f"{column.name} has shape {shape}, expected {self.node.shape}")

    def __len__(self) -> int:
        return len(self.node)

    def take(self, rows: NDArray[np.intp] | Bools) -> States:
        """Return the given rows of object states, in the given order."""
        return taken(self, rows)

    @classmethod
    def of(cls, **columns: NDArray[np.generic]) -> States:
        """Make a table of object states from given columns.

        ``node`` is required; other columns default to missing values.
        """
        n = len(columns["node"])
        missing = {
            "lights": np.full(n, -1, np.int64),
            "light_state": np.full(n, -1, np.int8),
            "derived": np.zeros(n, np.int64),
            "carrier": np.full(n, UNTOLD),
            "own": np.full(n, None, object),
            "lane": np.zeros(n, np.int64),
        }
        return cls(
            **{
                f.name: columns.get(f.name, missing.get(f.name, np.full(n, np.nan)))
                for f in fields(cls)
            }  # pyright: ignore[reportArgumentType]
        )


@dataclass(frozen=True, slots=True)
class MessageRefs:
    """File positions of recorded messages, one row per message; shape (M,).

    Attributes
    ----------
    channel : int64
        Index into :attr:`TraceInfo.channels`.
    log_time_ns : int64
        Log time in MCAP; ns.
    chunk_offset : int64
        Byte offset of the chunk record in the file; -1: the message is in no chunk.
    offset : int64
        Byte offset of the message record (its opcode) in the chunk's records, uncompressed, or in the file.
    length : int64
        Bytes of the message's data, without the record's head.
    """

    channel: Ints
    log_time_ns: Ints
    chunk_offset: Ints
    offset: Ints
    length: Ints

    def __len__(self) -> int:
        return len(self.channel)


@dataclass(frozen=True, slots=True)
class FrameBlock:
    """Block of consecutive frames of a trace, with object states, new objects, messages and events.

    Frame f has the rows ``offsets[f]:offsets[f + 1]`` of ``states``.

    Attributes
    ----------
    seq : (F,) int64
        Number of the frame in its trace, from 0, without gaps.
    time_ns : (F,) int64
        Simulation time; ns. It can jump backwards.
    log_time_ns : (F,) int64
        Log time of the leading message; payloads are joined by it.
    offsets : (F + 1,) int64
        Rows of each frame in ``states``.
    states : States
        Every entity that moves or changes (traffic lights too), in and out of range.
    ego : (F,) int64
        Node id of the ego; -1 means absent.
    entities : Entities
        Entities that appear in this block for the first time.
    scenery : States
        Poses of the new static entities, valid for the rest of the trace.
    messages : MessageRefs
        The messages read with this block, of all channels that are not latched.
    events : tuple of Event
        Events read with this block. They belong to its frames, and possibly to later frames.
    noise : float
        Noise of the positions of smoothed states; m.
    """

    seq: Ints
    time_ns: Ints
    log_time_ns: Ints
    offsets: Ints
    states: States
    ego: Ints
    entities: Entities
    scenery: States
    messages: MessageRefs
    events: tuple[Event, ...] = ()
    noise: float = 0.0

    def __post_init__(self) -> None:
        frames = len(self.seq)
        if not len(self.time_ns) == len(self.log_time_ns) == len(self.ego) == frames:
            raise ValueError("seq, time_ns, log_time_ns and ego must have one row a frame")
        if len(self.offsets) != frames + 1 or self.offsets[-1] != len(self.states):
            raise ValueError("offsets must have one more row than frames and end at the last state")

    def __len__(self) -> int:
        return len(self.seq)

    @property
    def frame_of(self) -> Ints:
        """For each object state, the index of its frame within the block, (N,) int64."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))


@dataclass(frozen=True, slots=True)
class Channel:
    """Message channel of a recording: topic, schema, encoding and role.

    Attributes
    ----------
    id : int
        The channel's id in the file.
    topic, schema, schema_encoding, message_encoding : str
        Values in the file.
    messages : int
        Number of messages in the file's statistics; -1 without statistics.
    role : str
        ``ground_truth``, ``map``, or ``payload``.
    """

    id: int
    topic: str
    schema: str
    schema_encoding: str
    message_encoding: str
    messages: int
    role: str


@dataclass(frozen=True, slots=True)
class TraceInfo:
    """Properties of a recording that are known before its frames are read, such as channels and ego.

    Attributes
    ----------
    path : Path
        The file.
    size, mtime_ns : int
        Size in bytes and modification time, summed up for the files of a bag. They later show a replaced file.
    digest : str
        SHA-256 of the whole file, in hexadecimal digits.
    flavour : str
        Name of the reader: ``osi``.
    channels : tuple of Channel
    ego : str
        Simulator id of the ego; empty without an ego.
    map_text, map_name : str
        Text (OpenDRIVE or plain lanes) and name of the road map in the trace; empty without a map.
    context : MessageRefs
        Messages that later messages need: maps, latched messages, static data. A clip must include those before
        its start.
    mapping : str
        Digest of the type mapping, for flavours that need one.
    lost_lanes : tuple of str
        Lanes of the trace that its lane map lacks, with the reasons.
    """

    path: Path
    size: int
    mtime_ns: int
    digest: str
    flavour: str
    channels: tuple[Channel, ...]
    ego: str
    map_text: str
    map_name: str
    context: MessageRefs
    mapping: str = ""
    lost_lanes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Event:
    """Event reported by a simulator, such as a collision or a change of weather.

    Attributes
    ----------
    kind : str
        ``collision``, ``lane_invasion`` or ``environment``.
    time_ns, log_time_ns : int
        Simulation time and log time.
    seq : int
        Number of the last frame before the event in the file; -1: none.
    ident : str
        Id of the vehicle; empty: unknown.
    other : str
        Id of the other object in a collision; empty: none.
    value : float or None
        Length of the impulse of a collision; N·s.
    detail : str
        Crossed lane markings: ``broken``, ``solid``, ``other``, separated by commas. For an environment, its
        new state: ``precipitation=light, fog=mist``.
    lifetime, other_lifetime : int
        Lifetime numbers of the entities; see :class:`Entities`.
    """

    kind: str
    time_ns: int
    log_time_ns: int
    seq: int
    ident: str = ""
    other: str = ""
    value: float | None = None
    detail: str = ""
    lifetime: int = 1
    other_lifetime: int = 1


FAR_NS: Final = 1_000_000_000
"""Distance of an event's simulation time from all near frames above which its log time is used; ns."""
_PIECE: Final = 4096


def nearest_frames(events: Sequence[Event], time_ns: Any, log_time_ns: Any) -> Ints:
    """Return the row of the nearest frame for each event. If two are equally near, the first one."""
    found: list[Ints] = [np.zeros(0, np.int64)]
    for start in range(0, len(events), _PIECE):
        some = events[start : start + _PIECE]
        apart = np.abs(np.array([event.time_ns for event in some])[:, None] - time_ns)
        row = apart.argmin(axis=1)
        far = apart[np.arange(len(row)), row] > FAR_NS
        logged = np.abs(np.array([event.log_time_ns for event in some])[:, None] - log_time_ns)
        found.append(np.where(far, logged.argmin(axis=1), row))
    return np.concatenate(found)


@dataclass(slots=True)
class TraceReport(Findings):
    """Report of the reading of a trace: counts, warnings, lost messages and events.

    The reader extends the report block by block.

    Attributes
    ----------
    frames, states : int
        Numbers of frames and states read.
    unknown_types : dict
        Type names without a mapping → number of entities.
    warnings : list of str
        Anomalies without loss of data.
    about_ego : list of str
        Warnings that do not matter if the caller names the egos.
    losses : list of Loss
        Unusable data.
    events : list of Event
        Events in file order, up to a limit.
    """

    frames: int = 0
    states: int = 0
    unknown_types: dict[str, int] = field(default_factory=dict[str, int])
    about_ego: list[str] = field(default_factory=list[str])
    events: list[Event] = field(default_factory=list[Event])


@dataclass(frozen=True, slots=True)
class Clip:
    """Time interval of a trace, both ends included.

    Attributes
    ----------
    trace : str
        Name of the trace in its store.
    start_ns, end_ns : int
        Log times; ns.

    Examples
    --------
    >>> clip = sgstore.Clip("town", 1_000_000_000, 3_000_000_000)
    >>> (clip.end_ns - clip.start_ns) / 1e9
    2.0
    """

    trace: str
    start_ns: int
    end_ns: int

    def widened(self, by: int) -> Clip:
        """Return the time interval, with a time (ns) added at both ends.

        Examples
        --------
        >>> sgstore.Clip("town", 1_000_000_000, 3_000_000_000).widened(500_000_000)
        Clip(trace='town', start_ns=500000000, end_ns=3500000000)
        """
        return Clip(self.trace, self.start_ns - by, self.end_ns + by)


# Stored values: float32 relative to an origin

KEPT: Final = (
    *("pitch", "roll", "vx", "vy", "vz", "ax", "ay", "az", "yaw_rate"),
    *("length", "width", "height", *INPUTS),
)
"""Columns of :class:`States` that a store has as float32."""

_VELOCITY: Final = slice(KEPT.index("vx"), KEPT.index("vz") + 1)
_GEAR: Final = KEPT.index("gear")
_HAND_BRAKE: Final = KEPT.index("hand_brake")


@dataclass(frozen=True, slots=True)
class Origin:
    """Coordinate origin to which the positions of a trace are relative; whole metres."""

    x: float
    y: float
    z: float


def origin_of(frames: FrameBlock) -> Origin | None:
    """Return a coordinate origin for a trace: the median position of its first frame, in whole metres.

    The result does not depend on the ego. Without moving entities, the scenery counts. ``None`` means no
    positions yet.
    """
    states, scenery = frames.states, frames.scenery
    placed = np.flatnonzero(np.isfinite(states.x) & np.isfinite(states.y))
    if len(placed):
        frame = frames.frame_of[placed]
        return _middle(states.take(placed[frame == frame[0]]))
    standing = np.isfinite(scenery.x) & np.isfinite(scenery.y)
    return _middle(scenery.take(standing)) if standing.any() else None


def _middle(states: States) -> Origin:
    z = states.z[np.isfinite(states.z)]
    x, y = round(float(np.median(states.x))), round(float(np.median(states.y)))
    return Origin(float(x), float(y), float(round(float(np.median(z)))) if len(z) else 0.0)


def quantize(frames: FrameBlock, origin: Origin) -> FrameBlock:
    """Round the object states of frames as a store does.

    Graphs are then equal before and after storage.
    """
    return replace(
        frames,
        states=_as_kept(frames.states, origin),
        scenery=_as_kept(frames.scenery, origin),
    )


def _as_kept(states: States, origin: Origin) -> States:
    """Convert object states to the form in a store: float32, relative to the coordinate origin.

    A second call, or storage, changes nothing.

    A float32 has 24 significant bits. The sum with the origin may round off low bits in float64; the difference
    to the origin then still fits into 24 bits.
    """
    if not len(states):
        return states
    # All columns are processed at once, because a single frame has only a few dozen rows.
    names = (*KEPT, "heading", "x", "y", "z")
    shift = np.array([0.0] * (len(names) - 3) + [origin.x, origin.y, origin.z])[:, None]
    given = [getattr(states, name) for name in KEPT]
    given += [turned(states.heading), states.x, states.y, states.z]
    kept = number(np.stack(given) - shift).astype(np.float64)
    kept[~np.isfinite(kept)] = np.nan
    # A traffic light has states, because it changes, but its position is constant.
    velocity = kept[_VELOCITY]
    kept[_VELOCITY] = np.where((states.light_state >= 0) & np.isnan(velocity), 0.0, velocity)
    gear, hand_brake = np.rint(kept[_GEAR]), kept[_HAND_BRAKE]
    kept[_GEAR] = np.where(np.abs(gear) <= HIGHEST_GEAR, gear, np.nan)
    kept[_HAND_BRAKE] = np.where(np.isnan(hand_brake), np.nan, hand_brake != 0)
    kept[-3:] += shift[-3:]
    return replace(states, **dict(zip(names, kept, strict=True)))


def turned(heading: Floats) -> Floats:
    """Wrap headings into (-π, π], also after rounding to float32."""
    # The largest float32 that is not above π: the float32 nearest to π is.
    largest = float(np.nextafter(np.float32(np.pi), np.float32(0)))
    return np.clip(wrapped(heading), -largest, largest)


def number(values: Floats) -> NDArray[np.float32]:
    """Convert values to float32. A value beyond the float32 range becomes infinite."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
