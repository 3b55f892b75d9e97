"""The sheet of paper: the only room that knows how pictures are written.

A page is measured in points (1/72 inch) from its lower left corner; a stage is a window on the map
upon it, measured in metres. Drawing goes through figures of their own, never through global state;
what a user's configuration of the drawing package says does not reach the picture, so that the same
frame gives the same bytes.
"""

from __future__ import annotations

import io
import threading
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from PIL import Image

from sgstore.draw import layers
from sgstore.draw.indexed import indexed
from sgstore.draw.palette import GROUND, INK, PAPER
from sgstore.draw.view import clean
from sgstore.errors import ExportError

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from sgstore.draw.labels import Rect
    from sgstore.draw.view import View
    from sgstore.world import Floats

DPI: Final = 130
FORMATS: Final = (".png", ".svg")
PICTURE_PIXELS: Final = 64_000_000
"""Most pixels of a camera picture that is opened."""
PICTURE_SIDE: Final = 640
"""Longest side to which a camera picture is reduced; pixels."""

_STYLE: Final = (
    "font.",
    "text.",
    "path.",
    "svg.",
    "savefig.",
    "figure.",
    "patch.",
    "lines.",
    "axes.",
    "image.",
    "agg.",
)
_ONE_AT_A_TIME: Final = threading.RLock()


@contextmanager
def own_style() -> Generator[None]:
    """Draw in the style of this house, whatever the user's configuration says; restores it afterwards."""
    style: dict[Any, Any] = {k: v for k, v in mpl.rcParamsDefault.items() if k.startswith(_STYLE)}
    style |= {"svg.fonttype": "none", "svg.hashsalt": "sgstore"}
    # At this size letters look better unhinted, and are faster.
    style["text.hinting"] = "none"
    # The package keeps its settings for the whole process: two pictures at once would mix them.
    with _ONE_AT_A_TIME, mpl.rc_context(style):
        yield


@dataclass(frozen=True, slots=True)
class Stage:
    """A window on the map upon a page.

    Attributes
    ----------
    axes : Axes
        Measured in metres from the middle of the window.
    view : View
    half : (float, float)
        Half its width and height; m.
    points : float
        Points of the page in a metre.
    page : Page
    """

    axes: Axes
    view: View
    half: tuple[float, float]
    points: float
    page: Page

    @property
    def metre(self) -> float:
        """Metres in one point: sizes that are meant for the eye are given in points."""
        return 1.0 / self.points

    def rect(self, half_x: float, half_y: float, middle: tuple[float, float]) -> Rect:
        """A rectangle of the window, given in metres, in points of the page from the window's middle."""
        (x, y), scale = middle, self.points
        return (
            (x - half_x) * scale,
            (y - half_y) * scale,
            (x + half_x) * scale,
            (y + half_y) * scale,
        )

    def shows(self, x: float, y: float) -> bool:
        """Whether a point lies in the window."""
        return abs(x) <= self.half[0] and abs(y) <= self.half[1]

    def fill(
        self, outline: Outline, colour: str, *, z: float, gid: str | None = None, **look: Any
    ) -> None:
        """Fill an outline; ``look`` goes to the patch."""
        patch = PathPatch(outline, facecolor=colour, zorder=z, **{"linewidth": 0.0, **look})
        patch.set_gid(gid)
        self.axes.add_artist(patch)

    def fill_all(
        self,
        outlines: Sequence[Outline],
        colour: str,
        *,
        z: float,
        edge: float = 0.4,
        alpha: float = 1.0,
    ) -> None:
        """Fill many outlines with one colour, with a hairline of the same that closes the seams."""
        if outlines:
            self.axes.add_artist(
                PathCollection(
                    list(outlines),
                    facecolors=[colour],
                    edgecolors=[colour],
                    linewidths=[edge],
                    alpha=alpha,
                    zorder=z,
                )
            )

    def lines(
        self, lines: Sequence[Floats], colour: str, *, z: float, width: float, **look: Any
    ) -> None:
        """Draw many lines of (N, 2) picture coordinates in one look."""
        if lines:
            self.axes.add_artist(
                PathCollection(
                    [Outline(line) for line in lines],
                    facecolors=["none"],
                    edgecolors=[colour],
                    linewidths=[width],
                    zorder=z,
                    **look,
                )
            )

    def text(self, x: float, y: float, text: str, **look: Any) -> None:
        """Write in the window; see :meth:`Page.text`."""
        self.page.write(self.axes, x, y, text, **{"clip_on": True, **look})


class Page:
    """A sheet of paper.

    Parameters
    ----------
    width, height : float
        In points.
    dpi : float
        Pixels of an inch, where it is drawn in pixels.
    """

    def __init__(self, width: float, height: float, dpi: float = DPI) -> None:
        self.width = width
        self.height = height
        self._dpi = dpi
        self._figure = Figure(figsize=(width / 72, height / 72), dpi=dpi, facecolor=PAPER)
        self._canvas = FigureCanvasAgg(self._figure)
        self.sheet = self._axes(0, 0, width, height)
        self.sheet.set_xlim(0, width)
        self.sheet.set_ylim(0, height)

    def stage(self, box: Rect, view: View) -> Stage:
        """A window upon the page; ``view.radius`` is half its shorter side.

        Parameters
        ----------
        box : Rect
            Left, bottom, right, top on the page.
        view : View
        """
        left, bottom, right, top = box
        width, height = right - left, top - bottom
        points = min(width, height) / (2 * view.radius)
        half = (width / points / 2, height / points / 2)
        axes = self._axes(left, bottom, width, height)
        axes.set_xlim(-half[0], half[0])
        axes.set_ylim(-half[1], half[1])
        stage = Stage(axes, view, half, points, self)
        corners = np.array(((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))) * half
        stage.fill(Outline(corners), GROUND, z=layers.WINDOW)
        return stage

    def text(self, x: float, y: float, text: str, **look: Any) -> None:
        """Write on the sheet.

        The text is taken as it stands: no markup is interpreted, whatever it holds.
        """
        self.write(self.sheet, x, y, text, **look)

    def write(self, axes: Axes, x: float, y: float, text: str, **look: Any) -> None:
        """Write on a sheet or in a window, in its own measure."""
        gid = look.pop("gid", None)
        style: dict[str, Any] = {"fontsize": 7.0, "color": INK, "va": "baseline", **look}
        axes.text(x, y, printable(text), parse_math=False, **style).set_gid(gid)

    def text_size(self, text: str, size: float, weight: str = "normal") -> tuple[float, float]:
        """Width and height of a text; points."""
        font = FontProperties(size=size, weight=weight)
        width, height, _ = self._canvas.get_renderer().get_text_width_height_descent(
            printable(text),
            font,
            False,  # noqa: FBT003  its only spelling that all releases know
        )
        return width * 72 / self._dpi, height * 72 / self._dpi

    def picture(
        self, picture: bytes, left: float, top: float, width: float, height: float
    ) -> float:
        """Lay a camera picture on the sheet, in a width and height at most; returns its height in points.

        Raises
        ------
        ExportError
            If it is neither JPEG nor PNG, is damaged, or has too many pixels.
        """
        pixels = _decoded(picture)
        scale = min(width / pixels.shape[1], height / pixels.shape[0])
        width, height = scale * pixels.shape[1], scale * pixels.shape[0]
        axes = self._axes(left, top - height, width, height)
        axes.imshow(pixels, extent=(0, 1, 0, 1), aspect="auto", interpolation="antialiased")
        axes.set_axis_off()
        return height

    def save(self, to: Path) -> None:
        """Write the page as PNG or SVG, as the ending says; a picture that is there is replaced.

        Raises
        ------
        ExportError
            If the ending is another, or the file cannot be written.
        """
        drawn = self._svg() if check_format(to) == "svg" else self._png()
        try:
            to.write_bytes(drawn)
        except OSError as error:
            raise ExportError(f"cannot write the picture {to}: {error.strerror}") from error

    def _svg(self) -> bytes:
        written = io.BytesIO()
        self._figure.savefig(written, format="svg", metadata={"Creator": "sgstore", "Date": None})
        return written.getvalue()

    def pixels(self) -> NDArray[np.uint8]:
        """(height, width, 3) uint8: the page as it is seen."""
        self._canvas.draw()
        return np.ascontiguousarray(np.asarray(self._canvas.buffer_rgba())[..., :3])

    def _png(self) -> bytes:
        written = io.BytesIO()
        indexed(Image.fromarray(self.pixels())).save(written, "PNG")
        return written.getvalue()

    def _axes(self, left: float, bottom: float, width: float, height: float) -> Axes:
        box = (left / self.width, bottom / self.height, width / self.width, height / self.height)
        axes = self._figure.add_axes(box)
        axes.set_axis_off()
        axes.set_autoscale_on(False)
        return axes


def check_format(to: Path) -> str:
    """``png`` or ``svg``, by the ending of a file's name."""
    if to.suffix.lower() not in FORMATS:
        raise ExportError(
            f"cannot draw {to.name!r}: a picture is {' or '.join(FORMATS)}, so end the name in one of these"
        )
    return to.suffix.lower()[1:]


def printable(text: str) -> str:
    """A text in characters that the font has; ``□`` for others."""
    known = _characters()
    return "".join(c if ord(c) in known else "□" for c in clean(text, 200))


@cache
def _characters() -> frozenset[int]:
    return frozenset(get_font(findfont(FontProperties())).get_charmap())


def _decoded(picture: bytes) -> np.ndarray[Any, np.dtype[np.uint8]]:
    try:
        with Image.open(io.BytesIO(picture), formats=("JPEG", "PNG")) as image:
            if image.width * image.height > PICTURE_PIXELS:
                raise ExportError(
                    f"the camera picture has {image.width} by {image.height} pixels, more than is opened"
                )
            image.draft("RGB", (PICTURE_SIDE, PICTURE_SIDE))
            image.thumbnail((PICTURE_SIDE, PICTURE_SIDE))
            return np.asarray(image.convert("RGB"))
    # Decoders of untrusted bytes fail in many ways: each of them means an unusable picture.
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ExportError(f"the camera picture is not a readable JPEG or PNG: {error}") from error
