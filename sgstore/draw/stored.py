"""Pictures of frames of a store: its graph, its map, what a query matches in it, and what a camera saw."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sgstore.draw import check_installed, draw_frame
from sgstore.errors import ExportError, StoreError
from sgstore.opendrive import read_map

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from sgstore.draw import Relations
    from sgstore.matches import Matches
    from sgstore.query import Store
    from sgstore.roads import RoadMap
    from sgstore.store import FrameRef

NO_CAMERA: Final = "none"

FPS: Final = 10.0
"""Pictures a second of an animation."""
MOST_FPS: Final = 50.0
"""Players show no more: see :data:`sgstore.draw.gif.LEAST_DELAY`."""
SAMPLES: Final = 8
"""Frames of a clip that are looked at before it is drawn."""

_RANGE: Final = re.compile(r"(.+)([@#])(\d+(?:\.\d+)?s?)\.\.(\d+(?:\.\d+)?s?)")

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


@dataclass(frozen=True, slots=True)
class FrameRange:
    """Frames of a trace from one to another, both included; each is named as everywhere: ``town@12s``."""

    first: str
    last: str


def range_of(text: str) -> FrameRange | None:
    """The frames that ``TRACE@12s..18s`` or ``TRACE#120..180`` means; ``None`` if it is a frame.

    >>> range_of("town@12.5s..18s")
    FrameRange(first='town@12.5s', last='town@18s')
    >>> range_of("town#120..180").last, range_of("town#120")
    ('town#180', None)
    """
    found = _RANGE.fullmatch(text.strip())
    if found is None:
        return None
    trace, mark, first, last = found.groups()
    unit = "s" if mark == "@" else ""
    first, last = (f"{trace}{mark}{end.removesuffix('s')}{unit}" for end in (first, last))
    return FrameRange(first, last)


def draw_clip(  # noqa: PLR0913  as many options as the picture has
    store: Store,
    frames: FrameRange,
    to: Path,
    *,
    matches: Matches | None = None,
    camera: str | None = None,
    relations: Relations = "ego",
    radius: float | None = None,
    north_up: bool = False,
    diagram: bool = False,
    fps: float = FPS,
    on_frame: Callable[[int, int], None] | None = None,
) -> int:
    """Draw a clip of a store as an animation that runs as fast as the trace did.

    Parameters
    ----------
    frames : FrameRange
    to : Path
        ``….gif``; a file that is there is replaced.
    fps : float
        Pictures a second at most; of frames that come faster some are left out.
    on_frame : function, optional
        Called with the number of pictures drawn and of all, after each.
    store, matches, camera, relations, radius, north_up, diagram
        See :func:`draw_stored`.

    Returns
    -------
    int
        Pictures in which the query matches.

    Raises
    ------
    StoreError, ExportError, MissingExtraError, TraceError
        As of :func:`draw_stored`; or the clip ends before it begins.
    """
    check_installed()
    from sgstore.draw.film import Film, Shot

    if not 0 < fps <= MOST_FPS:
        raise ValueError(f"fps is {fps}, expected a number up to {MOST_FPS:g}")

    def shot(ref: FrameRef, *, seen: bool) -> Shot:
        # The store is kept open for one frame at a time, so that others can write while this one draws.
        with store.file.snapshot():
            bindings = matches.bindings(ref) if matches is not None else []
            picture = _picture(store, ref, camera) if seen and not diagram else None
            return Shot(store.file.graph(ref.frame_id), bindings[0] if bindings else {}, picture)

    with store.file.snapshot():
        chosen = _chosen(store, frames, fps)
        road_map = map_of(store, chosen[0].trace)
    spread = sorted({len(chosen) * i // SAMPLES for i in range(SAMPLES)} | {len(chosen) - 1})
    samples = [shot(chosen[number], seen=False) for number in spread]
    look: dict[str, Any] = {"relations": relations, "radius": radius}
    look |= {"north_up": north_up, "diagram": diagram}
    marked = 0
    with Film(to, road_map, samples, **look) as film:
        for number, ref in enumerate(chosen, start=1):
            now = shot(ref, seen=True)
            film.add(now)
            marked += bool(now.highlight)
            if on_frame is not None:
                on_frame(number, len(chosen))
    return marked


def _chosen(store: Store, frames: FrameRange, fps: float) -> list[FrameRef]:
    """The frames of a clip that are drawn: the first, and each that comes late enough after the last one."""
    first, last = store.file.frame(frames.first), store.file.frame(frames.last)
    if last.seq < first.seq:
        raise ExportError(f"the clip from {frames.first} to {frames.last} ends before it begins")
    chosen: list[FrameRef] = []
    due: float | None = None
    for seq in range(first.seq, last.seq + 1):
        frame = store.file.frame(f"{first.trace}#{seq}")
        # A little grace: the clock of a trace is not that exact. One that runs back starts anew.
        if due is None or not due - 2e9 / fps <= frame.time_ns < due:
            chosen.append(frame)
            due = frame.time_ns + 0.95e9 / fps
    return chosen


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
