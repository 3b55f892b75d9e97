"""Online monitor of checks and patterns, and the sources of its frames.

The frames are from a recording, replayed as if live, or from a running CARLA.
"""

from __future__ import annotations

import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from sgstore.base.display import number_of
from sgstore.errors import QueryError, TraceError
from sgstore.graphs.online import GcPaused, replayed
from sgstore.lang.bind import (
    MOTION,
    bind_checks,
    bind_query,
    not_computed,
    of_check,
    of_query,
    without_guesses,
)
from sgstore.lang.catalog import Catalog, RelationScope, TraceFacts
from sgstore.lang.library import statement
from sgstore.lang.memory import FrameView
from sgstore.lang.sql import each_match, recorded_events
from sgstore.lang.syntax import parse
from sgstore.lang.syntax.tree import CheckClause, Define, MatchClause, parameters_in
from sgstore.model.config import Config
from sgstore.model.world import seconds_of
from sgstore.temporal._check_monitor import CheckMonitor
from sgstore.temporal._check_verdict import Verdict, within_range
from sgstore.temporal._known_range import SeenRange
from sgstore.temporal._sequence_monitor import (
    FrameTime,
    MonitorEvent,
    SequenceMonitor,
    sequence_monitor,
)
from sgstore.temporal._signal_state import StreamClock
from sgstore.temporal._topic_values import RecordedTopics, TopicMemory, topics_of
from sgstore.temporal._valuation import NodeNames, QueryCache

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence

    from sgstore.graphs.online import Frame
    from sgstore.lang.bind import Need
    from sgstore.lang.ir import BoundCheck, Query
    from sgstore.lang.syntax.tree import Statement
    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import SceneGraph
    from sgstore.readers import Cameras, Sensor
    from sgstore.temporal._robustness import Robustness


LIVE: Final = "carla://"
PORT: Final = 2000
"""Default port of a CARLA server."""


@dataclass(slots=True)
class FrameSource:
    """Source of consecutive frames, with their road map.

    Attributes
    ----------
    name : str
    road_map : RoadMap or None
    frames : iterator of Frame
        Frames; endless for a running simulator.
    warnings : list of str
        Anomalies; the list grows while frames are read.
    losses : list of str
        Unreadable data.
    live : bool
        True if frames arrive in real time.
    cameras : Cameras, optional
        Camera pictures of the frames read so far.
    topics : RecordedTopics, optional
        Topics of the recording.
    """

    name: str
    road_map: RoadMap | None
    frames: Iterator[Frame]
    warnings: list[str] = field(default_factory=list[str])
    losses: list[str] = field(default_factory=list[str])
    live: bool = False
    cameras: Cameras | None = None
    topics: RecordedTopics | None = None


@contextmanager
def opened(
    source: str,
    config: Config,
    *,
    road_map: Path | None = None,
    ego: str = "",
    sensors: Sequence[Sensor] = (),
) -> Generator[FrameSource]:
    """Open a frame source: a recording, or ``carla://host:port``.

    Parameters
    ----------
    source : str
    config : Config
    road_map : Path, optional
        Road map for a recording without a map, as for ingest.
    ego : str
        Id, role or name of the ego; empty: ego of the recording.
    sensors : sequence of Sensor
        For a running simulator: sensors attached to the ego. Their camera pictures are available.

    Raises
    ------
    TraceError
        The recording is not readable, the server is missing, or no ego exists for the sensors.
    MapError
        The map is not readable.
    """
    if source.startswith(LIVE):
        with _live(source, ego, sensors) as told:
            yield told
        return
    from sgstore.maps.map_files import Maps, lost_lanes  # searches need no maps and readers
    from sgstore.readers import RecordedCameras, on_map, open_trace

    path = Path(source)
    with ExitStack() as until, open_trace(path, ego=ego or config.ego) as trace:
        found, warnings = Maps(road_map, config.signs).of(trace.info)
        on_map(trace, found)
        trace.noise, trace.causal = config.noise, True
        cameras = RecordedCameras(trace.info.path, trace.info.channels)
        told = FrameSource(path.stem, found, iter(()), warnings, cameras=cameras)
        told.losses += [loss.reason for loss in lost_lanes(trace.info, found)]

        told.topics = topics = RecordedTopics(trace.recording, trace.blocks, until)

        def frames() -> Iterator[Frame]:
            blocks = topics.followed(cameras.followed(trace.blocks()))
            recorded = recorded_events(c.schema for c in trace.info.channels)
            yield from map(topics.on, replayed(blocks, recorded))
            told.warnings += trace.report.warnings
            told.losses += [loss.reason for loss in trace.report.losses]

        told.frames = frames()
        yield told


def paced(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield recorded frames at the speed at which they were recorded."""
    begun = first = None
    for frame in frames:
        if begun is None or first is None:
            begun, first = time.monotonic(), frame.time_ns
        wait = begun + (frame.time_ns - first) / 1e9 - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        yield frame


@contextmanager
def _live(source: str, ego: str, sensors: Sequence[Sensor]) -> Generator[FrameSource]:
    from sgstore.readers import (
        LiveCameras,
        LiveWorld,
        Sensors,
        connect,  # a large package: import on demand
    )

    try:
        where = urlsplit(source)
        host, port = where.hostname or "localhost", where.port or PORT
    except ValueError as error:
        raise TraceError(f"{source}: {error}; expected {LIVE}host:port") from error
    live = LiveWorld(connect(host, port).get_world(), ego)
    with ExitStack() as stack:
        cameras = None
        if sensors:
            attached = stack.enter_context(Sensors(live.world, live.find_ego(), [*sensors]))
            cameras = LiveCameras(attached, sensors)
        told = FrameSource(live.map_name, live.road_map, iter(()), live=True, cameras=cameras)

        def frames() -> Iterator[Frame]:
            for seq in count():
                live.world.wait_for_tick()
                frame = live.frame()
                frame.recorded = frozenset()  # CARLA sensors report no events
                told.warnings[:] = live.warnings
                if cameras is not None:
                    cameras.take(seq, frame.time_ns)
                yield frame

        told.frames = frames()
        yield told


class Monitor:
    """Online monitor of checks and patterns on a running trace.

    Parameters
    ----------
    text : str
        ``CHECK`` and ``MATCH`` statements, with the predicates that they need.
    road_map : RoadMap, optional
    config : Config, optional
    on_event : callable, optional
        Called with every event, as early as possible.
    parameters : mapping of str to value, optional
        Values of ``$name``.
    trace : str
        Name of the trace in verdicts.
    period_s : float, optional
        Time between frames, used to detect gaps; default: median of the frames seen; s.
    called : str or sequence of str
        Name of a pattern in events. Several patterns get numbers, or a name each.
    sgsm_compat : bool
        True for SGSM mode, as in :meth:`sgstore.query.Store.check`: a check is violated in a frame if the trace
        would violate it by ending there. Such a violation has no reset.
    on_step : callable, optional
        Called after the events of each frame, with its time and its graphs, one for each of :attr:`egos`.
    topics : RecordedTopics, optional
        Topics of the replayed recording: :attr:`FrameSource.topics`. By default, frames carry their messages.

    Attributes
    ----------
    generator : SceneGraphGenerator
        Generator of the graphs. It holds the graphs of the last step.
    names : tuple of str
        Names of the checks and patterns.

    Raises
    ------
    QueryError
        The text is invalid, or needs data that are unavailable online. The message gives the place.

    Notes
    -----
    If the graphs cannot have a relation (such as a lane relation without a map), a check that uses it has the
    verdict ``unknown``, and a pattern has no matches.

    Examples
    --------
    >>> monitor = sgstore.Monitor("CHECK slow: ALWAYS ego.speed < 14")
    >>> frame = sgstore.Frame(0, ego="hero")
    >>> frame.add("hero", "car", 0, 0, vx=20, vy=0)
    >>> for event in monitor.step(frame):
    ...     print(event.kind, event.name)
    violated slow
    """

    def __init__(  # noqa: PLR0913 - most have names
        self,
        text: str,
        road_map: RoadMap | None = None,
        config: Config | None = None,
        *,
        on_event: Callable[[MonitorEvent], object] | None = None,
        parameters: Mapping[str, Any] | None = None,
        trace: str = "online",
        period_s: float | None = None,
        called: str | Sequence[str] = "pattern",
        sgsm_compat: bool = False,
        on_step: Callable[[FrameTime, Sequence[SceneGraph]], object] | None = None,
        topics: RecordedTopics | None = None,
    ) -> None:
        from sgstore.sgg import SceneGraphGenerator  # searches need no generator

        config = config or Config()
        self.generator = SceneGraphGenerator(road_map, config)
        self.trace = trace
        self._on_event, self._on_step = on_event, on_step
        answers = frozenset(self.generator.answers)
        reach = RelationScope.of(config.as_dict())
        facts = TraceFacts(0, trace, "", answers, reach)
        known = topics.facts if topics is not None and "topic" in text.lower() else {}
        catalog = Catalog(traces=(facts,), online=True, topics=known)
        checks, queries = _bound(text, catalog, parameters or {})
        self._topics = TopicMemory(topics_of([*checks, *queries]))
        if topics is not None:
            topics.asked += self._topics.asked
        self._egos: list[str] = []
        self._questions: list[QueryCache] = []
        self._scopes: list[tuple[int, bool]] = []
        self._seen: list[SeenRange] = []
        around = config.range
        radius = around.radius if around.shape == "radius" else 0.0
        self._known, self._labels = max(radius, around.world), config.kinds
        self._pulse = StreamClock(None if period_s is None else round(period_s * 1e9))
        self._last: FrameTime | None = None
        self._watches: list[tuple[int, CheckMonitor, _PendingEvents]] = []
        self._unknown: dict[str, str] = {}
        for check in checks:
            reason = not_computed(check, facts)
            if not reason:
                ego, questions = self._of_scope(check.ego, world=check.world)
                watch = CheckMonitor(check, questions, self._pulse, compat=sgsm_compat)
                self._watches.append((ego, watch, _PendingEvents(of_check(check), trace)))
            else:
                self._unknown[check.name] = reason
        self._follows: list[tuple[int, SequenceMonitor, _PendingEvents]] = []
        for name, query in zip(_names(called, len(queries)), queries, strict=True):
            if query.relations <= answers or query.unknown_is_false:
                ego, questions = self._of_scope(query.ego, world=query.world)
                waiting = _PendingEvents(of_query(query) if query.steps else (), trace)
                follow = sequence_monitor(name, query, questions, self._pulse)
                self._follows.append((ego, follow, waiting))
        told = (follow.name for _, follow, _ in self._follows)
        self.names = (*(check.name for check in checks), *told)

    def __repr__(self) -> str:
        seen = 0 if self._last is None else self._last.seq + 1
        return f"<Monitor of {', '.join(self.names)} after {number_of(seen, 'frame')}>"

    def _of_scope(self, ego: str | None, *, world: bool) -> tuple[int, QueryCache]:
        """Return the query cache for an ego, and its index. ``world`` adds entities outside the graphs."""
        if (ego or "") not in self._egos:
            self._egos.append(ego or "")
        scope = self._egos.index(ego or ""), world
        if scope not in self._scopes:
            self._scopes.append(scope)
            self._questions.append(QueryCache())
            self._seen.append(SeenRange(self._known, self._labels))
        number = self._scopes.index(scope)
        return number, self._questions[number]

    def step(self, frame: Frame) -> tuple[MonitorEvent, ...]:
        """Process the next frame of the running trace, and return the new events.

        Raises
        ------
        ValueError
            The frame is inconsistent; see :meth:`sgstore.sgg.SceneGraphGenerator.steps`. It is ignored.

        Examples
        --------
        >>> monitor = sgstore.Monitor("CHECK slow: ALWAYS ego.speed < 14")
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", 0, 0, vx=20, vy=0)
        >>> [event.kind for event in monitor.step(frame)]
        ['violated']
        """
        with GcPaused():  # the graphs are freed inside
            return self._step(frame)

    def _step(self, frame: Frame) -> tuple[MonitorEvent, ...]:
        return self.look(self.generator.steps(frame, self._egos or [""]), classed=True)

    def look(
        self, graphs: Sequence[SceneGraph], *, classed: bool = False
    ) -> tuple[MonitorEvent, ...]:
        """Process the next frame from scene graphs that the caller made, and return the new events.

        Parameters
        ----------
        graphs : sequence of SceneGraph
            One graph for each of :attr:`egos`.
        classed : bool
            True for the last graphs of :attr:`generator`, which can then return their classes.

        Examples
        --------
        >>> monitor = sgstore.Monitor("CHECK slow: ALWAYS ego.speed < 14")
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", 0, 0, vx=20, vy=0)
        >>> graph = monitor.generator.step(frame)
        >>> [event.kind for event in monitor.look([graph])]
        ['violated']
        """
        here, people = self._ask(graphs, classed=classed)
        events = self._tell(here, people)
        if self._on_step is not None:
            self._on_step(here, graphs)
        return events

    def _ask(
        self, graphs: Sequence[SceneGraph], *, classed: bool = False
    ) -> tuple[FrameTime, list[NodeNames]]:
        """Run all single-frame queries on the graphs of a frame. Return its time and each graph's nodes."""
        self._pulse.step(graphs[0].time_ns)
        tick, time = self._pulse.tick, self._pulse.told(self._pulse.tick.time)
        here = FrameTime(tick.number, time, seconds_of(time - self._pulse.start))
        people: list[NodeNames] = []
        scopes = zip(self._scopes, self._questions, self._seen, strict=True)
        for (number, world), questions, seen in scopes:
            view = self._view(graphs[number], here, number if classed else None)
            view = view.in_world() if world else view
            if world:
                seen.see(view)
            people.append(NodeNames(view))
            questions.ask(view, people[-1])
        return here, people

    def _tell(self, here: FrameTime, people: list[NodeNames]) -> tuple[MonitorEvent, ...]:
        """Update the checks and patterns with the query results of a frame, and return the new events."""
        self._last = here
        found: list[MonitorEvent] = []
        for ego, watch, waiting in self._watches:
            found += waiting.passed(watch.step(here), here, people[ego])
        for ego, follow, waiting in self._follows:
            found += waiting.passed(follow.step(here, people[ego]), here, people[ego])
        return self._told(found)

    def _view(self, graph: SceneGraph, here: FrameTime, number: int | None) -> FrameView:
        frame = {"id": here.seq, "seq": here.seq, "time_ns": here.time_ns, "t": here.t}
        frame |= self._topics.values(here.time_ns, graph.topics)
        trace = {"id": 0, "name": self.trace}
        if number is None:
            return FrameView(graph, frame, trace)
        classes = partial(self.generator.class_of, number=number)
        return FrameView(graph, frame, trace, classes, partial(self.generator.roles_of, number))

    def _told(self, events: list[MonitorEvent]) -> tuple[MonitorEvent, ...]:
        if self._on_event is not None:
            for event in events:
                self._on_event(event)
        return tuple(events)

    @property
    def egos(self) -> tuple[str, ...]:
        """Ids of the monitored egos. An empty id means the ego of the frame.

        Examples
        --------
        >>> monitor = sgstore.Monitor("CHECK slow: ALWAYS ego.speed < 14")
        >>> monitor.egos
        ('',)
        """
        return tuple(self._egos)

    @property
    def patterns(self) -> dict[str, Query]:
        """Monitored patterns: name → query with resolved names.

        Examples
        --------
        >>> list(sgstore.Monitor("MATCH (v:Vehicle)", called="cars").patterns)
        ['cars']
        """
        return {follow.name: follow.query for _, follow, _ in self._follows}

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the clauses of patterns that have no effect in a monitor.

        Examples
        --------
        >>> sgstore.Monitor("MATCH (v:Vehicle) RETURN v.name ORDER BY v.name LIMIT 3").notes
        ('pattern: a monitor reports each match; ORDER BY, LIMIT have no effect',)
        """
        ignored = {name: query.result.among_rows for name, query in self.patterns.items()}
        return tuple(
            f"{name}: a monitor reports each match; {', '.join(words)} have no effect"
            for name, words in ignored.items()
            if words
        )

    @property
    def status(self) -> dict[str, str]:
        """Return the status of each check: ``true``, ``false``, ``presumably_true`` or ``presumably_false``.

        The ``presumably`` values are the verdicts if the trace ended now. The status can also be ``unknown``.

        Examples
        --------
        >>> monitor = sgstore.Monitor("CHECK slow: ALWAYS ego.speed < 14")
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", 0, 0, vx=20, vy=0)
        >>> events = monitor.step(frame)
        >>> monitor.status
        {'slow': 'false'}
        """
        known = {
            watch.name: "unknown" if waiting.reason else watch.status()
            for _, watch, waiting in self._watches
        }
        return known | dict.fromkeys(self._unknown, "unknown")

    @property
    def robustness(self) -> dict[str, Robustness]:
        """Return the robustness of each check with ``ROBUSTNESS`` if the trace ended now: name → value.

        Examples
        --------
        >>> monitor = sgstore.Monitor("CHECK slow: ALWAYS ego.speed < 14 ROBUSTNESS")
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", 0, 0, vx=20, vy=0)
        >>> events = monitor.step(frame)
        >>> monitor.robustness["slow"].value
        -6.0
        """
        watches = self._watches if self._last is not None else []
        told = ((w.name, w.robustness) for _, w, waiting in watches if not waiting.reason)
        return {name: one for name, one in told if one is not None}

    def run(
        self, frames: Iterable[Frame], *, duration_s: float | None = None
    ) -> tuple[Verdict, ...]:
        """Process frames until they end or Ctrl-C is pressed, and return the verdicts of the checks.

        Parameters
        ----------
        frames : iterable of Frame
        duration_s : float, optional
            Simulation time to process; s. Default: all frames.

        Examples
        --------
        >>> monitor = sgstore.Monitor("CHECK slow: ALWAYS ego.speed < 14")
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", 0, 0, vx=20, vy=0)
        >>> monitor.run([frame])
        (<Verdict 'slow' of 'online': false, 1 violation>,)
        """
        try:
            for frame in frames:
                self.step(frame)
                if self._last is not None and duration_s is not None and self._last.t >= duration_s:
                    break
        except KeyboardInterrupt:
            pass  # the frames so far still get verdicts
        return self.finish()

    def finish(self) -> tuple[Verdict, ...]:
        """End the trace, and return the verdicts of the checks.

        A store with the same trace gives the same verdicts.

        Examples
        --------
        >>> monitor = sgstore.Monitor("CHECK slow: ALWAYS ego.speed < 14")
        >>> frame = sgstore.Frame(0, ego="hero")
        >>> frame.add("hero", "car", 0, 0, vx=20, vy=0)
        >>> events = monitor.step(frame)
        >>> monitor.finish()
        (<Verdict 'slow' of 'online': false, 1 violation>,)
        """
        if self._last is None:
            return ()
        verdicts: list[Verdict] = []
        events: list[MonitorEvent] = []
        unknown = dict(self._unknown)
        for scope, watch, waiting in self._watches:
            if waiting.reason:
                unknown[watch.name] = waiting.reason
                continue
            verdict, late = watch.finish(self.trace, self._last)
            verdicts.append(within_range(verdict, self._seen[scope].short(watch.check)))
            events += late
        for _, follow, waiting in self._follows:
            if not waiting.reason:
                events += follow.finish(self._last)
        self._told(events)
        told = (Verdict(n, self.trace, "unknown", reason=why) for n, why in unknown.items())
        return (*verdicts, *told)


class _PendingEvents:
    """Monitor events that are held back until the trace has had all data that the query requires.

    Parameters
    ----------
    needs : iterable of Need
    trace : str
        Name of the trace, for the reason.

    Attributes
    ----------
    reason : str
        Missing data of the trace as text. Entities that never appear need no data.
    """

    def __init__(self, needs: Iterable[Need], trace: str) -> None:
        self._open, self._trace = list(needs), trace
        self._met: set[Need] = set()
        self._events: list[MonitorEvent] = []
        self.reason = ""

    def passed(
        self, found: list[MonitorEvent], here: FrameTime, people: NodeNames
    ) -> list[MonitorEvent]:
        """Return the events to report at this frame. They include events that were held back until now."""
        if not self._open:
            return found
        self._open = [need for need in self._open if not self._told(need, people)]
        left = (n for n in self._open if n.attribute is None or n.kinds is None or n in self._met)
        self.reason = "; ".join(dict.fromkeys(need.reason_in(self._trace) for need in left))
        self._events += found
        if self.reason:
            return []
        told, self._events = [replace(event, told=here) for event in self._events], []
        return told

    def _told(self, need: Need, people: NodeNames) -> bool:
        if need.event:
            return people.records(need.event)
        if need.lanes:
            return people.has_lanes(need.lanes)
        if need.kinds is None:
            value = need.attribute and need.attribute.topic
            return value is not None and people.has_topic(value.topic)  # weather stays unknown
        present = people.of(need.kinds)
        if need.attribute is None:
            return bool(present)
        name = need.attribute.name
        asked = [
            node for node in present if name not in MOTION or not people.tells(node, "is_static")
        ]
        if asked:
            self._met.add(need)
        return any(people.tells(node, name) is not None for node in asked)


def _names(called: str | Sequence[str], count: int) -> Sequence[str]:
    """Return a name for each monitored pattern, to use in events."""
    if isinstance(called, str):
        return [called] if count == 1 else [f"{called} {i + 1}" for i in range(count)]
    if len(called) != count:
        raise ValueError(f"{len(called)} names for {count} patterns")
    return called


def _bound(
    text: str, catalog: Catalog, parameters: Mapping[str, Any]
) -> tuple[list[BoundCheck], list[Query]]:
    """Return the checks and patterns of a query text, with resolved names."""
    text, parameters = statement(text, parameters, check=True)
    statements = [*each_match(parse(text))]
    written = [one for one in statements if not isinstance(one, MatchClause)]
    named = {name for one in statements for name in parameters_in(one)}
    unused = sorted(set(parameters) - named)
    if unused:
        hint = f"write a parameter as ${unused[0]}"
        raise QueryError(f"the text has no parameter '{unused[0]}'", hint=hint)

    def given(some: Sequence[Statement]) -> dict[str, Any]:
        names = {name for one in some for name in parameters_in(one)}
        return {name: value for name, value in parameters.items() if name in names}

    checks: list[BoundCheck] = []
    if any(isinstance(one, CheckClause) for one in written) or not any(
        isinstance(one, MatchClause) for one in statements
    ):
        bound = bind_checks(text, written, lambda _: catalog, given(written))
        checks = [one.check for one in bound]
    defined: list[Statement] = []
    queries: list[Query] = []
    for one in statements:
        if isinstance(one, Define):
            defined.append(one)
        elif isinstance(one, MatchClause):
            query = bind_query(text, [*defined, one], catalog, given([*defined, one]))
            queries.append(without_guesses(query))
    return checks, queries
