"""Charts of coverage and selection.

Charts: two axes, lines between them, and a key. What curves of coverage and of selections are drawn with.
"""

from __future__ import annotations

import math
from contextlib import contextmanager
from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.draw._palette import EGO, FAINT_INK, INK, JUNCTION, ROAD_EDGE, RULE

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.draw._page import Page


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
    from sgstore.draw._picture import check_installed

    check_installed()
    from sgstore.draw._page import Page, check_format, own_style

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


# Coverage as pictures: sizes of classes by rank, growth, and which pairs of features occur together ----
# PNG or SVG by the ending of the file's name; the same numbers give the same bytes.

_RIGHT: Final = 62.0
_CELL: Final = 11.0
_GAP: Final = "#f5b877"
MOST_FEATURES: Final = 120
"""Features that a matrix shows; of more, those with the most gaps."""


def draw_rank_sizes(
    sizes: Sequence[int], cumulative: Sequence[float], to: Path, *, unit: str, title: str
) -> None:
    """Draw how large classes are by rank, both in powers of ten, and the share that they have together.

    Parameters
    ----------
    sizes : sequence of int
        The largest first; at least one.
    cumulative : sequence of float
        Share of all units that so many classes have, 0 … 1; empty: it is not drawn.
    to : Path
        ``….png`` or ``….svg``; a file that is there is replaced.
    unit : str
        What is counted: ``frame``.
    title : str

    Raises
    ------
    ExportError
        The ending is another, or the file cannot be written.
    MissingExtraError
        The packages for drawing are not installed.
    """
    once = sum(1 for size in sizes if size == 1)
    below = f"{len(sizes)} classes, {sum(sizes)} {unit}s; {once} classes come once"
    with sheet(to, title, below) as page:
        x, y = scales(
            page, (1, max(len(sizes), 10)), (1, max(sizes[0], 10)), right=_RIGHT, log=True
        )
        paint_axes(page, x, y, ("rank of the class", f"{unit}s of the class"))
        ranks = np.arange(1, len(sizes) + 1)
        if len(cumulative):
            _draw_share(page, x, Scale(0, 1, y.start, y.end), cumulative, unit)
        page.sheet.plot(
            x.at(ranks), y.at(sizes), color=ROAD_EDGE, linewidth=1.6, marker=".", markersize=2.5
        )


def _draw_share(page: Page, x: Scale, share: Scale, cumulative: Sequence[float], unit: str) -> None:
    """The share that classes have together, with its own numbers to the right."""
    ranks = np.arange(1, len(cumulative) + 1)
    page.sheet.plot(x.at(ranks), share.at(cumulative), color=EGO, linewidth=1.4)
    for value in (0.0, 0.25, 0.5, 0.75, 1.0):
        page.text(x.end + 5, float(share.at(value)) - 2.5, f"{value:.0%}", color=EGO)
    look = {"fontsize": 8, "color": EGO, "rotation": 90, "ha": "center", "va": "center"}
    middle = (share.start + share.end) / 2
    page.text(page.width - 12, middle, f"share of all {unit}s so far", **look)


def draw_growth(
    n: Sequence[int],
    classes: Sequence[int],
    at_random: Sequence[float | None],
    to: Path,
    *,
    unit: str,
    title: str,
    below: str = "",
) -> None:
    """Draw how many classes the first n units have, beside n units at random.

    Parameters
    ----------
    n, classes : sequence of int
    at_random : sequence of float or None
    to : Path
        As in :func:`draw_rank_sizes`.
    unit, title : str
    below : str
        A sentence under the title.

    Raises
    ------
    ExportError, MissingExtraError
        As in :func:`draw_rank_sizes`.
    """
    with sheet(to, title, below) as page:
        x, y = scales(page, (0, max(n)), (0, max(classes) * 1.05))
        paint_axes(page, x, y, (f"{unit}s", "classes"))
        known = [(one, value) for one, value in zip(n, at_random, strict=True) if value is not None]
        key = [("as they came", CHOSEN)]
        if known:
            numbers, values = zip(*known, strict=True)
            page.sheet.plot(x.at(numbers), y.at(values), **AT_RANDOM)
            key.append((f"{unit}s at random", AT_RANDOM))
        page.sheet.plot(x.at(n), y.at(classes), **CHOSEN)
        paint_key(page, x, y, key)


def draw_matrix(
    names: Sequence[str],
    frames: NDArray[np.int64],
    wanted: NDArray[np.bool_],
    to: Path,
    *,
    title: str,
) -> None:
    """Draw which pairs of features occur together, and mark the gaps: pairs that are wanted and do not.

    Parameters
    ----------
    names : sequence of str
        F features.
    frames : (F, F) int64
        Frames with both, symmetric; on the diagonal, with the feature.
    wanted : (F, F) bool
        Which pairs should occur.
    to : Path
        As in :func:`draw_rank_sizes`.
    title : str

    Raises
    ------
    ExportError, MissingExtraError
        As in :func:`draw_rank_sizes`.

    Notes
    -----
    Of more than :data:`MOST_FEATURES` features, those with the most gaps are shown, and the picture says so.
    """
    shown = np.arange(len(names))
    gaps = wanted & (frames == 0)
    pairs = np.triu(wanted, 1)
    below = f"{int((pairs & (frames > 0)).sum())} of {int(pairs.sum())} pairs occur"
    if len(names) > MOST_FEATURES:
        shown = np.sort(np.argsort(-gaps.sum(axis=0), kind="stable")[:MOST_FEATURES])
        below += f"; the {MOST_FEATURES} of {len(names)} features with the most gaps"
    frames, gaps = frames[np.ix_(shown, shown)], gaps[np.ix_(shown, shown)]
    names = [names[i] for i in shown.tolist()]
    side = len(names) * _CELL
    label = 12 + 3.7 * max((len(name) for name in names), default=0)
    with sheet(to, title, below, max(label + side + 30, 420), side + label + 90) as page:
        left, bottom = label, 30.0
        image = _colours(frames, gaps)
        page.sheet.imshow(
            image[::-1],
            extent=(left, left + side, bottom, bottom + side),
            aspect="auto",
            interpolation="nearest",
            origin="lower",
        )
        page.sheet.set_xlim(0, page.width)
        page.sheet.set_ylim(0, page.height)
        for row, name in enumerate(names):
            at = bottom + side - (row + 0.5) * _CELL
            page.text(left - 4, at - 2, name, ha="right", fontsize=6)
            across = left + (row + 0.5) * _CELL
            page.text(
                across, bottom + side + 4, name, rotation=90, ha="center", va="bottom", fontsize=6
            )
        _key(page, left, gaps)


def _colours(frames: NDArray[np.int64], gaps: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(F, F, 3): the darker the more frames, orange where there is a gap."""
    from matplotlib.colors import to_rgb

    weight = np.log1p(frames) / max(float(np.log1p(frames).max(initial=0)), 1e-12)
    pale, dark = np.array([0.93, 0.945, 0.965]), np.array([0.17, 0.33, 0.57])
    image = pale + weight[..., None] * (dark - pale)
    image[frames == 0] = (1.0, 1.0, 1.0)
    image[gaps] = to_rgb(_GAP)
    return image


def _key(page: Page, left: float, gaps: NDArray[np.bool_]) -> None:
    """What the colours mean, below."""
    many = int(np.triu(gaps, 1).sum())
    entries = (
        ("#2b5491", "many frames have both"),
        ("#edf1f6", "few"),
        (_GAP, f"a gap: no frame has both ({many} pairs)"),
    )
    x = min(left, 40.0)
    for colour, text in entries:
        page.sheet.fill(
            [x, x + 9, x + 9, x],
            [10, 10, 19, 19],
            facecolor=colour,
            edgecolor=JUNCTION,
            linewidth=0.4,
        )
        page.text(x + 13, 12, text, fontsize=6.5)
        x += 26 + 3.6 * len(text)


# What a selection keeps, as a picture: after each of its units, beside units in random order ----
# PNG or SVG by the ending of the file's name; the same numbers give the same bytes.


def draw_curve(
    rows: Sequence[tuple[Any, ...]],
    total: int,
    to: Path,
    *,
    unit: str,
    title: str,
    below: str,
) -> None:
    """Draw a curve of coverage against size.

    Parameters
    ----------
    rows : sequence of tuple
        Units; how many elements are kept by so many, ``None`` beyond the selection; the share of that; how many
        as many units keep in random order.
    total : int
        How many elements there are.
    to : Path
        ``….png`` or ``….svg``; a file that is there is replaced.
    unit : str
        What units are: ``clip``.
    title, below : str
        Two sentences above it.

    Raises
    ------
    ExportError
        The ending is another, or the file cannot be written.
    MissingExtraError
        The packages for drawing are not installed.
    """
    most, whole = max((row[0] for row in rows), default=1), max(total, 1)
    random = [(0, 0.0), *((row[0], row[3] / whole) for row in rows)]
    chosen = [(0, 0.0), *((row[0], row[1] / whole) for row in rows if row[1] is not None)]
    with sheet(to, title, below) as page:
        x, y = scales(page, (0, most), (0, 1))
        paint_axes(page, x, y, (f"{unit}s", f"kept, of {total:,}"), up=lambda share: f"{share:.0%}")
        for points, look in ((random, AT_RANDOM), (chosen, CHOSEN)):
            numbers, shares = zip(*points, strict=True)
            page.sheet.plot(x.at(numbers), y.at(shares), **look)
        size, kept = chosen[-1]
        end = float(x.at(size))
        page.sheet.plot([end, end], [y.start, float(y.at(kept))], color=EGO, linewidth=1.0)
        paint_key(
            page, x, y, [(f"selected: {size:,} {unit}s", CHOSEN), (f"{unit}s at random", AT_RANDOM)]
        )
