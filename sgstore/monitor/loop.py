"""The loop of a monitor: frame in, graph made, questions asked, checks and patterns told."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from sgstore.config import Config
from sgstore.errors import QueryError
from sgstore.history.checks import Verdict
from sgstore.lang.binder import bind_query
from sgstore.lang.catalog import Catalog, TraceFacts
from sgstore.lang.checks import bind_checks
from sgstore.lang.evaluation import FrameView
from sgstore.lang.parser import parse
from sgstore.lang.reach import Reach
from sgstore.lang.syntax import Check, Define, Match, Parameter
from sgstore.monitor.asking import People, Questions
from sgstore.monitor.events import Event, Moment
from sgstore.monitor.following import Follow
from sgstore.monitor.watching import Watch
from sgstore.online.stepping import Uncollected
from sgstore.sgg import SceneGraphGenerator
from sgstore.temporal.courses import Pulse
from sgstore.world import GAP

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.graph import SceneGraph
    from sgstore.lang.bound import Query
    from sgstore.lang.over_time import Check as BoundCheck
    from sgstore.lang.syntax import Statement
    from sgstore.online import Frame
    from sgstore.roads import RoadMap


class Monitor:
    """Checks and patterns over one trace that is going on.

    Parameters
    ----------
    text : str
        ``CHECK`` and ``MATCH`` statements, with the predicates that they need.
    road_map : RoadMap, optional
    config : Config, optional
    on_event : callable, optional
        Is told every event as soon as it is known.
    parameters : mapping of str to value, optional
        Values of ``$name``.
    trace : str
        What the trace is called in verdicts.
    period_s : float, optional
        Time between two frames, from which gaps are told; by default the median of those seen.
    called : str
        What a pattern is called in events; of several each has a number as well.
    sgsm_compat : bool
        Whether a check is violated in each frame with which the trace, if it ended there, would violate it; as
        :meth:`sgstore.query.Store.check` has it. Nothing resets such a violation.

    Attributes
    ----------
    generator : SceneGraphGenerator
        What makes the graphs; its last ones are those of the last step.
    names : tuple of str
        Of the checks and patterns.

    Raises
    ------
    QueryError
        The text has no meaning, or is about what cannot be known while a trace goes on; it says where.

    Notes
    -----
    A check that names a relation which the graphs cannot have (of lanes, without a map) has the verdict
    ``unknown``, a pattern none.
    """

    def __init__(  # noqa: PLR0913 - most have names
        self,
        text: str,
        road_map: RoadMap | None = None,
        config: Config | None = None,
        *,
        on_event: Callable[[Event], object] | None = None,
        parameters: Mapping[str, Any] | None = None,
        trace: str = "online",
        period_s: float | None = None,
        called: str = "pattern",
        sgsm_compat: bool = False,
    ) -> None:
        config = config or Config()
        self.generator = SceneGraphGenerator(road_map, config)
        self.trace = trace
        self._on_event = on_event
        answers = frozenset(self.generator.answers)
        reach = Reach.of(config.as_dict())
        catalog = Catalog(traces=(TraceFacts(0, trace, "", answers, reach),))
        checks, queries = _bound(text, catalog, parameters or {})
        self._egos: list[str] = []
        self._questions: list[Questions] = []
        self._pulse = Pulse(GAP, None if period_s is None else round(period_s * 1e9))
        self._last: Moment | None = None
        self._watches: list[tuple[int, Watch]] = []
        self._unknown: list[str] = []
        for check in checks:
            if check.relations <= answers or check.unknown_is_false:
                ego, questions = self._of_ego(check.ego)
                watch = Watch(check, questions, self._pulse, compat=sgsm_compat)
                self._watches.append((ego, watch))
            else:
                self._unknown.append(check.name)
        self._follows: list[tuple[int, Follow]] = []
        for number, query in enumerate(queries, start=1):
            if query.relations <= answers or query.unknown_is_false:
                ego, questions = self._of_ego(query.ego)
                name = called if len(queries) == 1 else f"{called} {number}"
                self._follows.append((ego, Follow(name, query, questions, self._pulse)))
        told = (follow.name for _, follow in self._follows)
        self.names = (*(check.name for check in checks), *told)

    def _of_ego(self, ego: str | None) -> tuple[int, Questions]:
        """The number of an ego, and what is asked of its graphs."""
        if (ego or "") not in self._egos:
            self._egos.append(ego or "")
            self._questions.append(Questions())
        number = self._egos.index(ego or "")
        return number, self._questions[number]

    def step(self, frame: Frame) -> tuple[Event, ...]:
        """The next frame: what is known from it on.

        Raises
        ------
        ValueError
            The frame contradicts itself, as :meth:`sgstore.sgg.SceneGraphGenerator.steps` says; it is as if it
            had not been given.
        """
        with Uncollected():  # the graphs are let go within
            return self._step(frame)

    def _step(self, frame: Frame) -> tuple[Event, ...]:
        return self.look(self.generator.steps(frame, self._egos or [""]), classed=True)

    def look(self, graphs: Sequence[SceneGraph], *, classed: bool = False) -> tuple[Event, ...]:
        """The graphs of the next frame, of whoever makes them: what is known from it on.

        Parameters
        ----------
        graphs : sequence of SceneGraph
            One for each of :attr:`egos`.
        classed : bool
            Whether they are the last ones of :attr:`generator`, which can then be asked for their classes.
        """
        return self._tell(*self._ask(graphs, classed=classed))

    def _ask(
        self, graphs: Sequence[SceneGraph], *, classed: bool = False
    ) -> tuple[Moment, list[People]]:
        """Ask all questions of the graphs of a frame."""
        self._pulse.step(graphs[0].time_ns)
        tick, start = self._pulse.tick, self._pulse.start
        here = Moment(tick.number, tick.time, (tick.time - start) / 1e9)
        people: list[People] = []
        for number, (graph, questions) in enumerate(zip(graphs, self._questions, strict=False)):
            view = self._view(graph, here, number if classed else None)
            people.append(People(view))
            questions.ask(view, people[-1])
        return here, people

    def _tell(self, here: Moment, people: list[People]) -> tuple[Event, ...]:
        """Tell checks and patterns the answers."""
        self._last = here
        found = [event for _, watch in self._watches for event in watch.step(here)]
        for ego, follow in self._follows:
            found += follow.step(here, people[ego])
        return self._told(found)

    def _view(self, graph: SceneGraph, here: Moment, number: int | None) -> FrameView:
        frame = {"id": here.seq, "seq": here.seq, "time_ns": here.time_ns, "t": here.t}
        trace = {"id": 0, "name": self.trace}
        if number is None:
            return FrameView(graph, frame, trace)
        classes = partial(self.generator.class_of, number=number)
        return FrameView(graph, frame, trace, classes, partial(self.generator.roles_of, number))

    def _told(self, events: list[Event]) -> tuple[Event, ...]:
        if self._on_event is not None:
            for event in events:
                self._on_event(event)
        return tuple(events)

    @property
    def egos(self) -> tuple[str, ...]:
        """The ids of the egos whose graphs are looked at; empty: the ego of the frame."""
        return tuple(self._egos)

    @property
    def status(self) -> dict[str, str]:
        """What is known of each check so far: ``true``, ``false``, ``presumably_true``, ``presumably_false``.

        The latter are what the verdict would be if the trace ended now. ``unknown``: it cannot be told.
        """
        known = {watch.name: watch.status() for _, watch in self._watches}
        return known | dict.fromkeys(self._unknown, "unknown")

    def run(
        self, frames: Iterable[Frame], *, duration_s: float | None = None
    ) -> tuple[Verdict, ...]:
        """Watch frames one after the other, until they end, or Ctrl-C ends it: the verdicts.

        Parameters
        ----------
        frames : iterable of Frame
        duration_s : float, optional
            How much simulation time is watched; by default all.
        """
        try:
            for frame in frames:
                self.step(frame)
                if self._last is not None and duration_s is not None and self._last.t >= duration_s:
                    break
        except KeyboardInterrupt:
            pass  # what was seen until then has its verdicts
        return self.finish()

    def finish(self) -> tuple[Verdict, ...]:
        """The trace has ended: the verdicts of all checks, as a store has them of the recorded trace."""
        if self._last is None:
            return ()
        verdicts: list[Verdict] = []
        events: list[Event] = []
        for _, watch in self._watches:
            verdict, late = watch.finish(self.trace, self._last)
            verdicts.append(verdict)
            events += late
        for _, follow in self._follows:
            events += follow.finish(self._last)
        self._told(events)
        return (*verdicts, *(Verdict(name, self.trace, "unknown") for name in self._unknown))


def _bound(
    text: str, catalog: Catalog, parameters: Mapping[str, Any]
) -> tuple[list[BoundCheck], list[Query]]:
    """The checks and the patterns of a text."""
    statements = parse(text)
    written = [one for one in statements if not isinstance(one, Match)]
    named = {name for one in statements for name in _parameters(one)}
    unused = sorted(set(parameters) - named)
    if unused:
        hint = f"it would be written ${unused[0]}"
        raise QueryError(f"the text has no parameter '{unused[0]}'", hint=hint)

    def given(some: Sequence[Statement]) -> dict[str, Any]:
        names = {name for one in some for name in _parameters(one)}
        return {name: value for name, value in parameters.items() if name in names}

    checks: list[BoundCheck] = []
    if any(isinstance(one, Check) for one in written) or not any(
        isinstance(one, Match) for one in statements
    ):
        bound = bind_checks(text, written, lambda _: catalog, given(written))
        checks = [one.check for one in bound]
    defined: list[Statement] = []
    queries: list[Query] = []
    for one in statements:
        if isinstance(one, Define):
            defined.append(one)
        elif isinstance(one, Match):
            queries.append(bind_query(text, [*defined, one], catalog, given([*defined, one])))
    return checks, queries


def _parameters(part: object) -> Iterator[str]:
    """The names of the parameters in a part of a text."""
    if isinstance(part, Parameter):
        yield part.name
    elif isinstance(part, tuple | list):
        for item in part:  # pyright: ignore[reportUnknownVariableType]
            yield from _parameters(item)  # pyright: ignore[reportUnknownArgumentType]
    elif is_dataclass(part):
        for field in fields(part):
            yield from _parameters(getattr(part, field.name))
