"""Text of ``schema.sql``, and SQL statements as lists of tokens, for the comparison of schemas."""

from __future__ import annotations

import re
from functools import cache, lru_cache
from importlib import resources
from typing import TYPE_CHECKING, Final

from sgstore.model.pair_numbers import pairs_view

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    Tokens = tuple[str, ...]
    Objects = tuple[tuple[str, str, str, str | Tokens], ...]

INSIDE: Final = "inside"
"""Schema of a store's tables and internal views. Public views and column types are in ``main``."""

_TOKEN: Final = re.compile(
    r"""(?P<gap>\s+|--[^\n]*)|(?P<text>'(?:[^']|'')*')|(?P<name>"(?:[^"]|"")*")
    |(?P<number>\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)|(?P<word>\w+)|(?P<sign><>|!=|<=|>=|::|>>|<<|//|\|\||.)""",
    re.VERBOSE | re.DOTALL,
)

_PLAIN: Final = re.compile(r'"[A-Za-z_]\w*"', re.ASCII)

_TRUTH: Final = {"'t'": "true", "'f'": "false"}


@cache
def schema_sql() -> str:
    """Return the text of ``schema.sql``: types, tables and views."""
    text = resources.files("sgstore").joinpath("schema.sql").read_text(encoding="utf-8")
    for view in ("pairs", "criticality"):
        made, numbers = pairs_view(view)
        text = text.replace(f"{{{{{view}}}}}", made)
        text = text.replace(f"{{{{numbers of {view}}}}}", numbers.replace("'", "''"))
    for table in BEYOND:
        text = text.replace(f"{{{{columns of {table}}}}}", _between(text, f"TABLE {table} (", ");"))
    for view, tables in _VIEWS_BEYOND.items():
        made = _between(text, f"VIEW main.{view} AS", ";")
        for table, other in tables.items():
            made = re.sub(rf"\b{INSIDE}\.{table}\b", f"{INSIDE}.{other}", made)
        text = text.replace(f"{{{{world_{view}}}}}", made)
    return text


BEYOND: Final = {
    name: f"world_{name}"
    for name in (
        "state",
        "node",
        "edge",
        "lane_single",
        "lane_repeated",
        "gap_single",
        "gap_repeated",
    )
}
"""Graph tables → tables of the data outside the graphs, with the same columns."""

_VIEWS_BEYOND: Final[Mapping[str, Mapping[str, str]]] = {
    "nodes": BEYOND,
    "lane_states": BEYOND,
    "pairs": {"state": "known_state"},
    "criticality": {"state": "known_state"},
    "lane_dists": {"lane_state": "known_lane_state"},
}
"""Views of graphs → replaced tables, which give the views with the data outside the graphs."""


def _between(text: str, before: str, behind: str) -> str:
    return text.partition(f"CREATE {before}")[2].partition(behind)[0].strip()


@cache
def statements() -> tuple[Tokens, ...]:
    """Return the SQL statements of ``schema.sql`` as lists of tokens."""
    found: list[list[str]] = [[]]
    for word in tokens_of(schema_sql()):
        if word == ";":
            found.append([])
        else:
            found[-1].append(word)
    return tuple(map(tuple, found[:-1]))


def tokens_of(sql: str) -> list[str]:
    """Split an SQL statement into tokens, without comments, quotes of plain names and casts of constants."""
    found: list[str] = []
    for match in _TOKEN.finditer(sql):
        word = match[0]
        if match["gap"]:
            continue
        if match["name"] and _PLAIN.fullmatch(word):
            word = word[1:-1]
        elif match["number"] and not word.isdigit():
            word = repr(float(word))
        found.append(word)
        if word == ")" and found[-6:-4] == ["CAST", "("] and found[-3] == "AS":
            constant, kind = found[-4], found[-2]
            if kind == "BOOLEAN" and constant in _TRUTH:
                found[-6:] = [_TRUTH[constant]]
            elif kind == "DOUBLE" and re.fullmatch(r"[\d.e+-]+", constant):
                found[-6:] = [repr(float(constant))]
    return found


@lru_cache(maxsize=256)
def statement(sql: str) -> Tokens:
    words = tokens_of(sql)
    return tuple(words[:2] + words[4:] if words[3:4] == ["."] else words)


def with_types(words: Tokens, types: dict[str, Tokens]) -> Iterator[str]:
    """Yield the tokens of a CREATE TABLE statement, with each enumeration type replaced by its values."""
    before = ""
    for number, word in enumerate(words):
        # A type follows the name of a column. Both can be equal.
        named = number > 3 and before not in {"(", ","}
        yield from types[word] if named and word in types else (word,)
        before = word
