"""Recipes of CONTRIBUTING.md, applied to a copy of the tree as they are printed."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
COPIED = (
    "sgstore",
    "tests",
    "tools",
    "docs",
    "samples",
    "pyproject.toml",
    "CONTRIBUTING.md",
    "README.md",
)
IGNORED = shutil.ignore_patterns("__pycache__", "frozen", "pictures", "page")
BLOCK = re.compile(r"^`([\w/.]+)`[^\n]*\n|^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
SECTION = re.compile(r"^### ([^\n]+)\n(.*?)(?=^##|\Z)", re.MULTILINE | re.DOTALL)
RECIPES: dict[str, str] = dict(SECTION.findall(PAGE))


def test_every_kind_of_extension_has_a_recipe() -> None:
    wanted = ("relation", "number of pairs", "abstraction", "reader", "exporter", "verb")

    assert [word for word in wanted if not any(word in title for title in RECIPES)] == []


@pytest.mark.parametrize("title", RECIPES)
def test_a_recipe_has_at_most_25_lines_of_code(title: str) -> None:
    found = [(language, block) for _, language, block in BLOCK.findall(RECIPES[title])]
    lines = [
        line
        for language, block in found
        for line in block.splitlines()
        if (language == "python" or (language == "diff" and line[0] == "+"))
        and line.strip(" +")
        and not line.strip(" +").startswith('"""')
    ]

    assert len(lines) <= 25


@pytest.mark.parametrize("title", RECIPES)
def test_a_recipe_passes_its_own_tests(title: str, tmp_path: Path) -> None:
    tree = copied(tmp_path / "tree")
    commands, written = applied(RECIPES[title], tree)

    assert commands
    for command in commands:
        done = run(command, tree)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        assert "no tests ran" not in done.stdout
    for arguments in (["check"], ["format", "--check"]):
        lint = [sys.executable, "-m", "ruff", *arguments, *map(str, written)]
        done = subprocess.run(lint, cwd=tree, check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


def copied(tree: Path) -> Path:
    """Return a copy of the tree, with the environment of this process."""
    tree.mkdir()
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tree / name, ignore=IGNORED)
        else:
            shutil.copy2(ROOT / name, tree)
    (tree / ".venv").symlink_to(sys.prefix)
    return tree


def applied(recipe: str, tree: Path) -> tuple[list[str], list[Path]]:
    """Write the blocks of a recipe into a tree; return its commands, and its Python files."""
    file, commands, written = tree, list[str](), list[Path]()
    for name, language, block in BLOCK.findall(recipe):
        if name:
            file = tree / name
        elif language == "console":
            commands += re.findall(r"^\$ (.+)$", block, re.MULTILINE)
        elif language == "diff":
            change(file, block)
        else:
            assert not file.exists(), file
            file.write_text(block, encoding="utf-8")
        if name.endswith(".py"):
            written.append(file)
    return commands, written


def change(file: Path, block: str) -> None:
    """Apply a diff whose old lines stand in the file exactly once."""
    lines = block.splitlines(keepends=True)
    old, new = ("".join(line[1:] for line in lines if line[0] in f" {sign}") for sign in "-+")
    text = file.read_text(encoding="utf-8")

    assert text.count(old) == 1, f"{file.name} has {text.count(old)} times:\n{old}"
    file.write_text(text.replace(old, new), encoding="utf-8")


def run(command: str, tree: Path) -> subprocess.CompletedProcess[str]:
    """Run a printed command line in a tree."""
    words = shlex.split(command, comments=True)
    given = [word for word in words if re.match(r"[A-Z_]+=", word)]
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    environment |= dict(word.split("=", 1) for word in given)
    return subprocess.run(
        words[len(given) :],
        cwd=tree,
        env=environment,
        check=False,
        capture_output=True,
        text=True,
    )
