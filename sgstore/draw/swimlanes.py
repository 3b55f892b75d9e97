"""Swim lanes: when what matches or is violated in a trace, one lane for each who; as text for a terminal."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang.parser import parse
from sgstore.lang.syntax import Check

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from sgstore.matches import Interval
    from sgstore.query import Store

LETTERS: Final = 60
"""Letters that a trace is long."""

FULL, PART, NONE = "█", "▌", "·"
NAME: Final = 36
"""Letters of the name of a lane, at most."""


@dataclass(frozen=True, slots=True)
class Span:
    """When something holds, in s since the trace began.

    Attributes
    ----------
    start, end : float
    violation : bool
        Whether it should not.
    """

    start: float
    end: float
    violation: bool


@dataclass(slots=True)
class Lane:
    """What one line tells: a pattern or a check, and who.

    Attributes
    ----------
    name, who : str
    verdict : str
        Of a check; else empty.
    spans : list of Span
        In order; they may overlap.
    """

    name: str
    who: str = ""
    verdict: str = ""
    spans: list[Span] = field(default_factory=list[Span])

    @property
    def label(self) -> str:
        """What stands beside it."""
        return " · ".join(part for part in (self.name, self.who) if part)


@dataclass(slots=True)
class Timeline:
    """The lanes of a trace.

    Attributes
    ----------
    trace : str
    seconds : float
        From its first frame to its last.
    lanes : list of Lane
    """

    trace: str
    seconds: float
    lanes: list[Lane] = field(default_factory=list[Lane])


def timelines(
    store: Store, asked: Mapping[str, tuple[str, Mapping[str, Any]]], trace: str = ""
) -> list[Timeline]:
    """The swim lanes of the traces of a store.

    Parameters
    ----------
    store : Store
    asked : mapping of str to (str, mapping)
        Texts, of ``CHECK`` statements or of one ``MATCH`` each, with the values of their parameters, by what
        their lanes are called; a check is called by its own name.
    trace : str
        The only trace that is told, if there is one.

    Returns
    -------
    list of Timeline
        Of every trace that is asked, in the order of the store; a check that holds has a lane without spans.

    Raises
    ------
    QueryError
        A text has no meaning.
    """
    found = {
        one.name: Timeline(one.name, (one.end_ns - one.start_ns) / 1e9)
        for one in store.info()
        if trace in {"", one.name}
    }
    for name, (text, values) in asked.items():
        checks = any(isinstance(one, Check) for one in parse(text))
        lanes = _checked(store, text, values) if checks else _matched(store, name, text, values)
        for of, lane in lanes:
            if of in found:
                found[of].lanes.append(lane)
    return list(found.values())


def _checked(store: Store, text: str, values: Mapping[str, Any]) -> Iterator[tuple[str, Lane]]:
    for verdict in store.check(text, **values):
        lane = Lane(verdict.check, "", verdict.verdict)
        of_whom = [one for one in verdict.witnesses if one.violations]
        if not of_whom:
            lane.spans = _spans(verdict.violations, violation=True)
            yield verdict.trace, lane
        for witness in of_whom:
            who = ", ".join(witness.names.values())
            spans = _spans(witness.violations, violation=True)
            yield verdict.trace, Lane(verdict.check, who, verdict.verdict, spans)


def _matched(
    store: Store, name: str, text: str, values: Mapping[str, Any]
) -> Iterator[tuple[str, Lane]]:
    lanes: dict[tuple[str, str], Lane] = {}
    for interval in store.find(text, **values).intervals():
        told = interval.values
        nodes = [f"{name}.name" for name in told if f"{name}.name" in told]  # without RETURN
        who = ", ".join(str(told[name]) for name in nodes or told)
        lane = lanes.setdefault((interval.trace, who), Lane(name, who))
        lane.spans += _spans((interval,), violation=False)
    for (trace, _), lane in lanes.items():
        yield trace, lane


def _spans(intervals: Iterable[Interval], *, violation: bool) -> list[Span]:
    return [Span(one.start, one.end, violation) for one in intervals]


def lines_of(timeline: Timeline, letters: int = LETTERS) -> list[str]:
    """A timeline as lines of text; each letter stands for an equal part of the trace.

    ``█``: it holds, or is violated, for most of the part; ``▌``: in some of it; ``·``: nowhere in it.
    """
    head = f"{timeline.trace}  0 … {timeline.seconds:.1f} s"
    if not timeline.lanes:
        return [head, "  nothing"]
    labels = [_cut(lane.label) for lane in timeline.lanes]
    width = max(map(len, labels))
    lines = [head]
    for label, lane in zip(labels, timeline.lanes, strict=True):
        lines.append(
            f"  {label.ljust(width)}  {_letters(lane, timeline.seconds, letters)}  {_told(lane)}"
        )
    return [line.rstrip() for line in lines]


def _letters(lane: Lane, seconds: float, letters: int) -> str:
    part = max(seconds, 1e-9) / letters
    covered = [0.0] * letters
    touched = [False] * letters
    for start, end in _merged(lane.spans):
        first = min(int(start / part), letters - 1)
        last = min(int(end / part), letters - 1)
        for place in range(first, last + 1):
            touched[place] = True
            covered[place] += max(min(end, (place + 1) * part) - max(start, place * part), 0.0)
    return "".join(
        FULL if share > part / 2 else PART if some else NONE
        for share, some in zip(covered, touched, strict=True)
    )


def _merged(spans: Sequence[Span]) -> list[tuple[float, float]]:
    """Times that spans cover, each once."""
    found: list[tuple[float, float]] = []
    for span in sorted(spans, key=lambda one: one.start):
        if found and span.start <= found[-1][1]:
            found[-1] = found[-1][0], max(found[-1][1], span.end)
        else:
            found.append((span.start, span.end))
    return found


def _told(lane: Lane) -> str:
    """How often, and for how long together."""
    if not lane.spans:
        return lane.verdict
    seconds = sum(end - start for start, end in _merged(lane.spans))
    what = "violated" if lane.spans[0].violation else "found"
    times = "once" if len(lane.spans) == 1 else f"{len(lane.spans)} times"
    return f"{what} {times}, {seconds:.1f} s"


def _cut(label: str) -> str:
    return label if len(label) <= NAME else f"{label[: NAME - 1]}…"
