"""Pictures and animations of the frames of a store.

A clip becomes an animation: the pictures of its frames, with one scale and one legend.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from sgstore.base.display import number_of
from sgstore.draw._animation import animation
from sgstore.draw._film import FilmPage
from sgstore.draw._legend import entries_of
from sgstore.draw._page import own_style
from sgstore.draw._picture import (
    check_installed,
    checked,
    diagram_page,
    draw_frame,
    draw_graph,
    frame_page,
    matched_nodes,
    title_of,
)
from sgstore.draw._scene import DrawnFrame
from sgstore.draw._view import called, view_of
from sgstore.errors import ExportError, StoreError
from sgstore.maps.opendrive import read_map

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.draw._drawn_links import Relations
    from sgstore.draw._legend import Entry
    from sgstore.draw._view import Names
    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import SceneGraph
    from sgstore.query import Store
    from sgstore.store import FrameRef, StoreFile


DPI: Final = 85.0
"""Pixels per inch of an animation. It is lower than for a single picture, to save time."""

Shot = tuple["SceneGraph", "Mapping[str, int]", "bytes | None"]
"""Frame of a clip: its graph, the nodes to mark (see :func:`sgstore.draw.draw_frame`), and the camera picture.

Without a new camera picture the previous one stays.
"""
FrameRange = tuple[str, str]
"""Names of the first and the last frame of a range (both included), such as ``town@12s``."""


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
    """Draw the frames of a clip into an animation file. Yield each frame after it is drawn.

    Parameters
    ----------
    to : Path
        ``….gif``, ``….mp4`` or ``….webm``; an existing file is replaced at the end.
    road_map : RoadMap or None
    samples : sequence of Shot
        Some shots from the whole clip: they define the scale and the legend.
    shots : iterable of Shot
    relations, radius, north_up, diagram
        As in :func:`sgstore.draw.draw_frame`.
    start_ns : int, optional
        Simulation time of the start of the trace.

    Raises
    ------
    ExportError
        The ending is unknown, or the file cannot be written.
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
    """Return the radius in metres of a view that fits all given frames; ``None`` if no frame is given."""
    radii = (view_of(graph, None, matched_nodes(marked)).radius for graph, marked, _ in samples)
    return max(radii, default=None)


def _legend(scenes: Iterable[DrawnFrame]) -> list[Entry]:
    """Return the distinct legend entries of several frames, in order of first occurrence."""
    found: dict[Entry, None] = {}
    for scene in scenes:
        half = scene.view.radius
        found |= dict.fromkeys(entries_of(scene, (half, half)))
    signs = [entry.sign for entry in found]
    return sorted(found, key=lambda entry: signs.index(entry.sign))


# Pictures of frames of a store: graph, map, matches of a query, and camera picture.

NO_CAMERA: Final = "none"

FPS: Final = 10.0
"""Default number of pictures per second in an animation."""
MOST_FPS: Final = 50.0
"""Largest number of pictures per second in players; :data:`sgstore.draw._animation.LEAST_DELAY`."""
SAMPLES: Final = 8
"""Number of sample frames of a clip that determine its scale and legend."""
AT_ONCE: Final = 8
"""Number of frames that are read at once."""

_PICTURE: Final = re.compile(rb"\xff\xd8\xff|\x89PNG\r\n\x1a\n")
"""First bytes of JPEG and PNG pictures. Every message encoding contains a picture unchanged."""


class Bindings(Protocol):
    """Interface of an object that returns the matches of a query in a frame; pictures mark these nodes."""

    def bindings(self, frame: FrameRef) -> list[dict[str, int]]:
        """For each match in a frame, return its nodes: variable name → node id."""
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
    abstraction: str = "",
) -> bool:
    """Draw a picture of a stored frame seen from above; return True if the query matches in the frame.

    Parameters
    ----------
    store : Store
    frame : int or str
        ``frame_id``, ``TRACE#SEQ`` or ``TRACE@12.3s``.
    to : str or Path
        ``….png`` or ``….svg``; an existing file is replaced.
    matches : Matches or other Bindings, optional
        Their bindings in this frame are marked.
    camera : str, optional
        Channel of the camera picture; by default the first with pictures, ``none`` for no picture.
    relations, radius, north_up, diagram
        See :func:`sgstore.draw.draw_frame`.
    names : str
        Labels of entities: ``number`` (``car 17``), ``ident`` (the simulator's id), ``type`` (its
        type).
    abstraction : str
        Draw the graph of this abstraction instead; all other options are ignored.

    Returns
    -------
    bool
        True if the query matches in this frame.

    Raises
    ------
    StoreError, ExportError, MissingExtraError, TraceError
        The frame or channel is missing; the picture cannot be made; the recording is missing or was
        replaced.
    """
    if abstraction:
        _draw_abstraction(store, frame, to, abstraction)
        return False
    with store.file.snapshot():
        ref = store.file.frame(frame)
        bindings = matches.bindings(ref) if matches is not None else []
        graph = called(store.file.graph(ref.frame_id), names)
        draw_frame(
            graph,
            map_of(store.file, ref.trace),
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


def _draw_abstraction(store: Store, frame: int | str, to: str | Path, abstraction: str) -> None:
    """Draw the graph of a frame in an abstraction."""
    graph = store.graph(frame, abstraction)
    ref = store.file.frame(frame)
    size = f"{number_of(len(graph), 'node')}, {number_of(graph.number_of_edges(), 'edge')}"
    title = f"{ref.trace}   frame {ref.seq}   {ref.t:.3f} s"
    draw_graph(graph, to, title=title, subtitle=f"graph of the abstraction {abstraction}: {size}")


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
    """Draw a clip of a store as an animation at its original speed. Return the number of frames with matches.

    Parameters
    ----------
    frames : FrameRange
    to : str or Path
        ``….gif``, or with the extra ``video`` ``….mp4`` or ``….webm``; an existing file is
        replaced.
    fps : float
        Greatest number of pictures per second. Of faster frames some are left out, if possible
        those without a match.
    on_frame : function, optional
        Called after each picture with the number of drawn pictures and the total.
    store, matches, camera, relations, radius, north_up, diagram, names
        See :func:`draw_stored`.

    Returns
    -------
    int
        Number of pictures with matches.

    Raises
    ------
    StoreError, ExportError, MissingExtraError, TraceError
        As in :func:`draw_stored`; or the clip ends before it begins.
    """
    check_installed()

    if not 0 < fps <= MOST_FPS:
        raise ExportError(f"fps is {fps}, expected a number up to {MOST_FPS:g}")

    def shots(refs: Sequence[FrameRef], *, seen: bool) -> Iterator[Shot]:
        # The store is open for a few frames at a time, so that other processes can write in
        # between.
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
        groups = _groups(store, frames, fps)
        trace = groups[0][0].trace
        road_map = map_of(store.file, trace)
        usual = camera_of(store.file, trace)
        if camera is None and not usual:
            camera = NO_CAMERA
    chosen = [_shown(group, matches) for group in groups]
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


def _groups(store: Store, frames: FrameRange, fps: float) -> list[list[FrameRef]]:
    """Return the frames of a clip in groups, at most ``fps`` per second. One frame of a group is drawn."""
    first, last = (store.file.frame(end) for end in frames)
    if last.seq < first.seq:
        raise ExportError(f"the clip from {' to '.join(frames)} ends before it begins")
    groups: list[list[FrameRef]] = []
    due: float | None = None
    sql = (
        "SELECT frame_id, seq, time_ns, log_time_ns, t FROM frames"
        " WHERE frame_id BETWEEN ? AND ? ORDER BY frame_id"
    )
    for about in store.file.rows(sql, [first.frame_id, last.frame_id]).dicts():
        frame = replace(first, **about)
        # A small tolerance covers inexact clocks. A clock that runs back starts again.
        if due is None or not due - 2e9 / fps <= frame.time_ns < due:
            groups.append([])
            due = frame.time_ns + 0.95e9 / fps
        groups[-1].append(frame)
    return groups


def _shown(group: Sequence[FrameRef], matches: Bindings | None) -> FrameRef:
    """Return the first frame of a group in which the query matches, otherwise the first frame."""
    if matches is None or len(group) == 1:
        return group[0]
    return next((frame for frame in group if matches.bindings(frame)), group[0])


def map_of(file: StoreFile, trace: str) -> RoadMap | None:
    """Return the road map of a trace of a store; ``None`` if the trace has no map."""
    found = file.road_map_text(trace)
    return read_map(found[1], found[0]) if found else None


def _picture(
    store: Store, frame: FrameRef, camera: str | None, usual: str | None = None
) -> bytes | None:
    """Return the camera picture nearest to a frame, as JPEG or PNG data; ``None`` if none is recorded.

    ``usual``: the known default camera.
    """
    if camera == NO_CAMERA:
        return None
    try:
        topic = camera or (camera_of(store.file, frame.trace) if usual is None else usual)
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


def camera_of(file: StoreFile, trace: str) -> str:
    """Return the alphabetically first channel with camera pictures; empty if no pictures are recorded."""
    topics = (c.topic for c in file.channels(trace) if c.schema.endswith("CompressedImage"))
    return min(topics, default="")
