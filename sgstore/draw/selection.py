"""What a selection keeps, as a picture: after each of its units, beside units in random order.

PNG or SVG by the ending of the file's name; the same numbers give the same bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from sgstore.draw.palette import EGO, FAINT_INK, INK, ROAD_EDGE, RULE

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

_WIDTH: Final = 560.0
_HEIGHT: Final = 330.0
_LEFT, _RIGHT, _BELOW, _ABOVE = 62.0, 24.0, 46.0, 60.0
_TICKS: Final = 5


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
    from sgstore.draw import check_installed

    check_installed()
    from sgstore.draw.page import Page, check_format, own_style

    check_format(to)
    most = max((row[0] for row in rows), default=1)
    right, top = _WIDTH - _RIGHT, _HEIGHT - _ABOVE

    def across(n: float) -> float:
        return _LEFT + n / most * (right - _LEFT)

    def up(kept: float) -> float:
        return _BELOW + kept / max(total, 1) * (top - _BELOW)

    with own_style():
        page = Page(_WIDTH, _HEIGHT)
        page.text(14, _HEIGHT - 20, title, fontsize=10, weight="bold")
        page.text(14, _HEIGHT - 34, below, fontsize=7, color=FAINT_INK)
        for tick in range(_TICKS + 1):
            share = tick / _TICKS
            page.sheet.plot([_LEFT, right], [up(share * total)] * 2, color=RULE, linewidth=0.6)
            page.text(
                _LEFT - 5, up(share * total) - 2.5, f"{share:.0%}", ha="right", color=FAINT_INK
            )
        for n in _round_numbers(most):
            page.text(across(n), _BELOW - 11, f"{n:,}", ha="center", color=FAINT_INK)
        page.sheet.plot([_LEFT, right], [_BELOW, _BELOW], color=INK, linewidth=0.8)
        page.sheet.plot([_LEFT, _LEFT], [_BELOW, top], color=INK, linewidth=0.8)
        page.text((_LEFT + right) / 2, _BELOW - 28, f"{unit}s", ha="center", fontsize=8)
        middle = (_BELOW + top) / 2
        look: dict[str, Any] = {"fontsize": 8, "rotation": 90, "ha": "center", "va": "center"}
        page.text(16, middle, f"kept, of {total:,}", **look)
        random = [(0.0, 0.0), *((row[0], row[3]) for row in rows)]
        chosen = [(0.0, 0.0), *((row[0], row[1]) for row in rows if row[1] is not None)]
        dashed: dict[str, Any] = {"color": FAINT_INK, "linewidth": 1.2, "linestyle": (0, (4, 3))}
        page.sheet.plot([across(n) for n, _ in random], [up(k) for _, k in random], **dashed)
        page.sheet.plot(
            [across(n) for n, _ in chosen],
            [up(k) for _, k in chosen],
            color=ROAD_EDGE,
            linewidth=1.8,
        )
        end, reached = chosen[-1]
        page.sheet.plot([across(end)] * 2, [_BELOW, up(reached)], color=EGO, linewidth=1.0)
        at, low = right - 118, _BELOW + 12
        page.sheet.plot([at, at + 22], [low + 14] * 2, color=ROAD_EDGE, linewidth=1.8)
        page.text(at + 28, low + 11.5, f"selected: {end:,.0f} {unit}s")
        page.sheet.plot([at, at + 22], [low] * 2, **dashed)
        page.text(at + 28, low - 2.5, f"{unit}s at random")
        page.save(to)


def _round_numbers(most: int) -> range:
    """Some five round numbers up to a number."""
    step = 10 ** max(len(str(most)) - 2, 0)
    step *= next(one for one in (1, 2, 5, 10, 20) if most / (one * step) <= _TICKS + 1)
    return range(0, most + 1, step)
