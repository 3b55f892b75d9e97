"""Verbs that are killed at random moments and begun again: all ends as where nobody disturbed it.

::

    python tools/killing.py 200        # how many kills; SEED=7 for others

Each verb that writes is run on a store that was prepared, and is killed while it is at work: by SIGKILL, alone
or with its workers, or by SIGTERM. Half of the kills come after a random part of the time that the verb takes,
half at the very moment at which a file comes, goes or changes its name. One that comes too late does not count.
Then the store must be whole, and nothing in it that is not of the state before or after; files are the old or
the new ones. The next run of the verb must end as an undisturbed one, with nothing left beside.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.extend(str(Path(__file__).parents[1] / "tests" / name) for name in ("worlds", "reference"))

from opendrive_maps import a_map, a_road, line
from recordings import Recorder, car, drive

from sgstore.apps.cli import run as sgstore
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Sequence

_PAUSE_S = 0.002
"""How often files are looked at; s."""

NOT_COMPARED = {"trace": "EXCLUDE (ingested_at)", "recording": "EXCLUDE (place)"}


def content(path: Path) -> dict[str, list[tuple[Any, ...]]]:
    """All rows of a store, but for the times at which traces came."""
    store = StoreFile(path)
    sql = "SELECT table_name FROM duckdb_tables() WHERE NOT internal ORDER BY ALL"
    with store.snapshot():
        tables = [table for (table,) in store.rows(sql)]
        return {
            table: store.rows(
                f"SELECT * {NOT_COMPARED.get(table, '')} FROM {table} ORDER BY ALL"
            ).values
            for table in tables
        }


def made(folder: Path, frames: int = 130) -> list[Path]:
    """Four recordings, two of which are of one name and two the same."""
    (folder / "other").mkdir()
    paths = [drive(folder / "a.mcap", frames=frames), drive(folder / "b.mcap", frames=frames // 2)]
    with Recorder(folder / "other" / "a.mcap") as recorder:
        for i in range(frames):
            recorder.ground_truth(i / 10, [car(1, i / 10), car(2, 20.0)], host=1)
            recorder.camera(i / 10 + 0.01)
    again = folder / "again.mcap"
    again.write_bytes(paths[1].read_bytes())
    return [*paths, folder / "other" / "a.mcap", again]


CODE = """
import sys
from sgstore.ingest import ingest
store, jobs, *paths = sys.argv[1:]
print("begun", flush=True)
outcomes = ingest(store, paths, jobs=int(jobs))
assert all(outcome.error is None for outcome in outcomes), outcomes
"""


def begun(store: Path, paths: list[Path], jobs: int) -> subprocess.Popen[str]:
    """A process that has begun to read recordings into a store."""
    run = subprocess.Popen(
        [sys.executable, "-c", CODE, str(store), str(jobs), *map(str, paths)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert run.stdout is not None
    run.stdout.readline()
    run.stdout.close()
    return run


# Processes --------------------------------------------------------------------------------------------------


def serve() -> None:
    """Run the command lines that stdin says, each in a process forked from one that imported all."""
    import atexit

    import duckdb  # noqa: F401

    import sgstore.apps.cli._process as ending
    import sgstore.exporters._write
    import sgstore.ingest
    import sgstore.pipeline.derive
    import sgstore.pipeline.importing
    import sgstore.pipeline.rebuild
    import sgstore.query
    import sgstore.testsets.locks
    import sgstore.testsets.selection
    from sgstore.apps import cli

    sgstore.ingest.BLOCK_FRAMES = 60
    for asked in sys.stdin:
        arguments, said = json.loads(asked)
        child = os.fork()
        if not child:
            code = 99
            try:
                os.setsid()
                ending.heed_signals()
                os.write(1, f"{os.getpid()}\n".encode())
                for stream, name in ((0, os.devnull), (1, os.devnull), (2, said)):
                    os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC), stream)
                sys.argv = ["sgstore", *arguments]
                cli.main()
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else 0
            except KeyboardInterrupt:  # before the command line itself heeds it
                code = ending.exit_code()
            except BaseException:  # noqa: BLE001
                sys.excepthook(*sys.exc_info())
            finally:
                atexit._run_exitfuncs()
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        os.write(1, f"{code}\n".encode())


class Server:
    """Processes of the command line that start at once; what they need for a time is in a folder of theirs."""

    def __init__(self, folder: Path) -> None:
        self.temporary = folder / "tmp"
        self.temporary.mkdir()
        self._said = folder / "said.txt"
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            env=os.environ | {"TMPDIR": str(self.temporary)},
        )
        self.pid = 0

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(60)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def start(self, arguments: list[str]) -> None:
        """Start a process; back when it is about to begin."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{json.dumps([arguments, str(self._said)])}\n".encode())
        self.pid = self._line()

    def _line(self) -> int:
        assert self._process.stdout is not None
        return int(self._process.stdout.readline())

    def ended(self, seconds: float) -> bool:
        """Whether it ends within a time."""
        return bool(select.select([self._process.stdout], [], [], max(seconds, 0))[0])

    def code(self) -> int:
        """Its exit code, when it and its workers have ended."""
        assert self.ended(120), "a run that does not end"
        code, end = self._line(), time.monotonic() + 20
        while self.processes() and time.monotonic() < end:
            time.sleep(0.005)
        assert not self.processes(), "workers outlive their run"
        return code

    def said(self) -> str:
        """What it wrote to stderr."""
        return self._said.read_text(encoding="utf-8", errors="replace")

    def processes(self) -> list[int]:
        """It and its workers, as long as they live.

        One whose first thread has ended holds its locks until the last one has: all threads are looked at.
        """
        found: set[int] = set()
        for stat in Path("/proc").glob("[0-9]*/task/[0-9]*/stat"):
            with suppress(OSError):
                fields = stat.read_text().rpartition(")")[2].split()
                if int(fields[3]) == self.pid and fields[0] not in "ZX":
                    found.add(int(stat.parts[2]))
        return sorted(found)

    def kill(self, how: str) -> None:
        """End it."""
        for pid in self.processes() if how == "all killed" else [self.pid]:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM if how == "terminated" else signal.SIGKILL)


# Verbs ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Verb:
    """A verb at work.

    Attributes
    ----------
    line : str
        What it is called with. ``{p}`` is the place where it works, ``{i}`` where its input is.
    again : str
        The same for a run that comes after one that did all but the last; by default that very line.
    starts_with : tuple of str
        Files of the input that are at the place before.
    gives : str
        The file or folder that it writes, if not into the store.
    at_once : bool
        Whether it is at work from the beginning, not only when a first file of its own is seen.
    keeps : tuple of str
        What a run that was ended in order may leave for the next one.
    """

    line: str
    starts_with: tuple[str, ...]
    again: str = ""
    gives: str = ""
    at_once: bool = False
    keeps: tuple[str, ...] = ()


_RECORDINGS = "{i}/a.mcap {i}/b.mcap {i}/other/a.mcap {i}/again.mcap"
_FRESH = ("s.db.rebuild", "s.db.rebuild-lock")
VERBS = {
    "ingest": Verb(f"ingest {{p}}/s.db {_RECORDINGS} --jobs 1", ("first/s.db",)),
    "ingest, 2 jobs": Verb(f"ingest {{p}}/s.db {_RECORDINGS} --jobs 2", ("first/s.db",)),
    "derive": Verb(
        "derive {p}/s.db --name wide --config {i}/wide.toml --trace a --trace b", ("s.db",)
    ),
    "import s3c": Verb("import {p}/s.db {i}/more.csv --as s3c", ("s.db",)),
    "import nodelink": Verb("import {p}/s.db {i}/graphs.json --as nodelink", ("s.db",)),
    "remove --compact": Verb(
        "remove {p}/s.db a b --compact", ("s.db",), again="remove {p}/s.db --compact"
    ),
    "rebuild": Verb("rebuild {p}/s.db", ("s.db",), keeps=_FRESH),
    "rebuild, 2 jobs": Verb("rebuild {p}/s.db --jobs 2", ("s.db",), keeps=_FRESH),
    "export clips": Verb("export {i}/s.db MATCH_ALL --to {p}/clips --as mcap", (), gives="clips"),
    "export parquet": Verb(
        "export {i}/s.db MATCH_ALL --to {p}/tables --as parquet", (), gives="tables"
    ),
    "shrink --to": Verb("shrink {i}/s.db MATCH_ALL --to {p}/cut", (), gives="cut"),
    "select -o": Verb("select {i}/s.db -o {p}/t.lock", ("t.lock",), gives="t.lock"),
    "lock union": Verb(
        "lock union {i}/a.lock {i}/b.lock -o {p}/t.lock",
        ("t.lock",),
        gives="t.lock",
        at_once=True,
    ),
}
_QUERY = "MATCH (e:Ego) WHERE e.x - 7 * floor(e.x / 7) < 2 RETURN CLIPS(-0.2s, +0.2s)"


def prepare(folder: Path, frames: int) -> None:
    """Make the input of all verbs."""
    made(folder, frames)
    (folder / "street.xodr").write_text(a_map(a_road("1", line(200.0, x=-20.0, y=2.0))))
    (folder / "wide.toml").write_text("[range]\nradius = 30.0\n")
    rows = ["ds,sg,n_img,t_id,node1,edge,node2"]
    graphs: list[dict[str, Any]] = []
    for i in range(6 * frames):
        rows += [
            f"d,g{i},1,0,ego,isIn,Ego Lane",
            f"d,g{i},1,1,car_{i % 5},{('near', 'visible')[i % 2]},ego",
        ]
        nodes = [{"id": "ego", "label": "ego"}, {"id": f"c{i % 7}", "label": "car"}]
        link = {"source": f"c{i % 7}", "target": "ego", "key": 0, "label": "near"}
        graphs.append(
            {"directed": True, "multigraph": True, "graph": {}, "nodes": nodes, "links": [link]}
        )
    (folder / "few.csv").write_text("\n".join([*rows[:9], ""]))
    (folder / "more.csv").write_text("\n".join([*rows, ""]))
    (folder / "graphs.json").write_text(json.dumps(graphs))
    (folder / "first").mkdir()
    store, i = f"{folder}/s.db", str(folder)
    for arguments in (
        ["ingest", f"{i}/first/s.db", f"{i}/b.mcap"],
        ["ingest", store, f"{i}/a.mcap", f"{i}/b.mcap"],
        ["ingest", store, f"{i}/other/a.mcap", "--map", f"{i}/street.xodr"],
        ["import", store, f"{i}/few.csv", "--as", "s3c"],
        ["derive", store, "--name", "near_by", "--config", f"{i}/wide.toml", "--trace", "b"],
        ["select", store, "MATCH (e:Ego) WHERE e.x < 5", "-o", f"{i}/a.lock"],
        ["select", store, "MATCH (e:Ego) WHERE e.x >= 5", "-o", f"{i}/b.lock"],
        ["select", store, "--minimal", "-o", f"{i}/t.lock"],
    ):
        with Path(os.devnull).open("w") as nothing:
            out, sys.stdout = sys.stdout, nothing
            err, sys.stderr = sys.stderr, nothing
            try:
                code = sgstore(arguments)
            finally:
                sys.stdout, sys.stderr = out, err
        assert code in {0, 3}, arguments


Rows = dict[str, Counter[str]]


@dataclass
class Measured:
    """What an undisturbed run does: what is there in the end, how long it takes, how often files change."""

    after: Any
    seconds: float
    changes: int


@dataclass
class Done:
    """What was done to a verb."""

    kills: Counter[str] = field(default_factory=Counter)
    late: int = 0
    rounds: int = 0
    half: int = 0


def tried_by_python(path: Path) -> bool:
    """Return whether this is the file by which ``tempfile`` finds out where files can be written.

    It is there for a moment in every process; its name has eight letters, and none of ours is so short.
    """
    return path.is_file() and len(path.name) == 8 and path.read_bytes() in {b"", b"blat"}


class Killing:
    """Kills of all verbs in a folder.

    Raises
    ------
    AssertionError
        A store or a file was torn, something was left beside it, or it is not as where nobody disturbed it.
    """

    def __init__(
        self, folder: Path, server: Server, verbs: Sequence[str], frames: int, seed: int
    ) -> None:
        self._folder, self._server = folder, server
        self._input = folder / "in"
        self._input.mkdir()
        prepare(self._input, frames)
        self._chance = random.Random(seed)
        self._measured: dict[str, Measured] = {}
        self._before: dict[str, Any] = {}
        self._places = 0
        self._seen: dict[str, Rows] = {}
        self.done = {name: Done() for name in verbs}

    def rounds(self, kills: int) -> None:
        """Kill so many runs, as many of each verb."""
        names = list(self.done)
        self._chance.shuffle(names)
        for number, name in enumerate(names):
            share = (kills + number) // len(names)
            while (left := share - self.done[name].kills.total()) > 0:
                self._round(name, min(left, self._chance.randint(1, 3)))

    def _place(self, verb: Verb) -> Path:
        self._places += 1
        place = self._folder / f"round{self._places}"
        place.mkdir()
        for name in verb.starts_with:
            shutil.copy2(self._input / name, place / Path(name).name)
        return place

    def _line(self, text: str, place: Path) -> list[str]:
        words = text.format(p=place, i=self._input).split()
        return [_QUERY if word == "MATCH_ALL" else word for word in words]

    def _names(self, place: Path) -> frozenset[str]:
        return frozenset(
            f"{root}/{name}"
            for top in (place, self._server.temporary)
            for root, folders, files in os.walk(top)
            for name in (*folders, *files)
        )

    def _measure(self, name: str) -> Measured:
        verb = VERBS[name]
        place = self._place(verb)
        self._before[name] = self._state(verb, place)
        self._server.start(self._line(verb.line, place))
        start, changes, names = 0.0, 0, self._names(place)
        if verb.at_once:
            start = time.perf_counter()
        while not self._server.ended(_PAUSE_S):
            now = self._names(place)
            if now != names:
                names, changes = now, changes + 1
                start = start or time.perf_counter()
        measured = Measured(None, time.perf_counter() - start, changes)
        assert self._server.code() in {0, 3}, self._server.said()
        measured.after = self._state(verb, place)
        assert measured.after != self._before[name] or "rebuild" in name, name
        self._bare(verb, place, "undisturbed")
        shutil.rmtree(place)
        return measured

    def _state(self, verb: Verb, place: Path) -> Any:
        """What is there: the rows of the store, which is not touched, or the bytes of files."""
        if verb.gives:
            top = place / verb.gives
            files = [top] if top.is_file() else sorted(top.rglob("*"))
            return {
                file.name: file.read_bytes()
                for file in files
                if file.is_file() and not any(p.name.startswith(".export-") for p in file.parents)
            }
        parts = [place / name for name in ("s.db", "s.db.wal") if (place / name).exists()]
        digest = " ".join(hashlib.sha256(part.read_bytes()).hexdigest() for part in parts)
        if digest not in self._seen:  # of the same bytes the same is known
            self._seen[digest] = self._rows(parts)
        return self._seen[digest]

    def _rows(self, parts: list[Path]) -> Rows:
        self._places += 1
        look = self._folder / f"look{self._places}"
        look.mkdir()
        for part in parts:
            shutil.copy2(part, look)
        faults = StoreFile(look / "s.db").verify().faults
        assert faults == [], faults
        found = content(look / "s.db")
        found["derived"] = (
            StoreFile(look / "s.db").rows("SELECT * EXCLUDE (derived_at) FROM derived").values
        )
        found["manifest"] = [row for row in found["manifest"] if row[2] != "derived"]  # has a time
        shutil.rmtree(look)
        return {table: Counter(map(repr, rows)) for table, rows in found.items()}

    def _bare(self, verb: Verb, place: Path, what: str, *more: str) -> None:
        """Assert that nothing is left that does not belong there."""
        names = {Path(name).name for name in verb.starts_with} | {verb.gives} | {*more}
        beside = [path.name for path in place.iterdir() if path.name not in names]
        if verb.gives and (place / verb.gives).is_dir():
            hidden = {p.name for p in (place / verb.gives).iterdir() if p.name.startswith(".")}
            beside += hidden - {*more}
        beside += [
            p.name
            for p in self._server.temporary.iterdir()
            if p.name not in more and not tried_by_python(p)
        ]
        assert beside == [], f"{what}: {sorted(beside)} is left"

    def _round(self, name: str, kills: int) -> None:
        verb, done = VERBS[name], self.done[name]
        if name not in self._measured:
            self._measured[name] = self._measure(name)
        measured = self._measured[name]
        place, state = self._place(verb), self._before[name]
        line, told = self._line(verb.line, place), [f"{name}, round {done.rounds}"]
        for _ in range(kills):
            if state == measured.after and "rebuild" not in name:
                break
            how = self._chance.choice(("killed", "all killed", "all killed", "terminated"))
            left = [Path(path).name for path in self._names(place)]  # by one that was killed
            moment, code = self._hit(verb, place, line, measured, how)
            told.append(f"{how} {moment}: {code}")
            what = "; ".join(told)
            assert "Traceback" not in self._server.said(), f"{what}: {self._server.said()}"
            if code not in {-signal.SIGKILL, 128 + signal.SIGTERM}:
                assert code in {0, 3}, f"{what}: {self._server.said()}"
                done.late += 1
            else:
                done.kills[how] += 1
                if how == "terminated":
                    self._bare(verb, place, what, *verb.keeps, *left)
            try:
                state = self._state(verb, place)
            except Exception as error:
                raise AssertionError(f"{what}: {error}") from error
            self._between(name, state, what)
            if state not in (self._before[name], measured.after):
                done.half += 1
            if verb.again and state != self._before[name]:
                line = self._line(verb.again, place)
        what = "; ".join(told)
        self._server.start(line)
        code = self._server.code()
        whole = verb.gives and state == measured.after and not verb.starts_with
        assert code in ({0, 3, 1} if whole else {0, 3}), f"{what}: {self._server.said()}"
        found = self._state(verb, place)
        others = [
            key for key in {*found, *measured.after} if found.get(key) != measured.after.get(key)
        ]
        assert others == [], f"{what}: differs in {others}"
        self._bare(verb, place, what)
        shutil.rmtree(place)
        done.rounds += 1

    def _hit(
        self, verb: Verb, place: Path, line: list[str], measured: Measured, how: str
    ) -> tuple[str, int]:
        """Start a run, and end it at work; when that was, and its exit code."""
        changes = self._chance.randint(1, max(measured.changes, 1))
        later = self._chance.uniform(0, measured.seconds)
        moment = f"at change {changes}"
        if self._chance.random() < 0.5:
            changes, moment = 0 if verb.at_once else 1, f"after {later:.3f} s"
        else:
            later = 0.0
        names = self._names(place)
        self._server.start(line)
        while changes and not self._server.ended(_PAUSE_S):
            now = self._names(place)
            if now != names:
                names, changes = now, changes - 1
        if not self._server.ended(later):
            self._server.kill(how)
        return moment, self._server.code()

    def _between(self, name: str, state: Any, what: str) -> None:
        """Assert that there is nothing that is neither of the state before nor of that after."""
        before, after = self._before[name], self._measured[name].after
        if VERBS[name].gives:
            for file, data in state.items():
                whole = {known.get(file) for known in (before, after)}
                assert data in whole, f"{what}: {file} is torn"
            assert {*before} <= {*state}, f"{what}: the old file is gone"
            return
        assert {*state} == {*before}, f"{what}: other tables"
        for table, rows in state.items():
            least, most = before[table] & after[table], before[table] | after[table]
            if table != "manifest":  # what it says has been verified
                assert least <= rows <= most, f"{what}: other rows in {table}"


def killed_and_resumed(
    folder: Path, kills: int, seed: int = 0, frames: int = 130, verbs: Sequence[str] = tuple(VERBS)
) -> dict[str, Done]:
    """Kill verbs on recordings of so many frames; see :class:`Killing`."""
    with Server(folder) as server:
        killing = Killing(folder, server, verbs, frames, seed)
        killing.rounds(kills)
        return killing.done


def main() -> None:
    if sys.argv[1:] == ["--serve"]:
        serve()
        return
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    seed = int(os.environ.get("SEED", "0"))
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        done = killed_and_resumed(Path(folder), kills, seed)
        seconds = time.perf_counter() - start
    for name, one in done.items():
        hows = ", ".join(f"{count} {how}" for how, count in sorted(one.kills.items()))
        print(
            f"{name:18} {one.kills.total():4} kills ({hows}) in {one.rounds} rounds;"
            f" {one.half} between two states, {one.late} too late"
        )
    kills = sum(one.kills.total() for one in done.values())
    print(f"{kills} kills, {seconds:.0f} s: every store and file whole and equal, nothing left")


if __name__ == "__main__":
    main()
