"""Export formats for networkx: node-link JSON with one graph per line, and GraphML files.

Each clip has a file ``CLIP.jsonl`` for ``networkx.node_link_graph(json.loads(line),
edges="edges")``; with ``graphml`` also a folder ``CLIP`` with ``000123.graphml``, one per frame, by
its number in the trace. The attributes of a graph identify its frame, and contain its labels as
``label_NAME``; unknown values are omitted. Without an abstraction, nodes are node ids with all
attributes; with an abstraction they are names, with ``base_class``.

Graphs are read from the store in windows of frames, as by :meth:`sgstore.query.Store.graph`.
"""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import networkx as nx

from sgstore.errors import ExportError
from sgstore.exporters._clip_frames import FEW
from sgstore.exporters._clips import WrittenFile, clip_name
from sgstore.graphs.abstractions import abstraction_named, abstractions
from sgstore.model.graph import named_graph
from sgstore.model.vocabulary import RELATION_CODE, normalize_name

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.exporters._clip_frames import ClipFrames, Export
    from sgstore.model.graph import SceneGraph

    Graph = nx.MultiDiGraph[Any]


def graphs_of(export: Export, frames: ClipFrames) -> Iterator[SceneGraph]:
    """Yield the scene graph of each frame of a clip, with sorted edges."""
    for graph in export.store.file.graphs(frames.frame_id):
        edges = sorted(graph.edges, key=lambda edge: (edge[0], RELATION_CODE[edge[1]], edge[2]))
        yield replace(graph, edges=edges)


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write the scene graphs of all frames, and verify each by reading it with networkx."""
    abstraction = export.abstraction
    if abstraction and not _is_derived(export):
        abstraction = abstraction_named(abstraction).name
    written: list[WrittenFile] = []
    for frames in export.frames():
        name = clip_name(frames.clip.trace, frames.own, "")
        lines, drawn = folder / f"{name}.jsonl", folder / name
        if export.graphml:
            drawn.mkdir()
        with lines.open("x", encoding="utf-8", newline="\n") as stream:
            for graph in _graphs(export, frames, abstraction):
                stream.write(_line(graph) + "\n")
                if export.graphml:
                    _write_graphml(graph, drawn / f"{graph.graph['seq']:06d}.graphml")
        written.append(WrittenFile.of(lines, "graphs", len(frames)))
        if export.graphml:
            written.append(WrittenFile.of(drawn, "graphs", len(frames)))
        export.tell(frames.number, len(export.clips))
    return written


def _is_derived(export: Export) -> bool:
    """True if the requested name is a derived set of relations. False for an abstraction of graphs."""
    derived = {normalize_name(one.name) for one in export.store.file.deriving.sets()}
    name = normalize_name(export.abstraction)
    return name in derived and name not in abstractions()


def _graphs(export: Export, frames: ClipFrames, abstraction: str) -> Iterator[Graph]:
    for window in frames.windows(FEW):
        columns = export.label_columns(window.frame_id)
        for row, graph in enumerate(_of_window(export, window, abstraction)):
            labels = {f"label_{name}": values[row] for name, values in columns.items()}
            graph.graph["t"] = float(window.t[row])
            graph.graph["log_time_ns"] = int(window.log_time_ns[row])
            graph.graph.update({k: v for k, v in labels.items() if v is not None})
            if graph.graph.get("ego", 0) is None:
                del graph.graph["ego"]
            yield graph


def _of_window(export: Export, frames: ClipFrames, abstraction: str) -> Iterator[Graph]:
    if not abstraction:
        yield from (graph.to_networkx() for graph in graphs_of(export, frames))
    elif _is_derived(export):
        yield from (export.store.graph(one, abstraction) for one in frames.frame_id.tolist())
    else:
        for row, graph in enumerate(export.named_graphs(frames, abstraction)):
            about = {
                "frame_id": int(frames.frame_id[row]),
                "trace": frames.clip.trace,
                "seq": int(frames.seq[row]),
                "time_ns": int(frames.time_ns[row]),
                "abstraction": abstraction,
            }
            yield named_graph(*graph, **about)


def _line(graph: Graph) -> str:
    """Return a graph as one line of node-link JSON, verified by reading the line again."""
    for _, about in graph.nodes(data=True):
        _drop_unknown(about)
    for *_, about in graph.edges(data=True):
        _drop_unknown(about)
    text = json.dumps(nx.node_link_data(graph, edges="edges"), allow_nan=False, ensure_ascii=True)
    again: Graph = nx.node_link_graph(json.loads(text), edges="edges")
    if not nx.utils.graphs_equal(graph, again) or again.graph != graph.graph:
        raise ExportError(
            f"frame {graph.graph['seq']}: networkx reads another graph than was written"
        )
    return text


def _drop_unknown(about: dict[str, Any]) -> None:
    for name in [k for k, v in about.items() if isinstance(v, float) and not math.isfinite(v)]:
        del about[name]


def _write_graphml(graph: Graph, file: Path) -> None:
    """Write a graph as a GraphML file, and verify its nodes and edges by reading the file again."""
    drawn: Graph = nx.MultiDiGraph(**_drawable(graph.graph))
    for node, about in graph.nodes(data=True):
        drawn.add_node(node, **_drawable(about))
    for src, dst, key, about in graph.edges(keys=True, data=True):
        drawn.add_edge(src, dst, _readable(str(key)), **_drawable(about))
    nx.write_graphml_xml(drawn, file, infer_numeric_types=True)
    try:
        node_type = int if all(isinstance(node, int) for node in graph) else str
        again: Graph = nx.read_graphml(file, node_type=node_type, force_multigraph=True)
    except (nx.NetworkXException, ValueError, ET.ParseError) as error:
        raise ExportError(f"{file.name}: networkx cannot read it: {error}") from error
    if set(again) != set(graph) or set(again.edges(keys=True)) != set(drawn.edges(keys=True)):
        raise ExportError(f"{file.name}: networkx reads another graph than was written")


def _drawable(about: dict[str, Any]) -> dict[str, Any]:
    """Return attributes for GraphML. Numbers and truth values stay the same; other values become texts."""
    return {
        name: value if isinstance(value, (bool, int, float)) else _readable(str(value))
        for name, value in about.items()
    }


def _readable(text: str) -> str:
    return "".join(
        c if c.isprintable() or c in "\t\n" else "\N{REPLACEMENT CHARACTER}" for c in text
    )
