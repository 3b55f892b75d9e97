"""What the preset ``carlasgg`` gives, beside what CARLASGG itself computed for the same traffic.

::

    python -m bench.against_carlasgg TRACE ORACLE [--map FILE.xodr]

TRACE is a recording of CARLA's ROS bridge, ORACLE a folder with ``junction_rsv.jsonl.gz``: one line a frame,
with the nodes and edges of CARLASGG's junction abstraction. Entities are told by their actor ids, lanes by road
and lane number, as CARLASGG names them: it does not know sections. Traffic lights are told by their actor ids
as well.

The exit status is 1 where a row falls below its mark, or a difference has no cause. Every difference is looked
into, and counted under its cause:

* *tie*: the number that decides is at its threshold, up to the float32 that CARLA computes with;
* *overhang*: CARLASGG takes a lane for boxes, 2 m long, around points every metre: they stick out beyond the
  ends of the lane, and beside it in a bend, so an entity is in a lane that it does not touch;
* *range cut*: it drops the points outside the rectangle with their boxes, so that an entity at the edge is in
  no lane there, and a lane of which the rectangle holds a strip but no point is absent;
* *gap*: towards the end of a lane its points stop up to 2 m short, and where lanes begin in one place only one
  of them keeps its first point;
* *fork*: for the same reason, of the lanes that begin in one place, the one that keeps the point seems to lead
  to the others, and what comes before seems to lead to that one alone;
* *heads*: a light is in range when one of its heads is, and a recording tells where its pole stands;
* *unknown id*: one side names an entity, a lane or a signal that the other has never heard of;
* *unexplained*: none of these. There should be none of either.

What of CARLASGG's is a defect, and not imitated, is counted below.
"""

from __future__ import annotations

import argparse
import gzip
import sys
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import shapely

from bench.carlasgg_frames import CONFIG, Edge, Ours, View, theirs
from sgstore.model.vocabulary import DIRECTIONS, PROXIMITY

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


BEARINGS = (0.0, 45.0, 90.0, 135.0, 180.0)
SPACING, HALF_BOX = 1.0, 1.0
"""CARLASGG's distance of points along a lane, and half the length of the box around each; m."""
REACH_OF_HEADS = 8.0
"""How far over the road the arm of a traffic light may carry its heads; m."""
TOGETHER = 0.01
"""How far apart lanes begin that begin in one place; m."""
MARKS = {
    "frames with equal entities": 1.0,
    "kinds of entities": 1.0,
    "distance relations of the ego": 0.999,
    "front and rear of the ego": 0.999,
    "left and right of the ego": 0.99,
    "entities with equal lanes": 0.94,
    "entities on or off the road": 0.99,
    "lanes in range": 0.97,
    "opposes, lanes in both": 1.0,
    "left and right of lanes, lanes in both": 1.0,
    "travelsTo, lanes in both": 0.7,
    "traffic lights in range": 0.99,
    "what lights in both show": 1.0,
    "lanes that these control": 0.77,
    "mayAffect, signals and lanes in both": 0.83,
    "kinds of these signals": 1.0,
}
"""Rows, and the least share of each that is equal."""
UNEXPLAINED, UNKNOWN = "unexplained", "unknown id"
FLOAT32 = 2e-4
"""How exact positions are some hundred metres from the origin, rotated and subtracted as float32; m."""


@dataclass
class Row:
    """A line of the comparison.

    Attributes
    ----------
    name : str
    equal, of : int
        How many of how many are equal.
    causes : Counter
        What the others are.
    """

    name: str
    equal: int = 0
    of: int = 0
    causes: Counter[str] = field(default_factory=Counter)

    @property
    def share(self) -> float:
        return self.equal / self.of if self.of else 1.0

    @property
    def fails(self) -> bool:
        """Whether it is below its mark, or something is different for no known cause."""
        without = self.of - self.equal - sum(self.causes.values())
        return (
            self.share < MARKS[self.name]
            or bool(without)
            or bool(self.causes[UNEXPLAINED] + self.causes[UNKNOWN])
        )

    def add(self, ours: set[Any], theirs: set[Any]) -> Iterator[tuple[Any, bool]]:
        """Count what two sets have in common; give what only one has, and whether that is ours."""
        self.equal += len(ours & theirs)
        self.of += len(ours | theirs)
        yield from ((one, True) for one in sorted(ours - theirs))
        yield from ((one, False) for one in sorted(theirs - ours))

    def __str__(self) -> str:
        causes = ", ".join(f"{n} {cause}" for cause, n in self.causes.most_common() if n)
        mark = "BELOW" if self.fails else "     "
        share = f"{self.equal:>7,} of {self.of:>7,} {100 * self.share:8.2f} %"
        return f"{self.name:44} {share} {mark} {causes}"


class Points(NamedTuple):
    """Points along a lane, CARLASGG's boxes around them, and whether it surely has points there."""

    places: Any
    boxes: Any
    sure: Any


class Comparison:
    """CARLASGG's graphs of a recording beside ours.

    Attributes
    ----------
    rows : list of Row
    defects : Counter
        What CARLASGG gets wrong, and how often.
    """

    def __init__(self, trace: Path, oracle: Path, road_map: Path | None = None) -> None:
        self._ours = Ours(trace, road_map)
        self.road_map = self._ours.road_map
        self.rows = [Row(name) for name in MARKS]
        self.defects: Counter[str] = Counter()
        with gzip.open(oracle / "junction_rsv.jsonl.gz", "rt", encoding="utf-8") as lines:
            for ours, line in zip(self._ours.views(), lines, strict=True):
                peer = theirs(line)
                self._compare(ours, peer)
                self._compare_lights(ours, peer)
                self._count_defects(ours, peer)

    def row(self, beginning: str) -> Row:
        return next(row for row in self.rows if row.name.startswith(beginning))

    def _compare(self, ours: View, peer: View) -> None:
        entities, kinds, near, front, side, lanes, off_road, present, opposes, beside, flow = (
            self.rows[:11]
        )
        entities.of += 1
        entities.equal += ours.entities == peer.entities
        if ours.entities != peer.entities:
            entities.causes[UNKNOWN] += 1
        self._compare_kinds(kinds, ours, peer, ours.entities & peer.entities - {peer.ego})
        for row, relations, causes in (
            (near, PROXIMITY, self._at_distance),
            (front, DIRECTIONS, self._at_bearing),
            (side, ("toLeftOf", "toRightOf"), self._at_axis),
        ):
            both = (view.among(*relations, entities=True) for view in (ours, peer))
            for edge, _ in row.add(*both):
                row.causes[causes(ours, edge)] += 1
        for entity in sorted(ours.entities & peer.entities):
            self._compare_lanes(lanes, ours, peer, entity)
            mine, other = ((entity, "isIn", "Off Road") in view.edges for view in (ours, peer))
            off_road.of += 1
            off_road.equal += mine == other
            if mine != other:
                inside = ours.lanes_in(entity) or peer.lanes_in(entity)
                off_road.causes["as its lanes" if inside else UNEXPLAINED] += 1
        for lane, mine in present.add(ours.lanes, peer.lanes):
            present.causes[self._at_edge(ours, lane, mine=mine)] += 1
        common = ours.lanes & peer.lanes
        for row, relations in (
            (opposes, ("opposes",)),
            (beside, ("toLeftOf", "toRightOf")),
            (flow, ("travelsTo",)),
        ):
            both = (
                {e for e in view.among(*relations, entities=False) if {e[0], e[2]} <= common}
                for view in (ours, peer)
            )
            for edge, mine in row.add(*both):
                row.causes[self._why_lanes(ours, peer, edge, mine=mine)] += 1

    def _compare_lights(self, ours: View, peer: View) -> None:
        lights, shown, control, affect, kinds = self.rows[11:]
        for light, mine in lights.add(ours.lights, peer.lights):
            lights.causes[self._why_light(ours, peer, light, mine=mine)] += 1
        for light in sorted(ours.lights & peer.lights):
            shown.of += 1
            shown.equal += ours.shows[light] == peer.shows[light]
            shown.causes[UNEXPLAINED] += ours.shows[light] != peer.shows[light]
        both = (
            {e for e in v.edges if e[1] == "controlsTrafficOf" and e[0] in v.lights}
            for v in (ours, peer)
        )
        for edge, mine in control.add(*both):
            control.causes[self._why_controlled(ours, peer, edge, mine=mine)] += 1

        common = (ours.lanes & peer.lanes) | (ours.signals & peer.signals)
        both = (
            {e for e in v.edges if e[1] == "mayAffect" and {e[0], e[2]} <= common}
            for v in (ours, peer)
        )
        for edge, mine in affect.add(*both):
            affect.causes[self._why_affected(peer, edge, mine=mine)] += 1
        signals = {signal for signal in peer.signals if self._ours.knows(signal)}
        kinds.of += len(peer.signals - signals)
        kinds.causes[UNKNOWN] += len(peer.signals - signals)
        mine = View(kind={signal: self._ours.kind_of(signal) for signal in signals})
        self._compare_kinds(kinds, mine, peer, signals)

    def _compare_kinds(self, row: Row, ours: View, peer: View, names: set[str]) -> None:
        for name in sorted(names):
            equal = ours.kind.get(name) == peer.kind.get(name)
            row.of += 1
            row.equal += equal
            row.causes[UNEXPLAINED] += not equal

    def _why_light(self, ours: View, peer: View, light: str, *, mine: bool) -> str:
        if not self._ours.knows(light):
            return UNKNOWN
        pole = shapely.Point((ours if mine else peer).place[light])
        near = self._rectangle(ours).exterior.distance(pole) <= REACH_OF_HEADS
        return "heads" if near else UNEXPLAINED

    def _why_controlled(self, view: View, peer: View, edge: Edge, *, mine: bool) -> str:
        """Where a light controls lanes that begin in one place, only one of them keeps its first point."""
        if not (self._ours.knows(edge[0]) and edge[2] in self._points):
            return UNKNOWN
        sections = self._ours.controlled(edge[0]).get(edge[2], [])
        if not mine or not sections:
            return UNEXPLAINED
        starts = shapely.points([self._starts[edge[2]][row] for row in sections])
        if not shapely.intersects(self._rectangle(view, -SPACING), starts).any():
            return "range cut"
        return "fork" if self._is_fork(peer, edge, sections) else UNEXPLAINED

    def _why_affected(self, peer: View, edge: Edge, *, mine: bool) -> str:
        """A signal at the very start of a lane is ahead of no point of it, if another lane keeps the first."""
        if not (self._ours.knows(edge[0]) and edge[2] in self._points):
            return UNKNOWN
        sections = self._ours.controlled(edge[0]).get(edge[2], [])
        twins = sorted(peer.lanes - {edge[2]})  # who keeps the point may be affected by nothing
        fork = any(self._start_together(edge[2], lane, sections) for lane in twins)
        return "fork" if mine and edge[0] in peer.signals and fork else UNEXPLAINED

    def _count_defects(self, ours: View, peer: View) -> None:
        found = self.defects
        for name, view in (("CARLASGG", peer), ("sgstore", ours)):
            changes = sum(relation == "laneChange" for _, relation, _ in view.edges)
            found[f"lane changes, {name}"] += changes
        lights = {s for s in peer.signals if self._ours.kind_of(s) == "traffic_light"}
        found["traffic lights that are there a second time, as landmarks"] += len(lights)
        nowhere = {s for s, r, d in peer.edges if d == "Off Road" and s not in peer.entities}
        found["lights and signs that are 'Off Road' for lack of an edge"] += len(nowhere)

    def _compare_lanes(self, row: Row, ours: View, peer: View, entity: str) -> None:
        mine, other = ours.lanes_in(entity), peer.lanes_in(entity)
        row.of += 1
        row.equal += mine == other
        if mine != other:
            causes = {self._at_edge(ours, lane, mine=True, entity=entity) for lane in mine - other}
            causes |= {
                self._at_edge(ours, lane, mine=False, entity=entity) for lane in other - mine
            }
            row.causes[UNEXPLAINED if UNEXPLAINED in causes else " and ".join(sorted(causes))] += 1

    # Causes ---------------------------------------------------------------------------------

    def _pair(self, view: View, edge: Edge) -> tuple[float, float, float]:
        """Of the source, seen from the destination: distance of origins, bearing (°), distance off the axis."""
        (bx, by, bz, *_, bh), (ax, ay, az, heading, *_, ah) = view.box[edge[0]], view.box[edge[2]]
        people = {
            name
            for name in (edge[0], edge[2])
            if view.box[name][4] < 1.0 and view.box[name][5] < 1.0
        }
        bz -= 0 if edge[0] in people else bh / 2
        az -= 0 if edge[2] in people else ah / 2
        distance = float(np.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + (bz - az) ** 2))
        bearing = np.degrees(np.arctan2(by - ay, bx - ax) - heading)
        bearing = float((bearing + 180) % 360 - 180)
        return distance, bearing, float(np.hypot(bx - ax, by - ay) * np.sin(np.radians(bearing)))

    def _at_distance(self, view: View, edge: Edge) -> str:
        if not {edge[0], edge[2]} <= view.box.keys():
            return UNKNOWN
        distance = self._pair(view, edge)[0]
        tie = min(abs(distance - bound) for bound in CONFIG.proximity.upper) < FLOAT32
        return "tie" if tie else UNEXPLAINED

    def _at_bearing(self, view: View, edge: Edge) -> str:
        if not {edge[0], edge[2]} <= view.box.keys():
            return UNKNOWN
        distance, bearing, _ = self._pair(view, edge)
        off = min(abs(abs(bearing) - bound) for bound in BEARINGS)
        tie = (
            np.radians(off) * distance < FLOAT32
            or abs(distance - CONFIG.pairs.ego_within) < FLOAT32
        )
        return "tie" if tie else UNEXPLAINED

    def _at_axis(self, view: View, edge: Edge) -> str:
        if not {edge[0], edge[2]} <= view.box.keys():
            return UNKNOWN
        distance, _, off_axis = self._pair(view, edge)
        if abs(distance - CONFIG.pairs.ego_within) < FLOAT32:
            return "tie"
        return "dead ahead or behind" if abs(off_axis) < 1e-3 + FLOAT32 else UNEXPLAINED

    @cached_property
    def _points(self) -> dict[str, Points]:
        """Points of each lane and CARLASGG's boxes around them, close to one another."""
        points, lengths = self.road_map.waypoints(SPACING / 4), self.road_map.ribbons.lengths
        ahead = np.stack([np.cos(points.heading), np.sin(points.heading)], axis=1)
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) * (points.width / 2)[:, None]
        centre = np.stack([points.x, points.y], axis=1)
        ahead *= HALF_BOX
        corners = [centre + a * ahead + b * left for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        boxes, places = shapely.polygons(np.stack(corners, axis=1)), shapely.points(centre)
        sure = points.along >= SPACING
        sure &= points.along <= lengths[points.lane] - 2 * SPACING
        rows: dict[str, list[int]] = {}
        nodes = self.road_map.nodes
        for row, lane in enumerate(points.lane.tolist()):
            rows.setdefault(f"{nodes.road[1 + lane]}_{nodes.lane[1 + lane]}", []).append(row)
        return {name: Points(places[of], boxes[of], sure[of]) for name, of in rows.items()}

    @cached_property
    def _starts(self) -> dict[str, dict[int, tuple[float, float]]]:
        """Where each section of a lane begins in its direction, by the section's row."""
        ribbons, nodes = self.road_map.ribbons, self.road_map.nodes
        rows = np.arange(len(ribbons.lengths))
        at = ribbons.at(rows, np.zeros(len(rows)))
        found: dict[str, dict[int, tuple[float, float]]] = {}
        for row in rows.tolist():
            name = f"{nodes.road[1 + row]}_{nodes.lane[1 + row]}"
            found.setdefault(name, {})[row] = float(at.x[row]), float(at.y[row])
        return found

    def _rectangle(self, view: View, margin: float = 0.0) -> Any:
        x, y, _, heading, *_ = view.box[view.ego]
        of = CONFIG.range
        at = shapely.box(-of.rear - margin, -of.side - margin, of.front + margin, of.side + margin)
        turned = shapely.affinity.rotate(at, heading, (0, 0), use_radians=True)
        return shapely.affinity.translate(turned, x, y)

    def _at_edge(self, view: View, lane: str, *, mine: bool, entity: str = "") -> str:
        """Why only one side has a lane: in range, or under an entity.

        Points every quarter of a metre are all that CARLASGG can have; those every metre are some of them. So
        what only CARLASGG has is explained by any, and what only we have by the lack of points over a metre.
        """
        if lane not in self._points:
            return UNKNOWN
        places, boxes, sure = self._points[lane]
        under = np.ones(len(places), np.bool_)
        if entity:
            under = shapely.intersects(boxes, self._footprint(view, entity))
        if not mine:
            reached = shapely.intersects(self._rectangle(view, FLOAT32), places[under]).any()
            return "overhang" if reached else UNEXPLAINED
        inside = shapely.intersects(self._rectangle(view), places[under])
        if (inside & sure[under]).sum() > SPACING / (SPACING / 4):
            return UNEXPLAINED
        return "gap" if inside.all() else "range cut"

    def _footprint(self, view: View, entity: str) -> Any:
        x, y, _, heading, length, width, _ = view.box[entity]
        shape = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
        shape = shapely.affinity.rotate(shape, heading, (0, 0), use_radians=True)
        return shapely.affinity.translate(shape, x, y)

    def _why_lanes(self, view: View, peer: View, edge: Edge, *, mine: bool) -> str:
        if edge[1] != "travelsTo":
            return UNEXPLAINED
        if not {edge[0], edge[2]} <= self._points.keys():
            return UNKNOWN
        if mine:
            end = self._points[edge[0]].places[-1]
            if not shapely.intersects(self._rectangle(view, -2 * SPACING), end):
                return "range cut"
            entered = self._ours.entered(edge[0], edge[2])
            return "fork" if self._is_fork(peer, edge, entered) else UNEXPLAINED
        every = list(self._starts[edge[0]])
        return "fork" if self._start_together(edge[0], edge[2], every) else UNEXPLAINED

    def _is_fork(self, peer: View, edge: Edge, sections: list[int]) -> bool:
        """Whether CARLASGG has the edge to another lane instead, which begins where these sections do."""
        others = {e[2] for e in peer.edges if e[:2] == edge[:2]} - {edge[2]}
        return any(self._start_together(edge[2], lane, sections) for lane in sorted(others))

    def _start_together(self, one: str, other: str, sections: list[int]) -> bool:
        """Whether some sections of a lane begin where a section of another lane does."""
        starts = np.array([self._starts[one][row] for row in sections]).reshape(-1, 1, 2)
        there = np.array(list(self._starts.get(other, {}).values())).reshape(1, -1, 2)
        return bool((np.hypot(*(starts - there).transpose(2, 0, 1)) < TOGETHER).any())


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="The preset carlasgg beside CARLASGG itself.")
    parser.add_argument("trace", type=Path)
    parser.add_argument("oracle", type=Path)
    parser.add_argument("--map", type=Path, default=None)
    given = parser.parse_args(arguments)
    comparison = Comparison(given.trace, given.oracle, given.map)
    for row in comparison.rows:
        print(row)
    print("\nDefects of CARLASGG, counted and not imitated")
    for name, count in comparison.defects.items():
        print(f"{name:60} {count:>7,}")
    failing = [row.name for row in comparison.rows if row.fails]
    if failing:
        print(f"\nbelow the mark: {', '.join(failing)}", file=sys.stderr)
    return 1 if failing else 0


if __name__ == "__main__":
    sys.exit(main())
