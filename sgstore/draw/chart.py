"""Charts: two axes, lines between them, and a key. What curves of coverage and of selections are drawn with."""

from __future__ import annotations

import math
from contextlib import contextmanager
from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.draw.palette import FAINT_INK, INK, ROAD_EDGE, RULE

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.draw.page import Page

_WIDTH: Final = 560.0
_HEIGHT: Final = 330.0
_LEFT: Final = 62.0
_BELOW: Final = 46.0
_ABOVE: Final = 60.0
_LETTER: Final = 3.9
"""Width of a letter of 7 points, about."""
_KEY: Final = 5.2
"""Width of a letter of the key, about; points."""

CHOSEN: Final[Mapping[str, Any]] = {"color": ROAD_EDGE, "linewidth": 1.8}
"""Look of the line that a chart is about."""
AT_RANDOM: Final[Mapping[str, Any]] = {
    "color": FAINT_INK,
    "linewidth": 1.2,
    "linestyle": (0, (4, 3)),
}
"""Look of the line that it is compared with."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Numbers along one side of a chart, as points of the page."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def at(self, value: Any) -> NDArray[np.float64]:
        """Where numbers stand."""
        numbers = np.asarray(value, np.float64)
        if self.log:
            numbers = np.log10(np.maximum(numbers, 1e-12))
            low, high = math.log10(self.low), math.log10(self.high)
        else:
            low, high = self.low, self.high
        return self.start + (numbers - low) / max(high - low, 1e-12) * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Round numbers on it, some five."""
        if self.log:
            first, last = math.floor(math.log10(self.low)), math.floor(math.log10(self.high) + 1e-9)
            return [10.0**power for power in range(first, last + 1)]
        raw = (self.high - self.low) / 5
        step = 10.0 ** math.floor(math.log10(max(raw, 1e-12)))
        step *= next(one for one in (1, 2, 5, 10) if one * step >= raw)
        first = math.ceil(self.low / step)
        return [step * i for i in range(first, math.floor(self.high / step + 1e-9) + 1)]


@contextmanager
def sheet(
    to: Path, title: str, below: str, width: float = _WIDTH, height: float = _HEIGHT
) -> Generator[Page]:
    """A page with a title and a sentence, of at most two lines, under it; written when all is drawn.

    Raises
    ------
    ExportError
        The ending of ``to`` is none of a picture, or the file cannot be written.
    MissingExtraError
        The packages for drawing are not installed.
    """
    from sgstore.draw import check_installed

    check_installed()
    from sgstore.draw.page import Page, check_format, own_style

    check_format(to)
    with own_style():
        page = Page(width, height)
        page.text(14, height - 20, title, fontsize=10, weight="bold")
        for number, line in enumerate(wrap(below, int((width - 28) / _LETTER))[:2]):
            page.text(14, height - 34 - 10 * number, line, fontsize=7, color=FAINT_INK)
        yield page
        page.save(to)


def scales(
    page: Page,
    x: tuple[float, float],
    y: tuple[float, float],
    *,
    right: float = 24.0,
    log: bool = False,
) -> tuple[Scale, Scale]:
    """The scales of a chart that fills a page. ``x``, ``y``: from, to; ``right``: room beside it, points."""
    return (
        Scale(*x, _LEFT, page.width - right, log),
        Scale(*y, _BELOW, page.height - _ABOVE, log),
    )


def written(value: float) -> str:
    """A number of an axis, short: ``25k``."""
    if value >= 10_000:
        power = math.floor(math.log10(value) / 3)
        return f"{value / 1000**power:g}{('', 'k', 'M', 'G', 'T')[min(power, 4)]}"
    return f"{value:g}"


def paint_axes(
    page: Page,
    x: Scale,
    y: Scale,
    names: tuple[str, str],
    up: Callable[[float], str] = written,
) -> None:
    """The frame of a chart, with its numbers and what they are. ``up``: how numbers of ``y`` are written."""
    for value in x.ticks():
        at = float(x.at(value))
        page.sheet.plot([at, at], [y.start, y.end], color=RULE, linewidth=0.6)
        page.text(at, y.start - 11, written(value), ha="center", color=FAINT_INK)
    for value in y.ticks():
        at = float(y.at(value))
        page.sheet.plot([x.start, x.end], [at, at], color=RULE, linewidth=0.6)
        page.text(x.start - 5, at - 2.5, up(value), ha="right", color=FAINT_INK)
    page.sheet.plot([x.start, x.end], [y.start, y.start], color=INK, linewidth=0.8)
    page.sheet.plot([x.start, x.start], [y.start, y.end], color=INK, linewidth=0.8)
    page.text((x.start + x.end) / 2, y.start - 28, names[0], ha="center", fontsize=8)
    middle = (y.start + y.end) / 2
    page.text(16, middle, names[1], fontsize=8, rotation=90, ha="center", va="center")


def paint_key(
    page: Page, x: Scale, y: Scale, entries: Sequence[tuple[str, Mapping[str, Any]]]
) -> None:
    """What the lines are, in the lower right corner; the first entry above."""
    start = x.end - 40 - _KEY * max(len(text) for text, _ in entries)
    low, high = y.start + 4, y.start + 6 + 14 * len(entries)
    box = [start - 4, x.end - 2, x.end - 2, start - 4], [low, low, high, high]
    page.sheet.fill(*box, color="white", linewidth=0, zorder=3)
    for number, (text, look) in enumerate(reversed(entries)):
        height = y.start + 12 + 14 * number
        page.sheet.plot([start, start + 22], [height, height], zorder=4, **look)
        page.text(start + 28, height - 2.5, text, zorder=4)
