"""Coverage as pictures: sizes of classes by rank, growth, and which pairs of features occur together.

PNG or SVG by the ending of the file's name; the same numbers give the same bytes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.draw.palette import EGO, FAINT_INK, INK, JUNCTION, ROAD_EDGE, RULE

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.draw.page import Page

_WIDTH: Final = 560.0
_HEIGHT: Final = 330.0
_LEFT: Final = 62.0
_RIGHT: Final = 62.0
_BELOW: Final = 46.0
_ABOVE: Final = 60.0
_CELL: Final = 11.0
_LETTER: Final = 3.9
"""Width of a letter of 7 points, about."""
MOST_FEATURES: Final = 120
"""Features that a matrix shows; of more, those with the most gaps."""


@dataclass(frozen=True, slots=True)
class _Scale:
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


def _sheet(to: Path, width: float, height: float, title: str, below: str) -> Page:
    from sgstore.draw import check_installed

    check_installed()
    from sgstore.draw.page import Page, check_format

    check_format(to)
    page = Page(width, height)
    page.text(14, height - 20, title, fontsize=10, weight="bold")
    for number, line in enumerate(wrap(below, int((width - 28) / _LETTER))[:2]):
        page.text(14, height - 34 - 10 * number, line, fontsize=7, color=FAINT_INK)
    return page


def _axes(page: Page, x: _Scale, y: _Scale, names: tuple[str, str]) -> None:
    """The frame of a chart, with its numbers and what they are."""
    for value in x.ticks():
        at = float(x.at(value))
        page.sheet.plot([at, at], [y.start, y.end], color=RULE, linewidth=0.6)
        page.text(at, y.start - 11, _written(value), ha="center", color=FAINT_INK)
    for value in y.ticks():
        at = float(y.at(value))
        page.sheet.plot([x.start, x.end], [at, at], color=RULE, linewidth=0.6)
        page.text(x.start - 5, at - 2.5, _written(value), ha="right", color=FAINT_INK)
    page.sheet.plot([x.start, x.end], [y.start, y.start], color=INK, linewidth=0.8)
    page.sheet.plot([x.start, x.start], [y.start, y.end], color=INK, linewidth=0.8)
    page.text((x.start + x.end) / 2, y.start - 28, names[0], ha="center", fontsize=8)
    middle = (y.start + y.end) / 2
    page.text(16, middle, names[1], fontsize=8, rotation=90, ha="center", va="center")


def _written(value: float) -> str:
    if value >= 10_000:
        power = math.floor(math.log10(value) / 3)
        return f"{value / 1000**power:g}{('', 'k', 'M', 'G', 'T')[min(power, 4)]}"
    return f"{value:g}"


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
    from sgstore.draw import check_installed

    check_installed()
    from sgstore.draw.page import own_style

    with own_style():
        once = sum(1 for size in sizes if size == 1)
        below = f"{len(sizes)} classes, {sum(sizes)} {unit}s; {once} classes come once"
        page = _sheet(to, _WIDTH, _HEIGHT, title, below)
        x = _Scale(1, max(len(sizes), 10), _LEFT, _WIDTH - _RIGHT, log=True)
        y = _Scale(1, max(sizes[0], 10), _BELOW, _HEIGHT - _ABOVE, log=True)
        _axes(page, x, y, ("rank of the class", f"{unit}s of the class"))
        ranks = np.arange(1, len(sizes) + 1)
        if len(cumulative):
            _draw_share(page, x, _Scale(0, 1, y.start, y.end), cumulative, unit)
        page.sheet.plot(
            x.at(ranks), y.at(sizes), color=ROAD_EDGE, linewidth=1.6, marker=".", markersize=2.5
        )
        page.save(to)


def _draw_share(
    page: Page, x: _Scale, share: _Scale, cumulative: Sequence[float], unit: str
) -> None:
    """The share that classes have together, with its own numbers to the right."""
    ranks = np.arange(1, len(cumulative) + 1)
    page.sheet.plot(x.at(ranks), share.at(cumulative), color=EGO, linewidth=1.4)
    for value in (0.0, 0.25, 0.5, 0.75, 1.0):
        page.text(x.end + 5, float(share.at(value)) - 2.5, f"{value:.0%}", color=EGO)
    look = {"fontsize": 8, "color": EGO, "rotation": 90, "ha": "center", "va": "center"}
    middle = (share.start + share.end) / 2
    page.text(_WIDTH - 12, middle, f"share of all {unit}s so far", **look)


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
    from sgstore.draw import check_installed

    check_installed()
    from sgstore.draw.page import own_style

    with own_style():
        page = _sheet(to, _WIDTH, _HEIGHT, title, below)
        x = _Scale(0, max(n), _LEFT, _WIDTH - _RIGHT)
        y = _Scale(0, max(classes) * 1.05, _BELOW, _HEIGHT - _ABOVE)
        _axes(page, x, y, (f"{unit}s", "classes"))
        known = [(one, value) for one, value in zip(n, at_random, strict=True) if value is not None]
        if known:
            numbers, values = zip(*known, strict=True)
            page.sheet.plot(
                x.at(numbers), y.at(values), color=FAINT_INK, linewidth=1.2, linestyle=(0, (4, 3))
            )
        page.sheet.plot(x.at(n), y.at(classes), color=ROAD_EDGE, linewidth=1.8)
        right, low = x.end - 128, y.start + 12
        page.sheet.plot([right, right + 22], [low + 14, low + 14], color=ROAD_EDGE, linewidth=1.8)
        page.text(right + 28, low + 11.5, "as they came")
        if known:
            page.sheet.plot(
                [right, right + 22],
                [low, low],
                color=FAINT_INK,
                linewidth=1.2,
                linestyle=(0, (4, 3)),
            )
            page.text(right + 28, low - 2.5, f"{unit}s at random")
        page.save(to)


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
    from sgstore.draw import check_installed

    check_installed()
    from sgstore.draw.page import own_style

    shown = np.arange(len(names))
    gaps = wanted & (frames == 0)
    pairs = np.triu(wanted, 1)
    below = f"{int((pairs & (frames > 0)).sum())} of {int(pairs.sum())} pairs occur"
    if len(names) > MOST_FEATURES:
        shown = np.sort(np.argsort(-gaps.sum(axis=0), kind="stable")[:MOST_FEATURES])
        below += f"; the {MOST_FEATURES} of {len(names)} features with the most gaps"
    frames, gaps = frames[np.ix_(shown, shown)], gaps[np.ix_(shown, shown)]
    names = [names[i] for i in shown.tolist()]
    with own_style():
        side = len(names) * _CELL
        label = 12 + 3.7 * max((len(name) for name in names), default=0)
        page = _sheet(to, max(label + side + 30, 420), side + label + _ABOVE + 30, title, below)
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
        page.save(to)


def _colours(frames: NDArray[np.int64], gaps: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(F, F, 3): the darker the more frames, orange where there is a gap."""
    weight = np.log1p(frames) / max(float(np.log1p(frames).max(initial=0)), 1e-12)
    pale, dark = np.array([0.93, 0.945, 0.965]), np.array([0.17, 0.33, 0.57])
    image = pale + weight[..., None] * (dark - pale)
    image[frames == 0] = (1.0, 1.0, 1.0)
    image[gaps] = (0.91, 0.44, 0.04)
    return image


def _key(page: Page, left: float, gaps: NDArray[np.bool_]) -> None:
    """What the colours mean, below."""
    many = int(np.triu(gaps, 1).sum())
    entries = (
        ("#2b5491", "many frames have both"),
        ("#edf1f6", "few"),
        (EGO, f"a gap: no frame has both ({many} pairs)"),
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
