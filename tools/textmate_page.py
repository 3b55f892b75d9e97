"""``editors/sgql.tmLanguage.json``: highlighting for editors that take TextMate grammars.

Words, numbers, texts and durations are those of the terminals of the grammar; a name before a bracket is a
function::

    python tools/textmate_page.py
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, Final

from sgstore.lang.syntax._tables import tables

PAGE: Final = Path(__file__).parents[1] / "editors" / "sgql.tmLanguage.json"
_CONSTANTS: Final = {"TRUE", "FALSE", "NULL", "INF"}
_OF_TIME: Final = {"THEN", "UNTIL", "WHILE", "WITHIN", "AFTER", "IMMEDIATELY", "FOR", "HOLDS"}
_LOGIC: Final = {"AND", "OR", "XOR", "NOT", "IMPLIES", "IN", "IS", "CONTAINS", "STARTS", "ENDS"}


def keywords() -> set[str]:
    """All words of the grammar, in capitals."""
    words: set[str] = set()
    for terminal in tables().terminals.values():
        if terminal.pattern is not None:
            words |= set(re.findall(r"(?<![\\\w])[A-Z]{2,}", terminal.pattern.pattern))
        elif terminal.literal.isalpha():
            words.add(terminal.literal)
    return words


def any_of(words: set[str]) -> str:
    return rf"(?i)\b(?:{'|'.join(sorted(words))})\b"


def rule(name: str, match: str) -> dict[str, str]:
    return {"name": f"{name}.sgql", "match": match}


def grammar() -> dict[str, Any]:
    """The grammar as TextMate has it: the first rule that fits takes a piece of text."""
    words, temporal = keywords(), terminal_words("TEMPORAL") | terminal_words("UNTIL_OP")
    rest = words - _CONSTANTS - _LOGIC - _OF_TIME - temporal
    text = {"match": r"\\.", "name": "constant.character.escape.sgql"}
    patterns: list[dict[str, Any]] = [
        {"name": "comment.block.sgql", "begin": r"/\*", "end": r"\*/"},
        rule("comment.line.double-dash", r"--(?!>|\s*\(|\[).*$"),
        {"name": "string.quoted.single.sgql", "begin": "'", "end": "'", "patterns": [text]},
        {"name": "string.quoted.double.sgql", "begin": '"', "end": '"', "patterns": [text]},
        rule("constant.numeric.duration", r"(?i)\b\d+(?:\.\d+)?(?:ms|s|min|frames)\b"),
        rule("constant.numeric", r"\b\d+(?:\.\d+)?(?:[eE][+-]?\d+)?\b"),
        rule("variable.parameter", r"\$[A-Za-z_]\w*"),
        {
            "match": r"(:)\s*(!?[A-Za-z_]\w*(?:\s*[|&]\s*!?[A-Za-z_]\w*)*)",
            "captures": {
                "1": {"name": "punctuation.separator.sgql"},
                "2": {"name": "entity.name.type.sgql"},
            },
        },
        rule("variable.other.property", r"(?<=\w\.)[A-Za-z_]\w*"),
        rule("keyword.operator.temporal", any_of(temporal)),
        rule("keyword.control.sequence", any_of(_OF_TIME & words)),
        rule("keyword.operator.logical", any_of(_LOGIC & words)),
        rule("constant.language", any_of(_CONSTANTS)),
        rule("keyword.control", any_of(rest)),
        rule("support.function", r"[A-Za-z_]\w*(?=\()"),
        rule("keyword.operator.arrow", r"<?-\[|\]->?|-->|<--"),
        rule("keyword.operator", r"=>|=~|<>|!=|<=|>=|[<>=+*/%-]"),
    ]
    return {
        "$schema": "https://raw.githubusercontent.com/martinring/tmlanguage/master/tmlanguage.json",
        "name": "SGQL",
        "scopeName": "source.sgql",
        "fileTypes": ["sgql"],
        "patterns": patterns,
    }


def terminal_words(name: str) -> set[str]:
    """The words that a terminal stands for."""
    found = tables().terminals[name].pattern
    return set() if found is None else set(re.findall(r"[A-Z]{2,}", found.pattern))


def written() -> str:
    return json.dumps(grammar(), indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(written(), encoding="utf-8")
