"""Text → syntax tree: an LALR(1) parser that runs the tables of ``grammar.lark``.

The lexer is led by the parser: of the terminals that may stand at a place it takes the longest, so that a word
is a keyword only where a keyword may stand. What may stand there is also what an error message says.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import QuerySyntaxError, Span
from sgstore.lang.builders import BUILDERS, BuildError
from sgstore.lang.hints import bracket_hint
from sgstore.lang.slips import places, slip_hint
from sgstore.lang.tables import Rule, Tables, Terminal, tables

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.lang.syntax import Statement

MAX_LENGTH: Final = 100_000
"""Longest text that is parsed; characters."""

MAX_DEPTH: Final = 200
"""Deepest stack of the parser, so that nesting is bounded before anything recurses."""

_END: Final = "$END"
_BLANK: Final = re.compile(r"\s+")
_COMMENT: Final = re.compile(r"--[^\n]*|/\*.*?\*/", re.DOTALL)
_NEXT: Final = re.compile(
    r"""\w+|<?--+>?|&&|\|\||\]\s*>|-\(|'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|\S""", re.DOTALL
)


@dataclass(frozen=True, slots=True)
class Token:
    """A terminal as it was read."""

    name: str
    text: str
    span: Span


@dataclass(slots=True)
class _Entry:
    """What lies on the parser's stack: the state after a symbol, what was built of it, where it stands."""

    state: int
    value: Any
    span: Span


def parse(text: str) -> tuple[Statement, ...]:
    """The statements of a text.

    Raises
    ------
    QuerySyntaxError
        The text is not a sentence of the language.
    """
    if len(text) > MAX_LENGTH:
        reason = f"the text has {len(text)} characters, more than {MAX_LENGTH}"
        raise QuerySyntaxError(reason)
    machine = tables()
    stack = [_Entry(machine.start, None, Span(0, 0))]
    position = 0
    while True:
        token = _read(machine, stack, text, position)
        _take(machine, stack, token, text)
        if stack[-1].state == machine.end:
            return stack[-1].value
        position = token.span.end


def _read(machine: Tables, stack: list[_Entry], text: str, position: int) -> Token:
    """The next token of those that may stand after the stack."""
    actions = machine.states[stack[-1].state]
    allowed = [machine.terminals[name] for name in actions if name in machine.terminals]
    while True:
        if blank := _BLANK.match(text, position):
            position = blank.end()
        best = max(allowed, key=partial(_rank, text, position), default=None)
        edge = _reads_as_edge(text, position, actions)
        comment = None if edge else _COMMENT.match(text, position)
        # Between nodes two dashes are an edge; in an expression they begin a comment.
        signs = comment is not None and best is not None and best.name == "SIGN"
        if best and not signs and (length := best.length_at(text, position)):
            span = Span(position, position + length)
            return Token(best.name, text[position : position + length], span)
        if not comment:
            break
        position = comment.end()
    if position == len(text) and _END in actions:
        return Token(_END, "", Span(position, position))
    raise _unexpected(machine, stack, text, position)


def _reads_as_edge(text: str, position: int, actions: Mapping[str, int]) -> bool:
    """Whether two dashes are meant as an edge, so that what follows is not taken for a comment and dropped."""
    if text.startswith("-->", position):
        return True
    behind = text[position - 1 : position] == ")" or text.startswith("--[", position)
    return behind and "BARE_ANY" in actions and text.startswith("--", position)


def _rank(text: str, position: int, terminal: Terminal) -> tuple[int, int, bool]:
    return terminal.length_at(text, position), terminal.priority, bool(terminal.literal)


def _take(machine: Tables, stack: list[_Entry], token: Token, text: str) -> None:
    """Reduce whatever ends before the token, then put it on the stack."""
    while True:
        action = machine.states[stack[-1].state].get(token.name)
        if action is None:
            raise _unexpected(machine, stack, text, token.span.start)
        if action >= 0:
            break
        rule = machine.rules[-1 - action]
        _reduce(machine, stack, rule, text)
        if stack[-1].state == machine.end:
            return
    if len(stack) > MAX_DEPTH:
        raise QuerySyntaxError("nested too deeply", text=text, span=token.span)
    stack.append(_Entry(action, token, token.span))


def _reduce(machine: Tables, stack: list[_Entry], rule: Rule, text: str) -> None:
    first = len(stack) - rule.size
    parts = stack[first:]
    del stack[first:]
    end = stack[-1].span.end  # of what comes before, for a part that is empty
    span = Span(parts[0].span.start, parts[-1].span.end) if parts else Span(end, end)
    value = _built(rule, _children(rule, parts), span, text)
    state = machine.states[stack[-1].state][rule.origin]
    stack.append(_Entry(state, value, span))


def _children(rule: Rule, parts: list[_Entry]) -> list[Any]:
    """What a rule is built of: without mere signs, with repetitions spread out, absent parts as ``None``."""
    children: list[Any] = []
    for index, part in enumerate(parts):
        if rule.absent:
            children += [None] * rule.absent[index]
        if isinstance(part.value, list):
            children += part.value
        elif rule.keep[index]:
            children.append(part.value)
    if rule.absent:
        children += [None] * rule.absent[-1]
    return children


def _built(rule: Rule, children: list[Any], span: Span, text: str) -> Any:
    if rule.origin.startswith("_"):
        return children
    if rule.inline and len(children) == 1:
        return children[0]
    try:
        return BUILDERS[rule.name](span, children)
    except BuildError as error:
        raise QuerySyntaxError(
            error.reason, text=text, span=error.span or span, hint=error.hint
        ) from None


# Errors -------------------------------------------------------------------------------------------

_OPERATORS: Final = frozenset(
    {"COMPARE", "SIGN", "STAR", "SLASH", "PERCENT", "AND", "OR", "XOR", "IMPLIES", "IS", "IN"}
    | {"STARTS", "ENDS", "CONTAINS", "EQUAL", "UNTIL_OP", "UNTIL_LINK", "NOT"}
)
_EDGES: Final = frozenset({"BARE_RIGHT", "BARE_LEFT", "BARE_ANY", "_OPEN", "_OPEN_LEFT"})
_LATER: Final = frozenset(
    {
        "HOLDS",
        "CHECK",
        "FOR",
        "THEN",
        "UNTIL_LINK",
        "WHILE",
        "UNTIL_OP",
        "TEMPORAL",
        "RESET",
        "SEMICOLON",
    }
    | {"_ARROW"}
)
"""What is not proposed, lest the list be long: what concerns time, and other words for what is proposed."""

_STARTS: Final = frozenset({"NUMBER", "STRING", "PARAM", "TRUTH", "NULL", "EXISTS"})
_SAID: Final = {
    "NAME": ("a name",),
    "NUMBER": ("a number",),
    "STRING": ("a text in quotes",),
    "DURATION": ("a duration such as 2s",),
    "PARAM": ("a parameter such as $x",),
    "COMPARE": ("a comparison",),
    "BARE_RIGHT": ("'-->'",),
    "BARE_LEFT": ("'<--'",),
    "BARE_ANY": ("'--'",),
    "UPTO": ("'..'",),
    "SIGN": ("'+'", "'-'"),
    "TRUTH": ("TRUE", "FALSE"),
    "DIRECTION": ("ASC", "DESC"),
    "QUANTIFIER": ("FORALL", "FORSOME"),
    "DEF_KIND": ("PREDICATE", "SCENARIO"),
    "AGGREGATE": ("MIN", "MAX", "AVG", "SUM"),
    "BOUND": ("a bound such as [0s, 2s]",),
    _END: ("the end",),
}
"""Terminals in words."""

_MANY: Final = 8
_LONGEST: Final = 40


def _unexpected(machine: Tables, stack: list[_Entry], text: str, position: int) -> QuerySyntaxError:
    if blank := _BLANK.match(text, position):
        position = blank.end()
    found = _NEXT.match(text, position)
    span = Span(position, found.end() if found else position)
    names = [name for name in machine.states[stack[-1].state] if name.isupper() or name == _END]
    names = [name for name in names if _leads_on(machine, stack, name)]
    here = f"found {_shown(found[0])}" if found else "the text ends"
    reason = f"expected {_listed(machine, names)}, but {here}"
    return QuerySyntaxError(reason, text=text, span=span, hint=_hint(machine, names, text, span))


def _shown(found: str) -> str:
    """What was found, for a message: short, and so that it can be seen."""
    if not found.isprintable():
        return " ".join(f"U+{ord(character):04X}" for character in found[:8])
    short = found if len(found) <= _LONGEST else f"{found[:_LONGEST]}…"
    return short if len(found) > 1 and found[0] in "'\"" else f"'{short}'"


def _leads_on(machine: Tables, stack: list[_Entry], name: str) -> bool:
    """Whether the parser would accept the terminal after all reductions that it brings about."""
    states = [entry.state for entry in stack]
    while (action := machine.states[states[-1]].get(name)) is not None:
        if action >= 0:
            return True
        rule = machine.rules[-1 - action]
        del states[len(states) - rule.size :]
        states.append(machine.states[states[-1]][rule.origin])
        if states[-1] == machine.end:
            return name == _END
    return False


def _listed(machine: Tables, names: list[str]) -> str:
    """What was expected, in words; operators and beginnings of values are each one thing."""
    left = set(names) - _LATER
    said: list[str] = []
    if left >= _EDGES:
        said.append("an edge")
        left -= _EDGES
    if "MATCH" in left:
        left -= {"NOT"}
    if left >= _STARTS:
        said += ["a value", "a condition"]
        left -= _STARTS | {"NAME", "LPAR", "LSQB", "COUNT", "AGGREGATE", "DURATION", "TEMPORAL"}
        left -= {"SIGN", "NOT"}
    elif {"SIGN", "STAR"} <= left:
        said.append("an operator")
        left -= _OPERATORS | {"_RESEMBLES", "DOT"}
    said += sorted(word for name in left for word in _said(machine, name))
    if len(said) > _MANY:
        said = [*said[:_MANY], "…"]
    return " or ".join([", ".join(said[:-1]), said[-1]]) if len(said) > 1 else "".join(said)


def _said(machine: Tables, name: str) -> tuple[str, ...]:
    terminal = machine.terminals.get(name)
    if name in _SAID or terminal is None or not terminal.literal:
        return _SAID.get(name, (name,))
    return (terminal.literal if terminal.literal.isalpha() else f"'{terminal.literal}'",)


def _hint(machine: Tables, names: list[str], text: str, span: Span) -> str | None:
    bracket = bracket_hint(text, span.start, text[span.start : span.end])
    if bracket:
        return bracket
    words = [machine.terminals[name].literal for name in names if name in machine.terminals]
    return slip_hint(text, span.start, span.end, places(names), words)
