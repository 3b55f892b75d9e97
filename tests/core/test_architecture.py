"""The house plan as a test: imports point down the layers, and each third-party package has one home."""

from __future__ import annotations

import ast
import importlib
import re
from fnmatch import filter as fitting
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from check import TESTS, WHOLE, part_of, patterns_of
from house import is_at_home, module_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

PACKAGE = Path(__file__).parents[2] / "sgstore"

# From the ground up. An import may only point to a lower layer. Packages and files of one layer do not know one
# another, except that the files of one folder do, and those of TOGETHER.
LAYERS: tuple[frozenset[str], ...] = (
    frozenset({"errors"}),
    frozenset({"base", "mcap"}),
    frozenset({"model"}),
    frozenset({"lang", "maps"}),
    frozenset({"graphs"}),
    frozenset({"draw", "readers", "sgg"}),
    frozenset({"store"}),
    frozenset({"ingest", "matches", "pipeline", "temporal"}),
    frozenset({"exporters"}),
    frozenset({"query"}),
    frozenset({"collection"}),
    frozenset({"testsets"}),
    frozenset({"apps"}),
)
TOGETHER = ({"ingest", "pipeline"}, {"matches", "temporal"})
"""Files of the design at the top, and the package each of them belongs to."""

FOLDERS_OF_LANG = ("syntax", "library", "bind", "contrib", "sql", "memory", "help")
"""Folders of the language, from the ground up."""

OUTER = {"apps", "collection", "draw", "exporters", "testsets"}
"""Packages around the core."""

LOOK_OUT = {
    "__init__": {"apps"},
    "__main__": {"apps"},
    "matches": {"draw"},
    "query": {"draw", "exporters"},
}
"""Files of the core that may import outer packages, inside functions or at their top, and which."""

OWNERS = {
    "duckdb": {"store"},
    "mcap": {"mcap", "readers", "exporters"},
    "google": {"readers", "exporters"},
    "zstandard": {"mcap", "readers", "exporters"},
    "lz4": {"mcap", "readers/rosbags", "exporters"},
    "isal": {"mcap"},
    "numba": {"base/numba_loops"},
    "subprocess": {"base/processes"},  # of the standard library: one protocol for worker processes
    "multiprocessing": set[str](),  # it unpickles what a process sends
    "typer": {"apps/cli"},
    "rich": {"apps/cli"},
    "networkx": {"model/graph", "exporters"},
    "shapely": {"base/geometry", "maps/roads", "maps/opendrive"},
    "lark": {"lang/syntax"},
    "highspy": {"testsets/selection"},
    "sklearn": {"testsets/selection"},
    "threadpoolctl": {"testsets/selection"},
    "matplotlib": {"draw"},
    "PIL": {"draw", "exporters"},
    "av": {"draw"},
    "pytest": {"apps/pytest_plugin"},
    "rerun": {"exporters"},
    "lance": {"exporters"},
    "pyproj": {"exporters"},
    "torch": {"exporters"},
    "torch_geometric": {"exporters"},
    "carla": {"readers"},
    "mcp": {"apps/assistant"},
    "pydantic": {"apps/assistant"},
    "obstore": {"mcap"},
    "ray": {"collection"},
    "pyspark": {"collection"},
    "starlette": {"apps/explorer"},
    "uvicorn": {"apps/explorer"},
}
"""Third-party package → the packages or files that import it."""

MOST_NAMES = 40
"""Most names of an interface."""

MOST_NAMES_OF_AUTHORS = 10
"""Most names of an interface for authors of readers, relations or exporters."""

MASKS_ARE_KNOWN_TO = {"store", "lang/sql/_masks", "lang/sql/_mask_counts", "lang/sql/_runs"}
SQL_OF_MASKS = re.compile(r"\bmask\b|\bbit_or\b|\bbit_count\b|<<")
FORBIDDEN_MODULES = {"pickle", "marshal", "shelve", "dill"}
FORBIDDEN_CALLS = {"eval", "exec", "__import__"}
NO_ROOMS = {"utils", "util", "common", "core", "helpers", "manager", "misc"}

FILES = sorted(PACKAGE.rglob("*.py"))
ROOMS = {room for layer in LAYERS for room in layer}


def room_of(path: Path) -> str:
    """The first step below the package: ``readers`` of ``readers/osi/_trace.py`` and of
    ``readers/__init__.py``."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").as_posix()


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def is_in(path: Path, places: set[str]) -> bool:
    """Tell whether a file is one of some places, ``store`` or ``base/temporary_folders``, or lies below one."""
    return any(f"{name_of(path)}/".startswith(f"{place}/") for place in places)


@cache
def source_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    """All nodes of a file, each once. The trees of all files are read once for all tests of this file."""
    return list(ast.walk(ast.parse(source_of(path))))


@cache
def imports_of(path: Path) -> set[str]:
    """Dotted names that a file imports when it runs, at its top or inside functions."""
    nodes = nodes_of(path)
    unseen = {id(n) for block in nodes if is_type_checking(block) for n in ast.walk(block)}
    names: set[str] = set()
    for node in nodes:
        if id(node) in unseen:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module}
            if node.module == "sgstore":
                names |= {f"sgstore.{alias.name}" for alias in node.names}
    return names


@pytest.fixture(scope="module", autouse=True)
def _trees_are_let_go() -> Iterator[None]:
    yield
    nodes_of.cache_clear()  # millions of nodes, which would slow every later test of the process


def height(room: str) -> int:
    return next(i for i, layer in enumerate(LAYERS) if room in layer)


def offending(faults_of: Callable[[Path], object]) -> dict[str, object]:
    """What is wrong, by file: an assertion that it is empty names all files in its message."""
    return {name_of(path): faults for path in FILES if (faults := faults_of(path))}


def test_imports_point_down_the_layers() -> None:
    def upward(path: Path) -> set[str]:
        room = room_of(path)
        if room in {"__init__", "__main__"}:
            return set()
        targets = {n.split(".")[1] for n in imports_of(path) if n.startswith("sgstore.")} - {room}
        targets -= {one for known in TOGETHER if room in known for one in known}
        return {t for t in targets if t not in ROOMS or height(t) >= height(room)}

    assert len(FILES) > 100
    assert offending(upward) == {}


def test_rooms_are_entered_by_their_faces() -> None:
    def past_the_face(path: Path) -> set[str]:
        names = {n.removeprefix("sgstore.") for n in imports_of(path) if n.startswith("sgstore.")}
        return {n for n in names if "._" in n and not is_at_home(module_of(path), n)}

    assert offending(past_the_face) == {}


def test_interfaces_import_and_list_their_names() -> None:
    """An ``__init__.py`` has a docstring, imports of its own modules, and the list of their names.

    A second list, ``__all__ += […]``, has the names for authors of plug-ins.
    """
    for path in sorted(PACKAGE.rglob("__init__.py")):
        body = ast.parse(source_of(path)).body
        if path.parent == PACKAGE or not any(isinstance(node, ast.ImportFrom) for node in body):
            continue
        package = importlib.import_module(".".join(path.parent.relative_to(PACKAGE.parent).parts))
        if "attach_stub" in source_of(path) or not hasattr(package, "__all__"):
            continue
        names = [
            alias.asname or alias.name
            for node in body
            if isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith(package.__name__)
            for alias in node.names
        ]
        assert {*package.__all__} <= {*names, *_defined(body)}, package.__name__
        more = sum(len(_listed(node.value)) for node in body if isinstance(node, ast.AugAssign))
        assert len(package.__all__) - more <= MOST_NAMES, package.__name__
        assert more <= MOST_NAMES_OF_AUTHORS, package.__name__


def _listed(node: ast.expr) -> list[ast.expr]:
    """Items of a list display."""
    assert isinstance(node, ast.List)
    return node.elts


def _defined(body: list[ast.stmt]) -> set[str]:
    """Names of the functions, classes and objects of a module."""
    objects = {ast.unparse(n.target) for n in body if isinstance(n, ast.AnnAssign)}
    return objects | {n.name for n in body if isinstance(n, (ast.FunctionDef, ast.ClassDef))}


def test_the_core_imports_no_outer_package() -> None:
    def outward(path: Path) -> set[str]:
        names = imports_of(path) | {  # and those for types
            n.module for n in nodes_of(path) if isinstance(n, ast.ImportFrom) and n.module
        }
        own = {room_of(path)} if room_of(path) not in OUTER else OUTER
        return {n.split(".")[1] for n in names if n.startswith("sgstore.")} & OUTER - own

    assert offending(outward) == LOOK_OUT


def test_folders_of_the_language_import_one_another_in_one_direction() -> None:
    def upward(path: Path) -> set[str]:
        own = folder_of(".".join(path.relative_to(PACKAGE).parts[:-1]))
        if own is None:
            return set()
        names = {n.removeprefix("sgstore.") for n in imports_of(path)}
        return {n for n in names if (folder_of(n) or 0) > own}

    assert offending(upward) == {}


def folder_of(name: str) -> int | None:
    """Place of a folder of ``lang/`` in the order in which they may import one another; files at its top: 0."""
    package, _, rest = name.partition(".")
    folder = rest.partition(".")[0]
    if package != "lang":
        return None
    return FOLDERS_OF_LANG.index(folder) + 1 if folder in FOLDERS_OF_LANG else 0


def test_every_file_has_a_room_in_the_plan() -> None:
    def unplanned(path: Path) -> set[str]:
        room = {room_of(path)} - ROOMS - {"__init__", "__main__"}
        return room | NO_ROOMS & set(name_of(path).split("/"))

    assert offending(unplanned) == {}


def test_the_page_names_every_package() -> None:
    page = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\| (`.*?`) \|", page[page.index("\n## Packages\n") :], re.MULTILINE)
    named = [name for cell in cells for name in re.findall(r"`([a-z0-9_/]+)(?:\.py|/)`", cell)]
    folders = {name_of(path.parent) for path in FILES if path.parent != PACKAGE}
    files = {path.stem for path in FILES if path.parent == PACKAGE}

    assert sorted(named) == sorted(folders | files - {"__init__", "__main__"})


def test_third_party_packages_are_met_in_their_one_home() -> None:
    def abroad(path: Path) -> set[str]:
        packages = {name.split(".")[0] for name in imports_of(path)}
        return {p for p in packages if p in OWNERS and not is_in(path, OWNERS[p])}

    assert offending(abroad) == {}


def test_nothing_is_unpickled_or_evaluated() -> None:
    def dangerous(path: Path) -> set[str]:
        calls = {
            n.func.id
            for n in nodes_of(path)
            if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)
        }
        return imports_of(path) & FORBIDDEN_MODULES | calls & FORBIDDEN_CALLS

    assert offending(dangerous) == {}


def test_functions_fit_the_house() -> None:
    def too_long(path: Path) -> set[str]:
        functions = [n for n in nodes_of(path) if isinstance(n, ast.FunctionDef)]
        return {f.name for f in functions if code_lines(f) > 60}

    assert offending(too_long) == {}


def code_lines(function: ast.FunctionDef) -> int:
    """Lines of a function from its name to its end, without its docstring."""
    lines = (function.end_lineno or 0) - function.lineno + 1
    first = function.body[0]
    if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
        lines -= (first.end_lineno or 0) - first.lineno + 1
    return lines


def test_every_file_of_tests_belongs_to_a_room() -> None:
    tests = {
        path.stem.removeprefix("test_") for path in Path(__file__).parents[1].rglob("test_*.py")
    }
    parts = {part_of(path.relative_to(PACKAGE.parent)) for path in FILES} | {*TESTS}
    patterns = [one for part in parts for one in patterns_of(part)]

    assert [one for one in WHOLE if one not in tests] == []
    assert [
        one for names in TESTS.values() for one in names.split() if not fitting(tests, one)
    ] == []
    assert tests - WHOLE - {one for pattern in patterns for one in fitting(tests, pattern)} == set()


def test_masks_are_a_secret_of_the_store() -> None:
    def told(path: Path) -> list[str]:
        if is_in(path, MASKS_ARE_KNOWN_TO):
            return []
        nodes = nodes_of(path)
        docstrings = {id(n.value) for n in nodes if isinstance(n, ast.Expr)}
        texts = [
            n.value
            for n in nodes
            if isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in docstrings
        ]
        return [t for t in texts if SQL_OF_MASKS.search(t)]

    assert offending(told) == {}
