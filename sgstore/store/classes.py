"""The classes of frames in each abstraction: on their way into a store, and made when asked for.

Classes are masks like edges: one row for each class of a bucket, because driving repeats itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.abstractions import AT_INGEST, Classes, Grounds, Seen, abstraction_named
from sgstore.store.packing import masks_of, texts, trace_bucket
from sgstore.world import BUCKET_FRAMES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.graph import GraphBlock
    from sgstore.roads import RoadMap
    from sgstore.store.packing import Columns
    from sgstore.world import Codes, Ints


class TraceClasses:
    """Classes of the frames of one trace, block by block.

    Parameters
    ----------
    road_map : RoadMap or None
        What the graphs lie on.
    names : sequence of str
        Abstractions.
    """

    def __init__(self, road_map: RoadMap | None, names: Sequence[str] = AT_INGEST) -> None:
        self._grounds = None if road_map is None else Grounds.of(road_map)
        self._of = [(abstraction_named(name), Classes()) for name in names]

    def columns(self, graph: GraphBlock, trace_id: int, kinds: Codes) -> Columns:
        """Table ``frame_class``.

        Parameters
        ----------
        graph : GraphBlock
        trace_id : int
        kinds : int8
            Kinds of the entities of the trace so far, by node id.
        """
        seen = Seen.of(graph, kinds, self._grounds)
        return self.of_seen(seen, trace_id, graph.frames.seq)

    def of_seen(self, seen: Seen, trace_id: int, seq: Ints) -> Columns:
        """The same of what has been read of some frames; ``seq`` are their numbers."""
        rows: list[tuple[str, str]] = []
        buckets: list[Ints] = []
        masks: list[Ints] = []
        for abstraction, classes in self._of:
            names = classes.of(abstraction.function(seen))
            number = {name: i for i, name in enumerate(dict.fromkeys(names))}
            code = np.array([number[name] for name in names], np.int64)
            bucket = trace_bucket(trace_id, seq)
            first, mask = masks_of((bucket, code), seq % BUCKET_FRAMES)
            rows += [(abstraction.name, names[row]) for row in first.tolist()]
            buckets.append(bucket[first])
            masks.append(mask)
        return {
            "abstraction": texts(abstraction for abstraction, _ in rows),
            "class": texts(name for _, name in rows),
            "bucket": np.concatenate(buckets),
            "mask": np.concatenate(masks),
        }
