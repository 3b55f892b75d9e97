"""Functions that build the syntax tree of a query: one for each grammar rule.

A builder has the name of its rule, or of the alias of an alternative. It takes the span and the children and
returns a part of the syntax tree. Signs and keywords are not passed as children. An absent optional part is
``None``.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

from sgstore.errors import TextSpan
from sgstore.lang.syntax import tree as s
from sgstore.lang.syntax._hints import said_of
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Callable


Children = list[Any]

_ESCAPES: Final = {"n": "\n", "t": "\t", "r": "\r", "\\": "\\", "'": "'", '"': '"'}
_ESCAPED: Final = re.compile(r"\\(.)", re.DOTALL)
_DURATION: Final = re.compile(r"([\d.]+)\s*(\w+)")


class BuildError(Exception):
    """Error: a query text fits the grammar, but is not valid."""

    def __init__(self, reason: str, span: TextSpan | None = None, hint: str | None = None) -> None:
        self.reason = reason
        self.span = span
        self.hint = hint
        super().__init__(reason)


def rule_number(span: TextSpan, children: Children) -> s.Constant:
    text: str = children[0].text
    value = int(text) if text.isdigit() else float(text)
    if abs(value) > 1e300:
        raise BuildError("the number is too large")
    if isinstance(value, int) and value >= 2**63:
        value = float(value)
    return s.Constant(value, span)


def _whole(token: Any) -> int:
    if not token.text.isdigit():
        raise BuildError("expected a whole number", token.span)
    if len(token.text) > 9:
        raise BuildError("the number is too large", token.span, "at most 9 digits")
    return int(token.text)


def rule_string(span: TextSpan, children: Children) -> s.Constant:
    return s.Constant(_unquoted(children[0].text), span)


def _unquoted(text: str) -> str:
    r"""Return the text between two quotes. Known escapes are replaced; others, such as ``\d``, stay."""
    return _ESCAPED.sub(lambda found: _ESCAPES.get(found[1], found[0]), text[1:-1])


def rule_truth(span: TextSpan, children: Children) -> s.Constant:
    return s.Constant(children[0].text.upper() == "TRUE", span)


def _duration(span: TextSpan, children: Children) -> s.Duration | s.Parameter:
    token = children[0]
    if token.name == "PARAM":
        return s.Parameter(token.text[1:], span)
    return _length(token.text, span)


def _length(text: str, span: TextSpan) -> s.Duration:
    found = _DURATION.fullmatch(text)
    assert found is not None, text  # noqa: S101 - the lexer's pattern is narrower
    if (amount := float(found[1])) > s.LONGEST:
        raise BuildError(s.TOO_LONG, span)
    return s.Duration(amount, found[2].lower(), span)


def rule_window(span: TextSpan, children: Children) -> s.FrameWindow:
    """Return the syntax tree of a time window around a frame, such as ``-1s..1s``."""
    before, ahead = (part.strip() for part in children[0].text.strip("-").split(".."))
    return s.FrameWindow(_length(before, span), _length(ahead, span), span)


def rule_parameter(span: TextSpan, children: Children) -> s.Parameter:
    return s.Parameter(children[0].text[1:], span)


def rule_variable(span: TextSpan, children: Children) -> s.Variable:
    return s.Variable(children[0].text, span)


def rule_attribute(span: TextSpan, children: Children) -> s.AttributeOf | s.TopicExpression:
    owner, name = children
    field = name.text.strip("`")
    if isinstance(owner, s.TopicExpression) or _is_topic(owner):
        return _topic_field(owner, field, TextSpan(name.span.start, span.end), span)
    if name.name == "FIELD":
        reason = f"only fields of a topic are written as `{field}`"
        raise BuildError(reason, name.span, f"topic('/name').`{field}`")
    if not isinstance(owner, s.Variable):
        inner = owner.name if isinstance(owner, s.AttributeOf) else ""
        hint = said_of("attributes", inner) or "call a function for a value: abs(x), lower(x)"
        if isinstance(owner, s.Call):
            hint = f"write the attribute in the parentheses: {owner.name}(x.{name.text})"
        raise BuildError(
            f"only variables have attributes; '.{name.text}' is not allowed here", hint=hint
        )
    return s.AttributeOf(owner, name.text, span)


def rule_list_item(span: TextSpan, children: Children) -> s.TopicExpression:
    owner, index = children
    if not isinstance(owner, s.TopicExpression):
        hint = "write topic('/name').values[0]"
        raise BuildError("only lists in the messages of a topic have elements", hint=hint)
    return _topic_field(owner, _whole(index), TextSpan(owner.path_span.start, span.end), span)


def _is_topic(owner: s.Expression) -> bool:
    return isinstance(owner, s.Call) and normalize_name(owner.name) == "topic"


def _topic_field(
    owner: s.TopicExpression | s.Call, part: str | int, place: TextSpan, span: TextSpan
) -> s.TopicExpression:
    """Return the syntax tree of a topic's field, or of a part of this field."""
    if isinstance(owner, s.TopicExpression):
        place = TextSpan(owner.path_span.start, place.end)
        return replace(owner, path=(*owner.path, part), path_span=place, span=span)
    if not owner.arguments or not isinstance(owner.arguments[0], s.Constant | s.Parameter):
        raise BuildError("topic() takes the name of a topic", owner.span, _TOPIC_EXAMPLE)
    topic, *further = owner.arguments
    rule, tolerance = "last", None
    if further and isinstance(word := further[0], s.Variable) and word.name.upper() != "INF":
        rule, further = word.name.lower(), further[1:]
    if rule not in TOPIC_RULES:
        known = ", ".join(TOPIC_RULES)
        raise BuildError(f"unknown rule '{rule}' of topic(); expected {known}", owner.span)
    if further:
        tolerance = further.pop(0)
        if isinstance(tolerance, s.Variable) and tolerance.name.upper() == "INF":
            tolerance = s.Duration(math.inf, "s", tolerance.span)
    right = tolerance is None or isinstance(tolerance, s.Parameter)
    timed = isinstance(tolerance, s.Duration) and tolerance.unit != "frames"
    if further or not (right or timed):
        reason = "topic() takes a name, a rule and a time"
        raise BuildError(reason, owner.span, _TOPIC_EXAMPLE)
    return s.TopicExpression(topic, (part,), rule, tolerance, place, span)  # type: ignore[arg-type]


TOPIC_RULES: Final = ("last", "nearest", "linear")
"""Names of rules that select a message of a topic for a frame."""
_TOPIC_EXAMPLE: Final = "topic('/imu', nearest, 0.1s).linear_acceleration.z"


def rule_attribute_in(span: TextSpan, children: Children) -> s.AttributeOf:
    """Return the syntax tree of ``frame.class('E')``. It equals that of ``frame.class_E``."""
    owner, name, value = children
    if not (isinstance(owner, s.Variable) and owner.name == "frame" and name.text == "class"):
        hint = said_of("methods", name.text) or f"write the function first: {name.text}(x)"
        raise BuildError(f"'.{name.text}' takes no arguments; only frame.class does", hint=hint)
    return s.AttributeOf(owner, f"class_{_unquoted(value.text)}", span)


def _all(_: TextSpan, children: Children) -> tuple[Any, ...]:
    return tuple(children)


def rule_list(span: TextSpan, children: Children) -> s.ListOf:
    return s.ListOf(children[0] or (), span)


def rule_call(span: TextSpan, children: Children) -> s.Call:
    name, arguments = children
    return s.Call(name.text, arguments or (), distinct=False, name_span=name.span, span=span)


def rule_call_of_distinct(span: TextSpan, children: Children) -> s.Call:
    name, _, arguments = children
    return s.Call(name.text, arguments, distinct=True, name_span=name.span, span=span)


def rule_happens(span: TextSpan, children: Children) -> s.HappensExpression:
    _, kind, arguments = children
    return s.HappensExpression(kind.text, arguments or (), kind.span, span)


def rule_count_all(span: TextSpan, _: Children) -> s.CountAll:
    return s.CountAll(span)


def rule_count_values(span: TextSpan, children: Children) -> s.Call:
    distinct, value = children
    return s.Call(
        "count", (value,), distinct is not None, TextSpan(span.start, span.start + 5), span
    )


def rule_over_match(span: TextSpan, children: Children) -> s.OverExpression:
    return s.OverExpression(children[0], None, None, span)


def rule_over_steps(span: TextSpan, children: Children) -> s.OverExpression:
    value, *names = children
    start, end = (name and s.Variable(name.text, name.span) for name in names)
    return s.OverExpression(value, start, end, span)


def _logic(
    word: Literal["NOT", "AND", "OR", "XOR", "IMPLIES"], span: TextSpan, children: Children
) -> s.Logic:
    return s.Logic(word, tuple(children), span)


def rule_compare(span: TextSpan, children: Children) -> s.Comparison:
    left, sign, right = children
    return s.Comparison("<>" if sign.text == "!=" else sign.text, left, right, span)


def _comparison(word: str, span: TextSpan, children: Children) -> s.Comparison:
    return s.Comparison(word, children[0], children[1], span)


def _null_test(span: TextSpan, children: Children, *, negated: bool) -> s.NullTest:
    return s.NullTest(children[0], negated, span)


def _membership(span: TextSpan, children: Children, *, negated: bool) -> s.Membership:
    return s.Membership(children[0], children[1], negated, span)


def _arithmetic(span: TextSpan, children: Children) -> s.Arithmetic:
    pairs = zip(children[1::2], children[2::2], strict=True)
    return s.Arithmetic(children[0], tuple((sign.text, term) for sign, term in pairs), span)


def rule_sign(span: TextSpan, children: Children) -> s.Expression:
    sign, operand = children
    return s.Negative(operand, span) if sign.text == "-" else operand


def rule_when(span: TextSpan, children: Children) -> s.When:
    condition, value = children
    return s.When(condition, value, span)


def rule_case(span: TextSpan, children: Children) -> s.Case:
    """Return the syntax tree of a ``CASE``. With ``CASE x WHEN y``, each branch has the condition ``x = y``."""
    subject, *branches, otherwise = children
    if subject is not None:
        branches = [
            s.When(
                s.Comparison("=", subject, one.condition, one.condition.span), one.value, one.span
            )
            for one in branches
        ]
    return s.Case(tuple(branches), otherwise, span)


_SYNONYMS: Final = {"GLOBALLY": "ALWAYS", "FINALLY": "EVENTUALLY", "NEVER": "ALWAYS"}
"""Temporal operators of other tools → operator of this language. ``NEVER`` also negates its operand."""


def rule_temporal(span: TextSpan, children: Children) -> s.Temporal | s.Logic:
    word, bound, operand = children
    name, place = word.text.upper(), TextSpan(span.start, word.span.end)
    if name == "NEVER":
        operand = s.Logic("NOT", (operand,), place)
    name = _SYNONYMS.get(name, name)
    if bound is None or not any(_is_negative(end) for end in bound):
        return s.Temporal(name, (operand,), place, bound)
    return _around(name, operand, place, bound)


def _is_negative(end: s.Duration | s.Parameter | None) -> bool:
    return isinstance(end, s.Duration) and end.amount < 0


_MIRRORED: Final = {
    "ALWAYS": "HISTORICALLY",
    "EVENTUALLY": "ONCE",
    "HISTORICALLY": "ALWAYS",
    "ONCE": "EVENTUALLY",
}
"""Temporal operators → operator for the opposite direction of time."""


def _around(
    name: str, operand: s.Expression, place: TextSpan, bound: tuple[Any, Any]
) -> s.Temporal | s.Logic:
    """Return the syntax tree of a temporal operator with earlier frames: ``EVENTUALLY[-2s, 2s] p``.

    It is the operator with the part of the bound ahead, joined with its mirror image for the part before.
    """
    low, high = bound
    if name not in _MIRRORED:
        raise BuildError(f"a bound of {name} cannot be negative", place)
    if not _is_negative(low):
        raise BuildError("the end of the bound is before its start", place)
    start = replace(high, amount=-high.amount) if _is_negative(high) else replace(low, amount=0)
    before = s.Temporal(
        _MIRRORED[name], (operand,), place, (start, replace(low, amount=-low.amount))
    )
    if _is_negative(high):
        return before
    nothing = s.Duration(0, high.unit if isinstance(high, s.Duration) else "s", place)
    ahead = s.Temporal(name, (operand,), place, (nothing, high))
    return s.Logic("OR" if name in {"EVENTUALLY", "ONCE"} else "AND", (before, ahead), place)


def rule_temporal_pair(_: TextSpan, children: Children) -> s.Temporal:
    left, word, bound, right = children
    name = word.text.upper()
    if bound and any(map(_is_negative, bound)):
        raise BuildError(f"a bound of {name} cannot be negative", word.span)
    if name == "UNLESS":  # weak until: the right operand releases the left one, and may replace it
        left, right = right, s.Logic("OR", (left, right), word.span)
        name = "RELEASE"
    return s.Temporal(name, (left, right), word.span, bound)


def rule_bound(span: TextSpan, children: Children) -> tuple[Any, Any]:
    """Return start and end of a time bound such as ``[0s, 2s]``. For ``WITHIN 2s``, the start is 0."""
    (found,) = children
    if isinstance(found, s.Duration | s.Parameter):
        return s.Duration(0, "s", span), found
    low, high = (part.strip() for part in found.text[1:-1].split(","))
    return _end(low, span), None if high.upper() == "INF" else _end(high, span)


def _end(text: str, span: TextSpan) -> s.Duration | s.Parameter:
    if text.startswith("$"):
        return s.Parameter(text[1:], span)
    if text.startswith("-"):
        found = _length(text[1:].strip(), span)
        return replace(found, amount=-found.amount)
    return _length(text, span)


def _block_expression(word: str, span: TextSpan, children: Children) -> s.BlockExpression:
    return s.BlockExpression(word, children[0], None, span)


def rule_aggregate_block(span: TextSpan, children: Children) -> s.BlockExpression:
    word, block, value = children
    return s.BlockExpression(word.text.upper(), block, value, span)


def rule_label(span: TextSpan, children: Children) -> s.Label:
    return s.Label(children[0].text, span)


def rule_label_any(span: TextSpan, _: Children) -> s.Label:
    return s.Label("%", span)


def _label_logic(word: Literal["!", "&", "|"], span: TextSpan, children: Children) -> s.LabelLogic:
    return s.LabelLogic(word, tuple(children), span)


def rule_prop(_: TextSpan, children: Children) -> s.Property:
    name, value = children
    return s.Property(name.text, value, name.span)


def _only(_: TextSpan, children: Children) -> Any:
    return children[0]


def rule_node(span: TextSpan, children: Children) -> s.NodePattern:
    name, label, props, where = children
    name_span = name.span if name else span
    return s.NodePattern(name and name.text, label, props or (), where, name_span, span)


def rule_edge_body(span: TextSpan, children: Children) -> tuple[Any, ...]:
    name, label, star, props, where = children
    return name and name.text, label, star, props or (), where, span


_Direction = Literal["right", "left", "any"]
_DIRECTIONS: Final[tuple[_Direction, ...]] = ("right", "left", "any")


def _edge(direction: _Direction, span: TextSpan, children: Children) -> s.EdgePattern:
    (name, label, star, props, where, _), repeat = children
    if star and repeat:
        raise BuildError("an edge is repeated twice, by '*' and by '{…}'")
    low, high = star or repeat or (None, None)
    return s.EdgePattern(name, label, low, high, props, where, direction, span)


def _bare(direction: _Direction, span: TextSpan, _: Children) -> s.EdgePattern:
    return s.EdgePattern(None, None, None, None, (), None, direction, span)


def rule_star(span: TextSpan, children: Children) -> tuple[int, int]:
    number, upto = children
    digits = upto.text[2:].strip() if upto else ""
    if not number and not upto:
        raise _unbounded(span)
    if upto and not digits:
        raise _unbounded(span)
    low = _whole(number) if number else 1
    return _range(low, int(digits[:9]) if upto else low, span)


def rule_repeat(span: TextSpan, children: Children) -> tuple[int, int]:
    low, high = children
    if high is None:
        raise _unbounded(span)
    return _range(_whole(low), _whole(high), span)


def rule_repeat_exactly(span: TextSpan, children: Children) -> tuple[int, int]:
    return _range(_whole(children[0]), _whole(children[0]), span)


MAX_EDGES: Final = 10
"""Longest path that one edge pattern can match, in edges."""


def _unbounded(span: TextSpan) -> BuildError:
    return BuildError(
        "a repeated edge needs an upper bound", span, f"write *1..{MAX_EDGES} for 1 to {MAX_EDGES}"
    )


def _range(low: int, high: int, span: TextSpan) -> tuple[int, int]:
    if not 1 <= low <= high:
        raise BuildError(f"an edge cannot be repeated {low} to {high} times", span, "write *1..3")
    if high > MAX_EDGES:
        raise BuildError(f"a repeated edge has at most {MAX_EDGES} edges", span)
    return low, high


def rule_path(_: TextSpan, children: Children) -> s.Path:
    return s.Path(tuple(children[::2]), tuple(children[1::2]))


def rule_named_path(_: TextSpan, children: Children) -> s.Path:
    name, path = children
    return replace(path, name=name.text, name_span=name.span)


def rule_block_body(span: TextSpan, children: Children) -> s.Block:
    paths, where = children
    return s.Block(paths, where, span)


def rule_match_step(span: TextSpan, children: Children) -> s.StepClause:
    paths, where, *further, hold, name = children
    for more, condition in further:
        paths += more
        where = _both(where, condition)
    end = where.span.end if where else span.end
    block = s.Block(paths, where, TextSpan(span.start, end))
    return s.StepClause(block, absent=False, hold=hold, name=name, span=span)


def rule_further(_: TextSpan, children: Children) -> tuple[Any, Any]:
    """Return the paths and the condition of a ``MATCH`` that follows another one for the same frame."""
    paths, where = children
    return paths, where


def _both(one: s.Expression | None, other: s.Expression | None) -> s.Expression | None:
    if one is None or other is None:
        return one or other
    return s.Logic("AND", (one, other), TextSpan(one.span.start, other.span.end))


def rule_holds_step(span: TextSpan, children: Children) -> s.StepClause:
    condition, hold, name = children
    block = s.Block((), condition, condition.span)
    return s.StepClause(block, absent=False, hold=hold, name=name, span=span)


def rule_absent_step(span: TextSpan, children: Children) -> s.StepClause:
    (step,) = children
    if step.hold or step.name:
        raise BuildError("NOT MATCH cannot have a duration or a name", step.span)
    return s.StepClause(step.block, absent=True, hold=None, name=None, span=span)


def rule_group_step(span: TextSpan, children: Children) -> s.GroupStep:
    *alternatives, often = children
    low, high = often or (1, 1)
    return s.GroupStep(tuple(alternatives), low, high, span)


def rule_often(span: TextSpan, children: Children) -> tuple[int, int]:
    low, high = children
    least = _whole(low)
    most = least if high is None else _whole(high)
    if not 1 <= least <= most:
        reason = f"steps cannot be repeated {least} to {most} times"
        raise BuildError(reason, span, "write {2} or {1,3}")
    return least, most


def rule_scenario_step(span: TextSpan, children: Children) -> s.ScenarioStep:
    name, *given = children
    values = tuple(value for value in given if value is not None)
    named = [normalize_name(value.name) for value in values]
    if len(set(named)) < len(named):
        raise BuildError("a parameter has two values", span)
    return s.ScenarioStep(name.text, values, name.span, span)


def rule_given(span: TextSpan, children: Children) -> s.Argument:
    name, value = children
    if not isinstance(value, s.Constant | s.Duration):
        named = value.name == "NAME"
        value = (
            s.Variable(value.text, value.span) if named else s.Parameter(value.text[1:], value.span)
        )
    return s.Argument(name.text, value, span)


def rule_hold(span: TextSpan, children: Children) -> s.HoldClause:
    *comparison, duration, inclusive = children
    word = comparison[0].text if comparison else "="
    if word in {"<>", "!="}:
        raise BuildError("expected >=, >, =, < or <= before the duration of a step", span)
    return s.HoldClause(word, duration, inclusive is not None, span)


def rule_step_name(_: TextSpan, children: Children) -> str:
    return children[0].text


def rule_link(span: TextSpan, children: Children) -> s.LinkClause:
    kind, after, within = children[0] or ("then", None, None)
    return s.LinkClause(kind, after, within, span)


def rule_immediately(_: TextSpan, __: Children) -> tuple[str, None, None]:
    return "immediately", None, None


def _other_link(kind: Literal["until", "while"], span: TextSpan, _: Children) -> s.LinkClause:
    return s.LinkClause(kind, None, None, span)


def rule_sequence(span: TextSpan, children: Children) -> s.SequenceClause:
    return s.SequenceClause(tuple(children[::2]), tuple(children[1::2]), span)


def rule_match(span: TextSpan, children: Children) -> s.MatchClause:
    settings, sequence, later, returns, order, sample, top, skip, limit = children
    if any(part is not None for part in children[3:]):
        every = (s.Item("all", None, None, 0, 0, span),)
        distinct, items, having, at = returns or (False, every, None, span)
        returns = s.Returns(distinct, items, order or (), sample, limit, at, having, top, skip or 0)
    return s.MatchClause(settings or (), sequence, returns, span, later or ())


def _later_match(span: TextSpan, children: Children, *, optional: bool) -> s.LaterMatch:
    paths, where = children
    return s.LaterMatch(s.Block(paths, where, span), optional, span)


def rule_with(span: TextSpan, children: Children) -> s.WithClause:
    distinct, items, order, skip, limit, where = children
    for item in items:
        if item.form not in {"value", "all"}:
            raise BuildError("WITH passes values and variables on", item.span, "WITH e, v, …")
    return s.WithClause(distinct is not None, items, order or (), skip or 0, limit, where, span)


def rule_union(span: TextSpan, children: Children) -> s.UnionClause:
    words = {" ".join(word.text.upper().split()): word for word in children[1::2]}
    if len(words) > 1:
        last = [*words.values()][-1]
        raise BuildError("a query cannot contain both UNION and UNION ALL", last.span)
    return s.UnionClause(tuple(children[::2]), "UNION" in words, span)


def rule_check(span: TextSpan, children: Children) -> s.CheckClause:
    settings, name, *quantifiers, formula, reset, robustness, returns = children
    called, quantified = name and name.text, tuple(quantifiers)
    distinct, items, having, at = returns or (False, (), None, span)
    if distinct:
        raise BuildError("violations are listed one by one; remove DISTINCT", at)
    if any(item.form != "value" for item in items):
        reason = "a CHECK returns values of its violations"
        raise BuildError(reason, at, "RETURN MIN(gap(ego, v)) OVER match AS closest")
    asked = robustness is not None
    about = settings or (), called, quantified, formula, reset, asked, items, span
    return s.CheckClause(*about, having)


def rule_quantifier(span: TextSpan, children: Children) -> s.QuantifierClause:
    word, *nodes, where, absent = children
    return s.QuantifierClause(word.text.upper(), tuple(nodes), where, absent is not False, span)


def rule_qvar(span: TextSpan, children: Children) -> s.QuantifiedNode:
    name, label = children
    return s.QuantifiedNode(name.text, label, span)


def rule_absent(_: TextSpan, children: Children) -> bool:
    return children[0].text.upper() == "TRUE"


def rule_setting(span: TextSpan, children: Children) -> s.Setting:
    name, value = children
    if value.name == "PARAM":
        return s.Setting(name.text, s.Parameter(value.text[1:], value.span), span)
    text = _unquoted(value.text) if value.name == "STRING" else value.text
    return s.Setting(name.text, text, span)


def rule_define(span: TextSpan, children: Children) -> s.Define:
    _, name, parameters, body = children
    formals: tuple[s.Formal, ...] = parameters or ()
    named = [normalize_name(formal.name) for formal in formals]
    if len(set(named)) < len(named):
        raise BuildError("two parameters have the same name", span)
    if not isinstance(body, s.SequenceClause) and any(formal.default for formal in formals):
        raise BuildError("the parameters of a predicate are names, without a value", span)
    return s.Define(name.text, formals, body, name.span, span)


def rule_param(span: TextSpan, children: Children) -> s.Formal:
    name, label, default = children
    if label:
        raise BuildError("the parameters of a definition are names, without a label")
    return s.Formal(name.text, default, span)


def rule_start(_: TextSpan, children: Children) -> tuple[Any, ...]:
    return tuple(child for child in children if child is not None)


def rule_item(span: TextSpan, children: Children) -> s.Item:
    value, name = children
    return s.Item("value", value, name and name.text, 0, 0, span)


_Form = Literal["all", "frames", "intervals", "subgraphs"]
_FORMS: Final[tuple[_Form, ...]] = ("all", "frames", "intervals", "subgraphs")


def _form(form: _Form, span: TextSpan, _: Children) -> s.Item:
    return s.Item(form, None, None, 0, 0, span)


def rule_item_clips(span: TextSpan, children: Children) -> s.Item:
    return s.Item("clips", None, None, children[0], children[1], span)


def rule_offset(span: TextSpan, children: Children) -> int:
    sign, duration = children
    if not isinstance(duration, s.Duration) or duration.unit == "frames":
        raise BuildError("the ends of clips are times such as -3s and +5s", span)
    return -duration.ns if sign and sign.text == "-" else duration.ns


def rule_sort(_: TextSpan, children: Children) -> s.Sort:
    value, direction = children
    return s.Sort(value, bool(direction and direction.text.upper() == "DESC"))


def _sample(span: TextSpan, children: Children) -> s.Sample:
    return s.Sample(_whole(children[0]), children[1], span)


def _limit(_: TextSpan, children: Children) -> int:
    return _whole(children[0])


def rule_returns(span: TextSpan, children: Children) -> tuple[Any, ...]:
    distinct, items, having = children
    return distinct is not None, items, having, span


# A function ``rule_x`` builds the tree of the grammar rule ``x``.
BUILDERS: Final[dict[str, Callable[[TextSpan, Children], Any]]] = {
    **{name[5:]: made for name, made in [*globals().items()] if name.startswith("rule_")},
    **dict.fromkeys(
        ("params", "later", "using", "patterns", "props", "arguments", "items", "order"), _all
    ),
    "optional": partial(_later_match, optional=True),
    "again": partial(_later_match, optional=False),
    **dict.fromkeys(
        ("reset", "where", "label_expr", "times", "otherwise", "block", "having"), _only
    ),
    "until_link": partial(_other_link, "until"),
    "while_link": partial(_other_link, "while"),
    "within": lambda _, children: ("then", None, children[0]),
    "after": lambda _, children: ("then", *children),
    **{f"edge_{way}": partial(_edge, way) for way in _DIRECTIONS},
    **{f"bare_{way}": partial(_bare, way) for way in _DIRECTIONS},
    "label_or": partial(_label_logic, "|"),
    "label_and": partial(_label_logic, "&"),
    "label_neg": partial(_label_logic, "!"),
    "implies": partial(_logic, "IMPLIES"),
    "disjunction": partial(_logic, "OR"),
    "exclusion": partial(_logic, "XOR"),
    "conjunction": partial(_logic, "AND"),
    "negation": partial(_logic, "NOT"),
    "equal": partial(_comparison, "="),
    "is_null": partial(_null_test, negated=False),
    "is_known": partial(_null_test, negated=True),
    "is_in": partial(_membership, negated=False),
    "is_not_in": partial(_membership, negated=True),
    "starts_with": partial(_comparison, "STARTS WITH"),
    "ends_with": partial(_comparison, "ENDS WITH"),
    "contains": partial(_comparison, "CONTAINS"),
    "resembles": partial(_comparison, "=~"),
    "sum": _arithmetic,
    "product": _arithmetic,
    "timespan": _duration,
    "exists": partial(_block_expression, "EXISTS"),
    "count_block": partial(_block_expression, "COUNT"),
    "null": lambda span, _: s.Constant(None, span),
    "duration": _duration,
    **{f"item_{form}": partial(_form, form) for form in _FORMS},
    "sample": _sample,
    "top": _sample,
    "skip": _limit,
    "limit": _limit,
}
