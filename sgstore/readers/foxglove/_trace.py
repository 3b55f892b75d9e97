"""Reader of Foxglove scenes in MCAP files: messages ``SceneUpdate`` and ``FrameTransform``.

A recording is recognised by the schemas of its channels. A scene is made for drawing. A mapping therefore
defines the types and speeds of its boxes, and the ego (:mod:`sgstore.readers.foxglove._mapping`). A frame is
one message of the leading scene, in file order. The leading scene is the one with the most messages with boxes.

* The contents of other scenes stay valid until their next message.
* An entity stays until it is replaced or deleted, or its lifetime ends. If each message contains the complete
  scene (``snapshot``), it stays until the next message.
* Poses are converted into fixed axes by the transforms of the recording: at the time of the frame for entities
  locked to their axes, else at the time of the entity.
* Foxglove has no velocities. A velocity missing in the metadata is derived.

Source: foxglove-sdk, schemas.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from hashlib import sha256
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.model.vocabulary import KINDS, LIGHT_STATE_CODE, normalize_name
from sgstore.model.world import POSE
from sgstore.readers._base import (
    LISTED,
    Lead,
    Ref,
    Survey,
    SurveyedDecoder,
    SurveyedTrace,
    count_ref,
    ref_of,
)
from sgstore.readers._blocks import FAR, NAN, FrameRows, LossTally
from sgstore.readers._stamps import LATEST_NS, NO_TIME, Stamps
from sgstore.readers.foxglove._mapping import Mapping, mapping_for
from sgstore.readers.foxglove._messages import (
    ERRORS,
    ORIGIN,
    SCENE,
    STILL,
    Axes,
    ChannelReader,
    angles,
    encoding_of,
    product,
    rotated,
)

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.mcap import Messages, Recording
    from sgstore.model.world import TraceReport
    from sgstore.readers._blocks import Called
    from sgstore.readers.foxglove._messages import Box, Deletion, Pose, SceneUpdate, Transform


MAX_STANDING: Final = 100_000
"""Maximum number of entities that stay valid between messages."""
REMEMBERED: Final = 10_000_000_000
"""Time for which transforms are stored; ns."""
NO_EGO: Final = "no entity is the ego: none is named, and the mapping names none that is there"

"""Maximum number of entities that the error for a missing ego lists."""
EGO_NAMES: Final = frozenset({"ego", "hero", "host", "ego_vehicle", "ego-vehicle", "vehicle.ego"})
"""Ids and types of the ego in lower case, if no mapping is used."""
EGO_AXES: Final = ("base_link", "ego_vehicle", "ego", "hero")
"""Names of the ego's coordinate axes, if no mapping is used."""

_HEADING, _VELOCITY, _ACCELERATION, _SIZE = 3, 6, 9, 13


class FoxgloveSurvey(Survey[Lead]):
    """First reading of a Foxglove recording. It collects information that the frames need.

    The weight of a frame is 1 if it has boxes.

    Attributes
    ----------
    readers : dict
        Channel id → decoder, for the scenes of the mapping and the transforms.
    mapping : Mapping
    ego : tuple of str
        Id of the ego's entity, and name of its axes; empty for an unused one.
    """

    def __init__(self, recording: Recording, wanted: str, mapping: Mapping) -> None:
        super().__init__(recording, wanted)
        self.readers: dict[int, ChannelReader] = {}
        self.mapping = mapping
        self.ego = ("", "")
        self._entities: dict[str, tuple[int, Ref]] = {}
        self._types: dict[str, str] = {}
        self._entity_axes: Counter[str] = Counter()
        self._transforms: dict[str, tuple[int, Ref]] = {}
        self._axes = Axes()

    def root(self) -> str:
        """Return the name of the coordinate axes in which the scene is fixed."""
        if self.mapping.scene.axes:
            return self.mapping.scene.axes
        most = [axes for axes, _ in self._entity_axes.most_common(1)]
        return self._axes.root() or (most or [""])[0]

    def no_frames(self) -> str:
        """Return the text that explains why a Foxglove recording has no frames."""
        named = ", ".join(self.mapping.scene.topics)
        where = f" on the topics of the mapping: {named}" if named else ""
        return f"no {SCENE} can be read{where}"

    def find_ego(self) -> str:
        """Find the scene object or coordinate axes of the ego, and return its name."""
        self.ego = self._named(self.wanted) if self.wanted else self._meant()
        return self.ego[0] or self.ego[1]

    def _named(self, wanted: str) -> tuple[str, str]:
        if wanted in self._entities:
            return wanted, ""
        if wanted in self._transforms:
            return "", wanted
        entities = ", ".join([*self._entities][:LISTED]) or "none"
        axes = ", ".join([*self._transforms][:LISTED]) or "none"
        raise TraceError(
            f"no entity and no axes are called {wanted!r}; entities: {entities}; axes: {axes}",
            path=self.recording.path,
        )

    def _meant(self) -> tuple[str, str]:
        told = self.mapping.ego
        names = {told.entity.lower()} if told.entity else EGO_NAMES
        named = [
            ident
            for ident, type_name in self._types.items()
            if ident.lower() in names or type_name.lower() in names
        ]
        if len(named) == 1 and not told.axes:
            return named[0], ""
        if told.axes:
            return "", told.axes if told.axes in self._transforms else ""
        axes = next((axes for axes in EGO_AXES if axes in self._transforms), "")
        if axes:
            self.about_ego.append(
                f"the ego is the axes {axes!r}, a box without a size; set the size in a mapping"
            )
        return "", axes

    def context(self) -> list[Ref]:
        """Return positions of messages with objects or transforms that stay valid. Later messages need them."""
        lasting = self._transforms
        if not self.mapping.scene.snapshot:
            lasting = self._entities | self._transforms
        first = min(lead.first_ns for lead in self.leads.values())
        return [*self.once(first), *(ref for count, ref in lasting.values() if count == 1)]

    def keeps(self, channel: int) -> bool:
        """Return True if messages of a channel are needed in the second reading, in which frames are made."""
        return bool(encoding_of(self.recording, channel))

    def meet(self, channel: int) -> bool:
        """Return True if the reader needs the messages of a channel. If so, prepare their decoder."""
        if channel in self.readers:
            return True
        encoding = encoding_of(self.recording, channel)
        record = self.recording.channels[channel]
        topics = self.mapping.scene.topics
        schema = self.recording.schemas.get(record.schema_id)
        if not encoding or schema is None:
            return False
        if schema.name == SCENE and topics and record.topic not in topics:
            return False
        self.readers[channel] = ChannelReader(schema, encoding)
        if schema.name == SCENE:
            self.leads[channel] = Lead(stamps=self.shared_stamps(channel, Stamps()))
        return True

    def look(self, run: Messages, row: int) -> None:
        """Collect information from a Foxglove message with scene objects or coordinate axes."""
        channel = int(run.channel[row])
        reader = self.readers[channel]
        if reader.name == SCENE:
            self.leads[channel].stamps.next()
        try:
            data = bytes(run.data(row))
            if reader.name == SCENE:
                scene = reader.scene(data)
                self.see_stamp(run, row, time_of(scene))
                self.count(run, row, bool(scene.boxes))
                for box in scene.boxes:
                    ident = self.mapping.entity.ident_of(box)
                    if not count_ref(self._entities, ident, ref_of(run, row)):
                        self._types[ident] = self.mapping.entity.type_of(box)
                        self._entity_axes[box.axes] += 1
            else:
                told = reader.transforms(data)
                for one in told:
                    if self._axes.tell(one.child, one.parent, 0, (ORIGIN, STILL)):
                        count_ref(self._transforms, one.child, ref_of(run, row))
        except ERRORS:  # Counted as a loss during the reading of the frames.
            return


def time_of(scene: SceneUpdate) -> int | None:
    """Return the time of a scene message: that of its newest object. ``None`` if no object has a time."""
    times = [box.time_ns for box in scene.boxes if box.time_ns is not None]
    return max((one for one in times if abs(one) < LATEST_NS), default=max(times, default=None))


@dataclass(slots=True)
class FoxgloveRawFrame:
    """Frame of a Foxglove recording before conversion. Its poses have their original coordinate axes.

    ``boxes``: each with its node id and the log time of its message. ``kinds``: as in
    :class:`~sgstore.readers._blocks.FrameRows`.
    """

    time_ns: int
    log_time_ns: int
    boxes: list[tuple[int, Box]] = field(default_factory=list)  # pyright: ignore[reportUnknownVariableType]
    kinds: dict[int, Called] = field(default_factory=dict[int, "Called"])


class FoxgloveDecoder(SurveyedDecoder[FoxgloveRawFrame, FoxgloveSurvey]):
    """Decoder of Foxglove messages into frames.

    Parameters
    ----------
    survey : FoxgloveSurvey
    report : TraceReport
    """

    def __init__(self, survey: FoxgloveSurvey, report: TraceReport) -> None:
        super().__init__(survey, report)
        self._readers = survey.readers
        self.channels = frozenset(survey.readers)
        self._sources = {channel: survey.alike(channel)[0] for channel in survey.leads}
        self._mapping, self._root = survey.mapping, survey.root()
        self._ego_entity, self._ego_axes = survey.ego
        self._states = {normalize_name(name): code for name, code in LIGHT_STATE_CODE.items()}
        self._axes = Axes()
        self._nodes: dict[tuple[int, str], int] = {}
        self._idents: list[str] = []
        self._kinds: dict[int, Called] = {}
        self._ego = -1
        self._standing: dict[int, dict[str, tuple[int, Box]]] = {}
        self._open: FoxgloveRawFrame | None = None
        self._told_by = -1
        self._left_out = LossTally()
        self._bodiless = self._odd_axes = 0

    def decode(self, run: Messages, row: int) -> FoxgloveRawFrame | None:
        """Return the frame that a Foxglove message starts, before conversion; ``None`` for other messages."""
        channel, log_time = int(run.channel[row]), int(run.log_time_ns[row])
        reader = self._readers[channel]
        if channel in self._leading:
            self._stamps.next()
        try:
            data = bytes(run.data(row))
            if reader.name != SCENE:
                self._take_transforms(reader.transforms(data), log_time)
                return None
            scene = reader.scene(data)
        except ERRORS as error:
            what = f"a message of schema {reader.name} cannot be read"
            self.lose(f"{what}: {type(error).__name__}: {error}", run, row)
            return None
        time_ns = self._time(channel, scene, log_time)
        if time_ns is None:
            self.lose(NO_TIME, run, row)
            return None
        last, before = self._open, self._told_by
        leads = channel in self._leading
        # The message belongs to the same instant.
        same = last is not None and last.log_time_ns == log_time
        goes_on = same and leads and before not in {-1, channel}
        self._take_scene(self._sources[channel], scene, time_ns, log_time, goes_on=goes_on)
        if leads:
            self._told_by = channel
        if last is not None and same and (goes_on or not leads):
            self._fill(last)
            return None
        if not leads or not self.is_inside(log_time):
            return None
        frame = self._open = FoxgloveRawFrame(time_ns, log_time)
        self._fill(frame)
        if self._ego < 0 and self._ego_axes and self._pose_of_ego(time_ns) is not None:
            meaning = self._mapping.meaning(self._mapping.ego.type)
            self._idents.append(self._ego_axes)
            self._ego = self.roster.enter(self._ego_axes, meaning, self._mapping.ego.type)
        return frame

    def _fill(self, frame: FoxgloveRawFrame) -> None:
        """Add all current objects of the scene to a frame."""
        time_ns, frame.boxes = frame.time_ns, []
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
        if self._kinds:
            here = {node for node, _ in frame.boxes}
            frame.kinds = {node: told for node, told in self._kinds.items() if node in here}

    def complete(self, frames: list[FoxgloveRawFrame]) -> list[FrameRows]:
        """Convert Foxglove frames: compute the poses of boxes in fixed map axes."""
        done = [self._rows(frame) for frame in frames]
        if frames:
            self._axes.forget(frames[-1].time_ns - REMEMBERED)
        return done

    def settle(self) -> None:
        """Add the lost messages to the report, after all frames are read."""
        super().settle()
        self._report.losses += self._left_out.losses()
        warn = self._report.warnings.append
        if self._bodiless:
            warn(f"{self._bodiless} entities left out: they have only lines, texts or arrows")
        if self._odd_axes:
            warn(
                f"{self._odd_axes} transforms left out: they contradict others or have no usable pose"
            )
        if self._ego < 0:
            self._warn_of_egos(NO_EGO)

    def _take_transforms(self, told: list[Transform], log_time: int) -> None:
        for one in told:
            time_ns = self._stamps.beside(log_time, one.time_ns)
            if one.pose is None or not self._axes.tell(one.child, one.parent, time_ns, one.pose):
                self._odd_axes += 1

    def _time(self, channel: int, scene: SceneUpdate, log_time: int) -> int | None:
        if channel not in self._leading or not self.is_inside(log_time):
            return self._stamps.beside(log_time, time_of(scene))
        return self._stamps.time(log_time, time_of(scene))

    def _take_scene(
        self, channel: int, scene: SceneUpdate, time_ns: int, log_time: int, *, goes_on: bool
    ) -> None:
        """Add, change and delete scene objects as a scene message requests.

        With ``goes_on``, the message adds to a message of another channel.
        """
        standing = self._standing.setdefault(channel, {})
        if self._mapping.scene.snapshot and not goes_on:
            standing.clear()
        for gone in scene.deletions:
            self._delete(standing, gone, log_time)
        self._bodiless += scene.bodiless
        seen: set[str] = set()
        for box in scene.boxes:
            ident = self._mapping.entity.ident_of(box)
            if ident in seen:
                self._left_out.add(f"entity {ident} comes more than once in a message", log_time)
                continue
            seen.add(ident)
            if len(standing) >= MAX_STANDING and ident not in standing:
                self._left_out.add(f"more than {MAX_STANDING} entities at once", log_time)
                continue
            node = self._nodes.get((channel, ident))
            if node is None:
                self._nodes[channel, ident] = self._enter(ident, box)
            else:
                self._see_kind(node, box)
            told = time_ns if box.time_ns is None else self._stamps.beside(log_time, box.time_ns)
            if box.time_ns not in {None, told}:  # The time is from another clock.
                box = replace(box, time_ns=told)  # noqa: PLW2901
            standing[ident] = (told, box)

    def _delete(self, standing: dict[str, tuple[int, Box]], gone: Deletion, log_time: int) -> None:
        """Delete the scene objects that a deletion names: one or all, if older than its time."""
        before = None if gone.time_ns is None else self._stamps.beside(log_time, gone.time_ns)
        for ident in [*standing] if gone.id is None else [gone.id]:
            if ident in standing and (before is None or standing[ident][0] < before):
                del standing[ident]

    def _see_kind(self, node: int, box: Box) -> None:
        """If the kind of a scene object differs from its first kind, record its present type."""
        first, type_name = self.roster.entered(node), self._mapping.entity.type_of(box)
        self._kinds.pop(node, None)
        if type_name != first.type_name:
            meaning = self._mapping.meaning(type_name)
            if meaning.kind != KINDS[first.kind]:
                self._kinds[node] = meaning, type_name

    def _enter(self, ident: str, box: Box) -> int:
        type_name = self._mapping.entity.type_of(box)
        meaning = self._mapping.meaning(type_name)
        if meaning.kind == "vehicle" and type_name.lower() not in self._mapping.types:
            self.roster.count_unknown(type_name)
        node = self.roster.enter(ident, meaning, type_name)
        self._idents.append(ident)
        if self._ego < 0 and self._ego_entity and ident == self._ego_entity:
            self._ego = node
        return node

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
                self._left_out.add(words, frame.log_time_ns)
                continue
            nodes.append(node)
            rows.append(values)
            state = normalize_name(self._mapping.entity.shown(box))
            states.append(
                self._states.get(state, 0) if self._mapping.entity.light_state and state else -1
            )
        if self._ego >= 0 and self._ego_axes:
            pose = self._pose_of_ego(frame.time_ns)
            if pose is not None:
                nodes.append(self._ego)
                ego = self._mapping.ego
                rows.append(_row(pose, (ego.length, ego.width, ego.height)))
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
            kinds=frame.kinds,
        )

    def _values(self, box: Box, time_ns: int) -> list[float] | None:
        """Return the pose columns of a scene object; ``None`` if its pose in fixed map axes is unknown."""
        at = time_ns if box.locked or box.time_ns is None else box.time_ns
        outer = self._axes.pose(box.axes or self._root, self._root, at)
        if box.pose is None or outer is None:
            return None
        place = outer[0] + rotated(outer[1], box.pose[0])
        if not (np.abs(place) < FAR).all():
            return None
        row = _row((place, product(outer[1], box.pose[1])), box.size)
        entity, number = self._mapping.entity, self._mapping.entity.number_of
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


class FoxgloveTrace(SurveyedTrace[FoxgloveSurvey]):
    """Open recording of Foxglove scenes, which yields frames.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id of an entity, or name of the axes that move with the ego; empty: the ego of the mapping.
    digest : str
        SHA-256 of the file if known; empty: the file is hashed.
    mapping : str or Path
        Name of an included mapping or path of a TOML file; empty: the included mapping that fits.

    Attributes
    ----------
    info : TraceInfo
    report : TraceReport
        Filled during the reading of blocks.

    Raises
    ------
    TraceError
        A schema or the mapping is malformed, no scene can be read, or the given ego does not exist.
    """

    name: ClassVar[str] = "foxglove"

    def __init__(
        self,
        recording: Recording,
        *,
        ego: str = "",
        digest: str = "",
        mapping: str | Path = "",
    ) -> None:
        topics = [record.topic for record in recording.channels.values()]
        found = mapping_for(mapping, topics)
        known_by = sha256(repr(found).encode("utf-8", "replace")).hexdigest()
        super().__init__(lambda: FoxgloveSurvey(recording, ego, found), digest, mapping=known_by)

    @staticmethod
    def has_frames(recording: Recording, channel: int) -> bool:
        """Return True if a channel contains Foxglove scenes."""
        schema = recording.schemas.get(recording.channels[channel].schema_id)
        is_scene = schema is not None and schema.name == SCENE
        return is_scene and bool(encoding_of(recording, channel))

    def _decoder(self, report: TraceReport) -> FoxgloveDecoder:
        return FoxgloveDecoder(self._survey, report)
