"""Statements of SQL that try to reach or to write what is not in the store, and what refuses them.

``{out}``, ``{secret}`` and ``{folder}`` stand for a file to write, a file to read, and the folder of tables.
"""

from __future__ import annotations

from typing import Final

PROBES: Final = (
    ("COPY frames TO '{out}'", "COPY is not allowed"),
    ("COPY (SELECT 1) TO '{out}' (FORMAT parquet)", "COPY is not allowed"),
    ("EXPORT DATABASE '{out}'", "EXPORT is not allowed"),
    ("ATTACH '{out}' AS x", "ATTACH is not allowed"),
    ("INSTALL httpfs", "is not allowed"),
    ("LOAD '{secret}'", "is not allowed"),
    ("SET memory_limit = '100GB'", "SET is not allowed"),
    ("SET enable_external_access = true", "SET is not allowed"),
    ("SET VARIABLE x = 1", "SET is not allowed"),
    ("PRAGMA database_list", "is not allowed"),
    ("PRAGMA memory_limit='100GB'", "is not allowed"),
    ("CALL pragma_version()", "CALL is not allowed"),
    ("CREATE TABLE x AS SELECT 1", "CREATE is not allowed"),
    ("CREATE MACRO f() AS 1", "CREATE is not allowed"),
    ("DROP VIEW frames", "DROP is not allowed"),
    ("INSERT INTO inside.trace SELECT * FROM inside.trace", "INSERT is not allowed"),
    ("UPDATE inside.trace SET name = 'x'", "UPDATE is not allowed"),
    ("SELECT 1; SELECT 2", "expected one statement"),
    ("BEGIN", "TRANSACTION is not allowed"),
    ("SELECT * FROM read_text('{secret}')", "disabled by configuration"),
    ("SELECT * FROM read_csv('{secret}')", "disabled by configuration"),
    ("SELECT * FROM read_blob('/proc/self/environ')", "disabled by configuration"),
    ("SELECT * FROM '{secret}'", "disabled by configuration|does not exist"),
    ("SELECT * FROM glob('/*')", "disabled by configuration"),
    ("SELECT * FROM parquet_scan('http://127.0.0.1/x')", "disabled by configuration|httpfs"),
    ("SELECT getenv('HOME')", "does not exist"),
    ("SELECT getvariable('x') FROM query('COPY frames TO ''{out}''')", "SELECT|COPY"),
    ("EXPLAIN ANALYZE COPY frames TO '{out}'", "disabled by configuration|read-only"),
    (
        "EXPLAIN ANALYZE COPY frames TO '{folder}/out.parquet'",
        "File too large|Could not write|Cannot open|read-only|IO Error",
    ),
    ("COPY labels TO '{folder}/out.parquet'", "COPY is not allowed"),
    ("SELECT * FROM read_text('{folder}/../secret.csv')", "disabled by configuration"),
    ("SELECT * FROM glob('{folder}/../*')", "disabled by configuration"),
    ("ATTACH '{folder}/x.duckdb' AS x", "ATTACH is not allowed"),
    ("CREATE TEMP TABLE t AS SELECT * FROM labels", "CREATE is not allowed"),
    ("DROP VIEW labels", "DROP is not allowed"),
)
