"""Translator of LTLf formulas (temporal logic on finite traces), as ``ltlf2dfa`` writes them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sgstore.errors import QueryError, TextSpan
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Mapping

MAX_TIMES: Final = 10_000
"""Largest ``N`` of ``$[N][…]``; frames."""

_TOKEN: Final = re.compile(r"\s*(?:(->|<->|\$\[[0-9]+\]\[|[&|~!()\]])|(\w+))")
_UNARY: Final = {
    "G": "ALWAYS",
    "F": "EVENTUALLY",
    "X": "NEXT",
    "WX": "WEAKNEXT",
    "~": "NOT",
    "!": "NOT",
}
_BINARY: Final = (("<->",), ("->",), ("|",), ("&",), ("U", "R"))
_WORDS: Final = {"->": "IMPLIES", "|": "OR", "&": "AND", "U": "UNTIL", "R": "RELEASE"}


class LtlFormula:
    """Translator of temporal logic formulas (LTLf), as ``ltlf2dfa`` writes them.

    ``$[N][…]`` means N frames in a row.
    """

    def __init__(self, text: str, defined: Mapping[str, str]) -> None:
        self._formula = text
        self._defined = {normalize_name(name): name for name in defined}
        self._tokens = self._read(text)
        self._at = 0

    def text(self) -> str:
        found = self._binary(0)
        if self._at < len(self._tokens):
            raise self._refused(f"unexpected '{self._tokens[self._at][0]}'")
        return found

    def _read(self, text: str) -> list[tuple[str, int]]:
        tokens: list[tuple[str, int]] = []
        at = 0
        while text[at:].strip():
            match = _TOKEN.match(text, at)
            if match is None:
                raise QueryError(
                    "unexpected character in the formula", text=text, span=TextSpan(at, at + 1)
                )
            tokens.append((match[1] or match[2], match.end()))
            at = match.end()
        return tokens

    def _peek(self) -> str:
        return self._tokens[self._at][0] if self._at < len(self._tokens) else ""

    def _take(self) -> str:
        token = self._peek()
        self._at += 1
        return token

    def _binary(self, level: int) -> str:
        if level == len(_BINARY):
            return self._unary()
        left = self._binary(level + 1)
        while self._peek() in _BINARY[level]:
            sign = self._take()
            right = self._binary(level if sign in {"->", "U", "R"} else level + 1)
            left = (
                f"NOT ({left} XOR {right})" if sign == "<->" else f"({left} {_WORDS[sign]} {right})"
            )
        return left

    def _unary(self) -> str:
        word = self._take()
        if word in _UNARY:
            return f"{_UNARY[word]} ({self._unary()})"
        if word == "(":
            return self._closed(self._binary(0), ")")
        if word.startswith("$["):
            times = int(word[2:-2]) if len(word) <= len("$[][") + 9 else MAX_TIMES + 1
            return self._in_a_row(times, self._closed(self._binary(0), "]"))
        if word in {"true", "false"}:
            return word.upper()
        name = self._defined.get(normalize_name(word))
        if name is None:
            raise self._refused(f"unknown proposition '{word}'")
        return f"{name}()"

    def _closed(self, inner: str, bracket: str) -> str:
        if self._take() != bracket:
            raise self._refused(f"expected '{bracket}'")
        return f"({inner})"

    def _in_a_row(self, times: int, inner: str) -> str:
        """Return a condition: true if a formula is true in N consecutive frames at some time."""
        if not 0 < times <= MAX_TIMES:
            raise self._refused(f"expected 1 to {MAX_TIMES} frames")
        last = times - 1
        return (
            f"EVENTUALLY (ALWAYS[0frames, {last}frames] {inner}"
            f" AND EVENTUALLY[{last}frames, {last}frames] TRUE)"
        )

    def _refused(self, reason: str) -> QueryError:
        at = self._tokens[min(self._at, len(self._tokens)) - 1][1] if self._tokens else 0
        return QueryError(reason, text=self._formula, span=TextSpan(max(at - 1, 0), max(at, 1)))
