"""Examples in docstrings: they run, and every public name has some."""

from __future__ import annotations

import doctest
import inspect
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from api_page import PARTS, members

import sgstore

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.seconds(15)

PACKAGE = Path(sgstore.__file__).parent
WITH_EXAMPLES = [
    ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts)
    for file in sorted(PACKAGE.rglob("*.py"))
    if ">>> " in file.read_text(encoding="utf-8")
]
"""Modules: pytest could find them itself, but it would import all others, too, in each of its processes."""
OPTIONAL = {"Tabular.df": "pandas"}
"""Examples that need a package which is not among those for development."""


@pytest.fixture(scope="module")
def folder(town_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the examples run: a store, a collection of it, and a table."""
    from sgstore.collection import pack

    folder = tmp_path_factory.mktemp("examples")
    (folder / "demo.sgstore").write_bytes(town_store.read_bytes())
    (folder / "weather.csv").write_text("trace,rain\ntown,0.8\n")
    pack(town_store, folder / "fleet")
    return folder


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_in_docstrings_are_right(
    name: str, folder: Path, open_town: sgstore.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    module = import_module(name.removesuffix(".__init__"))
    runner = doctest.DocTestRunner()
    examples = doctest.DocTestFinder().find(
        module, extraglobs={"sgstore": sgstore, "store": open_town}
    )
    for example in examples:
        package = OPTIONAL.get(example.name.removeprefix(f"{module.__name__}."))
        if package is None or find_spec(package):
            runner.run(example)

    assert (runner.failures, runner.tries > 0) == (0, True)


def public_names() -> Iterator[tuple[str, Any]]:
    for name in (name for names in PARTS.values() for name in names):
        of = getattr(sgstore, name)
        yield name, of
        if inspect.isclass(of):
            yield from ((f"{name}.{member}", held) for member, held in members(name))


def test_every_public_name_has_examples() -> None:
    sections = {
        name: (inspect.getdoc(of) or "").partition("\nExamples\n--------\n>>> ")[2]
        for name, of in public_names()
    }

    assert [name for name, section in sections.items() if not section] == []
    assert [name for name, section in sections.items() if "doctest:" in section] == []
