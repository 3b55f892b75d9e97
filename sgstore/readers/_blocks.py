"""Construction of blocks of frames from decoded messages: node ids, object states and derived values.

The :class:`MessageDecoder` of a flavour converts messages into :class:`FrameRows` and adds entities to an
:class:`EntityTable`. :func:`assemble` makes blocks of them and reads ahead, for two reasons. A missing velocity
is the difference of two positions, and the second one may be in the next block. Other messages about a frame
may follow its leading message. The values therefore never depend on the limits of a block.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np

from sgstore.base.display import number_of
from sgstore.base.tables import chained, taken
from sgstore.mcap import IDS, Loss
from sgstore.model.noise import Noise, Smoother, noise_of
from sgstore.model.online_noise import OnlineSmoother
from sgstore.model.vocabulary import KIND_CODE, KINDS
from sgstore.model.world import (
    FASTEST,
    HARDEST,
    INPUTS,
    POSE,
    Entities,
    FaultTally,
    FrameBlock,
    Life,
    Lives,
    MessageRefs,
    Sight,
    States,
    derivable_ns,
    leaps,
    valid_attributes,
    without_implausible,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.mcap import Messages
    from sgstore.model.vocabulary import TypeMeaning
    from sgstore.model.world import Bools, Event, Floats, Ints, TraceReport

    Steps = tuple[Ints, Ints, Floats, Floats]

Called: TypeAlias = "tuple[TypeMeaning, str]"
"""Meaning of an entity's type, and the name of the type in the simulator."""


Raw = TypeVar("Raw")

NAN: Final = float("nan")
FAR: Final = 1e9
"""Largest coordinate on earth in any map projection; m. Larger values are invalid."""

UPRIGHT: Final = 1 - 1e-13
"""Sine of the pitch above which heading and roll cannot be separated, because of rounding."""

EXACT: Final = Noise()
"""Noise value for exact positions, as from a simulator."""

NEAR_REFS: Final = 250_000
"""Largest number of message positions that are kept after a frame, and before the next frame."""

MOST_EVENTS: Final = 10_000
"""Largest number of events in a report. A vehicle at a wall collides in every frame, so they can be many."""

_X, _HEADING, _VELOCITY, _ACCELERATION, _YAW_RATE = 0, 3, 6, 9, 12


NO_INPUTS: Final = (NAN,) * len(INPUTS)
"""Control inputs of an entity for which the recording has none."""


@dataclass(slots=True)
class FrameRows:
    """Decoded frame: time, ego, and one row of pose and motion per object.

    Attributes
    ----------
    time_ns, log_time_ns : int
        Simulation time; log time of the leading message.
    ego : int
        Node id; -1 if absent.
    node, lights, light_state : (n,) int64
        As in :class:`sgstore.model.world.States`.
    values : (n, 16) float64
        Columns :data:`POSE`.
    controls : tuple of float
        :data:`sgstore.model.world.INPUTS` of the ego; NaN for missing ones.
    driven : mapping
        Node id → the same inputs, of vehicles other than the ego.
    own : mapping
        Node id → its attributes without a column; see :attr:`sgstore.model.world.States.own`.
    kinds : mapping
        Node id → kind in this frame, for entities that were added with another kind.
    seconds : float
        Time since the previous frame; s. NaN means unknown, or too long to derive numbers.
    returned : int
        Number of entities up to this frame with a reused id; see :class:`LifetimeTracker`.
    """

    time_ns: int
    log_time_ns: int
    ego: int
    node: Ints
    values: Floats
    lights: Ints
    light_state: Ints
    controls: tuple[float, ...] = NO_INPUTS
    driven: Mapping[int, tuple[float, ...]] = field(default_factory=dict[int, "tuple[float, ...]"])
    own: Mapping[int, Mapping[str, Any]] = field(default_factory=dict[int, "Mapping[str, Any]"])
    kinds: Mapping[int, Called] = field(default_factory=dict[int, "Called"])
    seconds: float = NAN
    returned: int = 0

    def __len__(self) -> int:
        return len(self.node)

    def with_heads(self, heads: tuple[Ints, Floats, Ints]) -> FrameRows:
        """Return the frame with rows of traffic lights added: node ids, poses and light states."""
        node, values, light_state = heads
        if not len(node):
            return self
        return replace(
            self,
            node=np.concatenate([self.node, node]),
            values=np.concatenate([self.values, values]),
            lights=np.concatenate([self.lights, np.full(len(node), -1, np.int64)]),
            light_state=np.concatenate([self.light_state, light_state]),
        )


class EntityRow(NamedTuple):
    """Object of a trace (such as a vehicle or sign) as one row of the object table."""

    ident: str
    kind: int
    special: str
    subkind: str
    type_name: str
    static: bool
    map_ref: str
    lifetime: int = 1
    trailer: str = ""


@dataclass(slots=True)
class EntityTable:
    """Objects of a trace (such as vehicles and signs) in order of appearance, and the events of the trace.

    Attributes
    ----------
    report : TraceReport
        Receives the type names without a mapping.
    size : int
        Number of entities.
    absurd : int
        Number of impossible values in states and poses.
    happened : int
        Number of events.
    faults : FaultTally
        Implausible sizes and speeds.
    impossible : (2,) int64
        Number of implausible derived velocities and accelerations.
    completed : int
        Number of frames with checked values.

    Notes
    -----
    A decoder identifies an entity by the number that :meth:`enter` returned: one number per id. Node ids equal
    these numbers until an id returns as another entity (:meth:`enter_again`). This entity gets the next node
    id, and the node ids of later entities increase by one (:meth:`nodes_of`).
    """

    report: TraceReport
    size: int = 0
    absurd: int = 0
    happened: int = 0
    faults: FaultTally = field(default_factory=FaultTally)
    impossible: Ints = field(default_factory=lambda: np.zeros(2, np.int64))
    completed: int = 0
    _events: list[Event] = field(default_factory=list["Event"])
    _rows: list[EntityRow] = field(default_factory=list["EntityRow"])
    _taken: int = 0
    _poses: dict[int, tuple[float, ...]] = field(default_factory=dict[int, tuple[float, ...]])
    _idents: set[str] = field(default_factory=set[str])
    _returned: list[tuple[int, EntityRow]] = field(default_factory=list[tuple[int, "EntityRow"]])
    _returned_taken: int = 0
    _turns: dict[str, list[tuple[int, int]]] = field(
        default_factory=dict[str, list[tuple[int, int]]]
    )

    def enter(
        self,
        ident: str,
        meaning: TypeMeaning,
        type_name: str,
        map_ref: str = "",
        pose: tuple[float, ...] | None = None,
        trailer: str = "",
    ) -> int:
        """Add an object (such as a vehicle) to the table, and return its node id.

        Parameters
        ----------
        ident : str
            The simulator's own id. If another entity has the same id, the kind is appended.
        meaning : TypeMeaning
        type_name, map_ref : str
        pose : tuple of float, optional
            Columns :data:`POSE` of a static entity.
        trailer : str
            Id of the trailer that it pulls. Empty: no trailer, or an unknown one.
        """
        if ident in self._idents:
            ident = f"{ident}:{meaning.kind}"
        while ident in self._idents:
            ident += "'"
        self._idents.add(ident)
        if meaning.kind == "unknown" and not meaning.subkind:
            self.count_unknown(type_name)
        node = self.size
        if pose is not None:
            self._poses[node] = pose
        self._rows.append(
            EntityRow(
                ident,
                KIND_CODE[meaning.kind],
                meaning.special,
                meaning.subkind,
                type_name,
                pose is not None,
                map_ref,
                trailer=trailer,
            )
        )
        self.size += 1
        return node

    def entered(self, number: int) -> EntityRow:
        """Return the table row of the object with the given number."""
        return self._rows[number]

    def enter_again(self, row: EntityRow, before: int) -> int:
        """Add a new object with an id that an earlier object had. Return its node id.

        Parameters
        ----------
        row : EntityRow
        before : int
            Number of ids known before it appears.
        """
        self._returned.append((before, row))
        return before + len(self._returned) - 1

    def turn(self, number: int, lifetime: int, seq: int) -> None:
        """Record from which frame on an id belongs to another object, and that object's lifetime number."""
        self._turns.setdefault(self._rows[number].ident, []).append((seq, lifetime))

    @property
    def returned(self) -> int:
        """Number of objects with an id that an earlier object had."""
        return len(self._returned)

    def nodes_of(self, numbers: Ints) -> Ints:
        """Convert object numbers to node ids. Negative numbers stay unchanged."""
        if not self._returned:
            return numbers
        places = np.array([place for place, _ in self._returned], np.int64)
        return numbers + np.searchsorted(places, numbers, side="right")

    def happen(self, event: Event) -> None:
        """Add an event (such as a collision) to the trace."""
        self.happened += 1
        self._events.append(event)
        if self.happened <= MOST_EVENTS:
            self.report.events.append(event)

    def take_events(self) -> tuple[Event, ...]:
        """Remove and return the events (such as collisions) added since the last call."""
        events, self._events = self._events, []
        if self._turns:
            events = [
                replace(
                    event,
                    lifetime=self._lifetime(event.ident, event.seq),
                    other_lifetime=self._lifetime(event.other, event.seq),
                )
                for event in events
            ]
        return tuple(events)

    def _lifetime(self, ident: str, seq: int) -> int:
        """Return the lifetime number (1, 2, …) of the object that has an id in a given frame."""
        turns = self._turns.get(ident, ())
        at = bisect_right(turns, seq, key=itemgetter(0))
        return turns[at - 1][1] if at else 1

    def settle(self) -> None:
        """Add warnings about implausible values to the report, after all frames are read."""
        warn = self.report.warnings.append
        if self.absurd:
            warn(f"{self.absurd} numbers of {FAR:g} and more are taken as missing")
        self.report.losses += self.faults.losses()
        velocities, accelerations = self.impossible.tolist()
        if velocities:
            warn(f"{velocities} velocities are not derived from jumps faster than {FASTEST:g} m/s")
        if accelerations:
            warn(f"{accelerations} derived accelerations above {HARDEST:g} m/s² are missing")
        if self.happened > MOST_EVENTS:
            warn(f"of {self.happened} events the report lists the first {MOST_EVENTS}")

    def plausible(
        self, values: Floats, nodes: Sequence[int] | Ints, frames: Ints | None = None
    ) -> Floats:
        """Replace implausible sizes and speeds of objects by NaN, and count them.

        Parameters
        ----------
        values : (n, 16) float64
            Columns :data:`POSE`.
        nodes : (n,) int
            Node id of each row.
        frames : (n,) int64, optional
            Frame of each row, in this call.
        """
        values, faults = without_implausible(values)
        for row, words in faults:
            frame = -1 if frames is None else self.completed + int(frames[row])
            self.faults.add(self._rows[int(nodes[row])].ident, words, frame)
        return values

    def count_unknown(self, type_name: str) -> None:
        """Count an object whose type name has no known kind."""
        unknown = self.report.unknown_types
        unknown[type_name] = unknown.get(type_name, 0) + 1

    def take(self, upto: int, returned: int) -> tuple[Entities, States]:
        """Return the objects added since the last call, and the poses of the static ones.

        Parameters
        ----------
        upto : int
            Number of known ids.
        returned : int
            Number of entities with a reused id.
        """
        rows = self._rows[self._taken : upto]
        for place, row in reversed(self._returned[self._returned_taken : returned]):
            rows.insert(place - self._taken, row)
        columns = tuple(zip(*rows, strict=True)) if rows else ((),) * len(EntityRow._fields)
        named: dict[str, Any] = dict(zip(EntityRow._fields, columns, strict=True))
        named["kind"] = np.array(named["kind"], np.int8)
        named["static"] = np.array(named["static"], np.bool_)
        named["lifetime"] = named["lifetime"] if returned else ()
        entities = Entities(first=self._taken + self._returned_taken, **named)
        nodes = [node for node in range(self._taken, upto) if node in self._poses]
        values = np.array([self._poses.pop(node) for node in nodes], np.float64)
        absurd = np.abs(values) >= FAR
        self.absurd += int(absurd.sum())
        values[absurd] = np.nan
        values = self.plausible(values.reshape(-1, len(POSE)), nodes)
        self._taken, self._returned_taken = upto, returned
        return entities, _states(self.nodes_of(np.array(nodes, np.int64)), values)


class LossTally:
    """Counter of lost messages, by the reason of the loss.

    A repeated reason adds to the existing loss. After :attr:`MOST` reasons, further ones are counted together.
    """

    MOST: ClassVar[int] = 1000

    def __init__(self) -> None:
        self._found: dict[str, Loss] = {}

    def add(self, reason: str, log_time_ns: int, size: int = 0) -> None:
        """Count a lost message of ``size`` bytes, with the reason of the loss."""
        if reason not in self._found and len(self._found) >= self.MOST:
            reason = "and more of the same kinds"
        last = self._found.get(reason) or Loss(reason, 0, 0, log_time_ns, log_time_ns)
        self._found[reason] = Loss(
            reason,
            last.messages + 1,
            last.bytes + size,
            min(last.start_ns, log_time_ns),
            max(last.end_ns, log_time_ns),
        )

    def losses(self) -> list[Loss]:
        """Return one record per reason, with the number of lost messages."""
        return list(self._found.values())


class MessageDecoder(Generic[Raw]):
    """Decoder of messages into frames. It works in two steps, so that many frames are converted at once.

    Parameters
    ----------
    channels : collection of int
        Ids of the channels to decode: channels of frames, and channels with further facts about the same
        instants.
    window : tuple of int
        First and last log time of frames, both included. Other messages only provide lasting facts.
    report : TraceReport
        Receives losses and warnings.

    Attributes
    ----------
    roster : EntityTable
        Receives the entities of decoded messages.
    channels : frozenset of int
    sure_kinds : bool
        True if kinds are certain, as from a simulator; see :class:`LifetimeTracker`.
    measures : bool
        True if recorded velocities come from sensors and may have noise.
    """

    sure_kinds: ClassVar[bool] = True
    measures: ClassVar[bool] = False

    def __init__(
        self, channels: Collection[int], window: tuple[int, int], report: TraceReport
    ) -> None:
        self.roster = EntityTable(report)
        self.channels = frozenset(channels)
        self._window = window
        self._report = report
        self._unreadable, self._unusable = LossTally(), LossTally()
        self._untimed = 0

    def decode(self, run: Messages, row: int) -> Raw | None:
        """Return the frame in a message, before conversion; ``None`` if the message is not a frame."""
        raise NotImplementedError

    def complete(self, frames: list[Raw]) -> list[FrameRows]:
        """Convert frames: compute all numbers (poses, speeds, sizes) of many frames at once.

        It is called for a frame only after the next frame or the end of the recording, because other messages
        about the same instant may follow the leading message.
        """
        raise NotImplementedError

    def settle(self) -> None:
        """Add the lost messages to the report, after all frames are read."""
        losses = self._report.losses
        losses += self._unreadable.losses()
        for loss in self._unusable.losses():  # These losses are states, not messages.
            reason = f"{loss.reason}: {number_of(loss.messages, 'state')} left out"
            losses.append(replace(loss, reason=reason, messages=0, bytes=0))
        if self._untimed:
            words = f"{number_of(self._untimed, 'frame')} without a time: the log time is used"
            self._report.warnings.append(words)

    def is_inside(self, log_time_ns: int) -> bool:
        """Return True if a message with this log time can be a frame. Clips also have earlier messages."""
        return self._window[0] <= log_time_ns <= self._window[1]

    def lose(self, reason: str, run: Messages, row: int) -> None:
        """Count an unreadable message of the recording, under the reason of the loss."""
        self._unreadable.add(reason, int(run.log_time_ns[row]), int(run.length[row]))

    def _warn_of_egos(self, words: str) -> None:
        """Add a warning about a missing ego to the report. It is removed later if the user names egos."""
        self._report.warnings.append(words)
        self._report.about_ego.append(words)


def assemble(
    runs: Iterable[Messages],
    size: int,
    decoder: MessageDecoder[Raw],
    refs: Callable[[Messages], MessageRefs],
    first_steps: Iterable[int] = (),
    noise: Noise = EXACT,
    *,
    causal: bool = False,
) -> Iterator[FrameBlock]:
    """Decode the messages of a recording, and yield blocks of consecutive frames.

    Parameters
    ----------
    runs : iterable of Messages
        In file order.
    size : int
        Frames per block; the last block may have fewer.
    decoder : MessageDecoder
    refs : callable
        Returns the references of a run's messages that belong to frames.
    first_steps : iterable of int
        Times between the first frames; ns.
    noise : Noise
        Noise of the positions. Missing motion of noisy positions needs more frames before and after a block.
    causal : bool
        True: motion from noisy positions does not depend on later frames.

    Yields
    ------
    FrameBlock
        Its messages are those from its first frame up to the next block. Messages with the log time of a frame
        belong to this frame.
    """
    wanted = np.zeros(IDS, np.bool_)
    wanted[[*decoder.channels]] = True
    steps = [step for step in first_steps if step > 0]
    period = float(np.median(steps)) / 1e9 if steps else 0.1
    form = OnlineSmoother if causal else Smoother
    maker = _BlockMaker(decoder, size, steps, form(noise, period) if noise else None)
    between = _Between()
    for run in runs:
        start = 0
        for row in np.flatnonzero(wanted[run.channel]).tolist():
            entered = decoder.roster.size
            frame = decoder.decode(run, row)
            if frame is None:
                continue
            yield from maker.ready(entered)
            if maker.starts_block:
                between.add(refs(run.span(start, row)))
                start = row
                maker.start_block(*between.split(int(run.log_time_ns[row])), entered)
            maker.add(frame, between.take())
        between.add(refs(run.span(start, len(run))))
    maker.finish(between.take())
    while maker.left > size:
        yield maker.block(size)
    last = maker.block(maker.left) if maker.left else None
    maker.settle()
    if between.dropped:
        words = f"{between.dropped} sensor messages are far from all frames and were not linked"
        decoder.roster.report.warnings.append(words)
    if last is not None:
        yield last


class _BlockMaker(Generic[Raw]):
    """Builder of blocks (frames converted together). It keeps a frame until all later frames it needs exist.

    Parameters
    ----------
    decoder : MessageDecoder
    size : int
        Frames per block.
    steps : list of int
        Times between the first frames; ns.
    smoother : Smoother, OnlineSmoother or None
        Source of missing motion. ``None``: differences of exact positions.
    """

    def __init__(
        self,
        decoder: MessageDecoder[Raw],
        size: int,
        steps: list[int],
        smoother: Smoother | OnlineSmoother | None,
    ) -> None:
        self._decoder, self._size = decoder, size
        self._lives = LifetimeTracker(decoder.roster, steps, sure_kinds=decoder.sure_kinds)
        self._smoother = smoother
        self._reach = smoother.reach if isinstance(smoother, Smoother) else 1
        self._raw: list[Raw] = []
        self._sizes: list[int] = []  # Number of known ids before the frame after each one.
        self._done: list[FrameRows] = []  # Completed frames, also those before the block.
        self._count = self._first = 0
        # Of each block that began after the current one: its messages, and the entities before it.
        self._borders: deque[tuple[list[MessageRefs], int]] = deque()
        self._refs: list[MessageRefs] = []

    @property
    def starts_block(self) -> bool:
        """True if the next frame begins another block (frames that are converted together)."""
        return self._count > 0 and self._count % self._size == 0

    def start_block(self, before: list[MessageRefs], same: list[MessageRefs], known: int) -> None:
        """Begin a block (frames converted together) at the next frame. ``known``: entities before it."""
        self._borders.append((self._refs + before, known))
        self._refs = same

    def add(self, frame: Raw, refs: list[MessageRefs]) -> None:
        """Add a frame, and the positions of the messages between the frame before and this frame."""
        self._raw.append(frame)
        self._refs += refs
        self._count += 1

    @property
    def left(self) -> int:
        """Number of frames that are not yet in a block (frames that are converted together)."""
        return self._count - self._first

    def ready(self, known: int) -> Iterator[FrameBlock]:
        """Yield the next block as soon as all later frames that it needs are known.

        ``known``: number of entities of the frames so far.
        """
        if self._raw:  # the last frame can have objects of later messages of its time
            self._sizes.append(known)
        if self.left >= self._size + self._reach:
            self._complete()
            yield self.block(self._size)

    def finish(self, refs: list[MessageRefs]) -> None:
        """End the last block. ``refs``: positions of messages after the last frame."""
        self._sizes.append(self._decoder.roster.size)
        self._complete()
        self._borders.append((self._refs + refs, self._decoder.roster.size))

    def block(self, size: int) -> FrameBlock:
        """Remove the next ``size`` frames from the waiting ones, and return them as a block."""
        refs, known = self._borders.popleft()
        before = min(self._first, self._reach)
        window, part = self._done[: before + size + self._reach], (before, size)
        roster, smoother = self._decoder.roster, self._smoother
        block = _block(self._first, window, part, refs, roster, known, smoother)
        self._first += size
        del self._done[: before + size - min(self._first, self._reach)]
        return block

    def settle(self) -> None:
        """Add warnings about ids, gaps of the clock and impossible values to the report."""
        self._lives.settle()
        self._decoder.roster.settle()
        if self._smoother is not None:
            self._decoder.roster.report.warnings += self._smoother.warnings()

    def _complete(self) -> None:
        frames = _on_earth(self._decoder.complete(self._raw), self._decoder.roster)
        self._done += self._lives.follow(frames, self._sizes)
        self._raw, self._sizes = [], []


@dataclass(slots=True)
class _Between:
    """Buffer for message positions between two frames. If it is full, only the first and last ones stay.

    A recording may contain hours of pictures without ground truth. Messages far from every frame are not
    needed.
    """

    dropped: int = 0
    _parts: list[MessageRefs] = field(default_factory=list[MessageRefs])
    _total: int = 0

    def add(self, refs: MessageRefs) -> None:
        self._parts.append(refs)
        self._total += len(refs)
        if self._total > 3 * NEAR_REFS:
            whole, near = chained(self._parts), np.arange(NEAR_REFS)
            self.dropped += len(whole) - 2 * NEAR_REFS
            # As copies, so that a part does not keep the whole array alive.
            self._parts = [taken(whole, near), taken(whole, near + len(whole) - NEAR_REFS)]
            self._total = 2 * NEAR_REFS

    def split(self, log_time_ns: int) -> tuple[list[MessageRefs], list[MessageRefs]]:
        """Empty the buffer. Return its positions in two lists: with other log times, and with the given one."""
        if not self._total:
            return self.take(), []
        whole = chained(self.take())
        same = whole.log_time_ns == log_time_ns
        return [taken(whole, np.flatnonzero(~same))], [taken(whole, np.flatnonzero(same))]

    def take(self) -> list[MessageRefs]:
        """Empty the buffer. Return the message positions in order."""
        parts, self._parts, self._total = self._parts, [], 0
        return parts


def counted(blocks: Iterable[FrameBlock], report: TraceReport) -> Iterator[FrameBlock]:
    """Yield blocks of frames unchanged. Count frames, states and clock faults in the report."""
    last: int | None = None
    back, still = 0, 0
    for block in blocks:
        report.frames += len(block)
        report.states += len(block.states)
        times = block.time_ns if last is None else np.concatenate([[last], block.time_ns])
        steps = np.diff(times)
        back += int((steps < 0).sum())
        still += int((steps == 0).sum())
        last = int(block.time_ns[-1])
        yield block
    if back:
        report.warnings.append(f"simulation time runs backwards {number_of(back, 'time')}")
    if still:
        report.warnings.append(f"simulation time stands still {number_of(still, 'time')}")


def _block(
    first: int,
    window: list[FrameRows],
    part: tuple[int, int],
    refs: list[MessageRefs],
    roster: EntityTable,
    known: int,
    smoother: Smoother | OnlineSmoother | None,
) -> FrameBlock:
    """Convert some frames to a block. The frames before and after them are needed to compute motion.

    ``part``: number of frames before the block, and of frames in it; ``known``: number of entities before
    the first frame of the next block.
    """
    skipped, size = part
    frames = window[skipped : skipped + size]
    counts = np.array([len(frame) for frame in frames], np.int64)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    skip = sum(len(frame) for frame in window[:skipped])
    rows = slice(skip, skip + int(offsets[-1]))
    columns = _columns(window, np.array([frame.seconds for frame in window]))
    own = _own(frames)
    if smoother is None:
        values, derived, impossible = derive(*columns, rows)
        roster.impossible += impossible
    else:
        values, derived, more = smoother.fill(*columns, rows)
        for row, one in enumerate(more):
            if one:
                own[row] = {**(own[row] or {}), **one}
    nodes = np.concatenate([frame.node for frame in frames])
    ego = np.array([frame.ego for frame in frames], np.int64)
    entities, scenery = roster.take(known, frames[-1].returned)
    return FrameBlock(
        seq=np.arange(first, first + len(frames)),
        time_ns=np.array([frame.time_ns for frame in frames], np.int64),
        log_time_ns=np.array([frame.log_time_ns for frame in frames], np.int64),
        offsets=offsets,
        states=_states(
            nodes,
            values,
            lights=np.concatenate([frame.lights for frame in frames]),
            light_state=np.concatenate([frame.light_state for frame in frames]).astype(np.int8),
            derived=derived,
            own=own,
            **_controls(nodes, ego, frames, counts),
        ),
        ego=ego,
        entities=entities,
        scenery=scenery,
        messages=chained(refs),
        events=roster.take_events(),
        noise=max(smoother.noise) if smoother is not None else 0.0,
    )


def _columns(window: list[FrameRows], seconds: Floats) -> tuple[Ints, Ints, Floats, Floats, Bools]:
    """Return the arguments of :func:`derive`: nodes, frames, time steps, values, fixed objects."""
    return (
        np.concatenate([frame.node for frame in window]),
        np.repeat(np.arange(len(window)), [len(frame) for frame in window]),
        seconds,
        np.concatenate([frame.values for frame in window]),
        np.concatenate([frame.light_state for frame in window]) >= 0,
    )


def first_noise(decoder: MessageDecoder[Raw], raw: list[Raw]) -> Noise:
    """Estimate the noise of positions from the first frames of a recording."""
    frames = decoder.complete(raw)
    if not any(map(len, frames)):
        return EXACT
    time = np.array([frame.time_ns for frame in frames], np.int64)
    steps = np.diff(time, prepend=time[0]) / 1e9
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    steps[(steps <= 0) | (steps > 3.01 * usual)] = np.nan
    node, frame, seconds, values, fixed = _columns(frames, steps)
    return noise_of(node, frame, seconds, np.where(np.abs(values) < FAR, values, NAN), fixed)


def lacks_velocity(decoder: MessageDecoder[Raw], raw: list[Raw]) -> bool:
    """Return True if a moving object of these frames has no recorded velocity."""
    frames = decoder.complete(raw)
    if not frames:
        return False
    _, _, _, values, fixed = _columns(frames, np.zeros(len(frames)))
    return bool((np.isnan(values[:, _VELOCITY]) & ~fixed).any())


FIRST_STEPS: Final = 64
"""Number of recent time steps whose median is the period of a recording."""


class LifetimeTracker:
    """Assignment of node ids to objects. If an id returns with another object, the object gets a new node id.

    Node ids depend on lifetimes, by the rule of :class:`~sgstore.model.world.Lives`. Most ids have the same
    entity in all frames. They are compared as arrays; only the rows of possibly different entities are
    processed one by one.

    Parameters
    ----------
    roster : EntityTable
        Receives the additional entities.
    first_steps : iterable of int
        Times between the first frames of the recording; ns.
    sure_kinds : bool
        False means that the kind of an entity in a frame is a guess.
    """

    MOST: ClassVar[int] = 20
    """Largest number of reused ids that a report lists."""

    def __init__(
        self, roster: EntityTable, first_steps: Iterable[int], *, sure_kinds: bool = True
    ) -> None:
        self._roster = roster
        self._sure_kinds = sure_kinds
        self._steps = deque((step for step in first_steps if step > 0), FIRST_STEPS)
        self._time: int | None = None
        self._seq = self._run = 0
        self._gaps: list[int] = []
        # For each id: time, and run of the clock; -1 if never seen.
        self._seen = np.zeros((0, 2), np.int64)
        self._places = np.zeros((0, 3))
        # Node id and lifetime of the entities of each id with a changed kind or a jump.
        self._lives: dict[int, Lives[tuple[int, int]]] = {}
        self._warnings: list[str] = []

    def follow(self, frames: list[FrameRows], sizes: list[int]) -> list[FrameRows]:
        """Return the next frames with final node ids. Objects that share an id get different node ids.

        ``sizes`` is the number of known ids at each frame.
        """
        runs: list[int] = []
        for frame in frames:
            seconds = self._seconds(frame.time_ns)
            frame.seconds, frame.returned = seconds, self._roster.returned
            runs.append(self._run)
        earlier = self._earlier(frames, runs)
        if not (self._lives or any(earlier)):
            self._seq += len(frames)
            return frames
        return [
            self._entered(frame, run, sights, size)
            for frame, run, sights, size in zip(frames, runs, earlier, sizes, strict=True)
        ]

    def settle(self) -> None:
        """Add warnings about reused ids and gaps of the clock to the report."""
        warnings = self._roster.report.warnings
        most = self.MOST if self._roster.report.passes is None else 0
        warnings += self._warnings[:most]
        if len(self._warnings) > most:
            warnings.append(f"{len(self._warnings)} ids in all come back as other entities")
        if self._gaps:
            longest = max(self._gaps) / 1e9
            warnings.append(
                f"{number_of(len(self._gaps), 'gap')} longer than three periods, the longest {longest:g} s:"
                " nothing is derived across them"
            )

    def _seconds(self, time_ns: int) -> float:
        """Return the time since the frame before; s. After a gap or backward jump, count it; return NaN."""
        last, self._time = self._time, time_ns
        step = 0 if last is None else time_ns - last
        if step < 0:
            self._run += 1
        if step <= 0:
            return NAN
        # The median is at least the minimum, so most steps do not need it.
        short = not self._steps or step <= 3 * min(self._steps)
        joined = short or step <= derivable_ns(float(np.median(self._steps)))
        self._steps.append(step)
        if not joined:
            self._gaps.append(step)
        return step / 1e9 if joined else NAN

    def _earlier(self, frames: list[FrameRows], runs: list[int]) -> list[dict[int, Sight | None]]:
        """For each frame, return the rows whose id may belong to a new object, with the last known position.

        These are ids with a jump, and ids with a different kind in some frame.
        """
        counts = [len(frame) for frame in frames]
        found: list[dict[int, Sight | None]] = [{} for _ in frames]
        node = np.concatenate([frame.node for frame in frames] or [np.zeros(0, np.int64)])
        if not len(node):
            return found
        self._grow()
        rows = np.argsort(node, kind="stable")
        ids = node[rows]
        place = np.concatenate([frame.values[:, _X : _X + 3] for frame in frames])[rows]
        lamp = np.concatenate([frame.light_state for frame in frames])[rows] >= 0
        times = np.array([frame.time_ns for frame in frames], np.int64)
        now = np.repeat(np.stack([times, np.array(runs)], axis=1), counts, axis=0)[rows]
        placed = np.isfinite(place[:, :2]).all(axis=1) & ~lamp
        # The latest row of the same id with a known place: up to this row, and before it.
        at, begins = np.arange(len(ids)), np.diff(ids, prepend=-1) != 0
        first = np.maximum.accumulate(np.where(begins, at, 0))
        latest = np.maximum.accumulate(np.where(placed, at, -1))
        last = np.append(-1, latest[:-1])
        carried = (last < first)[:, None]
        before = np.where(carried, self._places[ids], place[last])
        was = np.where(carried, self._seen[ids], now[last])
        ends = np.flatnonzero(np.append(begins[1:], True) & (latest >= first))
        self._places[ids[ends]], self._seen[ids[ends]] = place[latest[ends]], now[latest[ends]]
        away = place - before
        far = leaps(np.sqrt(np.nansum(away * away, axis=1)), (now[:, 0] - was[:, 0]) / 1e9)
        far &= placed & (now[:, 1] == was[:, 1])
        called = {number for frame in frames for number in frame.kinds} if self._sure_kinds else ()
        if called:
            far |= np.isin(ids, [*called])
        ends = np.cumsum(counts)
        for one in np.flatnonzero(far).tolist():
            frame = int(np.searchsorted(ends, rows[one], side="right"))
            row = int(rows[one] - ends[frame] + counts[frame])
            time, run = was[one].tolist()
            found[frame][row] = Sight(tuple(before[one].tolist()), time, run) if run >= 0 else None
        return found

    def _grow(self) -> None:
        more = 2 * self._roster.size - len(self._seen)
        if len(self._seen) < self._roster.size:
            self._seen = np.concatenate([self._seen, np.full((more, 2), -1, np.int64)])
            self._places = np.concatenate([self._places, np.zeros((more, 3))])

    def _entered(
        self, frame: FrameRows, run: int, earlier: dict[int, Sight | None], size: int
    ) -> FrameRows:
        """Return a frame with the node ids of its objects. Add objects with a reused id to the object table."""
        numbers, nodes = frame.node.tolist(), self._roster.nodes_of(frame.node).tolist()
        for row, number in enumerate(numbers):
            if row not in earlier and number not in self._lives:
                continue
            kind = self._roster.entered(number).kind
            if number not in self._lives:
                self._lives[number] = Lives(Life((nodes[row], 1), kind, earlier[row]))
            called = frame.kinds.get(number)
            kind = KIND_CODE[called[0].kind] if called else kind
            lamp = frame.light_state[row] >= 0
            place = (NAN,) * 3 if lamp else tuple(frame.values[row, _X : _X + 3].tolist())
            nodes[row] = self._follow(number, kind, Sight(place, frame.time_ns, run), called, size)
        self._seq += 1
        of = dict(zip(numbers, nodes, strict=True))
        return replace(
            frame,
            node=np.array(nodes, np.int64),
            ego=of.get(frame.ego, -1),
            driven={of[number]: told for number, told in frame.driven.items() if number in of},
            own={of[number]: told for number, told in frame.own.items() if number in of},
            returned=self._roster.returned,
        )

    def _follow(self, number: int, kind: int, here: Sight, called: Called | None, size: int) -> int:
        """Return the node id of the object that has an id in a given frame."""
        lives = self._lives[number]
        before = lives.last

        def enter() -> tuple[int, int]:
            same = before.kind == kind or not self._sure_kinds
            why = "is where it cannot have moved" if same else f"is a {KINDS[kind]} now"
            return self._enter(number, called, size, why)

        node, lifetime = lives.follow(kind, here, enter, sure_kind=self._sure_kinds)
        if lifetime != before.entity[1]:
            self._roster.turn(number, lifetime, self._seq)
        return node

    def _enter(self, number: int, called: Called | None, size: int, why: str) -> tuple[int, int]:
        """Add a new object with a reused id. Return its node id and lifetime number."""
        row = self._roster.entered(number)
        if called is not None:
            meaning, type_name = called
            row = row._replace(
                kind=KIND_CODE[meaning.kind],
                special=meaning.special,
                subkind=meaning.subkind,
                type_name=type_name,
            )
        row = row._replace(lifetime=self._lives[number].count + 1)
        name = f"{row.ident}#{row.lifetime}"
        self._warnings.append(
            f"entity {row.ident!r} {why} (frame {self._seq}): it is a new entity, {name}"
        )
        return self._roster.enter_again(row, size), row.lifetime


def _on_earth(frames: list[FrameRows], roster: EntityTable) -> list[FrameRows]:
    """In some frames, replace impossible values (too large numbers) by NaN, and count them."""
    values = np.concatenate([frame.values for frame in frames] or [np.zeros((0, len(POSE)))])
    absurd = np.abs(values) >= FAR
    if absurd.any():
        roster.absurd += int(absurd.sum())
        values[absurd] = np.nan
    nodes = np.concatenate([frame.node for frame in frames] or [np.zeros(0, np.int64)])
    counts = [len(frame) for frame in frames]
    plausible = roster.plausible(values, nodes, np.repeat(np.arange(len(frames)), counts))
    roster.completed += len(frames)
    if plausible is values and not absurd.any():
        return frames
    cuts = np.cumsum(counts)[:-1]
    return [
        replace(frame, values=part)
        for frame, part in zip(frames, np.split(plausible, cuts), strict=True)
    ]


def _controls(nodes: Ints, ego: Ints, frames: list[FrameRows], counts: Ints) -> dict[str, Floats]:
    """Return the control inputs of the ego and of other vehicles as columns; empty if all are unknown."""
    inputs = np.array([frame.controls for frame in frames], np.float64)
    others = [frame.driven for frame in frames]
    if np.isnan(inputs).all() and not any(others):
        return {}
    columns = np.repeat(inputs, counts, axis=0)
    columns[nodes != np.repeat(ego, counts)] = np.nan
    start = 0
    for count, driven in zip(counts.tolist(), others, strict=True):
        for node, told in driven.items():
            columns[start + np.flatnonzero(nodes[start : start + count] == node)] = told
        start += count
    return {name: columns[:, column] for column, name in enumerate(INPUTS)}


def _own(frames: list[FrameRows]) -> NDArray[np.object_]:
    """Return the attributes that have no column: a mapping or ``None`` for each row of the frames."""
    column = np.full(sum(map(len, frames)), None, object)
    start = 0
    for frame in frames:
        for row, node in enumerate(frame.node.tolist() if frame.own else ()):
            column[start + row] = valid_attributes(frame.own.get(node, {})) or None
        start += len(frame)
    return column


def _states(node: Ints, values: Floats, **more: NDArray[np.generic]) -> States:
    columns = {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(POSE)}
    return States.of(node=node, **columns, **more)


def derive(
    node: Ints, frame: Ints, seconds: Floats, values: Floats, fixed: Bools, rows: slice
) -> tuple[Floats, Ints, Ints]:
    """Compute missing velocities, accelerations and yaw rates from differences between frames.

    Parameters
    ----------
    node, frame : (n,) int64
        Node id and frame of each row. Frames ascend; a node has one row per frame.
    seconds : (F,) float64
        Time from the previous frame to each frame; s. NaN: numbers must not be derived across it.
    values : (n, 16) float64
        Columns :data:`POSE`; NaN for missing numbers.
    fixed : (n,) bool
        Rows of static entities, which are skipped.
    rows : slice
        Rows of the result. Other rows are only used for differences.

    Returns
    -------
    values : (m, 16) float64
        The requested rows. A velocity is the difference of the positions one frame before and one frame after.
        It is one-sided if the entity is absent in one of them, time stands still, or the step is implausibly
        fast; it is NaN if both sides fail. An acceleration is the difference of recorded velocities, by the
        same rule. Without them, it is the second difference of positions, which needs both sides. Implausible
        accelerations are NaN.
    derived : (m,) int64
        Bit 0: velocity, bit 1: acceleration, bit 2: yaw rate.
    impossible : (2,) int64
        Number of velocities and accelerations that are missing or one-sided because of implausible values.
    """
    wanted = values[rows].copy()
    derived, impossible = np.zeros(len(wanted), np.int64), np.zeros(2, np.int64)
    lacking = np.isnan(wanted[:, [_VELOCITY, _ACCELERATION, _YAW_RATE]]) & ~fixed[rows, None]
    if not lacking.any():
        return wanted, derived, impossible
    steps = _neighbours(node, frame, seconds, rows)
    moving, lost = _possible(values, rows, steps)
    columns = (
        (_VELOCITY, 3, lambda: _slope(values[:, _X : _X + 3], rows, moving)),
        (_ACCELERATION, 3, lambda: _accelerations(values, rows, steps, moving)),
        (_YAW_RATE, 1, lambda: _slope(values[:, [_HEADING]], rows, moving, turn=2 * np.pi)),
    )
    impossible[0] = int((lost & lacking[:, 0]).sum())
    for bit, (column, width, slopes_of) in enumerate(columns):
        if not lacking[:, bit].any():
            continue
        slopes = slopes_of()
        found = lacking[:, bit] & np.isfinite(slopes).all(axis=1)
        if column == _ACCELERATION:
            # From positions, where noise grows with the square.
            bent = np.isnan(values[rows, _VELOCITY])
            hard = found & bent & (np.hypot(slopes[:, 0], slopes[:, 1]) > HARDEST)
            impossible[1] = int(hard.sum())
            found &= ~hard
        wanted[found, column : column + width] = slopes[found]
        derived |= found.astype(np.int64) << bit
    return wanted, derived, impossible


def _neighbours(node: Ints, frame: Ints, seconds: Floats, rows: slice) -> Steps:
    """Return the same node's rows in the frames before and after, and the time steps; s. NaN without a row."""
    span = int(node.max()) + 1
    keys = frame * span + node
    order = np.argsort(keys)
    sorted_keys = keys[order]
    found: list[Ints] = []
    steps: list[Floats] = []
    for side in (-1, 1):
        key = keys[rows] + side * span
        at = np.minimum(np.searchsorted(sorted_keys, key), len(keys) - 1)
        there = order[at]
        step = seconds[frame[rows] if side < 0 else frame[there]]
        found.append(there)
        steps.append(np.where(sorted_keys[at] == key, step, np.nan))
    return found[0], found[1], steps[0], steps[1]


def _possible(values: Floats, rows: slice, steps: Steps) -> tuple[Steps, Bools]:
    """Return the time steps, NaN for impossible speeds, and a mask of the rows with such steps."""
    before, behind, since, until = steps
    position = values[:, _X : _X + 3]
    lost = np.zeros(len(since), np.bool_)
    kept: list[Floats] = []
    for there, step in ((before, since), (behind, until)):
        away = position[rows] - position[there]
        far = np.nansum(away * away, axis=1) > (FASTEST * step) ** 2
        lost |= far
        kept.append(np.where(far, np.nan, step))
    return (before, behind, kept[0], kept[1]), lost


def _slope(values: Floats, rows: slice, steps: Steps, turn: float = 0.0) -> Floats:
    """Return the rate of change of values at each row, from the rows before and after that are available.

    ``turn``: period of the values, for example 2π; differences are then the smallest possible.
    """
    before, behind, since, until = steps
    back = values[rows] - values[before]
    forth = values[behind] - values[rows]
    if turn:
        back = back - turn * np.round(back / turn)
        forth = forth - turn * np.round(forth / turn)
    since, until = since[:, None], until[:, None]
    both = (back + forth) / (since + until)
    slopes = np.where(np.isfinite(both), both, back / since)
    return np.where(np.isfinite(slopes), slopes, forth / until)


def _accelerations(values: Floats, rows: slice, steps: Steps, moving: Steps) -> Floats:
    """Compute accelerations from velocities. Use only time steps with plausible speeds.

    ``moving`` contains these time steps.
    """
    velocity = values[:, _VELOCITY : _VELOCITY + 3]
    position = values[:, _X : _X + 3]
    before, behind, since, until = moving
    since, until = since[:, None], until[:, None]
    back = (position[rows] - position[before]) / since
    forth = (position[behind] - position[rows]) / until
    bend = 2 * (forth - back) / (since + until)
    read = np.isfinite(velocity[rows]).all(axis=1, keepdims=True)
    return np.where(read, _slope(velocity, rows, steps), bend)
