"""Blocks of frames: rows of decoded messages, entities, and numbers that a recording lacks.

The :class:`MessageDecoder` of a flavour makes :class:`FrameRows` of messages and enters what it meets into a
:class:`EntityTable`.
:func:`assemble` makes blocks of that, ahead of what it hands out: a velocity that the recording lacks is
the difference of two positions, the second of them may belong to the first frame of the next block, and
what else is told of that frame may stand behind the message that leads. So a value never depends on where
a block begins or ends.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Final, Generic, TypeVar

import numpy as np

from sgstore.columns import chained, taken
from sgstore.mcap import IDS, Loss
from sgstore.vocabulary import KIND_CODE
from sgstore.world import INPUTS, POSE, Entities, FrameBlock, MessageRefs, States

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    from sgstore.mcap import Messages
    from sgstore.vocabulary import TypeMeaning
    from sgstore.world import Bools, Event, Floats, Ints, TraceReport

    Steps = tuple[Ints, Ints, Floats, Floats]


Raw = TypeVar("Raw")

NAN: Final = float("nan")
FAR: Final = 1e9
"""Greatest coordinate of anything on earth, in any projection; m. Beyond it a pose is not usable."""

UPRIGHT: Final = 1 - 1e-13
"""Sine of the pitch beyond which rounding leaves no heading and roll of their own."""

NEAR_REFS: Final = 250_000
"""Messages behind a frame, and before the next one, that are referred to however many there are."""

MOST_EVENTS: Final = 10_000
"""Events that a report lists; a vehicle that leans on a wall collides in every frame. Blocks have them all."""

_X, _HEADING, _VELOCITY, _ACCELERATION, _YAW_RATE = 0, 3, 6, 9, 12


NO_INPUTS: Final = (NAN,) * len(INPUTS)
"""Controls of whom the recording tells none."""


@dataclass(frozen=True, slots=True)
class FrameRows:
    """One frame, decoded.

    Attributes
    ----------
    time_ns, log_time_ns : int
        Simulation time; log time of the leading message.
    ego : int
        Node id, -1 where it is absent.
    node, lights, light_state : (n,) int64
        As in :class:`sgstore.world.States`.
    values : (n, 16) float64
        Columns :data:`POSE`.
    controls : tuple of float
        :data:`sgstore.world.INPUTS` of the ego; NaN where the recording has none.
    driven : mapping
        Node id → the same, of other vehicles than the ego.
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

    def __len__(self) -> int:
        return len(self.node)

    def with_heads(self, heads: tuple[Ints, Floats, Ints]) -> FrameRows:
        """The same, and behind it the rows of traffic lights: node ids, columns :data:`POSE`, states."""
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


@dataclass(slots=True)
class EntityTable:
    """The entities of a trace in the order in which they were met; the index is the node id. And its events.

    Attributes
    ----------
    report : TraceReport
        Takes up the type names that nothing maps.
    size : int
        How many there are.
    absurd : int
        Numbers that nothing on earth has, in states and poses.
    happened : int
        How many events there were.
    """

    report: TraceReport
    size: int = 0
    absurd: int = 0
    happened: int = 0
    _events: list[Event] = field(default_factory=list["Event"])
    _first: int = 0
    _rows: list[tuple[str, int, str, str, str, bool, str]] = field(default_factory=list)  # pyright: ignore[reportUnknownVariableType]
    _poses: dict[int, tuple[float, ...]] = field(default_factory=dict[int, tuple[float, ...]])
    _idents: set[str] = field(default_factory=set[str])

    def enter(
        self,
        ident: str,
        meaning: TypeMeaning,
        type_name: str,
        map_ref: str = "",
        pose: tuple[float, ...] | None = None,
    ) -> int:
        """Enter an entity and return its node id.

        Parameters
        ----------
        ident : str
            The simulator's own id; where another entity bears it too, the kind is appended.
        meaning : TypeMeaning
        type_name, map_ref : str
        pose : tuple of float, optional
            Columns :data:`POSE` of an entity that never moves.
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
        row = (
            ident,
            KIND_CODE[meaning.kind],
            meaning.special,
            meaning.subkind,
            type_name,
            pose is not None,
            map_ref,
        )
        self._rows.append(row)
        self.size += 1
        return node

    def happen(self, event: Event) -> None:
        """Take up an event."""
        self.happened += 1
        self._events.append(event)
        if self.happened <= MOST_EVENTS:
            self.report.events.append(event)

    def take_events(self) -> tuple[Event, ...]:
        """The events that were not taken yet."""
        events, self._events = tuple(self._events), []
        return events

    def settle(self) -> None:
        """Report what is odd, once everything was taken."""
        warn = self.report.warnings.append
        if self.absurd:
            warn(f"{self.absurd} numbers of {FAR:g} and more are taken as missing")
        if self.happened > MOST_EVENTS:
            warn(f"of {self.happened} events the report lists the first {MOST_EVENTS}")

    def count_unknown(self, type_name: str) -> None:
        """Count an entity whose type name nothing maps to a kind of its own."""
        unknown = self.report.unknown_types
        unknown[type_name] = unknown.get(type_name, 0) + 1

    def take(self, upto: int) -> tuple[Entities, States]:
        """The entities that were not taken yet, up to a node id, and the poses of the static ones."""
        count = upto - self._first
        rows, self._rows = self._rows[:count], self._rows[count:]
        columns = tuple(zip(*rows, strict=True)) if rows else ((),) * 7
        entities = Entities(
            first=self._first,
            ident=columns[0],
            kind=np.array(columns[1], np.int8),
            special=columns[2],
            subkind=columns[3],
            type_name=columns[4],
            static=np.array(columns[5], np.bool_),
            map_ref=columns[6],
        )
        nodes = [node for node in range(self._first, upto) if node in self._poses]
        values = np.array([self._poses.pop(node) for node in nodes], np.float64)
        absurd = np.abs(values) >= FAR
        self.absurd += int(absurd.sum())
        values[absurd] = np.nan
        self._first = upto
        return entities, _states(np.array(nodes, np.int64), values.reshape(-1, len(POSE)))


class LossTally:
    """Losses by their reason.

    A reason that comes again adds to the loss that there is; beyond :attr:`MOST` reasons the others are
    counted together.
    """

    MOST: ClassVar[int] = 1000

    def __init__(self) -> None:
        self._found: dict[str, Loss] = {}

    def add(self, reason: str, log_time_ns: int, size: int = 0) -> None:
        """Count one more, of ``size`` bytes."""
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
        """One loss for each reason; ``messages`` is how often."""
        return list(self._found.values())


class MessageDecoder(Generic[Raw]):
    """Messages → frames, in two steps, so that the numbers of many frames can be read at once.

    Parameters
    ----------
    channels : collection of int
        Ids of the channels whose messages it asks for: those that are frames, and those that say more about the
        same instants.
    window : tuple of int
        Log times, both included, between which messages are frames; others only tell what lasts.
    report : TraceReport
        Takes up what cannot be used.

    Attributes
    ----------
    roster : EntityTable
        Takes up entities while messages are decoded.
    channels : frozenset of int
    """

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
        """The frame that a message is, or ``None`` if it is none."""
        raise NotImplementedError

    def complete(self, frames: list[Raw]) -> list[FrameRows]:
        """The same frames with their numbers.

        Each has been followed by another, or by the end of the recording: what belongs to the same instant
        may stand behind the message that leads.
        """
        raise NotImplementedError

    def settle(self) -> None:
        """Report what could not be used, once all frames are read."""
        losses = self._report.losses
        losses += self._unreadable.losses()
        for loss in self._unusable.losses():  # of states, which are no messages
            reason = f"{loss.reason}: {loss.messages} states were left out"
            losses.append(replace(loss, reason=reason, messages=0, bytes=0))
        if self._untimed:
            words = f"{self._untimed} frames bear no time of their own: their log time is taken"
            self._report.warnings.append(words)

    def is_inside(self, log_time_ns: int) -> bool:
        """Return whether a message logged then is a frame; a clip brings others for what lasts."""
        return self._window[0] <= log_time_ns <= self._window[1]

    def lose(self, reason: str, run: Messages, row: int) -> None:
        """Count a message that cannot be read."""
        self._unreadable.add(reason, int(run.log_time_ns[row]), int(run.length[row]))

    def _warn_of_egos(self, words: str) -> None:
        """Warn of the lack of an ego; who names the egos is not concerned."""
        self._report.warnings.append(words)
        self._report.about_ego.append(words)


def assemble(
    runs: Iterable[Messages],
    size: int,
    decoder: MessageDecoder[Raw],
    refs: Callable[[Messages], MessageRefs],
) -> Iterator[FrameBlock]:
    """Blocks of frames from the messages of a recording.

    Parameters
    ----------
    runs : iterable of Messages
        In file order.
    size : int
        Frames of a block; the last may have fewer.
    decoder : MessageDecoder
    refs : callable
        The references of those messages that belong to frames.

    Yields
    ------
    FrameBlock
        Its messages are those that stand in the file from its first frame up to the next block's.
    """
    wanted = np.zeros(IDS, np.bool_)
    wanted[[*decoder.channels]] = True
    raw: list[Raw] = []
    done: list[FrameRows] = []  # the frame before the block, and those of it that are complete
    open_refs: list[MessageRefs] = []
    block_refs: list[MessageRefs] = []
    between = _Between()
    first, known = 0, 0
    for run in runs:
        start = 0
        for row in np.flatnonzero(wanted[run.channel]).tolist():
            entered = decoder.roster.size
            frame = decoder.decode(run, row)
            if frame is None:
                continue
            window = size + (first > 0)
            if len(done) + len(raw) > window:  # the frame behind the block is complete now, too
                done += _on_earth(decoder.complete(raw), decoder.roster)
                yield _block(first, done, size, block_refs, decoder.roster, known)
                first, done, raw = first + size, done[-2:], []
                window = size + 1
            if len(done) + len(raw) == window:
                between.add(refs(run.span(start, row)))
                start, known = row, entered
                block_refs, open_refs = open_refs + between.take(), []
            raw.append(frame)
            open_refs += between.take()
        between.add(refs(run.span(start, len(run))))
    open_refs += between.take()
    done += _on_earth(decoder.complete(raw), decoder.roster)
    if len(done) - (first > 0) > size:
        yield _block(first, done, size, block_refs, decoder.roster, known)
        first, done = first + size, done[-2:]
    left = len(done) - (first > 0)
    last = (
        _block(first, done, left, open_refs, decoder.roster, decoder.roster.size) if left else None
    )
    decoder.roster.settle()
    if between.dropped:
        words = f"{between.dropped} sensor messages stand far from any frame, and no frame refers to them"
        decoder.roster.report.warnings.append(words)
    if last is not None:
        yield last


@dataclass(slots=True)
class _Between:
    """References of messages between two frames: if they are very many, the first and the last of them.

    A recording may hold hours of pictures without any ground truth. What stands far from every frame is the
    payload of none.
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
            # As copies, so that the whole is not kept alive by a part of it.
            self._parts = [taken(whole, near), taken(whole, near + len(whole) - NEAR_REFS)]
            self._total = 2 * NEAR_REFS

    def take(self) -> list[MessageRefs]:
        """All of them, in order; then there are none."""
        parts, self._parts, self._total = self._parts, [], 0
        return parts


def counted(blocks: Iterable[FrameBlock], report: TraceReport) -> Iterator[FrameBlock]:
    """The same blocks, while a report counts their frames and states and watches their clock."""
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
        report.warnings.append(f"simulation time runs backwards {back} times")
    if still:
        report.warnings.append(f"simulation time stands still {still} times")


def _block(
    first: int,
    window: list[FrameRows],
    size: int,
    refs: list[MessageRefs],
    roster: EntityTable,
    known: int,
) -> FrameBlock:
    """The block of ``size`` frames in a window, which has the frames before and behind it too, if any.

    ``known``: how many entities had been met before the next block's first frame.
    """
    skipped = int(first > 0)
    frames = window[skipped : skipped + size]
    counts = np.array([len(frame) for frame in frames], np.int64)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    skip = len(window[0]) if skipped else 0
    rows = slice(skip, skip + int(offsets[-1]))
    values, derived = derive(
        np.concatenate([frame.node for frame in window]),
        np.repeat(np.arange(len(window)), [len(frame) for frame in window]),
        np.array([frame.time_ns for frame in window], np.int64),
        np.concatenate([frame.values for frame in window]),
        np.concatenate([frame.light_state for frame in window]) >= 0,
        rows,
    )
    nodes = np.concatenate([frame.node for frame in frames])
    ego = np.array([frame.ego for frame in frames], np.int64)
    entities, scenery = roster.take(known)
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
            **_controls(nodes, ego, frames, counts),
        ),
        ego=ego,
        entities=entities,
        scenery=scenery,
        messages=chained(refs),
        events=roster.take_events(),
    )


def _on_earth(frames: list[FrameRows], roster: EntityTable) -> list[FrameRows]:
    """The same frames without numbers that nothing on earth has; they are counted, and missing from now on."""
    values = np.concatenate([frame.values for frame in frames] or [np.zeros(0)])
    if not (np.abs(values) >= FAR).any():
        return frames
    for frame in frames:
        absurd = np.abs(frame.values) >= FAR
        if absurd.any():
            roster.absurd += int(absurd.sum())
            frame.values[absurd] = np.nan
    return frames


def _controls(nodes: Ints, ego: Ints, frames: list[FrameRows], counts: Ints) -> dict[str, Floats]:
    """Control inputs in the rows of the ego and of others that have any; nothing where no frame tells any."""
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


def _states(node: Ints, values: Floats, **more: NDArray[np.generic]) -> States:
    columns = {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(POSE)}
    return States.of(node=node, **columns, **more)


def derive(
    node: Ints, frame: Ints, time_ns: Ints, values: Floats, fixed: Bools, rows: slice
) -> tuple[Floats, Ints]:
    """Velocities, accelerations and yaw rates that a recording lacks, by differences.

    Parameters
    ----------
    node, frame : (n,) int64
        Node id and frame of each row; frames ascend, a node comes once in a frame.
    time_ns : (F,) int64
        Time of each frame.
    values : (n, 16) float64
        Columns :data:`POSE`; NaN is what is lacking.
    fixed : (n,) bool
        Rows of what does not move; nothing is derived for them.
    rows : slice
        The rows that are wanted; those outside it are only differed from.

    Returns
    -------
    values : (m, 16) float64
        The wanted rows. A velocity is the difference of the positions one frame before and one behind,
        or of one of them and this, where the entity is not in the other or time stands still; NaN if in
        neither. An acceleration is the difference of velocities likewise if they were read, else the
        second difference of positions, which needs both neighbours.
    derived : (m,) int64
        Bit 0: velocity, bit 1: acceleration, bit 2: yaw rate.
    """
    wanted = values[rows].copy()
    derived = np.zeros(len(wanted), np.int64)
    lacking = np.isnan(wanted[:, [_VELOCITY, _ACCELERATION, _YAW_RATE]]) & ~fixed[rows, None]
    if not lacking.any():
        return wanted, derived
    steps = _neighbours(node, frame, time_ns, rows)
    columns = (
        (_VELOCITY, 3, lambda: _slope(values[:, _X : _X + 3], rows, steps)),
        (_ACCELERATION, 3, lambda: _accelerations(values, rows, steps)),
        (_YAW_RATE, 1, lambda: _slope(values[:, [_HEADING]], rows, steps, turn=2 * np.pi)),
    )
    for bit, (column, width, slopes_of) in enumerate(columns):
        if not lacking[:, bit].any():
            continue
        slopes = slopes_of()
        found = lacking[:, bit] & np.isfinite(slopes).all(axis=1)
        wanted[found, column : column + width] = slopes[found]
        derived |= found.astype(np.int64) << bit
    return wanted, derived


def _neighbours(node: Ints, frame: Ints, time_ns: Ints, rows: slice) -> Steps:
    """Rows of the same node one frame before and behind; steps of time to them, NaN where there is none."""
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
        step = side * (time_ns[frame[there]] - time_ns[frame[rows]]) / 1e9
        found.append(there)
        steps.append(np.where((sorted_keys[at] == key) & (step > 0), step, np.nan))
    return found[0], found[1], steps[0], steps[1]


def _slope(values: Floats, rows: slice, steps: Steps, turn: float = 0.0) -> Floats:
    """Slope at each row: over both steps where there are two, else over the one there is.

    ``turn``: values are the same modulo this, and differences the smallest that there are.
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


def _accelerations(values: Floats, rows: slice, steps: Steps) -> Floats:
    velocity = values[:, _VELOCITY : _VELOCITY + 3]
    position = values[:, _X : _X + 3]
    before, behind, since, until = steps
    since, until = since[:, None], until[:, None]
    back = (position[rows] - position[before]) / since
    forth = (position[behind] - position[rows]) / until
    bend = 2 * (forth - back) / (since + until)
    read = np.isfinite(velocity[rows]).all(axis=1, keepdims=True)
    return np.where(read, _slope(velocity, rows, steps), bend)
