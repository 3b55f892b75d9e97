"""Timelines of matches and violations, one lane per entity, as text for a terminal or as a picture."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from sgstore.draw._palette import EGO, FAINT_INK, GROUND, INK, ROAD_EDGE
from sgstore.lang.syntax import parse
from sgstore.lang.syntax.tree import CheckClause

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from sgstore.draw._page import Page
    from sgstore.matches import Interval
    from sgstore.query import Store


LETTERS: Final = 60
"""Length of the timeline of a trace as text; letters."""

FULL, PART, NONE = "█", "▌", "·"
NAME: Final = 36
"""Largest length of a lane's name; letters."""


LaneSpan = tuple[float, float, bool]
"""Start and end of a time span since the start of the trace (s), and True for a violation."""


@dataclass(slots=True)
class Lane:
    """Lane of a timeline: the time spans in which some entities match a pattern, or violate a check.

    Attributes
    ----------
    name, who : str
    verdict : str
        Verdict of a check; ``unknown`` for a trace that cannot answer; else empty.
    spans : list of LaneSpan
        In order; they can overlap.
    reason : str
        Reason of an unknown verdict; else empty.
    """

    name: str
    who: str = ""
    verdict: str = ""
    spans: list[LaneSpan] = field(default_factory=list[LaneSpan])
    reason: str = ""

    @property
    def label(self) -> str:
        """Return the label of the lane: the pattern or check, and its entities."""
        return " · ".join(part for part in (self.name, self.who) if part)


@dataclass(slots=True)
class Timeline:
    """Timeline of a trace, with lanes for matches and violations.

    Attributes
    ----------
    trace : str
    seconds : float
        Time from the first frame to the last.
    lanes : list of Lane
    """

    trace: str
    seconds: float
    lanes: list[Lane] = field(default_factory=list[Lane])

    @property
    def hit(self) -> bool:
        """True if the timeline contains a match or a violation."""
        return any(lane.spans for lane in self.lanes)


def timelines(
    store: Store,
    asked: Mapping[str, tuple[str, Mapping[str, Any]]],
    traces: str | Collection[str] = (),
) -> list[Timeline]:
    """Evaluate patterns and checks on a store. Return a timeline of matches and violations for each trace.

    Parameters
    ----------
    store : Store
    asked : mapping of str to (str, mapping)
        Texts by lane name, with values of their parameters: ``CHECK`` statements, or one ``MATCH``
        each. The lane of a check has the name of the check.
    traces : str or collection of str
        Trace or traces to show; empty means all.

    Returns
    -------
    list of Timeline
        One per trace, in the order of the store. A check that holds has a lane without spans; so
        has an unknown verdict, with its reason.

    Raises
    ------
    QueryError
        A text is invalid.
    """
    wanted = {traces} - {""} if isinstance(traces, str) else {*traces}
    found = {
        one.name: Timeline(one.name, one.seconds)
        for one in store.info()
        if not wanted or one.name in wanted
    }
    for name, (text, values) in asked.items():
        checks = any(isinstance(one, CheckClause) for one in parse(text))
        lanes = _checked(store, text, values) if checks else _matched(store, name, text, values)
        for of, lane in lanes:
            if of in found:
                found[of].lanes.append(lane)
    return list(found.values())


def parts_timeline(
    store: Store, text: str, frame: int | str, values: Mapping[str, Any]
) -> Timeline:
    """Return a timeline of one match: the times at which each part of the pattern is true.

    Parameters
    ----------
    store : Store
    text : str
        A pattern.
    frame : int or str
        As in :meth:`sgstore.query.Store.graph`: its first match is shown, or the nearest approach
        to a match.
    values : mapping
        Values of the parameters of the pattern.

    Raises
    ------
    QueryError
        The text is not a query.
    StoreError
        The frame is missing.
    """
    with store.file.snapshot():
        found = store.parts(text, frame, **values)
        one = store.file.trace(found.trace)
        sql = "SELECT seq, t FROM frames WHERE trace = ? ORDER BY seq"
        times = dict(store.file.rows(sql, [found.trace]).values)

    def spans(of: Iterable[tuple[int, int]]) -> list[LaneSpan]:
        return [(times[first], times[last], False) for first, last in of]

    whole = Timeline(one.name, one.seconds)
    steps = len(found.steps) > 1
    for lane in found.lanes:
        name = f"{lane.part.step}. {lane.part.text}" if steps else lane.part.text
        reason = ", ".join(lane.unknown)
        verdict = "unknown" if lane.unknown else ""
        whole.lanes.append(Lane(name, "", verdict, spans(lane.spans), reason))
    for step in found.steps:
        name = f"all of step {step}" if steps else "all of it"
        whole.lanes.append(Lane(name, "", "", spans(found.together(step))))
    return whole


def _checked(store: Store, text: str, values: Mapping[str, Any]) -> Iterator[tuple[str, Lane]]:
    for verdict in store.check(text, **values):
        lane = Lane(verdict.check, "", verdict.verdict, reason=verdict.reason)
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
    matches = store.find(text, **values)
    for interval in matches.intervals():
        told = interval.values
        nodes = [f"{name}.name" for name in told if f"{name}.name" in told]  # without RETURN
        who = ", ".join(str(told[name]) for name in nodes or told)
        lane = lanes.setdefault((interval.trace, who), Lane(name, who))
        lane.spans += _spans((interval,), violation=False)
    for (trace, _), lane in lanes.items():
        yield trace, lane
    for trace, reason in matches.reasons.items():
        yield trace, Lane(name, "", "unknown", reason=reason)


def _spans(intervals: Iterable[Interval], *, violation: bool) -> list[LaneSpan]:
    return [(one.start, one.end, violation) for one in intervals]


def lines_of(timeline: Timeline, letters: int = LETTERS, longest: float = 0.0) -> list[str]:
    """Return a timeline as lines of text. All letters cover equal parts of the time.

    ``█``: true, or violated, for most of the part; ``▌``: for some of it; ``·``: for none of it.

    Parameters
    ----------
    timeline : Timeline
    letters : int
        Length of the longest trace in letters.
    longest : float
        Duration of the longest trace, for a common scale; by default that of this trace; s.
    """
    head = f"{timeline.trace}  0 … {timeline.seconds:.1f} s"
    if not timeline.lanes:
        return [head, "  nothing"]
    labels = [_cut(lane.label, NAME) for lane in timeline.lanes]
    width = max(map(len, labels))
    lines = [head]
    own = max(round(letters * timeline.seconds / max(longest, timeline.seconds, 1e-9)), 1)
    for label, lane in zip(labels, timeline.lanes, strict=True):
        drawn = _letters(lane, timeline.seconds, own).ljust(letters)
        lines.append(f"  {label.ljust(width)}  {drawn}  {_told(lane)}")
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


def _merged(spans: Sequence[LaneSpan]) -> list[tuple[float, float]]:
    """Return time spans with overlapping ones merged."""
    found: list[tuple[float, float]] = []
    for start, end, _ in sorted(spans, key=lambda one: one[0]):
        if found and start <= found[-1][1]:
            found[-1] = found[-1][0], max(found[-1][1], end)
        else:
            found.append((start, end))
    return found


def _told(lane: Lane) -> str:
    """Return a summary of a lane as text: number and total length of its time spans."""
    if not lane.spans:
        return lane.verdict
    seconds = sum(end - start for start, end in _merged(lane.spans))
    what = "violated" if lane.spans[0][2] else "found"
    times = "once" if len(lane.spans) == 1 else f"{len(lane.spans)} times"
    return f"{what} {times}, {seconds:.1f} s"


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}…"


MOST_LANES: Final = 400
"""Largest number of lanes in a picture. The legend states the number of the others."""

_WIDTH: Final = 720.0
_LEFT: Final = 190.0
_RIGHT: Final = 130.0
"""Width after a lane for its verdict or count; points."""
_LANE: Final = 15.0
_BAR: Final = 9.0
_ABOVE: Final = 26.0
_BELOW: Final = 26.0
_TOP: Final = 34.0
_LEAST: Final = 1.5
"""Width of the shortest bar of a timeline; points."""
_LETTERS: Final = 44
_REASON: Final = 100
"""Largest length of a reason; letters."""


def draw_timelines(timelines: list[Timeline], to: Path) -> None:
    """Draw the timelines of several traces below each other as a picture, with one time scale.

    Parameters
    ----------
    timelines : list of Timeline
        At least one.
    to : Path
        ``….png`` or ``….svg``; an existing file is replaced.

    Raises
    ------
    ExportError
        The ending is unknown, or the file cannot be written.
    MissingExtraError
        The packages for drawing are not installed.
    """
    from sgstore.draw._picture import drawing

    left = MOST_LANES
    shown: list[tuple[Timeline, int]] = []
    for timeline in timelines:
        shown.append((timeline, min(max(len(timeline.lanes), 1), left)))
        left = max(left - len(timeline.lanes), 0)
    shown = [(timeline, lanes) for timeline, lanes in shown if lanes]
    height = _TOP + sum(_ABOVE + lanes * _LANE + _BELOW for _, lanes in shown)
    with drawing(to):
        from sgstore.draw._page import Page

        page = Page(_WIDTH, height)
        kinds = {span[2] for one in timelines for lane in one.lanes for span in lane.spans}
        _key(page, kinds, sum(len(one.lanes) for one in timelines) - MOST_LANES)
        top = height - _TOP
        longest = max(timeline.seconds for timeline in timelines)
        for timeline, lanes in shown:
            _draw(page, timeline, lanes, top, max(longest, 1e-9))
            top -= _ABOVE + lanes * _LANE + _BELOW
        page.save(to)


def _key(page: Page, kinds: set[bool], more: int) -> None:
    """Draw the legend of a timeline picture. It also states how many lanes are not shown."""
    from matplotlib.patches import Patch

    known = ((False, ROAD_EDGE, "found"), (True, EGO, "violated"))
    handles = [Patch(color=colour, label=text) for kind, colour, text in known if kind in kinds]
    if more > 0:
        handles.append(Patch(visible=False, label=f"{more} more lanes are not shown"))
    page.legend(handles, (8, page.height - 6), "upper left", fontsize=8, handlelength=1.6)


def _draw(page: Page, timeline: Timeline, lanes: int, top: float, longest: float) -> None:
    """Draw the lanes of one trace below the height ``top``. The longest trace has the full page width."""
    from matplotlib.ticker import MaxNLocator

    from sgstore.draw._page import printable

    page.text(14, top - 18, timeline.trace[:80], fontsize=9, weight="bold")
    axes = page.plot(_LEFT, top - _ABOVE - lanes * _LANE, _WIDTH - _RIGHT, top - _ABOVE)
    axes.spines[:].set_visible(False)
    seconds = max(timeline.seconds, 1e-9)
    axes.set_xlim(0, longest)
    axes.set_ylim(lanes - 0.5, -0.5)
    axes.xaxis.set_major_locator(MaxNLocator(9, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter("{x:g} s")
    axes.grid(visible=False, axis="y")
    shown = timeline.lanes[:lanes]
    labels = [printable(_cut(lane.label, _LETTERS)) for lane in shown]
    axes.set_yticks(range(len(shown)), labels, color=INK, parse_math=False)
    if not shown:
        page.write(axes, 0, 0, "nothing", color=FAINT_INK)
    shortest = _LEAST / (_WIDTH - _RIGHT - _LEFT) * longest
    for row, lane in enumerate(shown):
        across = (row - _BAR / _LANE / 2, _BAR / _LANE)
        axes.broken_barh([(0, seconds)], across, color=GROUND, linewidth=0, zorder=0.4)
        if not lane.spans and lane.verdict == "unknown":
            said = f"unknown: {lane.reason}" if lane.reason else "unknown"
            page.write(
                axes, longest / 120, row, _cut(said, _REASON), va="center_baseline", color=FAINT_INK
            )
        elif told := _told(lane):
            colour = EGO if lane.verdict == "false" else FAINT_INK
            look = {"va": "center_baseline", "color": colour, "clip_on": False}
            page.write(axes, seconds + longest / 120, row, told, **look)
        for violation, colour in ((False, ROAD_EDGE), (True, EGO)):
            spans = [
                (start, max(end - start, shortest))
                for start, end, violated in lane.spans
                if violated is violation
            ]
            axes.broken_barh(spans, across, color=colour, linewidth=0, zorder=2)
