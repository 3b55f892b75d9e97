"""Builder of SQL ``SELECT`` statements, with parameter values.

The text is portable SQL. It runs on DuckDB and can be adapted to other engines. Every identifier is quoted
and every value of the user is bound. Words of the vocabulary are literals.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from sgstore.base.quoting import quoted

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(slots=True)
class BoundValues:
    """Values of the parameters ``$1``, ``$2``, … of an SQL statement."""

    items: list[Any] = field(default_factory=list[Any])

    def add(self, value: object) -> str:
        """Add a parameter value to the SQL statement. Return the name of the parameter, such as ``$3``."""
        self.items.append(value)
        return f"${len(self.items)}"


@dataclass(slots=True)
class Select:
    """SQL ``SELECT`` statement under construction: its columns, tables and conditions.

    If ``lenient``, tables are joined by ``LEFT JOIN``, so rows without a partner are kept.
    """

    columns: list[str] = field(default_factory=list[str])
    tables: list[str] = field(default_factory=list[str])
    where: list[str] = field(default_factory=list[str])
    group: list[str] = field(default_factory=list[str])
    having: list[str] = field(default_factory=list[str])
    order: list[str] = field(default_factory=list[str])
    limit: int | None = None
    offset: int = 0
    distinct: bool = False
    lenient: bool = False

    def text(self) -> str:
        """Return the text of the ``SELECT`` statement."""
        head = "SELECT DISTINCT " if self.distinct else "SELECT "
        lines = [head + ",\n  ".join(self.columns)]
        lines += ["FROM " + "\n  ".join(self.tables)] if self.tables else []
        lines += ["WHERE " + "\n  AND ".join(self.where)] if self.where else []
        lines += ["GROUP BY " + ", ".join(self.group)] if self.group else []
        lines += ["HAVING " + "\n  AND ".join(self.having)] if self.having else []
        lines += ["ORDER BY " + ", ".join(self.order)] if self.order else []
        lines += [f"LIMIT {self.limit}"] if self.limit is not None else []
        lines += [f"OFFSET {self.offset}"] if self.offset else []
        return "\n".join(lines)

    def join(self, table: str, conditions: Sequence[str], how: str = "JOIN") -> None:
        """Join a table to the ``SELECT`` statement. Without conditions, it is a cross join."""
        if not self.tables:
            self.tables.append(table)
            self.where += conditions
        elif conditions:
            how = "LEFT JOIN" if self.lenient else how
            self.tables.append(f"{how} {table} ON " + " AND ".join(conditions))
        else:
            self.tables.append(f"CROSS JOIN {table}")


def indented(text: str) -> str:
    """Return SQL text with indentation, for use inside another statement."""
    return "\n".join(f"    {line}" for line in text.splitlines())


def nested(text: str, name: str) -> str:
    """Return SQL text in brackets and with a name, for the ``FROM`` of another statement."""
    return f"(\n{indented(text)}\n  ) AS {quoted(name)}"
