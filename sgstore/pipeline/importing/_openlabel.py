"""Reader of ASAM OpenLABEL 1.0 files (annotations of a recording): each frame becomes a graph.

The nodes are objects, actions, events, contexts and tags. A file is one JSON document. An element is in the
frames that list it, and in its ``frame_intervals``; without both, it is in all frames. Boxes are transformed
into the root coordinate system, by the poses of the systems and the transforms of the frames. A named value
without a column in sgstore is an attribute of its node.

Source: ASAM OpenLABEL 1.0.0, its JSON schema; `velocity` and `time_ns` are additions of sgstore.
"""

from __future__ import annotations

import json
import math
from bisect import bisect_left, bisect_right
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.model.vocabulary import add_kind, kind_named, normalize_name
from sgstore.pipeline.importing._formats import lines_of
from sgstore.pipeline.importing._resolve import (
    EGOS,
    LONGEST,
    NO_ATTRIBUTES,
    GivenEdge,
    GivenGraph,
    GivenNode,
    check_size,
    wrong,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.errors import TraceError

SECTIONS: Final = {
    "object": "objects",
    "action": "actions",
    "event": "events",
    "context": "contexts",
    "tag": "tags",
}
"""Sections whose elements become nodes → key in the file. Types other than objects become new kinds."""
UID: Final = "uid"
"""Name of the node attribute with the key of the element in the file."""

MAX_DOCUMENT: Final = 256 << 20
MAX_VALUES: Final = 20_000_000
"""Maximum number of characters, and of values, in a document. A value needs up to 100 bytes of memory."""
MAX_FRAMES: Final = 10_000_000

_VECTORS: Final = {"velocity": ("vx", "vy", "vz"), "acceleration": ("ax", "ay", "az")}
_IN_AXES: Final = ("cuboid", "point3d")
_FARTHEST: Final = 20
"""Maximum length of a chain of coordinate systems, each defined relative to the next."""
_UNITS: Final = ((4e9, 1e9), (4e12, 1e6), (4e15, 1e3), (4e18, 1.0))
"""Upper limit of a plausible time in a unit → length of the unit; ns. For s, ms, µs and ns."""


def read_openlabel(path: Path) -> Iterator[GivenGraph]:
    """Yield the frames of an OpenLABEL file as graphs, ordered by frame number.

    A file without frames is one graph.

    Raises
    ------
    TraceError
        The file is not OpenLABEL 1, exceeds a limit, or contains an invalid value. The message contains the
        place.
    """
    yield from _Labels(path).graphs()


def metadata_of(path: Path) -> dict[str, Any]:
    """Return the metadata of an OpenLABEL file."""
    return _Labels(path).root.get("metadata") or {}


def _root(path: Path) -> dict[str, Any]:
    parts: list[str] = []
    characters = values = 0
    with lines_of(path) as lines:
        for line in lines:
            parts.append(line)
            characters += len(line)
            values += sum(map(line.count, "[{,"))
            if characters > MAX_DOCUMENT or values > MAX_VALUES:
                most = f"{MAX_DOCUMENT >> 20} Mi characters or {MAX_VALUES:,} values"
                raise wrong(path, "", f"more than {most}; write a file for each clip")
    try:
        document = json.loads("".join(parts))
    except RecursionError as error:
        raise wrong(path, "", "no JSON: nested too deeply") from error
    except ValueError as error:
        raise wrong(path, "", f"no JSON: {error}") from error
    root = document.get("openlabel") if isinstance(document, dict) else None
    if not isinstance(root, dict):
        reason = "expected an object 'openlabel'"
        if isinstance(document, dict) and "vcd" in document:
            reason += "; this is VCD 4 or older: its own tools convert it to OpenLABEL 1.0"
        raise wrong(path, "", reason)
    about = root.get("metadata")
    version = about.get("schema_version", "") if isinstance(about, dict) else ""
    if not str(version).startswith("1."):
        raise wrong(path, "metadata", f"expected schema_version 1.0.0, found {str(version)[:20]!r}")
    return root


class _Labels:
    """Parsed OpenLABEL file: its elements, frames, relations and coordinate systems.

    Attributes
    ----------
    root : dict
        Contents of ``openlabel``.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.root = _root(path)
        self._frames = self._section(self.root, "frames", "")
        self._numbers = self._numbered()
        self._axes = _Axes(self._section(self.root, "coordinate_systems", ""))
        self._elements: dict[tuple[str, str], dict[str, Any]] = {}
        for kind, section in SECTIONS.items():
            for uid, element in self._section(self.root, section, "").items():
                if not isinstance(element, dict) or not isinstance(element.get("type"), str):
                    raise self._wrong(f"{section} {uid}", "expected an object with a 'type'")
                if len(uid) > LONGEST:
                    raise self._wrong(section, f"a key of more than {LONGEST} characters")
                self._elements[kind, uid] = element
            own = kind != "object" and any(of == kind for of, _ in self._elements)
            if own and kind_named(kind) is None:
                add_kind(kind)
        self._relations: dict[str, Any] = self._section(self.root, "relations", "")
        self._there = self._presence()

    def _wrong(self, where: str, reason: str) -> TraceError:
        return wrong(self._path, where, reason)

    def _section(self, of: Mapping[str, Any], name: str, where: str) -> dict[str, Any]:
        found = of.get(name)
        if found is None:
            return {}
        if not isinstance(found, dict):
            raise self._wrong(f"{where} {name}".strip(), "expected an object")
        return found

    def _numbered(self) -> list[int]:
        """Return the frame numbers of an OpenLABEL file, ascending.

        Without frames, they are the numbers in the intervals, or a single 0.
        """
        if self._frames:
            if not all(key.isdecimal() and len(key) < 16 for key in self._frames):
                raise self._wrong("frames", "expected numbers of frames as keys")
            return sorted(map(int, self._frames))
        told = self._intervals(self.root, "frame_intervals")
        if sum(last - first + 1 for first, last in told) > MAX_FRAMES:
            raise self._wrong("frame_intervals", f"more than {MAX_FRAMES:,} frames")
        return sorted({n for first, last in told for n in range(first, last + 1)}) or [0]

    def _intervals(self, element: Mapping[str, Any], where: str) -> list[tuple[int, int]]:
        found: list[tuple[int, int]] = []
        for one in element.get("frame_intervals") or []:
            told = one if isinstance(one, dict) else {}
            first, last = told.get("frame_start"), told.get("frame_end")
            if type(first) is not int or type(last) is not int or first > last:
                raise self._wrong(where, f"expected intervals of frames, found {str(one)[:80]}")
            found.append((first, last))
        return found

    def _places(self, element: Mapping[str, Any], where: str) -> Iterator[int]:
        """Yield the indices of the frames in which an element (object, action, …) occurs, by its intervals."""
        for first, last in self._intervals(element, where):
            yield from range(bisect_left(self._numbers, first), bisect_right(self._numbers, last))

    def _presence(self) -> list[dict[tuple[str, str], None]]:
        """Return the elements (objects, actions, …) that occur in each frame."""
        there: list[dict[tuple[str, str], None]] = [{} for _ in self._numbers]
        listed: set[tuple[str, str]] = set()
        for place, number in enumerate(self._numbers):
            frame = self._frame(number)
            for kind, section in SECTIONS.items():
                for uid in self._section(frame, section, f"frame {number}"):
                    if (kind, uid) not in self._elements:
                        reason = f"{section} {uid[:80]}: not among the {section} of the file"
                        raise self._wrong(f"frame {number}", reason)
                    there[place][kind, uid] = None
                    listed.add((kind, uid))
        for key, element in self._elements.items():
            where = f"{SECTIONS[key[0]]} {key[1]}"
            if not element.get("frame_intervals") and key not in listed:
                for of in there:
                    of[key] = None
            for place in self._places(element, where):
                there[place][key] = None
        return there

    def _frame(self, number: int) -> dict[str, Any]:
        frame = self._frames.get(str(number)) or {}
        if not isinstance(frame, dict):
            raise self._wrong(f"frame {number}", "expected an object")
        return frame

    def graphs(self) -> Iterator[GivenGraph]:
        """Yield the graph of each frame of an OpenLABEL file."""
        edges = self._edges()
        for place, number in enumerate(self._numbers):
            frame, where = self._frame(number), f"frame {number}"
            graph = GivenGraph(str(number), place + 1)
            about = self._section(frame, "frame_properties", where)
            graph.time_ns = self._time(about, where)
            if about.get("labels"):
                graph.lost["labels of frames"] = 1
            axes = self._axes.at(self._section(about, "transforms", where))
            for key in self._there[place]:
                node = self._node(key, frame, where, axes)
                graph.nodes[node.name] = node
                graph.characters += len(node.name) + len(node.label)
            for what in axes.missing:
                graph.lost[f"pose of the coordinate system {what[:80]}"] = 1
            for row, (src, relation, dst) in enumerate(edges[place]):
                if src in graph.nodes and dst in graph.nodes:
                    at = (f"{where}, relation {{}}", row)
                    graph.edges.append(GivenEdge(src, relation, dst, *at, NO_ATTRIBUTES))
                else:
                    what = f"relation {relation[:80]} of a node that is not in the frame"
                    graph.lost[what] = graph.lost.get(what, 0) + 1
            check_size(self._path, where, graph)
            yield graph

    def _edges(self) -> list[list[tuple[str, str, str]]]:
        """Return the relations in each frame, each with the names of its two nodes."""
        found: list[list[tuple[str, str, str]]] = [[] for _ in self._numbers]
        listed: dict[str, list[int]] = {}
        for place, number in enumerate(self._numbers):
            for uid in self._section(self._frame(number), "relations", f"frame {number}"):
                listed.setdefault(uid, []).append(place)
        for uid, relation in self._relations.items():
            where = f"relations {uid}"
            if not isinstance(relation, dict):
                raise self._wrong(where, "expected an object")
            name = _tail(relation.get("type") or relation.get("name"))
            ends = [self._agents(relation, side, where) for side in ("rdf_subjects", "rdf_objects")]
            if not name or len(name) > LONGEST or not all(ends):
                raise self._wrong(where, "expected a type, rdf_subjects and rdf_objects")
            places = {*self._places(relation, where), *listed.get(uid, ())}
            everywhere = uid not in listed and not relation.get("frame_intervals")
            shared = [
                place
                for place, there in enumerate(self._there if everywhere else ())
                if all(key in there for key in (*ends[0], *ends[1]))
            ]
            for place in sorted(places) or shared:
                found[place] += [(_name(a), name, _name(b)) for a in ends[0] for b in ends[1]]
        return found

    def _agents(self, relation: Mapping[str, Any], side: str, where: str) -> list[tuple[str, str]]:
        keys: list[tuple[str, str]] = []
        for one in relation.get(side) or []:
            told = one if isinstance(one, dict) else {}
            key = str(told.get("type", "object")), str(told.get("uid", ""))
            if key not in self._elements:
                raise self._wrong(where, f"{side}: no {key[0][:20]} {key[1][:80]!r} in the file")
            keys.append(key)
        return keys

    def _node(
        self, key: tuple[str, str], frame: Mapping[str, Any], where: str, axes: _FrameAxes
    ) -> GivenNode:
        kind, uid = key
        element, section = self._elements[key], SECTIONS[kind]
        name = str(element.get("name") or "") or (uid if kind == "object" else "")
        told = element["type"]
        attributes: dict[str, Any] = {"ident": name or told}
        label = _tail(told)
        if kind != "object":
            label, attributes["type_name"] = kind, told
        elif normalize_name(name) in EGOS or normalize_name(label) in EGOS:
            attributes["is_ego"] = True
        dynamic = self._section(frame, section, where).get(uid) or {}
        usual = str(element.get("coordinate_system") or "")
        place = f"{where}, {section} {uid}"
        for of in (element, dynamic):
            data = of.get(f"{kind}_data") if isinstance(of, dict) else None
            if isinstance(data, str):
                attributes["value"] = data
            elif isinstance(data, dict):
                attributes |= self._data(data, usual, place, axes)
        node = GivenNode(_name(key), label, place, {**attributes, UID: uid})
        still = attributes.get("is_static") is True
        node.static = still and not dynamic.get(f"{kind}_data") and "x" in attributes
        return node

    def _data(
        self, data: Mapping[str, Any], usual: str, where: str, axes: _FrameAxes
    ) -> dict[str, Any]:
        """Convert the data of an OpenLABEL element to node attributes, with its pose in the root system."""
        found: dict[str, Any] = {}
        boxes: dict[str, tuple[Any, str]] = {}
        for form, row in self._rows(data, where):
            name, value = str(row.get("name") or "value"), row.get("val")
            system = str(row.get("coordinate_system") or usual)
            if form in _IN_AXES and form not in boxes:
                boxes[form] = value, system
            elif form == "vec" and name in _VECTORS:
                turned = axes.turned(self._numbers_in(value, (3,), where), system)
                found |= dict(zip(_VECTORS[name], turned, strict=True))
            elif value is not None:
                found[name] = value
        for form in _IN_AXES:
            if form in boxes and boxes[form][0] is not None:
                value, system = boxes[form]
                lengths = (9, 10) if form == "cuboid" else (3,)
                return found | axes.pose(self._numbers_in(value, lengths, where), system)
        return found

    def _rows(self, data: Any, where: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield each data value of an OpenLABEL element with its type; nested values follow their parent."""
        if not isinstance(data, dict):
            raise self._wrong(where, "expected an object of lists of data")
        for form, rows in data.items():
            if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
                raise self._wrong(f"{where}, {form}", "expected a list of objects")
            for row in rows:
                yield form, row
                if row.get("attributes"):
                    yield from self._rows(row["attributes"], f"{where}, {form}")

    def _numbers_in(self, value: Any, lengths: tuple[int, ...], where: str) -> list[float]:
        known = isinstance(value, list) and len(value) in lengths
        if not known or not all(type(one) in {int, float} and math.isfinite(one) for one in value):
            many = " or ".join(map(str, lengths))
            raise self._wrong(where, f"expected {many} numbers, found {str(value)[:80]}")
        return [float(one) for one in value]

    def _time(self, about: Mapping[str, Any], where: str) -> int | None:
        """Return the time of a frame; ns. ``None`` if the file has no time for the frame.

        The unit of a number (s, ms, µs or ns since 1970) follows from its size. Seconds may have
        another origin.
        """
        exact = about.get("time_ns")
        if type(exact) is int and abs(exact) < 1 << 62:
            return exact
        told = about.get("timestamp")
        if told is None:
            return None
        try:
            number = float(told)
        except ValueError:
            try:
                moment = datetime.fromisoformat(told)
            except ValueError:
                number = math.nan
            else:
                moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
                return round(moment.timestamp() * 1e6) * 1000
        except TypeError:
            number = math.nan
        for most, unit in _UNITS:
            if abs(number) < most:
                return round(number * unit)
        raise self._wrong(where, f"expected a timestamp, found {str(told)[:80]!r}")


def _name(key: tuple[str, str]) -> str:
    """Return the name of the graph node for an OpenLABEL element, unique in the file."""
    return key[1] if key[0] == "object" else f"{key[0]} {key[1]}"


def _tail(told: Any) -> str:
    """Return a type name without its ontology address, such as ``Car`` for ``http://…/ontology#Car``."""
    return str(told or "").rpartition("#")[2].rpartition("/")[2]


class _Axes:
    """Coordinate systems of an OpenLABEL file, each with its parent system and its pose."""

    def __init__(self, systems: Mapping[str, Any]) -> None:
        self._systems = {name: of if isinstance(of, dict) else {} for name, of in systems.items()}

    def at(self, transforms: Mapping[str, Any]) -> _FrameAxes:
        """Return the coordinate systems in one frame. Its transforms can change their poses."""
        moved: dict[tuple[str, str], NDArray[np.float64]] = {}
        for told in transforms.values():
            if isinstance(told, dict):
                matrix = _matrix(told.get("transform_src_to_dst"))
                if matrix is not None:
                    moved[str(told.get("src")), str(told.get("dst"))] = matrix
        return _FrameAxes(self._systems, moved)


class _FrameAxes:
    """Coordinate systems of an OpenLABEL file in one frame, for converting poses into the root system.

    Attributes
    ----------
    missing : set of str
        Systems without a known pose in their parent. Poses in these systems are not converted.
    """

    def __init__(
        self,
        systems: Mapping[str, dict[str, Any]],
        moved: Mapping[tuple[str, str], NDArray[np.float64]],
    ) -> None:
        self._systems, self._moved = systems, moved
        self._known: dict[str, NDArray[np.float64] | None] = {}
        self.missing: set[str] = set()

    def _outward(self, system: str) -> NDArray[np.float64] | None:
        """Return the matrix (4, 4) that converts coordinates of a system into the root system.

        ``None`` means the root system itself.
        """
        if system not in self._known:
            self._known[system] = self._found(system)
        return self._known[system]

    def _found(self, system: str) -> NDArray[np.float64] | None:
        matrix: NDArray[np.float64] | None = None
        for _ in range(_FARTHEST):
            parent = str(self._systems.get(system, {}).get("parent") or "")
            if not parent:
                return matrix
            step = self._step(system, parent)
            if step is None:
                self.missing.add(system)
                return matrix
            matrix = step if matrix is None else step @ matrix
            system = parent
        return matrix

    def _step(self, system: str, parent: str) -> NDArray[np.float64] | None:
        if (system, parent) in self._moved:
            return self._moved[system, parent]
        if (parent, system) in self._moved:
            return np.asarray(np.linalg.inv(self._moved[parent, system]), np.float64)
        return _matrix(self._systems[system].get("pose_wrt_parent"))

    def turned(self, vector: list[float], system: str) -> list[float]:
        """Return a direction vector of a coordinate system, rotated into the root system."""
        matrix = self._outward(system)
        return vector if matrix is None else (matrix[:3, :3] @ vector).tolist()

    def pose(self, value: list[float], system: str) -> dict[str, float]:
        """Return position, angles and size of a cuboid or point as node attributes, in m and degrees."""
        matrix = self._outward(system)
        place = value[:3]
        if matrix is not None:
            place = (matrix @ [*place, 1.0])[:3].tolist()
        found = dict(zip("xyz", place, strict=True))
        if len(value) < 9:
            return found
        own = _turn(value[3:-3])
        own = own if matrix is None else matrix[:3, :3] @ own
        angles = {
            "heading": math.atan2(own[1, 0], own[0, 0]),
            "pitch": -math.asin(float(np.clip(own[2, 0], -1.0, 1.0))),
            "roll": math.atan2(own[2, 1], own[2, 2]),
        }
        found |= {name: math.degrees(angle) for name, angle in angles.items()}
        return found | dict(zip(("length", "width", "height"), value[-3:], strict=True))


def _turn(told: list[float]) -> NDArray[np.float64]:
    """Return the rotation matrix for a quaternion (x, y, z, w), or for three angles in radians."""
    if len(told) == 3:
        return _in_sequence("ZYX", told[::-1])
    x, y, z, w = np.array(told) / (np.linalg.norm(told) or 1.0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _in_sequence(sequence: str, angles: list[float]) -> NDArray[np.float64]:
    """Return the matrix of successive rotations in radians. Each is about an axis that was rotated before."""
    made = np.eye(3)
    for letter, angle in zip(sequence, angles, strict=True):
        axis = "XYZ".index(letter)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        one = np.eye(3)
        one[a, a] = one[b, b] = math.cos(angle)
        one[a, b], one[b, a] = -math.sin(angle), math.sin(angle)
        made = made @ one
    return made


def _matrix(told: Any) -> NDArray[np.float64] | None:
    """Return the (4, 4) matrix of an OpenLABEL transform; ``None`` if its data are invalid."""
    if not isinstance(told, dict):
        return None
    try:
        if "matrix4x4" in told:
            made = np.array(told["matrix4x4"], np.float64).reshape(4, 4)
        else:
            made = np.eye(4)
            made[:3, 3] = told["translation"]
            turn = [float(one) for one in told.get("quaternion") or told["euler_angles"]]
            sequence = str(told.get("sequence", "ZYX")).upper()
            made[:3, :3] = _turn(turn) if len(turn) == 4 else _in_sequence(sequence, turn)
    except (ValueError, TypeError, LookupError):
        return None
    return made if np.isfinite(made).all() else None
