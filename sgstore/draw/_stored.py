"""Pictures and animations of frames of a store.

A clip as an animation: the pictures of its frames, all to one scale and with one legend.
"""

from __future__ import annotations

import io
import re
import tempfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from sgstore.draw._animation import animation
from sgstore.draw._film import FilmPage
from sgstore.draw._legend import entries_of
from sgstore.draw._page import PICTURE_PIXELS, own_style
from sgstore.draw._picture import (
    check_installed,
    checked,
    diagram_page,
    draw_frame,
    frame_page,
    matched_nodes,
    title_of,
)
from sgstore.draw._scene import DrawnFrame
from sgstore.draw._view import called, view_of
from sgstore.errors import ExportError, StoreError
from sgstore.opendrive import read_map

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from PIL.Image import Image

    from sgstore.draw._legend import Entry
    from sgstore.draw._view import Names, Relations
    from sgstore.graph import SceneGraph
    from sgstore.query import Store
    from sgstore.roads import RoadMap
    from sgstore.store import FrameRef, StoreFile


DPI: Final = 85.0
"""Pixels of an inch: an animation is watched and not studied, and has many pictures."""


Shot = tuple["SceneGraph", "Mapping[str, int]", "bytes | None"]
"""A frame of a clip: its graph; what is marked, as in :func:`sgstore.draw.draw_frame`; what the camera saw.

Where it has no picture, the one before stays.
"""
FrameRange = tuple[str, str]
"""Frames of a trace from one to another, both included; each is named as everywhere: ``town@12s``."""


def filmed(  # noqa: PLR0913  as many options as the picture has
    to: str | Path,
    road_map: RoadMap | None,
    samples: Sequence[Shot],
    shots: Iterable[Shot],
    *,
    relations: Relations = "ego",
    radius: float | None = None,
    north_up: bool = False,
    diagram: bool = False,
    start_ns: int | None = None,
) -> Iterator[Shot]:
    """Draw shots into an animation, and give each when it is drawn.

    Parameters
    ----------
    to : Path
        ``….gif``, ``….mp4`` or ``….webm``; a file that is there is replaced when all is drawn.
    road_map : RoadMap or None
    samples : sequence of Shot
        Some of the shots, from all of the clip: they tell the scale and what the legend explains.
    shots : iterable of Shot
    relations, radius, north_up, diagram
        As in :func:`sgstore.draw.draw_frame`.
    start_ns : int, optional
        Simulation time at which the trace begins.

    Raises
    ------
    ExportError
        The ending is another, or the file cannot be written.
    MissingExtraError
        The package that writes videos is not installed.
    """
    film = animation(Path(to))
    reach = checked(radius) or scale_of(samples)
    pages: list[FilmPage] = []

    def blank(width: float, height: float) -> FilmPage:
        pages[:] = pages or [FilmPage(width, height, DPI)]
        pages[0].clear()
        return pages[0]

    def scene_of(shot: Shot) -> DrawnFrame:
        graph, marked, _ = shot
        matched = matched_nodes(marked)
        view = view_of(graph, reach, matched, north_up=north_up)
        return DrawnFrame.of(graph, road_map, matched, view, relations)

    entries = _legend(map(scene_of, samples))
    seen: bytes | None = None
    start: int | None = None
    with film:
        for shot in shots:
            graph, _, picture = shot
            seen = picture or seen
            start = graph.time_ns if start is None else start
            scene, title = scene_of(shot), title_of(graph, start_ns)
            with own_style():
                if diagram:
                    page = diagram_page(scene, title, relations, entries, blank)
                else:
                    page = frame_page(scene, title, seen, entries, blank)
                film.add(page.pixels(), (graph.time_ns - start) / 1e9)
            yield shot


def scale_of(samples: Iterable[Shot]) -> float | None:
    """The radius of a view that shows what matters in each of some shots; ``None`` if there is none."""
    radii = (view_of(graph, None, matched_nodes(marked)).radius for graph, marked, _ in samples)
    return max(radii, default=None)


def _legend(scenes: Iterable[DrawnFrame]) -> list[Entry]:
    """Entries of all scenes, each once, in the order of the first that has it."""
    found: dict[Entry, None] = {}
    for scene in scenes:
        half = scene.view.radius
        found |= dict.fromkeys(entries_of(scene, (half, half)))
    signs = [entry.sign for entry in found]
    return sorted(found, key=lambda entry: signs.index(entry.sign))


# Pictures of frames of a store: its graph, its map, what a query matches in it, and what a camera saw ----

NO_CAMERA: Final = "none"

FPS: Final = 10.0
"""Pictures a second of an animation."""
MOST_FPS: Final = 50.0
"""Players show no more: see :data:`sgstore.draw._animation.LEAST_DELAY`."""
SAMPLES: Final = 8
"""Frames of a clip that are looked at before it is drawn."""
AT_ONCE: Final = 8
"""Frames that are read together."""

_RANGE: Final = re.compile(r"(.+)([@#])(\d+(?:\.\d+)?s?)\.\.(\d+(?:\.\d+)?s?)")

_PICTURE: Final = re.compile(rb"\xff\xd8\xff|\x89PNG\r\n\x1a\n")
"""How JPEG and PNG begin. Pictures stand whole in their messages, whatever encodes these."""


class Bindings(Protocol):
    """Bindings of a query in a frame: :class:`sgstore.matches.Matches`, or what is known of them already."""

    def bindings(self, frame: FrameRef) -> list[dict[str, int]]:
        """Node ids of the variables by name, for each match."""
        ...


def draw_stored(  # noqa: PLR0913  as many options as the picture has
    store: Store,
    frame: int | str,
    to: str | Path,
    *,
    matches: Bindings | None = None,
    camera: str | None = None,
    relations: Relations = "ego",
    radius: float | None = None,
    north_up: bool = False,
    diagram: bool = False,
    names: Names = "number",
) -> bool:
    """Draw a frame of a store from above.

    Parameters
    ----------
    store : Store
    frame : int or str
        ``frame_id``, ``TRACE#SEQ`` or ``TRACE@12.3s``.
    to : str or Path
        ``….png`` or ``….svg``; a file that is there is replaced.
    matches : Matches or other Bindings, optional
        What they bind in this frame is marked.
    camera : str, optional
        Channel of the picture to put beside it; by default the first that carries pictures, ``none`` for none.
    relations, radius, north_up, diagram
        See :func:`sgstore.draw.draw_frame`.
    names : str
        What entities are called: ``number`` (``car 17``), ``ident`` (the simulator's id), ``type`` (its type).

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
        graph = called(store.file.graph(ref.frame_id), names)
        draw_frame(
            graph,
            map_of(store, ref.trace),
            to,
            title=title_of(graph, store.file.trace(ref.trace_id).start_ns),
            highlight=bindings[0] if bindings else {},
            picture=None if diagram else _picture(store, ref, camera),
            relations=relations,
            radius=radius,
            north_up=north_up,
            diagram=diagram,
        )
    return bool(bindings)


def range_of(text: str) -> FrameRange | None:
    """The frames that ``TRACE@12s..18s`` or ``TRACE#120..180`` means; ``None`` if it is a frame.

    >>> range_of("town@12.5s..18s")
    ('town@12.5s', 'town@18s')
    >>> range_of("town#120..180"), range_of("town#120")
    (('town#120', 'town#180'), None)
    """
    found = _RANGE.fullmatch(text.strip())
    if found is None:
        return None
    trace, mark, first, last = found.groups()
    unit = "s" if mark == "@" else ""
    first, last = (f"{trace}{mark}{end.removesuffix('s')}{unit}" for end in (first, last))
    return first, last


def draw_clip(  # noqa: PLR0913  as many options as the picture has
    store: Store,
    frames: FrameRange,
    to: str | Path,
    *,
    matches: Bindings | None = None,
    camera: str | None = None,
    relations: Relations = "ego",
    radius: float | None = None,
    north_up: bool = False,
    diagram: bool = False,
    names: Names = "number",
    fps: float = FPS,
    on_frame: Callable[[int, int], None] | None = None,
) -> int:
    """Draw a clip of a store as an animation that runs as fast as the trace did.

    Parameters
    ----------
    frames : FrameRange
    to : str or Path
        ``….gif``, or with the extra ``video`` ``….mp4`` or ``….webm``; a file that is there is replaced.
    fps : float
        Pictures a second at most; of frames that come faster some are left out.
    on_frame : function, optional
        Called with the number of pictures drawn and of all, after each.
    store, matches, camera, relations, radius, north_up, diagram, names
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

    if not 0 < fps <= MOST_FPS:
        raise ExportError(f"fps is {fps}, expected a number up to {MOST_FPS:g}")

    def shots(refs: Sequence[FrameRef], *, seen: bool) -> Iterator[Shot]:
        # The store is kept open for a few frames at a time, so that others can write while these are drawn.
        for start in range(0, len(refs), AT_ONCE):
            some = refs[start : start + AT_ONCE]
            with store.file.snapshot():
                scenes = store.file.graphs(np.array([ref.frame_id for ref in some]))
                graphs = [called(graph, names) for graph in scenes]
                found = [matches.bindings(ref) if matches is not None else [] for ref in some]
                pictures = [
                    _picture(store, ref, camera, usual) if seen and not diagram else None
                    for ref in some
                ]
            marked = [bindings[0] if bindings else {} for bindings in found]
            yield from zip(graphs, marked, pictures, strict=True)

    with store.file.snapshot():
        chosen = _chosen(store, frames, fps)
        trace = chosen[0].trace
        road_map = map_of(store, trace)
        usual = camera_of(store, trace)
        if camera is None and not usual:
            camera = NO_CAMERA
    spread = sorted({len(chosen) * i // SAMPLES for i in range(SAMPLES)} | {len(chosen) - 1})
    samples = [*shots([chosen[number] for number in spread], seen=False)]
    look: dict[str, Any] = {"relations": relations, "radius": radius}
    look |= {"north_up": north_up, "diagram": diagram}
    look["start_ns"] = store.file.trace(trace).start_ns
    marked = 0
    drawn = filmed(to, road_map, samples, shots(chosen, seen=True), **look)
    for number, (_, found, _) in enumerate(drawn, start=1):
        marked += bool(found)
        if on_frame is not None:
            on_frame(number, len(chosen))
    return marked


def _chosen(store: Store, frames: FrameRange, fps: float) -> list[FrameRef]:
    """The frames of a clip that are drawn: the first, and each that comes late enough after the last one."""
    first, last = (store.file.frame(end) for end in frames)
    if last.seq < first.seq:
        raise ExportError(f"the clip from {' to '.join(frames)} ends before it begins")
    chosen: list[FrameRef] = []
    due: float | None = None
    sql = (
        "SELECT frame_id, seq, time_ns, log_time_ns, t FROM frames"
        " WHERE frame_id BETWEEN ? AND ? ORDER BY frame_id"
    )
    for about in store.file.rows(sql, [first.frame_id, last.frame_id]).dicts():
        frame = replace(first, **about)
        # A little grace: the clock of a trace is not that exact. One that runs back starts anew.
        if due is None or not due - 2e9 / fps <= frame.time_ns < due:
            chosen.append(frame)
            due = frame.time_ns + 0.95e9 / fps
    return chosen


def map_of(store: Store, trace: str) -> RoadMap | None:
    """The road map of a trace of a store; ``None`` if it has none."""
    return _map_in(store.file, trace)


def _map_in(file: StoreFile, trace: str) -> RoadMap | None:
    found = file.road_map_text(trace)
    return read_map(found[1], found[0]) if found else None


def _picture(
    store: Store, frame: FrameRef, camera: str | None, usual: str | None = None
) -> bytes | None:
    """Picture of the camera nearest to the frame, as JPEG or PNG; ``None`` if there is none.

    ``usual``: the camera if none is asked for, where it is known already.
    """
    if camera == NO_CAMERA:
        return None
    try:
        topic = camera or (camera_of(store, frame.trace) if usual is None else usual)
        message = store.payload(frame, topic)
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


def camera_of(store: Store, trace: str) -> str:
    """The first channel that carries pictures; empty if none does."""
    return _camera_in(store.file, trace)


def _camera_in(file: StoreFile, trace: str) -> str:
    topics = (c.topic for c in file.channels(trace) if c.schema.endswith("CompressedImage"))
    return min(topics, default="")


# Pictures as objects of Pillow ------------------------------------------------------------------

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
    media = store.file.carried(frame, channel)
    if media.form not in _PICTURES:
        held = "no picture" if media.form == "message" else f"{media.form} video, not a picture"
        raise ExportError(
            f"{channel}: the message holds {held}; 'sgstore payload' writes it as it is"
        )
    return _opened(media.data, channel)


def _opened(data: bytes, channel: str) -> Image:
    """A picture of a recording, which nobody has looked at: of forms that are meant, and of a bounded size."""
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
    """A frame from above; parameters and errors are those of :func:`sgstore.draw.draw_stored`."""
    check_installed()
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "frame.png"
        draw_stored(store, frame, file, matches=matches, **look)
        image = Image.open(file)
        image.load()
    return image


THUMBNAIL: Final = 180
"""Longest side of a small picture; pixels."""


def thumbnail(file: StoreFile, frame: FrameRef, side: int = THUMBNAIL) -> bytes:
    """A small picture of a frame, as JPEG: what a camera saw, or, without one, the frame from above.

    Raises
    ------
    StoreError, TraceError, ExportError
        The frame, or its recording, is gone, or the picture cannot be read.
    MissingExtraError
        The packages for drawing are not installed.
    """
    check_installed()
    topic = _camera_in(file, frame.trace)
    data = b""
    if topic:
        with suppress(
            StoreError
        ):  # cameras are slower than frames: none of their pictures may belong to it
            media = file.carried(frame.frame_id, topic)
            data = media.data if media.form in _PICTURES else b""
    if not data:
        graph = file.graph(frame.frame_id)
        title = title_of(graph, file.trace(frame.trace_id).start_ns)
        data = graph_picture(graph, _map_in(file, frame.trace), title=title)
    image = _opened(data, topic).convert("RGB")
    image.thumbnail((side, side))
    small = io.BytesIO()
    image.save(small, "JPEG", quality=85)
    return small.getvalue()


def graph_picture(graph: SceneGraph, road_map: RoadMap | None = None, **look: Any) -> bytes:
    """A graph from above, as PNG; ``**look`` is that of :func:`sgstore.draw.draw_frame`.

    Raises
    ------
    MissingExtraError
        The packages for drawing are not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "graph.png"
        draw_frame(graph, road_map, file, **look)
        return file.read_bytes()
