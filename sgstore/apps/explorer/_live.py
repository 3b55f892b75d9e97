"""Web page of a running monitor: current frames, and the verdicts and matches over time.

The monitor passes each frame to a :class:`LiveRun`. It keeps the last frames as sent messages, and
the graphs of the last few seconds, so that the page can show the parts of a match around its time.
A slow reader misses frames; the monitor never waits.
"""

from __future__ import annotations

import asyncio
import base64
import math
import threading
from collections import OrderedDict, deque
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from starlette.responses import Response, StreamingResponse

from sgstore.apps.explorer._app import answered, application_of, page_of
from sgstore.apps.explorer._guard import Guard
from sgstore.apps.explorer._requests import fields_of, taken
from sgstore.apps.explorer._store_reader import drawn_map, shown_picture, told_graph
from sgstore.apps.explorer._wire import as_json, packed, told_values
from sgstore.base.json_text import finite
from sgstore.errors import QueryNameError, StoreError
from sgstore.lang.help import condition_values, why_not
from sgstore.model.vocabulary import KIND_CODE, KINDS, LIGHT_STATE_CODE, LIGHT_STATES
from sgstore.temporal import RecentGraphs

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping, Sequence

    from starlette.requests import Request

    from sgstore.apps.explorer._app import Endpoint
    from sgstore.lang.ir import Query
    from sgstore.lang.memory import FrameView
    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import SceneGraph
    from sgstore.readers import Cameras
    from sgstore.temporal import FrameTime, Monitor, MonitorEvent, Verdict

    Things = Mapping[int, Mapping[str, Any]]

MOST_FRAMES: Final = 3000
"""Largest number of frames kept for pages opened later. A second limit applies to their bytes."""
MOST_BYTES: Final = 32 << 20

MOST_NAMES: Final = 20_000
"""Largest number of entities whose names are kept."""

LOOK_S: Final = 0.02
"""Interval at which the page is checked for new frames; s."""

_STATES: Final = {
    **dict.fromkeys(("x", "y"), np.float64),  # so that places equal those of a store
    **dict.fromkeys(("heading", "speed", "length", "width"), np.float32),
    "node": np.int32,
    **dict.fromkeys(("kind", "ego", "light"), np.uint8),
}
_NO_LIGHT: Final = len(LIGHT_STATES)
_OF_EVENTS: Final = "kind", "name", "nodes", "names", "values"

ASKED: Final = {
    "GET /api/store": ("about",),
    "GET /api/map": ("map",),
    "GET /api/frame": ("frame", "seq"),
    "GET /api/series": ("series", "attribute", "node", "other"),
    "GET /api/picture": ("picture", "seq", "channel"),
    "POST /api/parts": ("parts", "text", "binding"),
    "POST /api/values": ("values", "text", "seq", "binding"),
    "POST /api/why": ("why", "text", "seq"),
}
"""Request of the page → method of :class:`LiveRun`, and fields of the request."""


class LiveRun:
    """Messages of a running monitor for its web page, with the most recent frames and graphs.

    Parameters
    ----------
    name : str
        Name of the recording, or of the world.
    road_map : RoadMap, optional
    cameras : Cameras, optional
        Source of the pictures of frames.
    """

    def __init__(self, name: str, road_map: RoadMap | None, cameras: Cameras | None = None) -> None:
        self.name = name
        self._cameras = cameras
        self._map = drawn_map(road_map)
        self._has_map = road_map is not None
        self._lock = threading.Lock()
        self._monitor: Monitor | None = None
        self._sent: deque[bytes] = deque()
        self._gone = self._bytes = 0
        self._recent = RecentGraphs()
        self._names: OrderedDict[int, list[str]] = OrderedDict()
        self._still: dict[int, list[Any]] = {}
        self._events: list[dict[str, Any]] = []
        self._origin: tuple[float, float] | None = None
        self._stopped = False

    def follow(self, monitor: Monitor) -> None:
        """Set the monitor whose data the page shows; required before the first frame."""
        self._monitor = monitor

    def event(self, event: MonitorEvent) -> None:
        """Add an event of the monitor, which is sent to the page with the next frame."""
        told = {name: getattr(event, name) for name in _OF_EVENTS}
        told |= {"first": event.start.seq, "start": event.start.t}
        told |= {"last": event.end.seq, "end": event.end.t}
        with self._lock:
            self._events.append(finite(told))

    def step(self, here: FrameTime, graphs: Sequence[SceneGraph]) -> None:
        """Send a frame and its events to the page. With several egos, the page shows the first one."""
        graph, monitor = graphs[0], self._monitor
        with self._lock:
            if self._origin is None:
                self._origin = _origin_of(graph)
            things = {node: about for node, about in graph.nodes.items() if node >= 0}
            header = {"seq": here.seq, "t": here.t, "origin": self._origin, "events": self._events}
            header |= {"ego": -1 if graph.ego is None else graph.ego}
            header |= {"names": self._new_names(things), "still": self._new_still(things)}
            header |= {"status": {} if monitor is None else monitor.status}
            self._events = []
            data = packed(header, _columns(things, graph.ego, self._origin))
            self._put("frame", base64.b64encode(data))
            self._recent.add(here, graph, self.name if monitor is None else monitor.trace)

    def end(self, verdicts: Sequence[Verdict]) -> None:
        """Send the verdicts of all checks to the page, after the last frame."""
        with self._lock:
            listed = [[one.check, one.verdict, len(one.violations), one.reason] for one in verdicts]
            told = {"verdicts": listed, "events": self._events}
            self._put("end", as_json(told))

    def stop(self) -> None:
        """End the message streams of all pages."""
        self._stopped = True

    def _put(self, event: str, data: bytes) -> None:
        message = b"event: " + event.encode() + b"\ndata: " + data + b"\n\n"
        self._sent.append(message)
        self._bytes += len(message)
        while len(self._sent) > MOST_FRAMES or (self._bytes > MOST_BYTES and len(self._sent) > 1):
            self._bytes -= len(self._sent.popleft())
            self._gone += 1

    def _new_names(self, things: Things) -> dict[int, list[str]]:
        new = {node: about for node, about in things.items() if node not in self._names}
        found = {node: [a["kind"], a.get("ident", ""), ""] for node, a in new.items()}
        self._names |= found
        while len(self._names) > MOST_NAMES:
            self._names.popitem(last=False)
        return found

    def _new_still(self, things: Things) -> list[list[Any]]:
        """Return the static entities not sent yet (position, heading, size), and mark them as sent."""
        x, y = self._origin or (0.0, 0.0)
        new = [n for n, about in things.items() if about["is_static"] and n not in self._still]
        for node in new:
            about = things[node]
            place = about.get("x", math.nan) - x, about.get("y", math.nan) - y
            turned = math.radians(about.get("heading", 0.0))
            size = about.get("length"), about.get("width")
            self._still[node] = finite([node, KIND_CODE[about["kind"]], *place, turned, *size])
        return [self._still[node] for node in new]

    def about(self) -> dict[str, Any]:
        """Return a description of the run for the page, as if the run was a store with one trace."""
        key, cameras = "live" * self._has_map, [] if self._cameras is None else self._cameras.topics
        trace = {"name": self.name, "frames": 0, "seconds": 0.0, "period": 0.0, "map": ""}
        trace |= {"map_key": key, "origin": self._origin or (0.0, 0.0), "cameras": [*cameras]}
        names, checks = (), []
        if self._monitor is not None:
            names, checks = self._monitor.names, [*self._monitor.status]
        patterns = [name for name in names if name not in checks]
        codes = {"kind": list(KINDS), "light": [*LIGHT_STATES, "unknown"]}
        told = {"store": self.name, "traces": [trace], "codes": codes, "other": None}
        return {**told, "writing": False, "checks": checks, "patterns": patterns}

    def map(self) -> bytes:
        """Return the outlines of the road map as bytes; empty if the run has no map."""
        return self._map

    def parts(self, text: str, binding: Mapping[str, int] | None) -> dict[str, Any]:
        """For one match, return for each part of the pattern the recent frames in which that part is true.

        Raises
        ------
        QueryNameError
            The pattern is unknown, or has no such variable.
        """
        query = self._query(text)
        with self._lock:
            match = self._recent.match(text, query, binding or {})
            known = [max(self._gone, match.begun), match.seen]
            return {**match.lanes(self.name, self._gone).as_dict(), "known": known}

    def series(self, attribute: str, node: int, other: int | None = None) -> bytes:
        """Return the values of an attribute in the recent frames, as binary columns.

        Raises
        ------
        StoreError
            The attribute is unknown.
        """
        with self._lock:
            columns = self._recent.curve(attribute, node, other).columns()
        return packed({"trace": self.name, "attribute": attribute}, columns)

    def picture(self, seq: int, channel: str) -> tuple[bytes, str]:
        """Return the camera picture of a frame, with its media type; empty if no picture is recorded.

        Raises
        ------
        StoreError
            The camera is unknown.
        ExportError
            The message has no picture that browsers can show.
        """
        if self._cameras is None or channel not in self._cameras.topics:
            raise StoreError(f"no camera {channel!r}")
        return shown_picture(self._cameras.at(seq, channel), channel)

    def frame(self, seq: int) -> dict[str, Any]:
        """Return the scene graph of a recent frame as JSON values.

        Raises
        ------
        StoreError
            The graph of this frame is no longer kept.
        """
        return told_graph(self._kept(seq).graph)

    def values(self, text: str, seq: int, binding: Mapping[str, int] | None) -> dict[str, Any]:
        """Return the values in the conditions of a pattern in a recent frame, as JSON values.

        Raises
        ------
        QueryNameError
            The pattern is unknown, or has no such variable.
        StoreError
            The graph of this frame is no longer kept.
        """
        return told_values(condition_values(self._query(text), self._kept(seq), binding or {}))

    def why(self, text: str, seq: int) -> dict[str, Any]:
        """Return the first part of a pattern that fails in a recent frame, as JSON values.

        Raises
        ------
        QueryNameError
            The pattern is unknown.
        StoreError
            The graph of this frame is no longer kept.
        """
        return why_not(self._query(text), self._kept(seq)).as_dict()

    def _query(self, name: str) -> Query:
        queries = self._monitor.patterns if self._monitor is not None else {}
        if name not in queries:
            raise QueryNameError(f"no pattern {name!r} is watched")
        return queries[name]

    def _kept(self, seq: int) -> FrameView:
        with self._lock:
            return self._recent.view(seq)

    def _hello(self) -> tuple[int, bytes]:
        """Return the number of the oldest stored message, and the first message that a new page receives."""
        with self._lock:
            told = {"about": self.about(), "names": self._names, "still": [*self._still.values()]}
            return self._gone, b"event: hello\ndata: " + as_json(told) + b"\n\n"

    def _since(self, number: int) -> tuple[int, list[bytes]]:
        """Return the stored messages with this number or a later one, and the number of the next message."""
        with self._lock:
            found = list(islice(self._sent, max(number - self._gone, 0), None))
            return self._gone + len(self._sent), found

    async def messages(self) -> AsyncIterator[bytes]:
        """Yield server-sent events for the page: first all stored messages, then each new frame."""
        number, hello = self._hello()
        yield hello
        while not self._stopped:
            number, found = self._since(number)
            if found:
                yield b"".join(found)
            await asyncio.sleep(LOOK_S)


def live_application(run: LiveRun, token: str, hosts: tuple[str, ...], cookie: str) -> Guard:
    """Return the ASGI application with the page of a monitor. Each request must have a token."""

    async def ask(request: Request, name: str, fields: Sequence[str]) -> Response:
        told = taken(await fields_of(request), *fields)
        return answered(await asyncio.to_thread(partial(getattr(run, name), **told)))

    async def live(_: Request) -> Response:
        return StreamingResponse(run.messages(), media_type="text/event-stream")

    table: list[tuple[str, Endpoint]] = [
        ("GET /", partial(page_of, script="live.js")),
        ("GET /api/live", live),
        *((where, partial(ask, name=name, fields=told)) for where, (name, *told) in ASKED.items()),
    ]
    return Guard(application_of(table), token, hosts, cookie)


def _columns(things: Things, ego: int | None, origin: tuple[float, float]) -> dict[str, Any]:
    """Return the states of the moving entities in a frame as columns for the page."""
    moving = {node: about for node, about in things.items() if not about["is_static"]}
    columns = {name: [a.get(name, math.nan) for a in moving.values()] for name in _STATES}
    for name, place in zip("xy", origin, strict=True):
        columns[name] = [value - place for value in columns[name]]
    columns["heading"] = [math.radians(degrees) for degrees in columns["heading"]]
    columns["node"] = [*moving]
    columns["ego"] = [node == ego for node in moving]
    columns["kind"] = [KIND_CODE[about["kind"]] for about in moving.values()]
    lights = [about.get("light_state", "") for about in moving.values()]
    columns["light"] = [LIGHT_STATE_CODE.get(light, _NO_LIGHT) for light in lights]
    return {name: np.array(columns[name], type_) for name, type_ in _STATES.items()}


def _origin_of(graph: SceneGraph) -> tuple[float, float]:
    """Return the origin of the page's coordinates: a point near the entities, in whole metres."""
    places = [a for n, a in graph.nodes.items() if n >= 0]
    first = graph.nodes[graph.ego] if graph.ego is not None else next(iter(places), {})
    return float(round(first.get("x", 0.0))), float(round(first.get("y", 0.0)))
