"""Every command and program of ``docs/selection.md`` runs, in the order of the page."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer
from verb_lines import verbs

import sgstore
from sgstore.apps.cli import app, run
from sgstore.ingest import ingest

pytestmark = pytest.mark.seconds(8)

PAGE = (Path(__file__).parents[2] / "docs" / "selection.md").read_text(encoding="utf-8")
COMMANDS = [
    line.removeprefix("$ ")
    for block in re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("page")
    sample = Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap"
    for name, since, until in (("drives", 0, 40), ("new", 20, 60)):
        (place / "town.mcap").unlink(missing_ok=True)
        (place / "town.mcap").symlink_to(sample)
        ingest(place / f"{name}.sgstore", [place / "town.mcap"], since=since, until=until, rate=2)
    return place


def test_all_commands_of_the_page_run_one_after_another(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    codes = {command: run(shlex.split(command)[1:]) for command in COMMANDS}
    out = capsys.readouterr()

    assert {command: code for command, code in codes.items() if code} == {}
    assert "as locked" in out.err
    assert Path("curve.png").read_bytes().startswith(b"\x89PNG")
    assert len(COMMANDS) > 15


def test_the_program_of_the_page_prints_a_bound_below_its_cost(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    program = next(
        p for p in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "SelectionSpec" in p
    )

    exec(compile(program, "selection.md", "exec"), {})
    cost, bound, at_random = map(float, capsys.readouterr().out.splitlines()[0].split())

    assert bound <= cost <= at_random


def test_the_old_names_of_options_are_understood(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told: list[str] = []
    by_value = ("--stratify", "ego.speed > 8", "--per-class", "3")
    for options in (
        ("--minimal", "--objective", "seconds"),
        ("--minimal", "--objective", "seconds"),
        (*by_value, "--alpha", "0.5"),
        (*by_value, "--alpha", "0.5"),
    ):
        assert run(["select", str(folder / "drives.sgstore"), "--json", *options]) == 0
        told.append(capsys.readouterr().out)

    assert told[0] == told[1] != told[2] == told[3]


def test_every_verb_of_locks_is_on_the_page() -> None:
    known = verbs(typer.main.get_command(app))
    of_locks = {verb.split()[1] for verb in known if verb.startswith("lock ")}

    assert of_locks <= {shlex.split(command)[2] for command in COMMANDS if " lock " in command}
