"""Foxglove messages → frames: boxes of a scene as rows, in the axes that stand still; the ego by a mapping.

* A frame is a message of the leading scene. What other scenes tell stays until they tell something else.
* An entity stays until it is replaced, deleted, or its lifetime ends; or, if messages tell all that there is
  (``snapshot``), until the next message.
* Poses are carried to the axes that stand still by the transforms of the recording, at the time of the frame
  for what is locked to its axes, else at the time of the entity.
* Foxglove knows no velocity: what no metadata tells is derived.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.readers._base import FAR, NAN, EntityTable, FrameRows, LossTally
from sgstore.readers.foxglove._mapping import METADATA, type_keys
from sgstore.readers.foxglove._messages import ERRORS, SCENE, Axes, angles, product, rotated
from sgstore.vocabulary import LIGHT_STATE_CODE, normalize_name
from sgstore.world import POSE

if TYPE_CHECKING:
    from sgstore.mcap import Messages
    from sgstore.readers.foxglove._mapping import Ego, EntityMapping, Mapping
    from sgstore.readers.foxglove._messages import Box, ChannelReader, Pose, SceneUpdate, Transform
    from sgstore.world import TraceReport


MAX_STANDING: Final = 100_000
"""Entities that stay from one message to the next."""
REMEMBERED: Final = 10_000_000_000
"""How long transforms are remembered; ns."""
NO_EGO: Final = "no entity is the ego: none is named, and the mapping names none that is there"

_HEADING, _VELOCITY, _ACCELERATION, _SIZE = 3, 6, 9, 13
_STATES: Final = {normalize_name(name): code for name, code in LIGHT_STATE_CODE.items()}


@dataclass(slots=True)
class FoxgloveRawFrame:
    """A frame whose poses are still in the axes that they were told in.

    ``boxes``: each with its node id and log time of the frame that it was told with.
    """

    time_ns: int
    log_time_ns: int
    boxes: list[tuple[int, Box]] = field(default_factory=list)  # pyright: ignore[reportUnknownVariableType]


@dataclass(frozen=True, slots=True)
class EntityNames:
    """Ids and types of entities, as a mapping says where they stand."""

    entity: EntityMapping

    def ident(self, box: Box) -> str:
        """The id of an entity; its own where the mapping's place for it is empty."""
        return self.text(self.entity.id, box) or box.id

    def type_name(self, box: Box) -> str:
        """The type of an entity, or the empty string."""
        if self.entity.type:
            told = self.text(self.entity.type, box)
            if told or self.entity.type != "metadata.type":
                return told
        lowered = {key.lower(): value for key, value in box.metadata.items()}
        return next((lowered[key] for key in type_keys() if lowered.get(key)), "")

    @staticmethod
    def text(place: str, box: Box) -> str:
        """Text at a place of an entity."""
        if place.startswith(METADATA):
            return box.metadata.get(place.removeprefix(METADATA), "")
        return box.id if place == "id" else ""

    def number(self, place: str, box: Box) -> float:
        """The number at a place of an entity; NaN if there is none."""
        try:
            return float(self.text(place, box) or NAN)
        except ValueError:
            return NAN


class FoxgloveDecoder:
    """Messages → frames, with what must be remembered from one to the next.

    Parameters
    ----------
    readers : dict
        Channel id → reader, of the scenes and transforms.
    leading : int
        Id of the channel whose messages are frames.
    mapping : Mapping
    root : str
        The axes that stand still.
    ego : tuple of str
        Id of the entity, and name of the axes, that are the ego; empty where they are not.
    window : tuple of int
        Log times, both included, between which messages are frames.
    report : TraceReport

    Attributes
    ----------
    roster : EntityTable
    channels : frozenset of int
    """

    def __init__(
        self,
        readers: dict[int, ChannelReader],
        leading: int,
        mapping: Mapping,
        root: str,
        ego: tuple[str, str],
        window: tuple[int, int],
        report: TraceReport,
    ) -> None:
        self.roster = EntityTable(report)
        self.channels = frozenset(readers)
        self._readers = readers
        self._leading = leading
        self._mapping = mapping
        self._names = EntityNames(mapping.entity)
        self._root = root
        self._ego_entity, self._ego_axes = ego
        self._window = window
        self._report = report
        self._axes = Axes()
        self._nodes: dict[tuple[int, str], int] = {}
        self._idents: list[str] = []
        self._ego = -1
        self._standing: dict[int, dict[str, tuple[int, Box]]] = {}
        self._unreadable, self._unusable = LossTally(), LossTally()
        self._untimed = self._bodiless = self._odd_axes = 0
        self._last = (0, 0)

    def decode(self, run: Messages, row: int) -> FoxgloveRawFrame | None:
        """The frame that a message of the leading scene is; of others ``None``."""
        channel, log_time = int(run.channel[row]), int(run.log_time_ns[row])
        reader = self._readers[channel]
        inside = self._window[0] <= log_time <= self._window[1]
        try:
            data = bytes(run.data(row))
            if reader.name != SCENE:
                self._take_transforms(reader.transforms(data), log_time)
                return None
            scene = reader.scene(data)
        except ERRORS as error:
            reason = (
                f"a message of schema {reader.name} cannot be read: {type(error).__name__}: {error}"
            )
            self._unreadable.add(reason, log_time, int(run.length[row]))
            return None
        time_ns = self._time_of(scene, log_time)
        self._take_scene(channel, scene, time_ns, log_time)
        if channel != self._leading or not inside:
            return None
        frame = FoxgloveRawFrame(time_ns, log_time)
        for source, standing in self._standing.items():
            ended = [
                ident
                for ident, (told, box) in standing.items()
                if box.lifetime_ns and told + box.lifetime_ns < time_ns
            ]
            for ident in ended:
                del standing[ident]
            frame.boxes += [
                (self._nodes[source, ident], box) for ident, (_, box) in standing.items()
            ]
        if self._ego < 0 and self._ego_axes and self._pose_of_ego(time_ns) is not None:
            self._ego = self._enter_ego()
        return frame

    def complete(self, frames: list[FoxgloveRawFrame]) -> list[FrameRows]:
        """Frames with the poses of their boxes in the axes that stand still."""
        done = [self._rows(frame) for frame in frames]
        if frames:
            self._axes.forget(frames[-1].time_ns - REMEMBERED)
        return done

    def settle(self) -> None:
        """Report what could not be used, once all frames are read."""
        losses, warn = self._report.losses, self._report.warnings.append
        losses += self._unreadable.losses()
        losses += self._unusable.losses()
        if self._untimed:
            warn(f"{self._untimed} frames bear no time of their own: their log time is taken")
        if self._bodiless:
            warn(f"{self._bodiless} entities are lines, texts or arrows only: they are no objects")
        if self._odd_axes:
            warn(
                f"{self._odd_axes} transforms contradict others or have no usable pose: they were left out"
            )
        if self._ego < 0:
            warn(NO_EGO)
            self._report.about_ego.append(NO_EGO)

    # Messages ------------------------------------------------------------------------------------------

    def _take_transforms(self, told: list[Transform], log_time: int) -> None:
        for one in told:
            time_ns = one.time_ns or log_time
            if one.pose is None or not self._axes.tell(one.child, one.parent, time_ns, one.pose):
                self._odd_axes += 1

    def _time_of(self, scene: SceneUpdate, log_time: int) -> int:
        """The time of a message: that of its latest entity, else as far behind the last as it was logged."""
        times = [box.time_ns for box in scene.boxes if box.time_ns]
        last, last_log = self._last
        if times:
            time_ns = max(times)
        elif last:
            time_ns = last + log_time - last_log
        else:
            time_ns = log_time
            self._untimed += bool(scene.boxes)
            return time_ns
        self._last = (time_ns, log_time)
        return time_ns

    def _take_scene(self, channel: int, scene: SceneUpdate, time_ns: int, log_time: int) -> None:
        standing = self._standing.setdefault(channel, {})
        if scene.cleared or self._mapping.scene.snapshot:
            standing.clear()
        for ident in scene.deleted:
            standing.pop(ident, None)
        self._bodiless += scene.bodiless
        seen: set[str] = set()
        for box in scene.boxes:
            ident = self._names.ident(box)
            if ident in seen:
                self._unusable.add(f"entity {ident} comes more than once in a message", log_time)
                continue
            seen.add(ident)
            if len(standing) >= MAX_STANDING and ident not in standing:
                self._unusable.add(f"more than {MAX_STANDING} entities at once", log_time)
                continue
            if (channel, ident) not in self._nodes:
                self._nodes[channel, ident] = self._enter(ident, box)
            standing[ident] = (box.time_ns or time_ns, box)

    def _enter(self, ident: str, box: Box) -> int:
        type_name = self._names.type_name(box)
        meaning = self._mapping.meaning(type_name)
        if meaning.kind == "vehicle" and type_name.lower() not in self._mapping.types:
            self.roster.count_unknown(type_name)
        node = self.roster.enter(ident, meaning, type_name)
        self._idents.append(ident)
        if self._ego < 0 and self._ego_entity and ident == self._ego_entity:
            self._ego = node
        return node

    def _enter_ego(self) -> int:
        ego = self._mapping.ego
        self._idents.append(self._ego_axes)
        return self.roster.enter(self._ego_axes, self._mapping.meaning(ego.type), ego.type)

    # Rows ----------------------------------------------------------------------------------------------

    def _rows(self, frame: FoxgloveRawFrame) -> FrameRows:
        nodes: list[int] = []
        rows: list[list[float]] = []
        states: list[int] = []
        for node, box in frame.boxes:
            values = self._values(box, frame.time_ns)
            if values is None:
                where = (
                    ""
                    if box.pose is None
                    else f" (axes {box.axes!r} are not tied to {self._root!r})"
                )
                words = f"entity {self._idents[node]} has no usable pose{where}"
                self._unusable.add(words, frame.log_time_ns)
                continue
            nodes.append(node)
            rows.append(values)
            state = normalize_name(self._names.text(self._mapping.entity.light_state, box))
            states.append(
                _STATES.get(state, 0) if self._mapping.entity.light_state and state else -1
            )
        if self._ego >= 0 and self._ego_axes:
            pose = self._pose_of_ego(frame.time_ns)
            if pose is not None:
                nodes.append(self._ego)
                rows.append(_row(pose, _size(self._mapping.ego)))
                states.append(-1)
        count = len(nodes)
        return FrameRows(
            time_ns=frame.time_ns,
            log_time_ns=frame.log_time_ns,
            ego=self._ego if self._ego in nodes else -1,
            node=np.array(nodes, np.int64),
            values=np.array(rows, np.float64).reshape(count, len(POSE)),
            lights=np.full(count, -1, np.int64),
            light_state=np.array(states, np.int64),
        )

    def _values(self, box: Box, time_ns: int) -> list[float] | None:
        """The columns of :data:`POSE` of a box; ``None`` if it has no pose in the axes that stand still."""
        at = time_ns if box.locked or not box.time_ns else box.time_ns
        outer = self._axes.pose(box.axes or self._root, self._root, at)
        if box.pose is None or outer is None:
            return None
        place = outer[0] + rotated(outer[1], box.pose[0])
        if not (np.abs(place) < FAR).all():
            return None
        row = _row((place, product(outer[1], box.pose[1])), box.size)
        entity, number = self._mapping.entity, self._names.number
        for column, places in ((_VELOCITY, entity.velocity), (_ACCELERATION, entity.acceleration)):
            if places:
                told = np.array([number(place, box) for place in places])
                row[column : column + 3] = rotated(outer[1], told).tolist()
        speed = number(entity.speed, box) if entity.speed else NAN
        if math.isfinite(speed) and math.isnan(row[_VELOCITY]):
            heading = row[_HEADING]
            row[_VELOCITY : _VELOCITY + 3] = [
                speed * math.cos(heading), speed * math.sin(heading), 0.0
            ]  # fmt: skip
        return row

    def _pose_of_ego(self, time_ns: int) -> Pose | None:
        pose = self._axes.pose(self._ego_axes, self._root, time_ns)
        if pose is None:
            return None
        place, turn = pose
        return place + rotated(turn, np.array(self._mapping.ego.offset)), turn


def _row(pose: Pose, size: tuple[float, float, float]) -> list[float]:
    place, turn = pose
    return [*place.tolist(), *angles(turn), *(NAN,) * 7, *size]


def _size(ego: Ego) -> tuple[float, float, float]:
    return ego.length, ego.width, ego.height
