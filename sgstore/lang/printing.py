"""The stages of the compiler as text, for ``--explain``."""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang.bound import (
    ANY,
    ANY_RELATION,
    Aggregate,
    BlockValue,
    Bound,
    Choices,
    Course,
    EdgeAttribute,
    EdgeRelation,
    FrameAttribute,
    Kinds,
    LabelTest,
    Moment,
    NodeAttribute,
    NodeValue,
    Operation,
    PairNumber,
    Query,
    Scope,
    Tense,
    TraceAttribute,
    Value,
)
from sgstore.vocabulary import ENTITY_KINDS, KINDS, RELATIONS

if TYPE_CHECKING:
    from sgstore.lang.bound import Edge
    from sgstore.lang.syntax import Statement

_PLACES: Final = frozenset({"span", "name_span"})
_INFIX: Final = frozenset(
    {"AND", "OR", "XOR", "IMPLIES", "=", "<>", "<", "<=", ">", ">=", "IN"}
    | {"+", "-", "*", "/", "%", "STARTS WITH", "ENDS WITH", "CONTAINS", "=~"}
)


def tree_text(part: Any) -> str:
    """A syntax tree, one part a line; places in the text and what is absent are left out."""
    return "\n".join(_tree(part, ""))


def _tree(part: Any, indent: str) -> list[str]:
    if not is_dataclass(part) or isinstance(part, type):
        return [f"{indent}{part!r}"]
    lines = [indent + type(part).__name__]
    for field in fields(part):
        value = getattr(part, field.name)
        if field.name in _PLACES or value in (None, (), False):
            continue
        inner = value if isinstance(value, tuple) else (value,)
        if any(is_dataclass(item) for item in inner):
            lines.append(f"{indent}  {field.name}:")
            lines += [line for item in inner for line in _tree(item, indent + "    ")]
        else:
            lines[0] += f" {field.name}={value!r}"
    return lines


def statements_text(statements: tuple[Statement, ...]) -> str:
    """The syntax trees of a text."""
    return "\n".join(tree_text(statement) for statement in statements)


def query_text(query: Query) -> str:
    """A bound query: what may be bound to what, under which conditions."""
    lines = _scope(query.scope, "")
    result = query.result
    shown = [f"{column.name} = {value_text(column.value)}" for column in result.columns]
    lines.append(f"return {result.form}" + (f": {', '.join(shown)}" if shown else ""))
    if query.ego is not None:
        lines.append(f"ego {query.ego!r}")
    return "\n".join(lines)


def _scope(scope: Scope, indent: str) -> list[str]:
    lines = [
        f"{indent}node {node.key}: {kinds_text(node.kinds)}"
        + ("" if node.role == "named" else f" ({node.role})")
        for node in scope.nodes.values()
    ]
    lines += [f"{indent}outside {key}: {kinds_text(kinds)}" for key, kinds in scope.outer.items()]
    lines += [f"{indent}edge {edge.key}: {edge_text(edge)}" for edge in scope.edges]
    lines += [f"{indent}where {value_text(condition, indent)}" for condition in scope.where]
    pairs = ", ".join(f"{a} ≠ {b}" for a, b in sorted(scope.distinct))
    return [*lines, f"{indent}distinct {pairs}"] if pairs else lines


def edge_text(edge: Edge) -> str:
    """An edge between the keys of its nodes."""
    some = [relation for relation in RELATIONS if relation in edge.relations]
    label = "any" if edge.relations == ANY_RELATION else "|".join(some)
    times = "" if edge.high == 1 else f"*{edge.low}..{edge.high}"
    arrow = "-" if edge.both else "->"
    return f"({edge.src})-[{label}{times}]{arrow}({edge.dst})"


def kinds_text(kinds: Kinds) -> str:
    """What a node may be."""
    if kinds == ANY:
        return "anything"
    entities = frozenset(ENTITY_KINDS)
    if not kinds.other:
        which = "" if kinds.ego == entities else f", a {_kinds(kinds.ego)}"
        return "the ego" + which
    without = "" if kinds.ego == kinds.other & entities else ", not the ego"
    if kinds.ego - kinds.other:
        without = ", or the ego"
    return _kinds(kinds.other) + without


def _kinds(kinds: frozenset[str]) -> str:
    return "|".join(kind for kind in KINDS if kind in kinds) or "nothing"


def unnumbered_text(value: Bound) -> str:
    """An expression as :func:`value_text` prints it, without the numbers that tell unnamed nodes apart."""
    return _NUMBERED.sub(lambda found: "#" if found[0][0] == "#" else found[0], value_text(value))


_NUMBERED: Final = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|#\d+""")
"""Texts, which are left as they are, and numbers of nodes."""


def value_text(value: Bound, indent: str = "") -> str:  # noqa: PLR0911 - a case each
    """An expression, nearly as one would write it."""
    match value:
        case Value(value=constant):
            return "NULL" if constant is None else repr(constant)
        case Choices(items=items):
            return "[" + ", ".join(value_text(item) for item in items) + "]"
        case Operation():
            return _operation(value, indent)
        case BlockValue():
            return _block(value, indent)
        case Tense() | Course() | Moment():
            return _over_time(value, indent)
        case Aggregate(word=word, operand=operand, distinct=distinct):
            inner = "*" if operand is None else value_text(operand, indent)
            return f"{word}({'DISTINCT ' * distinct}{inner})"
        case _:
            return _leaf(value)


def _over_time(value: Tense | Course | Moment, indent: str) -> str:
    match value:
        case Tense(word=word, operands=operands):
            bound = _bound(value)
            if len(operands) == 1:
                return f"{word}{bound} {value_text(operands[0], indent)}"
            left, right = (value_text(operand, indent) for operand in operands)
            return f"({left} {word}{bound} {right})"
        case Course(word=word, operand=operand):
            by = f", {_length(value.by, frames=value.frames)}" if word == "delta" else ""
            counted = " in frames" if word in {"run_length", "since_true"} and value.frames else ""
            return f"{word}({value_text(operand, indent)}{by}){counted}"
        case Moment(step=step):
            return f"t(step {step + 1})"


def _bound(tense: Tense) -> str:
    if not tense.low and tense.high is None:
        return ""
    high = "INF" if tense.high is None else _length(tense.high, frames=tense.frames)
    return f"[{_length(tense.low, frames=tense.frames)}, {high}]"


def _length(amount: int, *, frames: bool) -> str:
    return f"{amount}frames" if frames else f"{amount / 1e9:g}s"


def _leaf(value: Bound) -> str:
    match value:
        case NodeValue(node=node):
            text = node
        case NodeAttribute(node=owner) | EdgeAttribute(edge=owner):
            text = f"{owner}.{value.attribute.name}"
        case FrameAttribute(attribute=attribute) if attribute.of_store:
            text = attribute.name
        case FrameAttribute(attribute=attribute):
            text = f"frame.{attribute.name}"
        case TraceAttribute(attribute=attribute):
            text = f"trace.{attribute.name}"
        case EdgeRelation(edge=edge):
            text = f"type({edge})"
        case PairNumber(function=function, a=a, b=b):
            text = f"{function}({a}, {b})"
        case LabelTest(node=node, kinds=kinds):
            text = f"{node} is {kinds_text(kinds)}"
        case _:
            text = repr(value)
    return text


def _operation(operation: Operation, indent: str) -> str:
    parts = [value_text(operand, indent) for operand in operation.operands]
    word = operation.word
    if word in _INFIX:
        return "(" + f" {word} ".join(parts) + ")"
    if word.startswith("IS "):
        return f"({parts[0]} {word})"
    if word in {"NOT", "negative"}:
        return f"{'NOT ' if word == 'NOT' else '-'}{parts[0]}"
    return f"{word}({', '.join(parts)})"


def _block(block: BlockValue, indent: str) -> str:
    inside = _scope(block.scope, indent + "    ")
    if block.value is not None:
        inside.append(f"{indent}    value {value_text(block.value, indent)}")
    return "\n".join([f"{block.word} {{", *inside, f"{indent}  }}"])
