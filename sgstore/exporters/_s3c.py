"""Export format S3C: edges as CSV rows (node, edge, node), with the header that S3C's scripts expect.

The header is ``ds, sg, n_img, t_id, node1, edge, node2``. ``ds`` is the trace, ``sg`` the frame as
``trace#seq``, ``n_img`` is 1 (every frame counts once), ``t_id`` counts the rows of a graph. Graphs
follow the abstraction ``RSV``, which is S3C's ELR, or another one. A node without edges has no row:
a note counts such nodes. Labels have their own file, because the header has no room for
them.

Source: S3C (Woodlief et al., ICSE 2024), its data sets of triples; "ELR" of its section 3.
"""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING, Final

from sgstore.base.display import number_of
from sgstore.errors import ExportError
from sgstore.exporters._clips import WrittenFile
from sgstore.graphs.abstractions import abstraction_named

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.exporters._clip_frames import Export


HEADER: Final = ("ds", "sg", "n_img", "t_id", "node1", "edge", "node2")
GRAPHS: Final = "graphs.csv"
LABELS: Final = "labels.csv"
BY_ITSELF: Final = "RSV"
"""Name of the default abstraction."""


def write(export: Export, folder: Path) -> list[WrittenFile]:
    """Write the edges of all graphs as CSV rows, and verify the file by reading it again."""
    abstraction = abstraction_named(export.abstraction or BY_ITSELF).name
    rows = alone = 0
    with (folder / GRAPHS).open("x", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(HEADER)
        for frames in export.fresh_windows():
            trace, graphs = frames.clip.trace, export.named_graphs(frames, abstraction)
            for seq, (nodes, edges) in zip(frames.seq.tolist(), graphs, strict=True):
                ends = {end for src, _, dst in edges for end in (src, dst)}
                alone += len(nodes.keys() - ends)
                for number, edge in enumerate(edges):
                    writer.writerow((trace, f"{trace}#{seq}", 1, number, *edge))
                rows += len(edges)
    reason = f"{number_of(alone, 'node')} without an edge in no row: rows of S3C are edges"
    _test(folder / GRAPHS, rows)
    notes = [reason] if alone else []
    written = [WrittenFile.of(folder / GRAPHS, "rows", rows, notes=notes)]
    if export.labels is not None:
        written.append(_write_labels(export, folder / LABELS))
    return written


def _write_labels(export: Export, file: Path) -> WrittenFile:
    names = list(export.labels.texts) if export.labels is not None else []
    count = 0
    with file.open("x", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(("sg", *names))
        for frames in export.fresh_windows():
            cells = export.label_cells(frames.frame_id)
            for seq, labels in zip(frames.seq.tolist(), cells, strict=True):
                writer.writerow((f"{frames.clip.trace}#{seq}", *labels))
            count += len(frames)
    return WrittenFile.of(file, "labels", count)


def _test(file: Path, rows: int) -> None:
    with file.open(encoding="utf-8", newline="") as stream:
        reader = csv.reader(stream)
        header = tuple(next(reader))
        found = sum(len(row) == len(HEADER) for row in reader)
    if header != HEADER or found != rows:
        raise ExportError(f"{file.name}: {rows} rows were written, {found} are read back")
