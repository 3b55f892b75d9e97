"""Highlighting for editors: of the grammar as it is, and of queries as people write them."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from cookbook_page import entries
from textmate_page import PAGE, grammar, keywords, written

QUERIES = [entry.text for entry in entries() if entry.language != "sql"]


def test_the_file_is_made_from_the_grammar() -> None:
    assert PAGE.read_text(encoding="utf-8") == written(), "python tools/textmate_page.py"


def test_it_has_the_words_that_the_grammar_quotes() -> None:
    path = PAGE.parents[1] / "sgstore" / "lang" / "syntax" / "grammar.lark"
    quoted = set(re.findall(r'"([A-Z]{2,})"i', path.read_text(encoding="utf-8")))
    assert quoted <= keywords()


def highlighted(text: str) -> list[tuple[str, str]]:
    """Pieces of a text and their scopes: at each place the first rule that fits, as editors do it."""
    rules: list[dict[str, Any]] = grammar()["patterns"]
    found: list[tuple[str, str]] = []
    at = 0
    while at < len(text):
        for one in rules:
            pattern = one.get("match") or f"{one['begin']}(?:.|\n)*?{one['end']}"
            match = re.compile(pattern, re.MULTILINE).match(text, at)
            if match and match.end() > at:
                name = one.get("name") or one["captures"]["2"]["name"]
                found.append((match[0], name))
                at = match.end()
                break
        else:
            word = re.compile(r"\w+|.", re.DOTALL).match(text, at)
            assert word
            found.append((word[0], ""))
            at = word.end()
    return found


@pytest.mark.parametrize("text", QUERIES)
def test_words_in_capitals_are_words_of_the_language_and_others_are_not(text: str) -> None:
    pieces = highlighted(text)

    assert "".join(piece for piece, _ in pieces) == text
    for piece, scope in pieces:
        if re.fullmatch(r"[A-Z]{2,}", piece):
            assert scope.startswith(("keyword.", "constant.language", "support.function")), piece
        elif re.fullmatch(r"[a-z_]\w*", piece) and scope.startswith(("keyword.", "constant.l")):
            assert piece in {"match", "end", "frames"}, piece  # names that are words elsewhere


def test_texts_comments_labels_and_durations_are_told_apart() -> None:
    text = (
        "MATCH (v:Car|Bus)-[:near]->(w) -- who is near\n"
        "WHERE v.name = 'a -- b' AND prev(v.speed) > $x FOR >= 2s"
    )

    scopes = dict(highlighted(text))

    assert scopes["-- who is near"].startswith("comment.")
    assert scopes["'a -- b'"].startswith("string.")
    assert scopes[":Car|Bus"] == scopes[":near"] == "entity.name.type.sgql"
    assert scopes["2s"] == "constant.numeric.duration.sgql"
    assert scopes["$x"] == "variable.parameter.sgql"
    assert scopes["prev"] == "support.function.sgql"
    assert scopes["name"] == "variable.other.property.sgql"
    assert scopes["FOR"] == "keyword.control.sequence.sgql"
    assert json.loads(PAGE.read_text(encoding="utf-8"))["fileTypes"] == ["sgql"]
