"""Figures of the code base, each beside its ratchet: ``make house``.

``ratchets.toml`` keeps the figures. A figure may only fall; a test compares them. ``--write`` lowers the kept
figures. To raise one, edit the file and write the reason behind the number.

* *code lines*: lines of a file without blank lines, comments and docstrings.
* *length of a function*: code lines of its body, without the functions inside it.
* *circles*: groups of files that import one another, inside functions and for types included.
* *inner modules*: ``sgstore.package._module``. Only tests of an algorithm or a small limit import them.
* *unclear docstrings*: first paragraphs that match :data:`UNCLEAR`. The count is a meter, not the aim.
* *walk*: functions of sgstore that run in a fresh process during the ingest of the bundled sample, and during
  a query. Comprehensions, lambdas and bodies of modules and classes do not count.
"""

from __future__ import annotations

import argparse
import ast
import collections
import math
import re
import subprocess
import sys
import tempfile
import threading
import tomllib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import networkx

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from types import CodeType, FrameType

PACKAGE = Path(__file__).parents[1] / "sgstore"

INTERFACES_BELOW = {"apps", "base", "graphs", "lang", "maps", "model", "pipeline", "testsets"}
"""Packages whose parts have an interface each."""

RATCHETS = Path(__file__).with_name("ratchets.toml")
CORE = {
    *(
        "base",
        "graphs",
        "lang",
        "maps",
        "mcap",
        "model",
        "pipeline",
        "readers",
        "store",
        "temporal",
    ),
    *("errors", "ingest", "matches", "query", "sgg"),
}
"""Packages and files that import no outer package."""

UNCLEAR = re.compile(
    r"\b(who|whom|whoever|nobody|somebody)\b"  # persons for things
    r"|\b(told|tells|said of|(is|are|was) said)\b"
    r"|\bwhat (is|was|are|it|they|else|has|holds|comes|lies|stands|belongs|must|there|of)\b"
    r"|\b(is|are) (no|none)\b"
    r"|\b(so|as) (many|much)\b|\bof which\b|\bby which\b"
    r"|^(it|they|them|those|one|the same|the others|all of|as)\b"  # pronouns without a noun before them
    r"|\b(stands|meant|beside|comes in|goes? on)\b",
    re.IGNORECASE,
)
BANNER = re.compile(r"^\s*#.*-{4,}\s*$", re.MULTILINE)
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
    unclear: int = 0
    banners: int = 0


@dataclass
class House:
    """Figures of all rooms, and of what they have together."""

    rooms: dict[str, Room] = field(default_factory=lambda: collections.defaultdict(Room))
    homes: dict[str, list[str]] = field(default_factory=dict)
    lengths: list[int] = field(default_factory=list)
    interfaces: dict[str, int] = field(default_factory=dict)
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
    """``lang/bind/_queries.py`` as ``lang.bind._queries``, ``lang/__init__.py`` as ``lang``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


@cache
def survey() -> House:
    """Look at all files of the package and of the tests; once in a process."""
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
    room = house.rooms[name.split(".")[0] or "sgstore"]
    docs = [
        node.body[0]
        for node in nodes
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None
    ]
    code = code_lines(text, docs)
    room.files += 1
    room.code += len(code)
    room.docstrings += len(docs)
    firsts = (doc.value.value.strip().split("\n\n")[0] for doc in docs)
    room.unclear += sum(UNCLEAR.search(" ".join(one.split())) is not None for one in firsts)
    room.banners += len(BANNER.findall(text))
    if path.name == "__init__.py":
        house.interfaces[name or "sgstore"] = len(interface(path))
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


def interface(path: Path) -> list[str]:
    """Return the names that a package exports, from its ``__init__.py`` or its stub."""
    stub = path.with_suffix(".pyi")
    tree = ast.parse((stub if stub.exists() else path).read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return ast.literal_eval(node.value)
    return [a.asname or a.name for n in tree.body if isinstance(n, ast.ImportFrom) for a in n.names]


def code_lines(text: str, docstrings: Iterable[ast.stmt]) -> set[int]:
    """Numbers of the lines that hold code."""
    without = {line for doc in docstrings for line in range(doc.lineno, (doc.end_lineno or 0) + 1)}
    return {
        number
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.strip().startswith("#") and number not in without
    }


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


def entries_at_the_top() -> int:
    """Return the number of packages and modules directly below ``sgstore``."""
    here = [p for p in PACKAGE.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()]
    return len(here)


def figures(house: House, counts: dict[str, tuple[int, int]]) -> dict[str, dict[str, float]]:
    """Return the figures of the code base by table and name, as ``ratchets.toml`` keeps them."""
    rooms = house.rooms
    tests = 100 * len(house.inner_tests) / house.tests
    code = {
        "packages and modules at the top": entries_at_the_top(),
        "files": house.total("files"),
        "code lines of the core": sum(rooms[name].code for name in CORE),
        "code lines": house.total("code"),
        "classes": house.total("classes"),
        "class names used twice": len(house.twice()),
        "function length, median": house.length(0.5),
        "function length, 90th percentile": house.length(0.9),
        "function length, longest": house.length(1),
        "import circles": len(house.circles()),
        "imports of inner modules": len(house.past_faces),
        "banner comments": house.total("banners"),
        "test files with inner modules, percent": math.ceil(tests),
        **{f"functions of {verb}": functions for verb, (functions, _) in counts.items()},
    }
    page = [
        *(PACKAGE / "apps" / "explorer" / "page").glob("[!v]*/*.js"),
        *PACKAGE.rglob("page/style.css"),
    ]
    texts = [file.read_text(encoding="utf-8") for file in page]
    of_page = {
        "any in its types": sum(len(re.findall(r"\bany\b", text)) for text in texts),
        "longest line": max(len(line) for text in texts for line in text.splitlines()),
    }
    unclear = {n: math.ceil(1000 * r.unclear / max(r.docstrings, 1)) for n, r in rooms.items()}
    return {
        "code": code,
        "page of the explorer": of_page,
        "names of an interface": dict(sorted(house.interfaces.items())),
        "unclear docstrings per thousand": dict(sorted(unclear.items())),
    }


def kept() -> dict[str, dict[str, float]]:
    """Return the kept figures."""
    return tomllib.loads(RATCHETS.read_text(encoding="utf-8"))


def risen(found: dict[str, dict[str, float]]) -> list[str]:
    """Return one line for each figure that is above its ratchet or has none."""
    known = kept()
    return [
        f"{name}: {value}, at most {known.get(table, {}).get(name, 'nothing')}"
        for table, values in found.items()
        for name, value in values.items()
        if value > known.get(table, {}).get(name, -1)
    ]


def lowered(found: dict[str, dict[str, float]]) -> str:
    """Return the text of ``ratchets.toml`` with lower figures and without names that are gone."""
    lines: list[str] = []
    table = ""
    for line in RATCHETS.read_text(encoding="utf-8").splitlines():
        if head := re.fullmatch(r'\["?(.*?)"?\]', line):
            table = head[1]
        if entry := re.fullmatch(r'"(.*?)" = (\d+)(.*)', line):
            if entry[1] not in found[table]:
                continue
            lower = min(int(entry[2]), int(found[table][entry[1]]))
            lines.append(f'"{entry[1]}" = {lower}{entry[3]}')
        else:
            lines.append(line)
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description="Figures of the code base beside their ratchets.")
    parser.add_argument("--names", action="store_true", help="name what is counted")
    parser.add_argument("--write", action="store_true", help="lower the ratchets to the figures")
    parser.add_argument("--walk-of", nargs=2, metavar=("VERB", "STORE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.walk_of:
        print_walk(*options.walk_of, names=options.names)
        return 0
    house = survey()
    print(f"{'package':20}{'files':>7}{'code':>8}{'classes':>9}{'docstrings':>12}{'unclear':>9}")
    for name, room in sorted(house.rooms.items(), key=lambda item: -item[1].code):
        numbers = f"{room.files:7}{room.code:8}{room.classes:9}{room.docstrings:12}{room.unclear:9}"
        print(f"{name:20}{numbers}")
    if options.names:
        print(
            *(f"twice: {name} in {', '.join(at)}" for name, at in house.twice().items()), sep="\n"
        )
        print(*(f"circle: {', '.join(sorted(one))}" for one in house.circles()), sep="\n")
        print(*(f"inner module: {a} -> {b}" for a, b in sorted(house.past_faces)), sep="\n")
        print(*(f"inner module: {name}" for name in sorted(house.inner_tests)), sep="\n")
    found = figures(house, walks(names=options.names))
    if options.write:
        RATCHETS.write_text(lowered(found), encoding="utf-8")
    known = kept()
    for table, values in found.items():
        print(f"\n{table}")
        for name, value in values.items():
            print(f"  {name:44}{value:>8}   at most {known.get(table, {}).get(name, '?'):>7}")
    print(*risen(found), sep="\n")
    return int(bool(risen(found)))


if __name__ == "__main__":
    sys.exit(main())
