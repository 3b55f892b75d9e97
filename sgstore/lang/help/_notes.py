"""Notes on likely mistakes in a query: texts that no stored value equals, parts that no frame has.

A misspelt name finds nothing, without an error. So the notes list the texts that are not values in the store,
each with the nearest value. The compiler finds the comparisons. The caller looks the texts up in the store.
If nothing matches, a note names the first part of the pattern that no frame has.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.quoting import quoted
from sgstore.lang import ir as b
from sgstore.lang.catalog import Home
from sgstore.lang.help._pattern_text import Writer
from sgstore.lang.help._why_not import growing, part_text
from sgstore.lang.sql import Select, nested
from sgstore.model.vocabulary import entity_kinds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.lang.ir import BoundCheck

    Ask = Callable[[str, list[object]], Sequence[tuple[Any, ...]]]


_ENTITY_NAMES: Final = ("kind || ' ' || node_id", "entity")
_TEXTS_OF: Final[dict[str, tuple[tuple[str, ...], ...]]] = {
    "name": (_ENTITY_NAMES, ("name", "map_node")),
    "ident": (("ident", "entity"),),
    "type": (("type_name", "entity"), ("lane_type", "map_node")),
    "type_name": (("type_name", "entity"),),
    "subkind": (("subkind", "entity"),),
    "lane_type": (("lane_type", "map_node"),),
    "road": (("road", "map_node"), ("name", "map_node", "kind = 'road'")),
    "junction": (("junction", "map_node"), ("name", "map_node", "kind = 'junction'")),
    "role": (("role", "lane_role"),),
    "trace.name": (("name", "trace"),),
    "trace.uri": (("uri", "recording"),),
    "trace.flavour": (("flavour", "trace"),),
    "trace.ego": (("ego", "trace"),),
    "trace.map": (("name", "map"),),
}
"""Places of attributes with texts from recordings: column, table, and condition on its rows."""

Compared = tuple[str, str]
"""Attribute, and a text that it is compared with."""


def compared_in_query(query: b.Query) -> list[Compared]:
    """Return all comparisons of an attribute with a text in a query, without duplicates."""
    returned = [column.value for column in query.result.columns]
    found = list(_comparisons(returned, query.scope))
    for scope in () if query.steps else query.patterns:
        found += _comparisons(scope.where, scope)
    for stage in query.stages:
        if isinstance(stage, b.WithStage):
            found += _comparisons(stage.expressions, stage.after)
    for step in query.steps:
        found += _comparisons([*step.scope.where, *step.when], step.scope)
    return list(dict.fromkeys(found))


def compared_in_check(check: BoundCheck) -> list[Compared]:
    """Return all comparisons of an attribute with a text in a check, without duplicates."""
    values = [check.formula, *(one.where for one in check.quantifiers if one.where is not None)]
    values += [check.reset] if check.reset is not None else []
    return list(dict.fromkeys(_comparisons([*values, *check.scope.where], check.scope)))


def _comparisons(values: Iterable[b.Bound], scope: b.Scope) -> Iterator[Compared]:
    for value in values:
        for part in b.walk(value):
            match part:
                case b.BlockValue(scope=inner):
                    yield from _comparisons(part.inside, inner)
                case b.Operation(word="=" | "<>", operands=(left, right)):
                    yield from _texts(left, (right,), scope)
                    yield from _texts(right, (left,), scope)
                case b.Operation(word="IN", operands=(operand, b.Choices(items=items))):
                    yield from _texts(operand, items, scope)
                case _:
                    pass


def _texts(attribute: b.Bound, values: Iterable[b.Bound], scope: b.Scope) -> Iterator[Compared]:
    match attribute:
        case b.NodeAttribute(node=node, attribute=about):
            name = about.name
            if name == "type" and (node in scope.nodes or node in scope.outer):
                name = _type_of(scope.kinds(node))
        case b.TraceAttribute(attribute=about):
            name = f"trace.{about.name}"
        case _:
            return
    if name in _TEXTS_OF:
        for value in values:
            if isinstance(value, b.Value) and isinstance(value.value, str):
                yield name, value.value


def _type_of(kinds: b.Kinds) -> str:
    if "lane" not in kinds.every:
        return "type_name"
    return "type" if kinds.every & entity_kinds() else "lane_type"


def notes_on(
    compared: Iterable[Compared], query: str, parameters: Mapping[str, object], ask: Ask
) -> tuple[str, ...]:
    """Return a note on each text in a query that equals no value of the attribute in the store.

    Parameters
    ----------
    compared : iterable of (str, str)
    query : str
        Text of the query. Notes cover only texts that occur in it or in a parameter. The predicates of the
        library name values, such as lane types, that few stores have.
    parameters : mapping
    ask : function
        Function that runs a statement with its values and returns the rows.
    """
    written = f"{query} {[*parameters.values()]}"
    return tuple(
        _note(name, text, ask)
        for name, text in compared
        if text in written and not _there(name, text, ask)
    )


def _there(name: str, text: str, ask: Ask) -> bool:
    there = Select(["1"], [nested(_all_values(name), "v")], ['"v"."value" = $1'], limit=1)
    return bool(ask(there.text(), [text]))


def _note(name: str, text: str, ask: Ask) -> str:
    said = f"the store has no {name} {text!r}"
    for other in _TEXTS_OF:
        alike = other.startswith("trace.") == name.startswith("trace.") and other != name
        if alike and other != "type" and _there(other, text, ask):
            return f"{said}; it is a value of {other}"
    # A difference in case is the smallest mistake.
    near = 'levenshtein(lower("v"."value"), lower($1)), levenshtein("v"."value", $1), "v"."value"'
    nearest = Select([near], [nested(_all_values(name), "v")], order=[near], limit=1)
    rows = ask(nearest.text(), [text])  # a row of each store of a collection
    return f"{said}; the nearest is {min(rows)[-1]!r}" if rows else f"{said}, nor any {name}"


def _all_values(name: str) -> str:
    """Return SQL that selects the different values of an attribute in the store."""
    places = (
        Select([f'{column} AS "value"'], [table], [f"({column}) IS NOT NULL", *where])
        for column, table, *where in _TEXTS_OF[name]
    )
    return "\nUNION ALL\n".join(place.text() for place in places)


def absent_part(query: b.Query, exists: Callable[[b.Scope], bool]) -> tuple[str, ...]:
    """If no frame of the store has some part of a query, return a note on the first such part.

    Parameters
    ----------
    query : Query
    exists : function
        Function that returns True if some frame of the store matches a pattern.
    """
    for part, scope, writer, held in _first_absent(query, exists, query.calls):
        text = part_text(part, scope, writer)
        if isinstance(part, b.Edge):
            text = writer.labelled_edge(part, scope)
        others = f" with {', '.join(held)}" if held and exists(_alone(part, scope)) else ""
        told = isinstance(part, b.Node | b.Edge) or _is_scene(part)
        return (f"no frame of the store has {text}{others}",) if told else ()
    return ()


def _first_absent(
    query: b.Query, exists: Callable[[b.Scope], bool], calls: b.Calls
) -> Iterator[tuple[b.Node | b.Edge | b.Bound, b.Scope, Writer, list[str]]]:
    """Yield the first part that no frame matches, the pattern up to it, a text writer and earlier parts.

    The calls of predicates in ``calls`` are one part each.
    """
    steps = [query.steps[number].scope for number in sorted(query.certain)] if query.steps else []
    for step in steps or [query.first]:
        where = [part for part in step.where if not any(map(b.is_passed_on, b.walk(part)))]
        whole = replace(step, where=tuple(where))
        if not whole.nodes or exists(whole):
            continue
        writer, held = Writer(whole, calls), list[str]()
        for part, scope in growing(whole, calls):
            if not exists(scope):
                # A node is also in the edges.
                yield (
                    part,
                    scope,
                    writer,
                    [one for one in held if not any(one in o for o in held if o != one)],
                )
                return
            edge = isinstance(part, b.Edge)
            held.append(
                writer.labelled_edge(part, scope) if edge else part_text(part, scope, writer)
            )
        return


def nearest_query(
    query: b.Query, exists: Callable[[b.Scope], bool]
) -> tuple[str, list[str], str, str] | None:
    """Return a query for the frame that comes nearest to the first part that no frame matches.

    Parameters
    ----------
    query : Query
    exists : function
        Function that returns True if some frame of the store matches a pattern.

    Returns
    -------
    failed : str
        The part that no frame has, as written in the query.
    others : list of str
        The parts before it, if frames have it without them; otherwise empty.
    value : str
        The value of the part that is compared; empty if the part compares no values.
    text : str
        The query for a frame that has the parts before; empty if the part is a node. Its columns are trace,
        frame and value.
    """
    for part, scope, writer, held in _first_absent(query, exists, query.calls):
        failed = part_text(part, scope, writer)
        others = held if held and exists(_alone(part, scope)) else []
        if part in query.calls and isinstance(part, b.Operation) and part.word == "AND":
            for inner, wider, other, _ in _first_absent(query, exists, {}):  # its first false part
                return failed, others, *_nearest(inner, wider, other)
        return failed, others, *_nearest(part, scope, writer.expanded())
    return None


def _nearest(part: b.Node | b.Edge | b.Bound, scope: b.Scope, writer: Writer) -> tuple[str, str]:
    """For the last part of a pattern, return the compared value, and a query for the frame nearest to it."""
    value, limit, others = "", "", replace(scope, where=scope.where[:-1])
    match part:
        case b.Node():
            return "", ""
        case b.Operation(word="<" | "<=" | ">" | ">=" | "=", operands=(left, right)):
            if isinstance(left, b.Value):
                left, right = right, left
            value, limit = (writer.expression(one, inner=True) for one in (left, right))
        case b.Edge(src=src, dst=dst, high=1) if src != dst:
            value = f"dist({writer.name(src)}, {writer.name(dst)})"
            limit, others = "0", replace(scope, edges=scope.edges[:-1])
        case b.Edge():
            others = replace(scope, edges=scope.edges[:-1])
        case _:
            pass
    shown = f"RETURN trace.name, frame.seq, {value or 'NULL'} AS found"
    order = f" ORDER BY ABS({value} - {limit})" if value else ""
    return value, f"MATCH {writer.block(others)} {shown}{order} LIMIT 1"


def _is_scene(condition: b.Bound) -> bool:
    """True if a condition requires something in the scene. Absences, ids and texts do not count."""
    match condition:
        case b.Operation(operands=(b.NodeAttribute(attribute=one), _)) if one.name == "id":
            return False
        case b.Operation(word="AND", operands=parts):
            return any(map(_is_scene, parts))
        case b.Operation(word=word):
            return word in {"<", "<=", ">", ">=", "=", "OR"}
        case b.BlockValue() | b.NodeAttribute() | b.EdgeAttribute():
            return True
        case _:
            return False


def _alone(part: b.Node | b.Edge | b.Bound, scope: b.Scope) -> b.Scope:
    """Return a pattern with only one part of a given pattern, and the nodes and edges that it uses."""
    edges = [part] if isinstance(part, b.Edge) else []
    if isinstance(part, b.Node):
        keys = {part.key}
    elif isinstance(part, b.Edge):
        keys = {part.src, part.dst}
    else:
        used = b.edges_of(part)
        edges = [edge for edge in scope.edges if edge.key in used]
        keys = {*b.nodes_of(part), *(end for edge in edges for end in (edge.src, edge.dst))}
        keys = keys or set(list(scope.nodes)[:1])  # a pattern has a node
    nodes = {key: node for key, node in scope.nodes.items() if key in keys}
    distinct = frozenset(pair for pair in scope.distinct if {*pair} <= keys)
    where = () if isinstance(part, b.Node | b.Edge) else (part,)
    return b.Scope(nodes, {}, tuple(edges), where, distinct)


def unknown_in_or(query: b.Query, ask: Ask) -> tuple[str, ...]:
    """Return a note on each attribute in an ``OR`` that has no known value. Unknown counts as false there."""
    conditions = [one for scope in query.patterns for one in scope.where]
    either = [part for one in conditions for part in b.walk(one) if _is_or(part)]
    used = [leaf for part in either for leaf in b.walk(part) if isinstance(leaf, b.NodeAttribute)]
    columns = {leaf.attribute.name: leaf.attribute.columns.get(Home.state) for leaf in used}
    return tuple(
        f"{name} is unknown for all entities of the store; a condition on it in OR counts as false"
        for name, column in columns.items()
        if column is not None
        and not ask(
            Select(["1"], ['"state"'], [f"{quoted(column)} IS NOT NULL"], limit=1).text(), []
        )
    )


def _is_or(part: b.Bound) -> bool:
    return isinstance(part, b.Operation) and part.word == "OR"
