"""Scene graphs for networkx: node-link JSON, a graph a line, and GraphML, a file a frame.

For each clip there are ``CLIP.jsonl``, which ``networkx.node_link_graph(json.loads(line), edges="edges")``
reads, and a folder ``CLIP`` of ``000123.graphml``, one for each frame, by its number in the trace. A graph's
attributes say which frame it is, and have its labels as ``label_NAME``; what is not known is left out. Without
an abstraction nodes are node ids with all that is known of them; with one they are names, with ``base_class``.
"""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any, Final
from xml.sax.saxutils import escape, quoteattr

import networkx as nx

from sgstore.abstractions import abstractions
from sgstore.errors import ExportError
from sgstore.exporters.clips import WrittenFile, clip_name
from sgstore.exporters.export import FEW
from sgstore.exporters.scenes import graphs_of
from sgstore.graph import named_graph
from sgstore.store.spans import Spans
from sgstore.vocabulary import folded

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.exporters.export import ClipFrames, Export

    Graph = nx.MultiDiGraph[Any]


_XML: Final = '<?xml version="1.0" encoding="utf-8"?>\n<graphml xmlns="http://graphml.graphdrawing.org/xmlns">'
_KINDS: Final = {bool: "boolean", int: "long", float: "double"}


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write the graphs of all frames, each of which is read again by networkx."""
    spans: Spans | None = None
    if export.abstraction and not _is_derived(export):
        spans = Spans(export.store.file, export.abstraction)
    written: list[WrittenFile] = []
    for frames in export.frames():
        name = clip_name(frames.clip.trace, frames.number, "")
        lines, drawn = folder / f"{name}.jsonl", folder / name
        drawn.mkdir()
        with lines.open("x", encoding="utf-8", newline="\n") as stream:
            for graph in _graphs(export, frames, spans):
                stream.write(_line(graph) + "\n")
                _write_graphml(graph, drawn / f"{graph.graph['seq']:06d}.graphml")
        written += [
            WrittenFile.of(lines, "graphs", len(frames)),
            WrittenFile.of(drawn, "graphs", len(frames)),
        ]
        export.tell(frames.number, len(export.clips))
    return written


def _is_derived(export: Export) -> bool:
    """Whether the abstraction is a set of relations that was derived, and none of that name hides it."""
    derived = {folded(one.name) for one in export.store.file.deriving.sets()}
    name = folded(export.abstraction)
    return name in derived and name not in abstractions()


def _graphs(export: Export, frames: ClipFrames, spans: Spans | None) -> Iterator[Graph]:
    for window in frames.windows(FEW):
        columns = export.label_columns(window.frame_id)
        for row, graph in enumerate(_of_window(export, window, spans)):
            labels = {f"label_{name}": values[row] for name, values in columns.items()}
            graph.graph["t"] = float(window.t[row])
            graph.graph["log_time_ns"] = int(window.log_time_ns[row])
            graph.graph.update({k: v for k, v in labels.items() if v is not None})
            if graph.graph.get("ego", 0) is None:
                del graph.graph["ego"]
            yield graph


def _of_window(export: Export, frames: ClipFrames, spans: Spans | None) -> Iterator[Graph]:
    if spans is None and not export.abstraction:
        yield from (graph.to_networkx() for graph in graphs_of(export, frames))
        return
    if spans is None:
        yield from (
            export.store.graph(int(frame_id), export.abstraction) for frame_id in frames.frame_id
        )
        return
    found, _, labelled = spans.labelled(**frames.bounds)
    number = {seq: i for i, seq in enumerate(found.tolist())}
    for row, seq in enumerate(frames.seq.tolist()):
        nodes, edges = labelled.named(number[seq])
        about = {
            "frame_id": int(frames.frame_id[row]),
            "trace": frames.clip.trace,
            "seq": seq,
            "time_ns": int(frames.time_ns[row]),
            "abstraction": spans.abstraction.name,
        }
        yield named_graph(nodes, edges, **about)


def _line(graph: Graph) -> str:
    """A graph as a line of node-link JSON, which is the same graph when it is read."""
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
    """Write a graph as GraphML, and read it again: nodes, edges and their relations.

    Source: GraphML primer, "attributes"; names of types as networkx and Gephi read them.
    """
    keys: dict[tuple[str, str], str] = {}
    body = [*_data(graph.graph, "graph", keys)]
    for node, about in graph.nodes(data=True):
        body += [f"<node id={quoteattr(str(node))}>", *_data(about, "node", keys), "</node>"]
    for src, dst, key, about in graph.edges(keys=True, data=True):
        ends = f"source={quoteattr(str(src))} target={quoteattr(str(dst))}"
        body += [f"<edge {ends} id={_attribute(key)}>", *_data(about, "edge", keys), "</edge>"]
    head = [
        f'<key id="{thing}.{name}" for="{thing}" attr.name="{name}" attr.type="{kind}"/>'
        for (thing, name), kind in keys.items()
    ]
    start = [_XML, *head, '<graph edgedefault="directed">']
    file.write_text("\n".join([*start, *body, "</graph>", "</graphml>", ""]), encoding="utf-8")
    try:
        node_type = int if all(isinstance(node, int) for node in graph) else str
        again: Graph = nx.read_graphml(file, node_type=node_type, force_multigraph=True)
    except (nx.NetworkXException, ValueError, ET.ParseError) as error:
        raise ExportError(f"{file.name}: networkx cannot read it: {error}") from error
    edges = {(a, b, _readable(str(key))) for a, b, key in graph.edges(keys=True)}
    if set(again) != set(graph) or set(again.edges(keys=True)) != edges:
        raise ExportError(f"{file.name}: networkx reads another graph than was written")


def _data(about: dict[str, Any], thing: str, keys: dict[tuple[str, str], str]) -> Iterator[str]:
    """Attributes of a thing; those that are new, with their type, are noted."""
    for name, value in about.items():
        kind = _KINDS.get(type(value), "string")
        known = keys.setdefault((thing, name), kind)
        if {known, kind} == {"long", "double"}:
            keys[thing, name] = "double"
        text = str(value).lower() if kind == "boolean" else _readable(str(value))
        yield f'<data key="{thing}.{name}">{escape(text)}</data>'


def _attribute(text: Any) -> str:
    return quoteattr(_readable(str(text)))


def _readable(text: str) -> str:
    """A text that XML can hold."""
    return "".join(
        c if c.isprintable() or c in "\t\n" else "\N{REPLACEMENT CHARACTER}" for c in text
    )
