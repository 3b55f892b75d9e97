"""Parser of CommonRoad scenarios (XML, 2018b and 2020a) into obstacles, lights, signs and lanelets.

Each part of the document (an obstacle, a lanelet, …) becomes a small tree, which is read and freed at the end
of the part. :mod:`sgstore.base.markup` limits the untrusted features of XML. Texts, parts and states are
limited, too. An invalid part is dropped and reported as a loss. Of an obstacle with invalid states, the valid
ones are used.

Source: CommonRoad: XML format documentation, versions 2018b and 2020a (Technical University of Munich).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from sgstore.base.markup import MarkupError, MarkupParser, number
from sgstore.errors import TraceError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

ROOT: Final = "commonRoad"
MAX_BYTES: Final = 256 << 20
"""Maximum size of a file; bytes."""
MAX_ELEMENTS: Final = 20_000_000
MAX_PART: Final = 4_000_000
"""Maximum number of elements in one part of a document, such as an obstacle or a lanelet."""
MAX_STATES: Final = 2_000_000
"""Maximum number of states of all obstacles together."""
MAX_TEXT: Final = 1000
"""Maximum number of characters in an element. A number has about 20."""
MAX_NAME: Final = 100
MAX_STEP: Final = 10_000_000
MAX_LOST: Final = 1000
"""Maximum number of losses that are listed. Further losses are only counted."""
_FAR: Final = 1e8
"""Maximum distance of a point from the origin; m."""

VERSIONS: Final = ("2018b", "2020a")

Place = tuple[float, float, float]


class State(NamedTuple):
    """State of a CommonRoad obstacle at a time step: position, heading, speed, …; NaN if unknown.

    The units are m, rad, m/s, m/s² and rad/s.
    """

    x: float
    y: float
    z: float
    heading: float
    along: float
    across: float
    acceleration: float
    yaw_rate: float


class ObstacleBox(NamedTuple):
    """Bounding box of an obstacle shape, in the obstacle's axes: size, centre and rotation."""

    length: float
    width: float
    ahead: float = 0.0
    left: float = 0.0
    turn: float = 0.0


@dataclass(slots=True)
class Obstacle:
    """Obstacle (vehicle, pedestrian, …) of a CommonRoad scenario. It has a state for each time step."""

    ident: str
    type: str
    static: bool
    body: ObstacleBox
    states: dict[int, State]
    lights: dict[int, tuple[str, ...]] = field(default_factory=dict[int, tuple[str, ...]])


@dataclass(frozen=True, slots=True)
class ScenarioLight:
    """Traffic light of a CommonRoad scenario. Its cycle is a list of (number of steps, state)."""

    ident: str
    place: Place | None
    cycle: tuple[tuple[int, str], ...]
    offset: int = 0
    active: bool = True

    def shows(self, step: int) -> str:
        """Return the traffic light state at a time step; empty if it is unknown."""
        if not self.active:
            return "inactive"
        total = sum(steps for steps, _ in self.cycle)
        if not total:
            return ""
        into = (step - self.offset) % total
        for steps, state in self.cycle:
            into -= steps
            if into < 0:
                return state
        raise AssertionError


@dataclass(frozen=True, slots=True)
class ScenarioSign:
    """Traffic sign of a CommonRoad scenario. Each of its plates is a pair (code, value)."""

    ident: str
    place: Place | None
    plates: tuple[tuple[str, float], ...]
    virtual: bool = False


@dataclass(frozen=True, slots=True)
class Lanelet:
    """Lanelet (lane segment) of a CommonRoad map, with its borders (x, y, z) in driving direction."""

    ident: str
    left: tuple[Place, ...]
    right: tuple[Place, ...]
    markings: tuple[str, str]
    before: tuple[str, ...]
    after: tuple[str, ...]
    beside: tuple[str, str]
    types: tuple[str, ...]
    one_way: tuple[str, ...]
    both_ways: tuple[str, ...]
    signs: tuple[str, ...]
    lights: tuple[str, ...]
    speed_limit: float = math.nan
    stop_line: tuple[Place, ...] | None = None
    """Points of the stop line. Empty means at the end of the lanelet; ``None`` means no stop line."""
    directions: tuple[str, str] = ("", "")
    """``same`` or ``opposite`` direction of the left and of the right neighbour. Empty means unknown."""


@dataclass(slots=True)
class TrafficScenario:
    """Contents of a CommonRoad scenario: obstacles, traffic lights, signs and lanelets.

    Attributes
    ----------
    name : str
        The id of the benchmark.
    step : float
        Time between steps; s.
    obstacles, lights, signs, lanelets : dict
        By their ids.
    junction_of : dict
        Id of a lanelet → id of its intersection.
    incoming : list
        Ids of intersections, each with the id of a lanelet that leads into it.
    lost : list of str
        Dropped parts with the reasons.
    more_lost : int
        Number of further losses.
    """

    name: str = ""
    step: float = math.nan
    obstacles: dict[str, Obstacle] = field(default_factory=dict[str, Obstacle])
    lights: dict[str, ScenarioLight] = field(default_factory=dict[str, ScenarioLight])
    signs: dict[str, ScenarioSign] = field(default_factory=dict[str, ScenarioSign])
    lanelets: dict[str, Lanelet] = field(default_factory=dict[str, Lanelet])
    junction_of: dict[str, str] = field(default_factory=dict[str, str])
    incoming: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    lost: list[str] = field(default_factory=list[str])
    more_lost: int = 0
    states: int = 0

    def lose(self, what: str) -> None:
        """Record that a part of the scenario is unreadable, for the report."""
        if len(self.lost) < MAX_LOST:
            self.lost.append(what)
        else:
            self.more_lost += 1


def read_scenario(data: bytes) -> TrafficScenario:
    """Parse a CommonRoad XML document into a scenario.

    Raises
    ------
    TraceError
        The document is not XML, not a CommonRoad scenario of a supported version, or exceeds a limit.
    """
    reader = _Reader()
    parser = MarkupParser(
        reader.start, reader.end, text=reader.characters, most=MAX_ELEMENTS, whose="scenarios"
    )
    try:
        parser.feed(data, last=True)
    except MarkupError as error:
        where = f" (<{error.element}>)" if error.element else ""
        raise TraceError(f"{error}{where}") from error
    return reader.scenario


class _Node:
    """XML element with its tag, attributes, text and children."""

    __slots__ = ("attributes", "children", "tag", "text")

    def __init__(self, tag: str, attributes: dict[str, str]) -> None:
        self.tag = tag
        self.attributes = attributes
        self.text = ""
        self.children: list[_Node] = []

    def all(self, tag: str) -> list[_Node]:
        return [child for child in self.children if child.tag == tag]

    def get(self, *path: str) -> _Node | None:
        """Return the first XML element at a path of tags; ``None`` if it does not exist."""
        found: _Node | None = self
        for tag in path:
            found = next((child for child in found.children if child.tag == tag), None)
            if found is None:
                return None
        return found

    def word(self, *path: str) -> str:
        """Return the text at a path of XML tags; empty if it is missing."""
        found = self.get(*path)
        return found.text.strip() if found else ""

    def words(self, tag: str) -> tuple[str, ...]:
        return tuple(child.text.strip() for child in self.all(tag))

    def refs(self, tag: str) -> tuple[str, ...]:
        """Return the ids in the attribute ``ref`` of child elements with a tag."""
        return tuple(_ident(child, "ref") for child in self.all(tag))


class _Reader:
    """Handler of XML parser events that builds a CommonRoad scenario."""

    def __init__(self) -> None:
        self.scenario = TrafficScenario()
        self._open: list[_Node] = []
        self._part = 0

    def start(self, tag: str, attributes: dict[str, str], _depth: int) -> None:
        """Handle the start tag of an XML element."""
        self._part += 1
        if self._part > MAX_PART:
            raise TraceError(f"<{self._open[1].tag}> has more than {MAX_PART:,} elements")
        node = _Node(tag, attributes)
        if not self._open:
            _begin(self.scenario, node)
        elif len(self._open) > 1:
            self._open[-1].children.append(node)
        else:
            self._part = 1
        self._open.append(node)

    def end(self) -> None:
        """Handle the end tag of an XML element."""
        node = self._open.pop()
        if len(self._open) == 1:
            _take(self.scenario, node)

    def characters(self, text: str) -> None:
        """Add text to the current XML element."""
        node = self._open[-1]
        if text.strip():
            node.text += text
            if len(node.text) > MAX_TEXT:
                raise TraceError(f"<{node.tag}> has a text of more than {MAX_TEXT} characters")


def _begin(scenario: TrafficScenario, root: _Node) -> None:
    if root.tag != ROOT:
        raise TraceError(f"<{root.tag[:40]}> is not a CommonRoad scenario; expected <{ROOT}>")
    version = root.attributes.get("commonRoadVersion", "")
    if version not in VERSIONS:
        known = " and ".join(VERSIONS)
        raise TraceError(f"CommonRoad version {version[:40]!r}; versions {known} are read")
    name = root.attributes.get("benchmarkID", "")
    scenario.name = name[:MAX_NAME] if name.isprintable() else ""
    scenario.step = number(root.attributes.get("timeStepSize", ""))
    if not 1e-6 <= scenario.step <= 100:
        told = root.attributes.get("timeStepSize", "")[:40]
        raise TraceError(f"timeStepSize {told!r}: expected the seconds between two steps")


def _take(scenario: TrafficScenario, node: _Node) -> None:
    """Read one obstacle, light, sign or lanelet of a scenario. Report an invalid one as lost."""
    if node.tag not in _PARTS:
        return
    try:
        _PARTS[node.tag](scenario, node)
    except ValueError as error:
        scenario.lose(f"{node.tag} {node.attributes.get('id', '')[:MAX_NAME]}: {error}")


def _ident(node: _Node, name: str = "id") -> str:
    ident = node.attributes.get(name, "").strip()
    if not 0 < len(ident) <= MAX_NAME or not ident.isprintable():
        raise ValueError(f"<{node.tag}> has no {name}")
    return ident


def _float(text: str, what: str) -> float:
    value = number(text)
    if not abs(value) < _FAR:
        raise ValueError(f"{what} {text[:40]!r} is not a number")
    return value


def _whole(text: str, what: str) -> int:
    value = _float(text, what)
    if value != int(value) or abs(value) > MAX_STEP:
        raise ValueError(f"{what} {text[:40]!r} is not a number of steps")
    return int(value)


def _value(node: _Node | None) -> float:
    """Return the number in an XML element, or the middle of an interval. NaN if it is missing."""
    if node is None:
        return math.nan
    if node.get("exact"):
        return _float(node.word("exact"), node.tag)
    ends = [_float(node.word(end), node.tag) for end in ("intervalStart", "intervalEnd")]
    return sum(ends) / 2


def _time(node: _Node) -> int:
    found = node.get("time")
    if found is None or found.get("exact") is None:
        raise ValueError("a state has no exact time")
    step = _whole(found.word("exact"), "time")
    if step < 0:
        raise ValueError(f"time {step} is before the beginning")
    return step


def _point(node: _Node) -> Place:
    z = node.word("z")
    x, y = (_float(node.word(axis), axis) for axis in "xy")
    return x, y, _float(z, "z") if z else 0.0


def _position(node: _Node | None) -> Place | None:
    """Return the position in an XML element, or the centre of its area; ``None`` if it has neither."""
    if node is None or not node.children:
        return None
    point = node.get("point")
    if point is not None:
        return _point(point)
    _, (x, y) = _around(list(_corners(node)))
    return x, y, 0.0


def _corners(shapes: _Node) -> Iterator[tuple[float, float]]:
    """Yield points around all shapes in an XML element. The box around the points contains the shapes."""
    for shape in shapes.children:
        if shape.tag == "polygon":
            yield from (_point(point)[:2] for point in shape.all("point"))
            continue
        if shape.tag not in {"rectangle", "circle"}:
            raise ValueError(f"an unknown shape, {shape.tag[:40]}")
        middle = shape.get("center")
        x, y, _ = _point(middle) if middle else (0.0, 0.0, 0.0)
        if shape.tag == "circle":
            radius = _size(shape, "radius")
            yield from ((x + i * radius, y + j * radius) for i in (-1, 1) for j in (-1, 1))
            continue
        turn = shape.word("orientation")
        angle = _float(turn, "orientation") if turn else 0.0
        half = _size(shape, "length") / 2, _size(shape, "width") / 2
        for i, j in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            u, v = i * half[0], j * half[1]
            yield (
                x + u * math.cos(angle) - v * math.sin(angle),
                y + u * math.sin(angle) + v * math.cos(angle),
            )


def _size(shape: _Node, name: str) -> float:
    size = _float(shape.word(name), name)
    if not 0 < size < 1e4:
        raise ValueError(f"{name} {size} m of a shape")
    return size


def _around(
    corners: list[tuple[float, float]],
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the size and centre of the axis-aligned box around points."""
    if not corners:
        raise ValueError("a shape without points")
    low, high = ((end(x for x, _ in corners), end(y for _, y in corners)) for end in (min, max))
    size = high[0] - low[0], high[1] - low[1]
    return size, ((high[0] + low[0]) / 2, (high[1] + low[1]) / 2)


def _body(node: _Node | None) -> ObstacleBox:
    if node is None or not node.children:
        return ObstacleBox(math.nan, math.nan)
    if len(node.children) == 1 and node.children[0].tag == "rectangle":
        shape = node.children[0]
        middle, turn = shape.get("center"), shape.word("orientation")
        ahead, left, _ = _point(middle) if middle else (0.0, 0.0, 0.0)
        angle = _float(turn, "orientation") if turn else 0.0
        return ObstacleBox(_size(shape, "length"), _size(shape, "width"), ahead, left, angle)
    (length, width), (ahead, left) = _around(list(_corners(node)))
    return ObstacleBox(length, width, ahead, left)


_LIGHTS: Final = {
    "indicatorLeft": ("light_left",),
    "indicatorRight": ("light_right",),
    "hazardWarningLights": ("light_left", "light_right"),
    "brakingLights": ("light_brake",),
    "flashingBlueLights": ("light_special1",),
}
"""Name of a ``signalState`` element → light of a vehicle. The horn is ignored."""


def _state(node: _Node) -> State | None:
    """Read the state of an obstacle from XML; ``None`` if it has no position."""
    place = _position(node.get("position"))
    if place is None:
        return None
    along, across = _value(node.get("velocity")), _value(node.get("velocityY"))
    slip = _value(node.get("slipAngle"))
    if not math.isnan(along) and math.isnan(across):
        # A single speed is along the slip angle, which is 0 by default.
        slip = 0.0 if math.isnan(slip) else slip
        along, across = along * math.cos(slip), along * math.sin(slip)
    return State(
        *place,
        _value(node.get("orientation")),
        along,
        across,
        _value(node.get("acceleration")),
        _value(node.get("yawRate")),
    )


def _obstacle(scenario: TrafficScenario, node: _Node) -> None:
    ident, role = _ident(node), node.word("role")
    if ident in scenario.obstacles:
        raise ValueError("there are two of this id; the first one counts")
    static = node.tag == "staticObstacle" or role == "static"
    first = node.get("initialState")
    if first is None:
        raise ValueError("no initial state")
    start = 0 if static and first.get("time") is None else _time(first)
    state = _state(first)
    if state is None:
        raise ValueError("its initial state has no place")
    found = Obstacle(ident, node.word("type")[:MAX_NAME], static, _body(node.get("shape")), {})
    found.states[start] = state
    if not static:
        _follow(scenario, node, found)
        _signal(node, found)
    scenario.states += len(found.states)
    if scenario.states > MAX_STATES:
        raise TraceError(f"more than {MAX_STATES:,} states of obstacles")
    scenario.obstacles[ident] = found


def _follow(scenario: TrafficScenario, node: _Node, found: Obstacle) -> None:
    """Add the states of a trajectory to an obstacle. Report invalid states as lost."""
    trajectory = node.get("trajectory")
    if node.get("occupancySet") is not None:
        told = "it has a set of places where it may be, and no trajectory: its first state counts"
        scenario.lose(f"{node.tag} {found.ident}: {told}")
    for state in trajectory.all("state") if trajectory else ():
        try:
            read, step = _state(state), _time(state)
            if read is None:
                raise ValueError(f"its state at step {step} has no place")
            if step in found.states and str(found.states[step]) != str(read):
                raise ValueError(f"there are two states at step {step}; the first one counts")
        except ValueError as error:
            scenario.lose(f"{node.tag} {found.ident}: {error}")
            continue
        found.states.setdefault(step, read)


def _signal(node: _Node, found: Obstacle) -> None:
    series = node.get("signalSeries")
    first = node.get("initialSignalState")
    for told in (*([first] if first else ()), *(series.all("signalState") if series else ())):
        on = {
            light
            for word, lights in _LIGHTS.items()
            if told.word(word) == "true"
            for light in lights
        }
        found.lights.setdefault(_time(told), tuple(sorted(on)))


def _surroundings(scenario: TrafficScenario, node: _Node) -> None:
    """Add an obstacle of the environment (such as a building). It has only a shape, in map axes."""
    ident = _ident(node)
    if ident in scenario.obstacles:
        raise ValueError("there are two of this id; the first one counts")
    body = _body(node.get("shape"))
    state = State(body.ahead, body.left, 0.0, body.turn, 0.0, 0.0, 0.0, 0.0)
    kind = node.word("type")[:MAX_NAME]
    scenario.obstacles[ident] = Obstacle(
        ident, kind, static=True, body=ObstacleBox(body.length, body.width), states={0: state}
    )


def _lanelet(scenario: TrafficScenario, node: _Node) -> None:
    ident = _ident(node)
    if ident in scenario.lanelets:
        raise ValueError("there are two of this id; the first one counts")
    sides = [node.get(side) for side in ("leftBound", "rightBound")]
    left, right = (tuple(map(_point, side.all("point"))) if side else () for side in sides)
    if len(left) < 2 or len(right) < 2:
        raise ValueError("its borders need at least two points each")
    limit = node.word("speedLimit")
    stop_line = node.get("stopLine")
    beside = [node.refs(tag) for tag in ("adjacentLeft", "adjacentRight")]
    scenario.lanelets[ident] = Lanelet(
        ident,
        left,
        right,
        (
            sides[0].word("lineMarking") if sides[0] else "",
            sides[1].word("lineMarking") if sides[1] else "",
        ),
        node.refs("predecessor"),
        node.refs("successor"),
        (beside[0][0] if beside[0] else "", beside[1][0] if beside[1] else ""),
        node.words("laneletType"),
        node.words("userOneWay"),
        node.words("userBidirectional"),
        node.refs("trafficSignRef"),
        node.refs("trafficLightRef"),
        _float(limit, "speedLimit") if limit else math.nan,
        None if stop_line is None else tuple(_point(point) for point in stop_line.all("point")),
        (_direction(node, "adjacentLeft"), _direction(node, "adjacentRight")),
    )


def _direction(node: _Node, tag: str) -> str:
    found = node.get(tag)
    return "" if found is None else found.attributes.get("drivingDir", "")


def _light(scenario: TrafficScenario, node: _Node) -> None:
    cycle = node.get("cycle")
    elements = cycle.all("cycleElement") if cycle else []
    told = tuple((_whole(e.word("duration"), "duration"), e.word("color")) for e in elements)
    if any(steps < 1 for steps, _ in told):
        raise ValueError("a state of it lasts less than a step")
    offset = cycle.word("timeOffset") if cycle else ""
    scenario.lights.setdefault(
        _ident(node),
        ScenarioLight(
            _ident(node),
            _position(node.get("position")),
            told,
            _whole(offset, "timeOffset") if offset else 0,
            node.word("active") != "false",
        ),
    )


def _sign(scenario: TrafficScenario, node: _Node) -> None:
    plates: list[tuple[str, float]] = []
    for element in node.all("trafficSignElement"):
        value = number(element.word("additionalValue"))
        plates.append((element.word("trafficSignID")[:MAX_NAME], value))
    place = _position(node.get("position"))
    virtual = node.word("virtual") == "true"
    sign = ScenarioSign(_ident(node), place, tuple(plates), virtual)
    scenario.signs.setdefault(sign.ident, sign)


def _intersection(scenario: TrafficScenario, node: _Node) -> None:
    ident = _ident(node)
    for incoming in node.all("incoming"):
        scenario.incoming += [(ident, lanelet) for lanelet in incoming.refs("incomingLanelet")]
        for way in ("successorsLeft", "successorsStraight", "successorsRight"):
            for lanelet in incoming.refs(way):
                scenario.junction_of.setdefault(lanelet, ident)


_PARTS: Final[dict[str, Callable[[TrafficScenario, _Node], Any]]] = {
    "obstacle": _obstacle,
    "dynamicObstacle": _obstacle,
    "staticObstacle": _obstacle,
    "environmentObstacle": _surroundings,
    "lanelet": _lanelet,
    "trafficLight": _light,
    "trafficSign": _sign,
    "intersection": _intersection,
}
"""Tags of the parts that are read → function for the part. Planning problems are ignored."""
