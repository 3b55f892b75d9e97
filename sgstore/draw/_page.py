"""The page: drawing primitives, drawing order, and PNG and SVG output."""

from __future__ import annotations

import io
import math
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
from PIL import Image

from sgstore.draw._palette import FAINT_INK, GROUND, INK, PAPER, RULE
from sgstore.draw._view import clean
from sgstore.errors import ExportError
from sgstore.files import write_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Hashable, Sequence

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from sgstore.draw._view import MapWindow
    from sgstore.world import Floats

    Pixels = NDArray[np.uint8]
    Colours = NDArray[np.float32]


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


def indexed(picture: Image.Image) -> Image.Image:
    """An RGB picture with a palette, or the picture itself where 256 colours are not enough."""
    counted = picture.getcolors(MOST_COLOURS)
    if counted is None:
        return picture
    counted.sort(reverse=True)
    colours = np.array([colour for _, colour in counted], dtype=np.float32)
    palette, nearest, furthest = grown(colours[:COMMONEST], colours)
    if furthest > FURTHEST:
        return picture
    places = np.zeros(1 << 24, np.uint8)
    places[packed(colours)] = nearest
    return with_palette(places[packed(np.asarray(picture))], palette)


def with_palette(places: Pixels, colours: Colours) -> Image.Image:
    """A picture of places in a palette."""
    made = Image.fromarray(places)
    made.putpalette(colours.astype(np.uint8).tobytes())
    return made


def grown(
    palette: Colours, colours: Colours, most: int = PLACES, enough: float = 0.0
) -> tuple[Colours, NDArray[np.intp], float]:
    """A palette with more of some colours, each time the one that is furthest from all that are in it.

    Parameters
    ----------
    palette, colours : (N, 3) float32
        Whole numbers up to 255: squares of their distances are exact.
    most : int
        Places of the palette.
    enough : float
        Distance from which on a colour needs no place of its own.

    Returns
    -------
    palette : (N, 3) float32
    nearest : (N,) intp
        Place of each colour's nearest one.
    furthest : float
        Greatest distance of a colour from its nearest one.
    """
    squares = (colours * colours).sum(axis=1)
    # Of each colour's distances what is the same for all of them is added to the least one alone.
    away = colours @ (-2 * palette.T)
    away += (palette * palette).sum(axis=1)
    nearest = away.argmin(axis=1)
    least = squares + away[np.arange(len(colours)), nearest]
    more: list[int] = []
    while len(palette) + len(more) < most and least.max() > enough**2:
        row = int(least.argmax())
        away = squares - 2 * (colours @ colours[row]) + squares[row]
        nearest[away < least] = len(palette) + len(more)
        least = np.minimum(least, away)
        more.append(row)
    return np.concatenate((palette, colours[more])), nearest, float(np.sqrt(least.max()))


def packed(colours: NDArray[np.generic]) -> NDArray[np.int32]:
    """Each colour, red, green and blue, as one number."""
    red, green, blue = (colours[..., axis].astype(np.int32) for axis in range(3))
    return 65536 * red + 256 * green + blue


# The sheet of paper: the only room that knows how pictures are written --------------------------
# A page is measured in points (1/72 inch) from its lower left corner; a stage is a window on the map
# upon it, measured in metres. Drawing goes through figures of their own, never through global state;
# what a user's configuration of the drawing package says does not reach the picture, so that the same
# frame gives the same bytes.

DPI: Final = 130
FORMATS: Final = (".png", ".svg")
TEXT: Final[dict[str, Any]] = {"fontsize": 7.0, "color": INK, "va": "baseline"}
"""How texts look if nothing else is said."""
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
    # The package keeps its settings for the whole process: two pictures at once would mix them.
    with _ONE_AT_A_TIME, mpl.rc_context():
        dict.update(mpl.rcParams, _style())  # they were looked at before
        yield


@cache
def _style() -> dict[Any, Any]:
    """The settings of the drawing package for pictures of this house, as it keeps them."""
    style: dict[Any, Any] = {k: v for k, v in mpl.rcParamsDefault.items() if k.startswith(_STYLE)}
    # At this size letters look better unhinted, and are faster.
    style |= {"svg.fonttype": "none", "svg.hashsalt": "sgstore", "text.hinting": "none"}
    with mpl.rc_context(style):
        return {name: mpl.rcParams[name] for name in style}


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
        """Fill many outlines with one colour, with a hairline of the same that closes the seams."""
        if outlines:
            look = {"facecolor": colour, "edgecolor": colour, "linewidth": edge, "alpha": alpha}
            self.page.fill_all(self.axes, list(outlines), z, look)

    def lines(
        self, lines: Sequence[Floats], colour: str, *, z: float, width: float, **look: Any
    ) -> None:
        """Draw many lines of (N, 2) picture coordinates in one look."""
        if lines:
            look |= {"facecolor": "none", "edgecolor": colour, "linewidth": width}
            self.page.fill_all(self.axes, [Outline(line) for line in lines], z, look)

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

    def add(self, axes: Axes, artist: Artist) -> None:
        """Draw an artist of the drawing package on the sheet or in a window, in its own measure."""
        axes.add_artist(artist)

    def fill(
        self, axes: Axes, outline: Outline, z: float, look: dict[str, Any], gid: str | None = None
    ) -> None:
        """Fill an outline; ``look`` as of a patch of the drawing package."""
        patch = PathPatch(outline, zorder=z, **look)
        patch.set_gid(gid)
        self.add(axes, patch)

    def fill_all(
        self, axes: Axes, outlines: Sequence[Outline], z: float, look: dict[str, Any]
    ) -> None:
        """Draw outlines in one look, as of a patch of the drawing package."""
        each = {f"{name}s": [look[name]] for name in ("facecolor", "edgecolor", "linewidth")}
        rest = {name: value for name, value in look.items() if f"{name}s" not in each}
        self.add(axes, PathCollection(outlines, zorder=z, **each, **rest))

    def once(self, key: Hashable, box: Rect, paint: Callable[[], None]) -> None:
        """Paint in a box of the sheet where nothing else is; what has a key is always the same.

        A page that is drawn again and again paints it only once.
        """
        del key, box
        paint()

    def text(self, x: float, y: float, text: str, **look: Any) -> None:
        """Write on the sheet.

        The text is taken as it stands: no markup is interpreted, whatever it holds.
        """
        self.write(self.sheet, x, y, text, **look)

    def write(self, axes: Axes, x: float, y: float, text: str, **look: Any) -> None:
        """Write on a sheet or in a window, in its own measure."""
        gid = look.pop("gid", None)
        axes.text(x, y, printable(text), parse_math=False, **(TEXT | look)).set_gid(gid)

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

    def _axes(self, left: float, bottom: float, width: float, height: float) -> Axes:
        axes = self._figure.add_axes(self._share(left, bottom, width, height))
        axes.set_axis_off()
        axes.set_autoscale_on(False)
        # Each artist that is clipped asks for it, and would have it made anew; it follows the axes by itself.
        transform = axes.patch.get_transform()
        axes.patch.get_transform = lambda: transform
        return axes

    def _share(self, left: float, bottom: float, width: float, height: float) -> Rect:
        return left / self.width, bottom / self.height, width / self.width, height / self.height


@cache
def _ruler(dpi: float) -> RendererAgg:
    """A renderer that measures texts and draws nothing."""
    return RendererAgg(1, 1, dpi)


@lru_cache(maxsize=4096)
def _text_size(text: str, size: float, weight: str, dpi: float) -> tuple[float, float]:
    """Width and height; pixels."""
    font = FontProperties(size=size, weight=weight)
    ismath = False
    width, height, _ = _ruler(dpi).get_text_width_height_descent(text, font, ismath)
    return width, height


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
