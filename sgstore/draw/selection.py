"""What a selection keeps, as a picture: after each of its units, beside units in random order.

PNG or SVG by the ending of the file's name; the same numbers give the same bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sgstore.draw.chart import AT_RANDOM, CHOSEN, paint_axes, paint_key, scales, sheet
from sgstore.draw.palette import EGO

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


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
