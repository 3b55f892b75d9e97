"""Pictures of a single frame or of a road map, as PNG or SVG by the file ending.

A frame is seen from above, with the ego in the middle and its heading up. The legend explains every
sign in a picture, and only these, for readers who do not know this project. An existing file is
replaced. The same input gives the same bytes.

Texts from traces are cut and shown literally; markup in them is not interpreted. In an SVG, texts
are texts, and the groups of nodes have the ids ``node-17``, ``halo-17``, ``label-17``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from sgstore.base.display import number_of
from sgstore.draw._view import clean, number, view_of
from sgstore.errors import ExportError, MissingExtraError
from sgstore.model.world import seconds_of

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence
    from pathlib import Path
    from typing import Any

    import networkx as nx

    from sgstore.draw._drawn_links import Relations
    from sgstore.draw._legend import Entry
    from sgstore.draw._page import Page, Rect
    from sgstore.draw._scene import DrawnFrame
    from sgstore.maps.roads import RoadMap
    from sgstore.model.graph import SceneGraph


_MARGIN: Final = 14.0
_TITLE: Final = 40.0
_WINDOW: Final = 520.0
_PANEL: Final = 244.0
_READ_DIAGRAM: Final = (
    "above: entities, where the ego sees them; below: the map, from left to right"
)
_NS_OF_A_YEAR: Final = 31_536_000 * 10**9


def draw_frame(  # noqa: PLR0913  one option for each thing that people ask of a picture
    graph: SceneGraph,
    road_map: RoadMap | None,
    to: str | Path,
    *,
    highlight: Mapping[str, int] | Sequence[int] = (),
    picture: bytes | None = None,
    radius: float | None = None,
    title: str | None = None,
    relations: Relations = "ego",
    north_up: bool = False,
    diagram: bool = False,
) -> None:
    """Draw a picture of a frame seen from above, and write it to a file.

    Parameters
    ----------
    graph : SceneGraph
    road_map : RoadMap or None
        The ground; without a map only entities are drawn.
    to : str or Path
        ``….png`` or ``….svg``; an existing file is replaced.
    highlight : mapping of str to int, or sequence of int
        Matched nodes, by variable or as a list. The panel names ids outside the graph as missing.
    picture : bytes, optional
        Camera picture for the panel, JPEG or PNG.
    radius : float, optional
        Half the side of the window; m. By default it fits the entities, 30 to 60 m.
    title : str, optional
        By default trace, frame and time.
    relations : {"ego", "all", "none"}
        ``ego``: proximity to the ego, and all relations among matched nodes; ``all``: every
        relation.
    north_up : bool
        True for north up; by default the ego's heading is up.
    diagram : bool
        True for the graph as nodes and edges in the panel, without the camera picture.

    Raises
    ------
    ExportError
        The ending is unknown, the file cannot be written, or the camera picture cannot be read.
    MissingExtraError
        The drawing packages are not installed.
    """
    with drawing(to):
        from sgstore.draw._scene import DrawnFrame

        matched = matched_nodes(highlight)
        view = view_of(graph, checked(radius), matched, north_up=north_up)
        scene = DrawnFrame.of(graph, road_map, matched, view, relations)
        title = title or title_of(graph)
        page = (
            diagram_page(scene, title, relations) if diagram else frame_page(scene, title, picture)
        )
        page.save(to)


def frame_page(
    scene: DrawnFrame,
    title: str,
    picture: bytes | None,
    entries: Sequence[Entry] | None = None,
    blank: Callable[[float, float], Page] | None = None,
) -> Page:
    """Return a page with a frame seen from above, and a side panel with matches, surroundings and legend.

    ``entries``: the legend, by default of the occurring signs; ``blank``: function that makes a
    page of a width and height.
    """
    from sgstore.draw._page import Page
    from sgstore.draw._scene import paint_scene

    page = (blank or Page)(3 * _MARGIN + _WINDOW + _PANEL, _MARGIN + _WINDOW + _TITLE)
    stage = page.stage((_MARGIN, _MARGIN, _MARGIN + _WINDOW, _MARGIN + _WINDOW), scene.view)
    unnamed = paint_scene(stage, scene)
    _paint_title(page, title, _subtitle(scene, unnamed))
    _paint_panel(page, scene, stage.half, picture, entries)
    return page


def diagram_page(
    scene: DrawnFrame,
    title: str,
    relations: Relations,
    entries: Sequence[Entry] | None = None,
    blank: Callable[[float, float], Page] | None = None,
) -> Page:
    """Return a page with a frame seen from above, the diagram of its scene graph, and the legend."""
    from sgstore.draw._diagram import diagram_entries, paint_diagram
    from sgstore.draw._legend import entries_of
    from sgstore.draw._page import Page
    from sgstore.draw._panel import key_height, paint_key
    from sgstore.draw._scene import paint_scene

    half = scene.view.radius
    known = entries_of(scene, (half, half)) if entries is None else entries
    key = [*(e for e in known if not e.is_long), *diagram_entries()]
    foot = key_height(len(key)) + _MARGIN
    page = (blank or Page)(3 * _MARGIN + 2 * _WINDOW, _MARGIN + foot + _WINDOW + _TITLE)
    bottom, middle = _MARGIN + foot, 2 * _MARGIN + _WINDOW
    stage = page.stage((_MARGIN, bottom, _MARGIN + _WINDOW, bottom + _WINDOW), scene.view)
    unnamed = paint_scene(stage, scene)
    _paint_title(page, title, _subtitle(scene, unnamed))
    box = (middle, bottom, middle + _WINDOW, bottom + _WINDOW)
    told = paint_diagram(page, box, scene, relations)
    _paint_title(page, "Its scene graph", f"{told}  ·  {_READ_DIAGRAM}", left=middle)
    foot_box = (_MARGIN, _MARGIN, page.width - _MARGIN, bottom - _MARGIN / 2)
    page.once(("key", *key), foot_box, lambda: paint_key(page, key, foot_box))
    return page


def draw_graph(graph: nx.MultiDiGraph[Any], to: str | Path, *, title: str, subtitle: str) -> None:
    """Draw the graph of an abstraction: nodes in a ring around the ego, and a list of the edges.

    Lines have no arrows: the list has the edges with their direction, those of the ego first. It
    ends with the number of edges that do not fit.

    Parameters
    ----------
    graph : networkx.MultiDiGraph
        As returned by :meth:`sgstore.query.Store.graph` with an abstraction.
    to : str or Path
        ``….png`` or ``….svg``.
    title, subtitle : str

    Raises
    ------
    ExportError
        The ending is unknown, or the file cannot be written.
    MissingExtraError
        The drawing packages are not installed.
    """
    with drawing(to):
        from sgstore.draw._abstraction import graph_page

        graph_page(graph, title, subtitle).save(to)


def draw_map(road_map: RoadMap, to: str | Path, *, title: str | None = None) -> None:
    """Draw a complete map, north up: lanes by type, junctions, crosswalks and signals.

    Parameters
    ----------
    road_map : RoadMap
    to : str or Path
        As in :func:`draw_frame`.
    title : str, optional
        By default the map's name.

    Raises
    ------
    ExportError
        The ending is unknown, the file cannot be written, or the map has no lanes.
    MissingExtraError
        The drawing packages are not installed.
    """
    with drawing(to):
        from sgstore.draw._atlas import paint_atlas
        from sgstore.draw._page import Page

        page = Page(3 * _MARGIN + _WINDOW + _PANEL, _MARGIN + _WINDOW + _TITLE)
        window: Rect = (_MARGIN, _MARGIN, _MARGIN + _WINDOW, _MARGIN + _WINDOW)
        subtitle = paint_atlas(page, road_map, window, _panel_box(page))
        _paint_title(page, title or f"map {clean(road_map.name)}", subtitle)
        page.save(to)


def title_of(graph: SceneGraph, start_ns: int | None = None) -> str:
    """Return a title for a frame: its trace, number and time.

    The time is relative (``t``) if the start of the trace is known. An absolute date is shown as
    well.
    """
    dated = graph.time_ns > _NS_OF_A_YEAR
    parts = [clean(graph.trace), f"frame {graph.seq}"]
    if start_ns is not None or not dated:
        parts.append(f"{seconds_of(graph.time_ns - (start_ns or 0)):.3f} s")
    if dated:
        moment = datetime.fromtimestamp(graph.time_ns / 1e9, UTC)
        parts.append(f"{moment:%Y-%m-%d %H:%M:%S.%f}"[:-3] + " UTC")
    return "   ".join(parts)


def check_installed() -> None:
    """Raise an error if the drawing packages are not installed.

    Raises
    ------
    MissingExtraError
        They are not installed.
    """
    try:
        import matplotlib as mpl
        import PIL
    except ImportError as error:
        raise MissingExtraError("drawing", "viz") from error
    del mpl, PIL


@contextmanager
def drawing(to: str | Path) -> Generator[None]:
    """Context manager that sets the drawing style, and checks the file name and installed packages before.

    Raises
    ------
    ExportError
        The ending is not a picture format.
    MissingExtraError
        The drawing packages are not installed.
    """
    check_installed()
    from sgstore.draw._page import check_format, own_style

    check_format(to)
    with own_style():
        yield


def checked(radius: float | None) -> float | None:
    """Return the radius of a view in metres. An invalid value raises an error.

    Raises
    ------
    ExportError
        It is not from 1 to 10,000 m.
    """
    if radius is not None and not 1.0 <= radius <= 10_000.0:
        raise ExportError(f"radius is {radius} m, expected 1 to 10,000 m")
    return radius


def matched_nodes(highlight: Mapping[str, int] | Sequence[int]) -> dict[int, str]:
    """Return the variable names of matched nodes, by node id."""
    if not isinstance(highlight, Mapping):
        return dict.fromkeys(map(int, highlight), "")
    matched: dict[int, str] = {}
    for name, node in highlight.items():
        matched[int(node)] = f"{matched[int(node)]}, {name}" if int(node) in matched else str(name)
    return matched


def _subtitle(scene: DrawnFrame, unnamed: int) -> str:
    graph = scene.graph
    ego = graph.nodes.get(graph.ego, {}) if graph.ego is not None else {}
    speed = number(ego, "speed")
    turned_to_ego = scene.view.up == math.radians(number(ego, "heading"))
    told = [
        f"seen from above, {'ego heading' if turned_to_ego else 'north'} up",
        "" if ego else "no ego in this frame",
        "" if math.isnan(speed) else f"ego at {speed:.1f} m/s ({3.6 * speed:.0f} km/h)",
        f"scene graph: {number_of(len(graph.nodes), 'node')}, {number_of(len(graph.edges), 'edge')}",
        "no road map" if scene.ground is None else "",
        f"without a place, not drawn: {number_of(scene.lost, 'node')}" if scene.lost else "",
        f"{number_of(unnamed, 'name')} left out for lack of room" if unnamed else "",
    ]
    return "  ·  ".join(text for text in told if text)


def _paint_title(page: Page, title: str, subtitle: str, left: float = _MARGIN) -> None:
    from sgstore.draw._palette import FAINT_INK

    top = page.height
    page.text(left, top - 19, clean(title, 110), fontsize=11, weight="bold")
    page.text(left, top - 32, subtitle, fontsize=7.2, color=FAINT_INK)


def _panel_box(page: Page) -> Rect:
    left = 2 * _MARGIN + _WINDOW
    return (left, _MARGIN, page.width - _MARGIN, _MARGIN + _WINDOW)


def _paint_panel(
    page: Page,
    scene: DrawnFrame,
    half: tuple[float, float],
    picture: bytes | None,
    entries: Sequence[Entry] | None,
) -> None:
    import sgstore.draw._panel as side
    from sgstore.draw._legend import entries_of

    left, bottom, right, top = _panel_box(page)
    panel = side.Panel(page, left, right, bottom, top)
    entries = entries_of(scene, half) if entries is None else entries
    if picture is not None:
        side.paint_picture(panel, picture)
    if scene.matched:
        side.paint_matches(panel, scene)
    side.paint_surroundings(panel, scene, bottom + side.legend_height(entries))
    box = (left, bottom, page.width, panel.y)
    page.once(("legend", *entries, panel.y), box, lambda: side.paint_legend(panel, entries))
