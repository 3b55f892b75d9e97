"""Features of labelled graphs, to compute similarity: counts of node labels and of edges.

The weighted Jaccard index (Ruzicka's similarity) compares two graphs as multisets of features:
``sum(min) / sum(max)`` over the counts. It is 1 for isomorphic graphs, and for few others; 0
without common features.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.tables import spread
from sgstore.graphs.abstractions._columns import Labelled, found
from sgstore.model.vocabulary import kinds_labelled, normalize_name, relation_named

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from sgstore.model.world import Bools, Ints


@dataclass(frozen=True, eq=False)
class GraphFeatures:
    """Counts of features in many graphs. A feature is a node label, or an edge with the labels of its ends.

    Attributes
    ----------
    frames : int
    texts : tuple of str
        The features, such as ``car`` and ``(car)-[near]->(ego)``.
    frame, feature, count : (K,) int64
        Frame, index into ``texts``, and count.
    """

    frames: int
    texts: tuple[str, ...]
    frame: Ints
    feature: Ints
    count: Ints

    @classmethod
    def of(cls, graphs: Labelled) -> GraphFeatures:
        """Count the features (node labels and edges) of labelled graphs."""
        label = graphs.node_label.astype(np.int64)
        frame, src, edge, dst = _single(graphs)
        ends = [label[found(graphs.node_frame, graphs.node, frame, end)] for end in (src, dst)]
        many = len(graphs.labels)
        codes = (ends[0] * many + edge) * many + ends[1] + many  # above the codes of nodes
        cells = np.concatenate([graphs.node_frame, frame]), np.concatenate([label, codes])
        kinds, feature = np.unique(cells[1], return_inverse=True)
        cell, count = np.unique(cells[0] * max(len(kinds), 1) + feature, return_counts=True)
        at, feature = np.divmod(cell, max(len(kinds), 1))
        texts = tuple(_text(code, graphs.labels) for code in kinds.tolist())
        return cls(graphs.frames, texts, at, feature, count)

    def counts(self, number: int) -> Counter[str]:
        """Return how often each feature (node label or edge) occurs in one frame's graph."""
        rows = np.flatnonzero(self.frame == number)
        names = (self.texts[i] for i in self.feature[rows].tolist())
        return Counter(dict(zip(names, self.count[rows].tolist(), strict=True)))

    def likeness(self, example: Counter[str]) -> NDArray[np.float64]:
        """Return the similarity (weighted Jaccard index) of each frame to an example, (frames,)."""
        wanted = np.array([example[text] for text in self.texts] or [0])
        both = np.minimum(self.count, wanted[self.feature])
        shared = np.bincount(self.frame, both, self.frames)
        either = example.total() + np.bincount(self.frame, self.count, self.frames) - shared
        return np.divide(shared, either, out=np.ones(self.frames), where=either > 0)

    def digests(self) -> NDArray[np.uint64]:
        """Return a hash of each frame's counts of node labels and edges, (frames,); equal for equal counts."""
        hashes = [blake2b(text.encode(), digest_size=8).digest() for text in self.texts]
        mixed = np.frombuffer(b"".join(hashes) or bytes(8), "<u8").astype(np.uint64)
        sums = np.zeros(self.frames, np.uint64)
        np.add.at(sums, self.frame, mixed[self.feature] * self.count.astype(np.uint64))
        return sums


def without(graphs: Labelled, ignored: Iterable[str]) -> Labelled:
    """Remove all nodes and edges with given labels from labelled graphs, and the edges of removed nodes.

    Parameters
    ----------
    graphs : Labelled
    ignored : iterable of str
        Labels, kinds, words for several kinds (``vehicle``), relations; case-insensitive. ``lane``
        represents all labels that contain it (``Ego Lane``).
    """
    names = list(ignored)
    dropped = np.array([_ignored(label, names) for label in graphs.labels] or [False])
    if not dropped.any():
        return graphs
    kept = ~dropped[graphs.node_label]
    nodes = graphs.node_frame[kept], graphs.node[kept]
    frame, src, label, dst = _single(graphs)
    ends = [found(*nodes, frame, end) >= 0 for end in (src, dst)]
    there = ends[0] & ends[1] & ~dropped[label]
    return replace(
        graphs,
        node_frame=nodes[0],
        node=nodes[1],
        node_label=graphs.node_label[kept],
        frame=frame[there],
        src=src[there],
        label=label[there].astype(np.int32),
        dst=dst[there],
        bundles=(),
    )


def of_frames(graphs: Labelled, chosen: Bools) -> Labelled:
    """Return the labelled graphs with an empty graph for each frame that is not in ``chosen``."""
    nodes, edges = chosen[graphs.node_frame], chosen[graphs.frame]
    return replace(
        graphs,
        node_frame=graphs.node_frame[nodes],
        node=graphs.node[nodes],
        node_label=graphs.node_label[nodes],
        frame=graphs.frame[edges],
        src=graphs.src[edges],
        label=graphs.label[edges],
        dst=graphs.dst[edges],
    )


def _single(graphs: Labelled) -> tuple[Ints, Ints, Ints, Ints]:
    """Return a row for each label of each edge: frame, source, label, destination."""
    label = graphs.label.astype(np.int64)
    if not graphs.bundles:
        return graphs.frame, graphs.src, label, graphs.dst
    flat = np.array([one for bundle in graphs.bundles for one in bundle], np.int64)
    many = np.array([len(bundle) for bundle in graphs.bundles])
    starts = np.cumsum(many) - many
    bundle = np.where(label < 0, -1 - label, 0)
    count = np.where(label < 0, many[bundle], 1)
    edge, place = spread(starts[bundle], count)
    bundled = label[edge] < 0
    single = label[edge]
    single[bundled] = flat[place[bundled]]
    return graphs.frame[edge], graphs.src[edge], single, graphs.dst[edge]


def _text(code: int, labels: Sequence[str]) -> str:
    many = len(labels)
    if code < many:
        return labels[code]
    code, dst = divmod(code - many, many)
    src, edge = divmod(code, many)
    return f"({labels[src]})-[{labels[edge]}]->({labels[dst]})"


def _ignored(label: str, names: list[str]) -> bool:
    whole, words = (
        normalize_name(label.replace(" ", "_")),
        {normalize_name(word) for word in label.split()},
    )
    for name in names:
        meant = {normalize_name(one) for one in (name, *(kinds_labelled(name) or ()))}
        meant |= {normalize_name(relation_named(name) or name)}
        if whole in meant or (whole not in _EXACT and words & meant & _PLACES):
            return True
    return False


_PLACES: Final = frozenset({"lane", "road", "junction", "crosswalk"})
"""Regular expression of labels of map parts, such as ``Left 1 of Ego Lane``."""

_EXACT: Final = frozenset({"offroad"})
