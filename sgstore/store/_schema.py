"""Comparison of a store's tables and views with ``schema.sql``. The store may be from an untrusted source.

An untrusted file may have a view instead of a table, a macro with the name of a function, or a trigger. So
before the first read, the catalogue of a store is compared with ``schema.sql``: the text of tables, types and
views, for any DuckDB version. User objects with other names are allowed, and never read.

Until then, the content of the store is not trusted: the check uses no functions and names that a store could
define.
"""

from __future__ import annotations

import hashlib
import re
from collections import defaultdict
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from importlib.metadata import version
from itertools import chain
from typing import TYPE_CHECKING, Final

import duckdb
import numpy as np

from sgstore.base.display import STORE_TEXT, excerpt
from sgstore.base.quoting import literal, quoted
from sgstore.errors import StoreError
from sgstore.model.pair_numbers import pairs_view
from sgstore.model.vocabulary import NAMES, learn

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from duckdb import DuckDBPyConnection
    from numpy.typing import NDArray

    Tokens = tuple[str, ...]
    Objects = tuple[tuple[str, str, str, str | Tokens], ...]

_HEAD: Final = re.compile(r"-- sgstore: what is in a store, version (\d+)\.")
_SYSTEM: Final = frozenset({"information_schema", "pg_catalog", "system", "temp"})


def schema_version() -> str:
    """Return the version number in the header of ``schema.sql``."""
    found = _HEAD.match(schema_sql())
    if found is None:
        raise ValueError("the head of schema.sql contains no version")
    return found[1]


TEXT: Final = (
    "1e5477db7ac5dd58262c8260117368defd984d0a4e548de85ce507805d8dbb66",
    "e5268bcc3af76249caab4d312a26142d856e9876e70aae802ef79cee53957638",
)
"""Known digests: of the text of ``schema.sql``, and of its statements, whose parsing takes 10 ms."""


@cache
def schema_digest() -> str:
    """Return the SHA-256 of the SQL statements of ``schema.sql``. Comments do not change it."""
    text, known = TEXT
    return known if text_digest() == text else statements_digest()


def text_digest() -> str:
    """Return the SHA-256 of the whole text of ``schema.sql``."""
    return hashlib.sha256(schema_sql().encode()).hexdigest()


def statements_digest() -> str:
    """Compute the SHA-256 of the SQL statements of ``schema.sql``, without comments."""
    made = ["\0".join(words) for words in statements() if words[0] != "COMMENT"]
    return hashlib.sha256("\n".join(made).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Shape:
    """Tables, views and enumeration types of ``schema.sql``, by name.

    Attributes
    ----------
    tables, types : dict
        Statements as tokens, independent of the DuckDB version.
    views, inner : dict
        Texts of the public views, and of the internal views.
    """

    tables: dict[str, Tokens]
    types: dict[str, Tokens]
    views: dict[str, str]
    inner: dict[str, str]


@cache
def expected(*wider: tuple[str, Tokens]) -> Shape:
    """Return the tables, views and types of ``schema.sql``. Types in ``wider`` replace those of equal name."""
    tables: dict[str, Tokens] = {}
    types: dict[str, Tokens] = {}
    views: dict[str, dict[str, str]] = {"main": {}, INSIDE: {}}
    for words in statements():
        if words[:2] == ("CREATE", "TYPE"):
            types[words[2]] = words[4:]
        elif words[:2] == ("CREATE", "TABLE"):
            tables[words[2]] = words
        elif words[:2] == ("CREATE", "VIEW"):
            views[words[2]][words[4]] = " ".join(words[6:])
    types |= dict(wider)
    written = {name: tuple(with_types(words, types)) for name, words in tables.items()}
    return Shape(written, types, views["main"], views[INSIDE])


_written: dict[str, Tokens] = {}


BEFORE_TRACE: Final = {
    "7535a0e47dd54aff42b430f36fcecb652340d281021f582733125e752a644a4c": (
        "nodes",
        "edges",
        "world_nodes",
        "entities",
        "traces",
    ),
    "b97bda47e1fdf0a4a970985fd707ae4ee0fa509ef4d7056cbef17b61ee7f0bb5": ("entities", "traces"),
}
"""Digest of an older schema → its views without the column ``trace``, and the views that it lacks.

Such stores are read. The next write adds them: see :func:`add_trace`.
"""

NEW_VIEWS: Final = frozenset({"traces"})
"""Views that older stores lack."""

_TRACE: Final = re.compile(
    r" , (t \. name AS trace|n \. trace|t \. name(?= FROM))"
    r"| JOIN inside \. trace t ON t \. trace_id = [bf] \. trace_id(?= JOIN)"
)
"""Regular expression for the parts of the views that provide the column ``trace``."""


def add_trace(connection: DuckDBPyConnection, database: str = "") -> None:
    """To an older store, add the column ``trace`` of the views, and the views that it lacks.

    A store in which a user's table has the name of a new view is not changed.

    Parameters
    ----------
    connection : DuckDBPyConnection
    database : str
        Attached store to change. Empty: create temporary views, and do not change the store.
    """
    where = "WHERE key = 'schema_digest'"
    info = f"{quoted(database)}.{INSIDE}.store_info" if database else f"{INSIDE}.store_info"
    digests = connection.execute(f"SELECT value FROM {info} {where}").fetchall()
    names = [name for (digest,) in digests for name in BEFORE_TRACE.get(digest, ())]
    if not names:
        return
    ((before,),) = connection.execute("SELECT current_database()").fetchall()
    objects = objects_of(connection, database or before)
    taken = {name.lower() for _, schema, name, _ in objects if schema == "main"} & NEW_VIEWS
    if not database:
        for name in names:
            if name in taken:
                continue
            view = expected().views[name].replace(" main . nodes ", " nodes ")
            connection.execute(f"CREATE OR REPLACE TEMP VIEW {name} AS {view}")
    if not database or taken:
        return
    connection.execute(f"USE {quoted(database)}; BEGIN TRANSACTION")
    for name in names:
        connection.execute(f"CREATE OR REPLACE VIEW main.{name} AS {expected().views[name]}")
    for words in statements():
        if words[:3] == ("COMMENT", "ON", "VIEW") and words[5] in names:
            connection.execute(" ".join(words))
    connection.execute(f"UPDATE {info} SET value = '{schema_digest()}' {where}")
    connection.execute(f"COMMIT; USE {quoted(before)}")


def _expected_views(connection: DuckDBPyConnection) -> dict[str, Tokens]:
    """Return the views of ``schema.sql`` in the text form of this DuckDB version.

    Names that end in ``:`` have the text before the column ``trace`` was added.
    """
    if not _written:
        views = expected().views | expected().inner
        views |= {f"{name}:": _TRACE.sub("", views[name]) for name in chain(*BEFORE_TRACE.values())}
        rows = connection.execute(
            "SELECT system.main.json_deserialize_sql(system.main.json_serialize_sql(text))"
            " FROM (SELECT unnest($1::VARCHAR[]) AS text)",
            [list(views.values())],
        ).fetchall()
        for name, (sql,) in zip(views, rows, strict=True):
            _written[name] = tuple(tokens_of(f"CREATE VIEW {name.rstrip(':')} AS {sql}"))
    return _written


def check(connection: DuckDBPyConnection, database: str, path: Path) -> None:
    """Raise an error if a database is not a store, has another version, or was altered.

    Parameters
    ----------
    connection : DuckDBPyConnection
    database : str
        Database name of the file in the connection.
    path : Path

    Raises
    ------
    StoreError
    """
    objects = objects_of(connection, database)
    other = other_version(_about(connection, database, path, objects))
    if other:
        raise StoreError(f"{path}: {other}; {_REMEDY}")
    faults = _altered(connection, database, objects)
    if faults:
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        raise StoreError(
            f"{path}: differs from the schema of sgstore and is not read: {faults[0]}{more};"
            f" 'sgstore verify' lists faults; {_REMEDY}"
        )


_REMEDY: Final = "'sgstore rebuild' makes it again from its recordings"


def schema_faults(connection: DuckDBPyConnection, path: Path) -> tuple[list[str], tuple[str, ...]]:
    """Return all faults of a store's schema, and the names of user tables and views.

    Raises
    ------
    StoreError
        The file is not a store.
    """
    database = database_of(connection)
    objects = objects_of(connection, database)
    other = other_version(_about(connection, database, path, objects))
    wrong = [other] if other else _altered(connection, database, objects)
    return wrong, tuple(others(objects))


def database_of(connection: DuckDBPyConnection) -> str:
    """Return the database name of the file that a DuckDB connection has open."""
    sql = "SELECT database_name FROM system.main.duckdb_databases() WHERE internal = false"
    ((name,),) = connection.execute(sql).fetchall()
    return name


_TOPIC: Final = re.compile(r"topic(_[0-9a-f]{16})?")
TOPIC_TYPES: Final[frozenset[str]] = frozenset(
    (
        *("BOOLEAN", "TINYINT", "UTINYINT", "SMALLINT", "USMALLINT", "INTEGER", "UINTEGER"),
        *("BIGINT", "UBIGINT", "FLOAT", "DOUBLE", "VARCHAR", "BLOB", "JSON"),
    )
)
"""Column types that tables of topics can have."""


def topic_statements(tables: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the statement of each topic table: table name → statement without ``CREATE TABLE``.

    ``tables``: names and statements of tables. Only tables of plain columns count: a store is not trusted.
    """
    found: dict[str, str] = {}
    for name, told in tables:
        columns = _plain_columns(statement(told)) if _TOPIC.fullmatch(name) else ""
        if columns:
            found[name] = f"{name}({columns})"
    return found


def _plain_columns(words: Tokens) -> str:
    """Return the columns of a CREATE TABLE statement; empty if a column is more than a name and plain type."""
    *inner, end = words[4:] if words[-1] != ";" else words[4:-1]
    found: list[str] = []
    column: list[str] = []
    for word in (*inner, ","):
        if word != ",":
            column.append(word)
            continue
        name, kind, *more = *column, "", ""
        rest = " ".join(more[:-2])
        if kind not in TOPIC_TYPES or rest not in {"", "NOT NULL", "[ ]", "[ ] NOT NULL"}:
            return ""
        found.append(f"{name if name.startswith(chr(34)) else quoted(name)} {kind} {rest}")
        column = []
    return ", ".join(found) if (words[3], end) == ("(", ")") else ""


def _without_topics(objects: Objects) -> Objects:
    """Return the objects of a store without the tables of topics, which are optional."""
    told = {
        (name, str(sql))
        for what, schema, name, sql in objects
        if what == "table" and schema == INSIDE and _TOPIC.fullmatch(name)
    }
    ours = topic_statements(told) if told else {}
    return tuple(one for one in objects if one[:2] != ("table", INSIDE) or one[2] not in ours)


def _about(
    connection: DuckDBPyConnection, database: str, path: Path, objects: Objects
) -> dict[str, str]:
    about = about_store(connection, database, objects)
    if about is None:
        raise StoreError(
            f"{path}: a DuckDB database, but not a store; expected a file that 'sgstore ingest' made"
        )
    return about


def about_store(
    connection: DuckDBPyConnection, database: str, objects: Objects
) -> dict[str, str] | None:
    """Return version and digest of a store's schema; ``None`` if the file is not a store."""
    schema = schema_of(objects)
    told = _info_of(objects).get(schema)
    if told is None:
        return None
    if not _is_known(objects):
        made = statement(told)
        own, added = expected().tables["store_info"], {"NOT", "NULL"}  # later added to its columns
        if [word for word in made if word not in added] != [w for w in own if w not in added]:
            return {}  # an unknown table is not read
    rows = connection.execute(
        f"SELECT key, system.main.substring(value, 1, {4 * STORE_TEXT})"
        f" FROM {quoted(database)}.{schema}.store_info LIMIT {_MOST_INFO}"
    )
    return {str(key)[:STORE_TEXT]: str(value) for key, value in rows.fetchall()}


_MOST_INFO: Final = 1000
"""Maximum number of rows of ``store_info`` that are read."""


def schema_of(objects: Objects) -> str:
    """Return the name of the database schema that has the store's tables.

    Old stores have tables and views in one schema.
    """
    return INSIDE if INSIDE in _info_of(objects) else "main"


def _info_of(objects: Objects) -> dict[str, str]:
    """Return the CREATE statement of the table ``store_info`` for each database schema that has it."""
    return {
        schema: str(told)
        for what, schema, name, told in objects
        if what == "table" and name.lower() == "store_info"
    }


def other_version(about: dict[str, str]) -> str:
    """If a store has another schema version, return the error message; otherwise an empty text."""
    held, maker = (
        excerpt(about.get("schema_version", "unknown")),
        excerpt(about.get("created_by", "an unknown version")),
    )
    if held != SCHEMA_VERSION:
        reason = f"a store of version {held}, expected {SCHEMA_VERSION}"
    elif about.get("schema_digest") not in {schema_digest(), *BEFORE_TRACE}:
        reason = (
            f"a store of version {held}, but with other tables or views than those of this sgstore"
        )
    else:
        return ""
    return f"{reason} (made by {maker}, this is sgstore {version('sgstore')})"


def altered(connection: DuckDBPyConnection, database: str) -> list[str]:
    """Return faults of a store: objects that differ from ``schema.sql``, or hide its objects.

    A store can have additional kinds, relations and light states. They are registered here.
    """
    return _altered(connection, database, objects_of(connection, database))


def _altered(connection: DuckDBPyConnection, database: str, objects: Objects) -> list[str]:
    if objects not in _compared:
        if len(_compared) >= _MOST_COMPARED:
            _compared.clear()
        _compared[objects] = () if _is_known(objects) else _any_changed(connection, objects)
    found = [*_compared[objects], *_shadowing(connection, database)]
    found += _attached(connection, database)
    return found or [*_strange(objects)]


def _any_changed(connection: DuckDBPyConnection, objects: Objects) -> tuple[str, ...]:
    """Compare a store with the current and the older views. Return the shorter list of faults."""
    views = _expected_views(connection)
    older = (
        {
            name: views[f"{name}:"] if name in names else text
            for name, text in views.items()
            if name not in NEW_VIEWS or name not in names
        }
        for names in BEFORE_TRACE.values()
    )
    return min((tuple(_changed(objects, one)) for one in (views, *older)), key=len)


_compared: dict[Objects, tuple[str, ...]] = {}
"""Cached faults by store objects. Different stores mostly have equal objects."""

_MOST_COMPARED: Final = 64

KNOWN: Final = "3fc8d1bd15f0fd9c83366a745207e856e85f93290c8292bf5cea6a644d3b2d2f"
"""Known digest of a valid store's objects in DuckDB 2. It avoids a comparison of tokens (30 ms).

Objects of other versions are compared token by token.
"""


KNOWN_BEFORE_TRACE: Final = (
    "67a1e889548b35aea29187ebe60625b8a9972a94cede672da4fa62ceec3afe26",
    "58eb62162e09868669b8fcc0eae2bd07beae958f0a5ad03ac48de9891774ad8a",
)
"""Known digests of valid older stores, in the order of :data:`BEFORE_TRACE`."""


def digest_of(objects: Objects) -> str:
    """Return the SHA-256 of ``schema.sql`` together with a store's tables, views and types."""
    return hashlib.sha256(repr((schema_sql(), sorted(objects))).encode()).hexdigest()


@lru_cache(maxsize=_MOST_COMPARED)
def _is_known(objects: Objects) -> bool:
    return digest_of(objects) in {KNOWN, *KNOWN_BEFORE_TRACE}


def _changed(objects: Objects, views: dict[str, Tokens]) -> Iterator[str]:
    """Yield faults of a store: tables, views or types that differ from ``schema.sql`` or are misplaced."""
    made = _made(objects)
    types = made["type", "main"]
    shape = expected(
        *(
            (enum, types[enum])
            for enum in NAMES
            if _labels(types.get(enum, ()))[: len(own_labels(enum))] == own_labels(enum)
        )
    )
    yield from _differing("table", shape.tables, made["table", INSIDE], made["view", INSIDE])
    for schema, of in (("main", shape.views), (INSIDE, shape.inner)):
        wanted = {name: views[name] for name in of if name in views}
        yield from _differing("view", wanted, made["view", schema], made["table", schema])
    yield from _differing("type", shape.types, types, {})
    yield from _misplaced(objects, shape)
    yield from (
        f"{INSIDE}.{name} takes the place of a type" for name in sorted(made["type", INSIDE])
    )


@cache
def own_labels(enum: str) -> tuple[str, ...]:
    """Return the values of an enumeration type in ``schema.sql``."""
    return _labels(expected().types[enum])


def _labels(words: Tokens) -> tuple[str, ...]:
    return tuple(word[1:-1].replace("''", "'") for word in words if word.startswith("'"))


def labels_of(connection: DuckDBPyConnection, database: str, enum: str) -> tuple[str, ...]:
    """Return the values of a store's enumeration type, in code order. A missing type has no values."""
    rows = connection.execute(
        "SELECT labels FROM system.main.duckdb_types() WHERE database_name = ?"
        " AND schema_name = ? AND type_name = ? AND internal = false",
        [database, "main", enum],
    ).fetchall()
    return tuple(rows[0][0] or ()) if rows else ()


def others_of(connection: DuckDBPyConnection, enum: str) -> tuple[str, ...]:
    """Return the values of a store's enumeration type that ``schema.sql`` lacks."""
    ((labels,),) = connection.execute(f"SELECT enum_range(NULL::{enum})").fetchall()
    return tuple(labels[len(own_labels(enum)) :])


def codes_of(connection: DuckDBPyConnection, enum: str) -> NDArray[np.int8]:
    """Return an array that translates enumeration codes: code in the store → code in this process."""
    ((labels,),) = connection.execute(f"SELECT enum_range(NULL::{enum})").fetchall()
    return np.array([learn(enum, label) for label in labels], np.int8)


def widen(
    connection: DuckDBPyConnection, database: str, names: Mapping[str, Iterable[str]]
) -> None:
    """Add values to the enumeration types of an attached database."""
    inside = f"{quoted(database)}.{INSIDE}"
    for enum, wanted in names.items():
        labels = labels_of(connection, database, enum)
        new = [name for name in dict.fromkeys(wanted) if name not in labels]
        if not new:
            continue
        wider = _enum((*labels, *new))
        for table in expected().tables:
            for column in (name for name, what in enums_of(table).items() if what == enum):
                connection.execute(f"ALTER TABLE {inside}.{table} ALTER {column} TYPE {wider}")
        connection.execute(f"DROP TYPE {quoted(database)}.main.{enum}")
        connection.execute(f"CREATE TYPE {quoted(database)}.main.{enum} AS {wider}")


@cache
def enums_of(table: str) -> Mapping[str, str]:
    """Return the enumeration columns of a table in ``schema.sql``: column → enumeration."""
    words = next((words for words in statements() if words[1:3] == ("TABLE", table)), ())
    return {
        column: what
        for before, column, what in zip(words[3:], words[4:], words[5:], strict=False)
        if what in NAMES and before in {"(", ","}
    }


def code_sql(column: str, enum: str) -> str:
    """Return an SQL expression that maps an enumeration value to the same number in every store."""
    code, words = f"enum_code({column}::{enum})", tuple(tokens_of(enum))
    own = next(own for own in expected().types.values() if words[: len(own) - 1] == own[:-1])
    if words == own:
        return code
    number = f"('0x' || md5({column}::VARCHAR)[:15])::BIGINT"
    many = sum(word.startswith("'") for word in own)
    return f"CASE WHEN {code} < {many} THEN {code} ELSE {number} END"


def _strange(objects: Objects) -> Iterator[str]:
    """Yield faults of a store: enumeration values that this process cannot register."""
    labels = {
        name: told for what, schema, name, told in objects if (what, schema) == ("type", "main")
    }
    for enum in NAMES:
        for label in labels[enum][len(own_labels(enum)) :]:
            try:
                learn(enum, label[:STORE_TEXT])
            except ValueError as error:
                yield f"a {enum.replace('_', ' ')}: {error}"


def others(objects: Objects) -> list[str]:
    """Return the sorted names of user tables and views in a store."""
    inside = schema_of(objects)
    ours = {(inside, name) for name in (*expected().tables, *expected().inner)}
    ours |= {("main", name) for name in expected().views}
    return sorted(
        name if schema == "main" else f"{schema}.{name}"
        for what, schema, name, _ in objects
        if what != "type" and (schema, name.lower()) not in ours
    )


def unlisted(connection: DuckDBPyConnection, database: str) -> list[str]:
    """Return user macros, sequences, types and empty schemas of a database, as texts such as ``macro f``."""
    found = [("macro", name) for name in _names_in(connection, database, "functions", "function")]
    found += [
        ("sequence", name) for name in _names_in(connection, database, "sequences", "sequence")
    ]
    own = {*expected().types, *(f"{INSIDE}.{name}" for name in expected().types)}
    types = _names_in(connection, database, "types", "type")
    found += [("type", name) for name in types if name not in own]
    used = {schema for _, schema, *_ in objects_of(connection, database)} | {"main", INSIDE}
    schemas = connection.execute(
        "SELECT schema_name FROM system.main.duckdb_schemas()"
        " WHERE database_name = ? AND internal = false ORDER BY ALL",
        [database],
    )
    found += [("empty schema", name) for (name,) in schemas.fetchall() if name not in used]
    return [f"{what} {name}" for what, name in found]


def _names_in(connection: DuckDBPyConnection, database: str, what: str, one: str) -> Iterable[str]:
    internal = "" if one == "sequence" else " AND internal = false"
    rows = connection.execute(
        f"SELECT DISTINCT schema_name, {one}_name FROM system.main.duckdb_{what}()"
        f" WHERE database_name = ?{internal} ORDER BY ALL",
        [database],
    ).fetchall()
    return [name if schema == "main" else f"{schema}.{name}" for schema, name in rows]


def objects_of(connection: DuckDBPyConnection, database: str) -> Objects:
    """Return tables, views and types of a database: (kind, schema, name, statement or values).

    Tables of topics are not among them.
    """
    found: list[tuple[str, str, str, str | Tokens]] = []
    for what, told in (("table", "sql"), ("view", "sql"), ("type", "labels")):
        rows = connection.execute(
            f"SELECT schema_name, {what}_name, {told} FROM system.main.duckdb_{what}s()"
            " WHERE database_name = ? AND internal = false",
            [database],
        ).fetchall()
        for schema, name, made in rows:
            text = tuple(made or ()) if what == "type" else (made or "").rstrip().removesuffix(";")
            found.append((what, schema, name, text))
    return _without_topics(tuple(found))


def _made(objects: Objects) -> Mapping[tuple[str, str], dict[str, Tokens]]:
    """Return the tables, views and types of a store: (kind, schema) → name → tokens of the statement."""
    found: dict[tuple[str, str], dict[str, Tokens]] = defaultdict(dict)
    for what, schema, name, told in objects:
        if schema not in {"main", INSIDE}:
            continue
        if isinstance(told, str):
            found[what, schema][name.lower()] = statement(told)
        else:
            found[what, schema][name] = tuple(tokens_of(_enum(told)))
    return found


def _enum(labels: Iterable[str]) -> str:
    return f"ENUM({', '.join(map(literal, labels))})"


def _differing(
    what: str, wanted: dict[str, Tokens], there: dict[str, Tokens], instead: dict[str, Tokens]
) -> Iterator[str]:
    """Yield faults: tables, views or types that are missing, of the wrong kind, or different."""
    for name, words in wanted.items():
        found = there.get(name)
        if found is None:
            gone = f"a {'view' if what == 'table' else 'table'}" if name in instead else "missing"
            yield f"{what} {name!r} is {gone}"
        elif found != words:
            yield f"{what} {name!r} differs from that of sgstore"


def _misplaced(objects: Objects, shape: Shape) -> Iterator[str]:
    """Yield faults of a store: user tables and views with names that hide objects of ``schema.sql``."""
    for schema, name in sorted(
        (schema, name) for what, schema, name, _ in objects if what != "type"
    ):
        ours = {"main": shape.tables | shape.inner, INSIDE: shape.views}.get(schema, {})
        if name.lower() in ours:
            what = "a table" if name.lower() in shape.tables else "a view"
            yield f"{excerpt(schema)}.{name} takes the place of {what}"


def _shadowing(connection: DuckDBPyConnection, database: str) -> Iterator[str]:
    """Yield faults of a store: macros and schemas with the names of built-in DuckDB objects."""
    macros = connection.execute(
        "SELECT function_name FROM system.main.duckdb_functions() WHERE database_name = ?",
        [database],
    ).fetchall()
    if macros:
        own = connection.execute(
            "SELECT function_name FROM system.main.duckdb_functions() WHERE database_name = 'system'"
        ).fetchall()
        names = {name.lower() for (name,) in own}
        for name in sorted({name for (name,) in macros if name.lower() in names}):
            yield f"a macro takes the place of the function {name!r}"
    schemas = connection.execute(
        "SELECT schema_name FROM system.main.duckdb_schemas()"
        " WHERE database_name = ? AND internal = false",
        [database],
    ).fetchall()
    for (name,) in schemas:
        if name.lower() in _SYSTEM:
            yield f"there is a schema {name!r}"


def _attached(connection: DuckDBPyConnection, database: str) -> Iterator[str]:
    """Yield faults of a store: triggers and indexes on tables of ``schema.sql``."""
    for what in ("trigger", "index"):
        plural = {"trigger": "triggers", "index": "indexes"}[what]
        try:
            rows = connection.execute(
                f"SELECT schema_name, table_name, {what}_name FROM system.main.duckdb_{plural}()"
                " WHERE database_name = ?",
                [database],
            ).fetchall()
        except (
            duckdb.CatalogException
        ):  # DuckDB 1.5 has no triggers, and rejects a store with triggers
            continue
        for schema, table, name in rows:
            ours = {*expected().tables, *expected().views, *expected().inner}
            if schema in {"main", INSIDE} and table.lower() in ours:
                yield f"table {table!r} has the {what} {excerpt(name)!r}"


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
"""Graph tables → tables with the data outside the graphs. Both have the same columns."""

_VIEWS_BEYOND: Final[Mapping[str, Mapping[str, str]]] = {
    "nodes": BEYOND,
    "lane_states": BEYOND,
    "pairs": {"state": "known_state"},
    "criticality": {"state": "known_state"},
    "lane_dists": {"lane_state": "known_lane_state"},
}
"""Views of graphs → replacements of tables that turn them into views of the data outside the graphs."""


WORLD_VIEWS: Final = frozenset(_VIEWS_BEYOND)
"""Views of graphs for which a view ``world_…`` exists."""


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
    """Split an SQL statement into tokens. Drop comments, quotes of plain names and casts of constants."""
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


SCHEMA_VERSION: Final = schema_version()
"""Version of ``schema.sql``. Stores of other versions are rejected, but can be rebuilt from recordings."""
