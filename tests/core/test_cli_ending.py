"""What ends a run before it is done, and what is left of it then: nothing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
import thorough
import typer
import verb_lines
from children import FOLDERS
from test_cli_streams import SLOTS
from verb_lines import LINES, verbs

import sgstore
import sgstore.apps.cli._process as ending
import sgstore.store._rows as rows
from sgstore.apps.cli import app, run
from sgstore.apps.demo import RECORDING
from sgstore.errors import SqlError
from sgstore.query import Store
from sgstore.store._locking import Access

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.seconds(42)

NOT_ASKING = {
    *("ingest", "import", "rebuild", "derive", "remove", "verify", "info"),
    *("doctor", "map", "monitor", "record", "demo", "try", "mcp", "serve"),
    *("config", "translate", "patterns list", "patterns search", "patterns show", "payload"),
    *("lock list", "lock union", "lock intersect", "lock minus"),
    *(f"collection {verb}" for verb in ("pack", "commit", "unpack", "verify", "rebuild", "gc")),
}
"""Verbs that write stores or tell of them, that read recordings, and that need no store at all.

``mcp`` and ``serve`` bound each question by itself.
"""
ASKING = [verb for verb in LINES if verb not in NOT_ASKING | {"lint", "docs"}]
OUTPUTS = {
    "select": ["-o", "{new}.lock", "--no-payloads"],
    "prioritize": ["-o", "{new}.lock", "--no-payloads"],
    "timeline": ["-o", "{new}.svg"],
    "coverage growth": ["-o", "{new}.csv", "--picture", "{new}.png"],
} | {verb: [] for verb in ("why-not", "show", "export", "shrink", "report")}
"""What verbs write beside what their lines say; the others rows."""

MATCHES = (
    "MATCH (a:Vehicle), (b:Vehicle), (c:Vehicle), (d) WHERE a.speed + b.speed + c.speed + d.x > 1"
)
MANY = (
    f"{MATCHES} RETURN a.name, b.name, c.name, d.name, a.speed, b.x, c.x"
    " ORDER BY a.speed + b.speed * c.speed"
)
"""A query with far more matches than anybody waits for."""
RULE = (
    "CHECK FORALL (a:Vehicle, b:Vehicle, c:Vehicle, d:Vehicle)"
    " ALWAYS dist(a, b) < 3 + dist(b, c) + dist(c, d)"
)
"""A check of 300,000 bindings over 750 frames: seconds on any machine."""
PAIRS = "SELECT count(*) FROM range(10000000) a, range(10000000) b WHERE a.range + b.range > 3"


@pytest.fixture
def small_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sgstore.store._file.default_memory", lambda: 64 << 20)


ENDLESS = {
    "find": ["{store}", MANY, "--format", "csv", "-o", "{new}.csv"],
    "check": ["{store}", "-e", RULE, "--format", "csv", "-o", "{new}.csv"],
    "sql": ["{store}", PAIRS],
    "timeline": ["{store}", RULE, "-o", "{new}.svg"],
    "select": ["{store}", MATCHES, "-o", "{new}.lock"],
    "diff": ["{store}", "{store}", "-q", RULE],
    "coverage spec": ["{store}", MANY.partition(" ORDER BY")[0], "-o", "{new}.csv"],
    "export": ["{store}", MATCHES, "--to", "{new}/clips"],
    "shrink": ["{store}", RULE, "--to", "{new}/cut"],
}
"""Questions that take longer than the deadline, however fast the machine is."""
LATE = thorough.some([*ENDLESS], 2)
"""The verbs that end at a deadline; ``make oracle`` tries all of them."""


@pytest.fixture(scope="module")
def late(town_store: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Of each endless question: exit code, length of stdout, stderr, and its folder.

    Each runs in a process of its own, forked from one that imported all: what comes too late ends that one.
    """
    folders = {verb: tmp_path_factory.mktemp(verb.replace(" ", "-")) for verb in LATE}
    asked = []
    for verb in LATE:
        line = ENDLESS[verb]
        names = {"store": town_store, "new": folders[verb] / "new"}
        words = [*verb.split(), *(part.format(**names) for part in line), "--timeout", "200ms"]
        asked.append([(words, "")])
    done = subprocess.run(
        [sys.executable, verb_lines.__file__],
        input=json.dumps(asked),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=600,
    )
    ends = map(json.loads, done.stdout.splitlines())
    return {verb: (*end, folders[verb]) for verb, end in zip(LATE, ends, strict=True)}


@pytest.mark.parametrize("verb", LATE)
def test_a_question_ends_at_its_deadline_and_leaves_nothing(
    verb: str, late: dict[str, Any]
) -> None:
    code, _, err, folder = late[verb]

    assert code == 2
    assert "stopped after 0.2 s" in err
    assert "raise it, or reduce the query" in err
    assert not list(folder.iterdir())


ONE_STEP = "SELECT count(*) FROM nodes a, nodes b, nodes c WHERE a.x + b.x + c.x > 3"
"""A question whose answer is one step of the database, which takes hours."""


def test_a_step_of_the_database_that_takes_for_ever_ends_at_the_deadline_too(
    town_store: Path,
) -> None:
    line = ["sql", str(town_store), ONE_STEP, "--timeout", "300ms"]
    done = subprocess.run(
        [sys.executable, "-m", "sgstore", *line],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )

    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("sgstore: stopped after 0.3 s")
    assert len(done.stderr.splitlines()) == 1  # the database is let go of before the process ends


LONG_STEP = (
    "MATCH (c:%) WHERE NOT EXISTS {(b) WHERE b.width < b.heading + 2.5"
    " AND COUNT {(d) WHERE c.kind <> 'car' OR NOT (b.accel > c.speed + 0)} = 2}"
)
"""A query that the database answers in a few steps, each of which takes long."""
NEVER = f"CHECK ALWAYS EXISTS {{{LONG_STEP.removeprefix('MATCH ')}}}"

ENDLESS_IN_PYTHON: dict[str, Callable[[Store], object]] = {
    "sql": lambda store: store.sql(ONE_STEP),
    "sql that is bounded": lambda store: store.sql(ONE_STEP, timeout_s=600.0),
    "rows": lambda store: store.file.rows(ONE_STEP),
    "arrays": lambda store: store.file.arrays(ONE_STEP),
    "find": lambda store: store.find(LONG_STEP).rows(),
    "find, the first row": lambda store: next(iter(store.find(LONG_STEP))),
    "find, counted": lambda store: store.find(LONG_STEP).count(),
    "check": lambda store: list(store.check(NEVER)),
}

ALARMED = """
import signal, sys, threading, time
sys.path[:0] = {paths!r}
from sgstore.query import Store

class TimeIsUpError(Exception):
    pass

def up(*_):
    raise TimeIsUpError

def alarmed(task, after=0.5):
    signal.signal(signal.SIGALRM, up)
    try:
        signal.setitimer(signal.ITIMER_REAL, after)
        task()
    except TimeIsUpError:
        return
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    raise AssertionError("nothing was interrupted")

store = Store({store!r})
"""
"""Alarms reach the process that sets them: each test has one of its own."""


def in_a_process(code: str, store: Path) -> None:
    """Run code after :data:`ALARMED`, and fail with what it prints."""
    head = ALARMED.format(paths=FOLDERS, store=str(store))
    command = [sys.executable, "-c", head + code]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


FACES = [[face] for face in ENDLESS_IN_PYTHON] if thorough.LONG else [[*ENDLESS_IN_PYTHON]]
"""Questions that one process asks; in ``make oracle`` each has a process of its own."""


@pytest.mark.parametrize("faces", FACES, ids=", ".join)
def test_what_a_handler_of_signals_raises_ends_a_question_of_the_library(
    faces: list[str], town_store: Path
) -> None:
    code = f"""
from test_cli_ending import ENDLESS_IN_PYTHON
for face in {faces!r}:
    try:
        alarmed(lambda: ENDLESS_IN_PYTHON[face](store))
        assert store.sql("SELECT count(*) FROM frames").values == [(750,)]
    except BaseException as error:
        raise AssertionError(face) from error
print("done")
"""
    in_a_process(code, town_store)


def test_a_handler_that_raises_nothing_changes_no_answer(town_store: Path) -> None:
    code = """
came = []
signal.signal(signal.SIGALRM, lambda *_: came.append(1))
signal.setitimer(signal.ITIMER_REAL, 0.01, 0.01)
found = store.sql("SELECT count(*), sum(a.x) > 0 FROM nodes a, range(100)")
signal.setitimer(signal.ITIMER_REAL, 0)
(nodes,) = store.sql("SELECT count(*) FROM nodes").values[0]
assert came
assert found.values[0][0] == 100 * nodes
print("done")
"""
    in_a_process(code, town_store)


def test_one_thread_does_the_steps_of_all_questions_even_after_an_interruption(
    town_store: Path,
) -> None:
    code = f"""
assert store.sql("SELECT 1").values == [(1,)]
threads = threading.active_count()
with store.file.snapshot():  # opened before: only a step is interrupted
    alarmed(lambda: store.sql({PAIRS!r}))
assert [store.sql(f"SELECT {{n}}").values for n in range(20)] == [[(n,)] for n in range(20)]
assert threading.active_count() == threads
print("done")
"""
    in_a_process(code, town_store)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing is forked off here")
def test_a_process_that_was_forked_off_asks_by_a_thread_of_its_own(town_store: Path) -> None:
    assert Store(town_store).sql("SELECT 1").values == [(1,)]
    child = os.fork()
    if not child:
        # DuckDB itself does not survive a fork; a step of Python shows whether anybody does the steps.
        os._exit(rows.interruptible(None, lambda: 7))
    late = threading.Timer(300, os.kill, (child, signal.SIGKILL))
    late.start()
    try:
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    finally:
        late.cancel()


def test_errors_of_the_database_and_other_threads_are_as_they_were(town_store: Path) -> None:
    found: list[object] = []

    def ask() -> None:
        try:
            found.append(Store(town_store).sql("SELECT count(*) FROM frames").values)
            Store(town_store).sql("SELECT nothing FROM frames")
        except SqlError as error:
            found.append(str(error))

    ask()
    other = threading.Thread(target=ask)
    other.start()
    other.join()

    assert found[:2] == found[2:]
    assert "nothing" in str(found[1])


@pytest.mark.parametrize("end", ["deadline", "Ctrl-C", "safe"])
def test_a_find_of_long_steps_ends(end: str, town_store: Path, tmp_path: Path) -> None:
    late = ["--timeout", "500ms"]
    more = {"deadline": late, "Ctrl-C": [], "safe": ["--safe", *late]}
    line = ["find", str(town_store), LONG_STEP, *more[end]]
    process = subprocess.Popen(
        [sys.executable, "-m", "sgstore", *line],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TMPDIR": str(tmp_path)},
    )
    try:
        if end == "Ctrl-C":
            assert wait(lambda: list(tmp_path.glob("sgstore-held-*")))
            time.sleep(0.4)
            process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300)
    finally:
        process.kill()

    assert (process.returncode, out) == (130 if end == "Ctrl-C" else 2, "")
    err = err.partition("beyond the graphs (50 m)\n")[2] or err  # behind what the settings cut
    told = "sgstore: interrupted" if end == "Ctrl-C" else "sgstore: stopped after 0.5 s"
    # In its process memory is bounded, too: which bound ends it first, the machine decides.
    memory = end == "safe" and err.startswith("sgstore: stopped: it took more memory")
    assert err.startswith(told) or memory
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What stands in the command lines of the verbs that ask. The store is no longer than the lines need."""
    folder = tmp_path_factory.mktemp("files")
    store = folder / "town.sgstore"
    assert run(["ingest", str(store), str(RECORDING), "--until", "27s"]) == 0
    (folder / "slots.toml").write_text(SLOTS)
    failed = "".join(f"town#{number},0\n" for number in range(271))
    (folder / "outcomes.csv").write_text(f"frame,failed\n{failed}")
    lock = folder / "town.lock"
    assert run(["select", str(store), "--minimal", "--no-payloads", "-o", str(lock)]) == 0
    found = {"slots": folder / "slots.toml", "outcomes": folder / "outcomes.csv", "lock": lock}
    return {name: str(path) for name, path in found.items()} | {"store": str(store)}


def test_verbs_that_ask_a_store_say_in_the_same_words_how_they_are_bounded() -> None:
    known = verbs(typer.main.get_command(app))
    for name in ("timeout", "max_spill"):
        having = {
            verb: (one.opts, one.metavar, one.help, one.show_default, one.multiple)
            for verb, command in known.items()
            for one in command.params
            if one.name == name
        }
        assert sorted(having) == sorted(ASKING)
        assert len(set(map(str, having.values()))) == 1


@pytest.mark.parametrize("verb", thorough.some(ASKING, 5))
def test_every_verb_that_asks_heeds_its_bounds_and_leaves_nothing_where_time_is_over(
    verb: str,
    files: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # The deadline passes as the store is asked for the last time, whenever that is.
    opened, asked, last = [], [0], [0]
    connect, enter = duckdb.connect, Access._enter

    def connecting(*arguments: object, **options: dict[str, object]) -> object:
        opened.append(options.get("config", {}).get("max_temp_directory_size"))
        return connect(*arguments, **options)

    def entering(access: Access, *arguments: object, **named: object) -> object:
        asked[0] += 1
        if asked[0] == last[0]:
            signal.raise_signal(signal.SIGALRM)
        return enter(access, *arguments, **named)

    monkeypatch.setattr(duckdb, "connect", connecting)
    monkeypatch.setattr(Access, "_enter", entering)

    def end(folder: str, *bounds: str) -> int:
        (tmp_path / folder).mkdir()
        words = [*LINES[verb], *OUTPUTS.get(verb, ["-o", "{new}.csv"])]
        given = [word.format(**files, new=tmp_path / folder / "new") for word in words]
        return run([*verb.split(), *given, *bounds])

    assert end("whole", "--max-spill", "3GB", "--timeout", "600s") == 0
    assert {bound for bound in opened if bound} == {"2929687KiB"}
    assert any((tmp_path / "whole").iterdir()) == (verb != "why-not")
    capsys.readouterr()
    asked[0], last[0] = 0, asked[0]
    assert end("late", "--timeout", "600s") == 2
    assert "stopped after 600 s" in capsys.readouterr().err
    assert not list((tmp_path / "late").iterdir())


def test_a_deadline_is_told_as_data_and_safely_too(
    town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["find", str(town_store), MANY, "--timeout", "500ms", "--json"]) == 2
    *_, told = capsys.readouterr().err.splitlines()
    assert json.loads(told)["error"] == "SqlError"
    assert run(["find", str(town_store), MANY, "--timeout", "500ms", "--safe"]) == 2
    # In its process memory is bounded, too: which bound ends it first, the machine decides.
    told = capsys.readouterr().err
    assert "stopped after 0.5 s" in told or "stopped: it took more memory" in told


class Closing:
    """Something that takes a while when it is thrown away."""

    def __del__(self) -> None:
        time.sleep(1)


def test_an_interruption_that_comes_while_something_is_thrown_away_is_not_lost() -> None:
    ending.set_deadline(0.2)
    try:
        Closing()  # Python can raise nothing out of `__del__`
        with pytest.raises(KeyboardInterrupt):
            time.sleep(5)
        assert ending.was_ended()
    finally:
        ending.clear_deadline()
    assert sys.unraisablehook is not ending._lost


LARGE = "SELECT repeat('x', 1000) || i AS t FROM range(300000) r(i) ORDER BY hash(i)"


@pytest.mark.usefixtures("small_memory")
def test_a_question_that_needs_more_disk_than_it_may_says_what_to_do(
    town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["sql", str(town_store), LARGE, "--max-spill", "2MB", "--timeout", "600s"]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert told.startswith("sgstore: stopped: it needs more")
    assert "--max-spill 50GB" in told


def test_the_library_has_the_same_bound_and_the_database_is_told_of_it(town_store: Path) -> None:
    store = Store(town_store, memory=64 << 20, max_spill=2_000_000)
    settings = "SELECT value FROM duckdb_settings() WHERE name = 'max_temp_directory_size'"

    assert store.sql(settings).values == [("1.9 MiB",)]
    with pytest.raises(SqlError, match="stopped: it needs more"):
        store.sql(LARGE)
    assert sgstore.open(town_store).sql(settings).values == [("9.3 GiB",)]


@pytest.mark.parametrize(
    ("size", "told"),
    [("5kB", "4.0 KiB"), ("5MB", "4.7 MiB"), ("50gb", "46.5 GiB"), ("2.5 TB", "2.2 TiB")],
)
def test_sizes_are_as_large_as_they_say(
    size: str, told: str, town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = "SELECT value FROM duckdb_settings() WHERE name = 'max_temp_directory_size'"

    assert run(["sql", str(town_store), settings, "--max-spill", size, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [{"value": told}]


@pytest.mark.parametrize("wrong", ["--max-spill=5", "--max-spill=5 apples", "--timeout=soon"])
def test_a_bound_that_is_none_is_refused(wrong: str, town_store: Path) -> None:
    assert run(["find", str(town_store), "MATCH (e:Ego)", wrong]) == 2


def test_a_query_that_speaks_of_interruptions_is_none(town_store: Path) -> None:
    text = "MATCH (e:Ego) WHERE e.nme = 'KeyboardInterrupt: Query interrupted'"

    assert run(["find", str(town_store), text]) == 2


# Signals ------------------------------------------------------------------------------------------------

LONG = {
    "ingest": ["ingest", "{folder}/new.sgstore", "{drives}"],
    "ingest --jobs": ["ingest", "{folder}/new.sgstore", "{drives}", "--jobs", "2"],
    "find": ["find", "{store}", MANY, "-o", "{folder}/rows.csv"],
    "check": ["check", "{store}", "-e", RULE, "-o", "{folder}/rows.csv"],
    "sql": ["sql", "{store}", ONE_STEP],
    "sql --safe": ["sql", "{store}", PAIRS, "--safe", "--timeout", "60s"],
    "show": ["show", "{store}", "town#0..249", "-o", "{folder}/clip.gif"],
    "export": ["export", "{store}", "MATCH (e:Ego)", "--to", "{folder}/e", "--as", "nx"],
}
"""Long runs of all kinds: with processes, transactions, spilled tables, and files on their way."""
BEGUN = {
    "show": "{folder}/.sgstore-held-*/*",
    "export": "{folder}/e/.export-*/*",
    "ingest": "{folder}/new.sgstore.segment-*/0/*",
    "ingest --jobs": "{folder}/new.sgstore.segment-*/0/*",
}
"""What is there once they are at work; of the others a time is waited for."""


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings that differ."""
    folder = tmp_path_factory.mktemp("drives")
    for number in range(
        4
    ):  # a file may be longer than its last record: what follows is not looked at
        (folder / f"{number}.mcap").write_bytes(RECORDING.read_bytes())
    return folder


def children_of(process: int) -> list[int]:
    found: list[int] = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == process and fields[0] != "Z":
            found += [int(stat.parent.name), *children_of(int(stat.parent.name))]
    return found


def wait(until: Callable[[], object], seconds: float = 300.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if until():
            return True
        time.sleep(0.01)
    return False


@pytest.fixture
def begun(town_store: Path, drives: Path, tmp_path: Path):
    """Starts a long run, and comes back when it is at work; gives the process and its folders."""
    folder, temporary = tmp_path / "work", tmp_path / "tmp"
    folder.mkdir()
    temporary.mkdir()

    def start(verb: str) -> subprocess.Popen[str]:
        names = {"folder": folder, "store": town_store, "drives": drives}
        line = [part.format(**names) for part in LONG[verb]]
        process = subprocess.Popen(
            [sys.executable, "-m", "sgstore", *line],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"TMPDIR": str(temporary)},
        )
        there = BEGUN.get(verb, f"{temporary}/sgstore-held-*").format(**names)
        assert wait(lambda: list(Path("/").glob(there[1:])))
        time.sleep(0.2)
        assert process.poll() is None
        return process

    start.folder, start.temporary = folder, temporary
    return start


SENT = [*((verb, signal.SIGTERM) for verb in thorough.some([*LONG], 2)), ("find", signal.SIGHUP)]
"""Each kind of run is ended once. Ctrl-C: ``test_a_find_of_long_steps_ends``; ``test_ctrl_c_…`` of ingest."""
if thorough.LONG:  # make oracle
    SENT += [("ingest --jobs", signal.SIGHUP)]
    SENT += [(verb, signal.SIGINT) for verb in ("ingest --jobs", "find", "show")]


@pytest.mark.parametrize(("verb", "sent"), SENT)
def test_signals_end_a_run_in_order_and_leave_nothing_behind(
    verb: str, sent: signal.Signals, begun: Any
) -> None:
    process = begun(verb)
    workers = children_of(process.pid)
    process.send_signal(sent)
    _, err = process.communicate(timeout=300)

    assert process.returncode == 128 + sent, err
    word = "interrupted" if sent == signal.SIGINT else f"ended by {sent.name}"
    stored = "; the store has all finished work" if "ingest" in verb else ""
    assert err.splitlines()[-1:] == [f"sgstore: {word}{stored}"]
    assert "Traceback" not in err
    assert bool(workers) == (verb in {"ingest --jobs", "sql --safe"})
    assert wait(lambda: not any(Path(f"/proc/{one}").exists() for one in workers), 10)
    assert {one.name for one in begun.folder.rglob("*")} <= {"new.sgstore"}
    assert not list(begun.temporary.iterdir())


@pytest.mark.parametrize("verb", thorough.some(["ingest --jobs", "find", "show", "export"], 3))
def test_what_a_killed_run_left_is_removed_by_the_next_start(
    verb: str, begun: Any, town_store: Path
) -> None:
    process = begun(verb)
    process.kill()
    process.communicate()
    left = [*begun.folder.rglob("*"), *begun.temporary.iterdir()]
    assert left

    env = os.environ | {"TMPDIR": str(begun.temporary)}
    fast = [str(town_store), "MATCH (e:Ego) WHERE e.speed > 9"]
    lines = {
        "show": ["show", str(town_store), "town#3", "-o", f"{begun.folder}/x.png"],
        "export": ["export", "--as", "parquet", "--to", f"{begun.folder}/e", *fast],
        "ingest --jobs": ["ingest", f"{begun.folder}/new.sgstore", str(RECORDING), "--until", "1s"],
        "find": ["find", str(town_store), "MATCH (e:Ego)", "-o", f"{begun.folder}/rows.csv"],
    }
    again = [sys.executable, "-m", "sgstore", *lines[verb]]
    subprocess.run(again, env=env, check=True, capture_output=True)

    there = {one.name for one in begun.folder.rglob("*")}
    assert not [name for name in there if "held" in name or "segment" in name or ".export" in name]
    assert not list(begun.temporary.iterdir())


@pytest.mark.parametrize("verb", ["export", "shrink"] if thorough.LONG else ["export"])
def test_a_refused_export_removes_the_folders_of_a_killed_one(
    verb: str, town_store: Path, tmp_path: Path
) -> None:
    to, temporary = tmp_path / "to", tmp_path / "tmp"
    temporary.mkdir()
    more = ["--as", "parquet"] if verb == "export" else []
    line = [verb, str(town_store), "MATCH (e:Ego) WHERE frame.seq < 5", "--to", str(to), *more]
    code = (
        "import os, signal, sys; from sgstore.apps import cli; "
        "from sgstore.base import temporary_folders as files; "
        "sys.argv[0] = 'sgstore'\n"
        "if sys.argv[1] == 'kill':\n"
        "    files.HeldFolder.remove = lambda self: os.kill(os.getpid(), signal.SIGKILL)\n"
        "del sys.argv[1]; cli.main()"
    )

    def run(how: str) -> int:
        env = os.environ | {"TMPDIR": str(temporary)}
        return subprocess.run(
            [sys.executable, "-c", code, how, *line], check=False, capture_output=True, env=env
        ).returncode

    assert run("kill") == -signal.SIGKILL
    files = {one.name for one in to.iterdir()}
    assert "manifest.json" in files
    assert any(name.startswith(".export-") for name in files)
    assert list(temporary.glob("sgstore-held-*"))

    assert run("again") == 1
    assert {one.name for one in to.iterdir()} == {
        name for name in files if not name.startswith(".export-")
    }
    assert not list(temporary.iterdir())


def test_the_exit_code_is_kept_wherever_the_interruption_came_from() -> None:
    code = (
        "import signal, sys; import sgstore.apps.cli._process as ending\n"
        "ending.heed_signals()\n"
        "try: exec('signal.raise_signal(signal.SIGTERM)')\n"
        "except KeyboardInterrupt: ending.ignore_signals(); sys.exit(ending.exit_code())"
    )

    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 143


@pytest.mark.parametrize("place", ["_process._hear_of_lost", "run", "_process.clear_deadline"])
def test_a_signal_at_the_edge_of_a_run_ends_it_like_any_other(place: str) -> None:
    code = (
        "import signal, sys; from sgstore.apps.cli import _application as cli\n"
        "sys.argv = ['sgstore', '--version']\n"
        f"cli.{place} = lambda *a: signal.raise_signal(signal.SIGTERM)\n"
        "cli.main()"
    )

    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)

    assert (done.returncode, done.stderr) == (143, "sgstore: ended by SIGTERM\n")


def test_what_its_parent_ignores_is_ignored(town_store: Path) -> None:
    code = (
        "import signal, sgstore.apps.cli._process as ending; ending.heed_signals();"
        " print(signal.getsignal(signal.SIGHUP) is signal.SIG_IGN)"
    )

    done = subprocess.run(
        ["nohup", sys.executable, "-c", code], capture_output=True, text=True, check=True
    )

    assert done.stdout.strip() == "True"
