"""What people get who install it: what is in the wheel, and what it says that it needs."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from typing import TYPE_CHECKING

import packages
import pytest

import sgstore

if TYPE_CHECKING:
    from pathlib import Path

IMPORTED_AS = {"google": "protobuf", "PIL": "pillow", "sklearn": "scikit-learn", "pytest": None}
"""Packages whose modules have another name; of pytest only the plugin is, and pytest loads it."""

NEEDED = sorted(
    {
        *packages.project()["dependencies"],
        *(n for extra in packages.project()["optional-dependencies"].values() for n in extra),
    }
    - {*packages.project()["optional-dependencies"]["all"]}
)
"""What ``pyproject.toml`` names: what is always installed, and the extras."""


def imported() -> set[str]:
    """Names of packages outside of the standard library that a file of ours imports, at its top or later."""
    found: set[str] = set()
    for path in (packages.REPOSITORY / "sgstore").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module.partition(".")[0]}
    found -= {*sys.stdlib_module_names, "sgstore"}
    return {name for module in found if (name := IMPORTED_AS.get(module, module))}


@pytest.fixture(autouse=True)
def _checkout(request: pytest.FixtureRequest) -> None:
    if "tmp_path" not in request.fixturenames:
        return
    git = shutil.which("git")
    if git is None or not (packages.REPOSITORY / ".git").exists():
        pytest.skip("no checkout of git: there is nothing to compare with")
    listed = subprocess.run(
        [git, "ls-files"], cwd=packages.REPOSITORY, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip(f"git does not list its files: {listed.stderr}")


def test_the_published_wheel_holds_what_is_committed(tmp_path: Path) -> None:
    wheel = packages.build(tmp_path, isolated=False)

    packages.check_contents(wheel, packages.shipped())
    with zipfile.ZipFile(wheel) as archive:
        (about,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = archive.read(about).decode()
    # An index shows the description where nothing lies beside it.
    assert "sgstore demo" in metadata
    assert not re.search(r"\]\((?!https?://)", metadata)
    told = dict(re.findall(r"^Project-URL: (.+), (.+)$", metadata, re.MULTILINE))
    assert told == packages.project()["urls"]


def test_a_wheel_with_another_file_or_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wheel = tmp_path / "sgstore-1-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("sgstore/__init__.py", "")
        archive.writestr("sgstore/apps/sample/town.mcap", "long")
        archive.writestr("sgstore-1.dist-info/METADATA", "")

    packages.check_contents(wheel, {"sgstore/__init__.py", "sgstore/apps/sample/town.mcap"})
    with pytest.raises(AssertionError, match=r"extra .*town\.mcap"):
        packages.check_contents(wheel, {"sgstore/__init__.py"})
    monkeypatch.setattr(packages, "LARGEST", 10)
    with pytest.raises(AssertionError, match="at most 10"):
        packages.check_contents(wheel, {"sgstore/__init__.py", "sgstore/apps/sample/town.mcap"})


def test_a_source_distribution_can_run_its_tests(tmp_path: Path) -> None:
    copy = packages.clean_copy(tmp_path)
    command = ["git", "ls-files"]
    listed = subprocess.run(command, cwd=copy, capture_output=True, text=True, check=True)
    with tarfile.open(packages.distribution(copy, "sdist")) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}

    left_out = {*listed.stdout.splitlines()} - held
    assert left_out == {".gitignore", ".dockerignore"}


@pytest.mark.parametrize("needed", NEEDED)
def test_every_package_that_is_needed_has_bounds(needed: str) -> None:
    name = re.match(r"[\w.-]+", needed)[0]
    lower = re.search(r"[>=]=([\d.]+)", needed)
    upper = re.search(r"(?:<|==)([\d.]+)", needed)

    assert lower
    # A major version of it each quarter, and what we use has not changed in any.
    assert upper or name == "pyarrow"


def test_the_citation_is_of_this_version_and_licence() -> None:
    text = (packages.REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
    told = dict(re.findall(r"^(version|license): (.+)$", text, re.MULTILINE))

    assert sgstore.__version__.startswith(told["version"])
    assert told["license"] == packages.project()["license"]


def test_every_package_that_is_imported_is_named_as_needed() -> None:
    named = {re.match(r"[\w-]+", needed)[0].replace("-", "_") for needed in NEEDED}
    assert {name.replace("-", "_") for name in imported()} <= named
