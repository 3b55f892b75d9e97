"""Export format for PyTorch Geometric: graphs as arrays, read by :mod:`sgstore.exporters.graph_data`.

A folder ``graphs`` of ``.npy`` files, which are memory-mapped (no pickle), and ``graphs.json`` with
the meaning of the numbers. Graph i has the rows ``node_ptr[i]`` to ``node_ptr[i + 1]`` of the node
columns, and likewise for edges; its ``edge_index`` counts its own nodes from 0. Clips are ranges of
graphs, and therefore sequences.

By default graphs follow the abstraction ``roadscene2vec``, with the types and relations of that
tool in its order (a type is the column of its one-hot feature, and a relation the type of its
edge). Graphs of another abstraction have its labels in alphabetical order. A node has its type, and
its position relative to the ego.

Source: RoadScene2Vec (Malawade et al., 2022), its configuration (names of actors and relations, their order).
"""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from sgstore.errors import ExportError
from sgstore.exporters._clips import WrittenFile
from sgstore.exporters.graph_data import ABOUT, ENTITIES, FOLDER, FORMAT, VERSION, GraphData
from sgstore.graphs.abstractions import abstraction_named
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.exporters._clip_frames import ClipFrames, Export
    from sgstore.graphs.abstractions import GraphColumns, Labelled


BY_ITSELF: Final = "roadscene2vec"
"""Name of the default abstraction."""

ACTORS: Final = ("ego_car", "car", "moto", "bicycle", "ped", "lane", "light", "sign", "road")
RELATIONS: Final = (
    *("isIn", "inDFrontOf", "inSFrontOf", "atDRearOf", "atSRearOf", "toLeftOf", "toRightOf"),
    *("near_coll", "super_near", "very_near", "near", "visible"),
)
"""Types of nodes and of edges in RoadScene2Vec, in its order."""

_TYPE_OF: Final = {
    **dict.fromkeys(("Left Lane", "Middle Lane", "Right Lane"), "lane"),
    "Root Road": "road",
}
FEATURES: Final = (
    ("ahead", "m", "of the ego's centre, along its heading"),
    ("left", "m", "of the ego's centre, across its heading"),
    ("up", "m", "above the ego's centre"),
    ("heading", "rad", "less the ego's heading, in (-pi, pi]"),
)
"""Columns of ``node_feature`` with name, unit and meaning."""

UNKNOWN: Final = (
    "NaN: the node has no pose (lanes, roads and signs of the map), or the frame has no ego"
)
"""Meaning of a missing value in ``node_feature``."""

_KINDS: Final = {
    "frame_id": ("<i8", 0),
    "time_ns": ("<i8", 0),
    "clip": ("<i4", 0),
    "node_ptr": ("<i8", 0),
    "edge_ptr": ("<i8", 0),
    "node_type": ("<i2", 0),
    "node_id": ("<i8", 0),
    "node_feature": ("<f4", len(FEATURES)),
    "edge_index": ("<i4", 2),
    "edge_type": ("<i2", 0),
}
"""Columns → type, and number of values per row. 0 means one value without a second axis."""


class _TensorColumns:
    """Files ``.npy`` that grow during the export, one for each column of the graphs.

    Parameters
    ----------
    folder : Path
    labels : mapping
        Name → kind and words of a label; see :func:`_kind_of`.
    """

    def __init__(self, folder: Path, labels: Mapping[str, tuple[str, list[str]]]) -> None:
        self.labels = labels
        self.types: list[str] = []
        self.relations: list[str] = []
        self.nodes = self.edges = 0
        self.clips: list[list[int]] = []
        self._kinds = _KINDS | {f"label_{name}": ("<f8", 0) for name in labels}
        self._rows = Counter[str]()
        self._streams = {name: (folder / f"{name}.npy").open("xb") for name in self._kinds}

    def __enter__(self) -> Self:
        for name in self._streams:
            self._write_head(name)
        for name in ("node_ptr", "edge_ptr"):
            self._append(name, np.zeros(1))
        return self

    def __exit__(self, *_exception: object) -> None:
        for name, stream in self._streams.items():
            stream.seek(0)
            self._write_head(name)
            stream.close()

    def _write_head(self, name: str) -> None:
        """Write the header of a column file, with the number of rows so far."""
        dtype, width = self._kinds[name]
        shape = (self._rows[name], width) if width else (self._rows[name],)
        # Numpy reserves room for the largest number, so that the length of the header is constant.
        np.lib.format.write_array_header_1_0(
            self._streams[name], {"descr": dtype, "fortran_order": False, "shape": shape}
        )

    def _append(self, name: str, values: NDArray[Any]) -> None:
        self._rows[name] += len(values)
        self._streams[name].write(np.ascontiguousarray(values, self._kinds[name][0]).tobytes())

    def add(self, frames: ClipFrames, columns: Mapping[str, NDArray[Any]]) -> None:
        """Append the columns of some graphs to the files."""
        count = len(frames)
        if len(self.clips) < frames.number:
            start = self.clips[-1][1] if self.clips else 0
            self.clips.append([start, start])
        self.clips[-1][1] += count
        per = {
            "frame_id": frames.frame_id,
            "time_ns": frames.time_ns,
            "clip": np.full(count, frames.number - 1),
            "node_ptr": self.nodes + np.cumsum(columns["nodes"]),
            "edge_ptr": self.edges + np.cumsum(columns["edges"]),
        }
        self.nodes += int(columns["nodes"].sum())
        self.edges += int(columns["edges"].sum())
        for name in self._streams:
            self._append(name, per[name] if name in per else columns[name])


def _kind_of(values: list[Any]) -> tuple[str, list[str]]:
    """Return the type of a label (``bool``, ``number`` or ``text``). Also return all values of a text label."""
    known = [value for value in values if value is not None]
    if all(isinstance(value, bool) for value in known):
        return "bool", []
    if all(isinstance(value, int | float) for value in known):
        return "number", []
    return "text", sorted({str(value) for value in known})


def _numbers(values: list[Any], words: list[str]) -> NDArray[np.float64]:
    """Return the values of a label as numbers (for texts, word indices). NaN means unknown."""
    place = {word: i for i, word in enumerate(words)}
    told = [place[str(v)] if words and v is not None else v for v in values]
    return np.array([np.nan if value is None else float(value) for value in told])


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write the graphs of all frames as arrays, and verify the files by reading them again."""
    abstraction = abstraction_named(export.abstraction or BY_ITSELF).name
    told = {} if export.labels is None else export.labels.values
    labels = {name: _kind_of(of.tolist()) for name, of in told.items()}
    place = folder / FOLDER
    place.mkdir()
    columns = _TensorColumns(place, labels)
    fixed = normalize_name(abstraction) == normalize_name(BY_ITSELF)
    if fixed:
        columns.types += ACTORS
        columns.relations += RELATIONS
    with columns:
        for frames in export.windows():
            columns.add(frames, _columns_of(export, frames, abstraction, columns))
    if not fixed:
        columns.types = _sorted(place / "node_type.npy", columns.types)
        columns.relations = _sorted(place / "edge_type.npy", columns.relations)
    about = _about(export, abstraction, columns)
    text = json.dumps(about, indent=2, ensure_ascii=False) + "\n"
    (folder / ABOUT).write_text(text, encoding="utf-8")
    entities = _write_entities(export, folder)
    _test(folder, columns)
    graphs = sum(last - first for first, last in columns.clips)
    return [
        WrittenFile.of(folder / ABOUT, "clips", len(columns.clips)),
        WrittenFile.of(folder / ENTITIES, "entities", entities),
        WrittenFile.of(place, "graphs", graphs),
    ]


_IDENTITIES: Final = """
SELECT node_id, ident, type_name FROM entities
WHERE trace_id = $trace AND (ident IS NOT NULL OR type_name IS NOT NULL) ORDER BY node_id
"""


def _write_entities(export: Export, folder: Path) -> int:
    """Write the recorded ids and types of the entities, one entity per line; return their number."""
    written = 0
    with (folder / ENTITIES).open("x", encoding="utf-8", newline="\n") as stream:
        for trace in dict.fromkeys(clip.trace for clip in export.clips):
            values = {"trace": export.trace(trace).trace_id}
            for node, ident, type_name in export.store.file.rows(_IDENTITIES, values):
                told = {"trace": trace, "node_id": node, "ident": ident, "type_name": type_name}
                stream.write(json.dumps(told, ensure_ascii=False) + "\n")
                written += 1
    return written


def _about(export: Export, abstraction: str, columns: _TensorColumns) -> dict[str, Any]:
    texts = {} if export.labels is None else export.labels.texts
    return {
        "format": FORMAT,
        "version": VERSION,
        "abstraction": abstraction,
        "node_types": columns.types,
        "relations": columns.relations,
        "node_features": [
            {"name": name, "unit": unit, "meaning": meaning, "unknown": UNKNOWN}
            for name, unit, meaning in FEATURES
        ],
        "labels": {
            name: {"text": texts[name], "kind": kind, "words": words}
            for name, (kind, words) in columns.labels.items()
        },
        "clips": [
            {"trace": c.trace, "start_ns": c.start_ns, "end_ns": c.end_ns, "graphs": span}
            for c, span in zip(export.clips, columns.clips, strict=True)
        ],
    }


def _columns_of(
    export: Export, frames: ClipFrames, abstraction: str, columns: _TensorColumns
) -> dict[str, NDArray[Any]]:
    """Return the graphs of some frames as columns. ``nodes`` and ``edges`` are their numbers per graph."""
    found, seen, labelled = export.store.file.abstracted.frames(abstraction, **frames.bounds)
    wanted = np.full(len(found), -1)
    wanted[np.searchsorted(found, frames.seq)] = np.arange(len(frames))
    of_node = wanted[labelled.node_frame]
    kept = np.flatnonzero(of_node >= 0)
    kept = kept[np.argsort(of_node[kept], kind="stable")]
    nodes = np.bincount(of_node[kept], minlength=len(frames))
    start = np.cumsum(nodes) - nodes
    local = np.zeros(len(labelled.node), np.int64)
    local[kept] = np.arange(len(kept)) - start[of_node[kept]]
    frame, src, label, dst = _edges(labelled)
    of_edge = wanted[frame]
    order = np.flatnonzero(of_edge >= 0)
    order = order[np.argsort(of_edge[order], kind="stable")]
    ends = [local[_row(labelled, frame[order], end[order])] for end in (src, dst)]
    named = np.array(labelled.labels or ("",), object)
    own = normalize_name(abstraction) == normalize_name(BY_ITSELF)
    numbers = export.label_columns(frames.frame_id)
    return {
        "nodes": nodes,
        "edges": np.bincount(of_edge[order], minlength=len(frames)),
        "node_type": _codes(
            columns.types, named[labelled.node_label[kept]], _TYPE_OF if own else {}
        ),
        "node_id": labelled.node[kept],
        "node_feature": _features(seen, labelled.node_frame[kept], labelled.node[kept]),
        "edge_index": np.stack(ends, axis=1),
        "edge_type": _codes(columns.relations, named[label[order]], {}),
    } | {f"label_{name}": _numbers(of, columns.labels[name][1]) for name, of in numbers.items()}


def _edges(labelled: Labelled) -> tuple[NDArray[Any], ...]:
    """Return the edges of labelled graphs as four arrays: frame, source, label, destination."""
    bundles = labelled.bundles[::-1]  # a negative label counts from the end
    several = [(i,) for i in range(len(labelled.labels))] + [tuple(of) for of in bundles]
    many = np.array([len(of) for of in several] or [0])
    flat = np.array([one for of in several for one in of] or [0], np.int64)
    starts = np.cumsum(many) - many
    index = np.where(labelled.label < 0, len(several) + labelled.label, labelled.label)
    count = many[index] if len(index) else np.zeros(0, np.int64)
    edge = np.repeat(np.arange(len(index)), count)
    within = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    label = flat[starts[index[edge]] + within] if len(edge) else np.zeros(0, np.int64)
    return labelled.frame[edge], labelled.src[edge], label, labelled.dst[edge]


def _row(labelled: Labelled, frame: NDArray[Any], node: NDArray[Any]) -> NDArray[np.int64]:
    """Return the array index of each given node in its frame. The array is sorted by frame and node."""
    low = int(labelled.node.min(initial=0))
    span = int(labelled.node.max(initial=0)) - low + 1
    keys = labelled.node_frame * span + (labelled.node - low)
    return np.searchsorted(keys, frame * span + (node - low)).astype(np.int64)


def _codes(
    known: list[str], labels: NDArray[np.object_], meaning: Mapping[str, str]
) -> NDArray[np.int64]:
    """Return a number for each label. Add new labels to the list of known labels."""
    texts, inverse = np.unique(labels.astype(str), return_inverse=True)
    place = {name: i for i, name in enumerate(known)}
    codes: list[int] = []
    for text in texts.tolist():
        name = meaning.get(text, text) if text not in place else text
        if name not in place:
            place[name] = len(known)
            known.append(name)
        codes.append(place[name])
    return np.array(codes or [0], np.int64)[inverse] if len(labels) else np.zeros(0, np.int64)


def _features(seen: GraphColumns, frame: NDArray[Any], node: NDArray[Any]) -> NDArray[np.float64]:
    """Return numeric features of nodes relative to the ego of their frame; see :data:`FEATURES`."""
    row = seen.row_of(frame, node)
    ego = np.full(seen.frames, -1)
    own = np.flatnonzero(seen.is_ego)
    ego[seen.node_frame[own]] = own
    at = ego[frame]
    known = (row >= 0) & (at >= 0)
    dx, dy, dz, turned = (
        np.where(known, of[row] - of[at], np.nan) for of in (seen.x, seen.y, seen.z, seen.heading)
    )
    heading = np.where(known, seen.heading[at], np.nan)
    ahead = dx * np.cos(heading) + dy * np.sin(heading)
    left = dy * np.cos(heading) - dx * np.sin(heading)
    turned -= 2 * np.pi * np.ceil((turned - np.pi) / (2 * np.pi))
    return np.stack([ahead, left, dz, turned], axis=1)


def _sorted(file: Path, names: list[str]) -> list[str]:
    """Sort the names, and replace their old indices in a file by the new ones. Return the sorted names."""
    order = sorted(range(len(names)), key=names.__getitem__)
    place = np.zeros(len(names) + 1, np.int16)
    place[order] = np.arange(len(names))
    mapped = np.lib.format.open_memmap(file, mode="r+")
    for start in range(0, len(mapped), 1 << 20):
        mapped[start : start + (1 << 20)] = place[mapped[start : start + (1 << 20)]]
    mapped.flush()
    return [names[i] for i in order]


def _test(folder: Path, columns: _TensorColumns) -> None:
    """Raise an error if the written columns of the graphs cannot be read again.

    Raises
    ------
    ExportError
        The content differs from the written columns.
    """
    data = GraphData(folder)
    found = len(data), len(data.columns["node_type"]), len(data.columns["edge_type"])
    if found != (sum(last - first for first, last in columns.clips), columns.nodes, columns.edges):
        raise ExportError(f"{FOLDER}: the written file cannot be read back")
    data.check()
