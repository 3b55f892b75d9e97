"""Graphs as networkx writes them: node-link JSON, one graph a line, a list of graphs, or one graph."""

from __future__ import annotations

import json
import re
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

from sgstore.importing.given import GivenEdge, GivenGraph, GivenNode, wrong
from sgstore.importing.lines import lines_of

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

MAX_DOCUMENT: Final = 256 << 20
"""Longest text that is not one graph a line; characters."""

MAX_NODES: Final = 200_000
MAX_EDGES: Final = 2_000_000
"""Most nodes and edges of one graph."""

_LONGEST: Final = 1_000
"""Longest name; characters."""

_WHOLE: Final = re.compile(r"-?[0-9]{1,18}")

_LABELS: Final = ("kind", "base_class", "label")
"""Attributes that say what a node is; the first that is there. (sgstore, CARLASGG, networkx.)"""

_RELATIONS: Final = ("relation", "label", "type")
"""Attributes that say what an edge is; the first that is there, else its key if that is a text."""


def read_nodelink(path: Path) -> Iterator[GivenGraph]:
    """The graphs of a file, in its order.

    Of a graph ``name`` (or ``frame_id``), ``time_ns`` or ``t`` (s), and ``ego`` (a node's id) are read; of a
    node ``kind``, ``base_class`` or ``label``, ``is_ego``, and the attributes that nodes have here, in the
    same units; of an edge ``relation``, ``label``, ``type`` or its key.

    Raises
    ------
    TraceError
        It is no JSON, no node-link graph, an undirected one, or exceeds a bound; it says in which line or
        graph.
    """
    for number, (where, document) in enumerate(_documents(path)):
        yield _graph(path, number, where, document)


def _documents(path: Path) -> Iterator[tuple[str, Any]]:
    """JSON documents, and where they stand."""
    with lines_of(path) as lines:
        numbered = enumerate(lines, start=1)
        number, first = next((one for one in numbered if one[1].strip()), (0, ""))
        if not number:
            raise wrong(path, "", "empty; expected a graph")
        try:
            document = _parsed(first)
        except ValueError:
            yield from _whole(path, number, chain([first], lines))
            return
        if isinstance(document, list):
            yield from _whole(path, number, chain([first], lines))
            return
        yield f"line {number}", document
        for later, line in numbered:
            if not line.strip():
                continue
            try:
                yield f"line {later}", _parsed(line)
            except ValueError as error:
                raise wrong(path, f"line {later}", f"no JSON: {error}") from error


def _whole(path: Path, line: int, lines: Iterator[str]) -> Iterator[tuple[str, Any]]:
    """The documents of a text that is more than one a line."""
    parts: list[str] = []
    total = 0
    for part in lines:
        parts.append(part)
        total += len(part)
        if total > MAX_DOCUMENT:
            raise wrong(
                path,
                "",
                f"one JSON document of more than {MAX_DOCUMENT >> 20} Mi characters; write one graph a line",
            )
    text = "".join(parts)
    try:
        document = _parsed(text)
    except json.JSONDecodeError as error:
        where = f"line {line - 1 + error.lineno}, column {error.colno}"
        raise wrong(path, where, f"no JSON: {error.msg}") from error
    except ValueError as error:
        raise wrong(path, "", f"no JSON: {error}") from error
    if not isinstance(document, list):
        yield f"line {line}", document
        return
    if not document:
        raise wrong(path, "", "an empty list; expected graphs")
    for number, one in enumerate(document):
        yield f"graph {number}", one


def _parsed(text: str) -> Any:
    """A JSON document.

    Raises
    ------
    ValueError
        It is none, or nested beyond reason.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def _graph(path: Path, number: int, where: str, document: Any) -> GivenGraph:
    if not isinstance(document, dict) or not isinstance(document.get("nodes"), list):
        raise wrong(path, where, "no node-link graph: expected an object with a list 'nodes'")
    if document.get("directed", True) is False:
        raise wrong(
            path, where, "an undirected graph; relations have a direction: expected directed"
        )
    links = document.get("edges", document.get("links", []))
    if not isinstance(links, list):
        raise wrong(path, where, "expected a list 'edges' or 'links'")
    if len(document["nodes"]) > MAX_NODES or len(links) > MAX_EDGES:
        raise wrong(
            path, where, f"more than {MAX_NODES:,} nodes or {MAX_EDGES:,} edges in one graph"
        )
    about = document.get("graph") or {}
    if isinstance(about, list):  # as networkx wrote it once: pairs
        about = dict(pair for pair in about if isinstance(pair, list) and len(pair) == 2)
    if not isinstance(about, dict):
        raise wrong(path, where, "expected an object 'graph'")
    name = about.get("name") or about.get("frame_id") or document.get("name") or f"graph {number}"
    graph = GivenGraph(str(name)[:_LONGEST], number + 1)
    graph.time_ns = _time(path, where, about)
    for row, node in enumerate(document["nodes"]):
        _add_node(path, graph, f"{where}, node {row}", node)
    ego = about.get("ego")
    if ego is not None and _text(ego) in graph.nodes:
        graph.nodes[_text(ego)].attributes["is_ego"] = True
    for row, edge in enumerate(links):
        _add_edge(path, graph, f"{where}, edge {row}", edge)
    return graph


def _time(path: Path, where: str, about: dict[str, Any]) -> int | None:
    for key, unit, most in (("time_ns", 1, 1 << 62), ("t", 1e9, 4e9)):
        value = about.get(key)
        if value is None:
            continue
        if isinstance(value, str) and _WHOLE.fullmatch(value):
            value = int(value)  # 64-bit numbers come as texts, because JSON readers round them
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= most:
            raise wrong(path, where, f"expected a time in {key!r}, found {str(value)[:80]}")
        return round(value * unit)
    return None


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)


def _add_node(path: Path, graph: GivenGraph, where: str, node: Any) -> None:
    if not isinstance(node, dict) or "id" not in node:
        raise wrong(path, where, "expected an object with an 'id'")
    name = _text(node["id"])
    if not name or len(name) > _LONGEST:
        raise wrong(path, where, f"expected an id of 1 to {_LONGEST} characters")
    if name in graph.nodes:
        raise wrong(path, where, f"the id {name!r} comes twice")
    attributes = {key: value for key, value in node.items() if key != "id"}
    label = next((attributes[key] for key in _LABELS if isinstance(attributes.get(key), str)), "")
    graph.nodes[name] = GivenNode(name, label, where, attributes)


def _add_edge(path: Path, graph: GivenGraph, where: str, edge: Any) -> None:
    if not isinstance(edge, dict) or not {"source", "target"} <= edge.keys():
        raise wrong(path, where, "expected an object with 'source' and 'target'")
    src, dst = _text(edge["source"]), _text(edge["target"])
    for end in (src, dst):
        if end not in graph.nodes:
            raise wrong(path, where, f"no node {end[:80]!r} in this graph")
    told = next((key for key in (*_RELATIONS, "key") if isinstance(edge.get(key), str)), None)
    if told is None:
        raise wrong(
            path, where, f"says no relation; expected one of {', '.join(_RELATIONS)}, or a key"
        )
    skipped = {"source", "target", "key", *_RELATIONS}
    attributes = {key: value for key, value in edge.items() if key not in skipped}
    graph.edges.append(GivenEdge(src, edge[told], dst, where, attributes))
