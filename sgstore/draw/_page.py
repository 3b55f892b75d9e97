"""The page: drawing primitives, drawing order, and PNG, SVG and GIF output."""

from __future__ import annotations

import gc
import io
import math
import threading
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.text import Text
from matplotlib.transforms import Bbox, IdentityTransform
from PIL import Image
from PIL.GifImagePlugin import getdata, getheader

from sgstore.draw._palette import FAINT_INK, GROUND, INK, PAPER, RULE
from sgstore.draw._view import clean
from sgstore.errors import ExportError
from sgstore.files import OutputFile, write_bytes

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from sgstore.draw._view import MapWindow
    from sgstore.world import Floats

    Pixels = NDArray[np.uint8]


Rect = tuple[float, float, float, float]
"""Left, bottom, right, top."""

WINDOW: Final = 0.0
LANES: Final = 1.0
STOREY: Final = 0.03
"""Between one storey of roads and the next; the highest is below the tints."""
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


# Pictures with 256 colours where that is enough: a third of the bytes, and the eye sees no difference ----
# A drawing has few colours on its areas and thousands of mixtures along its edges. The commonest keep their
# own place in the palette, so that areas stay exactly as they were drawn; the other places go to those colours
# that are furthest from all chosen so far, so that no mixture is moved far. Photographs stay as they are.
# No quantiser of Pillow does both: each of them changes the colours of areas (10 to 60 of the 64 commonest).

PLACES: Final = 256
COMMONEST: Final = 64
"""Places of the palette that go to the commonest colours."""
MOST_COLOURS: Final = 50_000
"""A picture with more colours than this is a photograph."""
FURTHEST: Final = 24.0
"""Greatest distance in RGB, of 0 … 255 each, that a mixture may be moved."""
_AREA: Final = 30
"""Pixels of one colour that are an area."""


def indexed(picture: Image.Image) -> Image.Image:
    """An RGB picture with a palette, or the picture itself where 256 colours are not enough."""
    counted = picture.getcolors(MOST_COLOURS)
    if counted is None:
        return picture
    counted.sort(reverse=True)
    colours = np.array([colour for _, colour in counted], dtype=np.float32)
    chosen, nearest, furthest = _palette(colours)
    if furthest > FURTHEST:
        return picture
    places = np.zeros(1 << 24, np.uint8)
    places[_packed(colours)] = nearest
    return _with_palette(places[_packed(np.asarray(picture))], colours[chosen])


def _with_palette(places: Pixels, colours: NDArray[np.float32]) -> Image.Image:
    made = Image.fromarray(places)
    made.putpalette(colours.astype(np.uint8).tobytes())
    return made


class LastingPalette:
    """The palette of one picture for those that follow, as long as it does them justice.

    It does if no mixture of colours is moved further than in :func:`indexed`, and no area at all.
    """

    def __init__(self) -> None:
        self._colours = np.zeros((0, 3), np.float32)
        self._places = np.full(1 << 24, -1, np.int16)  # of all colours that have been met

    def indexed(self, picture: Image.Image) -> Image.Image:
        """An RGB picture with a palette of at most 256 colours."""
        packed = _packed(np.asarray(picture))
        if not self._takes(packed[self._places[packed] < 0]):
            made = indexed(picture)
            if made.mode != "P":
                return picture.quantize(PLACES, dither=Image.Dither.NONE)
            palette = np.array(made.getpalette(), np.float32).reshape(-1, 3)
            self._colours = palette[: 1 + int(np.asarray(made).max())]
            self._places.fill(-1)
            self._places[packed] = np.asarray(made)
            return made
        return _with_palette(self._places[packed].astype(np.uint8), self._colours)

    def _takes(self, unknown: NDArray[np.int32]) -> bool:
        """Give places to pixels of colours that are new, if there are such places."""
        if not len(self._colours):
            return False
        found, many = np.unique(unknown, return_counts=True)
        if len(found) > PLACES * 16 or (many > _AREA).any():
            return False
        colours = np.stack([found >> 16, found >> 8 & 255, found & 255], axis=1).astype(np.float32)
        away = np.square(colours[:, None] - self._colours).sum(axis=2)
        near = away.argmin(axis=1) if len(found) else np.zeros(0, np.intp)
        if (away[np.arange(len(found)), near] > FURTHEST**2).any():
            return False
        self._places[found] = near
        return True


def _palette(colours: NDArray[np.float32]) -> tuple[list[int], NDArray[np.intp], float]:
    """Rows of the chosen colours, the place of each colour's nearest one, and how far the furthest is from it.

    Squares of distances of whole numbers up to 255 are exact in float32.
    """
    squares = (colours * colours).sum(axis=1)
    chosen = list(range(min(COMMONEST, len(colours))))
    away = squares[:, None] - 2 * (colours @ colours[chosen].T) + squares[chosen]
    nearest = away.argmin(axis=1)
    least = away[np.arange(len(colours)), nearest]
    while len(chosen) < min(PLACES, len(colours)):
        row = int(least.argmax())
        away = squares - 2 * (colours @ colours[row]) + squares[row]
        nearest[away < least] = len(chosen)
        least = np.minimum(least, away)
        chosen.append(row)
    return chosen, nearest, float(np.sqrt(least.max()))


def _packed(colours: NDArray[np.generic]) -> NDArray[np.int32]:
    red, green, blue = (colours[..., axis].astype(np.int32) for axis in range(3))
    return 65536 * red + 256 * green + blue


# Animations, written frame by frame: memory does not grow with their length ---------------------
# Pillow writes the pieces of the file; saving with ``append_images`` would first gather all frames. Each frame
# is the rectangle in which it differs from the one before, with a palette of its own.

LEAST_DELAY: Final = 2
"""Hundredths of a second that a frame is shown at least: players take less for a tenth of a second."""
MOST_DELAY: Final = 65535


class Gif:
    """Writes an animation that repeats for ever; to be used in a ``with``.

    Parameters
    ----------
    to : Path
        Gets its name when all is written; a file that is there is replaced.
    """

    def __init__(self, to: Path) -> None:
        self._output = OutputFile(to)
        self._stream = self._output.stream()
        self._waiting: tuple[Pixels, int] | None = None
        self._last: Pixels | None = None
        self._palette = LastingPalette()
        self._shown = 100  # the last frame is shown as long as the one before
        self.frames = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_exception: object) -> None:
        try:
            if kind is None and self._waiting is not None:
                pixels, _ = self._waiting
                self._write(pixels, self._shown)
                self._stream.write(b";")  # the trailer of a GIF
                self._output.keep()
        finally:
            self._output.discard()

    def add(self, pixels: Pixels, time_s: float) -> None:
        """Show a picture, (height, width, 3), from a time on; s. All are of one size, and times ascend."""
        start = round(time_s * 100)
        if self._waiting is not None:
            before, since = self._waiting
            self._shown = max(start - since, LEAST_DELAY)
            self._write(before, self._shown)
        self._waiting = (pixels, start)

    def _write(self, pixels: Pixels, delay: int) -> None:
        """Write a frame that is shown for so many hundredths of a second."""
        if self._last is None:
            height, width, _ = pixels.shape
            # The frames bring their palettes: the file's own one has no colour of use.
            head, _ = getheader(Image.new("P", (width, height)), info={"loop": 0})
            self._stream.write(b"".join(head))
        left, top, right, bottom = changed(self._last, pixels)
        part = Image.fromarray(np.ascontiguousarray(pixels[top:bottom, left:right]))
        pieces = getdata(
            self._palette.indexed(part),
            (left, top),
            duration=min(delay, MOST_DELAY) * 10,
            disposal=1,
            include_color_table=True,
        )
        self._stream.write(b"".join(pieces))
        pieces.clear()  # they hang in a cycle of Pillow's
        gc.collect(0)
        self._last = pixels
        self.frames += 1


def changed(before: Pixels | None, now: Pixels) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the part of a picture that is other than before; a pixel at least."""
    height, width, _ = now.shape
    if before is None:
        return 0, 0, width, height
    other = (before != now).any(axis=2)
    lines, columns = np.flatnonzero(other.any(axis=1)), np.flatnonzero(other.any(axis=0))
    if not len(lines):
        return 0, 0, 1, 1
    return int(columns[0]), int(lines[0]), int(columns[-1]) + 1, int(lines[-1]) + 1


# The sheet of paper: the only room that knows how pictures are written --------------------------
# A page is measured in points (1/72 inch) from its lower left corner; a stage is a window on the map
# upon it, measured in metres. Drawing goes through figures of their own, never through global state;
# what a user's configuration of the drawing package says does not reach the picture, so that the same
# frame gives the same bytes.

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
    "xtick.",
    "ytick.",
    "legend.",
    "grid.",
    "scatter.",
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
    view : MapWindow
    half : (float, float)
        Half its width and height; m.
    points : float
        Points of the page in a metre.
    page : Page
    """

    axes: Axes
    view: MapWindow
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
        """Return True for a point in the window."""
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


Sprite = tuple["Pixels", int, int]
"""A text as drawn, (height, width, 4) from below, and how far its corner lies from its place; pixels."""


class DrawnText(Artist):
    """A text that has been drawn before: a sprite at a place of some axes."""

    def __init__(self, sprite: Sprite, axes: Axes, x: float, y: float, z: float) -> None:
        super().__init__()
        self.zorder = z
        self._sprite, self._within, self._at = sprite, axes, (x, y)

    def draw(self, renderer: Any) -> None:
        """Lay the sprite on the page, as far as it lies in the axes."""
        pixels, left, below = self._sprite
        x, y = self._within.transData.transform(self._at)
        gc = renderer.new_gc()
        gc.set_clip_rectangle(self._within.bbox)
        renderer.draw_image(gc, round(x) + left, round(y) + below, pixels)
        gc.restore()


class Page:
    """A sheet of paper.

    Parameters
    ----------
    width, height : float
        In points.
    dpi : float
        Pixels of an inch, where it is drawn in pixels.
    sprites : dict, optional
        Texts that were drawn already, for pages that are drawn in pixels one after another: a text is set on
        whole pixels then.
    """

    def __init__(
        self,
        width: float,
        height: float,
        dpi: float = DPI,
        sprites: dict[object, Sprite] | None = None,
    ) -> None:
        self.width = width
        self.height = height
        self._dpi = dpi
        self._sprites = sprites
        self._windows: dict[Rect, Axes] = {}
        self._free: dict[Rect, Axes] = {}
        self._figure = Figure(figsize=(width / 72, height / 72), dpi=dpi, facecolor=PAPER)
        self._canvas = FigureCanvasAgg(self._figure)
        self.sheet = self._axes(0, 0, width, height)
        self._windows = {}
        self.sheet.set_xlim(0, width)
        self.sheet.set_ylim(0, height)

    def stage(self, box: Rect, view: MapWindow) -> Stage:
        """A window upon the page; ``view.radius`` is half its shorter side.

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

    def text(self, x: float, y: float, text: str, **look: Any) -> None:
        """Write on the sheet.

        The text is taken as it stands: no markup is interpreted, whatever it holds.
        """
        self.write(self.sheet, x, y, text, **look)

    def write(self, axes: Axes, x: float, y: float, text: str, **look: Any) -> None:
        """Write on a sheet or in a window, in its own measure."""
        gid = look.pop("gid", None)
        style: dict[str, Any] = {"fontsize": 7.0, "color": INK, "va": "baseline", **look}
        text = printable(text)
        if self._sprites is None:
            axes.text(x, y, text, parse_math=False, **style).set_gid(gid)
        elif text:
            z = style.pop("zorder", Text.zorder)
            key = text, repr(style)
            if key not in self._sprites:
                self._sprites[key] = drawn_text(text, self._dpi, style)
            axes.add_artist(DrawnText(self._sprites[key], axes, x, y, z))

    def text_size(self, text: str, size: float, weight: str = "normal") -> tuple[float, float]:
        """Width and height of a text; points."""
        width, height = _text_size(printable(text), size, weight, self._dpi)
        return width * 72 / self._dpi, height * 72 / self._dpi

    def plot(self, left: float, bottom: float, right: float, top: float) -> Axes:
        """Axes of a chart upon the page; its sides in points of the page, without numbers and names."""
        box = (left, bottom, right - left, top - bottom)
        axes = self._figure.add_axes(self._share(*box))
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set(color=INK, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.grid(color=RULE, linewidth=0.6)
        axes.tick_params(length=0, pad=4, labelsize=7, labelcolor=FAINT_INK)
        return axes

    def legend(self, handles: list[Any], at: tuple[float, float], loc: str, **look: Any) -> None:
        """Explain some artists on the sheet; ``at`` is where the corner ``loc`` of the legend lies."""
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

    def save(self, to: str | Path) -> None:
        """Write the page as PNG or SVG, as the ending says; a picture that is there is replaced.

        Raises
        ------
        ExportError
            If the ending is another, or the file cannot be written.
        """
        drawn = self._svg() if check_format(to) == "svg" else self._png()
        write_bytes(to, drawn)

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

    def clear(self) -> None:
        """Take all from the page that was drawn; windows of the same places are used again."""
        for axes in self._figure.axes:
            drawn = (*axes.artists, *axes.patches, *axes.collections, *axes.lines, *axes.images)
            for artist in drawn:
                artist.remove()
        for share, axes in self._windows.items():
            if axes in self._figure.axes:
                self._figure.delaxes(axes)
                self._free[share] = axes
        self._windows = {}

    def _axes(self, left: float, bottom: float, width: float, height: float) -> Axes:
        share = self._share(left, bottom, width, height)
        axes = self._windows[share] = self._figure.add_axes(self._free.pop(share, share))
        axes.set_axis_off()
        axes.set_autoscale_on(False)
        # Each artist that is clipped asks for it, and would have it made anew; it follows the axes by itself.
        transform = axes.patch.get_transform()
        axes.patch.get_transform = lambda: transform
        return axes

    def _share(self, left: float, bottom: float, width: float, height: float) -> Rect:
        return left / self.width, bottom / self.height, width / self.width, height / self.height


@lru_cache(maxsize=4096)
def _text_size(text: str, size: float, weight: str, dpi: float) -> tuple[float, float]:
    """Width and height; pixels."""
    font = FontProperties(size=size, weight=weight)
    ismath = False
    width, height, _ = RendererAgg(1, 1, dpi).get_text_width_height_descent(text, font, ismath)
    return width, height


@cache
def _nowhere(dpi: float) -> Figure:
    """A figure for what is measured and drawn outside of all pages."""
    return Figure(dpi=dpi)


def drawn_text(text: str, dpi: float, style: dict[str, Any]) -> Sprite:
    """A text, and what is under it, drawn alone; ``style`` as of a text of the drawing package."""
    written = Text(0, 0, text, parse_math=False, **style)
    written.set_figure(_nowhere(dpi))
    written.set_transform(IdentityTransform())
    renderer = RendererAgg(1, 1, dpi)
    slip = written.get_bbox_patch()
    written.update_bbox_position_size(renderer)
    boxes = [written.get_window_extent(renderer)]
    boxes += [slip.get_window_extent(renderer)] if slip is not None else []
    left, below, right, above = map(round, Bbox.union(boxes).padded(3).extents)
    renderer = RendererAgg(right - left, above - below, dpi)
    written.set_position((-left, -below))
    written.draw(renderer)
    return np.array(renderer.buffer_rgba())[::-1], left, below  # as images are drawn, from below


def check_format(to: str | Path) -> str:
    """``png`` or ``svg``, by the ending of a file's name."""
    to = Path(to)
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


# Placement of texts: beside what they name, on top of nothing that matters ----------------------
# Greedy: texts come in the order of their weight, each takes the first free place around its anchor,
# and one that finds none is left out. All measures are points of the page.

_ROUND: Final = tuple(
    math.radians(a) for a in (0, 180, 30, -30, 150, -150, 90, -90, 60, 120, -60, -120)
)
_STEPS: Final = (2.0, 8.0, 16.0, 26.0)
_CLEAR: Final = 4.0
"""By how much a name is nearer to its own thing than to any other, where there is room; points."""


class Placer:
    """Free and taken room in a window.

    Parameters
    ----------
    bounds : Rect
        The window; no text leaves it.
    """

    def __init__(self, bounds: Rect) -> None:
        self._bounds = bounds
        self._taken: list[Rect] = []
        self._things: list[Rect] = []

    def stand(self, x: float, y: float, reach: tuple[float, float]) -> None:
        """Take note of a thing that has a name, or could: names of others are not put nearer to it."""
        self._things.append(_around(x, y, reach))

    def block(self, rect: Rect) -> None:
        """Keep a rectangle free of texts."""
        self._taken.append(rect)

    def beside(
        self, x: float, y: float, reach: tuple[float, float], size: tuple[float, float]
    ) -> tuple[float, float] | None:
        """The middle of a free place for a text beside a thing, near first; taken at once.

        Parameters
        ----------
        x, y : float
            Middle of the thing.
        reach : (float, float)
            How far the thing extends from there, to its sides and up and down.
        size : (float, float)
            Width and height of the text.

        Returns
        -------
        (float, float) or None
            ``None`` if there is no room.
        """
        return self.first_free(_spots(x, y, reach, size), size)

    def named(
        self, x: float, y: float, reach: tuple[float, float], size: tuple[float, float]
    ) -> tuple[tuple[float, float], bool] | None:
        """The same for the name of a thing, and whether the name is clearly its own.

        It is if nothing else is about as near to it; such a place comes before all others.
        """
        spots = _spots(x, y, reach, size)
        own = _around(x, y, reach)
        others = np.array([thing for thing in self._things if thing != own]).reshape(-1, 4)
        texts = np.array([_around(*spot, (size[0] / 2, size[1] / 2)) for spot in spots])
        rival = _gaps(texts, others).min(axis=1, initial=np.inf)
        clear = _gaps(texts, np.array([own]))[:, 0] + _CLEAR <= rival
        for wanted in (clear, ~clear):
            chosen = [spot for spot, is_wanted in zip(spots, wanted, strict=True) if is_wanted]
            spot = self.first_free(chosen, size) if chosen else None
            if spot is not None:
                return spot, wanted is clear
        return None

    def along(
        self, a: tuple[float, float], b: tuple[float, float], size: tuple[float, float]
    ) -> tuple[float, float] | None:
        """The middle of a free place for a text on the line from ``a`` to ``b``; taken at once."""
        spots = [
            (a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]))
            for t in (0.55, 0.65, 0.45, 0.75, 0.35)
        ]
        return self.first_free(spots, size)

    def first_free(
        self, spots: list[tuple[float, float]], size: tuple[float, float]
    ) -> tuple[float, float] | None:
        """The first of some spots that is free for a text of a size; taken at once."""
        middles = np.array(spots)
        half = np.array(size) / 2
        low, high = middles - half, middles + half
        left, bottom, right, top = self._bounds
        free = (low >= (left, bottom)).all(axis=1) & (high <= (right, top)).all(axis=1)
        if self._taken:
            taken = np.array(self._taken)
            meets = (low[:, None] < taken[:, 2:]) & (high[:, None] > taken[:, :2])
            free &= ~(meets[:, :, 0] & meets[:, :, 1]).any(axis=1)
        if not free.any():
            return None
        chosen = int(free.argmax())
        self._taken.append((*low[chosen].tolist(), *high[chosen].tolist()))
        return spots[chosen]


def _spots(
    x: float, y: float, reach: tuple[float, float], size: tuple[float, float]
) -> list[tuple[float, float]]:
    """Middles of texts around a thing, near first."""
    half_w, half_h = size[0] / 2, size[1] / 2
    return [
        (
            x + (reach[0] + step) * math.cos(a) + half_w * _sign(math.cos(a)),
            y + (reach[1] + step) * math.sin(a) + half_h * _sign(math.sin(a)),
        )
        for step in _STEPS
        for a in _ROUND
    ]


def _around(x: float, y: float, reach: tuple[float, float]) -> Rect:
    return (x - reach[0], y - reach[1], x + reach[0], y + reach[1])


def _gaps(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (n, m) of rectangles (n, 4) and (m, 4); 0 where they meet."""
    apart = np.maximum(one[:, None, :2] - other[:, 2:], other[:, :2] - one[:, None, 2:])
    return np.hypot(*np.moveaxis(np.maximum(apart, 0.0), -1, 0))


def _sign(value: float) -> float:
    return 0.0 if abs(value) < 1e-9 else math.copysign(1.0, value)
