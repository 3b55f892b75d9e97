"""The house plan as a test: imports point down the layers, and each third-party package has one home."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "sgstore"

# From the ground up. An import may only point to a lower layer; rooms of one layer are strangers to
# one another, except that the files of one folder know each other.
LAYERS: tuple[frozenset[str], ...] = (
    frozenset({"errors", "geometry", "quoting", "vocabulary"}),
    frozenset({"config", "world"}),
    frozenset({"roads", "graph"}),
    frozenset({"opendrive", "online"}),
    frozenset({"traces", "relations", "abstractions", "lang"}),
    frozenset({"sgg", "store", "temporal"}),
    frozenset({"matches"}),
    frozenset({"history"}),
    frozenset({"ingest", "importing", "query", "graphs"}),
    frozenset({"locks"}),
    frozenset({"monitor", "coverage", "exporters", "draw", "cluster", "sandbox"}),
    frozenset({"selection", "differences"}),
    frozenset({"demo", "recording"}),
    frozenset({"cli", "web", "pytest_plugin"}),
)
OWNERS = {
    "duckdb": {"store"},
    "mcap": {"traces", "exporters"},
    "google": {"traces", "exporters"},
    "zstandard": {"traces", "exporters"},
    "lz4": {"traces", "exporters"},
    "isal": {"traces"},
    "typer": {"cli"},
    "rich": {"cli"},
    "networkx": {"graph", "exporters"},
    "shapely": {"geometry", "roads", "opendrive"},
    "lark": {"lang"},
    "matplotlib": {"draw"},
    "PIL": {"draw", "exporters"},
    "pytest": {"pytest_plugin"},
    "torch": {"exporters"},
    "torch_geometric": {"exporters"},
    "carla": {"traces"},
}
MASKS_ARE_KNOWN_TO = {"store", "lang/sql", "lang/presence", "lang/counting", "lang/runs"}
SQL_OF_MASKS = re.compile(r"\bmask\b|\bbit_or\b|\bbit_count\b|<<")
FORBIDDEN_MODULES = {"pickle", "marshal", "shelve", "dill"}
FORBIDDEN_CALLS = {"eval", "exec", "__import__"}
NO_ROOMS = {"utils", "util", "common", "core", "base", "helpers", "manager", "misc"}

FILES = sorted(PACKAGE.rglob("*.py"))
ROOMS = {room for layer in LAYERS for room in layer}


def room_of(path: Path) -> str:
    """The first step below the package: ``traces/osi.py`` and ``traces/__init__.py`` are ``traces``."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").as_posix()


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


def imports_of(path: Path) -> set[str]:
    """Dotted names that a file imports when it runs, at its top or inside functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    unseen = {id(n) for block in ast.walk(tree) if is_type_checking(block) for n in ast.walk(block)}
    names: set[str] = set()
    for node in ast.walk(tree):
        if id(node) in unseen:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module}
            if node.module == "sgstore":
                names |= {f"sgstore.{alias.name}" for alias in node.names}
    return names


def height(room: str) -> int:
    return next(i for i, layer in enumerate(LAYERS) if room in layer)


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_imports_point_down_the_layers(path: Path) -> None:
    room = room_of(path)
    if room in {"__init__", "__main__"}:
        return
    targets = {n.split(".")[1] for n in imports_of(path) if n.startswith("sgstore.")} - {room}

    assert {t for t in targets if t not in ROOMS or height(t) >= height(room)} == set()


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_every_file_has_a_room_in_the_plan(path: Path) -> None:
    assert room_of(path) in ROOMS | {"__init__", "__main__"}
    assert not NO_ROOMS & set(name_of(path).split("/"))


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_third_party_packages_are_met_in_their_one_home(path: Path) -> None:
    packages = {name.split(".")[0] for name in imports_of(path)}

    assert {p for p in packages if p in OWNERS and room_of(path) not in OWNERS[p]} == set()


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_nothing_is_unpickled_or_evaluated(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    calls = {
        n.func.id
        for n in ast.walk(tree)
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)
    }

    assert imports_of(path) & FORBIDDEN_MODULES == set()
    assert calls & FORBIDDEN_CALLS == set()


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_files_and_functions_fit_the_house(path: Path) -> None:
    source = path.read_text(encoding="utf-8")
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]

    assert len(source.splitlines()) <= 600
    assert {f.name for f in functions if code_lines(f) > 60} == set()


def code_lines(function: ast.FunctionDef) -> int:
    """Lines of a function from its name to its end, without its docstring."""
    lines = (function.end_lineno or 0) - function.lineno + 1
    first = function.body[0]
    if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
        lines -= (first.end_lineno or 0) - first.lineno + 1
    return lines


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_masks_are_a_secret_of_the_store(path: Path) -> None:
    if {room_of(path), name_of(path)} & MASKS_ARE_KNOWN_TO:
        return
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docstrings = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
    texts = [
        n.value
        for n in ast.walk(tree)
        if isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in docstrings
    ]

    assert [t for t in texts if SQL_OF_MASKS.search(t)] == []
