"""Words of users' SQL statements: views of graphs, and kinds of nodes with the macro ``is_a``."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sgstore.base.display import first_of
from sgstore.base.quoting import literal
from sgstore.model.vocabulary import (
    EVENT_KINDS,
    SUPER_KINDS,
    kinds_labelled,
    known_names,
    labels,
    normalize_name,
    suggestion,
)
from sgstore.store._schema import WORLD_VIEWS, tokens_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from duckdb import DuckDBPyConnection

_OF_GRAPHS: Final = frozenset({*WORLD_VIEWS, "edges", "lane_courses", "lane_gaps"})
_OF_WORLD: Final = frozenset(f"world_{name}" for name in WORLD_VIEWS)
_KIND_COLUMNS: Final = {"kind", "src_kind", "dst_kind"}


def world_read(sql: str) -> bool | None:
    """True if a statement reads only ``world_…`` views, False if it reads views of graphs, else ``None``.

    >>> world_read("FROM pairs"), world_read("FROM world_pairs"), world_read("FROM frames")
    (False, True, None)
    """
    words = {word.lower() for word in tokens_of(sql)}
    return False if words & _OF_GRAPHS else True if words & _OF_WORLD else None


def kind_notes(sql: str) -> tuple[str, ...]:
    """If a statement compares ``kind`` with a group of kinds or an unknown word, return notes about it.

    >>> kind_notes("SELECT * FROM nodes WHERE kind = 'vru'")
    ("kind = 'vru' is a group of kinds (person, bicycle, motorcycle); write is_a(kind, 'vru')",)
    """
    words = tokens_of(sql)
    lower = [word.lower() for word in words]
    if not {*lower} & {*_OF_GRAPHS, *_OF_WORLD, "entities", "events"}:
        return ()
    known = {*known_names("kind"), *(EVENT_KINDS if "events" in lower else ())}
    groups = {normalize_name(name): name for name in SUPER_KINDS}
    notes: list[str] = []
    for column, word in _compared(lower, words):
        group = groups.get(normalize_name(word))
        if group is not None:
            kinds = first_of(tuple(SUPER_KINDS[group]), 4)
            means = f"is a group of kinds ({kinds})"
            means = "means only vehicles of unknown type" if word in known else means
            notes.append(f"{column} = '{word}' {means}; write is_a({column}, '{group}')")
        elif word not in known:
            like = suggestion(word, known)
            hint = f"did you mean '{like}'?" if like else "'sgstore docs views' lists the kinds"
            notes.append(f"{column} = '{word}': unknown kind; {hint}")
    return tuple(dict.fromkeys(notes))


def _compared(lower: list[str], words: list[str]) -> Iterator[tuple[str, str]]:
    """For each comparison of a column of kinds with a text, yield the column and the text."""
    for place, column in enumerate(lower):
        if column not in _KIND_COLUMNS:
            continue
        sign = lower[place + 1] if place + 1 < len(lower) else ""
        if sign not in {"=", "<>", "!=", "in"}:
            continue
        for word in words[place + 2 :]:
            if word.startswith("'"):
                yield column, word[1:-1].replace("''", "'")
            elif word not in {"(", ","}:
                break
            if sign != "in":
                break


_MAY_CALL: Final = re.compile(r"(?i)\bis_a\s*\(")


def show_is_a(connection: DuckDBPyConnection, sql: str | None = None) -> None:
    """Create the macro ``is_a(kind, 'vehicle')`` on a connection, if a statement may call it.

    ``sql`` ``None`` means any statement.
    """
    if sql is not None and not _MAY_CALL.search(sql):
        return
    kinds = {normalize_name(label): kinds_labelled(label) for label in labels()}
    cases = " ".join(
        f"WHEN {literal(name)} THEN kind::VARCHAR IN ({', '.join(map(literal, its))})"
        for name, its in kinds.items()
        if its
    )
    unknown = "error('unknown kind or group of kinds: ' || name || '; see sgstore docs views')"
    connection.execute(
        "CREATE OR REPLACE TEMP MACRO is_a(kind, name) AS"
        f" CASE lower(replace(name, '_', '')) {cases} ELSE {unknown} END"
    )
