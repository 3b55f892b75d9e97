"""Export format ASAM OpenLABEL 1.0.0: objects with their frames and boxes, and relations between them.

An object is an entity, named by the simulator's id. Boxes are in the frames; boxes of static
entities are at the object. Frames have the numbers of the trace. A relation between two entities is
one relation with the intervals of its frames. Parts of the road map are not exported.

Data imported from OpenLABEL keeps its keys, frame numbers, metadata and attributes. Places are
rounded to 0.1 mm, which a store preserves up to a kilometre from its middle, so that an import is
exported unchanged.

Source: ASAM OpenLABEL 1.0.0, its JSON schema.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError
from sgstore.exporters._clips import WrittenFile, clip_name, tool

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path
    from typing import TextIO

    from sgstore.exporters._clip_frames import ClipFrames, Export

SCHEMA_VERSION: Final = "1.0.0"
AXES: Final = "map"
DIGITS: Final = 6

_OBJECTS: Final = """
SELECT node_id, kind::VARCHAR AS kind, ident, special::VARCHAR AS special, subkind, type_name, is_static,
       map_ref, x::DOUBLE AS x, y::DOUBLE AS y, z::DOUBLE AS z, heading::DOUBLE AS heading,
       length::DOUBLE AS length, width::DOUBLE AS width, height::DOUBLE AS height
FROM entities WHERE trace_id = $trace ORDER BY node_id
"""
_STATES: Final = """
SELECT frame_id, node_id, is_static, is_ego, x::DOUBLE AS x, y::DOUBLE AS y, z::DOUBLE AS z,
       heading::DOUBLE AS heading, pitch::DOUBLE AS pitch, roll::DOUBLE AS roll,
       length::DOUBLE AS length, width::DOUBLE AS width, height::DOUBLE AS height,
       speed::DOUBLE AS speed, vx::DOUBLE AS vx, vy::DOUBLE AS vy, vz::DOUBLE AS vz,
       light_state::VARCHAR AS light_state
FROM nodes WHERE frame_id >= $first AND frame_id <= $last AND node_id >= 0 ORDER BY frame_id, node_id
"""
_EDGES: Final = """
SELECT frame_id, src, relation::VARCHAR AS relation, dst FROM edges
WHERE frame_id >= $first AND frame_id <= $last AND src >= 0 AND dst >= 0 ORDER BY frame_id
"""
_OWN: Final = """
SELECT frame_id, node_id, name, value::VARCHAR AS value FROM attributes
WHERE frame_id >= $first AND frame_id <= $last AND node_id >= 0 ORDER BY frame_id, node_id, name
"""
_NAMES: Final = """
SELECT frame_id, graph FROM imports WHERE frame_id >= $first AND frame_id <= $last
"""
_SIZE: Final = ("length", "width", "height")
_PLACE_DIGITS: Final = 4
_TURN_DIGITS: Final = 9
_UID: Final = "uid"
_SECTIONS: Final = {"action": "actions", "event": "events", "context": "contexts", "tag": "tags"}
"""Kind of imported elements other than objects → section of the file."""


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write an OpenLABEL file for each clip, and verify it by reading it again."""
    written: list[WrittenFile] = []
    for frames in export.frames():
        file = folder / clip_name(frames.clip.trace, frames.own, ".openlabel.json")
        clip = _Labelling(export, frames)
        with file.open("x", encoding="utf-8", newline="\n") as stream:
            clip.write(stream)
        _test(file, clip)
        written.append(WrittenFile.of(file, "objects", len(clip.seen)))
        export.tell(frames.number, len(export.clips))
    return written


class _Spans:
    """Set of frames, stored as intervals of consecutive frames."""

    def __init__(self) -> None:
        self.spans: list[list[int]] = []

    def add(self, place: int) -> None:
        """Add a frame, given as its index in the clip. Frames must be added in order."""
        if self.spans and self.spans[-1][1] >= place - 1:
            self.spans[-1][1] = place
        else:
            self.spans.append([place, place])

    def told(self, numbers: list[int]) -> list[dict[str, int]]:
        """Return the intervals of frames as first and last frame numbers."""
        return [{"frame_start": numbers[a], "frame_end": numbers[b]} for a, b in self.spans]


class _Labelling:
    """Writer of one clip as an OpenLABEL file.

    Parameters
    ----------
    export : Export
    frames : ClipFrames

    Attributes
    ----------
    seen : dict
        Node of each entity → its frames.
    """

    def __init__(self, export: Export, frames: ClipFrames) -> None:
        self._export, self._frames = export, frames
        self._trace = export.trace(frames.clip.trace)
        self._again = self._trace.flavour == "openlabel"
        self.seen: dict[int, _Spans] = {}
        self._edges: dict[tuple[int, str, int], _Spans] = {}
        self._egos: set[int] = set()
        self._uids: dict[int, str] = {}
        self._tags: dict[int, dict[str, Any]] = {}
        self._kinds: dict[int, str] = {}
        self._entities = self._known()
        self._numbers = self._numbered()

    def _known(self) -> list[dict[str, Any]]:
        """Return the attributes of the trace's entities that never change, such as size."""
        rows = self._export.store.file.rows(_OBJECTS, {"trace": self._trace.trace_id})
        found = [dict(zip(rows.columns, row, strict=True)) for row in rows]
        self._kinds = {entity["node_id"]: entity["kind"] for entity in found}
        return found

    def _numbered(self) -> list[int]:
        """Return the numbers of the frames in the OpenLABEL file."""
        numbers: list[int] = self._frames.seq.tolist()
        if not self._again or not numbers:
            return numbers
        names = dict(self._export.store.file.rows(_NAMES, self._frames.bounds))
        told = [str(names.get(frame, "")) for frame in self._frames.frame_id.tolist()]
        return [int(one) for one in told] if all(one.isdecimal() for one in told) else numbers

    def write(self, stream: TextIO) -> None:
        """Write the frames of the clip in order, then the objects and relations."""
        stream.write('{"openlabel": {\n"metadata": ')
        stream.write(_json(self._metadata()))
        axes = {AXES: {"type": "scene_cs", "parent": "", "children": []}}
        stream.write(f',\n"coordinate_systems": {_json(axes)},\n"frames": {{\n')
        first = True
        for window in self._frames.windows():
            for number, frame in self._window(window):
                stream.write("" if first else ",\n")
                stream.write(f'"{number}": {_json(frame)}')
                first = False
        stream.write("\n}")
        spans = _Spans()
        for place in range(len(self._numbers)):
            spans.add(place)
        tail = {
            "frame_intervals": spans.told(self._numbers),
            **self._elements(),
            "relations": self._relations(),
        }
        stream.writelines(f',\n"{key}": {_json(value)}' for key, value in tail.items())
        stream.write("\n}}\n")

    def _metadata(self) -> dict[str, Any]:
        clip, trace = self._frames.clip, self._trace
        told: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "name": clip.trace,
            "annotator": tool(),
            "source": trace.path.name,
            "source_sha256": trace.digest,
            "start_ns": clip.start_ns,
            "end_ns": clip.end_ns,
        }
        query = self._export.provenance.get("query", "")
        told |= {"comment": query} if query else {}
        return told | trace.report.get("metadata", {}) if self._again else told

    def _window(self, frames: ClipFrames) -> Iterable[tuple[int, dict[str, Any]]]:
        """For each frame, yield its number, and its objects and relations as OpenLABEL data."""
        place = {int(one): i for i, one in enumerate(self._frames.frame_id.tolist())}
        ids: list[int] = frames.frame_id.tolist()
        own = self._own(frames)
        within: dict[int, dict[str, dict[str, Any]]] = {one: {"objects": {}} for one in ids}
        rows = self._export.store.file.rows(_STATES, frames.bounds)
        for row in rows:
            state: dict[str, Any] = dict(zip(rows.columns, row, strict=True))
            frame_id, node = state["frame_id"], state["node_id"]
            if frame_id in within:
                self.seen.setdefault(node, _Spans()).add(place[frame_id])
                if state["is_ego"]:
                    self._egos.add(node)
                kind = self._kinds.get(node, "")
                data = {} if state["is_static"] or kind in _SECTIONS else _data(state)
                for key, rest in _typed(own.get((frame_id, node), {})).items():
                    data[key] = [*data.get(key, []), *rest]
                section = _SECTIONS.get(kind, "objects")
                key = f"{kind if kind in _SECTIONS else 'object'}_data"
                uid = self._uids.get(node, str(node))
                if kind != "tag":  # a tag belongs to the whole file
                    within[frame_id].setdefault(section, {})[uid] = {key: data} if data else {}
                else:
                    self._tags[node] = data
        for frame_id, src, relation, dst in self._export.store.file.rows(_EDGES, frames.bounds):
            if frame_id in within:
                self._edges.setdefault((src, relation, dst), _Spans()).add(place[frame_id])
        labels = self._export.label_columns(frames.frame_id) if self._export.labels else {}
        for row, frame_id in enumerate(ids):
            time_ns = int(frames.time_ns[row])
            properties: dict[str, Any] = {"timestamp": round(time_ns / 1e9, 9), "time_ns": time_ns}
            told = {name: _value(values[row]) for name, values in labels.items()}
            properties |= {"labels": told} if told else {}
            number = self._numbers[place[frame_id]]
            yield number, {"frame_properties": properties, **within[frame_id]}

    def _own(self, frames: ClipFrames) -> dict[tuple[int, int], dict[str, Any]]:
        """Return user-defined attributes of imported graphs: name → value, for each frame and node."""
        found: dict[tuple[int, int], dict[str, Any]] = {}
        if not self._trace.report.get("imported"):
            return found
        for frame_id, node, name, value in self._export.store.file.rows(_OWN, frames.bounds):
            told = json.loads(value)
            if name == _UID and self._again and isinstance(told, str):
                self._uids[node] = told
            else:
                found.setdefault((frame_id, node), {})[name] = told
        return found

    def _elements(self) -> dict[str, dict[str, Any]]:
        """Return all objects and other elements (actions, events, contexts) of the clip as OpenLABEL data."""
        found: dict[str, dict[str, Any]] = {"objects": {}}
        for entity in self._entities:
            node, kind = entity["node_id"], entity["kind"]
            if node not in self.seen:
                continue
            uid, spans = self._uids.get(node, str(node)), self.seen[node].told(self._numbers)
            if kind in _SECTIONS:
                told: dict[str, Any] = {"type": entity["type_name"] or kind}
                if kind == "tag":
                    data = self._tags[node]
                    told |= {"tag_data": data} if data else {}
                else:
                    told |= {"name": entity["ident"] or uid, "frame_intervals": spans}
                found.setdefault(_SECTIONS[kind], {})[uid] = told
                continue
            texts = ("type_name", "special", "subkind", "map_ref")
            data = {
                "text": [{"name": key, "val": entity[key]} for key in texts if entity[key]],
                "boolean": [{"name": "is_static", "val": bool(entity["is_static"])}],
            }
            data["boolean"] += [{"name": "is_ego", "val": True}] if node in self._egos else []
            if entity["is_static"]:
                data |= {key: value for key, value in _data(entity).items() if key not in data}
            found["objects"][uid] = {
                "name": entity["ident"] or str(node),
                "type": kind,
                "frame_intervals": spans,
                "object_data": {key: value for key, value in data.items() if value},
            }
        return found

    def objects(self) -> set[str]:
        """Return the OpenLABEL ids of all exported objects."""
        nodes = [node for node in self.seen if self._kinds.get(node) not in _SECTIONS]
        return {self._uids.get(node, str(node)) for node in nodes}

    def _relations(self) -> dict[str, Any]:
        def agent(node: int) -> list[dict[str, str]]:
            kind = self._kinds.get(node, "")
            form = kind if kind in _SECTIONS else "object"
            return [{"uid": self._uids.get(node, str(node)), "type": form}]

        def order(edge: tuple[tuple[int, str, int], _Spans]) -> tuple[Any, ...]:
            src, relation, dst = edge[0]
            ends = (self._uids.get(node, str(node)) for node in (src, dst))
            first, last = ((len(uid), uid) if uid.isdecimal() else (99, uid) for uid in ends)
            return first, relation, last

        return {
            str(number): {
                "name": relation,
                "type": relation,
                "rdf_subjects": agent(src),
                "rdf_objects": agent(dst),
                "frame_intervals": spans.told(self._numbers),
            }
            for number, ((src, relation, dst), spans) in enumerate(
                sorted(self._edges.items(), key=order)
            )
        }


def _data(state: Mapping[str, Any]) -> dict[str, Any]:
    """Return the box, speed and light state of an entity as OpenLABEL data.

    Without a known box, the position is returned.
    """
    place = [state["x"], state["y"], state["z"]]
    if None in place[:2]:
        return {}
    place[2] = 0.0 if place[2] is None else place[2]
    told: dict[str, Any] = {}
    size = [state[key] for key in _SIZE]
    place = _rounded(place, _PLACE_DIGITS)
    if None in size or state["heading"] is None:
        told["point3d"] = [{"name": "place", "val": place, "coordinate_system": AXES}]
    else:
        turn = _quaternion(
            *(np.radians(state.get(key) or 0.0) for key in ("heading", "pitch", "roll"))
        )
        val = [*place, *_rounded(turn, _TURN_DIGITS), *_rounded(size)]
        told["cuboid"] = [{"name": "box", "val": val, "coordinate_system": AXES}]
    velocity = [state.get(key) for key in ("vx", "vy", "vz")]
    if None not in velocity[:2]:
        val = _rounded([0.0 if one is None else one for one in velocity])
        told["vec"] = [{"name": "velocity", "val": val, "coordinate_system": AXES}]
        told["num"] = [{"name": "speed", "val": round(float(np.hypot.reduce(val)), DIGITS)}]
    if state.get("light_state"):
        told["text"] = [{"name": "light_state", "val": state["light_state"]}]
    return told


def _typed(attributes: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return attributes as OpenLABEL element data, with a type for each value."""
    found: dict[str, list[dict[str, Any]]] = {}
    for name, value in attributes.items():
        form, told = "text", value
        if isinstance(value, bool):
            form = "boolean"
        elif isinstance(value, int | float):
            form = "num"
        elif isinstance(value, list) and all(type(one) in {int, float, str} for one in value):
            form = "vec"
        elif not isinstance(value, str):
            told = _json(value)
        found.setdefault(form, []).append({"name": name, "val": told})
    return found


def _quaternion(heading: float, pitch: float, roll: float) -> list[float]:
    """Return the quaternion (x, y, z, w) of heading, pitch and roll in radians, with w >= 0."""
    (sy, cy), (sp, cp), (sr, cr) = (
        (float(np.sin(a / 2)), float(np.cos(a / 2))) for a in (heading, pitch, roll)
    )
    turn = [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
    return turn if turn[3] >= 0 else [-one for one in turn]


def _rounded(values: Iterable[float], digits: int = DIGITS) -> list[float]:
    return [round(float(value), digits) + 0.0 for value in values]


def _value(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def _test(file: Path, clip: _Labelling) -> None:
    """Raise an error if a written OpenLABEL file does not have the expected frames and objects."""
    try:
        told = json.loads(file.read_text(encoding="utf-8"))["openlabel"]
        wrong = {*told["objects"]} != clip.objects() or not told["frames"]
    except (ValueError, KeyError, TypeError) as error:
        raise ExportError(f"{file.name}: cannot be read back: {error}") from error
    if wrong:
        raise ExportError(f"{file.name}: not all objects are read back")
