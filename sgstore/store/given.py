"""Rows that a statement of ours is given: a table that lasts as long as the statement is asked.

They come a block at a time, and the database moves what does not fit into memory to temporary files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sgstore.quoting import quoted

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from duckdb import DuckDBPyConnection


@dataclass(frozen=True, slots=True)
class GivenTable:
    """A table of rows that are not in the store.

    Attributes
    ----------
    name : str
        What the statement calls it; like no table of the store.
    types : mapping of str to str
        The type of each column in the database.
    blocks : iterable of sequence of list
        The columns of some rows, in the same order.
    """

    name: str
    types: Mapping[str, str]
    blocks: Iterable[Sequence[list[Any]]]


def give(connection: DuckDBPyConnection, given: Iterable[GivenTable]) -> None:
    """Make tables that nobody but this connection sees, until it is closed."""
    for table in given:
        columns = ", ".join(f"{quoted(name)} {kind}" for name, kind in table.types.items())
        name = quoted(table.name)
        connection.execute(f"CREATE OR REPLACE TEMP TABLE {name} ({columns})")
        values = ", ".join(f"unnest(CAST(? AS {kind}[]))" for kind in table.types.values())
        for block in table.blocks:
            if len(block[0]):
                connection.execute(f"INSERT INTO {name} SELECT {values}", list(block))
