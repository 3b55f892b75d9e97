"""Temporary tables with the value of a topic at each frame, made for the statements that name them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sgstore.base.quoting import quoted
from sgstore.lang.catalog import TOPIC, TopicValue

if TYPE_CHECKING:
    from pathlib import Path

    from duckdb import DuckDBPyConnection

_NAMED: Final = re.compile(rf'"({TOPIC}(?:[^"]|"")*)"')


def show_topic_values(connection: DuckDBPyConnection, path: Path, sql: str) -> None:
    """Create the tables of topic values that a statement uses, if the connection lacks them."""
    from sgstore.store._topics import topic_values  # most statements use no topics

    for name in dict.fromkeys(_NAMED.findall(sql)):
        relation = name.replace('""', '"')
        there = "SELECT 1 FROM duckdb_tables() WHERE table_name = ?"
        if connection.execute(there, [relation]).fetchone() is not None:
            continue
        one = TopicValue.of(relation)
        assert one is not None, relation  # noqa: S101 - the pattern ensures it
        made = topic_values(connection, path, one.topic, one.field, one.rule, one.tolerance_ns)
        connection.execute(f"CREATE TEMP TABLE {quoted(relation)} AS {made}")
