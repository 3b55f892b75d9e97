"""Export format OpenSCENARIO XML 1.2: each clip as a scenario for simulators, with the road map.

Each clip has a file ``CLIP.xosc``; its map, if the trace has one, is ``MAP.xodr`` in the same
folder.

* Every entity follows its recorded track: a trajectory of vertices with times, which a simulator
  joins by straight lines. Time 0 is the first frame of the clip. Entities are added and deleted
  when they appear and disappear.
* Static entities are placed once. Signs and lights are parts of the map; light states refer to ids
  of the map.
* The origin of a vehicle is below the middle of its rear axle, on the ground, as in the standard.
  Recordings do not contain the axle: the export assumes 0.3 of the length behind the middle.

Source: ASAM OpenSCENARIO XML 1.2.0, its model of classes and its schema.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.exporters._clips import WrittenFile, clip_name, safe_name, tool
from sgstore.exporters._xosc_elements import (
    CATEGORIES,
    ScenarioEntity,
    XmlWriter,
    event,
    group,
    test,
    write_entity,
    write_position,
    write_signal,
    write_speed,
    write_trajectory,
    write_when,
)
from sgstore.maps.roads import is_lane_text
from sgstore.mcap import Loss

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.exporters._clip_frames import ClipFrames, Export

    Numbers = NDArray[np.float64]
_SIZES: Final = {
    "truck": (8.0, 2.5, 3.2),
    "bus": (12.0, 2.55, 3.2),
    "van": (5.9, 2.0, 2.4),
    "train": (25.0, 2.9, 3.8),
    "trailer": (8.0, 2.5, 3.0),
    "motorcycle": (2.2, 0.8, 1.5),
    "bicycle": (1.8, 0.6, 1.7),
    "person": (0.6, 0.6, 1.75),
}
_SIZE: Final = (4.5, 1.8, 1.5)
"""Default length, width and height of an entity; m."""
TOLERANCE: Final = 0.001
"""Tolerance for positions when a written file is verified; m."""

_ENTITIES: Final = """
SELECT n.node_id, any_value(n.kind)::VARCHAR AS kind, bool_or(n.is_ego) AS is_ego,
       bool_and(n.is_static) AS still,
       max(n.length)::DOUBLE AS length, max(n.width)::DOUBLE AS width, max(n.height)::DOUBLE AS height,
       max(e.ident) AS ident, max(e.type_name) AS type_name, max(e.map_ref) AS map_ref
FROM nodes n JOIN entities e ON e.trace_id = n.frame_id >> 24 AND e.node_id = n.node_id
WHERE n.frame_id >= $first AND n.frame_id <= $last AND n.node_id >= 0
GROUP BY n.node_id ORDER BY n.node_id
"""
_TRACK: Final = """
SELECT frame_id, x::DOUBLE AS x, y::DOUBLE AS y, z::DOUBLE AS z, radians(heading)::DOUBLE AS heading,
       radians(pitch)::DOUBLE AS pitch, radians(roll)::DOUBLE AS roll, speed::DOUBLE AS speed
FROM nodes WHERE frame_id >= $first AND frame_id <= $last AND node_id = $node ORDER BY frame_id
"""
_LIGHT: Final = """
SELECT frame_id, light_state::VARCHAR AS state FROM nodes
WHERE frame_id >= $first AND frame_id <= $last AND node_id = $node AND light_state IS NOT NULL ORDER BY frame_id
"""


@dataclass(slots=True)
class EntityTrack:
    """Columns (n,) with the states of an entity, one row for each frame of a clip in which it occurs.

    Attributes
    ----------
    row : int64
        Frame of each state, as a row of the clip.
    pose : (n, 6) float64
        x, y, z, heading, pitch, roll of the origin, headings without jumps; m, rad. NaN means
        unknown.
    speed : float64
        m/s.
    """

    row: NDArray[np.int64]
    pose: Numbers
    speed: Numbers

    def stretches(self) -> Iterator[tuple[int, int]]:
        """Yield the first and last index of each sequence of frames without gaps."""
        ends = np.flatnonzero(np.diff(self.row) > 1).tolist()
        yield from zip([0, *(end + 1 for end in ends)], [*ends, len(self.row) - 1], strict=True)


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write an OpenSCENARIO file for each clip, and the road maps that the files use."""
    maps: dict[str, Path | None] = {}
    written: list[WrittenFile] = []
    for frames in export.frames():
        trace = frames.clip.trace
        if trace not in maps:
            maps[trace] = _write_map(export, folder, trace)
        road_map = maps[trace]
        file = folder / clip_name(trace, frames.own, ".xosc")
        scenario = Scenario(export, frames, "" if road_map is None else road_map.name)
        scenario.write(file)
        test(file, scenario.vertices)
        written.append(WrittenFile.of(file, "entities", len(scenario.actors), scenario.losses()))
        export.tell(frames.number, len(export.clips))
    found = sorted({one for one in maps.values() if one is not None})
    return written + [WrittenFile.of(road_map, "maps", 1) for road_map in found]


def _write_map(export: Export, folder: Path, trace: str) -> Path | None:
    """Write the road map of a trace to a file, and return its path.

    Equal maps share a file. ``None`` means a trace without a map.
    """
    told = export.store.file.road_map_text(trace)
    if told is None:
        return None
    name, text = told
    if is_lane_text(text):  # plain lanes are not OpenDRIVE
        return None
    stem = safe_name(name.removesuffix(".xodr").rpartition("/")[2], "map")
    data = text.encode("utf-8")
    for number in range(1, len(export.clips) + 2):
        file = folder / (f"{stem}.xodr" if number == 1 else f"{stem}_{number}.xodr")
        if not file.exists():
            file.write_bytes(data)
            return file
        if file.read_bytes() == data:
            return file
    raise AssertionError("more maps than clips")


class Scenario:
    """Writer of one clip as an OpenSCENARIO file.

    Parameters
    ----------
    export : Export
    frames : ClipFrames
    map_file : str
        Name of the map in the folder, or empty.
    """

    def __init__(self, export: Export, frames: ClipFrames, map_file: str) -> None:
        self._store, self._frames, self._map = export.store.file, frames, map_file
        self._told = dict(export.provenance)
        self._seconds = (frames.time_ns - frames.time_ns[0]) / 1e9
        self.vertices = 0
        self.actors: list[ScenarioEntity] = []
        self._lights: list[tuple[int, str]] = []
        self._unsized: list[str] = []
        self._unmapped: list[str] = []
        self._take_entities()

    def _take_entities(self) -> None:
        for node, kind, is_ego, still, *size, ident, type_name, ref in self._store.rows(
            _ENTITIES, self._frames.bounds
        ):
            name = "Ego" if is_ego else f"{kind}_{node}"
            if kind == "traffic_light":
                if ref:
                    self._lights.append((node, ref))
                else:
                    self._unmapped.append(name)
            elif kind in CATEGORIES:
                if None in size:
                    self._unsized.append(name)
                length, width, height = (
                    usual if own is None else own
                    for own, usual in zip(size, _SIZES.get(kind, _SIZE), strict=True)
                )
                told = {"ident": ident, "type_name": type_name, "kind": kind}
                about = {key: str(value) for key, value in told.items() if value}
                self.actors.append(
                    ScenarioEntity(node, name, kind, still, (length, width, height), about)
                )

    def losses(self) -> list[Loss]:
        """Return the data that the scenario lacks or that are only assumed, each with a reason."""
        told: list[Loss] = []
        if self._unsized:
            reason = f"the size of {_some(self._unsized)} is not known: a usual one is written"
            told.append(Loss(reason, 0, 0))
        if self._unmapped:
            reason = f"{_some(self._unmapped)}: not a signal of the map; its state is left out"
            told.append(Loss(reason, 0, 0))
        if not self._map:
            told.append(Loss("the trace has no OpenDRIVE map; the scenario has none", 0, 0))
        return told

    def write(self, file: Path) -> None:
        """Write the clip to an OpenSCENARIO file."""
        with file.open("x", encoding="utf-8", newline="\n") as stream:
            xml = XmlWriter(stream)
            with xml.element("OpenSCENARIO"):
                self._write_head(xml)
                with xml.element("Entities"):
                    for actor in self.actors:
                        write_entity(xml, actor)
                with xml.element("Storyboard"):
                    with xml.element("Init"), xml.element("Actions"):
                        self._write_init(xml)
                    with xml.element("Story", name="recorded"):
                        self._write_acts(xml)
                    with xml.element("StopTrigger"):
                        write_when(xml, float(self._seconds[-1]), "end")
            xml.finish()

    def _write_head(self, xml: XmlWriter) -> None:
        start = datetime.fromtimestamp(0, UTC) + timedelta(
            microseconds=int(self._frames.log_time_ns[0]) // 1000
        )
        clip = self._frames.clip
        query = self._told.get("query", "")
        xml.leaf(
            "FileHeader",
            revMajor="1",
            revMinor="2",
            date=start.isoformat(timespec="milliseconds").removesuffix("+00:00"),
            description=f"{clip.trace}, {clip.start_ns} to {clip.end_ns} ns: {query}".rstrip(": "),
            author=tool(),
        )
        xml.leaf("CatalogLocations")
        with xml.element("RoadNetwork"):
            if self._map:
                xml.leaf("LogicFile", filepath=self._map)

    def _write_init(self, xml: XmlWriter) -> None:
        changes = [(ref, next(self._light(node), None)) for node, ref in self._lights]
        for ref, change in changes:
            if change is not None and change[0] == 0:
                with xml.element("GlobalAction"):
                    write_signal(xml, ref, change[1])
        for actor in self.actors:
            track = self._track(actor, first=not actor.still)
            if not len(track.row) or (not actor.still and track.row[0] != 0):
                continue
            with xml.element("Private", entityRef=actor.name):
                with xml.element("PrivateAction"), xml.element("TeleportAction"):
                    write_position(xml, track.pose[0])
                if not actor.still and np.isfinite(track.speed[0]):
                    with xml.element("PrivateAction"):
                        write_speed(xml, float(track.speed[0]))

    def _write_acts(self, xml: XmlWriter) -> None:
        with xml.element("Act", name="tracks"):
            moving = [actor for actor in self.actors if not actor.still]
            for actor in moving:
                self._write_group(xml, actor)
            self._write_lights(xml, alone=not moving)
            with xml.element("StartTrigger"):
                write_when(xml, 0.0, "begin")

    def _write_group(self, xml: XmlWriter, actor: ScenarioEntity) -> None:
        track = self._track(actor)
        with group(xml, actor.name, actor.name), xml.element("Maneuver", name=actor.name):
            for number, (low, high) in enumerate(track.stretches(), 1):
                self._write_stretch(xml, f"{actor.name} {number}", actor, track, (low, high))

    def _write_stretch(
        self,
        xml: XmlWriter,
        name: str,
        actor: ScenarioEntity,
        track: EntityTrack,
        ends: tuple[int, int],
    ) -> None:
        """Write scenario events of an entity: it appears, follows its trajectory, and disappears."""
        low, high = ends
        times, poses = self._seconds[track.row[low : high + 1]], track.pose[low : high + 1]
        start = float(times[0])
        if track.row[low] > 0:
            with (
                event(xml, f"{name} comes", start),
                xml.element("GlobalAction"),
                xml.element("EntityAction", entityRef=actor.name),
                xml.element("AddEntityAction"),
            ):
                write_position(xml, poses[0])
        with event(xml, f"{name} moves", start), xml.element("PrivateAction"):
            if high > low:
                write_trajectory(xml, name, times, poses)
                self.vertices += len(times)
            else:
                with xml.element("TeleportAction"):
                    write_position(xml, poses[0])
        if track.row[high] + 1 < len(self._seconds):
            leaves = float(self._seconds[track.row[high] + 1])
            with (
                event(xml, f"{name} leaves", leaves),
                xml.element("GlobalAction"),
                xml.element("EntityAction", entityRef=actor.name),
            ):
                xml.leaf("DeleteEntityAction")

    def _write_lights(self, xml: XmlWriter, *, alone: bool) -> None:
        """Write the state changes of traffic lights as scenario events.

        Without moving entities, a placeholder is added, because an act must not be empty.
        """
        for node, ref in self._lights:
            changes = [(row, state) for row, state in self._light(node) if row > 0]
            if not changes:
                continue
            alone = False
            with group(xml, f"signal {ref}"), xml.element("Maneuver", name=f"signal {ref}"):
                for number, (row, state) in enumerate(changes, 1):
                    time = float(self._seconds[row])
                    with event(xml, f"signal {ref} {number}", time), xml.element("GlobalAction"):
                        write_signal(xml, ref, state)
        if alone:
            with group(xml, "nothing moves"):
                pass

    def _track(self, actor: ScenarioEntity, *, first: bool = False) -> EntityTrack:
        """Return the states of an entity over the clip, or only in its first frame."""
        bounds = self._frames.bounds
        if first:
            bounds["last"] = bounds["first"]
        found = self._store.arrays(_TRACK, {**bounds, "node": actor.node})
        row = np.searchsorted(self._frames.frame_id, found["frame_id"].astype(np.int64))
        names = ("x", "y", "z", "heading", "pitch", "roll")
        columns = [np.ma.filled(found[name].astype(np.float64), np.nan) for name in names]
        pose = np.column_stack(columns) if len(row) else np.zeros((0, 6))
        pose[:, 3] = _unwrapped(pose[:, 3])
        speed = np.ma.filled(found["speed"].astype(np.float64), np.nan)
        return EntityTrack(row, _origins(pose, actor.centre), speed)

    def _light(self, node: int) -> Iterator[tuple[int, str]]:
        """Yield the changes of a traffic light: index of the frame, and new state."""
        before = ""
        for frame_id, state in self._store.rows(_LIGHT, {**self._frames.bounds, "node": node}):
            if state != before:
                yield int(np.searchsorted(self._frames.frame_id, frame_id)), state
                before = state


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(names[:5]) + more


def _unwrapped(heading: Numbers) -> Numbers:
    """Return the headings unwrapped: no jumps by full turns. Unknown headings remain unknown."""
    known = np.isfinite(heading)
    out = heading.copy()
    out[known] = np.unwrap(heading[known])
    return out


def _origins(pose: Numbers, centre: tuple[float, float, float]) -> Numbers:
    """Return the poses of vehicle origins, computed from the poses of box centres."""
    (ch, cp, cr), (sh, sp, sr) = (
        [of(np.nan_to_num(pose[:, axis])) for axis in (3, 4, 5)] for of in (np.cos, np.sin)
    )
    ahead, _, up = centre
    out = pose.copy()
    out[:, 0] -= ch * cp * ahead + (ch * sp * cr + sh * sr) * up
    out[:, 1] -= sh * cp * ahead + (sh * sp * cr - ch * sr) * up
    out[:, 2] -= -sp * ahead + cp * cr * up
    return out
