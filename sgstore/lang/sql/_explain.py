"""Text of a query after each stage of the compiler, for ``--explain``."""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang.ir import (
    PASSED,
    WINDOWS,
    Aggregate,
    BlockValue,
    Bound,
    Choices,
    Edge,
    EdgeAttribute,
    EdgeRelation,
    FrameAttribute,
    GroupKey,
    Happened,
    Kinds,
    LabelTest,
    MatchStage,
    NodeAttribute,
    NodeValue,
    Operation,
    OverMatch,
    PairNumber,
    Query,
    Scope,
    SignalCall,
    Stage,
    StepTime,
    Tense,
    TraceAttribute,
    Value,
    any_kinds,
    any_relation,
    is_passed_on,
)
from sgstore.lang.operators import INFIX
from sgstore.model.pair_numbers import as_written
from sgstore.model.vocabulary import KINDS, RELATIONS, entity_kinds

if TYPE_CHECKING:
    from sgstore.lang.syntax.tree import Statement

_PLACES: Final = frozenset({"span", "name_span"})


def tree_text(part: Any) -> str:
    """Return a syntax tree as text: one line for each part. Positions and absent parts are left out."""
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
    """Return the syntax trees of query statements as text."""
    return "\n".join(tree_text(statement) for statement in statements)


def query_text(query: Query) -> str:
    """Return a compiled query as readable text: variables, conditions and results."""
    lines = [line for stage in query.stages for line in _stage(stage)]
    lines += [] if query.stages else _scope(query.scope, "")
    result = query.result
    shown = [f"{column.name} = {value_text(column.value)}" for column in result.columns]
    lines.append(f"return {result.form}" + (f": {', '.join(shown)}" if shown else ""))
    if query.ego is not None:
        lines.append(f"ego {query.ego!r}")
    return "\n".join(lines)


def _stage(stage: Stage) -> list[str]:
    """Return a ``MATCH`` or ``WITH`` clause of a query as readable lines of text."""
    if isinstance(stage, MatchStage):
        return ["optional match" if stage.optional else "match", *_scope(stage.scope, "  ")]
    nodes = [new if new == key else f"{key} AS {new}" for new, key in stage.nodes]
    edges = [e.key if e.key == key else f"{key} AS {e.key}" for e, key in stage.edges]
    values = [f"{value_text(column.value)} AS {column.name}" for column in stage.values]
    lines = [f"with {'each ' * stage.grouped}{', '.join([*nodes, *edges, *values])}"]
    keys = [
        value_text(key.value) + " DESC" * key.descending
        for key in stage.order
        if not isinstance(key.value, str)
    ]
    lines += [f"  order by {', '.join(keys)}"] if keys else []
    lines += [f"  skip {stage.skip}"] if stage.skip else []
    lines += [] if stage.limit is None else [f"  limit {stage.limit}"]
    return [*lines, *(f"  where {value_text(condition)}" for condition in stage.where)]


def _passed(name: str) -> str:
    """Return the name that the query text gives to a ``WITH`` value."""
    return name.removeprefix(PASSED).rpartition(" ")[0]


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
    """Return a pattern edge as readable text, with the keys of its nodes."""
    some = [relation for relation in RELATIONS if relation in edge.relations]
    label = "" if edge.relations == any_relation() else f":{'|'.join(some)}"
    times = "" if edge.high == 1 else f"*{edge.low}..{edge.high}"
    arrow = "-" if edge.both else "->"
    return f"({edge.src})-[{label}{times}]{arrow}({edge.dst})"


def kinds_text(kinds: Kinds) -> str:
    """Return the kinds allowed for a pattern node as readable text, such as ``the ego``."""
    if kinds == any_kinds():
        return "anything"
    entities = entity_kinds()
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
    """Return an expression as readable text. The numbers of unnamed nodes are left out."""
    return _NUMBERED.sub(lambda found: "#" if found[0][0] == "#" else found[0], value_text(value))


_NUMBERED: Final = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|#\d+""")
"""Regular expression: quoted texts, which stay, and the numbers of unnamed nodes."""


def value_text(value: Bound, indent: str = "") -> str:  # noqa: PLR0911 - a case each
    """Return an expression as readable text in almost the syntax of the query language."""
    match value:
        case Value(value=constant):
            return "NULL" if constant is None else repr(constant)
        case Choices(items=items):
            return "[" + ", ".join(value_text(item) for item in items) + "]"
        case Operation():
            return _operation(value, indent)
        case BlockValue():
            return _block(value, indent)
        case Tense() | SignalCall() | StepTime() | OverMatch():
            return _over_time(value, indent)
        case Aggregate(word=word, operand=operand, distinct=distinct, share=share):
            inner = "*" if operand is None else value_text(operand, indent)
            inner += f", {share * 100:g}" if word == "percentile" else ""
            return f"{word}({'DISTINCT ' * distinct}{inner})"
        case GroupKey(name=name):
            return name
        case _:
            return _leaf(value)


def _over_time(value: Tense | SignalCall | StepTime | OverMatch, indent: str) -> str:
    match value:
        case Tense(word=word, operands=operands):
            bound = _bound(value)
            if len(operands) == 1:
                return f"{word}{bound} {value_text(operands[0], indent)}"
            left, right = (value_text(operand, indent) for operand in operands)
            return f"({left} {word}{bound} {right})"
        case SignalCall(word=word, operand=operand):
            back = word in {"delta", *WINDOWS}
            by = f", {_length(value.by, frames=value.frames)}" if back else ""
            if back and value.ahead:
                before = value.by - value.frames
                by = f", -{_length(before, frames=value.frames)}..{_length(value.ahead, frames=value.frames)}"
            counted = " in frames" if word in {"run_length", "since_true"} and value.frames else ""
            return f"{word}({value_text(operand, indent)}{by}){counted}"
        case StepTime(step=step):
            return f"t(step {step + 1})"
        case OverMatch(word=word, operand=operand, at=at):
            told = ", ".join(value_text(one, indent) for one in (operand, at) if one is not None)
            return f"{word.upper()}({told}) OVER {_part(value)}"


def _part(value: OverMatch) -> str:
    if value.start is None or value.end is None:
        return "match"
    same = value.start == value.end
    return f"step {value.start + 1}" + ("" if same else f"..{value.end + 1}")


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
        case FrameAttribute(attribute=attribute) if attribute.of_store or is_passed_on(value):
            text = _passed(attribute.name) if is_passed_on(value) else attribute.name
        case FrameAttribute(attribute=attribute):
            text = f"frame.{attribute.name}"
        case TraceAttribute(attribute=attribute):
            text = f"trace.{attribute.name}"
        case EdgeRelation(edge=edge):
            text = f"type({edge})"
        case PairNumber(function=function, a=a, b=b):
            text = as_written(function, a, b)
        case Happened(kind=kind, nodes=nodes):
            text = f"HAPPENS {kind}({', '.join(nodes)})"
        case LabelTest(node=node, kinds=kinds):
            text = f"{node} is {kinds_text(kinds)}"
        case _:
            text = repr(value)
    return text


def _operation(operation: Operation, indent: str) -> str:
    parts = [value_text(operand, indent) for operand in operation.operands]
    word = operation.word
    if word in INFIX:
        return "(" + f" {word} ".join(parts) + ")"
    if word == "case":
        pairs = zip(parts[::2], parts[1::2], strict=False)
        told = " ".join(f"WHEN {condition} THEN {value}" for condition, value in pairs)
        return f"CASE {told} ELSE {parts[-1]} END"
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
