"""Parser tables (LALR(1)) of the query grammar. They are computed once, and stored in a file.

Lark needs about 200 ms to compute the tables of ``grammar.lark``. They are stored in ``grammar.json``, with
the digest of the grammar, and load in 6 ms. If the file is missing or outdated, the tables are computed again
in memory.

``python -m sgstore.lang.syntax._tables`` writes the file. A test fails if the file is outdated.
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
    """Terminal symbol (smallest unit) of the query grammar: a fixed text or a pattern.

    Attributes
    ----------
    name : str
    literal : str
        Text in capitals; empty if the terminal is a pattern.
    pattern : re.Pattern or None
    priority : int
        Priority among terminals that match the same text.
    """

    name: str
    literal: str
    pattern: re.Pattern[str] | None
    priority: int

    def length_at(self, text: str, start: int) -> int:
        """Return the length of the text that the terminal matches from ``start`` on; 0 without a match.

        Words must match as a whole.
        """
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
    """Rule of the query grammar, with all values that the parser needs to apply it.

    Attributes
    ----------
    origin, name : str
        The symbol that the rule produces, and the name of the builder.
    size : int
        Number of symbols.
    keep : tuple of bool
        For each symbol: true if it is passed to the builder as a child.
    absent : tuple of int
        Number of absent children before each symbol and after the last; empty if there are none.
    inline : bool
        True if a single child is returned without a builder.
    """

    origin: str
    name: str
    size: int
    keep: tuple[bool, ...]
    absent: tuple[int, ...]
    inline: bool


@dataclass(frozen=True, slots=True)
class Tables:
    """Tables of an LALR(1) parser: terminals, rules and states.

    Attributes
    ----------
    terminals : dict of str to Terminal
    rules : tuple of Rule
    states : tuple of dict
        For each state, symbol → action: ``n >= 0`` goes to state n, ``-1 - n`` reduces rule n.
    start, end : int
        The first state and the final state.
    """

    terminals: dict[str, Terminal]
    rules: tuple[Rule, ...]
    states: tuple[dict[str, int], ...]
    start: int
    end: int


@cache
def tables() -> Tables:
    """Return the parser tables of the query grammar, read from a file or computed."""
    folder = resources.files("sgstore.lang.syntax")
    grammar = folder.joinpath(GRAMMAR).read_text(encoding="utf-8")
    kept = folder.joinpath(TABLES)
    plain = json.loads(kept.read_text(encoding="utf-8")) if kept.is_file() else {}
    if plain.get("digest") != _digest(grammar):
        plain = made_from(grammar)
    return _read_tables(plain)


def keywords() -> list[str]:
    """Return the keywords of the query language in alphabetical order."""
    terminals = tables().terminals.values()
    written = [one.pattern.pattern if one.pattern else one.literal for one in terminals]
    return sorted({word for text in written for word in re.findall("[A-Z]{2,}", text)})


def made_from(grammar: str) -> dict[str, Any]:
    """Return the parser tables of a grammar as JSON data. Equal grammars have equal tables."""
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
    """Return new numbers for parser states, which are the same in each run: old → new.

    The old numbers change from run to run.
    """
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


def _read_tables(plain: dict[str, Any]) -> Tables:
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
    """Return parser tables as JSON text. Each state has its own line."""
    states = ",\n".join(json.dumps(state, separators=(",", ":")) for state in plain["states"])
    rest = {key: value for key, value in plain.items() if key != "states"}
    return f'{json.dumps(rest, separators=(",", ":"))[:-1]},\n"states":[\n{states}\n]}}\n'


if __name__ == "__main__":
    here = Path(__file__).parent
    grammar_text = (here / GRAMMAR).read_text(encoding="utf-8")
    (here / TABLES).write_text(text_of(made_from(grammar_text)), encoding="utf-8")
