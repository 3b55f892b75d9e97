"""Graphs as rows (node, edge, node), under the header that S3C's scripts read.

The header is ``ds, sg, n_img, t_id, node1, edge, node2``.
``ds`` is the trace, ``sg`` the frame as ``trace#seq``, ``n_img`` is 1 (every frame stands for itself), ``t_id``
counts the rows of a graph. Graphs are as the abstraction ``RSV`` has them, which is S3C's ELR, or as another
one does. A node without any edge stands in no row: such nodes are counted as a loss. Labels have a file of
their own, because the header has no room for them.

Source: S3C (Woodlief et al., ICSE 2024), its data sets of triples; "ELR" of its section 3.
"""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import ExportError
from sgstore.exporters._clips import WrittenFile
from sgstore.mcap import Loss
from sgstore.store import FrameSpans

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.exporters._labels import ClipFrames, Export


HEADER: Final = ("ds", "sg", "n_img", "t_id", "node1", "edge", "node2")
GRAPHS: Final = "graphs.csv"
LABELS: Final = "labels.csv"
BY_ITSELF: Final = "RSV"
"""The abstraction without another one."""


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write the rows, and read them again."""
    spans = FrameSpans(export.store.file, export.abstraction or BY_ITSELF)
    rows = alone = 0
    with (folder / GRAPHS).open("x", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(HEADER)
        for frames in export.fresh_windows():
            for name, nodes, edges in _graphs(frames, spans):
                ends = {end for src, _, dst in edges for end in (src, dst)}
                alone += len(nodes.keys() - ends)
                for number, (src, label, dst) in enumerate(edges):
                    writer.writerow((frames.clip.trace, name, 1, number, src, label, dst))
                rows += len(edges)
    reason = f"{alone} nodes without an edge stand in no row"
    losses = [Loss(reason, 0, 0)] if alone else []
    _test(folder / GRAPHS, rows)
    written = [WrittenFile.of(folder / GRAPHS, "rows", rows, losses)]
    if export.labels is not None:
        written.append(_write_labels(export, folder / LABELS))
    return written


def _graphs(
    frames: ClipFrames, spans: FrameSpans
) -> Iterator[tuple[str, dict[str, str], list[tuple[str, str, str]]]]:
    """Names of frames, and their nodes and edges by names."""
    found, _, labelled = spans.labelled(**frames.bounds)
    number = {seq: i for i, seq in enumerate(found.tolist())}
    for seq in frames.seq.tolist():
        yield f"{frames.clip.trace}#{seq}", *labelled.named(number[seq])


def _write_labels(export: Export, file: Path) -> WrittenFile:
    names = list(export.labels.texts) if export.labels is not None else []
    count = 0
    with file.open("x", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(("sg", *names))
        for frames in export.fresh_windows():
            columns = export.label_columns(frames.frame_id)
            for row, seq in enumerate(frames.seq.tolist()):
                cells = (_cell(columns[one][row]) for one in names)
                writer.writerow((f"{frames.clip.trace}#{seq}", *cells))
            count += len(frames)
    return WrittenFile.of(file, "labels", count)


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else value


def _test(file: Path, rows: int) -> None:
    with file.open(encoding="utf-8", newline="") as stream:
        reader = csv.reader(stream)
        header = tuple(next(reader))
        found = sum(len(row) == len(HEADER) for row in reader)
    if header != HEADER or found != rows:
        raise ExportError(f"{file.name}: {rows} rows were written, {found} are read back")
