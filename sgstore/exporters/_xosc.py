"""Clips as scenarios in OpenSCENARIO XML 1.2 for simulators, with the road map.

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

from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, Final
from xml.etree import ElementTree as ET
from xml.sax.saxutils import XMLGenerator
from xml.sax.xmlreader import AttributesImpl

import numpy as np

from sgstore.errors import ExportError
from sgstore.exporters._clips import WrittenFile, clip_name, safe_name, tool
from sgstore.maps.roads import is_lane_text
from sgstore.mcap import Loss
from sgstore.model.vocabulary import VEHICLES

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.exporters._labels import ClipFrames, Export

    Numbers = NDArray[np.float64]

_CATEGORIES: Final = {
    **{kind: kind for kind in ("car", "truck", "van", "bus", "bicycle", "trailer", "train")},
    "motorcycle": "motorbike",
    "vehicle": "car",
    "person": "pedestrian",
    "animal": "animal",
    "prop": "obstacle",
    "building": "building",
    "pole": "pole",
    "barrier": "barrier",
    "vegetation": "vegetation",
    "unknown": "none",
}
"""Kind → category; without signs and lights, which belong to the map."""
_PEOPLE: Final = frozenset({"person", "animal"})
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
"""Default length, width and height; m."""
REAR_AXLE: Final = 0.3
"""Distance of the rear axle behind the middle of a vehicle, as a share of the length."""
_MASS: Final = {"person": 75.0, "animal": 20.0}
TOLERANCE: Final = 0.001
"""Tolerance of positions in the verification; m."""

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


@dataclass(frozen=True, slots=True)
class ScenarioEntity:
    """Entity of a clip.

    Attributes
    ----------
    node : int
    name : str
        Name in the scenario.
    kind : str
    still : bool
        True if it never moves.
    size : tuple of float
        Length, width, height; m.
    properties : dict
        Names from the simulator.
    """

    node: int
    name: str
    kind: str
    still: bool
    size: tuple[float, float, float]
    properties: dict[str, str]

    @property
    def centre(self) -> tuple[float, float, float]:
        """Return the middle of the box in the axes of the entity; m."""
        ahead = REAR_AXLE * self.size[0] if self.kind in VEHICLES else 0.0
        return ahead, 0.0, self.size[2] / 2


@dataclass(slots=True)
class EntityTrack:
    """States of an entity; shape (n,).

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
        """Yield first and last index of each stretch without a gap."""
        ends = np.flatnonzero(np.diff(self.row) > 1).tolist()
        yield from zip([0, *(end + 1 for end in ends)], [*ends, len(self.row) - 1], strict=True)


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write a scenario for each clip, and the referenced maps."""
    maps: dict[str, Path | None] = {}
    written: list[WrittenFile] = []
    for frames in export.frames():
        trace = frames.clip.trace
        if trace not in maps:
            maps[trace] = _write_map(export, folder, trace)
        road_map = maps[trace]
        file = folder / clip_name(trace, frames.number, ".xosc")
        scenario = Scenario(export, frames, "" if road_map is None else road_map.name)
        scenario.write(file)
        _test(file, scenario.vertices)
        written.append(WrittenFile.of(file, "entities", len(scenario.actors), scenario.losses()))
        export.tell(frames.number, len(export.clips))
    found = sorted({one for one in maps.values() if one is not None})
    return written + [WrittenFile.of(road_map, "maps", 1) for road_map in found]


def _write_map(export: Export, folder: Path, trace: str) -> Path | None:
    """Write the road map of a trace next to its scenarios; equal texts are shared."""
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
    raise AssertionError("there are no more maps than clips")


class Scenario:
    """Writer of one clip into a file.

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
            elif kind in _CATEGORIES:
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
        """Return the parts of the clip that the scenario does not have."""
        told: list[Loss] = []
        if self._unsized:
            reason = f"the size of {_some(self._unsized)} is not known: a usual one is written"
            told.append(Loss(reason, 0, 0))
        if self._unmapped:
            reason = f"{_some(self._unmapped)}: no signal of the map, so what it shows is left out"
            told.append(Loss(reason, 0, 0))
        if not self._map:
            told.append(Loss("the trace has no OpenDRIVE map: the scenario names none", 0, 0))
        return told

    def write(self, file: Path) -> None:
        """Write the scenario into a file."""
        with file.open("x", encoding="utf-8", newline="\n") as stream:
            xml = XmlWriter(stream)
            with xml.element("OpenSCENARIO"):
                self._write_head(xml)
                with xml.element("Entities"):
                    for actor in self.actors:
                        _write_entity(xml, actor)
                with xml.element("Storyboard"):
                    with xml.element("Init"), xml.element("Actions"):
                        self._write_init(xml)
                    with xml.element("Story", name="recorded"):
                        self._write_acts(xml)
                    with xml.element("StopTrigger"):
                        _write_when(xml, float(self._seconds[-1]), "end")
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

    # What is there at the beginning ---------------------------------------------------------------

    def _write_init(self, xml: XmlWriter) -> None:
        changes = [(ref, next(self._light(node), None)) for node, ref in self._lights]
        for ref, change in changes:
            if change is not None and change[0] == 0:
                with xml.element("GlobalAction"):
                    _write_signal(xml, ref, change[1])
        for actor in self.actors:
            track = self._track(actor, first=not actor.still)
            if not len(track.row) or (not actor.still and track.row[0] != 0):
                continue
            with xml.element("Private", entityRef=actor.name):
                with xml.element("PrivateAction"), xml.element("TeleportAction"):
                    _write_position(xml, track.pose[0])
                if not actor.still and np.isfinite(track.speed[0]):
                    with xml.element("PrivateAction"):
                        _write_speed(xml, float(track.speed[0]))

    # What happens ---------------------------------------------------------------------------------

    def _write_acts(self, xml: XmlWriter) -> None:
        with xml.element("Act", name="tracks"):
            moving = [actor for actor in self.actors if not actor.still]
            for actor in moving:
                self._write_group(xml, actor)
            self._write_lights(xml, alone=not moving)
            with xml.element("StartTrigger"):
                _write_when(xml, 0.0, "begin")

    def _write_group(self, xml: XmlWriter, actor: ScenarioEntity) -> None:
        track = self._track(actor)
        with _group(xml, actor.name, actor.name), xml.element("Maneuver", name=actor.name):
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
        """Write the appearance, movement and disappearance of an entity."""
        low, high = ends
        times, poses = self._seconds[track.row[low : high + 1]], track.pose[low : high + 1]
        start = float(times[0])
        if track.row[low] > 0:
            with (
                _event(xml, f"{name} comes", start),
                xml.element("GlobalAction"),
                xml.element("EntityAction", entityRef=actor.name),
                xml.element("AddEntityAction"),
            ):
                _write_position(xml, poses[0])
        with _event(xml, f"{name} moves", start), xml.element("PrivateAction"):
            if high > low:
                _write_trajectory(xml, name, times, poses)
                self.vertices += len(times)
            else:
                with xml.element("TeleportAction"):
                    _write_position(xml, poses[0])
        if track.row[high] + 1 < len(self._seconds):
            leaves = float(self._seconds[track.row[high] + 1])
            with (
                _event(xml, f"{name} leaves", leaves),
                xml.element("GlobalAction"),
                xml.element("EntityAction", entityRef=actor.name),
            ):
                xml.leaf("DeleteEntityAction")

    def _write_lights(self, xml: XmlWriter, *, alone: bool) -> None:
        """Write light changes; without moving entities, a placeholder fills the act."""
        for node, ref in self._lights:
            changes = [(row, state) for row, state in self._light(node) if row > 0]
            if not changes:
                continue
            alone = False
            with _group(xml, f"signal {ref}"), xml.element("Maneuver", name=f"signal {ref}"):
                for number, (row, state) in enumerate(changes, 1):
                    time = float(self._seconds[row])
                    with _event(xml, f"signal {ref} {number}", time), xml.element("GlobalAction"):
                        _write_signal(xml, ref, state)
        if alone:
            with _group(xml, "nothing moves"):
                pass

    # What the store knows -------------------------------------------------------------------------

    def _track(self, actor: ScenarioEntity, *, first: bool = False) -> EntityTrack:
        """Return the states of an entity in the clip, or only in its first frame."""
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
        """Yield rows of the frames where a light changes, and its new state."""
        before = ""
        for frame_id, state in self._store.rows(_LIGHT, {**self._frames.bounds, "node": node}):
            if state != before:
                yield int(np.searchsorted(self._frames.frame_id, frame_id)), state
                before = state


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(names[:5]) + more


def _unwrapped(heading: Numbers) -> Numbers:
    """Remove full-turn jumps from headings; unknown headings stay."""
    known = np.isfinite(heading)
    out = heading.copy()
    out[known] = np.unwrap(heading[known])
    return out


def _origins(pose: Numbers, centre: tuple[float, float, float]) -> Numbers:
    """Convert poses of box centres to poses of vehicle origins."""
    (ch, cp, cr), (sh, sp, sr) = (
        [of(np.nan_to_num(pose[:, axis])) for axis in (3, 4, 5)] for of in (np.cos, np.sin)
    )
    ahead, _, up = centre
    out = pose.copy()
    out[:, 0] -= ch * cp * ahead + (ch * sp * cr + sh * sr) * up
    out[:, 1] -= sh * cp * ahead + (sh * sp * cr - ch * sr) * up
    out[:, 2] -= -sp * ahead + cp * cr * up
    return out


# Elements -----------------------------------------------------------------------------------------


class XmlWriter:
    """Writer of XML elements in sequence."""

    def __init__(self, stream: Any) -> None:
        self._out = XMLGenerator(stream, "utf-8", short_empty_elements=True)
        self._out.startDocument()
        self._depth = 0

    @contextmanager
    def element(self, tag: str, /, **attributes: str) -> Generator[None]:
        """Write an element around the content of the ``with`` block."""
        self._begin(tag, attributes)
        self._out.ignorableWhitespace("\n")
        self._depth += 1
        yield
        self._depth -= 1
        self._out.ignorableWhitespace("  " * self._depth)
        self._out.endElement(tag)
        self._out.ignorableWhitespace("\n")

    def leaf(self, tag: str, /, **attributes: str) -> None:
        """Write an empty element."""
        self._begin(tag, attributes)
        self._out.endElement(tag)
        self._out.ignorableWhitespace("\n")

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        self._out.ignorableWhitespace("  " * self._depth)
        told = {name: _readable(text) for name, text in attributes.items()}
        self._out.startElement(tag, AttributesImpl(told))

    def finish(self) -> None:
        """End the document."""
        self._out.endDocument()


def _readable(text: str) -> str:
    """Replace characters that XML cannot hold, and ``$``, which marks scenario parameters."""
    return "".join(c if c.isprintable() and c != "$" else "\N{REPLACEMENT CHARACTER}" for c in text)


def _number(value: float) -> str:
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _write_entity(xml: XmlWriter, actor: ScenarioEntity) -> None:
    category, length = _CATEGORIES[actor.kind], actor.size[0]
    with xml.element("ScenarioObject", name=actor.name):
        if actor.kind in VEHICLES:
            with xml.element("Vehicle", name=actor.kind, vehicleCategory=category):
                _write_box(xml, actor)
                xml.leaf("Performance", maxSpeed="70", maxAcceleration="10", maxDeceleration="10")
                with xml.element("Axles"):
                    _write_axle(xml, "FrontAxle", actor, 2 * REAR_AXLE * length, "0.6")
                    _write_axle(xml, "RearAxle", actor, 0.0, "0")
                _write_properties(xml, actor)
            return
        mass = _number(_MASS.get(actor.kind, 100.0))
        if actor.kind in _PEOPLE:
            told = {"name": actor.kind, "pedestrianCategory": category, "mass": mass}
            about = xml.element("Pedestrian", **told)
        else:
            told = {"name": actor.kind, "miscObjectCategory": category, "mass": mass}
            about = xml.element("MiscObject", **told)
        with about:
            _write_box(xml, actor)
            _write_properties(xml, actor)


def _write_box(xml: XmlWriter, actor: ScenarioEntity) -> None:
    x, y, z = map(_number, actor.centre)
    length, width, height = map(_number, actor.size)
    with xml.element("BoundingBox"):
        xml.leaf("Center", x=x, y=y, z=z)
        xml.leaf("Dimensions", width=width, length=length, height=height)


def _write_axle(
    xml: XmlWriter, name: str, actor: ScenarioEntity, ahead: float, steering: str
) -> None:
    xml.leaf(
        name,
        maxSteering=steering,
        wheelDiameter="0.6",
        trackWidth=_number(0.9 * actor.size[1]),
        positionX=_number(ahead),
        positionZ="0.3",
    )


def _write_properties(xml: XmlWriter, actor: ScenarioEntity) -> None:
    with xml.element("Properties"):
        for name, value in actor.properties.items():
            xml.leaf("Property", name=f"sgstore.{name}", value=value)


def _write_position(xml: XmlWriter, pose: Numbers) -> None:
    names = ("x", "y", "z", "h", "p", "r")
    known = {
        name: _number(value)
        for name, value in zip(names, pose.tolist(), strict=True)
        if np.isfinite(value)
    }
    with xml.element("Position"):
        xml.leaf("WorldPosition", **known)


def _write_trajectory(xml: XmlWriter, name: str, times: Numbers, poses: Numbers) -> None:
    with xml.element("RoutingAction"), xml.element("FollowTrajectoryAction"):
        with (
            xml.element("TrajectoryRef"),
            xml.element("Trajectory", name=name, closed="false"),
            xml.element("Shape"),
            xml.element("Polyline"),
        ):
            for time, pose in zip(times.tolist(), poses, strict=True):
                with xml.element("Vertex", time=_number(time)):
                    _write_position(xml, pose)
        with xml.element("TimeReference"):
            xml.leaf("Timing", domainAbsoluteRelative="absolute", scale="1", offset="0")
        xml.leaf("TrajectoryFollowingMode", followingMode="position")


def _write_speed(xml: XmlWriter, speed: float) -> None:
    with xml.element("LongitudinalAction"), xml.element("SpeedAction"):
        how = {"dynamicsShape": "step", "dynamicsDimension": "time", "value": "0"}
        xml.leaf("SpeedActionDynamics", **how)
        with xml.element("SpeedActionTarget"):
            xml.leaf("AbsoluteTargetSpeed", value=_number(speed))


def _write_signal(xml: XmlWriter, ref: str, state: str) -> None:
    with xml.element("InfrastructureAction"), xml.element("TrafficSignalAction"):
        xml.leaf("TrafficSignalStateAction", name=ref, state=state)


def _write_when(xml: XmlWriter, time: float, name: str) -> None:
    """Write a condition that holds from a time on."""
    with (
        xml.element("ConditionGroup"),
        xml.element("Condition", name=name, delay="0", conditionEdge="none"),
        xml.element("ByValueCondition"),
    ):
        xml.leaf("SimulationTimeCondition", value=_number(time), rule="greaterOrEqual")


@contextmanager
def _group(xml: XmlWriter, name: str, actor: str = "") -> Generator[None]:
    with xml.element("ManeuverGroup", maximumExecutionCount="1", name=name):
        with xml.element("Actors", selectTriggeringEntities="false"):
            if actor:
                xml.leaf("EntityRef", entityRef=actor)
        yield


@contextmanager
def _event(xml: XmlWriter, name: str, time: float) -> Generator[None]:
    with xml.element("Event", name=name, priority="parallel", maximumExecutionCount="1"):
        with xml.element("Action", name=name):
            yield
        with xml.element("StartTrigger"):
            _write_when(xml, time, name)


def _test(file: Path, vertices: int) -> None:
    """Read the written file again, one element at a time."""
    found = 0
    try:
        for _, element in ET.iterparse(file):  # noqa: S314  it is ours
            found += element.tag == "Vertex"
            element.clear()
    except ET.ParseError as error:
        raise ExportError(f"{file.name}: what was written cannot be read back: {error}") from error
    if found != vertices:
        raise ExportError(f"{file.name}: {vertices} vertices were written, {found} are read back")
