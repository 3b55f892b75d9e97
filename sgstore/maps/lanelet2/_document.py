"""Parser of OpenStreetMap XML (Lanelet2 maps) into points in metres, ways and relations."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.display import first_of
from sgstore.base.markup import MAX_MAP_ELEMENTS, MarkupParser, number, read_markup
from sgstore.errors import MapError
from sgstore.maps.roads import MAX_POINTS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.maps.lanelet2._projection import Projection
    from sgstore.model.world import Floats

LISTED: Final = 1_000
"""Largest number of elements that a warning lists."""
_FAR: Final = 1e8
"""Largest distance of a point from the origin; m."""
_NODE_TAGS: Final = ("ele", "local_x", "local_y")


@dataclass(slots=True)
class OsmElement:
    """Element of an OpenStreetMap file: node, way or relation, with its tags and members."""

    kind: str
    ident: str
    tags: dict[str, str] = field(default_factory=dict[str, str])
    members: list[tuple[str, str, str]] = field(default_factory=list[tuple[str, str, str]])
    place: tuple[str, str] = ("", "")

    def members_of(self, role: str, kind: str = "way") -> list[str]:
        """Return the ids of the members that have a given role (such as ``left``) in a relation."""
        return [ref for what, ref, own in self.members if own == role and what == kind]


@dataclass(slots=True)
class OsmDocument:
    """Contents of an OpenStreetMap file: ways as lines (n, 3) of points in metres, and relations."""

    lines: dict[str, Floats]
    nodes: dict[str, list[str]]
    tags: dict[str, dict[str, str]]
    relations: dict[str, OsmElement]
    warnings: list[str]


def read_osm(text: str, projection: Projection) -> OsmDocument:
    """Parse an OpenStreetMap text into ways (lines of points in metres) and relations.

    Raises
    ------
    MapError
        The text is not XML, not OpenStreetMap data, or exceeds a limit.
    """
    builder = _OsmBuilder()
    read_markup(MarkupParser(builder.start, most=MAX_MAP_ELEMENTS), text)
    ways = [one for one in builder.elements if one.kind == "way"]
    points = sum(len(way.members) for way in ways)
    if points > MAX_POINTS:
        raise MapError(f"lines of {points:,} points; a map may have {MAX_POINTS:,}", element="way")
    used = {ref for way in ways for _, ref, _ in way.members}
    nodes = [one for one in builder.elements if one.kind == "node" and one.ident in used]
    warnings: list[str] = []
    places = _places(nodes, projection, warnings)
    row = {node.ident: at for at, node in enumerate(nodes)}
    # Nodes in one place are one node: lanelets meet there.
    first = dict[tuple[float, ...], str]()
    spots = map(tuple, np.round(places, 2).tolist())
    same = {
        node.ident: first.setdefault(spot, node.ident)
        for node, spot in zip(nodes, spots, strict=True)
    }
    document = OsmDocument({}, {}, {}, {}, warnings)
    broken: list[str] = []
    for way in ways:
        refs = [ref for _, ref, _ in way.members]
        rows = [row[ref] for ref in refs if ref in row]
        line = places[rows]
        if len(rows) < len(refs) or not (np.abs(line) < _FAR).all():
            broken.append(way.ident)
            continue
        document.lines[way.ident] = line
        document.nodes[way.ident] = [same[ref] for ref in refs]
        document.tags[way.ident] = way.tags
    if broken:
        warnings.append(
            f"ways {first_of(broken, LISTED)}: a node of theirs is missing, or no place; left out"
        )
    document.relations = {one.ident: one for one in builder.elements if one.kind == "relation"}
    warnings += _contradictions(builder.elements, document)
    return document


def _contradictions(elements: list[OsmElement], document: OsmDocument) -> Iterator[str]:
    """Yield ids that occur twice, and missing members of lanelets and rules."""
    for (kind, ident), count in Counter((one.kind, one.ident) for one in elements).items():
        if count > 1:
            yield f"{kind} {ident}: there are {count} of this id; the last one counts"
    ways = {one.ident for one in elements if one.kind == "way"}
    for ident, relation in document.relations.items():
        if relation.tags.get("type") in {"lanelet", "regulatory_element"}:
            for kind, ref, role in relation.members:
                known = {"way": ways, "relation": document.relations}.get(kind, {ref})
                if ref not in known:
                    yield f"relation {ident}: its {kind} {ref} ({role}) is missing"


def _places(nodes: list[OsmElement], projection: Projection, warnings: list[str]) -> Floats:
    """Return the positions (n, 3) of OpenStreetMap nodes: ``local_x`` and ``local_y``, or projected degrees."""
    if not nodes:
        return np.zeros((0, 3))
    height, x, y = (
        np.array([number(node.tags.get(tag, "")) for node in nodes]) for tag in _NODE_TAGS
    )
    height = np.nan_to_num(height)
    local = np.isfinite(x) & np.isfinite(y)
    degrees = np.array([list(map(number, node.place)) for node in nodes])
    known = (np.abs(degrees) <= (90.0, 180.0)).all(axis=1)
    if (local | ~known).all() or projection.name == "Local":
        return np.column_stack((x, y, height))
    if local.any():
        few = f"{int((~local).sum())} of {len(local)} points have no local_x and local_y"
        warnings.append(f"{few}: all are placed by latitude and longitude")
    places = np.full((len(nodes), 3), np.nan)
    if known.any():
        latitude, longitude = degrees[known].T
        with np.errstate(all="ignore"):
            places[known] = projection.project(latitude, longitude, height[known])
    return places


class _OsmBuilder:
    """Handler of XML parser events that builds an OpenStreetMap document, without deleted elements."""

    def __init__(self) -> None:
        self.elements: list[OsmElement] = []
        self._open: OsmElement | None = None

    def start(self, tag: str, attributes: dict[str, Any], depth: int) -> None:
        """Handle the start tag of an XML element."""
        if depth == 1 and tag != "osm":
            raise MapError(f"the root element is <{tag[:80]}>, expected <osm>")
        if depth == 2:
            self._open = None
            wanted = tag in {"node", "way", "relation"} and attributes.get("action") != "delete"
            if wanted and "id" in attributes:
                place = attributes.get("lat", ""), attributes.get("lon", "")
                self._open = OsmElement(tag, attributes["id"], place=place)
                self.elements.append(self._open)
        elif depth == 3 and self._open is not None:
            if tag == "tag":
                self._open.tags[attributes.get("k", "")] = attributes.get("v", "")
            elif tag == "nd":
                self._open.members.append(("node", attributes.get("ref", ""), ""))
            elif tag == "member":
                member = (attributes.get(key, "") for key in ("type", "ref", "role"))
                kind, ref, role = member
                self._open.members.append((kind, ref, role))
