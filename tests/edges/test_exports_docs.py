"""Every command and every program of ``docs/exports.md`` runs, and what the page lists is all there is."""

from __future__ import annotations

import importlib
import re
import shlex
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from typer.main import get_command

import sgstore
from sgstore.apps.cli import app, run
from sgstore.apps.demo import RECORDING
from sgstore.exporters import EXPORTERS, GROUP, Export, write_export
from sgstore.ingest import ingest
from sgstore.model.world import Clip

if TYPE_CHECKING:
    from types import ModuleType

pytest_plugins = ["pytester"]

PAGE = (Path(__file__).parents[2] / "docs" / "exports.md").read_text(encoding="utf-8")
COMMANDS = [
    line.removeprefix("$ ")
    for block in re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL)
    for line in block.replace("\\\n", "").splitlines()
]
PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("page")
    recording = Path(shutil.copy(RECORDING, place / "town.mcap"))
    ingest(place / "drives.sgstore", [recording], since=48, until=60)
    (place / "frames.txt").write_text("town#50\ntown@10.5s\n")
    return place


def program(marker: str) -> str:
    (found,) = [text for text in PROGRAMS if marker in text]
    return found


def module(text: str, folder: Path, name: str) -> ModuleType:
    (folder / f"{name}.py").write_text(text)
    sys.modules.pop(name, None)
    return importlib.import_module(name)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_of_the_page_runs(
    folder: Path, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    name, *arguments = shlex.split(command)
    if arguments[0] == "import":
        assert run([*shlex.split(command_of("s3c"))[1:-1], "s3c"]) == 0

    code = run(arguments)
    out, err = capsys.readouterr()

    assert (name, code) == ("sgstore", 0), err
    if "--to" in arguments:
        to = folder / arguments[arguments.index("--to") + 1]
        assert (to / "manifest.json").is_file()
        assert all((folder / line.split()[0]).exists() for line in out.splitlines()[2:])
        shutil.rmtree(to)


def command_of(form: str) -> str:
    return next(c for c in COMMANDS if f"--as {form}" in c and c.startswith("sgstore export"))


def test_every_format_and_every_option_is_on_the_page() -> None:
    table = re.findall(r"^\| `(\w+)` \| ", PAGE, re.MULTILINE)

    assert table == [exporter.name for exporter in EXPORTERS]
    for option in ("--label", "--with-graph", "--abstraction", "--channel", "--clouds", "--param"):
        assert f"{option} " in PAGE or f"{option}`" in PAGE
    assert f'"{GROUP}"' in PAGE


def test_help_names_the_formats_that_support_each_option() -> None:
    program = get_command(app)
    command = program.commands["export"]
    above = program.context_class(program, info_name="sgstore")
    context = command.context_class(command, info_name="export", parent=above)
    command.get_help(context)  # It adds the help of the library's methods.
    helps = {option.name: option.help for option in command.params}
    supported = {option for exporter in EXPORTERS for option in exporter.options}

    for option in supported:
        formats = ", ".join(one.name for one in EXPORTERS if option in one.options)
        assert re.match(f"{formats}[:,] ", helps[option])


@pytest.mark.parametrize(("form", "marker"), [("nx", "node_link_graph"), ("pyg", "GraphData(")])
def test_a_program_of_the_page_reads_what_was_exported(
    folder: Path, form: str, marker: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    assert run(shlex.split(command_of(form))[1:]) == 0

    found = module(program(marker), folder, f"program_{form}")

    things: Any = found.graphs if form == "nx" else found.graph["node_type"]
    assert len(things) > 5


def test_the_format_of_the_page_can_be_exported(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    own = module(program("def write(export, folder)"), tmp_path, "my_package").IDS

    class Point:
        name, value = "ids", "my_package:IDS"

        def load(self) -> Any:
            return own

    monkeypatch.setattr("sgstore.base.plugins.entry_points", lambda group: [Point()])
    store = sgstore.open(folder / "drives.sgstore")

    (written,) = write_export(
        Export(store, (Clip("town", 50 * 10**9, 51 * 10**9),)), tmp_path / "out", "ids"
    )

    assert (tmp_path / "out" / "ids.txt").read_text().count("\n") == 10
    assert written.as_row()["count"] == 11


def test_the_test_of_the_page_passes(folder: Path, pytester: pytest.Pytester) -> None:
    (pytester.path / "drives.sgstore").symlink_to(folder / "drives.sgstore")
    pytester.makepyfile(program("@pytest.mark.scenes"))

    result = pytester.runpytest("-p", "sgstore.pytest_plugin", "-p", "no:cacheprovider")

    result.assert_outcomes(passed=1)
