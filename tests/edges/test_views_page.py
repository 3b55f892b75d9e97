"""The page of the public views says what the schema says; ``SGSTORE_UPDATE_GOLDEN=1`` brings it in line.

What stands before the first view, and the example of each, are written by hand.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import duckdb

import sgstore
from sgstore.model.vocabulary import OWN_KINDS, SUPER_KINDS
from sgstore.store import StoreFile

SCHEMA = Path(sgstore.__file__).with_name("schema.sql")
ELSEWHERE = {
    "pairs": (
        "distance: ",
        "[The language](language.md#functions) explains the numbers."
        " For distances along lanes LEFT JOIN lane_dists USING (frame_id, src, dst).",
    ),
    "criticality": (
        "dce: ",
        "[Criticality](criticality.md) explains the measures. They are NULL if an input is unknown.",
    ),
}
"""View → the first number that its comment explains, and the sentence in place of all of them."""
PAGE = Path(__file__).parents[2] / "docs" / "views.md"


def page(now: str, store: Path) -> str:
    """The page with what the schema says of each view, and what else it holds now."""
    StoreFile.create(store).close()
    connection = duckdb.connect(str(store), read_only=True)
    sql = (
        "SELECT view_name, comment FROM duckdb_views() WHERE NOT internal AND schema_name = 'main'"
    )
    comments = dict(connection.execute(sql).fetchall())
    names = re.findall(
        r"^CREATE VIEW main\.(\w+)", SCHEMA.read_text(encoding="utf-8"), re.MULTILINE
    )
    views = [(name, comments.pop(name)) for name in names if name in comments]
    assert comments == {}
    intro, *sections = re.split(r"^## ", now, flags=re.MULTILINE)
    examples = {section.split("\n")[0]: example_of(section) for section in sections}
    parts, places = [intro], dict[str, str]()
    for name, comment in views:
        described = connection.execute(f"DESCRIBE {name}").fetchall()
        columns = ", ".join(f"`{column}` {short(kind)}" for column, kind, *_ in described)
        same = places.setdefault(columns, name)
        if same != name:
            columns = f"Columns as in [{same}](#{same})."
        meaning = shortened(name, comment)
        parts.append(f"## {name}\n\n{meaning}\n\n{columns}\n\n{examples.get(name, '')}")
    return "".join(parts).rstrip("\n") + "\n"


def shortened(name: str, comment: str) -> str:
    """The comment of a view, with a link in place of the meanings of numbers of pairs."""
    first, page = ELSEWHERE.get(name, ("", ""))
    return f"{comment.partition(first)[0]}{page}" if first else comment


def example_of(section: str) -> str:
    found = re.search(r"```sql\n.*?```\n", section, re.DOTALL)
    return f"{found[0]}\n" if found else ""


def short(kind: str) -> str:
    return "word" if kind.startswith("ENUM") else kind.lower()


def test_the_page_says_what_the_schema_says(tmp_path: Path) -> None:
    now = PAGE.read_text(encoding="utf-8")
    text = page(now, tmp_path / "empty.sgstore")
    if os.environ.get("SGSTORE_UPDATE_GOLDEN"):
        PAGE.write_text(text, encoding="utf-8")
        now = text

    assert now == text


def test_every_view_but_of_imports_has_an_example() -> None:
    sections = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    without = {section.split("\n")[0] for section in sections if not example_of(section)}

    assert without <= {"imports", "edge_attributes"}
    assert len(sections) >= 11


def test_the_page_lists_the_kinds_and_their_groups() -> None:
    intro = PAGE.read_text(encoding="utf-8").partition("## ")[0]
    kinds = re.findall(r"`(\w+)`", intro.partition("**Kinds.** `kind`")[2].partition("Imported")[0])
    groups = {name: tuple(its.split(", ")) for name, its in re.findall(r"\* `(\w+)`: (.+)", intro)}

    assert tuple(kinds) == OWN_KINDS
    assert groups.pop("entity") == ("all kinds of entities",)
    assert groups == {name: its for name, its in SUPER_KINDS.items() if name != "entity"}
