"""Pictures with 256 colours where that is enough: a third of the bytes, and the eye sees no difference.

A drawing has few colours on its areas and thousands of mixtures along its edges. The commonest keep their
own place in the palette, so that areas stay exactly as they were drawn; the other places go to those colours
that are furthest from all chosen so far, so that no mixture is moved far. Photographs stay as they are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
    chosen, nearest, furthest = _palette(colours)
    if furthest > FURTHEST:
        return picture
    places = np.zeros(1 << 24, np.uint8)
    places[_packed(colours)] = nearest
    made = Image.fromarray(places[_packed(np.asarray(picture))])
    made.putpalette(colours[chosen].astype(np.uint8).tobytes())
    return made


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
