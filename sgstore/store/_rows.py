"""SQL statements and their results: rows in memory, arrays, or a stream of rows."""

from __future__ import annotations

import re
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import duckdb

from sgstore.base.display import number_of
from sgstore.base.json_text import shortest
from sgstore.base.quoting import quoted
from sgstore.errors import ExportError, MissingExtraError
from sgstore.store._arrow import ARROW_TYPES, as_told, package
from sgstore.store._interrupts import interruptible
from sgstore.store._schema import INSIDE
from sgstore.store._table_files import ParquetTable, relation_of, write_csv

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    import numpy as np
    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    Parameters = Sequence[object] | Mapping[str, object]


T = TypeVar("T")

BATCH: Final = 10_000
"""Rows of a batch."""

MAX_SQL: Final = 1 << 20
"""Longest statement of a user; characters."""

_TO_A_TABLE: Final = re.compile(rf'Did you mean "{INSIDE}\.\w+"\?')
"""Regular expression of a DuckDB hint to an internal table. Users can query only the views."""

_READS: Final = {"SELECT", "EXPLAIN"}
"""Types of statements that only read. ``SELECT`` includes WITH, FROM, VALUES, TABLE, DESCRIBE and others."""


_OTHER_WORDS: Final = {
    **dict.fromkeys(("pl", "to_polars"), "polars"),
    **dict.fromkeys(("pd", "pandas", "to_pandas", "to_df", "fetchdf", "dataframe"), "df"),
    **dict.fromkeys(("to_arrow", "fetch_arrow_table"), "arrow"),
    "to_csv": "csv",
    "to_parquet": "parquet",
}
"""Method names of pandas, polars and others → name of the method of a query result."""


class Tabular:
    """Base class of query results, with conversion to data frames, Arrow tables and files."""

    _joined_tables = staticmethod(as_told)  # for subclasses in other packages

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Raise an error for an unknown attribute. If the name is from another library, name the method."""
            instead = _OTHER_WORDS.get(name)
            hint = f"; write {instead}()" if instead else ""
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}{hint}")

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        raise NotImplementedError

    def _described(self) -> tuple[tuple[str, ...], tuple[str, ...] | None]:
        raise NotImplementedError

    def _table(self) -> Any:
        return None

    def arrow(self) -> Any:
        """Return all rows of the result as a ``pyarrow.Table``.

        Raises
        ------
        MissingExtraError
            pyarrow is not installed.

        Examples
        --------
        >>> table = store.find("MATCH (v:Bus) RETURN v.name AS name, v.speed AS speed").arrow()
        >>> table.num_rows, table.column_names
        (466, ['name', 'speed'])
        """
        arrow = package("pyarrow")
        table = self._table()
        if table is not None:
            return table
        names, types = self._described()
        kinds = [
            getattr(arrow, ARROW_TYPES[kind])() if kind in ARROW_TYPES else None
            for kind in types or ()
        ]
        columns = _columns(names, self)
        arrays = map(arrow.array, columns, kinds) if kinds else map(arrow.array, columns)
        return arrow.table(list(arrays), names=list(names))

    def df(self) -> Any:
        """Return all rows of the result as a ``pandas.DataFrame``.

        Raises
        ------
        MissingExtraError
            pandas is not installed.

        Examples
        --------
        >>> store.find("MATCH (v:Bus) RETURN v.name AS name, v.speed AS speed").df().shape
        (466, 2)
        """
        pandas = package("pandas")
        if (table := self._by_values()) is not None:
            return table.to_pandas()
        names, _ = self._described()
        return pandas.DataFrame.from_records(list(self), columns=list(names))

    def polars(self) -> Any:
        """Return all rows of the result as a ``polars.DataFrame``.

        Raises
        ------
        MissingExtraError
            polars is not installed.

        Examples
        --------
        >>> store.find("MATCH (v:Bus) RETURN v.name AS name, v.speed AS speed").polars().shape
        (466, 2)
        """
        polars = package("polars")
        if (table := self._by_values()) is not None:
            return polars.from_arrow(table)
        names, _ = self._described()
        columns = zip(names, _columns(names, self), strict=True)
        return polars.DataFrame([polars.Series(name, of, strict=False) for name, of in columns])

    def _by_values(self) -> Any:
        """Return the result as an Arrow table with types from its Python values; ``None`` if impossible."""
        with suppress(MissingExtraError):
            package("pyarrow")
            table = self._table()
            return None if table is None else as_told([table])
        return None

    def parquet(self, path: str | Path) -> int:
        """Write all rows of the result to a Parquet file as a stream, and return their number.

        Raises
        ------
        ExportError
            The file is not writable.

        Examples
        --------
        >>> store.sql("SELECT * FROM entities").parquet("entities.parquet")
        146
        """
        names, types = self._described()
        return ParquetTable.write_rows(names, self, Path(path), types)

    def csv(self, path: str | Path) -> int:
        """Write all rows of the result to a CSV file as a stream, and return their number.

        Raises
        ------
        ExportError
            The file is not writable.

        Examples
        --------
        >>> store.sql("SELECT kind, name FROM entities").csv("entities.csv")
        146
        """
        return write_csv(self._described()[0], self, Path(path))

    def relation(self) -> duckdb.DuckDBPyRelation:
        """Return all rows as a DuckDB relation (SQL table object), for filters, joins, aggregates and plots.

        The rows are queried once and copied into a new database as the table ``answer``, in memory or on disk.
        Further relations are computed when they are fetched.

        Raises
        ------
        ExportError
            Disk and memory are too small for the rows.

        Examples
        --------
        >>> gaps = store.find("MATCH (e:Ego), (v:Vehicle) RETURN v.kind AS kind, gap(e, v) AS metres")
        >>> often = gaps.relation().filter("metres < 5").aggregate("kind, count(*) AS often")
        >>> often.order("kind").fetchall()
        [('bus', 246), ('car', 388), ('truck', 16), ('van', 83)]
        """
        return relation_of(self.parquet)


class Rows(Tabular):
    """Result of an SQL statement: column names and rows.

    Attributes
    ----------
    columns : tuple of str
        Column names.
    types : tuple of str
        Database types: ``BIGINT``, ``VARCHAR``, ``ENUM('car', …)``, …
    truncated : bool
        True if there were more rows than requested.
    reasons : mapping of str to str
        Reasons why a pattern in the statement skips traces, by trace name.

    Examples
    --------
    >>> rows = store.sql("SELECT trace, count(*) AS frames FROM frames GROUP BY trace")
    >>> rows
    <1 row of trace, frames>
    >>> for row in rows:
    ...     print(row)
    ('town', 750)
    >>> print(rows)
    trace  frames
    ─────  ──────
    town      750
    """

    def __init__(
        self,
        columns: tuple[str, ...],
        types: tuple[str, ...],
        values: list[tuple[Any, ...]],
        *,
        truncated: bool = False,
    ) -> None:
        self.columns, self.types, self.truncated = columns, types, truncated
        self.reasons: Mapping[str, str] = {}
        self._values = values

    @property
    def values(self) -> list[tuple[Any, ...]]:
        """Rows of the result as tuples. Enumeration values are ``str``; NULL is ``None``.

        Examples
        --------
        >>> store.sql("SELECT trace, count(*) AS frames FROM frames GROUP BY trace").values
        [('town', 750)]
        """
        return self._values

    def __repr__(self) -> str:
        more = " and more" * self.truncated
        return f"<{number_of(len(self), 'row')}{more} of {', '.join(self.columns)}>"

    def __str__(self) -> str:
        """Return the first rows of a result as a table of text."""
        from sgstore.base.display import text_table

        return text_table(self.columns, *self._shown())

    def _repr_html_(self) -> str:
        """Return the first rows of a result as an HTML table, for notebooks."""
        from sgstore.base.display import html_table

        some, below = self._shown()
        return html_table(self.columns, some, below=below)

    def _shown(self) -> tuple[list[tuple[Any, ...]], str]:
        """Return the first rows of a result, and a note if there are more."""
        from sgstore.base.display import IN_NOTEBOOK

        some = self._values[:IN_NOTEBOOK]
        more = self.truncated or len(self._values) > len(some)
        return some, f"the first {len(some)} rows" if more else ""

    def __len__(self) -> int:
        return len(self.values)

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        return iter(self.values)

    def _described(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        return self.columns, self.types

    def dicts(self) -> list[dict[str, Any]]:
        """Return each row of a result as a dict: column → value.

        Examples
        --------
        >>> store.sql("SELECT trace, count(*) AS frames FROM frames GROUP BY trace").dicts()
        [{'trace': 'town', 'frames': 750}]
        """
        return [dict(zip(self.columns, row, strict=True)) for row in self.values]


class Batches:
    """Result of an SQL statement as a stream; each batch of rows is a :class:`Rows` object.

    Attributes
    ----------
    columns, types : tuple of str
        See :class:`Rows`.
    shortened : bool
        True to return float32 values as the float64 with the shortest text.
    """

    def __init__(
        self,
        connection: DuckDBPyConnection,
        sql: str,
        parameters: Parameters | None = None,
        size: int = BATCH,
        *,
        shortened: bool = False,
    ) -> None:
        self._connection = connection
        self._size = size

        def begin() -> list[tuple[Any, ...]]:
            return connection.execute(sql, parameters or None).fetchmany(size)

        # Errors of the statement are raised before its first row.
        self._next = interruptible(connection, begin)
        self.columns, self.types = _described(connection)
        self._single = [i for i, kind in enumerate(self.types) if kind == "FLOAT" and shortened]

    def _told(self, values: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        """Convert float32 values in rows to the float64 values with the same shortest decimal text."""
        if not self._single:
            return values
        columns = list(zip(*values, strict=True))
        for place in self._single:
            columns[place] = tuple(map(shortest, columns[place]))
        return list(zip(*columns, strict=True))

    def _more(self) -> list[tuple[Any, ...]]:
        return interruptible(self._connection, lambda: self._connection.fetchmany(self._size))

    def __iter__(self) -> Iterator[Rows]:
        while values := self._next:
            yield Rows(self.columns, self.types, self._told(values))
            self._next = self._more() if len(values) == self._size else []


def run(connection: DuckDBPyConnection, sql: str, parameters: Parameters | None = None) -> Rows:
    """Run a trusted SQL statement, and return all rows."""
    values = interruptible(
        connection, lambda: connection.execute(sql, parameters or None).fetchall()
    )
    return Rows(*_described(connection), values)


def _described(result: DuckDBPyConnection) -> tuple[tuple[str, ...], tuple[str, ...]]:
    description = result.description or []
    return tuple(str(one[0]) for one in description), tuple(str(one[1]) for one in description)


def arrays(
    connection: DuckDBPyConnection, sql: str, parameters: Parameters | None, *, plain: bool = False
) -> dict[str, NDArray[np.generic]]:
    """Run a trusted SQL statement, and return its columns as arrays. NULL values are masked."""
    given = parameters or None
    described = [] if plain else connection.execute(f"DESCRIBE {sql}", given).fetchall()
    listed = [quoted(str(row[0])) for row in described if "ENUM" in str(row[1])]
    if listed:  # enumerations would become pandas categories
        texts = ", ".join(f"{name}::VARCHAR AS {name}" for name in listed)
        sql = f"SELECT * REPLACE ({texts}) FROM ({sql})"

    def fetched() -> dict[str, NDArray[np.generic]]:
        return connection.execute(sql, given).fetchnumpy()

    return interruptible(connection, fetched)


def _columns(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[list[Any]]:
    """Transpose rows to columns. It works in batches to keep related values close in memory."""
    found: list[list[Any]] = [[] for _ in columns]
    rows = iter(rows)
    while batch := list(islice(rows, BATCH)):
        for values, more in zip(found, zip(*batch, strict=True), strict=True):
            values.extend(more)
    return found


def count_parquet(file: Path) -> tuple[int, tuple[str, ...]]:
    """Read a whole Parquet file, and return its number of rows and its column names.

    Raises
    ------
    ExportError
        The file is not readable.
    """
    try:
        with duckdb.connect() as connection:
            found = Batches(connection, "FROM read_parquet(?)", [str(file)])
            return sum(len(batch) for batch in found), found.columns
    except duckdb.Error as error:
        raise ExportError(f"{file.name}: cannot be read back: {str(error).strip()}") from error
