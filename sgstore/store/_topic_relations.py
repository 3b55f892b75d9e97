"""SQL views with the value of a topic at each frame. They are created for statements that name them.

The values are computed once per process and state of the store, and kept as Parquet files in the folder of user
tables, because a query has one statement for each window of frames.
"""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING, Final

from sgstore.base.quoting import literal, quoted
from sgstore.lang.catalog import TOPIC, TopicValue
from sgstore.lang.topics import find_field
from sgstore.store._engine_errors import move
from sgstore.store._interrupts import interruptible
from sgstore.store._lease import stamp_of

if TYPE_CHECKING:
    from pathlib import Path

    from duckdb import DuckDBPyConnection

    from sgstore.store._locking import Access

_NAMED: Final = re.compile(rf'"({TOPIC}(?:[^"]|"")*)"')


def show_topic_values(connection: DuckDBPyConnection, access: Access, sql: str) -> None:
    """Create the views of topic values that a statement uses."""
    from sgstore.store._joins import tables_folder  # most statements use no topics

    for name in dict.fromkeys(_NAMED.findall(sql)):
        relation = name.replace('""', '"')
        key = repr((str(access.path.resolve()), stamp_of(access.path), relation))
        digest = hashlib.sha256(key.encode("utf-8", "replace")).hexdigest()
        place = tables_folder() / "topics" / f"{digest[:32]}.parquet"
        if not place.exists():
            _write(connection, access, relation, place)
        rows = f"FROM read_parquet({literal(str(place))})"
        connection.execute(f"CREATE OR REPLACE TEMP VIEW {quoted(relation)} AS {rows}")


def _write(connection: DuckDBPyConnection, access: Access, relation: str, place: Path) -> None:
    """Write the values of a topic at all frames to a Parquet file."""
    from sgstore.store._topic_views import topic_facts, topic_values

    one = TopicValue.of(relation)
    assert one is not None, relation  # noqa: S101 - the pattern ensures it
    # Booleans convert to any type, so the columns of several parts can be joined.
    made = "SELECT CAST(NULL AS BIGINT) AS frame_id, CAST(NULL AS BOOLEAN) AS value LIMIT 0"
    topic = topic_facts(connection, access).get(one.topic)
    # A part of a collection may lack the topic, or the field.
    if topic is not None and find_field(topic.source(), one.field):
        made = topic_values(connection, access, topic, one.field, one.rule, one.tolerance_ns)
    place.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    part = place.with_suffix(f".{id(connection)}")
    copy = f"COPY (FROM ({made}) ORDER BY frame_id) TO {literal(str(part))} (FORMAT parquet)"
    interruptible(connection, lambda: connection.execute(copy))
    move(part, place, f"{place}: cannot be written")
