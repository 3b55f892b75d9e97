"""Recordings of Foxglove scenes: ``foxglove.SceneUpdate`` and ``FrameTransform``, protobuf or JSON, in MCAP.

They are recognised by the schemas of their channels. A scene is made to be drawn, so what its boxes are, how
fast they move and which is the ego, a mapping says (:mod:`sgstore.readers.foxglove._mapping`). A frame is one
message of the leading scene, the one with most messages that hold boxes, in file order.

Source: foxglove-sdk, schemas.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from hashlib import sha256
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.mcap import read_and_digest
from sgstore.readers._base import Opened, Ref, channels_of, ref_of, refs_of
from sgstore.readers.foxglove._frames import EntityNames, FoxgloveDecoder
from sgstore.readers.foxglove._mapping import Mapping, mapping_for
from sgstore.readers.foxglove._messages import (
    ERRORS,
    ORIGIN,
    SCENE,
    STILL,
    Axes,
    ChannelReader,
    encoding_of,
)
from sgstore.world import TraceInfo, TraceReport

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.mcap import Messages, Recording
    from sgstore.world import FrameBlock


BEGINNING: Final = 1_000_000_000
"""How long after the first frame a message still comes with it; ns of log time."""
LISTED: Final = 20
"""Entities that an error lists by name."""
EGO_NAMES: Final = frozenset({"ego", "hero", "host", "ego_vehicle", "ego-vehicle", "vehicle.ego"})
"""Ids and types that mean the ego where no mapping says who it is, in lower case."""
EGO_AXES: Final = ("base_link", "ego_vehicle", "ego", "hero")
"""Axes that move with the ego where no mapping says which do."""


class FoxgloveTrace(Opened):
    """A recording of Foxglove scenes.

    Parameters
    ----------
    recording : Recording
    ego : str
        Id of an entity, or name of the axes that move with the ego; empty: as the mapping says.
    digest : str
        SHA-256 of the file, if it is known; else the file is hashed.
    mapping : str or Path
        Name of a mapping that is shipped or path of a TOML file; empty: the shipped one that fits.

    Attributes
    ----------
    info : TraceInfo
    report : TraceReport
        Filled while blocks are read.

    Raises
    ------
    TraceError
        A schema or the mapping is malformed, there is no scene that can be read, or nothing bears the name
        given for the ego.
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
        self._recording = recording
        topics = [record.topic for record in recording.channels.values()]
        self._mapping = mapping_for(mapping, topics)
        self._survey, digest = read_and_digest(
            recording.path, digest, lambda: _Survey(recording, self._mapping)
        )
        self._leading = self._survey.leading()
        self._root = self._survey.root()
        self._notes: list[str] = []
        self._ego = self._survey.ego(ego, self._notes)
        self.report = TraceReport()
        channels = channels_of(recording, self._role)
        self.info = TraceInfo(
            path=recording.path,
            size=recording.size,
            mtime_ns=recording.mtime_ns,
            digest=digest,
            flavour=self.name,
            channels=channels,
            ego=self._ego[0] or self._ego[1],
            map_text="",
            map_name="",
            context=refs_of(self._survey.context(), channels),
            mapping=sha256(repr(self._mapping).encode("utf-8", "replace")).hexdigest(),
        )

    @classmethod
    def recognises(cls, recording: Recording) -> bool:
        """Return whether one of the channels carries Foxglove scenes."""
        for number, record in recording.channels.items():
            schema = recording.schemas.get(record.schema_id)
            if schema is not None and schema.name == SCENE and encoding_of(recording, number):
                return True
        return False

    def blocks(self, size: int = 60) -> Iterator[FrameBlock]:
        """The frames of the trace, ``size`` at a time; block i begins at frame ``i * size``.

        Raises
        ------
        TraceError
            The file cannot be read any more, or has no frame.
        """
        report = self.report = TraceReport()
        report.warnings += self._notes
        report.about_ego += self._notes
        decoder = FoxgloveDecoder(
            self._survey.readers,
            self._leading,
            self._mapping,
            self._root,
            self._ego,
            self._recording.window,
            report,
        )
        topic = self._recording.channels[self._leading].topic
        yield from self._told(decoder, size, report, topic)

    def _role(self, channel: int) -> str:
        return "ground_truth" if channel == self._leading else "payload"


@dataclass(slots=True)
class _LossNote:
    """Number of times that a loss was told, and the first message that it concerns."""

    first: Ref
    count: int = 0


@dataclass(slots=True)
class _SceneChannel:
    """A channel of scenes: its messages with boxes, all its messages, log time of its first."""

    boxed: int = 0
    messages: int = 0
    first_ns: int = (1 << 63) - 1


class _Survey:
    """The first reading of a recording: what must be known before its frames can be read.

    Attributes
    ----------
    readers : dict
        Channel id → reader, of the scenes that the mapping names and of the transforms.
    """

    def __init__(self, recording: Recording, mapping: Mapping) -> None:
        self.readers: dict[int, ChannelReader] = {}
        self._recording = recording
        self._mapping = mapping
        self._names = EntityNames(mapping.entity)
        self._others: dict[int, _LossNote] = {}
        self._scenes: dict[int, _SceneChannel] = {}
        self._entities: dict[str, _LossNote] = {}
        self._types: dict[str, str] = {}
        self._entity_axes: Counter[str] = Counter()
        self._transforms: dict[str, _LossNote] = {}
        self._axes = Axes()
        for run in recording.walk(TraceReport(), keep=self.readers.__contains__):
            self._look(run)

    def leading(self) -> int:
        """The scene with most messages that hold boxes.

        Raises
        ------
        TraceError
            No message of a scene can be read.
        """
        ranked = [
            (scene.boxed, scene.messages, -channel)
            for channel, scene in self._scenes.items()
            if scene.messages
        ]
        if not ranked:
            named = ", ".join(self._mapping.scene.topics)
            where = f" on the topics of the mapping: {named}" if named else ""
            raise TraceError(f"no {SCENE} can be read{where}", path=self._recording.path)
        return -max(ranked)[2]

    def root(self) -> str:
        """The axes that stand still."""
        if self._mapping.scene.axes:
            return self._mapping.scene.axes
        most = [axes for axes, _ in self._entity_axes.most_common(1)]
        return self._axes.root() or (most or [""])[0]

    def ego(self, wanted: str, notes: list[str]) -> tuple[str, str]:
        """Id of the entity, and name of the axes, that are the ego; empty where they are not.

        Raises
        ------
        TraceError
            Nothing bears the name that the user gave.
        """
        told = self._mapping.ego
        if wanted:
            if wanted in self._entities:
                return wanted, ""
            if wanted in self._transforms:
                return "", wanted
            entities = ", ".join([*self._entities][:LISTED]) or "none"
            axes = ", ".join([*self._transforms][:LISTED]) or "none"
            raise TraceError(
                f"no entity and no axes are called {wanted!r}; entities: {entities}; axes: {axes}",
                path=self._recording.path,
            )
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
            notes.append(
                f"the ego is the axes {axes!r}, a box without a size: a mapping can tell one"
            )
        return "", axes

    def context(self) -> list[Ref]:
        """Messages that later ones depend on: what comes once, with the first frame or to stay."""
        first = min((scene.first_ns for scene in self._scenes.values()), default=0)
        once = [
            told.first
            for told in self._others.values()
            if told.count == 1 and told.first[1] <= first + BEGINNING
        ]
        lasting = (
            self._transforms if self._mapping.scene.snapshot else self._entities | self._transforms
        )
        return once + [told.first for told in lasting.values() if told.count == 1]

    def _look(self, run: Messages) -> None:
        rows = np.unique(run.channel, return_index=True, return_counts=True)
        for channel, row, count in zip(*(column.tolist() for column in rows), strict=True):
            if not self._meet(channel):
                told = self._others.setdefault(channel, _LossNote(ref_of(run, row)))
                told.count += count
        for row in np.flatnonzero(np.isin(run.channel, [*self.readers])).tolist():
            reader = self.readers[int(run.channel[row])]
            try:
                data = bytes(run.data(row))
                if reader.name == SCENE:
                    self._look_at_scene(reader, run, row, data)
                else:
                    self._look_at_transforms(reader, run, row, data)
            except ERRORS:  # counted as a loss when the frames are read
                continue

    def _meet(self, channel: int) -> bool:
        """Return whether the messages of a channel are read; make ready for one that is met first."""
        if channel in self.readers:
            return True
        encoding = encoding_of(self._recording, channel)
        record = self._recording.channels[channel]
        topics = self._mapping.scene.topics
        schema = self._recording.schemas.get(record.schema_id)
        if not encoding or schema is None:
            return False
        if schema.name == SCENE and topics and record.topic not in topics:
            return False
        self.readers[channel] = ChannelReader(schema, encoding)
        if schema.name == SCENE:
            self._scenes[channel] = _SceneChannel()
        return True

    def _look_at_scene(self, reader: ChannelReader, run: Messages, row: int, data: bytes) -> None:
        scene = reader.scene(data)
        start, end = self._recording.window
        log_time = int(run.log_time_ns[row])
        found = self._scenes[int(run.channel[row])]
        if start <= log_time <= end:
            found.messages += 1
            found.boxed += bool(scene.boxes)
            found.first_ns = min(found.first_ns, log_time)
        for box in scene.boxes:
            ident = self._names.ident(box)
            told = self._entities.setdefault(ident, _LossNote(ref_of(run, row)))
            told.count += 1
            if told.count == 1:
                self._types[ident] = self._names.type_name(box)
                self._entity_axes[box.axes] += 1

    def _look_at_transforms(
        self, reader: ChannelReader, run: Messages, row: int, data: bytes
    ) -> None:
        for one in reader.transforms(data):
            if self._axes.tell(one.child, one.parent, 0, (ORIGIN, STILL)):
                told = self._transforms.setdefault(one.child, _LossNote(ref_of(run, row)))
                told.count += 1
