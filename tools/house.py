"""Figures of the house, each beside its target: ``make house``.

How they are counted:

* *code lines*: lines of a file that are neither blank, nor a comment alone, nor part of a docstring.
* *length of a function*: the code lines of its body. The line of ``def`` with its parameters, decorators,
  the docstring, comments and blank lines do not count; functions inside it do.
* *wh docstrings*: docstrings whose first word is what, whether, who, which, where, how, when, why or whose.
* *circles*: groups of files that import one another, imports inside functions and for types included.
* *past a face*: imports of an inner module (``sgstore.room._module``) by another room. Files of tests that
  name one count apart: an oracle of an inner algorithm, or a limit made small, needs one.
* *walk*: functions of sgstore that run, and the files they are in, while the bundled sample is ingested and
  while a question is put to it, in a fresh process. Comprehensions, lambdas and bodies of modules and classes
  are no functions.
"""

from __future__ import annotations

import argparse
import ast
import collections
import re
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import networkx

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from types import CodeType, FrameType

PACKAGE = Path(__file__).parents[1] / "sgstore"

INTERFACES_BELOW = {"apps", "base", "graphs", "lang", "maps", "model", "pipeline", "testsets"}
"""Packages whose parts have an interface each."""

WH = {"what", "whether", "who", "which", "where", "how", "when", "why", "whose"}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
QUESTION = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed > 5"
INNER = re.compile(r"sgstore(\.[a-z]\w*)*\._[a-z][\w.]*")
OPTIMIZED = 1  # inspect.CO_OPTIMIZED: code of a function, not of a class or module


@dataclass
class Room:
    """Figures of one room."""

    files: int = 0
    code: int = 0
    classes: int = 0
    docstrings: int = 0
    wh: int = 0


@dataclass
class House:
    """Figures of all rooms, and of what they have together."""

    rooms: dict[str, Room] = field(default_factory=lambda: collections.defaultdict(Room))
    homes: dict[str, list[str]] = field(default_factory=dict)
    lengths: list[int] = field(default_factory=list)
    imports: networkx.DiGraph[str] = field(default_factory=networkx.DiGraph)
    past_faces: set[tuple[str, str]] = field(default_factory=set)
    tests: int = 0
    inner_tests: set[str] = field(default_factory=set)

    def total(self, figure: str) -> int:
        return sum(getattr(room, figure) for room in self.rooms.values())

    def twice(self) -> dict[str, list[str]]:
        return {name: files for name, files in self.homes.items() if len(files) > 1}

    def circles(self) -> list[set[str]]:
        found = networkx.strongly_connected_components(self.imports)
        return [circle for circle in found if len(circle) > 1]

    def length(self, share: float) -> int:
        """The length that a share of the functions do not exceed."""
        ordered = sorted(self.lengths)
        return ordered[min(int(len(ordered) * share), len(ordered) - 1)]


def is_at_home(module: str, inner: str) -> bool:
    """Tell whether a module may import an inner one: both are of one package, or of one part of a package."""
    names = inner.split(".")
    parts = 2 if names[0] in INTERFACES_BELOW and len(names) > 2 else 1
    return module.split(".")[:parts] == names[:parts]


def module_of(path: Path) -> str:
    """``lang/bind/_bind.py`` as ``lang.bind._bind``, ``lang/__init__.py`` as ``lang``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def survey() -> House:
    house = House()
    files = sorted(PACKAGE.rglob("*.py"))
    modules = {module_of(path) for path in files}
    for path in files:
        _look_at(path, modules, house)
    tests = {path.stem: path for path in (PACKAGE.parent / "tests").rglob("test_*.py")}
    house.tests = len(tests)
    house.inner_tests = {name for name, path in tests.items() if names_inner_module(path)}
    return house


def names_inner_module(path: Path) -> bool:
    """Return whether a file imports an inner module, or names one in a text such as ``monkeypatch`` takes."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    texts = (n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str))
    return any("._" in one for one in imported(nodes)) or any(map(INNER.fullmatch, texts))


def _look_at(path: Path, modules: set[str], house: House) -> None:
    text = path.read_text(encoding="utf-8")
    nodes = list(ast.walk(ast.parse(text)))
    name = module_of(path)
    room = house.rooms[name.split(".")[0]]
    docs = [
        node.body[0]
        for node in nodes
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None
    ]
    code = code_lines(text, docs)
    room.files += 1
    room.code += len(code)
    room.docstrings += len(docs)
    room.wh += sum(_first_word(doc.value.value) in WH for doc in docs)
    for node in nodes:
        if isinstance(node, ast.ClassDef):
            room.classes += 1
            house.homes.setdefault(node.name, []).append(name)
        elif isinstance(node, FUNCTIONS):
            first = node.body[0].lineno
            house.lengths.append(len(code & set(range(first, (node.end_lineno or 0) + 1))))
    inside = name if path.name == "__init__.py" else None  # an interface imports its own modules
    for target in imported(nodes):
        if inside is not None and target.startswith(f"sgstore.{inside}."):
            continue
        known = target.removeprefix("sgstore.")
        if known in modules and known != name:
            house.imports.add_edge(name, known)
        if "._" in target and not is_at_home(name, known):
            house.past_faces.add((name, target))


def code_lines(text: str, docstrings: Iterable[ast.stmt]) -> set[int]:
    """Numbers of the lines that hold code."""
    without = {line for doc in docstrings for line in range(doc.lineno, (doc.end_lineno or 0) + 1)}
    return {
        number
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.strip().startswith("#") and number not in without
    }


def _first_word(docstring: str) -> str:
    return next(iter(docstring.split()), "").lower().strip("`'\",:")


def imported(nodes: list[ast.AST]) -> Iterator[str]:
    """Dotted names below ``sgstore`` that a file imports, for types and inside functions, too."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.startswith("sgstore."))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "sgstore":
            if node.module != "sgstore":
                yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


class Walk:
    """Functions of sgstore that run while it is open, in all threads of this process."""

    def __init__(self) -> None:
        self.functions: dict[tuple[str, str], None] = {}  # in the order of their first calls
        self._seen: dict[CodeType, bool] = {}

    def _event(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or code in self._seen:
            return
        self._seen[code] = True
        ours = code.co_filename.startswith(f"{PACKAGE}/")
        if ours and code.co_flags & OPTIMIZED and not code.co_name.startswith("<"):
            name = Path(code.co_filename).relative_to(PACKAGE).as_posix()
            self.functions.setdefault((name, code.co_qualname))

    def __enter__(self) -> Walk:
        threading.setprofile(self._event)
        sys.setprofile(self._event)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)


def walk(verb: str, store: str) -> Walk:
    """Ingest the bundled sample, or put a question to it; in this process."""
    import sgstore
    from sgstore import ingest as ingesting

    sample = PACKAGE / "apps" / "sample" / "town.mcap"
    with Walk() as walked:
        if verb == "ingest":
            (outcome,) = ingesting.ingest(store, [sample])
            assert outcome.error is None
        else:
            assert list(sgstore.open(store).find(QUESTION))
    return walked


def print_walk(verb: str, store: str, *, names: bool) -> None:
    functions = walk(verb, store).functions
    print(len(functions), len({file for file, _ in functions}))
    if names:
        print(*(f"{file} {name}" for file, name in functions), sep="\n")


def walks(*, names: bool) -> dict[str, tuple[int, int]]:
    """Functions and files of an ingest and of a find, each in a process of its own."""
    counts = {}
    with tempfile.TemporaryDirectory() as folder:
        for verb in ("ingest", "find"):
            command = [sys.executable, __file__, "--walk-of", verb, f"{folder}/town.sgstore"]
            said = subprocess.run(
                [*command, *["--names"] * names], stdout=subprocess.PIPE, text=True, check=True
            ).stdout.splitlines()
            if names:
                print(f"{verb}:", *said[1:], sep="\n  ")
            functions, files = said[0].split()
            counts[verb] = int(functions), int(files)
    return counts


def figures(house: House, counts: dict[str, tuple[int, int]]) -> list[tuple[str, float, float]]:
    """Name, value and target of each figure: none may be above its target."""
    wh = 100 * house.total("wh") / max(house.total("docstrings"), 1)
    rows: list[tuple[str, float, float]] = [
        ("files", house.total("files"), 190),
        ("code lines", house.total("code"), 43_000),
        ("classes", house.total("classes"), 500),
        ("class names that stand twice", len(house.twice()), 0),
        ("function, median length", house.length(0.5), 7),
        ("function, 90 % are at most", house.length(0.9), 20),
        ("function, longest", house.length(1), 60),
        ("docstrings with a wh-word, %", round(wh, 1), 2),
        ("import circles", len(house.circles()), 0),
        ("imports past a face", len(house.past_faces), 0),
        ("tests past a face, %", round(100 * len(house.inner_tests) / house.tests), 50),
    ]
    targets = {"find": (200, 25), "ingest": (400, 45)}
    for verb, (functions, files) in counts.items():
        rows += [
            (f"{verb}: functions", functions, targets[verb][0]),
            (f"{verb}: files", files, targets[verb][1]),
        ]
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description="Figures of the house, each beside its target.")
    parser.add_argument("--walk", action="store_true", help="count what a find and an ingest run")
    parser.add_argument("--names", action="store_true", help="name what is counted")
    parser.add_argument("--require", action="store_true", help="status 1 when a target is missed")
    parser.add_argument("--walk-of", nargs=2, metavar=("VERB", "STORE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.walk_of:
        print_walk(*options.walk_of, names=options.names)
        return 0
    house = survey()
    print(f"{'room':20}{'files':>7}{'code':>8}{'classes':>9}{'docstrings':>12}{'wh':>6}")
    for name, room in sorted(house.rooms.items(), key=lambda item: -item[1].code):
        print(
            f"{name:20}{room.files:7}{room.code:8}{room.classes:9}{room.docstrings:12}{room.wh:6}"
        )
    if options.names:
        print(
            *(f"twice: {name} in {', '.join(at)}" for name, at in house.twice().items()), sep="\n"
        )
        print(*(f"circle: {', '.join(sorted(one))}" for one in house.circles()), sep="\n")
        print(*(f"past a face: {a} -> {b}" for a, b in sorted(house.past_faces)), sep="\n")
        print(*(f"past a face: {name}" for name in sorted(house.inner_tests)), sep="\n")
    missed = 0
    print()
    for name, value, target in figures(house, walks(names=options.names) if options.walk else {}):
        missed += value > target
        print(f"{name:32}{value:>9}   target {target:>7}   {'missed' * (value > target)}")
    return int(options.require and missed > 0)


if __name__ == "__main__":
    sys.exit(main())
