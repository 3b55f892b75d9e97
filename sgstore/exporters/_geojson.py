"""Export format GeoJSON (RFC 7946): scenes and road maps, for QGIS, kepler.gl and other map programs.

A clip is a file with a feature for each entity and frame: the outline of its box, or a point
without a size. A road map is a file with its lanes, crosswalks and objects. Coordinates are
longitude and latitude if the road map has a coordinate system (the ``geoReference`` of OpenDRIVE,
or ``--crs``) and pyproj is installed. Otherwise they are metres in the axes of the map, and a note
gives the reason.

Source: RFC 7946; ASAM OpenDRIVE 1.8, 7.4 and 7.5 (``geoReference``, ``offset``).
"""

from __future__ import annotations

import json
import re
from importlib import import_module
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.geometry import corners
from sgstore.errors import ExportError
from sgstore.exporters._clips import WrittenFile, clip_name, safe_name
from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import DrawnOutlines
from sgstore.model.vocabulary import KINDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from sgstore.exporters._clip_frames import ClipFrames, Export
    from sgstore.model.world import Floats

    Placed = Callable[[Floats], Floats]

_NODES: Final = """
SELECT n.frame_id, f.time_ns, f.t, n.node_id, n.kind::VARCHAR AS kind, n.is_ego, n.name, n.ident, n.type_name,
       n.x::DOUBLE AS x, n.y::DOUBLE AS y, n.heading::DOUBLE AS heading, n.length::DOUBLE AS length,
       n.width::DOUBLE AS width, n.speed::DOUBLE AS speed, n.light_state::VARCHAR AS light_state
FROM nodes n JOIN frames f USING (frame_id)
WHERE n.frame_id >= $first AND n.frame_id <= $last AND n.node_id >= 0 AND isfinite(n.x) AND isfinite(n.y)
ORDER BY n.frame_id, n.node_id
"""
_GEO: Final = re.compile(r"<geoReference>\s*(?:<!\[CDATA\[)?\s*([^<\]]+)")
_OFFSET: Final = re.compile(r"<offset\b([^>]*)>")
_NUMBER: Final = re.compile(r"(\w+)\s*=\s*[\"']([-+.\deE]+)[\"']")
_DIGITS: Final = {True: 8, False: 3}
"""Number of digits of coordinates, in degrees and in metres: about a millimetre."""
_TEXTS: Final = ("name", "lane_type", "road", "junction", "turn")
"""Text columns of a road map that become properties of its features."""


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write a file for each clip and for each road map, and verify them by reading them again."""
    written: list[WrittenFile] = []
    maps: dict[str, Path] = {}
    for frames in export.frames():
        told = export.store.file.road_map_text(frames.clip.trace)
        placed, note = _projection(told[1] if told else "", export.crs)
        if told and told[0] not in maps:
            name = f"map_{safe_name(told[0].rsplit('.', 1)[0], str(len(maps) + 1))}"
            same = sum(file.stem.startswith(name) for file in maps.values())
            file = folder / f"{name}{f'_{same}' if same else ''}.geojson"
            maps[told[0]] = file
            written.append(_written(file, "parts", _parts_of(*told, placed), note))
        file = folder / clip_name(frames.clip.trace, frames.own, ".geojson")
        written.append(_written(file, "entities", _entities(export, frames, placed), note))
        export.tell(frames.number, len(export.clips))
    return written


def _projection(text: str, crs: str) -> tuple[Placed | None, str]:
    """Return a function that converts map coordinates to longitude and latitude, or ``None`` and a reason."""
    found = _GEO.search(text)
    system = crs or (found[1].strip() if found else "")
    local = "coordinates are metres in the axes of the road map"
    if not system:
        return None, f"{local}: it has no coordinate system; --crs EPSG:32632 sets one"
    try:
        pyproj: Any = import_module("pyproj")
    except ImportError:
        return None, f"{local}: longitude and latitude need pyproj: pip install 'sgstore[geo]'"
    try:
        to = pyproj.Transformer.from_crs(pyproj.CRS(system).to_2d(), "OGC:CRS84", always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise ExportError(f"coordinate system {system!r} is unknown: {error}") from error
    offset = _OFFSET.search(text)
    shift = dict(_NUMBER.findall(offset[1])) if offset else {}
    dx, dy, turn = (float(shift.get(name, 0)) for name in ("x", "y", "hdg"))

    def placed(points: Floats) -> Floats:
        x, y = points.T
        east, north = (
            x * np.cos(turn) - y * np.sin(turn) + dx,
            x * np.sin(turn) + y * np.cos(turn) + dy,
        )
        return np.column_stack(to.transform(east, north))

    return placed, ""


def _entities(export: Export, frames: ClipFrames, placed: Placed | None) -> Iterator[Any]:
    """Yield a GeoJSON feature for each entity in each frame of a clip."""
    for window in frames.windows():
        found = export.store.file.rows(_NODES, window.bounds).dicts()
        columns = export.label_columns(window.frame_id)
        labels = {
            int(frame): {name: values[i] for name, values in columns.items()}
            for i, frame in enumerate(window.frame_id)
        }
        rows = [row for row in found if row["frame_id"] in labels]
        if not rows:
            continue
        size = [[row[name] or 0 for name in ("length", "width")] for row in rows]
        places = [[row["x"], row["y"], np.radians(row["heading"] or 0)] for row in rows]
        poses = np.column_stack([places, size]).astype(np.float64)
        boxes = corners(np.nan_to_num(poses, posinf=0.0, neginf=0.0))
        points = _rounded(boxes.reshape(-1, 2), placed)
        for i, row in enumerate(rows):
            ring = points[4 * i : 4 * i + 4]
            known = all(size[i])
            shape = {
                "type": "Polygon" if known else "Point",
                "coordinates": [[*ring, ring[0]]] if known else ring[0],
            }
            about = {"trace": frames.clip.trace, "clip": frames.number, **row}
            about["frame_id"] = str(row["frame_id"])  # too large for the numbers of JavaScript
            yield _feature(shape, {**about, **labels[row["frame_id"]], "x": None, "y": None})


def _parts_of(name: str, text: str, placed: Placed | None) -> Iterator[Any]:
    """Yield a GeoJSON feature for each outline of a road map."""
    road_map = read_map(text, name)
    drawn, nodes = DrawnOutlines.of(road_map), road_map.nodes
    places = np.column_stack([drawn.x, drawn.y]).astype(np.float64) + drawn.origin
    points = _rounded(places, placed)
    starts = pairwise(drawn.start.tolist())
    for i, (start, end) in enumerate(starts):
        node = int(drawn.node[i])
        line = points[start:end]
        closed = bool(drawn.closed[i]) and len(line) > 2
        ring = line if line[0] == line[-1] else [*line, line[0]]
        shape = {
            "type": "Polygon" if closed else "LineString" if len(line) > 1 else "Point",
            "coordinates": [ring] if closed else line if len(line) > 1 else line[0],
        }
        row = -1 - node
        about = {"map": name, "node_id": node, "kind": KINDS[int(nodes.kind[row])]}
        texts = {column: getattr(nodes, column)[row] for column in _TEXTS}
        limit = float(nodes.speed_limit[row])
        if np.isfinite(limit):
            texts["speed_limit"] = limit
        yield _feature(shape, about | {key: value or None for key, value in texts.items()})


def _feature(shape: dict[str, Any], about: dict[str, Any]) -> dict[str, Any]:
    told = {
        name: round(value, 6) if isinstance(value, float) else value
        for name, value in about.items()
        if value is not None
    }
    return {"type": "Feature", "geometry": shape, "properties": told}


def _rounded(points: Floats, placed: Placed | None) -> list[list[float]]:
    known = points if placed is None or not len(points) else placed(points)
    return np.round(known, _DIGITS[placed is not None]).tolist()


def _written(file: Path, holds: str, features: Iterable[Any], note: str) -> WrittenFile:
    """Write features to a file, one a line, and verify the file by reading it again."""
    count = 0
    with file.open("x", encoding="utf-8", newline="\n") as stream:
        stream.write('{"type":"FeatureCollection","features":[')
        for count, one in enumerate(features, 1):
            text = json.dumps(one, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
            stream.write(f"{',' if count > 1 else ''}\n{text}")
        stream.write("\n]}\n")
    found = len(json.loads(file.read_text(encoding="utf-8"))["features"])
    if found != count:
        raise ExportError(f"{file.name}: {count} features were written, {found} are read back")
    return WrittenFile.of(file, holds, count, notes=(note,) if note else ())
