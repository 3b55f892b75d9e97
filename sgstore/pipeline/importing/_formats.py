"""Readers of graph files: node-link JSON, and tables of edges (CSV).

Files are untrusted text, read line by line with limits. ``.xz``, ``.gz`` and ``.bz2`` are decompressed.
"""

from __future__ import annotations

import bz2
import csv
import gzip
import json
import lzma
import re
import stat
import sys
import zlib
from contextlib import contextmanager
from io import StringIO
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import TraceError
from sgstore.model.vocabulary import normalize_name
from sgstore.pipeline.importing._resolve import (
    LONGEST,
    NO_ATTRIBUTES,
    GivenEdge,
    GivenGraph,
    GivenNode,
    check_size,
    wrong,
)

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator
    from pathlib import Path


MAX_LINE: Final = 32 << 20
"""Maximum length of a line; bytes. A graph of 100,000 nodes with attributes needs half of this."""

MAX_TEXT: Final = 1 << 36
"""Maximum size of a decompressed file; bytes: 64 GiB."""

MAX_RATIO: Final = 2_000
"""Maximum compression ratio after the first GiB. Real text never reaches it."""

_FREE: Final = 1 << 30
_PACKED: Final = {".xz": lzma.open, ".gz": gzip.open, ".bz2": bz2.open}


def stem_of(path: Path) -> str:
    """Return the file name without its format suffixes, such as ``graphs`` for ``graphs.csv.xz``."""
    name = path.name
    for ending in (*_PACKED, ".csv", ".json", ".ndjson", ".jsonl", ".openlabel"):
        if name.lower().endswith(ending) and len(name) > len(ending):
            name = name[: -len(ending)]
    return name


@contextmanager
def lines_of(path: Path) -> Generator[Iterator[str]]:
    """Context manager with the text lines of a file, which may be compressed.

    Raises
    ------
    TraceError
        The file cannot be opened, is not a regular file or not UTF-8, or exceeds a limit. The message contains
        the line.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise TraceError("no regular file", path=path)
        opened = _PACKED.get(path.suffix.lower())
        file = opened(path, "rb") if opened else path.open("rb")
    except OSError as error:
        raise TraceError(f"cannot be read: {error.strerror or error}", path=path) from error
    with file:
        yield _lines(path, file, status.st_size)


def _lines(path: Path, file: Any, size: int) -> Iterator[str]:
    number = total = 0
    while True:
        number += 1
        where = f"line {number}"
        try:
            line = file.readline(MAX_LINE + 1)
        except (OSError, EOFError, ValueError, lzma.LZMAError, zlib.error) as error:
            raise wrong(path, where, f"cannot be read: {error}") from error
        if not line:
            return
        if len(line) > MAX_LINE:
            raise wrong(path, where, f"longer than {MAX_LINE >> 20} MiB")
        total += len(line)
        if total > MAX_TEXT or total > _FREE + MAX_RATIO * size:
            raise wrong(path, where, f"{total:,} bytes unpacked, from a file of {size:,}")
        try:
            yield line.decode("utf-8-sig" if number == 1 else "utf-8")
        except UnicodeDecodeError as error:
            raise wrong(path, where, f"no UTF-8 at byte {error.start} of the line") from error


# Tables with one edge per row (node, edge, node): files of S3C, and CSV with a header.
# The rows of a graph are consecutive. A row without relation and second node adds a single node.

S3C: Final = ("ds", "sg", "n_img", "t_id", "node1", "edge", "node2")
"""Header line of S3C's files. (Woodlief et al., "S3C", ICSE 2024.)"""

_NAMES: Final = {
    "graph": ("graph", "frame", "frame_id", "sg", "image"),
    "src": ("src", "source", "node1", "from"),
    "relation": ("relation", "edge", "label"),
    "dst": ("dst", "target", "node2", "to"),
    "src_kind": ("src_kind", "kind1", "source_kind", "node1_class"),
    "dst_kind": ("dst_kind", "kind2", "target_kind", "node2_class"),
    "src_is_ego": ("src_is_ego",),
    "dst_is_ego": ("dst_is_ego",),
    "time": ("t", "time", "time_s"),
    "time_ns": ("time_ns",),
    "images": ("images", "n_img"),
}
"""Name of a column → names that are accepted in its place."""

_IGNORED: Final = frozenset({"ds", "t_id"})
"""Columns of S3C that are ignored: the data set and the row number."""

MAX_ROW: Final = 1 << 20
"""Maximum length of a table row, which can have several lines; characters."""


def read_s3c(path: Path) -> Iterator[GivenGraph]:
    """Yield the graphs of a CSV file in the format of S3C, in file order.

    Raises
    ------
    TraceError
        The header or a row is invalid.
    """
    return _read(path, S3C)


def read_csv(path: Path) -> Iterator[GivenGraph]:
    """Yield the graphs of a CSV file with the columns ``graph, src, relation, dst`` and optional others.

    The optional columns are ``src_kind``, ``dst_kind``, ``src_is_ego``, ``dst_is_ego``, ``t`` (s) or
    ``time_ns``, and ``images``. Column names of S3C, pandas and networkx are also accepted.

    Raises
    ------
    TraceError
        A column is missing or occurs twice, or a row is invalid.
    """
    return _read(path, ())


def _read(path: Path, header: tuple[str, ...]) -> Iterator[GivenGraph]:
    with lines_of(path) as lines:
        yield from _EdgeTable(path, lines).graphs(header)


class _EdgeTable:
    """Parser of a CSV file of edges, which builds graphs row by row."""

    def __init__(self, path: Path, lines: Iterator[str]) -> None:
        self._path, self._lines = path, lines
        self._line = self._taken = 0
        self._number, self._row = 1, list[str]()
        self._names: tuple[str, ...] = ()
        self._places: dict[str, int] = {}  # Index of each column; -1 if it is missing.
        self._lost: list[int] = []
        self._edge_place = ""

    def graphs(self, header: tuple[str, ...]) -> Iterator[GivenGraph]:
        """Yield the graphs of the edge table. A given ``header`` must be the header of the file."""
        reader = csv.reader(self._bounded(), strict=True)
        try:
            self._read_header(next(reader, None), header)
            yield from self._graphs(reader)
        except csv.Error as error:
            raise wrong(self._path, f"row {reader.line_num}", f"no CSV: {error}") from error

    def _bounded(self) -> Iterator[str]:
        """Yield the lines of the file for the CSV parser. A row that is too long raises an error."""
        for line in self._lines:
            self._line += 1
            self._taken += len(line)
            if self._taken > MAX_ROW:
                reason = f"a row of more than {MAX_ROW:,} characters"
                raise wrong(self._path, f"line {self._line}", reason)
            yield line

    def _read_header(self, first: list[str] | None, header: tuple[str, ...]) -> None:
        if first is None:
            raise wrong(self._path, "", "empty; expected a header")
        names = self._names = tuple(name.strip() for name in first)
        if header and names != header:
            raise wrong(
                self._path,
                "row 1",
                f"expected the header of S3C, {','.join(header)}; found {','.join(names)[:200]}"
                " (another table of edges can be read with --as csv)",
            )
        folded = list(map(normalize_name, names))
        for what, words in _NAMES.items():
            found = [i for i, name in enumerate(folded) if name in set(map(normalize_name, words))]
            if len(found) > 1:
                both = " and ".join(names[i] for i in found)
                reason = f"columns {both} both say {what!r}; expected one"
                raise wrong(self._path, "row 1", reason)
            if not found and what in {"graph", "src", "relation", "dst"}:
                reason = f"no column {what!r} (or {', '.join(words[1:])})"
                raise wrong(self._path, "row 1", f"{reason}; found {','.join(names)[:200]}")
            self._places[what] = found[0] if found else -1
        known = set(self._places.values())
        self._lost = [i for i, n in enumerate(names) if i not in known and n not in _IGNORED]
        self._edge_place = f"row {{}}, column {names[self._places['relation']]}"

    def _graphs(self, rows: Iterator[list[str]]) -> Iterator[GivenGraph]:
        graph: GivenGraph | None = None
        self._taken = 0
        for self._number, self._row in enumerate(rows, start=2):
            self._taken = 0
            where = f"row {self._number}"
            if not self._row:
                continue
            if len(self._row) != len(self._names):
                reason = f"{len(self._row)} columns, expected {len(self._names)}"
                raise wrong(self._path, where, reason)
            name = self._row[self._places["graph"]]
            if graph is None or name != graph.name:
                if graph is not None:
                    yield graph
                graph = self._opened(name)
            self._add(graph)
            check_size(self._path, where, graph)
        if graph is None:
            raise wrong(self._path, "", "no row beside the header; expected graphs")
        yield graph

    def _wrong(self, column: str, reason: str) -> TraceError:
        return wrong(self._path, self._where(column), reason)

    def _where(self, column: str) -> str:
        return f"row {self._number}, column {self._names[self._places[column]]}"

    def _text(self, column: str) -> str:
        """Return the current row's text in a column; empty if the file lacks the column."""
        place = self._places[column]
        return self._row[place].strip() if place >= 0 else ""

    def _opened(self, name: str) -> GivenGraph:
        """Return a new graph that starts with the current row of the edge table."""
        if not name or len(name) > LONGEST:
            raise self._wrong(
                "graph", f"expected the name of a graph, of 1 to {LONGEST} characters"
            )
        graph = GivenGraph(name, self._number)
        if self._places["images"] >= 0:
            graph.images = int(self._value("images", 1, 1 << 31))
        if self._places["time_ns"] >= 0:
            graph.time_ns = int(self._value("time_ns", -(1 << 62), 1 << 62))
        elif self._places["time"] >= 0:
            graph.time_ns = round(self._value("time", -4e9, 4e9) * 1e9)
        return graph

    def _value(self, column: str, low: float, high: float) -> float:
        text = self._text(column)
        try:
            value = int(text) if text.lstrip("+-").isdigit() and len(text) < 20 else float(text)
        except ValueError:
            raise self._wrong(column, f"expected a number, found {text[:80]!r}") from None
        if not low <= value <= high:
            raise self._wrong(column, f"{text[:80]} is out of range")
        return value

    def _add(self, graph: GivenGraph) -> None:
        src = self._node(graph, "src")
        relation, dst = self._text("relation"), self._text("dst")
        for place in self._lost:
            if self._row[place]:
                what = f"column {self._names[place]}"
                graph.lost[what] = graph.lost.get(what, 0) + 1
        if not relation and not dst:
            return
        if not relation or len(relation) > LONGEST:
            what = "empty, beside a second node" if not relation else f"{len(relation)} characters"
            raise self._wrong("relation", f"{what}; expected a relation")
        dst = self._node(graph, "dst")
        if not graph.edges or graph.edges[-1].relation != relation:
            graph.characters += len(relation)
        place = self._edge_place, self._number
        graph.edges.append(GivenEdge(src, sys.intern(relation), dst, *place, NO_ATTRIBUTES))

    def _node(self, graph: GivenGraph, end: str) -> str:
        """Add the source or destination node of the current row to a graph, and return its name."""
        name, label = self._text(end), self._text(f"{end}_kind")
        if not name or len(name) > LONGEST:
            raise self._wrong(end, f"expected the name of a node, of 1 to {LONGEST} characters")
        known = graph.nodes.get(name)
        if known is None:
            known = graph.nodes[name] = GivenNode(name, label, self._where(end))
            graph.characters += len(name) + len(label)
        elif label and known.label and known.label != label:
            told = f"{name!r} is {label!r} here and {known.label!r} in {known.where}"
            raise self._wrong(end, told)
        else:
            known.label = known.label or label
        if text := self._text(f"{end}_is_ego"):
            known.attributes["is_ego"] = text.lower() in {"true", "1", "t", "yes"}
        return known.name


# Node-link JSON of networkx: one graph per line, a list of graphs, or one graph.

MAX_DOCUMENT: Final = 32 << 20
"""Maximum length of a document that does not have one graph per line; characters."""

MAX_VALUES: Final = 3_000_000
"""Maximum number of values in a JSON document, counted before parsing. A value needs up to 100 bytes."""

_TOO_MANY: Final = f"more than {MAX_VALUES:,} values in one JSON document; write one graph a line"

_WHOLE: Final = re.compile(r"-?[0-9]{1,18}")

_LABELS: Final = ("kind", "base_class", "label")
"""Attributes for the label of a node in sgstore, CARLASGG and networkx. The first one present is used."""

_RELATIONS: Final = ("relation", "label", "type")
"""Attributes for the relation of an edge. The first one present is used; else the key, if it is a text."""


def read_nodelink(path: Path) -> Iterator[GivenGraph]:
    """Yield the graphs of a node-link JSON file, in file order.

    Used keys of a graph: ``name`` (or ``frame_id``), ``time_ns`` or ``t`` (s), and ``ego`` (the id of a node).
    Of a node: ``kind``, ``base_class`` or ``label``, ``is_ego``, and the node attributes of sgstore in the same
    units. Of an edge: ``relation``, ``label``, ``type`` or its key.

    Raises
    ------
    TraceError
        The file is not JSON, not a directed node-link graph, or exceeds a limit. The message contains the line
        or graph.
    """
    for number, (where, document) in enumerate(_documents(path)):
        yield _graph(path, number, where, document)


def _documents(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield the JSON documents of a file, each with a text for messages such as ``line 2``."""
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
    """Yield the graphs in a file that is one JSON document: a single graph, or several."""
    parts = StringIO()
    values = 0
    for part in lines:
        parts.write(part)
        values += _values(part)
        if values > MAX_VALUES:
            raise wrong(path, "", _TOO_MANY)
        if parts.tell() > MAX_DOCUMENT:
            raise wrong(
                path,
                "",
                f"one JSON document of more than {MAX_DOCUMENT >> 20} Mi characters; write one graph a line",
            )
    text = parts.getvalue()
    parts.close()
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


def _values(text: str) -> int:
    """Return an upper bound for the number of values in a JSON text, without parsing the text."""
    return sum(map(text.count, "[{,"))


def _parsed(text: str) -> Any:
    """Return the content of a JSON text. An invalid or too large text raises an error.

    Raises
    ------
    ValueError
        The text is not JSON, has too many values, or is nested too deeply.
    """
    if _values(text) > MAX_VALUES:
        raise ValueError(_TOO_MANY)
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
    about = document.get("graph") or {}
    if isinstance(about, list):  # Old format of networkx: pairs.
        about = dict(pair for pair in about if isinstance(pair, list) and len(pair) == 2)
    if not isinstance(about, dict):
        raise wrong(path, where, "expected an object 'graph'")
    name = about.get("name") or about.get("frame_id") or document.get("name") or f"graph {number}"
    graph = GivenGraph(str(name)[:LONGEST], number + 1)
    graph.time_ns = _time(path, where, about)
    for row, node in enumerate(document["nodes"]):
        _add_node(path, graph, f"{where}, node {row}", node)
    ego = about.get("ego")
    if ego is not None and _text(ego) in graph.nodes:
        graph.nodes[_text(ego)].attributes["is_ego"] = True
    place = f"{where}, edge {{}}"
    for row, edge in enumerate(links):
        _add_edge(path, graph, (place, row), edge)
    check_size(path, where, graph)
    return graph


def _time(path: Path, where: str, about: dict[str, Any]) -> int | None:
    for key, unit, most in (("time_ns", 1, 1 << 62), ("t", 1e9, 4e9)):
        value = about.get(key)
        if value is None:
            continue
        if isinstance(value, str) and _WHOLE.fullmatch(value):
            value = int(value)  # 64-bit numbers are texts, because JSON readers round numbers.
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
    if not name or len(name) > LONGEST:
        raise wrong(path, where, f"expected an id of 1 to {LONGEST} characters")
    if name in graph.nodes:
        raise wrong(path, where, f"the id {name!r} comes twice")
    attributes = {key: value for key, value in node.items() if key != "id"}
    label = next((attributes[key] for key in _LABELS if isinstance(attributes.get(key), str)), "")
    graph.nodes[name] = GivenNode(name, label, where, attributes)


def _add_edge(path: Path, graph: GivenGraph, at: tuple[str, int], edge: Any) -> None:
    where = at[0].replace("{}", str(at[1]), 1)
    if not isinstance(edge, dict) or not {"source", "target"} <= edge.keys():
        raise wrong(path, where, "expected an object with 'source' and 'target'")
    src, dst = _text(edge["source"]), _text(edge["target"])
    for end in (src, dst):
        if end not in graph.nodes:
            raise wrong(path, where, f"no node {end[:80]!r} in this graph")
    told = next((key for key in (*_RELATIONS, "key") if isinstance(edge.get(key), str)), None)
    if told is None:
        raise wrong(
            path, where, f"names no relation; expected one of {', '.join(_RELATIONS)}, or a key"
        )
    skipped = {"source", "target", "key", *_RELATIONS}
    attributes = {key: value for key, value in edge.items() if key not in skipped}
    graph.edges.append(GivenEdge(src, edge[told], dst, *at, attributes or NO_ATTRIBUTES))
