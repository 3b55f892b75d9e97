"""A clip as an animation: the pictures of its frames, all to one scale and with one legend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from sgstore.draw import Relations, checked, diagram_page, frame_page, matched_nodes, title_of
from sgstore.draw.gif import Gif
from sgstore.draw.legend import entries_of
from sgstore.draw.page import own_style
from sgstore.draw.scene import Scene
from sgstore.draw.view import view_of
from sgstore.errors import ExportError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from sgstore.draw.legend import Entry
    from sgstore.graph import SceneGraph
    from sgstore.roads import RoadMap

DPI: Final = 85.0
"""Pixels of an inch: an animation is watched and not studied, and has many pictures."""
ENDING: Final = ".gif"


@dataclass(frozen=True, slots=True)
class Shot:
    """A frame of a clip.

    Attributes
    ----------
    graph : SceneGraph
    highlight : mapping of str to int
        As in :func:`sgstore.draw.draw_frame`.
    picture : bytes or None
        What the camera saw; ``None``: what it saw before stays.
    """

    graph: SceneGraph
    highlight: Mapping[str, int]
    picture: bytes | None = None


class Film:
    """Draws shots into an animation; to be used in a ``with``.

    Parameters
    ----------
    to : Path
        ``….gif``; a file that is there is replaced when all is drawn.
    road_map : RoadMap or None
    samples : sequence of Shot
        Some of the shots, from all of the clip: they tell the scale and what the legend explains.
    relations, radius, north_up, diagram
        As in :func:`sgstore.draw.draw_frame`.

    Raises
    ------
    ExportError
        The ending is another, or the file cannot be written.
    """

    def __init__(
        self,
        to: Path,
        road_map: RoadMap | None,
        samples: Sequence[Shot],
        *,
        relations: Relations = "ego",
        radius: float | None = None,
        north_up: bool = False,
        diagram: bool = False,
    ) -> None:
        if to.suffix.lower() != ENDING:
            raise ExportError(f"cannot draw a clip into {to.name!r}: end the name in {ENDING}")
        self._map = road_map
        self._relations: Relations = relations
        self._north_up = north_up
        self._diagram = diagram
        self._radius = checked(radius) or max(
            (view_of(s.graph, None, matched_nodes(s.highlight)).radius for s in samples),
            default=None,
        )
        self._entries = self._legend(samples)
        self._picture: bytes | None = None
        self._start_ns: int | None = None
        self._gif = Gif(to)

    def __enter__(self) -> Self:
        self._gif.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        self._gif.__exit__(kind, *exception)

    def add(self, shot: Shot) -> None:
        """Draw the next shot."""
        graph, self._picture = shot.graph, shot.picture or self._picture
        start = self._start_ns = graph.time_ns if self._start_ns is None else self._start_ns
        scene, title = self._scene(shot), title_of(graph)
        with own_style():
            page = (
                diagram_page(scene, title, self._relations, self._entries, DPI)
                if self._diagram
                else frame_page(scene, title, self._picture, self._entries, DPI)
            )
            self._gif.add(page.pixels(), (graph.time_ns - start) / 1e9)

    def _scene(self, shot: Shot) -> Scene:
        matched = matched_nodes(shot.highlight)
        view = view_of(shot.graph, self._radius, matched, north_up=self._north_up)
        return Scene.of(shot.graph, self._map, matched, view, self._relations)

    def _legend(self, samples: Sequence[Shot]) -> list[Entry]:
        """Entries of all samples, each once, in the order of the first that has it."""
        found: dict[Entry, None] = {}
        for shot in samples:
            scene = self._scene(shot)
            half = scene.view.radius
            found |= dict.fromkeys(entries_of(scene, (half, half)))
        signs = [entry.sign for entry in found]
        return sorted(found, key=lambda entry: signs.index(entry.sign))
