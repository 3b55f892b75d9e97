"""Small Lanelet2 maps, written as their editors do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Place = tuple[float, float]


@dataclass
class LaneletMap:
    """A map in the making; ids are counted up."""

    parts: list[str] = field(default_factory=list)
    known: dict[Place, int] = field(default_factory=dict)
    last: int = 0
    degrees: bool = False
    """Whether places are longitudes and latitudes; else they are ``local_x`` and ``local_y``."""

    def way(self, places: Sequence[Place], height: float = 0.0, **tags: str) -> int:
        refs = [self._node(place, height) for place in places]
        return self._add("way", "".join(f"<nd ref='{ref}'/>" for ref in refs), tags)

    def lanelet(
        self, left: int, right: int, subtype: str = "road", *elements: int, **tags: str
    ) -> str:
        members = [("way", left, "left"), ("way", right, "right")]
        members += [("relation", element, "regulatory_element") for element in elements]
        named = {"type": "lanelet", "subtype": subtype, **tags}
        return str(self.relation(members, named))

    def element(self, subtype: str, *members: tuple[str, int, str], **tags: str) -> int:
        return self.relation(members, {"type": "regulatory_element", "subtype": subtype, **tags})

    def relation(self, members: Sequence[tuple[str, int, str]], tags: Mapping[str, str]) -> int:
        inner = "".join(f"<member type='{t}' ref='{r}' role='{o}'/>" for t, r, o in members)
        return self._add("relation", inner, tags)

    def text(self) -> str:
        return f"<?xml version='1.0'?>\n<osm version='0.6'>{''.join(self.parts)}</osm>\n"

    def _node(self, place: Place, height: float) -> int:
        if place not in self.known:
            local = {} if self.degrees else {"local_x": place[0], "local_y": place[1]}
            tags = {key: str(value) for key, value in {**local, "ele": height}.items()}
            where = f" lon='{place[0]}' lat='{place[1]}'" if self.degrees else " lat='' lon=''"
            self.known[place] = self._add("node", "", tags, where)
        return self.known[place]

    def _add(self, kind: str, inner: str, tags: Mapping[str, str], more: str = "") -> int:
        self.last += 1
        told = "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in tags.items())
        self.parts.append(f"<{kind} id='{self.last}'{more}>{inner}{told}</{kind}>")
        return self.last


def two_lanes() -> tuple[LaneletMap, dict[str, str]]:
    """A road of three lanes, 100 m long, one of which comes back; a crosswalk, a light, a lane that follows.

    The line between the first two may be crossed from the left. Ids by their names.
    """
    m = LaneletMap()
    outer = m.way([(0, 7), (50, 7), (100, 7)], type="curbstone", subtype="high")
    middle = m.way([(0, 3.5), (100, 3.5)], type="line_thin", subtype="dashed_solid")
    inner = m.way([(100, 0), (0, 0)], type="line_thin", subtype="solid")  # drawn the other way
    far = m.way([(0, -3.5), (100, -3.5)], type="curbstone", subtype="low")
    onward = [m.way([(100, y), (130, y)], type="curbstone") for y in (7, 3.5)]
    stop = m.way([(99, 3.5), (99, 7)], type="stop_line")
    lamp = m.way([(104, 7), (104.5, 7)], 5.0, type="traffic_light", subtype="red_yellow_green")
    lights = m.element("traffic_light", ("way", lamp, "refers"), ("way", stop, "ref_line"))
    limit = m.way([(1, -4), (1, -4)], 2.0, type="traffic_sign", subtype="de274-60")
    slow = m.element("speed_limit", ("way", limit, "refers"))
    lanes = {
        "left": m.lanelet(outer, middle, "road", lights, one_way="yes"),
        "right": m.lanelet(middle, inner, "road", slow, one_way="yes"),
        "back": m.lanelet(far, inner, "road", one_way="yes", speed_limit="30 mph"),
        "onward": m.lanelet(onward[0], onward[1], "highway", one_way="yes"),
    }
    sides = [m.way([(x, 8), (x, -5)], type="zebra_marking") for x in (104, 101)]
    lanes["crossing"] = m.lanelet(sides[0], sides[1], "crosswalk")
    lanes |= {"light": str(lights), "sign": str(limit), "stop": str(stop)}
    return m, lanes
