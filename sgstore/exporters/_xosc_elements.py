"""Elements of OpenSCENARIO XML files: entities, conditions, positions."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final
from xml.etree import ElementTree as ET
from xml.sax.saxutils import XMLGenerator
from xml.sax.xmlreader import AttributesImpl

import numpy as np

from sgstore.errors import ExportError
from sgstore.model.vocabulary import VEHICLES

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from numpy.typing import NDArray

    Numbers = NDArray[np.float64]

CATEGORIES: Final = {
    **{kind: kind for kind in ("car", "truck", "van", "bus", "bicycle", "trailer", "train")},
    "motorcycle": "motorbike",
    "vehicle": "car",
    "person": "pedestrian",
    "animal": "animal",
    "prop": "obstacle",
    "building": "building",
    "pole": "pole",
    "barrier": "barrier",
    "vegetation": "vegetation",
    "unknown": "none",
}
"""Kind of entity → category in OpenSCENARIO. Signs and lights are missing, because they belong to the map."""

_PEOPLE: Final = frozenset({"person", "animal"})

REAR_AXLE: Final = 0.3
"""Distance of the rear axle behind the middle of a vehicle, as a share of the length."""

_MASS: Final = {"person": 75.0, "animal": 20.0}


@dataclass(frozen=True, slots=True)
class ScenarioEntity:
    """Entity of an exported scenario: its node, name, type and box.

    Attributes
    ----------
    node : int
    name : str
        Name in the scenario.
    kind : str
    still : bool
        True if it never moves.
    size : tuple of float
        Length, width, height; m.
    properties : dict
        Names from the simulator.
    """

    node: int
    name: str
    kind: str
    still: bool
    size: tuple[float, float, float]
    properties: dict[str, str]

    @property
    def centre(self) -> tuple[float, float, float]:
        """Return the centre of the entity's box in the axes of the entity, in metres."""
        ahead = REAR_AXLE * self.size[0] if self.kind in VEHICLES else 0.0
        return ahead, 0.0, self.size[2] / 2


class XmlWriter:
    """Writer of an XML file, element by element."""

    def __init__(self, stream: Any) -> None:
        self._out = XMLGenerator(stream, "utf-8", short_empty_elements=True)
        self._out.startDocument()
        self._depth = 0

    @contextmanager
    def element(self, tag: str, /, **attributes: str) -> Generator[None]:
        """Context manager that writes the start and the end of an XML element around its content."""
        self._begin(tag, attributes)
        self._out.ignorableWhitespace("\n")
        self._depth += 1
        yield
        self._depth -= 1
        self._out.ignorableWhitespace("  " * self._depth)
        self._out.endElement(tag)
        self._out.ignorableWhitespace("\n")

    def leaf(self, tag: str, /, **attributes: str) -> None:
        """Write an XML element without content."""
        self._begin(tag, attributes)
        self._out.endElement(tag)
        self._out.ignorableWhitespace("\n")

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        self._out.ignorableWhitespace("  " * self._depth)
        told = {name: _readable(text) for name, text in attributes.items()}
        self._out.startElement(tag, AttributesImpl(told))

    def finish(self) -> None:
        """Write the end of the XML document."""
        self._out.endDocument()


def _readable(text: str) -> str:
    """Return a text without characters that XML forbids, and without ``$``, which starts a parameter."""
    return "".join(c if c.isprintable() and c != "$" else "\N{REPLACEMENT CHARACTER}" for c in text)


def _number(value: float) -> str:
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def write_entity(xml: XmlWriter, actor: ScenarioEntity) -> None:
    category, length = CATEGORIES[actor.kind], actor.size[0]
    with xml.element("ScenarioObject", name=actor.name):
        if actor.kind in VEHICLES:
            with xml.element("Vehicle", name=actor.kind, vehicleCategory=category):
                _write_box(xml, actor)
                xml.leaf("Performance", maxSpeed="70", maxAcceleration="10", maxDeceleration="10")
                with xml.element("Axles"):
                    _write_axle(xml, "FrontAxle", actor, 2 * REAR_AXLE * length, "0.6")
                    _write_axle(xml, "RearAxle", actor, 0.0, "0")
                _write_properties(xml, actor)
            return
        mass = _number(_MASS.get(actor.kind, 100.0))
        if actor.kind in _PEOPLE:
            told = {"name": actor.kind, "pedestrianCategory": category, "mass": mass}
            about = xml.element("Pedestrian", **told)
        else:
            told = {"name": actor.kind, "miscObjectCategory": category, "mass": mass}
            about = xml.element("MiscObject", **told)
        with about:
            _write_box(xml, actor)
            _write_properties(xml, actor)


def _write_box(xml: XmlWriter, actor: ScenarioEntity) -> None:
    x, y, z = map(_number, actor.centre)
    length, width, height = map(_number, actor.size)
    with xml.element("BoundingBox"):
        xml.leaf("Center", x=x, y=y, z=z)
        xml.leaf("Dimensions", width=width, length=length, height=height)


def _write_axle(
    xml: XmlWriter, name: str, actor: ScenarioEntity, ahead: float, steering: str
) -> None:
    xml.leaf(
        name,
        maxSteering=steering,
        wheelDiameter="0.6",
        trackWidth=_number(0.9 * actor.size[1]),
        positionX=_number(ahead),
        positionZ="0.3",
    )


def _write_properties(xml: XmlWriter, actor: ScenarioEntity) -> None:
    with xml.element("Properties"):
        for name, value in actor.properties.items():
            xml.leaf("Property", name=f"sgstore.{name}", value=value)


def write_position(xml: XmlWriter, pose: Numbers) -> None:
    names = ("x", "y", "z", "h", "p", "r")
    known = {
        name: _number(value)
        for name, value in zip(names, pose.tolist(), strict=True)
        if np.isfinite(value)
    }
    with xml.element("Position"):
        xml.leaf("WorldPosition", **known)


def write_trajectory(xml: XmlWriter, name: str, times: Numbers, poses: Numbers) -> None:
    with xml.element("RoutingAction"), xml.element("FollowTrajectoryAction"):
        with (
            xml.element("TrajectoryRef"),
            xml.element("Trajectory", name=name, closed="false"),
            xml.element("Shape"),
            xml.element("Polyline"),
        ):
            for time, pose in zip(times.tolist(), poses, strict=True):
                with xml.element("Vertex", time=_number(time)):
                    write_position(xml, pose)
        with xml.element("TimeReference"):
            xml.leaf("Timing", domainAbsoluteRelative="absolute", scale="1", offset="0")
        xml.leaf("TrajectoryFollowingMode", followingMode="position")


def write_speed(xml: XmlWriter, speed: float) -> None:
    with xml.element("LongitudinalAction"), xml.element("SpeedAction"):
        how = {"dynamicsShape": "step", "dynamicsDimension": "time", "value": "0"}
        xml.leaf("SpeedActionDynamics", **how)
        with xml.element("SpeedActionTarget"):
            xml.leaf("AbsoluteTargetSpeed", value=_number(speed))


def write_signal(xml: XmlWriter, ref: str, state: str) -> None:
    with xml.element("InfrastructureAction"), xml.element("TrafficSignalAction"):
        xml.leaf("TrafficSignalStateAction", name=ref, state=state)


def write_when(xml: XmlWriter, time: float, name: str) -> None:
    """Write a scenario condition that becomes true at a simulation time."""
    with (
        xml.element("ConditionGroup"),
        xml.element("Condition", name=name, delay="0", conditionEdge="none"),
        xml.element("ByValueCondition"),
    ):
        xml.leaf("SimulationTimeCondition", value=_number(time), rule="greaterOrEqual")


@contextmanager
def group(xml: XmlWriter, name: str, actor: str = "") -> Generator[None]:
    with xml.element("ManeuverGroup", maximumExecutionCount="1", name=name):
        with xml.element("Actors", selectTriggeringEntities="false"):
            if actor:
                xml.leaf("EntityRef", entityRef=actor)
        yield


@contextmanager
def event(xml: XmlWriter, name: str, time: float) -> Generator[None]:
    with xml.element("Event", name=name, priority="parallel", maximumExecutionCount="1"):
        with xml.element("Action", name=name):
            yield
        with xml.element("StartTrigger"):
            write_when(xml, time, name)


def test(file: Path, vertices: int) -> None:
    """Raise an error if a written scenario file cannot be read or has a wrong number of vertices."""
    found = 0
    try:
        for _, element in ET.iterparse(file):  # noqa: S314  it is ours
            found += element.tag == "Vertex"
            element.clear()
    except ET.ParseError as error:
        raise ExportError(f"{file.name}: the written file cannot be read back: {error}") from error
    if found != vertices:
        raise ExportError(f"{file.name}: {vertices} vertices were written, {found} are read back")
