"""Errors for patterns that no recording can match: wrong nodes of a relation, values out of range.

The relations that sgstore computes join only some kinds of nodes, and most numbers have a range. A pattern or a
condition outside of these never holds, so the binder rejects it. Graphs of other tools and relations of clients
may differ: then the query gets a note instead.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Final

from sgstore.lang import ir as b
from sgstore.lang.bind._horizon import COMPUTED
from sgstore.lang.catalog import Type
from sgstore.lang.operators import MIRRORED, ROUNDINGS
from sgstore.model.vocabulary import (
    OWN_ENTITY_KINDS,
    OWN_KINDS,
    RELATION_ENDS,
    SIGNALS,
    VEHICLES,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sgstore.lang.bind._symbols import SymbolTable
    from sgstore.lang.syntax import tree as s

    Ends = Sequence[tuple[b.Kinds, b.Kinds]]
    Written = tuple[s.EdgePattern, s.NodePattern, s.NodePattern, str]
    """Edge of the query text, the nodes to its left and right, and its key."""

Interval = tuple[float, float]


_SIGNALS: Final = frozenset(SIGNALS)
_OWN: Final = frozenset(OWN_ENTITY_KINDS)
_KINDS: Final = frozenset(OWN_KINDS)
"""Built-in kinds. An edge can also have a user-defined kind at either end."""
_WORDS: Final[Mapping[str, b.Kinds]] = {
    "entity": b.Kinds(_OWN, _OWN),
    "body": b.Kinds(_OWN, _OWN - _SIGNALS),
    "vehicle": b.Kinds(frozenset(VEHICLES), frozenset(VEHICLES)),
    "signal": b.Kinds(_SIGNALS, _SIGNALS),
}
_ENDS: Final[Mapping[str, Ends]] = {
    name: tuple(
        (
            _WORDS.get(src) or b.Kinds(frozenset(), frozenset(src.split("|"))),
            _WORDS.get(dst) or b.Kinds(frozenset(), frozenset(dst.split("|"))),
        )
        for src, dst in pairs
    )
    for name, pairs in RELATION_ENDS.items()
}
"""Built-in kinds at both ends of each relation that sgstore computes."""


def check_edges(written: Sequence[Written], names: SymbolTable) -> None:
    """Raise an error if no recording can have an edge of a pattern.

    The kinds that remain for each node are stored for :func:`check_comparison`.

    Raises
    ------
    QueryError
        No relation of the edge can join these nodes.
    """
    edges = {edge.key: edge for edge in names.scope.edges}
    kinds = names.session.kinds_left
    for _ in written:
        before = dict(kinds)
        for one in written:
            edge = edges[one[3]]
            src, dst = (
                _sort(names.scope.outer[key])
                if key in names.scope.outer
                else kinds.get(key) or names.scope.kinds(key)
                for key in (edge.src, edge.dst)
            )
            if not (edge.relations <= _ENDS.keys() and (src.every | dst.every) <= _KINDS):
                continue
            ends = [pair for name in edge.relations for pair in _ENDS[name]]
            if edge.high > 1 or edge.both:
                ways = _ways(edge, src, dst, ends)
            else:
                ways = [(src & a, dst & z) for a, z in ends if src & a and dst & z]
            if not ways or (edge.src == edge.dst and edge.high == 1):
                _refuse_edge(one, edge, (src, dst), names)
                return
            if edge.high == 1:
                sides = zip(*ways, strict=True)
                for key, side in zip((edge.src, edge.dst), sides, strict=True):
                    if key not in names.scope.outer:
                        kinds[key] = reduce(or_, side)
        if kinds == before:
            break


def _sort(kinds: b.Kinds) -> b.Kinds:
    """If some kinds include an entity kind, return these kinds together with all entity kinds."""
    return kinds | _WORDS["entity"] if kinds.other & _OWN else kinds


def _ways(
    edge: b.Edge, src: b.Kinds, dst: b.Kinds, ends: Sequence[tuple[b.Kinds, b.Kinds]]
) -> list[tuple[b.Kinds, b.Kinds]]:
    """Return the pairs of kinds (source, destination) that an edge or a path of such edges can connect."""
    ends = [*ends, *((other, one) for one, other in ends)] if edge.both else ends
    found: list[tuple[b.Kinds, b.Kinds]] = []
    reached = [src]
    for number in range(1, edge.high + 1):
        steps = [(at & one, other) for at in reached for one, other in ends if at & one]
        if number >= edge.low:
            found += [(one, other & dst) for one, other in steps if other & dst]
        reached = list(dict.fromkeys(other for _, other in steps))
    return found


def _refuse_edge(
    written: Written, edge: b.Edge, kinds: tuple[b.Kinds, b.Kinds], names: SymbolTable
) -> None:
    pattern, left, right, _ = written
    text = names.session.text
    one, arrow, other = (text[part.span.start : part.span.end] for part in (left, pattern, right))
    names.session.impossible(
        f"no recording has {one}{arrow}{other}",
        pattern.span,
        _correct_edge(edge, kinds, (one, arrow, other), pattern.direction),
    )


def _correct_edge(
    edge: b.Edge, kinds: tuple[b.Kinds, b.Kinds], texts: tuple[str, str, str], direction: str
) -> str:
    """Return a hint for an impossible edge: reverse, repeat or replace it, or use other nodes."""
    src, dst = kinds
    of = {name: _ENDS[name] for name in RELATION_ENDS if name in edge.relations}
    ends = [pair for some in of.values() for pair in some]
    one, arrow, other = texts
    if edge.src == edge.dst:
        return "no edge joins a node with itself: use two variables"
    if _ways(edge, dst, src, ends):
        turned = f"-{arrow[2:]}>" if direction == "left" else f"<{arrow[:-1]}"
        return f"write {one}{turned}{other}"
    if set(of) == {"isIn"} and edge.high == 1 and not edge.both:
        for many in (2, 3):
            if _ways(replace(edge, low=many, high=many), src, dst, ends):
                return f"write {one}{arrow.replace(']', f'*{many}]')}{other}"
    others = [
        name for name, some in _ENDS.items() if _ways(replace(edge, low=1, high=1), src, dst, some)
    ]
    told = [f"{name} leads from {_told(name)}" for name in of if len(of) <= 2]
    if others and len(others) <= 4:
        told.append(f"these nodes can have {', '.join(f'-[:{name}]->' for name in others)}")
    return "; ".join(told) or "no relation joins these nodes"


def _told(relation: str) -> str:
    """Return, as text, the kinds of node that a relation connects, such as ``a lane to a road``."""
    pairs = RELATION_ENDS[relation]
    text = ", or from ".join(f"{one} to {other}" for one, other in pairs)
    return text.replace("|", ", ").replace("body", "entity")


LIMITS: Final[Mapping[str, Interval]] = {
    **dict.fromkeys(("heading", "pitch", "roll", "bearing", "rel_heading"), (-180.0, 180.0)),
    **dict.fromkeys(("apparent_heading", "heading_error"), (-180.0, 180.0)),
    **dict.fromkeys(("throttle", "brake", "steer"), (-10.0, 10.0)),
    "cpi": (0.0, 1.0),
    **dict.fromkeys(("speed", "length", "width", "height", "speed_limit"), (0.0, math.inf)),
    **dict.fromkeys(("dist", "gap", "ttc", "headway", "rel_speed", "lon_gap"), (0.0, math.inf)),
    **dict.fromkeys(("lat_gap", "closing_time", "dce", "ttce", "dce_3s", "wttc"), (0.0, math.inf)),
    **dict.fromkeys(("drac", "a_req", "pret", "et", "delta_v", "msd"), (0.0, math.inf)),
    **dict.fromkeys(("ttc_mild", "pet", "et_recorded", "ttc_recorded", "tet"), (0.0, math.inf)),
    **dict.fromkeys(("tit", "dce_recorded", "ttce_recorded"), (0.0, math.inf)),
    **dict.fromkeys(("t", "seq", "trace.duration", "trace.period"), (0.0, math.inf)),
    **dict.fromkeys(("lifetime", "trace.frames"), (1.0, math.inf)),
    "env.temperature": (100.0, 1000.0),
}
"""Smallest and largest value of attributes and of numbers of two entities, in the units of the language.

Readers do not check controls and the weather, so their limits are wide: they are for other units (percent, °C).
"""

ROUNDED: Final = 0.01
"""Tolerance at both limits of a range, because stored numbers have only 32 bits."""


_ANY: Final = (-math.inf, math.inf)


def limits(value: b.Bound) -> Interval:
    """Return the smallest and the largest value that a number can have in a recording."""
    match value:
        case b.Value(value=int() | float() as number):
            return float(number), float(number)
        case b.NodeAttribute(attribute=one) | b.EdgeAttribute(attribute=one):
            found = None if one.name == "gap" else LIMITS.get(one.name)  # may be below 0
        case b.FrameAttribute(attribute=one) | b.TraceAttribute(attribute=one):
            found = None if one.table or b.is_passed_on(value) else LIMITS.get(one.name)
        case b.PairNumber(function=name):
            found = LIMITS.get(name)
        case b.BlockValue(word="COUNT") | b.Aggregate(word="count"):
            found = (0.0, math.inf)
        case b.Aggregate(word="min" | "max" | "avg", operand=operand) if operand is not None:
            found = limits(operand)
        case b.OverMatch(word="min" | "max" | "avg" | "first" | "last", operand=operand):
            found = limits(operand)
        case b.Operation(word, operands) if word in ROUNDINGS:
            return limits(operands[0])
        case b.Operation(word, operands) if word in COMPUTED:
            found = COMPUTED[word]([limits(one) for one in operands])
        case _:
            found = None
    return found or _ANY


def check_comparison(e: s.Expression, found: b.Bound, names: SymbolTable) -> b.Bound:
    """Return a comparison. Raise an error if no recorded value can make it true.

    A comparison that always holds gets a note.

    Raises
    ------
    QueryError
        It never holds.
    """
    match found:
        case b.Operation(operands=(left, b.Choices(items=others))):
            word = "="
        case b.Operation(word=word, operands=(b.Value() as constant, left)):
            others, word = (constant,), MIRRORED.get(word, word)
        case b.Operation(word=word, operands=(left, b.Value() as constant)):
            others = (constant,)
        case _:
            return found
    texts = {one.value for one in others if isinstance(one.value, str)}
    numbers = [float(one.value or 0) for one in others if one.type is Type.number]
    holds, hint = "", ""
    if numbers and not isinstance(left, b.Value):
        if isinstance(left, b.NodeAttribute):
            low, high = LIMITS.get(left.attribute.name, _ANY)
        else:
            low, high = limits(left)
        margin = ROUNDED if math.isfinite(low) and math.isfinite(high) else 0.0
        below, above = max(numbers) < low - margin, min(numbers) > high + margin
        if below or above:
            never = {"=": True, "<": below, "<=": below, ">": above, ">=": above}.get(word, False)
            holds, hint = "never" if never else "always", _range(low, high, others[0])
    elif texts:
        holds, hint = _wrong_words(left, word, texts, names)
    if holds:
        reason = f"{names.session.text[e.span.start : e.span.end]} {holds} holds"
        if holds == "never" and not isinstance(left, b.EdgeRelation):
            names.session.impossible(reason, e.span, hint)
        else:
            names.session.doubt(f"{reason}; {hint}")
    return found


def _range(low: float, high: float, constant: b.Value) -> str:
    """Return the valid range of an attribute as text, and a hint if the value has the wrong unit."""
    number = float(constant.shown or 0)
    text = (
        f"it is at least {low:g}" if high == math.inf else f"it lies between {low:g} and {high:g}"
    )
    if (low, high) == (-180.0, 180.0):
        text += f" degrees: write {(number + 180) % 360 - 180:g}"
    elif (low, high) == LIMITS["env.temperature"]:
        text = f"it is in K: write {number + 273.15:g} for {number:g} °C"
    elif (low, high) == LIMITS["brake"]:
        text = f"it lies between -1 and 1: write {number / 100:g} for {number:g} %"
    elif (low, high) == (0.0, 1.0) and 1 < number <= 100:
        text += f": write {number / 100:g} for {number:g} %"
    return text


def _wrong_words(left: b.Bound, word: str, texts: set[str], names: SymbolTable) -> tuple[str, str]:
    """If a compared kind or relation cannot occur, return ``always`` or ``never`` (the result), and a hint."""
    possible, hint = None, ""
    if isinstance(left, b.NodeAttribute) and left.attribute.name == "kind":
        possible = (names.session.kinds_left.get(left.node) or names.scope.kinds(left.node)).every
        label = "".join(part.capitalize() for part in min(texts).split("_"))
        hint = f"its label or its edges exclude it: write (x:{label})"
    elif isinstance(left, b.EdgeRelation):
        edge = next((one for one in names.scope.edges if one.key == left.edge), None)
        possible, hint = edge and edge.relations, f"write -[…:{min(texts)}]->"
    if possible is None or not texts.isdisjoint(possible):
        return "", ""
    return "always" if word == "<>" else "never", hint
