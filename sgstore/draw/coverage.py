"""Coverage as pictures: sizes of classes by rank, growth, and which pairs of features occur together.

PNG or SVG by the ending of the file's name; the same numbers give the same bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.draw.chart import AT_RANDOM, CHOSEN, Scale, paint_axes, paint_key, scales, sheet
from sgstore.draw.palette import EGO, JUNCTION, ROAD_EDGE

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.draw.page import Page

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
