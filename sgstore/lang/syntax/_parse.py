"""LALR(1) parser of the query language. It uses precomputed tables of the grammar.

The parser guides the lexer: the lexer takes the longest of the terminals allowed at a place. So a word is a
keyword only where a keyword is allowed. Error messages list the same allowed terminals.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import QuerySyntaxError, TextSpan
from sgstore.lang.syntax._hints import bracket_hint, places, slip_hint
from sgstore.lang.syntax._tables import Rule, Tables, Terminal, tables
from sgstore.lang.syntax._tree_builder import BUILDERS, BuildError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sgstore.lang.syntax.tree import Statement


MAX_LENGTH: Final = 100_000
"""Longest text that the parser accepts; characters."""

MAX_DEPTH: Final = 200
"""Largest size of the parser stack. It limits nested brackets before any recursion starts."""

_END: Final = "$END"
_BLANK: Final = re.compile(r"\s+")
_COMMENT: Final = re.compile(r"--[^\n]*|/\*.*?\*/", re.DOTALL)
_NEXT: Final = re.compile(
    r"""\w+|<?--+>?|&&|\|\||\]\s*>|-\(|'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|\S""", re.DOTALL
)


@dataclass(frozen=True, slots=True)
class Token:
    """Token of a query text, such as a keyword, a name or a number."""

    name: str
    text: str
    span: TextSpan


@dataclass(slots=True)
class _StackEntry:
    """Entry of the parser stack: the parser state, the result of a symbol, and the symbol's place."""

    state: int
    value: Any
    span: TextSpan


def parse(text: str) -> tuple[Statement, ...]:
    """Parse a query text, and return the syntax trees of its statements. Short texts are cached.

    Raises
    ------
    QuerySyntaxError
        The text does not match the grammar.
    """
    return _parsed_once(text) if len(text) <= _SHORT else _parsed(text)


_SHORT: Final = 4_000
"""Longest text whose statements are cached; characters."""


def _parsed(text: str) -> tuple[Statement, ...]:
    if len(text) > MAX_LENGTH:
        reason = f"the text has {len(text)} characters, more than {MAX_LENGTH}"
        raise QuerySyntaxError(reason)
    machine = tables()
    stack = [_StackEntry(machine.start, None, TextSpan(0, 0))]
    position = 0
    while True:
        token = _read(machine, stack, text, position)
        _take(machine, stack, token, text)
        if stack[-1].state == machine.end:
            return stack[-1].value
        position = token.span.end


_parsed_once = lru_cache(maxsize=64)(_parsed)


def joined(texts: Sequence[str]) -> str:
    """Join several query texts to one text with all their statements. A single text stays unchanged.

    Raises
    ------
    QuerySyntaxError
        One of the texts does not match the grammar.
    """
    if len(texts) == 1:
        return texts[0]
    written = (text[s.span.start : s.span.end] for text in texts for s in parse(text))
    return "\n;\n".join(written)  # on separate lines, because a statement may end in a comment


def _read(machine: Tables, stack: list[_StackEntry], text: str, position: int) -> Token:
    """Return the next token of the query text. The parser state determines the allowed tokens."""
    actions = machine.states[stack[-1].state]
    allowed = [machine.terminals[name] for name in actions if name in machine.terminals]
    while True:
        if blank := _BLANK.match(text, position):
            position = blank.end()
        best = max(allowed, key=partial(_rank, text, position), default=None)
        edge = _reads_as_edge(text, position, actions)
        comment = None if edge else _COMMENT.match(text, position)
        # Between nodes, two dashes are an edge. In an expression, they begin a comment.
        signs = comment is not None and best is not None and best.name == "SIGN"
        if best and not signs and (length := best.length_at(text, position)):
            span = TextSpan(position, position + length)
            return Token(best.name, text[position : position + length], span)
        if not comment:
            break
        position = comment.end()
    if position == len(text) and _END in actions:
        return Token(_END, "", TextSpan(position, position))
    raise _unexpected(machine, stack, text, position)


def _reads_as_edge(text: str, position: int, actions: Mapping[str, int]) -> bool:
    """True if ``--`` at this place of the query is an edge, and not the start of a comment."""
    if text.startswith("-->", position):
        return True
    behind = text[position - 1 : position] == ")" or text.startswith("--[", position)
    return behind and "BARE_ANY" in actions and text.startswith("--", position)


def _rank(text: str, position: int, terminal: Terminal) -> tuple[int, int, bool]:
    return terminal.length_at(text, position), terminal.priority, bool(terminal.literal)


_CLOSING: Final = "RPAR"


def _take(machine: Tables, stack: list[_StackEntry], token: Token, text: str) -> None:
    """Process a token: complete all grammar rules that end before it, then put it on the stack."""
    before = [*stack]
    while True:
        action = machine.states[stack[-1].state].get(token.name)
        if action is None:
            # A closing bracket reduces all open rules, even without an opening bracket.
            shown = before if token.name == _CLOSING else stack
            raise _unexpected(machine, shown, text, token.span.start)
        if action >= 0:
            break
        rule = machine.rules[-1 - action]
        _reduce(machine, stack, rule, text)
        if stack[-1].state == machine.end:
            return
    if len(stack) > MAX_DEPTH:
        raise QuerySyntaxError("nested too deeply", text=text, span=token.span)
    stack.append(_StackEntry(action, token, token.span))


def _reduce(machine: Tables, stack: list[_StackEntry], rule: Rule, text: str) -> None:
    first = len(stack) - rule.size
    parts = stack[first:]
    del stack[first:]
    end = stack[-1].span.end  # the end of the previous part, used for an empty part
    span = TextSpan(parts[0].span.start, parts[-1].span.end) if parts else TextSpan(end, end)
    value = _built(rule, _children(rule, parts), span, text)
    state = machine.states[stack[-1].state][rule.origin]
    stack.append(_StackEntry(state, value, span))


def _children(rule: Rule, parts: list[_StackEntry]) -> list[Any]:
    """Return the values of a grammar rule's parts: flat lists, and None for absent parts."""
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


def _built(rule: Rule, children: list[Any], span: TextSpan, text: str) -> Any:
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


_OPERATORS: Final = frozenset(
    {"COMPARE", "SIGN", "STAR", "SLASH", "PERCENT", "AND", "OR", "XOR", "IMPLIES", "IS", "IN"}
    | {"STARTS", "ENDS", "CONTAINS", "EQUAL", "UNTIL_OP", "UNTIL_LINK", "NOT", "OVER"}
)
_EDGES: Final = frozenset({"BARE_RIGHT", "BARE_LEFT", "BARE_ANY", "_OPEN", "_OPEN_LEFT"})
_OF_TOPICS: Final = frozenset({"FIELD", "SPAN", "_ITEM"})
"""Grammar terminals that only topics use. Error messages do not list them."""
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
    | {"_ARROW", "_GROUP", "HAVING", "OPTIONAL", "PATH_NAME", "SKIP", "UNION", "WITH"}
)
"""Grammar terminals that error messages omit, to keep the list short: temporal words and synonyms."""

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
"""Descriptions of grammar terminals for error messages."""

_MANY: Final = 8
_LONGEST: Final = 40


def _unexpected(
    machine: Tables, stack: list[_StackEntry], text: str, position: int
) -> QuerySyntaxError:
    if blank := _BLANK.match(text, position):
        position = blank.end()
    found = _NEXT.match(text, position)
    span = TextSpan(position, found.end() if found else position)
    names = [name for name in machine.states[stack[-1].state] if name.isupper() or name == _END]
    names = [name for name in names if _leads_on(machine, stack, name)]
    here = f"found {_shown(found[0])}" if found else "the text ends"
    reason = f"expected {_listed(machine, names)}, but {here}"
    return QuerySyntaxError(reason, text=text, span=span, hint=_hint(machine, names, text, span))


def _shown(found: str) -> str:
    """Return part of the query text for an error message: short, and with all characters visible."""
    if not found.isprintable():
        return " ".join(f"U+{ord(character):04X}" for character in found[:8])
    short = found if len(found) <= _LONGEST else f"{found[:_LONGEST]}…"
    return short if len(found) > 1 and found[0] in "'\"" else f"'{short}'"


def _leads_on(machine: Tables, stack: list[_StackEntry], name: str) -> bool:
    """True if the parser accepts a terminal symbol (kind of token) as the next one."""
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
    """Return the terminal symbols that the parser expects, as words for an error message.

    Operators form a group, as do starts of values.
    """
    left = set(names) - _LATER or set(names)
    left -= _OF_TOPICS
    said: list[str] = []
    if "RETURN" in left:  # a second MATCH is allowed wherever RETURN is
        left -= {"MATCH"}
    if left >= _EDGES:
        said.append("an edge")
        left -= _EDGES
    if "MATCH" in left:
        left -= {"NOT"}
    if left >= _STARTS:
        said += ["a value", "a condition"]
        left -= _STARTS | {
            "NAME",
            "LPAR",
            "LSQB",
            "COUNT",
            "AGGREGATE",
            "DURATION",
            "TEMPORAL",
            "WINDOW",
        }
        left -= {"CASE", "HAPPENS"}
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


def _hint(machine: Tables, names: list[str], text: str, span: TextSpan) -> str | None:
    bracket = bracket_hint(text, span.start, text[span.start : span.end])
    if bracket:
        return bracket
    words = [machine.terminals[name].literal for name in names if name in machine.terminals]
    return slip_hint(text, span.start, span.end, places(names), words)
