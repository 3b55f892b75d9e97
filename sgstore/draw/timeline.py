"""Swim lanes of a trace as a picture: when what matches or is violated, one lane for each who."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.draw.palette import EGO, FAINT_INK, GROUND, INK, ROAD_EDGE, RULE

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.draw.page import Page
    from sgstore.draw.swimlanes import Timeline

MOST_LANES: Final = 400
"""Lanes that a picture shows; the title says of more."""

_WIDTH: Final = 720.0
_LEFT: Final = 190.0
_RIGHT: Final = 20.0
_LANE: Final = 15.0
_BAR: Final = 9.0
_ABOVE: Final = 26.0
_BELOW: Final = 26.0
_TOP: Final = 34.0
_LEAST: Final = 1.5
"""Width of the shortest bar; points."""
_LETTERS: Final = 44


def draw_timelines(timelines: list[Timeline], to: Path) -> None:
    """Draw the swim lanes of traces, one trace under the other, each on its own time.

    Parameters
    ----------
    timelines : list of Timeline
        At least one.
    to : Path
        ``….png`` or ``….svg``; a file that is there is replaced.

    Raises
    ------
    ExportError
        The ending is another, or the file cannot be written.
    MissingExtraError
        The packages for drawing are not installed.
    """
    from sgstore.draw import check_installed

    check_installed()
    from sgstore.draw.page import Page, check_format, own_style

    check_format(to)
    left = MOST_LANES
    shown: list[tuple[Timeline, int]] = []
    for timeline in timelines:
        shown.append((timeline, min(max(len(timeline.lanes), 1), left)))
        left = max(left - len(timeline.lanes), 0)
    shown = [(timeline, lanes) for timeline, lanes in shown if lanes]
    height = _TOP + sum(_ABOVE + lanes * _LANE + _BELOW for _, lanes in shown)
    with own_style():
        page = Page(_WIDTH, height)
        _legend(page, height, sum(len(one.lanes) for one in timelines) - MOST_LANES)
        top = height - _TOP
        for timeline, lanes in shown:
            _draw(page, timeline, lanes, top)
            top -= _ABOVE + lanes * _LANE + _BELOW
        page.save(to)


def _legend(page: Page, height: float, more: int) -> None:
    x, y = 14.0, height - 20
    for colour, word in ((ROAD_EDGE, "found"), (EGO, "violated")):
        page.sheet.fill(
            [x, x + 14, x + 14, x], [y, y, y + _BAR, y + _BAR], color=colour, linewidth=0
        )
        page.text(x + 19, y + 1.5, word, fontsize=8)
        x += 76
    if more > 0:
        page.text(x, y + 1.5, f"{more} more lanes are not shown", fontsize=8, color=FAINT_INK)


def _draw(page: Page, timeline: Timeline, lanes: int, top: float) -> None:
    start, end = _LEFT, _WIDTH - _RIGHT
    seconds = max(timeline.seconds, 1e-9)
    low, high = top - _ABOVE - lanes * _LANE, top - _ABOVE
    page.text(14, top - 18, timeline.trace[:80], fontsize=9, weight="bold")
    for value in _ticks(timeline.seconds):
        at = start + value / seconds * (end - start)
        page.sheet.plot([at, at], [low, high], color=RULE, linewidth=0.6, zorder=1)
        page.text(at, low - 11, f"{value:g} s", ha="center", color=FAINT_INK)
    if not timeline.lanes:
        page.text(start, high - 10, "nothing", color=FAINT_INK)
    for number, lane in enumerate(timeline.lanes[:lanes]):
        base = high - (number + 1) * _LANE + (_LANE - _BAR) / 2
        label = lane.label if len(lane.label) <= _LETTERS else f"{lane.label[: _LETTERS - 1]}…"
        page.text(start - 6, base + 1.8, label, ha="right", fontsize=7, color=INK)
        _bar(page, (start, end), base, GROUND)
        if not lane.spans and lane.verdict == "unknown":
            page.text(start + 4, base + 1.8, "cannot be told", fontsize=7, color=FAINT_INK)
        for span in lane.spans:
            a, z = (start + t / seconds * (end - start) for t in (span.start, span.end))
            _bar(page, (a, max(z, a + _LEAST)), base, EGO if span.violation else ROAD_EDGE)


def _bar(page: Page, ends: tuple[float, float], base: float, colour: str) -> None:
    a, z = ends
    box = [a, z, z, a], [base, base, base + _BAR, base + _BAR]
    page.sheet.fill(*box, color=colour, linewidth=0, zorder=0.5 if colour == GROUND else 2)


def _ticks(seconds: float) -> list[float]:
    """Round times, some eight."""
    step = next(
        (s * 10**p for p in range(-3, 9) for s in (1, 2, 5) if seconds / (s * 10**p) <= 9), 1e9
    )
    return [round(number * step, 6) for number in range(int(seconds / step) + 1)]
