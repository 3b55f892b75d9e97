"""Scenes of which less is known, and random checks of them.

A scene is what was recorded, its road map and the settings. Less of it is known with a smaller range, without
the map, without some relations, and without some values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from scenes import crossroads, street

from sgstore.graphs.online import Frame
from sgstore.model.config import Config, RangeSettings
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    import random
    from collections.abc import Callable, Sequence

    from sgstore.maps.roads import RoadMap
    from sgstore.temporal import Verdict

Car = dict[str, Any]
PERIOD: Final = 0.1
WIDE: Final = Config(range=RangeSettings(radius=1000, world=0))
"""Settings with which all of a scene is in its graphs."""


@dataclass(frozen=True)
class Known:
    """What is known of a scene."""

    frames: Sequence[Sequence[Car]]
    road: RoadMap | None = None
    config: Config = WIDE

    def until(self, end: int) -> Known:
        """The same, cut after so many frames."""
        return replace(self, frames=self.frames[:end])

    def judged(self, rules: Sequence[str]) -> dict[str, Verdict]:
        """The verdict of each rule."""
        text = ";".join(
            f"{before}CHECK c{n}: {rule}" for n, (before, rule) in enumerate(map(_split, rules))
        )
        monitor = Monitor(text, self.road, self.config, period_s=PERIOD, trace="drive")
        for number, cars in enumerate(self.frames):
            monitor.step(frame_of(number, cars))
        return {rules[int(one.check[1:])]: one for one in monitor.finish()}


def _split(rule: str) -> tuple[str, str]:
    """The settings of a rule, and the rest of it."""
    before, _, after = rule.rpartition("CHECK ")
    return before, after


def car(ident: str, x: float, y: float = 0.0, **more: Any) -> Car:
    sized = {"heading": 0.0, "length": 4.0, "width": 2.0, "height": 1.5, "vx": 10.0, "vy": 0.0}
    return {"ident": ident, "x": x, "y": y, "z": 0.75, **sized, **more}


def frame_of(number: int, cars: Sequence[Car]) -> Frame:
    frame = Frame(time_ns=number * 100_000_000, ego="ego")
    for one in cars:
        own = dict(one)
        kind = own.pop("kind", "car")
        frame.add(own.pop("ident"), kind, own.pop("x"), own.pop("y"), own.pop("z"), **own)
    return frame


# Scenes -------------------------------------------------------------------------------------------------

ROADS: Final[dict[str, Callable[[], RoadMap]]] = {
    "street": lambda: street("driving", "driving", left=("driving",), zebra=30.0, limit=13.9),
    "crossroads": lambda: crossroads("stop"),
}
_roads: dict[str, RoadMap] = {}


def road(name: str) -> RoadMap:
    """A road map, read once."""
    if name not in _roads:
        _roads[name] = ROADS[name]()
    return _roads[name]


def random_scene(rng: random.Random) -> Known:
    """The ego and up to four others, near and far, who come and go, mostly on a road map."""
    frames, far = rng.randint(3, 7), rng.random() < 0.6
    where = rng.choice(("street", "street", "crossroads", ""))
    start = 0.0 if where == "street" else rng.uniform(-60, -10)
    lane = 1.75 if where == "crossroads" else -1.75
    lane = -1.75 if where == "street" else lane if where else 0.0
    others = [_other(f"v{n}", rng, far=far, lane=lane) for n in range(rng.randint(1, 4))]
    away = {(n, rng.choice(others)["ident"]) for n in range(frames) if rng.random() < 0.2}
    scene: list[list[Car]] = []
    for n in range(frames):
        here = [car("ego", start + n * 0.9, lane, vx=9.0)]
        for one in others:
            if (n, one["ident"]) in away:
                continue
            at = {"x": start + one["x"] + 0.1 * n * one["vx"], "y": one["y"] + 0.1 * n * one["vy"]}
            speed = one["vx"] + (rng.uniform(-1, 1) if one["vx"] else 0.0)
            here.append(one | at | {"vx": speed})
        scene.append(here)
    return Known(scene, road(where) if where else None)


def _other(ident: str, rng: random.Random, *, far: bool, lane: float) -> Car:
    x = rng.uniform(-90, 140) if far and rng.random() < 0.6 else rng.uniform(-15, 25)
    y = lane + rng.choice((0.0, 0.0, -3.5, 3.5)) + rng.uniform(-1, 1)
    way = rng.choice((1, 1, 1, -1))
    speed = rng.choice((0.0, rng.uniform(4, 14), rng.uniform(4, 14), rng.uniform(15, 45)))
    kind = rng.choice(("car", "car", "car", "truck", "person"))
    size = {"length": 0.6, "width": 0.6} if kind == "person" else {"length": rng.uniform(3, 6)}
    turned = 180.0 if way < 0 else rng.choice((0.0, rng.uniform(-20, 20)))
    sideways = rng.choice((0.0, 0.0, rng.uniform(-2, 2)))
    return car(ident, x, y, kind=kind, vx=way * speed, vy=sideways, heading=turned, **size)


# Less knowledge -----------------------------------------------------------------------------------------

MEASURED: Final = ("length", "width", "height", "vx", "heading")


def less_measured(known: Known, rng: random.Random) -> Known:
    """Without sizes, speeds and headings of some cars."""

    def less(one: Car) -> Car:
        names = [name for name in MEASURED if rng.random() < 0.25]
        names += ["vy"] if "vx" in names else []
        return one | dict.fromkeys(names, float("nan"))

    share = rng.choice((0.1, 0.3, 0.6))
    frames = [[less(one) if rng.random() < share else one for one in cars] for cars in known.frames]
    return replace(known, frames=frames)


def less_world(known: Known, rng: random.Random) -> Known:
    """With smaller graphs, and a smaller world around them."""
    radius = rng.choice((10.0, 20.0, 50.0))
    world = rng.choice((0.0, radius, 30.0, 60.0, 100.0, 1000.0))
    return replace(
        known, config=replace(known.config, range=RangeSettings(radius=radius, world=world))
    )


def no_map(known: Known, rng: random.Random) -> Known:
    """Without the road map."""
    return replace(known, road=None)


def fewer_relations(known: Known, rng: random.Random) -> Known:
    """Without some relations."""
    config = known.config
    ways: list[Config] = [
        replace(config, sees=False),
        replace(config, proximity=replace(config.proximity, names=(), upper=())),
        replace(config, direction=replace(config.direction, names=(), upper=())),
        replace(config, lanes=replace(config.lanes, ahead=0.0)),
        replace(config, lanes=replace(config.lanes, granularity="none")),
        replace(
            config, without=tuple(rng.sample(("overlaps", "leads", "follows", "isIn", "near"), 2))
        ),
    ]
    return replace(known, config=rng.choice(ways))


LESS: Final = {
    "measured": less_measured,
    "world": less_world,
    "map": no_map,
    "relations": fewer_relations,
}


def reduced(known: Known, rng: random.Random) -> tuple[Known, list[str]]:
    """The same scene, of which less is known, and what was taken away."""
    names = rng.sample([*LESS], rng.choice((1, 1, 2, 3)))
    for name in names:
        known = LESS[name](known, rng)
    return known, names


# Checks -------------------------------------------------------------------------------------------------

OF_TWO: Final = (
    *("gap({a}, {b}) < {near}", "dist({a}, {b}) < {near}", "clearance({a}, {b}) > {near}"),
    *("ttc({a}, {b}) < {time}", "headway({a}, {b}) < {time}", "wttc({a}, {b}) < {time}"),
    *("closing_time({a}, {b}) < {time}", "rss_margin({a}, {b}) < 0", "drac({a}, {b}) > {brake}"),
    *("a_long_req({a}, {b}) < -{brake}", "btn({a}, {b}) > 0.3", "lon_gap({a}, {b}) < {near}"),
    *("lat_gap({a}, {b}) < 1", "lane_dist({a}, {b}) < {near}", "abs(lane_dist({a}, {b})) < {near}"),
    *(
        "gap({a}, {b}) < {time} * {a}.speed",
        "lon({a}, {b}) > {near}",
        "closing_speed({a}, {b}) > 5",
    ),
    *("dist({a}, {b}) > {near}", "rss_lon({a}, {b}) > lon_gap({a}, {b})", "{a}.speed < {b}.speed"),
    *("same_lane({a}, {b})", "next_lane({a}, {b})", "lead({a}, {b})", "ahead({a}, {b})"),
    *("lead({a}, {b}) AND gap({a}, {b}) < {near}", "same_lane({a}, {b}) AND {b}.speed < {speed}"),
    *("EXISTS {{({a})-[:near]->({b})}}", "EXISTS {{({a})-[:near|very_near|visible]->({b})}}"),
    *("EXISTS {{({a})-[:sees]->({b})}}", "EXISTS {{({a})-[:inDFrontOf|inSFrontOf]->({b})}}"),
    *("EXISTS {{({a})-[:leads]->({b})}}", "EXISTS {{({a})-[:overlaps]-({b})}}"),
    *("EXISTS {{({a})-[:isIn]->(:Lane)<-[:isIn]-({b})}}", "EXISTS {{({a})-[:toLeftOf]->({b})}}"),
)
OF_ONE: Final = (
    *("{a}.speed > {speed}", "{a}.speed <= {speed}", "{a}.length > 4", "abs({a}.heading) < 10"),
    *("exists_now({a})", "off_road({a})", "in_junction({a})", "right_most({a})", "moving({a})"),
    *("to_junction({a}) < {near}", "to_crosswalk({a}) < {near}", "{a}.width * {a}.length > 9"),
    *("EXISTS {{({a})-[:isIn]->(:Lane)}}", "EXISTS {{({a})-[:isIn]->(l:Lane) WHERE l.width > 3}}"),
    *(
        "abs(delta({a}.speed, 0.2s)) < 1",
        "prev({a}.speed) > {speed}",
        "{a}.y > -3",
        "age({a}) > 0.3",
    ),
    *("max_over({a}.speed, 3frames) > {speed}", "min_over({a}.length, 0.2s) > 4"),
)
OF_MANY: Final = (
    *("EXISTS {{(w:{kind}) WHERE {inner}}}", "COUNT {{(w:{kind}) WHERE {inner}}} < {count}"),
    *("COUNT {{(w:{kind}) WHERE {inner}}} > {count}", "MIN {{(w:{kind}) | gap({a}, w)}} < {near}"),
    *("MAX {{(w:{kind}) | w.speed}} > {speed}", "COUNT {{(w:{kind})}} = {count}"),
    *(
        "EXISTS {{({a})-[:near]->(w:{kind}) WHERE w.speed < {speed}}}",
        "COUNT {{(w:{kind})}} < {count}",
    ),
    *("AVG {{(w:{kind}) | w.speed}} > {speed}", "SUM {{(w:{kind}) WHERE {inner} | w.length}} < 6"),
    *(
        "EXISTS {{({a})-[:sees]->(w:{kind})}}",
        "COUNT {{({a})-[:near|visible]-(w:{kind})}} > {count}",
    ),
    "EXISTS {{(w:{kind}) WHERE {inner} AND NOT EXISTS {{({a})-[:sees]->(w)}}}}",
    "EXISTS {{(w:{kind})-[:isIn]->(:Lane)<-[:isIn]-({a}) WHERE {inner}}}",
    "EXISTS {{({a})-[:isIn]->(l:Lane) WHERE NOT EXISTS {{(w:{kind})-[:isIn]->(l)}}}}",
)
OVER_TIME: Final = (
    *("ALWAYS{bound} ({0})", "EVENTUALLY{bound} ({0})", "NEXT ({0})", "({0}) UNTIL{bound} ({1})"),
    *(
        "ONCE{bound} ({0})",
        "PREVIOUS ({0})",
        "HISTORICALLY{bound} ({0})",
        "({0}) SINCE{bound} ({1})",
    ),
    *("run_length({now}) >= {count}frames", "run_length({now}) < {count}frames"),
)
LOGIC: Final = (
    *("NOT ({0})", "({0}) AND ({1})", "({0}) OR ({1})", "({0}) IMPLIES ({1})", "({0}) XOR ({1})"),
)
BOUNDS: Final = ("", "", "[0s, 0.3s]", "[0.2s, 0.5s]", "[0frames, 2frames]")
KINDS: Final = ("Car", "Vehicle", "Person", "Entity")


class Checks:
    """Random checks of a scene.

    Parameters
    ----------
    rng : random.Random
    scene : Known
    ended : bool
        Whether what they wait for at the end is pending, and not false.
    """

    def __init__(self, rng: random.Random, scene: Known, *, ended: bool = False) -> None:
        self.rng = rng
        # Signs of a map are entities, and without the map nothing says that they are missing.
        self.kinds = KINDS if scene.road is None else KINDS[:-1]
        self.bounds = BOUNDS
        self.before = ""
        if ended and rng.random() < 0.5:
            self.before = "USING END pending CHECK "
        elif ended:
            self.bounds = BOUNDS[2:]

    def some(self, count: int) -> list[str]:
        """So many different checks."""
        found: dict[str, None] = {}
        while len(found) < count:
            found[self.check()] = None
        return [*found]

    def _filled(self, shape: str, names: Sequence[str], *parts: str) -> str:
        """A shape with random numbers, of some variables."""
        rng = self.rng
        a, b = rng.sample(names, 2) if len(names) > 1 else (names[0], names[0])
        told: dict[str, Any] = {
            "a": a,
            "b": b,
            "kind": rng.choice(self.kinds),
            "count": rng.randint(1, 3),
            "near": rng.choice((2, 5, 10, 20, 45, 80)),
            "time": rng.choice((0.5, 1, 2, 4)),
            "speed": rng.choice((5, 8, 10, 12, 30)),
            "brake": rng.choice((0.5, 2, 4)),
            "bound": rng.choice(self.bounds),
        }
        if "{inner}" in shape:
            told["inner"] = self.now([*names, "w"], 1, blocks=False)
        if "{now}" in shape:
            told["now"] = self.now(names, 1)
        return shape.format(*parts, **told)

    def atom(self, names: Sequence[str], *, blocks: bool = True, times: bool = True) -> str:
        """A smallest condition."""
        kinds = [OF_ONE, *([OF_TWO] * 3 if len(names) > 1 else []), *([OF_MANY] * blocks)]
        shape = self.rng.choice(self.rng.choice(kinds))
        while not times and any(
            word in shape for word in ("_over", "delta", "prev", "_now", "age(")
        ):
            shape = self.rng.choice(self.rng.choice(kinds))
        return self._filled(shape, names)

    def now(self, names: Sequence[str], depth: int, *, blocks: bool = True) -> str:
        """A condition on one frame."""
        if depth == 0 or self.rng.random() < 0.4:
            return self.atom(names, blocks=blocks, times=False)
        parts = [self.now(names, depth - 1, blocks=blocks) for _ in range(2)]
        return self.rng.choice(LOGIC).format(*parts)

    def formula(self, names: Sequence[str], depth: int) -> str:
        """A condition on several frames."""
        if depth == 0:
            return self.atom(names)
        shape = self.rng.choice(OVER_TIME + LOGIC * 2)
        return self._filled(shape, names, *(self.formula(names, depth - 1) for _ in range(2)))

    def check(self) -> str:
        """A check."""
        rng = self.rng
        variables: list[tuple[str, list[str]]] = []
        for name in rng.choice(((), ("v",), ("v",), ("v",), ("v", "u"))):
            word = rng.choice(("FORALL", "FORALL", "FORSOME"))
            if variables and variables[-1][0] == word:
                variables[-1][1].append(name)
            else:
                variables.append((word, [name]))
        quantifiers: list[str] = []
        names = ["ego"]
        for word, own in variables:
            names += own
            listed = ", ".join(f"{name}:{rng.choice(self.kinds)}" for name in own)
            where = f" WHERE {self.now(names, 0)}" if rng.random() < 0.2 else ""
            quantifiers.append(f"{word} ({listed}{where})")
        waits = "EVENTUALLY" + rng.choice(self.bounds)
        first = rng.choice(("ALWAYS", "ALWAYS", "ALWAYS", waits, "ALWAYS NOT", ""))
        formula = self.formula(names, rng.randint(0, 2))
        return f"{self.before}{' '.join(quantifiers)} {first} ({formula})"
