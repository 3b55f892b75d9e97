"""Horizon of a check: the range around the ego in which a trace must have all entities.

Unknown entities are in no binding. In ``FORALL (v:Vehicle) ALWAYS dist(ego, v) > 5`` only vehicles within 5 m
matter, so a trace that covers 50 m around the ego is sufficient. ``FORALL (v:Vehicle) ALWAYS v.speed < 50``
is about all vehicles. If vehicles were left out, it cannot be proved true, but it is false if a known vehicle
is too fast.

Some conditions cannot hold beyond a distance, so they bound the position of an entity: a comparison of a
distance, of a time to collision (with the greatest speed in the trace) or of a safe distance, and a relation
with a limited range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.operators import MIRRORED
from sgstore.model.vocabulary import PROXIMITY, SIGNALS, entity_kinds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from sgstore.lang.ir import Bound, BoundCheck, Scope

Interval = tuple[float, float]

BODY: Final = 10.0
"""Extra distance between the centres of two bodies, compared with their edges: sum of the half lengths; m."""
FASTEST: Final = 150.0
"""Greatest valid speed. Faster speeds count as unknown; m/s."""
_FAR: Final = 200.0 + BODY
"""Largest known distance along lanes; m."""
WAITING: Final = 200.0
"""Largest distance from a vehicle to the light or sign that applies to it; m."""
LINKS: Final = dict.fromkeys(PROXIMITY, 25.0 + BODY) | {
    **dict.fromkeys(("leads", "follows"), 100.0 + BODY),
    "overlaps": 2 * BODY,
}
"""Relations with a limited range, with the range in the default settings; m."""


@dataclass(frozen=True, slots=True)
class Horizon:
    """Range around the ego in which a trace must have all entities; m.

    Attributes
    ----------
    true, false : float
        Range with which a true, or false, verdict for the known entities is valid for the whole world.
    """

    true: float = 0.0
    false: float = 0.0


@dataclass(frozen=True, slots=True)
class _Place:
    """Largest distance of an entity from the ego that some conditions allow.

    Attributes
    ----------
    away : float
        Largest distance from the ego; m.
    along : float
        Largest distance along the axis of the ego; m. Valid for entities in its lane or a neighbouring lane.
    lanes : bool
        True if the entity is connected to the ego by lanes.
    """

    away: float = math.inf
    along: float = math.inf
    lanes: bool = False

    @property
    def reach(self) -> float:
        """Largest distance of the entity from the ego that the conditions allow; m."""
        return min(self.away, self.along) if self.lanes else self.away

    def both(self, other: _Place) -> _Place:
        """Return the largest distance of an entity that meets both groups of conditions."""
        lanes = self.lanes or other.lanes
        return _Place(min(self.away, other.away), min(self.along, other.along), lanes)

    def either(self, other: _Place) -> _Place:
        """Return the largest distance of an entity that meets at least one of two groups of conditions."""
        lanes = self.lanes and other.lanes
        away = max(self.reach, other.reach)
        return _Place(away, max(self.along, other.along), lanes)


def horizon(check: BoundCheck, speed: float = FASTEST) -> Horizon:
    """Return the range around the ego in which entities can change the verdict of a check.

    Parameters
    ----------
    check : BoundCheck
    speed : float
        Upper limit of all speeds in the trace; m/s.
    """
    egos = {key: 0.0 for key, node in check.scope.nodes.items() if not node.kinds.other}
    asked = _Looking(egos, speed)
    formulas = [check.formula, *(q.where for q in check.quantifiers if q.where is not None)]
    found = Horizon()
    for quantifier in check.quantifiers:
        every = quantifier.word == "FORALL"
        for key in quantifier.nodes:
            if not check.scope.nodes[key].kinds.every & entity_kinds():
                continue
            where = asked.place(check.formula, key, wanted=not every)
            if quantifier.where is not None:
                where = where.both(asked.place(quantifier.where, key, wanted=True))
            found = _farther(found, where.reach, true=every, false=not every)
            asked.known[key] = where.reach
    for formula in formulas:
        for one in asked.blocks(formula):
            found = _farther(found, one.reach, true=one.true, false=one.false)
    if check.range is not None:
        found = Horizon(min(found.true, check.range), min(found.false, check.range))
    return found


def spoken_kinds(check: BoundCheck) -> tuple[frozenset[str], frozenset[str]]:
    """Return two sets of node kinds. If these nodes are missing, a check can be wrongly true, or wrongly false.

    Parameters
    ----------
    check : BoundCheck
    """
    true, false = set[str](), set[str]()
    for quantifier in check.quantifiers:
        among = true if quantifier.word == "FORALL" else false
        for key in quantifier.nodes:
            among |= check.scope.nodes[key].kinds.other
    formulas = [check.formula, *(q.where for q in check.quantifiers if q.where is not None)]
    for formula in formulas:
        for one in _Looking({}, FASTEST).blocks(formula):
            true |= one.kinds if one.true else set()
            false |= one.kinds if one.false else set()
    return frozenset(true), frozenset(false)


def _farther(found: Horizon, reach: float, *, true: bool, false: bool) -> Horizon:
    if true:
        found = replace(found, true=max(found.true, reach))
    return replace(found, false=max(found.false, reach)) if false else found


@dataclass(frozen=True, slots=True)
class _Missed:
    """Pattern node that may be missing in a recording, and the wrong verdicts that this can cause.

    ``true`` and ``false`` are set if a missing node can cause that wrong verdict.
    """

    kinds: frozenset[str]
    reach: float
    true: bool
    false: bool

    @property
    def either(self) -> _Missed:
        """Return a copy in which the missing node can cause both wrong verdicts: true and false."""
        return replace(self, true=True, false=True)


@dataclass(slots=True)
class _Looking:
    """Analysis of a check: the distances from the ego up to which its entities matter.

    Attributes
    ----------
    known : dict of str to float
        Variable → largest distance from the ego; m.
    speed : float
        Greatest speed of vehicles; m/s.
    joined : frozenset of str
        Variables that edges connect to one whose distance is limited.
    """

    known: dict[str, float]
    speed: float
    joined: frozenset[str] = frozenset()

    def blocks(  # noqa: C901, PLR0912 - a case each
        self, formula: Bound, *, up: bool = True
    ) -> Iterable[_Missed]:
        """Yield the nodes of all patterns in braces, such as ``EXISTS {…}``, in a formula.

        Each has the wrong verdicts that a missing node can cause.

        ``up``: true if a true formula supports a true verdict.
        """
        match formula:
            case b.Operation("NOT", (one,)):
                yield from self.blocks(one, up=not up)
            case b.Operation("IMPLIES", (one, other)):
                yield from self.blocks(one, up=not up)
                yield from self.blocks(other, up=up)
            case b.Operation("AND" | "OR", operands) | b.Tense(operands=operands):
                for one in operands:
                    yield from self.blocks(one, up=up)
            case b.Operation(">" | ">=", (b.BlockValue(word="COUNT" | "EXISTS") as block, _)):
                yield from self.of_block(block, up=up)
            case b.Operation("<" | "<=", (b.BlockValue(word="COUNT" | "EXISTS") as block, _)):
                yield from self.of_block(block, up=not up)
            case b.Operation(">" | ">=", (b.SignalCall(word="run_length", operand=one), _)):
                yield from self.blocks(one, up=up)
            case b.BlockValue(word="EXISTS"):
                yield from self.of_block(formula, up=up)
            case _:
                for part in b.walk(formula):
                    if isinstance(part, b.BlockValue):
                        for one in self.of_block(part, up=up):
                            yield one.either
                    elif isinstance(part, b.SignalCall) and part is not formula:
                        for one in self.blocks(part.operand, up=up):
                            yield one.either

    def of_block(self, block: b.BlockValue, *, up: bool) -> Iterable[_Missed]:
        """Yield the nodes of a pattern in braces, with the wrong verdicts that their absence can cause.

        A missing node makes ``EXISTS`` false and ``COUNT`` smaller.
        """
        scope = block.scope
        for key, node in scope.nodes.items():
            if node.kinds.other:
                moves = node.kinds.every & entity_kinds()
                reach = self.in_scope(scope, key).reach if moves else 0.0
                yield _Missed(node.kinds.other, reach, not up, up)
        inner = _Looking(
            self.known | {key: self.in_scope(scope, key).reach for key in scope.nodes},
            self.speed,
            self.joined.union(key for key in scope.nodes if self._is_joined(scope, key)),
        )
        for part in block.inside:
            yield from inner.blocks(part, up=up)

    def in_scope(self, scope: Scope, key: str) -> _Place:
        """Return the largest distance between the ego and a node of a matched pattern."""
        found = _Place()
        for part in scope.where:
            found = found.both(self.place(part, key, wanted=True))
        for edge in scope.edges:
            ends = {edge.src, edge.dst}
            if key in ends and edge.relations <= LINKS.keys():
                other = next(iter(ends - {key}), key)
                reach = max(LINKS[name] for name in edge.relations)
                found = found.both(_Place(reach + self.known.get(other, math.inf)))
        if self._is_joined(scope, key):
            found = found.both(_Place(lanes=True))
            if scope.kinds(key).every <= frozenset(SIGNALS):
                found = found.both(_Place(WAITING))
        return found

    def _is_joined(self, scope: Scope, key: str) -> bool:
        """True if edges, or lanes of one chain, connect a node to a node at a limited distance from the ego."""
        links = [(edge.src, edge.dst) for edge in scope.edges]
        links += b.same_chain(scope.where)
        reached, grown = {key}, True
        while grown:
            fresh = {end for link in links if reached.intersection(link) for end in link} - reached
            reached |= fresh
            grown = bool(fresh)
        return any(
            other in self.joined or self.known.get(other, math.inf) < math.inf
            for other in reached - {key}
        )

    def place(  # noqa: PLR0911 - a case each
        self, formula: Bound, key: str, *, wanted: bool, later: bool = False
    ) -> _Place:
        """Return the largest distance of an entity from the ego that a formula allows.

        The formula is true or false, as ``wanted``. ``later``: true if the frame is not the last one.
        """
        later = later or _goes_on(formula, wanted=wanted)
        match formula:
            case b.Operation("NOT", (one,)):
                return self.place(one, key, wanted=not wanted, later=later)
            case b.Operation("IMPLIES", (one, other)):
                parts = [
                    self.place(one, key, wanted=not wanted, later=later),
                    self.place(other, key, wanted=wanted, later=later),
                ]
                return _any(parts) if wanted else _all(parts)
            case b.Operation("AND" | "OR" as word, operands):
                parts = [self.place(one, key, wanted=wanted, later=later) for one in operands]
                return _all(parts) if (word == "AND") == wanted else _any(parts)
            case b.Tense(word="NEXT" | "WEAKNEXT", operands=(one,)) if later:
                return self.place(one, key, wanted=wanted)
            case b.Tense(operands=operands) if not _may_be_empty(formula, wanted=wanted):
                return _any([self.place(one, key, wanted=wanted) for one in operands])
            case b.Operation(">" | ">=" | "<" | "<=", (b.SignalCall(word="run_length") as run, _)):
                # A run is also short if it began with the trace.
                is_long = wanted == formula.word.startswith(">")
                return self.place(run.operand, key, wanted=True) if is_long else _Place()
            case b.Operation(word, (one, other)) if word in MIRRORED:
                return self._compared(word if wanted else _COMPLEMENT[word], one, other, key)
            case b.BlockValue(word="EXISTS", scope=scope) if wanted and key in scope.outer:
                return self.in_scope(scope, key)
            case b.Value(value=value) if value is not wanted and value is not None:
                return _Place(0.0, 0.0)  # the constant never has the wanted value
            case _:
                return _Place()

    def _compared(self, word: str, one: Bound, other: Bound, key: str) -> _Place:
        found = self._measured(word, one, other, key)
        return found.both(self._measured(MIRRORED[word], other, one, key))

    def _measured(self, word: str, one: Bound, other: Bound, key: str) -> _Place:
        """Return the largest distance of an entity from the ego that ``dist(e, v) < 20`` or similar allows."""
        whole = isinstance(one, b.Operation) and one.word == "abs"
        pair = one.operands[0] if isinstance(one, b.Operation) and whole else one
        if not isinstance(pair, b.PairNumber) or key not in {pair.a, pair.b}:
            return _Place()
        from_ = self.known.get(pair.b if pair.a == key else pair.a, math.inf)
        low, high = bounds(other, self.speed)
        along = pair.function == "lon_gap" or (pair.function == "lon" and whole)
        if along and word in {"<", "<=", "="}:
            return _Place(along=from_ + high + BODY)
        if pair.function == "lane_dist":
            return _Place(from_ + _FAR)
        reach = _SMALL.get(pair.function)
        if reach is not None and word in {"<", "<=", "="}:
            return _Place(from_ + reach(max(high, 0.0), self.speed))
        braking = _BRAKING.get(pair.function)
        least = low if braking is not None and braking > 0 else -high
        wanted = {">", ">="} if braking is not None and braking > 0 else {"<", "<="}
        if braking is None or word not in wanted or least <= 0:
            return _Place()
        return _Place(from_ + (2 * self.speed) ** 2 / (2 * least * abs(braking)) + BODY)


def _goes_on(formula: Bound, *, wanted: bool) -> bool:
    """True if a formula can have the given value (true or false) only before the last frame."""
    match formula:
        case b.Tense(word="NEXT" | "WEAKNEXT"):
            return wanted == (formula.word == "NEXT")
        case b.Operation("NOT", (one,)):
            return _goes_on(one, wanted=not wanted)
        case b.Operation("IMPLIES", (one, other)) if not wanted:
            return _goes_on(one, wanted=True) or _goes_on(other, wanted=False)
        case b.Operation("AND" | "OR" as word, operands) if wanted == (word == "AND"):
            return any(_goes_on(one, wanted=wanted) for one in operands)
        case _:
            return False


def _may_be_empty(tense: b.Tense, *, wanted: bool) -> bool:
    """True if a temporal operator has the given value when its time window has no frames.

    Examples: ``NEXT`` in the last frame is false, ``HISTORICALLY[1s, 2s]`` in the first frame is true.
    """
    if tense.word in {"NEXT", "WEAKNEXT", "PREVIOUS"}:
        return wanted == (tense.word == "WEAKNEXT")
    return tense.low > 0 and wanted == (tense.word in {"ALWAYS", "HISTORICALLY", "RELEASE"})


def _all(places: list[_Place]) -> _Place:
    found = _Place()
    for one in places:
        found = found.both(one)
    return found


def _any(places: list[_Place]) -> _Place:
    found = places[0]
    for one in places[1:]:
        found = found.either(one)
    return found


_COMPLEMENT: Final = {"<": ">=", "<=": ">", ">": "<=", ">=": "<", "=": "<>", "<>": "="}


def _safe(margin: float, speed: float) -> float:
    """Return the largest RSS safe distance between two oncoming vehicles; m."""
    fast = speed + 3.5
    return margin + 2 * (speed + 1.75) + fast * fast / 6 + fast * fast / 8 + BODY


_SMALL: Final[Mapping[str, Callable[[float, float], float]]] = {
    "dist": lambda value, _: value,
    **dict.fromkeys(("gap", "clearance"), lambda value, _: value + BODY),
    "ttc": lambda value, speed: 2 * speed * value + BODY,
    "closing_time": lambda value, speed: 2 * speed * value + BODY,
    "headway": lambda value, speed: speed * value + BODY,
    "wttc": lambda value, speed: 2 * speed * value + 11.5 * value * value + BODY,
    "ttc_mild": lambda value, speed: 2 * speed * value + 4 * value * value + BODY,
    "rss_margin": _safe,
}
"""Pair numbers that are small only for near entities: name → function (value, speed) → largest distance; m."""

_BRAKING: Final = {"a_long_req": -1.0, "drac": 1.0, "btn": 11.5}
"""Pair numbers that are large only for near entities: name → deceleration for a value of 1; m/s²."""


def bounds(value: Bound, speed: float) -> Interval:
    """Return the smallest and the largest possible value of a numeric expression.

    Parameters
    ----------
    value : Bound
    speed : float
        m/s.
    """
    match value:
        case b.Value(value=int() | float() as number):
            return float(number), float(number)
        case b.NodeAttribute(attribute=attribute):
            return _OF_NODE.get(attribute.name, lambda _: _ANY)(speed)
        case b.PairNumber(function="closing_speed" | "rel_speed"):
            return -2 * speed, 2 * speed
        case b.Operation(word, operands) if word in COMPUTED:
            return COMPUTED[word]([bounds(one, speed) for one in operands])
        case _:
            return _ANY


_ANY: Final = (-math.inf, math.inf)
_OF_NODE: Final[Mapping[str, Callable[[float], Interval]]] = {
    "speed": lambda speed: (0.0, speed),
    **dict.fromkeys(("vx", "vy"), lambda speed: (-speed, speed)),
    **dict.fromkeys(("length", "width", "height"), lambda _: (0.0, 2 * BODY)),
}


def _product(parts: list[Interval]) -> Interval:
    (a, b_), (c, d) = parts
    found = [0.0 if 0 in (x, y) else x * y for x in (a, b_) for y in (c, d)]
    return min(found), max(found)


def _quotient(parts: list[Interval]) -> Interval:
    (_, _), (low, high) = parts
    if low <= 0 <= high:
        return _ANY
    return _product([parts[0], (1 / high, 1 / low)])


def _absolute(parts: list[Interval]) -> Interval:
    ((low, high),) = parts
    least = 0.0 if low <= 0 <= high else min(abs(low), abs(high))
    return least, max(abs(low), abs(high))


COMPUTED: Final[Mapping[str, Callable[[list[Interval]], Interval]]] = {
    "+": lambda parts: (parts[0][0] + parts[1][0], parts[0][1] + parts[1][1]),
    "-": lambda parts: (parts[0][0] - parts[1][1], parts[0][1] - parts[1][0]),
    "*": _product,
    "/": _quotient,
    "negative": lambda parts: (-parts[0][1], -parts[0][0]),
    "abs": _absolute,
    "min": lambda parts: (min(low for low, _ in parts), min(high for _, high in parts)),
    "max": lambda parts: (max(low for low, _ in parts), max(high for _, high in parts)),
    "coalesce": lambda parts: (min(low for low, _ in parts), max(high for _, high in parts)),
}
"""Operator → function from the intervals of its operands to the interval of its result."""
