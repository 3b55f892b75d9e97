"""Export format of the Rerun viewer: one file per clip, with scene, graph, cameras and point clouds.

Paths in the recording:

* ``world/map/LANE_TYPE``: constant outlines of the road map;
* ``world/boxes``: entities as boxes with names, ``world/edges/RELATION``: edges between centres;
* ``world/ego``: the axes of the ego, on the ground below the middle of its box; in them
  ``world/ego/AXES`` from mounts, with the point clouds of their sensors. Clouds of sensors without
  a mount are ``sensors/TOPIC``, outside the scene;
* ``camera/TOPIC``: pictures; ``graph``: nodes and edges, placed around the ego.

The timelines are ``time``, seconds since the start of the trace, and ``frame``. Rerun files contain
their creation time, so that equal exports differ in bytes.

Source: rerun-io/rerun, its Python SDK and its types of data.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import numpy as np

import sgstore.exporters._foxglove as drawn
from sgstore.errors import ExportError, MissingExtraError
from sgstore.exporters._clip_frames import FEW
from sgstore.exporters._clips import WrittenFile, clip_name
from sgstore.exporters._nx import graphs_of
from sgstore.exporters._sensor_data import sensor_of
from sgstore.exporters._transforms import EGO, FrameTransforms
from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import DrawnOutlines
from sgstore.mcap import Loss
from sgstore.readers import record_reader

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.exporters._clip_frames import ClipFrames, Export
    from sgstore.model.graph import SceneGraph

APPLICATION: Final = "sgstore"
_MESSAGES: Final = """
SELECT any_value(p.frame_id) AS frame_id, p.channel, p.log_time_ns
FROM payloads p WHERE p.frame_id >= $first AND p.frame_id <= $last
GROUP BY p.channel, p.log_time_ns ORDER BY p.channel, p.log_time_ns
"""
_LANES: Final = (128, 128, 128)
_KINDS_OF_PICTURES: Final = frozenset({"jpeg", "png", "webp", "bmp"})


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write a Rerun file for each clip, and verify it with Rerun's own reader."""
    try:
        rerun: Any = import_module("rerun")
        reader: Any = import_module("rerun.chunk").RrdReader
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "rerun":
            raise
        raise MissingExtraError("writing recordings for Rerun", "rerun") from error
    written: list[WrittenFile] = []
    for frames in export.frames():
        file = folder / clip_name(frames.clip.trace, frames.own, ".rrd")
        clip = RerunClip(rerun, export, frames)
        clip.write(file)
        _test(file, clip.paths, reader)
        written.append(WrittenFile.of(file, "frames", len(frames), clip.losses))
        export.tell(frames.number, len(export.clips))
    return written


def _test(file: Path, paths: set[str], reader: Any) -> None:
    """Raise an error if a written Rerun file lacks one of its entity paths."""
    try:
        found = {str(chunk.entity_path) for chunk in reader(str(file)).stream().to_chunks()}
    except Exception as error:  # any error of Rerun
        raise ExportError(f"{file.name}: Rerun cannot read it back: {error}") from error
    if not paths <= {path.lstrip("/") for path in found}:
        gone = ", ".join(sorted(paths - {path.lstrip("/") for path in found})[:5])
        raise ExportError(f"{file.name}: not all is read back: {gone}")


class RerunClip:
    """Writer of one clip as a Rerun file.

    Parameters
    ----------
    rerun : module
    export : Export
    frames : ClipFrames

    Attributes
    ----------
    paths : set of str
        Written paths.
    losses : list of Loss
        Pictures, videos and clouds that are not written.
    """

    def __init__(self, rerun: Any, export: Export, frames: ClipFrames) -> None:
        self._rerun, self._export, self._frames = rerun, export, frames
        self.paths: set[str] = set()
        self.losses: list[Loss] = []
        trace = export.trace(frames.clip.trace)
        names = {one.schema for one in export.store.file.channels(trace.name)}
        self._transforms = FrameTransforms(names, export.mounts)
        self._mounts = {one.child for one in export.mounts if one.parent == EGO}

    def write(self, file: Path) -> None:
        """Write the clip to a Rerun file."""
        clip = self._frames.clip
        ident = f"{clip.trace} {clip.start_ns} {clip.end_ns}"
        self._out = self._rerun.RecordingStream(APPLICATION, recording_id=ident)
        self._out.save(str(file), default_blueprint=self._view())
        try:
            self._log("world", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            self._write_map()
            for window in self._frames.windows(FEW):
                for row, graph in enumerate(graphs_of(self._export, window)):
                    self._at(float(window.t[row]), int(window.seq[row]))
                    self._write_scene(graph)
            self._write_messages()
        finally:
            self._out.flush()
            self._out.disconnect()

    def _view(self) -> Any:
        """Return the initial layout of the Rerun viewer: the scene, the camera and the graph side by side."""
        views: Any = import_module("rerun.blueprint")
        return views.Blueprint(
            views.Horizontal(
                views.Spatial3DView(origin="world", name="scene"),
                views.Vertical(
                    views.Spatial2DView(origin="camera", name="camera"),
                    views.GraphView(origin="graph", name="graph"),
                ),
                column_shares=[2, 1],
            ),
            collapse_panels=True,
        )

    def _log(self, path: str, what: Any, *, static: bool = False) -> None:
        self._out.log(path, what, static=static)
        self.paths.add(path)

    def _at(self, time: float, frame: int | None = None) -> None:
        self._out.reset_time()
        self._out.set_time("time", duration=time)
        if frame is not None:
            self._out.set_time("frame", sequence=frame)

    def _path(self, *parts: str) -> str:
        """Return a Rerun entity path whose parts are arbitrary names."""
        return str(self._rerun.new_entity_path(list(parts))).lstrip("/")

    def _write_map(self) -> None:
        told = self._export.store.file.road_map_text(self._frames.clip.trace)
        if told is None:
            return
        name, text = told
        lines = DrawnOutlines.of(read_map(text, name))
        points = np.column_stack(
            [lines.x + lines.origin[0], lines.y + lines.origin[1], 0 * lines.x]
        )
        parts = np.split(points, lines.start[1:-1].astype(int))
        for code, word in enumerate(lines.words):
            strips = [
                part for part, of in zip(parts, lines.word.tolist(), strict=True) if of == code
            ]
            if strips:
                shown = self._rerun.LineStrips3D(strips, colors=[_LANES], radii=[0.04])
                self._log(self._path("world", "map", word), shown, static=True)

    def _write_scene(self, graph: SceneGraph) -> None:
        rerun, places = self._rerun, {n: drawn.place_of(a) for n, a in graph.nodes.items()}
        solid = [n for n, about in graph.nodes.items() if places[n] and drawn.is_solid(n, about)]
        nodes = [graph.nodes[node] for node in solid]
        boxes = rerun.Boxes3D(
            centers=[places[node] for node in solid],
            sizes=[[about[side] for side in ("length", "width", "height")] for about in nodes],
            quaternions=[rerun.Quaternion(xyzw=_turn(about)) for about in nodes],
            colors=[_rgba(drawn.colour_of(about)) for about in nodes],
            labels=[about["name"] for about in nodes],
            fill_mode="solid",
            show_labels=False,
        )
        self._log("world/boxes", boxes)
        for relation, ends in _lines(graph, places).items():
            colour = drawn.RELATION_COLOURS.get(relation, drawn.OTHER_RELATIONS)
            shown = rerun.LineStrips3D(ends, colors=[_rgba(colour)])
            self._log(self._path("world", "edges", relation), shown)
        self._clear_edges(graph)
        self._write_axes(graph)
        self._write_graph(graph, places)

    def _clear_edges(self, graph: SceneGraph) -> None:
        """Remove lines of earlier frames from the viewer, for each relation without edges in this frame."""
        now = {self._path("world", "edges", relation) for _, relation, _, _ in graph.edges}
        for path in sorted(path for path in self.paths - now if path.startswith("world/edges/")):
            self._out.log(path, self._rerun.Clear(recursive=False))

    def _write_axes(self, graph: SceneGraph) -> None:
        for one in self._transforms.of(graph):
            if one.child == self._transforms.ego:
                path = f"world/{EGO}"
            elif one.child in self._mounts:
                path = self._path("world", EGO, one.child)
            else:
                continue
            turn = self._rerun.Quaternion(xyzw=one.turn)
            self._log(path, self._rerun.Transform3D(translation=one.place, quaternion=turn))

    def _write_graph(self, graph: SceneGraph, places: dict[int, Any]) -> None:
        """Write a scene graph as a diagram. The ego is in the middle, and its front points up."""
        rerun = self._rerun
        known = [node for node in graph.nodes if places[node]]
        about = {} if graph.ego is None else graph.nodes.get(graph.ego, {})
        centre = drawn.place_of(about) or (0.0, 0.0, 0.0)
        heading = np.radians(about.get("heading", 90.0))
        x, y = (np.array([places[n][axis] - centre[axis] for n in known]) for axis in (0, 1))
        ahead = x * np.cos(heading) + y * np.sin(heading)
        left = y * np.cos(heading) - x * np.sin(heading)
        shown = rerun.GraphNodes(
            [str(node) for node in known],
            positions=np.column_stack([-left, -ahead]) * _SPREAD,
            labels=[graph.nodes[node]["name"] for node in known],
            colors=[_rgba(drawn.colour_of(graph.nodes[node])) for node in known],
        )
        there = set(known)
        pairs = dict.fromkeys(
            (str(src), str(dst)) for src, _, dst, _ in graph.edges if {src, dst} <= there
        )
        self._out.log("graph", shown, rerun.GraphEdges([*pairs], graph_type="directed"))
        self.paths.add("graph")

    def _write_messages(self) -> None:
        file, frames = self._export.store.file, self._frames
        sensors = {one.topic for one in file.channels(frames.clip.trace) if one.role == "payload"}
        odd: dict[str, int] = {}
        for frame_id, topic, log_time_ns in file.rows(_MESSAGES, frames.bounds):
            if topic not in sensors:
                continue
            row = int(np.searchsorted(frames.frame_id, frame_id))
            beside = (log_time_ns - int(frames.log_time_ns[row])) / 1e9
            self._at(float(frames.t[row]) + beside)
            if not self._write_message(frame_id, topic):
                odd[topic] = odd.get(topic, 0) + 1
        for topic, count in odd.items():
            reason = f"{topic}: {count} images or point clouds have no format for Rerun"
            self.losses.append(Loss(reason, 0, 0))

    def _write_message(self, frame_id: int, topic: str) -> bool:
        channel, schema, data = self._export.store.file.recorded(frame_id, topic)
        told = sensor_of(channel, schema)(data)
        if told is None:  # other sensors, such as odometry, are not exported
            return True
        if told.holds == "picture" and told.form in _KINDS_OF_PICTURES:
            shown = self._rerun.EncodedImage(contents=told.data, media_type=f"image/{told.form}")
            self._log(self._path("camera", topic), shown)
            return True
        names = told.data.dtype.names if told.holds == "cloud" else ()
        if not {"x", "y", "z"} <= {*(names or ())}:
            return False
        points = np.column_stack([told.data[axis].astype(np.float32) for axis in "xyz"])
        axes = _axes_of(record_reader(channel, schema)(data) or {})
        # The pose of a sensor without a mount is unknown: its points are outside the scene.
        root = ("world", EGO, axes) if axes in self._mounts else ("sensors",)
        shown = self._rerun.Points3D(points[np.isfinite(points).all(axis=1)], radii=[0.04])
        self._log(self._path(*root, topic), shown)
        return True


_SPREAD: Final = 8.0
"""Units of the graph view for each metre. They leave space for names."""


def _axes_of(record: Mapping[str, Any]) -> str:
    """Return the name of the coordinate axes that a sensor message states (``frame_id``)."""
    header = record.get("header")
    held = header if isinstance(header, Mapping) else record
    return str(held.get("frame_id", ""))


def _turn(about: dict[str, Any]) -> tuple[float, float, float, float]:
    return drawn.quaternion(*drawn.turn_of(about))


def _rgba(colour: drawn.Colour) -> list[int]:
    return [round(255 * part) for part in colour]


def _lines(graph: SceneGraph, places: dict[int, Any]) -> dict[str, list[Any]]:
    """For each relation, return its edges as lines: pairs of node positions."""
    found: dict[str, list[Any]] = {}
    for src, relation, dst, _ in graph.edges:
        if places.get(src) and places.get(dst):
            found.setdefault(relation, []).append([places[src], places[dst]])
    return found
