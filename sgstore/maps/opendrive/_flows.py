"""Connections between OpenDRIVE lanes: pairs of lanes, with traffic from the first to the second.

A lane ends at one end of its section, or at both if traffic runs both ways. The lanes after it come
from links to the next section or road (also into a road, in its middle), or from the connecting
roads of a junction. A pair counts only if the next lane is entered where its own traffic enters:
maps also link lanes tail to tail. (ASAM OpenDRIVE 1.8, 10.3, 11.5 and 12.)

Incomplete links are completed where lane ends touch:

* a link of one lane counts for both lanes;
* of a link to the far end of a road, the end that touches counts;
* a lane without a link leads to the one lane ahead that touches it.

Each other contradiction is a warning. A junction decides about the ways into it: a connecting road
without a connection is not entered.
"""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.base.markup import number
from sgstore.maps.opendrive._network import (
    END,
    START,
    Target,
    junction_ends,
    road_links,
    whole,
)
from sgstore.maps.opendrive._nodes import junction_of
from sgstore.model.vocabulary import DRIVING, TRAFFIC

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.maps.opendrive._document import Document, ElementTable
    from sgstore.maps.opendrive._lanes import LaneTable
    from sgstore.maps.opendrive._network import Network
    from sgstore.maps.roads import Ribbons
    from sgstore.model.world import Ints

TOUCH: Final = 0.5
"""Largest distance between the centre lines of two lane ends that touch; m."""
FAR: Final = 5.0
"""Distance between the ends of two linked lanes above which the link is a contradiction; m."""
NARROW: Final = 0.3
"""Width below which a lane counts as ended; m."""
OTHER: Final = {START: END, END: START}

_End = tuple[int, str]
"""Place on a lane: its row; ``start`` or ``end`` of its section, or ``+``, ``-`` or empty for within."""
_Named = dict[_End, list[_End]]
"""End of a lane → ends of other lanes to which its links refer."""
_LanePairs = tuple[tuple[int, int], ...]
_Way = tuple[Target, _LanePairs]
"""Path through a junction: its target, and the pairs of lanes that it connects."""


def flows(document: Document, network: Network, ribbons: Ribbons) -> tuple[Ints, Ints]:
    """Return all pairs of connected OpenDRIVE lanes. Traffic goes from the first lane to the second."""
    links = _Links(document, network, ribbons)
    named = links.named()
    pairs = {
        (end[0], other[0])
        for end, others in named.items()
        if links.exits(*end)
        for other in others
        if links.enters(*other)
    }
    pairs |= {pair for pair in links.named_by_next(named) if pair not in pairs}
    pairs |= links.touching(pairs)
    pairs |= set(_branches(document, network))
    both = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    return both[:, 0], both[:, 1]


class _Links:
    """Links from each lane to the next section, the next road, or through a junction."""

    def __init__(self, document: Document, network: Network, ribbons: Ribbons) -> None:
        self._document, self._network = document, network
        self._lane_links = {
            START: _lane_links(document["road/laneSection/lane/predecessor"], network.lanes),
            END: _lane_links(document["road/laneSection/lane/successor"], network.lanes),
        }
        self._road_links = {
            START: road_links(document["road/predecessor"]),
            END: road_links(document["road/successor"]),
        }
        self._names = document.road_ids
        lanes = network.lanes
        self._road, self._section, self._ident, self._forward, self._both = (
            column.tolist()
            for column in (lanes.road, lanes.section, lanes.ident, lanes.forward, lanes.both)
        )
        self._middle, self._width = _ends(network.lanes, ribbons)
        self._said: dict[str, None] = dict.fromkeys(network.warnings)
        self._near: dict[tuple[int, str, Target], Target] = {}
        self._junctions = self._ways()
        self._in_section: dict[int, list[int]] = defaultdict(list)
        for lane, section in enumerate(self._section):
            self._in_section[section].append(lane)
        table = document["junction"]
        kinds = zip(table.texts("id"), table.texts("type"), strict=True)
        self._kinds = dict(kinds)
        self._around: dict[str, list[Target]] = defaultdict(list)
        for road, contact, name in junction_ends(document):
            section = network.first[road] if contact == START else network.last[road]
            self._around[name].append(Target(section, contact))
        self._back: dict[tuple[str, str], list[Target]] = defaultdict(list)
        for contact, links in self._road_links.items():
            for road, link in links.items():
                section = network.first[road] if contact == START else network.last[road]
                key = link.get("elementId", ""), link.get("contactPoint", START)
                self._back[key].append(Target(section, contact))

    def exits(self, lane: int, contact: str) -> bool:
        """Return True if traffic leaves a lane at the given end of its section."""
        return self._both[lane] or self._forward[lane] == (contact == END)

    def enters(self, lane: int, contact: str) -> bool:
        """Return True if traffic can enter a lane at the given end of its section."""
        return self._both[lane] or not contact or self._forward[lane] == (contact in {START, "+"})

    def named(self) -> _Named:
        """Return, for each lane end, the lane ends that its links name. Missing lanes are left out."""
        found: _Named = {}
        for contact, links in self._lane_links.items():
            ends = self._road_links[contact]
            at_junctions = {
                road for road, link in ends.items() if link.get("elementType") == "junction"
            }
            for lane, road in enumerate(self._road):
                if lane in links or road in at_junctions:
                    others = [*self._of(lane, contact)]
                    if others:
                        found[lane, contact] = others
        self._check(found)
        return found

    def _of(self, lane: int, contact: str) -> Iterator[_End]:
        linked = self._lane_links[contact].get(lane, [])
        inner = self._inner(lane, contact)
        targets = (
            self._across(lane, contact, linked) if inner is None else ((inner, to) for to in linked)
        )
        for target, to in targets:
            other = self._network.lane.get((target.section, to))
            if other is not None:
                yield other, target.contact
                continue
            way = "leads to" if self.exits(lane, contact) else "comes from"
            name = self._names[self._road[lane]]
            self._say(f"road {name!r}: lane {self._ident[lane]} {way} a missing lane {to}")

    def _inner(self, lane: int, contact: str) -> Target | None:
        """Return the next section in the same road as a target; ``None`` at the end of the road."""
        section, road = self._section[lane], self._road[lane]
        if contact == END and section < self._network.last[road]:
            return Target(section + 1, START)
        if contact == START and section > self._network.first[road]:
            return Target(section - 1, END)
        return None

    def _across(self, lane: int, contact: str, linked: list[int]) -> Iterator[tuple[Target, int]]:
        """Yield the lanes of other roads to which a lane leads, as lane section and lane id."""
        road = self._road[lane]
        link = self._road_links[contact].get(road, {})
        if link.get("elementType") == "junction":
            key = (link.get("elementId", ""), self._names[road])
            for start, lanes in self._junctions.get(key, ()):
                for source, to in lanes:
                    if source == self._ident[lane]:
                        yield self._touched(lane, contact, start, to), to
            return
        target = self._network.target(link)
        if target is None and linked and not link:
            self._say(f"{self._lane(lane)} is linked at the {contact} of its road, the road is not")
        if target is not None:
            yield from ((self._touched(lane, contact, target, to), to) for to in linked)

    def _touched(self, lane: int, contact: str, target: Target, to: int) -> Target:
        """Return the end of a linked road that a lane touches, even if the link names the wrong end."""
        key = (self._road[lane], contact, target)
        if target.contact not in OTHER:
            return target
        if key not in self._near:
            self._near[key] = target
            if self._gap((lane, contact), target, to) > TOUCH:
                road = int(self._network.lanes.sections.road[target.section])
                ends = {START: self._network.first[road], END: self._network.last[road]}
                at = OTHER[target.contact]
                other = Target(ends[at], at)
                if self._gap((lane, contact), other, to) <= TOUCH:
                    self._near[key] = other
                    self._say(
                        f"road {self._names[key[0]]!r}: linked to the {target.contact} of road"
                        f" {self._names[road]!r}, whose {at} touches it: the {at} counts"
                    )
        return self._near[key]

    def _gap(self, end: _End, target: Target, to: int) -> float:
        other = self._network.lane.get((target.section, to))
        if other is None:
            return math.inf
        return self._apart(end, (other, target.contact))

    def _apart(self, one: _End, other: _End) -> float:
        """Return the distance between the centre lines at two lane ends; m."""
        return math.dist(self._middle[one[1]][one[0]], self._middle[other[1]][other[0]])

    def _check(self, named: _Named) -> None:
        """Warn about linked lanes that are far apart, or that have opposite directions of traffic."""
        rows = [
            (lane, contact == END, other, at == END)
            for (lane, contact), others in named.items()
            for other, at in others
            if at in OTHER
        ]
        lane, contact, other, at = np.array(rows, np.int64).reshape(-1, 4).T
        middle = np.array([self._middle[START], self._middle[END]]).reshape(2, -1, 3)
        gap = np.linalg.norm(middle[contact, lane] - middle[at, other], axis=1)
        lanes = self._network.lanes
        traffic = np.array([kind in TRAFFIC for kind in lanes.type], np.bool_) & ~lanes.both
        out, beyond = lanes.forward[lane] == contact, lanes.forward[other] == at
        head_on = (out == beyond) & traffic[lane] & traffic[other]
        for row in np.flatnonzero((gap > FAR) | head_on).tolist():
            both = " and ".join(map(self._lane, sorted((rows[row][0], rows[row][2]))))
            if gap[row] > FAR:
                self._say(f"{both} are linked, but {gap[row]:.1f} m apart")
            if head_on[row]:
                self._say(f"{both} are linked, but their traffic meets head on")
        for row in np.flatnonzero((gap > TOUCH) & (gap <= FAR)).tolist():
            one, next_one = ((rows[row][i], END if rows[row][i + 1] else START) for i in (0, 2))
            named_back = named.get(next_one, [])
            if named_back and one not in named_back and not self._at_junction(*next_one):
                self._say(
                    f"{self._lane(one[0])} is linked to {self._lane(next_one[0])}, which is linked"
                    f" to {' and '.join(self._lane(back) for back, _ in named_back)} instead:"
                    " the link counts"
                )

    def _at_junction(self, lane: int, contact: str) -> bool:
        """Return True if a lane ends at a junction. The lanes after it are then listed only in the junction."""
        link = self._road_links[contact].get(self._road[lane], {})
        return self._inner(lane, contact) is None and link.get("elementType") == "junction"

    def _lane(self, lane: int) -> str:
        inner = self._section[lane] - self._network.first[self._road[lane]]
        return f"lane {self._names[self._road[lane]]}/{inner}/{self._ident[lane]}"

    def _say(self, warning: str) -> None:
        if warning not in self._said:
            self._said[warning] = None
            self._network.warnings.append(warning)

    def _ways(self) -> dict[tuple[str, str], list[_Way]]:
        """Return the lanes that each junction connects: (junction, incoming road) → list of pairs of lanes."""
        network, document = self._network, self._document
        ways: dict[tuple[str, str], list[_Way]] = defaultdict(list)
        ends: dict[tuple[str, str], list[str]] = defaultdict(list)
        for road, contact, name in junction_ends(document):
            ends[name, self._names[road]].append(contact)
        pairs = _lane_pairs(document)
        junctions, table = document["junction"], document["junction/connection"]
        for row, (parent, attributes) in enumerate(
            zip(table.parent, table.attributes, strict=True)
        ):
            junction = junctions.attributes[parent].get("id", "")
            virtual = junctions.attributes[parent].get("type") == "virtual"
            incoming = attributes.get("incomingRoad", "")
            direct = "linkedRoad" in attributes
            onward = attributes.get("linkedRoad" if direct else "connectingRoad", "")
            target = network.target(
                {"elementId": onward, "contactPoint": attributes.get("contactPoint", START)}
            )
            if incoming not in network.roads and not virtual:
                self._say(
                    f"junction {junction!r}: a connection comes from a missing road {incoming!r}"
                )
            if target is None:
                self._say(f"junction {junction!r} leads to a missing road {onward!r}")
                continue
            ways[junction, incoming].append((target, pairs[row]))
            if incoming not in network.roads:
                continue
            if not virtual and (junction, incoming) not in ends:
                ends[junction, incoming] = self._entrances(junction, incoming, target, pairs[row])
            self._check_sources(junction, incoming, ends[junction, incoming], pairs[row])
            for contact in ends[junction, incoming] if direct else ():
                back = network.target({"elementId": incoming, "contactPoint": contact})
                if back is not None:
                    turned = tuple((to, source) for source, to in pairs[row])
                    ways[junction, onward].append((back, turned))
        return ways

    def _check_sources(
        self, junction: str, incoming: str, ends: list[str], pairs: _LanePairs
    ) -> None:
        """Warn about lanes that a junction connection names, but its incoming road lacks at that end."""
        sections = dict(self._sections(self._network.roads[incoming]))
        for source, _ in pairs:
            if ends and not any((sections[at], source) in self._network.lane for at in ends):
                self._say(
                    f"junction {junction!r}: a connection comes from a missing lane {source}"
                    f" of road {incoming!r}"
                )

    def _entrances(
        self, junction: str, incoming: str, target: Target, pairs: _LanePairs
    ) -> list[str]:
        """Link a road to a junction if a connection of the junction names the road, and their lanes touch."""
        road = self._network.roads[incoming]
        for contact, section in self._sections(road):
            lanes = [(self._network.lane.get((section, source)), to) for source, to in pairs]
            if road not in self._road_links[contact] and any(
                self._gap((lane, contact), target, to) <= TOUCH
                for lane, to in lanes
                if lane is not None
            ):
                link = {"elementType": "junction", "elementId": junction}
                self._road_links[contact][road] = link
                return [contact]
        self._say(
            f"junction {junction!r}: a connection comes from road {incoming!r},"
            " which does not lead to it"
        )
        return []

    def _sections(self, road: int) -> tuple[tuple[str, int], ...]:
        """Return both ends of a road with their lane sections: the end (last) and the start (first)."""
        return (END, self._network.last[road]), (START, self._network.first[road])

    def named_by_next(self, named: _Named) -> Iterator[tuple[int, int]]:
        """Yield pairs of touching lanes if only the second lane has a link to the first."""
        for (after, at), others in named.items():
            for before, end in others:
                if (
                    end not in OTHER
                    or (after, at) in named.get((before, end), ())
                    or not self.exits(before, end)
                    or not self.enters(after, at)
                ):
                    continue
                both = f"{self._lane(before)} to {self._lane(after)}"
                if not self._admits(before, end, after):
                    self._say(
                        f"{both}: linked by the second lane, but not connected by the junction"
                    )
                elif self._apart((before, end), (after, at)) > TOUCH:
                    self._say(f"{both}: linked by the second lane only, and they do not touch")
                else:
                    yield before, after

    def _admits(self, before: int, end: str, after: int) -> bool:
        """Return False if the junction after a lane has connections, but none from this lane to the other."""
        link = self._road_links[end].get(self._road[before], {})
        if self._inner(before, end) is not None or not link:
            return True
        name, onward = self._names[self._road[before]], self._names[self._road[after]]
        if link.get("elementType") != "junction":
            if link.get("elementId") != onward:
                self._say(
                    f"road {name!r} leads to road {link.get('elementId')!r}, but road {onward!r} names it, too"
                )
            return True
        ways = self._junctions.get((link.get("elementId", ""), name), [])
        into = [pairs for target, pairs in ways if target.section == self._section[after]]
        return bool(into) and not any(into)

    def touching(self, pairs: set[tuple[int, int]]) -> set[tuple[int, int]]:
        """Return pairs of lanes without a link: a lane, and the only lane that touches its end."""
        lanes, found = self._network.lanes, set[tuple[int, int]]()
        onward = {lane for lane, _ in pairs}
        for lane in range(len(self._road)):
            if lane in onward or self._both[lane]:
                continue
            contact = END if self._forward[lane] else START
            if self._width[contact][lane] < NARROW:
                continue
            ends = [
                (other, target.contact)
                for target in self._ahead(lane, contact)
                for other in self._in_section.get(target.section, ())
                if self.enters(other, target.contact) and self._same_kind(lane, other)
            ]
            near = {end[0] for end in ends if self._apart((lane, contact), end) <= TOUCH}
            if len(near) == 1:
                found |= {(lane, other) for other in near}
            elif lanes.type[lane] in DRIVING and self._is_lost(lane, contact, onward):
                self._say(f"{self._lane(lane)} leads nowhere: no link names a lane that touches it")
        return found

    def _same_kind(self, lane: int, other: int) -> bool:
        """Return True if both lanes are for the same traffic."""
        kinds = {self._network.lanes.type[lane], self._network.lanes.type[other]}
        return len(kinds) == 1 or DRIVING.issuperset(kinds)

    def _ahead(self, lane: int, contact: str) -> list[Target]:
        """Return the sections in which a lane without a link may continue, with the end that traffic enters.

        They are in its road, at the link of its road, or around the junction of its road.
        """
        inner = self._inner(lane, contact)
        if inner is not None:
            return [inner]
        road = self._road[lane]
        link = self._road_links[contact].get(road, {})
        name = link.get("elementId", "")
        if link.get("elementType") == "junction" and self._kinds.get(name) != "direct":
            ways = self._junctions.get((name, self._names[road]), ())
            return [target for target, pairs in ways if not pairs]
        onward = self._network.roads.get(name)
        if onward is not None:
            return [Target(section, at) for at, section in self._sections(onward)]
        around = self._around.get(name or junction_of(self._document, road), [])
        return around or self._back.get((self._names[road], contact), [])

    def _is_lost(self, lane: int, contact: str, onward: set[int]) -> bool:
        """Return True if a lane leads to a road or junction, but no lane in its direction has a successor."""
        road = self._road[lane]
        if self._inner(lane, contact) is None:
            link = self._road_links[contact].get(road, {})
            name = link.get("elementId", "") or junction_of(self._document, road)
            at_junction = not link or link.get("elementType") == "junction"
            kinds = self._kinds if at_junction else self._network.roads
            if name not in kinds or self._kinds.get(name) == "virtual":
                return False
            if junction_of(self._document, road):
                return True
        return not any(
            other in onward and self._forward[other] == self._forward[lane]
            for other in self._in_section[self._section[lane]]
        )


def _ends(
    lanes: LaneTable, ribbons: Ribbons
) -> tuple[dict[str, list[tuple[float, ...]]], dict[str, list[float]]]:
    """Return the middle and the width of each lane at the start and at the end of its section."""
    first, last = ribbons.offsets[:-1], ribbons.offsets[1:] - 1
    middle: dict[str, list[tuple[float, ...]]] = {}
    width: dict[str, list[float]] = {}
    for contact in (START, END):
        row = np.where(lanes.forward == (contact == START), first, last)
        left = ribbons.left_x[row], ribbons.left_y[row]
        right = ribbons.right_x[row], ribbons.right_y[row]
        x, y = ((a + b) / 2 for a, b in zip(left, right, strict=True))
        middle[contact] = [*zip(x.tolist(), y.tolist(), ribbons.z[row].tolist(), strict=True)]
        width[contact] = np.hypot(left[0] - right[0], left[1] - right[1]).tolist()
    return middle, width


def _lane_links(table: ElementTable, lanes: LaneTable) -> dict[int, list[int]]:
    links: dict[int, list[int]] = defaultdict(list)
    for raw, attributes in zip(table.parent, table.attributes, strict=True):
        links[int(lanes.row[raw])].append(whole(attributes.get("id", "")))
    return links


def _lane_pairs(document: Document) -> dict[int, _LanePairs]:
    pairs: dict[int, _LanePairs] = defaultdict(tuple)
    table = document["junction/connection/laneLink"]
    for row, attributes in zip(table.parent, table.attributes, strict=True):
        pairs[row] += ((whole(attributes.get("from", "")), whole(attributes.get("to", ""))),)
    return pairs


def _branches(document: Document, network: Network) -> Iterator[tuple[int, int]]:
    """Yield pairs of lanes in virtual junctions: a lane of the main road, and a lane that leaves it."""
    links = _lane_pairs(document)
    table = document["junction/connection"]
    junctions = document["junction"].attributes
    for row, (parent, attributes) in enumerate(zip(table.parent, table.attributes, strict=True)):
        if junctions[parent].get("type") != "virtual":
            continue
        main = network.roads.get(attributes.get("incomingRoad", ""))
        onward = network.target(
            {
                "elementId": attributes.get("connectingRoad", ""),
                "contactPoint": attributes.get("contactPoint", START),
            }
        )
        if main is None or onward is None:
            continue
        junction = junctions[parent]
        kind = "road/predecessor" if onward.contact == START else "road/successor"
        road = int(network.lanes.sections.road[onward.section])
        link = road_links(document[kind]).get(road, {})
        place = number(link.get("elementS", junction.get("sStart", "0")), 0.0)
        section = network.section_at(main, place)
        for source, to in links[row]:
            src, dst = network.lane.get((section, source)), network.lane.get((onward.section, to))
            if src is not None and dst is not None and network.enters(dst, onward.contact):
                yield src, dst
