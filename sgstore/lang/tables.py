"""From ``grammar.lark`` to the tables that parse, once, so that a query does not pay for it.

Lark needs about 200 ms to read the grammar and work out its LALR(1) tables. They are plain data, so they
are kept beside the grammar in ``grammar.json`` with the digest of the text they were made from, and load in
6 ms. If the file is missing or stale, the tables are made again in memory: slower, never wrong.

Written by ``python -m sgstore.lang.tables``; a test says so when it is due.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final

GRAMMAR: Final = "grammar.lark"
TABLES: Final = "grammar.json"
_WORD: Final = re.compile(r"\w")


@dataclass(frozen=True, slots=True)
class Terminal:
    """A terminal: what it looks like in a text.

    Attributes
    ----------
    name : str
    literal : str
        In capitals; empty if it is a pattern.
    pattern : re.Pattern or None
    priority : int
        Decides between terminals that match the same text.
    """

    name: str
    literal: str
    pattern: re.Pattern[str] | None
    priority: int

    def length_at(self, text: str, start: int) -> int:
        """How many characters of the text from ``start`` it matches; 0: none. Words match as a whole."""
        if self.pattern is None:
            end = start + len(self.literal)
            length = len(self.literal) if text[start:end].upper() == self.literal else 0
        else:
            found = self.pattern.match(text, start)
            length = found.end() - start if found else 0
        end = start + length
        broken = length and _WORD.match(text, end) and _WORD.match(text, end - 1)
        return 0 if broken else length


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule of the grammar, as it is reduced.

    Attributes
    ----------
    origin, name : str
        The symbol that it makes, and the name of what is built.
    size : int
        Number of symbols.
    keep : tuple of bool
        Whether each symbol is a child of what is built.
    absent : tuple of int
        How many absent children stand before each symbol and after the last; empty if none do.
    inline : bool
        Whether an only child stands for itself.
    """

    origin: str
    name: str
    size: int
    keep: tuple[bool, ...]
    absent: tuple[int, ...]
    inline: bool


@dataclass(frozen=True, slots=True)
class Tables:
    """An LALR(1) parser as data.

    Attributes
    ----------
    terminals : dict of str to Terminal
    rules : tuple of Rule
    states : tuple of dict
        For each state, symbol → action: ``n >= 0`` goes to state n, ``-1 - n`` reduces rule n.
    start, end : int
        The first state, and the one that has seen everything.
    """

    terminals: dict[str, Terminal]
    rules: tuple[Rule, ...]
    states: tuple[dict[str, int], ...]
    start: int
    end: int


@cache
def tables() -> Tables:
    """The tables of the grammar that is shipped."""
    folder = resources.files("sgstore.lang")
    grammar = folder.joinpath(GRAMMAR).read_text(encoding="utf-8")
    kept = folder.joinpath(TABLES)
    plain = json.loads(kept.read_text(encoding="utf-8")) if kept.is_file() else {}
    if plain.get("digest") != _digest(grammar):
        plain = made_from(grammar)
    return _read(plain)


def made_from(grammar: str) -> dict[str, Any]:
    """The tables of a grammar as plain data, fit for JSON; the same text gives the same tables."""
    from lark import Lark
    from lark.grammar import Rule as LarkRule
    from lark.lexer import TerminalDef

    data, memo = Lark(grammar, parser="lalr", maybe_placeholders=True).memo_serialize(
        [TerminalDef, LarkRule]
    )
    table: dict[str, Any] = data["parser"]["parser"]
    rules = sorted(
        {json.dumps(_rule(value)) for value in memo.values() if value["__type__"] == "Rule"}
    )
    number = {
        key: rules.index(json.dumps(_rule(value)))
        for key, value in memo.items()
        if value["__type__"] == "Rule"
    }
    states = {
        state: {
            table["tokens"][symbol]: -1 - number[target["@"]] if reduces else target
            for symbol, (reduces, target) in actions.items()
        }
        for state, actions in table["states"].items()
    }
    order = _walk(states, table["start_states"]["start"])
    return {
        "digest": _digest(grammar),
        "start": 0,
        "end": order[table["end_states"]["start"]],
        "terminals": sorted(
            _terminal(value) for value in memo.values() if value["__type__"] == "TerminalDef"
        ),
        "rules": [json.loads(rule) for rule in rules],
        "states": [_numbered(states[state], order) for state in order],
    }


def _walk(states: dict[int, dict[str, int]], start: int) -> dict[int, int]:
    """States in an order that depends on the grammar only; lark's own numbers change from run to run."""
    order = {start: 0}
    waiting = [start]
    while waiting:
        actions = states[waiting.pop(0)]
        for _, target in sorted(actions.items()):
            if target >= 0 and target not in order:
                order[target] = len(order)
                waiting.append(target)
    return order


def _numbered(actions: dict[str, int], order: dict[int, int]) -> dict[str, int]:
    return {s: order[t] if t >= 0 else t for s, t in sorted(actions.items())}


def _rule(rule: dict[str, Any]) -> list[Any]:
    options = rule["options"]
    origin, alias = rule["origin"]["name"], rule["alias"]
    keep = [
        options["keep_all_tokens"] or not symbol.get("filter_out", False)
        for symbol in rule["expansion"]
    ]
    holes = "".join("1" if hole else "0" for hole in options["empty_indices"])
    absent = [len(ones) for ones in holes.split("0")] if holes else []
    names = [symbol["name"] for symbol in rule["expansion"]]
    return [origin, alias or origin, keep, absent, bool(options["expand1"] and not alias), names]


def _terminal(terminal: dict[str, Any]) -> list[Any]:
    pattern = terminal["pattern"]
    literal = pattern["__type__"] == "PatternStr"
    value: str = pattern["value"]
    return [
        terminal["name"],
        value.upper() if literal else "",
        "" if literal else value,
        terminal["priority"],
    ]


def _read(plain: dict[str, Any]) -> Tables:
    return Tables(
        {
            name: Terminal(
                name, literal, re.compile(regex, re.IGNORECASE) if regex else None, priority
            )
            for name, literal, regex, priority in plain["terminals"]
        },
        tuple(
            Rule(origin, name, len(keep), tuple(keep), tuple(absent), inline)
            for origin, name, keep, absent, inline, _ in plain["rules"]
        ),
        tuple(plain["states"]),
        plain["start"],
        plain["end"],
    )


def _digest(grammar: str) -> str:
    return hashlib.sha256(grammar.encode()).hexdigest()[:16]


def text_of(plain: dict[str, Any]) -> str:
    """The tables as JSON, one state a line."""
    states = ",\n".join(json.dumps(state, separators=(",", ":")) for state in plain["states"])
    rest = {key: value for key, value in plain.items() if key != "states"}
    return f'{json.dumps(rest, separators=(",", ":"))[:-1]},\n"states":[\n{states}\n]}}\n'


if __name__ == "__main__":
    here = Path(__file__).parent
    grammar_text = (here / GRAMMAR).read_text(encoding="utf-8")
    (here / TABLES).write_text(text_of(made_from(grammar_text)), encoding="utf-8")
