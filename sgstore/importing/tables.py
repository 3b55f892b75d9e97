"""Graphs as rows, an edge each: node, edge, node. S3C's files, and CSV with a header that says what is what.

Rows of one graph stand together. In a row without relation and second node the first node stands alone.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.importing.given import GivenEdge, GivenGraph, GivenNode, wrong
from sgstore.importing.lines import lines_of
from sgstore.vocabulary import folded

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

S3C: Final = ("ds", "sg", "n_img", "t_id", "node1", "edge", "node2")
"""The header of S3C's files. (Woodlief et al., "S3C", ICSE 2024.)"""

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
"""What a column is → what it may be called."""

_IGNORED: Final = frozenset({"ds", "t_id"})
"""Columns of S3C that say nothing that a graph has: the data set, and the number of a row."""

MAX_ROWS: Final = 2_000_000
"""Most rows of one graph."""

_LONGEST: Final = 1_000
"""Longest name; characters."""


@dataclass(frozen=True, slots=True)
class _Columns:
    """Places of the columns in a row; -1: there is none."""

    graph: int
    src: int
    relation: int
    dst: int
    src_kind: int
    dst_kind: int
    src_is_ego: int
    dst_is_ego: int
    time: int
    time_ns: int
    images: int
    names: tuple[str, ...]
    lost: tuple[int, ...]


def read_s3c(path: Path) -> Iterator[GivenGraph]:
    """The graphs of a file of S3C, in its order.

    Raises
    ------
    TraceError
        Its header is another one, or a row is not what it must be.
    """
    return _read(path, S3C)


def read_csv(path: Path) -> Iterator[GivenGraph]:
    """The graphs of a CSV file: columns ``graph, src, relation, dst`` and, if they are there, others.

    These are ``src_kind``, ``dst_kind``, ``src_is_ego``, ``dst_is_ego``, ``t`` (s) or ``time_ns``, and
    ``images``. They may be called as S3C, pandas and networkx call them.

    Raises
    ------
    TraceError
        A column is missing or comes twice, or a row is not what it must be.
    """
    return _read(path, ())


def _read(path: Path, header: tuple[str, ...]) -> Iterator[GivenGraph]:
    with lines_of(path) as lines:
        reader = csv.reader(lines, strict=True)
        try:
            first = next(reader, None)
            columns = _columns_of(path, first, header)
            yield from _graphs(path, reader, columns)
        except csv.Error as error:
            raise wrong(path, f"row {reader.line_num}", f"no CSV: {error}") from error


def _columns_of(path: Path, first: list[str] | None, header: tuple[str, ...]) -> _Columns:
    if first is None:
        raise wrong(path, "", "empty; expected a header")
    names = tuple(name.strip() for name in first)
    if header and names != header:
        raise wrong(
            path,
            "row 1",
            f"expected the header of S3C, {','.join(header)}; found {','.join(names)[:200]}"
            " (another table of edges can be read with --format csv)",
        )
    places: dict[str, int] = {}
    known: set[int] = set()
    for what, words in _NAMES.items():
        found = [i for i, name in enumerate(names) if folded(name) in set(map(folded, words))]
        if len(found) > 1:
            both = " and ".join(names[i] for i in found)
            raise wrong(path, "row 1", f"columns {both} both say {what!r}; expected one")
        if not found and what in {"graph", "src", "relation", "dst"}:
            raise wrong(
                path,
                "row 1",
                f"no column {what!r} (or {', '.join(words[1:])}); found {','.join(names)[:200]}",
            )
        places[what] = found[0] if found else -1
        known.update(found)
    lost = [i for i, name in enumerate(names) if i not in known and name not in _IGNORED]
    return _Columns(**places, names=names, lost=tuple(lost))


def _graphs(path: Path, rows: Iterator[list[str]], columns: _Columns) -> Iterator[GivenGraph]:
    graph: GivenGraph | None = None
    number, many = 1, 0
    for number, row in enumerate(rows, start=2):
        if not row:
            continue
        if len(row) != len(columns.names):
            raise wrong(path, f"row {number}", f"{len(row)} columns, expected {len(columns.names)}")
        name = row[columns.graph]
        if graph is None or name != graph.name:
            if graph is not None:
                yield graph
            graph, many = _opened(path, number, row, columns), 0
        many += 1
        if many > MAX_ROWS:
            raise wrong(path, f"row {number}", f"more than {MAX_ROWS:,} rows of graph {name!r}")
        _add(path, graph, number, row, columns)
    if graph is None:
        raise wrong(path, "", "no row beside the header; expected graphs")
    yield graph


def _opened(path: Path, number: int, row: list[str], columns: _Columns) -> GivenGraph:
    """A new graph, from its first row."""
    name = row[columns.graph]
    if not name or len(name) > _LONGEST:
        where = f"row {number}, column {columns.names[columns.graph]}"
        raise wrong(path, where, f"expected the name of a graph, of 1 to {_LONGEST} characters")
    graph = GivenGraph(name, number)
    if columns.images >= 0:
        graph.images = int(_number(path, number, row, columns, columns.images, 1, 1 << 31))
    if columns.time_ns >= 0:
        place = columns.time_ns
        graph.time_ns = int(_number(path, number, row, columns, place, -(1 << 62), 1 << 62))
    elif columns.time >= 0:
        graph.time_ns = round(_number(path, number, row, columns, columns.time, -4e9, 4e9) * 1e9)
    return graph


def _number(
    path: Path, number: int, row: list[str], columns: _Columns, place: int, low: float, high: float
) -> float:
    text = row[place].strip()
    where = f"row {number}, column {columns.names[place]}"
    try:
        value = int(text) if text.lstrip("+-").isdigit() and len(text) < 20 else float(text)
    except ValueError:
        raise wrong(path, where, f"expected a number, found {text[:80]!r}") from None
    if not low <= value <= high:
        raise wrong(path, where, f"{text[:80]} is out of range")
    return value


def _add(path: Path, graph: GivenGraph, number: int, row: list[str], columns: _Columns) -> None:
    src = _node(
        path, graph, number, row, columns, (columns.src, columns.src_kind, columns.src_is_ego)
    )
    relation, dst = row[columns.relation].strip(), row[columns.dst].strip()
    for place in columns.lost:
        if row[place]:
            what = f"column {columns.names[place]}"
            graph.lost[what] = graph.lost.get(what, 0) + 1
    if not relation and not dst:
        return
    if not relation:
        where = f"row {number}, column {columns.names[columns.relation]}"
        raise wrong(path, where, "empty, beside a second node; expected a relation")
    dst = _node(
        path, graph, number, row, columns, (columns.dst, columns.dst_kind, columns.dst_is_ego)
    )
    graph.edges.append(
        GivenEdge(src, relation, dst, f"row {number}, column {columns.names[columns.relation]}")
    )


def _node(
    path: Path,
    graph: GivenGraph,
    number: int,
    row: list[str],
    columns: _Columns,
    places: tuple[int, int, int],
) -> str:
    """Take note of a node; its name."""
    place, kind_place, ego_place = places
    name = row[place].strip()
    where = f"row {number}, column {columns.names[place]}"
    if not name or len(name) > _LONGEST:
        raise wrong(path, where, f"expected the name of a node, of 1 to {_LONGEST} characters")
    label = row[kind_place].strip() if kind_place >= 0 else ""
    known = graph.nodes.get(name)
    if known is None:
        known = graph.nodes[name] = GivenNode(name, label, where)
    elif label and known.label and known.label != label:
        raise wrong(path, where, f"{name!r} is {label!r} here and {known.label!r} in {known.where}")
    else:
        known.label = known.label or label
    if ego_place >= 0 and (text := row[ego_place].strip()):
        known.attributes["is_ego"] = text.lower() in {"true", "1", "t", "yes"}
    return name
