"""Legend of a picture: one entry for each symbol or colour that occurs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon, Rectangle, RegularPolygon

import sgstore.draw._palette as palette
from sgstore.draw._drawn_links import ego_lane, seen_from_ego
from sgstore.draw._symbols import ROUND_KINDS, lamps
from sgstore.draw._view import ARROW_SECONDS, SCENERY, clean
from sgstore.graphs.relations import relations
from sgstore.model.vocabulary import KINDS, PROXIMITY, SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from matplotlib.artist import Artist

    from sgstore.draw._ground import GroundView
    from sgstore.draw._page import Page
    from sgstore.draw._scene import DrawnFrame


Sign = Literal[
    "box", "dot", "area", "sign", "lamp", "line", "dashes", "zebra", "mark", "arrow", "word"
]


@dataclass(frozen=True, slots=True)
class Entry:
    """Entry of a legend: a symbol or colour with its meaning.

    Attributes
    ----------
    sign : str
        Shape of the sign; empty for ``word``.
    text : str
        Its meaning.
    colour : str
        Colour of the sign; for a lamp, its state.
    width : float
        Line width; points.
    is_long : bool
        True if the text needs the full width of the panel.
    """

    sign: Sign
    text: str
    colour: str = palette.INK
    width: float = 1.2
    is_long: bool = False


def entries_of(scene: DrawnFrame, half: tuple[float, float]) -> list[Entry]:
    """Return the legend entries for a frame. ``half`` is half the width and height of the window; m."""
    bodies = [b for b in scene.bodies.values() if abs(b.x) <= half[0] and abs(b.y) <= half[1]]
    kinds = {b.kind for b in bodies if not b.is_ego}
    entries = [Entry("box", "ego", palette.EGO)] if any(b.is_ego for b in bodies) else []
    ground = [] if scene.ground is None else ground_entries(scene.ground)
    kinds -= {"traffic_light", *(entry.text for entry in ground)}
    entries += [_kind_entry(kind) for kind in KINDS if kind in kinds]
    lights = sorted({b.light for b in bodies if b.kind == "traffic_light"})
    entries += [Entry("lamp", f"light: {clean(s.replace('_', ' '), 16)}", s) for s in lights]
    entries += ground
    if ground and ego_lane(scene.graph) not in {None, *scene.matched}:
        entries.append(Entry("area", "the ego's lane", palette.EGO_LANE))
    if any(math.hypot(b.vx, b.vy) * ARROW_SECONDS > 0.5 for b in bodies):
        entries.append(Entry("arrow", f"way in {ARROW_SECONDS:g} s", palette.entity_tint("car")))
    if any(b.below for b in bodies):
        entries.append(Entry("dashes", "a storey below", palette.entity_tint("car")))
    if scene.matched:
        named = "matched" if any(scene.matched.values()) else "highlighted"
        entries.append(Entry("mark", named, palette.MATCH))
    return entries + _link_entries(scene)


def ground_entries(ground: GroundView) -> list[Entry]:
    """Return the legend entries for the visible lane types, crosswalks and scenery."""
    by_tint: dict[str, list[str]] = {}
    types = {ground.nodes.lane_type[row] for row in ground.of_kind("lane")}
    for lane_type in sorted(types, key=lambda t: (t not in palette.TRAVELLED, t)):
        by_tint.setdefault(palette.lane_tint(lane_type), []).append(clean(lane_type, 16))
    entries = [Entry("area", _lanes_called(names), tint) for tint, names in by_tint.items()]
    if ground.of_kind("crosswalk"):
        entries.append(Entry("zebra", "crosswalk", palette.CROSSWALK))
    standing = {KINDS[int(ground.nodes.kind[row])] for row in ground.of_kind(*SCENERY)}
    return entries + [Entry("area", k, palette.entity_tint(k)) for k in sorted(standing)]


def paint_swatch(page: Page, entry: Entry, at: tuple[float, float]) -> None:
    """Draw the symbol of a legend entry at a point of the page."""
    for artist in _swatch(entry, *at):
        page.add(page.sheet, artist)


def _swatch(  # noqa: PLR0911  one return a sign
    entry: Entry, x: float, y: float
) -> Sequence[Artist]:
    fill: dict[str, Any] = {"facecolor": entry.colour, "linewidth": 0.0}
    match entry.sign:
        case "box":
            wedge = ((x + 4, y), (x + 1.2, y + 1.6), (x + 1.2, y - 1.6))
            screen = Polygon(wedge, facecolor=palette.PAPER, linewidth=0.0, alpha=0.85)
            return Rectangle((x - 5, y - 2.4), 10, 4.8, **fill), screen
        case "dot":
            return [Circle((x, y), 3.2, **fill)]
        case "sign":
            return [RegularPolygon((x, y), 8, radius=3.4, orientation=math.pi / 8, **fill)]
        case "area" | "zebra":
            return _area(entry, x, y)
        case "lamp":
            return lamps(x, y, entry.colour, 0.8, None)
        case "mark":
            look: dict[str, Any] = {"edgecolor": entry.colour, "linewidth": 3.0}
            look |= {"facecolor": palette.PAPER, "joinstyle": "round"}
            return [Rectangle((x - 4.5, y - 2), 9, 4, **look)]
        case "line" | "dashes" | "arrow":
            return _strokes(entry, x, y)
        case "word":
            return ()


def _area(entry: Entry, x: float, y: float) -> list[Rectangle]:
    edge: dict[str, Any] = {"edgecolor": palette.RULE, "linewidth": 0.5}
    area = Rectangle((x - 6, y - 3.2), 12, 6.4, facecolor=entry.colour, **edge)
    tint = palette.lane_tint("driving")
    gaps = (-4.5, -1.5, 1.5) if entry.sign == "zebra" else ()
    return [area, *(Rectangle((x + at, y - 3), 1.5, 6, color=tint, linewidth=0.0) for at in gaps)]


def _strokes(entry: Entry, x: float, y: float) -> list[Line2D]:
    look: dict[str, Any] = {"color": entry.colour, "linewidth": entry.width}
    dash = (0, (4, 2)) if entry.sign == "dashes" else "-"
    head = [Line2D((x + 4, x + 7, x + 4), (y + 2, y, y - 2), **look)]
    shaft = Line2D((x - 7, x + 7), (y, y), linestyle=dash, **look)
    return [shaft, *(head if entry.sign == "arrow" else [])]


def _kind_entry(kind: str) -> Entry:
    sign: Sign = "box"
    if kind in ROUND_KINDS:
        sign = "dot"
    elif kind in SIGNALS:
        sign = "sign"
    elif kind in SCENERY:
        sign = "area"
    return Entry(sign, kind.replace("_", " "), palette.entity_tint(kind))


def _link_entries(scene: DrawnFrame) -> list[Entry]:
    drawn = [k for k in scene.links if scene.ends(k) is not None]
    matched = [k for k in drawn if k.family == "matched"]
    close = {k.closeness for k in drawn if k.family in {"ego", "matched"}}
    words = {word for k in matched for word in k.there + k.back}
    words.update(*seen_from_ego(scene.graph).values())
    families = {k.family for k in drawn}
    entries = [Entry("line", name, *palette.CLOSENESS[name]) for name in PROXIMITY if name in close]
    if "light" in families or "controlsTrafficOf" in words:
        entries.append(Entry("dashes", "controlsTrafficOf", palette.FAINT_INK))
    for family, text, colour in (
        ("entity", "between entities", palette.ENTITY_EDGE),
        ("mixed", "entity and road", palette.MIXED_EDGE),
        ("road", "among roads", palette.ROAD_EDGE),
    ):
        if family in families:
            entries.append(Entry("line", text, colour, 0.8))
    return entries + _word_entries(words)


def _word_entries(words: Iterable[str]) -> list[Entry]:
    met = set(words)
    known = [one for one in relations() if one.legend and one.name in met]
    return [Entry("word", f"{one.name}: {one.legend}", is_long=True) for one in known]


def _lanes_called(names: list[str]) -> str:
    if names[0] in palette.TRAVELLED:
        return "driving lane" if names[0] in {"driving", "bidirectional"} else f"{names[0]} lane"
    return f"lane type {names[0]}" if names[0] in {"", "none"} else " / ".join(names[:2])
