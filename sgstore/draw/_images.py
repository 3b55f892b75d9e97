"""Pictures as objects of Pillow: what a camera saw, and frames drawn from above."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.draw._picture import check_installed
from sgstore.draw._stored import draw_stored
from sgstore.errors import ExportError

if TYPE_CHECKING:
    from PIL.Image import Image

    from sgstore.matches import Matches
    from sgstore.query import Store

_PICTURES: Final = ("jpeg", "png", "webp", "tiff", "bmp")


def camera_image(store: Store, frame: int | str, channel: str) -> Image:
    """The picture in the message of a camera that belongs to a frame.

    Raises
    ------
    StoreError
        There is no such frame or channel, or no message of the channel belongs to the frame.
    TraceError
        The recording is gone, was replaced, or is damaged there.
    ExportError
        The message holds no picture: it is a frame of a video, or of another sensor.
    MissingExtraError
        Pillow is not installed.
    """
    check_installed()
    from PIL import Image

    media = store.file.carried(frame, channel)
    if media.form not in _PICTURES:
        held = "no picture" if media.form == "message" else f"{media.form} video, not a picture"
        raise ExportError(
            f"{channel}: the message holds {held}; 'sgstore payload' writes it as it is"
        )
    try:
        image = Image.open(io.BytesIO(media.data))
        image.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise ExportError(f"{channel}: the picture cannot be read: {error}") from error
    return image


def frame_image(store: Store, frame: int | str, matches: Matches | None, **look: Any) -> Image:
    """A frame from above; parameters and errors are those of :func:`sgstore.draw.draw_stored`."""
    check_installed()
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "frame.png"
        draw_stored(store, frame, file, matches=matches, **look)
        image = Image.open(file)
        image.load()
    return image
