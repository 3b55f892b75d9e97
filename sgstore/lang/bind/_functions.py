"""Binder of function calls: functions of entities and numbers, predicates, and aggregates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NoReturn

from sgstore.errors import QueryError
from sgstore.lang import ir as b
from sgstore.lang.bind._aggregates import AGGREGATES, aggregate, is_aggregate
from sgstore.lang.bind._datasets import CLASSES, abstraction_named, class_count
from sgstore.lang.bind._in_range import in_range
from sgstore.lang.bind._kinds import on_lanes
from sgstore.lang.bind._symbols import Symbol, SymbolTable, of_type
from sgstore.lang.bind._temporal import course
from sgstore.lang.catalog import NODE_ATTRIBUTES, PAIR_NAMES, Type
from sgstore.lang.library import pattern_named, patterns, predicates
from sgstore.lang.operators import EXTREMES, NUMERIC, OF_TEXT, OF_TWO
from sgstore.lang.syntax import parse, said_of
from sgstore.lang.syntax import tree as s
from sgstore.model.criticality import RECORDED
from sgstore.model.pair_numbers import (
    COURSES,
    LANE_DIST,
    NEXT_PARTS,
    OF_ONE,
    PAIR_FUNCTIONS,
    PART_DIST,
)
from sgstore.model.vocabulary import entity_kinds, normalize_name, relation_named, suggestion

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.lang.bind._symbols import Session

_OTHERS: Final = frozenset(
    {
        *("class_count", "coalesce", "dataset_classes", "in_range", "known", "length", "nodes"),
        *("topic", "type", *OF_TEXT),
    }
)
_COURSES: Final = (
    "prev",
    "delta",
    *b.WINDOWS,
    "run_length",
    "since_true",
    "t",
    "age",
    "exists_now",
    "robustness",
)
_TEMPORAL: Final = frozenset(map(normalize_name, _COURSES))
TTC_LANE: Final = "ttc_lane"
_IN_LANE: Final = "MAX {(@)-[at:isIn {is_primary: TRUE}]->(l:Lane) | "
_LANE_SPEED: Final = (
    f"{_IN_LANE}@.vx * cos(radians(@.heading - at.heading_error))"
    " + @.vy * sin(radians(@.heading - at.heading_error))}"
)
"""Speed along the lane; negative for an entity that reverses or drives against the lane."""
_LANE_HALF: Final = (
    f"{_IN_LANE}@.length * abs(cos(radians(at.heading_error)))"
    " + @.width * abs(sin(radians(at.heading_error)))} / 2"
)
"""Half the length of a footprint along the lane."""
_ALONG_LANES: Final = """DEFINE PREDICATE ttc_lane(a, b) AS
  CASE WHEN lane_dist(a, b) > 0 AND {speeds} >= 0.000001
  THEN max(lane_dist(a, b) - {halves}, 0) / ({speeds}) END""".format(
    speeds=" - ".join(_LANE_SPEED.replace("@", one) for one in "ab"),
    halves=" - ".join(_LANE_HALF.replace("@", one) for one in "ab"),
)
"""Definition of ``ttc_lane``. It is a predicate, not a column, because it combines tables and attributes."""
FUNCTIONS: Final = frozenset(
    {
        *(*PAIR_FUNCTIONS, *RECORDED, TTC_LANE, *OF_ONE, *NUMERIC, *EXTREMES, *OF_TWO),
        *(*_OTHERS, *AGGREGATES, *_COURSES),
    }
)

MAX_CALLS: Final = 30
"""Deepest nesting of predicate calls."""


def call(e: s.Call, names: SymbolTable) -> b.Bound:
    """Resolve the names and types in a call of a function or predicate; return the expression.

    Raises
    ------
    QueryNameError
        Unknown function or predicate.
    QueryError
        Invalid arguments.
    """
    name = normalize_name(e.name)
    if e.distinct and not is_aggregate(e):
        names.session.refuse(
            f"{e.name}() takes no DISTINCT", e.span, "RETURN DISTINCT, or COUNT(DISTINCT x)"
        )
    if name in names.session.predicates:
        return _predicate(e, names)
    if name in _TEMPORAL:
        return course(e, names)
    if not names.aggregated and is_aggregate(e):
        if names.aggregates:
            return aggregate(e, names)
        if names.over:
            names.session.refuse(
                f"a CHECK returns values of each violation; {e.name}() needs all rows",
                e.span,
                f"during it: {e.name}(x) OVER match" if name in b.OF_MATCH else None,
            )
    if name in _FUNCTIONS:
        return _FUNCTIONS[name](e, names)
    if name in AGGREGATES:
        _refuse_aggregate(e, names)
    return _standard(name, e, names)


def _refuse_aggregate(e: s.Call, names: SymbolTable) -> NoReturn:
    """Raise an error for an aggregate such as ``COUNT(x)`` outside ``RETURN`` or inside another aggregate."""
    word = e.name.upper()
    if names.aggregated:
        names.session.refuse("an aggregate cannot contain another aggregate", e.span)
    inner = "(a)-[:near]->(b)" if word == "COUNT" else "(a)-[:near]->(b) | b.speed"
    of_blocks = word in {"COUNT", "MIN", "MAX", "AVG", "SUM"}
    names.session.refuse(
        f"{e.name}() is allowed only after RETURN",
        e.span,
        f"in a condition: {word} {{{inner}}} > 2"
        if of_blocks
        else f"RETURN … HAVING {e.name}(…) > 2",
    )


def _standard(name: str, e: s.Call, names: SymbolTable) -> b.Bound:
    """Return the resolved expression for a call of a predicate from the query library.

    The library is parsed on first use.
    """
    found = predicates().get(name)
    if found is None:
        defined = [*names.session.predicates.values(), *predicates().values()]
        known = [*PAIR_FUNCTIONS, *sorted(FUNCTIONS - PAIR_FUNCTIONS.keys())]
        known += [one.name for one in defined]
        names.session.unknown("function", e.name, e.name_span, known, _no_function(e.name))
    names.session.predicates[name] = found
    return _predicate(e, names)


def _no_function(name: str) -> str | None:
    """If an unknown function name is an attribute, relation or sequence, return a hint; otherwise None."""
    word = normalize_name(name)
    if (said := said_of("functions", name)) is not None:
        return said
    if relation_named(name):
        return f"it is a relation: EXISTS {{(a)-[:{name}]->(b)}}"
    if word in NODE_ATTRIBUTES:
        return f"it is an attribute: x.{NODE_ATTRIBUTES[word].name}"
    if any(normalize_name(known) == word for known in patterns()):
        return f"it is a sequence of the library: MATCH {name}()"
    sequences = [known for known, one in patterns().items() if one.kind in {"concept", "scenario"}]
    near = suggestion(name, sequences, 0.9)
    return f"did you mean the sequence MATCH {near}()?" if near else None


def _expect(e: s.Call, low: int, high: int, names: SymbolTable) -> None:
    if not low <= len(e.arguments) <= high:
        wanted = str(low) if low == high else f"{low} or more"
        names.session.refuse(
            f"{e.name}() takes {wanted} argument{'s' * (wanted != '1')}, found {len(e.arguments)}",
            e.span,
            _signature(normalize_name(e.name)),
        )


def _signature(name: str) -> str | None:
    """Return the signature and meaning of a library predicate, or of a function of two entities.

    ``None`` means an unknown name.
    """
    if name in PAIR_NAMES:
        function = PAIR_NAMES[name]
        about = PAIR_FUNCTIONS.get(function) or RECORDED[function]
        return f"{function}(a, b): {about.meaning}"
    found = predicates().get(name)
    if found is None:
        return None
    formals = ", ".join(formal.name for formal in found.parameters)
    return f"{found.name}({formals}): {pattern_named(found.name).sentence}"


def _pair(e: s.Call, names: SymbolTable) -> b.PairNumber:
    _expect(e, 2, 2, names)
    function = PAIR_NAMES[normalize_name(e.name)]
    if function in RECORDED and names.session.online:
        names.session.refuse(
            f"{function}() needs later frames, which a monitor does not have",
            e.span,
            "use a store: sgstore find, sgstore check; or use ttc, pret or dce, which need one frame",
        )
    if function == LANE_DIST:
        _refuse_sort(e, names)
    keys = [_entity(function, argument, names) for argument in e.arguments]
    if function == LANE_DIST:
        every = [names.scope.kinds(key).every for key in keys]
        function = LANE_DIST if all(kinds & entity_kinds() for kinds in every) else PART_DIST
    return b.PairNumber(function, keys[0], keys[1], online=names.session.online)


def _ttc_lane(e: s.Call, names: SymbolTable) -> b.Bound:
    _expect(e, 2, 2, names)
    keys = [_entity(TTC_LANE, argument, names) for argument in e.arguments]
    meanings = {name: Symbol(node=key) for name, key in zip("ab", keys, strict=True)}
    relations = names.session.relations
    before = {*relations}
    match parse(_ALONG_LANES):
        case (s.Define(body=s.Case() as body),):
            shipped, names.session.shipped = names.session.shipped, True
            bound = names.body(meanings).bind(body)
            names.session.shipped = shipped
            # Without a map the value is NULL, as for lane_dist. So traces without a map are not left out.
            relations.intersection_update(before)
            return bound
        case other:
            raise TypeError(other)


def _refuse_sort(e: s.Call, names: SymbolTable) -> None:
    """Raise an error for ``lane_dist(e, junction)``, with a hint that names the right function."""
    one, other = e.arguments
    if isinstance(other, s.Temporal) and other.word == "NEXT":
        (other,) = other.operands
    sorts = {normalize_name(sort): function for function, sort in NEXT_PARTS.items()}
    if isinstance(other, s.Variable) and (sort := normalize_name(other.name)) in sorts:
        try:
            names.bind(other)
        except QueryError as error:
            who = one.name if isinstance(one, s.Variable) else "v"
            hint = f"for the distance to the next one write {sorts[sort]}({who})"
            raise type(error)(error.reason, text=error.text, span=error.span, hint=hint) from None


def _of_one(e: s.Call, names: SymbolTable) -> b.PairNumber:
    _expect(e, 1, 1, names)
    name = normalize_name(e.name)
    function = next(one for one in OF_ONE if normalize_name(one) == name)
    node = _entity(function, e.arguments[0], names)
    return b.PairNumber(function, node, node, online=names.session.online)


def _entity(function: str, argument: s.Expression, names: SymbolTable) -> str:
    found = names.bind(argument)
    takes = "an entity" if function in OF_ONE else "two entities"
    if function == LANE_DIST:
        takes += ", lanes, roads, junctions, roundabouts or crosswalks"
    if not isinstance(found, b.NodeValue):
        form = f"{function}(a)" if function in OF_ONE else f"{function}(a, b)"
        names.session.refuse(f"{function}() takes {takes}", argument.span, f"write {form}")
    kinds = names.scope.kinds(found.node).every
    if not kinds & (on_lanes() if function == LANE_DIST else entity_kinds()):
        hint = (
            "the edge holds the place of an entity in a lane: (e)-[r:isIn]->(l), r.offset, r.along"
        )
        if function in COURSES:
            hint = f"write it for an entity in the lane: (e)-[:isIn]->(l), {function}(e)"
        names.session.refuse(
            f"{function}() takes {takes}, but this is a {' or '.join(sorted(kinds))}",
            argument.span,
            hint,
        )
    return found.node


def _in_range(e: s.Call, names: SymbolTable) -> b.Bound:
    _expect(e, 2, 2, names)
    one, other = (_entity("in_range", argument, names) for argument in e.arguments)
    return in_range(one, other, names.session.traces)


def _numeric(e: s.Call, names: SymbolTable) -> b.Operation:
    _expect(e, 1, 1, names)
    return b.Operation(normalize_name(e.name), (names.number(e.arguments[0]),), Type.number)


def _of_two(e: s.Call, names: SymbolTable) -> b.Operation:
    _expect(e, 2, 2, names)
    one, other = map(names.number, e.arguments)
    return b.Operation(normalize_name(e.name), (one, other), Type.number)


def _extreme(e: s.Call, names: SymbolTable) -> b.Operation:
    _expect(e, 2, 100, names)
    return b.Operation(
        normalize_name(e.name), tuple(names.number(a) for a in e.arguments), Type.number
    )


def _coalesce(e: s.Call, names: SymbolTable) -> b.Operation:
    _expect(e, 1, 100, names)
    found = tuple(names.bind(argument) for argument in e.arguments)
    types = {f.type for f in found} - {Type.null, Type.open}
    found = tuple(of_type(one, next(iter(types), Type.open)) for one in found)
    types = {f.type for f in found} - {Type.null}
    if len(types) > 1 or types & {Type.node, Type.list}:
        names.session.refuse("coalesce() takes values of one type", e.span)
    return b.Operation("coalesce", found, types.pop() if types else Type.null)


def _known(e: s.Call, names: SymbolTable) -> b.Operation:
    _expect(e, 1, 1, names)
    return b.Operation("IS NOT NULL", (names.bind(e.arguments[0]),), Type.boolean)


def _type(e: s.Call, names: SymbolTable) -> b.EdgeRelation:
    _expect(e, 1, 1, names)
    argument = e.arguments[0]
    meaning = names.meaning(argument.name) if isinstance(argument, s.Variable) else None
    if meaning is None or meaning.edge is None:
        names.session.refuse(
            "type() takes an edge variable", argument.span, "-[d:near|visible]-> and type(d)"
        )
    if all(edge.key != meaning.edge for edge in names.scope.edges):
        names.session.refuse("an edge can be used only in the pattern that binds it", argument.span)
    return b.EdgeRelation(meaning.edge)


def _path_function(e: s.Call, names: SymbolTable) -> b.Bound:
    """Return the resolved call ``nodes(p)`` (list of nodes of a path) or ``length(p)``."""
    _expect(e, 1, 1, names)
    found = names.bind(e.arguments[0])
    if normalize_name(e.name) == "length" and b.items_of(found) is not None:
        return b.Operation("size", (found,), Type.number)
    if not b.is_path(found):
        hint = "MATCH p = (a)-[:near*1..2]->(b) RETURN length(p), nodes(p)"
        names.session.refuse(f"{e.name}() takes a path that has a name", e.arguments[0].span, hint)
    if normalize_name(e.name) == "nodes":
        return found
    return b.Operation("length", (found,), Type.number)


def _text_function(e: s.Call, names: SymbolTable) -> b.Operation:
    _expect(e, 1, 1, names)
    found = of_type(names.bind(e.arguments[0]), Type.text)
    if found.type is not Type.text:
        names.session.refuse(f"{e.name}() takes a text", e.arguments[0].span)
    return b.Operation(normalize_name(e.name), (found,), Type.text)


def _class_count(e: s.Call, names: SymbolTable) -> b.FrameAttribute:
    _expect(e, 0, 1, names)
    if not e.arguments:
        return class_count("RSV", part=names.session.part)
    found = names.bind(e.arguments[0])
    if not isinstance(found, b.Value) or not isinstance(found.value, str):
        names.session.refuse(f"{e.name}() takes the name of an abstraction", e.arguments[0].span)
    abstraction = abstraction_named(found.value, e.arguments[0].span, names.session)
    return class_count(abstraction, part=names.session.part)


def _whole_message(e: s.Call, names: SymbolTable) -> b.Bound:
    reason = "a message of a topic is not a value"
    names.session.refuse(
        reason, e.span, "write one of its fields: topic('/imu').angular_velocity.z"
    )


def _after_in(e: s.Call, names: SymbolTable) -> b.Bound:
    names.session.refuse(
        f"{e.name}() is allowed only after IN", e.span, f"write frame.class IN {e.name}('train')"
    )


def _predicate(e: s.Call, names: SymbolTable) -> b.Bound:
    session = names.session
    definition = session.predicates[normalize_name(e.name)]
    if isinstance(definition.body, s.SequenceClause):
        session.refuse(
            f"{definition.name} is a scenario, which is a sequence, not a condition",
            e.name_span,
            f"write MATCH {definition.name}()",
        )
    if definition.name in session.calls or len(session.calls) > MAX_CALLS:
        session.refuse(f"{definition.name}() is defined by itself", e.name_span)
    _expect(e, len(definition.parameters), len(definition.parameters), names)
    meanings = {
        formal.name: _meaning(argument, names)
        for formal, argument in zip(definition.parameters, e.arguments, strict=True)
    }
    session.calls.append(definition.name)
    try:
        found = names.body(meanings).bind(definition.body)
    except QueryError as error:
        reason = f"in {definition.name}(): {error.reason}"
        hint = error.hint or _signature(normalize_name(definition.name))
        raise type(error)(reason, text=session.text, span=e.span, hint=hint) from None
    finally:
        session.calls.pop()
    if not session.calls and (written := _written(e, session)):
        session.written[found] = written
    return found


def _written(e: s.Call, session: Session) -> str:
    """Return the text of a call, as the query or the library writes it."""
    if not session.shipped:
        return " ".join(session.text[e.span.start : e.span.end].split())
    names = [one.name for one in e.arguments if isinstance(one, s.Variable)]
    return f"{e.name}({', '.join(names)})" if len(names) == len(e.arguments) else ""


def _meaning(argument: s.Expression, names: SymbolTable) -> Symbol:
    found = names.bind(argument)
    return Symbol(node=found.node) if isinstance(found, b.NodeValue) else Symbol(value=found)


_FUNCTIONS: Final[dict[str, Callable[[s.Call, SymbolTable], b.Bound]]] = {
    **dict.fromkeys(PAIR_NAMES, _pair),
    **dict.fromkeys(map(normalize_name, OF_ONE), _of_one),
    **dict.fromkeys(NUMERIC, _numeric),
    **dict.fromkeys(EXTREMES, _extreme),
    **dict.fromkeys(OF_TWO, _of_two),
    **dict.fromkeys(OF_TEXT, _text_function),
    "classcount": _class_count,
    "coalesce": _coalesce,
    "inrange": _in_range,
    CLASSES: _after_in,
    "known": _known,
    "length": _path_function,
    "nodes": _path_function,
    "topic": _whole_message,
    "ttclane": _ttc_lane,
    "type": _type,
}
