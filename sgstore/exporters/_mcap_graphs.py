"""Channels that an MCAP export adds to clips: scene graphs, frame labels, transforms; and a viewer layout.

Channels, each with one message a frame, at the frame's log time:

* ``/sgstore/graph``: the scene graph as JSON (:data:`GRAPH_SCHEMA`), with the labels;
* ``/sgstore/scene``: the scene graph for viewers, ``foxglove.SceneUpdate`` in protobuf;
* ``/sgstore/tf``: poses of the ego and its sensors, ``foxglove.FrameTransforms`` in protobuf;
* ``/sgstore/labels``: only the labels, as JSON, in clips without graphs.

The metadata of these channels has ``sgstore: derived``: they are not part of the recording.
"""

from __future__ import annotations

import json
from importlib import resources
from typing import TYPE_CHECKING, Any, Final

from mcap.records import Channel, Schema

import sgstore.exporters._foxglove as foxglove_scene
from sgstore.base.json_text import json_text
from sgstore.errors import ExportError
from sgstore.exporters._clip_frames import FEW, ClipFrames
from sgstore.exporters._nx import graphs_of
from sgstore.exporters._transforms import FrameTransforms
from sgstore.readers import DERIVED

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from sgstore.exporters._clip_frames import Export
    from sgstore.model.graph import SceneGraph


GRAPH: Final = "/sgstore/graph"
SCENE: Final = "/sgstore/scene"
TRANSFORMS: Final = "/sgstore/tf"
LABELS: Final = "/sgstore/labels"

_SCHEMAS: Final[dict[str, Any]] = json.loads(
    resources.files("sgstore.exporters").joinpath("graph_schemas.json").read_text(encoding="utf-8")
)
"""JSON schemas of the added messages ``graph`` and ``labels``."""

ClipMessage = tuple[int, int, int, int, bytes | memoryview]
"""Message of a clip: channel, sequence number, log time and publish time (ns), data."""


def is_added(channel: Channel) -> bool:
    """True if an earlier export has added a channel to the recording."""
    return all(channel.metadata.get(key) == value for key, value in DERIVED.items())


class Added:
    """Channels with scene graphs and labels that an export adds to MCAP clips.

    Parameters
    ----------
    export : Export
    """

    def __init__(self, export: Export) -> None:
        self._export = export
        schema = ("jsonschema", _as_json(_SCHEMAS["labels"]), "json")
        self._kinds = [(LABELS, "sgstore.Labels", *schema)]
        if export.with_graph:
            scene, tree = (
                foxglove_scene.schema(name)
                for name in (foxglove_scene.SCENE, foxglove_scene.TRANSFORMS)
            )
            self._kinds = [
                (GRAPH, "sgstore.SceneGraph", "jsonschema", _as_json(_SCHEMAS["graph"]), "json"),
                (SCENE, "foxglove.SceneUpdate", "protobuf", scene, "protobuf"),
                (TRANSFORMS, "foxglove.FrameTransforms", "protobuf", tree, "protobuf"),
            ]
        self.transforms = FrameTransforms((), export.mounts)
        self._first = 0  # number of the first added channel in the current clip

    def definitions(
        self, schemas: Mapping[int, Schema], channels: Mapping[int, Channel]
    ) -> Iterator[Schema | Channel]:
        """Yield the schemas and channels to add to a clip, with numbers that the recording does not use.

        Raises
        ------
        ExportError
            The recording uses all possible numbers.
        """
        schema, channel = max(schemas, default=0), max(channels, default=0)
        if max(schema, channel) + len(self._kinds) >= 1 << 16:
            raise ExportError("the recording leaves no numbers for channels of scene graphs")
        self._first = channel + 1
        own = {channels[number].schema_id for number in channels if not is_added(channels[number])}
        names = {schemas[number].name for number in own & schemas.keys()}
        self.transforms = FrameTransforms(names, self._export.mounts)
        for i, (topic, name, form, data, encoding) in enumerate(self._kinds, 1):
            yield Schema(schema + i, data, form, name)
            yield Channel(channel + i, topic, encoding, dict(DERIVED), schema + i)

    def channels(self) -> list[tuple[int, str, str]]:
        """Return the number, topic and schema name of each added channel."""
        return [(i, topic, name) for i, (topic, name, *_) in enumerate(self._kinds, self._first)]

    def messages(self, number: int) -> Iterator[ClipMessage]:
        """Yield the messages to add for the frames of a clip, in order of log time."""
        frames = ClipFrames.of(self._export, number, self._export.clips[number - 1])
        order = frames.log_time_ns.argsort(kind="stable")
        sequence = 0
        for start in range(0, len(frames), FEW):
            # Graphs are read by ranges of frames: frames of a window are close together.
            rows = order[start : start + FEW]
            rows.sort()
            window = frames.take(rows)
            found = list(self._of_window(window))
            for at in window.log_time_ns.argsort(kind="stable").tolist():
                time = int(window.log_time_ns[at])
                for channel, data in enumerate(found[at], self._first):
                    yield channel, sequence, time, time, data
                sequence += 1

    def _of_window(self, frames: ClipFrames) -> Iterator[tuple[bytes, ...]]:
        columns = self._export.label_columns(frames.frame_id)
        labels = [
            {name: values[row] for name, values in columns.items()} for row in range(len(frames))
        ]
        heads = [_head(frames, row) | {"labels": of} for row, of in enumerate(labels)]
        if not self._export.with_graph:
            yield from ((_as_json(head),) for head in heads)
            return
        for row, graph in enumerate(graphs_of(self._export, frames)):
            told, time = _as_json(heads[row] | _graph(graph)), int(frames.log_time_ns[row])
            where = foxglove_scene.transforms(self.transforms.of(graph), time)
            yield told, foxglove_scene.message(graph, time), where


def _head(frames: ClipFrames, row: int) -> dict[str, Any]:
    seconds, rest = divmod(int(frames.log_time_ns[row]), 1_000_000_000)
    return {
        "timestamp": {"sec": seconds, "nsec": rest},
        "trace": frames.clip.trace,
        "frame_id": str(int(frames.frame_id[row])),
        "seq": int(frames.seq[row]),
        "time_ns": str(int(frames.time_ns[row])),
    }


def _graph(graph: SceneGraph) -> dict[str, Any]:
    return {
        "ego": graph.ego,
        "nodes": [{"id": node} | about for node, about in graph.nodes.items()],
        "edges": [
            {"src": src, "dst": dst} | about
            for src, dst, about in graph.to_networkx().edges(data=True)
        ],
    }


def _as_json(value: Any) -> bytes:
    return json_text(value).encode("utf-8", "backslashreplace")
