"""Clips as ASAM OpenLABEL 1.0.0: who is there, in which frames, in which box, and the relations among them.

An object is an entity, called as the simulator calls it; its boxes stand in the frames, those of entities that
never move at the object. Numbers of frames are those of the trace. A relation of two entities is one relation
with the intervals of frames in which it holds. Parts of the road map are not in it.

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

    from sgstore.exporters._labels import ClipFrames, Export

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
       speed::DOUBLE AS speed, light_state::VARCHAR AS light_state
FROM nodes WHERE frame_id >= $first AND frame_id <= $last AND node_id >= 0 ORDER BY frame_id, node_id
"""
_EDGES: Final = """
SELECT frame_id, src, relation::VARCHAR AS relation, dst FROM edges
WHERE frame_id >= $first AND frame_id <= $last AND src >= 0 AND dst >= 0 ORDER BY frame_id
"""
_SIZE: Final = ("length", "width", "height")


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write a file for each clip, and read it again."""
    written: list[WrittenFile] = []
    for frames in export.frames():
        file = folder / clip_name(frames.clip.trace, frames.number, ".openlabel.json")
        clip = _Labelling(export, frames)
        with file.open("x", encoding="utf-8", newline="\n") as stream:
            clip.write(stream)
        _test(file, clip)
        written.append(WrittenFile.of(file, "objects", len(clip.seen)))
        export.tell(frames.number, len(export.clips))
    return written


class _Spans:
    """Frames in which something is the case, as intervals; told in the order of time."""

    def __init__(self) -> None:
        self.spans: list[list[int]] = []

    def add(self, place: int) -> None:
        """Take note of a frame, by its place in the clip."""
        if self.spans and self.spans[-1][1] >= place - 1:
            self.spans[-1][1] = place
        else:
            self.spans.append([place, place])

    def told(self, numbers: list[int]) -> list[dict[str, int]]:
        """The intervals, by the numbers of frames."""
        return [{"frame_start": numbers[a], "frame_end": numbers[b]} for a, b in self.spans]


class _Labelling:
    """One clip on its way into a file.

    Parameters
    ----------
    export : Export
    frames : ClipFrames

    Attributes
    ----------
    seen : dict
        Node of each entity → the frames that it is in.
    """

    def __init__(self, export: Export, frames: ClipFrames) -> None:
        self._export, self._frames = export, frames
        self.seen: dict[int, _Spans] = {}
        self._edges: dict[tuple[int, str, int], _Spans] = {}
        self._egos: set[int] = set()
        self._numbers: list[int] = frames.seq.tolist()

    def write(self, stream: TextIO) -> None:
        """Write it: frames as they are read, then what is known at their end."""
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
            "objects": self._objects(),
            "relations": self._relations(),
        }
        stream.writelines(f',\n"{key}": {_json(value)}' for key, value in tail.items())
        stream.write("\n}}\n")

    def _metadata(self) -> dict[str, Any]:
        clip, trace = self._frames.clip, self._export.trace(self._frames.clip.trace)
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
        return told | ({"comment": query} if query else {})

    def _window(self, frames: ClipFrames) -> Iterable[tuple[int, dict[str, Any]]]:
        """Numbers of frames with what is in them."""
        place = {int(one): i for i, one in enumerate(self._frames.frame_id.tolist())}
        objects: dict[int, dict[str, Any]] = {one: {} for one in frames.frame_id.tolist()}
        rows = self._export.store.file.rows(_STATES, frames.bounds)
        for row in rows:
            state: dict[str, Any] = dict(zip(rows.columns, row, strict=True))
            frame_id, node = state["frame_id"], state["node_id"]
            if frame_id in objects:
                self.seen.setdefault(node, _Spans()).add(place[frame_id])
                if state["is_ego"]:
                    self._egos.add(node)
                data = {} if state["is_static"] else _data(state)
                objects[frame_id][str(node)] = {"object_data": data} if data else {}
        for frame_id, src, relation, dst in self._export.store.file.rows(_EDGES, frames.bounds):
            if frame_id in objects:
                self._edges.setdefault((src, relation, dst), _Spans()).add(place[frame_id])
        labels = self._export.label_columns(frames.frame_id) if self._export.labels else {}
        for row, frame_id in enumerate(frames.frame_id.tolist()):
            properties: dict[str, Any] = {"timestamp": round(float(frames.t[row]), 9)}
            properties |= {"time_ns": int(frames.time_ns[row])}
            told = {name: _value(values[row]) for name, values in labels.items()}
            properties |= {"labels": told} if told else {}
            frame = {"frame_properties": properties, "objects": objects[frame_id]}
            yield int(frames.seq[row]), frame

    def _objects(self) -> dict[str, Any]:
        rows = self._export.store.file.rows(
            _OBJECTS, {"trace": self._export.trace(self._frames.clip.trace).trace_id}
        )
        found: dict[str, Any] = {}
        for row in rows:
            entity: dict[str, Any] = dict(zip(rows.columns, row, strict=True))
            node = entity["node_id"]
            if node not in self.seen:
                continue
            texts = ("type_name", "special", "subkind", "map_ref")
            data: dict[str, Any] = {
                "text": [{"name": key, "val": entity[key]} for key in texts if entity[key]],
                "boolean": [{"name": "is_static", "val": bool(entity["is_static"])}],
            }
            data["boolean"] += [{"name": "is_ego", "val": True}] if node in self._egos else []
            if entity["is_static"]:
                data |= {key: value for key, value in _data(entity).items() if key not in data}
            found[str(node)] = {
                "name": entity["ident"] or str(node),
                "type": entity["kind"],
                "frame_intervals": self.seen[node].told(self._numbers),
                "object_data": {key: value for key, value in data.items() if value},
            }
        return found

    def _relations(self) -> dict[str, Any]:
        def agent(node: int) -> list[dict[str, str]]:
            return [{"uid": str(node), "type": "object"}]

        return {
            str(number): {
                "name": relation,
                "type": relation,
                "rdf_subjects": agent(src),
                "rdf_objects": agent(dst),
                "frame_intervals": spans.told(self._numbers),
            }
            for number, ((src, relation, dst), spans) in enumerate(
                sorted(self._edges.items(), key=lambda e: e[0])
            )
        }


def _data(state: Mapping[str, Any]) -> dict[str, Any]:
    """Box, speed and what a light shows; a place where the box is not known."""
    place = [state["x"], state["y"], state["z"]]
    if None in place[:2]:
        return {}
    place[2] = 0.0 if place[2] is None else place[2]
    told: dict[str, Any] = {}
    size = [state[key] for key in _SIZE]
    if None in size or state["heading"] is None:
        told["point3d"] = [{"name": "place", "val": _rounded(place), "coordinate_system": AXES}]
    else:
        turn = _quaternion(
            *(np.radians(state.get(key) or 0.0) for key in ("heading", "pitch", "roll"))
        )
        val = _rounded([*place, *turn, *size])
        told["cuboid"] = [{"name": "box", "val": val, "coordinate_system": AXES}]
    if state.get("speed") is not None:
        told["num"] = [{"name": "speed", "val": round(state["speed"], DIGITS)}]
    if state.get("light_state"):
        told["text"] = [{"name": "light_state", "val": state["light_state"]}]
    return told


def _quaternion(heading: float, pitch: float, roll: float) -> list[float]:
    """x, y, z, w of the turn about z, then y, then x; rad."""
    (sy, cy), (sp, cp), (sr, cr) = (
        (float(np.sin(a / 2)), float(np.cos(a / 2))) for a in (heading, pitch, roll)
    )
    return [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]


def _rounded(values: Iterable[float]) -> list[float]:
    return [round(float(value), DIGITS) + 0.0 for value in values]


def _value(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def _test(file: Path, clip: _Labelling) -> None:
    """Read a file again: its frames and objects are those that were written."""
    try:
        told = json.loads(file.read_text(encoding="utf-8"))["openlabel"]
        wrong = {*told["objects"]} != {str(node) for node in clip.seen} or not told["frames"]
    except (ValueError, KeyError, TypeError) as error:
        raise ExportError(f"{file.name}: cannot be read back: {error}") from error
    if wrong:
        raise ExportError(f"{file.name}: not all objects are read back")
