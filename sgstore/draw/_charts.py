"""Charts of coverage and selection: class sizes by rank, growth, pairs of features, selection curves.

The file ending selects PNG or SVG; the same numbers give the same bytes.
"""

from __future__ import annotations

from contextlib import contextmanager
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.draw._palette import EGO, FAINT_INK, INK, JUNCTION, ROAD_EDGE

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from sgstore.draw._page import Page


_WIDTH: Final = 560.0
_HEIGHT: Final = 330.0
_LEFT: Final = 62.0
_RIGHT: Final = 24.0
_BELOW: Final = 46.0
_ABOVE: Final = 72.0
_LETTER: Final = 3.9
"""Approximate width of a letter in a font of 7 points; points."""

CHOSEN: Final[Mapping[str, Any]] = {"color": ROAD_EDGE, "linewidth": 1.8}
"""Style of the main line of a chart."""
AT_RANDOM: Final[Mapping[str, Any]] = {
    "color": FAINT_INK,
    "linewidth": 1.2,
    "linestyle": (0, (4, 3)),
}
"""Style of the line for comparison in a chart."""


@contextmanager
def _page(
    to: Path, title: str, below: str, width: float = _WIDTH, height: float = _HEIGHT
) -> Generator[Page]:
    """Yield a page with a title and a subtitle, and write it to a file at the end.

    Raises
    ------
    ExportError
        The ending of ``to`` is not a picture format, or the file cannot be written.
    MissingExtraError
        The packages for drawing are not installed.
    """
    from sgstore.draw._picture import drawing

    with drawing(to):
        from sgstore.draw._page import Page

        page = Page(width, height)
        page.text(14, height - 20, title, fontsize=10, weight="bold")
        for number, line in enumerate(wrap(below, int((width - 28) / _LETTER))[:2]):
            page.text(14, height - 34 - 10 * number, line, fontsize=7, color=FAINT_INK)
        yield page
        page.save(to)


@contextmanager
def _chart(
    to: Path, title: str, below: str, names: tuple[str, str], right: float = _RIGHT
) -> Generator[Axes]:
    """Yield the axes of a chart on a new page, with axis titles. At the end, write the page to a file."""
    with _page(to, title, below) as page:
        axes = page.plot(_LEFT, _BELOW, page.width - right, page.height - _ABOVE)
        axes.set_xlabel(names[0], fontsize=8, color=INK, parse_math=False)
        axes.set_ylabel(names[1], fontsize=8, color=INK, parse_math=False)
        yield axes


def _number_axes(axes: Axes) -> None:
    """Write short numbers (``25 k``) at round values on both axes of a chart, from 0 on."""
    from matplotlib.ticker import EngFormatter, MaxNLocator

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=True))
        axis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)


def _key(axes: Axes) -> None:
    """Draw the legend of the lines of a chart above the chart."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1, 1), ncols=4, fontsize=7, labelcolor=INK, frameon=False
    )


_GAP: Final = "#f5b877"
_CANNOT: Final = "#dcdcdc"
_CELL: Final = 11.0
MOST_FEATURES: Final = 120
"""Largest number of features in a matrix. Features with the most missing pairs are selected."""


def draw_rank_sizes(
    sizes: Sequence[int], cumulative: Sequence[float], to: Path, *, unit: str, title: str
) -> None:
    """Draw a chart of class sizes by rank, on logarithmic axes, with their cumulative share.

    Parameters
    ----------
    sizes : sequence of int
        Largest first; at least one.
    cumulative : sequence of float
        Share of all units in the classes up to this rank, 0 … 1; empty for no line.
    to : Path
        ``….png`` or ``….svg``; an existing file is replaced.
    unit : str
        The counted unit: ``frame``.
    title : str

    Raises
    ------
    ExportError
        The ending is unknown, or the file cannot be written.
    MissingExtraError
        The packages for drawing are not installed.
    """
    from matplotlib.ticker import EngFormatter, LogLocator, NullLocator, PercentFormatter

    once = sum(1 for size in sizes if size == 1)
    below = f"{len(sizes)} classes, {sum(sizes)} {unit}s; {once} classes come once"
    ranks = np.arange(1, len(sizes) + 1)
    names = ("rank of the class", f"{unit}s of the class")
    with _chart(to, title, below, names, right=62.0) as axes:
        axes.loglog(ranks, sizes, color=ROAD_EDGE, linewidth=1.6, marker=".", markersize=2.5)
        axes.set_xlim(1, max(len(sizes), 10))
        axes.set_ylim(1, max(sizes[0], 10))
        for axis, most in ((axes.xaxis, len(sizes)), (axes.yaxis, sizes[0])):
            axis.set_major_formatter(EngFormatter(sep=""))
            axis.set_minor_locator(NullLocator())
            if most < 100:  # powers of ten alone would be two numbers
                axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        if len(cumulative):
            share: Axes = axes.twinx()
            share.plot(
                ranks[: len(cumulative)], cumulative, color=EGO, linewidth=1.4, clip_on=False
            )
            share.set_ylim(0, 1)
            share.set_ylabel(
                f"share of all {unit}s so far", fontsize=8, color=EGO, parse_math=False
            )
            share.yaxis.set_major_formatter(PercentFormatter(1))
            share.tick_params(length=0, labelsize=7, labelcolor=EGO)
            share.spines[:].set_visible(False)


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
    """Draw a chart: the number of scene classes in the first n frames, and in n randomly chosen frames.

    Parameters
    ----------
    n, classes : sequence of int
    at_random : sequence of float or None
    to : Path
        As in :func:`draw_rank_sizes`.
    unit, title : str
    below : str
        Subtitle.

    Raises
    ------
    ExportError, MissingExtraError
        As in :func:`draw_rank_sizes`.
    """
    with _chart(to, title, below, (f"{unit}s", "classes")) as axes:
        axes.plot(n, classes, label="as they came", **CHOSEN)
        values = np.array(at_random, np.float64)
        if np.isfinite(values).any():
            axes.plot(n, values, label=f"{unit}s at random", zorder=1.9, **AT_RANDOM)
        axes.set_xlim(0, max(n))
        axes.set_ylim(0, np.nanmax([*classes, *values]) * 1.05)
        _number_axes(axes)
        _key(axes)


def draw_matrix(
    names: Sequence[str],
    frames: NDArray[np.int64],
    wanted: NDArray[np.bool_],
    to: Path,
    *,
    title: str,
    groups: Sequence[str] = (),
    most: int = MOST_FEATURES,
) -> None:
    """Draw a matrix of feature pairs: the number of frames in which both occur, and the missing pairs.

    Each pair has one place, below the diagonal.

    Parameters
    ----------
    names : sequence of str
        F features, or values of slots.
    frames : (F, F) int64
        Frames with both features, symmetric; on the diagonal, frames with the feature.
    wanted : (F, F) bool
        Mask of the pairs that should occur.
    to : Path
        As in :func:`draw_rank_sizes`.
    title : str
    groups : sequence of str, optional
        Slot of each value; the values of a slot are contiguous. Lines separate the slots, and
        impossible pairs are grey.

    most : int
        Greatest number of features shown.

    Raises
    ------
    ExportError, MissingExtraError
        As in :func:`draw_rank_sizes`.

    Notes
    -----
    Features with exactly the same frames, such as both directions of an edge, are shown once, with
    preference for the ego's. Above ``most``, the features with the most gaps are shown. A gap
    counts as the product of both frame counts: a missing pair of frequent features is more
    surprising. The picture mentions the omission.
    """
    from matplotlib.colors import to_rgb

    from sgstore.draw._page import printable

    shown = np.arange(len(names))
    gaps = wanted & (frames == 0)
    pairs = np.triu(wanted, 1)
    below = f"{int((pairs & (frames > 0)).sum())} of {int(pairs.sum())} pairs occur"
    if not groups:
        shown = _one_direction(names, frames, wanted)
        if len(shown) < len(names):
            below += (
                f"; {len(names) - len(shown)} features are in the same frames as one of the others"
            )
    if len(shown) > most:
        what = "values" if groups else "features"
        below += f"; of {len(shown)} {what} the {most} with the most gaps"
        shown = _most_surprising(shown, frames, gaps, most)
    square = np.ix_(shown, shown)
    groups = [groups[i] for i in shown.tolist()] if groups else []
    image = _cells(frames[square], gaps[square], wanted[square], groups)
    gaps = gaps[square]
    names = [printable(names[i]) for i in shown.tolist()]
    rows, columns = _compared(groups, len(names))
    image = image[rows, columns]
    label = 12 + 3.7 * max((len(name) for name in names), default=0)
    least = max(480 if groups else 420, 7.4 * len(title))  # for the texts above and below
    high, wide = image.shape[:2]
    cell = min(max((least - label - 30) / max(wide, 1), _CELL), _LARGEST_CELL)
    high, wide = high * cell, wide * cell
    if groups:  # few values, with a long legend below
        wide = max(2 * wide, least - label - 30)
    with _page(to, title, below, max(label + wide + 30, least), high + label + 80) as page:
        axes = page.plot(label, 30.0 + label, label + wide, 30.0 + label + high)
        axes.imshow(image, interpolation="nearest", aspect="auto")
        axes.grid(visible=False)
        axes.spines[:].set_visible(False)
        look: dict[str, Any] = {"fontsize": 6, "color": INK, "parse_math": False}
        axes.set_xticks(range(len(names[columns])), names[columns], rotation=90, **look)
        axes.set_yticks(range(len(names[rows])), names[rows], **look)
        for draw, part in ((axes.axhline, groups[rows]), (axes.axvline, groups[columns])):
            for place in range(1, len(part)):
                if part[place] != part[place - 1]:
                    draw(place - 0.5, color=INK, linewidth=0.6)
        cannot = bool((image == to_rgb(_CANNOT)).all(axis=2).any())
        _explain_colours(page, gaps, cannot=cannot)


def _most_surprising(
    shown: NDArray[np.int64], frames: NDArray[np.int64], gaps: NDArray[np.bool_], most: int
) -> NDArray[np.int64]:
    """Return the features with the most surprising missing pairs, in which both features are frequent."""
    often = np.diagonal(frames) + 1.0
    surprise = (gaps[np.ix_(shown, shown)] * often[shown]).sum(axis=1) * often[shown]
    return np.sort(shown[np.argsort(-surprise, kind="stable")[:most]])


def _cells(
    frames: NDArray[np.int64],
    gaps: NDArray[np.bool_],
    wanted: NDArray[np.bool_],
    groups: Sequence[str],
) -> NDArray[np.float64]:
    """Return the colours of a matrix of pairs. Pairs within a group are white, other impossible pairs grey."""
    from matplotlib.colors import to_rgb

    image = _colours(frames, gaps)
    if groups:
        image[~wanted & ~np.eye(len(frames), dtype=np.bool_)] = to_rgb(_CANNOT)
    for group in {*groups}:  # a slot has one value
        same = [i for i, one in enumerate(groups) if one == group]
        image[np.ix_(same, same)] = (1.0, 1.0, 1.0)
    image[np.triu_indices(len(frames), 1)] = (1.0, 1.0, 1.0)
    return image


_LARGEST_CELL: Final = 24.0
"""Largest side of a cell of a small matrix; points."""


def _compared(groups: Sequence[str], count: int) -> tuple[slice, slice]:
    """Return the row range and the column range of a matrix of pairs, without empty rows and columns."""
    if len({*groups}) < 2:
        return slice(count), slice(count)
    return slice(groups.count(groups[0]), count), slice(count - groups.count(groups[-1]))


def _one_direction(
    names: Sequence[str], frames: NDArray[np.int64], wanted: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Return indices of features. If features occur in exactly the same frames, only one is returned."""
    order = np.array(
        sorted(range(len(names)), key=lambda i: not names[i].startswith("ego ")), np.intp
    )
    told = np.hstack([frames, wanted])[order]
    _, first = np.unique(told, axis=0, return_index=True)
    return np.sort(order[first])


def _colours(frames: NDArray[np.int64], gaps: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the cell colours of a matrix of feature pairs, (F, F, 3) for F features.

    A cell is darker for more frames, and orange for a missing pair.
    """
    from matplotlib.colors import to_rgb

    weight = np.log1p(frames) / max(float(np.log1p(frames).max(initial=0)), 1e-12)
    pale, dark = np.array([0.93, 0.945, 0.965]), np.array([0.17, 0.33, 0.57])
    image = pale + weight[..., None] * (dark - pale)
    image[frames == 0] = (1.0, 1.0, 1.0)
    image[gaps] = to_rgb(_GAP)
    return image


def _explain_colours(page: Page, gaps: NDArray[np.bool_], *, cannot: bool) -> None:
    """Draw the legend of the cell colours below a matrix of feature pairs."""
    from matplotlib.patches import Patch

    many = int(np.triu(gaps, 1).sum())
    entries = {
        "many frames have both": "#2b5491",
        "few": "#edf1f6",
        f"a gap: no frame has both ({many} pairs)": _GAP,
    }
    entries |= {"does not count": _CANNOT} if cannot else {}
    handles = [
        Patch(facecolor=colour, edgecolor=JUNCTION, linewidth=0.4, label=text)
        for text, colour in entries.items()
    ]
    look: dict[str, Any] = {"fontsize": 6.5, "handlelength": 1.2, "handleheight": 1.2}
    page.legend(handles, (8, 4), "lower left", ncols=len(handles), **look)


def draw_curve(
    rows: Sequence[tuple[Any, ...]],
    total: int,
    to: Path,
    *,
    unit: str,
    title: str,
    below: str,
    words: tuple[str, str] = ("kept", "selected"),
) -> None:
    """Draw a chart of covered classes, or of found failures, by the number of selected test cases.

    Parameters
    ----------
    rows : sequence of tuple
        Number of units; number of covered elements, ``None`` beyond the selection; its share;
        covered elements for as many units in random order.
    total : int
        Number of elements.
    to : Path
        ``….png`` or ``….svg``; an existing file is replaced.
    unit : str
        Kind of the units: ``clip``.
    title, below : str
        Title and subtitle.
    words : tuple of str
        Labels of the elements and of the units: ``failures found``, ``in order``.

    Raises
    ------
    ExportError
        The ending is unknown, or the file cannot be written.
    MissingExtraError
        The packages for drawing are not installed.
    """
    from matplotlib.ticker import MultipleLocator, PercentFormatter

    most, whole = max((row[0] for row in rows), default=1), max(total, 1)
    random = [(0, 0.0), *((row[0], row[3] / whole) for row in rows)]
    chosen = [(0, 0.0), *((row[0], row[1] / whole) for row in rows if row[1] is not None)]
    with _chart(to, title, below, (f"{unit}s", f"{words[0]}, of {total:,}")) as axes:
        axes.plot(*zip(*random, strict=True), label=f"{unit}s at random", **AT_RANDOM)
        size, share = chosen[-1]
        label = f"{words[1]}: {size:,} {unit}s"
        axes.plot(*zip(*chosen, strict=True), label=label, **CHOSEN)
        axes.vlines(size, 0, share, color=EGO, linewidth=1.0)
        axes.set_xlim(0, most)
        axes.set_ylim(0, 1)
        _number_axes(axes)
        axes.yaxis.set_major_locator(MultipleLocator(0.2))
        axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        _key(axes)
