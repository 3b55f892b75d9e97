"""Page for animations. It is drawn again for each picture, as pixels.

matplotlib makes an object for everything that is drawn; these objects take most of the time. This
page sends shapes and texts directly to the renderer. The legend is drawn once, and drawn texts are
cached. The pixels equal those of :class:`sgstore.draw._page.Page`, except that texts are placed on
whole pixels.
"""

from __future__ import annotations

import math
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.path import Path as Outline
from matplotlib.text import Text
from matplotlib.transforms import Affine2D, IdentityTransform

from sgstore.draw._page import TEXT, Page, printable

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Sequence

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from sgstore.draw._page import Pixels, Rect

    Draw = Callable[[], None]


Sprite = tuple["Pixels", int, int]
"""Text as pixels, (height, width, 4) from the bottom up, and the offset of its corner; pixels."""

_NOWHERE = IdentityTransform()
_AT_ONE_PLACE = np.zeros((1, 2))
_AS_THEY_ARE = np.empty((0, 3, 3))


class FilmPage(Page):
    """Page for the pictures of an animation. The caller clears the page before each picture."""

    def __init__(self, width: float, height: float, dpi: float) -> None:
        self._windows: dict[Rect, Axes] = {}
        self._shown: dict[Axes, list[tuple[float, Draw]]] = {}
        self._scales: dict[Axes, Affine2D] = {}
        self._pens: dict[Hashable, Any] = {}
        self._sprites: dict[Hashable, Sprite] = {}
        self._blocks: dict[Hashable, Sprite] = {}
        self._new_blocks: dict[Hashable, tuple[int, int, int, int]] = {}
        super().__init__(width, height, dpi)
        self._renderer: Any = self._canvas.get_renderer()
        self._texts = TextSprites(dpi)

    def clear(self) -> None:
        """Remove all content of the page before the next picture."""
        for axes in self._shown:
            for image in (*axes.images,):
                image.remove()
        self._shown = {self.sheet: []}
        self._scales = {}

    def pixels(self) -> Pixels:
        """Return the page as an array of pixels, (height, width, 3) uint8."""
        self._renderer.clear()
        self._figure.patch.draw(self._renderer)
        for axes, drawn in self._shown.items():
            for _, draw in sorted(drawn, key=itemgetter(0)):
                draw()
            for image in axes.images:
                image.draw(self._renderer)
        seen = np.asarray(self._renderer.buffer_rgba())
        for key, (left, below, right, above) in self._new_blocks.items():
            height = len(seen)
            part = seen[height - above : height - below, left:right]
            self._blocks[key] = np.array(part[::-1]), left, below
        self._new_blocks = {}
        pixels = np.empty((*seen.shape[:2], 3), np.uint8)
        for colour in range(3):  # one plane at a time: five times as fast as all three at once
            pixels[..., colour] = seen[..., colour]
        return pixels

    def add(self, axes: Axes, artist: Artist) -> None:
        """Draw a matplotlib object on the page or in one of its windows, in units of that page or window."""
        artist.set_figure(self._figure)
        artist.axes = axes
        if not artist.is_transform_set():
            artist.set_transform(axes.transData)
        artist.set_clip_box(axes.bbox)
        self._draw(axes, artist.zorder, partial(artist.draw, self._renderer))

    def once(self, key: Hashable, box: Rect, paint: Callable[[], None]) -> None:
        """Draw content that is equal in all pictures. After the first time, its pixels come from a cache."""
        if key in self._blocks:
            pixels, left, below = self._blocks[key]
            pen = self._renderer.new_gc()
            self._draw(
                self.sheet, 0.0, partial(self._renderer.draw_image, pen, left, below, pixels)
            )
            return
        paint()
        left, bottom, right, top = (side * self._dpi / 72 for side in box)
        width, height = (int(side) for side in self._renderer.get_canvas_width_height())
        self._new_blocks[key] = (
            max(int(left), 0),
            max(int(bottom), 0),
            min(int(right) + 1, width),
            min(int(top) + 1, height),
        )

    def write(self, axes: Axes, x: float, y: float, text: str, **look: Any) -> None:
        """Write a text on the page or in one of its windows, in units of that page or window."""
        style = TEXT | look
        style.pop("gid", None)
        text = printable(text)
        if not text:
            return
        z = style.pop("zorder", Text.zorder)
        key = text, repr(style)
        if key not in self._sprites:
            width, _ = self.text_size(text, style["fontsize"], style.get("weight", "normal"))
            self._sprites[key] = self._texts.drawn(text, width * self._dpi / 72, style)
        pixels, left, below = self._sprites[key]
        x, y = self.scale(axes).transform((x, y))
        pen = self.pen(axes)
        place = round(x) + left, round(y) + below
        self._draw(axes, z, partial(self._renderer.draw_image, pen, *place, pixels))

    def fill(
        self, axes: Axes, outline: Outline, z: float, look: dict[str, Any], gid: str | None = None
    ) -> None:
        """Fill an outline; ``look`` contains attributes of a matplotlib patch."""
        del gid
        alpha = look.get("alpha")
        face = to_rgba(look["facecolor"], alpha)
        edge = to_rgba(look.get("edgecolor", "none"), alpha)
        pen = self.pen(
            axes,
            edge=edge,
            width=look.get("linewidth", 0.0) if edge[3] else 0.0,
            alpha=alpha,
            linestyle=look.get("linestyle"),
            capstyle=look.get("capstyle", "butt"),
            joinstyle=look.get("joinstyle", "miter"),
        )
        shape = (outline, self.scale(axes), face if face[3] else None)
        self._draw(axes, z, partial(self._renderer.draw_path, pen, *shape))

    def fill_all(
        self, axes: Axes, outlines: Sequence[Outline], z: float, look: dict[str, Any]
    ) -> None:
        """Fill several outlines in the same style; ``look`` contains attributes of a matplotlib patch."""
        alpha = look.get("alpha")
        face, edge = to_rgba(look["facecolor"], alpha), to_rgba(look["edgecolor"], alpha)
        width, scale = look["linewidth"], self.scale(axes)
        dashes = _dashes(look.get("linestyle"), width)
        capstyle, joinstyle = look.get("capstyle"), look.get("joinstyle")
        if len(outlines) == 1 and dashes[1] is None and self._has_room(outlines[0], scale):
            pen = self.pen(axes, edge=edge, width=width, capstyle=capstyle, joinstyle=joinstyle)
            one = (outlines[0], scale, Outline(_AT_ONE_PLACE), _NOWHERE, face)
            self._draw(axes, z, partial(self._renderer.draw_markers, pen, *one))
            return
        pen = self.pen(axes, capstyle=capstyle, joinstyle=joinstyle)
        places = (_AS_THEY_ARE, _AT_ONE_PLACE, _NOWHERE)
        colours = (np.array([face]), np.array([edge]), [width], [dashes], [True], [None], "screen")
        shapes = (scale, outlines, *places, *colours)
        self._draw(axes, z, partial(self._renderer.draw_path_collection, pen, *shapes))

    def scale(self, axes: Axes) -> Affine2D:
        """Return the transform from the units of the page, or of a window on it, to pixels."""
        if axes not in self._scales:
            self._scales[axes] = cast("Affine2D", axes.transData.frozen())
        return self._scales[axes]

    def pen(
        self,
        axes: Axes,
        *,
        edge: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0),
        width: float = 1.0,
        alpha: float | None = None,
        linestyle: Any = None,
        capstyle: str | None = None,
        joinstyle: str | None = None,
    ) -> Any:
        """Return the matplotlib graphics context for a line style, clipped to a window of the page."""
        key = (axes, edge, width, alpha, linestyle, capstyle, joinstyle)
        if key not in self._pens:
            made = self._pens[key] = self._renderer.new_gc()
            made.set_clip_rectangle(axes.bbox.frozen())
            made.set_linewidth(width)
            made.set_alpha(alpha)
            made.set_foreground(edge, isRGBA=True)
            made.set_dashes(*_dashes(linestyle, width))
            if capstyle is not None:
                made.set_capstyle(capstyle)
            if joinstyle is not None:
                made.set_joinstyle(joinstyle)
        return self._pens[key]

    def _has_room(self, outline: Outline, scale: Affine2D) -> bool:
        """True if an outline is smaller than the page, so that matplotlib can draw it as a marker."""
        extents, page = outline.get_extents(scale), self._figure.bbox
        return extents.width < page.width and extents.height < page.height

    def _draw(self, axes: Axes, z: float, draw: Draw) -> None:
        self._shown[axes].append((z, draw))

    def _axes(self, left: float, bottom: float, width: float, height: float) -> Axes:
        box = (left, bottom, width, height)
        if box not in self._windows:
            self._windows[box] = super()._axes(*box)
        self._shown[self._windows[box]] = []
        return self._windows[box]


class TextSprites:
    """Cache of texts as pixels, for repeated drawing."""

    def __init__(self, dpi: float) -> None:
        self._dpi = dpi
        self._figure = Figure(dpi=dpi)
        self._renderer: Any = RendererAgg(1, 1, dpi)

    def drawn(self, text: str, width: float, style: dict[str, Any]) -> Sprite:
        """Draw a text with its background, and return it as pixels. ``width`` is its width in pixels."""
        around = 3 * style["fontsize"] * self._dpi / 72
        x, y = math.ceil(width + around), math.ceil(around)
        if 2 * x > self._renderer.width or 2 * y > self._renderer.height:
            self._renderer = RendererAgg(2 * x, 2 * y, self._dpi)
        sheet = self._renderer
        sheet.clear()
        written = Text(x, y, text, parse_math=False, **style)
        written.set_figure(self._figure)
        written.set_transform(IdentityTransform())
        written.draw(sheet)
        pixels = np.asarray(sheet.buffer_rgba())[-2 * y :, : 2 * x]
        pixels = pixels[::-1]  # images are drawn from below
        inked = pixels[..., 3] != 0
        lines, columns = (np.flatnonzero(inked.any(axis=axis)) for axis in (1, 0))
        if not len(lines):
            return pixels[:1, :1].copy(), 0, 0
        top, left = int(lines[0]), int(columns[0])
        part = pixels[top : lines[-1] + 1, left : columns[-1] + 1]
        return part.copy(), left - x, top - y


def _dashes(linestyle: Any, width: float) -> tuple[float, list[float] | None]:
    """Return the offset of a pattern of dashes, and the lengths of the dashes and gaps; pixels.

    ``None`` means a solid line.
    """
    if linestyle is None or isinstance(linestyle, str):
        return 0.0, None
    start, dashes = linestyle
    return start * width, [part * width for part in dashes]
