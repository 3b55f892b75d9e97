"""Reader of a store for the web page: states, maps, pictures and graphs, by trace and frame.

:data:`READS` has their fields.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from sgstore.apps.explorer._requests import RequestError
from sgstore.apps.explorer._wire import packed
from sgstore.base.json_text import finite
from sgstore.errors import ExportError, SgstoreError, StoreError
from sgstore.lang.help import words
from sgstore.lang.library import patterns, search
from sgstore.maps.opendrive import read_map
from sgstore.maps.roads import DrawnOutlines
from sgstore.store import StateColumns

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import SceneGraph
    from sgstore.query import Store
    from sgstore.readers import Media
    from sgstore.store import StoredTrace

T = TypeVar("T")

MOST_THUMBS: Final = 400
"""Largest number of frames in one request for thumbnails."""

READS: Final[Mapping[str, tuple[str, ...]]] = {
    "words": (),
    "library": (),
    "search": ("text",),
    "states": ("trace", "first", "last"),
    "static": ("trace",),
    "map": ("trace",),
    "frame": ("trace", "seq"),
    "picture": ("trace", "seq", "channel"),
    "series": ("trace", "attribute", "node", "other"),
    "thumbs": ("frames",),
}
"""Names of methods of :class:`Reads` that the page can call → fields of the request."""

_PICTURES: Final = "jpeg", "png", "webp", "bmp"
"""Picture formats that browsers can show."""


class Reads:
    """Reader of one store for the web page.

    Parameters
    ----------
    store : Store
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._known: tuple[dict[str, StoredTrace], dict[str, Any]] | None = None
        self._maps: dict[str, bytes] = {}
        self._reading, self._looking = threading.Lock(), threading.Lock()

    def _traces(self) -> tuple[dict[str, StoredTrace], dict[str, Any]]:
        """Return the traces of the store by name, and its description for the page. Both are cached."""
        with self._looking:  # after a change one thread reads, and the others wait
            stamp = self._store.file.stamp
            if self._known is None or self._known[1]["stamp"] != stamp:
                with self._store.file.snapshot():
                    traces = {one.name: one for one in self._store.traces()}
                    self._known = traces, self._told(traces) | {"stamp": stamp}
            return self._known

    def _told(self, traces: dict[str, StoredTrace]) -> dict[str, Any]:
        file, places = self._store.file, StateColumns(self._store.file).places()
        listed: list[dict[str, Any]] = []
        for name, one in traces.items():
            x, y, digest, cameras = places[name]
            about = {"name": name, "frames": one.frames, "period": one.period_ns / 1e9}
            about |= {"seconds": one.seconds, "map": one.map}
            listed.append(about | {"map_key": digest[:16], "origin": (x, y), "cameras": cameras})
        about = {"store": file.path.name, "path": str(file.path.absolute())}
        return {**about, "traces": listed, "codes": StateColumns(file).codes()}

    def about(self) -> dict[str, Any]:
        """Return a description of the store: its traces, and the names of kinds and lights by their code."""
        return self._traces()[1]

    def frame_id(self, trace: str, seq: int) -> int:
        """Return the id of a frame, from its trace and its number.

        Raises
        ------
        StoreError
            The trace or frame is unknown.
        """
        self._trace(trace)
        return self._store.file.frame(f"{trace}#{seq}").frame_id

    def _trace(self, name: str) -> StoredTrace:
        return _among(self._traces()[0], name)

    def thumbs(self, frames: Sequence[tuple[str, int]]) -> bytes:
        """Return the states of all entities in the given frames as bytes, to draw thumbnails."""
        if len(frames) > MOST_THUMBS:
            raise RequestError(f"frames: expected at most {MOST_THUMBS}")
        traces = self._traces()[0]  # read once, because the store may change
        of = [(_among(traces, trace).trace_id, seq) for trace, seq in frames]
        return packed({}, StateColumns(self._store.file).states_at(of))

    def states(self, trace: str, first: int, last: int) -> bytes:
        """Return the states of all entities in a range of frames, as binary columns."""
        of, columns = self._trace(trace).trace_id, StateColumns(self._store.file)
        with self._store.file.snapshot():
            frames, states = columns.frames(of, first, last), columns.states(of, first, last)
        # Start of the states of each frame, so that the page need not search.
        start = np.searchsorted(states.pop("seq"), [*frames["seq"].tolist(), 1 << 31])
        found = {f"frame.{name}": column for name, column in frames.items() if name != "t"}
        found["frame.start"] = start.astype(np.uint32)
        return packed({"trace": trace, "first": first, "last": last}, found | states)

    def static(self, trace: str) -> bytes:
        """Return the static entities of a trace, all names of entities, and all times of frames, as bytes."""
        of, columns = self._trace(trace), StateColumns(self._store.file)
        with self._store.file.snapshot():
            names, found = columns.names(of.trace_id), columns.scenery(of.trace_id)
            found["t"] = columns.frames(of.trace_id, 0, of.frames - 1)["t"]
        return packed({"trace": trace, "names": names}, found)

    def map(self, trace: str) -> bytes:
        """Return the outlines of the road map of a trace as bytes; empty if the trace has no map."""
        key = _among(StateColumns(self._store.file).places(), trace)[2]
        with self._reading:  # one map at a time, so that it is not read twice
            if key not in self._maps:
                found = self._store.file.road_map_text(trace)
                self._maps[key] = drawn_map(None if found is None else read_map(found[1], found[0]))
            return self._maps[key]

    def warm(self, ended: threading.Event) -> None:
        """Read all road maps of the store in advance, until the event ``ended`` is set."""
        with suppress(SgstoreError):
            for trace in self._traces()[0]:
                if ended.is_set():
                    return
                self.map(trace)

    def series(self, trace: str, attribute: str, node: int, other: int | None) -> bytes:
        """Return the values of an attribute of one or two entities over time, as bytes."""
        columns = StateColumns(self._store.file).series(
            self._trace(trace).trace_id, attribute, node, other
        )
        return packed({"trace": trace, "attribute": attribute}, columns)

    def frame(self, trace: str, seq: int) -> dict[str, Any]:
        """Return the scene graph of a frame: all attributes of its nodes and edges."""
        return told_graph(self._store.file.graph(self.frame_id(trace, seq)))

    def picture(self, trace: str, seq: int, channel: str) -> tuple[bytes, str]:
        """Return the recorded camera picture of a frame, with its media type.

        Raises
        ------
        ExportError
            The message has no picture that browsers can show.
        """
        return shown_picture(self._store.file.carried(self.frame_id(trace, seq), channel), channel)

    def words(self) -> dict[str, Any]:
        """Return the words of the query language that the editor completes."""
        return words(self._store.catalog())

    def library(self) -> list[dict[str, Any]]:
        """Return the patterns of the library, each with a drawing."""
        names = ("name", "kind", "text", "sentence", "library", "source")
        return [
            {name: getattr(one, name) for name in names} | {"drawing": one.example}
            for one in patterns().values()
        ]

    def search(self, text: str) -> list[str]:
        """Return the names of the library patterns that match a text, best match first."""
        return [one.name for one in search(text)]


def _among(traces: Mapping[str, T], name: str) -> T:
    """Return the entry of a trace in a mapping. Raise an error for an unknown trace."""
    if name not in traces:
        raise StoreError(f"no trace {name!r} in the store")
    return traces[name]


def shown_picture(media: Media | None, channel: str) -> tuple[bytes, str]:
    """Return a picture that browsers can show, and its media type; empty if no picture is recorded."""
    if media is None:
        return b"", "application/octet-stream"
    if media.form not in _PICTURES:
        raise ExportError(f"{channel}: the message holds {media.form}, no picture")
    return media.data, f"image/{media.form}"


def drawn_map(road_map: RoadMap | None) -> bytes:
    """Return the outlines of a road map as bytes; empty if the map is missing."""
    if road_map is None:
        return packed({"origin": [0, 0], "words": []}, {})
    drawn = DrawnOutlines.of(road_map)
    names = ("x", "y", "start", "node", "word", "closed")
    columns = {name: getattr(drawn, name) for name in names}
    columns |= {f"arrow.{name}": drawn.arrows[:, i] for i, name in enumerate(("x", "y", "angle"))}
    return packed({"origin": drawn.origin, "words": drawn.words}, columns)


def told_graph(graph: SceneGraph) -> dict[str, Any]:
    """Return all attributes of the nodes and edges of a scene graph, as JSON values."""
    nodes = [{"id": node, **about} for node, about in graph.nodes.items()]
    edges = [
        {"src": src, "relation": relation, "dst": dst, **about}
        for src, relation, dst, about in graph.edges
    ]
    return finite({"nodes": nodes, "edges": edges})
