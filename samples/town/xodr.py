"""A town of :mod:`road_model` as OpenDRIVE 1.6 text."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from road_model import Lane, Mark, Road, Section, Thing

DASH, GAP = 3.0, 6.0
"""A broken line in a town (German RMS: 3 m of paint, 6 m without)."""


@dataclass(frozen=True)
class Junction:
    """A junction: its connecting roads, and which of the incoming roads give way to which."""

    id: str
    name: str
    roads: tuple[Road, ...]
    priorities: tuple[tuple[str, str], ...] = ()
    controllers: tuple[str, ...] = ()


@dataclass(frozen=True)
class Controller:
    """Signals that change together."""

    id: str
    name: str
    signals: tuple[str, ...]


def number(value: float) -> str:
    """A number to the nanometre, without needless digits."""
    text = f"{value:.9f}".rstrip("0").rstrip(".")
    return "0" if text in {"-0", ""} else text


def add(parent: ET.Element, tag: str, **attributes: str | float) -> ET.Element:
    """Append an element; floats become text."""
    texts = {k: number(v) if isinstance(v, float) else v for k, v in attributes.items()}
    return ET.SubElement(parent, tag, texts)


def add_marks(parent: ET.Element, marks: tuple[Mark, ...]) -> None:
    """Road marks of a lane."""
    for mark in marks:
        if mark.kind in {"none", "curb"}:
            add(
                parent, "roadMark", sOffset=mark.s, type=mark.kind, weight="standard",
                color="standard", width=mark.width if mark.kind == "curb" else 0.0, laneChange="none",
            )  # fmt: skip
            continue
        element = add(
            parent, "roadMark", sOffset=mark.s, type=mark.kind, weight="standard", color="white",
            width=mark.width, laneChange=mark.change,
        )  # fmt: skip
        broken = mark.kind == "broken"
        kind = add(element, "type", name=mark.kind, width=mark.width)
        for offset in (mark.width, -mark.width) if mark.kind == "solid solid" else (0.0,):
            add(
                kind, "line", length=DASH if broken else 0.0, space=GAP if broken else 0.0,
                tOffset=offset, sOffset=0.0, width=mark.width,
            )  # fmt: skip


def add_lane(parent: ET.Element, road: Road, where: int, lane_number: int, lane: Lane) -> None:
    """One lane of the ``where``-th section with its links, width, marks and height."""
    element = add(parent, "lane", id=str(lane_number), type=lane.kind, level="false")
    before, after = links_of(road, where, lane_number)
    if before is not None or after is not None:
        link = add(element, "link")
        if before is not None:
            add(link, "predecessor", id=str(before))
        if after is not None:
            add(link, "successor", id=str(after))
    _, start, stop = road.spans()[where]
    slope = (lane.width_at(1) - lane.width) / (stop - start)
    add(element, "width", sOffset=0.0, a=lane.width, b=slope, c=0.0, d=0.0)
    add_marks(element, lane.marks)
    if lane.kind == "driving":
        add(element, "speed", sOffset=0.0, max=str(road.limit), unit="km/h")
    if lane.kind == "sidewalk":
        add(element, "height", sOffset=0.0, inner=0.12, outer=0.12)


def links_of(road: Road, where: int, lane_number: int) -> tuple[int | None, int | None]:
    """Numbers of the lanes before and after, in the neighbouring sections or roads."""
    before, after = road.links.get(lane_number, (None, None))
    return (
        lane_number if where > 0 else before,
        lane_number if where < len(road.sections) - 1 else after,
    )


def add_section(parent: ET.Element, road: Road, where: int) -> None:
    """A lane section: left lanes from the outermost in, centre, right lanes from the middle out."""
    section: Section = road.sections[where]
    element = add(parent, "laneSection", s=section.s)
    if section.left:
        left = add(element, "left")
        for n in range(len(section.left), 0, -1):
            add_lane(left, road, where, n, section.lane(n))
    center = add(add(element, "center"), "lane", id="0", type="none", level="false")
    add_marks(center, section.center)
    if section.right:
        right = add(element, "right")
        for n in range(-1, -len(section.right) - 1, -1):
            add_lane(right, road, where, n, section.lane(n))


def add_object(parent: ET.Element, thing: Thing) -> None:
    """An object with its outline, in its own axes or in those of the road."""
    element = add(parent, "object", s=thing.s, t=thing.t, **thing.attributes)
    if thing.outline:
        outlines = add(element, "outlines")
        outline = add(outlines, "outline", id="0", outer="true", closed="true", fillType="asphalt")
        for i, (u, v) in enumerate(thing.outline):
            if thing.by_road:
                add(outline, "cornerRoad", id=str(i), s=u, t=v, dz=0.0, height=0.0)
            else:
                add(outline, "cornerLocal", id=str(i), u=u, v=v, z=0.0, height=0.0)
    for lane in thing.lanes:
        add(element, "validity", fromLane=str(lane), toLane=str(lane))


def add_link(parent: ET.Element, tag: str, link: tuple[str, ...]) -> None:
    """A road's predecessor or successor."""
    if link:
        contact = {"contactPoint": link[2]} if link[0] == "road" else {}
        add(parent, tag, elementType=link[0], elementId=link[1], **contact)


def add_plan(parent: ET.Element, road: Road) -> None:
    """The reference line."""
    plan = add(parent, "planView")
    for piece, (s, x, y, heading) in zip(road.pieces, road.starts(), strict=False):
        geometry = add(plan, "geometry", s=s, x=x, y=y, hdg=heading, length=piece.length)
        if piece.start == piece.end == 0:
            add(geometry, "line")
        elif piece.start == piece.end:
            add(geometry, "arc", curvature=piece.start)
        else:
            add(geometry, "spiral", curvStart=piece.start, curvEnd=piece.end)


def add_road(parent: ET.Element, road: Road) -> None:
    """A road."""
    element = add(
        parent, "road", name=road.name, length=road.length, id=road.id, junction=road.junction,
        rule="RHT",
    )  # fmt: skip
    if road.before or road.after:
        link = add(element, "link")
        add_link(link, "predecessor", road.before)
        add_link(link, "successor", road.after)
    kind = add(element, "type", s=0.0, type="town", country="DE")
    add(kind, "speed", max=str(road.limit), unit="km/h")
    add_plan(element, road)
    add(add(element, "elevationProfile"), "elevation", s=0.0, a=0.0, b=0.0, c=0.0, d=0.0)
    add(element, "lateralProfile")
    lanes = add(element, "lanes")
    for where in range(len(road.sections)):
        add_section(lanes, road, where)
    if road.objects:
        objects = add(element, "objects")
        for thing in road.objects:
            add_object(objects, thing)
    if road.signals:
        signals = add(element, "signals")
        for thing in road.signals:
            signal = add(signals, "signal", s=thing.s, t=thing.t, **thing.attributes)
            for lane in thing.lanes:
                add(signal, "validity", fromLane=str(lane), toLane=str(lane))


def add_junction(parent: ET.Element, junction: Junction) -> None:
    """A junction with one connection for each of its connecting roads."""
    element = add(parent, "junction", id=junction.id, name=junction.name, type="default")
    for i, road in enumerate(junction.roads):
        connection = add(
            element, "connection", id=str(i), incomingRoad=road.before[1], connectingRoad=road.id,
            contactPoint="start",
        )  # fmt: skip
        for lane, (before, _) in road.links.items():
            if before is not None:
                add(connection, "laneLink", **{"from": str(before), "to": str(lane)})
    for high, low in junction.priorities:
        add(element, "priority", high=high, low=low)
    for controller in junction.controllers:
        add(element, "controller", id=controller, type="0")


def text(
    name: str,
    date: str,
    roads: list[Road],
    junctions: tuple[Junction, ...],
    controllers: tuple[Controller, ...],
) -> str:
    """The whole map."""
    root = ET.Element("OpenDRIVE")
    header = add(root, "header", revMajor="1", revMinor="6", name=name, version="1.00", date=date)
    edges = np.vstack([
        border for road in roads for section in road.sections for n in section.numbers
        for border in road.lane_strip(section, n)
    ])  # fmt: skip
    (west, south), (east, north) = edges.min(0).tolist(), edges.max(0).tolist()
    for side, value in (("north", north), ("south", south), ("east", east), ("west", west)):
        header.set(side, number(round(value, 3)))
    header.set("vendor", "sgstore")
    for road in roads:
        add_road(root, road)
    for controller in controllers:
        element = add(root, "controller", id=controller.id, name=controller.name)
        for signal in controller.signals:
            add(element, "control", signalId=signal, type="0")
    for junction in junctions:
        add_junction(root, junction)
    ET.indent(root, " ")
    body = ET.tostring(root, encoding="unicode", xml_declaration=False)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{body}\n'
