"""Which tests run which lines, for ``mutants.py``.

Measured in a copy of the tree, a file of tests at a time, and kept in a folder: what was measured stays until
the file of tests is another one. Where a source changed since, its lines are found again by their text.
"""

from __future__ import annotations

import ast
import difflib
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

REPOSITORY: Final = Path(__file__).parents[1]

IMPORTED: Final = (
    "tests",
    *(f"tests/{name}" for name in ("core", "edges", "worlds", "reference")),
    "tools",
)
"""Folders on the import path of the tests."""


def copy_of_the_tree(folder: Path) -> Path:
    """A copy of what tests need."""
    ignored = shutil.ignore_patterns("__pycache__")
    for name in ("sgstore", "tests", "tools", "docs", "bench", "samples"):
        shutil.copytree(REPOSITORY / name, folder / name, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "CHANGELOG.md", "Makefile", "LICENSE"):
        shutil.copy(REPOSITORY / name, folder)
    return folder


def environment(tree: Path) -> dict[str, str]:
    """In which tests of a copy of the tree run."""
    environ = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, (tree, *(tree / name for name in IMPORTED)))),
    }
    environ.setdefault("SGSTORE_DATA", str((REPOSITORY / "../shared/data").resolve()))
    return environ


def digest(*texts: str | bytes) -> str:
    """Short name of texts."""
    made = hashlib.sha256()
    for text in texts:
        made.update((text.encode() if isinstance(text, str) else text) + b"\0")
    return made.hexdigest()[:20]


def moved(old: str, new: str) -> dict[int, int]:
    """Lines of a text → the lines that they were in an older one; those that are new have none."""
    if old == new:
        return {line: line for line in range(1, new.count("\n") + 2)}
    matcher = difflib.SequenceMatcher(None, new.splitlines(), old.splitlines(), autojunk=False)
    return {
        a + i + 1: b + i + 1 for a, b, size in matcher.get_matching_blocks() for i in range(size)
    }


@dataclass
class Coverage:
    """Which tests run which lines.

    Attributes
    ----------
    tests : dict
        (path, line) → ids of tests.
    seconds : dict
        Id of a test → how long it takes.
    """

    tests: dict[tuple[str, int], set[str]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def of(self, path: str, line: int, text: str) -> list[list[str]]:
        """Tests that run a line: those of a file together; files and tests first that ask the most in a time.

        Where no test is seen to run the statement (it may run in another process), those that run the function
        around it, or else anything of the file.
        """
        whole = 1, text.count("\n") + 1
        spans = (*_around(text, line), whole)
        found: set[str] = set()
        for low, high in spans:
            found = {t for at in range(low, high + 1) for t in self.tests.get((path, at), ())}
            if found:
                break
        files: dict[str, list[str]] = {}
        for test in sorted(found, key=lambda test: (self.seconds[test], test)):
            files.setdefault(test.partition("::")[0], []).append(test)
        return sorted(files.values(), key=lambda tests: self.takes(tests) / len(tests))

    def takes(self, tests: Sequence[str]) -> float:
        """How long tests take; s."""
        return sum(self.seconds[test] for test in tests)


def _around(text: str, line: int) -> list[tuple[int, int]]:
    """First and last lines: of the innermost statement around a line, and of the innermost function."""
    inside: list[tuple[int, int]] = []
    functions: list[tuple[int, int]] = []
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.stmt | ast.ExceptHandler) or node.lineno > line:
            continue
        last = node.end_lineno or node.lineno
        if line > last:
            continue
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            functions.append((node.body[0].lineno, last))  # its head is run where it is imported
        # Of a statement that holds others only what stands before them is run with it.
        body = getattr(node, "body", None)
        inside.append((node.lineno, max(body[0].lineno - 1, line) if body else last))
    # What is in no function is run where it is imported: that says nothing.
    return [max(inside), max(functions)] if functions else []


def coverage_of(
    files: Mapping[str, Sequence[str]], folder: Path, together: int
) -> dict[str, Coverage]:
    """Measure what is not kept yet, and read what is.

    Parameters
    ----------
    files : mapping
        Room → names of its files of tests.
    folder : Path
        Where it is kept.
    together : int
        Files that are measured at a time.
    """
    (folder / "sources").mkdir(parents=True, exist_ok=True)
    missing = [
        (room, name) for room in files for name in files[room] if _kept(room, name, folder) is None
    ]
    if missing:
        begun = time.monotonic()
        with tempfile.TemporaryDirectory() as made, ThreadPoolExecutor(together) as pool:
            tree = copy_of_the_tree(Path(made))

            def one(room_and_name: tuple[str, str]) -> str:
                return _measure(*room_and_name, tree, folder)

            for number, said in enumerate(pool.map(one, missing), 1):
                spent = time.monotonic() - begun
                print(f"coverage {number}/{len(missing)}, {spent:.0f} s: {said}", flush=True)
    return {room: _read(room, names, folder) for room, names in files.items()}


def _place(room: str, name: str, folder: Path) -> Path:
    return folder / f"{room.replace('/', '-')}-{name.removesuffix('.py').replace('/', '-')}.json"


def _kept(room: str, name: str, folder: Path) -> dict | None:
    """What is known of a file of tests, if it is the same as then."""
    place = _place(room, name, folder)
    if not place.exists():
        return None
    found = json.loads(place.read_text(encoding="utf-8"))
    same = found["text"] == digest((REPOSITORY / "tests" / name).read_bytes())
    return found if same else None


def _measure(room: str, name: str, tree: Path, folder: Path) -> str:
    """Run a file of tests, and keep which lines of the room each of them runs."""
    with tempfile.TemporaryDirectory() as scratch:
        data, durations, settings = (Path(scratch) / n for n in ("data", "seconds.json", "rc"))
        settings.write_text(f"[run]\nsource = {tree / 'sgstore' / room}\ndata_file = {data}\n")
        command = [sys.executable, "-m", "coverage", "run", f"--rcfile={settings}", "-m", "pytest"]
        options = ["-p", "mutants_seconds", "-p", "no:cacheprovider", "-q", "--no-header"]
        done = subprocess.run(
            [*command, *options, f"--basetemp={scratch}/t", f"tests/{name}"],
            check=False,
            cwd=tree,
            env=environment(tree) | {"MUTANTS_SECONDS": str(durations)},
            capture_output=True,
            text=True,
        )
        assert done.returncode in {0, 1}, done.stdout[-4000:] + done.stderr[-2000:]
        noted = json.loads(durations.read_text(encoding="utf-8"))
        seconds = {test: s for test, s in noted["seconds"].items() if test not in noted["failed"]}
        numbers = {test: number for number, test in enumerate(seconds)}
        lines = {
            path.relative_to(tree).as_posix(): {
                "source": _keep_source(path, folder),
                "lines": {
                    line: [numbers[t] for t in tests if t in numbers] for line, tests in at.items()
                },
            }
            for path, at in _lines(data)
        }
    text = digest((tree / "tests" / name).read_bytes())
    told = {"text": text, "seconds": seconds, "failed": noted["failed"], "lines": lines}
    beside = folder / f".{room.replace('/', '-')}-{name.replace('/', '-')}"
    beside.write_text(json.dumps(told), encoding="utf-8")
    beside.replace(_place(room, name, folder))
    failed = f", FAILED and not used: {noted['failed']}" if noted["failed"] else ""
    return f"{room}, {name}: {len(seconds)} tests, {sum(seconds.values()):.0f} s{failed}"


def _lines(data: Path) -> Iterator[tuple[Path, dict[int, list[str]]]]:
    from coverage import CoverageData

    found = CoverageData(str(data))
    found.read()
    for file in found.measured_files():
        yield Path(file), found.contexts_by_lineno(file)


def _keep_source(path: Path, folder: Path) -> str:
    text = path.read_bytes()
    kept = folder / "sources" / digest(text)
    if not kept.exists():
        kept.write_bytes(text)
    return kept.name


def _read(room: str, names: Sequence[str], folder: Path) -> Coverage:
    """What is kept of a room, for its sources as they are now."""
    coverage = Coverage()
    ways: dict[tuple[str, str], dict[int, int]] = {}
    for name in names:
        found = _kept(room, name, folder)
        assert found is not None, name
        coverage.seconds |= found["seconds"]
        tests = list(found["seconds"])
        for path, told in found["lines"].items():
            file, at = REPOSITORY / path, (path, told["source"])
            if not file.exists():
                continue
            if at not in ways:
                old = (folder / "sources" / told["source"]).read_text(encoding="utf-8")
                ways[at] = moved(old, file.read_text(encoding="utf-8"))
            for line, before in ways[at].items():
                run = told["lines"].get(str(before))
                if run:
                    coverage.tests.setdefault((path, line), set()).update(tests[n] for n in run)
    return coverage
