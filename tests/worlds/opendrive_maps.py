"""OpenDRIVE maps in the words of the domain: ``a_map(a_road("1", line(100.0), right=[lane(-1)]))``."""

from __future__ import annotations

import re
from math import cos, sin
from typing import Any


def attributes(**values: Any) -> str:
    return "".join(f' {name}="{value}"' for name, value in values.items())


def element(tag: str, *inner: str, **values: Any) -> str:
    return f"<{tag}{attributes(**values)}>{''.join(inner)}</{tag}>"


def geometry(
    length: float, *inner: str, s: float = 0, x: float = 0, y: float = 0, hdg: float = 0
) -> str:
    return element("geometry", *inner, s=s, x=x, y=y, hdg=hdg, length=length)


def line(length: float, **pose: float) -> str:
    return geometry(length, "<line/>", **pose)


def arc(length: float, curvature: float, **pose: float) -> str:
    return geometry(length, element("arc", curvature=curvature), **pose)


def spiral(length: float, first: float, last: float, **pose: float) -> str:
    return geometry(length, element("spiral", curvStart=first, curvEnd=last), **pose)


def poly3(length: float, a: float, b: float, c: float, d: float, **pose: float) -> str:
    return geometry(length, element("poly3", a=a, b=b, c=c, d=d), **pose)


def param_poly3(
    length: float,
    u: tuple[float, float, float, float],
    v: tuple[float, float, float, float],
    p_range: str = "normalized",
    **pose: float,
) -> str:
    coefficients = dict(zip(("aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV"), u + v, strict=True))
    return geometry(length, element("paramPoly3", pRange=p_range, **coefficients), **pose)


def cubic(tag: str, a: float, b: float = 0, c: float = 0, d: float = 0, **values: Any) -> str:
    return element(tag, **values, a=a, b=b, c=c, d=d)


def width(a: float, b: float = 0, c: float = 0, d: float = 0, s: float = 0) -> str:
    return cubic("width", a, b, c, d, sOffset=s)


def border(a: float, b: float = 0, c: float = 0, d: float = 0, s: float = 0) -> str:
    return cubic("border", a, b, c, d, sOffset=s)


def mark(kind: str, s: float = 0, **values: Any) -> str:
    return element("roadMark", sOffset=s, type=kind, **values)


def lane(
    number: int,
    *records: str,
    kind: str = "driving",
    before: int | None = None,
    after: int | None = None,
    **values: Any,
) -> str:
    """A lane, 3.5 m wide unless records say otherwise; ``before`` and ``after`` are its links."""
    links = "" if before is None else element("predecessor", id=before)
    links += "" if after is None else element("successor", id=after)
    wide = number == 0 or any(r.startswith(("<width", "<border")) for r in records)
    own = records if wide else (width(3.5), *records)
    return element("lane", element("link", links), *own, id=number, type=kind, **values)


def section(*lanes: str, s: float = 0) -> str:
    """A lane section; its lanes are sorted into sides by their ids."""
    sides: dict[str, list[str]] = {"left": [], "center": [], "right": []}
    for text in lanes:
        found = re.match(r'<lane id="(-?\d+)"', text)
        number = int(found[1]) if found else -1
        sides["center" if number == 0 else "left" if number > 0 else "right"].append(text)
    return element("laneSection", *(element(k, *v) for k, v in sides.items() if v), s=s)


def link(tag: str, kind: str, name: str, contact: str = "", **values: Any) -> str:
    point = {"contactPoint": contact} if contact else {}
    return element(tag, elementType=kind, elementId=name, **point, **values)


def a_road(
    name: str,
    *plan: str,
    sections: str = "",
    links: str = "",
    junction: str = "-1",
    length: float | None = None,
    **inner: str,
) -> str:
    """A road; what is not said is one right-hand driving lane. ``inner``: signals, objects, offsets, ..."""
    whole = sum(float(part.split('length="')[1].split('"')[0]) for part in plan)
    lanes = sections or section(lane(0), lane(-1))
    rule = {"rule": inner.pop("rule")} if "rule" in inner else {}
    return element(
        "road",
        element("link", links),
        inner.get("type", ""),
        element("planView", *plan),
        element("elevationProfile", inner.get("elevation", "")),
        element("lanes", inner.get("offset", ""), lanes),
        element("objects", inner.get("objects", "")),
        element("signals", inner.get("signals", "")),
        id=name,
        length=whole if length is None else length,
        junction=junction,
        **rule,
    )


def a_map(*parts: str) -> str:
    return element("OpenDRIVE", element("header", revMajor=1, revMinor=7, name="test"), *parts)


def moved(x: float, y: float, turn: float, dx: float, dy: float) -> dict[str, float]:
    """The pose keywords of a geometry at (x, y), once the map is turned about the origin, then moved."""
    return {
        "x": cos(turn) * x - sin(turn) * y + dx,
        "y": sin(turn) * x + cos(turn) * y + dy,
    }
