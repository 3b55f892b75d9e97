"""Mutants: faults put in on purpose, which the tests of their room must find. ``make mutants``.

::

    python tools/mutants.py                      # 14 in each room, and those that are named below
    python tools/mutants.py --rooms store --each 30 --seed 7

Small faults are made in the syntax trees of a room's files: a comparison flipped, a number off by one, ``and``
for ``or``, a statement dropped, two arguments swapped, a ``raise`` or a rollback removed. Which tests run which
lines is found out once and kept (see ``mutants_coverage.py``); each mutant is then given those tests that run
its line, the quickest files first, in a copy of the tree. A mutant that no test finds is printed. Those that
change nothing that could be seen are listed, each with the reason, in ``equivalent_mutants.txt``; they count as
survivors. What became of each is kept, too: a run that was stopped goes on when it is begun again.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final

from mutants_coverage import REPOSITORY, copy_of_the_tree, coverage_of, digest, environment

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence

    Takes = Callable[[Sequence[str]], float]

EQUIVALENT: Final = Path(__file__).with_name("equivalent_mutants.txt")

ROOMS: Final[dict[str, tuple[str, ...]]] = {
    "store": (
        *(
            "test_store*.py",
            "test_views.py",
            "test_schema*.py",
            "test_user_tables.py",
            "test_like.py",
            "test_rows.py",
        ),
        *(
            "test_doors.py",
            "test_events.py",
            "test_datasets.py",
            "test_derive*.py",
            "test_locks.py",
        ),
        "test_classes.py",
    ),
    "graphs/relations": (
        *("test_relations*.py", "test_extent.py", "test_lane_*.py", "test_sgg*.py"),
        *("test_crowds.py", "test_plugins.py", "test_compiled.py"),
    ),
    "temporal": (
        *("test_temporal.py", "test_over_time.py", "test_monitor.py", "test_check_verdicts.py"),
        *("test_robustness.py", "test_step_expressions.py", "test_windows.py", "test_union.py"),
        *("test_tolerance.py", "test_happens.py", "test_sequences.py", "test_shrink.py"),
        *("test_lang_topic_values.py", "test_noise.py", "test_clock.py"),
    ),
    "mcap": (
        *(
            "test_mcap*.py",
            "test_ahead.py",
            "test_order.py",
            "test_damaged.py",
            "test_carla_cut.py",
        ),
        *("test_carla_bags.py", "test_flavours.py"),
    ),
    "collection": ("test_collection*.py", "test_system_calls.py"),
    "lang": ("test_lang_*.py", "test_query.py", "test_like.py", "test_notes.py"),
    "readers": (
        *("test_mcap_file.py", "test_osi*.py", "test_cdr.py", "test_carla*.py", "test_foxglove.py"),
        *("test_flavours.py", "test_damaged.py", "test_ahead.py", "test_roads_osi*.py"),
    ),
}
"""The tests of each room that mutants are made in."""

AT_LEAST: Final = 60
AT_MOST: Final = 3
"""How many mutants there are, and how many may survive."""

TOGETHER: Final = 2
LIMIT_S: Final = 120.0
AT_LEAST_S: Final = 20.0
SLOWER: Final = 4.0
"""Mutants that are tried at a time; longest total of the tests of a mutant; and the processor time after
which a mutant has no end: so many seconds, and a multiple of what the tests take without it."""


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant: whether a test found it, and which, or why none did."""

    found: bool
    why: str


@dataclass(frozen=True)
class Mutant:
    """A fault.

    Attributes
    ----------
    path : str
        Of the file, in the repository.
    kind : str
    line : int
        Where it is.
    old : str
        Text of the file.
    begin, end : int
        What of it is changed; bytes.
    text : str
        What stands there now.
    where : str
        The function that it is in.
    said : str
        What was there, and what is there now.
    """

    path: str
    kind: str
    line: int
    old: str
    begin: int
    end: int
    text: str
    where: str
    said: str

    @property
    def key(self) -> str:
        """By what it is known in the list of equivalent ones: stays the same when lines move."""
        return f"{self.path} {self.where}: {self.said}"

    @property
    def new(self) -> str:
        """Text of the file with the fault."""
        raw = self.old.encode()
        return (raw[: self.begin] + self.text.encode() + raw[self.end :]).decode()

    def diff(self) -> str:
        """The difference that it makes."""
        lines = (text.splitlines(keepends=True) for text in (self.old, self.new))
        return "".join(difflib.unified_diff(*lines, self.path, self.path, n=2))


# What can be made wrong -----------------------------------------------------------------------------------

_FLIPPED: Final = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}


def comparison_flipped(node: ast.AST) -> ast.AST | None:
    """``<`` becomes ``<=``, ``==`` becomes ``!=``, ``in`` becomes ``not in``."""
    if not isinstance(node, ast.Compare):
        return None
    ops = [_FLIPPED[type(node.ops[0])](), *node.ops[1:]]
    return ast.Compare(node.left, ops, node.comparators)


def off_by_one(node: ast.AST) -> ast.AST | None:
    """A whole number becomes the next one."""
    if isinstance(node, ast.Constant) and type(node.value) is int:
        return ast.Constant(node.value + 1)
    return None


def and_or(node: ast.AST) -> ast.AST | None:
    """``and`` becomes ``or``, and the other way round; ``&`` and ``|`` too."""
    if isinstance(node, ast.BoolOp):
        return ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitAnd | ast.BitOr):
        swapped = ast.BitOr() if isinstance(node.op, ast.BitAnd) else ast.BitAnd()
        return ast.BinOp(node.left, swapped, node.right)
    return None


def statement_dropped(node: ast.AST) -> ast.AST | None:
    """A call whose result nobody takes, or an addition to something, is not there."""
    called = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    return ast.Pass() if called or isinstance(node, ast.AugAssign) else None


def arguments_swapped(node: ast.AST) -> ast.AST | None:
    """The first two arguments of a call change places."""
    if not isinstance(node, ast.Call) or len(node.args) < 2:
        return None
    one, two, *others = node.args
    if any(isinstance(a, ast.Starred) for a in (one, two)) or ast.dump(one) == ast.dump(two):
        return None
    if isinstance(node.func, ast.Name) and node.func.id in {"cast", "isinstance", "max", "min"}:
        return None  # these take theirs in any order, or not at all
    return ast.Call(node.func, [two, one, *others], node.keywords)


def raise_removed(node: ast.AST) -> ast.AST | None:
    """An error is not raised; but for that of a method that only stands for others."""
    if not isinstance(node, ast.Raise) or "NotImplementedError" in ast.unparse(node):
        return None
    return ast.Pass()


def rollback_removed(node: ast.AST) -> ast.AST | None:
    """What should be undone is kept."""
    if isinstance(node, ast.Constant) and node.value == "ROLLBACK":
        return ast.Constant("COMMIT")
    return None


KINDS: Final[tuple[Callable[[ast.AST], ast.AST | None], ...]] = (
    comparison_flipped,
    off_by_one,
    and_or,
    statement_dropped,
    arguments_swapped,
    raise_removed,
    rollback_removed,
)

NAMED: Final = (
    (
        "frames of equal time do not go on",
        "sgstore/store/_write.py",
        "joined = (seq > 0) & (step >= 0)",
        "joined = (seq > 0) & (step > 0)",
    ),
    (
        "the gate is not closed",
        "sgstore/store/_gate.py",
        "_lock(self._lock, fcntl.LOCK_EX, self._path, deadline)",
        "_lock(self._lock, fcntl.LOCK_SH, self._path, deadline)",
    ),
    (
        "orphans of a replaced trace are kept",
        "sgstore/store/_publish.py",
        "if known:\n        connection.execute(ORPHANS)",
        "if known:\n        pass",
    ),
    (
        "what failed is committed",
        "sgstore/store/_locking.py",
        'connection.execute("ROLLBACK")',
        'connection.execute("COMMIT")',
    ),
)
"""Mutants that survived once: their names, files, and texts."""


def named() -> Iterator[Mutant]:
    """Those that survived once."""
    for what, path, before, after in NAMED:
        old = (REPOSITORY / path).read_text(encoding="utf-8")
        assert before in old, f"{what}: {path} has no {before!r} any more"
        line = old[: old.index(before)].count("\n") + 1
        begin = len(old[: old.index(before)].encode())
        yield Mutant(path, what, line, old, begin, begin + len(before.encode()), after, "", what)


@cache
def mutants_of(path: Path) -> tuple[Mutant, ...]:
    """Everything that can be made wrong in the functions of a file."""
    return tuple(_mutants_of(path))


def _mutants_of(path: Path) -> Iterator[Mutant]:
    old = path.read_text(encoding="utf-8")
    name = path.relative_to(REPOSITORY).as_posix()
    raw = old.encode()
    starts = [0]
    for line in raw.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    times: Counter[str] = Counter()
    for where, node in _inside(ast.parse(old), ""):
        for kind in KINDS:
            changed = kind(node)
            if changed is None:
                continue
            begin = starts[node.lineno - 1] + node.col_offset
            end = starts[node.end_lineno - 1] + node.end_col_offset
            text = ast.unparse(ast.fix_missing_locations(changed))
            # In brackets, because what is around may bind closer.
            text = f"({text})" if isinstance(changed, ast.BoolOp | ast.BinOp) else text
            was = " ".join(raw[begin:end].decode().split())
            said = f"{kind.__name__}: {was} -> {text}"
            times[f"{where} {said}"] += 1
            if (time_of := times[f"{where} {said}"]) > 1:
                said += f" (number {time_of} in the function)"
            yield Mutant(name, kind.__name__, node.lineno, old, begin, end, text, where, said)


def _inside(node: ast.AST, where: str) -> Iterator[tuple[str, ast.AST]]:
    """The nodes of the bodies of functions, each with the function's name; without annotations and texts."""
    function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    named = function or isinstance(node, ast.ClassDef)
    where = f"{where}.{node.name}".lstrip(".") if named else where
    for field, value in ast.iter_fields(node):
        if field in {"annotation", "returns", "decorator_list", "args"} and named:
            continue
        if field == "annotation" or isinstance(node, ast.JoinedStr):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST):
                continue
            if hasattr(child, "lineno") and where and not isinstance(node, ast.ClassDef):
                yield where, child
            yield from _inside(child, where)


def chosen(room: str, number: int, seed: int) -> list[Mutant]:
    """Some mutants of a room, of every kind in turn; the same for the same seed, most also after a change."""
    every: dict[str, list[Mutant]] = {}
    for path in sorted((REPOSITORY / "sgstore" / room).rglob("*.py")):
        for mutant in mutants_of(path):
            every.setdefault(mutant.kind, []).append(mutant)
    for mutants in every.values():
        mutants.sort(key=lambda mutant: digest(f"{seed}", mutant.key))
    turns = [every[kind.__name__] for kind in KINDS if kind.__name__ in every]
    found = [mutant for turn in zip_longest(*turns) for mutant in turn if mutant is not None]
    return found[:number]


# Which tests find them ------------------------------------------------------------------------------------


def files_of(room: str) -> list[str]:
    """The files of tests of a room."""
    tests = REPOSITORY / "tests"
    return sorted(
        {str(p.relative_to(tests)) for pattern in ROOMS[room] for p in tests.rglob(pattern)}
    )


# Trying them ----------------------------------------------------------------------------------------------


class Tree:
    """A copy of the tree, in which one mutant after another is tried.

    Parameters
    ----------
    folder : Path
    files : sequence of str
        Files of tests, which are collected once.
    """

    def __init__(self, folder: Path, files: Sequence[str]) -> None:
        self.folder = copy_of_the_tree(folder)
        self._sound: set[str] = set()
        self._ready = False
        orders, replies = os.pipe(), os.pipe()
        command = [sys.executable, "tools/mutants_server.py", str(orders[0]), str(replies[1])]
        with (folder / "server.log").open("wb") as log:
            self._server = subprocess.Popen(
                [*command, *files],
                cwd=self.folder,
                env=environment(self.folder),
                pass_fds=(orders[0], replies[1]),
                stdout=log,
                stderr=log,
            )
        os.close(orders[0])
        os.close(replies[1])
        self._orders, self._replies = os.fdopen(orders[1], "w"), os.fdopen(replies[0])

    def close(self) -> None:
        """End the process that runs the tests."""
        self._orders.close()
        self._server.wait()
        self._replies.close()

    def outcome(
        self, mutant: Mutant, tests: Sequence[str], takes: Takes, limit: float = LIMIT_S
    ) -> Outcome:
        """Whether tests find a mutant.

        Parameters
        ----------
        mutant : Mutant
        tests : sequence of str
            Tests that run what is changed, in the order in which they are tried.
        takes : callable
            How long tests take without a mutant.
        limit : float
            Tests are left out when those before them take longer in total; s.

        """
        if not tests:
            return Outcome(found=False, why="no test of the room runs its file")
        if not self._ready:
            self._ready = bool(self._reply())
        waiting = list(tests)
        while len(waiting) > 1 and takes(waiting) > limit:
            waiting.pop()
        left, broken = len(tests) - len(waiting), 0
        # The second trial imports the changed file: some functions run only at the import.
        for anew in (False, True):
            while waiting:
                with self._changed(mutant):
                    failed = self._failed(waiting, takes, mutant, anew=anew)
                if failed is None:
                    break
                blamed = [failed] if failed in waiting else waiting
                if self._passes(blamed, takes):
                    why = failed if failed in waiting else f"{waiting[0]} and others: {failed}"
                    return Outcome(found=True, why=why)
                # A test that fails without the mutant finds nothing.
                print(f"{blamed} fail without any mutant", flush=True)
                broken += len(blamed)
                waiting = [test for test in waiting if test not in blamed]
        unused = f", {broken} fail without it" if broken else ""
        unused += f", {left} were not run" if left else ""
        return Outcome(found=False, why=f"all {len(waiting)} tests that run it pass{unused}")

    @contextmanager
    def _changed(self, mutant: Mutant) -> Generator[None]:
        file = self.folder / mutant.path
        file.write_text(mutant.new, encoding="utf-8")
        _forget(file)
        try:
            yield
        finally:
            file.write_text(mutant.old, encoding="utf-8")
            _forget(file)

    def _passes(self, tests: Sequence[str], takes: Takes) -> bool:
        unknown = [test for test in tests if test not in self._sound]
        if unknown and self._failed(unknown, takes) is not None:
            return False
        self._sound.update(unknown)
        return True

    def _failed(
        self,
        tests: Sequence[str],
        takes: Takes,
        mutant: Mutant | None = None,
        *,
        anew: bool = False,
    ) -> str | None:
        """The test that fails, or the reason why that is not known; ``None``: they pass."""
        seconds = AT_LEAST_S + SLOWER * takes(tests)
        with tempfile.TemporaryDirectory() as folder:
            if anew:
                return self._failed_anew(tests, folder, seconds)
            about = (
                {"path": str(self.folder / mutant.path), "old": mutant.old, "new": mutant.new}
                if mutant
                else {"old": "", "new": ""}
            )
            told = {"folder": folder, "tests": tests, "seconds": seconds, **about}
            self._orders.write(json.dumps(told) + "\n")
            self._orders.flush()
            child = self._reply()["child"]
            timer = threading.Timer(SLOWER * seconds, _kill, (child,))
            timer.start()
            reply = self._reply()
            timer.cancel()
        if reply["code"] == 0:
            return None
        return reply["failed"] or f"ended with code {reply['code']}"

    def _reply(self) -> dict[str, Any]:
        line = self._replies.readline()
        assert line, (self.folder / "server.log").read_text(encoding="utf-8")
        return json.loads(line)

    def _failed_anew(self, tests: Sequence[str], folder: str, seconds: float) -> str | None:
        options = ["-x", "-q", "-rf", "-p", "no:cacheprovider", "-p", "no:xdist"]
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *options, f"--basetemp={folder}/t", *tests],
            cwd=self.folder,
            env=environment(self.folder),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
        )
        try:
            said = process.communicate(timeout=SLOWER * seconds)[0]
        except subprocess.TimeoutExpired:
            _kill(process.pid)
            process.communicate()
            return "no end"
        if process.returncode == 0:
            return None
        named = [test for test in tests if f"FAILED {test}" in said or f"ERROR {test}" in said]
        return max(named, key=len, default=f"ended with code {process.returncode}")


def _kill(group: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def _forget(file: Path) -> None:
    """Compiled code is told from a changed source by seconds and size: too coarse here."""
    for kept in file.parent.glob(f"__pycache__/{file.stem}.*.pyc"):
        kept.unlink(missing_ok=True)


def equivalent() -> dict[str, str]:
    """Mutants that change nothing that could be seen, each with the reason."""
    found: dict[str, str] = {}
    for block in EQUIVALENT.read_text(encoding="utf-8").split("\n\n"):
        lines = [line for line in block.splitlines() if line and not line.startswith("#")]
        if lines:
            found[lines[0]] = " ".join(lines[1:])
    assert all(found.values()), "a mutant is listed as equivalent without a reason"
    return found


class Results:
    """What became of mutants, in a file, for the next run.

    A mutant that was found is found as long as the package and the tests that found it are the same; one that
    was not is tried again when any test is another one.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[str, dict[str, str]] = {}
        if path.exists():
            lines = path.read_text(encoding="utf-8").splitlines()
            self._known = {one["key"]: one for one in map(json.loads, lines)}
        top = REPOSITORY / "sgstore"
        parts = [p for p in sorted(top.rglob("*")) if p.suffix in {".py", ".sql", ".toml", ".lark"}]
        self._package = digest(*(part.read_bytes() for part in parts))
        tests = sorted((REPOSITORY / "tests").rglob("*.py"))
        self._tests = {one.name: digest(one.read_bytes()) for one in tests}

    def known(self, mutant: Mutant) -> Outcome | None:
        """What became of a mutant, if that is still so."""
        one = self._known.get(mutant.key)
        if one is None or one["state"] != self._state(one["by"]):
            return None
        return Outcome(found=bool(one["by"]), why=one["why"])

    def keep(self, mutant: Mutant, outcome: Outcome) -> None:
        """Write down what became of a mutant."""
        by = Path(outcome.why.partition("::")[0]).name if outcome.found else ""
        told = {"key": mutant.key, "by": by, "why": outcome.why, "state": self._state(by)}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(told) + "\n")

    def _state(self, by: str) -> str:
        tests = self._tests.get(by, "") if by else "".join(self._tests.values())
        return digest(self._package, tests)


def try_all(rooms: list[str], number: int, seed: int, kept: Path, limit: float = LIMIT_S) -> int:
    """Make mutants, try them, print what survives; how many do.

    Parameters
    ----------
    rooms : list of str
    number : int
        Mutants of each room; those that are named come on top.
    seed : int
    kept : Path
        Folder of what tests run which lines, and of results.
    limit : float
        Longest total of the tests of a mutant; s.
    """
    equal = equivalent()
    every = [(room, mutant) for room in rooms for mutant in chosen(room, number, seed)]
    every += [("store", mutant) for mutant in named() if "store" in rooms]
    begun = time.monotonic()
    coverages = coverage_of({room: files_of(room) for room in rooms}, kept, TOGETHER)
    files = sorted({f"tests/{file}" for room in rooms for file in files_of(room)})
    results = Results(kept / "results.ndjson")
    survivors: list[Mutant] = []
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(TOGETHER) as pool:
        trees: SimpleQueue[Tree] = SimpleQueue()
        for i in range(TOGETHER):
            (Path(name) / str(i)).mkdir()
            trees.put(Tree(Path(name) / str(i), files))

        def one(room: str, mutant: Mutant) -> Outcome:
            if mutant.key in equal:
                return Outcome(found=False, why=f"equivalent: {equal[mutant.key]}")
            if (before := results.known(mutant)) is not None:
                return before
            coverage, tree = coverages[room], trees.get()
            try:
                tests = coverage.of(mutant.path, mutant.line, mutant.old)
                flat = [test for of_file in tests for test in of_file]
                outcome = tree.outcome(mutant, flat, coverage.takes, limit)
            finally:
                trees.put(tree)
            results.keep(mutant, outcome)
            return outcome

        futures = {pool.submit(one, room, mutant): mutant for room, mutant in every}
        for count, future in enumerate(as_completed(futures), 1):
            mutant, outcome = futures[future], future.result()
            said = "found by" if outcome.found else "SURVIVES,"
            spent = time.monotonic() - begun
            print(f"{count}/{len(every)}, {spent:.0f} s: {said} {outcome.why}", flush=True)
            print(f"    {mutant.key} (line {mutant.line})", flush=True)
            if not outcome.found:
                survivors.append(mutant)
                print(mutant.diff(), flush=True)
        for _ in range(TOGETHER):
            trees.get().close()
    shown = sum(mutant.key in equal for mutant in survivors)
    print(
        f"{len(every)} mutants, {len(every) - len(survivors)} found; {len(survivors)} survive,"
        f" of which {shown} are shown to be equivalent; {time.monotonic() - begun:.0f} s"
    )
    return len(survivors)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", nargs="+", default=list(ROOMS), choices=list(ROOMS))
    parser.add_argument("--each", type=int, default=14)
    parser.add_argument("--seed", type=int, default=14)
    parser.add_argument(
        "--coverage",
        type=Path,
        default=REPOSITORY / "build" / "mutants",
        help="Folder that keeps what tests run which lines, and what became of mutants.",
    )
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="Longest total of tests; s.")
    given = parser.parse_args()
    os.nice(10)
    given.coverage.mkdir(parents=True, exist_ok=True)
    survive = try_all(given.rooms, given.each, given.seed, given.coverage, given.limit)
    sys.exit(survive > AT_MOST)
