"""Page of a picture: drawing of shapes and texts by matplotlib, drawing order, PNG and SVG files."""

from __future__ import annotations

import io
import threading
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from PIL import Image, ImageChops

from sgstore.base.output_files import write_bytes
from sgstore.draw._palette import FAINT_INK, GROUND, INK, PAPER, RULE
from sgstore.draw._view import clean
from sgstore.errors import ExportError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Hashable, Sequence

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from sgstore.draw._view import MapWindow
    from sgstore.model.world import Floats

    Pixels = NDArray[np.uint8]


Rect = tuple[float, float, float, float]
"""Rectangle: left, bottom, right and top."""

WINDOW: Final = 0.0
LANES: Final = 1.0
STOREY: Final = 0.03
"""Step in the drawing order from one storey of roads to the next. All storeys are drawn below the tints."""
TINTS: Final = 1.4
MARKS: Final = 1.6
SCENERY: Final = 1.8
RINGS: Final = 2.0
LINKS: Final = 3.0
HALOS: Final = 3.8
ARROWS: Final = 4.0
BODIES: Final = 5.0
LAMPS: Final = 5.5
LINK_TEXTS: Final = 6.0
CAPTIONS: Final = 7.0
FURNITURE: Final = 9.0


MOST_CHANGE: Final = 24
"""Largest change of a colour channel (0 … 255) by a palette. A picture with a larger change gets no palette."""


# Pictures use 256 colours if that is enough: a third of the bytes, without a visible difference. Of
# Pillow's quantisers, only this one keeps rare colours; the k-means step keeps the colours of areas.


LEARNED: Final = 2_000_000
"""Largest number of pixels from which a palette is computed. The time grows faster than their number."""


def quantized(picture: Image.Image) -> Image.Image:
    """Reduce an RGB picture to 256 colours. The palette of a large picture is derived from some rows only."""
    plain, every = Image.Dither.NONE, -(-picture.width * picture.height // LEARNED)
    sample = Image.fromarray(np.asarray(picture)[::every]) if every > 1 else picture
    made = sample.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=100_000, dither=plain)
    return picture.quantize(palette=made, dither=plain) if every > 1 else made


def greatest_change(made: Image.Image, picture: Image.Image) -> int:
    """Return the greatest difference of a colour channel between two pictures, 0 to 255."""
    return int(np.asarray(ImageChops.difference(picture, made.convert("RGB"))).max())


# A page is measured in points (1/72 inch) from its lower left corner. A stage is a window of the
# map on the page, measured in metres. Each drawing has its own figure, without global state. The
# user's matplotlib configuration has no effect, so that the same frame gives the same bytes.

DPI: Final = 130
FORMATS: Final = (".png", ".svg")
TEXT: Final[dict[str, Any]] = {"fontsize": 7.0, "color": INK, "va": "baseline"}
"""Default style of texts."""
PICTURE_PIXELS: Final = 64_000_000
"""Largest number of pixels of a camera picture."""
PICTURE_SIDE: Final = 640
"""Longest side of a reduced camera picture; pixels."""

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
    "xtick.",
    "ytick.",
    "legend.",
    "grid.",
    "scatter.",
)
_ONE_AT_A_TIME: Final = threading.RLock()


@contextmanager
def own_style() -> Generator[None]:
    """Context manager with the fixed matplotlib style of this package instead of the user's style."""
    # matplotlib has one configuration per process: two pictures at once would mix them.
    with _ONE_AT_A_TIME, mpl.rc_context():
        dict.update(mpl.rcParams, _style())  # the values are already validated
        yield


@cache
def _style() -> dict[Any, Any]:
    """Return the matplotlib settings for the pictures of this package."""
    style: dict[Any, Any] = {k: v for k, v in mpl.rcParamsDefault.items() if k.startswith(_STYLE)}
    # At this size unhinted letters look better and are faster.
    style |= {"svg.fonttype": "none", "svg.hashsalt": "sgstore", "text.hinting": "none"}
    with mpl.rc_context(style):
        return {name: mpl.rcParams[name] for name in style}


@dataclass(frozen=True, slots=True)
class Stage:
    """Window on a page that shows part of a road map.

    Attributes
    ----------
    axes : Axes
        Measured in metres from the middle of the window.
    view : MapWindow
    half : (float, float)
        Half its width and height; m.
    points : float
        Points of the page per metre.
    page : Page
    """

    axes: Axes
    view: MapWindow
    half: tuple[float, float]
    points: float
    page: Page

    @property
    def metre(self) -> float:
        """Return the number of metres per point (1/72 inch) of the page."""
        return 1.0 / self.points

    def rect(self, half_x: float, half_y: float, middle: tuple[float, float]) -> Rect:
        """Convert a rectangle of the map window from metres to points (1/72 inch)."""
        (x, y), scale = middle, self.points
        return (
            (x - half_x) * scale,
            (y - half_y) * scale,
            (x + half_x) * scale,
            (y + half_y) * scale,
        )

    def shows(self, x: float, y: float) -> bool:
        """True if a point is inside the map window."""
        return abs(x) <= self.half[0] and abs(y) <= self.half[1]

    def fill(
        self, outline: Outline, colour: str, *, z: float, gid: str | None = None, **look: Any
    ) -> None:
        """Fill an outline in the map window; ``look`` contains attributes of a matplotlib patch."""
        look = {"facecolor": colour, "linewidth": 0.0, **look}
        self.page.fill(self.axes, outline, z, look, gid)

    def fill_all(
        self,
        outlines: Sequence[Outline],
        colour: str,
        *,
        z: float,
        edge: float = 0.4,
        alpha: float = 1.0,
    ) -> None:
        """Fill many outlines in the map window with one colour, without visible seams."""
        if outlines:
            look = {"facecolor": colour, "edgecolor": colour, "linewidth": edge, "alpha": alpha}
            self.page.fill_all(self.axes, list(outlines), z, look)

    def lines(
        self, lines: Sequence[Floats], colour: str, *, z: float, width: float, **look: Any
    ) -> None:
        """Draw many lines (N, 2) in the map window in the same style."""
        if lines:
            look |= {"facecolor": "none", "edgecolor": colour, "linewidth": width}
            self.page.fill_all(self.axes, [Outline(line) for line in lines], z, look)

    def text(self, x: float, y: float, text: str, **look: Any) -> None:
        """Write a text in the map window, in the units of the window."""
        self.page.write(self.axes, x, y, text, **{"clip_on": True, **look})


class Page:
    """Page for drawing, with shapes, texts and windows; saved as PNG or SVG.

    Parameters
    ----------
    width, height : float
        Size in points.
    dpi : float
        Pixels per inch, for pixel output.
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

    def stage(self, box: Rect, view: MapWindow) -> Stage:
        """Return a window on the page that shows part of a road map.

        Parameters
        ----------
        box : Rect
            Left, bottom, right, top on the page.
        view : MapWindow
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
        stage.fill(Outline(corners), GROUND, z=WINDOW)
        return stage

    def add(self, axes: Axes, artist: Artist) -> None:
        """Draw a matplotlib object on the page or in one of its windows, in units of that page or window."""
        axes.add_artist(artist)

    def fill(
        self, axes: Axes, outline: Outline, z: float, look: dict[str, Any], gid: str | None = None
    ) -> None:
        """Fill an outline; ``look`` contains attributes of a matplotlib patch."""
        patch = PathPatch(outline, zorder=z, **look)
        patch.set_gid(gid)
        self.add(axes, patch)

    def fill_all(
        self, axes: Axes, outlines: Sequence[Outline], z: float, look: dict[str, Any]
    ) -> None:
        """Fill several outlines in the same style; ``look`` contains attributes of a matplotlib patch."""
        each = {f"{name}s": [look[name]] for name in ("facecolor", "edgecolor", "linewidth")}
        rest = {name: value for name, value in look.items() if f"{name}s" not in each}
        self.add(axes, PathCollection(outlines, zorder=z, **each, **rest))

    def once(self, key: Hashable, box: Rect, paint: Callable[[], None]) -> None:
        """Draw content in a rectangle of the page. The same ``key`` means the same content in each picture.

        A reusable page paints it only once.
        """
        del key, box
        paint()

    def text(self, x: float, y: float, text: str, **look: Any) -> None:
        """Write a text on the page, at a point in points (1/72 inch).

        Markup in the text is not interpreted.
        """
        self.write(self.sheet, x, y, text, **look)

    def write(self, axes: Axes, x: float, y: float, text: str, **look: Any) -> None:
        """Write a text on the page or in one of its windows, in units of that page or window."""
        gid = look.pop("gid", None)
        axes.text(x, y, printable(text), parse_math=False, **(TEXT | look)).set_gid(gid)

    def text_size(self, text: str, size: float, weight: str = "normal") -> tuple[float, float]:
        """Return the width and height of a text on the page, in points (1/72 inch)."""
        width, height = _text_size(printable(text), size, weight, self._dpi)
        return width * 72 / self._dpi, height * 72 / self._dpi

    def plot(self, left: float, bottom: float, right: float, top: float) -> Axes:
        """Add the axes of a chart to the page. The rectangle, in points, does not include axis labels."""
        box = (left, bottom, right - left, top - bottom)
        axes = self._figure.add_axes(self._share(*box))
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set(color=INK, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.grid(color=RULE, linewidth=0.6)
        axes.tick_params(length=0, pad=4, labelsize=7, labelcolor=FAINT_INK)
        return axes

    def legend(self, handles: list[Any], at: tuple[float, float], loc: str, **look: Any) -> None:
        """Draw a legend for matplotlib objects; its corner ``loc`` is at the point ``at`` of the page."""
        style: dict[str, Any] = {
            "ncols": 3,
            "labelcolor": INK,
            "frameon": False,
            "loc": loc,
            **look,
        }
        place = {"bbox_to_anchor": at, "bbox_transform": self.sheet.transData}
        self.sheet.legend(handles=handles, **place, **style)

    def picture(
        self, picture: bytes, left: float, top: float, width: float, height: float
    ) -> float:
        """Draw a camera picture on the page, within a width and height; return the used height in points.

        Raises
        ------
        ExportError
            The picture is neither JPEG nor PNG, is damaged, or has too many pixels.
        """
        pixels = _decoded(picture)
        scale = min(width / pixels.shape[1], height / pixels.shape[0])
        width, height = scale * pixels.shape[1], scale * pixels.shape[0]
        axes = self._axes(left, top - height, width, height)
        axes.imshow(pixels, extent=(0, 1, 0, 1), aspect="auto", interpolation="antialiased")
        axes.set_axis_off()
        return height

    def save(self, to: str | Path) -> None:
        """Write the page to a PNG or SVG file, by the file ending. An existing file is replaced.

        Raises
        ------
        ExportError
            The ending is unknown, or the file cannot be written.
        """
        drawn = self._svg() if check_format(to) == "svg" else self._png()
        write_bytes(to, drawn)

    def _svg(self) -> bytes:
        written = io.BytesIO()
        self._figure.savefig(written, format="svg", metadata={"Creator": "sgstore", "Date": None})
        return written.getvalue()

    def pixels(self) -> NDArray[np.uint8]:
        """Return the page as an array of pixels, (height, width, 3) uint8."""
        self._canvas.draw()
        return np.ascontiguousarray(np.asarray(self._canvas.buffer_rgba())[..., :3])

    def _png(self) -> bytes:
        written = io.BytesIO()
        picture = Image.fromarray(self.pixels())
        made = quantized(picture)
        (made if greatest_change(made, picture) <= MOST_CHANGE else picture).save(written, "PNG")
        return written.getvalue()

    def _axes(self, left: float, bottom: float, width: float, height: float) -> Axes:
        axes = self._figure.add_axes(self._share(left, bottom, width, height))
        axes.set_axis_off()
        axes.set_autoscale_on(False)
        # Each clipped artist would make its own transform; this one follows the axes.
        transform = axes.patch.get_transform()
        axes.patch.get_transform = lambda: transform
        return axes

    def _share(self, left: float, bottom: float, width: float, height: float) -> Rect:
        return left / self.width, bottom / self.height, width / self.width, height / self.height


@cache
def _ruler(dpi: float) -> RendererAgg:
    """Return a matplotlib renderer that is used only to measure texts."""
    return RendererAgg(1, 1, dpi)


@lru_cache(maxsize=4096)
def _text_size(text: str, size: float, weight: str, dpi: float) -> tuple[float, float]:
    font = FontProperties(size=size, weight=weight)
    ismath = False
    width, height, _ = _ruler(dpi).get_text_width_height_descent(text, font, ismath)
    return width, height


def check_format(to: str | Path) -> str:
    """Return the picture format ``png`` or ``svg`` for a file name, or raise an error."""
    to = Path(to)
    if to.suffix.lower() not in FORMATS:
        raise ExportError(
            f"cannot draw {to.name!r}: a picture is {' or '.join(FORMATS)}, so end the name in one of these"
        )
    return to.suffix.lower()[1:]


def printable(text: str) -> str:
    """Return a text with ``□`` in place of characters that the font lacks."""
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
    # Decoders of untrusted bytes fail in many ways: each error means an unusable picture.
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ExportError(f"the camera picture is not a readable JPEG or PNG: {error}") from error
