"""Every query that stands anywhere in the documentation is asked of a store: patterns, checks and SQL."""

from __future__ import annotations

import ast
import re
import shlex
from itertools import islice
from pathlib import Path
from textwrap import dedent
from typing import TYPE_CHECKING

import pytest

import sgstore
from sgstore.lang.library import patterns
from sgstore.model.config import Config
from sgstore.pipeline.derive import derive
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.seconds(17)

ROOT = Path(__file__).parents[2]
OF_ITS_OWN = {"cookbook"}
"""A page that is asked of the stores that it speaks of."""
PAGES = [
    page
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
    if page.stem not in OF_ITS_OWN
]
BEGINS = re.compile(r"\s*(MATCH|USING|DEFINE|CHECK|SELECT|WITH|DESCRIBE|FROM)\b")
ASKS = re.compile(r"MATCH\s*\(|^CHECK\s|\bCHECK\s.*\bALWAYS|FROM\s|^DESCRIBE\s", re.MULTILINE)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
INDENTED = re.compile(r"(?:^    .*\n)+", re.MULTILINE)
ROWS = 3


def queries_of(page: str) -> list[str]:
    """All texts of a page that begin as a query does: blocks, arguments of commands, strings, code."""
    found: list[str] = []
    for language, block in FENCE.findall(page):
        if language in {"sgql", "sql", ""}:
            found += statements(block)
        elif language in {"sh", "console"}:
            found += arguments(block)
        elif language == "python":
            strings = (n.value for n in ast.walk(ast.parse(block)) if isinstance(n, ast.Constant))
            found += [s for s in strings if isinstance(s, str)]
    rest = FENCE.sub("", page)
    for block in INDENTED.findall(rest):
        found += statements(dedent(block))
    found += re.findall(r"`([^`\n]+)`", rest)
    whole = [text.strip() for text in found if BEGINS.match(text) and "…" not in text]
    return [text for text in dict.fromkeys(whole) if ASKS.search(text)]


def statements(block: str) -> list[str]:
    """A block as one query; or as several, one for each line that begins one with no definition before it."""
    if "DEFINE" in block or re.search(r"\b(THEN|UNTIL|WHILE)\b", block):
        return [block]
    return re.split(r"\n(?=MATCH\b)", block) if BEGINS.match(block) else []


def arguments(block: str) -> list[str]:
    lines = re.sub(r"\\\n", " ", block).splitlines()
    commands = [line.removeprefix("$ ") for line in lines]
    tokens = (shlex.split(line, comments=True) for line in commands if "sgstore " in line)
    return [
        token.split("=", 1)[-1] if "=MATCH" in token else token for line in tokens for token in line
    ]


@pytest.fixture(scope="module")
def store(town_store: Path) -> Iterator[sgstore.Store]:
    labels = town_store.with_name("labels.csv")
    derive(town_store, Config(), "near")
    frames = sgstore.open(town_store).sql(
        "SELECT frame_id, seq % 5 AS score, 2.0 AS error_deg FROM frames"
    )
    frames.csv(labels)
    notes = town_store.with_name("notes.csv")  # tags of the explorer
    notes.write_text("trace,seq,tag,note,who,at\ntown,12,check this,,,\n")
    close = town_store.with_name("close.csv")  # of sgstore criticality
    close.write_text("trace,src,dst,kind,pet\ntown,0,4,car,1.2\n")
    store = sgstore.open(town_store, tables={"labels": labels, "notes": notes, "close": close})
    with store.file.snapshot():
        yield store


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_queries_of_a_page_are_answered(page: Path, store: sgstore.Store) -> None:
    # Those of the library are asked by their own tests: of scenes, and of this recording, too.
    known = {one.text for one in patterns().values()}
    for text in queries_of(page.read_text(encoding="utf-8")):
        if text in known:
            continue
        if (
            "topic('/planner')" in text
        ):  # The sample has no planner. Those of the cookbook are answered.
            ask = store.check if text.startswith("CHECK") else store.find
            with pytest.raises(sgstore.errors.QueryNameError, match="no topic '/planner'"):
                list(ask(text))
            continue
        if text.startswith(("SELECT", "WITH", "DESCRIBE", "FROM")):
            store.sql(text, max_rows=ROWS)
        elif re.search(r"^CHECK\b.*^MATCH\b", text, re.MULTILINE | re.DOTALL):
            watched(text, store)
        elif re.search(r"^CHECK\b", text, re.MULTILINE):
            assert {verdict.trace for verdict in store.check(text)} == {"town"}
        else:
            list(islice(store.find(text), ROWS))


def watched(text: str, store: sgstore.Store) -> None:
    """What checks and searches at once is for a monitor."""
    given = dict.fromkeys(re.findall(r"\$(\w+)", text), 10)
    monitor = Monitor(text, parameters=given)
    for seq in range(ROWS):
        monitor.look([store.file.graph(f"town#{seq}")])
    assert len(monitor.finish()) == text.count("CHECK ")


def test_queries_are_found_wherever_they_stand() -> None:
    page = (
        "# Page\n\n    MATCH (a)\n    WHERE a.x > 1\n\n```sgql\nMATCH (b)\n```\n\n```sh\n"
        "sgstore find s 'MATCH (c)' --json  # MATCH (no)\n```\n\n"
        '```python\nstore.find("MATCH (d)")\n```\n\nInline `MATCH (e) RETURN FRAMES`, `MATCH …`, `MATCH`.\n'
        '```console\n$ sgstore sql s "SELECT 1 FROM frames"\n```\n'
    )

    assert sorted(queries_of(page)) == [
        "MATCH (a)\nWHERE a.x > 1",
        "MATCH (b)",
        "MATCH (c)",
        "MATCH (d)",
        "MATCH (e) RETURN FRAMES",
        "SELECT 1 FROM frames",
    ]


def test_most_pages_with_queries_are_among_them() -> None:
    numbers = {page.stem: len(queries_of(page.read_text(encoding="utf-8"))) for page in PAGES}

    assert numbers["language"] > 14
    assert numbers["README"] > 5
