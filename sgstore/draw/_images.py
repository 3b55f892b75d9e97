"""Pictures of stored frames as Pillow images and PNG data."""

from __future__ import annotations

import io
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.draw._page import PICTURE_PIXELS
from sgstore.draw._picture import check_installed, draw_frame, title_of
from sgstore.draw._stored import Bindings, camera_of, draw_stored, map_of
from sgstore.errors import ExportError, StoreError

if TYPE_CHECKING:
    from PIL.Image import Image

    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import SceneGraph
    from sgstore.query import Store
    from sgstore.store import FrameRef, StoreFile

_PICTURES: Final = ("jpeg", "png", "webp", "tiff", "bmp")


def camera_image(store: Store, frame: int | str, channel: str) -> Image:
    """Return the recorded camera picture of a frame as a Pillow image.

    Raises
    ------
    StoreError
        The frame or channel is missing, or the frame has no message of the channel.
    TraceError
        The recording is missing, was replaced, or is damaged at this place.
    ExportError
        The message has no picture: it has a video frame, or data of another sensor.
    MissingExtraError
        Pillow is not installed.
    """
    check_installed()
    media = store.file.carried(frame, channel)
    if media.form not in _PICTURES:
        held = "no picture" if media.form == "message" else f"{media.form} video, not a picture"
        raise ExportError(
            f"{channel}: the message holds {held}; 'sgstore payload' writes it as it is"
        )
    return _opened(media.data, channel)


def _opened(data: bytes, channel: str) -> Image:
    """Return an untrusted picture of a recording as a Pillow image, with permitted formats and sizes."""
    from PIL import Image

    try:
        image = Image.open(io.BytesIO(data), formats=[form.upper() for form in _PICTURES])
        if image.width * image.height > PICTURE_PIXELS:
            raise ExportError(
                f"{channel}: the picture has {image.width} by {image.height} pixels, more than is opened"
            )
        image.load()
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ExportError(f"{channel}: the picture cannot be read: {error}") from error
    return image


def frame_image(store: Store, frame: int | str, matches: Bindings | None, **look: Any) -> Image:
    """Return a picture of a frame seen from above, as a Pillow image."""
    check_installed()
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "frame.png"
        draw_stored(store, frame, file, matches=matches, **look)
        image = Image.open(file)
        image.load()
    return image


THUMBNAIL: Final = 180
"""Longest side of a thumbnail; pixels."""


def thumbnail(file: StoreFile, frame: FrameRef, side: int = THUMBNAIL) -> bytes:
    """Return a thumbnail of a frame as JPEG: its camera picture, or the view from above.

    Raises
    ------
    StoreError, TraceError, ExportError
        The frame or its recording is missing, or the picture cannot be read.
    MissingExtraError
        The packages for drawing are not installed.
    """
    check_installed()
    topic = camera_of(file, frame.trace)
    data = b""
    if topic:
        with suppress(StoreError):  # cameras are slower than frames: a frame may have no picture
            media = file.carried(frame.frame_id, topic)
            data = media.data if media.form in _PICTURES else b""
    if not data:
        graph = file.graph(frame.frame_id)
        title = title_of(graph, file.trace(frame.trace_id).start_ns)
        data = graph_picture(graph, map_of(file, frame.trace), title=title)
    image = _opened(data, topic).convert("RGB")
    image.thumbnail((side, side))
    small = io.BytesIO()
    image.save(small, "JPEG", quality=85)
    return small.getvalue()


def graph_picture(graph: SceneGraph, road_map: RoadMap | None = None, **look: Any) -> bytes:
    """Return a picture of a scene graph as PNG, seen from above or as a diagram.

    Raises
    ------
    MissingExtraError
        The packages for drawing are not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "graph.png"
        draw_frame(graph, road_map, file, **look)
        return file.read_bytes()
