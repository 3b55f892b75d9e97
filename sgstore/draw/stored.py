"""Pictures of frames of a store: its graph, its map, what a query matches in it, and what a camera saw."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sgstore.draw import draw_frame
from sgstore.errors import ExportError, StoreError
from sgstore.opendrive import read_map

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.draw import Relations
    from sgstore.query import Matches, Store
    from sgstore.roads import RoadMap
    from sgstore.store import FrameRef

NO_CAMERA: Final = "none"

_PICTURE: Final = re.compile(rb"\xff\xd8\xff|\x89PNG\r\n\x1a\n")
"""How JPEG and PNG begin. Pictures stand whole in their messages, whatever encodes these."""


def draw_stored(  # noqa: PLR0913  as many options as the picture has
    store: Store,
    frame: int | str,
    to: Path,
    *,
    matches: Matches | None = None,
    camera: str | None = None,
    relations: Relations = "ego",
    radius: float | None = None,
    north_up: bool = False,
    diagram: bool = False,
) -> bool:
    """Draw a frame of a store from above.

    Parameters
    ----------
    store : Store
    frame : int or str
        ``frame_id``, ``TRACE#SEQ`` or ``TRACE@12.3s``.
    to : Path
        ``….png`` or ``….svg``; a file that is there is replaced.
    matches : Matches, optional
        What they bind in this frame is marked.
    camera : str, optional
        Channel of the picture to put beside it; by default the first that carries pictures, ``none`` for none.
    relations, radius, north_up, diagram
        See :func:`sgstore.draw.draw_frame`.

    Returns
    -------
    bool
        Whether the query matches in this frame.

    Raises
    ------
    StoreError, ExportError, MissingExtraError, TraceError
        There is no such frame or channel; the picture cannot be made; the recording is gone or was replaced.
    """
    with store.file.snapshot():
        ref = store.file.frame(frame)
        bindings = matches.bindings(ref) if matches is not None else []
        draw_frame(
            store.file.graph(ref.frame_id),
            map_of(store, ref.trace),
            to,
            highlight=bindings[0] if bindings else {},
            picture=None if diagram else _picture(store, ref, camera),
            relations=relations,
            radius=radius,
            north_up=north_up,
            diagram=diagram,
        )
    return bool(bindings)


def map_of(store: Store, trace: str) -> RoadMap | None:
    """The road map of a trace of a store; ``None`` if it has none."""
    found = store.file.road_map_text(trace)
    return read_map(found[1], found[0]) if found else None


def _picture(store: Store, frame: FrameRef, camera: str | None) -> bytes | None:
    """What the camera saw nearest to the frame, as JPEG or PNG; ``None`` if it saw nothing then."""
    if camera == NO_CAMERA:
        return None
    try:
        message = store.payload(frame, camera or _camera_of(store, frame.trace))
    except StoreError:
        if camera:
            raise
        return None
    start = _PICTURE.search(message)
    if start is None:
        raise ExportError(
            f"no JPEG or PNG in the message of the camera at {frame.trace}#{frame.seq}"
        )
    return message[start.start() :]


def _camera_of(store: Store, trace: str) -> str:
    """The first channel that carries pictures; empty if none does."""
    topics = (c.topic for c in store.file.channels(trace) if c.schema.endswith("CompressedImage"))
    return min(topics, default="")
