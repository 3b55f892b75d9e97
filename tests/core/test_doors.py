"""What a store, a folder or another program could do to who opens a store: every door that should be shut."""

from __future__ import annotations

import json
import os
import random
import re
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from recordings import drive
from thorough import LONG

import sgstore
import sgstore.store._schema as shape
from sgstore.apps.cli import run as command_line
from sgstore.errors import StoreError
from sgstore.ingest import ingest
from sgstore.store import StoreFile
from sgstore.store._lease import give_back
from sgstore.store._locking import Access
from sgstore.store._schema import schema_sql
from sgstore.store._staging import scratch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

pytestmark = pytest.mark.seconds(19)

# Modules that lie around

BOTH_CHILDREN = """
import json, sys
from pathlib import Path
from sgstore.ingest import ingest
from sgstore.apps.sandbox import Sandbox
store, *recordings = map(Path, json.loads(sys.argv[1]))
{before}
outcomes = ingest(store, recordings, jobs=2)
with Sandbox(store) as box:
    print([str(o.error) for o in outcomes], box.sql("SELECT count(*) FROM frames").rows)
"""


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A folder with modules that leave a trace if anybody runs them."""
    folder = tmp_path / "hostile"
    names = (
        "duckdb",
        "numpy",
        "json",
        "sitecustomize",
        "usercustomize",
        "runpy",
        "mcap",
        "shapely",
    )
    for name in (*(f"{name}.py" for name in names), "sgstore/__init__.py", "lark/__init__.py"):
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"open({str(tmp_path / 'was-run')!r}, 'a').write({name!r} + ' ')\n")
    return folder


@pytest.mark.parametrize(
    "before",
    # A notebook has all that its own has, and a path of modules that begins where it is.
    ["import os; os.chdir({hostile!r}); sys.path[:0] = ['', '.']", *([""] if LONG else [])],
    ids=["a notebook's", *(["its own"] if LONG else [])],
)
def test_no_child_runs_what_lies_in_the_current_folder_or_on_pythonpath(
    hostile: Any, tmp_path: Path, before: Any
) -> None:
    paths = [drive(tmp_path / f"{frames}.mcap", frames=frames) for frames in (4, 5)]
    given = json.dumps([str(tmp_path / "s.sgstore"), *map(str, paths)])
    code = BOTH_CHILDREN.format(before=before.format(hostile=str(hostile)))
    run = subprocess.run(
        [sys.executable, "-I", "-c", code, given],
        cwd=hostile,
        env={**os.environ, "PYTHONPATH": f"{hostile}{os.pathsep}"},
        capture_output=True,
        text=True,
        check=False,
    )

    assert run.stdout == "['None', 'None'] [(9,)]\n", run.stderr
    assert not (tmp_path / "was-run").exists()


# Stores that were altered


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Path]:
    """A store of two traces, and the folder of their recordings."""
    folder = tmp_path_factory.mktemp("drives")
    paths = [drive(folder / f"drive{frames}.mcap", frames=frames) for frames in (12, 14)]
    outcomes = ingest(folder / "s.sgstore", paths)
    assert [outcome.error for outcome in outcomes] == [None, None]
    return (folder / "s.sgstore").read_bytes(), folder


@pytest.fixture
def store(drives: Any, tmp_path: Path) -> Path:
    (tmp_path / "s.sgstore").write_bytes(drives[0])
    return tmp_path / "s.sgstore"


def change(store: Path, *statements: str) -> None:
    give_back()
    with duckdb.connect(str(store)) as connection:
        for statement in statements:
            connection.execute(statement)


@dataclass
class Result:
    exit_code: int
    stdout: str
    stderr: str

    @property
    def output(self) -> str:
        return self.stdout + self.stderr


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., Result]:
    """Runs a command line; what leaves it is an exit code, or a fault of ours."""

    def call(*arguments: object) -> Result:
        capsys.readouterr()
        code = command_line([str(one) for one in arguments])
        return Result(code, *capsys.readouterr())

    return call


@pytest.fixture(scope="module")
def made() -> Iterator[duckdb.DuckDBPyConnection]:
    """A database as sgstore makes it; who changes it rolls that back."""
    connection = duckdb.connect()
    connection.execute(schema_sql())
    assert shape.altered(connection, "memory") == []
    yield connection
    assert shape.altered(connection, "memory") == []


def names(what: str) -> list[str]:
    return re.findall(rf"^CREATE {what} ([\w.]+)", schema_sql(), re.MULTILINE)


ALTERED = {
    **{
        f"a view in the place of table {table}": (
            f"ALTER TABLE {table} RENAME TO hidden",
            f"CREATE VIEW {table} AS SELECT * FROM hidden",
        )
        for table in names("TABLE")
    },
    **{
        f"view {view} says something else": (
            f"CREATE OR REPLACE VIEW {view} AS SELECT * FROM inside.frame",
        )
        for view in names("VIEW")
    },
    **{f"view {view} is gone": (f"DROP VIEW {view}",) for view in names("VIEW")},
    "a view whose text differs in a number": (
        "CREATE OR REPLACE VIEW main.lane_gaps AS"
        " SELECT frame_id, src, dst, gap + 1 AS gap FROM inside.lane_gap",
    ),
    "a table in the place of a view": (
        "CREATE TABLE main.copy AS FROM lanes",
        "DROP VIEW lanes",
        "ALTER TABLE main.copy RENAME TO lanes",
    ),
    "a column of another type": ("ALTER TABLE inside.frame ALTER seq TYPE VARCHAR",),
    "a column more": ("ALTER TABLE inside.trace ADD COLUMN x INTEGER",),
    "a column less": ("ALTER TABLE inside.event DROP COLUMN detail",),
    "a column of another name": ("ALTER TABLE inside.event RENAME COLUMN detail TO other_detail",),
    "a column that may be missing": ("ALTER TABLE inside.config ALTER settings DROP NOT NULL",),
    "a column that may not": ("ALTER TABLE inside.event ALTER detail SET NOT NULL",),
    "a default": ("ALTER TABLE inside.event ALTER detail SET DEFAULT 'x'",),
    "a generated column": (
        "DROP TABLE inside.imported",
        "CREATE TABLE inside.imported (bucket BIGINT, bit TINYINT, trace_id BIGINT, graph VARCHAR,"
        " place BIGINT, images BIGINT GENERATED ALWAYS AS (place + 1))",
    ),
    "a kind more": ("ALTER TABLE inside.map_edge ALTER src_kind TYPE ENUM ('car', 'hovercraft')",),
    "a type": (
        "ALTER TABLE inside.state ALTER light_state TYPE VARCHAR",  # a type in use is kept
        "ALTER TABLE inside.world_state ALTER light_state TYPE VARCHAR",
        "DROP TYPE light_state",
        "CREATE TYPE light_state AS ENUM ('red', 'blue')",
    ),
    "a macro like a function": ("CREATE MACRO degrees(x) AS 42",),
    "a macro like an operator": ("CREATE MACRO \"||\"(a, b) AS 'mine'",),
    "a macro like a table function": ("CREATE MACRO range(n) AS TABLE SELECT 1 AS range",),
    "a macro in other letters": ("CREATE MACRO SQRT(x) AS x",),
    "an index": ("CREATE UNIQUE INDEX once ON frame (trace_id)",),
    "a table among the views": ("CREATE TABLE main.trace AS FROM inside.trace",),
    "a type among the tables": ("CREATE TYPE inside.kind AS ENUM ('car')",),
    "a view among the tables": ("CREATE VIEW inside.frames AS SELECT 1 AS frame_id",),
    "a table is gone": ("DROP TABLE inside.payload",),
}


@pytest.mark.parametrize("how", ALTERED)
def test_every_object_that_is_not_as_sgstore_makes_it_is_told(made: Any, how: Any) -> None:
    made.execute("BEGIN")
    try:
        for statement in ALTERED[how]:
            made.execute(statement)
        assert shape.altered(made, "memory") != []
    finally:
        made.execute("ROLLBACK")


@pytest.mark.skipif(duckdb.__version__ < "2", reason="DuckDB 1.5 has no triggers")
def test_a_trigger_is_told(tmp_path: Path) -> None:
    connection = duckdb.connect()
    connection.execute(f"ATTACH '{tmp_path / 't'}' AS t (STORAGE_VERSION 'v2.0.0')")
    connection.execute("USE t")
    connection.execute(schema_sql())
    connection.execute(
        "CREATE TRIGGER mine AFTER INSERT ON inside.frame"
        " FOR EACH STATEMENT INSERT INTO inside.bits VALUES (1, 1)"
    )

    assert shape.altered(connection, "t") == ["table 'frame' has the trigger 'mine'"]


VERBS = (
    ("find", "{store}", "MATCH (e:Ego) RETURN e.speed"),
    ("check", "{store}", "-e", "CHECK c: ALWAYS ego.speed < 20"),
    ("info", "{store}"),
    ("sql", "{store}", "SELECT * FROM inside.config"),
    ("show", "{store}", "drive12#3"),
    ("payload", "{store}", "drive12#3", "/camera", "-o", "{out}"),
    ("like", "{store}", "drive12#3"),
    ("coverage", "of", "{store}", "--by", "{store}"),
    ("select", "{store}", "--minimal"),
    ("export", "{store}", "MATCH (e:Ego)", "--to", "{out}"),
    ("derive", "{store}", "--name", "near"),
    ("ingest", "{store}", "{recording}", "--force"),
    ("remove", "{store}", "drive12", "--compact"),
    ("timeline", "{store}", "-p", "cut_in"),
    ("why-not", "{store}", "drive12#3", "MATCH (e:Ego)"),
)


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb[0])
def test_a_view_in_the_place_of_a_table_reads_nobodys_files(
    run: Any, verb: Any, store: Any, drives: Any, tmp_path: Path
) -> None:
    secret = tmp_path / "secret.json"
    secret.write_text('{"password": "1234567"}')
    change(
        store,
        "DROP TABLE inside.config",
        f"CREATE VIEW inside.config AS SELECT 1 AS config_id, content AS digest, content AS settings"
        f" FROM read_text('{secret}')",
    )
    before = store.read_bytes()
    given = {"store": store, "out": tmp_path / "out", "recording": drives[1] / "drive12.mcap"}
    result = run(*(word.format(**given) for word in verb))

    assert result.exit_code == 1, result.output
    assert "table 'config' is a view" in result.output
    assert "1234567" not in result.output
    assert store.read_bytes() == before
    assert b"1234567" not in before


def test_a_store_that_was_good_is_looked_at_again_once_it_has_changed(store: Any) -> None:
    file = StoreFile(store)
    assert len(file.traces()) == 2
    change(store, "CREATE OR REPLACE VIEW lanes AS SELECT 1 AS x")

    for ask in (file.traces, lambda: file.remove("drive12"), file.compact, file.traces):
        for _ in range(2):
            with pytest.raises(StoreError, match="view 'lanes' differs"):
                ask()


def test_a_store_that_this_process_has_made_is_looked_at_once_it_was_altered(
    tmp_path: Path,
) -> None:
    for name in ("a", "b"):  # the second one is written as the first one was
        StoreFile.create(tmp_path / name)
        change(tmp_path / name, "CREATE OR REPLACE VIEW lanes AS SELECT 1 AS x")

        with pytest.raises(StoreError, match="view 'lanes' differs"):
            StoreFile(tmp_path / name)


def test_a_store_is_not_taken_for_new_if_a_log_lies_where_it_is_made(tmp_path: Path) -> None:
    first, second = StoreFile.create(tmp_path / "a"), tmp_path / "b"
    alters = (
        "import duckdb, os; c = duckdb.connect({!r}); c.execute('PRAGMA disable_checkpoint_on_shutdown');"
        " c.execute('CREATE OR REPLACE VIEW lanes AS SELECT 1 AS x'); os._exit(0)"
    )
    subprocess.run([sys.executable, "-c", alters.format(str(first.path))], check=True)
    (tmp_path / "a.wal").rename(tmp_path / "b.wal")

    with pytest.raises(StoreError, match="view 'lanes' differs"):
        StoreFile.create(second).traces()
    assert first.traces() == ()


def test_verify_says_every_object_that_was_altered(run: Any, store: Any) -> None:
    change(
        store,
        "CREATE OR REPLACE VIEW lanes AS SELECT * FROM read_csv('/etc/passwd')",
        "ALTER TABLE inside.event ADD COLUMN more INTEGER",
        "CREATE MACRO abs(x) AS 1",
    )
    result = run("verify", store, "--format", "ndjson")

    assert result.exit_code == 1
    found = [json.loads(line) for line in result.stdout.splitlines()]
    assert {row["check"] for row in found} == {"schema"}
    assert [row["detail"] for row in found] == [
        "table 'event' differs from that of sgstore",
        "view 'lanes' differs from that of sgstore",
        "a macro takes the place of the function 'abs'",
    ]


@pytest.mark.parametrize("digest", ["0" * 64, None])
def test_a_store_that_other_statements_made_is_of_another_version_and_not_altered(
    run: Any, store: Any, digest: Any
) -> None:
    keyed = "WHERE key = 'schema_digest'"
    change(
        store,
        f"UPDATE inside.store_info SET value = '{digest}' {keyed}"
        if digest
        else f"DELETE FROM inside.store_info {keyed}",
        "ALTER TABLE inside.event ADD COLUMN more INTEGER",
    )
    result = run("info", store)

    assert result.exit_code == 1
    assert "with other tables or views than those of this sgstore (made by sgstore" in result.output
    assert "differs from the schema" not in result.output


def test_tables_of_somebody_else_are_left_alone_and_told(
    run: Any, store: Any, drives: Any, tmp_path: Path
) -> None:
    secret = tmp_path / "secret.csv"
    secret.write_text("password\n1234567\n")
    change(
        store,
        "CREATE TABLE labels AS SELECT frame_id, 1 AS label FROM inside.frame",
        f"CREATE VIEW broken AS SELECT * FROM read_csv('{secret}')",
        "CREATE SCHEMA mine",
        "CREATE TABLE mine.trace (trace_id BIGINT)",
        "INSERT INTO mine.trace VALUES (7)",
        "CREATE MACRO double_of(x) AS 2 * x",
    )
    secret.unlink()

    verified = run("verify", store)
    assert verified.exit_code == 0
    assert "tables of other programs, not checked: broken, labels, mine.trace" in verified.output
    assert run("find", store, "MATCH (e:Ego)", "--count").exit_code == 0
    assert run("derive", store, "--name", "again").exit_code == 0
    assert run("sql", store, "SELECT sum(label) FROM labels").exit_code == 0
    before = store.read_bytes()
    refused = run("remove", store, "drive12", "--compact")
    assert refused.exit_code == 1
    assert "would be lost: broken, labels, mine.trace" in refused.output
    assert store.read_bytes() == before
    assert run("remove", store, "drive12").exit_code == 0
    assert run("ingest", store, drives[1] / "drive12.mcap").exit_code == 0
    with duckdb.connect(str(store), read_only=True) as connection:
        assert connection.execute("SELECT count(*) FROM labels").fetchall() == [(26,)]
        assert connection.execute("FROM mine.trace").fetchall() == [(7,)]


def test_a_connection_that_writes_sees_no_other_files_and_keeps_its_settings(
    store: Any, tmp_path: Path
) -> None:
    secret = tmp_path / "secret.csv"
    secret.write_text("password\n1234567\n")
    forbidden = (
        f"FROM read_csv('{secret}')",
        f"COPY (SELECT 1) TO '{tmp_path / 'out.csv'}'",
        f"ATTACH '{tmp_path / 'other.db'}'",
        "SET enable_external_access = true",
        "SET memory_limit = '10GB'",
        "LOAD httpfs",
    )
    access = Access(store, memory=1 << 28, wait_s=5)
    with scratch(tmp_path / "spill") as connection, access.attached(connection):
        for statement in forbidden:
            with pytest.raises(duckdb.Error, match=r"disabled|locked"):
                connection.execute(statement)
        settings = (
            "enable_external_access",
            "autoload_known_extensions",
            "autoinstall_known_extensions",
        )
        for setting in settings:
            assert connection.execute(f"SELECT current_setting('{setting}')").fetchone() == (False,)


# What is no file


@pytest.fixture
def special(tmp_path: Path) -> dict[str, Path]:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(str(tmp_path / "socket"))
    listening.close()
    kinds = {"pipe": "a named pipe", "folder": "a folder", "socket": "a socket"}
    return {what: tmp_path / name for name, what in kinds.items()} | {"a device": Path("/dev/zero")}


@pytest.mark.parametrize("what", ["a named pipe", "a folder", "a socket", "a device"])
@pytest.mark.parametrize("verb", [VERBS[0], VERBS[2], VERBS[11], ("verify", "{store}")], ids=str)
def test_what_is_no_file_is_refused_as_a_store_at_once(
    run: Any, special: Any, what: Any, verb: Any, drives: Any, tmp_path: Path
) -> None:
    given = {
        "store": special[what],
        "out": tmp_path / "out",
        "recording": drives[1] / "drive12.mcap",
    }
    result = run(*(word.format(**given) for word in verb))

    assert result.exit_code == 1
    assert f"{special[what]}: {what}: not a store" in result.output


@pytest.mark.parametrize("ending", [".wal", ".gate", ".segment-1-ab"])
def test_a_pipe_beside_a_store_makes_nobody_wait(
    run: Any, store: Any, drives: Any, ending: Any
) -> None:
    os.mkfifo(store.with_name(f"{store.name}{ending}"))
    found = run("find", store, "MATCH (e:Ego)", "--count")
    removed = run("remove", store, "drive12")
    added = run("ingest", store, drives[1] / "drive12.mcap")

    expected = 1 if ending == ".wal" else 0
    assert [one.exit_code for one in (found, removed, added)] == [expected] * 3, added.output


# A connection that this process has already


@pytest.mark.parametrize("read_only", [True, False])
@pytest.mark.parametrize("write", [True, False])
def test_a_store_that_this_process_has_open_by_duckdb_is_said_to_be_at_once(
    store: Any, drives: Any, read_only: Any, write: Any
) -> None:
    opened = sgstore.open(store)
    opened.close()

    def ask() -> None:
        if write:
            ingest(store, [drives[1] / "drive12.mcap"], force=True)
        else:
            list(opened.find("MATCH (e:Ego)"))

    with duckdb.connect(str(store), read_only=read_only) as connection:
        with pytest.raises(StoreError, match="open in this process already, by a connection of"):
            ask()
        assert connection.execute("SELECT count(*) FROM inside.trace").fetchall() == [(2,)]

    assert len(sgstore.open(store).info()) == 2
    (outcome,) = ingest(store, [drives[1] / "drive12.mcap"], force=True)
    assert outcome.status == "replaced"


# Stores whose rows were changed

ODD = {
    "VARCHAR": ("''", "'x'"),
    "JSON": ("'[]'", "'{}'", "'7'"),
    "VARCHAR[]": ("[]", "['x']", "[NULL]"),
    "BOOLEAN": ("true", "false"),
    "TIMESTAMP": ("'infinity'",),
    "FLOAT": ("'nan'", "'inf'", "-1"),
    "DOUBLE": ("'nan'", "'inf'", "-1"),
    "TINYINT": ("-1", "127"),
    "BIGINT": ("-1", "9223372036854775807"),
    "INTEGER": ("-1", "2147483647"),
}
ASKED = (
    ("info", "{store}", "--trace", "drive12"),
    ("verify", "{store}", "--payloads"),
    ("find", "{store}", "MATCH (e:Ego)-[:near|isIn]->(x) RETURN e.name, x.name, x.speed"),
    (
        "find",
        "{store}",
        "MATCH (v:Vehicle) THEN MATCH (v) WHERE v.speed > 0 RETURN CLIPS(-1s, +1s)",
    ),
    ("check", "{store}", "-e", "CHECK c: ALWAYS ego.speed < 20"),
    ("why-not", "{store}", "drive12#3", "MATCH (e:Ego)-[:near]->(v:Person)"),
    ("like", "{store}", "drive12#3"),
    ("payload", "{store}", "drive12#3", "/ego/camera/front/image", "-o", "{out}"),
    ("sql", "{store}", "SELECT * FROM nodes JOIN pairs USING (frame_id)"),
    ("derive", "{store}", "--name", "more"),
    ("coverage", "of", "{store}", "--by", "{store}"),
    ("remove", "{store}", "drive12"),
    ("rebuild", "{store}"),
)


def hurts(connection: duckdb.DuckDBPyConnection) -> list[str]:
    """Every column of every table with every odd value, and tables with rows too few or too many."""
    found: list[str] = []
    for table in (f"inside.{name}" for name in names("TABLE")):
        for name, kind, *_ in connection.execute(f"DESCRIBE {table}").fetchall():
            values = [*ODD.get(kind, ()), "NULL"]
            values += [f"enum_last(NULL::{name})"] if name in names("TYPE") else []
            found += [f'UPDATE {table} SET "{name}" = {value}' for value in values]
        found += [f"DELETE FROM {table}", f"DELETE FROM {table} WHERE rowid % 2 = 0"]
        found.append(f"INSERT INTO {table} SELECT * FROM {table}")
    return found


KNOWN = (
    ("UPDATE inside.config SET settings = '[]'", 5),
    ("UPDATE inside.config SET settings = '7'", 0),
    ("UPDATE inside.config SET config_id = 2147483647", 5),
    ("UPDATE inside.trace SET report = '[]'", 0),
    ("UPDATE inside.recording SET uri = '/dev/zero'", 7),
    ("UPDATE inside.recording SET uri = '/dev/zero'", 1),
    ("UPDATE inside.recording SET place = '../../etc/passwd'", 1),
    ("DELETE FROM inside.bits", 2),
)


@pytest.mark.parametrize("number", range(40 if LONG else len(KNOWN)))
def test_rows_that_were_changed_give_an_answer_or_a_reason_and_no_traceback(
    run: Any, made: Any, store: Any, tmp_path: Path, number: Any
) -> None:
    chance = random.Random(number)
    hurt, verb = chance.choice(hurts(made)), chance.choice(ASKED)
    if number < len(KNOWN):
        hurt, verb = KNOWN[number][0], ASKED[KNOWN[number][1]]
    try:
        change(store, hurt)
    except duckdb.Error:  # what may not be missing cannot be made so
        assert hurt.endswith("NULL")
        return
    result = run(*(word.format(store=store, out=tmp_path / "out") for word in verb))

    assert result.exit_code in {0, 1, 2, 3, 4}
    if result.exit_code == 1 and verb[0] != "verify":
        assert result.stderr.strip()


@pytest.mark.parametrize("what", ["a named pipe", "a folder", "a socket", "a device"])
def test_a_recording_that_has_become_no_file_is_refused_at_once(
    run: Any, store: Any, special: Any, what: Any
) -> None:
    change(store, f"UPDATE inside.recording SET uri = '{special[what]}', size = 0")

    verified = run("verify", store, "--payloads")
    shown = run(
        "payload", store, "drive12#3", "/ego/camera/front/image", "-o", store.with_name("x")
    )
    assert (verified.exit_code, shown.exit_code) == (1, 1)
    assert str(special[what]) in verified.stdout


@pytest.mark.parametrize(
    ("name", "reason"),
    [("x" * 300, "File name too long"), ("file/x.sgstore", "Not a directory")],
    ids=["a long name", "below a file"],
)
def test_a_place_that_cannot_be_looked_at_is_refused_with_the_reason(
    run: Any, tmp_path: Path, name: Any, reason: Any
) -> None:
    (tmp_path / "file").touch()
    place = tmp_path / name

    with pytest.raises(StoreError) as refused:
        sgstore.open(place)
    result = run("find", place, "MATCH (e:Ego)")

    assert str(refused.value) == f"{place}: cannot be read: {reason}"
    assert result.exit_code == 1
    assert f"cannot be read: {reason}" in result.output
