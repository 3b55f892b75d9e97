"""Binder of expressions: resolves names, checks types, and corrects the spelling of names."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import QueryNameError, TextSpan
from sgstore.lang import ir as b
from sgstore.lang.bind._datasets import CLASSES, abstraction_named, seen_in
from sgstore.lang.bind._possible import check_comparison
from sgstore.lang.bind._precision import chosen, compared
from sgstore.lang.bind._symbols import RESERVED, Binders, SymbolTable, call_hint, of_type
from sgstore.lang.bind._text_tests import text_test
from sgstore.lang.catalog import (
    EDGE_ALIASES,
    EDGE_ATTRIBUTES,
    ENV_ATTRIBUTES,
    FOLLOWING,
    FRAME_ATTRIBUTES,
    NODE_ATTRIBUTES,
    PAIR_NAMES,
    RECORDED_OWN,
    TRACE_ATTRIBUTES,
    Attribute,
    DisplayUnit,
    Type,
    class_attribute,
    own_attribute,
)
from sgstore.lang.operators import TEXT_TESTS
from sgstore.lang.syntax import comparison_hint, hint_at, said_of
from sgstore.lang.syntax import tree as s
from sgstore.model.pair_numbers import COURSES
from sgstore.model.vocabulary import (
    CONTROL,
    KINDS,
    LANE_TYPES,
    entity_kinds,
    kind_named,
    kinds_labelled,
    known_names,
    labels,
    normalize_name,
    relation_named,
    suggestion,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence


MAX_NUMBER: Final = 1e300
"""Largest number allowed in a query."""

_ORDERED: Final = frozenset({"<", "<=", ">", ">="})


def _constant(e: s.Constant, _: SymbolTable) -> b.Value:
    return b.Value(e.value, _type_of(e.value))


def _type_of(value: object) -> Type:
    if value is None:
        return Type.null
    if isinstance(value, bool):
        return Type.boolean
    return Type.text if isinstance(value, str) else Type.number


def _parameter(e: s.Parameter, names: SymbolTable) -> b.Bound:
    value = parameter(e, names)
    if isinstance(value, list | tuple):
        return b.Choices(tuple(_checked(item, e, names) for item in value))
    return _checked(value, e, names)


def parameter(e: s.Parameter, names: SymbolTable) -> Any:
    """Return the value that the caller passes for a query parameter such as ``$limit``.

    Raises
    ------
    QueryNameError
        The parameter has no value.
    """
    session = names.session
    if e.name not in session.parameters:
        session.refuse(
            f"the parameter ${e.name} has no value",
            e.span,
            f"set it: find(…, {e.name}=…), or --param {e.name}=…",
        )
    session.used.add(e.name)
    return session.parameters[e.name]


def _checked(value: object, e: s.Parameter, names: SymbolTable) -> b.Value:
    if value is not None and not isinstance(value, bool | int | float | str):
        names.session.refuse(
            f"the parameter '{e.name}' is {type(value).__name__}; expected a number, a text, "
            "true or false, or a list of these",
            e.span,
        )
    if isinstance(value, int | float) and not abs(value) <= MAX_NUMBER:
        names.session.refuse(
            f"the parameter '{e.name}' is {value}; expected a number up to 1e300", e.span
        )
    if isinstance(value, int) and abs(value) >= 2**63:
        value = float(value)
    return b.Value(value, _type_of(value))


def _variable(e: s.Variable, names: SymbolTable) -> b.Bound:
    if e.name in RESERVED:
        hint = {
            "frame": "its id is frame.id",
            "env": "it has env.precipitation, env.fog, env.illumination, …",
        }.get(e.name, f"its name is {e.name}.name")
        names.session.refuse(f"'{e.name}' has attributes, but is not a value", e.span, hint)
    if e.name in names.aliases:
        return names.aliases[e.name]
    meaning = names.meaning(e.name)
    if meaning is not None and meaning.value is not None:
        return meaning.value
    if meaning is not None and meaning.edge is not None:
        names.session.refuse(f"'{e.name}' is an edge; its relation is type({e.name})", e.span)
    return b.NodeValue(names.node(e.name, e.span))


def _attribute(e: s.AttributeOf, names: SymbolTable) -> b.Bound:
    owner = e.owner.name
    if owner in RESERVED and names.meaning(owner) is None:
        known, make = _OF_RESERVED[owner]
        found = known.get(normalize_name(e.name))
        if found is None and owner == "frame":
            found = _class_attribute(e.name, names)
        if found is None and owner == "frame" and e.name.startswith("class_"):
            abstraction_named(e.name.removeprefix("class_"), _tail(e), names.session)
        if found is None:
            known_names = [attribute.name.removeprefix("env.") for attribute in known.values()]
            if owner == "frame":
                known_names += [f"class_{name}" for name in names.session.classed]
            hint = _hint_elsewhere(e.name, known_names)
            names.session.unknown(f"attribute of {owner}", e.name, _tail(e), known_names, hint)
        return make(found, found.type)
    meaning = names.meaning(owner)
    if meaning is None and owner in names.session.tables:
        return _column(e, names)
    if meaning is not None and meaning.edge is not None:
        return edge_attribute(meaning.edge, e.name, _tail(e), names)
    return node_attribute(names.node(owner, e.owner.span), e.name, _tail(e), names)


def _hint_elsewhere(name: str, known: Sequence[str]) -> str | None:
    """If nodes or the query language have the unknown attribute name, return a hint; otherwise None."""
    if (hint_at(name, known) or "").startswith("did"):
        return None
    if normalize_name(name) in NODE_ATTRIBUTES:
        return f"it is an attribute of nodes, such as ego.{name}"
    return said_of("attributes", name)


def _column(e: s.AttributeOf, names: SymbolTable) -> b.FrameAttribute:
    """Return the resolved expression for a column of a user table: its value for the frame."""
    table, session = names.session.tables[e.owner.name], names.session
    found = table.attribute(e.name)
    if found is None:
        session.unknown(f"column of {table.name}", e.name, _tail(e), table.columns)
    if table.refused:
        session.refuse(
            f"the columns of {table.name} are not attributes of frames: it has {table.refused}",
            e.span,
            "join it in SQL with its own columns",
        )
    return b.FrameAttribute(found, found.type, names.session.online)


def _class_attribute(name: str, names: SymbolTable) -> Attribute | None:
    """If a name is ``class_X``, return the attribute "class of the frame in abstraction X"; otherwise None.

    Its other spelling is ``class('NAME')``.
    """
    of = (
        one
        for one in names.session.classed
        if normalize_name(f"class_{one}") == normalize_name(name)
    )
    found = next(of, None)
    return None if found is None else class_attribute(found)


_OF_RESERVED: Final[dict[str, tuple[Mapping[str, Attribute], Callable[..., b.Bound]]]] = {
    "env": (ENV_ATTRIBUTES, b.FrameAttribute),
    "frame": (FRAME_ATTRIBUTES, b.FrameAttribute),
    "trace": (TRACE_ATTRIBUTES, b.TraceAttribute),
}


def _tail(e: s.AttributeOf) -> TextSpan:
    return TextSpan(e.span.end - len(e.name), e.span.end)


def node_attribute(key: str, name: str, span: TextSpan, names: SymbolTable) -> b.NodeAttribute:
    """Return the resolved expression for an attribute of a node, such as ``v.speed``.

    Raises
    ------
    QueryNameError
        Unknown attribute, or not an attribute of these kinds.
    """
    kinds = names.scope.kinds(key).every
    own = names.session.own
    possible = [a.name for a in NODE_ATTRIBUTES.values() if a.kinds & kinds]
    possible += [one for one in own if one not in RECORDED_OWN]
    found = NODE_ATTRIBUTES.get(normalize_name(name)) or _own_attribute(name, names.session.own)
    if found is None and names.session.online and name.startswith(CONTROL):
        found = own_attribute(name, Type.number)  # A client can command any key.
    if found is None:
        hint = said_of("attributes", name) or _no_attribute(name)
        like = suggestion(name, [*possible, *RECORDED_OWN])
        hint = hint or (f"did you mean '{like}'?" if like in RECORDED_OWN else None)
        names.session.unknown("attribute", name, span, possible, hint)
    if not found.kinds & kinds:
        what = " or ".join(sorted(kinds)) if len(kinds) <= 3 else "node of these kinds"
        owners = [kind for kind in KINDS if kind in found.kinds]
        hint = hint_at(name, possible)
        if found.name in COURSES and kinds <= entity_kinds():
            hint = f"for the lane of the entity, write the function {found.name}(x)"
        elif "lane" in owners and kinds <= entity_kinds():
            hint = f"write its lane as a node: (x)-[:isIn]->(l:Lane), l.{found.name}"
        elif hint is None or not hint.startswith("did"):
            hint = f"it belongs to: {', '.join(owners)}"
        raise QueryNameError(
            f"a {what} has no attribute '{found.name}'",
            text=names.session.text,
            span=span,
            hint=hint,
        )
    return b.NodeAttribute(key, found, found.type, names.session.online)


def _own_attribute(name: str, own: Mapping[str, Type]) -> Attribute | None:
    """Return the user-defined attribute with this name, or None.

    An exact spelling wins over one that ignores case and underscores.
    """
    wanted = normalize_name(name)
    same = next((one for one in own if normalize_name(one) == wanted), None)
    spelled = name if name in own else same
    return None if spelled is None else own_attribute(spelled, own[spelled])


def _no_attribute(name: str) -> str | None:
    """If an unknown attribute name is a relation or a predicate, return a hint; otherwise None."""
    if relation_named(name):
        return f"it is a relation: EXISTS {{(a)-[:{name}]->(b)}}"
    return call_hint(name)


FOLLOWED: Final = tuple(frozenset({relation}) for relation in FOLLOWING)


def edge_attribute(key: str, name: str, span: TextSpan, names: SymbolTable) -> b.EdgeAttribute:
    """Return the resolved expression for an attribute of an edge.

    Raises
    ------
    QueryNameError
        Unknown attribute.
    QueryError
        The edge cannot have the attribute. Built-in attributes need a single relation: ``isIn``, or a
        directed ``leads`` or ``follows``. User-defined attributes need a single directed edge.
    """
    found = EDGE_ATTRIBUTES.get(EDGE_ALIASES.get(normalize_name(name), normalize_name(name)))
    found = found or _own_attribute(name, names.session.own_edges)
    if found is None:
        known = [one.name for one in EDGE_ATTRIBUTES.values()] + [*names.session.own_edges]
        hint = (
            f"{name}(a, b) is a number of two nodes" if normalize_name(name) in PAIR_NAMES else None
        )
        if normalize_name(name) in {"type", "label", "relation", "name", "kind"}:
            hint = "the relation of an edge d is type(d)"
        names.session.unknown("attribute of an edge", name, span, known, hint)
    edge = next((edge for edge in names.scope.edges if edge.key == key), None)
    if edge is None:
        names.session.refuse("an edge can be used only in the pattern that binds it", span)
    if found.unit is DisplayUnit.own:
        if edge.high > 1 or edge.both:
            names.session.refuse(
                f"only a single directed edge has '{found.name}'", span, "write -[…]->"
            )
    elif found.name == "gap":
        if not (edge.relations in FOLLOWED and edge.high == 1 and not edge.both):
            names.session.refuse(
                "only a directed edge of one relation, leads or follows, has 'gap'",
                span,
                "write -[:follows]->",
            )
    elif edge.relations != frozenset({"isIn"}) or edge.high > 1:
        names.session.refuse(
            f"only isIn edges from an entity to a lane have '{found.name}'",
            span,
            "write -[:isIn]->",
        )
    return b.EdgeAttribute(key, found, found.type, names.session.online)


def _list(e: s.ListOf, names: SymbolTable) -> b.Choices:
    items = [names.bind(item) for item in e.items]
    for item, written in zip(items, e.items, strict=True):
        if not isinstance(item, b.Value):
            names.session.refuse("a list can contain only constants and parameters", written.span)
    return b.Choices(tuple(item for item in items if isinstance(item, b.Value)))


def _logic(e: s.Logic, names: SymbolTable) -> b.Operation:
    if e.word == "IMPLIES" and "=>" in _between(e.operands, names):
        first = names.bind(e.operands[0])
        if first.type is Type.number:
            names.session.refuse("=> is IMPLIES, between conditions", e.span, "at least is >=")
    operands = tuple(names.condition(operand) for operand in e.operands)
    return b.Operation(e.word, operands, Type.boolean)


def _between(operands: tuple[s.Expression, ...], names: SymbolTable) -> str:
    """Return the query text between two operands. It contains the operator."""
    return names.session.text[operands[0].span.end : operands[1].span.start]


def _comparison(e: s.Comparison, names: SymbolTable) -> b.Bound:
    left, right = names.bind(e.left), names.bind(e.right)
    left, right = of_type(left, right.type), of_type(right, left.type)
    if left.type is right.type is Type.open and e.word in _ORDERED:
        left, right = of_type(left, Type.number), of_type(right, Type.number)
    if e.word in TEXT_TESTS:
        left = of_type(left, Type.text)
        return text_test(e, left, right, names)
    _check_sides(e, left, right, names)
    if left.type is not right.type:
        texts = [side.value for side in (left, right) if isinstance(side, b.Value)]
        hint = _of_sides(e, left, right, names)
        names.session.refuse(
            f"a {left.type.value} cannot be compared with a {right.type.value}",
            e.span,
            hint or comparison_hint(left.type, right.type, texts),
        )
    if e.word in _ORDERED and left.type in {Type.node, Type.boolean}:
        names.session.refuse(f"a {left.type.value} has no order", e.span)
    closed = next((side for side in (left, right) if _vocabulary(side)), None)
    if e.word in _ORDERED and closed is not None:
        words = ", ".join(f"'{word}'" for word in _vocabulary(closed)[:2])
        names.session.refuse(
            f"the values of {_what(closed)} have no order", e.span, f"write IN [{words}, …]"
        )
    left, right = (
        _canonical(left, right, e.left.span, names),
        _canonical(right, left, e.right.span, names),
    )
    found = b.Operation(e.word, compared(left, right), Type.boolean)
    return check_comparison(e, found, names)


def _check_sides(e: s.Comparison, left: b.Bound, right: b.Bound, names: SymbolTable) -> None:
    """Raise an error if a comparison has NULL or a list on one side."""
    prop = isinstance(e.left, s.Variable) and not e.left.name
    where = "in place of the property, behind WHERE: x." if prop else ""
    if prop:
        where += names.session.text[e.left.span.start : e.left.span.end]
    for side, written in ((left, e.left), (right, e.right)):
        if side.type is Type.null:
            hint = f"{where} IS NULL" if prop else "write IS NULL"
            names.session.refuse("a comparison with NULL is never true", written.span, hint)
        if side.type is Type.list:
            hint = f"{where} IN […]" if prop else "write IN"
            collected = isinstance(side, b.Aggregate) or b.is_passed_on(side)
            names.session.refuse(
                "a list cannot be compared", written.span, None if collected else hint
            )


def _of_sides(e: s.Comparison, left: b.Bound, right: b.Bound, names: SymbolTable) -> str | None:
    """If the sides of a comparison have different types, return a hint; otherwise None."""
    for written, side, other in ((e.left, left, right), (e.right, right, left)):
        if isinstance(written, s.Parameter):
            return f"${written.name} is the {side.type.value} {names.session.parameters[written.name]!r}"
        if isinstance(written, s.AttributeOf) and written.owner.name in names.session.tables:
            return f"the column {written.name} of your table holds {side.type.value}s"
        if (hint := _of_name(written, side, other, names)) is not None:
            return hint
    return None


def _of_name(e: s.Expression, side: b.Bound, other: b.Bound, names: SymbolTable) -> str | None:
    """If a query compares an id with a text, return the hint to use the attribute ``name``; otherwise None."""
    of_trace = isinstance(side, b.TraceAttribute)
    ids = isinstance(side, b.NodeAttribute | b.TraceAttribute) and side.attribute.name in {
        "id",
        "trace.id",
    }
    if not ids or other.type is not Type.text or not isinstance(e, s.AttributeOf):
        return None
    kinds = sorted(names.scope.kinds(side.node).every) if isinstance(side, b.NodeAttribute) else []
    what = "trace" if of_trace else kinds[0] if len(kinds) == 1 else "node"
    return f"the name of a {what} is {e.owner.name}.name"


def _canonical(value: b.Bound, other: b.Bound, span: TextSpan, names: SymbolTable) -> b.Bound:
    """Return a compared text in its standard spelling, if the attribute has a fixed list of values."""
    known = _vocabulary(other)
    if not known or not isinstance(value, b.Value) or not isinstance(value.value, str):
        return value
    by_folded = {normalize_name(word): word for word in reversed(known)}
    exact = value.value if value.value in known else None
    word = exact or by_folded.get(normalize_name(value.value))
    if word is None and isinstance(other, b.NodeAttribute) and other.attribute.name == "kind":
        word = _kind(value.value, span, names)
    if word is None:
        lane = "for a lane, write l.type" if value.value in LANE_TYPES else None
        hint = lane or (said_of("labels", value.value) if _what(other) == "kind" else None)
        names.session.unknown(_what(other), value.value, span, known, hint)
    return b.Value(word, Type.text, closed=True)


def _vocabulary(expression: b.Bound) -> Sequence[str]:
    match expression:
        case b.NodeAttribute(attribute=attribute) | b.FrameAttribute(attribute=attribute):
            return known_names(attribute.enum) if attribute.enum else attribute.values
        case b.EdgeRelation():
            return sorted(known_names("relation"))
        case _:
            return ()


def _what(expression: b.Bound) -> str:
    named = isinstance(expression, b.NodeAttribute | b.FrameAttribute)
    return expression.attribute.name if named else "relation"


def _kind(word: str, span: TextSpan, names: SymbolTable) -> str | None:
    kind, kinds = kind_named(word), kinds_labelled(word)
    if kind is None and kinds:
        label = next(label for label in labels() if normalize_name(label) == normalize_name(word))
        names.session.refuse(f"'{word}' is several kinds", span, f"use it as a label: (x:{label})")
    return kind


def _null_test(e: s.NullTest, names: SymbolTable) -> b.Operation:
    operand = names.bind(e.operand)
    maybe = isinstance(operand, b.NodeValue) and operand.node in names.session.maybe
    if operand.type in {Type.node, Type.list} and not maybe:
        hint = "write EXISTS {…} for an optional node" if operand.type is Type.node else None
        names.session.refuse(f"a {operand.type.value} is never NULL", e.operand.span, hint)
    word = "IS NOT NULL" if e.negated else "IS NULL"
    return b.Operation(word, (operand,), Type.boolean)


def _membership(e: s.Membership, names: SymbolTable) -> b.Bound:
    operand = names.bind(e.operand)
    if isinstance(e.choices, s.Call) and normalize_name(e.choices.name) == CLASSES:
        found = _in_dataset(operand, e.choices, names)
        return b.Operation("NOT", (found,), Type.boolean) if e.negated else found
    choices = names.bind(e.choices)
    if (items := b.items_of(choices)) is not None and items is operand.type:
        listed = b.Operation("is in", (operand, choices), Type.boolean)
        return b.Operation("NOT", (listed,), Type.boolean) if e.negated else listed
    if not isinstance(choices, b.Choices):
        hint = "write IN ['a', 'b']"
        if isinstance(e.choices, s.Parameter):
            hint = f"give ${e.choices.name} a list: find(…, {e.choices.name}=['a', 'b'])"
        if choices.type is Type.text and not isinstance(choices, b.Value):
            hint = "write x.name CONTAINS 'a' to search in a text"
        names.session.refuse("expected a list after IN", e.choices.span, hint)
    operand = of_type(operand, choices.items[0].type if choices.items else Type.text)
    for item in choices.items:
        if item.type is Type.null:
            names.session.refuse("NULL cannot be in a list", e.choices.span)
        if item.type is not operand.type:
            names.session.refuse(
                f"a {operand.type.value} cannot be in a list with a {item.type.value}",
                e.span,
                comparison_hint(operand.type, item.type, [item.value]),
            )
    items = tuple(_canonical(item, operand, e.choices.span, names) for item in choices.items)
    canonical = b.Choices(tuple(item for item in items if isinstance(item, b.Value)))
    found: b.Bound = b.Operation("IN", chosen(operand, canonical), Type.boolean)
    found = check_comparison(e, found, names)
    return b.Operation("NOT", (found,), Type.boolean) if e.negated else found


def _in_dataset(operand: b.Bound, e: s.Call, names: SymbolTable) -> b.FrameAttribute:
    """Return the resolved condition ``frame.class IN dataset_classes('train')``.

    A second argument of the function must repeat the abstraction.
    """
    session = names.session
    if (
        not isinstance(operand, b.FrameAttribute)
        or operand.attribute.unit is not DisplayUnit.classed
    ):
        session.refuse("a dataset has only frame classes", e.span, "write frame.class IN …")
    texts = [names.bind(argument) for argument in e.arguments]
    words = [t.value for t in texts if isinstance(t, b.Value) and isinstance(t.value, str)]
    if not 1 <= len(words) == len(texts) <= 2:
        session.refuse(
            f"{e.name}() takes the name of a dataset and, optionally, of an abstraction", e.span
        )
    if len(words) == 2:
        (mine,) = operand.attribute.columns.values()
        if abstraction_named(words[1], e.arguments[1].span, session) != mine:
            session.refuse(
                f"classes of {mine} cannot be compared with classes of {words[1]}",
                e.span,
                f"write frame.class('{words[1]}')",
            )
    return seen_in(operand, words[0], e.arguments[0].span, session)


def _case(e: s.Case, names: SymbolTable) -> b.Operation:
    """Return a ``CASE`` with resolved names: condition and value of each branch, then the ``ELSE`` value."""
    operands: list[b.Bound] = []
    written = [branch.value for branch in e.branches]
    written += [e.otherwise] if e.otherwise is not None else []
    values = [names.bind(value) for value in written]
    known = [
        (value, at)
        for value, at in zip(values, written, strict=True)
        if value.type is not Type.null
    ]
    for value, at in known:
        if value.type in {Type.node, Type.list}:
            hint = f"one of its attributes: {at.name}.name" if isinstance(at, s.Variable) else None
            names.session.refuse(f"CASE cannot return a {value.type.value}", at.span, hint)
        if value.type is not known[0][0].type:
            names.session.refuse(
                f"CASE has values of one type, and this is a {value.type.value} beside a"
                f" {known[0][0].type.value}",
                at.span,
                comparison_hint(known[0][0].type, value.type, _constants(values)),
            )
    for branch, value in zip(e.branches, values, strict=False):
        operands += [names.condition(branch.condition), value]
    operands.append(values[-1] if e.otherwise is not None else b.Value(None, Type.null))
    return b.Operation("case", tuple(operands), known[0][0].type if known else Type.null)


def _constants(values: Sequence[b.Bound]) -> list[object]:
    return [value.value for value in values if isinstance(value, b.Value)]


def _arithmetic(e: s.Arithmetic, names: SymbolTable) -> b.Bound:
    result = names.number(e.first)
    for sign, term in e.rest:
        result = b.Operation(sign, (result, names.number(term)), Type.number)
    return result


def _negative(e: s.Negative, names: SymbolTable) -> b.Bound:
    operand = names.number(e.operand)
    if isinstance(operand, b.Value) and isinstance(operand.value, int | float):
        return b.Value(-operand.value, Type.number)
    return b.Operation("negative", (operand,), Type.number)


def _count_all(e: s.CountAll, names: SymbolTable) -> b.Aggregate:
    if names.aggregated:
        names.session.refuse("an aggregate cannot contain another aggregate", e.span)
    if not names.aggregates:
        names.session.refuse(
            "COUNT(*) is allowed only after RETURN", e.span, "write COUNT {…} in a condition"
        )
    return b.Aggregate("count", None, distinct=False, type=Type.number)


BINDERS: Final[Binders] = {
    s.Constant: _constant,
    s.Parameter: _parameter,
    s.Variable: _variable,
    s.AttributeOf: _attribute,
    s.CountAll: _count_all,
    s.ListOf: _list,
    s.Logic: _logic,
    s.Comparison: _comparison,
    s.NullTest: _null_test,
    s.Membership: _membership,
    s.Arithmetic: _arithmetic,
    s.Negative: _negative,
    s.Case: _case,
}
"""Binders of basic expressions. :data:`~sgstore.lang.bind._patterns.ALL_BINDERS` adds those of calls, blocks
and time."""
